"""Boxes of n windows, sorted so that a point finds those it may lie on."""

from __future__ import annotations

import numpy as np

from trl_suite.terrain.layout import Belts, Boxes

HALF = 16.0  # m; half side of a window
BINS = round(2 * HALF)  # squares of 1 m that know which boxes touch them, along each axis


class BoxIndex:
    """Boxes and belts of n windows of 32 m x 32 m, in bins of 1 m x 1 m."""

    def __init__(self, n: int, boxes: int, belts: int) -> None:
        """Makes room for so many boxes and belts in each window."""
        self._boxes, self._count = boxes, boxes + belts
        # One box more in every window, that nothing is in.
        stride = self._count + 1
        self._row = np.arange(n)[:, None]
        self._x, self._y, self._sine, self._top, self._slope = np.zeros((5, n, stride))
        self._cosine = np.ones((n, stride))
        self._half_x, self._half_y = np.full((2, n, stride), -1.0)
        self._velocity = np.zeros((2, n, stride))
        self._turned = self._sloped = False  # whether any box ever was
        # For every bin, numbers of the boxes that touch it, among those of all windows.
        self._nothing = self._count + stride * self._row
        self._slots = np.zeros((1, n, BINS * BINS), int) + self._nothing
        self._touched = np.zeros((n, BINS * BINS), int)

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
        extent = boxes.extent()
        first = np.clip(np.floor(boxes.position - extent - low), 0, BINS - 1).astype(int)
        last = np.clip(np.floor(boxes.position + extent - low), 0, BINS - 1).astype(int)
        across = last[:, 1] - first[:, 1] + 1
        counts = (last[:, 0] - first[:, 0] + 1) * across
        box = np.repeat(np.arange(len(counts)), counts)
        k = np.arange(len(box)) - (np.cumsum(counts) - counts)[box]
        bins = (first[box, 0] + k // across[box]) * BINS + first[box, 1] + k % across[box]
        order = np.argsort(bins, kind='stable')
        bins, box = bins[order], box[order]
        touched = np.bincount(bins, minlength=BINS**2)
        slot = np.arange(len(bins)) - (np.cumsum(touched) - touched)[bins]
        missing = int(touched.max(initial=0)) - len(self._slots)
        if missing > 0:
            more = np.zeros((missing, *self._slots.shape[1:]), int) + self._nothing
            self._slots = np.concatenate([self._slots, more])
        self._slots[:, row] = self._nothing[row]
        self._slots[slot, row, bins] = numbers[box] + (self._count + 1) * row
        self._touched[row] = touched

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
        i = np.clip(x - low[:, :1], 0, BINS - 1e-6).astype(np.int32)
        j = np.clip(y - low[:, 1:], 0, BINS - 1e-6).astype(np.int32)
        i *= BINS
        i += j
        i += (numbers * BINS**2).astype(np.int32)
        touched = self._touched.reshape(-1).take(i)
        hits = np.flatnonzero(touched)
        if not len(hits):
            return
        bins = i.reshape(-1)[hits]
        x, y, z = x.reshape(-1)[hits], y.reshape(-1)[hits], heights.reshape(-1)[hits]
        runs = None if velocity is None else velocity.reshape(2, -1)[:, hits]
        for slots in self._slots[: int(touched.max())]:
            box = slots.reshape(-1).take(bins)
            along, across = x - self._x.take(box), y - self._y.take(box)
            if self._turned:
                cosine, sine = self._cosine.take(box), self._sine.take(box)
                along, across = cosine * along + sine * across, cosine * across - sine * along
            top = self._top.take(box)
            if self._sloped:
                top += self._slope.take(box) * along
            above = top > z
            above &= np.abs(along) <= self._half_x.take(box)
            above &= np.abs(across) <= self._half_y.take(box)
            np.copyto(z, top, where=above)
            if runs is not None:
                for axis in (0, 1):
                    np.copyto(runs[axis], self._velocity[axis].take(box), where=above)
        heights.reshape(-1)[hits] = z
        if velocity is not None:
            velocity.reshape(2, -1)[:, hits] = runs
