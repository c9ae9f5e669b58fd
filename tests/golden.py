"""Records the outputs of environments, and compares records with current outputs bit by bit.

    python tests/golden.py record FILE [--filter PATTERN]   writes FILE (.npz)
    python tests/golden.py compare FILE [--filter PATTERN]  exit status 1 if anything differs
    python tests/golden.py store tests/golden.json [--filter PATTERN]  expected by the test
    python tests/golden.py check tests/golden.json [--filter PATTERN]  compares without the
                        test, and with an engine that dm_control does not support yet

Only the public interface is used, so that one version of the suite can record and another compare;
PYTHONPATH selects the version. PATTERN selects cases by name, e.g. 'single/*Dog*' or 'option/'.
Cases:

    single/ID       a single environment: random actions, truncated episodes, a state saved in the
                    middle, restored at the end and continued ('repeats': whether it is identical)
    batch/ID        the same with 3 simulations, whose actions are small, medium and large
    option/ID/...   2 simulations with other options, or a combination without an id
    own/ID          2 simulations with custom reward terms, observations and failures
    use/ID/...      other uses of a vector environment: autoreset, subsets, threads, copies, dtypes
    policy/ID       an episode of the shipped policy, or its beginning; 'return': the sum of rewards

The record has the SHA-256 of the bytes, and the numbers, of each quantity of each case. A
comparison reports the first step with a difference (0 is the reset), the difference there, and the
largest. Trajectories are chaotic, so later differences mean little. This applies most to
three-dimensional characters: when a ball joint's servo is at its limit, the last bit decides
whether MuJoCo regards its force as limited, and one step later velocities differ by some rad/s.

Recording or comparing everything takes about five minutes on one core. Environments whose step is a
whole gait cycle or footstep are run for fewer steps.
"""

import argparse
import fnmatch
import hashlib
import json
import pathlib
import pickle
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
AFTER = 10  # number of steps repeated from a saved state
SCALES = (0.1, 0.3, 1.0)  # scale of the actions of the three simulations
LONG_STEPS = (
    'FSM_',
    '_HLC_',
    '/gait',
    '/goal_navigation',
    '/soccer',
)  # steps of gait cycles and footsteps, of up to 0.5 s
FAMILIES = (
    'PD_Biped2D_Gaps_Terrain-v0', 'MTU_Raptor2D_LLC_Imitate_Flat-v0', 'FSM_Dog2D_Terrain_Mixed-v0',
    'PD_Biped3D_Imitate-Hills_Terrain-v0', 'PD_Biped3D_LLC_Trail_Step-v0',
    'PD_Biped2D_LLC_Flat_Step-v0', 'PD_Biped3D_HLC_DynamicsObstacles-v0', 'PD_Biped3D_HLC_Soccer-v0',
    'PD_Biped3D_Terrain_Forest_Hard-v0', 'PD_Biped3D_Terrain_Soccer_Hard-v0',
)  # fmt: skip
OPTIONS = {  # an id, or the arguments of `suite.combine` -> options
    'PD_Biped2D_Gaps_Terrain-v0': (
        {'terrain_observation': 0}, {'terrain_observation': 20, 'reference_observation': True}, {'substeps': 4},
        {'action_offset': 'posture'}, {'action_offset': 'original'}, {'action_scale': 0.7}, {'start_phase': 0.25},
        {'start_phase': ((0.1, 0.2), (0.6, 0.9))}, {'spawn': 'upstream'}, {'time_limit': 0.3},
    ),
    'PD_Dog2D_Slopes_Mixed_Terrain-v0': ({'reference_observation': True}, {'terrain_observation': 100}),
    'PD_Raptor2D_Steps_Terrain-v0': ({'action_offset': 'posture', 'reference_observation': True},),
    'MTU_Biped2D_LLC_Imitate_Flat-v0': ({'reference_observation': False}, {'terrain_observation': 50}),
    'MTU_Raptor2D_LLC_Imitate_Flat-v0': ({'muscle_set': 'run'}, {'substeps': 20}),
    'Torque_Dog2D_LLC_Imitate_Flat-v0': ({'reference_observation': False, 'terrain_observation': 10},),
    'Vel_Biped2D_LLC_Imitate_Flat-v0': ({'reference_observation': False}, {'substeps': 10, 'start_phase': 0.0}),
    'FSM_Dog2D_Terrain_Mixed-v0': (
        {'interface': 'base_action'}, {'substeps': 4}, {'spawn': 'upstream'}, {'start_noise': 0.02},
    ),
    'FSM_Biped2D_Terrain_Slopes-v0': ({'interface': 'base_action', 'start_noise': 0.01},),
    'FSM_Hopper2D_Terrain_Gaps-v0': ({'substeps': 1},),
    'PD_Biped3D_Imitate-v0': (
        {'reference_observation': True}, {'mirrored': True}, {'substeps': 20},
        {'action_offset': 'posture'}, {'action_offset': 'original'}, {'action_scale': 0.7}, {'start_phase': 0.6},
        {'terrain_observation': 'height'}, {'time_limit': 0.3},
    ),
    'PD_Biped3D_Imitate-Stairs-v0': ({'terrain_observation': 'height', 'mirrored': True},),
    'PD_Biped3D_LLC_General_Step-v0': (
        {'mirrored': True}, {'plans': {'from_root': 1.0}}, {'plans': {'from_root': 0.5, 'sharp': 0.5}},
        {'goal': True}, {'max_landing_error': 0.1, 'grace_period': 0.2}, {'footstep_scale': 4.0, 'heading_scale': 2.0},
        {'pushes': {'force': (80, 120), 'duration': (0.1, 0.3), 'interval': (0.1, 0.3)}},
        {'terrain_observation': 'height'}, {'start_phase': ((0.0, 0.1), (0.5, 0.6))},
    ),
    'PD_Biped3D_LLC_Trail_Step-v0': ({'mirrored': True, 'plans': {'length': (0.3, 0.6)}},),
    'PD_Biped2D_LLC_Flat_Step-v0': (
        {'plans': {'length': (0.25, 0.6), 'change': 1.0}, 'max_landing_error': 0.5}, {'terrain_observation': 50},
        {'footstep_scale': 4.0}, {'start_phase': 0.0, 'substeps': 5},
    ),
    'PD_Biped3D_HLC_Forest-v0': (
        {'goal_distance': (3, 5), 'goal_reached': 2.0}, {'start_phases': (0.0, 0.1, 0.6)},
        {'step_length': 0.3, 'target_speed': 0.5}, {'terrain_observation': ()}, {'substeps': 20},
    ),
    'PD_Biped3D_HLC_DynamicsObstacles-v0': (
        {'terrain_observation': ('height', 'velocity')}, {'terrain_observation': ('velocity',)},
        {'interface': 'frame', 'terrain_observation': ('height', 'velocity')},
    ),
    'PD_Biped3D_HLC_Soccer-v0': (
        {'interface': 'frame'}, {'goal_distance': (1, 2)}, {'terrain_observation': ('height',)},
    ),
    'PD_Biped3D_Terrain_Trail_Hard-v0': (
        {'reward': 'original'}, {'terrain_observation': ()}, {'goal_reached': 3.0},
    ),
    'PD_Biped3D_Terrain_Soccer_Hard-v0': ({'terrain_observation': 'height', 'goal_reached': 2.0},),
    ('biped3d', 'torque'): ({}, {'reference_observation': True}),
    ('biped3d', 'velocity', 'hills3d'): ({},),
    ('biped3d', 'position', 'conveyor3d_wide'): ({'start_phase': 0.1},),
    ('biped3d_full_mocap',): ({'action_offset': 'original'},),
    ('biped3d_mocap', 'position', 'stairs3d', 'footsteps'): ({'terrain_observation': 'height'},),
    ('biped2d', 'torque', 'gaps', 'walk'): ({'terrain_observation': 50},),
    ('dog', 'muscle', 'slopes_mixed', 'walk'): ({'terrain_observation': 50},),
    ('biped3d_full_mocap', 'position', 'hills3d', 'walk'): ({'terrain_observation': 'height'},),
    ('biped2d', 'muscle', 'gaps_curriculum'): ({'terrain_level': 0.5}, {'terrain_level': 0.9}),
    ('goat', 'position', 'cliffs_rugged'): ({},),
    ('raptor', None, 'slopes_blend', 'gait'): ({'terrain_level': 0.3},),
}  # fmt: skip
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

    def time_step(self, time_step, environment):
        self.add('observation', time_step.observation['observations'])
        for name in ('reward', 'discount'):
            value = getattr(time_step, name)
            self.add(name, np.nan if value is None else value)
        self.add('step_type', int(time_step.step_type))
        self.add('info', environment.info)

    def batch_reset(self, observation, environments):
        self.add('observation', observation)
        self.add('info', environments.info)

    def batch_step(self, step):
        for name, value in step._asdict().items():
            self.add(name, value)

    def arrays(self):
        return {name: np.stack(values) for name, values in self.found.items()}


def is_long(name):
    return any(part in name for part in LONG_STEPS)


def drawn(name, *shape):
    """Returns random actions in [-1, 1], which differ between cases."""
    return np.random.default_rng(zlib.crc32(name.encode())).uniform(-1, 1, shape)


def repeats(first, again):
    """Returns whether quantities are equal, by step."""
    same = {
        name: [np.array_equal(a, b, equal_nan=True) for a, b in zip(first[name], values, strict=False)]
        for name, values in again.items()
    }  # fmt: skip
    return np.all(list(same.values()), axis=0).astype(float)


# Cases: functions that return arrays by name, with one row per step.


def single(name, id_):
    steps = 24 if is_long(id_) else 100
    options = {'random': SEED, 'step_limit': steps * 3 // 5}
    environment = suite.make(id_, options, {'flat_observation': True})
    actions = 0.2 * drawn(name, steps, len(environment.action_map))
    log, half = Log(), steps // 2
    log.time_step(environment.reset(), environment)
    for i, action in enumerate(actions):
        if i == half:
            state = pickle.dumps(environment.get_state())
        log.time_step(environment.step(action), environment)
    environment.set_state(pickle.loads(state))
    again = Log()
    for action in actions[half:][: 4 if is_long(id_) else AFTER]:
        again.time_step(environment.step(action), environment)
    environment.close()
    found = log.arrays()
    later = {key: values[half + 1 :] for key, values in found.items()}
    return {**found, 'repeats': repeats(later, again.arrays())}


def batch(name, environment, n=3, options=None, steps=None):
    steps = steps or (9 if is_long(name) else 100)
    environments = VectorEnvironment(
        environment, n, 1, SEED, step_limit=steps * 3 // 5, task_kwargs=options
    )
    actions = drawn(name, steps, n, len(environments.action_map))
    actions *= np.reshape(SCALES[:n], (n, 1))
    log, half = Log(), steps // 2
    log.batch_reset(environments.reset(), environments)
    for i, action in enumerate(actions):
        if i == half:
            state = pickle.dumps(environments.get_state())
        log.batch_step(environments.step(action))
    environments.set_state(pickle.loads(state))
    again = Log()
    for action in actions[half:][: 4 if is_long(name) else AFTER]:
        again.batch_step(environments.step(action))
    environments.close()
    found = log.arrays()
    later = {
        key: values[half + (key == 'observation' or key.startswith('info')) :]
        for key, values in found.items()
    }
    return {**found, 'repeats': repeats(later, again.arrays())}


def option(name, environment, options):
    if not isinstance(environment, str):
        environment = suite.combine(*environment)
    return batch(name, environment, 2, options, 6 if is_long(name) else 40)


def own(name, id_):
    return option(name, id_, PARTS)


def same_step(name, id_):
    environments = VectorEnvironment(id_, 3, 1, SEED, autoreset='same_step', step_limit=5)
    log = Log()
    log.batch_reset(environments.reset(), environments)
    for action in drawn(name, 12, 3, len(environments.action_map)):
        log.batch_step(environments.step(action))
    environments.close()
    return log.arrays()


def some_rows(name, id_):
    """Steps and resets of some simulations, by index and by mask, with and without new seeds."""
    environments = VectorEnvironment(id_, 4, 1, SEED, autoreset='disabled', step_limit=8)
    log, size = Log(), len(environments.action_map)
    log.batch_reset(environments.reset(), environments)
    for i, action in enumerate(drawn(name, 12, 4, size)):
        rows = [[0, 2], np.array([True, False, True, True]), None][i % 3]
        step = environments.step(0.3 * action, rows)
        log.batch_step(step)
        ended = step.terminated | step.truncated
        if ended.any():
            log.batch_reset(environments.reset(ended), environments)
        if i == 5:
            log.batch_reset(environments.reset([1, 2], seed=9), environments)
    environments.close()
    return log.arrays()


def threads(name, id_):
    """More simulations than one thread steps at a time."""
    environments = VectorEnvironment(id_, 13, 2, list(range(13)), step_limit=6)
    log = Log()
    log.batch_reset(environments.reset(), environments)
    for action in drawn(name, 3 if is_long(id_) else 15, 13, len(environments.action_map)):
        log.batch_step(environments.step(0.5 * action))
    environments.close()
    return log.arrays()


def copies(name, id_):
    """Simulations that continue from the states of another vector environment."""
    first, second = (VectorEnvironment(id_, n, 1, n) for n in (3, 4))
    first.reset(), second.reset()
    actions, log = drawn(name, 10, 4, len(first.action_map)), Log()
    for action in actions[:5]:
        first.step(0.2 * action[:3])
    second.copy_from(first, [2, 0], [1, 3])
    for action in actions[5:]:
        log.batch_step(second.step(0.2 * action))
    first.close(), second.close()
    return log.arrays()


def halves(name, id_):
    """Single precision, observation blocks, and a step limit."""
    environments = VectorEnvironment(
        id_, 2, 1, SEED, dtype=np.float32, flat_observation=False, task_kwargs={'time_limit': 0.4}
    )
    log = Log()
    log.batch_reset(environments.reset(), environments)
    for action in drawn(name, 14, 2, len(environments.action_map)):
        log.batch_step(environments.step(0.3 * action))
    environments.close()
    return log.arrays()


def policy(name, id_):
    environment, act = suite.make(id_, {'random': SEED}), policies.reference(id_)
    time_step, log = environment.reset(), Log()
    for _ in range(12 if is_long(id_) else 150):
        time_step = environment.step(act(time_step.observation))
        log.add(
            'observation', np.concatenate([np.ravel(x) for x in time_step.observation.values()])
        )
        log.add('reward', time_step.reward)
        log.add('discount', time_step.discount)
        if time_step.last():
            break
    environment.close()
    found = log.arrays()
    return {**found, 'return': found['reward'].sum(keepdims=True)}


def all_cases():
    """Returns all cases: functions without arguments by name."""
    listed = []
    for kind in (single, batch):
        listed += [(kind, f'{kind.__name__}/{id_}', id_) for id_ in suite.ALL_IDS]
    for environment, variants in OPTIONS.items():
        base = environment if isinstance(environment, str) else '/'.join(map(str, environment))
        listed += [(option, f'option/{base}/{v}', environment, v) for v in variants]
    for character, presets in (('biped2d', terrain.PRESETS), ('biped3d', terrain.PRESETS3D)):
        listed += [
            (option, f'option/{character}/position/{preset}', (character, 'position', preset), {})
            for preset in presets
        ]
    listed += [(own, f'own/{id_}', id_) for id_ in FAMILIES]
    for kind in (same_step, some_rows, threads, copies, halves):
        listed += [(kind, f'use/{id_}/{kind.__name__}', id_) for id_ in FAMILIES]
    listed += [(policy, f'policy/{id_}', id_) for id_ in policies.available()]
    return {name: lambda f=f, name=name, rest=rest: f(name, *rest) for f, name, *rest in listed}


# Recording and comparing.


def chosen(pattern):
    return {n: case for n, case in all_cases().items() if fnmatch.fnmatch(n, f'*{pattern}*')}


def digest(array):
    return hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()


def versions():
    return {
        'mujoco': mujoco.mj_versionString(), 'numpy': np.__version__,
        'python': platform.python_version(), 'machine': platform.machine(),
    }  # fmt: skip


def record(path, pattern):
    arrays, hashes = {}, {}
    for name, case in tqdm(chosen(pattern).items(), mininterval=5):
        try:
            found = case()
        except Exception as error:
            raise RuntimeError(name) from error
        for quantity, array in found.items():
            key = f'{name}|{quantity}'
            arrays[key], hashes[key] = array, digest(array)
    text = json.dumps({'versions': versions(), 'hashes': hashes})
    with open(path, 'wb') as file:
        np.savez_compressed(file, golden=np.array(text), **arrays)
    print(f'{len(hashes)} quantities of {len(chosen(pattern))} cases in {path}')


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
        text = json.loads(str(stored['golden']))
        if text['versions'] != versions():
            print(f'recorded with {text["versions"]}, compared with {versions()}')
        hashes, recorded = text['hashes'], {}
        for key in hashes:
            name, quantity = key.rsplit('|', 1)
            recorded.setdefault(name, []).append(quantity)
        asked, counts = chosen(pattern), {'equal': 0, 'different': 0, 'failed': 0}
        for name in asked.keys() - recorded.keys():
            print(f'{name}: not in the record')
        for name, quantities in recorded.items():
            if not fnmatch.fnmatch(name, f'*{pattern}*'):
                continue
            try:
                found = asked[name]()
            except Exception as error:  # reported, so that the other cases are still compared
                print(f'{name}: {type(error).__name__}: {error}', flush=True)
                counts['failed'] += 1
                continue
            lines = [f'{quantity}: is missing' for quantity in quantities if quantity not in found]
            for quantity, array in found.items():
                key = f'{name}|{quantity}'
                if quantity not in quantities:
                    lines.append(f'{quantity}: not in the record')
                elif digest(array) != hashes[key]:
                    lines.append(f'{quantity}: {told(stored[key], array)}')
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
