"""Tracking a motion clip over terrain, in the plane or in space: the Imitation and PLAiD families.

Source: the imitation scenario of the original; 'Does the choice of action space matter?' (Peng &
van de Panne 2017) and 'Progressive reinforcement learning with distillation for multi-skilled
motion control' (Berseth et al. 2018).
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from trl_suite.actuation.muscles import PLAIN
from trl_suite.bodies.blocks import Block
from trl_suite.bodies.body import write_distance
from trl_suite.bodies.reference import feature, moment, observe_phase
from trl_suite.characters import Character
from trl_suite.tasks import rewards
from trl_suite.tasks.common.control import MirroredConfig, PlanarConfig
from trl_suite.tasks.common.goals import GOAL, observe_place
from trl_suite.tasks.rewards import (
    com_error,
    conclude,
    effector_error,
    motion_errors,
    score_tracking,
)
from trl_suite.tasks.tracking import TrackingData, TrackingTask, proceed, publish
from trl_suite.util.compiled import compiled
from trl_suite.util.options import option

GOAL_AHEAD = 3.0  # m; distance of the goal from the root, along +x on the line through the start
REFERENCE = 'observe the state of the reference instead of the phase'


# A step of simulation i, after the body was measured.


@compiled
def compare(i: int, data: TrackingData) -> None:
    """Writes the reward terms, from errors of pose, velocities and end effectors."""
    comparison, measurement = data.comparison, data.measurement
    row, fraction = moment(data.clock.phase[i], 0, comparison.tracks)
    pose, velocity, height = motion_errors(i, row, fraction, comparison, measurement)
    end_effector = effector_error(i, row, fraction, comparison, measurement)
    turned = np.floor(data.clock.cycles[i]) * data.turn
    com = com_error(i, row, fraction, turned, comparison, measurement)
    terms, outcome = comparison.terms, data.outcome
    score_tracking(i, pose, velocity, end_effector, com, height, terms, outcome)


@compiled
def observe(i: int, data: TrackingData) -> None:
    """Writes the blocks after those of the body: phase or reference, and the goal."""
    columns, full = data.shown.columns, data.shown.full
    observe_phase(i, columns, data.clock, full)
    if columns.reference >= 0:
        tracks, features = data.comparison.tracks, data.comparison.columns
        row, fraction = moment(data.clock.phase[i], 0, tracks)
        full[i, columns.reference] = feature(row, fraction, features.height, tracks)
        for k in range(data.comparison.poses):  # positions and velocities of the links
            value = feature(row, fraction, features.positions + k, tracks)
            full[i, columns.reference + 1 + k] = value
    if columns.goal >= 0:
        aside = data.travel.origin[i, 1] - data.measurement.root[i, 1]
        observe_place(i, columns.goal, GOAL_AHEAD, aside, data.measurement, full)
    publish(i, data.shown, data.outcome)


def motion_blocks(character: Character, reference: bool) -> tuple[Block, ...]:
    """Returns the blocks that `observe` writes after the phase; `reference`: instead of the phase."""
    spec = character.spec
    numbers = 1 + (6 if spec.spatial else 4) * len(spec.links)
    return (
        Block(
            'reference',
            numbers if reference else 0,
            'm, m/s',
            'root height, link centres from the root, and velocities of link centres of the reference',
            'the reference is known to the controller',
        ),
        dataclasses.replace(
            GOAL,
            meaning='bearing (positive to the left) and distance of the point 3 m ahead on the line '
            'along +x through the start',
        ).observed_if(spec.spatial),
    )


# Loops over simulations; they take packs.


@compiled
def finish_all(env_ids: np.ndarray, data: TrackingData) -> None:
    """Finishes steps: computes reward, failure and observation."""
    for i in env_ids:
        if proceed(i, data):
            compare(i, data)
            conclude(i, data.measurement.fallen[i], data.outcome)
            observe(i, data)


@compiled
def observe_all(env_ids: np.ndarray, data: TrackingData) -> None:
    """Writes distances, reward terms of the current state, and observations."""
    for i in env_ids:
        write_distance(i, data.along, data.measurement, data.travel)
        compare(i, data)
        observe(i, data)


@dataclasses.dataclass(frozen=True, kw_only=True)
class PlanarImitationConfig(PlanarConfig):
    """Options of `PlanarImitation`."""

    reference_observation: bool = option(False, REFERENCE)
    muscle_set: str = option(
        PLAIN,
        "set of muscle parameters: 'plain', or the motion for which they were optimised (biped: 'walk', "
        "'run'; dog: 'bound'; raptor: 'run')",
        actuation='muscle',
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class SpatialImitationConfig(MirroredConfig):
    """Options of `SpatialImitation`."""

    reference_observation: bool = option(False, REFERENCE)


class Imitation(TrackingTask):
    """A character tracks a looping clip along +x, over random terrain."""

    terms = rewards.IMITATION_TERMS
    finish_all, observe_all = finish_all, observe_all
    draws = False
    along = True

    def _further_blocks(self, character: Character, config: Any) -> tuple[Block, ...]:
        return motion_blocks(character, config.reference_observation)

    def reference_pose(self, env_id: int) -> np.ndarray:
        """Returns the pose of the reference from the same start: root, then joints."""
        cycles = np.array([self.clock.start[env_id], self.cycles[env_id]])
        first, pose = self.clip.pose(cycles * self.period)
        level = 2 if self._spatial else 1
        pose[:level] += self.travel.origin[env_id, :level] - first[:level]
        return self._on_ground(env_id, pose)


class PlanarImitation(Imitation):
    """A planar character tracks a looping clip.

    Positions are observed from the root; x is mirrored while the trunk points backwards.
    """

    CONFIG: Any = PlanarImitationConfig


class SpatialImitation(Imitation):
    """A spatial character tracks a looping clip along +x.

    The goal is a point on the line through the start along +x. The original observes bearing and
    distance of the start instead, from which the direction +x cannot be derived.

    Mirrored observations and actions are reflected while the phase is 0.5 or more; the block phase
    then has the phase of the single step and the one-hot of its half.
    """

    CONFIG: Any = SpatialImitationConfig
