"""A custom character from a file, with an open-loop trot. Needs `pip install 'trl_suite[video]'`."""

import argparse
import pathlib

import numpy as np

from trl_suite import characters, rendering, suite
from trl_suite.util.program import begin_script

FEET = [f'{end}_{side}_foot' for end in ('front', 'hind') for side in ('right', 'left')]
LINK = '<link name="{}"><inertial><origin xyz="0 0 {z}"/><mass value="{m}"/><inertia ixx="{i}" iyy="{i}" izz="{i}" ixy="0" ixz="0" iyz="0"/></inertial><collision><origin xyz="0 0 {z}"/><geometry><box size="{size}"/></geometry></collision></link>'
JOINT = '<joint name="{}" type="revolute"><parent link="{}"/><child link="{}"/><origin xyz="{}"/><axis xyz="0 -1 0"/><limit lower="{}" upper="1.2" effort="40"/></joint>'

begin_script()
parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument('file', nargs='?', type=pathlib.Path)
parser.add_argument('--feet', nargs='+', default=FEET)
parser.add_argument('--fall', nargs='+', default=['trunk'])
parser.add_argument('--terrain', help='level ground by default')
parser.add_argument('--spatial', action=argparse.BooleanOptionalAction)  # default: by root joints
parser.add_argument('--seed', type=int, default=1)
parser.add_argument('--output', type=pathlib.Path, default='own_character.png')
args = parser.parse_args()
if args.file is None:
    args.spatial, args.file = True, args.output.with_name('table.urdf')
    parts = [LINK.format('trunk', z=0, m=8, i=0.2, size='.6 .25 .12')]
    for k, (foot, leg) in enumerate((foot, foot[:-5]) for foot in FEET):
        parts += [LINK.format(x, z=-0.12, m=0.5, i=0.003, size='.05 .05 .22') for x in (leg, foot)]
        place = f'{0.25 - 0.5 * (k > 1)} {0.3 * (k % 2) - 0.15} 0'
        parts.append(JOINT.format(f'{leg}_hip', 'trunk', leg, place, -1.2))
        parts.append(JOINT.format(f'{leg}_knee', leg, foot, '0 0 -.25', -2))
    args.file.write_text(f'<robot name="table">{"".join(parts)}</robot>')
links = {'end_effectors': args.feet, 'fall_links': args.fall}
spec = characters.from_file(args.file, **links, spatial=args.spatial)
print(*spec.notes, sep='\n')  # defaults that were used
env = suite.build(spec, terrain=args.terrain, task='walk', task_kwargs={'random': args.seed})
i = np.arange(len(env.action_map))
bend, trot = 0.2 - 0.6 * (i % 2), np.pi * ((i // 2 + i // 4) % 2 - i % 2 / 2)
policy = lambda _: bend + 0.3 * np.sin(15 * env.physics.time() + trot)  # noqa: E731
rendering.film_strip(rendering.frames(env, policy, steps=40), args.output, columns=4)
