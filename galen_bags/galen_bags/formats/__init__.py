# SPDX-License-Identifier: Apache-2.0
"""Files of bags: MCAP, SQLite3, ROS 1; reading and writing."""
