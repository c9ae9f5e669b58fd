"""Tests of muscles: the tables, the Hill formulas, and MuJoCo's muscles held against them."""

import functools
import math

import mujoco
import numpy as np
from absl.testing import parameterized
from dm_control import composer, mjcf

from trl_suite import actuation, characters, suite
from trl_suite.actuation import muscles

TIMESTEP = 1 / 300  # s
ISOMETRIC_ERROR = 0.05  # peak forces; largest error of the active force-length curve
# MuJoCo's force-velocity curve is flatter than Geyer and Herr's near rest: 1.15 against 1.34 peak
# forces at 0.5 optimal lengths per second.
VELOCITY_ERROR = 0.19

# muscle: optimal length m, slack length m, peak force N, pennation,
#   then per joint: arm m, angle of the largest arm (None: constant), rest angle, rad.
BIPED_LEG = {
    'GLU': (0.103, 0.122, 1500, 0.5, {'hip': (-0.094, None, 0.5216)}),
    'HFL': (0.103, 0.094, 2000, 0.5, {'hip': (0.094, None, 0)}),
    'VAS': (0.075, 0.215, 6000, 0.7, {'knee': (0.056, -0.2616, -0.9616)}),
    'SOL': (0.037, 0.243, 4000, 0.5, {'ankle': (-0.047, -0.3492, 0.1708)}),
    'TA': (0.056, 0.225, 800, 0.7, {'ankle': (0.037, 0.1708, -0.3492)}),
    'HAM': (0.094, 0.29, 3000, 0.7, {'hip': (-0.075, None, 0.4316), 'knee': (-0.047, 0, 0)}),
    'RF': (
        0.075, 0.281, 1000, 0.7, {'hip': (0.094, None, 0), 'knee': (0.056, -0.2616, -0.9616)},
    ),
    'GAS': (
        0.047, 0.374, 1500, 0.7,
        {'knee': (-0.047, -0.7016, -0.2616), 'ankle': (-0.047, -0.3492, 0.1708)},
    ),
}  # fmt: skip
BIPED = {
    f'{side}_{name}': (*row[:4], {f'{side}_{joint}': arm for joint, arm in row[4].items()})
    for side in ('right', 'left')
    for name, row in BIPED_LEG.items()
}
SAMPLES = {
    'biped2d': BIPED,
    'dog': {
        'spine0_top': (0.04, 0.03, 3000, 0.7, {'spine0': (0.03, 0.1, 0)}),
        'neck0_bot': (0.05, 0.04, 2000, 0.7, {'neck0': (-0.03, 0.58507, 0.68507)}),
        'tail0_top': (0.02, 0.06, 250, 0.7, {'tail0': (-0.03, -0.1, 0)}),
        'front_SUP': (0.08, 0.02, 3000, 0.5, {'shoulder': (0.035, None, -0.7)}),
        'front_BCP': (
            0.1, 0.25, 3000, 0.7, {'shoulder': (0.06, None, -0.75), 'elbow': (0.04, 1.3, 0.9)},
        ),
        'front_TCP': (
            0.1, 0.275, 2000, 0.7,
            {'shoulder': (-0.074, None, 0.7), 'elbow': (-0.056, 0.2616, 0.9616)},
        ),
        'back_HAM': (
            0.1, 0.04, 3000, 0.7, {'hip': (-0.05, None, 1), 'knee': (-0.06, -1.5616, -1.3616)},
        ),
        'back_GAS': (
            0.04, 0.2, 1500, 0.7,
            {'knee': (-0.047, -0.7016, -0.2616), 'ankle': (-0.047, -0.1492, 0.3708)},
        ),
        'back_toe1': (0.05, 0.15, 1000, 0.7, {'toe': (0.037, 0.0708, -0.4492)}),
    },
    'raptor': {
        'spine0_top': (0.085, 0.1, 2500, 0.7, {'spine0': (0.05, 0.21682, 0.16682)}),
        'head_bot': (0.03, 0.02, 1000, 0.7, {'head': (-0.05, 0.55355, 0.75355)}),
        'tail1_bot': (0.05, 0.0941, 2000, 0.7, {'tail1': (0.04, 0, -0.1)}),
        'right_HFL': (0.103, 0.094, 3000, 0.5, {'right_hip': (0.07, None, -0.25)}),
        'left_HAM': (
            0.1, 0.05, 3000, 0.7,
            {'left_hip': (-0.08, None, 0.5), 'left_knee': (-0.095, -1.3, -0.9)},
        ),
        'left_toe0': (0.05, 0.1, 1000, 0.7, {'left_toe': (-0.037, -0.4492, 0.0708)}),
    },
}  # fmt: skip
CASES = tuple((name, muscle) for name, table in SAMPLES.items() for muscle in table)
SETS = (  # a muscle of each set that was optimised for a motion
    (
        'raptor', 'run', 'right_VAS', 0.136791, 0.211811, 5692.86906,
        {'right_knee': (0.046858, -0.871852, -1.19406)},
    ),
    (
        'biped2d', 'walk', 'left_SOL', 0.071519, 0.245616, 4115.28,
        {'left_ankle': (-0.055327, -0.249141, 0.155117)},
    ),
    ('biped2d', 'run', 'right_GLU', 0.14532, 0.127926, 2157.21, {'right_hip': (-0.06043, None, 1.73281)}),
    ('dog', 'bound', 'torso_bot', 0.04458, 0.046537, 3283.75, {'torso': (-0.077986, -0.05925, 0.268007)}),
    ('dog', 'bound', 'back_toe1', 0.05, 0.15, 1000, {'toe': (0.037, 0.0708, -0.4492)}),
)  # fmt: skip


def arm_at_rest(arm, peak, rest):
    return arm if peak is None else arm * math.cos(rest - peak)


# The formulas of Geyer and Herr, which the original integrates; lengths are in optimal fibre lengths.

WIDTH = 0.56  # half width of the active force-length curve, optimal lengths
RESIDUE = 0.05  # active force at the end of that width
V_MAX = 10.0  # largest shortening speed, optimal lengths per second
CURVATURE = 5.0  # of the shortening branch
ECCENTRIC = 1.5  # plateau of the lengthening branch, peak forces


def force_length(length):
    """Active force-length factor of the contractile element."""
    return np.exp(np.log(RESIDUE) * np.abs((np.asarray(length) - 1) / WIDTH) ** 3)


def parallel_force(length):
    """Passive force of the parallel spring, in peak forces."""
    return np.maximum(0, (np.asarray(length) - 1) / WIDTH) ** 2


def fibre_velocity(force_velocity):
    """Fibre velocity in optimal lengths per second, lengthening positive, by the factor of force."""
    f = np.clip(force_velocity, 0, ECCENTRIC)
    shortening = -V_MAX * (1 - f) / (1 + CURVATURE * f)
    a = (f - ECCENTRIC) / (ECCENTRIC - 1)
    lengthening = -V_MAX * (a + 1) / (7.56 * CURVATURE * a - 1)
    return np.where(f < 1, shortening, lengthening)


@functools.cache
def physics_of(name):
    """A character with muscles, its root welded."""
    arena = composer.Arena()
    option = arena.mjcf_model.option
    option.timestep, option.gravity = TIMESTEP, (0, 0, 0)
    option.flag.contact = 'disable'
    character = characters.make(name)
    arena.attach(character)
    actuation.add(character, 'muscle', TIMESTEP)
    physics = mjcf.Physics.from_mjcf_model(arena.mjcf_model)
    # What the other muscles do must not reach the limits of joints.
    physics.model.ptr.jnt_actfrclimited[:] = 0
    return physics


class Rig:
    """One muscle of a character and the joints under it."""

    def __init__(self, name, muscle):
        physics = physics_of(name)
        mujoco.mj_resetData(physics.model.ptr, physics.data.ptr)
        self.model, self.data = physics.model.ptr, physics.data.ptr
        self.l_opt, _, self.f_max, self.pennation, self.arms = SAMPLES[name][muscle]
        self.prefix = f'{name}/'
        self.muscle = self.data.actuator(self.prefix + muscle)
        self.rest()

    def joint(self, name):
        return self.data.joint(self.prefix + name)

    def rest(self):
        for joint, (_, _, rest) in self.arms.items():
            self.joint(joint).qpos[0] = rest
            self.joint(joint).qvel[0] = 0

    def stretch(self, length=1.0, velocity=0.0):
        """Turns the first joint until the fibre has a length and a velocity, optimal lengths."""
        self.rest()
        joint, arm = next(iter(self.arms.items()))
        per_radian = -self.pennation * arm_at_rest(*arm) / self.l_opt
        self.joint(joint).qpos[0] += (length - 1) / per_radian
        self.joint(joint).qvel[0] = velocity / per_radian

    def force(self, excitation):
        """Pull of the muscle, peak forces."""
        self.muscle.ctrl[0] = excitation
        mujoco.mj_forward(self.model, self.data)
        return -self.muscle.force[0] / self.f_max

    def active(self):
        """Pull at full excitation without what pulls at none, peak forces."""
        return (self.force(1) - self.force(0.01)) / 0.99


class TableTest(parameterized.TestCase):
    """The hand-set muscles of the original's character files."""

    @parameterized.parameters(*CASES)
    def test_parameters_of_a_muscle(self, name, muscle):
        l_opt, l_slack, f_max, pennation, arms = SAMPLES[name][muscle]
        unit = next(unit for unit in muscles.MUSCLES[name]['plain'] if unit.name == muscle)
        self.assertEqual(unit[1:5], (l_opt, l_slack, f_max, pennation))
        self.assertEqual({a.joint: (a.arm, a.peak, a.rest) for a in unit.arms}, arms)

    @parameterized.parameters(*SETS)
    def test_optimised(self, name, chosen, muscle, l_opt, l_slack, f_max, arms):
        sets = muscles.MUSCLES[name]
        unit = next(unit for unit in sets[chosen] if unit.name == muscle)
        np.testing.assert_allclose(unit[1:4], (l_opt, l_slack, f_max), rtol=1e-5)
        self.assertEqual({a.joint: (a.arm, a.peak, a.rest) for a in unit.arms}, arms)
        self.assertEqual([u.name for u in sets[chosen]], [u.name for u in sets['plain']])
        for unit, plain in zip(sets[chosen], sets['plain'], strict=True):
            self.assertEqual([a.joint for a in unit.arms], [a.joint for a in plain.arms])
            self.assertEqual(unit.pennation, plain.pennation)

    def test_sets_are_chosen_by_name(self):
        raptor = characters.make('raptor')
        chosen = actuation.character_muscles(raptor, 'run')
        self.assertEqual(chosen, muscles.MUSCLES['raptor']['run'])
        with self.assertRaisesRegex(ValueError, "muscle set of 'raptor'.*'rum'.*'run'"):
            actuation.character_muscles(raptor, 'rum')
        with self.assertRaisesRegex(ValueError, 'is an option of muscle control, not position'):
            suite.make('PD_Raptor2D_LLC_Imitate_Flat-v0', task_kwargs={'muscle_set': 'run'})
        id_ = 'MTU_Raptor2D_LLC_Imitate_Flat-v0'
        for name, peak in (('plain', 6000), ('run', 5692.86906)):
            with suite.make(id_, task_kwargs={'random': 1, 'muscle_set': name}) as environment:
                model = environment.physics.model
                muscle = model.name2id('raptor/right_VAS', 'actuator')
                self.assertAlmostEqual(model.actuator_gainprm[muscle, 2], peak, delta=0.01)


class HillTest(parameterized.TestCase):
    """The formulas after Geyer and Herr."""

    def test_moment_arms(self):
        constant = muscles.Arm('hip', -0.094, 0.5)
        self.assertEqual(muscles.constant_arm(constant), -0.094)
        for off, share in ((0, 1), (-math.pi / 3, 0.5), (-0.7, math.cos(0.7)), (2.2616, 0)):
            cosine = muscles.Arm('knee', 0.056, -0.2616 + off, -0.2616)  # never turns its sign
            self.assertAlmostEqual(muscles.constant_arm(cosine), 0.056 * share)


class MujocoTest(parameterized.TestCase):
    """The compiled muscles, pulling on real joints."""

    @parameterized.parameters(*CASES)
    def test_forces_and_moment_arms(self, name, muscle):
        rig, lengths = Rig(name, muscle), np.linspace(0.3, 1.8, 31)
        for excitation in (1, 0.01, 0.5):  # activation without a lag
            self.assertAlmostEqual(rig.force(excitation), excitation, delta=1e-9)
        rest = rig.muscle.length[0]
        for joint, arm in rig.arms.items():
            rig.rest()
            rig.joint(joint).qpos[0] += 0.1
            rig.force(1)
            self.assertAlmostEqual(
                (rig.muscle.length[0] - rest) / 0.1, -arm_at_rest(*arm), delta=1e-9, msg=joint
            )
        found = []
        for length in lengths:
            rig.stretch(length)
            found.append(rig.active())
        np.testing.assert_allclose(found, force_length(lengths), atol=ISOMETRIC_ERROR)

    @parameterized.parameters(
        ('biped2d', 'right_GLU', 'right_hip', -0.094 * 1500),  # an extensor of 141 N m
        ('biped2d', 'left_HFL', 'left_hip', 0.094 * 2000),
        ('biped2d', 'right_VAS', 'right_knee', 0.056 * math.cos(0.7) * 6000),
        ('biped2d', 'right_HAM', 'right_hip', -0.075 * 3000),
        ('biped2d', 'right_HAM', 'right_knee', -0.047 * 3000),
        ('biped2d', 'right_TA', 'right_ankle', 0.037 * math.cos(0.52) * 800),
        ('dog', 'front_BCP', 'shoulder', 0.06 * 3000),
        ('raptor', 'tail1_bot', 'tail1', 0.04 * math.cos(0.1) * 2000),
    )  # fmt: skip
    def test_torque(self, name, muscle, joint, torque):
        rig, torques = Rig(name, muscle), []
        for excitation in (1, 0.01):
            rig.force(excitation)
            torques.append(float(rig.joint(joint).qfrc_actuator[0]))
        self.assertAlmostEqual((torques[0] - torques[1]) / 0.99, torque, delta=1e-6)

    def test_passive_force(self):
        rig, lengths = Rig('biped2d', 'right_GLU'), np.linspace(0.3, 1.8, 31)
        found = []
        for length in lengths:
            rig.stretch(length)
            found.append(rig.force(0.01) - 0.01 * rig.active())
        found = np.array(found)
        np.testing.assert_allclose(found[lengths <= 1], 0, atol=1e-9)  # a muscle cannot push
        self.assertTrue((np.diff(found) > -1e-9).all())
        # Cubic, then linear, where the original's is a parabola: softer at both ends.
        error = np.abs(found - parallel_force(lengths))
        self.assertLess(error[lengths <= 1.6].max(), 0.15)
        self.assertLess(error.max(), 0.51)

    @parameterized.parameters(
        ('biped2d', 'right_GLU'), ('biped2d', 'left_SOL'), ('dog', 'front_TCP'),
        ('raptor', 'head_bot'),
    )  # fmt: skip
    def test_force_velocity(self, name, muscle):
        rig, velocities = Rig(name, muscle), np.linspace(-10, 10, 41)
        found = []
        for velocity in velocities:
            rig.stretch(1.0, velocity)
            found.append(rig.active())
        # `fibre_velocity` is the inverse relation.
        factor = np.linspace(0, 1.5, 100001)
        expected = np.interp(velocities, fibre_velocity(factor), factor)
        found = np.array(found)
        np.testing.assert_allclose(found, expected, atol=VELOCITY_ERROR)
        self.assertTrue((np.diff(found) > -1e-9).all())
        np.testing.assert_allclose(found[[0, 20, 40]], (0, 1, 1.5), atol=1e-9)


class StrainTest(parameterized.TestCase):
    """What an environment observes of its muscles."""

    @parameterized.parameters(
        ('MTU_Biped2D_LLC_Imitate_Flat-v0', 'biped2d'), ('MTU_Dog2D_LLC_Imitate_Flat-v0', 'dog'),
        ('MTU_Raptor2D_LLC_Imitate_Flat-v0', 'raptor'),
    )  # fmt: skip
    def test_strain_by_the_length_law(self, id_, name):
        environment = suite.make(id_, {'random': 5})
        environment.reset()
        rng = np.random.default_rng(5)
        for _ in range(6):
            action = rng.uniform(-1, 1, len(environment.action_map))
            strain = environment.step(action).observation['strain']
            angle = environment.physics.named.data.qpos
            for i, muscle in enumerate(environment.action_map.names):
                if muscle not in SAMPLES[name]:
                    continue
                l_opt, _, _, pennation, arms = SAMPLES[name][muscle]
                change = sum(
                    arm_at_rest(*arm) * (angle[f'{name}/{joint}'][0] - arm[2])
                    for joint, arm in arms.items()
                )
                self.assertAlmostEqual(strain[i], -pennation * change / l_opt, delta=1e-9)

    def test_muscles_are_in_the_order_of_the_action(self):
        environment = suite.make('MTU_Biped2D_LLC_Imitate_Flat-v0', {'random': 0})
        names = environment.action_map.names
        self.assertEqual(names, tuple(BIPED))
        environment.reset()
        action = np.full(16, -1.0)
        action[names.index('left_SOL')] = 1.0
        environment.step(action)
        force = environment.physics.named.data.actuator_force
        ctrl = environment.physics.named.data.ctrl
        self.assertEqual(ctrl['biped2d/left_SOL'], 1.0)
        self.assertAlmostEqual(ctrl['biped2d/right_SOL'], 0.01)
        self.assertLess(force['biped2d/left_SOL'], 10 * force['biped2d/right_SOL'])
