"""The panel comes before the nodes, and may be killed while they work: nothing is lost by it."""

from urllib.parse import urlsplit

import pytest
from panel_processes import PanelWorld
from panel_tools import write_perfect_tool

pytestmark = [pytest.mark.soak, pytest.mark.timeout(600)]

PATIENCE_S = 90.0


def test_the_panel_before_the_nodes_and_killed_while_they_work(browser, tmp_path):
    with PanelWorld(tmp_path) as world:
        write_perfect_tool(world.tools_dir, "pointer")
        link = world.start_panel()
        browser.open(link)

        # nothing is there: each part says what to start
        browser.says("active", "gravcomp is not running", patience_s=PATIENCE_S)
        for button in ("enable", "tare", "calibrate", "check", "collect"):
            assert not browser.usable(button), button
        assert "ros2 run galen_calibration_behavior calibration_node" in browser.text(
            "card-calibrate"
        )
        assert "ros2 run galen_gravcomp gravcomp_node" in browser.text("tools-note")
        browser.click("tab-nodes")
        browser.says("node-gravcomp", "ros2 run galen_gravcomp gravcomp_node")

        # they come: the page follows
        world.start_driver(initial_tool="pointer")
        world.start_gravcomp()
        world.start_calibration()
        browser.click("tab-operate")
        browser.find("tool-pointer", PATIENCE_S)
        browser.wait(lambda: browser.usable("calibrate"), "the calibration", PATIENCE_S)
        browser.choose("calibrate-tool", "pointer")
        browser.click("calibrate-options")
        browser.click("calibrate-by-hand")
        browser.click("calibrate")
        browser.click("dialog-ok")
        browser.says("asked", "Take the tool off", patience_s=PATIENCE_S)

        # the panel is killed while the calibration waits for a person, and comes back
        world.kill("panel")
        world.start_panel(port=urlsplit(link).port)
        browser.says("running", "pointer", "started elsewhere", patience_s=PATIENCE_S)
        browser.says("asked", "Take the tool off", patience_s=PATIENCE_S)
        browser.click("confirm")
        browser.wait(lambda: done(browser) >= 2, "poses after that", PATIENCE_S)

        # while it sweeps, too
        world.kill("panel")
        world.start_panel(port=urlsplit(link).port)
        browser.says("running", "pointer", patience_s=PATIENCE_S)
        browser.wait(lambda: done(browser) >= 3, "poses of the goal that is adopted", PATIENCE_S)
        browser.click("cancel")
        browser.says("outcome", "Canceled", patience_s=PATIENCE_S)
        browser.forgive("ERR_CONNECTION_REFUSED")


def done(browser):
    texts = [element.text for element in browser.all("count")]
    return int(texts[0].split()[0]) if texts and texts[0] else -1
