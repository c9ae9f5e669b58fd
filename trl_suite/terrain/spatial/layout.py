"""Parts of three-dimensional ground: a level, a height grid, boxes, belts, moving boxes, a trail.

World axes: x forward, y to the left, z up; lengths in m. The surface at a point is the highest part
there. A generator returns a `Layout`, in which unbounded parts are functions.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Mapping
from numbers import Real
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from trl_suite.util.compiled import compiled

if TYPE_CHECKING:
    from trl_suite.terrain.spatial.trail import Trail

GRID = 0.2  # m between the vertices of a height grid; vertex i is at i * GRID
TURN_DISTANCE = 5.0  # m; moving boxes reverse only at a larger distance from the character
PLACES = ('start', 'clear', 'trail')
_PAIRS = ('position', 'half_size', 'velocity', 'start', 'end')  # arrays (k, 2); all others are (k,)


class Boxes(NamedTuple):
    """k static boxes, upright unless they have a slope; then their ends are normal to the slope."""

    position: np.ndarray  # (k, 2) centre
    half_size: np.ndarray  # (k, 2) along the box's own axes
    yaw: np.ndarray  # (k,) angle from the world's x axis to the box's, rad
    top: np.ndarray  # (k,) height of the upper face at the centre
    slope: np.ndarray  # (k,) rise of the upper face per m along the box's x axis

    def select(self, chosen: np.ndarray) -> Boxes:
        """Returns the boxes of a mask or of indices."""
        return Boxes(*(part[chosen] for part in self))

    def extent(self) -> np.ndarray:
        """Half sides of the axis-aligned bounding rectangles of the boxes, (k, 2)."""
        cosine, sine = np.abs(np.cos(self.yaw)), np.abs(np.sin(self.yaw))
        length, width = self.half_size.T
        return np.stack([cosine * length + sine * width, sine * length + cosine * width], 1)

    def touching(self, low: npt.ArrayLike, high: npt.ArrayLike) -> np.ndarray:
        """Which boxes touch a rectangle, (k,) bool; rotated ones by their bounding rectangle.

        Raises:
          ValueError: arrays of different lengths.
        """
        found = np.empty(len(self.top), bool)
        position, half_size, yaw = (np.ascontiguousarray(part, float) for part in self[:3])
        if not position.shape == half_size.shape == (*found.shape, 2) or yaw.shape != found.shape:
            raise ValueError(_misfit('boxes', self._asdict()))
        _touching(
            position, half_size, yaw, *np.broadcast_to(low, 2), *np.broadcast_to(high, 2), found
        )
        return found

    def heights(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Height of every box's upper face at points (m,), (m, k); -inf outside the box."""
        dx, dy = x[:, None] - self.position[:, 0], y[:, None] - self.position[:, 1]
        cosine, sine = np.cos(self.yaw), np.sin(self.yaw)
        along, across = cosine * dx + sine * dy, cosine * dy - sine * dx
        inside = (np.abs(along) <= self.half_size[:, 0]) & (np.abs(across) <= self.half_size[:, 1])
        return np.where(inside, self.top + self.slope * along, -np.inf)


def boxes(
    position: npt.ArrayLike,
    half_size: npt.ArrayLike,
    top: npt.ArrayLike,
    yaw: npt.ArrayLike = 0.0,
    slope: npt.ArrayLike = 0.0,
) -> Boxes:
    """Returns boxes; a value that all boxes share may be given once.

    Args:
      position: centres, m, (k, 2).
      half_size: m, (k, 2) or (2,).
      top: height of the upper faces at their centres, m.
      yaw: angle from the world's x axis to the box's, rad.
      slope: rise of the upper face per m along the box's x axis.
    """
    position = np.asarray(position, float).reshape(-1, 2)
    half_sizes, (yaws, tops, slopes) = np.empty_like(position), np.empty((3, len(position)))
    half_sizes[...], yaws[:], tops[:], slopes[:] = half_size, yaw, top, slope
    return Boxes(position, half_sizes, yaws, tops, slopes)


@compiled
def _touching(
    position: np.ndarray,
    half_size: np.ndarray,
    yaw: np.ndarray,
    low_x: float,
    low_y: float,
    high_x: float,
    high_y: float,
    found: np.ndarray,
) -> None:
    """Finds the boxes that touch a rectangle."""
    for k in range(len(yaw)):
        x, y = position[k, 0], position[k, 1]
        cosine, sine = abs(math.cos(yaw[k])), abs(math.sin(yaw[k]))
        length, width = half_size[k, 0], half_size[k, 1]
        along, across = cosine * length + sine * width, sine * length + cosine * width
        reaches = x + along >= low_x and y + across >= low_y
        found[k] = reaches and x - along <= high_x and y - across <= high_y


NO_BOXES = boxes(np.zeros((0, 2)), (0, 0), 0)


class Belts(NamedTuple):
    """k conveyor belts: boxes whose surface moves."""

    boxes: Boxes
    velocity: np.ndarray  # (k, 2) m/s along the world's axes


class Movers(NamedTuple):
    """k upright boxes on the level, each of which moves back and forth between two points."""

    start: np.ndarray  # (k, 2)
    end: np.ndarray  # (k, 2)
    half_size: np.ndarray  # (k, 2)
    height: np.ndarray  # (k,)
    speed: np.ndarray  # (k,) m/s
    phase: np.ndarray  # (k,) initial position, as a fraction of the path from start to end
    direction: np.ndarray  # (k,) 1 towards the end, -1 towards the start

    @property
    def length(self) -> np.ndarray:
        """Lengths of the paths, (k,)."""
        return np.linalg.norm(self.end - self.start, axis=1)

    @property
    def axis(self) -> np.ndarray:
        """Unit vectors from start to end, (k, 2)."""
        way = self.end - self.start
        way[self.length < 1e-9] = 1, 0
        return way / np.linalg.norm(way, axis=1)[:, None]


def _misfit(name: str, arrays: Mapping[str, Any]) -> str:
    """Returns which of the arrays of k boxes is not of k finite numbers or pairs; empty if none.

    Compiled functions read these arrays, and do not check indices.
    """
    count = None
    for field, array in arrays.items():
        if not isinstance(array, np.ndarray) or array.dtype.kind not in 'fiu':
            kind = array.dtype if isinstance(array, np.ndarray) else type(array).__name__
            return f'{name}.{field} is of type {kind}; expected an array of numbers'
        if count is None:
            count = len(array) if array.ndim else 0
        shape = (count, 2) if field in _PAIRS else (count,)
        if array.shape != shape:
            return (
                f'{name}.{field} has shape {array.shape}; expected {shape}, one entry for each box'
            )
        if not np.isfinite(array).all():
            return f'{name}.{field} is not finite'
    return ''


GridFunction = Callable[[np.ndarray, np.ndarray], np.ndarray]
BoxFunction = Callable[[np.ndarray, np.ndarray], Boxes]


@dataclasses.dataclass(frozen=True, eq=False)
class Layout:
    """The ground of one episode.

    Attributes:
      level: height of a plane under all other parts, m; None for none.
      grid: a function from indices of vertices, (k,) along x and (m,) along y, to
        their heights, (k, m); linear on two triangles per cell, whose common edge runs from the
        back left to the front right corner. None for none.
      boxes: `Boxes`, or a function from two corners of a rectangle, (2,) each, to the boxes that
        touch it. A box must not depend on the query. The function may have a method `touched` with
        the same arguments, a faster test whether there are any.
      belts: conveyor belts.
      movers: moving boxes; they stand on the level.
      trail: the path of start places and goals, if place is 'trail'; other objects need the
        attributes of a `Trail` but its height, and the methods `extend` and `leave`.
      place: where characters start and where goals are: 'start' (at the origin; goals near the
        character), 'clear' (anywhere that is clear of boxes and belts), or 'trail'.
      span: for 'clear', half side of the square of start places and goals, m.
      goal_room: for 'clear', half side of the square around a goal that must be clear, m.
      generator: terrain type, for messages; set when a ground is drawn.
    """

    level: float | None = 0.0
    grid: GridFunction | None = None
    boxes: Boxes | BoxFunction = NO_BOXES
    belts: Belts | None = None
    movers: Movers | None = None
    trail: Trail | None = None
    place: str = 'start'
    span: float = 12.0
    goal_room: float = 1.0
    generator: str = ''

    def boxes_in(self, low: np.ndarray, high: np.ndarray) -> Boxes:
        """The boxes that touch a rectangle.

        Raises:
          ValueError: a user's function returns anything else.
        """
        if isinstance(self.boxes, Boxes):
            return self.boxes.select(self.boxes.touching(low, high))
        found = self.boxes(low, high)
        fault = f'it returned {type(found).__name__}'
        if not isinstance(found, Boxes) or (fault := _misfit('boxes', found._asdict())):
            raise ValueError(f'{self._owner("boxes")} must return finite Boxes: {fault}')
        return found

    def _owner(self, part: str) -> str:
        return (
            f'generator of terrain type {self.generator!r}: the function for {part} of its Layout'
        )

    def is_clear(self, low: tuple[float, float], high: tuple[float, float]) -> bool:
        """Whether no box touches a rectangle."""
        touched = getattr(self.boxes, 'touched', None)
        if touched is not None:
            return not touched(low, high)
        return not self.boxes_in(np.array(low), np.array(high)).touching(low, high).any()

    def vertices(self, i: np.ndarray, j: np.ndarray) -> np.ndarray:
        """Heights of the grid at vertices (i, j) * GRID, (len(i), len(j)).

        Raises:
          ValueError: a user's function returns anything else.
        """
        assert self.grid is not None
        heights = np.asarray(self.grid(i, j))
        if heights.shape != (len(i), len(j)) or heights.dtype.kind not in 'fiu':
            raise ValueError(
                f'{self._owner("a grid")} must return heights of shape {(len(i), len(j))}; it returned '
                f'an array of {heights.dtype} of shape {heights.shape}'
            )
        if not np.isfinite(heights).all():
            a, b = np.argwhere(~np.isfinite(heights))[0]
            raise ValueError(
                f'{self._owner("a grid")} returned {heights[a, b]} at x = {GRID * i[a]:g} m, '
                f'y = {GRID * j[b]:g} m; expected finite heights'
            )
        return heights

    def fault(self) -> str:
        """Returns why the layout is invalid, for the author of a generator; empty if it is valid."""
        for name, kind, expected in _PARTS:
            part = getattr(self, name)
            if not isinstance(part, kind):
                return f'{name} is of type {type(part).__name__}; expected {expected}'
            if isinstance(part, Real) and not math.isfinite(part):
                return f'{name} is not finite'
        if self.place not in PLACES:
            return f'place must be one of {", ".join(PLACES)}, not {self.place!r}'
        if self.place == 'trail' and self.trail is None:
            return "place is 'trail', but there is no trail"
        if self.level is None and self.grid is None and self.boxes is NO_BOXES:
            return 'there must be a level, a grid or boxes'
        if self.movers is not None and self.level is None:
            return 'moving boxes need a level to stand on'
        arrays = {} if self.movers is None else {'movers': self.movers._asdict()}
        if isinstance(self.boxes, Boxes):
            arrays['boxes'] = self.boxes._asdict()
        if self.belts is not None:
            arrays['belts'] = {**self.belts.boxes._asdict(), 'velocity': self.belts.velocity}
        return next(filter(None, itertools.starmap(_misfit, arrays.items())), '')


# Fields of a layout: type, and the type in words.
_PARTS: tuple[tuple[str, Any, str], ...] = (
    ('level', Real | None, 'a number or None'),
    ('grid', Callable | None, 'a function or None'),
    ('boxes', Boxes | Callable, 'Boxes or a function'),
    ('belts', Belts | None, 'Belts or None'),
    ('movers', Movers | None, 'Movers or None'),
    ('span', Real, 'a number'),
    ('goal_room', Real, 'a number'),
)
