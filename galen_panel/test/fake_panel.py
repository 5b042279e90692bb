"""The panel on a made-up suite: python fake_panel.py --port 8090."""

import sys
import threading
import time

from fake_suite import FakeSuite
from galen_model.errors import GalenError
from galen_panel.options import read_options
from galen_panel.server import serve


def stream(suite):
    at_s = time.time()
    while True:
        if suite.watching:
            suite.stream(at_s, time.time() - at_s, seed=int(at_s * 10))
        at_s = time.time()
        time.sleep(0.1)


if __name__ == "__main__":
    suite = FakeSuite()
    threading.Thread(target=stream, args=(suite,), daemon=True).start()
    options = read_options(sys.argv[1:])
    try:
        serve(suite, options, lambda: None)
    except GalenError as error:
        sys.exit(f"panel: {error}")
