# SPDX-License-Identifier: Apache-2.0
"""The page in a small window, with the longest name: nothing overlaps, and there is room for it."""

import pytest
from browser_look import collisions
from panel_processes import PanelWorld
from selenium.webdriver.common.by import By

pytestmark = [pytest.mark.slow, pytest.mark.timeout(400)]

NAME = "a_long_name_" * 5 + "abcd"
# Something of each tab.
CONTENT = {"nodes": "node-gravcomp", "recordings": "bags-filter", "live": "mean-fx"}
MOST_OF_HEIGHT = 0.45
PATIENCE_S = 20.0


def troubles(browser, width, height):
    """What a person would complain of."""
    header = browser.driver.find_element(By.CSS_SELECTOR, ".panel-header").size["height"]
    found = [f"the header is {header} px high"] if header > MOST_OF_HEIGHT * height else []
    wide = browser.script("return document.documentElement.scrollWidth")
    found += [f"it is {wide} px wide"] if wide > width else []
    return found + collisions(browser, ".panel-header *, .live-heading *")


@pytest.mark.parametrize(("width", "height"), [(800, 600), (390, 844)])
def test_a_small_window_has_room_for_the_page_and_for_long_names(browser, tmp_path, width, height):
    with PanelWorld(tmp_path) as world:
        browser.resize(width, height)
        browser.open(world.start_panel(fake=True, FAKE_PANEL_TOOL=NAME))
        browser.says("running", NAME)
        for tab, content in CONTENT.items():
            browser.click(f"tab-{tab}")
            browser.find(content)
            try:
                browser.wait(lambda: not troubles(browser, width, height), tab, PATIENCE_S)
            except AssertionError:
                assert troubles(browser, width, height) == [], tab
        browser.says(content, ".")
        assert troubles(browser, width, height) == []
        browser.driver.get("about:blank")
