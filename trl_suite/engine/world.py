"""n simulations as arrays: the complete interface between tasks and physics.

Every array of a `World` has a leading axis of n simulations. Tasks access the engine only through
these arrays and a few methods, so that one implementation of a task works for the single
environment (n = 1, over one `dm_control` Physics) and for a batch.
"""

from __future__ import annotations

import concurrent.futures
import copy
import threading
from collections.abc import Callable, Sequence
from typing import Any

import mujoco
import numpy as np
from dm_control import mjcf

from trl_suite.engine import motors, native, pushes
from trl_suite.util import machine
from trl_suite.util.compiled import address, packed

# Arrays that tasks may write. After writing any but ctrl, call `World.forward`.
WRITABLE = ('qpos', 'qvel', 'ctrl')
# Fields that every task reads. A batch copies its fields after every step: others are optional.
READABLE = ('xpos', 'xipos', 'cvel', 'subtree_com', 'sensordata', 'ten_length')
STATE = mujoco.mjtState.mjSTATE_INTEGRATION  # restores a trajectory bit for bit
GRAVITY = 9.8  # m/s^2, of all arenas
CHUNKS = 4  # parts per thread into which env_ids are split, since some take longer than others
LEAST = 4  # simulations per part


class World:
    """n simulations: arrays that tasks read and write, and methods that they call.

    Attributes:
      n: number of simulations.
      models: the MjModel of each simulation; write terrain there, then call `set_const`.
      engine: the same simulations for compiled functions, see `trl_suite.engine.native`.
      pack: `engine` as a pack, for loops over simulations.
      qpos, qvel, ...: the fields of MjData named in `WRITABLE` and `READABLE`, and further ones on
        request, shape (n, ...); those not in `WRITABLE` are read-only.
    """

    qpos: np.ndarray
    qvel: np.ndarray
    ctrl: np.ndarray
    xpos: np.ndarray
    xipos: np.ndarray
    cvel: np.ndarray
    subtree_com: np.ndarray
    sensordata: np.ndarray
    ten_length: np.ndarray
    # Bound only on request.
    M: np.ndarray
    qfrc_bias: np.ndarray
    xanchor: np.ndarray
    site_xpos: np.ndarray
    xquat: np.ndarray
    engine: native.Engine

    def __init__(
        self,
        models: list[mujoco.MjModel],
        data: list[mujoco.MjData],
        fields: Sequence[str],
        live: bool,
        num_threads: int = 1,
    ) -> None:
        """Binds the arrays; see the subclasses.

        Args:
          models: one for each simulation.
          data: one for each simulation.
          fields: further fields of MjData, in addition to `WRITABLE` and `READABLE`.
          live: whether the arrays are views of the data of a single simulation, not copies.
          num_threads: threads that step and reset simulations.
        """
        self.n, self.models = len(models), models
        self.all_ids = np.arange(self.n)
        self._data = data
        self._local = threading.local()
        self._num_threads = num_threads
        self._pool: concurrent.futures.ThreadPoolExecutor | None = None
        names = tuple(dict.fromkeys((*WRITABLE, *READABLE, *fields)))
        arrays = []
        for name in names:
            if live:
                array = getattr(data[0], name)[None]
            else:
                array = np.zeros((self.n, *getattr(data[0], name).shape))
            arrays.append(array)
            if name not in WRITABLE:
                array = array.view()
                array.flags.writeable = False
            setattr(self, name, array)
        mirrored = () if live else names
        self._mirrors = arrays  # kept alive, since `engine` holds their addresses
        self.engine = native.Engine(
            functions=np.array(native.addresses()),
            models=np.array([model._address for model in models]),
            data=np.array([each._address for each in data]),
            warnings=np.array([address(each.warning.number) for each in data]),
            fields=np.array(
                [[address(getattr(each, name)) for name in mirrored] for each in data], np.int64
            ).reshape(self.n, len(mirrored)),
            arrays=np.array([address(array) for array in arrays[: len(mirrored)]], np.int64),
            sizes=np.array([array[0].size for array in arrays[: len(mirrored)]], np.int64),
            written=len(WRITABLE),
            time=np.zeros(self.n),
            steps=np.zeros(self.n, int),
            timestep=models[0].opt.timestep,
        )
        self.pack = packed(self.engine)

    def set_motors(
        self, limits: motors.Limits, noise: motors.Noise, units: int, slots: int
    ) -> motors.MotorState:
        """Makes motors imperfect; for the arguments see `trl_suite.engine.motors.motors`.

        It must be called before a task keeps `engine`.

        Returns:
          The state of the motors, to be drawn at the start of episodes, saved and restored.
        """
        made = motors.motors(self.models, self._data, limits, noise, units, slots)
        self._extend(motors=made)
        return made.state

    def add_pushes(self) -> int:
        """Adds a series of pushes to `engine.pushes`, to be filled in; returns its index.

        It must be called before a task keeps `engine`.
        """
        series = 0 if self.engine.pushes is None else len(self.engine.pushes.body)
        applied = np.array([address(each.xfrc_applied) for each in self._data])
        self._extend(pushes=pushes.no_pushes(applied, series + 1))
        return series

    def _extend(self, **parts: Any) -> None:
        self.engine = self.engine._replace(**parts)
        self.pack = packed(self.engine)

    # Methods for tasks; env_ids are sorted indices of simulations, without repeats. Those that do not
    # exist raise an IndexError.

    def step(self, nstep: int, env_ids: np.ndarray | None = None) -> None:
        """Advances some or all simulations by `nstep` physics steps; velocities are then current."""
        if env_ids is None or env_ids is self.all_ids:
            native.step_all(self.all_ids, nstep, self.pack)
        else:
            native.step_all(self.all_ids[env_ids], nstep, self.pack)

    def forward(self, env_ids: np.ndarray) -> None:
        """Recomputes all quantities that depend on the state, after the state was written."""
        native.forward_all(self.all_ids[env_ids], self.pack)

    def reset(self, env_ids: np.ndarray) -> None:
        """Resets simulations to the model's initial state and clears their warnings."""
        native.reset_all(self.all_ids[env_ids], self.pack)

    def set_const(self, env_id: int, ground_only: bool = False) -> None:
        """Recomputes what MuJoCo derives from a model, after the model was changed.

        Without this call, bodies fall through changed geoms.

        Args:
          env_id: index of the simulation.
          ground_only: whether only poses and sizes of geoms of static bodies were changed.
        """
        scratch = getattr(self._local, 'scratch', None)
        if scratch is None:  # one per thread: mj_setConst overwrites the state of its MjData
            scratch = self._local.scratch = mujoco.MjData(self.models[0])
        update = native.set_bounds() if ground_only else mujoco.mj_setConst
        update(self.models[env_id], scratch)

    def get_state(self, env_id: int) -> np.ndarray:
        """Returns the full integration state of one simulation."""
        model = self.models[env_id]
        state = np.empty(mujoco.mj_stateSize(model, STATE))
        mujoco.mj_getState(model, self._data[env_id], state, STATE)
        return state

    def set_state(self, env_id: int, state: np.ndarray) -> None:
        """Restores one simulation, bit for bit, and clears its warnings."""
        model, data = self.models[env_id], self._data[env_id]
        mujoco.mj_setState(model, data, state, STATE)
        data.warning.number[:] = 0
        self.engine.time[env_id] = data.time
        mujoco.mj_forward(model, data)
        native.physics_to_arrays(self.all_ids[env_id], self.pack)  # not a negative index

    @property
    def time(self) -> np.ndarray:
        """Simulated time since the reset of each simulation, (n,) s."""
        return self.engine.time

    def share(self, work: Callable[[np.ndarray], None], env_ids: np.ndarray) -> None:
        """Calls a function on the threads, each time for a part of the simulations.

        Args:
          work: called with parts of env_ids; its results must not depend on how these are split.
          env_ids: sorted indices of simulations.

        Raises:
          Exception: the first exception that `work` raised, after all parts have finished.
        """
        threads = min(self._num_threads, max(1, len(env_ids) // LEAST))
        if threads == 1 or not len(env_ids):
            work(env_ids)
            return
        if self._pool is None:
            self._pool = concurrent.futures.ThreadPoolExecutor(self._num_threads, 'trl_suite')
        parts = np.array_split(env_ids, min(CHUNKS * threads, max(1, len(env_ids) // LEAST)))
        running = [self._pool.submit(work, part) for part in parts]
        try:
            concurrent.futures.wait(running)
        except BaseException:  # a keyboard interrupt: no work may continue after this method ends
            for each in running:
                each.cancel()
            concurrent.futures.wait(running)
            raise
        for each in running:
            each.result()

    def close(self) -> None:
        """Stops the threads."""
        if self._pool is not None:
            self._pool.shutdown()
            self._pool = None

    def posed(self, qpos: np.ndarray, pose: np.ndarray) -> mujoco.MjData:
        """Returns new data of the first model in a pose, with positions of bodies and geoms.

        It is independent of the simulations.

        Args:
          qpos: addresses in qpos, (k,); the other entries have the model's initial values.
          pose: values at these addresses, (k,).
        """
        model = self.models[0]
        data = mujoco.MjData(model)
        data.qpos[qpos] = pose
        mujoco.mj_kinematics(model, data)
        return data

    def body_ids(self, names: Sequence[str]) -> np.ndarray:
        return self._ids(mujoco.mjtObj.mjOBJ_BODY, names)

    def site_ids(self, names: Sequence[str]) -> np.ndarray:
        return self._ids(mujoco.mjtObj.mjOBJ_SITE, names)

    def geom_ids(self, names: Sequence[str]) -> np.ndarray:
        return self._ids(mujoco.mjtObj.mjOBJ_GEOM, names)

    def joint_addresses(self, names: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
        """Returns the first address of each joint in qpos and in qvel."""
        ids, model = self._ids(mujoco.mjtObj.mjOBJ_JOINT, names), self.models[0]
        # Of NumPy's index type, so that it is not cast in every step.
        return model.jnt_qposadr[ids].astype(int), model.jnt_dofadr[ids].astype(int)

    def sensor_addresses(self, names: Sequence[str]) -> np.ndarray:
        """Returns the addresses of one-dimensional sensors in sensordata."""
        return self.models[0].sensor_adr[self._ids(mujoco.mjtObj.mjOBJ_SENSOR, names)]

    def control_addresses(self, names: Sequence[str]) -> np.ndarray:
        """Returns the addresses of single-input actuators in ctrl."""
        # Not the actuator's id: an actuator may have several controls.
        return self.models[0].actuator_ctrladr[self._ids(mujoco.mjtObj.mjOBJ_ACTUATOR, names)]

    def _ids(self, kind: mujoco.mjtObj, names: Sequence[str]) -> np.ndarray:
        model = self.models[0]
        ids = np.array([mujoco.mj_name2id(model, int(kind), name) for name in names], int)
        if (ids < 0).any():
            missing = [name for name, i in zip(names, ids, strict=True) if i < 0]
            raise ValueError(f'the model has no {kind.name[6:].lower()} named {missing}')
        return ids


class PhysicsWorld(World):
    """One simulation of a dm_control Physics; the arrays are views of its fields."""

    def __init__(self, physics: mjcf.Physics, fields: Sequence[str] = ()) -> None:
        # Keep the raw pointers, not the physics: dm_control passes a weak proxy.
        super().__init__([physics.model.ptr], [physics.data.ptr], fields, live=True)


class BatchWorld(World):
    """n simulations, each with its own copy of the model, stepped on threads."""

    def __init__(
        self, model: mujoco.MjModel, n: int, num_threads: int = 0, fields: Sequence[str] = ()
    ) -> None:
        """Makes n simulations.

        Args:
          model: copied once per simulation, so it should be small; see `light_model`.
          n: number of simulations.
          num_threads: threads that step them; 0 for all cores that this process may use.
          fields: further fields of MjData, in addition to `WRITABLE` and `READABLE`.
        """
        models = [copy.copy(model) for _ in range(n)]
        threads = num_threads or machine.cores()
        super().__init__(models, [mujoco.MjData(each) for each in models], fields, False, threads)
        self.reset(self.all_ids)


def light_model(root: mjcf.RootElement) -> mujoco.MjModel:
    """Compiles MJCF without textures and materials: the same physics, a hundredth of the size."""
    spec = mujoco.MjSpec.from_string(root.to_xml_string(), assets=root.get_assets())
    for item in (*spec.geoms, *spec.sites, *spec.tendons, *spec.skins):
        item.material = ''  # a material that is still referenced cannot be deleted
    for item in (*spec.materials, *spec.textures):
        spec.delete(item)
    return spec.compile()
