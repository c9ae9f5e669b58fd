"""Files of runs in a folder or at a URL: whole, and of one moment."""

import pathlib
import tempfile
import time
from unittest import mock

import fsspec
import storage
from absl.testing import absltest, parameterized
from fsspec.implementations import local


class StorageTest(parameterized.TestCase):
    def setUp(self):
        super().setUp()
        self.folder = self.new()

    def new(self):
        return pathlib.Path(self.enterContext(tempfile.TemporaryDirectory()))

    def write(self, **contents):
        for name, content in contents.items():
            part = self.folder / f'.{name}.part'
            part.write_text(content)
            part.replace(self.folder / name.replace('_', '.'))

    def fetched(self, url):
        folder = self.new()
        storage.fetch(url, folder)
        return {path.name: path.read_text() for path in folder.iterdir()}

    @parameterized.parameters('memory://runs/a', '{}/runs/a')
    def test_files_come_back(self, url):
        url = url.format(self.new())
        self.assertEqual(self.fetched(url), {})
        self.write(curve_json='1', checkpoint_pt='1')
        storage.put(self.folder, url)
        self.write(curve_json='2', policy_npz='2')
        (self.folder / '.lock').write_text('not copied')
        storage.put(self.folder, url)
        expected = {'curve.json': '2', 'policy.npz': '2', 'checkpoint.pt': '1'}
        self.assertEqual(self.fetched(url), expected)
        system, path = fsspec.core.url_to_fs(url)
        self.assertLen(system.ls(path), 3)  # no unfinished ones
        storage.remove(url)
        self.assertEqual(self.fetched(url), {})
        storage.remove(url)

    @parameterized.parameters('memory://runs/b', '{}/runs/b')
    def test_subfolders_come_back(self, url):
        url = url.format(self.new())
        for name in ('run_1/checkpoint.pt', 'run_1/last.npz', 'run_1/.lock', 'curve.json'):
            (self.folder / 'run_1').mkdir(exist_ok=True)
            (self.folder / name).write_text(name)
        storage.put(self.folder, url)
        folder = self.new()
        storage.fetch(url, folder)
        found = {path.relative_to(folder).as_posix() for path in folder.rglob('*.*')}
        self.assertEqual(found, {'run_1/checkpoint.pt', 'run_1/last.npz', 'curve.json'})
        self.assertEqual((folder / 'run_1/last.npz').read_text(), 'run_1/last.npz')
        self.assertGreater(storage._written(folder), 0)
        storage.remove(url)

    def test_the_checkpoint_comes_last(self):
        """A machine that is lost between two files leaves what the old checkpoint needs."""
        self.write(checkpoint_pt='', curve_json='', policy_npz='')
        moved = []
        with mock.patch.object(local.LocalFileSystem, 'mv', lambda _, a, b: moved.append(b)):
            storage.put(self.folder, str(self.new()))
        self.assertLen(moved, 3)
        self.assertEndsWith(moved[-1], '/checkpoint.pt')

    def test_a_checkpoint_is_stored_while_training_goes_on(self):
        url = str(self.new())
        self.enterContext(mock.patch.object(storage, 'EVERY', 0.01))
        with self.assertRaises(KeyboardInterrupt), storage.kept(self.folder, url):
            self.write(curve_json='1')
            time.sleep(0.05)
            self.assertEqual(self.fetched(url), {})  # nothing to continue from
            self.write(checkpoint_pt='1')
            end = time.monotonic() + 30
            while len(found := self.fetched(url)) < 2 and time.monotonic() < end:
                time.sleep(0.01)
            self.assertEqual(found, {'curve.json': '1', 'checkpoint.pt': '1'})
            self.write(curve_json='2')
            raise KeyboardInterrupt
        self.folder = self.new()
        with storage.kept(self.folder, url):
            self.assertEqual((self.folder / 'curve.json').read_text(), '1')
            self.write(curve_json='3')
        self.assertEqual(self.fetched(url)['curve.json'], '3')


if __name__ == '__main__':
    absltest.main()
