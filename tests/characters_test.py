"""Characters: their figures are the stored ones of the original's files; their physics.

tests/characters.json has the figures: `python tests/characters_test.py store` writes it after a change
that is intended. Review the difference against the source of the character.
"""

import dataclasses
import json
import pathlib
import re
import sys

import mujoco
import numpy as np
from absl.testing import absltest, parameterized
from dm_control import mjcf
from helpers import assert_refused, users_arena

from trl_suite import actuation, characters

STORED = pathlib.Path(__file__).with_name('characters.json')
GRAVITY = 9.81  # m/s^2; of MuJoCo's default, which a user's own arena has
NAMES = tuple(characters.CHARACTERS)
SPATIAL = tuple(name for name in NAMES if characters.CHARACTERS[name].spatial)


def alone(name):
    """The character compiled alone, its root at the origin."""
    physics = mjcf.Physics.from_mjcf_model(characters.make(name).mjcf_model)
    model, data = physics.model.ptr, physics.data.ptr
    mujoco.mj_forward(model, data)
    return model, data


def lowest(model, data):
    """Height of the lowest point of the geoms that can touch the ground, m."""
    solid = np.flatnonzero((model.geom_group == 3) & (model.geom_conaffinity > 0))
    up = np.abs(data.geom_xmat[solid].reshape(-1, 3, 3)[:, 2])
    reach = (up * model.geom_size[solid]).sum(1)
    capsule = model.geom_type[solid] == mujoco.mjtGeom.mjGEOM_CAPSULE
    round_ = model.geom_size[solid, 0] + up[:, 2] * model.geom_size[solid, 1]
    return (data.geom_xpos[solid, 2] - np.where(capsule, round_, reach)).min()


def touching(name):
    """Pairs of links (and the floor) that touch when every box is 20 m large."""
    arena, character = users_arena(), characters.make(name)
    character.create_root_joints(arena.attach(character))
    physics = mjcf.Physics.from_mjcf_model(arena.mjcf_model)
    model, data = physics.model.ptr, physics.data.ptr
    model.geom_size[model.geom_type == mujoco.mjtGeom.mjGEOM_BOX] = 10.0
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_MIDPHASE
    mujoco.mj_setConst(model, mujoco.MjData(model))
    mujoco.mj_kinematics(model, data)
    mujoco.mj_collision(model, data)
    geoms = [[model.geom(g).name.removeprefix(f'{name}/') for g in p] for p in data.contact.geom]
    return sorted({' '.join(sorted(pair)) for pair in geoms})


def figures(name):
    """What the file and the row of a character say, in MuJoCo's axes: x forward, y left, z up."""
    character, (model, data) = characters.make(name), alone(name)
    spec, links = character.spec, {}
    torques = dict(zip(spec.joints, character.torque_limits, strict=True))
    for link in spec.links:
        body, geom, row = model.body(link), model.geom(link), spec.joints.get(link)
        rows = {
            'parent': model.body(body.parentid[0]).name, 'mass': body.mass,
            'position': [body.pos, body.quat], 'centre': [geom.pos, geom.quat],
            'half_size': model.geom_aabb[geom.id, 3:], 'inertia': body.inertia,
        }  # fmt: skip
        if row is not None:
            joint = model.joint(link)
            rows['joint'] = [joint.type, joint.axis, joint.range, model.jnt_limited[joint.id]]
            rows['gains'] = [row.kp, row.kd, row.weight, torques[link]]
            rows['torque'] = [model.jnt_actfrcrange[joint.id], model.jnt_actfrclimited[joint.id]]
        links[link] = {key: numbers(value) for key, value in rows.items()}
    return {
        'mass': numbers(model.body_mass.sum()), 'com': numbers(data.subtree_com[1]),
        'inertia': numbers(data.crb[1][:3]), 'height': numbers(-lowest(model, data)),
        'fall': ' '.join(sorted(spec.fall_links)), 'ends': ' '.join(spec.end_effectors),
        'stumble_exempt': ' '.join(sorted(spec.stumble_exempt)), 'spatial': str(spec.spatial),
        'mirror': ', '.join(map(' '.join, spec.mirror)), 'touch': ', '.join(touching(name)),
        'weights': numbers(spec.weights), 'links': links,
    }  # fmt: skip


def numbers(value):
    """Numbers with six digits, as JSON has them; texts as they are."""
    if isinstance(value, str):
        return value
    parts = value if isinstance(value, list) else [value]
    flat = np.concatenate([np.ravel(part) for part in parts]).astype(float)
    return ' '.join(f'{x:.6g}' for x in flat.round(9) + 0.0)


def same(found, stored):
    """Whether two texts have the same words, and the same numbers up to rounding."""
    if not (isinstance(found, str) and found and found[0] in '-0123456789i'):
        return found == stored
    a, b = (np.array(text.split(), float) for text in (found, stored))
    return a.shape == b.shape and np.allclose(a, b, rtol=2e-5, atol=2e-6)


class FiguresTest(parameterized.TestCase):
    @parameterized.parameters(*NAMES)
    def test_figures_are_the_stored_ones(self, name):
        found, stored = figures(name), json.loads(STORED.read_text())[name]
        links, expected = found.pop('links'), stored.pop('links')
        self.assertEqual([*links], [*expected])  # in this order
        for where, one, other in (
            (name, found, stored),
            *((x, links[x], expected[x]) for x in links),
        ):
            differ = {key for key in {*one, *other} if not same(one.get(key), other.get(key))}
            self.assertEmpty(differ, where)

    @parameterized.parameters(*NAMES)
    def test_what_a_character_says_of_itself(self, name):
        character, (model, data) = characters.make(name), alone(name)
        spec, reported = character.spec, characters.body_figures(character)
        self.assertAlmostEqual(reported['mass'], model.body_mass.sum(), delta=1e-9)
        self.assertAlmostEqual(reported['standing_height'], -lowest(model, data), delta=1e-9)
        np.testing.assert_allclose(reported['com'], data.subtree_com[1], atol=1e-9)
        np.testing.assert_allclose(reported['inertia'], data.crb[1][:3], atol=1e-9)
        joints = [model.joint(name) for name in spec.joints]
        kinds = np.array([joint.type[0] for joint in joints])
        np.testing.assert_array_equal(character.spherical, kinds == mujoco.mjtJoint.mjJNT_BALL)
        np.testing.assert_array_equal(character.prismatic, kinds == mujoco.mjtJoint.mjJNT_SLIDE)
        np.testing.assert_array_equal(
            character.dofs, np.where(kinds == mujoco.mjtJoint.mjJNT_BALL, 3, 1)
        )
        free = [not model.jnt_limited[joint.id] for joint in joints]
        ranges = np.where(np.array(free)[:, None], (-np.inf, np.inf), [j.range for j in joints])
        np.testing.assert_array_equal(character.joint_ranges, ranges)
        self.assertEqual(tuple(body.name for body in character.end_effectors), spec.end_effectors)
        self.assertAlmostEqual(spec.weights.sum(), 1, delta=1e-12)
        self.assertNotEmpty(spec.description)

    @parameterized.parameters(*NAMES)
    def test_contacts_and_what_is_drawn(self, name):
        character, (model, _) = characters.make(name), alone(name)
        solid, looks = model.geom_group == 3, model.geom_group == 0
        # The original multiplies 0.9 by 0.9, MuJoCo takes the larger of the two.
        np.testing.assert_allclose(model.geom_friction[solid, 0], 0.81)
        np.testing.assert_array_equal(model.geom_condim[solid], 3)
        floor = {pair.replace('floor', '').strip() for pair in touching(name) if 'floor' in pair}
        self.assertCountEqual([geom.name for geom in character.collision_geoms], floor)
        self.assertGreaterEqual(looks.sum(), len(character.spec.joints))
        self.assertFalse((model.geom_contype | model.geom_conaffinity)[looks].any())
        for geom in character.mjcf_model.find_all('geom'):
            if geom.name not in character.spec.links:
                self.assertEqual(geom.mass or geom.dclass.geom.mass, 0, geom.name)
        cameras = {model.camera(i).name for i in range(model.ncam)}
        self.assertContainsSubset({'side', 'front'}, cameras)
        if character.spec.spatial:
            self.assertEqual(cameras, {'side', 'front', 'back', 'above'})
            for links in character.spec.mirror:  # the right side is the lighter one
                geoms = [model.geom(f'{link}_look').matid[0] for link in links]
                light, dark = model.mat_rgba[geoms, :3].sum(1)
                self.assertGreater(light, dark + 0.3)

    @parameterized.parameters('dog', 'goat')
    def test_two_legs_are_drawn_as_four(self, name):
        model, data = alone(name)
        legs = {'shoulder elbow wrist finger': 0.2, 'hip knee ankle toe': 0.12}
        for link, apart in ((link, x) for links, x in legs.items() for link in links.split()):
            looks = (model.geom_group == 0) & (model.geom_bodyid == model.body(link).id)
            lateral = np.unique(data.geom_xpos[looks, 1].round(6))
            # The simulated leg is the right one: y points left.
            simulated = data.geom(link).xpos[1]
            np.testing.assert_allclose(lateral, (simulated, simulated + apart), atol=1e-6)

    def test_refused(self):
        spec = characters.CHARACTERS['biped2d']
        joints = {**spec.joints, 'third_leg': next(iter(spec.joints.values()))}
        other = dataclasses.replace(spec, joints=joints)
        assert_refused(
            self,
            (lambda: characters.make('rapter'), "unknown character 'rapter'.*'raptor'"),
            (lambda: characters.make(other), "biped2d.xml has no joint named 'third_leg'"),
        )


class OwnArenaTest(parameterized.TestCase):
    """A character works in any composer arena."""

    @parameterized.parameters('biped2d', 'biped3d', 'biped3d_mocap', 'biped3d_full_mocap')
    def test_stands_for_a_moment(self, name):
        physics, height = self.place(name, 'position')
        physics.step(200)
        self.assertAlmostEqual(physics.named.data.xpos[f'{name}/root', 'z'], height, delta=0.01)

    def place(self, name, model, timestep=1 / 600):
        arena, character = users_arena(timestep), characters.make(name)
        arena.mjcf_model.option.integrator = 'implicitfast' if character.spec.spatial else 'Euler'
        character.create_root_joints(arena.attach(character))
        actuation.add(character, model, timestep)
        physics = mjcf.Physics.from_mjcf_model(arena.mjcf_model)
        height = characters.body_figures(character)['standing_height']
        physics.data.qpos[2 if character.spec.spatial else 1] = height + 0.001
        physics.forward()
        return physics, height

    @parameterized.parameters(*NAMES)
    def test_falls_and_its_contact_forces_equal_its_weight(self, name):
        physics, height = self.place(name, 'torque')
        model, data = physics.model.ptr, physics.data.ptr
        data.qvel[:3] = (0.3, 0.2, 0) if name in SPATIAL else (0, 0, 0.5)  # or it would balance
        physics.step(6 * 600)
        self.assertLess(data.body(f'{name}/root').xpos[2], 0.5 * height)
        forces, force = [], np.zeros(6)
        for _ in range(600):
            mujoco.mj_step(model, data)  # not physics.step, which leaves new contacts, old forces
            forces.append(0.0)
            for i, contact in enumerate(data.contact):
                if 'floor' in (model.geom(g).name for g in contact.geom):
                    mujoco.mj_contactForce(model, data, i, force)
                    forces[-1] += force[0]
        weight = model.body_mass.sum() * GRAVITY
        self.assertAlmostEqual(np.mean(forces), weight, delta=0.02 * weight)
        self.assertGreater(lowest(model, data), -0.01)

    @parameterized.parameters(*SPATIAL)
    def test_root_in_space_is_one_free_joint(self, name):
        arena, character = users_arena(), characters.make(name)
        (joint,) = character.create_root_joints(arena.attach(character))
        physics = mjcf.Physics.from_mjcf_model(arena.mjcf_model)
        root = physics.model.ptr.joint(joint.full_identifier)
        self.assertEqual(root.type[0], mujoco.mjtJoint.mjJNT_FREE)
        self.assertEqual((root.qposadr[0], root.dofadr[0]), (0, 0))
        np.testing.assert_array_equal(physics.model.dof_damping[:6], 0)
        np.testing.assert_array_equal(physics.model.dof_armature[:6], 0)
        degrees, balls = character.dofs.sum(), character.spherical.sum()
        self.assertEqual((physics.model.nv, physics.model.nq), (6 + degrees, 7 + degrees + balls))
        character.set_pose(physics, (1, 2, 3), (np.cos(0.25), 0, 0, np.sin(0.25)))
        physics.forward()
        np.testing.assert_allclose(physics.named.data.xpos[f'{name}/root'], (1, 2, 3))
        ahead = physics.named.data.xmat[f'{name}/root'].reshape(3, 3)[:, 0]
        np.testing.assert_allclose(ahead, (np.cos(0.5), np.sin(0.5), 0))

    @parameterized.parameters(('biped2d', 9, 9, 6), ('biped3d_mocap', 29, 23, 17))
    def test_two_characters_in_one_arena(self, name, nq, nv, nu):
        arena = users_arena()
        for i in range(2):
            character = characters.Character(characters.CHARACTERS[name], name=f'walker_{i}')
            character.create_root_joints(arena.attach(character))
            actuation.add(character, 'position', 1 / 300)
        model = mjcf.Physics.from_mjcf_model(arena.mjcf_model).model
        self.assertEqual((model.nq, model.nv, model.nu), (2 * nq, 2 * nv, 2 * nu))


def store():
    """Writes the figures, a link on a line."""
    text = json.dumps({name: figures(name) for name in NAMES}, indent=1)
    STORED.write_text(re.sub(r'\n {4,}', ' ', text).replace('\n   }', '}') + '\n')


if __name__ == '__main__':
    store() if sys.argv[1:] == ['store'] else absltest.main()
