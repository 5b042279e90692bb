"""Parameters of the gap's monitor."""

from __future__ import annotations

from dataclasses import dataclass

from galen_model.arm.galen import JOINT_NAMES
from galen_ros.parameters.param import param
from galen_ros.stream.pairing import PairingSettings
from galen_ros.stream.parameters import StreamParameters

from galen_diagnosis.monitor.gap_watch import GapSettings


@dataclass(frozen=True)
class GapMonitorParameters(StreamParameters):
    """Parameters of the node. Times of samples are by their stamps."""

    tools_dir: str = param("~/.ros/galen/tools", "directory of the tools' files; `~` is expanded")
    tool: str = param("", "tool that is on; empty: the one that `gravcomp_node` says it has active")
    gravcomp_node: str = param(
        "gravcomp", "name of the compensation's node, whose tool is followed where none is given"
    )
    joint_names: tuple[str, ...] = param(
        JOINT_NAMES,
        "names in `joint_states` of the platform's x, y and z, of roll and of tilt, in this order",
    )
    window_s: float = param(
        60.0, "s; so much untouched time at rest is tested, the newest", 5.0, 3600.0
    )
    max_age_s: float = param(600.0, "s; what is older doesn't count", 10.0, 86_400.0)
    look_s: float = param(10.0, "s; time from one test to the next", 1.0, 600.0)
    false_alarms_per_hour: float = param(
        0.05, "1/h; false alarms of an arm without a gap, at most", 1e-6, 10.0
    )
    floor_force_n: float = param(
        5e-4,
        "N; standard deviation, from stop to stop, of what an arm without a gap leaves beside the"
        " noise",
        1e-6,
        10.0,
    )
    floor_torque_nm: float = param(2e-5, "N.m; the same", 1e-8, 1.0)

    def validate(self) -> None:
        """Check what no single range can say."""
        count = len(JOINT_NAMES)
        if len(self.joint_names) != count or len(set(self.joint_names)) != count:
            raise ValueError(
                f"parameter 'joint_names' is {list(self.joint_names)}, but must name five joints:"
                " x, y and z of the platform, roll and tilt"
            )

    def pairing(self) -> PairingSettings:
        """Which wrenches are taken."""
        return PairingSettings(self.max_joint_age_s, self.restart_gap_s)

    def gap(self) -> GapSettings:
        """What is tested."""
        return GapSettings(
            window_s=self.window_s,
            max_age_s=self.max_age_s,
            look_s=self.look_s,
            false_alarms_per_hour=self.false_alarms_per_hour,
            floor_n=self.floor_force_n,
            floor_nm=self.floor_torque_nm,
        )
