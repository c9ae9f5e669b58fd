"""Tests of how feet touch the ground: what `benchmarks/contacts.py` measures, and docs/reports/robustness.md states."""

import pathlib
import sys

import numpy as np
from absl.testing import parameterized

from trl_suite import policies, suite

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[1] / 'benchmarks'))
import contacts

NONE, EPISODES = ([], {}, False), 2
SOFT = ([], {'randomize': {'contact_depth': 0.01}}, False)


def walked(name, change):
    """Returns the means over episodes of a walk, and the forces in the last one, weights."""
    id_ = contacts.WALKS[name]
    subject = contacts.Subject(id_, 0, change)
    found = [subject.episode(policies.reference(id_)) for _ in range(EPISODES)]
    forces = np.sum(subject.forces, axis=1) / subject.weight
    return {key: np.mean([each[key] for each in found]) for key in found[0]}, forces


class ContactTest(parameterized.TestCase):
    def test_recording_changes_nothing(self):
        id_ = contacts.WALKS['dog']
        policy, environment = policies.reference(id_), suite.make(id_, {'random': 0})
        time_step, total = environment.reset(), 0.0
        while not time_step.last():
            time_step = environment.step(policy(time_step.observation))
            total += time_step.reward
        self.assertEqual(contacts.Subject(id_, 0, NONE).episode(policy)['return'], total)

    # Bounds around the measured numbers of the page.
    @parameterized.parameters(
        ('biped', 11, 18, 3.5, 6), ('dog', 9, 16, 12, 20), ('raptor', 5, 10, 4, 7)
    )
    def test_feet_rattle_and_keep_the_ground_if_its_stiffness_rises_gradually(
        self, name, least, most, light, heavy
    ):
        (hard, forces), (soft, _) = walked(name, NONE), walked(name, SOFT)
        # On average the ground carries the weight, as in every gait that neither rises nor sinks.
        self.assertBetween(forces.mean(), 0.95, 1.05)
        self.assertBetween(hard['lift-offs'], least, most)
        self.assertGreater(hard['short'], 0.65 * hard['lift-offs'])
        self.assertBetween(hard['height'], 0.01, 0.6)
        self.assertBetween(hard['99 %'], light, heavy)
        self.assertLess(soft['lift-offs'], 3)
        self.assertLess(soft['short'], 0.15 * hard['short'])
        self.assertGreater(soft['return'], 0.97 * hard['return'])
