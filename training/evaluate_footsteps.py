"""Evaluates footstep tracking of a footstep controller: plans, pushes, slopes, bumps, belts.

    python training/evaluate_footsteps.py                           # the reference policy
    python training/evaluate_footsteps.py --id PD_Biped3D_LLC_HighKnees_Step-v0
    python training/evaluate_footsteps.py mine.npz --filter general straight

Prints for every condition, over episodes with the seeds of `evaluation.evaluate`: the share of
episodes that last to the end, the mean reward per step (0 after a fall), the distance from planned
to actual footsteps (mean and 90th percentile over all footsteps of all episodes), and the mean
heading error at landing; and of the posture, the least height of the hip above the knee and the largest
flexion of the knee in a swing, of both legs and of each, and the lean of the trunk, forwards and to the
right (means). Of walkers that are to stand throughout, the drift is printed, too: how far the root moves
from the first landing beside the stance foot to the end (mean over the episodes that last to the end). Results
of reference policies are written to trained/footsteps.json.
"""

from __future__ import annotations

import argparse
import dataclasses
from typing import Any

import numpy as np
import runs

from trl_suite import policies, suite
from trl_suite.bodies.reference import CONTROL_TIMESTEP
from trl_suite.cli.arguments import positive
from trl_suite.registry import catalogue
from trl_suite.registry.catalogue import EnvSpec
from trl_suite.tasks.common.footstep_plan import LEFT, RIGHT
from trl_suite.util import errors
from trl_suite.util.digest import digest
from trl_suite.util.options import checked
from trl_suite.util.program import begin_script
from trl_suite.vector import VectorEnvironment

ID = 'PD_Biped3D_LLC_General_Step-v0'
SECONDS = 20.0  # of an episode
LEAST_SECONDS = 3.0  # six footsteps
STEADY = {'turn': 0.0, 'sharp': 0.0}
VARIED = {'length': (0.25, 0.7), 'width': (0.1, 0.25), 'change': 1.0, 'sharp': 0.0}
STAY = {'stop': 1.0}
PUSHES = {'force': (150, 150), 'duration': (0.2, 0.2), 'interval': (2.8, 2.8)}  # every 3 s
BELTS = {
    'Type': 'conveyor3d',
    'Params': [{
        'ObstacleWidth0': 2, 'ObstacleWidth1': 2, 'ObstacleSpeed0': 0.6, 'ObstacleSpeed1': 0.6,
        'ConveyorStripLength': 200, 'ConveyorNumStrips': 20, 'ConveyorSpacing': 1,
    }],
}  # fmt: skip


def ramp(slope: float) -> dict[str, Any]:
    return {'Type': 'var3d_ramp', 'Params': [{'Slope': slope}]}


def bumps(height: float) -> dict[str, Any]:
    return {'Type': 'var3d_checkers', 'Params': [{'Slope': height}]}


# Task options; `terrain` replaces that of the environment's spec.
CONDITIONS: dict[str, dict[str, Any]] = {
    'straight': {'plans': STEADY},
    'straight, 0.3 m': {'plans': {**STEADY, 'length': (0.3, 0.3)}},
    'straight, 0.7 m': {'plans': {**STEADY, 'length': (0.7, 0.7)}},
    'general without sharp turns': {'plans': {'sharp': 0.0}},
    'general': {'plans': {}},
    'varied lengths and widths': {'plans': VARIED},
    'made from the root': {'plans': {'from_root': 1.0}},
    'made from the root, on the spot': {'plans': {'from_root': 1.0, 'root_length': (0.0, 0.0)}},
    'made from the root, turning about': {'plans': {'from_root': 1.0, 'root_turn': 0.6}},
    'stops': {'plans': {'sharp': 0.0, 'stop': 0.1}},
    'stands': {'plans': STAY},
    'stands, pushes of 100 N': {'plans': STAY, 'pushes': {**PUSHES, 'force': (100, 100)}},
    'stands on a ramp of 8 %': {'plans': STAY, 'terrain': ramp(0.08)},
    'pushes of 150 N': {'plans': {'sharp': 0.0}, 'pushes': PUSHES},
    'pushes of 250 N': {'plans': {'sharp': 0.0}, 'pushes': {**PUSHES, 'force': (250, 250)}},
    'ramp up 8 %': {'plans': STEADY, 'terrain': ramp(0.08)},
    'ramp down 8 %': {'plans': STEADY, 'terrain': ramp(-0.08)},
    'bumps of 3 cm': {'plans': {'sharp': 0.0}, 'terrain': bumps(0.03)},
    'bumps of 6 cm': {'plans': {'sharp': 0.0}, 'terrain': bumps(0.06)},
    'belts of 0.6 m/s': {'plans': {'sharp': 0.0}, 'terrain': BELTS},
}


def under(id_: str, condition: str) -> tuple[EnvSpec, dict[str, Any]]:
    """Returns the spec and the task options of an environment under a condition."""
    spec, options = suite.find(id_), dict(CONDITIONS[condition])
    terrain = options.pop('terrain', spec.terrain)
    options['plans'] = {**spec.options.get('plans', {}), 'stop': 0.0, **options['plans']}
    own = {k: v for k, v in spec.options.items() if k != 'plans'}
    return dataclasses.replace(spec, terrain=terrain, options=own), options


def postures(task: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns the height of each hip above its knee, (n, 2) m, the knees' flexion, (n, 2) rad, and the lean.

    Right before left; the lean, (n, 2) rad, is that of the trunk forwards and to the right.
    """
    names = [*task.character.spec.links]
    places = task.world.xpos[:, task.body.links]
    hip, knee, ankle = (
        places[:, [names.index(f'{side}_{joint}') for side in ('right', 'left')]]
        for joint in ('hip', 'knee', 'ankle')
    )
    thigh, shank = knee - hip, ankle - knee
    lengths = np.linalg.norm(thigh, axis=2) * np.linalg.norm(shank, axis=2)
    flexion = np.arccos(np.clip((thigh * shank).sum(2) / lengths, -1, 1))
    # The pose has the height of the root, then position and orientation of links in the heading frame.
    links = task.body.measurement.pose[:, 1:].reshape(len(places), len(names), 7)
    w, x, y, z = links[:, names.index('torso'), 3:].T
    upright = 2 * np.stack([x * z + w * y, w * x - y * z], axis=1)
    return hip[:, :, 2] - knee[:, :, 2], flexion, np.arcsin(np.clip(upright, -1, 1))


def run(
    spec: EnvSpec, policy: policies.Policy, episodes: int, seed: int, seconds: float, **options: Any
) -> dict[str, Any]:
    """Runs one episode in every simulation; returns survival, reward, errors, posture and drift."""
    steps = round(seconds / CONTROL_TIMESTEP)
    environments = VectorEnvironment(
        spec, episodes, 0, seed, autoreset='disabled', step_limit=steps, task_kwargs=options
    )
    policy.check(environments)
    observation = environments.reset()
    going, reward = np.ones(episodes, bool), 0.0
    root = environments.task.body.measurement.root
    landings, stood = np.zeros(episodes, int), np.zeros((episodes, 2))
    full, distance = np.zeros(episodes, bool), np.zeros(episodes)
    landing, heading, lean = [], [], []
    swings, swing = [], np.tile([[np.inf], [0.0]], episodes)  # extremes of the present step
    while going.any():
        side = 1 - environments.task.plan.stance
        step = environments.step(policy(observation), going)
        reward += float(step.reward[going].sum())
        landed = step.info['landed'] & going
        landings += landed
        beside = landed & (landings == 2)  # the first place was planned before the stop
        stood[beside] = root[beside, :2]
        heights, flexion, leans = postures(environments.task)
        rows = np.arange(episodes)
        swing[0] = np.minimum(swing[0], heights[rows, side])
        swing[1] = np.maximum(swing[1], flexion[rows, side])
        swings.append(np.append(swing, side[None], axis=0)[:, landed])
        lean.append(leans[going])
        swing[:, step.info['landed']] = [[np.inf], [0.0]]
        landing.append(step.info['landing_error'][landed])
        heading.append(step.info['heading_error'][landed])
        ended = step.terminated | step.truncated
        distance[ended & going] = step.info['distance'][ended & going]
        full[ended & going] = step.truncated[ended & going]
        going &= ~ended
        observation = step.observation
    stands = environments.task.plans.stop == 1 and full.any()
    drift = np.linalg.norm(root[:, :2] - stood, axis=1)[full]
    environments.close()
    misses, turns = np.concatenate(landing), np.concatenate(heading)
    least, most, leg = np.concatenate(swings, axis=1)
    forwards, to_the_right = np.concatenate(lean).mean(0).tolist()
    return {
        'of': digest(policy), 'episodes': episodes, 'seed': seed, 'seconds': seconds, 'survived': float(full.mean()),
        'normalized_return': reward / (steps * episodes), 'landing': float(misses.mean()),
        'landing_90': float(np.quantile(misses, 0.9)), 'heading': float(turns.mean()),
        'distance': float(distance.mean()), 'hip_above_knee': float(least.mean()),
        'knee': float(most.mean()), 'right_knee': float(most[leg == RIGHT].mean()),
        'left_knee': float(most[leg == LEFT].mean()), 'lean': forwards, 'tilt': to_the_right,
        **({'drift': float(drift.mean())} if stands else {}),
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('policy', nargs='?', help='.npz file; the reference policy by default')
    parser.add_argument('--id', default=ID)
    parser.add_argument(
        '--variant', default='', choices=('', *policies.VARIANTS), help='of the reference policy'
    )
    parser.add_argument('--filter', nargs='+', choices=CONDITIONS, default=list(CONDITIONS))
    parser.add_argument('--episodes', type=positive, default=100)
    parser.add_argument('--seed', type=int, default=runs.TEST_SEED)
    parser.add_argument('--seconds', type=float, default=SECONDS)
    arguments = parser.parse_args()
    checked('--seconds', arguments.seconds, float, 's', at_least=LEAST_SECONDS)
    id_ = suite.find(arguments.id).id
    known = [spec.id for spec in catalogue.SPECS if spec.task_type == 'spatial_footsteps']
    errors.check_known('environment with footsteps in 3D', known, id_)
    if arguments.policy and arguments.variant:
        parser.error('give either a file or --variant, not both')
    policy = (
        policies.load(arguments.policy)
        if arguments.policy
        else suite.reference_policy(id_, arguments.variant)
    )
    for name in arguments.filter:
        row, options = under(id_, name)
        result = run(row, policy, arguments.episodes, arguments.seed, arguments.seconds, **options)
        print(
            f'{name:34} survived {result["survived"]:.2f}  reward {result["normalized_return"]:.3f}  '
            f'landing {result["landing"]:.3f} m, 90 % {result["landing_90"]:.3f}  '
            f'heading {result["heading"]:.3f} rad  hip above knee {result["hip_above_knee"]:.2f} m  '
            f'knee {result["right_knee"]:.2f} and {result["left_knee"]:.2f}, '
            f'lean {result["lean"]:.2f} and {result["tilt"]:.2f} rad'
            + (f'  drift {result["drift"]:.2f} m' if 'drift' in result else ''),
            flush=True,
        )
        if not arguments.policy and not arguments.variant:
            runs.add('footsteps.json', id_, name, result)


if __name__ == '__main__':
    begin_script()
    main()
