"""What would take all memory, or for ever, is refused by name before it begins."""

import contextlib
import os
import pathlib
import resource
import sys
import tempfile
import tracemalloc
import zipfile
from unittest import mock

import imageio.v3 as iio
import numpy as np
from absl.testing import absltest, parameterized
from PIL import Image

from trl_suite import characters, motion, policies, rendering, retargeting, suite, terrain
from trl_suite.util import limited
from trl_suite.vector import VectorEnvironment

IDS = (
    'PD_Biped2D_Gaps_Terrain-v0', 'PD_Biped3D_Imitate-v0', 'FSM_Dog2D_Terrain_Slopes-v0',
)  # fmt: skip


def model(first='', world='', trunk=''):
    return (
        f'<mujoco>{first}<worldbody>{world}<body name="trunk" pos="0 0 1"><freejoint/><geom size=".1"/>{trunk}'
        '<body name="leg"><joint axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 -.5" size=".05"/></body></body>'
        '</worldbody></mujoco>'
    )


def asset(text):
    return model(f'<asset>{text}</asset>')


def replicated(count, inside='<geom size=".1"/>'):
    return f'<replicate count="{count}" offset="0 0 1">{inside}</replicate>'


def chain(length, copies):
    """Files that include each other, the next one `copies` times by other spellings of its name."""
    files = {
        'm.xml': model('<include file="i0.xml"/>'),
        f'i{length}.xml': '<mujoco><option/></mujoco>',
    }
    for i in range(length):
        inside = ''.join(f'<include file="{"./" * k}i{i + 1}.xml"/>' for k in range(copies))
        files[f'i{i}.xml'] = f'<mujoco>{inside}</mujoco>'
    return files


def attached(levels, copies):
    """Models that attach each other, the next one `copies` times."""
    files = {f'a{levels}.xml': model()}
    for i in range(levels):
        copied = ''.join(f'<attach model="a" body="trunk" prefix="p{k}"/>' for k in range(copies))
        first = f'<asset><model name="a" file="a{i + 1}.xml"/></asset>'
        files[f'a{i}.xml'] = model(first, trunk=f'<body name="b{i}">{copied}</body>')
    return {**files, 'm.xml': files['a0.xml']}


CABLE = """<composite type="cable" curve="l 0 0" count="20000000 1 1" size="1">
<geom type="capsule" size=".01"/></composite>"""
FILES = {  # character files that ask for more than any computer has, and the files that they need
    'replicate': {'m.xml': model(world=replicated('+2000000'))},
    'nested': {'m.xml': model(world=replicated(300, replicated(300, replicated(300))))},
    'attach': attached(1, 20_000), 'attach_attached': attached(5, 12),
    'attach_itself': {'m.xml': asset('<model name="a" file="m.xml"/>')}, 'doubling': chain(30, 2),
    'composite': {'m.xml': model(trunk=CABLE)},
    'flexcomp': {
        'm.xml': model(trunk='<flexcomp name="f" type="grid" count="900 900 9" spacing="1 1 1" dim="3"/>'),
    },
    'size': {'m.xml': model('<size nuser_geom="2000000000"/>')}, 'keys': {'m.xml': model('<size nkey="200000000"/>')},
    'hfield': {'m.xml': asset('<hfield name="h" nrow="60000" ncol="60000" size="1 1 1 1"/>')},
    'texture': {'m.xml': asset('<texture name="t" type="2d" builtin="flat" width="90000" height="90000"/>')},
    'mesh': {'m.xml': asset('<mesh name="m" builtin="supersphere" params="99999 1 1"/>')},
    'endless': {'m.xml': asset('<mesh name="m" file="endless.stl"/>')},
    'pipe': {'m.xml': asset('<mesh name="m" file="pipe.stl"/>')},
}  # fmt: skip


class LimitsTest(parameterized.TestCase):
    def setUp(self):
        super().setUp()
        self.folder = pathlib.Path(self.enterContext(tempfile.TemporaryDirectory()))

    @parameterized.parameters(
        *((lambda id_=id_, **options: suite.make(id_, options), 'substeps') for id_ in IDS),
        (lambda **options: suite.build('dog', task='walk', task_kwargs=options), 'substeps'),
        (lambda **options: suite.make(IDS[0], options), 'terrain_observation'),
        (lambda **options: VectorEnvironment(IDS[0], **options), 'num_envs'),
        (lambda **options: rendering.plot_terrain('gaps', 'a.png', **options), 'draws'),
    )  # fmt: skip
    def test_numbers(self, make, name):
        for value in (10**9, 2**32, 1e300, float('inf')):
            with self.assertRaisesRegex(ValueError, rf'^{name} is .*; expected a (whole )?number'):
                make(**{name: value})

    @parameterized.parameters(motion.load, motion.load_steps, policies.load)
    def test_an_archive_that_inflates(self, load):
        path = self.folder / 'bomb.npz'
        with (
            zipfile.ZipFile(path, 'w', zipfile.ZIP_DEFLATED) as archive,
            archive.open('poses.npy', 'w') as file,
        ):
            for _ in range(300):
                file.write(bytes(10**6))
        self.assertLess(path.stat().st_size, 10**6)
        tracemalloc.start()
        with self.assertRaisesRegex(
            ValueError, r'bomb.npz: .*has 300 MB; expected no more than 268'
        ):
            load(path)
        most = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        self.assertLess(most, 5e6)

    @parameterized.parameters(
        ('a.json', lambda path: motion.read_terrainrl(path, ('hip',), (1,), 'planar'), 268),
        ('a.bvh', lambda path: motion.read_bvh(path), 268),
        ('a.stl', lambda path: terrain.from_mesh(path), 1000),
        ('a.npz', lambda path: policies.load(path), 268),
    )
    def test_a_file_that_is_too_large(self, name, load, most):
        path = self.folder / name
        with path.open('wb') as file:
            file.truncate(3 * 10**9)  # takes no room on the disk
        with self.assertRaisesRegex(ValueError, f'{name}: .*has 3000 MB; .* more than {most} MB'):
            load(path)

    def test_the_format_is_told_by_the_beginning(self):
        path = self.folder / 'a.txt'
        with path.open('wb') as file:
            file.write(b'{"Loop": true}')
            file.truncate(3 * 10**9)
        with self.assertRaisesRegex(ValueError, 'a.txt: has 3000 MB'):
            retargeting.read(path, 'dog')

    def test_a_picture_of_too_many_pixels(self):
        path = self.folder / 'a.png'
        iio.imwrite(path, np.zeros((4000, 2600), np.uint8))
        tracemalloc.start()
        with self.assertRaisesRegex(ValueError, '4000 x 2600 pixels; expected no more than 1e'):
            terrain.from_image(path, 0.1)
        most = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        self.assertLess(most, 5e6)  # it was not read

    def test_of_an_animated_picture_the_first_frame_is_read(self):
        """The number of frames would be no bound of their size."""
        low, high = (Image.fromarray(np.full((5, 5), grey, np.uint8)) for grey in (0, 255))
        low.save(self.folder / 'a.png', save_all=True, append_images=[high, high])
        ground = terrain.SpatialGround(terrain.from_image(self.folder / 'a.png', 0.1), 0)
        self.assertEqual(float(ground.height(0, 0)), 0.0)

    @parameterized.parameters(*FILES)
    def test_character_files(self, name):
        path = self.folder / 'm.xml'
        for file, text in FILES[name].items():
            (self.folder / file).write_text(text)
        os.mkfifo(self.folder / 'pipe.stl')
        (self.folder / 'endless.stl').symlink_to('/dev/zero')
        own, before = map(resource.getrusage, (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
        with (
            mock.patch.multiple(limited, SECONDS=1, WAIT=5.0 if name == 'pipe' else 60.0),
            self.assertRaisesRegex(ValueError, f'^{path}: .*; expected|{path}: .*Error'),
        ):
            characters.from_file(path)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        self.assertLess(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, 5)
        if sys.platform == 'linux':  # a child begins with the memory of its parent, in kB
            self.assertLessEqual(after.ru_maxrss, max(own.ru_maxrss, before.ru_maxrss, 2.5e6))

    def test_no_module_beside_a_character_file_is_run(self):
        for module in ('pickle', 'resource', 'numpy', 'mujoco'):
            (self.folder / f'{module}.py').write_text('raise SystemExit("was run")')
        (self.folder / 'm.xml').write_text(model())
        with contextlib.chdir(self.folder):
            self.assertEqual(characters.from_file('m.xml').links, ('trunk', 'leg'))

    def test_a_long_chain_of_files_is_read(self):
        for file, text in chain(1500, 1).items():
            (self.folder / file).write_text(text)
        self.assertEqual(characters.from_file(self.folder / 'm.xml').links, ('trunk', 'leg'))


if __name__ == '__main__':
    absltest.main()
