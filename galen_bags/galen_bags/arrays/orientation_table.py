"""Tables of readings with orientations, from text files.

A row is one reading. Columns, in any order, named in the first line or by the caller:

    fx fy fz tx ty tz       wrench, N and N.m
    and one of
    qx qy qz qw             orientation of the sensor in the base, unit quaternion
    r11 r12 ... r33         R_base_sensor, row by row
    gx gy gz                gravity in the sensor's frame, m/s^2 (or in g: lengths 0.9 to 1.1)
    roll tilt               the Galen's joints, rad
    and, where there are,
    t                       time, s
    block                   a label; rows of one label are held out together

Values are apart, and comments marked, as `galen_bags.arrays.text_table` says.
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from galen_model.arm.galen import GRAVITY_M_S2, WRENCH_AXES
from galen_model.arm.kinematics import sensor_rotation
from galen_model.arrays import Array
from galen_model.errors import GalenError
from galen_model.rest.segments import DirectionRest, rest_by_direction
from galen_model.rotation import quaternion_to_matrix

from galen_bags.arrays.text_table import TableError, TextTable, read_text_table

ORIENTATIONS = {
    "gravity": ("gx", "gy", "gz"),
    "matrix": tuple(f"r{row}{column}" for row in (1, 2, 3) for column in (1, 2, 3)),
    "quaternion": ("qx", "qy", "qz", "qw"),
    "joints": ("roll", "tilt"),
}
"""Ways to give an orientation; where a table has several, the first of these is used."""

_KNOWN = {"t", *WRENCH_AXES, *(name for needed in ORIENTATIONS.values() for name in needed)}
_ROTATION_TOLERANCE = 1e-2
_GRAVITY_TOLERANCE = 0.02


@dataclass(frozen=True)
class OrientationTable:
    """Readings with orientations.

    gravity: (n, 3) in the sensor's frame, m/s^2; wrench: (n, 6) N and N.m in the sensor's frame;
    time: (n,) s or None; block: (n,) of texts or None; rotation: R_base_sensor (n, 3, 3), or None
    where the table tells gravity alone.
    """

    path: str
    gravity: Array
    wrench: Array
    time: Array | None
    block: np.ndarray | None
    orientation: str
    rotation: Array | None = None

    def __len__(self) -> int:
        """Return the number of readings."""
        return len(self.wrench)

    def take(self, rows: np.ndarray, block: np.ndarray | None) -> "OrientationTable":
        """Return the table's `rows`, with the labels `block` (for those rows)."""
        time = None if self.time is None else self.time[rows]
        rotation = None if self.rotation is None else self.rotation[rows]
        return OrientationTable(
            self.path,
            self.gravity[rows],
            self.wrench[rows],
            time,
            block,
            self.orientation,
            rotation,
        )

    def timed(self) -> "OrientationTable":
        """Return the table with its readings' order for a time where it has none."""
        return self if self.time is not None else replace(self, time=np.arange(float(len(self))))


def read_table(
    path: str | os.PathLike[str],
    columns: Sequence[str] | None = None,
    wrench_frame: str = "sensor",
) -> OrientationTable:
    """Read a table; `columns` names the columns of a file without a first line of names.

    wrench_frame: "sensor", or "base" when the file's wrenches were turned into the base's axes
    (still about the sensor's origin); they are turned back with the orientation.

    Raises TableError naming the file and what is wrong in it.
    """
    text = read_text_table(path, _KNOWN, columns)
    wrench = _wrench(text)
    gravity, rotation, kind = _orientation(text)
    if wrench_frame == "base":
        if rotation is None:
            raise TableError(
                f"{text.path}: wrenches in the base need qx..qw, r11..r33 or roll, tilt"
            )
        turned = [np.einsum("nji,nj->ni", rotation, part) for part in np.split(wrench, 2, axis=1)]
        wrench = np.concatenate(turned, axis=1)
    elif wrench_frame != "sensor":
        raise TableError(f"wrench frame {wrench_frame!r}: expected 'sensor' or 'base'")
    block = None
    if "block" in text.names:
        at = text.names.index("block")
        block = np.array([row[at].strip() for row in text.rows])
    time = text.numbers.get("t")
    return OrientationTable(str(text.path), gravity, wrench, time, block, kind, rotation)


def read_wrenches(
    path: str | os.PathLike[str], columns: Sequence[str] | None = None
) -> tuple[Array, Array]:
    """Return times (n,) as the file has them and wrenches (n, 6) of a table of t, fx ... tz.

    Raises TableError naming the file and what is wrong in it.
    """
    text = read_text_table(path, _KNOWN, columns)
    return _time(text), _wrench(text)


def read_orientations(
    path: str | os.PathLike[str], columns: Sequence[str] | None = None
) -> tuple[Array, Array]:
    """Read times (n,) as the file has them and gravity (n, 3), m/s^2, of a table without wrenches.

    Raises TableError naming the file and what is wrong in it.
    """
    text = read_text_table(path, _KNOWN, columns)
    return _time(text), _orientation(text)[0]


def read_rotations(
    path: str | os.PathLike[str], columns: Sequence[str] | None = None
) -> Array | None:
    """R_base_sensor (n, 3, 3) of a table with orientations; None where it tells gravity alone.

    Raises TableError naming the file and what is wrong in it.
    """
    return _orientation(read_text_table(path, _KNOWN, columns))[1]


def average_still(
    table: OrientationTable, window_s: float, settings: DirectionRest
) -> tuple[OrientationTable, Array]:
    """Averages of `window_s` within each still phase of a recording, and their scatter (6,).

    Each phase becomes a block of its own. Raises GalenError when the table has no increasing time
    or no still phase.
    """
    if table.time is None:
        raise GalenError(f"{table.path}: finding still phases needs a column t (s)")
    steps = np.diff(table.time)
    if np.any(steps <= 0.0):
        row = int(np.argmax(steps <= 0.0)) + 1
        raise GalenError(
            f"{table.path}: time does not increase at reading {row + 1} "
            f"({table.time[row - 1]:.6f} s, then {table.time[row]:.6f} s)"
        )
    means: list[tuple[Array, Array, float, str]] = []
    rotations = []
    variances = []
    for number, phase in enumerate(rest_by_direction(table.time, table.gravity, settings)):
        time = table.time[phase]
        window = np.floor((time - time[0]) / window_s).astype(int)
        whole = [w for w in np.unique(window) if time[window == w][-1] - time[0] >= w * window_s]
        in_phase = []
        for index in whole:
            rows = np.arange(phase.start, phase.stop)[window == index]
            wrench = table.wrench[rows].mean(axis=0)
            in_phase.append(wrench)
            means.append(
                (table.gravity[rows].mean(axis=0), wrench, float(table.time[rows].mean()),
                 f"still phase {number + 1}")
            )  # fmt: skip
            if table.rotation is not None:  # still: as good as equal, like gravity
                rotations.append(table.rotation[rows].mean(axis=0))
        if len(in_phase) > 1:
            variances.append(np.var(in_phase, axis=0, ddof=1))
    if not means:
        raise GalenError(f"{table.path}: no still phase of {settings.min_duration_s} s in it")
    gravity, wrench, time_of, label = zip(*means, strict=True)
    averaged = OrientationTable(
        table.path, np.array(gravity), np.array(wrench), np.array(time_of), np.array(label),
        table.orientation, np.array(rotations) if rotations else None,
    )  # fmt: skip
    scatter = np.sqrt(np.mean(variances, axis=0)) if variances else np.full(6, np.nan)
    return averaged, scatter


def _wrench(text: TextTable) -> Array:
    for axis in WRENCH_AXES:
        text.require(axis)
    return np.column_stack([text.numbers[axis] for axis in WRENCH_AXES])


def _time(text: TextTable) -> Array:
    text.require("t")
    return text.numbers["t"]


def _orientation(text: TextTable) -> tuple[Array, Array | None, str]:
    """Gravity (n, 3), R_base_sensor (n, 3, 3) where the table tells it, and which columns told."""
    path, numbers, lines = text.path, text.numbers, text.lines
    kinds = [kind for kind, needed in ORIENTATIONS.items() if set(needed) <= set(text.names)]
    if not kinds:
        ways = "; ".join(" ".join(needed) for needed in ORIENTATIONS.values())
        raise TableError(f"{path}: no orientation; give the columns of one of: {ways}")
    rotations = {kind: _rotation(path, numbers, kind, lines) for kind in kinds if kind != "gravity"}
    rotation = next(iter(rotations.values()), None)
    if "gravity" not in kinds:
        assert rotation is not None
        return np.einsum("nji,j->ni", rotation, GRAVITY_M_S2), rotation, kinds[0]
    gravity = np.column_stack([numbers[name] for name in ORIENTATIONS["gravity"]])
    size = np.linalg.norm(gravity, axis=1)
    if np.all(np.abs(size - 1.0) < 0.1):
        gravity, size = gravity * -GRAVITY_M_S2[2], size * -GRAVITY_M_S2[2]
    off = np.abs(size / -GRAVITY_M_S2[2] - 1.0) > _GRAVITY_TOLERANCE
    if np.any(off):
        row = int(np.argmax(off))
        raise TableError(
            f"{path}: line {lines[row]}: gx gy gz has the length {size[row]:.4g}; expected about "
            "9.8 m/s^2 (or 1, in g)"
        )
    return gravity, rotation, kinds[0]


def _rotation(path: Path, numbers: dict[str, Array], kind: str, lines: list[int]) -> Array:
    cells = np.column_stack([numbers[name] for name in ORIENTATIONS[kind]])
    if kind == "joints":
        return sensor_rotation(cells[:, 0], cells[:, 1])
    if kind == "quaternion":
        bad = np.abs(np.linalg.norm(cells, axis=1) - 1.0) > _ROTATION_TOLERANCE
        what = "qx qy qz qw is not a unit quaternion"
    else:
        matrices = cells.reshape(-1, 3, 3)
        products = np.einsum("nij,nkj->nik", matrices, matrices)
        bad = np.abs(products - np.eye(3)).max(axis=(1, 2)) > _ROTATION_TOLERANCE
        bad |= np.linalg.det(matrices) < 0.0
        what = "r11 ... r33 is not a rotation"
    if np.any(bad):
        raise TableError(f"{path}: line {lines[int(np.argmax(bad))]}: {what}")
    return quaternion_to_matrix(cells) if kind == "quaternion" else cells.reshape(-1, 3, 3)
