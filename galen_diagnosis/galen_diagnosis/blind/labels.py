"""Labels and their seal, and answers as they are scored.

The labels lie in a directory that only this user may enter. Their text begins with 32 random bytes,
so that trying out hashes finds no labels. Its SHA-256 is published first; opening shows that no
label changed since.
"""

from __future__ import annotations

import hashlib
import hmac
import json
import os
import secrets
import shutil
import stat
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Literal

from galen_model.errors import GalenError
from galen_model.files.atomic_file import write_whole
from galen_model.files.json_fields import (
    FieldError,
    get,
    items,
    mapping,
    number,
    parse_json,
    text,
    texts,
)
from galen_sim_driver.effects.registry import identity_of

from galen_diagnosis.answer.answer import NONE, UNKNOWN

LabelKind = Literal["single", "none", "unknown", "pair", "ambiguous"]
LABEL_KINDS: tuple[LabelKind, ...] = ("single", "none", "unknown", "pair", "ambiguous")
_SALT_BYTES = 32
_EFFECTS = {"single": 1, "pair": 2, "ambiguous": 1, NONE: 0, UNKNOWN: 1}


@dataclass(frozen=True)
class Label:
    """The truth about one recording.

    recording: its directory's name. effects: name and parameters each, as in `truth.json`; of an
    unknown cause the name is none of the list. strength: the word of it. d: how far the cause
    stands out in standard deviations after the nuisances, None where it wasn't measured.
    acceptable: for each effect the names, its own among them, that this recording can't separate
    from it. plant_seed, bags: of the recording. sha256: of the directory's files.
    """

    recording: str
    kind: LabelKind
    effects: tuple[Mapping[str, Any], ...] = ()
    strength: str = ""
    d: float | None = None
    acceptable: tuple[tuple[str, ...], ...] = ()
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
    found["effects"] = tuple(effects)
    for name in ("acceptable", "bags"):
        found[name] = tuple(found.get(name, ()))
    found["acceptable"] = tuple(map(tuple, found["acceptable"]))
    return Label(**found)


def private_directory(output: Path) -> Path:
    """Where the labels of this output are kept until they are opened; made with mode 0700.

    It lies in the user's state directory (XDG Base Directory Specification), under a name that is
    always the same for one output, so that an interrupted check finds it again. Raises GalenError.
    """
    home = os.environ.get("XDG_STATE_HOME")
    state = Path(home) if home else Path.home() / ".local" / "state"
    name = hashlib.sha256(str(output.resolve()).encode()).hexdigest()[:16]
    folder = state.resolve() / "galen_blind_check" / name
    if folder.is_relative_to(output.resolve()):
        raise GalenError(f"{folder}: the labels would lie within {output}; set XDG_STATE_HOME")
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        folder.chmod(0o700)
        found = folder.stat()
    except OSError as error:
        raise GalenError(f"{folder}: the labels can't be kept there: {error.strerror}") from error
    if found.st_uid != os.geteuid() or stat.S_IMODE(found.st_mode) != 0o700:
        raise GalenError(f"{folder}: the labels can't be kept there: others may read it")
    return folder


def forget(folder: Path) -> None:
    """Remove what `private_directory` made; after the labels were opened."""
    shutil.rmtree(folder, ignore_errors=True)


def sealed(labels: Sequence[Label]) -> tuple[str, str]:
    """Return the text to keep, and its SHA-256 in hexadecimal, to be published."""
    content = json.dumps(
        {
            "schema_version": 1,
            "salt": secrets.token_hex(_SALT_BYTES),
            "labels": [label.to_json() for label in labels],
        },
        indent=1,
        sort_keys=True,
    )
    return content, sha256(content)


def sha256(content: str) -> str:
    """In hexadecimal."""
    return hashlib.sha256(content.encode()).hexdigest()


def directory_sha256(folder: Path) -> str:
    """Of a directory's files, their names and contents, in hexadecimal; raises GalenError."""
    whole = hashlib.sha256()
    try:
        for path in sorted(path for path in folder.rglob("*") if path.is_file()):
            with path.open("rb") as stream:
                content = hashlib.file_digest(stream, "sha256").hexdigest()
            whole.update(f"{path.relative_to(folder)}\0{content}\n".encode())
    except OSError as error:
        raise GalenError(f"{folder}: can't be read: {error.strerror}") from error
    return whole.hexdigest()


def write_sealed(path: Path, content: str) -> None:
    """Write the labels; raises GalenError."""
    try:
        write_whole(path, content)
        path.chmod(0o600)
    except OSError as error:
        raise GalenError(f"{path}: can't be written: {error.strerror}") from error


def opened(path: Path, published_sha256: str) -> tuple[Label, ...]:
    """Read a sealed file's labels, if they are those of the hash; raises GalenError."""
    try:
        content = path.read_text(encoding="utf-8")
    except OSError as error:
        raise GalenError(f"{path}: the labels can't be read: {error.strerror}") from error
    if not hmac.compare_digest(sha256(content), published_sha256):
        raise GalenError(f"{path}: isn't what was sealed: its SHA-256 is not {published_sha256}")
    try:
        return tuple(
            label_from_json(label)
            for label in get(mapping(parse_json(content), "labels"), "labels")
        )
    except (FieldError, TypeError) as error:
        raise GalenError(f"{path}: {error}") from error


VERDICTS = (NONE, "identified", "ambiguous", UNKNOWN)


@dataclass(frozen=True)
class ParsedAnswer:
    """An answer; effects are identities, with the joint where they have one.

    causes: effect to its parameters as `diagnosis.json` has them; equivalent: effects that are
    indistinguishable from one of the causes. ranking: probabilities by name. seconds: wall time of
    the diagnosis.
    """

    recording: str
    verdict: str
    causes: Mapping[str, Mapping[str, Any]]
    equivalent: frozenset[str]
    ranking: Mapping[str, float]
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
    return ParsedAnswer(
        recording=recording,
        verdict=verdict,
        causes={_identity(cause): _parameters(cause) for cause in causes},
        equivalent=frozenset(name for cause in causes for name in _equivalent(cause)),
        ranking=ranking,
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
