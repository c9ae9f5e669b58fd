"""Measures whether the actions of a gait could have prevented the falls of a policy.

    python training/oracle_gaits.py FSM_Dog2D_Terrain_Mixed-v0 --falls 24
    python training/oracle_gaits.py FSM_Hopper2D_Terrain_Mixed_Easy-v0 --policy policy.npz

The policy runs until it falls. From the states before its last cycles other actions are tried, each
for one cycle, after which the policy continues: every base action, and random parameters (a base
action plus normal noise in all parameters). An action prevents the fall if the character gets
`PASSED` metres beyond the place of the fall. If random parameters prevent more falls than base actions,
other gaits are needed; if nothing helps, the gait itself is the limit, or the view, or the fall was
decided more than `BACK` cycles earlier.

An action is found here with hindsight. To tell a wrong choice from bad luck, the policy also continues
from the same states with joint angles that are changed by `NUDGE`, which its network hardly sees. As
far as that prevents the fall as often as other actions do, no policy could have selected a better one
from its observation, and more learning does not help; where other actions prevent more, it does.

Writes `trained/oracles.json`: ID -> settings and, for 1 to `BACK` cycles before the end, the share of
falls that some action prevents, and the mean share of actions that do; and the same for the policy's
own action from changed states. Its own action from the same state is tried as well: it falls again,
unless two actions are so close in value that rounding decides.
"""

from __future__ import annotations

import argparse
import collections
import json
import pathlib
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import ppo
import tqdm
from tune_gait import nudged, position

from trl_suite import policies, suite
from trl_suite.util import files, resources
from trl_suite.util.program import begin_script
from trl_suite.vector import VectorEnvironment

BACK = 5  # largest number of cycles from a state to the fall
PASSED, PASSED_CYCLES = 2.0, 4  # beyond the place of the fall: m, mean cycles of the policy
MOST_CYCLES = 12  # with that of the action that is tried
NOISE = 0.3  # standard deviation of random parameters, in units of the action
NUDGE = 1e-3  # standard deviation of changes of joint angles, rad
KINDS = 'base', 'random', 'nudged'
Act = Callable[[np.ndarray], np.ndarray]


def falls(
    environments: VectorEnvironment, act: Act, back: int = BACK
) -> tuple[list[list[dict[str, Any]]], np.ndarray, float]:
    """Runs each simulation until a fall that is preceded by `back` steps.

    Returns:
      For each simulation the states before its last `back` steps, the last one first; the position
      in which it fell, (n,) m; and the mean distance of all steps, m.
    """
    count, distance, steps = environments.num_envs, 0.0, 0
    past: list[collections.deque] = [collections.deque(maxlen=back) for _ in range(count)]
    going, observation = np.ones(count, bool), environments.reset()
    with tqdm.tqdm(total=count, unit='fall') as bar:
        while going.any():
            for i in np.flatnonzero(going).tolist():
                past[i].appendleft(environments.get_state([i]))
            before = position(environments)
            step = environments.step(act(observation), going)
            distance += float((position(environments) - before)[going].sum())
            steps += int(going.sum())
            for i in np.flatnonzero(step.terminated & going).tolist():
                if len(past[i]) == back:
                    going[i] = False
                    bar.update()
                else:
                    past[i].clear()
                    environments.reset([i])
            observation = environments.task.observation.copy()
    return [list(each) for each in past], position(environments), distance / steps


def prevented(
    copies: VectorEnvironment,
    states: Sequence[dict[str, Any]],
    beyond: float,
    actions: np.ndarray,
    act: Act,
) -> np.ndarray:
    """Returns which of some actions prevent a fall.

    Args:
      copies: environments of this kind, at least m.
      states: the states in which the actions are tried, m.
      beyond: the position that has to be passed, m.
      actions: the actions, each for one cycle, (m, k).
      act: the policy that continues.

    Returns:
      (m,) bool.
    """
    going = np.arange(len(actions))
    for i, state in enumerate(states):
        copies.set_state(state, [i])
    action = np.zeros((copies.num_envs, actions.shape[1]))
    action[going] = actions
    passed = np.zeros(copies.num_envs, bool)
    for _ in range(MOST_CYCLES):
        step = copies.step(action, going)
        passed[going] = ~step.terminated[going] & (position(copies)[going] > beyond)
        going = going[~(step.terminated | passed)[going]]
        if not len(going):
            break
        action[going] = act(step.observation[going])
    return passed[: len(actions)]


def measure(
    id_: str, policy: policies.Policy, number: int, randoms: int, seed: int
) -> dict[str, Any]:
    """Returns the results for a number of falls, as they are stored."""
    rng = np.random.default_rng(seed)
    options: dict[str, Any] = {'autoreset': 'disabled', 'step_limit': None}
    environments = VectorEnvironment(id_, number, 1, seed, **options)
    parameters = environments.task.gait.parameters
    base = parameters.action(parameters.base_actions)
    past, places, pace = falls(environments, policy)
    margin = min(PASSED, PASSED_CYCLES * pace)
    ends = np.cumsum([1, len(base), randoms, randoms])  # of the copies of each kind
    copies = VectorEnvironment(id_, int(ends[-1]), 1, seed, **options)
    copies.reset()
    joints = copies.task.world.qpos.shape[1] - 3
    found = np.zeros((number, BACK, copies.num_envs), bool)
    for i, place in enumerate(tqdm.tqdm(places, unit='fall')):
        for back, state in enumerate(past[i]):
            copies.set_state(state, [0])
            own = policy(copies.task.observation[:1])
            around = base[rng.integers(len(base), size=randoms)]
            noisy = np.clip(around + rng.normal(0, NOISE, around.shape), -1, 1)
            changes = rng.normal(0, NUDGE, (randoms, joints))
            states = [state] * ends[2] + [nudged(copies, state, each) for each in changes]
            tried = np.concatenate([own, base, noisy, np.repeat(own, randoms, 0)])
            found[i, back] = prevented(copies, states, float(place) + margin, tried, policy)
    parts = np.split(found, ends[:-1], axis=2)[1:]
    result: dict[str, Any] = {
        'falls': number, 'seed': seed, 'samples': policy.info.get('samples'),
        'policy': policy.id, 'passed': round(margin, 3), 'own': float(found[..., 0].mean()),
    }  # fmt: skip
    for kind, part in zip(KINDS, parts, strict=True):
        some = part.any(2)
        result[kind] = {
            'actions': part.shape[2],
            'prevented': some.mean(0).round(3).tolist(),
            'actions_that_prevent': part.mean((0, 2)).round(3).tolist(),
            'ever_prevented': float(some.any(1).mean()),
        }
    result['ever_prevented'] = float((parts[0].any(2) | parts[1].any(2)).any(1).mean())
    return result


def measure_all(
    path: pathlib.Path,
    arguments: argparse.Namespace,
    measured: Callable[..., dict[str, Any]],
    condition: str = '',
) -> None:
    """Measures the policies of environments, and enters the results into a JSON file."""
    for name in arguments.ids:
        id_, begin = suite.find(name).id, time.process_time()
        policy = policies.load(arguments.policy) if arguments.policy else policies.reference(id_)
        found = measured(id_, policy, arguments.falls, arguments.tries, arguments.seed)
        found['cpu_seconds'] = round(time.process_time() - begin)
        print(id_, json.dumps(found), flush=True)
        stored = json.loads(path.read_text()) if path.exists() else {}
        key = f'{id_}: {condition}' if condition else id_
        files.write_json(dict(sorted({**stored, key: found}.items())), path)


def parser(description: str, falls: int, tries: int, of: str) -> argparse.ArgumentParser:
    """Returns a parser with the arguments of `measure_all`."""
    parser_ = argparse.ArgumentParser(description=description)
    parser_.add_argument('ids', nargs='+', metavar='ID', help='ids of environments')
    parser_.add_argument('--policy', help='file; default: the shipped policy')
    parser_.add_argument('--falls', type=int, default=falls, help='number of falls')
    parser_.add_argument('--tries', type=int, default=tries, help=f'number {of}')
    parser_.add_argument('--seed', type=int, default=ppo.EVALUATION_SEED + 1)
    return parser_


def main() -> None:
    of = 'of random actions, and of changed states'
    arguments = parser(__doc__.splitlines()[0], 24, 8, of).parse_args()
    measure_all(resources.directory('trained') / 'oracles.json', arguments, measure)


if __name__ == '__main__':
    begin_script()
    main()
