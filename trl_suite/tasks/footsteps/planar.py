"""Walking straight ahead along planned footsteps in the plane: the planar footstep controller.

Source: the step scenario of the original, with its configuration for the planar biped;
'DeepLoco' (Peng, Berseth, Yin, van de Panne 2017).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from trl_suite.arenas import PlanarArena
from trl_suite.characters import Character, CharacterSpec
from trl_suite.engine import World
from trl_suite.kinematics.planar import breaks_down, has_fallen, look
from trl_suite.kinematics.planar_reference import feature
from trl_suite.motion import Clip
from trl_suite.tasks.common import rewards
from trl_suite.tasks.common.footstep_plan import (
    CONTACT,
    PLAN,
    SOLE,
    SOLE_AHEAD,
    STANCE_COLOUR,
    SWING_COLOUR,
)
from trl_suite.tasks.common.plans import FOOTSTEP_SCALE, MAX_LANDING_ERROR, StraightPlans
from trl_suite.tasks.common.rewards import score_tracking
from trl_suite.tasks.imitation import planar as imitation
from trl_suite.tasks.imitation.planar import ImitationData, PlanarConfig, PlanarImitation
from trl_suite.tasks.task import Marker, drawn_seed
from trl_suite.tasks.terms import Term, begin, conclude, give
from trl_suite.terrain.planar import windows as planar_ground
from trl_suite.util.compiled import compiled, packed
from trl_suite.util.options import option
from trl_suite.util.random import Streams, random, uniform

_DIGITS = (
    1e9  # the clock is rounded to 1 / _DIGITS of a cycle, so that stance switches at half a cycle
)
HEADING = Term(
    'heading',
    rewards.HEADING_WEIGHT,
    '1 while the trunk points forwards, 0 while it points backwards',
)
RIGHT, LEFT = 0, 1


class Plan(NamedTuple):
    """The footsteps planned in each simulation.

    Attributes:
      stance: stance foot, 0 right, 1 left, (n,).
      landing: landing places of the swing foot, then of the stance foot: x, 0 and z, (n, 2, 3) m.
      landing_error: distance along x of the last foot that landed from its landing place, (n,) m.
      landed: whether a foot landed in the last step, (n,) bool.
      length: current step length, (n,) m.
      begun: time in periods of the clip, and x of the root (m), at the last switch, (n, 2).
      random: random stream for step lengths, (n, 6); see `util.random`.
    """

    stance: np.ndarray
    landing: np.ndarray
    landing_error: np.ndarray
    landed: np.ndarray
    length: np.ndarray
    begun: np.ndarray
    random: np.ndarray


class Options(NamedTuple):
    """Options of plans and of the reward.

    Attributes:
      shortest, longest: bounds of the step length, m.
      change: probability that the step length is redrawn.
      max_landing_error: landing error above which the episode fails, m.
      footstep_scale: factor of the squared distance between swing foot and landing place.
    """

    shortest: float
    longest: float
    change: float
    max_landing_error: float
    footstep_scale: float


# A step of simulation i, in order.


@compiled
def finish_step(i: int, data: ImitationData, plan: Plan, options: Options) -> None:
    """Computes landing, reward, failure and observation, after the physics was advanced."""
    imitation.advance_clock(i, data.clip, data.state)
    body, outcome = data.body, data.outcome
    outcome.diverged[i] = breaks_down(i, body)
    missed = land(i, data, plan, options)
    if outcome.diverged[i]:  # keeps the last finite observation
        conclude(i, True, outcome)
        return
    look(i, body, outcome.observation)
    compare(i, data, plan, options)
    conclude(i, missed or has_fallen(i, body.ids, body.physics), outcome)
    observe(i, data, plan, options)


@compiled
def read_clock(i: int, data: ImitationData) -> int:
    """Writes the phase; returns the stance foot that it implies."""
    cycles = np.rint(data.state.cycles[i] * _DIGITS) / _DIGITS
    data.state.phase[i] = cycles % 1.0
    return LEFT if data.state.phase[i] >= 0.5 else RIGHT


@compiled
def land(i: int, data: ImitationData, plan: Plan, options: Options) -> bool:
    """At a switch of stance, writes landing error and next plan; returns whether the step failed."""
    stance, body = read_clock(i, data), data.body
    plan.landed[i] = stance != plan.stance[i] and not data.outcome.diverged[i]
    if not plan.landed[i]:
        return False
    plan.stance[i] = stance  # the foot that has just landed
    foot = body.physics.xpos[i, body.ids.effectors[stance], 0]
    plan.landing_error[i] = abs(foot - plan.landing[i, 0, 0])
    for axis in range(3):
        plan.landing[i, 0, axis] = plan.landing[i, 1, axis]
    plan.landing[i, 1, 0] += next_length(i, plan, options)
    put_on_ground(i, data, plan)
    return plan.landing_error[i] > options.max_landing_error


@compiled
def next_length(i: int, plan: Plan, options: Options) -> float:
    """Returns the length of the next step, m; redraws it with probability `change`."""
    if random(i, plan.random) < options.change:
        plan.length[i] = uniform(i, options.shortest, options.longest, plan.random)
    return plan.length[i]


@compiled
def put_on_ground(i: int, data: ImitationData, plan: Plan) -> None:
    """Writes ground heights to the landing places, and the clock and root position to `begun`."""
    for which in range(2):
        x = plan.landing[i, which, 0]
        plan.landing[i, which, 2] = planar_ground.height(i, x, data.body.ground)
    plan.begun[i, 0] = data.state.cycles[i]
    plan.begun[i, 1] = data.body.physics.qpos[i, data.body.ids.qpos[0]]


@compiled
def compare(i: int, data: ImitationData, plan: Plan, options: Options) -> None:
    """Writes the reward terms; in the second half of a step the plan replaces the clip."""
    pose, velocity, _, com, height = imitation.errors(i, data)
    columns, body = data.features, data.body
    measurement = body.measurement
    phase, swing = data.state.phase[i], 1 - plan.stance[i]
    twice = 2 * phase
    late = twice - np.floor(twice) > 0.5
    end_effector = 0.0
    for k in range(measurement.effectors.shape[1]):
        if k == swing and late:
            continue  # compared with the landing place below
        off = measurement.effectors[i, k] - feature(phase, columns.effectors + k, data.clip)
        end_effector += off * off
    if late:
        foot = body.ids.effectors[swing]
        raised = feature(phase, columns.effectors + 2 + swing, data.clip)
        x = plan.landing[i, 0, 0] - body.physics.xpos[i, foot, 0]
        z = plan.landing[i, 0, 2] - body.physics.xpos[i, foot, 2] + raised
        end_effector += options.footstep_scale * (x * x + z * z)
    terms, outcome = data.terms, data.outcome
    score_tracking(i, pose, velocity, end_effector, com, height, terms, outcome)
    give(i, 1.0 if measurement.facing[i] > 0.0 else 0.0, terms.heading, outcome)


@compiled
def observe(i: int, data: ImitationData, plan: Plan, options: Options) -> None:
    """Writes the blocks after velocity: strain, phase, contact and plan."""
    imitation.observe(i, data)
    observation, columns = data.outcome.observation, data.columns
    ids, physics, measurement = data.body.ids, data.body.physics, data.body.measurement
    for k in range(len(ids.contact)):
        touches = physics.sensordata[i, ids.contact[k]] > 0.0
        observation[i, columns.contact + k] = 1.0 if touches else 0.0
    for k in range(12):
        observation[i, columns.plan + k] = 0.0
    for which in range(2):  # first and second landing place, relative to the foot that lands there
        foot = 1 - plan.stance[i] if which == 0 else plan.stance[i]
        x = plan.landing[i, which, 0] - physics.xpos[i, ids.effectors[foot], 0]
        place = columns.plan + 6 * which + 3 * foot
        observation[i, place] = x * measurement.facing[i]
        observation[i, place + 2] = plan.landing[i, which, 2] - measurement.under[i]


@compiled
def draw_plan(i: int, data: ImitationData, plan: Plan, options: Options) -> None:
    """Draws the first plan of an episode."""
    plan.stance[i] = read_clock(i, data)
    plan.landing_error[i], plan.landed[i] = 0.0, False
    plan.length[i] = uniform(i, options.shortest, options.longest, plan.random)
    foot = data.body.physics.xpos[i, data.body.ids.effectors[plan.stance[i]], 0]
    plan.landing[i, 0, 0] = foot + next_length(i, plan, options)
    plan.landing[i, 1, 0] = plan.landing[i, 0, 0] + next_length(i, plan, options)
    put_on_ground(i, data, plan)


# Loops over simulations; they take packs.


@compiled
def draw_plans(env_ids: np.ndarray, data: ImitationData, plan: Plan, options: Options) -> None:
    """Draws the first plans of some simulations."""
    for i in env_ids:
        draw_plan(i, data, plan, options)


@compiled
def finish_steps(env_ids: np.ndarray, data: ImitationData, plan: Plan, options: Options) -> None:
    """Finishes steps."""
    for i in env_ids:
        finish_step(i, data, plan, options)


@compiled
def observe_all(
    env_ids: np.ndarray, fresh: bool, data: ImitationData, plan: Plan, options: Options
) -> None:
    """Writes observations; if `fresh`, episodes have just begun, and outcomes are reset."""
    for i in env_ids:
        look(i, data.body, data.outcome.observation)
        compare(i, data, plan, options)
        observe(i, data, plan, options)
        if fresh:
            begin(i, data.outcome)


@dataclasses.dataclass(frozen=True, kw_only=True)
class PlanarFootstepsConfig(PlanarConfig):
    """Options of `PlanarFootsteps`."""

    plans: StraightPlans = option(
        None, 'how footstep plans are drawn: a mapping of fields of StraightPlans'
    )
    max_landing_error: float | None = option(None, MAX_LANDING_ERROR, unit='m', above=0)
    footstep_scale: float = option(1.0, FOOTSTEP_SCALE, at_least=0)


class PlanarFootsteps(PlanarImitation):
    """A planar biped tracks a plan of footsteps; the reference of a step is one half of a clip.

    Attributes:
      plan: the footsteps; see `Plan`.
    """

    terms = *rewards.STEP_TERMS, HEADING
    ABOUT = 'root'
    EXTRAS = CONTACT, PLAN

    CONFIG: Any = PlanarFootstepsConfig

    def __init__(
        self,
        character: Character,
        arena: PlanarArena,
        clip: Clip,
        config: PlanarFootstepsConfig = PlanarFootstepsConfig(),
        *,
        actuation_model: str = 'position',
    ) -> None:
        """Composes the task.

        Args:
          character: a planar character with a right and a left foot, without actuators; it is
            attached to the arena.
          arena: the arena with its terrain.
          clip: a looping planar clip of two steps for this character, with right stance first.
          config: the options.
          actuation_model: one of `trl_suite.actuation.ACTUATIONS`.

        Raises:
          ValueError: incompatible options, a character without two feet, or a clip that does not
            fit it; `bind` raises it for a clip with left stance first.
        """
        check_feet(character.spec)
        super().__init__(character, arena, clip, config, actuation_model=actuation_model)
        self.plans = config.plans
        self.max_landing_error = config.max_landing_error
        self._footstep_scale = config.footstep_scale

    def bind(self, world: World) -> None:
        super().bind(world)
        n = world.n
        columns = self.reference.columns['effectors']
        table = self.reference.features(np.arange(64) / 64)[:, columns]
        higher = (
            (table[:, 2] - table[:, 3]).reshape(2, -1).mean(1)
        )  # right above left foot, by halves
        if not higher[0] < 0 < higher[1]:
            raise ValueError(
                f'clip {self.clip.name!r}: expected the right foot on the ground in the first half of '
                'the cycle, and the left foot in the second; if the left foot is first, pass '
                'clip.mirrored()'
            )
        self._streams = Streams(n)
        self.plan = Plan(
            np.zeros(n, int), np.zeros((n, 2, 3)), np.zeros(n), np.zeros(n, bool), np.zeros(n),
            np.zeros((n, 2)), self._streams.state,
        )  # fmt: skip
        self.saved = (*self.saved, self.plan)
        self.info_arrays |= {
            'landed': self.plan.landed,
            'landing_error': self.plan.landing_error,
            'heading_error': np.zeros(n),  # a planar character does not turn
        }
        plans = self.plans
        options = Options(
            *plans.length, plans.change, np.inf if self.max_landing_error is None else float(self.max_landing_error),
            float(self._footstep_scale),
        )  # fmt: skip
        self._packs = self._pack, packed(self.plan), packed(options)

    def _begin(self, env_ids: np.ndarray, random_states: Sequence[np.random.RandomState]) -> None:
        for i, random_state in zip(env_ids.tolist(), random_states, strict=True):
            self._streams.seed(i, drawn_seed(random_state))
        draw_plans(env_ids, *self._packs)

    def finish_step(self, env_ids: np.ndarray) -> None:
        finish_steps(env_ids, *self._packs)

    def _observe(self, env_ids: np.ndarray, fresh: bool) -> None:
        observe_all(env_ids, fresh, *self._packs)

    def markers(self, env_id: int) -> list[Marker]:
        """Returns markers of the landing places."""
        return [
            Marker('box', (x + SOLE_AHEAD, y, z + SOLE[2]), SOLE, colour)
            for (x, y, z), colour in zip(
                self.plan.landing[env_id].tolist(), (SWING_COLOUR, STANCE_COLOUR), strict=True
            )
        ]

    def reference_pose(self, env_id: int) -> np.ndarray:
        """Returns the reference pose, aligned with x at the last switch: x, z, pitch, joints."""
        begun, x = self.plan.begun[env_id]
        first, pose = self.clip.pose(
            np.array([begun, self.state.cycles[env_id]]) * self.reference.period
        )
        pose[0] += x - first[0]
        pose[1] += self.figure.ground_heights(env_id, pose[:1])[0]
        return pose


def check_feet(character: CharacterSpec) -> None:
    """Checks that a character has a right and a left foot, and no others.

    Raises:
      ValueError: the character has no such pair of end effectors.
    """
    if character.end_effectors not in character.mirror:
        raise ValueError(
            f'character {character.name!r} has '
            f'{", ".join(character.end_effectors) or "nothing"} as end effectors; expected a right and a left '
            'foot, as biped2d_full has'
        )
