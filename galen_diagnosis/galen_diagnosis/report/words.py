# SPDX-License-Identifier: Apache-2.0
"""A diagnosis in words: effects, parameters in the units that people read, what to do next."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from typing import Any

from galen_model.arm.galen import WRENCH_AXES
from galen_sim_driver.effects.registry import EFFECTS

from galen_diagnosis.answer.answer import (
    NONE,
    RESIDUAL,
    SURE,
    UNKNOWN,
    Answer,
    BudgetItem,
    Excluded,
    FoundCause,
    Interval,
)
from galen_diagnosis.effects.registry import RECORDS
from galen_diagnosis.observation.recording import DiagnosticRecording
from galen_diagnosis.observation.specification import DEFAULT

RANKING_NOTE = (
    "Each probability is that of one cause being there; several can be there together, so they"
    " need not add up to 100 %."
)
VERDICTS = {
    NONE: "Within specification",
    "identified": "Cause found",
    "ambiguous": "Several causes are possible",
    UNKNOWN: "A gap without a known cause",
}
_NO_EFFECT = {NONE: "nothing is missing", UNKNOWN: "something that is not on the list"}

_AXES = {3: ("x", "y", "z"), 6: WRENCH_AXES}
_ROTATIONS = ("rotvec_rad",)


_Unit = tuple[float, str]
"""What an SI number is multiplied by, and the unit after it."""

_FORCES: dict[str, tuple[_Unit, _Unit]] = {
    "limit": ((1.0, " N"), (1e3, " mN.m")),
    "step": ((1.0, " N"), (1e3, " mN.m")),
    "rate_per_hour": ((1.0, " N/h"), (1e3, " mN.m/h")),
}
_UNITS: dict[str, _Unit] = {
    "gain": (100.0, " %"),
    "residual_fraction": (100.0, " %"),
    "fraction": (100.0, " %"),
    "k": (1.0, " N.m/rad"),
    "carriage": (1e-3, " N/mm"),
    "rod": (1e-3, " N/mm"),
}
_ENDINGS: dict[str, _Unit] = {
    "_rad": (math.degrees(1.0), "°"),
    "_kg": (1e3, " g"),
    "delay_s": (1e3, " ms"),
    "_s": (1.0, " s"),
    "_m": (1e3, " mm"),
    "_N": (1.0, " N"),
}


def unit_of(name: str, axis: str | None = None) -> _Unit:
    """Return the unit that people read a parameter in.

    Args:
        name: The parameter's name in the contract; its ending is an SI unit where it has one.
        axis: Of the wrench, where it has one.

    Returns:
        Factor on the SI number, and the unit with its space; 1 and nothing where none is known.

    """
    if name in _FORCES:
        return _FORCES[name][axis is not None and axis.startswith("t")]
    if name in _UNITS:
        return _UNITS[name]
    return next((unit for end, unit in _ENDINGS.items() if name.endswith(end)), (1.0, ""))


def _coefficient_unit(source: str, target: str) -> _Unit:
    """Of a crosstalk from one axis to another."""
    if source[:1] == target[:1]:
        return 100.0, " %"
    return (1e3, " mN.m/N") if target.startswith("t") else (1.0, " N/N.m")


def with_interval(value: Interval, unit: _Unit) -> str:
    """Write `0.584° (0.571 to 0.597)`, with as many digits as the interval is worth.

    Args:
        value: In SI.
        unit: Factor on the SI number, and the unit with its space.

    Returns:
        The text; of an angle without an interval also in mrad.

    """
    factor, name = unit
    number = value.value * factor
    if value.low is None or value.high is None:
        text = f"{plain(number, abs(number) / 20.0)}{name}"
        return f"{text} ({1e3 * value.value:.3g} mrad)" if name == "°" else text
    low, high = value.low * factor, value.high * factor
    half = 0.5 * (high - low)
    return f"{plain(number, half)}{name} ({plain(low, half)} to {plain(high, half)})"


def plain(number: float, uncertainty: float) -> str:
    """Write a number to two digits of its uncertainty from 1 to 3, else to one.

    Args:
        number: In the unit that is written.
        uncertainty: In the same unit; where it isn't above 0 and finite, three digits are written.

    Returns:
        The text, never of a negative zero; `?` of what isn't finite.

    """
    if not math.isfinite(number):
        return "?"
    if not (uncertainty > 0.0 and math.isfinite(uncertainty)):
        return f"{number:.3g}"
    decimals = math.ceil(math.log10(3.0 / uncertainty) - 1e-9)
    text = f"{number:.{min(max(decimals, 0), 9)}f}"
    return text.removeprefix("-") if float(text) == 0.0 else text


def parameter_words(name: str, parameters: dict[str, Any]) -> str:
    """Write a parameter with interval and unit; of a vector those parts that aren't 0.

    Args:
        name: The parameter's name in the contract.
        parameters: All of the effect's: the axes among them decide units.

    Returns:
        The text.

    """
    value = parameters[name]
    if isinstance(value, dict):
        return ", ".join(f"{part} {_stiffness_words(part, value[part])}" for part in value)
    if isinstance(value, Interval):
        if name == "coefficient" and "axis" in parameters:
            per = "/(N.m)" if str(parameters["axis"]).startswith("t") else "/N"
            return with_interval(value, (1.0, per))
        if name == "coefficient":
            ends = (str(parameters.get(end, "")) for end in ("from", "to"))
            return with_interval(value, _coefficient_unit(*ends))
        return with_interval(value, unit_of(name, parameters.get("axis")))
    if isinstance(value, list | tuple) and value and isinstance(value[0], Interval):
        return _vector_words(name, value)
    if isinstance(value, int | float) and not isinstance(value, bool):
        factor, unit = unit_of(name, parameters.get("axis"))
        return f"{value * factor:.4g}{unit}"
    return str(value)


def _stiffness_words(of: str, value: Any) -> str:
    """Return a stiffness; of a joint it is N.m/rad."""
    return with_interval(value, _UNITS.get(of, _UNITS["k"]))


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


def cause_words(cause: FoundCause) -> str:
    """Write what an effect does, as a part of a sentence with its numbers.

    Args:
        cause: One that was found.

    Returns:
        The record's sentence, filled in; the title with all parameters where that can't be.

    """
    parameters = cause.parameters
    words = {name: parameter_words(name, parameters) for name in parameters}
    angles = [f"{words[name]} about {name[6]}" for name in words if name.startswith("about_")]
    if angles:
        words["inclination"] = " and ".join(angles)
    try:
        return RECORDS[cause.effect].sentence.format(**words, joint=cause.joint or "measured")
    except KeyError:  # an effect or a parameter without words
        others = ", ".join(f"{name} {text}" for name, text in words.items())
        return f"{title(cause.label)} ({others})" if others else title(cause.label)


def title(identity: str) -> str:
    """Name an effect for people.

    Args:
        identity: With its joint, `effect:joint`, where it has one; or `none`, `unknown`.

    Returns:
        The name.

    """
    effect, _, joint = identity.partition(":")
    record = RECORDS.get(effect)
    words = record.title if record else _NO_EFFECT.get(effect, effect.replace("_", " "))
    if "{joint}" in words:
        return words.format(joint=joint or "?")
    return f"{words} of the {joint} joint" if joint else words


def p_words(p: float | None) -> str:
    """Write a p-value; below 0.001 the null wasn't drawn often enough for more digits.

    Args:
        p: Corrected for all cells of a view; None where it isn't known.

    Returns:
        The text.

    """
    if p is None:
        return "-"
    return "≤ 0.001" if p <= 0.001 else f"{p:.3f}"


def share_words(share: dict[str, Any] | Interval | None) -> str:
    """Write a closed fraction with its interval.

    Args:
        share: As in diagnosis.json or before; None where it isn't known.

    Returns:
        Percent; `-` where it isn't known.

    """
    known = share.to_json() if isinstance(share, Interval) else share
    if not known or known.get("value") is None:
        return "-"
    text, interval = f"{known['value']:.0%}", [f"{end:.0%}" for end in known.get("ci95") or ()]
    return text if set(interval) <= {text} else f"{text} ({' to '.join(interval)})"


def probability_words(probability: float) -> str:
    """Write a probability without pretending to certainty.

    Args:
        probability: 0 ... 1.

    Returns:
        Percent.

    """
    if not 0.001 <= probability <= 0.999:
        return "more than 99.9 %" if probability > 0.5 else "less than 0.1 %"
    return f"{100.0 * probability:.{0 if 0.01 <= probability <= 0.99 else 1}f} %"


_WORDS = {"about": "about", "from": "of", "to": "in", "bag": "in the middle of", "joint": "at"}


def missed_words(one: Excluded) -> str:
    """Write the largest size of an effect that would have been missed, or why it isn't known.

    Args:
        one: An effect that was sought and not found.

    Returns:
        The text.

    """
    limits = one.missed_below or one.missed_above
    if limits is None:
        return one.because
    values = {name: _bare(value) for name, value in limits.items()}
    words = [f" {_WORDS[name]} {value}" for name, value in values.items() if name in _WORDS]
    sizes = []
    for name in (name for name in values if name not in _WORDS):
        text = parameter_words(name, values)
        about = f" about {name[6]}" if name.startswith("about_") else ""
        sizes.append(f"down to {text}" if name == "stiffness" else text + about)
    start = "beyond the largest readings: " if one.missed_above else ""
    because = f"; {one.because}" if one.because else ""
    return start + ", ".join(sizes) + "".join(words) + because


def _bare(value: Any) -> Any:
    """Return numbers as intervals of which nothing is known."""
    if isinstance(value, dict):
        return {name: _bare(part) for name, part in value.items() if part is not None}
    if isinstance(value, list):
        return [_bare(math.nan if part is None else part) for part in value]
    return Interval(value, None, None) if isinstance(value, float) else value


# The sentence


_LIMIT_UNITS: dict[str, _Unit] = {
    "rad": (1e3, " mrad"),
    "m": (1e3, " mm"),
    "kg": (1e3, " g"),
    "s": (1e3, " ms"),
    "N": (1.0, " N"),
    "": (100.0, " %"),
}
_LIMIT_PARTS = {"force_N_per_hour": (1.0, " N/h"), "torque_Nm_per_hour": (1e3, " mN.m/h")}


def limit_words(effect: str, by_part: Mapping[str, float]) -> str:
    """Write a specification's limits of an effect, of its parts where they differ.

    Args:
        effect: Its name.
        by_part: Limits by joint, axis or `default`, in the effect's unit.

    Returns:
        The text.

    """
    unit = EFFECTS[effect].fitted[0].unit
    words = {}
    for part, limit in by_part.items():
        own = f" {unit.replace('N', '(N.m)') if part.startswith('t') else unit}"
        factor, name = _LIMIT_PARTS.get(part, _LIMIT_UNITS.get(unit, (1.0, own)))
        words[part] = f"{limit * factor:.4g}{name}"
    others = [
        text if part in _LIMIT_PARTS else f"{part} {text}"
        for part, text in words.items()
        if part != DEFAULT
    ]
    return ", ".join(([words[DEFAULT]] if DEFAULT in words else []) + others)


def limit_of_parameter(name: str, of: BudgetItem) -> str:
    """Write a budget's limits of a parameter in the parameter's unit, one where all are alike.

    Args:
        name: A parameter that has a limit.
        of: The budget's entry of the effect.

    Returns:
        The text.

    """
    limit = of.limits[name]
    each = limit if isinstance(limit, list) else [limit]
    axes = _AXES[len(each)] if len(each) in _AXES else ("",) * len(each)
    words = []
    for axis, one in zip(axes, each, strict=True):
        exact = {**of.parameters, name: Interval(one, None, None)}
        if len(each) > 1:
            exact["axis"] = axis
        words.append(parameter_words(name, exact))
    return ", ".join(dict.fromkeys(words))


def _made_of(answer: Answer) -> str:
    """Return what is left of the gap, its largest parts first."""
    known = [one for one in answer.budget if one.label != RESIDUAL][:_MOST_PARTS]
    if not known:
        return ""
    parts = ", ".join(f"{title(one.label)} {one.share.value:.0%}" for one in known)
    return f" What the nominal model leaves is made of: {parts}."


_HALF = 0.5
_MOST_PARTS = 3
_MOST_TWINS = 6


def sentence(answer: Answer) -> str:
    """Write the verdict: causes with their numbers and probability, how much of the gap closes.

    Args:
        answer: All but its sentence.

    Returns:
        One sentence or several.

    """
    chances = dict(answer.ranking)
    if answer.verdict == NONE:
        chance = probability_words(chances.get(NONE, 0.0))
        if answer.specification is None:  # of a joint's runs
            return f"No gap beyond noise: the nominal model holds, probability {chance}."
        name = answer.specification["name"]
        if answer.reference:
            since = ", ".join(answer.reference)
            return f"Unchanged since {since} but for {name}, probability {chance}."
        return f"Within specification ({name}), probability {chance}.{_made_of(answer)}"
    if answer.verdict == UNKNOWN:
        text = f"There is a gap that no effect on the list explains{_best_of_list(answer)}"
        unlisted = chances.get(UNKNOWN, 0.0)
        if unlisted >= _HALF:
            text += f", probability {probability_words(unlisted)}."
        else:
            text += ": what fits best doesn't hold on readings that its fit hasn't seen."
        if answer.remaining:
            text += f" What remains varies systematically: {answer.remaining[0]['what']}."
        return text
    causes = [cause for cause in answer.causes if cause.effect != UNKNOWN]
    words = _ambiguous if answer.verdict == "ambiguous" else _identified
    text = f"Since {', '.join(answer.reference)}: " if answer.reference else ""
    text += words(causes, _closed(answer.gap))
    if len(causes) < len(answer.causes):
        text += " The rest is more than noise, and unknown."
    return text + " Brackets: 95 % intervals."


def _identified(causes: Sequence[FoundCause], closed: str) -> str:
    parts = [cause_words(cause) for cause in causes]
    chance = probability_words(min(cause.probability for cause in causes))
    together = "; and ".join(filter(None, ("; ".join(parts[:-1]), parts[-1])))
    it = "it" if len(parts) == 1 else "them"
    text = f"{_capital(together)}. Probability {chance}; with {it} in the model {closed} of the gap"
    return f"{text} closes." + "".join(_twins(cause) for cause in causes)


def _ambiguous(causes: Sequence[FoundCause], closed: str) -> str:
    sure = [cause for cause in causes if cause.probability >= SURE]
    maybe = ", or ".join(_one_of(cause) for cause in causes if cause.probability < SURE)
    text = "There is a gap, and this recording doesn't show what causes it"
    text += f": {maybe}." if maybe else "."
    if sure:
        chance = probability_words(min(cause.probability for cause in sure))
        text = f"{_capital('; and '.join(map(cause_words, sure)))}. Probability {chance}."
        if maybe:
            text += f" Whether there is more, this recording can't decide: perhaps {maybe}."
        text += "".join(map(_twins, sure))
    return f"{text} With the likeliest set in the model {closed} of the gap closes."


def _one_of(cause: FoundCause) -> str:
    """Return an open cause with its probability and its equivalents."""
    text = f"{cause_words(cause)}, probability {probability_words(cause.probability)}"
    return f"{text}, or {_names(cause.equivalent)}" if cause.equivalent else text


def _twins(cause: FoundCause) -> str:
    if not cause.equivalent:
        return ""
    return f" This recording can't distinguish it from: {_names(cause.equivalent)}."


def _names(effects: Sequence[str]) -> str:
    """Return some of them by name; of something faint it may be nearly all effects."""
    if len(effects) > _MOST_TWINS:
        return f"one of {len(effects)} other effects"
    return " or ".join(f"{title(name)} ({name})" for name in effects)


def _best_of_list(answer: Answer) -> str:
    known = [(name, p) for name, p in answer.ranking if name not in (NONE, UNKNOWN)]
    if not known or known[0][1] < 0.01:
        return ""
    name, probability = known[0]
    return f" (the nearest is {title(name)}, {probability:.0%})"


def _closed(gap: dict[str, Any]) -> str:
    words = share_words(gap.get("closed_fraction"))
    return "an unknown part" if words == "-" else words


# What to do next, and with what


def next_steps(answer: Answer) -> list[str]:
    """Return what to do: corrections, the next experiment, or nothing.

    Args:
        answer: What was found.

    Returns:
        Sentences in the order in which to do them, one at least.

    """
    if answer.verdict == NONE:
        return ["Nothing. What was tested and excluded, and from which size on, is below."]
    steps = []
    for cause in answer.causes:
        record = RECORDS.get(cause.effect)
        if answer.verdict == UNKNOWN or cause.probability < SURE or record is None:
            continue
        step = record.remedy.format(joint=cause.joint or "measured")
        if cause.equivalent:
            step = f"rule out {_names(cause.equivalent)}; then {step}"
        steps.append(f"{_capital(step)}.")
    steps += answer.corrections
    if answer.next_experiment:
        steps.append(_capital(str(answer.next_experiment["do"])))
    if answer.verdict == UNKNOWN:
        steps.append(
            "Look where the residual lies and what it varies with for something that the list"
            " lacks (contact, a loose part, another instrument's fault); change it, record again."
        )
    elif not steps:
        steps.append("Record again, with the tracker and more poses: no single experiment separates"
                     " the causes.")  # fmt: skip
    return steps


def data_words(recording: DiagnosticRecording) -> tuple[tuple[str, str], ...]:
    """Return what was diagnosed, against what and by which program.

    Args:
        recording: What was diagnosed.

    Returns:
        Pairs of a word and what it was.

    """
    bags = (
        f"{name} ({bag.wrench_s[-1]:.0f} s{', tracker' if bag.tool_marker else ''})"
        for name, bag in recording.bags.items()
    )
    tool, limits = recording.tool, recording.specification
    of = f" ({limits.source})" if limits.source else ""
    measured: tuple[tuple[str, str], ...]
    if recording.readings is None:
        measured = (
            ("recording", recording.name),
            ("bags", ", ".join(bags)),
            ("arm", recording.arm.name),
            ("calibration file", f"{tool.tool}, of {tool.calibrated_at}"),
            ("nominal model", recording.nominal),
        )
    else:
        file = f"{tool.tool}, of {tool.calibrated_at}" if tool.calibrated_at else "none"
        measured = (
            ("table", recording.name),
            *(("readings", note) for note in recording.readings.notes),
            ("calibration file", file),
        )
    return (
        *measured,
        ("specification", f"{limits.name}{of}"),
        ("program", f"galen_diagnosis {_version()}"),
    )


def _version() -> str:
    try:
        return version("galen_diagnosis")
    except PackageNotFoundError:  # by `pip install .` all packages are one distribution
        return version("galen")


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]
