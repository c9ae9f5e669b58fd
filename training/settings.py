"""The settings with which `ppo.py` trains each environment, including curriculum stages.

`Settings` documents them, and `OVERRIDES` is the table of differences from its defaults.
"""

from __future__ import annotations

import dataclasses
import fnmatch
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from evaluate_footsteps import BELTS, bumps, ramp

from trl_suite import terrain

CLOSER = 2 / 3  # times the spacing of obstacles
LARGER = 1.1  # times the size of the largest obstacles
Stages = tuple[tuple[float, Any], ...]  # see `Settings.stages`
Row = tuple[str, dict[str, Any]]


@dataclasses.dataclass(frozen=True)
class Settings:
    """Settings of a run, besides environment and seed."""

    samples: float = 1e6  # control steps in total, of all simulations
    num_envs: int = 64
    horizon: int = 32  # control steps of each simulation between two updates
    epochs: int = 5
    minibatch: int = 512
    learning_rate: float = 3e-4
    last_learning_rate: float = 5e-5  # reached by a linear decrease
    gamma: float = 0.95  # a time constant of 0.67 s at 30 Hz
    lambda_: float = 0.95
    clip: float = 0.2
    kl_per_action: float = 0.004  # an update stops at this divergence, times the number of actions
    value_goes_on: bool = False  # whether the value network is trained after an update has stopped
    hidden: tuple[int, ...] = (256, 256)
    activation: str = 'tanh'  # of all layers but the last, one of `networks.ACTIVATIONS`
    # Convolutions over the maps of the ground, with `map_bound`: filters, width and stride of each.
    convolutions: tuple[tuple[int, int, int], ...] = ()
    initial_std: float = 0.2  # of actions in [-1, 1]
    bound_cost: float = 0.1  # coefficient of the squared excess of a mean action over 1
    gradient_norm: float = 0.5
    # Evaluated and shipped policies have an exponential moving average of the weights over about
    # this number of samples (Polyak averaging); 0: the current weights.
    averaged: float = 0.0
    # The final policy has the mean weights at the ends of this number of last curriculum stages
    # (stochastic weight averaging, Izmailov et al. 2018, arXiv:1803.05407), which combines the
    # skills that different stages emphasise.
    stages_averaged: int = 1
    # Lower bounds of reward terms, as shares of their maxima: in training an episode also ends when
    # a term, smoothed over `patience` seconds, falls below its bound. For fast gaits, where
    # standing still is a local optimum. Not used in evaluations.
    least_share: dict[str, float] = dataclasses.field(default_factory=dict)
    patience: float = 0.3
    # Costs of the tracking errors in `info`, such as `landing_error`, per m or rad: in training they
    # are subtracted from the reward of the control step in which a foot lands.
    landing_costs: dict[str, float] = dataclasses.field(default_factory=dict)
    # Mirror observations and actions in left stance; for walkers in three dimensions.
    mirrored: bool = False
    # Part of a terrain map that is an input: distance ahead and to each side, m; None: all.
    view: tuple[float, float] | None = None
    # Bound at which maps are clipped, and by which they are divided, m or m/s; 0: scaled by their
    # standard deviation. With a bound a step of 0.15 m remains visible among hills of 5 m.
    map_bound: float = 0.0
    # Observation blocks that begin with bearing and distance of a point, whose Cartesian
    # coordinates are added to the inputs (see `trl_suite.policies.placed`).
    places: tuple[str, ...] = ()
    # Curriculum stages: the share of the samples at which each begins, and its task options,
    # including `terrain`; or a tuple of options, with which as many simulations each run at the
    # same time. Evaluations use the options of the environment, or `evaluated_with`.
    stages: tuple[tuple[float, Any], ...] = ()
    # Mean length of episodes, in control steps, with which the next stage begins; 0: it begins at its
    # share of the samples.
    stage_length: float = 0.0
    # Start from the shipped policy of this environment, as PLAiD does (Berseth et al. 2018), with
    # its weights, scales and noise; the weights of inputs that it does not have are 0. Or from one
    # of `ppo.TEACHERS`, which is imitated for `cloned` control steps.
    start: str = ''
    # Sample count of the scales of the initial policy. With a small count they adapt quickly to the
    # new environment, but the initial weights may then no longer fit the scales.
    start_count: float = 2e4
    start_std: float | None = None  # noise of the initial policy; None: its own
    cloned: float = 1e4
    # Rounds of imitation. After the first round the policy selects the actions, and the teacher
    # only labels the observations (DAgger, Ross et al. 2011, arXiv:1011.0686).
    clonings: int = 1
    # Whether a further run imitates, too; its initial policy selects the actions from the first round.
    imitates_again: bool = False
    cloning_epochs: int = 30  # of each round, over all labels so far
    cloning_rate: float = 1e-3  # learning rate of the first epoch of each round
    last_cloning_rate: float = 1e-3  # reached by a linear decrease
    # First control steps after `start`, in which only the value is trained, and the learning rate
    # in them; None: the same as later. A value network that starts from random weights needs a
    # high rate, a good policy a low one.
    value_first: float = 2e4
    value_rate: float | None = None
    # Changes of these settings in further runs, each of which starts from the policy of the one
    # before. The samples of these runs are those of the changes.
    further: tuple[dict[str, Any], ...] = ()
    # The final policy has the mean weights of the policies of this number of last runs.
    runs_averaged: int = 1
    step_limit: int = 0  # of episodes in training; 0: that of the environment
    enough: float = np.inf  # end when two evaluations in a row reach this share of the maximum
    evaluate_every: float = 1e5  # control steps
    evaluation_episodes: int = 32
    evaluated_with: dict[str, Any] = dataclasses.field(default_factory=dict)  # task options


# Terrain of curriculum stages.


def evenly(stages: Iterable[dict[str, Any]]) -> Stages:
    """Returns curriculum stages of equal length."""
    listed = list(stages)
    return tuple((i / len(listed), options) for i, options in enumerate(listed))


def joined(*parts: Stages) -> Stages:
    """Returns stages one after the other, of equal length; only the last part keeps its last one."""
    *first, last = parts
    return evenly(options for part in (*(p[:-1] for p in first), last) for _, options in part)


def rising(preset: str, low: dict[str, float], heights: Sequence[float]) -> Stages:
    """Returns stages of equal length on terrain that approaches a preset, which is the last.

    Args:
      preset: name of the terrain.
      low: parameters that differ at terrain level 0.
      heights: terrain levels of the stages, from 0 to less than 1, which is the preset.
    """
    full = dict(terrain.load(preset).parameter_sets[0])
    ground = ground_of(preset, {**full, **low}, full)
    return evenly([*({'terrain': ground, 'terrain_level': height} for height in heights), {}])


def ground_of(preset: str, *parameters: dict[str, float], walls: bool = False) -> dict[str, Any]:
    """Returns terrain of a preset's type; with `walls` that of a mixed one without gaps and steps."""
    type_ = terrain.load(preset).type
    if walls:
        type_ = type_.replace('mixed', 'walls')
        parameters = tuple(
            {name: value for name, value in each.items() if not name.startswith(('Gap', 'Step'))}
            for each in parameters
        )
    return {'Type': type_, 'Params': list(parameters)}


def crowded(preset: str) -> Stages:
    """Returns stages on closer walls, on closer obstacles of a mixed preset, and on the preset."""
    near = {
        name: CLOSER * value if 'Spacing' in name else value
        for name, value in terrain.load(preset).parameter_sets[0].items()
    }
    grounds = (ground_of(preset, near, walls=walls) for walls in (True, False))
    return evenly([*({'terrain': ground} for ground in grounds), {}])


def with_walls(preset: str) -> Stages:
    """Returns a stage in which half of the simulations have only the walls of a mixed preset."""
    ground = ground_of(preset, dict(terrain.load(preset).parameter_sets[0]), walls=True)
    return ((0.0, ({}, {'terrain': ground})),)


def with_larger(preset: str) -> Stages:
    """Returns a stage in which half of the simulations have larger obstacles than a preset's.

    Their sizes are from the middle of the preset's range to a tenth more than its largest.
    """
    values = dict(terrain.load(preset).parameter_sets[0])
    for size in ('GapW', 'WallH', 'StepH0', 'StepH1'):
        bounds = f'{size}Min', f'{size}Max'
        if bounds[0] in values:
            small, large = sorted((values[bound] for bound in bounds), key=abs)
            between = sorted(((small + large) / 2, LARGER * large))
            values |= dict(zip(bounds, between, strict=True))
    return ((0.0, ({}, {'terrain': ground_of(preset, values)})),)


# Footsteps.


def pushes(least: float, largest: float, *interval: float) -> dict[str, tuple[float, ...]]:
    return {'force': (least, largest), 'duration': (0.2, 0.2), 'interval': interval or (2.0, 4.0)}


VARIED = {'length': (0.25, 0.7), 'width': (0.1, 0.25), 'change': 1.0, 'turn': 0.3, 'from_root': 0.3}
TO_REST = {**VARIED, 'length': (0.0, 0.7), 'root_length': (0.0, 0.7), 'change': 0.2}
# An even walk first, then all step lengths and widths and plans like those of a high-level
# controller, then sharp turns and pushes. The reward weighs accuracy more than in evaluations, and a
# large landing error ends the episode, because samples far behind the plan are not useful. In the
# next stages it does not, and the walker may leave the plan to keep its balance after a push. Then it
# has to return to the plan, with a reward that extends far enough for that, and to be accurate again.
# Later a large landing error ends the episode except in the two seconds after a push or a sharp turn;
# otherwise the walker drifts off the plan. The last stages contain stopping and turning about, which
# high-level controllers need.
COLUMNS = 'footstep_scale', 'heading_scale', 'max_landing_error', 'grace_period', 'plans', 'pushes'
WALKER = 37e6  # samples
STAGES: Stages = tuple(
    (begin / WALKER, {n: v for n, v in zip(COLUMNS, values, strict=True) if v is not None})
    for begin, *values in (
        (0.0, 3.0, 2.0, 0.5, None, {'length': (0.4, 0.6), 'sharp': 0.0}, None),
        (0.9e6, 5.0, 3.0, 0.5, None, {**VARIED, 'sharp': 0.03}, None),
        (2.1e6, 10.0, 3.0, 0.6, None, {**VARIED, 'sharp': 0.1}, pushes(50, 180, 1.5, 4)),
        (6e6, 8.0, 5.0, None, None, {**VARIED, 'sharp': 0.1}, pushes(80, 220, 1, 3)),
        (9e6, 3.0, 5.0, 0.8, None, {**VARIED, 'sharp': 0.05}, pushes(80, 200, 1.5, 4)),
        (10e6, 8.0, 5.0, 0.6, None, {**VARIED, 'sharp': 0.05}, pushes(80, 180, 1.5, 4)),
        (12e6, (1.5, 20.0), 5.0, None, None, {**VARIED, 'sharp': 0.1}, pushes(80, 200, 1.5, 4)),
        (15e6, 8.0, 3.0, None, None, {**VARIED, 'sharp': 0.1}, pushes(80, 200, 1.5, 4)),
        (18e6, 10.0, 4.0, 0.5, 2.0, {**VARIED, 'change': 0.5, 'sharp': 0.1}, pushes(80, 180, 2.5, 5)),
        (19.3e6, 15.0, 4.0, 0.35, 1.5, {**VARIED, 'change': 0.5, 'sharp': 0.06}, pushes(80, 180, 3, 8)),
        (21e6, 15.0, 3.0, 0.5, 2.5, {**VARIED, 'change': 0.3, 'sharp': 0.06}, pushes(100, 180, 2.5, 5)),
        (23e6, 20.0, 3.0, 0.35, 2.5, {**VARIED, 'change': 0.5, 'sharp': 0.06}, pushes(100, 180, 2.5, 5)),
        (25e6, 20.0, 3.0, 0.3, 2.5, {**VARIED, 'change': 0.2, 'sharp': 0.06}, pushes(100, 180, 3, 6)),
        (27e6, 20.0, 3.0, 0.35, 2.5, {**TO_REST, 'sharp': 0.06}, pushes(100, 180, 3, 6)),
        (33e6, 20.0, 3.0, 0.35, 2.5, {**TO_REST, 'sharp': 0.08, 'from_root': 0.5, 'root_turn': 0.6},
         pushes(100, 180, 3, 6)),
    )
)  # fmt: skip

# After these stages everything at the same time, in equal numbers of simulations, with a cost of
# landing errors. What only few simulations contain is forgotten, so sharp turns and pushes are part
# of most conditions.
FREE = {**VARIED, 'length': (0.2, 0.75), 'turn': 0.2, 'sharp': 0.1}
BY_ROOT = {**FREE, 'from_root': 1.0, 'root_length': (0.0, 0.7)}
PLACES = {'plans': {'sharp': 0.05}, 'pushes': pushes(60, 160)}
CONDITIONS: tuple[dict[str, Any], ...] = (
    {'plans': {'sharp': 0.15}, 'pushes': pushes(80, 180)},
    {'plans': {'sharp': 0.2}},
    {'plans': FREE, 'pushes': pushes(100, 200)},
    {'plans': {**FREE, 'change': 0.0}, 'pushes': pushes(80, 180)},
    {'plans': BY_ROOT, 'pushes': pushes(60, 160)},
    {'plans': {**BY_ROOT, 'root_length': (0.0, 0.1), 'root_turn': 0.6}},
    {'plans': {'sharp': 0.03}, 'pushes': pushes(140, 260)},
    {'plans': {'sharp': 0.03}, 'pushes': pushes(60, 160), 'terrain': BELTS},
    {**PLACES, 'terrain': ramp(0.08)},
    {**PLACES, 'terrain': bumps(0.06)},
)
EVEN = {'plans': {'length': (0.25, 0.75), 'change': 0.0, 'turn': 0.0, 'sharp': 0.02}}


def together(conditions: Iterable[dict[str, Any]], **options: Any) -> Stages:
    """Returns a stage with all conditions at the same time, and further options in all of them."""
    common = {'max_landing_error': 0.6, 'grace_period': 2.5, **options}
    return ((0.0, tuple({**common, **own} for own in conditions)),)


# Parts of rows of the table below, differences from the defaults of `Settings`.
RUNS = {'least_share': {'com': 0.37}}  # a speed error of about 1 m/s
RUNS_UNEVENLY = {'least_share': {'com': 0.2}}
ENOUGH = {'enough': 0.95}
ACCURATELY = {
    'samples': 8e6, 'num_envs': 260, 'minibatch': 1024, 'learning_rate': 1.5e-4,
    'last_learning_rate': 2e-5, 'start_count': 1e9, 'value_first': 3e5, 'value_rate': 1e-3,
    'value_goes_on': True, 'stages_averaged': 1, 'evaluate_every': 4e5,
    'landing_costs': {'landing_error': 20.0, 'heading_error': 5.0},
    'stages': together(CONDITIONS, footstep_scale=5.0, heading_scale=2.0),
}  # fmt: skip
MORE_ACCURATELY = {
    **ACCURATELY, 'samples': 6e6, 'num_envs': 264, 'gamma': 0.98,
    'landing_costs': {'landing_error': 30.0, 'heading_error': 6.0},
    'stages': together(
        (*CONDITIONS[:4], EVEN, *CONDITIONS[4:]), footstep_scale=15.0, heading_scale=3.0
    ),
}  # fmt: skip
# After stronger pushes a landing error is no failure; more simulations turn about and stand on belts.
STRONG = {'pushes': pushes(140, 270), 'max_landing_error': 1.5}
MORE_STABLY = {
    **MORE_ACCURATELY, 'samples': 8e6, 'num_envs': 300,
    'landing_costs': {'landing_error': 25.0, 'heading_error': 6.0},
    'stages': together(
        (
            *CONDITIONS[:4], EVEN, *CONDITIONS[4:6],
            {'plans': {**BY_ROOT, 'root_turn': 0.6}, 'pushes': pushes(60, 160)},
            {**STRONG, 'plans': {'sharp': 0.03}}, {**STRONG, 'plans': FREE},
            {**STRONG, 'plans': {'sharp': 0.05}, 'pushes': pushes(100, 250)},
            *CONDITIONS[7:], {'plans': {'sharp': 0.03}, 'terrain': BELTS},
        ),
        footstep_scale=15.0, heading_scale=3.0,
    ),
}  # fmt: skip
FOOTSTEPS = {'samples': WALKER, 'gamma': 0.97, 'stages': STAGES, 'averaged': 5e5}
SHORTER = {'samples': 2e6, 'stages': evenly([options for _, options in STAGES[:3]])}
STEPS_ON = {  # other terrains and plans; low learning rates, to avoid forgetting
    'samples': 1e6, 'start': 'PD_Biped3D_LLC_General_Step-v0',
    'stages': ((0.0, {'footstep_scale': 5.0, 'heading_scale': 3.0, 'max_landing_error': 0.6}),),
    'start_count': 1e7, 'value_first': 1e5, 'learning_rate': 1e-4, 'last_learning_rate': 2e-5,
}  # fmt: skip
# Styles: mostly without disturbances, in which a policy that survives has no reason to change.
STYLED = {
    'samples': 1.5e6, 'averaged': 1e5, 'start': 'PD_Biped3D_LLC_General_Step-v0', 'start_std': 0.12,
    'value_first': 6e4, 'last_learning_rate': 3e-5,
    'landing_costs': {'landing_error': 8.0, 'heading_error': 2.0},
    'stages': together(
        (
            {'plans': {'sharp': 0.02}}, {'plans': {**FREE, 'sharp': 0.02}}, EVEN,
            {'plans': {**BY_ROOT, 'sharp': 0.0}}, {'plans': {**BY_ROOT, 'root_turn': 0.6}},
            {'plans': {'sharp': 0.1}}, PLACES, {'plans': FREE, 'pushes': pushes(60, 160)},
        ),
        footstep_scale=5.0, heading_scale=2.0,
    ),
}  # fmt: skip
# With more pushes, when the style is there.
STEADIER = ({
    'samples': 3e6, 'num_envs': 128, 'start_count': 1e9, 'value_first': 1e5, 'learning_rate': 2e-4,
    'last_learning_rate': 2e-5, 'evaluate_every': 3e5,
    'stages': together(
        (
            {'plans': {'sharp': 0.1}, 'pushes': pushes(80, 180)},
            {'plans': {**FREE, 'sharp': 0.02}, 'pushes': pushes(100, 200)},
            {**EVEN, 'pushes': pushes(100, 180)}, {'plans': {**BY_ROOT, 'root_turn': 0.6}},
            {'plans': {'sharp': 0.1}}, PLACES, {'plans': BY_ROOT, 'pushes': pushes(60, 160)},
            {'plans': FREE, 'pushes': pushes(140, 160)},
        ),
        footstep_scale=5.0, heading_scale=2.0,
    ),
},)  # fmt: skip
# With plans that go on from where a foot landed, a walker that is pushed may step wherever it keeps its
# balance; what it lands beside the plan counts once, and is no failure.
REACT = {'react': 1.0}
FREELY, BY_ROOT_FREELY = {**FREE, **REACT}, {**BY_ROOT, **REACT}
HARDER = {
    'samples': 3e6, 'num_envs': 300, 'minibatch': 1024, 'gamma': 0.98, 'averaged': 2e5,
    'start_count': 1e9, 'start_std': 0.12, 'value_first': 2e5, 'value_rate': 1e-3,
    'value_goes_on': True, 'learning_rate': 2e-4, 'last_learning_rate': 2e-5, 'evaluate_every': 4e5,
    'stages': together(
        (
            {'plans': {'sharp': 0.03, **REACT}, 'pushes': pushes(140, 270)},
            {'plans': {'sharp': 0.0, **REACT}, 'pushes': pushes(200, 300, 2.5, 4)},
            {'plans': FREELY, 'pushes': pushes(100, 250)},
            {'plans': {'sharp': 0.0}, 'pushes': pushes(140, 200)},
            {'plans': BY_ROOT_FREELY, 'pushes': pushes(100, 250)},
            {'plans': {**EVEN['plans'], **REACT}, 'pushes': pushes(140, 250)},
            {'plans': {'sharp': 0.1}},
            {'plans': {**BY_ROOT, 'root_turn': 0.6}, 'pushes': pushes(60, 160)},
            {'plans': FREE, 'pushes': pushes(100, 200)},
            {'plans': {'sharp': 0.03}, 'pushes': pushes(60, 160)},
        ),
        footstep_scale=5.0, heading_scale=2.0, max_landing_error=3.0,
    ),
}  # fmt: skip
PUSHED = {
    **ACCURATELY, **HARDER, 'start': 'PD_Biped3D_LLC_General_Step-v0',
    'landing_costs': {'landing_error': 10.0, 'heading_error': 3.0},
    'evaluated_with': {
        'plans': {'sharp': 0.0, **REACT},
        'pushes': {'force': (250, 250), 'duration': (0.2, 0.2), 'interval': (3, 3)},
    },
    'stages': together(
        (
            {'plans': {'sharp': 0.03, **REACT}, 'pushes': pushes(140, 270)},
            {'plans': {'sharp': 0.0, **REACT}, 'pushes': pushes(200, 300, 2.5, 4)},
            {'plans': FREELY, 'pushes': pushes(100, 250)},
            {'plans': {'sharp': 0.0, **REACT}, 'pushes': pushes(230, 260, 2.5, 3.5)},
            {'plans': BY_ROOT_FREELY, 'pushes': pushes(100, 250)},
            {'plans': {**EVEN['plans'], **REACT}, 'pushes': pushes(150, 270)},
            {'plans': {'sharp': 0.1, **REACT}},
            {'plans': {**BY_ROOT_FREELY, 'root_turn': 0.6}, 'pushes': pushes(60, 200)},
            {'plans': {'sharp': 0.05, **REACT}, 'pushes': pushes(60, 160), 'terrain': bumps(0.05)},
            {'plans': {'sharp': 0.1, **REACT}, 'pushes': pushes(100, 200)},
        ),
        footstep_scale=5.0, heading_scale=2.0, max_landing_error=3.0,
    ),
}  # fmt: skip
# Left and right differ: the nominal policy, which mirrors, is imitated first by one that does not.
ONE_SIDED = {
    **STYLED, 'mirrored': False, 'samples': 4e6, 'start': 'nominal', 'start_std': None, 'initial_std': 0.12,
    'cloned': 6e5, 'clonings': 4, 'cloning_epochs': 8, 'last_cloning_rate': 5e-5, 'value_first': 8e5,
    'further': STEADIER,
}  # fmt: skip
SHORT = {'length': (0.0, 0.1), 'change': 1.0, 'turn': 0.2}
BY_ROOT_SHORT = {**BY_ROOT, 'root_length': (0.0, 0.1), 'root_turn': 0.6}
IN_PLACE = {
    **STYLED,
    'stages': together(
        (
            {'plans': {**SHORT, 'sharp': 0.05}},
            {'plans': {**SHORT, 'sharp': 0.1}, 'pushes': pushes(60, 160)},
            {'plans': BY_ROOT_SHORT},
            {'plans': {**SHORT, 'change': 0.0, 'turn': 0.0, 'sharp': 0.0}},
        ),
        footstep_scale=10.0, heading_scale=2.0,
    ),
    'further': ({
        **STEADIER[0], 'samples': 2e6,
        'stages': together(
            (
                {'plans': {**SHORT, 'sharp': 0.05}, 'pushes': pushes(80, 180)},
                {'plans': {**SHORT, 'sharp': 0.0}, 'pushes': pushes(100, 200)},
                {'plans': {**SHORT, 'change': 0.0, 'turn': 0.0, 'sharp': 0.0}, 'pushes': pushes(140, 160)},
                {'plans': {**SHORT, 'sharp': 0.1}}, {'plans': BY_ROOT_SHORT},
                {'plans': BY_ROOT_SHORT, 'pushes': pushes(60, 160)},
                {'plans': {**SHORT, 'sharp': 0.02}, 'pushes': pushes(60, 160)},
                {'plans': {**SHORT, 'sharp': 0.02}, 'terrain': bumps(0.04)},
            ),
            footstep_scale=8.0, heading_scale=2.0,
        ),
    },),
}  # fmt: skip
STANDING = {
    **STYLED, 'samples': 3e6, 'landing_costs': {'landing_error': 15.0, 'heading_error': 4.0},
    'stages': together(
        (
            {'plans': {'sharp': 0.1, 'stop': 0.05}}, {'plans': {**FREE, 'stop': 0.1}},
            {'plans': {'stop': 0.3, 'stay': (4, 80)}}, {'plans': {**BY_ROOT, 'stop': 0.1}},
            {'plans': {**BY_ROOT, 'root_turn': 0.6, 'stop': 0.2}},
            {'plans': {'stop': 0.2}, 'pushes': pushes(60, 160)},
            {'plans': {'stop': 0.3}, 'pushes': pushes(60, 120), 'terrain': ramp(0.08)},
            {'plans': {**FREE, 'stop': 0.1}, 'pushes': pushes(100, 200)},
        ),
        footstep_scale=10.0, heading_scale=2.0,
    ),
    'further': ({  # with more disturbances, when the style is there
        'samples': 4e6, 'num_envs': 260, 'minibatch': 1024, 'start_count': 1e9, 'value_first': 1e5,
        'learning_rate': 1.5e-4, 'last_learning_rate': 2e-5, 'evaluate_every': 4e5,
        'landing_costs': {'landing_error': 20.0, 'heading_error': 5.0},
        'stages': together(
            (
                {'plans': {'sharp': 0.15, 'stop': 0.05}, 'pushes': pushes(80, 180)},
                {'plans': {'sharp': 0.2}}, {**STRONG, 'plans': {'sharp': 0.03, 'stop': 0.1}},
                {'plans': {**FREE, 'stop': 0.1}, 'pushes': pushes(100, 200)},
                {'plans': {'stop': 0.3, 'stay': (4, 80)}, 'pushes': pushes(60, 160)},
                {'plans': {'stop': 0.3}, 'pushes': pushes(60, 160), 'terrain': ramp(0.08)},
                {'plans': {**BY_ROOT, 'stop': 0.1}, 'pushes': pushes(60, 160)},
                {'plans': {**BY_ROOT, 'root_turn': 0.6, 'stop': 0.2}},
                {'plans': {'sharp': 0.1, 'stop': 0.1}, 'pushes': pushes(60, 160), 'terrain': BELTS},
                {'plans': {'sharp': 0.05, 'stop': 0.1}, 'pushes': pushes(60, 160), 'terrain': bumps(0.06)},
            ),
            footstep_scale=10.0, heading_scale=2.0,
        ),
    },),
}  # fmt: skip
# Up and down the steps of a trail, in two runs. Those of the shipped policy started from the third run
# of the footstep controller, before it was averaged with the second.
ON_TRAILS = {
    **ACCURATELY, 'samples': 4e6, 'num_envs': 256, 'gamma': 0.98, 'averaged': 5e5,
    'start': 'PD_Biped3D_LLC_General_Step-v0',
    'landing_costs': {'landing_error': 10.0, 'heading_error': 3.0},
    'stages': ((0.0, {'footstep_scale': 3.0, 'heading_scale': 2.0, 'max_landing_error': 1.0}),),
    'further': ({},),
}  # fmt: skip
# In the plane: the environment's plan, then all lengths, with increasing accuracy. With the reward
# alone the biped would walk a quarter of a metre ahead of the plan, as the reference with its
# longer steps does.
PLANAR_PLANS = {'length': (0.25, 0.6), 'change': 1.0}
PLANAR_STEPS = {
    'gamma': 0.97, 'start': 'PD_Biped2D_Flat-v0',
    'stages': (
        (0.0, {'footstep_scale': 3.0, 'max_landing_error': 0.5}),
        (0.2, {'footstep_scale': 5.0, 'max_landing_error': 0.3, 'plans': PLANAR_PLANS}),
        (0.45, {'footstep_scale': 10.0, 'max_landing_error': 0.2, 'plans': PLANAR_PLANS}),
    ),
}  # fmt: skip
# Running: the environment's plan first, then other lengths and gentle turns, then plans from the root.
RUN_PLANS = {'length': (1.0, 1.25), 'width': (0.1, 0.2), 'change': 1.0, 'sharp': 0.0}
RUN_FAR = {'heading_scale': 2.0, 'max_landing_error': 0.8}
RUN_STEPS = {
    **FOOTSTEPS, 'samples': 5e6,
    'stages': (
        (0.0, {'footstep_scale': 2.0, **RUN_FAR}),
        (0.25, {'footstep_scale': 4.0, **RUN_FAR, 'plans': {**RUN_PLANS, 'turn': 0.15}}),
        (0.5, {'footstep_scale': 4.0, **RUN_FAR, 'plans': {
            **RUN_PLANS, 'length': (0.8, 1.3), 'turn': 0.25, 'from_root': 0.3,
            'root_length': (0.8, 1.3), 'root_width': (0.08, 0.25), 'root_turn': 0.25,
        }}),
    ),
}  # fmt: skip
PLANS = {  # a step is a whole footstep, so there are few samples
    'samples': 4e5, 'num_envs': 128, 'horizon': 16, 'learning_rate': 2e-4,
    'kl_per_action': 0.01, 'initial_std': 0.12, 'view': (6.0, 3.0), 'places': ('goal',),
    'start': 'scripted', 'evaluate_every': 4e4, 'evaluation_episodes': 16,
}  # fmt: skip
# Imitation of an expert with a map, by DAgger; then PPO, whose updates stop after a few steps, too few
# to train the value network.
GUIDED = {
    'samples': 2e5, 'start': 'expert', 'cloned': 1.2e5, 'clonings': 6, 'value_first': 1.4e5,
    'value_goes_on': True, 'learning_rate': 1e-4, 'map_bound': 0.3, 'averaged': 2e4,
    'evaluate_every': 2e4, 'evaluation_episodes': 32,
}  # fmt: skip
# With more data and a larger network imitation alone comes close to its expert.
AMONG_BLOCKS = {
    **GUIDED, 'hidden': (512, 256), 'cloning_epochs': 20, 'samples': 3.6e5, 'cloned': 3.6e5,
    'evaluation_episodes': 64,
}  # fmt: skip
AMONG_PILLARS = {**AMONG_BLOCKS, 'samples': 3e5, 'cloned': 3e5, 'clonings': 5}
# Convolutions over the maps, ReLU and a falling learning rate follow the expert more closely.
SEEING = {
    **GUIDED, 'hidden': (256, 256), 'activation': 'relu',
    'convolutions': ((16, 3, 1), (32, 3, 2), (32, 3, 2)), 'clonings': 4, 'cloning_epochs': 8,
    'last_cloning_rate': 2e-5, 'averaged': 0.0,
}  # fmt: skip
ON_A_TRAIL = {**SEEING, 'samples': 2.4e5, 'cloned': 2.4e5}
AMONG_MOVING = {
    **SEEING, 'samples': 3.2e5, 'cloned': 3.2e5, 'map_bound': 1.0, 'view': (6.0, 3.6),
    'further': ({
        'samples': 1.6e5, 'cloned': 1.6e5, 'clonings': 2, 'imitates_again': True,
        'start_count': 1e9, 'cloning_rate': 3e-4,
    },),
}  # fmt: skip
ON_BELTS = {  # maps have velocities, m/s
    **GUIDED, 'map_bound': 1.0, 'cloning_epochs': 8, 'samples': 1.2e5, 'cloned': 6e4,
    'value_first': 8e4,
}  # fmt: skip
# On wide belts the scripted planner, which takes short steps on moving ground, falls less than the expert.
ON_WIDE_BELTS = {
    'start': 'scripted', 'samples': 2.6e5, 'cloned': 1e5, 'clonings': 5, 'last_cloning_rate': 1e-4,
    'value_first': 1.3e5, 'value_rate': 1e-3, 'gamma': 0.97, 'last_learning_rate': 3e-5,
    'evaluate_every': 4e4,
}  # fmt: skip
DRIBBLING = {
    'samples': 1e6, 'num_envs': 64, 'minibatch': 256, 'gamma': 0.97, 'kl_per_action': 0.006,
    'value_goes_on': True, 'averaged': 2e4, 'places': ('goal', 'ball'),
    # A goal so large that a kicked ball comes to rest in it, then smaller goals.
    'stages': evenly([*({'goal_reached': r} for r in (1.5, 1.0, 0.7)), {}]),
    'further': ({  # after the footstep controller was trained further
        'samples': 3.2e5, 'num_envs': 128, 'minibatch': 512, 'last_learning_rate': 3e-5,
        'stages': (), 'start_count': 1e6, 'value_first': 2e4, 'value_rate': 1e-3,
        'evaluate_every': 8e4,
    },),
}  # fmt: skip
# A policy trained on walls of 0.25 m falls at three of four walls of up to 0.4 m.
LOW = {'WallHMin': 0.1, 'WallHMax': 0.25, 'StepH0Max': 0.2, 'StepH1Min': -0.2}
HIGHER = rising('mixed_humanoid', LOW, (0.0, 0.3, 0.6))
# Few and varied obstacles: more simulations per update, and a longer time constant of the return.
RARE = {'num_envs': 256, 'minibatch': 1024, 'learning_rate': 2e-4, 'gamma': 0.97}
LONGER = {'averaged': 3e5, 'enough': np.inf}
LONG = {**LONGER, 'samples': 6e6, 'num_envs': 64, 'minibatch': 512}
# Training goes on with larger batches than before.
MORE = {**RARE, **LONGER, 'samples': 3e6, 'start_count': 1e6, 'value_first': 6e4}
# From a policy that is good already: its scales stay, and the value is learnt first.
AGAIN = {
    **MORE, 'last_learning_rate': 2e-5, 'start_count': 1e9,
    'value_first': 2e5, 'value_rate': 1e-3, 'value_goes_on': True,
}  # fmt: skip
MORE_WALLS = {**MORE, 'stages': with_walls('mixed_humanoid')}
MORE_WALLS_ON_SLOPES = {**MORE, 'stages': with_walls('slopes_mixed_humanoid')}
WALLS_AGAIN = {**AGAIN, 'samples': 2e6, 'stages': with_walls('mixed_humanoid')}
WALLS_ON_SLOPES_AGAIN = {**AGAIN, 'stages': with_walls('slopes_mixed_humanoid')}
LARGER_WALLS = {**AGAIN, 'samples': 1.5e6, 'stages': with_larger('walls_humanoid')}
LARGER_GAPS = with_larger('gaps_humanoid')
# With this discount a policy learns to step in place in front of a wall, unless that ends the episode.
NO_STEPS_IN_PLACE = {'gamma': 0.98, 'least_share': {'com': 0.25}, 'patience': 1.0}
WALKS_ON = {'start': 'PD_Biped3D_Imitate-v0', **ENOUGH}
# Tasks without hierarchy: PPO from the walk, for comparison (`compare.py`).
FROM_A_WALK = {
    'num_envs': 64, 'hidden': (256, 256), 'activation': 'tanh', 'convolutions': (), 'gamma': 0.97,
    'view': (6.0, 3.0), 'map_bound': 0.3, 'places': (), 'start': 'PD_Biped3D_Imitate-v0',
    'start_count': 1e6, 'value_goes_on': True, 'learning_rate': 2e-4, 'initial_std': 0.15,
    'step_limit': 0,
}  # fmt: skip
# The shipped ones imitate planned footsteps and the controller that tracks them, by DAgger in episodes
# of a minute, without PPO.
DIRECT = {
    'samples': 8e5, 'start': 'joint_expert', 'cloned': 8e5, 'clonings': 5, 'cloning_epochs': 6,
    'last_cloning_rate': 2e-5, 'num_envs': 128, 'step_limit': 1800, 'hidden': (512, 256),
    'activation': 'relu', 'convolutions': ((8, 5, 2), (16, 3, 2)), 'view': (6.0, 3.6),
    'map_bound': 0.3, 'places': ('goal',), 'initial_std': 0.08, 'gamma': 0.97, 'start_count': 1e6,
    'value_goes_on': True, 'learning_rate': 2e-4, 'evaluate_every': 2e5,
}  # fmt: skip
# More noise makes the biped fall after a few cycles, whose parameters are 28.
MORE_CYCLES: dict[str, Any] = {
    'samples': 1.8e6, 'num_envs': 128, 'learning_rate': 2e-4, 'initial_std': 0.07, 'start_std': 0.07,
    'start_count': 1e5,
}  # fmt: skip
# Distances rose while the updates became smaller.
SMALLER_CHANGES = {
    **MORE_CYCLES, 'samples': 1.6e6, 'learning_rate': 1.2e-4, 'last_learning_rate': 2e-5,
    'kl_per_action': 0.002, 'initial_std': 0.06, 'start_std': 0.06,
}  # fmt: skip
ROUGH = ('Hills', 'Ramp', 'Stairs', 'Steps', 'Rough')


def from_flat(name: str) -> tuple[Row, ...]:
    """Returns the rows of a character that goes from flat ground to all other terrains."""
    onto = {'samples': 0.6e6, 'start': f'PD_{name}_Flat_Terrain-v0', **ENOUGH}
    return (
        (f'PD_{name}_*_Terrain-v0', onto),
        (f'PD_{name}_Flat_Terrain-v0', {'samples': 0.2e6, 'start': f'PD_{name}_Flat-v0'}),
    )


# The table: pattern of ids -> differences from the defaults; later rows have precedence.
OVERRIDES: tuple[Row, ...] = (
    ('*', {'samples': 0.8e6}),
    ('*_Biped2D_*Flat-v0', {'samples': 0.5e6}),
    ('*_Run_*', {'samples': 1e6, **RUNS, **ENOUGH}),
    ('*_Raptor2D_*', RUNS),
    ('*_Dog2D_*', {'samples': 1.6e6, **RUNS}),
    ('PD_Dog2D_LLC_*', {'samples': 1.2e6}),
    ('PD_Dog2D_Flat-v0', {'samples': 0.8e6}),
    ('PD_Biped2D_*_Terrain-v0', {'samples': 2e6}),
    ('PD_Biped2D_Flat_Terrain-v0', {'samples': 0.8e6}),
    *((f'PD_{name}_[!F]*_Terrain-v0', RUNS_UNEVENLY) for name in ('Raptor2D', 'Dog2D')),
    ('PD_Biped2D_Incline-v0', {'start': 'PD_Biped2D_Flat-v0', **ENOUGH}),
    *from_flat('Dog2D'), *from_flat('Raptor2D'),
    ('PD_Biped2D_LLC_Flat_Step-v0', PLANAR_STEPS),
    # From one kind of obstacle to mixed terrain, and from there to mixed terrain on slopes.
    *(
        (f'PD_{name}_{to}_Terrain-v0', {'start': f'PD_{name}_{start}_Terrain-v0'})
        for name in ('Biped2D', 'Dog2D', 'Raptor2D')
        for to, start in (('Mixed', 'Walls'), ('Slopes_Mixed', 'Mixed'))
    ),
    ('PD_*2D_*Mixed_Terrain-v0', RARE),
    # Walls and gaps have to be met in every phase of the stride: returns rise for a long time.
    ('PD_Raptor2D_Walls_Terrain-v0', {**RARE, **LONGER, 'samples': 6e6}),
    ('PD_Raptor2D_Gaps_Terrain-v0', {**RARE, **LONGER, 'samples': 3e6}),
    ('PD_Dog2D_Gaps_Terrain-v0', {**LONGER, 'samples': 3e6}),
    # Walls alone make dog and raptor forget gaps.
    ('PD_*2D_Mixed_Terrain-v0', {**LONG, 'stages': joined(HIGHER, crowded('mixed_humanoid')[1:])}),
    ('PD_*2D_Slopes_Mixed_Terrain-v0',
     {**LONG, 'stages': joined(crowded('slopes_mixed_humanoid')[1:])}),
    # After these runs nine of ten falls of dog and raptor are at walls.
    ('PD_Dog2D_Mixed_Terrain-v0',
     {'further': (MORE_WALLS, WALLS_AGAIN, {**WALLS_AGAIN, 'samples': 3e6})}),
    ('PD_Raptor2D_Mixed_Terrain-v0',
     {'samples': 5e6, 'num_envs': 256, 'minibatch': 1024, 'stages': HIGHER, 'further': (MORE_WALLS,)}),
    ('PD_Dog2D_Slopes_Mixed_Terrain-v0',
     {**MORE_WALLS_ON_SLOPES, 'samples': 2e6,
      'further': ({**WALLS_ON_SLOPES_AGAIN, 'samples': 4e6}, WALLS_ON_SLOPES_AGAIN)}),
    ('PD_Raptor2D_Slopes_Mixed_Terrain-v0',
     {**MORE_WALLS_ON_SLOPES, 'samples': 4e6, 'further': ({**WALLS_ON_SLOPES_AGAIN, 'samples': 2e6},)}),
    ('PD_Raptor2D_Slopes_Terrain-v0', {'further': ({**MORE, 'samples': 2e6},)}),
    # After the runs before, falls are at the highest walls and the widest gaps.
    ('PD_Dog2D_Walls_Terrain-v0', {'further': (LARGER_WALLS,)}),
    ('PD_Biped2D_Walls_Terrain-v0', {'further': ({**LARGER_WALLS, 'gamma': 0.98},)}),
    ('PD_Dog2D_Gaps_Terrain-v0',
     {'further': ({**MORE, 'stages': LARGER_GAPS}, {**AGAIN, 'stages': LARGER_GAPS})}),
    ('PD_Raptor2D_Gaps_Terrain-v0', {'further': ({**AGAIN, 'stages': LARGER_GAPS},)}),
    ('PD_Biped2D_*Mixed_Terrain-v0', NO_STEPS_IN_PLACE),
    ('PD_Biped2D_Slopes_Mixed_Terrain-v0',
     {'further': (
         {**AGAIN, 'samples': 4e6, 'gamma': 0.98, 'stages': with_larger('slopes_mixed_humanoid')},
         {**WALLS_ON_SLOPES_AGAIN, 'gamma': 0.98},
     )}),
    ('PD_Biped2D_Mixed_Terrain-v0',
     {'samples': 8e6, 'stages': joined(HIGHER, crowded('mixed_humanoid')),
      'further': ({**AGAIN, 'samples': 2e6, 'gamma': 0.98, 'stages': ()},)}),
    ('MTU_Raptor2D_*', {'samples': 1.2e6}),
    ('MTU_Biped2D_*', {'samples': 1e6}),
    ('Vel_Biped2D_*', {'samples': 1e6}),
    # With the noise of the planar environments the 3D biped falls before it learns.
    ('*_Biped3D_*', {'initial_std': 0.15, 'mirrored': True, 'kl_per_action': 0.0045}),
    *((f'PD_Biped3D_Imitate-{name}-v0', WALKS_ON) for name in ROUGH),
    ('PD_Biped3D_Imitate-*_Terrain-v0', {**WALKS_ON, 'samples': 1.6e6, 'view': (2.5, 1.0)}),
    ('PD_Biped3D_Imitate-Run-v0', {'samples': 1.5e6, **RUNS, **ENOUGH}),
    ('PD_Biped3D_Imitate-Track-v0', {'mirrored': False}),  # it does not observe the phase
    ('*_Biped3D_*_Step*', FOOTSTEPS),
    ('PD_Biped3D_LLC_General_Step-v0',
     {'stages_averaged': 2, 'further': (ACCURATELY, MORE_ACCURATELY, MORE_STABLY), 'runs_averaged': 2}),
    ('PD_Biped3D_LLC_Run_FootStep-v0', RUN_STEPS),
    ('PD_Biped3D_LLC_Bumps_Step-v0', STEPS_ON),
    ('PD_Biped3D_LLC_Trail_Step-v0', ON_TRAILS),
    *((f'PD_Biped3D_LLC_{name}_Step-v0', {**STYLED, 'further': STEADIER})
      for name in ('HighKnees', 'StraightLegs', 'ForwardLean')),
    *((f'PD_Biped3D_LLC_{name}_Step-v0', ONE_SIDED) for name in ('OneStraightLeg', 'SidewaysLean')),
    *((f'PD_Biped3D_LLC_{name}_Step-v0', {'further': (*STEADIER, HARDER)}) for name in ('StraightLegs', 'SidewaysLean')),
    ('PD_Biped3D_LLC_InPlace_Step-v0', IN_PLACE),
    ('PD_Biped3D_LLC_Stand_Step-v0', STANDING),
    ('PD_Biped3D_LLC_React_Step-v0', PUSHED),
    # The environment mirrors its observation.
    ('PD_Biped3D_LLC_Symetric_Step-v0', {**SHORTER, 'mirrored': False}),
    ('PD_Biped3D_FULL_Imitate-Steps-v0', {**FOOTSTEPS, **SHORTER}),
    ('PD_Biped3D_Terrain_*_Hard-v0', DIRECT),
    ('PD_Biped3D_Terrain_Dynamic_Obs_Velocity_Hard-v0',  # bound in m and m/s; less data, for memory
     {'map_bound': 1.0, 'samples': 5e5, 'cloned': 5e5}),
    ('PD_Biped3D_Terrain_Soccer_Hard-v0',
     {'convolutions': (), 'view': None, 'map_bound': 0.0, 'places': ('goal', 'ball')}),
    ('PD_Biped3D_HLC_*', PLANS),
    ('PD_Biped3D_HLC_LargeBlocks-v0', AMONG_BLOCKS),
    ('PD_Biped3D_HLC_Forest-v0', AMONG_PILLARS),
    ('PD_Biped3D_HLC_DynamicsObstacles-v0', AMONG_MOVING),
    ('PD_Biped3D_HLC_Conveyors*', ON_BELTS),
    ('PD_Biped3D_HLC_Conveyors_Wide-v0', ON_WIDE_BELTS),
    ('PD_Biped3D_HLC_PathFollowing*', GUIDED),
    ('PD_Biped3D_HLC_PathFollowing-v0', ON_A_TRAIL),
    ('PD_Biped3D_HLC_Soccer-v0', DRIBBLING),
    ('FSM_*', {'samples': 1e6, 'least_share': {}, 'evaluation_episodes': 16}),  # a step is a cycle
    ('FSM_Biped2D_Terrain_Gaps-v0',
     {'initial_std': 0.08, 'evaluation_episodes': 8, 'further': (MORE_CYCLES, SMALLER_CHANGES)}),
)  # fmt: skip

# Gaits whose policy sets all parameters; of the others it selects a base action, see `learn_gaits.py`.
EVERY_PARAMETER = 'FSM_Hopper2D_Terrain_Gaps-v0', 'FSM_Biped2D_Terrain_Gaps-v0'

# Policies for worlds and sensors that vary, in `trained/randomized`: `train_randomized.py` continues
# the training of shipped ones with this preset of `randomize` and `sensors`. Low learning rates, to
# avoid forgetting.
PRESET = 'harsh'
CONTINUED = {
    'samples': 0.6e6, 'averaged': 5e4, 'learning_rate': 1.5e-4, 'last_learning_rate': 2e-5,
    'start_count': 1e6, 'value_first': 4e4, 'value_goes_on': True, 'least_share': {},
    'stages_averaged': 1, 'further': (), 'runs_averaged': 1, 'enough': np.inf,
    'evaluation_episodes': 64,
}  # fmt: skip
FEWER = {'samples': 2.5e5, 'value_first': 2e4, 'evaluate_every': 5e4, 'evaluation_episodes': 32}
RANDOMIZED: dict[str, dict[str, Any]] = {
    'PD_Biped2D_LLC_Imitate_Flat-v0': {},
    'Torque_Dog2D_LLC_Imitate_Flat-v0': {'enough': 0.76},
    'MTU_Raptor2D_LLC_Imitate_Flat-v0': {**FEWER, 'enough': 0.37},
    'PD_Biped2D_Gaps_Terrain-v0': {**FEWER, 'preset': 'robot', 'samples': 1.5e5},
    'PD_Raptor2D_Slopes_Terrain-v0': {**FEWER, 'samples': 5e5},
    'PD_Biped3D_Imitate-v0': FEWER,
    # Plans and rewards of the last stage of its training; pushes are those of the preset.
    'PD_Biped3D_LLC_General_Step-v0': {**FEWER, 'stages': STAGES[-1:]},
}


def matching(id_: str, rows: Iterable[Row]) -> dict[str, Any]:
    """Returns the values of all rows that match an id; later rows have precedence."""
    values: dict[str, Any] = {}
    for pattern, row in rows:
        if fnmatch.fnmatchcase(id_, pattern):
            values.update(row)
    return values


def settings_for(id_: str, **changes: Any) -> Settings:
    """Returns the settings of an environment; samples among the changes are those of each further run."""
    found = {**matching(id_, OVERRIDES), **changes}
    each = {'samples': changes['samples']} if 'samples' in changes else {}
    further = tuple({**run, **each} for run in found.get('further', ()))
    return Settings(**{**found, 'further': further})


def randomized_settings_for(id_: str, **changes: Any) -> Settings:
    """Returns the settings with which the shipped policy of an environment is trained further.

    Raises:
      KeyError: the environment is not in `RANDOMIZED`.
    """
    own = {**CONTINUED, 'start': id_, **RANDOMIZED[id_], **changes}
    preset = own.pop('preset', PRESET)
    disturbed = {'randomize': preset, 'sensors': preset}
    (_, options), *_ = own.get('stages') or ((0.0, {}),)
    options = {name: value for name, value in options.items() if name != 'pushes'}
    stages = ((0.0, {**options, **disturbed}),)
    return settings_for(id_, **{**own, 'stages': stages, 'evaluated_with': disturbed})
