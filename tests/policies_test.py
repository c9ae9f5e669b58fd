"""Trained policies: what they compute, what they refuse, their files, and those shipped."""

import dataclasses
import functools
import io
import itertools
import json
import pathlib
import zipfile
from unittest import mock

import dm_env
import numpy as np
from absl.testing import absltest, parameterized
from helpers import FolderTest, assert_refused

import trl_suite
from trl_suite import motion, policies, suite
from trl_suite.policies import files
from trl_suite.registry import catalogue
from trl_suite.util import resources
from trl_suite.vector import VectorEnvironment

GAPS, DOG = 'PD_Biped2D_Gaps_Terrain-v0', 'PD_Dog2D_Gaps_Terrain-v0'
MAX_BYTES = 750_000  # of a shipped network; the largest observes 10 m of ground
SIZES = (('terrain', 3), ('pose', 4))  # an odd sum: rows lie at any address


def make(seed=0, blocks=SIZES, hidden=(6, 5), actions=('hip', 'knee'), **changes):
    """A policy with random numbers."""
    rng = np.random.default_rng(seed)
    k, a = sum(size for _, size in blocks), len(actions)
    shapes = list(zip((k, *hidden), (*hidden, a), strict=True))
    fields = {
        'id': GAPS, 'blocks': blocks, 'actions': actions, 'quantity': 'target angle',
        'mean': rng.normal(size=k), 'std': rng.uniform(0.5, 2, k), 'clip': 1.5,
        'weights': [rng.normal(0, 0.6, shape) for shape in shapes],
        'biases': [rng.normal(0, 0.3, shape[1]) for shape in shapes], 'activation': 'tanh',
        'log_std': rng.normal(-1, 0.3, a), 'info': {'seed': seed, 'rates': [1e-3, None]},
    }  # fmt: skip
    return policies.Policy(**{**fields, **changes})


def make_convolving(seed=0, size=0.6, origin=9, grid=None, **changes):
    """A policy with convolutions over 9 heights, relative to the first of 4 other inputs.

    With `grid`, over two maps of that size instead, which are followed by 4 other inputs.
    """
    rng = np.random.default_rng(seed)
    if grid is None:
        line, shapes, outputs = 9, ((3, 1, 4), (2, 4, 5)), 3 * 5  # 9 heights -> 4 positions -> 3
    else:  # positions: 5 x 6 -> 2 x 2 -> 1 x 2
        line, shapes, outputs = 60, ((2, 3, 2, 4), (2, 1, 4, 3)), 1 * 2 * 3
    convolution = policies.Convolution(
        line=line, strides=(2, 1), weights=[rng.normal(0, size, shape) for shape in shapes],
        biases=[rng.normal(0, 0.3, shape[-1]) for shape in shapes], origin=origin, grid=grid,
    )  # fmt: skip
    pairs = itertools.pairwise((outputs + 4, 6, 5, 2))
    weights, blocks = [rng.normal(0, 0.6, pair) for pair in pairs], (('terrain', line), ('pose', 4))
    return make(seed, blocks, weights=weights, convolution=convolution, **changes)


make_seeing = functools.partial(make_convolving, size=0.4, origin=None, grid=(5, 6))


def selecting(seed, count, outputs):
    """A policy that selects one of some actions, and changes it."""
    random = np.random.default_rng(seed)
    return make(
        actions=tuple('abc'), choices=np.linspace(-1, 1, 3 * count).reshape(-1, 3),
        weights=[random.normal(size=(7, 16)), random.normal(size=(16, outputs))],
        biases=[np.zeros(16), np.zeros(outputs)], largest_change=0.3,
    )  # fmt: skip


def plain(policy, observation):
    """The documented formula for one observation, in double precision."""
    hidden = {'tanh': np.tanh, 'relu': lambda x: np.maximum(x, 0),
              'elu': lambda x: np.where(x > 0, x, np.expm1(np.minimum(x, 0)))}[policy.activation]  # fmt: skip
    x, line = np.array(observation, float), policy.convolution
    if line is not None and line.origin is not None:
        x[: line.line] -= x[line.origin]
    x = np.clip((x - policy.mean) / policy.std, -policy.clip, policy.clip)
    if line is not None:
        maps = np.moveaxis(x[: line.line].reshape(-1, *(line.grid or (1, line.line))), 0, -1)
        for weight, bias, stride in zip(line.weights, line.biases, line.strides, strict=True):
            weight = weight.reshape(-1, *weight.shape[-3:])
            (h, w), (rows, columns) = weight.shape[:2], maps.shape[:2]
            maps = hidden(np.array([
                [np.tensordot(maps[i : i + h, j : j + w], weight, 3) + bias
                 for j in range(0, columns - w + 1, stride)]
                for i in range(0, rows - h + 1, stride)
            ]))  # fmt: skip
        x = np.concatenate([maps.ravel(), x[line.line :]])
    for i, (weight, bias) in enumerate(zip(policy.weights, policy.biases, strict=True)):
        x = x @ weight.astype(float) + bias
        if i < len(policy.weights) - 1:
            x = (x - x.mean()) / np.sqrt(x.var() + 1e-5) if policy.layer_norm else x
            x = hidden(x)
    return np.clip(x, -1, 1)


class ActTest(parameterized.TestCase):
    @parameterized.parameters(
        *((make, {'activation': a, 'hidden': hidden}, 2.0, 2e-6)
          for a in policies.ACTIVATIONS for hidden in ((), (6,), (6, 5))),
        *((make_convolving, {'activation': a, 'layer_norm': norm}, 1.5, 1e-5)
          for a in policies.ACTIVATIONS for norm in (False, True)),
        (make_seeing, {}, 1.5, 1e-5),
        (make_seeing, {'activation': 'relu', 'layer_norm': True}, 1.5, 1e-5),
    )  # fmt: skip
    def test_output_equals_the_documented_formula(self, made, changes, scale, atol):
        policy = made(**changes)
        observations = np.random.default_rng(1).normal(0, scale, (50, policy.observation_size))
        expected = [plain(policy, row) for row in observations]
        actions = policy(observations)
        self.assertEqual((actions.shape, actions.dtype), ((50, 2), np.float64))
        self.assertEqual(policy(observations[:0]).shape, (0, 2))
        np.testing.assert_allclose(actions, expected, atol=atol)
        if made is make:
            self.assertEqual(np.abs(actions).max(), 1)  # some are clipped, not all
            self.assertGreater((np.abs(actions) < 1).mean(), 0.2)

    @parameterized.parameters(make, make_convolving, make_seeing)
    def test_an_ensemble_has_the_mean_output(self, make_one):
        scales = {'mean': make_one().mean, 'std': make_one().std}  # those of the whole ensemble
        members = []
        for seed in range(3):
            one = dataclasses.replace(make_one(seed), **scales)
            last = one.weights[-1] / 8  # so that no output is clipped
            members.append(dataclasses.replace(one, weights=[*one.weights[:-1], last]))
        together = policies.ensemble(members)
        size = together.observation_size
        observations = np.random.default_rng(1).normal(0, 0.3, (50, size))
        outputs = [np.array([plain(each, row) for row in observations]) for each in members]
        self.assertLess(np.abs(outputs).max(), 1)
        np.testing.assert_allclose(together(observations), np.mean(outputs, 0), atol=2e-6)
        alone = [together(row) for row in observations]
        np.testing.assert_array_equal(together(observations), alone)

    def test_an_ensemble_selects_the_action_with_the_largest_mean_value(self):
        choices = np.array([[0.5], [-0.5], [0.0]])
        weight = np.zeros((3, 1, 3))
        bias = np.array([[3.0, 0, 2], [0, 3, 2], [0, 0, 0]])  # means 1, 1, 4/3
        policy = make(
            hidden=(), blocks=(('a', 1),), actions=('hip',), weights=[weight], biases=[bias],
            mean=np.zeros(1), std=np.ones(1), choices=choices,
        )  # fmt: skip
        np.testing.assert_array_equal(policy([0.0]), [0.0])
        changed = dataclasses.replace(policy, biases=[bias - [0, 0, 0.5]])
        np.testing.assert_array_equal(changed([0.0]), [0.5])
        np.testing.assert_array_equal(changed.with_preference(0.3)([0.0]), [0.0])
        np.testing.assert_array_equal(changed.with_preference(0.1)([0.0]), [0.5])

    def test_only_networks_of_one_policy_are_an_ensemble(self):
        one, line = make(), make_convolving()
        two = policies.ensemble([one, one])
        shifted = dataclasses.replace(line.convolution, origin=10)
        weights = [np.zeros((13, 6)), *line.weights[1:]]
        bare = dataclasses.replace(line, convolution=None, weights=weights)
        mirror, twin = (
            policies.mirror.Mirror(
                phase=0, feet=None, observation_index=np.arange(7), observation_sign=np.ones(7),
                action_index=np.arange(2), action_sign=np.ones(2),
            )
            for _ in range(2)
        )  # fmt: skip
        mirrored = [dataclasses.replace(one, mirror=each) for each in (mirror, twin)]
        self.assertLen(policies.ensemble(mirrored).networks, 2)
        self.assertIs(policies.ensemble([one]), one)
        bounded = selecting(0, 2, 5)
        for members, message in (
            ([], 'members: .*at least one'),
            ([one, make(clip=2)], 'members: .*different clip'),
            ([one, dataclasses.replace(one, std=2 * one.std)], 'members: .*different std'),
            ([one, make(hidden=(6, 4))], 'members: .*different shapes'),
            ([one, make(hidden=(6,))], 'members: .*different shapes'),
            ([one, two], 'members: .*one network each'),
            ([line, dataclasses.replace(line, convolution=shifted)], 'different convolutions'),
            ([line, bare], 'members: .*different convolutions'),
            ([bare, line], 'members: .*different convolutions'),
            ([one, mirrored[0]], 'members: .*different mirrors'),
            ([bounded, dataclasses.replace(bounded, largest_change=0.2)], 'different largest_change'),
        ):  # fmt: skip
            with self.subTest(message), self.assertRaisesRegex(ValueError, message):
                policies.ensemble(members)
        for both, changes, message in (
            (two, {'weights': [*two.weights[:2], one.weights[2]]}, r'weight_2: .*expected \(2, 5, 2\)'),
            (two, {'biases': [one.biases[0], *two.biases[1:]]}, r'bias_0: .*expected \(2, 6\)'),
            (two, {'weights': [w[:0] for w in two.weights]}, 'weight_0: .*at least one network'),
            (policies.ensemble([line, line]), {'convolution': line.convolution},
             r'line: convolutions of 1 .* those of 2'),
        ):  # fmt: skip
            with self.subTest(message), self.assertRaisesRegex(ValueError, message):
                dataclasses.replace(both, **changes)

    def test_observations_are_normalised_and_clipped(self):
        identity = make(
            hidden=(), actions=tuple('abcdefg'), mean=np.arange(7), std=np.full(7, 4.0), clip=0.75,
            weights=[np.eye(7)], biases=[np.zeros(7)], log_std=np.zeros(7),
        )  # fmt: skip
        steps = np.array([0, 1, -1, 2.5, 3, 4, -1e30])
        np.testing.assert_array_equal(
            identity(np.arange(7) + steps), [0, 0.25, -0.25, 0.625, 0.75, 0.75, -0.75]
        )

    @parameterized.parameters(
        lambda seed: make(seed), lambda seed: make(seed, (('a', 99),), (33, 17)),
        lambda seed: make(seed, (('a', 104),), (64, 32)), lambda seed: selecting(seed, 2, 5),
        lambda seed: selecting(seed, 5, 20), lambda seed: make_convolving(seed, layer_norm=True),
        lambda seed: make_seeing(seed, layer_norm=True),
    )  # fmt: skip
    def test_actions_do_not_depend_on_the_batch(self, made):
        one, other = made(0), made(1)
        other = dataclasses.replace(other, mean=one.mean, std=one.std)
        for policy in (one, policies.ensemble([one, other])):
            size = policy.observation_size
            observations = np.random.default_rng(1).normal(0, 2, (67, size))
            batch = policy(observations)
            for i in range(67):
                np.testing.assert_array_equal(policy(observations[i]), batch[i])
            for part in (slice(-1, None), slice(-31, None), slice(5, 8), slice(None, None, -3)):
                np.testing.assert_array_equal(policy(observations[part]), batch[part])
            np.testing.assert_array_equal(policy(np.asfortranarray(observations)), batch)

    def test_blocks_and_flat_vector_give_equal_actions(self):
        policy = make()
        flat = np.random.default_rng(3).normal(size=(4, 7))
        for observation in (flat, flat[0]):
            pose, terrain = observation[..., 3:], observation[..., :3]
            mixed = {'pose': pose, 'other': np.zeros(9), 'terrain': terrain}
            np.testing.assert_array_equal(policy(mixed), policy(observation))
            flattened = {'observations': observation}
            np.testing.assert_array_equal(policy(flattened), policy(observation))
        self.assertEqual(policy(flat[0]).shape, (2,))
        self.assertEqual(policy(np.zeros((0, 7))).shape, (0, 2))

    @parameterized.parameters(
        (np.zeros(6), r'shape \(6,\); expected \(7,\) or \(n, 7\): terrain 3, pose 4'),
        (np.zeros((7, 2)), r'shape \(7, 2\); expected'),
        (np.zeros((1, 1, 7)), r'shape \(1, 1, 7\); expected'),
        (0.0, r'shape \(\); expected'),
        ({'pose': np.zeros(4)}, 'lacks terrain; expected terrain 3, pose 4'),
        ({}, 'lacks terrain, pose; expected'),
        ({'terrain': np.zeros(3), 'pose': np.zeros(5)},
         r"block 'pose' has shape \(5,\); expected \(4,\) or \(n, 4\)"),
        ({'terrain': np.zeros((2, 3)), 'pose': np.zeros((3, 4))}, r"'pose' has shape \(3, 4\)"),
        ({'terrain': np.zeros((2, 3)), 'pose': np.zeros(4)}, r"'pose' has shape \(4,\)"),
        ({'observations': np.zeros(6)}, r'shape \(6,\); expected \(7,\)'),
    )  # fmt: skip
    def test_other_observations_are_rejected(self, observation, message):
        with self.assertRaisesRegex(ValueError, message):
            make()(observation)

    def test_a_time_step_is_no_observation(self):
        with self.assertRaisesRegex(
            TypeError, r'expected its observation: policy\(time_step.observation\)'
        ):
            make()(dm_env.restart({'terrain': np.zeros(3), 'pose': np.zeros(4)}))

    def test_a_preferred_default_action(self):
        choices = np.array([[0.5, -0.5], [0, 0], [-1, 0.25]])
        policy = make(
            blocks=(('x', 3),), weights=[np.eye(3)], biases=[np.zeros(3)],
            mean=np.zeros(3), std=np.ones(3), choices=choices,
        )  # fmt: skip
        near, far = [1, 0.5, 0], [2, 0, 0]
        np.testing.assert_array_equal(policy([near, far]), choices[[0, 0]])
        prefers = policy.with_preference(0.75)
        np.testing.assert_array_equal(prefers([near, far]), choices[[1, 0]])
        np.testing.assert_array_equal(policy([near, far]), choices[[0, 0]])
        for bad in (np.nan, np.inf, 'much', [1, 2]):
            with self.assertRaisesRegex(ValueError, '^preference: '):
                policy.with_preference(bad)
        for without in (make(), dataclasses.replace(policy, choices=choices[[0, 2, 2]])):
            with self.assertRaisesRegex(ValueError, 'expected one action of zeros'):
                without.with_preference(1.0)

    def test_a_policy_can_change_the_action_that_it_selects(self):
        choices = np.array([[0.5, -0.5], [0.9, 0]])
        weights = np.array([[1, 0, 0.2, 0.1, 0, 0], [0, 1, 0, 0, 0.4, -0.3]])
        policy = make(
            hidden=(), blocks=(('a', 2),), weights=[weights], biases=[np.zeros(6)],
            mean=np.zeros(2), std=np.ones(2), choices=choices,
        )  # fmt: skip
        seen = np.array([[1.0, 0.5], [0.5, 1.0]])
        expected = [[0.7, -0.4], [1.0, -0.3]]  # 1.3 is clipped
        np.testing.assert_allclose(policy(seen), expected, atol=1e-6)
        bounded = dataclasses.replace(policy, largest_change=0.25)
        expected = choices + 0.25 * np.tanh([[0.2, 0.1], [0.4, -0.3]])
        np.testing.assert_allclose(bounded(seen), np.minimum(expected, 1), atol=1e-6)
        common = dataclasses.replace(bounded, weights=[weights[:, :4]], biases=[[0, 0, 0.1, 0]])
        expected = choices + 0.25 * np.tanh([[0.3, 0.1], [0.2, 0.05]])
        np.testing.assert_allclose(common(seen), np.minimum(expected, 1), atol=1e-6)
        self.assertEqual(common(np.zeros((0, 2))).shape, (0, 2))

    def test_columns_and_cartesian_inputs(self):
        """Near ones where they are, far ones as a direction; columns count with them."""
        some = {'mean': np.zeros(2), 'std': np.ones(2), 'clip': 9, 'hidden': (), 'biases': [[0, 0]]}
        policy = make(columns=np.array([4, 1]), weights=[np.eye(2) / 10], **some)
        np.testing.assert_allclose(policy(np.arange(7)), [0.4, 0.1], rtol=1e-6)
        policy = make(
            hidden=(), places=np.array([[1, 2], [4, 3]]), columns=np.array([7, 8, 9, 10]),
            mean=np.zeros(4), std=np.ones(4), clip=9, log_std=np.zeros(4), actions=tuple('abcd'),
            weights=[np.eye(4) / 2], biases=[np.zeros(4)],
        )  # fmt: skip
        observation = np.array([9, np.pi / 6, 0.5, 20, -np.pi / 2, 9, 9])
        expected = [0.5 * 3**0.5 / 2, 0.5 / 2, 0, -1]
        np.testing.assert_allclose(policy(observation), np.array(expected) / 2, atol=1e-6)

    def test_samples(self):
        # Not clipped before the noise: a mean far outside stays outside.
        policy = make(
            hidden=(), weights=[np.zeros((7, 2))], biases=[[0.25, 9.0]], log_std=np.log([0.2, 0.5])
        )
        drawn = policy.sample(np.zeros((20_000, 7)), np.random.default_rng(4))
        self.assertLessEqual(np.abs(drawn).max(), 1)
        self.assertAlmostEqual(drawn[:, 0].mean(), 0.25, delta=0.01)
        self.assertAlmostEqual(drawn[:, 0].std(), 0.2, delta=0.01)
        np.testing.assert_array_equal(drawn[:, 1], 1)
        again = policy.sample(np.zeros((20_000, 7)), np.random.default_rng(4))
        np.testing.assert_array_equal(drawn, again)
        one = policy.sample(np.zeros(7), np.random.default_rng(4))
        np.testing.assert_array_equal(one, drawn[0])

    @parameterized.parameters(
        ({'blocks': ()}, 'blocks: expected at least one name'),
        ({'blocks': (('a', 3), ('a', 4))}, 'blocks: .* each once'),
        ({'blocks': (('a', 7), ('b', 0))}, 'blocks: expected positive sizes; got a 7, b 0'),
        ({'actions': ()}, 'actions: expected at least one name'),
        ({'activation': 'tan'}, "unknown activation 'tan'; did you mean 'tanh'"),
        ({'mean': np.zeros(6)}, r'mean: has shape \(6,\); expected \(7,\)'),
        ({'mean': ['x'] * 7}, 'mean: expected an array of numbers'),
        ({'mean': np.full(7, 1e300)}, 'mean: (inf|nan) at .*; expected finite numbers'),
        ({'std': np.zeros(7)}, 'std: expected positive numbers'),
        ({'clip': 0}, 'clip: expected a positive number; got 0'),
        ({'clip': np.inf}, 'clip: (inf|nan) at .*; expected finite numbers'),
        ({'log_std': np.zeros(3)}, r'log_std: has shape \(3,\); expected \(2,\)'),
        ({'weights': [], 'biases': []}, 'weights: 0 layers'),
        ({'biases': [np.zeros(2)]}, 'weights: 3 layers with 1 biases'),
        ({'weights': [np.zeros((7, 2)), 3.0, np.zeros((6, 2))]}, r'bias_0: has shape \(6,\); exp'),
        ({'info': {'a': np.zeros(2)}}, 'info: not representable as JSON'),
        ({'info': {'a': np.nan}}, 'info: not representable as JSON'),
        ({'info': [1]}, 'info: expected a dict'),
        ({'columns': np.array([0.5])}, 'columns: expected integers, at least one'),
        ({'columns': np.array([7])}, 'columns: expected numbers of 0 to 6'),
        ({'places': np.array([0, 1])}, 'places: expected integers, at least one'),
        ({'places': np.array([[0, 7]])}, 'places: expected numbers of 0 to 6'),
        ({'places': np.array([[0, 1, 2]])}, r'places: has shape \(1, 3\); expected \(p, 2\)'),
        ({'places': np.array([[0, 1]])}, r'mean: has shape \(7,\); expected \(9,\)'),
        ({'columns': np.array([0, 6])}, r'mean: has shape \(7,\); expected \(2,\)'),
        ({'choices': np.zeros((3, 2))}, r'weight_2: has shape \(5, 2\); expected \(5, 3\)'),
        ({'choices': np.zeros((2, 3))}, r'choices: has shape \(2, 3\); expected \(2, 2\)'),
        ({'choices': np.full((2, 2), 1.5)}, r'choices: expected at least one action, in \[-1, 1'),
        ({'largest_change': 0.3}, 'largest_change: expected choices, and outputs that change them'),
        ({'choices': np.zeros((2, 2)), 'largest_change': 0.3},
         'largest_change: expected choices, and outputs that change them'),
        ({'largest_change': 0.0}, 'largest_change: expected a positive number; got 0.0'),
        ({'largest_change': [0.3]}, r'largest_change: has shape \(1,\); expected \(\)'),
    )  # fmt: skip
    def test_malformed_fields_are_rejected(self, changes, message):
        with self.assertRaisesRegex(ValueError, message):
            make(**changes)

    @parameterized.parameters(
        (make_convolving, {'strides': ()}, 'strides: 0 layers with 2 weights and 2 biases'),
        (make_convolving, {'strides': (2, 0)}, 'filter_1: 5 of width 2 and stride 0 on 4 positions'),
        (make_convolving, {'line': 2}, 'filter_0: 4 of width 3 and stride 2 on 2 positions'),
        (make_convolving, {'weights': [np.zeros((3, 1, 4)), np.zeros((2, 3, 5))]}, 'filter_1: has sh'),
        (make_convolving, {'weights': [np.zeros((3, 4)), np.zeros((2, 4, 5))]}, 'filter_0: has shape'),
        (make_convolving, {'biases': [np.zeros(4), np.zeros(4)]}, r'filter_bias_1: .* expected \(5,'),
        (make_convolving, {'origin': 13}, 'origin: is 13; expected a number of 0 to 12'),
        (make_convolving, {'line': 14}, 'line: has 14 of 13 inputs'),
        (make_convolving, {'line': 8}, r'weight_0: has shape \(19, 6\); expected \(15, 6\)'),
        (make_convolving, {'line': 60_000, 'weights': [np.zeros((3000, 1, 4)), np.zeros((2, 4, 5))]},
         r'filter_0: its windows have 8.55e\+07 numbers in all; expected at most 1e\+06'),
        (make_seeing, {'grid': (7, 6)}, r'grid: \(7, 6\) does not divide 60 inputs'),
        (make_seeing, {'grid': (2**40, 2**40)}, r'grid: \(\d+, \d+\) does not divide'),
        (make_seeing, {'grid': (60,)}, r'grid: \(60,\) does not divide'),
        (make_seeing, {'grid': (0, 6)}, r'grid: \(0, 6\) does not divide'),
        (make_seeing, {'grid': (5, 12)}, r'filter_0: has shape .*; expected \(2, 3, 1, 4\)'),
        (make_seeing, {'grid': (30, 1)}, r'filter_0: 4 of width 2 x 3 and stride 2 on 30 x 1 pos'),
    )  # fmt: skip
    def test_malformed_convolutions_are_rejected(self, made, changes, message):
        policy = made()
        with self.assertRaisesRegex(ValueError, message):
            line = dataclasses.replace(policy.convolution, **changes)
            dataclasses.replace(policy, convolution=line)

    def test_arrays_are_read_only_copies(self):
        mean = np.zeros(7)
        policy = make(mean=mean)
        mean[:] = 1
        np.testing.assert_array_equal(policy.mean, 0)
        for array in (policy.mean, policy.std, policy.log_std, *policy.weights, *policy.biases):
            with self.assertRaisesRegex(ValueError, 'read-only'):
                array[...] = 0


class CheckTest(absltest.TestCase):
    def test_environments_that_do_not_fit_are_rejected(self):
        environment = suite.make(GAPS, {'random': 0})
        blocks = [(name, part.stop - part.start) for name, part in environment.blocks.items()]
        names = environment.action_map.names
        policy = make(blocks=blocks, actions=names)
        policy.check(environment)
        policy.check(VectorEnvironment(GAPS, 2, 1))
        for fields, message in (
            ({'blocks': blocks[1:]}, 'observes pose .*gives terrain 50, pose'),
            ({'blocks': [*blocks[1:], blocks[0]]}, 'observes pose .*gives terrain 50, pose'),
            ({'blocks': [('terrain', 49), *blocks[1:]]}, 'observes terrain 49, .*gives terrain 50, '),
            ({'actions': [*names[1:], names[0]]},
             f'sets .* of {names[1]}, .*takes .* of {names[0]}, '),
            ({'quantity': 'torque'}, 'sets the torque of .*takes the target angle of'),
        ):  # fmt: skip
            with self.assertRaisesRegex(ValueError, message):
                make(**{'blocks': blocks, 'actions': names, **fields}).check(environment)


NEEDED = *files._FIELDS, *(f'{kind}_{i}' for kind in ('weight', 'bias') for i in range(3))


class FileTest(FolderTest):
    @parameterized.parameters(
        lambda: make(clip=0.1),
        lambda: make(
            places=np.array([[3, 1]]), columns=np.array([0, 2, 8]), mean=np.zeros(3), std=np.ones(3),
            weights=[np.ones((3, 6))], biases=[np.arange(6)], largest_change=0.3,
            choices=np.random.default_rng(0).uniform(-1, 1, (4, 2)),
        ),
        lambda: make_convolving(layer_norm=True), lambda: make_convolving(origin=None),
        lambda: policies.ensemble([make_convolving(layer_norm=True)] * 3), make_seeing,
        lambda: policies.ensemble([make_seeing()] * 2),
    )  # fmt: skip
    def test_round_trip_is_exact(self, made):
        policy, path = made(), self.folder / 'p.npz'
        with self.assertRaisesRegex(FileNotFoundError, 'p.npz'):
            policies.load(path)
        policies.save(policy, path)
        self.assert_only('p.npz')
        observations = np.random.default_rng(1).normal(size=(9, policy.observation_size))
        for again in (policies.load(path), policies.load(str(path))):
            for one, other in ((policy, again), (policy.convolution, again.convolution)):
                for field in dataclasses.fields(one) if one is not None else ():
                    if field.name not in ('convolution', 'mirror'):
                        ours, theirs = (getattr(each, field.name) for each in (one, other))
                        np.testing.assert_equal(theirs, ours, field.name)
            self.assertEqual({array.dtype for array in again.weights}, {np.dtype(np.float32)})
            np.testing.assert_array_equal(again(observations), policy(observations))
        # The same policy is the same file.
        policies.save(policies.load(path), self.folder / 'q.npz')
        self.assertEqual(path.read_bytes(), (self.folder / 'q.npz').read_bytes())

    def test_the_format(self):
        policies.save(make(), self.folder / 'p.npz')
        with np.load(self.folder / 'p.npz', allow_pickle=False) as data:
            arrays = dict(data)
        layers = (f'{kind}_{i}' for kind in ('weight', 'bias') for i in range(3))
        self.assertCountEqual(arrays, {*files._FIELDS, *layers})
        page = (pathlib.Path(__file__).parents[1] / 'trained/README.md').read_text()
        for name in (*files._FIELDS, *files._OPTIONAL, *files._LINE, *files._LINE_OPTIONAL):
            self.assertIn(f'`{name}`', page)
        self.assertEqual((str(arrays['format']), int(arrays['version'])), ('trl_suite policy', 1))
        self.assertEqual(json.loads(str(arrays['info'])), make().info)
        for name, array in arrays.items():
            self.assertIn(array.dtype.kind, 'Uif', name)
            if array.dtype.kind == 'f':
                self.assertIn(array.dtype, (np.float32, np.float16))

    def test_values_exact_in_half_precision_are_written_so(self):
        exact = [weight.astype(np.float16) for weight in make().weights]
        finer = np.full_like(make().biases[0], 1 + 2**-12)
        policy = make(weights=exact, biases=[finer, *make().biases[1:]])
        path = self.folder / 'p.npz'
        policies.save(policy, path)
        with np.load(path, allow_pickle=False) as data:
            self.assertEqual(data['weight_0'].dtype, np.float16)
            self.assertEqual(data['bias_0'].dtype, np.float32)
        for name in ('weights', 'biases'):
            ours, theirs = (getattr(each, name) for each in (policies.load(path), policy))
            for array, expected in zip(ours, theirs, strict=True):
                self.assertEqual(array.dtype, np.float32)
                np.testing.assert_array_equal(array, expected)

    def test_an_old_file_stays_until_the_new_one_is_complete(self):
        path = self.folder / 'p.npz'
        policies.save(make(0), path)
        before = path.read_bytes()
        with (
            mock.patch.object(np, 'savez_compressed', side_effect=OSError('disk full')),
            self.assertRaisesRegex(OSError, 'disk full'),
        ):
            policies.save(make(1), path)
        self.assertEqual(path.read_bytes(), before)
        self.assert_only('p.npz')
        with self.assertRaisesRegex(ValueError, "suffix '.pkl'; expected .npz"):
            policies.save(make(), self.folder / 'p.pkl')
        with self.assertRaisesRegex(FileNotFoundError, 'does not exist'):
            policies.save(make(), self.folder / 'none' / 'p.npz')
        with (
            mock.patch.object(files, 'LARGEST', 100),
            self.assertRaisesRegex(ValueError, 'expected no more'),
        ):
            policies.save(make(), self.folder / 'q.npz')
        self.assert_only('p.npz')

    def test_truncated_or_damaged_or_no_archive(self):
        path = self.folder / 'p.npz'
        policies.save(make(), path)
        whole = path.read_bytes()
        single = io.BytesIO()
        np.save(single, np.zeros(3))
        for content in (whole[:-1], whole[: len(whole) // 2], b'', b'text', single.getvalue()):
            path.write_bytes(content)
            with self.assertRaisesRegex(ValueError, 'p.npz: no readable policy'):
                policies.load(path)
        with zipfile.ZipFile(io.BytesIO(whole)) as archive:
            damaged = bytearray(whole)
            start = archive.getinfo('weight_1.npy').header_offset
        damaged[start + 120] ^= 0xFF
        path.write_bytes(damaged)
        with self.assertRaisesRegex(ValueError, "p.npz: field 'weight_1'"):
            policies.load(path)

    @parameterized.parameters(
        ({'format': 'clip'}, "'format': is 'clip'; expected 'trl_suite policy'"),
        ({'version': 2}, "'version': is 2; expected 1"),
        ({'version': '1'}, "'version': has type <U1 and 0 axes"),
        ({'id': np.zeros(2)}, "'id': has type float64 and 1 axes"),
        ({'actions': np.array(['hip', 'knee'], object)}, "'actions': Object arrays cannot"),
        ({'weight_0': np.array([[None]])}, "'weight_0': Object arrays cannot"),
        ({'weight_0': np.zeros((2, 7, 6))}, r"'weight_1': has type float\d+ and 2 axes"),
        ({'weight_0': np.zeros(7)}, "'weight_0': has type float64 and 1 axes"),
        ({'weight_0': np.zeros((7, 6), int)}, "'weight_0': has type int64 and 2 axes"),
        ({'block_sizes': np.array([3, 5])}, r'mean: has shape \(7,\); expected \(8,\)'),
        ({'block_sizes': np.array([7])}, r'zip\(\) argument 2 is shorter'),
        ({'layers': 2}, "'layers': is 2, but there are arrays of other layers"),
        ({'layers': 10**15}, "'weight_3': is missing"),
        ({'layers': -1}, "'layers': is 0, but there are arrays of other layers"),
        ({'other': 1}, "'other': is unknown"),
        ({'info': '{'}, "'info': Expecting"),
        ({'line': None}, "'line': is missing", make_convolving),
        ({'strides': np.array([2, 1, 1])}, "'filter_2': is missing", make_convolving),
        ({'strides': np.array([2])}, "'filter_1': is unknown", make_convolving),
        ({'filter_bias_1': None}, "'filter_bias_1': is missing", make_convolving),
        ({'filter_0': np.zeros((3, 4))}, "'filter_0': has type float64 and 2 axes", make_convolving),
        ({'origin': 0.5}, "'origin': has type float64", make_convolving),
        ({'layer_norm': 2}, "'layer_norm': is 2; expected 1", make_convolving),
        ({'grid': np.array([7, 6])}, 'grid: .* does not divide', make_seeing),
        *(({name: None}, f'{name}.*missing') for name in NEEDED),
    )  # fmt: skip
    def test_invalid_arguments_are_rejected(self, changes, message, made=make):
        with self.assertRaisesRegex(ValueError, f'p.npz: .*{message}'):
            self.load_with(made(), **changes)

    @parameterized.parameters(
        ('relu', 1e30, False, r'weight_\d: is too large: sums may reach \S+e\+(6|9)\d'),
        ('elu', 1e30, False, 'weight_1: is too large'), ('tanh', 1e30, False, None),
        ('tanh', 3e38, False, 'weight_0: is too large'), ('tanh', 1e30, True, 'weight_0: is too'),
        ('relu', 1e15, True, None),
    )  # fmt: skip
    def test_weights_so_large_that_actions_are_nan(self, activation, size, layer_norm, message):
        with self.assertRaisesRegex(ValueError, 'filter_1: is too large'):
            make_convolving(size=1e30, activation='relu')
        shapes = (7, 6), (6, 5), (5, 2)
        weights = [np.where(np.indices(shape).sum(0) % 2, size, -size) for shape in shapes]
        fields = {'weights': weights, 'activation': activation, 'layer_norm': layer_norm}
        if message is not None:
            with self.assertRaisesRegex(ValueError, message):
                make(**fields)
            return
        observations = np.random.default_rng(0).normal(0, 1e6, (50, 7))
        self.assertTrue(np.isfinite(make(**fields)(observations)).all())

    def load_with(self, policy, **changes):
        """Loads a file with some fields changed, or left out where None."""
        policies.save(policy, self.folder / 'p.npz')
        with np.load(self.folder / 'p.npz') as data:
            fields = {**data, **changes}
        kept = {name: value for name, value in fields.items() if value is not None}
        np.savez(self.folder / 'p.npz', **kept)
        return policies.load(self.folder / 'p.npz')


class ReferenceTest(FolderTest):
    def setUp(self):
        super().setUp()
        directory = resources.directory
        self.enterContext(
            mock.patch.object(
                resources, 'directory',
                lambda kind: self.folder if kind == 'trained' else directory(kind),
            )
        )  # fmt: skip

    def save(self, id_, variant='', name=None, **changes):
        (self.folder / variant).mkdir(exist_ok=True)
        policies.save(make(id=id_, **changes), self.folder / variant / f'{name or id_}.npz')

    def share(self, id_, variant='', **entry):
        text = json.dumps({id_: {**entry, 'evaluation': {}}})
        (self.folder / variant / policies.SHARED).write_text(text)

    def test_by_id_and_alias(self):
        self.assertEqual(policies.available(), ())
        with self.assertRaisesRegex(FileNotFoundError, f"for '{GAPS}'; none is installed"):
            policies.reference(GAPS)
        for id_ in (DOG, GAPS):
            self.save(id_)
        self.assertEqual(policies.available(), (GAPS, DOG))
        self.assertEqual(policies.reference(DOG).id, DOG)
        for id_ in (DOG, 'plaid/dog_gaps'):
            self.assertEqual(suite.reference_policy(id_).id, DOG)
            self.assertEqual(trl_suite.reference_policy(id_).id, DOG)
        for id_ in (3, None, [GAPS]):
            with self.assertRaisesRegex(TypeError, 'the id of an environment is a string, not '):
                policies.reference(id_)
        with self.assertRaisesRegex(FileNotFoundError, f'closest ids with a policy: {DOG}, {GAPS}'):
            policies.reference('PD_Dog2D_Steps_Terrain-v0')
        self.save('other', name='PD_Dog2D_Steps_Terrain-v0')
        assert_refused(
            self,
            (lambda: suite.reference_policy('x'), "unknown environment 'x'"),
            (lambda: suite.reference_policy('plaid/dog_gap'), "did you mean 'plaid/dog_gaps'"),
            (lambda: policies.reference('PD_Dog2D_Steps_Terrain-v0'),
             "PD_Dog2D_Steps_Terrain-v0.npz: field 'id': is 'other'"),
        )  # fmt: skip

    def test_a_policy_of_another_environment(self):
        steps = 'PD_Dog2D_Steps_Terrain-v0'
        self.save(DOG)
        self.share(steps, policy=DOG)
        self.assertEqual(policies.available(), (DOG, steps))
        own, other = map(policies.reference, (DOG, steps))
        self.assertEqual((own.id, other.id), (DOG, steps))
        self.assertEqual([policies.trained_for(id_) for id_ in (DOG, steps)], [DOG, DOG])
        np.testing.assert_array_equal(own.weights[0], other.weights[0])

    def test_a_policy_that_prefers_the_default_gait(self):
        raptor, slopes = 'FSM_Raptor2D_Terrain_Mixed-v0', 'FSM_Raptor2D_Terrain_Slopes-v0'
        self.save(raptor, choices=[[0.5, 0], [0, 0]])
        self.share(slopes, policy=raptor, preference=1.5)
        self.assertEqual(list(map(policies.preference_for, (raptor, slopes))), [0.0, 1.5])
        own, other = map(policies.reference, (raptor, slopes))
        np.testing.assert_allclose(other.biases[-1], own.biases[-1] + [0, 1.5], rtol=1e-6)

    def test_variants_are_in_folders_of_their_own(self):
        """A generalist is the policy of several environments."""
        mixed = 'PD_Dog2D_Mixed_Terrain-v0'
        self.save(DOG)
        self.assertEqual(policies.available('randomized'), ())
        with self.assertRaisesRegex(FileNotFoundError, f"no randomized .* shipped for '{DOG}'"):
            policies.reference(DOG, 'randomized')
        self.save(DOG, 'randomized', info={'seed': 7})
        self.save(mixed, 'generalist', info={'seed': 8})
        self.share(DOG, 'generalist', policy=mixed)
        for variant, ids, seed in (('randomized', (DOG,), 7), ('generalist', (DOG, mixed), 8)):
            self.assertEqual(policies.available(variant), ids)
            for found in (
                policies.reference(DOG, variant), suite.reference_policy('plaid/dog_gaps', variant),
            ):  # fmt: skip
                self.assertEqual((found.id, found.info), (DOG, {'seed': seed}))
        self.assertEqual(policies.available(), (DOG,))
        self.assertNotIn(policies.reference(DOG).info['seed'], (7, 8))
        with self.assertRaisesRegex(ValueError, "variant of policies 'random'.*'randomized'"):
            policies.reference(DOG, 'random')


class ShippedTest(parameterized.TestCase):
    """`environment_test.py` checks that each fits its environment."""

    def test_files_are_small(self):
        self.assertNotEmpty(paths := [*resources.directory('trained').glob('*.npz')])
        for path in paths:
            networks = len(policies.load(path).networks)
            self.assertLess(path.stat().st_size, networks * MAX_BYTES, path.name)

    def test_no_file_is_of_an_unknown_environment(self):
        folder = resources.directory('trained')
        names = {path.stem for path in folder.iterdir() if path.suffix in ('.npz', '.json')}
        studies = {
            'footsteps', 'default_gaits', 'foresight', 'oracles', 'oracle_falls', 'plans', 'ramps', 'shared',
            'stairs', 'transfer',
        }  # fmt: skip
        self.assertEqual(names - set(catalogue.BY_ID) - studies, set())
        self.assertTrue((folder / 'README.md').exists())

    def test_every_planar_environment_that_tracks_a_clip_has_one(self):
        specs = [spec for spec in catalogue.SPECS if spec.task_type == 'planar_imitation']
        ids = [spec.id for spec in specs if 'planar' in spec.tags]
        self.assertLen(ids, 42)
        self.assertContainsSubset(ids, policies.available())

    @parameterized.parameters(
        *(id_ for id_ in policies.available() if catalogue.BY_ID[id_].domain == 'plaid')
    )
    def test_walkers_that_do_not_fall_advance(self, id_):
        """A policy that stands still in front of a wall until the time limit is not shipped."""
        entry = json.loads((resources.directory('trained') / f'{id_}.json').read_text())
        found = next(run for run in entry['runs'] if run['seed'] == entry['shipped'])['evaluation']
        full = np.equal(found['lengths'], found['step_limit'])
        distances = np.array(found['distances'])[full]
        clip = motion.load(catalogue.BY_ID[id_].clip)
        whole = clip.speed * found['step_limit'] / 30  # m; as the clip goes
        self.assertGreater(np.median(distances), 0.7 * whole)
