"""Tests of hierarchical navigation: clock, plans, rewards, goals, ball, controllers."""

import contextlib
import dataclasses
import functools
import json
import warnings
from unittest import mock

import numpy as np
from absl.testing import parameterized
from helpers import (
    LEFT,
    RIGHT,
    FolderTest,
    angle_between,
    ankles,
    assert_refused,
    assert_uniform,
    body,
    ground,
    heading_of,
    made,
)

from trl_suite import policies, rendering, suite
from trl_suite.controllers import footstep_controller
from trl_suite.policies import files as policy_files
from trl_suite.tasks.navigation import hierarchical, scripted
from trl_suite.terrain.spatial.windows import SAMPLES
from trl_suite.vector import VectorEnvironment

PREFIX = 'PD_Biped3D_HLC_'
BLOCKS, MOVERS, SOCCER = (f'{PREFIX}{n}-v0' for n in ('LargeBlocks', 'DynamicsObstacles', 'Soccer'))
FOREST, TRAIL = f'{PREFIX}Forest-v0', f'{PREFIX}PathFollowing-v0'
IDS = [id_ for id_ in suite.ALL_IDS if id_.startswith(PREFIX)]
PLANE = dataclasses.replace(suite.find(FOREST), terrain='plane')  # to go from goal to goal
STILL = 0.8 * np.exp(-1.5) + 0.2  # what standing still earns
AHEAD = np.zeros(5)  # two steps of half a metre, straight on


def shipped_controller():
    return footstep_controller.load(policies.reference(hierarchical.CONTROLLER))


def started(id_=FOREST, **options):
    """An environment of few surprises, after a reset."""
    options = {'step_limit': None, 'start_phases': (0.0,), **options}
    environment = made(id_, seed=8, **options)
    return environment, environment.reset()


def com_of(environment):
    """Centre of mass of the walker, (3,) m, from its links."""
    bound = environment.physics.bind(environment.task.character.bodies)
    return np.asarray(bound.mass) @ np.asarray(bound.xipos) / np.asarray(bound.mass).sum()


def turned(way, angle):
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.array([cosine * way[0] - sine * way[1], sine * way[0] + cosine * way[1]])


def carry(environment, away=(0, 0, 0), yaw=0.0):
    """Moves the walker by a displacement, and rotates it about its root."""
    task, data = environment.task, environment.physics.data
    pose = data.qpos[task.body.pose_qpos]
    pose[:3] += away
    half = 0.5 * yaw
    w, x, y, z = pose[3:7]
    cosine, sine = np.cos(half), np.sin(half)
    pose[3:7] = cosine * w - sine * z, cosine * x - sine * y, cosine * y + sine * x, (
        cosine * z + sine * w
    )  # fmt: skip
    data.qpos[task.body.pose_qpos] = pose
    environment.physics.forward()


def put_ball(environment, position, velocity=(0, 0, 0), spin=(0, 0, 0)):
    data = environment.physics.named.data
    data.qpos['ball'] = *position, 1, 0, 0, 0
    data.qvel['ball'] = *velocity, *spin
    environment.physics.forward()


@contextlib.contextmanager
def moved(task, walker=(0, 0), ball=None, each=None):
    """Instead of physics: the walker glides at a velocity, m/s, and so does the ball."""
    world, pose = task.world, task.body.pose_qpos

    def step(nstep, env_ids=None):
        env_ids = np.arange(world.n) if env_ids is None else env_ids
        world.qpos[env_ids[:, None], pose[:2]] += np.array(walker) / 30
        if ball is not None:
            world.qpos[env_ids[:, None], task.ball.qpos[:3]] += np.array(ball) / 30
        if each is not None:
            each()
        if np.any(walker) or ball is not None or each is not None:
            world.forward(env_ids)

    with mock.patch.object(world, 'step', step):
        yield


def idle(observation):
    return np.zeros((len(observation), 17))


class ClockTest(parameterized.TestCase):
    """A step lasts from one switch of stance to the next."""

    @parameterized.parameters(
        (0.0, [15, 15, 15], [LEFT, RIGHT, LEFT]), (0.1, [12, 15, 15, 15], [LEFT, RIGHT, LEFT, RIGHT]),
        (0.6, [12, 15], [RIGHT, LEFT]), (0.4, [3, 15], [LEFT, RIGHT]),
    )  # fmt: skip
    def test_durations(self, phase, expected, stances):
        environment, _ = started(start_phases=(phase,), controller=idle)
        task, data = environment.task, environment.physics.data
        for count, stance in zip(expected, stances, strict=True):
            carry(environment, (0, 0, 5))  # nothing falls there within a step
            before, calls = data.time, []
            task.watch = lambda calls=calls: calls.append(data.time)
            self.assertTrue(environment.step(AHEAD).mid())
            self.assertAlmostEqual(data.time - before, count / 30, delta=1e-9)
            self.assertLen(calls, count)
            np.testing.assert_allclose(np.diff([before, *calls]), 1 / 30, atol=1e-9)
            self.assertEqual(task.plan.stance[0], stance)
            self.assertTrue(environment.info['landed'])

    def test_start_phases_are_drawn_evenly(self):
        specs = VectorEnvironment(BLOCKS, 200, 1, seed=0)
        specs.reset()
        phases = np.round(specs.task.phase, 9)
        self.assertEqual(set(phases), {0.1, 0.6})
        self.assertAlmostEqual((phases == 0.1).mean(), 0.5, delta=4 * np.sqrt(0.25 / 200))


class PlanTest(parameterized.TestCase):
    """The map from actions to plans."""

    @parameterized.parameters(FOREST, SOCCER, TRAIL)
    def test_plan_is_relative_to_the_start_of_the_step_and_fixed(self, id_):
        environment, _ = started(id_)
        task = environment.task
        rng = np.random.default_rng(0)
        for _ in range(3):
            root, heading = body(environment, 'xpos', 'root'), heading_of(environment)
            action = 0.15 * rng.uniform(-1, 1, 5)
            plan = np.array([0.5, 0, 1, 0, 0]) + np.array([1, 1, 2, 2, np.pi]) * action
            seen = []
            task.watch = lambda seen=seen: seen.append(
                (*task.plan.landing[0].ravel(), task.plan.heading[0])
            )
            environment.step(action)
            self.assertLen(seen, 15)
            self.assertGreater(np.hypot(*(body(environment, 'xpos', 'root') - root)[:2]), 0.1)
            for which, way in enumerate((plan[:2], plan[2:4])):
                place = task.plan.landing[0, which]
                np.testing.assert_allclose(place[:2], root[:2] + turned(way, heading), atol=1e-9)
                # Height grids are stored in single precision.
                height = float(ground(environment, *place[:2]))
                self.assertAlmostEqual(place[2], height, delta=1e-5)
            self.assertLess(angle_between(task.plan.heading[0], heading + plan[4]), 1e-9)
            np.testing.assert_array_equal(seen, np.tile(seen[0], (15, 1)))

    def test_inputs_of_the_controller(self):
        phases, default = [], shipped_controller()

        def controller(observation):
            feet, heading, swing = (
                ankles(environment),
                heading_of(environment),
                1 - task.plan.stance[0],
            )
            slots = observation[0, 112:124].reshape(2, 2, 3)
            for which, foot in enumerate((swing, 1 - swing)):
                way = turned((task.plan.landing[0, which] - feet[foot])[:2], -heading)
                np.testing.assert_allclose(slots[which, foot, :2], way, atol=1e-9)
                np.testing.assert_array_equal(slots[which, 1 - foot], 0)
            off = angle_between(heading + observation[0, 124], task.plan.heading[0])
            self.assertLess(off, 1e-9)
            phases.append(observation[0, 105])
            return default(observation)

        environment, _ = started(SOCCER, controller=controller)
        task = environment.task
        for _ in range(2):
            environment.step(AHEAD)
        np.testing.assert_allclose(phases, np.arange(30) / 30, atol=1e-6)


def goal_reward(speed, target=1.0):
    return 0.8 * np.exp(-1.5 * min(0, speed - target) ** 2) + 0.2


class GoalRewardTest(parameterized.TestCase):
    """0.8 exp(-1.5 min(0, v - 1)^2) + 0.2, over the whole step."""

    @parameterized.parameters(('plan', 5, (0.4, 0.5, 0.5, 0.5)), ('frame', 22, 4 * (1 / 30,)))
    def test_reward_from_the_physics(self, interface, size, seconds):
        environment, _ = started(PLANE, start_phases=(0.1,), interface=interface)
        task = environment.task
        for duration, angle in zip(seconds, (0.0, np.pi, 1.5, -0.4), strict=True):
            before = com_of(environment)
            task.goal[0] = before + 6 * np.array([np.cos(angle), np.sin(angle), 0])
            way = task.goal[0, :2] - before[:2]
            step = environment.step(np.zeros(size))
            moved_by = (com_of(environment) - before)[:2]
            speed = way @ moved_by / np.hypot(*way) / duration
            self.assertAlmostEqual(step.reward, goal_reward(speed), delta=1e-9)
            self.assertAlmostEqual(environment.info['speed'], speed, delta=1e-9)

    @parameterized.parameters(
        # Displacement of the goal, velocity of the walker, options, reward.
        ((7, 0), (0, 0), {}, STILL), ((7, 0), (0.5, 0), {}, goal_reward(0.5)), ((7, 0), (1, 0), {}, 1),
        ((7, 0), (3, 0), {}, 1), ((7, 0), (-1, 0), {}, goal_reward(-1)), ((7, 0), (0, 0.9), {}, goal_reward(0)),
        ((7, 0), (0.6, 0.8), {}, goal_reward(0.6)), ((7, 0), (0.4, 0), {'target_speed': 0.4}, 1),
        ((7, 0), (0, 0), {'target_speed': 0.4}, goal_reward(0, 0.4)), ((0, 0.9), (0, 0), {}, 1),
        ((0, 1.1), (0, 0), {}, STILL), ((0, 1.9), (0, 0), {'goal_reached': 2.0}, 1),
        ((0, 0.6), (0, 0), {'goal_reached': 0.5}, STILL),
    )  # fmt: skip
    def test_worked_values(self, way, velocity, options, expected):
        environment, _ = started(PLANE, controller=idle, **options)
        environment.task.goal[0] = com_of(environment) + np.array((*way, 0))
        with moved(environment.task, velocity):
            step = environment.step(AHEAD)
        self.assertAlmostEqual(step.reward, expected, delta=1e-9)


class FallTest(parameterized.TestCase):
    """A fall is a running share of samples, one every 0.1 s."""

    @parameterized.parameters(
        # Samples with contact, and at which sample it is a fall: S <- 0.9 S + c / 11 > 0.25.
        ('1111', 4), ('11101', 5), ('111001', 6), ('0001111', 7), ('1010101', 7), ('11011', 5),
        ('1001001001', None), ('11100', None),
    )  # fmt: skip
    def test_broken_contact(self, samples, fall):
        environment, _ = started(PLANE, controller=idle)
        task, share = environment.task, 0.0
        for i, touch in enumerate(samples, 1):
            share = 0.9 * share + int(touch) / 11
            self.assertEqual(share > 0.25, i == fall)  # the case is as described
        height = environment.physics.data.qpos[task.body.pose_qpos[2]]

        def place():
            number = task.clock.steps[0] // 3
            touch = number < len(samples) and samples[number] == '1'
            task.world.qpos[0, task.body.pose_qpos[2]] = height - 1.0 if touch else 5.0

        with moved(task, each=place):
            for _ in range(1 + len(samples) // 5):
                step = environment.step(AHEAD)
                if step.last():
                    break
        self.assertEqual(step.last(), fall is not None)
        self.assertEqual(environment.info['fell'], fall is not None)
        if fall is not None:
            self.assertEqual(task.clock.steps[0], 3 * fall)
            self.assertEqual((step.reward, step.discount), (0.0, 0.0))
            self.assertEqual(set(environment.info['reward_terms'].values()), {0.0})
            self.assertAlmostEqual(environment.info['duration'], (fall - 1) % 5 / 10 + 0.1)
            self.assertTrue(environment.step(AHEAD).first())
            self.assertFalse(environment.info['fell'])


class GoalTest(parameterized.TestCase):
    """Where to go."""

    def test_goal_is_redrawn_when_reached(self):
        environment, _ = started(PLANE, controller=idle)
        task = environment.task
        root = body(environment, 'xpos', 'root')
        with moved(task):
            for distance, reached in ((1.05, 0), (0.95, 1), (1.05, 1), (0.0, 2)):
                task.goal[0] = root + np.array((distance, 0, 0))
                given = task.goal[0].copy()
                step = environment.step(AHEAD)
                self.assertEqual(environment.info['goals_reached'], reached)
                self.assertEqual((task.goal[0] == given).all(), distance > 1)
                # On the plane within 3 m along x and along y of the root; observed at once.
                self.assertLessEqual(np.abs(task.goal[0] - root)[:2].max(), 3)
                away = np.hypot(*(task.goal[0] - root)[:2])
                self.assertAlmostEqual(step.observation['goal'][1], away, delta=1e-9)
        environment.reset()
        self.assertEqual(environment.info['goals_reached'], 0)

    def test_a_ball_at_its_goal_stays_and_so_does_the_goal(self):
        environment, _ = started(SOCCER, controller=idle)
        task = environment.task
        with moved(task):
            for gap, reached in ((0.4, 1), (0.5, 1), (0.0, 2)):
                ball = environment.physics.named.data.qpos['ball'][:2]
                # The ball's middle is 0.2 m above the ground.
                task.goal[0] = *(ball + np.array((gap, 0))), 0
                given = task.goal[0].copy()
                environment.step(AHEAD)
                self.assertEqual(environment.info['goals_reached'], reached)
                self.assertEqual(environment.info['at_goal'], gap < 0.45)
                np.testing.assert_array_equal(task.goal[0], given)

    @parameterized.parameters(PLANE, SOCCER)
    def test_goals_and_balls_are_redrawn_by_timers(self, id_):
        """Checked with every step of half a second."""
        n, goals = 10, (np.array([100.0 + i, 0, 0]) for i in range(1000))
        specs = VectorEnvironment(
            id_, n, 1, seed=0, step_limit=None,
            task_kwargs={'controller': idle, 'start_phases': (0.0,)},
        )  # fmt: skip
        specs.reset()
        task, places = specs.task, {'goal': lambda: task.goal}
        if id_ == SOCCER:
            places['ball'] = lambda: task.world.qpos[:, task.ball.qpos[:2]]
        else:  # out of reach
            far = mock.patch.object(task.arena, 'goal', lambda *_: next(goals))
            self.enterContext(far)
            for env_id in range(n):
                task.begin_goal(env_id)
        lasted, begun, before = {'ball': [], 'goal': []}, np.zeros((2, n)), {}
        with moved(task):
            for i in range(430):
                for row, (name, place) in zip(begun, places.items(), strict=False):
                    now = place().copy()
                    for env_id in np.flatnonzero((now != before.get(name, now)).any(1)):
                        lasted[name].append(0.5 * i - row[env_id])
                        row[env_id] = 0.5 * i
                    before[name] = now
                specs.step(np.zeros((n, 5)))
        self.assertGreaterEqual(len(lasted['goal']), 2 * n)
        assert_uniform(lasted['goal'], 50, 100.5)
        if id_ == SOCCER:
            assert_uniform(lasted['ball'], 100, 200.5)


class BallTest(parameterized.TestCase):
    """A light ball."""

    def test_figures(self):
        environment, _ = started(SOCCER)
        model = environment.physics.named.model
        self.assertAlmostEqual(model.body_mass['ball'], 0.1)
        self.assertAlmostEqual(model.geom_size['ball'][0], 0.2)
        np.testing.assert_allclose(model.body_inertia['ball'], 0.4 * 0.1 * 0.2**2)
        self.assertAlmostEqual(model.geom_friction['ball'][0], 0.45)
        self.assertGreater(model.geom_priority['ball'], model.geom_priority['plane'])

    def test_velocity_halves_in_a_second(self):
        environment, _ = started(SOCCER)
        put_ball(environment, (0, 0, 60), (2, -1, 0), (6, 3, -2))
        environment.task.world.step(300)
        fall = -9.81 / np.log(2) * 0.5  # against a drag of ln 2 per second
        velocity = environment.physics.named.data.qvel['ball']
        np.testing.assert_allclose(velocity, [1, -0.5, fall, 3, 1.5, -1], rtol=3e-3)

    def test_contact_with_the_ball_is_no_foot_contact_and_no_fall(self):
        seen = []

        def controller(observation):
            seen.append(observation[0, 110:112].copy())
            return np.zeros((1, 17))

        environment, _ = started(SOCCER, controller=controller)
        task = environment.task
        carry(environment, (0, 0, 5))
        touched = set()
        for link in ('right_ankle', 'left_ankle', 'root', 'torso'):
            put_ball(environment, body(environment, 'xipos', link))
            data, model = environment.physics.data.ptr, environment.physics.model.ptr
            geoms = data.contact.geom[: data.ncon]
            names = {model.body(b).name.split('/')[-1] for b in model.geom_bodyid[geoms].ravel()}
            touched |= names
            with moved(task):
                self.assertTrue(environment.step(AHEAD).mid())
        self.assertContainsSubset({'ball', 'right_ankle', 'left_ankle', 'root'}, touched)
        np.testing.assert_array_equal(seen, np.zeros((60, 2)))

    def test_where_ball_and_goal_are_put(self):
        specs = VectorEnvironment(SOCCER, 300, 1, seed=0)
        specs.reset()
        task = specs.task
        root = task.world.xpos[:, task.body.links[0], :2]
        ball = task.world.qpos[:, task.ball.qpos]
        away, shot = ball[:, :2] - root, task.goal[:, :2] - ball[:, :2]
        assert_uniform(np.hypot(*away.T), 0.7, 10)
        assert_uniform(np.hypot(*shot.T), 0, 10)
        for way in (away, shot):
            assert_uniform(np.arctan2(way[:, 1], way[:, 0]), -np.pi, np.pi)
        np.testing.assert_allclose(ball[:, 2], 0.2)
        np.testing.assert_array_equal(task.goal[:, 2], 0)
        np.testing.assert_array_equal(task.world.qvel[:, task.ball.dof], 0)
        options = {'goal_distance': (1, 2)}
        specs = VectorEnvironment(SOCCER, 64, 1, seed=0, task_kwargs=options)
        specs.reset()
        assert_uniform(np.hypot(*(specs.task.goal - specs.task.ball.place)[:, :2].T), 1, 2)

    def test_blocks(self):
        environment, _ = started(SOCCER, controller=idle)
        task = environment.task
        for yaw in (0.8, -2.0):
            carry(environment, yaw=yaw)
            root, heading = body(environment, 'xpos', 'root'), heading_of(environment)
            bearing, distance = -0.6, 2.5  # to the right
            place = root[:2] + distance * turned((np.cos(bearing), np.sin(bearing)), heading)
            put_ball(environment, (*place, 0.3), (1, 2, 3), (4, 5, 6))
            task.goal[0] = *(place + 4 * turned((np.cos(2.0), np.sin(2.0)), heading)), 0
            task.observe()
            found = environment.observation()
            np.testing.assert_allclose(found['goal'], [2.0, 4.0], atol=1e-9)
            expected = [
                bearing, distance, 0.3, *turned((1, 2), -heading), 3, *turned((4, 5), -heading), 6,
            ]  # fmt: skip
            np.testing.assert_allclose(found['ball'], expected, atol=1e-9)


class SoccerRewardTest(parameterized.TestCase):
    """Two sixths for the walker and the ball, two thirds for the ball and the goal."""

    @parameterized.parameters(
        # From the walker to the ball, velocities of both, from the ball to the goal.
        ((3, 0), (0, 0), (0, 0), (4, 0)), ((3, 0), (0.6, 0), (0, 0), (4, 0)),
        ((1, 2), (0.5, 1.5), (0, 0), (0, 3)), ((2, 0), (-0.5, 0), (0.7, 0), (4, 0)),
        ((2, 0), (0, 0), (2, 0), (4, 0)), ((0, 1.5), (0, 1), (0, -0.4), (0, 5)),
        ((0, 1.5), (0, 1), (0.3, 0.4), (0, 5)), ((5, 0), (3, 0), (0, 0), (0, 0.1)),
        # With the ball at the goal and within 2 m all are full; its middle is 0.2 m above the goal.
        ((1.9, 0), (0, 0), (0, 0), (0, 0.4)), ((2.1, 0), (0, 0), (0, 0), (0, 0.4)),
        ((1.0, 0), (0, 0), (0, 0), (0, 0.5)),
    )  # fmt: skip
    def test_terms(self, to_ball, walks, rolls, to_goal):
        environment, _ = started(SOCCER, controller=idle)
        task = environment.task
        walker = com_of(environment)[:2]
        ball = walker + to_ball
        put_ball(environment, (*ball, 0.2))
        task.goal[0] = *(ball + to_goal), 0
        with moved(task, walks, (*rolls, 0)):
            step = environment.step(AHEAD)
        after = ball + 0.5 * np.array(rolls)

        def along(velocity, way):
            return np.dot(velocity, way) / np.hypot(*way)

        towards_ball, towards_goal = along(walks, after - walker), along(rolls, to_goal)
        left = np.hypot(np.hypot(*(ball + to_goal - after)), 0.2)
        expected = {
            'approach': np.exp(-1.5 * min(0, towards_ball - 1) ** 2) / 6,
            'near': np.exp(-0.5 * ((after - walker) ** 2).sum()) / 6,
            'dribble': (towards_goal > 0) * np.exp(-1.5 * min(0, towards_goal - 1) ** 2) / 3,
            'goal': np.exp(-0.5 * left) / 3,
        }
        if left < 0.5 and np.hypot(*(after - walker)) < 2:
            expected = {'approach': 1 / 6, 'near': 1 / 6, 'dribble': 1 / 3, 'goal': 1 / 3}
        found = environment.info['reward_terms']
        for name, value in expected.items():
            self.assertAlmostEqual(found[name], value, delta=1e-9, msg=name)
        self.assertCountEqual(found, expected)
        self.assertAlmostEqual(step.reward, sum(expected.values()), delta=1e-9)
        self.assertAlmostEqual(environment.info['speed'], towards_goal, delta=1e-9)


class FrameTest(parameterized.TestCase):
    """The interface for whoever trains both levels."""

    @parameterized.parameters(SOCCER, MOVERS)
    def test_with_the_shipped_controller_frames_equal_plans(self, id_):
        options = {'start_phases': (0.1,), 'random': 3}
        plan, first = started(id_, **options)
        frame, begun = started(id_, interface='frame', **options)
        controller, rng = shipped_controller(), np.random.default_rng(0)
        for name, value in first.observation.items():
            np.testing.assert_array_equal(begun.observation[name], value)
        for i in range(4):
            action = 0.1 * rng.uniform(-1, 1, 5)
            expected = plan.step(action)
            low = frame.task.lay(np.append(action, np.zeros(17))[None])
            np.testing.assert_array_equal(frame.observation()['low_level'], low[0])
            for k in range(12 if i == 0 else 15):
                found = frame.step(np.append(action, controller(low)[0]))
                low = found.observation['low_level'][None]
                self.assertEqual(frame.info['landed'], k == (11 if i == 0 else 14))
            np.testing.assert_array_equal(frame.physics.data.qpos, plan.physics.data.qpos)
            np.testing.assert_array_equal(frame.physics.data.qvel, plan.physics.data.qvel)
            for name, value in expected.observation.items():
                np.testing.assert_array_equal(found.observation[name], value)
            np.testing.assert_array_equal(frame.task.plan.landing, plan.task.plan.landing)

    @parameterized.parameters(
        {'sensors': 'harsh'}, {'rewards': {'x': (1.0, lambda task: 0 * task.world.qpos[:, 0])}}
    )
    def test_a_plan_that_is_laid_is_observed(self, **components):
        environment, _ = started(PLANE, interface='frame', **components)
        low = environment.task.lay(np.append([0.1, 0.1, 0.2, 0, 0], np.zeros(17))[None])
        np.testing.assert_array_equal(environment.observation()['low_level'], low[0])

    def test_a_plan_takes_effect_at_the_start_of_a_footstep(self):
        environment, _ = started(PLANE, interface='frame')
        task, rng, plans = environment.task, np.random.default_rng(0), []
        for i in range(31):
            before = task.plan.landing[0].copy(), task.plan.heading[0]
            root, heading = body(environment, 'xpos', 'root'), heading_of(environment)
            action = np.append(0.2 * rng.uniform(-1, 1, 5), np.zeros(17))
            self.assertTrue(environment.step(action).mid())
            if i % 15 == 0:
                place = root[:2] + turned((0.5 + action[0], action[1]), heading)
                np.testing.assert_allclose(task.plan.landing[0, 0, :2], place, atol=1e-9)
                plans.append(task.plan.landing[0].copy())
            else:
                np.testing.assert_array_equal(task.plan.landing[0], before[0])
                self.assertEqual(task.plan.heading[0], before[1])
            self.assertEqual(environment.info['landed'], i in (14, 29))
        self.assertLen(plans, 3)


class ControllerTest(FolderTest):
    """Footstep controllers: the shipped one, files, functions."""

    def positions(self, **options):
        environment, _ = started(PLANE, **options)
        for _ in range(2):
            environment.step(AHEAD)
        return environment.physics.data.qpos.copy()

    def test_a_controller_by_id_alias_path_policy_or_function(self):
        shipped = policies.reference(hierarchical.CONTROLLER)
        path = self.folder / 'mine.npz'
        policies.save(shipped, path)
        expected = self.positions()
        for source in (
            hierarchical.CONTROLLER, 'deeploco/llc_general_step', path, str(path), shipped, shipped_controller(),
            lambda observation: shipped(observation),
        ):  # fmt: skip
            with self.subTest(source=str(source)):
                np.testing.assert_array_equal(self.positions(controller=source), expected)
        self.assertIsNone(footstep_controller.load(idle).policy)
        self.assertIsNotNone(footstep_controller.load(path).policy)
        controller = shipped_controller()
        self.assertIs(footstep_controller.load(controller), controller)

    def test_a_function_as_controller(self):
        def mine(observation):
            calls.append(observation.shape)
            return [[0.0] * 17] * len(observation)

        calls = []
        environments = VectorEnvironment(PLANE, 3, 1, seed=0, task_kwargs={'controller': mine})
        environments.reset()
        environments.step(np.zeros((3, 5)))
        self.assertEqual(calls, [(3, 125)] * 15)
        self.assertTrue((self.positions(controller=mine) != self.positions()).any())
        with self.assertRaisesRegex(TypeError, "^'set' object is not callable"):
            self.positions(controller=lambda observation: set()())

    def test_an_action_selects_one_of_several(self):
        ids = [hierarchical.CONTROLLER, 'PD_Biped3D_LLC_HighKnees_Step-v0']
        options = {'start_phases': (0.0, 0.5), 'random': 3}
        plan = policies.reference(FOREST)
        # Of equal numbers the first counts, also beyond the limits of actions.
        for id_, choice in zip(ids, ((2.0, 3.0), (-0.1, 0.1)), strict=True):
            several, _ = started(PLANE, controller=ids, **options)
            one, expected = started(PLANE, controller=id_, **options)
            for _ in range(4):
                action = plan(expected.observation)
                expected = one.step(action)
                found = several.step(np.append(action, choice))
            for name, value in expected.observation.items():
                np.testing.assert_array_equal(found.observation[name], value)
            self.assertEqual(several.info['controller'], ids.index(id_))
        names = [f'controller_{k}: {id_}' for k, id_ in enumerate(ids)]
        self.assertEqual(several.action_map.names, (*hierarchical.PLAN_NAMES, *names))
        np.testing.assert_array_equal(several.task.mirror.action_sign, (1, -1, 1, -1, -1, 1, 1))
        with self.assertRaisesRegex(ValueError, 'takes the footstep plan of .*controller_1'):
            plan.check(several)
        for bad in ([], ids):
            interface = 'frame' if bad else 'plan'
            with self.assertRaisesRegex(ValueError, f'controller: a list of {len(bad)}'):
                started(PLANE, controller=bad, interface=interface)

    def test_another_body_is_a_warning(self):
        shipped = policies.reference(hierarchical.CONTROLLER)
        with warnings.catch_warnings():
            warnings.simplefilter('error')
            started(PLANE)  # no warning
        info = {**json.loads(json.dumps(shipped.info)), 'character': '0123abcd'}
        other = dataclasses.replace(shipped, info=info)
        policies.save(other, self.folder / 'other.npz')
        with self.assertWarnsRegex(UserWarning, 'other.npz.*trained with body 0123abcd'):
            started(PLANE, controller=self.folder / 'other.npz')


class ScriptedTest(parameterized.TestCase):
    """The hand-written policy."""

    def test_walks_from_goal_to_goal(self):
        environments = VectorEnvironment(
            PLANE, 6, 1, seed=0, step_limit=None, autoreset='disabled',
            task_kwargs={'goal_distance': (3, 5)},
        )  # fmt: skip
        policy, observation, rewards = scripted.scripted(environments), environments.reset(), []
        fell = np.zeros(6, bool)
        for _ in range(60):  # half a minute
            step = environments.step(policy(observation))
            fell |= step.terminated
            rewards.append(step.reward[~fell].mean())
            ended = step.terminated
            observation = environments.reset(ended) if ended.any() else step.observation
        self.assertLessEqual(fell.sum(), 1)
        self.assertGreaterEqual(step.info['goals_reached'][~fell].mean(), 3)
        self.assertGreater(np.mean(rewards), 0.8)  # standing still earns 0.38

    def test_a_scripted_bearing_does_not_depend_on_other_simulations(self):
        rng, bearing = np.random.default_rng(0), np.array([1.55, 0.3])
        parts = {'terrain': np.stack([np.zeros(SAMPLES**2), rng.random(SAMPLES**2)])}
        found, _ = scripted.free_bearing(parts, bearing, np.full(2, 8.0))
        self.assertEqual(found[0], 1.55)

    @parameterized.parameters(*IDS)
    def test_goals_of_all_grounds(self, id_):
        environments = VectorEnvironment(id_, 4, 1, seed=1)
        policy, observation = scripted.scripted(environments), environments.reset()
        self.assertTrue(np.isfinite(environments.task.goal).all())
        self.assertLen(np.unique(environments.task.goal[:, 0]), 4)
        distance = observation[:, environments.blocks['goal']][:, 1]
        reach = {SOCCER: 10.0, TRAIL: 22.0}.get(id_, 48 * np.sqrt(2))
        self.assertBetween(distance.max(), 1.0, reach)
        for _ in range(6):
            step = environments.step(policy(observation))
            self.assertFalse(step.terminated.any())
            observation = step.observation

    def test_users_own_reward_terms_change_nothing(self):
        own, plain = (
            made(SOCCER, seed=1, flat=True, **more)
            for more in ({'rewards': {'idle': (0.1, lambda task: np.zeros(task.world.n))}}, {})
        )
        actions = [
            scripted.scripted(each)(each.reset().observation['observations'][None])
            for each in (own, plain)
        ]
        np.testing.assert_array_equal(*actions)

    def test_walks_around_obstacles(self):
        x = np.tile(np.linspace(-1, 10, 32), 32).reshape(32, 32)
        y = np.repeat(np.linspace(5.5, -5.5, 32), 32).reshape(32, 32)
        wall = (x > 1.5) & (x < 2.5) & (y > -0.9) & (y < 3)  # more of it to the left
        parts = {'terrain': np.stack([2.0 * wall.ravel(), np.zeros(1024)])}
        ways, room = scripted.free_bearing(parts, np.zeros(2), np.full(2, 8.0))
        np.testing.assert_array_equal(room, np.inf)
        self.assertLess(ways[0], -0.3)
        self.assertAlmostEqual(ways[1], 0)
        moving = np.stack([0.4 * wall.ravel(), np.zeros(1024)])[None].reshape(1, 2048)
        found, _ = scripted.free_bearing({'surface': moving}, np.zeros(1), np.full(1, 8.0))
        self.assertLess(found[0], -0.3)
        # Obstacles behind the goal do not block the path.
        near, room = scripted.free_bearing(parts, np.zeros(2), np.full(2, 1.0))
        np.testing.assert_allclose(near, 0)
        np.testing.assert_array_equal(room, np.inf)
        # If there is no free path, the result is the free distance.
        around = (np.hypot(x, y) > 1.7).reshape(1, 1024)
        everywhere = {'terrain': 2.0 * around}
        _, room = scripted.free_bearing(everywhere, np.zeros(1), np.full(1, 8.0))
        self.assertBetween(room[0], 1.2, 2.1)

    def test_gets_behind_the_ball(self):
        ball = np.zeros((2, 9))
        ball[:, 1] = 2.0  # straight on
        parts = {'ball': ball, 'goal': np.array([[0.0, 5.0], [np.pi / 2, 5.0]])}
        bearing, distance = scripted.towards_ball(parts)
        self.assertAlmostEqual(bearing[0], 0)
        self.assertGreater(distance[0], 2)  # through it, towards the goal
        # To shoot it to the left one has to stand to the right of it.
        place = distance[1] * np.array([np.cos(bearing[1]), np.sin(bearing[1])])
        np.testing.assert_allclose(place, [2, -0.7], atol=1e-9)


class PictureTest(parameterized.TestCase):
    """What is pointed out, and videos."""

    def test_markers(self):
        for options, reached in (({}, 0.5), ({'goal_reached': 0.3}, 0.3)):
            environment, _ = started(SOCCER, **options)
            *plan, disc = environment.task.markers(0)
            self.assertEqual([marker.shape for marker in plan], ['box', 'box', 'arrow'])
            self.assertEqual(disc.shape, 'cylinder')
            self.assertAlmostEqual(np.hypot(disc.size[0], 0.2), reached)  # 0.2 m: the ball's radius
            self.assertLess(disc.size[1], 0.02)
            np.testing.assert_array_equal(disc.position, environment.task.goal[0])
        environment, _ = started(FOREST)
        environment.step(AHEAD)
        task = environment.task
        *plan, flag = task.markers(0)
        trace = plan[3:]
        self.assertEqual([marker.shape for marker in plan[:3]], ['box', 'box', 'arrow'])
        # Every 5 of the 15 control steps; the last of them now.
        self.assertEqual([marker.shape for marker in trace], ['sphere'] * 3)
        np.testing.assert_allclose(trace[-1].position, com_of(environment), atol=1e-6)
        for marker, place in zip(plan[:2], task.plan.landing[0], strict=True):
            self.assertLess(np.hypot(*(marker.position - place)[:2]), 0.06)
            self.assertAlmostEqual(marker.yaw, task.plan.heading[0])
        self.assertEqual(flag.shape, 'cylinder')
        radius, half_height = flag.size[:2]
        # It stands on the ground at the goal.
        np.testing.assert_allclose(flag.position, task.goal[0] + (0, 0, half_height))
        self.assertGreater(half_height, radius)

    def test_goals_are_on_boxes_where_these_are_now(self):
        environment, _ = started(MOVERS, goal_distance=(0, 0.1))
        task, arena, ground = (
            environment.task,
            environment.task.arena,
            environment.task.arena.grounds[0],
        )
        begin = arena.mover_centres(0)
        for _ in range(12):
            environment.step(AHEAD)
        now = arena.mover_centres(0)
        moved = np.flatnonzero(np.hypot(*(now - begin).T) > 2)
        self.assertNotEmpty(moved)
        for k in moved:
            task._draw_goal(0, now[k])
            *place, height = task.goal[0]
            self.assertGreater(height, 0.5)
            self.assertEqual(height, ground.height(*place, now))

    def test_a_goal_is_larger_than_the_ball(self):
        for id_ in (SOCCER, 'PD_Biped3D_Terrain_Soccer_Hard-v0'):
            with self.assertRaisesRegex(ValueError, 'goal_reached is 0.2; .* radius of the ball'):
                suite.make(id_, {'goal_reached': 0.2})

    @parameterized.parameters(('plan', 2, 27), ('frame', 3, 3))
    def test_thirty_pictures_a_second(self, interface, steps, count):
        environment, _ = started(PLANE, start_phases=(0.1,), interface=interface, substeps=20)
        self.assertAlmostEqual(environment.physics.timestep(), 1 / 600)
        size = len(environment.action_map)
        images = list(
            rendering.frames(environment, lambda _: np.zeros(size), steps, height=60, width=80)
        )
        self.assertLen(images, 1 + count)
        self.assertIsNone(environment.task.watch)
        self.assertTrue((images[0] != images[-1]).any())


REFUSED = (
    ({'interface': 'plans'}, "unknown interface 'plans'; did you mean 'plan'"),
    ({'terrain_observation': 'heigth'}, "unknown terrain_observation 'heigth'; did you mean 'height'"),
    ({'terrain_observation': ('height', 'colour')}, "unknown terrain_observation 'colour'"),
    ({'target_speed': 0}, 'target_speed is 0'), ({'goal_reached': np.inf}, 'goal_reached is'),
    ({'start_phases': ()}, 'start_phases is'), ({'start_phases': (0.1, 1.0)}, 'start_phases is'),
    ({'start_phases': (-0.1,)}, 'start_phases is'), ({'substeps': 5}, 'substeps is 5'),
    ({'start_phase': 0.1}, "unknown option.*'start_phases'"),
    ({'goal_distance': -1}, 'goal_distance is -1; expected None or a number or a lower and an upper bound'),
    ({'goal_distance': (5, 3)}, 'goal_distance is'), ({'step_length': 0}, 'step_length is 0'),
    ({'goal_distance': (5, 1e9)}, 'goal_distance is .* from 0 to 100, in m'),
    ({'step_length': 'long'}, "step_length is 'long'; expected a number"),
    ({'start_phases': '12'}, "start_phases is '12'; expected a list of numbers"),
    ({'terrain_observation': None}, 'terrain_observation is None; expected a string or a list of strings'),
    ({'goal_reached': [1]}, r'goal_reached is \[1\]; expected None or a number above 0, in m'),
    ({'terrain_level': True}, 'terrain_level is True; expected a number'),
    ({'terrain_level': 1}, 'terrain_level is 1; expected a number from 0 to 0'),
)  # fmt: skip
ANSWERS = (  # of a controller for one simulation, and the message
    (np.zeros((1, 16)), r'shape \(1, 16\); expected \(1, 17\)'), (np.zeros((1, 18)), r'shape \(1, 18\)'),
    (np.zeros(17), r'shape \(17,\)'), (np.zeros((2, 17)), r'shape \(2, 17\)'), (np.zeros(()), r'shape \(\)'),
    (np.full((1, 17), np.nan), 'an action that is not finite for observation 0'),
    (None, r'not return numbers|shape'), ('left', 'not return numbers'), ([[1, 2], [3]], 'not return numbers'),
)  # fmt: skip


class OptionTest(FolderTest):
    """What is refused, and other options."""

    def test_far_goals_are_on_the_ground(self):
        task = started('PD_Biped3D_HLC_PathFollowing-v0', goal_distance=(30, 30), random=1)[0].task
        x, y, height = task.goal[0]
        self.assertEqual(height, task.arena.grounds[0].height(x, y))
        self.assertGreater(abs(height), 0.1)

    def test_refused(self):
        frame = started(PLANE, interface='frame')[0].task
        lay = functools.partial(functools.partial, frame.lay)

        def ball(name):
            return functools.partial(suite.build, 'biped3d_mocap', terrain=name, task='soccer')

        def script(id_, **options):
            return functools.partial(scripted.scripted, made(id_, **options))

        (self.folder / 'broken.npz').write_bytes(b'no')
        shipped = policies.reference(hierarchical.CONTROLLER)
        without_plan = policies.Policy(
            'mine', shipped.blocks[:3], shipped.actions, shipped.quantity, np.zeros(110), np.ones(110), 5.0,
            (np.zeros((110, 17)),), (np.zeros(17),), 'tanh', np.zeros(17),
        )  # fmt: skip
        assert_refused(
            self,
            *((lambda i=i, o=o: suite.make(i, o), m) for i in (FOREST, SOCCER) for o, m in REFUSED),
            *((ball(name), f'level ground.*{name}.*are: flat3d, plane') for name in ('hills3d', 'obstacles3d')),
            (lay(np.zeros(22)), r'shape \(22,\); expected \(1, 22\)'),
            (lay(np.zeros((1, 5))), r'shape \(1, 5\); expected'),
            (lay(np.full((1, 22), np.nan)), r'number 0 \(first_x\) is nan'),
            (lay([['a'] * 22]), 'not an array of numbers'),
            (script('PD_Biped3D_LLC_General_Step-v0'), 'the task SpatialFootsteps has no scripted policy'),
            (script(FOREST, interface='frame'), "needs the interface 'plan', not 'frame'"),
            (lambda: rendering.frame(started(FOREST)[0], 60, 80, ghost=True),
             'the task HierarchicalNavigation has no reference clip'),
            (lambda: started(PLANE, controller='PD_Biped3D_LLC_Genral_Step-v0'),
             f"did you mean '{hierarchical.CONTROLLER}'"),
            (lambda: started(PLANE, controller='stand'),
             "unknown controller 'stand'; known: FILE.npz, PD_Biped3D_LLC_Bumps_Step-v0, .*_Stand_Step-v0, "),
            *((lambda c=c: started(SOCCER, controller=c),
               "'PD_Biped3D_LLC_Run_FootStep-v0' has footsteps of 0.3 s; expected 0.5 s, as .*_Soccer-v0 has them: "
               f'{hierarchical.CONTROLLER}, ')
              for c in ('PD_Biped3D_LLC_Run_FootStep-v0', [hierarchical.CONTROLLER, 'deeploco/llc_run_footstep'])),
            (lambda: started(PLANE, controller='FSM_Goat2D_Terrain_Cliffs-v0'),
             "policy of 'FSM_Goat2D.*' observes .*plan 13"),
            (lambda: started(PLANE, controller=without_plan),
             'observes pose 57, velocity 48, phase 5; the environment gives .*contact 2, plan 13'),
            (lambda: footstep_controller.load(str(self.folder / 'broken.npz')), 'broken.npz'),
        )  # fmt: skip
        ball('flat3d')().close()
        missing = mock.patch.object(policy_files, 'available', lambda variant: ())
        with missing, self.assertRaisesRegex(FileNotFoundError, 'no policy is shipped for'):
            started(PLANE, controller='PD_Biped3D_LLC_Trail_Step-v0')
        with self.assertRaises(FileNotFoundError):
            footstep_controller.load(self.folder / 'none.npz')

    def test_invalid_actions_of_a_controller_are_rejected(self):
        def crooked(observation):
            return answers[-1]

        answers = [None]
        environment, _ = started(PLANE, controller=crooked)
        for answer, message in ANSWERS:
            answers.append(answer)
            environment.reset()
            assert_refused(
                self, (lambda: environment.step(AHEAD), f'controller crooked .*({message})')
            )
        environments = VectorEnvironment(PLANE, 4, 1, seed=0, task_kwargs={'controller': crooked})
        environments.reset()
        answers.append(np.where(np.arange(4)[:, None] == 2, np.nan, np.zeros((1, 17))))
        third = 'controller crooked returns an action that is not finite for observation 2'
        assert_refused(self, (lambda: environments.step(np.zeros((4, 5))), third))
