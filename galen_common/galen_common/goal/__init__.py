# SPDX-License-Identifier: Apache-2.0
"""Goals on the arm without ROS: the procedure, arrival and average of a pose."""
