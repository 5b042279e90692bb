# SPDX-License-Identifier: Apache-2.0
"""Answers of any tool, as they are scored: section 7 of the contract, read with distrust."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from galen_diagnosis.answer.answer import NONE, UNKNOWN
from galen_model.json_fields import (
    FieldError,
    get,
    items,
    mapping,
    number,
    read_json,
    text,
    texts,
)
from galen_sim_driver.effects.registry import identity_of

ANSWER = "diagnosis.json"
VERDICTS = (NONE, "identified", "ambiguous", UNKNOWN)
_FARTHEST = 1e12
_LARGEST_BYTES = 50_000_000


class Estimate(NamedTuple):
    """A number with its 95 % interval, None where that wasn't told."""

    value: float
    low: float | None = None
    high: float | None = None


@dataclass(frozen=True)
class Cause:
    """A named cause: identities that stand for it, its own first, and what was told of it."""

    same: tuple[str, ...]
    parameters: Mapping[str, Estimate | str]


@dataclass(frozen=True)
class ParsedAnswer:
    """An answer; effects are identities, with the joint where they have one.

    ranking: probabilities by name. seconds: wall time of the diagnosis, None where not told.
    """

    verdict: str
    causes: Mapping[str, Cause]
    ranking: Mapping[str, float]
    seconds: float | None = None

    @property
    def first(self) -> str:
        """The ranking's first, whatever its order in the file; of equal ones the first there."""
        return max(self.ranking, key=lambda name: self.ranking[name])

    @property
    def named(self) -> frozenset[str]:
        """All effects that the answer names: causes and those equivalent to them."""
        return frozenset(name for cause in self.causes.values() for name in cause.same)


def read_answer(tool: Path, recording: str) -> ParsedAnswer:
    """Read a tool's answer to one recording.

    Args:
        tool: The tool's folder, with `RECORDING/diagnosis.json` or `RECORDING.json`.
        recording: Name of the recording's directory.

    Returns:
        The answer from the first of the two files that exists.

    Raises:
        FieldError: There is no such file, it can't be read, or it is no valid answer.

    """
    for path in (tool / recording / ANSWER, tool / f"{recording}.json"):
        if path.exists():
            try:
                return parse_answer(read_json(path, _LARGEST_BYTES, "an answer"))
            except OSError as error:
                raise FieldError(f"can't be read: {error.strerror}") from error
            except RecursionError as error:
                raise FieldError("nested too deeply") from error
    raise FieldError("no answer")


def parse_answer(content: Any) -> ParsedAnswer:
    """Check and read the content of `diagnosis.json`.

    Args:
        content: What the file's JSON holds, of any type.

    Returns:
        The answer; of causes with the same identity the last one.

    Raises:
        FieldError: A field is missing or malformed, the verdict isn't one of `VERDICTS`, the
            ranking is empty, or a probability is outside 0 ... 1.

    """
    answer = mapping(content, "the answer")
    verdict = text(get(answer, "verdict"), "verdict")
    if verdict not in VERDICTS:
        raise FieldError(f"verdict is {verdict!r:.40}; expected one of {', '.join(VERDICTS)}")
    ranks = [mapping(row, "ranking") for row in items(get(answer, "ranking"), "ranking")]
    ranking = {_identity(row): number(get(row, "probability"), "probability") for row in ranks}
    if not ranking or any(not 0.0 <= p <= 1.0 + 1e-9 for p in ranking.values()):
        raise FieldError("ranking is empty, or has a probability outside 0 ... 1")
    causes = map(_cause, items(get(answer, "causes"), "causes"))
    seconds = answer.get("seconds")
    return ParsedAnswer(
        verdict,
        {cause.same[0]: cause for cause in causes},
        ranking,
        None if seconds is None else number(seconds, "seconds"),
    )


def _identity(entry: Mapping[str, Any]) -> str:
    return identity_of(text(get(entry, "effect"), "effect"), entry)


def _cause(content: Any) -> Cause:
    cause = mapping(content, "cause")
    parameters = mapping(cause.get("parameters", {}), "parameters")
    if "joint" in cause:
        parameters = {**parameters, "joint": cause["joint"]}
    own = _identity({**parameters, **cause})
    joints = mapping(cause.get("equivalent_joints", {}), "equivalent_joints")
    same = [own]
    for effect in texts(cause.get("equivalent", ()), "equivalent"):
        at = texts(joints.get(effect, ()), "equivalent_joints")
        same += [f"{effect}:{joint}" for joint in at] or [effect]
    return Cause(tuple(dict.fromkeys(same)), dict(flat(parameters)))


def flat(parameters: Mapping[str, Any]) -> Iterator[tuple[str, Estimate | str]]:
    """Yield parameters one number or word at a time: `name`, `name[k]` of lists, `name.entry`.

    A value stands alone, or as {"value": .., "ci95": [low, high]}; of a list, "ci95" has a pair or
    null for each.

    Args:
        parameters: A cause's parameters, SI units, as `diagnosis.json` or `truth.json` has them.

    Yields:
        Key, and the word or the number with its interval; nothing for null.

    Raises:
        FieldError: A value is no number, or intervals don't fit their values.

    """
    for name, value in parameters.items():
        limits = None
        if isinstance(value, Mapping):
            if "value" not in value:
                yield from ((f"{name}.{entry}", part) for entry, part in flat(value))
                continue
            value, limits = value["value"], value.get("ci95")
        if isinstance(value, str):
            yield name, value
        elif isinstance(value, list | tuple):
            pairs = [None] * len(value) if limits is None else items(limits, f"{name}: ci95")
            if len(pairs) != len(value):
                raise FieldError(f"{name} has {len(value)} values and {len(pairs)} intervals")
            for k, one in enumerate(value):
                if one is not None:
                    yield f"{name}[{k}]", _estimate(one, pairs[k], name)
        elif value is not None:
            yield name, _estimate(value, limits, name)


def _estimate(value: Any, limits: Any, name: str) -> Estimate:
    if limits is None:
        return Estimate(number(value, name, _FARTHEST))
    # A limit of how stiff something is may be anywhere.
    pair = [number(limit, f"{name}: ci95", _FARTHEST) for limit in items(limits, f"{name}: ci95")]
    if len(pair) != 2:
        raise FieldError(f"{name}: ci95 has {len(pair)} numbers; expected two")
    return Estimate(number(value, name, _FARTHEST), *pair)
