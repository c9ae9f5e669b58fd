"""Tests of the package: pins, what importing costs, and a wheel far from the checkout."""

import ast
import os
import pathlib
import platform
import re
import shutil
import site
import subprocess
import sys
import sysconfig
import textwrap
import tomllib
import unittest
import zipfile
from unittest import mock

import pytest
from absl.testing import absltest, parameterized
from helpers import FolderTest, besides_notices
from llvmlite import binding
from packaging.requirements import Requirement

import tests
import trl_suite
from trl_suite.util import libraries, machine

CHECKOUT = pathlib.Path(__file__).resolve().parents[1]
TRAINED = 'PD_Dog2D_Gaps_Terrain-v0'


def python(code, executable=sys.executable, cwd=None, **variables):
    """Runs code in a fresh interpreter; returns what it printed."""
    environment = {name: value for name, value in os.environ.items() if name != 'PYTHONPATH'}
    done = subprocess.run(
        [str(executable), '-c', textwrap.dedent(code)], capture_output=True, text=True, cwd=cwd,
        env={**environment, **variables}, timeout=300,
    )  # fmt: skip
    if done.returncode:
        raise AssertionError(done.stderr)
    return done.stdout, done.stderr


class PinTest(absltest.TestCase):
    """Requirements of an installation."""

    setup = (CHECKOUT / 'setup.py').read_text(encoding='utf-8')

    def test_constraints_fix_what_is_required(self):
        listed = re.search(r'install_requires=\[(.*?)\]', self.setup, re.DOTALL).group(1)
        texts = re.findall(r'^ +([\'"].*[\'"]),$', listed, re.MULTILINE)
        required = [Requirement(ast.literal_eval(text)) for text in texts]
        self.assertGreater(len(required), 10)
        # dm_control 1.0.50 asks for mujoco>=3.17 but cannot make a Physics on MuJoCo 4.0.0
        # ('MjModel' object has no attribute 'flex_vertedge'), so an unpinned install is broken.
        (mujoco,) = (each.specifier for each in required if each.name == 'mujoco')
        self.assertEqual([version in mujoco for version in ('3.16', '3.17', '4.0')], [0, 1, 0])
        lines = (CHECKOUT / 'constraints.txt').read_text(encoding='utf-8').splitlines()[1:]
        fixed = [(each.name, each) for each in map(Requirement, lines)]
        for requirement in required:
            for version in ('3.11', '3.12', '3.13'):
                found = [
                    str(each.specifier).removeprefix('==') for name, each in fixed
                    if name == requirement.name
                    and (each.marker is None or each.marker.evaluate({'python_version': version}))
                ]  # fmt: skip
                self.assertLen(found, 1, (requirement.name, version))
                self.assertIn(found[0], requirement.specifier)

    def test_pages_install_the_version_of_dm_control_that_messages_name(self):
        names = 'README.md', 'CONTRIBUTING.md', '.ci/run', '.ci/newest_engine'
        pages = [CHECKOUT / name for name in names]
        for page in (*pages, *(CHECKOUT / 'docs').glob('*.md')):
            found = re.findall(r'--no-deps dm-control\S*', page.read_text('utf-8'))
            self.assertLessEqual({*found}, {libraries.DM_CONTROL}, page.name)
            if page in pages:
                self.assertNotEmpty(found, page.name)

    def test_a_missing_dm_control_is_named_with_the_command_that_installs_it(self):
        commands = f'evaluate {TRAINED} --policy zero', f'bench {TRAINED}', 'try a.xml'
        cases = [
            *(f'import trl_suite.{name}' for name in ('suite', 'gym', 'vector', 'evaluation')),
            *(f'from trl_suite import cli; cli.main({name.split()})' for name in commands),
        ]
        # In one process: what fails to be imported is not kept.
        out, err = python(f"""
            import contextlib, io, sys
            sys.modules['dm_control'] = None
            for code in {cases!r}:
                told = io.StringIO()
                with contextlib.redirect_stderr(told):
                    try:
                        exec(code)
                    except ImportError as error:
                        told.write(str(error))
                print(told.getvalue().strip())
        """)
        expected = f'dm_control is required but not installed; pip install {libraries.DM_CONTROL}'
        self.assertEqual(err, '')
        for code, line in zip(cases, out.splitlines(), strict=True):
            self.assertEndsWith(line, expected, code)

    def test_the_distributions_have_one_version(self):
        policies = tomllib.loads((CHECKOUT / 'trained' / 'pyproject.toml').read_text('utf-8'))
        self.assertEqual(policies['project']['version'], trl_suite.__version__)
        self.assertIn(f"VERSION = '{trl_suite.__version__}'", self.setup)


class DiscoveryTest(absltest.TestCase):
    """Python's own runner finds the tests."""

    def test_unittest_runs_what_is_not_slow(self):
        found = tests.flat(unittest.TestLoader().discover(str(CHECKOUT)))
        found = {test.id().partition(' ')[0].removeprefix('tests.'): test for test in found}
        self.assertIn('package_test.PinTest.test_constraints_fix_what_is_required', found)
        for slow in ('test_long_random_rollout', 'cluster_test'):
            self.assertNotIn(slow, ' '.join(found))
        result = unittest.TestResult()
        with mock.patch.dict(os.environ):
            os.environ.pop('PYTEST_CURRENT_TEST', None)
            found['imitation_test.ResetTest.test_on_the_ground_and_not_below0'].run(
                result
            )  # uses `helpers.made`
        self.assertEqual((result.testsRun, result.failures, result.errors), (1, [], []))


class ImportTest(parameterized.TestCase):
    """Importing is quick, quiet and needs no display."""

    @parameterized.parameters(
        # Large libraries, which take seconds, are imported on first use.
        ("import sys, trl_suite; print({'mujoco', 'dm_control', 'numba', 'scipy'} & {*sys.modules})",
         {}, 'set()'),
        # Needs no engine, nor the extra that trains.
        ("""
            import sys
            from trl_suite import motion, policies, terrain
            terrain.PlanarGround(terrain.load('slopes_mixed'), 0).height([0.0, 7.0])
            motion.load('dog_bound').velocity(0.1), policies.available()
            print({'mujoco', 'dm_control', 'torch'} & {*sys.modules})
         """, {}, 'set()'),
        # Prints nothing, and makes no context of OpenGL.
        ("""
            import sys, trl_suite.suite
            from dm_control import _render
            environment = trl_suite.suite.make('PD_Dog2D_Gaps_Terrain-v0', {'random': 0})
            environment.reset()
            print('glfw' in sys.modules, environment.physics._contexts)
         """, {'MUJOCO_GL': 'egl'}, 'False None'),
        ('import os, trl_suite; print(os.environ["MUJOCO_GL"])', {'MUJOCO_GL': 'osmesa'}, 'osmesa'),
        ('import os; del os.environ["MUJOCO_GL"]; import trl_suite; print(os.environ["MUJOCO_GL"])',
         {'MUJOCO_GL': 'x'}, 'egl'),
        # Triton, here a broken one, is imported before dm_control's OpenGL.
        ("""
            import pathlib, sys, tempfile
            folder = tempfile.TemporaryDirectory()
            pathlib.Path(folder.name, 'triton.py').write_text(
                'import sys; print("OpenGL" in sys.modules); 1 / 0'
            )
            sys.path.insert(0, folder.name)
            import trl_suite.suite
         """, {'MUJOCO_GL': 'egl'}, 'False'),
    )  # fmt: skip
    def test_imports_without_a_screen(self, code, variables, expected):
        if expected == 'egl' and sys.platform != 'linux':
            self.skipTest('only on Linux')
        out, err = python(code, **variables, DISPLAY='', WAYLAND_DISPLAY='')
        self.assertEqual((out, besides_notices(err)), (f'{expected}\n', ''))

    def test_triton_is_left_alone_after_dm_control(self):
        code = """
            import pathlib, sys, tempfile
            folder = tempfile.TemporaryDirectory()
            pathlib.Path(folder.name, 'triton.py').write_text('print("imported")')
            sys.path.insert(0, folder.name)
            import dm_control.mujoco, trl_suite.suite
        """
        out, err = python(code, MUJOCO_GL='egl')
        self.assertEqual((out, besides_notices(err)), ('', ''))

    def test_a_python_without_docstrings(self):
        code = f"""
            from trl_suite import suite
            environment = suite.make({TRAINED!r})
            environment.reset()
            print(environment.step([0] * 20).reward > 0)
        """
        out, _ = python(code, PYTHONOPTIMIZE='2', NUMBA_DISABLE_JIT='1')
        self.assertEqual(out, 'True\n')


class MachineTest(parameterized.TestCase):
    """The class of CPU, on which results are equal bit for bit."""

    @parameterized.parameters(
        ('Haswell', 'Haswell'), ('Zen', 'Haswell'), ('Sandybridge', 'Sandybridge'),
    )  # fmt: skip
    def test_names_the_functions_that_multiply_matrices(self, core, expected):
        """What OpenBLAS computes with, which need not be the newest that the processor has."""
        has_avx2 = binding.get_host_cpu_features().get('avx2')
        if (
            not (machine.cpu_class().startswith('x86_64 ') and has_avx2)
            or 'AVX' in machine.cpu_class()
        ):
            self.skipTest('not OpenBLAS on x86_64 with AVX2')
        code = 'from trl_suite.util import machine; print(machine.cpu_class())'
        self.assertEqual(python(code, OPENBLAS_CORETYPE=core), (f'x86_64 {expected}\n', ''))

    def test_with_another_library_names_vector_instructions(self):
        has = {'avx512f': False, 'avx2': True, 'sse2': True}
        with (
            mock.patch('llvmlite.binding.get_host_cpu_features', return_value=has),
            mock.patch.object(machine.ctypes, 'CDLL', return_value=None),
        ):
            found = machine.cpu_class.__wrapped__()
        self.assertEqual(found, f'{platform.machine()} AVX2')


class WheelTest(FolderTest):
    """A wheel installed elsewhere works without the checkout."""

    @pytest.mark.slow  # .ci/run runs it
    def test_wheel_contains_all_data(self):
        folder = self.folder.resolve()
        source, wheels, venv, work = (
            folder / name for name in ('source', 'wheels', 'venv', 'work')
        )
        work.mkdir()
        # Built from a copy: building writes to the folder of setup.py.
        source.mkdir()
        for name in ('trl_suite', 'xml', 'mocap', 'trained'):
            shutil.copytree(
                CHECKOUT / name, source / name, ignore=shutil.ignore_patterns('__pycache__')
            )
        for name in ('setup.py', 'pyproject.toml', 'README.md', 'LICENSE', 'NOTICE'):
            shutil.copy(CHECKOUT / name, source / name)
        some = folder / 'policies'
        for left in (source / 'build/lib/trl_suite', some / 'build/lib/trl_suite_policies'):
            left.mkdir(parents=True)
            (left / 'deleted.py').touch()  # by an update, after an earlier build
        self.run_quietly(
            sys.executable, '-m', 'build', '--wheel', '--outdir', wheels, source, cwd=work
        )
        (wheel,) = wheels.glob('*.whl')
        self.assertLess(wheel.stat().st_size, 3e6)
        # Of the second distribution, with one policy instead of all.
        for name in (
            'setup.py', 'pyproject.toml', 'README.md', 'LICENSE', f'{TRAINED}.npz',
            f'{TRAINED}.json',
        ):  # fmt: skip
            shutil.copy(CHECKOUT / 'trained' / name, some / name)
        self.run_quietly(
            sys.executable, '-m', 'build', '--wheel', '--outdir', folder, some, cwd=work
        )
        for built in folder.glob('**/*.whl'):
            names = zipfile.ZipFile(built).namelist()
            self.assertNotIn('deleted', ' '.join(names))
            self.assertNotIn('setup.py', ' '.join(names))
        shutil.rmtree(source)

        self.run_quietly(sys.executable, '-m', 'venv', '--without-pip', venv)
        inner = venv / 'bin' / 'python'
        target = pathlib.Path(
            python("import sysconfig; print(sysconfig.get_path('purelib'))", inner)[0].strip()
        )

        def install(file):
            self.run_quietly(
                sys.executable, '-m', 'pip', '--disable-pip-version-check', '-q', 'install',
                '--no-deps', '--no-index', '--target', target, file,
            )  # fmt: skip

        install(wheel)
        # Third-party packages come from this interpreter; the suite must not.
        others = [sysconfig.get_path('purelib'), sysconfig.get_path('platlib'),
                  *site.getsitepackages()]  # fmt: skip
        lines = [f'import sys; sys.path.append({path!r})' for path in dict.fromkeys(others)]
        (target / 'others.pth').write_text('\n'.join(lines) + '\n')

        out, _ = python(
            """
            import pathlib
            import numpy as np
            import trl_suite
            from trl_suite import motion, suite
            from trl_suite.util import resources
            print(pathlib.Path(trl_suite.__file__).resolve())
            print(resources.directory('xml').resolve())
            print(resources.directory('mocap').resolve())
            print(len(motion.names()) + len(motion.steps_names()))
            for id_, steps in (
                ('PD_Dog2D_Slopes_Mixed_Terrain-v0', 20),
                ('MTU_Raptor2D_LLC_Imitate_Flat-v0', 20),
                ('FSM_Dog2D_Terrain_Mixed-v0', 2),
            ):
                environment = suite.make(id_, {'random': 0})
                environment.reset()
                for _ in range(steps):
                    step = environment.step(np.zeros(environment.action_spec().shape))
                assert all(np.isfinite(v).all() for v in step.observation.values())
            suite.build('goat', terrain='cliffs_rugged').reset()
            for id_ in suite.ALL_IDS:
                if '_HLC_' in id_:
                    suite.make(id_)
            """,
            inner, cwd=work,
        )  # fmt: skip
        module, xml, mocap, clips = out.split()
        installed = target.resolve() / 'trl_suite'
        self.assertEqual(pathlib.Path(module), installed / '__init__.py')
        self.assertEqual(pathlib.Path(xml), installed / 'xml')
        self.assertEqual(pathlib.Path(mocap), installed / 'mocap')
        self.assertEqual(int(clips), len(list((CHECKOUT / 'mocap').glob('*.npz'))))
        self.assertTrue((installed / 'py.typed').exists())
        self.assertTrue((installed / 'terrain' / 'presets.json').exists())
        for name, pattern in (('controllers', '*.json'), ('xml', '*.xml')):
            source = CHECKOUT / ('xml' if name == 'xml' else f'trl_suite/{name}')
            found, expected = (
                {path.name for path in each.glob(pattern)} for each in (installed / name, source)
            )
            self.assertEqual(found, expected)
        licenses = {path.name for path in target.glob('*.dist-info/licenses/*')}
        self.assertEqual(licenses, {'LICENSE', 'NOTICE'})
        self.assertFalse((target / 'tests').exists())
        self.assertFalse((installed / 'mocap' / 'recipes').exists())

        ask = f"""
            from trl_suite import policies
            try:
                print(policies.reference({TRAINED!r}).id, len(policies.available()))
            except FileNotFoundError as error:
                print(error)
        """
        self.assertIn("pip install 'trl_suite[policies]'", python(ask, inner, cwd=work)[0])
        install(*folder.glob('*.whl'))
        self.assertEqual(python(ask, inner, cwd=work)[0].strip(), f'{TRAINED} 1')

    def run_quietly(self, *command, cwd=None):
        done = subprocess.run(
            [str(each) for each in command], capture_output=True, text=True, cwd=cwd, timeout=300
        )
        self.assertEqual(done.returncode, 0, done.stdout + done.stderr)
