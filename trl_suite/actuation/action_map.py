"""Maps from actions in [-1, 1] to controls in physical units, as arrays, and checks of actions."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, NamedTuple

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

    Of ball joints, the norm of three torques is then clamped to the torque limit. In position
    actions of the original, a ball joint has an angle, then an axis of any length, forward, up and
    right, in place of which the controls have a rotation vector; an axis of length 0 is replaced by
    the one to the right.

    Attributes:
      names: joint or muscle of each action, shape (k,).
      quantity: quantity of the controls, e.g. 'target angle'.
      unit: physical unit of the controls; exceptions by joint: 'rad (leg: m)'.
      action_offset: control at action 0, shape (k,).
      action_scale: change of control per unit action, shape (k,).
      actuators: names of the actuators that get the controls, in order; those of ball joints get
        three each. Empty if a controller converts the controls.
      balls: the fields of `Drive` for ball joints: for torques that are clamped, or for angles and
        axes.
    """

    names: tuple[str, ...]
    quantity: str
    unit: str
    action_offset: np.ndarray
    action_scale: np.ndarray
    actuators: tuple[str, ...] = ()
    balls: Mapping[str, np.ndarray] = dataclasses.field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.names)

    @property
    def has_axes(self) -> bool:
        """Whether actions describe rotations of ball joints by angles and axes."""
        return 'angles' in self.balls

    def control(self, action: np.ndarray) -> np.ndarray:
        """Maps actions (..., k), clipped to [-1, 1], to controls in physical units."""
        by, rows = self.drive(0), np.reshape(action, (-1, len(self))).astype(float)
        found = np.empty((len(rows), len(self) - len(self.balls.get('angles', ()))))
        for i in range(len(rows)):
            drive(i, rows, by, found)
        return found.reshape(*np.shape(action)[:-1], -1)

    def drive(self, first: int) -> Drive:
        """Returns the map for compiled functions; `first` is the address of the first control."""
        none = np.zeros((0, 3), int), np.zeros(0)
        balls: Any = self.balls
        return Drive(self.action_offset, self.action_scale, first, *none)._replace(**balls)

    def action(self, control: np.ndarray) -> np.ndarray:
        """Maps controls (..., k) to actions that yield them; not clipped.

        Of the many equivalent angles and axes, it returns those with an axis in [-1, 1].
        """
        if self.has_axes:
            control = self._with_axes(control)
        return (control - self.action_offset) / self.action_scale

    def _with_axes(self, control: np.ndarray) -> np.ndarray:
        """Returns angles and axes in place of rotation vectors."""
        angles, (own, others) = self.balls['angles'], self.balls['hinges']
        vector = control[..., self.balls['angle_balls']]
        angle = np.linalg.norm(vector, axis=-1)
        turned = angle[..., None] > 0
        axis = np.where(turned, vector / np.where(turned, angle[..., None], 1), _TO_THE_RIGHT)
        value = np.empty((*control.shape[:-1], len(self)))
        value[..., own], value[..., angles] = control[..., others], angle
        value[..., angles[:, None] + _FORWARD_LEFT_UP] = axis * _SIGNS * (1 - AXIS_OFFSET)
        return value

    def checked(self, action: npt.ArrayLike, *num_envs: int) -> np.ndarray:
        """Returns an action as floats, (k,), or the actions of some simulations, (simulations, k)."""
        action = self.numbers(action, *num_envs)
        self.check_finite(action)
        return action

    def numbers(self, action: npt.ArrayLike, *num_envs: int) -> np.ndarray:
        """Returns what `checked` does, without the check for NaN and infinity."""
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
        return action

    def check_finite(self, action: np.ndarray) -> None:
        """Raises a ValueError if a number of `numbers` is NaN or infinite."""
        # A fast test first; huge numbers fail it, but pass the second one.
        if not np.vdot(action, action) < np.inf and not np.isfinite(action).all():
            *env_id, i = np.argwhere(~np.isfinite(action))[0]
            place = f'action of simulation {env_id[0]}, number {i}' if env_id else f'action[{i}]'
            raise ValueError(
                f'{place} ({self.names[i]}) is {action[(*env_id, i)]}; expected finite numbers'
            )


class Drive(NamedTuple):
    """An action map for compiled functions; the addresses of its actuators are consecutive."""

    offset: np.ndarray  # (k,); control at action 0
    scale: np.ndarray  # (k,); change per unit action
    first: int  # address of the first control
    # Ball joints whose torques are clamped: indices of these, and their largest norm, N m.
    torque_balls: np.ndarray  # (B, 3)
    torque_limits: np.ndarray  # (B,)
    # Ball joints with an angle and an axis, which follows it: index of the angle in an action, and
    # indices of the rotation vector in the controls; None if actions have no axes.
    angles: np.ndarray | None = None  # (B,)
    angle_balls: np.ndarray | None = None  # (B, 3)
    # Other joints beside these: indices in an action and in the controls.
    hinges: np.ndarray | None = None  # (2, H)


@compiled_inline
def in_units(i: int, k: int, action: np.ndarray, by: Drive) -> float:
    """Returns number k of an action, clipped, in physical units; norms are clamped afterwards."""
    return min(max(action[i, k], -1.0), 1.0) * by.scale[k] + by.offset[k]


@compiled
def drive(i: int, action: np.ndarray, by: Drive, ctrl: np.ndarray) -> None:
    """Writes the controls of simulation i for its action, `action[i]`, clipped to [-1, 1]."""
    if _drive_rotations(i, action, by, ctrl, by.angles, by.angle_balls, by.hinges):
        return
    for k in range(len(by.offset)):
        ctrl[i, by.first + k] = in_units(i, k, action, by)
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
    """Writes the rotation vectors of ball joints from angles and axes; see `ActionMap`.

    The last arguments are fields of `by`: what follows a return for an argument that is None is not
    compiled.

    Returns:
      Whether the actions have these; otherwise, nothing is written.
    """
    if angles is None or balls is None or hinges is None:
        return False
    for k in range(hinges.shape[1]):
        ctrl[i, by.first + hinges[1, k]] = in_units(i, hinges[0, k], action, by)
    for ball in range(len(angles)):
        column = angles[ball]
        angle = in_units(i, column, action, by)
        x = in_units(i, column + 1, action, by)
        y = -in_units(i, column + 3, action, by)
        z = in_units(i, column + 2, action, by)
        length = math.sqrt(x * x + y * y + z * z)
        if length == 0.0:
            x, y, z, length = 0.0, -1.0, 0.0, 1.0
        share = angle / length
        ctrl[i, by.first + balls[ball, 0]] = x * share
        ctrl[i, by.first + balls[ball, 1]] = y * share
        ctrl[i, by.first + balls[ball, 2]] = z * share
    return True
