"""The trainer of training/ppo.py: its parts, exact resumption, and learning."""

import dataclasses
import io
import json
import os
import pathlib
import subprocess
import sys
import tempfile
from unittest import mock

import checkpoints
import numpy as np
import ppo
import ppo_settings
import pytest
import torch
from absl.testing import absltest, parameterized

from trl_suite import evaluation, policies, terrain
from trl_suite.registry import catalogue
from trl_suite.util import machine

FOLDER = pathlib.Path(ppo.__file__).parent

FLAT = 'PD_Biped2D_LLC_Imitate_Flat-v0'
TINY = {
    'samples': 512, 'num_envs': 8, 'horizon': 8, 'minibatch': 32, 'hidden': (16, 16),
    'evaluate_every': 128, 'evaluation_episodes': 2,
}  # fmt: skip


class PartsTest(parameterized.TestCase):
    def test_advantages(self):
        """Against the sum that defines them, (gamma lambda)^k times errors up to an end."""
        random = np.random.default_rng(0)
        reward, value, following = random.normal(size=(3, 9, 4))
        ended = random.random((9, 4)) < 0.2
        found = ppo.advantages(reward, value, following, ended, 0.9, 0.8)
        error = reward + 0.9 * following - value
        for t in range(9):
            for env_id in range(4):
                expected = 0.0
                for k in range(t, 9):
                    expected += (0.9 * 0.8) ** (k - t) * error[k, env_id]
                    if ended[k, env_id]:
                        break
                self.assertAlmostEqual(found[t, env_id], expected)

    def test_scales(self):
        random = np.random.default_rng(0)
        data = random.normal(3, [1, 5, 0.2, 2, 1e-6, 4], (1000, 6))
        scales = ppo.Scales({'terrain': slice(0, 2), 'pose': slice(2, 5), 'phase': slice(5, 6)}, 6)
        for part in np.split(data, [10, 400]):
            scales.update(part)
        np.testing.assert_allclose(scales.mean[2:5], data[:, 2:5].mean(0))
        np.testing.assert_allclose(scales.std[2:4], data[:, 2:4].std(0))
        self.assertEqual(
            scales.std[4], ppo.LEAST_STD
        )  # the scale of almost constant inputs is bounded
        # All heights share one scale about the ground under the root, and the phase stays.
        np.testing.assert_allclose(scales.mean[:2], 0)
        np.testing.assert_allclose(scales.std[:2], np.sqrt((data[:, :2] ** 2).mean()))
        np.testing.assert_array_equal((scales.mean[5], scales.std[5]), (0, 1))
        self.assertEqual(scales(np.full(6, 1e9)).abs().max(), ppo.OBSERVATION_CLIP)

    def test_every_environment_has_settings(self):
        for id_ in catalogue.BY_ID:
            settings = ppo_settings.settings_for(id_)
            cycles = catalogue.BY_ID[id_].task_type == 'gait'  # a step is 10 to 20 times longer
            plans = catalogue.BY_ID[id_].task_type in ('goal_navigation', 'soccer')
            least = 5e4 if cycles or plans else 2e5 if settings.start else 5e5
            self.assertGreaterEqual(settings.samples, least, id_)
            if settings.start:
                self.assertIn(settings.start, {**catalogue.BY_ID, **ppo.TEACHERS})
            self.assertEqual(settings.num_envs * settings.horizon % settings.minibatch, 0)

    def test_gaits_that_stand_still_are_ended_in_training_only(self):
        trainer = ppo.Trainer(
            'PD_Raptor2D_LLC_Imitate_Flat-v0',
            0,
            ppo_settings.Settings(**TINY, least_share={'com': 0.37}),
            1,
        )
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
        trainer = ppo.Trainer('PD_Dog2D_LLC_Imitate_Flat-v0', 0, ppo_settings.Settings(**TINY), 1)
        trainer.learn(trainer.collect())
        unused = (trainer.scales.mean == 0) & (trainer.scales.square == 0)
        self.assertBetween(np.count_nonzero(unused), 1, 10)
        weights = np.abs(trainer.exported().weights[0]).max(1)
        np.testing.assert_array_equal(weights == 0, unused)

    @parameterized.parameters(((),), (((0.0, ({}, {'heading_scale': 2.0})),),))
    def test_landing_errors_may_cost_reward(self, stages):
        """With one simulation environment, and with several."""
        id_ = 'PD_Biped3D_LLC_General_Step-v0'
        settings = ppo_settings.Settings(**{**TINY, 'horizon': 40}, stages=stages)
        targets = []
        for costs in ({}, {'landing_error': 1e3}):
            trainer = ppo.Trainer(
                id_, 0, dataclasses.replace(settings, landing_costs=costs, lambda_=1.0), 1
            )
            targets.append(trainer.collect()['target'].numpy().reshape(40, -1))
        differs = (targets[0] != targets[1]).any(0)
        self.assertTrue(differs.any())  # a foot has landed
        np.testing.assert_array_less(targets[1], targets[0] + 1e-3)
        self.assertLess((targets[1] - targets[0]).min(), -1)

    def test_unknown_landing_costs_are_refused(self):
        settings = ppo_settings.Settings(**TINY, landing_costs={'landing_eror': 1.0})
        with self.assertRaisesRegex(ValueError, "landing cost 'landing_eror'.*landing_error"):
            ppo.Trainer('PD_Biped3D_LLC_General_Step-v0', 0, settings, 1)

    def test_several_options_at_the_same_time(self):
        groups = {'start_phase': 0.25}, {'action_scale': 2.0}, {}
        settings = ppo_settings.Settings(**TINY, stages=((0.0, groups),))
        trainer = ppo.Trainer(FLAT, 0, settings, 1)
        parts = trainer.environments.parts
        self.assertEqual([part.num_envs for part in parts], [3, 3, 2])
        self.assertLen({seed for part in parts for seed in part.seeds}, 8)
        np.testing.assert_array_equal(parts[0].task.phase, 0.25)
        self.assertGreater(np.ptp(parts[2].task.phase), 0)


class RunTest(parameterized.TestCase):
    def setUp(self):
        self.folder = pathlib.Path(self.enterContext(tempfile.TemporaryDirectory()))

    def train(self, name, **changes):
        settings = ppo_settings.Settings(**{**TINY, **changes})
        return ppo.train(FLAT, 3, settings, self.folder / name, threads=1, progress=False)

    @parameterized.named_parameters(
        ('plain', {}),
        ('two sets of options', {'stages': ((0.0, ({}, {'start_phase': 0.25})),)}),
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

    def test_a_checkpoint_runs_no_code(self):
        path = self.folder / 'checkpoint.pt'
        checkpoints.save({'where': pathlib.PurePosixPath('x'), 'a': np.arange(3)}, path)
        with self.assertRaisesRegex(
            ValueError, 'contains pathlib.PurePosixPath; expected arrays, numbers'
        ):
            checkpoints.load(path)

    def test_a_checkpoint_may_have_empty_arrays(self):
        path = self.folder / 'checkpoint.pt'
        checkpoints.save({'none': np.zeros((0, 3))}, path)
        self.assertEqual(checkpoints.load(path)['none'].shape, (0, 3))

    def test_two_runs_in_one_folder(self):
        with checkpoints.only_run(self.folder / 'run'):
            message = f'process {os.getpid()} trains in .*run; wait for it'
            with self.assertRaisesRegex(RuntimeError, message):
                self.train('run')
        self.assertNotIn('checkpoint.pt', os.listdir(self.folder / 'run'))
        program = 'import sys, pathlib, checkpoints, os, signal\n'
        program += 'with checkpoints.only_run(pathlib.Path(sys.argv[1])): os.kill(os.getpid(), 9)'
        folder = str(self.folder / 'run')
        subprocess.run([sys.executable, '-c', program, folder], cwd=FOLDER, check=False)
        with checkpoints.only_run(self.folder / 'run'):  # a run that was killed locks nothing
            pass

    def test_bad_input_ends_in_one_line(self):
        done = subprocess.run(
            [sys.executable, '-W', 'ignore', 'ppo.py', 'PD_Biped2D', '--output', str(self.folder)],
            cwd=FOLDER, capture_output=True, text=True, check=False,
        )  # fmt: skip
        self.assertEqual((done.returncode, done.stdout), (1, ''))
        self.assertRegex(done.stderr, "^ppo.py: error: unknown environment 'PD_Biped2D'; .*\n$")

    def test_the_exported_policy_may_be_an_average(self):
        batch = TINY['num_envs'] * TINY['horizon']
        trainer = ppo.Trainer(FLAT, 0, ppo_settings.Settings(**TINY, averaged=4 * batch), 1)
        bias, expected = trainer.policy[-1].bias, None
        for value in (1.0, 3.0, -5.0):
            with torch.no_grad():
                bias.fill_(value)
            trainer.average.update_parameters(trainer.policy)
            expected = value if expected is None else 0.75 * expected + 0.25 * value
        np.testing.assert_allclose(trainer.exported().biases[-1], expected, rtol=1e-6)

    def test_the_exported_policy_is_the_network(self):
        trainer = ppo.Trainer(FLAT, 0, ppo_settings.Settings(**TINY), 1)
        for _ in range(3):
            trainer.learn(trainer.collect())
        with torch.no_grad():
            for parameter in trainer.policy.parameters():  # far from its small beginning
                parameter.add_(0.1 * torch.randn_like(parameter))
            expected = trainer.policy(trainer.scales(trainer.observation)).numpy()
        exported = trainer.exported()
        exported.check(trainer.environments)
        np.testing.assert_allclose(
            exported(trainer.observation), np.clip(expected, -1, 1), atol=1e-5
        )

    @parameterized.parameters(
        ('PD_Biped2D_Gaps_Terrain-v0',),  # the same observation
        ('PD_Biped2D_Flat-v0',),  # one without the terrain
    )
    def test_a_run_may_start_from_another_policy(self, id_):
        start = 'PD_Biped2D_Flat_Terrain-v0'
        other = policies.reference(start)
        settings = ppo_settings.Settings(**{**TINY, 'hidden': (256, 256)}, start=start)
        trainer = ppo.Trainer(id_, 0, settings, 1)
        flat = ppo.Trainer(start, 0, settings, 1)
        observation = trainer.observation.copy()
        blocks, base = trainer.environments.blocks, flat.environments.blocks
        as_flat = np.zeros((len(observation), other.observation_size))
        for name in ('pose', 'velocity', 'phase'):
            as_flat[:, base[name]] = observation[:, blocks[name]]
        policy = trainer.exported()
        # Nothing rises on flat ground: what rises here has no influence yet.
        np.testing.assert_allclose(policy(observation), other(as_flat), atol=1e-4)
        # At first only the value function is trained.
        before = [weight.copy() for weight in policy.weights]
        trainer.learn(trainer.collect())
        np.testing.assert_array_equal(trainer.exported().weights[0], before[0])
        trainer.samples = int(settings.value_first)
        trainer.learn(trainer.collect())
        self.assertTrue((trainer.exported().weights[0] != before[0]).any())

    def test_the_value_may_learn_faster_before_the_policy(self):
        start = 'PD_Biped2D_Flat_Terrain-v0'
        changes = {'hidden': (256, 256), 'learning_rate': 1e-4, 'last_learning_rate': 1e-4}
        settings = ppo_settings.Settings(
            **{**TINY, **changes}, start=start, value_first=1000, value_rate=1e-3
        )
        trainer = ppo.Trainer(start, 0, settings, 1)
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
        start = 'PD_Biped2D_Flat_Terrain-v0'
        settings = ppo_settings.Settings(
            **{**TINY, 'hidden': (256, 256)}, start=start, start_count=count
        )
        trainer = ppo.Trainer('PD_Biped2D_Gaps_Terrain-v0', 0, settings, 1)
        pose = trainer.environments.blocks['pose']
        before = trainer.scales.mean[pose].copy()
        trainer.scales.update(
            np.broadcast_to(trainer.scales.mean + 1.0, (200, len(trainer.scales.mean)))
        )
        moved = np.abs(trainer.scales.mean[pose] - before)
        np.testing.assert_allclose(moved, 200 / (count + 200), rtol=1e-3)
        self.assertLess(moved.max(), 1 / least)

    def test_policies_can_have_cartesian_inputs(self):
        """By the network in training as by what it exports; and a start that saw them fits."""
        id_, places = 'PD_Biped3D_HLC_Soccer-v0', ('goal', 'ball')
        settings = ppo_settings.Settings(**TINY, places=places, mirrored=True)
        trainer = ppo.Trainer(id_, 0, settings, 1)
        trainer.learn(trainer.collect())
        policy = trainer.exported()
        blocks = trainer.environments.blocks
        expected = [[blocks[name].start, blocks[name].start + 1] for name in places]
        np.testing.assert_array_equal(policy.places, expected)
        self.assertLen(policy.mean, policy.observation_size + 4)
        observation, left = trainer.seen(trainer.observation)
        with torch.no_grad():
            inside = trainer.policy(trainer.scales(observation)).numpy()
        inside = trainer.mirror.unmirror_action(inside, left)
        np.testing.assert_allclose(policy(trainer.observation), np.clip(inside, -1, 1), atol=1e-5)
        # Inputs that have not varied would not be copied.
        policy = dataclasses.replace(policy, std=np.ones_like(policy.std))
        for names, same in ((places, True), (places[::-1], True), (places[1:], False)):
            other = ppo.Trainer(id_, 1, dataclasses.replace(settings, places=names), 1)
            other.begin_with(policy)
            found = other.exported()(trainer.observation)
            self.assertEqual(np.allclose(found, policy(trainer.observation), atol=1e-4), same)

    def test_maps_may_be_clipped(self):
        id_ = 'PD_Biped3D_HLC_LargeBlocks-v0'
        settings = ppo_settings.Settings(**TINY, map_bound=0.3, view=(6.0, 3.0))
        trainer = ppo.Trainer(id_, 0, settings, 1)
        trainer.collect()
        policy, observation = trainer.exported(), trainer.observation.copy()
        inputs = trainer.scales(observation)
        walls = inputs.abs().max(1).values > 0.99
        self.assertTrue(walls.any())
        with torch.no_grad():
            inside = trainer.policy(inputs).numpy()
        np.testing.assert_allclose(policy(observation), np.clip(inside, -1, 1), atol=1e-5)
        # What is higher than the bound makes no difference.
        part = trainer.environments.blocks['terrain']
        cut = observation.copy()
        cut[:, part] = np.clip(cut[:, part], -0.3, 0.3)
        np.testing.assert_allclose(policy(cut), policy(observation), atol=1e-6)
        # Inputs that have not varied would not be copied.
        policy = dataclasses.replace(policy, std=np.maximum(policy.std, 0.02))
        for bound, same in ((0.3, True), (0.5, False)):
            other = ppo.Trainer(id_, 1, dataclasses.replace(settings, map_bound=bound), 1)
            other.begin_with(policy)
            found = other.exported()(observation)
            self.assertEqual(np.allclose(found, policy(observation), atol=1e-4), same)

    def test_policies_may_have_convolutions_over_maps(self):
        settings = ppo_settings.Settings(
            **TINY, map_bound=1.0, view=(6.0, 3.6), activation='relu', mirrored=True,
            convolutions=((4, 4, 2), (6, 3, 1)),
        )  # fmt: skip
        id_ = 'PD_Biped3D_HLC_DynamicsObstacles-v0'
        trainer = ppo.Trainer(id_, 0, settings, 1)
        trainer.learn(trainer.collect())
        policy, observation = trainer.exported(), trainer.observation
        # 32 points on 11 m: 20 ahead and 20 across, in two maps; 9 x 9 positions, then 7 x 7.
        self.assertEqual((policy.convolution.line, policy.convolution.grid), (800, (20, 20)))
        self.assertEqual(policy.convolution.outputs, 7 * 7 * 6)
        seen, left = trainer.seen(observation)
        with torch.no_grad():
            inside = trainer.policy(trainer.scales(seen)).numpy()
        inside = trainer.mirror.unmirror_action(inside, left)
        np.testing.assert_allclose(policy(observation), np.clip(inside, -1, 1), atol=1e-5)
        mean = ppo.mean_of([policy, policy])
        np.testing.assert_allclose(mean(observation), policy(observation), atol=1e-5)
        # Inputs that have not varied would not be copied.
        policy = dataclasses.replace(policy, std=np.maximum(policy.std, 0.02))
        other = ppo.Trainer(id_, 1, settings, 1, policy)
        np.testing.assert_allclose(other.exported()(observation), policy(observation), atol=1e-4)
        for changes in (
            {'convolutions': ((4, 4, 2),)}, {'convolutions': ()}, {'view': (6.0, 3.0)},
            {'map_bound': 2.0},
        ):  # fmt: skip
            with (
                self.subTest(changes),
                self.assertRaisesRegex(ValueError, 'convolutions: those of'),
            ):
                ppo.Trainer(id_, 1, dataclasses.replace(settings, **changes), 1, policy)

    @parameterized.parameters(
        ('PD_Biped3D_HLC_LargeBlocks-v0', {}, 'expected a map_bound'),
        (FLAT, {'map_bound': 1.0}, 'not maps of the ground: pose'),
    )
    def test_convolutions_need_maps(self, id_, changes, message):
        settings = ppo_settings.Settings(**TINY, convolutions=((4, 4, 2),), **changes)
        with self.assertRaisesRegex(ValueError, f'convolutions: .*{message}'):
            ppo.Trainer(id_, 0, settings, 1)

    def test_an_unknown_activation_is_rejected(self):
        settings = ppo_settings.Settings(**TINY, activation='rely')
        with self.assertRaisesRegex(ValueError, "unknown activation 'rely'.*'relu'"):
            ppo.Trainer(FLAT, 0, settings, 1)

    def test_the_rate_of_imitation_falls(self):
        settings = ppo_settings.Settings(
            **TINY, start='scripted', cloned=64, cloning_epochs=3, cloning_rate=1e-2,
            last_cloning_rate=1e-3,
        )  # fmt: skip
        trainer = ppo.Trainer('PD_Biped3D_HLC_Soccer-v0', 0, settings, 1)
        step, rates = torch.optim.Adam.step, []

        def counted(optimizer):
            rates.append(optimizer.param_groups[0]['lr'])
            return step(optimizer)

        with mock.patch.object(torch.optim.Adam, 'step', counted):
            trainer.imitate('scripted')
        np.testing.assert_allclose(rates, np.repeat([1e-2, 5.5e-3, 1e-3], 2))

    def test_episodes_in_training_may_have_their_own_limit(self):
        for limit, expected in ((0, 256), (7, 7)):
            settings = ppo_settings.Settings(**TINY, step_limit=limit)
            trainer = ppo.Trainer('PD_Biped2D_Flat-v0', 0, settings, threads=1)
            self.assertEqual(trainer.environments.step_limit, expected)

    def test_a_run_may_start_by_imitating_a_baseline(self):
        id_ = 'PD_Biped3D_HLC_Soccer-v0'
        settings = ppo_settings.Settings(**TINY, start='scripted', cloned=160, view=(6.0, 3.0))
        trainer = ppo.Trainer(id_, 0, settings, 1)
        teacher = evaluation.BASELINES['scripted'](trainer.environments)
        seen, labels = trainer.observation.copy(), teacher(trainer.observation)
        before = np.abs(trainer.exported()(seen) - labels).mean()
        trainer.imitate('scripted')
        self.assertEqual(trainer.samples, 160)
        self.assertLess(np.abs(trainer.exported()(seen) - labels).mean(), before / 2)

    def test_after_the_first_round_the_policy_walks(self):
        id_ = 'PD_Biped3D_HLC_Soccer-v0'
        seen = []
        for clonings in (1, 2):
            settings = ppo_settings.Settings(
                **TINY, start='scripted', cloned=160, clonings=clonings, initial_std=1e-9
            )
            trainer = ppo.Trainer(id_, 0, settings, 1)
            with mock.patch.object(
                trainer.environments, 'step', wraps=trainer.environments.step
            ) as step:
                trainer.imitate('scripted')
            self.assertEqual(trainer.samples, 160)
            seen.append([call.args[0] for call in step.call_args_list])
        half = len(seen[0]) // 2
        np.testing.assert_allclose(seen[0][:half], seen[1][:half], atol=1e-6)
        self.assertGreater(np.abs(seen[0][half] - seen[1][half]).max(), 1e-3)

    def test_a_further_run_may_imitate_again(self):
        """Its initial policy selects the actions from the beginning."""
        id_ = 'PD_Biped3D_HLC_LargeBlocks-v0'
        settings = ppo_settings.Settings(
            **TINY, start='scripted', cloned=160, imitates_again=True, initial_std=1e-9
        )
        first = ppo.Trainer(id_, 0, settings, 1)
        self.assertFalse(first.begun)
        first.imitate('scripted')
        # Inputs that have not varied would not be copied.
        policy = dataclasses.replace(first.exported(), std=np.maximum(first.exported().std, 0.02))
        plain = dataclasses.replace(settings, imitates_again=False)
        self.assertTrue(ppo.Trainer(id_, 0, plain, 1, policy).begun)
        again = ppo.Trainer(id_, 0, settings, 1, policy)
        self.assertFalse(again.begun)
        expected = again.exported()(again.observation)
        with mock.patch.object(again.environments, 'step', wraps=again.environments.step) as step:
            again.imitate('scripted')
        self.assertEqual(again.samples, 160)
        np.testing.assert_allclose(step.call_args_list[0].args[0], expected, atol=1e-4)

    def test_policies_are_evaluated_between_rounds(self):
        settings = ppo_settings.Settings(
            **TINY, start='scripted', cloned=160, clonings=2, averaged=100.0
        )
        trainer = ppo.Trainer('PD_Biped3D_HLC_Soccer-v0', 0, settings, 1)
        before = trainer.exported()(trainer.observation)
        with tempfile.TemporaryDirectory() as name:
            trainer.imitate('scripted', pathlib.Path(name))
            self.assertEqual([point['samples'] for point in trainer.curve], [80])
            labels = policies.load(pathlib.Path(name) / 'policy.npz')(trainer.observation)
        self.assertGreater(np.abs(labels - before).mean(), 0.1)  # not yet the average

    def test_a_run_ends_at_its_target_return(self):
        trainer = ppo.Trainer(FLAT, 0, ppo_settings.Settings(**TINY, enough=0.9), 1)
        for fractions, expected in (
            ((), False), ((0.95,), False), ((0.95, 0.8), False), ((0.8, 0.95), False),
            ((0.8, 0.9, 0.91), True),
        ):  # fmt: skip
            trainer.curve = [{'normalized_return': fraction} for fraction in fractions]
            self.assertEqual(trainer.has_learnt(), expected)

    def test_evaluations_may_have_other_options(self):
        distances = []
        for options in ({}, {'randomize': {'gravity': 0.0}}):
            settings = ppo_settings.Settings(**TINY, evaluated_with=options)
            trainer = ppo.Trainer(FLAT, 0, settings, 1)
            with (
                tempfile.TemporaryDirectory() as name,
                mock.patch.object(evaluation, 'evaluate', wraps=evaluation.evaluate) as called,
            ):
                trainer.evaluate(pathlib.Path(name), 0.0)
            self.assertEqual(called.call_args.args[-1], options)
            distances.append(trainer.curve[-1]['distance'])
        self.assertNotEqual(*distances)

    def test_curriculum_of_rising_walls(self):
        stages = ppo_settings.rising(
            'mixed_humanoid', {'WallHMin': 0.1, 'WallHMax': 0.2}, (0.0, 0.5)
        )
        settings = ppo_settings.Settings(**{**TINY, 'samples': 300}, stages=stages)
        trainer = first = ppo.Trainer('PD_Biped2D_Mixed_Terrain-v0', 0, settings, 1)
        heights = []
        for samples in (0, 100, 200):
            trainer.samples = samples
            trainer.begin_stage()
            strips = (trainer.environments.task.arena.grounds[i] for i in range(TINY['num_envs']))
            ranges = {tuple(s.parameters[f'WallH{end}'] for end in ('Min', 'Max')) for s in strips}
            heights += ranges
        np.testing.assert_allclose(heights, [(0.1, 0.2), (0.175, 0.3), (0.25, 0.4)])
        self.assertEqual(trainer.environments.spec.terrain, 'mixed_humanoid')
        self.assertEqual(first.spec.terrain, 'mixed_humanoid')  # where it is evaluated

    def test_curriculum_of_dense_obstacles(self):
        stages = ppo_settings.crowded('slopes_mixed_humanoid')
        settings = ppo_settings.Settings(**{**TINY, 'samples': 300}, stages=stages)
        trainer = ppo.Trainer('PD_Biped2D_Slopes_Mixed_Terrain-v0', 0, settings, 1)
        spacings, types = [], []
        for samples in (0, 100, 200):
            trainer.samples = samples
            trainer.begin_stage()
            ground = trainer.environments.task.arena.terrain
            types.append(ground.type)
            values = ground.parameters()
            spacings.append(
                [
                    values[f'{name}SpacingMax']
                    for name in ('Wall', 'Gap')
                    if f'{name}SpacingMax' in values
                ]
            )
            self.assertEqual(values['WallHMax'], 0.4)
        self.assertEqual(types, ['var2d_slopes_walls', *['var2d_slopes_mixed'] * 2])
        np.testing.assert_allclose(np.concatenate(spacings), [8 / 3, 8 / 3, 8 / 3, 4, 4])

    def test_half_of_the_simulations_may_have_walls_only(self):
        stages = ppo_settings.with_walls('slopes_mixed_humanoid')
        settings = ppo_settings.Settings(**TINY, stages=stages)
        trainer = ppo.Trainer('PD_Raptor2D_Slopes_Mixed_Terrain-v0', 0, settings, 1)
        grounds = [part.task.arena.grounds[0] for part in trainer.environments.parts]
        types = [ground.type for ground in grounds]
        self.assertEqual(types, ['var2d_slopes_mixed', 'var2d_slopes_walls'])
        walls = [ground.parameters['WallHMax'] for ground in grounds]
        self.assertEqual(walls, [0.4, 0.4])

    @parameterized.parameters(
        ('gaps_humanoid', {'GapW': (0.275, 0.33)}),
        ('walls_humanoid', {'WallH': (0.15, 0.275)}),
        (
            'slopes_mixed_humanoid',
            {
                'GapW': (0.4, 0.55),
                'WallH': (0.325, 0.44),
                'StepH0': (0.2, 0.33),
                'StepH1': (-0.33, -0.2),
            },
        ),
    )
    def test_half_of_the_simulations_may_have_larger_obstacles(self, preset, expected):
        ((begin, (own, larger)),) = ppo_settings.with_larger(preset)
        self.assertEqual((begin, own), (0.0, {}))
        given = terrain.load(preset)
        ground = terrain.load(larger['terrain'])
        self.assertEqual(ground.type, given.type)
        before, after = given.parameter_sets[0], ground.parameter_sets[0]
        for name, bounds in expected.items():
            found = after[f'{name}Min'], after[f'{name}Max']
            np.testing.assert_allclose(found, bounds)
        changed = {f'{name}{end}' for name in expected for end in ('Min', 'Max')}
        self.assertEqual({name for name in after if after[name] != before[name]}, changed)

    def test_curricula_may_be_joined(self):
        heights = ppo_settings.rising('mixed_humanoid', ppo_settings.LOW, (0.0, 0.5))
        dense = ppo_settings.crowded('mixed_humanoid')
        joined = ppo_settings.joined(heights, dense)
        np.testing.assert_allclose([begin for begin, _ in joined], np.arange(5) / 5)
        expected = [options for _, options in (*heights[:2], *dense)]
        self.assertEqual([options for _, options in joined], expected)
        self.assertEqual(expected[-1], {})  # the preset, once

    def test_near_parts_of_maps(self):
        """Both velocity maps are reduced as the height map."""
        one = {'terrain': slice(0, 1024), 'pose': slice(1024, 1030)}
        two = {'surface': slice(0, 2048), 'pose': slice(2048, 2054)}
        near, both = (
            ppo.visible(blocks, size, (2.5, 1.0)) for blocks, size in ((one, 1030), (two, 2054))
        )
        count = len(near) - 6
        # 11 m by 11 m at 32 by 32 points: 3.5 m along, 2 m across.
        self.assertEqual(count, 10 * 6)
        np.testing.assert_array_equal(both[count : 2 * count], near[:count] + 1024)
        np.testing.assert_array_equal(both[-6:], np.arange(2048, 2054))
        self.assertIsNone(ppo.visible({'pose': slice(0, 6)}, 6, (2.5, 1.0)))

    def test_an_initial_policy_with_other_actions_is_rejected(self):
        settings = ppo_settings.Settings(
            **{**TINY, 'hidden': (256, 256)}, start='PD_Dog2D_LLC_Imitate_Flat-v0'
        )
        with self.assertRaisesRegex(
            ValueError, 'PD_Biped2D_Flat-v0 has other actions than PD_Dog2D'
        ):
            ppo.Trainer('PD_Biped2D_Flat-v0', 0, settings, 1)

    def test_an_update_ends_at_its_kl_limit(self):
        trainer = ppo.Trainer(FLAT, 0, ppo_settings.Settings(**TINY, kl_per_action=-1.0), 1)
        before = [p.detach().clone() for p in trainer.parameters]
        trainer.learn(trainer.collect())
        for a, b in zip(before, trainer.parameters, strict=True):
            self.assertTrue(torch.equal(a, b))

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
            rows = one.std > ppo.LEAST_STD if a is one.weights[0] else slice(None)
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
        for a, b, c in zip(two.weights, three.weights, mean.weights, strict=True):
            self.assertFalse(np.array_equal(a, b))
            np.testing.assert_allclose(c, (a + b) / 2, rtol=1e-5, atol=1e-7)
        self.assertEqual(mean.info['samples'], found[-1]['samples'])

    @parameterized.parameters(0, 3)
    def test_mean_over_more_runs_than_exist_is_rejected(self, number):
        with self.assertRaisesRegex(ValueError, f'runs_averaged: {number}; expected 1 to 2'):
            self.train('all', further=({},), runs_averaged=number)
        self.assertEmpty([path for path in self.folder.rglob('*') if path.suffix])

    def test_further_settings_are_checked_before_the_first_run(self):
        with self.assertRaisesRegex(TypeError, "unexpected keyword argument 'sample'"):
            self.train('all', further=({'sample': 128},))
        self.assertEmpty([path for path in self.folder.rglob('*') if path.suffix])

    def test_value_training_can_continue(self):
        trainer = ppo.Trainer(
            FLAT, 0, ppo_settings.Settings(**TINY, kl_per_action=-1.0, value_goes_on=True), 1
        )
        policy, value = (part.state_dict() for part in (trainer.policy, trainer.value))
        policy, value = ({k: v.clone() for k, v in part.items()} for part in (policy, value))
        trainer.learn(trainer.collect())
        for name, weight in trainer.policy.state_dict().items():
            self.assertTrue(torch.equal(weight, policy[name]), name)
        for name, weight in trainer.value.state_dict().items():
            self.assertFalse(torch.equal(weight, value[name]), name)

    def test_truncated_episodes_bootstrap_the_value(self):
        """Where nothing but the step limit ends episodes, targets do not dip before it."""
        settings = ppo_settings.Settings(**{**TINY, 'horizon': 4})
        trainer = ppo.Trainer(
            dataclasses.replace(catalogue.BY_ID[FLAT], step_limit=2), 0, settings, 1
        )
        with torch.no_grad():
            for parameter in trainer.value.parameters():
                parameter.zero_()
            trainer.value[-1].bias.fill_(7.0)  # the value of every state
        batch = trainer.collect()
        # Episodes last two steps: no target lacks the 7 that follow, discounted.
        self.assertGreater(float(batch['target'].min()), 7 * settings.gamma**2)

    def test_the_exported_policy_may_be_the_mean_over_ends_of_stages(self):
        samples = TINY['num_envs'] * TINY['horizon']  # of an update, and of a curriculum stage
        settings = ppo_settings.Settings(
            **{**TINY, 'samples': 3 * samples},
            stages=ppo_settings.evenly([{}] * 3), stages_averaged=2,
        )  # fmt: skip
        ppo.train(FLAT, 0, settings, self.folder, threads=1, progress=False)
        first, second, best, last = (
            policies.load(self.folder / f'{name}.npz')
            for name in ('stage_1', 'stage_2', 'policy', 'last')
        )
        self.assertEqual([p.info['samples'] for p in (first, second)], [samples, 2 * samples])
        self.assertFalse((self.folder / 'stage_3.npz').exists())
        self.assertEqual(best.info, last.info)  # the only one after all curriculum stages
        for part in ('mean', 'std', 'log_std'):
            expected = (getattr(second, part) + getattr(best, part)) / 2
            np.testing.assert_allclose(getattr(last, part), expected, rtol=1e-6, atol=1e-7)
        for part in ('weights', 'biases'):
            for a, b, found in zip(*(getattr(p, part) for p in (second, best, last)), strict=True):
                np.testing.assert_allclose(found, (a + b) / 2, rtol=1e-6, atol=1e-7)

    @parameterized.parameters(0, 3)
    def test_mean_over_more_stages_than_exist_is_rejected(self, number):
        settings = ppo_settings.Settings(
            **TINY, stages=ppo_settings.evenly([{}] * 2), stages_averaged=number
        )
        with self.assertRaisesRegex(ValueError, f'stages_averaged: {number}; expected 1 to 2'):
            ppo.Trainer(FLAT, 0, settings, 1)

    @pytest.mark.slow
    def test_a_short_run_learns(self):
        """0.15 M samples, seed 0: measured 0.9 of the maximum over 32 episodes."""
        settings = ppo_settings.settings_for(FLAT, samples=1.5e5, evaluate_every=1.5e5)
        folder = self.folder / 'run'
        ppo.train(FLAT, 0, settings, folder, threads=1, progress=False)
        found = evaluation.evaluate(FLAT, policies.load(folder / 'last.npz'), 32, seed=1)
        self.assertGreater(found['normalized_return'], 0.6)
        self.assertGreater(found['completion_rate'], 0.9)


if __name__ == '__main__':
    absltest.main()
