"""The shipped clips and step libraries, measured on their characters, and the recipes that made them."""

import dataclasses
import itertools
import pathlib
import sys

import mujoco
import numpy as np
from absl.testing import parameterized

from trl_suite import motion
from trl_suite.motion import quaternion

RECIPES = str(pathlib.Path(__file__).resolve().parents[1] / 'mocap' / 'recipes')
sys.path.insert(0, RECIPES)
import checks  # noqa: E402
import checks3d  # noqa: E402
import figure  # noqa: E402
import figure3d  # noqa: E402
import fit  # noqa: E402
import make3d  # noqa: E402
import run  # noqa: E402
import run3d  # noqa: E402
import step3d  # noqa: E402
import walk  # noqa: E402

sys.path.remove(RECIPES)

# Speed m/s and period s: in the plane those of the original's clips of the same gaits.
PLANAR = {
    'biped2d_walk': (1.535, 1.0), 'biped2d_full_walk': (1.535, 1.0), 'biped2d_run': (4.656, 0.5),
    'dog_bound': (4.024, 0.4333), 'raptor_run_050': (3.935, 0.5), 'raptor_run_066': (4.054, 0.66),
}  # fmt: skip
SPATIAL = {
    'biped3d_walk': (1.2, 1.0), 'biped3d_mocap_walk': (1.3, 1.0), 'biped3d_full_walk': (1.3, 1.0),
    'biped3d_run': (4.656, 0.5), 'biped3d_mocap_run': (3.833, 0.6), 'biped3d_full_run': (3.833, 0.6),
}  # fmt: skip
LIBRARIES = {'biped3d_mocap': 27, 'biped3d_full_mocap': 27, 'biped3d_mocap_run': 1}
WALKS = ('biped3d_mocap', 'biped3d_full_mocap')
# How a style differs from the nominal steps, at least: in the height of the hip above the knee in the
# swing of the left leg, m; in the largest flexion of the knee in a swing, left and right, rad; in the mean
# lean of the trunk, forwards and to the right, rad; in the longest step, m. 0: the same.
HIP, LEFT, RIGHT, LEAN, TILT, LENGTH = range(6)
STYLES = {
    '_high_knees': {HIP: -0.1, LEFT: 0.4, RIGHT: 0.4},
    '_straight_legs': {HIP: 0.02, LEFT: -0.5, RIGHT: -0.5},
    '_one_straight_leg': {HIP: 0.015, LEFT: -0.5},
    '_forward_lean': {LEAN: 0.3, TILT: 0},
    '_sideways_lean': {TILT: 0.3},
    '_in_place': {LENGTH: -0.6},
    '_stand': dict.fromkeys(range(6), 0),  # in its steps
}
DEEPEST = 0.01  # m below the ground
SLIDE = 0.02  # m a planted foot may travel


class ClipsTest(parameterized.TestCase):
    @parameterized.parameters(*PLANAR, *SPATIAL)
    def test_clip(self, name):
        clip, spatial = motion.load(name), name in SPATIAL
        character = (checks3d if spatial else checks).CHARACTERS[name]
        model = (figure3d if spatial else figure).model(character)
        joints = {model.joint(j).name for j in range(1 if spatial else 3, model.njnt)}
        self.assertEqual(set(clip.joints), joints)
        self.assertEqual((clip.root, clip.loop), ('free' if spatial else 'planar', True))
        speed, period = (SPATIAL if spatial else PLANAR)[name]
        self.assertAlmostEqual(clip.speed / speed, 1, delta=0.001 if spatial else 0.1)
        self.assertAlmostEqual(clip.duration / period, 1, delta=1e-6 if spatial else 0.05)

        measure = checks3d.measure if spatial else checks.measure
        report = measure(clip, character, 600)
        # Across the seam the rates change no more than between some neighbours inside the clip.
        self.assertLess(report.seam_position, 1e-6)
        self.assertLess(report.seam_rate, 1.1)
        before, after = clip.pose([clip.duration - 1e-9, clip.duration + 1e-9])
        np.testing.assert_allclose(before, after, atol=1e-6)
        margin, joint = report.margin
        least = (0.01 if '_full_' in name else 0.1) if spatial else 0
        self.assertGreaterEqual(margin, least, joint)
        self.assertGreater(report.lowest, -DEEPEST)
        self.assertLess(report.slide, SLIDE)
        self.assertGreater(report.planted, 0.3)  # otherwise the check above is not effective
        self.assertEqual(report.planted > 0.95, 'walk' in name)  # runs fly
        if spatial:
            self.assertLess(report.overlap, checks3d.DEEP)
            self.assertGreater(report.clearance, 0.02)
            self.assertAlmostEqual(clip.heading_change, 0)
            np.testing.assert_allclose(clip.displacement[1:], 0, atol=1e-9)

    @parameterized.parameters(*(name for name in PLANAR if name != 'dog_bound'), *SPATIAL)
    def test_steps_are_symmetric(self, name):
        clip = motion.load(name)
        pairs = [(j, j.replace('right', 'left')) for j in clip.joints if j.startswith('right')]
        mirror = motion.Mirror(clip.layout, pairs)
        t = np.linspace(0, clip.duration, 50)
        half = clip.pose(t + clip.duration / 2)
        half[:, 0] -= clip.displacement[0] / 2
        np.testing.assert_allclose(clip.mirrored(pairs).pose(t), half, atol=1e-3)
        if name in SPATIAL:
            rate = mirror.velocity(clip.velocity(t))
            np.testing.assert_allclose(clip.velocity(t + clip.duration / 2), rate, atol=0.1)

    @parameterized.parameters(
        ('biped3d_walk', (-17, 45), (-74, -8), (-30, 21)),
        ('biped3d_mocap_walk', (-15, 41), (-69, -7.9), (-33, 21)),
        ('biped3d_mocap_run', (-18, 61), (-103, -14), (-30, 38)),
    )
    def test_moves_like_a_person(self, name, *ranges):
        report = checks3d.measure(motion.load(name), checks3d.CHARACTERS[name], 600)
        for joint, (low, high) in zip(('hip', 'knee', 'ankle'), ranges, strict=True):
            found = np.degrees(report.angles[f'right_{joint}'][:, 0])
            self.assertBetween(found[0], low - 0.5, low + 6, joint)
            self.assertBetween(found[1], high - 6, high + 0.5, joint)


class ChecksTest(parameterized.TestCase):
    """The checks find the corresponding faults."""

    @parameterized.parameters(
        (1, lambda z: z - 0.02, lambda report: abs(report.lowest + 0.02) < 1e-3),
        # 10 % more travel: while a foot stands for 0.12 s the body should not gain 5 cm on it.
        (0, lambda x: 1.1 * x, lambda report: report.slide > SLIDE),
        ('left_knee', lambda angle: angle + 0.5, lambda report: report.margin < (0, 'left_knee')),
        (2, lambda pitch: pitch + 0.01 * np.linspace(0, 1, len(pitch)) ** 2,
         lambda report: abs(report.seam_position - 0.01) < 1e-6),
    )  # fmt: skip
    def test_faults_are_found(self, column, change, found):
        clip = motion.load('raptor_run_050')
        poses = clip.poses.copy()
        column = column if isinstance(column, int) else 3 + clip.joints.index(column)
        poses[:, column] = change(poses[:, column])
        report = checks.measure(dataclasses.replace(clip, poses=poses), 'raptor', 400)
        self.assertTrue(found(report), report)


def ankles(model, clip, t):
    """Returns place (2, 2) and yaw (2,) of right and left foot at a time."""
    data = mujoco.MjData(model)
    data.qpos[checks3d.place(model, clip)] = clip.pose(t)
    mujoco.mj_kinematics(model, data)
    feet = [data.body(foot) for foot in checks3d.FEET]
    frames = [foot.xmat.reshape(3, 3) for foot in feet]
    yaw = [np.arctan2(frame[1, 0], frame[0, 0]) for frame in frames]
    return np.array([foot.xpos[:2] for foot in feet]), np.array(yaw)


def posture(library):
    """Returns what `STYLES` compares, of the steps that are repeated to walk, (6,)."""
    model = figure3d.model('biped3d_mocap')
    usual = int(np.argmin(np.abs(library.labels - library.previous).sum(axis=1)))
    data, found = mujoco.MjData(model), []
    for clip in (library.clip(usual), library.clip(usual, mirrored=True)):
        for t in np.linspace(0, clip.duration, 41):
            data.qpos[checks3d.place(model, clip)] = clip.pose(t)
            mujoco.mj_kinematics(model, data)
            hip, knee = (data.body(f'left_{name}').xpos[2] for name in ('hip', 'knee'))
            flexion = (-float(data.joint(f'{side}_knee').qpos[0]) for side in ('left', 'right'))
            turned = data.body('torso').xmat
            found.append((hip - knee, *flexion, np.arcsin(turned[2]), np.arcsin(turned[7])))
    hip, left, right, lean, tilt = np.transpose(found)
    extremes = hip.min(), left.max(), right.max(), lean.mean(), tilt.mean()
    return np.array([*extremes, library.labels[:, 0].max()])


class LibraryTest(parameterized.TestCase):
    @parameterized.parameters(*LIBRARIES)
    def test_steps_are_as_good_as_the_clips(self, name):
        library = motion.load_steps(name)
        self.assertLen(library, LIBRARIES[name])
        if name in WALKS:
            turns = sorted(set(library.labels[:, 2].tolist()))
            self.assertEqual(turns, sorted(-turn for turn in turns))
            self.assertLen(turns, 9)
        for i in range(len(library)):
            report = checks3d.measure(library.clip(i), name, 121)
            self.assertGreater(report.lowest, -DEEPEST, i)
            self.assertLess(report.slide, SLIDE, i)
            self.assertGreaterEqual(report.margin[0], 0.01, report.margin[1])
            self.assertLess(report.overlap, checks3d.DEEP, i)
            self.assertEqual(report.planted > 0.95, name in WALKS, i)

    @parameterized.parameters(*STYLES)
    def test_styles(self, style):
        library = motion.load_steps(f'biped3d_mocap{style}')
        one_sided = library.left_poses is not None
        for i, mirrored in itertools.product(range(len(library)), (False, True)[: 1 + one_sided]):
            report = checks3d.measure(library.clip(i, mirrored), 'biped3d_mocap', 121)
            self.assertGreater(report.lowest, -DEEPEST, i)
            self.assertLess(report.slide, SLIDE, i)
            self.assertGreaterEqual(report.margin[0], 0.01, report.margin[1])
            self.assertLess(report.overlap, checks3d.DEEP, i)
        difference = posture(library) - posture(motion.load_steps('biped3d_mocap'))
        for column, least in STYLES[style].items():
            found = difference[column]
            if least:
                self.assertGreaterEqual(found / least, 1, (column, found))
            else:
                self.assertAlmostEqual(found, 0)

    @parameterized.product(name=tuple(LIBRARIES), mirrored=(False, True))
    def test_lands_as_labelled(self, name, mirrored):
        library, model = motion.load_steps(name), figure3d.model(name)
        side, stance, swing = (-1, 1, 0) if mirrored else (1, 0, 1)
        behind, out = (0.017, step3d.TOE_OUT) if name in WALKS else (0.025, run3d.TOE_OUT)
        for i, (length, width, turn) in enumerate(library.labels):
            clip = library.clip(i, mirrored)
            (_, start), (places, end) = (ankles(model, clip, t) for t in (0, clip.duration))
            # At landing the toes are up and the ankle is behind its flat place.
            gap = np.hypot(*(places[swing] - [length, side * width]))
            self.assertLess(gap, behind, i)
            self.assertAlmostEqual(end[swing], side * (turn + out), places=6)
            self.assertAlmostEqual(start[stance], -side * out, places=6)
            # The pelvis turns by up to 0.12 rad about the heading.
            heading = quaternion.heading(clip.poses[-1, 3:7])
            self.assertAlmostEqual(heading, side * turn, delta=0.13)

    @parameterized.product(
        name=(*WALKS, 'biped3d_mocap_one_straight_leg', 'biped3d_mocap_sideways_lean'),
        mirrored=(False, True),
    )
    def test_usual_steps_follow_each_other(self, name, mirrored):
        library = motion.load_steps(name)
        usual = int(np.argmin(np.abs(library.labels - library.previous).sum(axis=1)))
        np.testing.assert_array_equal(library.labels[usual], library.previous[usual])
        first, second = (library.clip(usual, side) for side in (mirrored, not mirrored))
        length, width = library.labels[usual, :2]
        end = first.poses[-1].copy()
        end[:2] -= length, -width if mirrored else width
        np.testing.assert_allclose(end, second.poses[0], atol=1e-9)

    def test_steps_end_and_begin_in_a_stand(self):
        library = motion.load_steps('biped3d_mocap_stand')
        standing, usual = (
            (library.previous == label).all(1) for label in ((0, 0.15, 0), (0.5, 0.15, 0))
        )
        self.assertEqual((standing.sum(), usual.sum()), (14, 28))
        [stand] = np.flatnonzero(standing & (library.labels == (0, 0.15, 0)).all(1))
        [stop] = np.flatnonzero(usual & (library.labels == (0, 0.15, 0)).all(1))
        still = library.poses[stand, 0]
        np.testing.assert_array_equal(library.poses[stand], np.tile(still, (31, 1)))
        np.testing.assert_array_equal(library.poses[standing, 0], np.tile(still, (14, 1)))
        end = library.pose(stop, library.duration, True)  # in left stance, the right foot lands
        np.testing.assert_allclose(end[2:], still[2:], atol=1e-9)
        rate = np.abs(library.velocity(stop, library.duration)).max()
        self.assertLess(rate, 0.2)  # of a mean over the last 1/60 s

    @parameterized.product(style=('', '_stand'), heading=(0.0, 2.8), mirrored=(False, True))
    def test_a_walker_as_a_clip_starts_with_its_landing_as_plan_gets_it(
        self, style, heading, mirrored
    ):
        library, model = motion.load_steps(f'biped3d_mocap{style}'), figure3d.model('biped3d_mocap')
        shift, numbers = (3.0, -7.0), np.arange(len(library))
        clips = [library.clip(i, mirrored) for i in numbers]
        feet = np.array([ankles(model, clip, 0)[0] for clip in clips])
        landing = library.labels * ((1, -1, -1) if mirrored else 1)
        places = [clip.poses[0, :2] for clip in clips], feet[:, 0], feet[:, 1], landing[:, :2]
        root, right, left, target = (
            quaternion.rotate_xy(np.array(place), heading) + shift for place in places
        )
        yaw = np.array([quaternion.heading(clip.poses[0, 3:7]) for clip in clips]) + heading
        turn, stance = landing[:, 2] + heading, np.full(len(library), not mirrored)
        query = motion.step_features(root, yaw, right, left, target, turn, stance)
        np.testing.assert_array_equal(library.select(query), numbers)
        np.testing.assert_allclose(query, library.features, atol=0.017)  # toes up, toes down


class RecipesTest(parameterized.TestCase):
    def test_remakes_what_is_shipped(self):
        for made in itertools.chain(walk.clips(), run.clips(), make3d.clips()):
            shipped = motion.load(made.name)
            np.testing.assert_allclose(made.poses, shipped.poses, atol=1e-9, err_msg=made.name)
            self.assertEqual(made.joints, shipped.joints)
        for made in make3d.libraries():
            shipped = motion.load_steps(made.name)
            for field in ('poses', 'labels', 'previous', 'features', 'left_poses'):
                own, stored = (getattr(each, field) for each in (made, shipped))
                self.assertEqual(own is None, stored is None)
                if own is not None:
                    np.testing.assert_allclose(own, stored, atol=1e-9, err_msg=field)

    @parameterized.parameters(*run.RUNS, *run3d.RUNS)
    def test_nothing_but_gravity_acts_in_flight(self, name):
        """In space by a model of MuJoCo, not by the kinematics that made the clip."""
        if name in run.RUNS:
            made, phase = run.RUNS[name], np.arange(300) / 300
            poses = run.poses(made, phase)
            force, _, _ = fit.dynamics(run.build(made.character), poses, made.period, made.speed)
            flight = phase % 0.5 > made.shape['ds'] + 0.01
            np.testing.assert_allclose(force[flight], 0, atol=0.05)
            np.testing.assert_allclose(force.mean(axis=0), (0, 1), atol=1e-3)
            return
        made, n = run3d.RUNS[name], 240
        phase = np.arange(-1, n + 1) / n
        poses = figure3d.figure(made.character).poses(run3d.bodies(made, phase))
        model = figure3d.model(made.character)
        found = checks3d.dynamics(model, motion.load(name), poses, made.period / n)
        flight = phase[1:-1] % 0.5 > made.shape['ds'] + 0.02
        self.assertLess(np.linalg.norm(found.force[flight], axis=1).max(), 0.1)
        np.testing.assert_allclose(found.force.mean(axis=0), (0, 0, 1), atol=2e-3)
        self.assertLess(np.percentile(found.friction, 95), 0.3)

    def test_walk_can_be_walked(self):
        made, usual = figure3d.figure('biped3d_mocap'), step3d.Step(0.65, 0.15)
        u = np.linspace(0, 1, 61)
        poses = made.poses(step3d.step(made, step3d.SHAPES['biped3d_mocap'], usual, usual, u))
        model, clip = figure3d.model('biped3d_mocap'), motion.load('biped3d_mocap_walk')
        found = checks3d.dynamics(model, clip, poses, step3d.STEP / 60)
        self.assertBetween(found.force[:, 2].min(), 0.4, 0.6)
        self.assertBetween(found.force[:, 2].max(), 1.5, 1.85)
        self.assertLess(np.percentile(found.friction, 95), 0.45)
        self.assertLess(np.nanmedian(found.outside), 0.01)
