# SPDX-License-Identifier: Apache-2.0
"""The records of all effects, and which of them are looked for on an arm."""

from __future__ import annotations

from collections.abc import Mapping

from galen_model.arm.galen import GALEN
from galen_sim_driver.effects.effect import Effect
from galen_sim_driver.effects.registry import identities

from galen_diagnosis.effects import drift, joints, load, sensor, tracker, transmission
from galen_diagnosis.effects.diagnosed_effect import DiagnosedEffect
from galen_diagnosis.observation.recording import DiagnosticRecording

RECORDS: Mapping[str, DiagnosedEffect] = {
    record.name: record
    for record in (
        *(sensor.SENSOR_MOUNT_ROTATION, sensor.AXIS_GAIN, load.LOOSE_TOOL),
        *(joints.BASE_INCLINATION, sensor.CROSSTALK, sensor.SENSOR_SATURATION, load.CABLE_DRAG),
        *(load.TOOL_MASS_ERROR, load.TOOL_COM_ERROR, drift.SENSOR_DRIFT, drift.BIAS_STEP),
        *(transmission.JOINT_COMPLIANCE, transmission.DEFLECTION_HYSTERESIS),
        *(transmission.ENCODER_DELAY, transmission.GEAR_ERROR, load.INERTIAL_LOAD),
        *(sensor.SENSOR_NONLINEARITY, sensor.SENSOR_HYSTERESIS, joints.JOINT_ECCENTRICITY),
        *(transmission.DEFLECTION_CREEP, sensor.WRENCH_DELAY, transmission.BACKLASH),
        joints.JOINT_ZERO_OFFSET,
        *(joints.JOINT_GAIN, joints.JOINT_AXIS_MISALIGNMENT),
        *(tracker.TRACKER_DELAY, tracker.TRACKER_SCALE, tracker.BASE_SHIFT),
    )
}
"""By name, in the order in which they are tried on tables."""


def record_of(identity: str) -> DiagnosedEffect:
    """Return the record of an effect.

    Args:
        identity: Its name, or `Effect.identity`.

    Returns:
        The record in RECORDS.

    """
    return RECORDS[identity.partition(":")[0]]


def sought(recording: DiagnosticRecording) -> dict[str, Effect]:
    """Return what is looked for in a recording.

    Args:
        recording: The revolute joints of its arm have effects of their own; of a table, whose
            joints aren't known, none.

    Returns:
        By identity, effects that change nothing yet.

    """
    arm, readings = recording.arm, recording.readings
    found = identities(arm)
    if readings is not None:
        return {
            name: effect
            for name, effect in found.items()
            if name in RECORDS and not RECORDS[name].needs and name not in readings.hidden
        }
    if arm.joint_names == GALEN.joint_names:
        for record in RECORDS.values():
            for joint in record.not_on_galen:
                del found[f"{record.name}:{joint}"]
    return found
