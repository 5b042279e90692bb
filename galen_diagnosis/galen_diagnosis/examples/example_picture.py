"""The picture of a worked example: what gravity compensation leaves in the sweep's still poses."""

from __future__ import annotations

from pathlib import Path

import matplotlib

matplotlib.use("Agg")  # a lab's machine over ssh has no display
import matplotlib.pyplot as plt
import numpy as np
from galen_model.arm.galen import JOINT_NAMES, WRENCH_AXES
from galen_model.arrays import Array
from galen_model.files.atomic_file import save_figure

from galen_diagnosis.answer.result import Diagnosis
from galen_diagnosis.errors import DiagnosisError
from galen_diagnosis.observation.rows import BAGS, CHANNELS

_COLOURS = ("#0072b2", "#e69f00", "#009e73")
_TILT = JOINT_NAMES.index("tilt")


def draw_story(diagnosis: Diagnosis, over: str, title: str, path: Path) -> Path:
    """Write the picture: forces above, torques below; before on the left, after on the right.

    over: "time" (since the recording's start) or "tilt". A point is what is left of the reading of
    one still pose, less its mean over all poses, for the sensor's zero is none of a compensation's
    errors. After: with the effect that was found in the simulator. Raises DiagnosisError without a
    sweep.
    """
    poses = _poses(diagnosis)
    if not len(poses):
        raise DiagnosisError("a story's picture needs the still poses of a sweep")
    figure, grid = plt.subplots(2, 2, figsize=(10, 5.2), sharex=True, sharey="row")
    for row, (group, axes, factor, unit) in enumerate(
        (("force", slice(0, 3), 1e3, "mN"), ("torque", slice(3, 6), 1e3, "mN.m"))
    ):
        for column, (state, residual) in enumerate(
            (("before", diagnosis.before), ("after", diagnosis.after))
        ):
            axis = grid[row, column]
            for colour, channel in zip(_COLOURS, range(6)[axes], strict=True):
                where, error = _pose_means(diagnosis, residual, poses, channel, over)
                axis.plot(
                    where,
                    (error - error.mean()) * factor,
                    ".",
                    color=colour,
                    ms=5,
                    label=WRENCH_AXES[channel],
                )
            axis.axhline(0.0, color="black", lw=0.6)
            if row == 0:
                axis.set_title(f"{state}", loc="left", fontsize=10)
        grid[row, 0].set_ylabel(f"error of {group}, {unit}")
        grid[row, 0].legend(loc="best", ncol=3, frameon=False, fontsize=8)
    for axis in grid[-1]:
        axis.set_xlabel("time of the recording, s" if over == "time" else "tilt as reported, rad")
    figure.suptitle(f"Gravity compensation where {title}", fontsize=11)
    figure.tight_layout()
    return save_figure(figure, path)


def _poses(diagnosis: Diagnosis) -> np.ndarray:
    rows = diagnosis.rows
    return np.unique(rows.pose[(rows.bag == BAGS.index("sweep")) & (rows.pose >= 0)])


def _pose_means(
    diagnosis: Diagnosis, residual: Array, poses: np.ndarray, channel: int, over: str
) -> tuple[Array, Array]:
    """Time (s) or tilt (rad), and the mean residual in N or N.m, of each pose that has the axis."""
    rows = diagnosis.rows
    mine = (rows.bag == BAGS.index("sweep")) & (
        rows.channel == CHANNELS.index(WRENCH_AXES[channel])
    )
    where, error = [], []
    for pose in poses:
        here = mine & (rows.pose == pose)
        if here.any():
            value = rows.session_s if over == "time" else rows.joints[:, _TILT]
            where.append(value[here].mean())
            # A row's weight is its number of samples: scale is that of its mean.
            weight = rows.samples[here]
            error.append(np.average((residual * rows.scale)[here], weights=weight))
    return np.array(where), np.array(error)
