"""A picture's file, written whole or not at all."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_DPI = 110


def save_figure(figure: Figure, path: Path) -> Path:
    """Write a PNG in one step, making its folder, and close the figure; returns the path.

    Raises OSError; an old picture is then untouched.
    """
    from matplotlib import pyplot as plt  # slow to import, and there already where a figure is

    unfinished = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(unfinished, dpi=_DPI, format="png")
        os.replace(unfinished, path)
    finally:
        plt.close(figure)
        if unfinished.exists():  # not where a file stands in the folder's place
            unfinished.unlink()
    return path
