"""Learns with Q-learning to select a base action of a gait in every cycle, on the CPU.

    python training/learn_gaits.py FSM_Dog2D_Terrain_Mixed-v0 --seed 1 --threads 1
    python training/learn_gaits.py FSM_Raptor2D_Terrain_Mixed-v0 --samples 1e6 --output runs

The value of each base action is learnt from a replay buffer (Mnih et al. 2015) with multi-step
returns and double Q-learning: the network selects the action that the averaged target network
evaluates (van Hasselt et al. 2016). The networks process ground heights relative to the root with
1-D convolutions, as those of Peng, Berseth, van de Panne (2016) do. After a fall most simulations
return to a state a few cycles earlier and continue with other actions, so that the replay contains
many states in which the action decides about a fall.

With `--action both` each base action belongs to an expert whose actor learns to change it: a mixture
of actor-critic experts (MACE), as in that publication. Actions with noise train the actor of their
expert if the result is better than its value (van Hasselt and Wiering 2007); the others train the values.
`--action continuous` has a single expert, of the default gait.

Writes into OUTPUT/ID/seed_S: `checkpoint.pt` (everything; the same command continues from it with
identical results, and with a larger `--samples` for longer), `curve.json` (settings, learning
curve), `last.npz` (the current averaged network), and at the end `policy.npz`: the result of a final
phase without new samples, in which a new network learns from the replay with a falling learning rate
(with an initial policy the same network continues). In the first cycles, if the environment has a shipped
policy, that one acts (setting `expert_cycles`; 0: none). With `--members 4` four networks learn in this
phase, and the policy has the mean of their values, whose errors are smaller. A run may learn over
several environments of one character at a time, and may learn in rounds: the policy collects, then
learns anew from the replay.
Needs `pip install 'trl_suite[train]'`.
"""

from __future__ import annotations

import collections
import copy
import dataclasses
import fnmatch
import pathlib
import time
from collections.abc import Sequence
from typing import Any, NamedTuple

import gait_bench
import networks
import numpy as np
import runs
import torch
import tqdm
from settings import matching
from several import Several
from torch import nn

from trl_suite import evaluation, policies
from trl_suite.cli.arguments import positive
from trl_suite.registry import catalogue
from trl_suite.tasks.gait import rules as gait_rules
from trl_suite.util import errors
from trl_suite.util.options import checked
from trl_suite.util.program import begin_script
from trl_suite.vector import VectorEnvironment

# A base action; the default gait with changes that an actor selects; a base action with changes.
ACTIONS = 'discrete', 'continuous', 'both'


@dataclasses.dataclass(frozen=True)
class Settings:
    """Settings of a run, besides environment and seed."""

    # Ids, or patterns of ids, of further environments of the character, in which the policy is
    # trained, too; all have as many simulations. One that is given twice has twice as many.
    also: tuple[str, ...] = ()
    samples: float = 2e5  # cycles
    num_envs: int = 64
    # Physics steps per 1/600 s in training; 1 doubles the speed, and is coarser than the environment.
    substeps: int = gait_rules.SUBSTEPS
    start: str = ''  # environment, or file, of the initial policy; '': none
    # First cycles, with actions of the initial or the shipped policy, or else random base actions.
    expert_cycles: float = 8e3
    expert_epsilon: float = 0.15  # share of random actions in these cycles
    begin: float = 2e3  # cycles before learning begins; they determine the observation scales
    # Names of sets of the character within the action range, to select from besides the base actions.
    gaits: tuple[str, ...] = ()
    action: str = 'discrete'  # one of `ACTIONS`
    noise: float = 0.15  # standard deviation of the actors' noise
    noise_share: float = 0.25  # share of actions with noise, if there are actors
    epsilon: float = 0.08  # share of random actions after `expert_cycles`
    # Share of simulations without retries, and without random actions after `expert_cycles`.
    greedy: float = 0.25
    retry: float = 0.8  # probability that a simulation returns to an earlier state after a fall
    retries: int = 4  # largest number of retries in a row
    # Smallest and largest number of cycles that a retry goes back, besides the last one.
    back: tuple[int, int] = (1, 3)
    retry_epsilon: float = 0.3  # share of random actions in the first cycles of a retry
    retry_cycles: int = 2
    gamma: float = 0.95  # per cycle
    steps: int = 3  # of multi-step returns
    alive: float = 0.5  # reward for a cycle without a fall, added to the environment's
    capacity: float = 5e5  # transitions in the replay buffer
    minibatch: int = 256
    updates: int = 16  # per cycle of all simulations
    # Cycles between learning from the replay with a falling learning rate, as at the end; 0: never.
    renew_every: float = 0
    learning_rate: float = 3e-4
    weight_decay: float = 1e-2
    polyak: float = 0.005  # weight of the new weights in the target network
    final_updates: int = 8000  # updates in which the learning rate falls to `final_rate`
    final_rate: float = 1e-5
    members: int = 1  # networks that learn in a final phase; the policy has their mean values
    view: float = 6.5  # m; distance of the farthest ground height in the input
    relief: float = 1.5  # m; heights relative to the root are clipped this far from the mean
    convolutions: tuple[tuple[int, int, int], ...] = ((16, 8, 2), (32, 5, 2), (32, 3, 1))
    ground_units: int = 128  # units of the layer after the convolutions
    hidden: tuple[int, ...] = (512, 256)
    write_every: float = 4096  # cycles
    evaluate_every: float = 16384  # cycles
    evaluation_episodes: int = 32

    @property
    def actors(self) -> bool:
        """Whether actors change the base actions."""
        return self.action != 'discrete'


# One policy for all terrains of a character. It collects and learns in rounds, because a policy that
# has learnt with a falling learning rate runs several times as far as one that learns with a constant
# rate all the time. With rounds of 32,768 cycles the dog fell four times as often as before: 8,000
# updates pass 60 times over so few transitions.
GENERALIST: dict[str, Any] = {
    'samples': 196608, 'updates': 0, 'renew_every': 98304, 'epsilon': 0.06, 'greedy': 0.2,
    'retries': 6, 'back': (1, 4), 'evaluate_every': 8192, 'evaluation_episodes': 0,
}  # fmt: skip
STARTED: dict[str, Any] = {'expert_cycles': 0, 'begin': 0, 'learning_rate': 1e-4}
SCRATCH: dict[str, Any] = {'expert_cycles': 98304, 'back': (1, 5), 'retry_cycles': 3}
OVERRIDES: dict[str, dict[str, Any]] = {
    'FSM_Dog2D_Terrain_Mixed-v0': {'samples': 180224},
    'FSM_Raptor2D_Terrain_Mixed-v0': {'samples': 90112},
    'FSM_Biped2D_Terrain_Mixed-v0': {'samples': 40960},
    'FSM_Hopper2D_*': {
        'samples': 49152, 'relief': 2.0, 'expert_cycles': 0, 'evaluation_episodes': 0,
        'evaluate_every': 8192,
    },
    'FSM_Goat2D_*': {'samples': 49152, 'relief': 1.6},
    'FSM_Dog2D_Terrain_Slopes_Mixed-v0': {
        **GENERALIST, **STARTED, 'start': 'FSM_Dog2D_Terrain_Mixed-v0', 'also': ('FSM_Dog2D_*',),
        'num_envs': 78, 'samples': 294912, 'members': 4,
    },
    'FSM_Raptor2D_Terrain_Slopes_Mixed-v0': {
        **GENERALIST, **STARTED, 'start': 'FSM_Raptor2D_Terrain_Mixed-v0',
        'also': ('FSM_Raptor2D_*',), 'num_envs': 70, 'members': 4,
    },
    'FSM_Biped2D_Terrain_Slopes_Mixed-v0': {
        **GENERALIST, **SCRATCH, 'also': ('FSM_Biped2D_*',), 'num_envs': 72, 'samples': 491520,
        'members': 4,
    },
    # The first quarter of the cycles has random actions, also of gaits that a search has found.
    'FSM_Dog2D_Terrain_Stairs_Rugged-v0': {
        **GENERALIST, 'renew_every': 49152, 'expert_cycles': 49152, 'expert_epsilon': 1.0,
        'substeps': 1, 'gaits': ('cliffs_rugged_1', 'cliffs_rugged_2'), 'view': 5.0,
        'evaluate_every': 16384,
    },
    'FSM_Goat2D_Terrain_Cliffs-v0': {'samples': 65536, 'members': 4},
    # A hopper chooses its hops some cycles ahead. On flat ground each base action is safe for a cycle.
    'FSM_Hopper2D_Terrain_Mixed-v0': {
        **GENERALIST, **SCRATCH, 'also': ('FSM_Hopper2D_*',), 'num_envs': 70, 'view': 10.0,
        'samples': 131072, 'renew_every': 65536, 'expert_cycles': 65536, 'expert_epsilon': 1.0,
    },
}  # fmt: skip
CHOICE_ERROR = 1e-5  # largest difference of equal base actions, which files hold as float32
CLIP = 5.0  # bound of the networks' inputs, in standard deviations
_STATE = (
    'samples', 'updates', 'loss', 'seconds', 'curve', 'mean', 'std', 'observation', 'tried',
    'past', 'chains', 'travelled', 'tally', 'renewed',
)  # fmt: skip
_FINAL = 'final_updates', 'final_rate', 'members'  # settings of the final phase
# Settings that may change when a run is continued.
_CHANGEABLE = (*_FINAL, 'samples', 'write_every', 'evaluate_every', 'evaluation_episodes')
_NETWORKS = 'network', 'target'
_PARTS = *_NETWORKS, 'optimizer'


def settings_for(id_: str, **changes: Any) -> Settings:
    """The settings of an environment."""
    return Settings(**{**matching(id_, OVERRIDES.items()), **changes})


def zero_layer(inputs: int, outputs: int) -> nn.Linear:
    """Returns a layer whose outputs are 0."""
    layer = nn.Linear(inputs, outputs)
    nn.init.zeros_(layer.weight)
    nn.init.zeros_(layer.bias)
    return layer


class Network(nn.Module):
    """A network for the values of all actions; the first `line` inputs are ground heights.

    Every layer but the last is followed by a ReLU, and fully connected layers by layer
    normalisation before it (Ba et al. 2016), which stabilises Q-learning.
    """

    def __init__(
        self, line: int, others: int, choices: tuple[int, int], settings: Settings
    ) -> None:
        """Makes a network for base actions of shape `choices`."""
        super().__init__()
        self.line, self.filters = line, nn.ModuleList()
        channels, length = 1, line
        for outputs, width, stride in settings.convolutions:
            self.filters.append(nn.Conv1d(channels, outputs, width, stride))
            channels, length = outputs, (length - width) // stride + 1
        self.filters.append(nn.Conv1d(channels, settings.ground_units, length))
        sizes = (settings.ground_units + others, *settings.hidden)
        self.hidden = nn.ModuleList(map(nn.Linear, sizes, settings.hidden))
        self.last = nn.Linear(sizes[-1], choices[0])
        self.choices, self.actors = choices, None
        if settings.actors:
            self.actors = zero_layer(sizes[-1], choices[0] * choices[1])

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.last(self.features(x))

    def features(self, x: torch.Tensor) -> torch.Tensor:
        """Returns the outputs of the hidden layers."""
        ground = x[:, None, : self.line]
        for layer in self.filters:
            ground = layer(ground).relu()
        x = torch.cat([ground.flatten(1), x[:, self.line :]], 1)
        for layer in self.hidden:
            x = nn.functional.layer_norm(layer(x), (layer.out_features,)).relu()
        return x

    def both(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Returns values (n, b) and the actors' changes (n, b, a), which do not train the features."""
        features = self.features(x)
        if self.actors is None:
            return self.last(features), torch.zeros(len(x), *self.choices)
        return self.last(features), self.actors(features.detach()).reshape(-1, *self.choices)


class Action(NamedTuple):
    """What was selected in a simulation, or in n of them."""

    number: Any  # of the base action
    change: Any  # what was added to it, (a,); without actors (1,)
    noisy: Any  # whether the change has noise


class Replay:
    """A replay buffer of multi-step transitions; new ones replace the oldest."""

    def __init__(self, capacity: int, size: int, changes: int = 1) -> None:
        """Makes an empty buffer for observations and changes of actions of these sizes."""
        self.before, self.after = np.zeros((2, capacity, size), np.float16)
        self.action = np.zeros(capacity, np.int64)
        self.change = np.zeros((capacity, changes), np.float16)
        self.noisy = np.zeros(capacity, bool)  # whether the action had noise
        self.reward, self.discount = np.zeros((2, capacity), np.float32)
        self.count = 0  # number of all transitions added so far

    def __len__(self) -> int:
        return min(self.count, len(self.action))

    def add(
        self, before: np.ndarray, action: Action, reward: float, discount: float, after: np.ndarray
    ) -> None:
        """Adds a transition; its discount is 0 if it ends in a fall."""
        i = self.count % len(self.action)
        self.before[i], self.after[i] = before, after
        self.action[i], self.change[i], self.noisy[i] = action
        self.reward[i], self.discount[i] = reward, discount
        self.count += 1

    def get_state(self) -> dict[str, Any]:
        """Returns the contents."""
        arrays = {name: value[: len(self)] for name, value in vars(self).items() if name != 'count'}
        return {**arrays, 'count': self.count}

    def set_state(self, state: dict[str, Any]) -> None:
        """Restores the state returned by `get_state` of a buffer of the same capacity."""
        self.count = state['count']
        for name, value in vars(self).items():
            if name != 'count':
                value[: len(self)] = state[name]


def initial_policy(start: str) -> policies.Policy:
    """Returns the policy in a file, or the shipped one of an environment."""
    return (policies.load if start.endswith('.npz') else policies.reference)(start)


def environments_of(id_: str, settings: Settings) -> list[str]:
    """Returns the ids of all environments of a run; its own comes first.

    Raises:
      ValueError: a pattern matches no id, or an environment has no gait or another character.
    """
    ids = [id_]
    for pattern in settings.also:
        found = fnmatch.filter(catalogue.BY_ID, pattern)
        if not found:
            raise ValueError(errors.unknown('environment', pattern, catalogue.BY_ID))
        ids += [other for other in found if other != id_ or pattern == id_]
    for other in ids:
        if catalogue.BY_ID[other].actuation != 'gait':
            raise ValueError(f'{other} has no gait; expected an environment FSM_...')
    characters = sorted({catalogue.BY_ID[other].character for other in ids})
    if len(characters) > 1:
        raise ValueError(f'environments of different characters: {characters}')
    return ids


class Learner:
    """One run: the simulations, the networks and the progress."""

    def __init__(self, id_: str, seed: int, settings: Settings, threads: int) -> None:
        torch.manual_seed(seed)
        self.settings, self.seed, self.threads = settings, seed, threads
        s, n = settings, settings.num_envs
        self.random = np.random.default_rng(seed)
        seeds = self.random.integers(2**32, size=n).tolist()  # different from those of evaluations
        self.ids = environments_of(id_, s)
        if n < len(self.ids):
            raise ValueError(f'{n} simulations for {len(self.ids)} environments')
        self.simulations = Several([
            VectorEnvironment(
                each, len(part), threads, part.tolist(), task_kwargs={'substeps': s.substeps},
                autoreset='disabled', step_limit=None,
            )
            for each, part in zip(self.ids, np.array_split(seeds, len(self.ids)), strict=True)
        ])  # fmt: skip
        environments = self.environments = self.simulations.parts[0]
        # Simulations without retries, and without random actions after the first cycles.
        counts = [each.num_envs for each in self.simulations.parts]
        self.greedy = np.concatenate([np.arange(count) < s.greedy * count for count in counts])
        parameters = environments.task.gait.parameters
        further = [gait_bench.vector_of(parameters, name) for name in s.gaits]
        self.choices = parameters.action(np.array([*parameters.base_actions, *further]))
        if np.abs(self.choices).max() > 1 + CHOICE_ERROR:
            raise ValueError(f'gaits: {s.gaits}; expected sets within the action range')
        self.choices = self.choices.clip(-1, 1)
        if s.action == 'continuous':
            self.choices = np.zeros_like(self.choices[:1])  # the default gait
        ahead = np.linspace(-gait_rules.BEHIND, gait_rules.AHEAD, gait_rules.SAMPLES)
        self.line = int((ahead <= s.view).sum())
        heights, size = environments.blocks['terrain'], environments.task.observation.shape[1]
        self.columns = np.r_[heights.start : heights.start + self.line, heights.stop : size]
        # Observed heights are relative to the ground under the root, which above a gap is its
        # floor.
        self.origin = int(np.flatnonzero(self.columns == environments.blocks['pose'].start)[0])
        self.mean, self.std = np.zeros(len(self.columns)), np.ones(len(self.columns))
        self.begin_network()
        self.members: list[Network] = []  # of the ensemble, after a final phase that made one
        self.replay = Replay(
            int(s.capacity), len(self.columns), self.choices.shape[1] if s.actors else 1
        )
        self.expert = policies.reference(id_) if id_ in policies.available() else None
        if s.start:
            self.expert = initial_policy(s.start)
            self.begin_with(self.expert)
            if self.expert.biases[-1].shape[-1] > len(self.expert.choices) and not s.actors:
                raise ValueError(
                    f'the policy of {self.expert.id} changes its base actions; expected one without changes'
                )
        self.samples = self.updates = 0
        self.renewed = 0  # number of samples when the policy last learnt with a falling rate
        self.loss = 0.0
        self.seconds = {'simulation': 0.0, 'learning': 0.0, 'evaluation': 0.0}
        self.curve: list[dict[str, Any]] = []
        self.simulations.reset()
        self.observation = self.simulations.observation
        # Of each simulation: states before the last cycles, and transitions not yet in the replay.
        self.past: list[collections.deque] = [
            collections.deque(maxlen=s.back[1] + 1) for _ in range(n)
        ]
        self.chains: list[list[tuple[np.ndarray, Action, float]]] = [[] for _ in range(n)]
        # Of each simulation: retries in a row, and cycles since the last one.
        self.tried = np.zeros((2, n), int)
        # Distance in the current episode, m; and of each environment since the last point of the
        # curve: distance and number of falls of its simulations without random actions.
        self.travelled = np.zeros(n)
        self.tally = np.zeros((len(self.ids), 2))

    def begin_network(self) -> None:
        """Makes a new network, its target network and its optimizer."""
        s, others = self.settings, len(self.columns) - self.line
        self.network = Network(self.line, others, self.choices.shape, s)
        self.target = copy.deepcopy(self.network).requires_grad_(False)
        self.begin_optimizer()

    def begin_optimizer(self) -> None:
        """Makes a new optimizer of the network."""
        s = self.settings
        self.optimizer = torch.optim.AdamW(
            self.network.parameters(), s.learning_rate, weight_decay=s.weight_decay, fused=True
        )

    def begin_with(self, policy: policies.Policy) -> None:
        """Copies the weights and scales of a policy that this program has trained.

        Of an ensemble, they are those of its first network. The policy may lack the last gaits.

        Raises:
          ValueError: its inputs differ, or it selects among other gaits.
        """
        line, *_ = policy.networks[0]
        columns = np.arange(policy.observation_size) if policy.columns is None else policy.columns
        if line is None or not np.array_equal(columns, self.columns):
            found = 'no convolution' if line is None else f'{len(columns)} inputs'
            raise ValueError(
                f'the network of {policy.id} has {found}, that of {self.ids[0]} a convolution and '
                f'{len(self.columns)} inputs; expected one that learn_gaits.py trained for the same character '
                'with the same setting view'
            )
        known = self.choices[: len(policy.choices)]
        if policy.choices.shape != known.shape or (
            np.abs(policy.choices - known).max() > CHOICE_ERROR
        ):
            raise ValueError(
                f'{policy.id} selects among other base actions than this environment has'
            )
        self.mean, self.std = policy.mean.astype(float), policy.std.astype(float)
        self.copy_weights(policy, 0, self.network)
        self.target.load_state_dict(self.network.state_dict())

    def copy_weights(self, policy: policies.Policy, member: int, network: Network) -> None:
        """Copies the weights of one network of a policy that this program has trained.

        The value of a gait that the policy lacks is the mean of the others.
        """
        line, weights, biases = policy.networks[member]
        assert line is not None
        parts = [*network.filters, *network.hidden, network.last]
        weights = [*(w.transpose(2, 1, 0) for w in line.weights), *(w.T for w in weights)]
        biases = [*line.biases, *biases]
        count = len(policy.choices)
        if lacking := len(self.choices) - count:
            for parameters in (weights, biases):
                mean = parameters[-1][:count].mean(0, keepdims=True)
                parameters[-1] = np.concatenate([parameters[-1][:count], mean.repeat(lacking, 0)])
            count += lacking
        with torch.no_grad():
            if network.actors is not None and weights[-1].shape[0] > count:
                network.actors.weight.copy_(torch.tensor(weights[-1][count:]))
                network.actors.bias.copy_(torch.tensor(biases[-1][count:]))
            weights[-1], biases[-1] = weights[-1][:count], biases[-1][:count]
            for part, weight, bias in zip(parts, weights, biases, strict=True):
                part.weight.copy_(torch.tensor(weight))
                part.bias.copy_(torch.tensor(bias))

    def seen(self, observation: np.ndarray) -> torch.Tensor:
        """Returns the networks' inputs for columns of observations."""
        x = observation.astype(np.float32)
        x[:, : self.line] -= x[:, [self.origin]]
        x = np.clip((x - self.mean) / self.std, -CLIP, CLIP)
        return torch.from_numpy(x.astype(np.float32))

    def set_scales(self) -> None:
        """Sets mean and standard deviation of the networks' inputs from the replay."""
        x = self.replay.before[: len(self.replay)].astype(np.float64)
        line = x[:, : self.line] - x[:, [self.origin]]
        self.mean, self.std = x.mean(0), np.maximum(x.std(0), networks.LEAST_STD)
        self.mean[: self.line], self.std[: self.line] = line.mean(), self.settings.relief / CLIP

    def act(self) -> Action:
        """Selects an action for each of the n simulations."""
        s, n = self.settings, self.settings.num_envs
        epsilon = np.full(n, s.epsilon)
        by_expert = self.samples < s.expert_cycles
        changes = np.zeros((n, *self.choices.shape))
        if by_expert and self.expert is None:
            epsilon[:] = 1.0
            chosen = np.zeros(n, int)
        elif by_expert:
            epsilon[:] = s.expert_epsilon
            away = self.expert(self.observation)[:, None] - self.choices
            chosen = (away**2).sum(2).argmin(1)
        else:
            with torch.no_grad():
                seen = self.seen(self.observation[:, self.columns])
                found = [each.both(seen) for each in self.members or [self.network]]
                values, learnt = (sum(each) / len(each) for each in zip(*found, strict=True))
            chosen, changes = values.argmax(1).numpy(), learnt.numpy()
            epsilon[self.greedy] = 0.0
        again = (self.tried[0] > 0) & (self.tried[1] < s.retry_cycles)
        epsilon[again] = np.maximum(epsilon[again], s.retry_epsilon)
        drawn = self.random.integers(len(self.choices), size=n)
        number = np.where(self.random.random(n) < epsilon, drawn, chosen)
        if not s.actors:
            return Action(number, np.zeros((n, 1)), np.zeros(n, bool))
        change, noisy = changes[np.arange(n), number], self.random.random(n) < s.noise_share
        noisy &= ~self.greedy
        change = change + noisy[:, None] * s.noise * self.random.normal(size=change.shape)
        base = self.choices[number]
        return Action(number, np.clip(base + change, -1, 1) - base, noisy)

    def collect(self) -> None:
        """Runs one cycle in every simulation, and adds the transitions to the replay."""
        s = self.settings
        action, before = self.act(), self.observation[:, self.columns].astype(np.float16)
        taken = self.choices[action.number]
        if s.actors:
            taken = taken + action.change
        reward, fell, seen = self.run(taken)
        after = seen[:, self.columns].astype(np.float16)
        for i, chain in enumerate(self.chains):
            each_action = Action(int(action.number[i]), action.change[i], bool(action.noisy[i]))
            chain.append((before[i], each_action, float(reward[i])))
            while chain and (fell[i] or len(chain) == s.steps):
                value = sum(s.gamma**k * each[2] for k, each in enumerate(chain))
                discount = 0.0 if fell[i] else s.gamma ** len(chain)
                self.replay.add(chain[0][0], chain[0][1], value, discount, after[i])
                del chain[0]

    def run(self, taken: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Runs one cycle in every simulation; after a fall, returns to an earlier state or resets.

        Returns:
          The rewards, (n,); whether there was a fall, (n,); and the observations before simulations
          returned to an earlier state, (n, size).
        """
        s, simulations = self.settings, self.simulations
        for i, past in enumerate(self.past):
            past.append(simulations.get_state(i))
        step = simulations.step(taken)
        reward, fell, distance = step.reward, step.terminated, step.info['distance']
        self.samples += s.num_envs
        after, fresh = simulations.observation, np.zeros(s.num_envs, bool)
        counted = np.stack([distance - self.travelled, fell], 1)[self.greedy]
        np.add.at(self.tally, simulations.group[self.greedy], counted)
        self.travelled = np.where(fell, 0.0, distance)
        self.tried[1] += 1
        self.tried[0, self.tried[1] > s.back[1] + s.retry_cycles] = 0
        for i in np.flatnonzero(fell).tolist():
            if not self.go_back(i):
                fresh[i] = True
                self.past[i].clear()
                self.tried[:, i] = 0
        if fresh.any():
            simulations.reset(fresh)
        self.observation = simulations.observation
        return reward + s.alive * ~fell, fell, after

    def go_back(self, env_id: int) -> bool:
        """Restores the state some cycles before a fall; returns whether it did."""
        s, past = self.settings, self.past[env_id]
        back = int(self.random.integers(s.back[0], s.back[1] + 1))
        if self.random.random() >= s.retry or self.greedy[env_id]:
            return False
        if self.tried[0, env_id] >= s.retries or len(past) <= back:
            return False
        for _ in range(back + 1):
            state = past.pop()
        self.simulations.set_state(state, env_id)
        self.tried[:, env_id] = self.tried[0, env_id] + 1, 0
        return True

    def learn(self) -> None:
        """Updates the network once, and the target network."""
        s, replay = self.settings, self.replay
        picked = self.random.integers(len(replay), size=s.minibatch)
        before, after = self.seen(replay.before[picked]), self.seen(replay.after[picked])
        action = torch.from_numpy(replay.action[picked])[:, None]
        reward, discount = (
            torch.from_numpy(each[picked]) for each in (replay.reward, replay.discount)
        )
        with torch.no_grad():
            following = self.network(after).argmax(1, keepdim=True)
            aim = reward + discount * self.target(after).gather(1, following)[:, 0]
        values, changes = self.network.both(before)
        error = aim - values.gather(1, action)[:, 0]
        if s.actors:
            noisy = torch.from_numpy(replay.noisy[picked])
            change = torch.from_numpy(replay.change[picked].astype(np.float32))
            own = changes[torch.arange(len(picked)), action[:, 0]]
            better = noisy & (error.detach() > 0)
            loss = (error.square() * ~noisy).mean()
            loss = loss + ((own - change).square().mean(1) * better).mean()
        else:
            loss = error.square().mean()
        self.optimizer.zero_grad()
        loss.backward()
        self.optimizer.step()
        with torch.no_grad():
            torch._foreach_lerp_(
                list(self.target.parameters()), list(self.network.parameters()), s.polyak
            )
        self.updates += 1
        self.loss += (float(loss.detach()) - self.loss) / min(self.updates, 1000)

    def advance(self) -> None:
        """Collects one cycle of every simulation, and updates the networks."""
        begin, before, s = time.process_time(), self.samples, self.settings
        self.collect()
        middle = time.process_time()
        if before < s.begin <= self.samples and not s.start:
            self.set_scales()
        if self.samples >= s.begin and s.updates:
            self.members = []
            for _ in range(s.updates):
                self.learn()
        self.seconds['simulation'] += middle - begin
        self.seconds['learning'] += time.process_time() - middle
        if s.renew_every and runs.passed(before, self.samples, s.renew_every):
            self.finish()

    def finish(self) -> None:
        """Learns with a falling learning rate, without new samples, once for each member.

        A new network learns from the replay, unless the run began with a policy or has actors: the
        values of experts are those of their actors.
        """
        s, begin = self.settings, time.process_time()
        if s.renew_every:  # so that a continued run is identical
            torch.manual_seed(int(self.random.integers(2**32)))
        members, first = [], [copy.deepcopy(getattr(self, name).state_dict()) for name in _NETWORKS]
        for _ in range(s.members):
            if s.start or s.actors:
                for name, weights in zip(_NETWORKS, first, strict=True):
                    getattr(self, name).load_state_dict(weights)
            else:
                self.begin_network()
            self.begin_optimizer()
            schedule = torch.optim.lr_scheduler.CosineAnnealingLR(
                self.optimizer, s.final_updates, s.final_rate
            )
            for _ in tqdm.trange(s.final_updates, unit='update', desc='last updates'):
                self.learn()
                schedule.step()
            members.append(copy.deepcopy(self.target))
        self.members = members if s.members > 1 else []
        self.renewed = self.samples
        if s.renew_every:
            self.network.load_state_dict(self.target.state_dict())
            self.begin_optimizer()  # with the constant rate
        self.seconds['learning'] += time.process_time() - begin

    def exported(self, networks: Sequence[Network] = ()) -> policies.Policy:
        """Returns networks as a policy without PyTorch; by default the ensemble or the target network."""
        return policies.ensemble(list(map(self._policy, networks or self.members or [self.target])))

    def _policy(self, network: Network) -> policies.Policy:
        layers = networks.arrays([*network.hidden, network.last], (1, 0))
        if network.actors is not None:
            actors = networks.arrays([network.actors], (1, 0))
            for name, axis in (('weights', 1), ('biases', 0)):
                *hidden, last = layers[name]
                layers[name] = (*hidden, np.concatenate([last, *actors[name]], axis))
        strides = *(stride for *_, stride in self.settings.convolutions), 1
        convolution = policies.Convolution(
            line=self.line, strides=strides, origin=self.origin,
            **networks.arrays(network.filters, (2, 1, 0)),
        )  # fmt: skip
        return policies.Policy.for_environment(
            self.environments, info=networks.described(self.environments, self.seed, self.samples),
            mean=self.mean, std=self.std, clip=CLIP, columns=self.columns, convolution=convolution,
            **layers, activation='relu', layer_norm=True, choices=self.choices,
            log_std=np.full(self.choices.shape[1], np.log(networks.LEAST_STD)),
        )  # fmt: skip

    def evaluate(self) -> dict[str, Any]:
        """Evaluates the policy, and returns the new point of the curve.

        `metres` and `falls` are those of the `greedy` simulations since the last point, by
        environment. Without episodes of evaluation `distance` is their ratio in the environment of
        the run; it is their mean distance to a fall. It is absent if these simulations have not
        moved, as after the final phase.
        """
        s, begin = self.settings, time.process_time()
        point: dict[str, Any] = {}
        if s.evaluation_episodes:
            results = evaluation.evaluate_all(
                [(each.spec, self.exported()) for each in self.simulations.parts],
                s.evaluation_episodes, runs.EVALUATION_SEED, self.threads,
            )  # fmt: skip
            result = results[0]
            for name in ('normalized_return', 'completion_rate', 'distance', 'median_distance'):
                point[name] = result[name]
            if s.also:
                point['distances'] = [result['distance'] for result in results]
        elif self.tally[0].any():
            point['distance'] = float(self.tally[0, 0] / max(self.tally[0, 1], 1))
        self.seconds['evaluation'] += time.process_time() - begin
        metres, falls = self.tally.T.round(1).tolist()
        point |= {'samples': self.samples, 'updates': self.updates, 'loss': self.loss}
        point |= {'metres': metres, 'falls': falls, 'seconds': dict(self.seconds)}
        self.tally[:] = 0
        self.curve.append(point)
        return point

    def get_state(self) -> dict[str, Any]:
        """Returns all that a checkpoint holds."""
        state = {name: getattr(self, name) for name in _STATE}
        state |= {name: getattr(self, name).state_dict() for name in _PARTS}
        state |= {
            'replay': self.replay.get_state(),
            'simulations': self.simulations.get_state()['parts'],
        }
        state['members'] = [each.state_dict() for each in self.members]
        state['past'] = list(map(list, self.past))
        state['chains'] = [
            [(before, tuple(action), reward) for before, action, reward in chain]
            for chain in self.chains
        ]
        state['settings'] = dataclasses.asdict(self.settings)
        state['random'] = self.random.bit_generator.state
        return state

    def save(self, folder: pathlib.Path) -> None:
        """Writes checkpoint, curve and policy."""
        runs.save(self.get_state(), folder / 'checkpoint.pt')
        self.write_curve(folder)
        policies.save(self.exported(), folder / 'last.npz')

    def write_curve(self, folder: pathlib.Path) -> None:
        """Writes the settings and the curve."""
        runs.write_curve(
            folder, self.environments.spec.id, self.seed, self.settings, self.threads, self.curve,
            environments=self.ids,
        )  # fmt: skip

    def restore(self, folder: pathlib.Path) -> None:
        """Restores the run from the files that `save` wrote."""
        state = runs.load_run(folder, self.settings, _CHANGEABLE)
        self.set_state(state)
        if any(state['settings'][name] != getattr(self.settings, name) for name in _FINAL):
            self.renewed = 0  # so that the final phase is repeated

    def set_state(self, state: dict[str, Any]) -> None:
        """Restores the state returned by `get_state` of a run with these settings."""
        empty = self.past
        for name in _STATE:
            setattr(self, name, state[name])
        self.past = [
            collections.deque(past, each.maxlen)
            for past, each in zip(state['past'], empty, strict=True)
        ]
        self.chains = [
            [(before, Action(*action), reward) for before, action, reward in chain]
            for chain in state['chains']
        ]
        for name in _PARTS:
            getattr(self, name).load_state_dict(state[name])
        self.members = [copy.deepcopy(self.target) for _ in state['members']]
        for network, weights in zip(self.members, state['members'], strict=True):
            network.load_state_dict(weights)
        self.replay.set_state(state['replay'])
        self.simulations.set_state({'parts': state['simulations']})
        self.random.bit_generator.state = state['random']


def train(
    id_: str, seed: int, settings: Settings, folder: pathlib.Path, threads: int = 0
) -> list[dict[str, Any]]:
    """Trains to the end, from the checkpoint in `folder` if there is one; returns the curve.

    Raises:
      ValueError: there are too few samples to learn from; or the checkpoint is damaged, or has other
        settings; only those in `_CHANGEABLE` may differ.
      RuntimeError: another process trains in the folder.
    """
    environments_of(id_, settings)  # before there is a folder
    least = max(settings.steps * settings.num_envs, 0 if settings.start else settings.begin)
    checked('samples', settings.samples, float, at_least=least)
    with runs.only_run(folder):
        return _train(id_, seed, settings, folder, threads)


def _train(
    id_: str, seed: int, settings: Settings, folder: pathlib.Path, threads: int
) -> list[dict[str, Any]]:
    torch.set_num_threads(1)
    learner, s = Learner(id_, seed, settings, threads), settings
    if (folder / 'checkpoint.pt').exists():
        learner.restore(folder)
    with tqdm.tqdm(total=int(s.samples), initial=learner.samples, unit='cycle') as bar:
        bar.set_description(id_)
        while learner.samples < s.samples:
            before = learner.samples
            learner.advance()
            bar.update(learner.samples - before)
            if runs.passed(before, learner.samples, s.evaluate_every):
                point = learner.evaluate()
                far = point.get('distance', np.nan)
                bar.set_postfix(distance=f'{far:.1f} m', loss=f'{point["loss"]:.4f}')
            if runs.passed(before, learner.samples, s.write_every):
                learner.save(folder)
    learner.save(folder)
    if learner.renewed < learner.samples:
        learner.finish()
    learner.evaluate()
    learner.write_curve(folder)
    policies.save(learner.exported(), folder / 'policy.npz')
    return learner.curve


def report(curve: list[dict[str, Any]], folder: pathlib.Path) -> None:
    """Prints a learning curve, and where the policy is."""
    for point in curve:
        if 'distance' in point:
            print(f'{point["samples"]:9} {point["distance"]:.1f} m')
    print(folder / 'policy.npz')


def main() -> None:
    further = {
        'action': {
            'choices': ACTIONS,
            'help': 'what an action sets; see the beginning of this file',
        },
        'members': {'type': positive, 'help': 'number of networks of the policy'},
    }
    id_, seed, changes, folder, threads = runs.command_line(
        __doc__.splitlines()[0], 'cycles', further
    )
    report(train(id_, seed, settings_for(id_, **changes), folder, threads), folder)


if __name__ == '__main__':
    begin_script()
    main()
