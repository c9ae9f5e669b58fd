"""Searches with full foresight how far a gait gets over a terrain, and writes trained/foresight.json.

    python training/foresight.py FSM_Dog2D_Terrain_Stairs_Rugged-v0

A best-first search over states between cycles: the farthest ones that are left try actions, and the
states to which these lead without a fall are added. Of each terrain there are two searches: with base
actions alone, those among which the shipped policy selects, each of which a state tries once; and with
normal noise in all parameters, of which a state tries others later. The policy runs from the same
start. If the first search gets farther than the policy, the selection is its limit; if the second gets
farther than the first, base actions are. What a search does not reach may be possible, unless no
state is left: then every sequence of base actions has fallen.
"""

from __future__ import annotations

import argparse
import heapq
import itertools
import time
from typing import Any

import learn_gaits
import numpy as np
import runs
import tqdm
from gait_bench import position

from trl_suite import policies, suite
from trl_suite.cli.arguments import positive
from trl_suite.policies import Policy
from trl_suite.util.digest import digest
from trl_suite.util.options import checked
from trl_suite.util.program import begin_script
from trl_suite.vector import VectorEnvironment

COPIES = 256  # simulations that try actions together
TRIES = 16  # actions with noise that a state tries at a time
STDS = (0.1, 0.3, 0.6)  # standard deviations of the noise, in units of the action, in turn
AGAIN = 0.3  # m; by how much a state counts as less far each time that it has tried TRIES actions


def search(
    copies: VectorEnvironment, start: dict[str, Any], base: np.ndarray, noisy: bool, metres: float,
    budget: int, rng: np.random.Generator,
) -> tuple[float, int]:  # fmt: skip
    """Returns the distance that was reached, m, and the number of cycles that were simulated.

    Args:
      copies: environments of this kind.
      start: the state at the start.
      base: the base actions, (b, k).
      noisy: whether actions are base actions with noise, TRIES of each state, instead of all of them.
      metres: distance at which the search ends.
      budget: number of cycles at which it ends.
      rng: generator of the actions.
    """
    tries, order = TRIES if noisy else len(base), itertools.count()
    std = np.resize(STDS, tries)[:, None]
    # -(distance - penalty), number and state; of equal ones the first comes first.
    left: list[tuple[float, int, dict[str, Any]]] = [(0.0, next(order), start)]
    copies.set_state(start, [0])
    begin, farthest, cycles = position(copies)[0], 0.0, 0
    with tqdm.tqdm(total=budget, unit='cycle') as bar:
        while left and farthest < metres and cycles < budget:
            count = min(copies.num_envs // tries, len(left), -(-(budget - cycles) // tries))
            chosen = [heapq.heappop(left) for _ in range(count)]
            ids, action = np.arange(count * tries), np.zeros((copies.num_envs, base.shape[1]))
            for i in ids.tolist():
                copies.set_state(chosen[i // tries][2], [i])
            if not noisy:
                action[ids] = np.tile(base, (count, 1))
            else:
                drawn = base[rng.integers(len(base), size=(count, tries))]
                drawn += std * rng.standard_normal(drawn.shape)
                action[ids] = np.clip(drawn, -1, 1).reshape(len(ids), -1)
                for far, _, state in chosen:
                    heapq.heappush(left, (far + AGAIN, next(order), state))
            ended = copies.step(action, ids).terminated
            cycles += len(ids)
            bar.update(len(ids))
            reached = position(copies) - begin
            for i in ids[~ended[ids]].tolist():
                farthest = max(farthest, float(reached[i]))
                heapq.heappush(left, (-reached[i], next(order), copies.get_state([i])))
    return farthest, cycles


def walked(environments: VectorEnvironment, policy: Policy, metres: float) -> list[float]:
    """Returns how far a policy gets from the start of each simulation until a fall, at most `metres`."""
    begin, observation = position(environments), environments.task.observation.copy()
    going, reached = np.ones(environments.num_envs, bool), np.zeros(environments.num_envs)
    while going.any():
        step = environments.step(policy(observation), going)
        going &= ~step.terminated
        reached[going] = (position(environments) - begin)[going]
        going &= reached < metres
        observation = step.observation
    return np.minimum(reached, metres).tolist()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('ids', nargs='+', metavar='ID', help='ids of environments')
    parser.add_argument('--terrains', type=positive, default=4, help='number of terrains')
    parser.add_argument('--metres', type=float, default=30.0, help='distance that is enough, m')
    parser.add_argument('--budget', type=float, default=5e3, help='cycles for each search')
    parser.add_argument('--seed', type=int, default=runs.EVALUATION_SEED + 2)
    arguments = parser.parse_args()
    checked('--metres', arguments.metres, float, above=0)
    checked('--budget', arguments.budget, float, at_least=1)
    for name in arguments.ids:
        id_, begin = suite.find(name).id, time.process_time()
        learn_gaits.environments_of(id_, learn_gaits.Settings())  # it has a gait
        policy, rng = policies.reference(id_), np.random.default_rng(arguments.seed)
        options = {'autoreset': 'disabled', 'step_limit': None}
        starts = VectorEnvironment(id_, arguments.terrains, 1, arguments.seed, **options)
        starts.reset()
        gait = starts.task.gait.parameters
        base = (
            gait.action(gait.base_actions)
            if policy.choices is None
            else policy.choices.astype(float)
        )
        copies = VectorEnvironment(id_, COPIES, 1, arguments.seed, **options)
        copies.reset()
        enough = arguments.metres, int(arguments.budget)
        result: dict[str, Any] = {
            'of': digest(policy), 'asked': arguments.metres, 'budget': int(arguments.budget),
            'seed': arguments.seed,
        }  # fmt: skip
        for kind in ('base', 'noisy'):
            found = [
                search(copies, starts.get_state([i]), base, kind == 'noisy', *enough, rng)
                for i in range(arguments.terrains)
            ]
            result[kind] = {
                'metres': [round(metres, 2) for metres, _ in found],
                'cycles': [cycles for _, cycles in found],
            }
        result['policy'] = [round(each, 2) for each in walked(starts, policy, arguments.metres)]
        result['cpu_seconds'] = round(time.process_time() - begin)
        print(id_, result, flush=True)
        runs.enter('foresight.json', id_, result)


if __name__ == '__main__':
    begin_script()
    main()
