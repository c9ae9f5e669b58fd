"""Evaluates navigation tasks: scripted and learnt footstep planning, and control without hierarchy.

    python training/evaluate_plans.py                                      # all, both policies
    python training/evaluate_plans.py PD_Biped3D_HLC_Soccer-v0 --policies scripted --episodes 32
    python training/evaluate_plans.py PD_Biped3D_HLC_Soccer-v0 --policies reference \
        --controller PD_Biped3D_LLC_HighKnees_Step-v0

Measures the quantities reported in the DeepLoco paper, over whole episodes (200 s) with the seeds
of `evaluation.evaluate`: the normalised cumulative reward (0 after a fall), the shares of episodes
without a fall, in total and in the first minute, speed towards the goal, goals per minute (not in
soccer), distance along a trail, the share of time with the ball at its goal, and falls per
kilometre. `expert` is the expert that policies imitate, for footsteps (not in soccer) or joint targets.
Environments without hierarchy have no scripted policy; their episodes are as long as the others.
Writes the results to trained/plans.json, with the digests of the policy (`of`) and of its footstep controllers.
"""

from __future__ import annotations

import argparse
import fnmatch
from collections.abc import Callable
from typing import Any

import numpy as np
import runs
from expert import expert, joint_expert

from trl_suite import policies, suite
from trl_suite.bodies.reference import CONTROL_TIMESTEP
from trl_suite.cli.arguments import positive
from trl_suite.registry import catalogue
from trl_suite.tasks.navigation.scripted import scripted
from trl_suite.util import errors
from trl_suite.util.digest import digest
from trl_suite.util.program import begin_script
from trl_suite.vector import VectorEnvironment

EPISODES = 128
POLICIES = ('scripted', 'reference', 'expert')
TAGS = ('hierarchical', 'flat_control')  # of the environments with goals
SECONDS = 200.0  # of an episode without hierarchy
SEGMENT = 2.0  # m; of a trail
MINUTE = 60.0  # s


def along_trails(environments: VectorEnvironment, place: np.ndarray) -> np.ndarray:
    """Returns the distances of positions (n, 2) along their trails, (n,) m; 0 without a trail."""
    found = np.zeros(len(place))
    for env_id, ground in enumerate(environments.task.arena.grounds):
        if ground.layout.trail is not None:
            trail = ground.layout.trail
            middle = 0.5 * (trail.start + trail.end)
            found[env_id] = SEGMENT * np.linalg.norm(middle - place[env_id], axis=1).argmin()
    return found


def run(
    id_: str, make: Callable[[VectorEnvironment], Any], episodes: int, seed: int, **options: Any
) -> dict:
    """Runs one episode in every simulation; returns the measured quantities."""
    own = 'hierarchical' in catalogue.BY_ID[id_].tags
    limit = -1 if own else round(SECONDS / CONTROL_TIMESTEP)
    environments = VectorEnvironment(
        id_, episodes, 0, seed, step_limit=limit, autoreset='disabled', task_kwargs=options
    )
    policy, observation = make(environments), environments.reset()
    task, limit = environments.task, environments.step_limit
    assert limit is not None
    duration = np.full(episodes, CONTROL_TIMESTEP)  # s; of a step without hierarchy
    root = task.body.links[0]

    def places() -> np.ndarray:
        return task.world.xpos[:, root, :2].copy()

    going, fell = np.ones(episodes, bool), np.zeros(episodes, bool)
    reward, seconds, towards, path, goals, arrived = np.zeros((6, episodes))
    before = places()
    begin = along_trails(environments, before)
    trail = np.zeros(episodes)
    while going.any():
        step = environments.step(policy(observation), going)
        info, after = step.info, places()
        reward += step.reward * going
        duration = info.get('duration', duration)
        seconds += duration * going
        towards += info['speed'] * duration * going
        path += np.linalg.norm(after - before, axis=1) * going
        arrived += info.get('at_goal', np.zeros(episodes)) * duration * going
        if 'at_goal' not in info:
            goals[going] = info['goals_reached'][going]
        ended = step.terminated | step.truncated
        if (ended & going).any():
            last = along_trails(environments, after) - begin
            trail[ended & going] = last[ended & going]
        fell |= step.terminated & going
        going &= ~ended
        observation, before = step.observation, after
    environments.close()
    return {
        **({'of': digest(policy)} if isinstance(policy, policies.Policy) else {}),
        **({'controllers': [digest(each.policy) for each in task.controllers]} if own else {}),
        'episodes': episodes, 'seed': seed, 'reward': float(reward.mean() / limit),
        'survived': float(1 - fell.mean()),
        'survived_minute': float(1 - (fell & (seconds < MINUTE)).mean()), 'seconds': float(seconds.mean()),
        'speed': float(towards.sum() / seconds.sum()),
        'goals_per_minute': float(60 * goals.sum() / seconds.sum()),
        'trail': float(np.median(trail)), 'at_goal': float(arrived.sum() / seconds.sum()),
        'falls_per_km': float(1000 * fell.sum() / path.sum()),
    }  # fmt: skip


def shown(result: dict[str, Any]) -> dict[str, float]:
    """Returns the numbers of a result, rounded."""
    return {
        name: round(value, 3)
        for name, value in result.items()
        if not isinstance(value, (str, list))
    }


def maker(id_: str, name: str) -> Callable[[VectorEnvironment], Any] | None:
    """Returns a function that makes one of `POLICIES`; None if the environment does not have it."""
    spec = catalogue.BY_ID[id_]
    planned = 'hierarchical' in spec.tags
    if name == 'scripted':
        return scripted if planned else None
    if name == 'expert':
        if not planned:
            return joint_expert
        return None if spec.task_type == 'soccer' else expert
    try:
        policy = policies.reference(id_)
    except FileNotFoundError:
        return None
    return lambda environments: policy


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('pattern', nargs='?', default='PD_Biped3D_*', help='of ids')
    parser.add_argument('--policies', nargs='+', choices=POLICIES, default=POLICIES[:2])
    parser.add_argument('--episodes', type=positive, default=EPISODES)
    parser.add_argument('--seed', type=int, default=runs.TEST_SEED)
    parser.add_argument('--controller', help='id of another footstep controller')
    arguments = parser.parse_args()
    options, under = {}, ''
    specs = [spec for spec in catalogue.SPECS if spec.tags.intersection(TAGS)]
    if arguments.controller is not None:
        controller = suite.find(arguments.controller)
        options, under = {'controller': controller.id}, f' with {controller.id}'
        specs = [
            spec
            for spec in specs
            if 'hierarchical' in spec.tags and spec.character == controller.character
        ]
    known = [spec.id for spec in specs]
    ids = [id_ for id_ in known if fnmatch.fnmatchcase(id_, arguments.pattern)]
    if not ids:
        raise ValueError(errors.unknown(f'environment{under}', arguments.pattern, known))
    for id_ in ids:
        for name in arguments.policies:
            make = maker(id_, name)
            if make is None:
                continue
            result = run(id_, make, arguments.episodes, arguments.seed, **options)
            print(id_, name + under, shown(result), flush=True)
            runs.add('plans.json', id_, name + under, result)


if __name__ == '__main__':
    begin_script()
    main()
