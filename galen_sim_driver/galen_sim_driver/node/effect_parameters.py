"""Effects as parameters of `sim_driver_node`, made of what each effect declares of itself.

A parameter's name is the effect's, then its number's as the contract has it, with words that end
the one and begin the other written once: `bias_step` and `time_s` make `bias_step_time_s`. An
effect of a joint has parameters for each joint: `joint_zero_offset`, `tilt` and `offset_rad` make
`joint_zero_offset_tilt_rad`. An effect may have older names (`driver_names`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from typing import Any

from galen_ros.parameters.param import ParameterError, param_fields

from galen_sim_driver.effects.effect import Effect
from galen_sim_driver.effects.registry import IDENTITIES
from galen_sim_driver.errors import ConfigError

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
"""All effects' parameters, as `galen_ros.parameters.declare.declare_parameters` takes them."""


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
