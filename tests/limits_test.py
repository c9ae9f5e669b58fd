"""What would take all memory, or for ever, is refused by name before it begins."""

import contextlib
import dataclasses
import fractions
import json
import math
import os
import resource
import shutil
import signal
import struct
import sys
import time
import tracemalloc
import zipfile
from unittest import mock

import imageio.v3 as iio
import numpy as np
import pytest
from absl.testing import parameterized
from helpers import FolderTest, assert_refused
from PIL import Image

from trl_suite import (
    characters,
    evaluation,
    motion,
    policies,
    rendering,
    retargeting,
    sequences,
    suite,
    terrain,
)
from trl_suite.actuation import strength_curves
from trl_suite.util import archive, files, limited
from trl_suite.vector import VectorEnvironment

IDS = (
    'PD_Biped2D_Gaps_Terrain-v0', 'PD_Biped3D_Imitate-v0', 'FSM_Dog2D_Terrain_Slopes-v0',
)  # fmt: skip
READERS = (
    ('a.json', lambda path: motion.read_terrainrl(path, ('hip',), (1,), 'planar')),
    ('a.json', motion.read_deepmimic), ('a.bvh', motion.read_bvh),
    ('a.amc', lambda path: motion.read_amc(path, path)),
    ('a.npz', motion.load), ('a.npz', motion.load_steps), ('a.npz', policies.load),
    ('a.json', lambda path: terrain.load(str(path))), ('a.json', sequences.read),
    ('a.json', lambda path: strength_curves.load(path, characters.CHARACTERS['dog'])),
    *((f'a{suffix}', terrain.from_mesh) for suffix in terrain.mesh.READ),
    *((f'a{suffix}', lambda path: terrain.from_image(path, 1)) for suffix in terrain.custom.IMAGES),
)  # fmt: skip
ABORTED = signal.strsignal(signal.SIGABRT)
ACCESSOR = {'bufferView': 0, 'componentType': 5126, 'count': 3, 'type': 'VEC3'}
PRIMITIVE = {'attributes': {'POSITION': 0}}


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


class LimitsTest(FolderTest):
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

    @parameterized.parameters(
        *((lambda v, name=name: suite.make(IDS[0], {name: v}), name) for name in (
            'action_scale', 'terrain_level', 'start_phase', 'start_noise', 'time_limit', 'step_limit',
            'substeps', 'face_length',
        )),
        (lambda v: suite.make(IDS[0], {'start_phase': [[0, v]]}), 'start_phase'),
        (lambda v: suite.make(IDS[0], {'sensors': {'noise': v}}), 'noise'),
        (lambda v: suite.make(IDS[0], {'actuators': {'torque_pose': {'right_hip': {
            'angle': [0, v], 'positive': [1, 1], 'negative': [1, 1]}}}}), 'torque_pose'),
        (lambda v: terrain.load('gaps').parameters(v), 'terrain_level'),
        (lambda v: terrain.from_heights(np.zeros((3, 3)), v), 'spacing'),
        (lambda v: terrain.from_heights([[v, v], [v, v]], 0.1), 'heights'),
        (lambda v: terrain.from_function(np.sin, 'sine', start_span=v), 'start_span'),
        (lambda v: terrain.mesh.to_mesh(terrain.PlanarGround(terrain.load('gaps'), 0), v), 'low'),
        (lambda v: characters.Joint(v, 1, 1), 'kp'),
        (lambda v: dataclasses.replace(motion.load('dog_bound'), times=[0, v]), 'times'),
        (lambda v: rendering.Video('a.gif', v), 'fps'),
        (lambda v: sequences.forgetting([[v, 1], [1, 1]]), 'scores'),
    )  # fmt: skip
    def test_numbers_that_are_too_large_for_a_float(self, make, name):
        for value in (10**400, fractions.Fraction(10**400)):
            with self.assertRaisesRegex(ValueError, name):
                make(value)

    @parameterized.parameters(
        ('pipe.npz', ValueError, 'expected a regular file'),
        (f'{"x" * 250}.npz', OSError, 'too long'),
        ('no/a.npz', OSError, 'does not exist'),
        ('a\0.npz', ValueError, 'null'),
    )
    def test_a_name_that_cannot_be_written(self, name, error, message):
        """It is refused before the work whose result it is to hold."""
        os.mkfifo(self.folder / 'pipe.npz')
        with self.assertRaisesRegex(error, message):
            files.check_path(self.folder / name, ('.npz',))
        self.assertEqual(files.check_path(self.folder / 'a.npz', ('.npz',)).name, 'a.npz')
        self.assertLen([*self.folder.iterdir()], 1)

    def test_values_of_another_kind(self):
        function = {'a': (1, np.sum)}
        assert_refused(
            self,
            *((lambda v=v: terrain.from_heights(np.zeros((3, 3)), 1, first=v), r'heights: first is')
              for v in ('a', 0.5, [0, np.nan], (0, 'a'), (0, 0, 0))),
            (lambda: terrain.from_heights(np.zeros(3), 1, start_span=-1), 'start_span is -1'),
            (lambda: terrain.from_function(np.sin, 'sine', start_span='1'), 'start_span is .1.'),
            *((lambda v=v: characters.Joint(1, 1, 1, original_range=v), 'original_range of a joint is')
              for v in ((1, 2, 3), (3,), (2, 1), '01')),
            *((lambda v=v: characters.Joint(1, 1, 1, v), 'target of a joint')
              for v in ((1, 2), [[1, 2, 3]], 'a')),
            (lambda: motion.read_deepmimic('run.json', joints=('a',)), 'given together'),
            (lambda: evaluation._seeds(2, np.array([1, -2])), 'seed is -2'),
            (lambda: rendering.film_strip([np.zeros((2, 2, 3), np.uint8)], columns='3'), 'columns is'),
            (lambda: suite.make(IDS[0], {'rewards': {1: function['a']}}), 'a name in rewards is 1'),
            (lambda: suite.make(IDS[0], {'observations': {'a': (True, np.sum)}}), "size of observation 'a'"),
            (lambda: policies.reference(IDS[0], 3), 'known: generalist, randomized'),
        )  # fmt: skip

    def assert_refused_unread(self, message, load, path):
        tracemalloc.start()
        with self.assertRaisesRegex(ValueError, message):
            load(path)
        most = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        self.assertLess(most, 5e6)

    def test_an_archive_that_inflates(self):
        path = self.folder / 'bomb.npz'
        with (
            zipfile.ZipFile(path, 'w', zipfile.ZIP_DEFLATED) as archive,
            archive.open('poses.npy', 'w') as file,
        ):
            for _ in range(300):
                file.write(bytes(10**6))
        self.assertLess(path.stat().st_size, 10**6)
        message = r'bomb.npz: .*has 300 MB; expected no more than {}'
        for load, most in (motion.load, 268), (motion.load_steps, 268), (policies.load, 67):
            self.assert_refused_unread(message.format(most), load, path)

    def test_a_picture_of_too_many_pixels(self):
        path = self.folder / 'a.png'
        iio.imwrite(path, np.zeros((4000, 2600), np.uint8))
        message = '4000 x 2600 pixels; expected 2 or more .* no more than 1e'
        self.assert_refused_unread(message, lambda path: terrain.from_image(path, 0.1), path)

    @parameterized.parameters(*READERS, ('a.txt', lambda path: retargeting.read(path, 'dog')))
    def test_a_file_that_is_too_large(self, name, load):
        path = self.folder / name
        with path.open('wb') as file:
            file.write(b'{"Loop": true}' if name == 'a.txt' else b'')  # which tells the format
            file.truncate(3 * 10**9)  # takes no room on the disk
        with self.assertRaisesRegex(ValueError, f'{name}: .*has 3000 MB'):
            load(path)

    @parameterized.parameters(*READERS)
    def test_what_is_not_a_regular_file(self, name, load):
        """Opening a pipe would wait for another process; a device has no end."""
        paths = [self.folder / kind / name for kind in ('pipe', 'device', 'folder')]
        for path in paths:
            path.parent.mkdir()
        os.mkfifo(paths[0])
        paths[1].symlink_to('/dev/zero')
        paths[2].mkdir()
        for path in paths:
            with self.assertRaisesRegex(ValueError, f'{name}: .*expected a regular file'):
                load(path)

    @parameterized.parameters(
        ({'accessors': [{'componentType': 5126, 'count': 10**9, 'type': 'VEC3'}]}, 'numbers'),
        ({'accessors': [{**ACCESSOR, 'count': -(10**9)}]}, 'numbers'),
        ({'bufferViews': [{'buffer': 0, 'byteLength': 2**30}]}, 'numbers'),
        ({'meshes': [{'primitives': 10_000 * [PRIMITIVE]}]}, '5000 meshes'),
        ({'meshes': [{'primitives': 500 * [PRIMITIVE]}], 'nodes': [
            {'children': [1] * 500}, {'mesh': 0}]}, '5000 meshes'),
        ({'nodes': [*({'children': [i + 1] * 2} for i in range(90)), {'mesh': 0}]}, '5000 meshes'),
        ({'nodes': [*({'children': [i + 1]} for i in range(3000)), {'mesh': 0}]}, '5000 meshes'),
        ({'nodes': [{'children': [0]}]}, '5000 meshes'),
        ({'accessors': [ACCESSOR, {'componentType': 5125, 'count': 10**7, 'type': 'SCALAR'}]},
         'expected a bufferView'),
        ({'buffers': [{'uri': '../up.bin'}]}, 'up.bin. is not in the folder'),
        ({'buffers': [{'uri': '/dev/zero'}]}, 'zero. is not in the folder'),
        ({'buffers': [{'uri': 'http://localhost:1/a'}]}, 'is not in the folder'),
        ({'buffers': [{'uri': '%2e%2e/up.bin'}]}, 'is not in the folder'),
        ({'buffers': [{'uri': 'zero'}]}, 'expected a regular file'),
        ({'buffers': [{'uri': 'long.bin'}]}, 'long.bin: has 3000 MB'),
    )  # fmt: skip
    def test_a_scene_that_is_larger_than_its_file(self, changes, message):
        corners = np.array([[-9, 0, -9], [9, 0, -9], [0, 0, 9]], '<f4').tobytes()
        (self.folder / 'a b.bin').write_bytes(corners)
        (self.folder / 'zero').symlink_to('/dev/zero')
        with (self.folder / 'long.bin').open('wb') as file:
            file.truncate(3 * 10**9)
        scene = {
            'asset': {'version': '2.0'}, 'buffers': [{'uri': 'a%20b.bin', 'byteLength': 36}],
            'bufferViews': [{'buffer': 0, 'byteLength': 36}], 'accessors': [ACCESSOR],
            'meshes': [{'primitives': [PRIMITIVE]}], 'nodes': [{'mesh': 0}],
            'scenes': [{'nodes': [0]}],
        }  # fmt: skip
        path = self.folder / 'a.gltf'
        path.write_text(json.dumps(scene))
        terrain.from_mesh(path)
        path.write_text(json.dumps({**scene, **changes}))
        with self.assertRaisesRegex(ValueError, f'a.gltf: .*{message}'):
            terrain.from_mesh(path)

    @parameterized.parameters(
        ('a.obj', ''.join(f'usemtl m{i}\nf 1 2 3\n' for i in range(20_000)).encode(), ''),
        ('a.ply', b'ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\n'
         b'property float z\nelement edge 1\nproperty int vertex1\nproperty int vertex2\n'
         b'end_header\n0 0 0\n1 0 0\n0 1 0\n0 100000000\n',
         "expected the elements vertex and face, not 'edge'"),
        ('a.stl', b'solid\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendsolid\n' * 20_000, '5000 solids'),
        ('a.stl', bytes(80) + struct.pack('<I', 10**5) + 10**5 * (
            bytes(12) + struct.pack('<9fH', -99, -99, 0, 99, -99, 0, 0, 99, 0, 0)
        ), 'cover 9.*e.11 points in all'),
    )  # fmt: skip
    def test_a_mesh_that_takes_for_ever(self, name, content, message):
        corners = b'v -1 -1 0\nv 1 -1 0\nv 0 1 0\n' if name == 'a.obj' else b''
        (self.folder / name).write_bytes(corners + content)
        begin = time.perf_counter()
        if message:
            with self.assertRaisesRegex(ValueError, f'{name}: .*{message}'):
                terrain.from_mesh(self.folder / name, 0.066)
        else:
            terrain.from_mesh(self.folder / name)
        self.assertLess(time.perf_counter() - begin, 10)  # minutes otherwise

    @parameterized.parameters(((10**10,), '<U0'), ((10**9, 0), '<f8'), ((10**12,), '|S0'))
    def test_arrays_without_content(self, shape, kind):
        """They take no memory, but lists of their elements do."""
        path = self.folder / 'a.npz'
        header = {'descr': kind, 'fortran_order': False, 'shape': shape}
        with zipfile.ZipFile(path, 'w') as entries, entries.open('joints.npy', 'w') as file:
            np.lib.format.write_array_header_1_0(file, header)
        with self.assertRaisesRegex(ValueError, "field 'joints': has shape .* without content"):
            archive.arrays(path, 'clip')

    def test_frames_that_name_few_of_many_bones(self):
        names = [f'b{i}' for i in range(1500)]
        bones = ''.join(f'begin\nname {name}\ndirection 1 0 0\nlength 1\nend\n' for name in names)
        (self.folder / 'a.asf').write_text(
            f':root\norder TX TY TZ\n:bonedata\n{bones}:hierarchy\nroot {" ".join(names)}\n'
        )
        (self.folder / 'a.amc').write_text(''.join(f'{i}\nroot 0 0 0\n' for i in range(15000)))
        with self.assertRaisesRegex(ValueError, 'a.amc: 15000 frames of 1501 bones'):
            motion.read_amc(self.folder / 'a.amc', self.folder / 'a.asf')

    def test_of_an_animated_picture_the_first_frame_is_read(self):
        """The number of frames would be no bound of their size."""
        low, high = (Image.fromarray(np.full((5, 5), grey, np.uint8)) for grey in (0, 255))
        low.save(self.folder / 'a.png', save_all=True, append_images=[high, high])
        ground = terrain.SpatialGround(terrain.from_image(self.folder / 'a.png', 0.1), 0)
        self.assertEqual(float(ground.height(0, 0)), 0.0)

    @parameterized.parameters('replicate', 'attach_attached', 'doubling', 'keys', 'endless', 'pipe')
    def test_character_files(self, name):
        self.check_character_file(name)

    @parameterized.parameters(
        (os.abort, (), f'reading it failed: {ABORTED}; expected what can be read in'),
        (os._exit, (3,), 'reading it failed: status 3; expected'),
        (math.sqrt, (-1,), 'math domain error|expected a nonnegative'),
        (math.factorial, ('1',), 'TypeError: .*; expected what can be read'),
    )  # fmt: skip
    def test_functions_that_fail(self, function, arguments, message):
        with self.assertRaisesRegex(ValueError, message):
            limited.call(function, *arguments)

    def test_a_process_that_does_not_start(self):
        with (
            mock.patch.object(sys, 'executable', shutil.which('false')),
            self.assertRaisesRegex(RuntimeError, "process of '.*false' does not start: status 1"),
        ):
            limited.call(math.sqrt, 4)

    def check_character_file(self, name):
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
        # An interactive session imports from the working folder, '', first.
        for places in (sys.path, ['', *sys.path]):
            with contextlib.chdir(self.folder), mock.patch.object(sys, 'path', places):
                self.assertEqual(characters.from_file('m.xml').links, ('trunk', 'leg'))

    def test_a_long_chain_of_files_is_read(self):
        for file, text in chain(1500, 1).items():
            (self.folder / file).write_text(text)
        self.assertEqual(characters.from_file(self.folder / 'm.xml').links, ('trunk', 'leg'))


@pytest.mark.slow
class AllFilesTest(FolderTest):
    @parameterized.parameters(*FILES)
    def test_character_files(self, name):
        LimitsTest.check_character_file(self, name)
