"""Read the answer of a diagnosis to a blind recording, as it is scored."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from galen_model.files.json_fields import FieldError, get, items, mapping, number, text, texts
from galen_sim_driver.effects.registry import identity_of

from galen_diagnosis.answer.answer import NONE, UNKNOWN

VERDICTS = (NONE, "identified", "ambiguous", UNKNOWN)


@dataclass(frozen=True)
class ParsedAnswer:
    """An answer; effects are identities, with the joint where they have one.

    causes: effect to its parameters as `diagnosis.json` has them; equivalent: effects that are
    indistinguishable from one of the causes. ranking: probabilities by name. closed: the closed
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


def parse_answer(recording: str, content: Any, seconds: float | None = None) -> ParsedAnswer:
    """From `diagnosis.json`; raises FieldError."""
    answer = mapping(content, "answer")
    verdict = text(get(answer, "verdict"), "verdict")
    if verdict not in VERDICTS:
        raise FieldError(f"verdict is {verdict!r:.40}; expected one of {', '.join(VERDICTS)}")
    ranks = [mapping(row, "ranking") for row in items(get(answer, "ranking"), "ranking")]
    ranking = {_identity(row): number(get(row, "probability"), "probability") for row in ranks}
    if not ranking or any(not 0.0 <= p <= 1.0 + 1e-9 for p in ranking.values()):
        raise FieldError("ranking is empty, or has a probability outside 0 ... 1")
    causes = [mapping(cause, "cause") for cause in items(get(answer, "causes"), "causes")]
    closed = mapping(get(answer, "gap"), "gap").get("closed_fraction")
    value = None if closed is None else get(mapping(closed, "closed_fraction"), "value")
    return ParsedAnswer(
        recording=recording,
        verdict=verdict,
        causes={_identity(cause): _parameters(cause) for cause in causes},
        equivalent=frozenset(name for cause in causes for name in _equivalent(cause)),
        ranking=ranking,
        closed=None if value is None else number(value, "closed_fraction"),
        seconds=seconds,
    )


def _identity(entry: Mapping[str, Any]) -> str:
    return identity_of(text(get(entry, "effect"), "effect"), entry)


def _parameters(cause: Mapping[str, Any]) -> dict[str, Any]:
    """The parameters as `truth.json` has them: the joint is one of them."""
    joint = {"joint": cause["joint"]} if "joint" in cause else {}
    return {**joint, **mapping(get(cause, "parameters"), "parameters")}


def _equivalent(cause: Mapping[str, Any]) -> Iterator[str]:
    joints = mapping(cause.get("equivalent_joints", {}), "equivalent_joints")
    for effect in texts(cause.get("equivalent", ()), "equivalent"):
        if effect in joints:
            yield from (f"{effect}:{joint}" for joint in texts(joints[effect], "joints"))
        else:
            yield effect
