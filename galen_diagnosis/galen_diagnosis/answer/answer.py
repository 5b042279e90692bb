# SPDX-License-Identifier: Apache-2.0
"""The result of a diagnosis: the contract's `diagnosis.json` (section 7), and what is behind it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from galen_model.arrays import Array
from galen_sim_driver.effects.effect import Effect

from galen_diagnosis.observation.rows import ResidualRows, Stream

if TYPE_CHECKING:
    from galen_diagnosis.experiment.next_experiment import Experiment

Verdict = Literal["none", "identified", "ambiguous", "unknown"]

NONE = "none"
UNKNOWN = "unknown"
RESIDUAL = "residual"
"""Of a budget: what no effect in it makes."""
SURE = 0.9
"""Probability from which a cause counts as found."""
NO_GAP = 0.5
"""A gap is reported only where one is likelier than none."""


class Interval(NamedTuple):
    """A value and its 95 % interval, None where it isn't known."""

    value: float
    low: float | None
    high: float | None

    def to_json(self) -> dict[str, Any]:
        """Return `{"value": .., "ci95": [.., ..]}`."""
        if self.low is None or self.high is None:
            return {"value": _number(self.value), "ci95": None}
        return {"value": _number(self.value), "ci95": [_number(self.low), _number(self.high)]}


@dataclass(frozen=True)
class FoundCause:
    """One effect that was found; `joint` where it is at one.

    parameters: name to interval, to a list or a mapping of them, or to a word (`axis`, `bag`).
    equivalent: identities of effects that this recording can't distinguish from it. model: which of
    the effect's models fits best, in words, where it has several.
    """

    effect: str
    probability: float
    parameters: dict[str, Any]
    equivalent: tuple[str, ...]
    gap_closed: Interval | None
    joint: str | None = None
    model: str = ""

    @property
    def label(self) -> str:
        """The effect with its joint, as tables have it."""
        return f"{self.effect}:{self.joint}" if self.joint else self.effect


@dataclass(frozen=True)
class BudgetItem:
    """One effect's part of the whole gap, or the residual's, which has no more than a share.

    label: with its joint, where it has one. parameters: of a cause; limits: of the specification,
    one number or several, by the parameter that it limits. probability_beyond: that a number is
    beyond its limit, None where that is not known. equivalent: identities of effects that the data
    can't separate from it.
    """

    label: str
    share: Interval
    parameters: dict[str, Any] = field(default_factory=dict)
    limits: dict[str, Any] = field(default_factory=dict)
    probability_beyond: float | None = None
    equivalent: tuple[str, ...] = ()

    @property
    def standing(self) -> Literal["within", "beyond", "undecided"] | None:
        """Where it lies by the specification, None where that has no limit."""
        if self.probability_beyond is None:
            return "undecided" if self.limits else None
        if self.probability_beyond >= SURE:
            return "beyond"
        return "within" if self.probability_beyond <= 1.0 - SURE else "undecided"

    def to_json(self) -> dict[str, Any]:
        """Return an entry of `budget`."""
        if self.label == RESIDUAL:
            return {"effect": RESIDUAL, "share": self.share.to_json()}
        named = {name: _limited(v, self.limits.get(name)) for name, v in self.parameters.items()}
        return {
            "joint": None,
            **_at(self.label),
            "parameters": named,
            "specification": self.standing,
            "probability_beyond": self.probability_beyond,
            "equivalent": list(self.equivalent),
            "share": self.share.to_json(),
        }


def _limited(value: Any, limit: Any) -> Any:
    if isinstance(value, Interval):
        return {**value.to_json(), **({} if limit is None else {"limit": limit})}
    if isinstance(value, list | tuple):
        each = limit if isinstance(limit, list) else [limit] * len(value)
        return [_limited(part, own) for part, own in zip(value, each, strict=True)]
    if isinstance(value, dict):
        return {name: _limited(part, None) for name, part in value.items()}
    return value


@dataclass(frozen=True)
class Excluded:
    """An effect that was sought and not found; label: with its joint, where it has one.

    missed_below: the contract's parameters at the largest size that would have been missed; None
    where the effect isn't excluded at any size, for the reason `because`. missed_above: of a limit
    that no reading reached.
    """

    label: str
    missed_below: dict[str, Any] | None = None
    missed_above: dict[str, Any] | None = None
    because: str = ""

    def to_json(self) -> dict[str, Any]:
        """Return an entry of `tested`."""
        above = {} if self.missed_above is None else {"missed_above": self.missed_above}
        because = {"because": self.because} if self.because else {}
        return {**_at(self.label), "missed_below": self.missed_below, **above, **because}


@dataclass(frozen=True)
class Answer:
    """The whole of `diagnosis.json`; `where`, `gap`, `next_experiment` as the contract has them.

    tested: effects that were sought and not found. remaining: structure in what the best fit
    leaves, each with `what` it is a function of, `energy` over the noise's and `log_bayes` against
    noise; the clearest first. corrections: sentences on files that correct what was found. data:
    what was diagnosed and against what, by a word for each. notes: how rows were made.
    specification: name and source of the limits, None of tables. budget: what the whole gap is made
    of, the largest share first; empty without a gap. reference: recordings since which changes are
    diagnosed.
    """

    recording: str
    verdict: Verdict
    causes: tuple[FoundCause, ...]
    ranking: tuple[tuple[str, float], ...]
    where: dict[str, Any]
    gap: dict[str, Any]
    next_experiment: dict[str, Any] | None = None
    sentence: str = ""
    cannot_tell: tuple[str, ...] = ()
    tested: tuple[Excluded, ...] = ()
    remaining: tuple[dict[str, Any], ...] = ()
    corrections: tuple[str, ...] = ()
    problems: tuple[str, ...] = ()
    data: tuple[tuple[str, str], ...] = ()
    notes: tuple[str, ...] = ()
    budget: tuple[BudgetItem, ...] = ()
    specification: dict[str, str] | None = None
    reference: tuple[str, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """Return the file's content; `sentence` and the last seven are beyond the contract."""
        return {
            "schema_version": 1,
            "recording": self.recording,
            "verdict": self.verdict,
            "sentence": self.sentence,
            "causes": [_cause_to_json(cause) for cause in self.causes],
            "ranking": [{**_at(name), "probability": p} for name, p in self.ranking],
            "where": self.where,
            "gap": self.gap,
            "next_experiment": self.next_experiment,
            "specification": self.specification,
            "reference": list(self.reference) or None,
            "budget": [one.to_json() for one in self.budget],
            "cannot_tell": list(self.cannot_tell),
            "tested": [one.to_json() for one in self.tested],
            "remaining": list(self.remaining),
            "corrections": list(self.corrections),
            "problems": list(self.problems),
            "data": dict(self.data),
            "notes": list(self.notes),
        }


def _at(identity: str) -> dict[str, str]:
    """Return an effect and, where it has one, its joint."""
    effect, _, joint = identity.partition(":")
    return {"effect": effect, "joint": joint} if joint else {"effect": effect}


def _cause_to_json(cause: FoundCause) -> dict[str, Any]:
    joints: dict[str, list[str]] = {}
    for effect, _, joint in (name.partition(":") for name in cause.equivalent):
        if joint:
            joints.setdefault(effect, []).append(joint)
    return {
        **_at(cause.label),
        "probability": cause.probability,
        "model": cause.model or None,
        "parameters": {name: _value(value) for name, value in cause.parameters.items()},
        "equivalent": list(dict.fromkeys(name.partition(":")[0] for name in cause.equivalent)),
        "equivalent_joints": joints,
        "gap_closed": None if cause.gap_closed is None else cause.gap_closed.to_json(),
    }


def _value(value: Any) -> Any:
    """Intervals as they are in the contract; six of them as {"value": [6], "ci95": [[2]]}."""
    if isinstance(value, Interval):
        return value.to_json()
    if isinstance(value, dict):
        return {name: _value(part) for name, part in value.items()}
    if isinstance(value, list | tuple) and value and isinstance(value[0], Interval):
        parts = [part.to_json() for part in value]
        return {key: [part[key] for part in parts] for key in ("value", "ci95")}
    return value


def _number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


@dataclass(frozen=True)
class Diagnosis:
    """The answer and the residuals behind it.

    rows (N); held_out_before, held_out_after (N,): whitened residuals without and with the effects
    that were found, each row predicted from the folds that it isn't in; streams_before,
    streams_after: the residual in time, unknowns fitted in both. effects: as fitted to all of it,
    for the driver; empty where nothing was found. floor: mean square of a row that noise alone
    gives. healthy (N, q): how rows change by each of q tolerances of a healthy arm.
    """

    answer: Answer
    rows: ResidualRows
    held_out_before: Array
    held_out_after: Array
    streams_before: tuple[Stream, ...]
    streams_after: tuple[Stream, ...]
    effects: tuple[Effect, ...]
    floor: float
    experiment: Experiment | None = None
    healthy: Array | None = None
