"""Extracts a character from an MJCF or URDF file: names, links, joints and their parameters.

`from_file.py` lists the assumptions about missing values, and makes a CharacterSpec of the results.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np

from trl_suite.characters.character import Joint
from trl_suite.engine import GRAVITY
from trl_suite.util import errors

SLIDE_WEIGHTS = 2.0  # force limit of a slide, in weights of the character
KD_SHARE = 0.1  # s; kd per kp
ARMATURE_SHARE = 0.01 / 300  # s^2; armature per kp
# Values outside these bounds are probably in another unit.
LEAST_SWING = 0.05  # rad, from limit to limit of a hinge
MOST_SWING = 2 * np.pi  # rad, from 0 to a limit of a hinge
SIZES = (0.05, 10.0)  # m, from the root to the farthest end
MASSES = (0.1, 2000.0)  # kg
# Smallest downward component of the direction to the end effectors; below it, a character may lie.
LYING = 0.2
FACING = 0.7  # cosine of the largest angle between +x and the facing direction without a note
LATERAL = 1e-3  # rad; largest deviation of a planar character's joint axis from plane or normal

_FREE, _BALL, _SLIDE, _HINGE = (
    int(getattr(mujoco.mjtJoint, f'mjJNT_{kind}')) for kind in ('FREE', 'BALL', 'SLIDE', 'HINGE')
)
_OF_JOINTS = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
_SIDES = (  # patterns of left names, and the right ones
    *(('left', 'right'), ('Left', 'Right')),
    *(('(^|_)l', r'\1r'), ('(^|_)L', r'\1R')),
    *(('l$', 'r'), ('L$', 'R')),
    # Front, rear, hind, back and middle legs, such as FL_hip and RL_hip.
    ('(^|[^A-Za-z])([frhbm])l(?![a-z])', r'\1\2r'),
    ('(^|[^A-Za-z])([FRHBM])L(?![a-z])', r'\1\2R'),
)
KINDS = {_FREE: 'free', _BALL: 'ball', _SLIDE: 'slide', _HINGE: 'hinge'}


def facing(places: Mapping[str, np.ndarray]) -> np.ndarray | None:
    """Returns the facing direction (2,) of a character, or None if names do not determine it.

    Args:
      places: positions of the bodies by name, (3,) m. The direction follows from pairs of bodies
        that are named left and right.
    """
    aside = np.zeros(3)
    for left, place in places.items():
        right = next((name for name in _right(left) if name in places), None)
        if right is not None:
            aside += place - places[right]
    length = np.linalg.norm(aside[:2])
    # The direction is mostly vertical if the character lies on its side.
    if length < FACING * np.linalg.norm(aside) or not length:
        return None
    return np.array([aside[1], -aside[0]]) / length


def _right(left: str) -> list[str]:
    """Returns possible names of the right counterpart of a left body."""
    return [name for a, b in _SIDES if (name := re.sub(a, b, left, count=1)) != left]


class ModelInspector:
    """The properties of a character in a compiled file."""

    def __init__(self, model: mujoco.MjModel, root: int, spatial: bool | None) -> None:
        self.model, self.notes = model, list[str]()
        self.data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, self.data)
        self.root = root
        self.ids = np.flatnonzero(model.body_rootid == self.root)
        self.bodies = [model.body(i).name for i in self.ids]
        own = np.isin(model.jnt_bodyid, self.ids)
        self.spatial = self._dimensions(np.flatnonzero(model.jnt_bodyid == self.root), spatial)
        self.joints = np.flatnonzero(own & (model.jnt_bodyid != self.root))
        self._check_joints()
        touching = (model.geom_contype | model.geom_conaffinity) != 0
        self.geoms = np.flatnonzero(np.isin(model.geom_bodyid, self.ids) & touching)
        if not len(self.geoms):
            raise ValueError(
                'no geom of the character can touch the ground: expected some whose contype '
                'and conaffinity are not both 0 (in URDF, <collision> elements)'
            )
        for i in self.geoms:
            masks = int(model.geom_contype[i]), int(model.geom_conaffinity[i])
            if not all(-(2**30) <= mask < 2**30 for mask in masks):
                raise ValueError(
                    f'geom {model.geom(i).name!r} has contype {masks[0]} and conaffinity '
                    f'{masks[1]}; expected masks below 2^30, as one bit is for the ground'
                )
        self.collision_geoms = tuple(model.geom(i).name for i in self.geoms)
        heavy = model.body_mass[self.ids] > 0
        heavy[0] = True
        self.links = tuple(np.array(self.bodies)[heavy].tolist())
        self.weight = float(model.body_mass[self.ids].sum()) * GRAVITY
        if not self.weight > 0:
            raise ValueError(f'the mass of {self.bodies[0]!r} and its descendants is 0')
        self._doubt()

    def _dimensions(self, root_joints: np.ndarray, spatial: bool | None) -> bool:
        kinds = sorted(KINDS[int(kind)] for kind in self.model.jnt_type[root_joints])
        says = {('free',): True, ('hinge', 'slide', 'slide'): False}.get(tuple(kinds))
        if spatial is not None:
            if says is not None and says is not spatial:
                self.notes.append(
                    f'spatial={spatial} was given and is used, although the root of the file '
                    f'{"has a free joint" if says else "moves in a plane, by two slides and a hinge"}'
                )
            return spatial
        if says is not None:
            return says
        raise ValueError(
            f'the root {self.bodies[0]!r} has {", ".join(kinds) or "no joints"}; expected '
            'a free joint, or two slides and a hinge; or pass spatial=True or spatial=False'
        )

    def _check_joints(self) -> None:
        model = self.model
        if not len(self.joints):
            raise ValueError(f'no joint attaches a body to the root {self.bodies[0]!r}')
        for i in self.joints:
            name, kind, axis = model.joint(i).name, int(model.jnt_type[i]), self.data.xaxis[i]
            aside, (low, high) = abs(axis[1]), model.jnt_range[i].tolist()
            if not model.jnt_limited[i] and low > high:  # read without limits
                raise ValueError(
                    f'{KINDS[kind]} {name!r} has limits {low:g} to {high:g}; expected the lower first'
                )
            if kind == _SLIDE and not model.jnt_limited[i]:
                raise ValueError(f'slide {name!r} has no limits; expected a range, in m')
            if not self.spatial and (
                kind == _BALL
                or (kind == _HINGE and aside < 1 - LATERAL)
                or (kind == _SLIDE and aside > LATERAL)
            ):
                raise ValueError(
                    f'{KINDS[kind]} {name!r} (axis {axis.round(3).tolist()}) leaves the '
                    'x-z plane; expected hinges about y and slides in the plane, or spatial=True'
                )

    def _doubt(self) -> None:
        """Adds notes on values that are probably in another unit."""
        model = self.model
        hinges = [i for i in self.joints if model.jnt_type[i] == _HINGE and model.jnt_limited[i]]
        found = {model.joint(i).name: model.jnt_range[i] for i in hinges}
        for what, names in (
            ('hardly move', [name for name, r in found.items() if np.ptp(r) < LEAST_SWING]),
            ('turn full circle', [n for n, r in found.items() if np.abs(r).max() > MOST_SWING]),
        ):
            if names:
                each = ', '.join(f'{name} {found[name].round(3).tolist()}' for name in names)
                self.notes.append(f'joints that {what}, rad: {each}; is the unit of angles right?')
        reach = self.reach(self.data.xpos[self.root], self.root)
        if not SIZES[0] <= reach <= SIZES[1]:
            self.notes.append(f'it reaches {reach:.3g} m from its root; are lengths in m?')
        if not MASSES[0] <= self.weight / GRAVITY <= MASSES[1]:
            self.notes.append(f'it weighs {self.weight / GRAVITY:.4g} kg; are masses in kg?')

    def check_posture(self, end_effectors: Sequence[str]) -> None:
        """Adds a note if a character seems to lie, or not to face +x, in its working posture."""
        model, data = self.model, mujoco.MjData(self.model)
        for i in self.joints.tolist():
            if model.jnt_type[i] in (_HINGE, _SLIDE):
                data.qpos[model.jnt_qposadr[i]] = self._posture(i, [])
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        ends = np.mean([data.xipos[model.body(name).id] for name in end_effectors], axis=0)
        away = ends - data.subtree_com[self.root]
        distance = np.linalg.norm(away)
        if distance > 0 and -away[2] < LYING * distance:
            self.notes.append(
                f'it may lie: the end effectors are at {away.round(3).tolist()} m from the centre of mass; '
                'expected below it, with z up; pass turn= to rotate the character'
            )
            return
        forward = facing(
            {name: data.xipos[i] for name, i in zip(self.bodies, self.ids, strict=True)}
        )
        if forward is not None and forward[0] < FACING:
            self.notes.append(
                f'it may face {forward.round(2).tolist()}, according to its left and right bodies; expected '
                '+x, [1, 0]; pass turn= to rotate the character'
            )

    def left_out(self) -> list[str]:
        """Returns names of actuators that do not act on a joint, and in brackets what they act on."""
        model, names = self.model, []
        for a in range(model.nu):
            kind = mujoco.mjtTrn(model.actuator_trntype[a])
            if kind in _OF_JOINTS and model.actuator_trnid[a, 0] in self.joints:
                continue
            on = kind.name.removeprefix('mjTRN_').lower()
            names.append(f'{model.actuator(a).name or a} ({on})')
        return names

    def limbs(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Returns the last bodies of limbs that reach below the centre of mass, and the first inner one.

        Only bodies that can touch the ground count. If no limb reaches down, all do. If no body is an
        inner one, e.g. because only feet can touch the ground, the second tuple is empty.
        """
        model, data = self.model, self.data
        mujoco.mj_comPos(model, data)
        solid = [i for i in self.ids.tolist() if i in model.geom_bodyid[self.geoms]]
        inner = set[int]()
        for body in solid:
            while (body := int(model.body_parentid[body])) and body not in inner:
                inner.add(body)
        last = [i for i in solid if i not in inner]
        low = [i for i in last if data.xipos[i, 2] < data.subtree_com[self.root, 2]] or last
        falls = [i for i in solid if i in inner][:1]
        low_names, fall_names = (tuple(model.body(i).name for i in each) for each in (low, falls))
        return low_names, fall_names

    def check_names(self, what: str, names: Sequence[str], solid: bool = False) -> None:
        model = self.model
        touching = {model.body(i).name for i in model.geom_bodyid[self.geoms]}
        for name in names:
            if name not in self.bodies:
                by_joint = {model.joint(i).name: model.jnt_bodyid[i] for i in self.joints}
                if name in by_joint:
                    link = model.body(by_joint[name]).name
                    raise ValueError(f'{what} {name!r} is a joint; did you mean its body {link!r}?')
                raise ValueError(errors.unknown(what, name, self.bodies))
            if solid and name not in touching:
                raise ValueError(
                    f'{what} {name!r} has no geom that can touch the ground; bodies '
                    f'with such geoms: {", ".join(sorted(touching))}'
                )

    def figures(self) -> dict[str, Joint]:
        """The parameters of all joints; sets `limits`, their largest torques or forces."""
        model, figures = self.model, {}
        self.limits: dict[str, float] = {}
        kinds = 'limit', 'gains', 'damping', 'posture', 'free'
        assumed: dict[str, list[str]] = {kind: [] for kind in kinds}
        for i in self.joints.tolist():
            name, kind = model.joint(i).name, int(model.jnt_type[i])
            kp, kv, limit = self._actuators(i)
            if limit is None:
                limit = self._default_limit(i)
                assumed['limit'].append(f'{name} {limit:.3g}')
            dof = model.jnt_dofadr[i]
            kd = kv + model.dof_damping[dof]
            if kp is None:
                span = 0.1 * np.ptp(model.jnt_range[i]) if kind == _SLIDE else 1.0
                kp = limit / span
                kd += KD_SHARE * kp
                assumed['gains'].append(f'{name} {kp:.3g}')
            elif not kd:
                kd = KD_SHARE * kp
                assumed['damping'].append(f'{name} {kd:.3g}')
            target = self._posture(i, assumed['posture'])
            if kind == _HINGE and not model.jnt_limited[i]:
                assumed['free'].append(name)
            armature = model.dof_armature[dof] or ARMATURE_SHARE * kp
            self.limits[name] = limit
            figures[name] = Joint(
                float(kp), float(kd), 1.0, target=target, armature=float(armature)
            )
        self.notes += [
            f'{text}: {", ".join(assumed[key])}'
            for key, text in (
                ('limit', 'no torque limits in the file; N m (slides: N)'),
                ('gains', 'no servos in the file; kp, N m/rad (slides: N/m)'),
                ('damping', 'servos without damping; kd, N m s/rad (slides: N s/m)'),
                ('posture', 'zero is beyond the limits; working posture'),
                ('free', 'no joint limits in the file'),
            )
            if assumed[key]
        ]
        return figures

    def _actuators(self, joint: int) -> tuple[float | None, float, float | None]:
        """Returns kp, kv and torque limit of a joint from the file's actuators."""
        model = self.model
        kp, kv, limits = 0.0, 0.0, []
        at = np.isin(model.actuator_trntype, [*map(int, _OF_JOINTS)]) & (
            model.actuator_trnid[:, 0] == joint
        )
        for a in np.flatnonzero(at):
            gear, bias = abs(model.actuator_gear[a, 0]), model.actuator_biasprm[a]
            if model.actuator_forcelimited[a]:  # before the gear
                limits.append(gear * np.abs(model.actuator_forcerange[a]).max())
            if model.actuator_biastype[a] == mujoco.mjtBias.mjBIAS_NONE:
                if model.actuator_ctrllimited[a]:
                    full = np.abs(model.actuator_ctrlrange[a]).max()
                    limits.append(gear * full * abs(model.actuator_gainprm[a, 0]))
                continue
            kp, kv = kp - bias[1] * gear**2, kv - bias[2] * gear**2
        if model.jnt_actfrclimited[joint]:
            limits.append(np.abs(model.jnt_actfrcrange[joint]).max())
        return kp if kp > 0 else None, max(kv, 0.0), float(min(limits)) if limits else None

    def _default_limit(self, joint: int) -> float:
        model, body = self.model, self.model.jnt_bodyid[joint]
        if model.jnt_type[joint] == _SLIDE:
            return SLIDE_WEIGHTS * self.weight
        return self.weight * self.reach(self.data.xanchor[joint], body)

    def reach(self, point: np.ndarray, body: int) -> float:
        """Distance from a point to the farthest end of a body and its descendants, m."""
        below = {body}
        for i in range(body + 1, self.model.nbody):  # parents precede their children
            if self.model.body_parentid[i] in below:
                below.add(i)
        geoms = [g for g in self.geoms if self.model.geom_bodyid[g] in below]
        away = np.linalg.norm(self.data.geom_xpos[geoms] - point, axis=1)
        ends = [*(away + self.model.geom_rbound[geoms])]
        ends += [np.linalg.norm(self.data.xipos[i] - point) for i in below]
        return float(max(ends))

    def _posture(self, i: int, moved: list[str]) -> Any:
        model = self.model
        address, kind = model.jnt_qposadr[i], int(model.jnt_type[i])
        pose = model.key_qpos[0] if model.nkey else model.qpos0
        if kind == _BALL:
            vector = np.zeros(3)
            mujoco.mju_quat2Vel(vector, pose[address : address + 4], 1.0)
            angle, most = np.linalg.norm(vector), model.jnt_range[i, 1]
            if model.jnt_limited[i] and angle > most:
                vector *= most / angle
                moved.append(f'{model.joint(i).name} {most:.3g}')
            return tuple(vector.tolist()) if vector.any() else 0.0
        target = float(pose[address])
        if model.jnt_limited[i]:
            inside = float(np.clip(target, *model.jnt_range[i]))
            if inside != target:
                moved.append(f'{model.joint(i).name} {inside:.3g}')
            target = inside
        return target
