"""The machine: processor and its class, usable cores, versions."""

from __future__ import annotations

import ctypes
import functools
import importlib.metadata
import math
import os
import pathlib
import platform

PACKAGES = ('mujoco', 'dm-control', 'numpy')
_CORE_NAME = 'openblas_get_corename'  # function of OpenBLAS; NumPy's wheels rename it
_SAME_KERNELS = {'Zen': 'Haswell', 'Cooperlake': 'SkylakeX'}  # results are equal, bit for bit
_VECTORS = {'avx512f': 'AVX-512', 'avx2': 'AVX2'}  # the widest first, by LLVM's names
_QUOTA = pathlib.Path('/sys/fs/cgroup/cpu.max')  # microseconds, or max; period


def cores() -> int:
    """Returns the number of cores that this process may use, by its affinity and its container."""
    try:
        count = len(os.sched_getaffinity(0))
    except AttributeError:  # not Linux
        count = os.cpu_count() or 1
    try:
        quota, period = _QUOTA.read_text().split()
        return max(1, min(count, math.ceil(int(quota) / int(period))))
    except (OSError, ValueError):
        return count


def processor() -> str:
    """Returns the name of the processor, or its architecture if the name is unknown."""
    try:
        lines = pathlib.Path('/proc/cpuinfo').read_text().splitlines()
    except OSError:
        lines = []
    names = [line.partition(':')[2].strip() for line in lines if line.startswith('model name')]
    return (names or [platform.processor()])[0] or platform.machine()


@functools.cache
def cpu_class() -> str:
    """Returns the architecture, and which functions multiply matrices, e.g. 'x86_64 Haswell'.

    OpenBLAS has them for several processors, and chooses by more than vector instructions; they differ
    in the last bits of policies' actions. With another BLAS, which does not tell, it is the widest
    vector instructions.
    """
    from numpy.linalg import _umath_linalg

    blas = ctypes.CDLL(_umath_linalg.__file__)  # and the libraries that it needs
    for name in (f'scipy_{_CORE_NAME}64_', f'{_CORE_NAME}64_', _CORE_NAME):
        if function := getattr(blas, name, None):
            function.restype = ctypes.c_char_p
            core = function().decode()
            return f'{platform.machine()} {_SAME_KERNELS.get(core, core)}'
    from llvmlite import binding

    has = binding.get_host_cpu_features()
    widest = next((name for feature, name in _VECTORS.items() if has.get(feature)), '')
    return f'{platform.machine()} {widest}'.strip()


def made_with() -> dict[str, str]:
    """Returns what bits of results depend on besides the suite: 'mujoco' (version), 'cpu' (class).

    Policies, results of sequences and of evaluations hold both, and so does a saved state.
    """
    return {'mujoco': version('mujoco') or '', 'cpu': cpu_class()}


def version(package: str) -> str | None:
    """Returns the installed version of a package; None if there is none."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def sentence() -> str:
    """Returns the machine in one line, for reports of measurements."""
    found = ', '.join(f'{package} {version(package)}' for package in PACKAGES)
    return (
        f'{processor()}, {cores()} of {os.cpu_count()} cores usable, {platform.system()} '
        f'{cpu_class()}, Python {platform.python_version()}, {found}'
    )
