# SPDX-License-Identifier: Apache-2.0
"""Reading a JSON file's fields with checks; an error names the field."""

import json
import os
import stat
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from galen_model.arrays import Array

LARGEST = 1e6
"""No SI number of this arm or its tools comes near it; a larger one would overflow in a product."""

LONGEST_SENTENCE = 1000

CALIBRATION_FILE = "a tool's calibration file (`calibrate` writes it)"
DEFLECTION_MODEL = "a deflection model (`train` writes it)"
_MARKS = {
    CALIBRATION_FILE: ({"zeroing"}, {"bias_pose_rad"}),
    DEFLECTION_MODEL: ({"kind", "sha256"},),
}
"""Sets of fields that no other file of the suite has."""

_ROUNDING = 1e-6
"""By which a correlation may be off that went through an inverse."""


class FieldError(ValueError):
    """A field is missing or wrong; the message names it."""


def read_json(path: Path, max_bytes: int, what: str) -> Any:
    """Return the content of a JSON file, `what` it should be ("a calibration file").

    Raises OSError, and FieldError without the file's name.
    """
    return parse_json(read_limited(path, max_bytes, what))


def read_limited(path: Path, max_bytes: int, what: str) -> bytes:
    """Return a file's bytes; raises OSError, and FieldError, without reading on, if there are more.

    What is no file is rejected: a pipe or a terminal would keep a node waiting for ever.
    """
    handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        if not stat.S_ISREG(os.fstat(handle).st_mode):
            raise FieldError("can't be read: it is no regular file")
        with os.fdopen(handle, "rb", closefd=False) as stream:
            raw = stream.read(max_bytes + 1)
    finally:
        os.close(handle)
    if len(raw) > max_bytes:
        raise FieldError(f"larger than {max_bytes} bytes, not {what}")
    return raw


def parse_json(raw: str | bytes) -> Any:
    """JSON's content; raises FieldError."""
    try:
        return json.loads(raw)
    except (ValueError, RecursionError) as error:
        raise FieldError(f"not JSON: {error}") from error


def check_version(content: Mapping[str, Any], version: int) -> None:
    """Raise FieldError unless the field schema_version is `version`."""
    found = get(content, "schema_version")
    if found != version or isinstance(found, bool):
        raise FieldError(f"schema_version is {found!r:.40}; this version reads {version}")


def check_kind(content: Mapping[str, Any], wanted: str) -> None:
    """Raise FieldError where it is the suite's other file, and not `wanted`."""
    kinds = [kind for kind, marks in _MARKS.items() if any(m <= content.keys() for m in marks)]
    if kinds and wanted not in kinds:
        raise FieldError(f"it is {kinds[0]}; {wanted} is needed here")


def numbers(values: ArrayLike) -> list[float]:
    """Return a row of plain numbers, to be written."""
    return [float(value) for value in np.asarray(values, dtype=float)]


def mapping(value: Any, name: str) -> Mapping[str, Any]:
    """Return an object."""
    if not isinstance(value, Mapping):
        raise FieldError(f"{name} is not an object")
    return value


def get(content: Mapping[str, Any], name: str) -> Any:
    """Return a field that must be there."""
    if name not in content:
        raise FieldError(f"{name} is missing")
    return content[name]


def text(value: Any, name: str) -> str:
    """Return a text that isn't empty, and can be written as UTF-8."""
    if not isinstance(value, str) or not value or any("\ud800" <= c <= "\udfff" for c in value):
        raise FieldError(f"{name} is {value!r:.80}; expected a text")
    return value


def sentence(value: Any, name: str) -> str:
    """Return one line of at most LONGEST_SENTENCE printable characters; it may be empty."""
    if not isinstance(value, str) or not value[:LONGEST_SENTENCE].isprintable():
        raise FieldError(f"{name} is {value!r:.80}; expected one line of printable characters")
    if len(value) > LONGEST_SENTENCE:
        raise FieldError(f"{name} has {len(value)} characters; at most {LONGEST_SENTENCE}")
    return value


def texts(value: Any, name: str) -> tuple[str, ...]:
    """Return a list of texts."""
    return tuple(str(item) for item in items(value, name))


def items(value: Any, name: str) -> Sequence[Any]:
    """Return a list of anything."""
    if not isinstance(value, Sequence) or isinstance(value, str):
        raise FieldError(f"{name} is not a list")
    return value


def count(value: Any, name: str) -> int:
    """Return a whole number from 0 on."""
    if not isinstance(value, int) or isinstance(value, bool) or value < 0:
        raise FieldError(f"{name} is {value!r:.40}; expected a count")
    return value


def number(value: Any, name: str, largest: float = LARGEST) -> float:
    """Return a finite number of at most the largest."""
    # The comparison, unlike float(), takes integers of any size; NaN fails it.
    if not _is_number(value) or not abs(value) <= largest:
        raise FieldError(f"{name} is {value!r:.40}; expected a finite number up to {largest:g}")
    return float(value)


def array(value: Any, name: str, shape: tuple[int, ...]) -> Array:
    """Numbers of a shape, each as `number`."""
    if not _holds_numbers(value):
        raise FieldError(f"{name} does not hold numbers")
    try:
        values = np.array(value, dtype=float)
    except (ValueError, OverflowError):
        raise FieldError(f"{name} does not hold numbers of the shape {shape}") from None
    if values.shape != shape:
        raise FieldError(f"{name} has shape {values.shape}; expected {shape}")
    if not np.all(np.abs(values) <= LARGEST):
        raise FieldError(f"{name} holds a value that is not finite, or above {LARGEST:g}")
    return values


def covariance(value: Any, name: str, size: int) -> Array:
    """Return a covariance (size, size): symmetric, no eigenvalue below zero, as correlations."""
    matrix = array(value, name, (size, size))
    variance = np.diag(matrix)
    if np.any(variance < 0.0):
        raise FieldError(f"{name} has a negative variance")
    # compared as correlations: the entries' own sizes differ by orders of magnitude
    scale = np.sqrt(np.where(variance > 0.0, variance, 1.0))
    with np.errstate(over="ignore"):
        correlation = matrix / scale / scale[:, None]
    if not np.allclose(correlation, correlation.T, atol=_ROUNDING):
        raise FieldError(f"{name} is not symmetric")
    if not np.all(np.abs(correlation) < 1.0 + _ROUNDING):
        raise FieldError(f"{name} has a correlation above one")
    if np.linalg.eigvalsh(correlation)[0] < -_ROUNDING:
        raise FieldError(f"{name} has a negative eigenvalue")
    return matrix


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _holds_numbers(value: Any) -> bool:
    if isinstance(value, list):
        return all(_holds_numbers(item) for item in value)
    return _is_number(value)
