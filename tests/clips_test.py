"""The shipped clips, measured on their characters, and the recipes that made them."""

import dataclasses
import pathlib
import sys

import numpy as np
from absl.testing import absltest, parameterized

from trl_suite import motion

RECIPES = str(pathlib.Path(__file__).resolve().parents[1] / 'mocap' / 'recipes')
sys.path.insert(0, RECIPES)
import checks  # noqa: E402
import figure  # noqa: E402
import fit  # noqa: E402
import run  # noqa: E402
import walk  # noqa: E402

sys.path.remove(RECIPES)

# The original's clips of the same gaits: speed m/s, period s.
ORIGINAL = {
    'biped2d_walk': (1.535, 1.0),
    'biped2d_full_walk': (1.535, 1.0),
    'biped2d_run': (4.656, 0.5),
    'dog_bound': (4.024, 0.4333),
    'raptor_run_050': (3.935, 0.5),
    'raptor_run_066': (4.054, 0.66),
}
DEEPEST = 0.01  # m below the ground
SLIDE = 0.02  # m a planted foot may travel


def each_clip(test):
    return parameterized.named_parameters((name, name) for name in ORIGINAL)(test)


class ClipsTest(parameterized.TestCase):
    @classmethod
    def setUpClass(cls):
        super().setUpClass()
        cls.reports = {
            name: checks.measure(motion.load(name), checks.CHARACTERS[name]) for name in ORIGINAL
        }

    def test_all_are_shipped(self):
        self.assertContainsSubset(ORIGINAL, motion.names())

    @each_clip
    def test_fits_its_character(self, name):
        clip = motion.load(name)
        model = figure.model(checks.CHARACTERS[name])
        joints = {model.joint(j).name for j in range(3, model.njnt)}
        self.assertEqual(set(clip.joints), joints)
        self.assertEqual(clip.root, 'planar')
        self.assertTrue(clip.loop)

    @each_clip
    def test_loops_without_a_jump(self, name):
        clip, report = motion.load(name), self.reports[name]
        self.assertLess(report.seam_position, 1e-6)
        # Across the seam the rates change no more than between some neighbours inside the clip.
        self.assertLess(report.seam_rate, 1.1)
        before, after = clip.pose([clip.duration - 1e-9, clip.duration + 1e-9])
        np.testing.assert_allclose(before, after, atol=1e-6)

    @each_clip
    def test_respects_joint_limits(self, name):
        margin, joint = self.reports[name].margin
        self.assertGreaterEqual(margin, 0, joint)

    @each_clip
    def test_stays_above_the_ground(self, name):
        self.assertGreater(self.reports[name].lowest, -DEEPEST)

    @each_clip
    def test_planted_feet_do_not_slide(self, name):
        report = self.reports[name]
        self.assertLess(report.slide, SLIDE)
        self.assertGreater(report.planted, 0.3)  # otherwise the check above is not effective

    @each_clip
    def test_speed_and_period_are_those_of_the_original(self, name):
        speed, period = ORIGINAL[name]
        clip = motion.load(name)
        self.assertAlmostEqual(clip.speed / speed, 1, delta=0.1)
        self.assertAlmostEqual(clip.duration / period, 1, delta=0.05)

    @each_clip
    def test_runs_fly_and_walks_do_not(self, name):
        self.assertEqual(self.reports[name].planted > 0.95, 'walk' in name)

    @each_clip
    def test_steps_are_symmetric(self, name):
        clip = motion.load(name)
        pairs = [(j, j.replace('right', 'left')) for j in clip.joints if j.startswith('right')]
        t = np.linspace(0, clip.duration, 50)
        if not pairs:
            self.skipTest('one leg stands for two')
        half = clip.pose(t + clip.duration / 2)
        half[:, 0] -= clip.displacement[0] / 2
        np.testing.assert_allclose(clip.mirrored(pairs).pose(t), half, atol=1e-3)

    def test_full_walk_has_the_legs_of_the_walk(self):
        walk_, full = motion.load('biped2d_walk'), motion.load('biped2d_full_walk')
        np.testing.assert_array_equal(walk_.poses, full.poses[:, : walk_.poses.shape[1]])


class ChecksTest(absltest.TestCase):
    """The checks find the corresponding faults."""

    def setUp(self):
        super().setUp()
        self.clip = motion.load('raptor_run_050')

    def changed(self, column, change):
        poses = self.clip.poses.copy()
        poses[:, column] = change(poses[:, column])
        return checks.measure(dataclasses.replace(self.clip, poses=poses), 'raptor', 400)

    def test_penetration_is_found(self):
        self.assertAlmostEqual(self.changed(1, lambda z: z - 0.02).lowest, -0.02, delta=1e-3)

    def test_sliding_is_found(self):
        # 10 % more travel: while a foot stands for 0.12 s the body should not gain 5 cm on it.
        self.assertGreater(self.changed(0, lambda x: 1.1 * x).slide, SLIDE)

    def test_a_violated_limit_is_found(self):
        column = 3 + self.clip.joints.index('left_knee')
        margin, joint = self.changed(column, lambda angle: angle + 0.5).margin
        self.assertLess(margin, 0)
        self.assertEqual(joint, 'left_knee')

    def test_a_jump_at_the_seam_is_found(self):
        def kink(z):
            return z + 0.01 * np.linspace(0, 1, len(z)) ** 2

        report = self.changed(2, kink)
        self.assertAlmostEqual(report.seam_position, 0.01)

    def test_numpy_and_mujoco_kinematics_agree(self):
        clip = motion.load('dog_bound')
        made = figure.figure('dog', clip.joints)
        joints, pitch = made.joints(clip.poses[:20])
        foot = made.links.index('finger')
        corner = joints[:, foot] + figure.rotate(np.array([0.085, -0.035]), pitch[:, foot])
        boxes = checks.corners('dog', clip, clip.times[:20])['finger'][:, :, [0, 2]]
        gap = np.linalg.norm(boxes - corner[:, None], axis=2).min(axis=1)
        np.testing.assert_allclose(gap, 0, atol=1e-9)


class RecipesTest(parameterized.TestCase):
    @parameterized.parameters(walk, run)
    def test_remakes_what_is_shipped(self, recipe):
        for made in recipe.clips():
            shipped = motion.load(made.name)
            np.testing.assert_allclose(made.poses, shipped.poses, atol=1e-9)
            self.assertEqual(made.joints, shipped.joints)

    # Poses at phases 0, 1/4, 1/2, 3/4: a second, independent implementation of the generator
    # found these (biped2d to 4 passes).
    @parameterized.named_parameters(
        (
            'biped2d',
            'biped2d_run',
            {
                'x': (-0.0140, 0.4997, 1.0400, 1.5537),
                'z': (0.7234, 0.6998, 0.7234, 0.6998),
                'pitch': (-0.0606, -0.0770, -0.0606, -0.0770),
                'right_hip': (0.7055, 0.1108, 0.0037, 1.0316),
                'right_knee': (-0.6029, -0.8296, -1.1469, -1.6650),
                'right_ankle': (0.0780, 0.5952, -0.1953, 0.0811),
            },
        ),
        (
            'raptor',
            'raptor_run_066',
            {
                'x': (0.0114, 0.6788, 1.3479, 2.0153),
                'z': (0.4953, 0.4971, 0.4953, 0.4971),
                'right_hip': (0.5675, -0.9558, -0.1793, 1.0858),
                'right_knee': (-1.3024, -0.3968, -1.4835, -2.5814),
                'right_ankle': (1.9418, 1.0741, 0.5322, 1.4783),
                'right_toe': (-1.0486, -0.4136, -0.6059, -0.2338),
            },
        ),
        (
            'raptor_fast',
            'raptor_run_050',
            {
                'x': (0.0170, 0.5060, 1.0045, 1.4935),
                'z': (0.5342, 0.5113, 0.5342, 0.5113),
                'right_hip': (0.3671, -0.8668, -0.1500, 1.1647),
                'right_knee': (-1.1851, -0.3278, -1.4170, -2.5698),
                'right_ankle': (1.8523, 1.2800, 0.4993, 1.5581),
                'right_toe': (-0.8824, -0.3990, -0.4177, -0.3822),
            },
        ),
    )
    def test_generated_angles_at_quarters_of_a_cycle(self, name, expected):
        start = fit.STARTS[name]
        columns = ('x', 'z', 'pitch', *run.build(start.character).joints)
        poses = run.poses(start, np.arange(4) / 4, passes=4)
        for column, values in expected.items():
            angles = poses[:, columns.index(column)]
            np.testing.assert_allclose(angles, values, atol=3e-3, err_msg=column)

    @parameterized.parameters(*run.RUNS)
    def test_nothing_but_gravity_acts_in_flight(self, name):
        found = run.RUNS[name]
        phase = np.arange(300) / 300
        poses = run.poses(found, phase)
        force, _, _ = fit.dynamics(run.build(found.character), poses, found.period, found.speed)
        flight = phase % 0.5 > found.shape['ds'] + 0.01
        np.testing.assert_allclose(force[flight], 0, atol=0.05)
        np.testing.assert_allclose(force.mean(axis=0), (0, 1), atol=1e-3)

    @parameterized.parameters(*run.RUNS)
    def test_fit_has_improved_on_its_start(self, name):
        cost = {}
        for kind, table in (('start', fit.STARTS), ('found', run.RUNS)):
            cost[kind] = np.sum(fit.residuals(table[name], physics=1.0) ** 2)
        self.assertLess(cost['found'], 0.6 * cost['start'])

    def test_walk_integrates_its_speed(self):
        # Mean speed 1.5 m/s, and the ripple leaves no displacement after a whole step.
        clip = motion.load('biped2d_walk')
        middle = clip.pose(clip.duration / 2)[0] - clip.pose(0)[0]
        self.assertAlmostEqual(middle, 0.75, places=6)


if __name__ == '__main__':
    absltest.main()
