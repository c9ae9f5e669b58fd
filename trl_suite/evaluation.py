"""What a policy achieves: returns, lengths and distances of many seeded episodes.

from trl_suite import evaluation, policies

id_ = 'PD_Biped2D_Gaps_Terrain-v0'
result = evaluation.evaluate(id_, policies.reference(id_), episodes=50, seed=0)
print(result['return'], result['return_interval'], result['normalized_return'])
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import tqdm

from trl_suite.environments.vector import VectorEnvironment
from trl_suite.policies import Policy
from trl_suite.registry.catalogue import EnvSpec
from trl_suite.tasks.navigation.scripted import scripted

BatchPolicy = Callable[[np.ndarray], np.ndarray]  # observations (n, k) -> actions (n, a)
CHUNK = 256  # episodes that run side by side
PROGRESS_DELAY = 2.0  # s before a progress bar appears
BOOTSTRAP = 10_000  # resamplings
_NORMAL_95 = 1.96  # standard errors on either side of a mean


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
) -> dict[str, Any]:
    """Runs whole episodes of an environment, and tells how each went and how they went on average.

    Episode i has the i-th number of `numpy.random.SeedSequence(seed)` as its seed: it is the first
    episode of `suite.make(id, {'random': result['seeds'][i]})`, whatever the number of episodes and
    threads, if the policy treats each simulation by itself (a `Policy` does).

    Args:
      environment: id, alias, or row of the catalogue.
      policy: observations (n, k) float64 -> actions (n, a) in [-1, 1]. n changes, and of simulations whose
        episode has ended the action does not count.
      episodes: how many.
      seed: of them all; or a sequence of as many seeds as episodes.
      num_threads: threads that step the physics; 0 takes all cores.
      task_kwargs: options of the task, as for `suite.load` (without seed and limits).
      factory: `policy` is not a policy but makes one: `VectorEnvironment` -> policy. So can a
        policy see more than observations; the values of `BASELINES` are such.
      progress: show a bar of the steps of the longest episodes, where stderr is a terminal.

    Returns:
      What JSON can hold. Settings: 'id', 'episodes', 'seed' (None for a sequence),
      'step_limit'. Summary: 'return' (mean),
      'return_interval' (half width of its 95 % confidence interval in the normal approximation, 1.96
      standard errors; None for a single episode), 'normalized_return' (mean return over the step limit; no
      step has a reward above 1), 'full' (share of episodes that last until the step limit),
      'length' (mean, steps), 'distance' (mean, m), 'distance_interval' (its 95 % confidence interval
      by `BOOTSTRAP` resamplings of the episodes, [m, m]; None for a single episode: how far a policy
      gets is far from normal), 'median_distance' (m), 'speed' (distance over time, m/s), 'falls' and
      'diverged' (shares of episodes).
      Lists, one entry per episode: 'seeds', 'returns', 'lengths', 'distances', 'fell'.

    Raises:
      ValueError: unknown names or options, numbers out of range, or a `Policy` that does not fit.
    """
    if int(episodes) != episodes or episodes < 1:
        raise ValueError(f'episodes is {episodes}; expected a positive integer')
    if isinstance(seed, Sequence):
        seeds = list(map(int, seed))
        if len(seeds) != episodes:
            raise ValueError(f'{len(seeds)} seeds for {episodes} episodes')
    elif int(seed) != seed or seed < 0:
        raise ValueError(f'seed is {seed}; expected 0 or a positive integer')
    else:
        seeds = np.random.SeedSequence(int(seed)).generate_state(int(episodes), np.uint32).tolist()
    chunks = []
    silent = None if progress else True
    for start in range(0, len(seeds), CHUNK):
        chunk = seeds[start : start + CHUNK]
        environments = VectorEnvironment(
            environment, len(chunk), num_threads, chunk, autoreset='disabled',
            task_kwargs=task_kwargs,
        )  # fmt: skip
        spec, step_limit = environments.spec, environments.step_limit
        try:
            if step_limit is None:
                raise ValueError(f'{spec.id} has no step limit, so its episodes may never end')
            if isinstance(policy, Policy):
                policy.check(environments)
            with tqdm.tqdm(
                total=step_limit, delay=PROGRESS_DELAY, disable=silent, unit='step'
            ) as bar:
                act = policy(environments) if factory else policy
                chunks.append(_run(environments, act, bar))
        finally:
            environments.close()
    assert step_limit is not None
    of = {name: np.concatenate([chunk[name] for chunk in chunks]) for name in chunks[0]}
    mean = float(of['returns'].mean())
    interval = None
    if len(seeds) > 1:
        interval = _NORMAL_95 * float(of['returns'].std(ddof=1)) / math.sqrt(len(seeds))
    return {
        'id': spec.id,
        'episodes': len(seeds),
        'seed': None if isinstance(seed, Sequence) else int(seed),
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


def _run(environments: VectorEnvironment, policy: BatchPolicy, bar: Any) -> dict[str, np.ndarray]:
    """Runs one episode in every simulation."""
    n = environments.num_envs
    returns, lengths, distances, durations = np.zeros(n), np.zeros(n, int), np.zeros(n), np.zeros(n)
    fell, diverged, full = np.zeros(n, bool), np.zeros(n, bool), np.zeros(n, bool)
    runs = np.ones(n, bool)  # simulations in their first episode
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


def zero(environments: VectorEnvironment) -> BatchPolicy:
    """Makes a policy that always takes action 0."""
    action = np.zeros((environments.num_envs, len(environments.action_map)))
    return lambda observation: action


def random(environments: VectorEnvironment) -> BatchPolicy:
    """Makes a policy that draws actions evenly from [-1, 1]."""
    generator = np.random.default_rng(environments.seeds.tolist())
    shape = environments.num_envs, len(environments.action_map)
    return lambda observation: generator.uniform(-1, 1, shape)


def clip(environments: VectorEnvironment) -> BatchPolicy:
    """Makes a policy that follows the reference clip without looking.

    Raises:
      ValueError: the task has no clip; or, when the policy acts, its actuation cannot follow one.
    """
    task: Any = environments.task
    if not hasattr(task, 'clip_action'):
        raise ValueError(f'{environments.spec.id} has no clip to follow')
    env_ids = range(environments.num_envs)
    return lambda observation: np.clip([task.clip_action(env_id) for env_id in env_ids], -1, 1)


BASELINES: dict[str, Callable[[VectorEnvironment], BatchPolicy]] = {
    'random': random,
    'zero': zero,
    'clip': clip,
    'scripted': scripted,
}
