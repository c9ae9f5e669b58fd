"""What tasks of a walker in three dimensions share: body, clock, actions, and how it is seen."""

from __future__ import annotations

import abc
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from trl_suite import actuation, errors
from trl_suite.action_map import Drive, drive
from trl_suite.arenas import SpatialTerrain
from trl_suite.characters import Character
from trl_suite.engine import World, native
from trl_suite.kinematics.spatial import (
    SpatialBody,
    SpatialFigure,
    SpatialMeasurement,
    SpatialState,
    write_body,
    write_terrain,
)
from trl_suite.kinematics.spatial import measure as measure_body
from trl_suite.kinematics.spatial_reference import mean_targets
from trl_suite.motion import Clip, Steps
from trl_suite.symmetry import Mirror
from trl_suite.tasks import reflection3d
from trl_suite.tasks.task import (
    MAX_JOINT_SPEED,
    MOST_SUBSTEPS,
    Outcome,
    Task,
    consecutive,
    drawn_seed,
    outcome,
    start_phases,
    too_fast,
)
from trl_suite.terrain import Ground, spatial_ground
from trl_suite.terrain.spatial_ground import SpatialGround
from trl_suite.util.compiled import compiled, compiled_loop

CONTROL_TIMESTEP = 1 / 30  # s
SUBSTEPS = 10  # physics at 300 Hz: trained walks score the same there and at 600 Hz, less below 180
HALF_RANGE = 1.0  # rad per unit action about the mean pose of the motion
PHASE_BINS = 4
MIRRORED_BINS = 2  # of the phase of a single step
CENTRES = ('clip', 'posture', 'original')  # of position control
_DIGITS = 1e9  # per cycle, to which the clock is rounded


class Clock(NamedTuple):
    """Where each simulation is in the cycle of its motion, (n,).

    Attributes:
      start: phase at the start of the episode.
      steps: control steps since.
      cycles: time on the motion in periods: the phase, not wrapped.
      phase: in [0, 1).
    """

    start: np.ndarray
    steps: np.ndarray
    cycles: np.ndarray
    phase: np.ndarray


class Travel(NamedTuple):
    """Where the walkers come from.

    Attributes:
      origin: x, y (m) and heading (rad) of the start, (n, 3).
      distance: of the root from there, (n,) m; in imitation along +x.
    """

    origin: np.ndarray
    distance: np.ndarray


class View(NamedTuple):
    """What of the full observation is given to the agent, perhaps in a mirror, and how it acts.

    Attributes:
      mirrored: whether left stance is seen as right stance.
      source, sign: a reflected full observation is `full[source] * sign`, (size,).
      phase: column of the phase in the full observation.
      kept: columns of the full observation that are given, (k,); all of them if it is empty.
      given_phase: column of the phase among them.
      action_index, action_sign: a reflected action is `action[index] * sign`.
    """

    mirrored: bool
    source: np.ndarray
    sign: np.ndarray
    phase: int
    kept: np.ndarray
    given_phase: int
    action_index: np.ndarray
    action_sign: np.ndarray


class SpatialRules(NamedTuple):
    """What the rules of all these tasks work on.

    Attributes:
      ctrl: controls of the physics, (n, ...).
      period: of the motion's cycle, s.
      terrain, pose, velocity, phase: where these blocks begin in the full observation; -1: nowhere.
      full: the full observation, (n, size).
      action: what joints are driven by, (n, k); scratch.
      leaving: whether the window of ground has to be laid anew, (n,).
    """

    engine: native.Engine
    body: SpatialBody
    physics: SpatialState
    ground: SpatialGround
    drive: Drive
    ctrl: np.ndarray
    period: float
    terrain: int
    pose: int
    velocity: int
    phase: int
    given: View
    clock: Clock
    travel: Travel
    found: SpatialMeasurement
    full: np.ndarray
    action: np.ndarray
    leaving: np.ndarray
    outcome: Outcome


# Parts of a step of simulation i.


@compiled
def act(i: int, action: np.ndarray, rules: SpatialRules) -> bool:
    """Drives the joints and keeps boxes moving; returns whether a window of ground must be laid.

    Ground is laid before the physics, so that what is rendered afterwards is up to date.
    """
    given = rules.given
    left = given.mirrored and rules.full[i, given.phase] >= 0.5
    for k in range(rules.action.shape[1]):
        if left:
            rules.action[i, k] = action[i, given.action_index[k]] * given.action_sign[k]
        else:
            rules.action[i, k] = action[i, k]
    drive(i, rules.action, rules.drive, rules.ctrl)
    return prepare_ground(i, rules)


@compiled
def prepare_ground(i: int, rules: SpatialRules) -> bool:
    """Keeps boxes moving before a control step.

    Returns:
      Whether the window of ground must be laid anew; who lays it keeps boxes moving as well.
    """
    root = rules.body.links[0]
    x, y = rules.physics.xpos[i, root, 0], rules.physics.xpos[i, root, 1]
    rules.leaving[i] = spatial_ground.has_left(i, x, y, rules.ground)
    if not rules.leaving[i] and spatial_ground.keep_moving(
        i, x, y, rules.physics.qpos, rules.physics.qvel, rules.ground
    ):
        native.forward(i, rules.engine)
    return rules.leaving[i]


@compiled
def tick(i: int, rules: SpatialRules) -> None:
    """Moves the clock on by a control step."""
    rules.clock.steps[i] += 1
    read_clock(i, rules)


@compiled
def read_clock(i: int, rules: SpatialRules) -> None:
    """Works out the phase."""
    clock = rules.clock
    cycles = clock.start[i] + clock.steps[i] * (CONTROL_TIMESTEP / rules.period)
    # Half a cycle is half a cycle, however it was counted.
    clock.cycles[i] = np.rint(cycles * _DIGITS) / _DIGITS
    clock.phase[i] = clock.cycles[i] - np.floor(clock.cycles[i])


@compiled
def breaks_down(i: int, rules: SpatialRules) -> bool:
    """Whether the physics has diverged; the last finite observation then stands."""
    diverged = native.diverged(i, rules.engine) or too_fast(
        i, rules.body.joint_dof, MAX_JOINT_SPEED, rules.physics.qvel
    )
    rules.outcome.diverged[i] = diverged
    return diverged


@compiled
def measure(i: int, rules: SpatialRules) -> None:
    """Measures the body, on the ground as it now is."""
    spatial_ground.see_movers(i, rules.physics.qpos, rules.ground)
    measure_body(i, rules.body, rules.physics, rules.ground, rules.found)
    x = rules.found.root[i, 0] - rules.travel.origin[i, 0]
    y = rules.found.root[i, 1] - rules.travel.origin[i, 1]
    rules.travel.distance[i] = np.sqrt(x * x + y * y)


@compiled
def observe_body(i: int, rules: SpatialRules) -> None:
    """Writes the blocks terrain, pose, velocity and phase of the full observation."""
    write_terrain(i, rules.terrain, rules.ground, rules.found, rules.full)
    write_body(i, rules.pose, rules.velocity, rules.found, rules.full)
    if rules.phase >= 0:
        phase = rules.clock.phase[i]
        rules.full[i, rules.phase] = phase
        for k in range(PHASE_BINS):
            rules.full[i, rules.phase + 1 + k] = np.floor(phase * PHASE_BINS) == k


@compiled
def publish(i: int, rules: SpatialRules) -> None:
    """Gives the agent what it is to see of the full observation."""
    given, full, observation = rules.given, rules.full, rules.outcome.observation
    left = given.mirrored and full[i, given.phase] >= 0.5
    for k in range(len(given.kept)):
        column = given.kept[k]
        if left:
            observation[i, k] = full[i, given.source[column]] * given.sign[column]
        else:
            observation[i, k] = full[i, column]
    if given.mirrored:  # the phase of the single step
        phase = full[i, given.phase]
        observation[i, given.given_phase] = 2 * (phase - 0.5 if left else phase)


@compiled_loop
def act_all(env_ids: np.ndarray, action: np.ndarray, rules: SpatialRules) -> int:
    """Takes actions; returns how many windows of ground must be laid. Takes a pack."""
    leaving = 0
    for i in env_ids:
        leaving += act(i, action, rules)
    return leaving


class SpatialTask(Task):
    """A walker in three dimensions with a clock of the period of its motion.

    A subclass says how an episode starts, what a step is worth, and what else is observed; it adds
    its blocks behind terrain, pose, velocity and phase.

    Attributes:
      figure: the character in every simulation.
      clock: where each simulation is in its cycle.
      period: of that, s.
      mirror: how a policy may reflect what it observes; None if there is nothing to reflect.
    """

    TERMS: Mapping[str, tuple[float, float]]  # reward terms: weight, and scale of the error
    ABOUT = 'com'  # from where end effectors are measured, or 'root'
    fields: tuple[str, ...] = SpatialFigure.fields
    period: float

    def __init__(
        self,
        character: Character,
        arena: SpatialTerrain,
        motion: Clip | Steps,
        *,
        actuation_model: str = 'position',
        substeps: int = SUBSTEPS,
        centre: str = 'clip',
        half_range: float | None = None,
        start_phase: float | Sequence[Sequence[float]] | None = None,
        terrain_map: bool = False,
        mirrored: bool = False,
        blend: float = 0.0,
        phase: bool = True,
        extras: Mapping[str, int],
    ) -> None:
        """Composes the task; see the subclasses.

        Raises:
          ValueError: options out of range, or a motion that does not fit the character.
        """
        row = character.row
        check_motion(character, motion)
        check_drive(actuation_model, centre, half_range, substeps)
        if mirrored and not row.mirror:
            raise ValueError(
                f'character {row.name!r} has no pairs of right and left links; mirrored observations '
                'need them'
            )
        if mirrored and not phase:
            raise ValueError('mirrored observations need the phase, which tells left from right')
        self.character, self.arena, self.motion = character, arena, motion
        self.actuation_model, self.terrain_map = actuation_model, terrain_map
        self.mirrored = mirrored
        self._start_phase, self._blend = start_phases(start_phase), blend
        self.figure = SpatialFigure(character, arena, terrain_map)
        self.set_timesteps(CONTROL_TIMESTEP, CONTROL_TIMESTEP / substeps)
        options: dict[str, Any] = {}
        if actuation_model == 'position':
            options = position_range(self._typical_poses(), motion, centre, half_range)
        self.action_map = actuation.add(
            character, actuation_model, self.physics_timestep, **options
        )
        self.joint_map = self.action_map  # from actions to the actuators
        full = {**self.figure.blocks, 'phase': 1 + PHASE_BINS if phase else 0, **extras}
        self._full = self.blocks = consecutive(full)
        self._reflection = self._reflected() if phase and row.mirror else None
        self.mirror: Mirror | None = self._reflection
        self._kept: np.ndarray = np.zeros(0, int)  # all
        if mirrored:
            self.mirror = None  # what is mirrored already has nothing to reflect
            self._kept = self._canonical_columns()
            self.blocks = consecutive({
                **self.figure.blocks, 'phase': 1 + MIRRORED_BINS, **self._canonical_extras(extras)
            })  # fmt: skip

    # What a subclass has.

    @abc.abstractmethod
    def _typical_poses(self) -> np.ndarray:
        """Returns poses whose mean is action 0 of position control, (k, columns of a pose)."""

    @abc.abstractmethod
    def _start(
        self, env_ids: np.ndarray, random_states: Sequence[np.random.RandomState]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Begins the grounds of some simulations; returns poses, rates, spawns: see `figure.place`.

        Phases must be in `clock.start` afterwards.
        """

    @abc.abstractmethod
    def _extra_mirror(self, name: str) -> reflection3d.Reflection:
        """Returns how a block of the subclass is reflected."""

    def _canonical_extras(self, extras: Mapping[str, int]) -> Mapping[str, int]:
        """Returns blocks of the subclass, with their sizes, as mirrored observations have them."""
        return extras

    def _canonical_extra_columns(self, name: str) -> np.ndarray:
        """Returns which columns of a block of the subclass mirrored observations keep."""
        part = self._full[name]
        return np.arange(part.start, part.stop)

    def _begun_on_ground(self, env_ids: np.ndarray) -> None:
        """What a subclass does once the characters of some simulations stand."""

    # Binding.

    @property
    def root_entity(self) -> SpatialTerrain:
        return self.arena

    @property
    def signature(self) -> str:
        parts = self.character.row.name, self.arena.terrain.name, self.motion.name
        return f'{super().signature} of {" / ".join(parts)}'

    def _bind_rules(self, world: World) -> SpatialRules:
        """Binds what all these tasks have; the subclass sets `saved` and `info_arrays` up."""
        self.world, n = world, world.n
        figure = self.figure
        figure.bind(world, self.ABOUT)
        self.clock = Clock(np.zeros(n), np.zeros(n, int), np.zeros(n), np.zeros(n))
        self.travel = Travel(np.zeros((n, 3)), np.zeros(n))
        self._random = [np.random.default_rng(0)] * n  # what is drawn within an episode
        size = max(part.stop for part in self.blocks.values())
        self.outcome = outcome(n, size, len(self.TERMS))
        self._full_observation = self.outcome.observation
        if self.blocks is not self._full:
            size = max(part.stop for part in self._full.values())
            self._full_observation = np.zeros((n, size))
        scope = f'{self.character.mjcf_model.model}/'
        # Actuators were added one after the other.
        first = int(world.control_addresses([scope + self.joint_map.actuators[0]])[0])
        starts = {name: part.start for name, part in self._full.items()}
        self.info_arrays = {
            'reward_terms': dict(zip(self.TERMS, self.outcome.reward_terms.T, strict=True)),
            'fell': self.outcome.fell,
            'diverged': self.outcome.diverged,
            'distance': self.travel.distance,
        }
        self.saved = (
            self.clock, self.travel, self.outcome, Full(self._full_observation),
        )  # fmt: skip
        return SpatialRules(
            world.engine, figure.body, figure.state, figure.ground, self.joint_map.drive(first),
            world.ctrl, self.period, starts.get('terrain', -1), starts['pose'],
            starts['velocity'], starts.get('phase', -1), self._view(), self.clock, self.travel,
            figure.found, self._full_observation, np.zeros((n, len(self.joint_map))),
            np.zeros(n, bool), self.outcome,
        )  # fmt: skip

    def _view(self) -> View:
        mirror, none = self._reflection, np.zeros(0, int)
        if mirror is None or not self.mirrored:
            return View(False, none, np.zeros(0), 0, self._kept, 0, none, np.zeros(0))
        assert mirror.phase is not None
        return View(
            True, mirror.observation_index, mirror.observation_sign, mirror.phase, self._kept,
            self.blocks['phase'].start, mirror.action_index, mirror.action_sign,
        )  # fmt: skip

    @property
    def phase(self) -> np.ndarray:
        """Phase of the cycle in [0, 1), (n,)."""
        return self.clock.phase

    @property
    def cycles(self) -> np.ndarray:
        """Time on the motion in periods: the phase, not wrapped, (n,)."""
        return self.clock.cycles

    # Episodes.

    def reset(self, env_ids: np.ndarray, random_states: Sequence[np.random.RandomState]) -> None:
        self.world.reset(env_ids)
        self.clock.steps[env_ids] = 0
        poses, rates, spawns = self._start(env_ids, random_states)
        self.travel.origin[env_ids] = spawns
        self.figure.place(env_ids, poses, rates, spawns)
        for array in self.outcome[1:]:  # all but the observation
            array[env_ids] = 0
        self._begun_on_ground(env_ids)
        self.observe(env_ids)
        self.outcome.reward_terms[env_ids] = 0.0

    def _begin_grounds(
        self, env_ids: np.ndarray, random_states: Sequence[np.random.RandomState]
    ) -> np.ndarray:
        """Draws phases, grounds, generators and starts of simulations; returns spawns, (m, 3)."""
        spawns = np.zeros((len(env_ids), 3))
        for k, (i, random_state) in enumerate(zip(env_ids.tolist(), random_states, strict=True)):
            drawn = random_state.random_sample()
            self.clock.start[i] = self._start_phase(drawn)
            ground = Ground(self.arena.terrain, drawn_seed(random_state), blend=self._blend)
            self._random[i] = np.random.default_rng(drawn_seed(random_state))
            spawns[k] = ground.spawn(self._random[i])
            self.arena.begin_episode(i, ground, spawns[k, :2])
        self._begin_clocks(env_ids)
        return spawns

    def _begin_clocks(self, env_ids: np.ndarray) -> None:
        """Sets the clocks of some simulations to `clock.start`."""
        cycles = np.rint(self.clock.start[env_ids] * _DIGITS) / _DIGITS
        self.clock.cycles[env_ids], self.clock.phase[env_ids] = cycles, cycles - np.floor(cycles)

    def _lay_ground(self, env_ids: np.ndarray, rules: SpatialRules) -> None:
        """Lays the windows of ground anew that some simulations are leaving."""
        leaving = env_ids[rules.leaving[env_ids]]
        self.arena.follow(self.world.xpos[leaving, self.figure.links[0], :2], leaving)

    def get_state(self, env_id: int) -> dict[str, Any]:
        return {
            **super().get_state(env_id),
            'random': self._random[env_id].bit_generator.state,
        }

    def set_state(self, env_id: int, state: dict[str, Any]) -> None:
        super().set_state(env_id, state)
        self._random[env_id] = np.random.default_rng(0)
        self._random[env_id].bit_generator.state = state['random']

    # Left and right.

    def _reflected(self) -> Mirror:
        """How full observations and actions are reflected."""
        parts = reflection3d.body(self.character)
        parts['phase'] = reflection3d.phase(PHASE_BINS)
        parts |= {name: self._extra_mirror(name) for name in self._full if name not in parts}
        return Mirror(
            *reflection3d.joined(self._full, parts),
            *reflection3d.actions(self.character, self.action_map),
            self._full['phase'].start,
        )

    def _canonical_columns(self) -> np.ndarray:
        """Which columns of a full observation in right stance a mirrored one has."""
        columns = []
        for name, part in self._full.items():
            if name == 'phase':
                columns.append(np.arange(part.start, part.start + 1 + MIRRORED_BINS))
            elif name in self.figure.blocks:
                columns.append(np.arange(part.start, part.stop))
            else:
                columns.append(self._canonical_extra_columns(name))
        return np.concatenate(columns)


class Full(NamedTuple):
    """The full observation as a part of the state of a task, (n, size)."""

    observation: np.ndarray


def check_motion(character: Character, motion: Clip | Steps) -> None:
    """Checks that a motion is one of a spatial character.

    Raises:
      ValueError: it is not; the message has the joints of both.
    """
    row = character.row
    if not row.spatial or tuple(motion.joints) != tuple(row.joints):
        raise ValueError(
            f'motion {motion.name!r} (joints {", ".join(motion.joints)}) does not fit character '
            f'{row.name!r}: expected a spatial character with these joints, not '
            f'{"one" if row.spatial else "a planar one"} with {", ".join(row.joints)}'
        )


def check_drive(actuation_model: str, centre: str, half_range: float | None, substeps: int) -> None:
    """Checks the options of actuation and time.

    Raises:
      ValueError: they are out of range, or do not fit each other.
    """
    if centre not in CENTRES:
        raise ValueError(errors.unknown('centre of position control', centre, CENTRES))
    if actuation_model != 'position' and (centre != 'clip' or half_range is not None):
        raise ValueError(
            f'centre and half_range shape position control, not {actuation_model} control'
        )
    if centre == 'original' and half_range is not None:
        raise ValueError("centre 'original' has ranges of its own: give no half_range")
    if half_range is not None and not 0 < half_range < np.inf:
        raise ValueError(f'half_range is {half_range}; expected a positive number of radians')
    errors.check_whole('substeps', substeps, 6, MOST_SUBSTEPS, ' (physics at 180 Hz to 30 kHz)')


def position_range(
    typical_poses: np.ndarray, motion: Clip | Steps, centre: str, half_range: float | None
) -> dict[str, Any]:
    """Returns the options of position control for a centre and a half range."""
    if centre == 'original':
        return {'rotations': 'angle_axis'}
    options: dict[str, Any] = {} if half_range is None else {'half_range': half_range}
    if centre == 'clip':
        options.setdefault('half_range', HALF_RANGE)
        options['centre'] = mean_targets(typical_poses, motion)
    return options
