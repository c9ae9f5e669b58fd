"""Tests of the footstep controller's task: plans, observation, reward, start, ends."""

import numpy as np
from absl.testing import absltest, parameterized
from helpers import (
    LEFT,
    RIGHT,
    advance,
    angle_between,
    ankles,
    assert_goes_on,
    assert_rows_are_singles,
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

from trl_suite import motion, rendering, suite, terrain
from trl_suite.tasks import terms
from trl_suite.tasks.common.plans import Plans, Pushes
from trl_suite.vector import VectorEnvironment

GENERAL, MIRRORED = 'PD_Biped3D_LLC_General_Step-v0', 'PD_Biped3D_LLC_Symetric_Step-v0'
RUN, TRAIL = 'PD_Biped3D_LLC_Run_FootStep-v0', 'PD_Biped3D_LLC_Trail_Step-v0'
BUMPS, FULL = 'PD_Biped3D_LLC_Bumps_Step-v0', 'PD_Biped3D_FULL_Imitate-Steps-v0'
IDS = [id_ for id_ in suite.ALL_IDS if suite.find(id_).task_type == 'spatial_footsteps']
SCALES = {'pose': 2, 'velocity': 0.005, 'end_effector': 5, 'com': 10, 'root': 10}
SIDE = {RIGHT: -1, LEFT: 1}


def started(id_=GENERAL, **options):
    environment = made(id_, seed=8, step_limit=None, **options)
    return environment, environment.reset()


def held(environment):
    """Takes a step high in the air, where nothing falls."""
    task, data = environment.task, environment.physics.data
    data.qpos[task.figure.pose_qpos[:7]] = 0, 0, 8, 1, 0, 0, 0
    data.qvel[task.figure.pose_dof] = 0
    environment.physics.forward()
    return environment.step(np.zeros(len(environment.action_map)))


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
        before = task.landing.copy(), task.heading.copy()
        everyone = task.world.all_ids
        task.apply_action(np.zeros((n, len(environments.action_map))), everyone)
        task.finish_step(everyone)
        if task.plan.landed.any():
            assert task.plan.landed.all()
            found.append((*before, task.landing.copy(), task.heading.copy(), int(task.stance[0])))
    return environments, found


class ClockTest(parameterized.TestCase):
    """The clock determines the stance foot."""

    @parameterized.parameters(
        (GENERAL, 0.0, [15, 30, 45, 60]), (GENERAL, 0.1, [12, 27, 42, 57]),
        (GENERAL, 0.6, [12, 27, 42, 57]), (MIRRORED, 0.0, [15, 30, 45]), (RUN, 0.0, [9, 18, 27]),
        (FULL, 0.5, [15, 30]),
    )  # fmt: skip
    def test_stance_switches(self, id_, phase, expected):
        environment, _ = started(id_, start_phase=phase)
        period = 0.6 if id_ == RUN else 1.0
        found, task = [], environment.task
        self.assertAlmostEqual(task.period, period)
        for i in range(1, expected[-1] + 1):
            before = task.stance[0]
            held(environment)
            if task.stance[0] != before:
                found.append(i)
            self.assertEqual(environment.info['landed'], task.stance[0] != before)
            now = (phase + i / 30 / period + 1e-9) % 1
            self.assertEqual(task.stance[0], RIGHT if now < 0.5 else LEFT)
        self.assertEqual(found, expected)

    @parameterized.parameters(0.0, 0.3, 0.5, 0.9)
    def test_plan_slots(self, phase):
        environment, step = started(start_phase=phase)
        for _ in range(20):
            plan, task = step.observation['plan'], environment.task
            right = step.observation['phase'][0] < 0.5
            slots = plan[:12].reshape(2, 2, 3)  # first and second place; from right and left foot
            np.testing.assert_array_equal(slots[0, 0 if right else 1], 0)
            np.testing.assert_array_equal(slots[1, 1 if right else 0], 0)
            turn, feet = flattened(heading_of(environment)), ankles(environment)
            for which, foot in ((0, LEFT if right else RIGHT), (1, RIGHT if right else LEFT)):
                expected = turn @ (task.landing[0, which] - feet[foot])
                expected[2] = 0.0  # the plane is as high as that under the root
                np.testing.assert_allclose(slots[which, foot], expected, atol=1e-9)
            off = angle_between(task.heading[0], heading_of(environment))
            self.assertAlmostEqual(abs(plan[12]), off, delta=1e-9)
            self.assertLess(
                angle_between(heading_of(environment) + plan[12], task.heading[0]), 1e-9
            )
            step = environment.step(0.1 * np.ones(17))

    def test_contacts(self):
        environment, _ = started(start_phase=0.0)
        seen = set()
        for _ in range(25):
            step = environment.step(np.zeros(17))
            links = links_on_ground(environment)
            expected = [float(f'{side}_ankle' in links) for side in ('right', 'left')]
            np.testing.assert_array_equal(step.observation['contact'], expected)
            seen.add(tuple(expected))
            if step.last():
                break
        self.assertGreater(len(seen), 1)

    def test_observation_sizes_of_the_documentation(self):
        self.assertEqual(started()[0].blocks, {
            'pose': slice(0, 57), 'velocity': slice(57, 105), 'phase': slice(105, 110),
            'contact': slice(110, 112), 'plan': slice(112, 125),
        })  # fmt: skip
        self.assertEqual(started(FULL)[0].blocks, {
            'pose': slice(0, 113), 'velocity': slice(113, 209), 'phase': slice(209, 214),
            'contact': slice(214, 216), 'plan': slice(216, 229),
        })  # fmt: skip

    @parameterized.parameters((GENERAL, 22), (RUN, 22), (FULL, 45))
    def test_actions_of_the_original(self, id_, size):
        environment, step = started(id_, action_offset='original')
        self.assertEqual(environment.action_spec().shape, (size,))
        self.assertTrue(environment.step(np.zeros(size)).mid())
        self.assertLen(step.observation['plan'], 13)


class PlanTest(parameterized.TestCase):
    """How plans are drawn."""

    @parameterized.parameters(0.0, 0.2, 0.5, 0.8)
    def test_the_first_plan(self, phase):
        # Along +x, the feet on lines half a width from the line of the start.
        environment, _ = started(start_phase=phase)
        task, feet = environment.task, ankles(environment)
        stance = RIGHT if phase < 0.5 else LEFT
        swing = 1 - stance
        self.assertEqual(task.heading[0], 0)
        first, second = task.landing[0]
        np.testing.assert_allclose(
            first, [feet[stance, 0] + 0.5, SIDE[swing] * 0.075, 0], atol=1e-9
        )
        np.testing.assert_allclose(second, [feet[stance, 0] + 1.0, SIDE[stance] * 0.075, 0],
                                   atol=1e-9)  # fmt: skip

    @parameterized.parameters((GENERAL, 0.5, 0.15), (RUN, 1.15, 0.15), (FULL, 0.5, 0.15))
    def test_each_step_is_laid_from_the_one_before(self, id_, length, width):
        _, found = walked(4, 12, id_)
        stances = []
        for landing, _, after, heading, stance in found:
            np.testing.assert_array_equal(after[:, 0], landing[:, 1])
            for env_id in range(4):
                way = flattened(heading[env_id])[:2, :2] @ (after[env_id, 1] - after[env_id, 0])[:2]
                np.testing.assert_allclose(way, [length, SIDE[stance] * width], atol=1e-9)
            stances.append(stance)
        self.assertEqual(stances, [LEFT, RIGHT] * 6)

    def test_the_run_goes_straight_on(self):
        _, found = walked(3, 10, RUN)
        for _, before, _, after, _ in found:
            np.testing.assert_array_equal(before, 0)
            np.testing.assert_array_equal(after, 0)

    def test_headings_walk_at_random(self):
        _, found = walked(100, 30)
        turns = np.array([after - before for _, before, _, after, _ in found]).ravel()
        # N(0, 0.25) in nine steps of ten, U(-pi, pi) in the tenth.
        self.assertLess(np.abs(turns).max(), np.pi)
        far = np.abs(turns) > 1.25  # five deviations
        probability = 0.1 * (1 - 1.25 / np.pi)
        deviation = np.sqrt(probability * (1 - probability) / len(turns))
        self.assertAlmostEqual(far.mean(), probability, delta=4 * deviation)
        near = np.abs(turns) < 0.25
        probability = 0.9 * 0.6827 + 0.1 * 0.25 / np.pi
        deviation = np.sqrt(probability * (1 - probability) / len(turns))
        self.assertAlmostEqual(near.mean(), probability, delta=4 * deviation)
        self.assertAlmostEqual(turns[~far].mean(), 0, delta=0.03)

    def test_sharp_turns_only(self):
        _, found = walked(50, 20, plans={'sharp': 1.0})
        turns = [after - before for _, before, _, after, _ in found]
        assert_uniform(turns, -np.pi, np.pi)

    def test_gentle_turns_only(self):
        _, found = walked(50, 20, plans={'sharp': 0.0, 'turn': 0.1})
        turns = np.array([after - before for _, before, _, after, _ in found])
        self.assertAlmostEqual(turns.std(), 0.1, delta=0.1 * 4 / np.sqrt(2 * turns.size))
        self.assertAlmostEqual(turns.mean(), 0.0, delta=0.1 * 4 / np.sqrt(turns.size))

    def ways(self, found):
        """Lengths and widths of the planned steps, (switches, n) each."""
        lengths, widths = [], []
        for _, _, after, heading, stance in found:
            x, y = (after[:, 1] - after[:, 0])[:, :2].T
            cosine, sine = np.cos(heading), np.sin(heading)
            lengths.append(cosine * x + sine * y)
            widths.append(SIDE[stance] * (cosine * y - sine * x))
        return np.array(lengths), np.array(widths)

    def test_lengths_and_widths_are_uniform(self):
        _, found = walked(
            50, 16, plans={'length': (0.25, 0.7), 'width': (0.1, 0.25), 'change': 1.0}
        )
        lengths, widths = self.ways(found)
        assert_uniform(lengths, 0.25 - 1e-9, 0.7 + 1e-9)
        assert_uniform(widths, 0.1 - 1e-9, 0.25 + 1e-9)
        self.assertLess(abs(np.corrcoef(lengths.ravel(), widths.ravel())[0, 1]), 0.13)

    @parameterized.parameters(0.0, 0.1, 0.6)
    def test_lengths_change_occasionally(self, change):
        _, found = walked(60, 20, plans={'length': (0.25, 0.7), 'change': change})
        lengths, _ = self.ways(found)
        changed = np.abs(np.diff(lengths, axis=0)) > 1e-9
        deviation = np.sqrt(change * (1 - change) / changed.size)
        self.assertAlmostEqual(changed.mean(), change, delta=4 * deviation)
        self.assertGreater(np.ptp(lengths[0]), 0.3)  # redrawn at every start

    def test_plans_made_from_the_root(self):
        environments, found = walked(60, 16, plans={'from_root': 1.0, 'root_turn': 0.45})
        task = environments.task
        measured = task.figure.measure()
        lengths, widths, turns = [], [], []
        for _, _, after, heading, stance in found:
            turns.append(heading - measured.heading)
            places = [measured.feet[:, stance, :2], after[:, 0, :2], after[:, 1, :2]]
            for which, foot in ((0, 1 - stance), (1, stance)):
                x, y = (places[which + 1] - places[which]).T
                cosine, sine = np.cos(heading), np.sin(heading)
                lengths.append(cosine * x + sine * y)
                widths.append(SIDE[foot] * (cosine * y - sine * x))
        assert_uniform(lengths, 0.2 - 1e-9, 0.7 + 1e-9)
        assert_uniform(widths, 0.08 - 1e-9, 0.28 + 1e-9)
        turns = np.ravel(turns)
        self.assertLessEqual(np.abs(turns).max(), 1.2 + 1e-9)
        # N(0, 0.45) truncated at 1.2, which is 2.67 deviations.
        self.assertAlmostEqual(turns.std(), 0.448, delta=0.045)
        self.assertBetween(np.mean(np.abs(turns) > 1.2 - 1e-6), 0.0, 0.025)

    def test_some_plans_from_the_root(self):
        _, found = walked(80, 12, plans={'from_root': 0.3})
        share = np.mean([
            np.abs(after[:, 0] - before[:, 1]).max(1) > 1e-12 for before, _, after, _, _ in found
        ])  # fmt: skip
        self.assertAlmostEqual(share, 0.3, delta=4 * np.sqrt(0.21 / (80 * 12)))

    @parameterized.parameters('hills3d', 'stairs3d', 'checkers3d', 'steps3d', 'trail3d2')
    def test_places_lie_on_the_ground(self, preset):
        environment = suite.build(
            'biped3d_mocap', terrain=preset, task='footsteps',
            task_kwargs={'random': 4, 'step_limit': None, 'start_phase': 0.4},
        )  # fmt: skip
        task = environment.task
        for _ in range(3):
            step = environment.reset()
            for _ in range(6):
                x, y, z = task.landing[0].T
                # Height grids are stored in single precision.
                np.testing.assert_allclose(z, ground(environment, x, y), atol=1e-6)
                root = body(environment, 'xpos', 'root')
                slots = step.observation['plan'][:12].reshape(2, 2, 3)
                used = slots[[0, 1], [1 - task.stance[0], task.stance[0]], 2]
                np.testing.assert_allclose(used, z - ground(environment, *root[:2]), atol=1e-6)
                step = environment.step(np.zeros(17))

    def test_turned_starts(self):
        # Among blocks episodes start anywhere, heading anywhere: all is turned with the body.
        environment = suite.build(
            'biped3d_mocap', terrain='obstacles3d', task='footsteps',
            task_kwargs={'random': 4, 'start_phase': 0.2},
        )  # fmt: skip
        first, headings = None, []
        for _ in range(6):
            step = environment.reset()
            heading = heading_of(environment)
            headings.append(heading)
            # Contacts aside, which are of the last substep.
            seen = np.concatenate([step.observation[n] for n in ('pose', 'velocity', 'plan')])
            first = seen if first is None else first
            np.testing.assert_allclose(seen, first, rtol=0, atol=1e-9)
            # Forward is where it heads.
            rate = environment.physics.data.qvel[environment.task.figure.pose_dof]
            along = np.array([np.cos(heading), np.sin(heading)])
            self.assertGreater(rate[:2] @ along, 0.5)
            self.assertGreater(np.abs(body(environment, 'xpos', 'root')[:2]).max(), 2)
            environment.task.observe()
            np.testing.assert_allclose(
                environment.task.reward_terms[0, :5] / list(WEIGHTS.values())[:5], 1, atol=2e-3
            )
        self.assertGreater(np.ptp(headings), 2)


class GoalTest(parameterized.TestCase):
    """Plans that head for a goal."""

    @parameterized.parameters(TRAIL, GENERAL)
    def test_plans_head_for_the_goal(self, id_):
        environment, _ = started(id_, goal=True, start_phase=0.0)
        task = environment.task
        for _ in range(5):
            environment.reset()
            root, feet = body(environment, 'xpos', 'root'), ankles(environment)
            way = task.goal[0, :2] - root[:2]
            self.assertGreater(np.hypot(*way), 0.1)
            self.assertLess(angle_between(task.heading[0], np.arctan2(way[1], way[0])), 1e-9)
            self.assertAlmostEqual(
                task.goal[0, 2], ground(environment, *task.goal[0, :2]), delta=1e-6
            )
            # The first place is a step from the foot that stands.
            length = 0.4 if id_ == TRAIL else 0.5
            step = flattened(task.heading[0])[:2, :2] @ (task.landing[0, 0] - feet[RIGHT])[:2]
            np.testing.assert_allclose(step, [length, 0.15], atol=1e-9)

    def test_at_a_switch_from_the_middle_of_the_old_plan(self):
        environment, _ = started(TRAIL, start_phase=0.4)
        task = environment.task
        goal, places = task.goal[0].copy(), task.landing[0].copy()
        root = body(environment, 'xpos', 'root')
        reached = np.hypot(*(root - goal)[:2]) < 1
        for _ in range(3):
            environment.step(np.zeros(17))
        self.assertEqual(task.stance[0], LEFT)
        self.assertEqual((task.goal[0] != goal).any(), reached)
        way = task.goal[0, :2] - places.mean(0)[:2]
        self.assertLess(angle_between(task.heading[0], np.arctan2(way[1], way[0])), 1e-9)

    def test_goal_is_redrawn_on_arrival(self):
        for near in (False, True):
            environment, _ = started(goal=True, start_phase=0.4)
            task = environment.task
            x, y, _ = body(environment, 'xpos', 'root')
            task.goal[0, :2] = x + (0.7 if near else 2.0), y + 0.3
            goal = task.goal[0].copy()
            for _ in range(3):
                self.assertTrue((task.goal[0] == goal).all())  # only at the switch
                environment.step(np.zeros(17))
            self.assertEqual((task.goal[0] != goal).any(), near)

    def test_a_goal_that_is_too_near_has_no_direction(self):
        environment, _ = started(start_phase=0.4, goal=True)
        task = environment.task
        before = task.heading[0]
        task.goal[0, :2] = task.landing[0, :, :2].mean(0) + 0.05
        data = environment.physics.data
        data.qpos[task.figure.pose_qpos[1]] += 5.0  # far enough for it to stay
        environment.physics.forward()
        for _ in range(3):
            environment.step(np.zeros(17))
        self.assertEqual(task.heading[0], before)

    def test_the_walk_on_the_trail_continues(self):
        environments, found = walked(20, 4, TRAIL)
        task = environments.task
        for env_id in range(20):
            spawn = task.travel.origin[env_id]
            way = task.goal[env_id, :2] - spawn[:2]
            # Within the next segments of the trail, which are 2 m long.
            self.assertLess(np.hypot(*way), 9)
        self.assertLen(found, 4)


class RewardTest(parameterized.TestCase):
    """The reward of the specification."""

    def test_weights_and_scales(self):
        task = started()[0].task
        self.assertEqual([term.name for term in task.terms], list(WEIGHTS))
        for term in task.terms:
            self.assertAlmostEqual(term.weight, WEIGHTS[term.name], delta=1e-12)
            self.assertEqual(term.scale, SCALES.get(term.name))
        self.assertAlmostEqual(sum(term.weight for term in task.terms), 1, delta=1e-12)

    def test_factor_of_the_heading_error(self):
        angles = (0.0, np.pi / 2, np.pi, -np.pi / 2, np.pi / 3, 2 * np.pi)
        found = [terms.facing(angle) for angle in angles]
        np.testing.assert_allclose(found, [1, 1 / 16, 0, 1 / 16, 0.75**4, 1], atol=1e-12)

    def placed(self, id_, phase, **options):
        """An environment with the body exactly where its reference is, and the plan on its step."""
        environment, _ = started(id_, start_phase=phase, **options)
        task = environment.task
        steps, mirrored = task.steps, phase >= 0.5
        # The straight step of about the planned length.
        length = task.plans.length[0]
        straight = np.flatnonzero((steps.labels[:, 2] == 0) & (steps.labels[:, 1] == 0.15))
        index = straight[np.argmin(np.abs(steps.labels[straight, 0] - length))]
        time = (2 * phase % 1) * steps.duration
        end = steps.pose(index, steps.duration, mirrored)
        put(environment, end, np.zeros(len(task.figure.pose_dof)))
        swing = RIGHT if mirrored else LEFT
        landing = ankles(environment)[swing]
        pose, rate = steps.pose(index, time, mirrored), steps.velocity(index, time, mirrored)
        landing[:2] -= pose[:2]
        pose[:2] = 0
        put(environment, pose, rate)
        task.landing[0, 0] = *landing[:2], 0
        task.heading[0] = heading_of(environment)
        task.observe()
        return environment, landing

    @parameterized.parameters(
        *((id_, phase) for id_ in (GENERAL, MIRRORED, RUN, FULL) for phase in
          (0.02, 0.11, 0.24, 0.499999, 0.53, 0.7, 0.999999)),
    )  # fmt: skip
    def test_the_reference_pose_has_full_reward(self, id_, phase):
        # In the second half of a step the swing foot is only there when it lands.
        environment, _ = self.placed(id_, phase)
        for found, (name, weight) in zip(
            environment.task.reward_terms[0], WEIGHTS.items(), strict=True
        ):
            self.assertAlmostEqual(found, weight, delta=1e-3 * weight, msg=name)
        self.assertAlmostEqual(environment.task.reward_terms[0].sum(), 1, delta=1e-3)

    @parameterized.parameters(
        *((phase, scale) for phase in (0.3, 0.4, 0.77, 0.95) for scale in (1.0, 5.0, (1.5, 8.0)))
    )
    def test_second_half_of_a_step(self, phase, scale):
        environment, landing = self.placed(GENERAL, phase, footstep_scale=scale)
        task = environment.task
        swing = RIGHT if phase >= 0.5 else LEFT
        ankle = ankles(environment)[swing]
        away = landing - ankle
        away[2] = 0.0  # as high above the landing place as the reference's
        scales = np.atleast_1d(scale)  # of several, the mean counts
        expected = WEIGHTS['end_effector'] * np.exp(-5 * scales * (away @ away)).mean()
        self.assertAlmostEqual(task.reward_terms[0, 2], expected, delta=2e-3)
        # The place may be higher: then the foot shall be.
        task.landing[0, 0, 2] = 0.1
        task.observe()
        expected = WEIGHTS['end_effector'] * np.exp(-5 * scales * (away @ away + 0.01)).mean()
        self.assertAlmostEqual(task.reward_terms[0, 2], expected, delta=2e-3)

    @parameterized.parameters(0.1, 0.2, 0.6, 0.7)
    def test_first_half_of_a_step_ignores_the_plan(self, phase):
        environment, _ = self.placed(GENERAL, phase)
        task = environment.task
        task.landing[0] += 1.0
        task.observe()
        self.assertAlmostEqual(task.reward_terms[0, 2], WEIGHTS['end_effector'], delta=1e-4)

    def test_a_displaced_foot_lowers_the_reward(self):
        environment, _ = self.placed(GENERAL, 0.1)  # in the first half of a step
        task = environment.task
        before = ankles(environment)
        environment.physics.named.data.qpos['biped3d_mocap/left_knee'] -= 0.25
        environment.physics.forward()
        task.observe()
        moved = ankles(environment) - before
        np.testing.assert_allclose(moved[RIGHT], 0, atol=1e-12)
        self.assertAlmostEqual(
            task.reward_terms[0, 2], WEIGHTS['end_effector'] * np.exp(-5 * moved[LEFT] @ moved[LEFT]),
            delta=1e-4,
        )  # fmt: skip
        # The knee's weight is 0.3 of 3.5.
        self.assertAlmostEqual(
            task.reward_terms[0, 0], WEIGHTS['pose'] * np.exp(-2 * 0.3 / 3.5 * 0.25**2), delta=1e-4
        )

    @parameterized.parameters(0.4, 1.2, -3.0)
    def test_planned_heading(self, off):
        environment, _ = self.placed(GENERAL, 0.1)
        task = environment.task
        task.heading[0] = (
            heading_of(environment) + off + 4 * np.pi
        )  # plans may turn round and round
        task.observe()
        expected = WEIGHTS['heading'] * (0.5 + 0.5 * np.cos(off)) ** 4
        self.assertAlmostEqual(task.reward_terms[0, 5], expected, delta=1e-9)
        self.assertAlmostEqual(environment.observation()['plan'][12], off, delta=1e-9)

    @parameterized.parameters((0.2, 3.0, 0.6), (-0.4, 2.0, 0.8), (2.0, 3.0, np.pi))
    def test_heading_scale_multiplies_the_heading_error(self, off, scale, counted):
        environment, _ = self.placed(GENERAL, 0.1, heading_scale=scale)
        task = environment.task
        task.heading[0] = heading_of(environment) + off
        task.observe()
        expected = WEIGHTS['heading'] * (0.5 + 0.5 * np.cos(counted)) ** 4
        self.assertAlmostEqual(task.reward_terms[0, 5], expected, delta=1e-9)
        self.assertAlmostEqual(environment.observation()['plan'][12], off, delta=1e-9)

    def test_the_root_and_the_centre_of_mass(self):
        environment, _ = self.placed(GENERAL, 0.1)
        task, data = environment.task, environment.physics.data
        data.qpos[task.figure.pose_qpos[2]] += 0.1
        data.qvel[task.figure.pose_dof[:3]] += (0.6, -0.8, 0.0)
        environment.physics.forward()
        task.observe()
        self.assertAlmostEqual(task.reward_terms[0, 4], WEIGHTS['root'] * np.exp(-0.1), delta=1e-4)
        self.assertAlmostEqual(task.reward_terms[0, 3], WEIGHTS['com'] * np.exp(-1.0), delta=1e-4)
        # Both feet are higher by 0.1 m, which the height above the ground shows.
        self.assertAlmostEqual(
            task.reward_terms[0, 2], WEIGHTS['end_effector'] * np.exp(-5 * 0.02), delta=1e-4
        )

    def test_reference_heads_as_the_body_did_at_the_switch(self):
        environment, _ = started(start_phase=0.4)
        task = environment.task
        for _ in range(3):
            environment.step(np.zeros(17))
        self.assertTrue(environment.info['landed'])
        pose = task.reference_pose(0)
        root = body(environment, 'xpos', 'root')
        np.testing.assert_allclose(pose[:2], root[:2], atol=1e-6)
        w, x, y, z = pose[3:7]
        heading = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        self.assertLess(angle_between(heading, heading_of(environment)), 1e-4)
        # The step of it is the nearest to the plan among all of the library.
        turn, feet = flattened(heading_of(environment)), ankles(environment)
        sign = np.array([1, -1])  # left stance
        landing = (turn @ (task.landing[0, 0] - feet[LEFT]))[:2] * sign
        query = np.array([*landing, -(task.heading[0] - heading_of(environment))])
        gap = (task.steps.features[:, 4:] - query) * (0.54, 0.54, 0.48)
        self.assertEqual(int(task.state.track[0]), int((gap**2).sum(1).argmin()) + len(task.steps))

    def test_terms_sum_to_the_reward(self):
        environment, _ = started(BUMPS)
        self.assertEqual(set(environment.info['reward_terms'].values()), {0.0})
        for _ in range(40):
            step = environment.step(np.zeros(17))
            terms = environment.info['reward_terms']
            self.assertEqual(list(terms), list(WEIGHTS))
            self.assertAlmostEqual(sum(terms.values()), step.reward, delta=1e-12)
            if step.last():
                break
        self.assertEqual(step.reward, 0)


class LandingTest(parameterized.TestCase):
    """The landing error, and the end of an episode by a miss."""

    @parameterized.parameters((GENERAL, 0.3), (GENERAL, 0.8), (MIRRORED, 0.3), (BUMPS, 0.3))
    def test_landing_error(self, id_, phase):
        environment, _ = started(id_, start_phase=phase)
        task = environment.task
        place, heading = task.landing[0, 0].copy(), task.heading[0]
        self.assertEqual(environment.info['landing_error'], 0)
        while True:
            step = environment.step(np.zeros(17))
            self.assertTrue(step.mid())
            if environment.info['landed']:
                break
            self.assertEqual(environment.info['landing_error'], 0)
        foot = ankles(environment)[LEFT if phase < 0.5 else RIGHT]
        self.assertAlmostEqual(
            environment.info['landing_error'], np.hypot(*(foot - place)[:2]), delta=1e-9
        )
        self.assertGreater(environment.info['landing_error'], 0.01)
        self.assertAlmostEqual(
            environment.info['heading_error'], angle_between(heading, heading_of(environment)),
            delta=1e-9,
        )  # fmt: skip
        error = environment.info['landing_error']
        step = environment.step(np.zeros(17))
        if step.mid():
            self.assertFalse(environment.info['landed'])
            self.assertEqual(environment.info['landing_error'], error)  # stays until the next one

    @parameterized.parameters((0.01, True), (50.0, False), (None, False))
    def test_max_landing_error_ends_the_episode(self, max_landing_error, ends):
        environment, _ = started(start_phase=0.3, max_landing_error=max_landing_error)
        for i in range(1, 7):
            step = environment.step(np.zeros(17))
            self.assertEqual(step.last(), ends and i == 6)  # 0.2 of a cycle later
        self.assertEqual(step.discount, 0.0 if ends else 1.0)
        self.assertEqual(step.reward == 0, ends)
        self.assertFalse(environment.info['diverged'])
        self.assertGreater(environment.info['landing_error'], 0.01)
        if ends:
            self.assertTrue(environment.step(np.zeros(17)).first())
            self.assertFalse(environment.info['landed'])
            self.assertEqual(environment.info['landing_error'], 0)

    @parameterized.parameters({}, {'goal': True}, {'plans': {'from_root': 1.0}})
    def test_a_diverged_simulation_has_no_landing(self, **options):
        environment, _ = started(start_phase=0.4, max_landing_error=5.0, **options)
        for _ in range(2):
            kept = environment.step(np.zeros(17)).observation
        environment.physics.data.qpos[environment.task.figure.pose_qpos[:2]] = np.nan
        step = environment.step(np.zeros(17))  # at the switch of stance
        self.assertTrue(step.last())
        self.assertTrue(environment.info['diverged'])
        self.assertFalse(environment.info['fell'])
        self.assertFalse(environment.info['landed'])
        for name, value in environment.info.items():
            if name != 'reward_terms':
                self.assertTrue(np.isfinite(value), name)
        for name, value in step.observation.items():
            np.testing.assert_array_equal(value, kept[name])
        step = environment.step(np.zeros(17))
        self.assertTrue(step.first())
        self.assertGreater(environment.step(np.zeros(17)).reward, 0.2)

    @parameterized.parameters(*IDS)
    def test_a_fall_ends_the_episode(self, id_):
        environment, _ = started(id_)
        fall = set(environment.task.character.spec.fall_links)
        size, rng = len(environment.action_map), np.random.default_rng(0)
        for _ in range(300):
            step = environment.step(rng.uniform(-1, 1, size))
            self.assertEqual(bool(links_on_ground(environment) & fall), step.last())
            if step.last():
                break
        self.assertEqual((step.reward, step.discount), (0.0, 0.0))
        self.assertTrue(environment.info['fell'])


class StartTest(parameterized.TestCase):
    """Where episodes start."""

    @parameterized.parameters(*sorted(terrain.PRESETS3D))
    def test_starts_do_not_penetrate_the_ground(self, preset):
        environment = suite.build(
            'biped3d_mocap', terrain=preset, task='footsteps', task_kwargs={'random': 31}
        )
        for _ in range(4):
            environment.reset()
            clearance = []
            for geom in environment.task.character.collision_geoms:
                bound = environment.physics.bind(geom)
                box = np.array(np.meshgrid(*[(-1, 1)] * 3)).reshape(3, 8).T * bound.size
                corners = bound.xpos + box @ bound.xmat.reshape(3, 3).T
                clearance.append(corners[:, 2] - ground(environment, *corners[:, :2].T))
            self.assertGreater(np.min(clearance), 0.0005)
            spawn = environment.task.travel.origin[0]
            np.testing.assert_allclose(body(environment, 'xpos', 'root')[:2], spawn[:2], atol=1e-12)
            self.assertTrue(environment.step(np.zeros(17)).mid())

    def test_phases_are_uniform(self):
        environments = VectorEnvironment(GENERAL, 400, 1, seed=0)
        environments.reset()
        assert_uniform(environments.task.phase, 0, 1)

    def test_pose_is_that_of_the_straight_step(self):
        steps = motion.load_steps('biped3d_mocap')
        straight = int(np.flatnonzero((steps.labels == (0.5, 0.15, 0)).all(1))[0])
        for phase in (0.1, 0.6):
            environment, _ = started(start_phase=phase)
            task, data = environment.task, environment.physics.data
            pose = steps.pose(straight, 0.2 * steps.duration, phase >= 0.5)
            rate = steps.velocity(straight, 0.2 * steps.duration, phase >= 0.5)
            np.testing.assert_allclose(data.qpos[task.figure.pose_qpos][3:], pose[3:], atol=1e-9)
            np.testing.assert_allclose(data.qvel[task.figure.pose_dof], rate, atol=1e-9)


class MovingGroundTest(parameterized.TestCase):
    """Belts and moving boxes."""

    def test_velocity_against_a_belt(self):
        environment = suite.build(
            'biped3d_mocap', terrain='conveyor3d_wide', task='footsteps',
            task_kwargs={'random': 2, 'start_phase': 0.1},
        )  # fmt: skip
        beside = environment.reset().observation['velocity'].reshape(8, 6)
        task, data = environment.task, environment.physics.data
        velocity = task.arena.grounds[0].layout.belts.velocity[0]
        self.assertAlmostEqual(np.linalg.norm(velocity), 0.6)
        pose, rate = data.qpos[task.figure.pose_qpos], data.qvel[task.figure.pose_dof]
        pose[:2] = 5.5, 1.0  # on the strip from x = 3 to 8 m
        put(environment, pose, rate)
        task.arena.recentre(np.zeros(1, int), pose[None, :2])
        task.observe()
        upon = environment.observation()['velocity'].reshape(8, 6)
        seen = flattened(heading_of(environment))[:2, :2] @ velocity
        np.testing.assert_allclose(upon[:, :2], beside[:, :2] - seen, atol=1e-9)
        np.testing.assert_allclose(upon[:, 2:], beside[:, 2:], atol=1e-9)

    def test_walks_among_moving_boxes(self):
        environment = suite.build(
            'biped3d_mocap', terrain='dynamic_obstacles3d', task='footsteps',
            task_kwargs={'random': 2, 'goal': True, 'terrain_observation': 'height'},
        )  # fmt: skip
        for _ in range(3):
            step = environment.reset()
            while not step.last():
                step = environment.step(np.zeros(17))
                for value in step.observation.values():
                    self.assertTrue(np.isfinite(value).all())


class PushTest(parameterized.TestCase):
    """Forces on the torso."""

    def test_pushes(self):
        options = {'force': (80, 80), 'duration': (0.2, 0.2), 'interval': (0.5, 0.5)}
        environment, _ = started(pushes=options)
        torso = environment.physics.model.ptr.body('biped3d_mocap/torso').id
        pushed = []
        for _ in range(60):
            held(environment)
            force = environment.physics.data.xfrc_applied[torso]
            pushed.append(bool(force.any()))
            if pushed[-1]:
                self.assertAlmostEqual(np.linalg.norm(force), 80, delta=1e-9)
                np.testing.assert_array_equal(force[2:], 0)
        # 15 steps without, 6 with, from the start on.
        np.testing.assert_array_equal(pushed, ([False] * 15 + [True] * 6) * 2 + [False] * 15
                                      + [True] * 3)  # fmt: skip

    @parameterized.parameters((0.03, True), (0.1, False))
    def test_pushed_walkers_may_miss(self, grace_period, ends):
        # A push is over after 4/30 s, when grace begins; the foot lands after 6/30 s.
        pushes = {'force': (0, 0), 'duration': (1 / 30,) * 2, 'interval': (0.1, 0.1)}
        environment, _ = started(
            start_phase=0.3, max_landing_error=0.01, grace_period=grace_period, pushes=pushes
        )
        for i in range(1, 7):
            self.assertEqual(environment.step(np.zeros(17)).last(), ends and i == 6)

    @parameterized.parameters((0.0, True), (0.6, False))
    def test_sharp_turns_allow_a_miss(self, grace_period, ends):
        # The plan turns when a foot lands, after 6/30 s; the next one lands 15/30 s later.
        environment, _ = started(
            start_phase=0.3, max_landing_error=1e-3, grace_period=grace_period, plans={'sharp': 1.0}
        )
        environment.task.state.excused[0] = 6
        for _ in range(6):
            self.assertFalse(held(environment).last())
        ended = [held(environment).last() for _ in range(15)]
        self.assertEqual(ended, [False] * 14 + [ends])


class SaveTest(parameterized.TestCase):
    """Saved states and pickles continue bit for bit; simulations equal single environments."""

    OPTIONS = (
        (GENERAL, {}), (TRAIL, {'terrain_observation': 'height'}), (MIRRORED, {'plans': {'from_root': 0.5}}),
        (RUN, {}), (FULL, {}), (BUMPS, {'mirrored': True, 'terrain_observation': 'height', 'pushes': {}}),
        (GENERAL, {'goal': True, 'mirrored': True, 'max_landing_error': 0.3}),
    )  # fmt: skip

    def advance(self, environment, seed):
        task = environment.task
        return advance(
            environment, seed, 40, 0.3,
            lambda _: (task.plan.landing_error, task.heading, task.goal[0], task.landing[0].ravel()),
        )  # fmt: skip

    @parameterized.parameters(*OPTIONS)
    def test_a_state_within_a_step_continues_exactly(self, id_, options):
        environment, other = (suite.make(id_, {'random': seed, **options}) for seed in (6, 9))
        environment.reset()
        other.reset()
        for _ in range(4):
            environment.step(np.zeros(len(environment.action_map)))
        self.advance(other, 4)
        assert_goes_on(environment, other, self.advance)

    @parameterized.parameters('dynamic_obstacles3d', 'conveyor3d')
    def test_on_moving_ground(self, preset):
        environment, other = (
            suite.build('biped3d_mocap', terrain=preset, task='footsteps',
                        task_kwargs={'random': seed, 'terrain_observation': 'height'})
            for seed in (6, 7)
        )  # fmt: skip
        environment.reset()
        self.advance(other, 2)
        for _ in range(4):
            environment.step(np.zeros(17))
        other.set_state(environment.get_state())
        np.testing.assert_array_equal(self.advance(other, 1), self.advance(environment, 1))

    @parameterized.parameters(*OPTIONS)
    def test_simulations_equal_single_environments(self, id_, options):
        assert_rows_are_singles(id_, 4, 45, 19, options, scale=0.2)


class HelperTest(parameterized.TestCase):
    """Pictures, and what is refused."""

    def test_markers(self):
        environment, _ = started(TRAIL)
        task = environment.task
        markers = task.markers(0)
        self.assertEqual([m.shape for m in markers], ['box', 'box', 'arrow', 'cylinder'])
        for marker, place in zip(markers[:2], task.landing[0], strict=True):
            # The sole under an ankle: within 6 cm of it, just above the ground.
            self.assertLess(np.hypot(*(marker.position - place)[:2]), 0.06)
            self.assertBetween(marker.position[2] - place[2], 0, 0.01)
            self.assertAlmostEqual(marker.yaw, task.heading[0])
        self.assertNotEqual(markers[0].colour, markers[1].colour)
        np.testing.assert_array_equal(markers[3].position, task.goal[0])
        self.assertLen(started(GENERAL)[0].task.markers(0), 3)

    def test_markers_are_drawn_and_change_nothing(self):
        environment, _ = started(start_phase=0.1)
        before = environment.physics.data.qpos.copy()
        with_markers = rendering.frame(environment, 120, 160)
        task = environment.task
        colours = with_markers.reshape(-1, 3).astype(int)
        orange = (colours[:, 0] - colours[:, 2] > 80).sum()  # where the swing foot lands
        blue = (colours[:, 2] - colours[:, 0] > 80).sum()  # where the stance foot does
        self.assertGreater(orange, 5)
        self.assertGreater(blue, 5)
        task.landing[0, :, 0] += 100.0  # out of sight
        other = rendering.frame(environment, 120, 160).reshape(-1, 3).astype(int)
        self.assertLess((other[:, 2] - other[:, 0] > 80).sum(), blue)
        np.testing.assert_array_equal(environment.physics.data.qpos, before)
        self.assertEqual(rendering.frame(environment, 120, 160, ghost=True).shape, (120, 160, 3))

    @parameterized.parameters(
        ({'plans': {'length': (0.6, 0.5)}}, r'length is \(0.6, 0.5\)'),
        ({'plans': {'length': -0.5}}, 'length is -0.5'),
        ({'plans': np.zeros((2, 2))}, r'plans is array\(\[\[0'),
        ({'plans': {'width': (-0.1, 0.2)}}, 'width is'),
        ({'plans': {'width': (0.1, np.inf)}}, 'width is'),
        ({'plans': {'change': 1.5}}, 'change is 1.5'), ({'plans': {'sharp': -0.1}}, 'sharp is -0.1'),
        ({'plans': {'from_root': np.nan}}, 'from_root is nan'),
        ({'plans': {'turn': -1}}, 'turn is -1'), ({'plans': {'turn': np.inf}}, 'turn is inf'),
        ({'plans': {'lenght': (0.5, 0.5)}}, "unknown option of plans 'lenght'; did you mean 'length'"),
        ({'plans': 0.5}, 'plans is 0.5'),
        ({'pushes': {'power': 1}}, "unknown option of pushes 'power'"),
        ({'pushes': {'force': (3, 2)}}, 'force is'), ({'grace_period': -1}, 'grace_period is -1'),
        ({'max_landing_error': 0}, 'max_landing_error is 0'), ({'max_landing_error': np.nan}, 'max_landing_error is nan'),
        ({'footstep_scale': -1}, 'footstep_scale is -1'),
        ({'footstep_scale': ()}, 'footstep_scale is '),
        ({'footstep_scale': (1, np.inf)}, r'footstep_scale is \(1, inf'),
        ({'heading_scale': -1}, 'heading_scale is -1'),
        ({'start_phase': 1}, 'start_phase is 1'), ({'substeps': 5}, 'substeps is 5'),
        ({'action_offset': 'mean'}, "unknown action_offset 'mean'"),
        ({'action_scale': -1}, 'action_scale is -1'),
        ({'reference_observation': True}, "unknown option.*'reference_observation'"),
    )  # fmt: skip
    def test_options_out_of_range(self, options, message):
        with self.assertRaisesRegex(ValueError, message):
            suite.make(GENERAL, options)

    def test_options_as_objects(self):
        plans = Plans(length=(0.3, 0.6), sharp=0.0)
        environment, _ = started(plans=plans, pushes=Pushes())
        self.assertIs(environment.task.plans, plans)
        with self.assertRaises(AttributeError):
            plans.turn = 1.0
        plans = Plans.parse('plans', {'length': 0.5, 'width': np.array([0, 0.2])})
        self.assertEqual((plans.length, plans.width.high), ((0.5, 0.5), 0.2))

    def test_characters_without_two_feet(self):
        with self.assertRaisesRegex(
            ValueError, "'biped3d_full_mocap'.*does not fit.*'biped3d_mocap'"
        ):
            suite.build('biped3d_mocap', task='footsteps', clip='biped3d_full_mocap')


if __name__ == '__main__':
    absltest.main()
