"""The panel on a made-up suite: [FAKE_PANEL_URDF=FILE] python fake_panel.py --port 8090."""

import os
import sys
import threading
import time

from fake_suite import FakeSuite
from galen_model.errors import GalenError
from galen_panel.options import read_options
from galen_panel.server import serve
from galen_ros.arm import ArmParameters


def stream(suite):
    at_s = time.time()
    while True:
        if suite.watching:
            suite.stream(at_s, time.time() - at_s, seed=int(at_s * 10))
        at_s = time.time()
        time.sleep(0.1)


if __name__ == "__main__":
    suite = FakeSuite(ArmParameters(urdf_file=os.environ.get("FAKE_PANEL_URDF", "")).arm())
    threading.Thread(target=stream, args=(suite,), daemon=True).start()
    options = read_options(sys.argv[1:])
    try:
        serve(suite, options, lambda: None)
    except GalenError as error:
        sys.exit(f"panel: {error}")
