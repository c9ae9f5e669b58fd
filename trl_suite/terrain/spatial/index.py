"""Boxes of a window, sorted into bins, so that a query tests only the boxes near its point."""

from __future__ import annotations

import math

import numpy as np

from trl_suite.terrain.spatial.layout import Belts, Boxes
from trl_suite.terrain.spatial.windows import (
    COSINE,
    HALF,
    HALF_X,
    HALF_Y,
    SINE,
    SLOPE,
    TOP,
    SpatialWindows,
    X,
    Y,
    bin_of,
)
from trl_suite.util.compiled import compiled


def fill(i: int, boxes: Boxes, belts: Belts | None, ground: SpatialWindows) -> None:
    """Replaces the boxes and belts of window i, whose centre is set already.

    There are at most as many boxes as were allocated.
    """
    ground.boxes[i, :, HALF_X] = -1.0
    _put(i, 0, boxes, ground)
    if belts is not None:
        first = ground.boxes.shape[1] - len(belts.velocity)
        _put(i, first, belts.boxes, ground)
        ground.box_velocity[i, first:] = belts.velocity
    _sort(i, ground)


@compiled
def _put(i: int, first: int, boxes: Boxes, ground: SpatialWindows) -> None:
    """Writes boxes from index `first` on."""
    for k in range(len(boxes.top)):
        of = ground.boxes[i, first + k]
        of[X], of[Y] = boxes.position[k, 0], boxes.position[k, 1]
        of[HALF_X], of[HALF_Y] = boxes.half_size[k, 0], boxes.half_size[k, 1]
        of[COSINE], of[SINE] = math.cos(boxes.yaw[k]), math.sin(boxes.yaw[k])
        of[TOP], of[SLOPE] = boxes.top[k], boxes.slope[k]


@compiled
def _sort(i: int, ground: SpatialWindows) -> None:
    """Lists for each bin of a window the boxes that touch it, in ascending order."""
    bins, entries = ground.bins[i], ground.bin_boxes[i]
    boxes, columns, lines = ground.boxes.shape[1], bins.shape[0], bins.shape[1]
    bins[:] = 0
    for number in range(boxes):
        first, last, begin, end = _touched(i, number, ground)
        for column in range(first, last):
            for line in range(begin, end):
                bins[column, line, 1] += 1
    total = 0
    for column in range(columns):
        for line in range(lines):
            count = bins[column, line, 1]
            bins[column, line, 0] = bins[column, line, 1] = total
            total += count
    if total <= len(entries):
        for number in range(boxes):
            first, last, begin, end = _touched(i, number, ground)
            for column in range(first, last):
                for line in range(begin, end):
                    entries[bins[column, line, 1]] = number
                    bins[column, line, 1] += 1
    else:  # many large boxes: every bin lists all of them
        bins[:, :, 0], bins[:, :, 1] = 0, boxes
        for number in range(boxes):
            entries[number] = number
    for number in range(boxes):
        of = ground.boxes[i, number]
        across = abs(of[Y] - ground.centre[i, 1])
        if of[SINE] == 0.0 and across + HALF <= of[HALF_Y]:
            of[HALF_Y] = np.inf  # spans the window, so it extends beyond it


@compiled
def _touched(i: int, number: int, ground: SpatialWindows) -> tuple[int, int, int, int]:
    """The bins that a box touches: begin and end along x, begin and end along y."""
    of = ground.boxes[i, number]
    length, width = of[HALF_X], of[HALF_Y]
    if length < 0.0:
        return 0, 0, 0, 0
    cosine, sine = abs(of[COSINE]), abs(of[SINE])
    half_x, half_y = cosine * length + sine * width, sine * length + cosine * width
    x, y = of[X] - (ground.centre[i, 0] - HALF), of[Y] - (ground.centre[i, 1] - HALF)
    columns, lines = ground.bins.shape[1], ground.bins.shape[2]
    return (
        bin_of(x - half_x, columns),
        bin_of(x + half_x, columns) + 1,
        bin_of(y - half_y, lines),
        bin_of(y + half_y, lines) + 1,
    )
