"""Tests of trl_suite.arenas: the collision geometry is the profile, wherever the character is."""

import mujoco
import numpy as np
from absl.testing import parameterized
from dm_control import mjcf

from trl_suite import suite, terrain
from trl_suite.arenas import PlanarArena, boxes
from trl_suite.engine import PhysicsWorld
from trl_suite.registry import catalogue
from trl_suite.terrain.planar import windows as planar_ground

TIMESTEP = 1 / 300  # s
GRAVITY = 9.8  # m/s^2; the original's
CELL = terrain.SPACING
BEHIND, AHEAD = 5.9, 17.9  # m; extent of the window of boxes around its centre
# Largest and typical deviation, m. Level ground is exact. Pieces longer than 0.1 m stay within 4 mm of the profile. Where
# there are faces, the level post of 1.5 cells next to a face adds 0.0375 m times the slope, which
# in these presets stays below 0.27 (three standard deviations). slopes_humanoid: pieces of 0.1 m.
DEVIATION = {
    **dict.fromkeys(('flat', 'gaps_humanoid', 'walls_humanoid', 'steps_humanoid', 'mixed_humanoid', 'gaps', 'walls', 'steps',
                     'mixed', 'cliffs_rugged', 'narrow_gaps_raptor', 'tight_gaps', 'stairs'), (1e-6, 1e-6)),
    'inclines': (0.005, 0.002), 'slopes': (0.006, 0.002), 'slopes_mixed': (0.010, 0.002),
    'slopes_mixed_humanoid': (0.010, 0.002), 'slopes_gaps_raptor': (0.010, 0.002),
    'slopes_narrow_gaps': (0.010, 0.002), 'slopes_humanoid': (0.025, 0.006),
}  # fmt: skip
OF_ROWS = sorted({spec.terrain for spec in catalogue.SPECS if 'planar' in spec.tags})


class DepthTest(parameterized.TestCase):
    @parameterized.parameters(('walls', 'WallH', 5.0), ('gaps', 'GapH', -6.0))
    def test_faces_reach_the_ground_below(self, kind, name, height):
        """Also those that are higher than boxes usually are thick."""
        source = {'Type': f'var2d_{kind}', 'Params': [{f'{name}Min': height, f'{name}Max': height}]}
        stage = Stage(source)
        heights, vertical = stage.strip.window(0, 800)
        faces = np.flatnonzero(vertical & (np.abs(np.diff(heights, prepend=0.0)) > 1))
        self.assertNotEmpty(faces)
        low, high = sorted((0.0, height))
        for k in faces[:2].tolist():
            x = (k - 0.5) * CELL
            side = 1 if heights[k] > heights[k - 1] else -1  # the high ground is on this side
            for z in np.linspace(low + 0.05, high - 0.05, 40):
                distance, _, is_ground = stage.ray((x - 0.05 * side, 0, z), (side, 0, 0))
                self.assertTrue(is_ground)
                self.assertBetween(distance, 0.0, 0.11)


class Stage:
    """An arena alone, or with one planar body on it."""

    def __init__(self, source, seed=0, timestep=TIMESTEP, body=None, **strip):
        self.arena = PlanarArena(terrain.load(source))
        root = self.arena.mjcf_model
        root.option.timestep = timestep
        if body is not None:
            element = root.worldbody.add('body', name='body')
            element.add('joint', name='x', type='slide', axis=(1, 0, 0))
            element.add('joint', name='z', type='slide', axis=(0, 0, 1))
            element.add('joint', name='pitch', type='hinge', axis=(0, -1, 0))
            element.add('geom', name='body', **body)
        self._physics = mjcf.Physics.from_mjcf_model(root)
        self.model, self.data = self._physics.model.ptr, self._physics.data.ptr
        self.world = PhysicsWorld(self._physics)
        self.arena.bind(self.world)
        self.strip = terrain.PlanarGround(self.arena.terrain, seed, **strip)
        self.arena.begin_episode(0, terrain.PlanarGround(self.arena.terrain, seed, **strip))
        self.world.forward(np.zeros(1, int))

    def follow(self, x):
        self.arena.recentre(np.zeros(1, int), np.array([float(x)]))

    def ray(self, start, direction):
        """First hit of a ray: distance, normal, and whether it is the ground."""
        geom, normal = np.zeros(1, np.int32), np.zeros(3)
        distance = mujoco.mj_ray(
            self.model, self.data, np.array(start, float), np.array(direction, float), None, True,
            -1, geom, normal,
        )  # fmt: skip
        ground = geom[0] >= 0 and self.model.geom_bodyid[geom[0]] == 0
        return distance, normal, ground

    def heights(self, xs):
        """Heights of the collision geometry."""
        found = []
        top = float(self.strip.height(xs).max()) + 3
        for x in xs:
            distance, _, ground = self.ray((x, 0, top), (0, 0, -1))
            found.append(top - distance if ground else np.nan)
        return np.array(found)


def faces_of(strip, low, high):
    """Middles of the vertical cells between two places, and heights on both sides, m."""
    first = round(low / CELL)
    heights, vertical = strip.window(first, round((high - low) / CELL))
    numbers = np.flatnonzero(vertical[1:]) + 1
    return (first + numbers - 0.5) * CELL, heights[numbers - 1], heights[numbers]


def away_from_faces(strip, xs):
    """Those of xs that do not lie in a vertical cell, 0.0125 m to both sides of its face."""
    faces = faces_of(strip, xs.min() - 1, xs.max() + 1)[0]
    if not len(faces):
        return xs
    return xs[np.abs(xs[:, None] - faces).min(1) > 0.5 * CELL + 1e-9]


class GeometryTest(parameterized.TestCase):
    """Ray casts against the profile."""

    @parameterized.parameters(*DEVIATION)
    def test_ground(self, source):
        largest, typical = DEVIATION[source]
        ground, errors = Stage(source, 1), []
        for centre in (0, 48, -30):
            ground.follow(centre)
            xs = np.random.default_rng(1).uniform(centre - BEHIND, centre + AHEAD, 700)
            xs = away_from_faces(ground.strip, xs)
            self.assertGreater(len(xs), 450)
            errors.append(ground.heights(xs) - ground.strip.height(xs))
        ground.follow(6)  # which covers other ground
        xs = away_from_faces(ground.strip, np.linspace(1, 23, 300))
        errors.append(ground.heights(xs) - ground.strip.height(xs))
        errors = np.concatenate(errors)
        self.assertLess(np.abs(errors).max(), largest)
        self.assertLess(np.sqrt(np.mean(errors**2)), typical)
        # Queries are of the ground, not of the boxes, also beyond them; half of these at vertices.
        arrays = ground.arena.ground
        for centre in (0.0, -40.0, 500.0):
            ground.follow(centre)
            xs = np.random.default_rng(1).uniform(centre - 14.9, centre + 14.9, (1, 400))
            xs[:, ::2] = (xs[:, ::2] / CELL).round() * CELL
            np.testing.assert_allclose(ground.arena.height(xs), ground.strip.height(xs), atol=1e-10)
            centre = arrays.start[0] * CELL + 6  # of the window
            for off in (-17.9, -5.9, 0.0, 0.3, 3.0, 17.9):
                self.assertEqual(planar_ground.has_left(0, centre + off, arrays), abs(off) > 3.1)
        for x in (481.9, 518.1, 1e300, -1e300):
            self.assertTrue(np.isfinite(planar_ground.height(0, x, arrays)))
        self.assertTrue(np.isnan(planar_ground.height(0, np.nan, arrays)))
        self.assertFalse(planar_ground.has_left(0, np.nan, arrays))
        with self.assertRaisesRegex(ValueError, r'shape \(2, 1\); expected \(1, k\)'):
            ground.arena.height(np.zeros((2, 1)))

    @parameterized.parameters(
        'gaps_humanoid', 'walls_humanoid', 'steps_humanoid', 'mixed_humanoid', 'cliffs_rugged',
        'tight_gaps', 'slopes_mixed_humanoid', 'slopes_mixed', 'slopes_gaps_raptor',
    )  # fmt: skip
    def test_faces_are_vertical(self, source):
        met = 0
        for seed in range(4):
            ground = Stage(source, seed)
            for face, left, right in zip(*faces_of(ground.strip, -5, 17), strict=True):
                if abs(right - left) < 0.03:
                    continue
                sign = 1.0 if right > left else -1.0  # towards higher ground
                low, high = min(left, right), max(left, right)
                for share in (0.1, 0.5, 0.9):
                    start = (face - sign * 0.015, 0, low + share * (high - low))
                    distance, normal, hit = ground.ray(start, (sign, 0, 0))
                    self.assertTrue(hit)
                    self.assertAlmostEqual(distance, 0.015, delta=1e-9)
                    np.testing.assert_allclose(normal, (-sign, 0, 0), atol=1e-12)
                    met += 1
        self.assertGreater(met, 40)

    @parameterized.parameters('slopes_mixed_humanoid', 'slopes_gaps_raptor', 'slopes_narrow_gaps')
    def test_gaps_in_slopes_are_empty(self, source):
        """No lower end of a tilted box protrudes from a side of a gap."""
        gaps = 0
        for seed in range(5):
            ground = Stage(source, seed)
            faces = faces_of(ground.strip, -5, 17)
            drop = faces[1] - faces[2]
            for i in np.flatnonzero((drop[:-1] > 0.5) & (drop[1:] < -0.5)):
                left, right = faces[0][i : i + 2]
                xs = np.linspace(left + 0.0126, right - 0.0126, 9)
                error = ground.heights(xs) - ground.strip.height(xs)
                self.assertLess(np.abs(error).max(), 0.02, f'gap at {left}')
                gaps += 1
        self.assertGreater(gaps, 5)

    @parameterized.parameters(
        'cliffs_rugged', 'walls', 'tight_gaps', 'mixed', 'slopes_mixed', 'slopes_mixed_humanoid',
        'slopes_narrow_gaps',
    )  # fmt: skip
    def test_ramps(self, source):
        """No box protrudes from a ramp, and none cuts off its ends."""
        for seed, length in ((0, 0.1), (1, 0.1), (2, 0.3)):
            ground = Stage(terrain.load(source).with_faces(length), seed)
            self.assertEqual(len(faces_of(ground.strip, -5, 17)[0]), 0)
            xs = np.random.default_rng(1).uniform(-BEHIND, AHEAD, 700)
            errors = ground.heights(xs) - ground.strip.height(xs)
            self.assertLess(np.abs(errors).max(), 0.015)
            self.assertLess(np.sqrt(np.mean(errors**2)), 0.002)
            self.assertLess(ground.model.geom_pos[-1, 2], -50)  # the pool suffices


class PoolTest(parameterized.TestCase):
    """The pool of boxes holds every window, at full resolution."""

    @parameterized.parameters(*OF_ROWS, 'narrow_gaps_raptor', 'slopes_steps_hard')
    def test_pool_is_never_exceeded(self, source):
        ground = PlanarArena(terrain.load(source))
        pool, most = len(ground.boxes), 0
        for seed in range(100, 120):
            strip = terrain.PlanarGround(ground.terrain, seed)
            for centre in range(-1, 10):
                first = (centre - 1) * 240  # windows of 24 m, every 6 m
                window = strip.window(first, 961)
                most = max(most, boxes.cut(first, *window).number)
        self.assertLessEqual(most, pool)

    def test_boxes_follow_each_other(self):
        ground = Stage('slopes_mixed_humanoid', 3)
        model = ground.model
        used = model.geom_pos[:, 2] > -50  # the others are out of reach
        self.assertBetween(used.sum(), 31, len(used) - 1)
        self.assertTrue((np.diff(model.geom_pos[used, 0]) > -0.5).all())
        self.assertTrue((model.geom_size > 0).all())
        np.testing.assert_allclose(np.linalg.norm(model.geom_quat, axis=1), 1)
        for lateral, hit in ((0.99, True), (-0.99, True), (1.01, False)):  # it is 2 m wide
            self.assertEqual(ground.ray((3, lateral, 5), (0, 0, -1))[2], hit)


class DynamicsTest(parameterized.TestCase):
    """Bodies on boxes that were moved after compiling."""

    @parameterized.parameters(
        ('gaps_humanoid', 0.0),
        ('cliffs_rugged', 9.0),
        ('steps_humanoid', 48.0),
    )
    def test_a_ball_rests_at_the_exact_height(self, source, x):
        ball = {'type': 'sphere', 'size': (0.1,), 'mass': 1}
        ground = Stage(source, 2, body=ball)
        ground.follow(x)
        places = x + np.linspace(-2, 6, 200)
        heights = np.array([ground.strip.height(p + np.linspace(-0.3, 0.3, 25)) for p in places])
        level = places[np.ptp(heights, axis=1) < 1e-9]
        self.assertNotEmpty(level)
        for place in level[:: len(level) // 3]:
            below = float(ground.strip.height(place))
            ground.data.qpos[:] = (place, below + 0.3, 0)
            ground.data.qvel[:] = 0
            mujoco.mj_step(ground.model, ground.data, 900)
            np.testing.assert_allclose(ground.data.qpos[:2], (place, below + 0.1), atol=1e-4)

    def slide(self, source, seed, start, speed, seconds):
        """Slides a frictionless foot; returns travel and its speed over that of no losses."""
        foot = {
            'type': 'box', 'size': (0.0885, 0.04, 0.025), 'mass': 5, 'condim': 1, 'priority': 1,
            'solref': (0.005, 1), 'solimp': (0.95, 0.99, 0.001),
        }  # fmt: skip
        ground = Stage(source, seed, body=foot)
        model, data, strip = ground.model, ground.data, ground.strip
        ground.follow(start)
        pitch = np.arctan((strip.height(start + 0.08) - strip.height(start - 0.08)) / 0.16)
        below = strip.height(start + np.linspace(-0.09, 0.09, 19)).max()
        data.qpos[:] = (start, below + 0.025, pitch)
        data.qvel[:] = (speed * np.cos(pitch), speed * np.sin(pitch), 0)
        mujoco.mj_forward(model, data)
        energy = 0.5 * speed**2 + GRAVITY * data.qpos[1]
        for _ in range(round(30 * seconds)):
            if planar_ground.has_left(0, data.qpos[0], ground.arena.ground):
                ground.follow(data.qpos[0])
            mujoco.mj_step(model, data, 10)
        ideal = np.sqrt(2 * (energy - GRAVITY * data.qpos[1]))
        self.assertLess(abs(data.qpos[1] - strip.height(data.qpos[0])), 0.06)
        return data.qpos[0] - start, np.hypot(data.qvel[0], data.qvel[1]) / ideal

    def test_a_foot_slides(self):
        travel, ratio = self.slide('flat', 0, 0, 2, 8)
        self.assertAlmostEqual(travel, 16, delta=0.02)
        self.assertAlmostEqual(ratio, 1, delta=0.002)
        for seed in range(4):
            travel, ratio = self.slide('inclines', seed, 12, -1, 3)
            self.assertLess(travel, -8)
            self.assertGreater(ratio, 0.95)

    def test_a_foot_slides_over_abutting_boxes(self):
        lip = 1e-6  # m; keeps level boxes apart that would be merged at equal heights
        steps = {
            'StepSpacingMin': 0.2, 'StepSpacingMax': 0.4, 'StepH0Min': 0, 'StepH0Max': lip,
            'StepH1Min': -lip, 'StepH1Max': 0,
        }  # fmt: skip
        for seed in range(3):
            source = {'Type': 'var2d_steps', 'Params': [steps]}
            for each, least, most in ((source, 13, 99), ('flat', 1, 1)):
                strip = terrain.PlanarGround(terrain.load(each), seed)
                self.assertBetween(boxes.cut(0, *strip.window(0, 240)).number, least, most)
            travel, ratio = self.slide(source, seed, 0, 2, 3)
            self.assertAlmostEqual(travel, 6, delta=0.02)
            self.assertAlmostEqual(ratio, 1, delta=0.002)


class LongWalkTest(parameterized.TestCase):
    """The ground is unbounded, and moving the window does not affect the physics."""

    def test_environment_moves_the_window_with_a_walker(self):
        environment = suite.make('PD_Biped2D_Slopes_Mixed_Terrain-v0', {'random': 3})
        environment.reset()
        physics, arena = environment.physics, environment.task.arena
        strip = terrain.PlanarGround.from_state(arena.grounds[0].state())
        for x in np.arange(0.0, 200.0, 2.5):
            with physics.reset_context():
                physics.named.data.qpos['biped2d_full/root_x/'] = x
                physics.named.data.qpos['biped2d_full/root_z/'] = 20.0
            observation = environment.step(np.zeros(11)).observation
            x = physics.named.data.qpos['biped2d_full/root_x/'][0]
            samples = strip.height(x + np.linspace(-0.5, 3, 50)) - strip.height(x)
            np.testing.assert_allclose(observation['terrain'], samples, atol=1e-9)
            start, down = np.array([x, 0.9, 19]), np.array([0, 0, -1.0])
            distance = mujoco.mj_ray(
                physics.model.ptr,
                physics.data.ptr,
                start,
                down,
                None,
                True,
                -1,
                np.zeros(1, np.int32),
                None,
            )
            self.assertGreater(distance, 0)
            if len(away_from_faces(strip, np.array([x]))):
                self.assertAlmostEqual(19.0 - distance, float(strip.height(x)), delta=0.007)

    @parameterized.parameters('far', 'refilled')
    def test_moved_boxes_do_not_change_a_trajectory(self, how):
        """Neither far ones, so that ground ahead can be replaced, nor a window that is filled again."""
        states = []
        for disturb in (False, True):
            environment = suite.make('PD_Dog2D_Slopes_Mixed_Terrain-v0', {'random': 11})
            environment.reset()
            arena, model, trajectory = environment.task.arena, environment.physics.model.ptr, []
            for i in range(40):
                if disturb and how == 'refilled':
                    arena.restore(0, arena.state(0))
                elif disturb and i in (7, 19, 20):
                    ahead = model.geom_pos[:, 0] > environment.info['distance'] + 6
                    far = np.flatnonzero(ahead & (model.geom_bodyid == 0))
                    self.assertGreater(len(far), 20)
                    model.geom_pos[far, 0] += 3.0
                    environment.task.world.set_const(0)
                action = np.random.default_rng(i).uniform(-1, 1, 20)
                trajectory.append(environment.step(action).observation['pose'])
            states.append(np.array(trajectory))
        np.testing.assert_array_equal(*states)
