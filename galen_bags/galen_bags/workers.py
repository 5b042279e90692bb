# SPDX-License-Identifier: Apache-2.0
"""Worker processes for `many`: here, or those of a Dask scheduler.

It imports dask.distributed, which takes its time: import it only where there are many bags.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import multiprocessing
import signal
import tempfile
import threading
from collections.abc import Iterator
from multiprocessing import resource_tracker
from pathlib import Path
from types import FrameType
from typing import Any

import dask
from dask.system import CPU_COUNT
from distributed import Client, LocalCluster
from distributed.core import rpc
from distributed.security import Security
from galen_model.errors import GalenError

# A worker that does not end by itself is killed after this time.
_END_S = 0.5
_CLIENT_END_S = 5.0
_LOCAL_SETTINGS: dict[str, Any] = {
    # Nothing to look at over HTTP.
    "distributed.scheduler.http.routes": [],
    "distributed.worker.http.routes": [],
    # A bag that ends its worker is not tried on the others one by one: `many` decides.
    "distributed.scheduler.allowed-failures": 0,
    # Results are small, so waiting and spilling would free nothing; a worker that takes more than
    # its share of the memory is ended before the machine is out of it.
    "distributed.worker.memory.target": False,
    "distributed.worker.memory.spill": False,
    "distributed.worker.memory.pause": False,
}


def cpu_count() -> int:
    """Return how many processors this process may use."""
    return int(CPU_COUNT)


@contextlib.contextmanager
def local_workers(count: int) -> Iterator[Client]:
    """Start processes of one thread each, reachable from this machine only.

    When it ends, for whatever reason, they are gone, and so are their files.

    Args:
        count: number of processes.

    Yields:
        A client of theirs.

    Raises:
        GalenError: they can't be started, or a worker is importing the script that asks for them.

    """
    if getattr(multiprocessing.current_process(), "_inheriting", False):
        raise GalenError(
            "many bags at once: the script that asks for it is being imported by a worker process;"
            ' it must ask below `if __name__ == "__main__":`'
        )
    cluster: LocalCluster | None = None
    with (
        tempfile.TemporaryDirectory(prefix="galen_bags_", ignore_cleanup_errors=True) as folder,
        dask.config.set({**_LOCAL_SETTINGS, "temporary-directory": folder}),
    ):
        try:
            with _interrupts_held():
                cluster = _start(count)
            client = Client(cluster, set_as_default=False)
            try:
                yield client
            finally:
                # After an interrupt it may wait a minute for an answer that doesn't come.
                with contextlib.suppress(TimeoutError):
                    client.close(timeout=_CLIENT_END_S)
        finally:
            if cluster is not None:
                with _interrupts_held():
                    cluster.sync(_end, cluster)
                    cluster.close()


def _start(count: int) -> LocalCluster:
    try:
        return LocalCluster(
            n_workers=count,
            threads_per_worker=1,
            processes=True,
            host="127.0.0.1",
            dashboard_address="127.0.0.1:0",
            scheduler_kwargs={"dashboard": False},
            silence_logs=logging.CRITICAL,
        )
    except (RuntimeError, OSError) as error:
        reason = f"{error or type(error).__name__}".splitlines()[0]
        raise GalenError(
            f"many bags at once: worker processes can't be started: {reason} (a script that asks"
            ' for it must do so below `if __name__ == "__main__":`)'
        ) from error


async def _end(cluster: LocalCluster) -> None:
    """End workers that are in the middle of a bag, too."""
    ends = [worker.close(timeout=_END_S) for worker in cluster.workers.values()]
    await asyncio.gather(*ends, return_exceptions=True)


@contextlib.contextmanager
def _interrupts_held() -> Iterator[None]:
    """Hold Ctrl-C back; processes started meanwhile, and later by the same threads, never see it.

    A terminal sends it to all of them, but only this process is to act on it.
    """
    # Starting it clears the mask, so it is started before.
    resource_tracker.ensure_running()
    held: list[int] = []

    def hold(number: int, frame: FrameType | None) -> None:
        held.append(number)

    in_main = threading.current_thread() is threading.main_thread()
    before = signal.signal(signal.SIGINT, hold) if in_main else None
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        # The handler must be there still when what was blocked arrives.
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        if in_main:
            signal.signal(signal.SIGINT, before)
        if held:
            signal.raise_signal(signal.SIGINT)


@contextlib.contextmanager
def scheduler_client(scheduler: str, timeout_s: float) -> Iterator[Client]:
    """Connect to a Dask scheduler.

    Args:
        scheduler: its address, such as tcp://host:8786, or the path of a scheduler file.
        timeout_s: how long to wait for its answer, s.

    Yields:
        A client of it, closed at the end.

    Raises:
        GalenError: none answers in time, it is no scheduler, has no workers or can't be connected
            to.

    """
    address = _address(scheduler)
    try:
        identity = asyncio.run(_ask(address, timeout_s))
    except TimeoutError:
        raise GalenError(f"{scheduler}: no scheduler answers within {timeout_s:g} s") from None
    # Whatever an address that is none of a scheduler brings; a MemoryError is among it.
    except Exception as error:
        reason = f"{error or type(error).__name__}".splitlines()[0]
        raise GalenError(f"{scheduler}: can't be asked as a scheduler: {reason}") from error
    if identity.get("type") != "Scheduler":
        raise GalenError(f"{scheduler}: is a {identity.get('type')}, not a scheduler")
    if not identity["workers"]:
        raise GalenError(f"{scheduler}: the scheduler has no workers")
    try:
        client = Client(address, timeout=timeout_s, set_as_default=False)
    except (OSError, ImportError) as error:
        reason = f"{error or type(error).__name__}".splitlines()[0]
        raise GalenError(f"{scheduler}: can't be connected to: {reason}") from error
    logger = logging.getLogger("distributed.client")
    disabled, logger.disabled = logger.disabled, True  # `many` says itself that it was lost
    try:
        with client:
            yield client
    finally:
        logger.disabled = disabled


async def _ask(address: str, timeout_s: float) -> dict[str, Any]:
    # The client itself would wait without end for a server that is silent.
    async with asyncio.timeout(timeout_s):
        arguments = Security().get_connection_args("client")
        async with rpc(address, connection_args=arguments) as server:
            answer: dict[str, Any] = await server.identity()
    return answer


def _address(scheduler: str) -> str:
    path = Path(scheduler)
    if path.suffix != ".json" and not path.is_file():
        return scheduler
    try:
        return str(json.loads(path.read_text(encoding="utf-8"))["address"])
    except OSError as error:
        raise GalenError(f"{path}: can't be read: {error.strerror}") from error
    except (ValueError, LookupError, TypeError) as error:
        raise GalenError(f"{path}: is no scheduler file: it names no address") from error
