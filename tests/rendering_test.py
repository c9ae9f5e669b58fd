"""Frames show the current state, files are complete or absent, errors name remedies."""

import contextlib
import functools
import io
import os
import pathlib
import signal
import subprocess
import sys
import textwrap
import time
from unittest import mock

import imageio.v3 as iio
import mujoco
import numpy as np
from absl.testing import parameterized
from dm_control import composer
from dm_control import mujoco as dm_mujoco
from helpers import FolderTest, besides_notices

from trl_suite import rendering, suite
from trl_suite import terrain as terrains
from trl_suite.rendering import cameras, drawing, overlays
from trl_suite.terrain import generators
from trl_suite.util import program

GAPS = 'PD_Biped2D_Gaps_Terrain-v0'
SMALL = {'height': 120, 'width': 160}


def make(id_=GAPS, seed=1, **task_kwargs):
    environment = suite.make(id_, {'random': seed, **task_kwargs})
    environment.reset()
    return environment


def drawn_ground(environment):
    """Boxes of the ground in the scene that a picture is made of: (x, half length, top) in m."""
    found = []

    def look(physics, scene):
        for geom in scene.geoms[: scene.ngeom]:
            is_geom = geom.objtype == mujoco.mjtObj.mjOBJ_GEOM
            if is_geom and physics.model.geom_bodyid[geom.objid] == 0 and geom.pos[2] > -30:
                found.append((geom.pos[0], geom.size[0], geom.pos[2] + geom.size[2]))

    rendering.frame(environment, **SMALL)  # makes the context
    environment.physics.render(camera_id='biped2d_full/side', scene_callback=look, **SMALL)
    return np.array(sorted(found))


class FrameTest(parameterized.TestCase):
    def test_cameras_by_short_and_full_name_and_number(self):
        """Frames are what `physics.render` draws; by default of the camera at the side."""
        environment = make()
        side, front = (rendering.frame(environment, camera=c, **SMALL) for c in ('side', 'front'))
        self.assertEqual((side.shape, side.dtype), ((120, 160, 3), np.uint8))
        direct = environment.physics.render(120, 160, 'biped2d_full/side')
        for image in (direct, rendering.frame(environment, **SMALL)):
            np.testing.assert_array_equal(image, side)
        self.assertGreater(np.mean(np.any(side != front, axis=2)), 0.1)
        for name, image in (('side', side), ('front', front)):
            full = f'biped2d_full/{name}'
            number = environment.physics.model.name2id(full, 'camera')
            for camera in (full, number):
                again = rendering.frame(environment, camera=camera, **SMALL)
                np.testing.assert_array_equal(again, image)

    def test_the_character_is_in_the_picture(self):
        # The camera follows the character: after half a second of walking it is still in the
        # middle, so it hides the sky there.
        environment = make('PD_Biped2D_LLC_Imitate_Flat-v0', start_phase=0.0)
        for _ in range(15):
            environment.step(environment.task.clip_action(0))
        self.assertGreater(environment.info['distance'], 0.3)
        image = rendering.frame(environment, **SMALL).astype(int)
        sky = image[:40].reshape(-1, 3).mean(0)
        middle = image[40:80, 30:100]
        self.assertGreater(np.mean(np.abs(middle - sky).sum(2) > 90), 0.05)


class CameraTest(parameterized.TestCase):
    """A camera that follows 3 m behind along y; a wall from y = -4 to -2, and a ball as character."""

    XML = """
    <mujoco><worldbody>
      <geom name="wall" type="box" pos="0 -3 0" size="1 1 1"/>
      <body><freejoint/><geom type="sphere" size=".2"/>
        <camera name="follows" mode="trackcom" pos="0 -3 0" xyaxes="1 0 0 0 0 1" fovy="40"/>
      </body>
    </worldbody></mujoco>"""

    def physics(self):
        physics = dm_mujoco.Physics.from_xml_string(self.XML)
        physics.forward()
        return physics

    def place(self, physics, at):
        return cameras.free_place(physics.model.ptr, physics.data.ptr, 1, np.array(at, float))

    @parameterized.parameters(
        ((0, -3, 0), -2 + cameras.MARGIN), ((0, -4.5, 0), -2 + cameras.MARGIN),  # in, closely behind
        *((at, at[1]) for at in ((0, -1, 0), (0, 3, 0), (0, -6, 0), (0, 0, 5))),  # open, far behind
    )  # fmt: skip
    def test_place_is_moved_in_front_of_a_wall(self, at, y):
        found = self.place(self.physics(), at)
        np.testing.assert_allclose(found, (at[0], y, at[2]), atol=1e-3)

    def test_place_is_not_closer_than_the_smallest_distance(self):
        physics = self.physics()
        physics.data.qpos[1] = -1.7
        physics.forward()
        expected = [0, -1.7 - cameras.NEAREST, 0]
        np.testing.assert_allclose(self.place(physics, [0, -3, 0]), expected, atol=1e-3)

    def test_character_keeps_its_size_in_the_picture(self):
        physics = self.physics()
        angle = physics.model.ptr.cam_fovy
        with cameras.outside_obstacles(physics, 0):
            place = physics.data.cam_xpos[0].copy()
            half = -place[1] * np.tan(np.deg2rad(angle[0]) / 2)
        np.testing.assert_allclose(place, [0, -2 + cameras.MARGIN, 0], atol=1e-3)
        self.assertAlmostEqual(half, 3 * np.tan(np.deg2rad(20)), places=6)
        self.assertEqual(angle[0], 40)
        np.testing.assert_array_equal(physics.data.cam_xpos[0], [0, -3, 0])

    def test_cameras_of_frames_are_in_no_block(self):
        environment = suite.make('PD_Biped3D_HLC_LargeBlocks-v0', task_kwargs={'random': 3})
        environment.reset()
        physics, seen = environment.physics, []
        camera = rendering.drawing.check_options(physics.model.ptr, environment.task, camera='back')

        def render(*arguments, **options):
            seen.extend(physics.data.cam_xpos[camera])

        with (
            mock.patch.object(cameras, 'free_place', return_value=np.array([1.0, 2.0, 3.0])),
            mock.patch.object(physics, 'render', render),
        ):
            rendering.frame(environment, 48, 64, 'back')
        self.assertEqual(seen, [1.0, 2.0, 3.0])


class GhostTest(parameterized.TestCase):
    @parameterized.parameters(GAPS, 'PD_Raptor2D_Steps_Terrain-v0', 'PD_Dog2D_Slopes_Terrain-v0')
    def test_stands_in_the_pose_of_the_reference(self, id_):
        # At the start the character is in the reference's pose, lifted clear of the ground.
        environment = make(id_)
        model = environment.physics.model
        lift = environment.physics.data.qpos[1] - environment.task.reference_pose(0)[1]
        self.assertBetween(lift, -1e-9, 0.05)  # the phase of the reference is rounded
        shown = {}

        def look(physics, scene):
            before = scene.ngeom
            overlays.ghost(environment.task)(physics, scene)
            for geom in scene.geoms[before : scene.ngeom]:
                shown[geom.objid] = np.array(geom.pos), np.array(geom.rgba)

        rendering.frame(environment, **SMALL)  # makes the context
        environment.physics.render(scene_callback=look, **SMALL)
        moves = model.body_weldid[model.geom_bodyid] != 0
        self.assertCountEqual(shown, np.flatnonzero(moves & (model.geom_group == 0)))
        for i, (position, colour) in shown.items():
            beside = np.array([0, overlays.GHOST_BEHIND, -lift])
            character = environment.physics.data.geom_xpos[i]
            np.testing.assert_allclose(position, character + beside, atol=1e-5)
            self.assertLess(colour[3], 1)

    def test_changes_the_picture_and_neither_model_nor_simulation(self):
        seen, unseen = make(seed=4), make(seed=4)
        plain, ghost = (rendering.frame(seen, ghost=ghost, **SMALL) for ghost in (False, True))
        self.assertBetween(np.mean(np.any(plain != ghost, axis=2)), 0.005, 0.5)
        model = seen.physics.model.ptr
        names = 'geom_pos', 'geom_size', 'geom_rgba', 'qpos0', 'body_mass'
        before = {name: np.array(getattr(model, name)) for name in names}
        for i in range(20):
            action = np.full(11, 0.2 * np.sin(i))
            a, b = seen.step(action), unseen.step(action)
            rendering.frame(seen, ghost=True, **SMALL)
            for name, value in a.observation.items():
                np.testing.assert_array_equal(value, b.observation[name])
        for name, value in before.items():
            np.testing.assert_array_equal(value, getattr(model, name))
        np.testing.assert_array_equal(seen.get_state()['world'], unseen.get_state()['world'])


class TerrainIsCurrentTest(parameterized.TestCase):
    def assert_drawn_around(self, environment, x):
        ground, strip = drawn_ground(environment), environment.task.arena.grounds[0]
        for centre, _, top in ground:
            np.testing.assert_allclose(top, strip.height(centre), atol=1e-4)
        left, right = ground[:, 0] - ground[:, 1], ground[:, 0] + ground[:, 1]
        self.assertLess(left[0], x - 2)
        self.assertGreater(right[-1], x + 10)
        np.testing.assert_allclose(left[1:], right[:-1], atol=1e-4)  # without holes

    def test_after_resets(self):
        environment = make()
        seen = []
        for _ in range(2):
            self.assert_drawn_around(environment, 0)
            picture = rendering.frame(environment, camera='front', **SMALL)
            seen.append((picture, drawn_ground(environment)))
            environment.reset()
        for one, other in zip(*seen, strict=True):
            self.assertFalse(np.array_equal(one, other))

    def test_after_the_ground_was_extended(self):
        environment = make()
        rendering.frame(environment, **SMALL)  # contexts exist before the ground changes
        world = environment.task.world
        world.qpos[0, 0] += 40.0
        world.qpos[0, 1] += 3.0
        world.forward(world.all_ids)
        environment.step(np.zeros(11))
        self.assert_drawn_around(environment, 40)

    def test_after_set_state(self):
        environment, other = make(seed=1), make(seed=2)
        picture = rendering.frame(environment, camera='front', **SMALL)
        self.assertFalse(np.array_equal(rendering.frame(other, camera='front', **SMALL), picture))
        other.set_state(environment.get_state())
        np.testing.assert_array_equal(rendering.frame(other, camera='front', **SMALL), picture)


def numbered(count, height=32, width=48):
    return [np.full((height, width, 3), 10 * i, np.uint8) for i in range(count)]


class VideoTest(FolderTest):
    @parameterized.parameters(
        ('a.mp4', 32, 48), ('a.gif', 32, 48), ('a.gif', 33, 47),
        # With a meaning for ffmpeg, or in capitals.
        ('12:30.mp4', 32, 48), ('-a%d.MP4', 32, 48), ('http:a.GIF', 32, 48),
    )  # fmt: skip
    def test_frames_come_back(self, name, *size):
        path = self.folder / name
        rendering.video(iter(numbered(12, *size)), str(path), fps=20)
        self.assert_only(name)
        plugin = {'plugin': 'FFMPEG'} if path.suffix.lower() == '.mp4' else {}
        frames, meta = iio.imread(path, **plugin), iio.immeta(path, **plugin)
        self.assertEqual(frames.shape, (12, *size, 3))
        np.testing.assert_allclose(frames.mean((1, 2, 3)), 10 * np.arange(12), atol=4)
        if plugin:
            self.assertEqual((meta['fps'], meta['codec'], meta['size']), (20.0, 'h264', (48, 32)))
        else:
            self.assertEqual(meta['duration'], 50)

    def test_progress(self):
        """Who waits for longer than a second sees how many pictures there are."""

        def slowly():
            for i, image in enumerate(numbered(2)):
                time.sleep(1.1 * i)
                yield image

        with contextlib.redirect_stderr(io.StringIO()) as shown:
            rendering.video(numbered(3), self.folder / 'a.gif')
            self.assertEqual(shown.getvalue(), '')
            shown.isatty = lambda: True
            rendering.video(slowly(), self.folder / 'a.gif')
        self.assertRegex(shown.getvalue(), r'\d+picture ')

    def test_an_interrupt_while_the_encoder_starts(self):
        started = []

        def start(*args, **kwargs):
            started.append(popen(*args, **kwargs))
            os.kill(os.getpid(), signal.SIGINT)
            return started[-1]

        popen = subprocess.Popen
        before = signal.signal(signal.SIGINT, signal.default_int_handler)
        self.addCleanup(signal.signal, signal.SIGINT, before)
        with (
            mock.patch.object(subprocess, 'Popen', start),
            self.assertRaises(KeyboardInterrupt),
        ):
            rendering.video(numbered(3), self.folder / 'a.mp4')
        self.assertIsNotNone(started[0].poll())  # it has ended, and cannot create the file later
        self.assert_only()

    @parameterized.parameters('a.mp4', 'a.gif')
    def test_an_error_keeps_the_old_file(self, name):
        path = self.folder / name
        path.write_text('old')

        def frames():
            yield from numbered(3)
            raise KeyboardInterrupt

        with self.assertRaises(KeyboardInterrupt):
            rendering.video(frames(), path)
        self.assertEqual(path.read_text(), 'old')
        self.assert_only(name)

    @parameterized.parameters(signal.SIGINT, signal.SIGTERM)
    def test_a_signal_waits_for_the_context(self, number):
        """Half of one would print a traceback when it is freed."""

        class Physics:
            made = False

            @property
            def contexts(self):
                signal.raise_signal(number)
                self.made = True

        physics = Physics()
        with self.assertRaises(KeyboardInterrupt), program.terminable():
            drawing.check_gl(physics)
        self.assertTrue(physics.made)

    def test_an_encoder_that_ends_says_why(self):
        with (
            self.assertRaisesRegex(OSError, 'a.mp4: the encoder failed: .*(directory|Permission)'),
            rendering.Video(self.folder / 'a.mp4') as video,
        ):
            video._part = self.folder / 'no' / 'a.mp4'
            for image in 50 * numbered(4, 320, 480):
                video.add(image)
        self.assert_only()

    def test_a_folder_that_cannot_be_written(self):
        with (
            mock.patch.object(pathlib.Path, 'touch', side_effect=PermissionError),
            self.assertRaisesRegex(PermissionError, "a.gif: the folder '.*' cannot be written"),
        ):
            rendering.video(numbered(2), self.folder / 'a.gif')


class FilmStripTest(FolderTest):
    @parameterized.parameters((11, 6), (10, 4), (3, 8), (5, 1), (1, 8))
    def test_evenly_spaced_with_both_ends(self, count, columns):
        path = self.folder / 'strip.png'
        strip = rendering.film_strip(iter(numbered(count)), path, columns)
        pitch = 48 + rendering.STRIP_MARGIN
        shown = strip[0, ::pitch, 0] // 10
        self.assertLen(shown, min(count, columns))
        self.assertEqual(strip.shape, (32, pitch * len(shown) - rendering.STRIP_MARGIN, 3))
        self.assertEqual(shown[0], 0)
        if len(shown) > 1:
            self.assertEqual(shown[-1], count - 1)
            gaps = np.diff(shown.astype(int))
            self.assertLessEqual(gaps.max() - gaps.min(), 1)
        np.testing.assert_array_equal(iio.imread(path), strip)
        self.assert_only('strip.png')

    def test_a_path_is_refused_before_frames_are_drawn(self):
        with self.assertRaisesRegex(ValueError, 'expected .png'):
            rendering.film_strip(iter([1]), 'a.jpg')  # 1 is no picture


class SpatialTest(FolderTest):
    """What is drawn in three dimensions; footsteps_test has the markers."""

    def test_moving_boxes_have_no_ghosts(self):
        environment = suite.build(
            'biped3d_mocap', terrain='dynamic_obstacles3d', task_kwargs={'random': 1}
        )
        environment.reset()
        colours = []
        ghost = overlays.ghost(environment.task)

        def look(physics, scene):
            before = scene.ngeom
            ghost(physics, scene)
            model = physics.model.ptr
            for geom in scene.geoms[before : scene.ngeom]:
                name = model.body(model.geom_bodyid[geom.objid]).name
                colours.append((name.startswith('mover'), float(geom.rgba[3])))

        environment.physics.render(48, 64, scene_callback=look)
        self.assertEqual({alpha for mover, alpha in colours if mover}, {0.0})
        shown = {round(alpha, 6) for mover, alpha in colours if not mover}
        self.assertEqual(shown, {overlays.GHOST_COLOUR[3]})

    @parameterized.parameters(('steps3d', 10, 1), ('gaps', 20, 0))  # beside, below each other
    def test_pictures_of_terrain_depend_on_the_seed(self, terrain, length, axis):
        for name, options in (('a', {}), ('b', {}), ('c', {'seed': 1}), ('d', {'draws': 1})):
            path, options = self.folder / f'{name}.png', {'draws': 2, **options}
            rendering.plot_terrain(terrain, path, length=length, **options)
        a, b, c, d = (iio.imread(self.folder / f'{name}.png') for name in 'abcd')
        np.testing.assert_array_equal(a, b)
        self.assertFalse(np.array_equal(a, c))
        self.assertGreater(a.shape[axis], d.shape[axis])
        for preset in ('plane', 'conveyor3d'):  # level ground
            rendering.plot_terrain(preset, self.folder / 'e.png', draws=1, length=8)
        self.assert_only('a.png', 'b.png', 'c.png', 'd.png', 'e.png')

    def test_a_map_shows_no_height_where_there_is_no_ground(self):
        self.enterContext(mock.patch.dict(generators._spatial))
        block = terrains.boxes([(0, 0)], (2, 2), top=0.5)
        terrains.register3d('island3d')(
            lambda parameters, rng: terrains.Layout(level=None, boxes=block)
        )
        with (
            mock.patch('matplotlib.axes.Axes.imshow', side_effect=ValueError('drawn')) as drawn,
            self.assertRaisesRegex(ValueError, 'drawn'),
        ):
            rendering.plot_terrain({'Type': 'island3d'}, self.folder / 'a.png', draws=1, length=8)
        heights = drawn.call_args.args[0]
        self.assertEqual(set(heights[np.isfinite(heights)]), {0.5})
        self.assertBetween(np.isnan(heights).mean(), 0.6, 0.8)


@functools.cache
def task_of_its_own():
    return composer.Environment(composer.NullTask(composer.Arena()))


def frame(message, **options):
    return lambda _: rendering.frame(make(), **{**SMALL, **options}), message


def video(message, name, frames, **options):
    return lambda folder: rendering.video(frames, folder / name, **options), message


def strip(message, frames, name='a.png', **options):
    return lambda folder: rendering.film_strip(frames, folder / name, **options), message


def plot(message, terrain='gaps', **options):
    return lambda folder: rendering.plot_terrain(terrain, folder / 'a.png', **options), message


class ErrorsTest(FolderTest):
    @parameterized.parameters(
        frame("unknown camera 'sid'; did you mean 'side'", camera='sid'),
        frame(r'camera is 2; expected -1 to 1', camera=2),
        frame(r'camera is -2', camera=-2),
        frame('camera is None; expected a string or a whole number', camera=None),
        frame('height is 0; expected a whole number from 1 to 1080, in pixels', height=0),
        frame('width is 1921; expected a whole number from 1 to 1920, in pixels', width=1921),
        frame("ghost is 'no'; expected True or False", ghost='no'),
        (lambda _: rendering.frame(task_of_its_own(), 48, 64, camera=-1, ghost=True),
         'the task NullTask has no reference clip'),
        video("unknown suffix '.avi'; expected .mp4 or .gif", 'a.avi', numbered(2)),
        video('no frames were given', 'a.mp4', []),
        video('frames are 48x33 pixels; h264 needs even', 'a.mp4', numbered(2, height=33)),
        video(r'shape \(16, 48, 3\)', 'a.gif', [*numbered(1), *numbered(1, 16)]),
        video('float64; expected', 'a.gif', [np.zeros((8, 8, 3))]),
        video(r'shape \(8, 8\)', 'a.gif', [np.zeros((8, 8), np.uint8)]),
        video('fps is 0', 'a.mp4', numbered(2), fps=0),
        video('fps is 200; expected a number above 0 and at most 100', 'a.gif', numbered(2), fps=200),
        video('the folder .* does not exist', 'no/a.mp4', numbered(2)),
        *((lambda _, n=n: next(rendering.frames(task_of_its_own(), None, n)), f'steps is {n}; expected a whole number')
          for n in (-1, 2.5)),
        strip('at least one frame', []),
        strip('columns is 0', numbered(2), columns=0),
        strip('the same size', [*numbered(1), *numbered(1, 16)]),
        strip("suffix '.jpg'; expected .png", numbered(2), 'a.jpg'),
        plot("unknown terrain 'gasp'; did you mean 'gaps'", 'gasp'),
        plot('draws is 0', draws=0),
        plot('length is nan', length=float('nan')),
        plot('length is -3.0', length=-3.0),
        plot('length is 301; expected a number above 0 and at most 300, in m', 'plane', length=301),
        plot('seed is -1', seed=-1),
        plot('terrain_level is .*; expected a number', terrain_level=float('nan')),
    )  # fmt: skip
    def test_errors_leave_no_files(self, call, message):
        with self.assertRaisesRegex((ValueError, FileNotFoundError), message):
            call(self.folder)
        self.assert_only()
        self.assertEqual(rendering.frame(task_of_its_own(), 48, 64, camera=-1).shape, (48, 64, 3))


DM_CONTROL_FIRST = 'from dm_control import composer'  # it chooses GLFW
NO_EGL = 'import ctypes.util; ctypes.util.find_library = lambda name: None'
NO_DRIVER = {'__EGL_VENDOR_LIBRARY_DIRS': '/nowhere'}
# For programs in child processes.
PICTURES = f"""
import gc, os, signal, threading
from concurrent.futures import ThreadPoolExecutor
from unittest import mock
import mujoco
import numpy as np
from dm_control import mujoco as dm_mujoco

dm = dm_mujoco.Physics.from_xml_string(
    '<mujoco><worldbody><light pos="0 0 3"/><geom size=".3"/></worldbody></mujoco>')
# Before trl_suite.
from trl_suite import rendering, suite

def make(id_={GAPS!r}):
    environment = suite.make(id_, {{'random': 1}})
    environment.reset()
    return environment

def elsewhere(function):
    found = []
    thread = threading.Thread(target=lambda: found.append(function()))
    thread.start()
    thread.join()
    return found[0]

def picture():
    return rendering.frame(one, height=48, width=64)

def direct(camera_id=0, **options):
    return one.physics.render(48, 64, camera_id=camera_id, **options)

def same(*pictures):
    return pictures[0].std() > 10 and all((each == pictures[0]).all() for each in pictures)
"""


def run_headless(program, variables):
    gl = ('DISPLAY', 'WAYLAND_DISPLAY', 'MUJOCO_GL', 'PYOPENGL_PLATFORM')
    rest = {name: value for name, value in os.environ.items() if name not in gl}
    done = subprocess.run(
        [sys.executable, '-W', 'ignore', '-c', program], capture_output=True, text=True,
        env={**rest, 'NUMBA_DISABLE_JIT': '1', **variables}, timeout=60, check=False,
    )  # fmt: skip
    done.stderr = besides_notices(done.stderr)
    return done


class ThreadTest(parameterized.TestCase):
    """An environment may be drawn, closed and freed in any thread; nothing is printed."""

    @parameterized.named_parameters(
        ('one_after_the_other', """
            PARTS = [
                'same(elsewhere(picture), picture(), elsewhere(picture))',
                'same(elsewhere(direct), direct(), elsewhere(direct))',
                'picture() is not None and elsewhere(one.close) is None',
                'elsewhere(picture) is not None and elsewhere(one.close) is None',
                'picture() is not None and forget() and elsewhere(gc.collect) > 0',
                'same(*pool(), picture())',
                'same(direct(), direct(overlays=[Free()]), direct())',
                'uploaded()',
            ]

            def forget():
                global one
                one.cycle = one
                one = None
                return True

            def pool():
                environments = [make() for _ in range(4)]
                def look(environment):
                    return rendering.frame(environment, 48, 64)
                with ThreadPoolExecutor(3) as pool:
                    pictures = [each for _ in range(3) for each in pool.map(look, environments)]
                    list(pool.map(lambda each: each.close(), environments))
                return pictures

            class Free:  # another context, while one is in use
                def __init__(self):
                    self.two = make()
                    rendering.frame(self.two)
                def draw(self, context, rect):
                    self.two.close()

            def uploaded():  # a height field
                global one
                one = make('PD_Biped3D_Imitate-Hills-v0')
                assert one.physics.model.nhfield
                elsewhere(picture)
                one.reset()
                return same(picture(), elsewhere(picture))

            for part in PARTS:
                one = make()
                assert eval(part), part
            print(True)
            """),
        ('at_exit_in_a_living_thread', """
            drawn = threading.Event()
            def stay():
                picture()
                drawn.set()
                threading.Event().wait()
            threading.Thread(target=stay, daemon=True).start()
            print(drawn.wait(50))
            """),
        ('between_those_of_dm_control', 'print(same(dm.render(), (picture(), dm.render())[1]))'),
        ('half_a_context', """
            with mock.patch('mujoco.MjrContext', side_effect=mujoco.FatalError('no memory')):
                for draw in picture, direct, picture:
                    try:
                        draw()
                    except RuntimeError as error:
                        assert str(error).startswith('cannot render: '), error
                        assert 'no memory' in str(error), error
            gc.collect()
            print(same(picture(), elsewhere(picture)))
            """),
        ('forked', """
            one = make('PD_Biped3D_Imitate-Hills-v0')
            picture()
            child = os.fork()
            if child == 0:
                signal.alarm(50)
                one.reset()
                for each in one, make():
                    try:
                        each.physics.render(48, 64)
                    except RuntimeError as error:
                        assert 'cannot render after a fork' in str(error), error
                    else:
                        raise AssertionError('it renders')
                one.close()
                one = each = None
                gc.collect()
                raise SystemExit
            print(os.waitpid(child, 0)[1] == 0 and same(picture()))
            """),
    )  # fmt: skip
    def test_any_thread(self, program):
        if 'fork' in program and not hasattr(os, 'fork'):
            self.skipTest('no fork here')
        first = 'dm.render()' if 'dm.' in program else ''
        begin = PICTURES.replace('# Before trl_suite.', first)
        code = f'{begin}\none = make()\n{textwrap.dedent(program)}'
        done = run_headless(code, {'MUJOCO_GL': 'egl'})
        self.assertEqual((done.returncode, done.stderr, done.stdout), (0, '', 'True\n'))


class MissingPartsTest(FolderTest):
    @parameterized.parameters(
        ('PIL.Image', lambda path: rendering.video(numbered(2), path / 'a.gif')),
        ('imageio_ffmpeg', lambda path: rendering.video(numbered(2), path / 'a.mp4')),
        ('PIL.Image', lambda path: rendering.film_strip(numbered(2), path / 'a.png')),
        ('matplotlib.figure', lambda path: rendering.plot_terrain('gaps', path / 'a.png')),
    )
    def test_the_extra_is_named(self, module, draw):
        with (
            mock.patch.dict(sys.modules, {module: None}),
            self.assertRaisesRegex(ImportError, r"pip install 'trl_suite\[video\]'"),
        ):
            draw(self.folder)
        self.assert_only()

    def test_without_opengl(self):
        program = f"""
import numpy as np
from trl_suite import rendering, suite
environment = suite.make({GAPS!r})
environment.reset()
environment.step(np.zeros(11))
try:
    rendering.frame(environment)
except RuntimeError as error:
    print(error)
"""
        for setting in ('disable', 'glfw'):
            with self.subTest(setting):
                done = run_headless(program, {'MUJOCO_GL': setting})
                self.assertEqual((done.returncode, done.stderr), (0, ''))
                self.assertRegex(done.stdout, f'^cannot render.*MUJOCO_GL is {setting!r}')
                self.assertRegex(done.stdout, 'egl or osmesa .* glfw .*\n$')
                self.assertEqual(done.stdout.count('\n'), 1)

    @parameterized.parameters(
        (DM_CONTROL_FIRST, {}, 'True'),
        (NO_EGL, {}, 'cannot render: .* MUJOCO_GL is not set'),
        (f'{DM_CONTROL_FIRST}; {NO_EGL}', {}, 'cannot render: .* MUJOCO_GL is not set'),
        ('', NO_DRIVER, 'cannot render: .* MUJOCO_GL is not set'),
        (DM_CONTROL_FIRST, NO_DRIVER, 'cannot render: .* MUJOCO_GL is not set'),
        ('', {'PYOPENGL_PLATFORM': 'osmesa'}, 'cannot render: .* MUJOCO_GL is not set'),
    )
    def test_without_a_display(self, first, variables, expected):
        program = f"""
{first}
from trl_suite import rendering, suite
environment = suite.make({GAPS!r})
environment.reset()
draw = environment.physics.render, lambda: rendering.frame(environment)
for each in 2 * draw:
    try:
        print(each().std() > 10)
    except RuntimeError as error:
        print(error)
"""
        done = run_headless(program, variables)
        self.assertEqual((done.returncode, done.stderr), (0, ''))
        lines = done.stdout.splitlines()
        self.assertLen(lines, 4)
        for line in lines:
            self.assertRegex(line, expected)
