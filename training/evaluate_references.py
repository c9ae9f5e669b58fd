"""Evaluates in the episodes of shipped policies what they are compared with.

    python training/evaluate_references.py default_gaits                # all that are trained
    python training/evaluate_references.py transfer PD_Dog2D_Gaps_Terrain-v0

`default_gaits`: the default gait, where gait policies are trained. `transfer`: the policy of flat ground
with the same observation, on the other PLAiD terrains. `stairs` and `ramps`: the shipped policies on stairs
with vertical faces, and with those of the 2016 program, in episodes that chose none of them. Prints the mean
distances, and writes `trained/default_gaits.json` and so on: ID -> evaluation.
"""

from __future__ import annotations

import argparse
import functools
from typing import Any

import runs
import train_all

from trl_suite import evaluation, policies
from trl_suite.environments import named_policies
from trl_suite.registry import catalogue
from trl_suite.util import errors
from trl_suite.util.digest import digest
from trl_suite.util.program import begin_script

STAIRS_SEED = 20161128
STAIRS = (
    'FSM_Goat2D_Terrain_Variable_Steps-v0',
    *(
        f'FSM_{character}2D_Terrain_Stairs_Rugged-v0'
        for character in ('Dog', 'Raptor', 'Hopper', 'Biped')
    ),
)


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


def of_stairs(id_: str, **options: Any) -> dict[str, Any]:
    policy = policies.reference(id_)
    episodes = train_all.GAIT_EPISODES
    found = evaluation.evaluate(id_, policy, episodes, STAIRS_SEED, task_kwargs=options)
    kept = ('distance', 'distance_interval', 'episodes', 'seed', 'step_limit')
    return {**{name: found[name] for name in kept}, **options, 'of': digest(policy)}


REFERENCES = {  # environments and evaluation
    'default_gaits': (train_all.GAITS, of_default_gait),
    'transfer': (
        tuple(s.id for s in catalogue.SPECS if s.domain == 'plaid' and s.terrain != 'flat'),
        of_flat_ground,
    ),
    'stairs': (STAIRS, of_stairs),
    'ramps': (STAIRS, functools.partial(of_stairs, face_length=0.1)),
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
