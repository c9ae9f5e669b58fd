"""Navigation by footstep plans: the high-level tasks, with a low-level footstep controller.

Source: the HLC scenarios of the original; 'DeepLoco: dynamic locomotion skills using hierarchical
deep reinforcement learning' (Peng, Berseth, Yin, van de Panne 2017).
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Collection, Sequence
from typing import Any

import numpy as np

from trl_suite.actuation.action_map import ActionMap
from trl_suite.arenas import SpatialArena
from trl_suite.bodies.blocks import Block, columns, layout, reflected, signs
from trl_suite.bodies.reference import CONTROL_TIMESTEP, PHASE
from trl_suite.bodies.spatial import LINK_POSE, body_blocks
from trl_suite.bodies.state import allocated
from trl_suite.characters import Character
from trl_suite.controllers import footstep_controller
from trl_suite.engine import World
from trl_suite.motion import FootstepLibrary
from trl_suite.policies.mirror import Mirror
from trl_suite.tasks.common.control import MOST_SUBSTEPS, SUBSTEPS, GroundConfig, terrain_maps
from trl_suite.tasks.common.footstep_plan import (
    CONTACT,
    PLAN,
    FootstepPlan,
    check_two_feet,
    plan_markers,
    pose_of_step,
)
from trl_suite.tasks.common.goals import (
    AT_GOAL,
    BALL,
    BALL_GOAL,
    GOAL,
    Ball,
    GoalTask,
    soccer_terms,
)
from trl_suite.tasks.navigation import hierarchical_rules as rules
from trl_suite.tasks.rewards import terms_data
from trl_suite.tasks.task import Marker, drawn_seed
from trl_suite.util.options import Range, option

INTERFACES = ('plan', 'frame')
# In the option `controller`, `registry.build` replaces an id by the policy that is shipped for it.
CONTROLLER = 'PD_Biped3D_LLC_General_Step-v0'
GOAL_REACHED = 1.0  # m; default
FARTHEST_GOAL = 100.0  # m; upper bound of the option goal_distance
# A plan: x and y of both landing places, m, and turn of the heading, rad. PLAN_OFFSET is the plan
# at action 0, in step lengths; PLAN_SCALE is the change per unit action, in m and rad.
PLAN_NAMES: tuple[str, ...] = ('first_x', 'first_y', 'second_x', 'second_y', 'turn')
PLAN_SIGNS = (1.0, -1.0, 1.0, -1.0, -1.0)  # of the mirrored plan
CHOICE = 'controller_'  # with index and name: actions that select one of several controllers
PLAN_OFFSET = np.array([1.0, 0.0, 2.0, 0.0, 0.0])
STEP_LENGTH = 0.5  # m
PLAN_SCALE = np.array([1.0, 1.0, 2.0, 2.0, np.pi])


@dataclasses.dataclass(frozen=True, kw_only=True)
class HierarchicalConfig(GroundConfig):
    """Options of `HierarchicalNavigation`."""

    controller: Any = option(
        CONTROLLER,
        (
            'footstep controller: the id of an environment, whose shipped policy is used, a policy, the path '
            'of its file, or a function; or a list of them, of which every action selects one, of equal numbers '
            "the first; it does not act with the interface 'frame'"
        ),
        policy=True,
    )
    interface: str = option(
        'plan',
        "'plan': a step is a footstep; 'frame': a step is 1/30 s, an action contains the plan, then the joint "
        'targets, and a plan takes effect only in a step that begins a footstep',
        choices=INTERFACES,
    )
    terrain_observation: str | Collection[str] = terrain_maps('height')
    step_length: float = option(
        STEP_LENGTH, 'step length of the plan at action 0', unit='m', above=0, at_most=10
    )
    target_speed: float = option(
        1.0,
        'speed of walker and ball towards the goal at which the reward reaches its maximum',
        unit='m/s',
        above=0,
    )
    goal_reached: float | None = option(
        None,
        f'distance within which a goal is reached, by default {GOAL_REACHED:g}, or a ball is at its goal, '
        f'by default {AT_GOAL:g}',
        unit='m',
        above=0,
    )
    goal_distance: Range | None = option(
        None,
        'minimum and maximum distance of goals from the walker, or the ball, in any direction; by default '
        'the terrain determines where goals are drawn',
        unit='m',
        at_least=0,
        at_most=FARTHEST_GOAL,
    )
    start_phases: Sequence[float] = option(
        (0.1, 0.6),
        'phases of the cycle, from which the phase at the start of an episode is drawn',
        at_least=0,
        below=1,
    )
    substeps: int = option(SUBSTEPS, 'physics steps per 1/30 s', at_least=6, at_most=MOST_SUBSTEPS)


class HierarchicalNavigation(GoalTask):
    """A spatial biped walks from goal to goal, or dribbles a ball to them, by planning footsteps.

    An action is a plan of two footsteps and a heading. A step lasts from one switch of stance to the
    next, half a cycle of the footstep controller that controls the joints; the first step of an
    episode may be shorter. A plan has the landing place of the swing foot, the next landing place
    of the stance foot, and a heading, relative to position and heading of the root at the beginning
    of the step. With several footstep controllers, an action also has a number for each; the largest
    selects the controller of the step. They are clipped to [-1, 1]; of equal ones, the first counts.

    Attributes:
      plan: plans of the simulations.
      controllers: the footstep controllers.
      watch: callback at every 1/30 s of the first simulation, also within steps; for rendering.
    """

    ABOUT_COM, RULE = False, 'far'
    finish_all, observe_all = rules.finish_all, rules.observe_all
    length = 0.5
    watch: Callable[[], None] | None = None

    CONFIG: Any = HierarchicalConfig

    def __init__(
        self,
        character: Character,
        arena: SpatialArena,
        steps: FootstepLibrary,
        config: HierarchicalConfig,
        ball: Ball | None = None,
        *,
        actuation_model: str = 'position',
    ) -> None:
        """Composes the task.

        Args:
          character: a spatial biped without actuators; it is attached to the arena.
          arena: the arena with its terrain.
          steps: library of single steps of this character, for the initial pose and the clock.
          config: the options, with a controller, not the id of an environment.
          ball: a ball of the arena, for dribbling; the terrain must be level.
          actuation_model: 'position'.

        Raises:
          ValueError: parts that are incompatible.
        """
        check_two_feet(character.spec)
        self.ball, self.goal_distance = ball, config.goal_distance
        self.terms = soccer_terms() if ball else rules.NAVIGATION_TERMS
        super().__init__(character, arena, steps, config, actuation_model)
        given = config.controller
        several = isinstance(given, (list, tuple))
        self.controllers = [*map(footstep_controller.load, given if several else [given])]
        self._controller_blocks: tuple[Block, ...] = (*self.body.blocks, PHASE, CONTACT, PLAN)
        for each in self.controllers:
            each.check(character.spec, layout(self._controller_blocks), self.joint_map)
        # A custom function is called on one thread, for all simulations together.
        self.in_parts = all(each.policy is not None for each in self.controllers)
        self.interface, self.step_length = config.interface, config.step_length
        reached = config.goal_reached
        self.goal_reached = (
            (AT_GOAL if ball else GOAL_REACHED) if reached is None else float(reached)
        )
        self.steps_vary = by_plan = self.interface == 'plan'
        count = len(self.controllers)
        if not count or (count > 1 and not by_plan):
            raise ValueError(
                f'controller: a list of {count}, with the interface {self.interface!r}; expected at least '
                "one, or with the interface 'frame' exactly one"
            )
        if by_plan:
            self.set_timesteps(steps.duration, CONTROL_TIMESTEP / config.substeps)
        joints = None if by_plan else self.joint_map
        names = [each.policy.id if each.policy else each.name for each in self.controllers]
        choices = tuple(f'{CHOICE}{k}: {name}' for k, name in enumerate(names) if count > 1)
        self.action_map = plan_action_map(self.step_length, joints, choices)
        controller = Block(
            'low_level',
            sum(block.size for block in self._controller_blocks),
            '',
            'observation of the footstep controller',
            'the footstep controller has its own observation',
        )
        self.observed = (
            *body_blocks(character, config.terrain_observation),
            BALL_GOAL if ball else GOAL,
            BALL.observed_if(ball is not None),
            controller.observed_if(not by_plan),
        )
        if by_plan and character.spec.mirror:
            self.mirror = planning_mirror(character, self.observed, len(self.action_map))

    @property
    def made_of(self) -> dict[str, tuple[str, Any]]:
        names = ', '.join(each.name for each in self.controllers)
        return {
            **super().made_of,
            'controller': (names, [each.policy for each in self.controllers]),
        }

    def _bind_body(self, world: World) -> rules.PlanningData:
        n, blocks = world.n, self._controller_blocks
        self.plan, self.state = allocated(FootstepPlan, n), allocated(rules.PlanningState, n)
        self.saved = (*self.saved, self.plan, self.state)
        aims = self._bind_goals(world, float(self.config.target_speed))
        self.info_arrays |= {
            'landed': self.plan.landed,
            'landing_error': self.plan.landing_error,
            'heading_error': self.plan.heading_error,
            'duration': self.state.duration,
            **({'controller': self.state.controller} if len(self.controllers) > 1 else {}),
        }
        self._controller_observation = np.zeros((n, sum(block.size for block in blocks)))
        self._joint_action = np.zeros((n, len(self.joint_map)))
        # In a step, `rules.observe_for_controller` writes all of this array; elsewhere, `Body.measure`
        # the body's blocks. `rules.observe` writes those of the planner.
        self.body.bind(world, self.joint_map, self._controller_observation, blocks, self.ABOUT_COM)
        return rules.PlanningData(
            body=self.body.data,
            outcome=self.outcome,
            clock=self.clock,
            travel=self.travel,
            period=self.period,
            controller=rules.ControllerData(columns(blocks), self._controller_observation),
            plan=self.plan,
            aims=aims,
            state=self.state,
            columns=columns(self.observed),
            terms=terms_data(rules.NAVIGATION_TERMS),
            by_plan=self.interface == 'plan',
            plan_map=self.action_map.drive(0),
            controllers=len(self.controllers),
        )

    # Episodes.

    def _draw_start(
        self, env_ids: np.ndarray, random_states: Sequence[np.random.RandomState]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        for i, random_state in zip(env_ids.tolist(), random_states, strict=True):
            seed = self.terrain_seed(i, random_state)
            random = self._random[i] = np.random.default_rng(drawn_seed(random_state))
            self.clock.start[i] = random.choice(self.config.start_phases)
            self._begin_ground(i, seed, random)
        self._begin_clocks(env_ids)
        self.plan.stance[env_ids] = self.phase[env_ids] >= 0.5
        poses, rates = pose_of_step(self.steps, self._first, self.phase[env_ids])
        return poses, rates, self.travel.origin[env_ids]

    def _placed(self, env_ids: np.ndarray) -> None:
        plan = self.plan
        for array in (*self.state, plan.landing_error, plan.heading_error, plan.landed):
            array[env_ids] = 0
        self._begin_goals(env_ids)
        measurement = self.body.measure(env_ids)
        # Before the first action, the plan is the current positions of the feet.
        plan.heading[env_ids] = measurement.heading[env_ids]
        stance = plan.stance[env_ids]
        plan.landing[env_ids, 0] = measurement.feet[env_ids, 1 - stance]
        plan.landing[env_ids, 1] = measurement.feet[env_ids, stance]

    @property
    def steps_per_call(self) -> int:
        return self.config.substeps

    # A step.

    def apply_action(self, action: np.ndarray, env_ids: np.ndarray) -> None:
        rules.begin_steps(env_ids, action, self._pack)
        if self.interface == 'frame':
            self._joint_action[env_ids] = np.clip(action[env_ids, len(PLAN_NAMES) :], -1.0, 1.0)

    def simulate(self, env_ids: np.ndarray) -> None:
        """Runs each simulation to the next switch of stance, or for one control step."""
        going = env_ids
        while len(going):
            if self.interface == 'plan':
                for k, controller in enumerate(self.controllers):
                    led = going[self.state.controller[going] == k]
                    if len(led):
                        self._joint_action[led] = controller(self._controller_observation[led])
            self.body.apply_action(self._joint_action, going)
            if self.step_in_parts:
                self.world.step(self.config.substeps, going)
            else:  # the physics alone
                self.world.share(functools.partial(self.world.step, self.config.substeps), going)
            count = rules.finish_control_steps(going, self._pack)
            if self.watch is not None:
                self.watch()
            if count < len(going):
                going = going[~self.state.over[going]]

    def lay(self, action: np.ndarray) -> np.ndarray:
        """Sets plans where a footstep begins, as the next step with the same actions would.

        With the interface 'frame', a footstep controller can thus observe a plan before it acts.

        Args:
          action: (n, k), in [-1, 1]; with several controllers the plan chooses one, other numbers after it
            are ignored.

        Returns:
          Observation of the footstep controller, (n, size); the observation is updated as well.

        Raises:
          ValueError: actions of the wrong shape, or with NaN or infinity.
        """
        rules.show_plans(
            self.world.all_ids, self.action_map.checked(action, self.world.n), self._pack
        )
        if self.interface == 'frame' and self.seen is not self.outcome:  # components have a copy
            part = self.blocks['low_level']
            self.seen.observation[:, part] = self.outcome.observation[:, part]
        return self._controller_observation.copy()

    def finish_step(self, env_ids: np.ndarray) -> None:
        if rules.score_all(env_ids, self._pack):
            self._redraw_goals(env_ids)
        self.finish_all(env_ids, self._pack)

    def markers(self, env_id: int) -> list[Marker]:
        """Returns markers of the plan, past positions of the centre of mass, and the goal."""
        root = self.world.xpos[env_id, self.body.links[0]]
        return [*plan_markers(env_id, root, self.plan), *super().markers(env_id)]


def plan_action_map(
    step_length: float, joint_map: ActionMap | None = None, choices: tuple[str, ...] = ()
) -> ActionMap:
    """Returns the map from actions to plans.

    Args:
      step_length: step length of the plan at action 0, m.
      joint_map: the map of actions to joint targets, with the interface 'frame': these actions
        follow those of the plan, and are passed on as they are.
      choices: names of the numbers that select a footstep controller, which follow.
    """
    more = choices if joint_map is None else joint_map.names
    offset = np.append(step_length * PLAN_OFFSET, np.zeros(len(more)))
    scale = np.append(PLAN_SCALE, np.ones(len(more)))
    return ActionMap((*PLAN_NAMES, *more), 'footstep plan', 'm (turn: rad)', offset, scale)


def planning_mirror(
    character: Character, blocks: tuple[Block, ...], actions: int = len(PLAN_NAMES)
) -> Mirror:
    """Returns the reflection of observations with these blocks, and of plans.

    Args:
      character: the character, which has pairs of right and left links.
      blocks: the observation blocks.
      actions: number of actions; those after the plan are not reflected.
    """
    links = list(character.spec.links)
    feet = [links.index(name) for name in character.spec.end_effectors]
    right, left = layout(blocks)['pose'].start + 1 + LINK_POSE * np.array(feet)
    same = [1.0] * (actions - len(PLAN_SIGNS))
    return Mirror(*reflected(blocks), *signs((*PLAN_SIGNS, *same)), feet=(right, left))
