"""MJCF and URDF files from a grammar: each is read, or refused by name, in limited time and memory.

The grammar of MJCF is dm_control's schema. One file of each kind is always the same; the slow tests
(`-m slow`) draw a seed, print it, and take it from FUZZ_SEED if that is set; FUZZ_EXAMPLES says how many.
"""

import os
import pathlib
import random
import re
import struct
import tempfile
import time
from unittest import mock
from xml.sax import saxutils

import imageio.v3 as iio
import numpy as np
import pytest
import trimesh
from absl.testing import parameterized
from dm_control.mjcf import schema

from trl_suite import characters, suite
from trl_suite.util import limited

SLOW = int(os.environ.get('FUZZ_EXAMPLES', '500'))
SECONDS = 3  # of processor time for one file
NUMBERS = ('0', '1', '-1', '2', '0.1', '.05', '1.5', '90', '-30', '1e-3')
POSITIVE = ('.1', '.1', '.2', '.5', '1', '1.5')
SIZES = (
    'size', 'radius', 'length', 'mass', 'scale', 'spacing', 'diaginertia', 'density', 'timestep', 'extent',
    'meaninertia', 'meanmass', 'meansize', 'fovy',
)  # fmt: skip
TURNS = ('quat', 'axisangle', 'xyaxes', 'zaxis', 'euler')
WHOLE = ('0', '1', '1', '2', '2', '3', '4', '10')
EXTREMES = (
    'nan', 'inf', '-inf', '1e-320', '1e-15', '1e10', '1e15', '1e29', '-1e30', '1e31', '1e400', '+5', '+2000000',
    '2147483647', '-2147483648', '2000000000', '1000', '60000', 30 * '9', '', 'x', '0x10', '1 2', '1,2',
)  # fmt: skip
NAMES = ('trunk', 'leg', 'hip', 'skin', 'a', 'b', 'main', 'world')
BROKEN = (
    'huge.stl', 'text.obj', 'huge.bin', 'part.xml', 'sub.xml', 'figure.xml', 'absent.stl', '.', '/dev/zero',
)  # fmt: skip
FILES = {'mesh': ('box.stl', 'box.obj'), 'hfield': ('field.bin',), 'texture': ('grey.png',)}
WORLD = schema.MUJOCO.children['worldbody']
BODY = WORLD.children['body']
SECTIONS = [each for name, each in schema.MUJOCO.children.items() if name != 'worldbody']
BOX = '<geom type="box" size=".1 .1 .2"/>'
LINKS = {'end_effectors': ('leg',), 'fall_links': ('trunk',), 'root': 'trunk', 'spatial': True}


class Grammar:
    """Draws files."""

    def __init__(self, seed):
        self.random = random.Random(seed)
        self.extreme = self.random.choice((0.0, 0.01, 0.1))

    def choose(self, choices):
        return self.random.choice(EXTREMES if self.random.random() < self.extreme else choices)

    def numbers(self, length, choices=NUMBERS):
        return ' '.join(self.choose(choices) for _ in range(length))

    def file(self, choices):
        return self.random.choice(choices if self.random.random() > 3 * self.extreme else BROKEN)

    def value(self, attribute):
        kind, more = attribute.type.__name__, attribute.other_kwargs
        numbers = POSITIVE if attribute.name in SIZES else NUMBERS
        if kind == 'Array':
            length = more.get('length') or self.random.randint(1, 6)
            whole = attribute.name in ('count', 'vertid', 'face', 'element', 'id')
            return self.numbers(length, WHOLE if whole else numbers)
        if kind == 'File':
            return self.file(FILES.get(more['path_namespace'], BROKEN))
        choices = {
            'Keyword': more.get('valid_values'), 'Float': numbers, 'Integer': WHOLE,
            'BasePath': ('', '.', '/'), 'String': (*NAMES, '1M', 'mujoco.sdf.torus', 'mujoco.elasticity.cable'),
        }  # fmt: skip
        return self.choose(list(choices.get(kind) or NAMES))

    def tag(self, name, attributes, inside=''):
        text = ''.join(f' {key}={saxutils.quoteattr(value)}' for key, value in attributes.items())
        return f'<{name}{text}>{inside}</{name}>'

    def element(self, element, depth=0):
        """An element of the schema, sometimes copied, moved or replaced."""
        chosen, few = {}, 3 / (1 + len(element.attributes))
        skipped = {'class', 'childclass', *TURNS} - {self.random.choice(TURNS)}
        for name, attribute in element.attributes.items():
            if name in skipped and self.random.random() > self.extreme:
                continue
            if attribute.required or self.random.random() < few:
                chosen[name] = self.value(attribute)
        inside = ''
        if depth < 3 and element.children:
            inside = self.some([*element.children.values()], 2, depth + 1)
        text = self.tag(element.name, chosen, inside)
        return self.wrapped(text, depth) if element.name in WORLD.children else text

    def wrapped(self, text, depth):
        how = self.random.choice(
            ('',) * 12 + ('frame', 'replicate', 'replicate', 'attach', 'include')
        )
        if how == 'frame':
            return self.tag('frame', {'pos': self.numbers(3), 'euler': self.numbers(3)}, text)
        if how == 'replicate':
            count = {'count': self.choose((*WHOLE, '100')), 'euler': self.numbers(3)}
            return self.tag(
                'replicate', count, text if depth > 2 else self.wrapped(text, depth + 1)
            )
        if how == 'attach':
            return self.tag('attach', {'model': 'sub', 'body': 'b', 'prefix': self.choose(NAMES)})
        if how == 'include':
            return self.tag('include', {'file': self.file(('part.xml',))})
        return text

    def some(self, elements, most, depth=0):
        chosen = self.random.choices(elements, k=self.random.randint(0, most))
        seldom = {each.name: each for each in chosen if not each.repeated}
        chosen = [each for each in chosen if each.repeated] + [*seldom.values()]
        return ''.join(self.element(each, depth) for each in chosen)

    def figure(self):
        """A figure with a leg that would be read, and elements that may change that."""
        inside = [*BODY.children.values()]
        world = self.some([*WORLD.children.values()], 1)
        leg = f'<body name="leg" pos="0 0 -.5"><joint name="hip" axis="0 1 0"/>{BOX}{self.some(inside, 1)}</body>'
        trunk = (
            f'<body name="trunk" pos="0 0 1"><freejoint/>{BOX}{self.some(inside, 2)}{leg}</body>'
        )
        sub = '<model name="sub" file="sub.xml"/>' if '<attach' in world + trunk else ''
        asset = f'<asset>{sub}<mesh name="a" file="{self.file(FILES["mesh"])}"/></asset>'
        return (
            f'<mujoco>{asset}{self.some(SECTIONS, 2)}<worldbody>{world}{trunk}</worldbody></mujoco>'
        )

    def part(self):
        return f'<mujoco>{self.some([*BODY.children.values()], 2)}</mujoco>'

    def sub(self):
        inside = self.some([*BODY.children.values()], 2)
        asset = '<asset><model name="sub" file="sub.xml"/></asset>' if '<attach' in inside else ''
        return f'<mujoco>{asset}<worldbody><body name="b">{BOX}{inside}</body></worldbody></mujoco>'

    def shape(self):
        size, mesh = self.numbers(3, POSITIVE), self.file((*FILES['mesh'], 'package://a/box.stl'))
        radius, length = self.numbers(1, POSITIVE), self.numbers(1, POSITIVE)
        return self.random.choice((
            f'<box size="{size}"/>', f'<sphere radius="{radius}"/>',
            f'<cylinder radius="{radius}" length="{length}"/>', f'<mesh filename="{mesh}" scale="{size}"/>',
            '<box size=".1 .1 .3"/>',
        ))  # fmt: skip

    def link(self, name):
        origin = f'<origin xyz="{self.numbers(3)}" rpy="{self.numbers(3)}"/>'
        mass, inertia = self.choose(('1', '2', '.1')), self.choose(('.1', '.01', '1'))
        inertial = (
            f'<inertial>{origin}<mass value="{mass}"/><inertia ixx="{inertia}" iyy="{inertia}" izz="{inertia}"'
            f' ixy="0" ixz="0" iyz="{self.choose(("0",))}"/></inertial>'
        )
        collision = f'<collision>{origin}<geometry>{self.shape()}</geometry></collision>'
        return f'<link name="{name}">{inertial}{self.random.choice((0, 1, 1, 1, 2)) * collision}</link>'

    def robot(self):
        """A URDF file."""
        links = [
            'trunk',
            'leg',
            *self.random.sample(('a', 'b', 'c', 'd'), self.random.randint(0, 4)),
        ]
        text = ''.join(map(self.link, links))
        for i, child in enumerate(links[1:], 1):
            kind = self.choose((*4 * ('revolute',), 'continuous', 'prismatic', 'fixed'))
            low, high, effort = (
                self.choose(('-1', '0')),
                self.choose(('1', '.5')),
                self.choose(('9', '0')),
            )
            text += (
                f'<joint name="{self.choose((f"j{i}",))}" type="{kind if i > 1 else "revolute"}">'
                f'<parent link="{self.random.choice(links[:i])}"/><child link="{self.choose((child,))}"/>'
                f'<origin xyz="{self.numbers(3)}"/><axis xyz="{self.choose(("0 1 0", "1 0 0", "1 1 0"))}"/>'
                f'<limit lower="{low}" upper="{high}" effort="{effort}" velocity="{self.numbers(1)}"/>'
                f'<dynamics damping="{self.choose(("0", "1"))}" friction="{self.choose(("0", "1"))}"/></joint>'
            )
        return f'<robot name="r">{text}</robot>'


def write_assets(folder):
    """Writes what files from the grammar refer to: valid files, and those that promise too much."""
    box = trimesh.creation.box((0.2, 0.2, 0.4))
    box.export(folder / 'box.stl')
    box.export(folder / 'box.obj')
    (folder / 'huge.stl').write_bytes(bytes(80) + struct.pack('<I', 2**32 - 1) + bytes(500))
    (folder / 'text.obj').write_text('v 1 2 nan\nf 1 2 999999999\n')
    (folder / 'field.bin').write_bytes(struct.pack('<2i', 3, 3) + np.ones(9, '<f4').tobytes())
    (folder / 'huge.bin').write_bytes(struct.pack('<2i', 2**31 - 1, 2**31 - 1))
    iio.imwrite(folder / 'grey.png', np.zeros((4, 4), np.uint8))


def check(path):
    """Reads a file; what is accepted can be simulated. Returns what was refused."""
    begin = time.perf_counter()
    try:
        row = characters.from_file(path, **LINKS)
    except ValueError as error:
        assert str(error).startswith(f'{path}: '), error
        assert not re.search(
            ': (Assertion|Attribute|Index|Key|Name|Type|ZeroDivision)Error:', str(error)
        ), error
        return str(error)
    finally:
        assert time.perf_counter() - begin < limited.WAIT
    environment = suite.build(row, task='walk', task_kwargs={'random': 0})
    environment.reset()
    step = environment.step(np.zeros(environment.action_spec().shape))
    assert all(np.isfinite(value).all() for value in step.observation.values())
    return ''


class FuzzTest(parameterized.TestCase):
    def setUp(self):
        super().setUp()
        self.folder = pathlib.Path(self.enterContext(tempfile.TemporaryDirectory()))
        self.enterContext(mock.patch.object(limited, 'SECONDS', SECONDS))
        write_assets(self.folder)

    def draw(self, kind, seed):
        grammar = Grammar(seed)
        for name, text in (('part.xml', grammar.part()), ('sub.xml', grammar.sub())):
            (self.folder / name).write_text(text)
        path = self.folder / ('figure.xml' if kind == 'mjcf' else 'figure.urdf')
        path.write_text(grammar.figure() if kind == 'mjcf' else grammar.robot())
        return path

    @parameterized.parameters(('mjcf', (0, 288, 306, 311)), ('urdf', (0, 1, 2)))
    def test_files_from_a_grammar(self, kind, seeds):
        refused = [check(self.draw(kind, seed)) for seed in seeds]
        self.assertIn('', refused)
        self.assertNotEmpty(refused[0])

    @parameterized.parameters('mjcf', 'urdf')
    @pytest.mark.slow
    def test_many_files_from_a_grammar(self, kind):
        seed = int(os.environ.get('FUZZ_SEED', random.SystemRandom().randrange(2**32)))
        print(f'FUZZ_SEED={seed}', flush=True)
        for i in range(SLOW):
            with self.subTest(kind=kind, seed=seed + i):
                check(self.draw(kind, seed + i))
