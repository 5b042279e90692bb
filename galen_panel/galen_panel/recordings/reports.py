# SPDX-License-Identifier: Apache-2.0
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
import tempfile
import threading
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path

from galen_model.errors import GalenError
from galen_model.json_fields import parse_json, read_limited
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response

from galen_panel.state.snapshot import NodeLevel

REPORT = "report.json"
EVALUATION, EVALUATION_PAGE, PICTURE = "evaluation.json", "evaluation.html", "evaluation.png"
DIAGNOSIS_FOLDER = "diagnosis"
REPORTS_PATH = "/reports"
# By the name that a browser asks for: the path in a report's folder, and the content's type.
_FILES = {
    EVALUATION: (EVALUATION, "application/json"),
    EVALUATION_PAGE: (EVALUATION_PAGE, "text/html; charset=utf-8"),
    PICTURE: (PICTURE, "image/png"),
    "diagnosis.json": (f"{DIAGNOSIS_FOLDER}/diagnosis.json", "application/json"),
    "report.html": (f"{DIAGNOSIS_FOLDER}/report.html", "text/html; charset=utf-8"),
    **{
        name: (f"{DIAGNOSIS_FOLDER}/{name}", "text/plain; charset=utf-8")
        for name in ("found_effect.yaml", "found_effect.mjcf.xml")
    },
}
KINDS = {"evaluate": "Evaluation", "diagnose": "Diagnosis"}
"""Of a job or a report, with its word."""
VERDICTS = {
    ("evaluate", "fits"): (NodeLevel.OK, "The calibration fits"),
    ("evaluate", "offset"): (NodeLevel.WARN, "An offset"),
    ("evaluate", "drift"): (NodeLevel.WARN, "The sensor drifts"),
    ("evaluate", "load"): (NodeLevel.ERROR, "The load is another one than calibrated"),
    ("evaluate", "changed"): (NodeLevel.ERROR, "Something changed during the recording"),
    ("evaluate", "unexplained"): (NodeLevel.ERROR, "Does not fit, and nothing explains it"),
    ("evaluate", "unknown"): (NodeLevel.WARN, "Not decidable"),
    ("diagnose", "none"): (NodeLevel.OK, "No gap"),
    ("diagnose", "identified"): (NodeLevel.WARN, "Cause found"),
    ("diagnose", "ambiguous"): (NodeLevel.WARN, "Several causes are possible"),
    ("diagnose", "unknown"): (NodeLevel.ERROR, "A gap without a known cause"),
}
"""By the kind of a report and its verdict."""
# A report's own page needs nothing but its pictures, which are in it, and may not run anything.
_PAGE_POLICY = (
    "sandbox; default-src 'none'; img-src data:; style-src 'unsafe-inline'; base-uri 'none';"
    " form-action 'none'; frame-ancestors 'self'"
)
_SCHEMA_VERSION = 1
_NAME = re.compile(r"\d{8}T\d{6}Z_(evaluate|diagnose)_[0-9a-f]{8}")
_UNFINISHED = ".unfinished_"
_OLD_S = 24 * 3600.0
_MOST_BYTES = 64 << 20


@dataclass(frozen=True)
class StoredReport:
    """A report; made_at: RFC 3339; recording, tool: names for a person.

    since: names of the recordings that a diagnosis compares with; empty for none.
    """

    id: str
    kind: str
    recording: str
    recording_id: str
    tool: str
    made_at: str
    verdict: str
    sentence: str
    since: str = ""

    @property
    def verdict_words(self) -> tuple[NodeLevel, str]:
        """The verdict's level and words."""
        return VERDICTS.get((self.kind, self.verdict), (NodeLevel.WARN, self.verdict))


class Reports:
    """Reports of one directory; used from several threads."""

    def __init__(self, directory: Path) -> None:
        self._directory = directory
        self._lock = threading.Lock()
        self._known: dict[str, StoredReport] | None = None

    def all(self) -> list[StoredReport]:
        """List the reports, newest first. The first call reads the directory."""
        with self._lock:
            known = self._read_known()
            return sorted(known.values(), key=lambda one: one.id, reverse=True)

    def get(self, report_id: str) -> StoredReport | None:
        """Return the report of an id.

        Args:
            report_id: as a browser may give it; no path is made of it.

        Returns:
            The report; None where there is none.

        """
        with self._lock:
            return self._read_known().get(report_id)

    def begin(self) -> Path:
        """Make a folder for a report, not listed yet.

        Returns:
            The folder.

        Raises:
            GalenError: the directory can't be written.

        """
        try:
            self._directory.mkdir(parents=True, exist_ok=True)
            self._sweep()
            return Path(tempfile.mkdtemp(dir=self._directory, prefix=_UNFINISHED))
        except OSError as error:
            raise GalenError(f"{self._directory}: can't be written: {error.strerror}") from error

    def finish(self, folder: Path, fields: Mapping[str, str]) -> StoredReport:
        """List a written folder.

        Args:
            folder: as `begin` made it; it is renamed.
            fields: StoredReport's fields but id and made_at.

        Returns:
            The report.

        Raises:
            GalenError: the folder can't be written.

        """
        at = datetime.now(UTC)
        name = f"{at.strftime('%Y%m%dT%H%M%SZ')}_{fields['kind']}_{secrets.token_hex(4)}"
        report = StoredReport(id=name, made_at=at.isoformat(timespec="seconds"), **fields)
        content = {"schema_version": _SCHEMA_VERSION, **asdict(report)}
        try:
            (folder / REPORT).write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
            folder.chmod(0o755)  # mkdtemp's 0700 would hide it from the lab's others
            folder.rename(self._directory / name)
        except OSError as error:
            raise GalenError(f"{folder}: can't be written: {error.strerror}") from error
        with self._lock:
            self._read_known()[name] = report
        return report

    def discard(self, folder: Path) -> None:
        """Remove what was begun and not finished.

        Args:
            folder: as `begin` made it; after `finish`, which renames it, nothing is removed.

        """
        shutil.rmtree(folder, ignore_errors=True)

    def files(self, report: StoredReport) -> dict[str, Path]:
        """Return a report's files.

        Args:
            report: one that is listed.

        Returns:
            Path by the name that a browser asks for; no links.

        """
        folder = self._directory / report.id
        if folder.is_symlink() or (folder / DIAGNOSIS_FOLDER).is_symlink():
            return {}
        paths = {name: folder / path for name, (path, _) in _FILES.items()}
        return {n: path for n, path in paths.items() if path.is_file() and not path.is_symlink()}

    def response(self, report_id: str, name: str) -> Response:
        """Answer a browser's request for a file.

        Args:
            report_id: as the browser gives it.
            name: of the file, as the browser gives it.

        Returns:
            The file with its headers; 404 where there is none.

        """
        report = self.get(report_id)
        path = None if report is None else self.files(report).get(name)
        try:
            content = None if path is None else _read(path)
        except (OSError, ValueError):
            content = None
        if content is None:
            return PlainTextResponse("There is no such file of a report.\n", 404)
        content_type = _FILES[name][1]
        headers = {"X-Content-Type-Options": "nosniff", "Cache-Control": "no-store"}
        if content_type.startswith("text/html"):
            headers["Content-Security-Policy"] = _PAGE_POLICY
        if name.endswith((".json", ".yaml")):
            headers["Content-Disposition"] = f'attachment; filename="{name}"'
        return Response(content, media_type=content_type, headers=headers)

    def serve(self, app: Starlette) -> None:
        """Add the route of the reports' files, and read which reports there are.

        Args:
            app: the server's.

        """
        self.all()

        async def answer(request: Request) -> Response:
            asked = request.path_params
            return await run_in_threadpool(self.response, asked["report"], asked["name"])

        app.add_route(f"{REPORTS_PATH}/{{report}}/{{name}}", answer, methods=["GET"])

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
            if folder.is_symlink():
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


def _read(path: Path) -> bytes:
    """Read a file; raises OSError, and ValueError where it is too large."""
    if path.is_symlink():
        raise OSError(f"{os.fspath(path.name)} is a link")
    return read_limited(path, _MOST_BYTES, "a report's file")
