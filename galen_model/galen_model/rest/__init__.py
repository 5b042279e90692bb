# SPDX-License-Identifier: Apache-2.0
"""Rest segments: where the arm stands still and the wrench is steady."""
