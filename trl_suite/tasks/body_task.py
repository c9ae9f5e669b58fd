"""A task for a body on random ground whose joints are controlled 30 times per second."""

from __future__ import annotations

import abc
from collections.abc import Sequence
from typing import Any

import numpy as np

from trl_suite import actuation
from trl_suite.arenas import PlanarArena, SpatialArena
from trl_suite.bodies.body import Travel
from trl_suite.bodies.planar import PlanarBody
from trl_suite.bodies.reference import CONTROL_TIMESTEP, DIGITS, Clock
from trl_suite.bodies.spatial import SpatialBody
from trl_suite.bodies.state import allocated
from trl_suite.characters import Character
from trl_suite.engine import World
from trl_suite.motion import Clip, FootstepLibrary
from trl_suite.tasks.common.control import check_motion, cycle_poses, joint_options
from trl_suite.tasks.common.footstep_plan import straight_step, typical_poses
from trl_suite.tasks.task import Task
from trl_suite.terrain import PlanarGround, SpatialGround
from trl_suite.util.compiled import Compiled, packed

VIEW_BEHIND, VIEW_AHEAD = 0.5, 3.0  # m; range of observed ground heights in the plane


class BodyTask(Task):
    """A body on random ground whose joints are controlled; a subclass defines what it is to do.

    Attributes:
      body: the body in every simulation.
      joint_map: the map from actions of the joints to actuators.
      travel: start of each episode, and the distance from it.
      motion: the motion that the character is to perform, if there is one; also `clip`, or `steps`.
      clock: phase of each simulation in a cycle of this motion.
      period: duration of a cycle, of two steps, s.
      finish_all, observe_all: compiled functions of indices and pack: they finish steps, and write
        the observations of current states, after the bodies were measured.
    """

    ABOUT_COM = True  # end effectors are relative to the centre of mass, not to the root
    length = 0.0  # m; of the step of a library with which episodes start
    strain = True  # whether the strain of muscles is observed
    body: Any  # PlanarBody or SpatialBody
    motion: Any  # Clip or FootstepLibrary
    finish_all: Compiled
    observe_all: Compiled
    _first: int  # index of the step with which episodes start

    def __init__(
        self,
        character: Character,
        arena: PlanarArena | SpatialArena,
        motion: Clip | FootstepLibrary | None,
        config: Any,
        actuation_model: str,
        *,
        terrain_observation: Any = (),
        contact: bool = False,
    ) -> None:
        """Attaches the character and its actuators to the arena.

        Args:
          character, arena, motion, config, actuation_model: see `TrackingTask`.
          terrain_observation: number of ground heights in the plane; names of maps in 3D.
          contact: whether contacts of end effectors are measured in the plane, too.

        Raises:
          ValueError: incompatible options, or a motion that does not fit the character.
        """
        self.character, self.arena, self.config = character, arena, config
        self.actuation_model, self.motion = actuation_model, motion
        self._spatial, self.period = character.spec.spatial, 0.0
        typical = None  # poses whose mean is action 0 of position control
        if motion is not None:
            check_motion(character, motion)
        if isinstance(motion, Clip):
            self.clip, self.period, typical = motion, motion.duration, cycle_poses(motion)
        elif motion is not None:
            self.steps, self.period = motion, 2 * motion.duration
            self._first = straight_step(motion, self.length)
            typical = typical_poses(motion, self._first)
        options, muscles = joint_options(character, config, actuation_model, motion, typical)
        if isinstance(arena, SpatialArena):
            self.body = SpatialBody(character, arena, terrain_observation)
        else:
            sight = VIEW_BEHIND, VIEW_AHEAD, terrain_observation
            self.body = PlanarBody(
                character, arena, *sight, contact, muscles if self.strain else ()
            )
        self.fields = self.body.fields
        self.set_timesteps(CONTROL_TIMESTEP, CONTROL_TIMESTEP / config.substeps)
        self.joint_map = actuation.add(character, actuation_model, self.physics_timestep, **options)

    @abc.abstractmethod
    def _bind_body(self, world: World) -> Any:
        """Binds the body, and what it is compared with; returns the data of `finish_all` and `observe_all`."""

    @abc.abstractmethod
    def _draw_start(
        self, env_ids: np.ndarray, random_states: Sequence[np.random.RandomState]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Begins episodes: draws ground, with `_begin_ground`, and the start, which it returns.

        Returns:
          The arguments of `body.place`: poses, rates, and extents in the plane, or spawns.
        """

    def _placed(self, env_ids: np.ndarray) -> None:
        """Called by `reset` after the characters of some simulations were placed on the ground."""

    @property
    def root_entity(self) -> PlanarArena | SpatialArena:
        return self.arena

    def bind(self, world: World) -> None:
        self.world, n = world, world.n
        self.clock, self.travel = allocated(Clock, n), allocated(Travel, n)
        self._random = [np.random.default_rng(0)] * n  # for draws within an episode
        self._allocate(n, self.travel.distance)
        self.saved = (self.clock, self.travel, self.outcome)
        self._pack = packed(self._bind_body(world))

    @property
    def phase(self) -> np.ndarray:
        """Phase of the cycle in [0, 1), (n,)."""
        return self.clock.phase

    @property
    def cycles(self) -> np.ndarray:
        """Time in periods of the motion: the phase, not wrapped, (n,)."""
        return self.clock.cycles

    def reset(self, env_ids: np.ndarray, random_states: Sequence[np.random.RandomState]) -> None:
        self.world.reset(env_ids)
        start = self._draw_start(env_ids, random_states)
        self.body.place(env_ids, *start)
        for array in self.outcome[1:]:  # all but the observation
            array[env_ids] = 0
        self._placed(env_ids)
        self.observe(env_ids)
        # `observe_all` may have written those of the start.
        self.outcome.reward_terms[env_ids] = 0.0

    def _begin_clocks(self, env_ids: np.ndarray) -> None:
        """Sets the clocks of some simulations to `clock.start`."""
        cycles = np.rint(self.clock.start[env_ids] * DIGITS) / DIGITS
        self.clock.cycles[env_ids], self.clock.phase[env_ids] = cycles, cycles - np.floor(cycles)
        self.clock.steps[env_ids] = 0

    def _begin_ground(self, i: int, seed: np.random.SeedSequence, random: Any = None) -> None:
        """Begins an episode on random ground: in 3D at a random place, if there is `random`."""
        terrain, level = self.arena.terrain, self.config.terrain_level
        if not self._spatial:
            strip = PlanarGround(terrain, seed, terrain_level=level, **self._flat_part(i))
            self.arena.begin_episode(i, strip)
            return
        ground = SpatialGround(terrain, seed, terrain_level=level)
        if random is not None:
            self.travel.origin[i] = ground.spawn(random)
        self.arena.begin_episode(i, ground, self.travel.origin[i, :2])

    def _flat_part(self, i: int) -> dict[str, Any]:
        """Returns where the ground is flat at the start, in the plane; see `PlanarGround`."""
        return {}

    def apply_action(self, action: np.ndarray, env_ids: np.ndarray) -> None:
        self.body.apply_action(action, env_ids)

    def finish_step(self, env_ids: np.ndarray) -> None:
        self.body.measure(env_ids, stepped=True)
        self.finish_all(env_ids, self._pack)

    def observe(self, env_ids: np.ndarray | None = None) -> None:
        env_ids = self.world.all_ids if env_ids is None else env_ids
        self.body.measure(env_ids)
        self.observe_all(env_ids, self._pack)

    def get_state(self, env_id: int) -> dict[str, Any]:
        random = self._random[env_id].bit_generator.state
        return {**super().get_state(env_id), 'random': random}

    def set_state(self, env_id: int, state: dict[str, Any]) -> None:
        super().set_state(env_id, state)
        self._random[env_id] = np.random.default_rng(0)
        self._random[env_id].bit_generator.state = state['random']
