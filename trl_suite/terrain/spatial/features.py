"""The three-dimensional terrain types: paths, stairs, hills, obstacles, moving boxes and belts.

The random processes are those of the original (Terrain RL Simulator, 2018), equal in distribution.

Intentional deviations from the original: vertical faces where it has flanks of one grid cell
(paths, stairs, blocks and pillars; dense low boxes, checkers and trails keep the flanks); where
blocks overlap, the higher one applies, not the later one; stairs have no seam 1 m to the side of
the start; belts do not drift by slices; the ground does not depend on the character's path.
"""

from __future__ import annotations

import functools
import math

import numpy as np

from trl_suite.terrain.generators import Parameter, Parameters, limited, register3d
from trl_suite.terrain.spatial import noise
from trl_suite.terrain.spatial.layout import GRID, Belts, Boxes, GridFunction, Layout, Movers, boxes
from trl_suite.terrain.spatial.trail import AMPLITUDE, FREQUENCY, Trail
from trl_suite.util.compiled import compiled

TILE = 80.0  # m; side of the squares in which obstacles are drawn; one is centred on the origin
TILES = 64  # squares held in memory
CLEAR = 2.0  # m; half side of the square about the origin that obstacles leave clear
DENSE = 0.25  # 1/m^2; denser obstacles form a height grid, in which later ones overwrite earlier
FAR = 1e3  # m; where unbounded boxes end
LANDING = 1.0  # m; half length of the level start of ramps and stairs
TREAD = 0.5  # m
RISE = 0.05  # m per tread, on average
FIRST_TREAD = 0.13154  # share of the range of heights at which the landing of stairs lies
CLIFF_PERIOD, CLIFF_SWAY, CLIFF_HALF_WIDTH = 12.0, 5.0, 2.5  # m
CLIFF_HEIGHT, CLIFF_SLOPE, CLIFF_ROUGHNESS = 2.0, 0.5, 0.2  # m, share of the height per m, m
MOVER_SPAN = 20.0  # m; half side of the square that contains the paths of moving boxes
PLACE_SPAN = {'obstacles3d': 24.0, 'moving': 12.0}  # m; half sides of the squares of start places
BELT_TOP = 0.01  # m above the plane

_lengths = functools.partial(limited, 0.0, 1e3)
_counts = functools.partial(limited, 0.0, 100.0, '1, number')
_heights = functools.partial(limited, -20.0, 20.0)
# Parameters; the defaults are those of the original.
PATH = {
    **_lengths(PathWidth0=3),
    **_heights(PathHeight0=0, PathHeight1=-2),
    'PathLength': Parameter(10, 0.2, 1e3),
    **_lengths(PathTurnLength=5),
}
TRAIL = {
    **_lengths(PathWidth0=3, PathWidth1=3, PathWidthDeltaStdev=0.1),
    'PathMaxTurnDelta': Parameter(1.5, 0.0, 2.0, 'rad'),
    **_heights(PathHeight0=0, PathHeight1=-2, StepHeightMin=0.1, StepHeightMax=0.2),
    'TrailStepProb': Parameter(0.2, 0.0, 1.0, '1, probability'),
    'PathLength': PATH['PathLength'],
    **_lengths(PathTurnLength=5),
}
STAIRS = {
    **_heights(StepHeightMin=0.1, StepHeightMax=0.2),
    **_lengths(StepSpacingMin=1, StepSpacingMax=2),
}
_WIDTHS = limited(0.0, 40.0, ObstacleWidth0=0.5, ObstacleWidth1=7)
_HEIGHTS = limited(0.0, 1e3, ObstacleHeight0=1, ObstacleHeight1=5)
OBSTACLES = {'ObstacleDensity': Parameter(0.015, 0.0, 2.0, '1/m²'), **_WIDTHS, **_HEIGHTS}
MOVING = {
    **_WIDTHS,
    **limited(1e-6, 100.0, 'm/s', ObstacleSpeed0=0.1, ObstacleSpeed1=2),
    'ObstacleSpeedLerpPow': Parameter(1, 0.0, 100.0, '1, exponent'),
}
MOVERS = {**_counts(NumObstacles=10), **_HEIGHTS, **MOVING}
CONVEYORS = {
    **_lengths(ConveyorStripLength=10),
    **_counts(ConveyorNumStrips=4),
    **_lengths(ConveyorSpacing=3),
    **MOVING,
    **_counts(ConveyorNumSlices=10),
}
# Parameters without effect, by type; in the original only those of belts have an effect.
IDLE = {
    'trail3d': ('PathLength', 'PathTurnLength'),
    'var3d_stairs': ('StepSpacingMin', 'StepSpacingMax'),
    'conveyor3d': ('ConveyorNumSlices',),
}

Corner = np.ndarray | tuple[float, float]
Rectangles = tuple[np.ndarray, np.ndarray, np.ndarray]  # low and high corners, heights


def _between(parameters: Parameters, name: str, shares: np.ndarray) -> np.ndarray:
    """Values at fractions of the range from {name}0 to {name}1, which may be descending."""
    first, second = parameters[name + '0'], parameters[name + '1']
    return first + (second - first) * shares


def _speeds(parameters: Parameters, shares: np.ndarray) -> np.ndarray:
    """Speeds whose logarithm is uniform, except for the power, which favours slow ones."""
    a = shares ** parameters['ObstacleSpeedLerpPow']
    slow, fast = (math.log(parameters[f'ObstacleSpeed{i}']) for i in (0, 1))
    return np.exp((1 - a) * slow + a * fast)


def hashed(*numbers: np.ndarray | int) -> np.ndarray:
    """Uniform numbers in [0, 1), hashed from integers (of at most 63 bits)."""
    mixed = np.zeros(np.broadcast_shapes(*(np.shape(number) for number in numbers)), np.uint64)
    for number in numbers:
        mixed = (
            mixed + np.asarray(number, np.int64).astype(np.uint64) + np.uint64(0x9E3779B97F4A7C15)
        )
        mixed = (mixed ^ (mixed >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        mixed = (mixed ^ (mixed >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        mixed = mixed ^ (mixed >> np.uint64(31))
    return (mixed >> np.uint64(11)).astype(float) / 2**53


@register3d('plane')
@register3d('var3d_flat')
def flat(parameters: Parameters, rng: np.random.Generator) -> Layout:
    """An endless plane."""
    return Layout()


@register3d('var3d_ramp', limited(-10.0, 10.0, '1, rise per m', Slope=0))
def ramp(parameters: Parameters, rng: np.random.Generator) -> Layout:
    """Level around the start, rising ahead of it and falling behind."""
    slope = parameters['Slope']
    middle = LANDING + 0.5 * FAR
    return Layout(
        level=None,
        boxes=boxes(
            [(0, 0), (middle, 0), (-middle, 0)],
            [(LANDING, FAR), (0.5 * FAR, FAR), (0.5 * FAR, FAR)],
            top=np.array([0, 0.5, -0.5]) * slope * FAR,
            slope=np.array([0, 1, 1]) * slope,
        ),
    )


@register3d('var3d_stairs', STAIRS)
def stairs(parameters: Parameters, rng: np.random.Generator) -> Layout:
    """Treads of 0.5 m that rise by 0.05 m on average, each at a height of its own."""
    low, high = parameters['StepHeightMin'], parameters['StepHeightMax']
    key = int(rng.integers(2**62))

    def number(x: float) -> int:
        return math.floor(math.copysign(max(0.0, abs(x) - LANDING), x) / TREAD)

    def treads(low_corner: np.ndarray, high_corner: np.ndarray) -> Boxes:
        k = np.arange(number(low_corner[0]), number(high_corner[0]) + 1)
        begin = TREAD * k + np.where(k > 0, LANDING, -LANDING)
        end = TREAD * (k + 1) + np.where(k >= 0, LANDING, -LANDING)
        share = np.where(k == 0, FIRST_TREAD, hashed(key, k))
        return boxes(
            np.stack([0.5 * (begin + end), np.zeros(len(k))], 1),
            np.stack([0.5 * (end - begin), np.full(len(k), FAR)], 1),
            top=RISE * k + low + (high - low) * share,
        )

    return Layout(level=None, boxes=treads)


@register3d('var3d_checkers', limited(-10.0, 10.0, Slope=0))
def checkers(parameters: Parameters, rng: np.random.Generator) -> Layout:
    """Squares of 1 m, alternate ones raised by `Slope` m, with flanks of one cell."""
    squares = round(1 / GRID)

    def grid(i: np.ndarray, j: np.ndarray) -> np.ndarray:
        parity = (np.abs(i) // squares)[:, None] + np.abs(j) // squares
        return parameters['Slope'] * (parity % 2)

    return Layout(level=None, grid=grid)


@register3d('var3d_path', PATH)
def path(parameters: Parameters, rng: np.random.Generator) -> Layout:
    """A serpentine: legs along x, alternately on the line of the start and to the right of it."""
    length, shift = max(parameters['PathLength'], GRID), parameters['PathTurnLength']
    half = min(0.5 * parameters['PathWidth0'], 0.5 * length)
    height = parameters['PathHeight0']
    if height < parameters['PathHeight1']:
        raise ValueError(
            f'PathHeight0 is {height:g}; expected at least PathHeight1, {parameters["PathHeight1"]:g} m: '
            'the path is on the ground'
        )

    def legs(low: np.ndarray, high: np.ndarray) -> Boxes:
        k = np.arange(
            math.floor((low[0] - half) / length), math.ceil((high[0] + half) / length) + 1
        )
        leg = np.stack([(k + 0.5) * length, np.where(k % 2, -shift, 0)], 1)
        crossing = np.stack([k * length, np.full(len(k), -0.5 * shift)], 1)
        sizes = [(0.5 * length - half, 0.5 * parameters['PathWidth0'])] * len(k)
        sizes += [(half, 0.5 * (shift + parameters['PathWidth0']))] * len(k)
        found = boxes(np.concatenate([leg, crossing]), sizes, height)
        return found.select(found.touching(low, high) & (found.half_size > 1e-9).all(1))

    return Layout(level=parameters['PathHeight1'], boxes=legs)


@register3d('var3d_cliff')
def cliff(parameters: Parameters, rng: np.random.Generator) -> Layout:
    """A winding ledge: a rock wall to the left, a drop to the right. The same in every episode."""

    def grid(i: np.ndarray, j: np.ndarray) -> np.ndarray:
        sway = CLIFF_SWAY * (np.cos(2 * np.pi / CLIFF_PERIOD * GRID * i) - 1)
        side = (-GRID * j) - sway[:, None]  # distance to the right of the ledge's middle
        share = np.clip(CLIFF_SLOPE * (np.abs(side) - CLIFF_HALF_WIDTH), 0, 1)
        heights = -CLIFF_HEIGHT * np.copysign(share, side)
        rough = np.flatnonzero((share > 0) & (share < 1))
        a, b = np.unravel_index(rough, share.shape)
        heights.ravel()[rough] += CLIFF_ROUGHNESS * (2 * hashed(i[a], j[b]) - 1)
        return heights

    return Layout(level=None, grid=grid)


@register3d('hills3d')
def hills(parameters: Parameters, rng: np.random.Generator) -> Layout:
    """Broad hills with fine texture: six octaves of gradient noise, from 60 m down to 2 m."""
    offset = rng.random(2)

    def grid(i: np.ndarray, j: np.ndarray) -> np.ndarray:
        return noise.grid(GRID * i, -GRID * j, offset, frequency=0.001, amplitude=2)

    return Layout(level=None, grid=grid)


@register3d('trail3d', TRAIL)
def trail(parameters: Parameters, rng: np.random.Generator) -> Layout:
    """A level winding path through rough ground, in places a causeway, in places a canyon."""
    way = Trail(dict(parameters), rng)

    def grid(i: np.ndarray, j: np.ndarray) -> np.ndarray:
        heights = noise.grid(GRID * i, -GRID * j, way.offset, FREQUENCY, AMPLITUDE)
        heights += np.float32(parameters['PathHeight1'])
        way.paint(heights, i, j)
        return heights

    return Layout(level=None, grid=grid, trail=way, place='trail')


class _Obstacles:
    """Axis-aligned rectangles, generated in squares of TILE m when they are queried."""

    def __init__(self, parameters: Parameters, rng: np.random.Generator) -> None:
        self._parameters = parameters
        self._key = rng.integers(2**32, size=4).tolist()
        self._tiles: dict[tuple[int, int], Rectangles] = {}
        self._largest = max(parameters['ObstacleWidth0'], parameters['ObstacleWidth1'])

    def __call__(self, low: np.ndarray, high: np.ndarray) -> Boxes:
        """The obstacles that touch a rectangle, as boxes."""
        begin, end, height = self.touching(low, high)
        return boxes(0.5 * (begin + end), 0.5 * (end - begin), height)

    def touched(self, low: Corner, high: Corner) -> bool:
        """Whether any obstacle touches a rectangle."""
        for begin, end, _ in self._tiles_near(low, high):
            if _meeting(begin, end, *low, *high, None):
                return True
        return False

    def touching(self, low: Corner, high: Corner) -> Rectangles:
        """Low and high corners and heights of obstacles that touch a rectangle, in drawn order."""
        found = []
        for parts in self._tiles_near(low, high):
            near = _select(*parts[:2], low, high)
            found.append(tuple(part[near] for part in parts))
        if len(found) == 1:
            return found[0]
        begin, end, height = (np.concatenate(parts) for parts in zip(*found, strict=True))
        return begin, end, height

    def _tiles_near(self, low: Corner, high: Corner) -> list[Rectangles]:
        """The squares whose obstacles may touch a rectangle."""
        # Obstacles extend beyond their square in the directions of +x and +y only.
        begin = [math.floor((float(edge) - self._largest) / TILE + 0.5) for edge in low]
        end = [math.floor(float(edge) / TILE + 0.5) + 1 for edge in high]
        return [
            self._tile((i, j)) for i in range(begin[0], end[0]) for j in range(begin[1], end[1])
        ]

    def _tile(self, tile: tuple[int, int]) -> Rectangles:
        if tile not in self._tiles:
            if len(self._tiles) == TILES:
                del self._tiles[next(iter(self._tiles))]
            parameters = self._parameters
            # Indices of squares as natural numbers: 0, 1, -1, 2, ... -> 0, 2, 1, 4, ...
            naturals = [2 * k if k >= 0 else -2 * k - 1 for k in tile]
            rng = np.random.default_rng(np.random.SeedSequence([*self._key, *naturals]))
            count = int(parameters['ObstacleDensity'] * TILE**2 + 1e-6)
            height = _between(parameters, 'ObstacleHeight', rng.random(count))
            begin, end = np.empty((2, count, 2))
            missing: slice | np.ndarray = slice(None)
            for _ in range(100):  # the rest, which overlaps the start, gets height 0
                shares = rng.random((2, *begin[missing].shape))
                corner = TILE * (np.array(tile) - 0.5 + shares[0])
                begin[missing] = corner
                end[missing] = corner + _between(parameters, 'ObstacleWidth', shares[1])
                missing = _select(begin, end, (-CLEAR, -CLEAR), (CLEAR, CLEAR))
                if not len(missing):
                    break
            height[missing] = 0.0
            self._tiles[tile] = begin, end, height
        return self._tiles[tile]


@register3d('obstacles3d', OBSTACLES)
def obstacles(parameters: Parameters, rng: np.random.Generator) -> Layout:
    """Level ground with axis-aligned boxes: city blocks, a forest of pillars, or rubble."""
    drawn = _Obstacles(parameters, rng)
    if parameters['ObstacleDensity'] > DENSE:
        return Layout(level=None, grid=_rubble(drawn))

    return Layout(boxes=drawn, place='clear', span=PLACE_SPAN['obstacles3d'])


def _select(begin: np.ndarray, end: np.ndarray, low: Corner, high: Corner) -> np.ndarray:
    """Indices of the axis-aligned rectangles that intersect a given one."""
    numbers = np.empty(len(begin), int)
    return numbers[: _meeting(begin, end, *low, *high, numbers)]


@compiled
def _meeting(
    begin: np.ndarray,
    end: np.ndarray,
    low_x: float,
    low_y: float,
    high_x: float,
    high_y: float,
    numbers: np.ndarray | None,
) -> int:
    """Finds the axis-aligned rectangles, from `begin` to `end` (k, 2), that intersect a given one.

    Returns:
      Their number; their indices are written. Without room for indices, 1 if there is any, else 0.
    """
    count = 0
    for k in range(len(begin)):
        begins = begin[k, 0] <= high_x and begin[k, 1] <= high_y
        if begins and end[k, 0] >= low_x and end[k, 1] >= low_y:
            if numbers is None:
                return 1
            numbers[count] = k
            count += 1
    return count


def _rubble(drawn: _Obstacles) -> GridFunction:
    def grid(i: np.ndarray, j: np.ndarray) -> np.ndarray:
        corner = np.array([i[0], j[0]])
        low, high = GRID * corner, GRID * np.array([i[-1], j[-1]])
        # Vertices in the closed rectangles; at least one vertex along each axis, which may lie beyond.
        begin, end, height = drawn.touching(low - GRID, high)
        heights = np.zeros((len(i), len(j)), np.float32)
        first = np.ceil(begin / GRID).astype(int)
        last = np.maximum(np.floor(end / GRID).astype(int), first)
        first, last = np.maximum(first - corner, 0), np.maximum(last - corner + 1, 0)
        tops = height[:, None].astype(np.float32)  # scalars would be converted one by one
        for a, c, b, d, top in zip(*first.T.tolist(), *last.T.tolist(), tops, strict=True):
            heights[a:b, c:d] = top
        return heights

    return grid


@register3d('dynamic_obstacles3d', MOVERS)
def dynamic_obstacles(parameters: Parameters, rng: np.random.Generator) -> Layout:
    """A plane on which boxes move back and forth."""
    count = int(parameters['NumObstacles'])
    # Box by box, in the order of the original's draws.
    length, height, width, x0, y0, x1, y1, speed, phase, coin = rng.random((count, 10)).T
    ways = MOVER_SPAN * (2 * np.array([x0, y0, x1, y1]) - 1)
    sizes = _between(parameters, 'ObstacleWidth', np.stack([length, width], 1))
    return Layout(
        movers=Movers(
            ways[:2].T.copy(),
            ways[2:].T.copy(),
            0.5 * sizes,
            _between(parameters, 'ObstacleHeight', height),
            _speeds(parameters, speed),
            phase,
            np.where(coin < 0.5, 1.0, -1.0),
        ),
        place='clear',
        span=PLACE_SPAN['moving'],
        goal_room=0.25,
    )


@register3d('conveyor3d', CONVEYORS)
def conveyors(parameters: Parameters, rng: np.random.Generator) -> Layout:
    """A plane with conveyor belts in sequence along x, which run to the left or to the right."""
    count = int(parameters['ConveyorNumStrips'])
    width, speed, coin = rng.random((count, 3)).T
    width = _between(parameters, 'ObstacleWidth', width)
    begin = parameters['ConveyorSpacing'] + np.cumsum(width + parameters['ConveyorSpacing'])
    begin -= width + parameters['ConveyorSpacing']
    velocity = np.zeros((count, 2))
    velocity[:, 1] = np.where(coin < 0.5, 1, -1) * _speeds(parameters, speed)
    half_length = 0.5 * parameters['ConveyorStripLength']
    strips = boxes(
        np.stack([begin + 0.5 * width, np.zeros(count)], 1),
        np.stack([0.5 * width, np.full(count, half_length)], 1),
        BELT_TOP,
    )
    return Layout(
        belts=Belts(strips, velocity), place='clear', span=PLACE_SPAN['moving'], goal_room=0.25
    )
