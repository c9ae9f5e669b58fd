"""Tests of the three-dimensional arena: the collision geometry is the ground, and it moves."""

import dataclasses
import functools
import pickle

import mujoco
import numpy as np
from absl.testing import parameterized
from dm_control import composer, mjcf
from helpers import assert_refused, height_map, surface_velocity, velocity_map

from trl_suite import terrain
from trl_suite.arenas import PlanarArena, SpatialArena
from trl_suite.engine import BatchWorld, PhysicsWorld, light_model
from trl_suite.terrain import generators
from trl_suite.terrain.spatial import windows as spatial_ground

TIMESTEP = 1 / 300  # s
SUBSTEPS = 10
# Largest deviation of the collision geometry from a query, m: height fields are single precision.
EXACT, SINGLE = 1e-9, 5e-6
BOXED = (
    'plane', 'ramp3d', 'stairs3d', 'path3d', 'path3d_straight', 'blocks3d', 'pillars3d',
    'conveyor3d', 'conveyor3d_wide', 'dynamic_obstacles3d',
)  # fmt: skip
GRIDS = ('checkers3d', 'cliff3d', 'hills3d', 'steps3d', 'trail3d1', 'trail3d2')
BALL = {'type': 'sphere', 'size': (0.1,), 'mass': 1, 'friction': (0.81, 0.005, 0.0001)}
CUBE = {
    'type': 'box', 'size': (0.1, 0.1, 0.1), 'mass': 10, 'friction': (0.81, 0.005, 0.0001),
    'solref': (0.005, 1), 'solimp': (0.95, 0.99, 0.001),
}  # fmt: skip


def tree(source, load=None):
    """An arena, alone or with one free body."""
    arena = SpatialArena(terrain.load(source))
    root = arena.mjcf_model
    root.option.timestep = TIMESTEP
    if load is not None:
        body = root.worldbody.add('body', name='load')
        body.add('freejoint', name='load')
        body.add('geom', name='load', **load)
        for ground in arena.touched:
            root.sensor.add('contact', body1=body, num=1, data='found', **ground)
    return arena


class Stage:
    """An arena over one or many simulations, each with a load."""

    def __init__(self, source, seeds=(0,), load=None, batch=False, xy=None):
        self.arena = arena = tree(source, load)
        if batch:
            model = light_model(arena.mjcf_model)
            self.world = BatchWorld(model, len(seeds), 1)
        else:
            self.physics = mjcf.Physics.from_mjcf_model(arena.mjcf_model)
            model = self.physics.model.ptr
            self.world = PhysicsWorld(self.physics)
            self.model, self.data = model, self.physics.data.ptr
        self.env_ids = np.arange(len(seeds))
        arena.bind(self.world)
        self.xy = np.zeros((len(seeds), 2)) if xy is None else np.array(xy, float)
        for env_id, seed in enumerate(seeds):
            arena.begin_episode(env_id, terrain.SpatialGround(arena.terrain, seed), self.xy[env_id])
        if load is not None:
            joint = model.body('load').jntadr[0]
            self.q, self.v = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
        self.world.forward(self.env_ids)

    def put(self, position, velocity=(0, 0, 0)):
        """Sets positions and velocities of the loads."""
        q, v = self.q, self.v
        self.world.qpos[:, q : q + 3] = position
        self.world.qpos[:, q + 3 : q + 7] = (1, 0, 0, 0)
        self.world.qvel[:, v : v + 6] = 0
        self.world.qvel[:, v : v + 3] = velocity
        self.world.forward(self.env_ids)

    @property
    def position(self):
        return self.world.qpos[:, self.q : self.q + 3]

    @property
    def velocity(self):
        return self.world.qvel[:, self.v : self.v + 3]

    def run(self, seconds, xy=None):
        for _ in range(round(30 * seconds)):
            self.arena.recentre(self.env_ids, self.xy if xy is None else xy)
            self.world.step(SUBSTEPS)

    def height(self, x, y, env_id=0):
        x, y = np.atleast_2d(x), np.atleast_2d(y)
        return self.arena.height(x, y, slice(env_id, env_id + 1))[0]

    def rays(self, x, y):
        """Heights of the collision geometry, by rays from above."""
        geom, heights = np.zeros(1, np.int32), []
        for px, py in zip(np.ravel(x), np.ravel(y), strict=True):
            distance = mujoco.mj_ray(
                self.model, self.data, np.array([px, py, 60.0]), np.array([0, 0, -1.0]), None, True,
                -1, geom, None,
            )  # fmt: skip
            heights.append(60.0 - distance if geom[0] >= 0 else np.nan)
        return np.array(heights)


class GeometryTest(parameterized.TestCase):
    """Ray casts against queries."""

    @parameterized.parameters(*BOXED, *GRIDS)
    def test_geometry_equals_the_ground(self, source):
        stage = Stage(source)
        tolerance = SINGLE if source in GRIDS else EXACT
        for seed, xy in ((0, (0, 0)), (1, (17.3, -9.1)), (2, (-40.2, 12.0)), (3, (200.0, 31.0))):
            stage.arena.begin_episode(0, terrain.SpatialGround(stage.arena.terrain, seed), xy)
            stage.world.forward(stage.env_ids)
            x, y = np.array(xy)[:, None] + np.random.default_rng(seed).uniform(-12, 12, (2, 250))
            queried = stage.height(x, y)
            np.testing.assert_allclose(stage.rays(x, y), queried, atol=tolerance)
            exact = stage.arena.grounds[0].height(x, y)
            np.testing.assert_allclose(queried, exact, atol=tolerance)
            # MuJoCo defines height fields for 0 to 1 only: contacts with others are lost.
            self.assertGreaterEqual(stage.model.hfield_data.min(initial=0), 0)
            self.assertLessEqual(stage.model.hfield_data.max(initial=0), 1)
        geoms = {'plane': 1, 'conveyor3d': 5, 'ramp3d': 3, 'dynamic_obstacles3d': 51}
        geoms |= {'pillars3d': 199, 'blocks3d': 59, **dict.fromkeys(GRIDS, 1)}
        self.assertLessEqual(stage.model.ngeom, geoms.get(source, 99))

    @parameterized.parameters('stairs3d', 'hills3d', 'pillars3d', 'trail3d1')
    def test_geometry_follows(self, source):
        stage = Stage(source, (4,))
        rng = np.random.default_rng(0)
        for x in (*np.arange(0, 60, 3.1), 0.0):  # and back
            xy = np.array([(x, 0.4 * x)])
            stage.arena.recentre(stage.env_ids, xy)
            px, py = xy[0][:, None] + rng.uniform(-11.9, 11.9, (2, 20))
            expected = stage.arena.grounds[0].height(px, py)
            np.testing.assert_allclose(stage.rays(px, py), expected, atol=SINGLE)

    def test_solver_and_friction(self):
        planar = mjcf.Physics.from_mjcf_model(
            PlanarArena(terrain.load('mixed_humanoid')).mjcf_model
        )
        for model in (
            planar.model.ptr,
            *(Stage(source).model for source in ('hills3d', 'dynamic_obstacles3d')),
        ):
            option = model.opt
            self.assertEqual(option.cone, mujoco.mjtCone.mjCONE_PYRAMIDAL)
            self.assertEqual(option.integrator, mujoco.mjtIntegrator.mjINT_IMPLICITFAST)
            self.assertEqual(
                (option.noslip_iterations, option.solver), (0, mujoco.mjtSolver.mjSOL_NEWTON)
            )
            np.testing.assert_array_equal(option.gravity, (0, 0, -9.8))  # the original's
            self.assertEqual(option.tolerance, planar.model.opt.tolerance)
            np.testing.assert_allclose(model.geom_friction[:, 0], 0.81)
            np.testing.assert_array_equal(model.geom_condim, 3)
            for name in ('geom_solref', 'geom_solimp', 'geom_friction'):
                expected = getattr(planar.model.ptr, name)[:1].repeat(model.ngeom, 0)
                np.testing.assert_array_equal(getattr(model, name), expected, name)

    def test_turned_and_sloping_boxes(self):
        @terrain.register3d('turned3d', replace=True)
        def turned(parameters, rng):
            return terrain.Layout(
                level=-0.3,
                boxes=terrain.boxes(
                    rng.uniform(-8, 8, (6, 2)), (2, 1), rng.uniform(0.2, 0.8, 6),
                    yaw=rng.uniform(-3, 3, 6), slope=rng.uniform(-0.2, 0.2, 6),
                ),
                belts=terrain.Belts(
                    terrain.boxes([(0, 12)], (3, 1), -0.1, yaw=0.3), np.array([(0.5, 0.2)])
                ),
            )  # fmt: skip

        self.addCleanup(generators._spatial.pop, 'turned3d')
        for seed in range(4):
            stage = Stage({'Type': 'turned3d'}, (seed,))
            x, y = np.random.default_rng(seed).uniform(-13, 13, (2, 600))
            error = np.abs(stage.rays(x, y) - stage.height(x, y))
            # The lower ends overhang, by up to 0.2 of the height of the box.
            lean = stage.height(x, y) == -0.3
            np.testing.assert_allclose(error[~lean], 0, atol=EXACT)
            self.assertLess((error[lean] > EXACT).mean(), 0.01)
            self.assertGreater((~lean).sum(), 30)

    def test_invalid_arguments_are_rejected(self):
        @terrain.register3d('steep3d', replace=True)
        def steep(parameters, rng):
            return terrain.Layout(level=None, grid=lambda i, j: np.add.outer(i, 0 * j) * 0.5)

        self.addCleanup(generators._spatial.pop, 'steep3d')
        arena = Stage('dynamic_obstacles3d', (5, 6, 7), batch=True).arena
        recentre = functools.partial(functools.partial, arena.recentre, np.arange(3))
        assert_refused(
            self,
            (lambda: SpatialArena(terrain.load('gaps')), 'gaps'),
            (lambda: PlanarArena(terrain.load('hills3d')), 'hills3d'),
            (lambda: Stage({'Type': 'steep3d'}), 'steep3d.*rises.*40 m'),
            (recentre(np.zeros((1, 2))), r'xy has shape .*; expected \(3, 2\)'),
            (recentre(np.zeros((3, 1))), r'xy has shape .*; expected \(3, 2\)'),
        )


class DynamicsTest(parameterized.TestCase):
    """Bodies on geoms that were moved after compiling."""

    @parameterized.parameters('blocks3d', 'pillars3d', 'path3d')
    def test_a_ball_stays_on_a_block(self, source):
        stage = Stage(source, load=BALL)
        for seed in (1, 2):
            stage.arena.begin_episode(0, terrain.SpatialGround(stage.arena.terrain, seed))
            stage.world.forward(stage.env_ids)
            boxes, met = stage.arena.surroundings.boxes[0], 0
            for k in range(len(boxes.top)):
                x, y = boxes.position[k]
                corners = boxes.position[k] + 0.9 * boxes.half_size[k] * [(1, 1), (1, -1), (-1, 1)]
                if np.ptp(stage.height(*corners.T)) > 0 or np.abs((x, y)).max() > 11:
                    continue  # blocks overlap
                top = stage.height(x, y)[0]
                stage.put((x, y, top + 0.3))
                mujoco.mj_step(stage.model, stage.data, 450)
                np.testing.assert_allclose(stage.position[0], (x, y, top + 0.1), atol=2e-4)
                met += 1
                if met == 4:
                    break
            self.assertGreater(met, 1)

    @parameterized.parameters(*GRIDS, 'ramp3d', 'stairs3d', 'conveyor3d')
    def test_nothing_falls_through(self, source):
        stage = Stage(source, load=CUBE)
        for seed in range(3):
            stage.arena.begin_episode(0, terrain.SpatialGround(stage.arena.terrain, seed))
            for x, y in np.random.default_rng(seed).uniform(-8, 8, (4, 2)):
                stage.put((x, y, stage.height(x, y)[0] + 1.0), (1, 0, -2))
                stage.run(1.0)
                x, y, z = stage.position[0]
                self.assertGreater(z, stage.height(x, y)[0] - 0.02)
                self.assertLess(z, stage.height(np.add(x, [-0.1, 0, 0.1]), 3 * [y]).max() + 0.7)

    @parameterized.parameters('conveyor3d', 'conveyor3d_wide')
    def test_a_body_on_a_belt_reaches_its_speed(self, source):
        stage = Stage(source, load=CUBE)
        for seed in range(4):
            stage.arena.begin_episode(0, terrain.SpatialGround(stage.arena.terrain, seed))
            around = stage.arena.seen()
            speed = surface_velocity(around, np.full((1, 1), 4.0), np.zeros((1, 1)))[0, 0, 1]
            self.assertAlmostEqual(abs(speed), {'conveyor3d': 0.4}.get(source, 0.6))
            stage.put((4, 0, 0.11))
            stage.run(1.0)
            np.testing.assert_allclose(stage.velocity[0], (0, speed, 0), atol=2e-3)
            y = stage.position[0, 1]
            stage.run(2.0)
            np.testing.assert_allclose(stage.position[0], (4, y + 2 * speed, 0.11), atol=5e-3)
            # Off the belt it comes to rest.
            stage.put((2, 0, 0.1), (0, speed, 0))
            stage.run(1.0)
            np.testing.assert_allclose(stage.velocity[0], 0, atol=1e-3)

    def mover(self, stage, k):
        around, ground = stage.arena.seen(), stage.arena.surroundings.arrays
        speed = ground.mover_speed[0, k] * ground.mover_direction[0, k]
        velocity = speed * ground.mover_axis[0, k]
        return around.centres()[0, k], velocity, ground.mover_half_size[0, k]

    def alone(self, stage):
        """The fastest moving box with nothing near its path for two seconds."""
        centres = stage.arena.surroundings.centres()[0]
        for k in np.argsort(-stage.arena.surroundings.arrays.mover_speed[0]).tolist():
            way = centres[k] + 2 * self.mover(stage, k)[1]
            gap = np.linalg.norm(centres - 0.5 * (centres[k] + way), axis=1)
            gap[k] = np.inf
            if gap.min() > 3.5 + np.linalg.norm(way - centres[k]) / 2 and np.abs(way).max() < 30:
                return k
        self.fail('no box by itself')

    def test_a_moving_box_carries(self):
        stage = Stage('dynamic_obstacles3d', (5,), load=CUBE)
        k = self.alone(stage)
        near = self.mover(stage, k)[0][None]  # a character nearby, so that it does not reverse
        stage.arena.recentre(stage.env_ids, near)
        centre, velocity, _ = self.mover(stage, k)
        stage.put((*centre, stage.height(*centre)[0] + 0.1), (*velocity, 0))
        stage.run(2.0, near)
        after, _, _ = self.mover(stage, k)
        np.testing.assert_allclose(after - centre, 2 * velocity, atol=2e-3)
        np.testing.assert_allclose(stage.position[0, :2] - after, 0, atol=5e-3)
        np.testing.assert_allclose(stage.velocity[0, :2], velocity, atol=2e-3)
        # From rest it is dragged along.
        stage.put((*after, stage.height(*after)[0] + 0.1))
        stage.run(1.0, near)
        np.testing.assert_allclose(stage.velocity[0, :2], velocity, atol=2e-3)

    def test_moving_boxes_yield_to_what_is_caught_between_them(self):
        stage = Stage('dynamic_obstacles3d', (5,), load=CUBE)
        ground = terrain.SpatialGround(stage.arena.terrain, 5)
        end = np.array([[2.0, 0], [-2, 0]])
        movers = type(ground.layout.movers)(
            start=-end, end=end, half_size=np.full((2, 2), 0.4), height=np.ones(2),
            speed=np.full(2, 1.3), phase=np.zeros(2), direction=np.ones(2),
        )  # fmt: skip
        ground.layout = dataclasses.replace(ground.layout, movers=movers)
        stage.arena.begin_episode(0, ground)
        stage.put((0, 0, 0.1))  # it is reached after 1.15 s, from both sides
        gaps, speeds = [], []
        for _ in range(90):
            stage.run(1 / 30)
            centres, dof = stage.arena.surroundings.centres()[0, :2, 0], stage.arena._dof[:2]
            gaps.append(centres[1] - centres[0] - 0.8)
            speeds.append(np.abs(stage.world.qvel[0, dof]).max())
        self.assertGreater(min(gaps), 0.2 - 0.06)  # the cube has 0.2 m
        self.assertLess(max(speeds[60:]), 0.2)  # they would pass through each other at 1.3
        np.testing.assert_allclose(stage.position[0], (0, 0, 0.1), atol=0.05)
        stage.put((0, 4, 0.1))
        stage.run(2.0)
        np.testing.assert_allclose(stage.world.qvel[0, dof], 1.3, atol=0.01)

    def test_boxes_keep_their_speed_and_path(self):
        stage = Stage('dynamic_obstacles3d', (7,))
        movers = stage.arena.grounds[0].layout.movers
        kinematic = terrain.Surroundings(1, stage.arena.capacity)
        kinematic.begin(0, stage.arena.grounds[0])
        expected, found = kinematic.arrays, stage.arena.surroundings.arrays
        for _ in range(900):
            spatial_ground.turn_movers(0, 0.0, 0.0, expected)
            expected.mover_distance[:] += expected.mover_direction * expected.mover_speed / 30
            stage.run(1 / 30, np.zeros((1, 2)))
        stage.arena.seen()
        np.testing.assert_allclose(found.mover_distance, expected.mover_distance, atol=2e-3)
        np.testing.assert_array_equal(found.mover_direction, expected.mover_direction)
        reversed_ = expected.mover_direction[0] != movers.direction
        self.assertTrue(reversed_.any())
        # Queries and geometry agree on where they are.
        x, y = np.random.default_rng(0).uniform(-12, 12, (2, 400))
        stage.world.forward(stage.env_ids)
        np.testing.assert_allclose(stage.rays(x, y), stage.height(x, y), atol=EXACT)
        self.assertGreater((stage.height(x, y) > 0).sum(), 3)

    def test_inertia_of_movers_does_not_loosen_the_solver(self):
        # The solver stops by a tolerance relative to the mean inertia.
        with_drives, without = Stage('dynamic_obstacles3d', load=CUBE), Stage('plane', load=CUBE)
        expected = without.model.stat.meaninertia
        self.assertAlmostEqual(with_drives.model.stat.meaninertia, expected, delta=1e-6 * expected)
        stage = with_drives
        stage.arena.begin_episode(0, terrain.SpatialGround(stage.arena.terrain, 3))
        self.assertAlmostEqual(stage.model.stat.meaninertia, expected, delta=1e-6 * expected)

    def test_contact_sensors(self):
        stage = Stage('dynamic_obstacles3d', (5,), load=CUBE)
        stage.put((0, 0, 30))
        stage.run(1.0)
        self.assertEqual(stage.data.ncon, 0)  # boxes touch neither ground nor each other

        def touches(*position):
            stage.put(position)
            return (stage.data.sensordata > 0).any()

        self.assertFalse(touches(0, 0, 30))
        centre, _, _ = self.mover(stage, self.alone(stage))
        self.assertTrue(touches(*centre, stage.height(*centre)[0] + 0.099))
        x, y, _ = stage.arena.grounds[0].spawn(np.random.default_rng(0))
        self.assertTrue(touches(x, y, 0.099))
        for source in ('plane', 'blocks3d', 'hills3d', 'conveyor3d'):
            stage = Stage(source, load=CUBE)
            self.assertEqual(len(stage.arena.touched) == 1, source in ('plane', 'hills3d'))
            self.assertFalse(touches(0, 0, 30))
            for x in np.linspace(-3, 3, 7):  # on the plane, the field, boxes, belts
                self.assertTrue(touches(x, 0, stage.height(x, 0)[0] + 0.05), (source, x))


class WorldTest(parameterized.TestCase):
    """Many simulations, states."""

    def begin(self, source, seeds, batch):
        grounds = [terrain.SpatialGround(terrain.load(source), seed) for seed in seeds]
        starts = [ground.spawn(np.random.RandomState(7)) for ground in grounds]
        stage = Stage(source, seeds, load=BALL, batch=batch, xy=[start[:2] for start in starts])
        x, y = stage.xy[:, :1], stage.xy[:, 1:]
        stage.put(np.concatenate([x, y, stage.arena.height(x, y) + 0.3], 1), (3, 1, 0))
        return stage, np.array([start[2] for start in starts])

    def advance(self, stage, heading, steps):
        """Follows the balls; returns all observations."""
        seen = []
        for _ in range(steps):
            xy = stage.position[:, :2].copy()
            stage.arena.recentre(stage.env_ids, xy)
            stage.world.step(SUBSTEPS)
            xy = stage.position[:, :2].copy()
            around = stage.arena.seen()
            maps = height_map(around, xy, heading), velocity_map(around, xy, heading)
            seen.append(np.concatenate([stage.position, stage.velocity, *maps], 1))
        return np.stack(seen, 1)

    @parameterized.parameters('pillars3d', 'dynamic_obstacles3d', 'trail3d1')
    def test_goals_are_on_the_ground_that_is_there(self, source):
        stage, rng = Stage(source, (3,)), np.random.RandomState(0)
        stage.run(1.0)
        for _ in range(20):
            x, y, z = stage.arena.goal(0, rng, (0.0, 0.0))
            if max(abs(x), abs(y)) < 12:
                self.assertAlmostEqual(z, stage.height(x, y)[0], delta=1e-5)
            self.assertEqual(z * (source != 'trail3d1'), 0)

    @parameterized.parameters(
        'plane', 'hills3d', 'stairs3d', 'pillars3d', 'trail3d2', 'conveyor3d', 'dynamic_obstacles3d'
    )
    def test_every_simulation_has_its_own_ground_and_equals_a_physics(self, source):
        """A physics that continues from a restored state, too."""
        seeds = (11, 4, 8)
        stage, heading = self.begin(source, seeds, batch=True)
        seen = self.advance(stage, heading, 60)  # far enough to move windows
        for env_id, seed in enumerate(seeds):
            single, psi = self.begin(source, (seed,), batch=False)
            np.testing.assert_array_equal(self.advance(single, psi, 30)[0], seen[env_id, :30])
            state = pickle.loads(pickle.dumps((single.arena.state(0), single.world.get_state(0))))
            found = [self.advance(single, psi, 30)[0]]
            if seed == 8:
                other = self.begin(source, (9,), batch=False)[0]
                other.run(0.3)
                for each in (single, other):
                    each.arena.restore(0, state[0])
                    each.world.set_state(0, state[1])
                    found.append(self.advance(each, psi, 30)[0])
            for each in found:
                np.testing.assert_array_equal(each, seen[env_id, 30:])
        if source != 'plane':
            self.assertFalse(np.array_equal(seen[0][:, 6:], seen[1][:, 6:]))

    @parameterized.parameters('hills3d', 'pillars3d')
    def test_pictures_show_the_new_ground(self, source):
        def begin():
            arena = tree(source, BALL)
            above = {'pos': (0, -9, 9), 'xyaxes': (1, 0, 0, 0, 0.7, 0.7)}
            arena.mjcf_model.worldbody.add('camera', name='above', **above)
            environment = composer.Environment(composer.NullTask(arena), random_state=0)
            environment.reset()
            arena.bind(PhysicsWorld(environment.physics))
            return arena, environment

        def picture(arena, environment, seed, x):
            arena.begin_episode(0, terrain.SpatialGround(arena.terrain, seed))
            for place in (x, 0.0):
                arena.recentre(np.zeros(1, int), np.array([(place, 0.0)]))
            environment.physics.forward()
            return environment.physics.render(60, 80, 'above').astype(int)

        one, other = begin(), begin()
        first, second = picture(*one, 1, 0.0), picture(*one, 2, 0.0)
        self.assertGreater(np.abs(first - second).mean(), 1)
        np.testing.assert_array_equal(picture(*other, 2, 30.0), second)
        # Refilled within an episode, after frames were rendered.
        np.testing.assert_array_equal(picture(*other, 1, -30.0), first)
