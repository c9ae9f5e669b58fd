"""Configures Sphinx: `pip install -e '.[docs]' && sphinx-build -W docs site`.

The pages are Markdown that reads as well on GitHub. What only the site needs is added here: the
pages of each environment, family, character and terrain with their navigation and the links to them,
pages from outside docs/, and the pictures that are missing, where OpenGL works. `-D moving_pictures='*'`,
or another pattern of ids, renders moving pictures of the environments, too.
"""

from __future__ import annotations

import ast
import contextlib
import os
import pathlib
import re
import sys
import textwrap
from typing import Any

import trl_suite
from trl_suite.registry import catalogue

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parent))
import gallery
import generate

DOCS = pathlib.Path(__file__).resolve().parent
ROOT = DOCS.parent
# Pages whose text lies outside docs/; the page in docs/ only links to it.
ELSEWHERE = {
    'changelog': ROOT / 'CHANGELOG.md',
    'clips': ROOT / 'mocap' / 'README.md',
    'contributing': ROOT / 'CONTRIBUTING.md',
    'index': ROOT / 'README.md',
    'notebooks': ROOT / 'colab' / 'README.md',
    'physics_rate': ROOT / 'benchmarks' / 'physics_rate.md',
    'policies': ROOT / 'trained' / 'README.md',
    'training': ROOT / 'training' / 'README.md',
}
PAGES = {path: f'{name}.md' for name, path in ELSEWHERE.items()}
LINK = re.compile(r'(?<=\]\()(?![a-z]+:|#)([^)#\s]+)')
# A cell of a table that is a name, and the pages of environments, characters and others by name.
CELL = re.compile(r'(?<=\| )`([\w/-]+)`(?= \|)')
SUBJECTS = {
    name: f'{folder}/{generate.slug(name)}.md'
    for folder, (_, names) in generate.SITE.items()
    for name in names
}
STRIP = re.compile(r'!\[Film strip\]\(\S*/environments/(\S+)\.jpg\)')
PICTURE = re.compile(r'!\[[^]]*\]\((\S+)\)')

project = 'trl_suite'
author = copyright = 'the trl_suite developers'
release = trl_suite.__version__
extensions = [
    'myst_parser',
    'sphinx.ext.autodoc',
    'sphinx.ext.autosummary',
    'sphinx.ext.napoleon',
    'sphinx.ext.viewcode',
    'sphinx_argparse_cli',
    'sphinx_copybutton',
]
root_doc = 'index'
templates_path = ['_templates']

myst_heading_anchors = 3

default_role = 'code'
autodoc_member_order = 'bysource'
suppress_warnings = ['ref.python']  # fields of the same name in two classes
autodoc_mock_imports = ['minari', 'stable_baselines3']
napoleon_use_ivar = True  # the fields of a NamedTuple are listed once

html_theme = 'furo'
html_title = 'trl_suite'
html_favicon = '_static/favicon.svg'
html_static_path = ['_static']
html_css_files = ['site.css']
html_js_files = [('sortable.min.js', {'defer': ''}), ('tables.js', {'defer': ''})]
html_copy_source = False
html_theme_options = {'sidebar_hide_name': False}


def navigation(name: str) -> str:
    """Returns the part of the navigation below a page."""
    folder, _, stem = name.partition('/')
    pages = []
    if folder == 'families':
        pages = [f'../environments/{spec.id}.md' for spec in catalogue.SPECS if spec.domain == stem]
    elif name in generate.SITE:
        below = 'families' if name == 'environments' else name
        pages = [SUBJECTS[each] for each in generate.SITE[below][1]]
    return '\n'.join(['', '```{toctree}', ':hidden:', *pages, '```', '']) if pages else ''


def read(app: Any, name: str, source: list[str]) -> None:
    """Completes the text of a page before it is parsed."""
    own, text = DOCS / name, source[0]
    if name in ELSEWHERE:
        app.env.note_dependency(str(ELSEWHERE[name]))
        _, tree, listed = text.partition('```{toctree}')  # that of the index
        text = ELSEWHERE[name].read_text(encoding='utf-8') + tree + listed
    start = ELSEWHERE.get(name, own).parent

    def inside(match: re.Match[str]) -> str:
        target = pathlib.Path(os.path.normpath(start / match[1]))
        return os.path.relpath(DOCS / PAGES[target] if target in PAGES else target, own.parent)

    def page_of(match: re.Match[str]) -> str:
        if (subject := SUBJECTS.get(match[1])) is None:
            return match[0]
        return f'[{match[0]}]({os.path.relpath(DOCS / subject, own.parent)})'

    def drawn(match: re.Match[str]) -> str:
        return match[0] if os.path.exists(os.path.normpath(own.parent / match[1])) else ''

    text = CELL.sub(page_of, LINK.sub(inside, text))
    folder = name.partition('/')[0]
    if folder == 'environments':
        text = STRIP.sub(moving, text)
    if folder in generate.SITE:
        text = PICTURE.sub(drawn, text)
    source[0] = text + navigation(name)


def moving(match: re.Match[str]) -> str:
    """Returns the moving picture of an environment, or its film strip, and how to see more of it."""
    picture = match[0]
    if (DOCS / 'moving' / f'{match[1]}.webp').exists():
        picture = f'![{match[1]}](../moving/{match[1]}.webp)'
    view = f'trl-suite view {match[1]} --browser'
    return f'{picture}\n\nIn the [web browser](../guide.md#in-a-web-browser): `{view}`'


def mark_code(app: Any, what: str, name: str, item: Any, options: Any, lines: list[str]) -> None:
    """Marks examples and file formats in the docstring of a module as literal text."""
    if what != 'module':
        return
    blocks, literal = [], False
    for block in '\n'.join(lines).strip().split('\n\n'):
        was, literal = literal, block.startswith(' ') or is_code(block)
        if literal and not was:
            blocks.append('::')
        blocks.append(textwrap.indent(textwrap.dedent(block), '    ') if literal else block)
    lines[:] = '\n\n'.join(blocks).split('\n')


def is_code(block: str) -> bool:
    with contextlib.suppress(SyntaxError):
        return any(not isinstance(part, ast.Name) for part in ast.parse(block).body)
    return False


def render(app: Any) -> None:
    """Makes pictures that are missing, or that show a policy that has been replaced."""
    try:
        _, failed = gallery.make(DOCS / 'pictures')
        if app.config.moving_pictures:
            failed |= gallery.make(DOCS, app.config.moving_pictures, moves=True)[1]
    except ValueError as error:
        failed = {'moving_pictures': error}
    except RuntimeError as error:
        print(f'The site has fewer pictures: {error}', file=sys.stderr)
        return
    if failed:
        # The tests, which read this file, work without Sphinx.
        from sphinx.errors import ConfigError

        raise ConfigError('\n'.join(f'{path}: {error}' for path, error in failed.items()))


def setup(app: Any) -> None:
    app.add_config_value('moving_pictures', '', 'env', str)
    app.connect('builder-inited', lambda app: generate.write_site())
    app.connect('builder-inited', render)
    app.connect('source-read', read)
    app.connect('autodoc-process-docstring', mark_code)
