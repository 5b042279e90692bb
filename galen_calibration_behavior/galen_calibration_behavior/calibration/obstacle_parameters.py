"""Parameters of nodes that take the arm to poses: what stands around it."""

from __future__ import annotations

from dataclasses import dataclass

from galen_model.arm.clearance import boxes_from_numbers
from galen_model.poses.plan import Surroundings
from galen_ros.goal.parameters import PoseParameters
from galen_ros.parameters.param import param


@dataclass(frozen=True)
class ObstacleParameters(PoseParameters):
    """Boxes to keep away from, and how far."""

    obstacles: tuple[float, ...] = param(
        (),
        "boxes that the arm keeps away from, six numbers each: smallest x, y, z, largest x, y, z,"
        " in `base_link`, m",
    )
    obstacle_clearance_m: float = param(0.03, "how far it keeps away from them", 0.0, 1.0)

    def check_obstacles(self) -> None:
        """Reject boxes that are none; raises ObstacleError naming the box."""
        boxes_from_numbers(self.obstacles)

    @property
    def surroundings(self) -> Surroundings:
        """The obstacles."""
        return Surroundings(boxes_from_numbers(self.obstacles), self.obstacle_clearance_m)
