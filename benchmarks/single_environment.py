"""Measures the speed of a single environment relative to raw MuJoCo; ratios within one run.

    python benchmarks/single_environment.py [--steps N] [--json FILE]

An environment is stepped with a sequence of actions; `step` calls are timed, resets are not. Then
the same model is set to the same start states and stepped with the same controls by raw `mj_step`,
with the same number of substeps. The ratio raw time / environment time is 1 if the environment has
no overhead. Two workloads: random actions (the character is in the air half of the time, where
physics is cheapest) and action 0 (the character holds its mean pose until it falls, always in
contact). The walker of dm_control's suite is measured in the same way. Blocks of all cases
alternate, so that changes of the machine's speed do not bias the ratios; printed are medians over
blocks.
"""

import argparse
import pathlib
import statistics
import time

import mujoco
import numpy as np

from trl_suite import suite  # isort: skip  (before dm_control: it selects the rendering backend)
from dm_control import suite as dm_suite

from trl_suite.util import files
from trl_suite.util.program import begin_script

ID = 'PD_Biped2D_Gaps_Terrain-v0'
BLOCK = 200  # control steps
WORKLOADS = {'random actions': 1.0, 'action 0': 0.0}
STATE = mujoco.mjtState.mjSTATE_INTEGRATION


def block(environment, substeps, scale, random, steps):
    """Times one block; returns (environment seconds, raw seconds, reset seconds per reset)."""
    model, data = environment.physics.model.ptr, environment.physics.data.ptr
    size = mujoco.mj_stateSize(model, STATE)
    spec = environment.action_spec()
    episodes, controls, resets = [], [], []
    spent, taken, last = 0.0, 0, True
    while taken < steps:
        if last:
            begin = time.perf_counter()
            environment.reset()
            resets.append(time.perf_counter() - begin)
            state = np.empty(size)
            mujoco.mj_getState(model, data, state, STATE)
            # A new copy of the model per episode, because the terrain is part of the model.
            episodes.append((taken, state, mujoco.MjModel.__copy__(model)))
        action = scale * random.uniform(spec.minimum, spec.maximum, spec.shape)
        begin = time.perf_counter()
        time_step = environment.step(action)
        spent += time.perf_counter() - begin
        controls.append(data.ctrl.copy())
        last = time_step.last()
        taken += 1
    raw = 0.0
    bounds = [start for start, _, _ in episodes[1:]] + [taken]
    for (start, state, copy), end in zip(episodes, bounds, strict=True):
        simulation = mujoco.MjData(copy)
        mujoco.mj_setState(copy, simulation, state, STATE)
        mujoco.mj_forward(copy, simulation)
        for i in range(start, end):
            begin = time.perf_counter()
            simulation.ctrl[:] = controls[i]
            mujoco.mj_step(copy, simulation, substeps)
            raw += time.perf_counter() - begin
    return spent, raw, resets


def measure(cases, blocks):
    """Runs alternating blocks; returns per case (ratio, control steps per second, reset ms)."""
    found = {name: ([], [], []) for name in cases}
    for i in range(blocks + 1):
        for name, (environment, substeps, scale) in cases.items():
            random = np.random.default_rng(i)
            spent, raw, resets = block(environment, substeps, scale, random, BLOCK)
            if i:  # the first block is a warm-up
                found[name][0].append(raw / spent)
                found[name][1].append(BLOCK / spent)
                found[name][2].extend(resets)
    return {
        name: {
            'ratio to raw mj_step': round(statistics.median(ratios), 3),
            'control steps per second': round(statistics.median(rates)),
            'median reset, ms': round(1e3 * statistics.median(resets), 2),
        }
        for name, (ratios, rates, resets) in found.items()
    }


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--steps', type=int, default=6000, help='control steps per case')
    parser.add_argument('--json', type=pathlib.Path, help='also write the figures to this file')
    arguments = parser.parse_args()
    cases = {}
    for substeps in (10, 20):
        environment = suite.make(ID, task_kwargs={'random': 0, 'substeps': substeps})
        for workload, scale in WORKLOADS.items():
            cases[f'{ID}, {substeps} substeps, {workload}'] = (environment, substeps, scale)
    walker = dm_suite.load('walker', 'walk', task_kwargs={'random': 0})
    for workload, scale in WORKLOADS.items():
        cases[f'dm_control suite walker-walk, 10 substeps, {workload}'] = (walker, 10, scale)
    figures = measure(cases, max(1, arguments.steps // BLOCK))
    for name, row in figures.items():
        print(name, *(f'{key}: {value}' for key, value in row.items()), sep='\n    ')
    if arguments.json:
        files.write_json(figures, arguments.json)


if __name__ == '__main__':
    begin_script()
    main()
