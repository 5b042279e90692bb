# SPDX-License-Identifier: Apache-2.0
"""What the page shows: the suite's state, the streams' history, the arm's drawing."""
