"""Parameters of the node; `evaluate` takes those that decide what becomes of a wrench."""

from dataclasses import dataclass

import numpy as np
from galen_ros.param import param

from galen_gravcomp.compensator import CompensatorSettings
from galen_gravcomp.tare import TareSettings


@dataclass(frozen=True)
class GravcompParameters:
    """Parameters of the node. Times of samples are by their stamps."""

    tools_dir: str = param("~/.ros/galen/tools", "directory of the tools' files; `~` is expanded")
    tool: str = param("", "tool to load at start; empty: none until `~/set_tool` is called")
    enabled: bool = param(True, "whether to compensate from the start")
    sensor_frame: str = param(
        "", "frame_id that `wrench_raw` must have; empty: the one in the tool's file"
    )
    joint_names: tuple[str, ...] = param(
        ("roll", "tilt"), "names of the roll and the tilt joint in `joint_states`, in this order"
    )
    position_joint_names: tuple[str, ...] = param(
        ("delta_x", "delta_y", "delta_z"),
        "names of the joints that are the platform's position, m; read only where it is needed",
    )
    max_joint_age_s: float = param(
        0.05,
        "s; how far `joint_states` may lie behind a wrench, and how far apart two joint samples"
        " may be to interpolate between them",
        minimum=0.001,
        maximum=1.0,
    )
    restart_gap_s: float = param(
        1.0,
        "s; a longer gap in the stamps of a topic means that the driver was restarted",
        minimum=0.1,
        maximum=60.0,
    )
    silence_s: float = param(
        1.0,
        "s of wall time without a message after which a topic is called silent",
        minimum=0.1,
        maximum=60.0,
    )
    best_effort_input: bool = param(
        False, "subscribe as best effort, for a driver that publishes its sensor so"
    )
    sensor_range: tuple[float, ...] = param(
        (125.0, 125.0, 500.0, 3.0, 3.0, 3.0),
        "N, N.m; range of the sensor's axes fx fy fz tx ty tz; a reading beyond it gives a warning",
        minimum=1e-6,
    )
    tare_window_s: float = param(0.5, "s over which `~/tare` averages", minimum=0.05, maximum=60.0)
    tare_ramp_s: float = param(
        1.0, "s over which a new tare is applied", minimum=0.01, maximum=60.0
    )
    tare_max_motion_rad: float = param(
        0.001, "rad; a tare is refused if roll or tilt moved further in its window", minimum=0.0
    )
    tare_max_std_force_n: float = param(
        0.3, "N; a tare is refused if a force axis had a larger standard deviation", minimum=0.0
    )
    tare_max_std_torque_nm: float = param(
        0.02, "N.m; a tare is refused if a torque axis had a larger standard deviation", minimum=0.0
    )
    tare_max_force_n: float = param(
        5.0, "N; a tare that would take off a larger force is refused", minimum=0.0
    )
    tare_max_torque_nm: float = param(
        0.5, "N.m; a tare that would take off a larger torque is refused", minimum=0.0
    )
    tare_timeout_s: float = param(
        2.0,
        "s of wall time without a compensated wrench after which a running tare is given up",
        minimum=0.1,
        maximum=60.0,
    )

    def validate(self) -> None:
        """Check what no single range can say."""
        if len(self.joint_names) != 2 or len(set(self.joint_names)) != 2:
            raise ValueError(
                f"parameter 'joint_names' is {list(self.joint_names)}, but must name two joints,"
                " roll and tilt"
            )
        if len(set(self.position_joint_names)) != 3:
            raise ValueError(
                f"parameter 'position_joint_names' is {list(self.position_joint_names)}, but must"
                " name three joints, x, y and z"
            )
        if len(self.sensor_range) != 6:
            raise ValueError(
                f"parameter 'sensor_range' has {len(self.sensor_range)} numbers, but must have 6"
            )

    def settings(self) -> CompensatorSettings:
        """The compensator's part of the parameters."""
        return CompensatorSettings(
            max_joint_age_s=self.max_joint_age_s,
            restart_gap_s=self.restart_gap_s,
            sensor_frame=self.sensor_frame,
            sensor_range=np.array(self.sensor_range),
            tare=TareSettings(
                window_s=self.tare_window_s,
                ramp_s=self.tare_ramp_s,
                max_motion_rad=self.tare_max_motion_rad,
                max_std_force_n=self.tare_max_std_force_n,
                max_std_torque_nm=self.tare_max_std_torque_nm,
                max_force_n=self.tare_max_force_n,
                max_torque_nm=self.tare_max_torque_nm,
            ),
        )
