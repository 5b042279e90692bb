# SPDX-License-Identifier: Apache-2.0
"""The command layer: parser, options, output places, pages, progress, exit codes. No rclpy."""

from __future__ import annotations

import argparse
import base64
import hashlib
import json
import math
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from galen_model.errors import GalenError
from tqdm import tqdm

if TYPE_CHECKING:
    from rich.console import Console

EXIT_OK, EXIT_FAILED, EXIT_USAGE, EXIT_INTERRUPTED = 0, 1, 2, 130
# A process that a signal ended has this much more than the signal's number.
EXIT_SIGNAL = 128
_SHOW_PERIOD_S = 0.2
_BAG_FORMATS = "rosbag2 directory, .mcap or .db3"

_Options = argparse.ArgumentParser | argparse._ArgumentGroup


# Parser and options


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        if "arguments are required" in message:  # an option of several values may have taken them
            message += " (arguments without an option go first, or after --)"
        super().error(message)


def make_parser(
    name: str,
    description: str,
    *,
    notes: str = "",
    ok: str = "done",
    failed: str = "failed; one line gives the reason",
    interrupted: str = "interrupted (Ctrl-C)",
    codes: Mapping[int, str] | None = None,
    usage: str | None = None,
) -> argparse.ArgumentParser:
    """Make a command's parser; its help ends with the exit codes.

    Args:
        name: the command's name.
        description: one sentence on what the command does.
        notes: printed before the exit codes, as written.
        ok: meaning of exit code 0.
        failed: meaning of exit code 1.
        interrupted: meaning of exit code 130.
        codes: meanings of the command's own exit codes.
        usage: instead of argparse's.

    Returns:
        The parser, still without options.

    """
    meanings = {EXIT_OK: ok, EXIT_FAILED: failed, EXIT_USAGE: "wrong arguments"}
    meanings |= {**(codes or {}), EXIT_INTERRUPTED: interrupted}
    lines = [f"  {code:<4d} {text}" for code, text in sorted(meanings.items())]
    return _Parser(
        prog=name,
        usage=usage,
        description=description,
        epilog="\n".join([*([notes.rstrip(), ""] if notes else []), "exit codes:", *lines]),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def add_bags(options: _Options, what: str = "recording", nargs: str = "+") -> None:
    """Add the positional argument `bags`: bags, or folders that are searched for them.

    Args:
        options: parser, or a group of its options.
        what: what the bags are, for the help's text.
        nargs: argparse's number of arguments.

    """
    options.add_argument(
        "bags",
        nargs=nargs,
        type=Path,
        metavar="BAG",
        help=f"{what}: {_BAG_FORMATS}, or a folder that is searched for them",
    )


def add_tool_file(options: _Options, what: str = "the tool's calibration file") -> Any:
    """Add `--tool FILE`, a Path or None.

    Args:
        options: parser, or a group of its options.
        what: the help's text.

    Returns:
        The option, as `add_argument` gives it.

    """
    return options.add_argument("--tool", type=Path, metavar="FILE", help=what)


def add_json(options: _Options, what: str = "print the result as one JSON object") -> None:
    """Add the flag `--json`.

    Args:
        options: parser, or a group of its options.
        what: the help's text.

    """
    options.add_argument("--json", action="store_true", help=what)


def add_plots(options: _Options) -> None:
    """Add `--plots DIR`; `check_folder` checks it before the work.

    Args:
        options: parser, or a group of its options.

    """
    options.add_argument("--plots", type=Path, metavar="DIR", help="write pictures to DIR")


def add_topic(options: _Options, option: str, default: str, what: str) -> None:
    """Add the name of a topic in a recording.

    Args:
        options: parser, or a group of its options.
        option: the option's name, such as `--joint-states`.
        default: the topic's name without a namespace.
        what: what is on the topic, for the help's text.

    """
    options.add_argument(
        option,
        default=default,
        metavar="TOPIC",
        help=f"topic of {what} (default: %(default)s, in any one namespace)",
    )


def add_table_columns(options: _Options) -> None:
    """Add `--columns` and `--no-setup-check` of a table of readings, and `--wrench-frame`.

    Args:
        options: parser, or a group of its options.

    """
    options.add_argument(
        "--columns",
        metavar="NAMES",
        help="comma-separated column names of a table without a first line of names; '-' skips one",
    )
    add_wrench_frame(options)
    add_no_setup_check(options)


def add_no_setup_check(options: _Options) -> None:
    """Add the flag `--no-setup-check`.

    Args:
        options: parser, or a group of its options.

    """
    options.add_argument(
        "--no-setup-check",
        action="store_true",
        help="go on where a wrong set-up (mount, axes, units, order) explains the readings",
    )


def add_wrench_frame(options: _Options) -> None:
    """Add `--wrench-frame` of a table or a bag: "sensor" or "base".

    Args:
        options: parser, or a group of its options.

    """
    options.add_argument(
        "--wrench-frame",
        choices=("sensor", "base"),
        default="sensor",
        help="axes that the wrenches are written in, about the sensor's origin (default:"
        " %(default)s)",
    )


def add_arm_topics(options: _Options) -> None:
    """Add `--joint-states`, `--wrench-raw`, `--joint-names` and `--log-times` of a bag.

    Args:
        options: parser, or a group of its options.

    """
    add_topic(options, "--joint-states", "joint_states", "the joint states")
    add_topic(options, "--wrench-raw", "wrench_raw", "the raw wrench")
    options.add_argument(
        "--joint-names",
        metavar="NAMES",
        help="names of the joints, by commas; only the revolute ones must be there (default: the"
        " arm's)",
    )
    options.add_argument(
        "--log-times",
        action="store_true",
        help="take the times at which messages were recorded, not their stamps",
    )


def add_workers(options: _Options) -> None:
    """Add `--workers N` and `--scheduler ADDRESS`, for galen_bags.many (None: not given).

    Args:
        options: parser, or a group of its options; the two exclude each other.

    """
    group = options.add_mutually_exclusive_group()
    group.add_argument(
        "--workers", type=whole(1), metavar="N", help="local processes (default: one a processor)"
    )
    group.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        help="address (tcp://host:port) or file of a Dask scheduler whose workers see the same"
        " paths or URLs; only one that you trust",
    )


def own_arguments(arguments: Sequence[str]) -> list[str]:
    """Return a command's arguments without those between each `--ros-args` and `--`, or the end.

    rclpy's `remove_ros_args` also drops what only looks like a ROS argument, such as OLD:=NEW.

    Args:
        arguments: of the command line.

    Returns:
        The command's own ones, in their order.

    """
    own: list[str] = []
    to_ros = False
    for argument in arguments:
        to_ros = to_ros or argument == "--ros-args"
        if not to_ros:
            own.append(argument)
        to_ros = to_ros and argument != "--"
    return own


def positive(text: str) -> float:
    """Read a finite number above zero, for argparse.

    Args:
        text: as typed.

    Returns:
        The number.

    Raises:
        argparse.ArgumentTypeError: it is no such number.

    """
    value = finite(text)
    if value <= 0.0:
        raise argparse.ArgumentTypeError(f"{text} is not above 0")
    return value


def not_negative(text: str) -> float:
    """Read a finite number, zero or above, for argparse.

    Args:
        text: as typed.

    Returns:
        The number.

    Raises:
        argparse.ArgumentTypeError: it is no such number.

    """
    value = finite(text)
    if value < 0.0:
        raise argparse.ArgumentTypeError(f"{text} is below 0")
    return value


def whole(least: int, most: int | None = None) -> Callable[[str], int]:
    """Make a reader of whole numbers, for argparse.

    Args:
        least: smallest number accepted.
        most: largest number accepted; None: no limit.

    Returns:
        The reader, which raises argparse.ArgumentTypeError for anything else.

    """

    def read(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            raise argparse.ArgumentTypeError(f"{text!r} is no whole number") from None
        if value < least:
            raise argparse.ArgumentTypeError(f"{text} is below {least}")
        if most is not None and value > most:
            raise argparse.ArgumentTypeError(f"{text} is above {most}")
        return value

    return read


def finite(text: str) -> float:
    """Read a finite number, for argparse.

    Args:
        text: as typed.

    Returns:
        The number.

    Raises:
        argparse.ArgumentTypeError: it is no such number.

    """
    try:
        value = float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no number") from None
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"{text} is not finite")
    return value


# Output places


def check_folder(folder: Path | None) -> None:
    """Check before the work that files can be written into a folder.

    Args:
        folder: it, and those above it, need not exist yet; None: nothing is checked.

    Raises:
        GalenError: no file can be written there.

    """
    if folder is not None:
        _check_writable(folder, folder)


def check_parent(path: Path) -> None:
    """Check before the work that something of this name can be made.

    Args:
        path: file or folder to make; the folders above it need not exist yet.

    Raises:
        GalenError: nothing can be written into its folder.

    """
    _check_writable(path.parent, path)


def check_file(path: Path | None) -> None:
    """Check before the work that a file can be written.

    Args:
        path: file to write; None: nothing is checked.

    Raises:
        GalenError: it can't be written, or is a directory.

    """
    if path is None:
        return
    with writing(path):
        is_folder = path.is_dir()
    if is_folder:
        raise GalenError(f"{path}: is a directory; name the file")
    check_parent(path)


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turn a failure of writing into a GalenError that names the file or folder.

    Args:
        path: named in the error's text.

    Yields:
        Nothing; the body does the writing.

    Raises:
        GalenError: the body raised an OSError.

    """
    try:
        yield
    except OSError as error:
        raise GalenError(f"{path}: can't be written: {error.strerror or error}") from error


def _check_writable(folder: Path, named: Path) -> None:
    """Write into the folder, or the nearest existing one above; nothing is left behind."""
    with writing(named):
        existing = next((path for path in (folder, *folder.parents) if path.exists()), Path())
        if not existing.is_dir():
            raise GalenError(f"{named}: can't be written: {existing}: is no directory")
        # Permissions alone don't decide it: root has them all, and a disk may be read-only.
        Path(tempfile.mkdtemp(dir=existing, prefix=".galen_")).rmdir()


# Pages


@dataclass(frozen=True)
class PageRow:
    """A row of a page's table; share: of a bar beside it, None without one."""

    cells: Sequence[str]
    share: float | None = None
    marked: bool = False


def render_page(template: Path, pictures: Mapping[str, bytes], **content: Any) -> str:
    """Return a page for people: one file that loads and runs nothing.

    Text is escaped by jinja2. The Content-Security-Policy lets in nothing but pictures in the page
    itself and the one style sheet whose hash it names; a name that smuggled in a tag could still
    not run or load anything.

    Args:
        template: extends `page.html`.
        pictures: PNG by name.
        **content: `title`, `sentence`, `verdict`, `good`, `captions` (by picture) and what the
            template shows.

    Returns:
        The page's HTML.

    """
    from jinja2 import Environment, FileSystemLoader  # slow to import

    here = Path(__file__).parent
    style = (here / "style.css").read_text(encoding="utf-8")
    loader = FileSystemLoader([template.parent, here])
    page = Environment(autoescape=True, trim_blocks=True, loader=loader).get_template(template.name)
    return page.render(
        style=style,
        digest=base64.b64encode(hashlib.sha256(style.encode()).digest()).decode(),
        pictures={name: base64.b64encode(png).decode() for name, png in pictures.items()},
        **content,
    )


# Terminal


def terminal(width: int = 120) -> Console:
    """Return a console on standard output.

    Args:
        width: columns where standard output is no terminal; a terminal has its own width.

    Returns:
        A console that doesn't colour numbers and names by itself.

    """
    from rich.console import Console  # slow to import, and `--json` needs none

    return Console(width=None if sys.stdout.isatty() else width, highlight=False)


def print_json(content: object) -> None:
    """Print JSON to standard output.

    Args:
        content: what `json.dumps` takes.

    """
    print(json.dumps(content, indent=2))


def progress(
    total: int | None = None, unit: str = "it", text: str = "", *, quiet: bool = False
) -> tqdm:
    """Return a progress bar on standard error; it draws nothing where that is no terminal.

    Args:
        total: how many there are; None: not known, and only a count is shown.
        unit: name of what is counted.
        text: stands before the bar; empty: nothing.
        quiet: whether to draw nothing, as with `--json`.

    Returns:
        The bar, to be closed by its user.

    """
    return tqdm(
        total=total,
        unit=unit,
        unit_scale=total is None,
        desc=text or None,
        file=sys.stderr,
        disable=quiet or not sys.stderr.isatty(),
        leave=False,
        **_size(),
    )


class ProgressLine:
    """One line on standard error that is written over; nothing where that is no terminal.

    With a total it is a bar: of counts with `unit`, else of a share.
    """

    def __init__(self, unit: str = "", *, quiet: bool = False) -> None:
        self.active = sys.stderr.isatty() and not quiet
        self._unit = unit
        self._bar: tqdm | None = None
        self._shown_s = -math.inf

    def __enter__(self) -> ProgressLine:
        return self

    def __exit__(self, *_error: object) -> None:
        self.close()

    def show(
        self, text: str | Callable[[], str], done: float = 0.0, total: float | None = None
    ) -> None:
        """Write the line again, at most five times a second; a share never gets smaller.

        Args:
            text: what goes on, or a function that makes the text, called only where it is shown.
            done: how much is done, in the unit of `total`.
            total: how much there is; None: text alone. The first call decides the line's form.

        """
        now_s = time.monotonic()
        finished = total is not None and done >= total
        if not self.active or (now_s - self._shown_s < _SHOW_PERIOD_S and not finished):
            return
        self._shown_s = now_s
        if self._bar is None:
            form = "{percentage:3.0f}% |{bar}| {desc}"
            if total is None:
                form = "{desc}"
            elif self._unit:
                form = "{desc}: {percentage:3.0f}% |{bar}| {n_fmt}/{total_fmt} {unit}"
            self._bar = tqdm(unit=self._unit, bar_format=form, file=sys.stderr, **_size())
        self._bar.set_description_str(text if isinstance(text, str) else text(), refresh=False)
        if total is not None:
            part = min(done, total)
            self._bar.total, self._bar.n = total, part if self._unit else max(self._bar.n, part)
        self._bar.refresh()

    def line(self, text: str) -> None:
        """Print a line above, also where there is no terminal.

        Args:
            text: the line, without a newline.

        """
        tqdm.write(text, file=sys.stderr)
        sys.stderr.flush()

    def close(self) -> None:
        """Leave the line as it is."""
        if self._bar is not None:
            self._bar.close()
            self._bar = None


def _size() -> dict[str, int]:
    """Sizes for tqdm, which shows nothing on a terminal that reports 0 rows."""
    return {"ncols": min(shutil.get_terminal_size().columns, 100), "nrows": 24}


# End


def run_command(name: str, work: Callable[[], int], if_interrupted: str = "") -> int:
    """Do a command's work, and print one line on standard error for what failed.

    Args:
        name: the command's name, which begins the line.
        work: does it; returns the exit code.
        if_interrupted: what an interruption leaves, to end the line, such as "; no bag is written".

    Returns:
        The exit code: that of `work`, EXIT_FAILED after a GalenError, EXIT_INTERRUPTED after
        Ctrl-C.

    """
    try:
        return work()
    except GalenError as error:
        print(f"{name}: {error}", file=sys.stderr)
        return EXIT_FAILED
    except KeyboardInterrupt:
        print(f"{name}: interrupted{if_interrupted}", file=sys.stderr)
        return EXIT_INTERRUPTED
