"""The executables; each imports its module when it starts."""

from galen_common.executable import Executable

calibration_node = Executable("galen_calibration_behavior.node")
calibrate = Executable("galen_calibration_behavior.calibrate")
check = Executable("galen_calibration_behavior.check")
calibrate_from_bag = Executable("galen_calibration_behavior.calibrate_from_bag")
