"""Maps from actions in [-1, 1] to controls in physical units, as arrays, and checks of actions."""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from trl_suite.util.compiled import compiled, compiled_inline

AXIS_OFFSET = 0.2  # component to the right of the original's axis at action 0
# The axis follows the angle, in the original's order: forward, up, right.
_FORWARD_LEFT_UP, _SIGNS = np.array([1, 3, 2]), np.array([1.0, -1.0, 1.0])
_TO_THE_RIGHT = np.array([0.0, -1.0, 0.0])


@dataclasses.dataclass(frozen=True)
class ActionMap:
    """The map from an action in [-1, 1] to control: action_offset + action_scale * action.

    Attributes:
      names: joint or muscle of each action, shape (k,).
      quantity: quantity of the controls, e.g. 'target angle'.
      unit: physical unit of the controls; exceptions by joint: 'rad (leg: m)'.
      action_offset: control at action 0, shape (k,).
      action_scale: change of control per unit action, shape (k,).
      actuators: names of the actuators that get the controls, in order; those of ball joints get
        three each. Empty if a controller converts the controls.
    """

    names: tuple[str, ...]
    quantity: str
    unit: str
    action_offset: np.ndarray
    action_scale: np.ndarray
    actuators: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.names)

    def control(self, action: np.ndarray) -> np.ndarray:
        """Maps actions (..., k), clipped to [-1, 1], to controls in physical units."""
        low, high, action_scale, action_offset = self._rows
        control = np.maximum(action, low)  # contiguous arrays: faster than scalars
        np.minimum(control, high, out=control)
        control *= action_scale
        control += action_offset
        return control if np.ndim(action) > 1 else control[0]

    def drive(self, first: int) -> Drive:
        """Returns the map for compiled functions; `first` is the address of the first control."""
        none = np.zeros((0, 3), int), np.zeros(0)
        return Drive(self.action_offset, self.action_scale, first, *none)

    @functools.cached_property
    def _rows(self) -> tuple[np.ndarray, ...]:
        ones = np.ones((1, len(self)))
        return -ones, ones, self.action_scale[None], self.action_offset[None]

    def action(self, control: np.ndarray) -> np.ndarray:
        """Maps controls (..., k) to the actions that yield them; not clipped."""
        return (control - self.action_offset) / self.action_scale

    def checked(self, action: npt.ArrayLike, *num_envs: int) -> np.ndarray:
        """Returns an action as floats, (k,), or the actions of some simulations, (simulations, k)."""
        shape = (*num_envs, len(self))
        are, have = ('actions are', 'actions have') if num_envs else ('action is', 'action has')
        try:
            action = np.asarray(action)
            if action.dtype.kind not in 'fiubO':  # NumPy would turn dates and strings into numbers
                raise ValueError(f'the type is {action.dtype}')
            action = action.astype(float, copy=False)
        except (TypeError, ValueError, OverflowError) as error:
            raise ValueError(f'{are} not an array of numbers: {error}') from None
        if action.shape != shape:
            raise ValueError(f'{have} shape {action.shape}; expected {shape}')
        # A fast test first; huge numbers fail it, but pass the second one.
        if not np.vdot(action, action) < np.inf and not np.isfinite(action).all():
            *env_id, i = np.argwhere(~np.isfinite(action))[0]
            place = f'action of simulation {env_id[0]}, number {i}' if env_id else f'action[{i}]'
            raise ValueError(
                f'{place} ({self.names[i]}) is {action[(*env_id, i)]}; expected finite numbers'
            )
        return action


class Drive(NamedTuple):
    """An action map for compiled functions; the addresses of its actuators are consecutive.

    Attributes:
      offset: control at action 0, (k,).
      scale: change per unit action, (k,).
      first: address of the first control.
      torque_balls: indices of the torques of each ball joint, (B, 3), if the map is a `TorqueMap`.
      torque_limits: largest norm of the torque of each ball joint, (B,), likewise.
      angles, angle_balls, hinges: fields of an `AngleAxisMap`, (B,), (B, 3) and (2, H); None for
        another type of map.
    """

    offset: np.ndarray
    scale: np.ndarray
    first: int
    torque_balls: np.ndarray
    torque_limits: np.ndarray
    angles: np.ndarray | None = None
    angle_balls: np.ndarray | None = None
    hinges: np.ndarray | None = None


@compiled_inline
def _meant(i: int, k: int, action: np.ndarray, by: Drive) -> float:
    """Control k of an action, in physical units, before norms are clamped."""
    return min(max(action[i, k], -1.0), 1.0) * by.scale[k] + by.offset[k]


@compiled
def drive(i: int, action: np.ndarray, by: Drive, ctrl: np.ndarray) -> None:
    """Writes the controls of simulation i for its action, `action[i]`, clipped to [-1, 1]."""
    if _drive_rotations(i, action, by, ctrl, by.angles, by.angle_balls, by.hinges):
        return
    for k in range(len(by.offset)):
        ctrl[i, by.first + k] = _meant(i, k, action, by)
    for ball in range(len(by.torque_limits)):
        square = 0.0
        for k in by.torque_balls[ball]:
            square += ctrl[i, by.first + k] * ctrl[i, by.first + k]
        limit = by.torque_limits[ball]
        share = limit / max(math.sqrt(square), limit)
        for k in by.torque_balls[ball]:
            ctrl[i, by.first + k] *= share


@compiled
def _drive_rotations(
    i: int,
    action: np.ndarray,
    by: Drive,
    ctrl: np.ndarray,
    angles: np.ndarray | None,
    balls: np.ndarray | None,
    hinges: np.ndarray | None,
) -> bool:
    """Writes the rotation vectors of ball joints from angles and axes; see `AngleAxisMap`.

    Returns:
      Whether the actions have these; otherwise, nothing is written, nor compiled.
    """
    if angles is None or balls is None or hinges is None:
        return False
    for k in range(hinges.shape[1]):
        ctrl[i, by.first + hinges[1, k]] = _meant(i, hinges[0, k], action, by)
    for ball in range(len(angles)):
        column = angles[ball]
        angle = _meant(i, column, action, by)
        x = _meant(i, column + 1, action, by)
        y = -_meant(i, column + 3, action, by)
        z = _meant(i, column + 2, action, by)
        length = math.sqrt(x * x + y * y + z * z)
        if length == 0.0:
            x, y, z, length = 0.0, -1.0, 0.0, 1.0
        share = angle / length
        ctrl[i, by.first + balls[ball, 0]] = x * share
        ctrl[i, by.first + balls[ball, 1]] = y * share
        ctrl[i, by.first + balls[ball, 2]] = z * share
    return True


@dataclasses.dataclass(frozen=True)
class TorqueMap(ActionMap):
    """Torques of joints, some of them spherical: the norm of these is clamped after the affine map.

    Attributes:
      balls: indices of the three torques of each ball joint, shape (B, 3).
      limits: the largest norm of each, N m, shape (B,).
    """

    balls: np.ndarray = dataclasses.field(kw_only=True)
    limits: np.ndarray = dataclasses.field(kw_only=True)

    def control(self, action: np.ndarray) -> np.ndarray:
        control = super().control(action)
        torque = control.take(self.balls, -1)
        torque *= (self.limits / np.maximum(_norm(torque), self.limits))[..., None]
        control[..., self.balls] = torque
        return control

    def drive(self, first: int) -> Drive:
        return super().drive(first)._replace(torque_balls=self.balls, torque_limits=self.limits)


@dataclasses.dataclass(frozen=True)
class AngleAxisMap(ActionMap):
    """The position actions of the original: angle and axis of a rotation for every ball joint.

    The affine map yields an angle, then an axis of any length, forward, up and right; an axis of
    length 0 is replaced by the one to the right. `control` converts these to rotation vectors, so
    it returns fewer numbers than it takes, and `action` returns one of many equivalent actions.

    Attributes:
      angles: index of the angle of each ball joint in an action, shape (B,); its axis follows.
      balls: indices of its rotation vector in the controls, shape (B, 3).
      hinges: indices of the other joints in an action and in the controls, shape (2, H).
    """

    angles: np.ndarray = dataclasses.field(kw_only=True)
    balls: np.ndarray = dataclasses.field(kw_only=True)
    hinges: np.ndarray = dataclasses.field(kw_only=True)

    def control(self, action: np.ndarray) -> np.ndarray:
        value = super().control(action)
        axis = value.take(self._axes, -1)
        axis *= _SIGNS
        length = _norm(axis)
        if not length.all():
            axis[length == 0] = _TO_THE_RIGHT
            length[length == 0] = 1
        axis *= (value.take(self.angles, -1) / length)[..., None]
        control = np.empty((*value.shape[:-1], self.balls.size + len(self.hinges[1])))
        control[..., self.hinges[1]] = value.take(self.hinges[0], -1)
        control[..., self.balls] = axis
        return control

    def drive(self, first: int) -> Drive:
        return (
            super()
            .drive(first)
            ._replace(angles=self.angles, angle_balls=self.balls, hinges=np.asarray(self.hinges))
        )

    @functools.cached_property
    def _axes(self) -> np.ndarray:
        """Indices of forward, left and up in an action, shape (B, 3)."""
        return self.angles[:, None] + _FORWARD_LEFT_UP

    def action(self, control: np.ndarray) -> np.ndarray:
        vector = control[..., self.balls]
        angle = _norm(vector)
        turned = angle[..., None] > 0
        axis = np.where(turned, vector / np.where(turned, angle[..., None], 1), _TO_THE_RIGHT)
        value = np.empty((*control.shape[:-1], len(self)))
        value[..., self.hinges[0]] = control[..., self.hinges[1]]
        value[..., self.angles] = angle
        # Scaled so that every axis has an action in [-1, 1].
        value[..., self._axes] = axis * _SIGNS * (1 - AXIS_OFFSET)
        return super().action(value)


def _norm(vectors: np.ndarray) -> np.ndarray:
    """Lengths of vectors (..., 3); bitwise independent of the number of simulations."""
    square = vectors * vectors
    return np.sqrt(square[..., 0] + square[..., 1] + square[..., 2])
