"""Users' own motions: files in four formats, retargeted, cut to a cycle, checked."""

import contextlib
import dataclasses
import functools
import importlib.util
import io
import json
import os
import pathlib
import re
import subprocess
import sys
from unittest import mock

import numpy as np
from absl.testing import parameterized
from helpers import FolderTest, assert_refused, in_this_process, write_terrainrl
from scipy.spatial.transform import Rotation

from trl_suite import characters, motion, retargeting, suite
from trl_suite.motion import quaternion
from trl_suite.rendering.kinematic_viewer import KinematicViewer
from trl_suite.retargeting import clip_check
from trl_suite.util import limited

# From y up, z forward to the suite's frame.
FILE_AXES = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
EXAMPLES = pathlib.Path(__file__).resolve().parents[1] / 'examples'
FULL, PLAIN = 'biped3d_full_mocap', 'biped3d_mocap'
# The axes of a leg are turned: its y axis points up, its z axis to the right, (0, -1, 0).
LEG = """<body name="{0}_thigh" pos="0 {1} -.1" euler="90 0 0"><joint name="{0}_hip" axis="{2}"/>
<geom type="capsule" size=".04" fromto="0 0 0 0 -.4 0"/></body>"""

# What stands before the leg in the trunk, joints before the hip, the thigh's place in the trunk, and the
# anchors of hip and knee in thigh and shin.
STANDS = {
    'plain': ('', '', -0.1, (0, 0)),
    'a link without a joint': ('<body name="head" pos="0 0 .2"><geom size=".1"/></body>', '', -0.1, (0, 0)),
    'a body without a mass': ('<body name="mount" pos="0 0 .1">', '', -0.2, (0, 0)),
    'three joints of a body': ('', '<joint name="a" axis="1 0 0"/><joint name="b" axis="0 0 1"/>', -0.1, (0, 0)),
    'joints beside the origins': ('', '', -0.4, (0.3, 0.1)),
}  # fmt: skip


def stand(folder, before, hips, place, anchors):
    """Returns a character of one leg from a file, see `STANDS`."""
    path, (hip, knee) = folder / 'stand.xml', anchors
    after = '</body>' if before and not before.endswith('</body>') else ''
    path.write_text(
        f'<mujoco><worldbody><body name="trunk" pos="0 0 1"><freejoint/><geom size=".1"/>{before}'
        f'<body name="thigh" pos="0 0 {place}">{hips}'
        f'<joint name="right_hip" axis="0 -1 0" pos="0 0 {hip}"/><geom size=".04" fromto="0 0 {hip} 0 0 {hip - 0.4}" '
        f'type="capsule"/><body name="shin" pos="0 0 {hip - 0.4 - knee}"><joint name="right_knee" axis="0 -1 0" '
        f'pos="0 0 {knee}"/><geom type="capsule" size=".04" fromto="0 0 {knee} 0 0 {knee - 0.4}"/></body></body>{after}'
        '</body></worldbody></mujoco>'
    )
    with mock.patch.object(limited, 'call', in_this_process):
        return characters.from_file(path)


def in_file(rotation):
    """Converts a rotation to a file's frame."""
    return Rotation.from_matrix(FILE_AXES.T @ rotation.as_matrix() @ FILE_AXES)


def legs(folder, axis):
    """Returns a character of two legs from a file, with hips about an axis of the legs."""
    path = folder / 'legs.xml'
    both = LEG.format('right', -0.1, axis) + LEG.format('left', 0.1, axis)
    path.write_text(
        f'<mujoco><worldbody><body name="trunk" pos="0 0 1"><freejoint/><geom size=".1"/>{both}</body>'
        '</worldbody></mujoco>'
    )
    with mock.patch.object(limited, 'call', in_this_process):
        return characters.from_file(path)


def free(times, place, turns, **joints):
    """Returns a clip with a free root, at places (n, 3) m, with Rotations, and hinge angles (n,)."""
    quaternions = np.roll(turns.as_quat(), 1, axis=-1)
    poses = np.column_stack([place, quaternions, *joints.values()])
    return motion.Clip('free', times, poses, 'free', tuple(joints), (1,) * len(joints))


def rotations(quaternions):
    return Rotation.from_quat(np.asarray(quaternions)[:, [1, 2, 3, 0]])


class Figure:
    """What a capture of a character's own motion would hold."""

    def __init__(self, character, clip, frames, spread_arms=False):
        viewer = KinematicViewer(character)
        self.names = ('root', *viewer.layout.joints)
        self.parents = viewer.parents()
        self.offsets = viewer.places()
        self.offsets[1:] -= self.offsets[self.parents[1:]]
        self.times = np.linspace(0, clip.duration, frames)
        self.poses = clip.pose(self.times)
        turned = []
        for pose in self.poses:
            viewer.put(pose)
            turned.append(viewer.orientations())
        world = [rotations(column) for column in np.swapaxes(turned, 0, 1)]
        # Arms that point sideways at rest turn by so much less in all poses.
        self.rest = [Rotation.identity()] * len(self.names)
        if spread_arms:
            for i, name in enumerate(self.names):
                if name.endswith(('shoulder', 'elbow', 'wrist')):
                    side = 1 if name.startswith('left') else -1
                    self.rest[i] = Rotation.from_euler('x', 90 * side, degrees=True)
                    if not name.endswith('shoulder'):
                        self.offsets[i] = self.rest[i].apply(self.offsets[i])
        world = [turn * rest.inv() for turn, rest in zip(world, self.rest, strict=True)]
        self.local = [
            turn if parent < 0 else world[parent].inv() * turn
            for turn, parent in zip(world, self.parents, strict=True)
        ]

    def children(self, i):
        return [j for j, parent in enumerate(self.parents) if parent == i]


BVH_NAMES = {
    'root': 'Hips', 'torso': 'Spine1', 'neck': 'Neck', 'head': 'Head', 'hip': 'UpLeg',
    'knee': 'Leg', 'ankle': 'Foot', 'shoulder': 'Arm', 'elbow': 'ForeArm', 'wrist': 'Hand',
}  # fmt: skip


def bvh_name(name):
    side, _, part = name.rpartition('_')
    return f'{side.capitalize()}{BVH_NAMES[part]}'


def write_bvh(figure, path, order='ZXY', unit=0.01):
    lines, columns = ['HIERARCHY'], [100 * figure.poses[:, :3] @ FILE_AXES]

    def block(i, depth):
        offset = ' '.join(f'{x / unit:.6f}' for x in figure.offsets[i] @ FILE_AXES)
        kind = 'ROOT' if i == 0 else 'JOINT'
        place = 'Xposition Yposition Zposition ' if i == 0 else ''
        turns = ' '.join(f'{axis}rotation' for axis in order)
        lines.extend([
            f'{kind} {bvh_name(figure.names[i])}', '{', f'OFFSET {offset}',
            f'CHANNELS {6 if i == 0 else 3} {place}{turns}',
        ])  # fmt: skip
        columns.append(in_file(figure.local[i]).as_euler(order, degrees=True))
        for child in figure.children(i):
            block(child, depth + 1)
        if not figure.children(i):
            lines.extend(['End Site', '{', 'OFFSET 0 1 0', '}'])
        lines.append('}')

    block(0, 0)
    frames = np.concatenate(columns, axis=1)
    lines += ['MOTION', f'Frames: {len(frames)}', f'Frame Time: {figure.times[1]:.9f}']
    lines += [' '.join(f'{x:.7f}' for x in frame) for frame in frames]
    path.write_text('\n'.join(lines) + '\n')


ASF_NAMES = {'root': 'root', 'torso': 'thorax', 'hip': 'femur', 'knee': 'tibia', 'ankle': 'foot'}


def asf_name(name):
    side, _, part = name.rpartition('_')
    return f'{side[:1]}{ASF_NAMES[part]}'


def write_acclaim(figure, skeleton, path, length=0.45):
    """Bones with frames of their own; each begins where one without degrees of freedom ends."""
    random = np.random.default_rng(0)
    unit = 0.0254 / length
    bones, hierarchy = [], []
    place = figure.poses[:, :3] @ FILE_AXES / unit
    turn = in_file(figure.local[0]).as_euler('xyz', degrees=True)
    columns = {'root': np.concatenate([place, turn], axis=1)}
    for i, name in enumerate(figure.names[1:], 1):
        way = figure.offsets[i] @ FILE_AXES / unit
        far = np.linalg.norm(way)
        axis = random.uniform(-90, 90, 3)
        parent = asf_name(figure.names[figure.parents[i]])
        to, own = f'to_{asf_name(name)}', asf_name(name)
        bones += [
            'begin', f'id {2 * i}', f'name {to}', f'direction {" ".join(map(str, way / far))}',
            f'length {far}', 'axis 0 0 0 XYZ', 'end',
            'begin', f'id {2 * i + 1}', f'name {own}', 'direction 0 -1 0', 'length 0',
            f'axis {" ".join(map(str, axis))} XYZ', 'dof rx ry rz',
            'limits (-180.0 180.0)', '(-180.0 180.0)', '(-180.0 180.0)', 'end',
        ]  # fmt: skip
        hierarchy += [f'{parent} {to}', f'{to} {own}']
        frame = Rotation.from_euler('xyz', axis, degrees=True)
        columns[own] = (frame.inv() * in_file(figure.local[i]) * frame).as_euler(
            'xyz', degrees=True
        )
    skeleton.write_text('\n'.join([
        '# a comment', ':version 1.10', ':name test', ':units', 'mass 1.0', f'length {length}',
        'angle deg', ':documentation', 'none', ':root', 'order TX TY TZ RX RY RZ', 'axis XYZ',
        'position 0 0 0', 'orientation 0 0 0', ':bonedata', *bones, ':hierarchy', 'begin',
        *hierarchy, 'end', '',
    ]))  # fmt: skip
    lines = ['#!OML:ASF test.asf', ':FULLY-SPECIFIED', ':DEGREES']
    for i in range(len(figure.times)):
        lines.append(str(i + 1))
        lines += [f'{name} {" ".join(map(str, column[i]))}' for name, column in columns.items()]
    path.write_text('\n'.join(lines) + '\n')


UNUSABLE = (  # name and content of a file, message, content of a skeleton
    ('a.bvh', 'HIERARCHY\n', r'a\.bvh: ', None), ('a.bvh', '', r'a\.bvh: is empty; expected one of: BVH', None),
    ('a.bvh', '<xml/>', r'a\.bvh: not a motion file', None), ('a.json', '{', r'a\.json: not JSON', None),
    ('a.json', '{"Loop": true', r'a\.json: .*not JSON', None),
    ('a.json', f'{{"Loop": {5000 * "9"}}}', r'a\.json: .*not JSON: .*4300', None),
    ('a.json', f'{{"Frames": {2000 * "["}{2000 * "]"}}}', 'nested too deeply', None),
    ('a.amc', '1\nroot 1\n', 'needs its skeleton, an .asf file', None),
    ('a.amc', '1\n', r"a\.asf, line 2: 'order TX': expected TX, TY and TZ", ':root\norder TX\n'),
    ('a.amc', '1\n', "a.asf, line 4: 'length", ':bonedata\nbegin\nname x\nlength far\nend\n'),
    ('a.bvh', 'HIERARCHY\n', r'a skeleton \(.*a\.asf\) was given', ':root\n'),
    ('a.asf', ':root\n', r'a skeleton \(.asf\); expected the motion', None),
)  # fmt: skip
DAMAGED = (  # the last of these words in a file, what takes its place, the message
    ('a.bvh', 'OFFSET 0.000000', 'OFFSET nan', "'OFFSET nan .*'; expected OFFSET and three finite"),
    ('a.bvh', 'Frame Time: ', 'Frame Time: inf ', 'Frame Time is inf; expected a positive'),
    ('a.bvh', 'CHANNELS 3 Zrotation Xrotation Yrotation', 'CHANNELS 0', 'without channels are not'),
    ('a.bvh', 'MOTION', 'MOTON', 'no line MOTION'), ('a.bvh', 'Frame Time: ', 'Frame Time: -', 'frame_time must be >= 0'),
    ('a.bvh', 'Frame Time: ', 'Frame Time: 1e-320 ', 'too large, or Frame Time is too small'),
    ('a.asf', 'begin\nid 2', 'id 2', "'id 2': expected 'begin' before it"),
    ('a.asf', 'angle deg', 'angle grad', "'angle grad': expected 'deg' or 'rad'"),
    ('a.asf', 'length 0.45', 'length 0', "'length 0': expected a positive number"),
    ('a.asf', 'length 0.45', 'length nan', "'length nan': expected a positive number"),
    ('a.asf', 'direction 0 -1 0', 'direction 0 inf 0', 'expected three finite numbers'),
    ('a.asf', 'direction 0 -1 0', 'direction', 'expected three finite numbers'),
    ('a.asf', 'direction 0 -1 0\n', '', "'end': the bone has no direction"),
    ('a.asf', 'XYZ\ndof', 'XYX\ndof', 'expected an order of axes, such as XYZ'),
    ('a.asf', 'dof rx ry rz', 'dof rx rw rz', "unknown degree of freedom 'rw'; known: l, rx"),
    ('a.asf', 'dof rx ry rz', 'dof rx rx rz', 'given twice'), ('a.asf', 'name thorax', 'name root', "'name root': the name is taken"),
    ('a.asf', '\nend\n', '\nthorax to_thorax\nend\n', "'to_thorax' has a parent already"),
    ('a.asf', '\nend\n', '\nthorax tooth\nend\n', "unknown bone 'tooth'"),
    ('a.asf', 'root to_thorax', 'thorax to_thorax', "'thorax to_thorax': a bone whose parent is"),
    ('a.asf', '\nend\n', '\nthorax root\nend\n', "'root' has a parent already"),
    ('a.amc', '\n1\n', '\n', 'line 4: .*expected the number of a frame'),
    ('a.amc', 'thorax', 'throax', "unknown bone 'throax'; did you mean"),
    ('a.amc', 'root ', 'root nan ', r'line \d+: .*7 numbers; expected 6'),
    ('a.amc', 'root -?[0-9.]+', 'root nan', r'line \d+: .*expected finite numbers'),
    ('a.amc', 'root ', 'rfoot ', r'line \d+: .*6 numbers; expected 3'), ('a.amc', '(.|\n)+', '', '0 frames; expected at least 2'),
    *((name, 'o', '\xff', 'not text in UTF-8') for name in ('a.bvh', 'a.asf', 'a.amc')),
)  # fmt: skip


class ClipTest(FolderTest):
    def assert_same_poses(self, clip, expected, places=1e-5):
        """Also the same rotations, of which quaternions have two."""
        self.assertEqual(clip.poses.shape, expected.shape)
        change = clip.layout.change(clip.poses, expected)
        np.testing.assert_allclose(change, 0, atol=places)


class ReadingTest(ClipTest):
    @parameterized.parameters('ZXY', 'XYZ', 'ZYX')
    def test_bvh_round_trip(self, order):
        """A shipped walk, arms at rest sideways, in centimetres, y up."""
        figure = Figure(FULL, motion.load('biped3d_full_walk'), 31, spread_arms=True)
        write_bvh(figure, self.folder / 'walk.bvh', order)
        capture = retargeting.read(self.folder / 'walk.bvh', FULL)
        self.assertEqual(capture.joints[:2], ('Hips', 'Spine1'))
        np.testing.assert_allclose(capture.positions, figure.poses[:, :3], atol=1e-6)
        clip = retargeting.retarget(capture, FULL)
        self.assertEqual((clip.name, clip.loop), ('walk', False))
        self.assertAlmostEqual(clip.duration, figure.times[-1], places=5)
        # Its feet touch the ground before and after, so that its height is the same.
        self.assert_same_poses(clip, figure.poses, 1e-3)
        angles = [column for column in range(clip.poses.shape[1]) if column > 2]
        self.assertLess(np.abs(np.abs(clip.poses) - np.abs(figure.poses))[:, angles].max(), 1e-5)

    def test_acclaim_round_trip(self):
        figure = Figure(PLAIN, motion.load('biped3d_mocap_walk'), 25)
        write_acclaim(figure, self.folder / 'a.asf', self.folder / 'walk.amc')
        capture = retargeting.read(
            self.folder / 'walk.amc', PLAIN, self.folder / 'a.asf', rate=24.0
        )
        np.testing.assert_allclose(capture.positions, figure.poses[:, :3], atol=1e-6)
        clip = retargeting.retarget(capture, PLAIN)
        self.assert_same_poses(clip, figure.poses, 1e-3)
        np.testing.assert_allclose(clip.times, np.arange(25) / 24)

    def test_acclaim_motions_may_state_rate_and_unit(self):
        _, asf, amc = self.capture()
        plain, text = motion.read_amc(amc, asf), amc.read_text()
        self.assertAlmostEqual(plain.times[1], 1 / 120)
        amc.write_text(':SAMPLES-PER-SECOND 60\n:DEGREES\n' + text)
        stated = motion.read_amc(amc, asf)
        self.assertAlmostEqual(stated.times[1], 1 / 60)
        self.assertAlmostEqual(motion.read_amc(amc, asf, rate=30).times[1], 1 / 30)
        np.testing.assert_array_equal(stated.rotations, plain.rotations)
        amc.write_text(text.replace(':DEGREES', ':RADIANS'))
        self.assertGreater(np.abs(motion.read_amc(amc, asf).rotations - plain.rotations).max(), 0.1)

    def test_what_is_too_large(self):
        _, asf, amc = self.capture()
        many = ''.join(f'begin\nname b{i}\nlength 1\ndirection 0 1 0\nend\n' for i in range(3000))
        asf.write_text(asf.read_text().replace(':bonedata\n', f':bonedata\n{many}', 1))
        bvh = self.folder / 'many.bvh'
        bvh.write_text('HIERARCHY\nROOT a\n{\n' + 'JOINT b\n' * 3000)
        flat = motion.Clip(
            'flat', np.array([0, 1e-6, 2e-6, 1e3]), np.zeros((4, 3)), 'planar', (), ()
        )
        assert_refused(
            self,
            (lambda: motion.read_amc(amc, asf), 'line .*expected at most 2000 bones'),
            (lambda: motion.read_bvh(bvh), 'line .*expected at most 2000 joints'),
            (
                lambda: retargeting.cycle(flat, 0, 1000),
                'frames, 1e-06 s apart; expected at most 100000',
            ),
        )

    def test_another_heading_size_and_place(self):
        """Twice as large, turned to the left and set aside: the same clip in the end."""
        figure = Figure(PLAIN, motion.load('biped3d_mocap_walk'), 25)
        expected = figure.poses.copy()
        turn = Rotation.from_euler('z', 2.0)
        figure.offsets *= 2
        figure.poses[:, :3] = turn.apply(2 * figure.poses[:, :3]) + np.array([3, 4, 5])
        figure.local[0] = turn * figure.local[0]
        write_bvh(figure, self.folder / 'walk.bvh')
        clip = retargeting.retarget(retargeting.read(self.folder / 'walk.bvh', PLAIN), PLAIN)
        self.assert_same_poses(clip, expected, 2e-3)

    def test_the_two_kinds_of_json(self):
        clip = motion.load('biped2d_walk')
        write_terrainrl(clip, self.folder / 'terrainrl.json')
        found = retargeting.read(self.folder / 'terrainrl.json', 'biped2d')
        np.testing.assert_allclose(found.poses, clip.poses, atol=1e-12)
        self.assertTrue(found.loop)

        angle, frame = 0.3, [0.1, 0, 0.9, 0, 1, 0, 0, 0]
        turn = [np.cos(angle / 2), 0, 0, np.sin(angle / 2)]  # about z of the file, -y of the suite
        for name, size in motion.HUMANOID3D.items():
            value = [angle if name == 'left_knee' else 0] if size == 1 else [1, 0, 0, 0]
            frame += turn if name in ('chest', 'right_hip') else value
        frames = [frame, [*frame[:1], 0.5, *frame[2:]]]
        path = self.folder / 'deepmimic.json'
        path.write_text(json.dumps({'Loop': 'none', 'Frames': frames}))
        clip = retargeting.retarget(retargeting.read(path, PLAIN), PLAIN)
        self.assertEqual(clip.joints, motion.load('biped3d_mocap_walk').joints)
        bent = quaternion.from_vector(np.array([0, -angle, 0]))
        for joint, expected in (
            ('torso', bent), ('right_hip', bent), ('left_knee', [angle]), ('right_knee', [0]),
            ('left_ankle', [1, 0, 0, 0]),
        ):  # fmt: skip
            column, _ = clip.layout.starts(joint)
            found = clip.poses[:, column : column + len(expected)]
            np.testing.assert_allclose(found, [expected] * 2, atol=1e-12)
        looped = {'Loop': 'wrap', 'CycleSyncRootRot': True, 'Frames': frames}
        path.write_text(json.dumps(looped))
        self.assertTrue(retargeting.retarget(retargeting.read(path, PLAIN), PLAIN).turning)
        # The height of the root is that of the character; displacements scale with it.
        size = KinematicViewer(PLAIN).standing()[2] / 0.9
        np.testing.assert_allclose(clip.displacement, [0.5 * size, 0, 0], atol=1e-9)

    def capture(self):
        """Files of a figure: BVH, skeleton, motion."""
        paths = [self.folder / name for name in ('a.bvh', 'a.asf', 'a.amc')]
        figure = Figure(PLAIN, motion.load('biped3d_mocap_walk'), 4)
        write_bvh(figure, paths[0])
        write_acclaim(figure, *paths[1:])
        return paths

    def test_content_tells_the_format(self):
        bvh, asf, amc = self.capture()
        for path in (bvh, amc):
            skeleton = asf if path == amc else None
            expected = retargeting.read(path, PLAIN, skeleton)
            found = retargeting.read(path.rename(self.folder / 'walk.txt'), PLAIN, skeleton)
            np.testing.assert_array_equal(found.rotations, expected.rotations)
        clip = motion.load('biped2d_walk')
        clip.save(self.folder / 'walk.npz')
        write_terrainrl(clip, self.folder / 'walk.json')
        for name in ('walk.npz', 'walk.json'):
            (self.folder / name).rename(self.folder / 'walk.txt')
            found = retargeting.read(self.folder / 'walk.txt', 'biped2d')
            np.testing.assert_allclose(found.poses, clip.poses, atol=1e-12)

    def test_refused(self):
        (self.folder / 'note.bvh').touch()
        with self.assertRaisesRegex(FileNotFoundError, "did you mean 'note.bvh'"):
            retargeting.read(self.folder / 'none.bvh', PLAIN)
        bvh, asf, amc = self.capture()
        for path, skeleton, option, message in (
            (bvh, None, 'rate', r"a\.bvh: .* of .bvh files 'rate'; known: forward, unit, up"),
            (amc, asf, 'fwd', r"a\.amc: .* of .amc files 'fwd'; did you mean 'forward'"),
        ):
            read = functools.partial(retargeting.read, path, PLAIN, skeleton, **{option: 60})
            assert_refused(self, (read, message))
        bvh.write_text(bvh.read_text().replace('Spine1', 'Rücken'), encoding='utf-8')
        code = f"""if True:
            from trl_suite import motion
            try:
                motion.read_bvh({str(bvh)!r})
            except ValueError as error:
                print(ascii(str(error)))
        """
        ascii_only = {'LC_ALL': 'POSIX', 'PYTHONUTF8': '0', 'PYTHONCOERCECLOCALE': '0'}
        out = subprocess.run(
            [sys.executable, '-c', code],
            env=os.environ | ascii_only,
            capture_output=True,
            check=True,
        ).stdout.decode()
        self.assertRegex(out, r'a\.bvh: .*xfc.* is not in the encoding of the system, ascii')
        for name, text, message, skeleton in UNUSABLE:
            asf = self.folder / 'a.asf' if skeleton else None
            (self.folder / 'a.asf').write_text(skeleton or '')
            (self.folder / name).write_text(text)
            read = functools.partial(retargeting.read, self.folder / name, PLAIN, asf)
            assert_refused(self, (read, message))

    def test_damaged_files(self):
        paths = {path.name: path for path in self.capture()}
        whole = {name: path.read_text() for name, path in paths.items()}
        for name, before, after, message in DAMAGED:
            found = [*re.finditer(before, whole[name])][-1]
            changed = whole[name][: found.start()] + after + whole[name][found.end() :]
            paths[name].write_bytes(changed.encode('latin-1'))
            if name == 'a.bvh':
                read = functools.partial(retargeting.read, paths['a.bvh'], PLAIN)
            else:
                read = functools.partial(motion.read_amc, paths['a.amc'], paths['a.asf'])
            assert_refused(self, (read, rf'{re.escape(name)}.*{message}'))
            paths[name].write_text(whole[name])

    @parameterized.parameters(motion.HUMANOID3D, motion.DOG3D)
    def test_deepmimics_layouts(self, **layout):
        frame = [0.1, 0, 0.9, 0, 1, 0, 0, 0]
        for size in layout.values():
            frame += [0] if size == 1 else [1, 0, 0, 0]
        path = self.folder / 'deepmimic.txt'
        path.write_text(json.dumps({'Loop': 'wrap', 'Frames': [frame, frame]}))
        found = retargeting.read(path, PLAIN)
        self.assertEqual((found.joints, found.sizes), (tuple(layout), tuple(layout.values())))
        self.assertEqual(
            (len(frame), found.loop), (44 if layout == motion.HUMANOID3D else 84, True)
        )
        path.write_text(json.dumps({'Loop': 'wrap', 'Frames': [frame[:-1]] * 2}))
        with self.assertRaisesRegex(ValueError, r'frame 0 has \d+ numbers; .* 44 .* or 84 \('):
            retargeting.read(path, PLAIN)


class RetargetTest(ClipTest):
    def test_a_spatial_motion_on_a_planar_character(self):
        """Hinges take the part of a rotation that is about their axis."""
        figure = Figure(FULL, motion.load('biped3d_full_walk'), 31, spread_arms=True)
        write_bvh(figure, self.folder / 'walk.bvh')
        clip = retargeting.retarget(
            retargeting.read(self.folder / 'walk.bvh', 'biped2d_full'), 'biped2d_full'
        )
        self.assertEqual((clip.root, set(clip.sizes)), ('planar', {1}))
        source = motion.load('biped3d_full_walk')
        column, _ = source.layout.starts('left_knee')
        own, _ = clip.layout.starts('left_knee')
        np.testing.assert_allclose(clip.poses[:, own], figure.poses[:, column], atol=1e-5)
        own, _ = clip.layout.starts('left_shoulder')  # hangs, though it was sideways at rest
        np.testing.assert_allclose(clip.poses[:, own], 0, atol=0.2)
        self.assertGreater(clip.speed, 0.8 * source.speed)
        # A rotation of the whole motion does not change joint angles.
        ramp = Rotation.from_euler('z', np.linspace(0, 3, 31)[:, None])
        figure.local[0] = ramp * figure.local[0]
        write_bvh(figure, self.folder / 'turn.bvh')
        turned = retargeting.retarget(
            retargeting.read(self.folder / 'turn.bvh', 'biped2d_full'), 'biped2d_full'
        )
        np.testing.assert_allclose(turned.poses[:, 2:], clip.poses[:, 2:], atol=1e-5)

    @parameterized.parameters(
        ('forwards', 2),
        ('backwards', -2),
        ('sideways', 0),
        ('circle', 2 * np.pi),
        ('back and forth', 4),
    )
    def test_the_way_of_a_planar_character_is_that_along_the_heading(self, way, expected):
        t = np.linspace(0, 1, 201)
        heading, place = 2.0 + 0 * t, 2 * np.stack([t, 0 * t], 1)
        if way == 'circle':  # of radius 1 m
            heading, place = (
                2 * np.pi * t,
                np.stack([np.sin(2 * np.pi * t), -np.cos(2 * np.pi * t)], 1),
            )
        elif way == 'back and forth':  # 2 m, a turn on the spot, 2 m
            heading = 2.0 + np.pi * np.clip(3 * t - 1, 0, 1)
            place[:, 0] = 2 * (np.clip(3 * t, 0, 1) - np.clip(3 * t - 2, 0, 1))
        if way != 'circle':
            turn = 2.0 + {'backwards': np.pi, 'sideways': np.pi / 2}.get(way, 0.0)
            place = quaternion.rotate_xy(place, np.full(201, turn))
        clip = free(
            t, np.c_[place, 1 + 0 * t], Rotation.from_euler('z', heading[:, None]), left_knee=-t
        )
        found = retargeting.retarget(clip, 'biped2d', scale=1.0)
        np.testing.assert_allclose(found.poses[[0, -1], 0], [0, expected], atol=1e-3)
        self.assertLessEqual(np.abs(np.diff(found.poses[:, 0])).max(), np.pi / 90)  # without jumps
        np.testing.assert_allclose(found.poses[:, 2], 0, atol=1e-9)
        if way in ('forwards', 'backwards'):  # in space it moves along x, and faces where it did
            spatial = retargeting.retarget(clip, PLAIN, scale=1.0)
            np.testing.assert_allclose(spatial.displacement[:2], [2, 0], atol=1e-9)
            facing = quaternion.rotate(spatial.poses[0, 3:7], np.array([1.0, 0, 0]))
            np.testing.assert_allclose(facing, [np.sign(expected), 0, 0], atol=1e-9)

    @parameterized.product(order=('ZXY', 'ZYX'), roll=(0.0, 0.3, -0.3))
    def test_a_somersault_that_leans(self, order, roll):
        """About an axis that is inclined, or with the body inclined to a level axis."""
        t = np.linspace(0, 1, 61)
        angles = {'Z': 0.4 + 0 * t, 'Y': 2 * np.pi * t, 'X': roll + 0 * t}
        turns = Rotation.from_euler(order, np.stack([angles[axis] for axis in order], 1))
        place = np.stack([t * np.cos(0.4), t * np.sin(0.4), 1 + 0 * t], 1)
        clip = retargeting.retarget(free(t, place, turns, left_knee=-t), 'biped2d', scale=1.0)
        # The pitch of clips is about (0, -1, 0).
        exact = order == 'ZXY' or not roll
        np.testing.assert_allclose(clip.poses[:, 2], -2 * np.pi * t, atol=1e-9 if exact else 0.03)
        np.testing.assert_allclose(clip.poses[:, 0], t, atol=1e-9 if exact else 0.05)

    def test_the_root_follows_another_joint(self):
        figure = Figure(FULL, motion.load('biped3d_full_walk'), 31)
        write_bvh(figure, self.folder / 'walk.bvh')
        capture = retargeting.read(self.folder / 'walk.bvh', FULL)
        names = {name: bvh_name(name) for name in figure.names} | {'root': 'Neck'}
        del names['torso']
        clip = retargeting.retarget(capture, FULL, names, 1.0)
        viewer, place = KinematicViewer(FULL), []
        for pose in figure.poses:
            viewer.put(pose)
            place.append(viewer.places()[figure.names.index('neck')])
        place = np.array(place) - place[0]
        np.testing.assert_allclose(clip.poses[:, :3] - clip.poses[0, :3], place, atol=1e-5)

    @parameterized.parameters(('0 0 1', 1), ('0 0 -2', -1), ('0 1 0', 0), ('1 0 0.1', 0))
    def test_hinges_of_clips_are_lateral(self, axis, sign):
        """Also on links whose axes are not those of the world."""
        character, t = legs(self.folder, axis), np.linspace(0, 1, 11)
        clip = free(t, np.c_[t, 0 * t, 1 + 0 * t], Rotation.identity(11), left_hip=0.5 * t)
        retarget = functools.partial(retargeting.retarget, clip, character)
        if not sign:
            assert_refused(
                self, (retarget, r"the axis of 'left_hip' is \[.*\], but that of 'left_hip'")
            )
            return
        found = retarget()
        column, _ = found.layout.starts('left_hip')
        np.testing.assert_allclose(found.poses[:, column], 0.5 * sign * t, atol=1e-9)

    def test_bodies_and_joints_of_a_file_need_not_correspond(self):
        """All variants have hip and knee at the same places, about the same axis."""
        t = np.linspace(0, 1, 11)
        clip = free(
            t, np.c_[t, 0 * t, 1 + 0 * t], Rotation.identity(11), right_hip=0.5 * t, right_knee=-t
        )
        joints = {name: name for name in ('root', 'right_hip', 'right_knee')}
        bvh, expected = self.folder / 'a.bvh', None
        for name, (before, hips, place, anchors) in STANDS.items():
            with self.subTest(name):
                character = stand(self.folder, before, hips, place, anchors)
                found = [retargeting.retarget(clip, character, joints)]
                if expected is None:
                    write_bvh(Figure(character, found[0], 11), bvh)
                    expected = found[0].displacement
                capture = retargeting.read(bvh, character)
                theirs = {each: bvh_name(each) for each in joints}
                found.append(retargeting.retarget(capture, character, theirs))
                for each in found:
                    np.testing.assert_allclose(each.displacement, expected, atol=1e-5)
                    for joint, angle in (('right_hip', 0.5 * t), ('right_knee', -t)):
                        column, _ = each.layout.starts(joint)
                        np.testing.assert_allclose(each.poses[:, column], angle, atol=1e-5)

    def test_a_jump_does_not_make_a_clip_small(self):
        t = np.linspace(0, 1, 31)
        place = np.stack([t, 0 * t, np.where(t > 0.6, 1.8, 0.9)], 1)
        clip = free(t, place, Rotation.identity(31), left_knee=-t)
        found = retargeting.retarget(clip, PLAIN)
        size = KinematicViewer(PLAIN).standing()[2] / 0.9
        np.testing.assert_allclose(found.displacement, [size, 0, 0.9 * size], atol=1e-9)

    def test_a_capture_without_limbs_needs_a_scale(self):
        figure = Figure(PLAIN, motion.load('biped3d_mocap_walk'), 4)
        write_bvh(figure, self.folder / 'walk.bvh')
        capture = retargeting.read(self.folder / 'walk.bvh', PLAIN)
        joints = {'root': 'Hips', 'left_knee': 'LeftLeg'}
        retarget = functools.partial(retargeting.retarget, capture, PLAIN, joints)
        assert_refused(self, (retarget, r'no two joints at the ends of a limb .* pass scale='))
        ways = [retarget(scale=scale).displacement for scale in (1.0, 2.0)]
        np.testing.assert_allclose(2 * ways[0], ways[1], atol=1e-9)

    def test_usual_names(self):
        ours = ('root', *motion.load('biped3d_full_walk').joints)
        for theirs in (
            [bvh_name(name) for name in ours],
            [f'mixamorig:{bvh_name(name)}' for name in ours],
            ['root', *motion.HUMANOID3D],
        ):
            found = retargeting.guess_map(theirs, ours)
            self.assertContainsSubset(
                ('root', 'torso', 'left_hip', 'right_knee', 'left_ankle', 'right_shoulder'), found
            )
            self.assertContainsSubset(found.values(), theirs)
            self.assertIn('eft', found['left_hip'])
        cmu = ['root', 'lowerback', 'thorax', 'lfemur', 'ltibia', 'lfoot', 'rhumerus', 'rradius']
        found = retargeting.guess_map(cmu, ours)
        self.assertEqual(found['torso'], 'thorax')
        self.assertEqual((found['left_knee'], found['right_elbow']), ('ltibia', 'rradius'))
        self.assertNotIn('right_hip', found)
        own = ['Hips', 'Left Knee', 'a{b}']
        found = retargeting.guess_map(own, ['root', *own[1:]])
        self.assertEqual(found, {'root': 'Hips', 'Left Knee': 'Left Knee', 'a{b}': 'a{b}'})


class CycleTest(parameterized.TestCase):
    def unrolled(self, name, cycles=2.6, noise=0.0):
        clip = motion.load(name)
        times = np.linspace(0, cycles * clip.duration, 201)
        poses = clip.pose(times)
        if clip.root == 'planar':
            poses[:, 2:] += noise * np.sin(np.linspace(0, 3, 201))[:, None]
        return dataclasses.replace(clip, times=times, poses=poses, loop=False)

    def test_the_period_is_found(self):
        for name in ('biped2d_walk', 'raptor_run_050', 'biped3d_mocap_walk'):
            clip, source = retargeting.cycle(self.unrolled(name)), motion.load(name)
            self.assertTrue(clip.loop)
            # Several cycles are as alike as one.
            cycles = clip.duration / source.duration
            self.assertAlmostEqual(cycles, round(cycles), delta=0.03, msg=name)
            self.assertAlmostEqual(clip.speed, source.speed, delta=0.05 * source.speed)

    def test_the_period_is_found_in_a_long_clip(self):
        """Of ten minutes, of which only the last seconds repeat; frames are 0.04 s apart."""
        t = np.arange(0, 600, 0.04)
        knee = np.where(t < 590, 0.5 * t, np.sin(2 * np.pi * t / 1.2))
        clip = motion.Clip('long', t, np.c_[t, 1 + 0 * t, 0 * t, knee], 'planar', ('knee',), (1,))
        found = retargeting.cycle(clip)
        self.assertAlmostEqual(found.duration, round(found.duration / 1.2) * 1.2, delta=0.03)
        self.assertGreater(np.ptp(found.poses[:, 3]), 1.9)
        with self.assertRaisesRegex(ValueError, 'loops already'):
            retargeting.cycle(found)

    def test_a_cycle_may_end_with_the_clip(self):
        """Of which only the last 28/30 s are a cycle; its rounded end is later than the clip's."""
        t = np.arange(41) / 30
        knee = np.where(t < 0.39, 9 * (t - 0.4), np.sin(2 * np.pi * (t - 0.4) * 30 / 28))
        clip = motion.Clip('c', t, np.c_[t, 1 + 0 * t, 0 * t, knee], 'planar', ('knee',), (1,))
        self.assertAlmostEqual(retargeting.cycle(clip).duration, 28 / 30)

    def test_a_somersault_stays_one(self):
        t = np.linspace(0, 3, 91)
        poses = np.stack([t, 1 + 0.1 * np.sin(2 * np.pi * t), 2 * np.pi * t], 1)
        clip = motion.Clip('flip', t, np.c_[poses, 0 * t], 'planar', ('knee',), (1,))
        for found in (retargeting.cycle(clip, 0, 1), retargeting.cycle(clip)):
            turns = np.ptp(found.poses[[0, -1], 2]) / (2 * np.pi)
            self.assertAlmostEqual(turns, round(found.duration), delta=1e-6)

    def test_the_ends_meet(self):
        for name, noise in (('biped2d_walk', 0.1), ('biped3d_mocap_walk', 0.0)):
            loose = self.unrolled(name, noise=noise)
            clip = retargeting.cycle(loose, 0.12, 1.1)
            change = clip.layout.change(clip.poses[0], clip.poses[-1])
            flat = len(clip.displacement) - 1
            np.testing.assert_allclose(change[flat:], 0, atol=1e-12)
            np.testing.assert_array_equal(clip.poses[0, :flat], 0)
            # Nothing moved by more than the gap.
            gap = np.abs(clip.layout.change(loose.pose(0.12), loose.pose(1.1))[flat:]).max()
            moved = clip.layout.change(clip.poses, loose.pose(0.12 + clip.times))[:, flat:]
            self.assertLessEqual(np.abs(moved).max(), gap + 1e-9)


class CheckTest(parameterized.TestCase):
    @parameterized.parameters(
        ('biped2d_walk', 'biped2d'), ('dog_bound', 'dog'), ('biped3d_run', 'biped3d'),
    )  # fmt: skip
    def test_shipped_clips_have_no_faults(self, name, character):
        report = clip_check.check(motion.load(name), character)
        self.assertEmpty(report.faults)
        self.assertEndsWith(str(report), 'no faults')

    def changed(self, column, amount, frames=slice(40, 60)):
        clip = motion.load('biped2d_walk')
        poses = clip.poses.copy()
        poses[frames, column] += amount
        return dataclasses.replace(clip, poses=poses)

    def test_errors(self):
        walk = dataclasses.replace(motion.load('biped2d_walk'), loop=False)
        short = CycleTest.unrolled(None, 'biped2d_walk', 0.2)
        assert_refused(self, *((functools.partial(*call), message) for *call, message in (
            (clip_check.check, walk, 'raptor', "'biped2d_walk'.*does not fit 'raptor'"),
            (retargeting.retarget, walk, 'raptor', {'root': 'root', 'left_nee': 'left_knee'}, "unknown joint of the character 'left_nee'"),
            (retargeting.retarget, walk, 'raptor', {'root': 'root', 'left_knee': 'knee'}, "joint of the motion 'knee'; did you mean"),
            (retargeting.retarget, walk, 'dog', 'the root, or all other joints'),
            (retargeting.retarget, dataclasses.replace(walk, poses=walk.poses - 2 * np.eye(1, walk.poses.shape[1], 1)), 'raptor', 'median height of its root is -1.* expected more than 0, or pass scale='),
            (retargeting.retarget, walk, 'raptor', {'root': 'left_knee', 'left_knee': 'left_knee'}, "'root' follows 'left_knee' of clip"),
            (retargeting.retarget, walk, 'raptor', {'root': 'root', 'left_knee': 'root'}, "'left_knee' follows 'root' of clip .*; expected the root"),
            *((clip_check.check, walk, 'biped2d', near, f'near is {near}; expected a number above 0, in m') for near in (np.nan, 0, -1)),
            (retargeting.retarget, walk, 'raptor', None, 0, 'scale is 0'), (retargeting.cycle, walk, 0.1, 'both or none'),
            (retargeting.cycle, walk, 0.5, 3.0, 'expected 0 <= start < end <= 1.0 s'), (retargeting.cycle, short, 'lasts 0.2 s'),
            (motion.read_bvh, __file__, 0.01, 'w', "forward is 'w'"),
            (motion.read_bvh, __file__, 0.01, '-y', 'expected two axes'),
        )))  # fmt: skip

    def test_joints_beyond_their_limits(self):
        clip = motion.load('biped2d_walk')
        column, _ = clip.layout.starts('right_knee')
        report = clip_check.check(
            self.changed(column, 0.25 - clip.poses[40, column], 40), 'biped2d'
        )
        (fault,) = [fault for fault in report.faults if fault.kind == 'joint limit']
        self.assertEqual((fault.frame, fault.name, fault.unit), (40, 'right_knee', 'rad'))
        self.assertAlmostEqual(fault.amount, 0.25)  # its range ends at 0
        self.assertAlmostEqual(fault.time, clip.times[40])
        clip = motion.load('biped3d_walk')
        column, _ = clip.layout.starts('torso')
        poses = clip.poses.copy()
        poses[7, column : column + 4] = quaternion.from_vector(np.array([0, 1.2, 0]))  # limit 1
        report = clip_check.check(dataclasses.replace(clip, poses=poses), 'biped3d')
        self.assertAlmostEqual(report.excess['torso'][7], 0.2)
        found = {(fault.kind, fault.name, fault.frame) for fault in report.faults}
        self.assertEqual(found, {('joint limit', 'torso', 7)})

    def test_below_the_ground(self):
        deep = clip_check.check(self.changed(1, -0.03), 'biped2d')
        found = [fault for fault in deep.faults if fault.kind == 'penetration']
        self.assertEqual({fault.frame for fault in found}, set(range(40, 60)))
        self.assertContainsSubset({fault.name for fault in found}, {'right_ankle', 'left_ankle'})
        self.assertAlmostEqual(max(fault.amount for fault in found), 0.03, delta=0.001)

    def test_feet_that_slide(self):
        """A walk on the spot: what stood slides back by what the body travelled."""
        clip = motion.load('biped2d_walk')
        poses = clip.poses.copy()
        poses[:, 0] = 0
        report = clip_check.check(dataclasses.replace(clip, poses=poses, loop=False), 'biped2d')
        self.assertEqual({fault.kind for fault in report.faults}, {'foot slide'})
        self.assertBetween(max(fault.amount for fault in report.faults), 0.4, 1.5)
        first = report.faults[0]
        self.assertAlmostEqual(first.amount, 0.02, delta=0.02)  # not before it has travelled so far
        self.assertIn('foot slide', str(report))

    def test_a_contact_lasts_across_the_seam(self):
        """Of a figure that stands, and is pulled by 15 mm per cycle."""
        stands = KinematicViewer('biped2d')
        poses = np.tile(stands.standing(), (16, 1))
        poses[:, 0], layout = 0.001 * np.arange(16), stands.layout
        clip = motion.Clip(
            'pulled', np.arange(16) / 15, poses, 'planar', layout.joints, layout.sizes
        )
        self.assertEmpty(clip_check.check(clip, 'biped2d').faults)
        report = clip_check.check(dataclasses.replace(clip, loop=True), 'biped2d')
        for foot in ('right_ankle', 'left_ankle'):
            np.testing.assert_allclose(report.slide[foot], 0.001 * np.arange(15, 31), atol=1e-9)
        self.assertEqual({fault.frame for fault in report.faults}, set(range(6, 16)))


class ImitationTest(FolderTest):
    def test_a_cycle_can_be_imitated(self):
        """From a file to an environment."""
        walk = motion.load('biped2d_full_walk')
        figure = Figure(FULL, motion.load('biped3d_full_walk'), 41)
        write_bvh(figure, self.folder / 'walk.bvh')
        clip = retargeting.cycle(
            retargeting.retarget(retargeting.read(self.folder / 'walk.bvh', 'biped2d_full'),
                                 'biped2d_full'), 0.0, figure.times[-1]
        )  # fmt: skip
        self.assertEqual(clip.joints, walk.joints)
        environment = suite.build('biped2d_full', clip=clip, task_kwargs={'random': 0})
        environment.reset()
        time_step = environment.step(environment.task.clip_action(0))
        self.assertGreater(time_step.reward, 0.5)

    def test_action_0_of_own_characters_is_the_mean_of_the_clip(self):
        """Right and left by name need not be mirror images: these legs are spread at the hips."""
        spec, t = legs(self.folder, '1 0 0'), np.linspace(0, 1, 31)
        spread = 0.1 * np.cos(2 * np.pi * t) + 0.2
        clip = free(
            t,
            np.c_[t, 0 * t, 0.6 + 0 * t],
            Rotation.identity(31),
            right_hip=-spread,
            left_hip=spread,
        )
        environment = suite.build(spec, clip=dataclasses.replace(clip, loop=True), terrain='plane')
        np.testing.assert_allclose(environment.action_map.action_offset, [-0.2, 0.2], atol=1e-6)

    def test_example_runs(self):
        figure = Figure(FULL, motion.load('biped3d_full_walk'), 61)
        write_bvh(figure, self.folder / 'walk.bvh')
        spec = importlib.util.spec_from_file_location('own_clip', EXAMPLES / 'own_clip.py')
        example = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(example)
        out = io.StringIO()
        with contextlib.chdir(self.folder), contextlib.redirect_stdout(out):
            example.main(['walk.bvh', '--strip', 'walk.png'])
        self.assertStartsWith(out.getvalue(), 'walk: ')
        self.assertTrue(motion.load(self.folder / 'clip.npz').loop)
        self.assertGreater((self.folder / 'walk.png').stat().st_size, 1000)
