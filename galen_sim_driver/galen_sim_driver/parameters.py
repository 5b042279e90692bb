"""The driver's parameters, but for its effects' own, and the plant's configuration they make.

Effects as parameters of `sim_driver_node`, made of what each effect declares of itself.

A parameter's name is the effect's, then its number's as the contract has it, with words that end
the one and begin the other written once: `bias_step` and `time_s` make `bias_step_time_s`. An
effect of a joint has parameters for each joint: `joint_zero_offset`, `tilt` and `offset_rad` make
`joint_zero_offset_tilt_rad`. An effect may have older names (`driver_names`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from galen_model.arm.galen import (
    HOME,
    LIMITS,
    SENSOR,
    TRACKER_POSITION_NOISE_M,
    TRACKER_ROTATION_NOISE_RAD,
    SensorParameters,
)
from galen_model.files.calibration_file import check_tool_name
from galen_model.load.model import Load
from galen_model.load.nominal_tools import ADAPTER, TOOLS, ToolGeometry
from galen_ros.parameters import ParameterError, param, param_fields

from galen_sim_driver.effects.effect import ConfigError, Effect
from galen_sim_driver.effects.registry import IDENTITIES
from galen_sim_driver.plant.config import (
    AdmittanceConfig,
    HandPush,
    MotionConfig,
    PlantConfig,
    Pose,
    SensorConfig,
    TrackerConfig,
    Vector3,
)

_NUMBERS_A_PUSH = 8
_DEFAULT = PlantConfig()


def _flat(vectors: list[np.ndarray]) -> list[float]:
    return [float(value) for vector in vectors for value in vector]


@dataclass(frozen=True)
class DriverParameters:
    """Parameters of `sim_driver_node`."""

    speed_factor: float = param(
        1.0,
        "simulated over wall time; at 1 stamps are system time, at any other value simulated time "
        "starts at 1 s and goes out on `/clock`",
        minimum=0.01,
        maximum=1000.0,
    )
    seed: int = param(0, "seed of every noise; the same seed gives the same noise", minimum=0)
    noise: bool = param(True, "noise of sensor and tracker")
    quantise: bool = param(True, "quanta of the force/torque sensor")
    tick_s: float = param(
        0.002, "wall time between two batches of steps, s", minimum=0.0005, maximum=0.1
    )
    max_steps_per_tick: int = param(
        40, "most steps of 2 ms at once, when it has to catch up", minimum=1, maximum=1000
    )
    start_joints: tuple[float, ...] = param(
        HOME.tolist(), "joints at the start: delta x, y, z in m, roll, tilt in rad"
    )

    delta_velocity_m_s: float = param(0.2, "fastest delta joint, m/s", minimum=1e-4, maximum=10.0)
    delta_acceleration_m_s2: float = param(
        1.0, "largest acceleration of a delta joint, m/s^2", minimum=1e-3, maximum=100.0
    )
    angle_velocity_rad_s: float = param(
        1.5, "fastest roll and tilt, rad/s", minimum=1e-4, maximum=50.0
    )
    angle_acceleration_rad_s2: float = param(
        6.0, "largest acceleration of roll and tilt, rad/s^2", minimum=1e-3, maximum=500.0
    )

    adapter_mass_kg: float = param(
        ADAPTER.mass_kg, "mass of the adapter, the bias load, kg", minimum=0.0
    )
    adapter_com_m: tuple[float, ...] = param(
        ADAPTER.com_m.tolist(), "its centre of mass in `ft_sensor`, m"
    )
    tools: tuple[str, ...] = param(list(TOOLS), "names of the tools that `attach_tool` knows")
    tool_mass_kg: tuple[float, ...] = param(
        [tool.load.mass_kg for tool in TOOLS.values()], "mass of each tool, kg", minimum=0.0
    )
    tool_com_m: tuple[float, ...] = param(
        _flat([tool.load.com_m for tool in TOOLS.values()]),
        "centre of mass of each tool in `ft_sensor`, three numbers a tool, m",
    )
    tool_tip_m: tuple[float, ...] = param(
        _flat([tool.tip_m for tool in TOOLS.values()]),
        "tip of each tool in `ft_sensor`, three numbers a tool, m",
    )
    initial_tool: str = param("", "tool that is on at the start, empty for none")

    sensor_noise: tuple[float, ...] = param(
        SENSOR.noise_std.tolist(), "sigma of one sample: fx fy fz in N, tx ty tz in Nm", minimum=0.0
    )
    sensor_quantum: tuple[float, ...] = param(
        SENSOR.quantum.tolist(), "quantum of each axis, N and Nm", minimum=1e-9
    )
    sensor_range: tuple[float, ...] = param(
        SENSOR.range.tolist(), "range (+-) of each axis, N and Nm", minimum=1e-3
    )
    bias_window_s: float = param(
        0.5, "how long `zero_ft_sensor` averages, s of simulated time", minimum=0.002, maximum=60.0
    )

    tracker_rate_hz: float = param(100.0, "rate of both tracker topics", minimum=1.0, maximum=500.0)
    tracker_position_noise_m: float = param(
        TRACKER_POSITION_NOISE_M, "sigma of a position, each axis, m", minimum=0.0
    )
    tracker_rotation_noise_rad: float = param(
        TRACKER_ROTATION_NOISE_RAD, "sigma of a rotation, each axis, rad", minimum=0.0
    )
    tracker_base_m: tuple[float, ...] = param(
        _DEFAULT.tracker.base_in_tracker.translation_m, "`base_link` in `tracker`, m"
    )
    tracker_base_rotvec_rad: tuple[float, ...] = param(
        _DEFAULT.tracker.base_in_tracker.rotvec_rad,
        "`base_link` in `tracker`, rotation vector, rad",
    )
    base_marker_m: tuple[float, ...] = param(
        _DEFAULT.tracker.base_marker.translation_m, "base marker in `base_link`, m"
    )
    base_marker_rotvec_rad: tuple[float, ...] = param(
        _DEFAULT.tracker.base_marker.rotvec_rad, "base marker in `base_link`, rotation vector, rad"
    )
    tool_marker_m: tuple[float, ...] = param(
        _DEFAULT.tracker.tool_marker.translation_m, "tool marker in `tool_tip`, m"
    )
    tool_marker_rotvec_rad: tuple[float, ...] = param(
        _DEFAULT.tracker.tool_marker.rotvec_rad, "tool marker in `tool_tip`, rotation vector, rad"
    )

    admittance_source: str = param(
        "compensated",
        "what admittance mode follows: `compensated` (topic `wrench_compensated`) or `raw` "
        "(the driver's own reading)",
        read_only=False,
    )
    admittance_linear_gain_m_s_n: float = param(
        _DEFAULT.admittance.linear_gain_m_s_n, "velocity of the tip over force, m/s/N", minimum=0.0
    )
    admittance_angular_gain_rad_s_nm: float = param(
        _DEFAULT.admittance.angular_gain_rad_s_nm,
        "angular velocity over torque about the tip, rad/s/Nm",
        minimum=0.0,
    )
    admittance_damping: float = param(
        _DEFAULT.admittance.damping, "damping of the least squares", minimum=0.0
    )
    admittance_timeout_s: float = param(
        _DEFAULT.admittance.timeout_s,
        "a wrench older than this, by its stamp, moves nothing, s; above speed factor 1, where "
        "the way through the other nodes takes more simulated time, times the speed factor",
        minimum=0.002,
    )

    hand_pushes: tuple[float, ...] = param(
        [
            value
            for push in _DEFAULT.hand
            for value in (push.start_s, push.duration_s, *push.force_n, *push.torque_nm)
        ],
        "the hand's script, eight numbers a push: start and duration in s, force in N, torque "
        "about the tip in Nm",
    )
    hand_frames: tuple[str, ...] = param(
        [push.frame for push in _DEFAULT.hand],
        "axes of each push: `base` (`base_link`) or `tip` (`tool_tip`); one entry does for all",
    )
    hand_ramp_s: float = param(
        _DEFAULT.hand[0].ramp_s, "time in which a push rises and falls, s", minimum=0.0
    )

    def validate(self) -> None:
        """Lists have their lengths, names exist; raises ParameterError or another GalenError."""
        for name in ("sensor_noise", "sensor_quantum", "sensor_range"):
            self._require_length(name, 6)
        self._require_length("start_joints", 5)
        for name in (
            "adapter_com_m",
            "tracker_base_m",
            "tracker_base_rotvec_rad",
            "base_marker_m",
            "base_marker_rotvec_rad",
            "tool_marker_m",
            "tool_marker_rotvec_rad",
        ):
            self._require_length(name, 3)
        for tool in self.tools:
            check_tool_name(tool)
        if len(set(self.tools)) != len(self.tools):
            raise ParameterError(f"parameter 'tools' names one twice: {', '.join(self.tools)}")
        self._require_length("tool_mass_kg", len(self.tools))
        self._require_length("tool_com_m", 3 * len(self.tools))
        self._require_length("tool_tip_m", 3 * len(self.tools))
        if self.initial_tool and self.initial_tool not in self.tools:
            raise ParameterError(
                f"parameter 'initial_tool' is '{self.initial_tool}', which is not in 'tools'"
            )
        if self.admittance_source not in ("compensated", "raw"):
            raise ParameterError(
                f"parameter 'admittance_source' is '{self.admittance_source}', but must be "
                "'compensated' or 'raw'"
            )
        pushes = len(self.hand_pushes) // _NUMBERS_A_PUSH
        self._require_length("hand_pushes", _NUMBERS_A_PUSH * pushes)
        if len(self.hand_frames) not in (1, pushes):
            raise ParameterError(
                f"parameter 'hand_frames' has {len(self.hand_frames)} entries for {pushes} pushes"
            )
        self.plant_config().validate()

    def plant_config(self) -> PlantConfig:
        """Return the plant's configuration."""
        angle_v, angle_a = self.angle_velocity_rad_s, self.angle_acceleration_rad_s2
        delta_v, delta_a = self.delta_velocity_m_s, self.delta_acceleration_m_s2
        com = np.reshape(self.tool_com_m, (-1, 3))
        tip = np.reshape(self.tool_tip_m, (-1, 3))
        x, y, z, roll, tilt = self.start_joints
        return replace(
            _DEFAULT,
            start_joints=(x, y, z, roll, tilt),
            adapter=Load(self.adapter_mass_kg, np.array(self.adapter_com_m)),
            tools={
                name: ToolGeometry(Load(self.tool_mass_kg[index], com[index]), tip[index])
                for index, name in enumerate(self.tools)
            },
            motion=MotionConfig(
                velocity=(delta_v, delta_v, delta_v, angle_v, angle_v),
                acceleration=(delta_a, delta_a, delta_a, angle_a, angle_a),
                limits=LIMITS,
            ),
            sensor=SensorConfig(
                SensorParameters(
                    np.array(self.sensor_noise),
                    np.array(self.sensor_quantum),
                    np.array(self.sensor_range),
                ),
                noise=self.noise,
                quantise=self.quantise,
            ),
            tracker=TrackerConfig(
                rate_hz=self.tracker_rate_hz,
                noise=self.noise,
                position_noise_m=self.tracker_position_noise_m,
                rotation_noise_rad=self.tracker_rotation_noise_rad,
                base_in_tracker=_pose(self.tracker_base_m, self.tracker_base_rotvec_rad),
                base_marker=_pose(self.base_marker_m, self.base_marker_rotvec_rad),
                tool_marker=_pose(self.tool_marker_m, self.tool_marker_rotvec_rad),
            ),
            admittance=AdmittanceConfig(
                self.admittance_linear_gain_m_s_n,
                self.admittance_angular_gain_rad_s_nm,
                self.admittance_damping,
                self.admittance_timeout_s * max(1.0, self.speed_factor),
            ),
            hand=self._hand_script(),
        )

    def _hand_script(self) -> list[HandPush]:
        rows = np.reshape(self.hand_pushes, (-1, _NUMBERS_A_PUSH)).tolist()
        frames = self.hand_frames * len(rows) if len(self.hand_frames) == 1 else self.hand_frames
        return [
            HandPush(row[0], row[1], _vector(row[2:5]), _vector(row[5:8]), frame, self.hand_ramp_s)
            for row, frame in zip(rows, frames, strict=True)
        ]

    def _require_length(self, name: str, length: int) -> None:
        values = getattr(self, name)
        if len(values) != length:
            raise ParameterError(
                f"parameter '{name}' has {len(values)} numbers, but must have {length}"
            )


def _vector(values: tuple[float, ...] | list[float]) -> Vector3:
    x, y, z = values
    return (x, y, z)


def _pose(translation_m: tuple[float, ...], rotvec_rad: tuple[float, ...]) -> Pose:
    return Pose(_vector(translation_m), _vector(rotvec_rad))


DRIVER_NODE = "sim_driver"
"""The node's name, as a parameter file has it."""


def parameter_name(effect: Effect, field: str) -> str:
    """The driver's parameter for a field of an effect."""
    if field in effect.driver_names:
        return effect.driver_names[field]
    own = effect.name.split("_")
    told = effect.contract_names.get(field, field).lower().replace(".", "_").split("_")
    shared = max(k for k in range(min(len(own), len(told)) + 1) if own[len(own) - k :] == told[:k])
    joint = effect.identity.split(":")[1:]
    return "_".join(own + joint + told[shared:])


def _names(effect: Effect) -> dict[str, str]:
    """Parameters of an effect, and the fields that they set."""
    return {
        parameter_name(effect, field): field
        for field in param_fields(type(effect))
        if field not in effect.recording_only and not (effect.of_a_joint and field == "joint")
    }


class _Checked:
    """Base of the parameters' dataclass: what they say must fit together."""

    def validate(self) -> None:
        """Raise ParameterError or ConfigError, naming the parameter."""
        effects_of(self)


def _fields() -> list[tuple[str, Any, Any]]:
    found = []
    for effect in IDENTITIES.values():
        declared = param_fields(type(effect))
        for name, field in _names(effect).items():
            hint, default, meaning = declared[field]
            found.append(
                (name, hint, dataclasses.field(default=default, metadata={"param": meaning}))
            )
    return found


EffectParameters: type[Any] = dataclasses.make_dataclass(
    "EffectParameters",
    _fields(),
    bases=(_Checked,),
    namespace={"__module__": __name__},
    frozen=True,
)
"""All effects' parameters, as `galen_ros.node.parameters.declare_parameters` takes them."""


def effects_of(parameters: Any) -> tuple[Effect, ...]:
    """The effects that an instance of `EffectParameters` asks for; those that change nothing left.

    Raises ParameterError or ConfigError, naming the parameter.
    """
    asked = []
    for nothing in IDENTITIES.values():
        declared = param_fields(type(nothing))
        values = {}
        for name, field in _names(nothing).items():
            value, default = getattr(parameters, name), declared[field][1]
            if isinstance(default, tuple) and default and len(value) != len(default):
                raise ParameterError(
                    f"parameter '{name}' has {len(value)} numbers, but must have {len(default)}"
                )
            values[field] = value
        effect = dataclasses.replace(nothing, **values)
        effect.validate()
        if not effect.changes_nothing:
            asked.append(effect)
    return tuple(asked)


def driver_parameters(effects: Iterable[Effect]) -> dict[str, Any]:
    """The driver's parameters that make it have these effects.

    What counts from a bag's first stamp counts from the driver's start there. Raises ConfigError
    where there are two of a kind: the driver has one of each.
    """
    found: dict[str, Any] = {}
    for effect in effects:
        names = _names(effect)
        if names.keys() & found.keys():
            raise ConfigError(f"the driver takes one {effect.identity} at a time, not two")
        for name, field in names.items():
            value = getattr(effect, field)
            # An empty list, for which a parameter file has no type, is always the default.
            if value != ():
                found[name] = list(value) if isinstance(value, tuple) else value
    return found


def driver_file(effects: Iterable[Effect]) -> Mapping[str, Any]:
    """The content of a parameter file, for `--params-file`, with these effects."""
    return {DRIVER_NODE: {"ros__parameters": driver_parameters(effects)}}
