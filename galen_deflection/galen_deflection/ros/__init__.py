# SPDX-License-Identifier: Apache-2.0
"""What needs ROS: nodes, and commands that talk to them."""
