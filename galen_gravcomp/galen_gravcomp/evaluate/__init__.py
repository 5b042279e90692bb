# SPDX-License-Identifier: Apache-2.0
"""A calibration file against recordings."""
