# SPDX-License-Identifier: Apache-2.0
"""In a real browser, on a made-up suite: what a unit test can't hold."""

import json
import shutil
import signal
import threading
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from browser_look import (
    COMPENSATED,
    RAW,
    font_sizes_of_plot,
    force_rms,
    rows,
    texts,
    too_faint,
    too_small,
)
from galen_panel.options import new_token
from galen_panel.recordings.reports import Reports
from panel_processes import PanelWorld
from selenium.webdriver.common.by import By

WEBGL = True
pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]

BAGS = Path(__file__).resolve().parents[2] / "bags"
TABS = ("operate", "live", "recordings", "nodes")
TOKEN = new_token()
# Software draws WebGL and the plots here, beside whatever else the machine does.
PATIENCE_S = 90.0


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    with PanelWorld(tmp_path_factory.mktemp("world")) as one:
        bags = one.folder / "bags"
        for name in ("free_motion", "tools"):
            shutil.copytree(BAGS / name, bags / name)
        for name in ("monday", "tuesday"):
            shutil.copytree(BAGS / "free_motion", bags / name / "sweep")
            (bags / name / "sweep" / "free_motion.mcap").write_bytes(b"cut")
            shutil.copy(BAGS / "tools" / "pointer.json", bags / name / "tool.json")
        one.diagnosis = hostile_report(one.folder / "panel")
        one.link = one.start_panel("--bags-dir", bags, "--specification", "ur5e", fake=True)
        yield one


@pytest.fixture
def page(browser, world):
    browser.open(world.link)
    connected(browser)
    return browser


def connected(browser):
    """Wait until the page shows its tabs and has its socket."""
    browser.find("tab-operate")
    browser.wait(lambda: browser.script("return window.socket?.connected"), "the page's socket")


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


# How it looks


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_all_can_be_read_at_arms_length(browser, world, scheme):
    browser.prefer(scheme)
    browser.open(world.link)
    browser.find("tool-pointer")
    assert browser.script("return document.body.classList.contains('body--dark')") == (
        scheme == "dark"
    )
    for tab in TABS:
        open_tab(browser, tab)
        found = texts(browser)
        assert len(found) > 12, f"{tab}: hardly any text is seen"
        assert too_small(found) == [], tab
        assert too_faint(found) == [], f"{tab}, {scheme}"
    open_tab(browser, "operate")
    browser.click("new-tool")
    browser.find("dialog-cancel")
    settled(browser)
    found = texts(browser)
    assert too_small(found) == [] and too_faint(found) == []


def test_nothing_sticks_out_and_everything_that_acts_has_a_name(page):
    """What a screen reader says of it, and whether Tab leads there."""
    for width in (1400, 600):
        page.driver.set_window_size(width, 900)
        for tab in TABS:
            open_tab(page, tab)
            wide, seen = page.script(
                "return [document.documentElement.scrollWidth, window.innerWidth]"
            )
            assert wide <= seen + 1, f"{tab} is {wide} px wide in a window of {seen} px"
    page.driver.set_window_size(1400, 1000)
    for tab in TABS:
        open_tab(page, tab)
        nameless = page.script(
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


# Live

ARM = """
const element = document.querySelector('[data-testid=arm]');
const scene = window['scene_' + element?.id];
const object = scene?.children.find(child => child.userData.placed);
const seen = object?.children.filter(child => child.visible).length;
return object ? [object.userData.placed, seen] : [0, 0];
"""


def test_plots_hold_what_was_streamed_and_the_arm_moves(page):
    open_tab(page, "live")
    page.wait(lambda: len(rows(page, RAW)) > 10, "plots with rows", PATIENCE_S)
    assert force_rms(page, COMPENSATED) < 0.2 and force_rms(page, RAW) > 0.5
    sizes = font_sizes_of_plot(page)
    assert len(sizes) > 10 and [one for one in sizes if one[1] < 18] == []
    page.wait(lambda: page.script(ARM)[0] > 0, "a placed arm", PATIENCE_S)
    placed, seen = page.script(ARM)
    assert seen > 10
    page.wait(lambda: page.script(ARM)[0] > placed, "another pose", PATIENCE_S)
    page.click("pause")
    page.says("pause", "Resume", patience_s=PATIENCE_S)
    page.says("arm-roll", "°", patience_s=PATIENCE_S)
    page.click("csv")
    page.wait(lambda: list(page.folder.glob("galen_wrench_*.csv")), "a CSV file", PATIENCE_S)


TRIANGLES = """
const scene = window['scene_' + document.querySelector('[data-testid=arm]')?.id];
const object = scene?.children.find(child => child.userData.loaded);
const drawn = [];
object?.traverse(one => one.geometry && one.visible && drawn.push(one));
return drawn.filter(one => one.geometry.attributes.position?.count === 12).length;
"""


def test_a_described_arm_is_drawn_with_its_meshes(browser, tmp_path):
    mesh = tmp_path / "forearm.obj"
    mesh.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n")
    urdf = (BAGS.parent / "galen_bringup/urdf/six_axis.urdf").read_text()
    forearm = '<cylinder radius="0.042" length="0.392"/>'
    assert forearm in urdf
    described = tmp_path / "arm.urdf"
    described.write_text(urdf.replace(forearm, f'<mesh filename="file://{mesh}" scale="1 1 .1"/>'))
    with PanelWorld(tmp_path) as world:
        browser.open(world.start_panel(fake=True, FAKE_PANEL_URDF=str(described)))
        connected(browser)
        open_tab(browser, "live")
        browser.wait(lambda: browser.script(TRIANGLES) == 2, "the mesh, and its ghost", PATIENCE_S)
        browser.says("arm-wrist_3", "°", patience_s=PATIENCE_S)
        assert too_small(texts(browser)) == [] and too_faint(texts(browser)) == []
        browser.driver.get("about:blank")


# Recordings


def hostile_report(output):
    """A report whose page was meddled with."""
    reports = Reports(output)
    folder = reports.begin() / "diagnosis"
    folder.mkdir()
    (folder / "report.html").write_text(
        "<!doctype html><title>report</title><p id='told'>as written</p>"
        "<script>document.getElementById('told').textContent = 'ran';"
        "parent.document.title = 'ran'</script>"
    )
    told = {"kind": "diagnose", "recording": "tuesday", "recording_id": "x", "tool": "pointer",
            "verdict": "none", "sentence": "No gap."}  # fmt: skip
    return reports.finish(folder.parent, told).id


def test_a_diagnosis_page_can_run_no_script(page, world):
    open_tab(page, "recordings")
    page.click(f"report-{world.diagnosis}")
    page.says("report-verdict", "No gap")
    frame = page.find("report").find_element(By.TAG_NAME, "iframe")
    assert frame.get_attribute("sandbox") == ""
    page.driver.switch_to.frame(frame)
    try:
        told = page.wait(lambda: page.driver.find_elements(By.ID, "told"), "the page in the frame")
        assert told[0].text == "as written"
    finally:
        page.driver.switch_to.default_content()
    assert page.driver.title == "Galen"


def test_jobs_are_begun_seen_in_another_browser_and_read(page, second_browser, world):
    open_tab(page, "recordings")
    page.type("bags-filter", "free")
    page.says("bags-status", "1 recording")
    page.click("bag-0")
    page.says("bag-picked", "free_motion", "32 s")
    assert not page.all("bag-specification") and not page.all("bag-reference")
    page.click("bag-start")
    second_browser.open(world.link)
    open_tab(second_browser, "recordings")
    second_browser.says("jobs", "done", patience_s=2 * PATIENCE_S)
    second_browser.click("job-1-report")
    # The active tool is the pointer, and the retractor was on the arm.
    second_browser.says("report-verdict", "The load is another one than calibrated")
    assert "+140.0" in second_browser.text("report-sentence")
    picture = "return document.querySelector('[data-testid=report] img').naturalWidth > 500"
    second_browser.wait(lambda: second_browser.script(picture), "the picture")

    page.type("bags-filter", "tuesday diagnosis")
    page.says("bag-0", "tuesday")
    page.click("bag-0")
    page.says("bag-specification", "ur5e")
    page.choose_several("bag-specification", "ati_axia80", "bota_sensone")
    page.says("bag-specification", "ur5e", "ati_axia80", "bota_sensone")
    page.choose_several("bag-reference", "monday")
    page.hover("bag-reference")
    tooltip = "return document.querySelector('.q-tooltip')?.innerText ?? ''"
    page.wait(lambda: "same arm and tool" in page.script(tooltip), "the tooltip")
    settled(page)
    assert too_small(texts(page)) == [] and too_faint(texts(page)) == []
    page.click("bag-start")
    page.says("jobs", "Diagnosis of tuesday, compared with monday, failed. It failed: ", "sweep")


# The connection


def test_a_page_is_grey_while_its_panel_hangs_and_when_it_is_gone(browser, tmp_path):
    with PanelWorld(tmp_path) as world:
        link = world.start_panel(fake=True)
        browser.open(link)
        connected(browser)
        world.processes["panel"].send_signal(signal.SIGSTOP)
        try:
            browser.find("lost")
        finally:
            world.processes["panel"].send_signal(signal.SIGCONT)
        browser.wait(lambda: not browser.all("lost") and browser.all("tab-operate"), "the page")
        world.kill("panel")
        browser.says("lost", "connection to the panel is lost", "Nothing shown here is current")
        # No key reaches the page behind, nor closes what hides it.
        for key in ("\ue004", "\ue00c", "\ue00c", "\ue007"):  # Tab, Escape twice, Enter
            browser.press(key)
        browser.find("lost")
        assert browser.focus() in ("", "lost")
        world.start_panel(fake=True, port=urlsplit(link).port)
        browser.wait(lambda: not browser.all("lost") and browser.all("tab-operate"), "the page")
        browser.forgive("")


# Who is let in

# Tries all a page may try, and tells what got through.
ATTACK = """
<!doctype html><title>evil</title><a id="link" href="PANEL">look here</a><div id="told"></div>
<script>
const tried = {};
const load = (name, element, attribute, address) => new Promise(resolve => {
  element[attribute] = address;
  element.onload = () => { tried[name] = 'loaded'; resolve(); };
  element.onerror = () => { tried[name] = 'rejected'; resolve(); };
  document.body.append(element);
});
const get = (name, options) => fetch('PANEL', options)
  .then(answer => { tried[name] = answer.type == 'opaque' ? 'opaque' : answer.status; })
  .catch(() => { tried[name] = 'rejected'; });
const socket = new Promise(resolve => {
  const one = new WebSocket('PANEL'.replace('http', 'ws').replace(/\\/[^/]*$/, '')
    + '/_nicegui_ws/socket.io/?EIO=4&transport=websocket');
  one.onopen = () => { tried.socket = 'open'; resolve(); };
  one.onerror = () => { tried.socket = 'rejected'; resolve(); };
});
const framed = new Promise(resolve => {
  const frame = document.createElement('iframe');
  frame.src = 'PANEL';
  frame.onload = resolve;
  document.body.append(frame);
});
Promise.all([
  load('image', document.createElement('img'), 'src', 'PANEL'.replace(/[?].*/, '') + 'favicon.ico'),
  load('script', document.createElement('script'), 'src', 'PANEL'),
  get('read', {}), get('blind', {mode: 'no-cors', credentials: 'include'}),
  get('post', {method: 'POST', mode: 'no-cors', credentials: 'include', body: 'x'}),
  socket, framed,
]).then(() => { document.getElementById('told').textContent = JSON.stringify(tried); });
</script>
"""


@contextmanager
def page_of_another_origin(text):
    """Serve one page; yields its port."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self):
            self.send_response(200 if self.path == "/" else 404)
            self.send_header("Content-Type", "text/html")
            self.end_headers()
            self.wfile.write(text.encode() if self.path == "/" else b"")

        def log_message(self, *_):
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield server.server_address[1]
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


def test_the_link_opens_the_page_and_nothing_of_another_origin_does(chromium, tmp_path):
    """Of another site by `localhost`, of the same with another port by the number."""
    with PanelWorld(tmp_path) as world:
        link = world.start_panel(fake=True, GALEN_PANEL_TOKEN=TOKEN)
        plain = link.split("?")[0]
        chromium.forget()
        chromium.open(plain)
        assert "needs its token" in chromium.driver.find_element(By.TAG_NAME, "body").text
        with page_of_another_origin(f'<a id="link" href="{link}">the panel</a>') as port:
            chromium.open(f"http://localhost:{port}/")
            chromium.driver.find_element(By.ID, "link").click()
            connected(chromium)
        assert TOKEN not in chromium.driver.current_url
        assert chromium.script("return document.cookie") == ""
        cookies = chromium.driver.get_cookies()
        assert [(c["value"], c["httpOnly"], c["sameSite"]) for c in cookies] == [
            (TOKEN, True, "Lax")
        ]
        # The cookie is in the browser now.
        for name in ("localhost", "127.0.0.1"):
            with page_of_another_origin(ATTACK.replace("PANEL", plain)) as port:
                chromium.open(f"http://{name}:{port}/")
                told = chromium.wait(
                    lambda: chromium.driver.find_element(By.ID, "told").text, "the attack"
                )
                tried = json.loads(told)
                assert len(tried) == 6 and set(tried.values()) == {"rejected"}, tried
                chromium.driver.switch_to.frame(0)
                assert "nicegui" not in chromium.driver.page_source.lower()
                chromium.driver.switch_to.default_content()
