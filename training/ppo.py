"""Trains a policy with proximal policy optimisation, in one file, on the CPU.

    python training/ppo.py PD_Biped2D_LLC_Imitate_Flat-v0 --seed 1
    python training/ppo.py PD_Dog2D_Gaps_Terrain-v0 --samples 4e6 --threads 2 --output runs

Writes into OUTPUT/ID/seed_S: `checkpoint.pt` (everything; the same command continues from it with
identical results), `curve.json` (settings, learning curve), `policy.npz` (the policy with the best
score in the evaluations of the curve, for `trl_suite.policies`), `stage_N.npz` at the end of every
curriculum stage but the last, and at the end `last.npz`. Of several runs (`further`) each has its own
subfolder `run_N` with these files, and the curve and the policies of the last one are joined above.

PPO as in Schulman et al. 2017 (arXiv:1707.06347) with the details of Huang et al. 2022 (The 37
Implementation Details of PPO); the settings of each environment are in `ppo_settings.py`. Needs
`pip install 'trl_suite[train]'`.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import pathlib
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import checkpoints
import numpy as np
import torch
import tqdm
from expert import expert
from joint_expert import joint_expert
from ppo_settings import Settings, settings_for
from several import LANDING_ERRORS, Several
from torch import nn
from torch.optim import swa_utils

from trl_suite import characters, evaluation, policies, suite
from trl_suite.registry.catalogue import EnvSpec
from trl_suite.terrain.spatial import windows as spatial_ground
from trl_suite.util import errors, machine
from trl_suite.util.program import begin_script
from trl_suite.vector import VectorEnvironment

TEACHERS = {**evaluation.BASELINES, 'expert': expert, 'joint_expert': joint_expert}
EVALUATION_SEED = 2**31  # used neither for training nor for published results
OBSERVATION_CLIP = 10.0  # in standard deviations
MAPS = ('terrain', 'surface')  # observation blocks with maps of the ground
ACTIVATIONS = {'tanh': nn.Tanh, 'relu': nn.ReLU, 'elu': nn.ELU}
LEAST_STD = 0.01  # lower bound, so that nearly constant observations are not amplified
NEW_COUNT = 2e4  # sample count of the scales of inputs that the initial policy does not have


class Scales:
    """Running mean and standard deviation of observations.

    The phase is not scaled. All elements of a map of the ground share one scale, which preserves
    its shape and does not amplify noise on flat ground. With `map_bound`, maps are clipped at this
    bound and divided by it; exported policies include `gain`, the factor for this, in their
    weights.
    """

    def __init__(
        self,
        blocks: dict[str, slice],
        size: int,
        columns: np.ndarray | None = None,
        map_bound: float = 0.0,
    ) -> None:
        self.blocks, self.count, self.columns = blocks, np.zeros(size), columns
        self.mean, self.square, self.gain = np.zeros(size), np.ones(size), np.ones(size)
        self.map_std = map_bound / OBSERVATION_CLIP
        if map_bound:
            for part in self.maps:
                self.square[part], self.gain[part] = self.map_std**2, 1 / OBSERVATION_CLIP

    @property
    def maps(self) -> list[slice]:
        return [self.blocks[name] for name in MAPS if name in self.blocks]

    def update(self, batch: np.ndarray) -> None:
        """Updates mean and deviation with observations (n, size)."""
        weight = len(batch) / (self.count + len(batch))
        self.count += len(batch)
        mean, square = batch.mean(0), (batch**2).mean(0)
        if 'phase' in self.blocks:
            part = self.blocks['phase']
            mean[part], square[part] = 0.0, 1.0
        for part in self.maps:
            mean[part], square[part] = 0.0, self.map_std**2 or square[part].mean()
        self.mean += weight * (mean - self.mean)
        self.square += weight * (square - self.square)

    @property
    def std(self) -> np.ndarray:
        return np.sqrt(np.maximum(self.square - self.mean**2, LEAST_STD**2))

    def __call__(self, observation: np.ndarray) -> torch.Tensor:
        scaled = np.clip((observation - self.mean) / self.std, -OBSERVATION_CLIP, OBSERVATION_CLIP)
        scaled *= self.gain
        if self.columns is not None:
            scaled = scaled[..., self.columns]
        return torch.from_numpy(scaled.astype(np.float32))


class Maps(nn.Module):
    """Convolutions over maps, the first inputs of a network; the other inputs follow the outputs.

    Attributes:
      shape: number, rows and columns of the maps.
      line: number of inputs that form the maps.
      outputs: number of outputs of the convolutions.
    """

    def __init__(
        self, shape: tuple[int, int, int], layers: Sequence[tuple[int, int, int]], activation: str
    ) -> None:
        """Makes layers with these numbers of filters, widths and strides."""
        super().__init__()
        self.shape, self.line = shape, int(np.prod(shape))
        parts: list[nn.Module] = []
        channels = shape[0]
        for filters, width, stride in layers:
            layer = nn.Conv2d(channels, filters, width, stride)
            nn.init.orthogonal_(layer.weight, 2**0.5)
            nn.init.zeros_(layer.bias)
            parts += [layer, ACTIVATIONS[activation]()]
            channels = filters
        self.layers = nn.Sequential(*parts)
        self.outputs = self.layers(torch.zeros(1, *shape)).numel()

    @property
    def filters(self) -> list[nn.Conv2d]:
        return [layer for layer in self.layers if isinstance(layer, nn.Conv2d)]

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        found = self.layers(x[:, : self.line].reshape(-1, *self.shape))
        # Position by position, as in policies.
        return torch.cat([found.permute(0, 2, 3, 1).flatten(1), x[:, self.line :]], 1)


def network(
    sizes: tuple[int, ...], last_gain: float, activation: str = 'tanh', maps: Maps | None = None
) -> nn.Sequential:
    """Returns a network with layers of these sizes; the first is the number of inputs."""
    layers: list[nn.Module] = [] if maps is None else [maps]
    first, *others = sizes
    if maps is not None:
        first += maps.outputs - maps.line
    for i, (fan_in, fan_out) in enumerate(itertools.pairwise((first, *others))):
        linear = nn.Linear(fan_in, fan_out)
        last = i == len(sizes) - 2
        nn.init.orthogonal_(linear.weight, last_gain if last else 2**0.5)
        nn.init.zeros_(linear.bias)
        layers += [linear] if last else [linear, ACTIVATIONS[activation]()]
    return nn.Sequential(*layers)


def advantages(
    reward: np.ndarray,
    value: np.ndarray,
    following: np.ndarray,
    ended: np.ndarray,
    gamma: float,
    lambda_: float,
) -> np.ndarray:
    """Generalised advantage estimation (Schulman et al. 2016, arXiv:1506.02438).

    Args:
      reward: reward of each step; all arrays are (time, simulations).
      value: estimated before the step.
      following: estimated after the step; of the final state for a truncated episode, 0 after a
        failure.
      ended: whether the episode ended with the step.
      gamma: discount per step.
      lambda_: weight of longer estimates.
    """
    result, running = np.empty_like(reward), np.zeros(reward.shape[1])
    for t in reversed(range(len(reward))):
        error = reward[t] + gamma * following[t] - value[t]
        running = error + gamma * lambda_ * ~ended[t] * running
        result[t] = running
    return result


def visible(
    blocks: dict[str, slice], inputs: int, view: tuple[float, float] | None
) -> np.ndarray | None:
    """Returns the columns of an observation without elements of maps that are too far away."""
    maps = [name for name in MAPS if name in blocks]
    if view is None or not maps:
        return None
    near = np.logical_and.outer(*_near(view)).ravel()
    seen = np.ones(inputs, bool)
    for name in maps:
        part = blocks[name]
        seen[part] = np.tile(near, (part.stop - part.start) // len(near))
    return np.flatnonzero(seen)


def _near(view: tuple[float, float] | None) -> tuple[np.ndarray, np.ndarray]:
    """Returns the rows and the columns of a map that are in the view, (SAMPLES,) bool each."""
    ahead, aside = view or (np.inf, np.inf)
    forward = np.linspace(*spatial_ground.AHEAD, spatial_ground.SAMPLES)
    to_side = np.linspace(-spatial_ground.ASIDE, spatial_ground.ASIDE, spatial_ground.SAMPLES)
    return np.abs(to_side) <= aside, forward <= ahead


def map_shape(blocks: dict[str, slice], view: tuple[float, float] | None) -> tuple[int, int, int]:
    """Returns number, rows and columns of the maps that are the first inputs.

    Raises:
      ValueError: there is none, or other blocks come before one.
    """
    size = sum(blocks[name].stop - blocks[name].start for name in MAPS if name in blocks)
    ends = [blocks[name].stop for name in MAPS if name in blocks]
    if not ends or max(ends) != size:
        raise ValueError(
            f'convolutions: the first observations are not maps of the ground: {", ".join(blocks)}'
        )
    rows, columns = (int(part.sum()) for part in _near(view))
    return size // spatial_ground.SAMPLES**2, rows, columns


def mean_of(parts: Sequence[policies.Policy]) -> policies.Policy:
    """Returns the last policy with the mean weights and scales of all policies."""
    means: dict[str, Any] = {
        name: np.mean([getattr(part, name) for part in parts], axis=0)
        for name in ('mean', 'std', 'log_std')
    }

    def mean(networks: Sequence[Any]) -> dict[str, Any]:
        return {
            name: tuple(
                np.mean(layer, axis=0)
                for layer in zip(*(getattr(each, name) for each in networks), strict=True)
            )
            for name in ('weights', 'biases')
        }

    means |= mean(parts)
    maps = [part.convolution for part in parts if part.convolution is not None]
    if maps:
        means['convolution'] = dataclasses.replace(maps[-1], **mean(maps))
    return dataclasses.replace(parts[-1], **means)


class Trainer:
    """One run: the simulations, the networks and the progress."""

    def __init__(
        self,
        environment: str | EnvSpec,
        seed: int,
        settings: Settings,
        threads: int,
        initial: policies.Policy | None = None,
    ) -> None:
        """Makes a run that starts from `initial`, or else from `start` of the settings."""
        torch.manual_seed(seed)
        self.spec = suite.find(environment) if isinstance(environment, str) else environment
        self.seed = seed
        self.settings, self.threads = settings, threads
        s = settings
        if not 1 <= s.stages_averaged <= max(1, len(s.stages)):
            raise ValueError(
                f'stages_averaged: {s.stages_averaged}; expected 1 to {max(1, len(s.stages))}, the '
                'number of stages'
            )
        if unknown := s.landing_costs.keys() - set(LANDING_ERRORS):
            raise ValueError(errors.unknown('landing cost', min(unknown), LANDING_ERRORS))
        if s.activation not in ACTIVATIONS:
            raise ValueError(errors.unknown('activation', s.activation, ACTIVATIONS))
        if s.convolutions and not s.map_bound:
            raise ValueError('convolutions: expected a map_bound, so that all maps have one scale')
        self.samples = 0
        self.begin_stage()
        self.mirror = getattr(self.environments.task, 'mirror', None) if s.mirrored else None
        if s.mirrored and self.mirror is None:
            raise ValueError(f'{self.spec.id} has no left and right to mirror')
        self.largest = {term.name: term.weight for term in self.environments.task.terms}
        self.random = np.random.default_rng(seed)
        outputs, blocks = len(self.environments.action_map), self.environments.blocks
        starts = [blocks[name].start for name in s.places]
        self.places = np.add.outer(starts, (0, 1)) if starts else None
        inputs = self.observation.shape[1] + 2 * len(starts)
        columns = visible(blocks, inputs, s.view)
        self.scales = Scales(blocks, inputs, columns, s.map_bound)
        inputs = inputs if columns is None else len(columns)

        def made(last: int, gain: float) -> nn.Sequential:
            maps = None
            if s.convolutions:
                maps = Maps(map_shape(blocks, s.view), s.convolutions, s.activation)
            return network((inputs, *s.hidden, last), gain, s.activation, maps)

        self.policy, self.value = made(outputs, 0.01), made(1, 1.0)
        self.log_std = nn.Parameter(torch.full((outputs,), float(np.log(s.initial_std))))
        if initial is None and s.start and s.start not in TEACHERS:
            initial = policies.reference(s.start)
        if initial is not None:
            self.begin_with(initial)
        self.again = s.imitates_again and initial is not None
        self.begun = not s.start or (initial is not None and not self.again)
        self.has_start = bool(s.start) or initial is not None
        self.networks = [self.policy, self.value]
        self.average: swa_utils.AveragedModel | None = None
        if s.averaged:
            decay = max(0.0, 1 - s.num_envs * s.horizon / s.averaged)
            self.average = swa_utils.AveragedModel(
                self.policy, multi_avg_fn=swa_utils.get_ema_multi_avg_fn(decay)
            )
            self.networks.append(self.average)
        self.parameters = [*self.policy.parameters(), *self.value.parameters(), self.log_std]
        self.optimizer = torch.optim.Adam(self.parameters, s.learning_rate, eps=1e-5, fused=True)
        self.penalty: Callable[[], Any] = lambda: 0.0  # added to the loss of the policy
        self.curve: list[dict[str, Any]] = []
        self.seconds = {'simulation': 0.0, 'learning': 0.0, 'evaluation': 0.0}
        self.recent = np.zeros(
            3
        )  # sums of returns and steps, and number, of recently ended episodes

    @property
    def stage(self) -> int:
        """Number of curriculum stages that have begun."""
        s = self.settings
        return sum(self.samples >= share * s.samples for share, _ in s.stages)

    def begin_stage(self) -> None:
        """Makes and resets the simulations of the current curriculum stage."""
        s, self.current = self.settings, self.stage
        self.best = -np.inf  # only policies of the last curriculum stage are shipped
        options = s.stages[self.current - 1][1] if self.current else {}
        groups = options if isinstance(options, tuple) else (options,)
        if self.current <= 1 and len(groups) == 1:
            self.enter(self.simulations(groups[0], s.num_envs, self.seed))
            return
        sequence = np.random.SeedSequence((self.seed, self.current))
        seeds = np.array_split(sequence.generate_state(s.num_envs), len(groups))
        parts = [
            self.simulations(each, len(own), own.tolist())
            for each, own in zip(groups, seeds, strict=True)
        ]
        self.enter(Several(parts) if len(parts) > 1 else parts[0])

    def simulations(
        self, options: Mapping[str, Any], number: int, seed: int | list[int]
    ) -> VectorEnvironment:
        """Makes simulations with task options, which may include `terrain`."""
        own = dict(options)
        spec = dataclasses.replace(self.spec, terrain=own.pop('terrain', self.spec.terrain))
        return VectorEnvironment(
            spec,
            number,
            self.threads,
            seed,
            autoreset='disabled',
            task_kwargs=own,
            step_limit=self.settings.step_limit or -1,
        )

    def enter(self, environments: VectorEnvironment | Several) -> None:
        """Continues in other simulations, with the networks, scales and optimiser so far."""
        self.environments, n = environments, environments.num_envs
        self.observation = environments.reset()
        self.returns, self.steps = np.zeros(n), np.zeros(n)
        self.shares = {name: np.ones(n) for name in self.settings.least_share}

    def begin_with(self, other: policies.Policy) -> None:
        """Copies weights, scales and noise of a policy, by observation blocks."""
        acts, scales = self.environments.action_map, self.scales
        same = (other.actions, other.quantity) == (tuple(acts.names), acts.quantity)
        if not same:
            raise ValueError(f'{self.spec.id} has other actions than {other.id}')
        hidden = tuple(len(bias) for bias in other.biases[:-1])
        if (hidden, other.activation) != (self.settings.hidden, self.settings.activation):
            raise ValueError(
                f'hidden: {self.settings.hidden} {self.settings.activation}, but {other.id} has '
                f'{hidden} {other.activation}'
            )
        column = np.full(len(scales.mean), -1)  # indices in the other policy's observation
        offset = 0
        for name, size in other.blocks:
            part = self.environments.blocks.get(name, slice(0))
            if part.stop - (part.start or 0) == size:
                column[part] = offset + np.arange(size)
            offset += size
        own, others = self.places, other.places
        if own is not None and others is not None:
            same_place = (column[own][:, None] == others).all(-1)  # (own, others)
            for i, j in np.argwhere(same_place):
                column[len(column) - own.size + 2 * i + np.arange(2)] = (
                    offset + 2 * j + np.arange(2)
                )
        offset += 0 if others is None else others.size
        seen = np.arange(offset) if other.columns is None else other.columns
        entry = np.full(
            offset + 1, -1
        )  # indices in the other network's input; the last one is for -1
        entry[seen[other.std > LEAST_STD]] = np.flatnonzero(other.std > LEAST_STD)
        entry = entry[column]
        bounded = scales.maps if scales.map_std else []
        for part in bounded:  # inputs with another bound are not compatible
            same_std = np.isclose(other.std[entry[part]], scales.map_std)
            entry[part] = np.where(same_std, entry[part], -1)
        known = entry >= 0
        scales.count = np.where(known, self.settings.start_count, NEW_COUNT)
        scales.mean[known] = other.mean[entry[known]]
        scales.square[:] = LEAST_STD**2
        for part in bounded:
            scales.square[part] = scales.map_std**2
        scales.square[known] = other.std[entry[known]] ** 2 + scales.mean[known] ** 2
        kept = slice(None) if scales.columns is None else scales.columns
        entry, gain = entry[kept], scales.gain[kept, None]
        entry, gain = self.begin_filters(other, entry, gain)
        first = np.where((entry >= 0)[:, None], other.weights[0][entry] / gain, 0.0)
        layers = [layer for layer in self.policy if isinstance(layer, nn.Linear)]
        with torch.no_grad():
            for layer, weight, bias in zip(
                layers, (first, *other.weights[1:]), other.biases, strict=True
            ):
                layer.weight.copy_(torch.from_numpy(weight.T.copy()))
                layer.bias.copy_(torch.from_numpy(bias.copy()))
            self.log_std.copy_(torch.from_numpy(other.log_std.copy()))

    def begin_filters(
        self, other: policies.Policy, entry: np.ndarray, gain: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Copies the convolutions of a policy, if there are any.

        Args:
          other: the policy.
          entry: indices in the other network's inputs, of each input.
          gain: gain of each input, (inputs, 1).

        Returns:
          Indices and gains of the inputs of the first layer after the convolutions.

        Raises:
          ValueError: the convolutions differ.
        """
        maps, theirs = self.policy[0], other.convolution
        if theirs is None and not isinstance(maps, Maps):
            return entry, gain
        shapes = [] if theirs is None else [weight.shape for weight in theirs.weights]
        own = list(maps.filters) if isinstance(maps, Maps) else []
        same = shapes == [layer.weight.permute(2, 3, 1, 0).shape for layer in own]
        line = 0 if theirs is None else theirs.line
        if not same or theirs is None or not np.array_equal(entry[:line], np.arange(line)):
            raise ValueError(f'convolutions: those of {other.id} have other maps or layers')
        with torch.no_grad():
            for i, (layer, weight, bias) in enumerate(
                zip(own, theirs.weights, theirs.biases, strict=True)
            ):
                weight = weight / gain[0] if i == 0 else weight
                layer.weight.copy_(torch.from_numpy(weight.transpose(3, 2, 0, 1).copy()))
                layer.bias.copy_(torch.from_numpy(bias.copy()))
        others = np.where(entry[line:] >= 0, entry[line:] - line + theirs.outputs, -1)
        return (
            np.concatenate([np.arange(theirs.outputs), others]),
            np.concatenate([np.ones((theirs.outputs, 1)), gain[line:]]),
        )

    def imitate(self, baseline: str, folder: pathlib.Path | None = None) -> None:
        """Trains the policy to imitate a baseline (behavioural cloning; in rounds: DAgger).

        Actions have the exploration noise of the policy, so that the data include recoveries.

        Args:
          baseline: one of `TEACHERS`.
          folder: for evaluations between rounds; None for no evaluations.
        """
        s, environments = self.settings, self.environments
        teacher = TEACHERS[baseline](environments)
        seen: list[np.ndarray] = []
        labels: list[np.ndarray] = []
        std = self.log_std.exp().detach().numpy()
        for number in range(s.clonings):
            first = len(seen)
            while len(seen) * s.num_envs < s.cloned * (number + 1) / s.clonings:
                observation, left = self.seen(self.observation)
                action = teacher(self.observation)
                seen.append(observation.astype(np.float32))  # half the memory
                labels.append(self.mirror.unmirror_action(action, left) if self.mirror else action)
                if number > 0 or self.again:
                    with torch.no_grad():
                        action = self.policy(self.scales(observation)).numpy()
                    action = self.mirror.unmirror_action(action, left) if self.mirror else action
                noise = self.random.standard_normal(action.shape)
                step = environments.step(np.clip(action + std * noise, -1, 1))
                ended = step.terminated | step.truncated
                self.observation = environments.reset(ended) if ended.any() else step.observation
            self.scales.update(np.concatenate(seen[first:]))
            self.fit(seen, labels)
            self.samples += (len(seen) - first) * s.num_envs
            if folder is not None and number < s.clonings - 1:
                self.evaluate(folder, 0.0)

    def fit(self, seen: Sequence[np.ndarray], labels: Sequence[np.ndarray]) -> None:
        """Fits the policy to actions (n, a) for observations (n, k), both given in parts."""
        s = self.settings
        inputs = torch.cat([self.scales(part) for part in seen])  # in parts, to save memory
        targets = torch.from_numpy(np.concatenate(labels).astype(np.float32))
        optimizer = torch.optim.Adam(self.policy.parameters(), s.cloning_rate)
        schedule = torch.optim.lr_scheduler.LinearLR(
            optimizer, 1.0, s.last_cloning_rate / s.cloning_rate, max(1, s.cloning_epochs - 1)
        )
        for _ in range(s.cloning_epochs):
            order = torch.from_numpy(self.random.permutation(len(inputs)))
            for part in order.split(s.minibatch):
                loss = (self.policy(inputs[part]) - targets[part]).square().mean()
                optimizer.zero_grad()
                loss.backward()
                optimizer.step()
            schedule.step()

    def collect(self) -> dict[str, torch.Tensor]:
        """Steps all simulations `horizon` times; returns the samples, flattened."""
        s, environments = self.settings, self.environments
        n = environments.num_envs
        shape = (s.horizon, n)
        observations = np.empty((s.horizon + 1, n, len(self.scales.mean)))
        noise = self.random.standard_normal((*shape, len(self.log_std)), np.float32)
        means, actions = np.empty_like(noise), np.empty_like(noise)
        reward, ended, failed = np.empty(shape), np.empty(shape, bool), np.empty(shape, bool)
        cut: list[
            tuple[int, np.ndarray, np.ndarray]
        ] = []  # final observations of truncated episodes
        std = self.log_std.exp().detach().numpy()
        for t in range(s.horizon):
            observations[t], left = self.seen(self.observation)
            with torch.no_grad():
                means[t] = self.policy(self.scales(observations[t])).numpy()
            actions[t] = means[t] + std * noise[t]
            step = environments.step(
                self.mirror.unmirror_action(actions[t], left) if self.mirror else actions[t]
            )
            failed[t] = step.terminated | self.strays(step.info['reward_terms'])
            ended[t] = failed[t] | step.truncated
            reward[t] = step.reward
            for name, cost in s.landing_costs.items():
                reward[t] -= cost * step.info[name] * step.info['landed']
            unseen = np.flatnonzero(ended[t] & ~failed[t])
            if len(unseen):
                cut.append((t, unseen, self.seen(step.observation[unseen])[0]))
            self.count(reward[t], ended[t])
            self.observation = step.observation
            if ended[t].any():
                self.observation = environments.reset(ended[t])
                for share in self.shares.values():
                    share[ended[t]] = 1.0
        observations[-1] = self.seen(self.observation)[0]
        self.samples += s.horizon * n

        flat = observations.reshape(-1, observations.shape[-1])
        inputs = self.scales(flat)
        with torch.no_grad():
            values = self.value(inputs)[:, 0].numpy().reshape(s.horizon + 1, n)
            following = values[1:].astype(float)
            for t, env_ids, last in cut:
                following[t, env_ids] = self.value(self.scales(last))[:, 0].numpy()
        following[failed] = 0.0
        advantage = advantages(reward, values[:-1], following, ended, s.gamma, s.lambda_)
        self.scales.update(flat[:-n])  # takes effect after this update
        log_probability = -(noise**2 / 2).sum(-1) - np.log(std).sum()
        return {
            'observation': inputs[:-n],
            'action': torch.from_numpy(actions).flatten(0, 1),
            'log_probability': torch.from_numpy(log_probability.astype(np.float32)).flatten(),
            'advantage': torch.from_numpy(advantage.astype(np.float32)).flatten(),
            'target': torch.from_numpy((advantage + values[:-1]).astype(np.float32)).flatten(),
        }

    def seen(self, observation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns the policy's inputs before scaling, and which of them are mirrored."""
        left = np.zeros(len(observation), bool)
        if self.mirror is not None:
            observation, left = self.mirror.canonical(observation)
        if self.places is not None:
            observation = policies.placed(observation, self.places)
        return observation, left

    def strays(self, terms: dict[str, np.ndarray]) -> np.ndarray:
        """Mask of simulations with a smoothed reward term below its bound, (n,) bool."""
        s, result = self.settings, np.zeros(self.environments.num_envs, bool)
        forget = self.environments.control_timestep / s.patience
        for name, least in s.least_share.items():
            self.shares[name] += forget * (terms[name] / self.largest[name] - self.shares[name])
            result |= self.shares[name] < least
        return result

    def count(self, reward: np.ndarray, ended: np.ndarray) -> None:
        self.returns += reward
        self.steps += 1
        self.recent += self.returns[ended].sum(), self.steps[ended].sum(), ended.sum()
        self.returns[ended] = self.steps[ended] = 0

    def learn(self, batch: dict[str, torch.Tensor]) -> float:
        """One update; returns the divergence of the new policy from the old one."""
        s = self.settings
        progress = min(self.samples / s.samples, 1.0)
        waits = self.has_start and self.samples <= s.value_first
        rate = s.learning_rate + progress * (s.last_learning_rate - s.learning_rate)
        if waits and s.value_rate is not None:
            rate = s.value_rate
        for group in self.optimizer.param_groups:
            group['lr'] = rate
        advantage = batch['advantage']
        batch['advantage'] = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
        divergence, stopped = 0.0, False
        for _ in range(s.epochs):
            order = torch.from_numpy(self.random.permutation(len(advantage)))
            for part in order.split(s.minibatch):
                b = {name: values[part] for name, values in batch.items()}
                mean = self.policy(b['observation'])
                log_probability = (
                    -(((b['action'] - mean) / self.log_std.exp()) ** 2 / 2).sum(-1)
                    - self.log_std.sum()
                )
                log_ratio = log_probability - b['log_probability']
                ratio = log_ratio.exp()
                if not stopped:
                    with torch.no_grad():
                        divergence = float((ratio - 1 - log_ratio).mean())
                    stopped = divergence > s.kl_per_action * mean.shape[1]
                if stopped and not s.value_goes_on:
                    return divergence
                gain = torch.min(
                    ratio * b['advantage'],
                    ratio.clamp(1 - s.clip, 1 + s.clip) * b['advantage'],
                ).mean()
                value_error = (self.value(b['observation'])[:, 0] - b['target']).square().mean()
                excess = (mean.abs() - 1).clamp(min=0).square().sum(-1).mean()
                loss = 0.5 * value_error
                if not (waits or stopped):
                    loss = -gain + loss + s.bound_cost * excess + self.penalty()
                self.optimizer.zero_grad()
                loss.backward()
                nn.utils.clip_grad_norm_(self.parameters, s.gradient_norm)
                self.optimizer.step()
        return divergence

    def exported(self) -> policies.Policy:
        """Returns the current policy without PyTorch."""
        averaged = self.average is not None and self.average.n_averaged > 0
        network_ = self.average.module if averaged else self.policy
        layers = [layer for layer in network_ if isinstance(layer, nn.Linear)]
        columns = self.scales.columns
        weights = [layer.weight.detach().numpy().T.copy() for layer in layers]
        # The weights of inputs that were always 0 in training are still random: on a slope, where
        # such inputs are not 0, a policy that was trained on level ground would be disturbed.
        gain = np.where(self.scales.square == 0, 0.0, self.scales.gain)
        gain = gain if columns is None else gain[columns]
        convolution, maps = None, network_[0]
        if isinstance(maps, Maps):
            filters = [
                layer.weight.detach().permute(2, 3, 1, 0).numpy().copy() for layer in maps.filters
            ]
            filters[0] *= gain[0]
            convolution = policies.Convolution(
                line=maps.line,
                strides=tuple(layer.stride[0] for layer in maps.filters),
                weights=tuple(filters),
                biases=tuple(layer.bias.detach().numpy().copy() for layer in maps.filters),
                grid=maps.shape[1:],
            )
            gain = np.concatenate([np.ones(maps.outputs), gain[maps.line :]])
        weights[0] *= gain[:, None]
        biases = [layer.bias.detach().numpy().copy() for layer in layers]
        return policies.Policy(
            id=self.spec.id,
            blocks=tuple(
                (name, part.stop - part.start) for name, part in self.environments.blocks.items()
            ),
            actions=tuple(self.environments.action_map.names),
            quantity=self.environments.action_map.quantity,
            mean=self.scales.mean if columns is None else self.scales.mean[columns],
            std=self.scales.std if columns is None else self.scales.std[columns],
            places=self.places,
            columns=columns,
            clip=OBSERVATION_CLIP,
            weights=tuple(weights),
            biases=tuple(biases),
            convolution=convolution,
            activation=self.settings.activation,
            log_std=self.log_std.detach().numpy().copy(),
            info={
                'seed': self.seed,
                'samples': self.samples,
                'character': characters.fingerprint(self.environments.task.character.spec),
                **machine.made_with(),
            },
            mirror=self.mirror,
        )

    def evaluate(self, folder: pathlib.Path, divergence: float) -> None:
        """Adds a point to the curve; keeps the policy if it is the best so far."""
        policy = self.exported()
        s = self.settings
        found = evaluation.evaluate(
            self.spec,
            policy,
            s.evaluation_episodes,
            EVALUATION_SEED,
            self.threads,
            s.evaluated_with,
        )
        returned, steps, number = self.recent.tolist()
        point = {
            'samples': self.samples,
            'normalized_return': found['normalized_return'],
            'completion_rate': found['completion_rate'],
            'distance': found['distance'],
            'training_return': returned / max(number, 1),
            'training_length': steps / max(number, 1),
            'std': float(self.log_std.detach().exp().mean()),
            'divergence': divergence,
            'seconds': dict(self.seconds),
        }
        self.recent[:] = 0
        self.curve.append(point)
        if found['normalized_return'] > self.best:
            self.best = found['normalized_return']
            policies.save(policy, folder / 'policy.npz')

    def has_learnt(self) -> bool:
        last = [point['normalized_return'] for point in self.curve[-2:]]
        return len(last) == 2 and min(last) >= self.settings.enough

    def learnt(self) -> dict[str, Any]:
        """Returns networks, noise, scales, optimiser and random state."""
        return {
            'networks': [part.state_dict() for part in self.networks],
            'log_std': self.log_std.detach().clone(),
            'optimizer': self.optimizer.state_dict(),
            'scales': (self.scales.count, self.scales.mean, self.scales.square),
            'random': self.random.bit_generator.state,
        }

    def set_learnt(self, state: dict[str, Any]) -> None:
        """Restores what `learnt` returned."""
        for network_, saved in zip(self.networks, state['networks'], strict=True):
            network_.load_state_dict(saved)
        self.log_std.data.copy_(state['log_std'])
        self.optimizer.load_state_dict(state['optimizer'])
        self.scales.count, self.scales.mean, self.scales.square = state['scales']
        self.random.bit_generator.state = state['random']

    def save(self, folder: pathlib.Path) -> None:
        """Writes checkpoint and curve."""
        state = {name: getattr(self, name) for name in _STATE}
        state |= {
            **self.learnt(),
            'settings': dataclasses.asdict(self.settings),
            'environments': self.environments.get_state(),
        }
        checkpoints.write_curve(
            folder, self.spec.id, self.seed, self.settings, self.threads, self.curve
        )
        # Last: a run that continues from it finds all other files.
        checkpoints.save(state, folder / 'checkpoint.pt')

    def restore(self, folder: pathlib.Path) -> None:
        """Restores the run from the files that `save` wrote."""
        state = checkpoints.load_run(folder, self.settings)
        for name in _STATE:
            setattr(self, name, state[name])
        self.set_learnt(state)
        if self.stage != self.current:
            kept = {name: getattr(self, name) for name in _STATE}
            self.environments.close()
            self.begin_stage()
            for name, value in kept.items():
                setattr(self, name, value)
        self.environments.set_state(state['environments'])


_STATE = (
    'begun', 'samples', 'curve', 'best', 'seconds', 'observation', 'shares', 'recent', 'returns', 'steps',
)  # fmt: skip


def train(
    id_: str,
    seed: int,
    settings: Settings,
    folder: pathlib.Path,
    threads: int = 0,
    progress: bool = True,
) -> list[dict[str, Any]]:
    """Trains to the end, from the checkpoint in `folder` if there is one; returns the curve.

    With `further` settings each run has its own subfolder, and the curve is that of all runs.

    Raises:
      ValueError: the checkpoint is damaged, or has other settings; a mean over more runs than there are.
      RuntimeError: another process trains in the folder.
    """
    runs = [
        dataclasses.replace(settings, **{'further': (), 'runs_averaged': 1, **changes})
        for changes in ({}, *settings.further)
    ]
    if not 1 <= settings.runs_averaged <= len(runs):
        raise ValueError(
            f'runs_averaged: {settings.runs_averaged}; expected 1 to {len(runs)}, the number of runs'
        )
    with checkpoints.only_run(folder):
        if not settings.further:
            return _train(id_, seed, settings, folder, threads, progress)
        curve: list[dict[str, Any]] = []
        initial = None
        for i, own in enumerate(runs):
            part = folder / f'run_{i + 1}'
            part.mkdir(exist_ok=True)
            before = curve[-1] if curve else None
            points = _train(id_, seed, own, part, threads, progress, initial)
            curve += [continued(point, before) for point in points]
            initial = policies.load(part / 'last.npz')
        ends = [folder / f'run_{i + 1}' / 'last.npz' for i in range(len(runs))]
        last = mean_of([policies.load(end) for end in ends[-settings.runs_averaged :]])
        best = policies.load(part / 'policy.npz')
        for name, policy in (('policy.npz', best), ('last.npz', last)):
            info = {**policy.info, **continued({'samples': policy.info['samples']}, before)}
            policies.save(dataclasses.replace(policy, info=info), folder / name)
        checkpoints.write_curve(folder, id_, seed, settings, threads, curve)
        return curve


def continued(point: dict[str, Any], before: dict[str, Any] | None) -> dict[str, Any]:
    """Returns a point of a curve with the samples and seconds of earlier runs, if any, added."""
    if before is None:
        return point
    found = {**point, 'samples': before['samples'] + point['samples']}
    if 'seconds' in point:
        spent = point['seconds'].items()
        found['seconds'] = {name: before['seconds'][name] + value for name, value in spent}
    return found


def _train(
    id_: str,
    seed: int,
    settings: Settings,
    folder: pathlib.Path,
    threads: int,
    progress: bool,
    initial: policies.Policy | None = None,
) -> list[dict[str, Any]]:
    torch.set_num_threads(1)  # a second thread slows down networks of this size
    trainer = Trainer(id_, seed, settings, threads, initial)
    if (folder / 'checkpoint.pt').exists():
        trainer.restore(folder)
    total = int(settings.samples)
    with tqdm.tqdm(
        total=total, initial=trainer.samples, unit='sample', disable=None if progress else True
    ) as bar:
        bar.set_description(id_)
        while trainer.samples < total and not trainer.has_learnt():
            if trainer.stage != trainer.current:
                trainer.environments.close()
                trainer.begin_stage()
            begin, before = time.perf_counter(), trainer.samples
            if not trainer.begun:
                trainer.imitate(settings.start, folder)
                trainer.begun = True
            batch = trainer.collect()
            middle = time.perf_counter()
            divergence = trainer.learn(batch)
            if trainer.average:
                trainer.average.update_parameters(trainer.policy)
            if trainer.stage != trainer.current:
                policies.save(trainer.exported(), folder / f'stage_{trainer.current}.npz')
            end = time.perf_counter()
            trainer.seconds['simulation'] += middle - begin
            trainer.seconds['learning'] += end - middle
            bar.update(trainer.samples - before)
            number = max(trainer.recent[2], 1)
            bar.set_postfix(
                reward=f'{trainer.recent[0] / max(trainer.recent[1], 1):.2f}',
                length=f'{trainer.recent[1] / number:.0f}',
                score=f'{trainer.curve[-1]["normalized_return"]:.2f}' if trainer.curve else '-',
                refresh=False,
            )
            every = settings.evaluate_every
            if trainer.samples // every > before // every or trainer.samples >= total:
                trainer.evaluate(folder, divergence)
                trainer.seconds['evaluation'] += time.perf_counter() - end
                trainer.save(folder)
    earlier = range(trainer.current - settings.stages_averaged + 1, trainer.current)
    parts = [policies.load(folder / f'stage_{i}.npz') for i in earlier]
    policies.save(mean_of([*parts, trainer.exported()]), folder / 'last.npz')
    return trainer.curve


def command_line(
    description: str, sample: str, further: Mapping[str, Mapping[str, Any]] | None = None
) -> tuple[str, int, dict[str, Any], pathlib.Path, int]:
    """Parses the command line of a training program.

    Args:
      description: description of the program.
      sample: what its samples are.
      further: further settings, and keyword arguments of `argparse.ArgumentParser.add_argument`.

    Returns:
      Id, seed, settings other than the defaults, folder and threads.
    """
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument('id', metavar='ID', help="id of an environment, or 'domain/task'")
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--threads', type=int, default=0, help='0: all cores')
    parser.add_argument('--output', type=pathlib.Path, default=pathlib.Path('runs'))
    parser.add_argument('--samples', type=float, help=f'{sample}, instead of the default')
    for name, keywords in (further or {}).items():
        parser.add_argument(f'--{name}', help='instead of the default', **keywords)
    chosen = parser.parse_args()
    id_ = suite.find(chosen.id).id
    given = {name: getattr(chosen, name) for name in ('samples', *(further or ()))}
    changes = {name: value for name, value in given.items() if value is not None}
    return id_, chosen.seed, changes, chosen.output / id_ / f'seed_{chosen.seed}', chosen.threads


def main() -> None:
    id_, seed, changes, folder, threads = command_line(__doc__.splitlines()[0], 'control steps')
    for point in train(id_, seed, settings_for(id_, **changes), folder, threads):
        print(
            f'{point["samples"]:9} {point["normalized_return"]:.3f} of the maximum, {point["completion_rate"]:.0%} complete'
        )
    print(folder / 'policy.npz')


if __name__ == '__main__':
    begin_script()
    main()
