"""Measures whether other actions could have prevented the falls of a policy that tracks a clip.

    python training/oracle_falls.py PD_Raptor2D_Mixed_Terrain-v0 --falls 32
    python training/oracle_falls.py PD_Biped3D_LLC_General_Step-v0 --condition 'pushes of 250 N'

The policy runs until it falls. From the states `BACK` seconds before, it runs again with noise in its
actions until the time of the fall, then without; each noise value lasts `HOLD` control steps. Noise
prevents the fall if the character gets `PASSED` metres beyond the place of the fall, or, in a condition of
`evaluate_footsteps.py`, if it has not fallen `AFTER` seconds after the time of the fall. If few falls can
be prevented, the clip or the torque limits are the limit, or the noise is not what is needed; if many
can, learning is. Noise of standard deviation `CHANCE`, which is no other behaviour, is tried as well,
to tell bad luck from wrong actions.

Writes `trained/oracle_falls.json`: ID, or 'ID: condition' -> settings and, for each standard deviation of
the noise and each time before the end, the share of falls that some noise prevents, and the mean share of
tries that do.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import numpy as np
import oracle_gaits
import tqdm
from evaluate_footsteps import CONDITIONS, row_for
from oracle_gaits import position

from trl_suite import policies
from trl_suite.util import resources
from trl_suite.util.program import begin_script
from trl_suite.vector import VectorEnvironment

BACK = (0.25, 0.5, 1.0, 1.5)  # s before the fall
HOLD = 3  # control steps
PASSED = 1.0  # m beyond the place of the fall
AFTER = 2.0  # s after the time of the fall
CHANCE = 0.001
STDS = (CHANCE, 0.15, 0.5)  # standard deviations of the noise, in units of the action


def prevented(
    copies: VectorEnvironment,
    states: Sequence[dict[str, Any]],
    place: float | None,
    noise: np.ndarray,
    after: int,
    policy: policies.Policy,
) -> np.ndarray:
    """Returns which noise prevents a fall.

    Args:
      copies: environments of this kind, m.
      states: the states from which the policy runs, m.
      place: place of the fall, m; None: not to fall is enough.
      noise: added to the actions until the time of the fall, (steps, m, a).
      after: further control steps.
      policy: the policy.

    Returns:
      (m,) bool.
    """
    for i, state in enumerate(states):
        copies.set_state(state, [i])
    going, passed = np.ones((2, copies.num_envs), bool)
    passed[:] = False
    observation = copies.task.observation.copy()
    for i in range(len(noise) + after):
        action = policy(observation)
        if i < len(noise):
            action = np.clip(action + noise[i], -1, 1)
        step = copies.step(action, going)
        going &= ~step.terminated
        if place is not None:
            passed |= going & (position(copies) > place + PASSED)
            going &= ~passed
        if not going.any():
            break
        observation = step.observation
    return going if place is None else passed


def measure(
    id_: str, policy: policies.Policy, number: int, tries: int, seed: int, condition: str = ''
) -> dict[str, Any]:
    """Returns the results for a number of falls, as they are stored."""
    rng = np.random.default_rng(seed)
    task_options = dict(CONDITIONS[condition]) if condition else {}
    row = row_for(id_, task_options.pop('terrain', None)) if condition else id_
    options: dict[str, Any] = {
        'autoreset': 'disabled', 'step_limit': None, 'task_kwargs': task_options,
    }  # fmt: skip
    environments = VectorEnvironment(row, number, 1, seed, **options)
    rate = 1 / environments.control_timestep
    backs = [round(seconds * rate) for seconds in BACK]
    past, places, _ = oracle_gaits.falls(environments, policy, max(backs))
    copies = VectorEnvironment(row, tries * len(STDS), 1, seed, **options)
    copies.reset()
    std = np.repeat(STDS, tries)[:, None]
    found = np.zeros((number, len(backs), len(STDS), tries), bool)
    for i, place in enumerate(tqdm.tqdm(places, unit='fall')):
        for j, back in enumerate(backs):
            shape = -(-back // HOLD), copies.num_envs, len(copies.action_map)
            noise = std * rng.standard_normal(shape).repeat(HOLD, axis=0)[:back]
            states = [past[i][back - 1]] * copies.num_envs
            passed = prevented(
                copies,
                states,
                None if condition else float(place),
                noise,
                round(AFTER * rate),
                policy,
            )
            found[i, j] = passed.reshape(len(STDS), tries)
    some = found.any(3)
    return {
        'falls': number, 'tries': tries, 'seed': seed, 'samples': policy.info.get('samples'),
        'policy': policy.id, 'seconds': BACK,
        'noise': {
            str(std): {
                'prevented': some[:, :, k].mean(0).round(3).tolist(),
                'tries_that_prevent': found[:, :, k].mean((0, 2)).round(3).tolist(),
                'ever_prevented': float(some[:, :, k].any(1).mean()),
            }
            for k, std in enumerate(STDS)
        },
    }  # fmt: skip


def main() -> None:
    parser = oracle_gaits.parser(__doc__.splitlines()[0], 32, 32, 'of each noise')
    parser.add_argument(
        '--condition', choices=CONDITIONS, default='', help='of a footstep controller'
    )
    arguments = parser.parse_args()
    path, condition = resources.directory('trained') / 'oracle_falls.json', arguments.condition
    oracle_gaits.measure_all(
        path, arguments, functools.partial(measure, condition=condition), condition
    )


if __name__ == '__main__':
    begin_script()
    main()
