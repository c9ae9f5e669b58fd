"""How fast this machine runs an environment: ratios to raw MuJoCo within one run.

    trl-suite bench PD_Dog2D_Slopes_Terrain-v0

Rates count physics steps, so that environments whose steps last differently compare; actions are
random, resets with new terrain included. `benchmarks/vector_environment.py` measures more with the same
parts: many sizes, memory, and other suites.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from typing import Any

import mujoco
import numpy as np

from trl_suite import files, suite
from trl_suite.commands import machine
from trl_suite.vector import VectorEnvironment

ID = 'PD_Biped2D_Gaps_Terrain-v0'
ROWS = 64
CONTROL_TIMESTEP = 1 / 30  # s; longer steps have controllers inside
SECONDS = 2.0  # per measurement
WARM = 4 / 3  # s of simulated time; most rows have fallen once by then
RESET = 30  # calls between two resets of what is stepped raw, a second of simulated time
ROUNDS = 8  # in which environment and raw batch take turns: machines are now faster, now slower
DRAWN = 100  # random actions, which are repeated


class Stopwatch:
    """Adds up the time that calls of a function take, and what they do.

    Attributes:
      seconds: spent in the function.
      items: the sum of what `count` made of the arguments.
    """

    def __init__(self, function: Callable[..., Any], count: Callable[..., int]) -> None:
        self._function, self._count = function, count
        self.seconds, self.items = 0.0, 0

    def __call__(self, *arguments: Any, **keywords: Any) -> Any:
        begin = time.perf_counter()
        found = self._function(*arguments, **keywords)
        self.seconds += time.perf_counter() - begin
        self.items += self._count(*arguments, **keywords)
        return found


def rate(step: Callable[[], object], seconds: float, per_call: int = 1) -> float:
    """Calls `step` for about `seconds`; returns items per second."""
    step()
    calls, begin = 0, time.perf_counter()
    while time.perf_counter() - begin < seconds:
        step()
        calls += 1
    return calls * per_call / (time.perf_counter() - begin)


def actions(low: Any, high: Any, shape: tuple[int, ...]) -> Iterator[np.ndarray]:
    """Yields random actions for ever, drawn beforehand with seed 0."""
    drawn = np.random.default_rng(0).uniform(low, high, (DRAWN, *shape))
    while True:
        yield from drawn


def warmed(id: str, rows: int, threads: int) -> tuple[VectorEnvironment, Iterator[np.ndarray]]:
    """Makes a vector environment whose rows are over their first episodes, and random actions."""
    environments = VectorEnvironment(id, rows, threads, seed=0)
    environments.reset()
    drawn = actions(-1, 1, (rows, len(environments.action_map)))
    physics = counted(environments)
    while physics.items * environments.task.physics_timestep < WARM * rows:
        environments.step(next(drawn))
    return environments, drawn


def counted(environments: VectorEnvironment) -> Stopwatch:
    """Has the time and number of all physics steps added up from now on, those of each row."""
    world: Any = environments._world
    step = type(world).step.__get__(world)
    world.step = Stopwatch(
        step, lambda n, r=None: n * (environments.num_envs if r is None else len(r))
    )
    return world.step


def vector(id: str, rows: int, threads: int, seconds: float = SECONDS) -> dict[str, float]:
    """Measures the vector environment, and `mujoco.batch.Batch.step` of the same model.

    Args:
      id: of the environment.
      rows: number of simulations.
      threads: that step them; 0 takes all cores.
      seconds: for the environment, and as many for the raw batch.

    Returns:
      'control' and 'physics': steps per second of all rows; 'batch': physics steps per second of the
      raw batch, terrains included, whose bodies are never reset; 'share': of the time that is spent in
      `Batch.step`; 'resets': share of resets; 'reset': ms per row.
    """
    environments, drawn = warmed(id, rows, threads)
    others, _ = warmed(id, rows, threads)
    world: Any = others._world
    physics, begin = counted(environments), Stopwatch(environments._begin, len)
    environments._begin = begin  # type: ignore[method-assign]
    substeps, controls = control_substeps(others), world.ctrl
    directly = acts_directly(others, world.models[0])  # else raw bodies are limp

    def step() -> None:
        controls[:] = others.action_map.control(next(drawn)) if directly else 0.0
        world.share(lambda part: world.step(substeps, part), world.all_ids)

    control = Stopwatch(lambda: environments.step(next(drawn)), lambda: rows)
    batch = Stopwatch(step, lambda: rows * substeps)
    for _ in range(ROUNDS):
        for turn in (control, batch):
            rate(turn, seconds / ROUNDS)
    environments.close()
    others.close()
    return {
        'control': control.items / control.seconds,
        'physics': physics.items / control.seconds,
        'batch': batch.items / batch.seconds,
        'share': physics.seconds / control.seconds,
        'reset': 1e3 * begin.seconds / max(1, begin.items),
        'resets': begin.seconds / control.seconds,
    }


def control_substeps(environment: Any) -> int:
    """How many physics steps there are between two controls of an environment."""
    task = environment.task
    return max(1, round(min(task.control_timestep, CONTROL_TIMESTEP) / task.physics_timestep))


def acts_directly(environment: Any, model: mujoco.MjModel) -> bool:
    """Whether actions are controls of the model, with no controller in between."""
    action_map = environment.action_map
    return np.size(action_map.control(np.zeros(len(action_map)))) == model.nu


def raw(
    model: mujoco.MjModel,
    substeps: int,
    seconds: float = SECONDS,
    state: np.ndarray | None = None,
    limp: bool = False,
) -> float:
    """Measures `mj_step` of a model under random controls, reset each second of simulated time.

    Args:
      model: whose it is.
      substeps: physics steps per control.
      seconds: how long.
      state: mjSTATE_INTEGRATION that it is reset to; its own by default.
      limp: controls are 0.

    Returns:
      Controls per second, of `substeps` each.
    """
    data = mujoco.MjData(model)
    low, high = model.actuator_ctrlrange.T.copy()
    free = ~model.actuator_ctrllimited.astype(bool)
    low[free], high[free] = -1, 1
    drawn = actions(low * (not limp), high * (not limp), (model.nu,))
    calls = 0

    def step() -> None:
        nonlocal calls
        if calls % RESET == 0:
            mujoco.mj_resetData(model, data)
            if state is not None:
                mujoco.mj_setState(model, data, state, mujoco.mjtState.mjSTATE_INTEGRATION)
        calls += 1
        data.ctrl[:] = next(drawn)
        mujoco.mj_step(model, data, substeps)

    return rate(step, seconds)


def single(id: str, seconds: float = SECONDS) -> dict[str, float]:
    """Measures raw `mj_step` from the start of an environment, and the environment itself.

    Returns:
      'mj_step': physics steps per second; 'environment': control steps per second, resets included.
    """
    environment = suite.make(id, {'random': 0})
    environment.reset()
    physics, substeps = environment.physics, control_substeps(environment)
    state = physics.get_state(sig=mujoco.mjtState.mjSTATE_INTEGRATION)
    model = physics.model.ptr
    limp = not acts_directly(environment, model)
    found = {'mj_step': substeps * raw(model, substeps, seconds, state, limp)}
    drawn = actions(-1, 1, environment.action_spec().shape)
    found['environment'] = rate(lambda: environment.step(next(drawn)), seconds)
    environment.close()
    return found


def bench(
    id: str = ID, rows: int = ROWS, threads: int = 0, seconds: float = SECONDS
) -> dict[str, Any]:
    """Measures an environment on this machine.

    Args:
      id: of the environment, or an alias.
      rows: of the vector environment.
      threads: that step them; 0 takes all cores that may be used.
      seconds: per measurement, of which there are four.

    Returns:
      What JSON can hold: 'machine', 'id', 'rows', 'threads'; 'control steps per second' of all rows,
      and of a 'single environment'; 'ratio to Batch.step' and 'ratio to mj_step' (on one thread) of
      the physics steps per second; 'share of the physics' in the time; 'reset' (ms per row).

    Raises:
      ValueError: unknown id, or numbers out of range.
    """
    if not 0 < seconds < float('inf'):
        raise ValueError(f'seconds is {seconds}; expected a positive number')
    id, threads = suite.find(id).id, threads or machine.cores()
    many, one = vector(id, rows, threads, seconds), single(id, seconds)
    return {
        'machine': machine.sentence(), 'id': id, 'rows': rows, 'threads': threads,
        'control steps per second': round(many['control']),
        'ratio to Batch.step': round(many['physics'] / many['batch'], 3),
        'ratio to mj_step': round(many['physics'] / one['mj_step'], 3),
        'share of the physics': round(many['share'], 3), 'reset': round(many['reset'], 3),
        'single environment': round(one['environment']),
    }  # fmt: skip


def run(arguments: argparse.Namespace) -> None:
    """Measures, and prints what was found."""
    if arguments.json is not None:
        files.check_path(arguments.json, ('.json',))
    result = bench(arguments.id, arguments.rows, arguments.threads, arguments.seconds)
    if arguments.json is not None:
        files.write_json(result, arguments.json)
    print(f'{result["id"]}, {result["rows"]} rows, {result["threads"]} threads, random actions')
    print(f'  on {result["machine"]}')
    for name, text in (
        ('control steps', f'{result["control steps per second"]} per second, resets included'),
        ('physics', f'{result["ratio to Batch.step"]:.2f} of the rate of raw mujoco.batch.Batch.step'),
        ('', f'{result["ratio to mj_step"]:.2f} of the rate of raw mj_step on one thread'),
        ('', f'{result["share of the physics"]:.0%} of the time is physics'),
        ('reset', f'{result["reset"]:.2f} ms per row'),
        ('alone', f'{result["single environment"]} control steps per second in a single environment'),
    ):  # fmt: skip
        print(f'  {name:<14} {text}')
