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
    """Read a JSON file of limited size.

    Args:
        path: file to read.
        max_bytes: size above which it is rejected.
        what: what it should be ("a calibration file"), for the error.

    Returns:
        The parsed content.

    Raises:
        OSError: it can't be opened or read.
        FieldError: it is too large, no regular file or not JSON; the message lacks the file's name.

    """
    return parse_json(read_limited(path, max_bytes, what))


def read_limited(path: Path, max_bytes: int, what: str) -> bytes:
    """Read a file of limited size.

    What is no file is rejected: a pipe or a terminal would keep a node waiting for ever.

    Args:
        path: file to read.
        max_bytes: size above which it is rejected, without reading on.
        what: what it should be ("a calibration file"), for the error.

    Returns:
        All of its bytes.

    Raises:
        OSError: it can't be opened or read.
        FieldError: it is larger or no regular file.

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
    """Parse JSON.

    Args:
        raw: a whole document.

    Returns:
        Its content.

    Raises:
        FieldError: it is not JSON, or nested too deeply.

    """
    try:
        return json.loads(raw)
    except (ValueError, RecursionError) as error:
        raise FieldError(f"not JSON: {error}") from error


def check_version(content: Mapping[str, Any], version: int) -> None:
    """Check the field schema_version.

    Args:
        content: the file's top object.
        version: the only one that is accepted.

    Raises:
        FieldError: the field is missing or another one.

    """
    found = get(content, "schema_version")
    if found != version or isinstance(found, bool):
        raise FieldError(f"schema_version is {found!r:.40}; this version reads {version}")


def check_kind(content: Mapping[str, Any], wanted: str) -> None:
    """Reject another kind of the suite's files, by the fields that only it has.

    Args:
        content: the file's top object.
        wanted: CALIBRATION_FILE or DEFLECTION_MODEL.

    Raises:
        FieldError: the fields are those of another kind, and not of `wanted`.

    """
    kinds = [kind for kind, marks in _MARKS.items() if any(m <= content.keys() for m in marks)]
    if kinds and wanted not in kinds:
        raise FieldError(f"it is {kinds[0]}; {wanted} is needed here")


def numbers(values: ArrayLike) -> list[float]:
    """Convert values to plain floats, to be written as JSON.

    Args:
        values: (n,).

    Returns:
        n floats.

    """
    return [float(value) for value in np.asarray(values, dtype=float)]


def mapping(value: Any, name: str) -> Mapping[str, Any]:
    """Check that a value is an object.

    Args:
        value: as parsed.
        name: the field's name in errors.

    Returns:
        The value.

    Raises:
        FieldError: it is no object.

    """
    if not isinstance(value, Mapping):
        raise FieldError(f"{name} is not an object")
    return value


def get(content: Mapping[str, Any], name: str) -> Any:
    """Get a field that must be there.

    Args:
        content: an object.
        name: the field's key in it.

    Returns:
        The field's value.

    Raises:
        FieldError: it is missing.

    """
    if name not in content:
        raise FieldError(f"{name} is missing")
    return content[name]


def text(value: Any, name: str) -> str:
    """Check that a value is a text, not empty, that can be written as UTF-8.

    Args:
        value: as parsed.
        name: the field's name in errors.

    Returns:
        The value.

    Raises:
        FieldError: it is no text, is empty or holds halves of surrogate pairs.

    """
    if not isinstance(value, str) or not value or any("\ud800" <= c <= "\udfff" for c in value):
        raise FieldError(f"{name} is {value!r:.80}; expected a text")
    return value


def sentence(value: Any, name: str) -> str:
    """Check that a value is one line of printable characters; it may be empty.

    Args:
        value: as parsed.
        name: the field's name in errors.

    Returns:
        The value, of at most LONGEST_SENTENCE characters.

    Raises:
        FieldError: it is no text, too long or not printable.

    """
    if not isinstance(value, str) or not value[:LONGEST_SENTENCE].isprintable():
        raise FieldError(f"{name} is {value!r:.80}; expected one line of printable characters")
    if len(value) > LONGEST_SENTENCE:
        raise FieldError(f"{name} has {len(value)} characters; at most {LONGEST_SENTENCE}")
    return value


def texts(value: Any, name: str) -> tuple[str, ...]:
    """Convert the entries of a list to texts.

    Args:
        value: as parsed.
        name: the field's name in errors.

    Returns:
        `str` of each entry, of whatever type that is.

    Raises:
        FieldError: it is no list.

    """
    return tuple(str(item) for item in items(value, name))


def items(value: Any, name: str) -> Sequence[Any]:
    """Check that a value is a list.

    Args:
        value: as parsed.
        name: the field's name in errors.

    Returns:
        The value; its entries may be anything.

    Raises:
        FieldError: it is no list.

    """
    if not isinstance(value, Sequence) or isinstance(value, str):
        raise FieldError(f"{name} is not a list")
    return value


def count(value: Any, name: str) -> int:
    """Check that a value is a whole number from 0 on.

    Args:
        value: as parsed.
        name: the field's name in errors.

    Returns:
        The value.

    Raises:
        FieldError: it is no such number.

    """
    if not isinstance(value, int) or isinstance(value, bool) or value < 0:
        raise FieldError(f"{name} is {value!r:.40}; expected a count")
    return value


def number(value: Any, name: str, largest: float = LARGEST) -> float:
    """Check that a value is a finite number of limited size.

    Args:
        value: as parsed.
        name: the field's name in errors.
        largest: limit of its absolute value, in the field's unit.

    Returns:
        The value.

    Raises:
        FieldError: it is no number, not finite or larger.

    """
    # The comparison, unlike float(), takes integers of any size; NaN fails it.
    if not _is_number(value) or not abs(value) <= largest:
        raise FieldError(f"{name} is {value!r:.40}; expected a finite number up to {largest:g}")
    return float(value)


def array(value: Any, name: str, shape: tuple[int, ...]) -> Array:
    """Check that a value is a nested list of numbers of a shape.

    Args:
        value: as parsed.
        name: the field's name in errors.
        shape: the only one that is accepted.

    Returns:
        The numbers, each finite and up to LARGEST in size.

    Raises:
        FieldError: an entry is no number, not finite or larger, or the shape is another one.

    """
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
    """Check that a value is a covariance: symmetric, no eigenvalue below zero, as correlations.

    Args:
        value: as parsed.
        name: the field's name in errors.
        size: number of rows and columns.

    Returns:
        The matrix (size, size), as it is in the file.

    Raises:
        FieldError: it is no array of that size, or no covariance within rounding.

    """
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
