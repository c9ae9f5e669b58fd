"""n simulations as arrays: the whole seam between tasks and physics.

Every array of a `World` has a leading axis of n simulations. Tasks read these arrays and call a few
verbs; they never touch the engine otherwise, so one implementation of a task serves the single
environment (n = 1, over one `dm_control` Physics) and a batch.
"""

from __future__ import annotations

import concurrent.futures
import copy
import os
import threading
from collections.abc import Callable, Sequence

import mujoco
import numpy as np
from dm_control import mjcf

from trl_suite.engine import native
from trl_suite.util.compiled import packed

# State arrays that tasks may write. After writing any but ctrl, call `World.forward`.
WRITABLE = (
    'qpos', 'qvel', 'act', 'ctrl', 'qacc_warmstart', 'mocap_pos', 'mocap_quat', 'xfrc_applied',
)  # fmt: skip
# Read by every task. A batch copies fields out after every step, so it binds others on request.
READABLE = ('xpos', 'xipos', 'cvel', 'subtree_com', 'sensordata', 'ten_length')
STATE = mujoco.mjtState.mjSTATE_INTEGRATION  # all that continues a trajectory bit for bit
CHUNKS = 4  # parts per thread into which env_ids are cut, since some take longer than others
LEAST = 4  # simulations in a part


class World:
    """n simulations: what tasks may read, write and ask.

    Attributes:
      n: number of simulations.
      models: the MjModel of each; write terrain there, then call `set_const`.
      engine: the same simulations for compiled functions, see `trl_suite.engine.native`.
      pack: of `engine`, for loops over simulations.
      qpos, qvel, ...: the fields of MjData named in `WRITABLE` and `READABLE`, and what else was
        asked for, shape (n, ...); all but the writable read-only.
    """

    qpos: np.ndarray
    qvel: np.ndarray
    act: np.ndarray
    ctrl: np.ndarray
    qacc_warmstart: np.ndarray
    mocap_pos: np.ndarray
    mocap_quat: np.ndarray
    xfrc_applied: np.ndarray
    xpos: np.ndarray
    xipos: np.ndarray
    cvel: np.ndarray
    subtree_com: np.ndarray
    sensordata: np.ndarray
    ten_length: np.ndarray
    # Bound only for tasks that ask for them.
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
          models: of each simulation.
          data: of each simulation.
          fields: of MjData, beside those of `WRITABLE` and `READABLE`.
          live: whether the arrays are views of the one simulation's data, not copies.
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
        self._mirrors = arrays  # kept alive for the addresses of them
        self.engine = native.Engine(
            functions=np.array(native.addresses()),
            models=np.array([model._address for model in models]),
            data=np.array([each._address for each in data]),
            warnings=np.array([_address(each.warning.number) for each in data]),
            fields=np.array(
                [[_address(getattr(each, name)) for name in mirrored] for each in data], np.int64
            ).reshape(self.n, len(mirrored)),
            arrays=np.array([_address(array) for array in arrays[: len(mirrored)]], np.int64),
            sizes=np.array([array[0].size for array in arrays[: len(mirrored)]], np.int64),
            written=len(WRITABLE),
            time=np.zeros(self.n),
            steps=np.zeros(self.n, int),
            timestep=models[0].opt.timestep,
        )
        self.pack = packed(self.engine)

    # The verbs; env_ids are sorted numbers of simulations, without repeats.

    def step(self, nstep: int, env_ids: np.ndarray | None = None) -> None:
        """Advances some or all simulations by `nstep` physics steps; velocities are then current."""
        native.step_all(self.all_ids if env_ids is None else env_ids, nstep, self.pack)

    def forward(self, env_ids: np.ndarray) -> None:
        """Recomputes everything that depends on a written state."""
        native.forward_all(env_ids, self.pack)

    def reset(self, env_ids: np.ndarray) -> None:
        """Puts simulations into the model's initial state, warnings cleared."""
        native.reset_all(env_ids, self.pack)

    def set_const(self, env_id: int) -> None:
        """Makes edits of the static geoms of a simulation take effect.

        Without it bodies fall through them.
        """
        scratch = getattr(self._local, 'scratch', None)
        if scratch is None:  # for each thread: mj_setConst overwrites the state of its data
            scratch = self._local.scratch = mujoco.MjData(self.models[0])
        mujoco.mj_setConst(self.models[env_id], scratch)

    def get_state(self, env_id: int) -> np.ndarray:
        """Returns the full integration state of one simulation."""
        model = self.models[env_id]
        state = np.empty(mujoco.mj_stateSize(model, STATE))
        mujoco.mj_getState(model, self._data[env_id], state, STATE)
        return state

    def set_state(self, env_id: int, state: np.ndarray) -> None:
        """Restores one simulation so that it continues bit for bit; its warnings are cleared."""
        model, data = self.models[env_id], self._data[env_id]
        mujoco.mj_setState(model, data, state, STATE)
        data.warning.number[:] = 0
        self.engine.time[env_id] = data.time
        mujoco.mj_forward(model, data)
        native.read_all(np.array([env_id]), self.pack)

    def any_diverged(self) -> bool:
        """Whether `diverged` holds for any simulation."""
        return bool(self.diverged().any())

    def diverged(self) -> np.ndarray:
        """Returns which simulations met a non-finite or huge state since their reset, (n,)."""
        found = np.empty(self.n, bool)
        native.diverged_all(self.pack, found)
        return found

    @property
    def time(self) -> np.ndarray:
        """Simulated time since the reset of each simulation, (n,) s."""
        return self.engine.time

    def share(self, work: Callable[[np.ndarray], None], env_ids: np.ndarray) -> None:
        """Has the threads do some work, each for a part of the simulations.

        Args:
          work: is called with parts of env_ids; what it does must not depend on how they are cut.
          env_ids: sorted numbers of simulations.

        Raises:
          Exception: the first one that the work raised; the other parts are finished.
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
        except BaseException:  # a keyboard interrupt: nothing may go on behind the caller's back
            for each in running:
                each.cancel()
            concurrent.futures.wait(running)
            raise
        for each in running:
            each.result()

    def close(self) -> None:
        """Ends the threads."""
        if self._pool is not None:
            self._pool.shutdown()
            self._pool = None

    def posed(self, qpos: np.ndarray, pose: np.ndarray) -> mujoco.MjData:
        """Returns data of the first model in a pose, with the places of its bodies and geoms.

        It is apart from the simulations: for what is measured once.

        Args:
          qpos: addresses in qpos, (k,); elsewhere the model's reference stays.
          pose: values there, (k,).
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
        """Returns where joints begin in qpos and in qvel."""
        ids, model = self._ids(mujoco.mjtObj.mjOBJ_JOINT, names), self.models[0]
        # As numpy's own index type: it need not be cast in every step.
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
    """One simulation over a dm_control Physics, whose fields the arrays are views of."""

    def __init__(self, physics: mjcf.Physics, fields: Sequence[str] = ()) -> None:
        # The raw pointers, not the physics: dm_control hands out weak proxies of it.
        super().__init__([physics.model.ptr], [physics.data.ptr], fields, live=True)


class BatchWorld(World):
    """n simulations, each with a model of its own, stepped on threads."""

    def __init__(
        self, model: mujoco.MjModel, n: int, num_threads: int = 0, fields: Sequence[str] = ()
    ) -> None:
        """Makes n simulations.

        Args:
          model: what all of them share; copied once per simulation, so it should be light.
          n: number of simulations.
          num_threads: threads that step them; 0 takes all cores.
          fields: of MjData, to be bound beside those of `WRITABLE` and `READABLE`.
        """
        models = [copy.copy(model) for _ in range(n)]
        threads = num_threads or os.cpu_count() or 1
        super().__init__(models, [mujoco.MjData(each) for each in models], fields, False, threads)
        self.reset(self.all_ids)


def _address(array: np.ndarray) -> int:
    return array.__array_interface__['data'][0]


def light_model(root: mjcf.RootElement) -> mujoco.MjModel:
    """Compiles a tree without textures and materials: the same physics, a hundredth of the size."""
    spec = mujoco.MjSpec.from_string(root.to_xml_string(), assets=root.get_assets())
    for item in (*spec.geoms, *spec.sites, *spec.tendons, *spec.skins):
        item.material = ''  # one that is still referred to cannot be deleted
    for item in (*spec.materials, *spec.textures):
        spec.delete(item)
    return spec.compile()
