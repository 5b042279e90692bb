"""Effects as parameters of `sim_driver_node`, made of what each effect declares of itself.

A parameter's name is the effect's, then its number's as the contract has it, with words that end
the one and begin the other written once: `tilt_zero_offset` and `offset_rad` make
`tilt_zero_offset_rad`, `bias_step` and `time_s` make `bias_step_time_s`. An effect may have older
names (`driver_names`). Nothing here lists the effects.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from typing import Any

from galen_ros.parameters.param import ParameterError, param_fields

from galen_sim_driver.effects.effect import Effect
from galen_sim_driver.effects.registry import EFFECTS
from galen_sim_driver.errors import ConfigError

DRIVER_NODE = "sim_driver"
"""The node's name, as a parameter file has it."""


def parameter_name(effect: type[Effect], field: str) -> str:
    """The driver's parameter for a field of an effect."""
    if field in effect.driver_names:
        return effect.driver_names[field]
    own = effect.name.split("_")
    told = effect.contract_names.get(field, field).lower().split("_")
    shared = max(k for k in range(min(len(own), len(told)) + 1) if own[len(own) - k :] == told[:k])
    return "_".join(own + told[shared:])


def _names(effect: type[Effect]) -> dict[str, str]:
    """Parameters of an effect, and the fields that they set."""
    return {
        parameter_name(effect, field): field
        for field in param_fields(effect)
        if field not in effect.recording_only
    }


class _Checked:
    """Base of the parameters' dataclass: what they say must fit together."""

    def validate(self) -> None:
        """Raise ParameterError or ConfigError, naming the parameter."""
        effects_of(self)


def _fields() -> list[tuple[str, Any, Any]]:
    found = []
    for effect in EFFECTS.values():
        declared = param_fields(effect)
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
    for kind in EFFECTS.values():
        declared = param_fields(kind)
        values = {}
        for name, field in _names(kind).items():
            value, default = getattr(parameters, name), declared[field][1]
            if isinstance(default, tuple) and default and len(value) != len(default):
                raise ParameterError(
                    f"parameter '{name}' has {len(value)} numbers, but must have {len(default)}"
                )
            values[field] = value
        effect = kind(**values)
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
        names = _names(type(effect))
        if names.keys() & found.keys():
            raise ConfigError(f"the driver takes one {effect.name} at a time, not two")
        for name, field in names.items():
            value = getattr(effect, field)
            # An empty list, for which a parameter file has no type, is always the default.
            if value != ():
                found[name] = list(value) if isinstance(value, tuple) else value
    return found


def driver_file(effects: Iterable[Effect]) -> Mapping[str, Any]:
    """The content of a parameter file, for `--params-file`, with these effects."""
    return {DRIVER_NODE: {"ros__parameters": driver_parameters(effects)}}
