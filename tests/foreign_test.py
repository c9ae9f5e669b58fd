"""Tests of characters whose files come with other packages: what they keep, and that they stand."""

import importlib.util
import itertools
import pathlib

import mujoco
import numpy as np
import pytest
from absl.testing import parameterized

from trl_suite import characters, suite

LOCOMOTION = 'dm_control/locomotion/walkers/assets/'
GYMNASIUM = 'gymnasium/envs/mujoco/assets/'
HANDS = {'end_effectors': ('foot_L', 'foot_R', 'hand_L', 'hand_R'), 'fall_links': ('skull',)}
FEET = {'end_effectors': ('right_foot', 'left_foot'), 'fall_links': ('torso',)}
ENDS = {'end_effectors': ('ffoot', 'bfoot'), 'fall_links': ('torso',)}
CMU = {'end_effectors': ('lfoot', 'rfoot'), 'fall_links': ('head', 'thorax')}
TOES = {
    'end_effectors': tuple(f'toe_{x}_{y}' for x in ('front', 'back') for y in ('left', 'right')),
    'fall_links': ('torso',),
    'root': 'torso',
}
DOG = 'dm_control/suite/dog.xml'
# File -> arguments, and the least height of the root after a second, as a share of that at first;
# humanoids do not stand by themselves.
FILES = {
    'dm_control/suite/walker.xml': (FEET, 0.9),
    'dm_control/suite/cheetah.xml': (ENDS, 0.9),
    'dm_control/suite/humanoid.xml': (FEET, 0.0),
    'dm_control/suite/quadruped.xml': (TOES, 0.8),
    # Up is y in the first, which stands as the package has it turned; the other is turned in the file.
    f'{LOCOMOTION}humanoid_CMU_V2020.xml': ({**CMU, 'spatial': True, 'turn': (0.859, 1, 1, 0.859)}, 0.0),
    'dm_control/suite/humanoid_CMU.xml': ({**CMU, 'turn': (0.7071, 0, 0, 0.7071)}, 0.0),
    f'{LOCOMOTION}rodent.xml': ({**HANDS, 'root': 'torso', 'spatial': True}, 0.8),
    f'{GYMNASIUM}walker2d_v5.xml': ({**FEET, 'end_effectors': ('foot', 'foot_left')}, 0.9),
    f'{GYMNASIUM}half_cheetah.xml': (ENDS, 0.9),
    f'{GYMNASIUM}hopper.xml': ({**FEET, 'end_effectors': ('foot',), 'name': 'hopper1'}, 0.9),
    f'{GYMNASIUM}ant.xml': ({**FEET, 'end_effectors': tuple(f'ankle_{i}' for i in range(1, 5))}, 0.4),
    f'{GYMNASIUM}humanoid.xml': (FEET, 0.0),
}  # fmt: skip


def file(test, path):
    """Returns a file of an installed package."""
    package, _, inside = path.partition('/')
    found = importlib.util.find_spec(package)
    if found is None:
        test.skipTest(f'{package} is not installed')
    return pathlib.Path(found.submodule_search_locations[0]) / inside


def colliding(model, bodies):
    """Returns pairs of bodies, by number among those given, that collide by masks and exclusions."""
    found = set()
    excluded = set(model.exclude_signature.tolist())
    number = {body: i for i, body in enumerate(bodies)}
    geoms = [g for g in range(model.ngeom) if model.geom_bodyid[g] in number]
    for a, b in itertools.combinations(geoms, 2):
        first, second = sorted(model.geom_bodyid[[a, b]].tolist())
        welded = model.body_weldid[[first, second]]
        above = model.body_weldid[model.body_parentid[welded]]
        masks = model.geom_contype[a] & model.geom_conaffinity[b]
        masks |= model.geom_contype[b] & model.geom_conaffinity[a]
        apart = welded[0] != welded[1] and not (welded == above[::-1]).any()
        if masks and apart and (first << 16) + second not in excluded:
            found.add((number[first], number[second]))
    return found


class ForeignFileTest(parameterized.TestCase):
    """Files that were written for other programs."""

    @parameterized.parameters(*FILES)
    def test_the_same_geoms_collide_and_it_stands(self, path):
        self.check(path)

    @pytest.mark.slow  # its meshes take half a gigabyte and several seconds
    def test_a_dog(self):
        self.check(DOG)

    def check(self, path):
        arguments, least = FILES.get(path, ({**HANDS, 'name': 'dog1', 'root': 'torso'}, 0.9))
        spec = mujoco.MjSpec.from_file(str(file(self, path)))
        made = characters.from_file(file(self, path), **arguments)
        root = next(body for body in spec.bodies if body.name == made.links[0])
        if not root.joints:
            root.add_freejoint()  # or all that hangs on it is welded to the world
        theirs = spec.compile()
        expected = colliding(theirs, np.flatnonzero(theirs.body_rootid == root.id))
        del spec, theirs, root  # meshes take much memory
        environment = suite.build(made, task='walk', task_kwargs={'random': 0})
        environment.reset()
        physics, root = environment.physics, environment.task.character.root_body
        names = [physics.model.id2name(i, 'body') for i in range(physics.model.nbody)]
        own = np.array([name.startswith(f'{made.name}/') for name in names])
        # Without the frame to which it is attached.
        self.assertEqual(colliding(physics.model.ptr, np.flatnonzero(own)[1:].tolist()), expected)
        bodies, begin = physics.model.geom_bodyid, physics.bind(root).xpos[2]
        within = [c.dist for c in physics.data.contact if own[bodies[[c.geom1, c.geom2]]].all()]
        self.assertGreater(min(within, default=0.0), -0.01)
        for _ in range(30):
            time_step = environment.step(np.zeros(len(environment.action_map)))
            self.assertFalse(environment.info['diverged'])
            if time_step.last():
                self.assertEqual(least, 0.0)  # it fell
                return
        self.assertGreater(physics.bind(root).xpos[2], least * begin)
