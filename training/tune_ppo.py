"""Searches settings of ppo.py with Ray Tune, on the cores of this machine or of a cluster.

    python training/tune_ppo.py PD_Biped2D_Flat-v0 --trials 16 --samples 4e5

Settings are drawn at random; ASHA (Li et al. 2020, arXiv:1810.05934) stops the worse half of the trials at
an eighth, a quarter and a half of the samples. A trial is a process on one core, and one whose machine is
lost continues from its checkpoint in RUNS, a folder or a URL that all machines reach. Writes nothing into
`trained/`. Needs `pip install 'trl_suite[train,rllib]'`.
"""

import argparse
import pathlib
import tempfile

import ppo
import ray
import storage
from ray import tune
from ray.tune import schedulers
from ray.tune.search.basic_variant import BasicVariantGenerator
from runs import check_seeds
from settings import settings_for

from trl_suite import suite
from trl_suite.adapters.ray import connect
from trl_suite.util.options import checked
from trl_suite.util.program import begin_script

SPACE = {
    'learning_rate': tune.loguniform(1e-4, 1e-3),
    'gamma': tune.choice([0.9, 0.95, 0.98]),
    'epochs': tune.choice([3, 5, 10]),
    'initial_std': tune.uniform(0.1, 0.4),
}
SCORE = 'normalized_return'
POINTS = 16  # of each learning curve


def trial(values, id_, samples, seed, runs):
    """Trains with some settings; reports each point of the learning curve."""

    class Trainer(ppo.Trainer):
        def evaluate(self, folder, divergence):
            super().evaluate(folder, divergence)
            tune.report({name: self.curve[-1][name] for name in ('samples', SCORE)})

    settings = settings_for(id_, samples=samples, evaluate_every=samples / POINTS, **values)
    ppo.Trainer = Trainer  # this process is for one trial
    with tempfile.TemporaryDirectory() as folder:
        path = pathlib.Path(folder, 'run')
        path.mkdir()
        with storage.kept(path, f'{runs}/{tune.get_context().get_trial_id()}'):
            ppo.train(id_, seed, settings, path, threads=1, progress=False)


def main(words=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('id', metavar='ID')
    parser.add_argument('--trials', type=int, default=16)
    parser.add_argument('--samples', type=float, default=4e5, help='control steps of a trial')
    parser.add_argument('--seed', type=int, default=1, help='of the settings and of every trial')
    parser.add_argument('--runs', default='runs/tune', help='folder, or URL of fsspec')
    parser.add_argument('--address', help="of Ray: 'auto', or HOST:PORT")
    chosen = parser.parse_args(words)
    id_ = suite.find(chosen.id).id
    checked('--trials', chosen.trials, int, at_least=1)
    checked('--samples', chosen.samples, float, above=0)
    check_seeds('--seed', chosen.seed)
    if not ray.is_initialized():
        connect(chosen.address)
    search = BasicVariantGenerator(random_state=chosen.seed)
    halving = schedulers.ASHAScheduler(
        'samples', SCORE, 'max', max_t=int(chosen.samples), reduction_factor=2,
        grace_period=int(chosen.samples / 8),
    )  # fmt: skip
    runs = storage.absolute(chosen.runs)
    function = tune.with_parameters(
        trial, id_=id_, samples=chosen.samples, seed=chosen.seed, runs=runs
    )
    found = tune.Tuner(
        tune.with_resources(function, {'cpu': 1}),
        param_space=SPACE,
        tune_config=tune.TuneConfig(
            num_samples=chosen.trials, search_alg=search, scheduler=halving
        ),
        run_config=tune.RunConfig(
            name='tune', storage_path=f'{runs}/results', verbose=0,
            failure_config=tune.FailureConfig(max_failures=10),
        ),
    ).fit()  # fmt: skip
    done = [result for result in found if result.metrics and SCORE in result.metrics]
    for result in sorted(done, key=lambda result: -result.metrics[SCORE]):
        values = ', '.join(f'{name} {value:.3g}' for name, value in result.config.items())
        print(f'{result.metrics[SCORE]:.3f} after {result.metrics["samples"]:8}: {values}')


if __name__ == '__main__':
    begin_script()
    main()
