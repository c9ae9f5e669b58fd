"""What would take all memory, or for ever, is refused by name before it begins."""

import pathlib
import tempfile
import tracemalloc
import zipfile

import imageio.v3 as iio
import numpy as np
from absl.testing import absltest, parameterized
from PIL import Image

from trl_suite import motion, policies, rendering, retargeting, suite, terrain
from trl_suite.vector import VectorEnvironment

IDS = (
    'PD_Biped2D_Gaps_Terrain-v0', 'PD_Biped3D_Imitate-v0', 'FSM_Dog2D_Terrain_Slopes-v0',
)  # fmt: skip


class LimitsTest(parameterized.TestCase):
    def setUp(self):
        super().setUp()
        self.folder = pathlib.Path(self.enterContext(tempfile.TemporaryDirectory()))

    @parameterized.parameters(
        *((lambda id_=id_, **options: suite.make(id_, options), 'substeps') for id_ in IDS),
        (lambda **options: suite.build('dog', task='walk', task_kwargs=options), 'substeps'),
        (lambda **options: suite.make(IDS[0], options), 'terrain_observation'),
        (lambda **options: VectorEnvironment(IDS[0], **options), 'num_envs'),
        (lambda **options: rendering.plot_terrain('gaps', 'a.png', **options), 'draws'),
    )  # fmt: skip
    def test_numbers(self, make, name):
        for value in (10**9, 2**32, 1e300, float('inf')):
            with self.assertRaisesRegex(ValueError, rf'^{name} is .*; expected a (whole )?number'):
                make(**{name: value})

    @parameterized.parameters(motion.load, motion.load_steps, policies.load)
    def test_an_archive_that_inflates(self, load):
        path = self.folder / 'bomb.npz'
        with (
            zipfile.ZipFile(path, 'w', zipfile.ZIP_DEFLATED) as archive,
            archive.open('poses.npy', 'w') as file,
        ):
            for _ in range(300):
                file.write(bytes(10**6))
        self.assertLess(path.stat().st_size, 10**6)
        tracemalloc.start()
        with self.assertRaisesRegex(
            ValueError, r'bomb.npz: .*has 300 MB; expected no more than 268'
        ):
            load(path)
        most = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        self.assertLess(most, 5e6)

    @parameterized.parameters(
        ('a.json', lambda path: motion.read_terrainrl(path, ('hip',), (1,), 'planar'), 268),
        ('a.bvh', lambda path: motion.read_bvh(path), 268),
        ('a.stl', lambda path: terrain.from_mesh(path), 1000),
        ('a.npz', lambda path: policies.load(path), 268),
    )
    def test_a_file_that_is_too_large(self, name, load, most):
        path = self.folder / name
        with path.open('wb') as file:
            file.truncate(3 * 10**9)  # takes no room on the disk
        with self.assertRaisesRegex(ValueError, f'{name}: .*has 3000 MB; .* more than {most} MB'):
            load(path)

    def test_the_format_is_told_by_the_beginning(self):
        path = self.folder / 'a.txt'
        with path.open('wb') as file:
            file.write(b'{"Loop": true}')
            file.truncate(3 * 10**9)
        with self.assertRaisesRegex(ValueError, 'a.txt: has 3000 MB'):
            retargeting.read(path, 'dog')

    def test_a_picture_of_too_many_pixels(self):
        path = self.folder / 'a.png'
        iio.imwrite(path, np.zeros((4000, 2600), np.uint8))
        tracemalloc.start()
        with self.assertRaisesRegex(ValueError, '4000 x 2600 pixels; expected no more than 1e'):
            terrain.from_image(path, 0.1)
        most = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        self.assertLess(most, 5e6)  # it was not read

    def test_of_an_animated_picture_the_first_frame_is_read(self):
        """The number of frames would be no bound of their size."""
        low, high = (Image.fromarray(np.full((5, 5), grey, np.uint8)) for grey in (0, 255))
        low.save(self.folder / 'a.png', save_all=True, append_images=[high, high])
        ground = terrain.SpatialGround(terrain.from_image(self.folder / 'a.png', 0.1), 0)
        self.assertEqual(float(ground.height(0, 0)), 0.0)


if __name__ == '__main__':
    absltest.main()
