# SPDX-License-Identifier: Apache-2.0
"""The executables; each imports its module when it starts."""

from galen_common.executable import Executable

panel = Executable("galen_panel.panel")
