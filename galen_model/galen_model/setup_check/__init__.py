# SPDX-License-Identifier: Apache-2.0
"""What people get wrong when they set an arm and its sensor up, found from still readings."""
