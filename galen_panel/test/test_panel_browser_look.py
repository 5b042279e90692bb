"""How the page looks, what the keyboard reaches, and a recording's report; on a made-up suite."""

from pathlib import Path

import pytest
from browser_look import font_sizes_of_plot, texts, too_faint, too_small
from panel_processes import PanelWorld

pytestmark = [pytest.mark.slow, pytest.mark.timeout(400)]

BAGS = Path(__file__).resolve().parents[2] / "bags"
TABS = ("operate", "live", "recordings", "nodes")


@pytest.fixture(scope="module")
def link(tmp_path_factory):
    with PanelWorld(tmp_path_factory.mktemp("world")) as world:
        yield world.start_panel("--bags-dir", BAGS, fake=True)


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_all_can_be_read_at_arms_length(browser, link, scheme):
    browser.prefer(scheme)
    browser.open(link)
    browser.find("tool-pointer")
    assert browser.script("return document.body.classList.contains('body--dark')") == (
        scheme == "dark"
    )
    for tab in TABS:
        open_tab(browser, tab)
        found = texts(browser)
        assert len(found) > 15, f"{tab}: hardly any text is seen"
        assert too_small(found) == [], tab
        assert too_faint(found) == [], f"{tab}, {scheme}"
    for button in ("new-tool", "tool-retractor-remove"):
        open_tab(browser, "operate")
        browser.click(button)
        browser.find("dialog-cancel")
        settled(browser)
        found = texts(browser)
        assert too_small(found) == [] and too_faint(found) == [], button
        browser.click("dialog-cancel")
        browser.wait(lambda: not browser.all("dialog-cancel"), "the dialog to close")


def test_the_plots_write_large_enough(browser, link):
    browser.open(link)
    open_tab(browser, "live")
    sizes = font_sizes_of_plot(browser)
    assert len(sizes) > 10 and [one for one in sizes if one[1] < 18] == []


def test_dark_and_light_are_switched_by_hand(browser, link):
    browser.prefer("light")
    browser.open(link)
    browser.find("tool-pointer")
    before = browser.script("return getComputedStyle(document.body).backgroundColor")
    browser.click("dark")
    browser.wait(
        lambda: browser.script("return getComputedStyle(document.body).backgroundColor") != before,
        "another background",
    )
    settled(browser)
    found = texts(browser)
    assert too_faint(found) == []


@pytest.mark.parametrize("width", [1400, 1024, 600])
def test_nothing_sticks_out_to_the_side(browser, link, width):
    browser.driver.set_window_size(width, 900)
    browser.open(link)
    try:
        for tab in TABS:
            open_tab(browser, tab)
            wide, seen = browser.script(
                "return [document.documentElement.scrollWidth, window.innerWidth]"
            )
            assert wide <= seen + 1, f"{tab} is {wide} px wide in a window of {seen} px"
    finally:
        browser.driver.set_window_size(1400, 1000)


def test_everything_that_acts_has_a_name_and_a_place_in_the_order(browser, link):
    """What a screen reader says of it, and whether Tab leads there."""
    browser.open(link)
    browser.find("tool-pointer")
    for tab in TABS:
        open_tab(browser, tab)
        nameless = browser.script(
            """
            const acts = 'button, a[href], input, select, textarea, [role=button], [role=tab]';
            return [...document.querySelectorAll(acts)].filter(one => one.checkVisibility())
              .filter(one => {
                const label = one.getAttribute('aria-label') || one.getAttribute('title')
                  || one.getAttribute('placeholder') || one.closest('label')?.innerText
                  || [...one.querySelectorAll('*')].length == 0 && one.innerText
                  || [...one.querySelectorAll(':not(.q-icon)')].map(x => x.innerText).join('');
                return !label?.trim();
              }).map(one => one.outerHTML.slice(0, 200));
            """
        )
        assert nameless == [], tab


@pytest.mark.soak
def test_a_recording_is_evaluated_and_its_report_read(browser, second_browser, link):
    browser.open(link)
    open_tab(browser, "recordings")
    rows = browser.wait(
        lambda: [
            element
            for number in range(8)
            for element in browser.all(f"bag-{number}")
            if "free_motion" in element.text
        ],
        "the recordings",
    )
    rows[0].click()
    browser.says("bag-picked", "free_motion")
    browser.choose("bag-tool", "retractor")
    browser.click("evaluate")
    second_browser.open(link)
    open_tab(second_browser, "recordings")
    second_browser.says("jobs", "free_motion", patience_s=120.0)
    reports = browser.wait(
        lambda: [
            button
            for job in browser.all("jobs")
            for button in job.find_elements("css selector", "[data-testid$=-report]")
            if button.is_displayed()
        ],
        "the report",
        180.0,
    )
    reports[0].click()
    verdict = browser.text("report-verdict")
    assert verdict and browser.text("report-sentence")
    settled(browser)
    found = texts(browser)
    assert too_small(found) == [] and too_faint(found) == []
    picture = "return document.querySelector('.panel-picture')?.naturalWidth ?? 0"
    browser.wait(lambda: browser.script(picture) > 300, "the report's picture")


def open_tab(browser, name):
    browser.click(f"tab-{name}")
    browser.wait(lambda: browser.find(f"tab-{name}").get_attribute("aria-selected") == "true", name)
    settled(browser)


def settled(browser):
    """Wait until nothing moves: texts that come and go are half transparent."""
    browser.wait(
        lambda: browser.script(
            "return document.getAnimations()"
            ".every(one => one.playState != 'running' || one.effect.getTiming().iterations > 9)"
        ),
        "the page to rest",
    )
