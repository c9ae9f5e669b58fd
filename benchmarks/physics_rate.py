"""Determines the physics rate that each character needs, by convergence towards 1/3000 s.

    python benchmarks/physics_rate.py [--quick] [--json FILE] [--plot FILE]
    python benchmarks/physics_rate.py --json docs/data/physics_rate.json --page benchmarks/physics_rate.md

1/3000 s is the time step of the original. With contact, trajectories diverge exponentially, so no
two rates agree for long, however accurate they are. Many short episodes are therefore run with the
same start and the same actions at every rate and compared with 1/3000 s start by start, as means
with 95 % confidence intervals over starts. Three comparisons at 1/3000 s show the scale of a
deviation:
  perturbed: joints and pitch of the start are displaced by a normal 0.01 rad, like the noise of a
    reset.
  soft: contacts and joint limits are as soft as at the default rate. MuJoCo limits a constraint's
    time constant to at least two time steps, and `trl_suite.actuation` sets that of joint limits to
    this value, so a coarser rate has softer constraints as well as a coarser integration.
  default, against soft: the effect of the coarser integration alone.
Position and velocity control follow the clip open loop, torque and muscle control a smooth seeded
sequence. Random full-range actions, continued after falls, test for divergence; in the air without
actuators, damping, limits and contact, energy should be conserved. Finally solver settings are
compared at the default rate. The second command measures nothing: it writes the tables of
physics_rate.md, which has the conclusion, from the JSON file.
"""

import argparse
import pathlib
import time

import mujoco
import numpy as np

from trl_suite import suite
from trl_suite.tasks.common.control import SUBSTEPS as DEFAULT
from trl_suite.util import files, tables
from trl_suite.util.program import begin_script

RATES = (100, 40, 20, 10, 8, 5, 4)  # physics steps per control step of 1/30 s, finest first
CONTROL_RATE = 30  # Hz
REFERENCE = RATES[0]
STARTS = 32  # seeds 0 ... 31: each has a start phase, an action sequence, and a terrain
STEPS = 15  # control steps of a compared episode: 0.5 s
AT = {'0.1 s': 3, '0.3 s': 9}  # where poses are compared, control steps
REWARD_STEPS = 9  # over which rewards are compared
RANDOM_EPISODES = 32  # the odd ones with every action at -1 or 1, the others uniform
RANDOM_STEPS = 45
PERTURBATION = 0.01  # rad
AMPLITUDE = 0.5  # of the smooth action sequences
FREQUENCIES = (0.5, 2.0)  # Hz
ON_TERRAIN = 3.0  # m; where episodes over terrain begin, beyond the flat start
REACH = 0.6  # m to both sides of the root that must be clear of the ground there
RESAMPLES = 1000  # of the bootstrap
ONE = np.zeros(1, int)  # the simulation of a single environment

# Compared environments: each character, actuation model and clip of the catalogue on flat ground,
# and the most difficult terrain for each character that walks over terrain.
GROUPS = {
    'biped2d position': 'PD_Biped2D_LLC_Imitate_Flat-v0',
    'biped2d position, run': 'PD_Biped2D_LLC_Imitate_Run_Flat-v0',
    'biped2d velocity': 'Vel_Biped2D_LLC_Imitate_Flat-v0',
    'biped2d torque': 'Torque_Biped2D_LLC_Imitate_Flat-v0',
    'biped2d muscle': 'MTU_Biped2D_LLC_Imitate_Flat-v0',
    'biped2d muscle, run': 'MTU_Biped2D_LLC_Imitate_Run_Flat-v0',
    'dog position': 'PD_Dog2D_LLC_Imitate_Flat-v0',
    'dog velocity': 'Vel_Dog2D_LLC_Imitate_Flat-v0',
    'dog torque': 'Torque_Dog2D_LLC_Imitate_Flat-v0',
    'dog muscle': 'MTU_Dog2D_LLC_Imitate_Flat-v0',
    'raptor position': 'PD_Raptor2D_LLC_Imitate_Flat-v0',
    'raptor velocity': 'Vel_Raptor2D_LLC_Imitate_Flat-v0',
    'raptor torque': 'Torque_Raptor2D_LLC_Imitate_Flat-v0',
    'raptor muscle': 'MTU_Raptor2D_LLC_Imitate_Flat-v0',
    'biped2d_full position': 'PD_Biped2D_Flat_Terrain-v0',
    'biped2d_full position, slopes_mixed': 'PD_Biped2D_Slopes_Mixed_Terrain-v0',
    'dog position, slopes_mixed': 'PD_Dog2D_Slopes_Mixed_Terrain-v0',
    'raptor position, slopes_mixed': 'PD_Raptor2D_Slopes_Mixed_Terrain-v0',
}
SOLVER_GROUPS = (
    'biped2d position', 'biped2d_full position, slopes_mixed', 'dog position', 'dog torque',
    'raptor velocity', 'raptor muscle',
)  # fmt: skip
SOLVERS = {
    'as it is': {},
    'elliptic cone': {'cone': mujoco.mjtCone.mjCONE_ELLIPTIC},
    'elliptic cone, 5 noslip iterations': {
        'cone': mujoco.mjtCone.mjCONE_ELLIPTIC, 'noslip_iterations': 5,
    },
    '5 noslip iterations': {'noslip_iterations': 5},
    '10 iterations': {'iterations': 10},
    '3 iterations': {'iterations': 3},
    'implicit': {'integrator': mujoco.mjtIntegrator.mjINT_IMPLICIT},
    'Euler': {'integrator': mujoco.mjtIntegrator.mjINT_EULER},
}  # fmt: skip

# A rate is accepted if all of these hold at it and at every finer one. The bounds are a judgement.
# Of an interval, the end nearest to zero is compared.
ACCEPTED = {
    'diverged share': 0.0,
    'joints 0.1 s / perturbed': 2.0,  # 1 is the effect of 0.01 rad of noise at the start
    'reward difference': 0.02,
    'mean force difference': 0.05,  # of the weight
    'random limit violation': 0.15,  # rad, 99th percentile
    'random penetration beyond reference': 0.02,  # m, 99th percentile
}


class Subject:
    """One environment at one rate, driven control step by control step."""

    def __init__(self, id_, substeps):
        self.environment = suite.make(id_, {'random': 0, 'substeps': substeps})
        self.task = self.environment.task
        self.substeps = substeps
        self.on_terrain = suite.find(id_).terrain != 'flat'
        self.model = self.environment.physics.model.ptr
        self.data = self.environment.physics.data.ptr
        figure = self.task.body
        self.joint_qpos, self.joint_dof = figure.pose_qpos[3:], figure.pose_dof[3:]
        self.root_qpos, self.z_dof = figure.pose_qpos[:2], figure.pose_dof[1]
        body = self.model.dof_bodyid[figure.pose_dof[0]]
        self.weight = -self.model.opt.gravity[2] * self.model.body_subtreemass[body]
        body_of = self.model.geom_bodyid
        self.ground = self.model.body_rootid[body_of] != self.model.body_rootid[body]
        ids = self.model.dof_jntid[self.joint_dof]
        self.limited = self.model.jnt_limited[ids] == 1
        self.low, self.high = self.model.jnt_range[ids].T
        self.cpu = 0.0  # s in physics alone
        self.cpu_all = 0.0  # s in whole steps
        self.timed = 0

    def soften(self, timestep):
        """Sets the time constants of contacts and limits to those at another time step."""
        self.model.geom_solref[:, 0] = np.maximum(self.model.geom_solref[:, 0], 2 * timestep)
        self.model.jnt_solref[:, 0] = np.maximum(self.model.jnt_solref[:, 0], 2 * timestep)

    def start(self, seed, noise=0.0):
        self.environment.random_state.seed(seed)
        self.environment.reset()
        if noise:
            random = np.random.default_rng([seed, 1])
            moved = self.task.body.pose_qpos[2:]
            self.data.qpos[moved] += random.normal(0, noise, len(moved))
            mujoco.mj_forward(self.model, self.data)
        if self.on_terrain:
            height = self.task.arena.height
            before = height(np.zeros((1, 1))).max()
            x, z = self.root_qpos
            self.data.qpos[x] = ON_TERRAIN
            self.task.arena.recentre(np.zeros(1, int), np.array([ON_TERRAIN]))
            around = ON_TERRAIN + np.linspace(-REACH, REACH, 49)
            self.data.qpos[z] += height(around[None]).max() - before
            mujoco.mj_forward(self.model, self.data)

    def step(self, action):
        """Steps as the environment does, with timing."""
        begin = time.process_time()
        self.task.apply_action(action[None], ONE)
        middle = time.process_time()
        self.task.simulate(ONE)
        end = time.process_time()
        self.task.finish_step(ONE)
        self.cpu += end - middle
        self.cpu_all += time.process_time() - begin
        self.timed += 1

    def watched_step(self, action):
        """Measures every substep; returns vertical contact forces / weight and depths (m)."""
        forces, depths = np.empty(self.substeps), np.empty(self.substeps)
        self.task.apply_action(action[None], ONE)
        for i in range(self.substeps):
            self.task.world.step(1)
            # Contacts are the only constraints that act along the root's vertical slide.
            forces[i] = self.data.qfrc_constraint[self.z_dof]
            depths[i] = self.depth()
        self.task.finish_step(ONE)
        return forces / self.weight, depths

    def depth(self):
        """Largest depth in the ground, m."""
        if not self.data.ncon:
            return 0.0
        contact = self.data.contact
        distances = contact.dist[self.ground[contact.geom].any(1)]
        return max(-distances.min(initial=0.0), 0.0)

    def violation(self):
        angles = self.data.qpos[self.joint_qpos]
        beyond = np.maximum(self.low - angles, angles - self.high)[self.limited]
        return max(beyond.max(initial=0.0), 0.0)

    def speed(self):
        return np.abs(self.data.qvel[self.joint_dof]).max()

    def energy(self):
        """Kinetic and potential energy divided by weight: the equivalent height, m."""
        mujoco.mj_energyPos(self.model, self.data)
        mujoco.mj_energyVel(self.model, self.data)
        return self.data.energy.sum() / self.weight

    def action(self, seed, step):
        """Returns the fixed action: that of the clip, or of a smooth seeded sequence."""
        if self.task.actuation_model in ('position', 'velocity'):
            return self.task.clip_action(0)
        random = np.random.default_rng([seed, 2])
        size = len(self.task.action_map)
        frequency, phase = random.uniform(*FREQUENCIES, size), random.uniform(0, 1, size)
        return AMPLITUDE * np.sin(2 * np.pi * (frequency * step / CONTROL_RATE + phase))


def compared(subject, starts, noise=0.0):
    """Runs the fixed actions from many starts; returns arrays whose first axis is the start."""
    names = ('joints', 'root', 'reward', 'force', 'impulse', 'peak', 'depth', 'energy', 'speed')
    found = {name: [] for name in (*names, 'violation', 'begin')}
    for seed in range(starts):
        subject.start(seed, noise)
        row = {name: [] for name in names}
        begin, violation, alive = subject.data.qpos.copy(), 0.0, 1.0
        for step in range(STEPS):
            forces, depths = subject.watched_step(subject.action(seed, step))
            alive *= not subject.task.failed[0]
            row['joints'].append(subject.data.qpos[subject.joint_qpos].copy())
            row['root'].append(subject.data.qpos[subject.root_qpos].copy())
            row['reward'].append(alive * subject.task.reward[0])
            row['force'].append(forces.mean())
            row['peak'].append(forces.max())
            row['depth'].append(depths.max())
            row['energy'].append(subject.energy())
            row['speed'].append(subject.speed())
            violation = max(violation, subject.violation())
        row['impulse'] = max(row['force'])
        for name in names:
            found[name].append(row[name])
        found['violation'].append(violation)
        found['begin'].append(begin)
    return {name: np.array(value) for name, value in found.items()}


def flailed(subject, episodes):
    """Runs random full-range actions, which continue after falls until divergence."""
    diverged, speeds, violations, depths = [], [], [], []
    for seed in range(episodes):
        subject.start(seed)
        random = np.random.default_rng([seed, 3])
        for _ in range(RANDOM_STEPS):
            action = random.uniform(-1, 1, len(subject.task.action_map))
            subject.step(np.sign(action) if seed % 2 else action)
            if subject.task.diverged[0]:
                break
            speeds.append(subject.speed())
            violations.append(subject.violation())
            depths.append(subject.depth())
        diverged.append(bool(subject.task.diverged[0]))
    return {
        'diverged share': np.mean(diverged),
        'random speed, max': np.max(speeds),
        'random speed': np.percentile(speeds, 99),
        'random limit violation, max': np.max(violations),
        'random limit violation': np.percentile(violations, 99),
        'random penetration, max': np.max(depths),
        'random penetration': np.percentile(depths, 99),
    }


def passive_drift(subject, starts):
    """Largest change of energy / weight in 0.5 s in the air without dissipation, m."""
    model = mujoco.MjModel.__copy__(subject.model)
    flags = mujoco.mjtDisableBit
    for flag in (flags.mjDSBL_CONTACT, flags.mjDSBL_ACTUATION, flags.mjDSBL_LIMIT):
        model.opt.disableflags |= flag
    model.dof_damping[:] = 0.0
    data = mujoco.MjData(model)
    drifts = []
    for seed in range(starts):
        subject.start(seed)
        data.qpos[:], data.qvel[:] = subject.data.qpos, subject.data.qvel
        energies = []
        for _ in range(STEPS):
            mujoco.mj_forward(model, data)
            mujoco.mj_energyPos(model, data)
            mujoco.mj_energyVel(model, data)
            energies.append(data.energy.sum())
            mujoco.mj_step(model, data, subject.substeps)
        drifts.append(np.abs(np.array(energies) - energies[0]).max() / subject.weight)
    return float(np.mean(drifts))


def interval(values, statistic=np.mean):
    """Returns statistic, low and high of its 95 % bootstrap interval over the first axis."""
    random = np.random.default_rng(0)
    drawn = random.integers(0, len(values), (RESAMPLES, len(values)))
    spread = np.percentile(statistic(values[drawn], axis=1), [2.5, 97.5])
    return [float(statistic(values, axis=0)), *spread.tolist()]


def against(found, reference):
    """Returns deviations from a reference, start by start."""
    row = {}
    for name, step in AT.items():
        joints = found['joints'][:, step - 1] - reference['joints'][:, step - 1]
        root = found['root'][:, step - 1] - reference['root'][:, step - 1]
        row[f'joints {name}'] = interval(np.sqrt((joints**2).mean(1)), np.median)
        row[f'root {name}'] = interval(np.hypot(*root.T), np.median)
        energy = found['energy'][:, step - 1] - reference['energy'][:, step - 1]
        row[f'energy difference {name}'] = interval(energy)

    def mean(run, name, steps=STEPS):
        return run[name][:, :steps].mean(1)

    reward = mean(found, 'reward', REWARD_STEPS) - mean(reference, 'reward', REWARD_STEPS)
    row['reward difference'] = interval(reward)
    row['reward'] = interval(mean(found, 'reward', REWARD_STEPS))
    row['mean force'] = interval(mean(found, 'force'))
    row['mean force difference'] = interval(mean(found, 'force') - mean(reference, 'force'))
    # The largest impulse in a control step, as a force over weight; and in a physics step.
    row['peak impulse'] = interval(found['impulse'])
    row['peak impulse difference'] = interval(found['impulse'] - reference['impulse'])
    row['peak force'] = interval(found['peak'].max(1))
    row['penetration'] = interval(found['depth'].max(1))
    row['speed'] = interval(found['speed'].max(1))
    row['limit violation'] = interval(found['violation'])
    return row


def group(id_, rates, starts, episodes):
    rows = {}
    reference = deepest = None
    for substeps in rates:
        subject = Subject(id_, substeps)
        found = compared(subject, starts)
        reference = reference or found
        assert np.array_equal(found['begin'], reference['begin']), 'starts differ between rates'
        row = rows[str(substeps)] = against(found, reference)
        row.update(flailed(subject, episodes))
        deepest = row['random penetration'] if deepest is None else deepest
        row['random penetration beyond reference'] = row['random penetration'] - deepest
        row['passive drift'] = passive_drift(subject, min(starts, 8))
        row['physics us'] = 1e6 * subject.cpu / subject.timed
        row['step us'] = 1e6 * subject.cpu_all / subject.timed
        if substeps == DEFAULT:
            default = found
    subject = Subject(id_, REFERENCE)
    rows['perturbed'] = against(compared(subject, starts, PERTURBATION), reference)
    subject.soften(1 / CONTROL_RATE / DEFAULT)
    soft = compared(subject, starts)
    rows['soft'] = against(soft, reference)
    rows['default, against soft'] = against(default, soft)
    yardstick = rows['perturbed']['joints 0.1 s'][0]
    for substeps in rates:
        row = rows[str(substeps)]
        row['joints 0.1 s / perturbed'] = row['joints 0.1 s'][0] / yardstick
        row['fails'] = [name for name, most in ACCEPTED.items() if beyond(row[name]) > most]
    return rows


def chosen(rows, rates):
    """Returns the coarsest accepted rate."""
    coarsest = rates[0]
    for substeps in rates:
        if rows[str(substeps)]['fails']:
            break
        coarsest = substeps
    return coarsest


def beyond(value):
    """Returns the value compared with a bound: of an interval, its end nearest to zero."""
    if not isinstance(value, list):
        return value
    _, low, high = value
    return max(low, -high, 0.0)


def solvers(id_, starts, episodes):
    rows = {}
    base = None
    reference = compared(Subject(id_, REFERENCE), starts)
    for name, options in SOLVERS.items():
        subject = Subject(id_, DEFAULT)
        for option, value in options.items():
            setattr(subject.model.opt, option, value)
        found = compared(subject, starts)
        base = base or found
        row = rows[name] = against(found, base)
        row['joints 0.1 s, from 1/3000 s'] = against(found, reference)['joints 0.1 s']
        row.update(flailed(subject, episodes))
        row['physics us'] = 1e6 * subject.cpu / subject.timed
    return rows


def report(figures):
    rates = [str(n) for n in figures['rates']]

    def table(title, cells):
        print(f'\n{title}\n{"":36}' + ''.join(f'{rate(r):>9}' for r in rates))
        for name, rows in figures['groups'].items():
            print(f'{name:36}' + ''.join(f'{cells(rows[r]):>9}' for r in rates))

    for name, scale, digits in (
        ('joints 0.1 s / perturbed', 1, 2),
        ('joints 0.1 s', 1e3, 1), ('joints 0.3 s', 1e3, 1), ('root 0.3 s', 1e3, 1),
        ('reward difference', 1e3, 1), ('mean force difference', 1e3, 1), ('mean force', 1, 3),
        ('peak impulse', 1, 2), ('peak impulse difference', 1, 3), ('peak force', 1, 2),
        ('penetration', 1e3, 1), ('random penetration beyond reference', 1e3, 1),
        ('energy difference 0.1 s', 1e3, 1), ('energy difference 0.3 s', 1e3, 1),
        ('speed', 1, 1), ('limit violation', 1, 3), ('passive drift', 1e3, 2),
        ('diverged share', 1, 3), ('random speed, max', 1, 0), ('random limit violation', 1, 3),
        ('random limit violation, max', 1, 3), ('random penetration', 1e3, 1),
        ('random penetration, max', 1e3, 1), ('physics us', 1, 0), ('step us', 1, 0),
    ):  # fmt: skip
        table(
            f'{name} x {scale:g}',
            lambda row, n=name, s=scale, d=digits: f'{s * np.ravel(row[n])[0]:.{d}f}',
        )
    print('\ncoarsest accepted rate, and the bounds exceeded at the others')
    for name, rows in figures['groups'].items():
        fails = {rate(r): rows[r]['fails'] for r in rates if rows[r]['fails']}
        print(f'{name:36}{rate(rows["chosen"])}', fails)
    print('\nyardsticks: joints at 0.1 s (mrad), reward, mean force')
    for name, rows in figures['groups'].items():
        for case in ('perturbed', 'soft', 'default, against soft'):
            row = rows[case]
            print(
                f'{name:36}{case:24}{1e3 * row["joints 0.1 s"][0]:8.1f}'
                f'{row["reward difference"][0]:9.4f}{row["mean force difference"][0]:9.4f}'
            )
    print(f'\nsolvers\n{solver_table(figures)}')


def rate(substeps):
    return f'1/{CONTROL_RATE * int(substeps)}'


def spread(values, digits):
    """Returns a value and its interval with signs."""
    value, low, high = (f'{each:+.{digits}f}' for each in values)
    return f'{value} ({low}, {high})'


def deviation_table(figures):
    compared = [n for n in figures['rates'] if n != REFERENCE]
    rows = []
    for name, found in figures['groups'].items():
        ratios = (f'{found[str(n)]["joints 0.1 s / perturbed"]:.2f}' for n in compared)
        angles = (f'{1e3 * found[case]["joints 0.1 s"][0]:.1f}' for case in (str(DEFAULT), 'soft'))
        rows.append((name, *ratios, *angles, rate(found['chosen'])))
    rates = (f'**{rate(n)}**' if n == DEFAULT else rate(n) for n in compared)
    more = f'mrad at {rate(DEFAULT)}', 'mrad, softness alone', 'meets all bounds'
    return tables.markdown_table(('character, actuation', *rates, *more), rows)


def measure_table(figures):
    limits, depths = (20, DEFAULT, 8, 5), (REFERENCE, DEFAULT, 8, 5)
    rows = []
    for name, found in figures['groups'].items():
        row, impulse = found[str(DEFAULT)], found[str(REFERENCE)]['peak impulse'][0]
        rows.append((
            name, spread(row['reward difference'], 3), spread(row['mean force difference'], 3),
            f'{impulse:.1f}, {spread(row["peak impulse difference"], 1)}',
            ', '.join(f'{found[str(n)]["random limit violation"]:.2f}' for n in limits),
            ', '.join(f'{1e3 * found[str(n)]["random penetration"]:.0f}' for n in depths),
        ))  # fmt: skip
    header = (
        'character, actuation', 'reward', 'mean force', 'peak impulse',
        f'beyond limits, rad: {", ".join(map(rate, limits))}',
        f'depth, mm: {", ".join(map(rate, depths))}',
    )  # fmt: skip
    return tables.markdown_table(header, rows)


def cost_table(figures):
    rows = []
    for title, name in (('physics alone', 'physics us'),
                        ('whole step of a single environment', 'step us')):  # fmt: skip
        ratios = [
            [found[str(n)][name] / found[str(DEFAULT)][name] for n in figures['rates']]
            for found in figures['groups'].values()
        ]
        rows.append((title, *(f'{ratio:.2f}' for ratio in np.median(ratios, axis=0))))
    return tables.markdown_table(('', *map(rate, figures['rates'])), rows)


def solver_table(figures):
    rows = []
    for name in SOLVERS:
        cases = [
            (found[name], found['as it is']['physics us']) for found in figures['solvers'].values()
        ]
        shares = [row['diverged share'] for row, _ in cases]
        times = [row['physics us'] / default for row, default in cases]
        rows.append((
            name,
            *(f'{1e3 * max(row[key][0] for row, _ in cases):.1f}'
              for key in ('joints 0.1 s', 'joints 0.1 s, from 1/3000 s')),
            f'{np.count_nonzero(shares)} of {len(shares)}', tables.share(np.mean(shares), len(shares) * (figures['random episodes'] // 2)),
            f'{min(times):.2f} to {max(times):.2f}',
        ))  # fmt: skip
    header = (
        'setting', 'joint angles after 0.1 s change by, mrad', 'they deviate from 1/3000 s by, mrad',
        'cases with divergence', 'diverged episodes', 'physics time',
    )  # fmt: skip
    return tables.markdown_table(header, rows)


def blocks(figures):
    """Returns the parts of the page that have figures, by their names."""
    starts, episodes = figures['starts'], figures['random episodes']
    return {
        'deviations': f'{starts} starts (seeds 0 to {starts - 1}):\n\n{deviation_table(figures)}',
        'measures': f'{starts} starts, {episodes} random episodes:\n\n{measure_table(figures)}',
        'costs': cost_table(figures),
        'solvers': f'{len(figures["solvers"])} cases, {starts} starts, {episodes // 2} random '
        f'episodes; the largest of the cases, and the range of the time:\n\n{solver_table(figures)}',
    }


def rounded(value):
    if isinstance(value, dict):
        return {name: rounded(part) for name, part in value.items()}
    if isinstance(value, list | tuple):
        return [rounded(part) for part in value]
    return float(f'{value:.4g}') if isinstance(value, float) else value


def plot(figures, file):
    import matplotlib

    matplotlib.use('Agg')
    from matplotlib import pyplot

    panels = {
        'joints 0.1 s / perturbed': 'joint angles after 0.1 s: deviation from 1/3000 s\n'
        'over that of 0.01 rad of noise at the start',
        'reward difference': 'reward of the first 0.3 s, size of the\ndifference from 1/3000 s',
        'mean force difference': 'mean vertical contact force, size of the\n'
        'difference from 1/3000 s, over weight',
        'random limit violation': 'joints beyond their limits under random\n'
        'actions, 99th percentile, rad',
        'random penetration': 'penetration under random actions,\n99th percentile, m',
        'physics us': 'CPU time of the physics of a control step,\n\N{MICRO SIGN}s',
    }
    colours = {'position': 'C0', 'velocity': 'C3', 'torque': 'C1', 'muscle': 'C2'}
    markers = {'biped2d': 'o', 'biped2d_full': 's', 'dog': '^', 'raptor': 'v'}
    rates = figures['rates']
    steps = [1e3 / CONTROL_RATE / n for n in rates]  # ms
    figure, axes = pyplot.subplots(2, 3, figsize=(14, 8.5), sharex=True)
    for (name, title), axis in zip(panels.items(), axes.flat, strict=True):
        for group_name, rows in figures['groups'].items():
            character, model = group_name.split(',')[0].split()
            values = np.array([np.ravel(rows[str(n)][name])[0] for n in rates])
            axis.plot(
                steps, np.where(np.abs(values) > 1e-5, np.abs(values), np.nan),
                marker=markers[character], ms=4, lw=1, color=colours[model], ls='--' if ',' in group_name else '-', label=group_name,
            )  # fmt: skip
        if name in figures['accepted']:
            axis.axhline(figures['accepted'][name], color='black', lw=0.8, ls=':')
        axis.axvline(1e3 / CONTROL_RATE / DEFAULT, color='grey', lw=0.8)
        axis.set_title(title, fontsize=10)
        axis.set_xscale('log')
        axis.set_yscale('log')
        axis.set_xticks(steps, list(map(rate, rates)), fontsize=8, rotation=60)
        axis.minorticks_off()
        axis.grid(alpha=0.3)
    for axis in axes[1]:
        axis.set_xlabel('physics step, s')
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc='lower center', ncols=5, fontsize=8, frameon=False)
    figure.suptitle('Physics rate; grey: the default, dotted: what is accepted')
    figure.tight_layout(rect=(0, 0.1, 1, 1))
    with files.replacing(file) as part:
        figure.savefig(part, dpi=90)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--quick', action='store_true', help='few starts, as a test of the program')
    parser.add_argument('--json', type=pathlib.Path, help='write the figures to this file')
    parser.add_argument('--plot', type=pathlib.Path, help='plot the figures to this file')
    parser.add_argument(
        '--page', type=pathlib.Path, help='only write the tables of --json into this page'
    )
    arguments = parser.parse_args()
    if arguments.page:
        if arguments.json is None:
            parser.error('--page needs --json')
        for name, text in blocks(files.read_json(arguments.json)).items():
            files.replace_between(arguments.page, name, 'benchmarks/physics_rate.py', text)
        return
    if arguments.plot:
        files.check_path(arguments.plot, ('.png', '.svg'))
    starts, episodes = (3, 2) if arguments.quick else (STARTS, RANDOM_EPISODES)
    figures = {
        'mujoco': mujoco.__version__, 'rates': RATES, 'starts': starts,
        'random episodes': episodes, 'accepted': ACCEPTED, 'groups': {}, 'solvers': {},
    }  # fmt: skip
    for name, id_ in GROUPS.items():
        begin = time.perf_counter()
        rows = figures['groups'][name] = group(id_, RATES, starts, episodes)
        rows['chosen'] = chosen(rows, RATES)
        print(f'{name}: {time.perf_counter() - begin:.0f} s', flush=True)
    for name in SOLVER_GROUPS:
        figures['solvers'][name] = solvers(GROUPS[name], starts, episodes // 2)
    report(figures)
    if arguments.json:
        files.write_json(rounded(figures), arguments.json, indent=None)
    if arguments.plot:
        plot(figures, arguments.plot)


if __name__ == '__main__':
    begin_script()
    main()
