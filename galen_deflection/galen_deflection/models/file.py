"""A fitted model's file: JSON with a schema's version and a checksum, written whole or not at all.

    {"schema_version": 1, "kind": "joint_stiffness", "tip_m": [..3..],
     "parameters": [{"name": "1/k_roll", "unit": "rad/(N.m)", "value": 0.0005}, ...],
     "covariance": [[..]], "discrepancy": [[6x6]], "noise": [..6..], "fitted_range": {...},
     "fitted_on": {"samples": .., "segments": .., "positions": .., "sets": ..}, "unresolved": [..],
     "notes": [..],
     "sha256": "..."}

What else is in it, the kind decides. The checksum is SHA-256 of all other fields as JSON without
spaces and with sorted keys: it tells a file that was cut, mixed or edited by hand.

A network's file is in the safetensors format, with its weights as tensors and the same JSON in its
metadata; the checksum is then over both (`tensor_file`). Which of the two a file is, its first
bytes say, not its name.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from galen_model.files.atomic_file import write_whole
from galen_model.files.json_fields import (
    DEFLECTION_MODEL,
    FieldError,
    check_kind,
    check_version,
    get,
    mapping,
    parse_json,
    read_limited,
    text,
)

from galen_deflection.errors import ModelFileError
from galen_deflection.models.interface import DeflectionModel
from galen_deflection.models.registry import kind_of, model_from
from galen_deflection.networks.tensor_file import digest, is_packed, packed, unpacked

SCHEMA_VERSION = 1
_MAX_FILE_BYTES = 10_000_000

_Tensors = Mapping[str, np.ndarray]


def read_model(path: str | os.PathLike[str]) -> DeflectionModel:
    """Read and check a model's file. Raises ModelFileError that names the file and the field."""
    path = Path(path)
    try:
        raw = read_limited(path, _MAX_FILE_BYTES, "a model's file")
        return _made(*_parts(raw))
    except OSError as error:
        raise ModelFileError(f"{path}: can't be read: {error.strerror}") from error
    except (FieldError, RecursionError) as error:
        raise ModelFileError(f"{path}: {error}") from error


def write_model(path: str | os.PathLike[str], model: DeflectionModel) -> None:
    """Write a model's file whole or not at all; the old one is kept as `.bak`.

    Raises ModelFileError, naming the file; the old file is then untouched.
    """
    path = Path(path)
    try:
        tensors = model.tensors()
        content = {"schema_version": SCHEMA_VERSION, **model.to_json()}
        content["sha256"] = _checksum(content, tensors)
        text = json.dumps(content, indent=1, allow_nan=False) + "\n"
        raw = text.encode() if tensors is None else packed(text, tensors)
        _made(*_parts(raw))  # what can't be read must not be written
    except (ValueError, FieldError) as error:
        raise ModelFileError(f"{path}: not written: {error}") from error
    try:
        write_whole(path, raw)
    except OSError as error:
        raise ModelFileError(f"{path}: can't be written: {error.strerror}") from error


def _parts(raw: bytes) -> tuple[Any, _Tensors | None]:
    """A file's JSON, and its tensors if it has any."""
    if not is_packed(raw):
        return parse_json(raw), None
    text, tensors = unpacked(raw)
    return parse_json(text), tensors


def _made(content: Any, tensors: _Tensors | None) -> DeflectionModel:
    whole = mapping(content, "the file")
    check_kind(whole, DEFLECTION_MODEL)
    check_version(whole, SCHEMA_VERSION)
    kind_of(text(get(whole, "kind"), "kind"))
    found = text(get(whole, "sha256"), "sha256")
    if found != _checksum(whole, tensors):
        raise FieldError("sha256 is not that of the content: it was changed or cut")
    return model_from(whole, tensors)


def _checksum(content: Mapping[str, Any], tensors: _Tensors | None) -> str:
    checked = {name: value for name, value in content.items() if name != "sha256"}
    try:
        canonical = json.dumps(checked, sort_keys=True, separators=(",", ":"), allow_nan=False)
    except ValueError as error:  # Python reads NaN and 1e999, which no JSON holds
        raise FieldError(f"a number in it is not finite: {error}") from error
    return hashlib.sha256(canonical.encode() + digest(tensors or {})).hexdigest()
