"""Tests of bounds: what the engine knows of re-posed geoms is what `mj_setConst` would have it know."""

import copy

import mujoco
import numpy as np
from absl.testing import absltest, parameterized
from dm_control import mjcf

from trl_suite import terrain
from trl_suite.arenas import PlanarArena, SpatialArena
from trl_suite.engine import BatchWorld, bounds, light_model
from trl_suite.util.compiled import packed

PLANAR = ('gaps_humanoid', 'slopes_mixed_humanoid', 'flat', 'stairs')
SPATIAL = ('hills3d', 'pillars3d', 'ramp3d', 'stairs3d', 'trail3d', 'conveyor3d', 'blocks3d',
           'dynamic_obstacles3d')  # fmt: skip


def array_names(model):
    names = [name for name in dir(model) if not name.startswith('_')]
    return [name for name in names if isinstance(getattr(model, name), np.ndarray)]


def assert_like_set_const(model, names):
    """Has `mj_setConst` do its work on a copy of a model, and compares arrays of the two."""
    expected = copy.copy(model)
    mujoco.mj_setConst(expected, mujoco.MjData(expected))
    for name in names:
        # Of bounding volumes the last bits may differ: they only tell what may be near.
        tolerance = 1e-13 * max(1.0, np.abs(model.geom_pos).max()) if name == 'bvh_aabb' else 0.0
        np.testing.assert_allclose(
            getattr(model, name), getattr(expected, name), rtol=tolerance, atol=tolerance,
            err_msg=name,
        )  # fmt: skip


class ArenaTest(parameterized.TestCase):
    """After the ground was laid, and laid anew, a model is as `mj_setConst` leaves it."""

    @parameterized.parameters(*PLANAR, *SPATIAL)
    def test_bounds(self, name):
        ground = terrain.load(name)
        arena = (SpatialArena if ground.spatial else PlanarArena)(ground)
        arena.mjcf_model.worldbody.add('body', name='ball').add('geom', size=(0.1,))
        ball = arena.mjcf_model.find('body', 'ball')
        ball.add('joint', type='slide', axis=(1, 0, 0))
        world = BatchWorld(light_model(arena.mjcf_model), 2, 1)
        arena.bind(world)
        for seed in range(4):
            if ground.spatial:
                arena.begin_episode(1, terrain.SpatialGround(ground, seed), (5.0 * seed, -3.0))
            else:
                arena.begin_episode(1, terrain.PlanarGround(ground, seed))
            inertia = world.models[1].stat.meaninertia
            assert_like_set_const(world.models[1], array_names(world.models[1]))
            self.assertEqual(world.models[1].stat.meaninertia, inertia)


class RefreshTest(parameterized.TestCase):
    """Any box, any body."""

    @parameterized.parameters(range(5))
    def test_random_boxes(self, seed):
        rng = np.random.default_rng(seed)
        root = mjcf.RootElement()
        bodies = [root.worldbody]
        for _ in range(2):
            body = bodies[-1].add('body', pos=rng.normal(size=3), quat=rng.normal(size=4))
            bodies.append(body)
        bodies[2].add('joint')
        bodies[2].add('inertial', pos=rng.normal(size=3), quat=rng.normal(size=4), mass=1,
                      diaginertia=(1, 1, 1))  # fmt: skip
        for body in bodies:
            for _ in range(7):
                body.add('geom', type='box', size=(1, 1, 1))
        model = mjcf.Physics.from_mjcf_model(root).model.ptr
        same = rng.random(model.ngeom) < 0.3
        model.geom_pos[:] = rng.normal(size=(model.ngeom, 3))
        model.geom_quat[:] = rng.normal(size=(model.ngeom, 4))
        model.geom_quat[:] /= np.linalg.norm(model.geom_quat, axis=1)[:, None]
        model.geom_quat[same] = model.body_iquat[model.geom_bodyid[same]]
        model.geom_pos[same] = model.body_ipos[model.geom_bodyid[same]]
        model.geom_pos[same & (rng.random(model.ngeom) < 0.5)] += 1.0
        model.geom_size[:] = rng.uniform(0.1, 2.0, (model.ngeom, 3))
        bounds.refresh_all(np.arange(model.nbody), packed(bounds.geoms(model)))
        assert_like_set_const(model, bounds.Geoms._fields)


if __name__ == '__main__':
    absltest.main()
