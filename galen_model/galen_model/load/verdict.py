# SPDX-License-Identifier: Apache-2.0
"""Verdicts on a calibration: whether it fits, why not, and what to do.

Every observation of a load ends in one of these causes, and takes its words from `MESSAGES`.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from galen_model.arm.galen import WRENCH_AXES
from galen_model.arrays import Array

TARE_COMMAND = "ros2 service call /gravcomp/tare std_srvs/srv/Trigger"


class CheckAnswer(IntEnum):
    """What to do, numbered as in CheckTool's result."""

    GOOD = 0
    RETARE = 1
    RECALIBRATE = 2
    UNSURE = 3


class Cause(IntEnum):
    """Why the readings are not what the calibration foretells.

    Up to NOISE numbered as in CheckTool's result, where FITS is NOTHING and CONTACT is TOUCHED.
    """

    FITS = 0
    OFFSET = 1
    ZERO_LOST = 2
    OTHER_TOOL = 3
    NO_TOOL = 4
    LOAD = 5
    UNEXPLAINED = 6
    CONTACT = 7
    NOISE = 8
    DRIFT = 9
    LOOSE_TOOL = 10
    CHANGED = 11
    UNKNOWN = 12

    @property
    def word(self) -> str:
        """The cause in files and diagnostics."""
        return self.name.lower()

    @property
    def answer(self) -> CheckAnswer:
        """What to do about it."""
        return _ANSWERS.get(self, CheckAnswer.RECALIBRATE)


_ANSWERS = {
    Cause.FITS: CheckAnswer.GOOD,
    Cause.OFFSET: CheckAnswer.RETARE,
    Cause.ZERO_LOST: CheckAnswer.RETARE,
    Cause.DRIFT: CheckAnswer.RETARE,
    Cause.CONTACT: CheckAnswer.UNSURE,
    Cause.NOISE: CheckAnswer.UNSURE,
    Cause.UNKNOWN: CheckAnswer.UNSURE,
}


class Message(NamedTuple):
    """What a cause is, and what to do."""

    what: str
    remedy: str

    def text(self, details: str = "") -> str:
        """Write the message as one clause, with numbers after what it is.

        Args:
            details: the numbers, in words; empty: none.

        Returns:
            Cause and remedy.

        """
        what = f"{self.what}, {details}" if details else self.what
        return f"{what}; {self.remedy}"


MESSAGES = {
    Cause.OFFSET: Message("a constant offset", f"a tare subtracts it: {TARE_COMMAND}"),
    Cause.ZERO_LOST: Message(
        "the sensor's zero is lost", f"a tare subtracts the offset: {TARE_COMMAND}"
    ),
    Cause.DRIFT: Message(
        "the sensor's zero is off by drift, or by zeroing elsewhere", "tare without contact"
    ),
    Cause.OTHER_TOOL: Message("another tool is on", "choose that tool"),
    Cause.NO_TOOL: Message("no tool is on", "put it on, or choose no tool"),
    Cause.LOAD: Message("the load is another one", "calibrate again, or choose its tool"),
    Cause.LOOSE_TOOL: Message("the tool is loose", "fasten it, then calibrate again"),
    Cause.CONTACT: Message("contact", "free the tool, then repeat"),
    Cause.UNEXPLAINED: Message(
        "no load, offset, drift or loose tool explains it: a cable, wrong angles or contact",
        "look at the tool and its cables; a recording and `diagnose` name the cause",
    ),
    Cause.NOISE: Message(
        "the readings are too noisy to tell", "take more poses or longer averages"
    ),
}
"""For each cause that has a remedy."""


@dataclass(frozen=True)
class Verdict:
    """Verdict of an observation on a calibration; text: a sentence, empty where nothing is wrong.

    blocks: how many it rests on, without contact; log_odds: against a calibration that fits.
    """

    cause: Cause
    text: str = ""
    blocks: int = 0
    log_odds: float = 0.0

    @property
    def fits(self) -> str:
        """Whether the calibration fits, for diagnostics."""
        if self.cause is Cause.UNKNOWN:
            return "not_judged"
        return "fits" if self.cause is Cause.FITS else "does_not_fit"


@dataclass(frozen=True)
class Limits:
    """What a compensation may be off by along an axis, and still the calibration fits."""

    force_n: float = 0.05
    torque_nm: float = 0.002

    @property
    def axes(self) -> Array:
        """By axis (6,), N and N.m."""
        return np.repeat([self.force_n, self.torque_nm], 3)

    def size(self, values: Array) -> float:
        """Compute the largest value in units of its limit.

        Args:
            values: wrench (6,), N and N.m.

        Returns:
            At most 1 where all are within their limits.

        """
        return float(np.max(np.abs(values) / self.axes))

    def worst(self, values: Array) -> str:
        """Write the value that is largest in units of its limit, in words.

        Args:
            values: wrench (6,), N and N.m.

        Returns:
            Value with its unit, N or mN.m, and its axis.

        """
        axis = int(np.argmax(np.abs(values) / self.axes))
        value = f"{values[axis]:.3f} N" if axis < 3 else f"{1e3 * values[axis]:.2f} mN.m"
        return f"{value} in {WRENCH_AXES[axis]}"


def wrench_text(wrench: Array) -> str:
    """Write a wrench in words.

    Args:
        wrench: (6,), N and N.m.

    Returns:
        Forces in N and torques in mN.m.

    """
    force = ", ".join(f"{round(value, 3) + 0.0:+.3f}" for value in wrench[:3])
    torque = ", ".join(f"{round(1e3 * value, 1) + 0.0:+.1f}" for value in wrench[3:])
    return f"({force}) N and ({torque}) mN.m"


def load_text(
    mass_kg: float,
    mass_std_kg: float,
    centre_m: Array | None = None,
    centre_std_m: Array | None = None,
) -> str:
    """Write by how much a load's mass and centre differ, in words.

    Args:
        mass_kg: difference of the masses.
        mass_std_kg: its standard deviation.
        centre_m: difference of the centres (3,); None: left out.
        centre_std_m: its standard deviations (3,); None: left out.

    Returns:
        A clause in g and mm.

    """
    text = f"by {1e3 * mass_kg:+.1f} +- {1e3 * mass_std_kg:.1f} g"
    if centre_m is None:
        return text
    centre = ", ".join(f"{round(1e3 * value, 1) + 0.0:+.1f}" for value in centre_m)
    if centre_std_m is None:
        return f"{text}, its centre by ({centre}) mm"
    stds = ", ".join(f"{1e3 * value:.1f}" for value in centre_std_m)
    return f"{text}, its centre by ({centre}) +- ({stds}) mm"
