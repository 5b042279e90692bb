"""`tools`: looks after a directory's tools' files; says what a node has active."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from typing import Any

import numpy as np
from galen_model.arm.galen import JOINT_NAMES, SENSOR_FRAME
from galen_model.errors import GalenError
from galen_model.files.calibration_store import CalibrationStore, CalibrationStoreError
from galen_model.files.comparison import before_name, compare_calibrations
from galen_model.load.frames import FRAMES, joint_vector, needed_joints, sensor_in_frame
from galen_ros.command import (
    EXIT_OK,
    add_json,
    make_parser,
    positive,
    print_json,
    run_command,
    terminal,
)
from rich.console import Console

from galen_gravcomp.parameters import GravcompParameters
from galen_gravcomp.tools.report import (
    comparison_to_dict,
    list_to_dict,
    print_active,
    print_comparison,
    print_list,
    print_tool,
    tool_to_dict,
)

_NOTES = """A running gravcomp_node keeps what it has loaded, whatever happens to the files; its
services do the same as these commands and know what is active."""


def build_parser() -> argparse.ArgumentParser:
    """The command's options."""
    parser = make_parser(
        "tools",
        "Look after the tools' files of a directory.",
        notes=_NOTES,
        ok="done; `list`: also where some files can't be used",
        failed="not done; one line gives the reason, and nothing is changed",
    )
    common = argparse.ArgumentParser(add_help=False)
    add_json(common)
    files = argparse.ArgumentParser(add_help=False, parents=[common])
    files.add_argument(
        "--tools-dir",
        default=GravcompParameters().tools_dir,
        metavar="DIR",
        help="directory of the tools' files (default: %(default)s)",
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    _add(commands, "list", "every tool of the directory, broken files named", files)
    show = _add(commands, "show", "one tool, its mass and centre in any frame of the arm", files)
    show.add_argument("tool", metavar="NAME")
    show.add_argument(
        "--frame",
        choices=FRAMES,
        default=SENSOR_FRAME,
        help=f"{', '.join(FRAMES)} (default: %(default)s)",
        metavar="FRAME",
    )
    show.add_argument(
        "--joints",
        type=_joints,
        default=joint_vector([]),
        metavar="LIST",
        help=f"{','.join(JOINT_NAMES)} (m, rad), or roll,tilt alone, as --joints=0.1,-0.2; needed"
        " for frames beyond tilt_link",
    )
    compare = _add(
        commands, "compare", "two tools: what differs, and is it more than they can tell?", files
    )
    compare.add_argument("a", metavar="A")
    other = compare.add_mutually_exclusive_group(required=True)
    other.add_argument("b", metavar="B", nargs="?")
    other.add_argument(
        "--previous", action="store_true", help="the calibration before A's present one against it"
    )
    rename = _add(commands, "rename", "give a tool another name; never over another tool", files)
    rename.add_argument("tool", metavar="OLD")
    rename.add_argument("new_name", metavar="NEW")
    revert = _add(
        commands,
        "revert",
        "swap a tool's calibration with the one before it; twice: as it was",
        files,
    )
    revert.add_argument("tool", metavar="NAME")
    remove = _add(commands, "remove", "take a tool off the list; its file is kept beside", files)
    remove.add_argument("tool", metavar="NAME")
    remove.add_argument("--yes", action="store_true", help="don't ask")
    restore = _add(commands, "restore", "bring back the tool removed last under a name", files)
    restore.add_argument("tool", metavar="NAME")
    active_tool = _add(commands, "active", "what a running gravcomp_node has active", common)
    active_tool.add_argument(
        "--node", default="gravcomp", help="the node's name (default: %(default)s)"
    )
    active_tool.add_argument(
        "--timeout-s",
        type=positive,
        default=5.0,
        metavar="SECONDS",
        help="wait so long for the node (default: %(default)s)",
    )
    return parser


def _add(commands: Any, name: str, text: str, parent: argparse.ArgumentParser) -> Any:
    return commands.add_parser(name, help=text, description=text, parents=[parent])


def _joints(text: str) -> np.ndarray:
    try:
        return joint_vector([float(word) for word in text.split(",")])
    except (ValueError, GalenError) as error:
        raise argparse.ArgumentTypeError(str(error)) from error


def _list(arguments: argparse.Namespace, store: CalibrationStore, console: Console) -> None:
    if not store.directory.is_dir():
        raise CalibrationStoreError(
            f"{store.directory}: no such directory; --tools-dir names another one, and the first"
            " calibration makes it"
        )
    entries, removed = list(store.entries()), store.removed()
    if arguments.json:
        print_json(list_to_dict(str(store.directory), entries, removed))
    else:
        print_list(str(store.directory), entries, removed, console)


def _show(arguments: argparse.Namespace, store: CalibrationStore, console: Console) -> None:
    stored = store.read(arguments.tool)
    needed = [name in needed_joints(arguments.frame) for name in JOINT_NAMES]
    joints = np.where(needed, arguments.joints, math.nan)
    place = sensor_in_frame(arguments.frame, stored.tool.tip_m, joints)
    if arguments.json:
        print_json(tool_to_dict(stored, place, joints))
    else:
        print_tool(stored, place, joints, console)


def _compare(arguments: argparse.Namespace, store: CalibrationStore, console: Console) -> None:
    if arguments.previous:
        before, present = store.previous(arguments.a), store.read(arguments.a)
        names = (before_name(arguments.a), arguments.a)
        comparison = compare_calibrations(before.tool, present.tool, names)
    else:
        comparison = compare_calibrations(
            store.read(arguments.a).tool, store.read(arguments.b).tool
        )
    if arguments.json:
        print_json(comparison_to_dict(comparison))
    else:
        print_comparison(comparison, console)


def _rename(arguments: argparse.Namespace, store: CalibrationStore, console: Console) -> None:
    path = store.rename(arguments.tool, arguments.new_name).path
    _tell(arguments, console, {"path": str(path)}, f"'{arguments.tool}' is now {path}")


def _revert(arguments: argparse.Namespace, store: CalibrationStore, console: Console) -> None:
    stored = store.revert(arguments.tool)
    told = {"path": str(stored.path), "calibrated_at": stored.tool.calibrated_at}
    text = f"'{arguments.tool}' is as calibrated {stored.tool.calibrated_at} again: {stored.path}"
    _tell(arguments, console, told, text)


def _remove(arguments: argparse.Namespace, store: CalibrationStore, console: Console) -> None:
    if not arguments.yes and not _agreed(arguments.tool, store):
        raise GalenError(f"'{arguments.tool}' is not removed")
    kept = store.remove(arguments.tool)
    text = f"removed; kept as {kept}; back with: tools restore {arguments.tool}"
    _tell(arguments, console, {"kept_as": str(kept)}, text)


def _agreed(name: str, store: CalibrationStore) -> bool:
    try:
        tool = store.read(name).tool
        what = f"{1e3 * tool.load.mass_kg:.1f} g, calibrated {tool.calibrated_at}"
    except GalenError as error:
        what = str(error)
    print(f"remove '{name}' ({what})? [y/N] ", end="", file=sys.stderr, flush=True)
    return sys.stdin.readline().strip().lower() in ("y", "yes")


def _restore(arguments: argparse.Namespace, store: CalibrationStore, console: Console) -> None:
    path = store.restore(arguments.tool)
    _tell(arguments, console, {"path": str(path)}, f"'{arguments.tool}' is back: {path}")


def _active(arguments: argparse.Namespace, ros_args: Sequence[str], console: Console) -> None:
    from galen_gravcomp.tools.client import read  # needs ROS, the other commands don't

    state = read(arguments.node, arguments.timeout_s, ros_args)
    if arguments.json:
        print_json(state)
    else:
        print_active(state, console)


_COMMANDS = {
    "list": _list,
    "show": _show,
    "compare": _compare,
    "rename": _rename,
    "revert": _revert,
    "remove": _remove,
    "restore": _restore,
}


def _tell(
    arguments: argparse.Namespace, console: Console, content: dict[str, str], text: str
) -> None:
    if arguments.json:
        print_json(content)
    else:
        console.print(text, soft_wrap=True, highlight=False, markup=False)


def main(args: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    words = list(sys.argv[1:] if args is None else args)
    at = words.index("--ros-args") if "--ros-args" in words else len(words)
    parser = build_parser()
    arguments = parser.parse_args(words[:at])
    if arguments.command == "remove" and not arguments.yes and not sys.stdin.isatty():
        parser.error("remove asks on a terminal, and there is none: give --yes")
    console = terminal()

    def work() -> int:
        if arguments.command == "active":
            _active(arguments, words[at:], console)
        else:
            _COMMANDS[arguments.command](arguments, CalibrationStore(arguments.tools_dir), console)
        return EXIT_OK

    return run_command("tools", work)


if __name__ == "__main__":
    sys.exit(main())
