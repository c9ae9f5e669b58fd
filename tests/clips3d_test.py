"""The clips and step libraries in space, measured on their characters, and their recipes."""

import itertools
import pathlib
import sys

import numpy as np
from absl.testing import absltest, parameterized

from trl_suite import motion
from trl_suite.motion import quaternion

RECIPES = str(pathlib.Path(__file__).resolve().parents[1] / 'mocap' / 'recipes')
sys.path.insert(0, RECIPES)
import checks3d  # noqa: E402
import figure3d  # noqa: E402
import fit3d  # noqa: E402
import make3d  # noqa: E402
import run3d  # noqa: E402
import step3d  # noqa: E402

sys.path.remove(RECIPES)

PACES = {  # speed m/s, period s
    'biped3d_walk': (1.2, 1.0),
    'biped3d_mocap_walk': (1.3, 1.0),
    'biped3d_full_walk': (1.3, 1.0),
    'biped3d_run': (4.656, 0.5),
    'biped3d_mocap_run': (3.833, 0.6),
    'biped3d_full_run': (3.833, 0.6),
}
LIBRARIES = {'biped3d_mocap': 27, 'biped3d_full_mocap': 27, 'biped3d_mocap_run': 1}
WALKS = ('biped3d_mocap', 'biped3d_full_mocap')
DEEPEST = 0.01  # m below the ground
SLIDE = 0.02  # m a planted foot may travel
TOE_OUT = step3d.TOE_OUT


def each_clip(test):
    return parameterized.named_parameters((name, name) for name in PACES)(test)


def each_library(test):
    return parameterized.named_parameters((name, name) for name in LIBRARIES)(test)


def each_step(name):
    library = motion.load_steps(name)
    return [library.clip(i) for i in range(len(library))]


class ClipsTest(parameterized.TestCase):
    @classmethod
    def setUpClass(cls):
        super().setUpClass()
        cls.reports = {
            name: checks3d.measure(motion.load(name), checks3d.CHARACTERS[name], 600)
            for name in PACES
        }

    def test_all_are_shipped(self):
        self.assertContainsSubset(PACES, motion.names())
        self.assertContainsSubset(LIBRARIES, motion.steps_names())
        self.assertEmpty([name for name in motion.names() if name.endswith('_steps')])

    @each_clip
    def test_fits_its_character(self, name):
        clip = motion.load(name)
        model = figure3d.model(checks3d.CHARACTERS[name])
        joints = {model.joint(j).name for j in range(1, model.njnt)}
        self.assertEqual(set(clip.joints), joints)
        self.assertLen(checks3d.place(model, clip), model.nq)
        self.assertEqual(clip.root, 'free')
        self.assertTrue(clip.loop)

    @each_clip
    def test_loops_without_a_jump(self, name):
        clip, report = motion.load(name), self.reports[name]
        self.assertLess(report.seam_position, 1e-6)
        self.assertLess(report.seam_rate, 1.1)
        self.assertAlmostEqual(clip.heading_change, 0)
        np.testing.assert_allclose(clip.displacement[1:], 0, atol=1e-9)
        before, after = clip.pose([clip.duration - 1e-9, clip.duration + 1e-9])
        np.testing.assert_allclose(before, after, atol=1e-6)

    @each_clip
    def test_respects_joint_limits(self, name):
        margin, joint = self.reports[name].margin
        self.assertGreaterEqual(margin, 0.01 if '_full_' in name else 0.1, joint)

    @each_clip
    def test_limbs_keep_apart(self, name):
        self.assertLess(self.reports[name].overlap, checks3d.DEEP)

    @each_clip
    def test_stays_above_the_ground(self, name):
        self.assertGreater(self.reports[name].lowest, -DEEPEST)
        self.assertGreater(self.reports[name].clearance, 0.02)

    @each_clip
    def test_planted_feet_do_not_slide(self, name):
        report = self.reports[name]
        self.assertLess(report.slide, SLIDE)
        self.assertGreater(report.planted, 0.3)  # otherwise the check above is not effective

    @each_clip
    def test_speed_and_period(self, name):
        speed, period = PACES[name]
        self.assertAlmostEqual(motion.load(name).speed, speed, places=3)
        self.assertAlmostEqual(motion.load(name).duration, period)

    @each_clip
    def test_runs_fly_and_walks_do_not(self, name):
        self.assertEqual(self.reports[name].planted > 0.95, 'walk' in name)

    @each_clip
    def test_steps_are_symmetric(self, name):
        clip = motion.load(name)
        t = np.linspace(0, clip.duration, 50)
        half = clip.pose(t + clip.duration / 2)
        half[:, 0] -= clip.displacement[0] / 2
        np.testing.assert_allclose(clip.mirrored().pose(t), half, atol=1e-3)
        rate = clip.layout.mirror.velocity(clip.velocity(t))
        np.testing.assert_allclose(clip.velocity(t + clip.duration / 2), rate, atol=0.1)

    @parameterized.parameters(
        ('biped3d_walk', (-17, 45), (-74, -8), (-30, 21)),
        ('biped3d_mocap_walk', (-15, 41), (-69, -7.9), (-33, 21)),
        ('biped3d_mocap_run', (-18, 61), (-103, -14), (-30, 38)),
    )
    def test_moves_like_a_person(self, name, *ranges):
        for joint, (low, high) in zip(('hip', 'knee', 'ankle'), ranges, strict=True):
            found = np.degrees(self.reports[name].angles[f'right_{joint}'][:, 0])
            self.assertBetween(found[0], low - 0.5, low + 6, joint)
            self.assertBetween(found[1], high - 6, high + 0.5, joint)


class LibraryTest(parameterized.TestCase):
    @each_library
    def test_turns_of_the_steps_are_symmetric(self, name):
        library = motion.load_steps(name)
        self.assertLen(library, LIBRARIES[name])
        if name in WALKS:
            turns = sorted(set(library.labels[:, 2].tolist()))
            self.assertEqual(turns, sorted(-turn for turn in turns))
            self.assertLen(turns, 9)

    @each_library
    def test_steps_are_as_good_as_the_clips(self, name):
        for clip in each_step(name):
            report = checks3d.measure(clip, name, 121)
            with self.subTest(clip.description):
                self.assertGreater(report.lowest, -DEEPEST)
                self.assertLess(report.slide, SLIDE)
                self.assertGreaterEqual(report.margin[0], 0.01, report.margin[1])
                self.assertLess(report.overlap, checks3d.DEEP)
                self.assertEqual(report.planted > 0.95, name in WALKS)

    @each_library
    def test_lands_as_labelled(self, name):
        library = motion.load_steps(name)
        model = figure3d.model(name)
        for i, (length, width, turn) in enumerate(library.labels):
            for mirrored, side in ((False, 1), (True, -1)):
                clip = library.clip(i, mirrored)
                feet = [ankles(model, clip, t) for t in (0, clip.duration)]
                stance, swing = (0, 1) if side > 0 else (1, 0)
                with self.subTest(clip.description, mirrored=mirrored):
                    # At landing the toes are up and the ankle is behind its flat place.
                    land, facing = feet[1][0][swing], feet[1][1][swing]
                    behind = 0.025 if name == 'biped3d_mocap_run' else 0.017
                    gap = np.hypot(*(land - [length, side * width]))
                    self.assertLess(gap, behind)
                    out = run3d.TOE_OUT if name == 'biped3d_mocap_run' else TOE_OUT
                    self.assertAlmostEqual(facing, side * (turn + out), places=6)
                    start = feet[0][1][stance]
                    self.assertAlmostEqual(start, -side * out, places=6)
                    # The pelvis turns by up to 0.12 rad about the heading.
                    heading = quaternion.heading(clip.poses[-1, 3:7])
                    self.assertAlmostEqual(heading, side * turn, delta=0.13)
                    landing = library.landing(i, mirrored)
                    np.testing.assert_allclose(landing, (length, side * width, side * turn))

    @parameterized.parameters(*WALKS)
    def test_usual_steps_follow_each_other(self, name):
        library = motion.load_steps(name)
        usual = int(np.argmin(np.abs(library.labels - library.previous).sum(axis=1)))
        np.testing.assert_array_equal(library.labels[usual], library.previous[usual])
        first, second = library.clip(usual), library.clip(usual, mirrored=True)
        end = first.poses[-1] - np.pad([*library.labels[usual, :2]], (0, first.poses.shape[1] - 2))
        np.testing.assert_allclose(end, second.poses[0], atol=1e-9)

    def test_both_bodies_walk_on_the_same_legs(self):
        legs, arms = (motion.load_steps(name) for name in WALKS)
        columns = legs.layout.columns
        np.testing.assert_array_equal(arms.poses[..., :columns], legs.poses)
        np.testing.assert_array_equal(arms.features, legs.features)

    def test_run_is_the_first_half_of_its_clip(self):
        library, clip = motion.load_steps('biped3d_mocap_run'), motion.load('biped3d_mocap_run')
        t = library.times
        found = library.pose(0, t)
        found[:, :2] += clip.poses[0, :2] - library.poses[0, 0, :2]
        np.testing.assert_allclose(found, clip.pose(t), atol=1e-9)


def ankles(model, clip, t):
    """Returns place (2, 2) and yaw (2,) of right and left foot at a time."""
    import mujoco

    data = mujoco.MjData(model)
    data.qpos[checks3d.place(model, clip)] = clip.pose(t)
    mujoco.mj_kinematics(model, data)
    feet = [data.body(foot) for foot in checks3d.FEET]
    frames = [foot.xmat.reshape(3, 3) for foot in feet]
    yaw = [np.arctan2(frame[1, 0], frame[0, 0]) for frame in frames]
    return np.array([foot.xpos[:2] for foot in feet]), np.array(yaw)


class SelectionTest(parameterized.TestCase):
    """A walker that stands as a clip starts, with the clip's landing as its plan, gets that clip."""

    def state(self, library, heading=0.0, shift=(0.0, 0.0), mirrored=False):
        """Features of walkers that stand somewhere as each of the clips starts."""
        model = figure3d.model(library.name)
        root, yaw, right, left, target = [], [], [], [], []
        for i in range(len(library)):
            clip = library.clip(i, mirrored)
            places, _ = ankles(model, clip, 0)
            root.append(clip.poses[0, :2])
            yaw.append(quaternion.heading(clip.poses[0, 3:7]))
            right.append(places[0])
            left.append(places[1])
            target.append(library.landing(i, mirrored)[:2])
        turned = [
            quaternion.rotate_xy(np.array(way), heading) + shift
            for way in (root, right, left, target)
        ]
        root, right, left, target = turned
        turn = library.landing(np.arange(len(library)), mirrored)[:, 2]
        return motion.step_features(
            root,
            np.array(yaw) + heading,
            right,
            left,
            target,
            turn + heading,
            np.full(len(library), not mirrored),
        )

    @parameterized.product(heading=(0.0, 2.8), mirrored=(False, True))
    def test_finds_every_clip(self, heading, mirrored):
        library = motion.load_steps('biped3d_mocap')
        query = self.state(library, heading, (3.0, -7.0), mirrored)
        np.testing.assert_array_equal(library.select(query), np.arange(len(library)))
        np.testing.assert_allclose(query, library.features, atol=0.017)  # toes up, toes down

    def test_queries_are_independent(self):
        library = motion.load_steps('biped3d_mocap')
        query = np.random.default_rng(0).normal(0, 0.5, (50, 7))
        rows = [library.select(row[None])[0] for row in query]
        np.testing.assert_array_equal(library.select(query), rows)

    def test_selects_the_nearest(self):
        library = motion.load_steps('biped3d_mocap')
        query = np.random.default_rng(0).normal(0, 0.5, (50, 7))
        gap = (query[:, None] - library.features)[..., 4:] * (0.54, 0.54, 0.48)
        nearest = np.linalg.norm(gap, axis=2).argmin(axis=1)
        np.testing.assert_array_equal(library.select(query), nearest)

    def test_weights_scale_the_distance(self):
        library = motion.load_steps('biped3d_mocap')
        query = library.features.copy()
        query[:, 4:6] = 0
        chosen = library.select(query, (0, 0, 0, 0, 0, 0, 1))
        np.testing.assert_array_equal(library.labels[chosen, 2], library.labels[:, 2])


class RecipesTest(parameterized.TestCase):
    def test_remakes_what_is_shipped(self):
        for made in make3d.clips():
            shipped = motion.load(made.name)
            np.testing.assert_allclose(made.poses, shipped.poses, atol=1e-9)
            self.assertEqual(made.joints, shipped.joints)
        for made in make3d.libraries():
            shipped = motion.load_steps(made.name)
            for field in ('poses', 'labels', 'previous', 'features'):
                np.testing.assert_allclose(
                    getattr(made, field), getattr(shipped, field), atol=1e-9, err_msg=field
                )

    # Two independent implementations of the generator found these, at quarters of the step.
    @parameterized.named_parameters(
        (
            'straight',
            step3d.Step(0.65, 0.15),
            step3d.Step(0.65, 0.15),
            {
                'x': (-0.2820, -0.1060, 0.0430, 0.1920),
                'y': (0.0750, 0.0589, 0.0524, 0.0589),
                'z': (0.8383, 0.8503, 0.8605, 0.8533),
                'root yaw': (0.0999, 0.0792, 0, -0.0792),
                'root roll': (-0.0050, -0.0335, -0.0700, -0.0256),
                'right_hip pitch': (0.4974, 0.3843, 0.1487, -0.0959),
                'right_knee': (-0.2537, -0.4335, -0.3193, -0.1649),
                'right_ankle pitch': (0.0824, 0.1001, 0.2177, 0.3106),
                'right_hip roll': (-0.0313, 0.0290, 0.1009, 0.0427),
                'left_hip pitch': (-0.2422, -0.2297, 0.3028, 0.7027),
                'left_knee': (-0.2659, -0.4889, -1.1412, -0.7363),
                'left_ankle pitch': (0.2543, -0.4304, -0.3134, 0.1710),
                'torso yaw': (-0.2000, -0.1594, -0.0021, 0.1576),
            },
        ),
        (
            'turning',
            step3d.Step(0.5, 0.15),
            step3d.Step(0.3, 0.15, 0.6),
            {
                'x': (-0.2070, -0.0729, 0.0295, 0.1088, 0.1855),
                'y': (0.0750, 0.0560, 0.0423, 0.0545, 0.0993),
                'z': (0.8565, 0.8610, 0.8614, 0.8604, 0.8572),
                'root yaw': (0.0768, 0.1028, 0.2189, 0.3888, 0.5481),
                'left_hip pitch': (-0.1547, -0.0554, 0.2686, 0.5505, 0.3470),
                'left_hip yaw': (-0.0002, -0.0299, -0.0608, 0.0949, 0.0972),
                'left_hip roll': (0.0151, 0.0864, 0.1831, 0.0480, -0.1113),
                'left_knee': (-0.2661, -0.6472, -1.0425, -0.7974, -0.3300),
                'left_ankle pitch': (0.2369, -0.1601, 0.0108, 0.3678, 0.1792),
                'right_hip yaw': (-0.0903, -0.1210, -0.1955, -0.2845, -0.3772),
                'torso yaw': (-0.1538, -0.1281, -0.0278, 0.0748, 0.1022),
            },
        ),
    )
    def test_generated_angles_of_a_step(self, previous, this, expected):
        u = np.arange(5) / 4
        made = figure3d.figure('biped3d_mocap')
        found = curves(step3d.step(made, step3d.SHAPES['biped3d_mocap'], previous, this, u))
        for name, values in expected.items():
            np.testing.assert_allclose(
                found[name][: len(values)], values, atol=1.1e-4, err_msg=name
            )

    def test_generated_angles_of_the_run(self):
        found = curves(run3d.bodies(fit3d.START, np.arange(4) / 4, passes=6))
        for name, values in {
            'x': (-0.0166, 0.5448, 1.1334, 1.6948),
            'z': (0.8131, 0.7953, 0.8131, 0.7953),
            'root pitch': (-0.1617, -0.1639, -0.1617, -0.1639),
            'right_hip pitch': (0.7515, 0.1248, 0.0596, 1.0630),
            'right_knee': (-0.6239, -0.7285, -1.1137, -1.5989),
            'right_ankle pitch': (0.1571, 0.4763, -0.1969, 0.0734),
        }.items():
            np.testing.assert_allclose(found[name], values, atol=1e-3, err_msg=name)

    def test_steps_of_any_kind_chain(self):
        # The end of a step is the start of the mirrored next one, in position and velocity.
        rng = np.random.default_rng(3)
        made, p = figure3d.figure('biped3d_mocap'), step3d.SHAPES['biped3d_mocap']
        steps = [
            step3d.Step(length, width, turn)
            for length, width, turn in zip(
                rng.uniform(0.2, 0.7, 40),
                rng.uniform(0.1, 0.3, 40),
                rng.normal(0, 0.25, 40),
                strict=True,
            )
        ]
        h = 1e-4
        u = np.concatenate([[0, h, 2 * h], np.linspace(0.1, 0.9, 41), [1 - 2 * h, 1 - h, 1]])
        table = [made.poses(step3d.step(made, p, *pair, u)) for pair in itertools.pairwise(steps)]
        for this, before, after in zip(steps[1:], table, table[1:], strict=False):
            start = made.layout.mirror.pose(after)[:3]
            turn = quaternion.about_z(np.array(this.turn))
            start[:, :2] = quaternion.rotate_xy(start[:, :2], this.turn)
            start[:, :2] += this.length, this.width
            start[:, 3:7] = quaternion.multiply(turn, start[:, 3:7])
            end = before[-3:]
            gap = made.layout.change(end[-1], start[0])
            np.testing.assert_allclose(gap, 0, atol=1e-9)
            dt = h * step3d.STEP
            rates = [
                (4 * made.layout.change(a, b) - made.layout.change(a, c)) / (2 * dt)
                for a, b, c in ((start[0], start[1], start[2]), (end[2], end[1], end[0]))
            ]
            np.testing.assert_allclose(rates[0], -rates[1], atol=0.01)

    def test_stance_foot_keeps_its_place(self):
        made, p = figure3d.figure('biped3d_mocap'), step3d.SHAPES['biped3d_mocap']
        u = np.linspace(0, 1, 61)
        for this in (step3d.Step(0.7, 0.15, 0.8), step3d.Step(0.5, 0.3, -0.8)):
            found = step3d.step(made, p, step3d.USUAL, this, u)
            short = found.reach[:, 0] - figure3d.soft_reach(found.reach[:, 0])
            self.assertLess(short.max() * sum(made.leg), 1.5 * step3d.SPARE)

    @parameterized.parameters(*run3d.RUNS)
    def test_nothing_but_gravity_acts_in_flight(self, name):
        # From a model of MuJoCo, not from the kinematics that made the clip.
        made, n = run3d.RUNS[name], 240
        phase = np.arange(-1, n + 1) / n
        poses = figure3d.figure(made.character).poses(run3d.bodies(made, phase))
        found = checks3d.dynamics(
            figure3d.model(made.character), motion.load(name), poses, made.period / n
        )
        flight = phase[1:-1] % 0.5 > made.shape['ds'] + 0.02
        self.assertLess(np.linalg.norm(found.force[flight], axis=1).max(), 0.1)
        np.testing.assert_allclose(found.force.mean(axis=0), (0, 0, 1), atol=2e-3)
        self.assertLess(np.percentile(found.friction, 95), 0.3)

    def test_walk_can_be_walked(self):
        made, n = figure3d.figure('biped3d_mocap'), 60
        usual = step3d.Step(0.65, 0.15)
        bodies = step3d.step(
            made, step3d.SHAPES['biped3d_mocap'], usual, usual, np.linspace(0, 1, n + 1)
        )
        found = checks3d.dynamics(
            figure3d.model('biped3d_mocap'),
            motion.load('biped3d_mocap_walk'),
            made.poses(bodies),
            step3d.STEP / n,
        )
        self.assertBetween(found.force[:, 2].min(), 0.4, 0.6)
        self.assertBetween(found.force[:, 2].max(), 1.5, 1.85)
        self.assertLess(np.percentile(found.friction, 95), 0.45)
        self.assertLess(np.nanmedian(found.outside), 0.01)

    def test_fit_has_improved_on_its_start(self):
        start = np.sum(fit3d.residuals(fit3d.START, physics=1.0) ** 2)
        found = np.sum(fit3d.residuals(run3d.RUNS['biped3d_mocap_run'], physics=1.0) ** 2)
        self.assertLess(found, 0.6 * start)


def curves(bodies):
    """Returns root, joint angles and their names, as the test vectors have them."""
    found = dict(zip('xyz', bodies.root.T, strict=True))
    for name, values in {'root': bodies.pelvis, **bodies.joints}.items():
        if values.ndim == 1:
            found[name] = values
            continue
        for axis, angle in zip(('pitch', 'yaw', 'roll'), figure3d.angles(values).T, strict=True):
            found[f'{name} {axis}'] = angle
    return found


if __name__ == '__main__':
    absltest.main()
