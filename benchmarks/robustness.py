"""Evaluates the shipped policies under each disturbance of world and sensors at three strengths.

    python benchmarks/robustness.py [IDS ...] [--episodes 12] [--seeds SEED ...] [--step-limit 128]
        [--json docs/data/robustness.json] [--page docs/reports/robustness.md]

Every cell has the same seeds, so that terrain and start of an episode are the same with and without
the disturbance. The JSON file is written after every cell, and an unfinished run is resumed; cells of
a policy that is no longer shipped are measured again. The table of the page has the return divided by
that without disturbance.
"""

from __future__ import annotations

import argparse
import math
import pathlib
from typing import Any

import numpy as np
import tqdm

from trl_suite import evaluation, policies
from trl_suite.registry import catalogue
from trl_suite.util import files, tables
from trl_suite.util.digest import digest
from trl_suite.util.program import begin_script

IDS = (
    'PD_Biped2D_LLC_Imitate_Flat-v0', 'MTU_Raptor2D_LLC_Imitate_Flat-v0',
    'PD_Biped2D_Gaps_Terrain-v0', 'PD_Dog2D_Slopes_Mixed_Terrain-v0', 'PD_Raptor2D_Steps_Terrain-v0',
    'PD_Biped3D_Imitate-v0', 'PD_Biped3D_Imitate-Hills_Terrain-v0',
    'PD_Biped3D_LLC_General_Step-v0', 'PD_Biped3D_HLC_Forest-v0',
    'FSM_Dog2D_Terrain_Mixed-v0', 'FSM_Biped2D_Terrain_Gaps-v0',
)  # fmt: skip
SEEDS = 1_000_000, 1_000_001  # no training had these, whose starts and terrains it would have seen
LEVELS = ('mild', 'robot', 'harsh')


def _worlds(name: str, *values: Any) -> list[tuple[str, dict[str, Any]]]:
    return [(_text(value), {'randomize': {name: value}}) for value in values]


def _sensors(name: str, *values: Any, ground: bool = False) -> list[tuple[str, dict[str, Any]]]:
    options = [{'terrain': value} if ground else value for value in values]
    return [
        (_text(value), {'sensors': {name: option}})
        for value, option in zip(values, options, strict=True)
    ]


def _text(value: Any) -> str:
    return ' to '.join(f'{each:g}' for each in np.ravel(value))


# Disturbances: name, unit, whether the ground must be observed, and three strengths with options.
DISTURBANCES: list[tuple[str, str, bool, list[tuple[str, dict[str, Any]]]]] = [
    ('`randomize` preset', '', False, [(name, {'randomize': name}) for name in LEVELS]),
    ('`sensors` preset', '', False, [(name, {'sensors': name}) for name in LEVELS]),
    ('friction', '', False, _worlds('friction', 0.6, 0.4, 0.2)),
    ('mass', 'factor', False, _worlds('mass', 1.1, 1.3, 1.6)),
    ('link_mass', 'factor', False, _worlds('link_mass', (0.9, 1.1), (0.75, 1.25), (0.5, 1.5))),
    ('com_offset', 'm', False, _worlds('com_offset', 0.02, 0.05, 0.1)),
    ('damping', 'factor', False, _worlds('damping', 2.0, 4.0, 8.0)),
    ('gravity', 'm/s²', False, _worlds('gravity', 10.8, 12.8, 15.8)),
    ('slope', 'rad', False, _worlds('slope', (-0.03, 0.03), (-0.1, 0.1), (-0.2, 0.2))),
    ('contact_depth', 'm', False, _worlds('contact_depth', 0.001, 0.003, 0.01)),
    ('contact_time', 's', False, _worlds('contact_time', 0.01, 0.02, 0.04)),
    (
        'push, every 2 s for 0.2 s', 'm/s', False,
        [(f'{speed:g}', {'randomize': {'push': {'speed': speed, 'interval': 2.0}}}) for speed in (0.2, 0.5, 1.0)],
    ),
    (
        'noise', 'of the preset', False,
        [(name, {'sensors': {'preset': name, 'bias': 0.0, 'delay': 0}}) for name in LEVELS],
    ),
    ('bias of all blocks', '', False, _sensors('bias', 0.01, 0.03, 0.1)),
    ('delay of all blocks', 'steps', False, _sensors('delay', 1, 2, 4)),
    ('delay of the ground', 'steps', True, _sensors('delay', 2, 5, 10, ground=True)),
    ('terrain_dropout', '', True, _sensors('terrain_dropout', 0.05, 0.2, 0.5)),
]  # fmt: skip


def cells() -> list[tuple[str, bool, dict[str, Any]]]:
    """Returns key, whether the ground must be observed, and options of every cell."""
    found: list[tuple[str, bool, dict[str, Any]]] = [('none', False, {})]
    for name, _, ground, strengths in DISTURBANCES:
        found += [(f'{name}: {text}', ground, options) for text, options in strengths]
    return found


def run(
    ids: list[str],
    episodes: int,
    seeds: list[int],
    threads: int,
    step_limit: int | None,
    path: pathlib.Path,
) -> dict[str, Any]:
    """Evaluates all cells that the file lacks for the shipped policies; returns all, by seed, id, cell.

    Entry 'of' of a row is the digest of the policy.
    """
    start = {'episodes': episodes, 'step_limit': step_limit, 'seeds': {}}
    with files.changing(path, start, indent=None) as found:
        pass  # what there is
    shipped = {id_: policies.reference(id_) for id_ in ids}
    digests = {id_: digest(policy) for id_, policy in shipped.items()}
    jobs = [(seed, id_, *cell) for seed in seeds for cell in cells() for id_ in ids]
    for seed, id_, key, ground, options in tqdm.tqdm(jobs):
        if key in row_of(found, seed, id_, digests[id_]) or (ground and not _sees_ground(id_)):
            continue
        limits = {} if step_limit is None else {'step_limit': step_limit // _shorter(id_)}
        result = evaluation.evaluate(
            id_, shipped[id_], episodes, seed, threads, {**options, **limits}
        )
        with files.changing(path, start, indent=None) as found:
            row_of(found, seed, id_, digests[id_])[key] = {
                name: result[name]
                for name in ('return', 'return_interval', 'completion_rate', 'distance', 'diverged')
            }
    return found


def row_of(found: dict[str, Any], seed: int, id_: str, policy: str) -> dict[str, Any]:
    """Returns the results of a policy, by its digest; those of others are removed, for all seeds."""
    for rows in found['seeds'].values():
        if id_ in rows and rows[id_].get('of') != policy:
            del rows[id_]
    row: dict[str, Any] = found['seeds'].setdefault(str(seed), {}).setdefault(id_, {})
    row['of'] = policy
    return row


def pooled(found: dict[str, Any], id_: str, key: str) -> tuple[float, float] | None:
    """Returns mean and 95 % confidence interval of the return over all seeds; None without any."""
    rows = [rows[id_] for rows in found['seeds'].values() if id_ in rows]
    results = [row[key] for row in rows if key in row]
    if not results:
        return None
    mean = sum(result['return'] for result in results) / len(results)
    intervals = (result['return_interval'] for result in results)
    half = math.hypot(*(math.nan if each is None else each for each in intervals))
    return mean, half / len(results)


def share(found: dict[str, Any], id_: str, key: str) -> str:
    """Returns the return relative to that without disturbance, over the seeds that have both.

    Below 90 % with a 95 % confidence interval, by the delta method from the intervals of both.
    """
    both = {
        seed: {id_: rows[id_]}
        for seed, rows in found['seeds'].items()
        if key in rows.get(id_, {}) and 'none' in rows[id_]
    }
    mean, none = (pooled({'seeds': both}, id_, each) for each in (key, 'none'))
    if mean is None or none is None:
        return '–'
    ratio = mean[0] / none[0]
    half = math.hypot(mean[1], ratio * none[1]) / none[0]  # nan of a single episode
    shown = round(100 * ratio) < 90 and math.isfinite(half)
    return f'{100 * ratio:.0f}' + (f'±{100 * half:.0f}' if shown else '')


def _shorter(id_: str) -> int:
    """Returns by what the step limit is divided, since steps are cycles or footsteps."""
    return 8 if 'FSM_' in id_ or 'HLC_' in id_ else 1


def _sees_ground(id_: str) -> bool:
    return any(name in id_ for name in ('_Terrain', 'FSM_', 'HLC_'))


def table(found: dict[str, Any]) -> str:
    """Returns the results as Markdown: a table of each family with a row for each disturbance."""
    measured = {id_ for rows in found['seeds'].values() for id_ in rows}
    ids = sorted(measured, key=lambda id_: (IDS.index(id_) if id_ in IDS else len(IDS), id_))
    limit, seeds = found['step_limit'], ', '.join(found['seeds'])
    length = (
        ''
        if limit is None
        else f', at most {limit} steps each, or {limit // 8} cycles and footsteps'
    )
    # An unfinished run has cells that not all seeds have.
    keys = [
        {(id_, key) for id_, row in rows.items() for key in row if key != 'of'}
        for rows in found['seeds'].values()
    ]
    every, any_ = len(set.intersection(*keys)), len(set.union(*keys))
    partly = '' if every == any_ else f' ({any_ - every} of {any_} cells: fewer seeds)'
    lines = [
        f'Mean return of the shipped policies, which were trained without any disturbance, divided by their '
        f'return without it, in percent; three strengths from left to right. {found["episodes"]} episodes for '
        f'each of the seeds {seeds}{partly}{length}; a cell has the same terrains and starts as the others of its '
        'column. Below 90 with a 95 % interval by the delta method, as if the episodes with and without the '
        'disturbance were independent; since they have the same terrains and starts, it is too wide rather than '
        'too narrow. A dash: the ground is not observed. Steps of `FSM` environments are gait cycles, those of '
        '`HLC` footsteps, and so are their delays.',
    ]
    families: dict[str, list[str]] = {}
    for id_ in ids:
        families.setdefault(catalogue.find(id_).domain, []).append(id_)
    for family, of_family in families.items():
        lines += ['', f'### Shipped policies: {family}', '', family_table(found, of_family)]
    return '\n'.join(lines)


def family_table(found: dict[str, Any], ids: list[str]) -> str:
    """Returns one table: a row for each disturbance, a column for each environment."""
    rows = []
    for name, unit, _, strengths in DISTURBANCES:
        shares = [[share(found, id_, f'{name}: {text}') for text, _ in strengths] for id_ in ids]
        if all(set(each) == {'–'} for each in shares):
            continue
        texts = ', '.join(text for text, _ in strengths)
        entries = ['–' if set(each) == {'–'} else ' '.join(each) for each in shares]
        rows.append((name, f'{texts} {unit}'.strip(), *entries))
    none = [pooled(found, id_, 'none') or (math.nan, math.nan) for id_ in ids]
    returns = (f'{mean:.0f} ± {interval:.1f}' for mean, interval in none)
    rows.append(('none: the return itself', '95 % confidence', *returns))
    return tables.markdown_table(('disturbance', 'strengths', *(f'`{id_}`' for id_ in ids)), rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('ids', nargs='*', default=list(IDS))
    parser.add_argument('--episodes', type=int, default=12)
    parser.add_argument('--seeds', type=int, nargs='+', default=list(SEEDS))
    parser.add_argument('--threads', type=int, default=1)
    parser.add_argument(
        '--step-limit', type=int, help='of an episode; gaits and planners: an eighth of it'
    )
    parser.add_argument(
        '--json', type=pathlib.Path, default=pathlib.Path('docs/data/robustness.json')
    )
    parser.add_argument('--page', type=pathlib.Path, help='a page whose table is replaced')
    arguments = parser.parse_args()
    found = run(
        [catalogue.find(name).id for name in arguments.ids], arguments.episodes, arguments.seeds, arguments.threads, arguments.step_limit,
        arguments.json,
    )  # fmt: skip
    text = table(found)
    print(text)
    if arguments.page is not None:
        files.replace_between(arguments.page, 'robustness', 'benchmarks/robustness.py', text)


if __name__ == '__main__':
    begin_script()
    main()
