# SPDX-License-Identifier: Apache-2.0
"""Parameters of the node; `evaluate` takes those that decide what becomes of a wrench."""

from dataclasses import dataclass

from galen_common.parameters import ParameterError, param
from galen_common.stream.pairing import StreamParameters
from galen_model.load.verdict import Limits

_MOTIONS = ("off", "joints", "imu")
_SETUP_CHECKS = ("stop", "wait", "off")
# motion_window_s and motion_delay_s: with encoder steps of 5e-5 rad and 5 um at 500 Hz, and the
# arm's fastest free motion (1.5 rad/s, 6 rad/s^2, 0.2 m/s, 1 m/s^2), the error of the inertial
# forces of 0.3 kg makes the sensor's noise 0.1 to 4.4 % larger, axis by axis. A window of 40 ms
# read off in its middle makes it up to 6.7 % larger; 50 ms 3.4 %, but 5 ms later.


@dataclass(frozen=True)
class GravcompParameters(StreamParameters):
    """Parameters of the node. Times of samples are by their stamps."""

    tools_dir: str = param("~/.ros/galen/tools", "directory of the tools' files; `~` is expanded")
    tool: str = param("", "tool to load at start; empty: none until `~/set_tool` is called")
    enabled: bool = param(True, "whether to compensate from the start")
    joint_names: tuple[str, ...] = param(
        (),
        "names in `joint_states` of the arm's joints, in its order; empty: as the arm has them."
        " Prismatic ones are read only where they are needed",
    )
    motion: str = param(
        "off",
        "inertial forces of tool and adapter: `off`: they stay in the output; `joints`: from"
        " `joint_states`; `imu`: from the topic `imu`",
    )
    motion_window_s: float = param(
        0.06,
        "s; window of samples that motion is differentiated in",
        minimum=0.002,
        maximum=1.0,
    )
    motion_delay_s: float = param(
        0.02,
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
        "whether the sensor's bias drift is learned and subtracted from the start, while the arm"
        " is at rest without contact; `~/set_bias_drift` switches it",
    )
    calibration_monitor: bool = param(
        True, "whether to check, at rest without contact, if the calibration file still fits"
    )
    setup_check: str = param(
        "stop",
        "what follows from readings at rest that contradict the set-up (axes, signs, units, order"
        " of joints), by `calibration_monitor`: `stop`: nothing is published; `wait`: nor before"
        " one has fitted; `off`: all is published, from the first sample on",
    )
    fit_limit_force_n: float = param(
        Limits.force_n, "N; a smaller residual is no warning", minimum=0.001
    )
    fit_limit_torque_nm: float = param(Limits.torque_nm, "N.m; the same", minimum=1e-5)
    tare_window_s: float = param(0.5, "s over which `~/tare` averages", minimum=0.05, maximum=60.0)
    tare_ramp_s: float = param(
        1.0, "s over which a new tare is applied", minimum=0.01, maximum=60.0
    )
    tare_max_force_n: float = param(
        5.0, "N; a tare that would subtract a larger force is rejected", minimum=0.0
    )
    tare_max_torque_nm: float = param(
        0.5, "N.m; a tare that would subtract a larger torque is rejected", minimum=0.0
    )

    def validate(self) -> None:
        """Check what no single range can say."""
        super().validate()
        if self.motion not in _MOTIONS:
            raise ParameterError(
                f"parameter 'motion' is '{self.motion}', but must be one of {', '.join(_MOTIONS)}"
            )
        if self.setup_check not in _SETUP_CHECKS:
            raise ParameterError(
                f"parameter 'setup_check' is '{self.setup_check}', but must be one of"
                f" {', '.join(_SETUP_CHECKS)}"
            )
        if self.setup_check == "wait" and not self.calibration_monitor:
            raise ParameterError(
                "parameter 'setup_check' is 'wait', which needs calibration_monitor"
            )
        if not self.motion_delay_s < self.motion_window_s:
            raise ParameterError(
                f"parameter 'motion_delay_s' is {self.motion_delay_s:g}, but must be less than"
                f" motion_window_s, {self.motion_window_s:g}"
            )
        for name in ("imu_rotvec_rad", "imu_lever_m", "imu_bias_m_s2"):
            if len(getattr(self, name)) != 3:
                raise ParameterError(
                    f"parameter '{name}' has {len(getattr(self, name))} numbers, but must have 3"
                )
