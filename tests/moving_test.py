"""Moving pictures: what is in view, and the files."""

import pathlib
import sys

import numpy as np
from absl.testing import parameterized
from helpers import FolderTest
from PIL import Image

from trl_suite import suite
from trl_suite.environments import named_policies
from trl_suite.rendering.web_scene import root_body

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[1] / 'docs'))
import gallery
import moving

DOG, GOAT = 'PD_Dog2D_Slopes_Mixed_Terrain-v0', 'FSM_Goat2D_Terrain_Variable_Steps-v0'
FOREST = 'PD_Biped3D_HLC_Forest-v0'
SIZE = (90, 144)
SECONDS = 0.4


def shot_of(id_, seconds=SECONDS):
    environment = suite.make(id_)
    _, policy = named_policies.best(environment, id_)
    return environment, moving._take(environment, policy, 1, 0.0, seconds)


class MovingTest(FolderTest):
    @parameterized.parameters(DOG, GOAT)
    def test_states_are_a_thirtieth_of_a_second_apart(self, id_):
        environment, shot = shot_of(id_)
        self.assertLen(shot.states, round(SECONDS / moving.FRAME) + 1)
        times = []
        for state, root in zip(shot.states, shot.root, strict=True):
            environment.set_state(state)
            times.append(environment.physics.data.time)
            found = environment.physics.data.xpos[root_body(environment)]
            np.testing.assert_allclose(found, root, atol=1e-12)
        np.testing.assert_allclose(np.diff(times), moving.FRAME, atol=1e-3)

    def test_no_obstacle_hides_the_character(self):
        environment, shot = shot_of(FOREST, 1.0)
        environment.set_state(shot.states[0])
        root = shot.root[0]
        boxes = environment.task.arena.surroundings.boxes[0].position
        nearest = np.argmin(np.linalg.norm(boxes - root[:2], axis=1))
        beyond = np.append(root[:2] + 3 * (boxes[nearest] - root[:2]), root[2])
        self.assertGreater(moving._hidden(environment, beyond), 0.9)
        view = moving._free_view(environment, shot, shot.root, distance=4.0)
        azimuth, elevation = np.deg2rad(view)
        level = np.array([np.cos(azimuth), np.sin(azimuth)]) * np.cos(elevation)
        eye = root - 4 * np.append(level, np.sin(elevation))
        self.assertLess(moving._hidden(environment, eye), 0.2)

    def test_pictures(self):
        images = moving.moving_picture(FOREST, SECONDS, SIZE)
        self.assertLen(images, 7)
        self.assertEqual(images[0].shape, (*SIZE, 3))
        self.assertGreater(np.abs(np.diff(np.array(images, int), axis=0)).max(), 50)
        path = self.folder / 'a.webp'
        gallery.save(images, path, 'digest')
        self.assertEqual(gallery._source(path), 'digest')
        with Image.open(path) as saved:
            self.assertEqual((saved.n_frames, saved.info['loop']), (7, 0))
            self.assertEqual(saved.size, SIZE[::-1])
            saved.seek(1)
            saved.load()
            self.assertEqual(saved.info['duration'], 67)

    def test_refusals(self):
        with self.assertRaisesRegex(ValueError, 'an animated picture needs at least one picture'):
            moving.save([], self.folder / 'a.webp')
        with self.assertRaisesRegex(ValueError, "unknown suffix '.gif'; expected .webp"):
            moving.save([np.zeros((9, 9, 3), np.uint8)], self.folder / 'a.gif')
