"""What an MJCF or URDF file holds of a character: names, links, joints and their figures.

`own.py` says what is assumed where a file is silent, and makes a character of what is found here.
"""

from __future__ import annotations

import pathlib
import re
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
from lxml import etree

from trl_suite.characters.character import Joint
from trl_suite.util import errors

GRAVITY = 9.8  # m/s^2, of the arenas
SLIDE_WEIGHTS = 2.0  # force limit of a slide, in weights of the character
KD_SHARE = 0.1  # s; kd per kp
ARMATURE_SHARE = 0.01 / 300  # s^2; armature per kp
# What a figure in the wrong unit goes beyond.
LEAST_SWING = 0.05  # rad, from limit to limit of a hinge
MOST_SWING = 2 * np.pi  # rad, from 0 to a limit of a hinge
SIZES = (0.05, 10.0)  # m, from the root to the farthest end
MASSES = (0.1, 2000.0)  # kg
LATERAL = 1e-3  # how far an axis of a planar character may be from its plane or normal, rad

_FREE, _BALL, _SLIDE, _HINGE = (
    int(kind)
    for kind in (
        mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL, mujoco.mjtJoint.mjJNT_SLIDE,
        mujoco.mjtJoint.mjJNT_HINGE,
    )
)  # fmt: skip
KINDS = {_FREE: 'free', _BALL: 'ball', _SLIDE: 'slide', _HINGE: 'hinge'}
# Of a file, besides bodies: what must have a name to be found again.
_NAMED = ('joints', 'geoms', 'sites', 'cameras', 'lights', 'equalities', 'excludes', 'tendons')


def problem(file: pathlib.Path, what: str) -> ValueError:
    """Returns what to raise about a file."""
    return ValueError(f'{file}: {what}')


def named(file: pathlib.Path) -> mujoco.MjSpec:
    """Reads a file; what has no name in it gets one."""
    try:
        spec = mujoco.MjSpec.from_file(str(file))
    except ValueError as error:
        raise problem(file, f'not a model: {" ".join(str(error).split())}') from None
    spec.compiler.fusestatic = False  # bodies without joints may be end effectors
    for mesh in spec.meshes:
        mesh.file = _in_package(file, mesh.file)
    for body in spec.bodies[1:]:
        if not body.name:
            body.name = body.joints[0].name if body.joints else ''
        body.name = body.name or f'{body.parent.name}_{body.id}'
        for kind, items in (('', body.joints), ('_geom', body.geoms)):
            for i, item in enumerate(items):
                if not item.name:
                    item.name = f'{body.name}{kind}{i if kind or len(items) > 1 else ""}'
    for kind in _NAMED:
        for i, item in enumerate(getattr(spec, kind)):
            item.name = item.name or f'unnamed_{kind}_{i}'
    for item in (*spec.bodies[1:], *(item for kind in _NAMED for item in getattr(spec, kind))):
        if '/' in item.name:
            raise problem(file, f'the name {item.name!r} has a slash; expected none in names')
    return spec


def check_numbers(file: pathlib.Path, seen: frozenset[pathlib.Path] = frozenset()) -> None:
    """Refuses NaN, which MuJoCo takes for something that is not said, and infinity."""
    try:
        elements = [*etree.parse(file).getroot().iter(etree.Element)]
    except etree.XMLSyntaxError as error:
        raise problem(file, f'not a model: {error}') from None
    names = {element.get(key) for element in elements for key in ('name', 'class')}
    for element in elements:
        for key, text in element.items():
            if text not in names and key not in ('name', 'class') and not _finite(text):
                of = f' of {element.get("name")!r}' if element.get('name') else ''
                raise problem(
                    file, f'line {element.sourceline}: {key}="{text}"{of} (<{element.tag}>); expected '
                    'finite numbers',
                )  # fmt: skip
    seen |= {file.resolve()}
    for element in elements:
        if element.tag == 'include':
            included = file.parent / element.get('file', '')
            if included.is_file() and included.resolve() not in seen:  # else MuJoCo complains
                check_numbers(included, seen)


def _finite(text: str) -> bool:
    """Whether a text is no list of numbers, or one of finite ones."""
    try:
        return bool(np.isfinite([float(number) for number in text.split()]).all())
    except ValueError:
        return True


def _in_package(file: pathlib.Path, name: str) -> str:
    """Returns where a mesh of a ROS package lies, given a file somewhere in that package."""
    address = re.fullmatch(r'package:/+([^/]+)/(.+)', name)
    if address is None:
        return name
    package, inside = address.groups()
    places = [
        parent / part
        for parent in file.resolve().parents
        for part in (inside, f'{package}/{inside}')
    ]
    return str(next((place for place in places if place.is_file()), name))


class ModelInspector:
    """What a compiled file holds of a character."""

    def __init__(
        self, file: pathlib.Path, model: mujoco.MjModel, root: str | None, spatial: bool | None
    ) -> None:
        self.file, self.model, self.notes = file, model, list[str]()
        self.data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, self.data)
        self.root = self._root(root)
        self.ids = np.flatnonzero(model.body_rootid == self.root)
        self.bodies = [model.body(i).name for i in self.ids]
        own = np.isin(model.jnt_bodyid, self.ids)
        self.spatial = self._dimensions(np.flatnonzero(model.jnt_bodyid == self.root), spatial)
        self.joints = np.flatnonzero(own & (model.jnt_bodyid != self.root))
        self._check_joints()
        touching = (model.geom_contype | model.geom_conaffinity) != 0
        self.geoms = np.flatnonzero(np.isin(model.geom_bodyid, self.ids) & touching)
        if not len(self.geoms):
            raise problem(
                file, 'no geom of the character can touch the ground: expected some whose contype '
                'and conaffinity are not both 0 (in URDF, <collision> elements)',
            )  # fmt: skip
        self.collision_geoms = tuple(model.geom(i).name for i in self.geoms)
        heavy = model.body_mass[self.ids] > 0
        heavy[0] = True
        self.links = tuple(np.array(self.bodies)[heavy].tolist())
        self.weight = float(model.body_mass[self.ids].sum()) * GRAVITY
        if not self.weight > 0:
            raise problem(file, f'the mass of {self.bodies[0]!r} and all that hangs on it is 0')
        self._doubt()

    def _root(self, root: str | None) -> int:
        model = self.model
        top = {model.body(i).name: i for i in range(1, model.nbody) if not model.body_parentid[i]}
        if root is None and len(top) == 1:
            (root,) = top
        if root in top:
            number = top[root]
            if abs(model.body_quat[number, 0]) < 1 - 1e-6:
                raise problem(
                    self.file, f'the root {root!r} is turned against the world; expected none, x '
                    'ahead and z up: turn what it holds instead',
                )  # fmt: skip
            return number
        if not top:
            raise problem(self.file, 'there is no body; expected one that carries all others')
        if root is None:
            raise problem(self.file, f'several bodies may be the root; give root=, one of {[*top]}')
        names = [model.body(i).name for i in range(1, model.nbody)]
        if root in names:
            above = model.body(model.body_rootid[model.body(root).id]).name
            raise problem(
                self.file, f'root {root!r} hangs on another body; did you mean {above!r}?'
            )
        raise problem(self.file, errors.unknown('root', root, names))

    def _dimensions(self, root_joints: np.ndarray, spatial: bool | None) -> bool:
        kinds = sorted(KINDS[int(kind)] for kind in self.model.jnt_type[root_joints])
        says = {('free',): True, ('hinge', 'slide', 'slide'): False}.get(tuple(kinds))
        if spatial is not None:
            if says is not None and says is not spatial:
                self.notes.append(
                    f'spatial={spatial} was given, and counts: the root of the file '
                    f'{"has a free joint" if says else "moves in a plane, by two slides and a hinge"}'
                )
            return spatial
        if says is not None:
            return says
        raise problem(
            self.file, f'the root {self.bodies[0]!r} has {", ".join(kinds) or "no joints"}; expected '
            'a free joint, or two slides and a hinge, or that you say spatial=True or spatial=False',
        )  # fmt: skip

    def _check_joints(self) -> None:
        model = self.model
        if not len(self.joints):
            raise problem(self.file, f'nothing hangs on the root {self.bodies[0]!r} by a joint')
        for i in self.joints:
            name, kind, axis = model.joint(i).name, int(model.jnt_type[i]), self.data.xaxis[i]
            aside = abs(axis[1])
            if kind == _SLIDE and not model.jnt_limited[i]:
                raise problem(self.file, f'slide {name!r} has no limits; expected a range, in m')
            if not self.spatial and (
                kind == _BALL
                or (kind == _HINGE and aside < 1 - LATERAL)
                or (kind == _SLIDE and aside > LATERAL)
            ):
                raise problem(
                    self.file, f'{KINDS[kind]} {name!r} (axis {axis.round(3).tolist()}) leaves the '
                    'x-z plane; expected hinges about y and slides in the plane, or spatial=True',
                )  # fmt: skip

    def _doubt(self) -> None:
        """Notes what looks as if it were in another unit."""
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

    def check_names(self, what: str, names: Sequence[str], solid: bool = False) -> None:
        if isinstance(names, str) or not names:
            raise ValueError(f'{what}s are {names!r}; expected a sequence of one name or more')
        model = self.model
        touching = {model.body(i).name for i in model.geom_bodyid[self.geoms]}
        for name in names:
            if name not in self.bodies:
                by_joint = {model.joint(i).name: model.jnt_bodyid[i] for i in self.joints}
                if name in by_joint:
                    link = model.body(by_joint[name]).name
                    raise problem(
                        self.file, f'{what} {name!r} is a joint; did you mean its body {link!r}?'
                    )
                raise problem(self.file, errors.unknown(what, name, self.bodies))
            if solid and name not in touching:
                raise problem(
                    self.file, f'{what} {name!r} has no geom that can touch the ground; those that '
                    f'have: {", ".join(sorted(touching))}',
                )  # fmt: skip

    def figures(self) -> dict[str, Joint]:
        """The figures of all joints; sets `limits`, their largest torques or forces."""
        model, figures = self.model, {}
        self.limits: dict[str, float] = {}
        assumed: dict[str, list[str]] = {
            'limit': [], 'gains': [], 'damping': [], 'posture': [], 'free': [],
        }  # fmt: skip
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
                ('posture', 'zero is beyond the limits; working about'),
                ('free', 'no limits of the angle'),
            )
            if assumed[key]
        ]
        return figures

    def _actuators(self, joint: int) -> tuple[float | None, float, float | None]:
        """Returns kp, kv and torque limit of a joint as the file's actuators have them."""
        model = self.model
        kp, kv, limits = 0.0, 0.0, []
        at = (model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT) & (
            model.actuator_trnid[:, 0] == joint
        )
        for a in np.flatnonzero(at):
            gear, bias = abs(model.actuator_gear[a, 0]), model.actuator_biasprm[a]
            if model.actuator_forcelimited[a]:
                limits.append(gear * np.abs(model.actuator_forcerange[a]).max())
            elif model.actuator_biastype[a] == mujoco.mjtBias.mjBIAS_NONE:
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
        """Distance from a point to the farthest end of what a body and all on it can touch, m."""
        below = {body}
        for i in range(body + 1, self.model.nbody):  # parents come before their children
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
            return tuple(vector.tolist()) if vector.any() else 0.0
        target = float(pose[address])
        if model.jnt_limited[i]:
            inside = float(np.clip(target, *model.jnt_range[i]))
            if inside != target:
                moved.append(f'{model.joint(i).name} {inside:.3g}')
            target = inside
        return target
