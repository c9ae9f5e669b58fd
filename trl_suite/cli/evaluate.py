"""`trl-suite evaluate`: runs a policy for whole episodes, and summarises them."""

from __future__ import annotations

import argparse
from typing import Any

import trl_suite
from trl_suite.cli import engine
from trl_suite.cli.arguments import (
    add_command,
    add_file,
    add_id,
    add_options,
    add_policy,
    add_threads,
    options_of,
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

    baseline = acting.BASELINES.get(arguments.policy)
    options = options_of(arguments)
    if arguments.step_limit is not None:
        if 'step_limit' in options:
            raise ValueError('step_limit is given twice: by --option and by --step-limit')
        options['step_limit'] = arguments.step_limit
    policy = baseline or acting.trained(arguments.policy, spec.id)
    settings = arguments.episodes, arguments.seed, arguments.threads, options
    result = evaluation.evaluate(
        spec, policy, *settings, factory=baseline is not None, progress=True
    )
    result['policy'] = arguments.policy
    if arguments.json is not None:
        given = {'options': options_of(arguments)} if arguments.options else {}
        files.write_json({'trl_suite': trl_suite.__version__, **result, **given}, arguments.json)
    returns, distances = result['return_interval'], result['distance_interval']
    around = '' if returns is None else f' +- {returns:.2f} (95 % confidence)'
    between = ''
    if distances is not None:
        between = ' ({:.2f} to {:.2f}, 95 % confidence)'.format(*distances)
    text = """{id}
  policy       {policy}
  episodes     {episodes}, seed {seed}
  return       {return:.2f}{around}, {normalized_return:.1%} of the maximum {step_limit}
  length       {length:.1f} of {step_limit} steps
  distance     {distance:.2f} m{between}, median {median_distance:.2f} m, at {speed:.2f} m/s
  full length  {completion_rate:.0%} of the episodes
  falls        {falls:.0%} of the episodes
  made with    trl_suite {version}, MuJoCo {mujoco} on {cpu}"""
    print(
        text.format_map(
            {**result, 'around': around, 'between': between, 'version': trl_suite.__version__}
        )
    )
