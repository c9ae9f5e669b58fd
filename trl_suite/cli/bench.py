"""The speed of an environment on this machine, compared to raw MuJoCo in the same run.

    trl-suite bench PD_Dog2D_Slopes_Terrain-v0

Ratios are of physics steps, so that environments with different control steps can be compared;
actions are random, and resets with new terrain are included. `benchmarks/vector_environment.py`
measures more with the same functions: many sizes, memory, and other suites.
"""

from __future__ import annotations

import argparse
import threading
import time
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from trl_suite.cli import engine
from trl_suite.cli.arguments import add_command, add_file, add_id, add_threads, positive
from trl_suite.util import files, machine

if TYPE_CHECKING:
    import mujoco

    from trl_suite.environments.vector import VectorEnvironment

ID = 'PD_Biped2D_Gaps_Terrain-v0'
NUM_ENVS = 64
CONTROL_TIMESTEP = 1 / 30  # s; tasks with longer steps contain controllers
SECONDS = 2.0  # per measurement
WARM = 4 / 3  # s of simulated time, in which most simulations fall once
RESET = 30  # calls between two resets of a raw simulation, a second of simulated time
ROUNDS = 8  # alternations of environment and raw batch, as the speed of machines varies
PROJECTED = (16, 64)  # cores
DRAWN = 100  # number of random actions, which are repeated
CONTROLS = 10  # the same for MuJoCo alone


class Stopwatch:
    """Measures the total time and the number of processed items of a function's calls.

    Attributes:
      seconds: time spent in the function.
      items: sum of `count` of the arguments over all calls.
    """

    def __init__(self, function: Callable[..., Any], count: Callable[..., int]) -> None:
        self._function, self._count = function, count
        self.seconds, self.items, self._lock = 0.0, 0, threading.Lock()

    def __call__(self, *arguments: Any, **keywords: Any) -> Any:
        begin = time.perf_counter()
        found = self._function(*arguments, **keywords)
        with self._lock:  # several threads may call it
            self.seconds += time.perf_counter() - begin
            self.items += self._count(*arguments, **keywords)
        return found


def rate(step: Callable[[], object], seconds: float, per_call: int = 1) -> float:
    """Calls `step` for about `seconds`; returns items per second."""
    step()
    calls, begin = 0, time.perf_counter()
    while not calls or time.perf_counter() - begin < seconds:
        step()
        calls += 1
    return calls * per_call / (time.perf_counter() - begin)


def actions(low: Any, high: Any, shape: tuple[int, ...]) -> Iterator[np.ndarray]:
    """Yields random actions without end, drawn beforehand with seed 0."""
    drawn = np.random.default_rng(0).uniform(low, high, (DRAWN, *shape))
    while True:
        yield from drawn


def warmed(id: str, num_envs: int, threads: int) -> tuple[VectorEnvironment, Iterator[np.ndarray]]:
    """Makes a vector environment, runs it beyond most first episodes, and makes random actions."""
    kind = engine.load('trl_suite.vector').VectorEnvironment
    environments = kind(id, num_envs, threads, seed=0)
    environments.reset()
    drawn = actions(-1, 1, (num_envs, len(environments.action_map)))
    while physics_steps(environments) * environments.task.physics_timestep < WARM * num_envs:
        environments.step(next(drawn))
    return environments, drawn


def physics_steps(environments: VectorEnvironment) -> int:
    """Returns the total number of physics steps of the simulations."""
    return int(environments.task.world.engine.steps.sum())


def vector(id: str, num_envs: int, threads: int, seconds: float = SECONDS) -> dict[str, Any]:
    """Measures the vector environment, and MuJoCo alone with the same models and threads.

    `seconds` is the duration for the environment, and the same for the raw batch.

    Returns:
      'control steps per second' of all simulations, resets included; 'physics' and 'engine':
      physics steps per second of the environment, and of MuJoCo alone with terrain, never reset;
      'ratio to the engine', of these two; 'serial': us per simulation and control step in which
      only one thread works; 'reset': ms per simulation; 'resets': fraction of the threads' time
      spent in resets; 'projection': control steps per second on each number of `PROJECTED` cores
      as a multiple of those on one, by Amdahl's law from the serial part. Shared caches and memory
      are neglected.
    """
    environments: Any
    environments, drawn = warmed(id, num_envs, threads)
    others, _ = warmed(id, num_envs, threads)
    world: Any = others.task.world
    core: Any = environments.core
    core.begin = begin = Stopwatch(core.begin, len)
    core.share = parallel = Stopwatch(core.share, lambda *_: num_envs)
    before = physics_steps(environments)
    substeps, controls = control_substeps(others), world.ctrl
    directly = acts_directly(others, world.models[0])  # else controls are 0
    given = [others.action_map.control(next(drawn)) if directly else 0.0 for _ in range(CONTROLS)]

    def step() -> None:
        given.append(given.pop(0))
        controls[:] = given[0]
        world.share(lambda part: world.step(substeps, part), world.all_ids)

    control = Stopwatch(lambda: environments.step(next(drawn)), lambda: num_envs)
    alone = Stopwatch(step, lambda: num_envs * substeps)
    for _ in range(ROUNDS):
        for turn in (control, alone):
            rate(turn, seconds / ROUNDS)
    physics = (physics_steps(environments) - before) / control.seconds
    unhindered = alone.items / alone.seconds
    environments.close()
    others.close()
    serial, shared = control.seconds - parallel.seconds, threads * parallel.seconds
    return {
        'control steps per second': round(control.items / control.seconds),
        'physics': round(physics),
        'engine': round(unhindered),
        'ratio to the engine': round(physics / unhindered, 3),
        'serial': round(1e6 * serial / control.items, 3),
        'reset': round(1e3 * begin.seconds / max(1, begin.items), 3),
        'resets': round(begin.seconds / (threads * control.seconds), 3),
        'projection': {
            str(cores): round((serial + shared) / (serial + shared / cores), 1)
            for cores in PROJECTED
        },
    }


def control_substeps(environment: Any) -> int:
    """Number of physics steps between two controls of an environment."""
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
    """Returns controls per second of `mj_step`, with `substeps` physics steps each.

    Controls are random, or 0 if `limp`. Each second of simulated time, the model is reset to a
    state (mjSTATE_INTEGRATION), by default its initial one.
    """
    import mujoco

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


def single(id: str, seconds: float = SECONDS) -> dict[str, int]:
    """Measures raw `mj_step` from the initial state of an environment, and the environment itself.

    Returns:
      'mj_step': physics steps per second; 'single environment': control steps per second, resets
      included.
    """
    environment = engine.load().make(id, {'random': 0})
    import mujoco

    environment.reset()
    physics, substeps = environment.physics, control_substeps(environment)
    state = physics.get_state(sig=mujoco.mjtState.mjSTATE_INTEGRATION)
    model = physics.model.ptr
    limp = not acts_directly(environment, model)
    alone = substeps * raw(model, substeps, seconds, state, limp)
    drawn = actions(-1, 1, environment.action_spec().shape)
    steps = rate(lambda: environment.step(next(drawn)), seconds)
    environment.close()
    return {'mj_step': round(alone), 'single environment': round(steps)}


def bench(
    id: str = ID, num_envs: int = NUM_ENVS, threads: int = 0, seconds: float = SECONDS
) -> dict[str, Any]:
    """Measures an environment on this machine.

    With 0 threads, all usable cores are used. Each of four measurements lasts `seconds`.

    Returns:
      A dict that can be written as JSON: 'machine', 'id', 'num_envs', 'threads', the results of
      `vector` and of `single`, and the 'ratio to mj_step' of their physics steps per second.

    Raises:
      ValueError: unknown id, or numbers out of range.
    """
    if not 0 < seconds < float('inf'):
        raise ValueError(f'seconds is {seconds}; expected a positive number')
    id, threads = engine.load().find(id).id, threads or machine.cores()
    many, one = vector(id, num_envs, threads, seconds), single(id, seconds)
    setting = {'id': id, 'num_envs': num_envs, 'threads': threads}
    ratio = round(many['physics'] / one['mj_step'], 3)
    return {'machine': machine.sentence(), **setting, **many, **one, 'ratio to mj_step': ratio}


def declare(commands: Any) -> None:
    """Declares the command and its arguments."""
    text = 'measure the speed of this machine against raw MuJoCo'
    command = add_command(commands, 'bench', text, run)
    add_id(command, nargs='?', default=ID)
    command.add_argument(
        '--num-envs', type=positive, default=NUM_ENVS, help='simulations of the vector environment'
    )
    add_threads(command)
    command.add_argument(
        '--seconds', type=float, default=SECONDS, help='duration of each of four measurements'
    )
    add_file(command, '--json', 'write all results, .json', '.json')


def run(arguments: argparse.Namespace) -> None:
    """Measures, and prints the results."""
    result = bench(arguments.id, arguments.num_envs, arguments.threads, arguments.seconds)
    if arguments.json is not None:
        files.write_json(result, arguments.json)
    projected = ', '.join(f'{v:.3g} times on {k} cores' for k, v in result['projection'].items())
    text = """{id}, {num_envs} simulations, {threads} threads, random actions
  on {machine}
  control steps  {control steps per second} per second, resets included
  physics        {ratio to the engine:.2f} of the rate of MuJoCo alone on these threads
                 {ratio to mj_step:.2f} of the rate of raw mj_step on one thread
  serial         {serial:.2f} us per simulation and control step in one thread
  reset          {reset:.2f} ms per simulation
  projected      {projected} of one core's rate, by Amdahl's law
  alone          {single environment} control steps per second in a single environment"""
    print(text.format_map({**result, 'projected': projected}))
