"""Transfer of a motion to a character by joint names.

Links get the directions of the motion's bones; rotations that a joint of the character cannot
perform are discarded (a hinge keeps the component about its axis). Violated limits, sliding feet
and ground penetration are not corrected: `trl_suite.retargeting.clip_check` reports them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from trl_suite.characters import CharacterSpec
from trl_suite.motion import Capture, Clip, quaternion
from trl_suite.rendering.kinematic_viewer import KinematicViewer
from trl_suite.util import errors
from trl_suite.util.options import checked

STRAIGHT = 0.2  # m; a motion with a larger displacement is rotated to +x by it, not by its heading
SINKING = 0.05  # fraction of frames that may penetrate the ground; captured heights are inexact
SLANT = 0.7  # cosine; a hinge whose axis is farther from the lateral one does not follow a clip's
_LATERAL = np.array([0.0, -1.0, 0.0])  # axis of pitch, and of hinges in files of the original
_IDENTITY = np.array([1.0, 0.0, 0.0, 0.0])

# Names of the joints in other formats; the first that exists is used: TerrainRL and DeepMimic,
# Acclaim (CMU), BVH of several tools. {side} is right, {s} is r. Case and prefixes such as
# mixamorig: are ignored.
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
}


def guess_map(theirs: Sequence[str], ours: Sequence[str]) -> dict[str, str]:
    """Returns a map from joints of a character to joints of a motion, by usual names (`NAMES`).

    Joints of the character without a counterpart are omitted.
    """
    known = {_plain(name): name for name in theirs}
    found = {}
    for joint in ours:
        plain = _plain(joint)
        side = plain.partition('_')[0] if plain.startswith(('left_', 'right_')) else ''
        usual = NAMES.get(plain.replace(f'{side}_', '{side}_', 1) if side else plain, ())
        for name in (plain, *(each.format(side=side, s=side[:1]) for each in usual)):
            if name in known:
                found[joint] = known[name]
                break
    return found


def _plain(name: str) -> str:
    """Returns a name without prefix, case and spaces."""
    return name.rpartition(':')[2].lower().replace(' ', '')


def counterparts(
    motion: Clip | Capture, joints: Sequence[str], joint_map: Mapping[str, str] | None = None
) -> dict[str, str]:
    """Returns the map from root and joints of a character to joints of a motion.

    It is the given one, by default that of `guess_map`.

    Raises:
      ValueError: unknown joints, no root or nothing but the root, or for a clip, whose root is no joint,
        a root that follows a joint, or a joint that follows the root.
    """
    ours, theirs = ('root', *joints), _joints(motion)
    chosen = guess_map(theirs, ours) if joint_map is None else dict(joint_map)
    errors.check_known('joint of the character', ours, *chosen)
    errors.check_known('joint of the motion', theirs, *chosen.values())
    if 'root' not in chosen or len(chosen) < 2:
        raise ValueError(
            f'motion {motion.name!r}: the root, or all other joints, have no counterpart; pass a '
            f'joint_map from {", ".join(ours)} to {", ".join(theirs)}'
        )
    for our, their in chosen.items() if isinstance(motion, Clip) else ():
        if (our == 'root') is not (their == 'root'):
            raise ValueError(
                f'joint_map: {our!r} follows {their!r} of clip {motion.name!r}; expected the root, and no '
                'other joint, to follow the root'
            )
    return chosen


def _joints(motion: Clip | Capture) -> tuple[str, ...]:
    return tuple(motion.joints) if isinstance(motion, Capture) else ('root', *motion.joints)


def retarget(
    motion: Clip | Capture,
    character: str | CharacterSpec,
    joint_map: Mapping[str, str] | None = None,
    scale: float | None = None,
) -> Clip:
    """Retargets a motion to a character.

    The motion is rotated so that its displacement (or its heading, if it stays in place) is along
    +x, moved to the origin, scaled, and put on the ground: all but the lowest 5 % of the frames are
    above it. A planar character, which has no heading, travels along x what the motion travels along
    its own heading: backwards for a walk backwards, and the length of the way for a walk in a circle.
    A clip that has the character's layout already is returned unchanged, unless a map or a scale is
    given.

    Hinges of a clip are taken to be about the lateral axis, (0, -1, 0), and its links to have the axes
    of the world when all joints are at 0, as in the suite's characters. Clips of other characters are
    transferred wrongly.

    Args:
      motion: the result of `read`.
      character: name or `CharacterSpec`.
      joint_map: joint of the character -> joint of the motion, with 'root' for the root; joints
        that are not in it stay at 0. By default by usual names, see `guess_map`.
      scale: factor on lengths; by default the ratio of limb lengths of the character to those of a
        capture, or of the height of its root to the median height of a clip's.

    Returns:
      A clip in the character's layout; it loops if the motion does.

    Raises:
      ValueError: a map that `counterparts` refuses, or from a clip's hinge to one that is not about the
        lateral axis; a scale that is not positive; or no scale, for a clip whose root is at or below 0
        or a capture without a limb in the map.
    """
    figure = KinematicViewer(character)
    layout = figure.layout
    if isinstance(motion, Clip) and joint_map is None and scale is None:
        own = motion.layout
        if (own.root, own.joints, own.sizes) == (layout.root, layout.joints, layout.sizes):
            return motion
    theirs, chosen = _joints(motion), counterparts(motion, layout.joints, joint_map)
    checked('scale', scale, float | None, above=0)
    if isinstance(motion, Capture):
        root = theirs.index(chosen['root'])
        path, turns = _place(motion, root), motion.rotations[:, root]
        size = _limbs(figure, motion, chosen) if scale is None else scale
    else:
        path, turns = _root(motion)
        standing = figure.standing()[1 if layout.root == 'planar' else 2]
        usual = float(np.median(path[:, 2]))
        if scale is None and usual <= 0:
            raise ValueError(
                f'clip {motion.name!r}: the median height of its root is {usual:.3g} m; expected more than '
                '0, or pass scale='
            )
        size = standing / usual if scale is None else scale
    path = path - [*path[0, :2], 0]
    if layout.root == 'planar':
        # From the lateral axis, the heading is exact at any pitch, also upside down.
        across = quaternion.rotate(turns, -_LATERAL)
        yaw = np.unwrap(np.arctan2(-across[:, 0], across[:, 1]))
        steps = quaternion.rotate_xy(np.diff(path[:, :2], axis=0), -(yaw[1:] + yaw[:-1]) / 2)
        path[1:, 0] = np.cumsum(steps[:, 0])
    else:
        yaw = np.full(len(path), _yaw(path, turns))
        path[:, :2] = quaternion.rotate_xy(path[:, :2], -yaw)
    upright = quaternion.about_z(-yaw)
    links = _captured(figure, motion, chosen, upright) if isinstance(motion, Capture) else None
    poses = _poses(figure, motion, chosen, size * path, quaternion.multiply(upright, turns), links)
    height = 1 if layout.root == 'planar' else 2
    poses[:, height] -= np.quantile(_lowest(figure, poses), SINKING)
    kind, loop = (layout.root, layout.joints, layout.sizes), getattr(motion, 'loop', False)
    turning = layout.root == 'free' and getattr(motion, 'turning', False)
    description = f'{motion.name}, retargeted to {figure.character.spec.name}'
    return Clip(motion.name, motion.times, poses, *kind, loop, description, turning)


def _root(motion: Clip) -> tuple[np.ndarray, np.ndarray]:
    """Returns positions (n, 3) and rotations (n, 4) of a clip's root."""
    if motion.root == 'free':
        return motion.poses[:, :3].copy(), motion.poses[:, 3:7]
    x, z, pitch = motion.poses[:, :3].T
    return np.stack([x, 0 * x, z], axis=1), quaternion.from_vector(pitch[:, None] * _LATERAL)


def _place(motion: Capture, joint: int) -> np.ndarray:
    """Returns the positions of a capture's joint, m, (n, 3)."""
    path = motion.positions
    while (parent := motion.parents[joint]) >= 0:
        offset = motion.rest[joint] - motion.rest[parent]
        path = path + quaternion.rotate(motion.rotations[:, parent], offset)
        joint = parent
    return path


def _yaw(path: np.ndarray, turns: np.ndarray) -> float:
    """Returns the direction of a motion's displacement, or its first heading if that is small."""
    way = path[-1, :2] - path[0, :2]
    if np.hypot(*way) > STRAIGHT:
        return float(np.arctan2(way[1], way[0]))
    return float(quaternion.heading(turns[0]))


def _bones(figure: KinematicViewer, chosen: Mapping[str, str]) -> dict[int, int]:
    """Returns joint -> next joint for limbs: their bodies have exactly one child that follows the motion."""
    ours, bodies = ('root', *figure.layout.joints), figure.bodies()
    children: dict[int, dict[int, int]] = {}  # by body: the first joint of each child
    for i, parent in enumerate(figure.parents()):
        if parent > 0 and ours[i] in chosen and bodies[i] != bodies[parent]:
            children.setdefault(bodies[parent], {}).setdefault(bodies[i], i)
    return {
        i: child
        for i, our in enumerate(ours)
        if our in chosen and len(found := children.get(bodies[i], {})) == 1
        for child in found.values()
    }


def _vectors(
    figure: KinematicViewer, motion: Capture, chosen: Mapping[str, str]
) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """Returns the vector of each limb in its zero pose and in the rest pose of the motion, m."""
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
    """Returns the ratio of limb lengths of the character to those of the motion.

    Raises:
      ValueError: no limb of the character, from a joint to the next, follows the motion.
    """
    pairs = _vectors(figure, motion, chosen).values()
    mine, other = (sum(float(np.linalg.norm(pair[i])) for pair in pairs) for i in (0, 1))
    if not other:
        raise ValueError(
            f'motion {motion.name!r}: no two joints at the ends of a limb have counterparts; expected, '
            'for instance, hip and knee in joint_map, or pass scale='
        )
    return mine / other


def _captured(
    figure: KinematicViewer, motion: Capture, chosen: Mapping[str, str], upright: np.ndarray
) -> dict[int, np.ndarray]:
    """Returns the target orientations of the bodies of joints, by number, (n, 4) in the world."""
    ours = ('root', *figure.layout.joints)
    vectors, parents = _vectors(figure, motion, chosen), figure.parents()
    zero = figure.orientations()
    align = {-1: _IDENTITY}  # from the zero pose to the rest pose of the motion
    links = {}
    for i, our in enumerate(ours):
        # A hand or foot has the alignment of its limb; the trunk's rest pose is upright.
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

    The root has the positions `path`, (n, 3), and the rotations `turns`, (n, 4). Joints follow
    those of a clip, or for a capture the target orientations of links.

    Raises:
      ValueError: a hinge that is not about the lateral axis follows one of a clip.
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
        turn, axis = np.tile(_IDENTITY, (n, 1)), axes[i - 1]
        if joint in chosen and links is not None:
            turn = quaternion.multiply(quaternion.conjugate(before), links[i])
        elif joint in chosen:
            assert isinstance(motion, Clip)
            their = chosen[joint]
            way = _LATERAL if axis is None else quaternion.rotate(zero[i], axis)
            if motion.sizes[motion.joints.index(their)] == 1 and abs(way @ _LATERAL) < SLANT:
                raise ValueError(
                    f'joint_map: the axis of {joint!r} is {way.round(2).tolist()}, but that of {their!r} is '
                    'taken to be the lateral one, as of all hinges of clips; expected a map without it'
                )
            turn = quaternion.multiply(_turns(motion, their), zero[i])
            turn = quaternion.multiply(quaternion.conjugate(zero[i]), turn)
        column, _ = layout.starts(joint)
        if size == 1:
            if axis is None:  # slides stay at 0
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
    """Returns the rotations of a clip's joint from its zero pose, in the root's axes, (n, 4)."""
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
