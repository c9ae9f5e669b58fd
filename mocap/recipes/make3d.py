"""Makes all 3D clips and step libraries, or the named ones: python make3d.py [name ...]."""

from __future__ import annotations

import pathlib
import sys

import checks3d
import numpy as np
import run3d
import step3d

from trl_suite import motion

MOCAP = pathlib.Path(__file__).resolve().parents[1]
RECIPES = (step3d, run3d)


def clips() -> list[motion.Clip]:
    """Returns all three-dimensional clips."""
    return [clip for recipe in RECIPES for clip in recipe.clips()]


def libraries() -> list[motion.FootstepLibrary]:
    """Returns all step libraries."""
    return [library for recipe in RECIPES for library in recipe.libraries()]


def describe(found: checks3d.Report) -> str:
    """Returns the measurements as one line of text."""
    return (
        f'{found.speed:.4g} m/s ({found.speeds[0]:.2f} to {found.speeds[1]:.2f}), '
        f'root {found.heights[0]:.3f} to {found.heights[1]:.3f} m, '
        f'lowest {1000 * found.lowest:.1f} mm, slide {1000 * found.slide:.1f} mm, '
        f'planted {found.planted:.0%}, clearance {1000 * found.clearance:.0f} mm, '
        f'margin {found.margin[0]:.3f} rad ({found.margin[1]}), '
        f'fastest {found.fastest[0]:.0f} rad/s ({found.fastest[1]}), '
        f'seam {found.seam_position:.0e} / {found.seam_rate:.2f}, '
        f'turn {found.heading_change:.3f} rad, overlap {1000 * found.overlap:.1f} mm'
    )


def main(names: list[str]) -> None:
    for clip in clips():
        if not names or clip.name in names:
            clip.save(MOCAP / f'{clip.name}.npz')
            found = checks3d.measure(clip, checks3d.CHARACTERS[clip.name])
            print(
                f'{clip.name}: {len(clip.times)} frames, {clip.duration:.4g} s, {describe(found)}'
            )
    for library in libraries():
        if not names or library.name in names:
            library.save(MOCAP / f'{library.name}{motion.clip.STEPS_SUFFIX}.npz')
            character = step3d.character(library.name)
            for i, label in enumerate(library.labels):
                found = checks3d.measure(library.clip(i), character, samples=300)
                print(f'{library.name} {np.round(label, 3)}: {describe(found)}')


if __name__ == '__main__':
    main(sys.argv[1:])
