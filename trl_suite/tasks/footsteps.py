"""Walking where the feet are told to go: the footstep-tracking low-level controllers.

Source: the step scenario of the original; 'DeepLoco: dynamic locomotion skills using hierarchical
deep reinforcement learning' (Peng, Berseth, Yin, van de Panne 2017).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np

from trl_suite.arenas import SpatialTerrain
from trl_suite.characters import Character
from trl_suite.engine import World
from trl_suite.motion import Steps, quaternion, step_features
from trl_suite.tasks import rewards
from trl_suite.tasks.figure3d import turn
from trl_suite.tasks.plans import (
    ROOT_TURN_LIMIT,
    Plans,
    Pushes,
    options,
)
from trl_suite.tasks.reference3d import SpatialReference
from trl_suite.tasks.reflection3d import Reflection
from trl_suite.tasks.task import Marker
from trl_suite.tasks.tracking3d import CONTROL_TIMESTEP, SUBSTEPS, Tracking

RIGHT, LEFT = 0, 1  # of the end effectors, in link order
SIDE = np.array([-1.0, 1.0])  # of each foot: to the right, to the left
NEAR_GOAL = 0.1  # m; nearer a goal gives no direction
GOAL_REACHED = 1.0  # m; a goal is drawn anew there
TYPICAL_POSES = 31  # of a step, whose mean is the middle of position control
SOLE, SOLE_AHEAD = (0.0885, 0.045, 0.004), 0.052  # m; of the markers, and how far before the ankle
SWING_COLOUR, STANCE_COLOUR = (0.95, 0.55, 0.1, 0.9), (0.15, 0.45, 0.9, 0.9)  # who lands there
GOAL_COLOUR = (0.85, 0.15, 0.2, 0.8)

_END = list(rewards.STEP_TERMS).index('end_effector')


class Footsteps(Tracking):
    """A spatial biped tracks a plan of footsteps, two steps per cycle of its clock.

    Observation blocks, in this order (N links; heading frame: x along the root's heading, y to the
    left, z up), N = 8: 125 numbers:
      terrain: the 32 x 32 map of `Surroundings.height_map`, m, if asked for.
      pose, velocity: as in `SpatialImitation`; 7N + 1 and 6N.
      phase: phase in [0, 1), then the one-hot of its quarter; 5. The right foot stands below 0.5.
      contact: whether right and left foot touch the ground; 2.
      plan: where the first step lands as seen from the right foot, zero while that one stands, and
        from the left foot, zero while that one does; where the second lands as seen from the right
        foot, zero unless that one stands, and from the left foot; (x, y, z) each, z from the ground
        under the root; then the planned heading, rad to the left of the present one; 13.
    Mirrored, 117 numbers: all of it reflected in left stance, actions too; the phase is that of the
    single step, with the one-hot of its half (3), and the plan (7) has the heading first, then the
    first landing place as seen from the swing foot, then the second from the stance foot.
    """

    TERMS = rewards.STEP_TERMS
    ABOUT = 'root'

    def __init__(
        self,
        character: Character,
        arena: SpatialTerrain,
        steps: Steps,
        *,
        actuation_model: str = 'position',
        plans: Plans | Mapping[str, Any] | None = None,
        goal: bool = False,
        pushes: Pushes | Mapping[str, Any] | None = None,
        miss: float | None = None,
        grace: float = 0.0,
        footstep_scale: float | Sequence[float] = 1.0,
        heading_scale: float = 1.0,
        terrain_map: bool = False,
        mirrored: bool = False,
        substeps: int = SUBSTEPS,
        centre: str = 'clip',
        half_range: float | None = None,
        start_phase: float | Sequence[Sequence[float]] | None = None,
        blend: float = 0.0,
    ) -> None:
        """Composes the task.

        Args:
          character: a spatial biped without actuators; it is attached to the arena.
          arena: where it moves.
          steps: library of single steps of this character; the clock has the period of two.
          actuation_model: one of `trl_suite.actuation.ACTUATIONS`.
          plans: how plans are drawn; or keyword arguments of `Plans`.
          pushes: forces on the torso; or keyword arguments of `Pushes`. None without.
          goal: plans head for a goal on the terrain instead, one after the other.
          miss: an episode fails where a foot lands farther than this from its place, m. The original
            meant to fail at 1 m and does not.
          grace: s after a push or a sharp turn in which no foot misses its place.
          footstep_scale: times the squared distance between swing foot and landing place in the
            reward; more than 1 teaches accuracy sooner. Of several, the mean of their rewards counts:
            a small one reaches far, a large one is accurate.
          heading_scale: the same of the error of the heading.
          terrain_map, mirrored, substeps, centre, half_range, start_phase, blend: as for
            `SpatialImitation`; the middle of position control is the mean pose of a straight step.

        Raises:
          ValueError: options out of range, or steps that do not fit the character.
        """
        if len(character.row.end_effectors) != 2:
            raise ValueError(f'character {character.row.name!r} has no two feet to place')
        if miss is not None and not 0 < miss < np.inf:
            raise ValueError(f'miss is {miss}; expected a positive number of metres, or None')
        if not 0 <= grace < np.inf:
            raise ValueError(f'grace is {grace}; expected seconds, 0 or more')
        for name, given in (('footstep_scale', footstep_scale), ('heading_scale', heading_scale)):
            scales = np.atleast_1d(given)
            if not len(scales) or not ((scales >= 0) & (scales < np.inf)).all():
                raise ValueError(f'{name} is {given}; expected 0 or more')
        self._footstep_scales = np.atleast_1d(footstep_scale).tolist()
        self._heading_scale = heading_scale
        self.plans = options(Plans, 'plans', {} if plans is None else plans)
        self.pushes = None if pushes is None else options(Pushes, 'pushes', pushes)
        if self.pushes:
            self.fields = (*self.fields, 'xfrc_applied')
        self.steps, self.period = steps, 2 * steps.duration
        self.goal_given, self.miss, self._grace = goal, miss, round(grace / CONTROL_TIMESTEP)
        mean = np.mean(self.plans.length)
        # The straight step of about the planned length, from which episodes start.
        straight = np.abs(steps.labels[:, 2]) + np.abs(steps.labels - steps.previous).sum(1)
        self._first = int(np.lexsort((np.abs(steps.labels[:, 0] - mean), straight))[0])
        super().__init__(
            character, arena, steps, actuation_model=actuation_model, substeps=substeps,
            centre=centre, half_range=half_range, start_phase=start_phase, terrain_map=terrain_map,
            mirrored=mirrored, blend=blend, phase=True, extras=self._extra_blocks(),
        )  # fmt: skip

    def _extra_blocks(self) -> dict[str, int]:
        """Blocks, with their sizes, of what is touched and planned."""
        return {'contact': 2, 'plan': 13}

    def _typical_poses(self) -> np.ndarray:
        return self.steps.pose(self._first, np.linspace(0, self.steps.duration, TYPICAL_POSES))

    def bind(self, world: World) -> None:
        super().bind(world)
        n, kinematics = world.n, self.figure.kinematics
        self.reference = SpatialReference.of_steps(self.steps, kinematics, world.models[0])
        weights = np.array(list(self.TERMS.values()))
        self._term_weights, self._term_scales = weights[None, :-1, 0], -weights[None, :-1, 1]
        self._heading_weight = weights[-1, 0]
        self.stance = np.zeros(n, int)  # foot that stands
        self.landing = np.zeros((n, 2, 3))  # m; where the swing foot lands, then the stance foot
        self.heading = np.zeros(n)  # rad; planned
        self._length, self._width = np.zeros(n), np.zeros(n)  # m; of the steps of now
        self._track = np.zeros(n, int)  # of the reference
        self._turned = np.zeros(n)  # rad; by which the reference is turned
        self._shift = np.zeros((n, 2))  # m; where the origin of its track is
        self.goal = np.zeros((n, 3))  # m
        self.landing_error = np.zeros(n)  # m; of the last foot that landed
        self.heading_error = np.zeros(n)  # rad; at that moment
        self.landed = np.zeros(n, bool)  # whether one did in this step
        self._torso = int(world.body_ids([self.character.bodies[1].full_identifier])[0])
        self._push = np.zeros((n, 3))  # N
        # Control steps of an episode at which the push ends and the next one begins.
        self._push_end, self._push_begin = np.zeros((2, n), int)
        self._missed: np.ndarray | bool = False  # who ends so
        self._excused = np.zeros(n, int)  # control step of an episode until which no foot misses

    @property
    def step_phase(self) -> np.ndarray:
        """Share of the single step that has passed, (n,)."""
        twice = 2 * self.phase
        return twice - np.floor(twice)

    # Episodes and plans.

    def _start(
        self, rows: np.ndarray, random_states: Sequence[np.random.RandomState]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        spawns = self._begin_grounds(rows, random_states)
        return self._pose_of_start(rows, spawns)

    def _pose_of_start(
        self, rows: np.ndarray, spawns: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Returns what `_start` does, for the phases that have been drawn."""
        stance = (self.phase[rows] >= 0.5).astype(int)
        self.stance[rows] = stance
        times = self.step_phase[rows] * self.steps.duration
        poses = self.steps.pose(self._first, times, stance == LEFT)
        poses[:, :2] = 0.0
        rates = self.steps.velocity(self._first, times, stance == LEFT)
        return poses, rates, spawns

    def _begun_on_ground(self, rows: np.ndarray) -> None:
        found = self.figure.measure()
        self.landing_error[rows] = self.heading_error[rows] = 0.0
        self.landed[rows] = False
        self._push_end[rows] = self._excused[rows] = 0
        aside, sizes = np.zeros(len(rows)), np.zeros((len(rows), 2, 2))
        for i, row in enumerate(rows.tolist()):
            if self.pushes:
                self._push_begin[row] = self._steps_within(row, self.pushes.interval)
            self._redraw_step(row, always=True)
            aside[i] = self._width[row]
            if self.goal_given:
                place = self._origin[row, :2]
                self.goal[row] = self.arena.goal(row, self._random[row], place, 'step')
            sizes[i] = self._next_size(row), self._next_size(row)
        places, angles = self._origin[rows, :2], self._origin[rows, 2]
        self.heading[rows] = angles
        stance = self.stance[rows]
        anchors = found.feet[rows, stance, :2]
        if self.goal_given:
            self._head_for_goals(rows, found.root[rows, :2])
        else:
            # The line of the plan goes through the start, half a width beside each foot.
            line = quaternion.turned(anchors - places, -angles)
            line[:, 1] = 0.5 * SIDE[stance] * aside
            anchors = places + quaternion.turned(line, angles)
        for which, foot in enumerate((1 - stance, stance)):
            anchors = self._lay(rows, which, foot, anchors, sizes[:, which])
        self._put_reference(rows, found, np.full(len(rows), self._first))

    def _redraw_step(self, row: int, always: bool = False) -> None:
        """Draws length and width of the steps to come, perhaps."""
        plans, random = self.plans, self._random[row]
        if always or random.uniform() < plans.change:
            self._length[row] = random.uniform(*plans.length)
            self._width[row] = random.uniform(*plans.width)

    def _next_size(self, row: int) -> tuple[float, float]:
        """Returns length and width of the next step, which perhaps are drawn anew, m."""
        self._redraw_step(row)
        return float(self._length[row]), float(self._width[row])

    def _lay(
        self, rows: np.ndarray, which: int, feet: np.ndarray, places: np.ndarray, sizes: np.ndarray
    ) -> np.ndarray:
        """Enters into the plans where feet land while the other ones stand at places, on the ground.

        Args:
          rows: which simulations, (m,).
          which: of the plan's two steps.
          feet: which ones step, (m,).
          places: (m, 2) m.
          sizes: lengths and widths of the steps, (m, 2) m.

        Returns:
          The landing places, (m, 2) m.
        """
        steps = sizes.copy()
        steps[:, 1] *= SIDE[feet]
        places = places + quaternion.turned(steps, self.heading[rows])
        self.landing[rows, which, :2] = places
        heights = self.arena.height(places[:, :1], places[:, 1:], rows)
        self.landing[rows, which, 2] = heights[:, 0]
        return places

    def _head_for_goals(self, rows: np.ndarray, places: np.ndarray) -> None:
        """Plans to head from places (m, 2) for the goals, where these are not too near."""
        way = self.goal[rows, :2] - places
        headings = np.arctan2(way[:, 1], way[:, 0])
        far = np.hypot(way[:, 0], way[:, 1]) > NEAR_GOAL
        self.heading[rows[far]] = headings[far]

    def _steps_within(self, row: int, seconds: tuple[float, float]) -> int:
        return round(self._random[row].uniform(*seconds) / self.control_timestep)

    def act(self, action: np.ndarray) -> None:
        super().act(action)
        pushes = self.pushes
        if not pushes:
            return
        for row in np.flatnonzero(self._count >= self._push_begin).tolist():
            angle = self._random[row].uniform(-np.pi, np.pi)
            force = self._random[row].uniform(*pushes.force)
            self._push[row] = force * np.cos(angle), force * np.sin(angle), 0.0
            self._push_end[row] = self._count[row] + self._steps_within(row, pushes.duration)
            self._push_begin[row] = self._push_end[row] + self._steps_within(row, pushes.interval)
            self._excused[row] = self._push_end[row] + self._grace
        pushing = (self._count < self._push_end)[:, None]
        self.world.xfrc_applied[:, self._torso, :3] = self._push * pushing

    def _step(self, found: SimpleNamespace) -> None:
        stance = (self.phase >= 0.5).astype(int)
        switched = (stance != self.stance) & ~self.diverged  # what breaks down lands nowhere
        self.landed = switched
        self._missed = False
        if not switched.any():
            return
        rows = np.flatnonzero(switched)
        self.stance[rows] = stance[rows]  # the foot that has just landed
        gap = found.feet[rows, stance[rows], :2] - self.landing[rows, 0, :2]
        self.landing_error[rows] = np.hypot(gap[:, 0], gap[:, 1])
        self.heading_error[rows] = np.abs(rewards.wrap(self.heading[rows] - found.heading[rows]))
        if self.miss is not None:  # by the plan that was to be met
            self._missed = switched & (self.landing_error > self.miss)
            self._missed &= self._count > self._excused
        self._replan(rows, found)
        self._put_reference(rows, found, self._choose(rows, found))

    def _replan(self, rows: np.ndarray, found: SimpleNamespace) -> None:
        """Makes the next plans of some simulations, at a switch of stance."""
        plans, count = self.plans, len(rows)
        by_root, turns, sizes = np.zeros(count, bool), np.zeros(count), np.zeros((count, 2, 2))
        for i, row in enumerate(rows.tolist()):
            random = self._random[row]
            if plans.from_root and random.uniform() < plans.from_root:
                by_root[i] = True
                turns[i] = random.normal(0, plans.root_turn)
                for which in (0, 1):
                    ahead = random.uniform(*plans.root_length)
                    sizes[i, which] = ahead, random.uniform(*plans.root_width)
                continue
            if self.goal_given:
                root = found.root[row, :2]
                if np.hypot(*(root - self.goal[row, :2])) < GOAL_REACHED:
                    self.goal[row] = self.arena.goal(row, random, root, 'step')
            elif plans.sharp and random.uniform() < plans.sharp:
                turns[i] = random.uniform(-np.pi, np.pi)
                self._excused[row] = self._count[row] + self._grace
            elif plans.turn:
                turns[i] = random.normal(0, plans.turn)
            sizes[i, 1] = self._next_size(row)
        stance = self.stance[rows]
        on = ~by_root
        if on.any():
            going = rows[on]
            if self.goal_given:
                self._head_for_goals(going, self.landing[going, :, :2].mean(1))
            self.heading[going] += turns[on]
            self.landing[going, 0] = self.landing[going, 1]
            self._lay(going, 1, stance[on], self.landing[going, 0, :2], sizes[on, 1])
        if by_root.any():
            going, foot = rows[by_root], stance[by_root]
            off = np.clip(turns[by_root], -ROOT_TURN_LIMIT, ROOT_TURN_LIMIT)
            self.heading[going] = found.heading[going] + off
            places = found.feet[going, foot, :2]
            for which, feet in enumerate((1 - foot, foot)):
                places = self._lay(going, which, feet, places, sizes[by_root, which])

    def _choose(self, rows: np.ndarray, found: SimpleNamespace) -> np.ndarray:
        """Returns the steps nearest to the plans of some simulations."""
        feet = found.feet[rows]
        query = step_features(
            found.root[rows, :2], found.heading[rows], feet[:, RIGHT, :2], feet[:, LEFT, :2],
            self.landing[rows, 0, :2], self.heading[rows], self.stance[rows] == RIGHT,
        )  # fmt: skip
        return self.steps.select(query)

    def _put_reference(self, rows: np.ndarray, found: SimpleNamespace, chosen: np.ndarray) -> None:
        """Has the chosen steps begin where the characters are and as they head."""
        self._track[rows] = chosen + len(self.steps) * (self.stance[rows] == LEFT)
        columns = self.reference.columns
        now = self.reference.features(self.step_phase[rows], self._track[rows])
        turned = found.heading[rows] - now[:, columns['heading'].start]
        self._turned[rows] = turned
        self._shift[rows] = found.root[rows, :2] - quaternion.turned(
            now[:, columns['root']], turned
        )

    # Reward and observation.

    def _gone(self) -> np.ndarray | bool:
        return self._missed

    def _compare(self, found: SimpleNamespace) -> None:
        n, kinematics = len(found.features), self.figure.kinematics
        rows = np.arange(n)
        columns = kinematics.columns
        share = self.step_phase
        reference = self.reference.features(share, self._track)
        # The reference heads where the character did when it was put there.
        velocity = reference[:, columns['com_velocity']]
        reference[:, columns['com_velocity']][:, :2] = quaternion.turned(
            velocity[:, :2], self._turned
        )
        error = kinematics.compare(found.features, reference[:, : found.features.shape[1]])
        feet = error[:, self._effector_columns].reshape(n, 2, 3)
        late = share > 0.5
        swing = 1 - self.stance
        away = feet[rows, swing]
        away[late, :2] = 0.0  # in the second half the plan takes the place of the reference
        feet[rows, swing] = away
        raised = reference[:, columns['effectors']].reshape(n, 2, 3)[rows, swing, 2]
        step = self.landing[:, 0] - found.feet[rows, swing]
        step[:, 2] += raised
        step *= late[:, None]
        feet, step = (feet * feet).reshape(n, 6).sum(1), (step * step).sum(1)
        end = feet + self._footstep_scales[0] * step
        error *= error
        # Row by row, so that a row's sums do not depend on how many rows there are.
        pose, velocity, com, root = np.matmul(error[:, None], self._weights)[:, 0].T
        errors = np.stack([pose, velocity, end, com, root], axis=1)
        terms = self.reward_terms
        terms[:, :-1] = rewards.exponentials(errors, self._term_weights, self._term_scales)
        for scale in self._footstep_scales[1:]:
            end = feet + scale * step
            terms[:, _END] += self._term_weights[:, _END] * np.exp(self._term_scales[:, _END] * end)
        terms[:, _END] /= len(self._footstep_scales)
        self._off = rewards.wrap(self.heading - found.heading)
        error = np.minimum(self._heading_scale * np.abs(self._off), np.pi)
        terms[:, -1] = self._heading_weight * rewards.heading(error)

    def _write_extras(self, found: SimpleNamespace) -> None:
        n = len(found.features)
        rows = np.arange(n)
        self._observation[:, self._full['contact']] = found.contact
        plan = self._observation[:, self._full['plan']]
        feet = np.stack([1 - self.stance, self.stance], axis=1)  # which of them lands where
        way = self.landing - found.feet[rows[:, None], feet]
        way[..., 2] = self.landing[..., 2] - found.under
        way = turn(way, found.cosine, found.sine)
        slots = np.zeros((n, 2, 2, 3))  # first and second step; as seen from right and left foot
        slots[rows[:, None], np.arange(2), feet] = way
        plan[:, :12] = slots.reshape(n, 12)
        plan[:, 12] = self._off

    def _extra_mirror(self, name: str) -> Reflection:
        if name == 'contact':
            return np.array([1, 0]), np.ones(2)
        index = np.arange(13)
        index[:12] = np.arange(12).reshape(2, 2, 3)[:, ::-1].ravel()
        return index, np.append(np.tile([1.0, -1.0, 1.0], 4), -1.0)

    def _canonical_extras(self, extras: dict[str, int]) -> dict[str, int]:
        return {**extras, 'plan': 7}

    def _canonical_extra_columns(self, name: str) -> np.ndarray:
        columns = super()._canonical_extra_columns(name)
        if name == 'contact':
            return columns
        # Heading; the first step as seen from the left foot, the second from the right one.
        return columns[[12, 3, 4, 5, 6, 7, 8]]

    def infos(self) -> dict[str, Any]:
        """As for every task; and of the last foot that landed, whether it did so in this step.

        `landed` (n,) bool; `landing_error` m and `heading_error` rad, (n,), 0 before any landing.
        """
        return {
            **super().infos(),
            'landed': self.landed.copy(),
            'landing_error': self.landing_error.copy(),
            'heading_error': self.heading_error.copy(),
        }

    def markers(self, row: int) -> list[Marker]:
        """Where the feet are to land, which way the body is to head, and the goal."""
        yaw = float(self.heading[row])
        ahead = SOLE_AHEAD * np.array([np.cos(yaw), np.sin(yaw), 0.0])
        found = [
            Marker('box', place + ahead + (0, 0, SOLE[2]), SOLE, colour, yaw)
            for place, colour in zip(self.landing[row], (SWING_COLOUR, STANCE_COLOUR), strict=True)
        ]
        root = self.world.xpos[row, self.figure.kinematics.links[0]]
        found.append(Marker('arrow', root, (0.012, 0.012, 0.5), SWING_COLOUR, yaw))
        if self.goal_given:
            found.append(Marker('cylinder', self.goal[row], (0.15, 0.2, 0.0), GOAL_COLOUR))
        return found

    def reference_pose(self, row: int) -> np.ndarray:
        """Pose of the reference where it was put: root, then joints."""
        mirrored, index = divmod(int(self._track[row]), len(self.steps))
        time = self.step_phase[row] * self.steps.duration
        pose = self.steps.pose(index, time, bool(mirrored))
        pose[:2] = self._shift[row] + quaternion.turned(pose[:2], self._turned[row])
        pose[3:7] = quaternion.multiply(quaternion.about_z(self._turned[row]), pose[3:7])
        rows = np.array([row])
        pose[2] += self.arena.height(pose[None, :1], pose[None, 1:2], rows)[0, 0]
        return pose

    _KEPT: tuple[str, ...] = (
        'stance', 'landing', 'heading', '_length', '_width', '_track', '_turned', '_shift', 'goal',
        'landing_error', 'heading_error', 'landed', '_push', '_push_end', '_push_begin', '_excused',
    )  # fmt: skip
