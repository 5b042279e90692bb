# SPDX-License-Identifier: Apache-2.0
"""The guide in a real browser, on the simulated arm: from nothing to a compensated wrench."""

import pytest
from panel_processes import PanelWorld

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1200)]

# The suite, its simulation and a Chromium share a machine with other tests.
PATIENCE_S = 200.0


def test_a_first_calibration_by_the_guide_alone(browser, tmp_path):
    with PanelWorld(tmp_path) as world:
        browser.open(world.start_panel())
        browser.says("step-1", "Missing: driver, compensation, calibration", patience_s=PATIENCE_S)
        browser.says("step-1", "ros2 run galen_gravcomp gravcomp_node")
        browser.says("enable", "unknown")
        world.start_driver()
        world.start_gravcomp()
        world.start_calibration()

        browser.says("step-1", "done", patience_s=PATIENCE_S)
        browser.says("step-2", "done", patience_s=PATIENCE_S)
        browser.says("step-3", "No tool is calibrated yet")
        browser.says("enable", "No compensation")
        browser.wait(lambda: browser.usable("step-3-go"), "the button", PATIENCE_S)
        browser.click("step-3-go")
        browser.type("new-tool-name", "pointer")
        browser.says("new-tool-before", "Keep off the arm")
        browser.click("dialog-ok")
        browser.says("step-3", "under way", patience_s=PATIENCE_S)
        browser.says("step-3", "Calibrated: pointer", patience_s=3 * PATIENCE_S)

        browser.wait(lambda: browser.usable("step-4-go"), "the check", PATIENCE_S)
        browser.click("step-4-go")
        browser.click("dialog-ok")
        browser.says("step-4", "was good", patience_s=2 * PATIENCE_S)

        if "5 of 5" not in browser.text("guide"):
            browser.wait(lambda: browser.usable("step-5-go"), "the tool", PATIENCE_S)
            browser.click("step-5-go")
        browser.says("guide", "5 of 5 steps done", patience_s=PATIENCE_S)
        browser.says("enable", "Compensation on", patience_s=PATIENCE_S)
        browser.click("tab-live")
        browser.driver.refresh()
        browser.wait(
            lambda: browser.find("tab-live").get_attribute("aria-selected") == "true",
            "the tab to last over a reload",
            PATIENCE_S,
        )
    browser.forgive("ERR_CONNECTION_REFUSED")
