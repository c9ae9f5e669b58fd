"""An environment under a policy, advanced frame by frame: what viewers show."""

from __future__ import annotations

import collections
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import dm_env
import mujoco
import numpy as np

from trl_suite.util import errors
from trl_suite.viewing.frames import Frames

if TYPE_CHECKING:
    from trl_suite.environments.environment import Environment

Policy = Callable[[dm_env.TimeStep], np.ndarray]

FRAME = 1 / 30  # s; the longest time between two frames
HISTORY = 300  # frames: 10 s
PUSHES: Mapping[str, tuple[float, float, float]] = {  # axes of the world
    'back': (-1, 0, 0), 'forward': (1, 0, 0), 'left': (0, 1, 0), 'right': (0, -1, 0), 'up': (0, 0, 1),
}  # fmt: skip
_ENDS = ('fell', 'stuck', 'diverged')  # of an episode, in the info


class Moment(NamedTuple):
    """What is plotted of a frame.

    Attributes:
      time: since the session began, s.
      rewards: the reward, then its terms, in the order of `Session.reward_names`.
      torques: of the actuators on each joint axis, (k,) N m.
    """

    time: float
    rewards: np.ndarray
    torques: np.ndarray


class Session:
    """An environment, a policy, and what has happened so far.

    Attributes:
      environment: may be looked at, but not stepped.
      policy: may be replaced.
      time_step: the last one.
      history: the last `HISTORY` moments.
      reward_names: 'reward', then the names of its terms.
      joint_axes: names of the joint axes that torques act on.
      episode: number of episodes begun.
      steps, total: control steps and return of this episode.
    """

    def __init__(self, environment: Environment, policy: Policy, seed: int | None = None) -> None:
        """Begins an episode.

        Args:
          environment: nothing else may step it.
          policy: time step -> action.
          seed: of the episodes from now on; None goes on in the environment's own stream.
        """
        self.environment, self.policy = environment, policy
        self._frames: Any = environment
        if hasattr(environment.task, 'watch'):
            self._frames = Frames(environment, lambda time_step: self.policy(time_step))
        model = environment.physics.model
        root_dofs, self._root_dof = _root_dofs(environment)
        joints = [
            i for i in range(model.nv)
            if i not in root_dofs and model.dof_treeid[i] == model.dof_treeid[self._root_dof]
        ]  # fmt: skip
        self._joint_dofs = np.array(joints, int)
        self.joint_axes = tuple(_axis_name(model, dof) for dof in joints)
        terms = environment.info.get('reward_terms', {})
        self.reward_names = ('reward', *(terms if len(terms) > 1 else ()))
        self.history: collections.deque[Moment] = collections.deque(maxlen=HISTORY)
        self._clock, self.episode = 0.0, 0
        self.reset(seed)

    def reset(self, seed: int | None = None) -> None:
        """Begins an episode; arguments are those of the constructor."""
        if seed is not None:
            self.environment.random_state.seed(seed)
            self.episode = 0
            self.history.clear()
            self._clock = 0.0
        self.time_step = self._frames.reset()
        self._begin()

    def _begin(self) -> None:
        """Counts from the start of an episode."""
        self.episode += 1
        self.steps, self.total = 0, 0.0
        self._push = np.zeros(3)  # m/s

    def advance(self) -> float:
        """Goes on by a frame, after the end of an episode to the start of the next one.

        Returns:
          The simulated time that has passed, s; 0 at a start.
        """
        physics = self.environment.physics
        before = physics.data.time
        act = self._frames.policy if isinstance(self._frames, Frames) else self.policy
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
        """Whether a control step has ended, so that the next frame asks the policy."""
        return not (isinstance(self._frames, Frames) and self._frames.is_within_step)

    def push(self, direction: str, speed: float) -> None:
        """Gives the whole body a speed at once, before the next step that is simulated.

        Args:
          direction: one of `PUSHES`; what is planar is not pushed to the side.
          speed: m/s.

        Raises:
          ValueError: an unknown direction.
        """
        if direction not in PUSHES:
            raise ValueError(errors.unknown('direction', direction, PUSHES))
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
        """Returns how the episode goes, by name."""
        info = self.environment.info
        found = {
            'episode': str(self.episode), 'step': str(self.steps),
            'time': f'{self.environment.physics.data.time:.1f} s', 'return': f'{self.total:.2f}',
        }  # fmt: skip
        if 'distance' in info:
            found['distance'] = f'{info["distance"]:.2f} m'
        if self.time_step.last():
            cut = 'was cut' if self.time_step.discount else 'failed'
            found['end'] = next((end for end in _ENDS if info.get(end)), cut)
        return found

    def _rewards(self) -> np.ndarray:
        terms = self.environment.info.get('reward_terms', {})
        rewards = [float(self.environment.task.reward[0]), *terms.values()]
        return np.array(rewards[: len(self.reward_names)])


def _root_dofs(environment: Any) -> tuple[set[int], int]:
    """Returns the numbers of all velocities of the character's root, and the first of them."""
    model, figure = environment.physics.model, environment.task.figure
    joint = int(np.flatnonzero(model.jnt_qposadr == figure.pose_qpos[0])[0])
    first = int(model.jnt_dofadr[joint])
    free = model.jnt_type[joint] == int(mujoco.mjtJoint.mjJNT_FREE)
    return set(range(first, first + (6 if free else 3))), first


def _axis_name(model: Any, dof: int) -> str:
    """Returns the name of a joint, of a ball joint with the letter of an axis."""
    joint = int(model.dof_jntid[dof])
    name = (model.id2name(joint, 'joint') or f'joint {joint}').rpartition('/')[2]
    if model.jnt_type[joint] == int(mujoco.mjtJoint.mjJNT_BALL):
        name += f' {"xyz"[dof - int(model.jnt_dofadr[joint])]}'
    return name
