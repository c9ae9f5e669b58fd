"""Data sets for offline learning, in Minari's format; the same recipe gives the same bytes.

    import minari
    from trl_suite.adapters.minari import write

    name = write('PD_Biped2D_Gaps_Terrain-v0', 'mixed', episodes=100)
    dataset = minari.load_dataset(name)

or `trl-suite dataset ID --policy mixed --episodes 100 --minari`.
"""

from __future__ import annotations

import hashlib
import json
import os
import pathlib
import tempfile
import warnings
from collections.abc import Callable, Iterator
from typing import Any
from unittest import mock

import numpy as np

import trl_suite
from trl_suite import evaluation, policies
from trl_suite.adapters.gym import flat
from trl_suite.environments import named_policies
from trl_suite.environments.vector import VectorEnvironment
from trl_suite.registry import catalogue
from trl_suite.util import errors, machine
from trl_suite.util.digest import digest
from trl_suite.util.options import checked

try:
    import gymnasium
    import minari
except ImportError as error:
    message = f"trl_suite.adapters.minari needs an extra ({error}): pip install 'trl_suite[minari]'"
    raise ImportError(message) from None

CHUNK = 32  # episodes that run in parallel
FOLDER = 'MINARI_DATASETS_PATH'  # environment variable of Minari


def reference(environments: VectorEnvironment) -> Callable[[np.ndarray], np.ndarray]:
    """Makes the shipped policy."""
    return policies.reference(environments.spec.id)


def mixed(environments: VectorEnvironment) -> Callable[[np.ndarray], np.ndarray]:
    """Makes a policy of all skills: every episode draws the probability of random actions.

    Each action is the shipped policy's or, with this probability, uniform in [-1, 1].
    """
    policy, size = reference(environments), len(environments.action_map)
    streams = [np.random.default_rng(seed) for seed in environments.seeds.tolist()]
    shares = np.array([stream.uniform() for stream in streams])

    def act(observation: np.ndarray) -> np.ndarray:
        drawn = np.array([stream.uniform(size=1 + size) for stream in streams])
        return np.where(drawn[:, :1] < shares[:, None], 2 * drawn[:, 1:] - 1, policy(observation))

    return act


POLICIES = {'reference': reference, 'mixed': mixed, 'random': named_policies.random}


def write(id: str, policy: str, episodes: int, seed: int = 0, num_threads: int = 0) -> str:
    """Writes a data set into Minari's folder, when it is complete.

    It has observations (flat) and actions, both in float32, rewards, terminations, truncations and infos
    of `gymnasium`'s `trl_suite/ID`. Its description is JSON: the recipe and the SHA-256 of the recipe.

    Args:
      id: id or alias of an environment.
      policy: one of `POLICIES`.
      episodes: number of episodes.
      seed: seed from which those of the episodes are drawn.
      num_threads: threads that step the physics; 0 uses all cores.

    Returns:
      The name of the data set, such as 'PD_Biped2D_Gaps_Terrain-mixed-v0'.

    Raises:
      ValueError: invalid arguments, or there is such a data set.
    """
    id = catalogue.find(id).id
    errors.check_known('policy', POLICIES, policy)
    episodes = checked('episodes', episodes, int, at_least=1, at_most=evaluation.MOST_EPISODES)
    seed = checked('seed', seed, int, at_least=0)
    recipe = {
        'id': id, 'policy': policy, 'episodes': episodes, 'seed': seed,
        'trl_suite': trl_suite.__version__, **machine.made_with(),
        **{name: machine.version(name) for name in ('numpy', 'h5py', 'minari')},
    }  # fmt: skip
    if policy != 'random':
        recipe['weights'] = digest(policies.reference(id))
    recipe['sha256'] = hashlib.sha256(json.dumps(recipe).encode()).hexdigest()
    stem, _, version = id.rpartition('-')
    name = f'{stem}-{policy}-{version}'
    path = pathlib.Path(minari.storage.get_dataset_path(name))
    if path.exists():
        raise ValueError(f'{path}: exists; remove it, or set another folder in {FOLDER}')
    seeds = np.random.SeedSequence(seed).generate_state(episodes, np.uint32).tolist()
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix='.trl_suite_', dir=path.parent) as folder:
        with (
            mock.patch.dict(os.environ, {FOLDER: folder}), warnings.catch_warnings(),
            gymnasium.make(f'trl_suite/{id}') as env,
        ):  # fmt: skip
            warnings.simplefilter('ignore', UserWarning)  # of fields without a value
            minari.create_dataset_from_buffers(
                name, _recorded(id, POLICIES[policy], seeds, num_threads), env,
                algorithm_name=policy, description=json.dumps(recipe),
            )  # fmt: skip
        os.rename(pathlib.Path(folder) / name, path)
    return name


def _recorded(
    id: str, make: Callable[[VectorEnvironment], Any], seeds: list[int], num_threads: int
) -> Iterator[minari.data_collector.EpisodeBuffer]:
    """Yields episodes, which do not depend on how many run in parallel."""
    for start in range(0, len(seeds), CHUNK):
        part = seeds[start : start + CHUNK]
        environments = VectorEnvironment(id, len(part), num_threads, part, autoreset='disabled')
        try:
            yield from _episodes(environments, make(environments))
        finally:
            environments.close()


def _episodes(
    environments: VectorEnvironment, policy: Callable[[np.ndarray], np.ndarray]
) -> Iterator[minari.data_collector.EpisodeBuffer]:
    """Yields one episode of every simulation."""
    runs = np.ones(environments.num_envs, bool)  # simulations whose episode has not ended
    lengths = np.zeros(environments.num_envs, int)
    observation = environments.reset()
    seen, infos, steps = [observation.astype(np.float32)], [flat(environments.info)], []
    while runs.any():
        action = np.clip(policy(observation), -1, 1).astype(np.float32)
        observation, reward, terminated, _, info = environments.step(action, runs)
        seen.append(observation.astype(np.float32))
        infos.append(flat(info))
        steps.append((action, reward, terminated, environments.at_limit))
        lengths[runs] += 1
        runs &= ~(terminated | environments.at_limit)
    columns = [np.stack(column) for column in (seen, *zip(*steps, strict=True))]
    found = {name: np.stack([info[name] for info in infos]) for name in infos[0]}
    for i, n in enumerate(lengths.tolist()):
        observations, *rest = columns
        actions, rewards, terminations, truncations = (column[:n, i] for column in rest)
        yield minari.data_collector.EpisodeBuffer(
            seed=int(environments.seeds[i]), observations=observations[: n + 1, i], actions=actions,
            rewards=rewards, terminations=terminations, truncations=truncations,
            infos={name: column[: n + 1, i] for name, column in found.items()},
        )  # fmt: skip
