# SPDX-License-Identifier: Apache-2.0
"""Labels of a set, and their seal.

The labels' text holds the set's seed, 64 random bits unless it was given, so that trying out hashes
finds no labels. Its SHA-256 is in the set from the start; the text follows when the answers are in.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, get_args

from galen_diagnosis.answer.answer import NONE, UNKNOWN
from galen_model.errors import GalenError
from galen_model.json_fields import (
    FieldError,
    check_version,
    get,
    items,
    mapping,
    parse_json,
    texts,
)
from galen_sim_driver.effects.registry import identity_of

LABELS, SEAL = "labels.json", "labels.sha256"
LabelKind = Literal[
    "single", "none", "unknown", "pair", "several", "ambiguous", "changed", "unchanged", "table"
]
KINDS: tuple[LabelKind, ...] = get_args(LabelKind)
_EFFECTS = {
    "single": (1,),
    "pair": (2,),
    "several": (3, 4, 5),
    "ambiguous": (1,),
    "changed": (1,),
    "unchanged": (0,),
    "table": (0, 1),
    NONE: (0,),
    UNKNOWN: (1,),
}


@dataclass(frozen=True)
class Label:
    """The truth about one recording.

    recording: its directory's name. effects: as in `truth.json`, some with the `member` of the
    effect's family of models that was simulated; of an unknown cause the name is none of the list.
    strength: the word of it. d: how far the cause stands out, in standard deviations after the
    nuisances. acceptable: for each effect the names, its own among them, that this recording can't
    separate from it.
    """

    recording: str
    kind: LabelKind
    effects: tuple[Mapping[str, Any], ...] = ()
    strength: str = ""
    d: float | None = None
    acceptable: tuple[tuple[str, ...], ...] = ()
    arm: str = "galen"

    @property
    def names(self) -> tuple[str, ...]:
        """Identities of the effects, with the joint where they have one, in their order."""
        return tuple(identity_of(one["effect"], one["parameters"]) for one in self.effects)

    @property
    def answer(self) -> str:
        """What the first of a ranking should be: of pairs the first effect."""
        return UNKNOWN if self.kind == UNKNOWN else (*self.names, NONE)[0]

    @property
    def wanted(self) -> tuple[frozenset[str], ...]:
        """For each effect of the list its name and those this recording can't separate from it."""
        if self.kind == UNKNOWN:
            return ()
        same = self.acceptable or ((),) * len(self.names)
        return tuple(frozenset((own, *more)) for own, more in zip(self.names, same, strict=True))

    @property
    def accepted(self) -> frozenset[str]:
        """`answer`, and what this recording can't separate from it."""
        return frozenset({self.answer}).union(*self.wanted[:1])

    @property
    def sure(self) -> bool:
        """Whether a cause is there that must be found: all but faint ones."""
        return bool(self.effects) and self.strength != "faint"

    @property
    def effect(self) -> str:
        """The first effect's name, without its joint; `none` without one."""
        return str(self.effects[0]["effect"]) if self.effects else NONE

    @property
    def member(self) -> str:
        """Which model of its family the first effect has; empty where it has but one."""
        return str(self.effects[0].get("member", "")) if self.effects else ""


def label_from_json(content: Any) -> Label:
    """Read a label as `asdict` made it.

    Args:
        content: What the JSON holds, of any type.

    Returns:
        The label.

    Raises:
        FieldError: A field is missing or malformed, or effects don't fit the kind.

    """
    found = dict(mapping(content, "label"))
    same = items(get(found, "acceptable"), "acceptable")
    effects = [mapping(one, "effects") for one in items(get(found, "effects"), "effects")]
    found |= {"effects": tuple(effects), "acceptable": tuple(texts(x, "acceptable") for x in same)}
    try:
        label = Label(**found)
        if len(label.names) not in _EFFECTS[label.kind] or len(same) not in (0, len(effects)):
            raise FieldError(f"{label.recording}: {len(effects)} effects don't make a {label.kind}")
    except (TypeError, KeyError) as error:
        raise FieldError(f"a label can't be read: {error}") from error
    return label


def beside(folder: Path, what: str) -> Path:
    """Return where a set's labels or answers lie: beside the set, not within.

    Args:
        folder: The set.
        what: `labels` or `answers`.

    Returns:
        FOLDER.WHAT, absolute.

    """
    return folder.resolve().with_name(f"{folder.resolve().name}.{what}")


def sealed(plan: Mapping[str, Any], labels: Sequence[Label]) -> tuple[str, str]:
    """Return the labels' text and its SHA-256.

    Args:
        plan: What makes the set again, its seed among them.
        labels: One for each recording.

    Returns:
        JSON text, and its hash in hexadecimal.

    """
    content = {"schema_version": 1, **plan, "labels": [asdict(label) for label in labels]}
    found = json.dumps(content, indent=1, sort_keys=True)
    return found, sha256(found)


def sha256(content: str) -> str:
    """Return the SHA-256 of a text.

    Args:
        content: Text, hashed as UTF-8.

    Returns:
        64 hexadecimal digits.

    """
    return hashlib.sha256(content.encode()).hexdigest()


def published_sha256(folder: Path) -> str:
    """Return the SHA-256 that the set published before its labels.

    Args:
        folder: The set.

    Returns:
        The hash in hexadecimal, as `labels.sha256` has it.

    Raises:
        GalenError: The file can't be read.

    """
    return _read(folder / SEAL).split(" ")[0].strip()


def open_labels(folder: Path) -> tuple[dict[str, Any], tuple[Label, ...]]:
    """Return a set's plan and labels, if they are those of the hash.

    Args:
        folder: The set; labels lie in it or beside it.

    Returns:
        The content beside the labels (version, options, seed), and the labels.

    Raises:
        GalenError: A file can't be read, isn't what was sealed, or is malformed.

    """
    published = published_sha256(folder)
    path = folder / LABELS
    if not path.exists() and (beside(folder, "labels") / LABELS).exists():
        path = beside(folder, "labels") / LABELS
    found = _read(path)
    if sha256(found) != published:
        raise GalenError(f"{path}: isn't what was sealed: its SHA-256 is not {published}")
    try:
        content = dict(mapping(parse_json(found), "labels"))
        check_version(content, 1)
        return content, tuple(map(label_from_json, items(content.pop("labels", None), "labels")))
    except FieldError as error:
        raise GalenError(f"{path}: {error}") from error


def _read(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, ValueError) as error:
        raise GalenError(f"{path}: can't be read: {error}") from error
