"""`trl-suite terrain`: plots random grounds of a terrain, or writes one as a mesh."""

from __future__ import annotations

import argparse
import pathlib
from typing import Any

import numpy as np

from trl_suite import rendering, terrain
from trl_suite.cli.arguments import add_command, add_file, positive
from trl_suite.terrain.mesh import LARGEST_SIDE
from trl_suite.util import files
from trl_suite.util.options import checked

BEFORE = 2.0  # m; extent of planar ground behind the start
LONGEST = LARGEST_SIDE - BEFORE  # m


def declare(commands: Any) -> None:
    """Declares the command and its arguments."""
    text = 'plot random grounds of a terrain, or write one as a mesh'
    command = add_command(commands, 'terrain', text, run)
    command.add_argument(
        'terrain', metavar='NAME-or-FILE', help='a preset, or a .json or .txt file'
    )
    command.add_argument('--draws', type=positive, help='number of grounds in a plot, by default 3')
    command.add_argument(
        '--length', type=float, default=40.0, help='length of a profile, or side of a map, in m'
    )
    command.add_argument('--seed', type=int, default=0, help='seed of the grounds')
    command.add_argument(
        '--terrain-level', type=float, default=0.0, help='index of the parameter set'
    )
    text = 'length of ramps in place of vertical faces, in m'
    command.add_argument('--face-length', type=float, help=text)
    text = 'write a plot, .png, or a mesh of the first ground, .obj, .glb or .stl; by default terrain_NAME.png'
    add_file(command, '--output', text)


def run(arguments: argparse.Namespace) -> None:
    """Plots random grounds of a terrain, or writes one as a mesh, and prints the file's name."""
    name = pathlib.Path(arguments.terrain)
    known = name.name if name.suffix not in ('.json', '.txt') else name.stem
    output = arguments.output or pathlib.Path(f'terrain_{known}.png')
    files.check_path(output, (*rendering.IMAGE_SUFFIXES, *terrain.WRITTEN))
    source = terrain.load(arguments.terrain).with_faces(arguments.face_length)
    if output.suffix.lower() in terrain.WRITTEN:
        if arguments.draws:
            raise ValueError(
                f'--draws has no effect on a mesh, {output}, which has the first ground'
            )
        _write_mesh(source, arguments, output)
        return
    drawn = arguments.draws or 3, arguments.length, arguments.seed, arguments.terrain_level
    rendering.plot_terrain(source, output, *drawn)
    print(output)


def _write_mesh(
    source: terrain.Terrain, arguments: argparse.Namespace, output: pathlib.Path
) -> None:
    length = arguments.length
    if not 0 < length <= LONGEST:
        raise ValueError(f'length is {length}; expected metres in (0, {LONGEST:g}]')
    checked('seed', arguments.seed, int, at_least=0)
    draw = terrain.SpatialGround if source.spatial else terrain.PlanarGround
    # The same ground as in the first plot.
    ground = draw(
        source, np.random.SeedSequence((arguments.seed, 0)), terrain_level=arguments.terrain_level
    )
    low, high = (-0.5 * length, 0.5 * length) if source.spatial else (-BEFORE, length)
    terrain.save_mesh(ground, output, low, high)
    print(output)
