"""`trl-suite try`: reads a character from a file, prints its properties, and renders it."""

from __future__ import annotations

import argparse
import pathlib
import re
from typing import TYPE_CHECKING, Any

import numpy as np

from trl_suite import rendering
from trl_suite.cli import engine
from trl_suite.cli.arguments import add_command, add_file
from trl_suite.util import files, program, tables

if TYPE_CHECKING:
    from trl_suite.characters import CharacterSpec
    from trl_suite.environments.environment import Environment

TERRAINS = {True: ('plane', 'hills3d', 'stairs3d'), False: ('flat', 'slopes', 'steps')}
SECONDS = 1.0  # duration of zero actions before a picture is rendered
OPTIONS = ('root', 'spatial', 'turn', 'end_effectors', 'fall_links', 'balance_inertia')
_ARGUMENTS = re.compile(rf'\b({"|".join(OPTIONS)})=(True|False)?')


def declare(commands: Any) -> None:
    """Declares the command and its arguments."""
    text = 'read a character from a file, print its properties, and render it'
    command = add_command(commands, 'try', text, run)
    command.add_argument('file', metavar='FILE', type=pathlib.Path, help='an .xml, .mjcf or .urdf')
    command.add_argument(
        '--root', metavar='BODY', help='root of the character, parent of all other links'
    )
    command.add_argument(
        '--end-effectors',
        nargs='+',
        metavar='BODY',
        help='by default the ends of limbs below the centre of mass',
    )
    text = (
        'links that must not touch the ground; without names there are none; by default the first '
        'link with limbs that can touch it'
    )
    command.add_argument('--fall-links', nargs='*', metavar='BODY', help=text)
    text = "whether the character is three-dimensional; by default derived from the root's joints"
    command.add_argument('--spatial', action=argparse.BooleanOptionalAction, help=text)
    text = 'quaternion that rotates the character so that it faces +x, with z up'
    command.add_argument('--turn', nargs=4, type=float, metavar=tuple('WXYZ'), help=text)
    text = 'replace moments of inertia that no body has by their mean'
    command.add_argument('--balance-inertia', action='store_true', help=text)
    add_file(
        command, '--output', 'file of the picture on three terrains, .png; by default try_NAME.png'
    )


def run(arguments: argparse.Namespace) -> None:
    """Prints the properties of the character in a file, then renders it on three terrains.

    Raises:
      ValueError: the file cannot be used, or its simulation diverges on one of the terrains.
    """
    output = arguments.output or pathlib.Path(f'try_{arguments.file.stem}.png')
    files.check_path(output, rendering.IMAGE_SUFFIXES)
    suite = engine.load()
    from trl_suite import characters

    name = arguments.file.stem
    options = {option: getattr(arguments, option) for option in OPTIONS}
    options['name'] = f'{name}_file' if name in characters.CHARACTERS else name
    try:
        spec = characters.from_file(arguments.file, **options)
    except ValueError as error:
        raise ValueError(_options(str(error))) from None
    pictures: list[np.ndarray] = []
    unstable: list[str] = []
    for terrain in TERRAINS[spec.spatial]:
        environment = suite.build(spec, terrain=terrain, task='walk', task_kwargs={'random': 0})
        environment.reset()
        if not pictures:
            print(_report(spec, environment), flush=True)
        print(f'{terrain}: {_stand(environment)}', flush=True)
        unstable += [terrain] if environment.info.get('diverged') else []
        pictures.append(rendering.frame(environment, 360, 480))
    rendering.film_strip(pictures, output, len(pictures))
    print(output)
    if unstable:
        raise ValueError(
            f'{arguments.file}: its simulation diverges on {", ".join(unstable)}; expected a stable one: '
            'are masses, inertias and gains right, and no bodies inside each other?'
        )


def _options(text: str) -> str:
    """Returns a message with options of the command instead of arguments of `from_file`."""
    return _ARGUMENTS.sub(
        lambda found: f'--{"no-" * (found[2] == "False")}{found[1].replace("_", "-")}', text
    )


def _report(spec: CharacterSpec, environment: Environment) -> str:
    """Returns the properties of a character, after a reset of its environment on level ground."""
    from trl_suite.characters import inspect
    from trl_suite.characters.character import extent

    model, data = environment.physics.model.ptr, environment.physics.data.ptr
    character = environment.task.character
    root = model.body_rootid[environment.task.body.links[0]]
    own = np.flatnonzero(model.body_rootid == root)
    pairs, inside = _colliding(model, own), _contacts(model, data, own)
    touching = (model.geom_contype | model.geom_conaffinity) != 0
    solid = np.flatnonzero(np.isin(model.geom_bodyid, own) & touching)
    low, high = extent(model, data, solid)
    bodies = zip(spec.links, character.bodies, strict=True)
    forward = inspect.facing({name: environment.physics.bind(body).xipos for name, body in bodies})
    looks = 'unknown, since no links are named left and right'
    if forward is not None:
        looks = (
            f'along {forward.round(2).tolist()}, derived from the positions of left and right links'
        )
    kinds = [joint.type or 'hinge' for joint in character.joints]
    joints = zip(spec.joints.items(), kinds, character.torque_limits, strict=True)
    lines = [
        f'{program.printable(spec.name)}: {"three-dimensional" if spec.spatial else "planar"}, '
        f'{model.body_mass[own].sum():.4g} kg, {high[2] - low[2]:.3g} m high, '
        f'{high[0] - low[0]:.3g} m along x (ahead), {high[1] - low[1]:.3g} m along y (to the left)',
        f'facing: {looks}; expected along [1, 0]',
        f'links: {", ".join(spec.links)}',
        f'end effectors: {", ".join(spec.end_effectors)}; must not touch the ground: '
        f'{", ".join(spec.fall_links) or "none"}',
        f'pairs of its geoms that can collide: {pairs}; in contact at the start: {len(inside)}'
        + (f', up to {-min(inside):.2g} m deep' if inside else ''),
        tables.table(
            ('joint', 'type', 'kp', 'kd', 'torque limit'),
            (
                (name, kind, f'{joint.kp:.4g}', f'{joint.kd:.4g}', f'{limit:.4g}')
                for (name, joint), kind, limit in joints
            ),
        ),
        *(program.printable(f'note: {_options(note)}') for note in spec.notes),
    ]
    return '\n'.join(lines)


def _colliding(model: Any, bodies: np.ndarray) -> int:
    """Returns the number of pairs of geoms, of these bodies, that can collide."""
    geoms = np.flatnonzero(np.isin(model.geom_bodyid, bodies))
    types, affinities = model.geom_contype[geoms], model.geom_conaffinity[geoms]
    own = model.geom_bodyid[geoms]
    welded = model.body_weldid[own]
    above = model.body_weldid[model.body_parentid[welded]]
    count = 0
    for i in range(len(geoms)):
        rest = slice(i + 1, None)
        touching = (types[i] & affinities[rest]) | (types[rest] & affinities[i])
        apart = (
            (welded[i] != welded[rest]) & (above[i] != welded[rest]) & (welded[i] != above[rest])
        )
        pairs = (np.minimum(own[i], own[rest]) << 16) + np.maximum(own[i], own[rest])
        count += (apart & (touching != 0) & ~np.isin(pairs, model.exclude_signature)).sum()
    return int(count)


def _contacts(model: Any, data: Any, bodies: np.ndarray) -> list[float]:
    """Returns the distances (m, negative for penetration) of contacts among bodies."""
    return [
        contact.dist
        for contact in data.contact
        if np.isin(model.geom_bodyid[[contact.geom1, contact.geom2]], bodies).all()
    ]


def _stand(environment: Environment) -> str:
    """Runs zero actions, and returns a phrase on the result."""
    task = environment.task
    root = environment.physics.bind(task.character.root_body)
    begin, steps = float(root.xpos[2]), round(SECONDS / environment.control_timestep())
    zero = np.zeros(environment.action_spec().shape)
    for step in range(1, steps + 1):
        if environment.step(zero).last():
            after = step * environment.control_timestep()
            how = 'diverges' if environment.info.get('diverged') else 'falls'
            return f'{how} after {after:.2g} s of zero actions'
    end = float(root.xpos[2])
    return f'root at a height of {begin:.3g} m at the start, {end:.3g} m after {SECONDS:g} s of zero actions'
