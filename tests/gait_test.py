"""Tests of the gait task: observation, reward, falls and cycles, recomputed independently."""

import ctypes
import dataclasses

import numpy as np
from absl.testing import parameterized
from helpers import assert_refused, links_on_ground, made
from imitation_test import PlanarProbe

from trl_suite import controllers, suite, terrain
from trl_suite.engine import native
from trl_suite.vector import VectorEnvironment

# One of each character, on ground with many features in view.
DOG, GOAT = 'FSM_Dog2D_Terrain_Slopes_Mixed-v0', 'FSM_Goat2D_Terrain_Variable_Steps-v0'
RAPTOR, BIPED = 'FSM_Raptor2D_Terrain_Mixed-v0', 'FSM_Biped2D_Terrain_Slopes-v0'
HOPPER = 'FSM_Hopper2D_Terrain_Mixed_Easy-v0'
EXAMPLES = (DOG, GOAT, RAPTOR, BIPED, HOPPER)
EXEMPT = {  # links that may touch the ground without a stumble
    DOG: ('toe', 'finger', 'ankle', 'wrist'),
    HOPPER: ('leg',),
    RAPTOR: ('right_toe', 'left_toe', 'right_ankle', 'left_ankle'),
    BIPED: ('right_ankle', 'left_ankle', 'right_knee', 'left_knee'),
}
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
    environment.calls = getattr(environment, 'calls', ()), calls  # keeps them alive


class Probe(PlanarProbe):
    def rate(self, name):
        return self.joint(name, 'qvel')[0]

    def touching(self):
        return links_on_ground(self.environment)

    def com(self):
        return self.centre_of_mass()[0][0]

    def observation(self, left_stance):
        order = list(self.links)
        if left_stance:
            swap = {'right': 'left', 'left': 'right'}
            order = ['_'.join([swap.get(part, part) for part in link.split('_')]) for link in order]
        found = self.blocks(np.linspace(-0.5, 10, 200), order)
        found['pose'] = np.delete(found['pose'], (1, 2))  # of the root
        if self.name == 'hopper':
            found['pose'][-1] = self.joint('root_pitch/')[0]
            found['velocity'][-1] = self.rate('root_pitch/')
        return found


class ObservationTest(parameterized.TestCase):
    """Blocks and their contents."""

    @parameterized.parameters(*EXAMPLES)
    def test_contents(self, id_):
        environment = make(id_, seed=3)
        rng, left = np.random.default_rng(0), False
        step, seen = environment.reset(), set()
        probe = Probe(environment)
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

    @parameterized.parameters(1, 3)
    def test_a_backward_heading_observes_the_ground_behind(self, n):
        """10 m behind is further than the boxes reach, and another simulation's ground lies there."""
        env_ids = VectorEnvironment(DOG, n, 1, seed=range(7, 7 + n))
        env_ids.reset()
        task = env_ids.task
        for env_id in range(n):
            # As far back from the middle of its boxes as they let it be.
            task.world.qpos[env_id, task.body.pose_qpos[:3]] = -2.9, 3.0, 2.0
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
        rates = [probe.rate(f'root_{axis}/') for axis in ('x', 'z', 'pitch')]
        np.testing.assert_allclose(rates, STARTS[id_])
        figures = controllers.load(probe.name).start
        x, _, z = probe.root
        self.assertEqual(x, 0.0)
        self.assertGreaterEqual(z, figures['height'] - 1e-12)
        self.assertLess(z, figures['height'] + 0.05)
        self.assertEqual(probe.joint('root_pitch/')[0], figures['pitch'])
        for name, expected in figures['joints'].items():
            found = probe.joint(name)[0], probe.rate(name)
            np.testing.assert_allclose(found, expected, err_msg=name)
        self.assertFalse(probe.touching() - set(EXEMPT[id_]))
        observation = environment.reset().observation
        np.testing.assert_array_equal(
            Probe(environment).root, (x, 0, z)
        )  # without noise, always so
        flat = np.linspace(-0.5, 10, 200) < 0.95  # the ground up to 1 m ahead
        np.testing.assert_allclose(observation['terrain'][flat], 0, atol=1e-12)

    def test_noise(self):
        clean, noisy = Probe(make(DOG)), Probe(make(DOG, start_noise=0.05))
        names = clean.task.character.spec.joints
        found = []
        for _ in range(40):
            noisy.environment.reset()
            angles = [(noisy.joint(n) - clean.joint(n))[0] for n in names]
            rates = [noisy.rate(n) - clean.rate(n) for n in (*names, 'root_x/')]
            found.append(np.append(angles, np.divide(rates, 10)))
            self.assertEqual(noisy.joint('root_pitch/'), clean.joint('root_pitch/'))
        self.assertBetween(np.std(found), 0.045, 0.055)
        self.assertLess(abs(np.mean(found)), 0.01)
        self.assertBetween(np.std(np.array(found)[:, -1]), 0.03, 0.07)
        environment = make(DOG, start_noise=1.0)  # the largest
        for _ in range(5):  # it begins on the ground, not in it
            environment.reset()
            self.assertFalse(Probe(environment).touching() - set(EXEMPT[DOG]))
        for step in (environment.reset(), environment.step(idle(environment))):
            self.assertTrue(np.isfinite(np.concatenate([*step.observation.values()])).all())

    def test_where_the_ground_begins(self):
        x = np.linspace(-0.95, 0.95, 50)
        for spawn, flat in (('intended', True), ('upstream', False)):
            strip = make('FSM_Dog2D_Terrain_Slopes-v0', spawn=spawn).task.arena.grounds[0]
            self.assertEqual(np.ptp(strip.height(x)) == 0, flat)
        self.assertAlmostEqual(strip.height([3.0])[0], 0.0)  # where its first two stretches meet


class RewardTest(parameterized.TestCase):
    """One value per cycle."""

    def expected(self, id_, speed, share):
        """Reward of a mean speed, m/s, and a share of the time that it stumbled."""
        if id_ == RAPTOR and speed < 0:
            return 0.0
        near = np.exp(-0.5 * (TARGETS[id_] - speed) ** 2)
        return near if id_ == HOPPER else 0.8 * near + 0.2 / (1 + 10 * share)

    @parameterized.product(id_=EXAMPLES, speed=(-1.0, -0.01, 0.01, 2.0, 4.0, 5.0), share=(0.0, 0.5))
    def test_speeds(self, id_, speed, share):
        environment = make(id_)
        task = environment.task
        task.state.lasted[:] = 240
        task.state.stumbled[:] = round(240 * share)
        task.state.start[:] = Probe(environment).com() - 0.4 * speed
        task.finish_step(np.arange(1))
        self.assertAlmostEqual(float(task.reward[0]), self.expected(id_, speed, share), places=9)

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
            self.assertAlmostEqual(sum(info['reward_terms'].values()), step.reward, places=12)
            stumbled += sum(stumbles)
            if step.last():
                self.assertEqual((step.reward, step.discount), (0.0, 0.0))
                self.assertEqual(set(info['reward_terms'].values()), {0.0})
                environment.reset()
                continue
            speed = (probe.com() - com) / duration
            expected = self.expected(id_, speed, sum(stumbles) * STEP / duration)
            self.assertAlmostEqual(step.reward, expected, places=9)
            self.assertEqual(step.discount, 1.0)
        if id_ == DOG:
            self.assertGreater(stumbled, 0)


class Adrift:
    """An environment whose character floats at rest, and feels what contacts a test gives it."""

    made = {}  # noqa: RUF012  # by id, for all tests

    def __init__(self, id_):
        self.environment = make(id_, fresh=True)
        self.links = self.environment.task.character.spec.links
        self.environment.physics.model.opt.gravity[:] = 0
        first = self.environment.task.gait.data.machine.contact
        self.sensed = self.environment.physics.data.sensordata[first : first + len(self.links)]
        around_physics(self.environment, self.let_go, self.touch)

    @classmethod
    def begun(cls, id_, contacts=lambda time: (), pitch=0.0, velocity=(0, 0, 0)):
        if id_ not in cls.made:
            cls.made[id_] = cls(id_)
        self = cls.made[id_]
        environment, task = self.environment, self.environment.task
        self.time, self.contacts = 0, lambda time: ()
        environment.reset()
        data = environment.physics.data
        data.qvel[:] = 0
        data.qpos[task.body.pose_qpos[1:3]] = 8.0, pitch
        data.qvel[task.body.pose_dof[:3]] = velocity
        task.world.forward(np.zeros(1, int))
        task.state.milestone[:] = 0.0, 8.0
        self.time, self.contacts = 0, contacts
        return self

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


FORWARD = {'velocity': (1, 0, 0)}
# Environment, links on the ground at a time in s, options of `Adrift`; when the episode ends, s, and how.
ENDS = (
    # Four samples on the ground, in the middle of a cycle.
    *((id_, lambda time, link=link: (link,), {}, 0.4, 'fell')
      for id_, link in ((DOG, 'torso'), (GOAT, 'spine0'), (RAPTOR, 'head'), (BIPED, 'root'), (HOPPER, 'root'))),
    # Other links, short contacts, and contacts between samples are not a fall.
    *((id_, lambda time, link=link: (link,), FORWARD, None, '')
      for id_, link in ((DOG, 'knee'), (GOAT, 'torso'), (RAPTOR, 'tail3'), (BIPED, 'left_hip'))),
    (DOG, lambda time: ('head',) if 0.05 < time < 0.35 else (), FORWARD, None, ''),
    (DOG, lambda time: ('head',) if 0.02 < time % 0.1 < 0.08 else (), FORWARD, None, ''),
    # Every so many of the samples: S <- 0.9 S + c / 11 > 0.25.
    *((DOG, lambda time, k=k: () if round(time * 10) % k else ('head',), FORWARD, end, 'fell')
      for k, end in ((3, 1.5), (4, 2.8), (5, None))),
    # Upside down: a pitch of more than 0.8 pi.
    *((id_, lambda time: (), {'pitch': pitch, **FORWARD}, end, 'fell') for id_ in EXAMPLES
      for pitch, end in ((2.6, 0.1), (-2.6, 0.1), (2.4, None), (-2.4, None), (2 * np.pi, None))),
    # Only the biped fails when it moves back.
    *((id_, lambda time: (), {'velocity': (-1, 0, 0)}, end, 'fell')
      for id_, end in ((BIPED, 0.1), (DOG, None), (RAPTOR, None), (HOPPER, None))),
    # Less than half a metre in 5 s; vertical motion counts as well.
    *((RAPTOR, lambda time: (), {'velocity': velocity}, end, 'stuck')
      for velocity, end in (((0, 0, 0), 5.0), ((0.09, 0, 0), 5.0), ((0.11, 0, 0), None), ((0, 0.2, 0), None))),
)  # fmt: skip


def tearDownModule():
    Adrift.made.clear()


class FallTest(parameterized.TestCase):
    """What ends an episode."""

    @parameterized.parameters(*ENDS)
    def test_ends(self, id_, contacts, options, end, how):
        adrift = Adrift.begun(id_, contacts, **options)
        found = adrift.lasts((end or (5 if how == 'stuck' else 2.5)) + 0.9)
        self.assertEqual(found is None, end is None)
        info = adrift.environment.info
        if end is None:
            self.assertFalse(info['fell'] or info['stuck'])
            return
        self.assertAlmostEqual(found, end)
        self.assertEqual(
            (info['fell'], info['stuck'], info['diverged']), (how == 'fell', how == 'stuck', False)
        )
        self.assertEqual(adrift.environment.task.get_discount(None), 0.0)
        self.assertEqual(float(adrift.environment.task.reward[0]), 0.0)

    def test_contacts_of_other_links_are_a_stumble(self):
        adrift = Adrift.begun(DOG, lambda time: ('knee',), **FORWARD)
        adrift.lasts(3.0)
        self.assertAlmostEqual(adrift.environment.info['stumbled'], 50 / 30)  # the last cycle

    def test_the_window_in_which_it_is_stuck_restarts_every_5_seconds(self):
        adrift = Adrift.begun(RAPTOR, velocity=(0, 0.2, 0))
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
            self.assertTrue(environment.step(idle(environment)).mid())
            steps = environment.info['duration'] * 600
            self.assertAlmostEqual(steps, round(steps), places=6)
            self.assertLess(steps, 1000)
            self.assertEqual(gait.state.number[0], 0 if id_ == HOPPER else 3)
            swing_foot = f'{"left" if left else "right"}_{ {RAPTOR: "toe"}.get(id_, "ankle") }'
            self.assertIn(landing.get(id_, swing_foot), probe.touching())
            left = not left
            durations.append(environment.info['duration'])
        time = environment.physics.data.time
        self.assertAlmostEqual(time, sum(durations), places=9)
        if id_ == DOG:
            self.assertBetween(np.mean(durations), 0.35, 0.55)
        elif id_ in (RAPTOR, BIPED):  # three timed states, and a moment
            self.assertBetween(np.mean(durations), 3 * 0.0825, 0.3)

    @parameterized.parameters(DOG, RAPTOR)
    def test_a_cycle_that_does_not_end_is_truncated(self, id_):
        adrift = Adrift.begun(id_, **FORWARD)
        environment = adrift.environment
        for _ in range(2):
            step = environment.step(idle(environment))
            self.assertTrue(step.mid())
            self.assertAlmostEqual(environment.info['duration'], 50 / 30)
        stuck_in = {DOG: 1, RAPTOR: 3}[id_]
        self.assertEqual(environment.task.gait.state.number[0], stuck_in)
        # The next action begins a cycle all the same.
        del Adrift.made[id_]
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
        environment = make(RAPTOR, substeps=4)
        self.assertAlmostEqual(environment.physics.timestep(), 1 / 2400)
        environment.step(idle(environment))
        self.assertAlmostEqual(environment.physics.data.time, environment.info['duration'])


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
    ({'substeps': 0}, 'substeps is 0'), ({'spawn': 'here'}, "'here'"),
    ({'start_noise': np.nan}, 'start_noise is nan'), ({'start_noise': 1e300}, 'from 0 to 1, in rad'),
    ({'terrain_observation': 3}, 'unknown option'),
)  # fmt: skip
DO_NOT_FIT = (
    (('dog', 'torque'), {}, 'unknown actuation .*; known: gait'),
    (('dog',), {'clip': 'dog_bound'}, 'no clip'),
    (('biped2d',), {}, "unknown character with a gait 'biped2d'"),
    (('dog', 'gait'), {'task': 'imitation'}, "unknown actuation .*'gait'"),
)


class OptionTest(parameterized.TestCase):
    def test_refused(self):
        assert_refused(
            self,
            *((lambda o=o: suite.make(DOG, o), message) for o, message in REFUSED),
            *((lambda a=a, o=o: suite.build(*a, **{'task': 'gait', **o}), m) for a, o, m in DO_NOT_FIT),
        )  # fmt: skip


class GaitTest(parameterized.TestCase):
    """The gaits themselves, on flat ground: they stay up, at about their speed."""

    @parameterized.parameters((DOG, 3.4, 4.4), (GOAT, 1.4, 2.2), (RAPTOR, 3.0, 4.1),
                              (BIPED, 2.6, 3.4), (HOPPER, 2.5, 4.6))  # fmt: skip
    def test_all_gaits_run(self, id_, slowest, fastest):
        """Three simulations with action 0, and three with random ones of amplitude 0.1, for 5 s."""
        environments = VectorEnvironment(
            on_flat(id_), 6, 1, seed=0, autoreset='disabled', step_limit=None,
            task_kwargs={'start_noise': 0.01},
        )  # fmt: skip
        environments.reset()
        rng = np.random.default_rng(0)
        amplitude = np.repeat([0.0, 0.1], 3)[:, None]
        time, distance, up = np.zeros(6), np.zeros(6), np.ones(6, bool)
        while (up & (time < 5)).any():
            action = amplitude * rng.uniform(-1, 1, (6, len(environments.action_map)))
            step = environments.step(action)
            counts = up & (time < 5)
            time[counts] += step.info['duration'][counts]
            distance[counts] = step.info['distance'][counts]
            up &= ~(step.terminated & counts)
            if step.terminated.any():
                environments.reset(step.terminated)
        self.assertGreaterEqual(up[:3].sum(), 2)
        self.assertGreaterEqual(up[3:].sum(), 2)
        speed = (distance[:3] / time[:3])[up[:3]].mean()
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
