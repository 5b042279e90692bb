"""The check node's parameters."""

from __future__ import annotations

from dataclasses import dataclass

from galen_ros.parameters.param import param

from galen_calibration_behavior.calibration.obstacle_parameters import ObstacleParameters
from galen_calibration_behavior.quick_check.answer import CheckLimits
from galen_calibration_behavior.quick_check.decision import FEWEST_POSES
from galen_calibration_behavior.quick_check.procedure import CheckSettings

MOST_POSES = 12


@dataclass(frozen=True)
class CheckParameters(ObstacleParameters):
    """Parameters of check_node."""

    tools_dir: str = param("~/.ros/galen/tools", "directory of the tools' files; `~` is expanded")
    poses: int = param(6, "number of poses", FEWEST_POSES, MOST_POSES)
    reach_rad: float = param(
        0.5, "the poses lie within this of where roll and tilt are, rad", 0.1, 1.5
    )
    pose_retries: int = param(1, "how often a rejected pose is tried again", 0, 10)
    limit_force_n: float = param(
        0.05, "a file is good that leaves no more than this anywhere, N", 1e-4, 100.0
    )
    limit_torque_nm: float = param(0.002, "likewise, N·m", 1e-6, 10.0)
    false_alarm: float = param(
        0.05, "how often chance alone may look like a change, before the limits", 1e-6, 0.5
    )

    def validate(self) -> None:
        """Reject boxes that are none; raises ObstacleError naming the box."""
        self.check_obstacles()

    @property
    def limits(self) -> CheckLimits:
        """What a file is judged by."""
        return CheckLimits(self.limit_force_n, self.limit_torque_nm, self.false_alarm)

    def settings(self) -> CheckSettings:
        """The procedure's settings."""
        return CheckSettings(
            **vars(self.pose_settings()),
            reach_rad=self.reach_rad,
            pose_retries=self.pose_retries,
            limits=self.limits,
            surroundings=self.surroundings,
        )
