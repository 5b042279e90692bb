"""Tables of readings in text files: columns by their names, numbers checked, lines told.

Values are apart by commas, semicolons, tabs or blanks, quoted or not, with decimal points; a line
that starts with # is a comment. The columns are named in the first line or by the caller.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from galen_model.arrays import Array
from galen_model.errors import GalenError

_MOST_BYTES = 1 << 30
# No reading, stamp or gain is larger, in whatever units; products of such numbers are finite.
_LARGEST = 1e30


class TableError(GalenError):
    """A table that can't be read; the message names the file and the line or column."""


@dataclass(frozen=True)
class TextTable:
    """A file's columns: cells as they are, the numbers (n,) of those that were asked for.

    lines: of each row, its line in the file.
    """

    path: Path
    names: list[str]
    rows: list[list[str]]
    lines: list[int]
    numbers: dict[str, Array]

    def require(self, name: str) -> Array:
        """Return the numbers (n,) of a column; raises TableError that names those there are."""
        if name not in self.names:
            raise TableError(f"{self.path}: no column {name!r}; there are {', '.join(self.names)}")
        return self.numbers[name]


def read_text_table(
    path: str | os.PathLike[str], known: Collection[str], columns: Sequence[str] | None = None
) -> TextTable:
    """Read a table; the columns `known` must hold finite numbers where they are there.

    `columns` names the columns of a file without a first line of names, "-" for one to skip.
    Raises TableError naming the file and what is wrong in it.
    """
    path = Path(path)
    names, rows, lines = _rows(path, columns)
    return TextTable(path, names, rows, lines, _numbers(path, names, rows, lines, known))


def _rows(
    path: Path, columns: Sequence[str] | None
) -> tuple[list[str], list[list[str]], list[int]]:
    """Column names, cells and line numbers."""
    try:
        with path.open("rb") as stream:
            raw = stream.read(_MOST_BYTES + 1)
        text = raw[:_MOST_BYTES].decode("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise TableError(f"{path}: can't be read: {error}") from error
    if len(raw) > _MOST_BYTES:
        raise TableError(f"{path}: larger than {_MOST_BYTES} bytes, not a table of readings")
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
    doubles = sorted(name for name, count in Counter(names).items() if count > 1 and name != "-")
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
    path: Path,
    names: list[str],
    rows: list[list[str]],
    lines: list[int],
    known: Collection[str],
) -> dict[str, Array]:
    """Return the known columns as numbers; others may hold anything."""
    numbers: dict[str, Array] = {}
    for index, name in enumerate(names):
        if name not in known:
            continue
        column = np.empty(len(rows))
        for row, (cells, line) in enumerate(zip(rows, lines, strict=True)):
            # NaN fails the comparison.
            if not _is_number(cells[index]) or not abs(float(cells[index])) <= _LARGEST:
                raise TableError(
                    f"{path}: line {line}, column {name!r}: {cells[index]!r:.80} is not a finite"
                    f" number up to {_LARGEST:g}"
                )
            column[row] = float(cells[index])
        numbers[name] = column
    return numbers
