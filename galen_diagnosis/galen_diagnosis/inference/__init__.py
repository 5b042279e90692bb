# SPDX-License-Identifier: Apache-2.0
"""Which effects explain the rows, and how probable each is."""
