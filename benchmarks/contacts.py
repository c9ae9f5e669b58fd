"""Measures how feet touch the ground, under changes of contacts, servos, feet and rates.

    python benchmarks/contacts.py [--episodes 8] [--seed 0] [--json docs/data/contacts.json]
        [--page docs/reports/robustness.md]

Shipped policies walk on level ground. In every physics step the normal force of the ground on each foot
is recorded, and from it
  return: of an episode, at most its number of steps;
  lift-offs: how often per second a foot loses the ground, mean over the feet;
  short: those of the lift-offs after which the foot touches the ground again within 50 ms, while a step
    of these gaits lasts more than 0.1 s;
  peak: the largest sum of the forces on all feet in an episode, in body weights;
  99 %: the percentile of this sum over the steps with contact;
  height: of the lowest point of a foot in the middle of short lift-offs, median, mm;
  depth: of the lowest point of a foot below the ground while it bears weight, median, mm.
Each change is written to the compiled model, or replaces the control that the servos receive in the
physics steps of a control step. Policies are not trained for it.
"""

from __future__ import annotations

import argparse
import pathlib
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
import tqdm

from trl_suite import policies, suite
from trl_suite.util import files, tables
from trl_suite.util.program import begin_script

WALKS = {
    'biped': 'PD_Biped2D_LLC_Imitate_Flat-v0', 'dog': 'PD_Dog2D_LLC_Imitate_Flat-v0',
    'raptor': 'PD_Raptor2D_LLC_Imitate_Flat-v0',
}  # fmt: skip
OTHERS = ('Torque', 'MTU', 'Vel')  # actuation models, compared without changes
SHORT = 0.05  # s

Change = Callable[[mujoco.MjModel, np.ndarray], None]  # of a model, given the geoms of the feet


def _contacts(name: str, value: Any) -> Change:
    def change(model: mujoco.MjModel, feet: np.ndarray) -> None:
        solid = (model.geom_contype > 0) | (model.geom_conaffinity > 0)
        getattr(model, name)[solid] = value

    return change


def _option(name: str, value: Any) -> Change:
    return lambda model, feet: setattr(model.opt, name, value)


def _servos(stiffness: float = 1.0, damping: float = 1.0) -> Change:
    def change(model: mujoco.MjModel, feet: np.ndarray) -> None:
        model.actuator_gainprm[:, 0] *= stiffness
        model.actuator_biasprm[:, 1] *= stiffness
        model.actuator_biasprm[:, 2] *= damping

    return change


def _damping(factor: float) -> Change:
    def change(model: mujoco.MjModel, feet: np.ndarray) -> None:
        model.dof_damping[:] *= factor

    return change


def _armature(value: float) -> Change:
    def change(model: mujoco.MjModel, feet: np.ndarray) -> None:
        model.dof_armature[model.dof_armature > 0] = value

    return change


def _round(model: mujoco.MjModel, feet: np.ndarray) -> None:
    """Boxes of feet become capsules of the same height and length."""
    for geom in feet:
        size = model.geom_size[geom].copy()
        long = int(np.argmax(size * (1, 0, 1)))  # the axis in the plane
        radius = size[2 - long]
        turn = np.zeros(4)
        mujoco.mju_quatZ2Vec(turn, np.eye(3)[long])
        mujoco.mju_mulQuat(model.geom_quat[geom], model.geom_quat[geom].copy(), turn)
        model.geom_sameframe[geom] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE  # it has a rotation now
        model.geom_type[geom] = mujoco.mjtGeom.mjGEOM_CAPSULE
        model.geom_size[geom] = radius, max(size[long] - radius, 1e-3), 0
        model.geom_rbound[geom] = size[long]
        model.geom_aabb[geom, 3:] = radius, radius, size[long]


def _soft(depth: float, least: float = 0.0) -> Change:
    return _contacts('geom_solimp', (least, 0.99, depth, 0.5, 2))


# Changes: name, changes of the model, options of the task, whether targets are interpolated.
CHANGES: list[tuple[str, list[Change], dict[str, Any], bool]] = [
    ('none', [], {}, False),
    ('impedance 0 to 0.99 over 1 mm', [_soft(0.001)], {}, False),
    ('impedance 0 to 0.99 over 3 mm', [_soft(0.003)], {}, False),
    ('impedance 0 to 0.99 over 10 mm', [_soft(0.01)], {}, False),
    ('impedance 0.5 to 0.99 over 10 mm', [_soft(0.01, 0.5)], {}, False),
    ('impedance 0.9 to 0.95', [_contacts('geom_solimp', (0.9, 0.95, 0.001, 0.5, 2))], {}, False),
    ('time constant 0.01 s', [_contacts('geom_solref', (0.01, 1))], {}, False),
    ('time constant 0.02 s', [_contacts('geom_solref', (0.02, 1))], {}, False),
    ('time constant 0.04 s', [_contacts('geom_solref', (0.04, 1))], {}, False),
    ('damping ratio 2', [_contacts('geom_solref', (0.005, 2))], {}, False),
    (
        'time constant 0.02 s, impedance 0 to 0.99 over 10 mm',
        [_contacts('geom_solref', (0.02, 1)), _soft(0.01)], {}, False,
    ),
    ('1200 physics steps per s', [], {'substeps': 40}, False),
    ('3000 physics steps per s', [], {'substeps': 100}, False),
    ('3000, impedance 0 to 0.99 over 10 mm', [_soft(0.01)], {'substeps': 100}, False),
    ('impratio 10', [_option('impratio', 10)], {}, False),
    ('elliptic cone', [_option('cone', mujoco.mjtCone.mjCONE_ELLIPTIC)], {}, False),
    ('friction 0.4', [_contacts('geom_friction', (0.4, 0.005, 0.0001))], {}, False),
    ('friction 1.6', [_contacts('geom_friction', (1.6, 0.005, 0.0001))], {}, False),
    ('feet: capsules', [_round], {}, False),
    ('gains x 0.5', [_servos(0.5)], {}, False),
    ('gains x 2', [_servos(2.0)], {}, False),
    ('servo damping x 2', [_servos(1.0, 2.0)], {}, False),
    ('passive damping x 2', [_damping(2.0)], {}, False),
    ('armature 0.05 kg m²', [_armature(0.05)], {}, False),
    ('joint targets interpolated', [], {}, True),
]  # fmt: skip


class Subject:
    """An environment whose contacts are recorded in every physics step."""

    def __init__(self, id_: str, seed: int, change: tuple[list[Change], dict[str, Any], bool]):
        changes, options, self.smooth = change
        self.environment = suite.make(id_, {'random': seed, **options})
        self.model = self.environment.physics.model.ptr
        self.data = self.environment.physics.data.ptr
        world = self.environment.task.world
        character = self.environment.task.character
        names = [f'{character.mjcf_model.model}/{name}' for name in character.spec.end_effectors]
        bodies = world.body_ids(names)
        self.foot = np.full(self.model.ngeom, -1)  # number of the foot that a geom belongs to
        for number, body in enumerate(bodies):
            self.foot[self.model.geom_bodyid == body] = number
        solid = self.model.geom_contype > 0
        root = self.model.body_rootid[bodies[0]]
        self.own = self.model.body_rootid[self.model.geom_bodyid] == root
        self.weight = self.model.body_subtreemass[root] * -self.model.opt.gravity[2]
        for each in changes:
            each(self.model, np.flatnonzero((self.foot >= 0) & solid))
        self.feet, self.soles = len(bodies), np.flatnonzero((self.foot >= 0) & solid)
        self.forces: list[np.ndarray] = []  # of every physics step, (feet,) N
        self.heights: list[np.ndarray] = []  # of the lowest point of every foot, (feet,) m
        self.target = None
        self.world: Any = world
        self.world.step = self.step

    def step(self, nstep: int, env_ids: np.ndarray | None = None) -> None:
        """Replaces `World.step`; both make the same physics steps."""
        target = self.data.ctrl.copy()
        before = target if self.target is None else self.target
        for k in range(nstep):
            if self.smooth:
                self.data.ctrl[:] = before + (target - before) * ((k + 1) / nstep)
            mujoco.mj_step2(self.model, self.data)
            self.forces.append(self.normal_forces())
            self.heights.append(self.lowest())
            mujoco.mj_step1(self.model, self.data)
            self.world.engine.time[0] += self.world.engine.timestep
        self.world.engine.steps[0] += nstep
        self.target = target

    def normal_forces(self) -> np.ndarray:
        """Returns the sum of the normal forces of the ground on each foot, N."""
        forces, out = np.zeros(self.feet), np.zeros(6)
        for i in range(self.data.ncon):
            one, other = self.data.contact.geom[i]
            if self.own[one] == self.own[other]:
                continue
            foot = self.foot[one if self.own[one] else other]
            if foot >= 0:
                mujoco.mj_contactForce(self.model, self.data, i, out)
                forces[foot] += out[0]
        return forces

    def lowest(self) -> np.ndarray:
        """Returns the height of the lowest point of each foot above level ground, m."""
        heights = np.full(self.feet, np.inf)
        for geom in self.soles:
            up, size = np.abs(self.data.geom_xmat[geom, 6:]), self.model.geom_size[geom]
            if self.model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_BOX:
                reach = up @ size
            else:
                reach = size[0] + up[2] * size[1]
            foot = self.foot[geom]
            heights[foot] = min(heights[foot], self.data.geom_xpos[geom, 2] - reach)
        return heights

    def episode(self, policy: Callable[[Any], np.ndarray]) -> dict[str, float]:
        """Runs one episode; returns what is measured in it."""
        time_step, total, self.target, steps = self.environment.reset(), 0.0, None, 0
        self.forces, self.heights = [], []
        while not time_step.last():
            time_step = self.environment.step(policy(time_step.observation))
            total, steps = total + time_step.reward, steps + 1
        forces = np.array(self.forces) / self.weight  # (physics steps, feet)
        timestep = self.model.opt.timestep
        touches, heights = forces > 0, 1e3 * np.array(self.heights)
        lifts, short = 0, 0
        gaps: list[float] = []
        for foot, height in zip(touches.T, heights.T, strict=True):
            ups, downs = (
                np.flatnonzero(foot[:-1] & ~foot[1:]),
                np.flatnonzero(~foot[:-1] & foot[1:]),
            )
            following = np.searchsorted(downs, ups)
            known = following < len(downs)
            pairs = np.stack([ups[known], downs[following[known]]])
            brief = pairs[:, np.diff(pairs, axis=0)[0] * timestep < SHORT]
            lifts, short = lifts + len(ups), short + brief.shape[1]
            gaps += height[brief.mean(0).astype(int) + 1].tolist()
        seconds = len(forces) * timestep * self.feet
        every = forces.sum(1)
        held = every[every > 0]
        return {
            'return': total, 'length': steps, 'lift-offs': lifts / seconds, 'short': short / seconds,
            'peak': float(every.max()), '99 %': float(np.percentile(held, 99)),
            'height': float(np.median(gaps)) if gaps else 0.0,
            'depth': float(-np.median(heights[forces > 0.2])),
        }  # fmt: skip


def measure(id_: str, name: str, episodes: int, seed: int) -> dict[str, float]:
    """Returns the means over episodes under a change."""
    change = next(
        (model, options, smooth) for key, model, options, smooth in CHANGES if key == name
    )
    policy = policies.reference(id_)
    subject = Subject(id_, seed, change)
    found = [subject.episode(policy) for _ in range(episodes)]
    return {key: float(np.mean([each[key] for each in found])) for key in found[0]}


def cells() -> list[tuple[str, str]]:
    """Returns ids and changes that are measured."""
    others = [
        (id_.replace('PD_', f'{model}_', 1), 'none') for model in OTHERS for id_ in WALKS.values()
    ]
    return [(id_, name) for name, *_ in CHANGES for id_ in WALKS.values()] + others


def run(episodes: int, seed: int, path: pathlib.Path) -> dict[str, Any]:
    """Measures what the file does not have yet; returns all, by environment and change."""
    start = {'episodes': episodes, 'seed': seed, 'results': {}}
    with files.changing(path, start) as found:
        pass  # what there is
    for id_, name in tqdm.tqdm(cells()):
        if name not in found['results'].get(id_, {}):
            result = measure(id_, name, episodes, seed)
            with files.changing(path, start) as found:
                found['results'].setdefault(id_, {})[name] = result
    return found


def _text(row: dict[str, float]) -> str:
    return (
        f'{row["return"]:.0f} / {row["lift-offs"]:.1f} ({row["short"]:.1f}) / '
        f'{row["peak"]:.1f} ({row["99 %"]:.1f}) / {row["depth"]:.1f}'
    )


def table(found: dict[str, Any]) -> str:
    """Returns the results as Markdown."""
    results = found['results']
    title = (
        f'Means of {found["episodes"]} episodes of at most 256 steps: return / lift-offs per foot and second '
        '(of these, shorter than 50 ms) / largest force in body weights (99th percentile) / depth of the soles below the ground in mm.'
    )
    rows = [(name, *(_text(results[id_][name]) for id_ in WALKS.values())) for name, *_ in CHANGES]
    words = {'Torque': 'torque control', 'MTU': 'muscles', 'Vel': 'velocity control'}
    for model in OTHERS:
        ids = (id_.replace('PD_', f'{model}_', 1) for id_ in WALKS.values())
        rows.append((words[model], *(_text(results[id_]['none']) for id_ in ids)))
    return f'{title}\n\n{tables.markdown_table(("change", *WALKS), rows)}'


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--episodes', type=int, default=8)
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument(
        '--json', type=pathlib.Path, default=pathlib.Path('docs/data/contacts.json')
    )
    parser.add_argument('--page', type=pathlib.Path, help='a page whose table is replaced')
    arguments = parser.parse_args()
    text = table(run(arguments.episodes, arguments.seed, arguments.json))
    print(text)
    if arguments.page is not None:
        files.replace_between(arguments.page, 'contacts', 'benchmarks/contacts.py', text)


if __name__ == '__main__':
    begin_script()
    main()
