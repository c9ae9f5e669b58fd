"""Records the outputs of environments, and compares records with current outputs bit by bit.

    python tests/golden.py record FILE [--filter PATTERN]   writes FILE (.npz)
    python tests/golden.py compare FILE [--filter PATTERN]  exit status 1 if anything differs
    python tests/golden.py store tests/golden.json [--filter PATTERN]  expected by the test
    python tests/golden.py check tests/golden.json [--filter PATTERN]  compares without the
                        test, and with an engine that dm_control does not support yet

Only the public interface is used, so that one version of the suite can record and another compare;
PYTHONPATH selects the version. PATTERN selects cases by name, e.g. 'batch/*Dog*' or 'option/'.
Cases:

    batch/ID        3 simulations with small, medium and large actions, episodes that end and begin
                    again; single environments, threads, copies and saved states equal them, as the
                    tests assert
    option/ID/...   2 simulations with other options, or a combination without an id
    policy/ID       an episode of the shipped policy, or its beginning; 'return': the sum of rewards

The record has the numbers of each quantity of each case. A comparison reports the first step with a
difference, the difference there, and the largest. Trajectories are chaotic, so later differences mean little. This applies most to
three-dimensional characters: when a ball joint's servo is at its limit, the last bit decides
whether MuJoCo regards its force as limited, and one step later velocities differ by some rad/s.

Recording or comparing everything takes about five minutes on one core. Environments whose step is a
whole gait cycle or footstep are run for fewer steps.
"""

import argparse
import fnmatch
import json
import pathlib
import platform
import sys
import zlib

import mujoco
import numpy as np
from dm_control.mujoco.wrapper.mjbindings.sizes import array_sizes
from tqdm import tqdm

from trl_suite import policies, suite, terrain
from trl_suite.tasks import parts
from trl_suite.vector import VectorEnvironment

SEED = 5
SCALES = (0.1, 0.3, 1.0)  # scale of the actions of the three simulations
# Steps of gait cycles and footsteps, of up to 0.5 s.
LONG_STEPS = ('FSM_', '_HLC_', '/gait', '/goal_navigation', '/soccer')
FAMILIES = (
    'PD_Biped2D_Gaps_Terrain-v0', 'MTU_Raptor2D_LLC_Imitate_Flat-v0', 'FSM_Dog2D_Terrain_Mixed-v0',
    'PD_Biped3D_Imitate-Hills_Terrain-v0', 'PD_Biped3D_LLC_Trail_Step-v0',
    'PD_Biped2D_LLC_Flat_Step-v0', 'PD_Biped3D_HLC_DynamicsObstacles-v0', 'PD_Biped3D_HLC_Soccer-v0',
    'PD_Biped3D_Terrain_Forest_Hard-v0', 'PD_Biped3D_Terrain_Soccer_Hard-v0',
)  # fmt: skip
OPTIONS = (  # an id or the arguments of `suite.combine`, options; beside those of state_test
    ('PD_Biped2D_Gaps_Terrain-v0', {
        'terrain_observation': 20, 'reference_observation': True, 'substeps': 4, 'action_offset': 'posture',
        'start_phase': ((0.1, 0.2), (0.6, 0.9)), 'spawn': 'upstream',
    }),
    ('PD_Biped2D_Gaps_Terrain-v0', {
        'terrain_observation': 0, 'action_offset': 'original', 'time_limit': 0.3,
    }),
    ('MTU_Biped2D_LLC_Imitate_Flat-v0', {'reference_observation': False, 'terrain_observation': 50}),
    ('MTU_Raptor2D_LLC_Imitate_Flat-v0', {'muscle_set': 'run', 'substeps': 20}),
    ('Torque_Dog2D_LLC_Imitate_Flat-v0', {'reference_observation': False, 'terrain_observation': 10}),
    ('Vel_Biped2D_LLC_Imitate_Flat-v0', {'substeps': 10, 'start_phase': 0.0}),
    ('FSM_Dog2D_Terrain_Mixed-v0', {'substeps': 4, 'spawn': 'upstream', 'start_noise': 0.02}),
    ('FSM_Hopper2D_Terrain_Gaps-v0', {'substeps': 1}),
    ('PD_Biped3D_Imitate-v0', {
        'reference_observation': True, 'substeps': 20, 'action_offset': 'posture', 'start_phase': 0.6,
        'action_scale': 0.7, 'terrain_observation': 'height', 'time_limit': 0.3,
    }),
    ('PD_Biped3D_LLC_General_Step-v0', {
        'plans': {'from_root': 0.5, 'sharp': 0.5}, 'footstep_scale': 4.0, 'heading_scale': 2.0,
        'max_landing_error': 0.1, 'grace_period': 0.2, 'start_phase': ((0.0, 0.1), (0.5, 0.6)),
        'pushes': {'force': (80, 120), 'duration': (0.1, 0.3), 'interval': (0.1, 0.3)},
    }),
    ('PD_Biped2D_LLC_Flat_Step-v0', {
        'terrain_observation': 50, 'footstep_scale': 4.0, 'start_phase': 0.0, 'substeps': 5,
    }),
    ('PD_Biped3D_HLC_Forest-v0', {
        'goal_distance': (3, 5), 'goal_reached': 2.0, 'start_phases': (0.0, 0.1, 0.6), 'step_length': 0.3,
        'target_speed': 0.5, 'terrain_observation': (), 'substeps': 20,
    }),
    ('PD_Biped3D_HLC_DynamicsObstacles-v0', {'terrain_observation': ('velocity',)}),
    ('PD_Biped3D_HLC_Soccer-v0', {'goal_distance': (1, 2), 'terrain_observation': ('height',)}),
    ('PD_Biped3D_HLC_Soccer-v0', {
        'controller': [f'PD_Biped3D_LLC_{name}_Step-v0' for name in ('General', 'HighKnees', 'Stand')],
    }),
    ('PD_Biped3D_Terrain_Trail_Hard-v0', {'reward': 'original', 'terrain_observation': ()}),
    ('PD_Biped3D_Terrain_Trail_Hard-v0', {'goal_reached': 3.0}),
    ('PD_Biped3D_Terrain_Soccer_Hard-v0', {'terrain_observation': 'height', 'goal_reached': 2.0}),
    (('biped3d', 'torque'), {'reference_observation': True}), (('biped3d', 'velocity', 'hills3d'), {}),
    (('biped3d_full_mocap',), {'action_offset': 'original'}),
    (('biped2d', 'torque', 'gaps', 'walk'), {'terrain_observation': 50}),
    (('dog', 'muscle', 'slopes_mixed', 'walk'), {'terrain_observation': 50}),
    (('biped3d_full_mocap', 'position', 'hills3d', 'walk'), {'terrain_observation': 'height'}),
    (('biped2d', 'muscle', 'gaps_curriculum'), {'terrain_level': 0.5}),
    (('raptor', None, 'slopes_blend', 'gait'), {'terrain_level': 0.3}),
)  # fmt: skip
PARTS = {
    'rewards': {'fast': (0.5, parts.speed), 'lazy': (-0.1, parts.effort)},
    'observations': {'upright': (1, parts.upright), 'rates': (2, lambda t: parts.joint_rates(t)[:, :2])},
    'failures': {'low': lambda task: parts.height(task) < 0.4},
}  # fmt: skip
# Settings of the stored test.
STEPS, LONG = (0, 1, 5, 20), (0, 1, 2)
TOLERANCE = 1e-6
NUDGE = (
    1e-12  # action changes that must not matter, much larger than differences between processors
)
NUDGES = 8
SEEDS = 100


class Log:
    """Arrays with the quantities of each step, by name."""

    def __init__(self):
        self.found = {}

    def add(self, name, value):
        if isinstance(value, dict):
            for key, part in value.items():
                self.add(f'{name}.{key}', part)
        else:
            self.found.setdefault(name, []).append(np.array(value, float))

    def arrays(self):
        return {name: np.stack(values) for name, values in self.found.items()}


def is_long(name):
    return any(part in name for part in LONG_STEPS)


def drawn(name, *shape):
    """Returns random actions in [-1, 1], which differ between cases."""
    return np.random.default_rng(zlib.crc32(name.encode())).uniform(-1, 1, shape)


# Cases: functions that return arrays by name, with one row per step.


def batch(name, environment, n=3, options=None, steps=100):
    if type(environment) is tuple:
        environment = suite.combine(*environment)
    steps = 9 if is_long(name) else steps
    environments = VectorEnvironment(
        environment, n, 1, SEED, step_limit=steps * 3 // 5, task_kwargs=options
    )
    actions = drawn(name, steps, n, len(environments.action_map))
    log = Log()
    log.add('reset', {'observation': environments.reset(), 'info': environments.info})
    for action in np.reshape(SCALES[:n], (n, 1)) * actions:
        log.add('step', environments.step(action)._asdict())
    environments.close()
    return log.arrays()


def policy(name, id_):
    environment, act = suite.make(id_, {'random': SEED}), policies.reference(id_)
    time_step, log = environment.reset(), Log()
    for _ in range(12 if is_long(id_) else 150):
        time_step = environment.step(act(time_step.observation))
        log.add('step', {**time_step.observation, 'reward': time_step.reward})
        if time_step.last():
            break
    environment.close()
    found = log.arrays()
    return {**found, 'return': found['step.reward'].sum(keepdims=True)}


def all_cases():
    """Returns all cases: functions without arguments by name."""
    from state_test import VARIANTS  # which the comparison with another engine does not need

    listed = [(batch, f'batch/{id_}', id_) for id_ in suite.ALL_IDS]
    characters = {'biped2d': terrain.PRESETS, 'biped3d': terrain.PRESETS3D}
    for environment, options in (
        *OPTIONS, *(each for each in VARIANTS if 'rewards' not in each[1]),
        *(((name, 'position', preset), {}) for name, presets in characters.items() for preset in presets),
        *((id_, PARTS) for id_ in FAMILIES),
    ):  # fmt: skip
        base = '/'.join(map(str, environment)) if type(environment) is tuple else environment
        name = f'option/{getattr(base, "id", base)}/{"parts" if options is PARTS else options}'
        listed.append((batch, name, environment, 2, options, 40))
    listed += [(policy, f'policy/{id_}', id_) for id_ in policies.available()]
    return {name: lambda f=f, name=name, rest=rest: f(name, *rest) for f, name, *rest in listed}


# Recording and comparing.


def chosen(pattern):
    return {n: case for n, case in all_cases().items() if fnmatch.fnmatch(n, f'*{pattern}*')}


def versions():
    return {
        'mujoco': mujoco.mj_versionString(), 'numpy': np.__version__,
        'python': platform.python_version(), 'machine': platform.machine(),
    }  # fmt: skip


def record(path, pattern):
    arrays = {}
    for name, case in tqdm(chosen(pattern).items(), mininterval=5):
        try:
            arrays |= {f'{name}|{quantity}': array for quantity, array in case().items()}
        except Exception as error:
            raise RuntimeError(name) from error
    with open(path, 'wb') as file:
        np.savez_compressed(file, versions=json.dumps(versions()), **arrays)
    print(f'{len(arrays)} quantities in {path}')


def told(expected, found):
    """Returns a description of the difference of two arrays with one row per step."""
    if expected.shape != found.shape:
        return f'shape {found.shape} instead of {expected.shape}'
    differ = ~((expected == found) | (np.isnan(expected) & np.isnan(found)))
    if not differ.any():
        return 'only the signs of zeros differ'
    steps = differ.reshape(len(differ), -1).any(1)
    first = int(steps.argmax())
    size = np.abs(expected - found)
    size[~differ] = 0.0
    return (
        f'from step {first} of {len(steps) - 1} on, there by {np.nanmax(size[first]):.1e}, '
        f'at most by {np.nanmax(size):.1e}'
    )


def compare(path, pattern):
    """Prints a line for each case; returns whether all recorded quantities are equal."""
    with np.load(path) as stored:
        made_with, asked, recorded = json.loads(str(stored['versions'])), chosen(pattern), {}
        if made_with != versions():
            print(f'recorded with {made_with}, compared with {versions()}')
        for key in stored.files[1:]:
            name, quantity = key.rsplit('|', 1)
            recorded.setdefault(name, []).append(quantity)
        counts = {'equal': 0, 'different': 0, 'failed': 0}
        for name in asked.keys() - recorded.keys():
            print(f'{name}: not in the record')
        for name in fnmatch.filter(recorded, f'*{pattern}*'):
            try:
                found = asked[name]()
            except Exception as error:  # reported, so that the other cases are still compared
                print(f'{name}: {type(error).__name__}: {error}', flush=True)
                counts['failed'] += 1
                continue
            kept = {quantity: stored[f'{name}|{quantity}'] for quantity in recorded[name]}
            lines = [f'{quantity}: is missing or new' for quantity in kept.keys() ^ found.keys()]
            for quantity in kept.keys() & found.keys():
                if kept[quantity].tobytes() != found[quantity].tobytes():
                    lines.append(f'{quantity}: {told(kept[quantity], found[quantity])}')
            counts['different' if lines else 'equal'] += 1
            print('\n    '.join([f'{name}: {"differs" if lines else "equal"}', *lines]), flush=True)
    print(', '.join(f'{count} {word}' for word, count in counts.items()))
    return not counts['different'] and not counts['failed']


# Expected values of the test, which are valid on any processor.


def summary(id_, seed, nudge=0.0, environment=None):
    """Returns the rewards and a weighted sum of each observation block of a few early steps.

    Args:
      id_: id of the environment.
      seed: seed of the environment and of the actions.
      nudge: size of random changes of the actions.
      environment: made by `summarised(id_)`, for repeated use.
    """
    environment = environment or summarised(id_)
    environment.random_state.seed(seed)
    draw, nudges = np.random.default_rng(seed), np.random.default_rng()
    CONTROLLER.nudge, CONTROLLER.draw = nudge, nudges
    steps, size = LONG if is_long(id_) else STEPS, len(environment.action_map)
    time_step, found = environment.reset(), {'reward': []}
    for i in range(steps[-1] + 1):
        if i:
            action = 0.1 * draw.uniform(-1, 1, size)
            time_step = environment.step(action + nudge * nudges.standard_normal(size))
        if i in steps:
            found['reward'].append(float(time_step.reward or 0.0))
            for block, value in time_step.observation.items():
                weights = 1.0 + np.arange(value.size) / value.size
                found.setdefault(block, []).append(float(weights @ value.ravel()))
    return found


class Controller:
    """Holds the mean pose; a network would give different results on different processors."""

    nudge, draw = 0.0, None

    def __call__(self, observation):
        shape = len(observation), 17
        return self.nudge * self.draw.standard_normal(shape) if self.nudge else np.zeros(shape)


CONTROLLER = Controller()


def summarised(id_):
    """Makes the environment for a summary."""
    options = {'controller': CONTROLLER} if '_HLC_' in id_ else {}
    return suite.make(id_, {'random': 0, **options})


def store(path, pattern=''):
    """Writes summaries of the first steps, as far as small changes of the actions do not matter.

    Of some seeds, the first one with which this holds for all steps is used, or else the one with
    the most steps. With a pattern the entries of other environments are kept.
    """
    file = pathlib.Path(path)
    stored = json.loads(file.read_text()) if pattern else {}
    for id_ in tqdm(fnmatch.filter(suite.ALL_IDS, f'*{pattern}*'), mininterval=5):
        environment, best, wanted = summarised(id_), 0, len(LONG if is_long(id_) else STEPS)
        for seed in range(SEEDS):
            expected, count = summary(id_, seed, 0.0, environment), wanted
            for _ in range(NUDGES):
                count = min(count, agreeing(expected, summary(id_, seed, NUDGE, environment)))
                if count <= best:
                    break
            else:
                best = count
                rounded = {k: [float(f'{x:.12g}') for x in v[:best]] for k, v in expected.items()}
                stored[id_] = {'seed': seed, **rounded}
            if best == wanted:
                break
        environment.close()
    lines = ',\n'.join(f' {json.dumps(id_)}: {json.dumps(value)}' for id_, value in stored.items())
    file.write_text(f'{{\n{lines}\n}}\n')


def agreeing(expected, found):
    """Returns the number of first steps in which two summaries agree within the tolerance."""
    near = [
        np.isclose(found[name], values, TOLERANCE / 100, TOLERANCE / 100)
        for name, values in expected.items()
    ]
    return int(np.logical_and.accumulate(np.all(near, axis=0)).sum())


def check(path, pattern):
    """Prints in which environments the first steps differ from the stored ones, and from where.

    Returns whether there is no such environment.
    """
    lacks = unsupported()
    print(f'{versions()}; dm_control knows, but MuJoCo lacks: {", ".join(lacks) or "nothing"}')
    stored, counts = json.loads(pathlib.Path(path).read_text()), {'equal': 0, 'different': 0}
    for id_ in fnmatch.filter(stored, f'*{pattern}*'):
        seed, steps = stored[id_].pop('seed'), LONG if is_long(id_) else STEPS
        try:
            found = summary(id_, seed)
            lines = [
                f'{name}: by {abs(b - a):.1e} in step {step}'
                for name, values in stored[id_].items()
                for step, a, b in zip(steps, values, found[name], strict=False)
                if not np.isclose(a, b, TOLERANCE, TOLERANCE)
            ]
        except Exception as error:  # reported, so that the other environments are still checked
            lines = [f'{type(error).__name__}: {error}']
        counts['different' if lines else 'equal'] += 1
        if lines:
            print('\n    '.join([id_, *lines]), flush=True)
    print(', '.join(f'{count} {word}' for word, count in counts.items()))
    return not counts['different']


def unsupported():
    """Removes fields that this engine lacks from dm_control's table; returns their names."""
    model = mujoco.MjModel.from_xml_string('<mujoco/>')
    missing = []
    for struct in (model, mujoco.MjData(model)):
        table = array_sizes[type(struct).__name__.lower()]
        lacking = [name for name in table if not hasattr(struct, name)]
        missing += [f'{type(struct).__name__}.{name}' for name in lacking]
        for name in lacking:
            del table[name]
    return missing


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('command', choices=('record', 'compare', 'store', 'check'))
    parser.add_argument('file')
    parser.add_argument('--filter', default='', metavar='PATTERN')
    arguments = parser.parse_args()
    if arguments.command == 'store':
        store(arguments.file, arguments.filter)
    elif arguments.command == 'check':
        sys.exit(not check(arguments.file, arguments.filter))
    elif arguments.command == 'record':
        record(arguments.file, arguments.filter)
    else:
        sys.exit(not compare(arguments.file, arguments.filter))


if __name__ == '__main__':
    main()
