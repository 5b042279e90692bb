# SPDX-License-Identifier: Apache-2.0
"""How a behaviour ended, what a new calibration changes, and what a person may do about it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from galen_model.load.verdict import TARE_COMMAND, Cause, CheckAnswer
from nicegui import ui

from galen_panel.messages import programs, texts
from galen_panel.page.page import Page, confirmed, pick_class, table
from galen_panel.state.snapshot import (
    LOST,
    BehaviourKind,
    BehaviourOutcome,
    CallAnswer,
    QuantityDifference,
    SuiteState,
    ToolComparison,
)

_ICONS = {"positive": "check_circle", "warning": "warning", "negative": "error"}
_DONE = {
    BehaviourKind.CALIBRATE: "Calibrated",
    BehaviourKind.CHECK: "Checked",
    BehaviourKind.COLLECT: "Collected",
}
_ENDS = {"CANCELED": ("Canceled", "warning"), LOST: ("Lost", "negative")}
_VERDICTS: dict[object, tuple[str, str]] = {
    CheckAnswer.GOOD: ("Good: the file fits", "positive"),
    CheckAnswer.RETARE: ("Tare it", "warning"),
    CheckAnswer.RECALIBRATE: ("It does not fit: calibrate again", "negative"),
    CheckAnswer.UNSURE: ("Not decidable: check again", "warning"),
}
# Another calibration would not help these.
_NOT_ON: dict[object, tuple[str, str]] = {
    Cause.OTHER_TOOL: ("It does not fit: another tool is on", "negative"),
    Cause.NO_TOOL: ("It does not fit: no tool is on", "negative"),
}


HERE = "The new file is written. Keep it to compensate with it now, or discard it."
ACTIVE = "The new file is active."
REPLACED = "The file is another one by now: this calibration was discarded or replaced."


def title_and_level(kind: BehaviourKind, outcome: BehaviourOutcome) -> tuple[str, str]:
    """Title an outcome and give its level.

    Args:
        kind: of the behaviour.
        outcome: its end.

    Returns:
        Title; level: positive, warning or negative.

    """
    if outcome.error:
        return _ENDS.get(outcome.error, ("It failed", "negative"))
    if kind is not BehaviourKind.CHECK:
        return _DONE[kind], "positive"
    answer, cause = outcome.values.get("answer"), outcome.values.get("cause")
    return _NOT_ON.get(cause) or _VERDICTS.get(answer, _VERDICTS[CheckAnswer.UNSURE])


def sentence_of(outcome: BehaviourOutcome) -> str:
    """Return the sentence without commands for a terminal: the page has buttons.

    Args:
        outcome: a behaviour's end.

    Returns:
        The sentence.

    """
    return texts.sentence(outcome.text.replace(f": {TARE_COMMAND}", ""), outcome.tool)


def fate(outcome: BehaviourOutcome, state: SuiteState) -> str:
    """Describe where a calibration's file is now, from any page.

    A file is known by mass and centre, which are written with all their digits.

    Args:
        outcome: of a calibration that came to its end.
        state: with the list of tools, and the active tool.

    Returns:
        HERE, ACTIVE or REPLACED.

    """
    found = next((tool for tool in state.tools or () if tool.name == outcome.tool), None)
    if found is None or found.problem or not _is(outcome, found.mass_kg, found.com_m):
        return REPLACED
    now = state.active_tool
    if now and now.tool == outcome.tool and _is(outcome, now.mass_kg, now.com_m):
        return ACTIVE
    return HERE


def load_rows(outcome: BehaviourOutcome) -> list[list[str]]:
    """Write mass and centre that a calibration found.

    Args:
        outcome: of a calibration that came to its end.

    Returns:
        Rows of texts: name, value with its standard deviation.

    """
    values = outcome.values
    com, com_std = _vector(values, "com_m"), _vector(values, "com_std_m")
    rows = [["mass", texts.mass(_number(values, "mass_kg"), _number(values, "mass_std_kg"))]]
    for axis, value, std in zip("xyz", com, com_std, strict=True):
        rows.append([f"centre {axis}", f"{1e3 * value:.2f} ± {1e3 * std:.2f} mm"])
    return rows


def left_out(outcome: BehaviourOutcome) -> list[str]:
    """List poses or pushes that were not used, with their reasons.

    Args:
        outcome: a behaviour's end.

    Returns:
        A text for each.

    """
    found = outcome.values.get("poses_rejected") or outcome.values.get("left_out") or ()
    return [str(text) for text in found] if isinstance(found, Sequence) else []


class OutcomeView:
    """One outcome; drawn once, then its buttons follow the state."""

    def __init__(self, page: Page, kind: BehaviourKind, outcome: BehaviourOutcome) -> None:
        self._file: FileNotice | None = None
        title, level = title_and_level(kind, outcome)
        with ui.column().classes("panel-outcome") as element:
            element.props("role=status data-testid=outcome")
            pick_class(element, "panel-level-", level)
            with ui.row().classes("panel-outcome-head no-wrap"):
                ui.icon(_ICONS[level]).props("aria-hidden=true").classes(f"text-{level}")
                ui.label(f"{title} · {outcome.tool}" if outcome.tool else title)
                ui.space()
                close = ui.button(icon="close", on_click=lambda: element.set_visibility(False))
                close.props('flat round aria-label="Close the result" data-testid=outcome-close')
            ui.label(sentence_of(outcome)).props("data-testid=outcome-text")
            warnings = list(outcome.warnings)
            if outcome.values.get("calibration_holds") is False:
                warnings.append("The tracker's base moved between begin and end: collect again.")
            for warning in warnings:
                with ui.row().classes("no-wrap items-start"):
                    ui.icon("warning").classes("text-warning panel-icon").props("aria-hidden=true")
                    ui.label(texts.sentence(warning))
            if kind is BehaviourKind.CALIBRATE and not outcome.error:
                self._file = FileNotice(page, outcome)
            elif outcome.file:
                ui.label(f"The recording is {outcome.file}").classes("panel-path")
            for note in outcome.notes:
                ui.label(texts.sentence(note)).classes("panel-quiet")
            reasons = left_out(outcome)
            if reasons:
                with ui.expansion(f"{len(reasons)} not used").props("dense").classes("w-full"):
                    ui.label("\n".join(reasons)).classes("panel-lines")

    def update(self, state: SuiteState) -> None:
        """Follow the state with the buttons.

        Args:
            state: the newest.

        """
        if self._file is not None:
            self._file.update(state)


class FileNotice:
    """The file of a calibration that came to its end: what it changes, keep, discard."""

    def __init__(self, page: Page, outcome: BehaviourOutcome) -> None:
        self._page = page
        self._outcome = outcome
        self._listed = False
        if outcome.new:
            table([], load_rows(outcome))
        force = texts.norm(_vector(outcome.values, "rmse_force_n"))
        torque = texts.norm(_vector(outcome.values, "rmse_torque_nm"))
        text = f"Residual of the averaged readings: {texts.size(force, torque)}."
        ui.label(text).classes("panel-number")
        if model := outcome.values.get("model"):
            ui.label(texts.model_sentence(str(model)))
            reason = f"Model: {model} - {outcome.values.get('model_reason', '')}"
            with ui.expansion("Details of the fit").props("dense").classes("w-full"):
                ui.label(texts.sentence(reason)).classes("panel-lines")
        self._beside = ui.column().classes("w-full gap-2").props("data-testid=beside")
        self._fate = ui.label().classes("panel-lead").props("role=status data-testid=fate")
        with ui.row():
            self._keep = ui.button("Keep", icon="check", on_click=self._on_keep)
            self._keep.props("unelevated data-testid=keep")
            self._discard = ui.button("Discard", icon="undo", on_click=self._on_discard)
            self._discard.props("outline color=negative data-testid=discard")
        ui.timer(0.0, self._look, once=True)

    def update(self, state: SuiteState) -> None:
        """Follow the state: another browser may have kept or discarded it.

        Args:
            state: the newest.

        """
        now = fate(self._outcome, state)
        replaced = now == REPLACED
        # The list is from before the calibration until it has been read again.
        reading = replaced and not self._listed
        text = "Reading the new file." if reading else now
        why_not = text if replaced else ""
        way_back = "gravcomp/remove_tool" if self._outcome.new else "gravcomp/revert_tool"
        kept = text if now == ACTIVE else ""
        self._fate.set_text(text)
        self._page.allow(
            self._keep, why_not or kept or programs.missing(state, "gravcomp/set_tool")
        )
        self._page.allow(self._discard, why_not or programs.missing(state, way_back))

    async def _look(self) -> None:
        suite = self._page.suite
        listed = await suite.list_tools()
        self._listed = listed.ok
        self.update(suite.state)
        if not listed.ok:
            self._page.tell(listed)
        if self._outcome.new:
            with self._beside:
                ui.label("The tool had no file before.")
            return
        found = await suite.compare(self._outcome.tool)
        with self._beside:
            if isinstance(found, CallAnswer):
                ui.label(found.text)
            else:
                draw_comparison(found, "before", "new")

    async def _on_keep(self) -> None:
        await self._page.ask(self._page.suite.activate(self._outcome.tool), self._keep)

    async def _on_discard(self) -> None:
        suite, tool = self._page.suite, self._outcome.tool
        sentences = [
            f"The calibration of {tool} before comes back.",
            "The new one is kept as the one before: going back once more brings it again.",
        ]
        if self._outcome.new:
            sentences = [
                f"{tool} had no file before: it leaves the list of tools.",
                "The new file is not deleted: it is kept beside the others, under another name.",
            ]
        title = "Discard this calibration?"
        if await confirmed(self._page, title, sentences, "Discard it", "undo"):
            back = suite.remove_tool if self._outcome.new else suite.revert_tool
            await self._page.ask(back(tool), self._discard)


_LOAD = ("mass", "com_x", "com_y", "com_z")
_THE_SAME = "the same"


def draw_comparison(comparison: ToolComparison, before: str, after: str) -> None:
    """Draw what differs between two calibration files.

    Args:
        comparison: of files a and b.
        before: what file a is called here.
        after: what file b is called here.

    """
    size = texts.size(comparison.worst_force_n, comparison.worst_torque_nm)
    ui.label(f"What is compensated differs by at most {size}, over all poses.").classes(
        "panel-lead"
    )
    ui.label(
        "Mass and centre agree within both calibrations' uncertainty."
        if comparison.same_load
        else "Mass or centre differ by more than both calibrations' uncertainty."
    )
    rows = [_row(row) for row in comparison.differences if is_shown(row)]
    with ui.element("div").classes("panel-scroll"):
        table(["", before, after, "difference", "σ"], rows)


def is_shown(row: QuantityDifference) -> bool:
    """Return whether a quantity is mass or centre, or another one that differs.

    Args:
        row: of a comparison.

    Returns:
        True where its row is to be drawn.

    """
    return row.quantity in _LOAD or not row.text.startswith(_THE_SAME)


def _row(row: QuantityDifference) -> list[str]:
    return [
        texts.quantity_name(row.quantity),
        texts.quantity(row.a, row.unit),
        texts.quantity(row.b, row.unit),
        texts.change(row.b - row.a, row.unit),
        texts.sigmas(row.b - row.a, row.std_dev),
    ]


def _is(outcome: BehaviourOutcome, mass_kg: float, com_m: Sequence[float]) -> bool:
    written = [_number(outcome.values, "mass_kg"), *_vector(outcome.values, "com_m")]
    return bool(np.allclose(written, [mass_kg, *com_m], rtol=1e-9, atol=1e-12))


def _number(values: Mapping[str, object], name: str) -> float:
    value = values.get(name)
    return float(value) if isinstance(value, (int, float)) else math.nan


def _vector(values: Mapping[str, object], name: str) -> list[float]:
    value = values.get(name)
    if not isinstance(value, (Sequence, np.ndarray)) or len(value) != 3:
        return [math.nan] * 3
    return [float(part) for part in value]
