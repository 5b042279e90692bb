"""The contract's effects, their causes here, and which of them are drawn together."""

from __future__ import annotations

from itertools import combinations

from galen_diagnosis.blind.plant.cause import Cause
from galen_diagnosis.blind.plant.causes.backlash import Backlash
from galen_diagnosis.blind.plant.causes.bias_drift import BiasStep, SensorDrift
from galen_diagnosis.blind.plant.causes.joint import (
    BaseInclination,
    RollZeroOffset,
    TiltAxisMisalignment,
    TiltGain,
    TiltZeroOffset,
)
from galen_diagnosis.blind.plant.causes.load import (
    CableDrag,
    InertialLoad,
    LooseTool,
    ToolComError,
    ToolMassError,
)
from galen_diagnosis.blind.plant.causes.sensor import (
    AxisGain,
    Crosstalk,
    SensorMountRotation,
    SensorSaturation,
)
from galen_diagnosis.blind.plant.causes.springs import DeflectionHysteresis, JointCompliance
from galen_diagnosis.blind.plant.causes.stamps import TrackerDelay, WrenchDelay
from galen_diagnosis.blind.plant.causes.tracking import BaseShift, TrackerScale

CAUSES: dict[str, type[Cause]] = {
    cause.name: cause
    for cause in (
        RollZeroOffset,
        TiltZeroOffset,
        TiltGain,
        TiltAxisMisalignment,
        BaseInclination,
        SensorMountRotation,
        AxisGain,
        Crosstalk,
        SensorDrift,
        BiasStep,
        WrenchDelay,
        SensorSaturation,
        ToolMassError,
        ToolComError,
        LooseTool,
        CableDrag,
        InertialLoad,
        JointCompliance,
        DeflectionHysteresis,
        Backlash,
        TrackerDelay,
        TrackerScale,
        BaseShift,
    )
}
"""By what a diagnosis distinguishes: the contract's names, with the joint where it has one."""

EFFECTS = tuple(CAUSES)

NEED_PUSHES = (
    "joint_compliance",
    "deflection_hysteresis",
    "tracker_delay",
    "tracker_scale",
    "base_shift",
)
"""Only the bag of pushes shows them."""

_ALIKE = (
    # One name for what the other does in part; which of the two did it, nobody could say.
    {"axis_gain", "crosstalk"},
    {"axis_gain", "tool_mass_error"},
    {"sensor_drift", "bias_step"},
    {"sensor_mount_rotation", "crosstalk"},
)

PAIRS = tuple(
    (a, b) for a, b in combinations(EFFECTS, 2) if {a, b} not in _ALIKE
)  # fmt: skip
"""All pairs but those of near twins; `case` draws a pair anew where the recording can't part it."""

TWINS: dict[str, Cause] = {
    "joint_zero_offset:roll": RollZeroOffset(RollZeroOffset.typical),
    "base_inclination": BaseInclination(BaseInclination.typical, (1.0, 0.0)),
}
"""Exact twins where nobody pushes, so without the tracker: both turn gravity about the roll axis.

Tilt's zero and a turn of the sensor about y are twins in the forces only. In the torques they
differ by the turn of the load's centre: 4 mrad and 70 mm make 0.3 mm, as strong as either by itself
(D = 30 leaves some 30), so that they are no case that is meant to be ambiguous.
"""

AMBIGUOUS = tuple(TWINS)
