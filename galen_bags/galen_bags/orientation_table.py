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

Values are apart by commas, semicolons, tabs or blanks, quoted or not, with decimal points; a line
that starts with # is a comment.
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from galen_model.arm import GRAVITY_M_S2, WRENCH_AXES
from galen_model.arrays import Array
from galen_model.errors import GalenError
from galen_model.kinematics import sensor_rotation
from galen_model.rotation import quaternion_to_matrix

ORIENTATIONS = {
    "gravity": ("gx", "gy", "gz"),
    "matrix": tuple(f"r{row}{column}" for row in (1, 2, 3) for column in (1, 2, 3)),
    "quaternion": ("qx", "qy", "qz", "qw"),
    "joints": ("roll", "tilt"),
}
"""Ways to give an orientation; where a table has several, the first of these is used."""

_ROTATION_TOLERANCE = 1e-2
_GRAVITY_TOLERANCE = 0.02


class TableError(GalenError):
    """A table that can't be read; the message names the file and the line or column."""


@dataclass(frozen=True)
class OrientationTable:
    """Readings with orientations.

    gravity: (n, 3) in the sensor's frame, m/s^2; wrench: (n, 6) N and N.m in the sensor's frame;
    time: (n,) s or None; block: (n,) of texts or None.
    """

    path: str
    gravity: Array
    wrench: Array
    time: Array | None
    block: np.ndarray | None
    orientation: str

    def __len__(self) -> int:
        """Number of readings."""
        return len(self.wrench)

    def take(self, rows: np.ndarray, block: np.ndarray | None) -> "OrientationTable":
        """The table's `rows`, with the labels `block` (for those rows)."""
        time = None if self.time is None else self.time[rows]
        return OrientationTable(
            self.path, self.gravity[rows], self.wrench[rows], time, block, self.orientation
        )


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
    text = _read(path, columns)
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
    return OrientationTable(str(text.path), gravity, wrench, text.numbers.get("t"), block, kind)


def read_wrenches(
    path: str | os.PathLike[str], columns: Sequence[str] | None = None
) -> tuple[Array, Array]:
    """Times (n,) as the file has them and wrenches (n, 6) of a table of t, fx ... tz.

    Raises TableError naming the file and what is wrong in it.
    """
    text = _read(path, columns)
    return _time(text), _wrench(text)


def read_orientations(
    path: str | os.PathLike[str], columns: Sequence[str] | None = None
) -> tuple[Array, Array]:
    """Times (n,) as the file has them and gravity (n, 3), m/s^2, of a table without wrenches.

    Raises TableError naming the file and what is wrong in it.
    """
    text = _read(path, columns)
    return _time(text), _orientation(text)[0]


@dataclass(frozen=True)
class _Text:
    """A file's columns: cells as they are, the numbers of those that the suite knows."""

    path: Path
    names: list[str]
    rows: list[list[str]]
    lines: list[int]
    numbers: dict[str, Array]


def _read(path: str | os.PathLike[str], columns: Sequence[str] | None) -> _Text:
    path = Path(path)
    names, rows, lines = _rows(path, columns)
    return _Text(path, names, rows, lines, _numbers(path, names, rows, lines))


def _wrench(text: _Text) -> Array:
    for axis in WRENCH_AXES:
        _require(text, axis)
    return np.column_stack([text.numbers[axis] for axis in WRENCH_AXES])


def _time(text: _Text) -> Array:
    _require(text, "t")
    return text.numbers["t"]


def _require(text: _Text, name: str) -> None:
    if name not in text.names:
        raise TableError(f"{text.path}: no column {name!r}; there are {', '.join(text.names)}")


def _rows(
    path: Path, columns: Sequence[str] | None
) -> tuple[list[str], list[list[str]], list[int]]:
    """Column names, cells and line numbers."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise TableError(f"{path}: can't be read: {error}") from error
    names = [name.strip() for name in columns] if columns else None
    rows: list[list[str]] = []
    lines: list[int] = []
    for number, line in enumerate(text.splitlines(), start=1):
        line = line.strip()
        if not line or line.startswith("#"):
            continue
        cells = _split(line)
        if names is None:
            names = cells
            if any(_is_number(cell) for cell in cells):
                raise TableError(f"{path}: line {number} names no columns; name them on the call")
            continue
        if len(cells) != len(names):
            raise TableError(
                f"{path}: line {number} has {len(cells)} values; there are {len(names)} columns"
            )
        rows.append(cells)
        lines.append(number)
    if names is None or not rows:
        raise TableError(f"{path}: no readings in it")
    doubles = sorted({name for name in names if names.count(name) > 1 and name != "-"})
    if doubles:
        raise TableError(f"{path}: column {doubles[0]!r} is there twice")
    return names, rows, lines


def _split(line: str) -> list[str]:
    # The comma last: beside another separator it is a decimal comma, and the error names the cell.
    for separator in (";", "\t", ","):
        if separator in line:
            return [cell.strip().strip('"') for cell in line.split(separator)]
    return line.split()


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _numbers(
    path: Path, names: list[str], rows: list[list[str]], lines: list[int]
) -> dict[str, Array]:
    """The columns that the suite knows, as numbers; others may hold anything."""
    known = {"t", *WRENCH_AXES, *(name for needed in ORIENTATIONS.values() for name in needed)}
    numbers: dict[str, Array] = {}
    for index, name in enumerate(names):
        if name not in known:
            continue
        column = np.empty(len(rows))
        for row, (cells, line) in enumerate(zip(rows, lines, strict=True)):
            if not _is_number(cells[index]) or not np.isfinite(float(cells[index])):
                raise TableError(
                    f"{path}: line {line}, column {name!r}: {cells[index]!r} is not a finite number"
                )
            column[row] = float(cells[index])
        numbers[name] = column
    return numbers


def _orientation(text: _Text) -> tuple[Array, Array | None, str]:
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
