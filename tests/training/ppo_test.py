"""The trainer of training/ppo.py: its parts, exact resumption, and learning."""

import copy
import dataclasses
import io
import json
import os
import pathlib
import subprocess
import sys
from unittest import mock

import networks
import numpy as np
import ppo
import pytest
import runs
import settings
import torch
from absl.testing import parameterized
from helpers import FolderTest
from settings import Settings, settings_for

from trl_suite import evaluation, policies, terrain
from trl_suite.environments import named_policies
from trl_suite.registry import catalogue
from trl_suite.util import machine

FOLDER = pathlib.Path(ppo.__file__).parent
FLAT = 'PD_Biped2D_LLC_Imitate_Flat-v0'
SOCCER, BLOCKS = 'PD_Biped3D_HLC_Soccer-v0', 'PD_Biped3D_HLC_LargeBlocks-v0'
STEPS = 'PD_Biped3D_LLC_General_Step-v0'
START = 'PD_Biped2D_Flat_Terrain-v0'
TINY = {
    'samples': 512, 'num_envs': 8, 'horizon': 8, 'minibatch': 32, 'hidden': (16, 16),
    'evaluate_every': 128, 'evaluation_episodes': 2,
}  # fmt: skip


def tiny(**changes):
    return Settings(**{**TINY, **changes})


def make(id_=FLAT, initial=None, seed=0, **changes):
    return ppo.Trainer(id_, seed, tiny(**changes), 1, initial)


def varied(policy, least=0.02):
    """Returns a policy all of whose inputs would be copied, as if they had varied in training."""
    return dataclasses.replace(policy, std=np.maximum(policy.std, least))


def inside(trainer):
    """Returns the actions of the network in training."""
    seen, left = trainer.seen(trainer.observation)
    return np.clip(trainer.unmirrored(trainer.means(seen), left), -1, 1)


class PartsTest(parameterized.TestCase):
    def test_advantages(self):
        """Against the sum that defines them, (gamma lambda)^k times errors up to an end."""
        random = np.random.default_rng(0)
        reward, value, following = random.normal(size=(3, 9, 4))
        ended = random.random((9, 4)) < 0.2
        found = ppo.advantages(reward, value, following, ended, 0.9, 0.8)
        error = reward + 0.9 * following - value
        for t, env_id in np.ndindex(9, 4):
            ends = np.flatnonzero(ended[t:, env_id])
            sum_ = error[t : t + ends[0] + 1 if len(ends) else None, env_id]
            expected = (0.9 * 0.8) ** np.arange(len(sum_)) @ sum_
            self.assertAlmostEqual(found[t, env_id], expected)

    def test_scales(self):
        data = np.random.default_rng(0).normal(3, [1, 5, 0.2, 2, 1e-6, 4], (1000, 6))
        blocks = {'terrain': slice(0, 2), 'pose': slice(2, 5), 'phase': slice(5, 6)}
        scales = networks.Scales(blocks, 6)
        for part in np.split(data, [10, 400]):
            scales.update(part)
        np.testing.assert_allclose(scales.mean[2:5], data[:, 2:5].mean(0))
        np.testing.assert_allclose(scales.std[2:4], data[:, 2:4].std(0))
        self.assertEqual(scales.std[4], networks.LEAST_STD)  # almost constant inputs
        # All heights share one scale about the ground under the root, and the phase stays.
        np.testing.assert_allclose(scales.mean[:2], 0)
        np.testing.assert_allclose(scales.std[:2], np.sqrt((data[:, :2] ** 2).mean()))
        np.testing.assert_array_equal((scales.mean[5], scales.std[5]), (0, 1))
        self.assertEqual(scales(np.full(6, 1e9)).abs().max(), networks.OBSERVATION_CLIP)

    def test_every_environment_has_settings(self):
        for id_, spec in catalogue.BY_ID.items():
            own = settings_for(id_)
            # Steps of gaits and plans are 10 to 20 times longer.
            long = spec.task_type in ('gait', 'goal_navigation', 'soccer')
            self.assertGreaterEqual(own.samples, 5e4 if long else 2e5 if own.start else 5e5, id_)
            if own.start:
                self.assertIn(own.start, {**catalogue.BY_ID, **ppo.TEACHERS})
            for changes in ({}, *own.further):
                run = dataclasses.replace(own, **changes)
                # The gradient of a last minibatch of a few samples would be noise.
                rest = run.num_envs * run.horizon % run.minibatch or run.minibatch
                self.assertGreaterEqual(rest, run.minibatch / 8, id_)

    def test_gaits_that_stand_still_are_ended_in_training_only(self):
        trainer = make('PD_Raptor2D_LLC_Imitate_Flat-v0', least_share={'com': 0.37})
        terms = {'com': np.full(8, 0.2)}  # the weight: on the clip's speed
        terms['com'][3] = 0.0  # nowhere near it
        steps = 0
        while not (strays := trainer.strays(terms)).any():
            steps += 1
        np.testing.assert_array_equal(np.flatnonzero(strays), [3])
        # 0.3 s of smoothing: exp(-t / 0.3) < 0.37 at 0.3 s.
        self.assertBetween(steps / 30, 0.2, 0.35)

    def test_inputs_that_were_always_0_have_no_weights(self):
        """A level ground's heights, for example, which are not 0 where the policy is used."""
        trainer = make('PD_Dog2D_LLC_Imitate_Flat-v0')
        trainer.learn(trainer.collect())
        unused = (trainer.scales.mean == 0) & (trainer.scales.square == 0)
        self.assertBetween(np.count_nonzero(unused), 1, 10)
        weights = np.abs(trainer.exported().weights[0]).max(1)
        np.testing.assert_array_equal(weights == 0, unused)

    @parameterized.parameters(((),), (((0.0, ({}, {'heading_scale': 2.0})),),))
    def test_landing_errors_may_cost_reward(self, stages):
        """With one simulation environment, and with several."""
        targets = []
        for costs in ({}, {'landing_error': 1e3}):
            trainer = make(STEPS, horizon=40, stages=stages, landing_costs=costs, lambda_=1.0)
            targets.append(trainer.collect()['target'].numpy().reshape(40, -1))
        self.assertTrue((targets[0] != targets[1]).any())  # a foot has landed
        np.testing.assert_array_less(targets[1], targets[0] + 1e-3)
        self.assertLess((targets[1] - targets[0]).min(), -1)

    def test_several_options_at_the_same_time(self):
        trainer = make(stages=((0.0, ({'start_phase': 0.25}, {'action_scale': 2.0}, {})),))
        parts = trainer.environments.parts
        self.assertEqual([part.num_envs for part in parts], [3, 3, 2])
        np.testing.assert_array_equal(trainer.environments.group, [0, 0, 0, 1, 1, 1, 2, 2])
        self.assertLen({seed for part in parts for seed in part.seeds}, 8)
        np.testing.assert_array_equal(parts[0].task.phase, 0.25)
        self.assertGreater(np.ptp(parts[2].task.phase), 0)

    @parameterized.parameters(
        (STEPS, {'landing_costs': {'landing_eror': 1.0}}, "landing cost 'landing_eror'.*landing_error"),
        (FLAT, {'activation': 'rely'}, "unknown activation 'rely'.*'relu'"),
        (BLOCKS, {'convolutions': ((4, 4, 2),)}, 'convolutions: .*expected a map_bound'),
        (FLAT, {'convolutions': ((4, 4, 2),), 'map_bound': 1.0}, 'not maps of the ground: pose'),
        (FLAT, {'stages': settings.evenly([{}] * 2), 'stages_averaged': 0}, 'stages_averaged: 0; expected 1 to 2'),
        (FLAT, {'stages': settings.evenly([{}] * 2), 'stages_averaged': 3}, 'stages_averaged: 3; expected 1 to 2'),
        ('PD_Biped2D_Flat-v0', {'hidden': (256, 256), 'start': 'PD_Dog2D_LLC_Imitate_Flat-v0'},
         'PD_Biped2D_Flat-v0 has other actions than PD_Dog2D'),
    )  # fmt: skip
    def test_bad_settings_are_refused(self, id_, changes, message):
        with self.assertRaisesRegex(ValueError, message):
            make(id_, **changes)

    def test_near_parts_of_maps(self):
        """Both velocity maps are reduced as the height map."""
        one = {'terrain': slice(0, 1024), 'pose': slice(1024, 1030)}
        two = {'surface': slice(0, 2048), 'pose': slice(2048, 2054)}
        near = networks.visible(one, 1030, (2.5, 1.0))
        both = networks.visible(two, 2054, (2.5, 1.0))
        count = len(near) - 6
        self.assertEqual(count, 10 * 6)  # 11 m by 11 m at 32 by 32 points: 3.5 m along, 2 m across
        np.testing.assert_array_equal(both[count : 2 * count], near[:count] + 1024)
        np.testing.assert_array_equal(both[-6:], np.arange(2048, 2054))
        self.assertIsNone(networks.visible({'pose': slice(0, 6)}, 6, (2.5, 1.0)))


def grounds(id_, stages):
    """Yields the ground of every simulation in each third of a run."""
    trainer = make(id_, samples=300, stages=stages)
    for samples in (0, 100, 200):
        trainer.samples = samples
        trainer.begin_stage(trainer.stage)
        task = trainer.environments.task
        yield [task.arena.grounds[i] for i in range(TINY['num_envs'])]
        assert trainer.spec.terrain == catalogue.BY_ID[id_].terrain  # where it is evaluated


class CurriculumTest(parameterized.TestCase):
    def test_stages_begin_when_episodes_are_long(self):
        trainer = make(stages=settings.evenly([{}, {'start_phase': 0.25}]), stage_length=10.0)
        n = TINY['num_envs']
        everyone, nobody = np.ones(n, bool), np.zeros(n, bool)
        for length, stage in ((9, 1), (10, 2), (10, 2)):  # there is no third stage
            for step in range(length):
                trainer.advance()  # without effect before episodes have ended
                trainer.count(np.zeros(n), everyone if step == length - 1 else nobody)
            trainer.advance()
            self.assertEqual(trainer.stage, stage)

    def test_rising_walls(self):
        stages = settings.rising('mixed_humanoid', {'WallHMin': 0.1, 'WallHMax': 0.2}, (0.0, 0.5))
        heights = [
            {(s.parameters['WallHMin'], s.parameters['WallHMax']) for s in strips}
            for strips in grounds('PD_Biped2D_Mixed_Terrain-v0', stages)
        ]
        np.testing.assert_allclose(
            [pair for (pair,) in heights], [(0.1, 0.2), (0.175, 0.3), (0.25, 0.4)]
        )

    def test_dense_obstacles(self):
        stages = settings.crowded('slopes_mixed_humanoid')
        spacings, types = [], []
        for strips in grounds('PD_Biped2D_Slopes_Mixed_Terrain-v0', stages):
            values = strips[0].parameters
            types.append(strips[0].type)
            names = (f'{name}SpacingMax' for name in ('Wall', 'Gap'))
            spacings += [values[name] for name in names if name in values]
            self.assertEqual(values['WallHMax'], 0.4)
        self.assertEqual(types, ['var2d_slopes_walls', *['var2d_slopes_mixed'] * 2])
        np.testing.assert_allclose(spacings, [8 / 3, 8 / 3, 8 / 3, 4, 4])

    def test_half_of_the_simulations_may_have_walls_only(self):
        stages = settings.with_walls('slopes_mixed_humanoid')
        trainer = make('PD_Raptor2D_Slopes_Mixed_Terrain-v0', stages=stages)
        halves = [part.task.arena.grounds[0] for part in trainer.environments.parts]
        types = [ground.type for ground in halves]
        self.assertEqual(types, ['var2d_slopes_mixed', 'var2d_slopes_walls'])
        self.assertEqual([ground.parameters['WallHMax'] for ground in halves], [0.4, 0.4])

    @parameterized.parameters(
        ('gaps_humanoid', {'GapW': (0.275, 0.33)}),
        ('walls_humanoid', {'WallH': (0.15, 0.275)}),
        ('slopes_mixed_humanoid',
         {'GapW': (0.4, 0.55), 'WallH': (0.325, 0.44), 'StepH0': (0.2, 0.33), 'StepH1': (-0.33, -0.2)}),
    )  # fmt: skip
    def test_half_of_the_simulations_may_have_larger_obstacles(self, preset, expected):
        ((begin, (own, larger)),) = settings.with_larger(preset)
        self.assertEqual((begin, own), (0.0, {}))
        given, ground = terrain.load(preset), terrain.load(larger['terrain'])
        self.assertEqual(ground.type, given.type)
        before, after = given.parameter_sets[0], ground.parameter_sets[0]
        for name, bounds in expected.items():
            np.testing.assert_allclose((after[f'{name}Min'], after[f'{name}Max']), bounds)
        changed = {f'{name}{end}' for name in expected for end in ('Min', 'Max')}
        self.assertEqual({name for name in after if after[name] != before[name]}, changed)

    def test_curricula_may_be_joined(self):
        heights = settings.rising('mixed_humanoid', settings.LOW, (0.0, 0.5))
        dense = settings.crowded('mixed_humanoid')
        found = settings.joined(heights, dense)
        np.testing.assert_allclose([begin for begin, _ in found], np.arange(5) / 5)
        expected = [options for _, options in (*heights[:2], *dense)]
        self.assertEqual([options for _, options in found], expected)
        self.assertEqual(expected[-1], {})  # the preset, once


class StartTest(parameterized.TestCase):
    """Runs that start from a policy, and what policies are made of."""

    @parameterized.parameters('PD_Biped2D_Gaps_Terrain-v0', 'PD_Biped2D_Flat-v0')  # without terrain
    def test_a_run_may_start_from_another_policy(self, id_):
        other = policies.reference(START)
        trainer, flat = (make(each, hidden=(256, 256), start=START) for each in (id_, START))
        observation = trainer.observation.copy()
        blocks, base = trainer.environments.blocks, flat.environments.blocks
        as_flat = np.zeros((len(observation), other.observation_size))
        for name in ('pose', 'velocity', 'phase'):
            as_flat[:, base[name]] = observation[:, blocks[name]]
        policy = trainer.exported()
        # Nothing rises on flat ground: what rises here has no influence yet.
        np.testing.assert_allclose(policy(observation), other(as_flat), atol=1e-4)
        # At first only the value function is trained.
        before = policy.weights[0].copy()
        trainer.learn(trainer.collect())
        np.testing.assert_array_equal(trainer.exported().weights[0], before)
        trainer.samples = int(trainer.settings.value_first)
        trainer.learn(trainer.collect())
        self.assertTrue((trainer.exported().weights[0] != before).any())

    def test_the_value_may_learn_faster_before_the_policy(self):
        trainer = make(
            START, hidden=(256, 256), learning_rate=1e-4, last_learning_rate=1e-4, start=START,
            value_first=1000, value_rate=1e-3,
        )  # fmt: skip
        rates = []
        for samples in (0, 2000):
            batch = trainer.collect()
            trainer.samples = samples
            trainer.learn(batch)
            rates.append({group['lr'] for group in trainer.optimizer.param_groups})
        self.assertEqual(rates, [{1e-3}, {1e-4}])

    @parameterized.parameters((2e4, 100.0), (1e9, 1e6))
    def test_scales_of_an_initial_policy_are_kept_for_the_given_time(self, count, least):
        """After a hundredth as many observations, means have moved by less than the step."""
        own = {'hidden': (256, 256), 'start': START, 'start_count': count}
        trainer = make('PD_Biped2D_Gaps_Terrain-v0', **own)
        pose, scales = trainer.environments.blocks['pose'], trainer.scales
        before = scales.mean[pose].copy()
        scales.update(np.broadcast_to(scales.mean + 1.0, (200, len(scales.mean))))
        moved = np.abs(scales.mean[pose] - before)
        np.testing.assert_allclose(moved, 200 / (count + 200), rtol=1e-3)
        self.assertLess(moved.max(), 1 / least)

    def test_the_exported_policy_is_the_network(self):
        trainer = make()
        for _ in range(3):
            trainer.learn(trainer.collect())
        with torch.no_grad():
            for parameter in trainer.policy.parameters():  # far from its small beginning
                parameter.add_(0.1 * torch.randn_like(parameter))
        exported = trainer.exported()
        exported.check(trainer.environments)
        np.testing.assert_allclose(exported(trainer.observation), inside(trainer), atol=1e-5)

    def test_the_exported_policy_may_be_an_average(self):
        trainer = make(averaged=4 * TINY['num_envs'] * TINY['horizon'])
        bias, expected = trainer.policy[-1].bias, None
        for value in (1.0, 3.0, -5.0):
            with torch.no_grad():
                bias.fill_(value)
            trainer.average.update_parameters(trainer.policy)
            expected = value if expected is None else 0.75 * expected + 0.25 * value
        np.testing.assert_allclose(trainer.exported().biases[-1], expected, rtol=1e-6)

    def assert_continues(self, id_, policy, observation, *changes, same=True):
        """Checks whether further runs with certain settings begin with what a policy does."""
        for own in changes:
            found = make(id_, policy, 1, **own).exported()(observation)
            self.assertEqual(np.allclose(found, policy(observation), atol=1e-4), same, own)

    def test_policies_can_have_cartesian_inputs(self):
        """By the network in training as by what it exports; and a start that saw them fits."""
        places = ('goal', 'ball')
        trainer = make(SOCCER, places=places, mirrored=True)
        trainer.learn(trainer.collect())
        policy, blocks = trainer.exported(), trainer.environments.blocks
        expected = [[blocks[name].start, blocks[name].start + 1] for name in places]
        np.testing.assert_array_equal(policy.places, expected)
        self.assertLen(policy.mean, policy.observation_size + 4)
        np.testing.assert_allclose(policy(trainer.observation), inside(trainer), atol=1e-5)
        both, turned, one = (
            {'places': p, 'mirrored': True} for p in (places, places[::-1], places[1:])
        )
        case = SOCCER, varied(policy, 1.0), trainer.observation
        self.assert_continues(*case, both, turned)
        self.assert_continues(*case, one, same=False)

    def test_maps_may_be_clipped(self):
        own = {'map_bound': 0.3, 'view': (6.0, 3.0)}
        trainer = make(BLOCKS, **own)
        trainer.collect()
        policy, observation = trainer.exported(), trainer.observation.copy()
        self.assertTrue((trainer.scales(observation).abs().max(1).values > 0.99).any())  # walls
        np.testing.assert_allclose(policy(observation), inside(trainer), atol=1e-5)
        # What is higher than the bound makes no difference.
        part, cut = trainer.environments.blocks['terrain'], observation.copy()
        cut[:, part] = np.clip(cut[:, part], -0.3, 0.3)
        np.testing.assert_allclose(policy(cut), policy(observation), atol=1e-6)
        self.assert_continues(BLOCKS, varied(policy), observation, own)
        wider = {**own, 'map_bound': 0.5}
        self.assert_continues(BLOCKS, varied(policy), observation, wider, same=False)

    def test_policies_may_have_convolutions_over_maps(self):
        id_, own = 'PD_Biped3D_HLC_DynamicsObstacles-v0', {
            'map_bound': 1.0, 'view': (6.0, 3.6), 'activation': 'relu', 'mirrored': True,
            'convolutions': ((4, 4, 2), (6, 3, 1)),
        }  # fmt: skip
        trainer = make(id_, **own)
        trainer.learn(trainer.collect())
        policy, observation = trainer.exported(), trainer.observation
        # 32 points on 11 m: 20 ahead and 20 across, in two maps; 9 x 9 positions, then 7 x 7.
        self.assertEqual((policy.convolution.line, policy.convolution.grid), (800, (20, 20)))
        self.assertEqual(policy.convolution.outputs, 7 * 7 * 6)
        np.testing.assert_allclose(policy(observation), inside(trainer), atol=1e-5)
        mean = networks.mean_of([policy, policy])
        np.testing.assert_allclose(mean(observation), policy(observation), atol=1e-5)
        policy = varied(policy)
        self.assert_continues(id_, policy, observation, own)
        for changes in (
            {'convolutions': ((4, 4, 2),)}, {'convolutions': ()}, {'view': (6.0, 3.0)},
            {'map_bound': 2.0},
        ):  # fmt: skip
            with (
                self.subTest(changes),
                self.assertRaisesRegex(ValueError, 'convolutions: those of'),
            ):
                make(id_, policy, 1, **{**own, **changes})


class ImitationTest(FolderTest):
    def test_the_rate_of_imitation_falls(self):
        trainer = make(
            SOCCER, start='scripted', cloned=64, cloning_epochs=3, cloning_rate=1e-2,
            last_cloning_rate=1e-3,
        )  # fmt: skip
        step, rates = torch.optim.Adam.step, []

        def counted(optimizer):
            rates.append(optimizer.param_groups[0]['lr'])
            return step(optimizer)

        with mock.patch.object(torch.optim.Adam, 'step', counted):
            trainer.imitate('scripted')
        np.testing.assert_allclose(rates, np.repeat([1e-2, 5.5e-3, 1e-3], 2))

    def test_a_run_may_start_by_imitating_a_baseline(self):
        trainer = make(SOCCER, start='scripted', cloned=160, view=(6.0, 3.0))
        teacher = named_policies.BASELINES['scripted'](trainer.environments)
        seen, labels = trainer.observation.copy(), teacher(trainer.observation)
        before = np.abs(trainer.exported()(seen) - labels).mean()
        trainer.imitate('scripted')
        self.assertEqual(trainer.samples, 160)
        self.assertLess(np.abs(trainer.exported()(seen) - labels).mean(), before / 2)

    def test_a_policy_that_only_imitates_is_not_updated(self):
        own = tiny(start='scripted', cloned=160, samples=160, value_first=0.0)
        with mock.patch.object(ppo.Trainer, 'learn') as learn:
            (point,) = ppo.train(SOCCER, 0, own, self.folder, threads=1, progress=False)
        learn.assert_not_called()
        self.assertEqual(point['samples'], 160)

    def test_after_the_first_round_the_policy_walks(self):
        seen = []
        for clonings in (1, 2):
            own = {'cloned': 160, 'clonings': clonings, 'initial_std': 1e-9}
            seen.append(self.actions(make(SOCCER, start='scripted', **own)))
        half = len(seen[0]) // 2
        np.testing.assert_allclose(seen[0][:half], seen[1][:half], atol=1e-6)
        self.assertGreater(np.abs(seen[0][half] - seen[1][half]).max(), 1e-3)

    def actions(self, trainer):
        """Returns the actions in a run of imitation."""
        step = trainer.environments.step
        with mock.patch.object(trainer.environments, 'step', wraps=step) as called:
            trainer.imitate('scripted')
        self.assertEqual(trainer.samples, 160)
        return [call.args[0] for call in called.call_args_list]

    def test_a_further_run_may_imitate_again(self):
        """Its initial policy selects the actions from the beginning."""
        own = {'start': 'scripted', 'cloned': 160, 'initial_std': 1e-9}
        first = make(BLOCKS, **own, imitates_again=True)
        self.assertFalse(first.begun)
        first.imitate('scripted')
        policy = varied(first.exported())
        self.assertTrue(make(BLOCKS, policy, **own).begun)
        again = make(BLOCKS, policy, **own, imitates_again=True)
        self.assertFalse(again.begun)
        expected = again.exported()(again.observation)
        np.testing.assert_allclose(self.actions(again)[0], expected, atol=1e-4)

    def test_policies_are_evaluated_between_rounds(self):
        trainer = make(SOCCER, start='scripted', cloned=160, clonings=2, averaged=100.0)
        before = trainer.exported()(trainer.observation)
        trainer.imitate('scripted', self.folder)
        self.assertEqual([point['samples'] for point in trainer.curve], [80])
        labels = policies.load(self.folder / 'policy.npz')(trainer.observation)
        self.assertGreater(np.abs(labels - before).mean(), 0.1)  # not yet the average


class RunTest(FolderTest):
    def train(self, name, **changes):
        path = self.folder / name
        return ppo.train(FLAT, 3, tiny(**changes), path, threads=1, progress=False)

    @parameterized.named_parameters(
        ('plain', {}),
        ('two sets of options', {'stages': ((0.0, ({}, {'start_phase': 0.25})),)}),
        (
            'another stage from a checkpoint on',
            {'stages': ((0.0, {}), (0.5, {'terrain': 'slopes'}))},
        ),
        (
            'another stage after long episodes',
            {
                'stages': ((0.0, {}), (0.0, {'terrain': 'slopes'})),
                'stage_length': 5.0,
                'step_limit': 8,
            },
        ),
        ('further', {'samples': 256, 'further': ({'value_first': 0.0},)}),
    )
    def test_a_stopped_run_resumes_exactly(self, changes):
        whole = self.train('whole', **changes)
        learn, calls = ppo.Trainer.learn, []

        def stopped(trainer, batch):
            calls.append(trainer.samples)
            if len(calls) == 6:  # between two checkpoints
                raise KeyboardInterrupt
            return learn(trainer, batch)

        with mock.patch.object(ppo.Trainer, 'learn', stopped), self.assertRaises(KeyboardInterrupt):
            self.train('parts', **changes)
        self.assertFalse((self.folder / 'parts' / 'last.npz').exists())
        parts = self.train('parts', **changes)
        for point in parts + whole:
            del point['seconds']
        self.assertEqual(parts, whole)
        self.assertEqual([point['samples'] for point in whole], [128, 256, 384, 512])
        for name in ('policy.npz', 'last.npz'):
            one, two = (policies.load(self.folder / run / name) for run in ('whole', 'parts'))
            self.assertLessEqual(machine.made_with().items(), one.info.items())
            for a, b in zip(one.weights + one.biases, two.weights + two.biases, strict=True):
                np.testing.assert_array_equal(a, b)
        with self.assertRaisesRegex(ValueError, 'other settings'):
            self.train('whole', **{**changes, 'clip': 0.1})

    def test_a_damaged_checkpoint_is_refused(self):
        self.train('run', samples=128)
        path = self.folder / 'run' / 'checkpoint.pt'
        whole = path.read_bytes()
        flipped = bytearray(whole)
        flipped[len(whole) // 2] ^= 1
        other = io.BytesIO()
        torch.save({'settings': {}}, other)
        for content, message in (
            (whole[: len(whole) // 2], 'damaged or incomplete'), (whole[:-1], 'damaged or incomplete'),
            (bytes(flipped), 'damaged or incomplete'), (b'', 'not a checkpoint of this version'),
            (other.getvalue(), 'not a checkpoint of this version'), (whole[1:], 'not a checkpoint of'),
        ):  # fmt: skip
            path.write_bytes(content)
            with self.assertRaisesRegex(ValueError, f'checkpoint.pt: .*{message}.*; remove it to'):
                self.train('run', samples=256)
            self.assertEqual(path.read_bytes(), content)
        path.write_bytes(whole)
        self.assertLen(self.train('run', samples=128), 1)

    def test_a_checkpoint_has_arrays_and_runs_no_code(self):
        path = self.folder / 'checkpoint.pt'
        runs.save({'none': np.zeros((0, 3))}, path)
        self.assertEqual(runs.load(path)['none'].shape, (0, 3))
        runs.save({'where': pathlib.PurePosixPath('x'), 'a': np.arange(3)}, path)
        message = 'contains pathlib.PurePosixPath; expected arrays, numbers'
        with self.assertRaisesRegex(ValueError, message):
            runs.load(path)

    def test_two_runs_in_one_folder(self):
        folder = self.folder / 'run'
        with runs.only_run(folder):
            message = f'process {os.getpid()} trains in .*run; wait for it'
            with self.assertRaisesRegex(RuntimeError, message):
                self.train('run')
        self.assertNotIn('checkpoint.pt', os.listdir(folder))
        program = 'import sys, pathlib, runs, os, signal\n'
        program += 'with runs.only_run(pathlib.Path(sys.argv[1])): os.kill(os.getpid(), 9)'
        subprocess.run([sys.executable, '-c', program, folder], cwd=FOLDER, check=False)
        with runs.only_run(folder):  # a run that was killed locks nothing
            pass

    def test_bad_input_ends_in_one_line(self):
        done = subprocess.run(
            [sys.executable, '-W', 'ignore', 'ppo.py', 'PD_Biped2D', '--output', str(self.folder)],
            cwd=FOLDER, capture_output=True, text=True, check=False,
        )  # fmt: skip
        self.assertEqual((done.returncode, done.stdout), (1, ''))
        self.assertRegex(done.stderr, "^ppo.py: error: unknown environment 'PD_Biped2D'; .*\n$")

    def test_episodes_in_training_may_have_their_own_limit(self):
        for limit, expected in ((0, 256), (7, 7)):
            trainer = make('PD_Biped2D_Flat-v0', step_limit=limit)
            self.assertEqual(trainer.environments.step_limit, expected)

    def test_a_run_ends_at_its_target_return(self):
        trainer = make(enough=0.9)
        for fractions, expected in (
            ((), False), ((0.95,), False), ((0.95, 0.8), False), ((0.8, 0.95), False),
            ((0.8, 0.9, 0.91), True),
        ):  # fmt: skip
            trainer.curve = [{'normalized_return': fraction} for fraction in fractions]
            self.assertEqual(trainer.has_learnt(), expected)

    def test_evaluations_may_have_other_options(self):
        distances = []
        for options in ({}, {'randomize': {'gravity': 0.0}}):
            trainer = make(evaluated_with=options)
            with mock.patch.object(evaluation, 'evaluate', wraps=evaluation.evaluate) as called:
                trainer.evaluate(self.folder, 0.0)
            self.assertEqual(called.call_args.args[-1], options)
            distances.append(trainer.curve[-1]['distance'])
        self.assertNotEqual(*distances)

    @parameterized.parameters(False, True)
    def test_an_update_ends_at_its_kl_limit(self, value_goes_on):
        trainer = make(kl_per_action=-1.0, value_goes_on=value_goes_on)
        parts = trainer.policy, trainer.value
        before = [copy.deepcopy(part.state_dict()) for part in parts]
        trainer.learn(trainer.collect())
        for part, old, same in zip(parts, before, (True, not value_goes_on), strict=True):
            for name, weight in part.state_dict().items():
                self.assertEqual(torch.equal(weight, old[name]), same, name)

    def test_truncated_episodes_bootstrap_the_value(self):
        """Where nothing but the step limit ends episodes, targets do not dip before it."""
        trainer = make(dataclasses.replace(catalogue.BY_ID[FLAT], step_limit=2), horizon=4)
        with torch.no_grad():
            for parameter in trainer.value.parameters():
                parameter.zero_()
            trainer.value[-1].bias.fill_(7.0)  # the value of every state
        batch = trainer.collect()
        # Episodes last two steps: no target lacks the 7 that follow, discounted.
        self.assertGreater(float(batch['target'].min()), 7 * trainer.settings.gamma**2)

    def test_further_runs_start_from_the_policy_of_the_one_before(self):
        first = self.train('first', samples=128)
        further = {'samples': 128, 'num_envs': 4, 'value_first': 1e9}, {'value_first': 0.0}
        found = self.train('all', samples=128, further=further)
        self.assertEqual([point['samples'] for point in found], [128, 256, 384])
        times = [point['seconds']['simulation'] for point in found]
        self.assertEqual(times, sorted(times))
        self.assertEqual(found[0]['normalized_return'], first[0]['normalized_return'])
        one, two, last = (
            policies.load(self.folder / name)
            for name in ('first/last.npz', 'all/run_2/last.npz', 'all/last.npz')
        )
        for a, b in zip(one.weights, two.weights, strict=True):  # only its value was trained
            rows = one.std > networks.LEAST_STD if a is one.weights[0] else slice(None)
            np.testing.assert_array_equal(a[rows], b[rows])
        self.assertFalse(np.array_equal(two.weights[0], last.weights[0]))
        self.assertEqual([one.info['samples'], last.info['samples']], [128, 384])
        record = json.loads((self.folder / 'all' / 'curve.json').read_text())
        self.assertEqual(record['settings']['further'], list(further))
        self.assertLen(record['curve'], 3)
        self.assertEqual(self.train('all', samples=128, further=further), found)

    def test_policies_of_the_last_runs_are_averaged(self):
        further = {'value_first': 0.0}, {'value_first': 0.0}
        found = self.train('all', samples=128, further=further, runs_averaged=2)
        two, three, mean = (
            policies.load(self.folder / 'all' / f'{name}.npz')
            for name in ('run_2/last', 'run_3/last', 'last')
        )
        self.assert_mean(two, three, mean)
        self.assertFalse(np.array_equal(two.weights[0], three.weights[0]))
        self.assertEqual(mean.info['samples'], found[-1]['samples'])

    def assert_mean(self, one, two, mean):
        for part in ('mean', 'std', 'log_std'):
            expected = (getattr(one, part) + getattr(two, part)) / 2
            np.testing.assert_allclose(getattr(mean, part), expected, rtol=1e-6, atol=1e-7)
        for part in ('weights', 'biases'):
            for a, b, found in zip(*(getattr(p, part) for p in (one, two, mean)), strict=True):
                np.testing.assert_allclose(found, (a + b) / 2, rtol=1e-5, atol=1e-7)

    @parameterized.parameters(
        ({'further': ({},), 'runs_averaged': 0}, ValueError, 'runs_averaged: 0; expected 1 to 2'),
        ({'further': ({},), 'runs_averaged': 3}, ValueError, 'runs_averaged: 3; expected 1 to 2'),
        ({'further': ({'sample': 128},)}, TypeError, "unexpected keyword argument 'sample'"),
    )
    def test_further_settings_are_checked_before_the_first_run(self, changes, error, message):
        with self.assertRaisesRegex(error, message):
            self.train('all', **changes)
        self.assertEmpty([path for path in self.folder.rglob('*') if path.suffix])

    def test_the_exported_policy_may_be_the_mean_over_ends_of_stages(self):
        samples = TINY['num_envs'] * TINY['horizon']  # of an update, and of a curriculum stage
        self.train('run', samples=3 * samples, stages=settings.evenly([{}] * 3), stages_averaged=2)
        first, second, best, last = (
            policies.load(self.folder / 'run' / f'{name}.npz')
            for name in ('stage_1', 'stage_2', 'policy', 'last')
        )
        self.assertEqual([p.info['samples'] for p in (first, second)], [samples, 2 * samples])
        self.assertFalse((self.folder / 'run' / 'stage_3.npz').exists())
        self.assertEqual(best.info, last.info)  # the only one after all curriculum stages
        self.assert_mean(second, best, last)

    @pytest.mark.slow
    def test_a_short_run_learns(self):
        """0.15 M samples, seed 0: measured 0.9 of the maximum over 32 episodes."""
        own = settings_for(FLAT, samples=1.5e5, evaluate_every=1.5e5)
        folder = self.folder / 'run'
        ppo.train(FLAT, 0, own, folder, threads=1, progress=False)
        found = evaluation.evaluate(FLAT, policies.load(folder / 'last.npz'), 32, seed=1)
        self.assertGreater(found['normalized_return'], 0.6)
        self.assertGreater(found['completion_rate'], 0.9)
