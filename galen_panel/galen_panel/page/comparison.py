"""Two tools' files beside each other, for a person who must choose."""

from __future__ import annotations

from nicegui import ui

from galen_panel.messages import texts
from galen_panel.page.elements import table
from galen_panel.state.snapshot import Comparison, Difference

_LOAD = ("mass", "com_x", "com_y", "com_z")
_THE_SAME = "the same"


def draw(comparison: Comparison, before: str, after: str) -> None:
    """Draw what differs. before, after: what the two files, a and b, are called here."""
    ui.label(worst_case(comparison)).classes("panel-lead")
    ui.label(same_load(comparison))
    headers = ["", before, after, "difference", "σ"]
    with ui.element("div").classes("panel-scroll"):
        table(headers, [_row(row) for row in comparison.differences if row.quantity in _LOAD])
    others = [row for row in comparison.differences if differs_beside(row)]
    if others:
        with (
            ui.expansion(f"{len(others)} other numbers differ").props("dense").classes("w-full"),
            ui.element("div").classes("panel-scroll"),
        ):
            table(headers, [_row(row) for row in others])


def differs_beside(row: Difference) -> bool:
    """Whether a quantity that is neither mass nor centre is another one."""
    return row.quantity not in _LOAD and not row.text.startswith(_THE_SAME)


def _row(row: Difference) -> list[str]:
    return [
        texts.quantity_name(row.quantity),
        texts.quantity(row.a, row.unit),
        texts.quantity(row.b, row.unit),
        texts.change(row.b - row.a, row.unit),
        texts.sigmas(row.b - row.a, row.std_dev),
    ]


def worst_case(comparison: Comparison) -> str:
    """What the difference means for who holds the tool."""
    size = texts.size(comparison.worst_force_n, comparison.worst_torque_nm)
    return f"What is compensated differs by at most {size}, over all poses."


def same_load(comparison: Comparison) -> str:
    """Whether it is the same tool as far as anybody can tell."""
    if comparison.same_load:
        return "Mass and centre are the same as far as both calibrations can tell."
    return "Mass or centre differ by more than both calibrations' uncertainty."
