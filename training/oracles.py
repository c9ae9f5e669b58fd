"""Measures which falls other actions could have prevented; of shipped policies it writes trained/oracles.json.

    python training/oracles.py FSM_Dog2D_Terrain_Mixed-v0 --falls 24
    python training/oracles.py PD_Raptor2D_Mixed_Terrain-v0 --falls 32 --tries 32
    python training/oracles.py PD_Biped3D_LLC_General_Step-v0 --condition 'pushes of 250 N'

The policy runs until it falls. From states before the fall it runs again with other actions; they prevent
the fall if the character gets beyond the place of the fall.

Of a gait, for one cycle, one to `BACK` cycles before: every base action; random parameters (a base action
plus normal noise in all parameters); and the policy's own action from changed states. If random
parameters prevent more falls than base actions, other gaits are needed; if nothing helps, the gait itself
is the limit, or the view, or the fall was decided earlier. Changed states tell chance from a better
choice. The own action from the same state falls again, unless two actions are so close in value that
rounding decides. Results: `trained/oracles.json`.

Of a policy that tracks a clip, from `SECONDS` before until the time of the fall: noise in its actions;
each noise value lasts `HOLD` control steps. In a condition of `evaluate_footsteps.py`, not to have fallen
`AFTER` seconds after the time of the fall is enough. If few falls can be prevented, the clip or the torque
limits are the limit, or the noise is not what is needed; if many can, learning is. Noise of standard
deviation `CHANCE`, which is no other behaviour, tells bad luck from wrong actions. Results:
`trained/oracle_falls.json`.
"""

from __future__ import annotations

import argparse
import collections
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import runs
import tqdm
from evaluate_footsteps import CONDITIONS, under
from gait_bench import nudged, position

from trl_suite import policies, suite
from trl_suite.registry import catalogue
from trl_suite.util.digest import digest
from trl_suite.util.program import begin_script
from trl_suite.vector import VectorEnvironment

# Of gaits.
BACK = 5  # largest number of cycles from a state to the fall
PASSED, PASSED_CYCLES = 2.0, 4  # beyond the place of the fall: m, mean cycles of the policy
MOST_CYCLES = 12  # with that of the action that is tried
NOISE = 0.3  # standard deviation of random parameters, in units of the action
NUDGE = 1e-3  # standard deviation of changes of joint angles, rad
# Of tracking policies.
SECONDS = (0.25, 0.5, 1.0, 1.5)  # before the fall
HOLD = 3  # control steps
PASSED_TRACKING = 1.0  # m beyond the place of the fall
AFTER = 2.0  # s after the time of the fall
CHANCE = 0.001
STDS = (CHANCE, 0.15, 0.5)  # standard deviations of the noise, in units of the action
Act = Callable[[np.ndarray], np.ndarray]


def falls(
    environments: VectorEnvironment, act: Act, back: int
) -> tuple[list[list[dict[str, Any]]], np.ndarray, float]:
    """Runs each simulation until a fall that is preceded by `back` steps; to be stuck is none.

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
            stuck = step.info.get('stuck')
            for i in np.flatnonzero(step.terminated & going).tolist():
                if len(past[i]) == back and not (stuck is not None and stuck[i]):
                    going[i] = False
                    bar.update()
                else:
                    past[i].clear()
                    environments.reset([i])
            observation = environments.task.observation.copy()
    return [list(each) for each in past], position(environments), distance / steps


def prevented(
    copies: VectorEnvironment, states: Sequence[dict[str, Any]],
    act: Callable[[int, np.ndarray], np.ndarray], steps: int, beyond: float | None,
) -> np.ndarray:  # fmt: skip
    """Returns which copies do not fall, (m,) bool.

    Args:
      copies: environments of this kind, m.
      states: where they begin, m.
      act: (step, observations) -> actions.
      steps: number of steps.
      beyond: position that has to be passed, m; None: not to fall is enough.
    """
    for i, state in enumerate(states):
        copies.set_state(state, [i])
    going, passed = np.ones(copies.num_envs, bool), np.zeros(copies.num_envs, bool)
    observation = copies.task.observation.copy()
    for t in range(steps):
        step = copies.step(act(t, observation), going)
        going &= ~step.terminated
        if beyond is not None:
            passed |= going & (position(copies) > beyond)
            going &= ~passed
        if not going.any():
            break
        observation = step.observation
    return going if beyond is None else passed


def shares(found: np.ndarray) -> dict[str, Any]:
    """Returns the shares of falls that some, and of tries that, prevent, of (falls, times, tries)."""
    some = found.any(2)
    return {
        'prevented': some.mean(0).round(3).tolist(),
        'tries_that_prevent': found.mean((0, 2)).round(3).tolist(),
        'ever_prevented': float(some.any(1).mean()),
    }


def of_gait(
    id_: str, policy: policies.Policy, number: int, tries: int, seed: int
) -> dict[str, Any]:
    """Returns the results for a number of falls, as they are stored."""
    rng, options = np.random.default_rng(seed), {'autoreset': 'disabled', 'step_limit': None}
    environments = VectorEnvironment(id_, number, 1, seed, **options)
    parameters = environments.task.gait.parameters
    base = getattr(policy, 'choices', None)
    if base is None:
        base = parameters.action(parameters.base_actions)
    past, places, pace = falls(environments, policy, BACK)
    margin = min(PASSED, PASSED_CYCLES * pace)
    ends = np.cumsum([1, len(base), tries, tries])  # of the copies of each kind
    copies = VectorEnvironment(id_, int(ends[-1]), 1, seed, **options)
    copies.reset()
    joints = copies.task.world.qpos.shape[1] - 3
    found = np.zeros((number, BACK, copies.num_envs), bool)
    for i, place in enumerate(tqdm.tqdm(places.tolist(), unit='fall')):
        for back, state in enumerate(past[i]):
            copies.set_state(state, [0])
            own = policy(copies.task.observation[:1])
            around = base[rng.integers(len(base), size=tries)]
            noisy = np.clip(around + rng.normal(0, NOISE, around.shape), -1, 1)
            changes = rng.normal(0, NUDGE, (tries, joints))
            states = [state] * ends[2] + [nudged(copies, state, each) for each in changes]
            tried = np.concatenate([own, base, noisy, np.repeat(own, tries, 0)])

            def act(t: int, seen: np.ndarray, tried: np.ndarray = tried) -> np.ndarray:
                return policy(seen) if t else tried

            found[i, back] = prevented(copies, states, act, MOST_CYCLES, place + margin)
    own, *parts = np.split(found, ends[:-1], axis=2)
    return {
        'passed': round(margin, 3),
        'own': float(own.mean()),
        **{
            kind: {'actions': part.shape[2], **shares(part)}
            for kind, part in zip(('base', 'random', 'nudged'), parts, strict=True)
        },
        'ever_prevented': float((parts[0].any(2) | parts[1].any(2)).any(1).mean()),
    }


def of_tracking(
    id_: str, policy: policies.Policy, number: int, tries: int, seed: int, condition: str = ''
) -> dict[str, Any]:
    """Returns the results for a number of falls, as they are stored."""
    rng = np.random.default_rng(seed)
    row, given = under(id_, condition) if condition else (id_, {})
    options: dict[str, Any] = {'autoreset': 'disabled', 'step_limit': None, 'task_kwargs': given}
    environments = VectorEnvironment(row, number, 1, seed, **options)
    rate = 1 / environments.control_timestep
    backs, after = [round(seconds * rate) for seconds in SECONDS], round(AFTER * rate)
    past, places, _ = falls(environments, policy, max(backs))
    copies = VectorEnvironment(row, tries * len(STDS), 1, seed, **options)
    copies.reset()
    std = np.repeat(STDS, tries)[:, None]
    found = np.zeros((number, len(backs), len(STDS), tries), bool)
    for i, place in enumerate(tqdm.tqdm(places.tolist(), unit='fall')):
        for j, back in enumerate(backs):
            shape = -(-back // HOLD), copies.num_envs, len(copies.action_map)
            noise = std * rng.standard_normal(shape).repeat(HOLD, axis=0)[:back]
            passed = prevented(
                copies, [past[i][back - 1]] * copies.num_envs, with_noise(policy, noise),
                back + after, None if condition else place + PASSED_TRACKING,
            )  # fmt: skip
            found[i, j] = passed.reshape(len(STDS), tries)
    noises = {str(std): shares(found[:, :, k]) for k, std in enumerate(STDS)}
    return {'tries': tries, 'seconds': SECONDS, 'noise': noises}


def with_noise(policy: Act, noise: np.ndarray) -> Callable[[int, np.ndarray], np.ndarray]:
    """Returns a policy with noise (steps, m, a) in its first actions, for `prevented`."""

    def act(t: int, seen: np.ndarray) -> np.ndarray:
        action = policy(seen)
        return np.clip(action + noise[t], -1, 1) if t < len(noise) else action

    return act


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('ids', nargs='+', metavar='ID', help='ids of environments')
    parser.add_argument('--policy', help='file; default: the shipped policy')
    parser.add_argument('--falls', type=int, default=24, help='number of falls')
    parser.add_argument('--tries', type=int, default=8, help='number of random tries of each kind')
    parser.add_argument('--seed', type=int, default=runs.EVALUATION_SEED + 1)
    parser.add_argument(
        '--condition', choices=CONDITIONS, default='', help='of a footstep controller'
    )
    arguments = parser.parse_args()
    for name in arguments.ids:
        id_, begin, condition = suite.find(name).id, time.process_time(), arguments.condition
        policy = policies.load(arguments.policy) if arguments.policy else policies.reference(id_)
        options = id_, policy, arguments.falls, arguments.tries, arguments.seed
        gait = catalogue.BY_ID[id_].actuation == 'gait'
        if gait and condition:
            parser.error(f'--condition is for footstep controllers, not for {id_}')
        found = of_gait(*options) if gait else of_tracking(*options, condition)
        found |= {'falls': arguments.falls, 'seed': arguments.seed, 'policy': policy.id}
        found |= {'samples': policy.info.get('samples'), 'of': digest(policy)}
        found['cpu_seconds'] = round(time.process_time() - begin)
        print(id_, found, flush=True)
        key = f'{id_}: {condition}' if condition else id_
        if not arguments.policy:
            runs.enter('oracles.json' if gait else 'oracle_falls.json', key, found)


if __name__ == '__main__':
    begin_script()
    main()
