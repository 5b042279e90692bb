# SPDX-License-Identifier: Apache-2.0
"""Tables of readings in text files: of any columns, with orientations, of one run in motion.

Values are apart by commas, semicolons (then decimal commas may be), tabs or blanks, quoted or not;
a line that starts with # or % is a comment. Columns, in any order, are named in the first line, by
the caller, or in a comment with as many names as there are values. A name may have a unit, as in
`Fx [N]` or `roll (deg)`. Of a table with orientations a row is one reading; rows in which a value
is missing or NaN are left out and counted:

    fx fy fz tx ty tz       wrench, N and N.m
    and one of
    qx qy qz qw             orientation of the sensor in the base, unit quaternion
    roll pitch yaw          the same, R = Rz(yaw) Ry(pitch) Rx(roll), rad
    r11 r12 ... r33         R_base_sensor, row by row
    gx gy gz                gravity in the sensor's frame, m/s^2 (or in g: lengths 0.9 to 1.1)
    roll tilt               or what the arm's turning joints are called, rad
    and, where there are,
    t                       time, s
    temperature             of the sensor, deg C (or temp; temperature_k in kelvin)
    block                   a label; rows of one label are held out together
"""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import scipy  # its parts are loaded when they are used
from galen_model.arm.arm import STANDARD_GRAVITY_M_S2, Arm
from galen_model.arm.galen import GALEN, WRENCH_AXES
from galen_model.arrays import Array
from galen_model.errors import GalenError
from galen_model.rest.segments import DirectionRest, rest_by_direction
from galen_model.rotation import quaternion_to_matrix, rot_x, rot_y, rot_z
from galen_model.setup_check.readings import StillReadings

_MOST_BYTES = 1 << 30
# No reading, stamp or gain is larger, in whatever units; products of such numbers are finite.
_LARGEST = 1e30


@dataclass(frozen=True)
class TextTable:
    """A file's columns: cells as they are, the numbers (n,) of those that were asked for.

    lines: of each row, its line in the file. left_out: how many rows lacked a number.
    """

    path: Path
    names: list[str]
    rows: list[list[str]]
    lines: list[int]
    numbers: dict[str, Array]
    left_out: int = 0

    def require(self, name: str) -> Array:
        """Return the numbers of a column.

        Args:
            name: the column's; one of those that were `known` when the table was read.

        Returns:
            Numbers (n,), one a row, in the unit of `read_text_table`.

        Raises:
            GalenError: the table has no such column; it names those there are.

        """
        if name not in self.names:
            raise GalenError(f"{self.path}: no column {name!r}; there are {', '.join(self.names)}")
        return self.numbers[name]


def read_text_table(
    path: str | os.PathLike[str],
    known: Collection[str],
    columns: Sequence[str] | None = None,
    *,
    leave_out: bool = False,
    units_as: Mapping[str, str] | None = None,
) -> TextTable:
    """Read a table.

    Args:
        path: text file to read.
        known: names of columns of numbers: where they are there, they must hold finite ones.
        columns: names of the columns of a file without a first line of names, "-" for one to skip;
            None: the file names them.
        leave_out: leave out, and count, rows that lack a number.
        units_as: columns whose names don't give their units, and the usual name that does.

    Returns:
        All cells as texts, and the numbers (n,) of the columns in `known`; those whose header has a
        unit in brackets are in SI units, but for temperatures and for accelerations in g.

    Raises:
        GalenError: the file can't be read or is no such table; it names file and line, or column.

    """
    path = Path(path)
    headers, rows, lines = _rows(path, columns)
    named = [_name_and_scale(path, header, known, units_as or {}) for header in headers]
    names = [name for name, _ in named]
    doubles = sorted(name for name, count in Counter(names).items() if count > 1 and name != "-")
    if doubles:
        raise GalenError(f"{path}: column {doubles[0]!r} is there twice")
    asked = [index for index, name in enumerate(names) if name in known]
    left_out = 0
    if leave_out:
        whole = [row for row, cells in enumerate(rows) if not any(_lacks(cells[k]) for k in asked)]
        if not whole:
            raise GalenError(f"{path}: every row lacks a number")
        left_out = len(rows) - len(whole)
        rows, lines = [rows[row] for row in whole], [lines[row] for row in whole]
    numbers = _numbers(path, names, rows, lines, known)
    for name, scale in named:
        if name in numbers and scale != 1.0:
            numbers[name] = numbers[name] * scale
    return TextTable(path, names, rows, lines, numbers, left_out)


_WITH_UNIT = re.compile(r"(.*?)\s*[\[(]([^\])]*)[\])]")
_NEWTON = {"n": 1.0, "mn": 1e-3, "kgf": STANDARD_GRAVITY_M_S2}
_NEWTON_METRE = {
    **dict.fromkeys(("nm", "n.m", "n·m", "n*m"), 1.0),
    **dict.fromkeys(("nmm", "n.mm", "n·mm", "n*mm", "mnm", "mn.m", "mn·m"), 1e-3),
}
_SECOND = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6}
_RADIAN = {"rad": 1.0, **dict.fromkeys(("deg", "°", "degrees"), np.pi / 180.0)}
_ACCELERATION = {"m/s2": 1.0, "m/s^2": 1.0, "g": 1.0}  # g is known by its length
_NO_UNIT = {"-": 1.0}


def _units_of(name: str) -> dict[str, float]:
    """Return the units that a column may have, and what makes its numbers SI."""
    if name in WRENCH_AXES:
        return _NEWTON if name[0] == "f" else _NEWTON_METRE
    if name == "t":
        return _SECOND
    if name in TEMPERATURES:
        return dict.fromkeys(("c", "°c", "degc", "k"), 1.0)
    if name in ("gx", "gy", "gz", "ax", "ay", "az"):
        return _ACCELERATION
    if name in (*ORIENTATIONS["quaternion"], *ORIENTATIONS["matrix"]):
        return _NO_UNIT
    return _RADIAN


_ALSO_CALLED = {"time": "t", "mx": "tx", "my": "ty", "mz": "tz"}


def _name_and_scale(
    path: Path, header: str, known: Collection[str], units_as: Mapping[str, str]
) -> tuple[str, float]:
    """Return a header's column name, and what makes its numbers SI; raises GalenError."""
    if header in known:
        return header, 1.0
    found = _WITH_UNIT.fullmatch(header)
    name, unit = (found[1], found[2].strip()) if found else (header, "")
    lower = name.strip().lower()
    name = next((one for one in (name, lower, _ALSO_CALLED.get(lower, "")) if one in known), header)
    if name not in known or not unit:
        return name, 1.0
    units = _units_of(units_as.get(name, name))
    if unit.lower() not in units:
        raise GalenError(
            f"{path}: column {header!r} has the unit {unit!r}; expected {' or '.join(units)}"
        )
    if name in TEMPERATURES:  # its name makes it deg C
        name = "temperature_k" if unit.lower() == "k" else "temperature_c"
    return name, units[unit.lower()]


def _lacks(cell: str) -> bool:
    return not cell or cell.lower() in ("nan", "na", "n/a", "null", "none")


def _rows(
    path: Path, columns: Sequence[str] | None
) -> tuple[list[str], list[list[str]], list[int]]:
    """Column names, cells and line numbers."""
    try:
        with path.open("rb") as stream:
            raw = stream.read(_MOST_BYTES + 1)
        text = raw[:_MOST_BYTES].decode("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise GalenError(f"{path}: can't be read: {error}") from error
    if len(raw) > _MOST_BYTES:
        raise GalenError(f"{path}: larger than {_MOST_BYTES} bytes, not a table of readings")
    names = [name.strip() for name in columns] if columns else None
    rows: list[list[str]] = []
    lines: list[int] = []
    comments: list[str] = []
    for number, line in enumerate(text.splitlines(), start=1):
        line = line.strip()
        if not line or line[0] in "#%":
            comments.append(line.strip("#% []"))
            continue
        cells = _split(line)
        if names is None:
            listed = [_split(comment) for comment in reversed(comments)]
            if all(_is_number(cell) for cell in cells):
                names = next((one for one in listed if len(one) == len(cells)), None)
        if names is None:
            names = cells
            if any(_is_number(cell) for cell in cells):
                raise GalenError(f"{path}: line {number} names no columns; name them on the call")
            continue
        if len(cells) != len(names):
            raise GalenError(
                f"{path}: line {number} has {len(cells)} values; there are {len(names)} columns"
            )
        rows.append(cells)
        lines.append(number)
    if names is None or not rows:
        raise GalenError(f"{path}: no readings in it")
    return names, rows, lines


def _split(line: str) -> list[str]:
    # The comma last: beside another separator it is a decimal comma.
    for separator in (";", "\t", ","):
        if separator in line:
            cells = [cell.strip().strip('"') for cell in line.split(separator)]
            return cells if separator == "," else [_decimal(cell) for cell in cells]
    return line.split()


def _decimal(cell: str) -> str:
    """Return a number's cell with a decimal point."""
    return point if _is_number(point := cell.replace(",", ".", 1)) else cell


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _numbers(
    path: Path,
    names: list[str],
    rows: list[list[str]],
    lines: list[int],
    known: Collection[str],
) -> dict[str, Array]:
    numbers: dict[str, Array] = {}
    for index, name in enumerate(names):
        if name not in known:
            continue
        column = np.empty(len(rows))
        for row, (cells, line) in enumerate(zip(rows, lines, strict=True)):
            # NaN fails the comparison.
            if not _is_number(cells[index]) or not abs(float(cells[index])) <= _LARGEST:
                raise GalenError(
                    f"{path}: line {line}, column {name!r}: {cells[index]!r:.80} is not a finite"
                    f" number up to {_LARGEST:g}"
                )
            column[row] = float(cells[index])
        numbers[name] = column
    return numbers


# Orientations

ORIENTATIONS = {
    "gravity": ("gx", "gy", "gz"),
    "matrix": tuple(f"r{row}{column}" for row in (1, 2, 3) for column in (1, 2, 3)),
    "quaternion": ("qx", "qy", "qz", "qw"),
    "euler angles": ("roll", "pitch", "yaw"),
}
"""Ways to give an orientation beside the arm's angles; the first that a table has is used."""

TEMPERATURES = {
    f"{name}{unit}": zero_c
    for name in ("temperature", "temp")
    for unit, zero_c in (("", 0.0), ("_c", 0.0), ("_degc", 0.0), ("_k", -273.15))
}
"""Names of a column of temperatures, and what makes its numbers deg C."""

_ROTATION_TOLERANCE = 1e-2
_MOST_CHECKED = 300
MOST_READINGS = 500
"""More are averaged where they are a recording: the time of a fit grows with the readings."""
_NEIGHBOURS_RAD = 0.02
_MOST_EULER_RAD = 2.0 * np.pi + 0.1
_GRAVITY_TOLERANCE = 0.02


@dataclass(frozen=True)
class OrientationTable:
    """Readings with orientations.

    gravity: (n, 3) in the sensor's frame, m/s^2; wrench: (n, 6) N and N.m in the sensor's frame;
    time: (n,) s or None; block: (n,) of texts or None; rotation: R_base_sensor (n, 3, 3), or None
    where the table tells gravity alone; arm: whose sensor it is; temperature_c: (n,) deg C or None;
    angles: (n, k) of the arm's turning joints, rad, or None; left_out: rows that lacked a number.
    """

    path: str
    gravity: Array
    wrench: Array
    time: Array | None
    block: np.ndarray | None
    orientation: str
    rotation: Array | None = None
    arm: Arm = field(default=GALEN, repr=False)
    temperature_c: Array | None = None
    angles: Array | None = None
    left_out: int = 0

    def __len__(self) -> int:
        """Return the number of readings."""
        return len(self.wrench)

    def take(self, rows: np.ndarray, block: np.ndarray | None) -> OrientationTable:
        """Return a table of some of the readings.

        Args:
            rows: indices or mask of readings (n,) to take.
            block: labels (one of each reading taken), or None.

        Returns:
            The readings at `rows`; `left_out` as of the whole table.

        """
        time = None if self.time is None else self.time[rows]
        rotation = None if self.rotation is None else self.rotation[rows]
        return replace(
            self,
            gravity=self.gravity[rows],
            wrench=self.wrench[rows],
            time=time,
            block=block,
            rotation=rotation,
            temperature_c=None if self.temperature_c is None else self.temperature_c[rows],
            angles=None if self.angles is None else self.angles[rows],
        )

    def timed(self) -> OrientationTable:
        """Return the table with its readings' order for a time where it has none."""
        return self if self.time is not None else replace(self, time=np.arange(float(len(self))))


def _read(path: str | os.PathLike[str], columns: Sequence[str] | None, arm: Arm) -> TextTable:
    known = {name for needed in _ways(arm).values() for name in needed}
    names = {"t", *WRENCH_AXES, *TEMPERATURES, *known}
    return read_text_table(path, names, columns, leave_out=True)


def _ways(arm: Arm) -> dict[str, tuple[str, ...]]:
    return {**ORIENTATIONS, "joints": arm.turning_names}


def read_table(
    path: str | os.PathLike[str],
    columns: Sequence[str] | None = None,
    wrench_frame: str = "sensor",
    *,
    arm: Arm,
) -> OrientationTable:
    """Read a table of wrenches with orientations.

    Args:
        path: text file to read.
        columns: names of the columns of a file without a first line of names; None: the file names
            them.
        wrench_frame: "sensor", or "base" when the file's wrenches were turned into the base's axes
            (still about the sensor's origin); they are turned back with the orientation.
        arm: whose joint angles may give the orientation, and the direction of gravity in its base.

    Returns:
        The n readings, without rows in which a value is missing.

    Raises:
        GalenError: the file can't be read or is no such table; it names what is wrong in it.

    """
    text = _read(path, columns, arm)
    wrench = _wrench(text)
    gravity, rotation, kind = _orientation(text, arm)
    if wrench_frame == "base":
        if rotation is None:
            raise GalenError(
                f"{text.path}: wrenches in the base need qx..qw, r11..r33 or"
                f" {', '.join(arm.turning_names)}"
            )
        turned = [np.einsum("nji,nj->ni", rotation, part) for part in np.split(wrench, 2, axis=1)]
        wrench = np.concatenate(turned, axis=1)
    elif wrench_frame != "sensor":
        raise GalenError(f"wrench frame {wrench_frame!r}: expected 'sensor' or 'base'")
    block = None
    if "block" in text.names:
        at = text.names.index("block")
        block = np.array([row[at].strip() for row in text.rows])
    time = text.numbers.get("t")
    temperature = [
        text.numbers[name] + zero_c for name, zero_c in TEMPERATURES.items() if name in text.numbers
    ]
    if len(temperature) > 1:
        raise GalenError(f"{text.path}: {len(temperature)} columns of temperatures; expected one")
    return OrientationTable(
        str(text.path), gravity, wrench, time, block, kind, rotation, arm,
        temperature[0] if temperature else None,
        np.column_stack([text.numbers[name] for name in arm.turning_names])
        if kind == "joints" else None,
        text.left_out,
    )  # fmt: skip


def read_wrenches(
    path: str | os.PathLike[str], columns: Sequence[str] | None = None
) -> tuple[Array, Array]:
    """Read a table of t, fx ... tz.

    Args:
        path: text file to read.
        columns: names of the columns of a file without a first line of names; None: the file names
            them.

    Returns:
        Times (n,) as the file has them, in s where the header gives the unit, and wrenches (n, 6),
        N and N.m, in the axes of the file.

    Raises:
        GalenError: the file can't be read or is no such table; it names what is wrong in it.

    """
    text = read_text_table(path, {"t", *WRENCH_AXES}, columns)
    return _time(text), _wrench(text)


def read_orientations(
    path: str | os.PathLike[str], columns: Sequence[str] | None = None, *, arm: Arm
) -> tuple[Array, Array]:
    """Read a table of orientations with t, without wrenches.

    Args:
        path: text file to read.
        columns: names of the columns of a file without a first line of names; None: the file names
            them.
        arm: whose joint angles may give the orientation, and the direction of gravity in its base.

    Returns:
        Times (n,) as the file has them, in s where the header gives the unit, and gravity (n, 3),
        m/s^2, in the sensor's frame.

    Raises:
        GalenError: the file can't be read or is no such table; it names what is wrong in it.

    """
    text = _read(path, columns, arm)
    return _time(text), _orientation(text, arm)[0]


def still_readings(table: OrientationTable) -> StillReadings:
    """Return the readings for a check of the set-up.

    Args:
        table: any number of readings.

    Returns:
        At most 300 readings; those of a recording in motion are averaged, others picked evenly.

    """
    if is_recording(table):
        table = average_runs(table, _MOST_CHECKED)
    elif len(table) > _MOST_CHECKED:
        table = table.take(np.linspace(0, len(table) - 1, _MOST_CHECKED).astype(int), None)
    return StillReadings(table.wrench, table.gravity, table.arm, table.rotation, table.angles)


def without_repeats(table: OrientationTable) -> tuple[OrientationTable, int]:
    """Leave out readings that repeat another, as a logger that holds the last value writes them.

    Args:
        table: readings; those alike in wrench and gravity to the last bit are repeats.

    Returns:
        The table, and how many readings were left out.

    """
    cells = np.hstack([table.wrench, table.gravity])
    rows = np.zeros(len(table), dtype=bool)
    rows[np.unique(cells, axis=0, return_index=True)[1]] = True
    if rows.all():
        return table, 0
    block = None if table.block is None else table.block[rows]
    return table.take(rows, block), int(np.count_nonzero(~rows))


def is_recording(table: OrientationTable) -> bool:
    """Return whether readings follow each other in a motion, and are more than a fit needs.

    Args:
        table: readings in the order in which they were taken.

    Returns:
        True for more than MOST_READINGS whose median step turns gravity by less than 0.02 rad.

    """
    if len(table) <= MOST_READINGS:
        return False
    unit = table.gravity / np.linalg.norm(table.gravity, axis=1, keepdims=True)
    step_rad = np.linalg.norm(np.diff(unit, axis=0), axis=1)
    return bool(np.median(step_rad) < _NEIGHBOURS_RAD)


def average_runs(table: OrientationTable, most: int) -> OrientationTable:
    """Average neighbours of a recording in motion.

    Args:
        table: readings in the order in which they were taken.
        most: so many readings remain, or all where there are fewer.

    Returns:
        The means of runs of neighbours, without labels; rotations are the nearest to the mean.

    """
    count = len(table)
    run = np.arange(count) * most // count
    first = np.flatnonzero(np.diff(run, prepend=-1))

    def mean(column: Array | None) -> Array | None:
        if column is None:
            return None
        length = np.diff(np.append(first, count))
        sums = np.add.reduceat(column, first, axis=0)
        return np.asarray(sums / length.reshape(-1, *[1] * (column.ndim - 1)))

    rotation = mean(table.rotation)
    if rotation is not None:  # the nearest rotation to the mean of neighbours
        left, _, right = np.linalg.svd(rotation)
        rotation = left @ right
    wrench, gravity = mean(table.wrench), mean(table.gravity)
    assert wrench is not None and gravity is not None
    return replace(
        table,
        wrench=wrench,
        gravity=gravity,
        time=mean(table.time),
        block=None,
        rotation=rotation,
        temperature_c=mean(table.temperature_c),
        angles=mean(table.angles),
    )


def average_still(
    table: OrientationTable, window_s: float, settings: DirectionRest
) -> tuple[OrientationTable, Array]:
    """Average the readings within each still phase of a recording.

    Args:
        table: a recording with times, s.
        window_s: length, s, of what is averaged into one reading.
        settings: how long and how closely gravity must keep its direction in a still phase.

    Returns:
        The averages, each phase a block of its own, and the scatter (6,), N and N.m, of those of
        one phase (root mean square over the phases; NaN where none has two).

    Raises:
        GalenError: the table has no times, they don't increase, or there is no still phase.

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
    rotations, temperatures = [], []
    variances = []
    step_s = float(np.median(steps)) if len(steps) else 0.0
    for number, phase in enumerate(rest_by_direction(table.time, table.gravity, settings)):
        time = table.time[phase]
        window = np.floor((time - time[0]) / window_s).astype(int)
        # A phase ends a step after its last reading; half a step is for stamps that jitter.
        filled = int((time[-1] - time[0] + 1.5 * step_s) / window_s)
        whole = [w for w in np.unique(window) if w < max(filled, 1)]
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
            if table.temperature_c is not None:
                temperatures.append(float(table.temperature_c[rows].mean()))
        if len(in_phase) > 1:
            variances.append(np.var(in_phase, axis=0, ddof=1))
    if not means:
        raise GalenError(f"{table.path}: no still phase of {settings.min_duration_s} s in it")
    gravity, wrench, time_of, label = zip(*means, strict=True)
    averaged = OrientationTable(
        table.path, np.array(gravity), np.array(wrench), np.array(time_of), np.array(label),
        table.orientation, np.array(rotations) if rotations else None, table.arm,
        np.array(temperatures) if temperatures else None,
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


def _orientation(text: TextTable, arm: Arm) -> tuple[Array, Array | None, str]:
    """Gravity (n, 3), R_base_sensor (n, 3, 3) where the table has it, and the columns' kind."""
    path, numbers, lines = text.path, text.numbers, text.lines
    ways = _ways(arm)
    kinds = [kind for kind, needed in ways.items() if set(needed) <= set(text.names)]
    if not kinds:
        listed = "; ".join(" ".join(needed) for needed in ways.values())
        raise GalenError(f"{path}: no orientation; give the columns of one of: {listed}")
    columns = {kind: np.column_stack([numbers[name] for name in ways[kind]]) for kind in kinds}
    rotations = [
        arm.rotation(cells) if kind == "joints" else _rotation(path, cells, kind, lines)
        for kind, cells in columns.items()
        if kind != "gravity"
    ]
    rotation = rotations[0] if rotations else None
    if "gravity" not in kinds:
        assert rotation is not None
        return np.einsum("nji,j->ni", rotation, arm.gravity_m_s2), rotation, kinds[0]
    gravity = columns["gravity"]
    size = np.linalg.norm(gravity, axis=1)
    if np.all(np.abs(size - 1.0) < 0.1):
        gravity, size = gravity * STANDARD_GRAVITY_M_S2, size * STANDARD_GRAVITY_M_S2
    off = np.abs(size / STANDARD_GRAVITY_M_S2 - 1.0) > _GRAVITY_TOLERANCE
    if np.any(off):
        row = int(np.argmax(off))
        raise GalenError(
            f"{path}: line {lines[row]}: gx gy gz has the length {size[row]:.4g}; expected about "
            "9.8 m/s^2 (or 1, in g)"
        )
    return gravity, rotation, kinds[0]


def _rotation(path: Path, cells: Array, kind: str, lines: list[int]) -> Array:
    if kind == "euler angles":
        if np.max(np.abs(cells)) > _MOST_EULER_RAD:
            raise GalenError(
                f"{path}: roll, pitch, yaw reach {np.max(np.abs(cells)):g}: are they degrees? Name"
                " the columns roll [deg], pitch [deg], yaw [deg]"
            )
        return rot_z(cells[:, 2]) @ rot_y(cells[:, 1]) @ rot_x(cells[:, 0])
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
        raise GalenError(f"{path}: line {lines[int(np.argmax(bad))]}: {what}")
    return quaternion_to_matrix(cells) if kind == "quaternion" else cells.reshape(-1, 3, 3)


# Motion

_IMU = ("ax", "ay", "az")
_REST_RAD_S = 0.01
_REST_S = 0.1
_SETTLED_S = 0.25


@dataclass(frozen=True)
class MotionTable:
    """One run: times (s, one clock more or less) and values of wrench, IMU and gravity."""

    wrench_s: Array
    wrench: Array
    imu_s: Array
    specific: Array
    gravity_s: Array
    gravity: Array


def read_motion(
    wrench_file: Path,
    imu_file: Path | None,
    orientations_file: Path,
    time_unit_s: float,
    imu_unit_m_s2: float,
    arm: Arm,
) -> MotionTable:
    """Read the tables of one run in motion.

    Args:
        wrench_file: table of t, fx ... tz.
        imu_file: table of t, ax, ay, az; None: there is no IMU, and its arrays are empty.
        orientations_file: table of t and orientations, at its own rate.
        time_unit_s: seconds a unit of the tables' times.
        imu_unit_m_s2: m/s^2 a unit of the IMU's table.
        arm: whose joint angles may give the orientation.

    Returns:
        The run, with times in s after the first wrench.

    Raises:
        GalenError: a table can't be read, or its times don't increase.

    """
    wrench_t, wrench = read_wrenches(wrench_file)
    gravity_t, gravity = read_orientations(orientations_file, arm=arm)
    imu_t, specific = np.zeros(0), np.zeros((0, 3))
    if imu_file is not None:
        imu_t = read_text_table(imu_file, {"t", *_IMU}).require("t")
        specific = read_specific(imu_file, imu_unit_m_s2)
        _check_times(imu_file, imu_t)
    _check_times(wrench_file, wrench_t)
    _check_times(orientations_file, gravity_t)
    start = wrench_t[0]
    return MotionTable(
        (wrench_t - start) * time_unit_s,
        wrench,
        (imu_t - start) * time_unit_s,
        specific,
        (gravity_t - start) * time_unit_s,
        gravity,
    )


def _check_times(path: Path, times: Array) -> None:
    late = np.flatnonzero(np.diff(times) <= 0.0)
    if len(late):
        row = int(late[0]) + 1
        raise GalenError(
            f"{path}: reading {row + 1} has t = {times[row]:.15g} after {times[row - 1]:.15g};"
            " a run's times increase"
        )


def read_specific(path: Path, unit_m_s2: float) -> Array:
    """Read the specific force of a table of ax, ay, az.

    Args:
        path: text file to read.
        unit_m_s2: m/s^2 a unit of the table.

    Returns:
        Specific force (n, 3), m/s^2, in the axes of the IMU.

    Raises:
        GalenError: the file can't be read, or lacks a column.

    """
    text = read_text_table(path, set(_IMU))
    return unit_m_s2 * np.column_stack([text.require(name) for name in _IMU])


def moving(time_s: Array, gravity: scipy.interpolate.CubicSpline) -> np.ndarray:
    """Find where gravity turns, or has or will within a quarter of a second.

    Args:
        time_s: moments (n,), s, increasing.
        gravity: gravity (3,), m/s^2, in the sensor's frame, as a function of time.

    Returns:
        (n,) bool: whether a moment at which gravity turns by over 0.01 rad/s is that near.

    """
    around = [gravity(time_s + shift) for shift in (-_REST_S / 2.0, _REST_S / 2.0)]
    change = np.linalg.norm(around[1] - around[0], axis=1) / 9.8
    turning = time_s[change > _REST_RAD_S * _REST_S]
    if not len(turning):
        return np.zeros(len(time_s), dtype=bool)
    after = np.clip(np.searchsorted(turning, time_s), 1, max(len(turning) - 1, 1))
    last = len(turning) - 1
    nearest = np.minimum(
        np.abs(turning[np.minimum(after, last)] - time_s), np.abs(turning[after - 1] - time_s)
    )
    return np.asarray(nearest < _SETTLED_S)
