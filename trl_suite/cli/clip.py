"""`trl-suite clip`: retargets a motion file to a character, and checks it."""

from __future__ import annotations

import argparse
import pathlib
from typing import Any

from trl_suite import rendering
from trl_suite.cli import engine
from trl_suite.cli.arguments import add_command, add_file
from trl_suite.util import files, program


def declare(commands: Any) -> None:
    """Declares the command and its arguments."""
    text = 'retarget a motion file to a character, and check it'
    command = add_command(commands, 'clip', text, run)
    text = 'BVH, Acclaim (.amc), JSON of TerrainRL or DeepMimic, or a clip; recognised from the content'
    command.add_argument('file', metavar='FILE', type=pathlib.Path, help=text)
    command.add_argument('--character', required=True, help='name of a character')
    add_file(command, '--skeleton', 'the .asf file of an .amc file')
    text = 'frames per second of an .amc file; by default those that it states, or else 120'
    command.add_argument('--rate', type=float, help=text)
    text = 'unit of lengths in m, by default 0.01 of BVH and 0.0254 (an inch) of .amc files'
    command.add_argument('--unit', type=float, metavar='M', help=text)
    for name, axis in (
        ('--forward', 'that the rest pose faces, by default z'),
        ('--up', 'that points up, by default y'),
    ):
        text = f'axis of a BVH or .amc file {axis}; a negative one as {name}=-x'
        command.add_argument(name, metavar='AXIS', help=text)
    text = (
        "a .json that maps the character's joints to the motion's; by default usual names are tried"
    )
    add_file(command, '--map', text)
    command.add_argument(
        '--scale',
        type=float,
        help='factor on lengths; by default the ratio of limb lengths, or of roots of clips',
    )
    text = 'cut one cycle, between two times (s), or without times the best cycle that is found'
    command.add_argument('--cycle', nargs='*', type=float, metavar='TIME', help=text)
    command.add_argument('--frames', action='store_true', help='print the faults of every frame')
    add_file(command, '--output', 'write the clip, .npz', '.npz')
    add_file(command, '--strip', 'write a film strip, .png', *rendering.IMAGE_SUFFIXES)


def run(arguments: argparse.Namespace) -> None:
    """Retargets a motion file to a character, and prints the faults of the clip."""
    if arguments.cycle and len(arguments.cycle) != 2:
        raise ValueError(f'--cycle: {len(arguments.cycle)} times; expected none or two')
    engine.load()
    from trl_suite import retargeting
    from trl_suite.rendering.kinematic_viewer import KinematicViewer
    from trl_suite.retargeting import clip_check

    chosen = None
    if arguments.map is not None:
        chosen = _joint_map(arguments.map)
    name = arguments.character
    given = {option: getattr(arguments, option) for option in ('rate', 'unit', 'forward', 'up')}
    options = {option: value for option, value in given.items() if value is not None}
    motion = retargeting.read(arguments.file, name, arguments.skeleton, **options)
    clip = retargeting.retarget(motion, name, chosen, arguments.scale)
    if clip is not motion:
        joints = KinematicViewer(name).layout.joints
        followed = retargeting.counterparts(motion, joints, chosen)
        still = [joint for joint in joints if joint not in followed]
        pairs = ', '.join(f'{own} from {other}' for own, other in followed.items())
        print(f'joints: {program.printable(pairs)}')
        if still:
            print('joints without a counterpart:', ', '.join(still))
    if arguments.cycle is not None:
        clip = retargeting.cycle(clip, *arguments.cycle)
    report = clip_check.check(clip, name)
    print(*map(program.printable, str(report).splitlines()), sep='\n')
    for fault in report.faults if arguments.frames else ():
        print(
            f'frame {fault.frame}, {fault.time:.3f} s: {fault.kind}, {fault.name}, '
            f'{fault.amount:.3g} {fault.unit}'
        )
    if arguments.output is not None:
        clip.save(arguments.output)
        print(arguments.output)
    if arguments.strip is not None:
        image = KinematicViewer(name).film_strip(clip, height=240, width=320)
        rendering.film_strip([image], arguments.strip)
        print(arguments.strip)


def _joint_map(path: pathlib.Path) -> dict[str, str]:
    """Reads the map from joints of the character to joints of the motion."""
    content = files.read_json(files.existing(path))
    if not isinstance(content, dict) or not all(isinstance(v, str) for v in content.values()):
        raise ValueError(
            f'{path}: expected an object of names, {{"joint of the character": "joint of the motion"}}'
        )
    return content
