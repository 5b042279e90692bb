"""Causes that aren't on the contract's list: two lists that share nothing.

Thresholds are calibrated on the one, `blind_check` asks the other. What a listed effect does as
well is no fair question: strength is measured after the best listed effect, and `case` draws anew
where less than twice what can be told is left. Not taken, because the list has them by its words: a
reading that swings with the room's temperature (sensor_drift: "of any shape"); a tool that creeps
(loose_tool or sensor_drift). Nor what leaves the mean alone (a larger noise or quantum), nor what
comes seldom and short (readings that freeze): one event more or less is no strength to be set.
"""

from __future__ import annotations

from galen_diagnosis.blind.plant.cause import Cause
from galen_diagnosis.blind.plant.causes.unlisted_calibration import (
    EncoderEccentricity,
    FluidHose,
    QuadraticSensor,
    RollGain,
    SensorDeadband,
    ViscousDrag,
    WeightSag,
)
from galen_diagnosis.blind.plant.causes.unlisted_test import (
    AngleCoupling,
    BendingTool,
    CrossTerm,
    EncoderSecondHarmonic,
    HeightScale,
    MagneticPull,
    SensorHysteresis,
    Vibration,
)

_CALIBRATION: tuple[type[Cause], ...] = (
    QuadraticSensor,
    RollGain,
    EncoderEccentricity,
    FluidHose,
    ViscousDrag,
    SensorDeadband,
    WeightSag,
)
_TEST: tuple[type[Cause], ...] = (
    HeightScale,
    MagneticPull,
    Vibration,
    SensorHysteresis,
    BendingTool,
    CrossTerm,
    EncoderSecondHarmonic,
    AngleCoupling,
)

UNLISTED: dict[str, type[Cause]] = {cause.name: cause for cause in (*_CALIBRATION, *_TEST)}
"""By name."""

CALIBRATION_UNKNOWN: tuple[str, ...] = tuple(cause.name for cause in _CALIBRATION)
TEST_UNKNOWN: tuple[str, ...] = tuple(cause.name for cause in _TEST)
