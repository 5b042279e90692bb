# SPDX-License-Identifier: Apache-2.0
"""`tools`: looks after a directory's calibration files; shows what a node has active."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Mapping, Sequence
from typing import Any

from galen_common.arm import add_arm, chosen_arm
from galen_common.command import (
    EXIT_OK,
    add_json,
    make_parser,
    positive,
    print_json,
    run_command,
    terminal,
)
from galen_model.arm.galen import WRENCH_AXES
from galen_model.arrays import Array
from galen_model.errors import GalenError
from galen_model.files.calibration_file import age_text
from galen_model.files.calibration_store import CalibrationStore, CalibrationStoreError
from galen_model.files.comparison import (
    CalibrationComparison,
    before_name,
    compare_calibrations,
    three_digits,
)
from galen_model.files.export import FORMATS, export_load
from galen_model.load.model import LoadEstimate
from rich.markup import escape
from rich.table import Table

from galen_gravcomp.parameters import GravcompParameters

_NOTES = """A running gravcomp_node keeps what it has loaded, whatever happens to the files; its
services do the same as these commands and know what is active."""
_LONGEST_LIST = 12


def build_parser() -> argparse.ArgumentParser:
    """Make the parser."""
    parser = make_parser(
        "tools",
        "Look after the calibration files of a directory.",
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
        help="directory of the calibration files (default: %(default)s)",
    )
    add_arm(files)
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def add(name: str, text: str, *names: str, parent: argparse.ArgumentParser = files) -> Any:
        made = commands.add_parser(name, help=text, description=text, parents=[parent])
        for one in names:
            made.add_argument(one, metavar=one.upper())
        return made

    add("list", "every tool of the directory, broken files named")
    add("show", "one tool: mass, centre, tip, and what its calibration left", "tool")
    compare = add("compare", "two tools: what differs, and is it more than their covariances", "a")
    other = compare.add_mutually_exclusive_group(required=True)
    other.add_argument("b", metavar="B", nargs="?")
    other.add_argument(
        "--previous", action="store_true", help="the calibration before A's present one against it"
    )
    add("rename", "give a tool another name; never over another tool", "tool", "new_name")
    add("revert", "swap a tool's calibration with the one before it; twice: as it was", "tool")
    remove = add("remove", "remove a tool from the list; its file is kept beside", "tool")
    remove.add_argument("--yes", action="store_true", help="don't ask")
    add("restore", "bring back the tool removed last under a name", "tool")
    export = add("export", "the load of tool and adapter as a robot's driver takes it", "tool")
    export.add_argument("--format", required=True, choices=FORMATS, help="whose driver")
    export.add_argument(
        "--frame",
        metavar="FRAME",
        help="rigid to the sensor, as tool0 is (default: its own)",
    )
    active = add("active", "what a running gravcomp_node has active", parent=common)
    active.add_argument("--node", default="gravcomp", help="the node's name (default: %(default)s)")
    active.add_argument(
        "--timeout-s",
        type=positive,
        default=5.0,
        metavar="SECONDS",
        help="wait so long for the node (default: %(default)s)",
    )
    return parser


def _give(arguments: argparse.Namespace, content: dict[str, Any], *shown: str | Table) -> None:
    """Print an answer: JSON, or tables and lines."""
    if arguments.json:
        print_json(content)
        return
    console = terminal()
    for item in shown:
        console.print(item, soft_wrap=isinstance(item, str), highlight=False)


def _list(arguments: argparse.Namespace, store: CalibrationStore) -> None:
    if not store.directory.is_dir():
        raise CalibrationStoreError(
            f"{store.directory}: no such directory; --tools-dir names another one, and the first"
            " calibration makes it"
        )
    table = Table(title=escape(str(store.directory)), title_justify="left")
    for name in ("tool", "mass, g", "centre, mm", "in", "calibrated", "poses", "parts"):
        table.add_column(name)
    rows: list[dict[str, Any]] = []
    broken = []
    for entry in store.entries():
        rows.append({"tool": entry.name, "problem": entry.problem or None})
        if entry.stored is None:
            broken.append(f"[red]can't be used: {escape(entry.problem)}[/red]")
            continue
        tool = entry.stored.tool
        rows[-1] |= {
            "mass_kg": float(tool.load.mass_kg),
            "mass_std_kg": tool.load.mass_std_kg,
            "com_m": tool.load.com_m.tolist(),
            "calibrated_at": tool.calibrated_at,
            "parts": list(tool.parts),
            "unresolved": list(tool.unresolved),
        }
        parts = (*tool.parts, *(("one sweep",) if tool.unresolved else ()))
        age, poses = age_text(tool.calibrated_at), str(tool.poses_used)
        load = (_mass(tool.load), _millimetres(tool.load.com_m), escape(tool.sensor_frame))
        table.add_row(entry.name, *load, age, poses, ", ".join(parts))
    removed = list(store.removed())
    shown = [f"removed, and can be restored: {', '.join(removed)}"] if removed else []
    content = {"tools_dir": str(store.directory), "tools": rows, "removed": removed}
    _give(arguments, content, table, *broken, *shown)


def _show(arguments: argparse.Namespace, store: CalibrationStore) -> None:
    stored = store.read(arguments.tool)
    tool = stored.tool
    content = tool.to_json() | {"path": str(stored.path), "sha256": stored.sha256}
    frame = escape(tool.sensor_frame)
    table = Table("", "mass, g", f"centre in {frame}, mm", "standard deviation, mm")
    for name, load in (("tool", tool.load), ("adapter", tool.adapter)):
        table.add_row(name, _mass(load), _millimetres(load.com_m), _millimetres(load.com_std_m))
    table.add_row("tip", "", _millimetres(tool.tip_m), "")
    rejected = f", {len(tool.poses_rejected)} rejected" if tool.poses_rejected else ""
    _give(
        arguments,
        content,
        f"[bold]{tool.tool}[/bold]: {escape(str(stored.path))}",
        table,
        f"calibrated {tool.calibrated_at}, {age_text(tool.calibrated_at)}, in {tool.poses_used}"
        f" poses{rejected}",
        *([f"model: {escape(f'{tool.model} - {tool.model_reason}')}"] if tool.model else []),
        _wrenches(f"in {frame}", {"offset left": tool.residual_offset, "RMSE": tool.rmse}),
        *(_fields(part, getattr(tool, part).to_json()) for part in tool.parts),
        *(
            f"[yellow]not identified by the calibration: {escape(text)}[/yellow]"
            for text in tool.unresolved
        ),
    )


def _compare(arguments: argparse.Namespace, store: CalibrationStore) -> None:
    if arguments.previous:
        before, present = store.previous(arguments.a), store.read(arguments.a)
        names = (before_name(arguments.a), arguments.a)
        comparison = compare_calibrations(before.tool, present.tool, names)
    else:
        a, b = store.read(arguments.a), store.read(arguments.b)
        comparison = compare_calibrations(a.tool, b.tool)
    style = "green" if comparison.same_load else "yellow"
    table = Table("", "unit", escape(comparison.a), escape(comparison.b), "difference", "in words")
    for row in comparison.differences:
        scale, unit = row.shown
        std_dev = "" if math.isnan(row.std_dev) else f" ± {three_digits(scale * row.std_dev)}"
        table.add_row(
            row.quantity.replace("_", " "),
            unit,
            f"{scale * row.a:.2f}",
            f"{scale * row.b:.2f}",
            three_digits(scale * row.value) + std_dev,
            row.text,
        )
    sentence = f"[{style}]{escape(comparison.text)}[/{style}]"
    _give(arguments, comparison_to_json(comparison), sentence, table)


def comparison_to_json(comparison: CalibrationComparison) -> dict[str, Any]:
    """Return the comparison in SI.

    Args:
        comparison: of two calibration files.

    Returns:
        Content for JSON; `std_dev` and `sigmas` are None where the files hold none.

    """
    return {
        "a": comparison.a,
        "b": comparison.b,
        "same_load": comparison.same_load,
        "text": comparison.text,
        "differences": [
            {
                "quantity": row.quantity,
                "unit": row.unit,
                "a": float(row.a),
                "b": float(row.b),
                "difference": float(row.value),
                "std_dev": float(row.std_dev) if math.isfinite(row.std_dev) else None,
                "sigmas": float(row.sigmas) if math.isfinite(row.sigmas) else None,
                "text": row.text,
            }
            for row in comparison.differences
        ],
        "worst": {
            "force_n": comparison.worst_force[0],
            "torque_nm": comparison.worst_torque[0],
        },
        "parts": [{"part": part, "only_in": owner} for part, owner in comparison.parts],
    }


def _rename(arguments: argparse.Namespace, store: CalibrationStore) -> None:
    path = store.rename(arguments.tool, arguments.new_name).path
    _give(arguments, {"path": str(path)}, escape(f"'{arguments.tool}' is now {path}"))


def _revert(arguments: argparse.Namespace, store: CalibrationStore) -> None:
    stored = store.revert(arguments.tool)
    at = stored.tool.calibrated_at
    text = f"'{arguments.tool}' is as calibrated {at} again: {stored.path}"
    _give(arguments, {"path": str(stored.path), "calibrated_at": at}, escape(text))


def _remove(arguments: argparse.Namespace, store: CalibrationStore) -> None:
    name = arguments.tool
    if not arguments.yes and not _agreed(name, store):
        raise GalenError(f"'{name}' is not removed")
    kept = store.remove(name)
    text = f"removed; kept as {kept}; back with: tools restore {name}"
    _give(arguments, {"kept_as": str(kept)}, escape(text))


def _agreed(name: str, store: CalibrationStore) -> bool:
    try:
        tool = store.read(name).tool
        what = f"{1e3 * tool.load.mass_kg:.1f} g, calibrated {tool.calibrated_at}"
    except GalenError as error:
        what = str(error)
    print(f"remove '{name}' ({what})? [y/N] ", end="", file=sys.stderr, flush=True)
    return sys.stdin.readline().strip().lower() in ("y", "yes")


def _restore(arguments: argparse.Namespace, store: CalibrationStore) -> None:
    path = store.restore(arguments.tool)
    _give(arguments, {"path": str(path)}, escape(f"'{arguments.tool}' is back: {path}"))


def _export(arguments: argparse.Namespace, store: CalibrationStore) -> None:
    tool = store.read(arguments.tool).tool
    content = export_load(tool, arguments.format, arguments.frame or "")
    if arguments.json:
        print_json(content)
    else:
        print(content["text"], end="")  # to be copied as it is: no console wraps or colours it


def _active(arguments: argparse.Namespace, ros_args: Sequence[str]) -> None:
    from galen_gravcomp.ros.active_tool import read_active  # needs ROS, the other commands don't

    state = read_active(arguments.node, arguments.timeout_s, ros_args)
    shown: list[str | Table] = [_fields("active", state)]
    if not state["tool"]:
        shown = ["[yellow]no tool is active: nothing is compensated[/yellow]"]
    elif not state["enabled"]:
        shown.append("[yellow]compensation is switched off[/yellow]")
    if state["file_state"] in ("changed", "gone"):
        shown.append(
            f"[yellow]the file is {state['file_state']} since it was loaded: what is active is the"
            " older content[/yellow]"
        )
    _give(arguments, state, *shown)


_COMMANDS = {
    "list": _list,
    "show": _show,
    "compare": _compare,
    "rename": _rename,
    "revert": _revert,
    "remove": _remove,
    "restore": _restore,
    "export": _export,
}


# Tables


def _mass(load: LoadEstimate) -> str:
    return f"{1e3 * load.mass_kg:.2f} ± {three_digits(1e3 * load.mass_std_kg)}"


def _millimetres(values: Array) -> str:
    return " ".join(f"{1e3 * value:8.2f}" for value in values)


def _wrenches(title: str, rows: Mapping[str, Array]) -> Table:
    table = Table(f"{title}, mN and mN.m", *WRENCH_AXES)
    for name, values in rows.items():
        table.add_row(name, *(f"{1e3 * value:.2f}" for value in values))
    return table


def _fields(title: str, content: Mapping[str, Any]) -> Table:
    """Plain content, whatever it holds; a covariance only by name."""
    table = Table(title, "")
    for key, value in content.items():
        table.add_row(key, "given" if "covariance" in key else _plain(value))
    return table


def _plain(value: Any) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{key}: {_plain(item)}" for key, item in value.items())
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, Sequence) and not isinstance(value, str):
        if len(value) > _LONGEST_LIST:
            return f"{len(value)} values"
        return " ".join(_plain(item) for item in value)
    return escape(str(value))


def main(args: Sequence[str] | None = None) -> int:
    """Run the command.

    Args:
        args: the command line without the program's name; None: that of the process.

    Returns:
        The exit code.

    """
    words = list(sys.argv[1:] if args is None else args)
    at = words.index("--ros-args") if "--ros-args" in words else len(words)
    parser = build_parser()
    arguments = parser.parse_args(words[:at])
    if arguments.command == "remove" and not arguments.yes and not sys.stdin.isatty():
        parser.error("remove asks on a terminal, and there is none: give --yes")

    def work() -> int:
        if arguments.command == "active":
            _active(arguments, words[at:])
        else:
            arm, any_arm = chosen_arm(arguments), not arguments.urdf
            store = CalibrationStore(arguments.tools_dir, arm, other_arms=any_arm)
            _COMMANDS[arguments.command](arguments, store)
        return EXIT_OK

    return run_command("tools", work)


if __name__ == "__main__":
    sys.exit(main())
