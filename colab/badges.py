"""Writes into the notebooks where they are published, so that they open and install on Colab.

    python colab/badges.py OWNER/NAME               # on GitHub, before a release on PyPI
    python colab/badges.py OWNER/NAME --released    # after it

Adds a Colab badge below the title of each notebook and a link to the table of README.md. Before a
release the first cell installs the repository's main branch, after it the latest release.
"""

from __future__ import annotations

import argparse
import json
import pathlib
import re

from trl_suite.util import files

FOLDER = pathlib.Path(__file__).resolve().parent
COLAB = 'https://colab.research.google.com'
REPOSITORY = re.compile(r'[\w.-]+/[\w.-]+')
SOURCE = re.compile(r"^REPOSITORY = '.*?'", re.MULTILINE)
BADGE = re.compile(r'^\[!\[Open in Colab\].*\n\n', re.MULTILINE)
LINK = re.compile(r'\((\w+)\.ipynb\)(, \[Colab\]\([^)]*\))?')


def address(repository: str, name: str) -> str:
    """Returns where Colab opens a notebook of a GitHub repository."""
    return f'{COLAB}/github/{repository}/blob/main/colab/{name}.ipynb'


def mark(text: str, repository: str, name: str, released: bool) -> str:
    """Returns the text of a notebook file with its badge and the source of the installation."""
    notebook = json.loads(text)
    title, install = notebook['cells'][:2]
    badge = f'[![Open in Colab]({COLAB}/assets/colab-badge.svg)]({address(repository, name)})'
    words = BADGE.sub('', ''.join(title['source']))
    title['source'] = words.replace('\n\n', f'\n\n{badge}\n\n', 1).splitlines(keepends=True)
    source = '' if released else f'https://github.com/{repository}'
    code = SOURCE.sub(f"REPOSITORY = '{source}'", ''.join(install['source']))
    install['source'] = code.splitlines(keepends=True)
    return json.dumps(notebook, indent=1, ensure_ascii=False) + '\n'


def link(text: str, repository: str) -> str:
    """Returns the text of README.md with a link to Colab after each notebook."""
    return LINK.sub(lambda m: f'({m[1]}.ipynb), [Colab]({address(repository, m[1])})', text)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('repository', metavar='OWNER/NAME')
    parser.add_argument('--released', action='store_true', help='the suite is on PyPI')
    arguments = parser.parse_args()
    if not REPOSITORY.fullmatch(arguments.repository):
        parser.error(f'{arguments.repository!r} is no repository; expected OWNER/NAME')
    for path in sorted(FOLDER.glob('*.ipynb')):
        text = mark(path.read_text('utf-8'), arguments.repository, path.stem, arguments.released)
        files.write_text(text, path)
    path = FOLDER / 'README.md'
    text = link(path.read_text('utf-8'), arguments.repository)
    files.write_text(text, path)


if __name__ == '__main__':
    main()
