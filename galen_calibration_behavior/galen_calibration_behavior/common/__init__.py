# SPDX-License-Identifier: Apache-2.0
"""What the procedures share: commands, parameters, the check's decision."""
