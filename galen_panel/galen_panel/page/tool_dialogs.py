"""Questions before a calibration file changes: remove, go back, new."""

from __future__ import annotations

from galen_model.errors import GalenError
from galen_model.files.calibration_file import check_tool_name
from nicegui import ui

from galen_panel.messages import hints, texts
from galen_panel.page.calibration_options import AREA_CLEAR, CalibrationOptions
from galen_panel.page.outcome import draw_comparison
from galen_panel.page.page import LOOK_PERIOD_S, Page, buttons, confirmed, dialog
from galen_panel.snapshot import BehaviourKind, CallAnswer


async def remove_tool(page: Page, name: str, button: ui.button) -> None:
    """Take it off the list, once a person has read what becomes of its file."""
    sure = await confirmed(
        page,
        f"Remove {name}?",
        [
            "It goes off the list of tools. Its file is not deleted: it is kept beside the others,"
            " under another name.",
            "The active tool can't be removed.",
        ],
        "Remove it",
        "delete_outline",
    )
    if sure:
        await page.ask(page.suite.remove_tool(name), button)


async def revert_tool(page: Page, name: str, button: ui.button) -> None:
    """Bring back the calibration before, once a person has read what that changes."""
    with page.waiting(button) as free:
        if not free:
            return
        found = await page.suite.compare(name)
    if isinstance(found, CallAnswer):
        page.tell(found)
        return
    with dialog(page, f"Go back to the calibration of {name} before?") as shown:
        ui.label("The present calibration is kept: going back once more brings it again.")
        ui.label("If the tool is active, activate it again afterwards.")
        draw_comparison(found, "before", "now")
        buttons(shown, "Go back", "history").on_click(lambda: shown.submit(True))
        sure = bool(await shown)
    if sure:
        await page.ask(page.suite.revert_tool(name), button)


async def new_tool(page: Page) -> None:
    """Ask for a name and a tip, and start the calibration."""
    with dialog(page, "New tool") as shown:
        name = ui.input("Name", validation=lambda text: name_problem(page, text or "") or None)
        name.props("outlined autofocus data-testid=new-tool-name").classes("w-full")
        name.without_auto_validation()
        options = CalibrationOptions("new-tool")
        before = ui.label().props("data-testid=new-tool-before")

        def look() -> None:
            options.update(page.suite.state)
            before.set_text(" ".join(options.before(page.suite.state)))

        look()
        ui.timer(LOOK_PERIOD_S, look)
        reason = ui.label().classes("text-negative").props("role=status")
        start = buttons(shown, AREA_CLEAR, "play_arrow")

        async def begin() -> None:
            goal = options.goal(name.value or "") if name.validate() else None
            if goal is None:
                return
            why_not = hints.cannot_start(page.suite.state, BehaviourKind.CALIBRATE)
            reason.set_text(why_not)
            if not why_not and (await page.ask(page.suite.start(goal), start)).ok:
                shown.submit(True)

        start.on_click(begin)
        name.on("keydown.enter", begin)
        await shown


def name_problem(page: Page, name: str) -> str:
    """Why a new tool can't be called so; empty where it can."""
    try:
        check_tool_name(name)
    except GalenError as error:
        return texts.sentence(str(error))
    if any(tool.name == name for tool in page.suite.state.tools or ()):
        return "There is a tool of this name. Choose another one, or calibrate that tool again."
    return ""
