"""Writes the reference pages from the catalogue and the code, and makes their pictures.

    python docs/generate.py [--again] [--only PATTERN] [--pages] [--check]

Pages are written anew; of pictures only those that are missing, or that show a policy that has been
replaced, unless --again. Needs `pip install 'trl_suite[video]'`. With --check nothing is written; it
fails if a page is not as it would be.
"""

from __future__ import annotations

import argparse
import json
import pathlib
import re
import statistics
import sys
import textwrap
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from trl_suite import acting, catalogue, characters, describe, files, policies, suite, terrain
from trl_suite.characters.muscles import MUSCLES
from trl_suite.commands import gallery
from trl_suite.describe import common
from trl_suite.mannequin import Mannequin

DOCS = pathlib.Path(__file__).resolve().parent
FAMILIES = {
    'imitation': 'Imitation: a clip is tracked on flat ground, or in three dimensions',
    'plaid': 'PLAiD: a clip is tracked over terrain',
    'terrainrl': 'TerrainRL: an action sets the gait of one whole cycle',
    'deeploco': 'DeepLoco: planned footsteps, and plans of them',
}
NAMES = (  # parts of ids
    ('`FSM`', 'a finite state machine drives the joints; an action sets its parameters'),
    (
        '`PD`, `Vel`, `Torque`, `MTU`',
        'actuation: position (proportional-derivative control), velocity, torque, muscle (muscle-tendon units)',
    ),
    ('`Imitate`, `LLC_Imitate`', 'a clip is tracked; LLC: low-level controller'),
    ('`LLC_…_Step`', 'planned footsteps are followed'),
    ('`HLC`', 'high-level controller: footsteps are planned, above a low-level controller'),
    ('`Hard`', 'the same tasks without hierarchy: joints are driven'),
    ('`FULL`', 'the three-dimensional biped with arms and head'),
    (
        '`…_Terrain-v0` of a biped, dog or raptor',
        'PLAiD: the ground is seen; without it blind, or flat',
    ),
    ('PLAiD', 'progressive learning and integration via distillation (Berseth et al. 2018)'),
    ('simbicon', 'a biped and its gait after SIMBICON (Yin, Loken, van de Panne 2007)'),
)
WITHOUT = {  # a shipped policy
    'scripted': 'a policy written by hand (`--policy scripted`)',
    'clip': 'the clip itself, whose poses are the targets, without feedback (`--policy clip`)',
    'zero': 'action 0 throughout, which for a gait is the default one (`--policy zero`)',
}
_LANDING = ('footsteps', 'footsteps2d', 'hike', 'soccer')
DRAWN = {  # beside the physics, and by which rules
    ' Orange and blue: where the foot that swings and the other one are to land.': _LANDING,
    ' Beads: the way of the centre of mass; red: the goal.': (
        'hike', 'soccer', 'journey', 'ball_journey',
    ),
}  # fmt: skip
README = '../README.md'
# What encloses the tables in the README that are written here.
SPEED = '<!-- speed, written by docs/generate.py -->', '<!-- /speed -->'
SOLVED = '<!-- solved, written by docs/generate.py -->', '<!-- /solved -->'
MACHINE = (  # of benchmarks/vector_environment.json
    'two cores of a shared virtual machine (x86-64, Python 3.11, MuJoCo 3.17), otherwise idle'
)
FIRST_LINES = 'Made by `python docs/generate.py`; do not edit.'
# Unit of terrain parameters that are no lengths in m, by a part of the name.
UNITS = {
    'LerpPow': '1, exponent', 'Speed': 'm/s', 'Density': '1/m²', 'Count': '1, number',
    'NumObstacles': '1, number', 'NumStrips': '1, number', 'NumSlices': '1, number',
    'Prob': '1, probability', 'TurnDelta': 'rad', 'Slope': '1, rise per m',
}  # fmt: skip
ON_ROLLING = re.compile('var2d_slopes_(.*)')
FEATURES = {
    'gaps': 'Gaps', 'walls': 'Walls', 'steps': 'Steps', 'mixed': 'Gaps, walls and steps',
    'narrow_gaps': 'Clusters of gaps with stepping stones between',
}  # fmt: skip


def pages() -> dict[str, str]:
    """Returns the text of every page by its path below docs/."""
    found = {'README.md': home()}
    environments: dict[Any, Any] = {}
    for row in catalogue.ROWS:
        # What differs by its ground only is compiled once.
        key = (row.rules, row.character, row.actuation, row.clip, repr(sorted(row.options.items())))
        if key not in environments:
            environments[key] = suite.build_row(row, {}, {})
        found[f'environments/{row.id}.md'] = environment_page(row, environments[key])
    found['environments/README.md'] = environment_index()
    for name in characters.CHARACTERS:
        found[f'characters/{name}.md'] = character_page(name)
    found['characters/README.md'] = character_index()
    for name in presets():
        found[f'terrains/{slug(name)}.md'] = terrain_page(name)
    found['terrains/README.md'] = terrain_index()
    found['speed.md'] = speed_page()
    found[README] = readme()
    return found


def presets() -> tuple[str, ...]:
    return (*terrain.PRESETS, *terrain.PRESETS3D)


def slug(name: str) -> str:
    return name.replace('/', '_')


def page(title: str, *parts: str) -> str:
    return '\n\n'.join((f'# {title}', *filter(None, parts), f'<sub>{FIRST_LINES}</sub>')) + '\n'


def table(header: Iterable[str], cells: Iterable[Iterable[object]]) -> str:
    """A table whose cells are Markdown."""
    rows = [tuple(row) for row in cells]
    return describe.markdown_table(describe.Table(tuple(header), rows), plain=True)


def picture(text: str, path: str) -> str:
    return f'![{text}](../pictures/{path})'


def links(folder: str, names: Iterable[str]) -> str:
    return ', '.join(f'[{name}](../{folder}/{slug(name)}.md)' for name in names)


def home() -> str:
    return page(
        'trl_suite',
        'Terrain RL Simulator (Berseth, Peng, van de Panne 2018) on MuJoCo: locomotion over random '
        'terrain, in the manner of `dm_control.suite`.',
        '![Six environments of the suite](pictures/suite.webp)',
        table(
            ('reference, made from the code', ''),
            (
                ('[Environments](environments/README.md)', f'{len(catalogue.ROWS)}, one page each'),
                ('[Characters](characters/README.md)', f'{len(characters.CHARACTERS)}, with their joints'),
                ('[Terrains](terrains/README.md)', f'{len(presets())} presets, with their parameters'),
            ),
        ),
        table(
            ('guide', ''),
            (
                ('[Guide](guide.md)', 'commands, combinations, footstep plans, pictures, training'),
                ('[Notebooks](../colab/README.md)', 'with pictures: first steps, training, and most of what follows'),
                ('[Make your own](make_your_own.md)', 'characters, terrains, tasks'),
                ('[Make your own: clips](make_your_own_clips.md)', 'from motion files'),
                ('[Clients](clients.md)', 'Gymnasium, Stable-Baselines3, TorchRL, RLlib, Shimmy'),
                ('[Multi-task and continual learning](continual_learning.md)', 'sequences, forgetting'),
                ('[What has been learnt](results.md)', 'the shipped policies, measured'),
                ('[Beside the papers](findings.md)', 'what they found, and what was found here'),
                ('[Differences from the original](differences.md)', 'and why'),
                ('[Speed](speed.md)', 'against raw MuJoCo and other libraries'),
                ('[The physics rate](../benchmarks/physics_rate.md)', 'how fine time must be'),
            ),
        ),
    )  # fmt: skip


# Environments


def environment_page(row: catalogue.Row, environment: Any) -> str:
    also = (f'{row.domain}/{row.task}', *row.aliases)
    facts = (
        ('also', ', '.join(f'`{name}`' for name in also)),
        ('tags', ', '.join(sorted(row.tags))),
        ('character', links('characters', [row.character])),
        ('terrain', links('terrains', [row.terrain])),
        ('actuation', row.actuation),
    )
    about, rules = [], []
    for title, parts in describe.parts(row, environment):
        text = f'## {describe.escape(title)}\n\n{describe.markdown(parts)}'
        if title.startswith('Terrain'):
            draws = f'{gallery.TERRAIN_DRAWS} draws of {row.terrain}'
            text += f'\n\n{picture(draws, gallery.terrain_path(row.terrain))}'
        (about if title.startswith(('Character', 'Links')) else rules).append(text)
    return page(
        row.id,
        row.description,
        strip(row, environment),
        table(('', ''), facts),
        f"```python\nfrom trl_suite import suite\n\nenvironment = suite.make('{row.id}')\n```",
        learnt(row),
        *rules,
        *about,
        '## Differs from the original\n\n'
        + '\n'.join(f'- {describe.escape(text)}' for text in describe.differences_of(row))
        + '\n\nReasons are in [Differences from the original](../differences.md).',
    )


def strip(row: catalogue.Row, environment: Any) -> str:
    _, begin, end, _ = gallery.scene(row.id)
    drawn = ''.join(text for text, rules in DRAWN.items() if row.rules in rules)
    name, _ = acting.best(environment, row.id)
    who = WITHOUT.get(name)
    said = f'No policy is shipped for it yet; this is {who}' if who else 'The shipped policy'
    return (
        f'{picture("Film strip", gallery.strip_path(row.id))}\n\n'
        f'*{said}: {begin:g} to {end:g} s of an episode, or until it ends.{drawn}*'
    )


def begun(settings: Mapping[str, Any]) -> str:
    """What a run began with."""
    start = settings['start']
    if start in catalogue.BY_ID:
        return f'[{start}]({start}.md)'
    shown = f'shown for {settings["cloned"] / 1e6:.2g} million plans'
    if start == 'guide':
        return f'what a guide with a map would do (`examples/guide.py`), {shown}'
    return f'what `--policy {start}` does, {shown}'


def learnt(row: catalogue.Row) -> str:
    found = gallery.record(row.id)
    if found is None:
        return ''
    run = next(run for run in found['runs'] if run['seed'] == found['shipped'])
    result, samples, taken = run['evaluation'], run['curve'][-1]['samples'], run['shipped_at']
    unit = 'plans' if 'hierarchical' in row.tags else 'steps'
    trained = f'{samples / 1e6:.2g} million {unit}'
    if row.rules == 'gait':
        trained = f'{samples:g} decisions, each of which tries all base actions'
    after = f'{taken:g} decisions' if row.rules == 'gait' else f'{taken / 1e6:.2g} million'
    if taken < run['settings'].get('cloned', 0) + run['settings'].get('evaluate_every', 0) / 2:
        after += ', when it had only been shown'
    seeds = len(found['runs'])
    facts = (
        ('return', f'{result["fraction"]:.1%} of the maximum {result["step_limit"]}'),
        ('episodes that lasted to the step limit', f'{result["full"]:.0%} of {result["episodes"]}'),
        ('mean distance', f'{result["distance"]:.1f} m'),
        ('trained for', f'{trained}, seed {run["seed"]}'),
        *([('policy taken after', after)] if taken < 0.99 * samples else []),
        *([('began with', begun(run['settings']))] if run['settings'].get('start') else []),
        ('on', run['machine']),
    )  # fmt: skip
    more = f'; grey: the other {seeds - 1} seeds' if seeds > 1 else ''
    return (
        f'## The shipped policy\n\n{table(("", ""), facts)}\n\n'
        f'{picture("Learning curve", gallery.curve_path(row.id))}\n\n'
        f'*While it learnt, without noise{more}. All policies: [What has been learnt](../results.md).*'
    )


def environment_index() -> str:
    shipped = policies.available()
    parts = []
    for domain, title in FAMILIES.items():
        rows = [row for row in catalogue.ROWS if row.domain == domain]
        cells = [
            (
                f'[{row.id}]({row.id}.md)', row.description, links('characters', [row.character]),
                links('terrains', [row.terrain]), 'yes' if row.id in shipped else '',
            )
            for row in rows
        ]  # fmt: skip
        header = ('environment', 'what', 'character', 'terrain', 'policy')
        parts += [f'## {title}', picture(domain, f'families/{domain}.jpg'), table(header, cells)]
    return page(
        'Environments',
        f'{len(catalogue.ROWS)} environments in {len(FAMILIES)} families; a trained policy is shipped '
        f'for {len(shipped)} of them. On the command line, `trl-suite list` selects by family (`--domain`), '
        'character, actuation, terrain or tag, and `trl-suite info ID` prints what a page says. Their '
        'names are those of the original, misspelt where it is.',
        table(('in a name', 'means'), NAMES),
        *parts,
    )


# Characters


def character_page(name: str) -> str:
    row = characters.CHARACTERS[name]
    mannequin = Mannequin(name)
    figure = mannequin.character
    weights = [joint.weight for joint in row.joints.values()]
    joints = common.links(figure, mannequin.environment.physics, (common.REWARD_WEIGHT, weights))
    used = [each.id for each in catalogue.ROWS if each.character == name]
    return page(
        name,
        row.description,
        picture(name, gallery.character_path(name)),
        f'{common.figures(figure)}. '
        + (
            'Its root is free in three dimensions.' if row.spatial else 'It moves in the x-z plane.'
        ),
        '## Links and joints',
        describe.markdown_table(joints),
        'Limits are those of torque; kp and kd are the gains of position control (of velocity control '
        'kd), before actuation models split the damping.',
        table(
            ('', ''),
            (
                ('end effectors', ', '.join(row.end_effectors)),
                ('a fall is the ground under', ', '.join(row.fall_links)),
                ('clip of its own', suite.DEFAULT_CLIPS.get(name, 'none')),
            ),
        ),
        f'## Environments\n\n{links("environments", used) or "None; it is for `suite.build`."}',
    )


def character_index() -> str:
    cells = [
        (
            f'[{name}]({name}.md)', picture(name, gallery.character_path(name)), row.description,
            sum(each.character == name for each in catalogue.ROWS),
        )
        for name, row in characters.CHARACTERS.items()
    ]  # fmt: skip
    return page(
        'Characters',
        f'Any of them goes with any terrain of as many dimensions and with position, velocity and torque '
        f'control; {", ".join(MUSCLES)} with muscles too: `suite.build`. Who has no clip needs '
        "`task='walk'`, or a clip of yours. For a character of your own see "
        '[Make your own](../make_your_own.md).',
        table(('character', '', 'what', 'environments'), cells),
    )


# Terrains


def terrain_page(name: str) -> str:
    ground = terrain.load(name)
    defaults = generator(ground).defaults
    sets = ground.parameter_sets or ({},)
    titles = ['value'] if len(sets) == 1 else [f'set {i}' for i in range(len(sets))]
    cells = [
        (
            key, 'no effect' if key in terrain.IDLE.get(ground.type, ()) else unit(ground.type, key),
            *(f'{values.get(key, default):g}' for values in sets), f'{default:g}',
        )
        for key, default in defaults.items()
    ]  # fmt: skip
    length = gallery.terrain_length(ground)
    shown = (
        'from above; arrows are starts'
        if ground.spatial
        else 'from the side; the dotted line is the start'
    )
    parameters = table(('parameter', 'unit', *titles, 'default of the type'), cells)
    blended = 'Sets are blended by the task option `blend`, 0 to {}; the picture shows set 0.'
    used = [row.id for row in catalogue.ROWS if row.terrain == name]
    size = f'{length:g} m on a side' if ground.spatial else f'{length:g} m'
    return page(
        name,
        f'Type `{ground.type}`: {meaning(ground)}',
        picture(f'Draws of {name}', gallery.terrain_path(name)),
        f'*{gallery.TERRAIN_DRAWS} draws of {size}, {shown}.*',
        f'## Parameters\n\n{parameters if cells else "None."}',
        blended.format(len(sets) - 1) if len(sets) > 1 else '',
        f'## Environments\n\n{links("environments", used) or "None; it is for `suite.build`."}',
    )  # fmt: skip


def generator(ground: terrain.Terrain) -> Any:
    return (terrain.GENERATORS3D if ground.spatial else terrain.GENERATORS)[ground.type]


def meaning(ground: terrain.Terrain) -> str:
    """What ground of a type is like: the first line of its generator."""
    said = (generator(ground).function.__doc__ or '').partition('\n')[0]
    if said:
        return said
    rolling = ON_ROLLING.fullmatch(ground.type)
    feature = rolling[1] if rolling else ground.type.removeprefix('var2d_')
    return f'{FEATURES[feature]} on {"rolling" if rolling else "level"} ground.'


def unit(type_name: str, key: str) -> str:
    if type_name == 'var3d_checkers':
        return 'm'
    return next((unit for part, unit in UNITS.items() if part in key), 'm')


def terrain_index() -> str:
    parts = []
    for title, names in (
        ('In the plane', terrain.PRESETS),
        ('In three dimensions', terrain.PRESETS3D),
    ):
        cells = [
            (
                f'[{name}]({slug(name)}.md)', f'`{ground.type}`', meaning(ground),
                max(len(ground.parameter_sets), 1),
                sum(row.terrain == name for row in catalogue.ROWS),
            )
            for name, ground in names.items()
        ]  # fmt: skip
        header = ('preset', 'type', 'what', 'parameter sets', 'environments')
        parts += [f'## {title}', table(header, cells)]
    return page(
        'Terrains',
        'Ground is drawn anew every episode. `trl-suite terrain NAME` plots draws of a preset or of a '
        'file of parameters; a terrain from a function, an image or a mesh: '
        '[Make your own](../make_your_own.md).',
        *parts,
    )


# Speed


PROJECTED = '1024 rows, 2 threads'


def speeds() -> dict[str, Any]:
    path = DOCS.parent / 'benchmarks' / 'vector_environment.json'
    return json.loads(path.read_text(encoding='utf-8'))


def readme() -> str:
    """README.md with its tables."""
    text = (DOCS / README).read_text(encoding='utf-8')
    for (start, end), written in ((SOLVED, solved()), (SPEED, speed())):
        before, _, rest = text.partition(start)
        text = f'{before}{start}\n{written}\n{end}{rest.partition(end)[2]}'
    return text


def solved() -> str:
    """How well the shipped policies do, by family."""
    cells = []
    for domain in FAMILIES:
        rows = [row for row in catalogue.ROWS if row.domain == domain]
        entries = filter(None, (gallery.record(row.id) for row in rows))
        found = [
            next(run for run in entry['runs'] if run['seed'] == entry['shipped'])['evaluation']
            for entry in entries
        ]
        middle = {
            name: statistics.median(each[name] for each in found)
            for name in ('fraction', 'full', 'distance')
        }
        # A gait has no reward that ends with a limit: what counts is how far it comes.
        gaits = all(row.rules == 'gait' for row in rows)
        cells.append((
            f'`{domain}`', f'{len(found)} of {len(rows)}',
            *(('–', '–') if gaits else (f'{middle["fraction"]:.2f}', f'{middle["full"]:.0%}')),
            f'{middle["distance"]:.0f} m',
        ))  # fmt: skip
    said = (
        'The median over the shipped policies of a family, each run without noise for 50 '
        'episodes: the return over its maximum, the share of episodes that lasted to the end, and '
        'the mean distance.'
    )
    header = ('family', 'trained', 'return', 'complete', 'distance')
    return f'{textwrap.fill(said, 100)}\n\n{table(header, cells)}'


def speed() -> str:
    """The rates of a few environments."""
    found, cells = speeds(), []
    for id, alone in found['single'].items():
        own, raw = found['ours'][id], found['engine alone'][id]
        one, two = (f'256 rows, {threads} threads' for threads in (1, 2))
        cells.append((
            f'`{id}`', f'{alone["single environment"]} ({alone["single environment"] / alone["raw mj_step"]:.2f})',
            *(f'{own[n]["control steps per second"]} ({own[n]["control steps per second"] / raw[n]:.2f})'
              for n in (one, two)),
            f'{own[one]["reset, ms per row"]:.2f} ms',
            f'{found["memory per row, kB"][id]} kB',
        ))  # fmt: skip
    header = ('', 'one', '256, one thread', '256, two threads', 'a reset', 'memory of each')
    said = (
        'Control steps per second (of 10 physics steps) under random actions, resets with new terrain '
        'included if there are 256; in brackets the share of what raw MuJoCo does with the same model, '
        '`mj_step` for one, MuJoCo on the same threads for 256 (above 1: without resets bodies lie on the ground, '
        f'where steps cost more). By `python benchmarks/vector_environment.py`, on {MACHINE}.'
    )
    return f'{textwrap.fill(said, 100)}\n\n{table(header, cells)}'


def speed_page() -> str:
    found = speeds()
    cells = [
        (
            f'`{id}`', setting, own['control steps per second'],
            f'{own["control steps per second"] / found["engine alone"][id][setting]:.2f}',
            f'{own["serial, us per row"]:.2f}', f'{own["reset, ms per row"]:.2f}',
            f'{own["share of resets"]:.2f}',
        )
        for id, settings in found['ours'].items()
        for setting, own in settings.items()
    ]  # fmt: skip
    single = [
        (
            f'`{id}`', own['single environment'], own['raw mj_step'],
            f'{own["single environment"] / own["raw mj_step"]:.2f}', found['memory per row, kB'][id],
        )
        for id, own in found['single'].items()
    ]  # fmt: skip
    projected = [
        (f'`{id}`', *(f'{share:g}' for share in settings[PROJECTED]['projection'].values()))
        for id, settings in found['ours'].items()
    ]
    return page(
        'Speed',
        f'Measured by `python benchmarks/vector_environment.py` on {MACHINE}. Actions are random; a '
        'control step is 10 physics steps; rows are simulations that step together. `trl-suite bench '
        'ID` measures your machine.',
        '## One environment',
        table(('environment', 'control steps per s', 'raw `mj_step`', 'ratio', 'kB per row of many'), single),
        '## Many at once',
        'Resets with new terrain included. *Ratio* is to what MuJoCo alone does with the same models, rows '
        'and threads; it may be above 1, as without resets bodies lie on the ground, where steps cost '
        'more. *Serial* is what one thread does of a control step while the others wait, in us per row; '
        '*resets* is their share of the time.',
        table(('environment', '', 'control steps per s', 'ratio', 'serial', 'a reset, ms', 'resets'), cells),
        '![Rates by rows and threads](../benchmarks/vector_environment.png)',
        '## More cores',
        "A projection, not a measurement: how many times one core's rate 1024 simulations would reach, by "
        "Amdahl's law from what one thread does alone (*serial* above). Memory and caches that cores share "
        'are left out. `trl-suite bench ID` prints the same of your machine.',
        table(('environment', '16 cores', '64 cores'), projected),
        '## Other libraries',
        'In the same run, as a share of the `mj_step` rate of their own models; none of them has terrain.',
        table(('', 'share'), ((name, f'{share:.2f}') for name, share in found['peers'].items())),
        'All figures: [vector_environment.json](../benchmarks/vector_environment.json). What learning '
        'costs, and high-level steps, `benchmarks/training.py` and `benchmarks/hierarchy.py` print.',
    )  # fmt: skip


def stale(found: dict[str, str]) -> Iterator[str]:
    """Yields pages that are not as they would be, or should not be."""
    for path, text in found.items():
        file = DOCS / path
        if not file.exists() or file.read_text(encoding='utf-8') != text:
            yield path
    yield from gone(found)


def gone(found: dict[str, str]) -> list[str]:
    """Returns pages of what there is no more."""
    there = [p.relative_to(DOCS) for name in ('environments', 'characters', 'terrains')
             for p in (DOCS / name).glob('*.md')]  # fmt: skip
    return [path.as_posix() for path in there if path.as_posix() not in found]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--again', action='store_true', help='make pictures that are there, too')
    parser.add_argument('--only', default='*', metavar='PATTERN', help='of pictures, as an id')
    parser.add_argument('--pages', action='store_true', help='make no pictures')
    parser.add_argument('--check', action='store_true', help='only tell whether pages are fresh')
    arguments = parser.parse_args()
    found = pages()
    old = list(stale(found))
    if arguments.check:
        print('\n'.join(f'docs/{path} is not fresh; run docs/generate.py' for path in old))
        return int(bool(old))
    for path in gone(found):
        (DOCS / path).unlink()
    for path in set(old) & set(found):
        file = DOCS / path
        file.parent.mkdir(exist_ok=True)
        with files.replacing(file) as part:
            part.write_text(found[path], encoding='utf-8')
    print(f'{len(old)} pages written')
    if arguments.pages:
        return 0
    written, failed = gallery.make(DOCS / 'pictures', arguments.only, arguments.again)
    for name, error in failed.items():
        print(f'{name}: {error}', file=sys.stderr)
    print(f'{len(written)} pictures made')
    return int(bool(failed))


if __name__ == '__main__':
    sys.exit(main())
