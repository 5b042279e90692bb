"""What the watch on a tool's file says: state, reason, and a sentence for a person."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np
from galen_model.arm.galen import WRENCH_AXES
from galen_model.arrays import Array
from galen_model.files.calibration_file import CalibrationFile

from galen_gravcomp.calibration_monitor.evidence import Explanation, Judgement
from galen_gravcomp.evaluate.residual_decomposition import Limits


class Misfit(Enum):
    """The likeliest reason for which a file does not fit."""

    WRONG_TOOL = "wrong_tool"
    NO_TOOL = "no_tool_on"
    DRIFT = "drift"
    LOOSE_TOOL = "loose_tool"
    CONTACT = "collision"
    UNKNOWN = "unknown"


class FitNotice(Enum):
    """What the watch can say."""

    NOT_JUDGED = "not_judged"
    FITS = "fits"
    DOES_NOT_FIT = "does_not_fit"


@dataclass(frozen=True)
class FitState:
    """What the watch says now: reason and a sentence where the file does not fit.

    stops: how many stops that rests on, touched ones left out.
    """

    notice: FitNotice
    reason: Misfit | None = None
    sentence: str = ""
    stops: int = 0
    log_odds: float = 0.0


def misfit(judgement: Judgement, tool: CalibrationFile, limits: Limits, pulled: bool) -> FitState:
    """What a judgement says; pulled: a cable's pull may look like that, too."""
    what = judgement.explanation
    size = _worst(judgement.beyond, limits)
    if what is Explanation.LOAD:
        reason, why = _load(judgement, tool)
    elif what is Explanation.DRIFT:
        reason = Misfit.DRIFT
        why = (
            f"the sensor's zero is off by ({_forces(judgement.offset)}) N,"
            f" ({_torques(judgement.offset)}) mN.m: drift, or zeroed elsewhere; tare with nobody"
            " at the tool"
        )
    elif what is Explanation.LOOSE:
        reason = Misfit.LOOSE_TOOL
        why = (
            f"its centre shifts with gravity by {1e3 * abs(judgement.shift_m):.1f} mm: is the tool"
            " loose? Fasten it, then recalibrate"
        )
    else:
        reason = Misfit.UNKNOWN
        why = (
            "it changes from pose to pose as no load, drift or loose tool does: a cable, wrong"
            " angles, or something touches the tool; look, then recalibrate"
        )
    if pulled and what is not Explanation.UNKNOWN:
        why += "; or a cable that pulls, which looks the same at these poses"
    stops = int(np.count_nonzero(~judgement.touched))
    plural = "" if stops == 1 else "s"
    sentence = f"its file does not fit, {size} too much at {stops} stop{plural}: {why}"
    return FitState(FitNotice.DOES_NOT_FIT, reason, sentence, stops, judgement.log_odds)


def contact(mean: Array, lasts_s: float, log_odds: float) -> FitState:
    """A lone stop's wrench (6,) that is neither a load nor a hand's, for `lasts_s` s."""
    sentence = (
        f"{np.linalg.norm(mean[:3]):.2f} N and {1e3 * np.linalg.norm(mean[3:]):.0f} mN.m for"
        f" {lasts_s:.0f} s without a tremble, and not along gravity: a collision, or something"
        " leans on the tool? Free it"
    )
    return FitState(FitNotice.DOES_NOT_FIT, Misfit.CONTACT, sentence, 1, log_odds)


def _load(judgement: Judgement, tool: CalibrationFile) -> tuple[Misfit, str]:
    more = float(judgement.load[0])
    mass = float(tool.load.mass_kg) + more
    text = f"{1e3 * more:+.0f} +- {1e3 * judgement.load_std[0]:.0f} g"
    if abs(mass) < max(3.0 * float(judgement.load_std[0]), 0.1 * float(tool.load.mass_kg)):
        return Misfit.NO_TOOL, f"{text}: the tool is not on; put it on, or choose no tool"
    if mass > 0.0:
        moved = (tool.load.mass_kg * tool.load.com_m + judgement.load[1:]) / mass - tool.load.com_m
        centre = ", ".join(f"{1e3 * value:+.0f}" for value in moved)
        text += f", centre by ({centre}) mm"
    return Misfit.WRONG_TOOL, f"another load, {text}: another tool? Choose it, or recalibrate"


def _worst(values: Array, limits: Limits) -> str:
    axis = int(np.argmax(values / limits.axes))
    value = f"{values[axis]:.2f} N" if axis < 3 else f"{1e3 * values[axis]:.1f} mN.m"
    return f"{value} in {WRENCH_AXES[axis]}"


def _forces(wrench: Array) -> str:
    return ", ".join(f"{value:+.2f}" for value in wrench[:3])


def _torques(wrench: Array) -> str:
    return ", ".join(f"{1e3 * value:+.1f}" for value in wrench[3:])
