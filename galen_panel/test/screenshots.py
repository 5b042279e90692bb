# SPDX-License-Identifier: Apache-2.0
"""Take the README's pictures of the panel: python galen_panel/test/screenshots.py --output DIR.

The made-up suite of the tests is shown: a calibration that runs, and streams.
"""

import argparse
import tempfile
from pathlib import Path

from browser import Browser
from browser_look import RAW, rows
from panel_processes import PanelWorld

PATIENCE_S = 120.0


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--output", type=Path, required=True, metavar="DIR")
    output = parser.parse_args().output
    output.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder, PanelWorld(folder) as world:
        link = world.start_panel(fake=True)
        for tab in ("operate", "live"):
            browser = Browser(world.folder, 1600, 1250, webgl=True)
            try:
                browser.prefer("light")
                browser.open(link)
                browser.click(f"tab-{tab}")
                if tab == "live":
                    browser.wait(
                        lambda browser=browser: len(rows(browser, RAW, 25.0)) > 450,
                        "a full window",
                        PATIENCE_S,
                    )
                else:
                    browser.find("tool-pointer")
                print(browser.screenshot(output / f"panel_{tab}.png"))
            finally:
                browser.close()


if __name__ == "__main__":
    main()
