# SPDX-License-Identifier: Apache-2.0
"""The executables; each imports its module when it starts."""

from galen_common.executable import Executable

calibration_node = Executable("galen_calibration_behavior.ros.node")
calibrate = Executable("galen_calibration_behavior.ros.calibrate")
check = Executable("galen_calibration_behavior.ros.check")
calibrate_from_bag = Executable("galen_calibration_behavior.calibrate_from_bag")
