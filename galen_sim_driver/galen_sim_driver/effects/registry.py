"""All effects by name, and their numbers as the contract's files have them.

An effect is known by its file being in a folder of this one: nothing lists the files. In `EFFECTS`
those of the contract come first, in its order.
"""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Iterator, Mapping
from dataclasses import fields
from typing import Any

from galen_ros.parameters.param import ParameterError, checked, param_fields

from galen_sim_driver import effects
from galen_sim_driver.effects.effect import Effect
from galen_sim_driver.errors import ConfigError

CONTRACT_ORDER = (
    "roll_zero_offset",
    "tilt_zero_offset",
    "tilt_gain",
    "tilt_axis_misalignment",
    "base_inclination",
    "sensor_mount_rotation",
    "axis_gain",
    "crosstalk",
    "sensor_drift",
    "bias_step",
    "wrench_delay",
    "sensor_saturation",
    "tool_mass_error",
    "tool_com_error",
    "loose_tool",
    "cable_drag",
    "inertial_load",
    "joint_compliance",
    "deflection_hysteresis",
    "backlash",
    "tracker_delay",
    "tracker_scale",
    "base_shift",
)
"""The names of the contract's section 6."""


def _in_folder() -> Iterator[type[Effect]]:
    for found in pkgutil.walk_packages(effects.__path__, prefix=f"{effects.__name__}."):
        if found.name == __name__:
            continue
        module = importlib.import_module(found.name)
        for value in vars(module).values():
            is_effect = isinstance(value, type) and issubclass(value, Effect)
            if is_effect and value is not Effect and value.__module__ == module.__name__:
                yield value


def _place(name: str) -> tuple[int, str]:
    known = name in CONTRACT_ORDER
    return (CONTRACT_ORDER.index(name) if known else len(CONTRACT_ORDER), name)


EFFECTS: dict[str, type[Effect]] = {
    effect.name: effect for effect in sorted(_in_folder(), key=lambda effect: _place(effect.name))
}


def contract_parameters(effect: Effect) -> dict[str, Any]:
    """The effect's numbers under the contract's names, as JSON has them."""
    return _told(effect, lambda name: name not in effect.beyond_contract)


def extra_parameters(effect: Effect) -> dict[str, Any]:
    """The numbers that the contract doesn't name, as JSON has them."""
    return _told(effect, lambda name: name in effect.beyond_contract)


def _told(effect: Effect, wanted: Any) -> dict[str, Any]:
    told = {}
    for field in fields(effect):
        if wanted(field.name):
            value = getattr(effect, field.name)
            name = effect.contract_names.get(field.name, field.name)
            told[name] = list(value) if isinstance(value, tuple) else value
    return told


def effect_from(name: str, parameters: Mapping[str, Any]) -> Effect:
    """The effect of this name with these numbers, under the contract's names or the fields' own.

    What isn't given has its default. Raises ConfigError naming effect and parameter on an unknown
    name, a wrong type, size or range, and what isn't finite.
    """
    if name not in EFFECTS:
        raise ConfigError(f"no effect '{name}'; known: {', '.join(EFFECTS)}")
    kind = EFFECTS[name]
    own = param_fields(kind)
    names = {told: field for field, told in kind.contract_names.items()}
    values = {}
    for told, value in parameters.items():
        field = names.get(told, told)
        if field not in own:
            known = ", ".join(kind.contract_names.get(other, other) for other in own)
            raise ConfigError(f"{name}: no parameter '{told}'; known: {known}")
        hint, default, meaning = own[field]
        plain = value.tolist() if hasattr(value, "tolist") else value
        try:
            values[field] = checked(told, plain, hint, meaning)
        except ParameterError as error:
            raise ConfigError(f"{name}: {error}") from None
        wanted = len(default) if isinstance(default, tuple) else 0
        if wanted and len(values[field]) != wanted:
            raise ConfigError(
                f"{name}: {told} has {len(values[field])} numbers, but must have {wanted}"
            )
    effect = kind(**values)
    effect.validate()
    return effect
