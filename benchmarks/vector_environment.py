"""Measures vector environments relative to raw MuJoCo and other libraries; ratios within one run.

    python benchmarks/vector_environment.py [--seconds S] [--json FILE] [--plot FILE]

Prints, with random actions and including resets:

- vector environments by number of simulations and threads: control steps per second; the serial
  part, us per simulation and control step; the cost of a reset; and the projected speed-up on 16
  and 64 cores, by Amdahl's law from the serial part;
- memory per simulation, from the difference of new processes with 16 and with 1024 simulations;
- MuJoCo alone with the same models on the same threads, raw `mj_step` of one of them, and the
  single environment;
- installed libraries: dm_control's suite, Gymnasium's MuJoCo environments (single, sync, async) and
  EnvPool, each as a fraction of the raw `mj_step` rate of its own model with the same number of
  physics steps, so that models of different cost can be compared. EnvPool 1.2.5 contains MuJoCo
  3.6.0; the wheels of 1.2.2 to 1.2.5 cannot be imported because files are missing.
"""

import argparse
import concurrent.futures
import importlib.util
import multiprocessing
import os
import pathlib
import resource

from trl_suite.cli import bench
from trl_suite.cli.bench import actions, rate, raw
from trl_suite.util import files
from trl_suite.util.program import begin_script

IDS = (
    'PD_Biped2D_Flat-v0', 'PD_Biped2D_Gaps_Terrain-v0', 'PD_Dog2D_Slopes_Terrain-v0',
    'PD_Biped3D_Imitate-v0', 'PD_Biped3D_Imitate-Hills_Terrain-v0',
)  # fmt: skip
SIZES = (1, 16, 64, 256, 1024)
THREADS = (1, 2)
SUBSTEPS = 10
MEMORY_ROWS = (16, 1024)


def resident():
    """Resident memory of this process, bytes."""
    with open('/proc/self/statm') as file:
        return int(file.read().split()[1]) * resource.getpagesize()


def measurement(num_envs, threads):
    """Returns the name of a measurement in the JSON file."""
    return f'{num_envs} simulations, {threads} threads'


def footprint(id_, num_envs):
    """Resident memory of this process after making and stepping simulations, bytes."""
    environments, _ = bench.warmed(id_, num_envs, max(THREADS))
    found = resident()
    environments.close()
    return found


def memory(id_):
    """Memory per simulation, bytes; measured in new processes, without earlier allocations."""
    sizes = []
    for num_envs in MEMORY_ROWS:
        spawn = multiprocessing.get_context('spawn')
        with concurrent.futures.ProcessPoolExecutor(1, spawn) as pool:
            sizes.append(pool.submit(footprint, id_, num_envs).result())
    return (sizes[1] - sizes[0]) / (MEMORY_ROWS[1] - MEMORY_ROWS[0])


def peers(seconds):
    """Measures installed libraries, each as a fraction of raw mj_step of its own model."""
    found = {}
    from dm_control import suite as dm_suite

    for domain, task in (('walker', 'walk'), ('humanoid', 'walk')):
        environment = dm_suite.load(domain, task, task_kwargs={'random': 0})
        spec = environment.action_spec()
        drawn = actions(spec.minimum, spec.maximum, spec.shape)
        environment.reset()
        substeps = round(environment.control_timestep() / environment.physics.timestep())
        reference = raw(environment.physics.model.ptr, substeps, seconds)
        speed = rate(lambda e=environment, d=drawn: e.step(next(d)), seconds)
        found[f'dm_control {domain}'] = speed / reference
    if importlib.util.find_spec('gymnasium'):
        import gymnasium

        for id_ in ('Walker2d-v5', 'Humanoid-v5'):
            environment = gymnasium.make(id_)
            base = environment.unwrapped
            reference = raw(base.model, base.frame_skip, seconds)
            environment.reset(seed=0)
            space = environment.action_space
            drawn = actions(space.low, space.high, space.shape)

            def step(environment=environment, drawn=drawn):
                _, _, terminated, truncated, _ = environment.step(next(drawn))
                if terminated or truncated:
                    environment.reset()

            found[f'Gymnasium {id_}'] = rate(step, seconds) / reference
            for mode in ('sync', 'async'):
                num_envs = 16
                vector = gymnasium.make_vec(id_, num_envs=num_envs, vectorization_mode=mode)
                vector.reset(seed=0)
                drawn = actions(space.low, space.high, (num_envs, *space.shape))
                speed = rate(lambda v=vector, d=drawn: v.step(next(d)), seconds, num_envs)
                found[f'Gymnasium {id_} {mode}, {num_envs} simulations'] = speed / reference
                vector.close()
            if id_ == 'Humanoid-v5':
                found.update(envpool_humanoid(space, reference, seconds))
    return found


def envpool_humanoid(space, reference, seconds):
    """Measures EnvPool's humanoid, if it can be imported, as a fraction of a raw rate."""
    try:
        import envpool
    except (ImportError, OSError) as error:
        print(f'EnvPool is not measured: {error}')
        return {}
    found = {}
    for num_envs in (16, 64):
        pool = envpool.make_gymnasium('Humanoid-v4', num_envs=num_envs, num_threads=2)
        pool.reset()
        shape = (num_envs, *space.shape)
        drawn = actions(space.low, space.high, shape)
        speed = rate(lambda p=pool, d=drawn: p.step(next(d)), seconds, num_envs)
        found[f'EnvPool Humanoid-v4, {num_envs} simulations, 2 threads'] = speed / reference
    return found


def plot(figures, path):
    """Plots rate against number of simulations."""
    import matplotlib

    matplotlib.use('Agg')
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(9, 4))
    for k, (id_, found) in enumerate(figures['ours'].items()):
        reference = figures['single'][id_]['mj_step'] / SUBSTEPS
        for threads in THREADS:
            sizes = [n for n in SIZES if measurement(n, threads) in found]
            rates = [
                found[measurement(n, threads)]['control steps per second'] / reference
                for n in sizes
            ]
            axes.plot(
                sizes,
                rates,
                'o-' if threads == 1 else 's--',
                color=f'C{k}',
                label=f'{id_}, {threads} thread{"s" * (threads > 1)}',
            )
    axes.set(xscale='log', xlabel='simulations', ylabel='rate / raw mj_step on one thread')
    axes.grid(alpha=0.3)
    axes.legend(fontsize=7, loc='center left', bbox_to_anchor=(1.01, 0.5))
    figure.tight_layout()
    with files.replacing(path) as part:
        figure.savefig(part, dpi=100)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--seconds', type=float, default=3.0, help='per measurement')
    parser.add_argument('--json', type=pathlib.Path, help='also write the figures to this file')
    parser.add_argument(
        '--plot', type=pathlib.Path, help='also plot rate against number of simulations'
    )
    parser.add_argument('--num-envs', type=int, nargs='*', default=SIZES)
    parser.add_argument('--no-peers', action='store_true')
    arguments = parser.parse_args()
    if arguments.plot:
        files.check_path(arguments.plot, ('.png', '.svg'))
    figures = {'cores': os.cpu_count(), 'single': {}, 'ours': {}, 'memory per simulation, kB': {}}
    for id_ in IDS:
        figures['single'][id_] = bench.single(id_, arguments.seconds)
        print(id_, figures['single'][id_])
        figures['memory per simulation, kB'][id_] = round(memory(id_) / 1e3)
        print(f'  memory per simulation: {figures["memory per simulation, kB"][id_]} kB')
        figures['ours'][id_] = {}
        for threads in THREADS:
            for num_envs in arguments.num_envs:
                name = measurement(num_envs, threads)
                found = bench.vector(id_, num_envs, threads, arguments.seconds)
                figures['ours'][id_][name] = found
                print(f'  {name}: {found}', flush=True)
    if not arguments.no_peers:
        figures['peers'] = peers(arguments.seconds)
        for name, value in figures['peers'].items():
            print(f'{name}: {value:.3f} of raw mj_step of its model')
    if arguments.json:
        files.write_json(figures, arguments.json)
    if arguments.plot:
        plot(figures, arguments.plot)


if __name__ == '__main__':
    begin_script()
    main()
