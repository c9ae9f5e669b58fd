"""The dog's bound: a recording of its gait state machine in MuJoCo, corrected for sliding feet.

The state machine is that of the original, with its default parameters: four states, stable PD
control, gravity compensation through the feet on the ground, and forces on the body. The clip is
the recorded cycle that closes best. The recording exceeds two joint limits and slips slightly, so
each leg is solved again for a foot that rolls without slipping, within the limits.
"""

from __future__ import annotations

import figure
import mujoco
import numpy as np
from scipy import optimize

from trl_suite.motion.clip import Clip

CONTROL = 1 / 600  # s
SUBSTEPS = 5  # physics at 3000 Hz
SECONDS = 20.0
GRAVITY = 9.8  # m/s2, of the gravity compensation

JOINTS = (
    *('spine0', 'spine1', 'spine2', 'spine3', 'torso', 'neck0', 'neck1', 'head'),
    *('tail0', 'tail1', 'tail2', 'tail3'),
    *('shoulder', 'elbow', 'wrist', 'finger', 'hip', 'knee', 'ankle', 'toe'),
)
SPINE = JOINTS[:5]
FRONT, HIND = JOINTS[12:16], JOINTS[16:]
# Kp N m/rad, Kd N m s/rad, target rad, in the order of JOINTS.
KP = (*(200,) * 5, *(50,) * 3, *(4,) * 4, 160, 80, 80, 80, 130, 50, 50, 50)
KD = (*(20,) * 5, *(5,) * 3, *(0.4,) * 4, 16, 8, 8, 8, 13, 5, 5, 5)
TARGET = (
    *(0.0,) * 5,
    *(0.68507, 0.2, 0.20456, 0.4, 0.2, 0.2, 0.2),
    *(-0.5224, 0.87117, 0.11488, -0.46365),
    *(0.61719, -1.31193, 1.32022, -0.62549),
)
WORLD = ('shoulder', 'hip')  # joints whose target is the pitch of the link in the world

# The bound: duration of the stances s, velocity feedback s/m, forces on the body N.
STANCE = 0.125
FEEDBACK = 0.014184
BACK_FORCE = np.array([378.334188, 408.983406])
FRONT_FORCE = np.array([449.223161, 14.581642])
STATES = (  # spine, shoulder, elbow, hip, knee, ankle: target angles, rad
    (-0.112436, -2.992142, 6.511997, -0.322121, -1.353893, 0.992232),  # back stance
    (0.033595, 0.466324, 0.374654, 1.330918, -3.087531, 2.393892),  # extend
    (-0.09348, -1.514667, 0.664715, 0.727145, -1.679779, 1.315872),  # front stance
    (-0.110882, -1.252001, 1.111638, 0.744034, -2.18498, 0.930373),  # gather
)
STATE_JOINTS = ('shoulder', 'elbow', 'hip', 'knee', 'ankle')

# A start from which the bound settles: hind feet about to land, the trunk turning down.
START = (
    *(0.0, 0.345, 0.76),
    *(-0.317, 0.014, -0.01, -0.006, -0.001, 0.41, 0.364, 0.187),
    *(-0.728, -0.187, -0.165, 0.035),
    *(-1.57, 0.488, 0.518, -0.843, 0.449, -2.476, 1.609, -0.343),
)
START_SPEED = 5.5  # m/s

PHASES = 200  # samples of a cycle
HARMONICS = 12
SETTLE = 8  # cycles before the bound has settled
RATE_WEIGHT = 0.02  # s, of a gap in the rates against one in the angles
BLEND = 24  # samples over which a change of a foot's path grows and fades
MARGIN = 0.01  # rad to the joint limits
SOLE = ((-0.025, -0.035), (0.085, -0.035))  # heel and tip of both feet from their joint, m
TAIL = JOINTS[8:12]


class Recorder:
    """The dog on a plane, driven by its gait state machine; `step` advances one control step."""

    def __init__(self) -> None:
        self.model = model = figure.model('dog', ground=True)
        model.opt.timestep = CONTROL / SUBSTEPS
        model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        model.opt.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        colliding = model.geom_conaffinity > 0
        model.geom_conaffinity[colliding] = 1  # with the ground only, not with itself
        model.jnt_solref[:] = (4 * model.opt.timestep, 1)  # stiff limits, steadier cycles
        model.geom_solref[:], model.geom_solimp[:] = (0.005, 1), (0.95, 0.99, 0.001, 0.5, 2)
        self.data = mujoco.MjData(model)
        self.dof = np.array([model.joint(name).dofadr[0] for name in JOINTS])
        self.limit = np.array([model.jnt_actfrcrange[model.joint(name).id, 1] for name in JOINTS])
        self.kp, self.kd = np.zeros(model.nv), np.zeros(model.nv)
        self.kp[self.dof], self.kd[self.dof] = KP, KD
        self.target = np.zeros(model.nv)
        self.target[self.dof] = TARGET
        self.feet = [model.geom(name).id for name in ('toe', 'finger')]
        self.state, self.phase = 3, 1.0
        self.started = self.new_cycle = False

    def touching(self) -> tuple[bool, bool]:
        """Returns whether toe and finger are on the ground."""
        toe, finger = (bool(np.any(self.data.contact.geom == foot)) for foot in self.feet)
        return toe, finger

    def step(self) -> None:
        """Advances the physics with the torques held, then computes the next ones."""
        for _ in range(SUBSTEPS):
            mujoco.mj_step(self.model, self.data)
        mujoco.mj_forward(self.model, self.data)
        toe, finger = self.touching()
        self._advance(toe, finger)
        torque = self._pd(toe, finger)
        jacobians = [self._foot_jacobian(geom) for geom in self.feet]
        if toe or finger:
            torque += self._gravity_compensation(jacobians, (toe, finger))
        for limb, foot, on, force, states in (
            (HIND, 0, toe, BACK_FORCE, (0, 1)),
            (FRONT, 1, finger, FRONT_FORCE, (2, 3)),
        ):
            if on and self.state in states:
                dofs = [self.model.joint(name).dofadr[0] for name in limb]
                torque[dofs] -= (jacobians[foot].T @ force)[dofs]
        self.data.qfrc_applied[self.dof] = np.clip(torque[self.dof], -self.limit, self.limit)

    def _advance(self, toe: bool, finger: bool) -> None:
        self.phase += CONTROL / STANCE
        ends = (self.phase >= 1, finger, self.phase >= 1, toe)
        self.new_cycle = False
        if not self.started or ends[self.state]:
            self.state = (self.state + 1) % 4
            self.new_cycle = self.state == 0
            self.started, self.phase = True, 0.0
            spine, *angles = STATES[self.state]
            for name in SPINE:
                self.target[self.model.joint(name).dofadr[0]] = spine
            for name, angle in zip(STATE_JOINTS, angles, strict=True):
                self.target[self.model.joint(name).dofadr[0]] = angle
        mujoco.mj_subtreeVel(self.model, self.data)
        forward = self.data.subtree_linvel[self.model.body('root').id][0]
        for name, on in (('hip', toe), ('shoulder', finger)):
            if not on:
                angle = STATES[self.state][1 + STATE_JOINTS.index(name)]
                self.target[self.model.joint(name).dofadr[0]] = angle + FEEDBACK * forward

    def _pd(self, toe: bool, finger: bool) -> np.ndarray:
        model, data = self.model, self.data
        target = self.target.copy()
        for name in WORLD:
            dof = model.joint(name).dofadr[0]
            frame = data.xmat[model.body(name).id].reshape(3, 3)
            target[dof] -= np.arctan2(frame[2, 0], frame[0, 0]) - data.qpos[dof]
        mass = np.empty((model.nv, model.nv))
        mujoco.mj_fullM(model, data, mass)
        v = data.qvel
        pull = self.kp * (target - data.qpos - CONTROL * v)
        acceleration = np.linalg.solve(
            mass + CONTROL * np.diag(self.kd), pull - self.kd * v - data.qfrc_bias
        )
        torque = pull - self.kd * (v + CONTROL * acceleration)
        torque[:3] = 0
        return torque

    def _foot_jacobian(self, geom: int) -> np.ndarray:
        """Returns the Jacobian (x and z, nv) of the middle of a foot's sole."""
        model, data = self.model, self.data
        frame = data.geom_xmat[geom].reshape(3, 3)
        point = data.geom_xpos[geom] - frame[:, 2] * model.geom_size[geom, 2]
        jacobian = np.empty((3, model.nv))
        mujoco.mj_jac(model, data, jacobian, None, point, model.geom_bodyid[geom])
        return jacobian[[0, 2]]

    def _gravity_compensation(self, jacobians, on) -> np.ndarray:
        model, data = self.model, self.data
        weight = np.zeros(model.nv)
        jacobian = np.empty((3, model.nv))
        for body in range(1, model.nbody):
            mujoco.mj_jacBodyCom(model, data, jacobian, None, body)
            weight -= GRAVITY * model.body_mass[body] * jacobian[2]
        feet = np.concatenate([j.T * touch for j, touch in zip(jacobians, on, strict=True)], 1)
        a = feet[:3]
        force = np.linalg.solve(a.T @ a + 1e-4 * np.eye(4), -a.T @ weight[:3])
        torque = -weight - feet @ force
        torque[:3] = 0
        return torque


def record() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns poses (n, 3 + joints) and contacts (n, 2: toe, finger) at every control step, and
    the steps (cycles,) that begin a cycle.
    """
    recorder = Recorder()
    qpos, qvel = recorder.data.qpos, recorder.data.qvel
    qpos[:3], qpos[recorder.dof], qvel[0] = START[:3], START[3:], START_SPEED
    poses, contacts, starts = [], [], []
    for i in range(round(SECONDS / CONTROL)):
        recorder.step()
        poses.append(np.concatenate([qpos[:3], qpos[recorder.dof]]))
        contacts.append(recorder.touching())
        if recorder.new_cycle:
            starts.append(i)
    return np.array(poses), np.array(contacts), np.array(starts)


def cycle(poses: np.ndarray, contacts: np.ndarray, starts: np.ndarray):
    """Returns the cycle that closes best; its end is adjusted to its start evenly over the cycle.

    Long and short cycles alternate, and the mean of cycles with different contacts has no contacts.

    Returns:
      Poses (PHASES, 3 + joints) with x relative to a steady advance, contacts (PHASES, 2), the
      advance in m, and the period in s.
    """
    rates = np.gradient(poses, CONTROL, axis=0)
    first, last = starts[SETTLE:-1], starts[SETTLE + 1 :]
    gap = np.abs(poses[last] - poses[first])[:, 1:].max(axis=1)
    gap += RATE_WEIGHT * np.abs(rates[last] - rates[first]).max(axis=1)
    a, b = first[np.argmin(gap)], last[np.argmin(gap)]
    phase = np.arange(PHASES + 1) / PHASES
    at = a + phase * (b - a)
    sample = np.stack([np.interp(at, np.arange(len(poses)), c) for c in poses.T], axis=1)
    advance = float(sample[-1, 0] - sample[0, 0])
    sample[:, 0] -= sample[0, 0]
    sample -= np.outer(phase, sample[-1] - sample[0])
    spectrum = np.fft.rfft(sample[:-1], axis=0)
    spectrum[HARMONICS + 1 :] = 0
    closed = np.fft.irfft(spectrum, PHASES, axis=0)
    touching = contacts[np.round(at[:-1]).astype(int)]
    return closed, touching, advance, float(b - a) * CONTROL


def stance(touching: np.ndarray) -> np.ndarray:
    """Returns the samples of a foot's stance, in order, over the seam if need be, gaps closed."""
    n = len(touching)
    on = np.flatnonzero(touching)
    breaks = np.diff(np.append(on, on[0] + n))  # the stance ends before the longest flight
    start = on[(int(np.argmax(breaks)) + 1) % len(on)]
    end = on[int(np.argmax(breaks))]
    return np.arange(start, end + (n if end < start else 0) + 1)


def set_down(joint: np.ndarray, pitch: np.ndarray, on: np.ndarray, advance: float) -> np.ndarray:
    """Returns a foot joint's path, (n, 2), changed so that the foot rolls without slipping.

    Args:
      joint: recorded path over one cycle, (n, 2), x as travelled.
      pitch: of the foot, (n,).
      on: samples of the stance, which may run past n.
      advance: of a cycle, m.
    """
    n = len(joint)
    drift = np.array([advance, 0])
    path = np.concatenate([joint - drift, joint, joint + drift])
    sole = np.stack([figure.rotate(np.array(end), np.tile(pitch, 3)) for end in SOLE], axis=1)
    at = on + n
    lowest = sole[at, :, 1].argmin(axis=1)
    pivot = lowest[:-1]
    roll = sole[at[1:], pivot, 0] - sole[at[:-1], pivot, 0]
    x = -np.concatenate([[0], np.cumsum(roll)])
    standing = np.stack([x - x.mean() + path[at, 0].mean(), -sole[at, lowest, 1]], axis=1)
    result = path.copy()
    result[at] = standing
    # Before and after, the change fades such that the foot lands at rest.
    u = np.arange(1, BLEND + 1)[:, None] / BLEND
    for edge, inner, way in ((0, 1, -1), (-1, -2, 1)):
        near = at[edge] + way * np.arange(1, BLEND + 1)
        change = standing[edge] - path[at[edge]]
        rate = standing[edge] - standing[inner] - (path[near[0]] - path[at[edge]])
        result[near] += (change * (1 + 2 * u) + BLEND * rate * u) * (1 - u) ** 2
    # The stance may extend over the seam, so changes are collected by phase.
    changed = (result - path).reshape(3, n, 2)
    return joint + changed.sum(axis=0)


def solve_leg(
    make: figure.Figure,
    poses: np.ndarray,
    leg: tuple[str, ...],
    path: np.ndarray,
    grip: np.ndarray,
) -> np.ndarray:
    """Returns the poses with a leg bent, within its limits, so that its foot follows a path.

    The foot keeps its pitch as far as the limits let it; the other joints change as little as that
    allows. `grip` in [0, 1] says how much the foot matters; in mid-air only the limits do.
    """
    columns = [3 + JOINTS.index(name) for name in leg]
    model = figure.model('dog')
    low, high = np.array([model.joint(name).range for name in leg]).T
    low, high = low + MARGIN, high - MARGIN
    foot = 1 + JOINTS.index(leg[-1])
    pitch = make.forward(poses)[1][:, foot]
    result = poses.copy()
    for i, pose in enumerate(poses):
        trial = pose[None].copy()

        def residual(angles, i=i, pose=pose, trial=trial):
            trial[0, columns] = angles
            joint, turn = make.joints(trial)
            off = joint[0, foot] - path[i]
            return np.concatenate(
                [
                    1e3 * grip[i] * off,
                    [10 * grip[i] * (turn[0, foot] - pitch[i])],
                    angles - pose[columns],
                ]
            )

        start = np.clip(pose[columns], low + 1e-6, high - 1e-6)
        result[i, columns] = optimize.least_squares(residual, start, bounds=(low, high)).x
    return result


def clip() -> Clip:
    """Returns the bound."""
    poses, touching, advance, period = cycle(*record())
    make = figure.figure('dog', JOINTS)
    phase = np.arange(PHASES + 1) / PHASES
    poses[:, 0] += advance * phase[:-1]
    tail = [3 + JOINTS.index(name) for name in TAIL]
    # The tail has no contacts in simulation and dips into the ground; it swings about its working
    # posture instead of the recorded mean, which is lower.
    poses[:, tail] += TARGET[tail[0] - 3 : tail[-1] - 2] - poses[:, tail].mean(axis=0)
    for leg, foot in ((HIND, 0), (FRONT, 1)):
        joint, pitch = make.joints(poses)
        index = 1 + JOINTS.index(leg[-1])
        on = stance(touching[:, foot])
        path = set_down(joint[:, index], pitch[:, index], on, advance)
        # Full weight from the blend before the stance to the one after it, then fading over that
        # length.
        n, middle = PHASES, (on[0] + on[-1]) / 2
        away = np.abs((np.arange(n) - middle + n / 2) % n - n / 2) - len(on) / 2
        grip = np.clip(2 - away / BLEND, 0, 1) ** 4
        poses = solve_leg(make, poses, leg, path, grip)
    poses = np.concatenate([poses, poses[:1]])
    poses[-1, 0] += advance
    poses[:, 0] -= poses[0, 0]
    return Clip(
        'dog_bound',
        period * phase,
        poses,
        'planar',
        JOINTS,
        (1,) * len(JOINTS),
        True,
        f'bound at {advance / period:.2f} m/s, recorded from the gait machine',
    )


def clips() -> list[Clip]:
    """Returns the clips of this recipe."""
    return [clip()]
