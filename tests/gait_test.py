"""Tests of the gait task: observation, reward, falls and cycles, recomputed independently."""

import ctypes
import dataclasses

import mujoco
import numpy as np
from absl.testing import absltest, parameterized
from helpers import assert_refused, links_on_ground, made

from trl_suite import controllers, suite, terrain
from trl_suite.engine import native
from trl_suite.vector import VectorEnvironment

# One of each character, on ground with many features in view.
DOG, GOAT = 'FSM_Dog2D_Terrain_Slopes_Mixed-v0', 'FSM_Goat2D_Terrain_Variable_Steps-v0'
RAPTOR, BIPED = 'FSM_Raptor2D_Terrain_Mixed-v0', 'FSM_Biped2D_Terrain_Slopes-v0'
HOPPER = 'FSM_Hopper2D_Terrain_Mixed_Easy-v0'
EXAMPLES = (DOG, GOAT, RAPTOR, BIPED, HOPPER)
EXEMPT = {  # links that may touch the ground without a stumble
    DOG: ('toe', 'finger', 'ankle', 'wrist'), HOPPER: ('leg',),
    RAPTOR: ('right_toe', 'left_toe', 'right_ankle', 'left_ankle'),
    BIPED: ('right_ankle', 'left_ankle', 'right_knee', 'left_knee'),
}  # fmt: skip
EXEMPT[GOAT] = EXEMPT[DOG]
TARGETS = {DOG: 4.0, GOAT: 2.0, RAPTOR: 4.0, BIPED: 3.0, HOPPER: 3.0}
# x, z, pitch rate of the root at the start.
STARTS = {
    DOG: (5.49344, -0.45159, 18.182892), RAPTOR: (3.760084, -0.320445, 0.369261),
    BIPED: (3.0, 0.0, 0.0), HOPPER: (2.813878, -1.714547, 0.100682),
}  # fmt: skip
STEP = 1 / 600  # s, of the control


def make(id_, seed=0, fresh=False, **options):
    """An environment after a reset; fresh if the test changes more than the state."""
    own = suite.make(id_, {'random': seed, **options}) if fresh else None
    environment = own or made(id_, seed=seed, **options)
    environment.reset()
    return environment


def idle(environment):
    return np.zeros(len(environment.action_map))


def on_flat(id_):
    return dataclasses.replace(suite.find(id_), terrain='flat')


def around_physics(environment, before=None, after=None):
    """Has functions called in the midst of a step, around the physics of each control step."""
    functions = environment.task.world.engine.functions
    kind = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p)

    def wrapped(number, first, last):
        original = kind(int(functions[number]))

        def call(model, data):
            if first:
                first()
            original(model, data)
            if last:
                last()

        return kind(call)

    # Where its physics begins and ends, see `native.step`.
    calls = {
        native.STEP2: wrapped(native.STEP2, before, None),
        native.STEP1: wrapped(native.STEP1, None, after),
    }
    for number, call in calls.items():
        functions[number] = ctypes.cast(call, ctypes.c_void_p).value
    environment.calls = calls  # keeps it alive


class Probe:
    """Reads an environment's state by names, with the engine's own functions."""

    def __init__(self, environment):
        self.environment, self.task = environment, environment.task
        self.model, self.data = environment.physics.model.ptr, environment.physics.data.ptr
        self.spec = self.task.character.spec
        self.name, self.links = self.spec.name, self.spec.links

    def body(self, link):
        return self.model.body(f'{self.name}/{link}').id

    def joint(self, name):
        joint = self.model.joint(f'{self.name}/{name}')
        return self.data.qpos[joint.qposadr[0]], self.data.qvel[joint.dofadr[0]]

    @property
    def root(self):
        return np.array([self.joint('root_x/')[0], self.joint('root_z/')[0]])

    def velocity(self, link):
        result = np.zeros(6)
        mujoco.mj_objectVelocity(
            self.model, self.data, mujoco.mjtObj.mjOBJ_BODY, self.body(link), result, 0
        )
        return result[[3, 5]]

    def touching(self):
        return links_on_ground(self.environment)

    def observation(self, left_stance):
        x, z = self.root
        facing = -1.0 if np.cos(self.joint('root_pitch/')[0]) < 0 else 1.0
        strip = terrain.PlanarGround.from_state(self.task.arena.grounds[0].state())
        under = strip.height([x])
        heading = np.array([facing, 1.0])
        order = list(self.links)
        if left_stance:
            swap = {'right': 'left', 'left': 'right'}
            order = ['_'.join([swap.get(part, part) for part in link.split('_')]) for link in order]
        centres = {n: (self.data.xipos[self.body(n)][[0, 2]] - (x, z)) * heading for n in order}
        pose = np.concatenate([z - under, *(centres[link] for link in order[1:])])
        velocity = np.concatenate([self.velocity(link) * heading for link in order])
        if self.name == 'hopper':
            pose[-1], velocity[-1] = self.joint('root_pitch/')
        samples = x + facing * (-0.5 + 10.5 * np.arange(200) / 199)
        return {'terrain': strip.height(samples) - under, 'pose': pose, 'velocity': velocity}

    def com(self):
        masses = [self.model.body_mass[self.body(link)] for link in self.links]
        centres = [self.data.xipos[self.body(link)][0] for link in self.links]
        return float(np.dot(masses, centres) / sum(masses))


class ObservationTest(parameterized.TestCase):
    """Blocks and their contents."""

    @parameterized.parameters(*EXAMPLES)
    def test_contents(self, id_):
        environment = make(id_, seed=3)
        probe, left = Probe(environment), False
        rng = np.random.default_rng(0)
        step, seen = environment.reset(), set()
        for _ in range(6):
            for name, expected in probe.observation(left).items():
                np.testing.assert_allclose(
                    step.observation[name], expected, atol=1e-9, err_msg=name
                )
            if step.last():
                break
            seen.add(left)
            step = environment.step(0.1 * rng.uniform(-1, 1, len(environment.action_map)))
            if id_ in (RAPTOR, BIPED) and step.mid():  # a cycle is a step of one leg
                left = not left
        self.assertLen(seen, 2 if id_ in (RAPTOR, BIPED) else 1)
        self.assertGreater(np.ptp(step.observation['terrain']), 0.05)

    def test_the_last_numbers_of_the_hopper(self):
        environment = make(HOPPER, start_noise=0.0)
        observation = environment.reset().observation
        self.assertAlmostEqual(observation['pose'][-1], -0.00686)
        self.assertAlmostEqual(observation['velocity'][-1], 0.100682)
        self.assertAlmostEqual(observation['velocity'][0], 2.813878, delta=0.1)

    @parameterized.parameters(1, 3)
    def test_a_backward_heading_observes_the_ground_behind(self, n):
        """10 m behind is further than the boxes reach, and another simulation's ground lies there."""
        env_ids = VectorEnvironment(DOG, n, 1, seed=range(7, 7 + n))
        env_ids.reset()
        task = env_ids.task
        for env_id in range(n):
            # As far back from the middle of its boxes as they let it be.
            task.world.qpos[env_id, task.figure.pose_qpos[:3]] = -2.9, 3.0, 2.0
        task.world.forward(np.arange(n))
        task.observe()
        for env_id in range(n):
            strip = terrain.PlanarGround.from_state(task.arena.grounds[env_id].state())
            x = -2.9 - np.linspace(-0.5, 10, 200)
            expected = strip.height(x) - strip.height([-2.9])
            found = task.observation[env_id, task.blocks['terrain']]
            np.testing.assert_allclose(found, expected, atol=1e-9)
            self.assertGreater(np.ptp(expected[120:]), 0.05)


class StartTest(parameterized.TestCase):
    """The first instant."""

    @parameterized.parameters(*STARTS)
    def test_velocity_and_place(self, id_):
        environment = make(id_)
        probe = Probe(environment)
        rates = [probe.joint(f'root_{axis}/')[1] for axis in ('x', 'z', 'pitch')]
        np.testing.assert_allclose(rates, STARTS[id_])
        figures = controllers.load(probe.name).start
        x, z = probe.root
        self.assertEqual(x, 0.0)
        self.assertGreaterEqual(z, figures['height'] - 1e-12)
        self.assertLess(z, figures['height'] + 0.05)
        self.assertEqual(probe.joint('root_pitch/')[0], figures['pitch'])
        for name, expected in figures['joints'].items():
            np.testing.assert_allclose(probe.joint(name), expected, err_msg=name)
        self.assertFalse(probe.touching() - set(EXEMPT[id_]))
        observation = environment.reset().observation
        np.testing.assert_array_equal(Probe(environment).root, (x, z))  # without noise, always so
        flat = np.linspace(-0.5, 10, 200) < 0.95  # the ground up to 1 m ahead
        np.testing.assert_allclose(observation['terrain'][flat], 0, atol=1e-12)

    def test_the_largest_noise_stays_finite(self):
        environment = make(DOG, start_noise=1.0)
        for _ in range(20):
            for step in (environment.reset(), environment.step(idle(environment))):
                for value in step.observation.values():
                    self.assertTrue(np.isfinite(value).all())

    def test_noise(self):
        clean, noisy = make(DOG), make(DOG, start_noise=0.05)
        found = []
        for _ in range(40):
            noisy.reset()
            a, b = Probe(clean), Probe(noisy)
            names = clean.task.character.spec.joints
            angles, rates = np.array([np.subtract(b.joint(n), a.joint(n)) for n in names]).T
            found.append((*angles, *rates / 10, (b.joint('root_x/')[1] - STARTS[DOG][0]) / 10))
            self.assertEqual(b.joint('root_pitch/'), a.joint('root_pitch/'))
        self.assertBetween(np.std(found), 0.045, 0.055)
        self.assertLess(abs(np.mean(found)), 0.01)
        self.assertBetween(np.std(np.array(found)[:, -1]), 0.03, 0.07)

    def test_where_the_ground_begins(self):
        x = np.linspace(-0.95, 0.95, 50)
        for spawn, flat in (('intended', True), ('upstream', False)):
            strip = make('FSM_Dog2D_Terrain_Slopes-v0', spawn=spawn).task.arena.grounds[0]
            self.assertEqual(np.ptp(strip.height(x)) == 0, flat)
        self.assertAlmostEqual(strip.height([3.0])[0], 0.0)  # where its first two stretches meet


class RewardTest(parameterized.TestCase):
    """One value per cycle."""

    def worked(self, id_, speed, share):
        """Reward of a cycle of 0.4 s with a mean speed and a share of stumbling."""
        environment = make(id_)
        task = environment.task
        task.state.lasted[:] = 240
        task.state.stumbled[:] = round(240 * share)
        task.state.start[:] = Probe(environment).com() - 0.4 * speed
        task.finish_step(np.arange(1))
        terms = environment.info['reward_terms']
        self.assertAlmostEqual(sum(terms.values()), float(task.reward[0]), places=12)
        return float(task.reward[0])

    @parameterized.parameters(
        (DOG, 4.0, 0.0, 1.0), (DOG, 3.0, 0.0, 0.6852), (DOG, 4.0, 0.1, 0.9), (DOG, 0.0, 0.0, 0.2003),
        (DOG, -1.0, 0.0, 0.2), (DOG, 5.0, 0.0, 0.6852), (DOG, 4.0, 1.0, 0.8 + 0.2 / 11),
        (RAPTOR, 4.0, 0.0, 1.0), (RAPTOR, 3.0, 0.1, 0.5852), (RAPTOR, -0.01, 0.0, 0.0),
        (RAPTOR, 0.01, 0.0, 0.2003), (GOAT, 2.0, 0.0, 1.0), (GOAT, 1.0, 0.0, 0.6852),
        (BIPED, 3.0, 0.0, 1.0), (BIPED, -0.5, 0.0, 0.2017), (HOPPER, 3.0, 0.0, 1.0),
        (HOPPER, 4.0, 0.5, 0.6065), (HOPPER, 3.0, 1.0, 1.0),
    )  # fmt: skip
    def test_worked_values(self, id_, speed, share, expected):
        self.assertAlmostEqual(self.worked(id_, speed, share), expected, places=4)

    @parameterized.parameters(*EXAMPLES)
    def test_rollout(self, id_):
        """Speed and stumbling, recomputed from the engine's substeps."""
        environment = make(id_, fresh=True, seed=1)
        probe, stumbles = Probe(environment), []
        self.assertEqual(environment.physics.timestep(), 1 / 1200)
        around_physics(
            environment, after=lambda: stumbles.append(bool(probe.touching() - set(EXEMPT[id_])))
        )
        rng, stumbled = np.random.default_rng(1), 0
        for _ in range(8):
            time, com = environment.physics.data.time, probe.com()
            stumbles.clear()
            step = environment.step(0.5 * rng.uniform(-1, 1, len(environment.action_map)))
            duration = environment.physics.data.time - time
            info = environment.info
            self.assertAlmostEqual(info['duration'], duration, places=9)
            self.assertAlmostEqual(info['duration'], len(stumbles) * STEP, places=9)
            self.assertAlmostEqual(info['stumbled'], sum(stumbles) * STEP, places=9)
            self.assertEqual(info['distance'], probe.root[0])
            stumbled += sum(stumbles)
            if step.last():
                self.assertEqual((step.reward, step.discount), (0.0, 0.0))
                self.assertEqual(set(info['reward_terms'].values()), {0.0})
                environment.reset()
                continue
            speed = (probe.com() - com) / duration
            near = np.exp(-0.5 * (TARGETS[id_] - speed) ** 2)
            expected = 0.8 * near + 0.2 / (1 + 10 * sum(stumbles) * STEP / duration)
            if id_ == HOPPER:
                expected = near
            elif id_ == RAPTOR and speed < 0:
                expected = 0.0
            self.assertAlmostEqual(step.reward, expected, places=9)
            self.assertEqual(step.discount, 1.0)
        if id_ == DOG:
            self.assertGreater(stumbled, 0)


class Adrift:
    """An environment whose character floats at rest, and feels what contacts a test gives it."""

    def __init__(self, id_, pitch=0.0, velocity=(0, 0, 0), **options):
        self.environment = make(id_, fresh=True, **options)
        environment, task = self.environment, self.environment.task
        self.links = task.character.spec.links
        environment.physics.model.opt.gravity[:] = 0
        environment.physics.data.qvel[:] = 0
        data = environment.physics.data
        data.qpos[task.figure.pose_qpos[1:3]] = 8.0, pitch
        data.qvel[task.figure.pose_dof[:3]] = velocity
        task.world.forward(np.zeros(1, int))
        task.state.milestone[:] = 0.0, 8.0
        self.time, self.contacts = 0, lambda time: ()
        first = task.gait.rules.machine.contact
        self.sensed = environment.physics.data.sensordata[first : first + len(self.links)]
        around_physics(environment, self.let_go, self.touch)

    def let_go(self):
        self.environment.physics.data.ctrl[:] = 0

    def touch(self):
        self.time += 1
        self.sensed[:] = np.isin(self.links, self.contacts(self.time * STEP))

    def lasts(self, most=8.0):
        """Time in s until the episode ends, or None."""
        while self.time * STEP < most - 1e-9:
            if self.environment.step(idle(self.environment)).last():
                return self.time * STEP
        return None


class FallTest(parameterized.TestCase):
    """What ends an episode."""

    @parameterized.parameters((DOG, 'torso'), (GOAT, 'spine0'), (RAPTOR, 'head'), (BIPED, 'root'),
                              (HOPPER, 'root'))  # fmt: skip
    def test_four_samples_on_the_ground(self, id_, link):
        adrift = Adrift(id_)
        adrift.contacts = lambda time: (link,)
        self.assertAlmostEqual(adrift.lasts(), 0.4)
        info = adrift.environment.info
        self.assertEqual((info['fell'], info['stuck'], info['diverged']), (True, False, False))
        self.assertEqual(adrift.environment.task.get_discount(None), 0.0)
        self.assertAlmostEqual(info['duration'], 0.4)  # in the middle of the cycle

    @parameterized.parameters(
        (DOG, 'knee'), (GOAT, 'torso'), (RAPTOR, 'tail3'), (BIPED, 'left_hip')
    )
    def test_contact_of_other_links_is_not_a_fall(self, id_, link):
        adrift = Adrift(id_, velocity=(1, 0, 0))
        adrift.contacts = lambda time: (link,)
        self.assertIsNone(adrift.lasts(3.0))
        self.assertAlmostEqual(adrift.environment.info['stumbled'], 50 / 30)  # the last cycle

    def test_short_contacts_are_not_a_fall(self):
        adrift = Adrift(DOG, velocity=(1, 0, 0))
        adrift.contacts = lambda time: ('head',) if 0.05 < time < 0.35 else ()
        self.assertIsNone(adrift.lasts(3.0))
        adrift = Adrift(DOG, velocity=(1, 0, 0))
        # Between two samples, contacts have no effect.
        adrift.contacts = lambda time: ('head',) if 0.02 < time % 0.1 < 0.08 else ()
        self.assertIsNone(adrift.lasts(3.0))
        self.assertGreater(adrift.environment.info['stumbled'], 0.9)

    @parameterized.parameters((3, True), (4, True), (5, False))
    def test_a_large_share_of_contacts_is_a_fall(self, every, falls):
        adrift = Adrift(DOG, velocity=(1, 0, 0))
        adrift.contacts = lambda time: () if round(time * 10) % every else ('head',)
        share, expected = 0.0, None
        for sample in range(1, 60):
            share = 0.9 * share + (sample % every == 0) / 11
            if share > 0.25 and expected is None:
                expected = sample / 10
        found = adrift.lasts(5.9)
        self.assertEqual(expected is not None, falls)
        if falls:
            self.assertAlmostEqual(found, expected)
        else:
            self.assertIsNone(found)

    @parameterized.product(id_=EXAMPLES, pitch=(2.6, -2.6, 2.4, -2.4, 2 * np.pi))
    def test_upside_down(self, id_, pitch):
        adrift = Adrift(id_, pitch=pitch, velocity=(1, 0, 0))
        ends = adrift.lasts(0.5)
        if abs(pitch) == 2.6:  # more than 0.8 pi
            self.assertAlmostEqual(ends, 0.1)
            self.assertTrue(adrift.environment.info['fell'])
        else:
            self.assertIsNone(ends)

    @parameterized.parameters((BIPED, 0.1), (DOG, None), (RAPTOR, None), (HOPPER, None))
    def test_only_the_biped_fails_when_it_moves_back(self, id_, expected):
        adrift = Adrift(id_, velocity=(-1, 0, 0))
        found = adrift.lasts(1.0)
        self.assertEqual(found is None, expected is None)
        if expected:
            self.assertAlmostEqual(found, expected)
            self.assertTrue(adrift.environment.info['fell'])

    def test_stuck(self):
        for speed, ends in ((0.0, 5.0), (0.09, 5.0), (0.11, None)):
            adrift = Adrift(RAPTOR, velocity=(speed, 0, 0))
            found = adrift.lasts(6.0)
            if ends is None:
                self.assertIsNone(found)
                continue
            self.assertAlmostEqual(found, ends)
            info = adrift.environment.info
            self.assertEqual((info['fell'], info['stuck'], info['diverged']), (False, True, False))
            self.assertEqual(float(adrift.environment.task.reward[0]), 0.0)
        # Vertical motion counts as well; the window restarts every 5 s.
        adrift = Adrift(RAPTOR, velocity=(0, 0.2, 0))
        self.assertIsNone(adrift.lasts(6.0))
        adrift.environment.physics.data.qvel[:] = 0
        self.assertAlmostEqual(adrift.lasts(15.1), 10.0)


class CycleTest(parameterized.TestCase):
    """How long a step lasts."""

    @parameterized.parameters(*EXAMPLES)
    def test_a_step_ends_with_the_cycle(self, id_):
        environment = make(id_)
        probe, gait = Probe(environment), environment.task.gait
        landing = {DOG: 'toe', GOAT: 'toe', HOPPER: 'leg'}
        left, durations = True, []
        for _ in range(5):
            step = environment.step(idle(environment))
            if step.last():
                break
            steps = environment.info['duration'] * 600
            self.assertAlmostEqual(steps, round(steps), places=6)
            self.assertLess(steps, 1000)
            self.assertEqual(gait.state.number[0], 0 if id_ == HOPPER else 3)
            swing_foot = f'{"left" if left else "right"}_{ {RAPTOR: "toe"}.get(id_, "ankle") }'
            self.assertIn(landing.get(id_, swing_foot), probe.touching())
            left = not left
            durations.append(environment.info['duration'])
        self.assertNotEmpty(durations)
        time = environment.physics.data.time
        total = sum(durations) + step.last() * environment.info['duration']
        self.assertAlmostEqual(time, total, places=9)
        if id_ == DOG:
            self.assertBetween(np.mean(durations), 0.35, 0.55)
        elif id_ in (RAPTOR, BIPED):  # three timed states, and a moment
            self.assertBetween(np.mean(durations), 3 * 0.0825, 0.3)

    @parameterized.parameters(DOG, RAPTOR)
    def test_a_cycle_that_does_not_end_is_truncated(self, id_):
        adrift = Adrift(id_, velocity=(1, 0, 0))
        environment = adrift.environment
        for _ in range(2):
            step = environment.step(idle(environment))
            self.assertTrue(step.mid())
            self.assertAlmostEqual(environment.info['duration'], 50 / 30)
        stuck_in = {DOG: 1, RAPTOR: 3}[id_]
        self.assertEqual(environment.task.gait.state.number[0], stuck_in)
        # The next action begins a cycle all the same.
        adrift.contacts = lambda time: ()
        seen, number = [], environment.task.gait.state.number
        around_physics(environment, before=lambda: seen.append(int(number[0])))
        environment.step(idle(environment))
        self.assertEqual(seen[0], 0)
        if id_ == RAPTOR:  # no step was made
            self.assertEqual(environment.task.gait.state.stance[0], 0)

    def test_the_first_action_takes_effect(self):
        for id_ in EXAMPLES:
            environment = make(id_, fresh=True)
            action = np.random.default_rng(0).uniform(-0.3, 0.3, len(environment.action_map))
            gait, seen = environment.task.gait, []
            vector = gait.state.vector
            around_physics(environment, lambda s=seen, v=vector: s.append(v.copy()))
            environment.step(action)
            expected = gait.parameters.vector(action[None])
            expected[:, gait.parameters.absolute] = np.abs(expected[:, gait.parameters.absolute])
            for vectors in (seen[0], seen[-1]):
                np.testing.assert_array_equal(vectors, expected)


class BaseActionTest(parameterized.TestCase):
    """The discrete interface: a preference per base action, at 30 Hz."""

    @parameterized.parameters(*zip(EXAMPLES, (8, 7, 8, 10, 18), strict=True))
    def test_choices(self, id_, count):
        environment = make(id_, fresh=True, interface='base_action')
        self.assertEqual(environment.action_spec().shape, (count,))
        self.assertEqual(environment.action_map.names[1], 'base_action_1')
        gait = environment.task.gait
        preferences = np.linspace(-1, 0.2, count)
        preferences[2] = 0.5
        environment.step(preferences)
        self.assertAlmostEqual(environment.info['duration'], 1 / 30)
        self.assertAlmostEqual(environment.physics.data.time, 1 / 30)
        first, second = gait.parameters.base_actions[[2, 1]]
        np.testing.assert_array_equal(gait.state.vector[0], first)
        # Another wish waits for the cycle's end.
        wish = np.zeros(count)
        wish[1] = 0.01
        seen, state = [], gait.state
        around_physics(
            environment, lambda: seen.append((int(state.number[0]), state.vector[0].copy()))
        )
        for _ in range(60):
            step = environment.step(wish)
            if step.last() or (state.vector[0] == second).all():
                break
        self.assertTrue((state.vector[0] == second).all())
        of_first = [number for number, vector in seen if (vector == first).all()]
        for _, vector in seen[len(of_first) :]:
            np.testing.assert_array_equal(vector, second)
        self.assertEqual(of_first[-1], 0 if id_ == HOPPER else 3)

    def test_rewards_are_of_frames(self):
        environment = make(DOG, interface='base_action')
        probe = Probe(environment)
        for _ in range(20):
            com = probe.com()
            step = environment.step(np.eye(8)[0])
            speed = (probe.com() - com) * 30
            stumble = 0.2 / (1 + 10 * environment.info['stumbled'] * 30)
            self.assertAlmostEqual(step.reward, 0.8 * np.exp(-0.5 * (4 - speed) ** 2) + stumble)

    def test_base_actions_of_the_original(self):
        environment = make(BIPED, interface='base_action', base_actions='original')
        self.assertEqual(environment.action_spec().shape, (8,))
        preferences = np.zeros(8)
        preferences[5] = 1.0
        environment.step(preferences)
        gait = environment.task.gait
        walk, jump = gait.parameters.sets['biped_walk'], gait.parameters.sets['biped_jump']
        expected = (walk + jump) / 2
        np.testing.assert_allclose(gait.state.vector[0], expected, atol=1e-12)
        environment = make(BIPED, base_actions='original')
        reach = environment.action_map.action_scale
        offset = gait.parameters.action_offset
        furthest = np.abs(gait.parameters.base_actions - offset).max(0)
        np.testing.assert_allclose(reach, furthest[gait.parameters.actions])


REFUSED = (
    ({'interface': 'parameter'}, "unknown interface 'parameter'.*'parameters'"),
    ({'base_actions': 'own'}, "unknown base_actions 'own'.*original"),
    ({'substeps': 0}, 'substeps is 0'), ({'substeps': 1.5}, 'substeps is 1.5'),
    ({'start_noise': -0.1}, 'start_noise is -0.1'), ({'start_noise': np.nan}, 'start_noise is nan'),
    ({'start_noise': np.inf}, 'start_noise is inf'), ({'start_noise': 1e300}, 'from 0 to 1, in rad'), ({'spawn': 'here'}, "'here'"),
    ({'terrain_observation': 3}, 'unknown option'), ({'start_phase': 0.5}, 'unknown option'),
)  # fmt: skip
DO_NOT_FIT = (
    (('dog', 'torque'), {}, 'unknown actuation .*; known: gait'), (('dog',), {'clip': 'dog_bound'}, 'no clip'),
    (('biped2d',), {}, "unknown character with a gait 'biped2d'"),
    (('dog', 'gait'), {'task': 'imitation'}, "unknown actuation .*'gait'"),
)  # fmt: skip


class OptionTest(parameterized.TestCase):
    def test_refused(self):
        assert_refused(
            self,
            *((lambda o=o: suite.make(DOG, o), message) for o, message in REFUSED),
            *((lambda a=a, o=o: suite.build(*a, **{'task': 'gait', **o}), m) for a, o, m in DO_NOT_FIT),
        )  # fmt: skip

    def test_build(self):
        for actuation in (None, 'gait'):
            environment = suite.build(
                'raptor', actuation, 'gaps', task='gait', task_kwargs={'random': 0, 'substeps': 4}
            )
            self.assertAlmostEqual(environment.physics.timestep(), 1 / 2400)
            environment.reset()
            environment.step(idle(environment))
            self.assertAlmostEqual(environment.physics.data.time, environment.info['duration'])


class GaitTest(parameterized.TestCase):
    """The gaits themselves, on flat ground: they stay up, at about their speed."""

    @parameterized.parameters((DOG, 3.4, 4.4), (GOAT, 1.4, 2.2), (RAPTOR, 3.0, 4.1),
                              (BIPED, 2.6, 3.4), (HOPPER, 2.5, 4.6))  # fmt: skip
    def test_all_gaits_run(self, id_, slowest, fastest):
        """Six simulations with action 0, and six with random ones of amplitude 0.1, for 6 s."""
        environments = VectorEnvironment(
            on_flat(id_), 12, 1, seed=0, autoreset='disabled', step_limit=None,
            task_kwargs={'start_noise': 0.01},
        )  # fmt: skip
        environments.reset()
        rng = np.random.default_rng(0)
        amplitude = np.repeat([0.0, 0.1], 6)[:, None]
        time, up = np.zeros(12), np.ones(12, bool)
        distance, lasted = np.zeros(12), np.zeros(12)
        while (up & (time < 6)).any():
            action = amplitude * rng.uniform(-1, 1, (12, len(environments.action_map)))
            step = environments.step(action)
            counts = up & (time < 6)
            time[counts] += step.info['duration'][counts]
            distance[counts], lasted[counts] = step.info['distance'][counts], time[counts]
            up &= ~(step.terminated & counts)
            if step.terminated.any():
                environments.reset(step.terminated)
        self.assertGreaterEqual(up[:6].sum(), 5)
        self.assertGreaterEqual(up[6:].sum(), 4)
        speed = (distance[:6] / lasted[:6])[up[:6]].mean()
        self.assertBetween(speed, slowest, fastest)


class BatchTest(parameterized.TestCase):
    def test_simulations_that_all_reset_run_no_physics(self):
        specs = VectorEnvironment(RAPTOR, 2, 1, seed=0, step_limit=1)
        specs.reset()
        self.assertTrue(specs.step(np.zeros((2, 28))).truncated.all())
        step = specs.step(np.zeros((2, 28)))
        np.testing.assert_array_equal(specs.task.world.time, 0)
        np.testing.assert_array_equal(step.reward, 0)
        np.testing.assert_array_equal(step.info['duration'], 0)


if __name__ == '__main__':
    absltest.main()
