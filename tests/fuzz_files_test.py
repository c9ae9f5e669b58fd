"""Files from strangers: whatever is done to a valid file, it is read, or refused by name.

Hypothesis changes valid files of every format. The fast tests always make the same changes; the slow ones
(`-m slow`) draw a seed, print it, and take it from FUZZ_SEED if that is set; FUZZ_EXAMPLES says how many.
"""

import dataclasses
import io
import json
import os
import pathlib
import random
import re
import tempfile
import warnings

import hypothesis
import imageio.v3 as iio
import numpy as np
import own_clip_test
import own_test
import policies_test
import pytest
from absl.testing import absltest, parameterized
from dm_control import mjcf
from hypothesis import strategies as st

from trl_suite import characters, motion, policies, retargeting, sequences, terrain

FAST = 30  # changed files of each format
SLOW = int(os.environ.get('FUZZ_EXAMPLES', '2000'))
COMMON = {
    'deadline': None, 'database': None, 'suppress_health_check': list(hypothesis.HealthCheck),
}  # fmt: skip
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
    numbers = value.dtype.kind in 'iuf'
    how = draw(st.sampled_from(('drop', 'type', 'shape', 'value', 'empty')))
    if how == 'drop':
        del fields[name]
    elif how == 'type':
        fields[name] = value.astype(draw(st.sampled_from(('U9', 'f4', '?')))) if numbers else 7
    elif how == 'shape':
        shape = draw(st.sampled_from(((*value.shape, 1), (-1,), (1, *value.shape))))
        fields[name] = value.reshape(shape)
    elif how == 'value' and numbers and value.size:
        value = value.copy()
        place = draw(st.integers(0, value.size - 1))
        word = draw(
            st.sampled_from(
                (
                    0,
                    1,
                    2,
                    100,
                    *((np.nan, np.inf, -1, 1e30, 1e308))[: 5 * (value.dtype.kind == 'f')],
                )
            )
        )
        with np.errstate(over='ignore'):
            value.flat[place] = word
        fields[name] = value
    else:
        fields[name] = value[:0] if value.ndim else np.zeros(0)
    content = io.BytesIO()
    np.savez_compressed(content, **fields)
    return content.getvalue()


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
    if path.suffix == '.png':
        made = terrain.from_image(path, 0.5)
    else:
        made = terrain.from_mesh(path, 0.5)
    heights = terrain.SpatialGround(made, 0).height(np.linspace(-5, 5, 50), 0.0)
    np.testing.assert_array_equal(np.isfinite(heights), True)


def result():
    """The result of a sequence of two environments."""
    scores, ids = (
        [[0.5, 0.25], [0.25, 0.75]],
        ['PD_Dog2D_Flat_Terrain-v0', 'PD_Dog2D_Gaps_Terrain-v0'],
    )
    found = {
        'format': sequences.results.FORMAT, 'trl_suite': '0', 'learner': 'a:B', 'sequence': 'mine',
        'ids': ids, 'budget': 9, 'episodes': 2, 'seed': 0, 'initial': [0.1, 0.2], 'scores': scores,
        'samples': [[9, 0], [0, 9]], 'seconds': [1.0, 2.0],
        'curves': 2 * [[None] * sequences.stage.POINTS],
        'metrics': sequences.metrics(scores, [0.1, 0.2]),
    }  # fmt: skip
    return {**found, 'digest': sequences.results.digest(found)}


def files(folder):
    """Valid files by format: their bytes, suffix, and how they are read."""
    figure = own_clip_test.Figure('biped3d_mocap', motion.load('biped3d_mocap_walk'), 4)
    bvh, asf, amc = (folder / f'valid.{suffix}' for suffix in ('bvh', 'asf', 'amc'))
    own_clip_test.write_bvh(figure, bvh)
    own_clip_test.write_acclaim(figure, asf, amc)
    walk = motion.load('biped2d_walk')
    motion.write_terrainrl(walk, folder / 'walk.txt')
    walk.save(folder / 'walk.npz')
    steps = motion.load_steps('biped3d_mocap')
    few = {name: getattr(steps, name)[:3] for name in ('poses', 'labels', 'previous', 'features')}
    dataclasses.replace(steps, **few).save(folder / 'steps.npz')
    policies.save(policies_test.make_convolving(), folder / 'policy.npz')
    frame = [0.1, 0, 0.9, 0, 1, 0, 0, 0]
    for size in motion.HUMANOID3D.values():
        frame += [0] if size == 1 else [1, 0, 0, 0]
    deepmimic = {
        'Loop': 'wrap',
        'CycleSyncRootRot': True,
        'Frames': [frame, [*frame[:1], 0.5, *frame[2:]]],
    }
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

    def check(self, name, settings):
        whole, suffix, read = self.files[name]
        path = self.folder / f'changed.{suffix}'
        path.write_bytes(whole)
        read(path)
        make = changed_archive if suffix == 'npz' else changed

        @settings
        @hypothesis.given(make(whole))
        def run(content):
            path.write_bytes(content)
            try:
                read(path)
            except ValueError as error:
                # A skeleton and its motion may not fit each other: then the motion is named.
                self.assertRegex(str(error), rf'{path.name}|valid\.amc')

        run()

    @parameterized.parameters(*FORMATS)
    def test_changed_files(self, name):
        self.check(name, hypothesis.settings(max_examples=FAST, derandomize=True, **COMMON))

    @parameterized.parameters(*FORMATS)
    @pytest.mark.slow
    def test_many_changed_files(self, name):
        seed = int(os.environ.get('FUZZ_SEED', random.SystemRandom().randrange(2**32)))
        print(f'FUZZ_SEED={seed}', flush=True)
        settings = hypothesis.settings(max_examples=SLOW, **COMMON)
        self.check(name, lambda test: hypothesis.seed(seed)(settings(test)))


if __name__ == '__main__':
    absltest.main()
