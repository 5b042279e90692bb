# SPDX-License-Identifier: Apache-2.0
"""All effects by name, and their numbers as the contract's files have them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace
from typing import Any

from galen_common.parameters import ParameterError, checked, param_fields
from galen_model.arm.arm import Arm

from galen_sim_driver.effects import hysteresis, joints, load, sensor
from galen_sim_driver.effects.effect import ConfigError, Effect

EFFECTS: dict[str, type[Effect]] = {
    effect.name: effect
    for effect in (
        *(joints.JointZeroOffset, joints.JointGain, joints.JointAxisMisalignment),
        *(joints.BaseInclination, sensor.SensorMountRotation, sensor.AxisGain, sensor.Crosstalk),
        *(sensor.SensorDrift, sensor.BiasStep, sensor.WrenchDelay, sensor.SensorSaturation),
        *(load.ToolMassError, load.ToolComError, load.LooseTool, load.CableDrag),
        *(load.InertialLoad, joints.JointCompliance, hysteresis.DeflectionHysteresis),
        *(joints.Backlash, joints.JointEccentricity, sensor.SensorNonlinearity),
        *(sensor.SensorHysteresis, hysteresis.DeflectionCreep, sensor.TrackerDelay),
        *(sensor.TrackerScale, sensor.BaseShift),
    )
}
"""Those of the contract's section 6, in its order; the compliance is that of the Galen."""

LIMITED = tuple(name for name, kind in EFFECTS.items() if kind.has_limit)
"""Effects that a specification limits."""


def identities(arm: Arm) -> dict[str, Effect]:
    """Return all effects of an arm by identity, changing nothing.

    Args:
        arm: the nominal one.

    Returns:
        Effects by `Effect.identity`; those of a joint are there for each revolute joint.

    """
    found = (effect for kind in EFFECTS.values() for effect in kind.none_of(arm))
    return {effect.identity: effect for effect in found}


_FORMER_NAMES: Mapping[str, Mapping[str, str]] = {
    "roll_zero_offset": {"effect": "joint_zero_offset", "joint": "roll"},
    "tilt_zero_offset": {"effect": "joint_zero_offset", "joint": "tilt"},
    "tilt_gain": {"effect": "joint_gain", "joint": "tilt"},
    "tilt_axis_misalignment": {"effect": "joint_axis_misalignment", "joint": "tilt", "about": "z"},
}
_FORMER_STIFFNESSES = {f"k_{spring}": spring for spring in ("roll", "tilt", "carriage", "rod")}


def contract_form(name: str, parameters: Mapping[str, Any]) -> tuple[str, dict[str, Any]]:
    """Rename an effect of recordings made before effects had joints; leave others as they are.

    Args:
        name: the effect's.
        parameters: its numbers, under the names of then or of now.

    Returns:
        Name and numbers as the contract names them now.

    """
    if name == joints.JointCompliance.name and parameters.keys() & _FORMER_STIFFNESSES.keys():
        others = {key: v for key, v in parameters.items() if key not in _FORMER_STIFFNESSES}
        springs = {_FORMER_STIFFNESSES[key]: parameters[key] for key in parameters.keys() - others}
        return name, {**others, "stiffness": springs}
    if name not in _FORMER_NAMES:
        return name, dict(parameters)
    at = dict(_FORMER_NAMES[name])
    found = {"angle_rad" if key == "about_z_rad" else key: v for key, v in parameters.items()}
    return at.pop("effect"), {**at, **found}


def identity_of(name: str, parameters: Mapping[str, Any]) -> str:
    """Return `Effect.identity` of an effect by name and parameters.

    Args:
        name: as the contract names it now; an unknown one is its own identity.
        parameters: of which `joint` counts.

    Returns:
        `name`, or `name:joint` of an effect of a joint.

    """
    kind = EFFECTS.get(name)
    return f"{name}:{parameters.get('joint')}" if kind and kind.of_a_joint else name


def contract_parameters(effect: Effect) -> dict[str, Any]:
    """Return the effect's numbers under the contract's names, as JSON has them.

    Args:
        effect: of any arm.

    Returns:
        Numbers, texts and lists; without the fields that the contract doesn't name.

    """
    own = [f.name for f in fields(effect) if "param" in f.metadata]
    named: dict[str, Any] = {}
    for field in own:
        if field in effect.beyond_contract:
            continue
        value = getattr(effect, field)
        group, _, entry = effect.contract_names.get(field, field).partition(".")
        if not entry:
            named[group] = list(value) if isinstance(value, tuple) else value
        elif value:
            named.setdefault(group, {})[entry] = value
    return named


def effect_from(name: str, parameters: Mapping[str, Any], arm: Arm) -> Effect:
    """Make an arm's effect of a name and numbers.

    Args:
        name: the effect's; names from before effects had joints are read, too.
        parameters: named as the contract or the fields are; numbers not given have their defaults.
        arm: the nominal one.

    Returns:
        The effect, checked.

    Raises:
        ConfigError: an unknown name, a wrong type, size or range, or numbers that aren't finite; it
            names effect and parameter.

    """
    name, parameters = contract_form(name, parameters)
    if name not in EFFECTS:
        raise ConfigError(f"no effect '{name}'; known: {', '.join(EFFECTS)}")
    kind = EFFECTS[name].kind_of(arm)
    own = param_fields(kind)
    names = {key: field for field, key in kind.contract_names.items()}
    values = {}
    for key, value in _flat(parameters).items():
        field = names.get(key, key)
        if field not in own:
            known = ", ".join(kind.contract_names.get(other, other) for other in own)
            raise ConfigError(f"{name}: no parameter '{key}'; known: {known}")
        hint, default, meaning = own[field]
        plain = value.tolist() if hasattr(value, "tolist") else value
        try:
            values[field] = checked(key, plain, hint, meaning)
        except ParameterError as error:
            raise ConfigError(f"{name}: {error}") from None
        wanted = len(default) if isinstance(default, tuple) else 0
        if wanted and len(values[field]) != wanted:
            raise ConfigError(
                f"{name}: {key} has {len(values[field])} numbers, but must have {wanted}"
            )
    effect = kind(**values)
    if isinstance(effect, joints.AtJoint):
        effect = replace(effect, nominal=arm)
    effect.validate()
    return effect


def _flat(parameters: Mapping[str, Any]) -> dict[str, Any]:
    """Entries of mappings under "name.entry"."""
    flat: dict[str, Any] = {}
    for name, value in parameters.items():
        if isinstance(value, Mapping):
            flat |= {f"{name}.{entry}": part for entry, part in value.items()}
        else:
            flat[name] = value
    return flat


def limit_parts(arm: Arm) -> dict[str, tuple[str, ...]]:
    """Return the names that limits may have on an arm, of each effect that a specification limits.

    Args:
        arm: the nominal one.

    Returns:
        Names by effect; none where the effect is limited as a whole.

    """
    found: dict[str, dict[str, None]] = {}
    for effect in identities(arm).values():
        if effect.has_limit:
            found.setdefault(effect.name, {}).update(dict.fromkeys(effect.limit_names(arm)))
    return {name: tuple(part for part in parts if part) for name, parts in found.items()}
