"""Trains the shipped footstep controller further, for smaller landing errors: `trained/accurate`.

    python examples/train_accurate.py
    python examples/evaluate_footsteps.py --variant accurate --json trained/accurate/footsteps.json

Two runs of `examples/ppo.py` on one thread, 14 M control steps, with `accurate_settings` of
`ppo_settings.py`: a cost of landing errors, and all plans, pushes and grounds at the same time. An
interrupted run continues from its checkpoints in RUNS. Writes `trained/accurate/ID.npz`, and settings,
curve and evaluation to `ID.json`.
"""

from __future__ import annotations

import argparse
import json
import pathlib
import time

import ppo
import ppo_settings
from train_all import measured

from trl_suite import policies
from trl_suite.util import files, resources
from trl_suite.util.program import begin_script

ID = 'PD_Biped3D_LLC_General_Step-v0'


def place() -> pathlib.Path:
    """Returns the path of settings, curve and evaluation; the policy is beside it, as .npz."""
    return resources.directory('trained') / 'accurate' / f'{ID}.json'


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--runs', type=pathlib.Path, default=pathlib.Path('runs/accurate'))
    parser.add_argument('--samples', type=float, help='of each run, instead of the default')
    arguments = parser.parse_args()
    settings = ppo_settings.accurate_settings()
    if arguments.samples is not None:
        further = tuple({**own, 'samples': arguments.samples} for own in settings.further)
        settings = ppo_settings.accurate_settings(samples=arguments.samples, further=further)
    folder, begin = arguments.runs / ID / f'seed_{arguments.seed}', time.monotonic()
    ppo.train(ID, arguments.seed, settings, folder, threads=1)
    run = measured(ID, folder, '', begin)
    place().parent.mkdir(parents=True, exist_ok=True)
    policies.save(run.policy, place().with_suffix('.npz'))
    with files.replacing(place()) as part:
        part.write_text(json.dumps(run.entry) + '\n')
    found = run.entry['evaluation']
    print(
        f'{found["normalized_return"]:.3f} of the maximum, {found["completion_rate"]:.0%} complete'
    )


if __name__ == '__main__':
    begin_script()
    main()
