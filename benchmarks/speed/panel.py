"""What the operator's panel costs, itself and the loop: closed, or plotting in a browser.

`gravcomp` in turn without a panel, beside one without a page, and beside one whose page "Live" is
open in a headless Chromium, by `benchmarks.speed.nodes`. The browser would run on the operator's
computer; here it takes its part of the same cores. So once it draws, and once it only takes what
the panel sends and answers that it was drawn: the rest is what the panel takes from a robot's
computer when a page on another one plots.
"""

from __future__ import annotations

import argparse
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.error import URLError
from urllib.request import urlopen

from rich.table import Table

from benchmarks.speed.nodes import (
    Measurement,
    Subject,
    compare,
    cpu_s,
    gravcomp_nodes,
    ratios,
    relays,
    spread,
)

TITLE = "gravcomp at 500 Hz beside the panel"
_RATE_HZ = 500.0
_START_TIMEOUT_S = 60.0
_WARM_UP_S = 5.0
_POLL_S = 0.1
_TAKE_ALL_DRAW_NOTHING = """
window.taken = 0;
galenPlots.patch = async () => { window.taken += 1; return true; };
const arm = document.querySelector("[data-testid=arm]");
getElement(arm.id.slice(1)).renderer.render = () => {};
"""
_FLAGS = (
    "--headless=new",
    "--disable-dev-shm-usage",
    "--disable-background-networking",
    "--no-first-run",
    "--window-size=1400,1000",
    # WebGL without a graphics card.
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
)
_PANEL, _BROWSER = "panel", "browser"


def browser_lacks() -> str:
    """Return why no page can be opened here; empty where one can."""
    try:
        import selenium  # noqa: F401
    except ImportError:
        return "selenium is not installed"
    lacking = [name for name in ("chromium", "chromedriver") if shutil.which(name) is None]
    return f"{' and '.join(lacking)} not found: make browser" if lacking else ""


def subjects(folder: Path) -> list[Subject]:
    """Return a bare relay, and gravcomp with more and more beside it; writes into `folder`."""
    node = gravcomp_nodes(folder)[0]

    def beside(what: str, drawn: bool | None) -> Subject:
        return replace(
            node,
            name=f"{node.name}, {what}",
            warm_up_s=_WARM_UP_S,
            beside=lambda environment: _panel(folder, environment, drawn),
        )

    out = [relays()[0], node, beside("panel without a page", None)]
    if not browser_lacks():
        out += [beside("page that plots", True), beside("page that plots, not drawn here", False)]
    return out


def measure(options: argparse.Namespace, progress: Callable[[str], None]) -> list[Measurement]:
    """Measure all subjects in turn; progress(what) is called before each."""
    lacks = browser_lacks()
    if lacks:
        progress(f"no page is opened: {lacks}")
    with tempfile.TemporaryDirectory(prefix="galen_bench_") as directory:
        found = subjects(Path(directory))
        return compare(found, [_RATE_HZ], options.seconds, options.rounds, progress)


def table(found: Sequence[Measurement]) -> Table:
    """Make a row a subject: least/median/largest of the rounds; CPU in % of a core."""
    out = Table(
        "subject", "lost", "CPU %", "x relay", "p50 ms", "p99 ms", "x relay", "panel's CPU %",
        "browser's CPU %", box=None, header_style="bold",
    )  # fmt: skip
    for column in out.columns[1:]:
        column.justify = "right"
    for subject in dict.fromkeys(one.subject for one in found):
        own = [one for one in found if one.subject == subject]
        lost, came = sum(one.lost for one in own), sum(one.received for one in own)
        out.add_row(
            subject, f"{lost} of {lost + came}",
            spread([one.cpu_percent for one in own], 1),
            spread(ratios(found, subject, _RATE_HZ, "cpu_percent"), 2),
            spread([one.latency_p50_ms for one in own], 2),
            spread([one.latency_p99_ms for one in own], 2),
            spread(ratios(found, subject, _RATE_HZ, "latency_p99_ms"), 2),
            *(
                spread([one.beside_percent[name] for one in own if name in one.beside_percent], 1)
                for name in (_PANEL, _BROWSER)
            ),
        )  # fmt: skip
    return out


@contextmanager
def _panel(
    folder: Path, environment: Mapping[str, str], drawn: bool | None
) -> Iterator[Callable[[], dict[str, float]]]:
    """Run a panel, and a browser on its page; gives their CPU time so far, s.

    drawn: whether the browser draws what it is sent; None for no browser.
    """
    with closing(socket.socket()) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    options = ("--port", str(port), "--bags-dir", str(folder), "--output-dir", str(folder))
    panel = subprocess.Popen(
        [sys.executable, "-m", "galen_panel.panel", *options],
        env=dict(environment),
        stdout=subprocess.DEVNULL,
    )
    link = f"http://127.0.0.1:{port}/"
    try:
        _wait(lambda: _answers(panel, link), "the panel's page")
        if drawn is None:
            yield lambda: {_PANEL: cpu_s(panel.pid)}
        else:
            with _page(link, drawn) as browser:
                yield lambda: {
                    _PANEL: cpu_s(panel.pid),
                    _BROWSER: _tree_cpu_s(browser.service.process.pid),
                }
                if not (any(_rows(browser)) if drawn else _taken(browser)):
                    raise RuntimeError("the panel's page plotted nothing")
    finally:
        panel.terminate()
        try:
            panel.wait(timeout=10.0)
        except subprocess.TimeoutExpired:
            panel.kill()
            panel.wait()


@contextmanager
def _page(link: str, drawn: bool) -> Iterator[Any]:
    """A Chromium with the page's plots, which nothing comes for yet."""
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service
    from selenium.webdriver.common.by import By

    options = webdriver.ChromeOptions()
    options.binary_location = shutil.which("chromium") or ""
    for flag in (*_FLAGS, *(["--no-sandbox"] if os.geteuid() == 0 else [])):
        options.add_argument(flag)
    service = Service(shutil.which("chromedriver"))
    browser = webdriver.Chrome(options=options, service=service)
    try:
        browser.get(link)
        tab = '[data-testid="tab-live"]'
        _wait(lambda: bool(browser.find_elements(By.CSS_SELECTOR, tab)), "the page's tabs")
        browser.find_element(By.CSS_SELECTOR, tab).click()
        _wait(lambda: bool(_rows(browser)), "the page's plots")
        if not drawn:
            browser.execute_script(_TAKE_ALL_DRAW_NOTHING)
        yield browser
    finally:
        browser.quit()


def _rows(browser: Any) -> list[int]:
    """Of each plot, how many rows it shows."""
    return list(
        browser.execute_script(
            "return [...document.querySelectorAll('[data-testid=plot]')].map((element) =>"
            " (getElement(element.id.slice(1))?.chart?.getOption()?.dataset ?? [])"
            " .reduce((sum, one) => sum + (one.source?.length ?? 0), 0))"
        )
    )


def _taken(browser: Any) -> int:
    """How many updates of the plots came since none is drawn any more."""
    return int(browser.execute_script("return window.taken"))


def _answers(panel: subprocess.Popen[bytes], link: str) -> bool:
    if panel.poll() is not None:
        raise RuntimeError(f"the panel ended with code {panel.returncode}")
    try:
        with urlopen(link, timeout=5.0):
            return True
    except (URLError, TimeoutError):
        return False


def _wait(there: Callable[[], bool], what: str) -> None:
    deadline_s = time.monotonic() + _START_TIMEOUT_S
    while not there():
        if time.monotonic() > deadline_s:
            raise RuntimeError(f"{what} did not come for {_START_TIMEOUT_S} s")
        time.sleep(_POLL_S)


def _tree_cpu_s(pid: int) -> float:
    """CPU time so far of a process and of all that came of it and hasn't ended, s."""
    total_s, found = 0.0, [pid]
    for one in found:
        with suppress(OSError):  # it ends at this moment
            total_s += cpu_s(one)
            for listed in Path(f"/proc/{one}/task").glob("*/children"):
                found += [int(child) for child in listed.read_text().split()]
    return total_s
