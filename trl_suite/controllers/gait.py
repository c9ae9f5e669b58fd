"""Gait state machines that drive a planar character by stable PD, over a batch axis.

    gait = controllers.make(character, ground_body, root)  # before the model is compiled
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
from typing import Any

import numpy as np

from trl_suite.characters import Character
from trl_suite.controllers import parameters
from trl_suite.controllers.dynamics import PlanarDynamics
from trl_suite.controllers.parameters import Parameters
from trl_suite.engine import World

CONTROL_TIMESTEP = 1 / 600  # s; gaits were tuned at this rate and fall below 300 Hz


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
