"""Tests of characters in three dimensions, bodies and actuation, against the original's values."""

import dataclasses
import functools
import itertools

import mujoco
import numpy as np
from absl.testing import absltest, parameterized
from dm_control import composer, mjcf

from trl_suite import actuation, characters, suite
from trl_suite.motion import quaternion

TIMESTEP = 1 / 300  # s
GRAVITY = 9.81  # m/s^2; of MuJoCo's default


def sided(limb):
    return {f'{side}_{name}': row for side in ('right', 'left') for name, row in limb.items()}


# link: mass kg, torque limit N m, kp N m/rad, kd N m s/rad, reward weight, and limits in rad: of a
# hinge (from, to); of a ball joint about x, y and z of the original (roll, yaw, pitch).
TORSO = {'torso': (15, 200, 1000, 100, 0.5, ((-0.5, 0.5), (-1, 1), (-1, 1)))}
HIP = ((-1.2, 1.2), (-1, 1), (-2.57, 2.57))
ANKLE = ((-1, 1), (-1, 1), (-1.57, 1.57))
LEG = {
    'hip': (4.5, 200, 300, 30, 0.5, HIP),
    'knee': (3, 150, 300, 30, 0.3, (-3.14, 0)),
    'ankle': (1, 90, 100, 10, 0.2, ANKLE),
}
RUN_LEG = {
    'hip': (2, 250, 500, 50, 0.5, HIP),
    'knee': (1.5, 200, 500, 50, 0.3, (-3.14, 0)),
    'ankle': (0.5, 200, 500, 50, 0.2, ANKLE),
}
SIMBICON_LEG = {
    'hip': (2, 200, 200, 20, 0.3, ((-0.7, 0.2), None, (-0.3, 1.4))),  # yaws freely
    'knee': (1.5, 200, 200, 20, 0.3, (-2.5, 0)),
    'ankle': (0.5, 100, 100, 10, 0.2, ((-0.25, 0.25), (-0.25, 0.25), (-1, 0.57))),
}
RIGID = (-0.01, 0.01)
ARM = {
    'shoulder': (1, 90, 100, 10, 0.001, (RIGID,) * 3),
    'elbow': (1, 90, 100, 10, 0.001, RIGID),
    'wrist': (1, 90, 100, 10, 0.001, (RIGID,) * 3),
}
JOINTS = {
    'biped3d': TORSO | sided(LEG),
    'biped3d_mocap': TORSO | sided(LEG),
    'biped3d_mocap_run': TORSO | sided(RUN_LEG),
    'biped3d_full_mocap': {
        **TORSO,
        **sided(LEG),
        **sided(ARM),
        'neck': (1, 90, 100, 10, 0.001, (RIGID,) * 3),
        'head': (1, 90, 100, 10, 0.001, RIGID),
    },
    'biped3d_simbicon': sided(SIMBICON_LEG),
}
NAMES = tuple(JOINTS)
ARMATURE = {('biped3d_mocap_run', 'right_ankle'): 0.03, ('biped3d_mocap_run', 'left_ankle'): 0.03}


@dataclasses.dataclass(frozen=True)
class Figures:
    """Whole-body figures in the zero pose, in the source's frame (x forward, y up, z right)."""

    mass: float  # kg
    root_mass: float  # kg
    height: float  # m, root above the sole
    total: float  # m, from sole to top
    com: tuple[float, float, float]  # m, relative to the root
    inertia: tuple[float, float, float]  # kg m^2, xx yy zz about the com
    fall: str
    pairs: int  # self-collision pairs
    sizes: tuple[int, int]  # of actions by rotation vectors, and by angles and axes


FIGURES = {
    'biped3d': Figures(
        42, 10, 0.7904, 1.2054, (0.002467, -0.056221, 0), (4.677238, 0.400246, 4.380956),
        'root torso', 11, (17, 22),
    ),
    'biped3d_mocap': Figures(
        42, 10, 0.87877, 1.31377, (0.002467, -0.070306, 0), (5.71196, 0.350557, 5.465367),
        'root torso', 11, (17, 22),
    ),
    'biped3d_mocap_run': Figures(
        33, 10, 0.87877, 1.31377, (0.00157, 0.02436, 0), (3.61826, 0.27054, 3.43225),
        'root torso', 11, (17, 22),
    ),
    'biped3d_full_mocap': Figures(
        50, 10, 0.87877, 1.45377, (0.002072, -0.033057, 0), (6.794128, 0.600486, 6.307576),
        'root torso right_hip right_knee left_hip left_knee right_shoulder right_elbow right_wrist '
        'left_shoulder left_elbow left_wrist neck head', 16, (35, 45),
    ),
    'biped3d_simbicon': Figures(
        33, 25, 0.7904, 1.2054, (0.00157, 0.050958, 0), (3.067179, 0.199238, 2.935667),
        'root', 2, (14, 18),
    ),
}  # fmt: skip


def leg(hip, thigh, shank, width, boxes):
    """Links of both legs: parent, joint in its frame, full box size, box centre (source), m."""
    return {
        f'{side}_{name}': row
        for side, z in (('right', hip), ('left', -hip))
        for name, row in {
            'hip': ('root', (0, 0, z), *boxes[0]),
            'knee': (f'{side}_hip', (0, -thigh, 0), *boxes[1]),
            'ankle': (
                f'{side}_knee', (0, -shank, 0), (0.177, 0.05, width), (0.0518, -0.0224, 0),
            ),
        }.items()
    }  # fmt: skip


def arm():
    return {
        f'{side}_{name}': row
        for side, z in (('right', 0.2), ('left', -0.2))
        for name, row in {
            'shoulder': ('torso', (0, 0.3, z), (0.09, 0.25, 0.09), (0, -0.125, 0)),
            'elbow': (f'{side}_shoulder', (0, -0.25, 0), (0.07, 0.25, 0.07), (0, -0.125, 0)),
            'wrist': (f'{side}_elbow', (0, -0.25, 0), (0.08, 0.07, 0.08), (0, -0.035, 0)),
        }.items()
    }


MOCAP_LINKS = {
    'root': (None, (0, 0, 0), (0.12, 0.15, 0.27), (0, 0.03, 0)),
    'torso': ('root', (0, 0.1, 0), (0.13, 0.33, 0.29), (0, 0.17, 0)),
    **leg(
        0.085, 0.4215, 0.40987, 0.09,
        (((0.09, 0.4215, 0.09), (0, -0.21075, 0)), ((0.07, 0.43, 0.07), (0, -0.19493, 0))),
    ),
}  # fmt: skip
LINKS = {
    'biped3d': {
        'root': (None, (0, 0, 0), (0.12, 0.13, 0.278), (0, 0.02, 0)),
        'torso': ('root', (0, 0.08, 0), (0.13, 0.33, 0.29), (0, 0.17, 0)),
        **leg(
            0.1, 0.352, 0.391, 0.085,
            (((0.09, 0.4, 0.085), (0, -0.1745, 0)), ((0.07, 0.416, 0.065), (0, -0.183, 0))),
        ),
    },
    'biped3d_mocap': MOCAP_LINKS,
    'biped3d_mocap_run': MOCAP_LINKS,
    'biped3d_full_mocap': {
        **MOCAP_LINKS,
        **arm(),
        'neck': ('torso', (0, 0.33, 0), (0.07, 0.05, 0.07), (0, 0.025, 0)),
        'head': ('neck', (0, 0.025, 0), (0.125, 0.12, 0.125), (0, 0.06, 0)),
    },
    'biped3d_simbicon': {
        'root': (None, (0, 0, 0), (0.11, 0.45, 0.278), (0, 0.19, 0)),
        **leg(
            0.01, 0.352, 0.391, 0.08,
            (((0.0846, 0.4, 0.08), (0, -0.1745, 0)), ((0.065, 0.416, 0.06), (0, -0.183, 0))),
        ),
    },
}  # fmt: skip

LEG_PAIRS = (
    ('right_hip', 'right_ankle'), ('right_hip', 'left_hip'), ('right_hip', 'left_knee'),
    ('right_hip', 'left_ankle'), ('right_knee', 'left_hip'), ('right_knee', 'left_knee'),
    ('right_knee', 'left_ankle'), ('right_ankle', 'left_hip'), ('right_ankle', 'left_knee'),
    ('right_ankle', 'left_ankle'), ('left_hip', 'left_ankle'),
)  # fmt: skip
SELF_COLLISIONS = {
    'biped3d': LEG_PAIRS,
    'biped3d_mocap': LEG_PAIRS,
    'biped3d_mocap_run': LEG_PAIRS,
    'biped3d_full_mocap': (
        *LEG_PAIRS, ('root', 'neck'), ('root', 'head'), ('torso', 'head'),
        ('right_shoulder', 'right_wrist'), ('left_shoulder', 'left_wrist'),
    ),
    'biped3d_simbicon': (('right_hip', 'right_ankle'), ('left_hip', 'left_ankle')),
}  # fmt: skip


def is_ball(limits):
    return len(limits) == 3


def cone(limits):
    """The largest of the finite limits about three axes."""
    return max(abs(limit) for axis in limits if axis is not None for limit in axis)


def to_mujoco(vector):
    """The source's x forward, y up, z right as MuJoCo's x forward, y left, z up."""
    x, y, z = vector
    return np.array([x, -z, y])


def quaternion_of(vector):
    """Unit quaternion of a rotation vector."""
    angle = np.linalg.norm(vector)
    axis = np.asarray(vector) / angle if angle > 0 else np.zeros(3)
    return np.array([np.cos(angle / 2), *(np.sin(angle / 2) * axis)])


def from_euler(x, y, z):
    """Rotation vector of the source's Rz(z) Ry(y) Rx(x), in MuJoCo's axes."""
    turns = (quaternion_of(to_mujoco(v)) for v in ((0, 0, z), (0, y, 0), (x, 0, 0)))
    return quaternion.rotation_vector(functools.reduce(quaternion.multiply, turns))


def random_targets(name, rng, share=1.0):
    """Rotation vectors and angles, (D,), within the Euler limits and within a share of the cones."""
    parts = []
    for *_, limits in JOINTS[name].values():
        if is_ball(limits):
            largest = cone(limits)
            euler = [rng.uniform(*(axis or (-largest, largest))) for axis in limits]
            vector = from_euler(*euler)
            parts.append(vector * min(1, share * largest / np.linalg.norm(vector)))
        else:
            middle, half = np.mean(limits), np.ptp(limits) / 2
            parts.append([middle + share * half * rng.uniform(-1, 1)])
    return np.concatenate(parts)


def alone(name):
    """The character compiled alone, its root at the origin."""
    physics = mjcf.Physics.from_mjcf_model(characters.make(name).mjcf_model)
    return physics.model.ptr, physics.data.ptr


def users_arena(timestep=TIMESTEP, **options):
    arena = composer.Arena(name='mine')
    option = arena.mjcf_model.option
    option.timestep, option.integrator = timestep, 'implicitfast'
    for key, value in options.items():
        setattr(option, key, value)
    arena.mjcf_model.worldbody.add('geom', name='floor', type='plane', size=(0, 0, 1))
    return arena


def half_size(model, link):
    return model.geom_aabb[model.geom(link).id, 3:]


def heights(model, data):
    """Lowest and highest points of the collision boxes, m."""
    boxes = np.flatnonzero(model.geom_group == 3)
    centre = data.geom_xpos[boxes, 2]
    reach = (np.abs(data.geom_xmat[boxes].reshape(-1, 3, 3)[:, 2]) * model.geom_size[boxes]).sum(1)
    return (centre - reach).min(), (centre + reach).max()


class Floating:
    """A character that can move freely, without gravity and contacts."""

    def __init__(self, name, model, timestep=TIMESTEP, root=True, **options):
        arena = users_arena(timestep, gravity=(0, 0, 0))
        arena.mjcf_model.option.flag.contact = 'disable'
        self.character = characters.make(name)
        frame = arena.attach(self.character)
        if root:
            self.character.create_root_joints(frame)
        self.map = actuation.add(self.character, model, timestep, **options)
        self._physics = mjcf.Physics.from_mjcf_model(arena.mjcf_model)
        self.model, self.data = self._physics.model.ptr, self._physics.data.ptr
        names = [joint.full_identifier for joint in self.character.joints]
        ids = [self.model.joint(each).id for each in names]
        # First numbers of each joint; three in qvel and four in qpos if it is a ball.
        self.qpos, self.dof = self.model.jnt_qposadr[ids], self.model.jnt_dofadr[ids]
        self.sizes = self.character.dofs
        self.dofs = np.concatenate([
            np.arange(dof, dof + size) for dof, size in zip(self.dof, self.sizes, strict=True)
        ])  # fmt: skip
        actuators = [self.model.actuator(f'{name}/{each}').id for each in self.map.actuators]
        first = self.model.actuator_ctrladr[actuators]
        count = self.model.actuator_ctrlnum[actuators]
        self.controls = np.concatenate([
            np.arange(adr, adr + size) for adr, size in zip(first, count, strict=True)
        ])  # fmt: skip

    def act(self, action):
        self.data.ctrl[self.controls] = self.map.control(np.asarray(action, float))

    def forward(self):
        mujoco.mj_forward(self.model, self.data)

    def step(self, seconds=None):
        count = 1 if seconds is None else round(seconds / self.model.opt.timestep)
        mujoco.mj_step(self.model, self.data, count)

    def pose(self, targets):
        """Puts the joints at rotation vectors and angles, (D,)."""
        for adr, part in zip(self.qpos, self.split(targets), strict=True):
            turn = quaternion_of(part) if len(part) == 3 else part
            self.data.qpos[adr : adr + len(turn)] = turn

    def split(self, values):
        """Cuts numbers of all degrees of freedom, (D,), into those of each joint."""
        return np.split(values, np.cumsum(self.sizes)[:-1])

    def error(self, targets):
        """Angles in rad between where joints are and where they should be, shape (J,)."""
        errors = []
        for adr, part in zip(self.qpos, self.split(targets), strict=True):
            if len(part) == 1:
                errors.append(abs(part[0] - self.data.qpos[adr]))
                continue
            back = quaternion.conjugate(self.data.qpos[adr : adr + 4])
            turn = quaternion.multiply(back, quaternion_of(part))
            errors.append(np.linalg.norm(quaternion.rotation_vector(turn)))
        return np.array(errors)

    @property
    def norms(self):
        """Norm of the actuators' torque on each joint, N m, shape (J,)."""
        torque = self.data.qfrc_actuator[self.dofs]
        return np.array([np.linalg.norm(part) for part in self.split(torque)])

    @property
    def speed(self):
        """Largest joint speed, rad/s."""
        return np.abs(self.data.qvel[self.dofs]).max()


class FiguresTest(parameterized.TestCase):
    """Bodies are those of the original."""

    def test_all_spatial_characters_are_here(self):
        spatial = [name for name, spec in characters.CHARACTERS.items() if spec.spatial]
        self.assertCountEqual(spatial, NAMES)

    @parameterized.parameters(*NAMES)
    def test_whole_body(self, name):
        figures = FIGURES[name]
        model, data = alone(name)
        mujoco.mj_forward(model, data)
        self.assertAlmostEqual(model.body_mass.sum(), figures.mass, delta=1e-9)
        np.testing.assert_allclose(data.subtree_com[1], to_mujoco(figures.com), atol=5e-6)
        xx, yy, zz = figures.inertia
        np.testing.assert_allclose(data.crb[1][:3], (xx, zz, yy), atol=5e-6)
        low, high = heights(model, data)
        self.assertAlmostEqual(-low, figures.height, delta=5e-6)
        self.assertAlmostEqual(high - low, figures.total, delta=5e-6)
        reported = characters.body_figures(characters.make(name))
        self.assertAlmostEqual(reported['mass'], figures.mass, delta=1e-9)
        self.assertAlmostEqual(reported['standing_height'], figures.height, delta=5e-6)
        np.testing.assert_allclose(reported['com'], to_mujoco(figures.com), atol=5e-6)
        np.testing.assert_allclose(reported['inertia'], (xx, zz, yy), atol=5e-6)

    @parameterized.parameters(*NAMES)
    def test_link_masses_and_solid_box_inertias(self, name):
        model, _ = alone(name)
        masses = {'root': FIGURES[name].root_mass} | {j: r[0] for j, r in JOINTS[name].items()}
        self.assertEqual(model.nbody - 1, len(masses))
        for link, mass in masses.items():
            body = model.body(link)
            self.assertAlmostEqual(body.mass[0], mass, delta=1e-9, msg=link)
            a, b, c = (2 * half_size(model, link)) ** 2
            solid = mass / 12 * np.array([b + c, a + c, a + b])
            np.testing.assert_allclose(np.sort(body.inertia), np.sort(solid), rtol=1e-6)

    @parameterized.parameters(
        # About x, y, z of the source, kg m^2.
        ('biped3d', 'root', (0.078487, 0.076403, 0.026083)),
        ('biped3d', 'left_knee', (0.044320, 0.002281, 0.044489)),
        ('biped3d_mocap', 'torso', (0.241250, 0.126250, 0.157250)),
        ('biped3d_mocap', 'right_hip', (0.069661, 0.006075, 0.069661)),
        ('biped3d_mocap_run', 'left_ankle', (0.000442, 0.001643, 0.001410)),
        ('biped3d_full_mocap', 'right_wrist', (0.000942, 0.001067, 0.000942)),
        ('biped3d_full_mocap', 'head', (0.002502, 0.002604, 0.002502)),
        ('biped3d_simbicon', 'right_hip', (0.027733, 0.002260, 0.027860)),
    )
    def test_inertia_of_a_link(self, name, link, inertia):
        model, data = alone(name)
        mujoco.mj_forward(model, data)
        frame = data.body(link).ximat.reshape(3, 3)
        own = frame @ np.diag(model.body(link).inertia) @ frame.T
        xx, yy, zz = inertia
        np.testing.assert_allclose(own, np.diag([xx, zz, yy]), atol=6e-7)

    @parameterized.parameters(*NAMES)
    def test_geometry_of_links(self, name):
        model, _ = alone(name)
        self.assertEqual(set(characters.CHARACTERS[name].links), set(LINKS[name]))
        for link, (parent, joint, size, centre) in LINKS[name].items():
            half = np.abs(to_mujoco(size)) / 2
            np.testing.assert_allclose(half_size(model, link), half, atol=1e-9, err_msg=link)
            np.testing.assert_allclose(model.geom(link).pos, to_mujoco(centre), atol=1e-9)
            np.testing.assert_allclose(model.body(link).ipos, to_mujoco(centre), atol=1e-9)
            np.testing.assert_allclose(model.body(link).pos, to_mujoco(joint), atol=1e-9)
            np.testing.assert_array_equal(model.body(link).quat, (1, 0, 0, 0))
            np.testing.assert_array_equal(model.geom(link).quat, (1, 0, 0, 0))
            if parent is not None:
                self.assertEqual(model.body(model.body(link).parentid[0]).name, parent)

    @parameterized.parameters(*NAMES)
    def test_joints(self, name):
        character, table = characters.make(name), JOINTS[name]
        model, _ = alone(name)
        self.assertEqual(tuple(character.spec.joints), tuple(table))  # order is that of the links
        self.assertEqual(character.spec.links, ('root', *table))
        balls = [is_ball(row[5]) for row in table.values()]
        np.testing.assert_array_equal(character.spherical, balls)
        np.testing.assert_array_equal(character.dofs, np.where(balls, 3, 1))
        self.assertFalse(character.prismatic.any())
        np.testing.assert_allclose(character.torque_limits, [row[1] for row in table.values()])
        for (joint, spec), figures, reach in zip(
            table.items(), character.spec.joints.values(), character.joint_ranges, strict=True
        ):
            _, limit, kp, kd, weight, limits = spec
            compiled = model.joint(joint)
            self.assertEqual((figures.kp, figures.kd, figures.weight), (kp, kd, weight), joint)
            self.assertEqual(model.jnt_limited[compiled.id], 1)
            np.testing.assert_allclose(reach, compiled.range, err_msg=joint)
            if is_ball(limits):
                self.assertEqual(compiled.type[0], mujoco.mjtJoint.mjJNT_BALL)
                np.testing.assert_allclose(compiled.range, (0, cone(limits)), err_msg=joint)
            else:
                self.assertEqual(compiled.type[0], mujoco.mjtJoint.mjJNT_HINGE)
                np.testing.assert_array_equal(compiled.axis, (0, -1, 0))
                np.testing.assert_allclose(compiled.range, limits, err_msg=joint)
                np.testing.assert_allclose(model.jnt_actfrcrange[compiled.id], (-limit, limit))
                self.assertEqual(model.jnt_actfrclimited[compiled.id], 1)

    @parameterized.parameters(
        ('biped3d', 8, 3.5, 'torso', 0.5), ('biped3d_mocap', 8, 3.5, 'left_knee', 0.3),
        ('biped3d_mocap_run', 8, 3.5, 'right_ankle', 0.2),
        ('biped3d_full_mocap', 16, 3.508, 'left_wrist', 0.001),
        ('biped3d_simbicon', 7, 2.6, 'root', 1),
    )  # fmt: skip
    def test_links_and_reward_weights(self, name, count, total, link, weight):
        spec = characters.CHARACTERS[name]
        self.assertLen(spec.links, count)
        self.assertAlmostEqual(spec.weights.sum(), 1, delta=1e-12)
        self.assertAlmostEqual(spec.weights[spec.links.index(link)], weight / total, delta=1e-12)

    @parameterized.parameters(*NAMES)
    def test_fall_links_end_effectors_and_stumbles(self, name):
        spec = characters.CHARACTERS[name]
        self.assertCountEqual(spec.fall_links, FIGURES[name].fall.split())
        self.assertEqual(spec.end_effectors, ('right_ankle', 'left_ankle'))
        free = {'right_ankle', 'left_ankle'}
        if name == 'biped3d_simbicon':  # as of the characters with gaits
            free |= {'right_knee', 'left_knee'}
        self.assertEqual(set(spec.stumble_exempt), free)
        self.assertNotEmpty(spec.description)

    @parameterized.parameters(*NAMES)
    def test_mirror_pairs(self, name):
        spec = characters.CHARACTERS[name]
        sides = [joint for joint in spec.joints if joint.startswith(('right_', 'left_'))]
        self.assertCountEqual(itertools.chain(*spec.mirror), sides)
        for right, left in spec.mirror:
            self.assertEqual(right.removeprefix('right'), left.removeprefix('left'))
            self.assertEqual(JOINTS[name][right], JOINTS[name][left])
            self.assertEqual(spec.joints[right], spec.joints[left])

    def test_original_limits_of_joints_that_are_not_symmetric(self):
        character = characters.make('biped3d_simbicon')
        hip, _, ankle = actuation.original_ranges(character)[:3]
        np.testing.assert_allclose(hip, (-0.7, 1.4))
        np.testing.assert_allclose(ankle, (-1, 0.57))


class MirrorTest(parameterized.TestCase):
    """The left side is the mirror image of the right one, in pose and in motion."""

    def exchanged(self, character):
        """The other side's name of every link that has two sides."""
        return {**dict(character.spec.mirror), **{b: a for a, b in character.spec.mirror}}

    def mirrored(self, character, vectors):
        """Rotation vectors and angles of the mirror image, (D,)."""
        names, exchanged = list(character.spec.joints), self.exchanged(character)
        parts = dict(zip(names, np.split(vectors, np.cumsum(character.dofs)[:-1]), strict=True))
        signs = {1: np.ones(1), 3: np.array([-1.0, 1.0, -1.0])}
        return np.concatenate([
            signs[len(parts[name])] * parts[exchanged.get(name, name)] for name in names
        ])  # fmt: skip

    def positions(self, body):
        scope = body.character.spec.name
        mujoco.mj_kinematics(body.model, body.data)
        return {
            link: body.data.body(f'{scope}/{link}').xipos.copy()
            for link in body.character.spec.links
        }

    def assert_mirrored(self, here, there, character, atol):
        exchanged = self.exchanged(character)
        for link, position in here.items():
            other = there[exchanged.get(link, link)] * (1, -1, 1)
            np.testing.assert_allclose(position, other, atol=atol, err_msg=link)

    @parameterized.parameters(*NAMES)
    def test_mirrored_poses_give_mirrored_positions(self, name):
        first, second = (Floating(name, 'position', root=False) for _ in range(2))
        pose = random_targets(name, np.random.default_rng(3))
        first.pose(pose)
        second.pose(self.mirrored(second.character, pose))
        here, there = self.positions(first), self.positions(second)
        self.assert_mirrored(here, there, first.character, 1e-12)
        self.assertGreater(abs(here['right_ankle'][1] + here['left_ankle'][1]), 0.01)  # not equal

    @parameterized.product(name=NAMES, model=('position', 'torque', 'velocity'))
    def test_mirrored_controls_give_mirrored_motion(self, name, model):
        first, second = (Floating(name, model) for _ in range(2))
        self.assertFalse(first.map.action_offset.any())
        # Below the clamps: at them, which steps MuJoCo damps implicitly depends on the last bit.
        size = {'position': 0.05, 'torque': 0.3, 'velocity': 0.02}[model]
        action = size * np.random.default_rng(4).uniform(-1, 1, len(first.map))
        first.act(action)
        second.act(self.mirrored(second.character, action))
        for _ in range(30):
            first.step()
            second.step()
            self.assertLess((first.norms / first.character.torque_limits).max(), 0.99)
        here, there = self.positions(first), self.positions(second)
        self.assert_mirrored(here, there, first.character, 1e-9)
        self.assertGreater(first.speed, 0.1)


class CollisionTest(parameterized.TestCase):
    """Pairs of links that can collide, according to the engine."""

    def touching(self, name):
        """Pairs of links (and the floor) that touch when every box is 20 m large."""
        arena = users_arena()
        character = characters.make(name)
        character.create_root_joints(arena.attach(character))
        physics = mjcf.Physics.from_mjcf_model(arena.mjcf_model)
        model, data = physics.model.ptr, physics.data.ptr
        model.geom_size[model.geom_type == mujoco.mjtGeom.mjGEOM_BOX] = 10.0
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_MIDPHASE
        mujoco.mj_setConst(model, mujoco.MjData(model))
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        geoms = [[model.geom(g).name.removeprefix(f'{name}/') for g in pair] for pair in
                 data.contact.geom]  # fmt: skip
        return {frozenset(pair) for pair in geoms}

    @parameterized.parameters(*NAMES)
    def test_self_collision_pairs(self, name):
        pairs = {pair for pair in self.touching(name) if 'floor' not in pair}
        self.assertEqual(pairs, set(map(frozenset, SELF_COLLISIONS[name])))
        self.assertLen(pairs, FIGURES[name].pairs)

    @parameterized.parameters(*NAMES)
    def test_every_link_collides_with_the_ground(self, name):
        links = characters.CHARACTERS[name].links
        floor = {next(iter(p - {'floor'})) for p in self.touching(name) if 'floor' in p}
        self.assertEqual(floor, set(links))
        solid = [geom.name for geom in characters.make(name).collision_geoms]
        self.assertCountEqual(solid, links)

    @parameterized.parameters(*NAMES)
    def test_friction_and_what_is_drawn(self, name):
        model, _ = alone(name)
        boxes, looks = model.geom_group == 3, model.geom_group == 0
        np.testing.assert_allclose(model.geom_friction[boxes, 0], 0.81)
        np.testing.assert_array_equal(model.geom_condim[boxes], 3)
        self.assertGreaterEqual(looks.sum(), len(JOINTS[name]))
        self.assertFalse(model.geom_contype[looks].any())
        self.assertFalse(model.geom_conaffinity[looks].any())

    @parameterized.parameters(*NAMES)
    def test_cameras(self, name):
        model, _ = alone(name)
        cameras = {model.camera(i).name for i in range(model.ncam)}
        self.assertEqual(cameras, {'side', 'front', 'back', 'above'})

    @parameterized.parameters(*NAMES)
    def test_left_and_right_have_their_own_colours(self, name):
        """The right side is the lighter one."""
        model, _ = alone(name)
        for right, left in characters.CHARACTERS[name].mirror:
            geoms = (model.geom(f'{link}_look') for link in (right, left))
            light, dark = (model.mat_rgba[geom.matid[0], :3].sum() for geom in geoms)
            self.assertGreater(light, dark + 0.3)


class OwnArenaTest(parameterized.TestCase):
    """A character works in any composer arena."""

    def place(self, name, model, **options):
        arena = users_arena()
        character = characters.make(name)
        character.create_root_joints(arena.attach(character))
        actuation.add(character, model, TIMESTEP, **options)
        physics = mjcf.Physics.from_mjcf_model(arena.mjcf_model)
        physics.named.data.qpos[f'{name}/root/'][2] = FIGURES[name].height + 0.001
        physics.forward()
        return character, physics

    @parameterized.parameters(*NAMES)
    def test_root_is_one_free_joint(self, name):
        arena = users_arena()
        character = characters.make(name)
        joints = character.create_root_joints(arena.attach(character))
        self.assertLen(joints, 1)
        physics = mjcf.Physics.from_mjcf_model(arena.mjcf_model)
        root = physics.model.ptr.joint(f'{name}/root/')
        self.assertEqual(root.type[0], mujoco.mjtJoint.mjJNT_FREE)
        self.assertEqual((root.qposadr[0], root.dofadr[0]), (0, 0))
        np.testing.assert_array_equal(physics.model.dof_damping[:6], 0)
        np.testing.assert_array_equal(physics.model.dof_armature[:6], 0)
        degrees = int(character.dofs.sum())
        self.assertEqual(degrees, FIGURES[name].sizes[0])
        self.assertEqual(physics.model.nv, 6 + degrees)
        self.assertEqual(physics.model.nq, 7 + degrees + int(character.spherical.sum()))
        character.set_pose(physics, (1, 2, 3), quaternion_of((0, 0, 0.5)))
        physics.forward()
        np.testing.assert_allclose(physics.named.data.xpos[f'{name}/root'], (1, 2, 3))

    @parameterized.parameters('biped3d', 'biped3d_mocap', 'biped3d_full_mocap')
    def test_stands_for_a_moment(self, name):
        _, physics = self.place(name, 'position')
        physics.step(100)
        height = physics.named.data.xpos[f'{name}/root', 'z']
        self.assertAlmostEqual(height, FIGURES[name].height, delta=0.01)

    @parameterized.parameters(*NAMES)
    def test_falls_and_its_contact_forces_equal_its_weight(self, name):
        _, physics = self.place(name, 'torque')
        model, data = physics.model.ptr, physics.data.ptr
        data.qvel[:2] = 0.3, 0.2
        physics.step(6 * 300)
        self.assertLess(data.body(f'{name}/root').xpos[2], 0.5 * FIGURES[name].height)
        forces, force = [], np.zeros(6)
        for _ in range(300):
            mujoco.mj_step(model, data)
            vertical = 0.0
            for i, contact in enumerate(data.contact):
                if 'floor' in (model.geom(g).name for g in contact.geom):
                    mujoco.mj_contactForce(model, data, i, force)
                    vertical += force[0]
            forces.append(vertical)
        weight = FIGURES[name].mass * GRAVITY
        self.assertAlmostEqual(np.mean(forces), weight, delta=0.02 * weight)
        self.assertGreater(heights(model, data)[0], -0.01)

    def test_two_characters_in_one_arena(self):
        arena = users_arena()
        for i in range(2):
            spec = characters.CHARACTERS['biped3d_mocap']
            character = characters.Character(spec, name=f'walker_{i}')
            character.create_root_joints(arena.attach(character))
            actuation.add(character, 'position', TIMESTEP)
        physics = mjcf.Physics.from_mjcf_model(arena.mjcf_model)
        self.assertEqual((physics.model.nq, physics.model.nv), (2 * 29, 2 * 23))
        self.assertEqual((physics.model.nu, physics.model.ptr.nactuator), (2 * 17, 2 * 7))


class PlanarTaskTest(parameterized.TestCase):
    """Planar tasks reject spatial characters."""

    @parameterized.parameters(
        ({'task': 'gait'}, "'biped3d_mocap'"),
        ({'clip': 'biped2d_walk'}, "'biped2d_walk'.*free root"),
        ({'terrain': 'gaps'}, "'biped3d_mocap'.*'gaps'|'gaps'.*'biped3d_mocap'"),
        ({'actuation': 'muscle'}, "'biped3d_mocap' has no muscles"),
    )
    def test_planar_tasks_reject_spatial_characters(self, options, message):
        with self.assertRaisesRegex(ValueError, message):
            suite.build('biped3d_mocap', **options)


class ActionMapTest(parameterized.TestCase):
    """The map from actions to controls."""

    @parameterized.product(name=NAMES, model=('torque', 'velocity', 'position'))
    def test_three_actions_for_every_ball_joint(self, name, model):
        mapping = Floating(name, model).map
        self.assertLen(mapping, FIGURES[name].sizes[0])
        self.assertLen(set(mapping.names), len(mapping))
        expected = [
            each
            for joint, row in JOINTS[name].items()
            for each in ([f'{joint}_{axis}' for axis in 'xyz'] if is_ball(row[5]) else [joint])
        ]
        self.assertEqual(mapping.names, tuple(expected))
        self.assertEqual(
            mapping.actuators, tuple(JOINTS[name]) if model == 'position' else mapping.names
        )
        self.assertFalse(mapping.action_offset.any())
        small = 0.5 * np.random.default_rng(0).uniform(-1, 1, (5, len(mapping)))
        control = mapping.control(small)
        np.testing.assert_allclose(control, mapping.action_scale * small)
        np.testing.assert_allclose(mapping.action(control), small, atol=1e-12)
        for action, row in zip(small, control, strict=True):
            np.testing.assert_array_equal(
                mapping.control(action), row
            )  # equal alone and in a batch
        far = mapping.control(np.full(len(mapping), 9.0))
        np.testing.assert_array_equal(far, mapping.control(np.ones(len(mapping))))

    @parameterized.parameters(
        ('torque', 'torque', 'N m'), ('velocity', 'target velocity', 'rad/s'),
        ('position', 'target rotation vector', 'rad'),
    )  # fmt: skip
    def test_controls_are_an_affine_map_of_actions(self, model, quantity, unit):
        mapping = Floating('biped3d', model).map
        self.assertEqual((mapping.quantity, mapping.unit), (quantity, unit))

    @parameterized.parameters(*NAMES)
    def test_largest_actions_reach_their_limits(self, name):
        reach = {
            model: dict(zip(mapping.names, mapping.action_scale, strict=True))
            for model in ('torque', 'velocity', 'position')
            for mapping in (Floating(name, model).map,)
        }
        for joint, (_, limit, *_, limits) in JOINTS[name].items():
            for part in (f'{joint}_x', f'{joint}_z') if is_ball(limits) else (joint,):
                self.assertAlmostEqual(reach['torque'][part], 0.75 * limit)
                self.assertAlmostEqual(reach['velocity'][part], 10 * np.pi)
                rigid = max(np.abs(np.ravel([axis for axis in limits if axis is not None]))) < 0.1
                self.assertAlmostEqual(reach['position'][part], 0.04 if rigid else 1.5)

    def test_action_offset_and_action_scale(self):
        rng = np.random.default_rng(0)
        action_offset, reach = rng.uniform(-0.2, 0.2, 17), rng.uniform(0.5, 1, 17)
        mapping = Floating(
            'biped3d', 'position', action_offset=action_offset, action_scale=reach
        ).map
        np.testing.assert_allclose(mapping.control(-np.ones(17)), action_offset - reach)
        mapping = Floating('biped3d', 'position', action_scale=1.0).map
        np.testing.assert_array_equal(mapping.action_scale, 1.0)
        for options in (
            {'action_offset': np.zeros(7)},
            {'action_scale': [1.0] * 7},
            {'action_scale': 0},
        ):
            with self.assertRaises(ValueError):
                Floating('biped3d', 'position', **options)

    def test_working_posture_of_a_ball_joint(self):
        spec = characters.CHARACTERS['biped3d']
        joints = dict(spec.joints)
        joints['torso'] = dataclasses.replace(joints['torso'], target=(0.1, -0.2, 0.3))
        joints['left_knee'] = dataclasses.replace(joints['left_knee'], target=-0.5)
        character = characters.make(dataclasses.replace(spec, joints=joints))
        mapping = actuation.add(character, 'position', TIMESTEP)
        action_offset = dict(zip(mapping.names, mapping.action_offset, strict=True))
        self.assertEqual([action_offset[f'torso_{axis}'] for axis in 'xyz'], [0.1, -0.2, 0.3])
        self.assertEqual((action_offset['left_knee'], action_offset['left_hip_x']), (-0.5, 0))

    @parameterized.parameters(*NAMES)
    def test_torques_are_clamped_by_their_norm(self, name):
        mapping = Floating(name, 'torque').map
        action = np.random.default_rng(1).uniform(-1, 1, (200, len(mapping)))
        control = mapping.control(action)
        affine = mapping.action_scale * action
        first = 0
        clamped = 0
        for _, limit, *_, limits in JOINTS[name].values():
            part = slice(first, first + (3 if is_ball(limits) else 1))
            first = part.stop
            norm = np.linalg.norm(affine[:, part], axis=1, keepdims=True)
            expected = affine[:, part] * np.minimum(1, limit / norm)
            np.testing.assert_allclose(control[:, part], expected)
            clamped += (norm > limit).sum()
        self.assertGreater(clamped, 20)

    def test_no_muscles(self):
        for name in NAMES:
            with self.assertRaisesRegex(ValueError, f"'{name}' has no muscles; these have"):
                actuation.add(characters.make(name), 'muscle', TIMESTEP)


class AngleAxisTest(parameterized.TestCase):
    """The original's form of position actions: angle and axis."""

    def make(self, name):
        return Floating(name, 'position', rotations='angle_axis')

    @parameterized.parameters(*NAMES)
    def test_sizes(self, name):
        body = self.make(name)
        self.assertLen(body.map, FIGURES[name].sizes[1])
        self.assertLen(set(body.map.names), len(body.map))
        self.assertEqual(body.map.actuators, tuple(JOINTS[name]))
        self.assertEqual(body.map.control(np.zeros(len(body.map))).shape, (body.model.nu,))
        self.assertEqual(
            body.map.control(np.zeros((2, 3, len(body.map)))).shape, (2, 3, body.model.nu)
        )
        self.assertEqual(body.model.nu, FIGURES[name].sizes[0])

    @parameterized.parameters(
        # First index, kind, value at action 0 and change per unit of each part.
        ('biped3d', 0, 'torso_angle', 0, 4), ('biped3d', 4, 'right_hip_angle', 0, 10.28),
        ('biped3d', 8, 'right_knee', -1.57, 6.28), ('biped3d', 9, 'right_ankle_angle', 0, 6.28),
        ('biped3d_mocap', 12, 'right_ankle_right', 0.2, 1),
        ('biped3d_mocap', 13, 'left_hip_angle', 0, 10.28),
        ('biped3d_mocap', 17, 'left_knee', -1.57, 6.28),
        ('biped3d_mocap', 21, 'left_ankle_right', 0.2, 1),
        ('biped3d_mocap_run', 5, 'right_hip_forward', 0, 1),
        ('biped3d_full_mocap', 22, 'right_shoulder_angle', 0, 0.04),
        ('biped3d_full_mocap', 26, 'right_elbow', 0, 0.04),
        ('biped3d_full_mocap', 35, 'left_elbow', 0, 0.04),
        ('biped3d_full_mocap', 40, 'neck_angle', 0, 0.04),
        ('biped3d_full_mocap', 44, 'head', 0, 0.04),
        ('biped3d_simbicon', 0, 'right_hip_angle', 0, 4.2),
        ('biped3d_simbicon', 4, 'right_knee', -1.25, 5),
        ('biped3d_simbicon', 5, 'right_ankle_angle', 0, 3.14),
    )  # fmt: skip
    def test_map_of_the_original(self, name, i, part, zero, per_unit):
        mapping = self.make(name).map
        self.assertEqual(mapping.names[i], part)
        self.assertAlmostEqual(mapping.action_offset[i], zero)
        self.assertAlmostEqual(mapping.action_scale[i], per_unit)

    def test_controls_are_rotations_about_normalised_axes(self):
        """Against the definition: theta about a normalised axis, in the source's frame."""
        mapping = self.make('biped3d_mocap').map
        action = np.random.default_rng(5).uniform(-1, 1, (40, 22))
        control = mapping.control(action)
        for given, got in zip(action, control, strict=True):
            vectors = []
            for first, reach in ((0, 4), (4, 10.28), (9, 6.28), (13, 10.28), (18, 6.28)):
                axis = given[first + 1 : first + 4] + np.array([0, 0, 0.2])
                vectors.append(reach * given[first] * to_mujoco(axis) / np.linalg.norm(axis))
            torso, right_hip, right_ankle, left_hip, left_ankle = vectors
            knees = -1.57 + 6.28 * given[[8, 17]]
            expected = np.concatenate(
                [torso, right_hip, knees[:1], right_ankle, left_hip, knees[1:], left_ankle]
            )
            np.testing.assert_allclose(got, expected)

    def test_positive_angle_swings_forward(self):
        """A positive angle about the axis to the right lifts the front, as in the plane."""
        body = self.make('biped3d')
        action = np.zeros(22)
        action[4] = 0.5 / 10.28  # the axis is to the right at action 0
        body.pose(body.map.control(action))
        mujoco.mj_kinematics(body.model, body.data)
        knee = body.data.body('biped3d/right_knee').xpos - body.data.body('biped3d/right_hip').xpos
        np.testing.assert_allclose(knee, 0.352 * np.array([np.sin(0.5), 0, -np.cos(0.5)]))

    def test_axis_of_length_zero_is_the_one_to_the_right(self):
        mapping = self.make('biped3d').map
        action = np.zeros((2, 22))
        action[0, :4] = 0.25, 0, 0, -0.2
        control = mapping.control(action)
        np.testing.assert_allclose(control[0, :3], (0, -1, 0))
        np.testing.assert_array_equal(control[1, :3], 0)
        np.testing.assert_array_equal(mapping.control(action[0])[:3], control[0, :3])

    @parameterized.parameters(*NAMES)
    def test_action_inverts_control(self, name):
        mapping = self.make(name).map
        rng = np.random.default_rng(6)
        target = np.array([random_targets(name, rng) for _ in range(20)])
        target[0] = 0
        action = mapping.action(target)
        self.assertLessEqual(np.abs(action).max(), 1)
        np.testing.assert_allclose(mapping.control(action), target, atol=1e-12)
        np.testing.assert_allclose(mapping.action(target[1]), action[1])

    def test_same_target_by_both_forms(self):
        """A turn of more than half a revolution is the same orientation as the shorter one."""
        by_axis, by_vector = self.make('biped3d'), Floating('biped3d', 'position')
        action = np.zeros(22)
        action[4:8] = 0.9, 0.3, -0.5, 0.2  # 9.25 rad
        vector = by_axis.map.control(action)[3:6]
        turn = quaternion.rotation_vector(quaternion_of(vector))
        self.assertLess(np.linalg.norm(turn), np.pi)
        control = np.zeros(17)
        control[3:6] = turn
        by_axis.act(action)
        by_vector.data.ctrl[by_vector.controls] = control
        for body in (by_axis, by_vector):
            body.forward()
        torques = (body.data.qfrc_actuator[body.dofs][3:6] for body in (by_axis, by_vector))
        np.testing.assert_allclose(*torques, atol=1e-9)

    def test_invalid_arguments_are_rejected(self):
        for options in ({'action_offset': np.zeros(22)}, {'action_scale': 1.0}):
            with self.assertRaisesRegex(ValueError, 'do not pass action_offset'):
                Floating('biped3d', 'position', rotations='angle_axis', **options)
        with self.assertRaisesRegex(ValueError, "unknown description of rotations 'axis'"):
            Floating('biped3d', 'position', rotations='axis')

    def test_planar_character(self):
        """Without ball joints it is the affine map of the original."""
        mapping = actuation.add(
            characters.make('hopper'), 'position', TIMESTEP, rotations='angle_axis'
        )
        np.testing.assert_allclose(mapping.control(np.ones(2)), (6.28, 0.2))


class ServoTest(parameterized.TestCase):
    """Forces of the compiled actuators."""

    @parameterized.parameters(*NAMES)
    def test_position_law(self, name):
        body = Floating(name, 'position')
        rng = np.random.default_rng(7)
        pose, target = (random_targets(name, rng, 0.9) for _ in range(2))
        rate = rng.uniform(-2, 2, len(target))
        body.pose(pose)
        body.data.qvel[body.dofs] = rate
        body.data.ctrl[body.controls] = target
        body.forward()
        torques = body.split(body.data.qfrc_actuator[body.dofs])
        passive = body.split(-body.data.qfrc_damper[body.dofs] / rate)
        clamped = 0
        for figures, *parts in zip(
            JOINTS[name].values(), *map(body.split, (pose, target, rate)), torques, passive,
            strict=True,
        ):  # fmt: skip
            here, there, speed, torque, damping = parts
            _, limit, kp, kd, *_ = figures
            if len(here) == 3:
                back = quaternion.conjugate(quaternion_of(here))
                error = quaternion.rotation_vector(
                    quaternion.multiply(back, quaternion_of(there))
                )  # in the link's axes
            else:
                error = there - here
            # A fiftieth of the torque limit acts outside the clamp, the rest of kd inside.
            np.testing.assert_allclose(damping, limit / 50)
            inside = kp * error - (kd - limit / 50) * speed
            norm = np.linalg.norm(inside)
            np.testing.assert_allclose(torque, inside * min(1, limit / norm), atol=1e-9)
            clamped += norm > limit
        self.assertGreater(clamped, 0)

    @parameterized.parameters(*NAMES)
    def test_velocity_law(self, name):
        body = Floating(name, 'velocity')
        rng = np.random.default_rng(8)
        rate, target = rng.uniform(-9, 9, (2, len(body.map)))
        body.pose(random_targets(name, rng, 0.9))
        body.data.qvel[body.dofs] = rate
        body.act(body.map.action(target))
        body.forward()
        table = JOINTS[name].values()
        kd, limit = (np.repeat([row[i] for row in table], body.sizes) for i in (3, 1))
        damping = limit / 50
        np.testing.assert_allclose(-body.data.qfrc_damper[body.dofs] / rate, damping)
        # Each axis of a ball joint has its own clamp: the norm then stays within the limit.
        clamp = np.where(np.repeat(body.sizes, body.sizes) == 3, limit / np.sqrt(3), limit)
        torque = body.data.qfrc_actuator[body.dofs]
        free = np.abs(torque) < 0.99 * clamp
        self.assertTrue(free.any())
        np.testing.assert_allclose(
            (torque + body.data.qfrc_damper[body.dofs])[free], (kd * (target - rate))[free]
        )
        np.testing.assert_allclose(
            torque, np.clip(kd * target - (kd - damping) * rate, -clamp, clamp), atol=1e-9
        )

    @parameterized.parameters(*NAMES)
    def test_torques_are_in_the_axes_of_the_link(self, name):
        body = Floating(name, 'torque')
        rng = np.random.default_rng(9)
        body.pose(random_targets(name, rng, 0.9))
        action = 0.5 * rng.uniform(-1, 1, len(body.map))
        body.act(action)
        body.forward()
        torque = body.map.action_scale * action
        np.testing.assert_allclose(body.data.qfrc_actuator[body.dofs], torque)

    @parameterized.product(name=NAMES, model=('torque', 'velocity', 'position'))
    def test_armature(self, name, model):
        body = Floating(name, model)
        for joint, part in zip(
            JOINTS[name], body.split(body.model.dof_armature[body.dofs]), strict=True
        ):
            _, limit, _, kd, *_ = JOINTS[name][joint]
            least = (kd - limit / 50) * TIMESTEP / 2 if model == 'velocity' else 0
            expected = max(ARMATURE.get((name, joint), 0.01), least)
            np.testing.assert_allclose(part, expected, err_msg=joint)

    @parameterized.parameters(*NAMES)
    def test_position_control_reaches_its_target(self, name):
        body = Floating(name, 'position', root=False)
        target = random_targets(name, np.random.default_rng(10), 0.8)
        body.data.ctrl[body.controls] = target
        body.step(3)
        np.testing.assert_allclose(body.error(target), 0, atol=1e-3)

    @parameterized.product(name=NAMES, rotations=actuation.ROTATIONS)
    def test_actions_reach_their_targets(self, name, rotations):
        body = Floating(name, 'position', root=False, rotations=rotations)
        target = random_targets(name, np.random.default_rng(11), 0.8)
        body.act(body.map.action(target))
        # Rotation vectors reach 1.5 rad about every axis by default.
        low, high = (
            body.map.action_offset - body.map.action_scale,
            body.map.action_offset + body.map.action_scale,
        )
        if rotations == 'vector':
            target = np.clip(target, low, high)
        body.step(3)
        np.testing.assert_allclose(body.error(target), 0, atol=1e-3)

    def test_velocity_control_reaches_its_target(self):
        body = Floating('biped3d', 'velocity', root=False)
        action = np.zeros(len(body.map))
        i = body.map.names.index('torso_z')
        action[i] = 0.05
        body.act(action)
        body.step(0.4)
        self.assertAlmostEqual(body.data.qvel[body.dofs[i]], np.pi / 2, delta=0.03)

    @parameterized.parameters(*((name, seed) for name in NAMES for seed in range(2)))
    def test_random_targets(self, name, seed):
        """Two seconds of new targets at every control step, then one second of the last."""
        body = Floating(name, 'position')
        rng = np.random.default_rng(seed)
        fastest, strongest = 0.0, np.zeros(len(JOINTS[name]))
        for _ in range(60):
            body.data.ctrl[body.controls] = random_targets(name, rng, 0.95)
            for _ in range(10):
                body.step()
                fastest = max(fastest, body.speed)
                np.maximum(strongest, body.norms, out=strongest)
        body.step(1)
        self.assertLess(body.speed, 1)
        self.assertBetween(fastest, 15, 40)
        self.assertLessEqual((strongest / body.character.torque_limits).max(), 1 + 1e-9)
        self.assertFalse(body.data.warning.number.any())

    @parameterized.parameters(*NAMES)
    def test_velocity_control_comes_to_rest(self, name):
        """Clamps of single axes do not make thin limbs oscillate."""
        body = Floating(name, 'velocity')
        rng = np.random.default_rng(0)
        for _ in range(60):
            body.act(rng.uniform(-1, 1, len(body.map)))
            body.step(1 / 30)
        body.act(np.zeros(len(body.map)))
        body.step(1)
        self.assertLess(body.speed, 1)

    @parameterized.product(name=NAMES, model=('torque', 'velocity', 'position'))
    def test_torque_limits_hold_under_extreme_actions(self, name, model):
        arena = users_arena()
        character = characters.make(name)
        character.create_root_joints(arena.attach(character))
        mapping = actuation.add(character, model, TIMESTEP)
        physics = mjcf.Physics.from_mjcf_model(arena.mjcf_model)
        compiled, data = physics.model.ptr, physics.data.ptr
        data.qpos[2] = FIGURES[name].height + 0.001
        ids = [compiled.joint(joint.full_identifier).id for joint in character.joints]
        first, limits = compiled.jnt_dofadr[ids], character.torque_limits
        rng, highest = np.random.default_rng(4), np.zeros(len(ids))
        for _ in range(6):
            data.qvel[6:] += rng.uniform(-20, 20, compiled.nv - 6)
            for _ in range(10):
                data.ctrl[:] = mapping.control(rng.choice((-1.0, 1.0), len(mapping)))
                for _ in range(10):
                    mujoco.mj_step(compiled, data)
                    for i, (dof, size) in enumerate(zip(first, character.dofs, strict=True)):
                        norm = np.linalg.norm(data.qfrc_actuator[dof : dof + size])
                        highest[i] = max(highest[i], norm)
        np.testing.assert_array_less(highest, limits * (1 + 1e-9))
        self.assertGreater((highest / limits).max(), 0.99)  # the limits are reached
        self.assertFalse(data.warning.number.any())

    @parameterized.parameters(*NAMES)
    def test_joint_limits_hold(self, name):
        body = Floating(name, 'position', root=False)
        limits = body.character.joint_ranges
        rng = np.random.default_rng(12)
        for _ in range(4):
            body.act(rng.choice((-1.0, 1.0), len(body.map)))
            body.step(1)
            for adr, (low, high), size in zip(body.qpos, limits, body.sizes, strict=True):
                if size == 3:
                    angle = np.linalg.norm(
                        quaternion.rotation_vector(body.data.qpos[adr : adr + 4])
                    )
                    self.assertLess(angle, high + 0.05)
                else:
                    self.assertBetween(body.data.qpos[adr], low - 0.05, high + 0.05)


if __name__ == '__main__':
    absltest.main()
