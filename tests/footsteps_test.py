"""Tests of the tasks that track footsteps, in the plane and in 3D: clock, plans, reward, landings."""

import functools
import itertools

import numpy as np
from absl.testing import parameterized
from helpers import (
    LEFT,
    RIGHT,
    angle_between,
    ankles,
    assert_refused,
    assert_uniform,
    body,
    flattened,
    ground,
    heading_of,
    links_on_ground,
    made,
    put,
)
from helpers import STEP_WEIGHTS as WEIGHTS
from imitation_test import begin_at

from trl_suite import motion, rendering, suite
from trl_suite.tasks.footsteps.planner import Plans, StraightPlans
from trl_suite.tasks.variation.pushes import PushConfig
from trl_suite.vector import VectorEnvironment

PLANAR = 'PD_Biped2D_LLC_Flat_Step-v0'
GENERAL, MIRRORED = 'PD_Biped3D_LLC_General_Step-v0', 'PD_Biped3D_LLC_Symetric_Step-v0'
RUN, TRAIL = 'PD_Biped3D_LLC_Run_FootStep-v0', 'PD_Biped3D_LLC_Trail_Step-v0'
BUMPS, FULL = 'PD_Biped3D_LLC_Bumps_Step-v0', 'PD_Biped3D_FULL_Imitate-Steps-v0'
BOTH = (PLANAR, GENERAL)
SIDE = {RIGHT: -1, LEFT: 1}


def started(id_=GENERAL, start_phase=None, **options):
    environment = made(id_, seed=8, step_limit=None, **options)
    begin_at(environment, start_phase)
    return environment, environment.reset()


def is_planar(environment):
    return not environment.task.character.spec.spatial


def idle(environment):
    """The action of the clip in the plane, where zero falls soon."""
    return environment.task.clip_action(0) if is_planar(environment) else np.zeros(17)


def held(environment):
    """Takes a step high in the air, where nothing falls."""
    figure, data = environment.task.body, environment.physics.data
    root = (0, 8, 0) if is_planar(environment) else (0, 0, 8, 1, 0, 0, 0)
    data.qpos[figure.pose_qpos[: len(root)]] = root
    data.qvel[figure.pose_dof] = 0
    environment.physics.forward()
    return environment.step(np.zeros(len(environment.action_map)))


def heading(task):
    """Planned heading of each simulation, rad; 0 in the plane."""
    return getattr(task.plan, 'heading', np.zeros(task.world.n)).copy()


def length_and_width(start, end, headings, foot):
    """Of steps of a foot between places (n, 3) m, along headings (n,), 2 arrays (n,) m."""
    x, y = (end - start)[:, :2].T
    cosine, sine = np.cos(headings), np.sin(headings)
    return cosine * x + sine * y, SIDE[foot] * (cosine * y - sine * x)


def walked(n, switches, id_=GENERAL, **options):
    """The plans of n walkers that stand still while their clocks run: distributions of plans.

    Returns:
      A list over the switches: landing places before and after, headings before and after, stance
      after. The physics stands still.
    """
    environments = VectorEnvironment(id_, n, 1, seed=0, task_kwargs={'start_phase': 0.0, **options})
    environments.reset()
    task, found = environments.task, []
    while len(found) < switches:
        before = task.plan.landing.copy(), heading(task)
        everyone = task.world.all_ids
        task.apply_action(np.zeros((n, len(environments.action_map))), everyone)
        task.finish_step(everyone)
        if task.plan.landed.any():
            assert task.plan.landed.all()
            found.append(
                (*before, task.plan.landing.copy(), heading(task), int(task.plan.stance[0]))
            )
    return environments, found


class ClockTest(parameterized.TestCase):
    """The clock determines the stance foot, and what is observed of the plan."""

    @parameterized.parameters(
        (GENERAL, 0.0, [15, 30, 45]), (GENERAL, 0.6, [12, 27, 42, 57]), (MIRRORED, 0.0, [15, 30]),
        (RUN, 0.0, [9, 18, 27]), (PLANAR, 0.0, [15, 30, 45, 60]), (PLANAR, 0.1, [12, 27, 42]),
    )  # fmt: skip
    def test_stance_switches(self, id_, phase, expected):
        environment, _ = started(id_, start_phase=phase)
        found, plan = [], environment.task.plan
        for i in range(1, expected[-1] + 1):
            before = plan.stance[0]
            step = held(environment)
            if plan.stance[0] != before:
                found.append(i)
            self.assertEqual(environment.info['landed'], plan.stance[0] != before)
            right = (phase + i / 30 / (0.6 if id_ == RUN else 1.0) + 1e-9) % 1 < 0.5
            self.assertEqual(plan.stance[0], RIGHT if right else LEFT)
            if id_ != MIRRORED:  # there the phase is that of a single step
                self.assertEqual(step.observation['phase'][0] < 0.5, right)
                self.assertEqual(step.observation['phase'][1:3].any(), right)
        self.assertEqual(found, expected)

    @parameterized.product(id_=BOTH, phase=(0.0, 0.3, 0.5, 0.9))
    def test_plan_slots(self, id_, phase):
        environment, step = started(id_, start_phase=phase, plans={'length': (0.25, 0.6)})
        for _ in range(15):
            plan, task = step.observation['plan'], environment.task
            right = step.observation['phase'][0] < 0.5
            slots = plan[:12].reshape(2, 2, 3)  # first and second place; from right and left foot
            np.testing.assert_array_equal(slots[0, 0 if right else 1], 0)
            np.testing.assert_array_equal(slots[1, 1 if right else 0], 0)
            turn, feet = flattened(heading_of(environment)), ankles(environment)
            for which, foot in ((0, LEFT if right else RIGHT), (1, RIGHT if right else LEFT)):
                expected = turn @ (task.plan.landing[0, which] - feet[foot])
                expected[2] = 0.0  # the plane is as high as that under the root
                expected[1] *= id_ != PLANAR
                np.testing.assert_allclose(slots[which, foot], expected, atol=1e-9)
            ahead = heading_of(environment) + plan[12]
            self.assertLess(angle_between(ahead, heading(task)[0]), 1e-9)
            step = environment.step(idle(environment) + 0.1)
        if id_ == PLANAR:  # heading back
            environment.physics.data.qpos[environment.task.body.pose_qpos[2]] = np.pi
            environment.physics.forward()
            task.observe()
            way = (task.plan.landing[0] - ankles(environment)[::-1])[:, 0]  # left, right
            found = environment.observation()['plan']
            if task.plan.stance[0] == RIGHT:
                np.testing.assert_allclose(found[[3, 6]], -way, atol=1e-12)
            self.assertEqual(task.reward_terms[0, -1], 0)  # the heading

    @parameterized.parameters(*BOTH)
    def test_contacts(self, id_):
        environment, _ = started(id_, start_phase=0.0)
        seen = set()
        for _ in range(25):
            step = environment.step(idle(environment))
            links = links_on_ground(environment)
            expected = [float(f'{side}_ankle' in links) for side in ('right', 'left')]
            np.testing.assert_array_equal(step.observation['contact'], expected)
            seen.add(tuple(expected))
            if step.last():
                break
        self.assertGreater(len(seen), 1)

    @parameterized.parameters('biped2d', 'biped2d_full', 'raptor')
    def test_the_stance_foot_is_planted(self, character):
        # In the middle of its half it carries the clip, and the other foot swings ahead.
        environment = suite.build(character, task='footsteps', task_kwargs={'random': 0})
        self.assertTrue(environment.reset().first())
        task = environment.task
        for phase, stance in ((0.25, RIGHT), (0.75, LEFT)):
            found = []
            for time in (phase - 0.04, phase, phase + 0.04):
                pose = task.clip.pose(time * task.clip.duration)
                put(environment, pose, np.zeros(len(pose)))
                found.append(task.world.xpos[0, task.body.effectors, ::2])
            x, z = np.moveaxis(found, -1, 0)
            self.assertLess(z[:, stance].max() + 0.02, z[:, 1 - stance].min())
            self.assertLess(np.ptp(x[:, stance]), 0.25 * np.ptp(x[:, 1 - stance]))
        again = suite.build(character, task='footsteps', clip=task.clip.mirrored().mirrored())
        self.assertTrue(again.reset().first())
        mirrored = task.clip.mirrored()
        wrong = functools.partial(suite.build, character, task='footsteps', clip=mirrored)
        assert_refused(self, (wrong, r'expected the right foot on the ground.*clip\.mirrored'))


class PlanTest(parameterized.TestCase):
    """How plans are drawn."""

    @parameterized.product(case=((GENERAL, 0.5, 0.15), (PLANAR, 0.4, 0.0)), phase=(0.0, 0.2, 0.8))
    def test_the_first_plan(self, case, phase):
        # Along +x, the feet on lines half a width from the line of the start.
        id_, length, width = case
        environment, _ = started(id_, start_phase=phase)
        stance = RIGHT if phase < 0.5 else LEFT
        foot = ankles(environment)[stance, 0]
        expected = [
            [foot + length, SIDE[1 - stance] * width / 2, 0],
            [foot + 2 * length, SIDE[stance] * width / 2, 0],
        ]
        np.testing.assert_allclose(environment.task.plan.landing[0], expected, atol=1e-9)
        self.assertEqual(heading(environment.task)[0], 0)

    @parameterized.parameters((GENERAL, 0.5, 0.15), (RUN, 1.15, 0.15), (PLANAR, 0.4, 0))
    def test_each_step_is_laid_from_the_one_before(self, id_, length, width):
        _, found = walked(4, 12, id_)
        stances = []
        for landing, before, after, headings, stance in found:
            np.testing.assert_array_equal(after[:, 0], landing[:, 1])
            if id_ == RUN:  # it goes straight on
                np.testing.assert_array_equal((before, headings), 0)
            found = length_and_width(after[:, 0], after[:, 1], headings, stance)
            np.testing.assert_allclose(found, [[length] * 4, [width] * 4], atol=1e-9)
            stances.append(stance)
        self.assertEqual(stances, [LEFT, RIGHT] * 6)

    @parameterized.parameters((0.4, {}), (1.0, {'turn': 0.0, 'sharp': 0.0}))
    def test_plans_react(self, react, plans):
        # The walkers stand still, so that they miss landing places.
        environments, found = walked(4, 6, plans={'react': react, **plans})
        feet = environments.task.body.measure().feet
        self.assertGreater(np.abs(found[0][2][:, 0] - found[0][0][:, 1]).min(0)[0], 0.1)
        for landing, _, after, headings, stance in found:
            missed = (feet[:, stance] - landing[:, 0])[:, :2]
            expected = landing[:, 1, :2] + react * missed
            np.testing.assert_allclose(after[:, 0, :2], expected, atol=1e-12)
            sizes = length_and_width(after[:, 0], after[:, 1], headings, stance)
            np.testing.assert_allclose(sizes, [[0.5] * 4, [0.15] * 4], atol=1e-9)
            if react == 1:
                sizes = length_and_width(feet[:, stance], after[:, 0], headings, 1 - stance)
                np.testing.assert_allclose(sizes, [[0.5] * 4, [0.15] * 4], atol=1e-9)

    @parameterized.parameters((3, 1.0), (6, 0.3))
    def test_plans_stop_and_stay(self, stay, stop):
        # The walkers stand still, with the feet far from the places of their plans.
        plans = {'stop': stop, 'stay': (stay, stay), 'width': (0.2, 0.2), 'turn': 0.3, 'sharp': 0.0}
        environments, found = walked(40, 12, plans=plans)
        feet, lasted, began = environments.task.body.measure().feet, np.zeros(40, int), []
        for _, before, after, headings, stance in found:
            stays = np.abs(after[:, 1] - feet[:, stance])[:, :2].max(1) < 1e-9
            sizes = length_and_width(feet[:, stance], after[:, 0], headings, 1 - stance)
            np.testing.assert_allclose(
                np.array(sizes)[:, stays].T, [[0, 0.2]] * stays.sum(), atol=1e-9
            )
            np.testing.assert_array_equal(before[stays], headings[stays])
            self.assertTrue((before != headings)[~stays].all())
            free = lasted % stay == 0
            self.assertTrue(stays[~free].all())  # until the time is over
            began.extend(stays[free])
            lasted = np.where(stays, lasted + 1, 0)
        deviation = np.sqrt(stop * (1 - stop) / len(began))
        self.assertAlmostEqual(np.mean(began), stop, delta=4 * deviation)

    @parameterized.parameters(False, True)
    def test_a_walker_that_stays_is_to_stand(self, mirrored):
        phase = 0.49 if mirrored else 0.99  # at the end of a step
        environment, _ = started(start_phase=phase, style='stand', plans={'stop': 1.0, 'turn': 0.0})
        task = environment.task
        [stand] = np.flatnonzero(np.ptp(task.steps.poses, 1).max(1) == 0)
        put(environment, task.steps.pose(stand, 0.0, mirrored), np.zeros(len(task.body.pose_dof)))
        environment.step(np.zeros(17))
        self.assertTrue(environment.info['landed'])
        self.assertEqual(task.state.track[0], stand + mirrored * len(task.steps))

    @parameterized.parameters(
        ({}, 0.1, 0.25), ({'sharp': 1.0}, 1.0, 0), ({'sharp': 0.0, 'turn': 0.1}, 0, 0.1)
    )
    def test_headings_walk_at_random(self, plans, sharp, turn):
        """N(0, turn) in most steps, U(-pi, pi) in the others, a share `sharp`."""
        _, found = walked(100, 30, plans=plans)
        turns = np.array([after - before for _, before, _, after, _ in found]).ravel()
        if sharp == 1:
            assert_uniform(turns, -np.pi, np.pi)
            return
        far, near = np.abs(turns) > 5 * turn, np.abs(turns) < turn
        self.assertLess(np.abs(turns).max(), np.pi)
        for found, probability in (
            (far, sharp * (1 - 5 * turn / np.pi)),
            (near, (1 - sharp) * 0.6827 + sharp * turn / np.pi),
        ):
            deviation = np.sqrt(probability * (1 - probability) / len(turns))
            self.assertAlmostEqual(found.mean(), probability, delta=4 * deviation)
        self.assertAlmostEqual(turns[~far].mean(), 0, delta=0.12 * turn)

    @parameterized.product(id_=BOTH, change=(0.0, 0.1, 1.0))
    def test_lengths_and_widths(self, id_, change):
        """They are uniform, and change in a share of the steps."""
        widths = {'width': (0.1, 0.25)} if id_ == GENERAL else {}
        _, found = walked(60, 16, id_, plans={'length': (0.25, 0.6), 'change': change, **widths})
        sizes = [length_and_width(a[:, 0], a[:, 1], *more) for _, _, a, *more in found]
        lengths, widths = np.moveaxis(sizes, 1, 0)
        changed = np.abs(np.diff(lengths, axis=0)) > 1e-9
        deviation = np.sqrt(change * (1 - change) / changed.size)
        self.assertAlmostEqual(changed.mean(), change, delta=4 * deviation)
        if change < 1:
            self.assertGreater(np.ptp(lengths[0]), 0.25)  # redrawn at every start
            return
        assert_uniform(lengths, 0.25 - 1e-9, 0.6 + 1e-9)
        if id_ == GENERAL:
            assert_uniform(widths, 0.1 - 1e-9, 0.25 + 1e-9)
            self.assertLess(abs(np.corrcoef(lengths.ravel(), widths.ravel())[0, 1]), 0.13)

    def test_plans_made_from_the_root(self):
        environments, found = walked(60, 16, plans={'from_root': 1.0, 'root_turn': 0.45})
        measured = environments.task.body.measure()
        sizes, turns = [], []
        for _, _, after, headings, stance in found:
            turns.append(headings - measured.heading)
            feet = measured.feet[:, stance]
            sizes.append(length_and_width(feet, after[:, 0], headings, 1 - stance))
            sizes.append(length_and_width(after[:, 0], after[:, 1], headings, stance))
        lengths, widths = np.moveaxis(sizes, 1, 0)
        assert_uniform(lengths, 0.2 - 1e-9, 0.7 + 1e-9)
        assert_uniform(widths, 0.08 - 1e-9, 0.28 + 1e-9)
        turns = np.ravel(turns)
        self.assertLessEqual(np.abs(turns).max(), 1.2 + 1e-9)
        # N(0, 0.45) truncated at 1.2, which is 2.67 deviations.
        self.assertAlmostEqual(turns.std(), 0.448, delta=0.045)
        self.assertBetween(np.mean(np.abs(turns) > 1.2 - 1e-6), 0.0, 0.025)
        _, found = walked(80, 12, plans={'from_root': 0.3})
        off = [np.abs(after[:, 0] - before[:, 1]).max(1) for before, _, after, _, _ in found]
        self.assertAlmostEqual(np.mean(np.array(off) > 1e-12), 0.3, delta=4 * np.sqrt(0.21 / 960))

    @parameterized.parameters(
        *(('biped3d_mocap', name) for name in ('hills3d', 'stairs3d', 'trail3d2')),
        *(('biped2d_full', name) for name in ('slopes_humanoid', 'gaps_humanoid')),
    )
    def test_places_lie_on_the_ground(self, character, preset):
        options = {'random': 4, 'step_limit': None, 'start_phase': 0.4}
        if character == 'biped3d_mocap':
            options['plans'] = {'react': 1.0}
        environment = suite.build(character, terrain=preset, task='footsteps', task_kwargs=options)
        task = environment.task

        def height(x, y):
            if is_planar(environment):
                return task.arena.height(np.atleast_1d(x)[None], slice(0, 1))[0]
            return ground(environment, x, y)

        for _ in range(3):
            step = environment.reset()
            for _ in range(6):
                x, y, z = task.plan.landing[0].T
                # Height grids are stored in single precision.
                np.testing.assert_allclose(z, height(x, y), atol=1e-6)
                root = body(environment, 'xpos', 'root')
                slots = step.observation['plan'][:12].reshape(2, 2, 3)
                stance = task.plan.stance[0]
                used = slots[[0, 1], [1 - stance, stance], 2]
                np.testing.assert_allclose(used, z - height(*root[:2]), atol=1e-6)
                step = environment.step(idle(environment))

    def test_turned_starts(self):
        # Among blocks episodes start anywhere, heading anywhere: all is turned with the body.
        environment = suite.build(
            'biped3d_mocap', terrain='obstacles3d', task='footsteps',
            task_kwargs={'random': 4, 'start_phase': 0.2},
        )  # fmt: skip
        first, headings = None, []
        for _ in range(6):
            step = environment.reset()
            ahead = heading_of(environment)
            headings.append(ahead)
            # Contacts aside, which are of the last substep.
            seen = np.concatenate([step.observation[n] for n in ('pose', 'velocity', 'plan')])
            first = seen if first is None else first
            np.testing.assert_allclose(seen, first, rtol=0, atol=1e-9)
            # Forward is where it heads.
            rate = environment.physics.data.qvel[environment.task.body.pose_dof]
            self.assertGreater(rate[:2] @ [np.cos(ahead), np.sin(ahead)], 0.5)
            self.assertGreater(np.abs(body(environment, 'xpos', 'root')[:2]).max(), 2)
            environment.task.observe()
            np.testing.assert_allclose(
                environment.task.reward_terms[0, :5] / list(WEIGHTS.values())[:5], 1, atol=2e-3
            )
        self.assertGreater(np.ptp(headings), 2)


class GoalTest(parameterized.TestCase):
    """Plans that head for a goal."""

    @parameterized.parameters((TRAIL, 0.4), (GENERAL, 0.5))
    def test_plans_head_for_the_goal(self, id_, length):
        environment, _ = started(id_, goal=True, start_phase=0.0)
        task = environment.task
        for _ in range(5):
            environment.reset()
            root, feet = body(environment, 'xpos', 'root'), ankles(environment)
            way = task.goal[0, :2] - root[:2]
            self.assertGreater(np.hypot(*way), 0.1)
            self.assertLess(np.hypot(*way), 9)  # on the trail: within the next segments, of 2 m
            self.assertLess(angle_between(heading(task)[0], np.arctan2(way[1], way[0])), 1e-9)
            self.assertAlmostEqual(
                task.goal[0, 2], ground(environment, *task.goal[0, :2]), delta=1e-6
            )
            # The first place is a step from the foot that stands.
            found = length_and_width(feet[[RIGHT]], task.plan.landing[:, 0], heading(task), LEFT)
            np.testing.assert_allclose(np.ravel(found), [length, 0.15], atol=1e-9)

    @parameterized.parameters(
        (GENERAL, 0.7, 0), (GENERAL, 2.0, 0), (TRAIL, 2.0, 0), (GENERAL, None, 5.0)
    )
    def test_at_a_switch(self, id_, ahead, aside):
        """The goal is redrawn on arrival; the plan heads for it from the middle of the old one."""
        environment, _ = started(id_, goal=True, start_phase=0.4)
        task = environment.task
        places, before = task.plan.landing[0].copy(), heading(task)[0]
        x, y, _ = body(environment, 'xpos', 'root')
        if ahead is None:  # at the middle itself, which gives no direction, and far enough to stay
            task.goal[0, :2] = places.mean(0)[:2] + 0.05
            environment.physics.data.qpos[task.body.pose_qpos[1]] += aside
            environment.physics.forward()
        else:
            task.goal[0, :2] = x + ahead, y + 0.3
        goal = task.goal[0].copy()
        for _ in range(3):
            self.assertTrue((task.goal[0] == goal).all())  # only at the switch
            environment.step(np.zeros(17))
        self.assertEqual(task.plan.stance[0], LEFT)
        self.assertEqual((task.goal[0] != goal).any(), ahead == 0.7)
        way = task.goal[0, :2] - places.mean(0)[:2]
        expected = before if ahead is None else np.arctan2(way[1], way[0])
        self.assertLess(angle_between(heading(task)[0], expected), 1e-9)

    def test_plans_that_react_head_for_the_goal(self):
        """From the middle of the places that have moved with the foot."""
        environment, _ = started(goal=True, start_phase=0.4, plans={'react': 1.0})
        task = environment.task
        task.goal[0, :2] += 2.0, 3.0
        places = task.plan.landing[0, :, :2].copy()
        for _ in range(3):
            environment.step(np.zeros(17))
        self.assertEqual(task.plan.stance[0], LEFT)
        missed = ankles(environment)[LEFT, :2] - places[0]
        self.assertGreater(np.hypot(*missed), 0.02)
        x, y = task.goal[0, :2] - places.mean(0) - missed
        self.assertLess(angle_between(heading(task)[0], np.arctan2(y, x)), 1e-9)
        np.testing.assert_allclose(task.plan.landing[0, 0, :2], places[1] + missed, atol=1e-9)
        ends = task.plan.landing[:, 0], task.plan.landing[:, 1]
        sizes = length_and_width(*ends, heading(task), LEFT)
        np.testing.assert_allclose(np.ravel(sizes), [0.5, 0.15], atol=1e-9)


class RewardTest(parameterized.TestCase):
    """The reward of the specification."""

    def placed(self, id_, phase, **options):
        """The body exactly where its reference is, the plan on its step; where that lands, (3,) m."""
        environment, _ = started(id_, start_phase=phase, **options)
        task, mirrored = environment.task, phase >= 0.5
        if id_ == PLANAR:
            end = task.clip.pose(np.ceil(2 * phase + 1e-9) / 2)
            pose, rate = task.clip.pose(phase), task.clip.velocity(phase)
        else:  # the straight step of about the planned length
            steps = task.steps
            straight = np.flatnonzero((steps.labels[:, 2] == 0) & (steps.labels[:, 1] == 0.15))
            gaps = np.abs(steps.labels[straight, 0] - task.plans.length[0])
            index = straight[np.argmin(gaps)]
            time = (2 * phase % 1) * steps.duration
            end = steps.pose(index, steps.duration, mirrored)
            pose, rate = steps.pose(index, time, mirrored), steps.velocity(index, time, mirrored)
        put(environment, end, np.zeros(len(rate)))
        landing = ankles(environment)[RIGHT if mirrored else LEFT]
        if id_ == PLANAR:
            landing[1] = 0
        else:
            landing[:2] -= pose[:2]
            pose[:2] = 0
        put(environment, pose, rate)
        task.plan.landing[0, 0] = *landing[:2], 0
        if id_ != PLANAR:
            task.plan.heading[0] = heading_of(environment)
        task.observe()
        return environment, landing

    @parameterized.product(
        id_=(GENERAL, MIRRORED, RUN, FULL, PLANAR), phase=(0.02, 0.24, 0.499999, 0.53, 0.999999)
    )
    def test_the_reference_pose_has_full_reward(self, id_, phase):
        # In the second half of a step the swing foot is only there when it lands.
        environment, _ = self.placed(id_, phase)
        task, near = environment.task, 2e-3 if id_ == PLANAR else 1e-3
        self.assertEqual([term.name for term in task.terms], list(WEIGHTS))
        for found, (name, weight) in zip(task.reward_terms[0], WEIGHTS.items(), strict=True):
            self.assertAlmostEqual(found, weight, delta=near * weight, msg=name)
        if phase % 0.5 < 0.25:  # the first half of a step ignores the plan
            task.plan.landing[0] += 1.0
            task.observe()
            found = task.reward_terms[0, 2]
            self.assertAlmostEqual(found, WEIGHTS['end_effector'], delta=1e-3)

    @parameterized.parameters(
        *((style, 0.24) for style in ('high_knees', 'straight_legs', 'forward_lean', 'in_place')),
        *itertools.product(('one_straight_leg', 'sideways_lean'), (0.24, 0.74)),
    )
    def test_a_style_is_another_reference(self, style, phase):
        plain, _ = self.placed(GENERAL, phase)
        environment, _ = self.placed(GENERAL, phase, style=style, pose_scale=10.0)
        task, maps = environment.task, (plain.action_map, environment.action_map)
        np.testing.assert_array_equal(*(mapped.action_offset for mapped in maps))
        for found, (name, weight) in zip(task.reward_terms[0], WEIGHTS.items(), strict=True):
            self.assertAlmostEqual(found, weight, delta=0.02 * weight, msg=name)
        environment.physics.named.data.qpos['biped3d_mocap/left_knee'] -= 0.25
        environment.physics.forward()
        task.observe()  # the knee's weight is 0.3 of 3.5
        expected = WEIGHTS['pose'] * np.exp(-10 * 2 * 0.3 / 3.5 * 0.25**2)
        self.assertAlmostEqual(task.reward_terms[0, 0], expected, delta=0.02 * WEIGHTS['pose'])
        poses = [made.task.reference_pose(0) for made in (plain, environment)]
        self.assertGreater(np.abs(poses[0] - poses[1]).max(), 0.1)

    @parameterized.parameters(
        *((id_, phase, scale) for phase in (0.4, 0.77) for id_, scale in (
            (GENERAL, 1.0), (GENERAL, 5.0), (GENERAL, (1.5, 8.0)), (PLANAR, 1.0), (PLANAR, 4.0)))
    )  # fmt: skip
    def test_second_half_of_a_step(self, id_, phase, scale):
        environment, landing = self.placed(id_, phase, footstep_scale=scale)
        task = environment.task
        away = landing - ankles(environment)[RIGHT if phase >= 0.5 else LEFT]
        away[2] = 0.0  # as high above the landing place as the reference's
        away[1] *= id_ != PLANAR
        scales = np.atleast_1d(scale)  # of several, the mean counts
        for height in (0.0, 0.1):  # of the place; the foot shall be as high above it
            task.plan.landing[0, 0, 2] = height
            task.observe()
            errors = 5 * scales * (away @ away + height**2)
            expected = WEIGHTS['end_effector'] * np.exp(-errors).mean()
            self.assertAlmostEqual(task.reward_terms[0, 2], expected, delta=2e-3)

    @parameterized.parameters(*BOTH)
    def test_a_displaced_foot_lowers_the_reward(self, id_):
        environment, _ = self.placed(id_, 0.1)  # in the first half of a step
        task, before = environment.task, ankles(environment)
        environment.physics.named.data.qpos[f'{task.character.spec.name}/left_knee'] -= 0.25
        environment.physics.forward()
        task.observe()
        moved = ankles(environment) - before
        np.testing.assert_allclose(moved[RIGHT], 0, atol=1e-12)
        expected = WEIGHTS['end_effector'] * np.exp(-5 * moved[LEFT] @ moved[LEFT])
        self.assertAlmostEqual(task.reward_terms[0, 2], expected, delta=1e-3)
        self.assertLess(expected, 0.98 * WEIGHTS['end_effector'])
        if id_ == GENERAL:  # the knee's weight is 0.3 of 3.5
            expected = WEIGHTS['pose'] * np.exp(-2 * 0.3 / 3.5 * 0.25**2)
            self.assertAlmostEqual(task.reward_terms[0, 0], expected, delta=1e-4)

    @parameterized.parameters(
        (0.4, 1.0, 0.4), (1.2, 1.0, 1.2), (-3.0, 1.0, 3.0), (0.2, 3.0, 0.6), (-0.4, 2.0, 0.8),
        (2.0, 3.0, np.pi),
    )  # fmt: skip
    def test_planned_heading(self, off, scale, counted):
        """heading_scale multiplies the error."""
        environment, _ = self.placed(GENERAL, 0.1, heading_scale=scale)
        task = environment.task
        # Plans may turn round and round.
        task.plan.heading[0] = heading_of(environment) + off + 4 * np.pi
        task.observe()
        expected = WEIGHTS['heading'] * (0.5 + 0.5 * np.cos(counted)) ** 4
        self.assertAlmostEqual(task.reward_terms[0, 5], expected, delta=1e-9)
        self.assertAlmostEqual(environment.observation()['plan'][12], off, delta=1e-9)

    @parameterized.parameters(*BOTH)
    def test_the_root_and_the_centre_of_mass(self, id_):
        environment, _ = self.placed(id_, 0.1)
        task, data = environment.task, environment.physics.data
        data.qpos[task.body.pose_qpos[1 if id_ == PLANAR else 2]] += 0.1
        data.qvel[task.body.pose_dof[:2]] += (0.6, -0.8)
        environment.physics.forward()
        task.observe()
        found = task.reward_terms[0]
        self.assertAlmostEqual(found[4], WEIGHTS['root'] * np.exp(-0.1), delta=1e-3)
        self.assertAlmostEqual(found[3], WEIGHTS['com'] * np.exp(-1.0), delta=1e-3)
        # Both feet are higher by 0.1 m, which the height above the ground shows.
        expected = WEIGHTS['end_effector'] * np.exp(-5 * 0.02)
        self.assertAlmostEqual(found[2], expected, delta=1e-3)

    def test_reference_heads_as_the_body_did_at_the_switch(self):
        environment, _ = started(start_phase=0.4)
        task = environment.task
        for _ in range(3):
            environment.step(np.zeros(17))
        self.assertTrue(environment.info['landed'])
        pose, root = task.reference_pose(0), body(environment, 'xpos', 'root')
        np.testing.assert_allclose(pose[:2], root[:2], atol=1e-6)
        w, x, y, z = pose[3:7]
        ahead = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        self.assertLess(angle_between(ahead, heading_of(environment)), 1e-4)
        # The step of it is the nearest to the plan among all of the library.
        turn, feet = flattened(heading_of(environment)), ankles(environment)
        landing = (turn @ (task.plan.landing[0, 0] - feet[LEFT]))[:2] * [1, -1]  # left stance
        query = np.array([*landing, -(task.plan.heading[0] - heading_of(environment))])
        gap = (task.steps.features[:, 4:] - query) * (0.54, 0.54, 0.48)
        self.assertEqual(int(task.state.track[0]), int((gap**2).sum(1).argmin()) + len(task.steps))
        assert_refused(self, (lambda: task.clip_action(0), 'footsteps have no clip to follow'))
        # In the plane it begins where the body is.
        environment, _ = started(PLANAR, start_phase=0.3)
        task = environment.task
        for _ in range(6):
            self.assertTrue(environment.step(task.clip_action(0)).mid())
        self.assertTrue(environment.info['landed'])
        pose, root = task.reference_pose(0), body(environment, 'xpos', 'root')
        self.assertAlmostEqual(pose[0], root[0], delta=1e-9)
        np.testing.assert_allclose(pose[2:], task.clip.pose(0.5)[2:], atol=1e-6)


class LandingTest(parameterized.TestCase):
    """The landing error, and the end of an episode by a miss."""

    @parameterized.parameters(
        *(
            (id_, *case)
            for id_ in (*BOTH, BUMPS)
            for case in ((0.3, 0.01), (0.3, 50.0), (0.8, None))
        ),
        (MIRRORED, 0.3, None),
    )
    def test_a_large_landing_error_ends_the_episode(self, id_, phase, most):
        environment, _ = started(id_, start_phase=phase, max_landing_error=most)
        place, planned = environment.task.plan.landing[0, 0].copy(), heading(environment.task)[0]
        ends = most == 0.01
        for i in range(1, 7):
            self.assertEqual(
                (environment.info['landed'], environment.info['landing_error']), (False, 0)
            )
            step = environment.step(idle(environment))
            self.assertEqual(step.last(), ends and i == 6)  # 0.2 of a cycle later
        gap = (ankles(environment)[LEFT if phase < 0.5 else RIGHT] - place)[:2]
        gap[1] *= id_ != PLANAR
        self.assertAlmostEqual(environment.info['landing_error'], np.hypot(*gap), delta=1e-9)
        off = angle_between(planned, heading_of(environment))
        self.assertAlmostEqual(environment.info['heading_error'], off, delta=1e-9)
        self.assertEqual(step.discount, 0.0 if ends else 1.0)
        self.assertEqual(step.reward == 0, ends)
        self.assertEqual(set(environment.info['reward_terms'].values()) == {0.0}, ends)
        self.assertFalse(environment.info['diverged'])
        self.assertGreater(environment.info['landing_error'], 0.01)
        if ends:
            self.assertTrue(environment.step(idle(environment)).first())
            self.assertFalse(environment.info['landed'])
            self.assertEqual(environment.info['landing_error'], 0)
        elif environment.step(idle(environment)).mid():
            self.assertFalse(environment.info['landed'])
            self.assertAlmostEqual(
                environment.info['landing_error'], np.hypot(*gap)
            )  # the last one

    # A push is over after 4/30 s, when grace begins; the foot lands after 6/30 s.
    PUSH = {'force': (0, 0), 'duration': (1 / 30,) * 2, 'interval': (0.1, 0.1)}  # noqa: RUF012

    @parameterized.parameters(
        (0.03, {'pushes': PUSH}, [6]), (0.1, {'pushes': PUSH}, []),
        # The plan turns when a foot lands, after 6/30 s; the next one lands 15/30 s later.
        (0.0, {'plans': {'sharp': 1.0}}, [21]), (0.6, {'plans': {'sharp': 1.0}}, []),
    )  # fmt: skip
    def test_pushed_and_turning_walkers_may_miss(self, grace_period, options, ends):
        environment, _ = started(
            start_phase=0.3, max_landing_error=1e-3, grace_period=grace_period, **options
        )
        if 'plans' in options:
            environment.task.state.excused[0] = 6
        steps = 6 if 'pushes' in options else 21
        found = [i for i in range(1, steps + 1) if held(environment).last()]
        self.assertEqual(found, ends)

    @parameterized.parameters((PLANAR, {}), (GENERAL, {}), (GENERAL, {'plans': {'from_root': 1.0}}))
    def test_a_diverged_simulation_has_no_landing(self, id_, options):
        environment, _ = started(id_, start_phase=0.4, max_landing_error=5.0, **options)
        still = np.zeros(len(environment.action_map))
        for _ in range(2):
            kept = environment.step(still).observation
        environment.physics.data.qpos[environment.task.body.pose_qpos[:1]] = np.nan
        step = environment.step(still)  # at the switch of stance
        self.assertTrue(step.last())
        info = dict(environment.info)
        self.assertTrue(info['diverged'])
        self.assertFalse(info['fell'] or info['landed'])
        del info['reward_terms']
        self.assertTrue(np.isfinite(list(info.values())).all())
        for name, value in step.observation.items():
            np.testing.assert_array_equal(value, kept[name])
        self.assertTrue(environment.step(still).first())
        self.assertGreater(environment.step(idle(environment)).reward, 0.2)


class StartTest(parameterized.TestCase):
    """How episodes start; where: in imitation_test."""

    def test_phase_and_pose(self):
        """A uniform phase, and the pose of the straight step."""
        environments = VectorEnvironment(GENERAL, 400, 1, seed=0)
        environments.reset()
        assert_uniform(environments.task.phase, 0, 1)
        steps = motion.load_steps('biped3d_mocap')
        straight = int(np.flatnonzero((steps.labels == (0.5, 0.15, 0)).all(1))[0])
        for phase in (0.1, 0.6):
            environment, _ = started(start_phase=phase)
            figure, data = environment.task.body, environment.physics.data
            pose = steps.pose(straight, 0.2 * steps.duration, phase >= 0.5)
            rate = steps.velocity(straight, 0.2 * steps.duration, phase >= 0.5)
            np.testing.assert_allclose(data.qpos[figure.pose_qpos][3:], pose[3:], atol=1e-9)
            np.testing.assert_allclose(data.qvel[figure.pose_dof], rate, atol=1e-9)


class PushTest(parameterized.TestCase):
    """Forces on the torso."""

    def test_pushes_are_those_of_randomize(self):
        """Of the torso, with the same draws."""
        push = {'speed': (0.1, 0.5), 'duration': (0.1, 0.3), 'interval': (0.1, 0.3)}
        pushed = {'randomize': {'push': {**push, 'body': 'torso'}}}, {'pushes': push}
        first, second = (started(**options)[0] for options in pushed)
        for _ in range(30):
            held(first), held(second)
            np.testing.assert_array_equal(first.physics.data.qpos, second.physics.data.qpos)
            np.testing.assert_array_equal(first.info['impulse'], second.info['impulse'])
        self.assertEqual(first.task.config.pushes, None)
        defaults = started(pushes={})[0].task.config.pushes
        self.assertEqual((defaults.force, defaults.duration), ((50, 150), (0.2, 0.4)))


class MarkerTest(parameterized.TestCase):
    """What pictures point out."""

    @parameterized.parameters((PLANAR, ['box'] * 2), (GENERAL, ['box', 'box', 'arrow']),
                              (TRAIL, ['box', 'box', 'arrow', 'cylinder']))  # fmt: skip
    def test_markers(self, id_, shapes):
        task = started(id_, start_phase=0.1)[0].task
        markers = task.markers(0)
        self.assertEqual([marker.shape for marker in markers], shapes)
        for marker, place in zip(markers[:2], task.plan.landing[0], strict=True):
            # The sole under an ankle: within 8 cm of it, just above the ground.
            self.assertBetween(np.hypot(*(marker.position - place)[:2]), 0.02, 0.08)
            self.assertBetween(marker.position[2] - place[2], 0, 0.01)
            self.assertAlmostEqual(marker.yaw, heading(task)[0])
        self.assertNotEqual(markers[0].colour, markers[1].colour)
        if id_ == TRAIL:
            np.testing.assert_array_equal(markers[3].position, task.goal[0])

    @parameterized.parameters(*BOTH)
    def test_markers_are_drawn_and_change_nothing(self, id_):
        environment, _ = started(id_, start_phase=0.1)
        before = environment.physics.data.qpos.copy()
        colours = rendering.frame(environment, 120, 160).reshape(-1, 3).astype(int)
        orange = (colours[:, 0] - colours[:, 2] > 80).sum()  # where the swing foot lands
        blue = (colours[:, 2] - colours[:, 0] > 80).sum()  # where the stance foot does
        self.assertGreater(min(orange, blue), 5)
        environment.task.plan.landing[0, :, 0] += 100.0  # out of sight
        other = rendering.frame(environment, 120, 160).reshape(-1, 3).astype(int)
        self.assertLess((other[:, 2] - other[:, 0] > 80).sum(), blue)
        np.testing.assert_array_equal(environment.physics.data.qpos, before)


REFUSED = (
    *((id_, options, message) for id_ in BOTH for options, message in (
        ({'plans': {'length': (0.6, 0.5)}}, r'length is \(0.6, 0.5\)'), ({'plans': {'change': 1.5}}, 'change is 1.5'),
        ({'plans': 0.5}, 'plans is 0.5; expected a dict of options, or '),
        ({'max_landing_error': 0}, 'max_landing_error is 0'), ({'footstep_scale': -1}, 'footstep_scale is -1'),
        ({'reference_observation': True}, "unknown option.*'reference_observation'"),
    )),
    (PLANAR, {'plans': {'width': (0.1, 0.2)}}, "unknown option of plans 'width'"),
    *((GENERAL, {'hidden_plan': True, name: True}, f'hidden_plan and {name} cannot be combined')
      for name in ('mirrored', 'goal')),
    *((GENERAL, {'plans': {name: value}}, message) for name, value, message in (
        ('width', (-0.1, 0.2), 'width is'), ('width', (0.1, np.inf), 'width is'), ('sharp', -0.1, 'sharp is -0.1'),
        ('stay', (1, 1e30), r'stay is \(1, 1e\+30\); expected .* from 1 to 10000, in footsteps'),
        ('stay', 2.5, r'stay is \(2.5, 2.5\); expected whole numbers of footsteps, such as \(3, 3\)'),
        ('from_root', np.nan, 'from_root is nan'), ('react', 1.5, 'react is 1.5'), ('turn', -1, 'turn is -1'),
        ('lenght', 0.5, "unknown option of plans 'lenght'; did you mean 'length'"),
    )),
    (GENERAL, {'plans': np.zeros((2, 2))}, r'plans is array\(\[\[0'),
    (GENERAL, {'pushes': {'power': 1}}, "unknown option of pushes 'power'"),
    (GENERAL, {'pushes': {'force': (3, 2)}}, 'force is'), (GENERAL, {'grace_period': -1}, 'grace_period is -1'),
    (GENERAL, {'footstep_scale': ()}, 'footstep_scale is '), (GENERAL, {'heading_scale': -1}, 'heading_scale is -1'),
    (GENERAL, {'style': 'high_knee'}, "unknown style of 'biped3d_mocap' 'high_knee'; did you mean 'high_knees'"),
    (GENERAL, {'style': 'run'}, "unknown style of 'biped3d_mocap' 'run'"),  # of another character
    (GENERAL, {'style': 'mine.npz'}, "unknown style of 'biped3d_mocap' '.*mine.npz'"),
    (GENERAL, {'grace_period': 1.0}, 'grace_period is 1; it has no effect without max_landing_error'),
    (GENERAL, {'style': 'one_straight_leg', 'mirrored': True}, "mirrored: the steps 'biped3d_mocap_one_straight_leg'"),
    (FULL, {'style': 'in_place'}, "unknown style of 'biped3d_full_mocap' 'in_place'"),
    (GENERAL, {'footstep_scale': (1, np.inf)}, r'footstep_scale is \(1, inf'),
)  # fmt: skip


class OptionTest(parameterized.TestCase):
    def test_refused(self):
        build = functools.partial(suite.build, task='footsteps', clip='biped3d_full_mocap')
        assert_refused(
            self, *((lambda i=i, o=o: suite.make(i, o), message) for i, o, message in REFUSED),
            (lambda: build('biped3d_mocap'), "'biped3d_full_mocap'.*does not fit.*'biped3d_mocap'"),
        )  # fmt: skip

    def test_options_as_objects(self):
        straight, plans = StraightPlans(length=(0.3, 0.6)), Plans(length=(0.3, 0.6), sharp=0.0)
        self.assertIs(started(PLANAR, plans=straight)[0].task.plans, straight)
        environment, _ = started(plans=plans, pushes=PushConfig(force=90.0))
        self.assertIs(environment.task.plans, plans)
        with self.assertRaises(AttributeError):
            plans.turn = 1.0
        plans = Plans.parse('plans', {'length': 0.5, 'width': np.array([0, 0.2])})
        self.assertEqual((plans.length, plans.width.high), ((0.5, 0.5), 0.2))
