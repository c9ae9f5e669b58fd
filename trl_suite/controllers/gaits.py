"""The gaits: the bound of dog and goat, the stride of raptor and biped, the hopper's hop.

Sources: see `trl_suite.controllers.gait`, which has what they share.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from trl_suite import errors
from trl_suite.characters import Character
from trl_suite.controllers.gait import Gait
from trl_suite.controllers.parameters import Parameters
from trl_suite.engine import World

GRAVITY = 9.8  # m/s^2
REGULARISATION = 1e-4  # of the contact forces that carry the weight


class Bound(Gait):
    """Dog and goat: back stance, extend, front stance, gather; one fore and one hind leg."""

    feet = ('toe', 'finger')
    world_joints = ('hip', 'shoulder')
    _legs = (('toe', 'ankle', 'knee', 'hip'), ('finger', 'wrist', 'elbow', 'shoulder'))
    _spine = ('spine0', 'spine1', 'spine2', 'spine3', 'torso')
    _limbs = ('shoulder', 'elbow', 'hip', 'knee', 'ankle')
    _no_gravity_compensation = ('goat',)
    endings = (
        'after TransTime', 'finger touches the ground', 'after TransTime',
        'toe touches the ground: end of the cycle',
    )  # fmt: skip

    def bind(self, world: World) -> None:
        super().bind(world)
        self._spine_joints = np.array([self.number[name] for name in self._spine])
        self._limb_joints = np.array([self.number[name] for name in self._limbs])
        self._compensate = self.character.row.name not in self._no_gravity_compensation
        # Which parameter of the state moves which world joint with speed: those of _limbs follow
        # SpineCurve.
        self._swing = [
            (self.link['toe'], self.number['hip'], 1 + self._limbs.index('hip')),
            (self.link['finger'], self.number['shoulder'], 1 + self._limbs.index('shoulder')),
        ]
        self._pushes = np.zeros((2, len(self.kp)), bool)
        for leg, joints in enumerate(self._legs):
            self._pushes[leg, [self.number[name] for name in joints]] = True

    def enter(self, rows: np.ndarray) -> None:
        values = self.of_state(rows)
        self.targets[rows[:, None], self._spine_joints] = values[:, :1]
        self.targets[rows[:, None], self._limb_joints] = values[:, 1:]

    def ends(self, rows: np.ndarray) -> np.ndarray:
        state, touching = self.state[rows], self.touching(rows)
        timed = (state == 0) | (state == 2)
        landed = np.where(
            state == 1, touching[:, self.link['finger']], touching[:, self.link['toe']]
        )
        return np.where(timed, self.phase[rows] >= 1, landed)

    def torques(self, rows: np.ndarray) -> np.ndarray:
        dynamics, world = self.dynamics, self.world
        q, v = dynamics.positions(rows), dynamics.velocities(rows)
        touching = self.touching(rows)
        vectors, values = self.vectors[rows], self.of_state(rows)
        lead = vectors[:, 1] * dynamics.com_speed(rows, v)
        for link, joint, place in self._swing:
            swinging = ~touching[:, link]
            self.targets[rows[swinging], joint] = values[swinging, place] + lead[swinging]
        tau = self.stable_pd(rows, q, v)
        on = touching[:, [self.link[foot] for foot in self.feet]]
        if on.any():
            bodies = [dynamics.bodies[self.link[foot]] for foot in self.feet]
            soles = [world.site_xpos[rows][:, self._sites[foot]] for foot in self.feet]
            jacobians = np.stack(
                [
                    dynamics.jacobian(rows, body, sole)
                    for body, sole in zip(bodies, soles, strict=True)
                ],
                axis=1,
            )
            jacobians *= on[:, :, None, None]
            if self._compensate:
                tau += self._weight(rows, jacobians) * on.any(axis=1, keepdims=True)
            # A force on the body is its opposite on the ground, from one foot by state.
            state = self.state[rows]
            back = state < 2
            forces = np.where(back[:, None], vectors[:, 2:4], vectors[:, 4:6])
            foot = np.where(back, 0, 1)
            pushing = jacobians[np.arange(len(rows)), foot]
            push = -(forces[:, None] @ pushing)[:, 0, 3:]
            tau += push * self._pushes[foot]
        return np.clip(tau, -self.limits, self.limits)

    def _weight(self, rows: np.ndarray, jacobians: np.ndarray) -> np.ndarray:
        """Torques that hold the body against gravity, with the feet on the ground, (m, J)."""
        gravity = self.dynamics.gravity(rows)
        supports = jacobians.reshape(len(gravity), 4, -1)
        root = supports[:, :, :3]  # transposed: forces by root coordinates
        matrix = root @ root.swapaxes(1, 2)
        matrix += REGULARISATION * np.eye(4)
        right = -(root @ gravity[:, :3, None])
        forces = np.linalg.solve(matrix, right)[..., 0]
        return (-gravity - (forces[:, None] @ supports)[:, 0])[:, 3:]


class Stride(Gait):
    """Raptor and biped: one step of a run per cycle; stance and swing leg change places.

    Attributes:
      stance: 0 where the right leg is the stance leg, 1 the left, (n,).
    """

    _hips = ('right_hip', 'left_hip')
    world_joints = _hips
    _leg = ('hip', 'knee', 'ankle')

    def bind(self, world: World) -> None:
        super().bind(world)
        self.stance = np.zeros(world.n, int)
        self._joints = np.array(
            [[self.number[f'{side}_{name}'] for name in self._leg] for side in ('right', 'left')]
        )
        foot = self.foot_link
        self._feet = np.array([self.link[f'{side}_{foot}'] for side in ('right', 'left')])
        # Of a state: root pitch, perhaps spine curve (not used), stance leg, swing leg.
        names = [name.split('.')[1] for name in self.parameters.names[self.parameters.misc :]]
        self._stance_place, self._swing_place = names.index('StanceHip'), names.index('SwingHip')

    @property
    def foot_link(self) -> str:
        """Name of the link that steps, without side."""
        return 'toe' if 'right_toe' in self.character.row.joints else 'ankle'

    @property
    def endings(self) -> tuple[str, ...]:  # type: ignore[override]
        foot = f"the swing leg's {self.foot_link} touches the ground"
        return *3 * ('after TransTime',), f'{foot}: end of the cycle, the legs change places'

    def begin(self, rows: np.ndarray) -> None:
        self.stance[rows] = 0
        super().begin(rows)

    def enter(self, rows: np.ndarray) -> None:
        values, stance = self.of_state(rows), self.stance[rows]
        k, first, second = len(self._leg), self._stance_place, self._swing_place
        self.targets[rows[:, None], self._joints[stance]] = values[:, first : first + k]
        self.targets[rows[:, None], self._joints[1 - stance]] = values[:, second : second + k]

    def ends(self, rows: np.ndarray) -> np.ndarray:
        state = self.state[rows]
        swing_foot = self._feet[1 - self.stance[rows]]
        landed = self.touching(rows)[np.arange(len(rows)), swing_foot]
        return np.where(state == 3, landed, self.phase[rows] >= 1)

    def advance(self, rows: np.ndarray) -> np.ndarray:
        ended = super().advance(rows)
        if ended.any():
            self.stance[rows[ended]] = 1 - self.stance[rows[ended]]
        return ended

    def torques(self, rows: np.ndarray) -> np.ndarray:
        dynamics, count = self.dynamics, np.arange(len(rows))
        q, v = dynamics.positions(rows), dynamics.velocities(rows)
        state, stance = self.state[rows], self.stance[rows]
        vectors, values = self.vectors[rows], self.of_state(rows)
        foot, early = self._feet[stance], state < 2
        loaded = early & self.touching(rows)[count, foot]
        hip, swing_hip = self._joints[stance, 0], self._joints[1 - stance, 0]
        ahead = dynamics.com(rows)[:, 0] - self.world.xipos[rows][count, dynamics.bodies[foot], 0]
        lead = np.where(early, vectors[:, 1] * dynamics.com_speed(rows, v), vectors[:, 2] * ahead)
        self.targets[rows, swing_hip] = values[:, self._swing_place] + lead
        off = np.zeros((len(rows), len(self.kp)), bool)
        off[count, hip] = loaded
        tau = self.stable_pd(rows, q, v, off)
        upright = self.kp[hip] * (values[:, 0] - q[:, 2]) - self.kd[hip] * v[:, 2]
        tau[count, hip] -= loaded * (tau[count, swing_hip] + upright)
        return np.clip(tau, -self.limits, self.limits)

    def get_state(self, row: int) -> dict[str, Any]:
        return {**super().get_state(row), 'stance': int(self.stance[row])}

    def set_state(self, row: int, state: dict[str, Any]) -> None:
        super().set_state(row, state)
        self.stance[row] = state['stance']


class Hop(Gait):
    """The one-legged hopper: descent, down stance, up stance, ascent; a cycle ends at touch-down.

    Attributes:
      rising: whether the root was moving up at the last control step, (n,).
    """

    world_joints = ('hip',)
    endings = (
        'leg touches the ground: end of the cycle', 'root turns upwards', 'leg leaves the ground',
        'root turns downwards; if leg touches the ground first, back to UpStance',
    )  # fmt: skip

    def bind(self, world: World) -> None:
        super().bind(world)
        self.rising = np.zeros(world.n, bool)
        self._fresh = np.zeros(world.n, bool)
        model = world.models[0]
        self._lift = -(float(model.body_mass[self.dynamics.bodies[0]]) + 0.5) * GRAVITY

    def begin(self, rows: np.ndarray) -> None:
        self._fresh[rows] = True
        self.rising[rows] = False
        super().begin(rows)
        self._fresh[rows] = True  # still in the air: the first action waits for the ground

    def apply(self, rows: np.ndarray, vectors: np.ndarray) -> None:
        fresh = self._fresh[rows]
        super().apply(rows, vectors)
        self.state[rows] = np.where(fresh, 0, 1)
        self._fresh[rows] = False
        self.enter(rows)

    def enter(self, rows: np.ndarray) -> None:
        self.targets[rows] = self.of_state(rows)

    def advance(self, rows: np.ndarray) -> np.ndarray:
        landed = self.touching(rows)[:, -1]
        rising = self.dynamics.velocities(rows)[:, 1] > 0
        was, state = self.rising[rows], self.state[rows]
        self.rising[rows] = rising
        following = state.copy()
        following[(state == 1) & rising & ~was] = 2
        following[(state == 2) & ~landed] = 3
        following[(state == 3) & ~rising & was] = 0
        following[(state == 3) & landed] = 2
        moved = following != state
        if moved.any():
            self.state[rows[moved]] = following[moved]
            self.enter(rows[moved])
        return (state == 0) & landed

    def torques(self, rows: np.ndarray) -> np.ndarray:
        dynamics = self.dynamics
        q, v = dynamics.positions(rows), dynamics.velocities(rows)
        state = self.state[rows]
        tau = self.stable_pd(rows, q, v)
        standing = (state == 1) | (state == 2)
        upright = -self.kp[0] * q[:, 2] - self.kd[0] * v[:, 2]
        tau[:, 0] -= standing * self.vectors[rows, 0] * upright
        thigh = (q[:, None] @ self._frame)[:, 0, 0] + self._turn + q[:, 3]
        tau[:, 1] += self.touching(rows)[:, -1] * self._lift * np.cos(thigh)
        return np.clip(tau, -self.limits, self.limits)

    def get_state(self, row: int) -> dict[str, Any]:
        return {
            **super().get_state(row),
            'rising': bool(self.rising[row]),
            'fresh': bool(self._fresh[row]),
        }

    def set_state(self, row: int, state: dict[str, Any]) -> None:
        super().set_state(row, state)
        self.rising[row], self._fresh[row] = state['rising'], state['fresh']


GAITS: dict[str, Callable[..., Gait]] = {
    'dog': Bound,
    'goat': Bound,
    'raptor': Stride,
    'biped2d_simbicon': Stride,
    'hopper': Hop,
}


def make(character: Character, ground_body: str, root: Any, gait: Parameters | None = None) -> Gait:
    """Makes the gait of a character; see `Gait`.

    Raises:
      ValueError: no gait drives this character.
    """
    name = gait.character if gait else character.row.name
    if name not in GAITS:
        raise ValueError(errors.unknown('character with a gait', name, GAITS))
    return GAITS[name](character, ground_body, root, gait)
