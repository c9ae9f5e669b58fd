"""`trl-suite evaluate`: runs a policy for whole episodes, and summarises them."""

from __future__ import annotations

import argparse
from typing import Any

from trl_suite.cli import engine
from trl_suite.cli.arguments import (
    add_command,
    add_file,
    add_id,
    add_options,
    add_policy,
    add_threads,
    positive,
)
from trl_suite.environments import named_policies as acting
from trl_suite.util import files


def declare(commands: Any) -> None:
    """Declares the command and its arguments."""
    text = 'run a policy for whole episodes, and print a summary'
    command = add_command(commands, 'evaluate', text, run)
    add_id(command)
    add_policy(command, 'reference')
    add_options(command)
    command.add_argument('--episodes', type=positive, default=50, help='number of episodes')
    command.add_argument(
        '--seed', type=int, default=0, help='seed of the environments and the policy'
    )
    add_threads(command)
    text = "steps after which an episode is truncated, instead of the environment's limit"
    command.add_argument('--step-limit', type=positive, metavar='N', help=text)
    add_file(command, '--json', 'write all results, .json', '.json')


def run(arguments: argparse.Namespace) -> None:
    """Runs a policy for whole episodes, and prints a summary."""
    spec = engine.load().find(arguments.id)
    from trl_suite import evaluation

    baseline = evaluation.BASELINES.get(arguments.policy)
    options = dict(arguments.options or ())
    if arguments.step_limit is not None:
        options['step_limit'] = arguments.step_limit
    result = evaluation.evaluate(
        spec, baseline or acting.trained(arguments.policy, spec.id), arguments.episodes, arguments.seed,
        arguments.threads, options, factory=baseline is not None, progress=True,
    )  # fmt: skip
    if arguments.json is not None:
        given = {'options': dict(arguments.options)} if arguments.options else {}
        files.write_json({**result, 'policy': arguments.policy, **given}, arguments.json)
    interval, distances = result['return_interval'], result['distance_interval']
    lines = (
        ('policy', arguments.policy),
        ('episodes', f'{result["episodes"]}, seed {result["seed"]}'),
        (
            'return',
            f'{result["return"]:.2f}'
            + ('' if interval is None else f' +- {interval:.2f} (95 % confidence)')
            + f', {result["normalized_return"]:.1%} of the maximum {result["step_limit"]}',
        ),
        ('length', f'{result["length"]:.1f} of {result["step_limit"]} steps'),
        (
            'distance',
            f'{result["distance"]:.2f} m'
            + (
                ''
                if distances is None
                else ' ({:.2f} to {:.2f}, 95 % confidence)'.format(*distances)
            )
            + f', median {result["median_distance"]:.2f} m, at {result["speed"]:.2f} m/s',
        ),
        ('full length', f'{result["completion_rate"]:.0%} of the episodes'),
        ('falls', f'{result["falls"]:.0%} of the episodes'),
        ('made with', f'MuJoCo {result["mujoco"]} on {result["cpu"]}'),
    )
    print(spec.id)
    for name, text in lines:
        print(f'  {name:<12} {text}')
