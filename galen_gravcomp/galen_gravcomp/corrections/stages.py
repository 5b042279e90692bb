"""The corrections of a compensator besides the tool's weight. No ROS.

    expected = weight(roll, tilt) + pull of a cable     as the sensor reads them, in its own axes
    untared  = C (raw - expected) - inertial forces    C: undoes its gains and rotation
    out      = untared - bias drift - tare

Every stage is optional. A stage sees each sample once, in the order of its arrival, by its stamp.
"""

from __future__ import annotations

from dataclasses import dataclass

from galen_model.evidence.verdict import Limits

from galen_gravcomp.calibration_monitor.monitor import CalibrationMonitor
from galen_gravcomp.corrections.bias_drift import BiasDrift
from galen_gravcomp.corrections.imu_motion import ImuMotion
from galen_gravcomp.corrections.joint_motion import JointMotion
from galen_gravcomp.parameters import GravcompParameters


@dataclass(frozen=True)
class Stages:
    """The stages of one compensator; None: it does without."""

    motion: JointMotion | ImuMotion | None = None
    bias_drift: BiasDrift | None = None
    fit: CalibrationMonitor | None = None


def make_motion(parameters: GravcompParameters) -> JointMotion | ImuMotion | None:
    """Make the stage of the inertial forces, None without."""
    if parameters.motion == "joints":
        return JointMotion(parameters)
    return ImuMotion(parameters) if parameters.motion == "imu" else None


def make_stages(parameters: GravcompParameters) -> Stages:
    """Make the stages that a node's parameters ask for."""
    limits = Limits(parameters.fit_limit_force_n, parameters.fit_limit_torque_nm)
    return Stages(
        motion=make_motion(parameters),
        bias_drift=BiasDrift(enabled=parameters.bias_drift, ramp_s=parameters.tare_ramp_s),
        fit=CalibrationMonitor(limits) if parameters.fit_watch else None,
    )
