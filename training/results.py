"""Writes docs/results.md and docs/learning_curves.png from the files in trained/.

    python training/results.py [--check]

Needs `pip install 'trl_suite[video]'` for the picture.
"""

from __future__ import annotations

import argparse
import itertools
import json
import pathlib
import sys
from collections.abc import Iterable
from typing import Any

import numpy as np
import oracle_gaits
import train_all

from trl_suite import policies
from trl_suite.registry import catalogue, terrainrl
from trl_suite.util import resources
from trl_suite.util.program import begin_script

DOCS = pathlib.Path(__file__).resolve().parents[1] / 'docs'
MODELS = {'position': 'PD', 'torque': 'torque', 'muscle': 'muscle', 'velocity': 'velocity'}
MILESTONES = (0.5, 0.8, 0.9)  # fractions of the maximum return
PANELS = {'hierarchical': 'plans', 'flat_control': 'without hierarchy'}  # else by character
LONGEST = 20  # ratio of longest to shortest run in a panel above which its x axis is logarithmic
PLANS = (  # tag, title, text
    (
        'hierarchical',
        '## Planning footsteps',
        'By `training/evaluate_plans.py`: episodes of 200 s, seed 0, with the scripted and the reference policy, '
        'and the expert that was imitated. *Reward*: normalised, 0 after a fall. *Speed*: towards the goal '
        '(soccer: of the ball), m/s. *Trail*: median distance along it, m. *Ball at goal*: share of the time.',
    ),
    (
        'flat_control',
        '## The same tasks without hierarchy',
        'The same program and episodes. The policies imitate planned footsteps and the controller that tracks '
        'them; with PPO alone: [DeepLoco](reports/deeploco.md#without-hierarchy). The reward includes '
        'imitation of the clip. Goals are reached within 0.5 m instead of 1 m, and on the trail they are one '
        'segment of 2 m ahead instead of up to ten; in soccer, speed is towards the ball.',
    ),
)
PLAN_COLUMNS = (
    'environment', 'policy', 'episodes', 'reward', 'no fall in 60 s', 'no fall', 'speed',
    'goals per minute', 'trail', 'ball at goal', 'falls per km',
)  # fmt: skip


def load() -> dict[str, dict[str, Any]]:
    """Returns the contents of `trained/ID.json` by id, in the catalogue's order."""
    folder = resources.directory('trained')
    paths = {id_: folder / f'{id_}.json' for id_ in catalogue.BY_ID}
    return {id_: json.loads(p.read_text()) for id_, p in paths.items() if p.exists()}


def million(samples: float) -> str:
    return f'{samples / 1e6:.2g} M'


def reached(run: dict[str, Any], fraction: float) -> float | None:
    """Returns the samples after which an evaluation first reached a fraction of the maximum."""
    return next((p['samples'] for p in run['curve'] if p['normalized_return'] >= fraction), None)


def table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    head = list(head)
    lines = [head, ['---', *['--:'] * (len(head) - 1)], *map(list, rows)]
    return '\n'.join(f'| {" | ".join(line)} |' for line in lines)


def environment_row(id_: str, entry: dict[str, Any]) -> list[str]:
    run = train_all.shipped(entry)
    found = run['evaluation']
    minutes = sum(run['curve'][-1]['seconds'].values()) / 60
    interval = found['return_interval'] / found['step_limit']
    return [
        f'`{id_}`',
        f'{found["normalized_return"]:.3f} ± {interval:.3f}',
        f'{found["completion_rate"]:.0%}',
        f'{found["distance"]:.1f}',
        million(run['curve'][-1]['samples']),
        f'{minutes:.0f}',
        str(run['seed']),
        f'`{start}`' if (start := run['settings'].get('start')) else '–',
    ]


def comparison_rows(entries: dict[str, dict[str, Any]]) -> list[list[str]]:
    rows = []
    for id_, entry in entries.items():
        spec, runs = catalogue.BY_ID[id_], entry['runs']
        if not train_all.compared(spec):
            continue
        fractions = [run['evaluation']['normalized_return'] for run in runs]
        cells = [f'{spec.character}, {MODELS[spec.actuation]}', str(len(runs))]
        cells += [
            f'{np.mean(fractions):.3f}',
            ' '.join(f'{fraction:.3f}' for fraction in fractions),
            f'{np.mean([run["evaluation"]["completion_rate"] for run in runs]):.0%}',
        ]
        for milestone in MILESTONES:
            when = [reached(run, milestone) for run in runs]
            arrived = [w for w in when if w is not None]
            cells.append(
                f'{million(np.mean(arrived))}'
                + (f' ({len(arrived)} of {len(when)})' if len(arrived) < len(when) else '')
                if arrived
                else '–'
            )
        rows.append(cells)
    return rows


def gait_rows(entries: dict[str, dict[str, Any]]) -> list[list[str]]:
    """Returns lines that compare trained with default gaits, on the same terrain."""
    path = resources.directory('trained') / 'default_gaits.json'
    stored = json.loads(path.read_text()) if path.exists() else {}
    rows = []
    for id_, entry in entries.items():
        if catalogue.BY_ID[id_].actuation != 'gait' or id_ not in stored:
            continue
        run = train_all.shipped(entry)
        own, default = (
            float(np.median(each['distances'])) for each in (run['evaluation'], stored[id_])
        )
        low, high = run['evaluation']['distance_interval']
        rows.append([
            f'`{id_}`', f'{own:.1f}', f'{default:.1f}', f'{own / default:.1f}',
            f'{run["evaluation"]["distance"]:.1f} ({low:.1f} to {high:.1f})',
            f'{stored[id_]["distance"]:.1f}', f'{run["evaluation"]["speed"]:.2f}',
            f'{run["curve"][-1]["samples"] / 1e3:.0f} k', str(run['seed']),
        ])  # fmt: skip
    return rows


def shared_rows() -> list[list[str]]:
    """Returns the results of policies that are shipped for further environments."""
    path = resources.directory('trained') / policies.SHARED
    rows = []
    for id_, entry in (json.loads(path.read_text()) if path.exists() else {}).items():
        own, before = entry['evaluation'], entry['before']
        low, high = own['distance_interval']
        preference = f'{entry["preference"]:g}' if 'preference' in entry else '–'
        rows.append([
            f'`{id_}`', f'`{entry["policy"]}`', preference, f'{own["distance"]:.0f} ({low:.0f} to {high:.0f})',
            f'{own["median_distance"]:.0f}', f'{own["speed"]:.2f}', f'{before["distance"]:.0f}',
            str(own['episodes']), f'{own["completion_rate"]:.0%}',
        ])  # fmt: skip
    return rows


def oracle_rows() -> list[list[str]]:
    """Returns the shares of falls that other actions prevent, one to five cycles earlier."""
    path = resources.directory('trained') / 'oracles.json'
    rows = []
    for id_, found in (json.loads(path.read_text()) if path.exists() else {}).items():
        shares = [
            ' '.join(f'{share:.0%}' for share in found[kind]['prevented']) if kind in found else '–'
            for kind in ('base', 'random', 'nudged')
        ]
        rows.append([f'`{id_}`', str(found['falls']), *shares, f'{found["ever_prevented"]:.0%}'])
    return rows


def fall_rows() -> list[list[str]]:
    """Returns the shares of falls that noise prevents, by the time before the end."""
    path = resources.directory('trained') / 'oracle_falls.json'
    rows = []
    for id_, found in (json.loads(path.read_text()) if path.exists() else {}).items():
        shares = [
            ' '.join(f'{share:.0%}' for share in each['prevented'])
            for each in found['noise'].values()
        ]
        rows.append([f'`{id_}`', str(found['falls']), *shares])
    return rows


# Keys of `trained/generalist/ID.json` with evaluations.
GENERALISTS = 'specialists', 'distilled', 'trained', 'averaged'


def generalist_rows() -> list[list[str]]:
    """Returns the results of the policies for all terrains of a character, and of its specialists."""
    rows = []
    for path in sorted((resources.directory('trained') / 'generalist').glob('PD_*.json')):
        entry = json.loads(path.read_text())
        shipped = entry['shipped']
        kinds = [kind for kind in GENERALISTS if kind in entry]  # the newest kind is not in all
        unknown = ['–'] * (len(GENERALISTS) - len(kinds))
        for id_ in entry['ids']:
            each = {kind: entry[kind][id_] for kind in kinds}
            cells = [
                f'{r["normalized_return"]:.3f} ({r["completion_rate"]:.0%})' for r in each.values()
            ]
            share = each[shipped]['return'] / each['specialists']['return']
            rows.append([f'`{id_}`', *cells, *unknown, f'{share:.2f}'])
        means = {
            kind: np.mean([entry[kind][id_]['normalized_return'] for id_ in entry['ids']])
            for kind in kinds
        }
        share = means[shipped] / means['specialists']
        rows.append(['mean', *(f'{mean:.3f}' for mean in means.values()), *unknown, f'{share:.2f}'])
    return rows


def footstep_rows() -> list[list[str]]:
    path = resources.directory('trained') / 'footsteps.json'
    if not path.exists():
        return []
    return [
        [
            name, str(found['episodes']), f'{found["survived"]:.0%}', f'{found["normalized_return"]:.3f}',
            f'{found["landing"]:.3f}', f'{found["landing_90"]:.3f}', f'{found["heading"]:.3f}',
        ]
        for name, found in json.loads(path.read_text())['conditions'].items()
    ]  # fmt: skip


def transfer_rows(entries: dict[str, dict[str, Any]]) -> list[list[str]]:
    path = resources.directory('trained') / 'transfer.json'
    if not path.exists():
        return []
    rows = []
    for id_, flat in json.loads(path.read_text()).items():
        if id_ in entries:
            own = train_all.shipped(entries[id_])['evaluation']
            rows.append([
                f'`{id_}`', f'{own["distance"]:.1f}', f'{flat["distance"]:.1f}',
                f'{own["distance"] / flat["distance"]:.1f}', f'{own["completion_rate"]:.0%}',
                f'{flat["completion_rate"]:.0%}',
            ])  # fmt: skip
    return rows


def plan_rows(tag: str) -> list[list[str]]:
    """Returns the results of `training/evaluate_plans.py` for the environments with a tag."""
    path = resources.directory('trained') / 'plans.json'
    if not path.exists():
        return []
    return [
        [
            f'`{id_}`', name, str(found['episodes']), f'{found["reward"]:.2f}',
            f'{found["survived_minute"]:.0%}', f'{found["survived"]:.0%}', f'{found["speed"]:.2f}',
            '–' if 'Soccer' in id_ else f'{found["goals_per_minute"]:.1f}',
            f'{found["trail"]:.0f}' if found['trail'] else '–',
            f'{found["at_goal"]:.0%}' if 'Soccer' in id_ else '–', f'{found["falls_per_km"]:.1f}',
        ]
        for id_, each in json.loads(path.read_text()).items()
        if tag in catalogue.BY_ID[id_].tags
        for name, found in each.items()
    ]  # fmt: skip


def page(entries: dict[str, dict[str, Any]]) -> str:
    runs = [run for entry in entries.values() for run in entry['runs']]
    episodes = sorted({run['evaluation']['episodes'] for run in runs})
    parts = [
        '# Results',
        f'A policy is shipped for {len(policies.available())} of {len(catalogue.BY_ID)} environments: '
        '`suite.reference_policy(id)`. This page is written by `training/results.py` from the '
        f'{len(runs)} runs in `trained/`, which `training/train_all.py` repeats. A `note` in the file of a run says '
        'where it differs from the settings there. Claims of the papers: [reports](reports/README.md).',
        f'Policies are evaluated without noise, in {" or ".join(map(str, episodes))} episodes (gaits on other '
        'terrains: column *episodes*) that are used neither in training nor to select a policy of the curve. Of '
        'several seeds the best one in these episodes is shipped; all seeds: *Actuation models*. *Return* is '
        'divided by its maximum; the reward is 0 after a fall. *Complete*: share of episodes that last to the '
        'end (256 steps; planned footsteps 200 s). *Distance*: mean, m. *Minutes*: wall time of the run, one '
        'thread of a shared machine. *Initial policy*: where training starts, its samples '
        'not included; or what is imitated first, samples included: `scripted`, the hand-written policy; `expert`, an '
        '[expert with a map](../training/expert.py); `joint_expert`, planned footsteps and the '
        '[controller that tracks them](../training/joint_expert.py).',
        '## Environments with a policy, except gaits',
        table(
            ('environment', 'return, 95 %', 'complete', 'distance', 'samples', 'minutes', 'seed',
             'initial policy'),
            (
                environment_row(id_, entry)
                for id_, entry in entries.items()
                if catalogue.BY_ID[id_].actuation != 'gait'
            ),
        ),
        '![Learning curves](learning_curves.png)',
        'Learning curves, evaluated without noise; faint: other seeds.',
        '## Actuation models',
        'Means over seeds, and the samples after which the policy first reaches 0.5, 0.8 and 0.9 of the maximum, '
        'averaged over the seeds that do (evaluated every 0.1 M samples).',
        table(
            ('character, actuation', 'seeds', 'return', 'each', 'complete', 'to 0.5', 'to 0.8',
             'to 0.9'),
            comparison_rows(entries),
        ),
    ]  # fmt: skip
    rows = gait_rows(entries)
    if rows:
        parts += [
            '## Gaits',
            'Median and mean distance in m before a fall, of the trained policy and of the default gait, in the same '
            f'{train_all.GAIT_EPISODES} episodes, which are truncated after {terrainrl.STEP_LIMIT} cycles; speed in '
            'm/s. *Decisions*: simulated cycles of training.',
            table(
                (
                    'environment',
                    'trained',
                    'default',
                    'ratio',
                    'mean',
                    'default',
                    'speed',
                    'decisions',
                    'seed',
                ),
                rows,
            ),
        ]
    rows = shared_rows()
    if rows:
        parts += [
            '## Gaits on other terrains',
            'Policies that are shipped for further environments, by `training/share_gaits.py`. *Before*: mean of the '
            'policy that is replaced, or else of the default gait, in the same episodes. *Preference*: added to the '
            f'value of the default gait. *Truncated*: share of episodes that last {terrainrl.STEP_LIMIT} cycles; '
            'where it is high, the distance to a fall is longer.',
            table(
                (
                    'environment',
                    'policy of',
                    'preference',
                    'mean, 95 %',
                    'median',
                    'speed',
                    'before',
                    'episodes',
                    'truncated',
                ),
                rows,
            ),
        ]
    rows = oracle_rows()
    if rows:
        parts += [
            '## Falls of gaits that other actions prevent',
            'By `training/oracle_gaits.py`: the share of falls that some action prevents, taken for one cycle one, two, '
            f'... five cycles before the end; the character then gets {oracle_gaits.PASSED:g} m beyond the place of '
            f'the fall, or {oracle_gaits.PASSED_CYCLES} of its mean cycles if shorter, within '
            f'{oracle_gaits.MOST_CYCLES} cycles. *Base*: every base action (7 to 18: more tries prevent more falls); *random*: eight base actions with noise; '
            '*nudged*: joint angles changed by 0.001 rad, eight times; *any*: at any time. Where base actions prevent '
            'more than nudges, the selection is the limit; else falls depend on what the policy cannot observe.',
            table(('environment', 'falls', 'base', 'random', 'nudged', 'any'), rows),
        ]
    rows = fall_rows()
    if rows:
        parts += [
            '## Falls of tracking policies that other actions prevent',
            'By `training/oracle_falls.py`: the share of falls that noise in the actions prevents in any of 32 tries, '
            'if it begins 0.25, 0.5, 1 and 1.5 s before the end; by its standard deviation in units of the '
            'action, of which 0.001 shows what is a matter of chance. Where noise prevents a fall, neither the '
            'clip nor the torque limits are its reason.',
            table(('environment', 'falls', '0.001', '0.15', '0.5'), rows),
        ]
    rows = generalist_rows()
    if rows:
        parts += [
            '## One policy for all terrains',
            'By `training/generalist.py` (`--policy generalist`), 200 episodes, seed 0: return, divided by the maximum, '
            'and share of complete episodes, of the specialists, of the policy distilled from them, of the same '
            'after PPO on all terrains, and of the mean weights of both. *Share*: that of the best one, which is '
            'shipped, divided by that of the specialist.',
            table(
                ('environment', 'specialist', 'distilled', 'after PPO', 'mean weights', 'share'),
                rows,
            ),
        ]
    rows = footstep_rows()
    if rows:
        parts += [
            '## Footstep tracking',
            'By `training/evaluate_footsteps.py`, episodes of 20 s, seed 0: landing error in m, mean and 90th '
            'percentile, and mean heading error in rad. *General*: the plans of the environment, with sharp turns; '
            '*made from the root*: relative to the root, as in the high-level environments; *pushes*: forces on the '
            'torso for 0.2 s every 3 s; *belts*: 2 m wide, 1 m apart.',
            table(
                ('condition', 'episodes', 'survived', 'reward', 'landing', '90 %', 'heading'), rows
            ),
        ]
    for tag, title, words in PLANS:
        rows = plan_rows(tag)
        if rows:
            parts += [title, words, table(PLAN_COLUMNS, rows)]
    rows = transfer_rows(entries)
    if rows:
        parts += [
            '## Does training on terrain help?',
            'Beside the policy that is trained on flat ground with the same observation, in the same episodes.',
            table(
                ('environment', 'distance, own', 'flat policy', 'ratio', 'complete, own',
                 'flat policy'),
                rows,
            ),
        ]  # fmt: skip
    return '\n\n'.join(parts) + '\n'


def plot(entries: dict[str, dict[str, Any]], path: pathlib.Path) -> None:
    import matplotlib

    matplotlib.use('Agg')
    from matplotlib import pyplot

    panels: dict[tuple[str, str], list[str]] = {}
    for id_ in entries:
        spec = catalogue.BY_ID[id_]
        if spec.actuation != 'gait':  # gaits are scored by distance
            name = next((name for tag, name in PANELS.items() if tag in spec.tags), spec.character)
            panels.setdefault((spec.domain, name), []).append(id_)
    columns = 3
    count = -(-len(panels) // columns)
    figure, axes = pyplot.subplots(
        count, columns, figsize=(13, 4.2 * count), squeeze=False, sharey=True
    )
    for axis, ((domain, name), ids) in zip(axes.flat, panels.items(), strict=False):
        axis.set_title(f'{domain}: {name}')
        colours = pyplot.get_cmap('tab10' if len(ids) <= 10 else 'tab20').colors
        for colour, id_ in zip(itertools.cycle(colours), ids, strict=False):
            spec = catalogue.BY_ID[id_]
            for run in entries[id_]['runs']:
                ship = run['seed'] == entries[id_]['shipped']
                axis.plot(
                    [p['samples'] / 1e6 for p in run['curve']],
                    [p['normalized_return'] for p in run['curve']],
                    color=colour, alpha=1 if ship else 0.4, linewidth=1.2,
                    label=spec.task if ship else None,
                )  # fmt: skip
        lengths = [run['curve'][-1]['samples'] for id_ in ids for run in entries[id_]['runs']]
        if max(lengths) > LONGEST * min(lengths):
            axis.set_xscale('log')
        else:
            axis.set_xlim(left=0)
        axis.set_ylim(0, 1)
        axis.grid(alpha=0.3)
        axis.legend(fontsize=7, loc='best')
        axis.set_xlabel(f'{"plans" if name == "plans" else "control steps"}, million')
    for axis in axes[:, 0]:
        axis.set_ylabel('return / maximum, no noise')
    for axis in axes.flat[len(panels) :]:
        axis.set_axis_off()
    figure.tight_layout()
    figure.savefig(path, dpi=80)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        '--check', action='store_true', help='write nothing; fail if the page is out of date'
    )
    arguments = parser.parse_args()
    entries = load()
    text, path = page(entries), DOCS / 'results.md'
    if arguments.check:
        sys.exit(0 if path.exists() and path.read_text() == text else f'{path} is out of date')
    path.write_text(text)
    plot(entries, DOCS / 'learning_curves.png')
    print(path)


if __name__ == '__main__':
    begin_script()
    main()
