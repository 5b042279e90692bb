"""Labels, which stay sealed until all answers are there, and answers, as they are scored."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any, Literal

from galen_model.files.json_fields import FieldError, get, items, mapping, number, text, texts
from galen_sim_driver.effects.registry import contract_form, identity_of

from galen_diagnosis.answer.answer import NONE, UNKNOWN

LabelKind = Literal["single", "none", "unknown", "pair", "ambiguous"]
LABEL_KINDS: tuple[LabelKind, ...] = ("single", "none", "unknown", "pair", "ambiguous")
_EFFECTS = {"single": 1, "pair": 2, "ambiguous": 1, NONE: 0, UNKNOWN: 1}


@dataclass(frozen=True)
class Label:
    """The truth about one recording.

    recording: its directory's name. effects: name and parameters each, as in `truth.json`; of an
    unknown cause the name is none of the list. strength: the word of it. d: how far the cause
    stands out in standard deviations after the nuisances, None where it wasn't measured.
    acceptable: for each effect the names, its own among them, that this recording can't separate
    from it. oracle_closed: the share of the gap that the true cause closes. plant_seed, bags: of
    the recording. sha256: of the
    directory's files (`seal.directory_sha256`).
    """

    recording: str
    kind: LabelKind
    effects: tuple[Mapping[str, Any], ...] = ()
    strength: str = ""
    d: float | None = None
    acceptable: tuple[tuple[str, ...], ...] = ()
    oracle_closed: float | None = None
    plant_seed: int = 0
    bags: tuple[str, ...] = ("sweep", "motion", "push")
    sha256: str = ""

    @property
    def names(self) -> tuple[str, ...]:
        """Identities of the effects, with the joint where they have one, in their order."""
        return tuple(identity_of(one["effect"], one["parameters"]) for one in self.effects)

    @property
    def answer(self) -> str:
        """What the first of a ranking should be: of pairs the first effect."""
        if self.kind in (NONE, UNKNOWN):
            return self.kind
        return self.names[0]

    @property
    def accepted(self) -> frozenset[str]:
        """`answer`, and what this recording can't separate from it."""
        return frozenset((self.answer, *(self.acceptable[0] if self.acceptable else ())))

    @property
    def unknown(self) -> str:
        """The kind of an unknown cause; empty for all others."""
        return self.names[0] if self.kind == UNKNOWN else ""

    def to_json(self) -> dict[str, Any]:
        """As it is sealed."""
        return asdict(self)


def label_from_json(content: Any) -> Label:
    """Read a label; raises FieldError."""
    found = dict(mapping(content, "label"))
    kind = text(get(found, "kind"), "kind")
    text(get(found, "recording"), "recording")
    if kind not in LABEL_KINDS:
        raise FieldError(f"kind is {kind!r:.40}; expected one of {', '.join(LABEL_KINDS)}")
    if strange := set(found) - {field.name for field in fields(Label)}:
        raise FieldError(f"{sorted(strange)[0]!r:.40} is no field of a label")
    effects = [mapping(effect, "effects") for effect in get(found, "effects")]
    if len(effects) != _EFFECTS[kind]:
        raise FieldError(f"a label of kind {kind} has {len(effects)} effects")
    for effect in effects:
        text(get(effect, "effect"), "effect")
        mapping(get(effect, "parameters"), "parameters")
    same = tuple(tuple(map(_renamed, names)) for names in found.get("acceptable", ()))
    bags = tuple(found.get("bags", ()))
    renamed = [contract_form(str(one["effect"]), one["parameters"]) for one in effects]
    found["effects"] = tuple({"effect": name, "parameters": of} for name, of in renamed)
    return Label(**{**found, "acceptable": same, "bags": bags})


def _renamed(name: str) -> str:
    """Name an acceptable answer by today's identity; older labels' effects had no joints."""
    return name if ":" in name else identity_of(*contract_form(name, {}))


VERDICTS = (NONE, "identified", "ambiguous", UNKNOWN)


@dataclass(frozen=True)
class ParsedAnswer:
    """An answer; effects are identities, with the joint where they have one.

    causes: effect to its parameters as `diagnosis.json` has them; equivalent: effects that are
    indistinguishable from one of the causes. ranking: probabilities by name. closed: the closed
    fraction, None without one. seconds: wall time of the diagnosis.
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
    """Return the parameters as `truth.json` has them: the joint is one of them."""
    joint = {"joint": cause["joint"]} if "joint" in cause else {}
    return {**joint, **mapping(get(cause, "parameters"), "parameters")}


def _equivalent(cause: Mapping[str, Any]) -> Iterator[str]:
    joints = mapping(cause.get("equivalent_joints", {}), "equivalent_joints")
    for effect in texts(cause.get("equivalent", ()), "equivalent"):
        if effect in joints:
            yield from (f"{effect}:{joint}" for joint in texts(joints[effect], "joints"))
        else:
            yield effect
