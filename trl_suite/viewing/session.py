"""Steps an environment with a policy, one frame at a time, for the viewers."""

from __future__ import annotations

import collections
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import mujoco
import numpy as np

from trl_suite.rendering import Policy
from trl_suite.rendering.overlays import root_joint
from trl_suite.util import errors
from trl_suite.viewing.playback import Playback

if TYPE_CHECKING:
    from trl_suite.environments.environment import Environment
    from trl_suite.registry.spec import EnvSpec

HISTORY = 300  # frames in the plots: 10 s
PUSHES: Mapping[str, tuple[float, float, float]] = {  # directions, in world axes
    'back': (-1, 0, 0),
    'forward': (1, 0, 0),
    'left': (0, 1, 0),
    'right': (0, -1, 0),
    'up': (0, 0, 1),
}


class Moment(NamedTuple):
    """The values that are plotted for one frame."""

    time: float  # simulated time since the session began, s
    rewards: np.ndarray  # the reward, then its terms, in the order of `Session.reward_names`
    torques: np.ndarray  # (k,) N m; actuator torque on each joint axis


class Loaded(NamedTuple):
    """An environment with all policies that fit it, and which of them acts."""

    spec: EnvSpec
    environment: Environment
    policies: dict[str, Policy]
    policy: str


class Session:
    """An environment and a policy, with the plotted values of the last frames.

    Attributes:
      environment: the environment. Read from it, but do not step it.
      policy: the policy. It may be replaced at any time.
      time_step: the latest time step.
      history: the `Moment`s of the last `HISTORY` frames.
      reward_names: 'reward', then the names of its terms.
      joint_axes: names of the joint axes, in the order of `Moment.torques`.
      episode: number of episodes started since the last seed was set.
      steps: number of control steps of the current episode.
      total: return of the current episode.
    """

    def __init__(self, environment: Environment, policy: Policy, seed: int | None = None) -> None:
        """Starts the first episode; without a seed, the random state stays as it is.

        Nothing else may step the environment.
        """
        self.environment, self.policy = environment, policy
        self._frames: Any = environment
        if hasattr(environment.task, 'watch'):
            self._frames = Playback(environment, lambda time_step: self.policy(time_step))
        model = environment.physics.model
        root_dofs, self._root_dof = _root_dofs(environment)
        joints = [
            i
            for i in range(model.nv)
            if i not in root_dofs and model.dof_treeid[i] == model.dof_treeid[self._root_dof]
        ]
        self._joint_dofs = np.array(joints, int)
        self.joint_axes = tuple(_axis_name(model, dof) for dof in joints)
        terms = environment.info.get('reward_terms', {})
        self.reward_names = ('reward', *(terms if len(terms) > 1 else ()))
        self.history: collections.deque[Moment] = collections.deque(maxlen=HISTORY)
        self._clock, self.episode = 0.0, 0
        self.reset(seed)

    def reset(self, seed: int | None = None) -> None:
        """Starts an episode; with a seed, the counts and the plots start again, too."""
        if seed is not None:
            self.environment.random_state.seed(seed)
            self.environment.core.seeds[0] = seed
            self.episode = 0
            self.history.clear()
            self._clock = 0.0
        self.time_step = self._frames.reset()
        self._begin()

    def _begin(self) -> None:
        """Resets the counts for a new episode."""
        self.episode += 1
        self.steps, self.total = 0, 0.0
        self._push = np.zeros(3)  # m/s

    def advance(self) -> float:
        """Simulates until the next frame; after the end of an episode, starts the next one.

        Returns:
          The simulated time that has passed, s; 0 if an episode was started.
        """
        physics = self.environment.physics
        before = physics.data.time
        act = self._frames.policy if isinstance(self._frames, Playback) else self.policy
        if self._push.any() and self.is_between_steps:
            self._apply_push()
        if self.time_step.last():
            self.time_step = self._frames.reset()
        else:
            self.time_step = self._frames.step(act(self.time_step))
        if self.time_step.first():
            self._begin()
            return 0.0
        if self.is_between_steps:
            self.steps += 1
            self.total += self.time_step.reward
        passed = physics.data.time - before
        self._clock += passed
        self.history.append(
            Moment(
                self._clock, self._rewards(), physics.data.qfrc_actuator[self._joint_dofs].copy()
            )
        )
        return passed

    @property
    def is_between_steps(self) -> bool:
        """Whether the next frame starts a control step, with a new action of the policy."""
        return not (isinstance(self._frames, Playback) and self._frames.is_within_step)

    def push(self, direction: str, speed: float) -> None:
        """Adds a velocity to the character's root before the next control step.

        Args:
          direction: one of `PUSHES`. 'left' and 'right' have no effect on a planar character.
          speed: magnitude of the velocity, m/s.
        """
        errors.check_known('direction', PUSHES, direction)
        self._push = speed * np.array(PUSHES[direction])

    def _apply_push(self) -> None:
        model, world = self.environment.physics.model, self.environment.task.world
        joint = model.dof_jntid[self._root_dof]
        free = model.jnt_type[joint] == int(mujoco.mjtJoint.mjJNT_FREE)
        change = self._push if free else self._push[[0, 2]]
        world.qvel[0, self._root_dof : self._root_dof + len(change)] += change
        world.forward(world.all_ids)
        self._push = np.zeros(3)

    def status(self) -> dict[str, str]:
        """Returns the texts of the status display, by name."""
        info = self.environment.info
        texts = {
            'episode': str(self.episode),
            'step': str(self.steps),
            'time': f'{self.environment.physics.data.time:.1f} s',
            'return': f'{self.total:.2f}',
        }
        if 'distance' in info:
            texts['distance'] = f'{info["distance"]:.2f} m'
        if self.environment.ending:
            texts['end'] = self.environment.ending
        return texts

    def _rewards(self) -> np.ndarray:
        terms = self.environment.info.get('reward_terms', {})
        rewards = [float(self.environment.task.seen.reward[0]), *terms.values()]
        return np.array(rewards[: len(self.reward_names)])


def _root_dofs(environment: Any) -> tuple[set[int], int]:
    """Returns the dof ids of the character's root joints, and the first of them."""
    model = environment.physics.model
    joint = root_joint(model, environment.task)
    first = int(model.jnt_dofadr[joint])
    free = model.jnt_type[joint] == int(mujoco.mjtJoint.mjJNT_FREE)
    return set(range(first, first + (6 if free else 3))), first


def _axis_name(model: Any, dof: int) -> str:
    """Returns the joint's name of a dof; for a ball joint, with the letter of the axis."""
    joint = int(model.dof_jntid[dof])
    name = (model.id2name(joint, 'joint') or f'joint {joint}').rpartition('/')[2]
    if model.jnt_type[joint] == int(mujoco.mjtJoint.mjJNT_BALL):
        name += f' {"xyz"[dof - int(model.jnt_dofadr[joint])]}'
    return name
