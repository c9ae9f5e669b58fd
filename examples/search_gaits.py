"""Trains a policy to select a base action of a gait in every cycle, by search and imitation.

    python examples/search_gaits.py FSM_Dog2D_Terrain_Mixed-v0 --seed 1

Before each cycle every base action of the gait is simulated in a copy of the simulation, followed
by cycles with actions of the network: rollouts improve a policy (Tesauro, Galperin 1996). The
network learns to predict the result of the search from the observation, as in DAgger (Ross, Gordon,
Bagnell 2011): in half of the simulations the search selects the actions, in the other half the
network, so that it is trained in states that its own errors lead to. The policy selects one of the
base actions, as the mixtures of experts of Peng, Berseth, van de Panne (2016) do.

Writes into OUTPUT/ID/seed_S the files of `examples/ppo.py`: `curve.json`, `policy.npz` (the best of
the curve), `last.npz`, and `decisions.npz`, from which the same command continues. Needs
`pip install 'trl_suite[train]'`.
"""

from __future__ import annotations

import dataclasses
import json
import pathlib
import time
from collections.abc import Callable
from typing import Any

import checkpoints
import numpy as np
import ppo
import ppo_settings
import torch
import tqdm

from trl_suite import characters, evaluation, policies
from trl_suite.tasks.gait import rules as gait_rules
from trl_suite.util import archive, files, machine
from trl_suite.util.program import begin_script
from trl_suite.vector import VectorEnvironment


@dataclasses.dataclass(frozen=True)
class Settings:
    """Settings of a run, besides environment and seed."""

    samples: float = 4e3  # decisions of the search, one per cycle
    num_envs: int = 16  # the search selects the actions in half of them, the network in the others
    cycles: int = 2  # search depth; actions after the first cycle are those of the network
    alive: float = 2.0  # bonus for the absence of a fall, in rewards of a cycle
    view: float = 5.0  # m; distance of the farthest ground height in the input
    hidden: tuple[int, ...] = (256, 128)
    learning_rate: float = 1e-3
    weight_decay: float = 1e-3
    epochs: int = 40  # of every fit, over all decisions
    minibatch: int = 256
    evaluate_every: float = 1e3  # decisions
    evaluation_episodes: int = 32


# A cycle of these characters is one step; after two steps a fall can be inevitable but not yet
# detected.
OVERRIDES: dict[str, dict[str, Any]] = {
    'FSM_Biped2D_*': {'cycles': 4, 'samples': 2e3},
    'FSM_Hopper2D_*': {'cycles': 4, 'samples': 2e3},
    'FSM_Dog2D_Terrain_Slopes_Mixed-v0': {'samples': 3e3},
}


def settings_for(id_: str, **changes: Any) -> Settings:
    """The settings of an environment."""
    return Settings(**{**ppo_settings.matching(id_, OVERRIDES.items()), **changes})


class Search:
    """Simulates every base action from the same state."""

    def __init__(self, id_: str, settings: Settings, threads: int) -> None:
        environments = VectorEnvironment(id_, 1, 1, 0)
        parameters = environments.task.gait.parameters
        environments.close()
        choices = np.clip(parameters.action(parameters.base_actions), -1, 1)
        default = np.zeros((1, choices.shape[1]))
        # The default gait comes first and is selected in a tie.
        self.choices = np.unique(np.concatenate([default, choices]), axis=0)
        self.choices = self.choices[np.argsort(np.abs(self.choices).sum(1), kind='stable')]
        self.settings = settings
        n = settings.num_envs * len(self.choices)
        self.copies = VectorEnvironment(id_, n, threads, 0, autoreset='disabled')
        self.copies.reset()

    def __call__(
        self, environments: VectorEnvironment, network: Callable[[np.ndarray], np.ndarray]
    ) -> np.ndarray:
        """Returns the value of each choice in each simulation.

        Args:
          environments: at the beginning of a cycle.
          network: observations (m, k) -> indices of choices (m,), for the cycles after the first.

        Returns:
          (n, choices): the sum of rewards over the cycles, plus `alive` without a fall.
        """
        n, count, copies = environments.num_envs, len(self.choices), self.copies
        copies.copy_from(environments, np.repeat(np.arange(n), count).tolist(), range(n * count))
        worth, alive = np.zeros(n * count), np.ones(n * count, bool)
        going, choice = np.arange(n * count), np.tile(np.arange(count), n)
        for _ in range(self.settings.cycles):
            step = copies.step(self.choices[choice], going)
            worth[going] += step.reward[going]
            alive &= ~step.terminated
            going = going[~(step.terminated | step.truncated)[going]]
            if not len(going):
                break
            choice[going] = network(step.observation[going])
        return (worth + self.settings.alive * alive).reshape(n, count)


def visible(blocks: dict[str, slice], view: float) -> np.ndarray:
    """Returns the columns of an observation without ground heights beyond `view`."""
    ahead = np.linspace(-gait_rules.BEHIND, gait_rules.AHEAD, gait_rules.SAMPLES)
    seen = np.ones(max(part.stop for part in blocks.values()), bool)
    seen[blocks['terrain']] = ahead <= view
    return np.flatnonzero(seen)


class Learner:
    """A network that predicts the values found by the search."""

    def __init__(self, environments: VectorEnvironment, choices: np.ndarray, settings: Settings):
        self.settings, self.choices, self.environments = settings, choices, environments
        columns = visible(environments.blocks, settings.view)
        size = environments.task.observation.shape[1]
        self.scales = ppo.Scales(environments.blocks, size, columns)
        self.network = ppo.network((len(columns), *settings.hidden, len(choices)), 0.01)

    def fit(
        self, observations: np.ndarray, worth: np.ndarray, random: np.random.Generator
    ) -> float:
        """Fits a new network to all decisions; returns the mean squared error of the last epoch."""
        s = self.settings
        size = observations.shape[1]
        self.scales = ppo.Scales(self.environments.blocks, size, self.scales.columns)
        self.scales.update(observations)
        inputs = self.scales(observations)
        # The advantage of each choice over their mean.
        aims = torch.from_numpy(worth - worth.mean(1, keepdims=True)).float()
        aims /= aims.std() + 1e-8
        self.network = ppo.network((inputs.shape[1], *s.hidden, len(self.choices)), 0.01)
        optimizer = torch.optim.AdamW(
            self.network.parameters(), s.learning_rate, weight_decay=s.weight_decay
        )
        steps = s.epochs * -(-len(inputs) // s.minibatch)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
        total = 0.0
        for _ in range(s.epochs):
            total = 0.0
            order = torch.from_numpy(random.permutation(len(inputs)))
            for part in order.split(s.minibatch):
                loss = (self.network(inputs[part]) - aims[part]).square().mean()
                optimizer.zero_grad()
                loss.backward()
                optimizer.step()
                schedule.step()
                total += loss.item() * len(part) / len(inputs)
        return total

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Returns the index of the choice for each observation, (n,)."""
        with torch.no_grad():
            return self.network(self.scales(observation)).argmax(1).numpy()

    def exported(self, samples: int, seed: int) -> policies.Policy:
        """Returns the current policy without PyTorch."""
        environments, columns = self.environments, self.scales.columns
        layers = [layer for layer in self.network if isinstance(layer, torch.nn.Linear)]
        return policies.Policy(
            id=environments.spec.id,
            blocks=tuple((name, p.stop - p.start) for name, p in environments.blocks.items()),
            actions=tuple(environments.action_map.names),
            quantity=environments.action_map.quantity,
            mean=self.scales.mean[columns],
            std=self.scales.std[columns],
            columns=columns,
            clip=ppo.OBSERVATION_CLIP,
            weights=tuple(layer.weight.detach().numpy().T.copy() for layer in layers),
            biases=tuple(layer.bias.detach().numpy().copy() for layer in layers),
            activation='tanh',
            log_std=np.full(len(environments.action_map), np.log(ppo.LEAST_STD)),
            choices=self.choices,
            info={
                'seed': seed,
                'samples': samples,
                'character': characters.fingerprint(environments.task.character.spec),
                **machine.made_with(),
            },
        )


def train(
    id_: str, seed: int, settings: Settings, folder: pathlib.Path, threads: int = 0
) -> list[dict[str, Any]]:
    """Trains to the end, from the decisions in `folder` if there are any; returns the curve.

    Raises:
      ValueError: the decisions are damaged, or were made with other settings, or the folder holds a
        run of another program.
      RuntimeError: another process trains in the folder.
    """
    with checkpoints.only_run(folder):
        return _train(id_, seed, settings, folder, threads)


def _train(
    id_: str, seed: int, settings: Settings, folder: pathlib.Path, threads: int
) -> list[dict[str, Any]]:
    torch.manual_seed(seed)
    torch.set_num_threads(1)
    s = settings
    search = Search(id_, s, threads)
    observations, worth, curve = load(folder, s)
    random = np.random.default_rng((seed, len(worth)))
    environments = VectorEnvironment(
        id_, s.num_envs, threads, random.integers(2**32, size=s.num_envs).tolist(),
        autoreset='disabled',
    )  # fmt: skip
    learner = Learner(environments, search.choices, s)
    learnt = bool(len(worth))
    if learnt:
        learner.fit(observations, worth, random)

    def network(observation: np.ndarray) -> np.ndarray:
        return learner(observation) if learnt else np.zeros(len(observation), int)

    seen, found = list(observations), list(worth)
    searches, searched = np.arange(s.num_envs) < s.num_envs // 2, []
    seconds = {'simulation': 0.0, 'learning': 0.0, 'evaluation': 0.0}
    if curve:
        seconds = dict(curve[-1]['seconds'])
    best = max((point['normalized_return'] for point in curve), default=-np.inf)
    observation = environments.reset()
    with tqdm.tqdm(total=int(s.samples), initial=len(found), unit='decision') as bar:
        bar.set_description(id_)
        while len(found) < s.samples:
            begin, before = time.perf_counter(), len(found)
            values = search(environments, network)
            seen.extend(observation.astype(np.float32))
            found.extend(values)
            choice = np.where(searches, values.argmax(1), network(observation))
            step = environments.step(search.choices[choice])
            ended = step.terminated | step.truncated
            searched += step.info['distance'][ended & searches].tolist()
            observation = environments.reset(ended) if ended.any() else step.observation
            seconds['simulation'] += time.perf_counter() - begin
            bar.update(len(found) - before)
            every = s.evaluate_every
            if len(found) // every == before // every and len(found) < s.samples:
                continue
            begin = time.perf_counter()
            observations, worth = np.array(seen), np.array(found)
            loss, learnt = learner.fit(observations, worth, random), True
            middle = time.perf_counter()
            policy = learner.exported(len(found), seed)
            result = evaluation.evaluate(
                id_, policy, s.evaluation_episodes, ppo.EVALUATION_SEED, threads
            )
            seconds['learning'] += middle - begin
            seconds['evaluation'] += time.perf_counter() - middle
            point = {
                name: result[name] for name in ('normalized_return', 'completion_rate', 'distance')
            }
            point |= {'samples': len(found), 'loss': loss, 'seconds': dict(seconds)}
            point['median_distance'] = float(np.median(result['distances']))
            point['searched'] = searched  # m; distances of the episodes that ended under the search
            searched = []
            curve.append(point)
            if point['normalized_return'] > best:
                best = point['normalized_return']
                policies.save(policy, folder / 'policy.npz')
            policies.save(policy, folder / 'last.npz')
            bar.set_postfix(distance=f'{point["median_distance"]:.1f} m', loss=f'{loss:.2f}')
            with files.replacing(folder / 'decisions.npz') as part:
                np.savez_compressed(part, observation=observations, worth=worth)
            checkpoints.write_curve(folder, id_, seed, s, threads, curve)
    return curve


def load(folder: pathlib.Path, settings: Settings) -> tuple[np.ndarray, np.ndarray, list]:
    """Loads the decisions and the curve so far.

    Raises:
      ValueError: they are damaged, or were made with other settings.
    """
    if (folder / 'checkpoint.pt').exists():
        raise ValueError(f'{folder} holds a run of learn_gaits.py; expected another folder')
    path = folder / 'decisions.npz'
    if not path.exists():
        return np.empty((0, 0)), np.empty((0, 0)), []
    record = files.read_json(folder / 'curve.json')
    if record['settings'] != json.loads(json.dumps(dataclasses.asdict(settings))):
        raise ValueError(f'{folder} holds a run with other settings: {record["settings"]}')
    found = archive.arrays(path, 'decisions')
    observation, worth = (archive.take(found, name, 'f', 2) for name in ('observation', 'worth'))
    return observation, worth, record['curve']


def main() -> None:
    id_, seed, changes, folder, threads = ppo.command_line(__doc__.splitlines()[0], 'decisions')
    for point in train(id_, seed, settings_for(id_, **changes), folder, threads):
        print(
            f'{point["samples"]:9} {point["median_distance"]:.1f} m, {point["completion_rate"]:.0%} complete'
        )
    print(folder / 'policy.npz')


if __name__ == '__main__':
    begin_script()
    main()
