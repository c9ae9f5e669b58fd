"""The command line: `trl-suite` or `python -m trl_suite`.

    trl-suite list --domain plaid --tag original
    trl-suite info PD_Dog2D_Gaps_Terrain-v0
    trl-suite rollout PD_Dog2D_Gaps_Terrain-v0 --policy clip --video dog.mp4 --ghost
    trl-suite evaluate PD_Dog2D_Gaps_Terrain-v0 --policy clip --episodes 100
    trl-suite terrain slopes_mixed --output slopes.png
    trl-suite clip walk.bvh --character biped2d_full --cycle --output walk.npz
    trl-suite doctor
    trl-suite bench PD_Dog2D_Gaps_Terrain-v0
    trl-suite gallery --only Dog2D_Gaps

Bad input ends with one line on stderr and exit status 2. The engine is imported only by the
commands that need it.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import pathlib
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np

import trl_suite
from trl_suite import acting, catalogue, describe, errors, files, rendering, terrain

if TYPE_CHECKING:
    import dm_env

    from trl_suite.environment import Environment

SHOWN_EPISODES = 8  # episodes that a rollout prints one by one
PROGRESS_DELAY = 2.0  # s before a progress bar appears
_ENDS = ('fell', 'stuck', 'diverged')  # of an episode, in a task's information
_FILTERS = ('domain', 'character', 'actuation', 'terrain', 'tag')


def main(argv: Sequence[str] | None = None, prog: str = 'trl-suite') -> int:
    """Runs a command.

    Args:
      argv: arguments, without the program's name; by default those of the process.
      prog: name of the program in the help.

    Returns:
      The exit status: 0; 1 if the doctor finds something wrong or a picture failed; 2 after an
      error, with one line on stderr; 130 after an interrupt.
    """
    try:
        arguments = _parser(prog).parse_args(argv)
        status = arguments.command(arguments) or 0
        sys.stdout.flush()
    except BrokenPipeError:
        # Whoever read the output has had enough; nothing may be flushed into the pipe at exit.
        with contextlib.suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except KeyboardInterrupt:
        print('trl-suite: interrupted', file=sys.stderr)
        return 130
    except (ValueError, ImportError, RuntimeError, OSError) as error:
        print(f'trl-suite: error: {" ".join(str(error).split())}', file=sys.stderr)
        return 2
    return status


class _Parser(argparse.ArgumentParser):
    """A parser whose errors are one line, like all others."""

    def error(self, message: str) -> NoReturn:
        raise ValueError(f'{message} (see {self.prog} --help)')


def _parser(prog: str) -> argparse.ArgumentParser:
    parser = _Parser(prog=prog, description='Locomotion environments over random terrain.')
    parser.add_argument('--version', action='version', version=f'trl-suite {trl_suite.__version__}')
    commands = parser.add_subparsers(required=True, metavar='command', parser_class=_Parser)

    def add(name: str, function: Callable[[Any], int | None], text: str) -> argparse.ArgumentParser:
        command = commands.add_parser(
            name, help=text, description=text[0].upper() + text[1:] + '.',
            formatter_class=argparse.ArgumentDefaultsHelpFormatter,
        )  # fmt: skip
        command.set_defaults(command=function)
        return command

    def add_policy(command: argparse.ArgumentParser, default: str) -> None:
        command.add_argument(
            '--policy', default=default, type=_policy_name, metavar='POLICY',
            help=f'{", ".join(acting.POLICIES)}, or an .npz file; the reference is the trained one shipped',
        )  # fmt: skip

    command = add('list', _list, 'list the environments of the catalogue')
    for name in _FILTERS:
        command.add_argument(f'--{name}', help=f'only those of one {name}')

    command = add('info', _info, 'tell everything about one environment')
    command.add_argument('id', metavar='ID', help="id, or 'domain/task'")

    command = add('rollout', _rollout, 'run a policy, over ends of episodes')
    command.add_argument('id', metavar='ID', help="id, or 'domain/task'")
    command.add_argument('--seed', type=int, default=0, help='of the environment and the policy')
    command.add_argument('--steps', type=_positive, default=256, help='control steps')
    add_policy(command, 'random')
    command.add_argument('--video', type=pathlib.Path, metavar='FILE', help='an .mp4 or .gif')
    command.add_argument('--strip', type=pathlib.Path, metavar='FILE', help='a .png film strip')
    command.add_argument('--columns', type=_positive, default=8, help='pictures in the strip')
    command.add_argument('--trajectory', type=pathlib.Path, metavar='FILE', help='an .npz')
    command.add_argument('--ghost', action='store_true', help='draw the reference clip as well')
    command.add_argument('--size', type=_size, default='640x480', metavar='WxH', help='in pixels')
    command.add_argument('--camera', default='side', help='name of a camera')

    command = add('evaluate', _evaluate, 'run a policy for whole episodes, and sum up')
    command.add_argument('id', metavar='ID', help="id, or 'domain/task'")
    add_policy(command, 'reference')
    command.add_argument('--episodes', type=_positive, default=50, help='how many')
    command.add_argument('--seed', type=int, default=0, help='of all episodes')
    command.add_argument('--threads', type=int, default=0, help='of the physics; 0: all cores')
    command.add_argument('--json', type=pathlib.Path, metavar='FILE', help='a .json of everything')

    command = add('terrain', _terrain, 'plot draws of a terrain, or write one as a mesh')
    command.add_argument(
        'terrain', metavar='NAME-or-FILE', help='a preset, or a .json or .txt file'
    )
    command.add_argument('--draws', type=_positive, default=3, help='how many')
    command.add_argument('--length', type=float, default=40.0, help='in metres, or side of a map')
    command.add_argument('--seed', type=int, default=0, help='of the draws')
    command.add_argument('--blend', type=float, default=0.0, help='which of the parameter sets')
    command.add_argument(
        '--output', type=pathlib.Path, metavar='FILE',
        help='a .png; or a mesh of the first draw, .obj, .glb or .stl',
    )  # fmt: skip

    command = add('clip', _clip, 'carry a motion file over to a character, and check it')
    command.add_argument(
        'file', metavar='FILE', type=pathlib.Path,
        help='a .bvh, .amc, .json (TerrainRL, DeepMimic) or .npz',
    )  # fmt: skip
    command.add_argument('--character', required=True, help='name of a character')
    command.add_argument('--skeleton', type=pathlib.Path, metavar='FILE', help='.asf of an .amc')
    command.add_argument(
        '--map', type=pathlib.Path, metavar='FILE',
        help="a .json of joints: the character's to the motion's; by usual names",
    )  # fmt: skip
    command.add_argument('--scale', type=float, help='of lengths; by the length of limbs')
    command.add_argument(
        '--cycle', nargs='*', type=float, metavar='TIME',
        help='cut one cycle out, from a time to another (s); without times, where it fits best',
    )  # fmt: skip
    command.add_argument('--frames', action='store_true', help='print every fault in every frame')
    command.add_argument('--output', type=pathlib.Path, metavar='FILE', help='a clip, .npz')
    command.add_argument('--strip', type=pathlib.Path, metavar='FILE', help='a .png film strip')

    add('doctor', _doctor, 'look at the installation; say what is wrong and what to do')

    command = add('bench', _bench, 'measure the speed of this machine against raw MuJoCo')
    command.add_argument(
        'id', metavar='ID', nargs='?', default='PD_Biped2D_Gaps_Terrain-v0', help="or 'domain/task'"
    )
    command.add_argument('--rows', type=_positive, default=64, help='of the vector environment')
    command.add_argument('--threads', type=int, default=0, help='of the physics; 0: all cores')
    command.add_argument('--seconds', type=float, default=2.0, help='of each of four measurements')
    command.add_argument('--json', type=pathlib.Path, metavar='FILE', help='a .json of everything')

    command = add('gallery', _gallery, 'make pictures of all environments, terrains and characters')
    command.add_argument(
        '--output', type=pathlib.Path, default='gallery', metavar='FOLDER', help='where to'
    )
    command.add_argument(
        '--only', default='*', metavar='PATTERN', help='part of a name, as Dog2D_Gaps or terrains'
    )
    command.add_argument('--again', action='store_true', help='also what is there already')
    return parser


def _positive(text: str) -> int:
    with contextlib.suppress(ValueError):
        if int(text) > 0:
            return int(text)
    raise argparse.ArgumentTypeError(f'{text!r} is not a positive integer')


def _policy_name(text: str) -> str:
    try:
        return acting.check(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def _size(text: str) -> tuple[int, int]:
    match = re.fullmatch(r'(\d+)x(\d+)', text)
    if not match:
        raise argparse.ArgumentTypeError(f'{text!r} is not a size such as 640x480')
    return int(match[1]), int(match[2])


# list


def _list(arguments: argparse.Namespace) -> None:
    chosen = list(catalogue.ROWS)
    for name in _FILTERS:
        value = getattr(arguments, name)
        if value is None:
            continue
        known = {item for row in catalogue.ROWS for item in _values(row, name)}
        if value not in known:
            raise ValueError(errors.unknown(name, value, known))
        chosen = [row for row in chosen if value in _values(row, name)]
    if chosen:
        cells = [(row.id, f'{row.domain}/{row.task}', row.description) for row in chosen]
        print(describe.table(('id', 'domain/task', 'description'), cells, indent=''))
    print(f'{len(chosen)} environment{"" if len(chosen) == 1 else "s"}')


def _values(row: catalogue.Row, name: str) -> frozenset[str]:
    return row.tags if name == 'tag' else frozenset({str(getattr(row, name))})


# info


def _info(arguments: argparse.Namespace) -> None:
    suite = _suite()
    row = suite.find(arguments.id)
    environment = suite.build_row(row, {}, {})
    print(f'{row.id}\n  {row.description}')
    print(f'  also {", ".join((f"{row.domain}/{row.task}", *row.aliases))}; tags:', end=' ')
    print(', '.join(sorted(row.tags)))
    for title, text in describe.sections(row, environment):
        print(f'\n{title}\n{text}')


# rollout


def _rollout(arguments: argparse.Namespace) -> None:
    for path, suffixes in (
        (arguments.video, rendering.VIDEO_SUFFIXES),
        (arguments.strip, rendering.IMAGE_SUFFIXES),
        (arguments.trajectory, ('.npz',)),
    ):
        if path is not None:  # before the work rather than after it
            files.check_path(path, suffixes)
    suite = _suite()
    environment = suite.make(arguments.id, {'random': arguments.seed})
    policy = acting.policy(arguments.policy, environment, arguments.id, arguments.seed)
    width, height = arguments.size
    in_strip = set(rendering.spread(arguments.steps + 1, arguments.columns))
    pictures: list[np.ndarray] = []
    record = _Record(environment)
    with contextlib.ExitStack() as stack:
        video = arguments.video and stack.enter_context(rendering.Video(arguments.video))

        def picture() -> np.ndarray:
            return rendering.frame(environment, height, width, arguments.camera, arguments.ghost)

        watched = video and stack.enter_context(
            rendering.watching(environment, lambda: video.add(picture()))
        )
        for done, time_step, action in _run(environment, policy, arguments.steps):
            record.add(time_step, action)
            into_strip = arguments.strip is not None and done in in_strip
            into_video = video and (time_step.first() or not watched)
            if not (into_video or into_strip):
                continue
            image = picture()
            if into_video:
                video.add(image)
            if into_strip:
                in_strip.discard(done)  # the start that follows an end has the same number
                pictures.append(image)
    if arguments.strip is not None:
        rendering.film_strip(pictures, arguments.strip, arguments.columns)
    if arguments.trajectory is not None:
        with files.replacing(arguments.trajectory) as part:
            np.savez_compressed(
                part, **record.arrays(), seed=arguments.seed, id=suite.find(arguments.id).id
            )
    print(record.summary())


def _suite() -> Any:
    try:
        from trl_suite import suite
    except ModuleNotFoundError:
        raise
    # What dm_control dies of where the library that MUJOCO_GL names is missing.
    except (AttributeError, ImportError) as error:
        raise RuntimeError(rendering.no_gl(error)) from error
    return suite


def _run(
    environment: Environment, policy: rendering.Policy, steps: int
) -> Iterator[tuple[int, dm_env.TimeStep, np.ndarray]]:
    """Yields steps done, every time step, and the action taken from it: zeros where none is."""
    import tqdm  # dm_control brings it

    none = np.zeros(len(environment.action_map))
    time_step, done = environment.reset(), 0
    # disable=None: no bar where stderr is not a terminal.
    with tqdm.tqdm(total=steps, delay=PROGRESS_DELAY, disable=None, unit='step') as bar:
        while True:
            action = none if done == steps or time_step.last() else policy(time_step)
            yield done, time_step, action
            if done == steps:
                return
            if time_step.last():
                time_step = environment.reset()
            else:
                time_step = environment.step(action)
                done += 1
                bar.update()


class _Record:
    """What a rollout leaves behind: a row per time step, and an entry per episode."""

    def __init__(self, environment: Environment) -> None:
        self._environment = environment
        self._rows: list[tuple[Any, ...]] = []
        self._episodes: list[dict[str, Any]] = []

    def add(self, time_step: dm_env.TimeStep, action: np.ndarray) -> None:
        environment = self._environment
        first = time_step.first()
        self._rows.append((
            np.concatenate([np.ravel(part) for part in time_step.observation.values()]), action,
            0.0 if first else time_step.reward, 1.0 if first else time_step.discount,
            int(time_step.step_type), environment.physics.data.qpos.copy(),
        ))  # fmt: skip
        if first:
            self._episodes.append({'steps': 0, 'return': 0.0, 'distance': 0.0, 'end': 'goes on'})
            return
        episode, info = self._episodes[-1], environment.info
        episode['steps'] += 1
        episode['return'] += time_step.reward
        episode['distance'] = info.get('distance', 0.0)
        if time_step.last():
            cut = 'was cut' if time_step.discount else 'failed'
            episode['end'] = next((end for end in _ENDS if info.get(end)), cut)

    def arrays(self) -> dict[str, Any]:
        """The rows as arrays; actions[i] was taken from observations[i], if step i had any."""
        names = ('observations', 'actions', 'rewards', 'discounts', 'step_types', 'qpos')
        return {
            name: np.array(column)
            for name, column in zip(names, zip(*self._rows, strict=True), strict=True)
        }

    def summary(self) -> str:
        shown = self._episodes[:SHOWN_EPISODES]
        lines = [
            describe.table(
                ('episode', 'steps', 'return', 'distance (m)', 'end'),
                (
                    (i, e['steps'], f'{e["return"]:.2f}', f'{e["distance"]:.2f}', e['end'])
                    for i, e in enumerate(shown, 1)
                ),
                indent='',
            )
        ]
        if len(self._episodes) > len(shown):
            lines.append(f'... and {len(self._episodes) - len(shown)} more')
        steps, total, distance = (
            sum(e[name] for e in self._episodes) for name in ('steps', 'return', 'distance')
        )
        count = len(self._episodes)
        lines.append(
            f'{steps} steps in {count} episode{"" if count == 1 else "s"}: return {total:.2f}, '
            f'{total / steps:.3f} per step; {distance:.2f} m'
        )
        return '\n'.join(lines)


# evaluate


def _evaluate(arguments: argparse.Namespace) -> None:
    if arguments.json is not None:
        files.check_path(arguments.json, ('.json',))
    row = _suite().find(arguments.id)
    from trl_suite import evaluation

    baseline = evaluation.BASELINES.get(arguments.policy)
    result = evaluation.evaluate(
        row, baseline or acting.trained(arguments.policy, row.id), arguments.episodes, arguments.seed,
        arguments.threads, factory=baseline is not None,
    )  # fmt: skip
    if arguments.json is not None:
        _write_json({**result, 'policy': arguments.policy}, arguments.json)
    interval = result['return_interval']
    lines = (
        ('policy', arguments.policy),
        ('episodes', f'{result["episodes"]}, seed {result["seed"]}'),
        (
            'return',
            f'{result["return"]:.2f}'
            + ('' if interval is None else f' +- {interval:.2f} (95 % confidence)')
            + f', {result["fraction"]:.1%} of the maximum {result["step_limit"]}',
        ),
        ('length', f'{result["length"]:.1f} of {result["step_limit"]} steps'),
        ('distance', f'{result["distance"]:.2f} m'),
        ('full length', f'{result["full"]:.0%} of the episodes'),
        ('falls', f'{result["falls"]:.0%} of the episodes'),
    )
    print(row.id)
    for name, text in lines:
        print(f'  {name:<12} {text}')


# terrain


def _terrain(arguments: argparse.Namespace) -> None:
    name = pathlib.Path(arguments.terrain)
    known = name.name if name.suffix not in ('.json', '.txt') else name.stem
    output = arguments.output or pathlib.Path(f'terrain_{known}.png')
    if output.suffix.lower() in terrain.WRITTEN:
        _terrain_mesh(arguments, output)
        return
    rendering.plot_terrain(
        arguments.terrain, output, arguments.draws, arguments.length, arguments.seed,
        arguments.blend,
    )  # fmt: skip
    print(output)


def _terrain_mesh(arguments: argparse.Namespace, output: pathlib.Path) -> None:
    source = terrain.load(arguments.terrain)
    draw = terrain.Ground if source.spatial else terrain.Strip
    # As the first of the plots.
    ground = draw(source, np.random.SeedSequence((arguments.seed, 0)), blend=arguments.blend)
    low, high = (-2.0, arguments.length)
    if source.spatial:
        low, high = -0.5 * arguments.length, 0.5 * arguments.length
    terrain.save_mesh(ground, output, low, high)
    print(output)


# clip


def _clip(arguments: argparse.Namespace) -> None:
    for path, suffixes in (
        (arguments.output, ('.npz',)),
        (arguments.strip, rendering.IMAGE_SUFFIXES),
    ):
        if path is not None:
            files.check_path(path, suffixes)
    if arguments.cycle and len(arguments.cycle) != 2:
        raise ValueError(f'--cycle: {len(arguments.cycle)} times; expected none or two')
    _suite()
    from trl_suite import clip_check, retargeting
    from trl_suite.mannequin import Mannequin

    chosen = None
    if arguments.map is not None:
        chosen = json.loads(files.existing(arguments.map, ('.json',)).read_text(encoding='utf-8'))
    name = arguments.character
    motion = retargeting.read(arguments.file, name, arguments.skeleton)
    clip = retargeting.retarget(motion, name, chosen, arguments.scale)
    if arguments.cycle is not None:
        clip = retargeting.cycle(clip, *arguments.cycle)
    report = clip_check.check(clip, name)
    print(report)
    for fault in report.faults if arguments.frames else ():
        print(
            f'frame {fault.frame}, {fault.time:.3f} s: {fault.kind}, {fault.name}, '
            f'{fault.amount:.3g} {fault.unit}'
        )
    if arguments.output is not None:
        clip.save(arguments.output)
        print(arguments.output)
    if arguments.strip is not None:
        image = Mannequin(name).film_strip(clip, height=240, width=320)
        rendering.film_strip([image], arguments.strip)
        print(arguments.strip)


# doctor


def _doctor(arguments: argparse.Namespace) -> int:
    from trl_suite.commands import doctor

    found = []
    for finding in doctor.findings():  # some take seconds
        found.append(finding.state)
        print('\n'.join(doctor.report([finding])), flush=True)
    failed = found.count(doctor.FAILED)
    print(f'\n{failed} thing{"" if failed == 1 else "s"} to mend' if failed else '\nall is well')
    return int(failed > 0)


# bench


def _bench(arguments: argparse.Namespace) -> None:
    if arguments.json is not None:
        files.check_path(arguments.json, ('.json',))
    _suite()
    from trl_suite.commands import bench

    result = bench.bench(arguments.id, arguments.rows, arguments.threads, arguments.seconds)
    if arguments.json is not None:
        _write_json(result, arguments.json)
    print(f'{result["id"]}, {result["rows"]} rows, {result["threads"]} threads, random actions')
    print(f'  on {result["machine"]}')
    for name, text in (
        ('control steps', f'{result["control steps per second"]} per second, resets included'),
        ('physics', f'{result["ratio to Batch.step"]:.2f} of the rate of raw mujoco.batch.Batch.step'),
        ('', f'{result["ratio to mj_step"]:.2f} of the rate of raw mj_step on one thread'),
        ('', f'{result["share of the physics"]:.0%} of the time is physics'),
        ('reset', f'{result["reset"]:.2f} ms per row'),
        ('alone', f'{result["single environment"]} control steps per second in a single environment'),
    ):  # fmt: skip
        print(f'  {name:<14} {text}')


def _write_json(result: dict[str, Any], path: pathlib.Path) -> None:
    with files.replacing(path) as part:
        part.write_text(f'{json.dumps(result, indent=1, allow_nan=False)}\n', encoding='utf-8')


# gallery


def _gallery(arguments: argparse.Namespace) -> int:
    _suite()
    from trl_suite.commands import gallery

    written, failed = gallery.make(arguments.output, arguments.only, arguments.again)
    for path, error in failed.items():
        print(f'{path}: {" ".join(str(error).split())}', file=sys.stderr)
    print(f'{len(written)} pictures written to {arguments.output}, {len(failed)} failed')
    return int(bool(failed))
