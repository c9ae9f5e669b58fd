"""Reflection of left and right: observations, physics, and policies with a mirror."""

import dataclasses
import pathlib

import numpy as np
from absl.testing import parameterized
from helpers import FolderTest, assert_refused, made, put

from trl_suite import policies, suite
from trl_suite.bodies.reference import joint_targets
from trl_suite.policies.mirror import Mirror
from trl_suite.tasks.navigation import scripted
from trl_suite.vector import VectorEnvironment

SOCCER = 'PD_Biped3D_HLC_Soccer-v0'
# Character, actuation, terrain, rules, options. Stairs and ramp are the same on either side of the
# line of the start.
WALK = ('biped3d', 'position', 'plane', 'imitation', {})
STEP = ('biped3d_mocap', 'position', 'plane', 'footsteps', {})
CASES = (
    WALK, STEP,
    ('biped3d_mocap_run', 'position', 'plane', 'imitation', {}),
    ('biped3d_mocap_run', 'position', 'plane', 'footsteps', {}),
    ('biped3d_full_mocap', 'position', 'plane', 'footsteps', {}),
    ('biped3d_full_mocap', 'position', 'plane', 'imitation', {'action_offset': 'original'}),
    ('biped3d', 'position', 'plane', 'imitation', {'action_offset': 'original', 'terrain_observation': 'height'}),
    ('biped3d', 'position', 'plane', 'imitation', {'action_offset': 'posture'}),
    ('biped3d', 'torque', 'plane', 'imitation', {}),
    ('biped3d_mocap', 'torque', 'plane', 'footsteps', {'terrain_observation': 'height'}),
    ('biped3d', 'velocity', 'plane', 'imitation', {}),
    ('biped3d_mocap', 'velocity', 'plane', 'footsteps', {}),
    ('biped3d', 'position', 'stairs3d', 'imitation', {'terrain_observation': 'height'}),
    ('biped3d_mocap', 'position', 'ramp3d', 'footsteps', {'terrain_observation': 'height'}),
)  # fmt: skip


def build(case, **options):
    character, actuation, terrain, rules, own = case
    environment = made(
        character, actuation, terrain, rules, seed=3, flat=True, step_limit=None, **own, **options
    )
    return environment, environment.reset().observation['observations']


def observed(environment):
    environment.task.observe()
    return environment.observation()['observations']


def state(environment):
    task, data = environment.task, environment.physics.data
    return data.qpos[task.body.pose_qpos].copy(), data.qvel[task.body.pose_dof].copy()


def disturbed(environment, rng, angle=0.4):
    """A pose and velocity anywhere about the present ones."""
    pose, rate = state(environment)
    pose[:3] += (1.0, 0.7, 0.1) * rng.uniform(-1, 1, 3)
    layout = environment.task.motion.layout
    for start, _ in layout.rotations:
        quaternion = pose[start : start + 4] + angle * rng.uniform(-1, 1, 4)
        pose[start : start + 4] = quaternion / np.linalg.norm(quaternion)
    return pose, rate + rng.uniform(-2, 2, len(rate))


class TaskTest(parameterized.TestCase):
    """The mirror of a task against the reflection of its state."""

    @parameterized.parameters(*CASES)
    def test_half_a_cycle_later_all_is_reflected(self, *case):
        # Clips are symmetric, and so is ground of which the middle line is a line of symmetry.
        environment, first = build(case, start_phase=0.4)
        _, second = build(case, start_phase=0.9)
        mirror = environment.task.mirror
        np.testing.assert_allclose(mirror.observation(second[None])[0], first, rtol=0, atol=1e-9)
        np.testing.assert_allclose(mirror.observation(first[None])[0], second, rtol=0, atol=1e-9)

    @parameterized.parameters(*CASES)
    def test_reflected_states_have_reflected_observations(self, *case):
        environment, _ = build(case, start_phase=0.4)
        other, _ = build(case, start_phase=0.9)
        task, rng = environment.task, np.random.default_rng(5)
        for _ in range(5):
            pose, rate = disturbed(environment, rng)
            put(environment, pose, rate)
            mirror = task.motion.layout.mirror
            put(other, mirror.pose(pose), mirror.velocity(rate))
            if case[3] == 'footsteps':
                places, heading = rng.uniform(-1, 1, (2, 3)), rng.uniform(-3, 3)
                task.plan.landing[0], task.plan.heading[0] = places, heading
                other.task.plan.landing[0] = places * [1, -1, 1]
                other.task.plan.heading[0] = -heading
            first, second = observed(environment), observed(other)
            kept = np.ones(len(first), bool)
            if case[3] == 'footsteps':  # contacts are of the last substep
                kept[environment.blocks['contact']] = False
            reflected = task.mirror.observation(second[None])[0]
            np.testing.assert_allclose(reflected[kept], first[kept], rtol=0, atol=1e-9)
            # Rewards are equal, too, except for the interpolation of the table.
            np.testing.assert_allclose(
                other.task.reward_terms, task.reward_terms, rtol=0, atol=1e-6
            )

    @parameterized.parameters(*CASES[:-2])
    def test_reflected_actions_move_a_reflected_body(self, *case):
        # Small moves for a few steps: the solver does not treat left and right alike to the last bit,
        # and at the clamp of an orientation actuator the last bit decides about its damping.
        environment, _ = build(case, start_phase=0.4)
        other, _ = build(case, start_phase=0.9)
        mirror = environment.task.mirror
        rng = np.random.default_rng(1)
        pose, rate = state(environment)
        for each in (environment, other):
            put(each, state(each)[0], np.zeros(len(rate)))
        action = np.zeros(len(environment.action_map))
        if case[1] == 'position':  # the targets are where the joints are
            task = environment.task
            action = task.action_map.action(joint_targets(task.motion, pose))
        for _ in range(5):
            given = action + 0.02 * rng.uniform(-1, 1, len(action))
            environment.step(given)
            other.step(mirror.action(given[None])[0])
            pose, rate = state(environment)
            reflect = environment.task.motion.layout.mirror
            found = state(other)
            np.testing.assert_allclose(found[0], reflect.pose(pose), rtol=0, atol=1e-6)
            np.testing.assert_allclose(found[1], reflect.velocity(rate), rtol=0, atol=1e-4)

    @parameterized.parameters(*CASES)
    def test_a_mirrored_environment_is_the_reflection_of_the_plain_one(self, *case):
        plain, first = build(case, start_phase=0.4)
        mirrored, seen = build(case, start_phase=0.4, mirrored=True)
        mirror, rng = plain.task.mirror, np.random.default_rng(2)
        self.assertIsNone(mirrored.task.mirror)  # nothing is left to reflect
        self.assertEqual(mirrored.action_spec(), plain.action_spec())
        sides = set()
        for _ in range(6):
            left = bool(mirror.left(first[None])[0])
            sides.add(left)
            self.assertEqual(left, plain.task.phase[0] >= 0.5)
            canonical = mirror.observation(first[None])[0] if left else first
            self.check(mirrored, plain, seen, canonical)
            action = 0.4 * rng.uniform(-1, 1, len(plain.action_map))
            seen = mirrored.step(action)
            first = plain.step(mirror.action(action[None])[0] if left else action)
            self.assertEqual(seen.reward, first.reward)
            seen, first = (each.observation['observations'] for each in (seen, first))
            np.testing.assert_array_equal(mirrored.physics.data.qpos, plain.physics.data.qpos)
            np.testing.assert_array_equal(mirrored.physics.data.qvel, plain.physics.data.qvel)
        self.assertEqual(sides, {False, True})

    def check(self, mirrored, plain, seen, canonical):
        """Compares a mirrored observation with the plain one as it is in right stance."""
        for name, part in mirrored.blocks.items():
            expected = canonical[plain.blocks[name]]
            if name == 'phase':  # of the single step, and its half
                phase = expected[0]
                self.assertLess(phase, 0.5)
                expected = [2 * phase, *np.eye(2)[int(4 * phase)]]
            elif name == 'plan':  # heading, first place from the left, second from the right foot
                np.testing.assert_array_equal(expected[[0, 1, 2, 9, 10, 11]], 0)
                expected = np.concatenate([expected[12:], expected[3:6], expected[6:9]])
            np.testing.assert_array_equal(seen[part], expected, err_msg=name)

    def test_tasks_without_a_phase_have_no_mirror(self):
        self.assertIsNone(suite.make('PD_Biped3D_Imitate-Track-v0').task.mirror)


class PlanTest(parameterized.TestCase):
    """The mirror of planning tasks: without a phase, the stance foot is the one ahead."""

    def soccer(self, phase):
        environment = suite.make(
            SOCCER, {'random': 3, 'step_limit': None, 'start_phases': (phase,)},
            {'flat_observation': True},
        )  # fmt: skip
        environment.reset()
        return environment

    def reflect(self, environment, other):
        """Copies the reflected state of an environment to another."""
        pose, rate = state(environment)
        mirror = environment.task.motion.layout.mirror
        columns, dof = environment.task.ball.qpos, environment.task.ball.dof
        here, there = (each.physics.data for each in (environment, other))
        there.qpos[columns] = here.qpos[columns] * [1, -1, 1, 1, -1, 1, -1]
        there.qvel[dof] = here.qvel[dof] * [1, -1, 1, -1, 1, -1]
        put(other, mirror.pose(pose), mirror.velocity(rate))
        put(environment, pose, rate)
        for each in (environment, other):
            each.task.goal[0] = (3.0, 2.0 if each is environment else -2.0, 0.0)

    def test_a_reflected_game(self):
        environment, other = self.soccer(0.0), self.soccer(0.5)
        mirror = environment.task.mirror
        data, columns = environment.physics.data, environment.task.ball.qpos
        data.qpos[columns[:3]] = 1.5, 0.4, 0.2
        data.qvel[environment.task.ball.dof] = 0.5, -0.7, 0, 1, 2, 3
        self.reflect(environment, other)
        first, second = observed(environment), observed(other)
        np.testing.assert_allclose(mirror.observation(second[None])[0], first, rtol=0, atol=1e-9)
        np.testing.assert_array_equal(
            mirror.left(np.stack([first, second])),
            [environment.task.plan.stance[0], other.task.plan.stance[0]],
        )
        # At the clamp of an orientation actuator the last bit decides about its damping.
        plan = np.array([0.0, 0.05, 0.0, 0.05, 0.15])
        mine, theirs = environment.step(plan), other.step(mirror.action(plan[None])[0])
        self.assertAlmostEqual(mine.reward, theirs.reward, delta=0.02)
        again = mirror.observation(theirs.observation['observations'][None])[0]
        turned = mine.observation['observations'][105] - first[105]  # bearing of the goal
        self.assertGreater(abs(turned), 0.2)
        shown = np.r_[environment.blocks['pose'], environment.blocks['goal'], 107:109]
        np.testing.assert_allclose(
            again[shown], mine.observation['observations'][shown], rtol=0, atol=0.06
        )

    @parameterized.parameters('Forest', 'Conveyors_Wide', 'LargeBlocks', 'PathFollowing_Run')
    def test_maps(self, name):
        environment = made(f'PD_Biped3D_HLC_{name}-v0')
        blocks_, mirror = environment.blocks, environment.task.mirror
        size = len(mirror.observation_index)
        mirror.check(size, len(environment.action_map))
        seen = np.random.default_rng(0).normal(size=(2, size))
        reflected = mirror.observation(seen)
        np.testing.assert_array_equal(mirror.observation(reflected), seen)
        np.testing.assert_array_equal(mirror.left(reflected), ~mirror.left(seen))
        for name, signs in (('terrain', (1,)), ('surface', (1, -1))):
            if name in blocks_:
                lines = seen[:, blocks_[name]].reshape(2, -1, 32, 32)[:, :, ::-1]
                expected = (lines * np.reshape(signs, (-1, 1, 1))).reshape(2, -1)
                np.testing.assert_array_equal(reflected[:, blocks_[name]], expected, err_msg=name)

    def test_every_footstep_begins_with_a_foot_ahead(self):
        specs = VectorEnvironment(SOCCER, 16, 1, seed=0)
        plan, observation = scripted.scripted(specs), specs.reset()
        for _ in range(6):
            left = specs.task.mirror.left(observation)
            np.testing.assert_array_equal(left, specs.task.plan.stance == 1)
            observation = specs.step(plan(observation)).observation

    def test_tasks_that_also_control_joints_have_no_mirror(self):
        self.assertIsNone(suite.make(SOCCER, {'interface': 'frame'}).task.mirror)


class MirrorTest(parameterized.TestCase):
    """Mirrors as data."""

    def make(self, **changes):
        fields = {
            'observation_index': np.array([0, 2, 1, 3]), 'observation_sign': np.array([1, -1, -1, 1.0]),
            'action_index': np.array([1, 0]), 'action_sign': np.ones(2), 'phase': 3,
        }  # fmt: skip
        return Mirror(**{**fields, **changes})

    def test_by_hand(self):
        mirror = self.make()
        observation = np.array([[1.0, 2, 3, 0.25], [1.0, 2, 3, 0.5]])
        np.testing.assert_array_equal(mirror.left(observation), [False, True])
        reflected = [[1, -3, -2, 0.75], [1, -3, -2, 0.0]]
        np.testing.assert_array_equal(mirror.observation(observation), reflected)
        canonical, left = mirror.canonical(observation)
        np.testing.assert_array_equal(canonical, [observation[0], reflected[1]])
        action = np.array([[0.1, 0.2], [0.1, 0.2]])
        np.testing.assert_array_equal(
            mirror.unmirror_action(action, left), [[0.1, 0.2], [0.2, 0.1]]
        )
        np.testing.assert_array_equal(action, [[0.1, 0.2], [0.1, 0.2]])

    def test_by_the_foot_ahead(self):
        mirror = self.make(phase=None, feet=(1, 2))
        mirror.check(4, 2)
        observation = np.array([[1.0, 2, 3, 0.25], [1.0, 3, 2, 0.25], [1.0, 2, 2, 0.25]])
        np.testing.assert_array_equal(mirror.left(observation), [True, False, False])
        np.testing.assert_array_equal(mirror.observation(observation[:1]), [[1, -3, -2, 0.25]])

    def test_invalid_arguments_are_rejected(self):
        """See also `test_malformed_files_are_rejected`."""
        cases = (
            ({'observation_index': np.arange(3)}, 'mirror_observation_index'),
            ({'observation_sign': np.array([1, -1, 0.5, 1])}, 'mirror_observation_sign'),
            ({'phase': -1}, 'mirror_phase'), ({'feet': (1, 2)}, 'mirror_phase, mirror_feet'),
            *(({'phase': None, 'feet': feet}, 'mirror_feet') for feet in ((1, 1), (4, 1), (1,))),
        )  # fmt: skip
        assert_refused(self, *((lambda c=c: self.make(**c).check(4, 2), name) for c, name in cases))


def policy_for(environment, **changes):
    """A random policy for an environment, with the mirror of its task."""
    rng = np.random.default_rng(7)
    task, k, a = environment.task, environment.observation_spec(), len(environment.action_map)
    k = k['observations'].shape[0]
    fields = {
        'id': 'PD_Biped3D_LLC_General_Step-v0',
        'blocks': [(name, part.stop - part.start) for name, part in task.blocks.items()],
        'actions': environment.action_map.names, 'quantity': environment.action_map.quantity,
        'mean': rng.normal(size=k), 'std': rng.uniform(0.5, 2, k), 'clip': 5.0,
        'weights': [rng.normal(0, 0.05, (k, 8)), rng.normal(0, 0.05, (8, a))],
        'biases': [rng.normal(0, 0.1, 8), rng.normal(0, 0.1, a)], 'activation': 'tanh',
        'log_std': np.zeros(a), 'mirror': task.mirror,
    }  # fmt: skip
    return policies.Policy(**{**fields, **changes})


class PolicyTest(FolderTest):
    """Policies that reflect left stance to right stance."""

    def setUp(self):
        super().setUp()
        self.path = self.folder / 'p.npz'
        self.environment, _ = build(STEP)
        self.policy = policy_for(self.environment)
        environments = VectorEnvironment('PD_Biped3D_LLC_General_Step-v0', 30, 1, seed=4)
        self.observation = environments.reset()

    def test_reflected_observations_get_reflected_actions(self):
        mirror = self.environment.task.mirror
        self.policy.check(self.environment)
        action = self.policy(self.observation)
        left = mirror.left(self.observation)
        self.assertTrue(0 < left.sum() < 30)
        reflected = self.policy(mirror.observation(self.observation))
        np.testing.assert_allclose(reflected, mirror.action(action), rtol=0, atol=1e-6)
        # In right stance the mirror does nothing; in left stance it does.
        plain = dataclasses.replace(self.policy, mirror=None)
        np.testing.assert_array_equal(action[~left], plain(self.observation[~left]))
        self.assertTrue((action[left] != plain(self.observation[left])).any(1).all())
        # A simulation does not depend on the others.
        for i in range(30):
            np.testing.assert_array_equal(self.policy(self.observation[i]), action[i])

    def test_saved_and_loaded(self):
        policies.save(self.policy, self.path)
        with np.load(self.path, allow_pickle=False) as data:
            names = [name for name in data.files if name.startswith('mirror_')]
            self.assertLen(names, 5)
            page = (pathlib.Path(__file__).parents[1] / 'trained/README.md').read_text()
            for name in names:
                self.assertIn(f'`{name}`', page)
                self.assertIn(data[name].dtype.kind, 'iuf')
                if data[name].dtype.kind == 'f':
                    self.assertIn(data[name].dtype, (np.float32, np.float16))
        again = policies.load(self.path)
        for field in dataclasses.fields(Mirror):
            np.testing.assert_array_equal(
                getattr(again.mirror, field.name), getattr(self.policy.mirror, field.name)
            )
        np.testing.assert_array_equal(again(self.observation), self.policy(self.observation))
        again.check(self.environment)
        policies.save(dataclasses.replace(self.policy, mirror=None), self.path)
        self.assertIsNone(policies.load(self.path).mirror)

    def test_malformed_files_are_rejected(self):
        policies.save(self.policy, self.path)
        with np.load(self.path) as data:
            stored = dict(data)
        for changes, message in (
            ({'mirror_phase': None}, 'mirror_phase'), ({'mirror_action_sign': None}, 'mirror_action_sign'),
            ({'mirror_action_sign': np.zeros(17, np.float32)}, 'mirror_action_sign'),
            ({'mirror_action_index': np.arange(16)}, 'mirror_action_index'),
            ({'mirror_observation_index': np.zeros(125, int)}, 'mirror_observation_index'),
            ({'mirror_observation_sign': np.array(['a'] * 125)}, 'mirror_observation_sign'),
            ({'mirror_phase': np.array(125)}, 'mirror_phase'), ({'mirror_side': np.array(1)}, 'mirror_'),
        ):  # fmt: skip
            fields = {
                name: value for name, value in {**stored, **changes}.items() if value is not None
            }
            np.savez(self.path, **fields)
            with self.assertRaisesRegex(ValueError, f'{self.path.name}.*{message}'):
                policies.load(self.path)

    def test_a_mirror_that_does_not_fit_is_rejected(self):
        with self.assertRaisesRegex(ValueError, 'mirror_observation_index'):
            policy_for(self.environment, mirror=build(WALK)[0].task.mirror)
