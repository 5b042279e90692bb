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


def test_a_small_window_has_room_for_the_page_and_for_long_names(browser, tmp_path):
    with PanelWorld(tmp_path) as world:
        link = world.start_panel(fake=True, FAKE_PANEL_TOOL=NAME)
        for width, height in ((800, 600), (390, 844)):
            browser.resize(width, height)
            browser.open(link)
            browser.says("running", NAME)
            header = browser.driver.find_element(By.CSS_SELECTOR, ".panel-header")
            assert header.size["height"] < MOST_OF_HEIGHT * height
            for tab, content in CONTENT.items():
                place = browser.find(f"tab-{tab}").rect
                assert place["x"] + place["width"] <= width, tab
                browser.click(f"tab-{tab}")
                browser.find(content)
                wide = browser.script("return document.documentElement.scrollWidth")
                assert wide <= width, f"{tab} is {wide} px wide in a window of {width} px"
                assert collisions(browser, ".panel-header *") == [], tab
            browser.says("mean-fx", ".")
            assert collisions(browser, ".live-heading *") == []
        browser.driver.get("about:blank")
