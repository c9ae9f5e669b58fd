"""Tests of three-dimensional imitation: observation, reward and start, recomputed independently."""

import mujoco
import numpy as np
from absl.testing import absltest, parameterized
from helpers import (
    advance,
    assert_goes_on,
    assert_rows_are_singles,
    assert_uniform,
    flattened,
    ground,
    links_on_ground,
    made,
    put,
)

from trl_suite import motion, suite, terrain
from trl_suite.vector import VectorEnvironment

PLANE, HILLS = 'PD_Biped3D_Imitate-v0', 'PD_Biped3D_Imitate-Hills-v0'
STEPS, TRACK = 'PD_Biped3D_Imitate-Steps-v0', 'PD_Biped3D_Imitate-Track-v0'
RUN, STAIRS = 'PD_Biped3D_Imitate-Run-v0', 'PD_Biped3D_Imitate-Stairs-v0'
IDS = [id_ for id_ in suite.ALL_IDS if suite.find(id_).task_type == 'spatial_imitation']
WEIGHTS = {'pose': 0.5, 'velocity': 0.05, 'end_effector': 0.15, 'com': 0.2, 'root': 0.1}
SCALES = {'pose': 2, 'velocity': 0.005, 'end_effector': 40, 'com': 10, 'root': 10}
# Raw reward weights: root, torso, then hip, knee and ankle of the right and of the left leg.
RAW = np.array([1, 0.5, 0.5, 0.3, 0.2, 0.5, 0.3, 0.2])
FEET = ('right_ankle', 'left_ankle')


def rotation_angle(matrix):
    """Angle of a rotation matrix, rad."""
    return np.arccos(np.clip((np.trace(matrix) - 1) / 2, -1, 1))


class Probe:
    """Reads an environment's state by names, with the engine's own functions."""

    def __init__(self, environment, flat=False):
        self.environment, self.task = environment, environment.task
        self.spec = self.task.character.spec
        self.named = environment.physics.named
        self.flat = flat

    def ground(self, x, y):
        if self.flat:
            return np.zeros(np.shape(x))
        return ground(self.environment, x, y)

    def body(self, field, link):
        return getattr(self.named.data, field)[f'{self.spec.name}/{link}']

    @property
    def root(self):
        return self.body('xpos', 'root')

    @property
    def heading(self):
        ahead = self.body('xmat', 'root').reshape(3, 3)[:, 0]
        return np.arctan2(ahead[1], ahead[0])

    def velocity(self, link):
        """Angular velocity of a link and velocity of its centre of mass, world axes."""
        model, data = self.environment.physics.model.ptr, self.environment.physics.data.ptr
        result = np.zeros(6)
        body = model.body(f'{self.spec.name}/{link}').id
        # Of the body's inertial frame, in world axes.
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, body, result, 0)
        return result[:3], result[3:]

    def blocks(self):
        turn, root = flattened(self.heading), self.root
        under = float(self.ground(root[0], root[1]))
        pose, velocity = [root[2:] - under], []
        for link in self.spec.links:
            pose.append(turn @ (self.body('xipos', link) - root))
            matrix = turn @ self.body('xmat', link).reshape(3, 3)
            wxyz = np.zeros(4)
            mujoco.mju_mat2Quat(wxyz, matrix.ravel())
            pose.append(wxyz * np.where(wxyz[0] < 0, -1, 1))
            spin, linear = self.velocity(link)
            velocity += [turn @ linear, turn @ spin]
        ahead = np.tile(np.linspace(-1, 10, 32), 32)
        aside = np.repeat(np.linspace(5.5, -5.5, 32), 32)  # from the left to the right
        points = root[:2, None] + turn.T[:2, :2] @ [ahead, aside]
        return {
            'terrain': self.ground(*points) - under,
            'pose': np.concatenate(pose),
            'velocity': np.concatenate(velocity),
        }

    def features(self):
        """What the reward compares."""
        turn, root, spec = flattened(self.heading), self.root, self.spec
        mass = np.array([self.named.model.body_mass[f'{spec.name}/{n}'] for n in spec.links])
        share = mass / mass.sum()
        com = share @ [self.body('xipos', n) for n in spec.links]
        com_velocity = share @ [self.velocity(n)[1] for n in spec.links]
        rotations, rates = [turn @ self.body('xmat', 'root').reshape(3, 3)], []
        rates.append(turn @ self.velocity('root')[0])
        for joint, ball in zip(spec.joints, self.task.character.spherical, strict=True):
            qpos = self.named.data.qpos[f'{spec.name}/{joint}']
            rates.append(self.named.data.qvel[f'{spec.name}/{joint}'])
            if ball:
                matrix = np.zeros(9)
                mujoco.mju_quat2Mat(matrix, qpos)
                rotations.append(matrix.reshape(3, 3))
            else:
                rotations.append(float(qpos[0]))
        feet = []
        for link in FEET:
            place = self.body('xpos', link)
            foot = turn @ (place - com)
            foot[2] = place[2] - self.ground(place[0], place[1])
            feet.append(foot)
        return {
            'rotations': rotations,
            'rates': rates,
            'feet': np.array(feet),
            'com_velocity': com_velocity,
            'height': root[2] - float(self.ground(root[0], root[1])),
        }


def started(id_, steps=0, **options):
    environment = made(id_, seed=8, step_limit=None, **options)
    step = environment.reset()
    rng = np.random.default_rng(9)
    for _ in range(steps):
        step = environment.step(0.3 * rng.uniform(-1, 1, len(environment.action_map)))
    return environment, step


def observed_terms(environment):
    """Reward terms of the last observation, which a start has as well."""
    return dict(zip(WEIGHTS, environment.task.reward_terms[0].tolist(), strict=True))


class ObservationTest(parameterized.TestCase):
    """Every block against named access and the engine's own velocities."""

    @parameterized.parameters(
        *((id_, steps) for id_ in (HILLS, STEPS, STAIRS, RUN) for steps in (0, 4, 14))
    )
    def test_terrain_pose_and_velocity(self, id_, steps):
        environment, step = started(id_, steps, terrain_observation='height')
        self.assertEqual(list(step.observation)[:3], ['terrain', 'pose', 'velocity'])
        for name, value in Probe(environment).blocks().items():
            # Height grids are stored in single precision.
            delta = 1e-6 if name == 'terrain' or id_ == HILLS else 1e-9
            np.testing.assert_allclose(
                step.observation[name], value, rtol=0, atol=delta, err_msg=name
            )

    def test_height_map_equals_that_of_the_arena(self):
        environment, step = started(HILLS, 6, terrain_observation='height')
        probe = Probe(environment)
        around = environment.task.arena.seen()
        expected = around.height_map(probe.root[None, :2], probe.heading[None])
        self.assertEqual(step.observation['terrain'].shape, (1024,))
        np.testing.assert_allclose(step.observation['terrain'], expected[0], atol=1e-12)

    @parameterized.parameters(0.0, 1.0, 3.0, -2.5)
    def test_observation_does_not_depend_on_the_heading(self, heading):
        # On a plane pose and velocity stay the same when everything is turned and moved.
        environment, step = started(PLANE, 5)
        task, data = environment.task, environment.physics.data
        before = step.observation
        half = heading / 2
        pose = data.qpos[task.figure.pose_qpos]
        turned = np.zeros(4)
        mujoco.mju_mulQuat(turned, np.array([np.cos(half), 0, 0, np.sin(half)]), pose[3:7])
        rate = data.qvel[task.figure.pose_dof]
        pose[:2], pose[3:7] = (3.0, -2.0), turned
        rate[:3] = flattened(heading).T @ rate[:3]  # the angular one is in the root's own axes
        put(environment, pose, rate)
        task.observe()
        after = environment.observation()
        for name in ('pose', 'velocity'):
            np.testing.assert_allclose(after[name], before[name], atol=1e-9)

    @parameterized.parameters(PLANE, RUN)
    def test_phase(self, id_):
        environment, step = started(id_, start_phase=0.2)
        period = environment.task.clip.duration
        for i in range(20):
            block = step.observation['phase']
            phase = (0.2 + i / 30 / period) % 1
            self.assertLess(abs((block[0] - phase + 0.5) % 1 - 0.5), 1e-8)
            self.assertTrue(0 <= block[0] < 1)
            np.testing.assert_array_equal(block[1:], np.eye(4)[int(4 * block[0])])
            step = environment.step(np.zeros(17))
            if step.last():
                break
        self.assertGreater(i, 4)

    @parameterized.parameters(0, 5)
    def test_target(self, steps):
        environment, step = started(TRACK, steps)
        clip, task = environment.task.clip, environment.task
        other, _ = started(TRACK)
        time = float(task.phase[0]) * clip.duration
        put(other, clip.pose(time), clip.velocity(time))
        blocks = Probe(other).blocks()
        links = blocks['pose'][1:].reshape(8, 7)
        expected = [blocks['pose'][:1], links[:, :3].ravel(),
                    blocks['velocity'].reshape(8, 6)[:, :3].ravel()]  # fmt: skip
        # The task interpolates a table of the clip, best where velocities are its slope.
        target, expected = step.observation['reference'], np.concatenate(expected)
        np.testing.assert_allclose(target[:25], expected[:25], atol=1e-4)
        np.testing.assert_allclose(target[25:], expected[25:], atol=5e-3)

    @parameterized.parameters(
        (0.0, 0.0, 0.0), (5.0, 0.0, 0.0), (-2.0, 1.0, 0.0), (4.0, -3.0, 0.5), (0.5, 2.0, -3.0),
    )  # fmt: skip
    def test_goal_is_straight_ahead(self, x, y, heading):
        environment, _ = started(PLANE)
        task, data = environment.task, environment.physics.data
        pose, rate = data.qpos[task.figure.pose_qpos], data.qvel[task.figure.pose_dof]
        pose[:2] = x, y
        pose[3:7] = np.cos(heading / 2), 0, 0, np.sin(heading / 2)
        put(environment, pose, rate)
        task.observe()
        bearing, distance = environment.observation()['goal']
        # The point (x + 3, 0) on the line through the start along +x.
        expected = np.arctan2(-y, 3) - heading
        self.assertAlmostEqual(np.cos(bearing - expected), 1, delta=1e-12)
        self.assertTrue(-np.pi <= bearing <= np.pi)
        self.assertAlmostEqual(distance, np.hypot(3, y), delta=1e-12)

    def test_observation_sizes_of_the_documentation(self):
        blocks = suite.make(PLANE).blocks
        self.assertEqual(blocks, {
            'pose': slice(0, 57), 'velocity': slice(57, 105), 'phase': slice(105, 110),
            'goal': slice(110, 112),
        })  # fmt: skip
        blocks = suite.make(TRACK).blocks
        self.assertEqual((blocks['reference'], blocks['goal']), (slice(105, 154), slice(154, 156)))

    @parameterized.parameters(
        ('position', {}, 17), ('position', {'action_offset': 'original'}, 22), ('torque', {}, 17),
        ('velocity', {}, 17),
    )  # fmt: skip
    def test_actions(self, actuation, options, size):
        environment = suite.build('biped3d', actuation, task_kwargs=options)
        self.assertEqual(environment.action_spec().shape, (size,))
        self.assertEqual(environment.action_spec().name.split('\t')[0][:6], 'torso_')
        self.assertEqual(max(part.stop for part in environment.blocks.values()), 112)

    def test_actions_of_the_full_body(self):
        for options, size in (({}, 35), ({'action_offset': 'original'}, 45)):
            environment = suite.build('biped3d_full_mocap', task_kwargs=options)
            self.assertEqual(environment.action_spec().shape, (size,))
            # 113 for the pose of 16 links, 96 for their velocities, phase and goal.
            self.assertEqual(max(p.stop for p in environment.blocks.values()), 113 + 96 + 5 + 2)

    def test_mirrored_state_has_the_mirrored_observation(self):
        environment = suite.make(PLANE, {'mirrored': True, 'random': 0})
        sizes = {name: part.stop - part.start for name, part in environment.blocks.items()}
        self.assertEqual(sizes, {'pose': 57, 'velocity': 48, 'phase': 3, 'goal': 2})


class RewardTest(parameterized.TestCase):
    """The reward of the specification, by hand."""

    @parameterized.parameters(*((id_, phase) for id_ in IDS for phase in (0.0, 0.31, 0.77)))
    def test_the_reference_pose_has_full_reward(self, id_, phase):
        environment, _ = started(id_, start_phase=phase)
        task, clip = environment.task, environment.task.clip
        pose = clip.pose(phase * clip.duration)
        pose[:2] = 0
        grid = np.linspace(-1.5, 1.5, 61)
        pose[2] += float(Probe(environment).ground(0.0, 0.0))
        put(environment, pose, clip.velocity(phase * clip.duration))
        task.observe()
        level = np.ptp(Probe(environment).ground(*np.meshgrid(grid, grid))) < 1e-12
        terms = observed_terms(environment)
        for name, weight in WEIGHTS.items():
            if level or name != 'end_effector':  # feet are measured from the ground below each
                self.assertAlmostEqual(terms[name], weight, delta=1e-3 * weight, msg=name)
        if level:
            self.assertAlmostEqual(sum(terms.values()), 1, delta=1e-3)

    def by_hand(self, environment):
        task = environment.task
        found = Probe(environment).features()
        other, _ = started(PLANE if task.clip.name == 'biped3d_walk' else RUN)
        time = float(task.phase[0]) * task.clip.duration
        put(other, task.clip.pose(time), task.clip.velocity(time))
        wanted = Probe(other, flat=True).features()
        weights = RAW / RAW.sum()
        turned = [
            rotation_angle(a @ np.transpose(b)) if np.ndim(a) else a - b
            for a, b in zip(found['rotations'], wanted['rotations'], strict=True)
        ]
        rates = [np.sum((a - b) ** 2) for a, b in zip(found['rates'], wanted['rates'], strict=True)]
        errors = {
            'pose': weights @ np.square(turned),
            'velocity': weights @ rates,
            'end_effector': np.mean(np.sum((found['feet'] - wanted['feet']) ** 2, axis=1)),
            'com': 0.1 * np.sum((found['com_velocity'] - wanted['com_velocity']) ** 2),
            'root': (found['height'] - wanted['height']) ** 2,
        }
        return {name: WEIGHTS[name] * np.exp(-SCALES[name] * e) for name, e in errors.items()}

    @parameterized.parameters(
        *((id_, steps) for id_ in (PLANE, HILLS, STEPS, RUN) for steps in (1, 6, 12))
    )
    def test_terms_in_a_rollout(self, id_, steps):
        environment, step = started(id_, steps)
        self.assertTrue(step.mid())
        terms, expected = environment.info['reward_terms'], self.by_hand(environment)
        for name, value in expected.items():
            # The task interpolates a table of the clip.
            self.assertAlmostEqual(terms[name], value, delta=2e-3 * WEIGHTS[name], msg=name)
        self.assertAlmostEqual(step.reward, sum(expected.values()), delta=2e-3)

    @parameterized.parameters(0.9, -2.0)
    def test_only_the_centre_of_mass_term_depends_on_the_direction(self, heading):
        # The pose of the clip, all of it turned: heading is removed everywhere but in `com`.
        environment, _ = started(PLANE, start_phase=0.4)
        task, clip = environment.task, environment.task.clip
        pose, rate = clip.pose(0.4 * clip.duration), clip.velocity(0.4 * clip.duration)
        turned = np.zeros(4)
        about = np.array([np.cos(heading / 2), 0, 0, np.sin(heading / 2)])
        mujoco.mju_mulQuat(turned, about, pose[3:7])
        pose[3:7], rate[:3] = turned, flattened(heading).T @ rate[:3]
        put(environment, pose, rate)
        task.observe()
        terms, velocity = observed_terms(environment), Probe(environment).features()['com_velocity']
        for name in ('pose', 'velocity', 'end_effector', 'root'):
            self.assertAlmostEqual(terms[name], WEIGHTS[name], delta=1e-3 * WEIGHTS[name])
        # By a chord of the circle of its speed.
        error = (2 * np.sin(heading / 2)) ** 2 * np.sum(velocity[:2] ** 2)
        self.assertAlmostEqual(terms['com'] / 0.2, np.exp(-error), delta=2e-3)

    @parameterized.parameters(0, 1)
    def test_a_joint_error_costs_its_weight(self, axis):
        environment, _ = started(PLANE, start_phase=0.3)
        task, data = environment.task, environment.physics.named.data
        task.observe()
        before = observed_terms(environment)['pose']
        turn = np.zeros(4)
        vector = np.eye(3)[axis]
        mujoco.mju_axisAngle2Quat(turn, vector, 0.2)
        weights = RAW / RAW.sum()
        for i, (joint, ball) in enumerate(
            zip(task.character.spec.joints, task.character.spherical, strict=True), 1
        ):
            kept = data.qpos[f'biped3d/{joint}'].copy()
            if ball:
                turned = np.zeros(4)
                mujoco.mju_mulQuat(turned, kept, turn)
                # The other sign is the same rotation.
                data.qpos[f'biped3d/{joint}'] = -turned
            else:
                data.qpos[f'biped3d/{joint}'] = kept + 0.2
            environment.physics.forward()
            task.observe()
            after = observed_terms(environment)['pose']
            data.qpos[f'biped3d/{joint}'] = kept
            self.assertAlmostEqual(
                after / before, np.exp(-2 * weights[i] * 0.04), delta=1e-3, msg=joint
            )

    def test_standing_still_in_the_pose_of_a_walk(self):
        environment, _ = started(PLANE, start_phase=0.0)
        environment.physics.data.qvel[:] = 0
        environment.physics.forward()
        environment.task.observe()
        # exp(-speed^2) at the mean speed of 1.2 m/s; the reference's speed varies a little.
        self.assertAlmostEqual(
            observed_terms(environment)['com'] / 0.2, np.exp(-(1.2**2)), delta=0.06
        )

    def test_weights_and_scales(self):
        task = suite.make(PLANE).task
        self.assertEqual({term.name: term.weight for term in task.terms}, WEIGHTS)
        self.assertEqual({term.name: term.scale for term in task.terms}, SCALES)


def corners(environment):
    """Corners of all boxes of the character, (boxes * 8, 3) m."""
    found = []
    for geom in environment.task.character.collision_geoms:
        bound = environment.physics.bind(geom)
        box = np.array(np.meshgrid(*[(-1, 1)] * 3)).reshape(3, 8).T * bound.size
        found.append(bound.xpos + box @ bound.xmat.reshape(3, 3).T)
    return np.concatenate(found)


class StartTest(parameterized.TestCase):
    """Where and how episodes start."""

    @parameterized.parameters(*sorted(terrain.PRESETS3D))
    def test_on_the_ground_and_not_below(self, preset):
        environment = suite.build('biped3d', terrain=preset, task_kwargs={'random': 31})
        for _ in range(4):
            environment.reset()
            probe = Probe(environment)
            np.testing.assert_array_equal(probe.root[:2], 0)
            places = corners(environment)
            clearance = (places[:, 2] - probe.ground(*places[:, :2].T)).min()
            self.assertGreater(clearance, 0.0005)
            clip = environment.task.clip
            pose = clip.pose(float(environment.task.phase[0]) * clip.duration)
            lift = probe.root[2] - pose[2] - probe.ground(0.0, 0.0)
            self.assertGreater(lift, -1e-6)  # only lifted, never lowered
            if lift > 1e-6:
                self.assertLess(clearance, 0.0015)
            self.assertTrue(environment.step(np.zeros(17)).mid())

    @parameterized.parameters(0.0, 0.37, 0.5)
    def test_pose_and_velocity_of_the_clip(self, phase):
        environment, _ = started(PLANE, start_phase=phase)
        task, clip = environment.task, environment.task.clip
        pose, rate = clip.pose(phase * clip.duration), clip.velocity(phase * clip.duration)
        data = environment.physics.data
        found = data.qpos[task.figure.pose_qpos]
        np.testing.assert_allclose(found[3:], pose[3:], atol=1e-12)
        np.testing.assert_array_equal(found[:2], 0)
        np.testing.assert_allclose(data.qvel[task.figure.pose_dof], rate, atol=1e-12)

    def test_phases_are_uniform(self):
        environments = VectorEnvironment(PLANE, 100, 1, seed=0)
        found = []
        for _ in range(8):
            environments.reset()
            found.append(environments.task.phase.copy())
        self.assertLess(np.max(found), 1)
        assert_uniform(np.ravel(found), 0, 1)

    def test_start_phase(self):
        environment, step = started(HILLS, start_phase=0.6)
        for _ in range(3):
            self.assertAlmostEqual(step.observation['phase'][0], 0.6, delta=1e-9)
            step = environment.reset()
        # The ground is redrawn, and does not depend on whether the phase is drawn or given.
        grounds = []
        for options in ({}, {'start_phase': 0.6}):
            other = suite.make(HILLS, {'random': 5, **options})
            other.reset()
            grounds.append(Probe(other).ground(np.linspace(-5, 5, 9), np.ones(9)))
        np.testing.assert_array_equal(*grounds)

    def test_distance_is_along_x(self):
        environment, _ = started(PLANE, 3)
        self.assertEqual(environment.info['distance'], Probe(environment).root[0])
        self.assertNotEqual(environment.info['distance'], 0)

    def test_terrain_level_selects_the_parameters(self):
        content = {'Type': 'var3d_checkers', 'Params': [{'Slope': 0.0}, {'Slope': 0.2}]}
        for terrain_level, height in ((0.0, 0.0), (0.5, 0.1), (1.0, 0.2)):
            environment = suite.build(
                'biped3d',
                terrain=content,
                task_kwargs={'random': 0, 'terrain_level': terrain_level},
            )
            environment.reset()
            grid = np.meshgrid(np.linspace(-4, 4, 81), np.linspace(-4, 4, 81))
            self.assertAlmostEqual(np.ptp(Probe(environment).ground(*grid)), height, delta=1e-12)


class EpisodeTest(parameterized.TestCase):
    """How episodes end."""

    @parameterized.parameters('root', 'torso', 'right_knee')
    def test_pelvis_and_torso_may_not_touch_the_ground(self, link):
        environment = suite.build('biped3d', 'torque', task_kwargs={'random': 0})
        environment.reset()
        task, data = environment.task, environment.physics.data
        pose, rate = data.qpos[task.figure.pose_qpos], np.zeros(23)
        if link == 'right_knee':  # kneels, trunk upright
            pose[3:7] = 1, 0, 0, 0
            pose[7:] = [1, 0, 0, 0] + 2 * [1, 0, 0, 0, -2.4, 1, 0, 0, 0]
        elif link == 'root':  # upright, on its seat: legs stretched ahead
            ahead = np.array([np.cos(0.85), 0, -np.sin(0.85), 0])
            pose[3:7] = 1, 0, 0, 0
            pose[7:] = [1, 0, 0, 0] + 2 * [*ahead, 0, 1, 0, 0, 0]
        else:  # on its head
            pose[3:7] = 0, 0, 1, 0
        pose[2] = 2.0
        put(environment, pose, rate)
        pose[2] -= corners(environment)[:, 2].min() - 1e-4
        put(environment, pose, rate)
        for _ in range(5):
            step = environment.step(np.zeros(17))  # limp
            links = links_on_ground(environment)
            fell = bool(links & {'root', 'torso'})
            self.assertEqual(step.last(), fell)
            self.assertEqual(environment.info['fell'], fell)
            self.assertEqual(step.discount, 0.0 if fell else 1.0)
            if link in links:
                break
        self.assertIn(link, links)
        self.assertEqual(fell, link != 'right_knee')
        if fell:
            self.assertEqual(step.reward, 0.0)

    def test_divergence_ends_the_episode(self):
        environment, _ = started(PLANE, 2)
        kept = environment.observation()
        environment.physics.data.qpos[environment.task.figure.pose_qpos[0]] = np.nan
        step = environment.step(np.zeros(17))
        self.assertTrue(step.last())
        self.assertEqual((step.reward, step.discount), (0.0, 0.0))
        self.assertTrue(environment.info['diverged'])
        self.assertFalse(environment.info['fell'])
        for name, value in step.observation.items():
            np.testing.assert_array_equal(value, kept[name])
        environment.reset()
        self.assertGreater(environment.step(np.zeros(17)).reward, 0.2)


class MovingGroundTest(parameterized.TestCase):
    """Belts carry characters, and observed velocities are relative to them."""

    def test_velocity_against_the_belt(self):
        environment = suite.build(
            'biped3d', terrain='conveyor3d_wide', task_kwargs={'random': 2, 'start_phase': 0.1}
        )
        beside = environment.reset().observation
        task, data = environment.task, environment.physics.data
        belt = task.arena.grounds[0].layout.belts
        self.assertAlmostEqual(np.linalg.norm(belt.velocity[0]), 0.6)
        pose, rate = data.qpos[task.figure.pose_qpos], data.qvel[task.figure.pose_dof]
        pose[0], pose[2] = 5.5, pose[2] + 0.01  # the strip from x = 3 to 8 m, 1 cm high
        put(environment, pose, rate)
        task.observe()
        upon = environment.observation()
        expected = beside['velocity'].reshape(8, 6).copy()
        turn = flattened(Probe(environment).heading)
        expected[:, :2] -= turn[:2, :2] @ belt.velocity[0]
        np.testing.assert_allclose(upon['velocity'].reshape(8, 6), expected, atol=1e-9)
        np.testing.assert_allclose(upon['pose'], beside['pose'], atol=1e-9)
        # The reward's velocity of the centre of mass is that of the world.
        self.assertAlmostEqual(observed_terms(environment)['com'], 0.2, delta=1e-3)


class SaveTest(parameterized.TestCase):
    """Saved states and pickles continue bit for bit; simulations equal single environments."""

    OPTIONS = (
        (HILLS, {'terrain_observation': 'height'}), (STEPS, {'mirrored': True, 'terrain_observation': 'height'}),
        (TRACK, {}),
    )  # fmt: skip

    def advance(self, environment, seed):
        return advance(environment, seed, 30, 0.5)

    @parameterized.parameters(*OPTIONS)
    def test_a_restored_state_continues_exactly(self, id_, options):
        environment, other = (suite.make(id_, {'random': seed, **options}) for seed in (6, 9))
        environment.reset()
        for _ in range(7):
            environment.step(np.zeros(17))
        self.advance(other, 4)
        assert_goes_on(environment, other, self.advance)

    @parameterized.parameters(
        *OPTIONS, (PLANE, {'action_offset': 'original'}), (STAIRS, {'start_phase': 0.4}),
    )  # fmt: skip
    def test_simulations_equal_single_environments(self, id_, options):
        assert_rows_are_singles(id_, 4, 22, 9, options)


class HelperTest(parameterized.TestCase):
    """What a task tells beyond the time step, and what it refuses."""

    @parameterized.parameters(
        ('position', {}), ('position', {'action_offset': 'posture'}), ('velocity', {}),
        ('position', {'mirrored': True, 'start_phase': 0.6}),
    )  # fmt: skip
    def test_clip_action(self, actuation, options):
        environment = suite.build('biped3d', actuation, task_kwargs={'random': 0, **options})
        environment.reset()
        task, clip = environment.task, environment.task.clip
        time = float(task.phase[0]) * clip.duration
        environment.step(task.clip_action(0))
        control = environment.physics.data.ctrl.copy()
        if actuation == 'velocity':
            expected = clip.velocity(time)[6:]
        else:
            expected, column = [], 7
            for size in clip.sizes:
                part = clip.pose(time)[column : column + size]
                if size == 4:
                    vector = np.zeros(3)
                    mujoco.mju_quat2Vel(vector, part, 1.0)
                    part = vector
                expected.append(part)
                column += size
            expected = np.concatenate(expected)
        np.testing.assert_allclose(control, expected, atol=1e-9)

    def test_no_clip_action(self):
        environment = suite.build('biped3d', 'torque', task_kwargs={'random': 0})
        environment.reset()
        with self.assertRaisesRegex(ValueError, 'cannot follow a clip open loop'):
            environment.task.clip_action(0)

    def test_reference_pose_walks_along(self):
        environment, _ = started(PLANE, start_phase=0.25)
        task, x = environment.task, []
        for _ in range(15):
            x.append(task.reference_pose(0)[0])
            environment.step(task.clip_action(0))
        self.assertEqual(x[0], 0)
        self.assertAlmostEqual((x[-1] - x[0]) / 14 * 30, 1.2, delta=0.15)

    @parameterized.parameters(
        ({'substeps': 5}, 'substeps is 5'), ({'substeps': 10.5}, 'substeps is 10.5'),
        ({'action_offset': 'mean'}, "unknown action_offset 'mean'"),
        ({'action_scale': 0}, 'action_scale is 0'), ({'action_scale': np.inf}, 'action_scale is inf'),
        ({'action_scale': 1.0, 'action_offset': 'original'}, 'takes no action_scale'),
        ({'start_phase': 1.0}, 'start_phase is 1.0'), ({'start_phase': -0.1}, 'start_phase is -0.1'),
        ({'start_phase': np.nan}, 'start_phase is nan'),
        ({'mirrored': True, 'reference_observation': True}, 'mirrored observations need the phase'),
        ({'terrain_level': np.nan}, 'terrain_level is nan; expected a number'),
        ({'terrain_observation': 50}, "terrain_observation is 50; expected a string"),
        ({'plans': {}}, "unknown option.*'plans'"),
    )  # fmt: skip
    def test_options_out_of_range(self, options, message):
        with self.assertRaisesRegex(ValueError, message):
            suite.make(PLANE, {'random': 0, **options}).reset()

    def test_parts_that_do_not_fit_are_rejected(self):
        for arguments, message in (
            (('biped3d', 'torque', None, 'imitation', None, {'action_scale': 1.0}),
             'options of position control'),
            (('biped3d', 'velocity', None, 'imitation', None, {'action_offset': 'posture'}),
             'options of position control'),
            (('biped3d', None, None, 'imitation', 'biped2d_walk'), "'biped2d_walk'.*free root"),
            (('biped3d', None, None, 'imitation', 'biped3d_full_walk'),
             "'biped3d_full_walk'.*does not fit character 'biped3d'"),
            (('biped3d', 'muscle'), 'has no muscles'),
        ):  # fmt: skip
            with self.subTest(message), self.assertRaisesRegex(ValueError, message):
                suite.build(*arguments)
        sizes = (1, 4, 4, 4, 4, 1, 4)  # those of the torso and of the right knee are exchanged
        pose = [0, 0, 1, 1, 0, 0, 0] + [n for size in sizes for n in [1, 0, 0, 0][:size]]
        joints = motion.load('biped3d_walk').joints
        clip = motion.Clip('other', (0, 1), [pose, pose], 'free', joints, sizes, loop=True)
        with self.assertRaisesRegex(ValueError, "columns for its joints; character 'biped3d' has"):
            suite.build('biped3d', clip=clip)
        once = motion.load_steps('biped3d_mocap').clip(2)
        with self.assertRaisesRegex(ValueError, 'not looping'):
            suite.build('biped3d_mocap', clip=once)


if __name__ == '__main__':
    absltest.main()
