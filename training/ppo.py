"""Trains a policy with proximal policy optimisation, on the CPU.

    python training/ppo.py PD_Biped2D_LLC_Imitate_Flat-v0 --seed 1
    python training/ppo.py PD_Dog2D_Gaps_Terrain-v0 --samples 4e6 --threads 2 --output runs

Writes into OUTPUT/ID/seed_S: `checkpoint.pt` (everything; the same command continues from it with
identical results), `curve.json` (settings, learning curve), `policy.npz` (the policy with the best
score in the evaluations of the curve, for `trl_suite.policies`), `stage_N.npz` at the end of every
curriculum stage but the last, and at the end `last.npz`. Of several runs (`further`) each has its own
subfolder `run_N` with these files, and the curve and the policies of the last one are joined above.

PPO as in Schulman et al. 2017 (arXiv:1707.06347) with the details of Huang et al. 2022 (The 37
Implementation Details of PPO); `settings.py` is the table of settings, and `networks.py` has the
networks. Needs `pip install 'trl_suite[train]'`.
"""

from __future__ import annotations

import dataclasses
import pathlib
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import networks
import numpy as np
import runs
import torch
import tqdm
from expert import CONTROLLER, DRIBBLING, expert, joint_expert
from networks import ACTIVATIONS, Maps, Scales, mean_of
from settings import Settings, settings_for
from several import LANDING_ERRORS, Several
from torch import nn
from torch.optim import swa_utils

from trl_suite import evaluation, policies
from trl_suite.environments import named_policies
from trl_suite.registry.catalogue import EnvSpec, spec_of
from trl_suite.util import errors
from trl_suite.util.program import begin_script
from trl_suite.vector import VectorEnvironment

TEACHERS: dict[str, Callable[..., Any]] = {
    **named_policies.BASELINES,
    'expert': expert,
    'joint_expert': joint_expert,
    'nominal': lambda environments: policies.reference(CONTROLLER),
}
USED = {'nominal': (CONTROLLER,), 'joint_expert': (CONTROLLER, DRIBBLING)}  # policies of teachers
_STATE = (  # what a checkpoint holds besides what `learnt` returns
    'begun', 'samples', 'current', 'curve', 'best', 'seconds', 'observation', 'shares', 'recent', 'returns',
    'steps', 'reached', 'lengths',
)  # fmt: skip


def advantages(
    reward: np.ndarray, value: np.ndarray, following: np.ndarray, ended: np.ndarray, gamma: float,
    lambda_: float,
) -> np.ndarray:  # fmt: skip
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


class Trainer:
    """One run: the simulations, the networks and the progress."""

    def __init__(
        self, environment: str | EnvSpec, seed: int, settings: Settings, threads: int,
        initial: policies.Policy | None = None,
    ) -> None:  # fmt: skip
        """Makes a run that starts from `initial`, or else from `start` of the settings."""
        torch.manual_seed(seed)
        self.spec = spec_of(environment)
        self.seed, self.settings, self.threads, s = seed, settings, threads, settings
        _check(s)
        self.samples, self.reached = 0, min(1, len(s.stages))
        self.lengths = np.zeros(2)  # steps and number of episodes since the last look at them
        self.begin_stage(self.stage)
        self.mirror = getattr(self.environments.task, 'mirror', None) if s.mirrored else None
        if s.mirrored and self.mirror is None:
            raise ValueError(f'{self.spec.id} has no left and right to mirror')
        self.largest = {term.name: term.weight for term in self.environments.task.terms}
        self.random = np.random.default_rng(seed)
        outputs, blocks = len(self.environments.action_map), self.environments.blocks
        starts = [blocks[name].start for name in s.places]
        self.places = np.add.outer(starts, (0, 1)) if starts else None
        inputs = self.observation.shape[1] + 2 * len(starts)
        columns = networks.visible(blocks, inputs, s.view)
        self.scales = Scales(blocks, inputs, columns, s.map_bound)
        inputs = inputs if columns is None else len(columns)

        def made(last: int, gain: float) -> nn.Sequential:
            maps = None
            if s.convolutions:
                maps = Maps(networks.map_shape(blocks, s.view), s.convolutions, s.activation)
            return networks.network((inputs, *s.hidden, last), gain, s.activation, maps)

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
        self.recent = np.zeros(3)  # sums of returns and steps, and number, of ended episodes

    @property
    def stage(self) -> int:
        """Number of curriculum stages that have begun."""
        s = self.settings
        if s.stage_length:
            return self.reached
        return sum(self.samples >= share * s.samples for share, _ in s.stages)

    def advance(self) -> None:
        """Reaches the next curriculum stage if the last `num_envs` episodes were long enough."""
        steps, number = self.lengths.tolist()
        if number >= self.settings.num_envs:
            if steps >= number * self.settings.stage_length:
                self.reached = min(self.reached + 1, len(self.settings.stages))
            self.lengths[:] = 0

    def begin_stage(self, number: int) -> None:
        """Makes and resets the simulations of a curriculum stage."""
        s, self.current = self.settings, number
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
            spec, number, self.threads, seed, autoreset='disabled', task_kwargs=own,
            step_limit=self.settings.step_limit or -1,
        )  # fmt: skip

    def enter(self, environments: VectorEnvironment | Several) -> None:
        """Continues in other simulations, with the networks, scales and optimiser so far."""
        self.environments, n = environments, environments.num_envs
        self.observation = environments.reset()
        self.returns, self.steps = np.zeros(n), np.zeros(n)
        self.shares = {name: np.ones(n) for name in self.settings.least_share}

    def begin_with(self, other: policies.Policy) -> None:
        """Copies weights, scales and noise of a policy, by observation blocks."""
        acts, s = self.environments.action_map, self.settings
        shared = tuple(acts.names[: len(other.actions)])
        if (other.actions, other.quantity) != (shared, acts.quantity):
            raise ValueError(f'{self.spec.id} has other actions than {other.id}')
        hidden = tuple(len(bias) for bias in other.biases[:-1])
        if (hidden, other.activation) != (s.hidden, s.activation):
            raise ValueError(
                f'hidden: {s.hidden} {s.activation}, but {other.id} has {hidden} {other.activation}'
            )
        networks.begin_with(other, self.policy, self.scales, self.places, s.start_count)
        self.log_std.data[: len(shared)].copy_(torch.from_numpy(other.log_std.copy()))
        if s.start_std is not None:
            self.log_std.data.fill_(float(np.log(s.start_std)))

    # Simulation.

    def seen(self, observation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns the policy's inputs before scaling, and which of them are mirrored."""
        left = np.zeros(len(observation), bool)
        if self.mirror is not None:
            observation, left = self.mirror.canonical(observation)
        if self.places is not None:
            observation = policies.placed(observation, self.places)
        return observation, left

    def unmirrored(self, action: np.ndarray, left: np.ndarray) -> np.ndarray:
        return action if self.mirror is None else self.mirror.unmirror_action(action, left)

    def means(self, seen: np.ndarray) -> np.ndarray:
        """Returns the actions without noise for inputs before scaling."""
        with torch.no_grad():
            return self.policy(self.scales(seen)).numpy()

    def collect(self) -> dict[str, torch.Tensor]:
        """Steps all simulations `horizon` times; returns the samples, flattened."""
        s, environments = self.settings, self.environments
        n = environments.num_envs
        shape = (s.horizon, n)
        observations = np.empty((s.horizon + 1, n, len(self.scales.mean)))
        noise = self.random.standard_normal((*shape, len(self.log_std)), np.float32)
        actions = np.empty_like(noise)
        reward, ended, failed = np.empty(shape), np.empty(shape, bool), np.empty(shape, bool)
        cut: list[tuple[int, np.ndarray, np.ndarray]] = []  # ends of truncated episodes
        std = self.log_std.exp().detach().numpy()
        for t in range(s.horizon):
            observations[t], left = self.seen(self.observation)
            actions[t] = self.means(observations[t]) + std * noise[t]
            step = environments.step(self.unmirrored(actions[t], left))
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
        self.advance()

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
        self.lengths += self.steps[ended].sum(), ended.sum()
        self.returns[ended] = self.steps[ended] = 0

    # Learning.

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
                value_error = (self.value(b['observation'])[:, 0] - b['target']).square().mean()
                loss = 0.5 * value_error
                if not (waits or stopped):
                    gain = clipped_gain(ratio, b['advantage'], s.clip)
                    excess = (mean.abs() - 1).clamp(min=0).square().sum(-1).mean()
                    loss = -gain + loss + s.bound_cost * excess + self.penalty()
                self.optimizer.zero_grad()
                loss.backward()
                nn.utils.clip_grad_norm_(self.parameters, s.gradient_norm)
                self.optimizer.step()
        return divergence

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
                labels.append(self.unmirrored(action, left))
                if number > 0 or self.again:
                    action = self.unmirrored(self.means(observation), left)
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

    # Results and checkpoints.

    def exported(self) -> policies.Policy:
        """Returns the current policy without PyTorch."""
        averaged = self.average is not None and self.average.n_averaged > 0
        return networks.exported(
            self.environments, self.average.module if averaged else self.policy, self.scales,
            id=self.spec.id,  # the simulations may be of several environments
            info=networks.described(self.environments, self.seed, self.samples),
            places=self.places, activation=self.settings.activation,
            log_std=self.log_std.detach().numpy().copy(), mirror=self.mirror,
        )  # fmt: skip

    def evaluate(self, folder: pathlib.Path, divergence: float) -> None:
        """Adds a point to the curve; keeps the policy if it is the best so far."""
        policy, s = self.exported(), self.settings
        found = evaluation.evaluate(
            self.spec, policy, s.evaluation_episodes, runs.EVALUATION_SEED, self.threads,
            s.evaluated_with,
        )  # fmt: skip
        returned, steps, number = self.recent.tolist()
        self.recent[:] = 0
        self.curve.append({
            'samples': self.samples,
            **{name: found[name] for name in ('normalized_return', 'completion_rate', 'distance')},
            'training_return': returned / max(number, 1), 'training_length': steps / max(number, 1),
            'std': float(self.log_std.detach().exp().mean()), 'divergence': divergence,
            'seconds': dict(self.seconds),
        })  # fmt: skip
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
        for network, saved in zip(self.networks, state['networks'], strict=True):
            network.load_state_dict(saved)
        self.log_std.data.copy_(state['log_std'])
        self.optimizer.load_state_dict(state['optimizer'])
        self.scales.count, self.scales.mean, self.scales.square = state['scales']
        self.random.bit_generator.state = state['random']

    def save(self, folder: pathlib.Path) -> None:
        """Writes checkpoint and curve."""
        state = {
            **{name: getattr(self, name) for name in _STATE},
            **self.learnt(),
            'settings': dataclasses.asdict(self.settings),
            'environments': self.environments.get_state(),
        }
        runs.write_curve(folder, self.spec.id, self.seed, self.settings, self.threads, self.curve)
        # Last: a run that continues from it finds all other files.
        runs.save(state, folder / 'checkpoint.pt')

    def restore(self, folder: pathlib.Path) -> None:
        """Restores the run from the files that `save` wrote."""
        state = runs.load_run(folder, self.settings)
        if state['current'] != self.current:
            self.environments.close()
            self.begin_stage(state['current'])
        for name in _STATE:
            setattr(self, name, state[name])
        self.set_learnt(state)
        self.environments.set_state(state['environments'])


def _check(s: Settings) -> None:
    if not 1 <= s.stages_averaged <= max(1, len(s.stages)):
        raise ValueError(
            f'stages_averaged: {s.stages_averaged}; expected 1 to {max(1, len(s.stages))}, the '
            'number of stages'
        )
    errors.check_known('landing cost', LANDING_ERRORS, *s.landing_costs)
    errors.check_known('activation', ACTIVATIONS, s.activation)
    if s.convolutions and not s.map_bound:
        raise ValueError('convolutions: expected a map_bound, so that all maps have one scale')


def clipped_gain(ratio: torch.Tensor, advantage: torch.Tensor, clip: float) -> torch.Tensor:
    """Returns PPO's objective for ratios of probabilities, (n,)."""
    return torch.minimum(ratio * advantage, ratio.clamp(1 - clip, 1 + clip) * advantage).mean()


def train(
    id_: str, seed: int, settings: Settings, folder: pathlib.Path, threads: int = 0,
    progress: bool = True,
) -> list[dict[str, Any]]:  # fmt: skip
    """Trains to the end, from the checkpoint in `folder` if there is one; returns the curve.

    With `further` settings each run has its own subfolder, and the curve is that of all runs.

    Raises:
      ValueError: the checkpoint is damaged, or has other settings; a mean over more runs than there are.
      RuntimeError: another process trains in the folder.
    """
    several = [
        dataclasses.replace(settings, **{'further': (), 'runs_averaged': 1, **changes})
        for changes in ({}, *settings.further)
    ]
    if not 1 <= settings.runs_averaged <= len(several):
        raise ValueError(
            f'runs_averaged: {settings.runs_averaged}; expected 1 to {len(several)}, the number of runs'
        )
    with runs.only_run(folder):
        if not settings.further:
            return _train(id_, seed, settings, folder, threads, progress)
        curve: list[dict[str, Any]] = []
        ends: list[policies.Policy] = []
        for i, own in enumerate(several):
            part = folder / f'run_{i + 1}'
            part.mkdir(exist_ok=True)
            before = curve[-1] if curve else None
            points = _train(id_, seed, own, part, threads, progress, ends[-1] if ends else None)
            curve += [continued(point, before) for point in points]
            ends.append(policies.load(part / 'last.npz'))
        best, last = policies.load(part / 'policy.npz'), mean_of(ends[-settings.runs_averaged :])
        for name, policy in (('policy.npz', best), ('last.npz', last)):
            info = {**policy.info, **continued({'samples': policy.info['samples']}, before)}
            policies.save(dataclasses.replace(policy, info=info), folder / name)
        runs.write_curve(folder, id_, seed, settings, threads, curve)
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
    id_: str, seed: int, settings: Settings, folder: pathlib.Path, threads: int, progress: bool,
    initial: policies.Policy | None = None,
) -> list[dict[str, Any]]:  # fmt: skip
    torch.set_num_threads(1)  # a second thread slows down networks of this size
    trainer, total = Trainer(id_, seed, settings, threads, initial), int(settings.samples)
    if (folder / 'checkpoint.pt').exists():
        trainer.restore(folder)
    with tqdm.tqdm(
        total=total, initial=trainer.samples, unit='sample', disable=None if progress else True
    ) as bar:
        bar.set_description(id_)
        while trainer.samples < total and not trainer.has_learnt():
            if trainer.stage != trainer.current:
                trainer.environments.close()
                trainer.begin_stage(trainer.stage)
            begin, before = time.perf_counter(), trainer.samples
            if not trainer.begun:
                trainer.imitate(settings.start, folder)
                trainer.begun = True
            # A policy that only imitates is not updated: its value network has learnt nothing.
            batch = trainer.collect() if trainer.samples < total else None
            middle, divergence = time.perf_counter(), 0.0
            if batch is not None:
                divergence = trainer.learn(batch)
                if trainer.average:
                    trainer.average.update_parameters(trainer.policy)
            if trainer.stage != trainer.current:
                policies.save(trainer.exported(), folder / f'stage_{trainer.current}.npz')
            end = time.perf_counter()
            trainer.seconds['simulation'] += middle - begin
            trainer.seconds['learning'] += end - middle
            bar.update(trainer.samples - before)
            returned, steps, number = trainer.recent.tolist()
            bar.set_postfix(
                reward=f'{returned / max(steps, 1):.2f}',
                length=f'{steps / max(number, 1):.0f}',
                score=f'{trainer.curve[-1]["normalized_return"]:.2f}' if trainer.curve else '-',
                refresh=False,
            )
            if (
                runs.passed(before, trainer.samples, settings.evaluate_every)
                or trainer.samples >= total
            ):
                trainer.evaluate(folder, divergence)
                trainer.seconds['evaluation'] += time.perf_counter() - end
                trainer.save(folder)
    # A stage that one update has passed has no policy of its own.
    earlier = range(trainer.current - settings.stages_averaged + 1, trainer.current)
    stages = [folder / f'stage_{i}.npz' for i in earlier]
    parts = [policies.load(path) for path in stages if path.exists()]
    policies.save(mean_of([*parts, trainer.exported()]), folder / 'last.npz')
    return trainer.curve


def main() -> None:
    id_, seed, changes, folder, threads = runs.command_line(
        __doc__.splitlines()[0], 'control steps'
    )
    runs.check_seeds('--seed', seed)
    for point in train(id_, seed, settings_for(id_, **changes), folder, threads):
        score, complete = point['normalized_return'], point['completion_rate']
        print(f'{point["samples"]:9} {score:.3f} of the maximum, {complete:.0%} complete')
    print(folder / 'policy.npz')


if __name__ == '__main__':
    begin_script()
    main()
