"""Actions that could prevent falls: states before falls, and what is counted as prevented."""

import dataclasses
from types import SimpleNamespace

import evaluate_footsteps
import foresight
import numpy as np
import oracles
from absl.testing import absltest
from gait_bench import nudged, position

from trl_suite import policies, suite
from trl_suite.vector import VectorEnvironment

RAPTOR = 'PD_Raptor2D_Slopes_Mixed_Terrain-v0'
HOPPER = 'FSM_Hopper2D_Terrain_Gaps-v0'
SIZE = len(suite.build_task(suite.find(HOPPER)).action_map)
FOOTSTEPS = 'PD_Biped3D_LLC_General_Step-v0'


def default(observation):
    """The default gait of the hopper."""
    return np.zeros((len(observation), SIZE))


def falling():
    """The raptor's policy with smaller actions, which soon falls."""
    policy = policies.reference(RAPTOR)
    weights, biases = ((*part[:-1], 0.7 * part[-1]) for part in (policy.weights, policy.biases))
    return dataclasses.replace(policy, weights=weights, biases=biases)


class Steps:
    """Simulations of a point that steps along a line, and falls at some places."""

    def __init__(self, num_envs, falls):
        self.num_envs, self.falls, self.x, self.tried = num_envs, falls, np.zeros(num_envs), []
        self.task = SimpleNamespace(
            world=SimpleNamespace(qpos=self.x[:, None]), body=SimpleNamespace(pose_qpos=[0])
        )

    def set_state(self, state, env_ids):
        self.x[env_ids] = state['x']

    def get_state(self, env_ids):
        return {'x': float(self.x[env_ids[0]])}

    def step(self, action, env_ids):
        self.tried += [(float(self.x[i]), float(action[i, 0])) for i in env_ids]
        self.x[env_ids] += action[env_ids, 0]
        return SimpleNamespace(terminated=np.isin(self.x, self.falls))


class OracleTest(absltest.TestCase):
    def test_states_precede_the_fall(self):
        environments = VectorEnvironment(HOPPER, 2, 1, 0, autoreset='disabled', step_limit=None)
        states, places, pace = oracles.falls(environments, default, oracles.BACK)
        self.assertBetween(pace, 0.5, 2.4)  # hops are 2.4 m long; those into gaps are shorter
        copies = VectorEnvironment(HOPPER, 2, 1, 1, autoreset='disabled', step_limit=None)
        copies.reset()
        for each, place in zip(states, places, strict=True):
            self.assertLen(each, oracles.BACK)
            for back, state in enumerate(each, 1):
                copies.set_state(state, [0])
                for cycle in range(back):
                    self.assertFalse(copies.task.failed[0] and cycle)
                    step = copies.step(default(copies.task.observation), [0])
                self.assertTrue(step.terminated[0], back)
                self.assertEqual(position(copies)[0], place)
                # The same action falls again; at a place far behind nothing is prevented by it.
                for nearer, expected in ((0.0, False), (1e3, True)):
                    found = oracles.prevented(
                        copies, [state] * 2, lambda _, seen: default(seen), oracles.MOST_CYCLES,
                        place + 0.5 - nearer,
                    )  # fmt: skip
                    self.assertEqual(found.tolist(), [expected] * 2 if back > 1 else [False] * 2)

    def test_only_the_joint_angles_of_a_state_are_changed(self):
        environments = VectorEnvironment(HOPPER, 2, 1, 0, autoreset='disabled', step_limit=None)
        environments.reset()
        state, task = environments.get_state([0]), environments.task
        before = [task.world.qpos.copy(), task.world.qvel.copy()]
        changed = nudged(environments, state, np.array([0.1, -0.2]))
        environments.set_state(changed, [0])
        change = task.world.qpos - before[0]
        np.testing.assert_allclose(change, [[0, 0, 0, 0.1, -0.2], [0] * 5], atol=1e-12)
        np.testing.assert_array_equal(task.world.qvel, before[1])
        environments.set_state(state, [0])
        np.testing.assert_array_equal(task.world.qpos, before[0])

    def test_every_kind_of_action_is_counted(self):
        found = oracles.of_gait(HOPPER, default, 2, 3, 0)
        counts = {'base': 18, 'random': 3, 'nudged': 3}  # the hopper has 18 base actions
        for kind, count in counts.items():
            self.assertEqual(found[kind]['actions'], count)
            for name in ('prevented', 'tries_that_prevent'):
                self.assertLen(found[kind][name], oracles.BACK)
            some, mean = (found[kind][name] for name in ('prevented', 'tries_that_prevent'))
            self.assertTrue(np.all(np.array(some) >= mean))

    def test_a_search_with_foresight_ends_in_time(self):
        options = {'autoreset': 'disabled', 'step_limit': None}
        copies, rng = VectorEnvironment(HOPPER, 24, 1, 3, **options), np.random.default_rng(3)
        copies.reset()
        start, base = (
            copies.get_state([0]),
            policies.reference('FSM_Hopper2D_Terrain_Mixed-v0').choices,
        )
        for noisy in (False, True):
            metres, cycles = foresight.search(copies, start, base, noisy, 9.0, 24 * 50, rng)
            self.assertBetween(metres, 9.0, 12.0)  # a hop is at most 2.4 m long
            self.assertBetween(cycles, 4 * len(base), 24 * 49)
        shorter = foresight.search(copies, start, base, True, 1e3, 48, np.random.default_rng(3))
        self.assertBetween(shorter[0], 2.0, 7.2)
        self.assertEqual(shorter[1], 48)

    def test_a_search_finds_the_only_way(self):
        """Steps of 2 or 3 m; all that get beyond 7 m have landed on 4 m. Others are dead ends."""
        world = Steps(8, falls=(3, 5, 6, 8))
        found = foresight.search(world, {'x': 0}, np.array([[2.0], [3.0]]), False, 11, 1000, None)
        self.assertGreaterEqual(found[0], 11)
        self.assertLen(set(world.tried), len(world.tried))  # each state tries each action once
        world = Steps(8, falls=(4, 5, 6, 8))
        found = foresight.search(world, {'x': 0}, np.array([[2.0], [3.0]]), False, 11, 1000, None)
        self.assertEqual(found, (3, 6))  # 0, 2 and 3 have tried both: no state is left

    def test_a_tracking_policy_falls_again_without_noise(self):
        """Noise prevents a fall if the character gets beyond its place, before or after its time."""
        policy = falling()
        environments = VectorEnvironment(RAPTOR, 2, 1, 0, autoreset='disabled', step_limit=None)
        past, places, _ = oracles.falls(environments, policy, 20)
        self.assertNotEmpty(past)
        copies = VectorEnvironment(RAPTOR, 2, 1, 1, autoreset='disabled', step_limit=None)
        copies.reset()
        none = np.zeros((20, 2, len(copies.action_map)))
        for each, place in zip(past, places, strict=True):
            self.assertLen(each, 20)
            for nearer, expected in ((0.0, False), (1e3, True)):
                found = oracles.prevented(
                    copies, [each[-1]] * 2, oracles.with_noise(policy, none), 80, place + 1 - nearer
                )
                self.assertEqual(found.tolist(), [expected] * 2)

    def test_a_footstep_controller_falls_again_after_the_same_push(self):
        row, given = evaluate_footsteps.under(FOOTSTEPS, 'pushes of 250 N')
        policy = policies.reference(FOOTSTEPS)
        options = {'autoreset': 'disabled', 'step_limit': None, 'task_kwargs': given}
        environments = VectorEnvironment(row, 2, 1, 0, **options)
        past, _, _ = oracles.falls(environments, policy, 15)
        copies = VectorEnvironment(row, 2, 1, 1, **options)
        copies.reset()
        none = np.zeros((15, 2, len(copies.action_map)))
        for each in past:
            for steps, expected in ((14, True), (15, False)):  # of the 15 until the fall
                act = oracles.with_noise(policy, none)
                found = oracles.prevented(copies, [each[-1]] * 2, act, steps, None)
                self.assertEqual(found.tolist(), [expected] * 2)

    def test_every_noise_is_counted(self):
        found = oracles.of_tracking(RAPTOR, falling(), 2, 3, 0)
        self.assertEqual(list(found['noise']), [str(std) for std in oracles.STDS])
        for each in found['noise'].values():
            some, mean = np.array(each['prevented']), np.array(each['tries_that_prevent'])
            self.assertLen(some, len(oracles.SECONDS))
            self.assertTrue((some >= mean).all())
            self.assertBetween(each['ever_prevented'], some.max(), 1.0)
