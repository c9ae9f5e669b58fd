"""Prints figures of the code: its size, and the CPU time of the first use of environments.

    python benchmarks/house.py [--no-times] [--json FILE]

First use is what a user waits for after an installation: an environment is made, reset and stepped
once in a new process with an empty folder for compiled code. Most of the time is spent in compiling.
The import of the package is not included.
"""

from __future__ import annotations

import argparse
import os
import pathlib
import subprocess
import sys
import tempfile

from trl_suite.util import files
from trl_suite.util.program import begin_script

ROOT = pathlib.Path(__file__).resolve().parents[1]
IDS = {
    'planar': 'PD_Biped2D_Gaps_Terrain-v0',
    '3D': 'PD_Biped3D_Imitate-Hills_Terrain-v0',
    'gait': 'FSM_Dog2D_Terrain_Mixed-v0',
    'planned': 'PD_Biped3D_HLC_Forest-v0',
}
FIRST_USE = """
import sys, time
import numpy as np
from trl_suite import suite
begin = time.process_time()
environment = suite.make(sys.argv[1], {'random': 0})
environment.reset()
environment.step(np.zeros(environment.action_spec().shape))
print(time.process_time() - begin)
"""


def counts() -> dict[str, int]:
    """Returns what can be counted in the modules of the package."""
    texts = [path.read_text(encoding='utf-8') for path in (ROOT / 'trl_suite').rglob('*.py')]
    whole = '\n'.join(texts)
    return {
        'lines': sum(text.count('\n') for text in texts),
        'lines of the longest module': max(text.count('\n') for text in texts),
        'fmt: skip': whole.count('# fmt: skip'),
        'type: ignore': whole.count('# type: ignore'),
        'named tuples': whole.count('(NamedTuple)'),
        'functions that are compiled': whole.count('\n@compiled'),
    }


def first_use(id_: str) -> float:
    """Returns the CPU time (s) of the first use of an environment."""
    with tempfile.TemporaryDirectory() as folder:
        done = subprocess.run(
            [sys.executable, '-c', FIRST_USE, id_],
            env={**os.environ, 'PYTHONPATH': str(ROOT), 'NUMBA_CACHE_DIR': folder},
            stdout=subprocess.PIPE,
            text=True,
            check=True,
        )
    return round(float(done.stdout), 1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--no-times', action='store_true', help='only count')
    parser.add_argument('--json', type=pathlib.Path, help='also write the figures to this file')
    arguments = parser.parse_args()
    figures: dict[str, float] = {**counts()}
    for name, id_ in {} if arguments.no_times else IDS.items():
        figures[f'CPU seconds of first use, {name}'] = first_use(id_)
    for name, value in figures.items():
        print(f'{name:<36}{value:>8}')
    if arguments.json:
        files.write_json(figures, arguments.json)


if __name__ == '__main__':
    begin_script()
    main()
