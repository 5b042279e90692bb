# SPDX-License-Identifier: Apache-2.0
"""Bags and tables as arrays."""
