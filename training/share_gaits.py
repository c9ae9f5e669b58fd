"""Evaluates a gait policy on other terrains, and ships it in trained/ where it is better.

    python training/share_gaits.py FSM_Dog2D_Terrain_Mixed-v0 FSM_Dog2D_Terrain_Gaps-v0
    python training/share_gaits.py FSM_Raptor2D_Terrain_Mixed-v0 FSM_Raptor2D_Terrain_Slopes-v0 \
        --preferences 0 1

Observation and action are the same on all terrains. The other environments get the policy of the first
id if its mean distance is above the 95 % interval of their shipped policy. One without a policy gets it if
its mean distance is not below the interval of the default gait. Of several preferences of the default
gait (`Policy.with_preference`) the best one is used, measured with another seed.

Writes `trained/shared.json`, which `trl_suite.policies.reference` reads: ID -> `policy`, the id of the
environment in which it was trained; `of`, its digest; `preference`, if it is not 0; `evaluation`, its
results; and `shipped_again`, those in episodes that had no part in the choice. After the policy has been
replaced its results are replaced, too, also by lower ones.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Any

import runs
import train_all

from trl_suite import evaluation, policies, suite
from trl_suite.cli.arguments import positive
from trl_suite.environments import named_policies
from trl_suite.util.digest import digest
from trl_suite.util.program import begin_script


def stored(id_: str, episodes: int) -> dict[str, Any] | None:
    """Returns the results of the shipped policy, if it was evaluated in as many episodes."""
    shared, own = runs.read(policies.SHARED), runs.read(f'{id_}.json')
    if replaced(id_):
        return None
    if id_ in shared:
        found = shared[id_]['evaluation']
    elif own:
        found = train_all.shipped(own)['evaluation']
    else:
        return None
    asked = {'episodes': episodes, 'seed': train_all.SEED}
    return found if {name: found[name] for name in asked} == asked else None


def replaced(id_: str, of: str | None = None) -> bool:
    """Returns whether a policy is another one than that of the results of an environment that shares it.

    Args:
      id_: the environment.
      of: the environment of the policy; None: the one whose policy it shares.
    """
    entry = runs.read(policies.SHARED).get(id_)
    if entry is None or of not in (None, entry['policy']):
        return False
    return entry.get('of') != digest(policies.reference(id_))


def preferring(
    id_: str, policy: policies.Policy, preferences: Sequence[float], episodes: int, threads: int
) -> tuple[float, policies.Policy]:
    """Returns the best preference of the default gait in an environment, and the policy with it."""
    found = {each: policy.with_preference(each) if each else policy for each in preferences}
    if len(found) == 1:
        return next(iter(found.items()))

    def distance(candidate: tuple[float, policies.Policy]) -> float:
        result = evaluation.evaluate(id_, candidate[1], episodes, runs.EVALUATION_SEED, threads)
        print(f'{id_}: preference {candidate[0]:g}: {result["distance"]:.1f} m', flush=True)
        return result['distance']

    return max(found.items(), key=distance)


def remove_unused(shared: dict[str, Any]) -> None:
    """Removes the policies of environments that use another one, unless others use theirs."""
    for id_ in shared.keys() - {entry['policy'] for entry in shared.values()}:
        for suffix in ('npz', 'json'):
            runs.place(f'{id_}.{suffix}').unlink(missing_ok=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('policy', metavar='ID', help='environment of the policy')
    parser.add_argument(
        'ids', nargs='+', metavar='ID', help='environments in which it is evaluated'
    )
    parser.add_argument('--episodes', type=positive, default=train_all.GAIT_EPISODES)
    parser.add_argument('--preferences', type=float, nargs='+', default=[0.0])
    parser.add_argument('--threads', type=int, default=1, help='0: all cores')
    arguments = parser.parse_args()
    of, ids = suite.find(arguments.policy).id, [suite.find(name).id for name in arguments.ids]
    if of != policies.trained_for(of):
        parser.error(f'{of} has the policy of {policies.trained_for(of)}; give that id')
    for id_ in ids:
        options = arguments.episodes, train_all.SEED, arguments.threads
        before, has_policy = stored(id_, arguments.episodes), id_ in policies.available()
        if before is None and has_policy:
            before = evaluation.evaluate(id_, policies.reference(id_), *options)
        elif before is None:
            before = evaluation.evaluate(id_, named_policies.zero, *options, factory=True)
        preference, policy = preferring(
            id_, policies.reference(of), arguments.preferences, arguments.episodes,
            arguments.threads,
        )  # fmt: skip
        found = evaluation.evaluate(id_, policy, *options)
        print(
            f'{id_}: {found["distance"]:.1f} m, median {found["median_distance"]:.1f} m; '
            f'before: {before["distance"]:.1f} m, median {before["median_distance"]:.1f} m',
            flush=True,
        )
        low, high = before['distance_interval']
        if found['distance'] <= (high if has_policy else low) and not replaced(id_, of):
            continue
        entry = {
            'policy': of, **({'preference': preference} if preference else {}), 'evaluation': found,
            'shipped_again': evaluation.evaluate(
                id_, policy, arguments.episodes, train_all.OTHER_SEED, arguments.threads
            ),
        }  # fmt: skip
        runs.enter(policies.SHARED, id_, entry)
        runs.add(policies.SHARED, id_, 'of', digest(policies.reference(id_)))
        with runs.changing(policies.SHARED) as shared:  # no other process changes it meanwhile
            remove_unused(shared)


if __name__ == '__main__':
    begin_script()
    main()
