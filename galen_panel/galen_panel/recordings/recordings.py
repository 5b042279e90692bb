# SPDX-License-Identifier: Apache-2.0
"""The recordings below a directory, from their metadata alone, and what is done with them. No ROS.

An archive may hold thousands: the search asks the file system only, and metadata is read for those
that are shown. The browser names a recording by the id that it got from here, never by a path.
"""

from __future__ import annotations

import hashlib
import os
import re
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

from galen_bags.formats.errors import BagError
from galen_bags.formats.files import find_bags, read_metadata, storage_files
from galen_diagnosis.observation.recording import RECORDING_FILES
from galen_diagnosis.observation.rows import BAGS
from galen_diagnosis.observation.specification import presets
from galen_model.arm.arm import Arm
from galen_model.arm.galen import GALEN
from galen_model.errors import GalenError, one_line
from galen_model.files.calibration_store import CalibrationStore

from galen_panel.messages import texts
from galen_panel.recordings.jobs import Jobs, Wanted
from galen_panel.recordings.reports import Reports
from galen_panel.state.snapshot import CallAnswer

TOOL_BESIDE = "tool.json"
BESIDE = "beside"
_TOOLS_OF_BAGS = "tools"
_METADATA = "metadata.yaml"
_ID_LETTERS = 16
_HEAD_BYTES = 4096
_GONE = "That recording is not on the list any more. Look again."
_NO_TOOL = "That calibration file is not there any more. Choose another one."
_NO_SPECIFICATION = "That specification is not on the list. Choose another one."
_NO_REFERENCE = "What to compare with is not on the list any more. Look again."
_NEVER_NS = 2**63 - 1  # rosbag2's start of a bag without messages
_BEGAN = re.compile(rb"starting_time:\s*nanoseconds_since_epoch:\s*(\d{1,19})\b")


@dataclass(frozen=True)
class FoundRecording:
    """A bag, which is evaluated, or a diagnosis recording with its bags, which is diagnosed.

    name: its path below the directory. at_s: when it was recorded, s since 1970; without metadata
    when it was written. parts: bags of a diagnosis recording, empty for a bag.
    """

    id: str
    name: str
    path: Path
    at_s: float
    parts: tuple[FoundRecording, ...] = ()

    @property
    def kind(self) -> str:
        """What it is, for a person."""
        return "diagnosis recording" if self.parts else "bag"


@dataclass(frozen=True)
class Details:
    """Sizes and metadata; duration_s None where unknown; problem: why it can't be used."""

    size_bytes: int = 0
    duration_s: float | None = None
    problem: str = ""


@dataclass(frozen=True)
class ToolChoice:
    """A calibration file; id: the browser's name for it, label: a person's."""

    id: str
    label: str
    path: Path


class Recordings:
    """Finds bags below a directory, evaluates and diagnoses them; used from several threads."""

    def __init__(
        self,
        bags_dir: Path,
        tools_dir: Path,
        output_dir: Path,
        arm: Callable[[], Arm] = lambda: GALEN,
        specification: Sequence[str] = (),
    ) -> None:
        """Start without a search.

        Args:
            bags_dir: the directory that is searched.
            tools_dir: folder of calibration files.
            output_dir: folder of the reports.
            arm: returns the arm of the calibration files, and of recordings that don't describe
                theirs.
            specification: presets and files that a diagnosis takes unless others are chosen.

        """
        self._arm = arm
        self.specification = tuple(specification)
        self.bags_dir, self.tools_dir = bags_dir, tools_dir
        self.problem = ""
        self.reports = Reports(output_dir)
        self.jobs = Jobs(self.reports)
        self._lock = threading.Lock()
        self._found: list[FoundRecording] | None = None
        self._details: dict[str, Details] = {}

    def search(self, again: bool = False) -> list[FoundRecording]:
        """Search the directory, or return what was found; as slow as the disk is.

        Args:
            again: whether to search although it was done.

        Returns:
            The recordings, newest first; `problem` has the reason where there are none.

        """
        with self._lock:
            if self._found is None or again:
                self._found, self.problem = find_recordings(self.bags_dir)
                self._details = {}
            return self._found

    def matching(self, text: str) -> list[FoundRecording]:
        """List those whose name or kind holds each word of a text; case makes no difference.

        Args:
            text: words with spaces between; empty: all recordings match.

        Returns:
            The recordings, newest first.

        """
        words = text.casefold().split()
        return [
            one
            for one in self.search()
            if all(word in f"{one.name} {one.kind}".casefold() for word in words)
        ]

    def details(self, recording: FoundRecording) -> Details:
        """Describe a recording by its metadata, read once until the next search.

        Args:
            recording: one that was found.

        Returns:
            Sizes and metadata.

        """
        with self._lock:
            known = self._details.get(recording.id)
        if known is None:
            known = look_at(recording, self.bags_dir)
            with self._lock:
                self._details[recording.id] = known
        return known

    def tools(self, recording_id: str) -> list[ToolChoice]:
        """List the calibration files that fit a recording's place; reads them.

        Args:
            recording_id: the recording's.

        Returns:
            The files; none for an unknown recording.

        """
        recording = self._get(recording_id)
        if recording is None:
            return []
        return tool_choices(recording, self.bags_dir, self.tools_dir, self._arm())

    def specifications(self) -> list[str]:
        """List what a diagnosis can take for healthy: the panel's own files, and all presets."""
        return list(dict.fromkeys((*self.specification, *presets())))

    def references(self, recording_id: str) -> list[FoundRecording]:
        """List the other diagnosis recordings: what one can be compared with.

        Args:
            recording_id: the one that is left out.

        Returns:
            The recordings, newest first.

        """
        return [one for one in self._found or () if one.parts and one.id != recording_id]

    def start(
        self,
        recording_id: str,
        tool_id: str,
        specification: Sequence[str] = (),
        reference_ids: Sequence[str] = (),
    ) -> CallAnswer:
        """Evaluate a bag, diagnose a diagnosis recording; ids as they were given to the browser.

        Args:
            recording_id: the recording's.
            tool_id: the calibration file's, one of `tools`.
            specification: of a diagnosis, some of `specifications`; where two have a number, the
                first one's counts.
            reference_ids: of a diagnosis, some of `references`.

        Returns:
            Whether it is in the queue now, and a sentence.

        """
        recording = self._get(recording_id)
        if recording is None:
            return CallAnswer(False, _GONE)
        if not set(specification) <= set(self.specifications()):
            return CallAnswer(False, _NO_SPECIFICATION)
        offered = self.references(recording_id)
        if not set(reference_ids) <= {one.id for one in offered}:
            return CallAnswer(False, _NO_REFERENCE)
        references = [one for one in reversed(offered) if one.id in reference_ids]
        for one in (recording, *references):
            # Files may have changed since they were listed.
            problem = look_at(one, self.bags_dir).problem
            if problem:
                return CallAnswer(False, f"{one.name} can't be used. {problem}")
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
                arm=self._arm(),
                specification=tuple(specification),
                reference=tuple(one.path for one in references),
            )
        )

    def _get(self, recording_id: str) -> FoundRecording | None:
        """Return the recording of an id; None where there is none, or no search was made."""
        return next((one for one in self._found or () if one.id == recording_id), None)


def find_recordings(directory: Path) -> tuple[list[FoundRecording], str]:
    """Search a directory for recordings.

    Args:
        directory: with all folders below it.

    Returns:
        The recordings, newest first; the reason where there are none.

    """
    try:
        bags = find_bags([directory])
    except BagError as error:
        return [], str(error)
    found = [_recording(bag, directory, _at_s(bag)) for bag in bags]
    for folder, parts in _sets(found):
        at_s = min(part.at_s for part in parts)
        found.append(_recording(folder, directory, at_s, tuple(parts)))
    return sorted(found, key=lambda one: (-one.at_s, one.name)), ""


def look_at(recording: FoundRecording, directory: Path) -> Details:
    """Read a recording's metadata.

    Args:
        recording: one that was found.
        directory: the one that was searched; a link that leads out of it is a problem.

    Returns:
        Sizes and metadata; what can't be read becomes `problem`.

    """
    root = directory.resolve()
    if not recording.parts:
        return _look_at_bag(recording.path, directory, root)
    parts = {part.path.name: _look_at_bag(part.path, directory, root) for part in recording.parts}
    problems = [f"{name}: {part.problem}" for name, part in parts.items() if part.problem]
    # A diagnosis opens whatever has these names, also what is no bag and so was not found.
    for entry in (recording.path / name for name in (*BAGS, *RECORDING_FILES)):
        if entry.name not in parts and entry.exists() and leads_out(entry, root):
            problems.append(f"{entry.name} is a link that leads out of {directory}.")
    lengths = [part.duration_s for part in parts.values() if part.duration_s is not None]
    return Details(
        sum(part.size_bytes for part in parts.values()),
        sum(lengths) if len(lengths) == len(parts) else None,
        " ".join(problems),
    )


def leads_out(path: Path, root: Path) -> bool:
    """Return whether a path, its links followed, is outside of a directory.

    Args:
        path: to look at.
        root: the directory, without links.

    Returns:
        True also where the links can't be followed.

    """
    try:
        return not path.resolve().is_relative_to(root)
    except (OSError, RuntimeError):  # such as links in a circle, up to Python 3.12
        return True


def tool_choices(
    recording: FoundRecording, bags_dir: Path, tools_dir: Path, arm: Arm
) -> list[ToolChoice]:
    """List an arm's usable calibration files.

    Args:
        recording: whose folder, and the one above, may have a `tool.json`.
        bags_dir: its folder `tools` is read; a link that leads out of it is left out.
        tools_dir: folder of calibration files.
        arm: whose files they must be.

    Returns:
        The files: beside the recording, then of the two directories.

    """
    choices = []
    folder = recording.path if recording.path.is_dir() else recording.path.parent
    root = bags_dir.resolve()
    for place in (folder, folder.parent):
        beside = place / TOOL_BESIDE
        if beside.is_file() and not leads_out(beside, root):
            choices.append(ToolChoice(BESIDE, f"{TOOL_BESIDE} beside the recording", beside))
            break
    stores = {"tools": CalibrationStore(tools_dir, arm)}
    of_bags = CalibrationStore(bags_dir / _TOOLS_OF_BAGS, arm)
    same = of_bags.directory.resolve() == stores["tools"].directory.resolve()
    if not same and not leads_out(of_bags.directory, root):
        stores["bags"] = of_bags
    for key, store in stores.items():
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


def line_of(recording: FoundRecording, details: Details) -> str:
    """Write when, how long, how large, in a line.

    Args:
        recording: one that was found.
        details: of it.

    Returns:
        The line.

    """
    parts = [texts.date(datetime.fromtimestamp(recording.at_s, UTC).isoformat(timespec="seconds"))]
    if details.duration_s is not None:
        parts.append(f"{details.duration_s:.0f} s")
    parts.append(f"{1e-6 * details.size_bytes:.1f} MB")
    if recording.parts:
        parts.append(recording.kind)
    return ", ".join(parts)


def _recording(
    path: Path, directory: Path, at_s: float, parts: tuple[FoundRecording, ...] = ()
) -> FoundRecording:
    relative = os.path.relpath(path, directory)
    name = one_line(directory.resolve().name if relative == "." else relative)
    found = FoundRecording("", name, path, at_s, parts)
    whole = f"{found.kind}:{relative}".encode(errors="surrogateescape")
    return replace(found, id=hashlib.sha256(whole).hexdigest()[:_ID_LETTERS])


def _at_s(path: Path) -> float:
    """When a bag was recorded, in a look at its metadata's head: all of it takes 30 ms to parse."""
    try:
        with (path / _METADATA).open("rb") as stream:
            began = _BEGAN.search(stream.read(_HEAD_BYTES))
        if began is not None and int(began[1]) < _NEVER_NS:
            return float(int(began[1]) * 1e-9)
    except OSError:
        pass
    try:
        return path.stat().st_mtime
    except OSError:
        return 0.0


def _sets(bags: Iterable[FoundRecording]) -> Iterator[tuple[Path, list[FoundRecording]]]:
    """Folders with the bags of a diagnosis recording, and these."""
    folders: dict[Path, list[FoundRecording]] = {}
    for bag in bags:
        if bag.path.name in BAGS and bag.path.is_dir():
            folders.setdefault(bag.path.parent, []).append(bag)
    for folder, parts in folders.items():
        # One bag of such a name alone is any recording; with a calibration file beside it is meant.
        if len(parts) > 1 or (folder / TOOL_BESIDE).is_file():
            yield folder, parts


def _look_at_bag(path: Path, directory: Path, root: Path) -> Details:
    metadata_file = path / _METADATA
    try:
        files = storage_files(path) if path.is_dir() else [path]
        if any(leads_out(part, root) for part in (path, metadata_file, *files)):
            return Details(problem=f"It is a link that leads out of {directory}.")
        size_bytes = sum(file.stat().st_size for file in files)
    except OSError as error:
        return Details(problem=f"It can't be read: {error.strerror}.")
    metadata = read_metadata(path)
    duration_s = None
    if metadata.start_ns is not None and metadata.end_ns is not None:
        duration_s = (metadata.end_ns - metadata.start_ns) * 1e-9
    return Details(size_bytes, duration_s, "" if files else "Its files are missing.")
