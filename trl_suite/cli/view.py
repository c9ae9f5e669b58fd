"""`trl-suite view`: a viewer for an environment that is controlled by a policy.

Steps that last longer than 1/30 s (gaits, footstep plans) are shown frame by frame.
"""

from __future__ import annotations

import argparse
import importlib
import os
import sys
import warnings
from typing import TYPE_CHECKING, Any

from trl_suite import rendering
from trl_suite.cli import engine
from trl_suite.cli.arguments import (
    add_command,
    add_id,
    add_options,
    check_used,
    options_of,
    positive,
    valid,
)
from trl_suite.environments import named_policies as acting

if TYPE_CHECKING:
    from trl_suite.environments.environment import Environment
    from trl_suite.viewing.browser import Browser

INSTEAD = 'use --browser to show it in a web browser, on this or another machine'


def declare(commands: Any) -> None:
    """Declares the command and its arguments."""
    text = "show an environment with a policy, in dm_control's viewer or in a web browser"
    command = add_command(commands, 'view', text, run)
    add_id(command)
    policies = ', '.join(acting.POLICIES)
    command.add_argument(
        '--policy',
        default='best',
        type=_policy,
        metavar='POLICY',
        help=f'{policies}, or an .npz file; best: the first of these that exists',
    )
    command.add_argument('--seed', type=int, default=0, help='seed of environment and policy')
    add_options(command)
    text = "show it in web browsers, with controls, instead of dm_control's viewer (F1: its keys)"
    command.add_argument('--browser', action='store_true', help=text)
    text = 'address to listen on with --browser, by default 127.0.0.1'
    command.add_argument('--host', help=text)
    text = 'first port to try with --browser, by default 8080'
    command.add_argument('--port', type=positive, help=text)


@valid
def _policy(text: str) -> str:
    return text if text == 'best' else acting.check(text)


def run(arguments: argparse.Namespace) -> None:
    """Opens a window and returns when it is closed, or serves web browsers until interrupted."""
    options = options_of(arguments)
    check_used(arguments, 'host', 'browser')
    check_used(arguments, 'port', 'browser')
    if arguments.browser:
        in_browser(arguments, options)
        return
    check_screen()
    suite = engine.load()
    environment = suite.make(arguments.id, {**options, 'random': arguments.seed})
    name = arguments.policy
    if name == 'best':
        name, _ = acting.best(environment, arguments.id)

    def policy() -> rendering.Policy:
        return acting.policy(name, environment, arguments.id, arguments.seed)

    policy()(environment.reset())  # errors of the policy are raised before a window opens
    environment.random_state.seed(arguments.seed)
    view(environment, policy(), f'{suite.find(arguments.id).id}: {name}')


def in_browser(arguments: argparse.Namespace, options: dict[str, Any]) -> None:
    """Serves web browsers until an interrupt."""
    shown = arguments.id, arguments.policy, arguments.seed
    address = {name: getattr(arguments, name) for name in ('host', 'port')}
    given = {name: value for name, value in address.items() if value is not None}
    kind = engine.load('trl_suite.viewing.browser').Browser
    kind(*shown, **given, task_kwargs=options, opened=_tell).run()


def _tell(viewer: Browser) -> None:
    elsewhere = f', or {viewer.other_url} on another machine' if viewer.other_url else ''
    print(f'open {viewer.url} in a web browser{elsewhere}; press Ctrl+C to stop', flush=True)


def check_screen() -> None:
    """Checks that a window can be opened, and makes dm_control use GLFW.

    Raises:
      RuntimeError: there is no display, or GLFW cannot use it; the message has an alternative.
    """
    if not rendering.has_display():
        raise RuntimeError(
            'a window needs a display, but neither DISPLAY nor WAYLAND_DISPLAY is set; ' + INSTEAD
        )
    import glfw  # a dependency of dm_control

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter('always')
        if not glfw.init():
            reason = ' '.join(str(each.message) for each in caught) or 'GLFW gives no reason'
            raise RuntimeError(f'a window needs a display that GLFW can use ({reason}); {INSTEAD}')
    # dm_control's windows need GLFW. It reads the variable when it is imported.
    os.environ['MUJOCO_GL'] = 'glfw'
    render = sys.modules.get('dm_control._render')
    if render is not None and getattr(render, 'BACKEND', None) != 'glfw':
        importlib.reload(render)


def view(environment: Environment, policy: rendering.Policy, title: str) -> None:
    """Resets an environment and shows it until the window is closed."""
    shown: Any = environment
    if hasattr(environment.task, 'watch'):
        from trl_suite.viewing.playback import Playback

        shown = Playback(environment, policy)
        policy = shown.policy
    engine.load('trl_suite.viewing.window').Window(environment, title).launch(shown, policy)
