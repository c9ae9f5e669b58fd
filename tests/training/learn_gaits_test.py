"""Q-learning over base actions: transitions, retries, the exported policy, exact resumption."""

import dataclasses

import learn_gaits
import numpy as np
import torch
from absl.testing import parameterized
from helpers import FolderTest

from trl_suite import policies
from trl_suite.util import machine
from trl_suite.vector import VectorEnvironment

HOPPER = 'FSM_Hopper2D_Terrain_Gaps-v0'
WALLS = 'FSM_Hopper2D_Terrain_Walls-v0'
TINY = learn_gaits.Settings(
    samples=48, num_envs=4, expert_cycles=24, begin=16, greedy=0.25, capacity=100, minibatch=8, updates=1,
    final_updates=2, convolutions=((4, 8, 2),), ground_units=8, hidden=(8, 6), write_every=16,
    evaluate_every=32, evaluation_episodes=2,
)  # fmt: skip


def make(advances=0, seed=1, **changes):
    learner = learn_gaits.Learner(HOPPER, seed, dataclasses.replace(TINY, **changes), 1)
    for _ in range(advances):
        learner.advance()
    return learner


def trained_in_parts(test, train, settings, parts, files):
    """Checks that a run in parts is that in one go; returns its folder, its curve, and a policy."""
    curves, folders = [], [test.folder / each for each in 'ab']
    for folder, ends in zip(folders, (parts[-1:], parts), strict=True):
        for samples in ends:
            own = dataclasses.replace(settings, samples=samples)
            curve = train(HOPPER, 1, own, folder, 1)
        curves.append([{**point, 'seconds': None} for point in curve])
    test.assertEqual(*curves)
    for file in files:
        test.assertEqual(*((folder / file).read_bytes() for folder in folders))
    policy = policies.load(folders[0] / 'policy.npz')
    policy.check(VectorEnvironment(HOPPER, 1, 1))
    return folders[0], curves[0], policy


class LearnTest(FolderTest):
    def test_transitions_and_retries(self):
        learner = make(expert_cycles=1e9, expert_epsilon=1.0, retry=1.0, retries=2)
        learner.expert = None  # random base actions fall soon
        tried = []
        for _ in range(24):
            learner.collect()
            tried.append(learner.tried[0].copy())
        tried = np.array(tried)
        self.assertEqual(tried.max(), 2)
        np.testing.assert_array_equal(tried[:, 0], 0)  # this row is greedy
        replay, waiting = learner.replay, sum(map(len, learner.chains))
        self.assertEqual(len(replay) + waiting, 24 * 4)  # every cycle begins one
        discount, reward = replay.discount[: len(replay)], replay.reward[: len(replay)]
        self.assertSetEqual(set(discount.tolist()), {0.0, float(np.float32(0.95**3))})
        # A fall has no reward; up to then there is more than that for being up.
        self.assertTrue((reward[discount > 0] >= 0.5 * (1 + 0.95 + 0.95**2) - 1e-6).all())
        self.assertIn(0.0, reward[discount == 0])
        for env_id, past in enumerate(learner.past):
            self.assertLessEqual(len(past), learner.settings.back[1] + 1, env_id)

    @parameterized.parameters('discrete', 'both')
    def test_an_ensemble_learns_and_selects_by_mean_values(self, action):
        settings = {
            'action': action, 'expert_cycles': 0, 'begin': 0, 'members': 3, 'updates': 0,
            'renew_every': 16, 'epsilon': 0.0, 'noise_share': 0.0, 'retry': 0.0,
        }  # fmt: skip
        learner = make(**settings)
        while learner.samples < 16:
            learner.advance()
        self.assertLen(learner.members, 3)
        observation = learner.observation
        with torch.no_grad():
            seen = learner.seen(observation[:, learner.columns])
            values = torch.stack([each(seen) for each in learner.members])
        self.assertGreater(float((values[0] - values[1]).abs().max()), 0)
        chosen = learner.act().number
        np.testing.assert_array_equal(chosen, values.mean(0).argmax(1))
        policy = learner.exported()
        self.assertLen(policy.networks, 3)
        if action == 'discrete':
            expected = learner.choices[chosen]
            np.testing.assert_allclose(policy(observation), expected, atol=learn_gaits.CHOICE_ERROR)
        other = make(seed=2, **settings)
        other.begin_with(policy)
        with torch.no_grad():
            np.testing.assert_allclose(other.network(seen), values[0], rtol=1e-4, atol=1e-5)

    def test_a_restored_simulation_has_its_old_state(self):
        learner = make(retry=1.0)
        seen = []
        for _ in range(3):
            seen.append(learner.observation.copy())
            learner.collect()
        self.assertLen(learner.past[3], 3)
        learner.random = np.random.default_rng(0)
        while not learner.go_back(3):
            pass
        left = len(learner.past[3])
        self.assertLess(left, 2)  # it was the last cycle but one, or but two
        now = learner.environments.task.observation
        np.testing.assert_array_equal(now[3], seen[left][3])
        np.testing.assert_array_equal(now[:3], learner.observation[:3])

    def test_the_oldest_transitions_are_replaced(self):
        replay = learn_gaits.Replay(3, 2)
        for i in range(5):
            action = learn_gaits.Action(i, 0.0, False)
            replay.add(np.full(2, i), action, i, 0.5, np.full(2, i + 1))
        self.assertLen(replay, 3)
        np.testing.assert_array_equal(replay.action, [3, 4, 2])
        other = learn_gaits.Replay(3, 2)
        other.set_state(replay.get_state())
        self.assertEqual(other.count, 5)
        for name in ('before', 'after', 'action', 'reward', 'discount'):
            np.testing.assert_array_equal(getattr(other, name), getattr(replay, name))

    @parameterized.parameters(*learn_gaits.ACTIONS)
    def test_the_policy_selects_as_the_network(self, action):
        learner = make(6, action=action)
        if learner.settings.actors:
            torch.nn.init.normal_(learner.target.actors.weight)
        policy = learner.exported()
        policy.check(learner.environments)
        observation = learner.replay.before[: len(learner.replay)].astype(float)
        with torch.no_grad():
            values, changes = learner.target.both(learner.seen(observation))
        values, changes = values.numpy(), changes.numpy()
        whole = np.zeros((len(observation), policy.observation_size))
        whole[:, learner.columns] = observation
        # Where two are as good, rounding decides.
        clear = np.ones(len(values), bool)
        if action != 'continuous':
            clear = np.diff(np.sort(values, axis=1)[:, -2:])[:, 0] > 1e-4
        self.assertGreater(clear.sum(), 5)
        chosen = values.argmax(1)
        expected = learner.choices[chosen] + changes[np.arange(len(chosen)), chosen]
        np.testing.assert_allclose(policy(whole)[clear], np.clip(expected, -1, 1)[clear], atol=1e-5)
        self.assertEqual(np.abs(changes).max() > 0.1, action != 'discrete')

    def test_actors_learn_from_noise_that_pays_and_values_from_the_rest(self):
        learner = make(action='both', begin=1e9, minibatch=32, updates=1, learning_rate=3e-3)
        for _ in range(4):
            learner.collect()
        replay, size = learn_gaits.Replay(64, len(learner.columns), 3), learner.choices.shape[1]
        replay.change = np.zeros((64, size), np.float16)
        before = learner.replay.before[0]
        pays, costs = np.full(size, 0.3), np.full(size, -0.3)
        for i in range(64):  # a fall ends each transition, so that the reward is the aim
            kind = i % 3
            change, reward = ((pays, 50.0), (costs, -50.0), (np.zeros(size), 2.0))[kind]
            action = learn_gaits.Action(1, change, kind < 2)
            replay.add(before, action, reward, 0.0, before)
        learner.replay = replay
        for _ in range(700):
            learner.learn()
        with torch.no_grad():
            values, changes = learner.network.both(learner.seen(before[None].astype(float)))
        self.assertAlmostEqual(float(values[0, 1]), 2.0, delta=0.5)
        np.testing.assert_allclose(changes[0, 1], 0.3, atol=0.05)
        np.testing.assert_array_equal(changes[0, 0], 0)  # this expert was not selected

    def test_noise_is_added_in_its_share_of_cycles_and_not_where_greedy(self):
        learner = make(num_envs=8, action='continuous', noise_share=0.5)
        acts = [learner.act() for _ in range(200)]
        noisy = np.array([act.noisy for act in acts])
        self.assertFalse(noisy[:, learner.greedy].any())
        self.assertBetween(noisy[:, ~learner.greedy].mean(), 0.45, 0.55)
        for act in acts:
            np.testing.assert_array_equal(act.number, 0)  # the default gait
            np.testing.assert_array_equal(act.change.any(1), act.noisy)
            self.assertLessEqual(np.abs(learner.choices[0] + act.change).max(), 1 + 1e-9)

    @parameterized.parameters(('discrete', 'discrete'), ('discrete', 'both'), ('both', 'both'))
    def test_a_run_begins_with_a_policy(self, first, second):
        learner = make(6, action=first)
        if first == 'both':
            torch.nn.init.normal_(learner.target.actors.weight)
        path = f'{self.folder}/policy.npz'
        policies.save(learner.exported(), path)
        other = make(seed=2, start=path, action=second)
        with torch.no_grad():
            seen = learner.seen(learner.replay.before[: len(learner.replay)].astype(float))
            both = learner.target.both(seen), other.network.both(seen)
        for ours, theirs in zip(*both, strict=True):
            np.testing.assert_allclose(theirs, ours, atol=1e-5)
        before = other.mean.copy()
        for _ in range(4):
            other.advance()
        np.testing.assert_array_equal(other.mean, before)

    def test_a_run_selects_among_further_gaits(self):
        learner = make(6)
        gait = learner.environments.task.gait.parameters
        names = ('foot_back', 'steady')
        path = f'{self.folder}/policy.npz'
        policies.save(learner.exported(), path)
        other = make(seed=2, start=path, gaits=names)
        count = len(gait.base_actions)
        found = gait.vector(other.choices[count:])
        np.testing.assert_allclose(found, [gait.sets[name] for name in names], atol=1e-9)
        seen = learner.seen(learner.replay.before[: len(learner.replay)].astype(float))
        with torch.no_grad():
            values, before = other.network(seen), learner.target(seen)
        np.testing.assert_allclose(values[:, :count], before, atol=1e-5)
        expected = before.mean(1, keepdim=True).expand(-1, len(names))
        np.testing.assert_allclose(values[:, count:], expected, atol=1e-5)
        self.assertLen(other.exported().choices, count + len(names))

    def test_several_environments_share_the_simulations(self):
        learner = make(num_envs=5, also=('FSM_Hopper2D_*Walls*', HOPPER))
        self.assertEqual(learner.ids, [HOPPER, WALLS, HOPPER])
        self.assertEqual([group.num_envs for group in learner.simulations.parts], [2, 2, 1])
        np.testing.assert_array_equal(learner.simulations.group, [0, 0, 1, 1, 2])
        np.testing.assert_array_equal(learner.greedy, [True, False, True, False, True])
        seeds = [seed for group in learner.simulations.parts for seed in group.seeds.tolist()]
        self.assertLen(set(seeds), 5)
        # Simulation 3 is the second of the walls.
        lone = VectorEnvironment(WALLS, 1, 1, seeds[3:4], autoreset='disabled')
        np.testing.assert_array_equal(learner.observation[3], lone.reset()[0])
        for _ in range(20):
            before = learner.observation.copy()
            learner.collect()
            self.assertFalse((learner.observation == before).all(1).any())
        self.assertEqual(len(learner.replay) + sum(map(len, learner.chains)), 20 * 5)
        state = learner.simulations.get_state(3)
        other = learner.observation.copy()
        learner.collect()
        learner.simulations.set_state(state, 3)
        np.testing.assert_array_equal(learner.simulations.observation[3], other[3])
        self.assertFalse((learner.simulations.observation[:3] == other[:3]).all())

    def test_metres_and_falls_are_counted_without_random_actions(self):
        learner = make(also=(WALLS,), evaluation_episodes=0)
        steps, step = [], learner.simulations.step
        learner.simulations.step = lambda action: steps.append(step(action)) or steps[-1]
        for _ in range(30):
            learner.collect()
        fell = np.array([each.terminated for each in steps])
        distance = np.array([each.info['distance'] for each in steps])
        for number, env_id in enumerate((0, 2)):  # these are greedy; the others are set back
            ends = distance[:, env_id][fell[:, env_id]]
            rest = 0.0 if fell[-1, env_id] else distance[-1, env_id]
            self.assertNotEmpty(ends)
            expected = ends.sum() + rest, len(ends)
            np.testing.assert_allclose(learner.tally[number], expected)
        falls = learner.tally[:, 1].tolist()
        point = learner.evaluate()
        self.assertEqual(point['falls'], falls)
        self.assertAlmostEqual(point['distance'], point['metres'][0] / falls[0], delta=0.1)
        np.testing.assert_array_equal(learner.tally, 0)
        self.assertNotIn('distance', learner.evaluate())  # nothing has moved since

    @parameterized.parameters(
        ({'also': ('FSM_Hoper_*',)}, 'FSM_Hoper'),
        ({'also': ('FSM_Goat2D_*',)}, 'different characters'),
        ({'also': ('FSM_Hopper2D_*',)}, '4 simulations for 10 environments'),
        ({'gaits': ('tuned',)}, "'tuned'.*did you mean"),
        ({'gaits': ('big_hop',)}, "'big_hop'.*within the action range"),
        ({'start': WALLS}, 'has 211 inputs, that of .* 144 inputs; .* setting view'),
        (
            {'start': HOPPER},
            'has no convolution, that of .* a convolution',
        ),  # it sets all parameters
    )
    def test_bad_settings_are_refused(self, changes, message):
        with self.assertRaisesRegex(ValueError, message):
            make(**changes)

    @parameterized.parameters(
        {},
        {'also': (WALLS,), 'renew_every': 16, 'updates': 0, 'evaluation_episodes': 0, 'members': 2},
        {'action': 'both', 'noise_share': 0.9, 'members': 2},
    )
    def test_a_run_writes_its_policy_and_resumes_exactly(self, **changes):
        settings = dataclasses.replace(TINY, **changes)
        folder, curve, policy = trained_in_parts(
            self, learn_gaits.train, settings, (24, 48), ('policy.npz', 'last.npz')
        )
        self.assertEqual([point['samples'] for point in curve], [32, 48])
        self.assertLessEqual(machine.made_with().items(), policy.info.items())
        self.assertEqual(policy.info['samples'], 48)
        # Another final phase is repeated, from the same transitions.
        more = dataclasses.replace(settings, members=settings.members + 1)
        learn_gaits.train(HOPPER, 1, more, folder, 1)
        self.assertLen(policies.load(folder / 'policy.npz').networks, more.members)
        with self.assertRaisesRegex(
            ValueError, 'other settings: alive is .*, not 1.0; give another --output'
        ):
            other = dataclasses.replace(settings, alive=1.0)
            learn_gaits.train(HOPPER, 1, other, folder, 1)
