"""A text and tensors in one file, in the safetensors format.

The format: the length of a header (8 bytes, little-endian), the header as JSON, which says where
each tensor lies and holds the text as metadata, then the tensors' numbers. Nothing in it is ever
executed, as it would be in a pickle, PyTorch's own format.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
from galen_model.files.json_fields import FieldError, get, mapping, parse_json, text

from galen_deflection.networks import NEEDS

_TEXT = "galen_deflection"
_LENGTH_BYTES = 8
_PRINTED = frozenset(b"\t\n\r" + bytes(range(0x20, 0x7F)))


def is_packed(raw: bytes) -> bool:
    """Whether it is meant to be in this format: its length is no text, its header is JSON."""
    length = raw[:_LENGTH_BYTES]
    return raw[_LENGTH_BYTES : _LENGTH_BYTES + 1] == b"{" and not _PRINTED.issuperset(length)


def packed(described: str, tensors: Mapping[str, np.ndarray]) -> bytes:
    """The file's bytes; tensors in float32. Raises FieldError without the library."""
    arrays = {name: np.ascontiguousarray(tensor) for name, tensor in tensors.items()}
    return bytes(_library().numpy.save(arrays, {_TEXT: described}))


def unpacked(raw: bytes) -> tuple[str, dict[str, np.ndarray]]:
    """The text and the tensors; raises FieldError that says what is wrong."""
    header = _header(raw)
    described = text(get(mapping(get(header, "__metadata__"), "metadata"), _TEXT), _TEXT)
    for name, entry in header.items():
        if name != "__metadata__":
            dtype = get(mapping(entry, f"tensor {name:.40}"), "dtype")
            if dtype != "F32":
                raise FieldError(f"tensor {name:.40} is in {dtype!r:.20}; expected F32")
    library = _library()
    try:
        return described, dict(library.numpy.load(raw))
    except (library.SafetensorError, ValueError) as error:
        raise FieldError(f"its tensors can't be read: {error}") from error


def digest(tensors: Mapping[str, np.ndarray]) -> bytes:
    """All that makes tensors what they are, for a checksum; nothing for none."""
    parts = []
    for name in sorted(tensors):
        tensor = np.ascontiguousarray(tensors[name])
        parts += [json.dumps([name, str(tensor.dtype), tensor.shape]).encode(), tensor.tobytes()]
    return b"".join(parts)


def _header(raw: bytes) -> Mapping[str, Any]:
    length = int.from_bytes(raw[:_LENGTH_BYTES], "little")
    there = len(raw) - _LENGTH_BYTES
    if length > there:
        raise FieldError(f"its header should have {length} bytes, but only {there} follow")
    return mapping(parse_json(raw[_LENGTH_BYTES : _LENGTH_BYTES + length]), "its header")


def _library() -> Any:
    try:
        import safetensors
        import safetensors.numpy
    except ImportError as error:
        raise FieldError(f"a network's file {NEEDS}") from error
    return safetensors
