# SPDX-License-Identifier: Apache-2.0
"""Subtracts the tool's weight from the wrist sensor's wrench, live and on recordings."""
