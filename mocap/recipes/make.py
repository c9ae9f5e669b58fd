"""Makes all planar clips of mocap/, or the named ones: python mocap/recipes/make.py [name ...]."""

from __future__ import annotations

import pathlib
import sys

import checks
import dog_bound
import run
import walk

from trl_suite.util import errors

MOCAP = pathlib.Path(__file__).resolve().parents[1]
RECIPES = (walk, run, dog_bound)


def main(names: list[str]) -> None:
    made = [clip for recipe in RECIPES for clip in recipe.clips()]
    errors.check_known('clip', [clip.name for clip in made], *names)
    for clip in made:
        if names and clip.name not in names:
            continue
        clip.save(MOCAP / f'{clip.name}.npz')
        found = checks.measure(clip, checks.CHARACTERS[clip.name])
        print(
            f'{clip.name}: {len(clip.times)} frames, {found.period:.4g} s, '
            f'{found.speed:.4g} m/s, lowest {1000 * found.lowest:.1f} mm, '
            f'slide {1000 * found.slide:.1f} mm, planted {found.planted:.0%}, '
            f'margin {found.margin[0]:.3f} rad ({found.margin[1]}), '
            f'fastest {found.fastest[0]:.0f} rad/s ({found.fastest[1]}), '
            f'seam {found.seam_position:.0e} / {found.seam_rate:.2f}'
        )


if __name__ == '__main__':
    main(sys.argv[1:])
