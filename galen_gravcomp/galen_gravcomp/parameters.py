"""Parameters of the node; `evaluate` takes those that decide what becomes of a wrench."""

from dataclasses import dataclass

import numpy as np
from galen_model.evidence.verdict import Limits
from galen_model.load.inertia.imu_mount import ImuMount
from galen_ros.parameters.param import param
from galen_ros.stream.parameters import LoopParameters

from galen_gravcomp.calibration_monitor.monitor import CalibrationMonitor
from galen_gravcomp.compensator import CompensatorSettings
from galen_gravcomp.corrections.bias_drift import BiasDrift, BiasDriftSettings
from galen_gravcomp.corrections.imu_motion import ImuMotion
from galen_gravcomp.corrections.joint_motion import JointMotion
from galen_gravcomp.corrections.motion_window import MotionSettings
from galen_gravcomp.corrections.stages import MotionStage, Stages
from galen_gravcomp.corrections.tare import TareSettings

_MOTIONS = ("off", "joints", "imu")


@dataclass(frozen=True)
class GravcompParameters(LoopParameters):
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
    motion: str = param(
        "off",
        "inertial forces of tool and adapter: `off`: they stay in the output; `joints`: from"
        " `joint_states`; `imu`: from the topic `imu`",
    )
    motion_window_s: float = param(
        MotionSettings.window_s,
        "s; window of samples that motion is differentiated in",
        minimum=0.002,
        maximum=1.0,
    )
    motion_delay_s: float = param(
        MotionSettings.delay_s,
        "s; how long before the window's end motion is read off, and so how much later a wrench"
        " goes out",
        minimum=0.001,
        maximum=0.5,
    )
    motion_lag_s: float = param(
        0.0,
        "s; how much later the stamps of `wrench_raw` are than those of `joint_states` (or `imu`)"
        " for the same moment",
        minimum=-0.1,
        maximum=0.1,
    )
    imu_rotvec_rad: tuple[float, ...] = param(
        (0.0, 0.0, 0.0), "rad; rotation vector that turns the IMU's axes into `ft_sensor`"
    )
    imu_lever_m: tuple[float, ...] = param((0.0, 0.0, 0.0), "m; where the IMU is in `ft_sensor`")
    imu_bias_m_s2: tuple[float, ...] = param(
        (0.0, 0.0, 0.0), "m/s^2; what the IMU reads too much, in its axes"
    )
    imu_scale: float = param(
        1.0, "the IMU's reading over the true one, of accelerations", minimum=0.5, maximum=2.0
    )
    bias_drift: bool = param(
        False,
        "whether the sensor's bias drift is learned and taken off from the start, while the arm"
        " is still and nobody touches the tool; `~/set_bias_drift` switches it",
    )
    bias_drift_max_force_n: float = param(
        BiasDriftSettings.max_force_n,
        "N; the most of it that is taken off along an axis",
        minimum=0.0,
        maximum=5.0,
    )
    bias_drift_max_torque_nm: float = param(
        BiasDriftSettings.max_torque_nm, "N.m; the same about an axis", minimum=0.0, maximum=0.5
    )
    fit_watch: bool = param(
        True, "whether to watch, while nobody touches the tool, if its file still fits"
    )
    fit_limit_force_n: float = param(
        Limits.force_n, "N; what is left over below that is no warning", minimum=0.001
    )
    fit_limit_torque_nm: float = param(Limits.torque_nm, "N.m; the same", minimum=1e-5)
    tare_window_s: float = param(0.5, "s over which `~/tare` averages", minimum=0.05, maximum=60.0)
    tare_ramp_s: float = param(
        1.0, "s over which a new tare is applied", minimum=0.01, maximum=60.0
    )
    tare_max_motion_rad: float = param(
        0.001, "rad; a tare is rejected if roll or tilt moved further in its window", minimum=0.0
    )
    tare_max_std_force_n: float = param(
        0.3, "N; a tare is rejected if a force axis had a larger standard deviation", minimum=0.0
    )
    tare_max_std_torque_nm: float = param(
        0.02,
        "N.m; a tare is rejected if a torque axis had a larger standard deviation",
        minimum=0.0,
    )
    tare_max_force_n: float = param(
        5.0, "N; a tare that would take off a larger force is rejected", minimum=0.0
    )
    tare_max_torque_nm: float = param(
        0.5, "N.m; a tare that would take off a larger torque is rejected", minimum=0.0
    )
    tare_timeout_s: float = param(
        2.0,
        "s of wall time without a compensated wrench after which a running tare is given up",
        minimum=0.1,
        maximum=60.0,
    )

    def validate(self) -> None:
        """Check what no single range can say."""
        super().validate()
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
        if self.motion not in _MOTIONS:
            raise ValueError(
                f"parameter 'motion' is '{self.motion}', but must be one of {', '.join(_MOTIONS)}"
            )
        if not self.motion_delay_s < self.motion_window_s:
            raise ValueError(
                f"parameter 'motion_delay_s' is {self.motion_delay_s:g}, but must be less than"
                f" motion_window_s, {self.motion_window_s:g}"
            )
        for name in ("imu_rotvec_rad", "imu_lever_m", "imu_bias_m_s2"):
            if len(getattr(self, name)) != 3:
                raise ValueError(
                    f"parameter '{name}' has {len(getattr(self, name))} numbers, but must have 3"
                )

    def motion_settings(self) -> MotionSettings:
        """Window, delay and lag of the inertial forces."""
        return MotionSettings(self.motion_window_s, self.motion_delay_s, self.motion_lag_s)

    def motion_stage(self) -> MotionStage | None:
        """The stage of the inertial forces, None without."""
        settings = self.motion_settings()
        if self.motion == "joints":
            return JointMotion(settings)
        if self.motion == "imu":
            mount = ImuMount(
                np.array(self.imu_rotvec_rad),
                np.array(self.imu_lever_m),
                np.array(self.imu_bias_m_s2),
                self.imu_scale,
            )
            return ImuMotion(mount, settings, self.max_joint_age_s)
        return None

    def stages(self) -> Stages:
        """What stands beside the tool's weight."""
        limits = Limits(self.fit_limit_force_n, self.fit_limit_torque_nm)
        bias_drift = BiasDriftSettings(
            self.bias_drift_max_force_n, self.bias_drift_max_torque_nm, self.tare_ramp_s
        )
        return Stages(
            motion=self.motion_stage(),
            bias_drift=BiasDrift(bias_drift, enabled=self.bias_drift),
            fit=CalibrationMonitor(limits) if self.fit_watch else None,
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
