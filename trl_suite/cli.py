"""The command line: `trl-suite` or `python -m trl_suite`.

    trl-suite list --domain plaid --tag original
    trl-suite info PD_Dog2D_Gaps_Terrain-v0
    trl-suite rollout PD_Dog2D_Gaps_Terrain-v0 --policy clip --video dog.mp4 --ghost
    trl-suite evaluate PD_Dog2D_Gaps_Terrain-v0 --policy clip --episodes 100
    trl-suite terrain slopes_mixed --output slopes.png

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
from trl_suite import catalogue, describe, errors, policies, rendering

if TYPE_CHECKING:
    import dm_env

    from trl_suite.environment import Environment

POLICIES = ('reference', 'clip', 'scripted', 'zero', 'random')  # or a file
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
      The exit status: 0; 2 after an error, with one line on stderr; 130 after an interrupt.
    """
    try:
        arguments = _parser(prog).parse_args(argv)
        arguments.command(arguments)
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
    return 0


class _Parser(argparse.ArgumentParser):
    """A parser whose errors are one line, like all others."""

    def error(self, message: str) -> NoReturn:
        raise ValueError(f'{message} (see {self.prog} --help)')


def _parser(prog: str) -> argparse.ArgumentParser:
    parser = _Parser(prog=prog, description='Locomotion environments over random terrain.')
    parser.add_argument('--version', action='version', version=f'trl-suite {trl_suite.__version__}')
    commands = parser.add_subparsers(required=True, metavar='command', parser_class=_Parser)

    def add(name: str, function: Callable[[Any], None], text: str) -> argparse.ArgumentParser:
        command = commands.add_parser(
            name, help=text, description=text[0].upper() + text[1:] + '.',
            formatter_class=argparse.ArgumentDefaultsHelpFormatter,
        )  # fmt: skip
        command.set_defaults(command=function)
        return command

    def add_policy(command: argparse.ArgumentParser, default: str) -> None:
        command.add_argument(
            '--policy', default=default, type=_policy_name, metavar='POLICY',
            help=f'{", ".join(POLICIES)}, or an .npz file; the reference is the trained one shipped',
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

    command = add('terrain', _terrain, 'plot draws of a terrain')
    command.add_argument(
        'terrain', metavar='NAME-or-FILE', help='a preset, or a .json or .txt file'
    )
    command.add_argument('--draws', type=_positive, default=3, help='how many')
    command.add_argument('--length', type=float, default=40.0, help='in metres, or side of a map')
    command.add_argument('--seed', type=int, default=0, help='of the draws')
    command.add_argument('--blend', type=float, default=0.0, help='which of the parameter sets')
    command.add_argument('--output', type=pathlib.Path, metavar='FILE', help='a .png')
    return parser


def _positive(text: str) -> int:
    with contextlib.suppress(ValueError):
        if int(text) > 0:
            return int(text)
    raise argparse.ArgumentTypeError(f'{text!r} is not a positive integer')


def _policy_name(text: str) -> str:
    if text not in POLICIES and not text.endswith('.npz'):
        raise argparse.ArgumentTypeError(errors.unknown('policy', text, (*POLICIES, 'FILE.npz')))
    return text


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
            rendering.check_path(path, suffixes)
    suite = _suite()
    environment = suite.make(arguments.id, {'random': arguments.seed})
    policy = _policy(arguments.policy, environment, arguments.id, arguments.seed)
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
        with rendering.replacing(arguments.trajectory) as part:
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


def _trained(name: str, id: str) -> policies.Policy:
    return policies.reference(id) if name == 'reference' else policies.load(name)


def _policy(name: str, environment: Environment, id: str, seed: int) -> rendering.Policy:
    size = len(environment.action_map)
    if name == 'zero':
        return lambda time_step: np.zeros(size)
    if name == 'random':
        generator = np.random.default_rng(seed)
        return lambda time_step: generator.uniform(-1, 1, size)
    if name == 'scripted':
        from trl_suite.scripted import scripted

        walk = scripted(environment)

        def act(time_step: dm_env.TimeStep) -> np.ndarray:
            return walk(np.concatenate(list(time_step.observation.values()))[None])[0]

        return act
    if name != 'clip':
        trained = _trained(name, id)
        trained.check(environment)
        return lambda time_step: trained(time_step.observation)
    task: Any = environment.task
    if not hasattr(task, 'clip_action'):
        raise ValueError(f'{id} has no clip to follow')
    return lambda time_step: np.clip(task.clip_action(0), -1, 1)


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
        rendering.check_path(arguments.json, ('.json',))
    row = _suite().find(arguments.id)
    from trl_suite import evaluation

    baseline = evaluation.BASELINES.get(arguments.policy)
    result = evaluation.evaluate(
        row, baseline or _trained(arguments.policy, row.id), arguments.episodes, arguments.seed,
        arguments.threads, factory=baseline is not None,
    )  # fmt: skip
    if arguments.json is not None:
        with rendering.replacing(arguments.json) as part:
            text = json.dumps({**result, 'policy': arguments.policy}, indent=1, allow_nan=False)
            part.write_text(f'{text}\n', encoding='utf-8')
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
    rendering.plot_terrain(
        arguments.terrain, output, arguments.draws, arguments.length, arguments.seed,
        arguments.blend,
    )  # fmt: skip
    print(output)
