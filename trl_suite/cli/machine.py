"""What machine this is: processor, cores that may be used, versions."""

from __future__ import annotations

import importlib.metadata
import math
import os
import pathlib
import platform

PACKAGES = ('mujoco', 'dm-control', 'numpy')
_QUOTA = pathlib.Path('/sys/fs/cgroup/cpu.max')  # of a container: microseconds, or max; period


def cores() -> int:
    """Returns how many cores this process may use: what its affinity and its container leave."""
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
    """Returns the name of the processor, or of its architecture where no name is known."""
    try:
        lines = pathlib.Path('/proc/cpuinfo').read_text().splitlines()
    except OSError:
        lines = []
    names = [line.partition(':')[2].strip() for line in lines if line.startswith('model name')]
    return (names or [platform.processor()])[0] or platform.machine()


def version(package: str) -> str | None:
    """Returns the installed version of a package; None if there is none."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def sentence() -> str:
    """Returns the machine in one line, to be stated beside figures."""
    found = ', '.join(f'{package} {version(package)}' for package in PACKAGES)
    return (
        f'{processor()}, {cores()} of {os.cpu_count()} cores usable, {platform.system()} '
        f'{platform.machine()}, Python {platform.python_version()}, {found}'
    )
