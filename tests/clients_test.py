"""Programs that use the suite through other libraries: the examples run with expected results."""

import importlib
import math
import pathlib
import re
import sys
import unittest
from unittest import mock

import gymnasium
import numpy as np
import pytest
from absl.testing import absltest, parameterized
from programs import EXAMPLES, CommandTest, output, run_example

import trl_suite.gym
from trl_suite import sequences, suite

ROOT = pathlib.Path(__file__).resolve().parents[1]
REALISTIC = [
    'ideal',
    'torque_speed',
    'torque_pose',
    'delay',
    'flex',
    'backlash',
    'noise',
    'strength',
    'all',
]
FLAT, GAPS = 'PD_Biped2D_Flat-v0', 'PD_Biped2D_Gaps_Terrain-v0'


def needs(module, extra, only_there=''):
    """Skips a class of tests where the extra, or a module that `only_there` is required, is not installed."""

    def decorated(tested):
        begin = tested.setUpClass

        def set_up_class(_):
            if importlib.util.find_spec(only_there or module.partition('.')[0]) is None:
                raise unittest.SkipTest(f"no {module}: pip install 'trl_suite[{extra}]'")
            importlib.import_module(module)
            begin()

        tested.setUpClass = classmethod(set_up_class)
        return tested

    return decorated


def run_page(word):
    """Runs the code block of docs/clients.md that contains a word; returns its names."""
    page = (ROOT / 'docs' / 'clients.md').read_text(encoding='utf-8')
    (code,) = (
        found for found in re.findall('```python\n(.*?)```', page, re.DOTALL) if word in found
    )
    names = {}
    output(lambda: exec(compile(code, 'clients.md', 'exec'), names))
    return names


def load(name):
    """Imports an example."""
    with mock.patch.object(sys, 'path', [str(EXAMPLES), *sys.path]):
        return importlib.import_module(name)


class GymnasiumTest(absltest.TestCase):
    def test_example_runs(self):
        out = run_example('gymnasium_rollout')
        self.assertRegex(out, r'^one: return \d+\.\d, -?\d+\.\d\d m, fell: True\n')
        # Random actions fell a walker within a second or so: 16 simulations of 256 steps.
        self.assertGreater(int(re.search(r'\n16: (\d+) episodes', out)[1]), 50)

    def test_code_of_the_page_runs(self):
        names = run_page('registers all ids')
        self.assertEqual(names['observations'].shape, (16, 104))
        self.assertEqual(names['rewards'].shape, (16,))


@needs('stable_baselines3', 'sb3')
class StableBaselinesTest(CommandTest):
    def test_code_of_the_page_runs(self):
        model = run_page('import SuiteVecEnv')['model']
        self.assertEqual(model.num_timesteps, 2048)

    @pytest.mark.slow
    def test_example_runs(self):
        out = run_example('stable_baselines_ppo', '--samples', '40960', '--every', '4096')
        returns = [float(line.split()[1]) for line in out.splitlines()[1:]]
        self.assertGreater(max(returns), returns[0] + 4)

    @pytest.mark.slow
    def test_learners_of_sequences(self):
        """The second stage of PLAiD takes samples on both terrains."""
        sequence = sequences.Sequence('two', ('PD_Biped2D_Flat_Terrain-v0', GAPS))
        for name, kind, expected in (
            ('continual_learning', 'FineTuning', [[4096, 0], [0, 4096]]),
            ('plaid', 'Plaid', [[4096, 0], [320, 2048 + 320]]),
        ):
            learner = getattr(load(name), kind)(sequence, 0)
            found = sequences.run(sequence, learner, 4096, f'{name}.json', episodes=1)
            self.assertEqual(found['samples'], expected)
            self.assertGreater(found['scores'][1][0], 0)


class ExamplesTest(absltest.TestCase):
    def test_every_example_is_short(self):
        self.assertNotEmpty(paths := [*EXAMPLES.glob('*.py')])
        for path in paths:
            self.assertLessEqual(len(path.read_text().splitlines()), 60, path.name)

    def test_actuators(self):
        out = run_example('real_actuators', '--episodes', '1')
        self.assertEqual([line.split()[0] for line in out.splitlines()], REALISTIC)
        shares = [float(line.split()[3]) for line in out.splitlines()]
        self.assertGreater(shares[0], 0.9)  # with ideal motors
        self.assertBetween(min(shares), 0.05, shares[0])


@needs('torchrl', 'torchrl')
class TorchRLTest(parameterized.TestCase):
    """TorchRL's wrappers: of a single environment, and of simulations on threads."""

    def setUp(self):
        super().setUp()
        import logging

        logging.getLogger('torchrl').setLevel('ERROR')

    def make(self, num_envs, **options):
        from torchrl.envs import GymEnv, GymWrapper

        if not num_envs:
            return GymEnv(f'trl_suite/{GAPS}', **options)
        return GymWrapper(
            gymnasium.make_vec(
                f'trl_suite/{GAPS}', num_envs=num_envs, autoreset_mode='Disabled', **options
            )
        )

    @parameterized.product(num_envs=(0, 3), flat_observation=(True, False))
    def test_specs(self, num_envs, flat_observation):
        from torchrl.envs import check_env_specs

        environment = self.make(num_envs, flat_observation=flat_observation)
        check_env_specs(environment)
        blocks = {'terrain': 50, 'pose': 25, 'velocity': 24, 'phase': 5}
        sizes = {'observation': 104} if flat_observation else blocks
        found = {name: spec.shape[-1] for name, spec in environment.observation_spec.items()}
        self.assertEqual(found, sizes)

    def test_simulations_equal_those_of_the_suite(self):
        """A rollout through successive episodes equals that of single environments."""
        import torch

        environment = self.make(3)
        environment.set_seed(5)
        torch.manual_seed(0)
        found = environment.rollout(60, break_when_any_done=False)
        self.assertGreater(int(found['next', 'done'].sum()), 3)
        for env_id, seed in enumerate(np.random.SeedSequence(5).generate_state(3)):
            single = trl_suite.gym.SuiteEnv(GAPS)
            single.reset(seed=int(seed))  # as TorchRL does when it is given a seed
            observation, _ = single.reset()
            for step in found[env_id]:
                np.testing.assert_array_equal(step['observation'], observation)
                observation, reward, terminated, truncated, _ = single.step(step['action'].numpy())
                np.testing.assert_array_equal(step['next', 'observation'], observation)
                self.assertEqual(step['next', 'reward'].item(), np.float32(reward))
                self.assertEqual(step['next', 'terminated'].item(), terminated)
                self.assertEqual(step['next', 'truncated'].item(), truncated)
                if terminated or truncated:
                    observation, _ = single.reset()

    def test_code_of_the_page_runs(self):
        names = run_page('torchrl')
        self.assertEqual(names['many'].batch_size, (16,))
        self.assertEqual(names['one'].batch_size, ())

    @pytest.mark.slow
    def test_example_runs(self):
        out = run_example('torchrl_ppo', '--samples', '24576')
        returns = [float(found) for found in re.findall(r'return +([\d.]+)\n', out)]
        self.assertLen(returns, 12)
        self.assertGreater(np.mean(returns[-3:]), 1.2 * np.mean(returns[:3]))


@needs('shimmy', 'shimmy')
class ShimmyTest(parameterized.TestCase):
    @parameterized.parameters(
        GAPS, 'FSM_Dog2D_Terrain_Gaps-v0', 'PD_Biped3D_LLC_General_Step-v0',
        'PD_Biped3D_HLC_Soccer-v0',
    )  # fmt: skip
    def test_passes_the_checker(self, id_):
        from gymnasium.utils.env_checker import check_env
        from shimmy.dm_control_compatibility import DmControlCompatibilityV0

        check_env(DmControlCompatibilityV0(suite.make(id_)), skip_render_check=True)

    def test_code_of_the_page_runs(self):
        expected = suite.make(FLAT, {'random': 1}).reset().observation
        for name, block in run_page('shimmy')['observation'].items():
            np.testing.assert_array_equal(block, expected[name])

    def test_example_runs(self):
        out = run_example('shimmy_rollout')
        self.assertRegex(out, r'^return \d+\.\d, -?\d+\.\d\d m, fell: True\n')
        self.assertEndsWith(out, 'picture of shape (240, 320, 3)\n')


@needs('ray.rllib', 'rllib', 'ormsgpack')
class RLlibTest(absltest.TestCase):
    def test_configuration(self):
        for name, runners in (('rllib_ppo', 3), ('rllib_appo', 1)):  # in a batch
            configuration = load(name).configuration(GAPS, runners=3, num_envs=8, seed=7)
            configuration.validate()
            self.assertEqual(configuration.total_train_batch_size, runners * 8 * 32)

    @pytest.mark.slow
    def test_two_runners_on_ground_of_their_own(self):
        import ray

        example = load('rllib_ppo')
        # The other processes cannot import it, nor this test.
        ray.cloudpickle.register_pickle_by_value(example)
        ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False, logging_level='ERROR')
        self.addCleanup(ray.shutdown)
        algorithm = example.configuration(FLAT, runners=2, num_envs=16, seed=7).build_algo()
        self.addCleanup(algorithm.stop)
        for updates in range(1, 4):
            found = algorithm.train()
            sampled = found['env_runners']['num_env_steps_sampled_lifetime']
            self.assertBetween(sampled, updates * 1024, updates * 1100)
        mean = found['env_runners']['episode_return_mean']
        self.assertBetween(mean, 5, 256)
        self.assertTrue(math.isfinite(found['learners']['default_policy']['total_loss']))
        self.assertEqual(found['fault_tolerance']['num_healthy_workers'], 2)

        states = algorithm.env_runner_group.foreach_env_runner(
            lambda runner: runner.env.unwrapped.environment.get_state(), local_env_runner=False
        )
        for runner, state in enumerate(states, 1):
            expected = np.random.SeedSequence(7 + runner).generate_state(16)
            np.testing.assert_array_equal(state['seeds'], expected)
            self.assertGreater(state['steps'].sum(), 16)
        self.assertFalse(np.array_equal(*(state['world'][0] for state in states)))
