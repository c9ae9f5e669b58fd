"""Gymnasium's interface: its checks, and its own vector environments as reference."""

import os
import pickle
import subprocess
import sys
import warnings
from unittest import mock

import gymnasium
import numpy as np
from absl.testing import parameterized
from gymnasium.utils.env_checker import check_env
from gymnasium.utils.passive_env_checker import env_render_passive_checker
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.vector.utils import batch_space
from helpers import LONG, assert_refused

from trl_suite import rendering, suite
from trl_suite.adapters.gym import flat as flat_info
from trl_suite.engine import world
from trl_suite.gym import SuiteEnv, SuiteVectorEnv

GAPS = 'PD_Biped2D_Gaps_Terrain-v0'
FLAT = 'PD_Biped2D_LLC_Imitate_Flat-v0'
SHORT = {'step_limit': 20}  # so that random actions meet both ends: falls and the limit
SMALL = {'height': 48, 'width': 64}
ONE_OF_EACH = (
    GAPS, 'PD_Biped3D_LLC_General_Step-v0', 'FSM_Hopper2D_Terrain_Gaps-v0', 'PD_Biped3D_HLC_Soccer-v0',
)  # fmt: skip
# Two for each Box: unbounded values are declared without bounds.
UNAVOIDABLE = ('space minimum value is -infinity', 'space maximum value is infinity')


def python(code, **variables):
    """Runs code in a fresh interpreter; returns what it printed."""
    done = subprocess.run(
        [sys.executable, '-c', code], capture_output=True, text=True, timeout=100,
        env={**os.environ, **variables},
    )  # fmt: skip
    if done.returncode:
        raise AssertionError(done.stderr)
    return done.stdout.strip()


class Same:
    """Comparison of nested dicts of arrays, shapes and types included."""

    def assert_same(self, ours, theirs, where=''):
        if isinstance(theirs, dict):
            self.assertEqual(set(ours), set(theirs), where)
            for key in theirs:
                self.assert_same(ours[key], theirs[key], f'{where}/{key}')
        elif isinstance(theirs, np.ndarray) and theirs.dtype == object:
            self.assertEqual(ours.dtype, object, where)
            for i, (our, their) in enumerate(zip(ours, theirs, strict=True)):
                self.assert_same(our, their, f'{where}/{i}')
        elif theirs is None:
            self.assertIsNone(ours, where)
        else:
            self.assertEqual(np.asarray(ours).dtype, np.asarray(theirs).dtype, where)
            np.testing.assert_array_equal(ours, theirs, where)


class InfoTest(parameterized.TestCase):
    def test_entries_are_numbers_by_their_names(self):
        env = SuiteEnv(GAPS, task_kwargs={'randomize': {'friction': (0.5, 1.0)}})
        env.reset(seed=1)
        _, reward, *_, info = env.step(np.zeros(11))
        names = ('pose', 'velocity', 'end_effector', 'com', 'root')
        terms = {name for name in info if name.startswith('reward_')}
        self.assertEqual(terms, {f'reward_{name}' for name in names})
        self.assertAlmostEqual(sum(info[name] for name in terms), reward)
        self.assertBetween(info['world_friction'], 0.5, 1.0)


class SingleTest(Same, parameterized.TestCase):
    """One environment."""

    def rollout(self, env, seed=5, steps=30):
        outputs = [env.reset(seed=seed)]
        random = np.random.default_rng(0)
        for _ in range(steps):
            outputs.append(env.step(random.uniform(-1, 1, env.action_space.shape)))
            if outputs[-1][2] or outputs[-1][3]:
                outputs.append(env.reset())
        return outputs

    @parameterized.parameters(*ONE_OF_EACH)
    def test_check_env(self, id_):
        """Gymnasium's checks pass, and an episode of a seed is that of the suite."""
        spec = suite.find(id_)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter('always')
            env = gymnasium.make(f'trl_suite/{id_}', render_mode='rgb_array', render_kwargs=SMALL)
            full = id_ == GAPS  # the checker would build another to draw it and one to close it
            check_env(env.unwrapped, skip_render_check=not full, skip_close_check=not full)
            env_render_passive_checker(env.unwrapped)
        messages = [str(each.message) for each in caught]
        self.assertEqual([m for m in messages if not any(known in m for known in UNAVOIDABLE)], [])
        self.assertEqual(env.spec.max_episode_steps, spec.step_limit)
        self.assertIsNone(env.unwrapped.environment.step_limit)  # else there were two
        box, blocks = env.action_space, env.unwrapped.environment.blocks
        self.assertEqual(box, gymnasium.spaces.Box(-1, 1, box.shape, np.float32))
        spaces = SuiteEnv(env.unwrapped.environment, flat_observation=False).observation_space
        self.assertEqual(list(spaces.spaces), list(blocks))  # terrain first
        for name, box in spaces.items():
            low, high = (0, 1) if name == 'phase' else (-np.inf, np.inf)
            self.assertTrue((box.low == low).all() and (box.high == high).all())
        env.reset(seed=1)  # earlier episodes have no effect
        observation, info = env.reset(seed=7)
        theirs = suite.make(id_, {'random': 7}, {'flat_observation': True})
        time_step = theirs.reset()
        self.assertEqual(observation.dtype, np.float32)
        env.action_space.seed(0)
        for _ in range(2 if spec.task_type in LONG else 4):
            expected = time_step.observation['observations'].astype(np.float32)
            np.testing.assert_array_equal(observation, expected)
            self.assertEqual(info, flat_info(theirs.info))
            # Cycles of random gaits last until truncation.
            action = (0.3 if spec.task_type == 'gait' else 1.0) * env.action_space.sample()
            observation, reward, terminated, truncated, info = env.step(action)
            time_step = theirs.step(action)
            self.assertEqual(reward, time_step.reward)
            self.assertEqual(terminated or truncated, time_step.last())
        env.close()
        env.close()  # may be called twice

    def test_observations(self):
        """Blocks or flat, in single or double precision."""
        half, full = self.rollout(SuiteEnv(GAPS)), self.rollout(SuiteEnv(GAPS, dtype=np.float64))
        blocks = self.rollout(gymnasium.make(f'trl_suite/{GAPS}', flat_observation=False).unwrapped)
        for single, double, parts in zip(half, full, blocks, strict=True):
            self.assertEqual((single[0].dtype, double[0].dtype), (np.float32, np.float64))
            np.testing.assert_array_equal(double[0].astype(np.float32), single[0])
            np.testing.assert_array_equal(np.concatenate([*parts[0].values()]), single[0])
        self.assertEqual(SuiteEnv(GAPS, dtype=np.float64).action_space.dtype, np.float64)

    def test_a_fall_in_the_step_of_the_limit(self):
        """Gymnasium's wrapper sets both flags; so do all environments."""
        idle = np.zeros(11, np.float32)
        environment = suite.make(GAPS, {'random': 1})
        environment.reset()
        steps = 1
        while not environment.step(idle).last():
            steps += 1
        self.assertLess(steps, 256)
        limited = {'task_kwargs': {'step_limit': steps}}
        id_ = f'trl_suite/{GAPS}'
        for env, seed in (
            (gymnasium.make(id_, max_episode_steps=steps), 1), (gymnasium.make(id_, **limited), 1),
            (SuiteEnv(GAPS, max_episode_steps=steps), 1),
            (gymnasium.make_vec(id_, 1, max_episode_steps=steps, autoreset_mode='SameStep'), [1]),
        ):  # fmt: skip
            env.reset(seed=seed)
            actions = idle if seed == 1 else idle[None]
            flags = [env.step(actions)[2:4] for _ in range(steps)]
            self.assertEqual([*map(bool, flags[-1])], [True, True], env)
            self.assertFalse(np.any(flags[:-1]))

    def test_pickle_in_the_middle_of_an_episode(self):
        env = gymnasium.make(f'trl_suite/{GAPS}').unwrapped
        env.reset(seed=2)
        idle = np.zeros(env.action_space.shape)
        env.step(idle)
        twin = pickle.loads(pickle.dumps(env))
        for _ in range(5):
            self.assertEqual(repr(env.step(idle)), repr(twin.step(idle)))
        np.testing.assert_array_equal(env.reset()[0], twin.reset()[0])

    def test_a_restored_episode_goes_on(self):
        env, idle = SuiteEnv(FLAT, task_kwargs={'step_limit': 2}), np.zeros(6)
        env.reset(seed=2)
        state = env.environment.get_state()
        first = [env.step(idle)[1] for _ in range(2)]
        with self.assertRaises(gymnasium.error.ResetNeeded):
            env.step(idle)
        env.environment.set_state(state)
        self.assertEqual([env.step(idle)[1] for _ in range(2)], first)

    def test_render(self):
        env = gymnasium.make(
            f'trl_suite/{GAPS}', render_mode='rgb_array', render_kwargs={**SMALL, 'ghost': True}
        )
        env.reset(seed=3)
        theirs = suite.make(GAPS, {'random': 3})
        theirs.reset()
        expected = rendering.frame(theirs, ghost=True, **SMALL)
        np.testing.assert_array_equal(env.render(), expected)
        self.assertGreater(np.std(expected), 5)
        self.assertEqual(env.metadata['render_fps'], 30)
        for id_, fps in (
            ('PD_Biped3D_HLC_Soccer-v0', 2), ('PD_Biped3D_HLC_PathFollowing_Run-v0', 3),
        ):  # fmt: skip
            self.assertEqual(SuiteEnv(id_).metadata['render_fps'], fps)
        silent = SuiteEnv(GAPS)
        silent.reset()
        self.assertIsNone(silent.render())

    def test_invalid_options_are_rejected(self):
        whole = 'max_episode_steps is {!r}; expected None or a whole number at least 1'
        bad = (
            ({'render_mode': 'rgb_aray'}, 'rgb_array'), ({'render_mode': 'human'}, 'render_mode'),
            ({'render_kwargs': {'heigth': 48}}, "'heigth'; did you mean 'height'"),
            ({'render_kwargs': {'height': 1081}}, 'height is 1081'),
            ({'render_kwargs': {'camera': 'sid'}}, "camera 'sid'; did you mean 'side'"),
            ({'dtype': np.int32}, 'int32'), ({'task_kwargs': {'step_limt': 3}}, 'step_limt'),
            *(({'max_episode_steps': n}, whole.format(n)) for n in (0, 2.5, -3, np.inf, 'abc', True)),
        )  # fmt: skip
        assert_refused(
            self,
            *((lambda o=o: SuiteEnv(GAPS, **o), message) for o, message in bad),
            *((lambda o=o: SuiteVectorEnv(GAPS, 2, **o), message) for o, message in bad),
            (lambda: SuiteEnv(suite.make(FLAT), max_episode_steps=5), 'already made'),
            (lambda: SuiteEnv(suite.make(GAPS), task_kwargs=SHORT), 'already made'),
            (lambda: SuiteVectorEnv(FLAT, 2, autoreset_mode='NexStep'), 'NextStep'),
            (lambda: SuiteVectorEnv(FLAT, 2, task_kwargs={'step_limit': 0}), 'step_limit'),
        )

    def test_misuse_raises_errors(self):
        env = SuiteEnv(FLAT)
        idle = np.zeros(6)
        with self.assertRaises(gymnasium.error.ResetNeeded):
            env.step(idle)
        with self.assertRaisesRegex(ValueError, 'seed'):
            env.reset(seed=-1)
        env.reset(seed=np.int64(3))
        with self.assertRaisesRegex(ValueError, r'shape \(5,\); expected \(6,\)'):
            env.step(np.zeros(5))
        env.step(idle)  # unharmed
        short = SuiteEnv(FLAT, task_kwargs={'step_limit': 1})
        short.reset()
        short.step(idle)
        with self.assertRaises(gymnasium.error.ResetNeeded):
            short.step(idle)


class VectorTest(Same, parameterized.TestCase):
    """Simulations against Gymnasium's vector environment of single environments."""

    def setUp(self):
        super().setUp()
        self.enterContext(mock.patch.object(world, 'LEAST', 1))  # each simulation on a thread

    def pair(self, mode, n=3, seed_list=(5, 9, 11), **options):
        single = {'task_kwargs': SHORT, **options}
        theirs = SyncVectorEnv(
            [lambda: SuiteEnv(GAPS, **single) for _ in range(n)], autoreset_mode=mode
        )
        ours = SuiteVectorEnv(GAPS, n, num_threads=2, autoreset_mode=mode, **single)
        self.assertIs(ours.metadata['autoreset_mode'], theirs.metadata['autoreset_mode'])
        seeds = list(seed_list)
        self.assert_same(ours.reset(seed=seeds), theirs.reset(seed=seeds))
        ours.action_space.seed(1)
        return ours, theirs

    def assert_same(self, ours, theirs, where=''):
        if isinstance(theirs, tuple):
            for i, (our, their) in enumerate(zip(ours, theirs, strict=True)):
                # Rewards: rounded to the environment's dtype, where Gymnasium's are float64.
                rounded = their.astype(our.dtype) if (len(ours), i) == (5, 1) else their
                super().assert_same(our, rounded, f'{where}[{i}]')
        else:
            super().assert_same(ours, theirs, where)

    @parameterized.parameters(
        (AutoresetMode.NEXT_STEP, True, np.float32), (AutoresetMode.SAME_STEP, False, np.float64)
    )
    def test_autoreset(self, mode, flat, dtype):
        ours, theirs = self.pair(mode, flat_observation=flat, dtype=dtype)
        falls = limits = 0
        for step in range(60):
            action = ours.action_space.sample()
            our, their = ours.step(action), theirs.step(action)
            self.assert_same(our, their, f'step {step}')
            self.assertIn(our[0], ours.observation_space)
            falls, limits = falls + our[2].sum(), limits + our[3].sum()
        self.assertGreaterEqual(falls, 1)
        self.assertGreaterEqual(limits, 1)

    def test_disabled(self):
        ours, theirs = self.pair(AutoresetMode.DISABLED)
        for step in range(30):
            action = ours.action_space.sample()
            our, their = ours.step(action), theirs.step(action)
            self.assert_same(our, their, f'step {step}')
            ended = our[2] | our[3]
            if ended.any():
                # Gymnasium's takes the mask out of the dict.
                options = [{'reset_mask': ended.copy()} for _ in range(2)]
                # Of the simulations that are reset.
                seed = [100 + step, None, 2**32 + step] if step % 2 else None
                self.assert_same(
                    ours.reset(seed=seed, options=options[0]),
                    theirs.reset(seed=seed, options=options[1]),
                    f'reset {step}',
                )
                self.assertIn('reset_mask', options[0])
        idle = np.zeros(ours.action_space.shape)
        with self.assertRaisesRegex(RuntimeError, 'has ended'):
            for _ in range(21):
                ours.step(idle)

    def test_one_seed_gives_every_simulation_its_own(self):
        ours = SuiteVectorEnv(GAPS, 3)
        first, _ = ours.reset(seed=5)
        children = np.random.SeedSequence(5).generate_state(3)
        np.testing.assert_array_equal(first, ours.reset(seed=children.tolist())[0])
        np.testing.assert_array_equal(first, ours.reset(seed=5)[0])
        self.assertTrue((first != ours.reset()[0]).any())
        self.assertTrue((ours.reset(seed=6)[0] != first).any(1).all())

    def test_make_vec(self):
        for mode in ('NextStep', 'SameStep', 'Disabled', None):
            options = {} if mode is None else {'autoreset_mode': mode}
            envs = gymnasium.make_vec(f'trl_suite/{FLAT}', num_envs=4, num_threads=1, **options)
            self.assertIsInstance(envs, SuiteVectorEnv)
            self.assertIs(envs.metadata['autoreset_mode'], AutoresetMode(mode or 'NextStep'))
            self.assertIs(envs.autoreset_mode, envs.metadata['autoreset_mode'])  # TorchRL reads it
            batch = batch_space(envs.single_observation_space, 4)
            self.assertEqual(envs.observation_space, batch)
            self.assertEqual(gymnasium.make_vec(envs.spec).num_envs, 4)

    @parameterized.parameters(
        ({}, 3, 3), ({'step_limit': 2}, 3, 2), ({}, 9, 8), ({}, -1, 8), ({}, None, 8),
        ({'time_limit': 0.15}, 8, 5),
    )  # fmt: skip
    def test_max_episode_steps(self, options, steps, expected):
        """Whichever limit comes first, as in a single environment and its wrapper."""
        options = {'task_kwargs': {'step_limit': 8, **options}}
        given = options if steps is None else {**options, 'max_episode_steps': steps}
        ours = gymnasium.make_vec(f'trl_suite/{GAPS}', 2, num_threads=1, **given)
        own, over = SuiteEnv(GAPS, **given), np.zeros(2, bool)
        ours.reset(seed=[5, 9]), own.reset(seed=5)
        clip, count = own.environment.task.clip_action, 0
        while not over[0]:
            action = np.tile(np.clip(clip(0), -1, 1), (2, 1))
            _, _, fell, over, _ = ours.step(action)
            count += 1
            self.assertEqual(own.step(action[0])[2:4], (fell[0], over[0]))
        self.assertEqual((count, over.tolist()), (expected, [True, True]))

    def test_one_limit(self):
        """That of `gymnasium.make` replaces that of the row, as of Gymnasium's own environments."""
        id_ = f'trl_suite/{FLAT}'
        longer = gymnasium.make(id_, max_episode_steps=999)
        self.assertEqual(longer.spec.max_episode_steps, 999)
        self.assertIsNone(longer.unwrapped.environment.step_limit)
        for steps, expected in ((None, 256), (999, 999), (-1, None)):
            options = {} if steps is None else {'max_episode_steps': steps}
            envs = gymnasium.make_vec(id_, 2, num_threads=1, **options)
            self.assertEqual(envs.environment.step_limit, expected)

    def test_levels(self):
        options = {'task_kwargs': {'levels': (0, 9)}}
        env = gymnasium.make(f'trl_suite/{GAPS}', **options)
        self.assertEqual(env.reset(seed=1, options={'level': 4})[1]['level'], 4)
        envs = gymnasium.make_vec(f'trl_suite/{GAPS}', 2, **options)
        self.assertEqual(envs.reset(options={'level': [4, 6]})[1]['level'].tolist(), [4, 6])

    def test_async(self):
        """Single environments live in processes as well."""
        seeds = [5, 9]
        theirs = gymnasium.make_vec(f'trl_suite/{FLAT}', 2, 'async')
        self.addCleanup(theirs.close)
        ours = gymnasium.make_vec(f'trl_suite/{FLAT}', 2, num_threads=1)
        ours.action_space.seed(0)
        self.assert_same(ours.reset(seed=seeds), theirs.reset(seed=seeds))
        action = ours.action_space.sample()
        self.assert_same(ours.step(action)[0], theirs.step(action)[0])

    def test_render(self):
        ours = SuiteVectorEnv(GAPS, 3, render_mode='rgb_array', render_kwargs=SMALL)
        single = SuiteEnv(GAPS, render_mode='rgb_array', render_kwargs=SMALL)
        ours.reset(seed=[1, 2, 3])
        single.reset(seed=2)
        idle = np.zeros(ours.action_space.shape)
        ours.step(idle)
        single.step(idle[0])
        frames = ours.render()
        self.assertIsInstance(frames, tuple)
        self.assertLen(frames, 3)
        np.testing.assert_array_equal(frames[1], single.render())
        self.assertTrue((frames[0] != frames[1]).any())
        self.assertIsNone(SuiteVectorEnv(GAPS, 1).render())

    def test_attributes_of_each_simulation(self):
        options = {'render_mode': 'rgb_array', 'render_kwargs': SMALL}
        ours = SuiteVectorEnv(FLAT, 2, num_threads=1, **options)
        theirs = SyncVectorEnv([lambda: SuiteEnv(FLAT, **options) for _ in range(2)])
        for each in ours, theirs:
            each.reset(seed=[4, 7])
        for name in 'render_mode', 'observation_space', 'action_space':
            for read in 'call', 'get_attr':
                self.assertEqual(getattr(ours, read)(name), getattr(theirs, read)(name), name)
        self.assertEqual(ours.get_attr('step_limit'), (256, 256))
        self.assertEqual(ours.get_attr('seeds'), (4, 7))  # each has its own
        with self.assertRaisesRegex(AttributeError, "no attribute 'step_limt'"):
            ours.get_attr('step_limt')
        with self.assertRaisesRegex(RuntimeError, 'share one object: call get_state of its'):
            ours.call('get_state')
        with self.assertRaisesRegex(RuntimeError, 'share one object: set step_limit on its'):
            ours.set_attr('step_limit', [3, 4])
        self.assertEqual(SuiteVectorEnv(FLAT, 2, num_threads=1).call('render'), (None, None))

    def test_misuse_raises_errors(self):
        envs = SuiteVectorEnv(FLAT, 2, num_threads=1)
        with self.assertRaisesRegex(RuntimeError, 'before the first reset'):
            envs.step(np.zeros((2, 6)))
        masks = ([True], np.array([1, 0]), np.zeros(2, bool), 'no')
        assert_refused(
            self,
            *((lambda s=s: envs.reset(seed=s), 'seed') for s in ([1], [None], [None, -1], [-1, 2], [0.5, 1.5], -1)),
            *((lambda m=m: envs.reset(options={'reset_mask': m}), 'reset_mask') for m in masks),
            (lambda: envs.reset(options={'levl': 3}), "unknown option of reset 'levl'; did you mean 'level'"),
            (lambda: SuiteEnv(FLAT).reset(options={'reset_mask': 1}), "unknown option of reset 'reset_mask'"),
        )  # fmt: skip
        envs.reset(seed=1)
        with self.assertRaisesRegex(ValueError, r'shape \(2, 5\); expected \(2, 6\)'):
            envs.step(np.zeros((2, 5)))
        envs.step(np.zeros((2, 6)))  # unharmed


class ImportTest(parameterized.TestCase):
    """What is registered, and by what."""

    def test_every_id_is_registered(self):
        ours = {id_ for id_ in gymnasium.registry if id_.startswith('trl_suite/')}
        self.assertEqual(ours, {f'trl_suite/{id_}' for id_ in suite.ALL_IDS})

    def test_id_that_names_the_module(self):
        id_ = f'trl_suite.gym:trl_suite/{FLAT}'
        out = python(
            f'import gymnasium; env = gymnasium.make({id_!r}); envs = gymnasium.make_vec({id_!r}, 2);'
            'print(env.reset(seed=1)[0].shape, envs.reset(seed=1)[0].shape)'
        )
        self.assertEqual(out, '(58,) (2, 58)')

    def test_the_suite_does_not_need_gymnasium(self):
        code = (
            'import sys; sys.modules["gymnasium"] = None\n'
            'from trl_suite import suite, vector, cli, rendering\n'
            f'suite.make({FLAT!r}).reset()\n'
            'try:\n    import trl_suite.gym\n'
            'except ImportError as error:\n    print(error)'
        )
        message = python(code)
        self.assertIn("pip install 'trl_suite[gymnasium]'", message)
        self.assertLen(message.splitlines(), 1)
