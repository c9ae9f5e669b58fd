"""`trl-suite terrain`: plots draws of a terrain, or writes one as a mesh."""

from __future__ import annotations

import argparse
import pathlib

import numpy as np

from trl_suite import rendering, terrain
from trl_suite.terrain.mesh import LARGEST_SIDE
from trl_suite.util import files

BEFORE = 2.0  # m; of planar ground behind the start
LONGEST = LARGEST_SIDE - BEFORE  # m


def run(arguments: argparse.Namespace) -> None:
    """Plots draws of a terrain, or writes one as a mesh, and prints the file's name."""
    name = pathlib.Path(arguments.terrain)
    known = name.name if name.suffix not in ('.json', '.txt') else name.stem
    output = arguments.output or pathlib.Path(f'terrain_{known}.png')
    files.check_path(output, (*rendering.IMAGE_SUFFIXES, *terrain.WRITTEN))
    if output.suffix.lower() in terrain.WRITTEN:
        _write_mesh(arguments, output)
        return
    rendering.plot_terrain(
        arguments.terrain, output, arguments.draws, arguments.length, arguments.seed,
        arguments.terrain_level,
    )  # fmt: skip
    print(output)


def _write_mesh(arguments: argparse.Namespace, output: pathlib.Path) -> None:
    source, length = terrain.load(arguments.terrain), arguments.length
    if not 0 < length <= LONGEST:
        raise ValueError(f'length is {length}; expected metres in (0, {LONGEST:g}]')
    draw = terrain.SpatialGround if source.spatial else terrain.PlanarGround
    # As the first of the plots.
    ground = draw(
        source, np.random.SeedSequence((arguments.seed, 0)), terrain_level=arguments.terrain_level
    )
    low, high = (-0.5 * length, 0.5 * length) if source.spatial else (-BEFORE, length)
    terrain.save_mesh(ground, output, low, high)
    print(output)
