# SPDX-License-Identifier: Apache-2.0
"""Recordings at hand, jobs on them, and their reports."""
