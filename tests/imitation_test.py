"""Tests of the imitation tasks, in the plane and in 3D: observation, reward, start, recomputed."""

import dataclasses
import itertools

import mujoco
import numpy as np
from absl.testing import parameterized
from helpers import assert_refused, assert_uniform, build, flattened, ground, made, put

from trl_suite import motion, suite, terrain
from trl_suite.motion import quaternion
from trl_suite.tasks.common.control import start_phases
from trl_suite.vector import VectorEnvironment

# One of each figure; the dog's links stand in another order than the engine's bodies.
DOG, RAPTOR = 'PD_Dog2D_Slopes_Mixed_Terrain-v0', 'PD_Raptor2D_Slopes_Terrain-v0'
BIPED, MUSCLES = 'PD_Biped2D_Gaps_Terrain-v0', 'MTU_Dog2D_LLC_Imitate_Flat-v0'
FLAT, SLOPES = 'PD_Biped2D_LLC_Imitate_Flat-v0', 'PD_Dog2D_Slopes_Terrain-v0'
PLANE, HILLS, STEPS, TRACK, RUN, STAIRS = (
    f'PD_Biped3D_Imitate{ground}-v0'
    for ground in ('', '-Hills', '-Steps', '-Track', '-Run', '-Stairs')
)
PLANAR_IDS = [id_ for id_ in suite.ALL_IDS if suite.find(id_).task_type == 'planar_imitation']
SPATIAL_IDS = [id_ for id_ in suite.ALL_IDS if suite.find(id_).task_type == 'spatial_imitation']
CLIPS = {
    (suite.find(id_).character, suite.find(id_).clip): id_ for id_ in (*PLANAR_IDS, *SPATIAL_IDS)
}
PLANAR = (
    DOG, RAPTOR, BIPED, MUSCLES, 'Torque_Raptor2D_LLC_Imitate_Flat-v0', 'PD_Biped2D_Incline-v0',
    'PD_Biped2D_LLC_Imitate_Run_Flat-v0',
)  # fmt: skip
SPATIAL = (PLANE, HILLS, STEPS, RUN, STAIRS)
EXAMPLES = (*PLANAR, *SPATIAL)
WEIGHTS = {'pose': 0.5, 'velocity': 0.05, 'end_effector': 0.15, 'com': 0.2, 'root': 0.1}
SCALES = {'pose': 2, 'velocity': 0.005, 'end_effector': 40, 'com': 10, 'root': 10}
# Raw reward weights: root, then joints in link order.
RAW = {
    'dog': [1] + [0.5] * 4 + [1] + [0.2] * 3 + [0.001] * 4 + [1] * 8,
    'raptor': [1] + [0.5] * 5 + [0.25] * 5 + 2 * [1, 0.5, 0.5, 0.5],
    'biped2d': [1] + 2 * [0.3, 0.3, 0.2],
    'biped2d_full': [1] + 2 * [0.3, 0.3, 0.2] + [0.3] * 5,
    'biped3d': [1, 0.5] + 2 * [0.5, 0.3, 0.2],
}
EFFECTORS = {'dog': ('finger', 'toe'), 'raptor': ('right_toe', 'left_toe')}
ANKLES = ('right_ankle', 'left_ankle')


def wrapped(angle):
    return np.angle(np.exp(1j * angle))


class Probe:
    """Reads an environment's state by names, with the engine's own functions."""

    def __init__(self, environment):
        self.environment, self.task = environment, environment.task
        self.spec = self.task.character.spec
        self.name, self.links = self.spec.name, self.spec.links
        self.named = environment.physics.named

    def body(self, field, link):
        return getattr(self.named.data, field)[f'{self.name}/{link}']

    def joint(self, name, field='qpos'):
        return getattr(self.named.data, field)[f'{self.name}/{name}']

    def velocity(self, link):
        """Angular velocity of a link and velocity of its centre of mass, world axes."""
        model, data = self.environment.physics.model.ptr, self.environment.physics.data.ptr
        result = np.zeros(6)
        body = model.body(f'{self.name}/{link}').id
        # Of the body's inertial frame, in world axes.
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, body, result, 0)
        return result[:3], result[3:]

    def centre_of_mass(self):
        """Position and velocity of the whole body's centre of mass."""
        mass = np.array([self.named.model.body_mass[f'{self.name}/{n}'] for n in self.links])
        centres = [self.body('xipos', n) for n in self.links]
        velocities = [self.velocity(n)[1] for n in self.links]
        return mass @ centres / mass.sum(), mass @ velocities / mass.sum()

    def terms(self, wanted):
        """Expected reward terms, for the probe of the reference."""
        found, wanted = self.features(), wanted.features()
        weights = np.array(RAW[self.name]) / np.sum(RAW[self.name])
        turned = [self.angle(*pair) for pair in zip(found['pose'], wanted['pose'], strict=True)]
        rates = [np.sum((a - b) ** 2) for a, b in zip(found['rates'], wanted['rates'], strict=True)]
        errors = {
            'pose': weights @ np.square(turned),
            'velocity': weights @ rates,
            'end_effector': np.mean(np.sum((found['feet'] - wanted['feet']) ** 2, axis=1)),
            'com': 0.1 * np.sum((found['com_velocity'] - wanted['com_velocity']) ** 2),
            'root': (found['height'] - wanted['height']) ** 2,
        }
        return {name: WEIGHTS[name] * np.exp(-SCALES[name] * e) for name, e in errors.items()}


class PlanarProbe(Probe):
    def __init__(self, environment):
        super().__init__(environment)
        strip = terrain.PlanarGround.from_state(self.task.arena.grounds[0].state())
        first, count = -400, 2400
        heights, _ = strip.window(first, count)
        self.ground = lambda x, y=0: np.interp(x, (first + np.arange(count)) * 0.025, heights)

    @property
    def root(self):
        return np.array([self.joint('root_x/')[0], 0, self.joint('root_z/')[0]])

    def blocks(self, view=np.linspace(-0.5, 3, 50), links=None):  # noqa: B008
        x, _, z = self.root
        facing = -1.0 if np.cos(self.joint('root_pitch/')[0]) < 0 else 1.0
        heading = np.array([facing, 1.0])
        under = self.ground(x)
        links = links or self.links
        centres = [(self.body('xipos', n) - self.root)[[0, 2]] * heading for n in links]
        velocities = [self.velocity(n)[1][[0, 2]] * heading for n in links]
        return {
            'terrain': self.ground(x + facing * view) - under,
            'pose': np.concatenate([[z - under], *centres]),
            'velocity': np.concatenate(velocities),
        }

    def angle(self, found, wanted):
        return wrapped(found - wanted)

    def features(self):
        com, velocity = self.centre_of_mass()
        names, feet = ['root_pitch/', *self.links[1:]], []
        for link in EFFECTORS.get(self.name, ANKLES):
            place = self.body('xpos', link)
            feet.append((place[0] - com[0], place[2] - self.ground(place[0])))
        return {
            'pose': [float(self.joint(n)[0]) for n in names],
            'rates': [float(self.joint(n, 'qvel')[0]) for n in names],
            'feet': np.array(feet),
            'com_velocity': velocity[[0, 2]],
            'height': self.root[2] - self.ground(self.root[0]),
        }


class SpatialProbe(Probe):
    def ground(self, x, y=0):
        return ground(self.environment, x, y)

    @property
    def root(self):
        return self.body('xpos', 'root')

    @property
    def heading(self):
        ahead = self.body('xmat', 'root').reshape(3, 3)[:, 0]
        return np.arctan2(ahead[1], ahead[0])

    def blocks(self):
        turn, root = flattened(self.heading), self.root
        under = float(self.ground(root[0], root[1]))
        pose, velocity = [root[2:] - under], []
        for link in self.links:
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

    def angle(self, found, wanted):
        if np.ndim(found) == 0:
            return found - wanted
        return np.arccos(np.clip((np.trace(found @ wanted.T) - 1) / 2, -1, 1))

    def features(self):
        turn, root = flattened(self.heading), self.root
        com, com_velocity = self.centre_of_mass()
        rotations = [turn @ self.body('xmat', 'root').reshape(3, 3)]
        rates = [turn @ self.velocity('root')[0]]
        for joint, ball in zip(self.spec.joints, self.task.character.spherical, strict=True):
            qpos, matrix = self.joint(joint), np.zeros(9)
            rates.append(self.joint(joint, 'qvel').copy())
            if ball:
                mujoco.mju_quat2Mat(matrix, qpos)
            rotations.append(matrix.reshape(3, 3) if ball else float(qpos[0]))
        feet = []
        for link in ANKLES:
            place = self.body('xpos', link)
            foot = turn @ (place - com)
            foot[2] = place[2] - self.ground(place[0], place[1])
            feet.append(foot)
        return {
            'pose': rotations, 'rates': rates, 'feet': np.array(feet), 'com_velocity': com_velocity,
            'height': root[2] - float(self.ground(root[0], root[1])),
        }  # fmt: skip


def probe(environment):
    spatial = environment.task.character.spec.spatial
    return (SpatialProbe if spatial else PlanarProbe)(environment)


def reference(environment):
    """A probe of the same character in the pose of the clip, by forward kinematics on level ground."""
    task, clip = environment.task, environment.task.clip
    spec = task.character.spec
    level = 'plane' if spec.spatial else 'flat'
    other = made(spec.name, 'position', level, 'imitation', clip.name)
    other.reset()
    time = float(task.phase[0]) * clip.duration
    pose = clip.pose(time)
    pose[: 2 if spec.spatial else 1] = 0
    put(other, pose, clip.velocity(time))
    return probe(other)


def begin_at(environment, phase):
    """Has episodes start at a phase, as the option would; None for what the option says."""
    task = environment.task
    task._start_phase = start_phases(task.config.start_phase if phase is None else phase)


def started(id_, steps=0, start_phase=None, **options):
    environment = made(id_, seed=8, step_limit=None, **options)
    begin_at(environment, start_phase)
    step = environment.reset()
    rng = np.random.default_rng(9)
    for _ in range(steps):
        step = environment.step(0.3 * rng.uniform(-1, 1, len(environment.action_map)))
        if step.last():
            step = environment.step(np.zeros(len(environment.action_map)))
    return environment, step


def observed_terms(environment):
    """Reward terms of the present state, which a start has as well."""
    environment.task.observe()
    return environment.info['reward_terms']


class ObservationTest(parameterized.TestCase):
    """Every block against named access and the engine's own velocities."""

    @parameterized.product(id_=EXAMPLES, steps=(0, 14))
    def test_terrain_pose_and_velocity(self, id_, steps):
        options = {'terrain_observation': 'height'} if id_ in SPATIAL else {}
        environment, step = started(id_, steps, **options)
        for name, expected in probe(environment).blocks().items():
            if name in step.observation:
                # Height grids are stored in single precision.
                near = 1e-6 if id_ in SPATIAL and (name == 'terrain' or id_ == HILLS) else 1e-9
                np.testing.assert_allclose(
                    step.observation[name], expected, rtol=0, atol=near, err_msg=name
                )

    @parameterized.parameters(DOG, RAPTOR, BIPED)
    def test_a_backward_heading_observes_the_ground_behind(self, id_):
        environment, _ = started(id_)
        data, name = environment.physics.named.data, environment.task.character.spec.name
        for pitch in (3.0, -2.5, 2 * np.pi + 0.1, -1.5):
            data.qpos[f'{name}/root_z/'] = 4.0
            data.qpos[f'{name}/root_x/'] = 2.6
            data.qpos[f'{name}/root_pitch/'] = pitch
            data.qvel[:] *= 0.1
            environment.physics.forward()
            step = environment.step(np.zeros(len(environment.action_map)))
            for block, value in probe(environment).blocks().items():
                np.testing.assert_allclose(step.observation[block], value, atol=1e-9)

    @parameterized.parameters(0.0, 1.0, 3.0, -2.5)
    def test_observation_does_not_depend_on_the_heading(self, heading):
        # On a plane pose and velocity stay the same when everything is turned and moved.
        environment, step = started(PLANE, 5)
        task, data, before = environment.task, environment.physics.data, step.observation
        pose, rate = data.qpos[task.body.pose_qpos], data.qvel[task.body.pose_dof]
        turned, half = np.zeros(4), heading / 2
        mujoco.mju_mulQuat(turned, np.array([np.cos(half), 0, 0, np.sin(half)]), pose[3:7])
        pose[:2], pose[3:7] = (3.0, -2.0), turned
        rate[:3] = flattened(heading).T @ rate[:3]  # the angular one is in the root's own axes
        put(environment, pose, rate)
        task.observe()
        for name in ('pose', 'velocity'):
            np.testing.assert_allclose(environment.observation()[name], before[name], atol=1e-9)

    @parameterized.parameters(DOG, RAPTOR, BIPED, PLANE, RUN)
    def test_phase(self, id_):
        environment, step = started(id_, start_phase=0.2)
        period, phase = environment.task.clip.duration, 0.2
        for _ in range(60):
            block = step.observation['phase']
            self.assertLess(abs((block[0] - phase + 0.5) % 1 - 0.5), 1e-8)
            self.assertTrue(0 <= block[0] < 1)
            np.testing.assert_array_equal(block[1:], np.eye(4)[int(4 * block[0])])
            step = environment.step(np.zeros(len(environment.action_map)))
            phase = 0.2 if step.first() else phase + 1 / 30 / period

    @parameterized.parameters(*((id_, steps) for id_ in (*PLANAR_IDS, TRACK) if 'LLC' in id_ or id_ == TRACK
                                for steps in ((0, 4) if id_ in (TRACK, FLAT) else (4,))))  # fmt: skip
    def test_target(self, id_, steps):
        environment, step = started(id_, steps)
        expected, target = reference(environment).blocks(), step.observation['reference']
        pose, velocity = expected['pose'], expected['velocity']
        if id_ == TRACK:  # of each link, where it is and how it moves, not how it is turned
            pose = np.append(pose[0], pose[1:].reshape(8, 7)[:, :3])
            velocity = velocity.reshape(8, 6)[:, :3].ravel()
        # The task interpolates a table of the clip, best where velocities are its slope.
        np.testing.assert_allclose(target[: len(pose)], pose, atol=1e-4)
        near = 2e-3 * max(np.abs(velocity).max(), 1) if id_ != TRACK else 5e-3
        np.testing.assert_allclose(target[len(pose) :], velocity, atol=near)

    @parameterized.parameters(
        (0.0, 0.0, 0.0), (5.0, 0.0, 0.0), (-2.0, 1.0, 0.0), (4.0, -3.0, 0.5), (0.5, 2.0, -3.0),
    )  # fmt: skip
    def test_goal_is_straight_ahead(self, x, y, heading):
        environment, _ = started(PLANE)
        task, data = environment.task, environment.physics.data
        pose, rate = data.qpos[task.body.pose_qpos], data.qvel[task.body.pose_dof]
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

    @parameterized.parameters(('biped3d', 17, 22), ('biped3d_full_mocap', 35, 45))
    def test_actions_of_the_original(self, character, size, original):
        for options, expected in (({}, size), ({'action_offset': 'original'}, original)):
            spec = suite.build(character, task_kwargs=options).action_spec()
            self.assertEqual(spec.shape, (expected,))

    def test_velocity_against_a_belt(self):
        """Observed velocities are relative to the belt on which a character stands."""
        for task_name in ('imitation', 'footsteps'):
            environment = suite.build(
                'biped3d_mocap', terrain='conveyor3d_wide', task=task_name,
                task_kwargs={'random': 2, 'start_phase': 0.1},
            )  # fmt: skip
            beside = environment.reset().observation
            task, data = environment.task, environment.physics.data
            belt = task.arena.grounds[0].layout.belts.velocity[0]
            self.assertAlmostEqual(np.linalg.norm(belt), 0.6)
            pose, rate = data.qpos[task.body.pose_qpos], data.qvel[task.body.pose_dof]
            pose[:3] += 5.5 - pose[0], -pose[1], 0.01  # the strip from x = 3 to 8 m, 1 cm high
            put(environment, pose, rate)
            task.arena.recentre(np.zeros(1, int), pose[None, :2])
            task.observe()
            upon, expected = environment.observation(), beside['velocity'].reshape(8, 6).copy()
            expected[:, :2] -= flattened(probe(environment).heading)[:2, :2] @ belt
            np.testing.assert_allclose(upon['velocity'].reshape(8, 6), expected, atol=1e-9)
            np.testing.assert_allclose(upon['pose'], beside['pose'], atol=1e-9)
            # The reward's velocity of the centre of mass is that of the world.
            com = next(term.weight for term in task.terms if term.name == 'com')
            self.assertAlmostEqual(observed_terms(environment)['com'], com, delta=2e-3)


class RewardTest(parameterized.TestCase):
    """The reward's worked values, and every term by hand."""

    @parameterized.product(id_=EXAMPLES, steps=(6, 12))
    def test_terms_in_a_rollout(self, id_, steps):
        environment, step = started(id_, steps)
        if step.first():  # it fell in the last of these steps
            step = environment.step(np.zeros(len(environment.action_map)))
        found, expected = (
            environment.info['reward_terms'],
            probe(environment).terms(reference(environment)),
        )
        for name, value in expected.items():
            # The task interpolates a table of the clip.
            self.assertAlmostEqual(found[name], value, delta=2e-3 * WEIGHTS[name], msg=name)
        self.assertAlmostEqual(step.reward, sum(expected.values()), delta=2e-3)

    @parameterized.parameters(0.9, -2.0)
    def test_only_the_centre_of_mass_term_depends_on_the_direction(self, heading):
        # The pose of the clip, all of it turned: heading is removed everywhere but in `com`.
        environment, _ = started(PLANE, start_phase=0.4)
        clip, turned = environment.task.clip, np.zeros(4)
        pose, rate = clip.pose(0.4 * clip.duration), clip.velocity(0.4 * clip.duration)
        about = np.array([np.cos(heading / 2), 0, 0, np.sin(heading / 2)])
        mujoco.mju_mulQuat(turned, about, pose[3:7])
        pose[3:7], rate[:3] = turned, flattened(heading).T @ rate[:3]
        put(environment, pose, rate)
        found, velocity = observed_terms(environment), probe(environment).features()['com_velocity']
        for name in ('pose', 'velocity', 'end_effector', 'root'):
            self.assertAlmostEqual(found[name], WEIGHTS[name], delta=1e-3 * WEIGHTS[name])
        # By a chord of the circle of its speed.
        error = (2 * np.sin(heading / 2)) ** 2 * np.sum(velocity[:2] ** 2)
        self.assertAlmostEqual(found['com'] / 0.2, np.exp(-error), delta=2e-3)

    def test_the_velocity_of_a_turning_clip_turns_in_every_cycle(self):
        clip = motion.load('biped3d_walk')
        angle, poses = np.linspace(0, 1, len(clip.times)), clip.poses.copy()
        poses[:, 3:7] = quaternion.multiply(quaternion.about_z(angle), poses[:, 3:7])
        ways = quaternion.rotate_xy(np.diff(poses[:, :2], axis=0), (angle[1:] + angle[:-1]) / 2)
        poses[1:, :2] = poses[0, :2] + np.cumsum(ways, axis=0)
        circle = dataclasses.replace(clip, poses=poses, turning=True)
        environment = made('biped3d', 'position', 'plane', 'imitation', circle)
        environment.reset()
        for cycles in (0.4, 1.4, 3.4):
            environment.task.clock.cycles[0], environment.task.clock.phase[0] = cycles, 0.4
            time = cycles * circle.duration
            pose = circle.pose(time)
            pose[:2] = 0
            put(environment, pose, circle.velocity(time))
            self.assertAlmostEqual(observed_terms(environment)['com'] / 0.2, 1, delta=2e-3)

    @parameterized.parameters(*((name, 0) for name in RAW), ('biped3d', 1))
    def test_a_joint_error_costs_its_weight(self, name, axis):
        environment = suite.build(name, task_kwargs={'random': 0, 'start_phase': 0.3})
        environment.reset()
        character, data = environment.task.character, environment.physics.named.data
        before, turn = observed_terms(environment)['pose'], np.zeros(4)
        mujoco.mju_axisAngle2Quat(turn, np.eye(3)[axis], 0.2)
        weights = np.array(RAW[name]) / np.sum(RAW[name])
        joints = list(character.spec.joints)
        balls = character.spherical.tolist()
        if not character.spec.spatial:
            joints, balls = ['root_pitch/', *joints], [False, *balls]
        for weight, joint, ball in zip(weights[-len(joints) :], joints, balls, strict=True):
            kept = data.qpos[f'{name}/{joint}'].copy()
            turned = kept + 0.2
            if ball:
                mujoco.mju_mulQuat(turned, kept, turn)
                turned = -turned  # the same rotation
            data.qpos[f'{name}/{joint}'] = turned
            environment.physics.forward()
            after = observed_terms(environment)['pose']
            data.qpos[f'{name}/{joint}'] = kept
            expected = np.exp(-2 * weight * 0.04)
            self.assertAlmostEqual(after / before, expected, delta=1e-3, msg=joint)
            self.assertLess(after, before)

    @parameterized.product(id_=(*CLIPS.values(), *EXAMPLES), phase=(0.31, 0.77))
    def test_the_reference_pose_has_full_reward(self, id_, phase):
        environment, _ = started(id_, start_phase=phase)
        clip, spatial = environment.task.clip, id_ in SPATIAL_IDS
        pose, level = clip.pose(phase * clip.duration), probe(environment).ground
        pose[: 2 if spatial else 1] = 0
        pose[2 if spatial else 1] += float(level(0.0))
        if not spatial and phase > 0.5:  # the pitch is that of a direction
            pose[2] += 2 * np.pi
        put(environment, pose, clip.velocity(phase * clip.duration))
        grid = np.linspace(-1.5, 1.5, 61)
        is_level = np.ptp(level(*np.meshgrid(grid, grid))) < 1e-12
        found = observed_terms(environment)
        for name, weight in WEIGHTS.items():
            if is_level or name != 'end_effector':  # feet are measured from the ground below each
                near = (2e-3 if spatial or name != 'velocity' else 2e-2) * weight
                self.assertAlmostEqual(found[name], weight, delta=near, msg=name)

    @parameterized.parameters(FLAT, PLANE)
    def test_standing_still_in_the_pose_of_a_walk(self, id_):
        environment, _ = started(id_)
        task, factors = environment.task, []
        environment.physics.data.qvel[:] = 0
        environment.physics.forward()
        for phase in np.linspace(0, 1, 40, endpoint=False):
            task.phase[0] = phase
            factors.append(observed_terms(environment)['com'] / 0.2)
        # exp(-speed^2) at the mean speed, for a speed of 1.535 m/s 0.095.
        speed = task.clip.speed if id_ == FLAT else 1.2
        self.assertAlmostEqual(np.mean(factors), np.exp(-(speed**2)), delta=0.03)


def corners(environment):
    """Corners of all boxes of the character, (boxes * 8, 3) m."""
    found = []
    for geom in environment.task.character.collision_geoms:
        bound = environment.physics.bind(geom)
        box = np.array(np.meshgrid(*[(-1, 1)] * 3)).reshape(3, 8).T * bound.size
        found.append(bound.xpos + box @ bound.xmat.reshape(3, 3).T)
    return np.concatenate(found)


class ResetTest(parameterized.TestCase):
    """Where and how episodes start."""

    @parameterized.parameters(*CLIPS.values(), *PLANAR, ('stairs3d', 'footsteps'), *zip(
        sorted(terrain.PRESETS3D), itertools.cycle(('imitation', 'footsteps'))))  # fmt: skip
    def test_on_the_ground_and_not_below(self, where, task=None):
        if task:
            environment = made('biped3d_mocap', None, where, task, terrain_observation='height')
        else:
            environment = made(where)
        environment.random_state.seed(31)
        for _ in range(4):
            environment.reset()
            found, places = probe(environment), corners(environment)
            clearance = (places[:, 2] - found.ground(*places[:, :2].T)).min()
            self.assertGreater(clearance, 0.0005)
            if task == 'footsteps':
                spawn = environment.task.travel.origin[0]
                np.testing.assert_allclose(found.root[:2], spawn[:2], atol=1e-12)
            else:
                np.testing.assert_array_equal(found.root[:2], 0)
                clip = environment.task.clip
                pose = clip.pose(float(environment.task.phase[0]) * clip.duration)
                height = 2 if environment.task.character.spec.spatial else 1
                lift = found.root[2] - pose[height] - found.ground(0.0)
                self.assertGreater(lift, -1e-5)  # only lifted, never lowered
                if lift > 1e-6:
                    self.assertLess(clearance, 0.002)
            step = environment.step(np.zeros(len(environment.action_map)))
            self.assertTrue(step.mid())
            for block in step.observation.values():
                self.assertTrue(np.isfinite(block).all())

    @parameterized.parameters(*PLANAR, PLANE)
    def test_pose_and_velocity_of_the_clip(self, id_):
        environment, _ = started(id_, start_phase=0.37)
        clip, figure = environment.task.clip, environment.task.body
        pose, rate = clip.pose(0.37 * clip.duration), clip.velocity(0.37 * clip.duration)
        data, first = environment.physics.data, 3 if id_ == PLANE else 2
        # In the plane the task interpolates a table of the clip.
        near = (1e-12, 1e-12) if id_ == PLANE else (1e-4, 0.01)
        np.testing.assert_allclose(data.qpos[figure.pose_qpos][first:], pose[first:], atol=near[0])
        np.testing.assert_allclose(data.qvel[figure.pose_dof], rate, atol=near[1])

    @parameterized.parameters(
        (FLAT, {}, ((0, 1),)),
        (PLANE, {}, ((0, 1),)),
        (BIPED, {'start_phase': ((0.1, 0.2), (0.5, 0.8))}, ((0.1, 0.2), (0.5, 0.8))),
        # A raptor with muscles starts in the air.
        ('MTU_Raptor2D_LLC_Imitate_Flat-v0', {}, ((0.25, 0.5), (0.75, 1.0))),
    )
    def test_phases_are_uniform(self, id_, options, ranges):
        environments = VectorEnvironment(id_, 400, 1, seed=5, task_kwargs=options)
        environments.reset()
        phases, begin = environments.task.phase, 0.0
        self.assertLess(phases.max(), 1)
        placed = np.full(len(phases), np.nan)
        for low, high in ranges:  # one after the other
            within = (phases >= low) & (phases < high)
            placed[within], begin = begin + phases[within] - low, begin + high - low
        assert_uniform(placed, 0, begin)

    @parameterized.parameters(BIPED, HILLS)
    def test_start_phase(self, id_):
        environment = made(id_, seed=8, start_phase=0.6)
        step = environment.reset()
        for _ in range(3):
            self.assertAlmostEqual(step.observation['phase'][0], 0.6, delta=1e-9)
            step = environment.reset()
        # The ground is redrawn, and does not depend on whether the phase is drawn or given.
        grounds, x = [], np.linspace(-5, 5, 9)
        for options in ({}, {'start_phase': 0.6}):
            other = suite.make(id_, {'random': 5, **options})
            other.reset()
            grounds.append(probe(other).ground(x, np.ones(9)))
        np.testing.assert_array_equal(*grounds)
        self.assertGreater(np.abs(probe(environment).ground(x, np.ones(9)) - grounds[0]).max(), 0)

    def test_spawn(self):
        """As intended, the ground is flat for a metre; where the original's segments meet, it may not be."""
        for spawn in ('intended', 'upstream'):
            environment, rough = made(SLOPES, spawn=spawn), 0
            for seed in range(8):
                environment.random_state.seed(seed)
                environment.reset()
                rough += np.ptp(probe(environment).ground(np.linspace(-1, 1, 81))) > 0
                for _ in range(10):
                    step = environment.step(np.zeros(20))
                    self.assertTrue(np.isfinite(step.observation['pose']).all())
            self.assertEqual(rough > 0, spawn == 'upstream')

    def test_the_original_sees_further_if_it_observes_no_ground(self):
        """Then its segments meet 3 m ahead, not 0.5 m behind."""
        for id_, there in ((SLOPES, -0.5), ('PD_Biped2D_Incline-v0', 3.0)):
            environment = made(id_, spawn='upstream', start_phase=0.0)
            environment.reset()
            self.assertAlmostEqual(environment.task._flat_part(0)['centre'], there)

    def test_terrain_level_selects_the_parameters(self):
        # Gaps of 0.1 to 0.25 m in the first set, of 0.5 to 1.5 m in the second.
        figures = ('biped2d', None, 'imitation'), ('dog', 'gait', 'gait')
        levels = (0.0, 0.1, 0.3), (1.0, 0.6, 1.4)
        for (figure, model, task), (level, low, high) in itertools.product(figures, levels):
            environment = build(
                suite.combine(figure, model, 'gaps_curriculum', task), {'terrain_level': level}
            )
            environment.reset()
            heights, vertical = environment.task.arena.grounds[0].window(0, 4000)
            edges = np.flatnonzero(vertical)
            widths = np.diff(edges)[heights[edges[:-1]] < -1]
            self.assertBetween(widths.mean() * 0.025, low, high)
        content = {'Type': 'var3d_checkers', 'Params': [{'Slope': 0.0}, {'Slope': 0.2}]}
        grid = np.meshgrid(np.linspace(-4, 4, 81), np.linspace(-4, 4, 81))
        for level, height in ((0.0, 0.0), (0.5, 0.1), (1.0, 0.2)):
            options = {'random': 0, 'terrain_level': level}
            environment = suite.build('biped3d', terrain=content, task_kwargs=options)
            environment.reset()
            self.assertAlmostEqual(np.ptp(ground(environment, *grid)), height, delta=1e-12)


class ClipTest(parameterized.TestCase):
    """What a task tells of its clip."""

    @parameterized.parameters(
        ('dog', 'position', {}), ('dog', 'velocity', {}), ('biped3d', 'position', {}),
        ('biped3d', 'position', {'action_offset': 'posture'}), ('biped3d', 'velocity', {}),
        ('biped3d', 'position', {'mirrored': True, 'start_phase': 0.6}),
    )  # fmt: skip
    def test_clip_action(self, character, actuation, options):
        environment = suite.build(character, actuation, task_kwargs={'random': 0, **options})
        environment.reset()
        task, clip = environment.task, environment.task.clip
        time = float(task.phase[0]) * clip.duration
        environment.step(task.clip_action(0))
        control = environment.physics.data.ctrl.copy()
        column = 7 if task.character.spec.spatial else 3
        expected = clip.velocity(time)[6 if column == 7 else 3 :]
        if actuation == 'position':
            expected = []
            for size in clip.sizes:
                part = clip.pose(time)[column : column + size]
                column += size
                if size == 4:
                    vector = np.zeros(3)
                    mujoco.mju_quat2Vel(vector, part, 1.0)
                    part = vector
                expected.append(part)
            expected = np.concatenate(expected)
        np.testing.assert_allclose(control, expected, atol=1e-9)

    @parameterized.parameters((FLAT, 0.3), (PLANE, 0.15))
    def test_reference_pose_walks_along(self, id_, near):
        environment, _ = started(id_, start_phase=0.25)
        task, x = environment.task, []
        for _ in range(90 if id_ == FLAT else 15):
            x.append(task.reference_pose(0)[0])
            if environment.step(task.clip_action(0)).last():
                break
        self.assertEqual(x[0], 0)
        speed = task.clip.speed if id_ == FLAT else 1.2
        self.assertAlmostEqual((x[-1] - x[0]) / (len(x) - 1) * 30, speed, delta=near)


START_PHASES = (
    1.0, -0.1, np.nan, 'early', (), (0.2, 0.4), ((0.4, 0.2),), ((0.2, 0.5), (0.4, 0.6)), ((0.5, 1.1),),
    ((0.1, 0.2), (0.3,)), (('a', 'b'),), ((0.1, np.nan),),
)  # fmt: skip
REFUSED = (
    *((id_, {'start_phase': value}, 'start_phase is') for id_ in (BIPED,) for value in START_PHASES),
    *((id_, options, message) for id_ in (BIPED, PLANE) for options, message in (
        ({'substeps': 3}, 'substeps is 3'),
        ({'action_offset': 'mean'}, "unknown action_offset 'mean'"),
        ({'action_scale': np.inf}, 'action_scale is inf'),
        ({'terrain_level': np.nan}, 'terrain_level is nan; expected a number'),
        ({'action_scale': 1.0, 'action_offset': 'original'}, 'takes no action_scale'),
        ({'plans': {}}, "unknown option.*'plans'"),
    )),
    (BIPED, {'terrain_observation': -1}, 'terrain_observation is -1'),
    (BIPED, {'spawn': 'nowhere'}, "spawn 'nowhere'"),
    (PLANE, {'substeps': 5}, 'substeps is 5'),
    (PLANE, {'mirrored': True, 'reference_observation': True}, 'mirrored observations need the phase'),
    (PLANE, {'terrain_observation': 50}, 'terrain_observation is 50; expected a string'),
)  # fmt: skip
DO_NOT_FIT = (  # arguments of `suite.build`
    (('raptor', None, None, 'imitation', 'dog_bound'), "'dog_bound'.*does not fit character 'raptor'"),
    (('biped2d', 'torque', None, 'imitation', None, {'action_scale': 1.0}), 'options of position control'),
    (('biped3d', 'torque', None, 'imitation', None, {'action_scale': 1.0}), 'options of position control'),
    (('biped3d', 'velocity', None, 'imitation', None, {'action_offset': 'posture'}), 'options of position control'),
    (('biped3d', None, None, 'imitation', 'biped2d_walk'), "'biped2d_walk'.*free root"),
    (('biped3d', None, None, 'imitation', 'biped3d_full_walk'),
     "'biped3d_full_walk'.*does not fit character 'biped3d'"),
    (('biped3d', 'muscle'), 'has no muscles'),
)  # fmt: skip


class OptionTest(parameterized.TestCase):
    def test_refused(self):
        walk = motion.load('biped2d_walk')
        once = motion.Clip('once', walk.times, walk.poses, 'planar', walk.joints, walk.sizes)
        sizes = (1, 4, 4, 4, 4, 1, 4)  # those of the torso and of the right knee are exchanged
        pose = [0, 0, 1, 1, 0, 0, 0] + [n for size in sizes for n in [1, 0, 0, 0][:size]]
        joints = motion.load('biped3d_walk').joints
        other = motion.Clip('other', (0, 1), [pose, pose], 'free', joints, sizes, loop=True)
        step = motion.load_steps('biped3d_mocap').clip(2)
        limp = [suite.build('dog', model) for model in ('torque', 'muscle')]
        limp.append(suite.build('biped3d', 'torque'))
        assert_refused(
            self,
            *((lambda i=i, o=o: suite.make(i, o), message) for i, o, message in REFUSED),
            *((lambda a=a: suite.build(*a), message) for a, message in DO_NOT_FIT),
            (lambda: suite.build('biped2d', clip=once), 'does not loop'),
            (lambda: suite.build('biped3d', clip=other), "for its joints; character 'biped3d' has"),
            (lambda: suite.build('biped3d_mocap', clip=step), 'not looping'),
            *((lambda e=e: e.reset() and e.task.clip_action(0), 'cannot follow a clip open loop') for e in limp),
        )  # fmt: skip
