"""Files of runs in a folder or at a URL: whole, and of one moment."""

import pathlib
import tempfile
import time
from unittest import mock

import fsspec
import storage
from absl.testing import parameterized
from fsspec.implementations import local
from helpers import FolderTest


class StorageTest(FolderTest):
    def setUp(self):
        super().setUp()
        self.place, self.folder = self.folder, self.new()

    def new(self):
        return pathlib.Path(tempfile.mkdtemp(dir=getattr(self, 'place', self.folder)))

    def write(self, **contents):
        for name, content in contents.items():
            part = self.folder / f'.{name}.part'
            part.write_text(content)
            part.replace(self.folder / name.replace('_', '.'))

    def fetched(self, url):
        folder = self.new()
        storage.fetch(url, folder)
        found = (path for path in folder.rglob('*') if path.is_file())
        return {path.relative_to(folder).as_posix(): path.read_text() for path in found}

    @parameterized.parameters('memory://runs/a', '{}/runs/a')
    def test_files_come_back(self, url):
        url = url.format(self.new())
        self.assertEqual(self.fetched(url), {})
        self.write(curve_json='1', checkpoint_pt='1')
        storage.put(self.folder, url)
        self.write(curve_json='2', policy_npz='2')
        (self.folder / 'run_1').mkdir()
        for name in ('.lock', 'run_1/.lock', 'run_1/last.npz'):
            (self.folder / name).write_text('')
        storage.put(self.folder, url)  # no locks
        expected = {'curve.json': '2', 'policy.npz': '2', 'checkpoint.pt': '1'}
        expected['run_1/last.npz'] = ''
        self.assertEqual(self.fetched(url), expected)
        system, path = fsspec.core.url_to_fs(url)
        self.assertLen(system.find(path), 4)  # no unfinished ones
        storage.remove(url)
        self.assertEqual(self.fetched(url), {})
        storage.remove(url)
        system.makedirs(path, exist_ok=True)
        system.pipe_file(f'{path}/thesis.tex', b'')
        with self.assertRaisesRegex(FileExistsError, 'is not the folder of a run'):
            storage.remove(url)
        self.assertLen(system.find(path), 1)

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
            (self.folder / 'run_1').mkdir()
            (self.folder / '.part').write_text('1')
            (self.folder / '.part').replace(self.folder / 'run_1/checkpoint.pt')
            end = time.monotonic() + 30
            while len(found := self.fetched(url)) < 2 and time.monotonic() < end:
                time.sleep(0.01)
            self.assertEqual(found, {'curve.json': '1', 'run_1/checkpoint.pt': '1'})
            self.write(curve_json='2')
            raise KeyboardInterrupt
        self.folder = self.new()
        with storage.kept(self.folder, url):
            self.assertEqual((self.folder / 'curve.json').read_text(), '1')
            self.write(curve_json='3')
        self.assertEqual(self.fetched(url)['curve.json'], '3')
