"""What a blind recording really has: the label that stays sealed until all answers are there."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any, Literal

from galen_model.files.json_fields import FieldError, get, mapping, text
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
    """A label; raises FieldError."""
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
    same = tuple(tuple(map(_identity, names)) for names in found.get("acceptable", ()))
    bags = tuple(found.get("bags", ()))
    renamed = [contract_form(str(one["effect"]), one["parameters"]) for one in effects]
    found["effects"] = tuple({"effect": name, "parameters": of} for name, of in renamed)
    return Label(**{**found, "acceptable": same, "bags": bags})


def _identity(name: str) -> str:
    """An acceptable answer, of labels from before effects had joints as well."""
    return name if ":" in name else identity_of(*contract_form(name, {}))
