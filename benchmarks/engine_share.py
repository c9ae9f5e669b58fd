"""Measures the share of an environment's time that is spent in the physics engine, on one thread.

    python benchmarks/engine_share.py [IDS ...] [--num-envs 1 64] [--seconds 5] [--json FILE]

The addresses of MuJoCo's functions in `World.engine` are replaced by those of compiled functions
that read a clock, call MuJoCo, and read the clock again (about 50 ns per call). The remaining time
is spent in the environment: control, measurements, rewards, observations, resets and Python.
Actions are random. A share of 1 is the speed of raw `mj_step` in the same states. Resets are
excluded for a single environment, as in `benchmarks/single_environment.py`, and included for vector
environments.
"""

from __future__ import annotations

import argparse
import ctypes
import pathlib
import time
from typing import Any

import numba
import numpy as np
import tqdm

from trl_suite import suite
from trl_suite.util import files
from trl_suite.util.program import begin_script
from trl_suite.vector import VectorEnvironment

IDS = (
    'PD_Biped2D_Gaps_Terrain-v0', 'PD_Dog2D_Slopes_Terrain-v0', 'PD_Biped3D_Imitate-v0',
    'PD_Biped3D_Imitate-Hills_Terrain-v0', 'PD_Biped3D_LLC_General_Step-v0',
    'FSM_Dog2D_Terrain_Mixed-v0', 'PD_Biped3D_HLC_Forest-v0', 'PD_Biped3D_HLC_Soccer-v0',
)  # fmt: skip
MONOTONIC = 1
WARM = 60  # warm-up steps, not measured

_spent = np.zeros(1)  # s, in MuJoCo
_moment = np.zeros(4, np.int64)  # two timespecs
_signature = numba.types.void(numba.types.intp, numba.types.intp)


def timed(function: int) -> Any:
    """Returns a C function of (model, data) that calls another and accumulates its time."""
    libc = ctypes.CDLL(None)
    clock = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_int, ctypes.c_void_p)(('clock_gettime', libc))
    call = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p)(function)
    spent = _spent.ctypes.data
    begin = _moment.ctypes.data

    @numba.cfunc(_signature)
    def measured(model, data):  # type: ignore[no-untyped-def]
        clock(MONOTONIC, begin)
        call(model, data)
        clock(MONOTONIC, begin + 16)
        moments = numba.carray(numba_pointer(begin), (4,), np.int64)
        total = numba.carray(numba_pointer(spent), (1,), np.float64)
        total[0] += moments[2] - moments[0] + 1e-9 * (moments[3] - moments[1])

    measured.kept = clock, call
    return measured


@numba.extending.intrinsic
def numba_pointer(typing: Any, address: Any) -> Any:
    """Converts an address to a pointer."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.inttoptr(args[0], context.get_value_type(signature.return_type))

    return numba.types.voidptr(numba.types.int64), generate


def instrument(world: Any) -> None:
    """Replaces a world's MuJoCo functions by timed ones."""
    world.timed = [timed(int(address)) for address in world.engine.functions]
    world.engine.functions[:] = [each.address for each in world.timed]


def single(id_: str, seconds: float) -> dict[str, float]:
    """Measures one environment; resets are not timed."""
    environment = suite.make(id_, {'random': 0})
    rng, size = np.random.default_rng(0), len(environment.action_map)
    instrument(environment.task.world)
    spent, steps, physics, last = 0.0, -WARM, 0.0, True
    while spent < seconds:
        if last:
            environment.reset()
        action = rng.uniform(-1, 1, size)
        before, begin = _spent[0], time.perf_counter()
        last = environment.step(action).last()
        if steps >= 0:
            spent += time.perf_counter() - begin
            physics += _spent[0] - before
        steps += 1
    return {'share': physics / spent, 'steps per second': steps / spent}


def batch(id_: str, num_envs: int, seconds: float) -> dict[str, float]:
    """Measures a vector environment including resets, and the time per reset."""
    environments = VectorEnvironment(id_, num_envs, 1, seed=0)
    environments.reset()
    rng, size = np.random.default_rng(0), len(environments.action_map)
    instrument(environments.task.world)
    core: Any = environments.core
    begin = core.begin
    resets = [0, 0.0]

    def counted(env_ids: np.ndarray) -> None:
        moment = time.perf_counter()
        begin(env_ids)
        resets[0] += len(env_ids)
        resets[1] += time.perf_counter() - moment

    core.begin = counted
    actions = rng.uniform(-1, 1, (64, num_envs, size))
    for k in range(40):
        environments.step(actions[k % 64])
    resets[:] = 0, 0.0
    moment, physics, steps = time.perf_counter(), _spent[0], 0
    while time.perf_counter() - moment < seconds:
        environments.step(actions[steps % 64])
        steps += 1
    spent = time.perf_counter() - moment
    environments.close()
    return {
        'share': (_spent[0] - physics) / spent,
        'steps per second': steps * num_envs / spent,
        'reset, ms': 1e3 * resets[1] / max(1, resets[0]),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('ids', nargs='*', default=IDS)
    parser.add_argument('--num-envs', type=int, nargs='*', default=(1, 64))
    parser.add_argument('--seconds', type=float, default=5.0, help='of each measurement')
    parser.add_argument('--json', type=pathlib.Path, help='also write the figures to this file')
    arguments = parser.parse_args()
    figures: dict[str, Any] = {}
    cases = [(id_, n) for id_ in arguments.ids for n in arguments.num_envs]
    for id_, n in tqdm.tqdm(cases):
        found = single(id_, arguments.seconds) if n == 1 else batch(id_, n, arguments.seconds)
        figures[f'{id_}, {n}'] = {name: round(value, 4) for name, value in found.items()}
        tqdm.tqdm.write(f'{id_}, {n}: ' + ', '.join(f'{k} {v:.3g}' for k, v in found.items()))
    if arguments.json:
        files.write_json(figures, arguments.json)


if __name__ == '__main__':
    begin_script()
    main()
