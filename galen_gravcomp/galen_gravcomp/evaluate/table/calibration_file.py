"""A tool's file from a load that was fitted to a table: what is told, and what is not."""

from __future__ import annotations

from datetime import UTC, datetime

import numpy as np
from galen_bags.arrays.orientation_table import OrientationTable
from galen_model.arm.galen import GRAVITY_M_S2
from galen_model.files.calibration_file import CalibrationFile, LoadEstimate
from galen_model.load.identification import SingleLoad
from galen_model.load.mounting.identification import MountedLoad

_UNRESOLVED = (
    "how much of the load is the adapter: all that hangs on the sensor is written as the tool, and"
    " the adapter as nothing; the compensation is not affected",
    "where and with what on it the sensor was zeroed: residual_offset holds the whole constant part"
    " of the reading",
    "the tip: written as (0, 0, 0)",
)


def tool_from_table(
    name: str, table: OrientationTable, fit: SingleLoad, mounted: MountedLoad | None = None
) -> CalibrationFile:
    """The tool's file of one load and six constants found by `identify_single_load` on `table`.

    Its reading under any gravity is `fit.predict`'s or, where `mounted` is given, whose load then
    holds, `mounted.predict`'s. Gravity is as large as in the table, since the mass was found with
    that. `unresolved` lists what is not identifiable from readings with one load.
    """
    predicted = fit.predict(table.gravity)
    if mounted is not None:
        fit, predicted = mounted.single, mounted.predict(table.gravity, table.rotation)
    residuals = (table.wrench - predicted)[fit.used]
    gravity = GRAVITY_M_S2.copy()
    if table.orientation == "gravity":
        gravity[2] = -np.mean(np.linalg.norm(table.gravity, axis=1))
    return CalibrationFile(
        tool=name,
        load=fit.load,
        adapter=LoadEstimate(0.0, np.zeros(3), np.zeros((4, 4))),
        tip_m=np.zeros(3),
        rmse=np.sqrt(np.mean(residuals**2, axis=0)),
        poses_used=int(np.sum(fit.used)),
        calibrated_at=datetime.now(UTC).isoformat(timespec="seconds"),
        residual_offset=fit.offset,
        poses_rejected=tuple(
            f"reading {row + 1}: off the common load" for row in np.flatnonzero(~fit.used)
        ),
        zeroing=None,
        gravity_m_s2=gravity,
        unresolved=_UNRESOLVED,
        mounting=None if mounted is None else mounted.mounting,
    )
