"""Trains shipped policies further in worlds and with sensors that vary, for `trained/randomized`.

    python training/train_randomized.py                       # all that are missing
    python training/train_randomized.py Torque_Dog2D_LLC_Imitate_Flat-v0 --overwrite
    python training/train_randomized.py --page docs/reports/robustness.md  # also writes its table

Each run is `training/ppo.py` on one thread, with the settings `RANDOMIZED` of `settings.py`,
starting from the shipped policy. Interrupted runs continue from their checkpoints in RUNS. The policy
with the best score of the learning curve, whose evaluations have the same disturbances, becomes
`trained/randomized/ID.npz`. It and the shipped policy are then evaluated without disturbances
and with each preset of both `randomize` and `sensors`, in the same episodes, and settings, curve and
results are written to `trained/randomized/ID.json`. The environment variable TRL_SUITE_TRAINED selects
another folder than `trained`.
"""

from __future__ import annotations

import argparse
import pathlib
from typing import Any

import ppo
import runs
import tqdm
from networks import trimmed
from settings import RANDOMIZED, randomized_settings_for
from train_all import SEED

from trl_suite import evaluation, policies
from trl_suite.util import errors, files, tables
from trl_suite.util.digest import digest
from trl_suite.util.program import begin_script

EPISODES = 64  # of each evaluation
CONDITIONS: dict[str, dict[str, Any]] = {
    'none': {},
    **{name: {'randomize': name, 'sensors': name} for name in ('mild', 'robot', 'harsh')},
}
RESULTS = ('return', 'return_interval', 'completion_rate', 'distance', 'episodes', 'seed')
TITLES = {'before': 'shipped', 'evaluations': 'randomized, `{}`'}  # of the policies


def place(id_: str) -> str:
    """Returns the name of the results of an environment; the policy is beside it, as .npz."""
    return f'randomized/{id_}.json'


def train(id_: str, seed: int, output: pathlib.Path) -> None:
    """Trains, and writes the policy with settings and curve."""
    folder = output / id_ / f'seed_{seed}'
    ppo.train(id_, seed, randomized_settings_for(id_), folder, threads=1)
    policy = trimmed(policies.load(folder / 'policy.npz'))
    entry = {
        **files.read_json(folder / 'curve.json'), 'machine': runs.machine(),
        'shipped_at': policy.info['samples'],
    }  # fmt: skip
    policies.save(policy, runs.place(place(id_)).with_suffix('.npz'))
    runs.write(place(id_), entry)  # last: what is entered is not trained again


def measure(id_: str) -> dict[str, Any]:
    """Evaluates where results of the present policies are missing; returns all of an environment."""
    entry = runs.read(place(id_))
    for name, variant in (('evaluations', 'randomized'), ('before', '')):
        policy = policies.reference(id_, variant)
        own = digest(policy)
        for condition, options in CONDITIONS.items():
            if condition not in results_of(entry, name, own):
                result = evaluation.evaluate(id_, policy, EPISODES, SEED, 1, options)
                with runs.changing(place(id_)) as entry:
                    found = results_of(entry, name, own)
                    found[condition] = {key: result[key] for key in RESULTS}
    return entry


def results_of(entry: dict[str, Any], name: str, policy: str) -> dict[str, Any]:
    """Returns the results of a policy, by its digest; those of another one are removed."""
    of = entry.setdefault('of', {})
    if of.get(name) != policy:
        of[name], entry[name] = policy, {}
    return entry.setdefault(name, {})


def preset(entry: dict[str, Any]) -> str:
    """Returns the preset with which a policy was trained."""
    return str(entry['settings']['evaluated_with']['randomize'])


def table(entries: list[dict[str, Any]]) -> str:
    """Returns the results as Markdown."""
    text = (
        'Mean returns, and shares of complete episodes, with 95 % intervals (of shares: Wilson). `robot / none` '
        'is what a policy keeps of its own return, and `none / shipped` what the training has cost without disturbances.'
    )
    rows = []
    for entry in entries:
        for name, title in TITLES.items():
            each, shipped = entry[name], entry['before']['none']['return']
            none, robot = each['none']['return'], each['robot']['return']
            rows.append([
                f'`{entry["id"]}`' if name == 'before' else '', title.format(preset(entry)),
                ', '.join(sorted({f'{r["episodes"]}' for r in each.values()})),
                *(
                    f'{r["return"]:.1f} ± {r["return_interval"]:.1f}, '
                    + tables.share(r['completion_rate'], r['episodes'])
                    for r in map(each.get, CONDITIONS)
                ),
                f'{robot / none:.2f}', f'{none / shipped:.2f}',
            ])  # fmt: skip
    head = ['environment', 'policy', 'episodes', *CONDITIONS, 'robot / none', 'none / shipped']
    return f'{text}\n\n{tables.markdown_table(head, rows)}'


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('ids', nargs='*', metavar='ID', default=list(RANDOMIZED))
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--runs', type=pathlib.Path, default=pathlib.Path('runs/randomized'))
    parser.add_argument('--overwrite', action='store_true', help='repeat runs that are entered')
    parser.add_argument('--page', type=pathlib.Path, help='a page whose table is replaced')
    arguments = parser.parse_args()
    runs.check_seeds('--seed', arguments.seed)
    errors.check_known('environment', RANDOMIZED, *arguments.ids)
    for id_ in tqdm.tqdm(arguments.ids, unit='run'):
        if arguments.overwrite:
            runs.remove(arguments.runs / id_ / f'seed_{arguments.seed}')
        if arguments.overwrite or not runs.place(place(id_)).exists():
            train(id_, arguments.seed, arguments.runs)
        measure(id_)
    text = table([measure(id_) for id_ in RANDOMIZED if runs.place(place(id_)).exists()])
    print(text)
    if arguments.page is not None:
        files.replace_between(arguments.page, 'randomized', 'training/train_randomized.py', text)


if __name__ == '__main__':
    begin_script()
    main()
