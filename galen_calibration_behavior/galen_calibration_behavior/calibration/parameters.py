"""The calibration node's parameters: sweep and home under the report's names, units elsewhere."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from galen_model.arm.galen import LIMITS
from galen_model.load.mounting.groups import entities
from galen_model.poses.grid import GridError
from galen_ros.parameters.param import param

from galen_calibration_behavior.calibration.procedure import ProcedureSettings
from galen_calibration_behavior.calibration.sweep_parameters import SweepParameters


@dataclass(frozen=True)
class CalibrationParameters(SweepParameters):
    """Parameters of calibration_node."""

    tools_dir: str = param("~/.ros/galen/tools", "directory of the tools' files; `~` is expanded")

    pose_retries: int = param(1, "how often a rejected pose is tried again", 0, 10)
    max_rejected_in_a_row: int = param(8, "so many rejected poses in a row end it", 1, 10_000)
    min_pose_fraction: float = param(0.5, "fewest good poses, as a part of the sweep", 0.05, 1.0)
    zero_tolerance_n: float = param(0.1, "largest force read just after zeroing, N", 1e-4, 100.0)
    zero_tolerance_nm: float = param(
        0.005, "largest torque read just after zeroing, N·m", 1e-6, 10.0
    )

    estimate: tuple[str, ...] = param(
        (),
        "what to estimate together with the loads, see *Sensor and mounting*; a goal is rejected"
        " where the poses can't tell it",
    )

    confirm_timeout_s: float = param(
        600.0, "a person has this long to put the tool on or take it off", 1.0, 86_400.0
    )

    def validate(self) -> None:
        """Reject a home or a sweep outside the joint limits, and what can't be estimated.

        Raises GridError naming the joint, IdentificationError naming the group, ObstacleError
        naming the box.
        """
        for name, value, low, high in zip(
            ("Xhome", "Yhome", "Zhome", "Rhome", "Thome"),
            self.home,
            LIMITS.lower,
            LIMITS.upper,
            strict=True,
        ):
            if not low <= value <= high:
                raise GridError(f"{name} = {value:g} is outside its limits, {low:g} ... {high:g}")
        entities(self.estimate)
        self.check_sweep()

    def settings(self) -> ProcedureSettings:
        """Return the procedure's settings."""
        return ProcedureSettings(
            home=np.array(self.home),
            **vars(self.sweep_pose_settings()),
            pose_retries=self.pose_retries,
            max_rejected_in_a_row=self.max_rejected_in_a_row,
            min_pose_fraction=self.min_pose_fraction,
            zero_tolerance=np.array([self.zero_tolerance_n] * 3 + [self.zero_tolerance_nm] * 3),
            confirm_timeout_s=self.confirm_timeout_s,
        )
