"""Checks an installation: versions, OpenGL, cores, a short run; prints problems and remedies.

    trl-suite doctor

Checks that may crash run in separate processes, so that this module needs neither a working engine
nor OpenGL.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import importlib.metadata
import importlib.util
import json
import os
import platform
import subprocess
import sys
import warnings
from collections.abc import Iterator, Sequence
from typing import Any

from trl_suite import policies
from trl_suite.cli.arguments import add_command
from trl_suite.util import compiled, libraries, machine, resources

BACKENDS = ('egl', 'osmesa', 'glfw')
OK, NOTE, FAILED = 'ok', 'note', 'FAILED'
TIMEOUT = 120.0  # s, for every process that is started
# Packages of the extras, by the name under which they are imported.
EXTRAS = {
    'video': ('imageio', 'imageio_ffmpeg', 'matplotlib'),
    'viewer': ('viser',),
    'gymnasium': ('gymnasium',),
    'sb3': ('stable_baselines3',),
    'torchrl': ('torchrl', 'gymnasium'),
    'rllib': ('ray', 'gymnasium', 'torch'),
    'cluster': ('ray', 'fsspec'),
    'shimmy': ('shimmy',),
    'train': ('torch',),
    'tune': ('cma',),
    'clips': ('pybvh',),
    'minari': ('minari', 'h5py'),
    'benchmark': ('stable_baselines3', 'sb3_contrib'),
}
LIBRARIES = {
    'egl': 'libegl1 (Debian, Ubuntu: apt install libegl1) or a graphics driver',
    'osmesa': 'libosmesa6 (Debian, Ubuntu: apt install libosmesa6)',
    'glfw': 'a display',
}

# Prints one line with the error, without messages of libraries at exit.
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
    """One line of the report."""

    state: str  # `OK`, `NOTE` (informative, not essential) or `FAILED`
    text: str
    remedy: str = ''  # what to do about it; may be empty


def declare(commands: Any) -> None:
    """Declares the command."""
    add_command(commands, 'doctor', 'check the installation; print problems and remedies', run)


def findings() -> Iterator[Finding]:
    """Yields all findings, in order; takes about ten seconds."""
    yield from versions()
    yield from extras()
    yield shipped_policies()
    yield cores()
    yield compiled_code()
    works = []
    for name, finding in backends():
        yield finding
        works += [name] * (finding.state == OK)
    yield from self_test(works)


def versions() -> Iterator[Finding]:
    """Installed versions of Python and of all required packages, compared to those required."""
    yield Finding(OK, f'Python {platform.python_version()}, {sys.executable}')
    try:
        from packaging.requirements import Requirement

        required = importlib.metadata.requires('trl_suite') or []
    except ImportError as error:  # or the suite is on the path without being installed
        yield Finding(NOTE, f'required versions are unknown ({error})', 'pip install trl_suite')
        return
    for requirement in map(Requirement, required):
        own = requirement.marker is None or requirement.marker.evaluate({'extra': ''})
        if not own and requirement.name != 'dm-control':  # belongs to an extra
            continue
        found = machine.version(requirement.name)
        text = f'{requirement.name} {found or "is missing"} (required: {requirement.specifier or "any"})'
        good = found is not None and requirement.specifier.contains(found, prereleases=True)
        remedy = '' if good else f"pip install '{requirement.name}{requirement.specifier}'"
        if remedy and not own:
            remedy = f'pip install {libraries.DM_CONTROL}'
        yield Finding(OK if good else FAILED, text, remedy)


def extras() -> Iterator[Finding]:
    """Optional packages."""
    for extra, modules in EXTRAS.items():
        missing = [name for name in modules if importlib.util.find_spec(name) is None]
        if missing:
            yield Finding(
                NOTE,
                f"extra '{extra}': {', '.join(missing)} not installed",
                f"to use it: pip install 'trl_suite[{extra}]'",
            )
        else:
            yield Finding(OK, f"extra '{extra}'")


def shipped_policies() -> Finding:
    """Number of environments for which a trained policy is installed."""
    text = f'trained policies for {len(policies.available())} environments'
    if resources.lacks_policies():
        return Finding(
            NOTE, f'{text}, the footstep controllers', "pip install 'trl_suite[policies]'"
        )
    return Finding(OK, text)


def cores() -> Finding:
    """The useful number of threads."""
    text = f'{machine.cores()} of {os.cpu_count()} cores usable, {machine.processor()}'
    return Finding(OK, f'{text}; num_threads=0 starts as many threads')


def compiled_code() -> Finding:
    """Location and size of the cache of compiled rules."""
    with warnings.catch_warnings():
        warnings.simplefilter('ignore')
        folder = compiled.cache_folder()
    if folder is None:
        return Finding(
            NOTE,
            'no folder for compiled code can be used: every process compiles again',
            'set NUMBA_CACHE_DIR to a folder of your own',
        )
    sizes = []
    for path in folder.rglob('*'):
        with contextlib.suppress(FileNotFoundError):  # other processes rename temporary files
            if path.is_file():
                sizes.append(path.stat().st_size)
    text = f'compiled code in {folder}: {len(sizes)} files, {sum(sizes) / 1e6:.1f} MB'
    return Finding(OK, text)


def backends() -> Iterator[tuple[str, Finding]]:
    """The values of MUJOCO_GL that can render, each tested in a separate process."""
    runs = {name: _start(_DRAW, name) for name in BACKENDS}
    for name, run in runs.items():
        status, out, error = _end(run)
        if status:
            yield name, Finding(NOTE, f'MUJOCO_GL={name}: {error}', f'needs {LIBRARIES[name]}')
        else:
            yield name, Finding(OK, f'MUJOCO_GL={name} renders' + (f', {out}' if out else ''))


def self_test(works: Sequence[str]) -> Iterator[Finding]:
    """Steps an environment for a second and renders it, with the current value of MUJOCO_GL.

    `works` are the values that can render.
    """
    status, out, error = _end(_start(_RUN))
    if not out:  # if the chosen library is missing, importing dm_control fails
        _, out, other = _end(_start(_RUN, 'disable'))
        if not out:
            yield Finding(
                FAILED,
                f'no environment runs: {other}',
                'see the failures above; if there are none: pip install --force-reinstall trl_suite',
            )
            return
    yield Finding(OK, f'an environment runs: {", ".join(json.loads(out.splitlines()[-1]))}')
    if status:
        remedy = (
            'export MUJOCO_GL=disable if you need no rendering, else install a library named above'
        )
        if works:
            remedy = f'export MUJOCO_GL={works[0]}'
        yield Finding(
            FAILED,
            f'rendering fails with MUJOCO_GL={os.environ.get("MUJOCO_GL", "")}: {error}',
            remedy,
        )


def _start(code: str, backend: str | None = None) -> subprocess.Popen[str]:
    environment = dict(os.environ)
    if backend is not None:
        environment['MUJOCO_GL'] = backend
        environment.pop('PYOPENGL_PLATFORM', None)  # may be set for another library
    streams: Any = {
        'stdin': subprocess.DEVNULL,
        **dict.fromkeys(('stdout', 'stderr'), subprocess.PIPE),
    }
    command = [sys.executable, '-W', 'ignore', '-c', _GUARD + code]
    return subprocess.Popen(command, env=environment, text=True, **streams)


def _end(run: subprocess.Popen[str]) -> tuple[int, str, str]:
    """Returns exit status, standard output, and the error in one line."""
    try:
        out, error = run.communicate(timeout=TIMEOUT)
    except subprocess.TimeoutExpired:
        run.kill()
        out, error = run.communicate()
        return 1, out.strip(), f'no answer within {TIMEOUT:g} s'
    lines = error.splitlines() or [f'exit status {run.returncode}']
    return run.returncode, out.strip(), lines[-1].strip()


def run(arguments: argparse.Namespace) -> int:
    """Prints all findings, and returns 1 if any check failed."""
    found = []
    for finding in findings():  # some take seconds
        found.append(finding.state)
        print(f'{finding.state:<6}  {finding.text}', flush=True)
        if finding.remedy:
            print(f'        -> {finding.remedy}', flush=True)
    failed = found.count(FAILED)
    print(
        f'\n{failed} check{"" if failed == 1 else "s"} failed' if failed else '\nall checks passed'
    )
    return int(failed > 0)
