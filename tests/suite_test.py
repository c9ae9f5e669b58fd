"""Tests of the front door: names, aliases, options, free combinations."""

import dataclasses
import json
import pathlib
import re
import tempfile

import numpy as np
from absl.testing import absltest, parameterized

import trl_suite
from trl_suite import catalogue, characters, motion, resources, suite, terrain

GAPS = 'PD_Biped2D_Gaps_Terrain-v0'
# The ids that the original registers: 21 of PLAiD and 9 of planar Imitation.
ORIGINAL = (
    *(
        f'PD_Biped2D_{ground}_Terrain-v0'
        for ground in ('Flat', 'Incline', 'Steps', 'Slopes', 'Gaps', 'Walls', 'Slopes_Mixed')
    ),
    *(
        f'PD_{figure}_{ground}_Terrain-v0'
        for figure in ('Dog2D', 'Raptor2D')
        for ground in ('Incline', 'Steps', 'Slopes', 'Gaps', 'Walls', 'Slopes_Mixed')
    ),
    'PD_Biped2D_Flat-v0', 'PD_Biped2D_Incline-v0',
    *(
        f'{model}_{figure}_LLC_Imitate_Flat-v0'
        for model in ('PD', 'Torque', 'MTU')
        for figure in ('Biped2D', 'Dog2D', 'Raptor2D')
    ),
)  # fmt: skip
TERRAINS = {
    'Flat': 'flat', 'Incline': 'inclines', 'Steps': 'steps_humanoid', 'Slopes': 'slopes_humanoid',
    'Gaps': 'gaps_humanoid', 'Walls': 'walls_humanoid', 'Mixed': 'mixed_humanoid',
    'Slopes_Mixed': 'slopes_mixed_humanoid',
}  # fmt: skip
MODELS = {'PD': 'position', 'Torque': 'torque', 'MTU': 'muscle', 'Vel': 'velocity'}


# Of the gait machines 32 are registered; the others complete what the papers name.
GAIT_TERRAINS = {
    'Gaps': 'gaps', 'Cliffs': 'cliffs_humanoid', 'Mixed': 'mixed', 'Slopes_Mixed': 'slopes_mixed',
    'Slopes': 'slopes', 'Stairs_Rugged': 'cliffs_rugged', 'Walls': 'walls', 'Steps': 'steps',
}  # fmt: skip
GAITS = {
    **{
        f'FSM_{figure}_Terrain_{ground}-v0': preset
        for figure in ('Dog2D', 'Raptor2D', 'Biped2D', 'Hopper2D')
        for ground, preset in GAIT_TERRAINS.items()
    },
    'FSM_Dog2D_Terrain_Narrow_Gaps-v0': 'narrow_gaps',
    'FSM_Dog2D_Terrain_Tight_Gaps-v0': 'tight_gaps',
    'FSM_Dog2D_Terrain_Slopes_Gaps-v0': 'slopes_gaps0',
    'FSM_Dog2D_Terrain_Slopes_Steps-v0': 'slopes_steps',
    'FSM_Dog2D_Terrain_Slopes_Walls-v0': 'slopes_walls',
    'FSM_Raptor2D_Terrain_Narrow_Gaps-v0': 'narrow_gaps',
    'FSM_Raptor2D_Terrain_Mixed_Raptor-v0': 'mixed_raptor',
    'FSM_Goat2D_Terrain_Variable_Steps-v0': 'cliffs_rugged',
    'FSM_Goat2D_Terrain_Cliffs-v0': 'cliffs_humanoid',
    'FSM_Hopper2D_Terrain_Gaps_Easy-v0': 'gaps_hopper',
    'FSM_Hopper2D_Terrain_Mixed_Easy-v0': 'mixed_hopper',
}
FIGURES = {
    'Dog2D': 'dog', 'Goat2D': 'goat', 'Raptor2D': 'raptor', 'Biped2D': 'biped2d_simbicon',
    'Hopper2D': 'hopper',
}  # fmt: skip


def ids_of(rules):
    """Rows of one task class."""
    return [id_ for id_ in suite.ALL_IDS if suite.find(id_).rules == rules]


def imitation_ids():
    """Rows of the two planar families of tracking."""
    return ids_of('imitation')


class CatalogueTest(parameterized.TestCase):
    """Every environment is a row."""

    def test_counts(self):
        rows = [suite.find(id_) for id_ in imitation_ids()]
        self.assertLen(rows, 42)
        self.assertLen([row for row in rows if 'original' in row.tags], 30)
        self.assertLen(ORIGINAL, 30)
        gaits = [suite.find(id_) for id_ in ids_of('gait')]
        self.assertLen(gaits, 43)
        self.assertLen([row for row in gaits if 'original' in row.tags], 32)

    def test_the_originals_are_tagged(self):
        tagged = {id_ for id_ in imitation_ids() if 'original' in suite.find(id_).tags}
        self.assertEqual(tagged, set(ORIGINAL))
        for id_ in imitation_ids():
            self.assertLen(suite.find(id_).tags & {'original', 'completion'}, 1, id_)
        tagged = [id_ for id_ in ids_of('gait') if 'original' in suite.find(id_).tags]
        self.assertCountEqual(tagged, list(GAITS)[:32])

    def test_gaits(self):
        self.assertCountEqual(ids_of('gait'), GAITS)
        for id_, preset in GAITS.items():
            row = suite.find(id_)
            figure = id_.split('_')[1]
            self.assertEqual((row.terrain, row.character), (preset, FIGURES[figure]))
            self.assertEqual((row.domain, row.actuation, row.clip), ('terrainrl', 'gait', None))
            ground = id_.split('_', 3)[3].removesuffix('-v0')
            self.assertEqual(row.task, f'{figure[:-2]}_{ground}'.lower())
            self.assertEqual((dict(row.options), row.step_limit), ({}, 256))

    @parameterized.parameters(*list(GAITS)[::4])
    def test_what_an_id_of_a_gait_says(self, id_):
        environment = suite.make(id_, {'random': 0})
        task = environment.task
        self.assertEqual(task.arena.terrain.name, GAITS[id_])
        self.assertEqual(task.character.row.name, FIGURES[id_.split('_')[1]])
        self.assertEqual(task.interface, 'parameters')
        self.assertEqual(list(environment.blocks), ['terrain', 'pose', 'velocity'])
        self.assertEqual(environment.step_limit, 256)
        self.assertAlmostEqual(environment.physics.timestep(), 1 / 1200)

    def test_names_are_unique(self):
        self.assertLen(set(suite.ALL_IDS), len(catalogue.ROWS))
        self.assertLen(set(suite.ALL_TASKS), len(catalogue.ROWS))
        every = [*suite.ALL_IDS, *catalogue.ALIASES]
        self.assertLen(set(every), len(every))

    @parameterized.parameters(*suite.ALL_IDS)
    def test_row(self, id_):
        row = suite.find(id_)
        self.assertEqual(row.id, id_)
        self.assertRegex(id_, r'^\w+-v\d$')
        self.assertRegex(row.description, r'^[A-Z].*\.$')
        self.assertNotIn('\n', row.description)
        self.assertLess(len(row.description), 130)
        self.assertIn(row.character, characters.CHARACTERS)
        self.assertIn(row.domain, suite.TASKS_BY_DOMAIN)
        self.assertRegex(row.task, r'^[a-z0-9_]+$')
        terrain.load(row.terrain)

    def test_descriptions_differ(self):
        descriptions = [suite.find(id_).description for id_ in suite.ALL_IDS]
        self.assertLen(set(descriptions), len(descriptions))

    @parameterized.parameters(*imitation_ids())
    def test_what_an_id_says(self, id_):
        row, parts = suite.find(id_), id_.removesuffix('-v0').split('_')
        environment = suite.make(id_, {'random': 0})
        task = environment.task
        self.assertEqual(task.actuation_model, MODELS[parts[0]])
        figure = {'Dog2D': 'dog', 'Raptor2D': 'raptor'}.get(
            parts[1], 'biped2d' if 'LLC' in parts else 'biped2d_full'
        )
        self.assertEqual(task.character.row.name, figure)
        ground = 'Flat' if 'LLC' in parts else '_'.join(p for p in parts[2:] if p != 'Terrain')
        self.assertEqual(task.arena.terrain.name, TERRAINS[ground])
        clips = {'dog': 'dog_bound', 'biped2d_full': 'biped2d_full_walk', 'biped2d': 'biped2d_walk'}
        if 'Run' in parts:
            clip = 'biped2d_run'
        elif figure == 'raptor':
            # 0.5 s for PD targets, 0.66 s for the other models.
            clip = 'raptor_run_050' if parts[0] == 'PD' else 'raptor_run_066'
        else:
            clip = clips[figure]
        self.assertEqual(task.clip.name, clip)
        self.assertEqual('terrain' in environment.blocks, 'Terrain' in parts)
        self.assertEqual('target' in environment.blocks, 'LLC' in parts)
        self.assertEqual(environment.step_limit, 256)
        self.assertAlmostEqual(environment.control_timestep(), 1 / 30)
        self.assertEqual(dict(row.options), dict(suite.find(id_).options))

    def test_tables(self):
        self.assertEqual(
            {domain: len(tasks) for domain, tasks in suite.TASKS_BY_DOMAIN.items()
             if domain in ('plaid', 'imitation', 'terrainrl')},
            {'plaid': 28, 'imitation': 14, 'terrainrl': 43},
        )  # fmt: skip
        flat = [(domain, task) for domain, tasks in suite.TASKS_BY_DOMAIN.items() for task in tasks]
        self.assertCountEqual(flat, suite.ALL_TASKS)
        self.assertEqual(
            set(suite.BENCHMARKING),
            {(r.domain, r.task) for r in catalogue.ROWS if 'original' in r.tags},
        )
        self.assertLess(set(suite.BENCHMARKING), set(suite.ALL_TASKS))

    def test_rows_cannot_be_changed(self):
        row = suite.find(GAPS)
        with self.assertRaises(AttributeError):
            row.terrain = 'flat'
        with self.assertRaises(TypeError):
            row.options['terrain_samples'] = 3


class LoadTest(parameterized.TestCase):
    """load, make, find."""

    def first(self, environment):
        return environment.reset().observation

    def test_one_environment_by_every_name(self):
        by_id = self.first(suite.make(GAPS, {'random': 1}))
        for other in (
            suite.load('plaid', 'biped_gaps', {'random': 1}),
            suite.make('plaid/biped_gaps', {'random': 1}),
            trl_suite.load('plaid', 'biped_gaps', {'random': 1}),
            trl_suite.make(GAPS, {'random': 1}),
            trl_suite.suite.make(GAPS, task_kwargs={'random': 1}, environment_kwargs={}),
        ):
            for name, value in self.first(other).items():
                np.testing.assert_array_equal(value, by_id[name])

    def test_public_names(self):
        for name in ('ALL_IDS', 'ALL_TASKS', 'BENCHMARKING', 'TASKS_BY_DOMAIN'):
            self.assertIs(getattr(trl_suite, name), getattr(suite, name))
        self.assertRegex(trl_suite.__version__, r'^\d+\.\d+\.\d+$')
        with self.assertRaises(AttributeError):
            _ = trl_suite.no_such_thing

    @parameterized.parameters(
        (lambda: suite.load('plad', 'biped_gaps'), "unknown domain 'plad'.*'plaid'"),
        (lambda: suite.load('plaid', 'biped_gap'), "unknown task.*'biped_gap'.*'biped_gaps'"),
        (lambda: suite.make('PD_Biped2D_Gap_Terrain-v0'), f"unknown environment.*'{GAPS}'"),
        (lambda: suite.make('pd_dog2d_steps_terrain-v0'), "'PD_Dog2D_Steps_Terrain-v0'"),
        (lambda: suite.make('plaid/dog_gap'), "unknown environment.*'plaid/dog_gaps'"),
        (lambda: suite.make(GAPS, {'terrain_sample': 3}), "unknown option.*'terrain_samples'"),
        (lambda: suite.make(GAPS, {'randm': 3}), "unknown option.*'random'"),
        (lambda: suite.make(GAPS, {'actuation_model': 'torque'}), 'unknown option'),
        (lambda: suite.make(GAPS, None, {'flat': 1}), "unknown option.*'flat_observation'"),
        (lambda: suite.make('FSM_Dog2D_Terrain_Gap-v0'), "'FSM_Dog2D_Terrain_Gaps-v0'"),
        (lambda: suite.load('terrainrl', 'dog_gap'), "unknown task.*'dog_gaps'"),
        (lambda: suite.make('terrainrl/dog_gaps', {'start_phase': 0.5}), 'unknown option'),
        (lambda: suite.build('dgo'), "unknown character 'dgo'.*'dog'"),
        (lambda: suite.build('dog', 'torqe'), "unknown actuation 'torqe'.*'torque'"),
        (lambda: suite.build('dog', terrain='gap'), "unknown terrain 'gap'.*'gaps'"),
        (lambda: suite.build('dog', task='imitate'), "unknown task 'imitate'.*'imitation'"),
        (lambda: suite.build('dog', clip='dog_bond'), "unknown clip 'dog_bond'.*'dog_bound'"),
    )
    def test_unknown_names_get_the_closest_ones(self, call, message):
        with self.assertRaisesRegex(ValueError, re.compile(message, re.DOTALL)):
            call()

    def test_given_options_are_not_changed(self):
        task_kwargs, environment_kwargs = {'random': 1, 'substeps': 8}, {'flat_observation': True}
        suite.make(GAPS, task_kwargs, environment_kwargs)
        self.assertEqual(task_kwargs, {'random': 1, 'substeps': 8})
        self.assertEqual(environment_kwargs, {'flat_observation': True})


class OptionTest(parameterized.TestCase):
    """Options are honoured."""

    def test_substeps(self):
        environment = suite.make(GAPS, {'substeps': 20})
        self.assertAlmostEqual(environment.physics.timestep(), 1 / 600)

    def test_terrain_samples(self):
        environment = suite.make(GAPS, {'random': 0, 'terrain_samples': 8})
        self.assertEqual(environment.observation_spec()['terrain'].shape, (8,))
        blind = suite.make(GAPS, {'random': 0, 'terrain_samples': 0})
        self.assertNotIn('terrain', blind.observation_spec())

    def test_target(self):
        environment = suite.make(GAPS, {'random': 0, 'target': True})
        self.assertEqual(list(environment.blocks), ['terrain', 'pose', 'velocity', 'target'])

    def test_position_range(self):
        environment = suite.make(GAPS, {'centre': 'posture', 'half_range': 0.5})
        np.testing.assert_array_equal(environment.action_map.centre, 0)  # the biped's posture
        np.testing.assert_array_equal(environment.action_map.half_range, 0.5)

    def test_limits(self):
        self.assertEqual(suite.make(GAPS, {'step_limit': 9}).step_limit, 9)
        self.assertEqual(suite.make(GAPS, None, {'step_limit': 9}).step_limit, 9)
        self.assertIsNone(suite.make(GAPS, {'step_limit': None}).step_limit)

    @parameterized.parameters(*ids_of('gait'))
    def test_common_options_on_every_gait(self, id_):
        environment = suite.make(id_, {'random': 3, 'step_limit': 1, 'start_noise': 0.01})
        starts = [environment.reset().observation['pose'] for _ in range(2)]
        self.assertTrue((starts[0] != starts[1]).any())
        step = environment.step(np.zeros(environment.action_spec().shape))
        self.assertTrue(step.last())
        self.assertBetween(step.reward, 0, 1)

    @parameterized.parameters(*imitation_ids())
    def test_common_options_on_every_row(self, id_):
        environment = suite.make(id_, {'random': 3, 'step_limit': 2, 'start_phase': 0.5})
        step = environment.reset()
        if 'phase' in step.observation:
            self.assertAlmostEqual(step.observation['phase'][0], 0.5)
        self.assertAlmostEqual(float(environment.task.phase[0]), 0.5)
        environment.step(np.zeros(environment.action_spec().shape))
        self.assertTrue(environment.step(np.zeros(environment.action_spec().shape)).last())


class BuildTest(parameterized.TestCase):
    """Combinations that the catalogue does not name."""

    @parameterized.parameters(
        *(
            (name, model)
            for name in suite.DEFAULT_CLIPS
            for model in ('position', 'torque', 'velocity', 'muscle')
        )
    )
    def test_every_character_with_every_model(self, name, model):
        environment = suite.build(name, model, task_kwargs={'random': 0})
        environment.reset()
        rng = np.random.default_rng(0)
        for _ in range(30):
            step = environment.step(rng.uniform(-1, 1, len(environment.action_map)))
            for value in step.observation.values():
                self.assertTrue(np.isfinite(value).all())

    @parameterized.parameters(*sorted(terrain.PRESETS))
    def test_every_preset(self, preset):
        environment = suite.build('biped2d', terrain=preset, task_kwargs={'random': 0})
        for _ in range(3):
            environment.reset()
            step = environment.step(np.zeros(6))
            self.assertTrue(np.isfinite(step.observation['pose']).all())

    def test_terrain_as_mapping_file_and_object(self):
        content = {'Type': 'var2d_steps', 'Params': [{'StepH0Min': 0.3, 'StepH0Max': 0.3}]}
        with tempfile.TemporaryDirectory() as folder:
            path = pathlib.Path(folder) / 'mine.json'
            path.write_text(json.dumps(content))
            blocks = [
                suite.build('dog', terrain=source, task_kwargs={'random': 2, 'terrain_samples': 50})
                .reset()
                .observation['pose']
                for source in (content, str(path), terrain.load(content))
            ]
        np.testing.assert_array_equal(blocks[0], blocks[1])
        np.testing.assert_array_equal(blocks[0], blocks[2])

    def test_clips(self):
        walk = motion.load('biped2d_walk')
        found = []
        with tempfile.TemporaryDirectory() as folder:
            path = pathlib.Path(folder) / 'mine.npz'
            walk.save(path)
            for clip in ('biped2d_walk', walk, str(path), None):
                environment = suite.build('biped2d', clip=clip, task_kwargs={'random': 0})
                found.append(environment.reset().observation['pose'])
        for pose in found[1:]:
            np.testing.assert_array_equal(pose, found[0])

    def test_a_row_of_the_users_own(self):
        row = dataclasses.replace(
            characters.CHARACTERS['biped2d'], name='mine', fall_links=('root', 'left_knee'),
            path=str(resources.directory('xml') / 'biped2d.xml'),
        )  # fmt: skip
        with self.assertRaisesRegex(ValueError, 'clip'):
            suite.build(row)
        environment = suite.build(row, clip='biped2d_walk', task_kwargs={'random': 0})
        environment.reset()
        self.assertEqual(environment.step(np.zeros(6)).observation['pose'].shape, (15,))

    def test_goat_takes_the_clip_of_the_dog(self):
        environment = suite.build('goat', 'position', 'cliffs_rugged', task_kwargs={'random': 0})
        self.assertEqual(environment.task.clip.name, 'dog_bound')


if __name__ == '__main__':
    absltest.main()
