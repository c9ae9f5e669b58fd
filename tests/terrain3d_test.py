"""Tests of the three-dimensional part of trl_suite.terrain: values from the original's description."""

import functools
import itertools
import math
import pickle
from unittest import mock

import numpy as np
from absl.testing import parameterized
from helpers import assert_refused, height_map, surface_velocity, velocity_map

from trl_suite import terrain
from trl_suite.terrain import generators
from trl_suite.terrain.spatial import features, noise
from trl_suite.terrain.spatial import windows as spatial_ground

GRIDS = ('checkers3d', 'cliff3d', 'hills3d', 'steps3d', 'trail3d', 'trail3d1', 'trail3d2')
BOXED = ('blocks3d', 'pillars3d', 'path3d', 'path3d_wide', 'ramp3d', 'stairs3d')
MOVING = ('conveyor3d', 'conveyor3d_wide', 'dynamic_obstacles3d')


_TWO = terrain.boxes([(0, 0), (3, 1)], 1, 0.2)
BOXES = {
    'boxes': _TWO,
    'belts': terrain.Belts(_TWO, np.ones((2, 2))),
    'movers': terrain.Movers(*np.ones((3, 2, 2)), *np.ones((4, 2))),
}
FIELDS = {
    'boxes': _TWO._fields, 'belts': (*_TWO._fields, 'velocity'), 'movers': BOXES['movers']._fields,
}  # fmt: skip
SPOILT = (  # of each array of boxes: the change, and the message
    (lambda array: np.repeat(array, 10**5, 0), 'has shape .*; expected .2'),
    (lambda array: array[0] * np.ones(1), 'has shape .*; expected .2'),
    (lambda array: array.reshape(1, -1), 'has shape'),
    (lambda array: array.flat[0], 'is of type float64; expected an array'),
    (lambda array: array.tolist(), 'is of type list; expected an array'),
    (lambda array: array.astype(str), 'is of type <U.*; expected an array'),
    (lambda array: array.astype(complex), 'is of type complex128'),
    (lambda array: np.full_like(array, np.nan), 'is not finite'),
)


def replaced(part, field, change):
    """Returns boxes, belts or moving boxes with one array changed."""
    if field not in part._fields:  # of the boxes of belts
        return part._replace(boxes=replaced(part.boxes, field, change))
    return part._replace(**{field: change(getattr(part, field))})


def make(source, seed=0, **options):
    return terrain.SpatialGround(terrain.load(source), seed, **options)


def around(source, seeds, xy=None):
    """Surroundings of characters on grounds of their own."""
    ground = terrain.load(source)
    found = terrain.Surroundings(len(seeds), terrain.capacity(ground))
    xy = np.zeros((len(seeds), 2)) if xy is None else xy
    for env_id, seed in enumerate(seeds):
        found.begin(env_id, terrain.SpatialGround(ground, seed), xy[env_id])
    return found


def flow_of(source, ground, x, y):
    """Velocities of the surface at points (k,), (k, 2) m/s."""
    found = terrain.Surroundings(1, terrain.capacity(terrain.load(source)))
    found.begin(0, ground)
    return surface_velocity(found, x[None], y[None])[0]


def advance(found, dt, xy):
    """Moves the boxes around characters at xy, without physics."""
    ground = found.arrays
    ground.mover_distance[:] += ground.mover_direction * ground.mover_speed * dt
    for i, (x, y) in enumerate(xy):
        spatial_ground.turn_movers(i, x, y, ground)


def vertices(low, high):
    return np.arange(round(low / 0.2), round(high / 0.2) + 1)


class ParameterTest(parameterized.TestCase):
    @parameterized.parameters(sorted(terrain.IDLE))
    def test_parameters_without_effect(self, type_name):
        x, y = np.meshgrid(np.arange(-20, 20, 0.5) + 0.01, np.arange(-20, 20, 0.5) + 0.01)
        heights = []
        for factor in (1, 3):
            values = terrain.GENERATORS3D[type_name].defaults
            parameters = {name: factor * values[name] for name in terrain.IDLE[type_name]}
            ground = make({'Type': type_name, 'Params': [parameters]}, 1)
            heights.append(ground.height(x.ravel(), y.ravel()))
        self.assertGreater(np.ptp(heights[0]), 0)
        np.testing.assert_array_equal(*heights)


class NoiseTest(parameterized.TestCase):
    def test_tile(self):
        tile = noise.tile()
        found = (*tile.shape, tile.min(), tile.max(), tile.mean(), tile.std())
        np.testing.assert_allclose(found, (256, 256, 0.0005, 0.906, 0.5, 0.128), atol=5e-4)
        for one, other in ((tile[0], tile[-1]), (tile[:, 0], tile[:, -1])):  # it is periodic
            np.testing.assert_allclose(one, other, atol=1e-15)
        # Gradient noise is 0, here 1/2, at every lattice point; 16 of them span the 255 cells.
        np.testing.assert_allclose(tile[::51, ::51][[0, -1], 0], 0.5, atol=1e-15)

    def test_octaves(self):
        # The formula of the original, by plain bilinear interpolation at single points.
        offset = np.array([0.31, 0.77])
        x, y = np.array([-31.7, 0.0, 12.3, 400.1]), np.array([-3.3, 55.5])
        factors = (1, 1.96, 4.03, 7.92, 16.7, 31.12)
        expected = np.zeros((4, 2))
        for k, factor in enumerate(factors):
            for a in range(4):
                for b in range(2):
                    u, v = (
                        ((p * 0.001 * factor) + o) % 1 * 255
                        for p, o in zip((x[a], y[b]), offset, strict=True)
                    )
                    i, j = int(u), int(v)
                    corner = noise.tile()[i : i + 2, j : j + 2]
                    weight = np.outer((1 - u + i, u - i), (1 - v + j, v - j))
                    expected[a, b] += 2 / 2**k * (2 * (corner * weight).sum() - 1)
        found = noise.grid(x, y, offset, 0.001, 2)
        np.testing.assert_allclose(found, expected, atol=2e-6)
        above = [[noise.above(p, q, offset, 0.001) for q in y] for p in x]
        np.testing.assert_array_equal(above, expected > 0)


class ShapeTest(parameterized.TestCase):
    """The surfaces that are formulas."""

    def points(self, low=-30, high=30, count=4000):
        return np.random.default_rng(1).uniform(low, high, (2, count))

    def test_checkers(self):
        i, j = vertices(-20, 20), vertices(-20, 20)
        x, s = np.meshgrid(i / 5, -j / 5, indexing='ij')
        expected = 0.05 * ((np.floor(np.abs(x)) + np.floor(np.abs(s))) % 2)
        np.testing.assert_allclose(make('checkers3d').layout.grid(i, j), expected)

    @parameterized.parameters(('plane', 0), ('flat3d', 0), ('ramp3d', 0.1), ('rampincline3d', 0.06))
    def test_ramp(self, source, slope):
        x, y = self.points()
        expected = slope * np.sign(x) * np.maximum(0, np.abs(x) - 1)
        np.testing.assert_allclose(make(source).height(x, y), expected, atol=1e-12)

    @parameterized.parameters(
        ('path3d', 3, 10, 5, -2), ('path3d_wide', 4, 7, 7, -1), ('path3d_straight', 1.5, 10, 0, -1)
    )
    def test_path(self, source, width, length, shift, below):
        x, y = self.points()
        s = -y
        leg = np.floor(x / length)
        middle = np.where(leg % 2 == 0, 0, shift)
        on = np.abs(s - middle) < width / 2
        crossing = np.abs(x - length * np.round(x / length)) < width / 2
        on |= crossing & (s > -width / 2) & (s < shift + width / 2)
        np.testing.assert_array_equal(make(source).height(x, y), np.where(on, 0, below))

    def test_cliff(self):
        i, j = vertices(-20, 20), vertices(-20, 20)
        heights = make('cliff3d').layout.grid(i, j)
        x, s = np.meshgrid(i / 5, -j / 5, indexing='ij')
        side = s - 5 * (np.cos(2 * np.pi * x / 12) - 1)
        share = np.clip(0.5 * (np.abs(side) - 2.5), 0, 1)
        smooth = np.where(side < -2.5, 2 * share, np.where(side > 2.5, -2 * share, 0))
        rough = (share > 1e-9) & (share < 1 - 1e-9)
        still = np.abs(np.abs(side) - 3.5) > 1 + 1e-9
        np.testing.assert_allclose(heights[still], smooth[still], atol=1e-12)
        noise_of = (heights - smooth)[rough]
        self.assertLess(np.abs(noise_of).max(), 0.2)
        self.assertAlmostEqual(noise_of.std(), 0.2 / math.sqrt(3), delta=0.005)
        self.assertLess(abs(noise_of.mean()), 0.005)
        # The same in every episode, and for every order of queries.
        np.testing.assert_array_equal(heights, make('cliff3d', 9).layout.grid(i, j))
        np.testing.assert_array_equal(
            heights[50:70, 80:], make('cliff3d').layout.grid(i[50:70], j[80:])
        )
        # To the left the wall rises 2 m, to the right it falls 2 m.
        np.testing.assert_allclose(make('cliff3d').height([0, 0, 0], [5, 0, -5]), [2, 0, -2])

    def test_stairs(self):
        x = np.arange(-100, 100, 0.05) + 0.025
        residues = []
        for seed in range(20):
            ground = make('stairs3d', seed)
            heights = ground.height(x, 0.3)
            np.testing.assert_allclose(heights[(x > -1) & (x < 1.5)], 0.12 * 0.13154)
            tread = np.floor(2 * np.sign(x) * np.maximum(0, np.abs(x) - 1))
            for k in np.unique(tread):
                self.assertEqual(len(np.unique(heights[tread == k])), 1)
            first = np.unique(tread, return_index=True)[1]
            residues.append(((heights - 0.05 * tread) / 0.12)[first][tread[first] != 0])
            np.testing.assert_array_equal(heights, ground.height(x, 14.0))  # no seam
        residues = np.concatenate(residues)
        self.assertBetween(residues.min(), 0, 0.01)
        self.assertBetween(residues.max(), 0.99, 1)
        self.assertAlmostEqual(residues.mean(), 0.5, delta=4 / math.sqrt(12 * len(residues)))
        self.assertAlmostEqual(residues.std(), 1 / math.sqrt(12), delta=0.01)

    def test_hills(self):
        spread, slopes = [], []
        i = vertices(-40, 40)
        for seed in range(40):
            heights = make('hills3d', seed).layout.grid(i, i)
            spread.append(np.abs(heights - heights.mean()).max())
            slopes.append(np.hypot(*np.gradient(heights, 0.2)).mean())
        self.assertBetween(np.median(spread), 1.0, 2.2)
        self.assertAlmostEqual(np.mean(slopes), 0.07, delta=0.015)

    def test_grid_is_linear_on_triangles(self):
        heights = np.array([[0.0, 1.0, 0.0], [4.0, 2.0, 0.0], [0.0, 0.0, 0.0]])

        @terrain.register3d('test_grid3d', replace=True)
        def grid(parameters, rng):
            def vertices(i, j):
                return heights[np.ix_(i.clip(0, 2), j.clip(0, 2))]

            return terrain.Layout(level=None, grid=vertices)

        self.addCleanup(generators._spatial.pop, 'test_grid3d')
        ground = make({'Type': 'test_grid3d'})
        # The common edge runs from the back left (0, 0.2) to the front right corner (0.2, 0).
        self.assertAlmostEqual(ground.height(0.1, 0.1), (1 + 4) / 2)
        self.assertAlmostEqual(ground.height(0.05, 0.05), 0.25 * 1 + 0.25 * 4)
        self.assertAlmostEqual(ground.height(0.15, 0.15), 2 + 0.25 * (1 - 2) + 0.25 * (4 - 2))
        self.assertAlmostEqual(ground.height(0.2, 0.2), 2)


class ObstaclesTest(parameterized.TestCase):
    @parameterized.parameters(
        ('blocks3d', 96, (0.5, 7), (1, 5), 0.18),
        ('pillars3d', 640, (0.75, 0.75), (2, 8), 0.05),
        ('steps3d', 3200, (0.5, 3), (0.06, 0.14), 0.76),
    )
    def test_counts_sizes_and_cover(self, source, count, side, height, cover):
        ground = terrain.load(source)
        covered = []
        for seed in range(6):
            drawn = features._Obstacles(ground.parameters(), np.random.default_rng(seed))
            begin, end, tops = drawn._tile((0, 0))
            self.assertLen(tops, count)
            self.assertTrue(((begin >= -40) & (begin <= 40)).all())
            sides = end - begin
            self.assertGreaterEqual(sides.min(), side[0] - 1e-9)
            self.assertLessEqual(sides.max(), side[1] + 1e-9)
            self.assertGreaterEqual(tops.min(), height[0])
            self.assertLessEqual(tops.max(), height[1])
            touching = ((begin <= 2) & (end >= -2)).all(1)
            self.assertFalse(touching.any())
            x, y = np.random.default_rng(seed).uniform(-30, 30, (2, 4000))
            covered.append((terrain.SpatialGround(ground, seed).height(x, y) > 0.03).mean())
        self.assertAlmostEqual(np.mean(covered), cover, delta=0.25 * cover)

    def test_ground_does_not_depend_on_queries(self):
        corner = np.array([30.0, -50.0])
        for source in ('blocks3d', 'pillars3d'):
            once = make(source, 4).layout.boxes(corner, corner + 30)
            ground = make(source, 4)
            ground.layout.boxes(np.array([-200.0, 0.0]), np.array([-100.0, 90.0]))
            parts = [
                ground.layout.boxes(np.add(corner, (0, 10 * k)), np.add(corner, (30, 10 * k)))
                for k in range(4)
            ]
            again = ground.layout.boxes(corner, corner + 30)
            for a, b in zip(once, again, strict=True):
                np.testing.assert_array_equal(a, b)
            known = {tuple(p) for p in once.position}
            self.assertGreater(len(known), 5)
            for part in parts:
                self.assertContainsSubset({tuple(p) for p in part.position}, known)
        i, j = vertices(30, 50), vertices(-45, -30)
        wide = {'Type': 'trail3d', 'Params': [{'PathWidth0': 30, 'PathWidth1': 30}]}
        narrow = {'ObstacleDensity': 0.5, 'ObstacleWidth0': 0.1, 'ObstacleWidth1': 0.1}
        for source in ('steps3d', 'trail3d2', wide, {'Type': 'obstacles3d', 'Params': [narrow]}):
            one, other = (make(source, 4).layout.grid for _ in range(2))
            other(vertices(60, 80), j)
            np.testing.assert_array_equal(one(i, j)[20:50, 30:], other(i[20:50], j[30:]))

    def test_later_rubble_overwrites_earlier(self):
        drawn = features._Obstacles(terrain.load('steps3d').parameters(), np.random.default_rng(0))
        begin, end, tops = drawn._tile((0, 0))
        grid = features._rubble(drawn)
        i = vertices(5, 9)
        heights = grid(i, i)
        for a, b in ((0, 0), (7, 11), (20, 3), (13, 13)):
            point = np.array([i[a], i[b]]) * 0.2
            over = np.flatnonzero(((begin <= point) & (end >= point)).all(1))
            self.assertEqual(heights[a, b], np.float32(tops[over[-1]]) if len(over) else 0)


class TrailTest(parameterized.TestCase):
    @parameterized.parameters(
        ('trail3d1', 1, 2, 1.0), ('trail3d2', 2, 3, 1.5), ('trail3d', 1.6, 1.6, 1.5),
        ('trail3d_wide', 2, 3, 0.5),
    )  # fmt: skip
    def test_segments(self, source, narrowest, widest, turn):
        turns, shares, headings, rises = [], [], [], []
        for seed in range(30):
            trail = make(source, seed).layout.trail
            trail.extend(200)
            np.testing.assert_allclose(trail.start[:2], [(-1.25, 0), (0.75, 0)])
            np.testing.assert_allclose(np.linalg.norm(trail.end - trail.start, axis=1), 2)
            np.testing.assert_allclose(trail.start[1:], trail.end[:-1], atol=1e-12)
            self.assertBetween(trail.width.min(), narrowest, widest)
            self.assertBetween(trail.width.max(), narrowest, widest)
            turns.append(np.diff(trail.heading)[1:])
            shares.append((trail.width[2:] - narrowest) / max(widest - narrowest, 1e-9))
            headings.append(trail.heading[1:-1])
            rises.append(np.diff(trail.height))
        turns, shares, headings, rises = map(np.concatenate, (turns, shares, headings, rises))
        if widest > narrowest:  # where it is narrow it turns half as much
            for low, high, most in ((0, 0.25, 0.5), (0.25, 0.35, 1), (0.35, 1, 1)):
                some = np.abs(turns[(shares >= low) & (shares < high)]) / turn
                self.assertBetween(some.max(), 0.95 * most, most)
        self.assertBetween(np.abs(turns).max(), 0.98 * turn, turn)
        # Straight on is no preferred direction within 1 rad; further off the trail is led back.
        self.assertAlmostEqual((turns > 0).mean(), 0.5, delta=0.03)
        self.assertLess(np.abs(headings).max(), 0.6 * np.pi + turn)
        for heading in (1.2, 1.5, 1.8) if source == 'trail3d' else ():
            near = np.abs(np.abs(headings) - heading) < 0.1
            back = (np.sign(turns) != np.sign(headings))[near].mean()
            expected = 0.5 * (1 + (heading - 1) / (0.6 * np.pi - 1))
            self.assertAlmostEqual(back, expected, delta=0.07)
        stepped = rises[rises != 0]
        self.assertAlmostEqual(len(stepped) / len(rises), 0.5 * (source == 'trail3d2'), delta=0.03)
        if len(stepped):
            self.assertBetween(np.abs(stepped).min(), 0.1, 0.102)
            self.assertBetween(np.abs(stepped).max(), 0.198, 0.2)
            self.assertAlmostEqual((stepped > 0).mean(), 0.5, delta=0.04)

    def test_surroundings_of_the_trail(self):
        """On high ground the trail is wide enough."""
        heights, low, high, i = [], [], [], vertices(-16, 16)
        for seed in range(30):
            ground = make('trail3d1', seed)
            grid, trail = ground.layout.grid(i, i), ground.layout.trail
            heights.append(grid[np.abs(grid) > 1e-6])
            middle = 0.5 * (trail.start + trail.end)[:6]
            np.testing.assert_array_equal(ground.height(*middle.T), 0)
            trail.extend(100)
            for (x, y), width in zip(trail.start[2:100], trail.width[2:100], strict=True):
                (high if noise.above(x, -y, trail.offset, 0.005) else low).append(width)
        heights = np.concatenate(heights)
        self.assertAlmostEqual(heights.std(), 1.5, delta=0.3)
        self.assertAlmostEqual(heights.mean(), -1, delta=0.5)
        self.assertGreaterEqual(min(high), 1.25)
        self.assertLess(min(low), 1.05)

    def test_painted_within_half_the_width(self):
        ground = make('trail3d1', 3)
        i = vertices(-4, 12)
        grid = ground.layout.grid(i, i)
        trail = ground.layout.trail
        x, y = np.meshgrid(i * 0.2, i * 0.2, indexing='ij')
        inside = np.zeros(grid.shape, bool)
        for start, end, width in zip(trail.start, trail.end, trail.width, strict=True):
            way = end - start
            t = np.clip(((x - start[0]) * way[0] + (y - start[1]) * way[1]) / 4, 0, 1)
            inside |= np.hypot(x - start[0] - t * way[0], y - start[1] - t * way[1]) <= width / 2
        np.testing.assert_array_equal(grid == 0, inside)


class MovingTest(parameterized.TestCase):
    def test_moving_boxes(self):
        movers = [make('dynamic_obstacles3d', seed).layout.movers for seed in range(60)]
        speed = np.concatenate([m.speed for m in movers])
        self.assertLen(speed, 3000)
        self.assertBetween(speed.min(), 0.2, 0.2001)
        self.assertBetween(speed.max(), 1.2, 1.3)
        self.assertAlmostEqual(np.median(speed), 0.25, delta=0.01)
        self.assertAlmostEqual(speed.mean(), 0.38, delta=0.02)
        self.assertAlmostEqual(np.quantile(speed, 0.9), 0.79, delta=0.05)
        for name, low, high in (
            ('start', -20, 20), ('end', -20, 20), ('half_size', 0.25, 0.5), ('height', 0.5, 2),
            ('phase', 0, 1),
        ):  # fmt: skip
            values = np.concatenate([getattr(m, name).ravel() for m in movers])
            self.assertBetween(values.min(), low, low + 0.02 * (high - low))
            self.assertBetween(values.max(), high - 0.02 * (high - low), high)
        direction = np.concatenate([m.direction for m in movers])
        self.assertAlmostEqual((direction > 0).mean(), 0.5, delta=0.04)

    def test_boxes_move_back_and_forth(self):
        found = around('dynamic_obstacles3d', [3])
        movers = found.grounds[0].layout.movers
        far, dt = np.full((1, 2), 1000.0), 1 / 30
        ways = [found.arrays.mover_distance[0].copy()]
        for _ in range(6000):
            advance(found, dt, far)
            ways.append(found.arrays.mover_distance[0].copy())
        ways = np.array(ways)
        step = movers.speed * dt
        self.assertTrue((ways >= -step - 1e-9).all())
        self.assertTrue((ways <= movers.length + step + 1e-9).all())
        np.testing.assert_allclose(np.abs(np.diff(ways, axis=0)) / step, 1, atol=1e-6)
        # Between turns a triangle wave: after a whole period where they were, but for the steps.
        period = 2 * movers.length / (movers.speed * dt)
        k = int(np.argmin(np.abs(period - np.round(period)) + 1e6 * (period > 5000)))
        self.assertAlmostEqual(ways[round(period[k]), k], ways[0, k], delta=4 * step[k])

    def test_boxes_near_a_character_go_straight_on(self):
        found = around('dynamic_obstacles3d', [3])
        movers = found.grounds[0].layout.movers
        k = int(np.argmax(movers.speed))
        for _ in range(2000):
            xy = found.centres()[0, k][None] + 4.9  # beyond 5 m: diagonal
            advance(found, 1 / 30, xy)
        self.assertBetween(found.arrays.mover_distance[0, k], 0 - 0.1, movers.length[k] + 0.1)
        for _ in range(3000):
            xy = found.centres()[0, k][None] + (4.9, 0)
            advance(found, 1 / 30, xy)
        beyond = abs(found.arrays.mover_distance[0, k] - 0.5 * movers.length[k])
        self.assertGreater(beyond, movers.length[k])
        advance(found, 1 / 30, found.centres()[0, k][None] + (5.1, 0))
        sign = -1 if found.arrays.mover_distance[0, k] > 0 else 1
        self.assertEqual(found.arrays.mover_direction[0, k], sign)

    def test_conveyors(self):
        signs = []
        for seed in range(40):
            belts = make('conveyor3d', seed).layout.belts
            np.testing.assert_allclose(belts.boxes.position, [(x, 0) for x in (4, 9, 14, 19)])
            np.testing.assert_allclose(belts.boxes.half_size, [(1, 50)] * 4)
            np.testing.assert_allclose(belts.boxes.top, 0.01)
            np.testing.assert_allclose(np.abs(belts.velocity), [(0, 0.4)] * 4)
            signs.append(belts.velocity[:, 1] > 0)
        self.assertAlmostEqual(np.mean(signs), 0.5, delta=0.13)
        wide = make('conveyor3d_wide', 1).layout.belts
        np.testing.assert_allclose(wide.boxes.position, [(5.5, 0)])
        np.testing.assert_allclose(wide.boxes.half_size, [(2.5, 7.5)])
        np.testing.assert_allclose(np.abs(wide.velocity[0, 1]), 0.6)
        # It is the velocity of the highest part, in the windows as well.
        found, y = around('conveyor3d_wide', [1]), np.array([[0, 0, 7.4, 7.6]])
        velocity = surface_velocity(found, np.array([[2.9, 3.1, 5.0, 5.0]]), y)[0]
        np.testing.assert_allclose(velocity, np.outer((0, 1, 1, 0), wide.velocity[0]))
        found = around('dynamic_obstacles3d', [1])
        movers = found.grounds[0].layout.movers
        middle = movers.start + movers.phase[:, None] * (movers.end - movers.start)
        over = (np.abs(middle[:, None] - middle) <= movers.half_size).all(2)
        top = np.where(over, movers.height, -1)
        np.testing.assert_array_equal(found.grounds[0].height(*middle.T), top.max(1))
        expected = ((movers.end - movers.start) / movers.length[:, None])[top.argmax(1)]
        expected *= (movers.speed * movers.direction)[top.argmax(1)][:, None]
        near = np.abs(middle).max(1) < 15
        velocity = surface_velocity(found, *middle[near].T[:, None])[0]
        np.testing.assert_allclose(velocity, expected[near])


class GroundTest(parameterized.TestCase):
    """Seeds, states, spawn and goals."""

    @parameterized.parameters(*GRIDS, *BOXED, *MOVING)
    def test_seeds_and_states(self, source):
        x, y = np.random.default_rng(0).uniform(-15, 15, (2, 800))
        sequence = np.random.SeedSequence(5)
        ground, spawned = (
            make(source, sequence),
            make(source, np.random.SeedSequence(5).spawn(3)[2]),
        )
        heights, flow = ground.height(x, y), flow_of(source, ground, x, y)
        restored = terrain.SpatialGround.from_state(pickle.loads(pickle.dumps(spawned.state())))
        for one, other in (
            (ground, make(source, 5)), (ground, make(source, sequence)), (spawned, restored),
            (spawned, pickle.loads(pickle.dumps(spawned))),
        ):  # fmt: skip
            np.testing.assert_array_equal(other.height(x, y), one.height(x, y))
            np.testing.assert_array_equal(*(flow_of(source, each, x, y) for each in (one, other)))
            self.assertEqual(*(each.spawn(np.random.default_rng(3)) for each in (one, other)))
        self.assertEqual(sequence.n_children_spawned, 0)
        others = [make(source, seed) for seed in range(6, 10)]
        differs = any(not np.array_equal(other.height(x, y), heights) for other in others)
        if source in MOVING:
            differs = any(
                not np.array_equal(flow_of(source, other, x, y), flow) for other in others
            )
        drawn = source not in ('cliff3d', 'checkers3d', 'ramp3d', 'path3d', 'path3d_wide')
        self.assertEqual(differs, drawn)
        # Points far apart: as alone.
        x, y = np.array([(0.0, 3.0, -999_999.0, 5.0), (2.0, 9.0, 8.0, 999_999.0)])
        np.testing.assert_array_equal(
            ground.height(x, y), [ground.height(*point) for point in zip(x, y, strict=True)]
        )

    @parameterized.parameters(
        ('blocks3d', 24, 1.0), ('pillars3d', 24, 1.0), *((source, 12, 0.25) for source in MOVING)
    )
    def test_spawn_among_obstacles(self, source, far, goal_room):
        rng, places = np.random.RandomState(0), []
        for seed in range(15):
            ground = make(source, seed)
            for _ in range(10):
                x, y, heading = ground.spawn(rng)
                goal = ground.goal(rng, (x, y))
                places.append((x, y, heading))
                self.assertEqual(goal[2], 0)
                for place, room in (((x, y), 1.0), (goal[:2], goal_room)):
                    self.assertLessEqual(np.abs(place).max(), far)
                    inside = place + np.random.default_rng(seed).uniform(-room, room, (50, 2))
                    np.testing.assert_array_equal(ground.height(*inside.T), 0)
        self.assertGreater(np.abs(places).max(0)[0], 0.8 * far)
        self.assertBetween(np.max(places, 0)[2], 2.9, np.pi)
        self.assertBetween(np.min(places, 0)[2], -np.pi, -2.9)

    @parameterized.parameters(('ramp', (1000.9, 0.0)), ('stairs', (3.0, -1000.5)))
    def test_where_the_ground_ends(self, name, root):
        """Goals, and surfaces in windows, are finite also beyond it."""
        source = next(each for preset, each in terrain.PRESETS3D.items() if name in preset)
        ground, rng = terrain.SpatialGround(source, 3), np.random.default_rng(0)
        goals = np.array([ground.goal(rng, root) for _ in range(50)])
        exact = ground.height(*goals[:, :2].T)
        self.assertTrue(np.isinf(exact).any())
        self.assertTrue(np.isfinite(goals).all())
        around = terrain.Surroundings(1, terrain.capacity(source))
        around.begin(0, ground, root)
        found = around.height(goals[None, :, 0], goals[None, :, 1])[0]
        np.testing.assert_allclose(found[np.isfinite(exact)], exact[np.isfinite(exact)], atol=1e-9)
        self.assertLess(found[np.isinf(exact)].max(), exact.max() - 9)

    def test_goals_are_clear_of_the_current_boxes(self):
        ground, rng = make('dynamic_obstacles3d', 2), np.random.default_rng(0)
        centres = rng.uniform(-3, 3, (50, 2))
        for _ in range(30):
            goal = ground.goal(rng, (0, 0), movers=centres)
            self.assertEqual(ground.height(*goal[:2], centres), 0)
        crowd = {'NumObstacles': 100, 'ObstacleWidth0': 30, 'ObstacleWidth1': 30}
        crowded = make({'Type': 'dynamic_obstacles3d', 'Params': [crowd]})
        self.assertEqual(crowded.spawn(rng)[:2], (0, 0))  # it does not search for ever

    def test_spawn_on_a_trail(self):
        rng = np.random.default_rng(0)
        for seed in range(20):
            ground = make('trail3d1', seed)
            x, y, heading = ground.spawn(rng)
            self.assertLess(max(abs(x), abs(y)), 39)
            self.assertEqual(ground.height(x, y), 0)
            trail = ground.layout.trail
            across = (trail.start - (x, y)) @ (-math.sin(heading), math.cos(heading))
            same = np.abs(trail.heading - heading) < 1e-12
            self.assertLess(np.abs(across[same]).min(), 1e-9)
            nearest = np.linalg.norm(0.5 * (trail.start + trail.end) - (x, y), axis=1).argmin()
            for rule, most in (('far', 10), ('near', 1)):
                goal = ground.goal(rng, (x, y), rule)
                from_start, k = goal[:2] - trail.start, np.arange(len(trail.start))
                along = (from_start * (trail.end - trail.start)).sum(1) / 4
                left = np.stack([-np.sin(trail.heading), np.cos(trail.heading)], 1)
                on = (along >= -1e-9) & (along <= 1 + 1e-9) & (k > nearest) & (k <= nearest + most)
                on &= np.abs((from_start * left).sum(1)) / trail.width <= 0.4 + 1e-9
                self.assertTrue(on.any())
                self.assertEqual(goal[2], ground.height(*goal[:2]))  # at the rim it may be lower

    @parameterized.parameters('plane', 'hills3d', 'ramp3d', 'stairs3d', 'path3d', 'steps3d')
    def test_spawn_at_the_start(self, source):
        ground, rng = make(source), np.random.RandomState(1)
        self.assertEqual(ground.spawn(rng), (0.0, 0.0, 0.0))
        far = np.array([ground.goal(rng, (5.0, 7.0)) for _ in range(200)])
        self.assertBetween(np.abs(far[:, :2] - (5, 7)).max(), 2.9, 3)
        np.testing.assert_allclose(far[:, 2], ground.height(far[:, 0], far[:, 1]), atol=1e-6)
        steps = np.array([ground.goal(rng, (5.0, 7.0), 'near') for _ in range(200)])
        np.testing.assert_array_equal(steps[:, 1], 0)
        self.assertBetween(steps[:, 0].min() - 5, 1.0, 1.1)
        self.assertBetween(steps[:, 0].max() - 5, 2.9, 3)


class FileTest(parameterized.TestCase):
    def test_files_of_the_original_with_entries_without_effect(self):
        belts = {'Type': 'conveyor3d', 'Params': [
            {'ObstacleWidth0': 2, 'ObstacleWidth1': 2, 'ObstacleSpeed0': 0.4, 'ObstacleSpeed1': 0.4,
             'ObstacleSpeedLerpPow': 3, 'ConveyorStripLength': 100, 'ConveyorNumStrips': 4,
             'ConveyorNumSlices': 10, 'ConveyorSpacing': 3}]}  # fmt: skip
        for key, values in terrain.load('conveyor3d').parameters().items():
            self.assertEqual(terrain.load(belts).parameters()[key], values)
        terrain.load({'Type': 'trail3d', 'Params': [{'PathLength': 10, 'PathTurnLength': 5}]})
        terrain.load({'Type': 'var3d_stairs', 'Params': [{'StepSpacingMin': 1}]})
        terrain.load({'Type': 'var3d_flat', 'GroundWidth': 20, 'VertSpacingX': 0.2})

    def test_terrain_level_interpolates(self):
        mixed = {
            'Type': 'conveyor3d',
            'Params': [{'ConveyorNumStrips': 1}, {'ConveyorNumStrips': 4}],
        }
        counts = [
            len(make(mixed, 0, terrain_level=terrain_level).layout.belts.velocity)
            for terrain_level in (0, 0.5, 0.7, 1)
        ]
        self.assertEqual(counts, [1, 2, 3, 4])
        self.assertEqual(terrain.capacity(terrain.load(mixed)).belts, 4)


class RegisterTest(parameterized.TestCase):
    def setUp(self):
        super().setUp()
        self.enterContext(mock.patch.dict(generators._spatial))

    def test_new_type(self):
        @terrain.register3d('turned3d', {'YawMin': 0.2, 'YawMax': 0.4})
        def turned(parameters, rng):
            yaw = rng.uniform(parameters['YawMin'], parameters['YawMax'])
            blocks = terrain.boxes(
                [(3, 0), (-4, 2)], (2, 1), top=(0.5, 0.4), yaw=yaw, slope=(0.1, 0)
            )
            belt = terrain.boxes([(0, 6)], (3, 1), 0.2, yaw=0.3)
            return terrain.Layout(boxes=blocks, belts=terrain.Belts(belt, np.array([(0.5, 0.2)])))

        found = around({'Type': 'turned3d', 'Params': [{'YawMax': 0.5}]}, range(4))
        x, y = np.random.default_rng(0).uniform(-8, 8, (2, 4, 2000))
        heights, velocity = found.height(x, y), surface_velocity(found, x, y)
        for ground, *places, z, v in zip(found.grounds, x, y, heights, velocity, strict=True):
            np.testing.assert_allclose(z, ground.height(*places), atol=1e-12)
            np.testing.assert_array_equal(np.unique(v, axis=0), [(0, 0), (0.5, 0.2)])
            self.assertGreater(np.ptp(z[z > 0.41]), 0.2)  # the slope
            self.assertBetween((z > 0.45).mean() * 256, 3, 6)  # the area
            self.assertAlmostEqual(v.any(1).mean() * 256, 12, delta=3)
        same = found.height(x[:1].repeat(4, 0), y[:1].repeat(4, 0))
        self.assertFalse(np.array_equal(same[0], same[1]))

    def of(self, **parts):
        """A ground whose generator returns a layout of some parts, queried."""
        terrain.register3d('mine3d', replace=True)(lambda parameters, rng: terrain.Layout(**parts))
        return make({'Type': 'mine3d'}).height(0, 0)

    def test_invalid_generators_are_rejected(self):
        flat = terrain.boxes([(0, 0)], 1, math.nan)
        assert_refused(self, *((lambda parts=parts: self.of(**parts), f"'mine3d'.*{message}") for parts, message in (
            ({'level': None}, 'a level, a grid or boxes'), ({'level': math.nan}, 'level is not finite'),
            ({'level': 'low'}, 'level is of type str; expected a number or None'),
            ({'span': math.inf}, 'span is not finite'), ({'goal_room': None}, 'goal_room is of type NoneType'),
            ({'grid': np.zeros((2, 2))}, 'grid is of type ndarray; expected a function'),
            ({'boxes': []}, 'boxes is of type list; expected Boxes or a function'),
            ({'belts': _TWO}, 'belts is of type Boxes; expected Belts'), ({'place': 'top'}, 'place'),
            ({'place': 'trail'}, 'no trail'), ({'boxes': terrain.boxes([(0, math.inf)], 1, 1)}, 'boxes.position'),
            # Functions, at the first query.
            ({'grid': lambda i, j: np.zeros(3)}, r'heights of shape .* \(3,\)'),
            ({'grid': lambda i, j: np.zeros((len(i), len(j)), complex)}, 'an array of complex128'),
            ({'grid': lambda i, j: np.full((len(i), len(j)), np.nan)}, 'returned nan at x = .* m, y = '),
            ({'boxes': lambda low, high: None}, 'must return finite Boxes: .* NoneType'),
            ({'boxes': lambda low, high: flat}, 'finite Boxes'),
        )))  # fmt: skip
        terrain.register3d('array3d')(lambda parameters, rng: np.zeros(3))
        # Not the kinds of parts of the samples.
        self.of(grid=lambda i, j: np.zeros((len(i), len(j))))
        holds = terrain.capacity(terrain.load({'Type': 'mine3d'}))._replace(grid=False)
        moody = functools.partial(terrain.Surroundings(1, holds).begin, 0, make({'Type': 'mine3d'}))
        assert_refused(
            self,
            (functools.partial(make, {'Type': 'array3d'}), 'must return a Layout'),
            (moody, 'mine3d.*same kinds'),
        )

    @parameterized.parameters('boxes', 'belts', 'movers', 'function')
    def test_arrays_that_do_not_fit_are_rejected(self, part):
        kind = 'boxes' if part == 'function' else part
        for field, (change, message) in itertools.product(FIELDS[kind], SPOILT):
            spoilt = replaced(BOXES[kind], field, change)
            given = (lambda low, high, s=spoilt: s) if part == 'function' else spoilt
            assert_refused(
                self, (lambda g=given: self.of(**{kind: g}), rf"'mine3d'.* {kind}\.\w+ {message}")
            )
        for field in _TWO._fields[:4]:
            boxes = replaced(_TWO, field, SPOILT[0][0])
            query = functools.partial(boxes.touching, (-1, -1), (1, 1))
            assert_refused(self, (query, r'boxes\.\w+ has shape .*; expected \('))


class LimitsTest(parameterized.TestCase):
    def setUp(self):
        super().setUp()
        self.enterContext(mock.patch.dict(generators._spatial))

    def test_a_path_is_on_the_ground(self):
        source = {'Type': 'var3d_path', 'Params': [{'PathHeight0': -1, 'PathHeight1': 0}]}
        with self.assertRaisesRegex(
            ValueError, 'PathHeight0 is -1; expected at least PathHeight1, 0'
        ):
            terrain.SpatialGround(terrain.load(source), 0)

    def test_a_span_is_a_whole_number_of_cells(self):
        seen = []

        def level(x, y):
            seen.append(x.min())
            return 0 * x

        ground = terrain.from_function(level, start_span=0.6)
        for seed in range(60):
            terrain.SpatialGround(ground, seed).height(0.0, 0.0)
        self.assertAlmostEqual(np.ptp(seen), 1.2)

    def test_numbers_of_boxes_may_be_random(self):
        def some(parameters, random):
            k = int(random.integers(1, 40))
            return terrain.Layout(
                level=0.0,
                boxes=terrain.boxes(random.uniform(-12, 12, (k, 2)), [(0.2, 0.2)] * k, 0.3),
            )

        terrain.register3d('numbers', replace=True)(some)
        found = terrain.capacity(terrain.load({'Type': 'numbers'})).boxes
        self.assertGreater(found, 39)


class SurroundingsTest(parameterized.TestCase):
    """Windows over a batch axis."""

    @parameterized.parameters('stairs3d', 'ramp3d', 'blocks3d', 'conveyor3d', 'hills3d')
    def test_beyond_a_window_its_rim_continues(self, source):
        found = around(source, range(2), np.array([(0.0, 0.0), (8.0, -4.0)]))
        centre = found.arrays.centre[:, None]
        points = centre + np.random.default_rng(0).uniform(-60, 60, (2, 400, 2))
        points = np.concatenate([points, centre + [[(1e6, 3), (2, -1e300)]] * 2], 1)
        rim = np.clip(points, centre - 16, centre + 16)
        for query in found.height, functools.partial(surface_velocity, found):
            expected = query(*np.moveaxis(rim, 2, 0))
            np.testing.assert_array_equal(query(*np.moveaxis(points, 2, 0)), expected)
            self.assertTrue(np.isfinite(expected).all())
        xy = found.arrays.centre + np.array([(13.0, 2.0), (900.0, -1e5)])
        heading = np.array([0.3, -2.0])
        points = np.moveaxis(self.samples(xy, heading), 2, 0)
        under = found.height(*xy.T[..., None])
        np.testing.assert_allclose(
            height_map(found, xy, heading), found.height(*points) - under, atol=3e-6
        )
        flow = surface_velocity(found, *points) - surface_velocity(found, *xy.T[..., None])
        ahead = np.stack([np.cos(heading), np.sin(heading)], 1)[:, None]
        np.testing.assert_allclose(
            velocity_map(found, xy, heading)[:, :1024], (flow * ahead).sum(2), atol=1e-12
        )

    def samples(self, xy, heading):
        """Points of maps in the order of the original: lines from the left, each from behind."""
        right, forward = np.meshgrid(
            np.linspace(-5.5, 5.5, 32), np.linspace(-1, 10, 32), indexing='ij'
        )
        ahead = np.stack([np.cos(heading), np.sin(heading)], 1)[:, None]
        aside = np.stack([np.sin(heading), -np.cos(heading)], 1)[:, None]
        return xy[:, None] + forward.reshape(-1, 1) * ahead + right.reshape(-1, 1) * aside

    @parameterized.parameters(*GRIDS, *BOXED, *MOVING, 'plane')
    def test_maps_equal_direct_queries(self, source):
        rng = np.random.default_rng(2)
        count = 19  # more than are handled at once
        xy = np.add(rng.uniform(-10, 10, (count, 2)), (4, 0))
        found = around(source, range(count), xy)
        if source == 'dynamic_obstacles3d':
            for _ in range(100):
                advance(found, 0.2, xy)
        heading = rng.uniform(-np.pi, np.pi, count)
        points = self.samples(xy, heading)
        heights, velocities = (query(found, xy, heading) for query in (height_map, velocity_map))
        self.assertEqual((heights.shape, velocities.shape), ((count, 1024), (count, 2048)))
        differing = 0
        for env_id, ground in enumerate(found.grounds):
            centres = found.centres()[env_id] if found.capacity.movers else None
            expected = ground.height(*points[env_id].T, centres) - ground.height(
                *xy[env_id], centres
            )
            # Within rounding of an edge of a box either side may be taken.
            differing += (np.abs(heights[env_id] - expected) > 3e-6).sum()
        flow = surface_velocity(found, *np.moveaxis(points, 2, 0))
        flow -= surface_velocity(found, *xy.T[..., None])
        cosine, sine = np.cos(heading)[:, None], np.sin(heading)[:, None]
        forward, right = (
            cosine * flow[..., 0] + sine * flow[..., 1],
            sine * flow[..., 0] - cosine * flow[..., 1],
        )
        differing += (np.abs(velocities - np.concatenate([forward, right], 1)) > 1e-12).sum()
        self.assertLessEqual(differing, 4)
        self.assertEqual(bool(velocities.any()), source in MOVING)
        env_ids = np.array([0, 7, 18])
        np.testing.assert_array_equal(
            height_map(found, xy[env_ids], heading[env_ids], env_ids), heights[env_ids]
        )
        np.testing.assert_array_equal(
            velocity_map(found, xy[env_ids], heading[env_ids], env_ids), velocities[env_ids]
        )

    @parameterized.parameters(
        'hills3d', 'pillars3d', 'stairs3d', 'trail3d1', 'path3d', 'conveyor3d'
    )
    def test_windows_follow(self, source):
        found, rng = around(source, [0, 1]), np.random.default_rng(0)
        xy, laid = np.zeros((2, 2)), []
        for _ in range(120):
            xy = xy + rng.uniform(-0.5, 1.5, (2, 2)) * (1, 0.4)
            laid += found.recentre(np.arange(2), xy)
            self.assertLessEqual(np.abs(found.arrays.centre - xy).max(), 4)
            x, y = xy.T[..., None] + rng.uniform(-11.4, 11.4, (2, 2, 9))
            for ground, *places, z in zip(found.grounds, x, y, found.height(x, y), strict=True):
                np.testing.assert_allclose(z, ground.height(*places), atol=2e-6)
        self.assertBetween(len(laid), 20, 60)
        for step, left in ((3.9, False), (4.1, True), (np.nan, False)):
            x, y = found.arrays.centre[0] + (0, step)
            self.assertEqual(spatial_ground.has_left(0, x, y, found.arrays), left)
        spatial_ground.height(0, np.nan, np.inf, found.arrays)  # reads no memory of others
        # Only the simulations that are given, and a jump.
        self.assertEqual(found.recentre(np.array([1]), np.array([(999.0, -3.0)])), [1])
        there = found.height(np.array([[999.0]]), np.array([[-3.0]]), np.array([1]))
        self.assertEqual(there.shape, (1, 1))
        assert_refused(
            self,
            *((lambda x=x, y=y: found.height(np.zeros(x), np.zeros(y)), message) for x, y, message in (
                ((3, 1), (3, 1), r'x has .*\(2, 1\)'), ((2, 5), (2, 4), r'y has .*\(2, 5\)'),
                (2, 2, r'x has .*\(2, 2\)'))),
        )  # fmt: skip
        plane = around('plane', [0])  # has no windows
        self.assertEqual(plane.recentre(np.zeros(1, int), np.full((1, 2), 1e5)), [])
        self.assertEqual(plane.height(np.full((1, 1), 1e5), np.zeros((1, 1))), 0)

    def test_crowds_of_large_boxes(self):
        @terrain.register3d('crowd3d', replace=True)
        def crowd(parameters, rng):
            middle, half = rng.uniform(-12, 12, (90, 2)), rng.uniform(3, 9, (90, 2))
            blocks = terrain.boxes(
                middle, half, rng.uniform(0.1, 1, 90), yaw=rng.uniform(-3, 3, 90)
            )
            return terrain.Layout(boxes=blocks)

        self.addCleanup(generators._spatial.pop, 'crowd3d')
        found = around({'Type': 'crowd3d'}, range(2))
        self.assertEqual(found.arrays.bins[0, 3, 5].tolist(), [0, 90])  # they do not fit into bins
        x, y = np.random.default_rng(0).uniform(-15, 15, (2, 2, 500))
        for env_id, ground in enumerate(found.grounds):
            np.testing.assert_array_equal(
                found.height(x, y)[env_id], ground.height(x[env_id], y[env_id])
            )

    @parameterized.parameters('pillars3d', 'dynamic_obstacles3d', 'trail3d2')
    def test_state(self, source):
        xy = np.array([(9.0, 3.0), (-7.0, 1.0)])
        found, other = around(source, [0, 1], xy), around(source, [5, 6, 7])
        for _ in range(50):
            advance(found, 0.1, xy)
        other.restore(2, pickle.loads(pickle.dumps(found.state(1))))
        for part in ('mover_distance', 'mover_direction', 'centre'):
            restored, expected = getattr(other.arrays, part)[2], getattr(found.arrays, part)[1]
            np.testing.assert_array_equal(restored, expected)
        points, env_ids = xy[1] + np.linspace(-8, 8, 50)[:, None], np.array([1])
        heights = found.height(*points.T[:, None], env_ids)
        np.testing.assert_array_equal(other.height(*points.T[:, None], env_ids + 1), heights)
        empty = terrain.Surroundings(1, found.capacity)
        empty.restore(0, empty.state(0))
        self.assertIsNone(empty.grounds[0])

    @parameterized.parameters('blocks3d', 'pillars3d', 'stairs3d', 'path3d', 'path3d_straight')
    def test_capacity(self, source):
        ground = terrain.load(source)
        holds = terrain.capacity(ground)
        most = 0
        for seed in range(100, 160):
            layout = terrain.SpatialGround(ground, seed).layout
            for centre in ((0, 0), (24, -20), (400, 8)):
                low = np.array(centre) - 16.0
                most = max(most, len(layout.boxes_in(low, low + 32).top))
        self.assertLessEqual(most, holds.boxes)
        self.assertLess(holds.boxes, 1.6 * most + 10)

    def test_an_overfull_window_keeps_the_nearest_boxes(self):
        ground = terrain.load('pillars3d')
        holds = terrain.capacity(ground)._replace(boxes=40)
        found = terrain.Surroundings(1, holds)
        found.begin(0, terrain.SpatialGround(ground, 0))
        x, y = np.random.default_rng(0).uniform(-5, 5, (2, 1, 500))
        np.testing.assert_array_equal(found.height(x, y)[0], found.grounds[0].height(x[0], y[0]))
        self.assertLen(found.boxes[0].top, 40)
