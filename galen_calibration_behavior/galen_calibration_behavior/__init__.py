# SPDX-License-Identifier: Apache-2.0
"""Sweeps the arm over still poses and writes the tool's calibration file, as a ROS action."""
