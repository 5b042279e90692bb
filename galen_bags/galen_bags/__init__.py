# SPDX-License-Identifier: Apache-2.0
"""Bags in and out: read into arrays, record, play, work through many."""
