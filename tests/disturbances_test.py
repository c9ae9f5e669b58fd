"""Tests of trl_suite.tasks.variation: worlds that vary, pushes, sensors."""

import contextlib
import dataclasses
import io
import itertools
import json
import pathlib
import runpy
import sys
from unittest import mock

import mujoco
import numpy as np
from absl.testing import parameterized
from dm_control import mjcf
from helpers import EVERY_PROPERTY as EVERY
from helpers import FolderTest, assert_refused, assert_uniform

from trl_suite import evaluation, policies, suite
from trl_suite.engine import PhysicsWorld, variation
from trl_suite.tasks.variation import SensorConfig, WorldConfig, sensors, worlds
from trl_suite.util.digest import digest
from trl_suite.vector import VectorEnvironment

ROOT = pathlib.Path(__file__).resolve().parents[1]
PLANAR, TERRAIN3D = 'PD_Biped2D_Gaps_Terrain-v0', 'PD_Biped3D_Imitate-Hills_Terrain-v0'
GAIT, STEPS = 'FSM_Dog2D_Terrain_Mixed-v0', 'PD_Biped3D_LLC_General_Step-v0'
PLAN, MOVERS = 'PD_Biped3D_HLC_Forest-v0', 'PD_Biped3D_HLC_DynamicsObstacles-v0'
BALL = 'PD_Biped3D_HLC_Soccer-v0'
MEASURED = {'preset': 'harsh', 'delay': (0, 3)}


def made(id_, seed=1, **options):
    return suite.make(id_, {'random': seed, **options}, {'flat_observation': True})


def observed(time_step):
    return time_step.observation['observations']


def zeros(environment):
    return np.zeros(len(environment.action_map))


def links(environment):
    return environment.task.body.links


def aloft(id_, height=50.0, **options):
    """An environment whose character is high above the ground, in the middle of an episode."""
    environment = made(id_, **options)
    environment.reset()
    spatial = environment.task.character.spec.spatial
    place = environment.task.body.pose_qpos[2 if spatial else 1]
    environment.physics.data.qpos[place] += height
    environment.physics.forward()
    return environment


def momentum(environment):
    """Linear momentum of the character, kg m/s."""
    model, data = environment.physics.model.ptr, environment.physics.data.ptr
    mujoco.mj_subtreeVel(model, data)
    root = links(environment)[0]
    return model.body_subtreemass[root] * data.subtree_linvel[root].copy()


def world_of(xml):
    physics = mjcf.Physics.from_mjcf_model(mjcf.from_xml_string(xml))
    return physics, PhysicsWorld(physics)


class WorldTest(parameterized.TestCase):
    """What is drawn is what the physics does."""

    @parameterized.parameters((0.0, 0.4), (0.3, 0.4), (0.2, 0.0), (-0.25, 0.2))
    def test_box_slides_as_coulomb_says(self, slope, friction):
        """The impulse of friction is the coefficient times that of the normal force."""
        physics, world = world_of("""
            <mujoco><option timestep="0.001" cone="elliptic" impratio="100" integrator="implicitfast"/>
            <worldbody><geom type="plane" size="0 0 1" friction="0.9"/>
            <body name="box" pos="0 0 0.05"><joint type="slide" axis="1 0 0"/>
            <joint type="slide" axis="0 0 1"/><geom type="box" size="0.2 0.2 0.05" mass="3"/>
            </body></worldbody></mujoco>""")
        varied = variation.Variation(
            world,
            ('friction', 'slope'),
            world.body_ids(['box']),
            np.zeros(0, int),
            np.zeros(0, int),
        )
        varied.properties.friction[0], varied.properties.slope[0] = friction, slope
        varied.apply(0)
        physics.data.qvel[0] = 20.0
        for _ in range(1500):  # until contacts have settled
            physics.step()
        before, time = physics.data.qvel.copy(), 0.5
        for _ in range(500):
            physics.step()
        along, up = physics.data.qvel - before
        pressed = up + 9.81 * np.cos(slope) * time  # impulse of the ground over the mass
        expected = -9.81 * np.sin(slope) * time - friction * pressed
        self.assertAlmostEqual(along, expected, delta=2e-3)

    @parameterized.parameters(
        (PLANAR, 3.7, 0.0), (PLANAR, 9.8, 0.3), ('PD_Biped3D_Imitate-v0', 1.6, -0.2)
    )
    def test_free_fall(self, id_, gravity, slope):
        """Momentum changes by mass times gravity, which slopes rotate backwards."""
        found = []
        for given in (0.0, gravity):  # the joints move alike
            environment = aloft(id_, randomize={'gravity': given, 'slope': slope, 'mass': 1.5})
            for _ in range(6):
                environment.step(zeros(environment))
            found.append(momentum(environment))
        mass = environment.physics.model.ptr.body_mass[links(environment)].sum()
        expected = 0.2 * mass * gravity * np.array([-np.sin(slope), 0, -np.cos(slope)])
        np.testing.assert_allclose(found[1] - found[0], expected, atol=1e-4 * mass)

    def test_tilted_gravity_in_three_dimensions(self):
        """Its horizontal part points downhill: against the direction of ascent."""
        options = {'gravity': 10.0, 'slope': 0.1, 'slope_direction': np.pi / 2}
        environment = made('PD_Biped3D_Imitate-v0', randomize=options)
        environment.reset()
        expected = 0, -10 * np.sin(0.1), -10 * np.cos(0.1)
        np.testing.assert_allclose(environment.physics.model.ptr.opt.gravity, expected, atol=1e-12)

    @parameterized.parameters(PLANAR, GAIT, MOVERS, BALL, STEPS)
    def test_bodies_and_contacts(self, id_):
        nominal, environment = made(id_), made(id_, randomize={
            'mass': (0.5, 1.5), 'link_mass': (0.8, 1.2), 'inertia': (0.5, 2.0), 'com_offset': 0.05, 'damping': 3.0,
            'friction': 0.37,
        })  # fmt: skip
        nominal.reset()
        for _ in range(2):
            environment.reset()
        before, after = (each.physics.model.ptr for each in (nominal, environment))
        world, own, figure = environment.info['world'], links(environment), environment.task.body
        expected = before.body_mass.copy()
        expected[own] *= world['mass'] * world['link_mass']
        np.testing.assert_allclose(after.body_mass, expected, rtol=1e-14)
        self.assertAlmostEqual(after.body_subtreemass[0], expected.sum(), places=9)
        ratio = after.body_inertia[own] / before.body_inertia[own]
        scale = (after.body_mass[own] / before.body_mass[own])[:, None]
        np.testing.assert_allclose(ratio, world['inertia'] * scale.repeat(3, 1))
        offset = after.body_ipos[own[0]] - before.body_ipos[own[0]]
        self.assertAlmostEqual(np.linalg.norm(offset), 0.05)
        np.testing.assert_allclose(offset, world['com_offset'], atol=1e-12)
        spatial = environment.task.character.spec.spatial
        self.assertEqual(offset[1] == 0, not spatial)
        joints = figure.pose_dof[6 if spatial else 3 :]
        np.testing.assert_allclose(after.dof_damping[joints], 3 * before.dof_damping[joints])
        own = before.geom_priority > 0  # a ball keeps the friction of its contacts
        np.testing.assert_array_equal(after.geom_friction[own], before.geom_friction[own])
        if id_ in (PLANAR, STEPS):
            self.assertGreater(before.dof_damping[joints].min(), 0)
            found = []
            for _ in range(15):
                environment.step(zeros(environment))
                found += environment.physics.data.ptr.contact.friction[:, :2].ravel().tolist()
            self.assertEqual(set(found), {0.37})

    @parameterized.parameters(PLANAR, STEPS)
    def test_model_equals_one_that_is_compiled_with_these_values(self, id_):
        """Also in everything that MuJoCo derives from them."""
        environment = made(id_, randomize={name: EVERY[name] for name in EVERY if name != 'push'})
        for _ in range(3):
            environment.reset()
        found = environment.physics.model.ptr
        root = environment.task.root_entity.mjcf_model
        spec = mujoco.MjSpec.from_string(root.to_xml_string(), assets=root.get_assets())
        world = environment.info['world']
        for number in links(environment):
            body = spec.body(found.body(number).name)
            body.explicitinertial, body.mass = True, found.body_mass[number]
            body.inertia, body.fullinertia = found.body_inertia[number], np.full(6, np.nan)
            body.ipos, body.iquat = found.body_ipos[number], found.body_iquat[number]
        for name in [joint.full_identifier for joint in environment.task.character.joints]:
            spec.joint(name).damping[:] = spec.joint(name).damping * world['damping']
        for geom in spec.geoms:
            geom.friction[0] = world['friction']
            geom.solimp[0], geom.solimp[2] = 0, world['contact_depth']
            geom.solref[0] = world['contact_time']
        spec.option.gravity = found.opt.gravity
        expected = spec.compile()
        for name in (
            'body_mass', 'body_inertia', 'body_ipos', 'body_subtreemass', 'body_invweight0',
            'dof_invweight0', 'dof_M0', 'dof_damping', 'actuator_acc0', 'tendon_invweight0',
            'body_sameframe', 'dof_simplenum', 'body_simple',
        ):  # fmt: skip
            np.testing.assert_allclose(
                getattr(found, name), getattr(expected, name), rtol=1e-9, atol=1e-12, err_msg=name
            )
        self.assertAlmostEqual(found.stat.meaninertia, expected.stat.meaninertia, places=9)
        # Bounding volumes are in the inertial frame, which com_offset moves.
        root = links(environment)[0]
        start, count = found.body_bvhadr[root], found.body_bvhnum[root]
        self.assertGreater(count, 0)
        np.testing.assert_allclose(
            found.bvh_aabb[start : start + count],
            expected.bvh_aabb[start : start + count],
            atol=1e-9,
        )
        solid = (found.geom_contype | found.geom_conaffinity) != 0
        for name in ('geom_friction', 'geom_solimp', 'geom_solref'):
            np.testing.assert_allclose(
                getattr(found, name)[solid], getattr(expected, name)[solid], err_msg=name
            )

    def test_draws_are_uniform_and_independent(self):
        environments = VectorEnvironment(PLANAR, 64, 1, 0, task_kwargs={'randomize': EVERY})
        drawn = []
        for _ in range(4):
            environments.reset()
            drawn.append(environments.info['world'])
        pooled = {name: np.concatenate([each[name] for each in drawn]) for name in drawn[0]}
        for name in ('friction', 'mass', 'inertia', 'damping', 'gravity', 'slope'):
            assert_uniform(pooled[name], *EVERY[name])
        assert_uniform(pooled['link_mass'], *EVERY['link_mass'])
        assert_uniform(np.linalg.norm(pooled['com_offset'], axis=1), *EVERY['com_offset'])
        angles = np.arctan2(pooled['com_offset'][:, 2], pooled['com_offset'][:, 0])
        assert_uniform(angles, -np.pi, np.pi)
        columns = np.stack([pooled[name] for name in ('friction', 'mass', 'gravity', 'slope')])
        off = np.corrcoef(columns) - np.eye(4)
        self.assertLess(np.abs(off).max(), 4 / np.sqrt(256))

    def test_draw_of_one_property_does_not_depend_on_the_others(self):
        alone, among = (
            made(PLANAR, randomize=given)
            for given in ({'gravity': (9, 10)}, {**EVERY, 'gravity': (9, 10)})
        )
        alone.reset(), among.reset()
        self.assertEqual(alone.info['world']['gravity'], among.info['world']['gravity'])

    @parameterized.parameters(PLANAR, GAIT, PLAN)
    def test_terrain_and_start_are_those_without_the_options(self, id_):
        # Links are observed by their centres of mass, so com_offset displaces that of the root.
        world = {name: EVERY[name] for name in EVERY if name not in ('com_offset', 'link_mass')}
        plain, varied = made(id_), made(id_, randomize=world, sensors=MEASURED)
        for _ in range(2):
            expected = observed(plain.reset())
            varied.reset()
            np.testing.assert_allclose(varied.info['clean_observation'], expected, atol=1e-9)

    def test_presets_are_extended_and_reduced(self):
        config = WorldConfig.parse('randomize', {'preset': 'robot', 'friction': 0.3, 'push': None})
        self.assertEqual(config.friction, (0.3, 0.3))
        self.assertIsNone(config.push)
        self.assertEqual(config.link_mass, WorldConfig.parse('randomize', 'robot').link_mass)
        for name in worlds.PRESETS:
            self.assertIsNotNone(WorldConfig.parse('randomize', name).push)
            SensorConfig.parse('sensors', name)

    def test_nothing_asked_for_is_the_plain_task(self):
        for options in ({}, {'randomize': None, 'sensors': None}, {'randomize': {}, 'sensors': {}}):
            self.assertEmpty(made(PLANAR, **options).task.components)


class PushTest(parameterized.TestCase):
    """Impulse is force times duration, whatever a step is."""

    @parameterized.parameters(
        (PLANAR, 0.011), (PLANAR, 0.2), (GAIT, 0.011), (GAIT, 0.2), ('PD_Biped3D_Imitate-v0', 0.2),
        (PLAN, 0.2),
    )  # fmt: skip
    def test_momentum_of_one_push(self, id_, duration):
        found, interval = [], 0.05
        for force in (0.0, 80.0):  # the joints move alike, except for the turn by the push
            push = {'force': force, 'duration': duration, 'interval': interval, 'direction': 0.5}
            environment = aloft(id_, randomize={'gravity': 0.0, 'push': push})
            environment.task.world.engine.pushes.ranges[:, 2] = 1e5  # the next one is far away
            total = np.zeros(3)
            while environment.physics.time() < interval + duration:
                environment.step(zeros(environment))
                total += environment.info['impulse']
            found.append(momentum(environment))
        spatial = environment.task.character.spec.spatial
        ahead = (np.cos(0.5), np.sin(0.5), 0.0) if spatial else (1.0, 0.0, 0.0)
        size = 80.0 * duration
        np.testing.assert_allclose(total, size * np.array(ahead), rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(found[1] - found[0], total, atol=0.03 + 0.03 * size)

    def test_speed_is_impulse_over_nominal_mass(self):
        push = {'speed': 0.5, 'duration': (0.05, 0.3), 'interval': 0.1, 'direction': np.pi}
        environment = aloft(PLANAR, randomize={'gravity': 0.0, 'push': push, 'mass': 2.0})
        environment.task.world.engine.pushes.ranges[:, 2] = 1e5
        total = np.zeros(3)
        for _ in range(15):
            environment.step(zeros(environment))
            total += environment.info['impulse']
        mass = environment.physics.model.ptr.body_mass[links(environment)].sum() / 2
        np.testing.assert_allclose(total, (-0.5 * mass, 0, 0), rtol=1e-9)

    def test_an_arrow_shows_it(self):
        """4 mm long per newton; it points at the root's centre of mass, and ends 0.15 m before it."""
        push = {'force': 100.0, 'duration': 0.2, 'interval': 0.05, 'direction': 0.5}
        environment = aloft('PD_Biped3D_Imitate-v0', randomize={'push': push})
        *_, component = environment.task.components
        self.assertEmpty(component.markers(0))
        for _ in range(3):
            environment.step(zeros(environment))
        [arrow] = component.markers(0)
        root = environment.task.world.xipos[0, links(environment)[0]]
        self.assertAlmostEqual(arrow.size[2], 0.4)
        self.assertAlmostEqual(arrow.yaw, 0.5)
        expected = 0.55 * np.array([np.cos(0.5), np.sin(0.5)])
        np.testing.assert_allclose((root - arrow.position)[:2], expected, atol=1e-12)

    def test_times_and_forces_are_drawn_from_their_ranges(self):
        push = {'force': (10, 20), 'duration': (0.1, 0.2), 'interval': (0.3, 0.5)}
        environment = made('PD_Biped3D_Imitate-v0', randomize={'push': push}, step_limit=None)
        environment.reset()
        state, found = environment.task.world.engine.pushes.state, []
        for _ in range(3000):
            now = state.begin[0, 0], state.end[0, 0], *state.force[0, 0]
            if not found or found[-1] != now:
                found.append(now)
            environment.task.world.step(10)
        begin, end, x, y, z = np.array(found).T
        assert_uniform(end - begin, 0.1, 0.2)
        assert_uniform(begin[1:] - end[:-1], 0.3, 0.5)
        assert_uniform(np.hypot(x, y), 10, 20)
        assert_uniform(np.arctan2(y, x), -np.pi, np.pi)
        self.assertFalse(z.any())

    @parameterized.parameters((PLANAR, False), (STEPS, True))
    def test_pushed_body(self, id_, foot):
        """It is like a constant force that a user applies to this body."""
        plain = made(id_)
        number = -1 if foot else 0
        push = {
            'force': 50.0, 'duration': 10.0, 'interval': 0.0, 'direction': 0.0,
            'body': plain.task.character.spec.links[-1] if foot else None,
        }  # fmt: skip
        pushed = made(id_, randomize={'push': push})
        plain.reset(), pushed.reset()
        plain.physics.data.xfrc_applied[links(plain)[number], 0] = 50.0
        for _ in range(3):
            expected = plain.step(zeros(plain))
            found = pushed.step(zeros(pushed))
            np.testing.assert_allclose(observed(found), observed(expected), rtol=1e-6, atol=1e-8)
        self.assertFalse(pushed.physics.data.xfrc_applied.any())

    def test_pushes_of_the_task_are_added_and_forces_of_users_kept(self):
        own = {'force': 60, 'duration': 0.2, 'interval': 0.1, 'direction': 0.0}
        push = {'force': 100, 'duration': 0.5, 'interval': 0.0, 'direction': np.pi / 2}
        environment = made(STEPS, pushes=own, randomize={'push': {**push, 'body': 'torso'}})
        environment.reset()
        torso, feet = (links(environment)[k] for k in (1, -1))
        forces = environment.physics.data.xfrc_applied
        forces[feet, 2], forces[torso, 1] = 0.125, -0.5
        kept = forces.copy()
        for step in range(9):
            environment.step(zeros(environment))
            along = 0 if step < 3 else 60 / 30
            np.testing.assert_allclose(environment.info['impulse'], (along, 100 / 30, 0), atol=1e-9)
            np.testing.assert_array_equal(environment.physics.data.xfrc_applied, kept)


class SensorTest(parameterized.TestCase):
    """What is observed is the exact observation with the noise that was asked for."""

    @parameterized.parameters(
        ({'noise': {'pose': 0.5}}, {'pose': 0.5}), ({'noise': {}}, {}),
        ({'noise': 0.3}, {'pose': 0.3, 'velocity': 0.3, 'terrain': 0.3}),
    )  # fmt: skip
    def test_options_change_a_preset_where_they_name_it(self, options, changed):
        blocks, stop = suite.build_task(suite.find(PLANAR)).observed, 0
        exact = np.zeros((1, sum(block.size for block in blocks)))
        data = sensors.sensor_data(SensorConfig(preset='robot', **options), blocks, exact, False)
        for block in blocks:
            part, stop = slice(stop, stop + block.size), stop + block.size
            if not isinstance(block.noise, str):
                expected = changed.get(block.name, block.noise.noise[1])
                np.testing.assert_array_equal(data.noise[part], expected)

    @parameterized.parameters(*enumerate(('mild', 'robot', 'harsh')))
    def test_presets_are_those_of_the_blocks(self, level, preset):
        blocks, stop = suite.build_task(suite.find(TERRAIN3D)).observed, 0
        exact = np.zeros((1, sum(block.size for block in blocks)))
        data = sensors.sensor_data(SensorConfig(preset=preset), blocks, exact, False)
        for block in blocks:
            part, stop, how = slice(stop, stop + block.size), stop + block.size, block.noise
            if isinstance(how, str) or not block.size:
                continue
            np.testing.assert_array_equal(data.noise[part], how.noise[level])
            np.testing.assert_array_equal(data.bias[part], how.bias[level])
            np.testing.assert_array_equal(data.delay[part], [[0, how.delay[level]]] * block.size)
            missing = sensors.TERRAIN_DROPOUT[level] if how.kind == 'map' else 0
            np.testing.assert_array_equal(data.dropout[part], missing)

    @parameterized.parameters(PLANAR, TERRAIN3D)
    def test_noise_and_bias(self, id_):
        noise, bias = {'terrain': 0.05, 'pose': 0.01}, {'velocity': 0.2, 'terrain': 0.3}
        options = {'sensors': {'noise': noise, 'bias': bias}}
        environments = VectorEnvironment(id_, 32, 1, 0, step_limit=None, task_kwargs=options)
        blocks = environments.blocks
        found, action = [], np.zeros((32, len(environments.action_map)))
        environments.reset()
        for _ in range(12):
            step = environments.step(action, ~environments.core.ended)
            found.append(step.observation - step.info['clean_observation'])
        error = np.array(found)  # (steps, n, size)
        going = ~environments.core.ended
        error = error[:, going]
        np.testing.assert_array_equal(error[..., blocks['phase']], 0)
        pose = error[..., blocks['pose']]
        self.assertAlmostEqual(pose.std(), 0.01, delta=5e-4)
        self.assertAlmostEqual(pose.mean(), 0, delta=5e-4)
        self.assertLess(abs(np.corrcoef(pose[1:].ravel(), pose[:-1].ravel())[0, 1]), 0.05)
        velocity = error[..., blocks['velocity']]
        np.testing.assert_allclose(velocity - velocity[:1], 0, atol=1e-12)  # constant
        self.assertAlmostEqual(velocity[0].std(), 0.2, delta=0.03)
        self.assertGreater(velocity[0].std(1).min(), 0.1)  # of each number its own
        terrain = error[..., blocks['terrain']]
        offset = terrain.mean((0, 2))  # one number for the whole map
        self.assertAlmostEqual((terrain - offset[:, None]).std(), 0.05, delta=2e-3)
        self.assertBetween(offset.std(), 0.15, 0.5)

    def test_missing_heights(self):
        options = {'sensors': {'terrain_dropout': 0.2}}
        environments = VectorEnvironment(TERRAIN3D, 8, 1, 0, step_limit=None, task_kwargs=options)
        environments.reset()
        part, found = environments.blocks['terrain'], []
        for _ in range(6):
            step = environments.step(np.zeros((8, 17)))
            seen, exact = step.observation[:, part], step.info['clean_observation'][:, part]
            np.testing.assert_array_equal(seen[seen != 0], exact[seen != 0])
            found.append((seen == 0)[exact != 0])
        found = np.concatenate(found)
        self.assertAlmostEqual(found.mean(), 0.2, delta=5 * 0.4 / np.sqrt(len(found)))

    @parameterized.parameters((PLANAR, 3), (GAIT, 1), (PLAN, 2))
    def test_delay(self, id_, delay):
        environment = made(id_, sensors={'delay': {'terrain': delay}}, step_limit=None)
        part = environment.blocks['terrain']
        time_step, exact = environment.reset(), []
        for k in range(8):
            exact.append(environment.info['clean_observation'][part])
            np.testing.assert_array_equal(observed(time_step)[part], exact[max(0, k - delay)])
            rest = slice(part.stop, None)
            np.testing.assert_array_equal(
                observed(time_step)[rest], environment.info['clean_observation'][rest]
            )
            time_step = environment.step(zeros(environment))
            if time_step.last():
                break
        self.assertGreater(k, delay)

    def test_delays_of_presets_are_for_steps_of_a_thirtieth_of_a_second(self):
        for id_, depth in ((PLANAR, 3), (GAIT, 0), (PLAN, 0)):
            environment = made(id_, sensors='robot')
            self.assertEqual(environment.task.components[-1].saved[0].history.shape[1], depth)

    def test_delay_of_an_episode_is_drawn(self):
        environments = VectorEnvironment(
            PLANAR, 256, 1, 0, task_kwargs={'sensors': {'delay': {'terrain': (1, 3)}}}
        )
        environments.reset()
        delay = environments.task.components[-1].saved[0].delay[:, environments.blocks['terrain']]
        self.assertTrue((delay == delay[:, :1]).all())
        counts = np.bincount(delay[:, 0], minlength=4)
        self.assertEqual(counts[0], 0)
        self.assertGreater(counts[1:].min(), 256 / 3 - 4 * 7.6)

    def test_flags_flip(self):
        environments = VectorEnvironment(
            STEPS, 32, 1, 0, step_limit=None, task_kwargs={'sensors': {'noise': {'contact': 0.25}}}
        )
        environments.reset()
        part, wrong = environments.blocks['contact'], []
        for _ in range(20):
            step = environments.step(np.zeros((32, 17)))
            seen, exact = step.observation[:, part], step.info['clean_observation'][:, part]
            self.assertContainsSubset(np.unique(seen), (0, 1))
            wrong.append(seen != exact)
        self.assertAlmostEqual(np.mean(wrong), 0.25, delta=0.05)

    def test_rewards_and_endings_are_those_of_the_true_state(self):
        """And reading twice gives the same values."""
        plain, noisy = made(PLANAR), made(PLANAR, sensors=MEASURED)
        plain.reset(), noisy.reset()
        for action in np.random.default_rng(0).uniform(-1, 1, (30, 11)):
            a, b = plain.step(action), noisy.step(action)
            self.assertEqual(
                (a.reward, a.discount, a.step_type), (b.reward, b.discount, b.step_type)
            )
            np.testing.assert_array_equal(noisy.info['clean_observation'], observed(a))
            self.assertFalse(np.array_equal(observed(a), observed(b)))
            noisy.task.observe()
            np.testing.assert_array_equal(noisy.observation()['observations'], observed(b))

    def test_custom_blocks_have_noise_and_custom_functions_read_the_truth(self):
        given = {
            'observations': {'x': (2, lambda task: task.world.qpos[:, :2])},
            'rewards': {'first': (1.0, lambda task: task.observation[:, 0])},
        }
        environment = made(PLANAR, sensors={'noise': {'x': 0.5, 'terrain': 0.1}}, **given)
        environment.reset()
        time_step, clean = environment.step(np.zeros(11)), environment.info['clean_observation']
        part = environment.blocks['x']
        np.testing.assert_array_equal(clean[part], environment.physics.data.qpos[:2])
        self.assertTrue((observed(time_step)[part] != clean[part]).all())
        self.assertEqual(environment.info['reward_terms']['first'], clean[0])


class IdentityTest(parameterized.TestCase):
    """Hooks do not change what is drawn."""

    @parameterized.parameters(PLANAR, PLAN)
    def test_hooks_of_composer_change_nothing(self, id_):
        options = {'randomize': EVERY, 'sensors': MEASURED}
        plain, hooked = made(id_, **options), made(id_, **options)
        hooked.add_extra_hook('before_step', lambda physics, action, random_state: None)
        plain.reset(), hooked.reset()
        for _ in range(4):
            a, b = plain.step(zeros(plain)), hooked.step(zeros(hooked))
            np.testing.assert_array_equal(observed(a), observed(b))
            np.testing.assert_array_equal(plain.info['impulse'], hooked.info['impulse'])


WORLDS = (
    ({'frction': 1}, "did you mean 'friction'"),
    ('robust', "did you mean 'robot'"),
    ({'preset': 'hash'}, "did you mean 'harsh'"),
    (3, "expected 'mild', 'robot', 'harsh', a dict of options, or WorldConfig"),
    ({'friction': -0.1}, 'friction is -0.1; expected .* a number .* from 0 to 10'),
    ({'friction': (1.2, 0.5)}, 'friction is .*lower and an upper'),
    ({'friction': (0.1, 0.2, 0.3)}, 'lower and an upper'),
    ({'mass': 0}, 'mass is 0; .* from 0.01 to 100'),
    ({'gravity': 1e4}, 'gravity is .* to 100'),
    ({'slope': 2.0}, 'slope is 2.0; .* rad'),
    ({'slope_direction': 1.0}, 'slope_direction has no effect without slope'),
    ({'slope': 0.1, 'slope_direction': 1.0}, 'three-dimensional'),
    ({'com_offset': 5}, 'com_offset is 5; .* m'),
    ({'friction': 'much'}, 'friction is .much.; expected None or a number'),
    ({'friction': ''}, 'friction is ..; expected None or a number'),
    ({'push': {}}, 'neither force and speed'),
    ({'push': {'force': 1, 'speed': 1}}, 'both force and speed'),
    ({'push': 150}, 'push is 150; expected a dict of options, or PushConfig'),
    ({'push': {'force': 1, 'body': 'rooot'}}, 'unknown link in push: body'),
    ({'push': {'force': 1, 'duration': 0}}, 'duration is 0; .* s'),
    ({'push': {'force': np.inf}}, 'force is inf'),
)  # fmt: skip
SENSORS = (
    ({'nois': 1}, "did you mean 'noise'"),
    ({'noise': {'terain': 0.1}}, "did you mean 'terrain'"),
    ({'noise': {'phase': 0.1}}, "phase is the controller's own clock"),
    ({'noise': {'pose': -1}}, r"noise\['pose'\] is -1"),
    ({'noise': 'much'}, 'noise is .much.'),
    ({'bias': {'pose': np.nan}}, 'bias.* is nan'),
    ({'terrain_dropout': 1.5}, 'terrain_dropout is 1.5'),
    ({'delay': 1.5}, 'whole numbers of steps'),
    ({'delay': (3, 1)}, 'whole numbers of steps'),
    ({'delay': {'pose': 10**6}}, 'up to 1000'),
)  # fmt: skip


class RefusalTest(parameterized.TestCase):
    """Contradictory, absurd and unknown settings are named."""

    def test_refused(self):
        blind = 'PD_Biped2D_Flat-v0'
        assert_refused(
            self,
            *((lambda g=g: made(PLANAR, randomize=g), message) for g, message in WORLDS),
            *((lambda g=g: made(PLANAR, sensors=g), message) for g, message in SENSORS),
            (lambda: made(blind, sensors={'terrain_dropout': 0.1}), 'does not observe the ground'),
        )
        made(blind, sensors='robot')  # a preset fits every task


class ExtremeTest(parameterized.TestCase):
    """Nothing returns NaN."""

    EXTREMES = (
        {'mass': 0.1, 'inertia': 0.1}, {'push': {'force': 1e4, 'duration': 0.5, 'interval': 0.1}},
        {'gravity': 100.0, 'com_offset': 1.0, 'damping': 1000.0}, {'friction': 0.0}, {'mass': 10.0},
        {'gravity': 0.0}, {'slope': 1.5}, {'contact_depth': 0.1, 'contact_time': 1.0},
        {'contact_depth': 1e-4, 'contact_time': 1e-3},
    )  # fmt: skip

    @parameterized.parameters(
        *((PLANAR, world) for world in EXTREMES),
        *itertools.product((GAIT, STEPS, PLAN, BALL), EXTREMES[:3]),
    )
    def test_numbers_stay_finite(self, id_, world):
        environment = made(id_, randomize=world, sensors={'noise': 10.0, 'delay': 5})
        rng, time_step = np.random.default_rng(0), environment.reset()
        for _ in range(4 if id_ in (GAIT, PLAN, BALL) else 40):
            time_step = environment.step(rng.uniform(-1, 1, len(environment.action_map)))
            self.assertTrue(np.isfinite(observed(time_step)).all())
            self.assertTrue(np.isfinite(environment.info['clean_observation']).all())
            self.assertTrue(np.isfinite(time_step.reward or 0.0))


class ProgramsTest(FolderTest):
    """The example, and the program that evaluates policies under disturbances."""

    def test_example(self):
        main = runpy.run_path(str(ROOT / 'examples/randomized_worlds.py'))['main']
        with contextlib.redirect_stdout(io.StringIO()) as out:
            main()
        self.assertRegex(out.getvalue(), r'friction 0\.4 to 0\.8: \d+ steps on average')

    def test_robustness(self):
        sys.path.insert(0, str(ROOT / 'benchmarks'))
        self.addCleanup(sys.path.remove, str(ROOT / 'benchmarks'))
        import robustness

        ids, path = ['PD_Biped2D_Flat-v0', PLANAR], self.folder / 'found.json'
        fast = {'randomize': {'push': {'speed': 9, 'interval': 0}}}
        strong = ('push', 'm/s', False, [('9', fast)])
        ground = ('terrain_dropout', '', True, [('0.5', {'sensors': {'terrain_dropout': 0.5}})])
        self.enterContext(mock.patch.object(robustness, 'DISTURBANCES', [strong, ground]))
        self.enterContext(mock.patch.object(robustness, 'IDS', ids))
        found = robustness.run(ids, 2, [0], 1, 40, path)
        self.assertEqual(json.loads(path.read_text()), found)
        flat, gaps = (found['seeds']['0'][id_] for id_ in ids)
        self.assertLess(flat['push: 9']['return'], 0.8 * flat['none']['return'])
        self.assertNotIn('terrain_dropout: 0.5', flat)
        self.assertIn('terrain_dropout: 0.5', gaps)
        with mock.patch.object(robustness.evaluation, 'evaluate', side_effect=AssertionError):
            self.assertEqual(robustness.run(ids, 2, [0], 1, 40, path), found)  # nothing is left
        with self.assertRaisesRegex(ValueError, 'other settings'):
            robustness.run(ids, 3, [0], 1, 40, path)
        # A policy that was replaced is measured again.
        other = dataclasses.replace(policies.reference(ids[0]), clip=3.0)
        with (
            mock.patch.object(robustness.policies, 'reference', lambda id_: other),
            mock.patch.object(
                robustness.evaluation, 'evaluate', wraps=evaluation.evaluate
            ) as again,
        ):
            robustness.run(ids[:1], 2, [0], 1, 40, path)
        self.assertLen(again.mock_calls, 2)
        share = round(100 * flat['push: 9']['return'] / flat['none']['return'])
        self.assertRegex(robustness.table(found), rf'\| push \| 9 m/s \| {share}±\d+ \|')
        row = {
            name: {'return': value, 'return_interval': half}
            for name, value, half in (('none', 100, 6), ('a', 50, 4), ('b', 90, 4))
        }
        shares = [robustness.share({'seeds': {'0': {'x': row}}}, 'x', key) for key in 'ab']
        self.assertEqual(shares, ['50±5', '90'])  # 4 and 50 % of 6 are independent

    def test_the_measurements_are_of_the_shipped_policies(self):
        if not policies.available('randomized'):
            self.skipTest('the trained policies are not installed')
        found = json.loads((ROOT / 'docs/data/robustness.json').read_text())
        for rows in found['seeds'].values():
            for id_, row in rows.items():
                expected = digest(policies.reference(id_))
                self.assertEqual(
                    row['of'], expected, f'measure {id_} again: benchmarks/robustness.py'
                )
