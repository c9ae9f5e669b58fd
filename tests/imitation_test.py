"""Tests of the imitation task: observation, reward and reset, recomputed independently."""

import mujoco
import numpy as np
from absl.testing import absltest, parameterized
from helpers import made

from trl_suite import characters, motion, suite, terrain
from trl_suite.arenas import PlanarArena
from trl_suite.environments.environment import Environment
from trl_suite.tasks import terms
from trl_suite.tasks.common import rewards
from trl_suite.tasks.imitation.task import PlanarImitation, PlanarImitationConfig
from trl_suite.vector import VectorEnvironment

# One of each figure; the dog's links stand in another order than the engine's bodies.
DOG, RAPTOR = 'PD_Dog2D_Slopes_Mixed_Terrain-v0', 'PD_Raptor2D_Slopes_Terrain-v0'
BIPED, MUSCLES = 'PD_Biped2D_Gaps_Terrain-v0', 'MTU_Dog2D_LLC_Imitate_Flat-v0'
IDS = [id_ for id_ in suite.ALL_IDS if suite.find(id_).task_type == 'planar_imitation']
EXAMPLES = (
    DOG, RAPTOR, BIPED, MUSCLES, 'Torque_Raptor2D_LLC_Imitate_Flat-v0', 'PD_Biped2D_Incline-v0',
    'PD_Biped2D_LLC_Imitate_Run_Flat-v0',
)  # fmt: skip
WEIGHTS = {'pose': 0.5, 'velocity': 0.05, 'end_effector': 0.15, 'com': 0.2, 'root': 0.1}
SCALES = {'pose': 2, 'velocity': 0.005, 'end_effector': 40, 'com': 10, 'root': 10}
# Raw reward weights: root, then joints in link order.
RAW = {
    'dog': [1] + [0.5] * 4 + [1] + [0.2] * 3 + [0.001] * 4 + [1] * 8,
    'raptor': [1] + [0.5] * 5 + [0.25] * 5 + 2 * [1, 0.5, 0.5, 0.5],
    'biped2d': [1] + 2 * [0.3, 0.3, 0.2],
    'biped2d_full': [1] + 2 * [0.3, 0.3, 0.2] + [0.3] * 5,
}
EFFECTORS = {
    'dog': ('finger', 'toe'), 'raptor': ('right_toe', 'left_toe'),
    'biped2d': ('right_ankle', 'left_ankle'), 'biped2d_full': ('right_ankle', 'left_ankle'),
}  # fmt: skip


class Probe:
    """Reads an environment's state by names, with the engine's own functions."""

    def __init__(self, environment):
        self.environment, self.task = environment, environment.task
        self.name = self.task.character.spec.name
        self.links = self.task.character.spec.links
        self.named = environment.physics.named
        self.strip = terrain.PlanarGround.from_state(self.task.arena.grounds[0].state())
        first, count = -400, 2400
        heights, _ = self.strip.window(first, count)
        self.ground = lambda x: np.interp(x, (first + np.arange(count)) * 0.025, heights)

    def qpos(self, joint):
        return float(self.named.data.qpos[f'{self.name}/{joint}'][0])

    def qvel(self, joint):
        return float(self.named.data.qvel[f'{self.name}/{joint}'][0])

    @property
    def root(self):
        return np.array([self.qpos('root_x/'), self.qpos('root_z/')])

    @property
    def facing(self):
        return -1.0 if np.cos(self.qpos('root_pitch/')) < 0 else 1.0

    def velocity(self, link):
        """Velocity of a link's centre of mass, world axes, x and z."""
        model, data = self.environment.physics.model.ptr, self.environment.physics.data.ptr
        result = np.zeros(6)
        body = model.body(f'{self.name}/{link}').id
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, body, result, 0)
        return result[[3, 5]]  # of the body's inertial frame, axes of the world

    def blocks(self):
        x, z = self.root
        heading = np.array([self.facing, 1.0])
        under = self.ground(x)
        samples = x + self.facing * np.linspace(-0.5, 3, 50)
        centres = [self.named.data.xipos[f'{self.name}/{n}'][[0, 2]] for n in self.links]
        return {
            'terrain': self.ground(samples) - under,
            'pose': np.concatenate([[z - under], *((c - self.root) * heading for c in centres)]),
            'velocity': np.concatenate([self.velocity(n) * heading for n in self.links]),
        }

    def centre_of_mass(self):
        """Position and velocity of the whole body's centre of mass."""
        mass = np.array([self.named.model.body_mass[f'{self.name}/{n}'] for n in self.links])
        centres = [self.named.data.xipos[f'{self.name}/{n}'][[0, 2]] for n in self.links]
        velocities = [self.velocity(n) for n in self.links]
        return mass @ centres / mass.sum(), mass @ velocities / mass.sum()

    def reward_features(self):
        joints = self.links[1:]
        com, velocity = self.centre_of_mass()
        x, z = self.root
        effectors = []
        for link in EFFECTORS[self.name]:
            place = self.named.data.xpos[f'{self.name}/{link}']
            effectors.append((place[0] - com[0], place[2] - self.ground(place[0])))
        return {
            'angles': np.array([self.qpos('root_pitch/'), *map(self.qpos, joints)]),
            'rates': np.array([self.qvel('root_pitch/'), *map(self.qvel, joints)]),
            'effectors': np.array(effectors),
            'com_velocity': velocity,
            'height': z - self.ground(x),
        }


class Reference:
    """The clip on the same character, by forward kinematics on flat ground."""

    def __init__(self, environment):
        task = environment.task
        config = PlanarImitationConfig(reference_observation=task.actuation_model == 'muscle')
        self.clip = task.clip
        spec = task.character.spec
        other = PlanarImitation(
            characters.make(spec.name), PlanarArena(terrain.load('flat')), self.clip,
            config, actuation_model=task.actuation_model,
        )  # fmt: skip
        self.environment = Environment(other, random=0)
        self.environment.reset()
        self.probe = Probe(self.environment)

    def at(self, phase):
        time = phase * self.clip.duration
        pose, rate = self.clip.pose(time), self.clip.velocity(time)
        data, name = self.probe.named.data, self.probe.name
        names = ['root_x/', 'root_z/', 'root_pitch/', *self.probe.links[1:]]
        for i, joint in enumerate(names):
            data.qpos[f'{name}/{joint}'] = 0 if i == 0 else pose[i]
            data.qvel[f'{name}/{joint}'] = rate[i]
        self.environment.physics.forward()
        return self.probe


def started(id_, steps=0, **options):
    environment = made(id_, seed=8, step_limit=None, **options)
    step = environment.reset()
    rng = np.random.default_rng(9)
    for _ in range(steps):
        step = environment.step(0.3 * rng.uniform(-1, 1, len(environment.action_map)))
        if step.last():
            step = environment.step(np.zeros(len(environment.action_map)))
    return environment, step


class ObservationTest(parameterized.TestCase):
    """Every block against named access and the engine's own velocities."""

    @parameterized.parameters(*((id_, steps) for id_ in EXAMPLES for steps in (0, 5, 23)))
    def test_terrain_pose_and_velocity(self, id_, steps):
        environment, step = started(id_, steps)
        expected = Probe(environment).blocks()
        for name in ('terrain', 'pose', 'velocity'):
            if name in step.observation:
                np.testing.assert_allclose(
                    step.observation[name], expected[name], atol=1e-9, err_msg=name
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
            expected = Probe(environment).blocks()
            for block, value in expected.items():
                np.testing.assert_allclose(step.observation[block], value, atol=1e-9)

    @parameterized.parameters(DOG, RAPTOR, BIPED)
    def test_phase(self, id_):
        environment, step = started(id_, start_phase=0.2)
        period = environment.task.clip.duration
        phase = 0.2
        for _ in range(60):
            block = step.observation['phase']
            self.assertLess(abs((block[0] - phase + 0.5) % 1 - 0.5), 1e-9)
            self.assertTrue(0 <= block[0] < 1)
            np.testing.assert_array_equal(block[1:], np.eye(4)[int(4 * block[0])])
            step = environment.step(np.zeros(len(environment.action_map)))
            phase = 0.2 if step.first() else phase + 1 / 30 / period

    @parameterized.parameters(*(id_ for id_ in IDS if 'LLC' in id_))
    def test_target(self, id_):
        environment, step = started(id_, 4)
        probe = Reference(environment).at(float(environment.task.phase[0]))
        expected = probe.blocks()
        links = len(probe.links)
        target = step.observation['reference']
        np.testing.assert_allclose(target[: 2 * links + 1], expected['pose'], atol=1e-4)
        scale = np.abs(expected['velocity']).max()
        np.testing.assert_allclose(
            target[2 * links + 1 :], expected['velocity'], atol=2e-3 * max(scale, 1)
        )

    def test_target_is_observed_after_reset(self):
        environment, step = started('PD_Biped2D_LLC_Imitate_Flat-v0')
        probe = Reference(environment).at(float(environment.task.phase[0]))
        np.testing.assert_allclose(
            step.observation['reference'][:15], probe.blocks()['pose'], atol=1e-4
        )

    def test_observation_sizes_of_the_documentation(self):
        blocks = suite.make('PD_Biped2D_Gaps_Terrain-v0').blocks
        self.assertEqual(blocks['terrain'], slice(0, 50))
        self.assertEqual(blocks['pose'], slice(50, 75))  # height, then 12 pairs
        self.assertEqual(blocks['velocity'], slice(75, 99))
        self.assertEqual(blocks['phase'], slice(99, 104))
        blocks = suite.make('Torque_Raptor2D_LLC_Imitate_Flat-v0').blocks
        self.assertEqual(blocks['pose'], slice(0, 39))
        self.assertEqual(blocks['velocity'], slice(39, 77))
        self.assertEqual(blocks['reference'], slice(77, 154))


def observed_terms(environment):
    """Reward terms of the present state, which a start has as well."""
    environment.task.observe()
    return environment.info['reward_terms']


class RewardTest(parameterized.TestCase):
    """The reward's worked values, and every term by hand."""

    @parameterized.parameters(
        # The errors of: perfect tracking; every joint and the root off by 0.2 rad; every rate by
        # 2 rad/s; each foot by 0.1 m; the root by 0.1 m; the com's velocity by 1 m/s.
        ((0, 0, 0, 0, 0), 'pose', 1.0), ((0.04, 0, 0, 0, 0), 'pose', 0.923),
        ((0, 4, 0, 0, 0), 'velocity', 0.980), ((0, 0, 0.01, 0, 0), 'end_effector', 0.670),
        ((0, 0, 0, 0, 0.01), 'root', 0.905), ((0, 0, 0, 0.1, 0), 'com', 0.368),
    )  # fmt: skip
    def test_worked_values(self, errors, term, factor):
        outcome = terms.outcome(1, 0, len(errors))
        data = terms.terms_data(rewards.IMITATION_TERMS)
        for name, error in zip(data._fields, errors, strict=True):
            terms.score(0, float(error), getattr(data, name), outcome)
        found = dict(zip(data._fields, outcome.reward_terms[0].tolist(), strict=True))
        self.assertAlmostEqual(found[term] / WEIGHTS[term], factor, delta=5e-4)
        for other in set(found) - {term}:
            self.assertAlmostEqual(found[other], WEIGHTS[other], delta=1e-12)

    def test_weights_and_scales(self):
        self.assertEqual({each.name: each.weight for each in rewards.IMITATION_TERMS}, WEIGHTS)
        self.assertEqual({each.name: each.scale for each in rewards.IMITATION_TERMS}, SCALES)
        self.assertAlmostEqual(sum(WEIGHTS.values()), 1, delta=1e-12)

    def test_joint_angles_are_wrapped(self):
        angles = np.array([0.3, -3.0, 2 * np.pi + 0.3, -7.0, 3 * np.pi + 0.1])
        expected = np.angle(np.exp(1j * angles))
        found = [terms.wrapped(angle) for angle in angles]
        np.testing.assert_allclose(found, expected, atol=1e-12)

    def by_hand(self, environment):
        task = environment.task
        name = task.character.spec.name
        found = Probe(environment).reward_features()
        wanted = Reference(environment).at(float(task.phase[0])).reward_features()
        weights = np.array(RAW[name]) / np.sum(RAW[name])
        turned = found['angles'] - wanted['angles']
        turned[0] = np.angle(np.exp(1j * turned[0]))  # the trunk's shortest rotation
        errors = {
            'pose': weights @ turned**2,
            'velocity': weights @ (found['rates'] - wanted['rates']) ** 2,
            'end_effector': np.mean(
                np.sum((found['effectors'] - wanted['effectors']) ** 2, axis=1)
            ),
            'com': 0.1 * np.sum((found['com_velocity'] - wanted['com_velocity']) ** 2),
            'root': (found['height'] - wanted['height']) ** 2,
        }
        return {name: WEIGHTS[name] * np.exp(-SCALES[name] * e) for name, e in errors.items()}

    @parameterized.parameters(*((id_, steps) for id_ in EXAMPLES for steps in (1, 6)))
    def test_terms_in_a_rollout(self, id_, steps):
        environment, step = started(id_, steps)
        self.assertTrue(step.mid())
        terms, expected = environment.info['reward_terms'], self.by_hand(environment)
        for name, value in expected.items():
            # The task interpolates a table of the clip.
            self.assertAlmostEqual(terms[name], value, delta=2e-3 * WEIGHTS[name], msg=name)
        self.assertAlmostEqual(step.reward, sum(expected.values()), delta=2e-3)

    @parameterized.parameters('dog', 'raptor', 'biped2d', 'biped2d_full')
    def test_a_joint_error_costs_its_weight(self, name):
        environment = suite.build(name, task_kwargs={'random': 0, 'start_phase': 0.3})
        environment.reset()
        task, data = environment.task, environment.physics.named.data
        task.observe()
        before = observed_terms(environment)['pose']
        weights = np.array(RAW[name]) / np.sum(RAW[name])
        for i, joint in enumerate(('root_pitch/', *task.character.spec.joints)):
            data.qpos[f'{name}/{joint}'] += 0.2
            environment.physics.forward()
            task.observe()
            after = observed_terms(environment)['pose']
            data.qpos[f'{name}/{joint}'] -= 0.2
            self.assertAlmostEqual(
                after / before, np.exp(-2 * weights[i] * 0.04), delta=1e-3, msg=joint
            )
            self.assertLess(after, before)

    @parameterized.parameters(*IDS)
    def test_a_start_has_almost_full_reward(self, id_):
        environment = made(id_, seed=21)
        for _ in range(3):
            environment.reset()
            # No reward is given for a reset.
            self.assertEqual(set(environment.info['reward_terms'].values()), {0.0})
            start = observed_terms(environment)
            self.assertAlmostEqual(start['pose'], 0.5, delta=1e-3)
            self.assertAlmostEqual(start['velocity'], 0.05, delta=1e-3)
            self.assertAlmostEqual(start['com'], 0.2, delta=2e-3)
            # Lifted by a centimetre at most.
            self.assertGreater(start['root'], 0.1 * np.exp(-10 * 0.01**2) - 1e-6)
            self.assertGreater(start['end_effector'], 0.15 * np.exp(-40 * 0.01**2) - 1e-4)

    def test_standing_still_in_the_pose_of_a_walk(self):
        environment = suite.make('PD_Biped2D_LLC_Imitate_Flat-v0', {'random': 0})
        environment.reset()
        task, speed = environment.task, environment.task.clip.speed
        environment.physics.data.qvel[:] = 0
        environment.physics.forward()
        factors = []
        for phase in np.linspace(0, 1, 40, endpoint=False):
            task.phase[0] = phase
            task.observe()
            factors.append(observed_terms(environment)['com'] / 0.2)
        # exp(-speed^2) at the mean speed, for a speed of 1.535 m/s 0.095.
        self.assertAlmostEqual(np.mean(factors), np.exp(-(speed**2)), delta=0.03)


class ResetTest(parameterized.TestCase):
    """Where and how episodes start."""

    def test_phases_are_uniform(self):
        environment = suite.make('PD_Biped2D_LLC_Imitate_Flat-v0', {'random': 0})
        phases = []
        for _ in range(800):
            environment.reset()
            phases.append(float(environment.task.phase[0]))
        phases = np.sort(phases)
        self.assertTrue((phases >= 0).all() and (phases < 1).all())
        # Kolmogorov-Smirnov at a significance of 1 in 1000.
        distance = np.abs(phases - (np.arange(800) + 0.5) / 800).max()
        self.assertLess(distance, 1.95 / np.sqrt(800))

    @parameterized.parameters(*IDS)
    def test_on_the_ground_and_not_below(self, id_):
        environment = made(id_, seed=31)
        for _ in range(4):
            environment.reset()
            probe = Probe(environment)
            self.assertEqual(probe.root[0], 0)
            clearance = []
            physics = environment.physics
            for geom in environment.task.character.collision_geoms:
                bound = physics.bind(geom)
                corners = np.array(np.meshgrid(*[(-1, 1)] * 3)).reshape(3, 8).T * bound.size
                corners = bound.xpos + corners @ bound.xmat.reshape(3, 3).T
                clearance.append((corners[:, 2] - probe.ground(corners[:, 0])).min())
            self.assertGreater(min(clearance), 0.0005)
            # Only lifted, never lowered; the ground about the start is level.
            clip = environment.task.clip
            pose = clip.pose(float(environment.task.phase[0]) * clip.duration)
            lift = probe.root[1] - pose[1] - probe.ground(0.0)
            self.assertGreater(lift, -1e-5)  # the reference is tabulated
            if lift > 1e-9:
                self.assertLess(min(clearance), 0.002)
            data, model = physics.data.ptr, physics.model.ptr
            contacts = model.geom_bodyid[data.contact.geom]
            self.assertFalse((contacts == 0).any())  # the world's, the ground

    @parameterized.parameters(*EXAMPLES)
    def test_pose_and_velocity_of_the_clip(self, id_):
        environment, _ = started(id_, start_phase=0.37)
        clip, probe = environment.task.clip, Probe(environment)
        pose, rate = clip.pose(0.37 * clip.duration), clip.velocity(0.37 * clip.duration)
        names = ['root_x/', 'root_z/', 'root_pitch/', *probe.links[1:]]
        # The task interpolates a table of the clip.
        np.testing.assert_allclose([probe.qpos(n) for n in names[2:]], pose[2:], atol=1e-4)
        np.testing.assert_allclose([probe.qvel(n) for n in names], rate, atol=0.01)

    def test_start_phase(self):
        environment, step = started(BIPED, start_phase=0.6)
        for _ in range(3):
            self.assertAlmostEqual(step.observation['phase'][0], 0.6, delta=1e-12)
            step = environment.reset()
        bad_pairs = ((), (0.2, 0.4), ((0.4, 0.2),), ((0.2, 0.5), (0.4, 0.6)), ((0.5, 1.1),))
        bad_pairs = (*bad_pairs, ((0.1, 0.2), (0.3,)), (('a', 'b'),), ((0.1, np.nan),))
        for bad in (1.0, -0.1, np.nan, 'early', *bad_pairs):
            with self.assertRaisesRegex(ValueError, 'start_phase is'):
                suite.make(BIPED, {'start_phase': bad})

    def test_ranges_of_start_phases(self):
        pairs = ((0.1, 0.2), (0.5, 0.8))
        specs = VectorEnvironment(BIPED, 400, 1, 5, task_kwargs={'start_phase': pairs})
        specs.reset()
        phases = specs.task.phase
        first, second = ((phases >= low) & (phases < high) for low, high in pairs)
        self.assertTrue((first | second).all())
        self.assertAlmostEqual(first.mean(), 0.25, delta=0.07)  # 3 standard deviations
        self.assertAlmostEqual(phases[second].mean(), 0.65, delta=0.02)

    def test_raptor_with_muscles_starts_in_the_air(self):
        specs = VectorEnvironment('MTU_Raptor2D_LLC_Imitate_Flat-v0', 64, 1, 5)
        specs.reset()
        self.assertTrue((specs.task.phase % 0.5 >= 0.25).all())

    def test_terrain_is_redrawn_at_reset(self):
        environment = suite.make('PD_Dog2D_Slopes_Terrain-v0', {'random': 3})
        first, second = (environment.reset().observation['terrain'] for _ in range(2))
        self.assertGreater(np.abs(first - second).max(), 1e-3)

    @parameterized.parameters(*EXAMPLES)
    def test_seeds(self, id_):
        def episode(seed):
            environment = made(id_, seed=seed, flat=True)
            steps = [environment.reset()] + [
                environment.step(np.zeros(len(environment.action_map))) for _ in range(20)
            ]
            return np.array([step.observation['observations'] for step in steps])

        np.testing.assert_array_equal(episode(1), episode(1))
        self.assertTrue((episode(1) != episode(2)).any())

    def test_intended_spawn_is_flat_for_a_metre(self):
        for seed in range(5):
            environment = made('PD_Dog2D_Slopes_Terrain-v0', seed=seed)
            environment.reset()
            heights = Probe(environment).ground(np.linspace(-1, 1, 81))
            np.testing.assert_array_equal(heights, 0)

    def test_upstream_spawn(self):
        # Where the original's segments meet depends on the phase; ground is level there or not.
        rough = 0
        for seed in range(8):
            environment = suite.make(
                'PD_Dog2D_Slopes_Terrain-v0', {'random': seed, 'spawn': 'upstream'}
            )
            environment.reset()
            heights = Probe(environment).ground(np.linspace(-1, 1, 81))
            rough += np.ptp(heights) > 0
            for _ in range(30):
                step = environment.step(np.zeros(20))
                self.assertTrue(np.isfinite(step.observation['pose']).all())
        self.assertGreater(rough, 0)
        with self.assertRaisesRegex(ValueError, 'spawn'):
            suite.make('PD_Dog2D_Slopes_Terrain-v0', {'spawn': 'nowhere'}).reset()

    def test_terrain_level_selects_the_parameters(self):
        reached = []
        for terrain_level in (0.0, 1.0):
            environment = suite.build(
                'biped2d',
                terrain='gaps_curriculum',
                task_kwargs={'random': 0, 'terrain_level': terrain_level},
            )
            environment.reset()
            heights, vertical = environment.task.arena.grounds[0].window(0, 4000)
            edges = np.flatnonzero(vertical)
            widths = np.diff(edges)[heights[edges[:-1]] < -1]
            reached.append(widths.mean() * 0.025)
        # 0.1 to 0.25 m in the first set, 0.5 to 1.5 m in the second.
        self.assertBetween(reached[0], 0.1, 0.3)
        self.assertBetween(reached[1], 0.6, 1.4)


class HelperTest(parameterized.TestCase):
    """What a task tells beyond the time step."""

    @parameterized.parameters('PD_Dog2D_LLC_Imitate_Flat-v0', 'Vel_Dog2D_LLC_Imitate_Flat-v0')
    def test_clip_action(self, id_):
        environment, _ = started(id_, 3)
        task, clip = environment.task, environment.task.clip
        time = float(task.phase[0]) * clip.duration
        wanted = (clip.pose if id_.startswith('PD') else clip.velocity)(time)[3:]
        control = task.action_map.action_offset + task.action_map.action_scale * task.clip_action(0)
        np.testing.assert_allclose(control, wanted, atol=1e-12)

    @parameterized.parameters('Torque_Dog2D_LLC_Imitate_Flat-v0', MUSCLES)
    def test_no_clip_action(self, id_):
        environment, _ = started(id_)
        with self.assertRaisesRegex(ValueError, 'cannot follow a clip open loop'):
            environment.task.clip_action(0)

    def test_reference_pose_walks_along(self):
        environment, _ = started('PD_Biped2D_LLC_Imitate_Flat-v0', start_phase=0.25)
        task = environment.task
        x = []
        for _ in range(90):
            x.append(task.reference_pose(0)[0])
            if environment.step(task.clip_action(0)).last():
                break
        self.assertEqual(x[0], 0)
        speed = (x[-1] - x[0]) / (len(x) - 1) * 30
        self.assertAlmostEqual(speed, task.clip.speed, delta=0.3)

    @parameterized.parameters(
        ({'terrain_observation': 1}, 'terrain_observation'), ({'terrain_observation': -1}, 'terrain_observation'),
        ({'substeps': 3}, 'substeps'), ({'substeps': 4.5}, 'substeps'), ({'action_offset': 'mean'}, 'action_offset'),
        ({'action_scale': 0}, 'action_scale'), ({'action_scale': np.inf}, 'action_scale'),
    )  # fmt: skip
    def test_options_out_of_range(self, options, message):
        with self.assertRaisesRegex(ValueError, message):
            suite.make(BIPED, options)

    def test_clips_that_do_not_fit_are_rejected(self):
        with self.assertRaisesRegex(ValueError, "'dog_bound'.*does not fit character 'raptor'"):
            suite.build('raptor', clip='dog_bound')
        clip = motion.load('biped2d_walk')
        once = motion.Clip('once', clip.times, clip.poses, 'planar', clip.joints, clip.sizes)
        with self.assertRaisesRegex(ValueError, 'does not loop'):
            suite.build('biped2d', clip=once)
        with self.assertRaisesRegex(ValueError, 'options of position control'):
            suite.build('biped2d', 'torque', task_kwargs={'action_scale': 1.0})


if __name__ == '__main__':
    absltest.main()
