# SPDX-License-Identifier: Apache-2.0
"""The executables; each imports its module when it starts."""

from galen_common.executable import Executable

demo = Executable("galen_bringup.demo")
preflight = Executable("galen_bringup.preflight")
