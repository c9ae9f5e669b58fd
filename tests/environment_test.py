"""Tests of trl_suite.environments.environment, over every environment of the catalogue."""

import gc
import json
import pathlib
import pickle
import threading
import weakref
from unittest import mock

import golden
import numpy as np
import pytest
from absl.testing import absltest, parameterized
from dm_control import composer, mjcf
from dm_control.composer.observation import observable
from dm_env import specs, test_utils
from helpers import (
    KINDS,
    advance,
    assert_goes_on,
    assert_refused,
    assert_rows_are_singles,
    links_on_ground,
)

from trl_suite import characters, describe, motion, policies, rendering, suite, terrain
from trl_suite.arenas import PlanarArena
from trl_suite.environments import vector
from trl_suite.environments.environment import Environment
from trl_suite.tasks import parts
from trl_suite.vector import VectorEnvironment

GAPS = 'PD_Biped2D_Gaps_Terrain-v0'
EXAMPLES = (  # built, stepped and closed
    GAPS, 'FSM_Raptor2D_Terrain_Slopes-v0', 'PD_Biped3D_LLC_General_Step-v0',
    'PD_Biped3D_HLC_LargeBlocks-v0',
)  # fmt: skip


def is_gait(id_):
    """Whether a step lasts a whole cycle, some 300 control steps."""
    return suite.find(id_).task_type == 'gait'


def is_high(id_):
    """Whether a step lasts a whole footstep, up to 15 control steps."""
    return suite.find(id_).task_type in ('goal_navigation', 'soccer')


# Numbers of the first steps, for seeds with which they do not depend on the last bits of anything,
# so that they hold on other processors.
ROOT = pathlib.Path(__file__).parents[1]
STORED = json.loads((ROOT / 'tests/golden.json').read_text())

# What papers and documentation say of each environment, reviewed; see `row`.
TABLE = {
    line.split()[0]: line for line in (ROOT / 'tests/environments.txt').read_text().splitlines()
}


def row(environment, spec):
    """The line of an environment in environments.txt.

    Id, other names, tags and type of the task; character, actuation, terrain and motion; options;
    step limit, duration of a step and of a physics step; observation blocks and actions; reward terms.
    """
    blocks = [f'{name} {part.stop - part.start}' for name, part in environment.blocks.items()]
    options = [f'{name} {value}' for name, value in sorted(spec.options.items())]
    step, physics = environment.control_timestep(), environment.physics.timestep()
    return ' | '.join((
        spec.id, ' '.join((f'{spec.domain}/{spec.task}', *spec.aliases)),
        ' '.join((*sorted(spec.tags), spec.task_type)),
        f'{spec.character} {spec.actuation} {spec.terrain} {spec.clip}', ', '.join(options),
        f'{environment.step_limit} x 1/{1 / step:.9g} s, 1/{1 / physics:.9g} s',
        f'{", ".join(blocks)}: {len(environment.action_map)}', ' '.join(environment.info['reward_terms']),
    ))  # fmt: skip


def random_actions(environment, steps, seed=0):
    spec = environment.action_spec()
    # Many cycles of random gaits last until truncation, which takes long.
    scale = 0.3 if hasattr(environment.task, 'gait') else 1.0
    return scale * np.random.default_rng(seed).uniform(
        spec.minimum, spec.maximum, (steps, *spec.shape)
    )


def rollout(environment, actions):
    """Observations, rewards, discounts and types of steps, as one array."""
    steps = [environment.reset(), *map(environment.step, actions)]
    return np.array([
        [*np.concatenate([*step.observation.values()]), step.reward or 0.0,
         np.nan if step.discount is None else step.discount, step.step_type]
        for step in steps
    ])  # fmt: skip


_last = {}  # id -> the environment that was built last


def newly_seeded(id_, seed, step_limit=256):
    """An environment before its first reset; one serves the tests of an id, which follow one another."""
    if id_ not in _last:
        _last.clear()
        _last[id_] = suite.make(id_)
    _last[id_].random_state.seed(seed)
    _last[id_].step_limit = step_limit
    return _last[id_]


def every_environment(id_):
    """Tests of one environment that apply to all."""
    gait, high = is_gait(id_), is_high(id_)

    class EveryEnvironment(absltest.TestCase):
        def test_it_is_as_reviewed(self):
            environment, spec = newly_seeded(id_, 0), suite.find(id_)
            environment.step_limit = spec.step_limit
            environment.reset()
            self.assertEqual(row(environment, spec), TABLE.get(id_))
            task = environment.task
            self.assertEqual(task.arena.terrain.name, spec.terrain)
            self.assertEqual(task.character.spec.name, spec.character)
            self.assertEqual(getattr(task, 'actuation_model', 'gait'), spec.actuation)
            motion = getattr(task, 'motion', getattr(task, 'clip', None))
            style = spec.options.get('style')
            expected = spec.clip if style is None else f'{spec.clip}_{style}'
            self.assertEqual(motion and motion.name, expected)
            stop, shapes = 0, environment.observation_spec()
            self.assertEqual(list(shapes), list(environment.blocks))  # terrain first
            for name, part in environment.blocks.items():
                self.assertEqual(part.start, stop)
                self.assertEqual(shapes[name].shape, (part.stop - stop,))
                self.assertEqual(shapes[name].dtype, np.float64)
                stop = part.stop
            actions = environment.action_spec()
            self.assertLen(actions.name.split('\t'), actions.shape[0])
            np.testing.assert_array_equal(actions.minimum, -np.ones(actions.shape))
            np.testing.assert_array_equal(actions.maximum, np.ones(actions.shape))
            for name in (*spec.aliases, f'{spec.domain}/{spec.task}'):
                self.assertIs(suite.find(name), spec)
            self.assertRegex(id_, r'^\w+(-\w+)?-v\d$')  # what Gymnasium takes for a name
            self.assertRegex(spec.description, r'^[A-Z].{,128}\.$')
            self.assertLen(spec.tags & {'original', 'completion', 'addition'}, 1)

        def test_simulations_equal_single_environments_and_are_sound(self):
            """With options: in state_test."""
            limit, steps = (1, 4) if gait else (3, 8) if high else (25, 52)
            scale = 0.3 if gait else np.array([[0.3], [1.0], [2.0]])
            one = newly_seeded(id_, 0, limit)
            found, ends = assert_rows_are_singles(
                id_, 3, steps, limit, scale=scale, seed=5, one=one
            )
            self.assertGreaterEqual(ends, 6)
            self.check(found)

        @pytest.mark.slow
        def test_long_random_rollout(self):
            environments = VectorEnvironment(id_, 2, 2, seed=1)
            environments.reset()
            draw, size = np.random.default_rng(1), len(environments.action_map)
            steps = [environments.step(draw.uniform(-1, 1, (2, size)))
                     for _ in range(200 if gait or high else 2500)]  # fmt: skip
            self.check(steps)
            self.assertTrue(any(step.terminated.any() or step.truncated.any() for step in steps))

        def check(self, steps):
            """Numbers are finite; rewards are in [0, 1], the sum of their terms, and 0 at a fall."""
            for step in steps:
                self.assertTrue(np.isfinite(step.observation).all())
                self.assertLess(np.abs(step.observation).max(), 1e4)
                self.assertTrue(((step.reward >= 0) & (step.reward <= 1)).all())
                terms = sum(step.info['reward_terms'].values())
                np.testing.assert_allclose(terms, step.reward, rtol=0, atol=1e-12)
                np.testing.assert_array_equal(step.reward[step.terminated], 0)

        def test_first_steps_equal_the_stored_ones(self):
            stored = dict(STORED[id_])
            # Planners of the record have another controller.
            environment = None if high else newly_seeded(id_, 0)
            found = golden.summary(id_, stored.pop('seed'), environment=environment)
            self.assertCountEqual(found, stored)
            for name, expected in stored.items():
                tolerance = golden.TOLERANCE
                np.testing.assert_allclose(
                    found[name][: len(expected)], expected, tolerance, tolerance, err_msg=name
                )

        def test_the_description_is_complete(self):
            sections = describe.sections(suite.find(id_), newly_seeded(id_, 0))
            found = ''.join(f'\n{title}\n{text}' for title, text in sections)
            self.assertNotRegex(found, r'\bnan\b|\binf\b|None|<')
            for title in ('Character', 'Links', 'Observation', 'Action', 'Terrain', 'Reward',
                          'Termination', 'Time', 'Differences'):  # fmt: skip
                self.assertIn(f'\n{title}', found)
            rules = suite.find(id_).task_type
            steps = rules == 'spatial_footsteps'
            for title, shown in (
                ('Clip:', not gait and not steps and not high), ('Gait:', gait),
                ('Parameters:', gait), ('Steps:', steps), ('Footstep controller\n', high),
                ('Plans:', steps or rules == 'planar_footsteps'),
            ):  # fmt: skip
                self.assertEqual(f'\n{title}' in found, shown, title)
            self.assertEqual('reward weight' in found, not gait and not high)

        if id_ in policies.available():

            def test_the_shipped_policy_fits(self):
                environment, policy = newly_seeded(id_, 0), policies.reference(id_)
                policy.check(environment)
                action = policy(environment.reset().observation)
                self.assertEqual(action.shape, environment.action_spec().shape)
                self.assertTrue(np.isfinite(action).all())

    return EveryEnvironment


def every_kind(id_):
    """Tests of dm_env, and others, of one environment of each kind."""
    gait, high = is_gait(id_), is_high(id_)

    class Kind(test_utils.EnvironmentTestMixin, absltest.TestCase):
        def make_object_under_test(self):
            if self._testMethodName == 'test_step_on_fresh_environment':
                _last.clear()
            return newly_seeded(id_, 0, 2 if gait or high else 12)  # so that episodes end

        def tearDown(self):
            absltest.TestCase.tearDown(self)  # the mixin's closes the environment

        def make_action(self):
            # dm_env uses the minimum: with such an action, a cycle of a gait lasts until truncation.
            return np.zeros(self.environment.action_spec().shape) if gait else super().make_action()

        def make_action_sequence(self):
            return random_actions(self.environment, 3 if gait or high else 30)

        def test_a_restored_state_continues_exactly(self):
            """With options: in state_test."""
            steps = 1 if gait else 2 if high else 5

            def go(environment, seed):
                return advance(environment, steps, seed, 0.3)

            environment = newly_seeded(id_, 6)
            other = suite.make(id_, {'random': 9})
            for each in (environment, other):
                each.reset()
                go(each, 0)
            assert_goes_on(environment, other, go)

        def test_far_actions_are_clipped(self):
            environment, found = self.environment, []
            for size in (1.0, 5.0, 1e200):
                environment.random_state.seed(4)
                found.append(rollout(environment, size * np.sign(random_actions(environment, 1))))
            np.testing.assert_array_equal(found[0], found[1])
            np.testing.assert_array_equal(found[0], found[2])

        if not gait:

            def test_a_fall_is_a_failure(self):
                environment = newly_seeded(id_, 5)
                environment.reset()
                fall_links = set(environment.task.character.spec.fall_links)
                for action in random_actions(environment, 250, seed=1):
                    step = environment.step(action)
                    if not high:  # otherwise contacts are sampled
                        touches = bool(links_on_ground(environment) & fall_links)
                        self.assertEqual(step.last(), touches)
                    if step.last():
                        break
                self.assertEqual((step.last(), step.discount, step.reward), (True, 0.0, 0.0))
                self.assertTrue(environment.info['fell'])
                self.assertFalse(environment.info['diverged'])
                self.assertEqual(set(environment.info['reward_terms'].values()), {0.0})
                self.assertNotEmpty(links_on_ground(environment) & fall_links)
                self.assertTrue(environment.step(action).first())
                self.assertFalse(environment.info['fell'])

        # Gaits and planners step their physics in the task: see gait_test, and below.
        if not gait and not high:

            def test_plain_composer_environment_agrees(self):
                ours = newly_seeded(id_, 3)
                theirs = composer.Environment(
                    suite.build_task(suite.find(id_)), random_state=3,
                    strip_singleton_obs_buffer_dim=True,
                )  # fmt: skip
                np.testing.assert_array_equal(theirs.action_spec().minimum, -1)
                np.testing.assert_array_equal(theirs.action_spec().maximum, 1)
                actions = random_actions(ours, 40)
                np.testing.assert_array_equal(rollout(ours, actions), rollout(theirs, actions))

    return Kind


for _ids, _make in (suite.ALL_IDS, every_environment), (KINDS, every_kind):
    for _id in _ids:
        _class = _make(_id)
        _class.__name__ = _class.__qualname__ = f'{_class.__name__}_{_id}'.replace('-', '_')
        globals()[_class.__name__] = _class
del _class  # else it would be collected twice


class PlainComposerTest(parameterized.TestCase):
    """What a plain composer.Environment does not know."""

    OURS = r'environments\.environment\.Environment'

    @parameterized.parameters(
        ('PD_Biped3D_HLC_Soccer-v0', {}, f'{OURS}, not.*composer'),
        ('PD_Biped3D_HLC_Forest-v0', {'interface': 'frame'}, f'{OURS}, not.*composer'),
        ('PD_Biped3D_HLC_Soccer-v0', {'rewards': {'idle': (0.1, lambda task: np.zeros(task.world.n))}}, OURS),
        ('FSM_Dog2D_Terrain_Slopes_Mixed-v0', {}, OURS), (GAPS, {'randomize': 'mild'}, 'pushes need'),
        (GAPS, {'actuators': {'noise': 0.1}}, 'not a plain composer.Environment'),
    )  # fmt: skip
    def test_it_is_rejected(self, id_, options, message):
        task = suite.build_task(suite.find(id_), options)
        environment = composer.Environment(task, random_state=3)
        environment.reset()
        with self.assertRaisesRegex(RuntimeError, message):
            environment.step(np.zeros(len(task.action_map)))

    @parameterized.parameters(
        'PD_Biped2D_Flat_Terrain-v0', 'FSM_Hopper2D_Terrain_Gaps-v0', 'PD_Biped3D_HLC_Soccer-v0'
    )
    def test_actions_of_other_shapes_are_rejected(self, id_):
        environment = composer.Environment(suite.build_task(suite.find(id_)), random_state=0)
        environment.reset()
        for size in (0, 1, 10**6):
            with self.assertRaisesRegex(ValueError, rf'action has shape \({size},\); expected'):
                environment.step(np.zeros(size))


class GoldenTest(absltest.TestCase):
    def test_all_environments_are_stored(self):
        """With steps: what follows a step in which the last bit may decide is left out."""
        self.assertCountEqual(STORED, suite.ALL_IDS)
        short = {id_ for id_, stored in STORED.items() if len(stored['reward']) < 2}
        self.assertEqual(
            short,
            {'PD_Biped3D_HLC_PathFollowing-v0', 'PD_Biped3D_HLC_PathFollowing_Run-v0'},
        )
        self.assertEqual([*TABLE], list(suite.ALL_IDS))


class ActionTest(parameterized.TestCase):
    """Bad actions are refused with a sentence; far ones are clipped."""

    def test_bad_actions_change_nothing(self):
        environment, single = suite.make(GAPS, {'random': 0}), np.zeros(11)
        environment.reset()
        before = pickle.dumps(environment.get_state())
        bad = []
        for value in (np.nan, np.inf, -np.inf):
            single[2] = value
            bad.append((single.copy(), rf'action\[2\] \(right_ankle\) is {value}'))
        bad += [
            (np.zeros(shape), r'shape .*; expected \(11,\)')
            for shape in ((), (1, 11), (10,), (12,))
        ]
        bad += [(each, 'not an array of numbers') for each in (['left'] * 11, [10**400] * 11)]
        for dtype in ('datetime64[D]', 'timedelta64[s]', complex, 'U1'):
            bad.append((np.zeros(11, int).astype(dtype), 'not an array of numbers: the type is'))
        assert_refused(self, *((lambda a=a: environment.step(a), message) for a, message in bad))
        self.assertEqual(pickle.dumps(environment.get_state()), before)
        self.assertTrue(environment.step(np.zeros(11)).mid())

    def test_the_given_action_is_not_changed(self):
        environment = suite.make(GAPS, {'random': 0})
        environment.reset()
        action = np.full(11, 2.0)
        environment.step(action)
        np.testing.assert_array_equal(action, 2.0)
        environment.step(list(action))


class ObservableTest(parameterized.TestCase):
    """A user's own observables in addition to the blocks."""

    def build(self):
        task = suite.build_task(suite.find('PD_Dog2D_Gaps_Terrain-v0'))
        character = task.character
        places = observable.Generic(lambda physics: physics.bind(character.bodies).xipos)
        for name, each in (
            ('joints_pos', observable.MJCFFeature('qpos', character.joints)),
            ('bodies_pos', places), ('root_pos', observable.MJCFFeature('xpos', character.root_body)),
        ):  # fmt: skip
            character.observables.add_observable(name, each)
        return Environment(task, random=7)

    def test_observables_are_current(self):
        environment = self.build()
        spec = environment.observation_spec()
        self.assertEqual(list(spec)[:4], ['terrain', 'pose', 'velocity', 'phase'])
        self.assertEqual(spec['dog/joints_pos'].shape, (20,))
        self.assertEqual(spec['dog/bodies_pos'].shape, (21, 3))
        names = [f'dog/{name}' for name in characters.CHARACTERS['dog'].joints]
        step = environment.reset()
        for action in random_actions(environment, 15):
            qpos = environment.physics.named.data.qpos
            found = np.array([qpos[name][0] for name in names])
            np.testing.assert_array_equal(step.observation['dog/joints_pos'], found)
            root = environment.physics.named.data.xpos['dog/root']
            np.testing.assert_array_equal(step.observation['dog/root_pos'], root)
            for name, each in spec.items():
                each.validate(step.observation[name])
            step = environment.step(action)

    def test_a_restored_state_has_its_random_stream(self):
        task = suite.build_task(suite.find(GAPS))
        noisy = observable.Generic(
            lambda _: 0.0, corruptor=lambda _, random_state: random_state.rand()
        )
        task.character.observables.add_observable('noise', noisy)
        environment = Environment(task, random=7)
        environment.reset()
        state, stream = environment.get_state(), environment.random_state.get_state()
        environment.set_state(state)
        for found, expected in zip(environment.random_state.get_state(), stream, strict=True):
            np.testing.assert_array_equal(found, expected)

    def test_returned_observations_are_not_overwritten(self):
        environment = suite.make(GAPS, {'random': 0})
        first = environment.reset().observation
        copies = {name: value.copy() for name, value in first.items()}
        for action in random_actions(environment, 5):
            environment.step(action)
        for name, value in first.items():
            np.testing.assert_array_equal(value, copies[name])
            value[:] = 77.0  # must not reach into the environment
        self.assertTrue((np.abs(environment.step(np.zeros(11)).observation['pose']) < 50).all())
        x = environment.physics.named.data.qpos['biped2d_full/root_x/'][0]
        self.assertEqual(environment.info['distance'], x)


class EndingTest(parameterized.TestCase):
    @parameterized.parameters((3, 'truncated'), (256, 'fell'))
    def test_the_cause_is_named_at_the_end_only(self, step_limit, cause):
        """With action 0 the biped falls within 4 s."""
        environment = newly_seeded('PD_Biped2D_LLC_Imitate_Flat-v0', 1, step_limit)
        time_step = environment.reset()
        while not time_step.last():
            self.assertEqual(environment.ending, '')
            time_step = environment.step(np.zeros(6))
        self.assertEqual(environment.ending, cause)
        environment.reset()
        self.assertEqual(environment.ending, '')

    @parameterized.parameters(
        ('diverged', {}),
        ('failed', {'failures': {'now': lambda task: np.ones(task.world.n, bool)}}),
    )
    def test_other_causes(self, cause, options):
        environment = suite.make('PD_Biped2D_LLC_Imitate_Flat-v0', {'random': 1, **options})
        environment.reset()
        if cause == 'diverged':
            environment.physics.data.qvel[:] = np.nan
        environment.step(np.zeros(6))
        self.assertEqual(environment.ending, cause)


class HookTest(parameterized.TestCase):
    """Substeps run in C: hooks between them are refused, not forgotten."""

    def task(self, **methods):
        """A task of the suite with other methods."""
        kind = type(suite.build_task(suite.find('PD_Biped2D_LLC_Imitate_Flat-v0')))
        character, arena = characters.make('biped2d'), PlanarArena(terrain.load('flat'))
        return type('Own', (kind,), methods)(character, arena, motion.load('biped2d_walk'))

    @parameterized.parameters('before_substep', 'after_substep')
    def test_invalid_arguments_are_rejected(self, hook):
        with self.assertRaisesRegex(ValueError, f'{hook} hook.*composer.Environment'):
            Environment(self.task(**{hook: lambda self, *_: None}))
        environment = Environment(self.task())
        with self.assertRaisesRegex(ValueError, f'{hook} hook'):
            environment.add_extra_hook(hook, lambda *_: None)
        with self.assertRaisesRegex(RuntimeError, 'compiled; set time steps before .* substeps'):
            environment.task.set_timesteps(0.02, 0.001)

    def test_other_hooks_run(self):
        environment, calls = Environment(self.task(), random=0), []
        environment.add_extra_hook('after_step', lambda *_: calls.append('after_step'))
        environment.add_extra_hook('initialize_episode', lambda *_: calls.append('reset'))
        environment.reset()
        environment.step(np.zeros(6))
        self.assertEqual(calls, ['reset', 'after_step'])
        hooked = suite.make(GAPS)
        hooked.add_extra_hook('after_step', print)
        with self.assertRaisesRegex(
            TypeError, 'hooks of add_extra_hook, which a pickle would lack'
        ):
            pickle.dumps(hooked)
        for name in 'initialize_episode_mjcf', 'after_compile':
            with self.assertRaisesRegex(
                ValueError, f'{name} hook: the model is compiled once.*before_step'
            ):
                environment.add_extra_hook(name, print)

    @parameterized.parameters('PD_Biped2D_Slopes_Terrain-v0', 'PD_Biped3D_Imitate-Hills_Terrain-v0')
    def test_a_hook_may_move_the_character_far_away(self, id_):
        def move(physics, _):
            physics.data.qpos[0] = 40.0

        environment = suite.make(id_, {'random': 1})
        environment.add_extra_hook('initialize_episode', move)
        height = environment.reset().observation['pose'][0]
        ground, (x, y, z) = environment.task.arena.grounds[0], parts.root(environment.task)[0]
        below = ground.height(x, y) if '3D' in id_ else ground.height(x)
        self.assertAlmostEqual(height, z - below, delta=0.02)

    def test_methods_of_a_task(self):
        """They are called, or refused; a vector environment calls none."""
        calls = []

        def after_step(task, physics, random_state):
            super(type(task), task).after_step(physics, random_state)
            calls.append(float(task.reward[0]))

        task = self.task(after_step=after_step)
        environment = Environment(task, random=0)
        environment.reset()
        self.assertEqual([environment.step(np.zeros(6)).reward], calls)
        for name in 'get_reward', 'get_discount', 'should_terminate_episode':
            with self.assertRaisesRegex(ValueError, f'overrides {name}.*finish_step'):
                Environment(self.task(**{name: lambda self, physics: 1.0}))
        with self.assertRaisesRegex(ValueError, 'initialize_episode_mjcf hook'):
            Environment(self.task(initialize_episode_mjcf=lambda self, random_state: None))

        def made(spec, options):
            return self.task(after_step=after_step)

        with (
            mock.patch.object(vector, 'build_task', made),
            self.assertRaisesRegex(ValueError, 'a hook after_step, which only a single'),
        ):
            VectorEnvironment('PD_Biped2D_Flat-v0', 2)

    def test_an_entity_places_itself(self):
        """Physics are consistent after it has changed its state at the beginning of an episode."""

        def place(prop, physics, random_state):
            physics.bind(prop.joint).qpos = 3, 0, 7, 1, 0, 0, 0

        ball, task = self.prop(initialize_episode=place), self.task()
        ball.joint = task.arena.attach(ball).add('freejoint')
        ball.mjcf_model.worldbody.add('geom', size=[0.1])
        environment = Environment(task, random=0)
        environment.reset()
        data = environment.physics.data
        self.assertAlmostEqual(data.geom_xpos[-1, 2], 7)
        root = environment.task.body.pose_qpos

        def raised(physics, random_state):
            physics.data.qpos[root[1]] += 0.25

        before = environment.reset().observation['pose'][0]
        environment.add_extra_hook('initialize_episode', raised)
        self.assertAlmostEqual(environment.reset().observation['pose'][0], before + 0.25, delta=0.1)

    def prop(self, **methods):
        """An entity with other methods."""

        class Prop(composer.Entity):
            def _build(self):
                self._root = mjcf.RootElement('prop')

            @property
            def mjcf_model(self):
                return self._root

        return type('Own', (Prop,), methods)()

    def test_an_entity_with_substep_hooks_is_rejected(self):
        task = self.task()
        task.arena.attach(self.prop(after_substep=lambda self, physics, random_state: None))
        with self.assertRaisesRegex(ValueError, 'after_substep hook'):
            Environment(task)


class DmEnvTest(absltest.TestCase):
    def test_the_action_of_a_reset_is_ignored(self):
        environment = suite.make(GAPS, {'random': 0, 'step_limit': 1})
        self.assertTrue(environment.step(None).first())
        environment.step(np.zeros(11))
        self.assertTrue(environment.at_limit)
        ended = environment.get_state()
        self.assertTrue(environment.step(np.full(11, np.nan)).first())
        self.assertFalse(environment.at_limit)
        environment.set_state(ended)
        self.assertEqual((environment.at_limit, environment.ending), (True, 'truncated'))

    def test_observables_of_users(self):
        """They keep their type and bounds."""
        task = HookTest().task()
        camera = observable.MJCFCamera(
            task.arena.mjcf_model.worldbody.add('camera', pos=[0, -4, 2]), 8, 12
        )
        camera.enabled = True
        task.task_observables['view'] = camera
        environment = Environment(task, random=0)
        view = environment.reset().observation['view']
        self.assertEqual((view.shape, view.dtype), ((8, 12, 3), np.uint8))
        environment.observation_spec()['view'].validate(view)
        self.assertIsInstance(environment.observation_spec()['view'], specs.BoundedArray)


class ConstructionTest(parameterized.TestCase):
    """Options of an environment."""

    def test_invalid_arguments_are_rejected(self):
        whole = 'step_limit is .*; expected None or a whole number at least 1'
        time = 'time_limit is .*; expected a positive number of seconds'
        common = (np.nan, 'abc', True, [2], np.arange(2), -1, 0)
        bad = [
            *(({'step_limit': value}, whole) for value in (2.5, np.inf, *common)),
            *(({'time_limit': value}, time) for value in (None, *common)),
            ({'random': np.random.RandomState(np.random.PCG64(1))}, 'a RandomState of PCG64; expected'),
            ({'random': -1}, 'random is -1'), ({'random': 2**32}, 'random is 4294967296'),
        ]  # fmt: skip
        assert_refused(
            self, *((lambda o=o: suite.make(GAPS, o), message) for o, message in bad),
            (lambda: suite.make(GAPS, {'time_limit': 5}, {'time_limit': 3}), 'time_limit is in task_kwargs and'),
        )  # fmt: skip
        for seed in (True, 1.0, '1', b'1', np.random.default_rng(1)):
            with self.assertRaisesRegex(TypeError, r'random is .*; expected a seed, an integer'):
                suite.make(GAPS, {'random': seed})

    def test_images_show_the_reward(self):
        """The body turns green with the fourth power of the reward; the ground does not."""
        shown = suite.load('plaid', 'biped_gaps', {'random': 1}, {'visualize_reward': True})
        self.assertIsNotNone(shown._colours)
        environment = suite.load('plaid', 'biped_gaps', {'random': 1}, visualize_reward=True)
        environment = pickle.loads(pickle.dumps(environment))
        environment.reset()
        model = environment.physics.model
        begun = model.geom_rgba.copy()
        share = environment.step(environment.task.clip_action(0)).reward ** 4
        moving = model.body_weldid[model.geom_bodyid] > 0
        expected = (1 - share) * begun[moving, :3] + share * np.array([0, 0.5, 0.3])
        np.testing.assert_allclose(model.geom_rgba[moving, :3], expected, rtol=1e-6)
        np.testing.assert_array_equal(model.geom_rgba[~moving], begun[~moving])
        self.assertGreater(share, 0.05)

    def test_no_compilation_after_construction(self):
        environment = suite.make(GAPS, {'random': 0})
        before = environment.physics.model.ptr
        for _ in range(3):
            environment.reset()
            environment.step(np.zeros(11))
        self.assertIs(environment.physics.model.ptr, before)

    def test_a_closed_environment_raises_errors(self):
        environment = suite.make('PD_Biped2D_Flat-v0', {'random': 0})
        environment.reset()
        state = environment.get_state()
        environment.close()
        environment.close()
        calls = (
            lambda: environment.step(np.zeros(11)), environment.reset, environment.get_state,
            lambda: environment.set_state(state), environment.observation,
            environment.observation_spec, lambda: environment.info, lambda: environment.physics,
            lambda: environment.add_extra_hook('before_step', print), lambda: environment.task,
            lambda: rendering.frame(environment), lambda: pickle.dumps(environment), environment.action_spec,
            environment.reward_spec, environment.discount_spec,
        )  # fmt: skip
        cases = ((call, 'the environment is closed') for call in calls)
        assert_refused(self, *cases, error=RuntimeError)

    @parameterized.parameters(*EXAMPLES)
    def test_close_frees_the_simulation(self, id_):
        environment = suite.make(id_, {'random': 0})
        environment.reset()
        environment.step(random_actions(environment, 1)[0])
        physics = environment.physics
        freed = [weakref.ref(each) for each in (physics.model.ptr, physics.data.ptr)]
        environment.close()
        mjcf.Physics.from_xml_string('<mujoco/>')  # dm_control keeps the last model it parsed
        gc.collect()
        self.assertEqual([each() for each in freed], [None, None])

    @parameterized.parameters(
        {}, {'levels': (0, 9)}, {'sensors': 'mild'}, {'randomize': 'mild'},
        {'actuators': {'delay': 20}}, {'rewards': {'fast': (0.1, parts.speed)}},
    )  # fmt: skip
    def test_close_frees_many_simulations_at_once(self, **options):
        """Not when Python collects garbage: a learner may make new ones in every stage."""
        environments = VectorEnvironment('PD_Biped2D_Flat-v0', 2, 1, task_kwargs=options)
        environments.reset()
        freed = weakref.ref(environments.core.world)
        gc.disable()
        self.addCleanup(gc.enable)
        environments.close()
        self.assertIsNone(freed())


class ThreadsTest(parameterized.TestCase):
    """A second thread is refused by name, for as long as the first one is inside."""

    def check(self, environment, calls):
        inside, leave, found = threading.Event(), threading.Event(), []
        step = environment.task.step

        def wait(*arguments):
            inside.set()
            leave.wait(60)
            return step(*arguments)

        def first():
            with mock.patch.object(environment.task, 'step', wait):
                found.append(calls[0]())

        thread = threading.Thread(target=first)
        thread.start()
        self.assertTrue(inside.wait(60))
        for call in calls:
            with self.assertRaisesRegex(RuntimeError, 'another thread.*one environment for each'):
                call()
        leave.set()
        thread.join()
        self.assertLen(found, 1)
        calls[0]()  # one after the other is fine

    def test_methods_of_a_single_environment(self):
        environment = suite.make(GAPS, {'random': 0})
        environment.reset()
        state = environment.get_state()
        self.check(environment, (
            lambda: environment.step(np.zeros(11)), environment.reset, environment.get_state,
            lambda: environment.set_state(state), environment.close,
            lambda: rendering.frame(environment),
        ))  # fmt: skip

    def test_methods_of_a_vector_environment(self):
        environments = VectorEnvironment(GAPS, 2, 1, seed=0)
        environments.reset()
        state = environments.get_state()
        self.check(environments, (
            lambda: environments.step(np.zeros((2, 11))), environments.reset, environments.render,
            environments.get_state, lambda: environments.set_state(state), environments.close,
            lambda: environments.copy_from(environments, [0], [1]), lambda: environments.seed(3),
        ))  # fmt: skip
