# SPDX-License-Identifier: Apache-2.0
"""The executables; each imports its module when it starts."""

from galen_common.executable import Executable

convert = Executable("galen_bags.convert")
record = Executable("galen_bags.ros.record")
play = Executable("galen_bags.ros.play")
