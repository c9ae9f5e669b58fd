"""Tests of the front door: names, aliases, options, free combinations."""

import dataclasses
import json
import pathlib
import re
import tempfile

import numpy as np
from absl.testing import absltest, parameterized
from helpers import KINDS, assert_refused

import trl_suite
from trl_suite import characters, motion, suite, terrain
from trl_suite.registry import catalogue

GAPS = 'PD_Biped2D_Gaps_Terrain-v0'
HIGH = 'PD_Biped3D_HLC_Forest-v0'
# Calls and messages.
UNKNOWN = (
    (lambda: suite.load('plad', 'biped_gaps'), "unknown domain 'plad'.*'plaid'"),
    (lambda: suite.load('plaid', 'biped_gap'), "unknown task.*'biped_gap'.*'biped_gaps'"),
    (lambda: suite.make('PD_Biped2D_Gap_Terrain-v0'), f"unknown environment.*'{GAPS}'"),
    (lambda: suite.make('pd_dog2d_steps_terrain-v0'), "'PD_Dog2D_Steps_Terrain-v0'"),
    (lambda: suite.make('plaid/dog_gap'), "unknown environment.*'plaid/dog_gaps'"),
    (lambda: suite.make(GAPS, {'terrain_sample': 3}), "unknown option.*'terrain_observation'"),
    (lambda: suite.make(GAPS, {'randm': 3}), "unknown option.*'random'"),
    (lambda: suite.make(GAPS, {'actuation_model': 'torque'}), 'unknown option'),
    (lambda: suite.make(GAPS, None, {'flat': 1}), "unknown option.*'flat_observation'"),
    (lambda: suite.make(GAPS, None, {'flat_observation': 'x'}), "flat_observation is 'x'; exp"),
    (lambda: suite.make('FSM_Dog2D_Terrain_Gap-v0'), "'FSM_Dog2D_Terrain_Gaps-v0'"),
    (lambda: suite.load('terrainrl', 'dog_gap'), "unknown task.*'dog_gaps'"),
    (lambda: suite.make('terrainrl/dog_gaps', {'start_phase': 0.5}), 'unknown option'),
    (lambda: suite.make('PD_Biped3D_HLC_Forrest-v0'), "'PD_Biped3D_HLC_Forest-v0'"),
    (lambda: suite.make('deeploco/hlc_forest', {'goal_reach': 2}), "unknown option.*'goal_reached'"),
    (lambda: suite.make(HIGH, {'controller': 'PD_Biped3D_LLC_General-v0'}),
     "^unknown controller 'PD_Biped3D_LLC_General.*Step-v0"),
    (lambda: suite.build('dgo'), "unknown character 'dgo'.*'dog'"),
    (lambda: suite.build('dog', 'torqe'), "unknown actuation .*'torqe'.*'torque'"),
    (lambda: suite.build('dog', terrain='gap'), "unknown terrain 'gap'.*'gaps'"),
    (lambda: suite.build('dog', task='imitate'), "unknown task 'imitate'.*'imitation'"),
    (lambda: suite.build('dog', clip='dog_bond'), "unknown clip 'dog_bond'.*'dog_bound'"),
)  # fmt: skip
OTHER_TYPES = (
    (lambda: suite.combine(None), 'character is None; expected a name, or what characters.from_file'),
    (lambda: suite.build(3), 'character is'), (lambda: suite.make(None), 'the id .* not None'),
    (lambda: suite.make([]), 'the id of an environment is a string'),
    (lambda: suite.build('dog', clip=3), 'clip is a name, a file, a Clip or FootstepLibrary, not 3'),
    (lambda: suite.build('dog', task=lambda *_, **__: None), 'task returned None; expected a Task'),
    (lambda: suite.make(GAPS, 3), 'task_kwargs is 3; expected a dict'),
    (lambda: suite.make(GAPS, None, 'x'), "environment_kwargs is 'x'; expected a dict"),
    (lambda: suite.make(HIGH, {'controller': 3}), 'controller is 3; expected the id of an environment'),
)  # fmt: skip
DO_NOT_FIT = (  # arguments of `suite.build`
    ({'character': 'dog', 'terrain': 'hills3d'},
     r"'dog' is planar and terrain 'hills3d' \(hills3d\) three-dimensional; presets that fit: .*flat"),
    ({'character': 'dog', 'terrain': 'hills3d', 'task': 'gait'}, "'dog' is planar and .*'hills3d'"),
    ({'character': 'biped3d', 'terrain': 'gaps'},
     "'biped3d' is three-dimensional and terrain 'gaps'.* planar; presets that fit: .*plane, ramp3d"),
    ({'character': 'biped3d_mocap', 'terrain': {'Type': 'var2d_gaps'}, 'task': 'footsteps'},
     "'biped3d_mocap' is three-dimensional and terrain 'var2d_gaps'"),
    ({'character': 'biped3d', 'task': 'gait'}, "'biped3d' is three-dimensional; the task 'gait'"),
    ({'character': 'dog', 'task': 'goal_navigation'}, "'dog' is planar; the task 'goal_navigation'"),
    ({'character': 'dog', 'task': 'footsteps'}, "'dog' has finger, toe as end effectors"),
    ({'character': 'hopper', 'task': 'footsteps'}, "'hopper' has no clip of its own"),
    ({'character': 'biped2d_full', 'task': 'footsteps', 'clip': motion.load_steps('biped3d_mocap')},
     "'biped3d_mocap' is a library of steps"),
    ({'character': 'biped3d', 'task': 'spatial_imitation'}, "unknown task 'spatial_imitation'"),
    ({'character': 'biped3d', 'task': 'footsteps'},
     'no library of steps of its own; pass clip=, one of .*biped3d_mocap'),
    ({'character': 'biped3d_mocap', 'task': 'footsteps', 'clip': 'biped3d_moca'},
     "unknown step library 'biped3d_moca'; did you mean 'biped3d_mocap'"),
    ({'character': 'biped3d_simbicon'}, "'biped3d_simbicon' has no clip of its own"),
    ({'character': 'biped3d', 'task': 'direct_navigation', 'task_kwargs': {'reward': 'original'}},
     "unknown character with reward='original', which needs its steps 'biped3d'; did you mean 'biped3d_mocap'"),
    ({'character': 'biped3d_mocap', 'task': 'direct_navigation', 'clip': motion.load('biped3d_mocap_run'),
      'task_kwargs': {'reward': 'original'}}, "clip 'biped3d_mocap_run': reward='original' takes the steps"),
    ({'character': 'biped3d_mocap', 'clip': motion.load_steps('biped3d_mocap')},
     "'biped3d_mocap' is a library of steps; to be imitated"),
    ({'character': 'biped3d', 'task': 'footsteps', 'clip': motion.load('biped3d_walk')},
     "'biped3d_walk' is a clip; for footsteps"),
)  # fmt: skip


class CatalogueTest(absltest.TestCase):
    """Names and numbers; environment_test compares each `EnvSpec` with environments.txt."""

    def test_names_are_unique(self):
        specs = catalogue.SPECS
        for names in (suite.ALL_IDS, suite.ALL_TASKS, {spec.description for spec in specs}):
            self.assertLen(set(names), len(specs))
        every = [*suite.ALL_IDS, *catalogue.ALIASES]
        self.assertLen(set(every), len(every))

    def test_tables(self):
        self.assertEqual([*suite.TASKS_BY_DOMAIN], ['plaid', 'imitation', 'terrainrl', 'deeploco'])
        flat = [(domain, task) for domain, tasks in suite.TASKS_BY_DOMAIN.items() for task in tasks]
        self.assertCountEqual(flat, suite.ALL_TASKS)
        originals = [spec for spec in catalogue.SPECS if 'original' in spec.tags]
        # 21 of PLAiD, 9 planar and 6 spatial of Imitation, 32 gaits, 4 of footsteps, 6 above them, 4 without.
        self.assertLen(originals, 82)
        self.assertLen(suite.BENCHMARKING, 82)

    def test_specs_are_immutable(self):
        spec = suite.find(GAPS)
        with self.assertRaises(AttributeError):
            spec.terrain = 'flat'
        with self.assertRaises(TypeError):
            spec.options['terrain_observation'] = 3


class LoadTest(parameterized.TestCase):
    """load, make, find."""

    def test_one_environment_by_every_name(self):
        """environment_test checks that all names of an environment mean the same `EnvSpec`."""
        found = [
            each.reset().observation['terrain'] for each in (
                suite.make(GAPS, {'random': 1}), suite.load('plaid', 'biped_gaps', {'random': 1}),
                trl_suite.suite.make('plaid/biped_gaps', task_kwargs={'random': 1}, environment_kwargs={}),
            )
        ]  # fmt: skip
        np.testing.assert_array_equal(found[1:], [found[0]] * 2)

    def test_public_names(self):
        for name in ('ALL_IDS', 'ALL_TASKS', 'BENCHMARKING', 'TASKS_BY_DOMAIN'):
            self.assertIs(getattr(trl_suite, name), getattr(suite, name))
        self.assertEqual((trl_suite.load, trl_suite.make), (suite.load, suite.make))
        self.assertRegex(trl_suite.__version__, r'^\d+\.\d+\.\d+$')
        with self.assertRaises(AttributeError):
            _ = trl_suite.no_such_thing

    def test_unknown_names_get_the_closest_ones(self):
        assert_refused(self, *(
            (call, re.compile(message, re.DOTALL)) for call, message in UNKNOWN
        ))  # fmt: skip

    def test_other_types_are_named(self):
        assert_refused(self, *OTHER_TYPES, error=TypeError)

    def test_given_options_are_not_changed(self):
        task_kwargs, environment_kwargs = {'random': 1, 'substeps': 8}, {'flat_observation': True}
        suite.make(GAPS, task_kwargs, environment_kwargs)
        self.assertEqual(task_kwargs, {'random': 1, 'substeps': 8})
        self.assertEqual(environment_kwargs, {'flat_observation': True})


class OptionTest(parameterized.TestCase):
    """Options are honoured."""

    def test_options_of_a_task(self):
        environment = suite.make(GAPS, {
            'terrain_observation': 8, 'reference_observation': True, 'substeps': 20, 'action_offset': 'posture',
            'action_scale': 0.5,
        })  # fmt: skip
        self.assertAlmostEqual(environment.physics.timestep(), 1 / 600)
        self.assertEqual(environment.observation_spec()['terrain'].shape, (8,))
        self.assertEqual(list(environment.blocks), ['terrain', 'pose', 'velocity', 'reference'])
        np.testing.assert_array_equal(environment.action_map.action_offset, 0)  # the posture
        np.testing.assert_array_equal(environment.action_map.action_scale, 0.5)
        blind = suite.make(GAPS, {'random': 0, 'terrain_observation': 0})
        self.assertNotIn('terrain', blind.observation_spec())

    def test_limits(self):
        self.assertEqual(suite.make(GAPS).step_limit, 256)
        self.assertEqual(suite.make(GAPS, {'step_limit': 9}).step_limit, 9)
        self.assertEqual(suite.make(GAPS, None, {'step_limit': 9}).step_limit, 9)
        self.assertIsNone(suite.make(GAPS, {'step_limit': None}).step_limit)

    @parameterized.parameters(*(id_ for id_ in KINDS if 'FSM' in id_ or '_HLC_' not in id_))
    def test_common_options(self, id_):
        gait = id_.startswith('FSM')
        own = {'start_noise': 0.01} if gait else {'start_phase': 0.5}
        environment = suite.make(id_, {'random': 3, 'step_limit': 2, **own})
        starts = [environment.reset().observation for _ in range(2)]
        if gait:
            self.assertTrue((starts[0]['pose'] != starts[1]['pose']).any())
        else:
            self.assertAlmostEqual(float(environment.task.phase[0]), 0.5)
        if 'phase' in starts[1]:
            # Mirrored, it is the phase of a single step, and the second one begins at one half.
            phase = 0.0 if 'Symetric' in id_ else 0.5
            self.assertAlmostEqual(starts[1]['phase'][0], phase)
        for last in (False, True):
            step = environment.step(np.zeros(environment.action_spec().shape))
            self.assertEqual(step.last(), last)

    @parameterized.product(
        id_=('PD_Biped2D_Gaps_Terrain-v0', 'FSM_Goat2D_Terrain_Variable_Steps-v0'),
        length=(None, 0.1),
    )
    def test_faces_become_ramps(self, id_, length):
        environment = suite.make(id_, {'random': 0, 'face_length': length})
        environment.reset()
        _, vertical = environment.task.arena.grounds[0].window(0, 4000)
        self.assertEqual(bool(vertical.any()), length is None)


class BuildTest(parameterized.TestCase):
    """Combinations that the catalogue does not name."""

    @parameterized.parameters(*sorted(
        {(name, model) for name, spec in characters.CHARACTERS.items()
         for model in ('position', 'torque', 'velocity', 'muscle')
         if spec.clip and (model != 'muscle' or not spec.spatial)}
        - {(spec.character, spec.actuation) for spec in catalogue.SPECS}
    ))  # fmt: skip
    def test_characters_and_models_without_an_environment(self, name, model):
        environment = suite.build(name, model, task_kwargs={'random': 0})
        environment.reset()
        rng = np.random.default_rng(0)
        for _ in range(30):
            step = environment.step(rng.uniform(-1, 1, len(environment.action_map)))
            for value in step.observation.values():
                self.assertTrue(np.isfinite(value).all())

    @parameterized.parameters(
        *sorted({*terrain.PRESETS} - {spec.terrain for spec in catalogue.SPECS})
    )
    def test_presets_without_an_environment(self, preset):
        environment = suite.build('biped2d', terrain=preset, task_kwargs={'random': 0})
        for _ in range(2):
            environment.reset()
            step = environment.step(np.zeros(len(environment.action_map)))
            self.assertTrue(np.isfinite(step.observation['pose']).all())

    @parameterized.parameters(
        ('biped3d', 'imitation', 'biped3d_walk'), ('biped3d_mocap', 'imitation', 'biped3d_mocap_walk'),
        ('biped3d_full_mocap', 'imitation', 'biped3d_full_walk'), ('biped3d_mocap', 'footsteps', 'biped3d_mocap'),
        ('biped3d_mocap_run', 'footsteps', 'biped3d_mocap_run'), ('goat', 'imitation', 'dog_bound'),
    )  # fmt: skip
    def test_defaults_of_characters(self, character, task, clip):
        environment = suite.build(character, task=task, task_kwargs={'random': 0})
        ground = 'flat' if character == 'goat' else 'plane'
        again = suite.build(character, 'position', ground, task, clip, {'random': 0})
        ours, theirs = environment.reset().observation, again.reset().observation
        self.assertEqual('plan' in ours, task == 'footsteps')
        for name, value in ours.items():
            np.testing.assert_array_equal(theirs[name], value)
        self.assertEqual(suite.build('hopper', task='gait').task.arena.terrain.name, 'flat')

    def test_parts_by_name_file_and_object(self):
        """All give the same environment."""
        folder = pathlib.Path(self.enterContext(tempfile.TemporaryDirectory()))
        content = {'Type': 'var2d_steps', 'Params': [{'StepH0Min': 0.3, 'StepH0Max': 0.3}]}
        (folder / 'mine.json').write_text(json.dumps(content))
        walk, steps = motion.load('biped2d_walk'), motion.load_steps('biped3d_mocap')
        walk.save(folder / 'walk.npz'), steps.save(folder / 'steps.npz')
        for character, task, part, block, sources in (
            ('dog', 'imitation', 'terrain', 'pose', (content, folder / 'mine.json', terrain.load(content))),
            ('biped2d', 'imitation', 'clip', 'pose', ('biped2d_walk', folder / 'walk.npz', walk, None)),
            ('biped3d_mocap', 'footsteps', 'clip', 'plan', ('biped3d_mocap', folder / 'steps.npz', steps, None)),
        ):  # fmt: skip
            found = []
            for source in sources:
                given = str(source) if isinstance(source, pathlib.Path) else source
                environment = suite.build(
                    character, task=task, task_kwargs={'random': 2}, **{part: given}
                )
                found.append(environment.reset().observation[block])
                np.testing.assert_array_equal(found[-1], found[0])

    def test_parts_that_do_not_fit_are_rejected(self):
        assert_refused(
            self, *((lambda a=a: suite.build(**a), message) for a, message in DO_NOT_FIT)
        )
        spec = dataclasses.replace(suite.find('PD_Biped3D_Imitate-v0'), terrain='gaps')
        assert_refused(self, (
            lambda: suite.build_task(spec), "'biped3d' is three-dimensional and terrain 'gaps'"
        ), (
            lambda: suite.build_task(suite.find('PD_Biped2D_Flat-v0'), {'step_limit': 5}),
            'step_limit is an option of the environment',
        ))  # fmt: skip
