"""Tests of determinism: seeds across processes, save and restore, pickling."""

import contextlib
import dataclasses
import io
import os
import pickle
import subprocess
import sys
import textwrap
from unittest import mock

import helpers
import numpy as np
from absl.testing import absltest, parameterized
from dm_control.composer.observation import observable
from helpers import EVERY_PROPERTY, LONG, assert_rows_are_singles

from trl_suite import motion, suite
from trl_suite.characters import CHARACTERS
from trl_suite.environments import states
from trl_suite.environments.environment import Environment
from trl_suite.registry import catalogue
from trl_suite.tasks import parts
from trl_suite.terrain import from_function, from_heights, load
from trl_suite.util import machine
from trl_suite.vector import VectorEnvironment

EXAMPLES = (
    'PD_Biped2D_Gaps_Terrain-v0', 'PD_Dog2D_Slopes_Mixed_Terrain-v0',
    'PD_Raptor2D_Slopes_Terrain-v0', 'MTU_Raptor2D_LLC_Imitate_Flat-v0',
    'Torque_Dog2D_LLC_Imitate_Flat-v0', 'Vel_Biped2D_LLC_Imitate_Flat-v0',
)  # fmt: skip
# In three dimensions; with options: VARIANTS.
SPATIAL = (
    'PD_Biped3D_Imitate-Hills-v0', 'PD_Biped3D_LLC_Trail_Step-v0', 'PD_Biped3D_HLC_Soccer-v0',
    'PD_Biped3D_HLC_LargeBlocks-v0',
)  # fmt: skip
GAITS = ('FSM_Dog2D_Terrain_Mixed-v0', 'FSM_Biped2D_Terrain_Slopes-v0')
DOG, FLAT = EXAMPLES[1], 'PD_Biped2D_LLC_Imitate_Flat-v0'
ONE_OF_EACH = tuple({spec.task_type: spec.id for spec in catalogue.SPECS}.values())
BROKEN = (('qvel', 1e12), ('qvel', np.nan), ('qpos', 1e12), ('qpos', np.nan))


def advance(environment, steps, seed=0, scale=1.0):
    """Random actions; returns everything that came back as one array."""
    rng, found = np.random.default_rng(seed), []
    for _ in range(steps):
        step = environment.step(scale * rng.uniform(-1, 1, len(environment.action_map)))
        reward = -1.0 if step.reward is None else step.reward
        discount = -1.0 if step.discount is None else step.discount
        blocks = [np.ravel(value) for value in step.observation.values()]
        found.append(np.concatenate([[reward, discount, int(step.step_type)], *blocks]))
    return np.array(found)


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


class DeterminismTest(parameterized.TestCase):
    """The seed decides, and nothing else does."""

    SCRIPT = textwrap.dedent("""
        import hashlib, sys
        import numpy as np
        from trl_suite import suite
        for id_ in sys.argv[1:]:
            environment = suite.make(id_, {'random': 5}, {'flat_observation': True})
            environment.reset()
            rng, digest = np.random.default_rng(1), hashlib.sha256()
            for _ in range(8 if 'FSM' in id_ or '_HLC_' in id_ else 120):
                step = environment.step(rng.uniform(-1, 1, len(environment.action_map)))
                digest.update(step.observation['observations'].tobytes())
                digest.update(repr((step.reward, step.discount)).encode())
            print(digest.hexdigest())
    """)

    def test_across_processes(self):
        digests = [
            subprocess.run(
                [sys.executable, '-c', self.SCRIPT, *EXAMPLES, *SPATIAL, *GAITS], check=True,
                capture_output=True,
                text=True, env={**os.environ, 'PYTHONHASHSEED': seed},
            ).stdout.split()
            for seed in ('1', '2')
        ]  # fmt: skip
        self.assertLen(set(digests[0]), len(EXAMPLES) + len(SPATIAL) + len(GAITS))
        self.assertEqual(digests[0], digests[1])
        with (
            contextlib.redirect_stdout(io.StringIO()) as out,
            mock.patch.object(sys, 'argv', ['', EXAMPLES[0]]),
        ):
            exec(self.SCRIPT, {})
        self.assertEqual([digests[0][0]], out.getvalue().split())

    def test_episodes_do_not_depend_on_other_environments(self):
        alone = advance(suite.make(DOG, {'random': 3}), 60)
        mine, other = suite.make(DOG, {'random': 3}), suite.make(EXAMPLES[2], {'random': 9})
        found = []
        np.random.seed(123)  # noqa: NPY002
        rng = np.random.default_rng(0)
        for _ in range(60):
            action = rng.uniform(-1, 1, 20)
            step = mine.step(action)
            found.append(step.observation['pose'])
            other.step(rng.bit_generator.ctypes.state_address % 7 * np.zeros(18))
        start = 3 + 50
        np.testing.assert_array_equal(alone[:, start : start + 43], np.array(found))

    def test_an_episode_does_not_depend_on_the_previous_one(self):
        episodes = []
        for steps in (2, 6):
            environment = suite.make(DOG, {'random': 4})
            environment.reset()
            self.assertFalse(np.isin(advance(environment, steps, scale=0.0)[:, 2], (0, 2)).any())
            episodes.append([environment.reset().observation['terrain'], advance(environment, 5)])
        np.testing.assert_array_equal(episodes[0][0], episodes[1][0])
        np.testing.assert_array_equal(episodes[0][1], episodes[1][1])


STEP2D, STEP3D = 'PD_Biped2D_LLC_Flat_Step-v0', 'PD_Biped3D_LLC_{}_Step-v0'
GENERAL, TRAIL = STEP3D.format('General'), STEP3D.format('Trail')
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
MOTOR = {  # options of actuators, each alone
    'torque_speed': {'torque_speed': True, 'no_load_speed': 8.0}, 'strength': {'strength': (0.7, 1.3)},
    'noise': {'noise': 0.1}, 'delay': {'delay': (0, 60)}, 'torque_pose': {'torque_pose': True},
    'flex': {'flex': 0.05}, 'backlash': {'backlash': 0.02},
}  # fmt: skip
MOTORS = {name: value for each in MOTOR.values() for name, value in each.items()}
OF_MUSCLES = {name: MOTORS[name] for name in ('strength', 'noise', 'delay')}
LATE = {
    'torque_speed': True,
    'delay': (0, 2),
    'noise': 0.02,
    'strength': (0.9, 1.1),
}  # for gaits, too
# Id or specification, options; the defaults of every task type are in environment_test.
VARIANTS = (
    (STEP2D, {'plans': {'length': (0.25, 0.6), 'change': 1.0}, 'max_landing_error': 0.5}),
    (TRAIL, {'terrain_observation': 'height'}),
    (STEP3D.format('Symetric'), {'plans': {'from_root': 0.5}}), ('PD_Biped3D_FULL_Imitate-Steps-v0', {}),
    (STEP3D.format('Bumps'), {'mirrored': True, 'terrain_observation': 'height', 'pushes': {}}),
    (GENERAL, {'goal': True, 'mirrored': True, 'max_landing_error': 0.3}),
    *((suite.combine('biped3d_mocap', None, ground, 'footsteps'), {'terrain_observation': 'height'})
      for ground in ('dynamic_obstacles3d', 'conveyor3d')),
    (IMITATE.format('-Hills'), {'terrain_observation': 'height'}), (IMITATE.format('-Track'), {}),
    (IMITATE.format('-Steps'), {'mirrored': True, 'terrain_observation': 'height'}),
    (IMITATE.format(''), {'action_offset': 'original'}),
    (SOCCER, {'interface': 'frame'}),
    (MOVERS, {'interface': 'frame', 'terrain_observation': ('height', 'velocity')}),
    *((id_, {'interface': interface, 'start_noise': 0.02})
      for id_ in RUNNERS for interface in ('parameters', 'base_action')),
    *((id_, WORLD) for id_ in (EXAMPLES[0], HILLS, GAITS[0], FOREST, MOVERS, SOCCER)),
    (GENERAL, {**WORLD, 'pushes': {'interval': (0.1, 0.2)}}),
    *((id_, {**WORLD, 'actuators': LATE}) for id_ in (EXAMPLES[0], GAITS[0], GENERAL, FOREST)),
    *((id_, {'actuators': each}) for id_ in (FLAT, IMITATE.format('')) for each in (*MOTOR.values(), MOTORS)),
    *((MUSCLES, {'actuators': each}) for each in (*(MOTOR[name] for name in OF_MUSCLES), OF_MUSCLES)),
    (SOCCER, {'actuators': MOTORS}),
)  # fmt: skip


class VariantTest(parameterized.TestCase):
    """With options: simulations are single environments, and states and pickles go on, bit for bit."""

    def pace(self, spec, options):
        """How many steps until episodes are cut, and how far actions go."""
        long = spec in suite.ALL_IDS and suite.find(spec).task_type in LONG
        if not long:
            return 12, 0.3
        return (3, 0.6) if options.get('interface', 'plan') in ('plan', 'parameters') else (15, 0.5)

    @parameterized.parameters(*VARIANTS)
    def test_simulations_equal_single_environments(self, spec, options):
        limit, scale = self.pace(spec, options)
        scale = scale * np.array([0.3, 1.0, 2.0])[:, None]  # so that some fall and some do not
        found, ends = assert_rows_are_singles(spec, 3, 2 * limit + 3, limit, options, scale)
        self.assertGreaterEqual(ends, 3)
        if 'randomize' in options:
            self.assertTrue(any(step.info['impulse'].any() for step in found))

    @parameterized.parameters(*VARIANTS)
    def test_a_restored_state_continues_exactly(self, spec, options):
        steps, scale = self.pace(spec, options)
        environment, other = (
            helpers.build(spec, {'random': seed, 'step_limit': 1000, **options}) for seed in (6, 9)
        )
        steps = steps if steps < 12 else 17  # in the middle of a cycle or footstep

        def look(each):
            """What is not observed at once."""
            world = each.info.get('world', {}).values()
            return [np.ravel(value) for value in (*world, each.physics.data.qpos)]

        def go(each, seed):
            return helpers.advance(each, seed, steps, scale, look)

        def draw_soon(each):
            """The ball is put elsewhere, and a goal drawn, from the stream that was saved."""
            if hasattr(each.task, 'goals'):
                each.task.goals.due[0] = each.task.clock.steps[0] + 2
            if spec == SOCCER:
                each.task.ball.state.due[0] = each.task.clock.steps[0] + 2

        environment.reset(), other.reset()
        go(environment, 0)
        helpers.advance(other, 5, steps - 1, scale)
        helpers.assert_goes_on(environment, other, go, draw_soon)

    def test_threads_and_copies(self):
        """Neither matters for what goes on, with all that can vary."""
        found = []
        for id_, n in ((GAITS[0], 12), (GENERAL, 4)):
            environments = [
                VectorEnvironment(id_, n, threads, 5, task_kwargs=WORLD) for threads in (1, 2, 3)
            ]
            action = np.zeros((n, len(environments[0].action_map)))
            for each in environments:
                each.reset()
                found.append([each.step(action).observation for _ in range(3)])
            np.testing.assert_array_equal(found[-1], found[-2])
            np.testing.assert_array_equal(found[-1], found[-3])
            one, other = environments[0], VectorEnvironment(id_, n, 1, 9, task_kwargs=WORLD)
            other.reset()
            other.copy_from(one, [2, 0], [0, 3])
            for _ in range(3):
                a, b = one.step(action), other.step(action)
                np.testing.assert_array_equal(a.observation[[2, 0]], b.observation[[0, 3]])
                np.testing.assert_array_equal(a.info['impulse'][[2, 0]], b.info['impulse'][[0, 3]])

    def test_a_frame_in_the_middle_of_a_footstep(self):
        environment = suite.make(MOVERS, {'random': 8, 'interface': 'frame'})
        environment.reset()
        for _ in range(7):
            environment.step(np.zeros(22))
        twin = pickle.loads(pickle.dumps(environment))
        lay = np.zeros((1, 22))
        np.testing.assert_array_equal(twin.task.lay(lay), environment.task.lay(lay))
        np.testing.assert_array_equal(
            advance(twin, 20, scale=0.15), advance(environment, 20, scale=0.15)
        )


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

    @parameterized.parameters(*EXAMPLES)
    def test_on_other_environments(self, id_):
        environment, fresh, used = (suite.make(id_, {'random': seed}) for seed in (6, 77, 78))
        environment.reset()
        advance(environment, 7, scale=0.3)
        advance(used, 33)
        walked(used, 20)
        self.assertLess(len(pickle.dumps(environment)), 300_000)
        self.check(environment, fresh, used)

    @parameterized.parameters(*EXAMPLES[:3])
    def test_after_the_ground_was_extended(self, id_):
        environment, other = (suite.make(id_, {'random': i, 'step_limit': None}) for i in (6, 79))
        environment.reset()
        walked(environment, 47)
        self.assertGreater(environment.task.arena.grounds[0].extent[1], 60)
        self.check(environment, other)

    def test_at_a_reset_and_at_an_end(self):
        environment = suite.make(DOG, {'random': np.random.RandomState(6)})
        self.check(environment, suite.make(DOG, {'random': 7}))  # before the first reset
        environment.reset()
        self.check(environment, suite.make(DOG, {'random': 7}))
        for _ in range(300):
            if environment.step(np.random.default_rng(0).uniform(-1, 1, 20)).last():
                break
        state = environment.get_state()
        other = suite.make(DOG, {'random': 7})
        other.set_state(state)
        self.assertTrue(other.info['fell'])
        self.assertTrue(other.step(np.zeros(20)).first())

    def test_observation_info_and_step_count_are_restored(self):
        environment, other = (suite.make(DOG, {'random': i, 'step_limit': 20}) for i in (6, 7))
        environment.reset()
        for _ in range(5):
            step = environment.step(np.zeros(20))
        other.set_state(environment.get_state())
        for name, value in other.observation().items():
            np.testing.assert_array_equal(value, step.observation[name])
        self.assertEqual(other.info, environment.info)
        lengths = []
        for each in (environment, other):
            lengths.append(0)
            while not each.step(np.zeros(20)).last():
                lengths[-1] += 1
        self.assertEqual(lengths[0], lengths[1])

    def test_a_saved_state_is_a_copy(self):
        environment, twin = suite.make(DOG, {'random': 6}), suite.make(DOG, {'random': 8})
        environment.reset()
        state = environment.get_state()
        before = pickle.dumps(state)
        for each in (environment, twin):
            if each is twin:
                twin.set_state(state)
            advance(each, 30)
            walked(each, 12)
            each.reset()
            self.assertEqual(pickle.dumps(state), before)

    @parameterized.parameters(
        'PD_Raptor2D_Slopes_Mixed_Terrain-v0', 'PD_Biped2D_Gaps_Terrain-v0',
        'MTU_Dog2D_LLC_Imitate_Flat-v0', 'PD_Dog2D_LLC_Imitate_Flat-v0', 'PD_Dog2D_Gaps_Terrain-v0',
        GAITS[0],
    )  # fmt: skip
    def test_a_wrong_state_is_rejected(self, id_):
        environment, other = suite.make(DOG, {'random': 0}), suite.make(id_, {'random': 0})
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

    @parameterized.parameters(EXAMPLES[0], MOVERS)
    def test_a_restored_world_is_the_saved_one(self, id_):
        one, other = (suite.make(id_, {'random': i, 'randomize': EVERY_PROPERTY}) for i in (1, 2))
        one.reset(), other.reset()
        one.step(np.zeros(len(one.action_map)))
        other.set_state(pickle.loads(pickle.dumps(one.get_state())))
        a, b = one.physics.model.ptr, other.physics.model.ptr
        for name in dir(a):
            value = getattr(a, name)
            if isinstance(value, np.ndarray) and not name.startswith(('_', 'bvh')):
                np.testing.assert_array_equal(getattr(b, name), value, name)
        np.testing.assert_array_equal(b.opt.gravity, a.opt.gravity)
        self.assertEqual(b.stat.meaninertia, a.stat.meaninertia)


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
            for path in leaves(state):
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

    def test_a_sealed_state_is_its_owners_deed(self):
        environment = suite.make(DOG, {'random': 6})
        environment.reset()
        environment.step(np.zeros(20))
        environment.set_state(states.seal({**environment.get_state(), 'steps': 0}))


BEYOND = {  # where no ground is drawn, by environment, and the height above the ground there
    DOG: (999_983.0, -999_983.0, 3e5), GAITS[0]: (999_983.0,),
    'PD_Biped2D_LLC_Flat_Step-v0': (999_983.0,),
    'PD_Biped3D_Imitate-Stairs_Terrain-v0': ((999_983.0, 0.0), (0.0, -999_983.0), (3e9, 0.0)),
    'PD_Biped3D_HLC_PathFollowing-v0': ((999_983.0, 0.0),),
}  # fmt: skip


class FarTest(parameterized.TestCase):
    """Who leaves the ground ends its episode; the others go on."""

    @parameterized.parameters(*((id_, place) for id_, places in BEYOND.items() for place in places))
    def test_beyond_the_border(self, id_, place):
        one, other = (VectorEnvironment(id_, 2, 1, 3, step_limit=None) for _ in range(2))
        idle = np.zeros((2, len(one.action_map)))
        for each in one, other:
            each.reset()
            each.step(idle)
        world, figure = one.task.world, one.task.figure
        place = np.atleast_1d(place)
        world.qpos[0, figure.pose_qpos[: len(place)]] = place
        world.qpos[0, figure.pose_qpos[1 if len(place) == 1 else 2]] += 5.0
        world.forward(world.all_ids)
        step, expected = one.step(idle), other.step(idle)
        np.testing.assert_array_equal(step.info['diverged'], [True, False])
        np.testing.assert_array_equal(step.terminated[0], True)
        self.assertTrue(np.isfinite(step.observation).all() and np.isfinite(step.reward).all())
        for _ in range(3):
            np.testing.assert_array_equal(step.observation[1], expected.observation[1])
            self.assertEqual(step.reward[1], expected.reward[1])
            step, expected = one.step(idle), other.step(idle)
            self.assertTrue(np.isfinite(step.observation).all())

    @parameterized.parameters(
        ('PD_Biped3D_Imitate-Ramp_Terrain-v0', (1000.9, 0.0)),
        ('PD_Biped3D_Imitate-Ramp_Terrain-v0', (3.0, 1000.5)),
        ('PD_Biped3D_Imitate-Stairs_Terrain-v0', (5.0, -1000.5)),
        ('PD_Biped3D_Imitate-Stairs_Terrain-v0', (5.0, 5000.0)),
    )
    def test_over_the_rim_of_the_ground(self, id_, place):
        environment = suite.make(id_, {'random': 3, 'step_limit': None})
        environment.reset()
        data, root = environment.physics.data, environment.task.figure.pose_qpos[:3]
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
        other = suite.make(DOG, {'random': 8, 'step_limit': None})
        other.set_state(pickle.loads(pickle.dumps(state)))
        np.testing.assert_array_equal(advance(other, 20), advance(environment, 20))
        for each in environment, other:
            np.testing.assert_array_equal(
                each.task.arena.grounds[0].window(-240, 961), ground.window(-240, 961)
            )


class DivergenceTest(parameterized.TestCase):
    """Who goes back to a state before the physics broke down goes on as if it never had."""

    def test_single(self):
        for id_ in ONE_OF_EACH:
            environment = suite.make(id_, {'random': 1})
            environment.reset()
            state, data = environment.get_state(), environment.physics.data
            kept, idle = environment.observation(), np.zeros(len(environment.action_map))
            expected = environment.step(idle)
            for field, value in BROKEN:
                with self.subTest(id_, field=field, value=value):
                    environment.set_state(state)
                    getattr(data, field)[:] = value
                    broken = environment.get_state()
                    step = environment.step(idle)
                    self.assertTrue(step.last() and step.discount == 0 and step.reward == 0)
                    self.assertTrue(environment.info['diverged'] and not environment.info['fell'])
                    np.testing.assert_equal(step.observation, kept)  # the last that was sound
                    self.assertTrue(environment.step(idle).first())
                    environment.set_state(state)
                    step = environment.step(idle)
                    self.assertEqual(step.reward, expected.reward)
                    np.testing.assert_equal(step.observation, expected.observation)
                    # A state that is broken itself: the episode ends or goes on, and the next is fine.
                    environment.set_state(broken)
                    for value in environment.step(idle).observation.values():
                        self.assertTrue(np.isfinite(value).all())
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

    def test_vector(self):
        for id_ in ONE_OF_EACH:
            options = {'num_threads': 1, 'seed': 1, 'autoreset': 'disabled'}
            one, other = (VectorEnvironment(id_, 2, **options) for _ in range(2))
            for each in one, other:
                each.reset()
            state, idle = one.get_state(), np.zeros((2, len(one.action_map)))
            expected = one.step(idle)
            for field, value in BROKEN:
                with self.subTest(id_, field=field, value=value):
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
        twin = pickle.loads(pickle.dumps(environment))
        self.assertEqual(twin.blocks, environment.blocks)
        np.testing.assert_array_equal(advance(twin, 60), advance(environment, 60))

    def test_an_environment_that_cannot_be_rebuilt_is_not_pickled(self):
        environment = Environment(suite.build_task(suite.find(DOG)))
        with self.assertRaisesRegex(TypeError, r'get_state\(\)'):
            pickle.dumps(environment)


if __name__ == '__main__':
    absltest.main()
