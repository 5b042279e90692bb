# SPDX-License-Identifier: Apache-2.0
"""Wrenches and joint states paired by stamp, and their monitoring."""
