"""Policies for a single environment, by name."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from trl_suite import policies
from trl_suite.registry import catalogue
from trl_suite.util import errors

if TYPE_CHECKING:
    from trl_suite.environments.environment import Environment
    from trl_suite.rendering import Policy

POLICIES = ('reference', *policies.VARIANTS, 'clip', 'scripted', 'zero', 'random')  # or a file


def check(name: str) -> str:
    """Returns the name of a policy, one of `POLICIES` or a file.

    Raises:
      ValueError: any other name; the message has the closest matches.
    """
    if name not in POLICIES and not name.endswith('.npz'):
        raise ValueError(errors.unknown('policy', name, (*POLICIES, 'FILE.npz')))
    return name


def trained(name: str, id: str) -> policies.Policy:
    """Returns a policy shipped for an environment, or one from a file.

    Args:
      name: 'reference', one of `policies.VARIANTS`, or an .npz file.
      id: id or alias of the environment.
    """
    if name == 'reference' or name in policies.VARIANTS:
        return policies.reference(catalogue.find(id).id, '' if name == 'reference' else name)
    return policies.load(name)


def policy(name: str, environment: Environment, id: str, seed: int = 0) -> Policy:
    """Makes a policy for an environment.

    Args:
      name: one of `POLICIES`, or an .npz file.
      environment: the environment that it acts in.
      id: id or alias of the environment.
      seed: seed of the policy 'random'.

    Returns:
      A function from time steps to actions in [-1, 1].

    Raises:
      ValueError: the environment has no such policy, or the policy is incompatible with it.
      FileNotFoundError: there is no such file, or no reference is shipped.
    """
    task: Any = environment.task
    size = len(environment.action_map)
    if name == 'zero':
        return lambda time_step: np.zeros(size)
    if name == 'random':
        generator = np.random.default_rng(seed)
        return lambda time_step: generator.uniform(-1, 1, size)
    if name == 'scripted':
        from trl_suite.tasks.navigation.scripted import scripted

        walk = scripted(environment)
        return lambda time_step: walk(np.concatenate([*time_step.observation.values()])[None])[0]
    if name == 'clip':
        if not hasattr(task, 'clip_action'):
            raise ValueError(f'{id} has no clip to follow')
        return lambda time_step: np.clip(task.clip_action(0), -1, 1)
    network = trained(check(name), id)
    network.check(environment)
    return lambda time_step: network(time_step.observation)


def available(environment: Environment, id: str, seed: int = 0) -> dict[str, Policy]:
    """Returns the policies that work in an environment, by name, in the order of `POLICIES`.

    A policy that raises an error in the first state is skipped: 'clip' does with torque control. The
    environment is reset.
    """
    time_step, found = environment.reset(), {}
    for name in POLICIES:
        try:
            made = policy(name, environment, id, seed)
            made(time_step)
            found[name] = made
        except (ValueError, FileNotFoundError):
            continue
    return found


def best(environment: Environment, id: str) -> tuple[str, Policy]:
    """Returns name and policy of the first that an environment has; see `available`."""
    return next(iter(available(environment, id).items()))
