"""What commands share: numbers and places on the command line, a live line, how they end."""

from __future__ import annotations

import argparse
import math
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from galen_model.errors import GalenError
from tqdm import tqdm

EXIT_OK, EXIT_FAILED, EXIT_USAGE, EXIT_INTERRUPTED = 0, 1, 2, 130
# A process that a signal ended has this much more than the signal's number.
EXIT_SIGNAL = 128
_SHOW_PERIOD_S = 0.2


def split_ros_arguments(arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    """A command's own arguments, and those from each `--ros-args` to `--` or the end.

    rclpy's `remove_ros_args` also takes away what only looks like one, such as OLD:=NEW.
    """
    own: list[str] = []
    ros: list[str] = []
    to_ros = False
    for argument in arguments:
        to_ros = to_ros or argument == "--ros-args"
        (ros if to_ros else own).append(argument)
        to_ros = to_ros and argument != "--"
    return own, ros


def positive(text: str) -> float:
    """A finite number above zero, for argparse."""
    value = _finite(text)
    if value <= 0.0:
        raise argparse.ArgumentTypeError(f"{text} is not above 0")
    return value


def not_negative(text: str) -> float:
    """A finite number, zero or above, for argparse."""
    value = _finite(text)
    if value < 0.0:
        raise argparse.ArgumentTypeError(f"{text} is below 0")
    return value


def _finite(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no number") from None
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"{text} is not finite")
    return value


def check_folder(folder: Path | None) -> None:
    """Raise GalenError before the work if no file can be written into it.

    The folder, and those above it, need not be there yet.
    """
    if folder is not None:
        _check_writable(folder, folder)


def check_parent(path: Path) -> None:
    """Raise GalenError before the work if nothing of this name can be made."""
    _check_writable(path.parent, path)


def check_file(path: Path | None) -> None:
    """Raise GalenError before the work if the file can't be written."""
    if path is None:
        return
    try:
        is_folder = path.is_dir()
    except OSError as error:
        raise GalenError(f"{path}: can't be written: {error.strerror}") from error
    if is_folder:
        raise GalenError(f"{path}: is a directory; name the file")
    check_parent(path)


def _check_writable(folder: Path, named: Path) -> None:
    """Write into the folder, or the nearest above that is there; nothing is left behind."""
    try:
        there = next((path for path in (folder, *folder.parents) if path.exists()), Path())
        if not there.is_dir():
            raise GalenError(f"{named}: can't be written: {there}: is no directory")
        # Permissions alone don't tell: root has them all, and a file system may be read-only.
        Path(tempfile.mkdtemp(dir=there, prefix=".galen_")).rmdir()
    except OSError as error:
        raise GalenError(f"{named}: can't be written: {error.strerror}") from error


def run_command(name: str, work: Callable[[], int]) -> int:
    """Do a command's work; returns the exit code, and says in a line what went wrong."""
    try:
        return work()
    except GalenError as error:
        print(f"{name}: {error}", file=sys.stderr)
        return EXIT_FAILED
    except KeyboardInterrupt:
        print(f"{name}: interrupted", file=sys.stderr)
        return EXIT_INTERRUPTED


class LiveLine:
    """One line on standard error that is written over; nothing where that is no terminal.

    With `total_s` it is a bar, filled by `show`'s `done_s`.
    """

    def __init__(self, total_s: float | None = None) -> None:
        self._bar: tqdm | None = None
        self._shown_s = -math.inf
        if sys.stderr.isatty():
            # Sizes given: tqdm shows nothing on a terminal that says it has 0 rows.
            columns = min(shutil.get_terminal_size().columns, 100)
            form = "{desc}" if total_s is None else "{percentage:3.0f}% |{bar}| {desc}"
            self._bar = tqdm(
                total=total_s, bar_format=form, file=sys.stderr, ncols=columns, nrows=24
            )

    def show(self, text: Callable[[], str], done_s: float = 0.0) -> None:
        """Write the line again, not more often than five times a second."""
        now_s = time.monotonic()
        if self._bar is None or now_s - self._shown_s < _SHOW_PERIOD_S:
            return
        self._shown_s = now_s
        if self._bar.total is not None:
            self._bar.n = min(done_s, self._bar.total)
        self._bar.set_description_str(text())

    def close(self) -> None:
        """Leave the line as it is."""
        if self._bar is not None:
            self._bar.close()
            self._bar = None
