"""Searches for a linear change of the plan that a footstep controller observes, without training it.

    python examples/tune_footsteps.py --output tuned.npz
    python examples/evaluate_footsteps.py tuned.npz
    python examples/tune_footsteps.py --output tuned.npz --enter
    python examples/tune_footsteps.py --body --output tuned.npz --enter

On steps of equal length a trained controller lands almost at the same distance from its plan each time.
Another plan in its observation corrects that, but may cost balance and heading: evaluate the result. The
plan z, in standard deviations and in right stance, becomes z + A y + b; y has the landing places and the
heading, and with `--body` also velocity and tilt of the pelvis and the phase. CMA-ES (Hansen 2016,
arXiv:1604.00772) selects A, b and a change of the output biases. The result is a network of the same
shape, with other weights in its first layer and other biases.

The score of a controller is the mean landing error in all conditions of `evaluate_footsteps.py`; an
error counts at most `MISS`, and as `MISS` in every step after a fall. All candidates of a generation
walk in the same episodes, and each generation has other ones. Heading errors do not count, nor do falls
after `SECONDS`, and both increase. Needs `pip install 'trl_suite[tune]'`.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import pathlib
from collections.abc import Sequence
from typing import Any

import numpy as np
import tqdm
import train_all
from evaluate_footsteps import CONDITIONS, ID, row_for

from trl_suite import evaluation, policies, suite
from trl_suite.util import files, resources
from trl_suite.util.program import begin_script
from trl_suite.vector import VectorEnvironment

MISS = 0.5  # m; largest landing error that counts
STEP = 0.5  # s; typical duration of a step
SECONDS = 6.0  # of an episode
EACH, COMPARED = 2, 32  # simulations of each condition, in the search and for the result
# Columns of the block plan in right stance: the landing places of the left and of the right foot (ahead
# and to the left), and the heading. Heights are inputs too, with the standard deviation of a slope.
PLAN, HEIGHTS = (3, 4, 6, 7, 12), (5, 8)
HEIGHT = 0.1  # m
# The velocity of the pelvis, ahead and to the left, its tilt, the phase and its first quarter.
BODY = (
    ('velocity', 0), ('velocity', 1), ('pose', 5), ('pose', 6), ('phase', 0), ('phase', 1),
)  # fmt: skip
BIAS = 0.2  # of the output biases, relative to the other parameters


def with_all_inputs(policy: policies.Policy) -> policies.Policy:
    """Returns the policy with all columns of its observation as inputs; added ones have weights of 0."""
    if policy.columns is None:
        return policy
    size = sum(size for _, size in policy.blocks)
    first, *others = policy.weights
    mean, std, weights = np.zeros(size), np.ones(size), np.zeros((size, first.shape[1]))
    for whole, part in ((mean, policy.mean), (std, policy.std), (weights, first)):
        whole[policy.columns] = part
    return dataclasses.replace(policy, columns=None, mean=mean, std=std, weights=(weights, *others))


class Tuning:
    """A controller with parameters that change its plan; 0: no change."""

    def __init__(self, policy: policies.Policy, body: bool = False) -> None:
        """Makes parameters for the plan, and with `body` also for inputs from other blocks.

        Raises:
          ValueError: the policy has no plan in its observation.
        """
        if 'plan' not in dict(policy.blocks):
            raise ValueError(f'{policy.id}: expected a footstep controller, with a block plan')
        policy = with_all_inputs(policy)
        starts, start = {}, 0
        for name, size in policy.blocks:
            starts[name], start = start, start + size
        plan = starts['plan']
        self.plan = plan + np.array(PLAN)
        more = [starts[name] + column for name, column in BODY] if body else []
        self.inputs = np.array([*self.plan, *(plan + k for k in HEIGHTS), *more])
        # Heights were always 0 in training. They have no weights, and no standard deviation either.
        std = policy.std.copy()
        heights = plan + np.array(HEIGHTS)
        std[heights[~policy.weights[0][heights].any(1)]] = HEIGHT
        self.policy = dataclasses.replace(policy, std=std)
        self.shape = len(PLAN), len(self.inputs) + 1
        self.size = self.shape[0] * self.shape[1] + len(policy.biases[-1])

    def changed(self, parameters: np.ndarray) -> policies.Policy:
        """Returns the controller with parameters (size,)."""
        change, outputs = np.split(parameters, [self.shape[0] * self.shape[1]])
        change = change.reshape(self.shape)
        first, *others = self.policy.weights
        bias, *more, last = self.policy.biases
        rows = first[self.plan]
        first = first.copy()
        first[self.inputs] += change[:, :-1].T @ rows
        bias = bias + change[:, -1] @ rows
        return dataclasses.replace(
            self.policy, weights=(first, *others), biases=(bias, *more, last + BIAS * outputs)
        )


class Score:
    """Simulations in all conditions, in which controllers are compared."""

    def __init__(self, controllers: int, each: int, seconds: float) -> None:
        """Makes `each` simulations per condition and controller."""
        self.controllers, self.each, self.steps = controllers, each, round(seconds * 30)
        self.parts = []
        for name in CONDITIONS:
            options = dict(CONDITIONS[name])
            row = row_for(ID, options.pop('terrain', None))
            self.parts.append(
                VectorEnvironment(
                    row, controllers * each, 1, 0, autoreset='disabled',
                    step_limit=self.steps + 1, task_kwargs=options,
                )
            )  # fmt: skip

    def __call__(self, controllers: Sequence[policies.Policy], seed: int) -> np.ndarray:
        """Returns the scores of controllers in all conditions, (m, conditions) m."""
        return np.stack(
            [self.in_part(part, controllers, (seed, i)) for i, part in enumerate(self.parts)], 1
        )

    def in_part(
        self,
        part: VectorEnvironment,
        controllers: Sequence[policies.Policy],
        entropy: Sequence[int],
    ) -> np.ndarray:
        """Returns the scores of controllers in one condition, (m,) m; all have the same episodes."""
        seeds = np.random.SeedSequence(entropy).generate_state(self.each)
        observation = part.reset(seed=np.tile(seeds, self.controllers).tolist())
        runs = np.ones(part.num_envs, bool)
        errors, steps = np.zeros(part.num_envs), np.zeros(part.num_envs)
        for t in range(self.steps):
            own = observation.reshape(self.controllers, self.each, -1)
            step = part.step(
                np.concatenate(
                    [policy(seen) for policy, seen in zip(controllers, own, strict=True)]
                )
            )
            landed = runs & step.info['landed']
            errors[landed] += np.minimum(step.info['landing_error'][landed], MISS)
            steps[landed] += 1
            fallen = runs & step.terminated
            left = (self.steps - t) / 30 / STEP
            errors[fallen] += MISS * left
            steps[fallen] += left
            runs &= ~step.terminated
            observation = step.observation
            if step.terminated.any():  # ended simulations have to be reset before the next step
                observation = part.reset(step.terminated)
        return (errors / np.maximum(steps, 1)).reshape(self.controllers, self.each).mean(1)


def enter(policy: policies.Policy, record: dict[str, Any]) -> None:
    """Ships a controller; the search is added to `tuned` of the training run."""
    trained = resources.directory('trained')
    path = trained / f'{ID}.json'
    stored = json.loads(path.read_text())
    run = train_all.shipped(stored)
    run.setdefault('tuned', []).append(record)
    run['evaluation'] = evaluation.evaluate(ID, policy, train_all.EPISODES, train_all.SEED, 1)
    policies.save(policy, trained / f'{ID}.npz')
    with files.replacing(path) as part:
        part.write_text(json.dumps(stored) + '\n')


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--policy', help='.npz file; the reference policy by default')
    parser.add_argument('--body', action='store_true', help='with inputs from other blocks')
    parser.add_argument('--generations', type=int, default=100)
    parser.add_argument('--population', type=int, default=16)
    parser.add_argument('--sd', type=float, default=0.03, help='initial standard deviation')
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--output', type=pathlib.Path, required=True)
    parser.add_argument('--enter', action='store_true', help='ship the result')
    arguments = parser.parse_args()
    import cma

    given = arguments.policy
    tuned = policies.load(given) if given else suite.reference_policy(ID)
    tuning = Tuning(tuned, arguments.body)
    score = Score(arguments.population, EACH, SECONDS)
    strategy = cma.CMAEvolutionStrategy(
        np.zeros(tuning.size),
        arguments.sd,
        {'popsize': arguments.population, 'seed': arguments.seed, 'verbose': -9},
    )
    with tqdm.tqdm(total=arguments.generations, unit='generation') as bar:
        for generation in range(arguments.generations):
            candidates = strategy.ask()
            controllers = [tuning.changed(candidate) for candidate in candidates]
            found = score(controllers, arguments.seed + generation).mean(1)
            strategy.tell(candidates, found)
            policies.save(tuning.changed(strategy.mean), arguments.output)
            bar.set_postfix(best=found.min(), mean=found.mean(), refresh=False)
            bar.update()
    compared = {'before': tuned, 'after': tuning.changed(strategy.mean)}
    scores = Score(len(compared), COMPARED, SECONDS)(list(compared.values()), arguments.seed - 1)
    for name, values in zip(compared, scores, strict=True):
        print(f'{name:8} {values.mean():.4f}', dict(zip(CONDITIONS, values.round(3), strict=True)))
    if arguments.enter:
        record = {
            'program': pathlib.Path(__file__).name, 'body': arguments.body,
            'seed': arguments.seed, 'sd': arguments.sd,
            'generations': arguments.generations, 'population': arguments.population,
            'scores': {name: dict(zip(CONDITIONS, values.tolist(), strict=True))
                       for name, values in zip(compared, scores, strict=True)},
        }  # fmt: skip
        enter(compared['after'], record)


if __name__ == '__main__':
    begin_script()
    main()
