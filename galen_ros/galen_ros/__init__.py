# SPDX-License-Identifier: Apache-2.0
"""What the Galen nodes share on the ROS side: nodes, diagnostics, conversions, spinning."""
