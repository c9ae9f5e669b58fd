"""Imperfect motors: torques against formulas, and composition with everything else."""

import copy
import itertools
import json
import pathlib
import tempfile

import mujoco
import numpy as np
from absl.testing import parameterized
from dm_control import mjcf
from engine_test import XML
from gait_test import around_physics
from helpers import EVERY_MOTOR, assert_refused, assert_uniform

from trl_suite import actuation, characters, suite
from trl_suite.actuation import realism, series, strength_curves
from trl_suite.engine import BatchWorld, motors
from trl_suite.engine.world import STATE
from trl_suite.vector import VectorEnvironment

PLANAR = 'PD_Biped2D_LLC_Imitate_Flat-v0'
MUSCLE = 'MTU_Biped2D_LLC_Imitate_Flat-v0'
GAIT = 'FSM_Dog2D_Terrain_Gaps-v0'
CHARACTERS = ('biped2d', 'biped3d')


def make(character='biped2d', model='position', task='imitation', **options):
    """An environment after its reset."""
    environment = suite.build(
        character, model, task=task, task_kwargs={'actuators': options, 'random': 1}
    )
    environment.reset()
    return environment


def actions(environment, steps, seed=0, scale=1.0):
    size = len(environment.action_map)
    return scale * np.random.default_rng(seed).uniform(-1, 1, (steps, size))


def flat(step):
    return np.concatenate([np.ravel(block) for block in step.observation.values()])


def joint_of(environment, name):
    task = environment.task
    return environment.physics.model.ptr.joint(f'{task.character.spec.name}/{name}')


def each_step(environment, action, steps):
    """Yields MjData before and after each physics step under one action."""
    data = environment.physics.data.ptr
    environment.task.apply_action(action[None], np.array([0]))
    for _ in range(steps):
        before = data.qpos.copy(), data.qvel.copy()
        environment.task.world.step(1)
        yield before, data


def limit_of(v, limit, no_load, braking):
    """Largest torque in the direction in which v is measured."""
    return limit * min(max(1 - v / no_load, 0), braking)


REFUSED = (  # environment, options
    (PLANAR, {'torque_sped': True}, "did you mean 'torque_speed'"),
    (PLANAR, {'delay': -1}, 'delay is -1'),
    (PLANAR, {'delay': 5000}, 'from 0 to 1000, in ms'),
    (PLANAR, {'delay': (30, 10)}, 'a lower and an upper bound'),
    (PLANAR, {'delay': (1, 2, 3)}, 'a lower and an upper bound'),
    (PLANAR, {'noise': 2}, 'from 0 to 0.5'),
    (PLANAR, {'strength': (1, 10)}, 'at most 2'),
    (PLANAR, {'torque_speed': True, 'no_load_speed': 0.5}, 'at least 1, in rad/s'),
    (PLANAR, {'noise': float('nan')}, 'noise is nan'),
    (PLANAR, {'strength': 0}, 'strength is 0'),
    (PLANAR, {'strength': 'weak'}, 'strength'),
    (PLANAR, {'torque_speed': 1}, 'True or False'),
    (PLANAR, {'no_load_speed': 5.0}, 'no effect without torque_speed'),
    (PLANAR, {'backlash': 0.6}, 'from 0 to 0.5, in rad'),
    (PLANAR, {'flex': -0.1}, 'flex is -0.1'),
    (PLANAR, {'flex': 0.1, 'flex_damping': -0.001}, 'from 0 to 1, in s'),
    (PLANAR, {'flex_damping': 0.1}, 'no effect without flex'),
    (PLANAR, {'braking': 2.0}, 'no effect without torque_speed'),
    (PLANAR, {'torque_pose': 'no such file.json'}, 'cannot read the table'),
    (PLANAR, {'torque_pose': 3}, 'expected True'), (PLANAR, {'torque_pose': {}}, 'expected True'),
    (PLANAR, {'torque_pose': {'right_nee': {}}}, "did you mean 'right_knee'"),
    (PLANAR, {'torque_pose': {'right_knee': {'angle': [0, 1]}}}, 'angle, positive, negative'),
    (PLANAR, {'torque_pose': {'right_knee': {'angle': [0, 0], 'positive': [1, 1], 'negative': [1, 1]}}}, 'ascending order'),
    (PLANAR, {'torque_pose': {'right_knee': {'angle': [0, 1], 'positive': [1, 1], 'negative': [1, -1]}}}, 'from 0 to 10'),
    (PLANAR, [1], 'expected a dict of options'),
    *((MUSCLE, {name: value}, f'{name} is not an option of muscle control') for name, value in (
        ('torque_speed', True), ('torque_pose', True), ('flex', 0.1), ('backlash', 0.1))),
    (GAIT, {'delay': (0, 3)}, 'at most 2 ms for a gait'),
    ('PD_Dog2D_Flat-v0', {'torque_pose': True}, "'dog' has no curves of its own"),
)  # fmt: skip


class OptionsTest(parameterized.TestCase):
    def test_refused(self):
        xml = """<mujoco><worldbody><body name="root"><geom name="root" size=".1"/>
        <body name="a"><joint name="a" axis="0 1 0" actuatorfrcrange="-1 1"/>
        <joint name="b" axis="0 1 0" actuatorfrcrange="-1 1"/><geom name="a" size=".1"/></body>
        </body></worldbody></mujoco>"""
        spec = characters.CharacterSpec(
            name='two', joints={'a': characters.Joint(1, 1, 1), 'b': characters.Joint(1, 1, 1)},
            fall_links=('root',), end_effectors=('a',), stumble_exempt=(), description='', xml=xml,
            bodies=('root', 'a'),
        )  # fmt: skip
        flexible = actuation.Actuators(flex=0.1)
        assert_refused(
            self,
            *((lambda i=i, o=o: suite.make(i, {'actuators': o}), message) for i, o, message in REFUSED),
            (lambda: realism.body(flexible, spec), 'flex needs one joint for each link'),
        )  # fmt: skip

    def test_ideal_actuators_change_nothing(self):
        ideal = {'delay': 0, 'noise': 0, 'strength': 1, 'torque_pose': False}
        plain = suite.make(PLANAR, task_kwargs={'random': 4})
        given = suite.make(PLANAR, task_kwargs={'random': 4, 'actuators': ideal})
        self.assertIs(type(given.task), type(plain.task))
        self.assertEqual(
            given.task.root_entity.mjcf_model.to_xml_string(),
            plain.task.root_entity.mjcf_model.to_xml_string(),
        )

    def test_terrain_and_start_do_not_depend_on_the_option(self):
        gaps = 'PD_Biped2D_Gaps_Terrain-v0'
        plain = suite.make(gaps, task_kwargs={'random': 4})
        given = suite.make(gaps, task_kwargs={'random': 4, 'actuators': EVERY_MOTOR})
        for _ in range(2):
            # Springs and play add bodies, which round differently.
            np.testing.assert_allclose(flat(plain.reset()), flat(given.reset()), atol=1e-9)


class EngineTest(parameterized.TestCase):
    def test_motors_without_effect_leave_every_bit(self):
        model = mujoco.MjModel.from_xml_string(XML)
        plain, other = BatchWorld(model, 3, 1), BatchWorld(model, 3, 1)
        other.set_motors(motors.Limits(), motors.Noise(), 0, 0)
        for control in np.random.default_rng(0).uniform(-1, 1, (60, 3, 2)):
            for world in (plain, other):
                world.ctrl[:] = control
                world.step(7)
            np.testing.assert_array_equal(plain.qpos, other.qpos)
            np.testing.assert_array_equal(plain.qvel, other.qvel)


class TorqueSpeedTest(parameterized.TestCase):
    NO_LOAD, BRAKING = 6.0, 1.25

    def make(self, character, model):
        return make(
            character, model, torque_speed=True, no_load_speed=self.NO_LOAD, braking=self.BRAKING
        )

    def test_servos_of_hinges_follow_the_formula(self):
        environment = self.make('biped2d', 'position')
        spec, saturated = environment.task.character.spec, 0
        rng = np.random.default_rng(0)
        for _ in range(8):
            action = rng.choice([-1.0, 1.0], len(environment.action_map))
            target = environment.action_map.control(action)
            for (qpos, qvel), data in each_step(environment, action, 10):
                for k, (name, joint) in enumerate(spec.joints.items()):
                    own = joint_of(environment, name)
                    limit = environment.task.character.torque_limits[k]
                    v = qvel[own.dofadr[0]]
                    kv = joint.kd - min(limit / 50, joint.kd)
                    torque = joint.kp * (target[k] - qpos[own.qposadr[0]]) - kv * v
                    high = limit_of(v, limit, self.NO_LOAD, self.BRAKING)
                    low = -limit_of(-v, limit, self.NO_LOAD, self.BRAKING)
                    saturated += not low <= torque <= high
                    self.assertAlmostEqual(
                        data.actuator_force[k], min(max(torque, low), high), delta=1e-9 * limit
                    )
        self.assertGreater(saturated, 50)

    @parameterized.parameters('position', 'torque')
    def test_norm_of_ball_joints_follows_the_formula(self, model_name):
        """The intended torque is that of the same state without limits."""
        environment = self.make('biped3d', model_name)
        model, data = environment.physics.model.ptr, environment.physics.data.ptr
        free, scratch = copy.copy(model), mujoco.MjData(model)
        free.actuator_forcelimited[:] = False
        spec, saturated = environment.task.character.spec, 0
        rng = np.random.default_rng(1)
        for _ in range(6):
            action = rng.choice([-1.0, 1.0], len(environment.action_map))
            environment.task.apply_action(action[None], np.array([0]))
            for _ in range(8):
                state = np.empty(mujoco.mj_stateSize(model, STATE))
                mujoco.mj_getState(model, data, state, STATE)
                mujoco.mj_setState(free, scratch, state, STATE)
                mujoco.mj_forward(free, scratch)
                environment.task.world.step(1)
                for k, name in enumerate(spec.joints):
                    if not environment.task.character.spherical[k]:
                        continue
                    axis = '_x' if model_name == 'torque' else ''
                    first = model.actuator(f'biped3d/{name}{axis}').id
                    out = slice(model.actuator_outadr[first], model.actuator_outadr[first] + 3)
                    wanted = scratch.actuator_force[out]
                    limit = environment.task.character.torque_limits[k]
                    norm = np.linalg.norm(wanted)
                    dof = model.joint(f'biped3d/{name}').dofadr[0]
                    v = wanted @ scratch.qvel[dof : dof + 3] / norm
                    most = limit_of(v, limit, self.NO_LOAD, self.BRAKING)
                    saturated += norm > most
                    np.testing.assert_allclose(
                        data.actuator_force[out], wanted * min(1, most / norm), atol=1e-7 * limit
                    )
        self.assertGreater(saturated, 10)

    def test_velocity_servos_of_ball_joints_have_a_limit_about_each_axis(self):
        environment = self.make('biped3d', 'velocity')
        model = environment.physics.model.ptr
        joint = model.joint('biped3d/right_hip')
        each = environment.task.character.torque_limits[1] / np.sqrt(3)
        action, saturated = np.ones(len(environment.action_map)), 0
        for (_, qvel), data in each_step(environment, action, 30):
            for k, axis in enumerate('xyz'):
                v = qvel[joint.dofadr[0] + k]
                high = limit_of(v, each, self.NO_LOAD, self.BRAKING)
                low = -limit_of(-v, each, self.NO_LOAD, self.BRAKING)
                force = data.actuator(f'biped3d/right_hip_{axis}').force[0]
                self.assertBetween(force, low - 1e-9, high + 1e-9)
                saturated += force > high - 1e-9
        self.assertGreater(saturated, 10)

    def test_gaits_have_the_limits_at_every_physics_step(self):
        environment = make(
            'dog', None, 'gait', torque_speed=True, no_load_speed=self.NO_LOAD, braking=self.BRAKING
        )
        model, data = environment.physics.model.ptr, environment.physics.data.ptr
        character = environment.task.character
        names = [f'dog/{name}' for name in character.spec.joints]
        motors = [model.actuator(name).id for name in names]
        dofs = [model.joint(name).dofadr[0] for name in names]
        rates, ranges = [], []
        around_physics(
            environment,
            before=lambda: rates.append(data.qvel[dofs]),
            after=lambda: ranges.append(model.actuator_forcerange[motors]),
        )
        environment.step(np.zeros(len(environment.action_map)))
        self.assertGreater(len(rates), 100)
        rates, relative = np.array(rates), np.array(ranges) / character.torque_limits[:, None]
        for sign, found in ((1, relative[..., 1]), (-1, -relative[..., 0])):
            expected = np.clip(1 - sign * rates / self.NO_LOAD, 0, self.BRAKING)
            np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)
            self.assertGreater(np.ptp(found), 0.5)


class TorquePoseTest(parameterized.TestCase):
    def test_human_curves_are_those_of_the_publication(self):
        # Table 3, men of 18 to 25 years; ratios at the angle of the largest torque.
        knee = strength_curves.human('right_knee')
        at = lambda curve, angle: np.interp(angle, knee.angle, curve)  # noqa: E731
        self.assertAlmostEqual(at(knee.positive, -1.133), 1.0, delta=0.01)  # extension
        self.assertAlmostEqual(at(knee.negative, -0.522), 0.087 / 0.163, delta=0.01)
        straight = np.cos(1.258 * 1.133)
        self.assertAlmostEqual(at(knee.positive, 0.0), straight, delta=0.02)
        ankle = strength_curves.human('left_ankle')
        weak = np.interp(-0.187, ankle.angle, ankle.positive)  # dorsiflexion
        self.assertAlmostEqual(weak, 0.033 / 0.095, delta=0.01)
        self.assertAlmostEqual(ankle.negative.max(), 1.0, delta=0.01)
        self.assertIsNone(strength_curves.human('neck'))

    def test_servos_follow_the_table(self):
        table = {
            'right_knee': {'angle': [-1.5, -0.5, 0.0], 'positive': [0.2, 0.8, 0.1], 'negative': [0.5, 0.3, 0.4]}
        }  # fmt: skip
        environment = make(torque_pose=table)
        own, found = joint_of(environment, 'right_knee'), []
        limit = environment.task.character.torque_limits[1]
        rng = np.random.default_rng(2)
        for _ in range(8):
            action = rng.choice([-1.0, 1.0], len(environment.action_map))
            for (qpos, _), data in each_step(environment, action, 10):
                factors = {
                    name: np.interp(qpos[own.qposadr[0]], table['right_knee']['angle'], table['right_knee'][name])
                    for name in ('positive', 'negative')
                }  # fmt: skip
                low, high = -limit * factors['negative'], limit * factors['positive']
                force = data.actuator('biped2d/right_knee').force[0]
                self.assertBetween(force, low - 1e-9, high + 1e-9)
                found.append(min(abs(force - low), abs(force - high)) < 1e-9)
        self.assertGreater(np.mean(found), 0.3)

    @parameterized.parameters('position', 'torque', 'velocity')
    def test_ball_joints_have_the_limit_about_the_lateral_axis(self, model):
        # Torques that swing the right hip forward are limited to a tenth, others are not.
        entry = {'angle': [-3.0, 3.0], 'positive': [0.1, 0.1], 'negative': [1.0, 1.0]}
        environment = make('biped3d', model, torque_pose={'right_hip': entry})
        other, forward = [], []
        limit = environment.task.character.torque_limits[1]
        joint = joint_of(environment, 'right_hip')
        rng = np.random.default_rng(3)
        for _ in range(10):
            action = rng.choice([-1.0, 1.0], len(environment.action_map))
            for _, data in each_step(environment, action, 5):
                own = data.qfrc_actuator[joint.dofadr[0] + np.arange(3)]
                forward.append(-own[1] / limit)
                other.append(np.linalg.norm(own) / limit)
        self.assertLessEqual(max(forward), 0.1 + 1e-9)
        self.assertGreater(max(forward), 0.05)
        self.assertLess(min(forward), -0.2)
        self.assertLessEqual(max(other), 1 + 1e-9)

    def test_the_angle_of_a_ball_joint_is_its_rotation_about_the_lateral_axis(self):
        for vector in ([0, -0.7, 0], [0.3, 0.5, -0.2], [0, 3.0, 0]):
            angle, quaternion = np.linalg.norm(vector), np.zeros(4)
            mujoco.mju_axisAngle2Quat(quaternion, np.array(vector) / angle, angle)
            for address in quaternion, -quaternion:
                found = motors.lateral_angle(address.__array_interface__['data'][0], 0)
                self.assertAlmostEqual(found, vector[1], places=12)

    def test_a_file_is_read_as_a_table_is(self):
        table = {'right_knee': {'angle': [-1, 0], 'positive': [1, 0.5], 'negative': [0.5, 0.5]}}
        with tempfile.TemporaryDirectory() as folder:
            path = pathlib.Path(folder) / 'table.json'
            path.write_text(json.dumps(table))
            one, two = make(torque_pose=str(path)), make(torque_pose=table)
        for action in actions(one, 5):
            np.testing.assert_array_equal(flat(one.step(action)), flat(two.step(action)))


class StrengthTest(parameterized.TestCase):
    @parameterized.parameters(
        *itertools.product(CHARACTERS, ('torque', 'velocity', 'position')), ('biped2d', 'muscle')
    )
    def test_torques_and_limits_scale(self, character, model):
        # One physics step from the same state: the torque is the factor times that of the ideal motor.
        plain = suite.build(character, model, task_kwargs={'random': 1})
        weak, found = make(character, model, strength=0.5), []
        plain.reset()
        for environment in (plain, weak):
            environment.task.apply_action(np.ones((1, len(environment.action_map))), np.array([0]))
            environment.task.world.step(1)
            found.append(environment.physics.data.ptr.actuator_force)
        np.testing.assert_allclose(found[1], 0.5 * found[0], rtol=1e-9, atol=1e-12)

    def test_limits_by_speed_scale_with_the_factor_of_their_motor(self):
        environment = make(torque_speed=True, strength=(0.5, 1.5))
        model, task = environment.physics.model.ptr, environment.task
        for (_, qvel), _ in each_step(environment, np.zeros(6), 5):
            for k, name in enumerate(task.character.spec.joints):
                limit = task.character.torque_limits[k] * environment.info[f'strength_{name}']
                v = qvel[joint_of(environment, name).dofadr[0]]
                low, high = model.actuator(f'biped2d/{name}').forcerange
                self.assertAlmostEqual(high, limit_of(v, limit, 20.0, 1.5), places=9)
                self.assertAlmostEqual(-low, limit_of(-v, limit, 20.0, 1.5), places=9)

    def test_factors_are_drawn_uniformly_and_shown(self):
        options = {'strength': (0.7, 1.3), 'delay': (10, 50)}
        environments = VectorEnvironment(PLANAR, 200, 1, seed=3, task_kwargs={'actuators': options})
        environments.reset()
        drawn, delay = self.drawn(environments), environments.info['delay']
        assert_uniform(drawn, 0.7, 1.3)
        self.assertLess(abs(np.corrcoef(drawn)[0, 1]), 0.25)  # joints are independent
        self.assertBetween(delay.min(), 9, 13)
        self.assertBetween(delay.max(), 47, 51)
        self.assertAlmostEqual(delay.mean(), 30, delta=3)
        environments.reset()
        self.assertGreater(np.abs(self.drawn(environments) - drawn).min(), 0)

    def drawn(self, environments):
        joints = environments.task.character.spec.joints
        return np.array([environments.info[f'strength_{name}'] for name in joints])


class NoiseTest(parameterized.TestCase):
    def test_deviation_and_correlation_time(self):
        environment = make(noise=0.1)
        task, data = environment.task, environment.physics.data.ptr
        limits = task.character.torque_limits
        dofs = [joint_of(environment, name).dofadr[0] for name in task.character.spec.joints]
        found = []
        for _ in range(4000):
            task.world.step(1)
            found.append(data.qfrc_applied[dofs] / limits)
        found = np.array(found)
        self.assertAlmostEqual(found.std(), 0.1, delta=0.01)
        self.assertAlmostEqual(found.mean(), 0.0, delta=0.01)
        lag = round(realism.NOISE_TIME / task.physics_timestep)
        correlation = (found[lag:] * found[:-lag]).mean() / found.var()
        self.assertAlmostEqual(correlation, np.exp(-1), delta=0.05)
        self.assertLess(abs((found[:, 0] * found[:, 1]).mean() / found.var()), 0.1)

    def test_muscle_driven_joints_have_it_too(self):
        environment = suite.make(MUSCLE, task_kwargs={'random': 1, 'actuators': {'noise': 0.1}})
        environment.reset()
        environment.step(np.zeros(len(environment.action_map)))
        self.assertGreater(np.count_nonzero(environment.physics.data.ptr.qfrc_applied), 5)

    def test_joints_that_no_muscle_drives_have_none(self):
        environment = suite.build(
            'biped2d_full', 'muscle', task_kwargs={'random': 1, 'actuators': {'noise': 0.1}}
        )
        environment.reset()
        environment.step(np.zeros(len(environment.action_map)))
        joints = environment.task.character.joints
        applied = environment.physics.bind(joints).qfrc_applied
        driven = {joint.name for joint, torque in zip(joints, applied, strict=True) if torque}
        legs = {
            f'{side}_{joint}' for side in ('right', 'left') for joint in ('hip', 'knee', 'ankle')
        }
        self.assertEqual(driven, legs)


class DelayTest(parameterized.TestCase):
    @parameterized.parameters(3.0, 37.0, 500.0)
    def test_a_control_takes_effect_after_the_delay(self, delay):
        """What acts at step s is the control given at step s - lag, at first the first."""
        environment = make(delay=delay)
        task, data, per, given = environment.task, environment.physics.data.ptr, 20, []
        lag = round(delay / 1000 / task.physics_timestep)
        self.assertAlmostEqual(
            environment.info.get('delay', 0), 1000 * lag * task.physics_timestep, places=9
        )
        for k, action in enumerate(actions(environment, 25)):
            task.apply_action(action[None], np.array([0]))
            given.append(environment.action_map.control(action))
            for s in range(k * per, (k + 1) * per):
                qpos, qvel = data.qpos.copy(), data.qvel.copy()
                task.world.step(1)
                applied = self.servo(environment, 3, given[max(0, (s - lag) // per)], qpos, qvel)
                self.assertAlmostEqual(data.actuator_force[3], applied, places=9)
            np.testing.assert_array_equal(task.world.ctrl[0], given[-1])  # as the task wrote it

    @parameterized.parameters(
        (GAIT, 2), ('PD_Biped3D_HLC_Forest-v0', 10), (PLANAR, 10),
    )  # fmt: skip
    def test_enough_controls_are_stored(self, id_, steps):
        """Of a delay of 60 ms, or 2 ms in gaits, with a control every so many physics steps."""
        delay = 2 if id_ == GAIT else 60
        environment = suite.make(id_, task_kwargs={'random': 1, 'actuators': {'delay': (0, delay)}})
        environment.reset()
        task = environment.task
        lag = round(delay / 1000 / task.physics_timestep)
        self.assertEqual(task.steps_per_call, steps)
        stored = len(task.world.engine.motors.state.controls[0])
        self.assertGreaterEqual(
            stored, -(-lag // steps) + 1
        )  # those of the delay, and the current one

    def servo(self, environment, k, target, qpos, qvel):
        character = environment.task.character
        joint, limit = list(character.spec.joints.values())[k], character.torque_limits[k]
        own = joint_of(environment, list(character.spec.joints)[k])
        kv = joint.kd - min(limit / 50, joint.kd)
        torque = joint.kp * (target[k] - qpos[own.qposadr[0]]) - kv * qvel[own.dofadr[0]]
        return min(max(torque, -limit), limit)


def fixed(character, **options):
    """A character whose root is fixed, with servos, and its physics; gravity acts."""
    spec = characters.CHARACTERS[character]
    figure = characters.make(realism.body(actuation.Actuators(**options), spec))
    actuation.add(figure, 'position', 1 / 600)
    series.finish(figure, 1 / 600)
    figure.mjcf_model.option.timestep = 1 / 600
    figure.mjcf_model.option.integrator = 'implicitfast'
    return figure, mjcf.Physics.from_mjcf_model(figure.mjcf_model)


class SeriesTest(parameterized.TestCase):
    """Free play and springs between motors and links."""

    @parameterized.parameters('biped2d', 'dog', 'biped3d', 'hopper')
    def test_a_spring_deflects_by_torque_over_stiffness(self, character):
        flex = 0.5
        figure, physics = fixed(character, flex=flex)
        model, data = physics.model.ptr, physics.data.ptr
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
        data.ctrl[:] = 0.3  # rad, so that gravity loads the joints
        for _ in range(8000):
            physics.step()
        self.assertLess(np.abs(data.qvel).max(), 1e-3)
        largest = 0.0
        for k, name in enumerate(figure.spec.joints):
            motor, spring = model.joint(name), model.joint(name + series.FLEX)
            stiffness = figure.torque_limits[k] / flex
            if figure.spherical[k]:
                deflection, size = np.zeros(3), 3
                address = spring.qposadr[0]
                mujoco.mju_quat2Vel(deflection, data.qpos[address : address + 4], 1.0)
            else:
                deflection, size = data.qpos[spring.qposadr], 1
            dof = motor.dofadr[0] + np.arange(size)
            # Of a ball joint, torque and deflection are parallel, but refer to different links.
            torque = data.qfrc_actuator[dof] + data.qfrc_constraint[dof]  # at joint limits
            self.assertAlmostEqual(
                np.linalg.norm(deflection), np.linalg.norm(torque) / stiffness,
                delta=1e-4 + 2e-3 * np.linalg.norm(deflection),
            )  # fmt: skip
            if size == 1:
                self.assertAlmostEqual(deflection[0], -torque[0] / stiffness, delta=1e-4)
            largest = max(largest, np.linalg.norm(deflection))
        self.assertGreater(largest, 2e-3)

    @parameterized.product(character=('biped2d', 'biped3d'), both=(False, True))
    def test_play_is_free_within_its_range(self, character, both):
        backlash = 0.1
        options = {'flex': 0.02} if both else {}
        _, physics = fixed(character, backlash=backlash, **options)
        model, data = physics.model.ptr, physics.data.ptr
        model.opt.gravity[:] = 0
        name = 'right_hip'
        play, ball = (
            model.joint(name + series.PLAY),
            model.joint(name).type[0] == mujoco.mjtJoint.mjJNT_BALL,
        )
        last = model.joint(name + (series.FLEX if both else series.PLAY))  # moves the link
        found = []
        for torque in (4.0, -4.0):
            for _ in range(1500):
                data.qfrc_applied[:] = 0
                for joint in {play.id, last.id, model.joint(name).id}:  # on the link about y
                    data.qfrc_applied[model.jnt_dofadr[joint] + ball] = torque
                data.qvel *= 0.99
                physics.step()
            address = play.qposadr[0]
            if ball:
                vector = np.zeros(3)
                mujoco.mju_quat2Vel(vector, data.qpos[address : address + 4], 1.0)
                found.append(vector[1])
            else:
                found.append(data.qpos[address])
        self.assertAlmostEqual(found[0] - found[1], backlash, delta=0.03 * backlash)

    @parameterized.product(
        character=CHARACTERS, options=({'flex': 0.05}, {'flex': 0.05, 'backlash': 0.02})
    )
    def test_mass_poses_and_observations_are_those_of_the_character(self, character, options):
        plain = suite.build(character, task_kwargs={'random': 5})
        given = suite.build(character, task_kwargs={'random': 5, 'actuators': options})
        np.testing.assert_allclose(flat(plain.reset()), flat(given.reset()), atol=1e-9)
        self.assertEqual(plain.task.body.__class__, given.task.body.__class__)
        before, after = (each.physics.model.ptr for each in (plain, given))
        self.assertAlmostEqual(after.body_mass.sum() / before.body_mass.sum(), 1, delta=1e-4)
        self.assertGreater(after.nexclude, before.nexclude)

    def test_springs_are_damped_as_asked(self):
        figure, physics = fixed('biped2d', flex=0.5, flex_damping=0.2)
        model = physics.model.ptr
        for name, limit in zip(figure.spec.joints, figure.torque_limits, strict=True):
            dof = model.joint(name + series.FLEX).dofadr[0]
            self.assertAlmostEqual(model.dof_damping[dof], 0.2 * limit / 0.5)


class CompositionTest(parameterized.TestCase):
    """With everything else; bit for bit: in state_test."""

    @parameterized.parameters('torque', 'velocity', 'position', 'muscle')
    def test_extreme_settings_stay_finite(self, model):
        options = {'delay': 500, 'noise': 0.5, 'strength': (0.01, 2)}
        if model != 'muscle':
            options |= {'backlash': 0.2, 'flex': 1.0, 'torque_speed': True, 'no_load_speed': 1.0}
            options |= {'braking': 2.0, 'torque_pose': True}
        environment = make('biped2d', model, **options)
        for action in actions(environment, 60):
            step = environment.step(action)
            self.assertTrue(np.isfinite(flat(step)).all())
            self.assertTrue(step.reward is None or np.isfinite(step.reward))
