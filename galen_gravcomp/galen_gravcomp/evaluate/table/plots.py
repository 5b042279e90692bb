"""The picture of an evaluation of a table: residuals of readings held out, axis by axis."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import matplotlib

matplotlib.use("Agg")  # a lab's machine over ssh has no display
import matplotlib.pyplot as plt
from galen_model.arm.galen import WRENCH_AXES
from galen_model.files.figure_file import save_figure

if TYPE_CHECKING:
    from galen_gravcomp.evaluate.table.evaluation import Evaluation

_COLOURS = ("#c44e52", "#1f6f8b", "#55a868", "#8172b3", "#dd8452", "#8c8c8c")


def plot_scores(result: Evaluation, directory: Path) -> Path:
    """Write `<table's name>_residuals.png` into `directory`; returns its path."""
    split, models = next(iter(result.scores.items()))
    figure, axes = plt.subplots(2, 3, figsize=(12, 6), sharex=True)
    for index, axis in enumerate(axes.flat):
        for colour, (name, score) in zip(_COLOURS, models.items(), strict=False):
            values = score.residuals[:, index] * 1e3
            axis.plot(values, "o-", color=colour, ms=3, lw=0.8, label=name)
        unit = "mN" if index < 3 else "mN.m"
        rms = ", ".join(f"{score.rmse[index] * 1e3:.1f}" for score in models.values())
        axis.axhline(0.0, color="black", lw=0.6)
        axis.set_title(f"{WRENCH_AXES[index]}: RMS {rms} {unit}", fontsize=10)
        axis.set_ylabel(unit)
        if index >= 3:
            axis.set_xlabel("reading")
    figure.suptitle(f"{Path(result.table.path).name}: left over on held-out readings ({split})")
    handles, names = axes.flat[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="lower center", ncol=len(names), frameon=False)
    figure.tight_layout(rect=(0.0, 0.04, 1.0, 1.0))
    return save_figure(figure, directory / f"{Path(result.table.path).stem}_residuals.png")
