"""Tests of the front door: names, aliases, options, free combinations."""

import dataclasses
import json
import pathlib
import re
import tempfile

import numpy as np
from absl.testing import absltest, parameterized
from helpers import KINDS

import trl_suite
from trl_suite import characters, motion, suite, terrain
from trl_suite.registry import catalogue
from trl_suite.util import resources

GAPS = 'PD_Biped2D_Gaps_Terrain-v0'
HIGH = 'PD_Biped3D_HLC_Forest-v0'
# The planar ids of tracking that the original registers: 21 of PLAiD and 9 of Imitation.
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
# In three dimensions: id -> task, terrain, character, motion, whether the original registers it.
_WALKS = ('biped3d', 'biped3d_walk')
SPATIAL = {
    'PD_Biped3D_Imitate-v0': ('pd_biped3d', 'plane', *_WALKS, True),
    'PD_Biped3D_Imitate-Track-v0': ('pd_biped3d_track', 'plane', *_WALKS, True),
    'PD_Biped3D_Imitate-Hills-v0': ('pd_biped3d_hills', 'hills3d', *_WALKS, True),
    'PD_Biped3D_Imitate-Ramp-v0': ('pd_biped3d_ramp', 'ramp3d', *_WALKS, True),
    'PD_Biped3D_Imitate-Stairs-v0': ('pd_biped3d_stairs', 'stairs3d', *_WALKS, True),
    'PD_Biped3D_Imitate-Steps-v0': ('pd_biped3d_steps', 'steps3d', *_WALKS, True),
    'PD_Biped3D_Imitate-Rough-v0': ('pd_biped3d_rough', 'checkers3d', *_WALKS, False),
    **{
        f'PD_Biped3D_Imitate-{name}_Terrain-v0': (task, ground, *_WALKS, False)
        for name, task, ground in (
            ('Hills', 'pd_biped3d_hills_terrain', 'hills3d'),
            ('Ramp', 'pd_biped3d_ramp_terrain', 'ramp3d'),
            ('Stairs', 'pd_biped3d_stairs_terrain', 'stairs3d'),
            ('Steps', 'pd_biped3d_steps_terrain', 'steps3d'),
            ('Rough', 'pd_biped3d_rough_terrain', 'checkers3d'),
        )
    },
    'PD_Biped3D_Imitate-Run-v0': ('pd_biped3d_run', 'plane', 'biped3d', 'biped3d_run', False),
    **{
        f'PD_Biped3D_{name}-v0': (task, ground, character, character, original)
        for name, task, ground, character, original in (
            ('LLC_General_Step', 'llc_general_step', 'plane', 'biped3d_mocap', True),
            ('LLC_Symetric_Step', 'llc_symmetric_step', 'plane', 'biped3d_mocap', True),
            ('LLC_Run_FootStep', 'llc_run_footstep', 'plane', 'biped3d_mocap_run', True),
            ('LLC_Bumps_Step', 'llc_bumps_step', 'checkers_3d', 'biped3d_mocap', False),
            ('LLC_Trail_Step', 'llc_trail_step', 'trail3d2', 'biped3d_mocap', False),
            ('FULL_Imitate-Steps', 'llc_full_step', 'plane', 'biped3d_full_mocap', True),
        )
    },
}
# Hierarchical: id -> terrain, observed maps, start phases, original.
_EITHER, _ZERO = (0.1, 0.6), (0.0,)
HARD = {  # id: terrain
    'PD_Biped3D_Terrain_Trail_Hard-v0': 'trail3d1',
    'PD_Biped3D_Terrain_Forest_Hard-v0': 'pillars3d',
    'PD_Biped3D_Terrain_Blocks_Hard-v0': 'obstacles3d',
    'PD_Biped3D_Terrain_Dyanmics_Obs_Hard-v0': 'dynamic_obstacles3d',
    'PD_Biped3D_Terrain_Soccer_Hard-v0': 'plane',
}
HIGH_LEVEL = {
    f'PD_Biped3D_HLC_{name}-v0': values
    for name, values in {
        'LargeBlocks': ('obstacles3d', ('height',), _EITHER, True),
        'DynamicsObstacles': ('dynamic_obstacles3d', ('velocity',), _ZERO, True),
        'Soccer': ('plane', (), _EITHER, True),
        'Forest': ('pillars3d', ('height',), _ZERO, True),
        'Conveyors': ('conveyor3d', ('velocity',), _ZERO, True),
        'Conveyors_Wide': ('conveyor3d_wide', ('velocity',), _ZERO, True),
        'PathFollowing': ('trail3d1', ('height',), _EITHER, False),
        'PathFollowing_Run': ('trail3d_wide', ('height',), _ZERO, False),
    }.items()
}


def ids_of(rules):
    """Specs of one task class."""
    return [id_ for id_ in suite.ALL_IDS if suite.find(id_).task_type == rules]


def imitation_ids():
    """Specs of the two planar tracking families."""
    return ids_of('planar_imitation')


class CatalogueTest(parameterized.TestCase):
    """Every environment is an `EnvSpec`."""

    def test_counts(self):
        specs = [suite.find(id_) for id_ in imitation_ids()]
        self.assertLen(specs, 42)
        self.assertLen([spec for spec in specs if 'original' in spec.tags], 30)
        self.assertLen(ORIGINAL, 30)
        gaits = [suite.find(id_) for id_ in ids_of('gait')]
        self.assertLen(gaits, 43)
        self.assertLen([spec for spec in gaits if 'original' in spec.tags], 32)

    def test_the_originals_are_tagged(self):
        tagged = {id_ for id_ in imitation_ids() if 'original' in suite.find(id_).tags}
        self.assertEqual(tagged, set(ORIGINAL))
        for id_ in suite.ALL_IDS:
            origins = suite.find(id_).tags & {'original', 'completion', 'addition'}
            self.assertLen(origins, 1, id_)
        tagged = [id_ for id_ in ids_of('gait') if 'original' in suite.find(id_).tags]
        self.assertCountEqual(tagged, list(GAITS)[:32])

    def test_gaits(self):
        self.assertCountEqual(ids_of('gait'), GAITS)
        for id_, preset in GAITS.items():
            spec = suite.find(id_)
            figure = id_.split('_')[1]
            self.assertEqual((spec.terrain, spec.character), (preset, FIGURES[figure]))
            self.assertEqual((spec.domain, spec.actuation, spec.clip), ('terrainrl', 'gait', None))
            ground = id_.split('_', 3)[3].removesuffix('-v0')
            self.assertEqual(spec.task, f'{figure[:-2]}_{ground}'.lower())
            self.assertEqual((dict(spec.options), spec.step_limit), ({}, 5000))

    @parameterized.parameters(*list(GAITS)[::4])
    def test_parts_of_ids_of_gaits(self, id_):
        environment = suite.make(id_, {'random': 0})
        task = environment.task
        self.assertEqual(task.arena.terrain.name, GAITS[id_])
        self.assertEqual(task.character.spec.name, FIGURES[id_.split('_')[1]])
        self.assertEqual(task.interface, 'parameters')
        self.assertEqual(list(environment.blocks), ['terrain', 'pose', 'velocity'])
        self.assertEqual(environment.step_limit, 5000)
        self.assertAlmostEqual(environment.physics.timestep(), 1 / 1200)

    def test_three_dimensions(self):
        self.assertCountEqual([*ids_of('spatial_imitation'), *ids_of('spatial_footsteps')], SPATIAL)
        self.assertCountEqual(
            [spec.id for spec in catalogue.SPECS if 'spatial' in spec.tags],
            [*SPATIAL, *HIGH_LEVEL, *HARD],
        )
        for id_, (task, ground, character, clip, original) in SPATIAL.items():
            spec = suite.find(id_)
            self.assertEqual((spec.task, spec.terrain, spec.character, spec.clip),
                             (task, ground, character, clip))  # fmt: skip
            self.assertEqual(spec.actuation, 'position')
            self.assertEqual(spec.domain, 'imitation' if task.startswith('pd_') else 'deeploco')
            self.assertEqual(spec.tags, {'spatial', 'original' if original else 'completion'})
        self.assertLen([values for values in SPATIAL.values() if values[-1]], 10)

    @parameterized.parameters(*SPATIAL)
    def test_parts_of_three_dimensional_ids(self, id_):
        _, ground, character, clip, _ = SPATIAL[id_]
        environment = suite.make(id_, {'random': 0})
        task = environment.task
        self.assertEqual(task.arena.terrain.name, ground)
        self.assertTrue(task.arena.terrain.spatial)
        self.assertEqual(task.character.spec.name, character)
        self.assertEqual(task.motion.name, clip)
        self.assertEqual(task.actuation_model, 'position')
        self.assertEqual(task.mirrored, 'Symetric' in id_)
        # The others are blind, as in the original.
        self.assertEqual('terrain' in environment.blocks, '_Terrain-' in id_)
        self.assertEqual('reference' in environment.blocks, 'Track' in id_)
        self.assertEqual(environment.step_limit, 256)
        self.assertAlmostEqual(environment.control_timestep(), 1 / 30)
        self.assertAlmostEqual(environment.physics.timestep(), 1 / 300)

    def test_high_level(self):
        self.assertCountEqual([*ids_of('goal_navigation'), *ids_of('soccer')], HIGH_LEVEL)
        self.assertEqual(ids_of('soccer'), ['PD_Biped3D_HLC_Soccer-v0'])
        for id_, (ground, _, _, original) in HIGH_LEVEL.items():
            spec = suite.find(id_)
            self.assertEqual(
                (spec.domain, spec.terrain, spec.actuation), ('deeploco', ground, 'position')
            )
            character = 'biped3d_mocap_run' if id_.endswith('_Run-v0') else 'biped3d_mocap'
            self.assertEqual((spec.character, spec.clip), (character, character))
            self.assertEqual(spec.step_limit, 667 if character.endswith('run') else 400)  # 200 s
            self.assertEqual(
                spec.tags, {'spatial', 'hierarchical', 'original' if original else 'completion'}
            )

    @parameterized.parameters(*HIGH_LEVEL)
    def test_parts_of_hierarchical_ids(self, id_):
        ground, sight, phases, _ = HIGH_LEVEL[id_]
        environment = suite.make(id_, {'random': 0})
        task = environment.task
        self.assertEqual(task.arena.terrain.name, ground)
        self.assertEqual('terrain' in environment.blocks, 'height' in sight)
        self.assertEqual('surface' in environment.blocks, 'velocity' in sight)
        self.assertEqual('ball' in environment.blocks, 'Soccer' in id_)
        self.assertEqual(task.interface, 'plan')
        run = id_.endswith('_Run-v0')
        self.assertEqual(environment.step_limit, 667 if run else 400)
        self.assertAlmostEqual(environment.control_timestep(), 0.3 if run else 0.5)
        self.assertAlmostEqual(environment.physics.timestep(), 1 / 300)
        found = set()
        for _ in range(8):
            environment.reset()
            found.add(round(float(task.phase[0]), 9))
        self.assertEqual(found, set(phases))

    @parameterized.parameters(*HARD)
    def test_without_hierarchy(self, id_):
        spec, environment = suite.find(id_), suite.make(id_, {'random': 0})
        original = 'Soccer' not in id_
        self.assertEqual(spec.domain, 'deeploco')
        self.assertEqual(
            spec.tags, {'spatial', 'flat_control', 'original' if original else 'completion'}
        )
        task = environment.task
        self.assertEqual(
            (task.arena.terrain.name, task.character.spec.name), (HARD[id_], 'biped3d_mocap')
        )
        self.assertEqual('terrain' in environment.blocks, original)
        self.assertEqual('ball' in environment.blocks, not original)
        self.assertEqual(environment.step_limit, 256)
        self.assertAlmostEqual(environment.control_timestep(), 1 / 30)
        self.assertAlmostEqual(environment.physics.timestep(), 1 / 300)

    def test_aliases_of_three_dimensional_environments(self):
        for name, id_ in (
            ('PD_Biped3D_LLC_Symmetric_Step-v0', 'PD_Biped3D_LLC_Symetric_Step-v0'),
            ('PD_Biped3D_Full_LLC_Step-v0', 'PD_Biped3D_FULL_Imitate-Steps-v0'),
            ('deeploco/llc_general_step', 'PD_Biped3D_LLC_General_Step-v0'),
            ('imitation/pd_biped3d', 'PD_Biped3D_Imitate-v0'),
            ('PD_Biped3D_HLC_DynamicObstacles-v0', 'PD_Biped3D_HLC_DynamicsObstacles-v0'),
            ('deeploco/hlc_soccer', 'PD_Biped3D_HLC_Soccer-v0'),
            ('PD_Biped3D_Terrain_Dynamic_Obs_Hard-v0', 'PD_Biped3D_Terrain_Dyanmics_Obs_Hard-v0'),
        ):
            self.assertEqual(suite.find(name).id, id_)

    def test_names_are_unique(self):
        self.assertLen(set(suite.ALL_IDS), len(catalogue.SPECS))
        self.assertLen(set(suite.ALL_TASKS), len(catalogue.SPECS))
        every = [*suite.ALL_IDS, *catalogue.ALIASES]
        self.assertLen(set(every), len(every))

    @parameterized.parameters(*suite.ALL_IDS)
    def test_fields_of_a_spec(self, id_):
        spec = suite.find(id_)
        self.assertEqual(spec.id, id_)
        self.assertRegex(id_, r'^\w+(-\w+)?-v\d$')  # what Gymnasium takes for a name
        self.assertRegex(spec.description, r'^[A-Z].*\.$')
        self.assertNotIn('\n', spec.description)
        self.assertLess(len(spec.description), 130)
        self.assertIn(spec.character, characters.CHARACTERS)
        self.assertIn(spec.domain, suite.TASKS_BY_DOMAIN)
        self.assertRegex(spec.task, r'^[a-z0-9_]+$')
        terrain.load(spec.terrain)

    def test_descriptions_differ(self):
        descriptions = [suite.find(id_).description for id_ in suite.ALL_IDS]
        self.assertLen(set(descriptions), len(descriptions))

    @parameterized.parameters(*imitation_ids())
    def test_parts_of_planar_ids(self, id_):
        spec, parts = suite.find(id_), id_.removesuffix('-v0').split('_')
        environment = suite.make(id_, {'random': 0})
        task = environment.task
        self.assertEqual(task.actuation_model, MODELS[parts[0]])
        figure = {'Dog2D': 'dog', 'Raptor2D': 'raptor'}.get(
            parts[1], 'biped2d' if 'LLC' in parts else 'biped2d_full'
        )
        self.assertEqual(task.character.spec.name, figure)
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
        self.assertEqual('reference' in environment.blocks, 'LLC' in parts)
        self.assertEqual(environment.step_limit, 256)
        self.assertAlmostEqual(environment.control_timestep(), 1 / 30)
        self.assertEqual(dict(spec.options), dict(suite.find(id_).options))

    def test_tables(self):
        self.assertEqual(
            {domain: len(tasks) for domain, tasks in suite.TASKS_BY_DOMAIN.items()},
            # Of imitation 14 in the plane and 13 in three dimensions.
            # Of deeploco 7 of footsteps, one in the plane, 8 above them and 5 without them.
            {'plaid': 28, 'imitation': 27, 'terrainrl': 43, 'deeploco': 20},
        )
        flat = [(domain, task) for domain, tasks in suite.TASKS_BY_DOMAIN.items() for task in tasks]
        self.assertCountEqual(flat, suite.ALL_TASKS)
        self.assertEqual(
            set(suite.BENCHMARKING),
            {(r.domain, r.task) for r in catalogue.SPECS if 'original' in r.tags},
        )
        self.assertLess(set(suite.BENCHMARKING), set(suite.ALL_TASKS))

    def test_specs_are_immutable(self):
        spec = suite.find(GAPS)
        with self.assertRaises(AttributeError):
            spec.terrain = 'flat'
        with self.assertRaises(TypeError):
            spec.options['terrain_observation'] = 3


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
        (lambda: suite.make(GAPS, {'terrain_sample': 3}), "unknown option.*'terrain_observation'"),
        (lambda: suite.make(GAPS, {'randm': 3}), "unknown option.*'random'"),
        (lambda: suite.make(GAPS, {'actuation_model': 'torque'}), 'unknown option'),
        (lambda: suite.make(GAPS, None, {'flat': 1}), "unknown option.*'flat_observation'"),
        (lambda: suite.make(GAPS, None, {'flat_observation': 'x'}), "flat_observation is 'x'; exp"),
        (lambda: suite.make('FSM_Dog2D_Terrain_Gap-v0'), "'FSM_Dog2D_Terrain_Gaps-v0'"),
        (lambda: suite.load('terrainrl', 'dog_gap'), "unknown task.*'dog_gaps'"),
        (lambda: suite.make('terrainrl/dog_gaps', {'start_phase': 0.5}), 'unknown option'),
        (lambda: suite.make('PD_Biped3D_HLC_Forrest-v0'), "'PD_Biped3D_HLC_Forest-v0'"),
        (
            lambda: suite.make('deeploco/hlc_forest', {'goal_reach': 2}),
            "unknown option.*'goal_reached'",
        ),
        (lambda: suite.build('dgo'), "unknown character 'dgo'.*'dog'"),
        (lambda: suite.build('dog', 'torqe'), "unknown actuation .*'torqe'.*'torque'"),
        (lambda: suite.build('dog', terrain='gap'), "unknown terrain 'gap'.*'gaps'"),
        (lambda: suite.build('dog', task='imitate'), "unknown task 'imitate'.*'imitation'"),
        (lambda: suite.build('dog', clip='dog_bond'), "unknown clip 'dog_bond'.*'dog_bound'"),
    )
    def test_unknown_names_get_the_closest_ones(self, call, message):
        with self.assertRaisesRegex(ValueError, re.compile(message, re.DOTALL)):
            call()

    @parameterized.parameters(
        (
            lambda: suite.combine(None),
            'a character is a CharacterSpec or a name, one of dog.*not None',
        ),
        (lambda: suite.build(3), 'a character is'),
        (lambda: suite.make(None), 'the id .* not None'),
        (lambda: suite.make([]), 'the id of an environment is a string'),
        (
            lambda: suite.build('dog', clip=3),
            'clip is a name, a file, a Clip or FootstepLibrary, not 3',
        ),
        (lambda: suite.make(GAPS, 3), 'task_kwargs is 3; expected a dict'),
        (lambda: suite.make(GAPS, None, 'x'), "environment_kwargs is 'x'; expected a dict"),
        (lambda: suite.make(HIGH, {'controller': 3}), 'controller is 3; expected a policy'),
    )
    def test_other_types_are_named(self, call, message):
        with self.assertRaisesRegex(TypeError, message):
            call()

    def test_an_unknown_controller_is_no_environment(self):
        with self.assertRaisesRegex(
            ValueError, "^unknown controller 'PD_Biped3D_LLC_General.*Step-v0"
        ):
            suite.make(HIGH, {'controller': 'PD_Biped3D_LLC_General-v0'})

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

    def test_terrain_observation(self):
        environment = suite.make(GAPS, {'random': 0, 'terrain_observation': 8})
        self.assertEqual(environment.observation_spec()['terrain'].shape, (8,))
        blind = suite.make(GAPS, {'random': 0, 'terrain_observation': 0})
        self.assertNotIn('terrain', blind.observation_spec())

    def test_target(self):
        environment = suite.make(GAPS, {'random': 0, 'reference_observation': True})
        self.assertEqual(list(environment.blocks), ['terrain', 'pose', 'velocity', 'reference'])

    def test_position_range(self):
        environment = suite.make(GAPS, {'action_offset': 'posture', 'action_scale': 0.5})
        np.testing.assert_array_equal(
            environment.action_map.action_offset, 0
        )  # the biped's posture
        np.testing.assert_array_equal(environment.action_map.action_scale, 0.5)

    def test_limits(self):
        self.assertEqual(suite.make(GAPS, {'step_limit': 9}).step_limit, 9)
        self.assertEqual(suite.make(GAPS, None, {'step_limit': 9}).step_limit, 9)
        self.assertIsNone(suite.make(GAPS, {'step_limit': None}).step_limit)

    @parameterized.parameters(*(id_ for id_ in KINDS if id_ in ids_of('gait')))
    def test_common_options_in_every_gait(self, id_):
        environment = suite.make(id_, {'random': 3, 'step_limit': 1, 'start_noise': 0.01})
        starts = [environment.reset().observation['pose'] for _ in range(2)]
        self.assertTrue((starts[0] != starts[1]).any())
        step = environment.step(np.zeros(environment.action_spec().shape))
        self.assertTrue(step.last())
        self.assertBetween(step.reward, 0, 1)

    @parameterized.parameters(*imitation_ids(), *SPATIAL)
    def test_common_options_in_every_environment(self, id_):
        environment = suite.make(id_, {'random': 3, 'step_limit': 2, 'start_phase': 0.5})
        step = environment.reset()
        if 'phase' in step.observation:
            # Mirrored, it is the phase of a single step, and the second one begins at one half.
            phase = 0.0 if 'Symetric' in id_ else 0.5
            self.assertAlmostEqual(step.observation['phase'][0], phase)
        self.assertAlmostEqual(float(environment.task.phase[0]), 0.5)
        environment.step(np.zeros(environment.action_spec().shape))
        self.assertTrue(environment.step(np.zeros(environment.action_spec().shape)).last())


class BuildTest(parameterized.TestCase):
    """Combinations that the catalogue does not name."""

    @parameterized.parameters(
        *(
            (name, model)
            for name, spec in characters.CHARACTERS.items()
            for model in ('position', 'torque', 'velocity', 'muscle')
            if spec.clip and (model != 'muscle' or not spec.spatial)
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

    @parameterized.parameters(
        *(
            (preset, task)
            for preset in sorted(terrain.PRESETS3D)
            for task in ('imitation', 'footsteps')
        )
    )
    def test_every_preset_in_three_dimensions(self, preset, task):
        environment = suite.build(
            'biped3d_mocap', terrain=preset, task=task,
            task_kwargs={'random': 0, 'terrain_observation': 'height'},
        )  # fmt: skip
        self.assertEqual(environment.task.arena.terrain.name, preset)
        self.assertEqual(environment.observation_spec()['terrain'].shape, (1024,))
        for _ in range(2):
            environment.reset()
            step = environment.step(np.zeros(17))
            for value in step.observation.values():
                self.assertTrue(np.isfinite(value).all())

    @parameterized.parameters(
        ('biped3d', 'imitation', 'biped3d_walk', 17), ('biped3d_mocap', 'imitation', 'biped3d_mocap_walk', 17),
        ('biped3d_mocap_run', 'imitation', 'biped3d_mocap_run', 17),
        ('biped3d_full_mocap', 'imitation', 'biped3d_full_walk', 35),
        ('biped3d_mocap', 'footsteps', 'biped3d_mocap', 17),
        ('biped3d_mocap_run', 'footsteps', 'biped3d_mocap_run', 17),
        ('biped3d_full_mocap', 'footsteps', 'biped3d_full_mocap', 35),
    )  # fmt: skip
    def test_defaults_of_spatial_characters(self, character, task, clip, actions):
        environment = suite.build(character, task=task, task_kwargs={'random': 0})
        self.assertEqual(environment.task.motion.name, clip)
        self.assertEqual(environment.task.arena.terrain.name, 'plane')
        self.assertEqual(environment.action_spec().shape, (actions,))
        self.assertEqual('plan' in environment.blocks, task == 'footsteps')
        again = suite.build(character, 'position', 'plane', task, clip, {'random': 0})
        ours, theirs = environment.reset().observation, again.reset().observation
        for name, value in ours.items():
            np.testing.assert_array_equal(theirs[name], value)

    def test_planar_characters_keep_level_ground(self):
        self.assertEqual(suite.build('dog').task.arena.terrain.name, 'flat')
        self.assertEqual(suite.build('hopper', task='gait').task.arena.terrain.name, 'flat')

    def test_steps_by_name_path_and_object(self):
        steps, found = motion.load_steps('biped3d_mocap'), []
        with tempfile.TemporaryDirectory() as folder:
            path = pathlib.Path(folder) / 'mine.npz'
            steps.save(path)
            for clip in ('biped3d_mocap', steps, str(path), None):
                environment = suite.build(
                    'biped3d_mocap', task='footsteps', clip=clip, task_kwargs={'random': 0}
                )
                found.append(environment.reset().observation['plan'])
        for plan in found[1:]:
            np.testing.assert_array_equal(plan, found[0])

    @parameterized.parameters(
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
        ({'character': 'biped3d_mocap', 'clip': motion.load_steps('biped3d_mocap')},
         "'biped3d_mocap' is a library of steps; to be imitated"),
        ({'character': 'biped3d', 'task': 'footsteps', 'clip': motion.load('biped3d_walk')},
         "'biped3d_walk' is a clip; for footsteps"),
    )  # fmt: skip
    def test_dimensions_that_do_not_fit_are_rejected(self, arguments, message):
        with self.assertRaisesRegex(ValueError, message):
            suite.build(**arguments)

    def test_an_environment_on_other_ground(self):
        spec = dataclasses.replace(suite.find('PD_Biped3D_Imitate-v0'), terrain='gaps')
        with self.assertRaisesRegex(
            ValueError, "'biped3d' is three-dimensional and terrain 'gaps'"
        ):
            suite.build_task(spec)

    def test_terrain_as_mapping_file_and_object(self):
        content = {'Type': 'var2d_steps', 'Params': [{'StepH0Min': 0.3, 'StepH0Max': 0.3}]}
        with tempfile.TemporaryDirectory() as folder:
            path = pathlib.Path(folder) / 'mine.json'
            path.write_text(json.dumps(content))
            blocks = [
                suite.build(
                    'dog', terrain=source, task_kwargs={'random': 2, 'terrain_observation': 50}
                )
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

    def test_a_users_own_character(self):
        spec = dataclasses.replace(
            characters.CHARACTERS['biped2d'], name='mine', clip=None, fall_links=('root', 'left_knee'),
            xml=(resources.directory('xml') / 'biped2d.xml').read_text(),
        )  # fmt: skip
        with self.assertRaisesRegex(ValueError, 'clip'):
            suite.build(spec)
        environment = suite.build(spec, clip='biped2d_walk', task_kwargs={'random': 0})
        environment.reset()
        self.assertEqual(environment.step(np.zeros(6)).observation['pose'].shape, (15,))

    def test_goat_uses_the_clip_of_the_dog(self):
        environment = suite.build('goat', 'position', 'cliffs_rugged', task_kwargs={'random': 0})
        self.assertEqual(environment.task.clip.name, 'dog_bound')


if __name__ == '__main__':
    absltest.main()
