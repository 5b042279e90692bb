"""In a real browser: the plots hold what was streamed, the arm is drawn, files arrive."""

import pytest
from panel_processes import PanelWorld

WEBGL = True
pytestmark = [pytest.mark.slow, pytest.mark.timeout(300)]

# Software draws WebGL and the plots here, beside whatever else the machine does.
PATIENCE_S = 90.0
OPTION = """
const element = document.querySelector('[data-testid=plot]');
const option = getElement(Number(element?.id.slice(1) ?? -1))?.chart?.getOption();
return option?.dataset.map(({source}) => source) ?? [];
"""
ZOOM = """
const element = document.querySelector('[data-testid=plot]');
const [zoom] = getElement(Number(element.id.slice(1))).chart.getOption().dataZoom;
return [zoom.startValue, zoom.endValue];
"""
ARM = """
const element = document.querySelector('[data-testid=arm]');
const scene = window['scene_' + element?.id];
const object = scene?.children.find(child => child.userData.placed);
return object ? [object.userData.placed, object.children.length,
  object.children.filter(child => child.visible).length] : [0, 0, 0];
"""


@pytest.fixture(scope="module")
def link(tmp_path_factory):
    with PanelWorld(tmp_path_factory.mktemp("live")) as world:
        yield world.start_panel(fake=True)


@pytest.fixture
def live(browser, link):
    browser.open(link)
    browser.click("tab-live")
    browser.wait(lambda: rows(browser)[0] > 100, "plots with rows", PATIENCE_S)
    return browser


def rows(browser):
    return [len(source) for source in browser.script(OPTION)] or [0, 0, 0]


def test_the_compensated_wrench_is_near_zero_and_the_raw_one_is_not(live):
    raw, compensated, deflection = live.script(OPTION)
    assert [len(source[0]) for source in (raw, compensated, deflection)] == [7, 7, 5]

    def largest(source, column):
        return max(abs(row[column]) for row in source if isinstance(row[column], int | float))

    assert largest(compensated, 1) < 0.2
    assert largest(raw, 2) > 0.5
    assert all(-30.5 < row[0] <= 0.0 for row in raw)
    live.says("mean-fx", "0.0", patience_s=PATIENCE_S)


def test_pause_holds_the_picture_and_the_keyboard_zooms_it(live):
    live.click("pause")
    live.says("pause", "Resume", patience_s=PATIENCE_S)
    live.wait(lambda: -31.0 < live.script(ZOOM)[0] < -29.0, "the window's zoom", PATIENCE_S)
    live.click("zoom-in")
    live.wait(lambda: live.script(ZOOM)[0] > -25.0, "a nearer view", PATIENCE_S)
    assert live.focus() == "zoom-in"
    before = live.script(ZOOM)
    live.press("\ue007")  # Enter
    live.wait(lambda: live.script(ZOOM)[0] > before[0], "a still nearer one", PATIENCE_S)
    held = live.script(OPTION)[0][-1]
    live.says("arm-roll", "°", patience_s=PATIENCE_S)
    assert live.script(OPTION)[0][-1] == held
    live.click("pause")
    live.says("pause", "Pause", patience_s=PATIENCE_S)


def test_the_arm_is_drawn_and_moves(live):
    live.wait(lambda: live.script(ARM)[0] > 0, "a placed arm", PATIENCE_S)
    placed, parts, seen = live.script(ARM)
    assert seen >= parts - 1, "all but the arrow, for there is no force"
    live.wait(lambda: live.script(ARM)[0] > placed, "another pose", PATIENCE_S)
    assert "100" in live.text("factor")
    live.click("view-top")
    assert live.text("arm-deflection-size").endswith("mm")


def test_csv_and_png_are_saved(live):
    live.click("csv")
    live.wait(lambda: list(live.folder.glob("galen_wrench_*.csv")), "a CSV file", PATIENCE_S)
    (path,) = live.folder.glob("galen_wrench_*.csv")
    live.wait(lambda: len(path.read_text().splitlines()) > 100, "its rows", PATIENCE_S)
    assert path.read_text().startswith("stamp_s,raw_fx_n,")
    live.click("png")
    live.wait(lambda: list(live.folder.glob("galen_plots_*.png")), "a PNG file", PATIENCE_S)
    (picture,) = live.folder.glob("galen_plots_*.png")
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert picture.stat().st_size > 10_000


def test_dark_and_light_are_followed(live):
    colour = """
    const element = document.querySelector('[data-testid=plot]');
    return getElement(Number(element.id.slice(1))).chart.getOption().textStyle.color;
    """
    before = live.script(colour)
    live.click("dark")
    live.wait(lambda: live.script(colour) != before, "the other colours", PATIENCE_S)
    live.click("dark")
    live.wait(lambda: live.script(colour) == before, "the first colours", PATIENCE_S)
