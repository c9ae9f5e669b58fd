"""Evaluates policies: returns, lengths and distances of many seeded episodes.

from trl_suite import evaluation, policies

id_ = 'PD_Biped2D_Gaps_Terrain-v0'
result = evaluation.evaluate(id_, policies.reference(id_), episodes=50, seed=0)
print(result['return'], result['return_interval'], result['normalized_return'])
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np
import tqdm

import trl_suite.suite  # noqa: F401  tells what to install if dm_control is missing
from trl_suite.environments.core import TIME_ERROR
from trl_suite.environments.named_policies import BatchPolicy
from trl_suite.environments.vector import VectorEnvironment
from trl_suite.policies import Policy
from trl_suite.registry.catalogue import EnvSpec
from trl_suite.util import errors, machine
from trl_suite.util.options import checked

MOST_EPISODES = 1_000_000
CHUNK = 256  # episodes that run in parallel
PART = 64  # the same, for an executor: small enough to keep many nodes busy
PROGRESS_DELAY = 2.0  # s before a progress bar appears
BOOTSTRAP = 10_000  # bootstrap samples
_NORMAL_95 = 1.96  # half width of a 95 % confidence interval, in standard errors


class Executor(Protocol):
    """Runs functions elsewhere: a pool of `concurrent.futures`, `adapters.ray.RayExecutor`, ..."""

    def map(self, fn: Callable[..., Any], /, *iterables: Iterable[Any]) -> Iterable[Any]:
        """Calls a function with arguments from iterables; returns the results in order.

        Starts all calls at once. Functions, arguments and results are pickled if they leave the
        process.
        """


def evaluate(
    environment: str | EnvSpec,
    policy: Callable[[Any], Any],
    episodes: int = 50,
    seed: int | Sequence[int] = 0,
    num_threads: int = 0,
    task_kwargs: Mapping[str, Any] | None = None,
    *,
    factory: bool = False,
    progress: bool = False,
    executor: Executor | None = None,
) -> dict[str, Any]:
    """Runs complete episodes of an environment; returns statistics and the result of each episode.

    Episode i is seeded with the i-th number of `numpy.random.SeedSequence(seed)`: it equals the
    first episode of `suite.make(id, {'random': result['seeds'][i]})`, for any number of episodes
    and threads and with any executor, if the policy computes each action from that simulation's
    observation alone (a `Policy` does).

    Args:
      environment: id, alias, or `EnvSpec`.
      policy: observations (n, k) float64 -> actions (n, a) in [-1, 1]. n may differ between calls;
        actions of simulations whose episode has ended are ignored.
      episodes: number of episodes, at most `MOST_EPISODES`.
      seed: seed of the whole evaluation; or a sequence with one seed per episode.
      num_threads: threads that step the physics; 0 uses all cores, with an executor 1.
      task_kwargs: options of the task, as for `suite.load`, with limits, but without seed.
      factory: `policy` is a function `VectorEnvironment` -> policy, so that the policy can use more
        than observations; the values of `named_policies.BASELINES` are such functions.
      progress: show a progress bar, in steps up to the step limit, with an executor in parts of
        `PART` episodes, if stderr is a terminal.
      executor: runs parts of `PART` episodes, for example on the nodes of a cluster; None runs them
        in this process. Only the policy and the results are sent.

    Returns:
      A dict that can be written as JSON. Settings: 'id', 'episodes', 'seed' (None for a sequence),
      'step_limit'. Summary: 'return' (mean),
      'return_interval' (half width of its 95 % confidence interval in the normal approximation, 1.96
      standard errors; None for a single episode), 'normalized_return' (mean return over the step
      limit; the reward of a step is at most 1), 'completion_rate' (share of episodes that
      reach a limit without a failure), 'length' (mean, steps), 'distance' (mean, m), 'distance_interval' (its
      95 % confidence interval from `BOOTSTRAP` bootstrap samples of the episodes, [m, m], since
      distances are far from normally distributed; None for a single episode), 'median_distance'
      (m), 'speed' (total distance over total time, m/s), 'falls' and 'diverged' (shares of
      episodes).
      Lists, one entry per episode: 'seeds', 'returns', 'lengths', 'distances', 'fell'.
      'mujoco' (its version) and 'cpu' (classes of the processors), on which the last bits depend.

    Raises:
      ValueError: unknown names or options, numbers out of range, or an incompatible `Policy`.
      TypeError: `policy` is no function.
    """
    cases = [(environment, policy)]
    [result] = evaluate_all(
        cases, episodes, seed, num_threads, task_kwargs, factory=factory, progress=progress,
        executor=executor,
    )  # fmt: skip
    return result


def evaluate_all(
    cases: Iterable[tuple[str | EnvSpec, Callable[[Any], Any]]],
    episodes: int = 50,
    seed: int | Sequence[int] = 0,
    num_threads: int = 0,
    task_kwargs: Mapping[str, Any] | None = None,
    *,
    factory: bool = False,
    progress: bool = False,
    executor: Executor | None = None,
) -> list[dict[str, Any]]:
    """Calls `evaluate` for pairs of environment and policy; an executor runs all at the same time.

    Arguments, results and errors are those of `evaluate`.
    """
    seeds = _seeds(episodes, seed)
    task_kwargs = errors.options('task_kwargs', task_kwargs)  # here, where paths are relative to
    size = CHUNK if executor is None else PART
    parts = [seeds[start : start + size] for start in range(0, len(seeds), size)]
    run = functools.partial(
        _run,
        num_threads=num_threads if executor is None else num_threads or 1,
        task_kwargs=task_kwargs,
        factory=factory,
        progress=progress and executor is None,
    )
    start: Callable[..., Iterable[Any]] = map if executor is None else executor.map
    running = [
        start(functools.partial(run, environment, policy), parts) for environment, policy in cases
    ]
    silent = None if progress and executor is not None else True
    results = []
    with tqdm.tqdm(total=len(running) * len(parts), disable=silent, unit='part') as bar:
        for each in running:
            done = []
            for part in each:
                done.append(part)
                bar.update()
            id_, step_limit, made, first = done[0]
            of = {name: np.concatenate([part[name] for *_, part in done]) for name in first}
            # An executor may have run parts on other processors.
            cpus = ', '.join(sorted({part['cpu'] for _, _, part, _ in done}))
            summary = _summary(id_, step_limit, seeds, seed, of)
            results.append({**summary, **made, 'cpu': cpus})
    return results


def _seeds(episodes: int, seed: int | Sequence[int]) -> list[int]:
    """Returns the seed of each episode."""
    episodes = checked('episodes', episodes, int, at_least=1, at_most=MOST_EPISODES)
    if isinstance(seed, np.ndarray):
        seed = seed.tolist()
    if isinstance(seed, Sequence) and not isinstance(seed, (str, bytes)):
        if len(seed) != episodes:
            raise ValueError(f'{len(seed)} seeds for {episodes} episodes')
        return [checked('seed', each, int, at_least=0, at_most=2**32 - 1) for each in seed]
    sequence = np.random.SeedSequence(checked('seed', seed, int, at_least=0))
    return sequence.generate_state(episodes, np.uint32).tolist()


def _run(
    environment: str | EnvSpec,
    policy: Callable[[Any], Any],
    seeds: list[int],
    num_threads: int,
    task_kwargs: Mapping[str, Any] | None,
    factory: bool,
    progress: bool,
) -> tuple[str, int, dict[str, str], dict[str, np.ndarray]]:
    """Runs one episode per seed, all at the same time.

    Returns id, step limit, `machine.made_with()` and results.
    """
    environments = VectorEnvironment(
        environment, len(seeds), num_threads, seeds, autoreset='disabled', task_kwargs=task_kwargs
    )
    id_, step_limit = environments.spec.id, environments.step_limit
    try:
        if environments.time_limit < math.inf:
            if environments.task.steps_vary:
                raise ValueError(
                    f'time_limit is {environments.time_limit}; expected a step_limit, by which returns '
                    f'are divided, since steps of {id_} differ in duration'
                )
            steps = math.ceil(
                (environments.time_limit - TIME_ERROR) / environments.control_timestep
            )
            steps = max(1, steps)  # an episode ends after a step
            step_limit = steps if step_limit is None else min(step_limit, steps)
        if step_limit is None:
            raise ValueError(f'{id_} has no step limit, so its episodes may never end')
        if not callable(policy):
            raise TypeError(f'policy is {policy!r}; expected a function of observations')
        if isinstance(policy, Policy):
            policy.check(environments)
        silent = None if progress else True
        with tqdm.tqdm(total=step_limit, delay=PROGRESS_DELAY, disable=silent, unit='step') as bar:
            act = policy(environments) if factory else policy
            return id_, step_limit, machine.made_with(), _episodes(environments, act, bar)
    finally:
        environments.close()


def _summary(
    id_: str,
    step_limit: int,
    seeds: list[int],
    seed: int | Sequence[int],
    of: dict[str, np.ndarray],
) -> dict[str, Any]:
    """Returns the result of `evaluate` for the results of its episodes."""
    mean = float(of['returns'].mean())
    interval = None
    if len(seeds) > 1:
        interval = _NORMAL_95 * float(of['returns'].std(ddof=1)) / math.sqrt(len(seeds))
    return {
        'id': id_,
        'episodes': len(seeds),
        'seed': None if np.ndim(seed) else int(np.asarray(seed)),
        'step_limit': step_limit,
        'return': mean,
        'return_interval': interval,
        'normalized_return': mean / step_limit,
        'completion_rate': float(of['completion_rate'].mean()),
        'length': float(of['lengths'].mean()),
        'distance': float(of['distances'].mean()),
        'distance_interval': _bootstrap(of['distances']) if len(seeds) > 1 else None,
        'median_distance': float(np.median(of['distances'])),
        'speed': float(of['distances'].sum() / of['durations'].sum()),
        'falls': float(of['fell'].mean()),
        'diverged': float(of['diverged'].mean()),
        'seeds': seeds,
        **{name: of[name].tolist() for name in ('returns', 'lengths', 'distances', 'fell')},
    }


def _episodes(
    environments: VectorEnvironment, policy: BatchPolicy, bar: Any
) -> dict[str, np.ndarray]:
    """Runs one episode in every simulation."""
    n = environments.num_envs
    returns, lengths, distances, durations = np.zeros(n), np.zeros(n, int), np.zeros(n), np.zeros(n)
    fell, diverged, full = np.zeros(n, bool), np.zeros(n, bool), np.zeros(n, bool)
    runs = np.ones(n, bool)  # simulations whose episode has not ended
    observation = environments.reset()
    while runs.any():
        observation, reward, terminated, truncated, info = environments.step(
            policy(observation), runs
        )
        bar.update()
        returns[runs] += reward[runs]
        lengths[runs] += 1
        ends = (terminated | truncated) & runs
        distances[ends] = info['distance'][ends]
        durations[ends] = environments.task.world.time[ends]
        fell[ends], diverged[ends] = info['fell'][ends], info['diverged'][ends]
        full[ends] = truncated[ends]
        runs &= ~ends
    return {
        'returns': returns, 'lengths': lengths, 'distances': distances, 'durations': durations,
        'fell': fell, 'diverged': diverged, 'completion_rate': full,
    }  # fmt: skip


def _bootstrap(values: np.ndarray) -> list[float]:
    """Returns a 95 % confidence interval of the mean."""
    random = np.random.default_rng(0)
    means = [random.choice(values, len(values)).mean() for _ in range(BOOTSTRAP)]
    return np.percentile(means, (2.5, 97.5)).tolist()
