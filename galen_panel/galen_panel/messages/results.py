"""What a behaviour's outcome means, and what can be done with it. No ROS, no NiceGUI."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from enum import Enum
from typing import NamedTuple

import numpy as np
from galen_model.evidence.verdict import TARE_COMMAND, Cause, CheckAnswer

from galen_panel.messages import texts
from galen_panel.snapshot import LOST, BehaviourKind, BehaviourOutcome, SuiteState

_CANCELED = "CANCELED"
_DONE = {
    BehaviourKind.CALIBRATE: "Calibrated",
    BehaviourKind.CHECK: "Checked",
    BehaviourKind.COLLECT: "Collected",
}


class Fate(Enum):
    """Where the file that a calibration wrote is now."""

    HERE = "here"
    ACTIVE = "active"
    REPLACED = "replaced"


class Todo(Enum):
    """What a quick check's answer asks for."""

    NOTHING = ""
    TARE = "Tare"
    CALIBRATE = "Calibrate again"
    CHECK = "Check again"


class CheckVerdict(NamedTuple):
    """A quick check's answer for a person; level: positive, warning or negative."""

    title: str
    level: str
    todo: Todo


_VERDICTS = {
    CheckAnswer.GOOD: CheckVerdict("Good: the file fits", "positive", Todo.NOTHING),
    CheckAnswer.RETARE: CheckVerdict("Tare it", "warning", Todo.TARE),
    CheckAnswer.RECALIBRATE: CheckVerdict(
        "It does not fit: calibrate again", "negative", Todo.CALIBRATE
    ),
    CheckAnswer.UNSURE: CheckVerdict("Can't tell: check again", "warning", Todo.CHECK),
}
# Another calibration would not help these.
_NOT_ON = {
    Cause.OTHER_TOOL: CheckVerdict("It does not fit: another tool is on", "negative", Todo.CHECK),
    Cause.NO_TOOL: CheckVerdict("It does not fit: no tool is on", "negative", Todo.CHECK),
}


def ended(kind: BehaviourKind, outcome: BehaviourOutcome) -> tuple[str, str]:
    """Title an outcome of any behaviour, and give its level."""
    if not outcome.error:
        return _DONE[kind], "positive"
    if outcome.error == _CANCELED:
        return "Canceled", "warning"
    if outcome.error == LOST:
        return "Lost", "negative"
    return "It failed", "negative"


def verdict(outcome: BehaviourOutcome) -> CheckVerdict:
    """Read the answer of a quick check that came to its end."""
    values = outcome.values
    try:
        answer, cause = CheckAnswer(_code(values, "answer")), Cause(_code(values, "cause"))
    except ValueError:
        return _VERDICTS[CheckAnswer.UNSURE]
    return _NOT_ON.get(cause) or _VERDICTS[answer]


def sentence_of(outcome: BehaviourOutcome) -> str:
    """Return the sentence without commands for a terminal: the page has buttons."""
    return texts.sentence(outcome.text.replace(f": {TARE_COMMAND}", ""), outcome.tool)


def fate(outcome: BehaviourOutcome, state: SuiteState) -> Fate:
    """Find where a calibration's file is: kept, discarded or replaced, from any page.

    A file is known by mass and centre, which are written with all their digits.
    """
    found = next((tool for tool in state.tools or () if tool.name == outcome.tool), None)
    if found is None or found.problem or not _is(outcome, found.mass_kg, found.com_m):
        return Fate.REPLACED
    now = state.active_tool
    if now and now.tool == outcome.tool and _is(outcome, now.mass_kg, now.com_m):
        return Fate.ACTIVE
    return Fate.HERE


def load_rows(outcome: BehaviourOutcome) -> list[list[str]]:
    """Write mass and centre that a calibration found, as texts: name, value."""
    values = outcome.values
    com, com_std = _vector(values, "com_m"), _vector(values, "com_std_m")
    rows = [["mass", texts.mass(_number(values, "mass_kg"), _number(values, "mass_std_kg"))]]
    for axis, value, std in zip("xyz", com, com_std, strict=True):
        rows.append([f"centre {axis}", f"{1e3 * value:.2f} ± {1e3 * std:.2f} mm"])
    return rows


def residual(outcome: BehaviourOutcome) -> str:
    """Say the residual of a calibration's readings."""
    force = texts.norm(_vector(outcome.values, "rmse_force_n"))
    torque = texts.norm(_vector(outcome.values, "rmse_torque_nm"))
    return f"Residual of the averaged readings: {texts.size(force, torque)}."


def collection_sentence(outcome: BehaviourOutcome) -> str:
    """Say how many pushes there are, and whether the tracker's base held."""
    values = outcome.values
    text = (
        f"{_number(values, 'pushes'):.0f} of {_number(values, 'pushes_asked'):.0f} pushes are as"
        " asked."
    )
    if values.get("calibration_holds") is False:
        text += " The tracker's base moved between begin and end: collect again."
    return text


def left_out(outcome: BehaviourOutcome) -> list[str]:
    """List poses or pushes that were not used, with their reasons."""
    found = outcome.values.get("poses_rejected") or outcome.values.get("left_out") or ()
    return [str(text) for text in found] if isinstance(found, Sequence) else []


def discard_sentences(outcome: BehaviourOutcome) -> list[str]:
    """Say what discarding a calibration does."""
    if outcome.new:
        return [
            f"{outcome.tool} had no file before: it goes off the list of tools.",
            "The new file is not deleted: it is kept beside the others, under another name.",
        ]
    return [
        f"The calibration of {outcome.tool} before comes back.",
        "The new one is kept as the one before: going back once more brings it again.",
    ]


def _is(outcome: BehaviourOutcome, mass_kg: float, com_m: Sequence[float]) -> bool:
    written = [_number(outcome.values, "mass_kg"), *_vector(outcome.values, "com_m")]
    return bool(np.allclose(written, [mass_kg, *com_m], rtol=1e-9, atol=1e-12))


def _code(values: Mapping[str, object], name: str) -> int:
    value = values.get(name)
    return value if isinstance(value, int) else -1


def _number(values: Mapping[str, object], name: str) -> float:
    value = values.get(name)
    return float(value) if isinstance(value, (int, float)) else math.nan


def _vector(values: Mapping[str, object], name: str) -> list[float]:
    value = values.get(name)
    if not isinstance(value, (Sequence, np.ndarray)) or len(value) != 3:
        return [math.nan] * 3
    return [float(part) for part in value]
