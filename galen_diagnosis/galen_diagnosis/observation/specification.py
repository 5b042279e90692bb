"""What is still healthy of an arm and its instruments, by effect: limits of their specification.

A limit is the largest magnitude that is within specification; 95 % of healthy parts lie inside it,
so that it is two standard deviations of what is fitted beside every cause.

    {"schema_version": 1, "name": "UR5e with an ATI Gamma", "source": "data sheets",
     "limits": {EFFECT: 0.01, EFFECT: {JOINT OR AXIS: 0.001, "default": 0.002}}}
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
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
"""Of a limit that is a map: what holds of the joints and axes that it doesn't name."""

_VERSION, _MAX_BYTES = 1, 100_000


@dataclass(frozen=True)
class Specification:
    """Limits by effect, each one number for all joints and axes or a map by name."""

    name: str
    source: str
    limits: Mapping[str, Mapping[str, float]]

    def limit(self, effect: str, part: str = DEFAULT) -> float | None:
        """Return an effect's limit at a joint or an axis; None where it has none."""
        by_part = self.limits.get(effect, {})
        return by_part.get(part, by_part.get(DEFAULT))

    def std(self, effect: str, parts: tuple[str, ...]) -> tuple[float, ...] | None:
        """Return a healthy arm's standard deviations of an effect's numbers, of `parts` each.

        None where one of them has no limit.
        """
        limits = [self.limit(effect, part) for part in parts]
        known = [limit for limit in limits if limit is not None]
        return tuple(limit / 2.0 for limit in known) if len(known) == len(limits) else None


def read_specification(path: Path, known: Mapping[str, tuple[str, ...]]) -> Specification:
    """Read a specification.

    Args:
        path: the file.
        known: by effect that has a limit, the names that a map of its limits may have.

    Raises:
        GalenError: naming the file and the key.

    """
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
            for part in by_part:
                if part not in (*known[effect], DEFAULT):
                    names = ", ".join((*known[effect], DEFAULT))
                    raise FieldError(f"limits.{effect}.{part} is not known; known: {names}")
            limits[effect] = {
                part: _positive(limit, f"limits.{effect}.{part}") for part, limit in by_part.items()
            }
        return Specification(
            sentence(content.get("name", path.name), "name"),
            sentence(content.get("source", ""), "source"),
            limits,
        )
    except OSError as error:
        raise GalenError(f"{path}: can't be read: {error.strerror}") from error
    except FieldError as error:
        raise GalenError(f"{path}: {error}") from error


def _positive(value: object, name: str) -> float:
    limit = number(value, name)
    if not (np.isfinite(limit) and limit > 0.0):
        raise FieldError(f"{name} is {limit:g}: a limit is positive and finite")
    return limit
