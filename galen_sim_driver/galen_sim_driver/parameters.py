# SPDX-License-Identifier: Apache-2.0
"""Parameters of `sim_driver_node`: the cell's, and those that each effect declares of itself.

An effect's parameter is named after the effect, then the number as the contract names it, with
words that end the one and begin the other written once: `bias_step` and `time_s` make
`bias_step_time_s`. An effect of a joint has parameters for each of the arm's joints:
`joint_zero_offset`, `tilt` and `offset_rad` make `joint_zero_offset_tilt_rad`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from galen_common.arm import ArmParameters
from galen_common.parameters import ParameterError, param, param_fields
from galen_model.arm.arm import Arm
from galen_model.arm.galen import GALEN, SENSOR
from galen_model.files.calibration_file import check_tool_name
from galen_model.load.model import ADAPTER, TOOLS, Load, ToolGeometry

from galen_sim_driver.effects.effect import ConfigError, Effect
from galen_sim_driver.effects.joints import as_word
from galen_sim_driver.effects.registry import identities
from galen_sim_driver.plant.config import HandPush, PlantConfig, Pose, Vector3

_NUMBERS_A_PUSH = 8
_DEFAULT = PlantConfig(arm=GALEN)


def _flat(vectors: Iterable[Iterable[float]]) -> list[float]:
    return [float(value) for vector in vectors for value in vector]


@dataclass(frozen=True)
class SimulatedArmParameters(ArmParameters):
    """The arm of `sim_driver_node`, which publishes `robot_description` itself."""

    urdf_file: str = param(
        "", "file of the robot description (URDF); `~` is expanded; empty: the Galen"
    )
    use_robot_description: bool = False
    """Without `param` it is no parameter."""


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
    noise: bool = param(True, "noise of sensor and tracker, and the sensor's quanta")
    start_joints: tuple[float, ...] = param(
        (), "joints at the start, in the arm's order, m and rad; empty for home"
    )
    adapter_mass_kg: float = param(ADAPTER.mass_kg, "mass of the adapter, kg", minimum=0.0)
    adapter_com_m: tuple[float, ...] = param(
        ADAPTER.com_m.tolist(), "its centre of mass in `ft_sensor`, m"
    )
    tools: tuple[str, ...] = param(list(TOOLS), "names of the tools that `attach_tool` knows")
    tool_mass_kg: tuple[float, ...] = param(
        [tool.load.mass_kg for tool in TOOLS.values()], "mass of each tool, kg", minimum=0.0
    )
    tool_com_m: tuple[float, ...] = param(
        _flat(tool.load.com_m for tool in TOOLS.values()),
        "centre of mass of each tool in `ft_sensor`, three numbers a tool, m",
    )
    tool_tip_m: tuple[float, ...] = param(
        _flat(tool.tip_m for tool in TOOLS.values()),
        "tip of each tool in `ft_sensor`, three numbers a tool, m",
    )
    initial_tool: str = param("", "tool that is on at the start, empty for none")
    sensor_noise: tuple[float, ...] = param(
        SENSOR.noise_std.tolist(), "sigma of one sample: fx fy fz in N, tx ty tz in Nm", minimum=0.0
    )
    bias_window_s: float = param(
        0.5, "how long `zero_ft_sensor` averages, s of simulated time", minimum=0.002, maximum=60.0
    )
    tracker_rate_hz: float = param(100.0, "rate of both tracker topics", minimum=1.0, maximum=500.0)
    tool_marker_m: tuple[float, ...] = param((0.0,) * 3, "tool marker in `tool_tip`, m")
    tool_marker_rotvec_rad: tuple[float, ...] = param(
        (0.0,) * 3, "tool marker in `tool_tip`, rotation vector, rad"
    )
    admittance_source: str = param(
        "compensated",
        "what admittance mode follows: `compensated` (topic `wrench_compensated`) or `raw` "
        "(the driver's own reading)",
        read_only=False,
    )
    admittance_timeout_s: float = param(
        _DEFAULT.admittance_timeout_s,
        "a wrench older than this, by its stamp, moves nothing, s; above speed factor 1, where "
        "the way through the other nodes takes more simulated time, times the speed factor",
        minimum=0.002,
    )
    hand_pushes: tuple[float, ...] = param(
        _flat((p.start_s, p.duration_s, *p.force_n, *p.torque_nm) for p in _DEFAULT.hand),
        "the hand's script, eight numbers a push: start and duration in s, force in N, torque "
        "about the tip in Nm",
    )
    hand_frames: tuple[str, ...] = param(
        ["base"],
        "axes of each push: `base` (`base_link`) or `tip` (`tool_tip`); one entry does for all",
    )

    def validate(self) -> None:
        """Check lengths and names; raises ParameterError or another GalenError."""
        pushes = len(self.hand_pushes) // _NUMBERS_A_PUSH
        for name, length in (
            ("sensor_noise", 6),
            ("adapter_com_m", 3),
            ("tool_marker_m", 3),
            ("tool_marker_rotvec_rad", 3),
            ("tool_mass_kg", len(self.tools)),
            ("tool_com_m", 3 * len(self.tools)),
            ("tool_tip_m", 3 * len(self.tools)),
            ("hand_pushes", _NUMBERS_A_PUSH * pushes),
        ):
            given = len(getattr(self, name))
            if given != length:
                raise ParameterError(
                    f"parameter '{name}' has {given} numbers, but must have {length}"
                )
        for tool in self.tools:
            check_tool_name(tool)
        if len(set(self.tools)) != len(self.tools):
            raise ParameterError(f"parameter 'tools' names one twice: {', '.join(self.tools)}")
        if self.initial_tool and self.initial_tool not in self.tools:
            raise ParameterError(
                f"parameter 'initial_tool' is '{self.initial_tool}', which is not in 'tools'"
            )
        if self.admittance_source not in ("compensated", "raw"):
            raise ParameterError(
                f"parameter 'admittance_source' is '{self.admittance_source}', but must be "
                "'compensated' or 'raw'"
            )
        if len(self.hand_frames) not in (1, pushes):
            raise ParameterError(
                f"parameter 'hand_frames' has {len(self.hand_frames)} entries for {pushes} pushes"
            )
        # Where the joints start is checked with the arm.
        dataclasses.replace(self, start_joints=()).plant_config(GALEN).validate()

    def plant_config(self, arm: Arm) -> PlantConfig:
        """Return the configuration of a plant.

        Args:
            arm: the simulated one.

        Returns:
            The configuration, unchecked and without effects.

        """
        com = np.reshape(self.tool_com_m, (-1, 3))
        tip = np.reshape(self.tool_tip_m, (-1, 3))
        rows = np.reshape(self.hand_pushes, (-1, _NUMBERS_A_PUSH)).tolist()
        frames = self.hand_frames * len(rows) if len(self.hand_frames) == 1 else self.hand_frames
        return PlantConfig(
            arm=arm,
            start_joints=self.start_joints,
            adapter=Load(self.adapter_mass_kg, np.array(self.adapter_com_m)),
            tools={
                name: ToolGeometry(Load(self.tool_mass_kg[index], com[index]), tip[index])
                for index, name in enumerate(self.tools)
            },
            noise=self.noise,
            quantise=self.noise,
            sensor=dataclasses.replace(SENSOR, noise_std=np.array(self.sensor_noise)),
            tracker_rate_hz=self.tracker_rate_hz,
            tool_marker=Pose(_vector(self.tool_marker_m), _vector(self.tool_marker_rotvec_rad)),
            admittance_timeout_s=self.admittance_timeout_s * max(1.0, self.speed_factor),
            hand=[
                HandPush(row[0], row[1], _vector(row[2:5]), _vector(row[5:8]), frame)
                for row, frame in zip(rows, frames, strict=True)
            ],
        )


def _vector(values: Sequence[float]) -> Vector3:
    x, y, z = values
    return (x, y, z)


DRIVER_NODE = "sim_driver"
"""The node's name, as a parameter file has it."""


def parameter_name(effect: Effect, field: str) -> str:
    """Return the driver's parameter for a field of an effect.

    Args:
        effect: of which name and joint count.
        field: name of the effect's field.

    Returns:
        The parameter's name, as the module's text has it.

    """
    own = effect.name.split("_")
    group, *entry = effect.contract_names.get(field, field).split(".", 1)
    words = group.lower().split("_")
    shared = max(
        k for k in range(min(len(own), len(words)) + 1) if own[len(own) - k :] == words[:k]
    )
    joint = effect.identity.split(":", 1)[1:]
    return "_".join([*own, *map(as_word, joint), *words[shared:], *map(as_word, entry)])


def _names(effect: Effect) -> dict[str, str]:
    """Return the parameters of an effect, and the fields that they set."""
    return {
        parameter_name(effect, field): field
        for field in param_fields(type(effect))
        if field not in effect.recording_only and not (effect.of_a_joint and field == "joint")
    }


def effect_parameters(arm: Arm) -> type[Any]:
    """Return the parameters of all effects of an arm, as `ManagedNode.hold` takes them.

    Args:
        arm: the nominal one.

    Returns:
        A class of dataclasses with a field a parameter; by default nothing is switched on.

    """
    nothing = identities(arm)
    found: list[tuple[str, Any, Any]] = []
    for effect in nothing.values():
        declared = param_fields(type(effect))
        for name, field in _names(effect).items():
            hint, _, meaning = declared[field]
            default = getattr(effect, field)
            found.append(
                (name, hint, dataclasses.field(default=default, metadata={"param": meaning}))
            )
    return dataclasses.make_dataclass(
        "EffectParameters",
        found,
        namespace={"__module__": __name__, "validate": effects_of, "nothing": nothing},
        frozen=True,
    )


def effects_of(parameters: Any) -> tuple[Effect, ...]:
    """Return the effects that parameters switch on.

    Args:
        parameters: an instance of a class of `effect_parameters`.

    Returns:
        The effects that change something, checked.

    Raises:
        ParameterError: a parameter has another number of values; the message names it.
        ConfigError: an effect's numbers don't fit together.

    """
    asked = []
    for nothing in parameters.nothing.values():
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


EffectParameters = effect_parameters(GALEN)
"""Those of the Galen's effects."""


def driver_parameters(effects: Iterable[Effect]) -> dict[str, Any]:
    """Return the driver's parameters that make it have these effects.

    What counts from a bag's first stamp counts from the driver's start there.

    Args:
        effects: at most one of a kind, or of a kind and joint.

    Returns:
        Values by the parameters' names, as a parameter file has them.

    Raises:
        ConfigError: there are two of a kind: the driver has one of each.

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
    """Return the content of a parameter file, for `--params-file`, with these effects.

    Args:
        effects: as `driver_parameters` takes them.

    Returns:
        The content, for YAML.

    Raises:
        ConfigError: there are two of a kind.

    """
    return {DRIVER_NODE: {"ros__parameters": driver_parameters(effects)}}
