"""The commands doctor, bench and clip, and the functions that they use."""

import importlib.metadata
import json
import pathlib
import re
from unittest import mock

import numpy as np
import own_clip_test
import own_test
from absl.testing import parameterized
from helpers import write_terrainrl
from PIL import Image
from programs import GAPS, CommandTest, run

from trl_suite import motion, policies, suite
from trl_suite.cli import bench, doctor
from trl_suite.environments import named_policies as acting
from trl_suite.util import machine

SETUP = pathlib.Path(__file__).resolve().parents[1] / 'setup.py'


class TryTest(CommandTest):
    def test_a_character_from_a_file(self):
        pathlib.Path('figure.xml').write_text(own_test.MJCF)
        out = self.output('try', 'figure.xml')
        self.assertRegex(out, r'figure: planar, [\d.]+ kg, 1.\d+ m high')
        self.assertIn('end effectors: right_shin, left_shin; must not touch the ground: trunk', out)
        self.assertRegex(out, r'facing: along \[1.0, 0.1\], derived from .* left and right')
        self.assertIn('collide: 6; in contact at the start: 0', out)
        self.assertRegex(out, 'right_hip +hinge +90 +3 +70')
        self.assertRegex(out, 'note: no torque limits in the file; .*left_hip')
        self.assertRegex(out, '(?s)flat: root .* m at the start.*slopes: .*steps: ')
        self.assertEqual(Image.open('try_figure.png').size, (3 * 480 + 2 * 4, 360))

    def test_it_is_turned_and_its_tendons_are_left_out(self):
        tendon = '<tendon><fixed name="both"><joint joint="left_hip" coef="1"/></fixed></tendon>'
        text = own_test.MJCF.replace('<actuator>', f'{tendon}<actuator><motor tendon="both"/>')
        pathlib.Path('dog.xml').write_text(text)  # a name of the suite's own
        out = self.output(
            'try', 'dog.xml', '--spatial', '--turn', '0.7071', '0', '0', '0.7071', '--end-effectors',
            'left_shin', '--fall-links', '--output', 'a.png',
        )  # fmt: skip
        self.assertIn('dog_file: three-dimensional', out)
        self.assertRegex(out, r'facing: along \[-?0.\d*, 1.0\]')
        self.assertIn('end effectors: left_shin; must not touch the ground: none', out)
        self.assertIn('note: actuators that are left out, 1 of 3, because', out)
        self.assertIn('note: --spatial was given and is used', out)
        self.assertTrue(pathlib.Path('a.png').exists())

    def test_a_character_that_diverges(self):
        """The report and the picture are written all the same."""
        spring = 'name="left_knee" stiffness="1e6" springref="90" axis'
        text = own_test.MJCF.replace('name="left_knee" axis', spring)
        pathlib.Path('figure.xml').write_text(text)
        status, out, err = run('try', 'figure.xml')
        self.assertEqual(status, 2)
        self.assertRegex(out, '(?s)flat: diverges after 0.0.* s of zero actions\n.*try_figure.png')
        self.assertIn('figure.xml: its simulation diverges on flat, slopes, steps; expected a', err)
        self.assertTrue(pathlib.Path('try_figure.png').exists())

    def test_messages_name_the_options_of_the_command(self):
        text = own_test.URDF.replace('ixx=".01"', 'ixx=".1"')
        pathlib.Path('two.urdf').write_text(text)
        self.assert_refused('or pass --balance-inertia, which', 'try', 'two.urdf', '--spatial')
        hat = '<body name="hat"><freejoint/><geom size="1"/><body><joint/><geom size="1"/></body></body>'
        text = own_test.MJCF.replace('</worldbody>', f'{hat}</worldbody>')
        pathlib.Path('figure.xml').write_text(text)
        self.assert_refused("pass --root, one of .'trunk', 'hat'", 'try', 'figure.xml')

    def test_invalid_files_are_rejected(self):
        pathlib.Path('two.urdf').write_text(own_test.URDF)
        self.assert_refused('pass --spatial or --no-spatial', 'try', 'two.urdf')
        self.assert_refused("no such file; did you mean 'two.urdf'", 'try', 'tow.urdf')
        self.assert_refused("did you mean 'leg'", 'try', 'two.urdf', '--root', 'leg2')
        self.assert_refused("suffix '.jpg'; expected .png", 'try', 'two.urdf', '--output', 'a.jpg')
        size = '<mujoco><size nuser_geom="2000000000"/>'
        pathlib.Path('two.xml').write_text(own_test.MJCF.replace('<mujoco>', size))
        self.assert_refused('two.xml: .*; expected what can be read in 10 s', 'try', 'two.xml')
        self.assert_only('two.urdf', 'two.xml')


class DoctorTest(CommandTest):
    def test_this_installation_runs(self):
        """The essential check: a separate process steps and renders an environment."""
        (found,) = doctor.self_test(())
        self.assertEqual((found.state, found.remedy), (doctor.OK, ''))
        self.assertRegex(found.text, r'runs: \d+ steps per second, first picture after \d')

    def test_versions(self):
        needed = ['numpy>=2.0', 'mujoco>=99', 'no-such-thing', 'torch>99; extra == "train"']
        with mock.patch.object(importlib.metadata, 'requires', return_value=needed):
            python, *found = doctor.versions()
        self.assertStartsWith(python.text, 'Python 3')
        self.assertEqual([f.state for f in found], [doctor.OK, doctor.FAILED, doctor.FAILED])
        self.assertEqual(found[1].remedy, "pip install 'mujoco>=99'")
        self.assertIn('no-such-thing is missing', found[2].text)
        # All required packages are installed.
        self.assertEqual({finding.state for finding in doctor.versions()}, {doctor.OK})

    def test_every_extra_of_a_user_is_named(self):
        """Those of developers are not, nor that of the policies, which have their own line."""
        text = SETUP.read_text().partition('extras_require')[2]
        declared = re.findall(r"^        '(\w+)': \[", text, re.MULTILINE)
        expected = set(declared) - {'policies', 'test', 'dev', 'docs', 'notebooks'}
        self.assertContainsSubset({'viewer', 'cluster'}, expected)
        self.assertEqual(set(doctor.EXTRAS), expected)
        named = re.findall(r"extra '(\w+)'", ' '.join(found.text for found in doctor.extras()))
        self.assertEqual(set(named), expected)

    def test_a_failed_process_reports_its_error(self):
        # At exit, a partly loaded library may print long messages.
        code = 'import atexit; atexit.register(lambda: print(1 / 0)); import no_such_module'
        status, _, error = doctor._end(doctor._start(code))
        expected = "ModuleNotFoundError: No module named 'no_such_module'"
        self.assertEqual((status, error), (1, expected))
        with mock.patch.object(doctor, 'TIMEOUT', 0.1):
            status, _, error = doctor._end(doctor._start('import time; time.sleep(60)'))
        self.assertEqual((status, error), (1, 'no answer within 0.1 s'))

    @parameterized.parameters(
        ((1, '["9 steps per second"]', 'FatalError: no GL'), ('egl',), 'export MUJOCO_GL=egl'),
        ((1, '["9 steps per second"]', 'FatalError: no GL'), (), 'MUJOCO_GL=disable if you need'),
        ((1, '', 'ImportError: mujoco'), (), 'see the failures above'),
    )
    def test_failures_name_a_remedy(self, end, works, remedy):
        with mock.patch.object(doctor, '_start'), mock.patch.object(doctor, '_end', lambda _: end):
            *_, found = doctor.self_test(works)
        self.assertEqual(found.state, doctor.FAILED)
        self.assertIn(end[2], found.text)
        self.assertIn(remedy, found.remedy)

    def test_rendering_backends_are_reported(self):
        ends = {'egl': (0, 'llvmpipe', ''), 'osmesa': (1, '', 'no library'), 'glfw': (0, '', '')}
        with (
            mock.patch.object(doctor, '_start', lambda code, name: name),
            mock.patch.object(doctor, '_end', ends.get),
        ):
            found = dict(doctor.backends())
        self.assertEqual(found['egl'].text, 'MUJOCO_GL=egl renders, llvmpipe')
        self.assertEqual((found['osmesa'].state, found['glfw'].state), (doctor.NOTE, doctor.OK))
        self.assertIn('libosmesa6', found['osmesa'].remedy)

    def test_usable_cores(self):
        with (
            mock.patch.object(machine, 'cores', return_value=2),
            mock.patch.object(doctor.os, 'cpu_count', return_value=8),
        ):
            found = doctor.cores()
        self.assertStartsWith(found.text, '2 of 8 cores usable')

    def test_cache_of_compiled_code_is_reported(self):
        found = doctor.compiled_code()
        self.assertEqual(found.state, doctor.OK)
        self.assertIn(str(doctor.compiled.cache_folder()), found.text)
        self.assertRegex(found.text, r': \d+ files, \d+\.\d MB$')
        with mock.patch.object(doctor.compiled, 'cache_folder', return_value=None):
            found = doctor.compiled_code()
        self.assertEqual(found.state, doctor.NOTE)
        self.assertIn('NUMBA_CACHE_DIR', found.remedy)

    def test_findings(self):
        """All of them; what runs in other processes is replaced."""
        ends = {doctor._DRAW: (0, 'Mesa', ''), doctor._RUN: (1, '', 'no engine')}
        with (
            mock.patch.object(doctor, '_start', lambda code, *_: code),
            mock.patch.object(doctor, '_end', lambda code: ends[code]),
        ):
            found = list(doctor.findings())
        failed = [each.text for each in found if each.state == doctor.FAILED]
        self.assertIn('no environment runs: no engine', failed)
        text = '\n'.join(each.text for each in found)
        for name in ('Python 3', 'mujoco ', "extra 'video'", ' cores usable', 'MUJOCO_GL=osmesa'):
            self.assertIn(name, text)
        for lacks, state in ((True, doctor.NOTE), (False, doctor.OK)):
            with mock.patch.object(doctor.resources, 'lacks_policies', return_value=lacks):
                found = doctor.shipped_policies()
            self.assertEqual(found.state, state)
            self.assertIn(f'policies for {len(doctor.policies.available())} env', found.text)

    def test_exit_status(self):
        good, bad = doctor.Finding('ok', 'fine'), doctor.Finding('FAILED', 'no engine', 'mend it')
        for found, status, last in (
            ([good], 0, 'all checks passed'),
            ([good, bad], 1, '1 check failed'),
        ):
            with mock.patch.object(doctor, 'findings', lambda found=found: iter(found)):
                code, out, _ = run('doctor')
            self.assertEqual((code, out.splitlines()[-1]), (status, last))
        self.assertIn('\nFAILED  no engine\n        -> mend it\n', out)


class BenchTest(CommandTest):
    def test_results_are_printed_and_written(self):
        out = self.output(
            'bench', 'plaid/dog_gaps', '--num-envs', '3', '--threads', '1', '--seconds', '0.05',
            '--json', 'bench.json',
        )  # fmt: skip
        self.assertStartsWith(
            out, 'PD_Dog2D_Gaps_Terrain-v0, 3 simulations, 1 threads, random actions\n'
        )
        found = json.loads(pathlib.Path('bench.json').read_text())
        self.assertIn(found['machine'], out)
        self.assertIn(f'mujoco {machine.version("mujoco")}', found['machine'])
        self.assertGreater(found['projection']['64'], found['projection']['16'])
        self.assertBetween(found['projection']['16'], 1, 16)
        for name in ('ratio to the engine', 'ratio to mj_step', 'serial', 'single environment'):
            self.assertGreater(found[name], 0, name)

    def test_counts_physics_steps(self):
        """Also for a gait, whose steps differ in duration."""
        self.enterContext(mock.patch.object(bench, 'WARM', 0.1))
        found = bench.vector('FSM_Hopper2D_Terrain_Gaps-v0', 2, 1, 0.05)
        self.assertGreater(found['physics'], 50 * found['control steps per second'])
        found = bench.vector('PD_Dog2D_Flat-v0', 2, 1, 0.05)
        self.assertAlmostEqual(found['physics'] / found['control steps per second'], 10, delta=2)

    def test_invalid_arguments_are_rejected(self):
        self.assert_refused("did you mean 'PD_Dog2D_Gaps", 'bench', 'PD_Dog_Gaps_Terrain-v0')
        self.assert_refused('seconds is 0', 'bench', '--seconds', '0')
        self.assert_refused('folder', 'bench', '--json', 'no/bench.json')
        self.assert_only()


class ActingTest(parameterized.TestCase):
    @parameterized.parameters(
        ('PD_Dog2D_Flat-v0', 'clip'), ('Torque_Dog2D_LLC_Imitate_Flat-v0', 'zero'),
        ('FSM_Hopper2D_Terrain_Gaps-v0', 'zero'), ('PD_Biped3D_HLC_Soccer-v0', 'scripted'),
    )  # fmt: skip
    def test_best_policy_that_exists_is_chosen(self, id_, name):
        environment = suite.make(id_, {'random': 0})
        with mock.patch.object(policies, 'reference', side_effect=FileNotFoundError):
            found, policy = acting.best(environment, id_)
        self.assertEqual(found, name)
        self.assertEqual(policy(environment.reset()).shape, environment.action_spec().shape)

    def test_a_shipped_policy_is_best(self):
        environment = suite.make(GAPS, {'random': 0})
        self.assertEqual(acting.best(environment, GAPS)[0], 'reference')


class ClipTest(CommandTest):
    def setUp(self):
        super().setUp()
        write_terrainrl(motion.load('raptor_run_050'), 'run.json')

    def test_reads_checks_and_writes(self):
        out = self.output(
            'clip', 'run.json', '--character', 'raptor', '--output', 'run.npz', '--strip', 'run.png'
        )
        self.assertEqual(out, 'run: 121 frames, 0.5 s, no faults\nrun.npz\nrun.png\n')
        found, own = motion.load('run.npz'), motion.load('raptor_run_050')
        self.assertTrue(found.loop)
        np.testing.assert_allclose(found.poses[:, 3:], own.poses[:, 3:], atol=1e-9)
        with Image.open('run.png') as image:
            self.assertEqual(image.size, (8 * 320 + 7 * 4, 240))

    def test_a_map_and_every_frame(self):
        """The raptor's run on the legs of a biped, whose knees bend the other way."""
        pathlib.Path('map.json').write_text(
            json.dumps({'root': 'root', 'right_knee': 'right_ankle', 'left_knee': 'left_ankle'})
        )
        run_json = ('clip', 'run.json', '--character', 'biped2d', '--map', 'map.json')
        # It is a file of the raptor's.
        self.assert_refused('frame 0 has 26 numbers, the layout of 6 joints needs 14', *run_json)
        motion.load('raptor_run_050').save('run.npz')
        out = self.output('clip', 'run.npz', *run_json[2:], '--frames')
        self.assertIn('right_knee from right_ankle', out)
        self.assertIn('joints without a counterpart: right_hip', out)
        self.assertRegex(out, r'\n  joint limit +left_knee +121 +0 +120 +2\.12 +rad +\d+\n')
        self.assertRegex(out, r'\nframe 0, 0.000 s: joint limit, right_knee, \S+ rad\n')

    def test_options_of_captures(self):
        """A walk at 24 frames per second, in a file without units and with the figure facing z."""
        walk = motion.load('biped3d_mocap_walk')
        figure = own_clip_test.Figure('biped3d_mocap', walk, 25)
        own_clip_test.write_acclaim(figure, self.folder / 'a.asf', self.folder / 'a.amc')
        arguments = 'clip', 'a.amc', '--skeleton', 'a.asf', '--character', 'biped2d', '--scale', '1'
        ways = []
        for *options, duration in (
            (0.2,), ('--rate', '24', 1.0), ('--rate', '24', '--unit', '0.0508', 1.0),
            ('--rate', '24', '--forward=-z', 1.0),
        ):  # fmt: skip
            self.output(*arguments, *options, '--output', 'a.npz')
            found = motion.load('a.npz')
            self.assertAlmostEqual(found.duration, duration)
            ways.append(found.displacement[0])
        self.assertGreater(ways[0], 1)
        np.testing.assert_allclose(np.divide(ways, ways[0]), [1, 1, 2, -1], atol=1e-6)
        self.assert_refused("forward is 'z' and up '-z'; expected two axes", *arguments, '--up=-z')
        run_json = 'clip', 'run.json', '--character', 'raptor'
        self.assert_refused("option of .json files 'rate'; known: none", *run_json, '--rate', '60')

    def test_invalid_maps_are_rejected(self):
        for text, message in (
            ('[1, 2]', 'map.json: expected an object of names'), ('[1, 2', 'map.json: not JSON'),
            ('{"left_knee": 3}', 'map.json: expected an object'),
        ):  # fmt: skip
            pathlib.Path('map.json').write_text(text)
            arguments = 'run.json', '--character', 'raptor', '--map', 'map.json'
            self.assert_refused(message, 'clip', *arguments)

    def test_errors_leave_no_files(self):
        here = [path.name for path in self.folder.iterdir()]
        for message, *arguments in (
            ("unknown character 'cat'", 'run.json', '--character', 'cat'),
            ('no such file; did you mean', 'rum.json', '--character', 'raptor'),
            ('--cycle: 1 times', 'run.json', '--character', 'raptor', '--cycle', '1'),
            ("unknown suffix '.txt'", 'run.json', '--character', 'raptor', '--output', 'a.txt'),
        ):
            self.assert_refused(message, 'clip', *arguments)
        self.assert_only(*here)
