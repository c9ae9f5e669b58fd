"""Every environment returns the numbers that were stored, in its first steps.

`python benchmarks/golden.py store tests/golden.json` writes them, for seeds with which they do not
depend on the last bits of anything, so that they hold on other processors.
"""

import importlib.util
import json
import pathlib

import numpy as np
from absl.testing import absltest, parameterized

from trl_suite import suite

ROOT = pathlib.Path(__file__).parents[1]
STORED = json.loads((ROOT / 'tests/golden.json').read_text())


def golden():
    spec = importlib.util.spec_from_file_location('golden', ROOT / 'benchmarks/golden.py')
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


GOLDEN = golden()


class GoldenTest(parameterized.TestCase):
    """Observations and rewards as stored."""

    def test_all_environments_are_stored(self):
        self.assertCountEqual(STORED, suite.ALL_IDS)

    @parameterized.parameters(*suite.ALL_IDS)
    def test_first_steps_equal_the_stored_ones(self, id_):
        stored = dict(STORED[id_])
        found = GOLDEN.summary(id_, stored.pop('seed'))
        self.assertCountEqual(found, stored)
        for name, expected in stored.items():
            tolerance = GOLDEN.TOLERANCE
            np.testing.assert_allclose(
                found[name][: len(expected)], expected, tolerance, tolerance, err_msg=name
            )


if __name__ == '__main__':
    absltest.main()
