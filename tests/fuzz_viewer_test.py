"""The viewer in the web browser and what may be sent to it: whatever arrives, it goes on.

The slow test (`-m slow`) draws a seed of random messages, prints it, and takes it from FUZZ_SEED if that is
set; FUZZ_EXAMPLES says how many messages.
"""

import contextlib
import dataclasses
import http.client
import io
import logging
import math
import os
import pathlib
import random
import socket
import sys
import tempfile
import threading
import time
import urllib.parse
import warnings
from unittest import mock

import msgspec
import numpy as np
import pytest
import viser
from absl.testing import parameterized
from viser import _messages
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from trl_suite import policies
from trl_suite.rendering import web_guard, web_server
from trl_suite.util import program
from trl_suite.viewing import browser

FLAT, GAPS = 'PD_Biped2D_Flat-v0', 'PD_Biped2D_Gaps_Terrain-v0'
SOCCER, GOAT = 'PD_Biped3D_HLC_Soccer-v0', 'FSM_Goat2D_Terrain_Variable_Steps-v0'
SLOW = int(os.environ.get('FUZZ_EXAMPLES', '4000'))  # messages
ROUND = 50  # messages between two checks
PATIENCE = 120  # s
MARK = 'joint axes'  # a checkbox; that it changes shows that everything before has arrived
EVIL = {'Host': 'evil.example', 'Origin': 'https://evil.example'}
CAMERA = {
    'type': 'ViewerCameraMessage', 'wxyz': [1, 0, 0, 0.0], 'position': [3, 3, 3], 'fov': 1,
    'near': 0.1, 'far': 100.0, 'image_height': 100, 'image_width': 100, 'look_at': [0, 0, 0],
    'up_direction': [0, 0, 1.0],
}  # fmt: skip
SILENT = logging.getLogger('client')
SILENT.disabled = True
encode = msgspec.msgpack.encode


class Client:
    """A browser that sends anything. What it receives is dropped."""

    def __init__(self, viewer, camera=True):
        self.viewer = viewer
        address, versions = viewer.url.replace('http', 'ws'), [f'viser-v{viser.__version__}']
        self.socket = connect(
            address, subprotocols=versions, max_size=None, open_timeout=PATIENCE, logger=SILENT
        )
        threading.Thread(target=self._drop, daemon=True).start()
        if camera:
            self.send(CAMERA)

    def _drop(self):
        with contextlib.suppress(ConnectionClosed):
            for _ in self.socket:
                pass

    def send(self, message):
        with contextlib.suppress(ConnectionClosed):
            self.socket.send(message if isinstance(message, (bytes, str)) else encode(message))

    def set(self, label, value):
        self.send(update(control(self.viewer, label)._impl.uuid, value))

    def upload(self, name, content, size=None, parts=None, order=None, uuid='transfer'):
        """Sends a file in parts; others than the content needs if they are given."""
        button = control(self.viewer, 'Policy from a file')._impl.uuid
        chunks = [content[i : i + 2**19] for i in range(0, len(content), 2**19)]
        self.send({
            'type': 'FileTransferStartUpload', 'source_component_uuid': button,
            'transfer_uuid': uuid, 'filename': name, 'mime_type': '',
            'part_count': len(chunks) if parts is None else parts,
            'size_bytes': len(content) if size is None else size,
        })  # fmt: skip
        for i in range(len(chunks)) if order is None else order:
            self.send({
                'type': 'FileTransferPart', 'source_component_uuid': button,
                'transfer_uuid': uuid, 'part_index': i, 'content': chunks[i % len(chunks)],
            })  # fmt: skip

    def answered(self):
        """Waits until everything that it sent has been handled; False if the viewer is silent."""
        shown = not self.viewer.shown[MARK]
        self.set(MARK, shown)
        return waited_for(lambda: self.viewer.shown[MARK] == shown)


def waited_for(condition):
    """Waits until a condition holds; False if it does not in the end."""
    end = time.monotonic() + PATIENCE
    while not condition() and time.monotonic() < end:
        time.sleep(0.01)
    return condition()


def update(uuid, value):
    return {'type': 'GuiUpdateMessage', 'uuid': uuid, 'updates': {'value': value}}


def controls(viewer):
    return list(viewer._server.gui._gui_input_handle_from_uuid.values())


def control(viewer, label):
    return next(each for each in controls(viewer) if each.label == label)


def uploads(viewer):
    """Files of which viser has some parts."""
    return viewer._server.gui._current_file_upload_states


def status(viewer, path, headers):
    """The status of a request for a page, and of one for a websocket."""
    port, found = viewer._server.get_port(), []
    for more in ({}, {
        'Upgrade': 'websocket', 'Connection': 'Upgrade', 'Sec-WebSocket-Version': '13',
        'Sec-WebSocket-Key': 'AAAAAAAAAAAAAAAAAAAAAA==',
        'Sec-WebSocket-Protocol': f'viser-v{viser.__version__}',
    }):  # fmt: skip
        request = http.client.HTTPConnection('127.0.0.1', port, timeout=PATIENCE)
        request.request('GET', path, headers={**headers, **more})
        found.append(request.getresponse().status)
        request.close()
    return found


@contextlib.contextmanager
def quiet():
    """Fails if anything is printed or logged, warned of, or raised unexpectedly."""
    printed, raised = io.StringIO(), []

    def in_one_line(error):
        if not isinstance(error, program.EXPECTED):
            raised.append(error)
        return ' '.join(str(error).split())

    handler = logging.StreamHandler(printed)
    handler.setLevel(logging.WARNING)
    logging.getLogger().addHandler(handler)
    try:
        with (
            contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed),
            warnings.catch_warnings(action='error'),
            mock.patch.object(program, 'in_one_line', in_one_line),
        ):  # fmt: skip
            yield
    finally:
        logging.getLogger().removeHandler(handler)
    if raised:
        raise raised[0]
    assert printed.getvalue() == '', printed.getvalue()


class ViewerTest(parameterized.TestCase):
    def setUp(self):
        super().setUp()
        self.enterContext(quiet())
        self.viewer = browser.Browser(FLAT, 'zero', port=0)
        self.tell = self.enterContext(mock.patch.object(self.viewer._panel, 'tell'))
        self.enterContext(mock.patch.object(self.viewer._panel, 'notice'))  # of compiling
        self.viewer.start()
        self.addCleanup(self.viewer.stop)

    def client(self, **options):
        client = Client(self.viewer, **options)
        self.addCleanup(client.socket.close)
        return client

    def assert_told(self, *sentences):
        found = [call.args[0] for call in self.tell.call_args_list]
        self.assertLen(found, len(sentences), found)
        for told, expected in zip(found, sentences, strict=True):
            self.assertRegex(told, expected)
        self.tell.reset_mock()


class GuardTest(ViewerTest):
    def test_only_the_printed_address_is_answered(self):
        """Whatever the host or the origin: a forwarded port and a proxy have others."""
        token = urllib.parse.urlparse(self.viewer.url).path
        self.assertLen(token, 33)
        for headers in ({}, EVIL, {'Host': 'localhost:9999', 'Origin': 'http://localhost:9999'}):
            for path in (
                '/', '/index.html', '//', '/..', token[:-1], f'{token}0', f'/{token}', token.upper(),
                f'/x{token}', '/?' + token[1:], 'http://127.0.0.1' + token,
            ):  # fmt: skip
                with self.subTest(path, **headers):
                    self.assertEqual(status(self.viewer, path, headers), [403, 403])
            for path in (token, f'{token}/', f'{token}/index.html', f'{token}?x=y'):
                with self.subTest(path, **headers):
                    self.assertEqual(status(self.viewer, path, headers), [200, 101])
        self.assertEqual(status(self.viewer, f'{token}/../../__init__.py', {})[0], 404)
        server = web_server.start_server('127.0.0.1', 0)  # of replays, which nobody needs to see
        self.addCleanup(web_server.stop_server, server)
        for path in ('/', '/None', token):
            self.assertEqual(status(mock.Mock(_server=server), path, {}), [403, 403])

    def test_a_viser_that_cannot_be_guarded_is_refused(self):
        with (
            mock.patch.object(web_guard.Guard, 'installed', contextlib.nullcontext),
            self.assertRaisesRegex(RuntimeError, 'is not supported'),
        ):
            web_server.start_server('127.0.0.1', 0)

    def test_limits(self):
        clients = [self.client() for _ in range(web_guard.CLIENTS)]
        self.assertTrue(clients[0].answered())
        with self.assertRaisesRegex(InvalidStatus, '503'):
            self.client()
        clients[1].send(bytes(web_guard.LARGEST_MESSAGE + 1))
        self.assertTrue(waited_for(lambda: clients[1].socket.close_code is not None))
        self.assertEqual(clients[1].socket.close_code, 1009)
        self.assertTrue(self.client().answered())


class ValuesTest(ViewerTest):
    def test_bad_values_are_refused(self):
        client = self.client()
        for label, value, message in (
            ('Environment', 'x' * 100_000, "unknown Environment 'xxx"),
            ('Environment', FLAT[:-1], 'did you mean .*'),
            ('Policy', '/etc/passwd.npz', "unknown Policy '/etc/passwd.npz'; known: clip, random"),
            ('Policy', 'a\0b.npz', 'unknown Policy'), ('Policy', ['zero'], 'unknown Policy'),
            ('Preset', __file__, 'unknown Preset'), ('Preset', '/root.json', 'unknown Preset'),
            ('Preset', {'Type': 'flat'}, 'unknown Preset'), ('Speed', '16', 'unknown Speed'),
            ('to', 'down', 'unknown to'), ('to', None, 'unknown to'),
            ('m/s', math.nan, r'm/s is nan; expected a number'), ('m/s', '1', "m/s is '1'"),
            ('m/s', 5.1, r'm/s is 5.1; expected a number from 0.1 to 5'),
            ('m/s', -math.inf, 'm/s is -inf; expected'), ('m/s', True, 'm/s is True; expected'),
            ('Seed', -1, 'Seed is -1; expected a whole number from 0 to 4294967295'),
            ('Seed', 1.5, 'Seed is 1.5'), ('Seed', math.inf, 'Seed is inf'), ('Seed', 2**40, 'Seed is 1'),
            ('Seed', 'x' * 100_000, 'Seed is '), ('contacts', 1, 'contacts is 1; expected True or'),
            ('Pause', 'no', "Pause is 'no'; expected True or False"),
            ('Policy from a file', True, 'Policy from a file takes no value'),
        ):  # fmt: skip
            with self.subTest(label, value=value if len(str(value)) < 99 else 'long'):
                handle = control(self.viewer, label)
                before = handle.value
                client.set(label, value)
                self.assertTrue(client.answered())
                self.assertLess(len(self.tell.call_args.args[0]), 600)
                self.assert_told(message)
                self.assertEqual(handle.value, before)
        self.assertTrue(self.viewer.playing)

    def test_good_values_are_used(self):
        client = self.client()
        client.set('m/s', 2)  # JavaScript has one type of numbers
        client.set('Seed', 2**32 - 1)
        client.set('First episode of this seed', True)
        client.set('Speed', '1/2')
        client.set('Policy', 'random')
        client.set('Pause', True)
        viewer, expected = self.viewer, (2**32 - 1, 0.5, 'random', False)

        def state():
            return viewer.seed, viewer.speed, viewer._loaded.policy, viewer.playing

        self.assertTrue(waited_for(lambda: state() == expected))
        self.assert_told()
        self.assertEqual(control(viewer, 'm/s').value, 2.0)

    def test_other_messages_are_ignored(self):
        client, box = self.client(), control(self.viewer, 'contacts')._impl
        callbacks, tabs = list(box.update_cb), dict(vars(box))
        valid = update(box.uuid, True)
        with mock.patch.object(self.viewer._server, 'request_share_url') as share:
            for message in (
                {'type': 'ShareUrlRequest'},  # viser would open a tunnel to the internet
                {**valid, 'updates': {'update_cb': []}}, {**valid, 'updates': {'removed': True}},
                {**valid, 'updates': {'value': True, 'uuid': 'x'}}, {**valid, 'updates': {}},
                {**valid, 'updates': None}, {**valid, 'more': 1}, {**valid, 'uuid': 5},
                {**valid, 'uuid': 'x'}, {**valid, 'type': ['GuiUpdateMessage']}, {**valid, 'type': 'Gui'},
                {'type': 'GuiUpdateMessage'}, {'type': 'GuiFormDirtyMessage', 'uuid': 'x'},
                {**CAMERA, 'position': [0, 0]}, {**CAMERA, 'wxyz': 'abcd'}, {**CAMERA, 'fov': math.nan},
                {**CAMERA, 'look_at': [1e300, 0, 0]}, [1, 2], None, 7, b'', b'\xc1', b'\x81' * 5000,
                b'\x91' * 5000 + b'\0', b'\x81\xa4type\xa1\xff', bytes(1000), 'a text', '{}',
            ):  # fmt: skip
                client.send(message)
            self.assertTrue(client.answered())
        share.assert_not_called()
        self.assert_told()
        self.assertEqual((box.update_cb, dict(vars(box))), (callbacks, tabs))
        silent = self.client(camera=False)
        silent.send(valid)
        time.sleep(0.2)
        self.assertFalse(box.value)

    def test_mistakes_in_python_do_not_end_it(self):
        viewer, client = self.viewer, self.client()
        with mock.patch.object(program, 'EXPECTED', (Exception,)):
            viewer.push('down', 1.0)
            viewer.push('up', 'fast')
            viewer.choose_environment(3)
            viewer.choose_terrain(4)
            viewer.choose_policy('none.npz')
            viewer.upload_policy('zero', b'')
            self.assertTrue(client.answered())
            self.assertLen(self.tell.call_args_list, 6)
            self.tell.reset_mock()
            viewer.session.policy = lambda time_step: np.full(6, np.nan)
            self.assertTrue(waited_for(lambda: not viewer.playing))
            self.assertTrue(client.answered())
        self.assert_told('.*')
        viewer.choose_policy('zero')
        viewer.play(True)
        self.assertTrue(client.answered())


class UploadTest(ViewerTest):
    def setUp(self):
        super().setUp()
        with tempfile.TemporaryDirectory() as folder:
            path = pathlib.Path(folder, 'a.npz')
            self.content, policy = [], policies.reference(FLAT)
            for shift in (0.0, 0.5):
                last = policy.biases[-1] + shift
                policies.save(dataclasses.replace(policy, biases=(*policy.biases[:-1], last)), path)
                self.content.append(path.read_bytes())

    def test_a_file_of_the_same_name_replaces_the_first(self):
        client, viewer = self.client(), self.viewer
        found = [viewer.session.policy]
        for content in (self.content[0], *self.content):
            client.upload('mine.npz', content)
            self.assertTrue(waited_for(lambda: viewer.session.policy is not found[-1]))
            found.append(viewer.session.policy)
        time_step = viewer.session.time_step
        first, again, second = (policy(time_step) for policy in found[1:])
        np.testing.assert_array_equal(first, again)
        self.assertGreater(np.abs(second - first).max(), 0.1)
        self.assertTrue(client.answered())  # the panel has its new controls
        loaded = viewer._loaded
        client.set('Preset', 'slopes_mixed')
        self.assertTrue(waited_for(lambda: viewer._loaded.environment is not loaded.environment))
        self.assertEqual(viewer._loaded.policy, 'mine.npz')  # is kept on other terrain
        np.testing.assert_array_equal(viewer._loaded.policies['mine.npz'](time_step), second)
        self.assert_told()

    def test_refused_files(self):
        client, largest = self.client(), web_guard.LARGEST_UPLOAD
        for name, content, options, message in (
            ('mine.npz', b'', {}, '^mine.npz: no readable policy'),
            ('../../mine.npz', b'x', {}, '^../../mine.npz: no readable policy'),
            ('a\0b.npz', self.content[0][:-9], {}, '^a\0b.npz: no readable policy'),
            ('zero', self.content[0], {}, '^zero: expected a policy, .npz'),
            ('mine.npz', b'', {'size': largest + 1, 'parts': 65}, f'expected no more than {largest}'),
        ):  # fmt: skip
            with self.subTest(name, **options):
                client.upload(name, content, **options)
                self.assertTrue(waited_for(lambda: self.tell.called))
                self.assertNotIn(tempfile.gettempdir(), self.tell.call_args.args[0])
                self.assert_told(message)
        for options in (
            {'parts': 0}, {'parts': 2**40}, {'parts': -1}, {'size': -1}, {'size': 2**19},
            {'order': (1, 0)}, {'order': (0, 0)}, {'order': (0,)}, {'order': (-1, 1)},
        ):  # fmt: skip
            sender = self.client()
            sender.upload('mine.npz', self.content[0] + bytes(2**19), **options)
            self.assertTrue(sender.answered())
            sender.socket.close()
        other = self.client()
        other.send({
            'type': 'FileTransferStartUpload', 'filename': 'x.npz', 'mime_type': '', 'part_count': 0,
            'source_component_uuid': control(self.viewer, 'Seed')._impl.uuid, 'size_bytes': 0,
            'transfer_uuid': 'x',
        })  # fmt: skip
        self.assertTrue(other.answered())
        self.assert_told()
        self.assertEqual(control(self.viewer, 'Seed').value, 0)
        self.assertEqual(self.viewer._loaded.policy, 'zero')
        self.assertTrue(waited_for(lambda: not uploads(self.viewer)))


NUMBERS = (
    0, 1, -1, 0.5, 3, 2**31, 2**63, -(2**40), 1e-320, 1e30, 1e308, math.inf, -math.inf, math.nan, True,
)  # fmt: skip
TEXTS = (
    '', 'zero', 'up', '1', '/etc/passwd', '/etc/passwd.npz', '../x.json', 'a\0b.npz', 'x' * 5000, '<b>',
    '\u202e', 'value',
)  # fmt: skip


class Fuzz:
    """Sends random messages by several clients."""

    def __init__(self, viewer, seed, ids):
        self.viewer, self.random, self.ids = viewer, random.Random(seed), ids
        kinds = _messages.Message.get_subclasses()
        self.kinds = [each for each in kinds if each.__name__[0] != '_']
        self.clients = [Client(viewer) for _ in range(3)]
        with tempfile.TemporaryDirectory() as folder:
            path = pathlib.Path(folder, 'a.npz')
            policies.save(policies.reference(FLAT), path)
            self.content = path.read_bytes()

    def anything(self, depth=0):
        pick = self.random.random()
        if pick < 0.4:
            return self.random.choice(NUMBERS)
        if pick < 0.7:
            return self.random.choice(TEXTS)
        if pick < 0.8 or depth > 3:
            return self.random.choice((None, b'', self.random.randbytes(20)))
        parts = [self.anything(depth + 1) for _ in range(self.random.randrange(5))]
        return parts if pick < 0.9 else {str(part)[:9]: part for part in parts}

    def control(self):
        return self.random.choice([each for each in controls(self.viewer) if each.label != MARK])

    def value(self, handle):
        """A valid value of a control, or anything."""
        if self.random.random() < 0.5:
            return self.anything()
        if handle.label == 'Environment':  # other kinds have to be compiled
            return self.random.choice(self.ids)
        if hasattr(handle, 'options'):
            return self.random.choice(handle.options)
        if hasattr(handle, 'min'):
            share = self.random.choice((0, 0.001, 0.5, 1, self.random.random()))
            value = handle.min + share * (handle.max - handle.min)
            return int(value) if isinstance(handle.value, int) else value
        return self.random.random() < 0.5

    def to_a_control(self):
        handle = self.control()
        return update(handle._impl.uuid, self.value(handle))

    def of_a_kind(self):
        """Any message of viser, with fields of any value, or of what a client may know."""
        kind = self.random.choice((*self.kinds, *4 * list(web_guard.ACCEPTED.values())))
        handle = self.control()
        fields = {each.name: self.anything() for each in dataclasses.fields(kind)}
        for name in fields.keys() & {'uuid', 'source_component_uuid'}:
            fields[name] = handle._impl.uuid
        if 'updates' in fields and self.random.random() < 0.8:
            names = ('value', 'update_cb', 'removed', 'sync_cb', 'props', 'is_button', '__class__')
            fields['updates'] = {self.random.choice(names): self.value(handle)}
        return {**fields, 'type': kind.__name__}

    def camera(self):
        name = self.random.choice([name for name in CAMERA if name != 'type'])
        value = CAMERA[name]
        if isinstance(value, list):
            value = [self.random.choice((*NUMBERS, *value)) for _ in value]
        return {**CAMERA, name: self.random.choice((value, self.anything()))}

    def garbage(self):
        if self.random.random() < 0.3:
            return self.random.choice((self.random.randbytes(self.random.randrange(200)), 'a text'))
        data = bytearray(encode(self.random.choice((self.to_a_control, self.camera))()))
        for _ in range(self.random.randrange(1, 4)):
            data[self.random.randrange(len(data))] = self.random.randrange(256)
        return bytes(data[: self.random.choice((len(data), self.random.randrange(len(data) + 1)))])

    def upload(self, client):
        content = bytearray(self.content)
        for _ in range(self.random.choice((0, 1, 3))):
            content[self.random.randrange(len(content))] = self.random.randrange(256)
        name = self.random.choice(('mine.npz', 'other.npz', *TEXTS[:-1]))
        options = {}
        if self.random.random() < 0.5:
            name_of = self.random.choice(('size', 'parts'))
            options[name_of] = self.random.choice((0, 1, 2, -1, 2**25, 2**26, 2**60))
        client.upload(name, bytes(content), uuid=str(self.random.random()), **options)

    def connection(self):
        """Bytes instead of a request or of frames; or a client that leaves, and another one."""
        if self.random.random() < 0.5:
            place = self.random.randrange(len(self.clients))
            old = self.clients[place]
            if self.random.random() < 0.5:
                old.socket.socket.close()
            old.socket.close()
            self.clients[place] = Client(self.viewer)
            return
        port, token = self.viewer._server.get_port(), urllib.parse.urlparse(self.viewer.url).path
        opening = (
            f'GET {token} HTTP/1.1\r\nHost: x\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n'
            'Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Version: 13\r\n'
        )
        speaking = f'{opening}Sec-WebSocket-Protocol: viser-v{viser.__version__}\r\n\r\n'
        begin = self.random.choice((
            '', f'GET {token} HTTP/1.1\r\n', 'GET / HTTP/1.1\r\n', f'{opening}\r\n', speaking,
            'GET / HTTP/1.1\r\n' + 'x: y\r\n' * 1000, 'GET /' + 'a' * 100_000,
        ))  # fmt: skip
        with socket.create_connection(('127.0.0.1', port), PATIENCE) as raw:
            raw.sendall(begin.encode() + self.random.randbytes(self.random.randrange(300)))

    def send(self):
        """Sends one message by one client."""
        client, how = self.random.choice(self.clients), self.random.random()
        if how < 0.5:
            client.send(self.to_a_control())
        elif how < 0.7:
            client.send(self.of_a_kind())
        elif how < 0.8:
            client.send(self.camera())
        elif how < 0.9:
            client.send(self.garbage())
        elif how < 0.95:
            self.upload(client)
        else:
            self.connection()

    def check(self):
        """The viewer answers those who know its address, and nobody else."""
        for place, client in enumerate(self.clients):
            if client.socket.close_code is not None:  # after bytes that are no frame
                self.clients[place] = Client(self.viewer)
        assert self.clients[0].answered(), 'the viewer is silent'
        token = urllib.parse.urlparse(self.viewer.url).path
        wrong = self.random.choice(('/', token[:-1], f'/{token[2:]}', f'/x{token}'))
        headers = self.random.choice(({}, EVIL))
        assert status(self.viewer, wrong, headers) == [403, 403]
        assert status(self.viewer, token, headers) == [200, 101]


class FuzzTest(ViewerTest):
    @pytest.mark.slow
    def test_random_messages(self):
        seed = int(os.environ.get('FUZZ_SEED', random.SystemRandom().getrandbits(32)))
        print(f'FUZZ_SEED={seed}', file=sys.__stderr__)
        fuzz = Fuzz(self.viewer, seed, (FLAT, GAPS, SOCCER, GOAT))
        with mock.patch.object(self.viewer._server, 'request_share_url') as share:
            for number in range(SLOW):
                fuzz.send()
                if number % ROUND == ROUND - 1:
                    fuzz.check()
            fuzz.check()
        share.assert_not_called()
        for client in fuzz.clients:
            client.socket.close()
        self.assertTrue(self.client().answered())
        self.assertTrue(waited_for(lambda: not uploads(self.viewer)))
        for call in self.tell.call_args_list:
            self.assertNotIn(tempfile.gettempdir(), call.args[0])
