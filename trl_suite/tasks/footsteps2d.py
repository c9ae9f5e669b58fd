"""Walking in the plane where the feet are told to go: the footstep controller, straight on.

Source: the step scenario of the original, as a configuration of it has it for the planar biped;
'DeepLoco' (Peng, Berseth, Yin, van de Panne 2017).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np

from trl_suite.arenas import PlanarTerrain
from trl_suite.characters import Character, CharacterRow
from trl_suite.engine import World
from trl_suite.motion import Clip
from trl_suite.tasks import rewards
from trl_suite.tasks.footsteps import SOLE, SOLE_AHEAD, STANCE_COLOUR, SWING_COLOUR
from trl_suite.tasks.imitation import SUBSTEPS, Imitation
from trl_suite.tasks.plans import StraightPlans, options
from trl_suite.tasks.task import Marker, drawn_seed

_DIGITS = 9  # of the clock, in cycles: half a cycle is half a cycle, however it was counted
_END_EFFECTOR = list(rewards.STEP_TERMS).index('end_effector')
_WEIGHTS = np.array([[weight for weight, _ in rewards.STEP_TERMS.values()]])
_SCALES = np.array([[-scale for _, scale in rewards.STEP_TERMS.values()]])[:, :-1]


class PlanarFootsteps(Imitation):
    """A planar biped tracks a plan of footsteps; its single steps are the halves of a clip.

    Observation blocks, in this order (N links; heading frame as for `Imitation`), N = 12: 69 numbers:
      terrain, pose, velocity, phase: as for `Imitation`; the right foot stands while the phase is
        below 0.5.
      contact: whether right and left foot touch the ground; 2.
      plan: as in three dimensions, where (x, y, z) stand for each place and y is 0: where the first
        step lands as seen from the right foot, zero while that one stands, and from the left foot,
        zero while that one does; where the second lands as seen from the right foot, zero unless that
        one stands, and from the left foot; z from the ground under the root; then 0 for the heading;
        13.

    Attributes:
      stance: foot that stands, 0 the right one, 1 the left one, (n,).
      landing: where the swing foot lands, then the stance foot: x, 0 and z, (n, 2, 3) m.
      landing_error: distance between the last foot that landed and its place, along x, (n,) m.
      landed: whether one landed in this step, (n,) bool.
    """

    TERMS = rewards.STEP_TERMS
    ABOUT = 'root'
    EXTRAS = MappingProxyType({'contact': 2, 'plan': 13})

    def __init__(
        self,
        character: Character,
        arena: PlanarTerrain,
        clip: Clip,
        *,
        actuation_model: str = 'position',
        plans: StraightPlans | Mapping[str, Any] | None = None,
        miss: float | None = None,
        footstep_scale: float = 1.0,
        terrain_samples: int = 0,
        substeps: int = SUBSTEPS,
        centre: str = 'clip',
        half_range: float | None = None,
        start_phase: float | Sequence[Sequence[float]] | None = None,
        spawn: str = 'intended',
        blend: float = 0.0,
    ) -> None:
        """Composes the task.

        Args:
          character: a planar character with a right and a left foot, without actuators; it is
            attached to the arena.
          arena: where it moves.
          clip: a looping planar clip for this character, of two steps; the right foot stands first.
          actuation_model: one of `trl_suite.actuation.ACTUATIONS`.
          plans: how plans are drawn; or keyword arguments of `StraightPlans`.
          miss: an episode fails where a foot lands farther than this from its place, m.
          footstep_scale: times the squared distance between swing foot and landing place in the
            reward; more than 1 teaches accuracy sooner.
          terrain_samples, substeps, centre, half_range, start_phase, spawn, blend: as for
            `Imitation`.

        Raises:
          ValueError: options out of range, a character without two feet, or a clip that does not fit
            it; when the world is bound, a clip whose left foot stands first.
        """
        check_feet(character.row)
        if miss is not None and not 0 < miss < np.inf:
            raise ValueError(f'miss is {miss}; expected a positive number of metres, or None')
        if not 0 <= footstep_scale < np.inf:
            raise ValueError(f'footstep_scale is {footstep_scale}; expected 0 or more')
        self.plans = options(StraightPlans, 'plans', {} if plans is None else plans)
        self.miss, self._footstep_scale = miss, footstep_scale
        super().__init__(
            character, arena, clip, actuation_model=actuation_model,
            terrain_samples=terrain_samples, substeps=substeps, centre=centre,
            half_range=half_range, start_phase=start_phase, spawn=spawn, blend=blend,
        )  # fmt: skip

    def bind(self, world: World) -> None:
        super().bind(world)
        n, self._effectors = world.n, self._compared['effectors']
        self._weights[self._effectors, _END_EFFECTOR] = 1.0  # the sum over both feet, not the mean
        table = self.reference.features(np.arange(64) / 64)[:, self._effectors]
        higher = (table[:, 2] - table[:, 3]).reshape(2, -1).mean(1)  # the right foot, by halves
        if not higher[0] < 0 < higher[1]:
            raise ValueError(
                f'clip {self.clip.name!r}: its right foot does not stand in the first half of the '
                'cycle and its left foot in the second; if the left one stands first, give '
                'clip.mirrored()'
            )
        self._random = [np.random.default_rng(0)] * n
        self._every = np.arange(n)
        self.stance = np.zeros(n, int)
        self.landing = np.zeros((n, 2, 3))
        self.landing_error, self.landed = np.zeros(n), np.zeros(n, bool)
        self._length = np.zeros(n)  # m; of the steps of now
        self._shift = np.zeros(n)  # m; where the clip's x = 0 is, for pictures

    def _read_clock(self) -> np.ndarray:
        """Writes the phase of all rows; returns which foot stands by it, (n,)."""
        np.remainder(np.round(self._cycles, _DIGITS), self._ones, self.phase)
        return (self.phase >= 0.5).astype(int)

    # Plans.

    def begin_episodes(
        self, rows: np.ndarray, random_states: Sequence[np.random.RandomState]
    ) -> None:
        super().begin_episodes(rows, random_states)
        self.stance[rows] = self._read_clock()[rows]
        self.landing_error[rows], self.landed[rows] = 0.0, False
        feet = self.figure.feet()
        for row, random_state in zip(rows.tolist(), random_states, strict=True):
            self._random[row] = np.random.default_rng(drawn_seed(random_state))
            self._length[row] = self._random[row].uniform(*self.plans.length)
            self.landing[row, 0, 0] = feet[row, self.stance[row], 0] + self._next_length(row)
            self.landing[row, 1, 0] = self.landing[row, 0, 0] + self._next_length(row)
        self._lay(rows)

    def _step(self) -> None:
        stance = self._read_clock()
        self.landed = (stance != self.stance) & ~self.diverged  # what breaks down lands nowhere
        rows = np.flatnonzero(self.landed)
        if not len(rows):
            return
        self.stance[rows] = stance[rows]  # the foot that has just landed
        feet = self.figure.feet()[rows, stance[rows], 0]
        self.landing_error[rows] = np.abs(feet - self.landing[rows, 0, 0])
        self.landing[rows, 0] = self.landing[rows, 1]
        for row in rows.tolist():
            self.landing[row, 1, 0] += self._next_length(row)
        self._lay(rows)

    def _next_length(self, row: int) -> float:
        """Returns how long the next step of a plan is, which perhaps is drawn anew, m."""
        if self._random[row].uniform() < self.plans.change:
            self._length[row] = self._random[row].uniform(*self.plans.length)
        return float(self._length[row])

    def _lay(self, rows: np.ndarray) -> None:
        """Puts the landing places of some rows on the ground, and the clip where they are."""
        self.landing[rows, :, 2] = self.arena.height(self.landing[rows, :, 0], rows)
        there = self.clip.pose(self._cycles[rows] * self.reference.period)[:, 0]
        self._shift[rows] = self._all.x[rows, 0] - there

    # Reward and observation.

    def finish_step(self, stepped: np.ndarray | None = None) -> None:
        super().finish_step(stepped)
        if self.miss is not None:
            missed = self.landed & (self.landing_error > self.miss)
            self.failed |= missed
            self.reward_terms[missed] = self.reward[missed] = 0.0

    def _compare(self, error: np.ndarray, reference: np.ndarray) -> None:
        facing = self._all.facing
        swing, twice = 1 - self.stance, 2 * self.phase
        late = twice - np.floor(twice) > 0.5
        # In the second half of a step the plan takes the place of the reference.
        error[self._every, self._effectors.start + swing] *= ~late
        np.matmul(error[:, None], self._weights, out=self._errors)
        errors = self._errors[:, 0]
        raised = reference[self._every, self._effectors.start + 2 + swing]
        way = self.landing[:, 0, ::2] - self.figure.feet()[self._every, swing]
        x, z = way[:, 0], way[:, 1] + raised
        errors[:, _END_EFFECTOR] += late * self._footstep_scale * (x * x + z * z)
        # Not into the terms themselves: exponentials of a part of an array depend on its rows.
        self.reward_terms[:, :-1] = rewards.exponentials(errors, _WEIGHTS[:, :-1], _SCALES)
        self.reward_terms[:, -1] = _WEIGHTS[0, -1]
        if facing is not None:
            self.reward_terms[:, -1] *= facing[:, 0] > 0

    def observe(self, env_ids: np.ndarray | None = None) -> None:
        super().observe()
        self.observation[:, self.blocks['contact']] = self.figure.contacts()
        feet = np.stack([1 - self.stance, self.stance], axis=1)  # which of them lands where
        way = self.landing.copy()
        way[..., 0] -= self.figure.feet()[self._every[:, None], feet, 0]
        way[..., 2] -= self._all.under
        if self._all.facing is not None:
            way[..., 0] *= self._all.facing
        slots = np.zeros((len(way), 2, 2, 3))  # first and second step; as seen from right and left
        slots[self._every[:, None], np.arange(2), feet] = way
        plan = self.observation[:, self.blocks['plan']]
        plan[:, :12] = slots.reshape(len(way), 12)

    def infos(self) -> dict[str, Any]:
        """As for `Imitation`; and of the last foot that landed, whether it did so in this step.

        `landed` (n,) bool; `landing_error` (n,) m, 0 before any landing; `heading_error` (n,), 0.
        """
        return {
            **super().infos(),
            'landed': self.landed.copy(),
            'landing_error': self.landing_error.copy(),
            'heading_error': np.zeros_like(self.landing_error),
        }

    def markers(self, row: int) -> list[Marker]:
        """Where the feet are to land."""
        return [
            Marker('box', (x + SOLE_AHEAD, y, z + SOLE[2]), SOLE, colour)
            for (x, y, z), colour in zip(
                self.landing[row].tolist(), (SWING_COLOUR, STANCE_COLOUR), strict=True
            )
        ]

    def reference_pose(self, row: int) -> np.ndarray:
        """Pose of the reference where the character was at the last switch: x, z, pitch, joints."""
        pose = self.clip.pose(self._cycles[row] * self.reference.period)
        pose[0] += self._shift[row]
        pose[1] += self.figure.ground(row, pose[:1])[0]
        return pose

    _KEPT: tuple[str, ...] = (
        'stance', 'landing', 'landing_error', 'landed', '_length', '_shift',
    )  # fmt: skip

    def get_state(self, row: int) -> dict[str, Any]:
        return {
            **super().get_state(row),
            'random': self._random[row].bit_generator.state,
            **{name: getattr(self, name)[row].copy() for name in self._KEPT},
        }

    def set_state(self, row: int, state: dict[str, Any]) -> None:
        super().set_state(row, state)
        random = np.random.default_rng(0)
        random.bit_generator.state = state['random']
        self._random[row] = random
        for name in self._KEPT:
            getattr(self, name)[row] = state[name]


def check_feet(character: CharacterRow) -> None:
    """Checks that a character has a right and a left foot, and no others.

    Raises:
      ValueError: it has not.
    """
    if character.end_effectors not in character.mirror:
        raise ValueError(
            f'character {character.name!r} has no right and left foot to place, but '
            f'{", ".join(character.end_effectors) or "no end effectors"}; biped2d_full has them'
        )
