"""Writes docs/results.md and docs/learning_curves.png from the files in trained/.

    python training/results.py [--check]

Needs `pip install 'trl_suite[video]'` for the picture.
"""

from __future__ import annotations

import argparse
import itertools
import sys
from collections.abc import Iterable, Iterator
from typing import Any

import evaluate_footsteps
import generalist
import numpy as np
import oracles
import runs
import train_all
from pages import DOCS, picture

from trl_suite import policies
from trl_suite.registry import catalogue
from trl_suite.util import files
from trl_suite.util.program import begin_script
from trl_suite.util.tables import markdown_table as table
from trl_suite.util.tables import share

MODELS = {'position': 'PD', 'torque': 'torque', 'muscle': 'muscle', 'velocity': 'velocity'}
MILESTONES = (0.5, 0.8, 0.9)  # fractions of the maximum return
PANELS = {'hierarchical': 'plans', 'flat_control': 'without hierarchy'}  # else by character
PICTURE = DOCS / 'learning_curves.png'
LONGEST = 20  # ratio of longest to shortest run in a panel above which its x axis is logarithmic
GENERALISTS = 'specialists', 'distilled', 'trained', 'averaged'  # keys of generalist/ID.json
Rows = Iterator[list[str]]


def load() -> dict[str, dict[str, Any]]:
    """Returns the contents of `trained/ID.json` by id, in the catalogue's order."""
    found = ((id_, runs.read(f'{id_}.json')) for id_ in catalogue.BY_ID)
    return {id_: entry for id_, entry in found if entry}


def million(samples: float) -> str:
    return f'{samples / 1e6:.2g} M'


def values(found: Iterable[dict[str, Any]], key: str = 'episodes') -> str:
    """Returns the different values of results, such as '50 or 200'."""
    every = sorted({each[key] for each in found if key in each})
    return ' or '.join(f'{value:g}' if isinstance(value, float) else str(value) for value in every)


def complete(found: dict[str, Any]) -> str:
    return share(found['completion_rate'], found['episodes'])


def environment_rows(entries: dict[str, dict[str, Any]]) -> Rows:
    """Yields the results of the shipped policies, if known in other episodes than those of the choice."""
    for id_, entry in entries.items():
        if catalogue.BY_ID[id_].actuation != 'gait':
            run = train_all.shipped(entry)
            found = entry.get('shipped_again', run['evaluation'])
            scores = [each['evaluation']['normalized_return'] for each in entry['runs']]
            interval = found['return_interval'] / found['step_limit']
            start = run['settings'].get('start')
            yield [
                f'`{id_}`', f'{found["normalized_return"]:.3f} ± {interval:.3f}',
                f'{np.mean(scores):.3f} ({len(scores)})' if len(scores) > 1 else '–',
                complete(found), f'{found["distance"]:.1f}',
                million(run['curve'][-1]['samples']),
                f'{sum(run["curve"][-1]["seconds"].values()) / 60:.0f}', str(run['seed']),
                f'`{start}`' if start else '–',
            ]  # fmt: skip


def model_rows(entries: dict[str, dict[str, Any]]) -> Rows:
    for id_, entry in entries.items():
        spec, every = catalogue.BY_ID[id_], entry['runs']
        if not train_all.compared(spec):
            continue
        scores = [run['evaluation']['normalized_return'] for run in every]
        complete = np.mean([run['evaluation']['completion_rate'] for run in every])
        row = [
            f'{spec.character}, {MODELS[spec.actuation]}', str(len(every)),
            million(every[0]['curve'][-1]['samples']), f'{np.mean(scores):.3f}',
            ' '.join(f'{score:.3f}' for score in scores), f'{complete:.0%}',
        ]  # fmt: skip
        for least in MILESTONES:
            when = [
                next((p['samples'] for p in run['curve'] if p['normalized_return'] >= least), None)
                for run in every
            ]
            arrived = [samples for samples in when if samples is not None]
            some = f' ({len(arrived)} of {len(when)})' if len(arrived) < len(when) else ''
            row.append(million(np.mean(arrived)) + some if arrived else '–')
        yield row


def gait_rows(entries: dict[str, dict[str, Any]]) -> Rows:
    """Yields lines that compare trained with default gaits, in the same episodes."""
    stored = runs.read('default_gaits.json')
    for id_, entry in entries.items():
        if catalogue.BY_ID[id_].actuation == 'gait' and id_ in stored:
            run, default = train_all.shipped(entry), stored[id_]
            found = run['evaluation']
            own, other = (float(np.median(each['distances'])) for each in (found, default))
            low, high = found['distance_interval']
            yield [
                f'`{id_}`', f'{own:.1f}', f'{other:.1f}', f'{own / other:.1f}',
                f'{found["distance"]:.1f} ({low:.1f} to {high:.1f})', f'{default["distance"]:.1f}',
                f'{found["speed"]:.2f}', f'{run["curve"][-1]["samples"] / 1e3:.0f} k', str(run['seed']),
            ]  # fmt: skip


def shared_rows() -> Rows:
    """Yields the results of policies that are shipped for further environments."""
    for id_, entry in runs.read(policies.SHARED).items():
        found = entry.get('shipped_again', entry['evaluation'])
        low, high = found['distance_interval']
        yield [
            f'`{id_}`', f'`{entry["policy"]}`',
            f'{entry["preference"]:g}' if 'preference' in entry else '–',
            f'{found["distance"]:.0f} ({low:.0f} to {high:.0f})', f'{found["median_distance"]:.0f}',
            f'{found["speed"]:.2f}', str(found['episodes']), complete(found),
        ]  # fmt: skip


def percent(shares: Iterable[float]) -> str:
    return ' '.join(f'{share:.0%}' for share in shares)


def oracle_rows() -> Rows:
    """Yields the shares of falls that other actions prevent, one to five cycles earlier."""
    for id_, found in runs.read('oracles.json').items():
        kinds = (found.get(kind) for kind in ('base', 'random', 'nudged'))
        shares = [percent(each['prevented']) if each else '–' for each in kinds]
        ever = share(found['ever_prevented'], found['falls'])
        yield [f'`{id_}`', str(found['falls']), *shares, ever]


def fall_rows() -> Rows:
    """Yields the shares of falls that noise prevents, by the time before the end."""
    for id_, found in runs.read('oracle_falls.json').items():
        for k, seconds in enumerate(found['seconds']):
            shares = (
                share(each['prevented'][k], found['falls']) for each in found['noise'].values()
            )
            yield [f'`{id_}`', str(found['falls']), f'{seconds:g}', *shares]


def generalist_rows(entries: Iterable[dict[str, Any]]) -> Rows:
    """Yields the results of the policies for all terrains of a character, and of its specialists."""
    for entry in entries:
        kinds = [kind for kind in GENERALISTS if kind in entry]  # the newest kind is not in all
        unknown = ['–'] * (len(GENERALISTS) - len(kinds))
        shipped, specialists = (
            entry.get(f'{name}_again', entry[kind])
            for name, kind in (('shipped', entry['shipped']), ('specialists', 'specialists'))
        )
        for id_ in entry['ids']:
            each = {kind: entry[kind][id_] for kind in kinds}
            cells = [f'{r["normalized_return"]:.3f}, {complete(r)}' for r in each.values()]
            part = shipped[id_]['return'] / specialists[id_]['return']
            yield [f'`{id_}`', *cells, *unknown, f'{part:.2f}']
        means = {kind: generalist.mean_score(entry[kind]) for kind in kinds}
        part = generalist.mean_score(shipped) / generalist.mean_score(specialists)
        yield ['mean', *(f'{mean:.3f}' for mean in means.values()), *unknown, f'{part:.2f}']


def footstep_rows() -> Rows:
    for name, found in runs.read('footsteps.json').get(evaluate_footsteps.ID, {}).items():
        errors = (f'{found[key]:.3f}' for key in ('landing', 'landing_90', 'heading'))
        lasting = share(found['survived'], found['episodes'])
        score = f'{found["normalized_return"]:.3f}'
        yield [name, str(found['episodes']), lasting, score, *errors]


def plan_rows(tag: str) -> Rows:
    """Yields the results of `evaluate_plans.py` for the environments with a tag."""
    for id_, each in runs.read('plans.json').items():
        soccer = 'Soccer' in id_
        for name, found in each.items() if tag in catalogue.BY_ID[id_].tags else ():
            lasting = (
                share(found[key], found['episodes']) for key in ('survived_minute', 'survived')
            )
            yield [
                f'`{id_}`', name, str(found['episodes']), f'{found["reward"]:.2f}',
                *lasting, f'{found["speed"]:.2f}',
                '–' if soccer else f'{found["goals_per_minute"]:.1f}',
                f'{found["trail"]:.0f}' if found['trail'] else '–',
                f'{found["at_goal"]:.0%}' if soccer else '–', f'{found["falls_per_km"]:.1f}',
            ]  # fmt: skip


def transfer_rows(entries: dict[str, dict[str, Any]]) -> Rows:
    for id_, flat in runs.read('transfer.json').items():
        if id_ in entries:
            own = train_all.shipped(entries[id_])['evaluation']
            yield [
                f'`{id_}`', f'{own["distance"]:.1f}', f'{flat["distance"]:.1f}',
                f'{own["distance"] / flat["distance"]:.1f}', complete(own), complete(flat),
            ]  # fmt: skip


PLAN_COLUMNS = (
    'environment', 'policy', 'episodes', 'reward', 'no fall in 60 s', 'no fall', 'speed',
    'goals per minute', 'trail', 'ball at goal', 'falls per km',
)  # fmt: skip


def sections(entries: dict[str, dict[str, Any]]) -> list[tuple[str, str, tuple[str, ...], Rows]]:
    """Returns title, text, head and rows of each section; without rows it is omitted."""
    gaits = [
        run['evaluation']
        for id_, entry in entries.items()
        for run in entry['runs']
        if catalogue.BY_ID[id_].actuation == 'gait'
    ]
    shared = [entry['evaluation'] for entry in runs.read(policies.SHARED).values()]
    falls = runs.read('oracles.json').values()
    tries = {
        kind: values((found.get(kind, {}) for found in falls), 'actions')
        for kind in ('base', 'random', 'nudged')
    }
    tracking = runs.read('oracle_falls.json').values()
    paths = sorted(runs.place('generalist').glob('PD_*.json'))
    generalists = [runs.read(f'generalist/{path.name}') for path in paths]
    of_terrains = [found for entry in generalists for found in entry['specialists'].values()]
    footsteps = runs.read('footsteps.json').get(evaluate_footsteps.ID, {}).values()
    plans = [found for each in runs.read('plans.json').values() for found in each.values()]
    flat = runs.read('transfer.json').values()
    widths = '; '.join(
        f'of {count} falls, {share(0, count)} and {share(0.5, count)}'
        for count in sorted({found['falls'] for found in falls})
    )
    return [
        (
            'Gaits',
            'Median and mean distance in m before a fall, of the trained policy and of the default gait, in the same '
            f'{values(gaits)} episodes, which are truncated after {values(gaits, "step_limit")} cycles; speed in '
            'm/s. *Cycles*: simulated in training.',
            ('environment', 'trained', 'default', 'ratio', 'mean', 'default', 'speed', 'cycles', 'seed'),
            gait_rows(entries),
        ),
        (
            'Gaits on other terrains',
            'Policies that are shipped for further environments, by `training/share_gaits.py`. *Preference*: added to '
            'the value of the default gait. *Truncated*: share of episodes that last '
            f'{values(shared, "step_limit")} cycles; where it is high, the distance to a fall is longer.',
            ('environment', 'policy of', 'preference', 'mean, 95 %', 'median', 'speed', 'episodes', 'truncated'),
            shared_rows(),
        ),
        (
            'Falls of gaits that other actions prevent',
            'By `training/oracles.py`: the share of falls that some action prevents, taken for one cycle one, two, '
            f'... five cycles before the end; the character then gets {oracles.PASSED:g} m beyond the place of '
            f'the fall, or {oracles.PASSED_CYCLES} of its mean cycles if shorter, within '
            f'{oracles.MOST_CYCLES} cycles. *Base*: every base action '
            f'({tries["base"]}; more of them prevent more falls); *random*: '
            f'{tries["random"]} base actions with noise; *nudged*: joint angles changed '
            f'by 0.001 rad, {tries["nudged"]} times; *any*: at any time, with its 95 % '
            f'interval (Wilson). The other columns are as uncertain: {widths}. Where base actions prevent '
            'more than nudges, the selection is the limit; else falls depend on what the policy cannot observe.',
            ('environment', 'falls', 'base', 'random', 'nudged', 'any'),
            oracle_rows(),
        ),
        (
            'Falls of tracking policies that other actions prevent',
            f'By `training/oracles.py`: the share of falls that noise in the actions prevents in any of {values(tracking, "tries")} '
            'tries, with its 95 % interval (Wilson), if it begins some seconds before the end; by its standard '
            'deviation in units of the action, of which 0.001 shows what is a matter of chance. Where noise '
            'prevents a fall, neither the clip nor the torque limits are its reason.',
            ('environment', 'falls', 'seconds', *next(iter(tracking), {'noise': ()})['noise']),
            fall_rows(),
        ),
        (
            'One policy for all terrains',
            f'By `training/generalist.py` (`--policy generalist`), {values(of_terrains)} episodes, seed {values(of_terrains, "seed")}: return, divided by the maximum, '
            'and share of complete episodes with its 95 % interval, of the specialists, of the policy distilled from them, of the same '
            'after PPO on all terrains, and of the mean weights of both. *Share*: that of the best one, which is '
            'shipped, divided by that of the specialist.',
            ('environment', 'specialist', 'distilled', 'after PPO', 'mean weights', 'share'),
            generalist_rows(generalists),
        ),
        (
            'Footstep tracking',
            f'By `training/evaluate_footsteps.py`, episodes of {values(footsteps, "seconds")} s, seed {values(footsteps, "seed")}: landing error in m, mean and 90th '
            'percentile, and mean heading error in rad. *General*: the plans of the environment, with sharp turns; '
            '*made from the root*: anew at every footstep, from the stance foot and the heading of the root; *pushes*: forces on the '
            'torso for 0.2 s every 3 s; *belts*: 2 m wide, 1 m apart.',
            ('condition', 'episodes', 'no fall', 'reward', 'landing', '90 %', 'heading'),
            footstep_rows(),
        ),
        (
            'Planning footsteps',
            f'By `training/evaluate_plans.py`: episodes of 200 s, seed {values(plans, "seed")}, with the scripted and the reference policy, '
            'and the expert that was imitated. *With ID*: on another footstep controller; *fine-tuned*: trained '
            'further on it, not shipped; *one planner*: on several, see '
            '[DeepLoco](reports/deeploco.md#a-planner-on-another-controller). *Reward*: normalised, 0 after a fall. '
            '*No fall*: share of episodes, with its 95 % interval (Wilson). *Speed*: towards the goal (soccer: of the ball), m/s. *Trail*: median distance along it, m. *Ball at goal*: share of the time.',
            PLAN_COLUMNS, plan_rows('hierarchical'),
        ),
        (
            'The same tasks without hierarchy',
            'The same program and episodes. The policies imitate planned footsteps and the controller that tracks '
            'them; with PPO alone: [DeepLoco](reports/deeploco.md#without-hierarchy). The reward includes '
            'imitation of the clip. Goals are reached within 0.5 m instead of 1 m, and on the trail they are one '
            'segment of 2 m ahead instead of up to ten, so that the speed towards them says little there.',
            PLAN_COLUMNS, plan_rows('flat_control'),
        ),
        (
            'Does training on terrain help?',
            f'Compared in the same {values(flat)} episodes with the policy for flat ground, which has the same observation.',
            ('environment', 'distance, own', 'flat policy', 'ratio', 'complete, own', 'flat policy'),
            transfer_rows(entries),
        ),
    ]  # fmt: skip


def page(entries: dict[str, dict[str, Any]]) -> str:
    every = [run['evaluation'] for entry in entries.values() for run in entry['runs']]
    parts = [
        '# Results',
        f'A policy is shipped for {len(policies.available())} of {len(catalogue.BY_ID)} environments: '
        '`suite.reference_policy(id)`. This page is written by `training/results.py` from the '
        f'{len(every)} runs in `trained/`, which `training/train_all.py` repeats. The file of a run has its settings; a '
        '`note` says where it departed from them. Claims of the papers: [reports](reports/README.md).',
        f'Policies are evaluated without noise, in {values(every)} episodes (gaits on other '
        'terrains: column *episodes*) that are used neither in training nor to select a policy of the curve. Where '
        'there are several seeds, the best one is shipped; its return is that in episodes that had no part in this choice, '
        'beside the mean and the number of all seeds. Other policies that were chosen among runs, terrains or '
        'kinds in the episodes of their row have slightly too high scores there. *Return* is '
        'divided by its maximum; the reward is 0 after a fall; its intervals are too narrow where '
        'falls are too rare to occur in these episodes. *Complete*: share of episodes that last to the '
        'end (256 steps; planning environments 200 s), with its 95 % interval (Wilson). *Distance*: mean, m. *Minutes*: wall time of the run, one '
        'thread of a shared machine. *Initial policy*: where training starts, its samples '
        'not included; or what is imitated first, samples included: `scripted`, the hand-written policy; `expert` and '
        '`joint_expert`, [experts with a map](../training/expert.py) for footsteps and for joint targets; `nominal`, '
        'the policy of `PD_Biped3D_LLC_General_Step-v0`.',
        '## Environments except gaits',
        table(
            ('environment', 'return, 95 %', 'mean of seeds', 'complete', 'distance', 'samples', 'minutes',
             'seed', 'initial policy'),
            environment_rows(entries),
        ),
        '![Learning curves](learning_curves.png)',
        'Learning curves, evaluated without noise; faint: other seeds.',
        '## Actuation models',
        'Means over seeds, and the samples after which the policy first reaches 0.5, 0.8 and 0.9 of the maximum, '
        'averaged over the seeds that do (evaluated every 0.1 M samples).',
        table(
            ('character, actuation', 'seeds', 'samples', 'return', 'each', 'complete', 'to 0.5', 'to 0.8', 'to 0.9'),
            model_rows(entries),
        ),
    ]  # fmt: skip
    for title, text, head, found in sections(entries):
        if rows := list(found):
            parts += [f'## {title}', text, table(head, rows)]
    return '\n\n'.join(parts) + '\n'


def plot(entries: dict[str, dict[str, Any]]) -> None:
    from matplotlib import colormaps

    panels: dict[tuple[str, str], list[str]] = {}
    for id_ in entries:
        spec = catalogue.BY_ID[id_]
        if spec.actuation != 'gait':  # gaits are scored by distance
            name = next((name for tag, name in PANELS.items() if tag in spec.tags), spec.character)
            panels.setdefault((spec.domain, name), []).append(id_)
    rows = -(-len(panels) // 3)
    with picture(PICTURE, rows, 3, figsize=(13, 4.2 * rows), sharey=True) as (_, axes):
        for axis, ((domain, name), ids) in zip(axes.flat, panels.items(), strict=False):
            lengths = []
            colours = colormaps['tab10' if len(ids) <= 10 else 'tab20'].colors
            for colour, id_ in zip(itertools.cycle(colours), ids, strict=False):
                for run in entries[id_]['runs']:
                    ship = run['seed'] == entries[id_]['shipped']
                    points = [(p['samples'] / 1e6, p['normalized_return']) for p in run['curve']]
                    label = catalogue.BY_ID[id_].task if ship else None
                    axis.plot(
                        *np.transpose(points),
                        color=colour,
                        alpha=1 if ship else 0.4,
                        lw=1.2,
                        label=label,
                    )
                    lengths.append(points[-1][0])
            if max(lengths) > LONGEST * min(lengths):
                axis.set_xscale('log')
            else:
                axis.set_xlim(left=0)
            unit = 'plans' if name == 'plans' else 'control steps'
            axis.set(title=f'{domain}: {name}', ylim=(0, 1), xlabel=f'{unit}, million')
            axis.grid(alpha=0.3)
            axis.legend(fontsize=7, loc='best')
        for axis in axes[:, 0]:
            axis.set_ylabel('return / maximum, no noise')
        for axis in axes.flat[len(panels) :]:
            axis.set_axis_off()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        '--check', action='store_true', help='write nothing; fail if the page is out of date'
    )
    arguments = parser.parse_args()
    entries = load()
    text, path = page(entries), DOCS / 'results.md'
    if arguments.check:
        old = path.read_text(encoding='utf-8') if path.exists() else ''
        sys.exit(0 if old == text else f'{path} is out of date')
    files.write_text(text, path)
    plot(entries)
    print(path)


if __name__ == '__main__':
    begin_script()
    main()
