"""Runs the notebooks from top to bottom, each in a new kernel, and stores them with their outputs.

    python colab/execute.py             # all
    python colab/execute.py terrain     # one of them

Needs `pip install -e '.[notebooks]'`. A notebook that fails or warns is not stored.
"""

from __future__ import annotations

import argparse
import os
import pathlib
import tempfile
import time

import nbclient
import nbformat

from trl_suite.util import errors, files

FOLDER = pathlib.Path(__file__).resolve().parent
NAMES = tuple(sorted(path.stem for path in FOLDER.glob('*.ipynb')))
SHORT = 'TRL_SUITE_SHORT'  # environment variable: notebooks that train use very few samples
TIMEOUT = 3600  # s, of a cell


def execute(path: pathlib.Path, short: bool = False) -> nbformat.NotebookNode:
    """Returns a notebook with its outputs after a run in an empty folder.

    Raises:
      nbclient.exceptions.CellExecutionError: a cell fails.
    """
    notebook = nbformat.read(path, as_version=4)
    variables = {name: value for name, value in os.environ.items() if name != SHORT}
    if short:
        variables[SHORT] = '1'
    with tempfile.TemporaryDirectory() as folder:
        client = nbclient.NotebookClient(
            notebook, kernel_name='python3', timeout=TIMEOUT, record_timing=False,
            coalesce_streams=True, extra_arguments=['--log-level=ERROR'],
            resources={'metadata': {'path': folder}},
        )  # fmt: skip
        return client.execute(env=variables)


def tidy(notebook: nbformat.NotebookNode) -> nbformat.NotebookNode:
    """Removes machine-specific metadata, and videos, which file viewers do not show.

    Raises:
      ValueError: something was written to stderr, for example a warning.
    """
    notebook.metadata = nbformat.from_dict(
        {
            'kernelspec': {'display_name': 'Python 3', 'language': 'python', 'name': 'python3'},
            'language_info': {'name': 'python'},
        }
    )
    for cell in notebook.cells:
        cell.metadata = nbformat.NotebookNode()
        if 'outputs' in cell:
            cell.outputs = [output for output in cell.outputs if not _is_notice(output)]
        for output in cell.get('outputs', ()):
            if output.get('name') == 'stderr':
                raise ValueError(f'{cell.source}\n\nwrote to stderr:\n{output.text}')
            if '<video' in output.get('data', {}).get('text/html', ''):
                del output.data['text/html']
    return notebook


def _is_notice(output: nbformat.NotebookNode) -> bool:
    """Whether an output only tells that functions were compiled."""
    lines = output.text.splitlines() if output.get('name') == 'stderr' else ['']
    return all(line.startswith('trl_suite: ') for line in lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('names', nargs='*', metavar='NAME', help=', '.join(NAMES))
    for name in parser.parse_args().names or NAMES:
        if name not in NAMES:
            parser.error(errors.unknown('notebook', name, NAMES))
        path = FOLDER / f'{name}.ipynb'
        begin, before = time.perf_counter(), os.times()
        notebook = tidy(execute(path))
        nbformat.validate(notebook)
        with files.replacing(path) as part:
            nbformat.write(notebook, part)
        after, wall = os.times(), time.perf_counter() - begin
        cpu = after.children_user - before.children_user
        print(
            f'{path.stem:20} {wall:5.0f} s, {cpu:5.0f} s of CPU, {path.stat().st_size / 1e3:4.0f} kB',
            flush=True,
        )


if __name__ == '__main__':
    main()
