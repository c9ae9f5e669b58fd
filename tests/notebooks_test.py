"""The notebooks in colab/: whole, with outputs, naming what exists; and run again (slow)."""

import ast
import importlib
import importlib.util
import json
import pathlib
import re
import shlex
import sys
import types
from unittest import mock

import pytest
from absl.testing import parameterized

from trl_suite import terrain
from trl_suite.registry import catalogue

ROOT = pathlib.Path(__file__).resolve().parents[1]
FOLDER = ROOT / 'colab'
NAMES = (
    'first_steps', 'train_a_biped', 'terrain', 'own_character', 'hierarchical_soccer',
    'continual_learning',
)  # fmt: skip
LARGEST = 600e3  # bytes
EXTRAS = {'trl_suite.adapters.stable_baselines': 'stable_baselines3'}  # what a module needs
_ID = re.compile(r'\b\w[\w-]*-v0\b')
_FILE = re.compile(r'\b(?:docs|examples|trained|training)/[\w/]+\.\w+')
_LINK = re.compile(r'\]\((?!https?:|#)([^)#]+)')
_ABSOLUTE = re.compile(r'(?<![\w/.:])/\w+/\w')
_MAGIC = re.compile(r'^(\s*)[%!].*$', re.MULTILINE)


def read(name):
    return json.loads((FOLDER / f'{name}.ipynb').read_text(encoding='utf-8'))


def text(lines):
    return lines if isinstance(lines, str) else ''.join(lines)


def sources(notebook, kind):
    return [text(cell['source']) for cell in notebook['cells'] if cell['cell_type'] == kind]


def program(notebook):
    """The code of a notebook as one tree, without what is for the notebook's shell."""
    return ast.parse('\n'.join(_MAGIC.sub(r'\1pass', cell) for cell in sources(notebook, 'code')))


def imported(tree):
    """What of the suite is imported, by name; a name that does not exist raises."""
    found = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and str(node.module).split('.')[0] == 'trl_suite':
            extra = EXTRAS.get(node.module, 'numpy')
            if importlib.util.find_spec(extra) is None:
                continue  # the slow test imports it
            module = importlib.import_module(node.module)
            for alias in node.names:
                if not hasattr(module, alias.name):
                    importlib.import_module(f'{node.module}.{alias.name}')
                found[alias.asname or alias.name] = getattr(module, alias.name)
    return found


class StoredTest(parameterized.TestCase):
    """The files as they are."""

    def test_all_are_known(self):
        self.assertCountEqual(NAMES, [path.stem for path in FOLDER.glob('*.ipynb')])
        readme = (FOLDER / 'README.md').read_text(encoding='utf-8')
        for name in NAMES:
            self.assertIn(f'({name}.ipynb)', readme)

    @parameterized.parameters(*NAMES)
    def test_notebooks_have_the_expected_format(self, name):
        """Outputs are of one run from top to bottom, with pictures, without errors and places."""
        self.assertLess((FOLDER / f'{name}.ipynb').stat().st_size, LARGEST)
        notebook = read(name)
        self.assertEqual((notebook['nbformat'], notebook['nbformat_minor']), (4, 5))
        self.assertEqual(notebook['metadata']['language_info'], {'name': 'python'})
        cells = notebook['cells']
        self.assertLen({cell['id'] for cell in cells}, len(cells))
        self.assertEqual([cell['metadata'] for cell in cells], [{}] * len(cells))
        self.assertStartsWith(text(cells[0]['source']), '# ')
        code = [cell for cell in cells if cell['cell_type'] == 'code']
        self.assertEqual([cell['execution_count'] for cell in code], list(range(1, len(code) + 1)))
        pictures = 0
        for output in (output for cell in code for output in cell['outputs']):
            self.assertIn(output['output_type'], ('stream', 'display_data', 'execute_result'))
            data = output.get('data', {})
            pictures += 'image/jpeg' in data or 'image/png' in data
            self.assertNotEqual(output.get('name'), 'stderr')
            said = text(output.get('text', '')) + text(data.get('text/plain', ''))
            self.assertNotRegex(said, _ABSOLUTE)
        self.assertGreaterEqual(pictures, 2)

    @parameterized.parameters(*NAMES)
    def test_names_in_notebooks_exist(self, name):
        notebook = read(name)
        tree, words = program(notebook), sources(notebook, 'markdown')
        for cell in (*words, *sources(notebook, 'code')):
            for id_ in _ID.findall(cell):
                self.assertIn(id_, catalogue.BY_ID)
        for cell in words:
            for file in _FILE.findall(cell):
                self.assertTrue((ROOT / file).is_file(), file)
            for link in _LINK.findall(cell):
                self.assertTrue((FOLDER / link).exists(), link)
        modules = {k: v for k, v in imported(tree).items() if isinstance(v, types.ModuleType)}
        for node in ast.walk(tree):
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
                owner = modules.get(node.value.id)
                self.assertTrue(owner is None or hasattr(owner, node.attr), ast.unparse(node))
            if isinstance(node, ast.keyword) and node.arg == 'terrain':
                preset = getattr(node.value, 'value', None)
                if isinstance(preset, str):
                    terrain.load(preset)


def badges():
    """The program that marks notebooks with where they are published."""
    with mock.patch.object(sys, 'path', [str(FOLDER), *sys.path]):
        return importlib.import_module('badges')


class PublishedTest(parameterized.TestCase):
    """What the first cell installs, and the badges."""

    def install(self, notebook, folder, installed=False):
        """Runs the first cell in a folder; returns what it asks pip for."""
        asked = []
        code = sources(notebook, 'code')[0]
        code = code.replace('%pip install --quiet {packages}', 'pip(packages)')
        code = re.sub(r'%pip install .* dm-control==.*', 'pass', code)
        code = re.sub(r'!apt-get.*', 'pass', code)
        found = object() if installed else None
        with (
            mock.patch.object(pathlib.Path, 'cwd', return_value=folder),
            mock.patch.object(importlib.util, 'find_spec', return_value=found),
        ):
            exec(code, {'pip': lambda packages: asked.extend(shlex.split(packages))})
        return asked

    @parameterized.parameters(*NAMES)
    def test_first_cell_and_badge(self, name):
        notebook, elsewhere = read(name), pathlib.Path('/content')
        self.assertEqual(self.install(notebook, FOLDER, installed=True), [])
        suite, policies = self.install(notebook, FOLDER)
        self.assertStartsWith(suite, f'{ROOT}[video')
        self.assertEqual(policies, f'{ROOT}/trained')
        (release,) = self.install(notebook, elsewhere)
        self.assertRegex(release, r'^trl_suite\[video.*policies\]$')
        self.assertLessEqual(set(release[len('trl_suite[') : -1].split(',')), setup_extras())

        before = (FOLDER / f'{name}.ipynb').read_text(encoding='utf-8')
        marked = badges().mark(before, 'someone/terrain', name, released=False)
        notebook = json.loads(marked)
        address = 'https://colab.research.google.com/github/someone/terrain/blob/main/colab/'
        self.assertIn(f'({address}{name}.ipynb)', sources(notebook, 'markdown')[0])
        suite, policies = self.install(notebook, elsewhere)
        source = ' @ git+https://github.com/someone/terrain'
        self.assertEndsWith(suite, source)
        self.assertEqual(policies, f'trl_suite_policies{source}#subdirectory=trained')
        released = badges().mark(marked, 'someone/terrain', name, released=True)
        self.assertLen(self.install(json.loads(released), ROOT / 'x' / 'y'), 1)
        again = badges().mark(released, 'someone/terrain', name, released=False)
        self.assertEqual(again, marked)

    def test_links(self):
        linked = badges().link((FOLDER / 'README.md').read_text(encoding='utf-8'), 'some/one')
        self.assertEqual(linked.count('[Colab](https://colab'), len(NAMES))
        self.assertEqual(badges().link(linked, 'some/one'), linked)


def setup_extras():
    text = (ROOT / 'setup.py').read_text(encoding='utf-8')
    return set(re.findall(r"^        '(\w+)': \[", text, re.MULTILINE))


class RunTest(parameterized.TestCase):
    """The notebooks from top to bottom; those that learn do so for next to no time."""

    @parameterized.parameters(*NAMES)
    @pytest.mark.slow
    def test_notebooks_run(self, name):
        for module in ('nbclient', 'ipykernel', 'stable_baselines3'):
            if importlib.util.find_spec(module) is None:
                self.skipTest(f"needs {module}: pip install -e '.[notebooks]'")
        sys.path.insert(0, str(FOLDER))
        self.addCleanup(sys.path.remove, str(FOLDER))
        import execute

        notebook = execute.tidy(execute.execute(FOLDER / f'{name}.ipynb', short=True))
        counts = [cell.execution_count for cell in notebook.cells if cell.cell_type == 'code']
        self.assertEqual(counts, list(range(1, len(counts) + 1)))
