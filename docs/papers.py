"""Tables of docs/reports/: published figures, and ours beside them from the results in the repository."""

from __future__ import annotations

import functools
import pathlib
from collections.abc import Iterable
from typing import Any

import gallery
import numpy as np

from trl_suite import sequences
from trl_suite.util.tables import markdown_table as table
from trl_suite.util.tables import share

RUNS = pathlib.Path(__file__).resolve().parent / 'continual'
# Action spaces (2017), supplement, table 4: normalised reward, mean ± standard deviation over 32
# episodes, and in brackets the normalised area under the learning curve.
MODELS = {'Torque': 'torque', 'Vel': 'velocity', 'PD': 'PD', 'MTU': 'muscle'}
MOTIONS = {
    'biped walk': ('Biped2D_LLC_Imitate_Flat-v0', (
        '.766 ± .312 (.479)', '.952 ± .003 (.631)', '.952 ± .003 (.700)', '.958 ± .007 (.717)')),
    'biped run': ('Biped2D_LLC_Imitate_Run_Flat-v0', (
        '.903 ± .010 (.694)', '.907 ± .011 (.730)', '.906 ± .006 (.788)', '.899 ± .009 (.536)')),
    'raptor run': ('Raptor2D_LLC_Imitate_Flat-v0', (
        '.614 ± .009 (.381)', '.873 ± .004 (.701)', '.955 ± .001 (.837)', '.953 ± .002 (.726)')),
    'dog bound': ('Dog2D_LLC_Imitate_Flat-v0', (
        '.789 ± .005 (.490)', '.979 ± .004 (.786)', '.980 ± .001 (.928)', '.903 ± .003 (.683)')),
}  # fmt: skip
# PLAiD (2018), tables 1 and 2, by terrain and their average.
TERRAINS = 'flat', 'incline', 'steps', 'slopes', 'gaps', 'average'
LEARNERS = {  # ours: name of the result files, final rewards, changes
    'PLAiD': ('Plaid', '.891 .800 .666 .602 .529 .698', '.054 .155 .001 .043 -.083 .063'),
    'TL-Only': ('FineTuning', '.790 .662 .615 .543 .626 .647', '-.065 -.044 -.235 -.242 .000 -.147'),
    'TL-Only with distillation': ('', '.903 .719 .781 .671 .543 .723', '.068 .039 -.030 -.062 -.133 -.024'),
    'MultiTasker': ('MultiTask', '.844 .757 .677 .656 .504 .688', '-.001 -.053 -.030 .119 .000 .009'),
}  # fmt: skip
GAITS = (
    'Dog2D_Terrain_Mixed', 'Dog2D_Terrain_Slopes_Mixed', 'Dog2D_Terrain_Narrow_Gaps',
    'Dog2D_Terrain_Tight_Gaps', 'Raptor2D_Terrain_Mixed', 'Raptor2D_Terrain_Slopes_Mixed',
    'Raptor2D_Terrain_Narrow_Gaps', 'Goat2D_Terrain_Variable_Steps', 'Goat2D_Terrain_Cliffs',
    'Hopper2D_Terrain_Mixed', 'Hopper2D_Terrain_Gaps', 'Biped2D_Terrain_Mixed', 'Biped2D_Terrain_Gaps', 'Dog2D_Terrain_Stairs_Rugged',
)  # fmt: skip
CONDITIONS = (
    'straight', 'straight, 0.3 m', 'straight, 0.7 m', 'general', 'made from the root',
    'made from the root, on the spot', 'made from the root, turning about', 'bumps of 6 cm',
    'belts of 0.6 m/s', 'pushes of 150 N', 'pushes of 250 N',
)  # fmt: skip

# DeepLoco (2017), supplement, table 3: normalised reward of a planner with the controller of a style,
# unchanged, fine-tuned and retrained.
STYLES = {
    'nominal': ('General', {}),
    'in place': ('InPlace', {}),
    'stand': ('Stand', {}),
    'high knees': ('HighKnees', {
        'soccer': '.19 .56 .51', 'path': '.10 .39 –', 'pillars': '.06 .43 –'}),
    'one straight leg': ('OneStraightLeg', {
        'soccer': '.51 .64 .45', 'path': '.08 .19 –', 'pillars': '.15 .35 –'}),
    'both legs straight': ('StraightLegs', {'soccer': '.16 .63 –'}),
    'forward lean': ('ForwardLean', {
        'soccer': '.64 .69 –', 'path': '.43 .44 –', 'pillars': '.43 .45 –'}),
    'sideways lean': ('SidewaysLean', {'soccer': '.41 .72 .74'}),
    'nominal or stand': ('General Stand', {}),
}  # fmt: skip
STANDS = (
    'straight', 'straight, 0.7 m', 'general', 'stops', 'stands', 'stands, pushes of 100 N',
    'stands on a ramp of 8 %', 'made from the root, on the spot', 'made from the root, turning about',
    'bumps of 6 cm', 'belts of 0.6 m/s', 'pushes of 150 N',
)  # fmt: skip
TASKS = {'soccer': 'Soccer', 'path': 'PathFollowing', 'pillars': 'Forest'}


@functools.cache
def tables() -> dict[str, dict[str, str]]:
    """Returns the tables of each page in docs/reports/, by name."""
    return {
        'action_spaces.md': {'returns': action_spaces()},
        'plaid.md': {'final rewards': plaid(0), 'changes': plaid(1)},
        'terrain_adaptive_gaits.md': {
            'distances': gaits(),
            'stairs': stairs(),
            'foresight': foresight(),
        },
        'deeploco.md': {
            'footsteps': footsteps(),
            'plans': plans(),
            'styles': styles(),
            'stands': stands(),
            'transfer': transfer(),
        },
    }


def figure(value: float) -> str:
    """Writes a share as the papers do: .952."""
    return f'{value:.3f}'.replace('0.', '.', 1)


def action_spaces() -> str:
    rows = []
    for motion, (name, published) in MOTIONS.items():
        records = [gallery.record(f'{model}_{name}') for model in MODELS]
        runs = [record['runs'] if record else [] for record in records]
        samples = min(run['curve'][-1]['samples'] for each in runs for run in each)
        rows += [
            (motion, 'published', *published),
            ('', f'ours, AUC to {samples / 1e6:.1f} M', *(returns(each, samples) for each in runs)),
        ]  # fmt: skip
    return table(('motion', '', *MODELS.values()), rows)


def returns(runs: list[dict[str, Any]], samples: int) -> str:
    """Returns mean and deviation over the episodes of all seeds, the area up to `samples`, and all samples."""
    if not runs:
        return '–'
    results = [run['evaluation'] for run in runs]
    shares = np.concatenate([np.divide(each['returns'], each['step_limit']) for each in results])
    areas = []
    for run in runs:
        points = [(0, 0.0)]  # nothing is gained before the first evaluation
        points += [(each['samples'], each['normalized_return']) for each in run['curve']]
        x, y = np.transpose([each for each in points if each[0] <= samples])
        areas.append(np.trapezoid(y, x) / x[-1])
    mean, deviation, area = map(figure, (shares.mean(), shares.std(), np.mean(areas)))
    return f'{mean} ± {deviation} ({area}; {runs[0]["curve"][-1]["samples"] / 1e6:.1f} M)'


def plaid(kind: int) -> str:
    """Returns final rewards (0), or how later stages change them (1)."""
    rows = []
    for learner, (name, *published) in LEARNERS.items():
        rows.append((learner, 'published', *published[kind].split()))
        for character in ('biped', 'dog', 'raptor') if name else ():
            paths = sorted((RUNS / f'plaid_{character}').glob(f'{name}_s*.json'))
            scores = np.mean([sequences.read(path)['scores'] for path in paths], axis=0)
            final, own = scores[-1], scores.diagonal()  # after all stages, after its own stage
            values = final / own - 1 if kind else final
            rows.append(('', f'our {character}', *map(figure, (*values, values.mean()))))
    return table(('learner', '', *TERRAINS), rows)


def gaits() -> str:
    rows = []
    for name in GAITS:
        id = f'FSM_{name}-v0'
        found = gallery.evaluation(id)
        low, high = found['distance_interval']
        default = gallery.record('default_gaits').get(id, {}).get('distance')
        rows.append((
            f'`{id}`', f'{found["distance"]:.0f} ({low:.0f} to {high:.0f})',
            '–' if default is None else f'{default:.0f}',
        ))  # fmt: skip
    return table(('environment', 'distance, m', 'default gait, m'), rows)


def footsteps() -> str:
    return compared(CONDITIONS, {'nominal': 'General', 'react': 'React'})


def plans() -> str:
    rows = []
    for id, found in gallery.record('plans').items():
        if 'scripted' in found:
            kinds = 'scripted', 'reference', f'reference with {controllers("React")}'
            each = scripted, trained, react = [found.get(kind) for kind in kinds]
            rows.append((
                f'`{id}`', counts(each), score(scripted), score(trained), lasting(trained), score(react),
                lasting(react),
            ))  # fmt: skip
    columns = (
        'episodes: scripted / trained / react', 'score, scripted', 'score, trained', 'no fall',
        'score, react', 'no fall, react',
    )  # fmt: skip
    return table(('planner', *columns), rows)


def counts(found: Iterable[dict[str, Any] | None]) -> str:
    """Returns the numbers of episodes of results."""
    return ' / '.join('–' if each is None else str(each['episodes']) for each in found)


def score(found: dict[str, Any] | None) -> str:
    return '–' if found is None else f'{found["reward"]:.2f}'


def lasting(found: dict[str, Any] | None) -> str:
    """Returns the share of episodes without a fall."""
    return '–' if found is None else share(found['survived'], found['episodes'])


def in_episodes(found: Iterable[dict[str, Any]], head: Iterable[str], rows: Iterable[Any]) -> str:
    """Returns a table of results that all have the same number of episodes, and this number."""
    [(count, seconds)] = {(each['episodes'], each['seconds']) for each in found}
    text = f'{count} episodes of {seconds:g} s each; shares without a fall with 95 % intervals (Wilson):'
    return f'{text}\n\n{table(head, rows)}'


def stairs() -> str:
    vertical, ramps = gallery.record('stairs'), gallery.record('ramps')
    shown = [
        (f'`{id}`', *(
            '{:.1f} ({:.1f} to {:.1f})'.format(each['distance'], *each['distance_interval'])
            for each in (found, ramps[id])
        ))
        for id, found in vertical.items()
    ]  # fmt: skip
    [(count, seed)] = {
        (each['episodes'], each['seed']) for of in (vertical, ramps) for each in of.values()
    }
    text = f'Mean distance to a fall in {count} episodes with seed {seed}, and its 95 % confidence interval:'
    head = 'environment', 'vertical, m', 'ramps of 0.1 m, m'
    return f'{text}\n\n{table(head, shown)}'


def foresight() -> str:
    found = gallery.record('foresight')
    rows = [
        (f'`{id}`', *(
            f'{np.mean(metres):.1f} ({min(metres):.1f} to {max(metres):.1f})'
            for metres in (each['policy'], each['base']['metres'], each['noisy']['metres'])
        ))
        for id, each in found.items()
    ]  # fmt: skip
    [(asked, budget, count)] = {
        (each['asked'], each['budget'], len(each['policy'])) for each in found.values()
    }
    text = (
        f'Each search ends at {asked:g} m or after {budget:,} cycles; mean of {count} terrains, and their '
        'range:'
    )
    head = 'environment', 'policy, m', 'base actions, m', 'all parameters, m'
    return f'{text}\n\n{table(head, rows)}'


def controllers(names: str) -> str:
    """Returns the ids of footstep controllers as a key of stored results has them."""
    return ', '.join(f'PD_Biped3D_LLC_{name}_Step-v0' for name in names.split())


def styles() -> str:
    rows, every = [], []
    for name, (part, _) in STYLES.items():
        found = gallery.record('footsteps').get(controllers(part))
        if found is None:
            continue
        general, *harder = (found[k] for k in ('general', 'pushes of 150 N', 'bumps of 3 cm'))
        every += [general, *harder]
        rows.append((
            name, f'{general["hip_above_knee"]:.2f}', pair(general, 'right_knee', 'left_knee'),
            pair(general, 'lean', 'tilt'),
            lasting(general), f'{general["landing"]:.3f}', *map(lasting, harder),
        ))  # fmt: skip
    columns = (
        'hip above knee, m',
        'knees, rad',
        'lean, rad',
        'no fall',
        'landing error, m',
        'no fall, 150 N',
        'no fall, 3 cm bumps',
    )
    return in_episodes(every, ('style', *columns), rows)


def pair(found: dict[str, Any], *keys: str) -> str:
    return ' / '.join(f'{round(found[key], 2) + 0.0:.2f}' for key in keys)  # no -0.00


def stands() -> str:
    return compared(STANDS, {'nominal': 'General', 'stand': 'Stand'})


def compared(conditions: Iterable[str], of: dict[str, str]) -> str:
    """Returns a table of footstep controllers, by their names in the table, under conditions."""
    found = [gallery.record('footsteps')[controllers(name)] for name in of.values()]
    rows = [
        (name, *(f'{lasting(each[name])}, {each[name]["landing"]:.3f} m' for each in found))
        for name in conditions
    ]
    every = (each[name] for each in found for name in conditions)
    return in_episodes(every, ('plans', *of), rows)


def transfer() -> str:
    rows = []
    for task, part in TASKS.items():
        found = gallery.record('plans')[f'PD_Biped3D_HLC_{part}-v0']
        for name, (controller, published) in STYLES.items():
            under = '' if name == 'nominal' else f' with {controllers(controller)}'
            ours = [found.get(kind + under) for kind in ('reference', 'fine-tuned')]
            ours.append(found.get(f'one planner, fine-tuned with {controllers(controller)}'))
            if task in published or any(ours):
                theirs = published.get(task, '– – –').split()
                rows.append((f'{task}, {name}', *theirs, *map(score, ours), counts(ours)))
    columns = (
        'unchanged', 'fine-tuned', 'retrained', 'ours, unchanged', 'ours, fine-tuned',
        'ours, one for all', 'episodes of ours',
    )  # fmt: skip
    return table(('task, controller', *columns), rows)
