"""Looks at an installation: versions, OpenGL, cores, a short run; says what is wrong and what to do.

    trl-suite doctor

Whatever may crash is tried in a process of its own, so that this module needs neither the engine nor
OpenGL to be in order.
"""

from __future__ import annotations

import argparse
import dataclasses
import importlib.metadata
import importlib.util
import json
import os
import platform
import subprocess
import sys
import warnings
from collections.abc import Iterable, Iterator, Sequence

from trl_suite.cli import machine
from trl_suite.util import compiled

BACKENDS = ('egl', 'osmesa', 'glfw')
OK, NOTE, FAILED = 'ok', 'note', 'FAILED'
TIMEOUT = 120.0  # s, for every process that is started
# What an extra brings, by the name under which it is imported.
EXTRAS = {
    'video': ('imageio', 'imageio_ffmpeg', 'matplotlib'), 'gymnasium': ('gymnasium',),
    'sb3': ('stable_baselines3',), 'torchrl': ('torchrl',), 'rllib': ('ray',), 'shimmy': ('shimmy',),
    'train': ('torch',), 'clips': ('pybvh',),
}  # fmt: skip
LIBRARIES = {
    'egl': 'libegl1 (Debian, Ubuntu: apt install libegl1) or a graphics driver',
    'osmesa': 'libosmesa6 (Debian, Ubuntu: apt install libosmesa6)',
    'glfw': 'a screen',
}

# One line says why, and no library complains at exit.
_GUARD = """
import os, sys
def fail(kind, error, trace):
    print(' '.join(f'{kind.__name__}: {error}'.split()), file=sys.stderr, flush=True)
    os._exit(1)
sys.excepthook = fail
"""
_DRAW = """
from dm_control import mujoco
physics = mujoco.Physics.from_xml_string(
    '<mujoco><worldbody><light pos="0 0 3"/><geom size=".3"/></worldbody></mujoco>')
assert physics.render(64, 64).std() > 0, 'the picture is empty'
try:
    from OpenGL import GL
    print((GL.glGetString(GL.GL_RENDERER) or b'').decode())
except Exception:
    print()
"""
_RUN = """
import json, time
from trl_suite import suite
environment = suite.make('PD_Biped2D_Gaps_Terrain-v0', {'random': 0})
environment.reset()
environment.step(environment.task.clip_action(0))  # on a new machine, rules are compiled
time_step, steps, begin = environment.reset(), 0, time.perf_counter()
while time.perf_counter() - begin < 1.0:
    if time_step.last():
        time_step = environment.reset()
    time_step = environment.step(environment.task.clip_action(0))
    steps += 1
    assert time_step.last() or 0 <= time_step.reward <= 1, time_step.reward
found = [f'{steps / (time.perf_counter() - begin):.0f} steps per second']
print(json.dumps(found), flush=True)
if os.environ.get('MUJOCO_GL') not in ('disable', 'disabled', 'off', 'false', '0'):
    from trl_suite import rendering
    begin = time.perf_counter()
    assert rendering.frame(environment, 120, 160).std() > 0, 'the picture is empty'
    found.append(f'first picture after {time.perf_counter() - begin:.1f} s')
print(json.dumps(found))
"""


@dataclasses.dataclass(frozen=True)
class Finding:
    """One line of the report.

    Attributes:
      state: `OK`, `NOTE` (worth knowing, nothing essential) or `FAILED`.
      text: what was found.
      remedy: what to do, if anything.
    """

    state: str
    text: str
    remedy: str = ''


def findings() -> Iterator[Finding]:
    """Yields what is found, in order; takes about ten seconds."""
    yield from versions()
    yield from extras()
    yield cores()
    yield compiled_code()
    works = []
    for name, finding in backends():
        yield finding
        works += [name] * (finding.state == OK)
    yield from self_test(works)


def versions() -> Iterator[Finding]:
    """Python and every package that the suite requires, against what it asks for."""
    yield Finding(OK, f'Python {platform.python_version()}, {sys.executable}')
    try:
        from packaging.requirements import Requirement

        required = importlib.metadata.requires('trl_suite') or []
    except ImportError as error:  # or the suite was not installed, only put on the path
        yield Finding(NOTE, f'required versions are unknown ({error})', 'pip install trl_suite')
        return
    for requirement in map(Requirement, required):
        if requirement.marker is not None:  # of an extra
            continue
        found = machine.version(requirement.name)
        text = f'{requirement.name} {found or "is missing"} (required: {requirement.specifier or "any"})'
        good = found is not None and requirement.specifier.contains(found, prereleases=True)
        remedy = '' if good else f"pip install '{requirement}'"
        yield Finding(OK if good else FAILED, text, remedy)


def extras() -> Iterator[Finding]:
    """What is optional."""
    for extra, modules in EXTRAS.items():
        missing = [name for name in modules if importlib.util.find_spec(name) is None]
        if missing:
            yield Finding(
                NOTE, f"extra '{extra}': {', '.join(missing)} not installed",
                f"if you want it: pip install 'trl_suite[{extra}]'",
            )  # fmt: skip
        else:
            yield Finding(OK, f"extra '{extra}'")


def cores() -> Finding:
    """How many threads make sense."""
    usable, all_ = machine.cores(), os.cpu_count() or 1
    text = f'{usable} of {all_} cores usable, {machine.processor()}'
    if usable == all_:
        return Finding(OK, f'{text}; num_threads=0 starts as many threads')
    return Finding(NOTE, text, f'num_threads=0 takes all {all_}: give num_threads={usable}')


def compiled_code() -> Finding:
    """Where the machine code of the rules is kept, and how much of it there is."""
    with warnings.catch_warnings():
        warnings.simplefilter('ignore')
        folder = compiled.cache_folder()
    if folder is None:
        return Finding(
            NOTE, 'no folder for compiled code can be written: every process compiles anew',
            'set NUMBA_CACHE_DIR to a folder that can be written',
        )  # fmt: skip
    sizes = [path.stat().st_size for path in folder.rglob('*') if path.is_file()]
    text = f'compiled code in {folder}: {len(sizes)} files, {sum(sizes) / 1e6:.1f} MB'
    return Finding(OK, text)


def backends() -> Iterator[tuple[str, Finding]]:
    """Which values of MUJOCO_GL draw a picture, each tried in a process of its own."""
    runs = {name: _start(_DRAW, name) for name in BACKENDS}
    for name, run in runs.items():
        status, out, error = _end(run)
        if status:
            yield name, Finding(NOTE, f'MUJOCO_GL={name}: {error}', f'needs {LIBRARIES[name]}')
        else:
            yield name, Finding(OK, f'MUJOCO_GL={name} draws' + (f', {out}' if out else ''))


def self_test(works: Sequence[str]) -> Iterator[Finding]:
    """Steps an environment for a second and draws it, with MUJOCO_GL as it is.

    Args:
      works: values of MUJOCO_GL that draw.
    """
    status, out, error = _end(_start(_RUN))
    if not out:  # where the chosen library is missing, dm_control cannot even be imported
        _, out, other = _end(_start(_RUN, 'disable'))
        if not out:
            yield Finding(
                FAILED, f'no environment runs: {other}',
                'see what failed above; if nothing: pip install --force-reinstall trl_suite',
            )  # fmt: skip
            return
    yield Finding(OK, f'an environment runs: {", ".join(json.loads(out.splitlines()[-1]))}')
    if status:
        remedy = (
            'export MUJOCO_GL=disable if you need no pictures, else install what is named above'
        )
        if works:
            remedy = f'export MUJOCO_GL={works[0]}'
        yield Finding(
            FAILED,
            f'nothing can be drawn with MUJOCO_GL={os.environ.get("MUJOCO_GL", "")}: {error}',
            remedy,
        )


def _start(code: str, backend: str | None = None) -> subprocess.Popen[str]:
    environment = dict(os.environ)
    if backend is not None:
        environment['MUJOCO_GL'] = backend
        environment.pop('PYOPENGL_PLATFORM', None)  # of another library
    return subprocess.Popen(
        [sys.executable, '-W', 'ignore', '-c', _GUARD + code], env=environment, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, stdin=subprocess.DEVNULL,
    )  # fmt: skip


def _end(run: subprocess.Popen[str]) -> tuple[int, str, str]:
    """Returns exit status, what was printed, and why it failed in one line."""
    try:
        out, error = run.communicate(timeout=TIMEOUT)
    except subprocess.TimeoutExpired:
        run.kill()
        out, error = run.communicate()
        return 1, out.strip(), f'no answer within {TIMEOUT:g} s'
    lines = error.splitlines() or [f'exit status {run.returncode}']
    return run.returncode, out.strip(), lines[-1].strip()


def report(found: Iterable[Finding]) -> Iterator[str]:
    """Yields lines, remedies indented below what they are for."""
    for finding in found:
        yield f'{finding.state:<6}  {finding.text}'
        if finding.remedy:
            yield f'        -> {finding.remedy}'


def run(arguments: argparse.Namespace) -> int:
    """Prints what is found, and returns 1 if anything is wrong."""
    found = []
    for finding in findings():  # some take seconds
        found.append(finding.state)
        print('\n'.join(report([finding])), flush=True)
    failed = found.count(FAILED)
    print(f'\n{failed} thing{"" if failed == 1 else "s"} to mend' if failed else '\nall is well')
    return int(failed > 0)
