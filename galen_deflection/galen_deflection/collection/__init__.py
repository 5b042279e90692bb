# SPDX-License-Identifier: Apache-2.0
"""Collecting pushes on the arm."""
