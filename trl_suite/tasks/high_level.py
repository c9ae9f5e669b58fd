"""Walking somewhere by planning footsteps: the high-level tasks above a footstep controller.

Source: the hike scenarios of the original; 'DeepLoco: dynamic locomotion skills using hierarchical
deep reinforcement learning' (Peng, Berseth, Yin, van de Panne 2017).
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from types import MappingProxyType, SimpleNamespace
from typing import Any

import numpy as np

from trl_suite import errors
from trl_suite.action_map import ActionMap
from trl_suite.arenas import SpatialTerrain
from trl_suite.characters import Character
from trl_suite.controllers import llc
from trl_suite.engine import World
from trl_suite.motion import Steps, quaternion
from trl_suite.symmetry import Mirror
from trl_suite.tasks import reflection3d, rewards
from trl_suite.tasks.figure3d import polar
from trl_suite.tasks.footsteps import GOAL_COLOUR, GOAL_REACHED, Footsteps
from trl_suite.tasks.plans import span
from trl_suite.tasks.task import (
    MAX_JOINT_SPEED,
    Marker,
    check_simulated,
    consecutive,
    drawn_seed,
    drawn_way,
)
from trl_suite.tasks.trace import Trace
from trl_suite.tasks.tracking3d import CONTROL_TIMESTEP, SUBSTEPS
from trl_suite.terrain import Ground
from trl_suite.terrain.surroundings import SAMPLES

INTERFACES = ('plan', 'frame')
SIGHTS = ('height', 'velocity')
# What action 0 means, in step lengths, and what 1 adds: x and y of both landing places, m; turn of the
# heading, rad.
PLAN_NAMES: tuple[str, ...] = ('first_x', 'first_y', 'second_x', 'second_y', 'turn')
PLAN_SIGNS = (1.0, -1.0, 1.0, -1.0, -1.0)  # in a mirror
PLAN_CENTRE = np.array([1.0, 0.0, 2.0, 0.0, 0.0])
STEP_LENGTH = 0.5  # m
PLAN_HALF_RANGE = np.array([1.0, 1.0, 2.0, 2.0, np.pi])
SPEED_SHARPNESS = 1.5
UPRIGHT = 0.2  # reward for being on one's feet
GOAL_LASTS = (50.0, 100.0)  # s until a goal that was not reached is drawn anew
HIKE_TERMS = {'speed': (1 - UPRIGHT, SPEED_SHARPNESS), 'upright': (UPRIGHT, 0.0)}
FADING, SHARE, FALLEN = 0.9, 1 / 11, 0.25  # of the running share of samples that touch the ground
SAMPLE_FRAMES = 3  # control steps between two of them: 0.1 s
FARTHEST_GOAL = 100.0  # m; to which goals may be asked for
LONGEST = 60  # control steps of a step; the clock switches stance long before
FLAG = (0.1, 0.6, 0.0)  # m; marker of the goal: radius and half height


class HighLevel(Footsteps):
    """A spatial biped goes from goal to goal; an action is a plan of two footsteps and a heading.

    A step lasts from one switch of stance to the next, half a cycle of the footstep controller that
    drives the joints inside; the first of an episode may be shorter. The plan is laid out from the
    root's place on the ground and its heading at the beginning of the step: where the foot that
    swings lands, where the other one lands after it, and the heading to have.

    Observation blocks, in this order (heading frame: x along the root's heading, y to the left):
      terrain: the 32 x 32 map of `Surroundings.height_map`, m, if it sees heights.
      surface: the two 32 x 32 maps of `Surroundings.velocity_map`, m/s, if it sees velocities.
      pose, velocity: as in `SpatialImitation`.
      target: bearing of the goal, rad to the left, and its distance, m.
      low_level: what the footstep controller observes, with interface 'frame' only.
    """

    TERMS = HIKE_TERMS
    GOAL_REACHED = GOAL_REACHED  # m; by default
    # Blocks that say where to go, with the sign that each number has in a mirror.
    GOAL_BLOCKS: Mapping[str, tuple[float, ...]] = MappingProxyType({'target': (-1.0, 1.0)})

    watch: Callable[[], None] | None = None  # called at every 1/30 s of the first simulation

    def __init__(
        self,
        character: Character,
        arena: SpatialTerrain,
        steps: Steps,
        *,
        controller: Any = llc.DEFAULT,
        interface: str = 'plan',
        sight: Collection[str] = ('height',),
        step_length: float = STEP_LENGTH,
        target_speed: float = 1.0,
        goal_reached: float | None = None,
        goal_distance: tuple[float, float] | None = None,
        start_phases: Sequence[float] = (0.1, 0.6),
        substeps: int = SUBSTEPS,
        blend: float = 0.0,
    ) -> None:
        """Composes the task.

        Args:
          character: a spatial biped without actuators; it is attached to the arena.
          arena: where it walks.
          steps: library of single steps of this character, for the first pose and the clock.
          controller: the footstep controller: what `trl_suite.controllers.llc.load` takes.
          interface: 'plan', or 'frame': a step is 1/30 s, and behind the plan, which counts when it
            begins a footstep, an action has that of the footstep controller.
          sight: which maps are observed, of 'height' and 'velocity'.
          step_length: of the steps that action 0 means, m.
          target_speed: m/s towards the goal from which on the reward is full.
          goal_reached: m; nearer, a goal is drawn anew. By default `GOAL_REACHED`.
          goal_distance: m; the least and the most, up to 100, from the walker (in soccer: from the
            ball), in any direction, at which goals are drawn: for open ground. By default they are
            where the terrain has them.
          start_phases: of the clock, one of which every episode starts with.
          substeps: physics steps per 1/30 s.
          blend: which mixture of the terrain's parameter sets to draw from.

        Raises:
          ValueError: options out of range, or parts that do not fit each other.
        """
        if interface not in INTERFACES:
            raise ValueError(errors.unknown('interface', interface, INTERFACES))
        sight = (sight,) if isinstance(sight, str) else tuple(sight)
        for each in sight:
            if each not in SIGHTS:
                raise ValueError(errors.unknown('sight', each, SIGHTS))
        goal_reached = self.GOAL_REACHED if goal_reached is None else goal_reached
        for name, value in (
            ('step_length', step_length), ('target_speed', target_speed),
            ('goal_reached', goal_reached),
        ):  # fmt: skip
            if not 0 < value < np.inf:
                raise ValueError(f'{name} is {value}; expected a positive number')
        if goal_distance is not None:
            goal_distance = span('goal_distance', goal_distance, 'm')
            if goal_distance[1] > FARTHEST_GOAL:
                raise ValueError(
                    f'goal_distance is {goal_distance}; expected at most {FARTHEST_GOAL:g} m'
                )
        if not len(start_phases) or not all(0 <= phase < 1 for phase in start_phases):
            raise ValueError(f'start_phases is {start_phases}; expected numbers in [0, 1)')
        self._furnish(arena)
        super().__init__(character, arena, steps, substeps=substeps, blend=blend)
        self.controller = llc.load(controller)
        self.controller.check(self)
        self.interface, self.sight, self.step_length = interface, sight, step_length
        self._target_speed, self._goal_reached = target_speed, goal_reached
        self._goal_distance = goal_distance
        self._start_phases = tuple(start_phases)
        self._frame = substeps
        low = max(part.stop for part in self._full.values())
        centre, half_range, names = step_length * PLAN_CENTRE, PLAN_HALF_RANGE, PLAN_NAMES
        if interface == 'frame':
            drive = self._drive
            names = (*names, *drive.names)
            centre = np.concatenate([centre, np.zeros(len(drive))])
            half_range = np.concatenate([half_range, np.ones(len(drive))])
        else:
            self.set_timesteps(steps.duration, CONTROL_TIMESTEP / substeps)
        self.action_map = ActionMap(names, 'footstep plan', 'm (turn: rad)', centre, half_range)
        pose = {name: size for name, size in self.figure.blocks.items() if name != 'terrain'}
        self.blocks = consecutive({
            'terrain': SAMPLES**2 if 'height' in sight else 0,
            'surface': 2 * SAMPLES**2 if 'velocity' in sight else 0,
            **pose,
            **{name: len(signs) for name, signs in self.GOAL_BLOCKS.items()},
            'low_level': low if interface == 'frame' else 0,
        })  # fmt: skip
        mirrors = interface == 'plan' and self.character.row.mirror
        self.mirror = self._plan_mirror() if mirrors else None

    def _furnish(self, arena: SpatialTerrain) -> None:
        """Adds what is there beside the ground."""

    def _plan_mirror(self) -> Mirror:
        """How observations and plans are reflected."""
        parts = reflection3d.body(self.character)
        lines, _ = parts['terrain']
        ahead = np.ones(len(lines))
        parts['surface'] = np.append(lines, len(lines) + lines), np.append(ahead, -ahead)
        for name, signs in self.GOAL_BLOCKS.items():
            parts[name] = np.arange(len(signs)), np.array(signs)
        index, sign = reflection3d.joined(self.blocks, parts)
        links = list(self.character.row.links)
        feet = [links.index(name) for name in self.character.row.end_effectors]
        right, left = self.blocks['pose'].start + 1 + len(reflection3d.POSE) * np.array(feet)
        return Mirror(
            index, sign, np.arange(len(PLAN_SIGNS)), np.array(PLAN_SIGNS), feet=(right, left)
        )

    def bind(self, world: World) -> None:
        super().bind(world)
        n = world.n
        self.observation = np.zeros((n, max(part.stop for part in self.blocks.values())))
        self._action = np.zeros((n, len(self.action_map)))
        self._lasted = np.zeros(n, int)  # control steps of the last step
        self._from = np.zeros((n, 3))  # m; centre of mass at its beginning
        self._down = np.zeros(n)  # running share of samples with a fall link on the ground
        self._due = np.zeros(n, int)  # control step of the episode at which the goal is drawn anew
        self.goals_reached = np.zeros(n, int)  # in the episode
        self.trace = Trace(n)  # of the centre of mass
        self._places = self.trace.places
        self._speed = np.zeros(n)  # m/s towards the goal, in the last step

    # Episodes.

    def _start(
        self, rows: np.ndarray, random_states: Sequence[np.random.RandomState]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        spawns = np.zeros((len(rows), 3))
        for i, (row, random_state) in enumerate(zip(rows.tolist(), random_states, strict=True)):
            ground = Ground(self.arena.terrain, drawn_seed(random_state), blend=self._blend)
            random = self._random[row] = np.random.default_rng(drawn_seed(random_state))
            self._start_cycles[row] = random.choice(self._start_phases)
            spawns[i] = ground.spawn(random)
            self.arena.begin_episode(row, ground, spawns[i, :2])
        return self._pose_of_start(rows, spawns)

    def _begun_on_ground(self, rows: np.ndarray) -> None:
        self.landing_error[rows] = self.heading_error[rows] = self._down[rows] = 0.0
        self.landed[rows] = False
        self._lasted[rows] = self.goals_reached[rows] = 0
        self._speed[rows] = 0.0
        self.trace.begin(rows)
        found = self.figure.measure()
        for row in rows.tolist():
            self._begin_goal(row, found)
        # Until the first action there is no plan; the places under the feet stand for it.
        self.heading[rows] = found.heading[rows]
        swing = 1 - self.stance[rows]
        self.landing[rows, 0] = found.feet[rows, swing]
        self.landing[rows, 1] = found.feet[rows, self.stance[rows]]

    def _begin_goal(self, row: int, found: SimpleNamespace) -> None:
        """Draws what is to be reached in an episode."""
        self._draw_goal(row, found.root[row, :2])

    def _draw_goal(self, row: int, place: np.ndarray) -> None:
        self.goal[row] = self._goal_drawn(row, place)
        lasts = self._random[row].uniform(*GOAL_LASTS)
        self._due[row] = self._count[row] + round(lasts / CONTROL_TIMESTEP)

    def _goal_drawn(self, row: int, place: np.ndarray) -> np.ndarray:
        """Returns a goal for a walker at a place, (3,) m."""
        random = self._random[row]
        if self._goal_distance is None:
            return self.arena.goal(row, random, place)
        x, y = place + drawn_way(random, *self._goal_distance)
        height = self.arena.height(np.array([[x]]), np.array([[y]]), np.array([row]))
        return np.array([x, y, height[0, 0]])

    # A step.

    def act(self, action: np.ndarray) -> None:
        self._action[...] = np.clip(action, -1, 1)

    def simulate(self, rows: np.ndarray | None = None) -> None:
        """Runs each row to the next switch of stance, or for a frame."""
        rows = np.arange(self.world.n) if rows is None else rows
        if not len(rows):  # all have just begun an episode
            return
        found = self.figure.measure()
        by_plan = self.interface == 'plan'
        new = rows if by_plan else self._beginning(rows)
        if len(new):
            self._lay_plans(new, found)
        self._lasted[rows] = 0
        self._from[rows] = found.com[rows]
        self.landed[rows] = False
        going = rows
        while len(going):
            if by_plan:
                self._write_low(found)
                action = self.controller(self._observation[going])
            else:
                action = self._action[going, len(PLAN_NAMES) :]
            self._ctrl[going] = self._drive.control(action)
            self.arena.follow(found.root[going, :2], going)
            self.world.step(self._frame, None if len(going) == self.world.n else going)
            self._count[going] += 1
            self._lasted[going] += 1
            found = self.figure.measure()
            over = self._account(going, found)
            self.trace.follow(going, self._count[going], found.com[going])
            if self.watch is not None:
                self.watch()
            going = going[~over] if by_plan else going[:0]

    def _beginning(self, rows: np.ndarray) -> np.ndarray:
        """Which of some rows begin a footstep now."""
        return rows[self.landed[rows] | (self._count[rows] == 0)]

    def lay(self, action: np.ndarray) -> np.ndarray:
        """Lays out plans where a footstep begins, as the step to come would with the same actions.

        With the interface 'frame' a footstep controller can so see a plan before it acts by it.

        Args:
          action: (n, k), in [-1, 1]; what lies behind the plan does not count.

        Returns:
          What the footstep controller observes now, (n, size); the observation has it as well.

        Raises:
          ValueError: actions of another shape, or with NaN or infinity.
        """
        action = self.action_map.checked(action, self.world.n)
        found = self.figure.measure()
        rows = self._beginning(np.arange(self.world.n))
        self.act(action)
        if len(rows):
            self._lay_plans(rows, found)
        self._write_low(found)
        if 'low_level' in self.blocks:
            self.observation[:, self.blocks['low_level']] = self._observation
        return self._observation.copy()

    def _lay_plans(self, rows: np.ndarray, found: SimpleNamespace) -> None:
        """Lays out the plans of some rows from where they are."""
        plan = self.action_map.control(self._action)[rows]
        heading = found.heading[rows]
        steps = plan[:, :4].reshape(-1, 2, 2)
        places = found.root[rows, None, :2] + quaternion.turned(steps, heading[:, None])
        self.landing[rows, :, :2] = places
        self.landing[rows, :, 2] = self.arena.height(places[..., 0], places[..., 1], rows)
        self.heading[rows] = heading + plan[:, 4]

    def _account(self, rows: np.ndarray, found: SimpleNamespace) -> np.ndarray:
        """Landings and falls of rows after a control step; returns whose step is over, (m,) bool."""
        rates = self.world.qvel[rows][:, self.figure.kinematics.joint_dof]
        self.diverged[rows] = ~(np.abs(rates) < MAX_JOINT_SPEED).all(1)
        self.diverged[rows] |= self.world.diverged()[rows]
        sampled = rows[self._count[rows] % SAMPLE_FRAMES == 0]
        self._down[sampled] *= FADING
        self._down[sampled] += SHARE * found.fall[sampled].any(1)
        self.failed[rows] = (self._down[rows] > FALLEN) | self.diverged[rows]
        stance = (self.phase[rows] >= 0.5).astype(int)
        switched = (stance != self.stance[rows]) & ~self.diverged[rows]
        landed = rows[switched]
        self.landed[landed] = True
        self.stance[landed] = stance[switched]
        gap = found.feet[landed, self.stance[landed], :2] - self.landing[landed, 0, :2]
        self.landing_error[landed] = np.hypot(gap[:, 0], gap[:, 1])
        off = rewards.wrap(self.heading[landed] - found.heading[landed])
        self.heading_error[landed] = np.abs(off)
        return switched | self.failed[rows] | (self._lasted[rows] >= LONGEST)

    def finish_step(self, stepped: np.ndarray | None = None) -> None:
        rows = np.arange(self.world.n) if stepped is None else np.flatnonzero(stepped)
        check_simulated(self._lasted[rows])
        found = self.figure.measure()
        self._reward_terms(rows, found)
        self.reward_terms[self.failed] = 0.0
        for row in rows[~self.failed[rows]].tolist():
            self._look_at_goal(row, found)
        kept = self.observation[self.diverged]
        with np.errstate(invalid='ignore'):
            self._write(found)
        self.observation[self.diverged] = kept  # the last finite one stands for what broke down
        np.add.reduce(self.reward_terms, axis=1, out=self.reward)

    def _reward_terms(self, rows: np.ndarray, found: SimpleNamespace) -> None:
        """Writes the reward terms of rows for the step that they have taken."""
        way = self.goal[rows, :2] - self._from[rows, :2]
        distance = np.hypot(way[:, 0], way[:, 1])
        moved = found.com[rows, :2] - self._from[rows, :2]
        seconds = CONTROL_TIMESTEP * np.maximum(self._lasted[rows], 1)
        along = (moved * way).sum(1) / np.maximum(distance, 1e-9)
        self._speed[rows] = along / seconds
        lack = np.minimum(self._speed[rows] - self._target_speed, 0.0)
        full = distance < self._goal_reached
        speed, _ = self.TERMS['speed']
        self.reward_terms[rows, 0] = speed * np.where(full, 1.0, np.exp(-SPEED_SHARPNESS * lack**2))
        self.reward_terms[rows, 1] = UPRIGHT

    def _look_at_goal(self, row: int, found: SimpleNamespace) -> None:
        """Draws the next goal where one was reached, or not in time."""
        place = found.root[row, :2]
        reached = np.hypot(*(self.goal[row, :2] - place)) < self._goal_reached
        self.goals_reached[row] += reached
        if reached or self._count[row] >= self._due[row]:
            self._draw_goal(row, place)

    def observe(self, env_ids: np.ndarray | None = None) -> None:
        self._write(self.figure.measure())

    def _write(self, found: SimpleNamespace) -> None:
        """Writes all blocks."""
        blocks, place = self.blocks, found.root[:, :2]
        if 'terrain' in blocks:
            self.arena.height_map(place, found.heading, out=self.observation[:, blocks['terrain']])
        if 'surface' in blocks:
            self.arena.velocity_map(
                place, found.heading, out=self.observation[:, blocks['surface']]
            )
        self.figure.write(found, self.observation, blocks)
        self._write_goal(found)
        if 'low_level' in blocks:
            self._write_low(found)
            self.observation[:, blocks['low_level']] = self._observation

    def _write_goal(self, found: SimpleNamespace) -> None:
        target = self.observation[:, self.blocks['target']]
        target[...] = polar(self.goal[:, None, :2] - found.root[:, None, :2], found)

    def _write_low(self, found: SimpleNamespace) -> None:
        """Writes what the footstep controller observes."""
        self.figure.write(found, self._observation, self._full)
        self._write_phase()
        self._off = rewards.wrap(self.heading - found.heading)
        self._write_extras(found)

    def infos(self) -> dict[str, Any]:
        """As for footsteps; and goals reached, speed towards the goal (m/s), duration (s)."""
        return {
            **super().infos(),
            'goals_reached': self.goals_reached.copy(),
            'speed': self._speed.copy(),
            'duration': CONTROL_TIMESTEP * self._lasted,
        }

    reference_pose = None  # type: ignore[assignment]  # nothing is tracked

    def markers(self, row: int) -> list[Marker]:
        """The plan, the way of the centre of mass, and the goal."""
        return [*super().markers(row), *self.trace.markers(row), flag(self.goal[row])]

    _KEPT = (
        *Footsteps._KEPT, '_lasted', '_from', '_down', '_due', 'goals_reached', '_speed', '_action',
        '_places',
    )  # fmt: skip


def flag(goal: Any) -> Marker:
    """Returns what stands at a goal (3,), m."""
    return Marker('cylinder', np.add(goal, (0, 0, FLAG[1])), FLAG, GOAL_COLOUR)
