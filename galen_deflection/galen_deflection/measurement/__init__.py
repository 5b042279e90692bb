# SPDX-License-Identifier: Apache-2.0
"""Measured deflections from recordings of pushes."""
