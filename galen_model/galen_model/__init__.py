# SPDX-License-Identifier: Apache-2.0
"""Kinematics, wrench algebra, load model and calibration files of any arm, free of ROS."""
