"""Clips and their readers: sampling against analytic motions, files and refusals."""

import dataclasses
import functools
import io
import json
import os

import numpy as np
from absl.testing import absltest, parameterized
from helpers import FolderTest, assert_refused, write_terrainrl
from scipy.spatial.transform import Rotation

from trl_suite import motion
from trl_suite.motion import quaternion

PERIOD = 0.8


def wxyz(rotation):
    return np.roll(rotation.as_quat(), 1, axis=-1)


def planar(loop=True, n=9, speed=2.0, climb=0.5):
    """x and z advance steadily, pitch is zero, two hinges are sine and cosine of the cycle."""
    times = np.linspace(0, PERIOD, n)
    angle = 2 * np.pi * times / PERIOD
    poses = np.stack([speed * times, 1 + climb * times, 0 * times, np.sin(angle), np.cos(angle)], 1)
    return motion.Clip('planar', times, poses, 'planar', ('right', 'left'), (1, 1), loop)


def free(loop=True, rate=(0.3, -0.4, 1.2), n=33):
    """The root and a ball joint turn at a constant rate about a fixed axis; a hinge stands."""
    times = np.linspace(0, PERIOD, n)
    turn = wxyz(Rotation.from_rotvec(np.outer(times, rate)))
    poses = np.column_stack([times, -times, 1 + 0 * times, turn, turn, 0.7 + 0 * times])
    return motion.Clip('free', times, poses, 'free', ('ball', 'hinge'), (4, 1), loop)


def circle(turn=0.9, radius=2.0, n=41):
    """Walks a part of a circle to the left, climbing; the root rolls, a ball joint swings."""
    times = np.linspace(0, PERIOD, n)
    share = times / PERIOD
    heading = 0.4 + turn * share
    x, y = radius * np.sin(heading), -radius * np.cos(heading)
    roll = 0.2 * np.sin(2 * np.pi * share)
    root = wxyz(Rotation.from_euler('ZX', np.stack([heading, roll], axis=1)))
    ball = wxyz(Rotation.from_rotvec(np.outer(np.sin(2 * np.pi * share), (0.3, 0.1, 0.2))))
    poses = np.column_stack([x, y, 1 + 0.1 * share, root, ball])
    return motion.Clip(
        'circle', times, poses, 'free', ('right_hip',), (4,), loop=True, turning=True
    )


def steps(n=7):
    """Two steps: the root advances, the right hip and knee move, the left ones stand."""
    times = np.linspace(0, 0.5, n)
    poses = []
    for speed, rate in ((1.0, 0.3), (2.0, 0.6)):
        turn = wxyz(Rotation.from_rotvec(np.outer(times, (0, 0.2, rate))))
        still = np.tile((1.0, 0, 0, 0), (n, 1))
        poses.append(
            np.column_stack(
                [speed * times, 0.1 * times, 1 + 0 * times, turn, turn, times, still, 0 * times]
            )
        )
    return motion.FootstepLibrary(
        'steps',
        times,
        np.array(poses),
        ('right_hip', 'right_knee', 'left_hip', 'left_knee'),
        (4, 1, 4, 1),
        labels=[(0.5, 0.15, 0.1), (1.0, 0.2, -0.3)],
        previous=[(0.5, 0.15, 0.0)] * 2,
        features=np.arange(14.0).reshape(2, 7),
        description='two',
    )


class SamplingTest(parameterized.TestCase):
    def test_passes_through_the_key_frames(self):
        for clip in (planar(loop=False), free(loop=False)):
            np.testing.assert_allclose(clip.pose(clip.times), clip.poses, atol=1e-12)

    def test_linear_between_uneven_frames(self):
        clip = motion.Clip('c', [0, 0.1, 0.5], [[0, 1, 0], [1, 1, 2], [5, 3, 0]], 'planar', (), ())
        np.testing.assert_allclose(clip.pose(0.2), (2, 1.5, 1.5))

    def test_any_shape_of_times(self):
        clip = free()
        for shape in ((), (3,), (2, 5), (0,)):
            self.assertEqual(clip.pose(np.zeros(shape)).shape, (*shape, 12))
            self.assertEqual(clip.velocity(np.zeros(shape)).shape, (*shape, 10))

    @parameterized.parameters(-3, -1, 0, 1, 7)
    def test_displacement_accumulates_height_included(self, cycles):
        clip = planar()
        t = 0.3 * PERIOD
        there = clip.pose(t + cycles * PERIOD) - clip.pose(t)
        np.testing.assert_allclose(there[:2], cycles * np.array([1.6, 0.4]), atol=1e-9)
        np.testing.assert_allclose(there[2:], 0, atol=1e-9)

    @parameterized.parameters(0.9, -2.5, 1e-5, 1e-12)
    def test_heading_accumulates_if_turning(self, turn):
        clip = circle(turn)
        self.assertAlmostEqual(clip.heading_change, turn)
        cycles = np.array([-3, -1, 0, 1, 2, 7])
        t = 0.3 * PERIOD
        found, first = clip.pose(t + cycles * PERIOD), clip.pose(t)
        heading = quaternion.heading(first[3:7]) + cycles * turn
        gap = quaternion.heading(found[:, 3:7]) - heading
        np.testing.assert_allclose(np.exp(1j * gap), 1, atol=1e-9)
        # Stays on the circle, except for linear interpolation between frames; the climb accumulates.
        np.testing.assert_allclose(np.hypot(found[:, 0], found[:, 1]), 2, atol=5e-3)
        np.testing.assert_allclose(found[:, 2], 1.03 + 0.1 * cycles, atol=1e-9)
        np.testing.assert_allclose(found[:, 7:], [first[7:]] * 6, atol=1e-12)
        # Each cycle is the one before it, moved.
        for axis in (0, 1):
            expected = quaternion.rotate_xy(np.tile(first[:2], (6, 1)), cycles * turn)[:, axis]
            np.testing.assert_allclose(found[:, axis], expected, atol=1e-6)

    @parameterized.parameters(0.9, -2.5)
    def test_turning_is_smooth_over_the_seams(self, turn):
        clip = circle(turn)
        t = np.linspace(-2 * PERIOD, 2 * PERIOD, 401)
        velocity = clip.velocity(t)
        ways = np.hypot(velocity[:, 0], velocity[:, 1])
        np.testing.assert_allclose(ways, 2 * abs(turn) / PERIOD, rtol=2e-3)
        at = clip.velocity([0.0, PERIOD, -3 * PERIOD])
        np.testing.assert_allclose(at[:, 2:], [at[0, 2:]] * 3, atol=1e-9)

    def test_somersault_continues_to_rotate(self):
        times = np.linspace(0, 1, 11)
        poses = np.stack([times, 1 + 0 * times, -2 * np.pi * times], axis=1)
        clip = motion.Clip('flip', times, poses, 'planar', (), (), True)
        np.testing.assert_allclose(clip.pose([-0.5, 1.25])[:, 2], (np.pi, -2.5 * np.pi))
        np.testing.assert_allclose(clip.velocity(1.0), (1, 0, -2 * np.pi))

    def test_a_clip_without_loop_holds_its_ends(self):
        clip = planar(loop=False)
        np.testing.assert_allclose(clip.pose([-1, 9]), clip.poses[[0, -1]], atol=1e-12)
        np.testing.assert_array_equal(clip.velocity([-0.1, 0.9]), np.zeros((2, 5)))

    def test_velocity_of_a_sine(self):
        clip = planar(n=801)
        t = np.linspace(-PERIOD, 2 * PERIOD, 97)
        w = 2 * np.pi / PERIOD
        velocity = clip.velocity(t)
        np.testing.assert_allclose(velocity[:, 3], w * np.cos(w * t), atol=0.03)
        np.testing.assert_allclose(velocity[:, 4], -w * np.sin(w * t), atol=0.03)
        np.testing.assert_allclose(velocity[:, :3], [[2, 0.5, 0]] * 97, atol=1e-9)

    def test_angular_velocity_is_in_body_axes(self):
        # Turned by a first rotation, then spinning about a fixed world axis.
        first, rate = Rotation.from_euler('z', 90, degrees=True), np.array([1.5, 0, 0])
        times = np.linspace(0, PERIOD, 9)
        turn = wxyz(Rotation.from_rotvec(np.outer(times, rate)) * first)
        poses = np.column_stack([np.zeros((9, 3)), turn])
        clip = motion.Clip('spin', times, poses, 'free', (), ())
        np.testing.assert_allclose(clip.velocity(0.4)[3:], (0, -1.5, 0), atol=1e-9)

    def test_slerp_turns_at_a_constant_rate(self):
        clip = free(n=3, loop=False)
        t = np.linspace(0.05, PERIOD - 0.05, 20)
        expected = wxyz(Rotation.from_rotvec(np.outer(t, (0.3, -0.4, 1.2))))
        np.testing.assert_allclose(clip.pose(t)[:, 3:7], expected, atol=1e-12)
        np.testing.assert_allclose(clip.velocity(t)[:, 6:9], [(0.3, -0.4, 1.2)] * 20, atol=1e-9)

    def test_slerp_takes_the_shorter_arc(self):
        clip = free(n=3, loop=False)
        poses = clip.poses.copy()
        poses[1, 3:7] *= -1
        other = dataclasses.replace(clip, poses=poses)
        t = np.linspace(0, PERIOD, 11)
        rotation = Rotation.from_quat(np.roll(clip.pose(t)[:, 3:7], -1, axis=1))
        changed = Rotation.from_quat(np.roll(other.pose(t)[:, 3:7], -1, axis=1))
        np.testing.assert_allclose((rotation.inv() * changed).magnitude(), 0, atol=1e-9)

    def test_figures(self):
        clip, still = planar(), planar(loop=False)
        np.testing.assert_allclose(still.velocity([0, PERIOD])[:, :2], [[2, 0.5]] * 2)
        np.testing.assert_allclose(clip.displacement, (1.6, 0.4))
        self.assertAlmostEqual(clip.duration, PERIOD)
        self.assertAlmostEqual(clip.speed, 2.0)
        self.assertAlmostEqual(free().speed, np.sqrt(2))  # horizontal, x and y
        np.testing.assert_allclose(free().pose(PERIOD + 0.1)[3:7], free().pose(0.1)[3:7])
        self.assertAlmostEqual(circle(2 * np.pi - 0.5).heading_change, -0.5)  # the smaller angle
        self.assertEqual(clip.heading_change, 0)


class MirrorTest(absltest.TestCase):
    def test_free_root_is_reflected_in_the_sagittal_plane(self):
        clip, mirror = free(), np.diag([1, -1, 1])
        mirrored = clip.mirrored([])
        np.testing.assert_allclose(mirrored.poses[:, :3], clip.poses[:, :3] @ mirror)
        for first in (3, 7):
            turn = [
                Rotation.from_quat(np.roll(c.poses[:, first : first + 4], -1, axis=1)).as_matrix()
                for c in (clip, mirrored)
            ]
            np.testing.assert_allclose(turn[1], mirror @ turn[0] @ mirror, atol=1e-12)

    def test_by_name(self):
        clip = planar()
        with self.assertRaisesRegex(ValueError, 'expected each joint once'):
            clip.mirrored([('right', 'left'), ('left', 'right')])
        swapped = clip.mirrored([('right', 'left')]).poses
        np.testing.assert_array_equal(swapped, clip.poses[:, [0, 1, 2, 4, 3]])
        clip = steps().clip(0)
        pairs = [('right_hip', 'left_hip'), ('right_knee', 'left_knee')]
        mirrored = clip.mirrored().poses
        np.testing.assert_array_equal(mirrored, clip.mirrored(pairs).poses)
        np.testing.assert_array_equal(mirrored[:, 7:11], [(1, 0, 0, 0)] * 7)
        np.testing.assert_array_equal(mirrored[:, 16], clip.poses[:, 11])

    def test_mirrored_clips_are_mirrored_at_all_times(self):
        for clip in (planar(), free(), circle(), steps().clip(1)):
            t = np.linspace(-0.4, 0.4, 21)
            pairs = [('right', 'left')] if clip.root == 'planar' else None
            mirror = motion.Mirror(clip.layout, pairs) if pairs else clip.layout.mirror
            (pose, rate), mirrored = clip.state(t), clip.mirrored(pairs)
            np.testing.assert_allclose(mirror.velocity(rate), mirrored.velocity(t), atol=1e-9)
            np.testing.assert_allclose(mirror.pose(pose), mirrored.pose(t), atol=1e-9)
            self.assertAlmostEqual(mirrored.heading_change, -clip.heading_change)


REFUSED = (  # of the clip `planar`
    ({'times': [0], 'poses': np.zeros((1, 5))}, r'times: has shape \(1,\); expected 2 or more'),
    ({'times': np.linspace(0.1, 1, 9)}, 'times: must start at 0'),
    ({'times': [0, 0, *range(1, 8)]}, 'times: .* increase by at least 1e-06 s'),
    ({'times': [0, 1e-320, *range(1, 8)]}, 'times: .* increase by at least 1e-06 s'),
    ({'times': [*range(8), np.inf]}, r'times: inf at \[8\]; .* finite numbers of at most 1e\+06'),
    ({'poses': np.zeros((9, 4))}, r'poses: has shape \(9, 4\); expected \(9, 5\)'), ({'poses': np.zeros(9)}, 'poses: has shape'),
    ({'poses': [[1, 2], [3]]}, 'poses: expected an array of numbers'),
    ({'poses': np.full((9, 5), np.nan)}, r'poses: nan at \[0, 0\]; expected finite'),
    ({'root': 'plnar'}, "root: unknown root 'plnar'.*'planar'"), ({'sizes': (1, 3)}, 'sizes'),
    ({'sizes': (1,)}, 'sizes: 1 for 2 joints'), ({'joints': ('left', 'left')}, 'joints: a name occurs twice'),
    ({'turning': True}, 'turning: a planar root'),
)  # fmt: skip
REFUSED_STEPS = (
    ({'poses': np.zeros((0, 7, 17))}, 'poses: has shape .* expected .k, n, d.'),
    ({'poses': np.zeros((7, 17))}, 'poses: has shape .* expected .k, n, d.'),
    ({'labels': np.zeros((2, 2))}, r'labels: has shape \(2, 2\); expected \(2, 3\)'),
    ({'previous': np.full((2, 3), np.nan)}, r'previous: nan at \[0, 0\]; expected finite'),
    ({'features': [['a'] * 7] * 2}, 'features: expected an array of numbers'),
    ({'left_poses': np.zeros((2, 7, 16))}, r'left_poses: has shape \(2, 7, 16\); expected \(2, 7, 17\)'),
)  # fmt: skip


class ConstructionTest(parameterized.TestCase):
    def test_refused(self):
        changed = functools.partial(functools.partial, dataclasses.replace)
        longer = free().poses.copy()
        longer[2, 7:11] *= 1.1
        assert_refused(
            self,
            *((changed(planar(), **c), f"clip 'planar', {message}") for c, message in REFUSED),
            *((changed(steps(), **c), f"steps 'steps', {message}") for c, message in REFUSED_STEPS),
            (changed(steps(), sizes=(4, 1, 4, 2)), r"clip 'steps\[0\]', sizes"),
            (changed(free(), poses=longer), 'column 7 of frame 2 has length 1.1'),
            (lambda: planar().mirrored([('rihgt', 'left')]), "unknown joint 'rihgt'.*'right'"),
            (lambda: free().mirrored([('ball', 'hinge')]), 'differ in kind'),
            (lambda: motion.load('biped2d_wlak'), "unknown clip 'biped2d_wlak'.*'biped2d_walk'"),
            (lambda: motion.load('biped3d_mocap_steps'), 'unknown clip'),
            *(
                (functools.partial(each.save, name), f"unknown suffix '{suffix}'; expected .npz")
                for each in (planar(), steps())
                for name, suffix in (('walk', ''), ('walk.txt', '.txt'))
            ),
            (lambda: motion.load_steps('biped3d'), "step library 'biped3d'.*'biped3d_mocap'"),
        )

    def test_keeps_a_read_only_copy(self):
        poses = planar().poses.copy()
        clip = dataclasses.replace(planar(), poses=poses)
        poses[:] = 0
        self.assertEqual(clip.poses[0, 1], 1)
        for array in (clip.poses[0], steps().poses[0, 0]):
            with self.assertRaises(ValueError):
                array[0] = 1


class FileTest(FolderTest):
    @parameterized.parameters(
        planar,
        free,
        circle,
        lambda: motion.Clip('c', [0, 1], [[0, 1, 0], [1, 1, 0]], 'planar', (), ()),
    )
    def test_round_trip(self, make):
        path = self.folder / 'clip.npz'
        (self.folder / 'other').mkdir()
        clip = dataclasses.replace(make(), name='clip', description='Größe')
        clip.save(path)
        clip.save(self.folder / 'other' / 'clip.NPZ')
        for found in map(motion.load, (path, str(path), f'{self.folder}/other/clip.NPZ')):
            for field in dataclasses.fields(clip):
                np.testing.assert_array_equal(
                    getattr(found, field.name), getattr(clip, field.name), field.name
                )
        self.assertEqual({*os.listdir(self.folder)}, {'clip.npz', 'other'})

    def test_truncated_or_damaged_files_are_rejected(self):
        path, single = self.folder / 'bad.npz', io.BytesIO()
        with self.assertRaises(FileNotFoundError):
            motion.load(path)
        planar().save(path)
        whole = path.read_bytes()
        np.save(single, np.zeros(3))
        parts = whole[:-30], whole[: len(whole) // 2], b'', b'once upon a time', b'PK\x03\x04 only'
        for content in (*parts, single.getvalue()):
            path.write_bytes(content)
            with self.assertRaisesRegex(ValueError, 'bad.npz'):
                motion.load(path)
        for at in range(0, len(whole), 7):
            path.write_bytes(whole[:at] + bytes([whole[at] ^ 0xFF]) + whole[at + 1 :])
            try:  # a byte that no reader needs may have any value
                found = motion.load(path)
            except ValueError as error:
                self.assertIn('bad.npz', str(error))
            else:
                for field in dataclasses.fields(found):
                    if field.name != 'name':  # that of the file
                        np.testing.assert_array_equal(
                            getattr(found, field.name), getattr(planar(), field.name), field.name
                        )

    def test_malformed_fields(self):
        path, bad = self.folder / 'clip.npz', self.folder / 'bad.npz'
        planar().save(path)
        with np.load(path) as archive:
            fields = dict(archive)
        for field, value, message in (
            ('times', None, "'times': is missing"), ('loop', None, "'loop': is missing"),
            ('joints', np.array(['a', 1], dtype=object), "'joints'"), ('loop', np.array('yes'), "'loop': has type"),
            ('root', np.array(['planar']), "'root': has type"), ('sizes', np.array([1.0, 1.0]), "'sizes': has type"),
            ('times', np.arange(9.0) + 1, 'times: must start at 0'),
            ('poses', np.array(['a', 'b']), "'poses': has type <U1 and 1 axes"),
        ):  # fmt: skip
            changed = {**fields, field: value}
            np.savez(bad, **{name: each for name, each in changed.items() if each is not None})
            assert_refused(self, (lambda: motion.load(bad), f'bad.npz: .*{message}'))
        del fields['turning']  # as in older files
        np.savez(bad, **fields)
        self.assertFalse(motion.load(bad).turning)


class StepsTest(FolderTest):
    """Libraries of made-up steps; the shipped ones are tested with the clips."""

    @parameterized.parameters(False, True)
    def test_each_query_has_its_own_step_time_and_side(self, one_sided):
        library = steps()
        if one_sided:  # the walker turns the other way about and stretches its knee
            library = dataclasses.replace(library, left_poses=library.poses[::-1])
        index, t = np.array([0, 1, 1, 0]), np.array([0.1, 0.2, 0.5, 0.0])
        mirrored = np.array([False, True, False, True])
        pose = library.pose(index, t, mirrored)
        velocity = library.velocity(index, t, mirrored)
        self.assertEqual((pose.shape, velocity.shape), ((4, 17), (4, 14)))
        for env_id in range(4):
            clip = library.clip(index[env_id], mirrored[env_id])
            np.testing.assert_allclose(pose[env_id], clip.pose(t[env_id]), atol=1e-12)
            np.testing.assert_allclose(velocity[env_id], clip.velocity(t[env_id]), atol=1e-9)
        self.assertEqual(library.pose(0, np.zeros((2, 3))).shape, (2, 3, 17))
        self.assertEqual(library.pose(1, 0.1, [True, False]).shape, (2, 17))
        self.assertEqual(library.velocity(1, 0.1).shape, (14,))
        self.assertEqual(library.velocity(1, 0.1, [True, False]).shape, (2, 14))
        left = library.pose(0, 0.5, True)
        self.assertAlmostEqual(left[0], 1.0 if one_sided else 0.5)

    def test_holds_its_ends(self):
        library = steps()
        found = library.pose([0, 0], [-1, 9])
        np.testing.assert_allclose(found, library.poses[0, [0, -1]], atol=1e-12)
        self.assertAlmostEqual(library.velocity(0, 9)[0], 1.0)

    def test_figures(self):
        library = steps()
        self.assertLen(library, 2)
        self.assertEqual(library.duration, 0.5)

    def test_features(self):
        # A walker that faces +y, at (1, 2), right foot 0.1 m to its right and 0.2 m ahead.
        root, heading = np.array([[1.0, 2.0]]), np.array([np.pi / 2])
        right, left = np.array([[1.1, 2.2]]), np.array([[0.9, 1.7]])
        target, planned = np.array([[0.95, 2.7]]), np.array([np.pi / 2 + 0.3])
        feet = (0.2, -0.1, -0.3, 0.1)
        found = motion.step_features(root, heading, right, left, target, planned, np.array([True]))
        np.testing.assert_allclose(found, [(*feet, 0.5, 0.15, 0.3)], atol=1e-12)
        # In left stance what lies to the right takes the place of the left.
        found = motion.step_features(root, heading, right, left, target, planned, np.array([False]))
        np.testing.assert_allclose(found, [(-0.3, -0.1, 0.2, 0.1, 1.0, 0.05, -0.3)], atol=1e-12)

    def test_heading_is_the_smaller_angle(self):
        place = np.zeros((2, 2))
        found = motion.step_features(
            place, np.array([3.0, -3.0]), place, place, place, np.array([-3.0, 9.0]),
            np.array([True, True]),
        )  # fmt: skip
        np.testing.assert_allclose(found[:, 6], (2 * np.pi - 6, 12 - 4 * np.pi))

    def test_selects_the_nearest(self):
        library = steps()
        query = np.zeros((3, 7))
        query[1:] = library.features[1]
        query[2, :4] = -100  # nearer to the feet at the start of the other clip
        for weights, expected in (((0,) * 4 + (1,) * 3, 1), (np.ones(7), 0)):
            np.testing.assert_array_equal(library.select(query, weights), (0, 1, expected))
        np.testing.assert_array_equal(library.select(query), (0, 1, 0))

    def test_round_trip(self):
        path = self.folder / 'steps_steps.npz'
        one_sided = dataclasses.replace(steps(), left_poses=steps().poses[::-1])
        for library, given in ((one_sided, path), (steps(), path), (steps(), str(path))):
            library.save(path)
            found = motion.load_steps(given)
            for field in dataclasses.fields(library):
                np.testing.assert_array_equal(
                    getattr(found, field.name), getattr(library, field.name), field.name
                )
        with self.assertRaisesRegex(ValueError, "'root': is missing"):
            motion.load(path)
        planar().save(path)
        with self.assertRaisesRegex(ValueError, "steps_steps.npz: field 'labels': is missing"):
            motion.load_steps(path)


class ReaderTest(FolderTest):
    def setUp(self):
        super().setUp()
        self.path = self.folder / 'walk.txt'

    def write(self, frames, **fields):
        self.path.write_text(json.dumps({'Frames': frames} | fields))

    @parameterized.product(make=(planar, free), loop=(True, False))
    def test_round_trip(self, make, loop):
        clip = make(loop=loop)
        write_terrainrl(clip, self.path)
        found = motion.read_terrainrl(self.path, clip.joints, clip.sizes, clip.root)
        np.testing.assert_allclose(found.times, clip.times, atol=1e-12)
        np.testing.assert_allclose(found.poses, clip.poses, atol=1e-12)
        self.assertEqual(found.loop, loop)
        self.assertEqual(found.name, 'walk')

    def test_a_file_of_the_original_form(self):
        # Tabs and blank lines; pitch +90 deg about z (up turns back), then past 180 with the
        # quaternion's sign inverted; hinge signs are kept.
        half = np.sqrt(0.5)
        self.path.write_text(
            '{\n\t"Loop": true,\n\n"Frames":\t[\n'
            f'[0.1, 1, 2, 0, {half}, 0, 0, {half}, -0.3],\n\n'
            f'[0.2, 1.5, 2.5, 0, {half}, 0, 0, {-half}, 0.4],\t[9, 2, 3, 0, 2, 0, 0, 2, 0.5]]}}'
        )
        clip = motion.read_terrainrl(self.path, ['knee'], [1], 'planar')
        np.testing.assert_allclose(clip.times, (0, 0.1, 0.3))
        np.testing.assert_allclose(
            clip.poses[:, [0, 1, 3]], [(1, 2, -0.3), (1.5, 2.5, 0.4), (2, 3, 0.5)]
        )
        # 90 to -90 to 90: half turns are ambiguous, but none is more than half a turn.
        self.assertAlmostEqual(clip.poses[0, 2], np.pi / 2)
        self.assertLessEqual(np.abs(np.diff(clip.poses[:, 2])).max(), np.pi + 1e-9)

    def test_a_file_of_the_predecessor(self):
        """Its frames lie under `Motion`, and its root is planar: x, y and an angle."""
        frames = [[0.1, 1, 2, 3.0, -0.3], [0.2, 1.5, 2.5, 3.5, 0.4], [9, 2, 3, 7.0, 0.5]]
        content = {'Motion': {'Loop': True, 'Frames': frames}}
        self.path.write_text(json.dumps(content))
        clip = motion.read_terrainrl(self.path, ['knee'], [1], 'planar')
        np.testing.assert_allclose(clip.times, (0, 0.1, 0.3))
        expected = np.array(frames)[:, 1:]
        expected[2, 2] -= 2 * np.pi  # frames tell directions, not turns
        np.testing.assert_allclose(clip.poses, expected)
        self.assertTrue(clip.loop)
        for row, root, message in (
            (frames[1], 'free', 'a motion in the plane; expected a planar'),
            ([0.1, 1, 2, None, 0], 'planar', 'frame 1, root angle: None'),
            ([0.1, 1, 2, 0, 'a'], 'planar', "frame 1, column 4: 'a'"),
            ([0.1, 1, 2, 0], 'planar', 'frame 1 has 4 numbers'),
        ):
            content['Motion']['Frames'] = [frames[0], row]
            self.path.write_text(json.dumps(content))
            with self.assertRaisesRegex(ValueError, f'walk.txt: {message}'):
                motion.read_terrainrl(self.path, ['knee'], [1], root)

    def test_planar_pitch_is_continuous(self):
        pitch = np.linspace(0.5, 12, 30)
        signs = np.where(np.arange(30) % 3, 1, -1)  # a quaternion and its negative are the same
        frames = [
            [0.1, 0, 1, 0, s * np.cos(p / 2), 0, 0, s * np.sin(p / 2)]
            for p, s in zip(pitch, signs, strict=True)
        ]
        self.write(frames)
        clip = motion.read_terrainrl(self.path, (), (), 'planar')
        np.testing.assert_allclose(clip.poses[:, 2], pitch, atol=1e-9)

    def test_rotates_the_frame(self):
        # Up is y and right is z in the file: yaw about its y is yaw about z here, and so on.
        turn = Rotation.from_rotvec([0.1, 0.2, 0.3])
        frame = [0.1, 1, 2, 3, *3 * wxyz(turn), *wxyz(turn)]  # also if they are not normalised
        self.write([frame, frame])
        clip = motion.read_terrainrl(self.path, ['ball'], [4], 'free')
        np.testing.assert_allclose(clip.poses[0, :3], (1, -3, 2))
        expected = wxyz(Rotation.from_rotvec([0.1, -0.3, 0.2]))
        np.testing.assert_allclose(clip.poses[0, 3:7], expected)
        np.testing.assert_allclose(clip.poses[0, 7:11], expected)

    def deepmimic(self, **fields):
        self.write(
            [[0.1, 5, 1, 7, 1, 0, 0, 0], [0.3, 6, 1.1, 7, 1, 0, 0, 0], [0, 9, 1.4, 8, 1, 0, 0, 0]],
            **fields,
        )
        return motion.read_deepmimic(self.path, (), ())

    def test_deepmimic(self):
        clip = self.deepmimic(Loop='none', CycleSyncRootPos=False)
        self.assertFalse(clip.loop)
        # It starts over the origin, and keeps its height over cycles.
        np.testing.assert_allclose(clip.poses[:, :3], [(0, 0, 1), (1, 0, 1.1), (4, -1, 1.4)])
        fields = {'Loop': 'wrap', 'RightJoints': [3], 'LeftJoints': [9], 'VelFilterCutoff': 6}
        np.testing.assert_allclose(self.deepmimic(**fields).displacement, (4, -1, 0), atol=1e-12)
        climbing = self.deepmimic(Loop='wrap', CycleSyncRootHeight=True)
        np.testing.assert_allclose(climbing.displacement, (4, -1, 0.4))
        self.assertFalse(self.deepmimic(Loop='wrap').turning)
        self.assertTrue(self.deepmimic(Loop='wrap', CycleSyncRootRot=True).turning)
        self.assertFalse(self.deepmimic(Loop='none', CycleSyncRootRot=True).turning)
        assert_refused(self, *((lambda f=f: self.deepmimic(Loop='wrap', **f), f'walk.txt: {message}') for f, message in (
            ({'CycleSyncRootRot': 1}, 'CycleSyncRootRot is 1; expected True or False'),
            ({'CycleSyncRootPos': False}, 'CycleSyncRootPos is False; expected True'))))  # fmt: skip
        wrong = functools.partial(self.deepmimic, Loop=True)
        assert_refused(self, (wrong, "walk.txt: Loop is True; expected 'wrap' or 'none'"))

    GOOD = (0.1, 0, 1, 0, 1, 0, 0, 0, 0.2)

    def read(self, content):
        text = json.dumps(content) if isinstance(content, dict) else content
        self.path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return motion.read_terrainrl(self.path, ['knee'], [1], 'planar')

    def test_malformed(self):
        good = self.GOOD
        frames = (
            (3, 'Frames: an array'), ([good], 'Frames: at least 2 are needed, found 1'), ([good, 3], 'frame 1: an array'),
            ([good, good, good[:-1]], 'frame 2 has 8 numbers, frame 0 has 9'), ([good[:5]] * 2, 'frame 0 has 5 numbers'),
            ([(*good, 1)] * 2, 'frame 0 has 10 .* needs 9'), ([good, (*good[:8], 'a')], "frame 1, column 8: 'a'"),
            ([good, (None, *good[1:])], 'frame 1, duration: None'),
            ([good, (0.1, True, *good[2:])], 'frame 1, root position: True'),
            ([good, (*good[:4], np.nan, 0, 0, 1, 0)], 'frame 1, root quaternion: nan'),
            ([good, (*good[:8], np.inf)], 'frame 1, column 8: inf'), ([good, (*good[:8], 10**400)], 'frame 1, column 8'),
            ([good, (0, *good[1:]), good], 'frame 1, duration: 0 s'),
            ([good, (1e-30, *good[1:]), good], 'frame 1, duration: 1e-30 s; .* 1e-06 s'),
            ([(-0.1, *good[1:]), good], 'frame 0, duration: -0.1 s'),
            ([good, (*good[:4], 0, 0, 0, 0, 0)], 'frame 1, root quaternion: .*zero'),
            ([good, (*good[:3], 0.1, 1, 0, 0, 0, 0)], 'frame 1, root position'),
            ([good, (*good[:5], 0.2, 0, 0, 0)], 'frame 1, root quaternion'),
        )  # fmt: skip
        others = (
            ({}, 'Frames: an array'), ({'Frames': [good] * 2, 'Loop': 'wrap'}, "Loop is 'wrap'; expected True or False"),
            ('', ''), ('[1, 2', ''), ('{"Frames": [}', ''), ('[]', ''), ('\ufeff', ''),
            (b'\xff\xfe\x00\x01', 'not text in UTF-8: .* at byte 0'),
        )  # fmt: skip
        deep = (0.1, 0, 1, 0, 0.2, 0.3)
        others += (
            ({'Motion': {'Frames': [deep] * 2}}, 'frame 0 has 6 numbers; expected 5, for 1 joints'),
        )
        for content, message in (*(({'Frames': f}, message) for f, message in frames), *others):
            assert_refused(self, (lambda c=content: self.read(c), f'walk.txt: {message}'))
        ball = (*good[:8], 0.3, 1, 0, 0, 0)
        self.write([ball, (*ball[:9], 0, 0, 0, 0)])
        with self.assertRaisesRegex(ValueError, "frame 1, joint 'ball': the quaternion is zero"):
            motion.read_terrainrl(self.path, ['knee', 'ball'], [1, 4], 'planar')

    def test_last_duration_is_ignored(self):
        good = list(self.GOOD)
        for last in (0, -1, 9):
            clip = self.read({'Frames': [good, good, [last, *good[1:]]]})
            self.assertAlmostEqual(clip.duration, 0.2)
