"""Gait state machines that drive a planar character by stable PD, over a batch axis.

    gait = make('dog', character)        # adds sensors, so before the model is compiled
    gait.bind(world)
    gait.begin(rows)                     # after a reset
    gait.apply(rows, vectors)            # the parameters of the next cycle
    while ...:
        world.ctrl[...] = gait.torques(rows)
        world.step(...)                  # CONTROL_TIMESTEP
        ended = gait.advance(rows)       # rows whose cycle is over: apply the next one

Four states are visited in order; time or a contact ends each. On entry to a state its targets are
set; feedback moves single targets in every control step. Source: the controllers of Terrain RL
Simulator (2018), of Peng, Berseth, van de Panne (2016), and Yin, Loken, van de Panne (2007) for the
feedback of bipeds; stable PD after Tan, Liu, Turk (2011).
"""

from __future__ import annotations

import abc
from collections.abc import Callable
from typing import Any

import numpy as np

from trl_suite import errors
from trl_suite.characters import Character
from trl_suite.controllers import parameters
from trl_suite.controllers.dynamics import PlanarDynamics
from trl_suite.controllers.parameters import Parameters
from trl_suite.world import World

CONTROL_TIMESTEP = 1 / 600  # s; gaits were tuned at this rate and fall below 300 Hz
GRAVITY = 9.8  # m/s^2
REGULARISATION = 1e-4  # of the contact forces that carry the weight


class Gait(abc.ABC):
    """One state machine in every simulation of a world.

    Attributes:
      parameters: the character's vectors.
      vectors: parameters of the current cycle, (n, P).
      state: (n,) int.
      phase: share of the state's time that is over, (n,).
      targets: of the joints, rad (prismatic: m), (n, J).
      contacts: which links touch the ground, by name: see `touching`.
    """

    def __init__(
        self, character: Character, ground_body: str, root: Any, gait: Parameters | None = None
    ) -> None:
        """Adds a contact sensor for every link, and a site under every foot.

        Args:
          character: an attached character with root joints. Its actuators take torques, in joint
            order; the gaits were tuned for joints without damping and armature.
          ground_body: name of the body that carries the ground; 'world' for a ground of no body.
          root: MJCF element of the arena.
          gait: parameters; by default those of the character's name.
        """
        self.character = character
        self.parameters = gait or parameters.load(character.row.name)
        scope = character.mjcf_model.model
        self._sensors = [f'{scope}_{link}_ground' for link in character.row.links]
        bodies = {body.name: body for body in character.bodies}
        for name, link in zip(self._sensors, character.row.links, strict=True):
            root.sensor.add(
                'contact', name=name, body1=bodies[link], body2=ground_body, num=1, data='found'
            )
        for foot in self.feet:
            box = next(geom for geom in character.collision_geoms if geom.parent is bodies[foot])
            bodies[foot].add(
                'site', name=f'{foot}_sole', size=(0.01,), group=4, quat=box.quat,
                pos=np.array(box.pos) - (0, 0, box.size[2]),
            )  # fmt: skip

    feet: tuple[str, ...] = ()
    stance_joints: tuple[str, ...] = ()

    def bind(self, world: World) -> None:
        """Resolves names in a compiled world and makes room for its n rows."""
        self.world = world
        row = self.character.row
        self.dynamics = dynamics = PlanarDynamics(self.character, world)
        joints = row.joints.values()
        self.kp = np.array([joint.kp for joint in joints])
        self.kd = np.array([joint.kd for joint in joints])
        self.limits = np.asarray(self.character.torque_limits)
        self._padded_kd = np.concatenate([np.zeros(3), self.kd])
        self._padded_kp = np.concatenate([np.zeros(3), self.kp])
        self._damping = np.diag(CONTROL_TIMESTEP * self._padded_kd)
        self.number = {name: i for i, name in enumerate(row.joints)}
        self.link = {name: i for i, name in enumerate(row.links)}
        self._world_joints = np.array([self.number[name] for name in self.world_joints], int)
        self._frame, self._turn = dynamics.frame(self._world_joints)
        addresses = world.sensor_addresses(self._sensors)
        self._contacts = slice(int(addresses[0]), int(addresses[-1]) + 1)
        scope = f'{self.character.mjcf_model.model}/'
        self._sites = dict(
            zip(self.feet, world.site_ids([f'{scope}{f}_sole' for f in self.feet]), strict=True)
        )
        n, states = world.n, len(self.parameters.states)
        self.vectors = np.tile(self.parameters.centre, (n, 1))
        self.state, self.phase = np.zeros(n, int), np.zeros(n)
        self.targets = np.zeros((n, len(self.kp)))
        self._file_targets = np.array([joint.target for joint in joints])
        self._per_state = (len(self.parameters.names) - self.parameters.misc) // states

    # What a kind of gait has of its own.

    world_joints: tuple[str, ...] = ()  # whose targets are angles in the world
    endings: tuple[str, ...] = ()  # what ends each state, in words

    @abc.abstractmethod
    def enter(self, rows: np.ndarray) -> None:
        """Sets the joint targets of the states that rows are in."""

    @abc.abstractmethod
    def torques(self, rows: np.ndarray) -> np.ndarray:
        """Returns the torques of the next control step, within limits, (m, J), N m."""

    def ends(self, rows: np.ndarray) -> np.ndarray:
        """Which rows leave their states for the next, (m,) bool; by default none."""
        return np.zeros(len(rows), bool)

    # Common machinery.

    def begin(self, rows: np.ndarray) -> None:
        """Puts rows at the start of their first cycle, with the default gait."""
        self.targets[rows] = self._file_targets
        self.apply(rows, np.tile(self.parameters.centre, (len(rows), 1)))

    def apply(self, rows: np.ndarray, vectors: np.ndarray) -> None:
        """Begins a cycle in some rows with parameters (m, P)."""
        places = self.parameters.absolute
        vectors = vectors.copy()
        vectors[:, places] = np.abs(vectors[:, places])
        self.vectors[rows] = vectors
        self.state[rows] = 0
        self.phase[rows] = 0.0
        self.enter(rows)

    def advance(self, rows: np.ndarray) -> np.ndarray:
        """Moves the machines on after a control step; returns whose cycle has ended, (m,) bool.

        A machine whose cycle has ended stays in its last state until `apply`.
        """
        self.phase[rows] += CONTROL_TIMESTEP / self.vectors[rows, 0]
        leaving = self.ends(rows)
        if not leaving.any():
            return leaving
        last = self.state[rows] == len(self.parameters.states) - 1
        going = rows[leaving & ~last]
        if len(going):
            self.state[going] += 1
            self.phase[going] = 0.0
            self.enter(going)
        return leaving & last

    def of_state(self, rows: np.ndarray) -> np.ndarray:
        """Parameters of the states that rows are in, (m, per state)."""
        first = self.parameters.misc + self.state[rows] * self._per_state
        return self.vectors[rows[:, None], first[:, None] + np.arange(self._per_state)]

    def touching(self, rows: np.ndarray) -> np.ndarray:
        """Which links touch the ground, (m, L) bool, in link order."""
        return self.world.sensordata[rows, self._contacts] > 0

    def local_targets(self, rows: np.ndarray, q: np.ndarray) -> np.ndarray:
        """Targets relative to parent links, (m, J), at positions (m, D)."""
        targets = self.targets[rows]
        if len(self._world_joints):
            turned = (q[:, None] @ self._frame)[:, 0] + self._turn  # without the link's own joint
            own = q[:, 3 + self._world_joints]
            world = turned + own
            world -= 2 * np.pi * np.ceil((world - np.pi) / (2 * np.pi))  # to (-pi, pi]
            targets[:, self._world_joints] -= world - own
        return targets

    def stable_pd(
        self, rows: np.ndarray, q: np.ndarray, v: np.ndarray, off: np.ndarray | None = None
    ) -> np.ndarray:
        """Torques of proportional-derivative control that looks one control step ahead, (m, J).

        Args:
          rows: which simulations.
          q: positions, (m, D).
          v: velocities, (m, D).
          off: joints that are left free, (m, J) bool.
        """
        dynamics = self.dynamics
        kp, kd = self._padded_kp, self._padded_kd
        if off is not None:
            on = np.ones_like(q)
            on[:, 3:] = ~off
            kp, kd = kp * on, kd * on
        error = -q - CONTROL_TIMESTEP * v
        error[:, 3:] += self.local_targets(rows, q)
        pull = kp * error - kd * v
        matrix = dynamics.inertia(rows)
        matrix += self._damping
        acceleration = np.linalg.solve(matrix, (pull - dynamics.bias(rows))[..., None])[..., 0]
        return (pull - kd * CONTROL_TIMESTEP * acceleration)[:, 3:]

    def get_state(self, row: int) -> dict[str, Any]:
        return {
            'vector': self.vectors[row].copy(),
            'state': int(self.state[row]),
            'phase': float(self.phase[row]),
            'targets': self.targets[row].copy(),
        }

    def set_state(self, row: int, state: dict[str, Any]) -> None:
        self.vectors[row], self.targets[row] = state['vector'], state['targets']
        self.state[row], self.phase[row] = state['state'], state['phase']


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
