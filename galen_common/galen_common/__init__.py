# SPDX-License-Identifier: Apache-2.0
"""What nodes and commands share without ROS: parameters, command layer, streams, procedures."""
