# SPDX-License-Identifier: Apache-2.0
"""The executables; each imports its module when it starts."""

from galen_common.executable import Executable

gravcomp_node = Executable("galen_gravcomp.ros.node")
evaluate = Executable("galen_gravcomp.evaluate.command")
tools = Executable("galen_gravcomp.tools")
