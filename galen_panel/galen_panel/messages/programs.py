"""Which program offers which service or action, and how it is started. No ROS."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Program:
    """A node's executable; `node` is the name that the node has on /diagnostics."""

    node: str
    package: str
    executable: str

    @property
    def start(self) -> str:
        """The command that starts it."""
        return f"ros2 run {self.package} {self.executable}"

    @property
    def absent(self) -> str:
        """That it isn't there, and what to do."""
        return f"{self.executable} isn't running. Start it: {self.start}"


DRIVER = Program("sim_driver", "galen_sim_driver", "sim_driver_node")
GRAVCOMP = Program("gravcomp", "galen_gravcomp", "gravcomp_node")
CALIBRATION = Program("calibration", "galen_calibration_behavior", "calibration_node")
CHECK = Program("check", "galen_calibration_behavior", "check_node")
COLLECTION = Program("collection", "galen_deflection", "collection_node")
DEFLECTION = Program("deflection", "galen_deflection", "deflection_node")

OFFERED_BY = {
    "gravcomp/set_tool": GRAVCOMP,
    "gravcomp/list_tools": GRAVCOMP,
    "gravcomp/compare_tools": GRAVCOMP,
    "gravcomp/remove_tool": GRAVCOMP,
    "gravcomp/revert_tool": GRAVCOMP,
    "gravcomp/enable": GRAVCOMP,
    "gravcomp/tare": GRAVCOMP,
    "calibration/confirm": CALIBRATION,
    "calibrate_tool": CALIBRATION,
    "check_tool": CHECK,
    "collect_pushes": COLLECTION,
    "attach_tool": DRIVER,
}
"""By the names in the contract, which are also those in `State.available`."""
