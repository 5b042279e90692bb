"""In a real browser: a recording is found, evaluated, its report read; nodes are told in words."""

import json
import shutil
import signal
from pathlib import Path

import pytest
from galen_panel.recordings.report_files import Reports
from panel_processes import PanelWorld
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys

pytestmark = [pytest.mark.slow, pytest.mark.timeout(400)]

BAGS = Path(__file__).resolve().parents[2] / "bags"
PATIENCE_S = 180.0
HOSTILE = """<!doctype html><title>report</title><p id="told">as written</p>
<script>document.getElementById('told').textContent = 'ran';
parent.document.title = 'ran'</script>"""


def make_diagnosis(output):
    """A report whose page was meddled with."""
    reports = Reports(output)
    folder = reports.begin() / "diagnosis"
    folder.mkdir()
    (folder / "report.html").write_text(HOSTILE)
    content = {
        "verdict": "none", "causes": [], "ranking": [{"effect": "none", "probability": 1.0}],
        "gap": {}, "next_experiment": None, "cannot_tell": [], "problems": [],
    }  # fmt: skip
    (folder / "diagnosis.json").write_text(json.dumps(content))
    told = {"kind": "diagnose", "recording": "tuesday", "recording_id": "x", "tool": "pointer",
            "verdict": "none", "sentence": "No gap."}  # fmt: skip
    return reports.finish(folder.parent, told).id


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    with PanelWorld(tmp_path_factory.mktemp("recordings")) as one:
        one.bags_dir = one.folder / "bags"
        for name in ("free_motion", "swings", "tools"):
            shutil.copytree(BAGS / name, one.bags_dir / name)
        (one.bags_dir / "broken").mkdir()
        (one.bags_dir / "broken" / "broken_0.mcap").write_bytes(b"junk")
        one.diagnosis = make_diagnosis(one.folder / "panel")
        one.link = one.start_panel("--bags-dir", one.bags_dir, fake=True)
        yield one


def open_recordings(browser, world):
    browser.open(world.link)
    browser.click("tab-recordings")
    browser.says("bags-status", "3 recordings")


def pick(browser, name):
    browser.type("bags-filter", name)
    browser.says("bags-status", "1 recording")
    browser.says("bag-0", name)
    browser.click("bag-0")
    browser.says("bag-picked", name)


def test_recordings_are_listed_and_a_broken_one_with_its_reason(browser, world):
    open_recordings(browser, world)
    texts = [browser.text(f"bag-{number}") for number in range(3)]
    assert any("broken_0.mcap is no .mcap file" in text for text in texts)
    assert any("free_motion" in text and "32 s" in text for text in texts)
    pick(browser, "broken")
    assert browser.all("evaluate") == []
    browser.type("bags-filter", "nothing like it")
    browser.says("bags-status", "None has")


def test_an_evaluation_is_begun_seen_in_another_browser_and_read(browser, second_browser, world):
    open_recordings(browser, world)
    open_recordings(second_browser, world)
    pick(browser, "free_motion")
    browser.says("bag-picked", "/wrench_raw: 16000 messages")
    browser.click("evaluate")
    second_browser.says("jobs", "Evaluation of free_motion")
    browser.says("jobs", "done", patience_s=PATIENCE_S)
    second_browser.says("jobs", "done")
    second_browser.click("job-1-report")
    # The active tool is the pointer, and the retractor was on the arm.
    second_browser.says("report-verdict", "Another load")
    sentence = second_browser.text("report-sentence")
    assert "+140.0" in sentence
    second_browser.wait(
        lambda: second_browser.script(
            "return document.querySelector('[data-testid=report] img').naturalWidth > 500"
        ),
        "the picture",
    )
    second_browser.press(Keys.ESCAPE)
    second_browser.wait(lambda: not second_browser.all("report"), "the report to close")
    # A browser that comes later finds the report on the list.
    browser.open(world.link)
    browser.click("tab-recordings")
    browser.says("jobs", "done")


def test_a_job_is_cancelled_from_another_browser_by_the_keyboard(browser, second_browser, world):
    open_recordings(browser, world)
    open_recordings(second_browser, world)
    pick(browser, "swings")
    browser.click("evaluate")
    focus = """const seen = [...document.querySelectorAll('[data-testid$=-cancel]')]
      .filter(element => element.offsetParent !== null);
      seen[0]?.focus(); return seen.length === 1;"""
    second_browser.wait(lambda: second_browser.script(focus), "the job in the other browser")
    assert second_browser.focus().endswith("-cancel")
    second_browser.press(Keys.ENTER)
    browser.says("jobs", "Evaluation of swings canceled")


def test_a_diagnosis_page_can_run_no_script(browser, world):
    open_recordings(browser, world)
    browser.click(f"report-{world.diagnosis}")
    browser.says("report-verdict", "No gap")
    browser.says("report", "What to do next", "Nothing has to be done.")
    frame = browser.find("report").find_element(By.TAG_NAME, "iframe")
    assert frame.get_attribute("sandbox") == ""
    browser.driver.switch_to.frame(frame)
    try:
        told = browser.wait(
            lambda: browser.driver.find_elements(By.ID, "told"), "the page in the frame"
        )
        assert told[0].text == "as written"
    finally:
        browser.driver.switch_to.default_content()
    assert browser.driver.title == "Galen"


def test_nodes_are_told_in_words_and_how_to_start_them(browser, world):
    browser.open(world.link)
    browser.click("tab-nodes")
    text = browser.says("node-deflection", "Not running.")
    assert "ros2 run galen_deflection deflection_node" in text
    browser.says("node-gravcomp", "Compensates 'pointer'")
    browser.says("node-sim_driver", "told nothing of itself yet")


def workers_of(pid):
    """Numbers of the workers that a panel has now."""
    found = []
    for path in Path("/proc").glob("[0-9]*"):
        try:
            parent = int((path / "stat").read_text().rpartition(")")[2].split()[1])
            command = (path / "cmdline").read_bytes()
        except OSError:  # it has ended meanwhile
            continue
        if parent == pid and b"bag_worker" in command:
            found.append(int(path.name))
    return found


def test_a_panel_that_is_ended_takes_its_worker_along(browser, world):
    open_recordings(browser, world)
    pick(browser, "swings")
    browser.click("evaluate")
    panel = world.processes["panel"].pid
    (worker,) = world.wait_for(lambda: workers_of(panel), "the worker")
    # A page that is still open would complain.
    browser.driver.get("about:blank")
    assert world.end("panel", signal.SIGTERM) == 0
    world.wait_for(lambda: not Path(f"/proc/{worker}").exists(), "the worker's end")
    assert list((world.folder / "panel").glob(".unfinished_*")) == []
