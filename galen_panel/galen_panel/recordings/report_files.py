"""Reports on the disk: each a folder of its own, whole or not there, found again after a restart.

A folder holds `report.json` (which recording, which tool, the verdict) and what the command wrote.
What is served to a browser is a file of a list that is made here; a browser's words never become a
path. No ROS.
"""

from __future__ import annotations

import json
import os
import re
import secrets
import shutil
import stat
import tempfile
import threading
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from galen_model.errors import GalenError
from galen_model.files.json_fields import parse_json, read_limited

REPORT = "report.json"
EVALUATION = "evaluation.json"
PICTURE = "evaluation.png"
DIAGNOSIS_FOLDER = "diagnosis"
DIAGNOSIS = f"{DIAGNOSIS_FOLDER}/diagnosis.json"
PAGE = f"{DIAGNOSIS_FOLDER}/report.html"
EFFECT = f"{DIAGNOSIS_FOLDER}/found_effect.yaml"
PICTURES = f"{DIAGNOSIS_FOLDER}/pictures"

KINDS = ("evaluate", "diagnose")
_SCHEMA_VERSION = 1
_NAME = re.compile(r"\d{8}T\d{6}Z_(evaluate|diagnose)_[0-9a-f]{8}")
_UNFINISHED = ".unfinished_"
_OLD_S = 24 * 3600.0
_MOST_BYTES = 64 << 20
_TYPES = {
    ".json": "application/json",
    ".png": "image/png",
    ".html": "text/html; charset=utf-8",
    ".yaml": "text/plain; charset=utf-8",
}


class StoredReportError(GalenError):
    """A report can't be written or read."""


@dataclass(frozen=True)
class StoredReport:
    """One of them. made_at: RFC 3339. recording, tool: as they were named to the person."""

    id: str
    kind: str
    recording: str
    recording_id: str
    tool: str
    made_at: str
    verdict: str
    sentence: str


@dataclass(frozen=True)
class Served:
    """A file for a browser; attachment: it is saved instead of shown."""

    content: bytes
    content_type: str
    attachment: bool


class Reports:
    """Those of one directory; used from several threads."""

    def __init__(self, directory: Path) -> None:
        self._directory = directory
        self._lock = threading.Lock()
        self._known: dict[str, StoredReport] | None = None

    def all(self) -> list[StoredReport]:
        """The newest first. The first call reads the directory."""
        with self._lock:
            known = self._read_known()
            return sorted(known.values(), key=lambda one: one.id, reverse=True)

    def get(self, report_id: str) -> StoredReport | None:
        """The report of an id; None where there is none."""
        with self._lock:
            return self._read_known().get(report_id)

    def begin(self) -> Path:
        """A new folder to write one into, not listed yet. Raises ReportError."""
        try:
            self._directory.mkdir(parents=True, exist_ok=True)
            self._sweep()
            return Path(tempfile.mkdtemp(dir=self._directory, prefix=_UNFINISHED))
        except OSError as error:
            raise StoredReportError(
                f"{self._directory}: can't be written: {error.strerror}"
            ) from error

    def finish(self, folder: Path, told: Mapping[str, str]) -> StoredReport:
        """List what was written into a folder; `told` has Report's fields but id and made_at."""
        at = datetime.now(UTC)
        name = f"{at.strftime('%Y%m%dT%H%M%SZ')}_{told['kind']}_{secrets.token_hex(4)}"
        report = StoredReport(id=name, made_at=at.isoformat(timespec="seconds"), **told)
        content = {"schema_version": _SCHEMA_VERSION, **asdict(report)}
        try:
            (folder / REPORT).write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
            folder.chmod(0o755)  # mkdtemp's 0700 would hide it from the lab's others
            folder.rename(self._directory / name)
        except OSError as error:
            raise StoredReportError(f"{folder}: can't be written: {error.strerror}") from error
        with self._lock:
            self._read_known()[name] = report
        return report

    def discard(self, folder: Path) -> None:
        """Remove what was begun and not finished."""
        shutil.rmtree(folder, ignore_errors=True)

    def content(self, report: StoredReport) -> dict[str, Any]:
        """What the command would print with --json. Raises ReportError."""
        name = EVALUATION if report.kind == "evaluate" else DIAGNOSIS
        try:
            content = parse_json(_read(self._directory / report.id / name))
        except (OSError, ValueError) as error:
            raise StoredReportError(f"{report.id}: {name} can't be read: {error}") from error
        if not isinstance(content, dict):
            raise StoredReportError(f"{report.id}: {name} is damaged")
        return content

    def files(self, report: StoredReport) -> dict[str, Path]:
        """The report's files by the name that a browser asks for."""
        folder = self._directory / report.id
        if report.kind == "evaluate":
            listed = [folder / EVALUATION, folder / PICTURE]
        else:
            pictures = folder / PICTURES
            listed = [folder / DIAGNOSIS, folder / PAGE, folder / EFFECT]
            if _is_folder(folder / DIAGNOSIS_FOLDER) and _is_folder(pictures):
                listed += sorted(path for path in pictures.iterdir() if path.suffix == ".png")
        if not _is_folder(folder) or (folder / DIAGNOSIS_FOLDER).is_symlink():
            return {}
        return {path.name: path for path in listed if _is_file(path)}

    def serve(self, report_id: str, name: str) -> Served | None:
        """A file by what a browser asks for; None where there is none. Nothing is raised."""
        report = self.get(report_id)
        path = None if report is None else self.files(report).get(name)
        if path is None:
            return None
        try:
            content = _read(path)
        except (OSError, ValueError):
            return None
        return Served(content, _TYPES[path.suffix], path.suffix in (".json", ".yaml"))

    # Inside

    def _read_known(self) -> dict[str, StoredReport]:
        if self._known is None:
            try:
                names = [path.name for path in self._directory.iterdir()]
            except OSError:
                names = []
            found = (self._read_report(name) for name in names if _NAME.fullmatch(name))
            self._known = {report.id: report for report in found if report is not None}
        return self._known

    def _read_report(self, name: str) -> StoredReport | None:
        folder = self._directory / name
        try:
            if not _is_folder(folder):
                return None
            content = parse_json(_read(folder / REPORT))
            if content.pop("schema_version") != _SCHEMA_VERSION:
                return None
            report = StoredReport(**content)
        except (OSError, ValueError, LookupError, TypeError, AttributeError):
            return None
        texts = all(isinstance(value, str) for value in asdict(report).values())
        return report if texts and report.id == name and report.kind in KINDS else None

    def _sweep(self) -> None:
        """Remove what a panel that was killed left behind, a day later: another one may run."""
        for path in self._directory.glob(f"{_UNFINISHED}*"):
            if datetime.now(UTC).timestamp() - path.lstat().st_mtime > _OLD_S:
                shutil.rmtree(path, ignore_errors=True)


def _is_folder(path: Path) -> bool:
    return path.is_dir() and not path.is_symlink()


def _is_file(path: Path) -> bool:
    try:
        return stat.S_ISREG(path.lstat().st_mode)
    except OSError:
        return False


def _read(path: Path) -> bytes:
    """A file's content; raises OSError, and ValueError where it is too large."""
    if path.is_symlink():
        raise OSError(f"{os.fspath(path.name)} is a link")
    return read_limited(path, _MOST_BYTES, "a report's file")
