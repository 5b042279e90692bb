# SPDX-License-Identifier: Apache-2.0
"""Waiting for other processes and threads."""

import time


def wait_for(there, what="it", wait_s=60.0):
    """Look until it is there."""
    deadline = time.monotonic() + wait_s
    while not there():
        assert time.monotonic() < deadline, f"{what} did not come"
        time.sleep(0.005)
