"""Motions of the user's own on a character: read, carried over by joint names, cut to a cycle.

    from trl_suite import retargeting, suite

    motion = retargeting.read('walk.bvh', 'biped2d_full')
    clip = retargeting.cycle(retargeting.retarget(motion, 'biped2d_full'))
    environment = suite.build('biped2d_full', clip=clip)

Links point where the bones of the motion point; what a joint of the character cannot do is left out
(a hinge takes the part of a rotation that is about its axis). Nothing is done about limits, feet that
slide or ground that is entered: `trl_suite.retargeting.clip_check` tells where that happens.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from trl_suite import characters
from trl_suite.motion import Capture, Clip, quaternion, readers
from trl_suite.motion import clip as clips
from trl_suite.motion.capture import read_amc, read_bvh
from trl_suite.rendering.kinematic_viewer import KinematicViewer
from trl_suite.util import errors
from trl_suite.util.files import Path, existing

SUFFIXES = ('.bvh', '.amc', '.json', '.npz')
STRAIGHT = 0.2  # m; a motion that gets farther is turned until it goes along +x
SINKING = 0.05  # share of the frames that may enter the ground; captured heights are not exact
CYCLE = (0.3, 2.5)  # s; shortest and longest cycle that is looked for
CYCLE_FRAMES = 300  # at most, among which a cycle is looked for
RATE_TIME = 0.1  # s; a difference of rates counts as that of poses after this time
_LATERAL = np.array([0.0, -1.0, 0.0])  # axis of pitch, and of hinges in files of the original
_VERTICAL = np.array([0.0, 0.0, 1.0])
_IDENTITY = np.array([1.0, 0.0, 0.0, 0.0])

# How others call our joints, the first that there is: TerrainRL and DeepMimic, Acclaim (CMU), BVH
# of several makes. {side} is right, {s} is r. Case and a prefix such as mixamorig: do not matter.
NAMES: dict[str, tuple[str, ...]] = {
    'root': ('root', 'hips', 'pelvis', 'hip'),
    'torso': ('torso', 'chest', 'thorax', 'spine1', 'spine2', 'spine', 'abdomen'),
    'neck': ('neck', 'upperneck', 'neck1', 'lowerneck'),
    'head': ('head',),
    '{side}_hip': ('{side}_hip', '{s}femur', '{side}upleg', '{side}hip', '{side}thigh'),
    '{side}_knee': ('{side}_knee', '{s}tibia', '{side}leg', '{side}knee', '{side}shin'),
    '{side}_ankle': ('{side}_ankle', '{s}foot', '{side}foot', '{side}ankle'),
    '{side}_shoulder': ('{side}_shoulder', '{s}humerus', '{side}arm', '{side}shoulder'),
    '{side}_elbow': ('{side}_elbow', '{s}radius', '{side}forearm', '{side}elbow'),
    '{side}_forearm': ('{side}_elbow', '{s}radius', '{side}forearm', '{side}elbow'),
    '{side}_wrist': ('{side}_wrist', '{s}hand', '{side}hand', '{side}wrist'),
}  # fmt: skip

CharacterLike = str | characters.CharacterSpec


def read(
    path: Path, character: CharacterLike, skeleton: Path | None = None, **options: Any
) -> Clip | Capture:
    """Reads a motion file of any format.

    Args:
      path: .bvh; .amc (Acclaim, CMU); .json of TerrainRL, whose joints are those of the character, in
        its order, or of DeepMimic, whose joints are those of its humanoid; .npz of `Clip.save`.
      character: for TerrainRL's files.
      skeleton: for .amc, the .asf file that belongs to it.
      **options: of `motion.read_bvh` or `motion.read_amc`.

    Raises:
      ValueError: another suffix, a malformed file, or options that do not belong to the format.
      FileNotFoundError: there is no such file.
      ImportError: for .bvh, if the extra 'clips' is not installed.
    """
    path = existing(path, SUFFIXES)
    if path.suffix.lower() == '.amc' and skeleton is None:
        raise ValueError(f'{path}: an .amc file needs its skeleton, an .asf file')
    if path.suffix.lower() != '.amc' and skeleton is not None:
        raise ValueError(
            f'{path}: a skeleton ({skeleton}) belongs to an .amc file, and to no other'
        )
    if path.suffix.lower() == '.bvh':
        return read_bvh(path, **options)
    if path.suffix.lower() == '.amc':
        assert skeleton is not None
        return read_amc(path, skeleton, **options)
    if options:
        raise ValueError(f'{path}: {", ".join(options)}: for .bvh and .amc only')
    if path.suffix.lower() == '.npz':
        return clips.load(path)
    try:
        content = json.loads(path.read_text(encoding='utf-8'))
    except ValueError as error:
        raise ValueError(f'{path}: not JSON: {error}') from None
    # The two differ in how they say that a motion repeats.
    if isinstance(content, dict) and isinstance(content.get('Loop'), str):
        return readers.read_deepmimic(path)
    layout = KinematicViewer(character).layout
    return readers.read_terrainrl(path, layout.joints, layout.sizes, layout.root)


def guess_map(theirs: Sequence[str], ours: Sequence[str]) -> dict[str, str]:
    """Returns which joint of a motion each joint of a character follows, by usual names (`NAMES`).

    Args:
      theirs: joints of the motion.
      ours: joints of the character. Those without a counterpart are left out.
    """
    known = {name.rpartition(':')[2].lower().replace(' ', ''): name for name in theirs}
    found = {}
    for joint in ours:
        side = joint.partition('_')[0] if joint.startswith(('left_', 'right_')) else ''
        usual = NAMES.get(joint.replace(f'{side}_', '{side}_', 1) if side else joint, ())
        for name in (joint, *usual):
            name = name.format(side=side, s=side[:1])
            if name in known:
                found[joint] = known[name]
                break
    return found


def counterparts(
    motion: Clip | Capture, joints: Sequence[str], joint_map: Mapping[str, str] | None = None
) -> dict[str, str]:
    """Returns which joint of a motion the root and each joint of a character follow.

    Args:
      motion: the motion.
      joints: of the character.
      joint_map: from the character's joints, and 'root', to the motion's; by default `guess_map`.

    Raises:
      ValueError: unknown joints, or no root in the map.
    """
    ours, theirs = ('root', *joints), _joints(motion)
    chosen = guess_map(theirs, ours) if joint_map is None else dict(joint_map)
    for our, their in chosen.items():
        if our not in ours:
            raise ValueError(errors.unknown('joint of the character', our, ours))
        if their not in theirs:
            raise ValueError(errors.unknown('joint of the motion', their, theirs))
    if 'root' not in chosen or len(chosen) < 2:
        raise ValueError(
            f'motion {motion.name!r}: no root, or nothing else, has a counterpart; give a map from '
            f'{", ".join(ours)} to {", ".join(theirs)}'
        )
    return chosen


def _joints(motion: Clip | Capture) -> tuple[str, ...]:
    return tuple(motion.joints) if isinstance(motion, Capture) else ('root', *motion.joints)


def retarget(
    motion: Clip | Capture,
    character: CharacterLike,
    joint_map: Mapping[str, str] | None = None,
    scale: float | None = None,
) -> Clip:
    """Carries a motion over to a character.

    The motion is turned until it goes along +x (or looks there, if it stays where it is), moved over
    the origin, scaled in its lengths, and put on the ground: all but the lowest 5 % of the frames
    stay above it. A clip that is in the character's layout already is returned as it is, unless a map
    or a scale is given.

    Args:
      motion: what `read` returned.
      character: name or row.
      joint_map: joint of the character -> joint of the motion, with 'root' for the root; joints that are
        not named keep their zero. By default by usual names, see `guess_map`.
      scale: of lengths; by default legs and arms of the character over those of a capture, or the height
        of its root over the largest height of a clip's.

    Returns:
      A clip in the character's layout; it loops if the motion does.

    Raises:
      ValueError: unknown joints, no root in the map, or a scale that is not positive.
    """
    figure = KinematicViewer(character)
    layout = figure.layout
    if isinstance(motion, Clip) and joint_map is None and scale is None:
        own = motion.layout
        if (own.root, own.joints, own.sizes) == (layout.root, layout.joints, layout.sizes):
            return motion
    theirs, chosen = _joints(motion), counterparts(motion, layout.joints, joint_map)
    if scale is not None and not 0 < scale < np.inf:
        raise ValueError(f'scale is {scale}; expected a positive number')
    if isinstance(motion, Capture):
        path, turns = motion.positions, motion.rotations[:, theirs.index(chosen['root'])]
        size = _limbs(figure, motion, chosen) if scale is None else scale
    else:
        path, turns = _root(motion)
        standing = figure.standing()[1 if layout.root == 'planar' else 2]
        size = standing / path[:, 2].max() if scale is None else scale
    yaw = _yaw(path, turns)
    path = path - [*path[0, :2], 0]
    path[:, :2] = quaternion.turned(path[:, :2], np.full(len(path), -yaw))
    upright = quaternion.about_z(np.full(len(path), -yaw))
    if layout.root == 'planar':  # it cannot turn aside: what it does, it does straight on
        aside = quaternion.angle_about(quaternion.multiply(upright, turns), _VERTICAL)
        upright = quaternion.multiply(quaternion.about_z(-aside), upright)
    links = _captured(figure, motion, chosen, upright) if isinstance(motion, Capture) else None
    poses = _poses(figure, motion, chosen, size * path, quaternion.multiply(upright, turns), links)
    height = 1 if layout.root == 'planar' else 2
    poses[:, height] -= np.quantile(_lowest(figure, poses), SINKING)
    return Clip(
        motion.name, motion.times, poses, layout.root, layout.joints,
        layout.sizes, getattr(motion, 'loop', False),
        f'{motion.name}, carried over to {figure.character.spec.name}',
    )  # fmt: skip


def _root(motion: Clip) -> tuple[np.ndarray, np.ndarray]:
    """Returns places (n, 3) and rotations (n, 4) of a clip's root."""
    if motion.root == 'free':
        return motion.poses[:, :3].copy(), motion.poses[:, 3:7]
    x, z, pitch = motion.poses[:, :3].T
    return np.stack([x, 0 * x, z], axis=1), quaternion.from_vector(pitch[:, None] * _LATERAL)


def _yaw(path: np.ndarray, turns: np.ndarray) -> float:
    """Returns where a motion goes, or looks to at first if it stays where it is, rad."""
    way = path[-1, :2] - path[0, :2]
    if np.hypot(*way) > STRAIGHT:
        return float(np.arctan2(way[1], way[0]))
    return float(quaternion.heading(turns[0]))


def _bones(figure: KinematicViewer, chosen: Mapping[str, str]) -> dict[int, int]:
    """Returns the links of limbs, by number: those with one child that follows the motion."""
    ours = ('root', *figure.layout.joints)
    children: dict[int, list[int]] = {}
    for i, parent in enumerate(figure.parents()):
        if parent > 0 and ours[i] in chosen and ours[parent] in chosen:
            children.setdefault(parent, []).append(i)
    return {parent: found[0] for parent, found in children.items() if len(found) == 1}


def _vectors(
    figure: KinematicViewer, motion: Capture, chosen: Mapping[str, str]
) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """Returns what each limb is in its zero pose and in the rest pose of the motion, m."""
    ours = ('root', *figure.layout.joints)
    figure.put(figure.standing())
    places = figure.places()
    rest = {
        ours.index(our): motion.rest[motion.joints.index(their)] for our, their in chosen.items()
    }
    found = {
        link: (places[child] - places[link], rest[child] - rest[link])
        for link, child in _bones(figure, chosen).items()
    }
    return {link: pair for link, pair in found.items() if min(map(np.linalg.norm, pair)) > 1e-6}


def _limbs(figure: KinematicViewer, motion: Capture, chosen: Mapping[str, str]) -> float:
    """Returns the length of the character's limbs over that of the motion's."""
    pairs = _vectors(figure, motion, chosen).values()
    mine, other = (sum(float(np.linalg.norm(pair[i])) for pair in pairs) for i in (0, 1))
    return mine / other if other else 1.0


def _captured(
    figure: KinematicViewer, motion: Capture, chosen: Mapping[str, str], upright: np.ndarray
) -> dict[int, np.ndarray]:
    """Returns the world orientations (n, 4) that links should have, by number."""
    ours = ('root', *figure.layout.joints)
    vectors, parents = _vectors(figure, motion, chosen), figure.parents()
    zero = figure.orientations()
    align = {-1: _IDENTITY}  # from the zero pose to the rest pose of the motion
    links = {}
    for i, our in enumerate(ours):
        # A hand or foot takes over from its limb; the trunk's own rest pose is upright.
        align[i] = quaternion.between(*vectors[i]) if i in vectors else align[parents[i]]
        if our in chosen:
            turns = motion.rotations[:, motion.joints.index(chosen[our])]
            turns = quaternion.multiply(upright, turns)
            links[i] = quaternion.multiply(turns, quaternion.multiply(align[i], zero[i]))
    return links


def _poses(
    figure: KinematicViewer,
    motion: Clip | Capture,
    chosen: Mapping[str, str],
    path: np.ndarray,
    turns: np.ndarray,
    links: dict[int, np.ndarray] | None,
) -> np.ndarray:
    """Returns poses in the character's layout, (n, columns).

    Args:
      figure: the character.
      motion: where joints of a clip are taken from.
      chosen: the map.
      path: of the root, (n, 3).
      turns: of the root, (n, 4).
      links: orientations that the links of a capture should have; None for a clip.
    """
    layout, n = figure.layout, len(path)
    poses = np.zeros((n, layout.columns))
    if layout.root == 'planar':
        pitch = np.unwrap(quaternion.angle_about(turns, _LATERAL))
        poses[:, :3] = np.stack([path[:, 0], path[:, 2], pitch], axis=1)
        turns = quaternion.from_vector(pitch[:, None] * _LATERAL)
    else:
        poses[:, :7] = np.concatenate([path, turns], axis=1)
    figure.put(figure.standing())
    zero, parents, axes = figure.orientations(), figure.parents(), figure.axes()
    reached = {0: quaternion.multiply(turns, zero[0])}
    for i, (joint, size) in enumerate(zip(layout.joints, layout.sizes, strict=True), 1):
        parent = reached[parents[i]]
        relative = quaternion.multiply(quaternion.conjugate(zero[parents[i]]), zero[i])
        before = quaternion.multiply(parent, relative)
        turn = np.tile(_IDENTITY, (n, 1))
        if joint in chosen and links is not None:
            turn = quaternion.multiply(quaternion.conjugate(before), links[i])
        elif joint in chosen:
            assert isinstance(motion, Clip)
            turn = _turns(motion, chosen[joint])
        column, _ = layout.starts(joint)
        if size == 1:
            axis = axes[i - 1]
            if axis is None:  # a slide has nothing to follow
                turn = np.tile(_IDENTITY, (n, 1))
            else:
                angle = np.unwrap(quaternion.angle_about(turn, axis))
                angle -= 2 * np.pi * np.round(angle.mean() / (2 * np.pi))
                poses[:, column] = angle
                turn = quaternion.from_vector(angle[:, None] * axis)
        else:
            poses[:, column : column + 4] = turn
        reached[i] = quaternion.multiply(before, turn)
    return poses


def _turns(motion: Clip, joint: str) -> np.ndarray:
    """Returns the rotations of a clip's joint against its parent, (n, 4)."""
    column, _ = motion.layout.starts(joint)
    if motion.sizes[motion.joints.index(joint)] == 4:
        return motion.poses[:, column : column + 4]
    return quaternion.from_vector(motion.poses[:, column, None] * _LATERAL)


def _lowest(figure: KinematicViewer, poses: np.ndarray) -> np.ndarray:
    """Returns the height of the lowest corner in every pose, (n,)."""
    heights = np.empty(len(poses))
    for i, pose in enumerate(poses):
        figure.put(pose)
        heights[i] = figure.corners()[..., 2].min()
    return heights


def cycle(clip: Clip, start: float | None = None, end: float | None = None) -> Clip:
    """Cuts one cycle out of a clip, so that it can be imitated.

    The gap that is left between its end and its start is spread evenly over the cycle; what it moves
    ahead, and to the side, it does in every cycle. Give both times, or none: then the two moments are
    chosen that are most alike in pose and rates, 0.3 to 2.5 s apart.

    Args:
      clip: which does not loop.
      start: of the cycle, s.
      end: of the cycle, s.

    Raises:
      ValueError: times that are not in the clip, one without the other, or a clip that is too short.
    """
    if (start is None) is not (end is None):
        raise ValueError('start and end: expected both or none')
    if start is None or end is None:
        start, end = _alike(clip)
    if not 0 <= start < end <= clip.duration:
        raise ValueError(
            f'start and end are {start} and {end}; expected 0 <= start < end <= {clip.duration:.4g} s'
        )
    step = float(np.median(np.diff(clip.times)))
    share = np.linspace(0, 1, max(3, round((end - start) / step) + 1))
    poses = clip.pose(start + share * (end - start))
    layout, flat = clip.layout, 1 if clip.root == 'planar' else 2
    gap = layout.change(poses[-1], poses[0])
    gap[:flat] = 0.0
    poses = advanced(clip, poses, share[:, None] * gap)
    poses[:, :flat] -= poses[0, :flat].copy()
    return dataclasses.replace(clip, times=share * (end - start), poses=poses, loop=True)


def advanced(clip: Clip, poses: np.ndarray, change: np.ndarray) -> np.ndarray:
    """Returns poses (n, columns) moved on by changes (n, rates), in a clip's layout."""
    layout = clip.layout
    result = poses.copy()
    quaternions = [column for q, _ in layout.rotations for column in range(q, q + 4)]
    turns = [column for _, v in layout.rotations for column in range(v, v + 3)]
    result[:, np.setdiff1d(np.arange(layout.columns), quaternions)] += change[
        :, np.setdiff1d(np.arange(layout.rates), turns)
    ]
    for q, v in layout.rotations:
        turn = quaternion.from_vector(change[:, v : v + 3])
        result[:, q : q + 4] = quaternion.multiply(poses[:, q : q + 4], turn)
    return result


def _alike(clip: Clip) -> tuple[float, float]:
    """Returns the two moments of a clip that are most alike, s."""
    if clip.duration < CYCLE[0]:
        raise ValueError(
            f'clip {clip.name!r} lasts {clip.duration:.3g} s; expected at least {CYCLE[0]} s, or the '
            'times of the cycle'
        )
    count = min(CYCLE_FRAMES, max(len(clip.times), 30))
    times = np.linspace(0, clip.duration, count)
    poses, rates = clip.pose(times), RATE_TIME * clip.velocity(times)
    flat = 1 if clip.root == 'planar' else 2
    best = (np.inf, 0.0, 0.0)
    for i, time in enumerate(times):
        later = np.flatnonzero((times >= time + CYCLE[0]) & (times <= time + CYCLE[1]))
        if not len(later):
            break
        change = clip.layout.change(np.broadcast_to(poses[i], poses[later].shape), poses[later])
        difference = (change[:, flat:] ** 2).sum(1) + ((rates[later] - rates[i]) ** 2).sum(1)
        j = int(difference.argmin())
        best = min(best, (float(difference[j]), time, times[later[j]]))
    return float(best[1]), float(best[2])
