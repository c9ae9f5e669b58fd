"""Policies by name: those that are shipped, and baselines that need no training."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from trl_suite import policies
from trl_suite.registry import catalogue
from trl_suite.util import errors

if TYPE_CHECKING:
    from trl_suite.environments.environment import Environment
    from trl_suite.rendering import Policy

BatchPolicy = Callable[[np.ndarray], np.ndarray]  # observations (n, k) -> actions (n, a)
POLICIES = ('reference', *policies.VARIANTS, 'clip', 'scripted', 'zero', 'random')  # or a file


def zero(environments: Any) -> BatchPolicy:
    """Makes a policy that always takes action 0, for a `VectorEnvironment` or an `Environment`."""
    action = np.zeros((environments.task.world.n, len(environments.action_map)))
    return lambda observation: action.copy()


def random(environments: Any, seeds: Sequence[int] | None = None) -> BatchPolicy:
    """Makes a policy that draws actions uniformly from [-1, 1].

    Args:
      environments: a `VectorEnvironment`, or an `Environment`.
      seeds: one per simulation; those of the simulations if None.
    """
    size = len(environments.action_map)
    # One stream per simulation, so that actions do not depend on how episodes are divided.
    given = environments.core.seeds.tolist() if seeds is None else seeds
    streams = [np.random.default_rng(seed) for seed in given]
    return lambda observation: np.array([stream.uniform(-1, 1, size) for stream in streams])


def clip(environments: Any) -> BatchPolicy:
    """Makes a policy that follows the reference clip in open loop.

    Args:
      environments: a `VectorEnvironment`, or an `Environment`.

    Raises:
      ValueError: the task has no clip; or, when the policy is called, its actuation model cannot
        follow one.
    """
    task = environments.task
    if not hasattr(task, 'clip_action'):
        raise ValueError(f'the task {type(task).__name__} has no clip to follow')
    env_ids = range(task.world.n)
    return lambda observation: np.clip([task.clip_action(env_id) for env_id in env_ids], -1, 1)


def scripted(environments: Any) -> BatchPolicy:
    """Makes a hand-written policy for a high-level task; see `trl_suite.tasks.navigation.scripted`."""
    # Imported here: the command line names policies also where dm_control is missing.
    from trl_suite.tasks.navigation import scripted as planner

    return planner.scripted(environments)


# Functions of a `VectorEnvironment`, or of an `Environment`.
BASELINES: dict[str, Callable[[Any], BatchPolicy]] = {
    'random': random,
    'zero': zero,
    'clip': clip,
    'scripted': scripted,
}


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
    if name in BASELINES:
        act = random(environment, [seed]) if name == 'random' else BASELINES[name](environment)
        return lambda time_step: act(np.hstack([*time_step.observation.values()])[None])[0]
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
