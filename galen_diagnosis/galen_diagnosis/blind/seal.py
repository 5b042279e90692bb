"""The sealed labels: kept in a directory that only this user may enter, their hash published first.

The text of all labels begins with 32 random bytes, so that trying out hashes finds no
labels. The SHA-256 of the text is published first; opening shows that no label changed since.
"""

from __future__ import annotations

import hashlib
import hmac
import json
import os
import secrets
import shutil
import stat
from collections.abc import Sequence
from pathlib import Path

from galen_model.errors import GalenError
from galen_model.files.atomic_file import write_whole
from galen_model.files.json_fields import FieldError, get, mapping, parse_json

from galen_diagnosis.blind.answers import Label, label_from_json

_SALT_BYTES = 32


class SealError(GalenError):
    """Labels that can't be kept, or aren't those that were sealed."""


def private_directory(output: Path) -> Path:
    """Where the labels of this output are kept until they are opened; made with mode 0700.

    It lies in the user's state directory (XDG Base Directory Specification), under a name that is
    always the same for one output, so that an interrupted check finds it again. Raises SealError.
    """
    home = os.environ.get("XDG_STATE_HOME")
    state = Path(home) if home else Path.home() / ".local" / "state"
    name = hashlib.sha256(str(output.resolve()).encode()).hexdigest()[:16]
    folder = state.resolve() / "galen_blind_check" / name
    if folder.is_relative_to(output.resolve()):
        raise SealError(f"{folder}: the labels would lie within {output}; set XDG_STATE_HOME")
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        folder.chmod(0o700)
        found = folder.stat()
    except OSError as error:
        raise SealError(f"{folder}: the labels can't be kept there: {error.strerror}") from error
    if found.st_uid != os.geteuid() or stat.S_IMODE(found.st_mode) != 0o700:
        raise SealError(f"{folder}: the labels can't be kept there: others may read it")
    return folder


def forget(folder: Path) -> None:
    """Remove what `private_directory` made; after the labels were opened."""
    shutil.rmtree(folder, ignore_errors=True)


def sealed(labels: Sequence[Label]) -> tuple[str, str]:
    """Return the text to keep, and its SHA-256 in hexadecimal, to be published."""
    text = json.dumps(
        {
            "schema_version": 1,
            "salt": secrets.token_hex(_SALT_BYTES),
            "labels": [label.to_json() for label in labels],
        },
        indent=1,
        sort_keys=True,
    )
    return text, sha256(text)


def sha256(text: str) -> str:
    """In hexadecimal."""
    return hashlib.sha256(text.encode()).hexdigest()


def directory_sha256(folder: Path) -> str:
    """Of a directory's files, their names and contents, in hexadecimal; raises SealError."""
    whole = hashlib.sha256()
    try:
        for path in sorted(path for path in folder.rglob("*") if path.is_file()):
            with path.open("rb") as stream:
                content = hashlib.file_digest(stream, "sha256").hexdigest()
            whole.update(f"{path.relative_to(folder)}\0{content}\n".encode())
    except OSError as error:
        raise SealError(f"{folder}: can't be read: {error.strerror}") from error
    return whole.hexdigest()


def write_sealed(path: Path, text: str) -> None:
    """Write the labels; raises SealError."""
    try:
        write_whole(path, text)
        path.chmod(0o600)
    except OSError as error:
        raise SealError(f"{path}: can't be written: {error.strerror}") from error


def opened(path: Path, published_sha256: str) -> tuple[Label, ...]:
    """Read a sealed file's labels, if they are those of the hash; raises SealError."""
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise SealError(f"{path}: the labels can't be read: {error.strerror}") from error
    if not hmac.compare_digest(sha256(text), published_sha256):
        raise SealError(f"{path}: isn't what was sealed: its SHA-256 is not {published_sha256}")
    try:
        return tuple(
            label_from_json(label) for label in get(mapping(parse_json(text), "labels"), "labels")
        )
    except (FieldError, TypeError) as error:
        raise SealError(f"{path}: {error}") from error
