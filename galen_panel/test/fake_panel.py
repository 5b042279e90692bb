# SPDX-License-Identifier: Apache-2.0
"""The panel on a made-up suite: [FAKE_PANEL_URDF=FILE] python fake_panel.py --port 8090.

With FAKE_PANEL_TOOL=NAME that tool is active, and is being calibrated.
"""

import os
import sys
import threading
import time
from dataclasses import replace

from fake_suite import ACTIVE, POINTER, FakeSuite
from galen_common.arm import ArmParameters
from galen_model.errors import GalenError
from galen_panel.options import read_options
from galen_panel.server import serve
from galen_panel.state.snapshot import Behaviour, BehaviourKind


def stream(suite):
    at_s = time.time()
    while True:
        if suite.watching:
            suite.stream(at_s, time.time() - at_s, seed=int(at_s * 10))
        at_s = time.time()
        time.sleep(0.1)


if __name__ == "__main__":
    suite = FakeSuite(ArmParameters(urdf_file=os.environ.get("FAKE_PANEL_URDF", "")).arm())
    if name := os.environ.get("FAKE_PANEL_TOOL"):
        kind = BehaviourKind.CALIBRATE
        running = Behaviour(1, kind, name, "sweep with tool", "pose 12 of 56", 12, 112)
        tools = (replace(POINTER, name=name), *suite.state.tools[1:])
        suite.put(tools=tools, active_tool=replace(ACTIVE, tool=name), behaviours={kind: running})
    threading.Thread(target=stream, args=(suite,), daemon=True).start()
    options = read_options(sys.argv[1:])
    try:
        serve(suite, options, lambda: None)
    except GalenError as error:
        sys.exit(f"panel: {error}")
