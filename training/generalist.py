"""Trains one policy for all PLAiD terrains of a character: distillation of its specialists, then PPO.

    python training/generalist.py biped2d
    python training/generalist.py dog2d raptor2d --runs runs/generalist

The specialists are the shipped policies of the eight terrains. A new network imitates them in states
that it visits itself, DAgger as in `continual.py` (Ross et al. 2011, arXiv:1011.0686), and is then trained
with PPO in the environments of all terrains at the same time. A third policy has the mean weights of both
(Wortsman et al. 2022, arXiv:2203.05482). The policy has no information about the terrain but its
observation.

Writes the best of the three policies to `trained/generalist/ID.npz`, where ID is the character's
environment of mixed terrain, makes it the policy of the other terrains, too, in
`trained/generalist/shared.json`, and writes settings, learning curve, and evaluations of specialists,
distilled, trained and averaged policy to `ID.json`; specialists and the best policy are evaluated again in
episodes that had no part in its choice.
"""

from __future__ import annotations

import argparse
import dataclasses
import pathlib
import time
from typing import Any

import numpy as np
import ppo
import runs
import torch
import tqdm
from continual import distil
from networks import mean_of, trimmed
from settings import settings_for
from several import Several
from train_all import OTHER_SEED, SEED

from trl_suite import evaluation, policies
from trl_suite.util.digest import digest
from trl_suite.util.program import begin_script
from trl_suite.vector import VectorEnvironment

CHARACTERS = {'biped2d': 'Biped2D', 'dog2d': 'Dog2D', 'raptor2d': 'Raptor2D'}
GROUNDS = 'Flat', 'Incline', 'Steps', 'Slopes', 'Gaps', 'Walls', 'Mixed', 'Slopes_Mixed'
EPISODES = 200  # of an evaluation on each terrain
RESULTS = (
    'return', 'return_interval', 'normalized_return', 'completion_rate', 'distance', 'episodes', 'seed',
)  # fmt: skip


# The first control steps of PPO only train the value, as after the start from a policy.
COMMON = {
    'hidden': (512, 256), 'gamma': 0.97, 'stages': (), 'averaged': 3e5,
    'start': 'expert', 'value_first': 2e5,
}  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Settings:
    """Settings of a run, besides character and seed."""

    distilled: int = 1_000_000  # control steps, of all terrains together
    rounds: int = 8  # of DAgger
    epochs: int = 8  # of each round, over all labels so far
    each: int = 16  # simulations of each terrain
    twice: tuple[str, ...] = ('Mixed', 'Slopes_Mixed')  # terrains with twice as many
    ppo: dict[str, Any] = dataclasses.field(
        default_factory=lambda: {
            **COMMON, 'samples': 1e6,
            # With large updates it forgets faster than it learns.
            'horizon': 64, 'minibatch': 1024, 'learning_rate': 5e-5, 'last_learning_rate': 2e-5,
            'kl_per_action': 0.001,
        }
    )  # fmt: skip


LARGE_UPDATES = {  # after the value has been learnt at a high rate
    **COMMON, 'samples': 2.5e6, 'gamma': 0.98, 'minibatch': 1024, 'learning_rate': 2e-4,
    'last_learning_rate': 2e-5, 'value_rate': 1e-3, 'value_goes_on': True,
}  # fmt: skip
# With as many simulations over walls as elsewhere the policies of biped and raptor were worst there.
SETTINGS = {
    'biped2d': Settings(twice=('Walls', 'Mixed', 'Slopes_Mixed'), each=24, ppo=LARGE_UPDATES),
    'dog2d': Settings(each=24, ppo=LARGE_UPDATES),
    'raptor2d': Settings(twice=('Walls', 'Mixed', 'Slopes_Mixed')),
}


def ids_of(character: str) -> list[str]:
    """Returns the environments of a character."""
    return [f'PD_{CHARACTERS[character]}_{ground}_Terrain-v0' for ground in GROUNDS]


def evaluated(chosen: dict[str, policies.Policy], seed: int = SEED) -> dict[str, dict[str, Any]]:
    """Evaluates in each environment the policy that is chosen for it."""
    results = evaluation.evaluate_all(list(chosen.items()), EPISODES, seed, 1)
    return {r['id']: {key: r[key] for key in RESULTS} for r in results}


def mean_score(results: dict[str, dict[str, Any]]) -> float:
    """Returns the mean over the environments of the return divided by its maximum."""
    return float(np.mean([found['normalized_return'] for found in results.values()]))


def train(
    specialists: dict[str, policies.Policy], seed: int, settings: Settings, folder: pathlib.Path
) -> tuple[policies.Policy, policies.Policy, list[dict[str, Any]]]:
    """Returns the distilled and the trained policy, and the learning curve."""
    torch.set_num_threads(1)
    ids, experts = list(specialists), list(specialists.values())
    counts = [settings.each * (2 if ground in settings.twice else 1) for ground in GROUNDS]
    own = settings_for(
        ids[-2], **settings.ppo, cloning_epochs=settings.epochs, num_envs=sum(counts)
    )
    trainer = ppo.Trainer(ids[-2], seed, own, 1)
    trainer.environments.close()
    log_std = np.mean([expert.log_std for expert in experts], axis=0)
    trainer.log_std.data.copy_(torch.from_numpy(log_std.astype(np.float32)))
    seeds = np.random.SeedSequence(seed).generate_state(len(ids))
    environments = Several([
        VectorEnvironment(id_, count, 1, int(own_seed), autoreset='disabled')
        for id_, count, own_seed in zip(ids, counts, seeds, strict=True)
    ])  # fmt: skip
    distil(trainer, environments, experts, settings.distilled, settings.rounds)
    distilled = trainer.exported()
    policies.save(distilled, folder / 'distilled.npz')
    trainer.enter(environments)
    curve: list[dict[str, Any]] = []
    every = own.samples / 20
    with tqdm.tqdm(total=int(own.samples), unit='sample') as bar:
        while trainer.samples < own.samples:
            before = trainer.samples
            trainer.learn(trainer.collect())
            trainer.average.update_parameters(trainer.policy)
            bar.update(trainer.samples - before)
            if runs.passed(before, trainer.samples, every):
                returned, length, _ = (trainer.recent / max(trainer.recent[2], 1)).tolist()
                curve.append({'samples': trainer.samples, 'return': returned, 'length': length})
                trainer.recent[:] = 0
                policies.save(trainer.exported(), folder / 'last.npz')
    return distilled, trainer.exported(), curve


def enter(ids: list[str], policy: policies.Policy, entry: dict[str, Any]) -> None:
    """Ships the policy of a character, with its results."""
    path = runs.place(f'generalist/{policy.id}.npz')
    path.parent.mkdir(parents=True, exist_ok=True)
    policies.save(policy, path)
    runs.write(f'generalist/{policy.id}.json', {**entry, 'of': digest(policy)})
    for id_ in ids:
        if id_ != policy.id:
            runs.enter(f'generalist/{policies.SHARED}', id_, {'policy': policy.id})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('characters', nargs='+', choices=CHARACTERS)
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--runs', type=pathlib.Path, default=pathlib.Path('runs/generalist'))
    parser.add_argument(
        '--samples', type=float, help='control steps of PPO, instead of the default'
    )
    arguments = parser.parse_args()
    runs.check_seeds('--seed', arguments.seed)
    for character in arguments.characters:
        settings = SETTINGS[character]
        if arguments.samples is not None:
            own = {**settings.ppo, 'samples': arguments.samples}
            settings = dataclasses.replace(settings, ppo=own)
        ids, folder = ids_of(character), arguments.runs / character
        begin = time.monotonic()
        specialists = {id_: policies.reference(id_) for id_ in ids}
        with runs.only_run(folder):
            distilled, policy, curve = train(specialists, arguments.seed, settings, folder)
        averaged = mean_of([distilled, policy])
        found = {'distilled': distilled, 'trained': policy, 'averaged': averaged}
        made = {kind: trimmed(each) for kind, each in found.items()}
        results = {kind: evaluated(dict.fromkeys(ids, p)) for kind, p in made.items()}
        best = max(made, key=lambda kind: mean_score(results[kind]))
        entry = {
            'ids': ids, 'seed': arguments.seed, 'settings': dataclasses.asdict(settings),
            'machine': runs.machine(),
            'seconds': round(time.monotonic() - begin), 'curve': curve,
            'distilled_from': {id_: digest(each) for id_, each in specialists.items()},
            'specialists': evaluated(specialists), **results, 'shipped': best,
            # In episodes that had no part in the choice.
            'specialists_again': evaluated(specialists, OTHER_SEED),
            'shipped_again': evaluated(dict.fromkeys(ids, made[best]), OTHER_SEED),
        }  # fmt: skip
        enter(ids, made[best], entry)
        for id_ in ids:
            words = ' '.join(
                f'{entry[kind][id_]["normalized_return"]:.3f} ({entry[kind][id_]["completion_rate"]:.0%})'
                for kind in ('specialists', *made)
            )
            print(f'{id_:40} {words}', flush=True)


if __name__ == '__main__':
    begin_script()
    main()
