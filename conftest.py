# SPDX-License-Identifier: Apache-2.0
"""Settings of all tests that have to be made before numpy is loaded."""

import gc
import os

import pytest

# A BLAS of several threads in each of several workers, and in every node that a test starts, makes
# them wait for each other: a cable's tests took 26 s in place of 6 s.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# What is imported and collected stays: garbage collection needn't look at it again and again. The
# page's tests collect twice each, at half a second a time.
gc.disable()


def pytest_collection_finish(session: pytest.Session) -> None:
    """Begin to collect garbage, of what the tests themselves make."""
    gc.freeze()
    gc.enable()
