"""Tests of the actuation of planar characters: action maps, servos and torque limits."""

import dataclasses

import mujoco
import numpy as np
from absl.testing import parameterized
from dm_control import composer, mjcf

from trl_suite import actuation, characters, suite
from trl_suite.util import resources

TIMESTEP = 1 / 300  # s
MUSCLES = {'biped2d': 16, 'biped2d_full': 16, 'dog': 44, 'goat': 44, 'raptor': 40}
WITHOUT_MUSCLES = {'biped2d_simbicon': 6, 'hopper': 2}  # and without a clip
JOINTS = {
    'biped2d': 6, 'biped2d_full': 11, 'dog': 20, 'goat': 20, 'raptor': 18, **WITHOUT_MUSCLES
}  # fmt: skip
PAIRS = tuple(
    (name, model)
    for name in JOINTS
    for model in ('torque', 'velocity', 'position', 'muscle')
    if model != 'muscle' or name in MUSCLES
)


def full(name, model):
    """Expected action_scale of each joint; torques as fractions of the limit."""
    revolute, leg = {
        'torque': (0.75, 1),
        'velocity': (10 * np.pi, 10),  # rad/s, m/s
        'position': (1.5, 0.2),  # rad, m
    }[model]
    return np.array([revolute, leg] if name == 'hopper' else [revolute] * JOINTS[name])


class Mounted:
    """A character whose root is welded to the world, without gravity and contacts; or free, on a plane."""

    def __init__(self, name, model, free=False, **options):
        arena = composer.Arena()
        option = arena.mjcf_model.option
        option.timestep, option.integrator = TIMESTEP, 'implicitfast'
        self.character = characters.make(name)
        frame = arena.attach(self.character)
        if free:
            arena.mjcf_model.worldbody.add('geom', type='plane', size=(0, 0, 1))
            self.character.create_root_joints(frame)
        else:
            option.gravity, option.flag.contact = (0, 0, 0), 'disable'
        self.map = actuation.add(self.character, model, TIMESTEP, **options)
        physics = mjcf.Physics.from_mjcf_model(arena.mjcf_model)
        self.model, self.data = physics.model.ptr, physics.data.ptr
        self._physics = physics
        names = [joint.full_identifier for joint in self.character.joints]
        ids = [self.model.joint(name).id for name in names]
        self.qpos, self.dof = self.model.jnt_qposadr[ids], self.model.jnt_dofadr[ids]
        self.joints = list(self.character.spec.joints.values())
        ids = [self.model.actuator(f'{name}/{each}').id for each in self.map.names]
        self.actuators = np.array(ids)

    def act(self, action):
        self.data.ctrl[self.actuators] = self.map.control(np.asarray(action, float))

    def forward(self):
        mujoco.mj_forward(self.model, self.data)

    def step(self, seconds):
        mujoco.mj_step(self.model, self.data, round(seconds / TIMESTEP))

    @property
    def torque(self):
        return self.data.qfrc_actuator[self.dof]


class ActionMapTest(parameterized.TestCase):
    """The affine map from actions to controls."""

    @parameterized.parameters(*PAIRS)
    def test_affine_clipped_and_invertible(self, name, model):
        mounted = Mounted(name, model)
        mapping = mounted.map
        size = MUSCLES[name] if model == 'muscle' else JOINTS[name]
        self.assertLen(mapping, size)
        self.assertLen(set(mapping.names), size)
        self.assertEqual(mapping.action_offset.shape, (size,))
        self.assertEqual(mapping.action_scale.shape, (size,))
        rng = np.random.default_rng(0)
        action = rng.uniform(-1, 1, (5, size))
        control = mapping.control(action)
        np.testing.assert_allclose(control, mapping.action_offset + mapping.action_scale * action)
        np.testing.assert_allclose(mapping.action(control), action, atol=1e-12)
        far = rng.uniform(1, 9, size)
        np.testing.assert_array_equal(mapping.control(far), mapping.control(np.ones(size)))
        np.testing.assert_array_equal(mapping.control(-far), mapping.control(-np.ones(size)))
        np.testing.assert_array_equal(mounted.model.dof_armature[mounted.dof], 0.01)
        np.testing.assert_array_equal(mounted.model.dof_frictionloss, 0)

    @parameterized.parameters(
        ('torque', 'torque', 'N m (leg: N)', (1875, 180)),
        ('velocity', 'target velocity', 'rad/s (leg: m/s)', (10 * np.pi, 10)),
        ('position', 'target angle', 'rad (leg: m)', (1.5, 0.2)),
    )
    def test_prismatic_joint(self, model, quantity, unit, action_scale):
        mapping = Mounted('hopper', model).map
        self.assertEqual((mapping.quantity, mapping.unit), (quantity, unit))
        self.assertEqual(mapping.names, ('hip', 'leg'))
        np.testing.assert_allclose(mapping.action_scale, action_scale)
        np.testing.assert_array_equal(mapping.action_offset, 0)

    def test_position_options(self):
        reach = np.linspace(0.5, 1.5, 6)
        mapping = Mounted('biped2d', 'position', action_offset=[0.1] * 6, action_scale=reach).map
        np.testing.assert_allclose(mapping.control(np.ones(6)), 0.1 + reach)
        for options in (
            {'action_offset': [0.0]}, {'action_offset': [np.nan] * 6}, {'action_scale': 0}, {'action_scale': -1},
        ):  # fmt: skip
            with self.assertRaisesRegex(ValueError, 'action_offset|action_scale'):
                Mounted('biped2d', 'position', **options)

    def test_original_map_spans_four_times_the_range_of_the_file(self):
        task_kwargs = {'action_offset': 'original'}
        mapping = suite.build('biped2d', task_kwargs=task_kwargs).action_map
        knee = mapping.names.index('right_knee')
        self.assertAlmostEqual(mapping.action_offset[knee], -1.57)
        self.assertAlmostEqual(mapping.action_scale[knee], 6.28)
        mapping = suite.build('dog', task_kwargs=task_kwargs).action_map
        figures = dict(
            zip(
                mapping.names,
                zip(mapping.action_offset, mapping.action_scale, strict=True),
                strict=True,
            )
        )
        np.testing.assert_allclose(figures['tail0'], (0, 4 * np.pi))  # without limits
        np.testing.assert_allclose(figures['elbow'], (1.57, 6.28))
        # Limits of the file, [-1.57, 1.57], not the effective ones, [-0.96, 2.18].
        np.testing.assert_allclose(figures['hip'], (0, 6.28), atol=1e-9)
        np.testing.assert_allclose(figures['spine0'], (0, 6.28), atol=1e-9)

    def test_invalid_arguments_are_rejected(self):
        with self.assertRaisesRegex(ValueError, "unknown actuation 'postion'.*'position'"):
            actuation.add(characters.make('dog'), 'postion', TIMESTEP)
        spec = dataclasses.replace(
            characters.CHARACTERS['biped2d'],
            name='mine',
            xml=(resources.directory('xml') / 'biped2d.xml').read_text(),
        )
        with self.assertRaisesRegex(ValueError, "'mine' has no muscles.*biped2d.*dog.*raptor"):
            actuation.add(characters.make(spec), 'muscle', TIMESTEP)
        character = characters.make(spec)
        for model, options, message in (
            ('position', {'action_scal': 0.5}, "unknown option of position control 'action_scal'; did you mean"),
            ('torque', {'action_scale': 0.5}, "unknown option of torque control 'action_scale'"),
            ('position', {'action_scale': -1}, 'action_scale is -1.*; expected positive numbers'),
            ('position', {'action_offset': 0.0}, r'action_offset has shape \(\).*; expected \(6,\)'),
        ):  # fmt: skip
            with self.assertRaisesRegex(ValueError, message):
                actuation.add(character, model, TIMESTEP, **options)
        self.assertLen(
            actuation.add(character, 'position', TIMESTEP), 6
        )  # nothing was added before

    def test_a_slide_without_limits_needs_a_range(self):
        character = characters.make('hopper')
        leg = character.joints[1]
        del leg.range
        leg.limited = False
        with self.assertRaisesRegex(
            ValueError, "action_scale of 'hopper': inf at .*; expected finite"
        ):
            actuation.add(character, 'position', TIMESTEP)


class ServoTest(parameterized.TestCase):
    """Forces of the compiled actuators against their formulas."""

    @parameterized.parameters(*JOINTS)
    def test_position_law(self, name):
        mounted = Mounted(name, 'position')
        data, limits = mounted.data, mounted.character.torque_limits
        kp = np.array([joint.kp for joint in mounted.joints])
        kd = np.array([joint.kd for joint in mounted.joints])
        rng = np.random.default_rng(1)
        angle, rate = rng.uniform(-1, 1, kp.shape), rng.uniform(-1, 1, kp.shape)
        action = rng.uniform(-1, 1, kp.shape)
        data.qpos[mounted.qpos], data.qvel[mounted.dof] = angle, rate
        mounted.act(action)
        mounted.forward()
        passive = -data.qfrc_damper[mounted.dof] / rate
        # A fiftieth of the torque limit acts outside the clamp, the rest of kd inside.
        np.testing.assert_allclose(passive, np.minimum(limits / 50, kd))
        spring = kp * (mounted.map.action_offset + full(name, 'position') * action - angle)
        inside = np.clip(spring - (kd - passive) * rate, -limits, limits)
        np.testing.assert_allclose(mounted.torque, inside, atol=1e-9)

    @parameterized.parameters(*JOINTS)
    def test_velocity_law(self, name):
        mounted = Mounted(name, 'velocity')
        kd = np.array([joint.kd for joint in mounted.joints])
        limits = mounted.character.torque_limits
        rng = np.random.default_rng(1)
        rate, action = rng.uniform(-9, 9, kd.shape), rng.uniform(-1, 1, kd.shape)
        mounted.data.qvel[mounted.dof] = rate
        mounted.act(action)
        mounted.forward()
        force = np.clip(kd * (full(name, 'velocity') * action - rate), -limits, limits)
        np.testing.assert_allclose(mounted.torque, force, atol=1e-9)
        np.testing.assert_array_equal(mounted.data.qfrc_damper, 0)  # the whole kd is in the servo

    @parameterized.parameters(*JOINTS)
    def test_torque_law(self, name):
        mounted = Mounted(name, 'torque')
        action = np.random.default_rng(1).uniform(-1, 1, JOINTS[name])
        mounted.act(action)
        mounted.forward()
        limits = mounted.character.torque_limits
        np.testing.assert_allclose(mounted.torque, full(name, 'torque') * limits * action)

    @parameterized.parameters(*JOINTS)
    def test_position_control_reaches_its_target(self, name):
        mounted = Mounted(name, 'position')
        low, high = mounted.character.joint_ranges.T
        target = np.clip(np.random.default_rng(2).uniform(-0.5, 0.5, low.shape), low + 0.1,
                         high - 0.1)  # fmt: skip
        mounted.act(mounted.map.action(target))
        mounted.step(20)
        np.testing.assert_allclose(mounted.data.qpos[mounted.qpos], target, atol=1e-4)

    @parameterized.parameters(
        *(pair for pair in PAIRS if pair[0] in ('biped2d', 'dog', 'biped2d_simbicon', 'hopper'))
    )
    def test_joint_limits_hold(self, name, model):
        for direction in (-1, 1):
            mounted = Mounted(name, model)
            action = np.full(len(mounted.map), float(direction))
            if model == 'muscle':
                action *= np.random.default_rng(0).choice((-1.0, 1.0), len(mounted.map))
            mounted.act(action)
            low, high = mounted.character.joint_ranges.T
            for i in range(900):
                mounted.step(TIMESTEP)
                angle = mounted.data.qpos[mounted.qpos]
                beyond = np.maximum(low - angle, angle - high).max()
                # An impact at tens of rad/s goes deeper than what full effort holds. The hopper's
                # hip has several times the torque of any other joint.
                held = 0.06 if name == 'hopper' else 0.05
                self.assertLess(beyond, 0.3 if i < 600 else held)


class TorqueLimitTest(parameterized.TestCase):
    """No actuation model exceeds the torque limit of a joint."""

    @parameterized.parameters(*PAIRS)
    def test_limits_hold_under_extreme_actions(self, name, model):
        mounted = Mounted(name, model, free=True)
        data, mapping, dof = mounted.data, mounted.map, mounted.dof
        height = characters.body_figures(mounted.character)['standing_height']
        data.joint(f'{name}/root_z/').qpos[0] = height + 0.001
        limits = mounted.character.torque_limits
        rng = np.random.default_rng(4)
        highest = np.zeros(len(limits))
        for _ in range(6):
            data.qvel[dof] += rng.uniform(-30, 30, len(dof))
            for _ in range(10):
                data.ctrl[:] = mapping.control(rng.choice((-1.0, 1.0), len(mapping)))
                for _ in range(10):
                    mujoco.mj_step(mounted.model, data)
                    np.maximum(highest, np.abs(data.qfrc_actuator[dof]), out=highest)
        np.testing.assert_array_less(highest, limits * (1 + 1e-9))
        np.testing.assert_array_equal(data.warning.number[:7], 0)
        # The limits are reached, so the test is effective.
        share = highest / limits
        if model == 'torque':
            np.testing.assert_allclose(share.max(), full(name, model).max())
            np.testing.assert_array_less(share, full(name, model) + 1e-9)
        else:
            self.assertGreater(share.max(), 0.99)
