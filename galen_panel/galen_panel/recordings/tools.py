"""The tools' files that a recording can be evaluated with. No ROS."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from galen_model.errors import GalenError
from galen_model.files.calibration_store import CalibrationStore

from galen_panel.recordings.index import TOOL_BESIDE, Recording, leads_out

BESIDE = "beside"
_TOOLS_OF_BAGS = "tools"


@dataclass(frozen=True)
class ToolChoice:
    """One of them. id: what the browser names it by. label: for a person."""

    id: str
    label: str
    path: Path


def tool_choices(recording: Recording, bags_dir: Path, tools_dir: Path) -> list[ToolChoice]:
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
