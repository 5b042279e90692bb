"""The poses of a behaviour that runs, as they are finished."""

from __future__ import annotations

from itertools import groupby

from nicegui import ui

from galen_panel.state import pose_table
from galen_panel.state.running_fit import residuals
from galen_panel.state.snapshot import Behaviour, Kind, Pose

_REASONS = 4


class PosesView:
    """The newest sweep pose by pose; those before it in a sentence each."""

    def __init__(self, behaviour: Behaviour) -> None:
        self._drawn = -1
        self._before = ui.label().classes("panel-number panel-lines")
        self._title = ui.label().classes("panel-number").props("data-testid=poses-summary")
        with ui.element("div").classes("panel-scroll"):
            self._table = ui.html("", sanitize=False).props("data-testid=poses")
        self._rejected = ui.label().classes("panel-lines")
        # A quick check's few poses are for its own fit; what they leave over says nothing here.
        self._fits = behaviour.kind is Kind.CALIBRATE

    def update(self, behaviour: Behaviour) -> None:
        """Draw what is new."""
        if len(behaviour.poses) == self._drawn:
            return
        self._drawn = len(behaviour.poses)
        sweeps = [(name, list(of)) for name, of in groupby(behaviour.poses, lambda p: p.sweep)]
        lines = [_sentence(name, poses, self._fits) for name, poses in sweeps]
        self._before.set_text("\n".join(lines[:-1]))
        self._before.set_visibility(len(lines) > 1)
        newest = sweeps[-1][1] if sweeps else []
        self._title.set_text(lines[-1] if lines else "")
        left = residuals(newest) if self._fits else {}
        self._table.set_content(pose_table.table(newest, left))
        rejected = pose_table.rejections(behaviour.poses)
        more = [f"and {len(rejected) - _REASONS} before"] if len(rejected) > _REASONS else []
        self._rejected.set_text("\n".join(["Not used:", *rejected[-_REASONS:], *more]))
        self._rejected.set_visibility(bool(rejected))


def _sentence(name: str, poses: list[Pose], fits: bool) -> str:
    left = residuals(poses) if fits else {}
    return f"{pose_table.sweep_title(name)}: {pose_table.summary(poses, left)}"
