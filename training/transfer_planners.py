"""Trains the planner of a task on for other footstep controllers (DeepLoco, supplement, table 3).

    python training/transfer_planners.py PD_Biped3D_HLC_Soccer-v0 PD_Biped3D_LLC_HighKnees_Step-v0
    python training/transfer_planners.py PD_Biped3D_HLC_Soccer-v0 PD_Biped3D_LLC_{General,Stand}_Step-v0
    python training/transfer_planners.py PD_Biped3D_HLC_Soccer-v0 PD_Biped3D_LLC_{General,Stand}_Step-v0 --each

It starts from the shipped planner, by PPO; an interrupted run continues from its checkpoint in --output. With
several controllers the planner selects one in every step, or with --each it is trained with all of them side
by side, each in as many simulations. Of the evaluations during training, with the first controller only, the best
planner is kept. The results of `evaluate_plans.py` with it are printed, and with --enter written to
trained/plans.json with the training, for the report.
"""

from __future__ import annotations

import argparse
import dataclasses
import pathlib
from typing import Any

import evaluate_plans
import ppo
import runs
from settings import Settings, settings_for

from trl_suite import policies, suite
from trl_suite.cli.arguments import positive
from trl_suite.util.program import begin_script

SAMPLES = 2.4e5  # footsteps


def fine_tuned(id_: str, samples: float, *controllers: Any) -> Settings:
    """Returns the settings of a training that continues with controllers, side by side.

    Each is what the option `controller` takes: an id, or a list of ids among which the planner selects.
    """
    parts = tuple({'controller': controller} for controller in controllers)
    return dataclasses.replace(
        settings_for(id_), samples=samples, start=id_, start_count=1e6, num_envs=128, minibatch=512,
        last_learning_rate=3e-5, value_first=2e4, value_rate=1e-3, value_goes_on=True, further=(),
        stages=((0.0, parts),), evaluated_with=parts[0], evaluate_every=8e4,
    )  # fmt: skip


def short(id_: str) -> str:
    """Returns the name of a footstep controller in its id."""
    return id_.removeprefix('PD_Biped3D_LLC_').removesuffix('_Step-v0')


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('id', help='of the planning environment')
    parser.add_argument(
        'controllers', nargs='+', help='ids of the environments of the footstep controllers'
    )
    parser.add_argument('--each', action='store_true', help='train with each, instead of selecting')
    parser.add_argument('--samples', type=float, default=SAMPLES, help='footsteps')
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--episodes', type=positive, default=32, help='of the evaluation')
    parser.add_argument('--enter', action='store_true', help='write results to trained/plans.json')
    parser.add_argument('--output', type=pathlib.Path, default=pathlib.Path('runs'))
    arguments = parser.parse_args()
    runs.check_seeds('--seed', arguments.seed)
    if arguments.each and len(arguments.controllers) < 2:
        raise ValueError('--each has one controller; expected at least two, or no --each')
    id_, ids = suite.find(arguments.id).id, [suite.find(each).id for each in arguments.controllers]
    parts: list[Any] = ids if arguments.each or len(ids) == 1 else [ids]
    how = 'one planner, ' * arguments.each + 'fine-tuned with '
    names = '_'.join([*map(short, ids), *['each'] * arguments.each])
    folder = arguments.output / f'{id_}_with_{names}' / f'seed_{arguments.seed}'
    ppo.train(id_, arguments.seed, fine_tuned(id_, arguments.samples, *parts), folder, 1)
    policy = policies.load(folder / 'policy.npz')
    training = {'controllers': ids, 'samples': arguments.samples, 'seed': arguments.seed}
    for controller in parts:
        result = evaluate_plans.run(
            id_,
            lambda environments: policy,
            arguments.episodes,
            runs.TEST_SEED,
            controller=controller,
        )
        under = how + (controller if isinstance(controller, str) else ', '.join(controller))
        print(under, evaluate_plans.shown(result), flush=True)
        if arguments.enter:
            runs.add('plans.json', id_, under, {**result, 'training': training})


if __name__ == '__main__':
    begin_script()
    main()
