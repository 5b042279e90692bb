# SPDX-License-Identifier: Apache-2.0
"""A calibration: the procedure, its poses and its estimate."""
