"""Packages of trl_suite, with the data folders xml/ and mocap/ inside the wheel."""

import pathlib
import re
import tempfile

from setuptools import find_packages, setup
from setuptools.command.build_py import build_py

TORCH = 'torch>=2.5'
# Below the next version that may change what the suite calls: of viser this is not only its interface
# (rendering/web_guard.py), and Ray has changed the interface of RLlib in minor versions.
BVH = 'pybvh>=0.9,<1'
VISER = 'viser>=1.1,<1.2'
MINARI = 'minari[hdf5]>=0.5,<0.6'
RAY = '>=2.54.1,<2.61'

VERSION = '0.1.0'
# Policies that environments need: the footstep controllers. The others are in trained/, which is a
# distribution of its own.
CONTROLLERS = ('PD_Biped3D_LLC_General_Step-v0', 'PD_Biped3D_LLC_Run_FootStep-v0')


def long_description() -> str:
    """Returns README.md without pictures and relative links, which a registry cannot show."""
    text = pathlib.Path(__file__).with_name('README.md').read_text(encoding='utf-8')
    text = re.sub(r'!\[[^]]*\]\([^)]*\)', '', text)
    return re.sub(r'\[([^]]*)\]\((?!https?:)[^)]*\)', r'\1', text)


class DataOnly(build_py):
    """Leaves out modules of packages that are folders of data, such as `trained/setup.py`."""

    def find_package_modules(self, package, package_dir):
        found = super().find_package_modules(package, package_dir)
        return found if package_dir.startswith('trl_suite') else []


# A new folder: setuptools packs what an earlier build left in build/, deleted modules included.
build = tempfile.TemporaryDirectory()

setup(
    name='trl_suite',
    options={'build': {'build_base': build.name}},
    cmdclass={'build_py': DataOnly},
    version=VERSION,
    description='Terrain RL Simulator on MuJoCo: locomotion over random terrain, as a suite',
    long_description=long_description(),
    long_description_content_type='text/markdown',
    author='The trl_suite developers',
    license_expression='Apache-2.0',
    keywords=['reinforcement learning', 'locomotion', 'MuJoCo', 'dm_control', 'benchmark'],
    classifiers=[
        'Development Status :: 4 - Beta',
        'Intended Audience :: Science/Research',
        'Operating System :: POSIX :: Linux',
        'Programming Language :: Python :: 3',
        'Programming Language :: Python :: 3.11',
        'Programming Language :: Python :: 3.12',
        'Programming Language :: Python :: 3.13',
        'Programming Language :: Python :: 3.14',
        'Topic :: Scientific/Engineering :: Artificial Intelligence',
        'Topic :: Scientific/Engineering :: Physics',
        'Typing :: Typed',
    ],
    packages=[
        *find_packages(include=['trl_suite', 'trl_suite.*']),
        'trl_suite.xml',
        'trl_suite.mocap',
        'trl_suite.trained',
    ],
    package_dir={
        'trl_suite.xml': 'xml',
        'trl_suite.mocap': 'mocap',
        'trl_suite.trained': 'trained',
    },
    include_package_data=False,  # true by default where pyproject.toml has the table `project`
    package_data={
        'trl_suite': ['py.typed'],
        'trl_suite.actuation': ['*.json'],
        'trl_suite.benchmark': ['*.json'],
        'trl_suite.controllers': ['*.json'],
        'trl_suite.terrain': ['*.json'],
        'trl_suite.xml': ['*.xml'],
        'trl_suite.mocap': ['*.npz', '*.md'],
        'trl_suite.trained': [f'{id}.npz' for id in CONTROLLERS],
    },
    install_requires=[
        # MuJoCo 4.0.0 breaks dm_control 1.0.50 when a Physics is made.
        'mujoco>=3.17,<4',
        # dm-control requires labmaze, which has no wheels for Python 3.13 and later, and which the
        # suite never imports. There, `pip install --no-deps` installs dm-control, and the suite
        # requires what dm-control imports.
        "dm-control>=1.0.50; python_version < '3.13'",
        'absl-py',
        'dm-env',
        'dm-tree',
        'glfw',
        'numba>=0.61',
        'numpy>=2.0',
        'lxml',
        'packaging',
        'pyopengl',
        'scipy',
        'tqdm',
        'trimesh>=4.6',
    ],
    extras_require={
        'policies': [f'trl_suite_policies=={VERSION}'],
        'video': ['imageio[ffmpeg]', 'matplotlib'],
        'viewer': [VISER],
        'gymnasium': ['gymnasium>=1.1'],
        'sb3': ['gymnasium>=1.1', 'stable-baselines3>=2.4', TORCH],
        'benchmark': ['gymnasium>=1.1', 'stable-baselines3>=2.7', 'sb3-contrib>=2.7', TORCH],
        'minari': ['gymnasium>=1.1', MINARI],
        'torchrl': ['gymnasium>=1.1', 'torchrl>=0.13.3,<0.15', TORCH],
        'rllib': ['gymnasium>=1.1', f'ray[rllib]{RAY}', TORCH],
        'cluster': [f'ray{RAY}', 'fsspec'],
        'shimmy': ["shimmy[dm-control]>=2.0,<3; python_version < '3.13'"],  # it requires labmaze
        'clips': [BVH],
        'train': [TORCH],
        'tune': ['cma'],
        'test': [
            'pytest',
            'pytest-xdist',
            'build',
            'gymnasium>=1.1',
            'hypothesis>=6',
            MINARI,
            'imageio[ffmpeg]',
            'matplotlib',
            'pycollada',
            'playwright>=1.50',  # drives Chromium, which the tests look for on the system
            BVH,
            TORCH,
            VISER,
        ],
        'notebooks': [  # to run and store those of colab/
            'ipykernel',
            'nbclient',
            'nbformat',
            'gymnasium>=1.1',
            'imageio[ffmpeg]',
            'matplotlib',
            'stable-baselines3>=2.4',
            TORCH,
        ],
        'docs': [
            'furo>=2025.12.19',
            'myst-parser>=5,<6',
            'sphinx>=9,<10',
            'sphinx-argparse-cli>=1.20,<2',
            'sphinx-copybutton>=0.5,<1',
            'gymnasium>=1.1',
            'imageio[ffmpeg]',
            'matplotlib',
            VISER,
        ],
        'dev': ['ruff==0.17.5', 'mypy==2.4.1', 'import-linter==2.16', 'twine>=6'],
    },
    entry_points={'console_scripts': ['trl-suite = trl_suite.__main__:main']},
)
