"""`trl-suite rollout`: runs a policy for a number of steps, through successive episodes."""

from __future__ import annotations

import argparse
import contextlib
import re
from typing import TYPE_CHECKING, Any

import numpy as np

from trl_suite import rendering
from trl_suite.cli import engine
from trl_suite.cli.arguments import (
    add_command,
    add_file,
    add_id,
    add_options,
    add_policy,
    check_used,
    options_of,
    positive,
    valid,
)
from trl_suite.environments import named_policies as acting
from trl_suite.util import archive, tables

if TYPE_CHECKING:
    import dm_env

    from trl_suite.environments.environment import Environment

SHOWN_EPISODES = 8  # largest number of episodes that are printed


def declare(commands: Any) -> None:
    """Declares the command and its arguments."""
    command = add_command(commands, 'rollout', 'run a policy for a number of steps', run)
    add_id(command)
    command.add_argument('--seed', type=int, default=0, help='seed of environment and policy')
    command.add_argument(
        '--steps',
        type=positive,
        default=256,
        help='number of steps: of 1/30 s, of cycles in gaits, of footsteps in planning',
    )
    add_policy(command, 'random')
    add_options(command)
    add_file(command, '--video', 'write a video, .mp4 or .gif', *rendering.VIDEO_SUFFIXES)
    add_file(command, '--html', 'write an interactive replay, .html', *rendering.REPLAY_SUFFIXES)
    add_file(command, '--strip', 'write a film strip, .png', *rendering.IMAGE_SUFFIXES)
    command.add_argument('--columns', type=positive, help='pictures in the strip, by default 8')
    add_file(command, '--trajectory', 'write all time steps, .npz', '.npz')
    command.add_argument('--ghost', action='store_true', help='show the reference clip as well')
    text = 'size of pictures in pixels, by default 640x480'
    command.add_argument('--size', type=_size, metavar='WxH', help=text)
    command.add_argument('--camera', help='name of a camera, by default side')


@valid
def _size(text: str) -> tuple[int, int]:
    match = re.fullmatch(r'(\d+)x(\d+)', text)
    if not match:
        raise ValueError(f'{text!r} is not a size such as 640x480')
    return int(match[1]), int(match[2])


def run(arguments: argparse.Namespace) -> None:
    """Runs a policy, writes the requested files, and prints a line per episode and per file."""
    check_used(arguments, 'columns', 'strip')
    check_used(arguments, 'size', 'video', 'strip')
    check_used(arguments, 'camera', 'video', 'strip')
    check_used(arguments, 'ghost', 'video', 'html', 'strip')
    columns, camera = arguments.columns or 8, arguments.camera or 'side'
    width, height = arguments.size or (640, 480)
    suite = engine.load()
    import tqdm  # a dependency of dm_control

    from trl_suite.evaluation import PROGRESS_DELAY

    options = options_of(arguments)
    environment = suite.make(arguments.id, {**options, 'random': arguments.seed})
    policy = acting.policy(arguments.policy, environment, arguments.id, arguments.seed)
    in_strip = set(rendering.spread(arguments.steps + 1, columns))
    pictures: list[np.ndarray] = []
    record = _Record(environment, arguments.trajectory is not None)
    with contextlib.ExitStack() as stack:
        video = arguments.video and stack.enter_context(rendering.Video(arguments.video))

        replay = arguments.html and stack.enter_context(
            engine.load('trl_suite.rendering.replays').Replay(
                environment, arguments.html, ghost=arguments.ghost
            )
        )

        def picture() -> np.ndarray:
            return rendering.frame(environment, height, width, camera, arguments.ghost)

        def look(first: bool) -> None:
            if video:
                video.add(picture())
            if replay:
                replay.add(jump=first)

        run = rendering.played(
            environment, policy, arguments.steps, look if video or replay else None
        )
        # disable=None: no bar where stderr is not a terminal.
        with tqdm.tqdm(
            total=arguments.steps, delay=PROGRESS_DELAY, disable=None, unit='step'
        ) as bar:
            for done, time_step, action in run:
                bar.update(done - bar.n)
                record.add(time_step, action)
                if arguments.strip is not None and done in in_strip:
                    in_strip.discard(done)  # the next reset has the same number
                    pictures.append(picture())
    if arguments.strip is not None:
        rendering.film_strip(pictures, arguments.strip, columns)
    if arguments.trajectory is not None:
        id_ = suite.find(arguments.id).id
        archive.write(arguments.trajectory, {**record.arrays(), 'seed': arguments.seed, 'id': id_})
    print(record.summary())
    for path in (arguments.video, arguments.html, arguments.strip, arguments.trajectory):
        if path is not None:
            print(path)


class _Record:
    """Data of a rollout: an entry per time step, if these are kept, and one per episode."""

    def __init__(self, environment: Environment, keep: bool) -> None:
        self._environment, self._keep = environment, keep
        self._rows: list[tuple[Any, ...]] = []
        self._episodes: list[dict[str, Any]] = []

    def add(self, time_step: dm_env.TimeStep, action: np.ndarray) -> None:
        environment = self._environment
        first = time_step.first()
        if self._keep:
            parts = [np.ravel(part) for part in time_step.observation.values()]
            outcome = (0.0, 1.0) if first else (time_step.reward, time_step.discount)
            kind, qpos = int(time_step.step_type), environment.physics.data.qpos.copy()
            self._rows.append((np.concatenate(parts), action, *outcome, kind, qpos))
        if first:
            self._episodes.append({'steps': 0, 'return': 0.0, 'distance': 0.0, 'end': 'unfinished'})
            return
        episode = self._episodes[-1]
        episode['steps'] += 1
        episode['return'] += time_step.reward
        episode['distance'] = environment.info.get('distance', 0.0)
        if time_step.last():
            episode['end'] = environment.ending

    def arrays(self) -> dict[str, Any]:
        """Returns the entries as arrays; actions[i] follows observations[i], or is 0 at ends of episodes."""
        names = ('observations', 'actions', 'rewards', 'discounts', 'step_types', 'qpos')
        return {
            name: np.array(column)
            for name, column in zip(names, zip(*self._rows, strict=True), strict=True)
        }

    def summary(self) -> str:
        shown = self._episodes[:SHOWN_EPISODES]
        lines = [
            tables.table(
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
