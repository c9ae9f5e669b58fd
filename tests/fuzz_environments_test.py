"""Random tests: invalid input is rejected by name, and single and vector environments agree.

Hypothesis draws options, actions, numbers of simulations, states, and orders of calls. All are slow
(`-m slow`): they draw a seed, print it, and take it from FUZZ_SEED if that is set; FUZZ_EXAMPLES
says how many.
"""

import dataclasses
import functools
import os
import pickle
import random
import warnings

import hypothesis
import numpy as np
import pytest
from absl.testing import parameterized
from helpers import ONE_OF_EACH
from hypothesis import stateful
from hypothesis import strategies as st

from trl_suite import suite
from trl_suite.environments import states
from trl_suite.registry import catalogue
from trl_suite.tasks.task_type import TASK_TYPES
from trl_suite.tasks.variation import pushes, sensors, worlds
from trl_suite.vector import VectorEnvironment

SLOW = int(os.environ.get('FUZZ_EXAMPLES', '200'))
COMMON = {
    'deadline': None, 'database': None, 'suppress_health_check': list(hypothesis.HealthCheck),
}  # fmt: skip
SPECS = {
    'planar_walk': suite.combine('dog', task='walk'),
    'spatial_walk': suite.combine('biped3d', task='walk'),
    **{spec.task_type: spec for spec in catalogue.SPECS},
}  # one of each task type
GAPS = 'PD_Biped2D_Gaps_Terrain-v0'
REALISTIC = {
    'actuators': {'strength': (0.7, 1.3), 'delay': (0, 2), 'noise': 0.05},
    'randomize': {'preset': 'robot', 'push': {'speed': (0.2, 1), 'interval': (0, 0.3)}},
    'sensors': {'preset': 'robot', 'delay': (0, 3)},
}
REFUSALS = (ValueError, TypeError)

numbers = st.one_of(
    st.sampled_from((0, 1, -1, 2, 4, 10, 33, 0.5, 1.0, -0.0, 1e-12, 1e300, 10**30)),
    st.floats(allow_nan=True, allow_infinity=True), st.integers(-3, 40), st.booleans(),
)  # fmt: skip
anything = st.one_of(
    numbers, st.none(), st.text(max_size=5), st.just(b'x'), st.just(object()), st.just(np.array),
    st.just({}), st.just(np.zeros((2, 2))), st.lists(numbers, max_size=3),
    st.lists(st.lists(numbers, min_size=2, max_size=2), max_size=2), st.just({'a': 1}),
)  # fmt: skip
arrays = st.one_of(
    anything,
    st.builds(
        lambda shape, dtype, value: np.full(shape, value).astype(dtype),
        st.lists(st.sampled_from((0, 1, 2, 3, 11)), max_size=3).map(tuple),
        st.sampled_from((float, 'float32', int, bool, 'datetime64[D]', 'U3', object, complex)),
        st.integers(-2, 3),
    ),
)


def drawn(test, examples):
    """Runs a property test with draws of a seed that is printed."""
    seed = int(os.environ.get('FUZZ_SEED', random.SystemRandom().randrange(2**32)))
    print(f'FUZZ_SEED={seed} FUZZ_EXAMPLES={examples}')
    hypothesis.seed(seed)(hypothesis.settings(max_examples=examples, **COMMON)(test))()


@functools.cache
def several(id_, realistic, count):
    """Simulations, and a single environment for each, which begin again with new seeds."""
    options = REALISTIC if realistic else {}
    environments = VectorEnvironment(id_, count, 1, seed=0, task_kwargs=options)
    return environments, [suite.make(id_, options) for _ in range(count)]


def begun(id_, seed=0, realistic=False, count=2):
    environments, singles = several(id_, realistic, count)
    first = environments.reset(seed=seed)
    for single, own, observation in zip(singles, environments.seeds, first, strict=True):
        single.random_state.seed(own)
        np.testing.assert_array_equal(flat(single.reset()), observation)
    return environments, singles


def flat(time_step):
    return np.concatenate([block.ravel() for block in time_step.observation.values()])


def check_option(task_type, name, value):
    """An option is refused by its name, or the environment works with it."""
    type_ = TASK_TYPES[task_type]
    try:
        type_.config.parse(task_type, {name: value})
    except REFUSALS as error:
        assert name in str(error), f'{name}={value!r}: {error}'
        return
    try:
        with warnings.catch_warnings():
            warnings.simplefilter('ignore')
            options = {name: value, 'random': 0}
            environment = suite.build_environment(SPECS[task_type], options, None)
    except (*REFUSALS, FileNotFoundError) as error:
        assert str(error), f'{name}={value!r}'
        return
    try:
        environment.reset()
        time_step = environment.step(np.zeros(len(environment.action_map)))
    except REFUSALS as error:  # what a function returns is known when it is called
        assert callable(value) and name in str(error), f'{name}={value!r}: {error}'
        return
    assert np.isfinite(flat(time_step)).all() and np.isfinite(time_step.reward)
    environment.close()


def option_test(task_type):
    names = [option.name for option in dataclasses.fields(TASK_TYPES[task_type].config)]

    @hypothesis.given(st.sampled_from(names), anything)
    def test(name, value):
        check_option(task_type, name, value)

    return test


DISTURBANCES = [  # option of the task, option in it, and a function that makes its value
    (kind, option.name, make)
    for kind, config, make in (
        ('randomize', worlds.WorldConfig,
         lambda name, value: {name: value, **({'slope': 0.1} if name == 'slope_direction' else {})}),
        ('randomize', pushes.PushConfig,
         lambda name, value: {'push': {**({} if name == 'speed' else {'force': 1.0}), name: value}}),
        ('sensors', sensors.SensorConfig, lambda name, value: {name: value}),
    )
    for option in dataclasses.fields(config)
]  # fmt: skip


def disturbance_test(id_):
    """An option of worlds, pushes or sensors is refused by its name, or the environment works."""

    @hypothesis.given(st.sampled_from(DISTURBANCES), anything)
    def test(chosen, value):
        kind, name, make = chosen
        try:
            environment = suite.make(id_, {'random': 0, kind: make(name, value)})
        except REFUSALS as error:
            assert name in str(error), f'{kind}, {name}={value!r}: {error}'
            return
        environment.reset()
        time_step = environment.step(np.zeros(len(environment.action_map)))
        assert np.isfinite(flat(time_step)).all() and np.isfinite(time_step.reward)
        environment.close()

    return test


def argument_test(id_):
    @hypothesis.given(arrays, arrays)
    def test(action, env_ids):
        environments, singles = begun(id_)
        for environment, arguments in ((singles[0], (action,)), (environments, (action, env_ids))):
            before = pickle.dumps(environment.get_state())
            try:
                found = environment.step(*arguments)
            except REFUSALS as error:
                assert str(error)
                assert pickle.dumps(environment.get_state()) == before
            else:
                observation = flat(found) if environment is singles[0] else found.observation
                assert np.isfinite(observation).all() and np.isfinite(found.reward).all()
        for call in (environments.reset, environments.get_state):
            try:
                call(env_ids)
            except REFUSALS as error:
                assert str(error)

    return test


def state_test(id_):
    @hypothesis.given(st.data())
    def test(data):
        environments, singles = begun(id_)
        for environment in (environments, singles[0]):
            state = environment.get_state()
            key = data.draw(st.sampled_from((*state, None)))
            if key == 'world':  # numbers that physics cannot bear
                value = data.draw(st.floats(allow_nan=True, allow_infinity=True))
                world = np.array(state['world'])
                world[..., data.draw(st.integers(0, world.shape[-1] - 1))] = value
                state = states.seal({**state, 'world': world})  # otherwise it is refused as damaged
            elif key is None:
                state = data.draw(anything)
            elif key in ('task', 'fresh') or data.draw(st.booleans()):
                del state[key]
            else:
                state[key] = data.draw(anything)
            before = pickle.dumps(environment.get_state())
            try:
                environment.set_state(state)
            except REFUSALS as error:
                assert str(error)
                assert pickle.dumps(environment.get_state()) == before
            size = len(environment.action_map)
            if environment is environments:
                found = environment.step(np.zeros((2, size))).observation
                again = environment.reset()
            else:
                found, again = flat(environment.step(np.zeros(size))), flat(environment.reset())
            assert np.isfinite(found).all() and np.isfinite(again).all()

    return test


class Calls(stateful.RuleBasedStateMachine):
    """Some simulations and as many single environments are told the same, and do the same.

    Environments are closed and made again in between.
    """

    ID, REALISTIC, COUNT = GAPS, False, 3
    which = st.integers(0, COUNT - 1)
    copies = st.lists(st.tuples(which, which), max_size=COUNT, unique_by=lambda pair: pair[1])
    states = stateful.Bundle('states')

    @stateful.initialize(seed=st.integers(0, 2**32 - 1))
    def begin(self, seed):
        self.environments, self.singles = begun(self.ID, seed, self.REALISTIC, self.COUNT)
        self.size = len(self.environments.action_map)

    @stateful.rule(seed=st.integers(0, 9), scale=st.sampled_from((0.0, 0.3, 1.0, 1e9)))
    def step(self, seed, scale):
        action = scale * np.random.default_rng(seed).uniform(-1, 1, (self.COUNT, self.size))
        found = self.environments.step(action)
        assert np.isfinite(found.observation).all()
        for i, single in enumerate(self.singles):
            time_step = single.step(action[i])
            np.testing.assert_array_equal(found.observation[i], flat(time_step))
            assert found.reward[i] == (time_step.reward or 0)
            assert (found.terminated[i] or found.truncated[i]) == time_step.last()
            assert found.terminated[i] == (time_step.discount == 0)

    @stateful.rule(i=which)
    def reset(self, i):
        found = self.environments.reset([i])
        np.testing.assert_array_equal(found[i], flat(self.singles[i].reset()))

    @stateful.rule(target=states)
    def save(self):
        states = self.environments.get_state(), [single.get_state() for single in self.singles]
        return pickle.dumps(states)

    @stateful.rule(saved=states)
    def restore(self, saved):
        state, alone = pickle.loads(saved)
        self.environments.set_state(state)
        for single, own in zip(self.singles, alone, strict=True):
            single.set_state(own)

    @stateful.rule(pairs=copies)
    def copy(self, pairs):
        found = [single.get_state() for single in self.singles]
        for i, j in pairs:
            self.singles[j].set_state(
                states.seal({**found[i], 'random': [self.singles[j].random_state.get_state()]})
            )
        self.environments.copy_from(self.environments, [i for i, _ in pairs], [j for _, j in pairs])

    @stateful.rule(i=which)
    def break_down(self, i):
        for world, k in (
            (self.environments.task.world, i), (self.singles[i].task.world, 0),
        ):  # fmt: skip
            world.qvel[k] = np.nan
            world.forward(np.array([k]))  # what was written is part of the state only then

    @stateful.rule()
    def make_again(self):
        state, old = self.environments.get_state(), (self.environments, *self.singles)
        self.singles = [pickle.loads(pickle.dumps(single)) for single in self.singles]
        options = REALISTIC if self.REALISTIC else {}
        self.environments = VectorEnvironment(self.ID, self.COUNT, 1, seed=3, task_kwargs=options)
        self.environments.set_state(state)
        if old[0] is not several(self.ID, self.REALISTIC, self.COUNT)[0]:
            for each in old:
                each.close()
                for call in (each.reset, each.get_state):
                    with pytest.raises(RuntimeError, match='the environment is closed'):
                        call()

    @stateful.invariant()
    def same(self):
        for i, single in enumerate(self.singles):
            info = self.environments.info
            assert info['distance'][i] == single.info['distance']
            assert info['diverged'][i] == single.info['diverged']


@pytest.mark.slow
class SlowTest(parameterized.TestCase):
    @parameterized.parameters(*TASK_TYPES)
    def test_options(self, task_type):
        drawn(option_test(task_type), SLOW)

    @parameterized.parameters(*ONE_OF_EACH)
    def test_worlds_and_sensors(self, id_):
        drawn(disturbance_test(id_), SLOW)

    @parameterized.parameters(*ONE_OF_EACH)
    def test_arguments(self, id_):
        drawn(argument_test(id_), SLOW)

    @parameterized.parameters(*ONE_OF_EACH)
    def test_states(self, id_):
        drawn(state_test(id_), SLOW)

    @parameterized.product(id_=ONE_OF_EACH, realistic=(False, True))
    def test_calls(self, id_, realistic):
        seed = int(os.environ.get('FUZZ_SEED', random.SystemRandom().randrange(2**32)))
        print(f'FUZZ_SEED={seed} FUZZ_EXAMPLES={SLOW}')
        examples = max(1, SLOW // 10)
        settings = hypothesis.settings(max_examples=examples, stateful_step_count=30, **COMMON)
        names = {'ID': id_, 'REALISTIC': realistic}
        calls = hypothesis.seed(seed)(type('CallsOf', (Calls,), names))
        stateful.run_state_machine_as_test(calls, settings=settings)
