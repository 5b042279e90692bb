# SPDX-License-Identifier: Apache-2.0
"""The executables; each imports its module when it starts."""

from galen_common.executable import Executable

diagnose = Executable("galen_diagnosis.diagnose")
blind_check = Executable("galen_diagnosis.blind_check")
