"""Start the suite's executables as processes of their own, and end each by its id.

On a full ROS 2 `ros2 launch` does this; a demonstration has to run without it, too.
"""

from __future__ import annotations

import os
import signal
import subprocess
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType

from ament_index_python.packages import PackageNotFoundError, get_package_prefix
from galen_model.errors import GalenError

_PATIENCE_S = 5.0


class ProcessError(GalenError):
    """An executable is missing, or a process ended by itself; then with its log's last lines."""

    __str__ = Exception.__str__


def executable_path(package: str, executable: str) -> Path:
    """Where colcon installed an executable; raises ProcessError naming what is missing."""
    try:
        path = Path(get_package_prefix(package)) / "lib" / package / executable
    except PackageNotFoundError as error:
        raise ProcessError(f"package {package} is not installed: build and source first") from error
    if not path.is_file():
        raise ProcessError(f"{path} is not there: build again")
    return path


def ros_arguments(
    parameters: Mapping[str, object] | None = None, remaps: Mapping[str, str] | None = None
) -> list[str]:
    """Command-line arguments that set a node's parameters and remaps."""
    arguments = []
    for name, value in (parameters or {}).items():
        text = str(value).lower() if isinstance(value, bool) else str(value)
        arguments += ["-p", f"{name}:={text}"]
    for old, new in (remaps or {}).items():
        arguments += ["-r", f"{old}:={new}"]
    return ["--ros-args", *arguments] if arguments else []


class Processes:
    """Processes that end with this object, whatever happens; each writes its own log."""

    def __init__(self, log_dir: Path) -> None:
        """Logs go to `log_dir`/<executable>.log."""
        self._log_dir = log_dir
        self._running: dict[str, subprocess.Popen[bytes]] = {}

    def __enter__(self) -> Processes:
        """Make the folder of the logs."""
        self._log_dir.mkdir(parents=True, exist_ok=True)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """End all of them."""
        self.stop()

    def start(self, package: str, executable: str, arguments: Sequence[str] = ()) -> int:
        """Start an executable; returns its process id."""
        path = executable_path(package, executable)
        # A signal between a process' start and its entry in the list would leave it behind.
        with (self._log_dir / f"{executable}.log").open("wb") as log, _signals_later():
            self._running[executable] = process = subprocess.Popen(
                [str(path), *arguments],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                # A group of their own: a Ctrl-C ends them through stop(), in order. Not a session
                # of their own, in which Linux would not weigh the driver's niceness against theirs.
                process_group=0,
            )
        return process.pid

    def check(self) -> None:
        """Raise ProcessError, with the end of its log, when one has ended by itself."""
        for name, process in self._running.items():
            if process.poll() is not None:
                log = self._log_dir / f"{name}.log"
                last = "\n".join(log.read_text(errors="replace").splitlines()[-5:])
                raise ProcessError(f"{name} ended with code {process.returncode} ({log}):\n{last}")

    def stop(self) -> None:
        """Interrupt all, wait, and kill what is left."""
        for process in self._running.values():
            _signal(process, signal.SIGINT)
        deadline = time.monotonic() + _PATIENCE_S
        try:
            for process in self._running.values():
                with suppress(subprocess.TimeoutExpired):
                    process.wait(timeout=max(0.1, deadline - time.monotonic()))
        finally:  # an impatient second Ctrl-C, too, must leave nothing behind
            for process in self._running.values():
                _signal(process, signal.SIGKILL)
                process.wait()
            self._running.clear()


@contextmanager
def _signals_later() -> Iterator[None]:
    """Hold back what would end this process until the block is done."""
    if threading.current_thread() is not threading.main_thread():
        yield  # signals reach the main thread alone
        return
    came: list[int] = []
    held = {
        number: signal.signal(number, lambda which, _frame: came.append(which))
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    }
    try:
        yield
    finally:
        for number, handler in held.items():
            signal.signal(number, handler)
        for which in came:
            signal.raise_signal(which)


def _signal(process: subprocess.Popen[bytes], number: signal.Signals) -> None:
    if process.poll() is None:
        os.kill(process.pid, number)
