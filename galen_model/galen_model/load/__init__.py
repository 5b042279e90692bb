# SPDX-License-Identifier: Apache-2.0
"""What a load reads at the wrist, and its identification."""
