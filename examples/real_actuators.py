"""A shipped policy with ideal actuators, and with those that a robot might have."""

import argparse

from trl_suite import evaluation, policies
from trl_suite.util.program import begin_script

ACTUATORS = {
    'ideal': {},
    'torque_speed': {'torque_speed': True, 'no_load_speed': 10.0},
    'torque_pose': {'torque_pose': True},
    'delay': {'delay': (10, 30)},
    'flex': {'flex': 0.1},
    'backlash': {'backlash': 0.05},
    'noise': {'noise': 0.1},
    'strength': {'strength': (0.7, 1.3)},
}
ACTUATORS['all'] = {name: value for each in ACTUATORS.values() for name, value in each.items()}

begin_script()
parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument('--id', default='PD_Biped2D_LLC_Imitate_Flat-v0', help='of a biped')
parser.add_argument('--episodes', type=int, default=50)
args = parser.parse_args()
policy = policies.reference(args.id)
for name, options in ACTUATORS.items():
    result = evaluation.evaluate(
        args.id, policy, args.episodes, seed=0, task_kwargs={'actuators': options}
    )
    print(
        f'{name:12} return {result["return"]:6.1f}, {result["normalized_return"]:.2f} of the best'
    )
