"""What a diagnosis said of a blind recording, as it is scored."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from galen_model.files.json_fields import FieldError, get, items, mapping, number, text, texts

from galen_diagnosis.answer.answer import NONE, UNKNOWN

VERDICTS = (NONE, "identified", "ambiguous", UNKNOWN)


@dataclass(frozen=True)
class Said:
    """An answer.

    causes: effect to its parameters as `diagnosis.json` has them; equivalent: effects that were
    said to be the same as one of the causes. ranking: probabilities by name. closed: the closed
    fraction, None where it wasn't told. seconds: wall time of the diagnosis.
    """

    recording: str
    verdict: str
    causes: Mapping[str, Mapping[str, Any]]
    equivalent: frozenset[str]
    ranking: Mapping[str, float]
    closed: float | None = None
    seconds: float | None = None

    @property
    def first(self) -> str:
        """The ranking's first, whatever its order in the file; of equal ones the first there."""
        return max(self.ranking, key=lambda name: self.ranking[name])

    @property
    def named(self) -> frozenset[str]:
        """All effects that the answer names: causes and those equivalent to them."""
        return frozenset(self.causes) | self.equivalent

    def probability(self, name: str) -> float:
        """Of a name of the ranking; 0 for one that isn't there."""
        return self.ranking.get(name, 0.0)


def said_from_json(recording: str, content: Any, seconds: float | None = None) -> Said:
    """From `diagnosis.json`; raises FieldError."""
    answer = mapping(content, "answer")
    verdict = text(get(answer, "verdict"), "verdict")
    if verdict not in VERDICTS:
        raise FieldError(f"verdict is {verdict!r:.40}; expected one of {', '.join(VERDICTS)}")
    ranking = {
        text(get(mapping(row, "ranking"), "effect"), "effect"): number(
            get(row, "probability"), "probability"
        )
        for row in items(get(answer, "ranking"), "ranking")
    }
    if not ranking or any(not 0.0 <= p <= 1.0 + 1e-9 for p in ranking.values()):
        raise FieldError("ranking is empty, or has a probability outside 0 ... 1")
    causes = [mapping(cause, "cause") for cause in items(get(answer, "causes"), "causes")]
    closed = mapping(get(answer, "gap"), "gap").get("closed_fraction")
    value = None if closed is None else get(mapping(closed, "closed_fraction"), "value")
    return Said(
        recording=recording,
        verdict=verdict,
        causes={
            text(get(c, "effect"), "effect"): dict(mapping(get(c, "parameters"), "parameters"))
            for c in causes
        },
        equivalent=frozenset(
            name for cause in causes for name in texts(cause.get("equivalent", ()), "equivalent")
        ),
        ranking=ranking,
        closed=None if value is None else number(value, "closed_fraction"),
        seconds=seconds,
    )
