"""The page of continual learning: its numbers by hand, and whether it is up to date."""

import copy
import json
from unittest import mock

import continual_results
import numpy as np
import pytest
from helpers import FolderTest

from trl_suite import evaluation, sequences
from trl_suite.runs import results


class Fixed:
    """Takes no samples."""

    def train(self, stage):
        pass

    def policy(self):
        return lambda observation: observation


class ResultsTest(FolderTest):
    def setUp(self):
        super().setUp()
        made_up = mock.Mock(
            side_effect=lambda cases, *_, **__: [{'normalized_return': 0.1}] * len(cases)
        )
        path = self.folder / 'template.json'
        with mock.patch.object(evaluation, 'evaluate_all', made_up):
            self.template = sequences.run('plaid_biped', Fixed(), 100, path, 1)
        path.unlink()

    def store(self, learner, seed, scores, curve):
        """Writes a run of len(scores) stages with the same curve in all of them."""
        result = copy.deepcopy(self.template)
        del result['metrics']
        stages = len(scores)
        result |= {
            'learner': f'module:{learner}', 'seed': seed, 'seconds': [1.0] * stages,
            'scores': scores, 'samples': [[100, 0, 0, 0, 0]] * stages,
            'curves': [[curve] * 20] * stages,
        }  # fmt: skip
        result['digest'] = results.digest(result)
        path = self.folder / f'{learner}_s{seed}.json'
        path.write_text(json.dumps(result))
        return path

    def test_stages_that_all_runs_have_are_compared(self):
        """Two stages of five are compared: one run has no more."""
        self.store('Scratch', 0, [[0.5, 0.1, 0, 0, 0], [0.3, 0.4, 0, 0, 0]], 0.2)
        self.store('Plaid', 0, [[0.5, 0.2, 0, 0, 0], [0.6, 0.7, 0, 0, 0], [0.9] * 5], 0.6)
        self.store('Plaid', 1, [[0.5, 0.2, 0, 0, 0], [0.4, 0.7, 0, 0, 0]], 0.6)
        self.store('Other', 0, [[0.9] * 5], 0.6)  # a single stage has no metrics
        runs = continual_results.load(self.folder)
        self.assertEqual(list(runs), ['Scratch', 'Plaid'])
        # Plaid's performance is 0.65 and 0.55, its forgetting -0.1 and 0.1; the interval of two
        # values is 12.706 times half their difference.
        self.assertEqual(
            continual_results.row(runs, 'Plaid', 2),
            ['`Plaid`', '2', '0.600 ± 0.635', '0.600 ± 0.000', '0.000 ± 1.271', '0.000 ± 1.271',
             '0.100 ± 0.000', '0.500'],
        )  # fmt: skip
        self.assertEqual(
            continual_results.row(runs, 'Scratch', 2),
            ['`Scratch`', '1', '0.350', '0.450', '0.200', '-0.200', '0.000', '–'],
        )
        text = continual_results.section(self.folder)
        self.assertIn('`plaid_biped`, 100 samples per stage', text)
        self.assertIn('the first 2 of 5 stages (flat, incline), 1 episodes', text)
        self.assertIn('| `Plaid` | 0.500 ± 1.271 | 0.700 ± 0.000 |', text)
        for picture in (continual_results.curves_picture, continual_results.scores_picture):
            paths = self.folder / 'a.svg', self.folder / 'b.svg'
            for path in paths:
                picture(runs, path)
            self.assertEqual(paths[0].read_bytes(), paths[1].read_bytes())
            self.assertIn(b'>slopes<', paths[0].read_bytes())

    def test_runs_that_cannot_be_compared_are_refused(self):
        path = self.store('Plaid', 0, [[0.5] * 5] * 2, 0.6)
        (self.folder / 'again.json').write_bytes(path.read_bytes())
        with self.assertRaisesRegex(ValueError, 'a second run of Plaid with seed 0'):
            continual_results.load(self.folder)
        (self.folder / 'again.json').unlink()
        other = json.loads(path.read_text()) | {'budget': 200, 'seed': 1}
        other['digest'] = results.digest(other)
        (self.folder / 'other.json').write_text(json.dumps(other))
        with self.assertRaisesRegex(ValueError, 'settings differ'):
            continual_results.load(self.folder)
        path.write_text(path.read_text().replace('0.5', '0.6'))
        with self.assertRaisesRegex(ValueError, 'Plaid_s0.json: digest'):
            continual_results.load(self.folder)


class PageTest(FolderTest):
    def test_page_is_made_from_the_results(self):
        """Run `python training/continual_results.py` if this fails."""
        text = (continual_results.DOCS / 'continual_learning.md').read_text(encoding='utf-8')
        self.assertEqual(continual_results.page(text), text)

    def test_results_have_the_settings_of_the_benchmark(self):
        for path in continual_results.FOLDER.glob('*/*.json'):
            with self.subTest(path.name):
                result = sequences.read(path, complete=False)
                self.assertEqual(sequences.departures(result), [])
                self.assertEqual(result['sequence'], path.parent.name)

    @pytest.mark.slow  # .ci/run runs it
    def test_the_learner_of_the_page_runs(self):
        text = (continual_results.DOCS / 'continual_learning.md').read_text(encoding='utf-8')
        code = text.split('```python\n')[1].split('```')[0]
        names = {'__name__': 'page'}
        path = repr(f'{self.folder}/result.json')
        code = code.replace("'result.json'", path).replace('1000', '200')
        exec(compile(code, 'continual_learning.md', 'exec'), names)
        self.assertEqual(np.diag(names['result']['samples']).tolist(), [192] * 5)
