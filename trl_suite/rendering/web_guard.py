"""Access control for a viser server, and validation of the messages that it receives.

Any web page and any user of this machine can connect to a local port. The paths of a guarded server
begin with a random token, which is part of the printed address; requests without it are refused.
Messages are validated: only the types that the panel uses are accepted, with values that its
controls can have. Viser itself would set any attribute of a control, and open a public tunnel.
"""

from __future__ import annotations

import contextlib
import http
import logging
import secrets
import threading
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import msgspec
import numpy as np
import viser
import websockets.asyncio.server
from viser import _messages

from trl_suite.util import errors
from trl_suite.util.options import checked

CLIENTS = 16  # connected at the same time
LARGEST_MESSAGE, LARGEST_UPLOAD = 2**20, 2**25  # bytes; files arrive in parts of 2**19
FARTHEST = 1e9  # m; of a camera
LONGEST = 255  # characters of a file name, or of a value in a report
ACCEPTED = {
    kind.__name__: kind
    for kind in (
        _messages.ViewerCameraMessage,
        _messages.GuiUpdateMessage,
        _messages.FileTransferStartUpload,
        _messages.FileTransferPart,
    )
}
_LOGGER = logging.getLogger(__name__)
# Of bytes that are no request. Errors of the server's own code are still logged.
_LOGGER.addFilter(lambda record: record.getMessage() != 'opening handshake failed')
_STARTING = threading.Lock()


class Guard:
    """Decides on the requests and messages to one server.

    Attributes:
      gui: the server's controls; set it when they exist.
      active: whether a server has been started with this guard.
    """

    gui: Any

    def __init__(self, token: str | None, report: Callable[[str], object]) -> None:
        """Creates a guard.

        Args:
          token: first part of all paths; None refuses all requests.
          report: called with a sentence about each refused value, in the server's thread.
        """
        self._token, self._report, self.active = token, report, False

    @contextlib.contextmanager
    def installed(self) -> Iterator[None]:
        """Guards the viser server that is started inside."""
        module: Any = websockets.asyncio.server
        # Browsers may leave at any time.
        warnings.filterwarnings('ignore', 'Queued a .* on a closed connection')
        with _STARTING:
            serve = module.serve

            def guarded(handler: Any, *arguments: Any, **options: Any) -> Any:
                if handler.__module__ != 'viser.infra._infra':
                    return serve(handler, *arguments, **options)
                self.active = True
                answer = options['process_request']
                options |= {
                    'process_request': lambda *request: self._admit(answer, *request),
                    'max_size': LARGEST_MESSAGE,
                    'logger': _LOGGER,
                    'select_subprotocol': None,
                    'subprotocols': [f'viser-v{viser.__version__}'],
                }
                return serve(self._checking(handler), *arguments, **options)

            module.serve = guarded
            try:
                yield
            finally:
                module.serve = serve

    def _admit(self, answer: Any, connection: Any, request: Any) -> Any:
        """Answers a request, or returns None if it may become a websocket."""
        first, _, rest = request.path.partition('?')[0].removeprefix('/').partition('/')
        if self._token is None or not secrets.compare_digest(
            first.encode(errors='replace'), self._token.encode()
        ):
            text = 'Open the address that the viewer has printed.\n'
            return connection.respond(http.HTTPStatus.FORBIDDEN, text)
        if len(connection.server.connections) >= CLIENTS:
            text = f'{CLIENTS} browsers are connected; close one of them.\n'
            return connection.respond(http.HTTPStatus.SERVICE_UNAVAILABLE, text)
        request.path = f'/{rest}'
        return answer(connection, request)

    def _checking(self, handler: Any) -> Any:
        async def handle(connection: Any) -> None:
            receive, inbox = connection.recv, Inbox(self.gui, self._report)

            async def recv() -> bytes:
                while not inbox.accepts(data := await receive()):
                    pass
                return data

            connection.recv = recv
            await handler(connection)

        return handle


class Inbox:
    """Decides on the messages of one browser."""

    def __init__(self, gui: Any, report: Callable[[str], object]) -> None:
        self._gui, self._report = gui, report
        self._connected = False  # as viser calls it: it has sent a camera
        self._transfer, self._part, self._left = '', 0, 0  # id, next part and missing bytes

    def accepts(self, data: bytes | str) -> bool:
        """Returns whether viser may handle a message; reports bad values of controls."""
        message = _decoded(data)
        try:
            match message:
                case _messages.ViewerCameraMessage():
                    numbers = np.hstack(list(vars(message).values()))
                    valid = bool((np.abs(numbers) < FARTHEST).all())
                    self._connected |= valid
                    return valid
                case _ if not self._connected:
                    return False
                case _messages.GuiUpdateMessage(uuid=uuid, updates={'value': value, **others}):
                    control = self._control(uuid)
                    if control is None or others:
                        return False
                    check_value(control, value)
                    return True
                case _messages.FileTransferStartUpload():
                    return self._begins(message)
                case _messages.FileTransferPart():
                    return self._continues(message)
        except ValueError as error:
            self._report(str(error)[: 2 * LONGEST])
        return False

    def _control(self, uuid: str) -> Any:
        return self._gui._gui_input_handle_from_uuid.get(uuid)  # noqa: SLF001

    def _begins(self, message: Any) -> bool:
        """Checks the announcement of a file; there is one at a time."""
        control = self._control(message.source_component_uuid)
        size, parts = message.size_bytes, message.part_count
        if (
            not isinstance(control, viser.GuiUploadButtonHandle)
            or self._left
            or len(message.filename) > LONGEST
            or not (0 < parts <= size or parts == size == 0)
        ):
            return False
        if size > LARGEST_UPLOAD:
            done = _messages.FileTransferPartAck(  # else the page would wait for ever
                message.source_component_uuid, message.transfer_uuid, size, size
            )
            self._gui._websock_interface.queue_message(done)  # noqa: SLF001
            raise ValueError(
                f'{message.filename}: has {size} bytes; expected no more than {LARGEST_UPLOAD}'
            )
        self._transfer, self._part, self._left, self._parts = message.transfer_uuid, 0, size, parts
        return True

    def _continues(self, message: Any) -> bool:
        """Checks a part of a file: parts come in order, and together have the announced size."""
        left = self._left - len(message.content)
        if (message.transfer_uuid, message.part_index) != (self._transfer, self._part) or (
            left < 0 or (left == 0) != (self._part + 1 == self._parts)
        ):
            return False
        self._part, self._left = self._part + 1, left
        return True


def _decoded(data: Any) -> Any:
    """Returns a message of a kind and with fields that viser's page sends; None if it is not one."""
    try:
        fields = msgspec.msgpack.decode(data, type=dict[str, Any])
        message = msgspec.convert(fields, ACCEPTED[fields.pop('type')])
    except (msgspec.MsgspecError, KeyError, TypeError, ValueError, RecursionError):
        return None
    return message if fields.keys() <= vars(message).keys() else None


def check_value(control: Any, value: Any) -> None:
    """Checks a new value, as a browser sent it, of a control, whatever its kind."""
    name = control.label
    if hasattr(control, 'options'):
        if value not in control.options:
            raise ValueError(errors.unknown(name, str(value)[:LONGEST], control.options))
    elif hasattr(control, 'min'):
        kind = int if isinstance(control.value, int) else float
        checked(name, value, kind, at_least=control.min, at_most=control.max)
    elif isinstance(control.value, bool):
        checked(name, value, bool)
    else:
        raise ValueError(f'{name} takes no value')
