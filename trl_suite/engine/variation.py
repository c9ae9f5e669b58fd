"""Physical properties that differ between the simulations of a world and between episodes.

They are written to the model of each simulation, without recompiling. What MuJoCo derives from
them (masses of subtrees, inverse weights, mean inertia) is recomputed, so that a varied model
equals one that was compiled with the varied properties.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection
from typing import Any, NamedTuple

import mujoco
import numpy as np

from trl_suite.engine.world import World

# Fields of `Properties` that change masses, so that derived quantities must be recomputed.
HEAVY = ('mass', 'link_mass', 'inertia', 'com_offset')


class Properties(NamedTuple):
    """Properties of n simulations, (n,), in the units of the options in `WorldConfig`.

    link_mass has a factor for each link, (n, L). com_offset is in the frame of the first link, (n, 3).
    """

    friction: np.ndarray
    mass: np.ndarray
    link_mass: np.ndarray
    inertia: np.ndarray
    com_offset: np.ndarray
    damping: np.ndarray
    gravity: np.ndarray
    slope: np.ndarray
    slope_direction: np.ndarray
    contact_depth: np.ndarray
    contact_time: np.ndarray


class Variation:
    """Writes properties to the models of a world.

    Attributes:
      properties: the properties of all simulations; at first the nominal ones.
    """

    def __init__(
        self,
        world: World,
        varied: Collection[str],
        links: np.ndarray,
        dofs: np.ndarray,
        geoms: np.ndarray,
        constants: Callable[[mujoco.MjModel], Any] | None = None,
    ) -> None:
        """Copies the nominal properties of the first model.

        Args:
          world: a compiled world.
          varied: names of the properties that are varied; the others are never written.
          links: body ids of the character's links, (L,); the first one is that whose centre of mass
            is displaced.
          dofs: addresses of the character's joints in qvel, whose damping is varied.
          geoms: ids of the character's collision geoms.
          constants: called with a model after its derived quantities were recomputed.
        """
        self._world, self._varied, self._constants = world, frozenset(varied), constants
        self._links, self._dofs, model = links, dofs, world.models[0]
        touches = (model.geom_contype | model.geom_conaffinity) != 0
        # Another geom with priority, such as a ball, keeps the friction of its contacts.
        own = np.isin(np.arange(model.ngeom), geoms)
        self._slides = np.flatnonzero(touches & ((model.geom_priority == 0) | own))
        self._mass = model.body_mass[links].copy()
        self._inertia = model.body_inertia[links].copy()
        self._centre = model.body_ipos[links[0]].copy()
        self._damping = model.dof_damping[dofs].copy()
        n, ones = world.n, np.ones(world.n)
        ground = model.geom_friction[self._slides, 0]
        first = self._slides[:1] if len(self._slides) else 0
        soft, stiff = np.ravel(model.geom_solimp[first]), np.ravel(model.geom_solref[first])
        self.properties = Properties(
            friction=np.full(n, ground.max() if len(ground) else 0.0),
            mass=ones.copy(),
            link_mass=np.ones((n, len(links))),
            inertia=ones.copy(),
            com_offset=np.zeros((n, 3)),
            damping=ones.copy(),
            gravity=np.full(n, math.hypot(*model.opt.gravity)),
            slope=np.zeros(n),
            slope_direction=np.zeros(n),
            contact_depth=np.full(n, soft[2]),
            contact_time=np.full(n, stiff[0]),
        )

    def apply(self, env_id: int) -> None:
        """Writes the properties of one simulation to its model.

        The caller forwards or resets the simulation afterwards. The result depends only on the
        properties, not on those before.
        """
        varied, model, own = self._varied, self._world.models[env_id], self.properties
        if 'friction' in varied:
            model.geom_friction[self._slides, 0] = own.friction[env_id]
            model.pair_friction[:, :2] = own.friction[env_id]
        if 'contact_depth' in varied:
            for part, rows in ((model.geom_solimp, self._slides), (model.pair_solimp, slice(None))):
                part[rows, 0], part[rows, 2] = 0.0, own.contact_depth[env_id]
        if 'contact_time' in varied:
            # MuJoCo would use this bound, too; `properties` have what acts.
            own.contact_time[env_id] = max(own.contact_time[env_id], 2 * model.opt.timestep)
            model.geom_solref[self._slides, 0] = own.contact_time[env_id]
            model.pair_solref[:, 0] = own.contact_time[env_id]
        if 'damping' in varied:
            model.dof_damping[self._dofs] = self._damping * own.damping[env_id]
        if varied & {'gravity', 'slope', 'slope_direction'}:
            model.opt.gravity[:] = tilted(
                own.gravity[env_id], own.slope[env_id], own.slope_direction[env_id]
            )
        if varied & set(HEAVY):
            self._weigh(env_id, model)

    def _weigh(self, env_id: int, model: mujoco.MjModel) -> None:
        """Writes masses, inertias and the centre of mass, and what is derived from them."""
        own = self.properties
        factor = own.mass[env_id] * own.link_mass[env_id]
        model.body_mass[self._links] = self._mass * factor
        model.body_inertia[self._links] = self._inertia * (factor * own.inertia[env_id])[:, None]
        model.body_ipos[self._links[0]] = self._centre + own.com_offset[env_id]
        self._world.set_const(env_id)
        # Not recomputed by mj_setConst; the tolerance of the solver is relative to it. Summed in
        # the order of the compiler.
        model.stat.meaninertia = np.cumsum(model.dof_M0)[-1] / model.nv
        model.stat.meanmass = np.cumsum(model.body_mass[1:])[-1] / (model.nbody - 1)
        if self._constants is not None:
            self._constants(model)


def tilted(gravity: float, slope: float, direction: float) -> tuple[float, float, float]:
    """Returns gravity in the frame of a tilted ground, m/s^2.

    Args:
      gravity: its magnitude, m/s^2.
      slope: angle between ground and horizontal, rad; a character that moves in the direction of
        ascent moves uphill if it is positive.
      direction: direction of ascent, rad to the left of +x.
    """
    along = -gravity * math.sin(slope)
    return along * math.cos(direction), along * math.sin(direction), -gravity * math.cos(slope)
