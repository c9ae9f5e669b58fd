"""Files from strangers: whatever is in a file, it is read, or refused by name.

Hypothesis changes valid files of every format, and writes pictures and meshes with any header, numbers
and references to other files, which must not be opened. The tests that draw (`-m slow`) print their seed, and
take it from FUZZ_SEED if that is set; FUZZ_EXAMPLES says how many files.
"""

import base64
import dataclasses
import io
import json
import os
import pathlib
import random
import re
import struct
import sys
import tempfile
import warnings
import zlib

import hypothesis
import imageio.v3 as iio
import numpy as np
import own_clip_test
import own_test
import policies_test
import pytest
from absl.testing import parameterized
from dm_control import mjcf
from helpers import write_terrainrl
from hypothesis import strategies as st

from trl_suite import characters, motion, policies, retargeting, sequences, terrain
from trl_suite.runs import results, stage

EXAMPLES = int(os.environ.get('FUZZ_EXAMPLES', '2000'))
WORDS = (
    b'nan', b'inf', b'-inf', b'NaN', b'Infinity', b'0', b'-1', b'1e-320', b'1e30', b'1e308', b'1e400',
    b'9' * 30, b'', b'"', b'{', b'}', b'[]', b'{}', b'null', b'true', b'<', b'/>', b'\n', b'\0', b'\xff',
    b'../x', b'begin', b'end', b'root',
)  # fmt: skip


@st.composite
def changed(draw, whole):
    """A few changes of bytes or of words."""
    data = bytes(whole)
    for _ in range(draw(st.integers(1, 3))):
        how = draw(st.sampled_from(('word', 'word', 'word', 'copy', 'drop', 'bit', 'cut')))
        if how == 'word':
            words = [match.span() for match in re.finditer(rb'[\w.+-]+', data)]
            if words:
                begin, end = draw(st.sampled_from(words))
                data = data[:begin] + draw(st.sampled_from(WORDS)) + data[end:]
            continue
        place = draw(st.integers(0, len(data)))
        end = min(len(data), place + draw(st.integers(1, 40)))
        if how == 'copy':
            data = data[:end] + data[place:]
        elif how == 'drop':
            data = data[:place] + data[end:]
        elif how == 'cut':
            data = data[:place]
        elif place < len(data):
            bit = 1 << draw(st.integers(0, 7))
            data = data[:place] + bytes([data[place] ^ bit]) + data[place + 1 :]
    return data


@st.composite
def changed_archive(draw, whole):
    """Changes of bytes, or of an array in a valid archive."""
    if draw(st.booleans()):
        return draw(changed(whole))
    with np.load(io.BytesIO(whole), allow_pickle=False) as archive:
        fields = dict(archive)
    name = draw(st.sampled_from(sorted(fields)))
    value = fields[name]
    how = draw(st.sampled_from(('drop', 'type', 'shape', 'value', 'empty')))
    if how == 'drop':
        del fields[name]
    elif how == 'type':
        kind = draw(st.sampled_from(('U9', 'f4', '?')))
        fields[name] = value.astype(kind) if value.dtype.kind in 'iuf' else 7
    elif how == 'shape':
        shape = draw(st.sampled_from(((*value.shape, 1), (-1,), (1, *value.shape))))
        fields[name] = value.reshape(shape)
    elif how == 'value' and value.dtype.kind in 'iuf' and value.size:
        value = value.copy()
        numbers = (0, 1, 2, 100)
        if value.dtype.kind == 'f':
            numbers += (np.nan, np.inf, -1, 1e30, 1e308)
        with np.errstate(over='ignore'):
            value.flat[draw(st.integers(0, value.size - 1))] = draw(st.sampled_from(numbers))
        fields[name] = value
    else:
        fields[name] = value[:0] if value.ndim else np.zeros(0)
    content = io.BytesIO()
    np.savez_compressed(content, **fields)
    return content.getvalue()


SIZES = (0, 1, 2, 3, 4, 8, 16, 255, 2**15, 65535, 2**16, 2**24, 2**31 - 1, 2**31, 2**32 - 1)
ELSEWHERE = ('/etc/hostname', '../up.bin', 'secret', 'fifo', '.', '..', 'http://localhost:1/a', '')
NUMBERS = ('0', '1', '-1', '2', '3', '1e3', '1e308', '-1e309', 'nan', '9' * 30, 'x', '')
POSTSCRIPT = b'%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n%%EndComments\nshowpage\n%%EOF\n'


def likely(good, others):
    """Mostly the first, so that some files are valid."""
    return st.one_of(st.just(good), st.just(good), st.sampled_from(others))


@st.composite
def picture(draw, suffixes=('png', 'tif', 'tiff', 'bmp', 'jpg', 'jpeg')):
    """A suffix, and a picture of any format, which may be another one."""
    size = likely(3, SIZES)
    width, height = draw(size), draw(size)
    depth, kind = draw(likely(8, SIZES)), draw(likely(0, SIZES))
    data = draw(st.one_of(st.just(bytes(40)), st.binary(max_size=60)))

    def chunk(name, content):
        check = struct.pack('>I', zlib.crc32(name + content))
        return struct.pack('>I', len(content)) + name + content + check

    def entry(tag, value):
        kind, count = draw(likely(4, (1, 2, 3, 12))), draw(likely(1, SIZES))
        return struct.pack('<HHII', tag, kind, count, value)

    head = struct.pack('>IIBBBBB', width, height, depth % 256, kind % 256, 0, 0, 0)
    png = b'\x89PNG\r\n\x1a\n' + chunk(b'IHDR', head)
    png += chunk(b'IDAT', zlib.compress(data)) + chunk(b'IEND', b'')
    bmp = b'BM' + struct.pack('<IIIIiiHHIIIIII', 54, 0, 54, 40, width % 2**31, height % 2**31, 1,
                              depth % 2**16, kind, len(data), 0, 0, 0, 0) + data  # fmt: skip
    tags = ((256, width), (257, height), (258, depth), (259, draw(likely(1, (2, 5, 7, 8, 32773)))),
            (262, kind), (273, draw(likely(8, SIZES))), (278, height), (279, draw(size)))  # fmt: skip
    tiff = b'II*\0' + struct.pack('<I', 8 + len(data)) + data + struct.pack('<H', len(tags))
    tiff += b''.join(entry(*tag) for tag in tags) + bytes(4)
    jpeg = io.BytesIO()
    iio.imwrite(jpeg, np.zeros((8, 8, 3), np.uint8), extension='.jpg')
    jpeg = re.sub(
        rb'(\xff\xc0..\x08)....', lambda found: found[1] + struct.pack('>HH', height % 2**16, width % 2**16),
        jpeg.getvalue(), flags=re.DOTALL,
    )  # fmt: skip
    begins = POSTSCRIPT, b'GIF89a', b'P6 9 9 255 ', b'RIFF', b'\x00\x00\x01\x00', b''
    other = draw(st.sampled_from(begins))
    formats = {'png': png, 'bmp': bmp, 'tif': tiff, 'tiff': tiff, 'jpg': jpeg, 'jpeg': jpeg}
    suffix = draw(st.sampled_from(suffixes))
    return suffix, draw(likely(formats[suffix], (*formats.values(), other + data)))


@st.composite
def scene(draw):
    """A glTF scene that may name other files, and refer to itself."""
    data = np.array([[-9, 0, -9], [9, 0, -9], [0, 0, 9]], '<f4').tobytes()
    size, index = likely(3, (*SIZES, -1)), likely(0, (1, 2, -1, 2**31))
    inside = 'data:application/octet-stream;base64,' + base64.b64encode(data).decode()
    tree = {
        'asset': {'version': '2.0'},
        'buffers': [{'uri': draw(likely(inside, (*ELSEWHERE, 'own.bin'))), 'byteLength': 36}],
        'bufferViews': [{'buffer': draw(index), 'byteLength': draw(likely(36, SIZES))}],
        'accessors': [
            {'bufferView': draw(index), 'componentType': draw(likely(5126, (5125, 5121, 0))),
             'count': draw(size), 'type': draw(likely('VEC3', ('SCALAR', 'MAT4', 'x')))}
        ],
        'images': [{'uri': draw(st.sampled_from(ELSEWHERE))}],
        'textures': [{'source': 0}],
        'materials': [{'pbrMetallicRoughness': {'baseColorTexture': {'index': 0}}}],
        'meshes': [
            {'primitives': draw(st.integers(1, 3)) * [
                {'attributes': {'POSITION': draw(index)}, 'material': 0, 'mode': draw(likely(4, (0, 1, 5)))}
            ]}
        ],
        'nodes': [
            {'mesh': draw(index), 'children': draw(likely([1], ([], [0], [1, 1], [9])))},
            {'mesh': 0, 'scale': draw(likely([1, 1, 1], ([0, 0, 0], [1e308] * 3, [1])))},
        ],
        'scenes': [{'nodes': [draw(index)]}],
    }  # fmt: skip
    if draw(st.booleans()):
        del tree[draw(st.sampled_from(sorted(tree)))]
    return json.dumps(tree).encode()


@st.composite
def solid(draw):
    """A suffix, and a mesh of any format that may name other files."""
    number, word = likely('1', NUMBERS), st.sampled_from(ELSEWHERE)
    three = [f'{draw(number)} {draw(number)} {draw(number)}' for _ in range(3)]
    triangle = [f'{x} {y} {z}' for x, y, z in ((-9, -9, 0), (9, -9, 0), (0, 9, 1))]
    points = draw(st.one_of(st.just(triangle), st.just(three)))
    face, count = draw(likely('1/1 2/2 3/3', three)), draw(likely(3, SIZES))
    obj = [
        f'mtllib {draw(word)}',
        'usemtl a',
        *(f'v {each}' for each in points),
        'vt 0 0',
        f'f {face}',
    ]
    kind, data = draw(likely('float', ('uchar', 'x'))), draw(st.binary(max_size=40))
    head = [
        'ply', f'format {draw(likely("ascii", ("binary_little_endian", "binary_big_endian", "x")))} 1.0',
        f'comment TextureFile {draw(word)}', f'element vertex {count}',
        *(f'property {kind} {axis}' for axis in 'xyz'), f'element face {draw(likely(1, SIZES))}',
        f'property list {draw(likely("uchar", ("uint", "x")))} int vertex_indices', 'end_header',
    ]  # fmt: skip
    ply = '\n'.join([*head, *points, draw(likely('3 0 1 2', three)), '']).encode() + data
    if draw(st.booleans()):
        stl = bytes(80) + struct.pack('<I', count) + draw(likely(bytes(50), (data,)))
    else:
        vertices = [f'vertex {point}' for point in points]
        stl = '\n'.join(['solid', *vertices, 'endsolid', '']).encode()
    tree = draw(scene())
    size = draw(likely(len(tree), SIZES))
    glb = b'glTF' + struct.pack('<IIII', 2, 20 + len(tree), size, 0x4E4F534A) + tree
    lines = draw(st.one_of(st.just(obj), st.permutations(obj)))
    contents = {'obj': '\n'.join(lines).encode(), 'ply': ply, 'stl': stl, 'gltf': tree, 'glb': glb}
    suffix = draw(st.sampled_from(sorted(contents)))
    return suffix, draw(likely(contents[suffix], (*contents.values(), POSTSCRIPT)))


class Audit:
    """Collects what Python opens, starts and connects to inside the context."""

    def __init__(self):
        self.on, self.events = False, []
        sys.addaudithook(self._add)  # stays for ever

    def _add(self, event, arguments):
        if self.on and event in ('open', 'subprocess.Popen', 'os.system', 'socket.connect'):
            self.events.append((event, str(arguments[0])))

    def __enter__(self):
        self.on, self.events = True, []
        return self.events

    def __exit__(self, *error):
        self.on = False


def character(path, **options):
    """Reads a character; what is accepted can be compiled."""
    row = characters.from_file(path, **options)
    with warnings.catch_warnings():
        warnings.simplefilter('ignore')
        mjcf.Physics.from_mjcf_model(characters.make(row).mjcf_model)


def clip(path, **options):
    """Reads a motion; its numbers are finite, and can be carried over."""
    found = retargeting.read(path, options.pop('character', 'biped3d_mocap'), **options)
    if isinstance(found, motion.Capture):
        arrays = found.times, found.rest, found.positions, found.rotations
    else:
        arrays = (found.times, found.poses, *found.state(np.linspace(-1, 3, 9) * found.duration))
    for array in arrays:
        np.testing.assert_array_equal(np.isfinite(array), True)


def policy(path):
    """Reads a policy; its actions are finite."""
    found = policies.load(path)
    observation = np.random.default_rng(0).normal(0, 10, (5, found.observation_size))
    np.testing.assert_array_less(np.abs(found(observation)), 1 + 1e-9)


def ground(path):
    """Reads terrain; heights are finite."""
    found = terrain.load(path)
    draw = terrain.SpatialGround if found.spatial else terrain.PlanarGround
    made = draw(found, seed=1)
    heights = made.height(np.linspace(-5, 5, 50), 0.0) if found.spatial else made.window(0, 400)[0]
    np.testing.assert_array_equal(np.isfinite(heights), True)


def surface(path):
    """Reads a mesh or a picture; its heights are finite."""
    if path.suffix in terrain.custom.IMAGES:
        made = terrain.from_image(path, 0.5)
    else:
        made = terrain.from_mesh(path, 0.5)
    heights = terrain.SpatialGround(made, 0).height(np.linspace(-5, 5, 50), 0.0)
    np.testing.assert_array_equal(np.isfinite(heights), True)


def result():
    """The result of a sequence of two environments."""
    scores = [[0.5, 0.25], [0.25, 0.75]]
    ids = ['PD_Dog2D_Flat_Terrain-v0', 'PD_Dog2D_Gaps_Terrain-v0']
    found = {
        'format': sequences.BENCHMARK.format, 'trl_suite': '0', 'learner': 'a:B', 'sequence': 'mine',
        'ids': ids, 'budget': 9, 'episodes': 2, 'seed': 0, 'initial': [0.1, 0.2], 'scores': scores,
        'samples': [[9, 0], [0, 9]], 'seconds': [1.0, 2.0],
        'curves': 2 * [[None] * stage.POINTS],
        'metrics': sequences.metrics(scores, [0.1, 0.2]),
    }  # fmt: skip
    return {**found, 'digest': results.digest(found)}


def files(folder):
    """Valid files by format: their bytes, suffix, and how they are read."""
    figure = own_clip_test.Figure('biped3d_mocap', motion.load('biped3d_mocap_walk'), 4)
    bvh, asf, amc = (folder / f'valid.{suffix}' for suffix in ('bvh', 'asf', 'amc'))
    own_clip_test.write_bvh(figure, bvh)
    own_clip_test.write_acclaim(figure, asf, amc)
    walk = motion.load('biped2d_walk')
    write_terrainrl(walk, folder / 'walk.txt')
    walk.save(folder / 'walk.npz')
    steps = motion.load_steps('biped3d_mocap')
    few = {name: getattr(steps, name)[:3] for name in ('poses', 'labels', 'previous', 'features')}
    dataclasses.replace(steps, **few).save(folder / 'steps.npz')
    policies.save(policies_test.make_convolving(), folder / 'policy.npz')
    frame = [0.1, 0, 0.9, 0, 1, 0, 0, 0]
    for size in motion.HUMANOID3D.values():
        frame += [0] if size == 1 else [1, 0, 0, 0]
    frames = [frame, [*frame[:1], 0.5, *frame[2:]]]
    deepmimic = {'Loop': 'wrap', 'CycleSyncRootRot': True, 'Frames': frames}
    presets = pathlib.Path(terrain.__file__).parent
    grid = np.add.outer(np.linspace(-0.2, 0.3, 9), np.linspace(0, 0.2, 8))
    hill = terrain.SpatialGround(terrain.from_heights(grid, 0.5, 'hill'), 0)
    for suffix in ('stl', 'obj', 'glb'):
        terrain.save_mesh(hill, folder / f'hill.{suffix}', -1.4, 1.4)
    iio.imwrite(folder / 'hill.png', (255 * grid).astype(np.uint8))
    planar = json.loads((presets / 'presets.json').read_text())['slopes_mixed']
    spatial = json.loads((presets / 'presets3d.json').read_text())['steps3d']
    return {
        'mjcf': (own_test.MJCF.encode(), 'xml', lambda path: character(path, **own_test.PLANAR)),
        'urdf': (own_test.URDF.encode(), 'urdf', lambda path: character(path, **own_test.TWO)),
        'bvh': (bvh.read_bytes(), 'txt', clip),
        'amc': (amc.read_bytes(), 'txt', lambda path: clip(path, skeleton=asf)),
        'asf': (asf.read_bytes(), 'txt', lambda path: clip(amc, skeleton=path)),
        'terrainrl': (
            (folder / 'walk.txt').read_bytes(), 'txt', lambda path: clip(path, character='biped2d'),
        ),
        'deepmimic': (json.dumps(deepmimic).encode(), 'json', clip),
        'clip': ((folder / 'walk.npz').read_bytes(), 'npz', clip),
        'steps': ((folder / 'steps.npz').read_bytes(), 'npz', motion.load_steps),
        'policy': ((folder / 'policy.npz').read_bytes(), 'npz', policy),
        **{
            suffix: ((folder / f'hill.{suffix}').read_bytes(), suffix, surface)
            for suffix in ('stl', 'obj', 'glb', 'png')
        },
        'result': (json.dumps(result()).encode(), 'json', sequences.read),
        'planar': (json.dumps(planar).encode(), 'txt', ground),
        'spatial': (json.dumps(spatial).encode(), 'json', ground),
    }  # fmt: skip


FORMATS = (
    'mjcf', 'urdf', 'bvh', 'amc', 'asf', 'terrainrl', 'deepmimic', 'clip', 'steps', 'policy', 'stl',
    'obj', 'glb', 'png', 'result', 'planar', 'spatial',
)  # fmt: skip


class FuzzTest(parameterized.TestCase):
    @classmethod
    def setUpClass(cls):
        super().setUpClass()
        cls.folder = pathlib.Path(cls.enterClassContext(tempfile.TemporaryDirectory()))
        cls.files = files(cls.folder)

    def settings(self, test):
        seed = int(os.environ.get('FUZZ_SEED', random.SystemRandom().randrange(2**32)))
        print(f'FUZZ_SEED={seed}', flush=True)
        settings = hypothesis.settings(
            max_examples=EXAMPLES, deadline=None, database=None,
            suppress_health_check=list(hypothesis.HealthCheck),
        )  # fmt: skip
        return hypothesis.seed(seed)(settings(test))

    @parameterized.parameters(*FORMATS)
    def test_valid_files(self, name):
        whole, suffix, read = self.files[name]
        path = self.folder / f'changed.{suffix}'
        path.write_bytes(whole)
        read(path)

    @parameterized.parameters(*FORMATS)
    @pytest.mark.slow
    def test_changed_files(self, name):
        whole, suffix, read = self.files[name]
        path = self.folder / f'changed.{suffix}'
        make = changed_archive if suffix == 'npz' else changed

        @self.settings
        @hypothesis.given(make(whole))
        def run(content):
            path.write_bytes(content)
            try:
                read(path)
            except ValueError as error:
                # A skeleton and its motion may not fit each other: then the motion is named.
                self.assertRegex(str(error), rf'{path.name}|valid\.amc')

        run()

    @parameterized.parameters(picture, solid)
    @pytest.mark.slow
    def test_written_files(self, make):
        for name in ('secret', 'own.bin'):
            (self.folder / name).write_bytes(POSTSCRIPT)
        if not (self.folder / 'fifo').exists():
            os.mkfifo(self.folder / 'fifo')
        surface(self.folder / 'hill.png')  # what Pillow and trimesh import, they open before
        surface(self.folder / 'hill.obj')
        audit = Audit()

        @self.settings
        @hypothesis.given(make())
        def run(written):
            suffix, content = written
            path = self.folder / f'written.{suffix}'
            path.write_bytes(content)
            with audit as events:
                try:
                    surface(path)
                except ValueError as error:
                    self.assertIn(path.name, str(error))
            own = {('open', str(self.folder / name)) for name in (path.name, 'own.bin', 'secret')}
            own = own if suffix in ('gltf', 'glb') else {('open', str(path))}
            imported = sys.prefix, sys.base_prefix
            strange = {each for each in events if not each[1].startswith(imported)} - own
            self.assertEmpty(strange)

        run()

    @parameterized.parameters(
        *((POSTSCRIPT, suffix) for suffix in terrain.custom.IMAGES),
        (b'mtllib a.mtl\nusemtl a\nv -1 -1 0\nv 1 -1 0\nv 0 1 0\nvt 0 0\nf 1/1 2/1 3/1\n', '.obj'),
    )
    def test_nothing_starts_ghostscript(self, content, suffix):
        """Pillow recognises formats by their content, and starts another program for PostScript."""
        folder = pathlib.Path(self.enterContext(tempfile.TemporaryDirectory()))
        (folder / 'a.png').write_bytes(POSTSCRIPT)
        (folder / 'a.mtl').write_text('newmtl a\nmap_Kd a.png\n')
        (folder / f'hill{suffix}').write_bytes(content)
        with Audit() as events:
            try:
                surface(folder / f'hill{suffix}')
            except ValueError as error:
                self.assertIn(f'hill{suffix}: cannot be read as', str(error))
        mine = [name for event, name in events if event != 'open' or str(folder) in name]
        self.assertLen(mine, 1)  # the file itself
