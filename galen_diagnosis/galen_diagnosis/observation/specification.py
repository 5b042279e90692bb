# SPDX-License-Identifier: Apache-2.0
"""What is still healthy of an arm and its instruments, by effect: limits of their specification.

A limit is the largest magnitude that is within specification; 95 % of healthy parts lie inside it,
so that it is two standard deviations of what is fitted beside every cause.

    {"schema_version": 1, "name": "UR5e with an ATI Gamma", "source": "data sheets",
     "limits": {EFFECT: 0.01, EFFECT: {JOINT OR AXIS: 0.001, "default": 0.002}},
     "sources": {EFFECT: "where its number is from"}}

What a file doesn't name is as in the preset `default`. A data sheet's "u of full scale" bounds the
reading's error at full load F: a gain of u, a coefficient of u / F of the square, a crosstalk from
an axis of full load F to one of G of u G / F.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib.resources import files
from pathlib import Path

import numpy as np
from galen_model.errors import GalenError
from galen_model.json_fields import (
    FieldError,
    check_version,
    get,
    mapping,
    number,
    read_json,
    sentence,
)

SPECIFICATION_FILE = "specification.json"
DEFAULT = "default"
"""The preset of a usual arm; of a limit that is a map: of the joints and axes it doesn't name."""
CALIBRATED = "galen"
"""The preset of a carefully calibrated arm: what it doesn't name is there or not."""

_PRESETS = Path(str(files(__package__))) / "specifications"
_VERSION, _MAX_BYTES = 1, 100_000


@dataclass(frozen=True)
class Specification:
    """Limits by effect, each one number for all joints and axes or a map by name.

    sources: where an effect's limit is from, as far as that is known.
    """

    name: str
    source: str
    limits: Mapping[str, Mapping[str, float]]
    sources: Mapping[str, str] = field(default_factory=dict)

    def limit(self, effect: str, part: str = DEFAULT) -> float | None:
        """Return an effect's limit at a joint or an axis.

        Args:
            effect: Its name.
            part: Joint or axis; of one that isn't named, that of all.

        Returns:
            The largest magnitude within specification, in the effect's unit; None where it has
            none.

        """
        by_part = self.limits.get(effect, {})
        return by_part.get(part, by_part.get(DEFAULT))

    def std(self, effect: str, parts: tuple[str, ...]) -> tuple[float, ...] | None:
        """Return a healthy arm's standard deviations of an effect's numbers, half of their limits.

        Args:
            effect: Its name.
            parts: Joint or axis of each number.

        Returns:
            One for each part, in the effect's unit; None where one of them has no limit.

        """
        limits = [self.limit(effect, part) for part in parts]
        known = [limit for limit in limits if limit is not None]
        return tuple(limit / 2.0 for limit in known) if len(known) == len(limits) else None

    def scaled(self, factor: float, words: str) -> Specification:
        """Return the same limits times a factor.

        Args:
            factor: On every limit.
            words: What comes before the name.

        Returns:
            A copy, sources as they are.

        """
        limits = {
            effect: {part: factor * limit for part, limit in by_part.items()}
            for effect, by_part in self.limits.items()
        }
        return replace(self, name=words + self.name, limits=limits)

    def over(self, other: Specification) -> Specification:
        """Return these limits and, of effects and parts without one, another's.

        Args:
            other: Limits that count where these have none.

        Returns:
            Both, under this name and source.

        """
        both: dict[str, Mapping[str, float]] = {
            effect: {**other.limits.get(effect, {}), **self.limits.get(effect, {})}
            for effect in {**other.limits, **self.limits}
        }
        # A number for all parts comes before another's number for one.
        both |= {name: own for name, own in self.limits.items() if DEFAULT in own}
        return replace(self, limits=both, sources={**other.sources, **self.sources})


def presets() -> tuple[str, ...]:
    """Return the names of all presets."""
    return tuple(sorted(path.stem for path in _PRESETS.glob("*.json")))


def path_of(given: str | os.PathLike[str]) -> Path:
    """Return the file of a preset or of a path.

    Args:
        given: Name of a preset, which comes first, or path of a file.

    Returns:
        The path, existing or not.

    """
    return _PRESETS / f"{given}.json" if str(given) in presets() else Path(given)


def specification_of(
    given: Sequence[str | os.PathLike[str]], known: Mapping[str, tuple[str, ...] | None]
) -> Specification:
    """Return what files and presets say together, the first before the others.

    Args:
        given: Files, and names of presets.
        known: By effect that has a limit, the names that a map of it may have; None for any.

    Returns:
        The limits of all, over those of the preset `default` unless that or `galen` is among them.

    Raises:
        GalenError: Naming the file and the key.

    """
    found = [_read(one, known) for one in given]
    if not any(str(one) in (DEFAULT, CALIBRATED) for one in given):
        found.append(_read(DEFAULT, known))
    whole = found[-1]
    for one in reversed(found[:-1]):
        whole = one.over(whole)
    named = found[: len(given)] or found
    return replace(
        whole,
        name=" and ".join(one.name for one in named),
        source="; ".join(dict.fromkeys(one.source for one in named if one.source)),
    )


def _read(
    given: str | os.PathLike[str], known: Mapping[str, tuple[str, ...] | None]
) -> Specification:
    path = path_of(given)
    try:
        content = mapping(read_json(path, _MAX_BYTES, "a specification"), "the file")
        check_version(content, _VERSION)
        limits = {}
        for effect, value in mapping(get(content, "limits"), "limits").items():
            if effect not in known:
                raise FieldError(
                    f"limits.{effect} is no effect that has a limit; known: {', '.join(known)}"
                )
            by_part = value if isinstance(value, Mapping) else {DEFAULT: value}
            names_of = known[effect]
            for part in by_part:
                if names_of is not None and part not in (*names_of, DEFAULT):
                    names = ", ".join((*names_of, DEFAULT))
                    raise FieldError(f"limits.{effect}.{part} is not known; known: {names}")
            limits[effect] = {
                part: _positive(limit, f"limits.{effect}.{part}") for part, limit in by_part.items()
            }
        sources = mapping(content.get("sources", {}), "sources")
        return Specification(
            sentence(content.get("name", path.name), "name"),
            sentence(content.get("source", ""), "source"),
            limits,
            {effect: sentence(text, f"sources.{effect}") for effect, text in sources.items()},
        )
    except OSError as error:
        raise GalenError(
            f"{path}: can't be read: {error.strerror}; presets: {', '.join(presets())}"
        ) from error
    except FieldError as error:
        raise GalenError(f"{path}: {error}") from error


def _positive(value: object, name: str) -> float:
    limit = number(value, name)
    if not (np.isfinite(limit) and limit > 0.0):
        raise FieldError(f"{name} is {limit:g}: a limit is positive and finite")
    return limit
