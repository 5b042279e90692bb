"""A diagnosis in words.

Effects and their parameters in words and in units that people read.

A diagnosis in a sentence or two that a person understands.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

from galen_model.arm.galen import WRENCH_AXES

from galen_diagnosis.answer.answer import NONE, UNKNOWN, Answer, Cause, Interval

RANKING_NOTE = (
    "Each probability is that of one cause being there; several can be there together, so they"
    " need not add up to 100 %."
)
TITLES = {
    "joint_zero_offset": "zero of the {joint} joint",
    "joint_gain": "gain of the {joint} joint",
    "joint_axis_misalignment": "direction of the {joint} axis",
    "base_inclination": "inclined base",
    "sensor_mount_rotation": "turned sensor",
    "axis_gain": "gains of the sensor's axes",
    "crosstalk": "crosstalk in the sensor",
    "sensor_drift": "drifting sensor",
    "bias_step": "jump of the sensor's reading",
    "wrench_delay": "late wrenches",
    "sensor_saturation": "saturated sensor",
    "tool_mass_error": "tool's mass",
    "tool_com_error": "tool's centre of mass",
    "loose_tool": "loose tool",
    "cable_drag": "pulling cable",
    "inertial_load": "forces of acceleration",
    "joint_compliance": "stiffness of the arm",
    "deflection_hysteresis": "hysteresis of the deflection",
    "backlash": "backlash",
    "tracker_delay": "late tracker",
    "tracker_scale": "tracker's scale",
    "base_shift": "moved base marker",
    NONE: "nothing is missing",
    UNKNOWN: "something that is not on the list",
}

# {name} is the parameter with its interval, {name!r} a word as it is.
SENTENCES = {
    "joint_zero_offset": "the {joint} joint's zero is off by {offset_rad}",
    "joint_gain": "the {joint} joint turns by {gain} more than it reports",
    "joint_axis_misalignment": "the {joint} axis is turned by {angle_rad} about {about} of its"
    " parent link",
    "base_inclination": "the base is inclined, by {about_x_rad} about x and {about_y_rad} about y",
    "sensor_mount_rotation": "the sensor is turned in its mount, by {rotvec_rad}",
    "axis_gain": "the sensor's axes read too much, by {gain}",
    "crosstalk": "the sensor reads {coefficient} of {from} in {to}",
    "sensor_drift": "the sensor drifts, by {rate_per_hour}",
    "bias_step": "the sensor's reading jumps by {step} at {time_s} of {bag}",
    "wrench_delay": "the wrenches are {delay_s} late against the joints",
    "sensor_saturation": "the sensor's {axis} clips at {limit}",
    "tool_mass_error": "the tool's true mass differs from its file's by {delta_kg}",
    "tool_com_error": "the tool's centre of mass lies elsewhere than its file says, by {delta_m}",
    "loose_tool": "the tool is loose and sags by {shift_m} in its mount",
    "cable_drag": "a cable pulls at the tool with {tension_N}",
    "inertial_load": "forces of acceleration of {mass_kg} are missing in the model",
    "joint_compliance": "the arm's stiffness is not the nominal one: {stiffness}",
    "deflection_hysteresis": "the deflection has hysteresis and keeps {residual_fraction} of itself"
    " when the load is gone",
    "backlash": "the {joint} joint has a backlash of {gap_rad}",
    "tracker_delay": "the tracker's stamps are {delay_s} late",
    "tracker_scale": "the tracker's positions are {gain} too large",
    "base_shift": "the base marker's stand moves at {time_s} of push, by {translation_m} and"
    " {rotvec_rad}",
}

_AXES = {3: ("x", "y", "z"), 6: WRENCH_AXES}
_ROTATIONS = ("rotvec_rad",)


class Unit(NamedTuple):
    """What an SI number is multiplied by, and the unit after it."""

    factor: float
    name: str


def unit_of(name: str, axis: str | None = None) -> Unit:
    """The unit that people read a parameter in; axis: of the wrench, where it has one."""
    torque = axis is not None and axis.startswith("t")
    if name == "limit":
        return Unit(1e3, " mN.m") if torque else Unit(1.0, " N")
    if name == "step":
        return Unit(1e3, " mN.m") if torque else Unit(1.0, " N")
    if name == "rate_per_hour":
        return Unit(1e3, " mN.m/h") if torque else Unit(1.0, " N/h")
    if name in ("gain", "residual_fraction"):
        return Unit(100.0, " %")
    if name in ("roll", "tilt"):  # of a stiffness
        return Unit(1.0, " N.m/rad")
    if name in ("carriage", "rod"):
        return Unit(1e-3, " N/mm")
    for end, unit in (
        ("_rad", Unit(math.degrees(1.0), "°")),
        ("_kg", Unit(1e3, " g")),
        ("delay_s", Unit(1e3, " ms")),
        ("_s", Unit(1.0, " s")),
        ("_m", Unit(1e3, " mm")),
        ("_N", Unit(1.0, " N")),
    ):
        if name.endswith(end):
            return unit
    return Unit(1.0, "")


def coefficient_unit(source: str, target: str) -> Unit:
    """Of a crosstalk from one axis to another."""
    if source[:1] == target[:1]:
        return Unit(100.0, " %")
    return Unit(1e3, " mN.m/N") if target.startswith("t") else Unit(1.0, " N/N.m")


def with_interval(value: Interval, unit: Unit) -> str:
    """`0.584° (0.571 to 0.597)`: as many digits as the interval is worth."""
    number = value.value * unit.factor
    if value.low is None or value.high is None:
        return f"{plain(number, abs(number) / 20.0)}{unit.name}"
    low, high = value.low * unit.factor, value.high * unit.factor
    half = 0.5 * (high - low)
    return f"{plain(number, half)}{unit.name} ({plain(low, half)} to {plain(high, half)})"


def plain(number: float, uncertainty: float) -> str:
    """A number to two digits of its uncertainty where that starts with 1 or 2, else to one."""
    if not math.isfinite(number):
        return "?"
    if not (uncertainty > 0.0 and math.isfinite(uncertainty)):
        return f"{number:.3g}"
    decimals = math.ceil(math.log10(3.0 / uncertainty) - 1e-9)
    text = f"{number:.{min(max(decimals, 0), 9)}f}"
    return text.removeprefix("-") if float(text) == 0.0 else text


def parameter_words(effect: str, name: str, parameters: dict[str, Any]) -> str:
    """A parameter with interval and unit; of a vector those parts that aren't 0."""
    value = parameters[name]
    if isinstance(value, str):
        return value
    if isinstance(value, dict):
        return ", ".join(f"{part} {parameter_words(effect, part, value)}" for part in value)
    if isinstance(value, Interval):
        if name == "coefficient":
            unit = coefficient_unit(str(parameters.get("from", "")), str(parameters.get("to", "")))
        else:
            unit = unit_of(name, _word(parameters, "axis"))
        return with_interval(value, unit)
    if isinstance(value, list | tuple) and value and isinstance(value[0], Interval):
        return _vector_words(name, value)
    if isinstance(value, int | float) and not isinstance(value, bool):
        unit = unit_of(name, _word(parameters, "axis"))
        return f"{value * unit.factor:.4g}{unit.name}"
    return str(value)


def _word(parameters: dict[str, Any], name: str) -> str | None:
    value = parameters.get(name)
    return value if isinstance(value, str) else None


def _vector_words(name: str, parts: Sequence[Interval]) -> str:
    axes = _AXES.get(len(parts), tuple(str(number) for number in range(len(parts))))
    between = " about " if name in _ROTATIONS else " in "
    sure = [k for k, part in enumerate(parts) if _not_zero(part)]
    shown = sure or [max(range(len(parts)), key=lambda k: abs(parts[k].value))]
    return ", ".join(
        f"{with_interval(parts[k], unit_of(name, axes[k] if len(parts) == 6 else None))}"
        f"{between}{axes[k]}"
        for k in shown
    )


def _not_zero(part: Interval) -> bool:
    if part.low is None or part.high is None:
        return part.value != 0.0
    return part.low > 0.0 or part.high < 0.0


def cause_words(cause: Cause) -> str:
    """What an effect does, as a part of a sentence with its numbers."""
    parameters = cause.parameters
    words = {name: parameter_words(cause.effect, name, parameters) for name in parameters}
    template = SENTENCES.get(cause.effect, "{missing}")
    try:
        return template.format(**words, joint=cause.joint)
    except KeyError:  # an effect or a parameter without words
        others = ", ".join(f"{name} {text}" for name, text in words.items())
        return f"{title(cause.label)} ({others})" if others else title(cause.label)


def title(identity: str) -> str:
    """An effect's name for people; identity: with its joint, `effect:joint`, where it has one."""
    effect, _, joint = identity.partition(":")
    words = TITLES.get(effect, effect.replace("_", " "))
    if "{joint}" in words:
        return words.format(joint=joint or "?")
    return f"{words} of the {joint} joint" if joint else words


_MOST_PLACES = 3
_NAMED_SHARE = 0.1
_MOST_TWINS = 4
_SURE = 0.9
"""A cause as likely as this is there, whatever else is."""


def sentence(answer: Answer) -> str:
    """The verdict, what causes the gap with its numbers, how much of it that explains, where."""
    if answer.verdict == "none":
        return (
            "No gap: the recording is what the model says, but for noise and what a healthy arm"
            " may be off."
        )
    where = _where(answer.where)
    if answer.verdict == "unknown":
        best = _best_of_list(answer)
        left = _left(answer)
        return f"There is a gap that nothing on the list explains{best}.{left}{where}"
    if answer.verdict == "ambiguous":
        return _ambiguous(answer) + where
    return _identified(answer) + where


def _identified(answer: Answer) -> str:
    parts = [cause_words(cause) for cause in answer.causes]
    if len(parts) == 1:
        text = f"{_capital(parts[0])}: this explains{_closed(answer.gap)} of the gap."
    else:
        text = (
            f"{_capital('; '.join(parts[:-1]))}; and {parts[-1]}: together they explain"
            f"{_closed(answer.gap)} of the gap."
        )
    return text + "".join(_twins(cause) for cause in answer.causes)


def _ambiguous(answer: Answer) -> str:
    sure = [cause for cause in answer.causes if cause.probability >= _SURE]
    open_ = [cause for cause in answer.causes if cause.probability < _SURE]
    told = [cause_words(cause) for cause in sure]
    maybe = [_one_of(cause) for cause in open_]
    if told:
        text = f"{_capital('; and '.join(told))}."
        if maybe:
            text += (
                f" Whether there is more, this recording can't tell: perhaps {', or '.join(maybe)}."
            )
        text += "".join(_twins(cause) for cause in sure)
    elif maybe:
        text = "There is a gap, and this recording can't tell what causes it: "
        text += f"{', or '.join(maybe)}."
    else:
        return "There is a gap, and this recording can't tell what causes it."
    return f"{text} What is found explains{_closed(answer.gap)} of the gap."


def _one_of(cause: Cause) -> str:
    """An open cause with its probability and what can't be told from it."""
    text = f"{cause_words(cause)} ({cause.probability:.0%})"
    return f"{text}, or {_names(cause.equivalent)}" if cause.equivalent else text


def _twins(cause: Cause) -> str:
    if not cause.equivalent:
        return ""
    return f" This recording can't tell it from: {_names(cause.equivalent)}."


def _names(effects: Sequence[str]) -> str:
    """Some of them by name; of something faint it may be nearly all effects."""
    if len(effects) > _MOST_TWINS:
        return f"one of {len(effects)} other effects"
    return " or ".join(f"{title(name)} ({name})" for name in effects)


def _best_of_list(answer: Answer) -> str:
    known = [(name, p) for name, p in answer.ranking if name not in ("none", "unknown")]
    if not known or known[0][1] < 0.01:
        return ""
    name, probability = known[0]
    return f" (the nearest is {title(name)}, {probability:.0%})"


def _left(answer: Answer) -> str:
    if not answer.left_over:
        return ""
    return f" What the nearest leaves goes with: {answer.left_over[0]['what']}."


def _closed(gap: dict[str, Any]) -> str:
    closed = gap.get("closed_fraction")
    if not closed or closed.get("value") is None:
        return " an unknown part"
    text = f" {closed['value']:.0%}"
    interval = closed.get("ci95")
    return text + (f" ({interval[0]:.0%} to {interval[1]:.0%})" if interval else "")


def _where(where: dict[str, Any]) -> str:
    """The channels and bags that hold most of it."""
    phrases = []
    for name, preposition in (("channels", "in"), ("bags", "of")):
        shares = [(key, share) for key, share in where.get(name, {}).items() if share]
        shares = sorted(shares, key=lambda one: -one[1])[:_MOST_PLACES]
        shares = [one for one in shares if one[1] >= _NAMED_SHARE] or shares[:1]
        if shares:
            parts = " and ".join(f"{key} ({share:.0%})" for key, share in shares)
            phrases.append(f"{preposition} {parts}")
    if not phrases:
        return ""
    text = f" The gap lies {', '.join(phrases)}"
    follows = where.get("joints", {}).get("follows", [])
    if follows and follows[0]["p"] < 0.05 and follows[0]["part"] >= 0.3:
        text += f"; {follows[0]['part']:.0%} of it in the sweep follow {follows[0]['joint']}"
    return text + "."


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]
