"""Searches with full foresight how far a gait gets over a terrain, and writes trained/foresight.json.

    python training/foresight.py FSM_Dog2D_Terrain_Stairs_Rugged-v0

A beam search: in every cycle, each of `BEAM` states tries `TRIES` actions, and the farthest states that
have not fallen are kept. If all fall, the search goes back by some cycles and draws others. It ends at
the distance asked, or with the budget of cycles. Of each terrain there are two searches: with base
actions alone, and with normal noise in all parameters. If the first gets farther than the policy, the
selection is its limit; if the second gets farther than the first, base actions are. The search is greedy:
what it does not reach may be possible.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import learn_gaits
import numpy as np
import runs
import tqdm
from gait_bench import position

from trl_suite import suite
from trl_suite.cli.arguments import positive
from trl_suite.util.options import checked
from trl_suite.util.program import begin_script
from trl_suite.vector import VectorEnvironment

BEAM, TRIES = 8, 32  # states, actions of each
# Standard deviations of the noise of actions, in units of the action; in equal shares.
NOISES = {'base': (0.0,), 'noisy': (0.0, 0.1, 0.3, 0.6)}
BACK = 3  # mean number of cycles by which a search goes back


def search(
    copies: VectorEnvironment, start: dict[str, Any], stds: tuple[float, ...], metres: float,
    budget: int, rng: np.random.Generator,
) -> tuple[float, int]:  # fmt: skip
    """Returns the distance that was reached, m, and the number of cycles that were simulated.

    Args:
      copies: environments of this kind, `BEAM` * `TRIES`.
      start: the state at the start.
      stds: standard deviations of the noise.
      metres: distance at which the search ends.
      budget: number of cycles at which it ends.
      rng: generator of the actions.
    """
    parameters = copies.task.gait.parameters
    base = parameters.action(parameters.base_actions)
    std = np.resize(stds, copies.num_envs)[:, None]
    past, farthest, begin, cycles = [[start]], 0.0, None, 0
    with tqdm.tqdm(total=budget, unit='cycle') as bar:
        while farthest < metres and cycles < budget:
            for i in range(copies.num_envs):
                copies.set_state(past[-1][i % len(past[-1])], [i])
            before = position(copies)
            begin = before[0] if begin is None else begin
            action = base[rng.integers(len(base), size=copies.num_envs)]
            action = np.clip(action + std * rng.standard_normal(action.shape), -1, 1)
            ended = copies.step(action).terminated
            cycles += copies.num_envs
            bar.update(copies.num_envs)
            reached = np.where(ended | (position(copies) < before), -np.inf, position(copies))
            best = np.argsort(-reached)[:BEAM]
            best = best[np.isfinite(reached[best])]
            if len(best):
                past.append([copies.get_state([int(i)]) for i in best])
                farthest = max(farthest, float(reached[best[0]] - begin))
            else:
                del past[max(1, len(past) - rng.geometric(1 / BACK)) :]
    return farthest, cycles


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('ids', nargs='+', metavar='ID', help='ids of environments')
    parser.add_argument('--episodes', type=positive, default=1, help='number of terrains')
    parser.add_argument('--metres', type=float, default=30.0, help='distance that is enough, m')
    parser.add_argument('--budget', type=float, default=6e3, help='cycles for each search')
    parser.add_argument('--seed', type=int, default=runs.EVALUATION_SEED + 2)
    arguments = parser.parse_args()
    checked('--metres', arguments.metres, float, above=0)
    checked('--budget', arguments.budget, float, at_least=1)
    for name in arguments.ids:
        id_, begin = suite.find(name).id, time.process_time()
        learn_gaits.environments_of(id_, learn_gaits.Settings())  # it has a gait
        rng = np.random.default_rng(arguments.seed)
        options = {'autoreset': 'disabled', 'step_limit': None}
        starts = VectorEnvironment(id_, arguments.episodes, 1, arguments.seed, **options)
        starts.reset()
        copies = VectorEnvironment(id_, BEAM * TRIES, 1, arguments.seed, **options)
        copies.reset()
        enough = arguments.metres, int(arguments.budget)
        result: dict[str, Any] = {'asked': arguments.metres, 'seed': arguments.seed}
        for kind, stds in NOISES.items():
            found = [
                search(copies, starts.get_state([i]), stds, *enough, rng)
                for i in range(arguments.episodes)
            ]
            result[kind] = {
                'metres': [round(metres, 2) for metres, _ in found],
                'cycles': [cycles for _, cycles in found],
            }
        result['cpu_seconds'] = round(time.process_time() - begin)
        print(id_, result, flush=True)
        runs.enter('foresight.json', id_, result)


if __name__ == '__main__':
    begin_script()
    main()
