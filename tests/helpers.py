"""Shared by test modules: environments, access to simulations, checks of simulations and states."""

import ctypes
import gc
import json
import os
import pathlib
import pickle
import tempfile
from unittest import mock

import numpy as np
from absl.testing import parameterized

from trl_suite import suite, terrain
from trl_suite.engine import world
from trl_suite.registry import catalogue
from trl_suite.terrain.spatial import windows
from trl_suite.vector import VectorEnvironment

# The first id of each task type with each character: for what depends on nothing else.
KINDS = tuple(
    {(spec.task_type, spec.character): spec.id for spec in reversed(catalogue.SPECS)}.values()
)
LONG = ('gait', 'goal_navigation', 'soccer')  # task types whose steps last many control steps
RIGHT, LEFT = 0, 1
EVERY_PROPERTY = {  # all of a world that can be varied
    'friction': (0.4, 1.2), 'mass': (0.8, 1.2), 'link_mass': (0.9, 1.1), 'inertia': (0.9, 1.1),
    'com_offset': (0.0, 0.03), 'damping': (0.5, 2.0), 'gravity': (9.0, 10.5), 'slope': (-0.05, 0.05),
    'contact_depth': (0.001, 0.01), 'contact_time': (0.005, 0.02),
    'push': {'force': (50, 200), 'duration': (0.02, 0.2), 'interval': (0.0, 0.3)},
}  # fmt: skip
EVERY_MOTOR = {  # what can be varied of motors
    'torque_speed': True, 'no_load_speed': 8.0, 'strength': (0.7, 1.3), 'noise': 0.1, 'delay': (0, 60),
    'torque_pose': True, 'flex': 0.05, 'backlash': 0.02,
}  # fmt: skip
ONE_OF_EACH = tuple({spec.task_type: spec.id for spec in catalogue.SPECS}.values())  # task type
STEP_WEIGHTS = {  # of the reward of footsteps
    name: weight / 1.05
    for name, weight in (
        ('pose', 0.5), ('velocity', 0.05), ('end_effector', 0.2), ('com', 0.1), ('root', 0.1),
        ('heading', 0.1),
    )
}  # fmt: skip


# Environments.

MOST_KEPT = 24  # 10 to 20 MB each
_kept = {}  # arguments -> environment, test that used it last, options (whose objects stay alive)


def users_arena(timestep=0.002):
    """A level arena that is none of the suite; those of dm_control.locomotion need labmaze."""
    from dm_control import composer  # after trl_suite, which imports Triton before it

    arena = composer.Arena(name='mine')
    arena.mjcf_model.option.timestep = timestep
    arena.mjcf_model.worldbody.add('geom', name='floor', type='plane', size=(0, 0, 1))
    return arena


def made(*parts, seed=0, flat=False, **options):
    """Returns an environment before its first reset, as if newly made.

    It is kept for the next tests of the file, as building takes most of the time of most tests;
    seeding restores the state of a new one. A test that changes more than the state of the
    simulation must make its own.

    Args:
      *parts: id or specification, or character, actuation, terrain and task.
      seed: seed of the random numbers.
      flat: whether observations are flat.
      **options: options of the task.
    """
    key = repr((parts, flat, sorted(options.items())))
    test = os.environ.get('PYTEST_CURRENT_TEST')  # with unittest, which lacks it, each is new
    environment, user, _ = _kept.pop(key, (None, None, None))
    if environment is None or user == test:  # a test that asks twice compares two
        environment = build(suite.combine(*parts) if len(parts) > 1 else parts[0], options, flat)
    _kept[key] = environment, test, options
    while len(_kept) > MOST_KEPT:
        _kept.pop(next(iter(_kept)))
    environment.random_state.seed(seed)
    return environment


def in_this_process(function, *arguments):
    """In place of `limited.call`, whose child process takes most of the time of reading a character."""
    try:
        return pickle.loads(pickle.dumps(function(*arguments)))
    except (ValueError, OSError) as error:
        raise ValueError(' '.join(str(error).split())) from None


def besides_notices(told):
    """Returns what a process wrote to stderr, except that it compiled functions."""
    lines = told.splitlines(keepends=True)
    return ''.join(line for line in lines if not line.startswith('trl_suite: '))


def let_go():
    """Forgets the environments of `made`, and returns the memory of all that are released.

    Environments are full of cycles, and the collector does not count their models; the C library
    keeps freed memory unless told otherwise.
    """
    _kept.clear()
    gc.collect()
    if hasattr(libc := ctypes.CDLL(None), 'malloc_trim'):  # glibc
        libc.malloc_trim(0)


# Values of a simulation, by named access.


def body(environment, field, link):
    name = environment.task.character.spec.name
    return getattr(environment.physics.named.data, field)[f'{name}/{link}'].copy()


def build(spec, options=None, flat=False):
    """Returns a new environment of an id or specification, with options of the task."""
    spec = suite.find(spec) if isinstance(spec, str) else spec
    return suite.build_environment(spec, options, {'flat_observation': flat})


def ankles(environment):
    """Right and left, (2, 3) m."""
    return np.stack([body(environment, 'xpos', f'{side}_ankle') for side in ('right', 'left')])


def heading_of(environment):
    ahead = body(environment, 'xmat', 'root').reshape(3, 3)[:, 0]
    return np.arctan2(ahead[1], ahead[0])


def ground(environment, x, y):
    """Height of three-dimensional ground, by a copy of it, m."""
    return terrain.SpatialGround.from_state(environment.task.arena.grounds[0].state()).height(x, y)


def surface_velocity(around, x, y, env_ids=slice(None)):
    """Velocities of the surface at points (simulations, k), (simulations, k, 2)."""
    return np.array([
        [windows.velocity(i, *point, around.pack) for point in zip(*row, strict=True)]
        for i, *row in zip(np.arange(len(around.grounds))[env_ids], x, y, strict=True)
    ])  # fmt: skip


def height_map(around, xy, heading, env_ids=slice(None), query=windows.height_map, size=1024):
    """Maps of simulations around positions (simulations, 2), (simulations, size)."""
    maps = np.empty((len(xy), size))
    for i, at, psi, out in zip(
        np.arange(len(around.grounds))[env_ids], xy, heading, maps, strict=True
    ):
        query(i, *at, psi, around.pack, out)
    return maps


def velocity_map(around, xy, heading, env_ids=slice(None)):
    """As `height_map`, of velocities, (simulations, 2048)."""
    return height_map(around, xy, heading, env_ids, windows.velocity_map, 2048)


def links_on_ground(environment):
    """Names of the links that touch the terrain, according to the engine's contacts."""
    model, contact = environment.physics.model.ptr, environment.physics.data.ptr.contact
    pairs = model.geom_bodyid[contact.geom]
    names = np.array([model.body(b).name.split('/')[-1] for b in pairs.ravel()]).reshape(-1, 2)
    ground = np.isin(names, ('world', 'terrain'))
    return set(names[ground.any(1)][~ground[ground.any(1)]])


def put(environment, pose, rate):
    """Sets the character to a pose of a clip: root and joints in link order."""
    task, data = environment.task, environment.physics.data
    data.qpos[task.body.pose_qpos], data.qvel[task.body.pose_dof] = pose, rate
    environment.physics.forward()


def write_terrainrl(clip, path):
    """Writes a clip as a motion file of TerrainRL: x forward, y up, z to the right."""
    head = 3 if clip.root == 'planar' else 7
    durations = np.append(np.diff(clip.times), 0.0)
    frames = np.zeros((len(durations), 8 + sum(clip.sizes)))
    frames[:, 0], frames[:, 8:] = durations, clip.poses[:, head:]
    if clip.root == 'planar':
        x, z, pitch = clip.poses[:, :3].T
        frames[:, [1, 2, 4, 7]] = np.stack([x, z, np.cos(pitch / 2), np.sin(pitch / 2)], axis=1)
    else:
        frames[:, 1:4], frames[:, 4:8] = clip.poses[:, [0, 2, 1]] * (1, 1, -1), clip.poses[:, 3:7]
    for column, _ in clip.layout.rotations:
        here = slice(column + 8 - head, column + 12 - head)
        frames[:, here] = frames[:, here][:, [0, 1, 3, 2]] * (1, 1, 1, -1)
    content = {'Loop': clip.loop, 'Frames': frames.tolist()}
    pathlib.Path(path).write_text(json.dumps(content))


def angle_between(a, b):
    return abs((a - b + np.pi) % (2 * np.pi) - np.pi)


def flattened(angle):
    """Matrix from world axes to axes rotated about z by an angle."""
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.array([[cosine, sine, 0], [-sine, cosine, 0], [0, 0, 1]])


def assert_uniform(values, low, high):
    """Kolmogorov-Smirnov at a significance of 1 in 1000."""
    values = np.sort(np.ravel(values))
    assert values[0] >= low and values[-1] <= high, (values[0], values[-1])
    share = (values - low) / (high - low)
    distance = np.abs(share - (np.arange(len(share)) + 0.5) / len(share)).max()
    assert distance < 1.95 / np.sqrt(len(share)), distance


def assert_refused(test, *cases, error=ValueError):
    """Checks that each of some calls, (call, message), raises an error whose message matches."""
    for call, message in cases:
        with test.subTest(message), test.assertRaisesRegex(error, message):
            call()


# Simulations and single environments, saved states.


def assert_rows_are_singles(
    spec, n, steps, step_limit, options=None, scale=1.0, seed=3, num_threads=2, one=None
):
    """Checks that simulations equal single environments with their seeds, bit for bit.

    One single environment plays the simulations, one after the other: building many would take most
    of the time, and what it did before must not matter either. Flat observations are the blocks.

    Args:
      spec: id or specification of the environment.
      n: simulations.
      steps: number of steps; a simulation whose episode ends starts the next one.
      step_limit: after which episodes are cut.
      options: options of the task.
      scale: scale of the random actions, a number or one for each simulation, (n, 1).
      seed: seed of the simulations.
      num_threads: number of threads.
      one: the single environment; None to make one.

    Returns:
      What the simulations returned, a list of `Step`, and how many episodes ended.
    """
    options = options or {}
    environments = VectorEnvironment(
        spec, n, num_threads, seed, step_limit=step_limit, task_kwargs=options
    )
    id_ = environments.spec.id
    rng, size = np.random.default_rng(0), len(environments.action_map)
    actions = [scale * rng.uniform(-1, 1, (n, size)) for _ in range(steps)]
    with mock.patch.object(world, 'LEAST', 1):  # else a few simulations stay in one thread
        first, found = environments.reset(), []
        for action in actions:
            found.append(environments.step(action))
    if one is None:
        one = build(spec, {'step_limit': step_limit, **options})
    ends = 0
    for env_id, own in enumerate(environments.seeds.tolist()):
        one.random_state.seed(own)
        where = f'{id_}, simulation {env_id}'
        expected = np.concatenate([*one.reset().observation.values()])
        np.testing.assert_array_equal(first[env_id], expected, f'{where}, reset')
        for i, (step, action) in enumerate(zip(found, actions, strict=True)):
            time_step, where = one.step(action[env_id]), f'{id_}, simulation {env_id}, step {i}'
            expected = np.concatenate([*time_step.observation.values()])
            np.testing.assert_array_equal(step.observation[env_id], expected, where)
            last, cut = time_step.last(), time_step.discount == 1
            ours = step.reward[env_id], step.terminated[env_id], step.truncated[env_id]
            theirs = time_step.reward or 0.0, last and not cut, last and cut
            np.testing.assert_equal(ours, theirs, where)
            _assert_same_info(step.info, one.info, env_id, where)
            ends += last
    environments.close()
    return found, ends


def _assert_same_info(of_rows, of_one, env_id, where):
    assert set(of_rows) == set(of_one), where
    for name, value in of_one.items():
        if isinstance(value, dict):
            _assert_same_info(of_rows[name], value, env_id, f'{where}, {name}')
        else:
            np.testing.assert_array_equal(of_rows[name][env_id], value, f'{where}, {name}')


def advance(environment, steps, seed=0, scale=1.0, look=lambda environment: ()):
    """Takes random actions; returns all results and probed values as one array."""
    rng, found = np.random.default_rng(seed), []
    for _ in range(steps):
        step = environment.step(scale * rng.uniform(-1, 1, len(environment.action_map)))
        result = [step.reward or 0.0, int(step.step_type)]
        found.append(np.concatenate([result, *step.observation.values(), *look(environment)]))
    return np.array(found)


def assert_goes_on(environment, other, go, before=lambda environment: None):
    """Checks that a pickled copy and a restored environment continue exactly like the original.

    Args:
      environment: in the middle of an episode.
      other: built alike, with another seed; somewhere else.
      go: function of (environment, seed): goes on with random actions and returns what came back.
      before: called with all three, before they go on.
    """
    twin = pickle.loads(pickle.dumps(environment))
    other.set_state(pickle.loads(pickle.dumps(environment.get_state())))
    for each in (twin, other):
        np.testing.assert_equal(each.info, environment.info)
    for each in (environment, twin, other):
        before(each)
    expected, info = go(environment, 1), environment.info
    following = environment.reset().observation
    again = go(environment, 2)
    for each in (twin, other):
        np.testing.assert_array_equal(go(each, 1), expected)
        np.testing.assert_equal(each.info, info)
        for name, value in each.reset().observation.items():
            np.testing.assert_array_equal(value, following[name])
        np.testing.assert_array_equal(go(each, 2), again)


class FolderTest(parameterized.TestCase):
    """A test with a temporary folder."""

    def setUp(self):
        super().setUp()
        self.folder = pathlib.Path(self.enterContext(tempfile.TemporaryDirectory()))

    def assert_only(self, *names):
        """Checks the names of the files in the folder."""
        self.assertCountEqual([path.name for path in self.folder.iterdir()], names)
