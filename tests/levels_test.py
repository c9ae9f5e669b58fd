"""Levels: terrain that depends on the level alone, in single and vector environments, and choices."""

import numpy as np
from absl.testing import parameterized
from helpers import assert_refused

from trl_suite import suite
from trl_suite.terrain import PlanarGround
from trl_suite.vector import VectorEnvironment

# One of each class that draws terrain.
IDS = (
    'PD_Biped2D_Mixed_Terrain-v0', 'FSM_Dog2D_Terrain_Mixed-v0', 'PD_Biped3D_Imitate-Stairs-v0',
    'PD_Biped3D_LLC_Bumps_Step-v0', 'PD_Biped3D_HLC_Forest-v0', 'PD_Biped3D_Terrain_Trail_Hard-v0',
)  # fmt: skip


def ground(task, env_id=0):
    """Returns what the terrain of a simulation is made from."""
    return repr(task.arena.grounds[env_id].state())


class LevelsTest(parameterized.TestCase):
    @parameterized.parameters(*IDS)
    def test_terrain_depends_on_the_level_alone(self, id_):
        """And starts do not: those of a seed are the same with and without levels."""
        environment = suite.make(id_, {'random': 1, 'levels': (7, 3)})
        plain = suite.make(id_, {'random': 1})
        found, levels, starts = {}, [], []
        for _ in range(8):
            environment.reset(), plain.reset()
            joints = plain.task.body.pose_qpos[7 if plain.task.character.spec.spatial else 3 :]
            first, second = (each.physics.data.qpos[joints] for each in (environment, plain))
            np.testing.assert_array_equal(first, second)
            levels.append(environment.level)
            starts.append(environment.physics.data.qpos.tobytes())
            self.assertEqual(
                found.setdefault(environment.level, ground(environment.task)),
                ground(environment.task),
            )
        self.assertEqual(set(levels), {7, 8, 9})
        self.assertLen(set(found.values()), 3)
        if not id_.startswith('FSM'):  # which start from one pose
            self.assertGreater(len(set(starts)), 3)
        self.assertEqual(environment.info['level'], levels[-1])
        self.assertIsNone(plain.level)

    def test_a_level_is_the_seed_of_its_terrain(self):
        environment = suite.make('PD_Biped2D_Mixed_Terrain-v0', {'levels': (0, 100)})
        environment.reset(level=42)
        task = environment.task
        expected = PlanarGround(task.arena.terrain, 42, terrain_level=task.config.terrain_level)
        x = np.linspace(0, 15, 200)
        np.testing.assert_allclose(task.arena.height(x[None])[0], expected.height(x), atol=1e-9)

    def test_a_chosen_level_counts_once(self):
        environments = VectorEnvironment('plaid/dog_gaps', 4, 1, 1, task_kwargs={'levels': (0, 9)})
        environments.reset(level=8)
        self.assertEqual(environments.level.tolist(), [8] * 4)
        environments.reset([1, 3], level=[2, 5])
        self.assertEqual(environments.level.tolist(), [8, 2, 8, 5])
        state = environments.get_state()
        environments.reset()
        drawn = environments.level.tolist()
        self.assertNotEqual(drawn, [8, 2, 8, 5])
        environments.set_state(state)
        self.assertEqual(environments.level.tolist(), [8, 2, 8, 5])
        environments.reset()
        self.assertEqual(environments.level.tolist(), drawn)

    def test_invalid_levels(self):
        id_ = 'plaid/dog_gaps'
        environment = suite.make(id_, {'levels': (3, 2)})
        several = VectorEnvironment(id_, 2, 1, task_kwargs={'levels': (3, 2)})
        needs = "expected an environment with the option 'levels'"
        assert_refused(
            self,
            *((lambda g=g: suite.make(id_, {'levels': g}), message) for g, message in (
                ((0, 0), 'levels is .0, 0.; expected the first level, at least 0, and the number of levels, at least 1'),
                ((-1, 5), 'levels is .-1, 5.; expected None or a list of whole numbers at least 0'),
                ((2**32, 1), 'all levels below 4294967296'),
                (5, 'levels is 5; expected None or a list of whole numbers'),
                ((1, 2, 3), 'levels is .1, 2, 3.; expected the first level'),
            )),
            *((lambda n=n: environment.reset(n), f'level is .*{n}.*from 3 to 4') for n in (2, 5, 3.5, 'three')),
            (lambda: suite.make(id_).reset(0), needs),
            (lambda: several.reset(level=[3, 3, 3]), '3 levels for 2 simulations'),
            *((lambda n=n: several.task.choose_level(n, 3), 'env_ids is .*; expected whole numbers from 0 to 1')
              for n in ([2], [-1], ['a'])),
        )  # fmt: skip
