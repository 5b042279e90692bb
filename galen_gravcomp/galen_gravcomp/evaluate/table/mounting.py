"""Sensor and mounting from a table of readings with orientations, beside the other models."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from galen_bags.arrays.orientation_table import OrientationTable
from galen_model.arrays import Array
from galen_model.errors import GalenError
from galen_model.files.calibration_file import CalibrationFile
from galen_model.load.mounting.held_out import GALEN, MOUNTED, PLAIN, Worth, compare
from galen_model.load.mounting.identification import (
    KnownLoad,
    MountedLoad,
    identify_single_load_mounted,
)

from galen_gravcomp.evaluate.table.cross_validation import Predictor, Score


@dataclass(frozen=True)
class TableMounting:
    """Groups (`galen_model.load.mounting.groups`) to estimate beside the load; what is known."""

    groups: tuple[str, ...]
    known: KnownLoad | None = None

    def identify(self, table: OrientationTable) -> MountedLoad:
        """From all of a table's readings; raises IdentificationError."""
        return identify_single_load_mounted(
            table.gravity, table.wrench, self.groups, table.rotation, self.known
        )

    def model(self, known: OrientationTable) -> Predictor:
        """A model for `cross_validation`; raises IdentificationError."""
        found = self.identify(known)
        return lambda asked: found.predict(asked.gravity, asked.rotation)


def table_worth(scores: dict[str, Score], groups: np.ndarray, sigma: Array) -> Worth | None:
    """Whether the mounting pays on the held-out `groups` (n,); None where a group has no score."""
    chosen = {name: scores[name] for name in (PLAIN, GALEN, MOUNTED)}
    if any(score.rejected for score in chosen.values()):
        return None
    labels = list(dict.fromkeys(groups.tolist()))
    return compare(
        {name: [of.residuals[groups == label] for label in labels] for name, of in chosen.items()},
        sigma,
    )


def table_prediction(tool: CalibrationFile, table: OrientationTable) -> Array:
    """Reading (n, 6) that a tool's file expects at a table's orientations, its mounting included.

    Raises GalenError where the file's mounting needs what the table doesn't tell.
    """
    mounting = tool.mounting
    if mounting is None:
        return tool.predict_under(table.gravity)
    if np.any(mounting.joint_zero_rad):
        raise GalenError(f"{table.path}: {tool.tool} holds zeros of joints; a table has none")
    if not np.any(mounting.base_inclination_rad):
        return tool.predict_under(table.gravity)
    if table.rotation is None:
        raise GalenError(
            f"{table.path}: {tool.tool} holds an inclination of the base, which needs qx..qw,"
            " r11..r33 or roll, tilt"
        )
    return tool.predict_under(mounting.turned_gravity(table.gravity, table.rotation))
