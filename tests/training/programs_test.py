"""Tests of the programs that train and compare: which runs there are, and in which order."""

import contextlib
import dataclasses
import io
import itertools
import json
import os
import pathlib
import signal
import subprocess
import sys
import time
from types import SimpleNamespace
from unittest import mock

import compare
import evaluate_footsteps
import evaluate_plans
import evaluate_references
import expert
import generalisation
import generalist
import learn_gaits
import networks
import numpy as np
import ppo
import ppo_learner
import results
import runs
import settings
import share_gaits
import train_all
import train_randomized
import transfer_planners
from absl.testing import absltest, parameterized
from helpers import FolderTest
from programs import output

from trl_suite import benchmark, characters, evaluation, policies, suite
from trl_suite.motion import quaternion
from trl_suite.registry import catalogue
from trl_suite.runs import Course
from trl_suite.util import files
from trl_suite.util.digest import digest
from trl_suite.vector import VectorEnvironment

sys.path.append(str(pathlib.Path(__file__).resolve().parents[2] / 'benchmarks'))
import actuators
import contacts
import physics_rate
import robustness

ROOT = pathlib.Path(__file__).resolve().parents[2]


class CompareTest(FolderTest):
    def run_program(self, name, job, *arguments):
        """Returns the cells and seeds that are trained, and the output."""
        trained = []

        def counted(cell, seed, samples, folder):
            trained.append((cell, seed))
            return job(cell, seed, samples)

        compared = compare.COMPARISONS[name]._replace(job=counted)
        with mock.patch.dict(compare.COMPARISONS, {name: compared}):
            out = output(compare.main, name, '--json', self.folder / 'found.json', *arguments)
        return trained, out

    def drawn(self, name, job, *arguments):
        """Returns the axes of the picture."""
        from matplotlib import pyplot

        picture = self.folder / 'curves.png'
        with mock.patch.object(pyplot, 'close'):
            self.run_program(name, job, *arguments, '--picture', picture)
        axes = pyplot.gcf().axes
        pyplot.close('all')
        self.assertEqual(picture.read_bytes()[:4], b'\x89PNG')
        return axes

    @staticmethod
    def action(cell, seed, cycles):
        curve = [[8, 50.0], [16, 60.0 + seed]]
        return {'distance': 100.0 * seed + len(cell), 'speed': 3.0, 'curve': curve}

    @staticmethod
    def hierarchy(cell, seed, control_steps):
        kind = cell.endswith('without')
        last = {'trail': 10.0 * seed + kind, 'at_goal': 0.25 * seed, 'survived_minute': 0.5}
        first = {'trail': 1.0, 'at_goal': 0.0, 'survived_minute': 0.0}
        points = enumerate((first, last), start=1)
        return [
            {'control_steps': control_steps * i / 2, 'episodes': 8, **each} for i, each in points
        ]

    def test_finished_runs_are_kept_and_shown(self):
        first, out = self.run_program('actions', self.action)
        self.assertEqual(first, [(each, 1) for each in ('discrete', 'continuous', 'both', 'ppo')])
        self.assertIn('| base action with changes (MACE) | 104 | 104 | 3.0 |', out)
        second, out = self.run_program('actions', self.action, '--seeds', '1', '2')
        self.assertEqual(second, [(action, 2) for action, _ in first])
        self.assertIn('| one of the base actions | 108 | 208 | 158 ± 635 | 3.0 |', out)
        self.assertIn('in `FSM_Dog2D_Terrain_Mixed-v0`', out)
        message = 'samples is 32768.*, not 100.*; give these, or another file'
        with self.assertRaisesRegex(ValueError, message):
            self.run_program('actions', self.action, '--samples', '100')

    def test_tables(self):
        trained, out = self.run_program('hierarchy', self.hierarchy, '--seeds', '1', '2')
        self.assertLen(trained, 8)
        self.assertIn('along the trail in 200 s, m | 11.0 | 21.0 | 16.0 ± 63.5 | 50% 50% |', out)
        self.assertIn(
            'time with the ball at its goal, % | 25.0 | 50.0 | 37.5 ± 158.8 | 50% 50% |', out
        )
        self.assertIn('8 episodes of 200 s', out)
        (self.folder / 'found.json').unlink()

        def limited(cell, seed, samples):
            return {'normalized_return': 0.1 * len(cell), 'curve': []}

        trained, out = self.run_program('limits', limited)
        self.assertLen(trained, 11)  # muscles have no realistic limits but their strength
        self.assertIn('| ideal | 1.40 | 1.20 | 1.40 | 1.20 |', out)
        self.assertIn('| realistic | 1.80 | 1.60 | 1.80 | 1.20 |', out)

    def test_learning_curves_are_drawn(self):
        (axis,) = self.drawn('actions', self.action, '--seeds', '1', '2')
        lines = [line.get_xydata().tolist() for line in axis.get_lines()]
        self.assertIn([[0.008, 50], [0.016, 61], [0.016, 108]], lines)  # its final policy last
        self.assertIn([[0.008, 50], [0.016, 62], [0.016, 208]], lines)
        self.assertLen(axis.get_legend().get_texts(), 4)
        (self.folder / 'found.json').unlink()
        trail, soccer = self.drawn('hierarchy', self.hierarchy, '--seeds', '1', '2')
        lines = [line.get_xydata().tolist() for line in trail.get_lines()]
        self.assertIn([[0.6, 1.0], [1.2, 20.0]], lines)  # with hierarchy, seed 2
        self.assertLen(soccer.get_lines(), 4)

    @parameterized.parameters(
        (compare.learn_gaits, 'both', {'action': 'both', 'expert_cycles': 0}),
        (compare.ppo, 'ppo', {'horizon': 16, 'gamma': 0.9}),
        (compare.refine_gaits, 'selection', {'changes': '', 'changes_first': 0, 'substeps': 1}),
        (compare.refine_gaits, 'less', {'changes': 'all', 'noise': 0.02, 'changes_first': 16}),
    )
    def test_a_run_has_the_settings_of_its_action(self, trainer, action, expected):
        result = {'distance': 3.0, 'distance_interval': [], 'median_distance': 2, 'speed': 1}
        asked = []

        def train(id_, seed, own, folder, threads):
            asked.append(own)
            folder.mkdir(parents=True, exist_ok=True)
            policies.save(policies.reference(id_), folder / 'policy.npz')
            return [{'samples': 8, 'distance': 3.0}]

        with (
            mock.patch.object(evaluation, 'evaluate', lambda *_: result),
            mock.patch.object(trainer, 'train', train),
        ):
            changes = trainer is compare.refine_gaits
            job = compare.train_changes if changes else compare.train_actions
            found = job(action, 3, 64, self.folder / 'run')
        expected = {**expected, 'samples': 64, 'evaluate_every': 8 if changes else 16}
        self.assertEqual({name: getattr(asked[0], name) for name in expected}, expected)
        self.assertEqual((found['curve'], found['distance']), ([[8, 3.0]], 3.0))

    @parameterized.parameters(('with hierarchy', 15), ('without', 1))
    def test_both_kinds_have_the_same_number_of_control_steps(self, kind, each):
        """A plan of footsteps lasts 15 control steps of 1/30 s."""
        asked, original = [], settings.settings_for

        def run(id_, make, episodes, seed):
            asked.append(make(None).id)
            return {'trail': 1.0}

        def shorter(id_, **changes):
            return original(id_, **{**changes, 'num_envs': 2, 'horizon': 4, 'minibatch': 8})

        with (
            mock.patch.object(evaluate_plans, 'run', run),
            mock.patch.object(settings, 'settings_for', shorter),
        ):
            found = compare.train_hierarchy(f'soccer/{kind}', 1, 32 * each, self.folder)
        steps = [point['control_steps'] for point in found]
        self.assertEqual(steps, [8 * each, 16 * each, 24 * each, 32 * each])
        self.assertEqual(set(asked), {compare.TASKS['soccer'][compare.KINDS.index(kind)]})


class JobsTest(FolderTest):
    @parameterized.parameters(
        ({}, 'policy'),
        ({'stages': [[0.0, {}]]}, 'last'),
        ({'cloned': 100.0}, 'last'),  # imitation only
        ({'cloned': 60.0}, 'policy'),
    )
    def test_policy_of_a_run(self, own, name):
        id_ = 'PD_Biped2D_Flat-v0'
        curve = {'settings': {'samples': 100.0, **own}}
        (self.folder / 'curve.json').write_text(json.dumps(curve))
        policy = policies.reference(id_)
        for number, each in enumerate(('policy', 'last')):
            changed = dataclasses.replace(policy, info={**policy.info, 'samples': number})
            policies.save(changed, self.folder / f'{each}.npz')
        with mock.patch.object(train_all.evaluation, 'evaluate', return_value={}):
            run = train_all.measured(id_, self.folder, '', 0.0)
        self.assertEqual(run.entry['shipped_at'], ('policy', 'last').index(name))

    def test_every_environment_is_trained_but_for_most_gaits(self):
        """Actuation models, of biped, dog and raptor, are compared with three seeds."""
        jobs = list(train_all.jobs('*'))
        gaits = {id_ for id_, spec in catalogue.BY_ID.items() if spec.task_type == 'gait'}
        self.assertEqual(
            {id_ for id_, _ in jobs}, set(catalogue.BY_ID) - gaits | set(train_all.GAITS)
        )
        again = {id_ for id_, seed in jobs if seed == 3}
        self.assertLen(again, 12)  # torque, velocity, position and muscle
        self.assertLen([id_ for id_ in again if id_.startswith('MTU_')], 3)

    def test_policies_that_a_run_uses_are_trained_before(self):
        seen = set()
        for id_, _ in train_all.jobs('*'):
            self.assertContainsSubset(train_all.needed(id_), seen)
            start = settings.settings_for(id_).start
            if start and start not in ppo.TEACHERS:
                self.assertIn(start, train_all.needed(id_))
            if '_HLC_' in id_:
                walker = 'Run_FootStep' if '_Run-' in id_ else 'General_Step'
                self.assertEqual(train_all.needed(id_), [f'PD_Biped3D_LLC_{walker}-v0'])
            seen.add(id_)

    def test_runs_that_use_the_policy_of_a_failed_run_are_not_trained(self):
        flat, incline = (f'PD_Biped2D_{name}-v0' for name in ('Flat', 'Incline'))
        self.assertEqual(train_all.needed(incline), [flat])
        done = []

        def work(id_, seed):
            done.append(id_)
            raise ValueError('no network')

        self.enterContext(mock.patch.object(train_all, 'in_processes', lambda *_: work))
        self.enterContext(mock.patch.dict(os.environ, TRL_SUITE_TRAINED=str(self.folder)))

        def train():
            with self.assertRaisesRegex(RuntimeError, '4 of 4 runs failed'):
                train_all.main(['--filter', 'PD_Biped2D_[FI]*'])

        out = output(train)
        self.assertLen(done, 3)
        self.assertNotIn(incline, done)
        self.assertIn(f'{flat:40}    1  ValueError: no network', out)
        self.assertIn(f'{incline:40}    1  RuntimeError: not trained, since', out)

    def test_a_run_in_progress_is_not_overwritten(self):
        folder = self.folder / 'PD_Biped2D_Flat-v0' / 'seed_1'
        arguments = ['--runs', str(self.folder), '--overwrite', '--samples', '1']
        work = train_all.in_processes(train_all.parsed(arguments), train_all.Children())
        with (
            runs.only_run(folder),
            self.assertRaisesRegex(RuntimeError, 'process [0-9]+ trains in '),
        ):
            work('PD_Biped2D_Flat-v0', 1)
        self.assertTrue(folder.exists())

    def test_a_stop_ends_the_runs_and_enters_nothing(self):
        """Of several runs, one at a time, the first has begun; the others never do."""
        script, begun, children = self.folder / 'ppo.py', self.folder / 'begun', []
        script.write_text(f'import time\nopen({str(begun)!r}, "w").close()\ntime.sleep(600)\n')

        def started(*arguments, **options):
            children.append(popen(*arguments, **options))
            return children[-1]

        def stopped(running):
            latest = time.monotonic() + 60
            while not begun.exists():
                self.assertLess(time.monotonic(), latest, 'no run has begun')
                time.sleep(0.01)
            raise KeyboardInterrupt

        popen, trained = subprocess.Popen, self.folder / 'trained'
        words = f'--filter PD_Biped2D_[FIS]* --jobs 1 --runs {self.folder / "runs"}'.split()
        with (
            mock.patch.dict(os.environ, TRL_SUITE_TRAINED=str(trained)),
            mock.patch.object(ppo, '__file__', str(script)),
            mock.patch.object(subprocess, 'Popen', started),
            mock.patch('concurrent.futures.as_completed', stopped),
            self.assertRaises(KeyboardInterrupt),
        ):
            output(lambda: train_all.main(words))
        self.assertEqual([child.returncode for child in children], [-signal.SIGTERM])
        self.assertFalse(trained.exists())

    @parameterized.parameters(
        ('PD_Biped2D_Incline-v0', 'PD_Biped2D_Flat-v0'),
        ('PD_Biped3D_HLC_Soccer-v0', 'PD_Biped3D_LLC_General_Step-v0'),
    )
    def test_files_that_a_run_reads(self, *expected):
        """The policies of the start and of the controller, and which environments share them."""
        given = train_all.given(expected[0])
        self.assertCountEqual(given, [*(f'{each}.npz' for each in expected), 'shared.json'])
        for name, content in given.items():
            (self.folder / name).write_bytes(content)
        self.assertGreater(len(policies.available()), 50)
        with mock.patch.dict(os.environ, TRL_SUITE_TRAINED=str(self.folder)):
            self.assertEqual(set(policies.available()), set(expected))
            VectorEnvironment(expected[0], 1, 1, 0).close()

    @parameterized.parameters((20.0, False), (22.0, True))
    def test_a_better_run_replaces_the_policy_of_another_environment(self, returned, better):
        id_, other = 'FSM_Biped2D_Terrain_Slopes_Mixed-v0', 'FSM_Biped2D_Terrain_Mixed-v0'
        entry = {'policy': other, 'evaluation': {'distance': 21.0}}
        (self.folder / policies.SHARED).write_text(json.dumps({id_: entry}))
        entry = {'seed': 1, 'settings': {}, 'evaluation': {'distance': returned}}
        run = train_all.Run(entry, policies.reference(id_), 'here', 1.0)
        with (
            mock.patch.dict(os.environ, TRL_SUITE_TRAINED=str(self.folder)),
            mock.patch.object(evaluation, 'evaluate', return_value={}),
        ):
            train_all.enter(id_, 1, run)
            self.assertEqual(policies.trained_for(id_), id_ if better else other)
            self.assertIn(id_, policies.available())

    def test_a_worse_run_with_other_settings_is_not_entered(self):
        id_ = 'FSM_Biped2D_Terrain_Slopes_Mixed-v0'
        policy = policies.reference(id_)

        def enter(samples, distance, seed=1, **options):
            settings = {**train_all.settings(id_), 'samples': samples}
            entry = {'seed': seed, 'settings': settings, 'evaluation': {'distance': distance}}
            other = dataclasses.replace(policy, info={'samples': samples})
            run = train_all.Run(entry, other, '', 1.0)
            out = output(lambda: train_all.enter(id_, seed, run, **options))
            return policies.load(self.folder / f'{id_}.npz').info['samples'], out

        with (
            mock.patch.dict(os.environ, TRL_SUITE_TRAINED=str(self.folder)),
            mock.patch.object(evaluation, 'evaluate', return_value={}),
        ):
            self.assertEqual(enter(2e6, 100.0), (2e6, ''))
            shipped, out = enter(100.0, 3.0)
            self.assertEqual(shipped, 2e6)
            self.assertIn('distance is 3.000, and 100.000 with the shipped policy', out)
            self.assertEqual(enter(2e6, 90.0)[0], 2e6)  # the same run again
            self.assertEqual(enter(100.0, 3.0, overwrite=True)[0], 100)

    def test_the_policy_of_the_run_that_is_named_is_shipped(self):
        """Also while better runs, whose policies are not stored, are repeated with lower scores."""
        id_ = 'FSM_Biped2D_Terrain_Slopes_Mixed-v0'
        policy, settings = policies.reference(id_), train_all.settings(id_)
        with (
            mock.patch.dict(os.environ, TRL_SUITE_TRAINED=str(self.folder)),
            mock.patch.object(train_all.evaluation, 'evaluate', return_value={}) as evaluate,
        ):
            for seed, distance in ((1, 90), (2, 88), (3, 86), (1, 80), (2, 85), (3, 84), (2, 99)):
                stop = distance == 99  # before the end
                evaluate.side_effect = KeyboardInterrupt if stop else None
                entry = {'seed': seed, 'settings': settings, 'evaluation': {'distance': distance}}
                run = train_all.Run(
                    entry, dataclasses.replace(policy, info={'m': distance}), '', 1.0
                )
                with self.assertRaises(KeyboardInterrupt) if stop else contextlib.nullcontext():
                    train_all.enter(id_, seed, run, overwrite=True)
                stored, own = runs.read(f'{id_}.json'), policies.load(self.folder / f'{id_}.npz')
                named = train_all.shipped(stored)['evaluation']['distance']
                self.assertEqual((own.info['m'], digest(own)), (named, stored['of']))
            self.assertEqual((named, len(stored['runs'])), (85, 3))

    def test_what_is_chosen_is_evaluated_again_in_other_episodes(self):
        id_, of = 'FSM_Dog2D_Terrain_Gaps-v0', 'FSM_Dog2D_Terrain_Mixed-v0'
        other, policy = 'FSM_Dog2D_Terrain_Slopes_Mixed-v0', policies.reference(of)
        again = {'seed': train_all.OTHER_SEED, 'episodes': train_all.GAIT_EPISODES}
        values = [100.0]

        def evaluate(id_, policy, episodes, seed, *options, factory=False, **more):
            distance = values[-1] - 90 * factory
            return {
                'seed': seed, 'episodes': episodes, 'distance': distance,
                'median_distance': distance, 'distance_interval': [distance] * 2,
            }  # fmt: skip

        with (
            mock.patch.dict(os.environ, TRL_SUITE_TRAINED=str(self.folder)),
            mock.patch.object(evaluation, 'evaluate', evaluate),
        ):
            entry = {'seed': 1, 'settings': {}, 'evaluation': {'distance': 9.0}}
            train_all.enter(of, 1, train_all.Run(entry, policy, '', 1.0))
            output(share_gaits.main, of, id_)
            for found in (runs.read(f'{of}.json'), runs.read(policies.SHARED)[id_]):
                self.assertEqual(found['shipped_again'] | again, found['shipped_again'])
            self.assertEqual(runs.read(policies.SHARED)[id_]['evaluation']['seed'], train_all.SEED)
            # The results of a policy that is replaced are replaced, too, also by lower ones.
            values.append(50.0)
            output(share_gaits.main, of, id_)
            self.assertEqual(runs.read(policies.SHARED)[id_]['evaluation']['distance'], 100.0)
            policies.save(policy.with_preference(0.1), runs.place(f'{of}.npz'))
            output(share_gaits.main, of, id_)
            self.assertEqual(runs.read(policies.SHARED)[id_]['evaluation']['distance'], 50.0)
            # A policy that is worse than that of an environment does not become its policy.
            policies.save(policy.with_preference(0.2), runs.place(f'{of}.npz'))
            policies.save(dataclasses.replace(policy, id=other), runs.place(f'{other}.npz'))
            values.extend([40.0, 60.0])
            output(share_gaits.main, other, id_)
            self.assertEqual(runs.read(policies.SHARED)[id_]['policy'], of)

    def test_a_policy_that_others_use_is_kept(self):
        for id_ in 'abcd':
            (self.folder / f'{id_}.npz').touch()
        used = {'b': {'policy': 'a'}, 'c': {'policy': 'b'}, 'e': {'policy': 'd'}}
        with mock.patch.dict(os.environ, TRL_SUITE_TRAINED=str(self.folder)):
            share_gaits.remove_unused(used)
        self.assert_only('a.npz', 'b.npz', 'd.npz')

    def test_the_best_preference_is_selected(self):
        id_ = 'FSM_Raptor2D_Terrain_Mixed-v0'
        policy = policies.reference(id_)

        def evaluate(id_, candidate, *options):
            added = float((candidate.biases[-1] - policy.biases[-1]).max())
            return {'distance': -abs(added - 1.25)}

        with mock.patch.object(share_gaits.evaluation, 'evaluate', evaluate):
            found = []
            output(lambda: found.extend(share_gaits.preferring(id_, policy, [0, 1, 3], 1, 1)))
        preference, best = found
        self.assertEqual(preference, 1)
        np.testing.assert_array_equal(best.biases[-1], policy.with_preference(1).biases[-1])

    def test_initial_policies_control_the_same_joints(self):
        """They drive the same joints in the same way; the limbs may differ in length."""
        for id_ in catalogue.BY_ID:
            start = settings.settings_for(id_).start
            if start in catalogue.BY_ID:
                own, other = (
                    (list(characters.CHARACTERS[spec.character].joints), spec.actuation)
                    for spec in (catalogue.BY_ID[id_], catalogue.BY_ID[start])
                )
                self.assertEqual(own, other, id_)


class RandomizedTest(parameterized.TestCase):
    """Policies that were trained further in worlds and with sensors that vary."""

    def test_every_run_continues_from_the_shipped_policy(self):
        for id_ in settings.RANDOMIZED:
            own = settings.randomized_settings_for(id_)
            self.assertEqual(own.start, id_)
            [(begin, options)] = own.stages
            self.assertEqual((begin, own.evaluated_with.items() <= options.items()), (0, True))
            self.assertEqual(own.evaluated_with.keys(), {'randomize', 'sensors'})
            self.assertNotIn('pushes', options)  # those of the preset
            self.assertEqual(own.hidden, settings.settings_for(id_).hidden)

    def test_every_run_is_shipped(self):
        self.assertEqual(policies.available('randomized'), tuple(sorted(settings.RANDOMIZED)))

    @parameterized.parameters(*((id_,) for id_ in policies.available('randomized') or (None,)))
    def test_what_is_shipped_keeps_its_return(self, id_):
        """At least 0.9 of the first policy's without disturbances, and 0.9 of that with `robot`.

        With the preset of the training it is not worse than the first policy.
        """
        if id_ is None:
            self.skipTest('no policy is shipped')
        entry = runs.read(train_randomized.place(id_))
        before, own = entry['before'], settings.randomized_settings_for(id_)
        default = dataclasses.asdict(settings.Settings())  # of settings that were added later
        expected = json.loads(json.dumps(dataclasses.asdict(own)))
        self.assertEqual(json.loads(json.dumps(default)) | entry['settings'], expected)
        found = {name: result['return'] for name, result in entry['evaluations'].items()}
        self.assertGreater(found['none'], 0.9 * before['none']['return'])
        self.assertGreater(found['robot'], 0.9 * found['none'])
        preset = train_randomized.preset(entry)
        least = before[preset]['return'] - before[preset]['return_interval']
        self.assertGreater(found[preset], least)
        policy = policies.reference(id_, 'randomized')
        options = train_randomized.CONDITIONS['robot']
        environments = VectorEnvironment(id_, 1, 1, 0, task_kwargs=options)
        self.addCleanup(environments.close)
        policy.check(environments)
        self.assertEqual(policy.info['samples'], entry['shipped_at'])
        # Else measure again: `train_randomized.py`.
        for name, variant in (('evaluations', 'randomized'), ('before', '')):
            self.assertEqual(entry['of'][name], digest(policies.reference(id_, variant)), name)


class GeneralistTest(FolderTest):
    """One policy for all terrains of a character."""

    def test_a_short_run_learns_from_the_specialists(self):
        """The distilled policy acts more like them than a new one."""
        ids = generalist.ids_of('biped2d')
        short = generalist.Settings(distilled=1600, rounds=2, epochs=20, each=2)
        ppo_ = {
            **short.ppo, 'samples': 1000, 'averaged': 500, 'value_first': 500, 'evaluate_every': 1,
        }  # fmt: skip
        short = dataclasses.replace(short, ppo=ppo_)
        with contextlib.redirect_stderr(io.StringIO()):
            specialists = {id_: policies.reference(id_) for id_ in ids}
            distilled, policy, curve = generalist.train(specialists, 0, short, self.folder)
        self.assertEqual(policy.id, 'PD_Biped2D_Mixed_Terrain-v0')
        self.assertNotEmpty(curve)
        observation = VectorEnvironment(ids[0], 8, 1, 0).reset()
        action = policies.reference(ids[0])(observation)
        error = np.abs(distilled(observation) - action).mean()
        self.assertLess(error, 0.6 * np.abs(action).mean())
        self.assertGreater(np.abs(policy(observation) - distilled(observation)).max(), 0)

    def test_a_policy_is_entered_for_all_terrains(self):
        ids = generalist.ids_of('biped2d')
        policy = policies.reference(ids[-2])
        with mock.patch.dict(os.environ, {'TRL_SUITE_TRAINED': str(self.folder)}):
            generalist.enter(ids, policy, {'ids': ids})
            self.assertEqual(policies.available('generalist'), tuple(sorted(ids)))
            self.assertEqual(policies.reference(ids[0], 'generalist').id, ids[0])
            entry = runs.read(f'generalist/{ids[-2]}.json')
            self.assertEqual(entry, {'ids': ids, 'of': digest(policy)})

    def test_the_best_is_evaluated_again_in_other_episodes(self):
        ids, entries = generalist.ids_of('biped2d'), []
        specialist = policies.reference(ids[-2])
        best = dataclasses.replace(specialist, clip=specialist.clip + 1)

        def evaluate(pairs, episodes, seed, threads):
            return [
                {
                    **dict.fromkeys(generalist.RESULTS, 0), 'id': id_, 'seed': seed,
                    'completion_rate': 1.0, 'normalized_return': float(policy.clip == best.clip),
                }
                for id_, policy in pairs
            ]  # fmt: skip

        with (
            mock.patch.object(generalist, 'train', lambda *_: (specialist, best, [])),
            mock.patch.object(generalist, 'mean_of', lambda _: specialist),
            mock.patch.object(evaluation, 'evaluate_all', evaluate),
            mock.patch.object(generalist, 'enter', lambda *given: entries.append(given[-1])),
        ):
            output(generalist.main, 'biped2d', '--runs', self.folder)
        [entry] = entries
        self.assertEqual(entry['shipped'], 'trained')
        for kind, seed, score in (
            ('trained', generalist.SEED, 1),
            ('shipped_again', train_all.OTHER_SEED, 1),
            ('specialists_again', train_all.OTHER_SEED, 0),
        ):
            for found in entry[kind].values():
                self.assertEqual((found['seed'], found['normalized_return']), (seed, score), kind)
        self.assertEqual(list(entry['distilled_from']), ids)
        self.assertEqual(entry['distilled_from'][ids[-2]], digest(specialist))

    @parameterized.parameters(*generalist.CHARACTERS)
    def test_what_is_shipped_has_the_results_of_its_file(self, character):
        ids = generalist.ids_of(character)
        self.assertContainsSubset(ids, policies.available('generalist'))
        entry = runs.read(f'generalist/{ids[-2]}.json')
        self.assertEqual(entry['ids'], ids)
        expected = dataclasses.asdict(generalist.SETTINGS[character])
        self.assertEqual(entry['settings'], json.loads(json.dumps(expected)))
        policy = policies.reference(ids[0], 'generalist')
        for id_ in ids[:2]:  # flat ground and an incline, where episodes are alike
            own = entry[entry['shipped']][id_]['return']
            self.assertGreater(own, 0.9 * entry['specialists'][id_]['return'])
            again = evaluation.evaluate(id_, policy, 8, 1)
            self.assertAlmostEqual(again['return'] / own, 1, delta=0.05)


class FootstepsTest(parameterized.TestCase):
    """The shipped footstep controllers."""

    def tracked(self, name, condition, episodes, seconds):
        """The results of one of them."""
        id_ = f'PD_Biped3D_LLC_{name}_Step-v0'
        row, options = evaluate_footsteps.under(id_, condition)
        return evaluate_footsteps.run(row, policies.reference(id_), episodes, 1, seconds, **options)

    @parameterized.parameters(
        ('straight, 0.3 m', 0.05), ('straight, 0.7 m', 0.06), ('general', 0.08)
    )
    def test_it_lands_on_its_plan(self, condition, error):
        found = self.tracked('General', condition, 6, 5.0)
        self.assertEqual(found['survived'], 1.0)
        self.assertLess(found['landing'], error)

    @parameterized.parameters(
        ('PD_Biped3D_LLC_InPlace_Step-v0', 'pushes of 150 N', {'length': (0.0, 0.1), 'sharp': 0.0}),
        ('PD_Biped3D_LLC_Stand_Step-v0', 'general', {'stop': 0.0}),
        ('PD_Biped3D_LLC_Stand_Step-v0', 'stops', {'stop': 0.1}),
        ('PD_Biped3D_LLC_React_Step-v0', 'pushes of 250 N', {'react': 1.0, 'sharp': 0.0}),
    )
    def test_a_condition_keeps_the_plans_of_the_environment(self, id_, condition, plans):
        row, options = evaluate_footsteps.under(id_, condition)
        self.assertNotIn('plans', row.options)
        self.assertContainsSubset(plans.items(), options['plans'].items())

    def test_strong_pushes_are_survived_with_plans_that_react(self):
        survived = [
            self.tracked(name, 'pushes of 250 N', 16, 10.0)['survived']
            for name in ('General', 'React')
        ]
        self.assertGreater(survived[1], survived[0] + 0.3)

    @parameterized.parameters(
        ('General', {'hip_above_knee': (0.34, 0.39), 'lean': (-0.1, 0.1), 'tilt': (-0.05, 0.05)}),
        ('HighKnees', {'hip_above_knee': (0.2, 0.32)}),
        ('StraightLegs', {'right_knee': (0.3, 0.7), 'left_knee': (0.3, 0.7)}),
        ('OneStraightLeg', {'right_knee': (0.9, 1.3), 'left_knee': (0.3, 0.7)}),
        ('ForwardLean', {'lean': (0.4, 0.6)}), ('SidewaysLean', {'tilt': (0.25, 0.45)}),
        ('InPlace', {'distance': (0.0, 1.0)}),
    )  # fmt: skip
    def test_it_has_its_style(self, name, limits):
        found = self.tracked(name, 'general', 4, 4.0)
        self.assertEqual(found['survived'], 1.0)
        for key, (low, high) in limits.items():
            self.assertBetween(found[key], low, high, key)
        self.assertNotIn('drift', found)

    def test_it_stands(self):
        drifts = [self.tracked(name, 'stands', 4, 8.0)['drift'] for name in ('Stand', 'General')]
        self.assertLess(drifts[0], 0.5 * drifts[1])

    @parameterized.parameters(((0, 0.3, 0), (0.3, 0)), ((0.4, 0, 0), (0, 0.4)))
    def test_postures(self, turn, lean):
        """Of a walker that heads elsewhere, with a raised right thigh, bent knees and a turned trunk."""
        environment = suite.make(evaluate_footsteps.ID, {'random': 0})
        environment.reset()
        task, joints = environment.task, environment.physics.named.data.qpos
        environment.physics.data.qpos[task.body.pose_qpos[3:7]] = quaternion.about_z(1.0)
        for name, value in (
            ('torso', quaternion.from_vector(np.array(turn, float))),
            ('right_hip', quaternion.from_vector(np.array([0, -0.5, 0]))),
            ('left_hip', (1, 0, 0, 0)), ('right_knee', -0.6), ('left_knee', -0.9),
        ):  # fmt: skip
            joints[f'biped3d_mocap/{name}'] = value
        environment.physics.forward()
        task.observe()
        heights, flexion, leans = evaluate_footsteps.postures(task)
        thigh = 0.4215  # m
        np.testing.assert_allclose(heights, [[thigh * np.cos(0.5), thigh]], atol=1e-9)
        np.testing.assert_allclose(flexion, [[0.6, 0.9]], atol=1e-9)
        np.testing.assert_allclose(leans, [lean], atol=1e-9)

    @parameterized.parameters(
        (['--seconds', '0.03'], '--seconds is 0.03; expected a number at least 3'),
        (['--id', 'PD_Biped2D_LLC_Flat_Step-v0'], "unknown environment with footsteps in 3D 'PD_Biped2D.*mean"),
    )  # fmt: skip
    def test_refused(self, arguments, message):
        with self.assertRaisesRegex(ValueError, message):
            output(evaluate_footsteps.main, *arguments)


class PlanEvaluationTest(FolderTest):
    def test_results_that_another_process_writes_are_kept(self):
        id_, result = 'PD_Biped3D_HLC_Soccer-v0', {'reward': 0.5}

        def run(*arguments, **options):
            runs.add('plans.json', id_, 'of another process', result)
            return result

        with (
            mock.patch.dict(os.environ, TRL_SUITE_TRAINED=str(self.folder)),
            mock.patch.object(evaluate_plans, 'run', run),
        ):
            output(evaluate_plans.main, id_, '--policies', 'scripted')
            self.assertEqual(
                runs.read('plans.json'), {id_: {'of another process': result, 'scripted': result}}
            )

    def test_a_controller_is_entered_by_its_id_where_it_fits(self):
        given, asked = ('--policies', 'scripted', '--controller', 'deeploco/llc_run_footstep'), []

        def run(*arguments, controller):
            asked.append(controller)
            return {}

        with (
            mock.patch.dict(os.environ, TRL_SUITE_TRAINED=str(self.folder)),
            mock.patch.object(evaluate_plans, 'run', run),
        ):
            output(evaluate_plans.main, *given)
            with self.assertRaisesRegex(ValueError, 'unknown environment with .*mean.*_Run-v0'):
                output(evaluate_plans.main, 'PD_Biped3D_HLC_PathFollowing-v0', *given)
            [controller], [(id_, found)] = asked, runs.read('plans.json').items()
        self.assertEqual(id_, 'PD_Biped3D_HLC_PathFollowing_Run-v0')
        self.assertEqual(controller, 'PD_Biped3D_LLC_Run_FootStep-v0')
        self.assertEqual(found, {f'scripted with {controller}': {}})


class PlannerTransferTest(absltest.TestCase):
    def test_starts_from_the_shipped_planner_with_the_controller(self):
        id_, controller = 'PD_Biped3D_HLC_Soccer-v0', 'PD_Biped3D_LLC_HighKnees_Step-v0'
        given = transfer_planners.fine_tuned(id_, 1e5, controller)
        trainer = ppo.Trainer(id_, 0, dataclasses.replace(given, num_envs=2), 1)
        walker = trainer.environments.task.controllers[0].policy
        self.assertEqual(walker.id, policies.reference(controller).id)
        seen, left = trainer.seen(trainer.observation)
        actions = np.clip(trainer.unmirrored(trainer.means(seen), left), -1, 1)
        expected = policies.reference(id_)(trainer.observation)
        np.testing.assert_allclose(actions, expected, atol=2e-3)  # the scales are rounded

    def test_one_planner_needs_several_controllers(self):
        given = ('PD_Biped3D_HLC_Soccer-v0', 'PD_Biped3D_LLC_Stand_Step-v0', '--each')
        with self.assertRaisesRegex(ValueError, '--each has one controller; expected at least two'):
            output(transfer_planners.main, *given)


class RecordsTest(absltest.TestCase):
    def test_records_name_the_policies_that_they_are_of(self):
        named = {}
        for variant in ('', 'generalist', 'randomized'):
            for path in runs.place(variant).glob('*.npz'):
                of = files.read_json(path.with_suffix('.json'))['of']
                named[path] = of['evaluations'] if variant == 'randomized' else of
        for table in ('stairs', 'ramps', 'oracles', 'foresight', 'shared'):
            for id_, found in runs.read(f'{table}.json').items():
                named[table, id_] = found['of']
        for key, found in runs.read('oracle_falls.json').items():
            named['oracle_falls', key.partition(': ')[0]] = found['of']
        for id_, found in runs.read('transfer.json').items():
            flat = evaluate_references.flat_ground(catalogue.BY_ID[id_])
            named[f'transfer: {id_}', flat] = found['of']
        for table in ('footsteps', 'plans'):
            for id_, found in runs.read(f'{table}.json').items():
                for name, row in found.items():
                    if table == 'footsteps' or name.startswith('reference'):
                        named[f'{table}: {name}', id_] = row['of']
        self.assertGreater(len(named), 280)
        for key, of in named.items():
            policy = policies.reference(key[1]) if isinstance(key, tuple) else policies.load(key)
            self.assertEqual(of, digest(policy), key)


class StoredPagesTest(parameterized.TestCase):
    """Pages equal what their programs make of the stored results: run these if a test fails."""

    def test_results(self):
        self.assertEqual(
            results.page(results.load()), (results.DOCS / 'results.md').read_text('utf-8')
        )

    @parameterized.parameters(
        ('actions', 'gait_actions', 'terrain_adaptive_gaits'), ('changes', 'gait_changes', 'terrain_adaptive_gaits'),
        ('hierarchy', 'hierarchy', 'deeploco'), ('limits', 'limits', 'robustness'),
    )  # fmt: skip
    def test_comparisons(self, name, stored, page):
        found = files.read_json(results.DOCS / f'data/{stored}.json')
        text = (results.DOCS / f'reports/{page}.md').read_text('utf-8')
        block = compare.described(compare.COMPARISONS[name], found)
        self.assertEqual(files.between(text, name, 'training/compare.py', block), text)

    def test_benchmarks(self):
        entries = [runs.read(train_randomized.place(id_)) for id_ in settings.RANDOMIZED]
        data = {
            name: files.read_json(results.DOCS / f'data/{name}.json')
            for name in ('robustness', 'contacts', 'physics_rate')
        }
        for page, program, blocks in (
            ('docs/reports/robustness.md', robustness, {'robustness': robustness.table(data['robustness'])}),
            ('docs/reports/robustness.md', contacts, {'contacts': contacts.table(data['contacts'])}),
            ('docs/reports/robustness.md', train_randomized, {'randomized': train_randomized.table(entries)}),
            ('docs/realism.md', actuators, actuators.blocks()),
            ('benchmarks/physics_rate.md', physics_rate, physics_rate.blocks(data['physics_rate'])),
        ):  # fmt: skip
            text = (ROOT / page).read_text('utf-8')
            path = pathlib.Path(program.__file__).relative_to(ROOT).as_posix()
            for name, block in blocks.items():
                with self.subTest(name):
                    self.assertEqual(files.between(text, name, path, block), text)


class PageTest(FolderTest):
    def test_text_between_marks(self):
        page = self.folder / 'page.md'
        begin, end = '<!-- a, written by b.py -->', '<!-- /a -->'
        page.write_text(f'before\n{begin}\nold\n{end}\nafter\n')
        files.replace_between(page, 'a', 'b.py', r'new \1')
        self.assertEqual(page.read_text(), f'before\n{begin}\nnew \\1\n{end}\nafter\n')
        for text in ('', begin, f'{end} {begin}'):
            page.write_text(text)
            with self.assertRaisesRegex(
                ValueError, f"page.md: expected the lines '{begin}' and '{end}'"
            ):
                files.replace_between(page, 'a', 'b.py', 'new')
            self.assertEqual(page.read_text(), text)


def policy_of_five(**fields):
    return policies.Policy(**{
        'id': 'PD_Biped2D_Flat-v0', 'blocks': (('a', 5),), 'actions': ('x', 'y'),
        'quantity': 'target angle', 'clip': 10, 'biases': [[0, 0]], 'log_std': [0, 0], **fields,
    })  # fmt: skip


class TrimTest(FolderTest):
    def test_only_what_was_always_0_is_left_out(self):
        rng = np.random.default_rng(0)
        policy = policy_of_five(
            mean=[0, 0.5, 0, 0], std=[1, 0.01, 0.01, 2], activation='tanh', columns=[4, 3, 1, 0],
            weights=[rng.normal(size=(4, 2))],
        )  # fmt: skip
        trimmed = networks.trimmed(policy)
        self.assertEqual(trimmed.columns.tolist(), [4, 3, 0])  # a constant counts
        observation = rng.normal(size=(9, 5)) / 10
        observation[:, 1] = 0.0
        np.testing.assert_allclose(trimmed(observation), policy(observation), atol=2e-3)  # halves
        self.assertFalse((trimmed.weights[0].view(np.int32) & 0x1FFF).any())  # 11 bits, kept by zip

    def test_inputs_of_convolutions_keep_their_places(self):
        rng = np.random.default_rng(0)
        line = policies.Convolution(
            line=4, strides=(2,), weights=[rng.normal(size=(2, 1, 3))], biases=[np.zeros(3)]
        )
        policy = policy_of_five(
            mean=np.zeros(5), std=[1, 1, 1, 0.01, 1], activation='relu', convolution=line,
            weights=[rng.normal(size=(7, 2))],
        )  # fmt: skip
        trimmed = networks.trimmed(policy)
        observation = rng.normal(size=(9, 5)) / 30
        np.testing.assert_allclose(trimmed(observation), policy(observation), atol=5e-3)
        for weights in (trimmed.weights[0], trimmed.convolution.weights[0]):
            self.assertFalse((weights.view(np.int32) & 0x1FFF).any())

    def test_the_program_of_each_environment(self):
        for id_, program in (
            ('PD_Biped2D_Flat-v0', 'ppo'),
            ('FSM_Hopper2D_Terrain_Gaps-v0', 'ppo'),
            ('FSM_Biped2D_Terrain_Gaps-v0', 'ppo'),
            ('FSM_Raptor2D_Terrain_Slopes_Mixed-v0', 'learn_gaits'),
            ('FSM_Biped2D_Terrain_Slopes_Mixed-v0', 'refine_gaits'),
        ):
            self.assertEqual(train_all.program(id_).__name__, program)
            self.assertIn('samples', train_all.settings(id_))
        own = train_all.settings('PD_Dog2D_Walls_Terrain-v0', 7e3)  # of every run
        self.assertEqual([own['samples'], *(run['samples'] for run in own['further'])], [7e3, 7e3])

    def test_old_entries_get_new_settings(self):
        id_ = 'FSM_Biped2D_Terrain_Slopes_Mixed-v0'
        settings = train_all.settings(id_)
        old = {**settings, 'first': dict(settings['first']), 'removed': 1}
        del old['retry'], old['first']['members']
        text = json.dumps({'id': id_, 'shipped': 1, 'runs': [{'settings': old}]})
        (self.folder / f'{id_}.json').write_text(text)
        with mock.patch.dict('os.environ', TRL_SUITE_TRAINED=str(self.folder)):
            [run] = train_all.entries(id_)
        default = train_all.refine_gaits.Settings()
        expected = {**settings, 'retry': default.retry}
        expected['first'] = {**settings['first'], 'members': default.first.members}
        self.assertEqual(run['settings'], expected)


class ProgramsTest(FolderTest):
    def test_results_that_another_process_adds_during_a_measurement_are_kept(self):
        path, id_ = self.folder / 'found.json', 'PD_Biped2D_Gaps_Terrain-v0'
        own = {'distance': 9.0, 'speed': 3.0, 'curve': [[8, 5.0]]}
        compared = compare.COMPARISONS['actions']._replace(cells=('both',))
        result = dict.fromkeys(train_randomized.RESULTS, 1.0)
        levels = {'FILE': path, 'IDS': (id_,), 'COUNTS': (10,)}
        self.enterContext(mock.patch.object(runs, 'place', lambda _: path))
        self.enterContext(mock.patch.object(policies, 'reference', lambda id_, *_: id_))
        given = {'samples': compared.samples, 'results': {}}
        for program, found, (table, row), start in (
            (lambda: output(compare.main, 'actions', '--json', path), own, ('results', 'both/1'), given),
            (lambda: output(generalisation.main, '--output', self.folder), [0.5, 0.4], (id_, '10'), {}),
            (lambda: train_randomized.measure(id_), result, ('before', 'harsh'), {}),
        ):  # fmt: skip
            asked = []

            def measure(*arguments, found=found, asked=asked, start=start):
                asked.append(arguments)
                with files.changing(path, start) as content:
                    content.setdefault('another', []).append(len(asked))
                return found

            job = compared._replace(job=measure)
            with (
                self.subTest(table),
                mock.patch.dict(compare.COMPARISONS, {'actions': job}),
                mock.patch.multiple(generalisation, measured=measure, **levels),
                mock.patch.object(evaluation, 'evaluate', measure),
            ):
                program()
                content = files.read_json(path)
                self.assertEqual(content['another'], [*range(1, len(asked) + 1)])
                self.assertIn(content[table][row], (found, [found] * len(asked)))
                program()  # nothing is left
                self.assertEqual(files.read_json(path), content)
            path.unlink()

    def test_no_process_erases_what_another_has_added(self):
        path = self.folder / 'new' / 'found.json'
        program = 'import sys, pathlib\nfrom trl_suite.util import files\nfor i in range(100):\n'
        program += ' with files.changing(pathlib.Path(sys.argv[1]), {"episodes": 8}) as found:\n'
        program += '  found.setdefault(sys.argv[2], []).append(i)\n'
        running = [
            subprocess.Popen([sys.executable, '-c', program, path, name]) for name in ('a', 'b')
        ]
        self.assertEqual([each.wait() for each in running], [0, 0])
        every = list(range(100))
        self.assertEqual(files.read_json(path), {'episodes': 8, 'a': every, 'b': every})
        for start, error in (
            ({'episodes': 9}, 'episodes is 8, not 9'),
            ({'limit': 3}, 'limit is None, not 3'),
        ):
            with (
                self.assertRaisesRegex(
                    ValueError, f'other settings: {error}; give these, or another'
                ),
                files.changing(path, start),
            ):
                pass
        written = path.stat().st_mtime_ns
        with contextlib.suppress(KeyError), files.changing(path) as found:
            found['a'] = found['b'] = 0
            raise KeyError
        with files.changing(path) as found:
            self.assertEqual(found['a'], every)
        self.assertEqual(path.stat().st_mtime_ns, written)  # nothing was changed
        self.assertEqual(os.listdir(path.parent), ['found.json'])

    def test_only_folders_of_runs_are_removed(self):
        (self.folder / 'thesis.txt').write_text('mine')
        with self.assertRaisesRegex(FileExistsError, 'is not the folder of a run'):
            runs.remove(self.folder)
        for name in ('curve.json', 'log.txt', 'run_1/checkpoint.pt'):  # of interrupted ones, too
            (self.folder / 'run' / name).parent.mkdir(parents=True)
            (self.folder / 'run' / name).touch()
            runs.remove(self.folder / 'run')
            self.assert_only('thesis.txt')
        (self.folder / 'run').mkdir()
        (self.folder / 'run/curve.json').touch()
        found = []  # when files begin to be removed

        def stop(*_, **__):
            found.extend(path.name for path in self.folder.iterdir())
            raise KeyboardInterrupt

        with (
            mock.patch.object(os, 'unlink', stop),
            self.assertRaises(KeyboardInterrupt),
        ):
            runs.remove(self.folder / 'run')
        self.assertNotIn('run', found)

    def test_every_program_ends_errors_in_one_line(self):
        folder = pathlib.Path(ppo.__file__).parent
        others = (
            folder.with_name(name).glob('*.py') for name in ('examples', 'docs', 'benchmarks')
        )
        for path in (*folder.glob('*.py'), *itertools.chain(*others)):
            text = path.read_text()
            if '__main__' in text or ('.parse_args(' in text and path.parent != folder):
                self.assertRegex(text, r'(?m)^(    )?(program\.)?begin_script\(\)$', path.name)

    @parameterized.parameters(
        (train_all, '--jobs 0', '--jobs is 0; expected a whole number at least 1'),
        (train_all, '--samples -1', '--samples is -1.0; expected'),
        (train_all, '--seeds -1', "unknown seed of the runs '-1'"),
        (train_all, '--runs s3://a/b', "--runs is 's3://a/b'; expected a folder, or a URL with --ray"),
        (train_all, '--address auto', "--address is 'auto'; expected --ray with it"),
        (compare, 'actions --samples 0', '--samples is 0.0; expected a number above 0'),
        (compare, 'actions --seeds -1', r'--seeds is \[-1\]; expected'),
        (compare, 'actions --seeds 1 0', '--seeds: 0 is the seed of the tests; choose another'),
        (generalist, 'dog2d --seed 0', '--seed: 0 is the seed of the tests'),
        (train_randomized, '--seed 0', '--seed: 0 is the seed of the tests'),
        (ppo, 'PD_Dog2D_Flat-v0 --seed 0', '--seed: 0 is the seed of the tests'),
        (ppo, f'PD_Dog2D_Flat-v0 --seed {2**31}', '--seed is .* expected'),
        (evaluate_references, 'transfer Foo', "unknown environment of transfer 'Foo'"),
        (
            evaluate_references, 'default_gaits PD_Biped2D_Flat-v0',
            "unknown environment of default_gaits 'PD_Biped2D_Flat-v0'",
        ),
        (learn_gaits, 'FSM_Hopper2D_Terrain_Gaps-v0 --samples 64', 'samples is 64.0; expected'),
    )  # fmt: skip
    def test_bad_arguments_are_named_before_there_is_a_folder(self, module, words, message):
        with (
            contextlib.chdir(self.folder),
            mock.patch.object(sys, 'argv', [module.__name__, *words.split()]),
            self.assertRaisesRegex(ValueError, message),
        ):
            module.main()
        self.assert_only()


class TransferTest(parameterized.TestCase):
    def test_flat_ground_of_every_environment(self):
        for spec in catalogue.SPECS:
            if spec.domain == 'plaid':
                flat = catalogue.BY_ID[evaluate_references.flat_ground(spec)]
                self.assertEqual(
                    (flat.terrain, flat.character, dict(flat.options)),
                    ('flat', spec.character, dict(spec.options)),
                )


class LearnerTest(FolderTest):
    def test_a_run_of_the_benchmark_continues_after_a_stop(self):
        """PPO learns in two stages; what it has learnt is restored from its files."""
        id_ = 'PD_Biped2D_Gaps_Terrain-v0'
        course = Course(id_, (id_,), parts=2)
        runs_ = dataclasses.replace(benchmark.BENCHMARK, courses={id_: course})
        budget = 2 * ppo.Settings().num_envs * ppo.Settings().horizon
        scores = {}
        for name, ends in (('whole', (2,)), ('stopped', (1, 2))):
            for stages in ends:
                learner, path = ppo_learner.SuitePPO(course, 1), self.folder / f'{name}.json'
                result = runs_.run(course, learner, budget, path, episodes=1, stages=stages)
            scores[name] = result['scores']
        self.assertEqual(scores['stopped'], scores['whole'])
        self.assertNotEqual(scores['whole'][0], scores['whole'][1])


class PlansTest(absltest.TestCase):
    def test_measurements_of_plans(self):
        """Two episodes of a controller that walks nowhere: they end early, without a goal."""
        id_ = 'PD_Biped3D_HLC_PathFollowing-v0'

        def make(environments):
            return lambda observation: 0.0 * observation[:, :5] + 1.0  # too far for anybody

        found = evaluate_plans.run(id_, make, episodes=2, seed=0)
        self.assertEqual((found['survived'], found['survived_minute']), (0, 0))
        self.assertEqual(found['goals_per_minute'], 0)
        self.assertBetween(found['seconds'], 0.5, 20)
        self.assertLess(found['reward'], 0.05)
        self.assertGreater(found['falls_per_km'], 50)
        self.assertEqual(found['at_goal'], 0)
        walker = policies.reference('PD_Biped3D_LLC_General_Step-v0')
        self.assertEqual(found['controllers'], [digest(walker)])
        self.assertEqual(found.keys() - evaluate_plans.shown(found), {'controllers'})

    def test_without_hierarchy(self):
        """A walker that always acts at its limits falls at once; a step lasts 1/30 s."""
        id_ = 'PD_Biped3D_Terrain_Soccer_Hard-v0'

        def make(environments):
            return lambda observation: np.ones((2, len(environments.action_map)))

        found = evaluate_plans.run(id_, make, episodes=2, seed=0)
        self.assertEqual(found['survived'], 0)
        self.assertBetween(found['seconds'], 0.1, 5)
        self.assertAlmostEqual(found['seconds'] * 60, round(found['seconds'] * 60), 6)
        self.assertLess(found['reward'], found['seconds'] / evaluate_plans.SECONDS)
        self.assertNotIn('controllers', found)

    def test_results_name_the_weights(self):
        id_ = 'PD_Biped3D_HLC_Soccer-v0'
        planner, walker = (policies.reference(each) for each in (id_, evaluate_footsteps.ID))
        found = evaluate_plans.run(id_, lambda _: planner, episodes=1, seed=0, step_limit=2)
        self.assertEqual((found['of'], found['controllers']), (digest(planner), [digest(walker)]))
        found = evaluate_footsteps.run(suite.find(walker.id), walker, 1, 0, 3.0)
        self.assertEqual(found['of'], digest(walker))

    def test_policies_of_tasks(self):
        planned, direct = 'PD_Biped3D_HLC_Forest-v0', 'PD_Biped3D_Terrain_Forest_Hard-v0'
        for id_, name, expected in (
            (planned, 'expert', expert.expert),
            (direct, 'expert', expert.joint_expert),
            (direct, 'scripted', None),
            ('PD_Biped3D_HLC_Soccer-v0', 'expert', None),  # its footsteps have no expert
        ):
            self.assertIs(evaluate_plans.maker(id_, name), expected)


class ExpertTest(parameterized.TestCase):
    """The expert for footstep plans."""

    def test_a_trail(self):
        trail = SimpleNamespace(
            start=np.array([[0.0, 0.0], [2.0, 0.0]]), end=np.array([[2.0, 0.0], [2.0, 2.0]])
        )
        for place, goal, ahead, expected in (
            ((0.5, 0.1), (1.9, 0.0), 1.0, (1.5, 0.0)),
            ((1.5, 0.1), (2.0, 1.9), 1.0, (2.0, 0.5)),  # around the corner
            ((2.1, 0.5), (1.0, 0.0), 1.0, (1.5, 0.0)),  # back
            ((1.5, 0.0), (1.7, 0.0), 1.0, (1.7, 0.0)),  # no farther than the goal
        ):
            aim = expert.on_trail(trail, np.array(place), np.array(goal), ahead)
            np.testing.assert_allclose(aim + place, expected, atol=1e-9)

    def test_past_a_goal_on_a_trail(self):
        """The point is farther on, shifted sideways with a goal that is still ahead."""
        trail = SimpleNamespace(start=np.array([[0.0, 0.0]]), end=np.array([[9.0, 0.0]]))
        place = np.array([2.0, 0.3])
        for goal, expected in (((2.5, 0.4), (3.5, 0.2)), ((1.0, 0.4), (3.5, 0.0))):
            aim = expert.on_trail(trail, place, np.array(goal), 1.5, beyond=True)
            np.testing.assert_allclose(aim + place, expected, atol=1e-9)

    def test_a_path_on_a_map(self):
        map_ = expert.Map()
        x, y = map_.places.T
        np.testing.assert_allclose(map_.places[map_.middle], 0)
        self.assertEqual(np.abs(map_.places[map_.rim]).max(1).min(), expert.REACH)
        even = np.ones(len(x))
        for goal in ((3.0, 0.0), (0.0, -4.0), (-20.0, 0.0), (9.0, 4.0)):  # there is nothing
            aim = map_.aim(even, np.array(goal))
            np.testing.assert_allclose(aim, goal)
        # A wall ahead that reaches farther to the right than to the left.
        wall = (np.abs(x - 1) < 0.2) & (y < 1) & (y > -4)
        aim = map_.aim(even + expert.WALL * wall, np.array([3.0, 0.0]))
        self.assertGreater(aim[1], 0.6)
        self.assertLess(np.linalg.norm(aim), 2.0)

    @parameterized.parameters(
        ('expert', 'PD_Biped3D_HLC_Soccer-v0'), ('joint_expert', 'PD_Biped3D_HLC_Forest-v0'),
        ('expert', 'PD_Biped3D_HLC_Forest-v0', {'interface': 'frame'}),
        ('expert', 'PD_Biped2D_Flat-v0'),
    )  # fmt: skip
    def test_unsupported_tasks_are_refused(self, name, id_, options=None):
        environments = VectorEnvironment(id_, 1, 1, seed=0, task_kwargs=options)
        message = f'the {name.replace("_", " ")} does not support the task'
        with self.assertRaisesRegex(ValueError, message):
            getattr(expert, name)(environments)

    @parameterized.parameters('PathFollowing', 'LargeBlocks', 'DynamicsObstacles')
    def test_expert_arrives_on_difficult_ground(self, name):
        """20 s of 8 episodes, towards goals at the least speed required of trained policies."""
        id_ = f'PD_Biped3D_HLC_{name}-v0'
        environments = VectorEnvironment(id_, 8, 0, seed=3, autoreset='disabled')
        policy, observation = expert.expert(environments), environments.reset()
        fell, speed = 0, np.zeros(8)
        for _ in range(40):
            action = policy(observation)
            self.assertEqual(action.shape, (8, 5))
            step = environments.step(action)
            ended = step.terminated | step.truncated
            fell += ended.sum()
            speed += step.info['speed'] / 40
            observation = environments.reset(ended) if ended.any() else step.observation
        self.assertLessEqual(fell, 1)
        self.assertGreater(speed.mean(), 0.6)


class JointExpertTest(parameterized.TestCase):
    """The expert for tasks without hierarchy."""

    @parameterized.parameters('Trail', 'Blocks', 'Soccer')
    def test_walks_on(self, name):
        """10 s of 8 episodes: at most one fall, and the walkers leave their start."""
        id_, options = f'PD_Biped3D_Terrain_{name}_Hard-v0', {'autoreset': 'disabled'}
        environments = VectorEnvironment(id_, 8, 0, seed=3, step_limit=None, **options)
        policy, observation = expert.joint_expert(environments), environments.reset()
        fell, distance = 0, np.zeros(8)
        for _ in range(300):
            action = policy(observation)
            self.assertEqual(action.shape, (8, len(environments.action_map)))
            step = environments.step(action)
            fell += step.terminated.sum()
            distance = np.maximum(distance, step.info['distance'])
            ended = step.terminated
            observation = environments.reset(ended) if ended.any() else step.observation
        self.assertLessEqual(fell, 1)
        self.assertGreater(distance.mean(), 1.0 if name == 'Soccer' else 5.0)

    def test_plans_again_after_a_reset(self):
        """A policy that has seen other episodes acts in a new one as a new policy does."""
        id_ = 'PD_Biped3D_Terrain_Soccer_Hard-v0'
        environments = VectorEnvironment(id_, 2, 0, seed=3, autoreset='disabled')
        used, observation = expert.joint_expert(environments), environments.reset()
        for _ in range(20):
            observation = environments.step(used(observation)).observation
        observation = environments.reset()
        fresh = expert.joint_expert(environments)
        np.testing.assert_array_equal(used(observation), fresh(observation))
