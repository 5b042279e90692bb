# SPDX-License-Identifier: Apache-2.0
"""Calibration, inertia and cables from recordings."""
