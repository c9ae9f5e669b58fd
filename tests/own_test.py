"""Tests of what users make: characters from files, terrain from data, tasks from parts."""

import contextlib
import copy
import itertools
import math
import pathlib
import pickle
import re
import runpy
import sys
import urllib.parse
from unittest import mock

import imageio.v3 as imageio
import mujoco
import numpy as np
import own_clip_test
import trimesh
from absl.testing import parameterized
from helpers import FolderTest, assert_refused, assert_rows_are_singles, in_this_process
from helpers import ground as heights_at
from PIL import Image

from trl_suite import characters, cli, describe, engine, motion, policies, suite, terrain
from trl_suite.arenas import PlanarArena, SpatialArena
from trl_suite.characters import inspect, model_file
from trl_suite.describe import tasks
from trl_suite.motion import quaternion
from trl_suite.registry import build
from trl_suite.rendering.kinematic_viewer import KinematicViewer
from trl_suite.tasks import parts
from trl_suite.tasks.walk import task as walk
from trl_suite.tasks.walk.task import Walk
from trl_suite.terrain import generators
from trl_suite.util import limited, program
from trl_suite.vector import VectorEnvironment

EXAMPLES = pathlib.Path(__file__).resolve().parents[1] / 'examples'
LINK = """<link name="{}"><inertial><origin xyz="0 0 -.2"/><mass value="{}"/>
<inertia ixx=".01" iyy=".01" izz=".01" ixy="0" ixz="0" iyz="0"/></inertial>
<collision><origin xyz="0 0 -.2"/><geometry><box size=".1 .1 .4"/></geometry></collision></link>"""
URDF = f"""<robot name="two">{LINK.format('trunk', 5)}{LINK.format('leg', 2)}
<joint name="hip" type="revolute"><parent link="trunk"/><child link="leg"/>
<origin xyz="0 0 -.4"/><axis xyz="0 1 0"/>
<limit lower="-0.7" upper="0.4" effort="35" velocity="9"/></joint></robot>"""
# A planar two-legged figure with its own root joints, a floor, servos and a key frame.
LEG = """<body name="{0}_thigh" pos="0 {1} 0"><joint name="{0}_hip" axis="0 -1 0" range="-60 60"/>
<geom type="capsule" size=".04" fromto="0 0 0 0 0 -.4"/>
<body name="{0}_shin" pos="0 0 -.4"><joint name="{0}_knee" axis="0 -1 0" range="-120 0"/>
<geom type="capsule" size=".04" fromto="0 0 0 0 0 -.4"/></body></body>"""
MJCF = f"""<mujoco><worldbody><geom name="floor" type="plane" size="9 9 1"/><body name="trunk" pos="0 0 1">
<joint name="x" type="slide" axis="1 0 0"/><joint name="z" type="slide" axis="0 0 1"/>
<joint name="p" axis="0 1 0"/><geom size=".15 .15 .2" type="box" pos="0 0 .2"/>
{LEG.format('right', -0.1)}{LEG.format('left', 0.1)}</body></worldbody>
<actuator><position joint="right_hip" kp="90" kv="3" forcerange="-70 70"/>
<motor joint="right_knee" gear="50" ctrlrange="-1 1"/></actuator>
<keyframe><key qpos="0 1 0 .2 -.3 .1 -.1"/></keyframe></mujoco>"""
LEG_BOX = trimesh.creation.box((0.1, 0.1, 0.4))
FLAT = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], [[0, 1, 2], [1, 3, 2]])
PLANAR = {'end_effectors': ('right_shin', 'left_shin'), 'fall_links': ('trunk',)}
TWO = {'end_effectors': ('leg',), 'fall_links': ('trunk',), 'spatial': True}


class WrittenTest(FolderTest):
    """A test that writes files."""

    def write(self, text, name='figure.xml'):
        path = self.folder / name
        path.write_text(text)
        return path


def with_named_shins(attributes=''):
    """Returns MJCF whose geoms of the shins are called right and left."""
    text = MJCF
    for side in ('right', 'left'):
        shin = f'name="{side}_knee" axis="0 -1 0" range="-120 0"/>\n<geom '
        assert shin in text
        text = text.replace(shin, f'{shin}name="{side}" {attributes} ')
    return text


def compiled(row):
    root = characters.make(row).mjcf_model
    return mujoco.MjModel.from_xml_string(root.to_xml_string(), root.get_assets())


def mesh_file(mesh, path):
    """Writes a mesh, in the format of the file's suffix; .txt.stl is an STL file as text."""
    mesh.export(path, file_type='stl_ascii' if path.name.endswith('.txt.stl') else None)


class CharacterTest(WrittenTest):
    """Characters from files."""

    def setUp(self):
        super().setUp()
        self.enterContext(mock.patch.object(limited, 'call', in_this_process))  # see limits_test

    def planar(self, text=MJCF, **options):
        return characters.from_file(self.write(text), **{**PLANAR, **options})

    def walk(self, spec, *actuation, terrain='flat'):
        """Returns an environment of a character after a step."""
        environment = suite.build(
            spec, *actuation, terrain=terrain, task='walk', task_kwargs={'random': 1}
        )
        environment.reset()
        step = environment.step(np.zeros(len(environment.action_map)))
        self.assertTrue(np.isfinite(step.reward))
        return environment

    def urdf(self, text=URDF, **options):
        return characters.from_file(self.write(text, 'two.urdf'), **{**TWO, **options})

    def test_urdf_keeps_masses_limits_and_efforts(self):
        spec = self.urdf()
        model = compiled(spec)
        np.testing.assert_array_equal(model.body_mass[1:], [5, 2])
        np.testing.assert_array_equal(model.jnt_range, [[-0.7, 0.4]])
        np.testing.assert_array_equal(model.jnt_actfrcrange, [[-35, 35]])
        self.assertEqual(
            (spec.name, spec.links, tuple(spec.joints)), ('two', ('trunk', 'leg'), ('hip',))
        )
        self.assertEqual(spec.joints['hip'].kp, 35)  # the file has no servo: all at 1 rad
        self.assertLen(spec.notes, 1)
        self.assertIn('hip 35', spec.notes[0])

    def test_fixed_links_stay_as_end_effectors(self):
        foot = '<link name="foot"/><joint name="f" type="fixed"><parent link="leg"/><child link="foot"/><origin xyz="0 0 -.4"/></joint></robot>'
        spec = self.urdf(URDF.replace('</robot>', foot), end_effectors=('foot',))
        self.assertEqual(spec.links, ('trunk', 'leg'))  # massless bodies are not links
        self.walk(spec, terrain='plane')

    def test_actuators_key_frame_and_defaults(self):
        spec = self.planar()
        self.assertFalse(spec.spatial)
        hip, knee, other = (spec.joints[n] for n in ('right_hip', 'right_knee', 'left_hip'))
        self.assertEqual((hip.kp, hip.kd, hip.target), (90, 3, 0.2))
        self.assertEqual((knee.kp, knee.target), (50, -0.3))
        model = compiled(spec)
        limits = dict(zip(spec.joints, model.jnt_actfrcrange[:, 1], strict=True))
        self.assertEqual((limits['right_hip'], limits['right_knee']), (70, 50))
        # The weight at the end of the leg, 0.84 m below the hip.
        self.assertAlmostEqual(limits['left_hip'], model.body_mass.sum() * 9.8 * 0.84, delta=1e-6)
        self.assertAlmostEqual(other.kd, other.kp / 10)
        self.assertFalse([note for note in spec.notes if 'without damping' in note])
        self.assertEqual(model.nu + model.nkey + model.nsensor, 0)
        np.testing.assert_allclose(model.jnt_range[1], [-2 * np.pi / 3, 0])
        self.assertEqual(mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, 'floor'), -1)

    def test_damping_of_the_file_is_added(self):
        text = MJCF.replace('name="left_hip"', 'name="left_hip" damping="5"').replace('kv="3"', '')
        spec = self.planar(text)
        hip, servo = spec.joints['left_hip'], spec.joints['right_hip']
        self.assertAlmostEqual(hip.kd, hip.kp / 10 + 5)
        self.assertEqual((servo.kp, servo.kd), (90, 9))
        self.assertIn(
            'servos without damping; kd, N m s/rad (slides: N s/m): right_hip 9', spec.notes
        )

    def test_a_body_without_mass_stays_without(self):
        """By options of the compiler, or by its geoms."""
        foot = '<body name="foot_{}" pos="0 0 -.1"><geom size=".05" {}/></body>'
        feet = foot.format('a', 'group="3"') + foot.format('b', 'mass="0"')
        text = MJCF.replace('<geom size=".15', f'{feet}<geom size=".15')
        spec = self.planar(
            text.replace('<worldbody>', '<compiler inertiagrouprange="0 2"/><worldbody>', 1)
        )
        model = compiled(spec)
        np.testing.assert_array_equal([model.body(f'foot_{name}').mass[0] for name in 'ab'], 0)
        self.assertNoCommonElements(('foot_a', 'foot_b'), spec.links)
        geoms = KinematicViewer(spec).links
        self.assertContainsSubset(('foot_a', 'foot_b', 'trunk'), geoms)
        self.walk(spec)

    @parameterized.parameters({'flex': 0.05}, {'flex': 0.05, 'backlash': 0.02})
    def test_fixed_bodies_do_not_collide_across_a_joint_with_play(self, **actuators):
        """What is fixed to the links on both sides of a joint overlaps there, as without a motor."""
        mount = '<body name="mount"><geom size=".1"/></body>'
        knob = '<body name="knob"><geom size=".1"/></body>'
        leg = LEG.format('right', -0.1).replace('<geom type', f'{knob}<geom type', 1)
        text = MJCF.replace(LEG.format('right', -0.1), mount + leg)
        self.assertNotEqual(text, MJCF)
        for each in ({}, actuators):
            environment = suite.build(
                self.planar(text),
                task='walk',
                terrain='flat',
                task_kwargs={'random': 1, 'actuators': each},
            )
            environment.reset()
            physics = environment.physics
            bodies = physics.model.geom_bodyid[physics.data.contact.geom]
            apart = [pair for pair in bodies.tolist() if 0 not in pair]
            self.assertEmpty([pair for pair in apart if min(physics.model.body_weldid[pair]) > 0])

    def test_friction_and_pairs_follow_the_world(self):
        """Also of geoms whose friction has priority."""
        rules = '<contact><pair geom1="right" geom2="left"/></contact></mujoco>'
        text = with_named_shins('priority="1" friction="1.5"').replace('</mujoco>', rules)
        world = {'friction': 0.3, 'contact_depth': 0.01, 'contact_time': 0.05}
        environment = suite.build(
            self.planar(text),
            task='walk',
            terrain='flat',
            task_kwargs={'random': 1, 'randomize': world},
        )
        environment.reset()
        model, found = environment.physics.model, []
        np.testing.assert_array_equal(model.pair_friction[:, :2], 0.3)
        np.testing.assert_array_equal(
            (model.pair_solimp[0, 2], model.pair_solref[0, 0]), (0.01, 0.05)
        )
        for _ in range(60):
            environment.step(np.zeros(len(environment.action_map)))
            found += environment.physics.data.contact.friction[:, 0].tolist()
        self.assertEqual(set(found), {0.3})

    def test_a_table_of_joints_needs_no_joint_for_each_body(self):
        head = '<body name="head" pos="0 0 .4"><geom size=".1" mass="3"/></body>'
        spec = self.planar(MJCF.replace('<geom size=".15', f'{head}<geom size=".15'))
        row = suite.combine(spec, terrain='flat', task='walk')
        told = '\n'.join(
            map(str, dict(describe.sections(row, suite.build_environment(row, {}, {}))).values())
        )
        for name in ('right_hip', 'left_knee'):
            self.assertIn(name, told)

    def test_pairs_and_exclusions(self):
        """Those with the world, or with what is beside the character, are left out."""
        rules = (
            '<contact><exclude body1="world" body2="trunk"/><exclude body1="trunk" body2="left_shin"/>'
            '<pair geom1="right" geom2="left"/><pair geom1="floor" geom2="left"/></contact></mujoco>'
        )
        text = with_named_shins().replace('</mujoco>', rules)
        spec = self.planar(text)
        model = compiled(spec)
        self.assertEqual((model.nexclude, model.npair), (1, 1))
        self.assertIn(
            "the pair of 'floor' and 'left' is left out: one is beside the character", spec.notes
        )

    def test_unnamed_elements_get_names(self):
        things = '<site pos="0 0 .4"/><camera pos="0 -2 0"/><light pos="0 0 3"/>'
        rules = (
            '<contact><exclude body1="trunk" body2="left_shin"/></contact>'
            '<equality><joint joint1="left_hip" joint2="right_hip" active="false"/></equality>'
            '<tendon><fixed><joint joint="left_knee" coef="1"/></fixed></tendon></mujoco>'
        )
        text = MJCF.replace('<geom size=".15', f'{things}<geom size=".15')
        spec = self.planar(text.replace('</mujoco>', rules))
        environment = self.walk(spec, terrain='slopes')
        model = environment.physics.model
        self.assertEqual((model.neq, model.ntendon, model.nexclude), (1, 1, 1))

    def test_unnamed_elements_beside_each_other(self):
        """Their names differ from each other, and from those in the file."""
        plain = '<body><geom size=".1" name="{}"/></body>'
        hinged = '<body {}><joint {} axis="0 1 0" range="-9 9"/><geom size=".1"/></body>'
        bodies = (
            plain.format('trunk_2') + plain.format('trunk_geom0') + hinged.format('name="trunk_1"', '')
            + hinged.format('', '') + hinged.format('name="left"', 'name="left_thigh"')
            + hinged.format('', 'name="right"')
        )  # fmt: skip
        spec = self.planar(MJCF.replace('<geom size=".15', f'{bodies}<geom size=".15'))
        self.assertLen(set(spec.links), 11)
        self.assertLen(spec.links, 11)
        self.assertLen(spec.joints, 8)
        self.walk(spec)

    def test_given_joint_parameters_replace_those_of_the_file(self):
        mine = characters.Joint(kp=10, kd=1, weight=0.5)
        self.assertIs(self.planar(joints={'left_hip': mine}).joints['left_hip'], mine)

    @parameterized.parameters('leg.obj', 'package://robot/leg.stl', 'leg.txt.stl')
    def test_meshes_are_stored_in_the_spec(self, address):
        path = self.folder / address.rpartition('/')[2]
        mesh_file(LEG_BOX, path)
        spec = self.urdf(URDF.replace('<box size=".1 .1 .4"/>', f'<mesh filename="{address}"/>'))
        row = pickle.loads(pickle.dumps(spec))
        path.unlink()
        for each in spec, row, pickle.loads(pickle.dumps(row)):
            np.testing.assert_allclose(compiled(each).geom_size[0], [0.05, 0.05, 0.2], atol=1e-6)

    def test_a_mesh_gives_a_mass(self):
        trimesh.creation.icosphere(radius=0.2).export(self.folder / 'ball.obj')
        text = MJCF.replace('<worldbody>', '<asset><mesh file="ball.obj"/></asset><worldbody>', 1)
        text = text.replace('<geom size=".15 .15 .2" type="box"', '<geom type="mesh" mesh="ball"')
        trunk = compiled(self.planar(text)).body_mass[1]
        self.assertAlmostEqual(trunk, 1000 * 4 / 3 * np.pi * 0.2**3, delta=0.05 * trunk)

    def with_mesh(self, address, mesh=None, name='two.urdf', text=URDF):
        """Returns the compiled file whose leg has a mesh, and nothing else; it is not simulated."""
        if mesh is not None:
            mesh_file(mesh, self.folder / urllib.parse.unquote(address.rpartition('/')[2]))
        head, _, leg = text.partition('<link name="leg">')
        leg = leg.replace('<box size=".1 .1 .4"/>', f'<mesh filename="{address}"/>')
        return model_file.compiled(
            model_file.named(self.write(f'{head}<link name="leg">{leg}', name))
        )

    @parameterized.parameters(
        'package://robot/meshes/leg.stl', 'package:///robot/meshes/leg.stl', 'file://{}/meshes/leg.stl',
        'file://localhost{}/meshes/leg.stl', 'file:{}/meshes/leg.stl', 'file://{}/%6deshes/leg.stl',
        '../meshes/leg.stl', '{}/meshes/leg.stl',
    )  # fmt: skip
    def test_addresses_of_meshes(self, address):
        for folder in ('my robot/urdf', 'my robot/meshes'):
            (self.folder / folder).mkdir(parents=True)
        LEG_BOX.export(self.folder / 'my robot' / 'meshes' / 'leg.stl')
        looks = '<visual><geometry><mesh filename="package://robot/no.dae"/></geometry></visual>'
        model = self.with_mesh(
            address.format(self.folder / 'my robot'), name='my robot/urdf/two.urdf',
            text=URDF.replace('<collision>', f'{looks}<collision>'),
        )  # fmt: skip
        np.testing.assert_allclose(model.geom_size[1], [0.05, 0.05, 0.2], atol=1e-6)

    @parameterized.parameters(
        'leg.stl', 'leg.txt.stl', 'leg.TXT.stl', 'leg.obj', 'leg.ply', 'leg.dae'
    )
    def test_formats_of_meshes(self, name):
        model = self.with_mesh(name, LEG_BOX)
        np.testing.assert_allclose(model.geom_size[1], [0.05, 0.05, 0.2], atol=1e-6)
        self.assertEqual(model.mesh_vertnum, [8])

    def test_the_unit_of_a_collada_file_applies(self):
        mesh_file(LEG_BOX, self.folder / 'leg.dae')
        text = (self.folder / 'leg.dae').read_text()
        asset = text.index('</asset>')
        self.write(f'{text[:asset]}<unit name="cm" meter="0.01"/>{text[asset:]}', 'leg.dae')
        model = self.with_mesh('leg.dae')
        np.testing.assert_allclose(model.geom_size[1], [5e-4, 5e-4, 2e-3], atol=1e-7)

    @parameterized.parameters(
        ('<!DOCTYPE COLLADA [<!ENTITY a "1 2 3">]><COLLADA/>', 'expected no document type'),
        ('<COLLADA', 'leg.dae'),
    )
    def test_collada_files_that_are_refused(self, text, message):
        self.write(text, 'leg.dae')
        with self.assertRaisesRegex(ValueError, f"mesh 'leg' of 'leg': .*{message}"):
            self.with_mesh('leg.dae')

    def test_without_a_reader_of_collada_the_remedy_is_named(self):
        self.write('<COLLADA/>', 'leg.dae')
        with (
            mock.patch.object(trimesh, 'available_formats', return_value={'stl'}),
            self.assertRaisesRegex(
                ValueError, "mesh 'leg' of 'leg': .*leg.dae: pycollada is .*; pip"
            ),
        ):
            self.with_mesh('leg.dae')

    @parameterized.parameters(
        ('file://host/leg.stl', 'is not the address of a file on this machine; expected an abs'),
        ('file://$(find robot)/leg.stl', 'is not the address of a file on this machine'),
        ('file:./leg.stl', 'is not the address of a file on this machine'),
        ('https://host/leg.stl', "cannot be read; expected a path, or an address that begins"),
        ('model://robot/leg.stl', 'cannot be read; expected a path'),
        ('package://robot/leg.stl', "there is no 'leg.stl', from the address 'package://robot/leg"),
        ('file:///no/leg.stl', "there is no file '/no/leg.stl'"),
        ('leg.stl', "there is no file 'leg.stl'"),
        ('leg.dae', 'leg.dae: cannot be read as a mesh', 'no mesh'),
        ('leg.stl', 'leg.stl: ', 'solid leg, but no mesh'),
        ('leg.stl', 'all corners are in a plane; expected a solid', FLAT),
        ('leg.stl', 'it is too small; is its scale right', LEG_BOX.copy().apply_scale(1e-8)),
    )  # fmt: skip
    def test_meshes_that_are_refused(self, address, message, mesh=None):
        """The message names the mesh, its link and the remedy."""
        if isinstance(mesh, str):
            self.write(mesh, address)
            mesh = None
        with self.assertRaisesRegex(ValueError, f"mesh 'leg' of 'leg': .*{re.escape(message)}"):
            self.with_mesh(address, mesh)

    def test_a_mesh_without_volume(self):
        """It is refused only where the mass of a link would have to be derived from it."""
        mesh = LEG_BOX.copy().apply_scale(1e-5)
        model = self.with_mesh('leg.stl', mesh)
        np.testing.assert_allclose(model.geom_size[1], [5e-7, 5e-7, 2e-6], rtol=1e-3)
        inertial = URDF[URDF.rindex('<inertial>') : URDF.rindex('</inertial>') + len('</inertial>')]
        head, _, tail = URDF.rpartition(inertial)
        with self.assertRaisesRegex(ValueError, 'it encloses no volume, from which to derive'):
            self.with_mesh('leg.stl', text=head + tail)

    def test_inertia_that_is_refused(self):
        head, _, leg = URDF.partition('<link name="leg">')

        def read(before, after):
            self.urdf(f'{head}<link name="leg">{leg.replace(before, after)}')

        link = "two.urdf: link 'leg': .*"
        assert_refused(
            self,
            (lambda: read('ixx=".01"', 'ixx=".1"'),
             f'{link}larger than the sum of the others.*pass balance_inertia=True'),
            (lambda: read('ixx=".01"', 'ixx="-.1"'), f'{link}expected positive ones'),
            (lambda: read('value="2"', 'value="0"'), f'{link}it moves, and has no mass or no inertia; expected both'),
        )  # fmt: skip

    @parameterized.parameters(
        ('ctrlrange="-1 1"', 50), ('ctrlrange="-1 1" forcerange="-100 100"', 50),
        ('ctrlrange="-9 9" forcerange="-2 2"', 100), ('forcerange="-2 2"', 100),
    )  # fmt: skip
    def test_torque_limits_of_a_motor(self, ranges, limit):
        """The smaller of both ranges, times the gear, 50."""
        spec = self.planar(MJCF.replace('ctrlrange="-1 1"', ranges))
        model = characters.make(spec)
        self.assertEqual(
            dict(zip(spec.joints, model.torque_limits, strict=True))['right_knee'], limit
        )

    @parameterized.parameters(('ixx=".01"', 'ixx=".1"', 0.04), ('ixy="0"', 'ixy=".01"', 0.01))
    def test_inertia_is_balanced_on_request(self, before, after, expected):
        spec = model_file.named(self.write(URDF.replace(before, after), 'two.urdf'))
        model_file.balance_inertia(spec)
        np.testing.assert_allclose(model_file.compiled(spec).body_inertia[1:], expected)
        made = self.urdf(URDF.replace(before, after), balance_inertia=True)
        np.testing.assert_allclose(compiled(made).body_inertia[1:], expected)

    @parameterized.parameters('position', 'torque', 'velocity')
    def test_it_starts_on_the_ground(self, actuation):
        environment = self.walk(self.planar(), actuation, terrain='gaps')
        environment.reset()
        data, model = environment.physics.data, environment.physics.model
        shins = [i for i in range(model.nbody) if 'shin' in model.id2name(i, 'body')]
        ends = data.xpos[shins] - 0.4 * data.xmat[shins].reshape(-1, 3, 3)[:, :, 2]
        self.assertBetween(ends[:, 2].min() - 0.04, 0, 0.02)  # the box around a capsule is clear

    def test_imitation_of_a_clip(self):
        spec = self.planar()
        poses = np.zeros((3, 7))
        poses[:, 0], poses[:, 1], poses[1, 3:] = (0, 0.5, 1), 0.8, (0.3, -0.2, -0.3, -0.4)
        clip = motion.Clip(
            'steps', np.arange(3) / 2, poses, 'planar', tuple(spec.joints), (1,) * 4, True
        )
        environment = suite.build(spec, terrain='slopes', clip=clip, task_kwargs={'random': 0})
        environment.reset()
        reward = environment.step(environment.task.clip_action(0)).reward
        self.assertBetween(reward, 0.5, 1)
        with self.assertRaisesRegex(ValueError, "no clip of its own; pass clip=, or task='walk'"):
            suite.build(spec)

    def test_spatial_imitation_of_a_clip(self):
        spec = self.urdf()
        poses = np.tile([0.0, 0, 0.8, 1, 0, 0, 0, 0], (3, 1))
        poses[1, -1] = 0.3
        clip = motion.Clip('nod', np.arange(3) / 2, poses, 'free', ('hip',), (1,), True)
        environment = suite.build(spec, terrain='hills3d', clip=clip, task_kwargs={'random': 0})
        environment.reset()
        self.assertGreater(environment.step(environment.task.clip_action(0)).reward, 0.5)
        with self.assertRaisesRegex(ValueError, 'no pairs of right and left'):
            suite.build(spec, clip=clip, task_kwargs={'mirrored': True})

    def test_invalid_arguments_are_rejected(self):
        values, strings = (
            ({'root': 'trunc'}, "unknown root 'trunc'; did you mean 'trunk'"),
            ({'root': 'left_shin'}, "is the child of another body; did you mean 'trunk'"),
            ({'end_effectors': ('left_shinn',)}, "effector 'left_shinn'; did you mean 'left_shin'"),
            ({'end_effectors': ('left_knee',)}, "is a joint; did you mean its body 'left_shin'"),
            ({'end_effectors': ()}, 'expected one name or more'),
            ({'fall_links': 'trunk'}, 'expected a list of strings or None'),
            ({'fall_links': ('trunk', 'trunk')}, 'trunk, trunk: expected names without repeats'),
            ({'balance_inertia': 1}, 'balance_inertia is 1; expected True or False'),
            ({'joints': {'left_hipp': None}}, "unknown joint 'left_hipp'; did you mean 'left_hip'"),
            ({'name': 'dog'}, "has a character named 'dog'"),
            ({'name': 'a/b'}, "name is 'a/b'; expected a name without '/'"),
            ({'name': ''}, "name is ''; expected a name, or None"),
            ({'spatial': 'x'}, "spatial is 'x'; expected True or False or None"),
            ({'turn': (0, 0, 90)}, r'turn, a quaternion wxyz: has shape \(3,\); expected \(4,\)'),
            ({'turn': (0, 0, 0, 0)}, 'expected a quaternion wxyz'),
            ({'turn': 'left'}, 'turn, a quaternion wxyz: expected an array of numbers'),
            ({'turn': (1, 0, 0, math.nan)}, r'quaternion wxyz: nan at \[3\]'),
        ), ('fall_links', 'end_effectors', 'stumble_exempt')  # fmt: skip
        joint = {'kp': 10, 'kd': 1, 'weight': 1}
        assert_refused(
            self,
            *((lambda o=o: self.planar(**o), message) for o, message in values),
            *((lambda n=n: self.planar(**{n: 3}), f'{n} is 3; expected a list of strings') for n in strings),
            *((lambda v=v: characters.Joint(**joint | v), message) for v, message in (
                ({'kp': -80}, 'kp of a joint is -80'), ({'kd': math.nan}, 'kd of a joint is nan'),
                ({'armature': math.inf}, 'armature'), ({'target': (0, math.nan, 0)}, 'target .* finite numbers'),
            )),
            (lambda: self.planar(MJCF.replace('<geom size=".15', f'<geom contype="{2**30}" size=".15')),
             f"geom 'trunk_geom0' has contype {2**30}"),
            (lambda: self.urdf(spatial=None), 'spatial=True or spatial=False'),
            (lambda: characters.make(self.planar(joints={'left_hip': characters.Joint(40, 1, 1, target=45)})),
             "target of 'left_hip' is 45; expected .* its limits"),
            (lambda: self.urdf(URDF.replace('lower="-0.7"', 'lower="0.7"')),
             'limits 0.7 to 0.4; expected the lower first'),
            (lambda: characters.from_file('robot.usd', **TWO), 'expected .xml or .mjcf or .urdf'),
        )  # fmt: skip
        assert_refused(
            self,
            (lambda: self.planar(joints={'left_hip': 3}), r"joints\['left_hip'\] is 3; expected a characters.J"),
            *((lambda j=j: self.planar(joints=j), 'joints is .*; expected a dict of characters.J') for j in (3, ['a'])),
            (lambda: characters.make(3), 'character is 3; expected a name, or what'),
            error=TypeError,
        )  # fmt: skip
        with self.assertRaisesRegex(FileNotFoundError, "did you mean 'two.urdf'"):
            characters.from_file(self.folder / 'tow.urdf', **TWO)

    def test_notes(self):
        """On what is left out, and on what is probably in another unit or another posture."""
        plain, box = '; '.join(self.planar().notes), '.2" type="box"'
        tendon = '<tendon><fixed name="both"><joint joint="left_hip" coef="1"/></fixed></tendon>'
        free = {'spatial': True}
        for before, after, options, note in (
            ('range="-60 60"', 'range="-1 1"', {}, 'hardly move, rad: right_hip .-0.017, 0.017.'),
            ('range="-60 60"', 'range="-3600 3600"', {}, 'full circle, rad: right_hip'),
            (f'{box} pos="0 0 .2"', '200" type="box" pos="0 0 .2"', {}, 'reaches .* are lengths in m'),
            (box, '.2" mass="8000" type="box"', {}, 'weighs 80[0-9][0-9] kg'),
            ('<actuator>', f'{tendon}<actuator><motor name="pull" tendon="both"/>', {},
             r'actuators that are left out.*: pull \(tendon\)(;|$)'),
            ('', '', {**free, 'turn': (0.7071, 0, 0.7071, 0)}, 'it may lie: the end effectors are at'),
            ('', '', {**free, 'turn': (0.7071, 0, 0, -0.7071)},
             'it may face .0.1, -1.0., according to its left and right bodies'),
            ('', '', free, 'spatial=True was given .* two slides and a hinge'),
            ('<mujoco>', '<mujoco><option gravity="0 0 -3.7"/>', {}, r'gravity of the file, .*-3.7.* is left out'),
            ('</worldbody>', '<body name="ball"><freejoint/><geom size=".1"/></body></worldbody>', {'root': 'trunk'},
             'bodies beside the character are left out: ball'),
        ):  # fmt: skip
            self.assertIn(before, MJCF)
            self.assertNotRegex(plain, note)
            notes = self.planar(MJCF.replace(before, after) if before else MJCF, **options).notes
            self.assertRegex('; '.join(notes), note)
        self.assertEqual('; '.join(self.planar(spatial=False).notes), plain)

    @parameterized.parameters(True, False)
    def test_a_turned_file_gives_the_same_model(self, in_file):
        turn = np.array([0.859, 1, 1, 0.859]) / np.linalg.norm([0.859, 1, 1, 0.859])
        back = turn * [1, -1, -1, -1]
        text = MJCF.replace('<geom size=".15', '<geom name="box" euler="0 20 0" size=".15')
        joint, end = '<joint name="p" axis="0 1 0"/>', '</body></worldbody>'
        inertial = '<inertial pos="{} {} {}" quat="{} {} {} {}" mass="3" diaginertia=".3 .2 .1"/>'
        upright = text.replace(joint, joint + inertial.format(0.1, 0, 0.2, 1, 0, 0, 0))
        place = np.empty(3)
        mujoco.mju_rotVecQuat(place, np.array([0.1, 0, 0.2]), back)
        turned = text.replace(
            joint,
            f'{joint}{inertial.format(*place, *back)}<frame quat="{" ".join(map(str, back))}">',
        )
        turned = turned.replace(end, f'</frame>{end}')
        if in_file:
            root = 'name="trunk" pos="0 0 1"'
            turned = turned.replace(root, f'{root} quat="{" ".join(map(str, turn))}"')
        spec = self.planar(turned, turn=None if in_file else turn)
        figures = []
        for model in (compiled(self.planar(upright)), compiled(spec)):
            data = mujoco.MjData(model)
            mujoco.mj_forward(model, data)
            order = [model.geom(name).id for name in spec.collision_geoms]
            figures.append((
                data.xpos, data.xmat, data.xipos, model.body_mass, data.xaxis, model.dof_M0,
                data.geom_xpos[order], data.geom_xmat[order],
            ))  # fmt: skip
        for first, second in zip(*figures, strict=True):
            np.testing.assert_allclose(first, second, atol=1e-6)  # files have six digits

    def test_lights_and_cameras_are_the_suites(self):
        things = '<light name="mine" pos="0 0 3"/><camera name="side" pos="0 -99 0"/>'
        spec = self.planar(MJCF.replace('<geom size=".15', f'{things}<geom size=".15'))
        model = compiled(spec)
        self.assertEqual([model.light(i).name for i in range(model.nlight)], ['sun'])
        self.assertLess(np.abs(model.cam_pos[model.camera('side').id]).max(), 5)

    @parameterized.named_parameters(
        ('twice', 'name="left_knee"', 'name="left_hip"', "repeated name 'left_hip' in joint"),
        ('no_geoms', '<geom ', '<geom contype="0" conaffinity="0" ', 'no geom of the character can'),
        ('no_root_joints', 'name="x" type="slide"', 'name="x"', 'has hinge, hinge, slide; expected'),
        ('out_of_plane', 'name="left_knee" axis="0 -1 0"', 'name="left_knee" axis="1 0 0"', "hinge 'left_knee' .* leaves"),
        ('free_slide', 'name="left_knee" axis="0 -1 0" range="-120 0"', 'name="left_knee" type="slide" axis="0 0 1"', "slide 'left_knee' has no limits"),
        ('mass', '<geom type="capsule"', '<geom mass="0" type="capsule"', 'it moves, and has no mass or no inertia'),
        ('turned', 'name="trunk" pos="0 0 1"', 'name="trunk" euler="0 0 90"', 'leaves the x-z plane'),
        ('two_roots', '</worldbody>', '<body name="ball"><freejoint/><geom size="1"/><body name="hat"><joint/><geom size="1"/></body></body></worldbody>', r"several bodies may be the root; pass root=, one of .'trunk', 'ball'."),
        ('broken', '</mujoco>', '', 'not a model'),
        ('nan', 'name="left_knee" axis', 'name="left_knee" armature="nan" axis', 'armature="nan" of .left_knee. .<joint>.; expected finite'),
        ('infinity', 'name="trunk" pos="0 0 1"', 'name="trunk" pos="0 0 inf"', 'line 1: pos="0 0 inf" of .trunk.'),
        ('empty', MJCF[MJCF.index('<worldbody>'):MJCF.index('</mujoco>')], '<worldbody/>', 'there is no body'),
        ('no_size', 'size=".15 .15 .2"', 'size=".15 0 .2"', "geom 'trunk_geom0': a size is 0 or negative; expected positive sizes"),
        ('copies', '<geom type="capsule"', '<replicate count="60"><replicate count="60"><geom size="1"/></replicate></replicate><geom type="capsule"', 'bodies, joints, geoms and sites are 144[0-9][0-9]; expected no more than 10000'),
        ('many', '<geom type="capsule"', 2501 * '<geom size="1"/>' + '<geom type="capsule"', 'geoms and sites are 100[0-9][0-9]; expected no more'),
        ('flex', '<geom size=".15', '<flexcomp type="grid" count="3 3 1" spacing=".1 .1 .1" dim="2" name="cloth" rigid="true"/><geom size=".15', "flex 'cloth': flexible bodies are not supported, .*; remove it, or replace it by geoms"),
        ('unstable', 'name="left_knee" axis', 'name="left_knee" springref="1e15" stiffness="1e15" axis', 'diverges in the first step'),
        ('far', 'name="trunk" pos="0 0 1"', 'name="trunk" pos="1e300 0 1"', 'line 1: pos="1e300 0 1" of .trunk.* up to 1e.30'),
        ('line_break', 'name="right_shin"', 'name="right&#10;shin"', r"'right.nshin' has a slash, a line break"),
        ('slash', 'name="right_shin"', 'name="right/shin"', "'right/shin' has a slash"),
    )  # fmt: skip
    def test_invalid_files_are_rejected(self, before, after, message):
        self.assertIn(before, MJCF)
        with self.assertRaisesRegex(ValueError, f'figure.xml: .*{message}'):
            self.planar(MJCF.replace(before, after))

    def test_numbers_of_included_files(self):
        part = '<mujocoinclude><body name="ball"><geom size="{}"/></body></mujocoinclude>'
        text = MJCF.replace('</worldbody>', '<include file="part.xml"/></worldbody>')
        self.write(part.format('1'), 'part.xml')
        self.assertNotIn('ball', self.planar(text, root='trunk').links)
        self.write(part.format('nan'), 'part.xml')
        with self.assertRaisesRegex(ValueError, 'part.xml: line 1: size="nan"'):
            self.planar(text, root='trunk')
        self.write('<mujocoinclude><include file="part.xml"/></mujocoinclude>', 'part.xml')
        with self.assertRaisesRegex(ValueError, "figure.xml: .*'part.xml' already included"):
            self.planar(text, root='trunk')

    def test_bodies_beside_the_character(self):
        """Targets, balls and furniture are no roots, and what ties the character to them is left out."""
        beside = (
            '<body name="target" mocap="true"><geom size=".1"/></body><body name="table"><geom size=".1"/></body>'
            '<body name="ball"><freejoint/><geom size=".1"/></body></worldbody><equality>'
            '<weld name="drag" body1="target" body2="trunk"/><connect name="nail" body1="trunk" anchor="0 0 0"/>'
            '<weld name="fix" body1="world" body2="trunk"/><joint name="slip" joint1="x" joint2="left_hip"/>'
            '<weld name="tie" body1="right_shin" body2="left_shin"/></equality>'
        )
        rope = (
            '<tendon><spatial name="rope"><site site="anchor"/><site site="hook"/></spatial>'
            '<fixed name="both"><joint joint="left_hip" coef="1"/></fixed></tendon></mujoco>'
        )
        text = MJCF.replace('</worldbody>', beside).replace('</mujoco>', rope)
        text = text.replace('<geom size=".15', '<site name="hook"/><geom size=".15')
        spec = self.planar(text.replace('<worldbody>', '<worldbody><site name="anchor"/>'))
        self.assertEqual(spec.links[0], 'trunk')
        ties = ("spatial 'rope'", "weld 'drag'", "connect 'nail'", "weld 'fix'", "joint 'slip'")
        self.assertEqual([note for note in spec.notes if 'ties' in note], [
            f'{tie} is left out: it ties the character to something else' for tie in ties
        ])  # fmt: skip
        self.assertEqual(compiled(spec).ntendon, 1)
        self.assertEqual(compiled(spec).neq, 1)

    @parameterized.parameters(True, False)
    def test_without_fall_links_no_fall_ends_an_episode(self, spatial):
        spec = self.planar(spatial=spatial, fall_links=())
        self.assertEqual(spec.fall_links, ())
        environment = self.walk(spec, terrain='plane' if spatial else 'flat')
        environment.reset()
        root = environment.physics.bind(environment.task.character.root_body)
        for _ in range(90):
            self.assertFalse(environment.step(np.zeros(4)).last())
        self.assertLess(root.xpos[2], 0.5)  # it lies on the ground
        text = repr(tasks.fall(environment.task))
        self.assertIn('the physics diverges', text)
        self.assertNotIn('a fall: ', text)

    def test_the_stops_of_joints_keep_their_stiffness(self):
        """A joint without `solreflimit`, or with MuJoCo's default, has the suite's."""
        text = MJCF.replace('name="left_hip"', 'name="left_hip" solreflimit="0.05 0.8"')
        text = text.replace('name="left_knee"', 'name="left_knee" solreflimit="-900 -30"')
        text = text.replace('name="right_hip"', 'name="right_hip" solreflimit="0.02 1"')
        environment = suite.build(self.planar(text), task='walk')
        model = environment.physics.model
        stops = {n: model.jnt_solref[model.name2id(f'figure/{n}', 'joint')].tolist() for n in (
            'left_hip', 'left_knee', 'right_hip', 'right_knee')}  # fmt: skip
        stiff = [2 * model.opt.timestep, 1]
        self.assertEqual(
            stops, {'left_hip': [0.05, 0.8], 'left_knee': [-900, -30], 'right_hip': stiff, 'right_knee': stiff}
        )  # fmt: skip

    @parameterized.parameters(
        ('FL_hip', 'FR_hip'), ('RL_foot', 'RR_foot'), ('fl', 'fr'), ('hl.knee', 'hr.knee'), ('LF_HIP', 'RF_HIP'),
        ('LH_FOOT', 'RH_FOOT'), ('lf_leg', 'rf_leg'), ('foot_FL', 'foot_FR'), ('leg_bl', 'leg_br'), ('MLHip', 'MRHip'),
        ('left_hip', 'right_hip'), ('hipL', 'hipR'), ('L_toe', 'R_toe'), ('calf_l', 'calf_r'),
    )  # fmt: skip
    def test_left_and_right_are_found_in_names(self, left, right):
        for side, expected in ((1.0, [1, 0]), (-1.0, [-1, 0])):
            places = {left: np.array([0, side, 0]), right: np.array([0, -side, 0])}
            np.testing.assert_array_equal(inspect.facing(places), expected)

    @parameterized.parameters('flap', 'Floor', 'wheel', 'rl', 'plate')
    def test_a_name_without_a_side(self, name):
        places = {name: np.array([0, 1.0, 0]), 'frap': np.zeros(3), 'Froor': np.zeros(3)}
        self.assertIsNone(inspect.facing(places))

    def test_limbs_are_found(self):
        spec = characters.from_file(self.write(MJCF))
        self.assertEqual(
            (spec.end_effectors, spec.fall_links, spec.stumble_exempt),
            (PLANAR['end_effectors'], PLANAR['fall_links'], PLANAR['end_effectors']),
        )

    def test_if_only_feet_can_touch_the_ground_there_are_no_fall_links(self):
        text = re.sub('<geom (?!name="floor"|type="capsule" size=".04" fromto="0 0 0 0 0 -.4"/></body>)',
                      '<geom contype="0" conaffinity="0" ', MJCF)  # fmt: skip
        spec = characters.from_file(self.write(text))
        self.assertEqual((spec.end_effectors, spec.fall_links), (PLANAR['end_effectors'], ()))
        self.assertIn('no fall links: no body above', '; '.join(spec.notes))

    def test_texts_that_are_accepted(self):
        """A declared version of XML is ignored, and a body may be named nan."""
        self.assertIn(
            'nan', self.planar(MJCF.replace('right_shin', 'nan'), end_effectors=('nan',)).links
        )
        for version in '"0.0" ', "'1.1'", '"1.0" encoding="iso-8859-1"':
            self.assertEqual(self.planar(f'<?xml version={version}?>{MJCF}').links[0], 'trunk')


def bowl(x, y):
    """Heights, m."""
    return 0.1 * (x**2 + y**2) / (1 + 0.1 * (x**2 + y**2))


def vee(x):
    """Heights, m."""
    return 0.2 * np.abs(x)


class TerrainTest(WrittenTest):
    """Terrain from functions, arrays, pictures and meshes; meshes from terrain."""

    def rest(self, ground, x, y=0.0):
        """Returns where a ball of 0.1 m comes to lie that is dropped onto a terrain, (3,) m."""
        arena = (SpatialArena if ground.spatial else PlanarArena)(ground)
        ball = arena.mjcf_model.worldbody.add('body', name='ball', pos=(x, y, 1.5))
        ball.add('freejoint')
        ball.add('geom', size=(0.1,), condim=6, friction=(1, 0.01, 0.005))
        root = arena.mjcf_model
        physics = mujoco.MjModel.from_xml_string(root.to_xml_string(), root.get_assets())
        batch = engine.BatchWorld(physics, 1, 1)
        arena.bind(batch)
        arena.begin_episode(
            0, (terrain.SpatialGround if ground.spatial else terrain.PlanarGround)(ground, 0)
        )
        batch.step(5000)
        return batch.qpos[0, :3].copy()

    def test_where_a_ball_comes_to_rest(self):
        trimesh.creation.box((4, 4, 1)).export(self.folder / 'table.stl')
        table = terrain.from_mesh(self.folder / 'table.stl')
        stair = terrain.from_heights([0.0, 0, 0, 1, 1, 1], 0.5, first=-2)
        for ground, place, height in (
            (table, (0.7, 0.4), 0.6), (stair, (1.0,), 1.1), (stair, (-0.5,), 0.1),
        ):  # fmt: skip
            np.testing.assert_allclose(self.rest(ground, *place)[2], height, atol=0.003)
        x, y, z = self.rest(terrain.from_function(bowl), 0.6, 0.5)
        self.assertLess(np.hypot(x, y), 0.4)
        self.assertAlmostEqual(z, 0.1 + bowl(x, y), delta=0.01)

    @parameterized.parameters(
        *zip([*terrain.PRESETS3D][::3], itertools.cycle(('.obj', '.glb', '.stl')))
    )
    def test_a_written_mesh_read_again_has_the_same_heights(self, preset, suffix):
        ground = terrain.SpatialGround(terrain.load(preset), 3)
        path = self.folder / f'ground{suffix}'
        terrain.save_mesh(ground, path, -4, 4)
        self.assertEqual([p.name for p in self.folder.iterdir()], [path.name])
        again = terrain.SpatialGround(terrain.from_mesh(path), 0)
        i = 0.2 * np.arange(-19, 20)
        x, y = np.meshgrid(i, i, indexing='ij')
        # At an upright face a point may fall to either side.
        near = [ground.height(x + dx, y + dy) for dx in (-1e-4, 1e-4) for dy in (-1e-4, 1e-4)]
        found = again.height(x, y)
        self.assertTrue((found >= np.min(near, 0) - 1e-3).all())
        self.assertTrue((found <= np.max(near, 0) + 1e-3).all())

    def test_planar_ground_written_and_read_as_a_line(self):
        strip = terrain.PlanarGround(terrain.load('slopes_mixed'), 4)
        terrain.save_mesh(strip, self.folder / 'strip.obj', -2, 12)
        mine = terrain.from_mesh(self.folder / 'strip.obj', terrain.SPACING, line=0.0)
        again = terrain.PlanarGround(mine, 0)
        x = np.arange(-60, 460) * terrain.SPACING
        np.testing.assert_allclose(again.height(x), strip.height(x), atol=1e-4)
        self.assertGreater(again.window(-60, 520)[1].sum(), 0)  # steep cells are faces

    def test_the_command_line_writes_meshes(self):
        path = self.folder / 'pillars.stl'
        self.assertEqual(cli.main(['terrain', 'pillars3d', '--output', str(path)]), 0)
        low, high = trimesh.load_mesh(path).bounds
        np.testing.assert_allclose((low[:2], high[:2]), [[-20, -20], [20, 20]], atol=1e-4)
        self.assertBetween(high[2], 6, 8)  # pillars are 2 to 8 m high

    def test_image(self):
        grey = np.zeros((5, 7), np.uint16)
        grey[0, 5] = 65535  # ahead and to the left: x = 2, y = 2 pixels
        imageio.imwrite(self.folder / 'hill.png', grey)
        ground = terrain.SpatialGround(terrain.from_image(self.folder / 'hill.png', 0.2, -1, 2), 0)
        self.assertAlmostEqual(float(ground.height(0.4, 0.4)), 2)
        self.assertAlmostEqual(float(ground.height(0.2, 0.4)), -1)
        # The heights of its rim continue.
        self.assertAlmostEqual(float(ground.height(0.4, 9)), 2)
        line = terrain.PlanarGround(
            terrain.from_image(self.folder / 'hill.png', 0.2, -1, 2, line=0.4), 0
        )
        np.testing.assert_allclose(line.height([0.4, 0.3, 0.2]), [2, 0.5, -1])
        # White and black of a printer's colours: no ink, and one of the four.
        inks = np.zeros((5, 7, 4), np.uint8)
        inks[:, 4:, 3] = 255
        Image.fromarray(inks, 'CMYK').save(self.folder / 'ink.tif')
        ground = terrain.SpatialGround(terrain.from_image(self.folder / 'ink.tif', 0.2, -1, 2), 0)
        np.testing.assert_allclose(ground.height([0.0, 0.4], [0.0, 0.0]), [2, -1], atol=0.02)

    @parameterized.parameters(3.8, 4.0)
    def test_the_rim_of_a_mesh_belongs_to_it(self, side):
        """Whether or not single precision, as in .stl, has the number."""
        box = trimesh.creation.box((2 * side, 2 * side, 1))
        box.export(self.folder / 'box.stl')
        ground = terrain.SpatialGround(terrain.from_mesh(self.folder / 'box.stl', 0.2), 0)
        x = np.array([0, side - 0.3, side, side + 3, 0])
        np.testing.assert_allclose(ground.height(x, x[::-1]), 0.5, atol=1e-6)

    def test_starts_are_spread_by_the_seed(self):
        for draw, function, place in (
            (terrain.PlanarGround, vee, (0,)), (terrain.SpatialGround, bowl, (0, 0)),
        ):  # fmt: skip
            mine = terrain.from_function(function, start_span=5)

            def at(ground, place=place):
                return float(ground.height(*place))

            heights = [at(draw(mine, seed)) for seed in range(20)]
            self.assertGreater(np.ptp(heights), 0.4)
            ground = draw(mine, 7)
            self.assertEqual(heights[7], at(ground))
            self.assertEqual(heights[7], at(draw.from_state(ground.state())))

    def test_a_line_does_not_depend_on_the_order_of_queries(self):
        mine = terrain.from_function(vee)
        whole, piecewise = terrain.PlanarGround(mine, 0), terrain.PlanarGround(mine, 0)
        for x in (0, 30, -30, 90, -55):
            piecewise.height(x)
        x = np.linspace(-60, 95, 500)
        np.testing.assert_array_equal(whole.height(x), piecewise.height(x))
        np.testing.assert_allclose(whole.height(x), vee(x), atol=0.2 * terrain.SPACING)

    def test_terrain_can_be_pickled(self):
        mine = terrain.from_heights(np.random.default_rng(0).random((9, 9)), 0.3, start_span=1)
        again = pickle.loads(pickle.dumps(mine))
        self.assertEqual(again, mine)
        grounds = [terrain.SpatialGround(each, 5).height(0.3, 0.1) for each in (mine, again)]
        self.assertEqual(*grounds)

    @parameterized.parameters(('biped2d', vee), ('biped3d', bowl))
    def test_a_batch_is_bit_for_bit_the_single_environments(self, character, function):
        spec = suite.combine(character, terrain=terrain.from_function(function, start_span=3))
        assert_rows_are_singles(spec, 3, 12, 256, seed=1)

    def test_invalid_arguments_are_rejected(self):
        f = self.folder
        box = trimesh.creation.box((1, 1, 1), trimesh.transformations.translation_matrix((9, 0, 0)))
        box.export(f / 'away.stl')
        self.write('nothing', 'broken.obj')
        self.write('nothing', 'broken.png')
        Image.fromarray(np.array([[0, -3], [5, 7]], np.int32)).save(f / 'signed.tif')
        self.write('v -1 -1\nv 1 -1\nv 0 1\nf 1 2 3\n', 'plane.obj')
        terrain.from_function(lambda x: x, 'wedge')
        cliff = terrain.from_function(lambda x: 1e300 * np.sign(x - 0.4), 'cliff')
        hole = terrain.from_function(lambda x: np.where(x > 3, np.nan, x), 'hole')
        assert_refused(
            self,
            (lambda: terrain.from_function(lambda x: x), 'has no name; pass name='),
            (lambda: terrain.from_function(np.abs, 'var2d_gaps'), 'exists; pass replace'),
            (lambda: terrain.from_function(lambda x: 2 * x, 'wedge'), 'exists; pass'),
            (lambda: terrain.from_function(lambda x, y: 0 * x, 'wedge'), 'exists and is planar; choose another name'),
            (lambda: terrain.from_function(np.abs, 'hills3d', replace=True), 'exists and is three-dimensional'),
            (lambda: terrain.register('plane')(print), "'plane' exists and is three-dimensional; choose another"),
            (lambda: terrain.register3d('var2d_gaps', replace=True)(print), "'var2d_gaps' exists and is planar"),
            (lambda: terrain.from_heights(['0', '1'], 1), 'heights: expected an array of numbers: the type is <U1'),
            (lambda: terrain.from_image(f / 'signed.tif', 1), 'signed.tif: .*mode I, .*expected 8 or 16 bits'),
            (lambda: terrain.from_function(lambda x: 0.0, 'f'), 'float64 of shape .. for an array of shape .3,.;'),
            (lambda: terrain.from_function(lambda x, y, z: x, 'f'), 'takes 3 arguments'),
            (lambda: terrain.PlanarGround(hole, 0).height(5.0), "terrain 'hole' returned nan at x = 3.* m; expected"),
            (lambda: terrain.PlanarGround(cliff, 0).height(5.0), "terrain 'cliff' returned .*; expected finite heights up to 1e.06 m"),
            (lambda: terrain.from_heights(np.zeros(5), 1, first=10**30), 'first is .1.*; expected'),
            (lambda: terrain.from_heights(np.zeros((2, 2, 2)), 1), r'\(2, 2, 2\); expected'),
            (lambda: terrain.from_heights([0, np.nan], 1), r'heights: nan at \[1\]; expected finite'),
            (lambda: terrain.from_heights([0, 0], 0), 'spacing is 0'),
            (lambda: terrain.from_heights(np.zeros((9, 5)), 0.5, line=1.1), 'line is 1.1; expected .*1'),
            (lambda: terrain.load('var2d_gaps'), "is a type of terrain; expected {'Type': 'var2d_gaps'}"),
            (lambda: terrain.from_mesh('hill.fbx'), "suffix '.fbx'; expected .obj or"),
            (lambda: terrain.from_mesh(f / 'away.stl'), 'not over the origin'),
            (lambda: terrain.from_mesh(f / 'away.stl', 50, centre=True), '1 x 1 points'),
            (lambda: terrain.from_mesh(f / 'away.stl', up='x'), "expected 'y' or 'z'"),
            (lambda: terrain.from_mesh(f / 'broken.obj'), 'not a mesh'),
            (lambda: terrain.from_mesh(f / 'plane.obj'), 'not a mesh: .*without three coordinates'),
            (lambda: terrain.from_mesh(f / 'away.stl', scale=1e7), r'reaches 9.5e\+07 m; expected no more than 1e\+06'),
            (lambda: terrain.from_image(f / 'broken.png', 1), 'broken.png: cannot be read as PNG'),
            (lambda: terrain.from_image(f / 'broken.png', 1, 2, 2), 'expected two heights'),
            (lambda: terrain.to_mesh(terrain.SpatialGround(terrain.load('plane'), 0), 0, 1e4), 'most 500 m'),
            (lambda: terrain.save_mesh(None, f / 'ground.fbx'), 'expected .obj or .glb'),
        )  # fmt: skip
        assert_refused(
            self,
            (lambda: terrain.from_function(lambda x: math.sin(x), 'f'), "function 'f' failed with .* np.sin"),
            (lambda: terrain.from_function(lambda x: x if x > 0 else 0.0, 'f'),
             "function 'f' failed with .* np.where instead of if"),
            error=TypeError,
        )  # fmt: skip
        assert_refused(
            self,
            (lambda: terrain.from_mesh(f / 'a.obj'), 'no such file'),
            (lambda: terrain.from_image(f / 'a.png', 1), 'no such file'),
            error=FileNotFoundError,
        )

    def test_a_rerun_cell_replaces_its_terrain(self):
        def cell(factor):
            names = {'np': np, '__name__': '__main__'}
            exec(f'def wavelets(x): return {factor} * np.sin(x)', names)
            return terrain.from_function(names['wavelets'])

        cell(1.0)
        again = terrain.PlanarGround(cell(0.5), 0)
        self.assertAlmostEqual(np.ptp(again.height(np.arange(0, 9, 0.1))), 1, delta=0.01)

    def test_functions_of_a_factory_do_not_replace_each_other(self):
        def made(factor):
            def ripples(x):
                return factor * np.sin(x)

            return terrain.from_function(ripples)

        first = made(1.0)
        self.assertEqual(made(1.0), first)
        with self.assertRaisesRegex(
            ValueError, "'ripples' exists; pass replace=True .* another name"
        ):
            made(0.5)
        heights = terrain.PlanarGround(first, 0).height(np.arange(0, 9, 0.1))
        self.assertAlmostEqual(np.ptp(heights), 2, delta=0.01)

    @parameterized.parameters(
        (terrain.register, lambda parameters, length, rng: None),
        (terrain.register3d, lambda parameters, rng: None),
    )
    def test_a_type_may_be_registered_again_by_the_same_function(self, register, other):
        for _ in range(2):

            @register(f'{register.__name__}_again', {'ToothW': 1.0})
            def teeth(*arguments):
                raise NotImplementedError

        with self.assertRaisesRegex(ValueError, 'exists; pass replace=True to replace it'):
            register(f'{register.__name__}_again')(other)


PARTS = {
    'rewards': {'fast': (0.5, parts.speed), 'lazy': (-0.1, parts.effort)},
    'observations': {'speed': (1, parts.speed), 'angles': (2, lambda t: parts.joint_angles(t)[:, :2])},
    'failures': {'off': lambda task: parts.speed(task) > 1e3},
}  # fmt: skip


class Rise(Walk):
    """A task of a user's."""

    def finish_step(self, env_ids):
        super().finish_step(env_ids)
        self.reward[env_ids] = parts.root(self)[env_ids, 2]


class TaskTest(parameterized.TestCase):
    """Tasks from parts."""

    @parameterized.parameters('PD_Biped2D_Flat-v0', 'PD_Biped3D_Imitate-v0')
    def test_parts_return_current_values(self, id):
        environment = suite.make(id, {'random': 1})
        environment.reset()
        names = ('height', 'root', 'speed', 'heading', 'upright', 'joint_angles', 'joint_rates')
        found = [np.asarray(getattr(parts, name)(environment.task)) for name in names]
        before = [array.copy() for array in found]
        environment.step(np.ones(environment.action_spec().shape))
        for name, array, expected in zip(names, found, before, strict=True):
            np.testing.assert_array_equal(array, expected, name)  # not a view of what changed
            if name != 'heading' or '3D' in id:
                self.assertTrue((getattr(parts, name)(environment.task) != expected).any(), name)

    @parameterized.parameters(
        'PD_Biped2D_Gaps_Terrain-v0', 'FSM_Dog2D_Terrain_Gaps-v0', 'PD_Biped3D_LLC_Symetric_Step-v0'
    )
    def test_parts_added_to_a_task_of_the_suite(self, id):
        many = VectorEnvironment(id, 3, seed=2, task_kwargs=PARTS)
        plain = VectorEnvironment(id, 3, seed=2)
        count = 2 if id.startswith('FSM') else 20  # whole cycles
        actions = np.random.default_rng(0).uniform(-1, 1, (count, 3, len(many.action_map)))
        np.testing.assert_array_equal(many.reset()[:, :-3], plain.reset())
        for action in actions:
            step, other = many.step(action), plain.step(action)
            np.testing.assert_array_equal(step.observation[:, :-3], other.observation)
            np.testing.assert_array_equal(step.terminated, other.terminated)
            terms = step.info['reward_terms']
            np.testing.assert_allclose(sum(terms.values()), step.reward, atol=1e-12)
            np.testing.assert_allclose(
                step.reward - terms['fast'] - terms['lazy'], other.reward, atol=1e-12
            )
            self.assertEqual(step.observation.shape[1], many.blocks['angles'].stop)
        assert_rows_are_singles(id, 3, count, 256, PARTS, seed=2)

    def test_no_term_is_added_at_a_fall(self):
        options = {'rewards': {'one': (0.5, lambda task: np.ones(task.world.n))}}
        many = VectorEnvironment('PD_Biped2D_Gaps_Terrain-v0', 3, 1, 2, task_kwargs=options)
        many.reset()
        falls = 0
        for action in np.random.default_rng(0).uniform(-1, 1, (60, 3, 11)):
            step = many.step(action)
            np.testing.assert_array_equal(step.reward[step.terminated], 0)
            falls += step.terminated.sum()
        self.assertGreater(falls, 0)

    def test_parts_in_three_dimensions(self):
        environment = suite.make('PD_Biped3D_Imitate-Hills_Terrain-v0', {'random': 1})
        environment.reset()
        task, data = environment.task, environment.physics.data
        lean = np.array([np.cos(0.2), 0, np.sin(0.2), 0])
        data.qpos[task.body.pose_qpos[3:7]] = quaternion.multiply(quaternion.about_z(0.7), lean)
        data.qvel[task.body.pose_dof[:2]] = 0.5, 2.0
        environment.physics.forward()
        self.assertAlmostEqual(parts.heading(task)[0], 0.7)
        self.assertAlmostEqual(parts.upright(task)[0], np.cos(0.4))
        self.assertAlmostEqual(parts.speed(task)[0], 0.5 * np.cos(0.7) + 2 * np.sin(0.7))
        x, y, z = data.qpos[task.body.pose_qpos[:3]]
        under = heights_at(environment, np.array([x]), np.array([y]))[0]
        self.assertAlmostEqual(parts.height(task)[0], z - under, places=6)
        self.assertGreater(abs(under), 1e-3)
        np.testing.assert_array_equal(parts.joint_rates(task)[0], data.qvel[task.body.pose_dof[6:]])

    def test_walk_by_its_definitions(self):
        environment = suite.build('biped3d', task='walk', task_kwargs={'random': 1})
        environment.reset()
        task, data = environment.task, environment.physics.data
        task.travel.origin[0, 2] = 0.5
        data.qvel[task.body.pose_dof[:2]] = 0.3, 0.4
        environment.physics.forward()
        task.observe()
        off = 0.5 - parts.heading(task)[0]
        found = task.observation[0, environment.blocks['target_heading']]
        np.testing.assert_allclose(found, (np.cos(off), np.sin(off)), atol=1e-9)
        speed = 0.3 * np.cos(0.5) + 0.4 * np.sin(0.5)
        self.assertAlmostEqual(walk.speed_ratio(task)[0], speed / task.full_speed)
        environment.step(np.full(len(environment.action_map), 0.5))
        self.assertAlmostEqual(environment.info['reward_terms']['low_effort'], 0.1 * 0.75)

    def test_values_of_parts_equal_their_definitions(self):
        environment = suite.make('PD_Biped2D_Flat-v0', {'random': 1, **PARTS})
        environment.reset()
        data = environment.physics.named.data
        for _ in range(3):
            step = environment.step(np.full(11, 0.5))
        self.assertEqual(step.observation['speed'][0], data.qvel['biped2d_full/root_x/'][0])
        self.assertAlmostEqual(environment.info['reward_terms']['lazy'], -0.1 * 0.25)

    def test_a_failure_ends_the_episode(self):
        failures = {'tall': lambda task: parts.height(task) > 0.5}
        environment = suite.make('PD_Biped2D_Flat-v0', {'random': 1, 'failures': failures})
        environment.reset()
        step = environment.step(np.zeros(11))
        self.assertTrue(step.last())
        self.assertEqual(step.discount, 0)
        self.assertFalse(environment.info['fell'])

    @parameterized.parameters('biped2d', 'biped3d')
    def test_a_users_own_task(self, character):
        spec = suite.combine(character, task=Rise)
        environment = suite.build(
            character, task=Rise, task_kwargs={'random': 1, 'action_scale': 1.0}
        )
        environment.reset()
        height = environment.step(np.zeros(environment.action_spec().shape)).reward
        self.assertBetween(height, 0.6, 1.0)
        many = VectorEnvironment(spec, 2, seed=0)
        many.reset()
        np.testing.assert_allclose(
            many.step(np.zeros((2, len(many.action_map)))).reward, height, atol=0.05
        )
        with self.assertRaisesRegex(ValueError, "unknown option .*'action_scal'.*'action_scale'"):
            suite.build(character, task=Rise, task_kwargs={'action_scal': 1})

    def test_a_users_own_function(self):
        """Its further arguments are options, by keyword or not."""
        given = []

        def rise(character, arena, actuation_model='position', height=0.3, *, weight=1.0):
            given.append((height, weight))
            return Rise(character, arena, actuation_model=actuation_model)

        spec = suite.combine('biped2d', task=rise)
        self.assertEqual([*build.task_options(spec)], ['height', 'weight'])
        suite.build('biped2d', task=rise, task_kwargs={'height': 0.5, 'weight': 2.0})
        self.assertEqual(given[-1], (0.5, 2.0))
        with self.assertRaisesRegex(ValueError, "unknown option .*'hight'.*'height'"):
            suite.build('biped2d', task=rise, task_kwargs={'hight': 0.5})

    def test_walking_is_rewarded(self):
        environment = suite.build('biped3d', task='walk', task_kwargs={'random': 1})
        environment.reset()
        action = np.zeros(environment.action_spec().shape)
        standing = environment.step(action).reward
        self.assertBetween(standing, 0.25, 0.4)
        environment.physics.data.qvel[0] = environment.task.full_speed
        self.assertBetween(environment.step(action).reward, 0.8, 1.0)

    def test_invalid_parts_are_rejected(self):
        def step(options):
            environment = suite.make('PD_Biped2D_Flat-v0', options)
            environment.reset()
            environment.step(np.zeros(11))

        assert_refused(self, *((lambda o=o: step(o), message) for o, message in (
            ({'rewards': {'a': (1, parts.joint_angles)}}, r"reward 'a' has shape \(1, 11\)"),
            ({'rewards': {'a': (1, lambda t: np.full(1, np.inf))}}, "'a' is .inf.; expected finite numbers up to 1e.30"),
            ({'rewards': {'a': (1e300, lambda t: np.full(1, 1e10))}}, "reward 'a' is .inf.; expected finite"),
            ({'observations': {'a': (1, lambda t: np.full(1, 1e39))}}, "observation 'a' is .1.e.39.; expected finite"),
            ({'observations': {'a': (-5, parts.speed)}}, "size of observation 'a' is -5; expected a whole number at least 1"),
            ({'observations': {'pose': (1, parts.speed)}}, "already has a block 'pose'"),
            ({'rewards': {'a': parts.speed}}, r'expected \(weight, function\)'),
            ({'rewards': {'a': (1.0, 1.0)}}, "reward 'a' is 1.0; expected a function of the task"),
            ({'rewards': {'a': (math.inf, parts.speed)}}, "weight of reward 'a' is inf; expected a number"),
            ({'rewards': {'pose': (1, parts.speed)}}, "already has a reward term 'pose'"),
            ({'failures': {'a': 1}}, 'expected a function'),
            ({'rewards': [1]}, 'expected a dict'), ({'reward': {}}, "did you mean 'rewards'"),
        )))  # fmt: skip


class WorkingFolderTest(FolderTest):
    """What was read when an environment was built is not read again."""

    @parameterized.parameters('clip', 'terrain', 'controller', 'controllers')
    def test_copies_in_another_folder(self, part):
        motion.load('biped2d_walk').save(self.folder / 'walk.npz')
        (self.folder / 'gaps.json').write_text(
            '{"Type": "var2d_gaps", "Params": [{"GapSpacingMin": 2, "GapSpacingMax": 3}]}'
        )
        policies.save(
            policies.reference('PD_Biped3D_LLC_General_Step-v0'), self.folder / 'controller.npz'
        )
        with contextlib.chdir(self.folder):
            options = {}
            if part.startswith('controller'):
                path = pathlib.Path('controller.npz')
                given = str(path) if part == 'controller' else [path, 'controller.npz']
                spec, options = 'PD_Biped3D_HLC_Soccer-v0', {'controller': given}
                environment = suite.make(spec, options)
            else:
                parts = {part: {'clip': 'walk.npz', 'terrain': 'gaps.json'}[part]}
                environment = suite.build('biped2d', **parts)
                spec = suite.combine('biped2d', **parts)
            many = VectorEnvironment(spec, 2, 1, task_kwargs=options)
        environment.reset()
        many.reset()
        state = copy.deepcopy(environment).get_state()
        self.assertEqual(state['made_for'], environment.get_state()['made_for'])
        self.assertEqual(many.render(0, height=32, width=32).shape, (32, 32, 3))


class ExampleTest(FolderTest):
    """The examples run and are short; so does the page."""

    def setUp(self):
        super().setUp()
        self.enterContext(mock.patch.dict(generators._planar))  # they register types

    def test_code_of_the_page_runs(self):
        page = (EXAMPLES.parent / 'docs' / 'make_your_own.md').read_text(encoding='utf-8')
        code = '\n'.join(re.findall('```python\n(.*?)```', page, re.DOTALL))
        clip = motion.load(characters.CHARACTERS['biped3d_full_mocap'].clip)
        figure = own_clip_test.Figure('biped3d_full_mocap', clip, frames=61)
        own_clip_test.write_bvh(figure, self.folder / 'walk.bvh')
        with contextlib.chdir(self.folder):
            exec(compile(code, 'make_your_own.md', 'exec'), {'__name__': 'page'})

    @parameterized.parameters('own_character', 'own_terrain', 'own_task')
    def test_example_runs(self, name):
        path, output = EXAMPLES / f'{name}.py', self.folder / 'picture.png'
        self.assertLess(len(path.read_text().splitlines()), 42)
        with (
            mock.patch.object(sys, 'argv', [name, '--output', str(output)]),
            mock.patch.object(program, 'begin_script'),  # it is for processes of their own
        ):
            runpy.run_path(str(path), run_name='__main__')
        self.assertGreater(imageio.imread(output).std(), 10)
