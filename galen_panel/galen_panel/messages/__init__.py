# SPDX-License-Identifier: Apache-2.0
"""What the panel tells, in words. No ROS, no NiceGUI."""
