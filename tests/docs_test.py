"""The pages in docs/ and the README: up to date, with existing link targets; their pictures."""

import builtins
import contextlib
import importlib.util
import io
import json
import os
import pathlib
import re
import sys
from unittest import mock

import numpy as np
from absl.testing import absltest, parameterized
from helpers import FolderTest, besides_notices
from PIL import Image

from trl_suite import characters, describe, policies, suite, terrain
from trl_suite.describe import options
from trl_suite.registry import build, catalogue
from trl_suite.util import tables

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[1] / 'docs'))
import conf
import gallery
import generate
import papers

ROOT = pathlib.Path(__file__).resolve().parents[1]
DOCS = ROOT / 'docs'
GAPS = 'PD_Biped2D_Gaps_Terrain-v0'
FOLDERS = 'trl_suite', 'tests', 'docs', 'training', 'benchmarks', 'colab', 'trained', '.ci', 'xml'
LARGEST = 3e6  # bytes of the pictures that the repository keeps
_LINK = re.compile(r'\]\((?!https?:|#)([^)#]+)')


def only_on_the_site(path):
    return path.relative_to(DOCS).parts[0] in generate.SITE


def tracked_pages():
    """Returns the pages in docs/ that the repository keeps, as paths."""
    return [path for path in DOCS.rglob('*.md') if not only_on_the_site(path)]


def built(path):
    """Whether a picture is drawn with the site."""
    return path.parent.name in gallery.BUILT


class PagesTest(FolderTest):
    def test_pages_are_up_to_date(self):
        """Generated pages equal the stored ones: run `python docs/generate.py` if this fails."""
        self.assertEqual(list(generate.stale(generate.pages())), [])

    @parameterized.parameters(
        ('environments', catalogue.BY_ID), ('characters', characters.CHARACTERS),
        ('terrains', generate.presets()),
    )  # fmt: skip
    def test_indexes_name_everything(self, page, names):
        text = (DOCS / f'{page}.md').read_text('utf-8')
        self.assertContainsSubset(names, re.findall(r'^\| `(\S+)` \|', text, re.MULTILINE))

    def test_pages_of_the_site_are_not_tracked(self):
        ignored = (ROOT / '.gitignore').read_text(encoding='utf-8').splitlines()
        left_out = (ROOT / 'MANIFEST.in').read_text(encoding='utf-8').splitlines()
        for folder in (*generate.SITE, *(f'pictures/{name}' for name in gallery.BUILT)):
            self.assertIn(f'/docs/{folder}/', ignored)
            self.assertIn(f'prune docs/{folder}', left_out)

    @parameterized.parameters(
        (f'environments/{GAPS}.md',
         '## Observation', '| pose |', '## Action', '| index |', '## Reward', '| end_effector |',
         '## Options', '| terrain_observation |', '## Links', '## Differences from the original'),
        ('environments/FSM_Hopper2D_Terrain_Walls-v0.md', '| velocity |', '| speed |', '| base_actions |'),
        ('families/plaid.md', f'| [{GAPS}](../environments/{GAPS}.md)<br>'),
        ('characters/dog.md', '## Links and joints\n\n| link and joint | kg |'),
        ('terrains/injectinput_slopes.md', '## Parameters\n\n| parameter | unit | value |'),
    )  # fmt: skip
    def test_pages_of_the_site(self, path, *parts):
        """They have their parts in this order, and all of their links have targets."""
        pages = generate.site_pages()
        text, place = pages[path](), 0
        for part in parts:
            place = text.index(f'\n{part}', place)
        for link in _LINK.findall(text):
            target = (DOCS / path).parent.joinpath(link).resolve()
            found = target.relative_to(DOCS).as_posix() in pages or target.exists()
            self.assertTrue(found or built(target), f'{path}: {link}')

    @parameterized.parameters(
        'README', 'CONTRIBUTING', 'docs/concepts', 'docs/guide', 'docs/realism',
        'docs/reports/robustness', 'docs/benchmark',
    )  # fmt: skip
    def test_code_runs(self, name):
        text = (ROOT / f'{name}.md').read_text(encoding='utf-8')
        code = '\n'.join(re.findall('```python\n(.*?)```', text, re.DOTALL))
        self.assertNotEmpty(code)
        with (
            contextlib.chdir(self.folder),
            contextlib.redirect_stdout(io.StringIO()),
            contextlib.redirect_stderr(io.StringIO()) as told,
        ):
            exec(compile(code, f'{name}.md', 'exec'), {'__name__': 'page'})
        self.assertEqual(besides_notices(told.getvalue()), '')

    def test_readme_counts_environments(self):
        text = (ROOT / 'README.md').read_text(encoding='utf-8')
        self.assertIn(f'{len(catalogue.SPECS)} environments in which', text)
        originals = sum('original' in spec.tags for spec in catalogue.SPECS)
        self.assertIn(f'\n{originals} of the environments are registered', text)
        counts = dict(re.findall(r'^\| \[`(\w+)`\].*?\.jpg\) \| (\d+) \|', text, re.MULTILINE))
        families = [spec.domain for spec in catalogue.SPECS]
        self.assertEqual(counts, {name: str(families.count(name)) for name in catalogue.FAMILIES})

    def test_links_have_targets_and_pictures_are_used(self):
        """Every link target of a page is in the repository, and is not empty."""
        linked = set()
        for file in (ROOT / 'README.md', ROOT / 'CONTRIBUTING.md', *tracked_pages()):
            for link in _LINK.findall(file.read_text(encoding='utf-8')):
                target = (file.parent / link).resolve()
                linked.add(target)
                self.assertTrue(target.exists(), f'{file}: {link}')
                if target.is_relative_to(DOCS):
                    self.assertFalse(only_on_the_site(target) or built(target), f'{file}: {link}')
                if target.is_file():
                    self.assertGreater(target.stat().st_size, 0, f'{file}: {link}')
        folder = DOCS / 'pictures'
        pictures = {each for each in folder.rglob('*') if each.is_file() and not built(each)}
        self.assertLess(sum(path.stat().st_size for path in pictures), LARGEST)
        made = {folder / item.path for item in gallery.items() if not built(folder / item.path)}
        self.assertEqual(made - pictures, set())
        self.assertEqual(pictures - made - linked, set())


class TablesTest(FolderTest):
    def test_returns_and_area_under_the_curve(self):
        curve = [(100_000, 0.5), (200_000, 1.0), (300_000, 1.0)]
        run = {
            'curve': [{'samples': x, 'normalized_return': y} for x, y in curve],
            'evaluation': {'returns': [90.0, 110.0], 'step_limit': 200},
        }
        self.assertEqual(papers.returns([run], 200_000), '.500 ± .050 (.500; 0.3 M)')
        self.assertEqual(papers.returns([], 200), '–')
        self.assertEqual([papers.figure(value) for value in (-0.0664, 1.5)], ['-.066', '1.500'])

    def test_shares_have_intervals(self):
        half = 1.96 * (0.25 / 10 + 1.96**2 / 400) ** 0.5 / (1 + 1.96**2 / 10)  # around 0.5, of 10
        low, high = 100 * (0.5 - half), 100 * (0.5 + half)
        self.assertEqual(tables.share(0.5, 10), f'50% ({low:.0f} to {high:.0f})')
        most = 100 * 1.96**2 / (10 + 1.96**2)
        self.assertEqual(tables.share(0.0, 10), f'0% (0 to {most:.0f})')

    def test_tables_show_what_is_stored(self):
        """The last return of PLAiD's biped on gaps, and the changes by the stages after the first."""
        scores = [
            json.loads(path.read_text())['scores']
            for path in (DOCS / 'continual' / 'plaid_biped').glob('Plaid_s*.json')
        ]
        last, change = np.mean([each[4][4] for each in scores]), np.mean(scores, 0)[[0, 4], 0]
        final, changed = papers.plaid(0), papers.plaid(1)
        last, change = papers.figure(last), papers.figure(change[1] / change[0] - 1)
        row = rf'published \| \.891.*\n\|  \| our biped .* \| {last} \| \S+ \|\n'
        self.assertRegex(final, row)
        self.assertRegex(changed, rf'published \| \.054.*\n\|  \| our biped \| {change} ')


class ContributingTest(absltest.TestCase):
    text = re.sub('```.*?```', '', (ROOT / 'CONTRIBUTING.md').read_text('utf-8'), flags=re.DOTALL)
    files = (*ROOT.glob('*.*'), *(path for name in FOLDERS for path in (ROOT / name).rglob('*.*')))

    def test_names_are_defined(self):
        sources = [path for path in self.files if path.suffix == '.py']
        code = '\n'.join(path.read_text('utf-8') for path in sources)
        modules = {name for path in sources for name in (path.stem, path.parent.name)}
        names = set(re.findall(r'`(?:\w+\.)*([A-Za-z]\w+)`', self.text))
        self.assertContainsSubset({'load', 'build_task', 'finish_step', 'EnvSpec'}, names)
        for name in names - modules - {'md', 'py', 'json', 'toml', *dir(builtins)}:
            if importlib.util.find_spec(name) is None:
                self.assertRegex(code, rf'(?m)^ *((def|class) {name}\b|{name}(: .*)? = )')

    def test_files_exist(self):
        found = re.findall(r'`(?:python )?([\w./]+(?:/|\.(?:py|json|md)))[` ]', self.text)
        paths = [f'/{path.relative_to(ROOT).as_posix()}' for path in self.files]
        self.assertIn('registry/build.py', found)
        for name in found:
            if 'NAME' not in name:
                self.assertTrue(any(f'/{name}' in path for path in paths), name)


class SitePagesTest(FolderTest):
    def test_only_pages_older_than_the_sources_are_written(self):
        (self.folder / 'generate.py').touch()
        site = {'terrains': (str.upper, ['a/b', 'c'])}
        with mock.patch.multiple(generate, DOCS=self.folder, SITE=site, SOURCES=()):
            self.assertEqual([generate.write_site() for _ in range(2)], [2, 0])
            path = self.folder / 'terrains' / 'a_b.md'
            self.assertEqual(path.read_text(), 'A/B')
            os.utime(path, (0, 0))
            self.assertEqual([generate.write_site() for _ in range(2)], [1, 0])


class GalleryTest(FolderTest):
    def test_everything_has_its_pictures(self):
        items = list(gallery.items())
        paths = [item.path for item in items]
        self.assertLen(set(paths), len(paths))
        trained = list(filter(gallery.record, policies.available()))  # others share a policy
        for folder, count in (
            ('environments', len(catalogue.SPECS)), ('characters', len(characters.CHARACTERS)),
            ('terrains', len(terrain.PRESETS) + len(terrain.PRESETS3D)), ('curves', len(trained)),
            ('families', len(suite.TASKS_BY_DOMAIN)),
        ):  # fmt: skip
            self.assertLen([path for path in paths if path.startswith(f'{folder}/')], count, folder)
        self.assertContainsSubset(('suite.webp', 'terrains/gaps.png', 'terrains/plane.jpg'), paths)
        sources = [item.path for item in items if item.source]
        self.assertLen(items[0].source.split(), 6)  # of the suite's picture
        self.assertLen(
            sources, 1 + len(policies.available()) + len(trained) + len(gallery.FAMILIES)
        )  # film strips and curves

    def test_pictures(self):
        for only in (
            'Hopper2D_Terrain_Walls-', 'characters/hopper', 'terrains/gaps.png', f'curves/{GAPS}',
        ):  # fmt: skip
            written, failed = gallery.make(self.folder, only)
            self.assertEqual((len(written), failed), (1, {}))
        files = {path.name: path for path in self.folder.rglob('*.*g')}
        strip = 'FSM_Hopper2D_Terrain_Walls-v0.jpg'
        self.assertCountEqual(files, [strip, 'hopper.jpg', 'gaps.png', f'{GAPS}.png'])
        for path in files.values():
            self.assertBetween(path.stat().st_size, 1000, gallery.LARGEST)
            with Image.open(path) as image:
                self.assertGreater(np.asarray(image.convert('RGB')).std(), 5)
        with Image.open(files[strip]) as image:
            height, width = gallery.STRIP_SIZE
            self.assertEqual(image.size, (6 * width + 5 * 4, height))

    def test_existing_pictures_are_kept(self):
        old = self.folder / 'characters/dog.jpg'
        old.parent.mkdir()
        old.write_text('mine')
        self.assertEqual(gallery.make(self.folder, 'characters/dog'), ([], {}))
        self.assertEqual(old.read_text(), 'mine')
        self.assertEqual(gallery.make(self.folder, 'characters/dog', again=True), ([old], {}))
        self.assertGreater(old.stat().st_size, 1000)

    def test_pictures_of_a_replaced_policy_are_redrawn(self):
        for digest, count in (('old', 1), ('old', 0), ('new', 1), ('new', 0)):
            with mock.patch.object(gallery, '_digest', lambda name, digest=digest: digest):
                self.assertLen(gallery.make(self.folder, f'curves/{GAPS}')[0], count)
        for suffix in ('.png', '.jpg'):
            path = self.folder / f'a{suffix}'
            gallery.save(np.zeros((9, 9, 3), np.uint8), path, 'digest')
            self.assertEqual(gallery._source(path), 'digest')

    def test_an_error_does_not_stop_other_pictures(self):
        error = ValueError('no such thing')

        def draw():
            raise error

        grey = np.zeros((9, 9, 3), 'u1')
        items = gallery.Item('a.png', draw), gallery.Item('b.png', lambda: grey)
        with mock.patch.object(gallery, 'items', lambda: iter(items)):
            found = gallery.make(self.folder)
        self.assertEqual(found, ([self.folder / 'b.png'], {'a.png': error}))
        self.assert_only('b.png')
        with self.assertRaisesRegex(ValueError, "no picture matches 'cat'"):
            gallery.make(self.folder, 'cat')

    def test_noise_becomes_small(self):
        noise = np.random.default_rng(0).integers(0, 255, (150, 200, 3)).astype(np.uint8)
        path = self.folder / 'noise.jpg'
        gallery.save(noise, path)
        self.assertLess(path.stat().st_size, gallery.LARGEST)
        with self.assertRaisesRegex(ValueError, "unknown suffix '.gif'"):
            gallery.save(noise, path.with_suffix('.gif'))


class WordsTest(parameterized.TestCase):
    @parameterized.parameters(
        'PD_Dog2D_Gaps_Terrain-v0', 'FSM_Raptor2D_Terrain_Walls-v0', 'PD_Biped3D_HLC_LargeBlocks-v0'
    )
    def test_descriptions_do_not_depend_on_the_ground(self, id_):
        """Environments that differ only in their ground have equal descriptions."""
        spec = suite.find(id_)
        other = next(
            each for each in catalogue.SPECS
            if each.terrain != spec.terrain and each.options == spec.options
            and (each.task_type, each.character, each.clip) == (spec.task_type, spec.character, spec.clip)
        )  # fmt: skip
        own, shared = (suite.build_environment(each, {}, {}) for each in (spec, other))
        self.assertEqual(list(describe.sections(spec, own)), list(describe.sections(spec, shared)))

    @parameterized.parameters(
        ('direct_navigation', '1 to 3 m ahead of the walker along x'), ('goal_navigation', 'up to 3 m from the walker'),
    )  # fmt: skip
    def test_goals_of_open_ground(self, task, words):
        spec = suite.combine('biped3d_mocap', terrain='plane', task=task)
        told = dict(describe.sections(spec, suite.build_environment(spec, {}, {})))
        self.assertIn(words, told['Goal'])
        self.assertIn('at the origin', told['Start'])

    def test_every_option_is_explained(self):
        for spec in (*catalogue.SPECS, suite.combine('dog', task='walk')):
            for name, (_, data) in build.task_options(spec).items():
                self.assertNotEmpty(data['meaning'], f'{name} of {spec.id}')
        spec = suite.find('PD_Biped3D_HLC_Forest-v0')
        table = options.options(spec).parts[0]
        meanings = {name: (default, meaning) for name, default, _, meaning in table.cells}
        self.assertIn('frame', meanings['interface'][1])
        self.assertEqual(meanings['step_limit'][0], 400)

    def test_markdown(self):
        table = tables.Table(('a', 'b'), [('x|y', 0.5), ('2 * <3>', 12)])
        self.assertEqual(
            tables.markdown(['a * b', table._replace(numbered=True)]),
            'a \\* b\n\n| index | a | b |\n| --: | --- | --: |\n'
            '| 0 | x\\|y | 0.5 |\n| 1 | 2 \\* &lt;3> | 12 |',
        )
        self.assertEqual(tables.table(table.header, table.cells).split(), [
            'a', 'b', 'x|y', '0.5', '2', '*', '<3>', '12',
        ])  # fmt: skip


class SiteTest(absltest.TestCase):
    def page(self, name, text=''):
        """Returns the text of a page as the site has it."""
        source = [text]
        conf.read(mock.MagicMock(), name, source)
        return source[0]

    def test_pages_from_outside_the_folder(self):
        written = set(conf.SUBJECTS.values())  # by the build of the site
        for name, path in conf.ELSEWHERE.items():
            text = self.page(name)
            self.assertStartsWith(text, path.read_text(encoding='utf-8').partition('\n')[0] + '\n')
            for link in _LINK.findall(text):
                self.assertTrue(link in written or (DOCS / link).exists(), f'{name}: {link}')
        self.assertEqual(
            self.page('guide', '[a](../CONTRIBUTING.md#layers) [b](../training/ppo.py) [c](#d)'),
            '[a](contributing.md#layers) [b](../training/ppo.py) [c](#d)',
        )

    def test_pictures_that_cannot_be_drawn_are_left_out(self):
        dog = '![dog](../pictures/characters/dog.jpg)'
        text = f'a ![b](../pictures/terrains/none.png) {dog}'
        self.assertStartsWith(self.page('terrains/none', text), f'a  {dog}')
        strip = '| ![Film strip](../pictures/environments/None-v0.jpg) |'
        view = (
            'In the [web browser](../guide.md#in-a-web-browser): `trl-suite view None-v0 --browser`'
        )
        self.assertEqual(self.page('environments/None-v0', strip), f'| \n\n{view} |')
        self.assertStartsWith(self.page('families/plaid', strip), '|  |\n')  # within a table
        error, told = RuntimeError('no OpenGL library works'), io.StringIO()
        with (
            mock.patch.object(gallery, 'make', side_effect=error),
            contextlib.redirect_stderr(told),
        ):
            conf.render(mock.MagicMock())
        self.assertEqual(told.getvalue(), f'The site has fewer pictures: {error}\n')

    def test_names_in_tables_are_links(self):
        self.assertLen(conf.SUBJECTS, len(generate.site_pages()))  # no name has two meanings
        self.assertEqual(
            self.page('guide', f'`{GAPS}`\n\n| `{GAPS}` | `injectinput/slopes` | `else` |'),
            f'`{GAPS}`\n\n| [`{GAPS}`](environments/{GAPS}.md) '
            '| [`injectinput/slopes`](terrains/injectinput_slopes.md) | `else` |',
        )

    def test_every_page_is_in_the_navigation(self):
        index = (DOCS / 'index.md').read_text(encoding='utf-8')
        listed = {f'{name}.md' for name in re.findall(r'^[a-z_]+(?:/\w+)?$', index, re.MULTILINE)}
        pages = {path.relative_to(DOCS).as_posix() for path in tracked_pages()}
        pages |= {*generate.site_pages()}
        for page in pages:
            folder = (DOCS / page).parent
            for below in conf.navigation(page.removesuffix('.md')).splitlines()[3:-1]:
                listed.add(folder.joinpath(below).resolve().relative_to(DOCS).as_posix())
        self.assertEqual(pages - listed - {'README.md', 'index.md'}, set())
