"""n simulations as arrays: the whole seam between tasks and physics.

Every array of a `World` has a leading axis of n simulations. Tasks read these arrays and call a few
verbs; they never touch the engine otherwise, so one implementation of a task serves the single
environment (n = 1, over one `dm_control` Physics) and a batch.
"""

from __future__ import annotations

import abc
import copy
from collections.abc import Sequence

import mujoco
import numpy as np
from dm_control import mjcf
from mujoco import batch

# State arrays that tasks may write. After writing any but ctrl, call `World.forward`.
WRITABLE = ('qpos', 'qvel', 'act', 'ctrl', 'qacc_warmstart', 'mocap_pos', 'mocap_quat')
FORCES = ('xfrc_applied',)  # may be written by tasks that ask for them
# Only what some task reads: a batch copies out every field for every row at every call.
READABLE = ('xpos', 'xipos', 'cvel', 'subtree_com', 'sensordata', 'ten_length')
STATE = mujoco.mjtState.mjSTATE_INTEGRATION  # all that continues a trajectory bit for bit
# Bad position, velocity and acceleration are neighbours among the warnings.
_DIVERGED = slice(mujoco.mjtWarning.mjWARN_BADQPOS, mujoco.mjtWarning.mjWARN_BADQACC + 1)


class World:
    """n simulations: what tasks may read, write and ask.

    Attributes:
      n: number of simulations.
      models: the MjModel of each; write terrain there, then call `set_const`.
      qpos, qvel, ...: the fields of MjData named in `WRITABLE` and `READABLE`, and what else was
        asked for, shape (n, ...); live views, all but the writable read-only.
    """

    qpos: np.ndarray
    qvel: np.ndarray
    act: np.ndarray
    ctrl: np.ndarray
    qacc_warmstart: np.ndarray
    mocap_pos: np.ndarray
    mocap_quat: np.ndarray
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
    xfrc_applied: np.ndarray

    def __init__(self, model: mujoco.MjModel, models: list[mujoco.MjModel]) -> None:
        self.n = len(models)
        self.models = models
        self._model = model
        self._scratch = mujoco.MjData(model)  # mj_setConst overwrites the state of its data

    # The verbs; rows are sorted numbers of simulations, without repeats.

    @abc.abstractmethod
    def step(self, nstep: int, rows: np.ndarray | None = None) -> None:
        """Advances some or all simulations by `nstep` substeps in C, velocities current."""

    @abc.abstractmethod
    def forward(self, rows: np.ndarray) -> None:
        """Recomputes everything that depends on a written state."""

    @abc.abstractmethod
    def reset(self, rows: np.ndarray) -> None:
        """Puts simulations into the model's initial state, warnings cleared."""

    @abc.abstractmethod
    def set_const(self, row: int) -> None:
        """Makes edits of a row's static geoms take effect; without it bodies fall through them."""

    @abc.abstractmethod
    def get_state(self, row: int) -> np.ndarray:
        """Returns the full integration state of one simulation."""

    @abc.abstractmethod
    def set_state(self, row: int, state: np.ndarray) -> None:
        """Restores one simulation so that it continues bit for bit."""

    @abc.abstractmethod
    def any_diverged(self) -> bool:
        """Whether `diverged` holds for any simulation; the cheap test of every step."""

    @abc.abstractmethod
    def diverged(self) -> np.ndarray:
        """Returns which simulations met a non-finite or huge state since their reset, (n,)."""

    def body_ids(self, names: Sequence[str]) -> np.ndarray:
        return self._ids(mujoco.mjtObj.mjOBJ_BODY, names)

    def site_ids(self, names: Sequence[str]) -> np.ndarray:
        return self._ids(mujoco.mjtObj.mjOBJ_SITE, names)

    def geom_ids(self, names: Sequence[str]) -> np.ndarray:
        return self._ids(mujoco.mjtObj.mjOBJ_GEOM, names)

    def joint_addresses(self, names: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
        """Returns where joints begin in qpos and in qvel."""
        ids = self._ids(mujoco.mjtObj.mjOBJ_JOINT, names)
        # As numpy's own index type: it need not be cast in every step.
        return self._model.jnt_qposadr[ids].astype(int), self._model.jnt_dofadr[ids].astype(int)

    def sensor_addresses(self, names: Sequence[str]) -> np.ndarray:
        """Returns the addresses of one-dimensional sensors in sensordata."""
        return self._model.sensor_adr[self._ids(mujoco.mjtObj.mjOBJ_SENSOR, names)]

    def control_addresses(self, names: Sequence[str]) -> np.ndarray:
        """Returns the addresses of single-input actuators in ctrl."""
        # Not the actuator's id: an actuator may have several controls.
        return self._model.actuator_ctrladr[self._ids(mujoco.mjtObj.mjOBJ_ACTUATOR, names)]

    def _ids(self, kind: mujoco.mjtObj, names: Sequence[str]) -> np.ndarray:
        ids = np.array([mujoco.mj_name2id(self._model, int(kind), name) for name in names], int)
        if (ids < 0).any():
            missing = [name for name, i in zip(names, ids, strict=True) if i < 0]
            raise ValueError(f'the model has no {kind.name[6:].lower()} named {missing}')
        return ids


class PhysicsWorld(World):
    """One simulation over a dm_control Physics."""

    def __init__(self, physics: mjcf.Physics, fields: Sequence[str] = ()) -> None:
        # The raw pointers, not the physics: dm_control hands out weak proxies of it.
        model, self._data = physics.model.ptr, physics.data.ptr
        super().__init__(model, [model])
        self._divergence = self._data.warning.number[_DIVERGED]
        for field in _bound(fields):
            view = getattr(self._data, field)[None]
            if field not in (*WRITABLE, *FORCES):
                view.flags.writeable = False
            setattr(self, field, view)

    def step(self, nstep: int, rows: np.ndarray | None = None) -> None:
        # The order of dm_control's default (`legacy_step`): finish the open step, run the others,
        # and begin the next, so that kinematics belong to the new state.
        mujoco.mj_step2(self._model, self._data)
        if nstep > 1:
            mujoco.mj_step(self._model, self._data, nstep - 1)
        mujoco.mj_step1(self._model, self._data)

    def forward(self, rows: np.ndarray) -> None:
        mujoco.mj_forward(self._model, self._data)

    def reset(self, rows: np.ndarray) -> None:
        mujoco.mj_resetData(self._model, self._data)

    def set_const(self, row: int) -> None:
        mujoco.mj_setConst(self._model, self._scratch)

    def get_state(self, row: int) -> np.ndarray:
        state = np.empty(mujoco.mj_stateSize(self._model, STATE))
        mujoco.mj_getState(self._model, self._data, state, STATE)
        return state

    def set_state(self, row: int, state: np.ndarray) -> None:
        mujoco.mj_setState(self._model, self._data, state, STATE)
        mujoco.mj_forward(self._model, self._data)

    def any_diverged(self) -> bool:
        return any(self._divergence.tolist())

    def diverged(self) -> np.ndarray:
        return np.array([self.any_diverged()])


class BatchWorld(World):
    """n simulations over a `mujoco.batch.Batch`, each with a model of its own.

    Forking a process that holds one leaves the child without the batch's threads; see
    `trl_suite.vector`.
    """

    def __init__(
        self, model: mujoco.MjModel, n: int, num_threads: int, fields: Sequence[str] = ()
    ) -> None:
        """Makes n simulations.

        Args:
          model: what all of them share; copied once per simulation, so it should be light.
          n: number of simulations.
          num_threads: threads that step them; 0 takes all cores.
          fields: of MjData, to be bound beside those of `WRITABLE` and `READABLE`.
        """
        super().__init__(model, [copy.copy(model) for _ in range(n)])
        self.batch = batch.Batch(model, n, nthread=num_threads)
        self._edited = True  # whether the batch must be told of edits of the models
        for field in _bound(fields):
            setattr(self, field, self.batch.bind(field))
        self._tell()
        # A field is zero until the first call after it was bound.
        self.batch.reset()
        self._initial = self.batch.state[0].copy()
        self._divergence = self.batch.warning[:, _DIVERGED, 1]

    def _tell(self) -> None:
        if self._edited:
            self.batch.set_models(self.models)
            self._edited = False

    def step(self, nstep: int, rows: np.ndarray | None = None) -> None:
        self._tell()
        self.batch.step(rows, nstep=nstep, stage=mujoco.mjtStage.mjSTAGE_VEL)

    def forward(self, rows: np.ndarray) -> None:
        self._tell()
        # What only accelerations need is computed by the next step.
        self.batch.forward(rows, stage=mujoco.mjtStage.mjSTAGE_VEL)

    def reset(self, rows: np.ndarray) -> None:
        # What `batch.reset` does, at a tenth of its price; no row's model has another initial state.
        self.batch.state[rows] = self._initial
        self.batch.warning[rows] = 0

    def set_const(self, row: int) -> None:
        mujoco.mj_setConst(self.models[row], self._scratch)
        self._edited = True

    def get_state(self, row: int) -> np.ndarray:
        return self.batch.state[row].copy()

    def set_state(self, row: int, state: np.ndarray) -> None:
        self.batch.state[row] = state
        self.forward(np.array([row]))

    def any_diverged(self) -> bool:
        return bool(np.count_nonzero(self._divergence))

    def diverged(self) -> np.ndarray:
        return self._divergence.any(1)


def _bound(fields: Sequence[str]) -> tuple[str, ...]:
    return tuple(dict.fromkeys((*WRITABLE, *READABLE, *fields)))


def light_model(root: mjcf.RootElement) -> mujoco.MjModel:
    """Compiles a tree without textures and materials: the same physics, a hundredth of the size."""
    spec = mujoco.MjSpec.from_string(root.to_xml_string(), assets=root.get_assets())
    for item in (*spec.geoms, *spec.sites, *spec.tendons, *spec.skins):
        item.material = ''  # one that is still referred to cannot be deleted
    for item in (*spec.materials, *spec.textures):
        spec.delete(item)
    return spec.compile()
