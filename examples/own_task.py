"""Adds a reward term, a block and a failure to a task. Needs `trl_suite[gymnasium,video,policies]`."""

import argparse
import pathlib

import numpy as np
from matplotlib.figure import Figure

from trl_suite import suite
from trl_suite.gym import SuiteEnv
from trl_suite.tasks import parts
from trl_suite.util.program import begin_script
from trl_suite.vector import VectorEnvironment

begin_script()
parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument('id', nargs='?', default='PD_Biped2D_Gaps_Terrain-v0')
parser.add_argument('--seed', type=int, default=1)
parser.add_argument('--output', type=pathlib.Path, default='own_task.png')
args = parser.parse_args()
mine = {  # functions of the task; arrays with one entry per simulation
    'rewards': {'fast': (0.5, lambda task: np.clip(parts.speed(task) / 2, 0, 1))},
    'observations': {'speed': (1, parts.speed)},
    'failures': {'low': lambda task: parts.height(task) < 0.5},
}
env = suite.make(args.id, task_kwargs={'random': args.seed, **mine})
trained = suite.reference_policy(args.id)  # does not use the added block
terms, time_step = [], env.reset()
while not time_step.last() and len(terms) < 100:
    seen = {name: time_step.observation[name] for name in env.task.blocks}
    time_step = env.step(trained(seen))
    terms.append([*env.info['reward_terms'].values()])
print(f'{len(terms)} steps, {env.info["distance"]:.1f} m; blocks {", ".join(env.blocks)}')
many = VectorEnvironment(args.id, 4, seed=args.seed, task_kwargs=mine)
print('of 4 at once:', many.reset().shape)
print('Gymnasium:', SuiteEnv(args.id, task_kwargs=mine).observation_space.shape)
figure = Figure(figsize=(8, 3), layout='constrained')
figure.subplots().stackplot(range(len(terms)), np.transpose(terms), labels=env.info['reward_terms'])
figure.legend(loc='outside right', title='reward terms by step')
figure.savefig(args.output)
