"""Trains the planner of a task on for another footstep controller (DeepLoco, supplement, table 3).

    python training/transfer_planners.py PD_Biped3D_HLC_Soccer-v0 PD_Biped3D_LLC_HighKnees_Step-v0

It starts from the shipped planner, by PPO; an interrupted run continues from its checkpoint in --output.
The result of `evaluate_plans.py` with this planner and controller is written to trained/plans.json.
"""

from __future__ import annotations

import argparse
import dataclasses
import pathlib

import evaluate_plans
import ppo
import runs
from settings import Settings, settings_for

from trl_suite import policies, suite
from trl_suite.util.program import begin_script

SAMPLES = 2.4e5  # footsteps
EPISODES = 32


def fine_tuned(id_: str, controller: str, samples: float) -> Settings:
    """Returns the settings of a training that continues with a controller."""
    options = {'controller': controller}
    return dataclasses.replace(
        settings_for(id_), samples=samples, start=id_, start_count=1e6, num_envs=128, minibatch=512,
        last_learning_rate=3e-5, value_first=2e4, value_rate=1e-3, value_goes_on=True, further=(),
        stages=((0.0, options),), evaluated_with=options, evaluate_every=8e4,
    )  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('id', help='of the planned environment')
    parser.add_argument('controller', help='id of the environment of the footstep controller')
    parser.add_argument('--samples', type=float, default=SAMPLES, help='footsteps')
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--output', type=pathlib.Path, default=pathlib.Path('runs'))
    arguments = parser.parse_args()
    id_, controller = suite.find(arguments.id).id, suite.find(arguments.controller).id
    folder = arguments.output / f'{id_}_with_{controller}' / f'seed_{arguments.seed}'
    settings = fine_tuned(id_, controller, arguments.samples)
    ppo.train(id_, arguments.seed, settings, folder, 1)
    policy = policies.load(folder / 'policy.npz')
    result = evaluate_plans.run(
        id_, lambda environments: policy, EPISODES, 0, controller=controller
    )
    found = runs.read('plans.json')
    found.setdefault(id_, {})[f'fine-tuned with {controller}'] = result
    runs.write('plans.json', found)
    print({name: round(value, 3) for name, value in result.items()})


if __name__ == '__main__':
    begin_script()
    main()
