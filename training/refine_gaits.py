"""Improves a policy that selects base actions of a gait, with PPO, on the CPU.

    python training/refine_gaits.py FSM_Biped2D_Terrain_Slopes_Mixed-v0 --seed 1 --threads 1
    python training/refine_gaits.py FSM_Goat2D_Terrain_Cliffs-v0 --start FSM_Goat2D_Terrain_Cliffs-v0

Q-learning (`learn_gaits.py`) levels off: what decides about a fall are small differences between
estimated values. PPO (Schulman et al. 2017) begins with its networks: their mean values, times
`sharpness`, are the logits of the base actions. It then learns from what these actions really lead
to. The policy that is written selects the action with the largest logit. Its weights are a moving
average of those of all updates (setting `averaged`), in which their random changes cancel. Its files
are those of `learn_gaits.py`.

With `--changes all` the networks also learn a change of the selected action, from changes with noise, or
with `--changes each` one for each base action. They are 0 at the beginning.

After a fall most simulations return to a state a few cycles earlier, as in `learn_gaits.py`; these
retries end a trajectory, and the actions after them are those of the policy.

Without `--start`, or a setting `start` of the environment, the policy is first learnt by `learn_gaits.py`, with the settings of the
environment, in the folder OUTPUT/ID/seed_S/first. Writes into OUTPUT/ID/seed_S: `checkpoint.pt`
(everything; the same command continues from it with identical results, and with a larger
`--samples` for longer), `curve.json` (settings, learning curve) and `policy.npz`.
Needs `pip install 'trl_suite[train]'`.
"""

from __future__ import annotations

import copy
import dataclasses
import pathlib
import time
from typing import Any

import learn_gaits
import numpy as np
import ppo
import runs
import torch
import tqdm
from settings import matching
from torch import nn
from torch.optim import swa_utils

from trl_suite import policies
from trl_suite.tasks.gait import rules as gait_rules
from trl_suite.util import errors, files
from trl_suite.util.options import checked
from trl_suite.util.program import begin_script


@dataclasses.dataclass(frozen=True)
class Settings:
    """Settings of a run, besides environment and seed."""

    # Of the run of `learn_gaits.py` whose policy is improved.
    first: learn_gaits.Settings = dataclasses.field(default_factory=learn_gaits.Settings)
    start: str = ''  # environment, or file, of the initial policy instead; '': none
    # Ids, or patterns of ids, of further environments of the character; all have as many simulations.
    also: tuple[str, ...] = ()
    samples: float = 3e5  # cycles
    num_envs: int = 64
    substeps: int = gait_rules.SUBSTEPS  # as in `learn_gaits.py`
    horizon: int = 64  # cycles of each simulation between two updates
    sharpness: float = 4.0  # logits per unit of value
    epochs: int = 4
    minibatch: int = 1024
    learning_rate: float = 5e-5
    last_learning_rate: float = 2e-5  # reached by a linear decrease
    value_rate: float = 3e-4  # learning rate of the value network
    value_first: int = 3  # first updates, in which only the value is trained
    value_epochs: int = 12  # of these updates
    gamma: float = 0.95  # per cycle
    lambda_: float = 0.95
    clip: float = 0.2
    kl: float = 0.02  # an update of the policy stops at this divergence
    changes: str = ''  # changes of the selected action: one of `CHANGES`
    largest_change: float = 0.3  # of an action in [-1, 1]
    noise: float = 0.05  # standard deviation of the noise of changes
    change_rate: float = 1e-5  # first learning rate of the layer of changes, adapted to
    change_kl: float = 0.01  # the divergence of changes in an update
    changes_first: float = 0  # first cycles, in which only this layer and the value are trained
    gradient_norm: float = 0.5
    averaged: float = 1e5  # cycles over which the weights of the policy are averaged; 0: not
    greedy: float = 0.34  # share of simulations that do not return to earlier states
    retry: float = 0.5  # probability that the others do after a fall
    retries: int = 6  # largest number of retries in a row
    # Smallest and largest number of cycles that a retry goes back, besides the last one.
    back: tuple[int, int] = (1, 5)
    write_every: float = 16384  # cycles
    evaluate_every: float = 32768  # cycles


def _terrains(character: str, *names: str) -> tuple[str, ...]:
    """Returns the ids of gait environments."""
    return tuple(f'FSM_{character}_Terrain_{name}-v0' for name in names)


# Environments that are easy for a policy for many terrains take no part in its training.
OVERRIDES: dict[str, dict[str, Any]] = {
    'FSM_Biped2D_Terrain_Slopes_Mixed-v0': {
        'also': _terrains('Biped2D', 'Mixed', 'Walls', 'Gaps', 'Cliffs'), 'num_envs': 75,
        'samples': 2.06e6, 'last_learning_rate': 1e-5, 'kl': 0.0225, 'averaged': 2e5,
        'evaluate_every': 49152,
    },
    'FSM_Dog2D_Terrain_Mixed-v0': {
        'also': _terrains('Dog2D', 'Gaps', 'Slopes_Walls'), 'num_envs': 66, 'samples': 6e5,
        'retry': 0.7, 'kl': 0.0225, 'evaluate_every': 49152,
    },
    'FSM_Dog2D_Terrain_Slopes_Mixed-v0': {
        'also': _terrains('Dog2D', 'Cliffs', 'Narrow_Gaps'), 'num_envs': 66, 'samples': 1.2e6,
        'last_learning_rate': 1e-5, 'retry': 0.7, 'kl': 0.0225, 'evaluate_every': 49152,
    },
    'FSM_Dog2D_Terrain_Cliffs-v0': {
        'start': 'FSM_Dog2D_Terrain_Slopes_Mixed-v0',
        'also': _terrains('Dog2D', 'Cliffs', 'Slopes_Mixed', 'Narrow_Gaps'), 'num_envs': 132,
        'horizon': 32, 'samples': 5.2e5, 'learning_rate': 2.8e-5, 'last_learning_rate': 1.4e-5,
        'retry': 0.7, 'kl': 0.0225, 'evaluate_every': 49152,
    },
    'FSM_Raptor2D_Terrain_Mixed-v0': {
        'samples': 2.5e5, 'retry': 0.7, 'averaged': 0.0, 'evaluate_every': 12288,
    },
    'FSM_Raptor2D_Terrain_Narrow_Gaps-v0': {
        'start': 'FSM_Raptor2D_Terrain_Slopes_Mixed-v0',
        'also': _terrains('Raptor2D', 'Slopes_Mixed', 'Mixed', 'Gaps', 'Cliffs'), 'num_envs': 75,
        'substeps': 1, 'samples': 7.2e5, 'last_learning_rate': 1e-5, 'retry': 0.7, 'kl': 0.0225,
        'evaluate_every': 49152,
    },
    'FSM_Hopper2D_Terrain_Mixed-v0': {
        'also': _terrains('Hopper2D', 'Gaps', 'Slopes_Mixed', 'Walls', 'Mixed_Easy'), 'num_envs': 80,
        'samples': 9.9e5, 'last_learning_rate': 1e-5, 'retry': 0.7, 'kl': 0.0225,
        'evaluate_every': 24576,
    },
    'FSM_Goat2D_Terrain_Cliffs-v0': {
        'samples': 1.2e5, 'num_envs': 48, 'averaged': 0.0, 'evaluate_every': 12288,
    },
}  # fmt: skip
CHANGES = '', 'all', 'each'  # none; the same for all base actions; one for each
CHANGE_RATES = 1e-7, 1e-3  # smallest and largest learning rate of the layer of changes
VALUE_SCALE = 5.0  # outputs of the value network are multiplied by it
# Settings that may change when a run is continued.
_CHANGEABLE = 'samples', 'write_every', 'evaluate_every'
_PARTS = 'policy', 'average', 'value', 'policy_optimizer', 'value_optimizer'


def settings_for(id_: str, **changes: Any) -> Settings:
    """The settings of an environment."""
    own = matching(id_, OVERRIDES.items())
    return Settings(**{'first': learn_gaits.settings_for(id_), **own, **changes})


def simulated(id_: str, settings: Settings) -> learn_gaits.Settings:
    """Returns the settings of the simulations.

    Raises:
      ValueError: actors of Q-learning change the base actions, the kind of changes is unknown, a number is
        out of range, or an environment is unknown or has no gait.
    """
    s = settings
    errors.check_known('kind of changes', CHANGES, s.changes)
    checked('noise', s.noise, float, above=0)
    checked('largest_change', s.largest_change, float, above=0, at_most=2)
    if s.changes_first and not s.changes:
        raise ValueError(f'changes_first is {s.changes_first}; expected 0 without changes')
    if s.first.actors:
        raise ValueError(
            f"action: {s.first.action!r}; expected 'discrete', a choice of base actions"
        )
    own = dataclasses.replace(
        s.first, also=s.also, num_envs=s.num_envs, substeps=s.substeps, start='', capacity=1,
        greedy=s.greedy, retry=s.retry, retries=s.retries, back=s.back, evaluation_episodes=0,
    )  # fmt: skip
    learn_gaits.environments_of(id_, own)
    return own


def of_action(changes: torch.Tensor, number: torch.Tensor) -> torch.Tensor:
    """Returns the changes (n, a) of base actions from those of each of them, or of all."""
    return changes[torch.arange(len(number)), number.clamp(max=changes.shape[1] - 1)]


class Refiner:
    """One run: simulations as in Q-learning, the policy, the value and the progress."""

    def __init__(
        self, id_: str, seed: int, settings: Settings, threads: int, initial: policies.Policy
    ) -> None:
        """Begins with a policy of `learn_gaits.py`.

        Raises:
          ValueError: the policy does not fit the environment, or as `simulated`.
        """
        self.settings, s = settings, settings
        self.learner = learner = learn_gaits.Learner(id_, seed, simulated(id_, s), threads)
        learner.begin_with(initial)
        networks = [copy.deepcopy(learner.network) for _ in initial.networks]
        self.value = copy.deepcopy(learner.network)
        features = self.value.last.in_features
        self.value.last = learn_gaits.zero_layer(features, 1)
        count, size = learner.choices.shape
        changes = {'': 0, 'all': size, 'each': count * size}[s.changes]
        known = initial.biases[-1].shape[-1] - len(initial.choices)
        largest = np.float32(s.largest_change)
        if known and (known, initial.largest_change) != (changes, largest):
            kind = {size: 'all', count * size: 'each'}.get(known, known)
            raise ValueError(
                f'the policy of {initial.id} has changes={kind!r}, largest_change={initial.largest_change:g}; '
                f'the settings have changes={s.changes!r}, largest_change={s.largest_change}: expected the '
                'same, or a policy without changes'
            )
        for number, network in enumerate(networks):
            if changes:
                network.actors = learn_gaits.zero_layer(features, changes)
            learner.copy_weights(initial, number, network)
        self.policy = nn.ModuleList(networks)
        cycles = s.num_envs * s.horizon
        average = swa_utils.get_ema_multi_avg_fn(1 - cycles / max(s.averaged, cycles))
        self.average = swa_utils.AveragedModel(self.policy, multi_avg_fn=average)
        parts = {True: [], False: []}
        for name, parameter in self.policy.named_parameters():
            parts['.actors.' in name].append(parameter)
        self.policy_optimizer = torch.optim.Adam(parts[False], s.learning_rate)
        if changes:
            group = {'params': parts[True], 'lr': s.change_rate}
            self.policy_optimizer.add_param_group(group)
        self.divergence = 0.0  # of the changes in the last update
        self.value_optimizer = torch.optim.Adam(self.value.parameters(), s.value_rate)

    @property
    def samples(self) -> int:
        """Number of cycles so far."""
        return self.learner.samples

    def outputs(self, seen: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Returns the logarithms of the probabilities of all base actions, (n, b), and their changes.

        The changes are (n, b, a), or (n, 1, a) if they are the same for all, or (n, 0, a).
        """
        s, n = self.settings, len(self.policy)
        features = [network.features(seen) for network in self.policy]
        values = sum(each.last(x) for each, x in zip(self.policy, features, strict=True)) / n
        likely = torch.log_softmax(s.sharpness * values, 1)
        actions = self.learner.choices.shape[1]
        if not s.changes:
            return likely, torch.zeros(len(seen), 0, actions)
        changes = sum(each.actors(x) for each, x in zip(self.policy, features, strict=True)) / n
        return likely, s.largest_change * changes.reshape(len(seen), -1, actions).tanh()

    def density(
        self, outputs: tuple[torch.Tensor, torch.Tensor], b: dict[str, torch.Tensor]
    ) -> torch.Tensor:
        """Returns the log-probabilities of actions, up to a constant, (n,)."""
        likely, changes = outputs
        result = likely.gather(1, b['action'][:, None])[:, 0]
        if changes.shape[1]:
            away = (b['change'] - of_action(changes, b['action'])) / self.settings.noise
            result = result - away.square().sum(1) / 2
        return result

    def estimate(self, seen: torch.Tensor) -> torch.Tensor:
        """Returns the estimated sums of future rewards, (n,)."""
        return VALUE_SCALE * self.value(seen)[:, 0]

    def seen(self) -> torch.Tensor:
        """Returns the networks' inputs for the current observations."""
        return self.learner.seen(self.learner.observation[:, self.learner.columns])

    @torch.no_grad()
    def collect(self) -> dict[str, torch.Tensor]:
        """Runs `horizon` cycles of all simulations.

        Returns:
          One row for each of these cycles: what the networks have seen, the number of the base action,
          its mean change and its change, if any, its log-probability, its advantage by GAE, and the
          target of the value.
        """
        s, learner = self.settings, self.learner
        shape = s.horizon, s.num_envs
        rows, fell, reward = [], np.zeros(shape, bool), np.zeros(shape)
        values = np.zeros((s.horizon + 1, s.num_envs))
        for t in range(s.horizon):
            seen = self.seen()
            likely, changes = outputs = self.outputs(seen)
            values[t] = self.estimate(seen).numpy()
            below = likely.exp().cumsum(1).numpy()
            drawn = learner.random.random((s.num_envs, 1)) * below[:, -1:]
            number = np.minimum((below < drawn).sum(1), below.shape[1] - 1)
            taken, row = learner.choices[number], {'seen': seen, 'action': torch.from_numpy(number)}
            if s.changes:
                row['mean'] = of_action(changes, row['action'])
                noise = learner.random.standard_normal(row['mean'].shape, np.float32)
                row['change'] = row['mean'] + s.noise * torch.from_numpy(noise)
                taken = np.clip(taken + row['change'].numpy(), -1, 1)
            row['log_probability'] = self.density(outputs, row)
            rows.append(row)
            reward[t], fell[t], _ = learner.run(taken)
        values[-1] = self.estimate(self.seen()).numpy()
        following = np.where(fell, 0.0, values[1:])
        advantage = ppo.advantages(reward, values[:-1], following, fell, s.gamma, s.lambda_)
        return {
            **{name: torch.cat([row[name] for row in rows]) for name in rows[0]},
            'advantage': torch.from_numpy(advantage.astype(np.float32)).flatten(),
            'target': torch.from_numpy((advantage + values[:-1]).astype(np.float32)).flatten(),
        }

    def learn(self, batch: dict[str, torch.Tensor]) -> None:
        """Updates value and policy."""
        s, learner = self.settings, self.learner
        only_value = learner.updates < s.value_first
        share = min(1.0, self.samples / s.samples)
        rate = s.learning_rate + share * (s.last_learning_rate - s.learning_rate)
        selection, *changes = self.policy_optimizer.param_groups
        selection['lr'], frozen = rate, self.samples < s.changes_first
        advantage = batch['advantage']
        batch['advantage'] = (advantage - advantage.mean()) / (advantage.std() + 1e-6)
        for _ in range(s.value_epochs if only_value else s.epochs):
            order = torch.from_numpy(learner.random.permutation(len(advantage)))
            for picked in order.split(s.minibatch):
                b = {name: value[picked] for name, value in batch.items()}
                loss = (self.estimate(b['seen']) - b['target']).square().mean()
                self.value_optimizer.zero_grad()
                loss.backward()
                self.value_optimizer.step()
                learner.loss = float(loss.detach())
                if only_value:
                    continue
                growth = self.density(self.outputs(b['seen']), b) - b['log_probability']
                if float(-growth.detach().mean()) > s.kl:
                    only_value = True  # in the rest of this update
                    continue
                gain = ppo.clipped_gain(growth.exp(), b['advantage'], s.clip)
                self.policy_optimizer.zero_grad()
                (-gain).backward()
                if frozen:
                    for parameter in selection['params']:
                        parameter.grad = None
                nn.utils.clip_grad_norm_(self.policy.parameters(), s.gradient_norm)
                self.policy_optimizer.step()
        if changes and learner.updates >= s.value_first:
            with torch.no_grad():
                means = of_action(self.outputs(batch['seen'])[1], batch['action'])
            moved = (means - batch['mean']).square().sum(1).mean()
            self.divergence = float(moved) / (2 * s.noise**2)
            if not s.change_kl / 1.5 <= self.divergence <= 1.5 * s.change_kl:
                factor = 1.5 if self.divergence < s.change_kl else 1 / 1.5
                changes[0]['lr'] = float(np.clip(changes[0]['lr'] * factor, *CHANGE_RATES))
        self.average.update_parameters(self.policy)
        learner.updates += 1

    def advance(self) -> None:
        """Collects, and updates the networks."""
        begin, seconds = time.process_time(), self.learner.seconds
        batch = self.collect()
        middle = time.process_time()
        self.learn(batch)
        seconds['simulation'] += middle - begin
        seconds['learning'] += time.process_time() - middle

    def evaluate(self) -> dict[str, Any]:
        """Returns the new point of the curve, with the divergence and the learning rate of changes."""
        point = self.learner.evaluate()
        if self.settings.changes:
            point['divergence'] = self.divergence
            point['change_rate'] = self.policy_optimizer.param_groups[1]['lr']
        return point

    def exported(self) -> policies.Policy:
        """Returns the policy without PyTorch."""
        networks = copy.deepcopy(self.average.module).requires_grad_(False)
        policy = self.learner.exported(list(networks))
        if not self.settings.changes:
            return policy
        return dataclasses.replace(policy, largest_change=self.settings.largest_change)

    def get_state(self) -> dict[str, Any]:
        """Returns all that a checkpoint holds."""
        return {
            **{name: getattr(self, name).state_dict() for name in _PARTS},
            'learner': self.learner.get_state(),
            'settings': dataclasses.asdict(self.settings),
        }

    def restore(self, folder: pathlib.Path) -> None:
        """Restores the run from its checkpoint."""
        state = runs.load_run(folder, self.settings, _CHANGEABLE)
        for name in _PARTS:
            getattr(self, name).load_state_dict(state[name])
        self.learner.set_state(state['learner'])

    def write(
        self, folder: pathlib.Path, before: list[dict[str, Any]], threads: int
    ) -> list[dict[str, Any]]:
        """Writes curve and policy; returns the curve, which continues that of the first run."""
        done = before[-1]['samples'] if before else 0
        curve = [
            *before,
            *({**point, 'samples': point['samples'] + done} for point in self.learner.curve),
        ]
        runs.write_curve(
            folder, self.learner.environments.spec.id, self.learner.seed, self.settings, threads,
            curve, environments=self.learner.ids,
        )  # fmt: skip
        policy = self.exported()
        info = {**policy.info, 'samples': self.samples + done}
        policies.save(dataclasses.replace(policy, info=info), folder / 'policy.npz')
        return curve


def first_policy(
    id_: str, seed: int, settings: Settings, folder: pathlib.Path, threads: int
) -> tuple[policies.Policy, list[dict[str, Any]]]:
    """Returns the initial policy, and its learning curve if it is learnt here."""
    if settings.start:
        return learn_gaits.initial_policy(settings.start), []
    first = folder / 'first'
    if (folder / 'checkpoint.pt').exists():  # PPO has begun
        curve = files.read_json(first / 'curve.json')['curve']
    else:
        curve = learn_gaits.train(id_, seed, settings.first, first, threads)
    return policies.load(first / 'policy.npz'), curve


def train(
    id_: str, seed: int, settings: Settings, folder: pathlib.Path, threads: int = 0
) -> list[dict[str, Any]]:
    """Trains to the end, from the checkpoint in `folder` if there is one; returns the curve.

    Raises:
      ValueError: the checkpoint is damaged, or has other settings; only those in `_CHANGEABLE` may
        differ.
      RuntimeError: another process trains in the folder.
    """
    simulated(id_, settings)  # before Q-learning, and before there is a folder
    with runs.only_run(folder):
        torch.set_num_threads(1)
        initial, before = first_policy(id_, seed, settings, folder, threads)
        refiner, s = Refiner(id_, seed, settings, threads, initial), settings
        if (folder / 'checkpoint.pt').exists():
            refiner.restore(folder)
        with tqdm.tqdm(total=int(s.samples), initial=refiner.samples, unit='cycle') as bar:
            bar.set_description(id_)
            while refiner.samples < s.samples:
                begin = refiner.samples
                refiner.advance()
                bar.update(refiner.samples - begin)
                ends = refiner.samples >= s.samples
                if ends or runs.passed(begin, refiner.samples, s.evaluate_every):
                    point = refiner.evaluate()
                    bar.set_postfix(distance=f'{point.get("distance", np.nan):.1f} m')
                    refiner.write(folder, before, threads)
                if ends or runs.passed(begin, refiner.samples, s.write_every):
                    runs.save(refiner.get_state(), folder / 'checkpoint.pt')
        return refiner.write(folder, before, threads)


def main() -> None:
    further = {
        'start': {
            'help': 'initial policy: id of an environment, whose shipped policy it is, or a file'
        },
        'changes': {'choices': CHANGES, 'help': 'of the selected action, to be learnt as well'},
    }
    id_, seed, changes, folder, threads = runs.command_line(
        __doc__.splitlines()[0], 'cycles', further
    )
    curve = train(id_, seed, settings_for(id_, **changes), folder, threads)
    learn_gaits.report(curve, folder)


if __name__ == '__main__':
    begin_script()
    main()
