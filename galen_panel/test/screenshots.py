"""Take the README's pictures of the panel: python galen_panel/test/screenshots.py --output DIR.

The suite runs on the simulated arm in a ROS domain of its own: tools' files and a deflection model
of the sample bags, a calibration, pushes by the scripted hand. It takes some three minutes.
"""

import argparse
import shutil
import subprocess
import tempfile
from pathlib import Path

import rclpy
from browser import Browser
from browser_plots import RAW, force_rms, rows
from galen_bringup.processes import executable_path
from panel_processes import PanelWorld
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from std_srvs.srv import Trigger

BAGS = Path(__file__).resolve().parents[2] / "bags"
PATIENCE_S = 120.0
POSES = 9
PUSH_S, PAUSE_S = 2.5, 1.0
PUSHES_N = ((6, 0, 0), (0, 8, 0), (0, 0, -9), (-5, 4, 0), (0, -7, 3), (4, 0, 8))


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--output", type=Path, required=True, metavar="DIR")
    output = parser.parse_args().output
    output.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder, PanelWorld(folder) as world:
        link = start(world)
        # A calibration takes the tool off: last.
        for take_all in (looks, operates):
            for scheme, ending in (("light", ""), ("dark", "_dark")):
                browser = Browser(world.folder, 1600, 1250, webgl=True)
                try:
                    browser.prefer(scheme)
                    browser.open(link)
                    take_all(browser, world, output, ending)
                finally:
                    browser.close()


def looks(browser, world, output, ending):
    live(browser, world, output / f"panel_live{ending}.png")
    recordings(browser, output / f"panel_recordings{ending}.png")


def operates(browser, _world, output, ending):
    operate(browser, output / f"panel_operate{ending}.png")


def start(world):
    """The nodes as `simulation.launch.py` starts them, with the sample bags' tools."""
    for path in (BAGS / "tools").glob("*.json"):
        shutil.copy(path, world.tools_dir)
    model = world.folder / "model.json"
    tool = BAGS / "tools" / "retractor.json"
    subprocess.run(
        [executable_path("galen_deflection", "train"), BAGS / "pushes", "--tool", tool]
        + ["--kind", "joint_hysteresis", "-o", model],
        check=True,
    )
    at_s, pushes = 0.5, []
    for _ in range(6):
        for force in PUSHES_N:
            pushes += [at_s, PUSH_S, *map(float, force), 0.0, 0.0, 0.0]
            at_s += PUSH_S + PAUSE_S
    world.start_driver(
        speed=1.0, initial_tool="retractor", hand_pushes=pushes, hand_frames="[base]"
    )
    tools = {"tools_dir": world.tools_dir}
    world.start_node("galen_gravcomp", "gravcomp_node", tools | {"tool": "retractor"})
    world.start_node("galen_deflection", "deflection_node", {"model_file": model})
    world.start_node("galen_calibration_behavior", "calibration_node", tools)
    return world.start_panel("--bags-dir", BAGS)


def operate(browser, path):
    """In the middle of a calibration."""
    browser.wait(lambda: browser.usable("calibrate"), "the calibration", PATIENCE_S)
    browser.says("active", "retractor", patience_s=PATIENCE_S)
    browser.click("calibrate")
    browser.click("dialog-ok")
    browser.wait(lambda: done(browser) >= POSES, "some poses", PATIENCE_S)
    take(browser, path)
    browser.click("cancel")
    browser.says("outcome", "Canceled", patience_s=PATIENCE_S)
    browser.click("outcome-close")


def live(browser, world, path):
    """While the tool is pushed."""
    browser.says("active", "retractor", patience_s=PATIENCE_S)
    browser.click("tab-live")
    browser.find("plot")
    run_hand(world)
    browser.wait(lambda: len_s(browser) > 25.0, "a window full of pushes", PATIENCE_S)
    browser.wait(lambda: (force_rms(browser, RAW) or 0.0) > 5.0, "a push", PATIENCE_S)
    take(browser, path)


def recordings(browser, path):
    """A report."""
    browser.click("tab-recordings")
    bags = browser.wait(
        lambda: [
            row
            for number in range(8)
            for row in browser.all(f"bag-{number}")
            if "free_motion" in row.text
        ],
        "the recordings",
    )
    bags[0].click()
    browser.says("bag-picked", "free_motion")
    browser.click("evaluate")
    selector = "[data-testid=jobs] [data-testid$=-report]"
    reports = browser.wait(
        lambda: [
            one
            for one in browser.driver.find_elements("css selector", selector)
            if one.is_displayed()
        ],
        "the report",
        PATIENCE_S,
    )
    reports[0].click()
    browser.find("report-verdict")
    browser.wait(
        lambda: browser.script(
            "return [...document.images].every(one => one.complete && one.naturalWidth)"
        ),
        "its picture",
    )
    take(browser, path)
    browser.click("report-close")


def take(browser, path):
    """Once nothing moves, and no notice lies over it."""
    browser.wait(
        lambda: browser.script("return !document.querySelector('.q-notification')"),
        "the notices to go",
        PATIENCE_S,
    )
    browser.screenshot(path)
    print(path)


def done(browser):
    texts = [element.text for element in browser.all("count")]
    return int(texts[0].split()[0]) if texts and texts[0] else -1


def len_s(browser):
    found = rows(browser, RAW, 60.0)
    return -float(found[0, 0]) if len(found) else 0.0


def run_hand(world):
    """Ask the simulated arm's hand to push; it may push already."""
    context = Context()
    rclpy.init(context=context, domain_id=world.domain_id)
    try:
        node = rclpy.create_node("screenshots", context=context)
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(node)
        client = node.create_client(Trigger, "sim_driver/run_hand")
        if not client.wait_for_service(timeout_sec=PATIENCE_S):
            raise SystemExit("the simulated arm is not there")
        future = client.call_async(Trigger.Request())
        executor.spin_until_future_complete(future, timeout_sec=PATIENCE_S)
        node.destroy_node()
    finally:
        rclpy.shutdown(context=context)


if __name__ == "__main__":
    main()
