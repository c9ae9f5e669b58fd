"""Every command of the command line: its output, its files, and its errors."""

import dataclasses
import functools
import json
import os
import pathlib
import re
import shlex
import signal
import subprocess
import sys
import textwrap
import threading
from unittest import mock

import imageio.v3 as iio
import numpy as np
import pytest
from absl.testing import parameterized
from helpers import KINDS, besides_notices
from programs import GAPS, CommandTest, policy_for, run

import trl_suite
from trl_suite import evaluation, policies, rendering, suite
from trl_suite.cli import list as listing
from trl_suite.cli import rollout
from trl_suite.environments import named_policies
from trl_suite.registry import catalogue
from trl_suite.tasks.gait.task import GaitTask
from trl_suite.tasks.navigation import scripted
from trl_suite.util import compiled, resources

SIZE = ('--size', '160x120')


@functools.cache
def info(id_):
    """Output of `trl-suite info` for an environment, which it has to build."""
    status, out, err = run('info', id_)
    assert (status, err) == (0, '')
    return out


class ListTest(CommandTest):
    def test_lists_everything_on_one_line_each(self):
        lines = self.output('list').splitlines()
        self.assertEqual(lines[-1], f'{len(suite.ALL_IDS)} environments')
        self.assertLen(lines, len(suite.ALL_IDS) + 2)
        self.assertEqual([line.split()[0] for line in lines[1:-1]], list(suite.ALL_IDS))
        listed = [tuple(line.split()[1].split('/')) for line in lines[1:-1]]
        self.assertEqual(listed, list(suite.ALL_TASKS))
        for line, spec in zip(lines[1:-1], catalogue.SPECS, strict=True):
            self.assertEndsWith(line, spec.description)

    @parameterized.parameters(
        ('--domain plaid', (' plaid/',)),
        ('--actuation gait', (' gait ',)),
        ('--character raptor', (' | raptor ',)),
        ('--terrain gaps_humanoid', (' gaps_humanoid ',)),
        ('--tag original', (' original ',)),
        ('--domain plaid --character dog --tag original', (' plaid/', ' | dog ', ' original ')),
        (
            '--domain plaid --terrain flat --character dog --tag blind',
            (' plaid/', ' flat ', ' | dog ', ' blind '),
        ),
        ('--actuation muscle --domain plaid', (' muscle ', ' plaid/')),
    )
    def test_filters(self, filters, parts):
        """Compared with the lines of environments.txt that have all parts."""
        reviewed = pathlib.Path(__file__).with_name('environments.txt').read_text().splitlines()
        found = [line.split()[0] for line in reviewed if all(part in line for part in parts)]
        lines = self.output('list', *filters.split()).splitlines()
        self.assertEqual(lines[-1], f'{len(found)} environment{"s" * (len(found) != 1)}')
        self.assertCountEqual([line.split()[0] for line in lines[1:-1]], found)

    def test_trained_lists_environments_with_a_policy(self):
        lines = self.output('list', '--trained', '--domain', 'plaid').splitlines()
        shipped = {id_ for id_ in policies.available() if suite.find(id_).domain == 'plaid'}
        self.assertEqual({line.split()[0] for line in lines[1:-1]}, shipped)

    @parameterized.parameters(
        ('--domain', 'plad', "unknown domain 'plad'; did you mean 'plaid'"),
        ('--terrain', 'gap_humanoid', "did you mean 'gaps_humanoid'"),
        ('--tag', 'xyz', "unknown tag 'xyz'; known: addition, blind"),
    )
    def test_unknown_values(self, name, value, message):
        self.assert_refused(message, 'list', name, value)


MUSCLE, DOG, RAPTOR, HOPPER = (
    'MTU_Biped2D_LLC_Imitate_Flat-v0', 'FSM_Dog2D_Terrain_Gaps-v0', 'FSM_Raptor2D_Terrain_Gaps-v0',
    'FSM_Hopper2D_Terrain_Gaps-v0',
)  # fmt: skip
STEP, STAIRS, MOVERS, SOCCER = (
    f'PD_Biped3D_{name}-v0'
    for name in ('LLC_General_Step', 'Imitate-Stairs', 'HLC_DynamicsObstacles', 'HLC_Soccer')
)
FACTS = {
    GAPS: """Observation: 104 numbers | terrain 0 50 50 m | phase 99 104 5 | 49 kg
        | Action: 11 numbers in [-1, 1]; target angle in rad | right_knee -0.4124 1.5 125
        | right_knee 2.5 -3 to 0 125 200 20 0.3 | GapWMin 0.25, GapWMax 0.3 | period 1 s, 1.5 m/s
        | control 30 Hz, physics 300 Hz | 256 steps, 8.53 s | randomize='harsh': | terrain_dropout
        | terrain m 0.02 0.06 0.12""",
    MUSCLE: """Action: 16 numbers in [-1, 1]; excitation = action_offset
        | right_VAS 0.505 0.495 6000 | strain 29 45 16""",
    DOG: """hip 2.9 -0.96 to 2.18 300 130 13 the world | knee 2 -3.14 to 0 300 50 5 its parent
        | Extend finger touches the ground | Parameters: 30, of which an action sets 29
        | 1 bound 0.67, slow_bound 0.33 | fixed: TransTime 0.125 s | Observation: 283 numbers
        | terrain 0 200 200 m | velocity 241 283 42 | Action: 29 numbers in [-1, 1]; gait parameter
        | BackForceX 378.3 432.7 N | Gather.Ankle 0.9304 1.547 rad joint target | speed 0.8 0.5
        | stumble 0.2 1 / (1 + 10 s) | target speed: 4 m/s | toe, finger, ankle, wrist
        | touches the ground in 4 consecutive samples | is more than 144 degrees
        | less than 0.5 m in 5 s | one cycle, at most 1.67 s; control 600 Hz, physics 1200 Hz
        | after 5000 steps""",
    RAPTOR: """Contact.SpineCurve 0 | action 0 is base action 1 | 0 if the speed is negative
        | the stance leg first""",
    HOPPER: """hip 0.2 -1.57 to 1.57 2500 200 20 the world
        | leg 0.2 -0.2 to 0.2 m 180 N 1000 N/m 20 N s/m its parent | target speed: 3 m/s
        | Ascent.Hip 0.5132 0.3804 rad joint target | Ascent.Knee -0.7777 0.02208 m joint target
        | MagicGain 0.8405 0.05996 1 | speed 1 0.5 | is replaced by the pitch of the root""",
    STEP: """Observation: 125 numbers | pose 0 57 57 | velocity 57 105 48 | phase 105 110 5
        | contact 110 112 2 | plan 112 125 13 | Action: 17 numbers in [-1, 1]; target rotation vector
        | torso_x 0 1 200 | left_knee -0.4 | right_hip 4.5 ball, up to 2.57 200 300 30 0.5 | 42 kg
        | heading 0.09524 | end_effector 0.1905 5 m^2 | com 0.09524 10 m^2/s^2
        | one of root, torso touches the ground | steps 0.5 m long, feet 0.15 m apart
        | N(0, 0.25) rad | physics 300 Hz""",
    STAIRS: """Observation: 112 numbers | goal 110 112 2 rad, m bearing | StepHeightMax 0.12
        | Terrain: stairs3d (var3d_stairs) | period 1 s, 1.2 m/s""",
    MOVERS: """Observation: 2155 numbers | surface 0 2048 2048 | pose 2048 2105 57
        | velocity 2105 2153 48 | goal 2153 2155 2 | Action: 5 numbers in [-1, 1]; footstep plan
        | first_x 0.5 1 m; | second_y 0 2 m; | turn 0 3.142 rad; | speed 0.8 exp(-1.5 min(0, v - t
        | upright 0.2 1 | up to 12 m from the origin | no obstacle or belt within 1 m
        | drawn up to 12 m | no obstacle or belt within 0.25 m; | within 1 m of it, or after 50 to
        | touches the ground in 4 consecutive samples | a step is 0.5 s | 400 steps, 200 s
        | 'PD_Biped3D_LLC_General_Step-v0';""",
    SOCCER: """Observation: 116 numbers | ball 107 116 9 | distance of the goal from the ball
        | a ball of radius 0.2 m and 0.1 kg is placed 0.7 to 10 m from | approach 0.1667 exp(-
        | near 0.1667 exp(- | dribble 0.3333 exp(- | goal 0.3333 exp(- | within 0.5 m of the goal""",
}
GAITS, PLANS, WALKS = (DOG, RAPTOR, HOPPER), (MOVERS, SOCCER), (GAPS, MUSCLE)
DIFFERENCES = {
    'rigid tendons': (MUSCLE,), 'exactly vertical': (GAPS, *GAITS), 'control at 600 Hz': GAITS,
    'applied at touch-down': (HOPPER,), 'base action 1': (RAPTOR,), 'ends with its cycle': GAITS,
    'not registered in the original': (), 'one cone': (STEP, STAIRS, *PLANS),
    'rotation vectors': (STEP, STAIRS), 'the clip was made for this suite': (*WALKS, STAIRS),
    '27 reference steps': (STEP,), 'treads': (STAIRS,), 'armature of 2000 kg': (MOVERS,),
    'whole footstep': PLANS, 'ball and goal have expired': (SOCCER,),
    'a goal is reached or has expired': (MOVERS,), 'Bullet at 1200 Hz': (STEP, SOCCER),
    'after 256 steps (discount 1)': (*WALKS, STEP, STAIRS),
    'after 5000 cycles (discount 1)': GAITS, 'truncated after 200 s': PLANS,
}  # fmt: skip


class InfoTest(CommandTest):
    @parameterized.parameters(*FACTS)
    def test_facts(self, id_):
        """Sizes, limits and rules are those of the original's files."""
        text = ' '.join(info(id_).split())
        for fact in FACTS[id_].strip().split(' | '):
            self.assertIn(' '.join(fact.split()), text)

    @parameterized.parameters(*DIFFERENCES)
    def test_only_the_differences_that_apply(self, difference):
        told = (id_ for id_ in FACTS if difference in info(id_).partition('\nDifferences')[2])
        self.assertCountEqual(told, DIFFERENCES[difference])

    def test_an_alias_gives_the_same_text(self):
        self.assertEqual(self.output('info', 'plaid/biped_gaps'), self.output('info', GAPS))

    def test_unknown_ids_suggest_the_closest(self):
        self.assert_refused("did you mean 'PD_Biped2D_Gaps_Terrain-v0'", 'info', GAPS[:-1])
        self.assert_refused("did you mean 'plaid/dog_gaps'", 'info', 'plaid/dog_gap')


class RolloutTest(CommandTest):
    @parameterized.parameters('random', 'zero', 'clip')
    def test_trajectory_equals_that_of_the_environment(self, policy):
        steps = 100
        out = self.output(
            'rollout', GAPS, '--seed', '3', '--steps', str(steps), '--policy', policy,
            '--trajectory', 'a.npz',
        )  # fmt: skip
        self.assert_only('a.npz')
        with np.load('a.npz') as data:
            t = dict(data)
        self.assertEqual((str(t['id']), int(t['seed'])), (GAPS, 3))
        episodes = int((t['step_types'] == 0).sum())
        self.assertGreater(episodes, 1)  # it continued after ends of episodes
        self.assertEqual(t['observations'].shape, (steps + episodes, 104))
        self.assertEqual((len(t['rewards']), t['qpos'].shape[1]), (steps + episodes, 14))
        ends = np.flatnonzero(t['step_types'] == 2)
        np.testing.assert_array_equal(t['actions'][[*ends, -1]], 0)  # there is no action

        # The recorded actions lead a fresh environment through the recorded states, bit for bit.
        environment = suite.make(GAPS, {'random': 3})
        action = np.zeros(11)
        for i in range(len(t['rewards'])):
            time_step = environment.step(action)
            observation = np.concatenate(list(time_step.observation.values()))
            np.testing.assert_array_equal(observation, t['observations'][i])
            np.testing.assert_array_equal(environment.physics.data.qpos, t['qpos'][i])
            self.assertEqual(int(time_step.step_type), t['step_types'][i])
            if not time_step.first():
                ours = time_step.reward, time_step.discount
                self.assertEqual(ours, (t['rewards'][i], t['discounts'][i]))
            action = t['actions'][i]
            if policy == 'clip' and time_step.mid() and i + 1 < len(t['rewards']):
                expected = np.clip(environment.task.clip_action(0), -1, 1)
                np.testing.assert_array_equal(action, expected)

        total = t['rewards'].sum()
        text = f'{steps} steps in {episodes} episodes: return {total:.2f}, {total / steps:.3f} per'
        self.assertIn(f'\n{text}', out)
        starts = np.flatnonzero(t['step_types'] == 0)
        lengths = np.diff([*starts, len(t['rewards'])]) - 1
        for i, length in enumerate(lengths[: rollout.SHOWN_EPISODES], 1):
            end = 'unfinished' if i == episodes and t['step_types'][-1] != 2 else 'fell'
            self.assertRegex(out, rf'\n +{i} +{length} +[\d.]+ +-?[\d.]+ +{end}\n')

    def test_options_of_the_task(self):
        self.output(
            'rollout', GAPS, '--seed', '3', '--steps', '2', '--trajectory', 'a.npz', '--option',
            'randomize=harsh', '--option', 'sensors={"noise": 0.1}',
        )  # fmt: skip
        options = {'random': 3, 'randomize': 'harsh', 'sensors': {'noise': 0.1}}
        first = suite.make(GAPS, options, {'flat_observation': True}).reset()
        with np.load('a.npz') as data:
            np.testing.assert_array_equal(
                data['observations'][0], first.observation['observations']
            )

    def test_a_truncated_episode(self):
        def short(id_, task_kwargs):
            return suite.build('raptor', task_kwargs={**task_kwargs, 'step_limit': 3})

        with mock.patch.object(suite, 'make', short):
            out = self.output('rollout', 'imitation/pd_raptor', '--steps', '6', '--policy', 'clip')
        episodes = out.splitlines()[1:-1]
        self.assertLen(episodes, 2)
        for i, line in enumerate(episodes, 1):
            self.assertRegex(line, rf'^ +{i} +3 +[\d.]+ +[\d.]+  truncated$')

    def test_steps_are_kept_for_a_trajectory_only(self):
        """A rollout of any length takes the same memory."""
        environment = suite.make(GAPS, {'random': 0})
        for keep in (False, True):
            record = rollout._Record(environment, keep)
            record.add(environment.reset(), np.zeros(11))
            self.assertLen(record._rows, keep)

    def test_many_episodes_are_summarised(self):
        out = self.output('rollout', GAPS, '--steps', '600', '--seed', '1')
        lines = out.splitlines()
        self.assertLen(lines, rollout.SHOWN_EPISODES + 3)
        self.assertRegex(lines[-2], r'^\.\.\. and \d+ more$')

    def test_pictures(self):
        self.output(
            'rollout', GAPS, '--steps', '60', '--policy', 'clip', '--video', 'a.mp4', '--strip',
            'a.png', '--columns', '5', '--ghost', *SIZE,
        )  # fmt: skip
        self.assert_only('a.mp4', 'a.png')
        meta = iio.immeta('a.mp4', plugin='FFMPEG')
        self.assertEqual((meta['size'], meta['fps']), ((160, 120), 30.0))
        frames = iio.imread('a.mp4', plugin='FFMPEG')
        self.assertGreaterEqual(len(frames), 61)  # every state, starts included
        strip = iio.imread('a.png')
        self.assertEqual(strip.shape, (120, 5 * 160 + 4 * rendering.STRIP_MARGIN, 3))
        # The first picture of the strip is the first of the video; compression blurs the latter.
        difference = np.abs(strip[:, :160].astype(int) - frames[0])
        self.assertLess(difference.mean(), 4)

    @parameterized.parameters(
        ('FSM_Raptor2D_Terrain_Slopes-v0', 'zero', lambda _: lambda seen: np.zeros((1, 28))),
        ('PD_Biped3D_HLC_PathFollowing-v0', 'scripted', scripted.scripted),
    )
    def test_long_steps_in_real_time(self, id_, name, make_policy):
        out = self.output(
            'rollout', id_, '--steps', '4', '--policy', name, '--seed', '2', '--video', 'a.mp4',
            '--strip', 'a.png', '--trajectory', 'a.npz', *SIZE,
        )  # fmt: skip
        self.assertRegex(out, r'\n4 steps in 1 episode: ')
        environment = suite.make(id_, {'random': 2}, {'flat_observation': True})
        policy, time_step = make_policy(environment), environment.reset()
        for _ in range(4):
            time_step = environment.step(policy(time_step.observation['observations'][None])[0])
        with np.load('a.npz') as trajectory:
            np.testing.assert_array_equal(trajectory['qpos'][-1], environment.physics.data.qpos)
        frames = iio.imread('a.mp4', plugin='FFMPEG')
        time = 30 * environment.physics.data.time
        self.assertLen(frames, 1 + (int(time) if name == 'zero' else round(time)))
        self.assertEqual(iio.imread('a.png').shape[1], 5 * 160 + 4 * rendering.STRIP_MARGIN)

    @parameterized.parameters('fell', 'stuck')
    def test_ends_of_episodes_of_gaits_are_named(self, end):
        def fail(task, env_ids, finish=GaitTask.finish_step):
            finish(task, env_ids)
            task.outcome.failed[:] = getattr(task.state, end)[:] = True

        with mock.patch.object(GaitTask, 'finish_step', fail):
            out = self.output('rollout', 'terrainrl/hopper_steps', '--steps', '1')
        self.assertRegex(out, rf'\n +1 +1 +\S+ +\S+  {end}\n')

    @parameterized.parameters(
        ('did you mean', 'PD_Biped2D_Gap_Terrain-v0'),
        ('the task HierarchicalNavigation has no reference clip', 'PD_Biped3D_HLC_Forest-v0', '--ghost',
         '--video', 'a.mp4', *SIZE),
        ('torque control cannot follow a clip', 'imitation/torque_dog', '--policy', 'clip',
         '--video', 'a.mp4'),
        ("suffix '.avi'; expected .mp4 or .gif", GAPS, '--video', 'a.avi'),
        ("suffix '.jpg'; expected .png", GAPS, '--strip', 'a.jpg'),
        ("suffix ''; expected .npz", GAPS, '--trajectory', 'a'),
        ("the folder 'no' does not exist", GAPS, '--trajectory', 'no/a.npz'),
        ("unknown camera 'sid'; did you mean 'side'", GAPS, '--video', 'a.mp4', '--camera', 'sid'),
        ('h264 needs even', GAPS, '--video', 'a.mp4', '--size', '161x121'),
        ("'big' is not a size such as 640x480", GAPS, '--size', 'big'),
        ('--size has no effect without --video or --strip', GAPS, '--html', 'a.html', *SIZE),
        ('--columns has no effect without --strip', GAPS, '--columns', '3'),
        ('--ghost has no effect without --video or --html or --strip', GAPS, '--ghost'),
        ("'0' is not a positive integer", GAPS, '--steps', '0'),
        ("'x' is not a positive integer", GAPS, '--steps', 'x'),
        ("unknown policy 'walk'; known: FILE.npz, clip, generalist, random, randomized, reference, scripted, zero", GAPS,
         '--policy', 'walk'),
        ('the task PlanarImitation has no scripted policy; goal_navigation and soccer have one', GAPS, '--policy',
         'scripted', '--video', 'a.mp4'),
        ('no such file', GAPS, '--policy', 'none.npz'),
        (r'random is -1; expected a seed in \[0', GAPS, '--seed', '-1'),
        ('required: ID', '--seed', '1'),
        ('unrecognized arguments: --sped 2', GAPS, '--sped', '2'),
        ("'randomize' is not NAME=JSON, such as randomize=robot", GAPS, '--option', 'randomize'),
        ('is not JSON', GAPS, '--option', 'sensors={"noise": 0.1'),
        ("did you mean 'randomize'", GAPS, '--option', 'randomise=robot'),
        ('terrain_level is 9', GAPS, '--option', f'terrain_level={"9" * 400}'),
        ('the seed is no option; use --seed', GAPS, '--option', 'random=1'),
        ("is not JSON: key 'friction' is given twice", GAPS, '--option', 'randomize={"friction": 1, "friction": 2}'),
        ('is not JSON', GAPS, '--option', f'sensors={"[" * 100_000}'),
        ('File name too long', GAPS, '--video', f'{"a" * 250}.mp4'),
    )  # fmt: skip
    def test_errors_leave_no_files(self, message, *arguments):
        self.assert_refused(message, 'rollout', *arguments)
        self.assert_only()

    @parameterized.parameters(
        (signal.SIGINT, 130, 'interrupted'), (signal.SIGTERM, 143, 'terminated')
    )
    def test_a_signal_leaves_nothing_behind(self, number, status, how):
        begun = threading.Event()

        def frames(*arguments):
            begun.set()
            return np.zeros((120, 160, 3), np.uint8)

        def end():
            begun.wait()
            os.kill(os.getpid(), number)

        thread = threading.Thread(target=end)
        thread.start()
        with mock.patch.object(rendering, 'frame', frames):
            found = run(
                'rollout', GAPS, '--video', 'a.mp4', '--trajectory', 'a.npz', '--steps', '1000000'
            )
        thread.join()
        self.assertEqual(found, (status, '', f'trl-suite: {how}\n'))
        self.assertEqual(signal.getsignal(signal.SIGTERM), signal.SIG_DFL)
        self.assert_only()


class TrainedTest(CommandTest):
    """Policies from a file or shipped."""

    def setUp(self):
        super().setUp()
        self.policy = policy_for(GAPS)
        policies.save(self.policy, 'mine.npz')

    def test_a_policy_file(self):
        self.output(
            'rollout', GAPS, '--steps', '40', '--policy', 'mine.npz', '--trajectory', 'a.npz'
        )
        with np.load('a.npz') as t:
            acted = t['step_types'] != 2
            acted[-1] = False
            self.assertGreater(acted.sum(), 30)
            expected = self.policy(t['observations'][acted])
            np.testing.assert_array_equal(t['actions'][acted], expected)

    def test_the_shipped_policy(self):
        pathlib.Path('mine.npz').rename(f'{GAPS}.npz')
        directory = resources.directory
        with mock.patch.object(
            resources,
            'directory',
            lambda kind: self.folder if kind == 'trained' else directory(kind),
        ):
            arguments = 'plaid/biped_gaps', '--steps', '30', '--policy'
            found = self.output('rollout', *arguments, 'reference')
            self.assertEqual(found, self.output('rollout', *arguments, f'{GAPS}.npz'))
            for command in ('rollout', 'evaluate'):
                self.assert_refused(
                    f"no policy is shipped for 'PD_Dog2D_Gaps_Terrain-v0'.*: {GAPS}",
                    command, 'PD_Dog2D_Gaps_Terrain-v0', '--policy', 'reference',
                )  # fmt: skip

    def test_evaluation_prints_and_writes(self):
        out = self.output(
            'evaluate', 'plaid/biped_gaps', '--policy', 'mine.npz', '--episodes', '5', '--seed', '3',
            '--threads', '1', '--json', 'a.json',
        )  # fmt: skip
        self.assert_only('mine.npz', 'a.json')
        expected = evaluation.evaluate(GAPS, self.policy, 5, 3)
        found = json.loads(pathlib.Path('a.json').read_text())
        more = {'policy': 'mine.npz', 'trl_suite': trl_suite.__version__}
        self.assertEqual(found, {**expected, **more})
        self.assertStartsWith(out, f'{GAPS}\n')
        for fact in (
            f'return {expected["return"]:.2f} +- {expected["return_interval"]:.2f} (95 % confidence)',
            f'{expected["normalized_return"]:.1%} of the maximum 256', 'episodes 5, seed 3',
            f'length {expected["length"]:.1f} of 256 steps', f'median {expected["median_distance"]:.2f} m',
            f'full length {expected["completion_rate"]:.0%} of', f'falls {expected["falls"]:.0%} of',
            f'made with trl_suite {trl_suite.__version__}, MuJoCo {expected["mujoco"]} on {expected["cpu"]}',
        ):  # fmt: skip
            self.assertIn(fact, ' '.join(out.split()))

    @parameterized.product(
        command=('rollout', 'evaluate'),
        refused=(
            (
                'observes terrain 50, .* the environment gives terrain 50, ',
                'plaid/dog_gaps',
                'mine',
            ),
            ('broken.npz: no readable', GAPS, 'broken'),
        ),
    )
    def test_a_policy_that_does_not_fit_is_refused(self, command, refused):
        message, id_, name = refused
        pathlib.Path('broken.npz').write_bytes(b'no')
        self.assert_refused(message, command, id_, '--policy', f'{name}.npz')


class EvaluateTest(CommandTest):
    @parameterized.parameters('clip', 'zero', 'random')
    def test_baselines_are_those_of_evaluation(self, name):
        out = self.output('evaluate', GAPS, '--policy', name, '--episodes', '2')
        expected = evaluation.evaluate(GAPS, named_policies.BASELINES[name], 2, factory=True)
        self.assertIn(f'  policy       {name}\n', out)
        self.assertIn(f'  return       {expected["return"]:.2f} +- ', out)

    def test_the_scripted_baseline(self):
        self.assert_refused('no scripted policy', 'evaluate', GAPS, '--policy', 'scripted')
        spec = dataclasses.replace(suite.find('PD_Biped3D_HLC_Forest-v0'), step_limit=5)
        with mock.patch.object(suite, 'find', lambda id_: spec):
            out = self.output('evaluate', spec.id, '--policy', 'scripted', '--episodes', '2')
        expected = evaluation.evaluate(spec, scripted.scripted, 2, factory=True)
        self.assertIn(f'  return       {expected["return"]:.2f} +- ', out)
        self.assertIn('of the maximum 5\n', out)

    def test_another_step_limit_and_one_episode(self):
        words = 'evaluate', GAPS, '--policy', 'clip', '--step-limit', '3', '--episodes', '1'
        out = self.output(*words)
        self.assertRegex(out, r'\n  length +3.0 of 3 steps\n')
        self.assertRegex(out, r'\n  return +[\d.]+, [\d.]+% of the maximum 3\n')  # no interval
        self.assertRegex(out, r'\n  distance +-?[\d.]+ m, median')
        self.output(*words[:-4], '--option', 'step_limit=2', '--episodes', '1', '--json', 'a.json')
        found = json.loads(pathlib.Path('a.json').read_text())
        self.assertEqual((found['options'], found['step_limit']), ({'step_limit': 2}, 2))

    @parameterized.parameters(
        ('did you mean', 'PD_Biped2D_Gap_Terrain-v0'),
        ("unknown policy 'walk'; known:", GAPS, '--policy', 'walk'),
        ('no such file', GAPS, '--policy', 'none.npz'),
        ("'0' is not a positive integer", GAPS, '--episodes', '0'),
        ('seed is -1; expected a whole', GAPS, '--policy', 'zero', '--seed', '-1'),
        ('num_threads is -1', GAPS, '--policy', 'zero', '--threads', '-1'),
        ('step_limit is given twice', GAPS, '--option', 'step_limit=3', '--step-limit', '2'),
        ("key 'levels' is given twice", GAPS, *2 * ('--option', 'levels=[0,3]')),
        ("the folder 'no' does not exist", GAPS, '--json', 'no/a.json'),
    )
    def test_errors_leave_no_files(self, message, *arguments):
        self.assert_refused(message, 'evaluate', *arguments)
        self.assert_only()


class CompileTest(CommandTest):
    def test_what_is_compiled_is_chosen(self):
        self.assert_refused('expected ids, or --all', 'compile')
        self.assert_refused('expected ids, or --all', 'compile', GAPS, '--all')
        self.assert_refused("did you mean .*'PD_Biped2D_Gaps", 'compile', GAPS, 'PD_Biped2D_Gap')
        with mock.patch.object(compiled, 'cache_folder', lambda: None):
            self.assert_refused('no folder in which compiled code can be kept', 'compile', GAPS)

    def test_all(self):
        with mock.patch.object(catalogue, 'SPECS', [suite.find(GAPS)]):
            self.assertRegex(
                self.output('compile', '--all'),
                f'^1 environment compiled in [0-9]+ s; the code is in {compiled.cache_folder()}\n$',
            )

    @parameterized.parameters(*(KINDS[i] for i in (1, 2, 3, 9, 14, 15)))  # with different steps
    @pytest.mark.slow
    def test_afterwards_nothing_is_compiled(self, id_):
        """Neither by the command nor in many steps, with falls, in another process."""
        begin = f"""
            import sys
            import numpy as np
            from numba.core import event
            from trl_suite import cli, suite, vector
            with event.install_recorder('numba:compile') as found:
                assert cli.main(['compile', {id_!r}]) == 0
        """
        end = """
            print(sorted({item.data['dispatcher'].py_func.__qualname__ for _, item in found.buffer}))
        """
        steps = f"""
                environment, many = suite.make({id_!r}, {{'random': 0}}), vector.VectorEnvironment({id_!r}, 3)
                environment.reset(), many.reset()
                draw = np.random.default_rng(0)
                for _ in range(60):
                    actions = draw.uniform(-1, 1, (3, len(many.action_map)))
                    environment.step(actions[0]), many.step(actions)
        """
        # Not in this folder itself: Python would take the folder `trl_suite` in it for the package.
        cache = self.folder / 'cache'
        variables = {**os.environ, 'NUMBA_CACHE_DIR': str(cache), 'MUJOCO_GL': 'disable'}
        for more, nothing in (('', False), (steps, True)):
            out = subprocess.run(
                [sys.executable, '-c', textwrap.dedent(begin + more + end)], env=variables, text=True,
                stdout=subprocess.PIPE, check=True,
            ).stdout.splitlines()[-1]  # fmt: skip
            self.assertEqual(out == '[]', nothing, out)


class TerrainTest(CommandTest):
    def test_a_preset(self):
        found = self.output('terrain', 'gaps', '--length', '12')
        self.assertEqual(found, 'terrain_gaps.png\n')
        self.output('terrain', 'gaps', '--draws', '1', '--length', '12', '--output', 'b.png')
        one, three = iio.imread('b.png'), iio.imread('terrain_gaps.png')
        self.assertLess(one.shape[0], three.shape[0])
        ramps = ('--draws', '1', '--length', '12', '--face-length', '0.5', '--output', 'c.png')
        self.output('terrain', 'gaps', *ramps)
        self.assertTrue((iio.imread('c.png') != one).any())
        self.assert_only('terrain_gaps.png', 'b.png', 'c.png')

    def test_a_terrain_file(self):
        (self.folder / 'own').mkdir()
        (self.folder / 'own' / 'mine.json').write_text('{"Type": "var2d_gaps"}')
        self.assertEqual(self.output('terrain', 'own/mine.json'), 'terrain_mine.png\n')
        self.assert_only('own', 'terrain_mine.png')

    @parameterized.parameters(
        ("unknown terrain 'gasp'; did you mean 'gaps'", 'gasp'),
        ("unknown terrain type 'var2d_gap'", 'bad.json'),
        ('no such file', 'none.json'),
        ('length is 0.0', 'gaps', '--length', '0'),
        ('seed is -2', 'gaps', '--seed', '-2'),
        ('FaceLength is -1', 'gaps', '--face-length', '-1'),
        ("unknown suffix '.pdf'; expected .*png or .obj", 'gaps', '--output', 'a.pdf'),
        ('length is 4000', 'hills3d', '--length', '4000', '--output', 'a.obj'),
        ('seed is -2', 'gaps', '--seed', '-2', '--output', 'a.obj'),
    )
    def test_errors_leave_no_files(self, message, *arguments):
        pathlib.Path('bad.json').write_text('{"Type": "var2d_gap"}')
        self.assert_refused(message, 'terrain', *arguments)
        self.assert_only('bad.json')


# As ctypes calls Python while PyOpenGL is imported, which turns any exception into an error.
CALLBACK = """
import ctypes, signal
class Address(ctypes.c_void_p):
    @classmethod
    def from_param(cls, value):
        signal.raise_signal(signal.SIGINT)
function = ctypes.pythonapi.PyErr_Clear
function.argtypes = [Address]
function(None)
"""


class ProgramTest(CommandTest):
    def test_version(self):
        self.assertRegex(self.output('--version'), r'^trl-suite \d+\.\d+\.\d+\n$')

    def test_a_missing_or_unknown_command_is_an_error(self):
        self.assert_refused('required: command')
        self.assert_refused("invalid choice: 'lst'", 'lst')

    def test_a_missing_extra_is_named(self):
        with mock.patch.dict(sys.modules, {'imageio_ffmpeg': None}):
            self.assert_refused("pip install 'trl_suite", 'rollout', GAPS, '--video', 'a.mp4')

    def test_other_errors_are_not_hidden(self):
        # A bug must keep its traceback.
        with (
            mock.patch.object(listing, '_values', lambda *_: 1 / 0),
            self.assertRaises(ArithmeticError),
        ):
            run('list', '--tag', 'blind')

    def test_as_a_module(self):
        done = self.program('list', '--tag', 'blind')
        self.assertEqual((done.returncode, done.stderr), (0, ''))
        self.assertEndsWith(done.stdout, '\n4 environments\n')
        self.assertStartsWith(self.program('--help').stdout, 'usage: python -m trl_suite [-h]')

    def test_help_of_every_command(self):
        commands, found = [()], []
        while commands:
            command = commands.pop()
            text = self.output(*command, '--help')
            self.assertStartsWith(text, ' '.join(('usage: trl-suite', *command)))
            found.append(command)
            for name in re.findall(
                r'^    ([a-z]+)(?= |$)', text.split('\noptions:')[0], re.MULTILINE
            ):
                commands.append((*command, name))
        self.assertContainsSubset([('info',), ('benchmark', 'verify'), ('sequences', 'run')], found)

    def assert_one_error(self, done, message):
        self.assertEqual((done.returncode, done.stdout), (2, ''))
        self.assertRegex(done.stderr, f'^trl-suite: error: [^\n]*{message}[^\n]*\n$')

    def test_without_opengl(self):
        without = {'MUJOCO_GL': 'disable', 'NUMBA_DISABLE_JIT': '1'}
        done = self.program('rollout', GAPS, '--video', 'a.mp4', **without)
        self.assert_one_error(done, "cannot render.* is 'disable'")
        self.assert_only()
        done = self.program('rollout', GAPS, '--steps', '5', **without)
        self.assertEqual((done.returncode, done.stderr), (0, ''))  # nothing is rendered

    def test_a_broken_library_or_a_wrong_name(self):
        """A library matters only where a picture may be asked for."""
        done = self.program('info', GAPS, MUJOCO_GL='nonsense')
        self.assert_one_error(done, 'MUJOCO_GL must be one of')
        # What PyOpenGL does where the library of OSMesa is not installed.
        (self.folder / 'OpenGL').mkdir()
        (self.folder / 'OpenGL/__init__.py').write_text('None.glGetError')
        path = {'PYTHONPATH': os.pathsep.join([str(self.folder), *sys.path])}
        done = self.program('info', GAPS, MUJOCO_GL='osmesa', **path)
        self.assert_one_error(done, 'MUJOCO_GL')
        done = self.program('list', '--tag', 'blind', MUJOCO_GL='osmesa', **path)
        self.assertEqual((done.returncode, done.stderr), (0, ''))

    def test_output_that_cannot_be_written(self):
        for command, message in (
            ('list --tag blind >&-', 'standard output is closed'),
            ('list --tag blind >/dev/full', 'No space'),
            ('--help >/dev/full', 'No space'),
        ):
            done = subprocess.run(
                ['bash', '-c', f'"{sys.executable}" -m trl_suite {command}'],
                capture_output=True, text=True, timeout=60, check=False,
            )  # fmt: skip
            self.assert_one_error(done, message)

    @parameterized.parameters(
        ('numpy', 'raise KeyboardInterrupt\n'), ('numpy', CALLBACK), ('dm_control', CALLBACK)
    )
    def test_an_interrupt_while_a_library_is_imported(self, name, code):
        (self.folder / f'{name}.py').write_text(code)
        path = os.pathsep.join([str(self.folder), *sys.path])
        done = self.program('rollout', GAPS, PYTHONPATH=path)
        found = done.returncode, done.stdout, done.stderr
        self.assertEqual(found, (130, '', 'trl-suite: interrupted\n'))

    def test_a_closed_pipe_is_not_an_error(self):
        with subprocess.Popen(
            [sys.executable, '-m', 'trl_suite', 'list'], stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        ) as process:  # fmt: skip
            process.stdout.close()
            self.assertEqual((process.stderr.read(), process.wait()), (b'', 141))

    def program(self, *arguments, **variables):
        done = subprocess.run(
            [sys.executable, '-m', 'trl_suite', *arguments], capture_output=True, text=True,
            env={**os.environ, **variables}, timeout=60, check=False,
        )  # fmt: skip
        done.stderr = besides_notices(done.stderr)
        return done


class PagesTest(CommandTest):
    """Commands of the README and the guide; docs_test runs their code."""

    @pytest.mark.slow  # .ci/run runs it
    def test_commands_run(self):
        root = pathlib.Path(__file__).parents[1]
        pages = (root / name for name in ('README.md', 'docs/guide.md'))
        text = ''.join(page.read_text(encoding='utf-8') for page in pages)
        commands = re.findall(r'^(?:.* && \S*/)?trl-suite (.*)$', text, re.MULTILINE)
        self.assertLen(commands, 11)
        for command in commands:
            if command.startswith('view'):  # serves until it is interrupted
                continue
            with self.subTest(command):
                short = (*SIZE, '--steps', '8') if command.startswith('rollout') else ()
                self.output(*shlex.split(command), *short)
        self.assert_only('rollout.mp4', 'steps.png', 'slopes.png', 'soccer.mp4')
