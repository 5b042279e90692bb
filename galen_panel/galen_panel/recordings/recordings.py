"""The recordings at hand, the jobs on them, and the reports; the same for every browser. No ROS."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from pathlib import Path

from galen_model.errors import GalenError
from galen_model.files.calibration_store import CalibrationStore
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response

from galen_panel.recordings.index import (
    TOOL_BESIDE,
    Details,
    FoundRecording,
    Index,
    RecordingKind,
    find_recordings,
    leads_out,
    look_at,
)
from galen_panel.recordings.jobs import Jobs, Wanted
from galen_panel.recordings.report_files import Reports
from galen_panel.snapshot import CallAnswer

BESIDE = "beside"
_TOOLS_OF_BAGS = "tools"


@dataclass(frozen=True)
class ToolChoice:
    """One of them. id: what the browser names it by. label: for a person."""

    id: str
    label: str
    path: Path


def tool_choices(recording: FoundRecording, bags_dir: Path, tools_dir: Path) -> list[ToolChoice]:
    """The file beside the recording first, then those of the two directories; usable ones only."""
    choices = []
    folder = recording.path if recording.path.is_dir() else recording.path.parent
    root = bags_dir.resolve()
    for place in (folder, folder.parent):
        beside = place / TOOL_BESIDE
        if beside.is_file() and not leads_out(beside, root):
            choices.append(ToolChoice(BESIDE, f"{TOOL_BESIDE} beside the recording", beside))
            break
    stores = {
        "tools": CalibrationStore(tools_dir),
        "bags": CalibrationStore(bags_dir / _TOOLS_OF_BAGS),
    }
    if stores["tools"].directory.resolve() == stores["bags"].directory.resolve():
        del stores["bags"]
    for key, store in stores.items():
        if key == "bags" and leads_out(store.directory, root):
            continue
        try:
            entries = list(store.entries())
        except GalenError:
            continue
        where = "" if key == "tools" else " (kept with the recordings)"
        choices += [
            ToolChoice(f"{key}:{entry.name}", f"{entry.name}{where}", entry.stored.path)
            for entry in entries
            if entry.stored is not None
        ]
    return choices


REPORTS_PATH = "/reports"
PAGE_LENGTH = 15
_GONE = "That recording is not on the list any more. Look again."
_NO_TOOL = "That calibration file is not there any more. Choose another one."
# A report's own page needs nothing but its pictures, which are in it, and may not run anything.
_REPORT_POLICY = (
    "sandbox; default-src 'none'; img-src data:; style-src 'unsafe-inline'; base-uri 'none';"
    " form-action 'none'; frame-ancestors 'self'"
)


@dataclass(frozen=True)
class ListEntry:
    """A recording on the list, with its number in it."""

    number: int
    recording: FoundRecording
    details: Details


@dataclass(frozen=True)
class ListPage:
    """A part of the list. total: how many match; number: of this page, from 0."""

    listed: tuple[ListEntry, ...]
    total: int
    number: int
    pages: int
    problem: str


class Recordings:
    """Finds bags below a directory, evaluates and diagnoses them; used from several threads."""

    def __init__(self, bags_dir: Path, tools_dir: Path, output_dir: Path) -> None:
        self.bags_dir, self.tools_dir, self.output_dir = bags_dir, tools_dir, output_dir
        self.reports = Reports(output_dir)
        self.jobs = Jobs(self.reports)
        self._lock = threading.Lock()
        self._index: Index | None = None
        self._details: dict[str, Details] = {}

    def search(self, again: bool = False) -> Index:
        """Search the directory, or say what was found; as slow as the disk is."""
        with self._lock:
            if self._index is None or again:
                self._index = find_recordings(self.bags_dir)
                self._details = {}
            return self._index

    def page(self, text: str = "", number: int = 0) -> ListPage:
        """A page of those that match a text, the newest first; reads their metadata."""
        index = self.search()
        matching = index.matching(text)
        pages = max(1, -(-len(matching) // PAGE_LENGTH))
        number = min(max(number, 0), pages - 1)
        first = number * PAGE_LENGTH
        shown = matching[first : first + PAGE_LENGTH]
        listed = tuple(
            ListEntry(first + place, one, self.details(one)) for place, one in enumerate(shown)
        )
        return ListPage(listed, len(matching), number, pages, index.problem)

    def details(self, recording: FoundRecording) -> Details:
        """What a recording's metadata says, read once until the next search."""
        with self._lock:
            known = self._details.get(recording.id)
        if known is None:
            known = look_at(recording, self.bags_dir)
            with self._lock:
                self._details[recording.id] = known
        return known

    def get(self, recording_id: str) -> FoundRecording | None:
        """The recording of an id; None where there is none, or no search was made."""
        return None if self._index is None else self._index.get(recording_id)

    def tools(self, recording_id: str) -> list[ToolChoice]:
        """The calibration files that a recording can be looked at with; reads them."""
        recording = self.get(recording_id)
        if recording is None:
            return []
        return tool_choices(recording, self.bags_dir, self.tools_dir)

    def start(self, recording_id: str, tool_id: str) -> CallAnswer:
        """Evaluate a bag, diagnose a diagnosis recording; ids as they were given to the browser."""
        recording = self.get(recording_id)
        if recording is None:
            return CallAnswer(False, _GONE)
        # Files may have changed since they were listed.
        problem = look_at(recording, self.bags_dir).problem
        if problem:
            return CallAnswer(False, f"{recording.name} can't be used. {problem}")
        tool = next((one for one in self.tools(recording_id) if one.id == tool_id), None)
        if tool is None:
            return CallAnswer(False, _NO_TOOL)
        diagnosis = recording.kind is RecordingKind.DIAGNOSIS
        # The diagnosis takes the file in the recording by itself.
        own = diagnosis and tool.id == BESIDE and tool.path.parent == recording.path
        return self.jobs.submit(
            Wanted(
                kind="diagnose" if diagnosis else "evaluate",
                recording=recording.name,
                recording_id=recording.id,
                path=recording.path,
                tool=tool.label,
                calibration_path=None if own else tool.path,
            )
        )

    def serve(self, app: Starlette) -> None:
        """Add the routes of reports and pictures, and read which reports there are."""
        self.reports.all()
        app.add_route(f"{REPORTS_PATH}/{{report}}/{{name}}", self._answer, methods=["GET"])

    def close(self) -> None:
        """End what runs."""
        self.jobs.close()

    async def _answer(self, request: Request) -> Response:
        report, name = request.path_params["report"], request.path_params["name"]
        served = await run_in_threadpool(self.reports.serve, report, name)
        if served is None:
            return PlainTextResponse("There is no such file of a report.\n", 404)
        headers = {"X-Content-Type-Options": "nosniff", "Cache-Control": "no-store"}
        if served.content_type.startswith("text/html"):
            headers["Content-Security-Policy"] = _REPORT_POLICY
        if served.attachment:
            headers["Content-Disposition"] = f'attachment; filename="{name}"'
        return Response(served.content, media_type=served.content_type, headers=headers)
