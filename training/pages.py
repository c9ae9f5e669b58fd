"""Pictures and intervals of results for the pages of the documentation."""

from __future__ import annotations

import contextlib
import pathlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from scipy import special

from trl_suite.util import files

DOCS = pathlib.Path(__file__).resolve().parents[1] / 'docs'


def interval(values: Iterable[float], digits: int = 3) -> str:
    """Returns mean and half width of the 95 % confidence interval of the mean (Student's t)."""
    found = np.fromiter(values, float)
    if len(found) < 2:
        return ' '.join(f'{value:.{digits}f}' for value in found) or '–'
    half = special.stdtrit(len(found) - 1, 0.975) * found.std(ddof=1) / np.sqrt(len(found))
    return f'{found.mean():.{digits}f} ± {half:.{digits}f}'


@contextlib.contextmanager
def picture(path: pathlib.Path, *shape: int, **options: Any) -> Iterator[tuple[Any, Any]]:
    """Yields a figure and its axes, (rows, columns), and writes them as .png or .svg.

    A .svg is the same file for the same data.
    """
    import matplotlib

    matplotlib.use('Agg')
    from matplotlib import pyplot

    svg = {'svg.hashsalt': 'continual', 'svg.fonttype': 'none', 'font.size': 8}
    with matplotlib.rc_context(svg if path.suffix == '.svg' else {}):
        figure, axes = pyplot.subplots(*shape, squeeze=False, layout='constrained', **options)
        yield figure, axes
        more = {'metadata': {'Date': None}} if path.suffix == '.svg' else {'dpi': 80}
        with files.replacing(path) as part:
            figure.savefig(part, format=path.suffix[1:], **more)
        pyplot.close(figure)


def curves(
    path: pathlib.Path, panels: Mapping[str, Mapping[str, Sequence[Any]]], label: str
) -> None:
    """Draws learning curves, each with a dot at its end.

    Args:
      path: the file.
      panels: label of the y axis -> name -> curves, (points, 2) each.
      label: that of the x axis.
    """
    with picture(path, 1, len(panels), figsize=(max(8, 4.5 * len(panels)), 4)) as (_, axes):
        for axis, (y, named) in zip(axes[0], panels.items(), strict=True):
            for i, (name, found) in enumerate(named.items()):
                for number, curve in enumerate(found):
                    x, values = np.transpose(curve)
                    axis.plot(
                        x,
                        values,
                        'o-',
                        color=f'C{i}',
                        markevery=[-1],
                        label=name if not number else None,
                    )
            axis.set(xlabel=label, ylabel=y)
            axis.set_xlim(left=0)
            axis.set_ylim(bottom=0)
            axis.grid(alpha=0.3)
        axes[0, 0].legend(fontsize=8)
