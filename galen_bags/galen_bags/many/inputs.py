"""Inputs of a job over bags: the calibration file and the name of each."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from galen_model.errors import GalenError
from galen_model.files.calibration_file import CalibrationFile, read_calibration


def calibration_of_bag(bag: Path, tool: Path, *, beside: bool) -> CalibrationFile:
    """Read the calibration file that a bag was recorded with.

    Args:
        bag: the recording.
        tool: the file, or, with `beside`, its name in the bag's directory or the one above.
        beside: look for the file beside the bag.

    Raises:
        GalenError: the file is missing or invalid; the message names it.

    """
    if not beside:
        return read_calibration(tool)
    folder = bag if bag.is_dir() else bag.parent
    for place in (folder, folder.parent):
        if (place / tool.name).is_file():
            return read_calibration(place / tool.name)
    raise GalenError(f"{bag}: neither in it nor beside it is a tool's file {tool.name}")


def distinct_names(paths: Sequence[Path]) -> dict[Path, str]:
    """Name each path by its stem, with folders before it as far as they differ."""
    resolved = {path: Path(os.path.abspath(path)) for path in paths}  # noqa: PTH100 - keeps links
    depth = 1
    while True:
        names = {
            path: "_".join((*whole.parent.parts, whole.stem)[-depth:])
            for path, whole in resolved.items()
        }
        longest = max((len(whole.parts) for whole in resolved.values()), default=1)
        if len(set(names.values())) == len(names) or depth > longest:
            return names
        depth += 1
