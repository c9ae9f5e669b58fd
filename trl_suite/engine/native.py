"""MuJoCo's C functions, called from compiled code by their addresses in the loaded library."""

from __future__ import annotations

import ctypes
import functools
import pathlib
from collections.abc import Callable
from typing import Any, NamedTuple

import mujoco
import numpy as np

from trl_suite.engine import motors, pushes
from trl_suite.util.compiled import Compiled, compiled, copy_floats, ints_at

# Functions of type void f(const mjModel*, mjData*), in the order of `Engine.functions`.
NAMES = ('mj_step', 'mj_step1', 'mj_step2', 'mj_forward', 'mj_resetData', 'mj_fwdActuation')
STEP, STEP1, STEP2, FORWARD, RESET, ACTUATION = range(len(NAMES))
_PATTERNS = ('libmujoco.so*', 'libmujoco*.dylib', 'mujoco.dll')
_GROUPS = '3.17.'  # versions with `mj_setConstGroups`
_TYPE = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p)
# The warnings of bad position, velocity and acceleration have consecutive numbers.
BAD = (int(mujoco.mjtWarning.mjWARN_BADQPOS), int(mujoco.mjtWarning.mjWARN_BADQACC) + 1)
_WARNING_STRIDE = 8  # bytes; mjWarningStat has two ints, the second of which is the counter


class Engine(NamedTuple):
    """n simulations as addresses, and the arrays that mirror their fields.

    Attributes:
      functions: addresses of MuJoCo's functions, in the order of `NAMES`.
      models, data: addresses of the mjModel and mjData of each simulation, (n,).
      warnings: address of the counter of the first warning of each simulation, (n,).
      fields: addresses of fields in each mjData, (n, F); F = 0 if the arrays are views of them.
      arrays: addresses of the arrays (n, ...) that mirror these fields, (F,).
      sizes: number of elements of each field, (F,).
      written: number of fields that tasks may write; these come first.
      time: simulated time, (n,) s.
      steps: physics steps since the world was made, (n,).
      timestep: duration of a physics step, s.
      pushes: forces that act while the simulations are advanced; None for none.
      motors: imperfections of the motors; None for none.
    """

    functions: np.ndarray
    models: np.ndarray
    data: np.ndarray
    warnings: np.ndarray
    fields: np.ndarray
    arrays: np.ndarray
    sizes: np.ndarray
    written: int
    time: np.ndarray
    steps: np.ndarray
    timestep: float
    pushes: pushes.Pushes | None = None
    motors: motors.Motors | None = None


@functools.cache
def library() -> ctypes.CDLL:
    """Returns MuJoCo's library.

    Raises:
      ImportError: it is not in the folder of the Python package, or has another version.
    """
    folder = pathlib.Path(mujoco.__file__).parent
    found = sorted(path for pattern in _PATTERNS for path in folder.glob(pattern))
    if not found:
        raise ImportError(
            f'no MuJoCo library ({", ".join(_PATTERNS)}) in {folder}; install mujoco from its wheel'
        )
    library = ctypes.CDLL(str(found[0]))
    library.mj_versionString.restype = ctypes.c_char_p
    check_version(library.mj_versionString().decode(), mujoco.mj_versionString(), str(found[0]))
    return library


def addresses() -> tuple[int, ...]:
    """Returns the addresses of MuJoCo's functions, in the order of `NAMES`."""
    return tuple(
        ctypes.cast(getattr(library(), name), ctypes.c_void_p).value or 0 for name in NAMES
    )


def check_version(found: str, expected: str, path: str) -> None:
    """Checks that the versions of the library and of the Python package are equal.

    Raises:
      ImportError: they differ, so that structures may have another layout.
    """
    if found != expected:
        raise ImportError(
            f'{path} is MuJoCo {found}, and the Python package is MuJoCo {expected}; reinstall '
            'mujoco, so that both are of one version'
        )


@functools.cache
def set_bounds() -> Callable[[mujoco.MjModel, mujoco.MjData], None]:
    """Returns a function that does what changed geoms of static bodies need of `mj_setConst`.

    That is its first group of computations, which are independent of the configuration (see
    MJSETCONST_ARRAYS in mjxmacro.h). Few versions of MuJoCo can run a group alone; with the others,
    the function is `mj_setConst`. The result is the same, in a third of the time.
    """
    if not mujoco.__version__.startswith(_GROUPS):
        return mujoco.mj_setConst
    groups = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int)(
        ('mj_setConstGroups', library())
    )
    return lambda model, data: groups(model._address, data._address, 1)


# Calls by address, which need a Numba intrinsic; the Python function does the same.


def _call_native() -> Callable[..., Any]:
    from llvmlite import ir
    from numba import types
    from numba.extending import intrinsic

    @intrinsic
    def call(typing: Any, function: Any, model: Any, data: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            integer = ir.IntType(64)
            pointer = ir.FunctionType(ir.VoidType(), [integer, integer]).as_pointer()
            builder.call(builder.inttoptr(args[0], pointer), args[1:])
            return context.get_dummy_value()

        return types.void(types.int64, types.int64, types.int64), generate

    def call_by_address(function: int, model: int, data: int) -> None:
        call(function, model, data)  # type: ignore[call-arg]

    return call_by_address


def _call(function: int, model: int, data: int) -> None:
    """Calls a function of (mjModel*, mjData*) by its address."""
    _TYPE(int(function))(int(model), int(data))


call = Compiled(_call, _call_native)


# Functions of simulation i.


@compiled
def arrays_to_physics(i: int, engine: Engine) -> None:
    """Copies the fields that tasks may write from the arrays, unless these are views, to the physics."""
    for k in range(min(engine.written, len(engine.sizes))):
        size = engine.sizes[k]
        copy_floats(engine.fields[i, k], engine.arrays[k] + 8 * size * i, size)


@compiled
def physics_to_arrays(i: int, engine: Engine) -> None:
    """Copies all fields from the physics to the arrays."""
    for k in range(len(engine.sizes)):
        size = engine.sizes[k]
        copy_floats(engine.arrays[k] + 8 * size * i, engine.fields[i, k], size)


@compiled
def step(i: int, nstep: int, engine: Engine) -> None:
    """Advances a simulation by `nstep` physics steps.

    In the order of dm_control's `legacy_step`: `mj_step2` for the current step, `mj_step` for the
    others, then `mj_step1`, so that positions and velocities of bodies belong to the new state.
    """
    model, data = engine.models[i], engine.data[i]
    arrays_to_physics(i, engine)
    pushes.push(i, engine.time[i], nstep * engine.timestep, engine.pushes)
    if not step_motors(i, nstep, engine, engine.motors):
        call(engine.functions[STEP2], model, data)
        for _ in range(nstep - 1):
            call(engine.functions[STEP], model, data)
        call(engine.functions[STEP1], model, data)
    for _ in range(nstep):  # one addition per step, for the same rounding as in MuJoCo
        engine.time[i] += engine.timestep
    engine.steps[i] += nstep
    pushes.release(i, engine.pushes)
    physics_to_arrays(i, engine)


@compiled
def step_motors(i: int, nstep: int, engine: Engine, own: motors.Motors | None) -> bool:
    """Advances a simulation by physics steps, before each of which its motors are updated.

    Returns:
      Whether there are motors; otherwise, nothing was done.
    """
    if own is None:
        return False
    model, data = engine.models[i], engine.data[i]
    motors.give(i, own)
    for _ in range(nstep):
        motors.prepare(i, own)
        if len(own.limits.balls.limit) > 0:
            # The limit of a ball joint depends on the direction of the torque that it intends.
            motors.free_balls(i, own)
            call(engine.functions[ACTUATION], model, data)
            motors.limit_balls(i, own)
        call(engine.functions[STEP2], model, data)
        call(engine.functions[STEP1], model, data)
    motors.restore(i, own)
    return True


@compiled
def forward(i: int, engine: Engine) -> None:
    """Recomputes all quantities that depend on the state, after the state was written."""
    arrays_to_physics(i, engine)
    call(engine.functions[FORWARD], engine.models[i], engine.data[i])
    physics_to_arrays(i, engine)


@compiled
def reset(i: int, engine: Engine) -> None:
    """Resets a simulation to the model's initial state and clears its warnings."""
    call(engine.functions[RESET], engine.models[i], engine.data[i])
    engine.time[i] = 0.0
    physics_to_arrays(i, engine)


@compiled
def diverged(i: int, dofs: np.ndarray, limit: float, qvel: np.ndarray, engine: Engine) -> bool:
    """Returns whether a simulation has had a non-finite or huge state since its reset.

    It has diverged as well if the magnitude of any of these velocities is above the limit, or NaN.
    """
    for k in range(BAD[0], BAD[1]):
        if ints_at(engine.warnings[i] + _WARNING_STRIDE * k, 1)[0] > 0:
            return True
    for k in dofs:
        if not abs(qvel[i, k]) <= limit:
            return True
    return False


# Loops over simulations; they take packs.


@compiled
def step_all(env_ids: np.ndarray, nstep: int, engine: Engine) -> None:
    """Advances simulations by `nstep` physics steps each."""
    for i in env_ids:
        step(i, nstep, engine)


@compiled
def forward_all(env_ids: np.ndarray, engine: Engine) -> None:
    """Recomputes all quantities that depend on the states of simulations."""
    for i in env_ids:
        forward(i, engine)


@compiled
def reset_all(env_ids: np.ndarray, engine: Engine) -> None:
    """Resets simulations to the model's initial state."""
    for i in env_ids:
        reset(i, engine)
