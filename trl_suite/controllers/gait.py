"""The gait of a planar character: its parameters, bound to the simulations of a world.

    gait = Gait(character, ground_body, root)  # before the model is compiled
    gait.bind(world)

Compiled functions then call those of `trl_suite.controllers.gaits` with `gait.data`: `begin` after a reset,
`begin_cycle` with the parameters of a cycle; in every control step `act`, physics, and `advance`, which returns
whether the cycle has ended.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from trl_suite.bodies.planar import PlanarState
from trl_suite.bodies.state import allocated
from trl_suite.characters import Character
from trl_suite.controllers import dynamics, parameters
from trl_suite.controllers.dynamics import Mechanics
from trl_suite.controllers.gaits import STATES, GaitData, GaitState, Machine, Scratch
from trl_suite.controllers.parameters import KINDS, Parameters
from trl_suite.engine import GRAVITY, World
from trl_suite.util import errors

_LEG_ON_GROUND = 0.5  # kg; mass of the hopper's leg that its lift supports, in addition to the root


class Gait:
    """One state machine in every simulation of a world.

    Attributes:
      parameters: parameters of the character's gait.
      number: joint -> its number.
      link: link -> its number.
      state: state of the machines, after `bind`.
      data: for compiled functions, after `bind`.
    """

    state: GaitState
    data: GaitData

    def __init__(
        self, character: Character, ground_body: str, root: Any, gait: Parameters | None = None
    ) -> None:
        """Adds a contact sensor for every link, and for a bound a site under every foot.

        Args:
          character: an attached character with root joints. Its actuators take torques, in joint
            order; the gaits were tuned for joints without damping and armature.
          ground_body: name of the body that has the ground geoms; 'world' if they have no body.
          root: MJCF element of the arena.
          gait: parameters; by default those for the character's name.
        """
        self.character = character
        self.parameters = gait = gait or parameters.load(character.spec.name)
        self.number = {name: i for i, name in enumerate(character.spec.joints)}
        self.link = {name: i for i, name in enumerate(character.spec.links)}
        for joints in (*gait.legs, *gait.targets.values()):
            errors.check_known('joint', self.number, *joints)
        errors.check_known('link', self.link, *gait.feet)
        scope = character.mjcf_model.model
        self._sensors = [f'{scope}_{link}_ground' for link in character.spec.links]
        bodies = {body.name: body for body in character.bodies}
        for name, link in zip(self._sensors, character.spec.links, strict=True):
            root.sensor.add(
                'contact', name=name, body1=bodies[link], body2=ground_body, num=1, data='found'
            )
        self._soles = gait.feet if gait.kind == 'bound' else ()
        for foot in self._soles:
            box = next(geom for geom in character.collision_geoms if geom.parent is bodies[foot])
            place = {'pos': np.array(box.pos) - (0, 0, box.size[2]), 'quat': box.quat}
            bodies[foot].add('site', name=f'{foot}_sole', size=(0.01,), group=4, **place)

    def bind(self, world: World) -> None:
        """Resolves names in a compiled world, which must have bound `dynamics.FIELDS`."""
        self.world, gait = world, self.parameters
        spec, scope = self.character.spec, f'{self.character.mjcf_model.model}/'
        skeleton = dynamics.skeleton(self.character, world)
        joints = spec.joints.values()
        legs = np.array([[self.number[name] for name in leg] for leg in gait.legs])
        turn, constant = dynamics.frame(legs[:, 0], skeleton, world)
        contacts = world.sensor_addresses(self._sensors)  # consecutive, in link order
        machine = Machine(
            kind=KINDS.index(gait.kind),
            kp=np.array([joint.kp for joint in joints], float),
            kd=np.array([joint.kd for joint in joints], float),
            limits=np.array(self.character.torque_limits, float),
            rest=np.array([joint.target for joint in joints], float),
            misc=gait.misc,
            per_state=(len(gait.names) - gait.misc) // STATES,
            absolute=gait.absolute,
            place=self._places(legs),
            legs=legs,
            feet=np.array([self.link[name] for name in gait.feet]),
            soles=world.site_ids([f'{scope}{foot}_sole' for foot in self._soles]),
            turn=turn,
            constant=constant,
            contact=int(contacts[0]),
            holds_weight=gait.gravity_compensation,
            lift=-(float(world.models[0].body_mass[skeleton.links[0]]) + _LEG_ON_GROUND) * GRAVITY,
        )
        n, size, count = world.n, len(skeleton.dof), len(self.number)
        vector, angles = gait.action_offset, np.zeros(count)
        self.state = allocated(GaitState, n, vector=vector, target=angles)
        self.state.vector[:] = vector
        matrix, support = np.zeros((size, size)), np.zeros((4, size))
        rows = {'torque': angles, 'matrix': matrix, 'rhs': np.zeros(size), 'support': support}
        scratch = allocated(Scratch, n, **rows)
        physics = PlanarState(*(getattr(world, name) for name in PlanarState._fields))
        mechanics = Mechanics(*(getattr(world, name) for name in Mechanics._fields))
        self.data = GaitData(skeleton, physics, mechanics, machine, self.state, scratch)

    def _places(self, legs: np.ndarray) -> np.ndarray:
        """Returns `Machine.place`, the parameter of a state for the target of each joint."""
        gait = self.parameters
        own = [name.split('.')[-1] for name in gait.names[gait.misc :]]
        place = np.full((2, len(self.number)), -1)
        for name, joints in gait.targets.items():
            place[:, [self.number[joint] for joint in joints]] = own.index(name)
        if gait.kind == 'stride':  # in left stance the legs are exchanged
            place[1, legs[::-1]] = place[0, legs]
        return place

    @property
    def hips(self) -> tuple[str, ...]:
        """Joints whose targets are world angles."""
        return tuple(leg[0] for leg in self.parameters.legs)

    @property
    def endings(self) -> tuple[str, ...]:
        """The condition that ends each state, in words."""
        timed, feet = 'after TransTime', self.parameters.feet
        if self.parameters.kind == 'bound':
            hind, fore = (f'{foot} touches the ground' for foot in feet)
            return timed, fore, timed, f'{hind}: end of the cycle'
        if self.parameters.kind == 'stride':
            foot = f"the swing leg's {feet[0].split('_')[-1]} touches the ground"
            return *3 * (timed,), f'{foot}: end of the cycle, stance and swing leg are exchanged'
        leg = feet[0]
        return (
            f'{leg} touches the ground: end of the cycle',
            'root starts to rise',
            f'{leg} leaves the ground',
            f'root starts to fall; if {leg} touches the ground first, the next state is UpStance',
        )
