"""Tests of the gait state machines: parameters, dynamics, laws and transitions, recomputed."""

import functools

import mujoco
import numpy as np
from absl.testing import parameterized
from dm_control import mjcf
from helpers import assert_refused, users_arena

from trl_suite import actuation, characters, controllers, suite
from trl_suite.controllers import dynamics, gaits, parameters
from trl_suite.engine import PhysicsWorld
from trl_suite.util.compiled import packed
from trl_suite.vector import VectorEnvironment

DT = 1 / 600
NAMES = ('dog', 'goat', 'raptor', 'biped2d_simbicon', 'hopper')
STRIDERS = ('raptor', 'biped2d_simbicon')
# Of base action 0, and the largest deviation of any base action from it, for the raptor from base
# action 1, by name.
FIGURES = {
    'dog': {
        'TransTime': (0.125, 0), 'Cv': (0.014184, 0.034553), 'BackForceX': (378.334188, 432.678275),
        'BackStance.SpineCurve': (-0.112436, 0.665593), 'Extend.Hip': (1.330918, 0.174266),
        'Gather.Ankle': (0.930373, 1.546647),
    },
    'goat': {
        'Cv': (0.034247, 0.016135), 'FrontForceY': (444.031403, 267.186149),
        'BackStance.Shoulder': (-3.281075, 2.124269), 'Gather.Ankle': (1.469614, 0.314952),
    },
    'raptor': {
        'TransTime': (0.0825, 0), 'Cd': (2.014739, 0.083013), 'ForceX': (0, 0),
        'Contact.RootPitch': (0.20376, 1.01999), 'Up.SwingAnkle': (0.166636, 0.205606),
    },
    'biped2d_simbicon': {
        'TransTime': (0.0825, 0), 'Cv': (0.251474, 0.06503), 'Passing.RootPitch': (-0.170533, 0),
        'Contact.StanceKnee': (0.273527, 1.395015), 'Up.SwingAnkle': (0.634434, 1.221746),
    },
    'hopper': {
        'MagicGain': (0.840456, 0.162049), 'Descent.Hip': (0.069732, 0.013257),
        'DownStance.Knee': (-0.808767, 0.323382), 'Ascent.Knee': (-0.77768, 0.241009),
    },
}  # fmt: skip
# Of other base actions: number -> by name.
BLENDS = {
    'dog': {1: {'BackForceX': 235.550357, 'Extend.Knee': -3.824514}, 7: {'BackStance.Knee': 2.516441},
            3: {'Cv': 0.048737}, 4: {'Cv': 0.015899}},
    'goat': {1: {'Cv': 0.018112}, 3: {'BackForceX': 863.470108}, 4: {'FrontForceY': 653.781456}},
    'raptor': {1: {'Cv': 0.151344, 'Down.StanceKnee': 2.123645}, 7: {'Contact.RootPitch': 1.212785}},
    'biped2d_simbicon': {1: {'Contact.StanceHip': -1.051302}, 7: {'Up.SwingAnkle': 1.85618}},
    'hopper': {1: {'MagicGain': 0.8202}, 5: {'Ascent.Hip': 0.789777}, 7: {'Ascent.Knee': -0.536671}},
}  # fmt: skip
ABSOLUTE = {'TransTime', 'Cv', 'Cd', 'MagicGain'}  # parameters whose sign does not count
STATES = {
    **dict.fromkeys(('dog', 'goat'), ('BackStance', 'Extend', 'FrontStance', 'Gather')),
    **dict.fromkeys(STRIDERS, ('Contact', 'Down', 'Passing', 'Up')),
    'hopper': ('Descent', 'DownStance', 'UpStance', 'Ascent'),
}
# The foot: middle of the lower face of its box, from the link's joint.
SOLES = {'toe': (0.03, -0.035), 'finger': (0.03, -0.035)}


_made = {}  # environments, by name and number of simulations


def tearDownModule():
    _made.clear()


class ParametersTest(parameterized.TestCase):
    """Parameter vectors, base actions, and the map from actions to parameters."""

    @parameterized.parameters(*FIGURES)
    def test_base_actions_of_the_original(self, name):
        gait = controllers.load(name, 'original')
        self.assertLen(gait.base_actions, len(gait.blends))
        for parameter, (value, action_scale) in FIGURES[name].items():
            place = gait.place(parameter)
            self.assertAlmostEqual(gait.base_actions[0, place], value, places=6, msg=parameter)
            self.assertAlmostEqual(gait.action_scale[place], action_scale, places=6, msg=parameter)
        for number, values in BLENDS[name].items():
            for parameter, value in values.items():
                found = gait.base_actions[number, gait.place(parameter)]
                self.assertAlmostEqual(found, value, places=6, msg=parameter)
        self.assertTrue((gait.action_scale[gait.actions] > 0).all())
        idle = np.delete(np.arange(len(gait.names)), gait.actions)
        np.testing.assert_array_equal(gait.action_scale[idle], 0)

    @parameterized.product(name=NAMES, base_actions=('default', 'original'))
    def test_actions_reach_base_actions(self, name, base_actions):
        gait = controllers.load(name, base_actions)
        actions = gait.action(gait.base_actions)
        self.assertLessEqual(np.abs(actions).max(), 1 + 1e-12)
        np.testing.assert_allclose(np.abs(actions).max(0), 1, atol=1e-12)  # all are within [-1, 1]
        found = gait.vector(np.clip(actions, -1, 1))
        np.testing.assert_allclose(found, gait.base_actions, atol=1e-9)

    def test_files(self):
        good = {
            'character': 'hopper', 'kind': 'hop', 'legs': [['hip', 'leg']], 'feet': ['leg'],
            'targets': {'Hip': ['hip']}, 'misc': ['Gain'], 'states': ['Up', 'Down'],
            'state_parameters': ['Hip'], 'fixed': ['Gain'], 'absolute': [], 'target_speed': 1.0,
            'sets': {'a': [1, 2, 3], 'b': [2, 4, 6]}, 'base_actions': [['a', 'b', 0], ['a', 'b', 0.5]],
            'action_offset': 'b', 'search_scale': {'Gain': 1, 'Hip': 2}, 'start': {},
        }  # fmt: skip
        gait = parameters.read(good)
        self.assertEqual(gait.names, ('Gain', 'Up.Hip', 'Down.Hip'))
        np.testing.assert_array_equal(gait.base_actions, [[1, 2, 3], [1.5, 3, 4.5]])
        np.testing.assert_array_equal(gait.action_offset, [2, 4, 6])
        np.testing.assert_array_equal(gait.action_scale, [1, 2, 3])
        np.testing.assert_array_equal(gait.search_scale, [1, 2, 2])
        bad = (
            ("'Up.Hip' has no range.*in fixed", {'base_actions': [['b', 'b', 0]]}),
            ("set 'a' needs 3 finite numbers: Gain, Up.Hip", {'sets': {'a': [1, 2]}}),
            ("set 'a' needs 3", {'sets': {'a': [1, 2, float('nan')]}}),
            ("unknown parameter 'Up.Hp'.*'Up.Hip'", {'fixed': ['Up.Hp']}),
            ("unknown parameter 'gain'.*'Gain'", {'absolute': ['gain']}),
            ("unknown kind of gait 'hopp'.*'hop'", {'kind': 'hopp'}),
            ("unknown parameter of a state 'Hp'.*'Hip'", {'targets': {'Hp': ['hip']}}),
            ('same number of joints', {'legs': [['hip'], ['hip', 'leg']], 'feet': ['leg', 'leg']}),
            ('one foot for each', {'feet': []}),
        )
        arena, biped = users_arena(), characters.make('biped2d')
        arena.attach(biped)
        assert_refused(
            self,
            *((lambda c=c: parameters.read({**good, **c}), message) for message, c in bad),
            (lambda: controllers.load('dgo'), "unknown character with a gait 'dgo'.*'dog'"),
            (lambda: controllers.load('dog', 'orginal'), "unknown base_actions 'orginal'.*'original'"),
            (lambda: controllers.Gait(biped, 'world', arena.mjcf_model), "with a gait 'biped2d'"),
        )  # fmt: skip


@functools.lru_cache(1)
def pack(gait):
    """Returns the data of a gait for compiled functions."""
    return packed(gait.data)


def begin(gait):
    """Starts the first cycles of all machines."""
    for i in range(gait.world.n):
        gaits.begin(i, gait.parameters.action_offset, pack(gait))


def apply(gait, vectors):
    """Begins cycles of all machines with parameters (n, P)."""
    gait.state.vector[:] = vectors
    for i in range(gait.world.n):
        gaits.begin_cycle(i, pack(gait))


def torques(gait):
    """Returns the torques of the next control step, (n, J)."""
    for i in range(gait.world.n):
        gaits.act(i, pack(gait))
    return gait.data.scratch.torque.copy()


def advance(gait):
    """Advances all machines; returns whether their cycles have ended."""
    return [gaits.advance(i, pack(gait)) for i in range(gait.world.n)]


class Rig:
    """Characters with gaits, whose states and contacts a test sets."""

    def __init__(self, name, n=1):
        if (name, n) not in _made:
            spec = suite.combine(name, 'gait', 'flat', 'gait')
            _made[name, n] = VectorEnvironment(spec, n, 1, seed=0)
        environments, self.name = _made[name, n], name
        environments.reset()
        task = environments.task
        self.character, self.gait, self.world = task.character, task.gait, task.world
        self.env_ids = self.world.all_ids
        self.joints = list(self.character.spec.joints)
        self.touches(())
        begin(self.gait)

    @property
    def positions(self):
        return self.world.qpos[:, self.gait.data.skeleton.qpos]

    def scatter(self, seed=0, speed=5.0):
        """Random poses in the air, at random speeds."""
        rng = np.random.default_rng(seed)
        low, high = self.character.joint_ranges.T
        low, high = np.maximum(low, -1.0), np.minimum(high, 1.0)
        n = self.world.n
        q = np.concatenate([
            rng.uniform((-3, 2, -0.8), (9, 4, 0.8), (n, 3)), rng.uniform(low, high, (n, len(low)))
        ], axis=1)  # fmt: skip
        self.put(q, speed * rng.uniform(-1, 1, q.shape))
        return rng

    def put(self, q, v):
        self.world.qpos[self.env_ids[:, None], self.gait.data.skeleton.qpos] = q
        self.world.qvel[self.env_ids[:, None], self.gait.data.skeleton.dof] = v
        self.world.forward(self.env_ids)

    def touches(self, links):
        """Overrides contacts until the next step: names of links, or (n, L) bool."""
        on = np.isin(self.character.spec.links, links) if isinstance(links, tuple) else links
        first = self.gait.data.machine.contact
        self.world.sensordata.base[:, first : first + len(self.character.spec.links)] = on

    def data(self, env_id=0):
        """The engine's own view of one simulation, and the columns of its degrees of freedom."""
        model = self.world.models[env_id]
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = self.world.qpos[env_id], self.world.qvel[env_id]
        mujoco.mj_forward(model, data)
        names = [f'{self.name}/root_{axis}/' for axis in ('x', 'z', 'pitch')]
        names += [f'{self.name}/{joint}' for joint in self.joints]
        return model, data, [model.joint(name).dofadr[0] for name in names]

    def set(self, **values):
        """Parameters by name ('Down.Hip' as Down__Hip) for all simulations."""
        for name, value in values.items():
            place = self.gait.parameters.place(name.replace('__', '.'))
            self.gait.state.vector[:, place] = value


def enter(rig):
    """Calls the state entry of the current states of all machines."""
    for env_id in rig.env_ids:
        gaits.enter(env_id, rig.gait.data)


def jacobian(model, data, columns, body, point):
    result = np.zeros((3, model.nv))
    mujoco.mj_jac(model, data, result, None, np.array(point), body)
    return result[np.ix_([0, 2], columns)]


def world_angle(data, body):
    """Turn of a body about -y, rad: of its x axis above the horizontal."""
    matrix = data.xmat[body].reshape(3, 3)
    return np.arctan2(matrix[2, 0], matrix[0, 0])


def sole(model, data, link, name='dog'):
    body = model.body(f'{name}/{link}').id
    x, z = SOLES[link]
    return body, data.xpos[body] + data.xmat[body].reshape(3, 3) @ (x, 0, z)


def dense_pd(rig, env_id, off=()):
    """Stable PD of one simulation, from the formula, with matrices of the engine."""
    model, data, columns = rig.data(env_id)
    joints = rig.character.spec.joints.values()
    full_kp, full_kd = np.transpose([*3 * ((0, 0),), *((joint.kp, joint.kd) for joint in joints)])
    on = np.append([1, 1, 1], ~np.isin(rig.joints, off))
    kp, kd = on * full_kp, on * full_kd  # kd stays in the matrix
    q, v = data.qpos[columns], data.qvel[columns]
    target = np.zeros(len(q))
    target[3:] = rig.gait.state.target[env_id]
    for hip in rig.gait.data.machine.legs[:, 0]:
        dof, name = 3 + hip, rig.joints[hip]
        angle = world_angle(data, model.body(f'{rig.name}/{name}').id)
        target[dof] -= angle - q[dof]
    pull = kp * (target - q - DT * v) - kd * v
    mass, bias = np.zeros((model.nv, model.nv)), np.zeros(model.nv)
    mujoco.mj_fullM(model, data, mass)
    mujoco.mj_rne(model, data, 0, bias)
    mass = mass[np.ix_(columns, columns)] + DT * np.diag(full_kd)
    acceleration = np.linalg.solve(mass, pull - bias[columns])
    return (pull - kd * DT * acceleration)[3:]


class LawTest(parameterized.TestCase):
    """Joint torques against the formulas."""

    @parameterized.parameters(*NAMES)
    def test_stable_pd(self, name):
        rig = Rig(name, 3)
        rng = rig.scatter(5)
        gait = rig.gait
        targets, torque = gait.state.target, rig.gait.data.scratch.torque
        targets[...] = rng.uniform(-4, 4, targets.shape)
        count = len(rig.joints)
        for env_id in rig.env_ids:
            gaits.stable_pd(env_id, count, rig.gait.data)
            np.testing.assert_allclose(torque[env_id], dense_pd(rig, env_id), rtol=1e-8, atol=1e-7)
            gaits.stable_pd(env_id, count - 1, rig.gait.data)
            expected = dense_pd(rig, env_id, off=(rig.joints[-1],))
            np.testing.assert_allclose(torque[env_id], expected, rtol=1e-8, atol=1e-7)
            self.assertEqual(torque[env_id, -1], 0.0)

    def test_solve(self):
        """Within rounding of LAPACK, pivots included."""
        rng = np.random.default_rng(0)
        for n in (1, 4, 23):
            matrix, vector = rng.normal(size=(3, n, n)), rng.normal(size=(3, n))
            matrix[1, 0, 0] = 0.0 if n > 1 else 2.0
            others, expected = matrix[[0, 2]].copy(), np.linalg.solve(matrix[1], vector[1])
            bound = 1e-15 * np.linalg.cond(matrix[1]) * np.abs(expected).max()
            dynamics.solve(1, n, matrix, vector)
            np.testing.assert_allclose(vector[1], expected, rtol=0, atol=bound)
            np.testing.assert_array_equal(matrix[[0, 2]], others)

    def test_world_angles_are_wrapped(self):
        rig = Rig('raptor')
        q = np.zeros((1, len(rig.gait.data.skeleton.dof)))
        q[0, 1:3] = 3.0, 3.0
        q[0, 3 + rig.joints.index('right_hip')] = 0.5  # 3.5 rad to the world: -2.78
        rig.put(q, np.zeros_like(q))
        rig.gait.state.target[:] = 0.0
        found = np.ones((1, len(rig.joints)))
        gaits.write_local_targets(0, rig.gait.data, found)
        hip = rig.joints.index('right_hip')
        model, data, _ = rig.data()
        angle = world_angle(data, model.body('raptor/right_hip').id)
        self.assertBetween(angle, -np.pi, -2.0)
        self.assertAlmostEqual(found[0, hip], 0.5 - angle)
        np.testing.assert_array_equal(np.delete(found[0], [hip, rig.joints.index('left_hip')]), 0)

    @parameterized.parameters(*NAMES)
    def test_state_entry_sets_targets(self, name):
        rig = Rig(name)
        gait, figures = rig.gait, controllers.load(name)
        vector = np.random.default_rng(0).uniform(-2, 2, len(figures.names))
        apply(gait, vector[None])
        vector = np.where(np.isin(figures.names, list(ABSOLUTE)), np.abs(vector), vector)
        np.testing.assert_array_equal(gait.state.vector[0], vector)
        value = lambda parameter: vector[figures.names.index(parameter)]  # noqa: E731
        files = {joint: each.target for joint, each in rig.character.spec.joints.items()}
        for number, state in enumerate(figures.states):
            gait.state.number[:] = number
            enter(rig)
            expected = dict(files)
            if name in ('dog', 'goat'):
                for joint in ('shoulder', 'elbow', 'hip', 'knee', 'ankle'):
                    expected[joint] = value(f'{state}.{joint.title()}')
                for joint in ('spine0', 'spine1', 'spine2', 'spine3', 'torso'):
                    expected[joint] = value(f'{state}.SpineCurve')
            elif name in STRIDERS:
                for joint in ('hip', 'knee', 'ankle'):
                    expected[f'right_{joint}'] = value(f'{state}.Stance{joint.title()}')
                    expected[f'left_{joint}'] = value(f'{state}.Swing{joint.title()}')
            else:
                expected = {'hip': value(f'{state}.Hip'), 'leg': value(f'{state}.Knee')}
            found = dict(zip(rig.joints, gait.state.target[0], strict=True))
            self.assertEqual(found, expected)

    @parameterized.product(name=STRIDERS, stance=(0, 1), state=(0, 1, 2, 3), loaded=(True, False))
    def test_stride(self, name, stance, state, loaded):
        """Swing feedback and stance hip, by hand."""
        rig = Rig(name)
        rig.scatter(6, speed=1.0)
        gait, foot = rig.gait, {'raptor': 'toe'}.get(name, 'ankle')
        right, left = 'right', 'left'
        stance_leg, swing_leg = (left, right) if stance else (right, left)
        gait.state.stance[:], gait.state.number[:] = stance, state
        name_of = STATES[name][state]
        rig.set(Cv=0.3, Cd=1.7)
        rig.set(**{f'{name_of}__RootPitch': 0.4, f'{name_of}__SwingHip': 0.6})
        enter(rig)
        rig.touches((f'{stance_leg}_{foot}',) if loaded else (f'{swing_leg}_{foot}', 'root'))
        found = torques(gait)[0]

        model, data, columns = rig.data()
        mujoco.mj_subtreeVel(model, data)
        root, box = model.body(f'{name}/root').id, model.body(f'{name}/{stance_leg}_{foot}').id
        if state < 2:
            target = 0.6 + 0.3 * data.subtree_linvel[root, 0]
        else:
            target = 0.6 + 1.7 * (data.subtree_com[root, 0] - data.xipos[box, 0])
        swing, hip = rig.joints.index(f'{swing_leg}_hip'), rig.joints.index(f'{stance_leg}_hip')
        self.assertAlmostEqual(gait.state.target[0, swing], target, places=9)
        acts = loaded and state < 2
        expected = dense_pd(rig, 0, off=(f'{stance_leg}_hip',) if acts else ())
        if acts:
            kp, kd = {'raptor': (300, 30)}.get(name, (200, 20))
            pitch, rate = data.qpos[columns[2]], data.qvel[columns[2]]
            expected[hip] = -expected[swing] - (kp * (0.4 - pitch) - kd * rate)
        limits = rig.character.torque_limits
        np.testing.assert_allclose(found, np.clip(expected, -limits, limits), atol=1e-6)

    @parameterized.product(name=('dog', 'goat'), state=(0, 1, 2, 3), feet=((), ('toe',), ('finger',),
                           ('toe', 'finger')))  # fmt: skip
    def test_bound(self, name, state, feet):
        """Swing feedback, virtual forces and gravity compensation, by hand."""
        rig = Rig(name)
        rig.scatter(7, speed=1.0)
        gait, figures = rig.gait, STATES[name][state]
        forces = {'toe': (31.0, 17.0), 'finger': (-12.0, 23.0)}
        rig.set(Cv=0.2, BackForceX=31.0, BackForceY=17.0, FrontForceX=-12.0, FrontForceY=23.0)
        rig.set(**{f'{figures}__Hip': 0.3, f'{figures}__Shoulder': -0.4})
        gait.state.number[:] = state
        enter(rig)
        rig.touches(('knee', *feet))
        found = torques(gait)[0]

        model, data, columns = rig.data()
        mujoco.mj_subtreeVel(model, data)
        speed = data.subtree_linvel[model.body(f'{name}/root').id, 0]
        for joint, foot, angle in (('hip', 'toe', 0.3), ('shoulder', 'finger', -0.4)):
            expected = angle + (0.0 if foot in feet else 0.2 * speed)
            target = gait.state.target[0, rig.joints.index(joint)]
            self.assertAlmostEqual(target, expected, places=9)
        expected = dense_pd(rig, 0)
        of_feet = {
            foot: jacobian(model, data, columns, *sole(model, data, foot, name)) for foot in feet
        }
        if name == 'dog' and feet:
            expected += self.weight(model, data, columns, of_feet)[3:]
        foot = 'toe' if state < 2 else 'finger'
        if foot in feet:
            push = of_feet[foot].T @ -np.array(forces[foot])
            limb = {'toe': ('hip', 'knee', 'ankle', 'toe')}.get(
                foot, ('shoulder', 'elbow', 'wrist', 'finger')
            )
            for joint in limb:
                expected[rig.joints.index(joint)] += push[3 + rig.joints.index(joint)]
        limits = rig.character.torque_limits
        np.testing.assert_allclose(found, np.clip(expected, -limits, limits), atol=1e-5)

    def weight(self, model, data, columns, of_feet):
        """Forces of the joints that carry the body on its feet, from those of gravity."""
        gravity = np.zeros(len(columns))
        for body in range(1, model.nbody):
            if model.body_mass[body]:
                centre = jacobian(model, data, columns, body, data.xipos[body])
                gravity += centre.T @ (0, -9.8 * model.body_mass[body])
        supports = np.concatenate([matrix.T for matrix in of_feet.values()], axis=1)
        a, b = supports[:3], -gravity[:3]
        x = np.linalg.solve(a.T @ a + 1e-4 * np.eye(a.shape[1]), a.T @ b)
        if len(of_feet) == 2:  # two feet can carry the trunk, and without tipping it
            np.testing.assert_allclose(a @ x, b, atol=0.05 * np.linalg.norm(b))
        return -gravity - supports @ x

    @parameterized.product(state=(0, 1, 2, 3), landed=(True, False))
    def test_hop(self, state, landed):
        rig = Rig('hopper')
        rig.scatter(8, speed=0.5)
        gait = rig.gait
        gait.state.vector[:, 0] = 0.7
        gait.state.number[:] = state
        rig.set(**{f'{STATES["hopper"][state]}__Knee': rig.positions[0, 4]})
        enter(rig)
        rig.touches(('leg',) if landed else ('root', 'hip'))
        found = torques(gait)[0]
        self.assertLess(abs(found[1]), 179.0)  # the leg's limit hides nothing
        model, data, columns = rig.data()
        pitch, rate = data.qpos[columns[2]], data.qvel[columns[2]]
        expected = dense_pd(rig, 0)
        if state in (1, 2):
            expected[0] -= 0.7 * (200 * (0 - pitch) - 20 * rate)
        if landed:
            thigh = world_angle(data, model.body('hopper/hip').id)
            expected[1] += (8.0 + 0.5) * -9.8 * np.cos(thigh)
        expected = np.clip(expected, (-2500, -180), (2500, 180))
        np.testing.assert_allclose(found, expected, atol=1e-6)

    @parameterized.parameters(*NAMES)
    def test_torques_stay_within_limits(self, name):
        rig = Rig(name, 40)
        rng = rig.scatter(9, speed=30.0)
        gait, limits = rig.gait, rig.character.torque_limits
        spread = np.maximum(5 * np.abs(gait.parameters.action_scale), 3.0)
        noise = rng.normal(size=gait.state.vector.shape)
        apply(gait, gait.parameters.action_offset + noise * spread)
        gait.state.number[:] = rig.env_ids % 4
        enter(rig)
        touching = rng.random((40, len(rig.character.spec.links))) < 0.5
        rig.touches(touching)
        found = torques(gait)
        self.assertTrue((np.abs(found) <= limits).all())
        self.assertTrue((np.abs(found) == limits).any())
        self.assertTrue((np.abs(found) < limits).any())


class MachineTest(parameterized.TestCase):
    """Transitions of states."""

    def leave(self, rig, state, links, phase=0.0):
        """Puts the machine into a state, advances it once, and returns (state, cycle's end)."""
        gait = rig.gait
        gait.state.number[:], gait.state.phase[:] = state, phase
        enter(rig)
        rig.touches(links)
        (ended,) = advance(gait)
        return int(gait.state.number[0]), bool(ended)

    def test_bound(self):
        rig = Rig('dog')
        feet = ((), ('toe',), ('finger',), ('toe', 'finger'), ('knee', 'wrist'))
        for links in feet:
            for late in (False, True):
                phase = 0.99 if late else 0.5
                following = [self.leave(rig, state, links, phase) for state in range(4)]
                self.assertEqual(following[0], (int(late), False))
                self.assertEqual(following[1], (2 if 'finger' in links else 1, False))
                self.assertEqual(following[2], (3 if late else 2, False))
                self.assertEqual(following[3], (3, 'toe' in links))

    @parameterized.product(name=STRIDERS, stance=(0, 1))
    def test_stride(self, name, stance):
        rig = Rig(name)
        foot = {'raptor': 'toe'}.get(name, 'ankle')
        stance_foot, swing_foot = (f'right_{foot}', f'left_{foot}')[:: -1 if stance else 1]
        for links in ((), (stance_foot,), (swing_foot,), (stance_foot, swing_foot)):
            for phase, late in ((0.5, False), (0.99, True)):
                for state in range(4):
                    rig.gait.state.stance[:] = stance
                    ends = late if state < 3 else swing_foot in links
                    expected = (min(state + 1, 3), state == 3) if ends else (state, False)
                    self.assertEqual(self.leave(rig, state, links, phase), expected)
                    # The legs are exchanged with the cycle, before any query.
                    self.assertEqual(
                        rig.gait.state.stance[0], 1 - stance if expected[1] else stance
                    )

    def test_phase(self):
        for name, duration in (('dog', 0.125), ('raptor', 0.0825), ('biped2d_simbicon', 0.0825)):
            rig = Rig(name)
            steps = 0
            while rig.gait.state.number[0] == 0:
                advance(rig.gait)
                steps += 1
            self.assertAlmostEqual(steps * DT, duration, delta=1.01 * DT)
            self.assertEqual(rig.gait.state.phase[0], 0.0)
            advance(rig.gait)
            self.assertAlmostEqual(rig.gait.state.phase[0], 0.0 if name == 'dog' else DT / duration,
                                   delta=DT / duration)  # fmt: skip

    def test_a_new_cycle(self):
        rig = Rig('raptor')
        gait = rig.gait
        gait.state.number[:], gait.state.phase[:], gait.state.stance[:] = 3, 0.4, 1
        vector = gait.parameters.base_actions[2:3].copy()
        vector[0, :3] *= -1
        apply(gait, vector)
        self.assertEqual(
            (gait.state.number[0], gait.state.phase[0], gait.state.stance[0]), (0, 0.0, 1)
        )
        np.testing.assert_array_equal(gait.state.vector, gait.parameters.base_actions[2:3])
        left_knee = gait.state.target[0, rig.joints.index('left_knee')]  # of the stance leg now
        self.assertEqual(left_knee, vector[0, gait.parameters.place('Contact.StanceKnee')])
        vector[...] = 0  # the caller's own
        np.testing.assert_array_equal(gait.state.vector, gait.parameters.base_actions[2:3])

    def test_hop(self):
        rig = Rig('hopper')
        gait = rig.gait

        def leave(state, landed, was_rising, rising):
            q = np.zeros((1, 5))
            q[0, 1] = 3.0
            rig.put(q, np.array([[0, 1.0 if rising else -1.0, 0, 0, 0]]))
            gait.state.rising[:] = was_rising
            return self.leave(rig, state, ('leg',) if landed else ())

        for was in (False, True):
            for now in (False, True):
                for landed in (False, True):
                    self.assertEqual(leave(0, landed, was, now), (0, landed))
                    turned_up = now and not was
                    self.assertEqual(leave(1, landed, was, now), (2 if turned_up else 1, False))
                    self.assertEqual(leave(2, landed, was, now), (2 if landed else 3, False))
                    turned_down = was and not now
                    self.assertEqual(
                        leave(3, landed, was, now),
                        (2 if landed else 0 if turned_down else 3, False),
                    )
                    self.assertEqual(bool(gait.state.rising[0]), now)

    def test_hop_begins_in_the_air_and_continues_at_touch_down(self):
        rig = Rig('hopper')
        gait = rig.gait
        apply(gait, gait.parameters.base_actions[3:4])
        self.assertEqual(gait.state.number[0], 0)  # the first action: still in descent
        np.testing.assert_array_equal(gait.state.vector, gait.parameters.base_actions[3:4])
        self.assertEqual(self.leave(rig, 0, ('leg',)), (0, True))
        apply(gait, gait.parameters.base_actions[4:5])
        self.assertEqual(gait.state.number[0], 1)
        self.assertEqual(gait.state.target[0, 0], gait.parameters.base_actions[4, 3])
        begin(gait)
        apply(gait, gait.parameters.base_actions[3:4])
        self.assertEqual(gait.state.number[0], 0)


class AloneTest(parameterized.TestCase):
    """A gait works without an environment of the suite."""

    def test_a_dog_in_a_users_arena(self):
        arena, dog = users_arena(), characters.make('dog')
        option = arena.mjcf_model.option
        option.timestep, option.gravity = controllers.GAIT_TIMESTEP / 2, (0, 0, -9.8)
        dog.create_root_joints(arena.attach(dog))
        gait = controllers.Gait(dog, 'world', arena.mjcf_model)
        actuation.add(dog, 'torque', option.timestep)
        for joint in dog.joints:
            joint.damping = joint.armature = 0
        physics = mjcf.Physics.from_mjcf_model(arena.mjcf_model)
        world, env_ids = PhysicsWorld(physics, dynamics.FIELDS), np.arange(1)
        gait.bind(world)
        start, skeleton = gait.parameters.start, gait.data.skeleton
        places, rates = skeleton.qpos, skeleton.dof
        world.qpos[0, places[1:3]] = start['height'], start['pitch']
        world.qvel[0, rates[:3]] = start['velocity']
        for name, (angle, rate) in start['joints'].items():
            dof = 3 + gait.number[name]
            world.qpos[0, places[dof]], world.qvel[0, rates[dof]] = angle, rate
        world.forward(env_ids)
        begin(gait)
        cycles, down = 0, 0
        trunk = [gait.link[name] for name in dog.spec.fall_links]
        for _ in range(3 * 600):
            world.ctrl[0] = torques(gait)[0]
            world.step(2)
            if advance(gait)[0]:
                apply(gait, gait.parameters.action_offset[None])
                cycles += 1
            down += (world.sensordata[0, gait.data.machine.contact + np.array(trunk)] > 0).any()
        self.assertBetween(cycles, 5, 9)
        self.assertLess(down, 60)  # of 1800
        self.assertGreater(world.qpos[0, places[0]], 6.0)
        self.assertLess(abs(world.qpos[0, places[2]]), 1.2)
