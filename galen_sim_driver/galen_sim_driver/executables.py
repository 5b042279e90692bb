# SPDX-License-Identifier: Apache-2.0
"""The executables; each imports its module when it starts."""

from galen_common.executable import Executable

sim_driver_node = Executable("galen_sim_driver.ros.node")
