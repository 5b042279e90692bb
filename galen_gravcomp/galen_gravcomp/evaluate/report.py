# SPDX-License-Identifier: Apache-2.0
"""The one form of a result: plain numbers for JSON, lines and tables for a terminal."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from galen_model.arm.galen import WRENCH_AXES
from galen_model.arrays import Array
from rich.console import Console
from rich.table import Table

UNITS = ("mN", "mN", "mN", "mN.m", "mN.m", "mN.m")


@dataclass(frozen=True)
class Report:
    """An evaluation's result.

    content: plain numbers, texts and lists, SI units, None where unknown; shown: lines (with
    markup) and tables; plot: writes the picture into a directory and returns its path.
    """

    content: dict[str, Any]
    shown: list[str | Table]
    plot: Callable[[Path], Path] | None = None

    def print(self, console: Console) -> None:
        """Print lines and tables to a terminal.

        Args:
            console: console to print to.

        """
        for item in self.shown:
            console.print(item, soft_wrap=isinstance(item, str), highlight=False)


def table(title: str, names: Iterable[str]) -> Table:
    """Make a table; its first column is aligned left, the others right.

    Args:
        title: line above the table.
        names: the columns' headings.

    Returns:
        The table, without rows.

    """
    made = Table(title=title, title_justify="left")
    for number, name in enumerate(names):
        made.add_column(name, justify="right" if number else "left", overflow="fold")
    return made


def axes_table(title: str, first: str = "", others: Iterable[str] = ()) -> Table:
    """Make a table whose last columns are the wrench axes, mN and mN.m; see `axis_cells`.

    Args:
        title: line above the table.
        first: heading of the first column.
        others: headings of the columns between.

    Returns:
        The table, without rows.

    """
    heads = (f"{axis} ({unit})" for axis, unit in zip(WRENCH_AXES, UNITS, strict=True))
    return table(title, (first, *others, *heads))


def axis_cells(values: Array | Mapping[str, float] | None, digits: int = 2) -> list[str]:
    """Format six values as mN and mN.m.

    Args:
        values: (6,) N and N.m, or by axis in their order; None: not known.
        digits: decimals.

    Returns:
        Six texts; a dash where a value is not finite.

    """
    if values is None:
        return ["-"] * len(WRENCH_AXES)
    six = values.values() if isinstance(values, Mapping) else values
    return [f"{1e3 * value:.{digits}f}" if np.isfinite(value) else "-" for value in six]


def by_axis(values: Array | None) -> dict[str, Any] | None:
    """Name six values by axis.

    Args:
        values: (6,), or None.

    Returns:
        Values by axis; None where they are not all finite.

    """
    if values is None or not np.all(np.isfinite(values)):
        return None
    return dict(zip(WRENCH_AXES, np.asarray(values).tolist(), strict=True))


def number_or_none(value: float) -> float | None:
    """Return a finite number, None for any other.

    Args:
        value: any number, NaN and infinity as well.

    Returns:
        The number, or None.

    """
    return float(value) if np.isfinite(value) else None
