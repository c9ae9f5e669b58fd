"""Makes every clip of mocap/ anew: python mocap/recipes/make.py [name ...]."""

from __future__ import annotations

import pathlib
import sys

import run
import walk

MOCAP = pathlib.Path(__file__).resolve().parents[1]


def main(names: list[str]) -> None:
    for clip in [*walk.clips(), *run.clips()]:
        if not names or clip.name in names:
            clip.save(MOCAP / f'{clip.name}.npz')
            print(f'{clip.name}: {len(clip.times)} frames, {clip.duration:g} s')


if __name__ == '__main__':
    main(sys.argv[1:])
