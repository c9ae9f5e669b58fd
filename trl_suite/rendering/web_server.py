"""The server of the package viser, which sends a scene to browsers."""

from __future__ import annotations

import contextlib
import errno
import socket
from collections.abc import Callable, Iterator
from typing import Any

from trl_suite.util.libraries import library
from trl_suite.util.options import checked

PORTS, LAST_PORT = 1000, 65535  # number of ports tried; the largest port


def load_viser() -> Any:
    """Imports viser."""
    return library('viser', 'trl_suite[viewer]')


def start_server(
    host: str,
    port: int,
    token: str | None = None,
    report: Callable[[str], object] = lambda sentence: None,
) -> Any:
    """Starts a viser server that prints nothing.

    Args:
      host: address to listen on; '127.0.0.1' accepts connections only from this machine.
      port: the first port to try; 0 for any free port.
      token: the path of its address, without which it answers nobody; None to answer nobody.
      report: called with a sentence about each refused value, in another thread.
    """
    viser = load_viser()
    from trl_suite.rendering import web_guard  # imports viser, too

    port = checked('port', port, int, at_least=0, at_most=LAST_PORT)
    port = _free_port(host, port)  # where there is none, viser would wait forever
    guard = web_guard.Guard(token, report)
    with _silent_viser(), guard.installed():
        server = viser.ViserServer(host, port, verbose=False)
    guard.gui = server.gui
    if not guard.active:
        stop_server(server)
        raise RuntimeError(f'viser {viser.__version__} is not supported')
    return server


def stop_server(server: Any) -> None:
    """Stops a viser server without a message."""
    with _silent_viser():
        server.stop()


@contextlib.contextmanager
def _silent_viser() -> Iterator[None]:
    """Suppresses what viser prints by way of rich, to terminals and into the outputs of notebooks."""
    console = library('rich', 'trl_suite[viewer]').get_console()
    before, console.quiet = console.quiet, True
    try:
        yield
    finally:
        console.quiet = before


def _free_port(host: str, port: int) -> int:
    """Returns the first port that is free, at or after `port`; 0, any, if that is given."""
    last = min(port + PORTS - 1, LAST_PORT)
    for number in range(port, last + 1):
        try:
            with socket.socket() as probe:
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                probe.bind((host, number))
                return number
        except OSError as error:
            if number == last or error.errno not in (errno.EADDRINUSE, errno.EACCES):
                what = f'cannot listen on host {host!r}, port {number}: {error.strerror}'
                raise OSError(error.errno, what) from None
    return port
