"""Evaluates in the episodes of shipped policies what they are compared with.

    python training/evaluate_references.py default_gaits                # all that are trained
    python training/evaluate_references.py transfer PD_Dog2D_Gaps_Terrain-v0

`default_gaits`: the default gait, where gait policies are trained. `transfer`: the policy of flat ground
with the same observation, on the other PLAiD terrains. Prints the mean distances, and writes
`trained/default_gaits.json` or `trained/transfer.json`: ID -> evaluation.
"""

from __future__ import annotations

import argparse
from typing import Any

import runs
import train_all

from trl_suite import evaluation, policies
from trl_suite.environments import named_policies
from trl_suite.registry import catalogue
from trl_suite.util import errors
from trl_suite.util.digest import digest
from trl_suite.util.program import begin_script


def flat_ground(spec: catalogue.EnvSpec) -> str:
    """Returns the id of the environment with the same observation on flat ground."""
    body = '_'.join(spec.id.split('_')[:2])  # actuation and character
    return f'{body}_Flat_Terrain-v0' if 'blind' not in spec.tags else f'{body}_Flat-v0'


def of_default_gait(id_: str) -> dict[str, Any]:
    episodes = train_all.GAIT_EPISODES
    return evaluation.evaluate(id_, named_policies.zero, episodes, train_all.SEED, 0, factory=True)


def of_flat_ground(id_: str) -> dict[str, Any]:
    flat = policies.load(runs.place(f'{flat_ground(catalogue.BY_ID[id_])}.npz'))
    found = evaluation.evaluate(id_, flat, train_all.EPISODES, train_all.SEED)
    return {**found, 'of': digest(flat)}


REFERENCES = {  # environments and evaluation
    'default_gaits': (train_all.GAITS, of_default_gait),
    'transfer': (
        tuple(s.id for s in catalogue.SPECS if s.domain == 'plaid' and s.terrain != 'flat'),
        of_flat_ground,
    ),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('reference', choices=REFERENCES)
    parser.add_argument('ids', nargs='*', metavar='ID', help='default: all')
    arguments = parser.parse_args()
    every, evaluate = REFERENCES[arguments.reference]
    errors.check_known(f'environment of {arguments.reference}', every, *arguments.ids)
    for id_ in arguments.ids or every:
        found = evaluate(id_)
        print(f'{id_}: {found["distance"]:.1f} m', flush=True)
        runs.enter(f'{arguments.reference}.json', id_, found)


if __name__ == '__main__':
    begin_script()
    main()
