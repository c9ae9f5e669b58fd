"""What a high-level step costs against the footstep controller's own stepping; ratios of one run.

    python benchmarks/hierarchy.py [--num_envs N] [--seconds S] [ID ...]

Prints, on one thread, per 1/30 s of one simulation and resets included:

- the footstep environment driven by the shipped controller: its time;
- each high-level environment under small random actions: its time as a multiple of that.

What the physics takes of it, `benchmarks/engine_share.py` prints.
"""

import argparse
import time

import numpy as np

from trl_suite import policies
from trl_suite.cli import bench
from trl_suite.controllers import footstep_controller
from trl_suite.registry import catalogue
from trl_suite.tasks.navigation import hierarchical_rules
from trl_suite.vector import VectorEnvironment

HALF_RANGE = 0.1  # of the random plans about action 0, straight on
WARM = 2  # steps; the first ones are cold


def measured(environments, act, frames, seconds):
    """Steps for some seconds; returns s per frame of a simulation."""
    observation = environments.reset()
    for _ in range(WARM):
        observation = environments.step(act(observation)).observation
    count, begin = 0, time.perf_counter()
    while time.perf_counter() - begin < seconds:
        observation = environments.step(act(observation)).observation
        count += frames(environments)
    return (time.perf_counter() - begin) / count


def footsteps(num_envs, seconds):
    """The footstep environment, driven by the shipped controller."""
    controller = footstep_controller.load(policies.reference(hierarchical_rules.CONTROLLER))
    environments = VectorEnvironment(hierarchical_rules.CONTROLLER, num_envs, 1, 0)
    return measured(
        environments, lambda o: np.clip(controller(o), -1, 1), lambda e: num_envs, seconds
    )


def high_level(id_, num_envs, seconds):
    """A high-level environment under random actions."""
    environments, random = VectorEnvironment(id_, num_envs, 1, 0), np.random.default_rng(0)
    shape = (num_envs, len(environments.action_map))
    return measured(
        environments, lambda o: random.uniform(-HALF_RANGE, HALF_RANGE, shape),
        lambda e: round(e.info['duration'].sum() / bench.CONTROL_TIMESTEP), seconds,
    )  # fmt: skip


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    all_ = [id_ for id_ in catalogue.BY_ID if '_HLC_' in id_]
    parser.add_argument('ids', nargs='*', metavar='ID', default=all_)
    parser.add_argument('--num-envs', type=int, default=64)
    parser.add_argument('--seconds', type=float, default=4.0, help='per measurement')
    arguments = parser.parse_args()
    base = footsteps(arguments.num_envs, arguments.seconds)
    print(f'{hierarchical_rules.CONTROLLER}: {1e6 * base:.0f} us')
    for id_ in arguments.ids:
        cost = high_level(id_, arguments.num_envs, arguments.seconds)
        print(f'{id_}: {cost / base:.2f} times as much', flush=True)
    again = footsteps(arguments.num_envs, arguments.seconds)
    print(f'the first measurement again: {again / base:.2f} times as much')


if __name__ == '__main__':
    main()
