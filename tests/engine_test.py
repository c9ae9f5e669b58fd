"""Simulations as arrays: results of the engine equal those of MuJoCo; states: in state_test."""

import pathlib
import tempfile
import threading
from unittest import mock

import mujoco
import numpy as np
from absl.testing import parameterized
from dm_control import mjcf

from trl_suite import engine
from trl_suite.engine import BatchWorld, PhysicsWorld, native
from trl_suite.engine.world import CHUNKS, LEAST, READABLE, STATE, WRITABLE
from trl_suite.util import machine

# A hopper on a box, driven by servos and a muscle, a belt that is moved, and a ball.
XML = """
<mujoco model="test">
  <option timestep="0.002" integrator="implicitfast"/>
  <asset><texture name="sky" type="skybox" builtin="flat" width="8" height="8"/>
    <material name="red" rgba="1 0 0 1"/></asset>
  <worldbody>
    <geom name="floor" type="box" size="5 5 .1" pos="0 0 -.1" material="red"/>
    <body name="trunk" pos="0 0 .6">
      <joint name="x" type="slide" axis="1 0 0"/><joint name="z" type="slide" axis="0 0 1"/>
      <joint name="pitch" axis="0 1 0"/>
      <geom name="trunk" type="capsule" size=".05 .1" mass="3"/><site name="middle"/>
      <body name="leg" pos="0 0 -.1"><joint name="hip" axis="0 1 0" damping=".1"/>
        <geom type="capsule" size=".03" fromto="0 0 0 0 0 -.3" mass="1"/>
        <site name="foot" pos="0 0 -.3" size=".06"/></body>
    </body>
    <body name="ball" pos=".5 0 1"><freejoint/><geom type="sphere" size=".1" mass=".5"/></body>
  </worldbody>
  <tendon><spatial name="rope"><site site="middle"/><site site="foot"/></spatial></tendon>
  <actuator><position name="servo" joint="hip" kp="50" kv="3" forcerange="-20 20"/>
    <muscle name="muscle" tendon="rope" lengthrange=".2 .5" force="30"/></actuator>
  <sensor><touch name="touch" site="foot"/></sensor>
</mujoco>
"""
SUBSTEPS = 7


def model():
    return mujoco.MjModel.from_xml_string(XML)


def controls(steps, n=1, seed=0):
    return np.random.default_rng(seed).uniform(0, 1, (steps, n, 2))


class StepTest(parameterized.TestCase):
    """A step is `mj_step`, repeated."""

    def raw(self, ctrl):
        """States, and what is computed from them, after plain steps of MuJoCo."""
        raw_model = model()
        data, found = mujoco.MjData(raw_model), []
        mujoco.mj_forward(raw_model, data)
        for each in ctrl:
            data.ctrl[:] = each
            for _ in range(SUBSTEPS):
                mujoco.mj_step(raw_model, data)
            found.append(np.concatenate([data.qpos, data.qvel]))
        return np.array(found), data.time

    def stepped(self, world, ctrl):
        found = []
        world.forward(world.all_ids)
        for each in ctrl:
            world.ctrl[:] = each
            world.step(SUBSTEPS)
            found.append(np.concatenate([world.qpos, world.qvel], 1))
        return np.array(found)

    def test_one_simulation(self):
        physics = mjcf.Physics.from_xml_string(XML)
        world, ctrl = PhysicsWorld(physics), controls(60)
        expected, time = self.raw(ctrl[:, 0])
        np.testing.assert_array_equal(self.stepped(world, ctrl)[:, 0], expected)
        self.assertEqual(world.time[0], time)
        np.testing.assert_array_equal(world.qpos[0], physics.data.qpos)

    def test_many_simulations(self):
        world, ctrl = BatchWorld(model(), 3, 1), controls(60, 3)
        found = self.stepped(world, ctrl)
        for i in range(3):
            expected, time = self.raw(ctrl[:, i])
            np.testing.assert_array_equal(found[:, i], expected)
            self.assertEqual(world.time[i], time)
        self.assertGreater(np.abs(found[-1, 0] - found[-1, 1]).max(), 1e-3)

    def test_derived_quantities_are_of_the_new_state(self):
        world = BatchWorld(model(), 2, 1, ('site_xpos',))
        world.forward(world.all_ids)
        for ctrl in controls(40, 2):
            world.ctrl[:] = ctrl
            world.step(SUBSTEPS)
        for i in range(2):
            data = mujoco.MjData(world.models[i])
            mujoco.mj_setState(world.models[i], data, world.get_state(i), STATE)
            mujoco.mj_forward(world.models[i], data)
            for name in ('xpos', 'xipos', 'cvel', 'subtree_com', 'ten_length', 'site_xpos'):
                found = getattr(world, name)[i]
                np.testing.assert_array_equal(found, getattr(data, name), err_msg=name)

    def test_other_simulations_do_not_move(self):
        world = BatchWorld(model(), 4, 1)
        world.forward(world.all_ids)
        before = [world.get_state(i) for i in range(4)]
        world.step(SUBSTEPS, np.array([1, 3]))
        moved = [not np.array_equal(world.get_state(i), before[i]) for i in range(4)]
        self.assertEqual(moved, [False, True, False, True])
        np.testing.assert_array_equal(world.time > 0, moved)

    def test_written_arrays_reach_the_physics(self):
        world = BatchWorld(model(), 2, 1)
        world.qpos[1, :4], world.qvel[1, :4] = (1.0, 0.2, 0.3, -0.4), 0.5
        world.forward(np.array([1]))
        one, data = world.models[1], mujoco.MjData(world.models[1])
        data.qpos[:4], data.qvel[:4] = (1.0, 0.2, 0.3, -0.4), 0.5
        mujoco.mj_forward(one, data)
        np.testing.assert_array_equal(world.xpos[1], data.xpos)
        self.assertEqual(world.xpos[0, 1, 0], 0.0)

    @parameterized.named_parameters(
        ('step', lambda world, env_ids: world.step(1, env_ids)),
        ('forward', lambda world, env_ids: world.forward(env_ids)),
        ('reset', lambda world, env_ids: world.reset(env_ids)),
        ('set_state', lambda world, env_ids: world.set_state(env_ids[-1], world.get_state(0))),
    )
    def test_simulations_that_do_not_exist(self, call):
        world = BatchWorld(model(), 2, 1)
        for env_ids in ([2], [0, 10**9], [-3]):
            with self.assertRaises(IndexError):
                call(world, np.array(env_ids))
        world.qpos[1] = 0.5
        call(world, np.array([-1]))  # the last one

    @parameterized.parameters(False, True)
    def test_writable_arrays(self, one):
        world = (
            PhysicsWorld(mjcf.Physics.from_xml_string(XML)) if one else BatchWorld(model(), 2, 1)
        )
        for name in (*WRITABLE, *READABLE):
            self.assertEqual(getattr(world, name).flags.writeable, name in WRITABLE, name)
            self.assertLen(getattr(world, name), world.n)


class NamesTest(parameterized.TestCase):
    """Ids and addresses by name."""

    def test_ids_and_addresses(self):
        world = BatchWorld(model(), 1, 1)
        one = world.models[0]
        with self.assertRaisesRegex(ValueError, r"the model has no body named \['tail'\]"):
            world.body_ids(['leg', 'tail'])
        self.assertEqual(world.body_ids(['leg', 'ball']).tolist(), [2, 3])
        self.assertEqual(world.geom_ids(['floor']).tolist(), [0])
        self.assertEqual(world.site_ids(['foot']).tolist(), [1])
        self.assertEqual([a.tolist() for a in world.joint_addresses(['hip', 'x'])], [[3, 0]] * 2)
        self.assertEqual(world.control_addresses(['muscle']).tolist(), [1])
        self.assertEqual(world.sensor_addresses(['touch']).tolist(), [one.sensor_adr[0]])

    def test_a_light_model_has_the_same_physics(self):
        root = mjcf.from_xml_string(XML)
        full, light = mjcf.Physics.from_mjcf_model(root).model.ptr, engine.light_model(root)
        self.assertEqual((full.ntex, full.nmat), (1, 1))
        self.assertEqual((light.ntex, light.nmat), (0, 0))
        found = []
        for world in (BatchWorld(each, 1, 1) for each in (full, light)):
            for world.ctrl[:] in controls(30):
                world.step(SUBSTEPS)
            found.append(world.qpos)
        np.testing.assert_array_equal(*found)


class LibraryTest(parameterized.TestCase):
    """MuJoCo's functions are those of the package that is imported."""

    def test_addresses(self):
        found = native.addresses()
        self.assertLen(set(found), len(native.NAMES))
        self.assertTrue(all(found))

    def test_another_version_is_rejected(self):
        native.check_version('3.17.0', '3.17.0', 'libmujoco.so')
        with self.assertRaisesRegex(
            ImportError,
            'libmujoco.so is MuJoCo 3.9.0, and the Python package is MuJoCo 3.17.0; rei',
        ):
            native.check_version('3.9.0', '3.17.0', 'libmujoco.so')

    def test_a_missing_library_is_an_error(self):
        with tempfile.TemporaryDirectory() as folder:
            file = str(pathlib.Path(folder) / '__init__.py')
            with (
                mock.patch.object(mujoco, '__file__', file),
                self.assertRaisesRegex(ImportError, f'no MuJoCo library .* in {folder}; install'),
            ):
                native.library.__wrapped__()

    @parameterized.parameters('3.17.0', '3.16.0')
    def test_bounds_are_those_of_set_const(self, version):
        """Of geoms of static bodies that were moved, with all versions of MuJoCo."""
        found, rng = [model(), model()], np.random.default_rng(0)
        pose, size = rng.normal(size=7), rng.uniform(1, 2, 3)
        for each in found:
            floor = each.geom('floor')
            floor.pos, floor.quat, floor.size = pose[:3], pose[3:] / np.linalg.norm(pose[3:]), size
        with mock.patch.object(mujoco, '__version__', version):
            native.set_bounds.__wrapped__()(found[0], mujoco.MjData(found[0]))
        mujoco.mj_setConst(found[1], mujoco.MjData(found[1]))
        for name in dir(found[0]):
            values = [getattr(each, name) for each in found]
            if not name.startswith('_') and isinstance(values[0], np.ndarray):
                np.testing.assert_array_equal(*values, name)
        self.assertNotEqual(found[0].geom_rbound[0], model().geom_rbound[0])


class ShareTest(parameterized.TestCase):
    """Work that threads share."""

    def world(self, num_threads=2, n=40):
        return BatchWorld(model(), n, num_threads)

    def test_parts_are_everything_once_in_order(self):
        world, ids, parts = self.world(), np.arange(1, 40, 2), []
        world.share(lambda part: parts.append((part, threading.get_ident())), ids)
        self.assertLen(parts, min(2 * CHUNKS, len(ids) // LEAST))
        parts.sort(key=lambda each: each[0][0])
        np.testing.assert_array_equal(np.concatenate([part for part, _ in parts]), ids)
        self.assertNotIn(threading.get_ident(), [thread for _, thread in parts])

    @parameterized.parameters((1, 40), (8, 2 * LEAST - 1))
    def test_little_work_and_one_thread(self, num_threads, count):
        parts = []
        self.world(num_threads).share(
            lambda part: parts.append((part.tolist(), threading.get_ident())), np.arange(count)
        )
        self.assertEqual(parts, [(list(range(count)), threading.get_ident())])

    def test_zero_threads_are_all_usable_cores(self):
        with mock.patch.object(machine, 'cores', return_value=3):
            world = self.world(0)
        parts = []
        world.share(parts.append, world.all_ids)
        self.assertLen(parts, min(3 * CHUNKS, world.n // LEAST))

    def test_other_parts_finish_before_an_error_is_raised(self):
        world, done, go = self.world(), [], threading.Event()

        def work(part):
            if part[0] == 0:
                raise KeyError('first')
            go.wait(0.05)
            done.extend(part.tolist())

        with self.assertRaisesRegex(KeyError, 'first'):
            world.share(work, world.all_ids)
        self.assertLen(done, 40 - min(done))
        self.assertEqual(sorted(done), list(range(min(done), 40)))
        done.clear()
        world.share(lambda part: done.extend(part.tolist()), world.all_ids)  # it can go on
        self.assertCountEqual(done, range(40))

    def test_close(self):
        world = self.world()
        before = {*threading.enumerate()}
        world.share(lambda part: None, world.all_ids)
        self.assertNotEmpty(started := {*threading.enumerate()} - before)
        for _ in range(2):
            world.close()
        self.assertFalse(any(thread.is_alive() for thread in started))
