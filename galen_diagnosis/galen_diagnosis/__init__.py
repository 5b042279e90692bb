# SPDX-License-Identifier: Apache-2.0
"""Where arm and model differ, which unmodelled effect causes it, and how far the gap shrinks."""
