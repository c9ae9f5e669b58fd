"""Costs and effects of the options of actuators, as tables and plots of docs/realism.md.

    python benchmarks/actuators.py costs      # docs/data/actuators.json: CPU time of each option
    python benchmarks/actuators.py effects    # docs/data/actuators.json: returns of shipped policies
    python benchmarks/actuators.py plots      # docs/pictures/realism/actuators.png, by simulation
    python benchmarks/actuators.py page       # the tables of docs/realism.md

Costs are CPU times of one thread, by `time.thread_time`, so that other programs on the machine disturb
them little; environments with and without an option take turns.
"""

import argparse
import pathlib
import time

import numpy as np
from dm_control import mjcf

from trl_suite import actuation, characters, evaluation, policies, suite
from trl_suite.actuation import realism, series, strength_curves
from trl_suite.describe.options import table_of
from trl_suite.engine import motors
from trl_suite.util import errors, files, tables
from trl_suite.util.program import begin_script
from trl_suite.vector import VectorEnvironment

ROOT = pathlib.Path(__file__).resolve().parents[1]
RESULTS, PAGE = ROOT / 'docs' / 'data' / 'actuators.json', ROOT / 'docs' / 'realism.md'
PICTURE = ROOT / 'docs' / 'pictures' / 'realism' / 'actuators.png'
OPTIONS = {
    'torque_speed': {'torque_speed': True},
    'torque_pose': {'torque_pose': True},
    'delay': {'delay': 20},
    'flex': {'flex': 0.05},
    'backlash': {'backlash': 0.02},
    'noise': {'noise': 0.05},
    'strength': {'strength': (0.8, 1.2)},
}
OPTIONS['all'] = {name: value for each in OPTIONS.values() for name, value in each.items()}
COST_IDS = {
    'biped, planar': 'PD_Biped2D_LLC_Imitate_Flat-v0',
    'biped, 3D': 'PD_Biped3D_Imitate-v0',
    'dog, gait': 'FSM_Dog2D_Terrain_Gaps-v0',
}
EFFECT_IDS = {
    'biped, position': 'PD_Biped2D_LLC_Imitate_Flat-v0',
    'biped, torque': 'Torque_Biped2D_LLC_Imitate_Flat-v0',
    'dog, position': 'PD_Dog2D_LLC_Imitate_Flat-v0',
}
STRENGTHS = {  # three strengths of each option
    'torque_speed': [{'torque_speed': True, 'no_load_speed': v} for v in (20.0, 10.0, 5.0)],
    'torque_pose': [{'torque_pose': True}],
    'delay': [{'delay': d} for d in (10, 20, 40)],
    'flex': [{'flex': f} for f in (0.02, 0.1, 0.3)],
    'backlash': [{'backlash': b} for b in (0.01, 0.05, 0.2)],
    'noise': [{'noise': s} for s in (0.02, 0.1, 0.3)],
    'strength': [{'strength': s} for s in ((0.9, 1.1), (0.7, 1.3), (0.5, 1.5))],
}
ENVS, ROUNDS, STEPS = 16, 9, 8


def fits(id_: str, options: dict[str, object]) -> bool:
    """Returns whether an environment can have these options."""
    try:
        suite.make(id_, task_kwargs={'actuators': options})
    except ValueError:
        return False
    return True


def store(name: str, title: str, row: object, **settings: object) -> None:
    """Stores a row of a table; its other rows are removed if they have other settings."""
    with files.changing(RESULTS) as found:
        others = found.get(name, {})
        same = settings.items() <= others.items()
        found[name] = {**(others if same else settings), title: row}


# Costs.


def cpu(environments: VectorEnvironment, steps: int) -> float:
    """Steps an environment from a start; returns the CPU time per physics step and simulation, us."""
    environments.reset(seed=0)
    action = np.zeros((ENVS, len(environments.action_map)))  # on the clip, without falls
    before, begin = environments.task.world.engine.steps.sum(), time.thread_time()
    for _ in range(steps):
        environments.step(action)
    spent = time.thread_time() - begin
    return 1e6 * spent / float(environments.task.world.engine.steps.sum() - before)


def costs(titles: list[str]) -> None:
    """Measures the time of each option relative to ideal actuators."""
    errors.check_known('title', COST_IDS, *titles)
    for title in titles or COST_IDS:
        id_ = COST_IDS[title]
        made = {}
        for name, options in {'ideal': {}, **OPTIONS}.items():
            if 'gait' in title and 'delay' in options:
                options = {**options, 'delay': realism.GAIT_DELAY}
            own = {key: value for key, value in options.items() if fits(id_, {key: value})}
            if own or not options:
                made[name] = VectorEnvironment(id_, ENVS, 1, seed=0, task_kwargs={'actuators': own})
                made[name].reset()
        times = {name: [] for name in made}
        for _ in range(ROUNDS + 1):  # the first one compiles, and is dropped
            for name, environments in made.items():
                times[name].append(cpu(environments, 1 if 'gait' in title else STEPS))
        median = {name: float(np.median(each[1:])) for name, each in times.items()}
        row = {name: value / median['ideal'] for name, value in median.items()}
        row['ideal'] = median['ideal']
        print(title, row, flush=True)
        store('costs', title, row)


# Effects on shipped policies.


def effects(episodes: int) -> None:
    """Evaluates shipped policies with each option at three strengths."""
    for title, id_ in EFFECT_IDS.items():
        policy = policies.reference(id_)
        ideal = evaluation.evaluate(id_, policy, episodes)['return']
        row: dict[str, object] = {'ideal': ideal}
        for name, strengths in STRENGTHS.items():
            shares = []
            for each in strengths:
                try:
                    found = evaluation.evaluate(
                        id_, policy, episodes, task_kwargs={'actuators': each}
                    )
                except ValueError:  # the character has no such option
                    continue
                shares.append(found['return'] / ideal)
            row[name] = shares
            print(title, name, shares, flush=True)
        store('effects', title, row, episodes=episodes)


# Plots: each panel shows a formula as a line, and what a simulation did as dots.


def fixed(**options: object) -> tuple[characters.Character, mjcf.Physics]:
    """Returns the planar biped with a fixed root, servos and no gravity."""
    given = actuation.Actuators(**options)
    figure = characters.make(realism.body(given, characters.CHARACTERS['biped2d']))
    actuation.add(figure, 'position', 1 / 600)
    series.finish(figure, 1 / 600)
    root = figure.mjcf_model
    root.option.timestep, root.option.integrator = 1 / 600, 'implicitfast'
    root.option.gravity = (0, 0, 0)
    return figure, mjcf.Physics.from_mjcf_model(root)


def speed_panel(axes: object) -> None:
    options = {'torque_speed': True, 'no_load_speed': 10.0}
    environment = suite.build('biped2d', task_kwargs={'actuators': options, 'random': 0})
    environment.reset()
    data, limit = environment.physics.data.ptr, environment.task.character.torque_limits[1]
    dof = environment.physics.model.ptr.joint('biped2d/right_knee').dofadr[0]
    rng, found = np.random.default_rng(0), []
    for _ in range(30):
        action = rng.choice([-1.0, 1.0], len(environment.action_map))
        environment.task.apply_action(action[None], np.array([0]))
        for _ in range(10):
            v = data.qvel[dof]
            environment.task.world.step(1)
            found.append((v, data.actuator('biped2d/right_knee').force[0] / limit))
    v = np.linspace(-15, 15, 301)
    line = [motors.speed_factor(each, 10.0, 1.5) for each in v]
    axes.plot(*np.array(found).T, '.', ms=2, color='0.5', label='knee of a walker')
    axes.plot(v, line, 'C0', v, -np.array(line)[::-1], 'C0', label='limits')
    axes.set(title='torque_speed', xlabel='speed, rad/s', ylabel='torque / limit', xlim=(-15, 15))


def pose_panel(axes: object) -> None:
    for k, joint in enumerate(strength_curves.ANDERSON_2007):
        curve = strength_curves.human(joint)
        sign = -1 if joint == 'knee' else 1
        axes.plot(sign * curve.angle, curve.positive, f'C{k}', label=joint)
        axes.plot(sign * curve.angle, -curve.negative, f'C{k}')
    axes.set(
        title='torque_pose: human', xlabel='flexion, rad', ylabel='limit / peak', xlim=(-1.2, 2.2)
    )
    axes.legend(fontsize=7)


def delay_panel(axes: object) -> None:
    options = {'delay': 40}
    environment = suite.build('biped2d', 'torque', task_kwargs={'actuators': options, 'random': 0})
    environment.reset()
    task, data = environment.task, environment.physics.data.ptr
    rows, rng = [], np.random.default_rng(4)
    for _ in range(8):
        task.apply_action(rng.uniform(-1, 1, (1, len(environment.action_map))), np.array([0]))
        for _ in range(10):
            given = task.world.ctrl[0, 0]
            task.world.step(1)
            rows.append((1000 * data.time, given, data.actuator_force[0]))
    times, given, used = np.array(rows).T
    axes.step(times, given, label='given')
    axes.plot(times, used, '.', ms=2, color='0.3', label='acts')
    axes.set(title='delay: 40 ms', xlabel='time, ms', ylabel='hip torque, N m')
    axes.legend(fontsize=7)


def series_panel(axes: object, name: str, **options: object) -> None:
    figure, physics = fixed(**options)
    model, data = physics.model.ptr, physics.data.ptr
    joint, motor = model.joint(f'right_hip_{name}'), model.joint('right_hip')
    limit, found = figure.torque_limits[0], []
    for torque in limit * 0.1 * np.sin(np.linspace(0, 2.5 * np.pi, 2500)):
        data.qfrc_applied[:] = 0
        data.qfrc_applied[[joint.dofadr[0], motor.dofadr[0]]] = torque  # on the thigh
        physics.step()
        found.append((data.qpos[joint.qposadr[0]], torque))
    axes.plot(*np.array(found).T, '.', ms=2, color='0.5')
    if name == 'flex':
        deflection = np.array([-0.012, 0.012])
        axes.plot(deflection, deflection * limit / options['flex'])
    else:
        for side in (-0.5, 0.5):
            axes.axvline(side * options['backlash'])
    ((option, value),) = options.items()
    axes.set(
        title=f'{option}: {value:g} rad', xlabel='thigh against motor, rad', ylabel='torque, N m'
    )


def noise_panel(axes: object) -> None:
    environment = suite.build('biped2d', task_kwargs={'actuators': {'noise': 0.1}, 'random': 0})
    environment.reset()
    task, data, found = environment.task, environment.physics.data.ptr, []
    dof = environment.physics.model.ptr.joint('biped2d/right_hip').dofadr[0]
    for _ in range(150):
        task.world.step(1)
        found.append((1000 * data.time, data.qfrc_applied[dof] / task.character.torque_limits[0]))
    axes.plot(*np.array(found).T)
    axes.axhspan(-0.1, 0.1, alpha=0.2)
    axes.set(title='noise: 0.1', xlabel='time, ms', ylabel='torque / limit')


def strength_panel(axes: object) -> None:
    environments = VectorEnvironment(
        EFFECT_IDS['biped, position'],
        500,
        1,
        0,
        task_kwargs={'actuators': {'strength': (0.7, 1.3)}},
    )
    environments.reset()
    drawn = [environments.info[f'strength_{side}_knee'] for side in ('right', 'left')]
    axes.plot(*drawn, '.', ms=2)
    axes.set(title='strength: (0.7, 1.3)', xlabel='right knee', ylabel='left knee')


def plots() -> None:
    """Draws a panel for each option."""
    from matplotlib.figure import Figure

    figure = Figure((10, 4.6), layout='constrained')
    axes = figure.subplots(2, 4).ravel()
    speed_panel(axes[0])
    pose_panel(axes[1])
    delay_panel(axes[2])
    series_panel(axes[3], 'flex', flex=0.1)
    series_panel(axes[4], 'play', backlash=0.05)
    noise_panel(axes[5])
    strength_panel(axes[6])
    axes[7].set_axis_off()
    PICTURE.parent.mkdir(parents=True, exist_ok=True)
    with files.replacing(PICTURE) as path:
        figure.savefig(path, dpi=110, format='png')


# The page.


def cost_table(found: dict[str, dict[str, float]]) -> str:
    rows = [
        [name, *(f'{found[title].get(name, np.nan):.2f}'.replace('nan', '-') for title in found)]
        for name in OPTIONS
    ]
    return tables.markdown_table(('option', *found), rows)


def effect_table(found: dict[str, object]) -> str:
    rows = []
    for title, row in found.items():
        if title == 'episodes':
            continue
        cells = [
            ', '.join(f'{share:.2f}' for share in row.get(name, ())) or '-' for name in STRENGTHS
        ]
        rows.append([title, f'{row["ideal"]:.0f}', *cells])
    return tables.markdown_table(('policy', 'return, ideal', *STRENGTHS), rows)


def blocks() -> dict[str, str]:
    """Returns the tables of the page, by their names."""
    found = files.read_json(RESULTS) if RESULTS.exists() else {}
    parts = {'options': tables.markdown([table_of(actuation.Actuators)])}
    if 'costs' in found:
        parts['costs'] = cost_table(found['costs'])
    if 'effects' in found:
        parts['effects'] = effect_table(found['effects'])
    return {name: f'\n{part.strip()}\n' for name, part in parts.items()}


def page() -> None:
    """Writes the tables between their markers."""
    for name, part in blocks().items():
        files.replace_between(PAGE, name, 'benchmarks/actuators.py', part)


if __name__ == '__main__':
    begin_script()
    parser = argparse.ArgumentParser(description=__doc__.split('\n')[0])
    parser.add_argument('what', choices=('costs', 'effects', 'plots', 'page'))
    parser.add_argument('titles', nargs='*', help='for costs: only these columns')
    parser.add_argument('--episodes', type=int, default=24)
    args = parser.parse_args()
    if args.what == 'effects':
        effects(args.episodes)
    elif args.what == 'costs':
        costs(args.titles)
    else:
        {'plots': plots, 'page': page}[args.what]()
