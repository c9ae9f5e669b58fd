"""Measures the cost of resets and of their parts, for some simulations, on one thread.

    python benchmarks/resets.py [IDS ...] [--num-envs 256] [--resets 64] [--repeats 30] [--json FILE]

Prints ms per reset: the smallest CPU time of the repeats, because machines are shared. The parts
are measured in a second run, because reading the clocks takes time; the time of a part excludes the
parts that it calls:

* seeds: streams of random numbers for terrain and goals
* drawing: generation of terrain as arrays
* start and goals: search for valid start and goal positions
* laying: terrain windows for queries, geoms and `mj_setConst`
* physics: the engine's reset and forward
* rest: the character's pose, observations, Python
"""

from __future__ import annotations

import argparse
import collections
import functools
import pathlib
import sys
import time
from typing import Any

import numpy as np
import tqdm

from trl_suite.arenas import PlanarArena, SpatialArena
from trl_suite.engine import World
from trl_suite.terrain import PlanarGround, SpatialGround
from trl_suite.terrain.spatial.layout import Layout
from trl_suite.util import files
from trl_suite.util.options import checked
from trl_suite.util.program import begin_script
from trl_suite.vector import VectorEnvironment

IDS = (
    'PD_Biped2D_Gaps_Terrain-v0', 'PD_Dog2D_Slopes_Mixed_Terrain-v0',
    'PD_Biped3D_Imitate-Hills_Terrain-v0', 'PD_Biped3D_HLC_Forest-v0',
)  # fmt: skip
PARTS = (
    ('drawing', PlanarGround, '__init__'), ('drawing', PlanarGround, 'window'), ('drawing', SpatialGround, '__init__'),
    ('drawing', Layout, 'vertices'), ('drawing', Layout, 'boxes_in'),
    ('start and goals', SpatialGround, 'spawn'), ('start and goals', SpatialGround, 'goal'),
    ('laying', PlanarArena, 'begin_episode'), ('laying', SpatialArena, 'begin_episode'),
    ('physics', World, 'forward'), ('physics', World, 'reset'),
)  # fmt: skip


class Clocks:
    """Accumulates the time spent in parts, each without the parts that it calls."""

    def __init__(self) -> None:
        self.spent: dict[str, float] = collections.defaultdict(float)
        self._inner = [0.0]  # s, spent in parts called by each active part

    def timed(self, part: str, function: Any) -> Any:
        @functools.wraps(function)
        def call(*args: Any, **kwargs: Any) -> Any:
            self._inner.append(0.0)
            begin = time.thread_time()
            try:
                return function(*args, **kwargs)
            finally:
                total = time.thread_time() - begin
                self.spent[part] += total - self._inner.pop()
                self._inner[-1] += total

        return call


def measure(id_: str, num_envs: int, resets: int, repeats: int) -> dict[str, float]:
    """Returns ms per reset, in total and for each part."""
    environments = VectorEnvironment(id_, num_envs, 1, seed=0)
    environments.reset()
    rows = np.linspace(0, num_envs, resets, endpoint=False).astype(int)
    per_reset = 1e3 / resets

    def repeat() -> float:
        spent = []
        for _ in range(repeats):
            begin = time.thread_time()
            environments.reset(rows)
            spent.append(time.thread_time() - begin)
        return float(min(spent))

    repeat()
    figures = {'reset': per_reset * repeat()}
    users = [module for module in sys.modules.values() if 'drawn_seed' in vars(module)]
    parts = (*PARTS, *(('seeds', module, 'drawn_seed') for module in users))
    clocks, originals = Clocks(), [getattr(owner, name) for _, owner, name in parts]
    for part, owner, name in parts:
        setattr(owner, name, clocks.timed(part, getattr(owner, name)))
    try:
        begin = time.thread_time()
        repeat()
        total = time.thread_time() - begin
    finally:
        for (_, owner, name), original in zip(parts, originals, strict=True):
            setattr(owner, name, original)
    clocks.spent['rest'] = total - sum(clocks.spent.values())
    environments.close()
    return {**figures, **{k: per_reset * s / repeats for k, s in clocks.spent.items()}}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('ids', nargs='*', default=IDS)
    parser.add_argument('--num-envs', type=int, default=256)
    parser.add_argument('--resets', type=int, default=64, help='number of simulations to reset')
    parser.add_argument('--repeats', type=int, default=30)
    parser.add_argument('--json', type=pathlib.Path, help='also write the figures to this file')
    arguments = parser.parse_args()
    checked('--resets', arguments.resets, int, at_least=1, at_most=arguments.num_envs)
    figures = {}
    for id_ in tqdm.tqdm(arguments.ids):
        found = measure(id_, arguments.num_envs, arguments.resets, arguments.repeats)
        figures[id_] = {name: round(value, 4) for name, value in found.items()}
        tqdm.tqdm.write(f'{id_}: ' + ', '.join(f'{k} {v:.3f}' for k, v in found.items()) + ' ms')
    if arguments.json:
        files.write_json(figures, arguments.json)


if __name__ == '__main__':
    begin_script()
    main()
