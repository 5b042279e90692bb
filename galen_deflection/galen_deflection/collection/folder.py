"""The folder that a collection leaves: whole under its name, or as `<name>.unfinished`.

    <recordings_dir>/<name>/push/, calibration_1/, calibration_2/    rosbag2 directories (MCAP)
    <recordings_dir>/<name>/tool.json                                the tool's file as it was
    <recordings_dir>/<name>/collection.json                          what was asked and what came

It grows as `<name>.unfinished` (a name that no collection can have) and is renamed in one step at
the end. What a canceled, failed or killed collection has recorded until then stays there and can be
read; one that has recorded nothing leaves nothing.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from galen_model.arrays import Array
from galen_model.errors import GalenError
from galen_model.files.atomic_file import write_whole
from galen_model.files.calibration_file import CalibrationFile, check_tool_name, write_calibration
from galen_model.files.json_fields import numbers

from galen_deflection.collection.commands import Collected, ErrorCode
from galen_deflection.collection.plan import CollectionPlan

TOOL_FILE, SUMMARY_FILE = "tool.json", "collection.json"
SCHEMA_VERSION = 1
_MOST_UNFINISHED = 1000


class CollectionFolderError(GalenError):
    """A folder that is there already, or can't be written; the message names it."""


class CollectionFolder:
    """One collection's folder, from its making to its name."""

    def __init__(self, recordings_dir: Path, name: str) -> None:
        """Only checks; raises ToolNameError and CollectionFolderError."""
        self.final = recordings_dir / check_tool_name(name, "recording's")
        self._reject_existing()
        self.path = self.final

    def make(self, tool: CalibrationFile) -> None:
        """Make the unfinished folder with the tool's file in it; raises a GalenError."""
        try:
            self.final.parent.mkdir(parents=True, exist_ok=True)
            self.path = self._make_unfinished()
        except OSError as error:
            raise CollectionFolderError(f"{self.final}: can't be made: {error}") from error
        write_calibration(self.path / TOOL_FILE, tool)

    def close(self, summary: Mapping[str, Any], *, finished: bool) -> Path:
        """Write the summary and return where it all is, under its own name if it is finished.

        Raises CollectionFolderError; all that was recorded is then in `path`.
        """
        text = json.dumps(summary, indent=2) + "\n"
        try:
            write_whole(self.path / SUMMARY_FILE, text)
            if finished:
                self._reject_existing()  # one that came meanwhile is not written over
                self.path.rename(self.final)
                self.path = self.final
        except OSError as error:
            raise CollectionFolderError(f"{self.path}: can't be written: {error}") from error
        return self.path

    def discard(self) -> None:
        """Take it away again: nothing was recorded."""
        if self.path != self.final:
            shutil.rmtree(self.path, ignore_errors=True)

    def _make_unfinished(self) -> Path:
        for number in range(1, _MOST_UNFINISHED):
            path = self.final.with_name(
                f"{self.final.name}.unfinished" + (f"-{number}" if number > 1 else "")
            )
            try:
                path.mkdir()
            except FileExistsError:
                continue
            return path
        raise CollectionFolderError(f"{self.final}.unfinished: there are too many of them")

    def _reject_existing(self) -> None:
        if os.path.lexists(self.final):
            raise CollectionFolderError(f"{self.final}: is there already, and is not written over")


def summary(
    name: str,
    tool: str,
    plan: CollectionPlan,
    by_service: bool,
    error_code: ErrorCode,
    error_msg: str,
    collected: Collected,
    messages: int,
) -> dict[str, Any]:
    """Make the content of `collection.json`; SI units, lengths m, angles rad, loads N and N.m."""
    return {
        "schema_version": SCHEMA_VERSION,
        "name": name,
        "tool": tool,
        "finished": error_code == ErrorCode.NONE,
        "error": {"code": error_code.name, "message": error_msg},
        "asked": {
            "sets": plan.sets,
            "positions": [numbers(row) for row in plan.positions],
            "pushes": [numbers(push.wrench) for push in plan.pushes],
            "push_by_service": by_service,
        },
        "pushes": collected.pushes,
        "pushes_asked": plan.total,
        "left_out": list(collected.left_out),
        "calibration": {"shift": _or_none(collected.shift), "holds": collected.holds},
        "messages": messages,
        "warnings": list(collected.warnings),
    }


def _or_none(values: Array) -> list[float] | None:
    """JSON has no NaN."""
    return numbers(values) if np.all(np.isfinite(values)) else None
