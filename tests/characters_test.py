"""Tests of planar characters: properties from the original's character files, and physics."""

import dataclasses

import mujoco
import numpy as np
from absl.testing import absltest, parameterized
from dm_control import composer, mjcf

from trl_suite import actuation, characters

GRAVITY = 9.81  # m/s^2; of MuJoCo's default, which a user's own arena has

# link: mass kg, torque limit N m, kp N m/rad, kd N m s/rad, reward weight, effective limits rad;
# of the hopper's leg, which slides, N and m instead of N m and rad.
FREE = (-np.inf, np.inf)
BIPED_LEG = {
    'hip': (2, 300, 300, 30, 0.3, (-2.57, 2.57)),
    'knee': (1.5, 300, 300, 30, 0.3, (-3.14, 0)),
    'ankle': (0.5, 100, 100, 10, 0.2, (-1.57, 1.57)),
}
SIMBICON_LEG = {
    'hip': (5, 200, 200, 20, 0.3, (-0.37, 2.87)),
    'knee': (2.5, 200, 200, 20, 0.3, (-3, 0)),
    'ankle': (0.5, 200, 150, 15, 0.2, (-0.57, 1)),
}
FULL_LEG = {
    'hip': (5, 150, 200, 20, 0.3, (-0.5, 2.57)),
    'knee': (2.5, 125, 200, 20, 0.3, (-3, 0)),
    'ankle': (0.5, 100, 100, 10, 0.2, (-1.57, 1.57)),
}
FULL_ARM = {
    'shoulder': (1.5, 100, 150, 15, 0.3, (-1.2, 3)),
    'forearm': (0.75, 75, 100, 10, 0.3, (0, 2.8)),
}
RAPTOR_LEG = {
    'hip': (2, 300, 300, 30, 1, (-1.57, 1.57)),
    'knee': (1.5, 300, 300, 30, 0.5, (-3.14, 0)),
    'ankle': (1, 200, 250, 25, 0.5, (0, 3.14)),
    'toe': (0.5, 100, 100, 10, 0.5, (-1.57, 1.57)),
}


def sided(limb):
    return {f'{side}_{name}': row for side in ('right', 'left') for name, row in limb.items()}


DOG_JOINTS = {
    'spine0': (2, 300, 200, 20, 0.5, (-0.96, 2.18)),
    'spine1': (2, 300, 200, 20, 0.5, (-1.57, 1.57)),
    'spine2': (2, 300, 200, 20, 0.5, (-1.57, 1.57)),
    'spine3': (2.67, 300, 200, 20, 0.5, (-1.57, 1.57)),
    'torso': (5.78, 300, 200, 20, 1, (-1.57, 1.57)),
    'neck0': (0.85, 200, 50, 5, 0.2, (-1.57, 1.57)),
    'neck1': (0.85, 200, 50, 5, 0.2, (-1.57, 1.57)),
    'head': (1.54, 200, 50, 5, 0.2, (-1.57, 1.57)),
    **{f'tail{i}': (0.25, 100, 4, 0.4, 0.001, FREE) for i in range(4)},
    'shoulder': (2.75, 300, 160, 16, 1, (-1.57, 1.57)),
    'elbow': (1.33, 300, 80, 8, 1, (0, 3.14)),
    'wrist': (1, 200, 80, 8, 1, (0, 3.14)),
    'finger': (1, 100, 80, 8, 1, (-1.57, 1.57)),
    'hip': (2.9, 300, 130, 13, 1, (-0.96, 2.18)),
    'knee': (2, 300, 50, 5, 1, (-3.14, 0)),
    'ankle': (1, 200, 50, 5, 1, (0, 3.14)),
    'toe': (1, 100, 50, 5, 1, (-1.57, 1.57)),
}
JOINTS = {
    'dog': DOG_JOINTS,
    # Weights are not given in the goat's file: all 1.
    'goat': {name: (*row[:4], 1, row[5]) for name, row in DOG_JOINTS.items()},
    'raptor': {
        'spine0': (1, 300, 200, 20, 0.5, (-1.57, 1.57)),
        'spine1': (0.5, 300, 200, 20, 0.5, (-1.57, 1.57)),
        'spine2': (0.5, 200, 100, 10, 0.5, (-1.57, 1.57)),
        'spine3': (0.5, 200, 100, 10, 0.5, (-1.57, 1.57)),
        'head': (1, 200, 100, 10, 0.5, (-1.57, 1.57)),
        'tail0': (2, 100, 100, 10, 0.25, FREE),
        'tail1': (1.35, 100, 50, 5, 0.25, FREE),
        'tail2': (0.5, 100, 50, 5, 0.25, FREE),
        'tail3': (0.3, 100, 50, 5, 0.25, FREE),
        'tail4': (0.3, 100, 50, 5, 0.25, FREE),
        **sided(RAPTOR_LEG),
    },
    'biped2d': sided(BIPED_LEG),
    'biped2d_simbicon': sided(SIMBICON_LEG),
    'biped2d_full': {
        **sided(FULL_LEG),
        **sided(FULL_ARM),
        'neck': (3.5, 50, 100, 10, 0.3, (-0.57, 0.57)),
    },
    'hopper': {
        'hip': (0.2, 2500, 200, 20, 0.5, (-1.57, 1.57)),
        'leg': (0.2, 180, 1000, 20, 0.5, (-0.2, 0.2)),
    },
}
NAMES = tuple(JOINTS)


@dataclasses.dataclass(frozen=True)
class Figures:
    """Whole-body figures in the zero pose, in the source's frame (x forward, y up, z right)."""

    mass: float  # kg
    root_mass: float  # kg
    height: float  # m, root above the sole
    com: tuple[float, float, float]  # m, relative to the root
    inertia: tuple[float, float, float]  # kg m^2, xx yy zz about the com
    fall: str
    effectors: str
    pairs: int  # self-collision pairs


DOG = Figures(
    33.67, 2, 0.6486, (0.29154, -0.12482, 0.0283), (1.42438, 2.73639, 3.99552),
    'root spine0 spine1 spine2 spine3 torso neck0 neck1 head', 'finger toe',
    33,  # 34 in the original; shoulder and wrist would lock in the plane and are excluded
)  # fmt: skip
FIGURES = {
    'dog': DOG,
    'goat': dataclasses.replace(DOG, fall='root spine0'),
    'raptor': Figures(
        32.95, 15, 0.7046, (0.00127, -0.09107, 0), (1.49919, 1.27696, 2.59121),
        'root spine0 spine1 spine2 spine3 head', 'right_toe left_toe', 67,
    ),
    'biped2d': Figures(
        33, 25, 0.7904, (0.00157, 0.05096, 0), (3.14638, 0.27844, 2.93567), 'root',
        'right_ankle left_ankle', 11,
    ),
    'biped2d_simbicon': Figures(
        41, 25, 0.7904, (0.001263, -0.01062, 0), (4.175239, 0.366537, 3.885026), 'root',
        'right_ankle left_ankle', 11,
    ),
    'biped2d_full': Figures(
        49, 25, 0.7904, (0.00106, 0.04252, 0), (5.43552, 0.52145, 4.99070),
        'root right_hip left_hip right_shoulder right_forearm left_shoulder left_forearm neck',
        'right_ankle left_ankle', 19,
    ),
    'hopper': Figures(
        8.4, 8, 0.83, (0, -0.016667, 0), (0.120215, 0.354388, 0.419587), 'root', 'leg', 0
    ),
}  # fmt: skip

# link: parent, joint in the parent's frame, full box size, box centre (x, y, z of the source), m.
LINKS = {
    'dog': {
        'root': (None, (0, 0, 0), (0.1548, 0.1116, 0.126), (0, 0, 0)),
        'spine0': ('root', (0.054, 0.048, 0), (0.0875, 0.1197, 0.127), (0.02375, -0.03, 0)),
        'torso': ('spine3', (0.1082, 0, 0), (0.2385, 0.2349, 0.15), (0.11925, -0.085, 0)),
        'head': ('neck1', (0.0853, 0, 0), (0.1062, 0.2088, 0.12), (0.0531, -0.055, 0)),
        'tail3': ('tail2', (-0.09, 0, 0), (0.09, 0.035, 0.05), (-0.0536, 0, 0)),
        'shoulder': ('torso', (0.156, -0.048, 0.1), (0.0702, 0.2817, 0.06), (0, -0.1142, 0)),
        'finger': ('wrist', (0, -0.1073, 0), (0.11, 0.05, 0.06), (0.03, -0.01, 0)),
        'hip': ('root', (-0.03, -0.018, 0.05), (0.0765, 0.2736, 0.06), (0, -0.114, 0)),
        'toe': ('ankle', (0, -0.1332, 0), (0.11, 0.05, 0.06), (0.03, -0.01, 0)),
    },
    'raptor': {
        'root': (None, (0, 0, 0), (0.2556, 0.2294, 0.126), (0, 0, 0)),
        'spine0': ('root', (0.1058, 0.0777, 0), (0.1736, 0.17, 0.1), (0.0868, -0.05065, 0)),
        'tail0': ('root', (-0.1198, 0.0777, 0), (0.159, 0.1553, 0.1), (-0.048, -0.04125, 0)),
        'tail4': ('tail3', (-0.1252, 0, 0), (0.1692, 0.04, 0.06), (-0.0571, 0.005, 0)),
        'right_hip': ('root', (0, 0, 0.08), (0.0938, 0.3129, 0.065), (0, -0.126, 0)),
        'left_hip': ('root', (0, 0, -0.08), (0.0938, 0.3129, 0.065), (0, -0.126, 0)),
        'left_toe': ('left_ankle', (0, -0.1876, 0), (0.12, 0.05, 0.06), (0.03, -0.03, 0)),
    },
    'biped2d': {
        'root': (None, (0, 0, 0), (0.11, 0.45, 0.278), (0, 0.19, 0)),
        'right_hip': ('root', (0, 0, 0.1), (0.0846, 0.4, 0.08), (0, -0.1745, 0)),
        'left_knee': ('left_hip', (0, -0.352, 0), (0.065, 0.416, 0.06), (0, -0.183, 0)),
        'left_ankle': ('left_knee', (0, -0.391, 0), (0.177, 0.05, 0.08), (0.0518, -0.0224, 0)),
    },
    'biped2d_simbicon': {
        'root': (None, (0, 0, 0), (0.11, 0.45, 0.278), (0, 0.19, 0)),
        'left_hip': ('root', (0, 0, -0.1), (0.0846, 0.4, 0.08), (0, -0.1745, 0)),
        'right_knee': ('right_hip', (0, -0.352, 0), (0.065, 0.416, 0.06), (0, -0.183, 0)),
        'right_ankle': ('right_knee', (0, -0.391, 0), (0.177, 0.05, 0.08), (0.0518, -0.0224, 0)),
    },
    'hopper': {
        'root': (None, (0, 0, 0), (0.7, 0.2, 0.2), (0, 0, 0)),
        'hip': ('root', (0, 0, 0), (0.08, 0.4, 0.21), (0, -0.2, 0)),
        # The capsule's bounding box: radius 0.03, cylinder 0.6 long.
        'leg': ('hip', (0, -0.2, 0), (0.06, 0.66, 0.06), (0, -0.3, 0)),
    },
    'biped2d_full': {
        'root': (None, (0, 0, 0), (0.1, 0.45, 0.278), (0, 0.19, 0)),
        'right_shoulder': ('root', (0, 0.41, 0.18), (0.07, 0.325, 0.08), (0, -0.1545, 0)),
        'left_forearm': ('left_shoulder', (0, -0.31, 0), (0.0546, 0.3, 0.08), (0, -0.145, 0)),
        'neck': ('root', (-0.02, 0.42, 0), (0.1, 0.15, 0.15), (0.02, 0.1, 0)),
    },
}  # fmt: skip
LINKS['goat'] = LINKS['dog']


def to_mujoco(vector):
    """The source's x forward, y up, z right as MuJoCo's x forward, y left, z up."""
    x, y, z = vector
    return np.array([x, -z, y])


def alone(name):
    """The character compiled alone, its root at the origin."""
    physics = mjcf.Physics.from_mjcf_model(characters.make(name).mjcf_model)
    return physics.model.ptr, physics.data.ptr


def half_size(model, link):
    """Half the size of a link's collision geom along its axes."""
    return model.geom_aabb[model.geom(link).id, 3:]


def lowest(model, data):
    """Heights of the lowest points of the geoms that can touch the ground, m."""
    for geom in np.flatnonzero((model.geom_group == 3) & (model.geom_conaffinity > 0)):
        up = np.abs(data.geom_xmat[geom].reshape(3, 3)[2])
        if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_CAPSULE:
            radius, half_length, _ = model.geom_size[geom]
            yield data.geom_xpos[geom, 2] - radius - up[2] * half_length
        else:
            yield data.geom_xpos[geom, 2] - up @ model.geom_size[geom]


def users_arena(timestep=0.002):
    arena = composer.Arena(name='mine')
    arena.mjcf_model.option.timestep = timestep
    arena.mjcf_model.worldbody.add('geom', name='floor', type='plane', size=(0, 0, 1))
    return arena


class FiguresTest(parameterized.TestCase):
    """Bodies are those of the original."""

    def test_all_planar_characters_are_here(self):
        planar = [name for name, spec in characters.CHARACTERS.items() if not spec.spatial]
        self.assertCountEqual(planar, NAMES)

    @parameterized.parameters(*NAMES)
    def test_whole_body(self, name):
        figures = FIGURES[name]
        model, data = alone(name)
        mujoco.mj_forward(model, data)
        self.assertAlmostEqual(model.body_mass.sum(), figures.mass, delta=1e-9)
        np.testing.assert_allclose(data.subtree_com[1], to_mujoco(figures.com), atol=1e-5)
        # The composite inertia of the root body: xx yy zz xy xz yz about the whole body's com.
        xx, yy, zz = figures.inertia
        np.testing.assert_allclose(data.crb[1][:3], (xx, zz, yy), atol=1e-5)
        self.assertAlmostEqual(-min(lowest(model, data)), figures.height, delta=5e-5)

    @parameterized.parameters(*NAMES)
    def test_body_figures_agree(self, name):
        figures, reported = FIGURES[name], characters.body_figures(characters.make(name))
        self.assertAlmostEqual(reported['mass'], figures.mass, delta=1e-9)
        self.assertAlmostEqual(reported['standing_height'], figures.height, delta=5e-5)
        np.testing.assert_allclose(reported['com'], to_mujoco(figures.com), atol=1e-5)
        xx, yy, zz = figures.inertia
        np.testing.assert_allclose(reported['inertia'], (xx, zz, yy), atol=1e-5)

    @parameterized.parameters(*NAMES)
    def test_link_masses_and_solid_box_inertias(self, name):
        """The capsule of the hopper's leg counts as its bounding box, 0.01 m larger all round."""
        model, _ = alone(name)
        masses = {'root': FIGURES[name].root_mass} | {j: r[0] for j, r in JOINTS[name].items()}
        self.assertEqual(model.nbody - 1, len(masses))
        for link, mass in masses.items():
            body = model.body(link)
            self.assertAlmostEqual(body.mass[0], mass, delta=1e-9, msg=link)
            margin = 0.01 if (name, link) == ('hopper', 'leg') else 0
            a, b, c = (2 * (half_size(model, link) + margin)) ** 2
            solid = mass / 12 * np.array([b + c, a + c, a + b])
            np.testing.assert_allclose(np.sort(body.inertia), np.sort(solid), rtol=1e-6)

    @parameterized.parameters(*((n, link) for n in NAMES for link in LINKS[n]))
    def test_geometry_of_a_link(self, name, link):
        parent, joint, size, centre = LINKS[name][link]
        model, _ = alone(name)
        x, y, z = size
        np.testing.assert_allclose(half_size(model, link), (x / 2, z / 2, y / 2), atol=1e-9)
        np.testing.assert_allclose(model.geom(link).pos, to_mujoco(centre), atol=1e-9)
        np.testing.assert_allclose(model.body(link).ipos, to_mujoco(centre), atol=1e-9)
        np.testing.assert_allclose(model.body(link).pos, to_mujoco(joint), atol=1e-9)
        if parent is not None:
            self.assertEqual(model.body(model.body(link).parentid[0]).name, parent)

    @parameterized.parameters('dog', 'goat')
    def test_only_the_pelvis_box_is_rotated(self, name):
        model, data = alone(name)
        mujoco.mj_forward(model, data)
        for link in characters.CHARACTERS[name].links:
            axis = data.geom(link).xmat.reshape(3, 3)[:, 0]  # of the box's length
            pitch = np.arctan2(axis[2], axis[0])
            self.assertAlmostEqual(pitch, 0.61 if link == 'root' else 0, delta=1e-9, msg=link)

    @parameterized.parameters(*NAMES)
    def test_joints(self, name):
        character, table = characters.make(name), JOINTS[name]
        model, _ = alone(name)
        self.assertEqual(tuple(character.spec.joints), tuple(table))  # order is that of the links
        self.assertEqual(character.spec.links, ('root', *table))
        for (joint, spec), figures in zip(
            table.items(), character.spec.joints.values(), strict=True
        ):
            _, limit, kp, kd, weight, limits = spec
            compiled = model.joint(joint)
            slides = (name, joint) == ('hopper', 'leg')
            kind = mujoco.mjtJoint.mjJNT_SLIDE if slides else mujoco.mjtJoint.mjJNT_HINGE
            self.assertEqual(compiled.type[0], kind, joint)
            # Positive lifts the front, or makes the leg longer.
            np.testing.assert_array_equal(compiled.axis, (0, 0, -1) if slides else (0, -1, 0))
            np.testing.assert_allclose(model.jnt_actfrcrange[compiled.id], (-limit, limit))
            self.assertEqual(model.jnt_actfrclimited[compiled.id], 1)
            self.assertEqual((figures.kp, figures.kd, figures.weight), (kp, kd, weight), joint)
            self.assertEqual(bool(model.jnt_limited[compiled.id]), limits != FREE, joint)
            if limits != FREE:
                np.testing.assert_allclose(compiled.range, limits, err_msg=joint)
        np.testing.assert_allclose(character.torque_limits, [row[1] for row in table.values()])
        np.testing.assert_allclose(character.joint_ranges, [row[5] for row in table.values()])

    def test_only_the_leg_of_the_hopper_slides(self):
        slides = {
            (name, joint)
            for name in NAMES
            for joint, prismatic in zip(
                JOINTS[name], characters.make(name).prismatic, strict=True
            )
            if prismatic
        }  # fmt: skip
        self.assertEqual(slides, {('hopper', 'leg')})

    def test_leg_of_the_hopper_slides_along_its_thigh(self):
        model, data = alone('hopper')
        data.joint('hip').qpos[0] = 0.5  # forward
        mujoco.mj_forward(model, data)
        short = data.body('leg').xipos.copy()
        data.joint('leg').qpos[0] = 0.15
        mujoco.mj_forward(model, data)
        slide = data.body('leg').xipos - short
        np.testing.assert_allclose(slide, 0.15 * np.array([np.sin(0.5), 0, -np.cos(0.5)]))

    @parameterized.parameters(
        # The original's state files: x, z, pitch, joints; lowest point and height above it, m.
        ('hopper', (0, 1.214392, -0.00686, 0.012764, 0), 0.384406, 0.932385),
        ('biped2d_simbicon', (0, 0.791, 0, 0, 0, 0, 0, 0, 0), 0.0006, 1.2054),
    )
    def test_initial_state_of_the_original(self, name, pose, bottom, height):
        arena = users_arena()
        character = characters.make(name)
        character.create_root_joints(arena.attach(character))
        physics = mjcf.Physics.from_mjcf_model(arena.mjcf_model)
        physics.data.qpos[:] = pose
        physics.forward()
        model, data = physics.model.ptr, physics.data.ptr
        self.assertAlmostEqual(min(lowest(model, data)), bottom, delta=1e-6)
        root = data.geom(f'{name}/root')
        top = root.xpos[2] + np.abs(root.xmat.reshape(3, 3)[2]) @ model.geom(f'{name}/root').size
        self.assertAlmostEqual(top - bottom, height, delta=2e-6)

    @parameterized.parameters(
        ('dog', 12.604, 'root', 1), ('raptor', 9.75, 'right_hip', 1), ('biped2d', 2.6, 'root', 1),
        ('biped2d_full', 4.1, 'neck', 0.3), ('goat', 21, 'tail0', 1),
        ('biped2d_simbicon', 2.6, 'left_ankle', 0.2), ('hopper', 2, 'leg', 0.5),
    )  # fmt: skip
    def test_reward_weights(self, name, total, link, weight):
        spec = characters.CHARACTERS[name]
        self.assertAlmostEqual(spec.weights.sum(), 1, delta=1e-12)
        self.assertAlmostEqual(spec.weights[spec.links.index(link)], weight / total, delta=1e-12)

    @parameterized.parameters(*NAMES)
    def test_fall_links_and_end_effectors(self, name):
        spec, figures = characters.CHARACTERS[name], FIGURES[name]
        self.assertCountEqual(spec.fall_links, figures.fall.split())
        self.assertEqual(spec.end_effectors, tuple(figures.effectors.split()))
        effectors = characters.make(name).end_effectors
        self.assertEqual(tuple(body.name for body in effectors), spec.end_effectors)
        self.assertNotEmpty(spec.description)

    @parameterized.parameters(
        ('biped2d_simbicon', 'right_ankle left_ankle right_knee left_knee'), ('hopper', 'leg')
    )
    def test_what_touches_the_ground_without_a_stumble(self, name, links):
        self.assertCountEqual(characters.CHARACTERS[name].stumble_exempt, links.split())

    @parameterized.parameters(
        ('raptor', 4), ('biped2d', 3), ('biped2d_full', 5), ('dog', 0), ('biped2d_simbicon', 3),
        ('hopper', 0),
    )  # fmt: skip
    def test_mirror_pairs(self, name, count):
        spec = characters.CHARACTERS[name]
        self.assertLen(spec.mirror, count)
        for right, left in spec.mirror:
            self.assertEqual(right.removeprefix('right'), left.removeprefix('left'))
            self.assertIn(left, spec.joints)


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
    def test_number_of_self_collision_pairs(self, name):
        pairs = {pair for pair in self.touching(name) if 'floor' not in pair}
        self.assertLen(pairs, FIGURES[name].pairs)

    @parameterized.parameters(*NAMES)
    def test_ground_touches_all_but_tails_of_dog_and_goat(self, name):
        spec = characters.CHARACTERS[name]
        ghosts = {f'tail{i}' for i in range(4)} if name in ('dog', 'goat') else set()
        floor = {next(iter(p - {'floor'})) for p in self.touching(name) if 'floor' in p}
        self.assertEqual(floor, set(spec.links) - ghosts)
        solid = [geom.name for geom in characters.make(name).collision_geoms]
        self.assertCountEqual(solid, floor)

    @parameterized.parameters(
        ('dog', 'spine0', 'head', True), ('dog', 'shoulder', 'finger', True),
        ('dog', 'root', 'spine0', False), ('dog', 'torso', 'shoulder', False),
        ('dog', 'elbow', 'knee', False), ('dog', 'tail0', 'tail2', False),
        ('dog', 'tail3', 'hip', False),
        ('raptor', 'tail0', 'tail2', True), ('raptor', 'head', 'tail4', True),
        ('raptor', 'right_toe', 'left_toe', True), ('raptor', 'root', 'right_knee', False),
        ('biped2d', 'right_knee', 'left_knee', True), ('biped2d', 'root', 'right_ankle', False),
        ('biped2d_simbicon', 'right_hip', 'left_ankle', True), ('hopper', 'root', 'leg', False),
        ('biped2d_full', 'right_forearm', 'neck', True),
        ('biped2d_full', 'right_forearm', 'right_hip', False),
        ('biped2d_full', 'right_shoulder', 'right_forearm', False),
    )  # fmt: skip
    def test_links_that_collide_with_each_other(self, name, a, b, touch):
        self.assertEqual(frozenset((a, b)) in self.touching(name), touch)

    @parameterized.parameters(*NAMES)
    def test_friction(self, name):
        model, _ = alone(name)
        boxes = np.flatnonzero(model.geom_group == 3)
        # The original multiplies 0.9 by 0.9, MuJoCo takes the larger of the two.
        np.testing.assert_allclose(model.geom_friction[boxes, 0], 0.81)
        np.testing.assert_array_equal(model.geom_condim[boxes], 3)

    @parameterized.parameters(*NAMES)
    def test_visual_geoms_have_no_mass_and_no_contacts(self, name):
        model, _ = alone(name)
        looks = model.geom_group == 0
        self.assertGreaterEqual(looks.sum(), len(JOINTS[name]))
        self.assertFalse(model.geom_contype[looks].any())
        self.assertFalse(model.geom_conaffinity[looks].any())
        for geom in characters.make(name).mjcf_model.find_all('geom'):
            if geom.name not in characters.CHARACTERS[name].links:
                self.assertEqual(geom.mass or geom.dclass.geom.mass, 0, geom.name)

    @parameterized.parameters('dog', 'goat')
    def test_two_legs_are_drawn_as_four(self, name):
        model, data = alone(name)
        mujoco.mj_forward(model, data)
        for links, apart in (
            (('shoulder', 'elbow', 'wrist', 'finger'), 0.2), (('hip', 'knee', 'ankle', 'toe'), 0.12)
        ):  # fmt: skip
            for link in links:
                looks = (model.geom_group == 0) & (model.geom_bodyid == model.body(link).id)
                lateral = np.unique(data.geom_xpos[looks, 1].round(6))
                simulated = data.geom(link).xpos[1]
                # The simulated leg is the right one: y points left.
                np.testing.assert_allclose(lateral, (simulated, simulated + apart), atol=1e-6)


class OwnArenaTest(parameterized.TestCase):
    """A character works in any composer arena."""

    def place(self, name, model, timestep=1 / 600):
        arena = users_arena(timestep)
        character = characters.make(name)
        character.create_root_joints(arena.attach(character))
        actuation.add(character, model, timestep)
        physics = mjcf.Physics.from_mjcf_model(arena.mjcf_model)
        physics.named.data.qpos[f'{name}/root_z/'] = FIGURES[name].height + 0.001
        physics.forward()
        return character, physics

    @parameterized.parameters(*NAMES)
    def test_falls_and_its_contact_forces_equal_its_weight(self, name):
        _, physics = self.place(name, 'torque')
        if name == 'hopper':
            physics.named.data.qvel[f'{name}/root_pitch/'] = 0.5  # it would balance on its point
        physics.step(6 * 600)
        model, data = physics.model.ptr, physics.data.ptr
        self.assertLess(data.body(f'{name}/root').xpos[2], 0.5 * FIGURES[name].height)
        forces, force = [], np.zeros(6)
        for _ in range(600):
            mujoco.mj_step(model, data)  # not physics.step, which leaves new contacts, old forces
            vertical = 0.0
            for i, contact in enumerate(data.contact):
                if 'floor' in (model.geom(g).name for g in contact.geom):
                    mujoco.mj_contactForce(model, data, i, force)
                    vertical += force[0]
            forces.append(vertical)
        weight = FIGURES[name].mass * GRAVITY
        self.assertAlmostEqual(np.mean(forces), weight, delta=0.02 * weight)
        self.assertGreater(min(lowest(model, data)), -0.01)

    def test_biped_stands(self):
        _, physics = self.place('biped2d', 'position')
        physics.step(300)
        height = physics.named.data.xpos['biped2d/root', 'z']
        self.assertAlmostEqual(height, FIGURES['biped2d'].height, delta=0.01)

    def test_two_characters_in_one_arena(self):
        arena = users_arena()
        for i in range(2):
            character = characters.Character(characters.CHARACTERS['biped2d'], name=f'walker_{i}')
            character.create_root_joints(arena.attach(character))
        physics = mjcf.Physics.from_mjcf_model(arena.mjcf_model)
        self.assertEqual(physics.model.nq, 2 * 9)

    def test_unknown_character(self):
        with self.assertRaisesRegex(ValueError, "unknown character 'rapter'.*'raptor'"):
            characters.make('rapter')

    def test_spec_of_an_incomplete_file(self):
        spec = characters.CHARACTERS['biped2d']
        joints = {**spec.joints, 'third_leg': next(iter(spec.joints.values()))}
        with self.assertRaisesRegex(ValueError, "biped2d.xml has no joint named 'third_leg'"):
            characters.make(dataclasses.replace(spec, joints=joints))


if __name__ == '__main__':
    absltest.main()
