"""Stable-Baselines3's interface, against its own vector environment of single ones."""

import gc
import importlib.util
import unittest

import gymnasium
import numpy as np
from absl.testing import parameterized

if importlib.util.find_spec('stable_baselines3') is None:
    raise unittest.SkipTest('needs stable-baselines3')

from stable_baselines3 import PPO
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor, VecNormalize

from trl_suite.adapters.stable_baselines import SuiteVecEnv
from trl_suite.environments import arguments
from trl_suite.gym import SuiteEnv
from trl_suite.runs import Course, Stage, train_seeds
from trl_suite.vector import VectorEnvironment

GAPS = 'PD_Biped2D_Gaps_Terrain-v0'
FLAT = 'PD_Biped2D_LLC_Imitate_Flat-v0'
LIMIT = 20  # so that random actions meet both ends: falls and the limit
SMALL = {'height': 48, 'width': 64}


class StableBaselinesTest(parameterized.TestCase):
    """Simulations against single environments, wrappers, and a learner."""

    def test_a_fall_in_the_step_of_the_limit_is_no_truncation(self):
        one, steps = SuiteVecEnv(GAPS, 1, 1, seed=[1]), 1
        one.reset()
        while not one.step(np.zeros((1, 11)))[2][0]:
            steps += 1
        one = SuiteVecEnv(GAPS, 1, 1, seed=[1], step_limit=steps)
        one.reset()
        *_, (_, _, done, [info]) = (one.step(np.zeros((1, 11))) for _ in range(steps))
        self.assertEqual((done[0], info['fell'], info['TimeLimit.truncated']), (True, True, False))

    @parameterized.parameters(True, False)
    def test_simulations_equal_those_of_dummy_vec_env(self, flat):
        theirs = DummyVecEnv([
            lambda: SuiteEnv(GAPS, flat_observation=flat, task_kwargs={'step_limit': LIMIT})
        ] * 3)  # fmt: skip
        ours = SuiteVecEnv(GAPS, 3, 2, flat_observation=flat, step_limit=LIMIT)
        self.assertEqual(ours.observation_space, theirs.observation_space)
        self.assertEqual(ours.action_space, theirs.action_space)
        theirs._seeds = ours.seed(7)
        self.compare(ours.reset(), theirs.reset())
        self.assertEqual(ours.reset_infos, theirs.reset_infos)
        random, falls, limits = np.random.default_rng(0), 0, 0
        for _ in range(60):
            action = random.uniform(-1, 1, (3, *ours.action_space.shape)).astype(np.float32)
            our, their = ours.step(action), theirs.step(action)
            self.compare(our[0], their[0])
            np.testing.assert_array_equal(our[1], their[1])
            self.assertEqual((our[1].dtype, our[2].dtype), (np.float32, bool))
            np.testing.assert_array_equal(our[2], their[2])
            self.assertEqual(ours.reset_infos, theirs.reset_infos)
            for env_id, (one, other) in enumerate(zip(our[3], their[3], strict=True)):
                self.assertEqual('terminal_observation' in one, our[2][env_id])
                if our[2][env_id]:
                    limits += one['TimeLimit.truncated']
                    falls += one['fell']
                    self.compare(one.pop('terminal_observation'), other.pop('terminal_observation'))
                self.assertEqual(one, other)
        self.assertGreaterEqual(falls, 1)
        self.assertGreaterEqual(limits, 1)

    def compare(self, ours, theirs):
        if not isinstance(ours, dict):
            ours, theirs = {'': ours}, {'': theirs}
        self.assertEqual(set(ours), set(theirs))
        for key in ours:
            self.assertEqual(ours[key].dtype, np.float32)
            np.testing.assert_array_equal(ours[key], theirs[key])

    def test_seeds(self):
        envs = SuiteVecEnv(GAPS, 8, 1, seed=[*range(8)])
        self.assertTrue((envs.reset() != envs.reset()).any(1).all())  # the streams continue

        def first(seed):
            self.assertEqual(envs.seed(seed), arguments.all_seeds(seed, 8).tolist())
            return envs.reset()

        np.testing.assert_array_equal(first(3), SuiteVecEnv(GAPS, 8, 1, seed=3).reset())
        # Successive seeds have no episodes in common; SB3 may draw the last one.
        seen = np.concatenate([first(seed) for seed in (3, 4, 2**32 - 1)])
        self.assertLen(np.unique(seen, axis=0), 24)

    def test_options_choose_levels(self):
        envs = SuiteVecEnv(GAPS, 3, 1, seed=0, task_kwargs={'levels': (0, 1000)})
        envs.set_options([{'level': 7}, {'level': None}, {'level': 9}])
        envs.reset()
        self.assertEqual(envs.environment.level[[0, 2]].tolist(), [7, 9])
        envs.reset()
        self.assertNotEqual(envs.environment.level[[0, 2]].tolist(), [7, 9])
        envs.set_options({'levle': 3})
        with self.assertRaisesRegex(ValueError, "unknown option of reset 'levle'; did you mean"):
            envs.reset()
        for given in ({'seed': 1}, {'num_envs': 2}, {'step_limit': 3}):
            with self.assertRaisesRegex(ValueError, 'already made'):
                SuiteVecEnv(envs.environment, **given)

    def test_render(self):
        envs = SuiteVecEnv(FLAT, 3, 1, seed=0, render_mode='rgb_array', render_kwargs=SMALL)
        self.assertEqual(envs.metadata['render_fps'], 30)
        envs.reset()
        picture = envs.render()
        self.assertEqual(picture.shape, (96, 128, 3))  # two by two, the last one empty
        np.testing.assert_array_equal(picture[:48, :64], envs.environment.render(0, **SMALL))
        self.assertEqual(SuiteVecEnv(FLAT, 2, 1).get_images(), [None, None])
        with self.assertRaisesRegex(ValueError, 'rgb_array'):
            SuiteVecEnv(FLAT, 2, 1, render_mode='rgb')
        with self.assertRaisesRegex(ValueError, "'sid'; did you mean 'side'"):
            SuiteVecEnv(FLAT, 2, 1, render_kwargs={'camera': 'sid'})

    def test_attributes(self):
        envs = SuiteVecEnv(FLAT, 3, 1)
        self.assertEqual(envs.get_attr('step_limit', [0, 2]), [256] * 2)
        self.assertEqual(envs.get_attr('seeds', [2]), [envs.environment.seeds[2]])
        self.assertFalse(envs.has_attr('terrain'))
        self.assertTrue(envs.has_attr('reset'))
        with self.assertRaisesRegex(TypeError, "'step_limit' is called; expected 'render'"):
            envs.env_method('step_limit', 3)
        self.assertEqual(envs.env_is_wrapped(gymnasium.Wrapper), [False] * 3)
        for change in (lambda: envs.set_attr('step_limit', 3), lambda: envs.env_method('reset')):
            with self.assertRaisesRegex(RuntimeError, 'environment'):
                change()

    def test_a_vector_environment_is_wrapped(self):
        options = {'num_envs': 2, 'num_threads': 1, 'seed': 3}
        made = VectorEnvironment(GAPS, autoreset='same_step', dtype=np.float32, **options)
        wrapped, own = SuiteVecEnv(made), SuiteVecEnv(GAPS, **options)
        self.assertIs(wrapped.environment, made)
        self.assertEqual(wrapped.num_envs, 2)
        np.testing.assert_array_equal(wrapped.reset(), own.reset())
        with self.assertRaisesRegex(ValueError, "autoreset is 'disabled'; expected 'same_step'"):
            SuiteVecEnv(VectorEnvironment(GAPS, 2, autoreset='disabled'))

    def test_a_wrapper_that_is_forgotten_closes_nothing(self):
        made = VectorEnvironment(GAPS, 1, 1, autoreset='same_step')
        SuiteVecEnv(made).reset()
        gc.collect()
        made.step(np.zeros((1, len(made.action_map))))

    def test_info_of_arrays(self):
        envs = SuiteVecEnv(GAPS, 2, 1, task_kwargs={'sensors': 'mild'})
        envs.reset()
        *_, (first, second) = envs.step(np.zeros((2, *envs.action_space.shape)))
        clean = envs.environment.info['clean_observation']
        np.testing.assert_array_equal(
            [each['clean_observation'] for each in (first, second)], clean
        )
        self.assertFalse(np.shares_memory(first['clean_observation'], clean))

    def test_ppo_in_a_stage(self):
        """It seeds the simulations, with training seeds."""
        stage = Stage(Course('one', (GAPS,)), 0, 100)
        envs = SuiteVecEnv(stage.environments(2, autoreset='same_step', dtype=np.float32))
        PPO('MlpPolicy', envs, n_steps=8, batch_size=16, seed=5, device='cpu').learn(16)
        self.assertEqual(stage.left, 100 - 16)
        self.assertEqual(envs.environment.seeds.tolist(), train_seeds(2, 5))

    def test_ppo_runs(self):
        envs = VecNormalize(VecMonitor(SuiteVecEnv(GAPS, 4, 1, flat_observation=False)))
        model = PPO('MultiInputPolicy', envs, n_steps=32, n_epochs=1, seed=3, device='cpu')
        model.learn(512)
        self.assertNotEmpty(model.ep_info_buffer)
        mean, _ = evaluate_policy(model, envs, n_eval_episodes=2)
        self.assertBetween(mean, 0, 256)
