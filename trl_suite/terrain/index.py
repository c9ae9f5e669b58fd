"""Boxes of n windows, sorted so that a point finds those it may lie on."""

from __future__ import annotations

import numpy as np

from trl_suite.terrain.layout import Belts, Boxes

HALF = 16.0  # m; half side of a window
SQUARES = np.array([32, 32])  # bins of a window along x and y
STRIPS = np.array([256, 1])  # where all boxes reach from the right rim to the left one


class BoxIndex:
    """Boxes and belts of n windows of 32 m x 32 m, in bins that know which of them touch them."""

    def __init__(self, n: int, boxes: int, belts: int, strips: bool = False) -> None:
        """Makes room.

        Args:
          n: number of windows.
          boxes, belts: the most of each in a window.
          strips: whether all of them are expected to reach from the right rim to the left one, as
            stairs do. Others are found, too, more slowly.
        """
        self._bins = STRIPS if strips else SQUARES
        self._number = int(self._bins.prod())
        self._per_metre = self._bins / (2 * HALF)
        self._boxes, self._count = boxes, boxes + belts
        # One box more in every window, that nothing is in.
        stride = self._count + 1
        self._row = np.arange(n)[:, None]
        self._x, self._y, self._sine, self._top, self._slope = np.zeros((5, n, stride))
        self._cosine = np.ones((n, stride))
        self._half_x, self._half_y = np.full((2, n, stride), -1.0)
        self._velocity = np.zeros((2, n, stride))
        # Whether any box ever was turned, sloped, or ended inside a window along y.
        self._turned = self._sloped = self._ended = False
        # For every bin, numbers of the boxes that touch it, among those of all windows.
        self._nothing = self._count + stride * self._row
        self._slots = np.zeros((1, n, self._number), int) + self._nothing
        self._touched = np.zeros((n, self._number), np.int16)

    def fill(self, row: int, low: np.ndarray, boxes: Boxes, belts: Belts | None) -> None:
        """Replaces what is in a window.

        Args:
          row: which window.
          low: its low corner, m, (2,).
          boxes: those that touch it, no more than there is room for.
          belts: all of them.
        """
        self._half_x[row] = -1.0
        self._put(row, 0, boxes, 0.0)
        numbers = np.arange(len(boxes.top))
        if belts is not None:
            self._put(row, self._boxes, *belts)
            numbers = np.append(numbers, np.arange(len(belts.velocity)) + self._boxes)
            boxes = Boxes(*map(np.concatenate, zip(boxes, belts.boxes, strict=True)))
        middle, extent = boxes.position - low, boxes.extent()
        self._ended |= bool((np.abs(middle[:, 1] - HALF) + HALF > extent[:, 1]).any())
        first, last = (self._bin(middle + extent * sign) for sign in (-1, 1))
        width, across = (last - first + 1).T
        box = np.repeat(np.arange(len(width)), width * across)
        k = np.arange(len(box)) - np.repeat(_before(width * across), width * across)
        across = across[box]
        bins = (first[box, 0] + k // across) * self._bins[1] + first[box, 1] + k % across
        order = np.argsort(bins, kind='stable')
        bins, box = bins[order], box[order]
        touched = np.bincount(bins, minlength=self._number)
        slot = np.arange(len(bins)) - _before(touched)[bins]
        missing = int(touched.max(initial=0)) - len(self._slots)
        if missing > 0:
            more = np.zeros((missing, *self._slots.shape[1:]), int) + self._nothing
            self._slots = np.concatenate([self._slots, more])
        self._slots[:, row] = self._nothing[row]
        self._slots[slot, row, bins] = numbers[box] + (self._count + 1) * row
        self._touched[row] = touched

    def _bin(self, points: np.ndarray) -> np.ndarray:
        """Numbers along x and y, (k, 2), of the bins of points (k, 2) that a window begins at 0."""
        bins = np.floor(points * self._per_metre).astype(int)
        return np.minimum(np.maximum(bins, 0), self._bins - 1)

    def _put(self, row: int, first: int, boxes: Boxes, velocity: np.ndarray | float) -> None:
        part = slice(first, first + len(boxes.top))
        self._x[row, part], self._y[row, part] = boxes.position.T
        self._half_x[row, part], self._half_y[row, part] = boxes.half_size.T
        self._cosine[row, part], self._sine[row, part] = np.cos(boxes.yaw), np.sin(boxes.yaw)
        self._top[row, part], self._slope[row, part] = boxes.top, boxes.slope
        self._velocity[:, row, part] = np.broadcast_to(velocity, (len(boxes.top), 2)).T
        self._turned |= bool(boxes.yaw.any())
        self._sloped |= bool(boxes.slope.any())

    def cover(
        self,
        x: np.ndarray,
        y: np.ndarray,
        low: np.ndarray,
        numbers: np.ndarray,
        heights: np.ndarray,
        velocity: np.ndarray | None,
    ) -> None:
        """Raises heights to the boxes and belts that lie higher.

        Args:
          x, y: points, m, (rows, k).
          low: low corners of the rows' windows, m, (rows, 2).
          numbers: of the windows, (rows, 1).
          heights: changed in place, m, (rows, k).
          velocity: is given the velocities of what heights are raised to, m/s, (2, rows, k); None
            if nobody wants them.
        """
        bins = self._along(0, x, low)
        if self._bins[1] > 1:
            bins *= np.int32(self._bins[1])
            bins += self._along(1, y, low)
        bins += (numbers * self._number).astype(np.int32)
        touched = self._touched.reshape(-1).take(bins)
        if not touched.size:
            return
        least, most = int(touched.min()), int(touched.max())
        for number, slots in enumerate(self._slots[:most]):
            hits = None if number < least else np.flatnonzero(touched > number)
            self._raise(slots.reshape(-1), bins, hits, x, y, heights, velocity)

    def _along(self, axis: int, points: np.ndarray, low: np.ndarray) -> np.ndarray:
        """Numbers of the bins of points along an axis."""
        bins = points - low[:, axis, None]
        bins *= self._per_metre[axis]
        np.clip(bins, 0, self._bins[axis] - 1e-6, out=bins)
        return bins.astype(np.int32)

    def _raise(
        self,
        slots: np.ndarray,
        bins: np.ndarray,
        hits: np.ndarray | None,
        x: np.ndarray,
        y: np.ndarray,
        heights: np.ndarray,
        velocity: np.ndarray | None,
    ) -> None:
        """Raises heights to one box or belt each, of points of these numbers, of all if None."""

        def of(part: np.ndarray) -> np.ndarray:
            return part.reshape(-1) if hits is None else part.reshape(-1).take(hits)

        box = slots.take(of(bins))
        along = of(x) - self._x.take(box)
        across = of(y) - self._y.take(box) if self._ended or self._turned else None
        if self._turned:
            assert across is not None
            cosine, sine = self._cosine.take(box), self._sine.take(box)
            along, across = cosine * along + sine * across, cosine * across - sine * along
        top = self._top.take(box)
        if self._sloped:
            top += self._slope.take(box) * along
        before = of(heights)
        above = top > before
        above &= np.abs(along) <= self._half_x.take(box)
        if across is not None:
            above &= np.abs(across) <= self._half_y.take(box)
        if hits is None:
            np.copyto(before, top, where=above)
        else:
            heights.reshape(-1)[hits[above]] = top[above]
        if velocity is not None:
            raised = np.flatnonzero(above) if hits is None else hits[above]
            for axis in (0, 1):
                velocity[axis].reshape(-1)[raised] = self._velocity[axis].take(box[above])


def _before(counts: np.ndarray) -> np.ndarray:
    """The sum of all counts before each, (k,)."""
    return np.cumsum(counts) - counts
