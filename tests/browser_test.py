"""The viewer in the web browser and replays: what they draw, and what a real browser shows of it."""

import base64
import shutil
import socket
import time
import unittest
import urllib.request
from unittest import mock

import imageio.v3 as iio
import mujoco
import numpy as np
import pytest
import rich.console
from absl.testing import absltest, parameterized
from helpers import FolderTest
from programs import run

from trl_suite import cli, rendering, suite
from trl_suite.arenas import PlanarArena
from trl_suite.rendering import overlays, replays, web_meshes, web_scene, web_server
from trl_suite.util import notices
from trl_suite.viewing import browser, session

DOG, GOAT = 'PD_Dog2D_Slopes_Mixed_Terrain-v0', 'FSM_Goat2D_Terrain_Variable_Steps-v0'
HILLS, SOCCER = 'PD_Biped3D_Imitate-Hills_Terrain-v0', 'PD_Biped3D_HLC_Soccer-v0'
BELTS = 'PD_Biped3D_HLC_Conveyors-v0'
FOREST, RAMP = 'PD_Biped3D_HLC_Forest-v0', 'PD_Biped3D_Imitate-Ramp-v0'
STAIRS = 'PD_Biped3D_Imitate-Stairs-v0'
FRAME = 1 / 30  # s
CHROMIUM = next(
    filter(None, map(shutil.which, ('chromium', 'chromium-browser', 'google-chrome'))), ''
)
# Without a sandbox, as containers need it, and with WebGL on the processor. The page around it is drawn
# without WebGL, which would take ten times as long.
FLAGS = (
    '--no-sandbox', '--use-angle=swiftshader', '--enable-unsafe-swiftshader',
    '--disable-gpu-compositing', '--disable-gpu-rasterization',
)  # fmt: skip
PATIENCE = 120_000  # ms; on a busy machine drawing by the processor is slow
# Keeps what was drawn, so that it can be read at any time. A screenshot waits for two frames of the whole
# page, which takes up to 30 s without a graphics card.
KEEP = """
const getContext = HTMLCanvasElement.prototype.getContext;
HTMLCanvasElement.prototype.getContext = function (kind, options) {
  return getContext.call(this, kind, {...options, preserveDrawingBuffer: true});
};
"""
READ = """() => [...document.querySelectorAll('canvas')]
  .sort((one, other) => other.width * other.height - one.width * one.height)[0]
  .toDataURL()
"""


def zero(environment):
    action = np.zeros(environment.action_spec().shape)
    return lambda time_step: action


class SessionTest(parameterized.TestCase):
    @parameterized.parameters(DOG, GOAT, SOCCER)
    def test_frames_are_those_of_the_environment(self, id_):
        """Of every frame of a second: 1/30 s or less has passed; steps end as they do without."""
        environment, expected = (suite.make(id_, {'random': 2}) for _ in range(2))
        act = zero(expected)
        shown = session.Session(environment, act)
        expected.reset()
        total = time_passed = 0.0
        while not shown.time_step.last() and time_passed < 1:
            passed = shown.advance()
            time_passed += passed
            self.assertBetween(passed, 0, FRAME + 1e-9)
            if shown.is_between_steps:
                total += expected.step(act(None)).reward
                qpos, own = (each.physics.data.qpos for each in (environment, expected))
                np.testing.assert_array_equal(qpos, own)
                self.assertEqual(shown.total, total)
        self.assertAlmostEqual(environment.physics.data.time, time_passed)
        self.assertGreater(time_passed, 0.2)
        moment = shown.history[-1]
        self.assertLen(moment.rewards, len(shown.reward_names))
        sum_ = moment.rewards[0] * (len(moment.rewards) > 1)
        np.testing.assert_allclose(moment.rewards[1:].sum(), sum_)
        self.assertLen(moment.torques, len(shown.joint_axes))
        self.assertEqual(shown.status()['episode'], '1')

    def test_a_seed_repeats_an_episode(self):
        environment = suite.make(DOG, {'random': 5})
        shown = session.Session(environment, zero(environment), seed=3)
        expected = suite.make(DOG, {'random': 3})
        for _ in range(2):
            found, own = shown.time_step.observation, expected.reset().observation
            np.testing.assert_array_equal(found['terrain'], own['terrain'])
            expected.random_state.seed(3)
            shown.reset(3)
        self.assertEqual(shown.episode, 1)
        shown.reset()
        self.assertEqual(shown.episode, 2)

    @parameterized.parameters(
        (DOG, 'forward', (2, 0, 0)), (DOG, 'left', (0, 0, 0)), (GOAT, 'up', (0, 0, 2)),
        (SOCCER, 'left', (0, 2, 0)),
    )  # fmt: skip
    def test_a_push_moves_the_whole_body(self, id_, direction, change):
        environment = suite.make(id_, {'random': 2})
        shown = session.Session(environment, zero(environment))
        shown.advance()
        model, data = environment.physics.model.ptr, environment.physics.data.ptr
        root = environment.task.body.links[0]

        def velocity():
            mujoco.mj_subtreeVel(model, data)
            return data.subtree_linvel[root].copy()

        shown.push(direction, 2.0)
        while not shown.is_between_steps:
            shown.advance()
        before = velocity()
        shown._apply_push()
        np.testing.assert_allclose(velocity() - before, change, atol=1e-9)
        shown.advance()
        with self.assertRaisesRegex(ValueError, "unknown direction 'forwards'; did you mean 'forw"):
            shown.push('forwards', 1.0)


def started(id_):
    environment = suite.make(id_, {'random': 4})
    environment.reset()
    return environment


class SceneTest(parameterized.TestCase):
    @parameterized.parameters(DOG, 'PD_Biped2D_Gaps_Terrain-v0', 'PD_Dog2D_Steps_Terrain-v0')
    def test_planar_ground_is_that_of_the_arena(self, id_):
        arena = started(id_).task.arena
        mesh = web_meshes.planar_mesh(arena.ground)
        # Upper corners of the pieces that the mesh consists of, from its upper triangles.
        tops = mesh.triangles[mesh.face_normals[:, 2] > 0.1]
        first, last = tops[:, :, 0].min(1), tops[:, :, 0].max(1)
        self.assertAlmostEqual(first.min(), -6.0)
        self.assertAlmostEqual(last.max(), 18.0)
        middles = 0.5 * (first + last)
        heights = 0.5 * (tops[:, :, 2].min(1) + tops[:, :, 2].max(1))
        found = arena.height(middles[None])[0]
        long = last - first > 0.02  # not beside a vertical face, which ends within a cell
        self.assertGreater(long.sum(), 5)
        np.testing.assert_allclose(heights[long], found[long], atol=1e-6)

    def test_height_field_is_that_of_the_arena(self):
        environment = started(HILLS)
        model, data = environment.physics.model.ptr, environment.physics.data.ptr
        field = int(np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_HFIELD)[0])
        mesh = web_meshes.height_field_mesh(model, data, field)
        # Everywhere but where fine and coarse cells meet; the window ends at 16 m.
        distance = np.abs(mesh.vertices[:, :2]).max(1)
        border = np.abs(distance - web_meshes.NEAR) < 1e-3
        x, y, z = mesh.vertices[~border & (distance < 15)].T
        heights = environment.task.arena.height(x[None], y[None])[0]
        np.testing.assert_allclose(z, heights, atol=0.5 * web_meshes.STEP + 1e-5)
        # Without overlaps: the area seen from above is that of the field.
        self.assertAlmostEqual(mesh.area_faces @ mesh.face_normals[:, 2], 32.0**2, delta=1e-2)
        for at in (x, y):
            near = np.unique(np.round(at[np.abs(at) < 7.9], 3))
            np.testing.assert_allclose(np.diff(near), 0.2, atol=2e-3)
        self.assertGreater((mesh.face_normals[:, 2] > 0).mean(), 0.999)

    def test_ports(self):
        """The next free one is taken; where there is none, no server waits for ever."""
        first = web_server.start_server('127.0.0.1', 0)
        self.addCleanup(web_server.stop_server, first)
        second = web_server.start_server('127.0.0.1', first.get_port())
        self.addCleanup(web_server.stop_server, second)
        self.assertGreater(second.get_port(), first.get_port())
        for port in (65536, 10**8, -1, 2.5):
            with self.assertRaisesRegex(ValueError, f'port is {port}; expected a whole number'):
                web_server.start_server('127.0.0.1', port)
        with socket.socket() as taken:
            taken.bind(('127.0.0.1', 65535))
            with self.assertRaisesRegex(OSError, 'in use'):
                web_server.start_server('127.0.0.1', 65535)
        with self.assertRaisesRegex(OSError, "host 'nosuch.invalid', port 8080"):
            web_server.start_server('nosuch.invalid', 8080)

    def shown(self, id_):
        """An environment in its first state, and its scene in a server."""
        environment, server = started(id_), web_server.start_server('127.0.0.1', 0)
        self.addCleanup(web_server.stop_server, server)
        return environment, web_scene.WebScene(server, environment)

    @parameterized.parameters((DOG, {'box', 'tube', 'sphere'}), (SOCCER, {'box', 'sphere', 'cone'}))
    def test_shapes_of_what_mujoco_draws(self, id_, expected):
        environment, scene = self.shown(id_)
        scene.update(overlays.of_task(environment.task))
        self.assertLessEqual(expected, {name.partition('_')[0] for name in scene._handles})
        # The character is in the middle.
        spheres = scene._handles['sphere'].batched_positions
        self.assertLess(np.linalg.norm(spheres.mean(0)), 1.5)
        capsules = (environment.physics.model.geom_type == mujoco.mjtGeom.mjGEOM_CAPSULE).sum()
        if 'tube' in expected:
            self.assertLen(scene._handles['tube'].batched_positions, capsules)

    def test_colours_are_those_of_the_materials(self):
        environment, scene = self.shown('PD_Raptor2D_Gaps_Terrain-v0')
        scene.update()
        model = environment.physics.model
        bones = scene._handles['tube'].batched_colors
        materials = model.geom_matid[model.geom_type == mujoco.mjtGeom.mjGEOM_CAPSULE]
        expected = 255 * model.mat_rgba[materials, :3] ** web_scene.GAMMA
        np.testing.assert_allclose(np.unique(bones, axis=0), np.unique(expected, axis=0), atol=1.01)

    @parameterized.parameters(DOG, SOCCER)
    def test_contact_forces(self, id_):
        environment, scene = self.shown(id_)
        for _ in range(10):
            environment.step(np.zeros(environment.action_spec().shape))
            if environment.physics.data.ncon:
                break
        scene.option.flags[mujoco.mjtVisFlag.mjVIS_CONTACTFORCE] = 1
        scene.update()
        self.assertGreaterEqual(
            len(scene._handles['cone'].batched_positions), environment.physics.data.ncon
        )

    @parameterized.parameters(DOG, HILLS, SOCCER, FOREST, RAMP)
    def test_squares_cover_the_ground(self, id_):
        environment = started(id_)
        arena = environment.task.arena
        if isinstance(arena, PlanarArena):
            meshes = {(0, 'boxes'): web_meshes.planar_mesh(arena.ground)}
        else:
            model, data = environment.physics.model.ptr, environment.physics.data.ptr
            is_ground = np.asarray(model.body_weldid[model.geom_bodyid] == 0)
            meshes = web_meshes.ground_meshes(model, data, is_ground, web_scene.FAR_BELOW)
        for mesh in meshes.values():
            middle = np.array([8.0, 0.0, 0.0])
            *near, far = parts = web_meshes.squares(mesh, middle, 24.0)
            area = mesh.area_faces[mesh.face_normals[:, 2] > -1e-6].sum()
            np.testing.assert_allclose(sum(part.area for part in parts), area, rtol=1e-4)
            bounds = np.array([part.bounds for part in parts if len(part.faces)])
            found = bounds[:, 0].min(0), bounds[:, 1].max(0)
            np.testing.assert_allclose(np.array(found).T[:2], mesh.bounds.T[:2], atol=1e-4)
            self.assertAlmostEqual(found[1][2], mesh.bounds[1, 2], places=4)
            far_tops = far.triangles_center[far.face_normals[:, 2] > 0.1]
            self.assertTrue((np.abs(far_tops - middle)[:, :2].max(1) > 24).all())
            for shade, part in enumerate(near):
                self.assertTrue((part.face_normals[:, 2] > 0.09).all())
                self.assertGreater(len(part.faces), 5)
                corners = part.triangles[:, :, :2]
                squares = np.floor(corners.mean(1) / web_meshes.TILE)
                np.testing.assert_array_equal(squares.sum(1) % 2, shade)
                inside = corners / web_meshes.TILE - squares[:, None]
                self.assertBetween(inside.min(), -1e-4, inside.max())
                self.assertLess(inside.max(), 1 + 1e-4)

    def test_changed_ground_keeps_its_handles(self):
        """Clients would show nothing until they have added a new one."""
        environment, scene = self.shown(HILLS)
        scene.update()
        handles = dict(scene._ground_handles)
        before = {key: handle.vertices.copy() for key, handle in handles.items()}
        heights = environment.physics.model.hfield_data
        for jump in (False, True):
            heights[:] = 0.5 * (1 - heights)
            scene.update(jump=jump)
            self.assertEqual(scene._ground_handles, handles)
            for key, handle in handles.items():
                self.assertTrue(handle.visible)
                self.assertNotEqual(handle.vertices[:, 2].min(), before[key][:, 2].min())
                self.assertLess(handle.faces.max(), len(handle.vertices))

    @parameterized.parameters(SOCCER, RAMP)
    def test_ground_follows_the_view(self, id_):
        """A plane by multiples of two squares, with the same meshes; of a ramp its part nearby."""
        environment, scene = self.shown(id_)
        scene.update()
        for x in (101.2, 207.3):
            environment.physics.data.qpos[environment.task.body.pose_qpos[0]] = x
            environment.physics.forward()
            with mock.patch.object(scene, '_lay_ground', wraps=scene._lay_ground) as lay:
                scene.update(jump=True)
            light = next(handle for key, handle in scene._ground_handles.items() if key[-1] == 0)
            if id_ == SOCCER:
                lay.assert_not_called()
                place = light.batched_positions[0] + scene._focus
                steps = place / (2 * web_meshes.TILE)
                np.testing.assert_allclose(steps, np.round(steps), atol=1e-5)
                self.assertLess(np.abs(place - scene._focus)[:2].max(), web_meshes.TILE + 1e-5)
                continue
            self.assertAlmostEqual(light.vertices[:, 0].min(), x - web_scene.NEAR_REACH, delta=5)
            self.assertAlmostEqual(light.vertices[:, 0].max(), x + web_scene.NEAR_REACH, delta=5)
            self.assertLess(len(light.vertices), 10_000)

    @parameterized.parameters(DOG, HILLS)
    def test_samples_lie_where_they_are_observed(self, id_):
        environment = suite.make(id_, {'random': 4})
        observed = environment.reset().observation['terrain']
        task = environment.task
        samples = overlays.terrain_samples(task, environment.physics)
        self.assertLen(samples, len(observed))
        x, y, _ = environment.physics.data.xpos[task.body.links[0]]
        at = ([[x]], [[y]]) if task.arena.terrain.spatial else ([[x]],)
        under = task.arena.height(*map(np.array, at)).item()
        np.testing.assert_allclose(samples[:, 2] - under, observed, atol=1e-9)


class OptionTest(absltest.TestCase):
    def test_options_of_the_task(self):
        """The command passes them on, and every environment that the viewer shows has them."""
        option = 'randomize={"friction": 0.3}'
        words = 'view', DOG, '--browser', '--port', '8765', '--option', option
        with mock.patch.object(browser, 'Browser') as made:
            self.assertEqual(cli.main(words), 0)
        self.assertEqual(made.call_args.kwargs['task_kwargs'], {'randomize': {'friction': 0.3}})
        viewer = browser.Browser(DOG, port=0, task_kwargs={'randomize': {'friction': 0.3}})
        self.addCleanup(viewer.stop)
        viewer.choose_environment('PD_Raptor2D_Flat-v0')
        for _ in range(2):
            self.assertEqual(viewer.session.environment.info['world'], {'friction': 0.3})
            viewer._serve()
        self.assertEqual(viewer._loaded.spec.id, 'PD_Raptor2D_Flat-v0')
        with self.assertRaisesRegex(ValueError, "did you mean 'randomize'"):
            browser.Browser(DOG, port=0, task_kwargs={'randomise': 'robot'})


class BrowserTest(parameterized.TestCase):
    def test_a_refused_choice_is_taken_back(self):
        viewer = browser.Browser(SOCCER, port=0)
        self.addCleanup(web_server.stop_server, viewer._server)
        preset, policy = viewer._panel._fitted[0], viewer._loaded.policy
        self.assertEqual(preset.value, 'plane')
        with mock.patch.object(viewer._panel, 'tell') as tell:
            preset.value = 'checkers_3d'  # as by a user
            viewer.upload_policy('mine.npz', b'')
            viewer._serve()
        self.assertLen(tell.call_args_list, 2)
        self.assertIn('a ball needs level ground', tell.call_args_list[0].args[0])
        self.assertIn('mine.npz', tell.call_args_list[1].args[0])
        self.assertEqual(viewer._panel._fitted[0].value, 'plane')
        self.assertEqual(viewer._panel._policy.value, policy)

    def test_a_seed_repeats_random_actions(self):
        viewer = browser.Browser(DOG, 'random', seed=3, port=0)
        self.addCleanup(web_server.stop_server, viewer._server)
        found = []
        for begin in (
            lambda: None,
            lambda: viewer.reset(3),
            lambda: viewer.choose_policy('random'),
        ):
            begin()
            viewer._serve()
            for _ in range(5):
                viewer.session.advance()
            found.append(viewer.session.total)
        self.assertEqual(found, found[:1] * 3)
        with self.assertRaisesRegex(ValueError, r'seed is -1; expected a seed in \[0, 2\*\*32\)'):
            browser.Browser(DOG, seed=-1, port=0)
        with self.assertRaisesRegex(
            ValueError, "task_kwargs has 'random'; use the argument `seed`"
        ):
            browser.Browser(DOG, port=0, task_kwargs={'random': 5})
        with self.assertRaisesRegex(ValueError, 'torque control cannot follow a clip'):
            browser.Browser('imitation/torque_dog', 'clip', port=0)

    def test_start_and_stop(self):
        viewer = browser.Browser(DOG, 'zero', port=0)
        thread = viewer.start()._thread
        self.assertIs(viewer.start()._thread, thread)
        viewer.speed = 0
        time.sleep(0.2)
        self.assertTrue(thread.is_alive())
        viewer.stop()
        self.assertFalse(thread.is_alive())
        with mock.patch.object(web_server, 'stop_server', wraps=web_server.stop_server) as stop:
            browser.Browser(DOG, 'zero', port=0).stop()
        stop.assert_called_once()

    def test_the_button_says_what_it_does(self):
        viewer = browser.Browser(DOG, 'zero', port=0)
        self.addCleanup(web_server.stop_server, viewer._server)
        for playing, label in ((False, 'Play'), (True, 'Pause')):
            viewer.play(playing)
            viewer._serve()
            self.assertEqual(viewer._panel._play.label, label)

    def test_browsers_are_told_of_waits_while_it_runs(self):
        viewer = browser.Browser(DOG, 'zero', port=0)
        viewer.choose_environment(DOG)

        def load(*_):
            notices._say('compiling')
            viewer.stop()
            raise ValueError('refused')

        before = list(notices.listeners)
        with (
            mock.patch.object(viewer, '_load', load),
            mock.patch.object(viewer._panel, 'tell') as tell,
        ):
            viewer.run()
        told = [call.args[0] for call in tell.call_args_list]
        told = [text for text in told if not text.startswith('compiling functions')]  # in fact
        self.assertEqual(told, ['compiling', 'refused'])
        self.assertEqual(notices.listeners, before)

    @parameterized.parameters(
        ('127.0.0.1', '127.0.0.1', False), ('localhost', 'localhost', False),
        ('0.0.0.0', '127.0.0.1', True),
    )  # fmt: skip
    def test_addresses(self, host, own, others):
        """0.0.0.0 is no address that a browser can open on another machine."""
        viewer = browser.Browser(DOG, 'zero', host=host, port=0)
        self.addCleanup(web_server.stop_server, viewer._server)
        port, token = viewer._server.get_port(), viewer.url.rpartition('/')[2]
        self.assertEqual(viewer.url, f'http://{own}:{port}/{token}')
        expected = f'http://{socket.gethostname()}:{port}/{token}' if others else ''
        self.assertEqual(viewer.other_url, expected)
        with urllib.request.urlopen(viewer.url) as page:
            self.assertEqual(page.status, 200)


class ReplayTest(FolderTest):
    @parameterized.parameters(
        (GOAT, 0.2), (HILLS, 1.0), (SOCCER, 0.2), (BELTS, 0.2), (STAIRS, 0.2),
    )  # fmt: skip
    def test_ten_seconds_take_no_more_than_3_mb(self, id_, largest):
        """On hills with falls every second, each of which lays another height field."""
        environment, random = started(id_), np.random.default_rng(0)
        path, states = self.folder / 'replay.html', []
        with replays.Replay(environment, path) as recording:

            def add():
                states.append(recording.add())

            environment.reset()
            while len(states) < 300:
                with rendering.calling_each_frame(environment, add):
                    action = random.uniform(-largest, largest, environment.action_spec().shape)
                    time_step = environment.step(action)
                if time_step.first():
                    add()
        self.assertLess(path.stat().st_size, 3e6)
        self.assertEqual(path.read_text(encoding='utf-8'), recording.html)

    def test_by_the_command(self):
        path = str(self.folder / 'dog.html')
        status, out, _ = run('rollout', DOG, '--steps', '5', '--html', path)
        self.assertEqual(status, 0)
        self.assertIn('dog.html', out)
        self.assertNotIn('viser', out)

    def test_in_a_notebook(self):
        """The replay is all that is shown: rich, with which viser prints, writes into outputs."""
        environment = suite.make(DOG, {'random': 1})
        with mock.patch.object(rich, '_console', rich.console.Console(record=True)) as console:
            recording = rendering.replay(environment, zero(environment), steps=3)
            self.assertEqual(console.export_text(), '')
            self.assertFalse(console.quiet)
        self.assertStartsWith(recording._repr_html_(), '<iframe srcdoc="&lt;!')

    @parameterized.parameters(
        ("unknown suffix '.mp4'; expected .html", 'goat.mp4', {}),
        ('no reference clip to show as a ghost', None, {'ghost': True}),
        ('fps is 0; expected a number above 0', None, {'fps': 0}),
        ('the replay has no states', 'goat.html', {}),
    )
    def test_invalid_arguments_of_a_replay_are_rejected(self, message, name, options):
        environment, path = started(GOAT), name and self.folder / name
        with (
            self.assertRaisesRegex(ValueError, message),
            replays.Replay(environment, path, **options),
        ):
            pass
        self.assert_only()


@pytest.mark.slow
@unittest.skipUnless(CHROMIUM, 'needs Chromium: apt install chromium')
class ChromiumTest(FolderTest):
    """In a real browser, without a screen."""

    def setUp(self):
        super().setUp()
        from playwright.sync_api import sync_playwright

        chromium = self.enterContext(sync_playwright()).chromium
        self.chromium = chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        self.addCleanup(self.chromium.close)
        self.messages = []

    def open(self, address, **options):
        """Opens a page of its own; what it complains about is kept."""
        context = self.chromium.new_context(viewport={'width': 640, 'height': 400}, **options)
        context.add_init_script(KEEP)
        page = context.new_page()
        page.set_default_timeout(PATIENCE)
        page.on('console', lambda message: self.messages.append((message.type, message.text)))
        page.on('pageerror', lambda error: self.messages.append(('error', str(error))))
        page.on('request', lambda request: self.messages.append(('request', request.url)))
        page.goto(address)
        page.wait_for_selector('canvas >> visible=true')
        return page

    def wait_for(self, condition, what):
        end = time.monotonic() + PATIENCE / 1000
        while not condition():
            self.assertLess(time.monotonic(), end, what)
            time.sleep(0.2)

    def picture(self, page):
        """Returns what WebGL has drawn."""
        image = page.evaluate(READ).partition(',')[2]
        return iio.imread(base64.b64decode(image))[..., :3].astype(int)

    def wait_until_drawn(self, page):
        """Waits for the ground, which fills the lower part: as long as it has one colour, nothing is."""

        def drawn():
            picture = self.picture(page)
            return picture[len(picture) // 2 :].std((0, 1)).max() > 10

        self.wait_for(drawn, 'nothing is drawn')
        return self.picture(page)

    def wait_until_it_moves(self, page, changes=3):
        """Waits for some changes: one alone may be of the light, which is loaded last."""
        last = self.wait_until_drawn(page)
        left = changes

        def moves():
            nonlocal last, left
            before, last = last, self.picture(page)
            if last.shape == before.shape:
                left -= (np.abs(last - before) > 20).mean() > 0.005
            return left <= 0

        self.wait_for(moves, 'the picture stays as it is')

    def assert_quiet(self, *allowed):
        self.assertEmpty([text for kind, text in self.messages if kind == 'error'])
        for kind, text in self.messages:
            if kind == 'request':
                self.assertStartsWith(text, ('data:', 'blob:', *allowed))

    def test_a_replay_without_a_network(self):
        environment = suite.make(DOG, {'random': 1})
        policy = suite.reference_policy(DOG)
        path = self.folder / 'dog.html'
        rendering.replay(environment, lambda step: policy(step.observation), path, steps=90)
        page = self.open(path.as_uri(), offline=True)
        self.wait_until_it_moves(page)
        self.assert_quiet('file:')

    def test_the_viewer(self):
        viewer = browser.Browser(DOG, port=0).start()
        self.addCleanup(viewer.stop)
        page = self.open(viewer.url)
        self.wait_until_it_moves(page)
        page.get_by_role('button', name='Pause').click()
        self.wait_for(lambda: not viewer.playing, 'it goes on')
        data = viewer.session.environment.physics.data
        before = data.time
        page.get_by_role('button', name='One frame').click()
        self.wait_for(lambda: data.time > before, 'there is no frame')
        page.get_by_role('button', name='Play').click()
        self.wait_for(lambda: viewer.playing, 'it does not go on')
        self.assert_quiet(viewer.url)
