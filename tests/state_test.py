"""Tests of determinism: seeds across processes, save and restore, pickling."""

import collections
import dataclasses
import hashlib
import json
import os
import pathlib
import pickle
import subprocess
import sys
import tempfile
from unittest import mock

import helpers
import numpy as np
from absl.testing import parameterized
from dm_control.composer.observation import observable
from helpers import (
    EVERY_MOTOR,
    EVERY_PROPERTY,
    LONG,
    ONE_OF_EACH,
    advance,
    assert_rows_are_singles,
)

from trl_suite import motion, suite
from trl_suite.characters import CHARACTERS
from trl_suite.engine import world
from trl_suite.environments import states
from trl_suite.environments.environment import Environment
from trl_suite.tasks import parts
from trl_suite.terrain import from_function, from_heights, load
from trl_suite.util import machine
from trl_suite.vector import VectorEnvironment

GAITS = ('FSM_Dog2D_Terrain_Mixed-v0', 'FSM_Biped2D_Terrain_Slopes-v0')
DOG, FLAT = 'PD_Dog2D_Slopes_Mixed_Terrain-v0', 'PD_Biped2D_LLC_Imitate_Flat-v0'
BROKEN = (('qvel', 1e12), ('qvel', np.nan), ('qpos', 1e12), ('qpos', np.nan))


def walked(environment, distance):
    """Carries the character forward, so that the strip and its window have moved on."""
    name = environment.task.character.spec.name
    while environment.info['distance'] < distance:
        data = environment.physics.named.data
        data.qpos[f'{name}/root_x/'] += 1.1
        data.qpos[f'{name}/root_z/'] = 6.0
        data.qpos[f'{name}/root_pitch/'] = 0.0
        data.qvel[:] = 0
        environment.physics.forward()
        environment.step(np.zeros(len(environment.action_map)))
    return environment


def digests(ids):
    """The bytes of what comes back from some steps of environments."""
    found = []
    for id_ in ids:
        environment = suite.make(id_, {'random': 5})
        first = environment.reset().observation
        long = suite.find(id_).task_type in LONG
        values = [*first.values(), advance(environment, 4 if long else 40)]
        found.append(hashlib.sha256(b''.join(value.tobytes() for value in values)).hexdigest())
    return found


class DeterminismTest(parameterized.TestCase):
    """The seed decides, and nothing else does."""

    def test_across_processes(self):
        ids = (DOG, FLAT.replace('PD', 'MTU'), GAITS[0], TRAIL, MOVERS)
        script = f'from state_test import digests; print(*digests({ids}))'
        path = os.pathsep.join([*sys.path, os.path.dirname(__file__)])
        theirs = subprocess.run(
            [sys.executable, '-c', script], check=True, capture_output=True, text=True,
            env={**os.environ, 'PYTHONHASHSEED': '2', 'PYTHONPATH': path},
        ).stdout.split()  # fmt: skip
        self.assertLen(set(theirs), len(ids))
        self.assertEqual(digests(ids), theirs)

    def test_nothing_else_matters(self):
        """Neither other environments, nor NumPy's seed, nor the length of the previous episode."""
        episodes = []
        for steps in (2, 6):
            environment, other = suite.make(DOG, {'random': 4}), suite.make(FLAT)
            environment.reset(), other.reset()
            np.random.seed(steps)  # noqa: NPY002
            before = advance(environment, steps, scale=0.0)
            self.assertFalse(np.isin(before[:, 1], (0, 2)).any())
            other.step(np.zeros(6))
            episodes.append([environment.reset().observation['terrain'], advance(environment, 20)])
        np.testing.assert_array_equal(episodes[0][0], episodes[1][0])
        np.testing.assert_array_equal(episodes[0][1], episodes[1][1])


GAPS = 'PD_Biped2D_Gaps_Terrain-v0'
STEP2D, STEP3D = 'PD_Biped2D_LLC_Flat_Step-v0', 'PD_Biped3D_LLC_{}_Step-v0'
GENERAL, TRAIL, STAND = (STEP3D.format(name) for name in ('General', 'Trail', 'Stand'))
IMITATE, HILLS = 'PD_Biped3D_Imitate{}-v0', 'PD_Biped3D_Imitate-Hills_Terrain-v0'
FOREST, MOVERS, SOCCER = (
    f'PD_Biped3D_HLC_{name}-v0' for name in ('Forest', 'DynamicsObstacles', 'Soccer')
)
MUSCLES = 'MTU_Biped2D_LLC_Imitate_Flat-v0'
RUNNERS = (
    'FSM_Dog2D_Terrain_Slopes_Mixed-v0', 'FSM_Goat2D_Terrain_Variable_Steps-v0',
    'FSM_Raptor2D_Terrain_Mixed-v0', 'FSM_Biped2D_Terrain_Slopes-v0', 'FSM_Hopper2D_Terrain_Mixed_Easy-v0',
)  # fmt: skip
WORLD = {'randomize': EVERY_PROPERTY, 'sensors': {'preset': 'harsh', 'delay': (0, 3)}}
OF_MUSCLES = {name: EVERY_MOTOR[name] for name in ('strength', 'noise', 'delay')}
# For gaits, too.
LATE = {'torque_speed': True, 'delay': (0, 2), 'noise': 0.02, 'strength': (0.9, 1.1)}
OWN = {  # of users
    'rewards': {'fast': (0.5, parts.speed)}, 'observations': {'speed': (1, parts.speed)},
}  # fmt: skip
# Id or specification, options; the defaults of every task type are in environment_test.
VARIANTS = (
    (STEP2D, {'plans': {'length': (0.25, 0.6), 'change': 1.0}, 'max_landing_error': 0.5}),
    (TRAIL, {'terrain_observation': 'height'}),
    (STEP3D.format('Symetric'), {'plans': {'from_root': 0.5, 'react': 0.7}}), ('PD_Biped3D_FULL_Imitate-Steps-v0', {}),
    (STEP3D.format('Bumps'), {'mirrored': True, 'terrain_observation': 'height', 'pushes': {}}),
    (GENERAL, {'goal': True, 'mirrored': True, 'max_landing_error': 0.3}),
    *((suite.combine('biped3d_mocap', None, ground, 'footsteps'), {'terrain_observation': 'height'})
      for ground in ('dynamic_obstacles3d', 'conveyor3d')),
    (IMITATE.format('-Hills'), {'terrain_observation': 'height'}), (IMITATE.format('-Track'), {}),
    (IMITATE.format('-Steps'), {'mirrored': True, 'terrain_observation': 'height'}),
    (IMITATE.format(''), {'action_offset': 'original'}),
    (STAND, {'plans': {'stop': 0.5, 'stay': 3}}),
    (SOCCER, {'interface': 'frame'}), (SOCCER, {'controller': [GENERAL, STAND]}),
    (MOVERS, {'interface': 'frame', 'terrain_observation': ('height', 'velocity')}),
    *((id_, {'face_length': 0.1}) for id_ in (GAPS, 'FSM_Goat2D_Terrain_Variable_Steps-v0')),
    (DOG, {'levels': (0, 1000)}), (GAITS[0], {'levels': (0, 1000)}),
    *((id_, {'interface': 'base_action', 'start_noise': 0.02}) for id_ in RUNNERS),
    *((id_, WORLD) for id_ in (HILLS, MOVERS, SOCCER)),
    (GENERAL, {**WORLD, 'pushes': {'interval': (0.1, 0.2)}}),
    *((id_, {**WORLD, 'actuators': LATE}) for id_ in (GAPS, GAITS[0], GENERAL, FOREST)),
    *((id_, {'actuators': EVERY_MOTOR}) for id_ in (FLAT, IMITATE.format(''))),
    (FLAT, {'actuators': {'noise': 0.1}}), (FLAT, {'actuators': {'delay': (0, 60)}}),
    (IMITATE.format(''), {'actuators': {'flex': 0.05}}), (MUSCLES, {'actuators': OF_MUSCLES}),
    (SOCCER, {'actuators': EVERY_MOTOR}), (suite.combine('dog', terrain='gaps', task='walk'), OWN),
)  # fmt: skip


class VariantTest(parameterized.TestCase):
    """With options, simulations are single environments, and states and pickles go on, bit for bit."""

    def pace(self, spec, options):
        """How many steps until episodes are cut, and how far actions go."""
        long = spec in suite.ALL_IDS and suite.find(spec).task_type in LONG
        if not long:
            return 12, 0.3
        return (3, 0.6) if options.get('interface', 'plan') in ('plan', 'parameters') else (15, 0.5)

    @parameterized.parameters(*VARIANTS)
    def test_variant(self, spec, options):
        limit, scale = self.pace(spec, options)
        environment, other = (helpers.build(spec, {'random': 9, **options}) for _ in range(2))
        # So that some fall and some do not.
        scales = scale * np.array([0.3, 1.0, 2.0])[:, None]
        environment.step_limit = limit
        found, ends = assert_rows_are_singles(
            spec, 3, 2 * limit + 3, limit, options, scales, one=environment
        )
        self.assertGreaterEqual(ends, 3)
        if 'randomize' in options:
            self.assertTrue(any(step.info['impulse'].any() for step in found))

        steps = limit if limit < 12 else 17  # in the middle of a cycle or footstep
        environment.random_state.seed(6)
        environment.step_limit = other.step_limit = 1000

        def look(each):
            """What is not observed at once."""
            world = each.info.get('world', {}).values()
            return [np.ravel(value) for value in (*world, each.physics.data.qpos)]

        def go(each, seed):
            return advance(each, steps, seed, scale, look)

        def draw_soon(each):
            """The ball is put elsewhere, and a goal drawn, from the stream that was saved."""
            if hasattr(each.task, 'goals'):
                each.task.goals.due[0] = each.task.clock.steps[0] + 2
            if spec == SOCCER:
                each.task.ball.state.due[0] = each.task.clock.steps[0] + 2

        environment.reset(), other.reset()
        go(environment, 0)
        advance(other, steps - 1, 5, scale)
        helpers.assert_goes_on(environment, other, go, draw_soon)

    @parameterized.parameters((GAITS[0], 5), (GENERAL, 4))
    def test_threads_and_copies(self, id_, n):
        """Neither matters for what goes on, with all that can vary."""
        one, two, other = (
            VectorEnvironment(id_, n, threads, seed, task_kwargs=WORLD)
            for threads, seed in ((1, 5), (3, 5), (1, 9))
        )
        self.enterContext(mock.patch.object(world, 'LEAST', 1))  # all on threads
        action = np.zeros((n, len(one.action_map)))
        for each in one, two, other:
            each.reset()
        one.step(action), two.step(action)
        other.copy_from(one, [2, 0], [0, 3])
        for _ in range(2):
            a, b, c = one.step(action), two.step(action), other.step(action)
            np.testing.assert_array_equal(a.observation, b.observation)
            np.testing.assert_array_equal(a.observation[[2, 0]], c.observation[[0, 3]])
            np.testing.assert_array_equal(a.info['impulse'][[2, 0]], c.info['impulse'][[0, 3]])


class SaveTest(parameterized.TestCase):
    """States saved at any step continue bit for bit."""

    def check(self, environment, *targets):
        """Also of environments before the first reset, in use, and of the one that was saved."""
        state = pickle.loads(pickle.dumps(environment.get_state()))
        twin = pickle.loads(pickle.dumps(environment))
        found = []
        for each in (environment, twin, *targets, environment):
            if found and each is not twin:
                each.set_state(state)
            first = advance(each, 60, seed=2, scale=0.3)
            following = each.reset().observation['pose']
            found.append(
                np.concatenate([first.ravel(), following, advance(each, 60, seed=3).ravel()])
            )
            np.testing.assert_array_equal(found[-1], found[0])

    def test_on_other_environments(self):
        environment, fresh, used = (suite.make(DOG, {'random': seed}) for seed in (6, 77, 78))
        environment.reset()
        advance(environment, 7, scale=0.3)
        advance(used, 33)
        walked(used, 20)
        self.assertLess(len(pickle.dumps(environment)), 300_000)
        self.check(environment, fresh, used)
        environment.step_limit = None  # after the ground was extended
        environment.reset()
        walked(environment, 47)
        self.assertGreater(environment.task.arena.grounds[0].extent[1], 60)
        self.check(environment, used)

    def test_at_a_reset_and_at_an_end(self):
        """The last observation, info and the number of steps are restored as well."""
        environment = suite.make(DOG, {'random': np.random.RandomState(6), 'step_limit': 7})
        other = suite.make(DOG, {'random': 7, 'step_limit': 7})
        self.check(environment, other)  # before the first reset
        environment.reset()
        self.check(environment, other)
        environment.reset()
        for _ in range(5):
            step = environment.step(np.zeros(20))
        other.set_state(environment.get_state())
        np.testing.assert_equal(other.observation(), step.observation)
        self.assertEqual(other.info, environment.info)
        lengths = [0, 0]
        for i, each in enumerate((environment, other)):
            while not each.step(np.zeros(20)).last():
                lengths[i] += 1
        self.assertEqual(lengths, [1, 1])
        fresh = suite.make(DOG, {'random': 8})
        fresh.set_state(environment.get_state())
        self.assertEqual(fresh.info, environment.info)
        self.assertTrue(fresh.step(np.zeros(20)).first())

    @parameterized.parameters(
        'PD_Raptor2D_Slopes_Mixed_Terrain-v0', 'PD_Dog2D_Gaps_Terrain-v0', GAITS[0]
    )
    def test_a_wrong_state_is_rejected(self, id_):
        environment, other = helpers.made(DOG), helpers.made(id_)
        environment.reset()
        other.reset()
        other.step(np.zeros(len(other.action_map)))
        before = pickle.dumps(environment.get_state())
        for state in (other.get_state(), {}):
            with self.assertRaisesRegex(ValueError, 'the state belongs to another environment'):
                environment.set_state(state)
        self.assertEqual(pickle.dumps(environment.get_state()), before)  # nothing half done

    def test_extra_observables_are_current_after_a_restore(self):
        def build():
            task = suite.build_task(suite.find(DOG))
            joints = observable.MJCFFeature('qpos', task.character.joints)
            task.character.observables.add_observable('joints_pos', joints)
            return Environment(task, random=0)

        environment, other = build(), build()
        environment.reset()
        other.reset()
        advance(environment, 5, scale=0.2)
        expected = environment.observation()['dog/joints_pos']
        other.set_state(environment.get_state())
        np.testing.assert_array_equal(other.observation()['dog/joints_pos'], expected)
        np.testing.assert_array_equal(advance(environment, 20), advance(other, 20))


def leaves(value, path=()):
    """Paths of all arrays and plain values in a state."""
    if isinstance(value, (dict, list, tuple)):
        items = value.items() if isinstance(value, dict) else enumerate(value)
        for key, part in items:
            yield from leaves(part, (*path, key))
    else:
        yield path


def edited(value, path, change):
    """A state in which one value is changed."""
    if not path:
        return change(value)
    content = dict(value) if isinstance(value, dict) else list(value)
    content[path[0]] = edited(content[path[0]], path[1:], change)
    return content


def raised(value):
    """The first number, plus 1."""
    if isinstance(value, np.ndarray):
        changed = value.copy() if value.size else np.zeros(1)
        changed.flat[0] = raised(changed.flat[0])
        return changed
    if isinstance(value, str):
        return value + 'x'
    if value is None or value != value:
        return 1
    return not value if isinstance(value, (bool, np.bool_)) else value + 1


class SignatureTest(parameterized.TestCase):
    """A state is restored whole, or refused whole."""

    @parameterized.parameters(GAITS[0], 'PD_Biped3D_HLC_DynamicsObstacles-v0')
    def test_edited_states(self, id_):
        options = {'sensors': {'delay': 2}, 'actuators': {'delay': 2.0}}
        single = suite.make(id_, {'random': 1, **options})
        for environment in single, VectorEnvironment(id_, 2, 1, 1, task_kwargs=options):
            environment.reset()
            state, before = environment.get_state(), pickle.dumps(environment.get_state())
            changes = raised, lambda value: np.asarray(value)[None]
            for path in [*leaves(state)][:: 1 if environment is single else 7]:
                for change in changes:
                    with (
                        self.subTest(path=path),
                        self.assertRaisesRegex(ValueError, 'checksum differs|another environment'),
                    ):
                        environment.set_state(edited(state, path, change))
            for name in state:
                with self.subTest(without=name), self.assertRaises(ValueError):
                    environment.set_state({key: state[key] for key in state if key != name})
            self.assertEqual(pickle.dumps(environment.get_state()), before)
            environment.set_state(pickle.loads(before))

    def test_functions_with_names_that_change(self):
        """What a function of a user collects, or refers to later, is no part of the signature."""
        calls = []

        def bonus(task):
            calls.append(task is environment.task)
            return np.zeros(task.world.n)

        environment = self.build(rewards={'bonus': (1.0, bonus)})
        environment.reset()
        environment.step(np.zeros(6))
        self.assertNotEmpty(calls)
        self.build(rewards={'bonus': (1.0, bonus)}).set_state(environment.get_state())

    def build(self, character='biped2d', clip='biped2d_walk', terrain='flat', **options):
        return suite.build(
            character, 'position', terrain, clip=clip, task_kwargs={'random': 1, **options}
        )

    def others(self):
        """By the part of which the contents differ: pairs of environments with parts of one name."""
        clip, heights = motion.load('biped2d_walk'), np.zeros(200)
        gaps = {'Type': 'var2d_gaps', 'Params': [{'GapWMin': 0.1, 'GapWMax': 0.2}]}
        wide = {'Type': 'var2d_gaps', 'Params': [{'GapWMin': 1.1, 'GapWMax': 2.2}]}
        spec = CHARACTERS['biped2d']
        yield 'terrain', {'terrain': gaps}, {'terrain': wide}
        yield 'terrain', *({'terrain': from_heights(each, 0.1)} for each in (heights, heights + 1))
        yield 'motion', {'clip': clip}, {'clip': dataclasses.replace(clip, times=clip.times * 2)}
        faster = dataclasses.replace(spec, joints={
            name: dataclasses.replace(joint, kp=joint.kp * 2) for name, joint in spec.joints.items()
        })  # fmt: skip
        yield 'character', {}, {'character': faster}
        yield 'options', {}, {'start_phase': 0.5}
        yield 'options', *({'start_phase': np.array([[0.0, high]])} for high in (0.5, 0.6))
        yield 'actuators', {'actuators': {'noise': 0.1}}, {'actuators': {'noise': 0.2}}
        yield 'sensors', {'sensors': {'delay': 1}}, {'sensors': {'delay': 2}}
        yield 'randomize', {'randomize': {'preset': 'robot'}}, {'randomize': {'gravity': 5.0}}
        functions = (lambda task: parts.height(task)), (lambda task: 2 * parts.height(task))
        yield 'additions', *({'rewards': {'high': (0.1, each)}} for each in functions)

    def test_states_of_other_contents(self):
        for name, one, other in self.others():
            with self.subTest(name, one=one):
                environment, target = self.build(**one), self.build(**other)
                for each in environment, target:
                    each.reset()
                state, before = environment.get_state(), pickle.dumps(target.get_state())
                with self.assertRaisesRegex(
                    ValueError, f'another environment: (.*; )?{name} .* instead'
                ):
                    target.set_state(state)
                self.assertEqual(pickle.dumps(target.get_state()), before)
                self.build(**one).set_state(state)

    def test_a_file_of_torques_counts_by_its_contents(self):
        folder = pathlib.Path(self.enterContext(tempfile.TemporaryDirectory()))
        for name, torque in (('a', 0.5), ('b', 0.6), ('c', 0.5)):
            knee = {'angle': [-1, 0], 'positive': [1, 1], 'negative': [1, torque]}
            (folder / f'{name}.json').write_text(json.dumps({'right_knee': knee}))

        def made(name):
            environment = self.build(actuators={'torque_pose': str(folder / f'{name}.json')})
            environment.reset()
            return environment

        state = made('a').get_state()
        made('c').set_state(state)
        (folder / 'b.json').replace(folder / 'a.json')
        with self.assertRaisesRegex(ValueError, 'another environment: actuators'):
            made('a').set_state(state)

    def test_states_of_a_task_that_saves_other_arrays(self):
        environment = self.build()
        before, (*others, last) = states.signature(environment.task, 'kind'), environment.task.saved
        names = tuple(f'other_{name}' for name in last._fields)
        renamed = collections.namedtuple('Other', names)(*last)
        smaller = last._replace(**{last._fields[0]: last[0].astype(np.float32)})
        for saved in ((*others,), (*others, last, last), (*others, renamed), (*others, smaller)):
            environment.task.saved = saved
            after = states.signature(environment.task, 'kind')
            self.assertRegex(states.differences(before, after), '^task .* instead of ')

    def test_other_functions_of_one_name(self):
        def ground(height):
            def hill(x):
                return height * np.exp(-np.square(x - 5))

            return from_function(hill, replace=True)

        environments = [self.build(terrain=ground(height)) for height in (0.1, 0.2)]
        saved = [environment.get_state() for environment in environments]
        environments[1].set_state(saved[1])
        with self.assertRaisesRegex(ValueError, 'terrain hill .* instead of hill'):
            environments[1].set_state(saved[0])

    def test_names_do_not_count(self):
        clip = dataclasses.replace(motion.load('biped2d_walk'), name='mine', description='My own.')
        ground = dataclasses.replace(load('gaps_humanoid'), name='other')
        environment = self.build(terrain='gaps_humanoid')
        environment.reset()
        self.build(terrain=ground, clip=clip).set_state(environment.get_state())

    def test_the_class_of_cpu_is_named_and_does_not_count(self):
        environment, name = suite.make(DOG, {'random': 6}), machine.cpu_class()
        state = environment.get_state()
        with mock.patch.object(machine, 'cpu_class', lambda: 'another'):
            other = suite.make(DOG, {'random': 6})
        other.set_state(state)
        label, _ = state['made_for']['environment']
        self.assertEndsWith(label, f' on {name}')
        self.assertEqual(
            other.get_state()['made_for']['environment'][0], label.replace(name, 'another')
        )


BEYOND = {  # where no ground is drawn, by environment, and the height above the ground there
    DOG: (999_983.0, -999_983.0, 3e5), GAITS[0]: (999_983.0,),
    'PD_Biped2D_LLC_Flat_Step-v0': (999_983.0,),
    'PD_Biped3D_Imitate-Stairs_Terrain-v0': ((999_983.0, 0.0), (0.0, -999_983.0), (3e9, 0.0)),
    'PD_Biped3D_HLC_PathFollowing-v0': ((999_983.0, 0.0),),
}  # fmt: skip


class FarTest(parameterized.TestCase):
    """Who leaves the ground ends its episode; the others go on."""

    @parameterized.parameters(*BEYOND)
    def test_beyond_the_border(self, id_):
        environments = VectorEnvironment(id_, 2, 1, 3, step_limit=None)
        idle = np.zeros((2, len(environments.action_map)))
        environments.reset()
        environments.step(idle)
        world, figure = environments.task.world, environments.task.body
        state, expected = environments.get_state(), [environments.step(idle) for _ in range(4)]
        for place in map(np.atleast_1d, BEYOND[id_]):
            environments.set_state(state)
            world.qpos[0, figure.pose_qpos[: len(place)]] = place
            world.qpos[0, figure.pose_qpos[1 if len(place) == 1 else 2]] += 5.0
            world.forward(world.all_ids)
            found = [environments.step(idle) for _ in range(4)]
            np.testing.assert_array_equal(found[0].info['diverged'], [True, False])
            np.testing.assert_array_equal(found[0].terminated[0], True)
            for step, other in zip(found, expected, strict=True):
                self.assertTrue(np.isfinite(step.observation).all())
                self.assertTrue(np.isfinite(step.reward).all())
                np.testing.assert_array_equal(step.observation[1], other.observation[1])
                self.assertEqual(step.reward[1], other.reward[1])

    @parameterized.parameters(
        ('PD_Biped3D_Imitate-Ramp_Terrain-v0', (1000.9, 0.0)),
        ('PD_Biped3D_Imitate-Stairs_Terrain-v0', (5.0, -1000.5)),
    )
    def test_over_the_rim_of_the_ground(self, id_, place):
        environment = helpers.made(id_, seed=3, step_limit=None)
        environment.reset()
        data, root = environment.physics.data, environment.task.body.pose_qpos[:3]
        data.qpos[root] = *place, data.qpos[root[2]] + 3.0
        environment.task.world.forward(environment.task.world.all_ids)
        for _ in range(300):
            step = environment.step(np.zeros(len(environment.action_map)))
            for name, block in step.observation.items():
                self.assertTrue(np.isfinite(block).all(), name)
            if step.last():
                break
        self.assertEqual(step.discount, 0)
        self.assertTrue(environment.info['diverged'])

    def test_states_do_not_grow_with_the_distance(self):
        environment = suite.make(DOG, {'random': 6, 'step_limit': None})
        environment.reset()
        sizes = []
        for x in 0.0, 1e5:
            environment.task.arena.recentre(np.zeros(1, int), np.array([x]))
            ground = environment.task.arena.grounds[0]
            environment.physics.data.qpos[:2] = x, ground.height(x) + 1.0
            environment.task.world.forward(environment.task.world.all_ids)
            state = environment.get_state()
            sizes.append(len(pickle.dumps(state)))
        self.assertLess(sizes[1], sizes[0] + 1000)
        environment.set_state(pickle.loads(pickle.dumps(state)))
        again = environment.task.arena.grounds[0]
        np.testing.assert_array_equal(again.window(-240, 961), ground.window(-240, 961))


class DivergenceTest(parameterized.TestCase):
    """Who goes back to a state before the physics broke down goes on as if it never had."""

    @parameterized.parameters(*ONE_OF_EACH)
    def test_single(self, id_):
        environment = suite.make(id_, {'random': 1})
        environment.reset()
        state, data = environment.get_state(), environment.physics.data
        kept, idle = environment.observation(), np.zeros(len(environment.action_map))
        place = environment.info['distance']
        expected = environment.step(idle)
        for field, value in BROKEN:
            with self.subTest(field=field, value=value):
                environment.set_state(state)
                getattr(data, field)[:] = value
                broken = environment.get_state()
                step = environment.step(idle)
                self.assertTrue(step.last() and step.discount == 0 and step.reward == 0)
                self.assertTrue(environment.info['diverged'] and not environment.info['fell'])
                np.testing.assert_equal(step.observation, kept)  # the last that was sound
                self.assertEqual(environment.info['distance'], place)
                self.assertTrue(environment.step(idle).first())
                environment.set_state(state)
                step = environment.step(idle)
                self.assertEqual(step.reward, expected.reward)
                np.testing.assert_equal(step.observation, expected.observation)
                # A state that is broken itself: the episode ends or goes on, and the next is fine.
                environment.set_state(broken)
                for value in environment.step(idle).observation.values():
                    self.assertTrue(np.isfinite(value).all())
                self.assertTrue(np.isfinite(environment.info['distance']))
                environment.reset()
                self.assertFalse(environment.step(idle).last())

    def test_a_joint_that_spins_too_fast(self):
        environment = suite.make('Torque_Dog2D_LLC_Imitate_Flat-v0', {'random': 6})
        environment.reset()
        environment.physics.model.dof_damping[:] = 0
        environment.physics.named.data.qvel['dog/tail3'] = 500.0
        environment.physics.forward()
        step = environment.step(np.zeros(20))
        self.assertGreater(np.abs(environment.physics.data.qvel).max(), 200)
        self.assertEqual((step.last(), step.reward, step.discount), (True, 0.0, 0.0))
        self.assertTrue(environment.info['diverged'])

    @parameterized.parameters(*ONE_OF_EACH[::3])
    def test_vector(self, id_):
        options = {'num_threads': 1, 'seed': 1, 'autoreset': 'disabled'}
        one, other = (VectorEnvironment(id_, 2, **options) for _ in range(2))
        for each in one, other:
            each.reset()
        state, idle = one.get_state(), np.zeros((2, len(one.action_map)))
        expected = one.step(idle)
        for field, value in BROKEN[::3]:
            with self.subTest(field=field, value=value):
                for each in one, other:
                    each.set_state(state)
                    getattr(each.task.world, field)[1] = value
                    step = each.step(idle)
                    np.testing.assert_array_equal(step.info['diverged'], [False, True])
                    np.testing.assert_array_equal(step.observation[0], expected.observation[0])
                one.set_state(state)
                other.copy_from(one, [0, 1], [0, 1])
                for each in one, other:
                    step = each.step(idle)
                    np.testing.assert_array_equal(step.observation, expected.observation)
                    np.testing.assert_array_equal(step.reward, expected.reward)
                    self.assertFalse(step.info['diverged'].any())


class PickleTest(parameterized.TestCase):
    """An environment of the suite can be pickled in mid-episode."""

    def test_built_environments(self):
        environment = suite.build(
            'goat', 'position', {'Type': 'var2d_gaps', 'Params': [{'GapWMin': 0.3, 'GapWMax': 0.4}]},
            clip=motion.load('dog_bound'), task_kwargs={'random': 1, 'terrain_observation': 20},
        )  # fmt: skip
        environment.reset()
        advance(environment, 4, scale=0.2)
        environment.step_limit = 10
        twin = pickle.loads(pickle.dumps(environment))
        self.assertEqual(twin.step_limit, 10)
        self.assertEqual(twin.blocks, environment.blocks)
        np.testing.assert_array_equal(advance(twin, 60), advance(environment, 60))

    def test_an_environment_that_cannot_be_rebuilt_is_not_pickled(self):
        environment = Environment(suite.build_task(suite.find(DOG)))
        with self.assertRaisesRegex(TypeError, r'get_state\(\)'):
            pickle.dumps(environment)
