"""The recordings at hand, the jobs on them, and the reports; the same for every browser. No ROS."""

from __future__ import annotations

import threading
from pathlib import Path

from galen_panel.recordings.index import (
    BESIDE,
    Details,
    FoundRecording,
    ToolChoice,
    find_recordings,
    look_at,
    tool_choices,
)
from galen_panel.recordings.jobs import Jobs, Wanted
from galen_panel.recordings.reports import Reports
from galen_panel.snapshot import CallAnswer

_GONE = "That recording is not on the list any more. Look again."
_NO_TOOL = "That calibration file is not there any more. Choose another one."


class Recordings:
    """Finds bags below a directory, evaluates and diagnoses them; used from several threads."""

    def __init__(self, bags_dir: Path, tools_dir: Path, output_dir: Path) -> None:
        self.bags_dir, self.tools_dir = bags_dir, tools_dir
        self.problem = ""
        self.reports = Reports(output_dir)
        self.jobs = Jobs(self.reports)
        self._lock = threading.Lock()
        self._found: list[FoundRecording] | None = None
        self._details: dict[str, Details] = {}

    def search(self, again: bool = False) -> list[FoundRecording]:
        """Search the directory, newest first, or return what was found; as slow as the disk is."""
        with self._lock:
            if self._found is None or again:
                self._found, self.problem = find_recordings(self.bags_dir)
                self._details = {}
            return self._found

    def matching(self, text: str) -> list[FoundRecording]:
        """List those whose name or kind holds each word of a text; case makes no difference."""
        words = text.casefold().split()
        return [
            one
            for one in self.search()
            if all(word in f"{one.name} {one.kind}".casefold() for word in words)
        ]

    def details(self, recording: FoundRecording) -> Details:
        """Describe a recording by its metadata, read once until the next search."""
        with self._lock:
            known = self._details.get(recording.id)
        if known is None:
            known = look_at(recording, self.bags_dir)
            with self._lock:
                self._details[recording.id] = known
        return known

    def tools(self, recording_id: str) -> list[ToolChoice]:
        """List the calibration files that fit a recording's place; reads them."""
        recording = self._get(recording_id)
        if recording is None:
            return []
        return tool_choices(recording, self.bags_dir, self.tools_dir)

    def start(self, recording_id: str, tool_id: str) -> CallAnswer:
        """Evaluate a bag, diagnose a diagnosis recording; ids as they were given to the browser."""
        recording = self._get(recording_id)
        if recording is None:
            return CallAnswer(False, _GONE)
        # Files may have changed since they were listed.
        problem = look_at(recording, self.bags_dir).problem
        if problem:
            return CallAnswer(False, f"{recording.name} can't be used. {problem}")
        tool = next((one for one in self.tools(recording_id) if one.id == tool_id), None)
        if tool is None:
            return CallAnswer(False, _NO_TOOL)
        # The diagnosis takes the file in the recording by itself.
        own = bool(recording.parts) and tool.id == BESIDE and tool.path.parent == recording.path
        return self.jobs.submit(
            Wanted(
                kind="diagnose" if recording.parts else "evaluate",
                recording=recording.name,
                recording_id=recording.id,
                path=recording.path,
                tool=tool.label,
                calibration_path=None if own else tool.path,
            )
        )

    def _get(self, recording_id: str) -> FoundRecording | None:
        """Return the recording of an id; None where there is none, or no search was made."""
        return next((one for one in self._found or () if one.id == recording_id), None)
