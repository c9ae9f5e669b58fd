"""Sections of paragraphs and tables, as text for a terminal or as Markdown."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterable, Sequence
from typing import NamedTuple

WIDTH = 100  # characters of a line of text


class Table(NamedTuple):
    """A table with a header."""

    header: Sequence[str]
    cells: Sequence[Sequence[object]]  # rows of numbers and texts
    numbered: bool = False  # whether rows are entries of a vector: Markdown then has their indices


Part = Table | str  # a str is a paragraph, or a list with an item '- ...' on each line


class Section(NamedTuple):
    """A title and the parts below it."""

    title: str
    parts: tuple[Part, ...]


def section(title: str, *parts: Part) -> Section:
    """Returns a section."""
    return Section(title, parts)


def text(parts: Iterable[Part]) -> str:
    """Returns parts as lines for a terminal, indented by two spaces."""
    return '\n'.join(
        table(part.header, part.cells)
        if isinstance(part, Table)
        else '\n'.join(map(_fold, part.split('\n')))
        for part in parts
    )


def markdown(parts: Iterable[Part]) -> str:
    """Returns parts as Markdown, separated by empty lines."""
    return '\n\n'.join(
        _escaped(part) if isinstance(part, Table) else escape(part) for part in parts
    )


def table(header: Sequence[str], cells: Iterable[Sequence[object]], indent: str = '  ') -> str:
    """Returns aligned columns as text; columns of numbers are right-aligned."""
    rows = [[_cell(c) for c in row] for row in cells]
    columns = list(zip(header, *rows, strict=True))
    widths = [max(map(len, column)) for column in columns]
    right = _numeric(columns)
    return '\n'.join(
        indent
        + '  '.join(
            cell.rjust(width) if to_right else cell.ljust(width)
            for cell, width, to_right in zip(row, widths, right, strict=True)
        ).rstrip()
        for row in (list(header), *rows)
    )


def markdown_table(header: Iterable[str], cells: Iterable[Iterable[object]]) -> str:
    """Returns a table whose cells are Markdown; columns of numbers are right-aligned."""
    header, rows = list(header), [[_cell(c) for c in row] for row in cells]
    right = _numeric(zip(header, *rows, strict=True))
    lines = [header, ['--:' if to_right else '---' for to_right in right], *rows]
    return '\n'.join(f'| {" | ".join(line)} |' for line in lines)


def share(value: float, count: int) -> str:
    """Returns a share of independent cases in percent, and its 95 % confidence interval (Wilson)."""
    from scipy import stats  # takes time, and few programs need it

    cases = round(value * count)
    low, high = stats.binomtest(cases, count).proportion_ci(method='wilson')
    return f'{cases / count:.0%} ({100 * low:.0f} to {100 * high:.0f})'


def _escaped(table: Table) -> str:
    header, rows = list(table.header), [[escape(_cell(c)) for c in row] for row in table.cells]
    if table.numbered:
        header, rows = ['index', *header], [[str(i), *row] for i, row in enumerate(rows)]
    return markdown_table(header, rows)


def escape(text: str) -> str:
    """Returns text with Markdown's special characters escaped."""
    return re.sub(r'([*|`\\])', r'\\\1', text).replace('<', '&lt;')


def _cell(value: object) -> str:
    return f'{value:.4g}' if isinstance(value, float) else str(value)


def _numeric(columns: Iterable[Sequence[str]]) -> list[bool]:
    """Returns which columns have only numbers below their titles, or dashes for missing ones."""
    number = re.compile(r'([-+]?\.?\d[-+.\de%±(),/ ]*|–)?')
    return [all(number.fullmatch(cell) for cell in column[1:]) for column in columns]


def _fold(line: str) -> str:
    return textwrap.fill(line, WIDTH, initial_indent='  ', subsequent_indent='  ')
