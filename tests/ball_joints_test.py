"""Actions and servos of characters with ball joints, against the original's values."""

import dataclasses

import mujoco
import numpy as np
from absl.testing import absltest, parameterized
from characters_test import SPATIAL
from dm_control import mjcf
from helpers import assert_refused, users_arena

from trl_suite import actuation, characters
from trl_suite.motion import quaternion

TIMESTEP = 1 / 300  # s
MODELS = ('torque', 'velocity', 'position')


def to_mujoco(vector):
    """The source's x forward, y up, z right as MuJoCo's x forward, y left, z up."""
    x, y, z = vector
    return np.array([x, -z, y])


class Body:
    """A character without gravity and contacts, that can move freely, or hangs from its root."""

    def __init__(self, name, model, root=True, contact='disable', **options):
        arena = users_arena(TIMESTEP)
        arena.mjcf_model.option.integrator = 'implicitfast'
        if contact == 'disable':
            arena.mjcf_model.option.gravity = 0, 0, 0
            arena.mjcf_model.option.flag.contact = contact
        self.character = characters.make(name)
        frame = arena.attach(self.character)
        if root:
            self.character.create_root_joints(frame)
        self.map = actuation.add(self.character, model, TIMESTEP, **options)
        self._physics = mjcf.Physics.from_mjcf_model(arena.mjcf_model)
        self.model, self.data = self._physics.model.ptr, self._physics.data.ptr
        ids = [self.model.joint(joint.full_identifier).id for joint in self.character.joints]
        # First numbers of each joint; three in qvel and four in qpos if it is a ball.
        self.qpos, self.sizes = self.model.jnt_qposadr[ids], self.character.dofs
        self.dofs = together(self.model.jnt_dofadr[ids], self.sizes)
        actuators = [self.model.actuator(f'{name}/{each}').id for each in self.map.actuators]
        first, count = self.model.actuator_ctrladr, self.model.actuator_ctrlnum
        self.controls = together(first[actuators], count[actuators])
        self.kp, self.kd = np.transpose([(j.kp, j.kd) for j in self.character.spec.joints.values()])
        self.limits, self.ranges = self.character.torque_limits, self.character.joint_ranges

    def act(self, action):
        self.data.ctrl[self.controls] = self.map.control(np.asarray(action, float))

    def forward(self):
        mujoco.mj_forward(self.model, self.data)

    def step(self, seconds=TIMESTEP):
        mujoco.mj_step(self.model, self.data, round(seconds / TIMESTEP))

    def pose(self, targets):
        """Puts the joints at rotation vectors and angles, (D,)."""
        for adr, part in zip(self.qpos, self.split(targets), strict=True):
            turn = quaternion.from_vector(part) if len(part) == 3 else part
            self.data.qpos[adr : adr + len(turn)] = turn

    def split(self, values):
        """Cuts numbers of all degrees of freedom, (D,), into those of each joint."""
        return np.split(values, np.cumsum(self.sizes)[:-1])

    def draw(self, rng, share=1.0):
        """Rotation vectors and angles, (D,), within a share of the joint limits."""
        parts = []
        for (low, high), size in zip(self.ranges, self.sizes, strict=True):
            if size == 3:
                way = rng.normal(size=3)
                parts.append(share * high * rng.uniform() ** (1 / 3) * way / np.linalg.norm(way))
            else:
                parts.append([0.5 * (low + high + share * (high - low) * rng.uniform(-1, 1))])
        return np.concatenate(parts)

    def errors(self, targets):
        """Torque-free errors in the links' axes of where joints are, one array for each."""
        found = []
        for adr, part in zip(self.qpos, self.split(targets), strict=True):
            if len(part) == 1:
                found.append(part - self.data.qpos[adr])
            else:
                back = quaternion.conjugate(self.data.qpos[adr : adr + 4])
                turn = quaternion.multiply(back, quaternion.from_vector(part))
                found.append(quaternion.rotation_vector(turn))
        return found

    @property
    def norms(self):
        """Norm of the actuators' torque on each joint, N m, shape (J,)."""
        return norms(self.split(self.data.qfrc_actuator[self.dofs]))

    @property
    def speed(self):
        """Largest joint speed, rad/s."""
        return np.abs(self.data.qvel[self.dofs]).max()


_made = {}  # bodies, by their arguments


def made(*arguments, **options):
    """A body at rest in its first pose, as if new."""
    key = repr((arguments, sorted(options.items())))
    if key not in _made:
        _made[key] = Body(*arguments, **options)
    mujoco.mj_resetData(_made[key].model, _made[key].data)
    return _made[key]


def tearDownModule():
    _made.clear()


def together(first, count):
    """Numbers of all parts that begin at some number and have some size."""
    return np.concatenate([np.arange(*each) for each in zip(first, first + count, strict=True)])


def norms(parts):
    return np.array([np.linalg.norm(part) for part in parts])


class ActionMapTest(parameterized.TestCase):
    """The map from actions to controls."""

    @parameterized.product(name=SPATIAL, model=MODELS)
    def test_three_actions_for_every_ball_joint(self, name, model):
        body = made(name, model)
        mapping, spec = body.map, body.character.spec
        expected = [
            each
            for joint, size in zip(spec.joints, body.sizes, strict=True)
            for each in ([f'{joint}_{axis}' for axis in 'xyz'] if size == 3 else [joint])
        ]
        self.assertEqual(mapping.names, tuple(expected))
        actuators = tuple(spec.joints) if model == 'position' else mapping.names
        self.assertEqual(mapping.actuators, actuators)
        self.assertEqual((mapping.quantity, mapping.unit), {
            'torque': ('torque', 'N m'), 'velocity': ('target velocity', 'rad/s'),
            'position': ('target rotation vector', 'rad'),
        }[model])  # fmt: skip
        rigid = np.repeat(body.ranges[:, 1] < 0.1, body.sizes)
        rigid &= np.repeat(body.ranges[:, 0] > -0.1, body.sizes)
        reach = {
            'torque': 0.75 * np.repeat(body.limits, body.sizes),
            'velocity': 10 * np.pi,
            'position': np.where(rigid, 0.04, 1.5),
        }[model]
        np.testing.assert_allclose(mapping.action_scale, reach)
        self.assertFalse(mapping.action_offset.any())
        small = 0.5 * np.random.default_rng(0).uniform(-1, 1, (5, len(mapping)))
        control = mapping.control(small)
        np.testing.assert_allclose(control, mapping.action_scale * small)
        np.testing.assert_allclose(mapping.action(control), small, atol=1e-12)
        for action, row in zip(small, control, strict=True):  # equal alone and in a batch
            np.testing.assert_array_equal(mapping.control(action), row)
        far = mapping.control(np.full(len(mapping), 9.0))
        np.testing.assert_array_equal(far, mapping.control(np.ones(len(mapping))))

    def test_action_offset_and_action_scale(self):
        rng = np.random.default_rng(0)
        offset, reach = rng.uniform(-0.2, 0.2, 17), rng.uniform(0.5, 1, 17)
        mapping = made('biped3d', 'position', action_offset=offset, action_scale=reach).map
        np.testing.assert_allclose(mapping.control(-np.ones(17)), offset - reach)
        mapping = made('biped3d', 'position', action_scale=1.0).map
        np.testing.assert_array_equal(mapping.action_scale, 1.0)

    def test_targets_that_are_refused(self):
        spec = characters.CHARACTERS['biped3d']
        for target, message in (
            (1.0, "target of 'torso' is 1.0; expected a rotation vector, or 0"),
            ((0.0, 9.0, 0.0), "target of 'torso' is 9; expected 0 to 1, its limits"),
        ):
            own = dataclasses.replace(spec.joints['torso'], target=target)
            with self.assertRaisesRegex(ValueError, message):
                characters.make(dataclasses.replace(spec, joints={**spec.joints, 'torso': own}))
        with self.assertRaisesRegex(
            ValueError, 'original_range of a joint is 1.0; expected two limits'
        ):
            characters.Joint(1, 1, 1, original_range=1.0)

    def test_working_posture_of_a_ball_joint(self):
        spec = characters.CHARACTERS['biped3d']
        joints = dict(spec.joints)
        joints['torso'] = dataclasses.replace(joints['torso'], target=(0.1, -0.2, 0.3))
        joints['left_knee'] = dataclasses.replace(joints['left_knee'], target=-0.5)
        character = characters.make(dataclasses.replace(spec, joints=joints))
        mapping = actuation.add(character, 'position', TIMESTEP)
        offset = dict(zip(mapping.names, mapping.action_offset, strict=True))
        self.assertEqual([offset[f'torso_{axis}'] for axis in 'xyz'], [0.1, -0.2, 0.3])
        self.assertEqual((offset['left_knee'], offset['left_hip_x']), (-0.5, 0))

    @parameterized.parameters(*SPATIAL)
    def test_torques_are_clamped_by_their_norm(self, name):
        body = made(name, 'torque')
        clamped, rng = 0, np.random.default_rng(1)
        for action in rng.uniform(-1, 1, (50, len(body.map))):
            found = body.split(body.map.control(action))
            wanted = body.split(body.map.action_scale * action)
            for torque, affine, limit in zip(found, wanted, body.limits, strict=True):
                norm = np.linalg.norm(affine)
                np.testing.assert_allclose(torque, affine * min(1, limit / norm))
                clamped += norm > limit
        self.assertGreater(clamped, 5)
        # They are in the axes of the link.
        body.pose(body.draw(rng, 0.9))
        action *= 0.5
        body.act(action)
        body.forward()
        np.testing.assert_allclose(
            body.data.qfrc_actuator[body.dofs], body.map.control(action), atol=1e-12
        )

    def test_refused(self):
        turned = {'rotations': 'angle_axis'}
        assert_refused(self, *((lambda o=o: made('biped3d', 'position', **o), message) for o, message in (
            ({'action_offset': np.zeros(7)}, 'action_offset'), ({'action_scale': [1.0] * 7}, 'action_scale'),
            ({'action_scale': 0}, 'action_scale'), ({'rotations': 'axis'}, "of rotations 'axis'"),
            ({'action_scale': 1.0, **turned}, 'do not pass action_offset'),
            ({'action_offset': np.zeros(22), **turned}, 'do not pass action_offset'),
        )))  # fmt: skip
        with self.assertRaisesRegex(ValueError, "'biped3d' has no muscles; these have"):
            made('biped3d', 'muscle')


class AngleAxisTest(parameterized.TestCase):
    """The original's form of position actions: angle and axis."""

    def make(self, name):
        return made(name, 'position', rotations='angle_axis')

    @parameterized.parameters(*SPATIAL)
    def test_sizes_and_inverse(self, name):
        body = self.make(name)
        size = (body.sizes + (body.sizes == 3)).sum()
        self.assertEqual((len(body.map), len(set(body.map.names))), (size, size))
        self.assertEqual(body.map.actuators, tuple(body.character.spec.joints))
        self.assertEqual(body.map.control(np.zeros((2, 3, size))).shape, (2, 3, body.model.nu))
        rng = np.random.default_rng(6)
        target = np.array([body.draw(rng) for _ in range(20)])
        target[0] = 0
        action = body.map.action(target)
        self.assertLessEqual(np.abs(action).max(), 1)
        np.testing.assert_allclose(body.map.control(action), target, atol=1e-12)
        np.testing.assert_allclose(body.map.action(target[1]), action[1])

    @parameterized.parameters(
        # First index, kind, value at action 0 and change per unit of each part.
        ('biped3d', 0, 'torso_angle', 0, 4),
        ('biped3d', 4, 'right_hip_angle', 0, 10.28),
        ('biped3d', 8, 'right_knee', -1.57, 6.28),
        ('biped3d', 9, 'right_ankle_angle', 0, 6.28),
        ('biped3d_mocap', 12, 'right_ankle_right', 0.2, 1),
        ('biped3d_mocap', 17, 'left_knee', -1.57, 6.28),
        ('biped3d_mocap_run', 5, 'right_hip_forward', 0, 1),
        ('biped3d_full_mocap', 22, 'right_shoulder_angle', 0, 0.04),
        ('biped3d_full_mocap', 44, 'head', 0, 0.04),
        ('biped3d_simbicon', 0, 'right_hip_angle', 0, 4.2),
        ('biped3d_simbicon', 4, 'right_knee', -1.25, 5),
        ('biped3d_simbicon', 5, 'right_ankle_angle', 0, 3.14),
    )
    def test_map_of_the_original(self, name, i, part, zero, per_unit):
        mapping = self.make(name).map
        self.assertEqual(mapping.names[i], part)
        self.assertAlmostEqual(mapping.action_offset[i], zero)
        self.assertAlmostEqual(mapping.action_scale[i], per_unit)

    def test_controls_are_rotations_about_normalised_axes(self):
        """Against the definition: theta about a normalised axis, in the source's frame."""
        mapping = self.make('biped3d_mocap').map
        action = np.random.default_rng(5).uniform(-1, 1, (40, 22))
        for given, got in zip(action, mapping.control(action), strict=True):
            parts = []
            for first, reach in ((0, 4), (4, 10.28), (9, 6.28), (13, 10.28), (18, 6.28)):
                axis = given[first + 1 : first + 4] + np.array([0, 0, 0.2])
                parts.append(reach * given[first] * to_mujoco(axis) / np.linalg.norm(axis))
            for place, knee in ((2, 8), (5, 17)):
                parts.insert(place, [-1.57 + 6.28 * given[knee]])
            np.testing.assert_allclose(got, np.concatenate(parts))
        # An axis of length zero is the one to the right.
        action = np.zeros((2, 22))
        action[0, :4] = 0.25, 0, 0, -0.2
        control = mapping.control(action)
        np.testing.assert_allclose(control[:, :3], ((0, -1, 0), (0, 0, 0)))
        # Limits of joints may not be symmetric; without ball joints the map is affine.
        hip, _, ankle = actuation.original_ranges(characters.make('biped3d_simbicon'))[:3]
        np.testing.assert_allclose((hip, ankle), ((-0.7, 1.4), (-1, 0.57)))
        hopper = characters.make('hopper')
        mapping = actuation.add(hopper, 'position', TIMESTEP, rotations='angle_axis')
        np.testing.assert_allclose(mapping.control(np.ones(2)), (6.28, 0.2))

    def test_same_target_by_both_forms(self):
        """A turn of more than half a revolution is the same orientation as the shorter one."""
        by_axis, by_vector = self.make('biped3d'), made('biped3d', 'position')
        action = np.zeros(22)
        action[4:8] = 0.9, 0.3, -0.5, 0.2  # 9.25 rad
        by_axis.act(action)
        turn = quaternion.rotation_vector(quaternion.from_vector(by_axis.data.ctrl[3:6]))
        self.assertLess(np.linalg.norm(turn), np.pi)
        by_vector.data.ctrl[3:6] = turn
        for body in (by_axis, by_vector):
            body.forward()
        torques = (body.data.qfrc_actuator[body.dofs][3:6] for body in (by_axis, by_vector))
        np.testing.assert_allclose(*torques, atol=1e-9)


class ServoTest(parameterized.TestCase):
    """Forces of the compiled actuators."""

    @parameterized.parameters(*SPATIAL)
    def test_position_law(self, name):
        body, rng = made(name, 'position'), np.random.default_rng(7)
        pose, target = (body.draw(rng, 0.9) for _ in range(2))
        rate = rng.uniform(-2, 2, len(target))
        body.pose(pose)
        body.data.qvel[body.dofs] = rate
        body.data.ctrl[body.controls] = target
        body.forward()
        # A fiftieth of the torque limit acts outside the clamp, the rest of kd inside.
        damping = np.repeat(body.limits / 50, body.sizes)
        np.testing.assert_allclose(-body.data.qfrc_damper[body.dofs] / rate, damping)
        torques, rates, clamped = body.data.qfrc_actuator[body.dofs], body.split(rate), 0
        gains = zip(body.limits, body.kp, body.kd, body.errors(target), rates, strict=True)
        for torque, (limit, kp, kd, error, speed) in zip(body.split(torques), gains, strict=True):
            inside = kp * error - (kd - limit / 50) * speed
            norm = np.linalg.norm(inside)
            np.testing.assert_allclose(torque, inside * min(1, limit / norm), atol=1e-9)
            clamped += norm > limit
        self.assertGreater(clamped, 0)

    @parameterized.parameters(*SPATIAL)
    def test_velocity_law(self, name):
        body, rng = made(name, 'velocity'), np.random.default_rng(8)
        rate, target = rng.uniform(-9, 9, (2, len(body.map)))
        body.pose(body.draw(rng, 0.9))
        body.data.qvel[body.dofs] = rate
        body.act(body.map.action(target))
        body.forward()
        kd, limit = np.repeat(body.kd, body.sizes), np.repeat(body.limits, body.sizes)
        damping = limit / 50
        np.testing.assert_allclose(-body.data.qfrc_damper[body.dofs] / rate, damping)
        # Each axis of a ball joint has its own clamp: the norm then stays within the limit.
        clamp = np.where(np.repeat(body.sizes, body.sizes) == 3, limit / np.sqrt(3), limit)
        torque, free = body.data.qfrc_actuator[body.dofs], kd * target - (kd - damping) * rate
        self.assertTrue((np.abs(free) < clamp).any())
        np.testing.assert_allclose(torque, np.clip(free, -clamp, clamp), atol=1e-9)
        # They do not make thin limbs oscillate.
        for _ in range(60):
            body.act(rng.uniform(-1, 1, len(body.map)))
            body.step(1 / 30)
        body.act(np.zeros(len(body.map)))
        body.step(1)
        self.assertLess(body.speed, 1)

    @parameterized.product(name=SPATIAL, model=MODELS)
    def test_armature(self, name, model):
        body = made(name, model)
        least = (body.kd - body.limits / 50) * TIMESTEP / 2 * (model == 'velocity')
        own = [0.03 if (name, j) in THICK else 0.01 for j in body.character.spec.joints]
        expected = np.repeat(np.maximum(own, least), body.sizes)
        np.testing.assert_allclose(body.model.dof_armature[body.dofs], expected)

    @parameterized.product(name=SPATIAL, rotations=actuation.ROTATIONS)
    def test_actions_reach_their_targets(self, name, rotations):
        body = made(name, 'position', root=False, rotations=rotations)
        target = body.draw(np.random.default_rng(11), 0.8)
        if rotations == 'vector':  # which reach 1.5 rad about every axis by default
            target = np.clip(target, -body.map.action_scale, body.map.action_scale)
        body.act(body.map.action(target))
        body.step(3)
        np.testing.assert_allclose(np.concatenate(body.errors(target)), 0, atol=1e-3)

    @parameterized.parameters(*SPATIAL)
    def test_random_targets(self, name):
        """Two seconds of new targets at every control step, then one second of the last."""
        body, rng = made(name, 'position'), np.random.default_rng(0)
        fastest, strongest = 0.0, np.zeros(len(body.sizes))
        for _ in range(60):
            body.data.ctrl[body.controls] = body.draw(rng, 0.95)
            for _ in range(10):
                body.step()
                fastest = max(fastest, body.speed)
                strongest = np.maximum(strongest, body.norms)
        body.step(1)
        self.assertLess(body.speed, 1)
        self.assertBetween(fastest, 15, 40)
        self.assertLessEqual((strongest / body.limits).max(), 1 + 1e-9)
        self.assertFalse(body.data.warning.number.any())

    @parameterized.product(name=SPATIAL, model=MODELS)
    def test_torque_limits_hold_under_extreme_actions(self, name, model):
        body = made(name, model, contact='enable')
        body.data.qpos[2] = 0.9
        rng, highest = np.random.default_rng(4), np.zeros(len(body.sizes))
        for _ in range(6):
            body.data.qvel[6:] += rng.uniform(-20, 20, body.model.nv - 6)
            for _ in range(10):
                body.act(rng.choice((-1.0, 1.0), len(body.map)))
                for _ in range(10):
                    body.step()
                    highest = np.maximum(highest, body.norms)
        np.testing.assert_array_less(highest, body.limits * (1 + 1e-9))
        self.assertGreater((highest / body.limits).max(), 0.99)  # the limits are reached
        self.assertFalse(body.data.warning.number.any())

    @parameterized.parameters(*SPATIAL)
    def test_joint_limits_hold(self, name):
        body, rng = made(name, 'position', root=False), np.random.default_rng(12)
        for _ in range(4):
            body.act(rng.choice((-1.0, 1.0), len(body.map)))
            body.step(1)
            zero = norms(body.errors(np.zeros(len(body.dofs))))
            single = body.sizes == 1
            angle = np.where(single, body.data.qpos[body.qpos], zero)
            self.assertTrue((angle < body.ranges[:, 1] + 0.05).all())
            self.assertTrue((angle > body.ranges[:, 0] - 0.05).all())


THICK = {('biped3d_mocap_run', f'{side}_ankle') for side in ('right', 'left')}  # armature

if __name__ == '__main__':
    absltest.main()
