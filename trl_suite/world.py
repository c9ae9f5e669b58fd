"""n simulations as arrays: the whole seam between tasks and physics.

Every array of a `World` has a leading axis of n simulations. Tasks read these arrays and call a few
verbs; they never touch the engine otherwise, so one implementation of a task serves the single
environment (n = 1, over one `dm_control` Physics) and a batch.
"""

from __future__ import annotations

import abc
from collections.abc import Sequence

import mujoco
import numpy as np
from dm_control import mjcf

# State arrays that tasks may write. After writing any but ctrl, call `World.forward`.
WRITABLE = ('qpos', 'qvel', 'act', 'ctrl', 'qacc_warmstart', 'mocap_pos', 'mocap_quat')
READABLE = (
    'xpos', 'xquat', 'xmat', 'xipos', 'cvel', 'subtree_com', 'geom_xpos', 'geom_xmat', 'sensordata',
    'ten_length', 'actuator_force',
)  # fmt: skip
STATE = mujoco.mjtState.mjSTATE_INTEGRATION  # all that continues a trajectory bit for bit
# Bad position, velocity and acceleration are neighbours among the warnings.
_DIVERGED = slice(mujoco.mjtWarning.mjWARN_BADQPOS, mujoco.mjtWarning.mjWARN_BADQACC + 1)


class World:
    """n simulations: what tasks may read, write and ask.

    Attributes:
      n: number of simulations.
      models: the MjModel of each; write terrain there, then call `set_const`.
      qpos, qvel, ...: the fields of MjData named in `WRITABLE` and `READABLE`, shape (n, ...);
        live views, the latter read-only.
    """

    qpos: np.ndarray
    qvel: np.ndarray
    act: np.ndarray
    ctrl: np.ndarray
    qacc_warmstart: np.ndarray
    mocap_pos: np.ndarray
    mocap_quat: np.ndarray
    xpos: np.ndarray
    xquat: np.ndarray
    xmat: np.ndarray
    xipos: np.ndarray
    cvel: np.ndarray
    subtree_com: np.ndarray
    geom_xpos: np.ndarray
    geom_xmat: np.ndarray
    sensordata: np.ndarray
    ten_length: np.ndarray
    actuator_force: np.ndarray

    def __init__(self, model: mujoco.MjModel, models: list[mujoco.MjModel]) -> None:
        self.n = len(models)
        self.models = models
        self._model = model
        self._scratch = mujoco.MjData(model)  # mj_setConst overwrites the state of its data

    # The verbs; rows are numbers of simulations.

    @abc.abstractmethod
    def step(self, nstep: int) -> None:
        """Advances all simulations by `nstep` substeps in C, positions and velocities current."""

    @abc.abstractmethod
    def forward(self, row: int) -> None:
        """Recomputes everything that depends on a written state."""

    @abc.abstractmethod
    def reset(self, row: int) -> None:
        """Puts one simulation into the model's initial state, warnings cleared."""

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

    def geom_ids(self, names: Sequence[str]) -> np.ndarray:
        return self._ids(mujoco.mjtObj.mjOBJ_GEOM, names)

    def joint_addresses(self, names: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
        """Returns the addresses of one-dimensional joints in qpos and in qvel."""
        ids = self._ids(mujoco.mjtObj.mjOBJ_JOINT, names)
        return self._model.jnt_qposadr[ids], self._model.jnt_dofadr[ids]

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

    def __init__(self, physics: mjcf.Physics) -> None:
        # The raw pointers, not the physics: dm_control hands out weak proxies of it.
        model, self._data = physics.model.ptr, physics.data.ptr
        super().__init__(model, [model])
        self._divergence = self._data.warning.number[_DIVERGED]
        for field in WRITABLE + READABLE:
            view = getattr(self._data, field)[None]
            if field in READABLE:
                view.flags.writeable = False
            setattr(self, field, view)

    def step(self, nstep: int) -> None:
        # The order of dm_control's default (`legacy_step`): finish the open step, run the others,
        # and begin the next, so that kinematics belong to the new state.
        mujoco.mj_step2(self._model, self._data)
        if nstep > 1:
            mujoco.mj_step(self._model, self._data, nstep - 1)
        mujoco.mj_step1(self._model, self._data)

    def forward(self, row: int) -> None:
        mujoco.mj_forward(self._model, self._data)

    def reset(self, row: int) -> None:
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
