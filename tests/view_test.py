"""The command view: inputs and frames of dm_control's viewer, with a fake window."""

import importlib
import os
import signal
import socket
import types
import urllib.error
import urllib.request
import warnings
from unittest import mock

import numpy as np
from absl.testing import parameterized
from programs import GAPS, CommandTest, policy_for, run

from trl_suite import policies, suite
from trl_suite.cli import view
from trl_suite.environments.environment import Environment
from trl_suite.tasks.task import Marker
from trl_suite.util import notices
from trl_suite.viewing import browser, playback

DOG, PLANS = 'FSM_Dog2D_Terrain_Mixed-v0', 'PD_Biped3D_HLC_PathFollowing-v0'
HILLS = 'PD_Biped3D_Imitate-Hills_Terrain-v0'
FRAME = 1 / 30  # s

with warnings.catch_warnings():  # GLFW's, where there is no screen
    warnings.simplefilter('ignore')
    window = importlib.import_module('trl_suite.viewing.window')


class ViewTest(CommandTest):
    def view(self, *arguments):
        """Runs the command; returns environment, policy and title of the window."""
        with mock.patch.object(view, 'check_screen'), mock.patch.object(view, 'view') as shown:
            self.assertEqual(self.output('view', *arguments), '')
        return shown.call_args.args

    @parameterized.parameters((PLANS, 'scripted'), ('plaid/biped_gaps', None))
    def test_environment_policy_and_title(self, id_, name):
        """Trying policies, to find the best that exists, costs no episode: it is that of the seed."""
        chosen = ('--policy', name) if name else ()
        environment, policy, title = self.view(id_, *chosen, '--seed', '3')
        self.assertEqual(title, f'{suite.find(id_).id}: {name or "reference"}')
        expected = suite.make(id_, {'random': 3}).reset().observation
        time_step = environment.reset()
        for block, value in time_step.observation.items():
            np.testing.assert_array_equal(value, expected[block])
        self.assertEqual(policy(time_step).shape, environment.action_spec().shape)

    def test_a_policy_file(self):
        policy = policy_for(GAPS)
        policies.save(policy, 'mine.npz')
        environment, found, title = self.view(GAPS, '--policy', 'mine.npz')
        self.assertEqual(title, f'{GAPS}: mine.npz')
        time_step = environment.reset()
        np.testing.assert_array_equal(found(time_step), policy(time_step.observation))

    @parameterized.parameters(
        ('did you mean', 'PD_Biped2D_Gap_Terrain-v0'),
        ("unknown policy 'walk'; known:", GAPS, '--policy', 'walk'),
        ('no such file', GAPS, '--policy', 'none.npz'),
        ('torque control cannot follow a clip', 'imitation/torque_dog', '--policy', 'clip'),
        (r'random is -1; expected a seed in \[0', GAPS, '--seed', '-1'),
    )
    def test_invalid_arguments_are_rejected(self, message, *arguments):
        """No address is printed for unknown names."""
        with mock.patch.object(view, 'check_screen'), mock.patch.object(view, 'view') as shown:
            self.assert_refused(message, 'view', *arguments)
            if 'clip' not in arguments and '-1' not in arguments:
                self.assert_refused(message, 'view', *arguments, '--browser')
        shown.assert_not_called()

    @parameterized.parameters(
        (signal.SIGTERM, 143, 'terminated'), (signal.SIGINT, 130, 'interrupted')
    )
    def test_status_after_a_signal(self, number, status, how):
        """The viewer in the web browser runs until then, and is closed."""
        viewers = []

        def serve(viewer):
            viewers.append(viewer)
            os.kill(os.getpid(), number)

        with mock.patch.object(browser.Browser, '_serve', serve):
            words = 'view', GAPS, '--browser', '--port', '18700', '--policy', 'zero'
            found, out, err = run(*words)
        self.assertEqual((found, err), (status, f'trl-suite: {how}\n'))
        self.assertRegex(out, r'^open http://127.0.0.1:\d+\S* in a web browser; press Ctrl')
        with self.assertRaises(ConnectionRefusedError):
            socket.create_connection(('127.0.0.1', viewers[0]._server.get_port())).close()

    @parameterized.parameters((ValueError, 2), (KeyboardInterrupt, 130))
    def test_the_address_answers_while_the_environment_is_loaded(self, error, status):
        seen = []

        def load(viewer, *_):
            with urllib.request.urlopen(viewer.url) as page:
                seen.append(page.status)
            with self.assertRaises(urllib.error.HTTPError) as refused:
                urllib.request.urlopen(viewer.url[:-1])
            refused.exception.close()  # the server would wait for it
            seen.extend([refused.exception.code, viewer._panel._status.content, viewer])
            notices._say('compiling')
            seen.append(viewer._panel._status.content)
            raise error('stop')

        before = list(notices.listeners)
        with mock.patch.object(browser.Browser, '_load', load):
            found, out, _ = run('view', GAPS, '--browser', '--port', '18700')
        self.assertEqual((found, *seen[:2]), (status, 200, 403))
        self.assertIn(GAPS, seen[2])
        self.assertIn('compiling', seen[4])
        self.assertStartsWith(out, f'open {seen[3].url} in a web browser')
        self.assertEqual(notices.listeners, before)
        with self.assertRaises(ConnectionRefusedError):  # the server has ended
            socket.create_connection(('127.0.0.1', seen[3]._server.get_port())).close()

    def test_a_missing_screen_is_an_error(self):
        nothing = {'DISPLAY': '', 'WAYLAND_DISPLAY': ''}
        with mock.patch.dict('os.environ', nothing), mock.patch('sys.platform', 'linux'):
            self.assert_refused('neither DISPLAY nor WAYLAND_DISPLAY .*--browser', 'view', GAPS)
        with (
            mock.patch.dict('os.environ', {'DISPLAY': ':1', 'MUJOCO_GL': 'egl'}),
            mock.patch('glfw.init', lambda: warnings.warn('Failed to open :1', stacklevel=1)),
        ):
            self.assert_refused(r'GLFW can use \(Failed to open :1\); .*--browser', 'view', GAPS)


class PlaybackTest(parameterized.TestCase):
    @parameterized.parameters(DOG, PLANS)
    def test_long_steps_frame_by_frame(self, id_):
        environment, expected = (suite.make(id_, {'random': 2}) for _ in range(2))
        random, asked = np.random.default_rng(0), []

        def policy(time_step):
            asked.append(random.uniform(-0.1, 0.1, expected.action_spec().shape))
            return asked[-1]

        played = playback.Playback(environment, policy)
        time_step, end, times = played.reset(), expected.reset(), [0.0]
        for step in range(3):
            while len(asked) <= step or played._left:
                time_step = played.step(played.policy(time_step))
                times.append(played.physics.data.time)
            self.assertLen(asked, step + 1)
            end = expected.step(asked[-1])
            self.assertEqual((time_step.reward, time_step.discount), (end.reward, end.discount))
            for block, value in end.observation.items():
                np.testing.assert_array_equal(time_step.observation[block], value)
            np.testing.assert_array_equal(played.physics.data.qpos, expected.physics.data.qpos)
        passed = np.diff(times)
        self.assertGreater(len(passed), 25)
        self.assertBetween(passed.min(), 1e-4, FRAME)  # no frame is shown twice
        self.assertLess(passed.max(), FRAME + 1e-9)

    def test_a_reset_within_a_step(self):
        played = playback.Playback(suite.make(DOG, {'random': 2}), lambda time_step: np.zeros(29))
        time_step = played.reset()
        for _ in range(3):
            time_step = played.step(played.policy(time_step))
        self.assertTrue(time_step.mid())
        self.assertNotEmpty(played._left)
        self.assertTrue(played.reset().first())
        self.assertEqual(played.physics.data.time, 0)
        self.assertLess(played.step(np.zeros(29)) and played.physics.data.time, 1.01 * FRAME)

    def test_only_long_steps(self):
        for id_, kind in ((DOG, playback.Playback), (GAPS, Environment)):
            environment = suite.make(id_)
            with mock.patch.object(window, 'Window') as shown:
                view.view(environment, lambda time_step: np.zeros(29), 'a title')
            shown.assert_called_once_with(environment, 'a title')
            self.assertIsInstance(shown().launch.call_args.args[0], kind)


class NoWindow:
    """A fake window for the viewer; it stores its frames, and closes after some of them."""

    def __init__(self, width, height, title):
        names = ('on_move', 'on_click', 'on_double_click', 'on_scroll', 'on_key')
        events = {name: window.application.util.QuietSet() for name in names}
        self.mouse = types.SimpleNamespace(position=np.zeros(2, int), **events)
        self.keyboard, self.shape, self.title = self.mouse, (160, 120), title
        self.count, self.pictures, self.after = 20, [], lambda i: None

    def event_loop(self, tick_func):
        for i in range(self.count):
            self.pictures.append(tick_func().astype(int))
            self.after(i)

    def close(self):
        pass


class WindowTest(parameterized.TestCase):
    """The viewer itself, which draws into memory."""

    def setUp(self):
        super().setUp()
        self.enterContext(mock.patch.object(window.application.gui, 'RenderWindow', NoWindow))

    def window(self, environment):
        shown = window.Window(environment, 'a title')
        clock = types.SimpleNamespace(tick=lambda: FRAME, measured_time=FRAME)
        shown._frame_timer = clock  # the machine's clock may be slow
        shown._viewer_layout = window.application.views.ViewportLayout()  # no text over the frame
        return shown, shown._window

    @parameterized.parameters(GAPS, DOG, PLANS)
    def test_moves_and_is_followed(self, id_):
        environment, times = suite.make(id_, {'random': 1}), []
        _, policy = view.acting.best(environment, id_)
        shown, screen = self.window(environment)
        screen.after = lambda i: times.append(environment.physics.data.time)
        with mock.patch.object(window, 'Window', return_value=shown):
            view.view(environment, policy, 'a title')
        self.assertEqual(screen.title, 'a title')
        # In the time of the clock: a frame each, now and then none or two.
        self.assertAlmostEqual(times[-1], 20 * FRAME, delta=2.01 * FRAME)
        self.assertLess(np.diff(times).max(), 2.01 * FRAME)
        changes = np.abs(np.diff(screen.pictures[1:], axis=0)).mean((1, 2, 3))
        self.assertGreater(np.mean(changes > 0.05), 0.6)
        self.assertGreater(screen.pictures[-1].std(), 10)
        body = shown._viewer.camera.settings.trackbodyid
        name = environment.physics.model.id2name(body, 'body')
        self.assertEqual(name, f'{environment.task.character.spec.name}/')

    def test_changed_ground_and_markers_are_drawn(self):
        environment = suite.make(HILLS, {'random': 1})
        shown, screen = self.window(environment)
        shown._pause_subject.toggle()
        place = environment.physics.data.xpos[environment.task.body.links[0]]
        marker = Marker('sphere', place, (0.5, 0.5, 0.5), (1, 0, 0, 1))

        def change(i):
            if i == 1:
                environment.physics.model.hfield_data[:] = 0
            if i == 3:
                environment.task.markers = lambda row: [marker]

        screen.count, screen.after = 5, change
        shown.launch(environment, None)
        first, again, flat, still, marked = screen.pictures
        np.testing.assert_array_equal(first, again)
        self.assertGreater(np.abs(flat - first).mean(), 1)
        np.testing.assert_array_equal(flat, still)
        self.assertGreater(np.abs(marked - still).max(), 50)
