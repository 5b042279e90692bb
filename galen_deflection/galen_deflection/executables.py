# SPDX-License-Identifier: Apache-2.0
"""The executables; each imports its module when it starts."""

from galen_common.executable import Executable

collect = Executable("galen_deflection.ros.collect")
collection_node = Executable("galen_deflection.ros.collection_node")
deflection_node = Executable("galen_deflection.ros.node")
evaluate = Executable("galen_deflection.evaluate")
train = Executable("galen_deflection.train")
