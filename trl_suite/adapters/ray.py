"""Ray: evaluations and sequences on the cores of this machine, or of a cluster.

    from trl_suite import evaluation, policies
    from trl_suite.adapters.ray import RayExecutor

    id_ = 'PD_Biped2D_Gaps_Terrain-v0'
    with RayExecutor() as executor:  # or RayExecutor('auto') for a cluster
        result = evaluation.evaluate(id_, policies.reference(id_), 4096, executor=executor)

`docs/cluster.md` describes how to start a cluster.
"""

from __future__ import annotations

import os
import platform
import signal
import socket
import threading
import warnings
from collections.abc import Callable, Iterable, Iterator
from typing import Any

from trl_suite.util import compiled

try:
    import ray
    from ray._private import services
except ImportError as error:
    message = f"trl_suite.adapters.ray needs an extra ({error}): pip install 'trl_suite[cluster]'"
    raise ImportError(message) from None

RETRIES = 10  # of a task whose process or node was lost
PATIENCE = 10.0  # s to wait for an answer of a cluster; Ray itself waits for many minutes


def connect(address: str | None = None) -> None:
    """Connects this process to a cluster of Ray, or starts Ray on this machine.

    Args:
      address: 'auto' for the cluster that this machine belongs to, or 'HOST:PORT' of its first
        node; 'local' starts Ray on this machine. None: the cluster of this machine or of
        `$RAY_ADDRESS` if there is one, otherwise 'local'.

    Raises:
      ConnectionError: there is no cluster at this address.
      ray.exceptions.AuthenticationError: the cluster has a token, and this machine has not.
    """
    target = address
    if address in (None, 'auto'):
        target = os.environ.get('RAY_ADDRESS')
    if not (target or '').startswith('ray://'):
        found = services.canonicalize_bootstrap_address(address)  # HOST:PORT; None for 'local'
        try:
            if found is not None:
                host, _, port = found.rpartition(':')
                socket.create_connection((host.strip('[]'), int(port)), PATIENCE).close()
        except OSError as error:
            if address is not None or os.environ.get('RAY_ADDRESS'):
                raise ConnectionError(
                    f'no cluster of Ray answers at {found} ({error}); `ray start --head` on its first '
                    'machine starts one'
                ) from error
            address = 'local'  # that cluster has ended without `ray stop`
    before = signal.getsignal(signal.SIGTERM)
    ray.init(address, log_to_driver=False, logging_level='ERROR')
    if callable(before) and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, before)  # instead of Ray's handler


class RayExecutor:
    """Runs functions as tasks of Ray; those of a lost node run again on another one."""

    def __init__(
        self,
        address: str | None = None,
        *,
        num_cpus: float = 1,
        memory: int = 0,
        retries: int = RETRIES,
        fresh: bool = False,
    ) -> None:
        """Connects to a cluster, unless this process is connected to one.

        Args:
          address: of the cluster, as for `connect`.
          num_cpus: cores that a task needs.
          memory: memory that a task needs, bytes.
          retries: how often a task is started again after the loss of its process or node.
          fresh: whether to run each task in a new process.

        Raises:
          ConnectionError: there is no cluster at this address.
          ray.exceptions.AuthenticationError: the cluster has a token, and this machine has not.
        """
        self._begun = not ray.is_initialized()
        if self._begun:
            connect(address)
        self._tasks: set[Any] = set()  # that are not done
        needed = {'CPU': num_cpus, 'memory': memory}
        if not any(
            all(node['Resources'].get(name, 0) >= number for name, number in needed.items())
            for node in ray.nodes()
            if node['Alive']
        ):
            warnings.warn(
                f'no node has the {num_cpus:g} cores and {memory / 1e9:.1f} GB of memory that a task '
                'needs; tasks wait until there is one',
                stacklevel=2,
            )
        self._call = ray.remote(
            num_cpus=num_cpus, memory=memory or None, max_retries=retries, max_calls=int(fresh),
            scheduling_strategy='SPREAD',
        )(_call)  # fmt: skip

    def map(self, fn: Callable[..., Any], /, *iterables: Iterable[Any]) -> Iterator[Any]:
        """Starts a task for each element of the iterables; returns the results in order.

        Raises:
          RuntimeError: when a result is taken: a node has other sources of trl_suite.
          ray.exceptions.RayError: when a result is taken: a task was lost too often.
          Exception: when a result is taken: what the function raised.
        """
        function = ray.put(fn)  # is sent to each node once
        expected = compiled.fingerprint()
        tasks = [
            self._call.remote(expected, function, *arguments)
            for arguments in zip(*iterables, strict=False)
        ]
        self._tasks.update(tasks)
        results = self._results(tasks)
        next(results)  # only a generator that has begun cancels what is left at its end
        return results

    def _results(self, tasks: list[Any]) -> Iterator[Any]:
        """Yields None, then results; cancels the tasks that are left if the caller stops or a task fails."""
        try:
            yield None
            while tasks:
                yield ray.get(tasks[0])
                self._tasks.discard(tasks.pop(0))
        except ray.exceptions.RayTaskError as error:
            raise error.cause from error
        finally:
            for task in tasks if ray.is_initialized() else ():  # else Ray would start again
                ray.cancel(task)
            self._tasks.difference_update(tasks)

    def cancel(self) -> None:
        """Kills the tasks that are not done; who waits for their results gets a RayError."""
        for task in list(self._tasks):
            ray.cancel(task, force=True)  # without, libraries may catch the exception

    def close(self) -> None:
        """Disconnects; ends a Ray that this object has started."""
        if self._begun:
            ray.shutdown()

    def __enter__(self) -> RayExecutor:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _call(expected: str, function: Callable[..., Any], *arguments: Any) -> Any:
    if compiled.fingerprint() != expected:
        raise RuntimeError(
            f'{platform.node()}: the sources of trl_suite or the version of MuJoCo differ from '
            'those of the process that started the task; install the same on all nodes'
        )
    return function(*arguments)
