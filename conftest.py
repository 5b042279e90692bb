# SPDX-License-Identifier: Apache-2.0
"""Settings of all tests that have to be made before numpy is loaded."""

import os

# A BLAS of several threads in each of several workers, and in every node that a test starts, makes
# them wait for each other: a cable's tests took 26 s in place of 6 s.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
