"""What differs from the original, as data; docs/differences.md has the reasons."""

from __future__ import annotations

from collections.abc import Callable

from trl_suite import catalogue

_CLIP, _GAIT, _SPATIAL, _CLIP3D, _STEPS, _HIGH, _HARD = (
    lambda row: row.rules in ('imitation', 'footsteps2d'), lambda row: row.rules == 'gait',
    lambda row: row.rules in ('imitation3d', 'footsteps', 'journey', 'ball_journey'),
    lambda row: row.rules == 'imitation3d',
    lambda row: row.rules in ('footsteps', 'footsteps2d'),
    lambda row: row.rules in ('hike', 'soccer'),
    lambda row: row.rules in ('journey', 'ball_journey'),
)  # fmt: skip
_SPACE = lambda row: _SPATIAL(row) or _HIGH(row)  # noqa: E731
_FINE = lambda row: _HIGH(row) and row.terrain in (  # noqa: E731
    'dynamic_obstacles3d', 'pillars3d', 'conveyor3d', 'conveyor3d_wide',
)  # fmt: skip
_DIFFERENCES: tuple[tuple[Callable[[catalogue.Row], bool], str], ...] = (
    (
        lambda row: 'completion' in row.tags,
        'not in the registry of the original: a combination that its papers name or imply',
    ),
    (
        lambda row: _CLIP(row) and 'substeps' not in row.options,
        'MuJoCo at 300 Hz instead of Bullet at 3000 Hz; task option substeps',
    ),
    (
        lambda row: _CLIP(row) and 'substeps' in row.options,
        'MuJoCo at 600 Hz instead of Bullet at 3000 Hz; task option substeps',
    ),
    (_GAIT, 'MuJoCo at 1200 Hz, control at 600 Hz; the original controls most of these at 30 Hz, at which they fall here'),
    (_CLIP3D, 'MuJoCo at 300 Hz instead of Bullet at 3000 Hz; task option substeps'),
    (
        lambda row: (row.rules == 'footsteps' or _HIGH(row) or _HARD(row)) and not _FINE(row),
        'MuJoCo at 300 Hz instead of Bullet at 1200 Hz; task option substeps',
    ),
    (_FINE, 'MuJoCo at 300 Hz instead of Bullet at 3000 Hz; task option substeps'),
    (
        _HIGH,
        'a step is a whole footstep, from one switch of stance to the next; that of the original is 1/30 s '
        'and leaves the cadence to the caller; task option interface',
    ),
    (
        _HIGH,
        'the footstep controller is inside, and trained by us; the original leaves it to the caller; task '
        'option controller',
    ),
    (
        _HIGH,
        'actions are in [-1, 1], clipped, and scaled as by the native learner of the original; its Python '
        'interface takes m and rad',
    ),
    (
        _HIGH,
        'the reward is over the whole step; that of the original is since the last plan, down to a few ms',
    ),
    (
        lambda row: row.terrain == 'pillars3d' and _HIGH(row),
        'sees the heights of its pillars; the original gives it a map of velocities that are all zero',
    ),
    (
        lambda row: row.rules == 'hike',
        'whether a goal is reached or its time over is looked at once a step',
    ),
    (lambda row: row.rules == 'soccer', 'the times of ball and goal are looked at once a step'),
    (
        lambda row: row.rules == 'journey',
        'the reward leads to the goal, and a goal that is reached is drawn anew; that of the original is for '
        'footsteps that nobody sees, and its goal stays; task option reward',
    ),
    (
        lambda row: row.rules == 'ball_journey',
        'there is a ball, and half of the reward is for it; the configuration of the original has none',
    ),
    (_SPACE, 'axes are x forward, y left, z up; the original has y up and z to the right'),
    (
        lambda row: _CLIP(row) or _SPATIAL(row),
        'actions are in [-1, 1] and clipped; the original takes physical units',
    ),
    (
        _SPATIAL,
        "targets of ball joints are rotation vectors about the mean pose; option centre='original' for the "
        "original's angle and axis",
    ),
    (
        _SPACE,
        'a ball joint is limited by one cone, as wide as the widest of its three ranges',
    ),
    (
        _CLIP3D,
        'the goal is straight on, 3 m ahead on the line of the start; the original observes where the start '
        'was',
    ),
    (
        _SPATIAL,
        'rotation errors are those of the shorter way, angular velocities of both sides in one frame',
    ),
    (
        lambda row: row.rules == 'footsteps' and row.options.get('mirrored', False),
        'truly mirrored; the original runs the same environment as for the general plan',
    ),
    (
        lambda row: row.rules == 'footsteps' and row.character == 'biped3d_mocap_run',
        'the footstep is rewarded in the second half of every step; in the original that clock is slower than '
        'the steps',
    ),
    (_STEPS, 'a step that misses its place ends the episode only if asked for; option miss'),
    (
        lambda row: row.rules == 'footsteps2d',
        'the reference is half a cycle of the walk for every step, however long',
    ),
    (
        lambda row: row.rules == 'footsteps' and row.options.get('goal', False),
        'a goal is drawn anew when the walker is within 1 m; the original draws one, at the start',
    ),
    (
        _GAIT,
        'actions are in [-1, 1], clipped, and mapped to the parameters that are learnt; the original takes '
        'them for the first of all parameters, so that most mean another',
    ),
    (_GAIT, 'a step ends with its cycle or a fall, not up to 1/30 s later; the first action of an episode counts'),
    (_GAIT, 'the reward is of the cycle that the action made, and never NaN'),
    (
        lambda row: row.rules == 'gait' and row.character == 'hopper',
        '9 parameters, taken at touch-down; the original announces 8 and takes them in mid-air',
    ),
    (
        lambda row: row.rules == 'gait' and row.character == 'raptor',
        "action 0 is the original's base action 1, which is steadier than its base action 0",
    ),
    (
        lambda row: row.rules == 'gait' and row.character == 'biped2d_simbicon',
        "action 0 is a gait tuned anew: the original's falls here; torque is not rewarded",
    ),
    (
        lambda row: row.rules == 'gait' and row.character == 'goat',
        "action 0 is a gait tuned anew: the original's fall here on flat ground; the original has the "
        'gait and no environment for it',
    ),
    (
        lambda row: row.actuation == 'position' and row.character != 'biped3d_mocap_run',
        'damping is split between servo and joint, joints have an armature of 0.01 kg m^2',
    ),
    (
        lambda row: row.actuation == 'position' and row.character == 'biped3d_mocap_run',
        'damping is split between servo and joint, joints have an armature of 0.01, ankles of 0.03 kg m^2',
    ),
    (
        lambda row: row.actuation == 'position' and row.character in ('dog', 'goat', 'raptor'),
        'targets of hips and shoulder are angles to the parent link, not to the world',
    ),
    (
        lambda row: row.actuation == 'torque',
        'joints have passive damping and an armature of 0.01 kg m^2; action 1 is 0.75 of the limit',
    ),
    (
        lambda row: row.actuation == 'velocity',
        'joints have an armature of 0.01 kg m^2; the damping gain is the servo',
    ),
    (
        lambda row: row.actuation == 'muscle',
        "MuJoCo's muscle curves fitted to the original's, rigid tendons, constant moment arms",
    ),
    (
        lambda row: row.actuation == 'muscle' and row.character in ('goat', 'biped2d_full'),
        'the original has no muscles for this character; they are borrowed',
    ),
    (
        lambda row: row.actuation == 'muscle' and row.character == 'raptor',
        'episodes start in the air, in phases 0.25 to 0.5 and 0.75 to 1: in stance its muscles cannot brake '
        'the clip',
    ),
    (_CLIP, "the clip is our own, close to the original's in gait and speed"),
    (
        lambda row: row.rules == 'imitation3d' and row.clip == 'biped3d_walk',
        "the clip is our own, 1.2 m/s; the original's walks at 1.535 m/s",
    ),
    (
        lambda row: row.rules == 'imitation3d' and row.clip != 'biped3d_walk',
        "the clip is our own, close to the original's in gait and speed",
    ),
    (_HARD, "the clip is our own, 1.3 m/s; the original's walks at 1.535 m/s"),
    (
        lambda row: row.rules == 'footsteps' and row.character != 'biped3d_mocap_run',
        'the steps are our own, 27 of them; the original chooses among 14 captured ones',
    ),
    (
        lambda row: row.rules == 'footsteps' and row.character == 'biped3d_mocap_run',
        "the step is our own, 3.83 m/s; the original's is captured, 4.4 m/s",
    ),
    (
        lambda row: row.clip is not None and not _HIGH(row),
        'the start phase is drawn uniformly instead of swept',
    ),
    (
        lambda row: row.terrain == 'stairs3d',
        'treads have vertical faces and run on to both sides; those of the original slope over 0.2 m and change '
        '1 m beside the start',
    ),
    (
        lambda row: row.terrain in ('obstacles3d', 'pillars3d'),
        'what stands on the ground has vertical faces, and where it overlaps the higher one counts; faces of the '
        'original slope over 0.2 m, and the later one counts',
    ),
    (
        lambda row: row.terrain == 'dynamic_obstacles3d',
        'moving boxes have an inertia of 10^6 kg: they push, carry, and are not stopped; those of the original '
        'are kinematic, and of 1 kg to whom they meet',
    ),
    (
        lambda row: row.terrain.startswith('conveyor3d'),
        'a belt is one box whose surface moves; that of the original is a row of boxes that move and '
        're-enter behind',
    ),
    (
        lambda row: row.terrain == 'mixed_humanoid',
        'the terrain is inferred: slopes_mixed_humanoid without slopes',
    ),
    (
        lambda row: row.rules in ('imitation', 'gait') and row.terrain != 'flat',
        'faces of the terrain are exactly vertical, and every start has flat ground from -1 to 1 m',
    ),
    (
        lambda row: not _HIGH(row) and row.rules != 'gait',
        f'episodes are cut after {catalogue.STEP_LIMIT} steps (discount 1)',
    ),
    (
        lambda row: row.rules == 'gait',
        f'episodes are cut after {catalogue.GAIT_STEP_LIMIT} cycles (discount 1)',
    ),
    (
        _HIGH,
        'episodes are cut after 200 s (discount 1); the limit that the original configures ends none',
    ),
)  # fmt: skip


def differences_of(row: catalogue.Row) -> list[str]:
    """Returns the sentences that apply to an environment."""
    return [text for applies, text in _DIFFERENCES if applies(row)]
