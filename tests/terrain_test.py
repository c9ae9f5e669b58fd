"""Tests of trl_suite.terrain: values from the papers and the original's description."""

import copy
import functools
import itertools
import json
import math
import pickle
from unittest import mock

import numpy as np
from absl.testing import parameterized
from helpers import FolderTest, assert_refused, assert_uniform

from trl_suite import terrain
from trl_suite.terrain import generators

# The example printed in the paper.
PAPER = """
{
  "Type": "var2d_slopes_mixed",
  "Params": [
    {
      "GapSpacingMin": 3, "GapSpacingMax": 4, "GapWMin": 0.3, "GapWMax": 0.5,
      "GapHMin": -2, "GapHMax": -2,
      "WallSpacingMin": 3, "WallSpacingMax": 4, "WallWMin": 0.2, "WallWMax": 0.2,
      "WallHMin": 0.25, "WallHMax": 0.4,
      "StepSpacingMin": 3, "StepSpacingMax": 4, "StepH0Min": 0.1, "StepH0Max": 0.3,
      "StepH1Min": -0.3, "StepH1Max": -0.1,
      "SlopeDeltaRange": 0.05, "SlopeDeltaMin": -0.5, "SlopeDeltaMax": 0.5
    }
  ]
}
"""


def draw(source, length=20.0, seed=0):
    ground = terrain.load(source)
    rng = np.random.default_rng(seed)
    return generators.draw(ground.type, ground.parameters(), length, rng)


def planar(kind, **parameters):
    return {'Type': f'var2d_{kind}', 'Params': [parameters]}


def runs(profile):
    """Returns (vertices, height) of the level runs of the ground, its first vertex included."""
    heights = np.concatenate(([0.0], profile.heights))
    starts = np.flatnonzero(np.diff(heights, prepend=np.nan) != 0)
    return np.diff(np.append(starts, len(heights))), heights[starts]


def slopes(profile):
    return np.diff(profile.heights, prepend=0.0) / 0.025


def rounded(values):
    """Without the last bits of differences of heights."""
    return np.round(values, 9)


class ProcessTest(parameterized.TestCase):
    """What the generators make."""

    def assert_lengths(self, counts, low, high):
        """Asserts that counts of cells could be lengths from U(low, high) m, rounded up."""
        low, high = low / 0.025, high / 0.025
        lowest = math.floor(low + 1e-6) + 1 + 0.05 * (high - low)
        self.assertBetween(np.min(counts), low, lowest)
        self.assertBetween(np.max(counts), high - 0.05 * (high - low), math.ceil(high - 1e-6))
        deviation = (high - low) / math.sqrt(12 * len(counts))
        self.assertAlmostEqual(np.mean(counts) - 0.5, (low + high) / 2, delta=4 * deviation)

    def test_box_of_wall(self):
        # A wall of 0.2 m is 8 vertices: crest 0.175 m, foot 0.225 m; the ground stays at 0.
        wall = planar('walls', WallSpacingMin=1, WallSpacingMax=1, WallHMin=0.3, WallHMax=0.3)
        profile = draw(wall, 5.0)
        counts, levels = runs(profile)
        # 40 cells of spacing, then 8 vertices of wall, then 1 + 40 vertices.
        np.testing.assert_array_equal(counts[:4], [41, 8, 41, 8])
        np.testing.assert_array_equal(levels[:4], [0, 0.3, 0, 0.3])
        faces = np.flatnonzero(profile.vertical)  # of cells
        np.testing.assert_array_equal(faces[:4] - 40, [0, 8, 49, 57])
        self.assertEqual(profile.heights[-1], 0)

    def test_rise_accumulates(self):
        step = planar('steps', StepSpacingMin=0.5, StepSpacingMax=0.5, StepH0Min=0.1,
                      StepH0Max=0.1, StepH1Min=0.1, StepH1Max=0.1)  # fmt: skip
        profile = draw(step, 2.1)
        counts, levels = runs(profile)
        # Tread and riser take 21 cells; four of them reach 84 = 2.1 m.
        np.testing.assert_array_equal(counts, [21, 21, 21, 21, 1])
        np.testing.assert_allclose(levels, [0, 0.1, 0.2, 0.3, 0.4], atol=1e-12)
        np.testing.assert_array_equal(np.flatnonzero(profile.vertical), [20, 41, 62, 83])

    @parameterized.parameters(
        # Per feature, x and height of where the ground bends, as with vertices 0.1 m apart.
        ('gaps', [1, 1.1, 1.4, 1.5], [0, -2, -2, 0],
         {'GapSpacing': 1, 'GapW': 0.4, 'GapH': -2}),
        ('walls', [1, 1.1, 1.2, 1.3], [0, 0.3, 0.3, 0],
         {'WallSpacing': 1, 'WallW': 0.2, 'WallH': 0.3}),
        ('walls', [1, 1.1, 1.2], [0, 0.3, 0],
         {'WallSpacing': 1, 'WallW': 0.05, 'WallH': 0.3}),
        ('steps', [0.5, 0.6], [0, 0.1], {'StepSpacing': 0.5, 'StepH0': 0.1, 'StepH1': 0}),
        ('cliffs', [0.5, 0.6], [0, -0.3], {'CliffSpacing': 0.5, 'CliffH0': 0, 'CliffH1': -0.3}),
        ('narrow_gaps', [1, 1.1, 1.2, 1.3, 1.4, 1.5, 1.6, 1.7], [0, -1, -1, 0, 0, -1, -1, 0],
         {'NarrowGapSpacing': 1, 'NarrowGapDist': 0.1, 'NarrowGapW': 0.2, 'NarrowGapDepth': -1,
          'NarrowGapCount': 2}),
    )  # fmt: skip
    def test_ramps(self, kind, x, heights, features):
        ranges = {f'{name}{end}': v for name, v in features.items() for end in ('Min', 'Max')}
        ground = terrain.load(planar(kind, **ranges)).with_faces(0.1)
        xs = np.append(0, np.add.outer(x[-1] * np.arange(5), x))  # five features, from 1 m on
        zs = np.append(0, np.add.outer(heights[-1] * np.arange(5), heights))
        at = np.random.default_rng(0).uniform(0, xs[-1], 500)
        strip = terrain.PlanarGround(ground, 0)
        np.testing.assert_allclose(strip.height(1 + at), np.interp(at, xs, zs), atol=1e-9)
        self.assertFalse(strip.window(40, 400)[1].any())
        # One cell is as steep as in the original; 0 is vertical; treads keep their lengths.
        for length, count in ((0.0, 1), (0.02, 1), (0.3, 12)):
            profile = draw(ground.with_faces(length))
            bent = np.flatnonzero(rounded(np.diff(profile.heights, n=2, prepend=[0, 0])))
            self.assertEqual(bent[0], round(x[0] / 0.025))
            self.assertEqual(bent[1] - bent[0], count)
            self.assertEqual(profile.vertical.any(), length == 0)

    def test_ledges_of_ramps(self):
        """The ledges of a cliff keep their length."""
        rise = rounded(np.diff(draw(terrain.load('cliffs_rugged').with_faces(0.1), 200.0).heights))
        begins = np.flatnonzero((rise[1:] > 0) & (rise[:-1] == 0)) + 1
        for i in begins[:-1]:
            np.testing.assert_array_equal(rise[i : i + 4], rise[i])
            np.testing.assert_array_equal(rise[i + 4 : i + 8], 0)
        self.assertIn(8, np.diff(begins))  # a ramp of 0.1 m and a ledge of 0.1 m

    def test_terrain_without_faces(self):
        for name in ('flat', 'slopes', 'bumps', 'plane'):
            self.assertIs(terrain.load(name).with_faces(0.1), terrain.load(name))
        self.assertIs(terrain.load('gaps').with_faces(None), terrain.load('gaps'))
        with self.assertRaisesRegex(
            ValueError, 'gaps: Params.0.: FaceLength is -1; expected .* from 0'
        ):
            terrain.load('gaps').with_faces(-1)

    @parameterized.parameters(
        (0.2, 8), (0.3, 12), (0.55, 22), (0.7, 28), (0.1 + 0.2, 12), (0.21, 9), (0.0, 0)
    )
    def test_cells(self, length, count):
        self.assertEqual(generators.cells(length), count)

    @parameterized.parameters(*sorted(terrain.GENERATORS))
    def test_length(self, kind):
        # At least the given length, longer by less than a feature.
        longest_feature = {'narrow_gaps': 10.0}
        name = kind.removeprefix('var2d_').removeprefix('slopes_')
        for seed in range(10):
            length = len(draw({'Type': kind}, 20.0, seed).heights) * 0.025
            self.assertBetween(length, 20.0 - 1e-9, 20.0 + longest_feature.get(name, 9.1))

    @parameterized.parameters(
        # Levels of floors or crests, their widths, and the ground between them, m.
        ('gaps', (-2, -2), (0.5, 2), (4, 7)),
        ('gaps_hopper', (-2.5, -2), None, None),
        ('walls_humanoid', (0.05, 0.25), None, (2, 4)),
    )
    def test_boxes(self, name, levels, widths, between):
        counts, found = runs(draw(name, 10_000.0))
        box = found != 0
        if levels[0] < levels[1]:
            assert_uniform(found[box], *levels)
        else:
            np.testing.assert_array_equal(found[box], levels[0])
        if widths:
            self.assert_lengths(counts[box], *widths)
        if name.startswith('walls'):
            np.testing.assert_array_equal(counts[box], 8)
        if between:  # the vertex after the box, and the spacing
            self.assert_lengths(counts[~box][:-1] - 1, *between)

    def test_steps_go_up_as_often_as_down(self):
        counts, levels = runs(draw('steps', 10_000.0))
        rises = np.diff(levels)
        assert_uniform(rounded(rises[rises > 0]), 0.1, 0.4)
        assert_uniform(rounded(rises[rises < 0]), -0.4, -0.1)
        up = (rises > 0).mean()
        self.assertAlmostEqual(up, 0.5, delta=4 * 0.5 / math.sqrt(len(rises)))
        # A tread is the vertex of the riser and the spacing.
        self.assert_lengths(counts[1:-1] - 1, 5, 7)

    @parameterized.parameters(
        ((0.0, 0.0), (0.2, 0.3), {1}),
        ((-0.3, -0.2), (0.0, 0.0), {-1}),
        ((0.0, 0.2), (-0.2, 0.0), {-1, 1}),  # one end at 0 does not switch a range off
        ((0.0, 0.0), (0.0, 0.0), set()),
    )
    def test_range_of_rises(self, first, second, directions):
        step = planar('steps', StepSpacingMin=0, StepSpacingMax=0, StepH0Min=first[0],
                      StepH0Max=first[1], StepH1Min=second[0], StepH1Max=second[1])  # fmt: skip
        profile = draw(step)
        rises = np.diff(profile.heights)
        self.assertEqual({*np.sign(rises[rises != 0])}, directions)
        self.assertEqual(profile.vertical.any(), bool(directions))

    def test_narrow_gaps(self):
        counts, levels = runs(draw('narrow_gaps', 20_000.0))
        floor = levels < 0
        np.testing.assert_array_equal(levels[floor], -2)
        self.assert_lengths(counts[floor], 0.1, 0.5)
        # Spacings are at least 3 m, stepping stones at most 0.4 m.
        between = counts[~floor][:-1] - 1
        stones = between[between < 40]
        self.assert_lengths(stones, 0.15, 0.4)
        self.assert_lengths(between[between > 40], 3, 6)
        clusters = np.diff(np.append(np.flatnonzero(between > 40), len(between)))[:-1]
        number, times = np.unique(clusters, return_counts=True)
        np.testing.assert_array_equal(number, [1, 2, 3, 4])
        np.testing.assert_allclose(times / times.sum(), 0.25, atol=0.03)

    def test_count_of_narrow_gaps_is_truncated_and_at_least_one(self):
        one = planar('narrow_gaps', NarrowGapCountMin=0, NarrowGapCountMax=1.9)
        counts, levels = runs(draw(one, 2_000.0))
        self.assertGreaterEqual(counts[levels == 0][:-1].min(), 3 / 0.025)

    def test_cliffs_have_ledges(self):
        profile = draw('cliffs_rugged', 20_000.0)
        counts, levels = runs(profile)
        rises = np.diff(levels)
        self.assertGreater(rises.min(), 0)  # the first range only, and ledges lie in between
        # A ledge is the vertex of its riser and 4 cells; a tread is at least 0.8 m.
        treads = counts[1:-1] - 1
        ledge = treads < 8
        np.testing.assert_array_equal(treads[ledge], 4)
        self.assert_lengths(treads[~ledge], 0.8, 1.0)
        # Total rises are uniform, and have 1, 2 or 3 risers with equal frequency.
        ends = np.append(np.flatnonzero(~ledge), len(ledge))
        totals = np.diff(levels[ends + 1])
        assert_uniform(rounded(totals), 0.2, 0.5)
        number, times = np.unique(np.diff(ends), return_counts=True)
        np.testing.assert_array_equal(number, [1, 2, 3])
        np.testing.assert_allclose(times / times.sum(), 1 / 3, atol=0.02)
        self.assertAlmostEqual(levels[-1] / 20_000, 0.34, delta=0.02)

    def test_mixed_thirds(self):
        counts, levels = runs(draw('mixed_humanoid', 20_000.0))
        rises = np.diff(levels)
        gaps = np.count_nonzero(rises < -1)
        walls = np.count_nonzero(counts[1:-1] == 8)
        steps = len(rises) - 2 * gaps - 2 * walls
        total = gaps + walls + steps
        self.assertGreater(total, 3_000)
        np.testing.assert_allclose(np.array([gaps, walls, steps]) / total, 1 / 3, atol=0.04)

    def test_bumps(self):
        heights = draw(planar('bumps', BumpHMin=0.02, BumpHMax=0.05), 1_000.0).heights
        self.assertEqual(heights[-1], 0)
        moved = heights[:-1]
        assert_uniform(np.abs(moved), 0.02, 0.05)
        self.assertAlmostEqual((moved > 0).mean(), 0.5, delta=0.02)
        self.assertLess(abs(np.corrcoef(moved[1:], moved[:-1])[0, 1]), 0.03)  # white
        self.assertFalse(draw('bumps').vertical.any())

    @parameterized.parameters(
        ('slopes', 0.0, 0.13, 0.90, 0.08),
        ('slopes_humanoid', 0.0, 0.36, 0.68, 0.13),
        ('inclines', 0.175, 0.04, 0.10, 0.01),
    )
    def test_slopes(self, name, mean, deviation, correlation, deviation_over_1m):
        g = slopes(draw(name, 20_000.0))
        self.assertAlmostEqual(g.mean(), mean, delta=0.005)
        self.assertAlmostEqual(g.std(), deviation, delta=0.006)
        self.assertAlmostEqual(np.corrcoef(g[1:], g[:-1])[0, 1], correlation, delta=0.02)
        self.assertAlmostEqual(g.reshape(-1, 40).mean(1).std(), deviation_over_1m, delta=0.006)

    def test_slopes_under_features(self):
        # Only the random walk: the features have no height.
        ground = json.loads(PAPER)
        for key in ('GapH', 'WallH', 'StepH0', 'StepH1'):
            ground['Params'][0].update({f'{key}Min': 0, f'{key}Max': 0})
        g = slopes(draw(ground, 20_000.0))
        self.assertAlmostEqual(g.std(), 0.09, delta=0.006)
        self.assertAlmostEqual(np.corrcoef(g[1:], g[:-1])[0, 1], 0.95, delta=0.01)
        metres = g[: len(g) // 40 * 40].reshape(-1, 40).mean(1)
        self.assertAlmostEqual(metres.std(), 0.07, delta=0.006)

    def test_slope_starts_at_zero_and_moves_first_vertex(self):
        first = np.array([draw('slopes', 0.025, seed).heights[0] for seed in range(500)])
        self.assertGreater(np.abs(first).min(), 0)
        # One change of up to 0.1, either way, over one cell.
        assert_uniform(first, -0.1 * 0.025, 0.1 * 0.025)

    def test_slope_band_without_width_adds_nothing(self):
        bare = planar('slopes', SlopeDeltaRange=0.3, SlopeDeltaMin=0.2, SlopeDeltaMax=0.2)
        np.testing.assert_array_equal(draw(bare).heights, 0)
        # The shipped slopes_gaps is such a file: 3 m on, 2 m off, level.
        counts, levels = runs(draw('slopes_gaps', 100.0))
        np.testing.assert_array_equal(levels[:4], [0, -2, 0, -2])
        np.testing.assert_array_equal(counts[:4], [121, 80, 121, 80])

    @parameterized.parameters('gaps', 'walls', 'steps', 'mixed', 'narrow_gaps')
    def test_features_on_slopes(self, kind):
        profile = draw(planar(f'slopes_{kind}', SlopeDeltaRange=0.02))
        rise = np.abs(np.diff(profile.heights, prepend=0.0))
        self.assertTrue(profile.vertical.any())
        self.assertGreater(rise[profile.vertical].min(), 0.08)
        self.assertLess(rise[~profile.vertical].max(), 0.02)
        self.assertGreater(rise[~profile.vertical].min(), 0)

    @parameterized.parameters('gaps', 'walls', 'steps', 'mixed', 'narrow_gaps', 'cliffs')
    def test_parameters_beyond_the_limits(self, kind):
        """They are checked in a `Terrain`; a user's generator may call the function itself."""
        generator = terrain.GENERATORS[f'var2d_{kind}']
        values = 0.0, math.nan, math.inf, -math.inf, -5.0, 1e6, 1e300
        for parameter, value in itertools.product((*generator.defaults, None), values):
            changed = generator.defaults if parameter is None else {parameter: value}
            parameters = {**generator.defaults, **dict.fromkeys(changed, value)}
            profile = generator.function(parameters, 20.0, np.random.default_rng(0))
            self.assertGreaterEqual(len(profile.heights), 800, parameter)
            self.assertEqual(profile.vertical.shape, profile.heights.shape)


class FileTest(FolderTest):
    """Terrain files, presets, blending."""

    def write(self, text, name='mine.json'):
        path = self.folder / name
        path.write_text(text, encoding='utf-8')
        return path

    def test_paper_example(self):
        path = self.write(PAPER, 'slopes.txt')
        for source in (path, str(path), json.loads(PAPER)):
            ground = terrain.load(source)
            self.assertEqual(ground.type, 'var2d_slopes_mixed')
            self.assertEqual(
                ground.parameters(), json.loads(PAPER)['Params'][0] | {'FaceLength': 0}
            )
        preset = terrain.load('slopes_mixed_humanoid')
        self.assertEqual(preset.parameters(), terrain.load(path).parameters())
        self.assertIs(terrain.load(preset), preset)

    @parameterized.parameters(
        'flat', 'gaps', 'steps', 'walls', 'mixed', 'narrow_gaps', 'slopes', 'slopes_gaps', 'slopes_walls',
        'slopes_steps', 'slopes_mixed', 'cliffs',
    )  # fmt: skip
    def test_files_of_the_predecessor(self, kind):
        """Their types lack the prefix."""
        defaults = terrain.load({'Type': f'var2d_{kind}'}).parameters()
        given = {key: value / 2 for key, value in defaults.items()}
        path = self.write(json.dumps({'Type': kind, 'Params': [given] if given else []}))
        ground = terrain.load(path)
        self.assertEqual((ground.type, ground.parameters()), (f'var2d_{kind}', given))

    def test_cliffs_of_the_predecessor_may_have_overlays_of_size_0(self):
        flat = dict.fromkeys(('BumpHMin', 'BumpHMax'), 0)
        flat |= dict.fromkeys(('SlopeDeltaRange', 'SlopeDeltaMin', 'SlopeDeltaMax'), 0.0)
        for extra in ({}, flat):
            ground = terrain.load({'Type': 'cliffs', 'Params': [{'CliffMiniCountMax': 2, **extra}]})
            self.assertEqual(ground.parameter_sets, ({'CliffMiniCountMax': 2},))
        for kind, extra in (('cliffs', {'BumpHMax': 0.1}), ('var2d_cliffs', flat)):
            with self.assertRaisesRegex(ValueError, "'BumpH.*' has no effect in var2d_cliffs"):
                terrain.load({'Type': kind, 'Params': [extra]})

    @parameterized.parameters({}, {'Params': []}, {'Params': [{}]}, {'GroundWidth': 20})
    def test_defaults(self, **content):
        defaults = {'GapSpacingMin': 4, 'GapSpacingMax': 7, 'GapWMin': 0.5, 'GapWMax': 2,
                    'GapHMin': -2, 'GapHMax': -2, 'FaceLength': 0}  # fmt: skip
        found = terrain.load({'Type': 'var2d_gaps', **content}).parameters()
        self.assertEqual(found, defaults)
        some = terrain.load(planar('gaps', GapWMax=1)).parameters()
        self.assertEqual(some, {**defaults, 'GapWMax': 1})

    def test_terrain_level_interpolates(self):
        ground = terrain.load('gaps_curriculum')
        for terrain_level, low, high in (
            (0, 0.1, 0.25), (0.25, 0.2, 0.5625), (1, 0.5, 1.5),
        ):  # fmt: skip
            values = ground.parameters(terrain_level)
            self.assertAlmostEqual(values['GapWMin'], low)
            self.assertAlmostEqual(values['GapWMax'], high)
            self.assertEqual(values['GapSpacingMin'], 4)
        self.assertEqual(ground.parameters(), ground.parameters(0))
        sets = [{'GapWMin': 0.1, 'GapWMax': 0.1}, {}, {'GapWMin': 1, 'GapWMax': 1}]
        three = terrain.load({'Type': 'var2d_gaps', 'Params': sets})
        for level, low, high in ((0.5, 0.3, 1.05), (1.5, 0.75, 1.5)):
            values = three.parameters(level)
            np.testing.assert_allclose((values['GapWMin'], values['GapWMax']), (low, high))
        easy, hard = (
            terrain.PlanarGround(terrain.load('bumps_blend'), 0, terrain_level=level).window(
                40, 800
            )[0]
            for level in (0, 1)
        )
        np.testing.assert_array_equal(easy, 0)
        self.assertGreater(np.abs(hard).max(), 0.06)

    @parameterized.parameters(*terrain.PRESETS, *terrain.PRESETS3D)
    def test_presets(self, name):
        source = terrain.load(name)
        self.assertEqual((source.name, source.spatial), (name, name in terrain.PRESETS3D))
        for other in (pickle.loads(pickle.dumps(source)), copy.deepcopy(source)):
            self.assertEqual(other, source)
        if source.spatial:
            self.assertTrue(np.isfinite(terrain.SpatialGround(source, 0).height(3.0, 1.0)))
            return
        # Away from vertical faces the ground never leaps, across 13 joins.
        for level in range(max(1, len(source.parameter_sets))):
            ground = terrain.PlanarGround(source, 0, terrain_level=level)
            heights, vertical = ground.window(-5000, 10_000)
            leap = np.abs(np.diff(heights))[~vertical[1:]]
            self.assertLess(leap.max(), 0.15)
            self.assertLess(np.median(leap), 0.08)
        self.assertEqual(np.ptp(heights) == 0, name == 'flat')

    def test_presets_that_differ_from_the_original(self):
        values = terrain.load('mixed_curriculum').parameters(0)
        self.assertEqual((values['StepH0Min'], values['StepH0Max']), (0.05, 0.1))
        values = terrain.load('gaps_humanoid').parameters()
        self.assertEqual((values['GapHMin'], values['GapHMax']), (-0.9, -0.85))
        mixed = terrain.load('slopes_mixed_humanoid').parameters()
        mixed = {key: value for key, value in mixed.items() if not key.startswith('Slope')}
        self.assertEqual(terrain.load('mixed_humanoid').parameters(), mixed)


REFUSED = (  # contents of files
    *((f'{{"Type": "var2d_gaps", {rest}', message) for rest, message in (
        ('', 'not JSON'), ('"Parms": []}', "'Parms'.*'Params'"), ('"Params": {}}', 'Params must be a list'),
        ('"Params": [1]}', r'Params\[0\].*must be an object'), ('"GroundWidth": "wide"}', "GroundWidth.*'wide'"),
        ('"Params": [{}, {"GapWidthMin": 1}]}', r"Params\[1\].*'GapWidthMin'.*'GapWMin'"),
    )),
    *((f'{{"Type": "var2d_gaps", "Params": [{{{values}}}]}}', message) for values, message in (
        ('"gapwmin": 1', "'GapWMin'"), ('"GapWMin": 1, "GapWMin": 1', "'GapWMin' is given twice"),
        ('"WallWMin": 1', r"Params\[0\].*'WallWMin' has no effect in var2d_gaps.*var2d_walls"),
        ('"GapWMin": 2, "GapWMax": 1', r'Params\[0\].*GapWMin 2 is above GapWMax 1'),
        ('"GapWMin": 3', r'GapWMin 3 is above GapWMax 2 \(the default\)'),
        ('"GapHMin": -1, "GapHMax": -2', 'GapHMin -1 is above GapHMax -2'),
        ('"GapWMin": NaN', 'GapWMin is nan.*from 0 to 1000'), ('"GapWMax": 1e999', 'GapWMax is inf'),
        (f'"GapWMax": 1{400 * "0"}', 'GapWMax is 1000.*from 0 to 1000'), ('"GapWMin": true', 'GapWMin.*True'),
        ('"GapWMin": "1"', "GapWMin.*'1'"), ('"GapWMin": -1', 'GapWMin is -1.*from 0'),
        ('"GapSpacingMax": 1e12', 'GapSpacingMax.*1000'),
    )),
    (100_000 * '[', 'not JSON'), (b'\xff\xfe\x00', 'not '), ('[]', 'Type and Params'),
    ('{"Params": []}', "'Type' is missing.*var2d_gaps"), ('{"Type": "var2d_gap"}', "'var2d_gap'.*'var2d_gaps'"),
    ('{"Type": ["x"]}', r"Type is \['x'\]; expected a string"),
    ('{"Type": "var2d_flat", "Params": [{"Height": 1}]}', "'Height'.*has none"),
    ('{"Type": "var2d_narrow_gaps", "Params": [{"NarrowGapCountMax": 1e9}]}', 'NarrowGapCountMax.*100'),
)  # fmt: skip
REFUSED3D = (  # the same, as mappings
    ('hill3d', None, 'hills3d'), ('hills3d', {'Height': 2}, 'has none'), ('var3d_ramp', {'Slop': 2}, "'Slope'"),
    ('var3d_ramp', {'PathLength': 2}, 'no effect in var3d_ramp'), ('obstacles3d', {'ObstacleDensity': 100}, 'from 0 to 2'),
    ('obstacles3d', {'ObstacleWidth0': -1}, 'from 0'), ('conveyor3d', {'ObstacleSpeed0': 0}, 'ObstacleSpeed0'),
    ('trail3d', {'PathMaxTurnDelta': 3}, 'from 0 to 2'), ('trail3d', {'StepHeightMin': 3}, 'above StepHeightMax'),
)  # fmt: skip


class RefusalTest(FolderTest):
    """What is refused, and why."""

    def strip(self, **options):
        return terrain.PlanarGround(terrain.load('slopes_mixed'), 0, **options)

    def test_files(self):
        for i, (text, message) in enumerate(REFUSED):
            path = self.folder / f'{i}.json'
            path.write_bytes(text if isinstance(text, bytes) else text.encode())
            assert_refused(self, (lambda path=path: terrain.load(path), f'(?s){path}.*{message}'))
        assert_refused(
            self,
            *((lambda t=t, v=v: terrain.load({'Type': t, 'Params': [v or {}]}), message)
              for t, v, message in REFUSED3D),
            (lambda: terrain.load({'Type': 'hills3d', 'VertSpacingX': 0.1}), 'VertSpacingX must be 0.2'),
            (lambda: terrain.load('gap_humanoid'), "'gaps_humanoid'"),
            (lambda: terrain.load('pilars3d'), "'pillars3d'"),
        )  # fmt: skip
        missing = functools.partial(terrain.load, 'no_such_terrain.json')
        assert_refused(self, (missing, 'no such file'), error=FileNotFoundError)
        assert_refused(self, (lambda: terrain.load(3), 'int'), error=TypeError)

    def test_grounds(self):
        strip, rng = self.strip(), np.random.default_rng(0)
        hills, movers = (
            terrain.SpatialGround(terrain.load(name), 0)
            for name in ('hills3d', 'dynamic_obstacles3d')
        )

        assert_refused(
            self,
            *((lambda c=c, x=x: c(x), 'within .* m of 0') for x in (math.nan, math.inf, -math.inf, 1.1e6, -1.1e6) for c in (
                lambda x: strip.height([0.0, x]), lambda x: strip.ensure(0, x), lambda x: strip.ensure(x, 0),
                lambda x: self.strip(spawn='upstream', centre=x))),
            (lambda: strip.window(10**9, 10), 'within .* m of 0'), (lambda: strip.window(0, 10**9), 'within .* m of 0'),
            (lambda: strip.window(0, 0), 'count must be positive, not 0'),
            (lambda: self.strip(spawn='upstrem'), "'upstrem'"),
            (lambda: generators.draw('var2d_flt', {}, 1.0, rng), 'var2d_flat'),
            *((lambda x=x: terrain.load('gaps').parameters(x), 'terrain_level is .*; expected a number')
              for x in (math.nan, True, '0', 0.5, -1)),
            (lambda: terrain.load('gaps_curriculum').parameters(1.1), 'from 0 to 1, as .* has 2 parameter sets'),
            (lambda: terrain.PlanarGround(terrain.load('hills3d'), 0), 'hills3d.*three-dimensional'),
            (lambda: terrain.SpatialGround(terrain.load('gaps'), 0), 'gaps.*planar'),
            (lambda: hills.height(0.0, math.nan), 'finite'), (lambda: hills.goal(rng, (0, 0), 'walk'), 'rule'),
            (lambda: terrain.SpatialGround(terrain.load('hills3d'), 0, terrain_level=math.nan), 'terrain_level'),
            (lambda: movers.goal(rng, (0, 0), movers=np.zeros((10**6, 2))), 'half_size has shape'),
        )  # fmt: skip
        self.assertEqual(strip.extent, (-1, -1))  # nothing was drawn
        with self.assertRaises(TypeError):
            terrain.load('gaps').parameter_sets[0]['GapWMin'] = math.nan
        terrain.load('gaps').parameters()['GapWMin'] = math.nan  # a copy
        self.assertEqual(terrain.load('gaps').parameters()['GapWMin'], 0.5)


class RegisterTest(parameterized.TestCase):
    """Terrain types of the user."""

    def setUp(self):
        super().setUp()
        self.enterContext(mock.patch.dict(generators._planar))

    def test_new_type(self):
        @terrain.register('var2d_saw', {'ToothW': 1.0, 'ToothHMin': 0.1, 'ToothHMax': 0.2})
        def saw(parameters, length, rng):
            cells = math.ceil(parameters['ToothW'] / terrain.SPACING)
            teeth = math.ceil(length / terrain.SPACING / cells)
            rises = rng.uniform(parameters['ToothHMin'], parameters['ToothHMax'], teeth)
            heights = np.outer(rises, np.arange(1, cells + 1) / cells).ravel()
            return terrain.Profile(heights, np.diff(heights, prepend=0.0) < 0)

        ground = terrain.load(planar('saw', ToothW=0.5))
        heights = terrain.PlanarGround(ground, 0).height(1 + np.arange(0, 10, 0.5) - 1e-9)
        np.testing.assert_array_less(heights[1:], 0.2 + 1e-9)
        np.testing.assert_array_less(0.1 - 1e-6, heights[1:])
        terrain.register('var2d_gaps', replace=True)(saw)
        self.assertIs(terrain.GENERATORS['var2d_gaps'].function, saw)
        height, low = terrain.Parameter(0.5, 0.0, 2.0), terrain.Parameter(1, low=0)
        terrain.register('mine', {'H': height, 'W': 1, 'L': low})(saw)

        def mine(**values):
            return functools.partial(terrain.load, {'Type': 'mine', 'Params': [values]})

        mine(H=2, W=-1e6)()
        assert_refused(
            self,
            (lambda: terrain.load(planar('saw', ToothV=0.5)), "did you mean 'ToothW'"),
            (lambda: terrain.load(planar('saw', ToothHMin=0.5)), 'ToothHMin 0.5 is above ToothHMax 0.2'),
            (mine(H=3), r'Params\[0\]: H is 3; expected .* from 0 to 2'),
            (mine(L=-1), 'L is -1; expected a number at least 0'),
            (lambda: terrain.register('other', {'H': height._replace(default=3)}), 'H is 3; expected'),
            (lambda: terrain.register('mine', {'HMin': 2, 'HMax': 1}), 'mine.*HMin 2 .*above'),
            (lambda: terrain.register('mine', {'H': math.inf}), "'mine': H is inf; expected a number"),
            (lambda: terrain.register('var2d_saw')(np.abs), 'var2d_saw'),
            (lambda: terrain.register3d('hills3d')(np.abs), 'hills3d'),
        )  # fmt: skip

    def test_invalid_generators_are_rejected(self):
        for made, message in (
            (np.zeros(3), 'must return a Profile'),
            (terrain.Profile(np.zeros(0), np.zeros(0, bool)), 'shape'),
            (terrain.Profile(np.zeros((2, 2)), np.zeros((2, 2), bool)), 'shape'),
            (terrain.Profile(np.array(['a']), np.zeros(1, bool)), 'numbers'),
            (terrain.Profile(np.zeros(3), np.zeros(2, bool)), 'vertical'),
            (terrain.Profile(np.zeros(3), np.zeros(3)), 'vertical'),
            (terrain.Profile(np.array([0, 1, np.nan]), np.zeros(3, bool)), 'vertex 2'),
        ):
            terrain.register('mine', replace=True)(lambda parameters, length, rng, made=made: made)
            strip = terrain.PlanarGround(terrain.load({'Type': 'mine'}), 0)
            assert_refused(self, (lambda g=strip: g.height(5.0), f"'mine'.*{message}"))


class PlanarGroundTest(parameterized.TestCase):
    """The endless ground."""

    def make(self, name='slopes_mixed', seed=0, **options):
        return terrain.PlanarGround(terrain.load(name), seed, **options)

    @parameterized.parameters('gaps', 'slopes_humanoid', 'bumps', 'cliffs_rugged')
    def test_intended_start(self, name):
        for seed in range(10):
            strip = self.make(name, seed)
            np.testing.assert_array_equal(strip.height(np.linspace(-1, 1, 99)), 0)
            # Right of +1 the first spacing or slope begins; left of -1 a feature ends.
            self.assertNotEqual(strip.height(-1.025), 0)
            self.assertEqual(strip.height(1.025) != 0, name in ('slopes_humanoid', 'bumps'))
        first = {'gaps': 4, 'cliffs_rugged': 0.8}.get(name, 0)
        np.testing.assert_array_equal(strip.height(np.linspace(1, 1 + first, 99)), 0)

    def test_window(self):
        strip = self.make('walls')
        heights, vertical = strip.window(-500, 2000)
        self.assertEqual(heights.shape, (2000,))
        self.assertEqual(vertical.shape, (2000,))
        # Faces are the cells in which level ground changes its height.
        np.testing.assert_array_equal(vertical[1:], np.diff(heights) != 0)
        # The flag of the first cell is right even where nothing was drawn before it.
        first = round(strip.extent[0] / 0.025)
        self.assertTrue(self.make('walls').window(first, 1)[1][0])
        heights[:] = vertical[:] = 1  # a copy
        self.assertEqual(strip.height(0.0), 0)

    def test_seeds(self):
        def ground(seed):
            return self.make('slopes', seed).window(-1000, 2000)[0]

        np.testing.assert_array_equal(ground(3), ground(3))
        self.assertFalse(np.array_equal(ground(3), ground(4)))
        sides = self.make('slopes').window(-840, 1681)[0]
        self.assertFalse(np.array_equal(sides, sides[::-1]))
        sequence = np.random.SeedSequence(3)
        np.testing.assert_array_equal(ground(sequence), ground(sequence))
        np.testing.assert_array_equal(ground(sequence), ground(3))
        self.assertEqual(sequence.n_children_spawned, 0)
        a, b = (ground(child) for child in np.random.SeedSequence(3).spawn(2))
        self.assertFalse(np.array_equal(a, b))
        rng = np.random.default_rng(3)
        first, second = ground(rng), ground(rng)
        self.assertFalse(np.array_equal(first, second))
        np.testing.assert_array_equal(first, ground(np.random.default_rng(3)))
        for seed in (None, 1.5, True, -1, 'a'):
            with self.assertRaisesRegex(TypeError, 'seed'):
                ground(seed)

    @parameterized.parameters(
        *itertools.product(('slopes_mixed', 'gaps', 'flat', 'wave'), (0, 3, -1, 9000, -9000))
    )
    def test_a_state_far_away(self, name, x):
        """It holds no ground, and is restored where it was, on the way there, and beyond."""
        if name == 'wave':
            terrain.from_function(np.sin, name, start_span=5, replace=True)
        source = terrain.load({'Type': name} if name == 'wave' else name)
        ground = terrain.PlanarGround(source, 4)
        near = round(x / 0.025)
        places = [near, near + 400, near - 400, near + 4000, near - 4000, 0, near]
        expected = [terrain.PlanarGround(source, 4).window(place, 961) for place in places]
        for at in range(0, x, 5 if x > 0 else -5):
            ground.ensure(at - 6, at + 18)
        ground.window(near, 961)
        low, high = ground.extent
        self.assertLess(high - low, 250)
        state = pickle.dumps(ground.state())
        self.assertLess(len(state), 2500)
        for place, heights in zip(places, expected, strict=True):
            restored = terrain.PlanarGround.from_state(pickle.loads(state))
            copied = pickle.loads(pickle.dumps(ground))
            for each in ground, copied, restored:  # which have forgotten, or were never there
                for a, b in zip(each.window(place, 961), heights, strict=True):
                    np.testing.assert_array_equal(a, b)

    @parameterized.parameters('slopes_mixed', 'cliffs_rugged', 'bumps')
    def test_height_is_linear_interpolation(self, name):
        strip = self.make(name)
        heights, _ = strip.window(-1200, 2401)
        vertices = np.arange(-1200, 1201) * 0.025
        x = np.random.default_rng(0).uniform(-30, 30, (50, 40))
        np.testing.assert_allclose(strip.height(x), np.interp(x, vertices, heights), atol=1e-11)
        np.testing.assert_allclose(strip.height(vertices), heights, atol=1e-11)
        self.assertEqual(strip.height(x).shape, (50, 40))
        self.assertEqual(np.shape(strip.height(0.3)), ())
        self.assertEqual(strip.height([]).shape, (0,))

    def test_upstream_view_10(self):
        # The centre is at 3: a feature ends there, and the next spacing starts there.
        for seed in range(5):
            walls = self.make('walls', seed, spawn='upstream', centre=3.0)
            self.assertGreater(walls.height([2.8, 2.975]).min(), 0.25 - 1e-9)
            np.testing.assert_array_equal(walls.height([2.775, 3.0]), 0)
            np.testing.assert_array_equal(walls.height(np.arange(3, 9, 0.02)), 0)
            steps = self.make('steps', seed, spawn='upstream', centre=3.0)
            self.assertGreater(abs(steps.height(2.975)), 0.1 - 1e-9)
            self.assertEqual(steps.height(3.0), 0)
            # 18 m of flat far to the left, before 20 m of walls that overshoot by up to a feature.
            faces = np.flatnonzero(walls.window(-1800, 1900)[1]) * 0.025 - 45
            i = np.diff(faces).argmax()
            self.assertBetween(np.diff(faces)[i], 18 + 6 - 1e-9, 18 + 8.1)
            self.assertBetween(faces[i + 1], -25.3 + 6, -17 + 8.1)

    @parameterized.parameters(0.0, -0.25, -0.5, 0.25, 0.9, 1.4)
    def test_upstream_view_3(self, centre):
        """A feature ends at the centre; if that is behind, flat to +1; then the first spacing."""
        for seed in range(5):
            strip = self.make('walls_humanoid', seed, spawn='upstream', centre=centre)
            self.assertGreater(strip.height(centre - 0.1), 0)
            begin = 1 if centre <= 0 else centre
            level = strip.height(np.linspace(centre, begin + 1.9, 99))
            np.testing.assert_allclose(level, 0, atol=1e-12)
            heights = strip.height(np.arange(begin, begin + 5, 0.01))
            self.assertBetween(np.argmax(heights > 0.01) * 0.01, 2 - 1e-9, 4.05)
