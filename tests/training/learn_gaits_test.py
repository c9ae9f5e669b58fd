"""Q-learning over base actions: transitions, retries, the exported policy, exact resumption."""

import dataclasses
import pathlib
import tempfile

import learn_gaits
import numpy as np
import torch
from absl.testing import absltest, parameterized

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


class LearnTest(parameterized.TestCase):
    def test_transitions_and_retries(self):
        settings = dataclasses.replace(
            TINY, expert_cycles=1e9, expert_epsilon=1.0, retry=1.0, retries=2
        )
        learner = learn_gaits.Learner(HOPPER, 1, settings, 1)
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
            self.assertLessEqual(len(past), settings.back[1] + 1, env_id)

    @parameterized.parameters('discrete', 'both')
    def test_an_ensemble_learns_and_selects_by_mean_values(self, action):
        settings = dataclasses.replace(
            TINY, action=action, expert_cycles=0, begin=0, members=3, updates=0, renew_every=16,
            epsilon=0.0, noise_share=0.0, retry=0.0,
        )  # fmt: skip
        learner = learn_gaits.Learner(HOPPER, 1, settings, 1)
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
        other = learn_gaits.Learner(HOPPER, 2, settings, 1)
        other.begin_with(policy)
        with torch.no_grad():
            np.testing.assert_allclose(other.network(seen), values[0], rtol=1e-4, atol=1e-5)

    def test_a_restored_simulation_has_its_old_state(self):
        learner = learn_gaits.Learner(HOPPER, 1, dataclasses.replace(TINY, retry=1.0), 1)
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
        learner = learn_gaits.Learner(HOPPER, 1, dataclasses.replace(TINY, action=action), 1)
        for _ in range(6):
            learner.advance()
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
        settings = dataclasses.replace(TINY, action='both', begin=1e9, minibatch=32, updates=1)
        learner = learn_gaits.Learner(HOPPER, 1, settings, 1)
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
        for _ in range(2000):
            learner.learn()
        with torch.no_grad():
            values, changes = learner.network.both(learner.seen(before[None].astype(float)))
        self.assertAlmostEqual(float(values[0, 1]), 2.0, delta=0.5)
        np.testing.assert_allclose(changes[0, 1], 0.3, atol=0.05)
        np.testing.assert_array_equal(changes[0, 0], 0)  # this expert was not selected

    def test_noise_is_added_in_its_share_of_cycles_and_not_where_greedy(self):
        settings = dataclasses.replace(TINY, num_envs=8, action='continuous', noise_share=0.5)
        learner = learn_gaits.Learner(HOPPER, 1, settings, 1)
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
        learner = learn_gaits.Learner(HOPPER, 1, dataclasses.replace(TINY, action=first), 1)
        for _ in range(6):
            learner.advance()
        if first == 'both':
            torch.nn.init.normal_(learner.target.actors.weight)
        with tempfile.TemporaryDirectory() as name:
            path = f'{name}/policy.npz'
            policies.save(learner.exported(), path)
            settings = dataclasses.replace(TINY, start=path, action=second)
            other = learn_gaits.Learner(HOPPER, 2, settings, 1)
            observation = learner.replay.before[: len(learner.replay)].astype(float)
            with torch.no_grad():
                seen = learner.seen(observation)
                for ours, theirs in zip(
                    learner.target.both(seen), other.network.both(seen), strict=True
                ):
                    np.testing.assert_allclose(theirs, ours, atol=1e-5)
            before = other.mean.copy()
            for _ in range(4):
                other.advance()
            np.testing.assert_array_equal(other.mean, before)
        with self.assertRaisesRegex(ValueError, 'other inputs'):
            learn_gaits.Learner(HOPPER, 1, dataclasses.replace(TINY, start=HOPPER), 1)

    def test_a_run_selects_among_further_gaits(self):
        learner = learn_gaits.Learner(HOPPER, 1, TINY, 1)
        for _ in range(6):
            learner.advance()
        gait = learner.environments.task.gait.parameters
        names = ('foot_back', 'steady')
        with tempfile.TemporaryDirectory() as name:
            path = f'{name}/policy.npz'
            policies.save(learner.exported(), path)
            settings = dataclasses.replace(TINY, start=path, gaits=names)
            other = learn_gaits.Learner(HOPPER, 2, settings, 1)
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
        with self.assertRaisesRegex(ValueError, "'tuned'.*did you mean"):
            learn_gaits.Learner(HOPPER, 1, dataclasses.replace(TINY, gaits=('tuned',)), 1)
        with self.assertRaisesRegex(ValueError, "'big_hop'.*within the action range"):
            learn_gaits.Learner(HOPPER, 1, dataclasses.replace(TINY, gaits=('big_hop',)), 1)

    def test_several_environments_share_the_simulations(self):
        settings = dataclasses.replace(TINY, num_envs=5, also=('FSM_Hopper2D_*Walls*', HOPPER))
        learner = learn_gaits.Learner(HOPPER, 1, settings, 1)
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
        settings = dataclasses.replace(TINY, also=(WALLS,), evaluation_episodes=0)
        learner = learn_gaits.Learner(HOPPER, 1, settings, 1)
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

    def test_unknown_and_foreign_environments_are_refused(self):
        with self.assertRaisesRegex(ValueError, 'FSM_Hoper'):
            learn_gaits.environments_of(HOPPER, dataclasses.replace(TINY, also=('FSM_Hoper_*',)))
        with self.assertRaisesRegex(ValueError, 'different characters'):
            learn_gaits.Learner(HOPPER, 1, dataclasses.replace(TINY, also=('FSM_Goat2D_*',)), 1)
        with self.assertRaisesRegex(ValueError, '4 simulations for 10 environments'):
            learn_gaits.Learner(HOPPER, 1, dataclasses.replace(TINY, also=('FSM_Hopper2D_*',)), 1)

    @parameterized.parameters(
        {},
        {'also': (WALLS,), 'renew_every': 16, 'updates': 0, 'evaluation_episodes': 0, 'members': 2},
        {'action': 'both', 'noise_share': 0.9, 'members': 2},
    )
    def test_a_run_writes_its_policy_and_resumes_exactly(self, **changes):
        curves = []
        with tempfile.TemporaryDirectory() as name:
            folders = [pathlib.Path(name) / each for each in 'ab']
            for folder, samples in zip(folders, ((48,), (24, 48)), strict=True):
                for each in samples:
                    settings = dataclasses.replace(TINY, samples=each, **changes)
                    curve = learn_gaits.train(HOPPER, 1, settings, folder, 1)
                curves.append([{**point, 'seconds': None} for point in curve])
            self.assertEqual([point['samples'] for point in curves[0]], [32, 48])
            self.assertEqual(*curves)
            for file in ('policy.npz', 'last.npz'):
                self.assertEqual(*((folder / file).read_bytes() for folder in folders))
            policy = policies.load(folders[0] / 'policy.npz')
            policy.check(VectorEnvironment(HOPPER, 1, 1))
            self.assertEqual(policy.info['samples'], 48)
            self.assertLessEqual(machine.made_with().items(), policy.info.items())
            # Another final phase is repeated, from the same transitions.
            members = settings.members + 1
            more = dataclasses.replace(settings, members=members)
            learn_gaits.train(HOPPER, 1, more, folders[0], 1)
            self.assertLen(policies.load(folders[0] / 'policy.npz').networks, members)
            with self.assertRaisesRegex(ValueError, 'other settings'):
                other = dataclasses.replace(TINY, alive=1.0, **changes)
                learn_gaits.train(HOPPER, 1, other, folders[0], 1)


if __name__ == '__main__':
    absltest.main()
