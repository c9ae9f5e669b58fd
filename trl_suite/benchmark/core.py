"""The core set: environments, budgets, seeds, and the scores that are 0 and 1."""

from __future__ import annotations

import functools
import pathlib
from typing import Any

import numpy as np

from trl_suite.runs import Benchmark, Course
from trl_suite.util import errors, files

BUDGETS = {'1M': 1_000_000, '10M': 10_000_000}  # control steps; of a gait, cycles
SEEDS = (0, 1, 2, 3, 4)  # of the runs
PARTS = 20  # tests of a run, one after every 5 % of the budget
GAIT_LIMIT = 200  # cycles of an episode; the ids' own, 5,000, would take most of a run for tests
SCALES = pathlib.Path(__file__).with_name('scales.json')

# What each tests. Every row differs from the others in body, actuation, ground or level of control.
_ROWS = {
    'PD_Biped2D_Gaps_Terrain-v0': 'target angles; steps must land beyond gaps',
    'PD_Dog2D_Mixed_Terrain-v0': 'target angles; steps, gaps and walls in turn',
    'PD_Raptor2D_Slopes_Terrain-v0': 'target angles; slopes without level ground',
    'MTU_Biped2D_LLC_Imitate_Flat-v0': 'excitations of muscles',
    'Torque_Dog2D_LLC_Imitate_Flat-v0': 'torques of a body with many joints',
    'PD_Biped3D_Imitate-Stairs_Terrain-v0': 'balance in 3D; stairs seen as a map of heights',
    'FSM_Hopper2D_Terrain_Gaps-v0': 'one action per hop; gaps',
    'FSM_Dog2D_Terrain_Mixed-v0': 'one action per bound; steps, gaps and walls in turn',
    'FSM_Biped2D_Terrain_Slopes_Mixed-v0': 'one action per stride; slopes with obstacles, drops',
    'PD_Biped3D_LLC_General_Step-v0': 'footsteps that are given, in 3D',
    'PD_Biped3D_HLC_Soccer-v0': 'footsteps that are chosen; a ball is to be brought to a goal',
    'PD_Biped3D_Terrain_Trail_Hard-v0': 'target angles on the way to a goal, without footsteps',
}

CORE: dict[str, Course] = {
    id: Course(id, (id,), text, PARTS, GAIT_LIMIT if id.startswith('FSM') else None)
    for id, text in _ROWS.items()
}


@functools.cache
def scales() -> dict[str, dict[str, Any]]:
    """Returns measured scores of each environment: 'zero', 'random' and 'shipped', and 'episodes' of each.

    `benchmarks/core_scales.py` measures them, and names engine, CPU and policy; the format of results has
    their version.
    """
    return files.read_json(SCALES)['scores']


def ends(id: str) -> tuple[float, float]:
    """Returns the scores that are 0, the better of random and default action, and 1, a shipped policy's.

    Raises:
      ValueError: the environment is not in the core set.
    """
    of = scales()[BENCHMARK.get(id).name]
    return max(of['zero'], of['random']), of['shipped']


def normalised(id: str, score: float) -> float:
    """Returns a score on the scale of `ends`; raises the same error."""
    low, high = ends(id)
    return (score - low) / (high - low)


def _custom(name: str, ids: tuple[str, ...]) -> Course:
    raise ValueError(errors.unknown('environment of the benchmark', name, CORE))


def _measured(course: Course, scores: list[list[float]], initial: list[float]) -> dict[str, float]:
    """Returns the normalised score after the run, and the mean of those after each part."""
    [id] = course.ids
    curve = [normalised(id, score) for (score,) in scores]
    return {'score': curve[-1], 'mean_score': float(np.mean(curve))}


BENCHMARK = Benchmark(
    'trl_suite benchmark 1', 'environment', CORE, _custom, BUDGETS, SEEDS, _measured
)
