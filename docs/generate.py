"""Writes the reference pages from the catalogue and the code, and renders their pictures.

    python docs/generate.py [--overwrite] [--filter PATTERN] [--pages]

The repository keeps the pages of `pages`. Those of `site_pages`, which describe one environment,
family, character or terrain each, are not tracked: the build of the site writes them, too. Pictures
are rendered if they are missing or show a policy that has been replaced; --overwrite renders all.
Needs `pip install 'trl_suite[video]'`.
"""

from __future__ import annotations

import argparse
import functools
import pathlib
import statistics
import sys
import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

import gallery
import papers

from trl_suite import characters, describe, policies, suite, terrain
from trl_suite.actuation.muscles import MUSCLES
from trl_suite.describe import common, options
from trl_suite.environments import named_policies as acting
from trl_suite.registry import catalogue
from trl_suite.registry.build import task_type
from trl_suite.rendering.kinematic_viewer import KinematicViewer
from trl_suite.tasks.variation import pushes, sensors, worlds
from trl_suite.util import errors, files, tables
from trl_suite.util.program import begin_script
from trl_suite.util.tables import markdown_table as table

DOCS = pathlib.Path(__file__).resolve().parent
SOURCES = 'trl_suite', 'trained', 'xml', 'mocap'  # what the pages of the site describe
NAMES = (  # parts of ids
    ('`FSM`', 'a finite state machine drives the joints; an action sets its parameters'),
    (
        '`PD`, `Vel`, `Torque`, `MTU`',
        'actuation: position (proportional-derivative control), velocity, torque, muscle (muscle-tendon units)',
    ),
    (
        '`Imitate`, `LLC_Imitate`',
        'imitation: a clip is tracked; LLC: low-level controller; `Imitate-Steps`: over low boxes',
    ),
    ('`LLC_…_Step`, `Run_FootStep`, `FULL_Imitate-Steps`', 'footstep tracking'),
    ('`HLC`', 'high-level controller: plans footsteps for a low-level controller'),
    ('`Hard`', 'the same tasks without hierarchy: the policy controls the joints'),
    ('`FULL`', 'the three-dimensional biped with arms and head'),
    (
        '`…_Terrain-v0` of a biped, dog or raptor',
        'in imitation and PLAiD: the ground is observed',
    ),
)
WITHOUT = {  # policies shown for environments without a shipped policy
    'scripted': 'the hand-written policy (`--policy scripted`)',
    'clip': 'the clip as joint targets, without feedback (`--policy clip`)',
    'zero': 'action 0 in every step, which is the default gait (`--policy zero`)',
}
SUBSTEPS = 10  # of a control step in benchmarks/vector_environment.py
MACHINE = (  # that of docs/data/vector_environment.json
    'two cores of a shared virtual machine (x86-64, Python 3.11, MuJoCo 3.17), otherwise idle'
)
FIRST_LINES = 'Made by `python docs/generate.py`; do not edit.'


def pages() -> dict[str, str]:
    """Returns the text of every page that the repository keeps, by its path below docs/."""
    tables = {
        '../README.md': {'solved': solved()},
        'realism.md': option_tables() | {'cost': cost()},
        **{f'reports/{name}': found for name, found in papers.tables().items()},
    }
    return {
        'environments.md': environment_index(),
        'characters.md': character_index(),
        'terrains.md': terrain_index(),
        'speed.md': speed_page(),
        **{path: filled(path, found) for path, found in tables.items()},
    }


def site_pages() -> dict[str, Callable[[], str]]:
    """Returns a function for every page that only the site has, by its path below docs/."""
    return {
        f'{folder}/{slug(name)}.md': functools.partial(text, name)
        for folder, (text, names) in SITE.items()
        for name in names
    }


def presets() -> tuple[str, ...]:
    return (*terrain.PRESETS, *terrain.PRESETS3D)


def slug(name: str) -> str:
    return name.replace('/', '_')


def page(title: str, *parts: str) -> str:
    return '\n\n'.join((f'# {title}', *filter(None, parts), f'<sub>{FIRST_LINES}</sub>')) + '\n'


def picture(text: str, path: str) -> str:
    return f'![{text}](../pictures/{path})'


def links(folder: str, names: Iterable[str]) -> str:
    return ', '.join(f'[{name}](../{folder}/{slug(name)}.md)' for name in names)


# Environments


_BUILT: dict[Any, Any] = {}


def built(spec: catalogue.EnvSpec) -> Any:
    """Returns the environment of a spec, or of one that differs only in terrain."""
    options_ = repr(sorted(spec.options.items()))
    key = spec.task_type, spec.character, spec.actuation, spec.clip, options_
    if key not in _BUILT:
        _BUILT[key] = suite.build_environment(spec, {}, {})
    return _BUILT[key]


def environment_page(id: str) -> str:
    spec = catalogue.BY_ID[id]
    environment = built(spec)
    also = (f'{spec.domain}/{spec.task}', *spec.aliases)
    facts = (
        ('other names', ', '.join(f'`{name}`' for name in also)),
        ('tags', ', '.join(sorted(spec.tags))),
        ('character', links('characters', [spec.character])),
        ('terrain', links('terrains', [spec.terrain])),
        ('actuation', spec.actuation),
    )
    about, rules = [], []
    for title, parts in describe.parts(spec, environment):
        text = f'## {tables.escape(title)}\n\n{tables.markdown(parts)}'
        if title.startswith('Terrain'):
            draws = f'{gallery.TERRAIN_DRAWS} samples of {spec.terrain}'
            text += f'\n\n{picture(draws, gallery.terrain_path(spec.terrain))}'
        (about if title.startswith(('Character', 'Links')) else rules).append(text)
    # The search of the site takes an id for one word.
    words = spec.id.removesuffix('-v0').replace('_', ', ')
    keywords = f'---\nmyst:\n  html_meta:\n    keywords: {words}\n---\n\n'
    return keywords + page(
        spec.id,
        spec.description,
        strip(spec, environment),
        table(('', ''), facts),
        f"```python\nfrom trl_suite import suite\n\nenvironment = suite.make('{spec.id}')\n```",
        learnt(spec),
        *rules,
        *about,
        '## Differences from the original\n\n'
        + '\n'.join(f'- {tables.escape(text)}' for text in describe.differences_of(spec))
        + '\n\nReasons are in [Differences from the original](../differences.md).',
    )


def strip(spec: catalogue.EnvSpec, environment: Any) -> str:
    _, begin, end, _ = gallery.scene(spec.id)
    drawn = describe.description_of(spec).legend
    name, _ = acting.best(environment, spec.id)
    who = WITHOUT.get(name)
    said = f'No policy is shipped; the pictures show {who}' if who else 'The shipped policy'
    return (
        f'{picture("Film strip", gallery.strip_path(spec.id))}\n\n'
        f'*{said}: {begin:g} to {end:g} s of an episode, or to its end.{drawn}*'
    )


EXPERTS = {
    'expert': 'an expert with a map (`training/expert.py`)',
    'joint_expert': 'planned footsteps and the controller that tracks them (`training/expert.py`)',
    'nominal': 'the policy of [PD_Biped3D_LLC_General_Step-v0](PD_Biped3D_LLC_General_Step-v0.md)',
}


def begun(settings: Mapping[str, Any], unit: str) -> str:
    """Returns how the policy of a run was initialised; `unit`: what its samples are."""
    start = settings['start']
    if start in catalogue.BY_ID:
        return f'[{start}]({start}.md)'
    imitated = EXPERTS.get(start, f'`--policy {start}`')
    return f'imitation of {imitated} for {settings["cloned"] / 1e6:.2g} million {unit}'


def observing(spec: catalogue.EnvSpec) -> list[tuple[str, str]]:
    """Returns the results of the same environment with observed terrain, if there is one."""
    other = f'{spec.id.removesuffix("-v0")}_Terrain-v0'
    result = gallery.evaluation(other)
    if not result:
        return []
    return [
        (
            'the same, but with observed terrain',
            f'[{other}]({other}.md): return {result["normalized_return"]:.1%}, '
            f'{result["completion_rate"]:.0%} of {result["episodes"]} episodes reached the step limit',
        )
    ]


def learnt(spec: catalogue.EnvSpec) -> str:
    found = gallery.record(spec.id)
    if not found:
        return ''
    run = gallery.shipped_run(found)
    result, samples = gallery.evaluation(spec.id), run['curve'][-1]['samples']
    taken = run['shipped_at']
    settings, unit = run['settings'], task_type(spec).samples
    first = settings.get('first', settings)
    begin = settings if settings.get('start') else first
    after = f'{taken / 1e6:.2g} million'
    if taken < settings.get('cloned', 0) + settings.get('evaluate_every', 0) / 2:
        after += ', at the end of the imitation'
    seeds = len(found['runs'])
    gait = task_type(spec).score == 'distance'
    facts = (
        *(
            [] if gait else
            [('return', f'{result["normalized_return"]:.1%} of the maximum {result["step_limit"]}')]
        ),
        ('episodes that reached the step limit', f'{result["completion_rate"]:.0%} of {result["episodes"]}'),
        ('mean distance', f'{result["distance"]:.1f} m'),
        ('trained for', f'{samples / 1e6:.2g} million {unit}, seed {run["seed"]}'),
        *([('policy saved after', after)] if taken < 0.99 * samples else []),
        *([('of these with PPO', f'the last {settings["samples"] / 1e6:.2g} million')] if settings is not begin else []),
        *([('initial policy', begun(begin, unit))] if begin.get('start') else []),
        *observing(spec),
        ('machine', run['machine']),
    )  # fmt: skip
    more = f'; grey: the other {seeds - 1} seeds' if seeds > 1 else ''
    noise = 'without noise' if first is settings else 'with PPO of the actions it draws'
    return (
        f'## The shipped policy\n\n{table(("", ""), facts)}\n\n'
        f'{picture("Learning curve", gallery.curve_path(spec.id))}\n\n'
        f'*{"Distance" if gait else "Return"} during training, {noise}{more}. All policies: [Results](../results.md).*'
    )


def family_page(domain: str) -> str:
    specs = [spec for spec in catalogue.SPECS if spec.domain == domain]
    title, _, about = catalogue.FAMILIES[domain].partition(': ')
    cells = (
        (
            f'[{spec.id}](../environments/{spec.id}.md)<br>{spec.description}',
            picture('Film strip', gallery.strip_path(spec.id)),
        )
        for spec in specs
    )
    return page(
        title,
        f'{about[0].upper()}{about[1:]}: {len(specs)} environments.',
        picture(domain, f'families/{domain}.jpg'),
        table(('environment', ''), cells),
    )


def environment_index() -> str:
    parts = []
    for domain, title in catalogue.FAMILIES.items():
        specs = [spec for spec in catalogue.SPECS if spec.domain == domain]
        cells = [
            (
                f'`{spec.id}`',
                spec.description,
                f'`{spec.character}`',
                f'`{spec.terrain}`',
                spec.actuation,
            )
            for spec in specs
        ]
        header = ('environment', 'task', 'character', 'terrain', 'actuation')
        parts += [f'## {title}', table(header, cells)]
    return page(
        'Environments',
        f'{len(catalogue.SPECS)} environments in {len(catalogue.FAMILIES)} families; a trained policy is shipped '
        f'for {len(policies.available())} of them. On the command line, `trl-suite list` selects by family (`--domain`), '
        'character, actuation, terrain or tag, and `trl-suite info ID` describes one. Ids of the original keep its '
        'spelling. PLAiD is progressive learning and integration via distillation (Berseth et al. 2018); `simbicon` '
        'characters have a gait after SIMBICON (Yin, Loken, van de Panne 2007).',
        table(('part of an id', 'meaning'), NAMES),
        *parts,
    )


# Characters


def character_page(name: str) -> str:
    spec = characters.CHARACTERS[name]
    viewer = KinematicViewer(name)
    figure = viewer.character
    weights = [joint.weight for joint in spec.joints.values()]
    joints = common.links(figure, viewer.environment.physics, (common.REWARD_WEIGHT, weights))
    used = [each.id for each in catalogue.SPECS if each.character == name]
    return page(
        name,
        spec.description,
        picture(name, gallery.character_path(name)),
        f'{common.figures(figure)}. '
        + (
            'Its root moves freely in three dimensions.'
            if spec.spatial
            else 'It moves in the x-z plane.'
        ),
        '## Links and joints',
        tables.markdown([joints]),
        'Limits are torque limits; kp and kd are the gains of position control (velocity control uses '
        'kd), before the actuation model splits the damping between servo and joint.',
        table(
            ('', ''),
            (
                ('end effectors', ', '.join(spec.end_effectors)),
                ('links whose ground contact is a fall', ', '.join(spec.fall_links)),
                ('default clip', spec.clip or 'none'),
            ),
        ),
        f'## Environments\n\n{links("environments", used) or "None; use it with `suite.build`."}',
    )


def character_index() -> str:
    cells = [
        (
            f'`{name}`', f'![{name}](pictures/{gallery.character_path(name)})', spec.description,
            sum(each.character == name for each in catalogue.SPECS),
        )
        for name, spec in characters.CHARACTERS.items()
    ]  # fmt: skip
    still = [name for name, spec in characters.CHARACTERS.items() if spec.clip is None]
    return page(
        'Characters',
        '`suite.build` combines a character with any terrain of the same dimension and with position, '
        f'velocity or torque control; {", ".join(MUSCLES)} also have muscles. {", ".join(still)} have no clip: '
        "they need a custom one, or another task, such as `task='walk'`. For custom characters see "
        '[Make your own](make_your_own.md).',
        table(('character', '', 'description', 'environments'), cells),
    )


# Terrains


def terrain_page(name: str) -> str:
    ground = terrain.load(name)
    defaults = ground.generator.defaults
    sets = ground.parameter_sets or ({},)
    titles = ['value'] if len(sets) == 1 else [f'set {i}' for i in range(len(sets))]
    cells = [
        (
            key, 'no effect' if key in terrain.IDLE.get(ground.type, ()) else ground.generator.parameters[key].unit,
            *(f'{values.get(key, default):g}' for values in sets), f'{default:g}',
        )
        for key, default in defaults.items()
    ]  # fmt: skip
    length = gallery.terrain_length(ground)
    shown = (
        'from above; arrows mark start positions'
        if ground.spatial
        else 'from the side; the dotted line marks the start'
    )
    parameters = table(('parameter', 'unit', *titles, 'default of the type'), cells)
    blended = 'The task option `terrain_level`, 0 to {}, interpolates between sets; the picture shows set 0.'
    used = [spec.id for spec in catalogue.SPECS if spec.terrain == name]
    size = f'{length:g} m on a side' if ground.spatial else f'{length:g} m'
    return page(
        name,
        f'Type `{ground.type}`: {meaning(ground)}',
        picture(f'Samples of {name}', gallery.terrain_path(name)),
        f'*{gallery.TERRAIN_DRAWS} random samples of {size}, {shown}.*',
        f'## Parameters\n\n{parameters if cells else "None."}',
        blended.format(len(sets) - 1) if len(sets) > 1 else '',
        f'## Environments\n\n{links("environments", used) or "None; use it with `suite.build`."}',
    )  # fmt: skip


def meaning(ground: terrain.Terrain) -> str:
    """Returns the description of a terrain type: the first line of its generator's docstring."""
    return (ground.generator.function.__doc__ or '').partition('\n')[0]


def terrain_index() -> str:
    parts = []
    for title, names in (
        ('In the plane', terrain.PRESETS),
        ('In three dimensions', terrain.PRESETS3D),
    ):
        cells = [
            (
                f'`{name}`', f'`{ground.type}`', meaning(ground),
                max(len(ground.parameter_sets), 1),
                sum(spec.terrain == name for spec in catalogue.SPECS),
            )
            for name, ground in names.items()
        ]  # fmt: skip
        header = ('preset', 'type', 'ground of this type', 'parameter sets', 'environments')
        parts += [f'## {title}', table(header, cells)]
    return page(
        'Terrains',
        'Terrain is random in every episode, except flat ground, checkers, paths, `cliff3d`, and presets whose parameters leave nothing to draw. `trl-suite terrain NAME` plots random samples of a '
        'preset or of a parameter file. For terrain from a function, an image or a mesh see '
        '[Make your own](make_your_own.md).',
        *parts,
    )


# Pages that only the site has: what writes one, and what they are about, by folder.
SITE: dict[str, tuple[Callable[[str], str], Iterable[str]]] = {
    'environments': (environment_page, catalogue.BY_ID),
    'families': (family_page, catalogue.FAMILIES),
    'characters': (character_page, characters.CHARACTERS),
    'terrains': (terrain_page, presets()),
}


# Speed


SHOWN = '16 ', '256 '  # simulations
PROJECTED = '1024 simulations, 2 threads'


def speeds() -> dict[str, Any]:
    return files.read_json(DOCS / 'data' / 'vector_environment.json')


def option_tables() -> dict[str, str]:
    """Returns the tables of the options of worlds, pushes and sensors."""
    configs = {
        'randomize': worlds.WorldConfig, 'push': pushes.PushConfig, 'sensors': sensors.SensorConfig,
    }  # fmt: skip
    return {
        f'options of {name}': tables.markdown([options.table_of(config)])
        for name, config in configs.items()
    }


def filled(path: str, tables: dict[str, str]) -> str:
    """Returns a page with its tables written between comments with their names."""
    text = (DOCS / path).read_text(encoding='utf-8')
    for name, written in tables.items():
        with errors.naming(path):
            text = files.between(text, name, 'docs/generate.py', written)
    return text


def cost() -> str:
    """Returns what worlds and sensors cost, from docs/data/disturbances.json."""
    found = files.read_json(DOCS / 'data' / 'disturbances.json')
    ids = list(found)
    cells = [
        (name, *(f'{found[id_][name][what]:.0f}' for id_ in ids for what in ('step', 'reset')))
        for name in found[ids[0]]
    ]
    titles = [f'`{id_}`: {what} (µs)' for id_ in ids for what in ('step', 'reset')]
    return (
        'CPU time of one simulation on one thread, with actions of zero, measured by `python '
        'benchmarks/disturbances.py` on a shared virtual machine that was busy; the smallest of the repeats:\n\n'
        + table(('options', *titles), cells)
    )


def solved() -> str:
    """Returns a sentence with the scores of the shipped policies by family."""
    scores: dict[str, list[float]] = {domain: [] for domain in catalogue.FAMILIES}
    gaits = set()
    for spec in catalogue.SPECS:
        score = task_type(spec).score
        if score == 'distance':
            gaits.add(spec.domain)
        if measured := gallery.evaluation(spec.id):
            scores[spec.domain].append(measured[score])
    shares, metres = (
        ', '.join(
            f'{statistics.median(found):{form}} (`{domain}`)'
            for domain, found in scores.items()
            if (domain in gaits) == distance
        )
        for distance, form in ((False, '.2f'), (True, '.0f'))
    )
    said = (
        f'{sum(map(len, scores.values()))} of {len(catalogue.SPECS)} environments have a trained policy. Median '
        f'[scores](docs/results.md): {shares} of the largest return; to the first fall, in m, {metres}.'
    )
    return textwrap.fill(said, 112, break_on_hyphens=False)


def speed_page() -> str:
    found = speeds()
    cells = [
        (
            f'`{id}`', setting, own['control steps per second'],
            *(f'{own[name]:.2f}' for name in ('ratio to the engine', 'reset', 'resets')),
        )
        for id, settings in found['ours'].items()
        for setting, own in settings.items()
        if setting.startswith(SHOWN)
    ]  # fmt: skip
    single = [
        (
            f'`{id}`', own['single environment'], own['mj_step'] // SUBSTEPS,
            f'{own["single environment"] / own["mj_step"] * SUBSTEPS:.2f}', found['memory per simulation, kB'][id],
        )
        for id, own in found['single'].items()
    ]  # fmt: skip
    projected = [
        (f'`{id}`', *(f'{share:g}' for share in settings[PROJECTED]['projection'].values()))
        for id, settings in found['ours'].items()
    ]
    return page(
        'Speed',
        f'Control steps per second, of 10 physics steps each, with random actions. Measured by `python '
        f'benchmarks/vector_environment.py` on {MACHINE}; `trl-suite bench ID` measures your machine.',
        '## Single environment',
        table(
            ('environment', 'control steps per s', 'raw `mj_step`', 'ratio', 'kB per simulation of a vector environment'),
            single,
        ),
        '## Vector environment',
        'Resets with new terrain are included; *resets* is their share of the time. *Ratio* is relative to MuJoCo '
        'alone with the same models, simulations and threads. It can be above 1, because MuJoCo alone does not '
        'reset: its characters lie on the ground, where physics steps cost more.',
        table(('environment', '', 'control steps per s', 'ratio', 'reset, ms', 'resets'), cells),
        '![Rates by simulations and threads](../benchmarks/vector_environment.png)',
        '## More cores',
        'Projected rate of 1024 simulations as a multiple of the rate on one core, by Amdahl\'s law from the part of '
        'a control step that runs on one thread. Limits of memory bandwidth and caches are not included.',
        table(('environment', '16 cores', '64 cores'), projected),
        '## Other libraries',
        'Ratios to raw `mj_step` with their own models, in the same run; none of them has terrain.',
        table(('', 'ratio'), ((name, f'{share:.2f}') for name, share in found['peers'].items())),
        'All figures: [vector_environment.json](data/vector_environment.json).',
    )  # fmt: skip


def stale(found: dict[str, str]) -> Iterator[str]:
    """Yields the paths of pages that are out of date or missing."""
    for path, text in found.items():
        file = DOCS / path
        if not file.exists() or file.read_text(encoding='utf-8') != text:
            yield path


def write(path: str, text: str) -> None:
    file = DOCS / path
    file.parent.mkdir(exist_ok=True)
    files.write_text(text, file)


def write_site() -> int:
    """Writes the pages that only the site has, except those newer than all that they describe.

    Returns:
      Number of written pages.
    """
    used = [*DOCS.glob('*.py')]
    for folder in SOURCES:
        used += (path for path in (DOCS.parent / folder).rglob('*.*') if path.suffix != '.pyc')
    newest = max(path.stat().st_mtime for path in used)
    old = {
        path: text
        for path, text in site_pages().items()
        if not (file := DOCS / path).exists() or file.stat().st_mtime < newest
    }
    for path, text in old.items():
        write(path, text())
    return len(old)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--overwrite', action='store_true', help='render existing pictures again')
    parser.add_argument(
        '--filter', default='*', metavar='PATTERN', help='render only matching pictures, e.g. an id'
    )
    parser.add_argument('--pages', action='store_true', help='write pages only, no pictures')
    arguments = parser.parse_args()
    found = pages()
    old = list(stale(found))
    for path in old:
        write(path, found[path])
    print(f'{len(old) + write_site()} pages written')
    if arguments.pages:
        return 0
    written, failed = gallery.make(DOCS / 'pictures', arguments.filter, arguments.overwrite)
    for name, error in failed.items():
        print(f'{name}: {error}', file=sys.stderr)
    print(f'{len(written)} pictures written')
    return int(bool(failed))


if __name__ == '__main__':
    begin_script()
    sys.exit(main())
