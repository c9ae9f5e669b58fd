"""Checks of a clip on a character, frame by frame: joint limits, ground, sliding feet.

from trl_suite import motion
from trl_suite.retargeting import clip_check

report = clip_check.check(motion.load('biped2d_walk'), 'biped2d')
print(report)
for fault in report.faults:
    print(fault.frame, fault.kind, fault.name, fault.amount, fault.unit)
"""

from __future__ import annotations

import dataclasses
import functools

import numpy as np

from trl_suite import characters
from trl_suite.motion import Clip, quaternion
from trl_suite.rendering.kinematic_viewer import KinematicViewer
from trl_suite.util import tables
from trl_suite.util.options import checked

# Thresholds of faults. Shipped clips have no faults, see mocap/README.md.
EXCESS = 1e-3  # rad beyond a joint's limits (m for a slide)
DEPTH = 0.01  # m below the ground
SLIDE = 0.02  # m that a corner of a foot travels in one contact
NEAR = 0.005  # m; a corner of a foot lower than this is in contact
KINDS = ('joint limit', 'penetration', 'foot slide')


@dataclasses.dataclass(frozen=True)
class Fault:
    """One fault in one frame."""

    frame: int  # from 0
    time: float  # of the frame, s
    kind: str  # one of `KINDS`
    name: str  # of the joint or link
    amount: float  # excess over a limit, depth below the ground, or sliding distance
    unit: str


@dataclasses.dataclass(frozen=True, eq=False)
class Report:
    """Measurements in n frames; arrays are (n,), and 0 where there is no fault."""

    name: str  # of the clip
    times: np.ndarray  # of the frames, s
    excess: dict[str, np.ndarray]  # by joint, rad beyond the limits (m for a slide)
    units: dict[str, str]  # of every joint's excess, 'rad' or 'm'
    depth: dict[str, np.ndarray]  # by link, m of its lowest corner below the ground
    slide: dict[str, np.ndarray]  # by foot, m of a corner since its contact began, the largest

    @functools.cached_property
    def faults(self) -> tuple[Fault, ...]:
        """All faults, frame by frame."""
        parts: tuple[tuple[dict[str, np.ndarray], float, dict[str, str]], ...] = (
            (self.excess, EXCESS, self.units),
            (self.depth, DEPTH, {}),
            (self.slide, SLIDE, {}),
        )
        times = self.times.tolist()
        found = [
            Fault(i, times[i], kind, name, float(values[i]), units.get(name, 'm'))
            for kind, (measured, most, units) in zip(KINDS, parts, strict=True)
            for name, values in measured.items()
            for i in np.flatnonzero(values > most).tolist()
        ]
        return tuple(sorted(found, key=lambda fault: fault.frame))

    def __str__(self) -> str:
        """A table with a line for every kind and joint or link, and the worst frame."""
        groups: dict[tuple[str, str], list[Fault]] = {}
        for fault in self.faults:
            groups.setdefault((fault.kind, fault.name), []).append(fault)
        title = f'{self.name}: {len(self.times)} frames, {self.times[-1]:.3g} s'
        if not groups:
            return f'{title}, no faults'
        rows = []
        for (kind, name), found in sorted(groups.items()):
            worst = max(found, key=lambda fault: fault.amount)
            frames = len(found), found[0].frame, found[-1].frame
            rows.append((kind, name, *frames, f'{worst.amount:.3g}', worst.unit, worst.frame))
        header = ('fault', 'where', 'frames', 'first', 'last', 'worst', '', 'in frame')
        return f'{title}\n{tables.table(header, rows)}'


def check(clip: Clip, character: str | characters.CharacterSpec, near: float = NEAR) -> Report:
    """Checks a clip on level ground at height 0, at its key frames.

    Contacts of a looping clip last across its seam, as those of a clip of two cycles.

    Args:
      clip: a clip with the joints of the character.
      character: name or `CharacterSpec`.
      near: height below which a corner of a foot is in contact, m, positive. Feet are the end
        effectors.

    Raises:
      ValueError: an unknown character, a clip with other joints, or another height.
    """
    checked('near', near, float, 'm', above=0)
    figure = KinematicViewer(character)
    layout, own = figure.layout, clip.layout
    if (own.root, own.joints, own.sizes) != (layout.root, layout.joints, layout.sizes):
        raise ValueError(
            f'clip {clip.name!r} (root {own.root}, joints {", ".join(own.joints)}) does not fit '
            f'{figure.character.spec.name!r} (root {layout.root}, joints {", ".join(layout.joints)})'
        )
    before = clip.pose(clip.times[:-1] - clip.duration) if clip.loop else clip.poses[:0]
    corners = np.empty((len(before) + len(clip.times), len(figure.links), 8, 3))
    for i, pose in enumerate(np.concatenate([before, clip.poses])):
        figure.put(pose)
        corners[i] = figure.corners()
    slide = {
        foot: _slide(corners[:, [name == foot for name in figure.links]], near)[len(before) :]
        for foot in figure.character.spec.end_effectors
    }
    corners = corners[len(before) :]
    deep = np.maximum(0.0, -corners[..., 2].min(2))
    depth: dict[str, np.ndarray] = {}
    for name, values in zip(figure.links, deep.T, strict=True):
        depth[name] = np.maximum(values, depth.get(name, 0.0))
    units = dict(
        zip(layout.joints, np.where(figure.character.prismatic, 'm', 'rad').tolist(), strict=True)
    )
    return Report(clip.name, clip.times, _excess(clip, figure), units, depth, slide)


def _excess(clip: Clip, figure: KinematicViewer) -> dict[str, np.ndarray]:
    found = {}
    for joint, size, (low, high) in zip(
        clip.joints, clip.sizes, figure.character.joint_ranges, strict=True
    ):
        column, _ = clip.layout.starts(joint)
        values = clip.poses[:, column]
        if size == 4:  # a ball joint's limit is a cone about the zero pose
            turns = quaternion.rotation_vector(clip.poses[:, column : column + 4])
            values, low = np.linalg.norm(turns, axis=1), -np.inf
        found[joint] = np.maximum(0.0, np.maximum(low - values, values - high))
    return found


def _slide(corners: np.ndarray, near: float) -> np.ndarray:
    """Returns the largest distance of corners (n, ..., 3) from the start of their contact, (n,)."""
    points = corners.reshape(len(corners), -1, 3)
    low = points[..., 2] < near
    begin, result = points[0, :, :2].copy(), np.zeros(len(points))
    for i in range(len(points)):
        fresh = low[i] & ~low[i - 1] if i else low[i]
        begin[fresh] = points[i, fresh, :2]
        away = np.linalg.norm(points[i, :, :2] - begin, axis=1)
        result[i] = away[low[i]].max(initial=0.0)
    return result
