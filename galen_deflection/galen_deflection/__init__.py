# SPDX-License-Identifier: Apache-2.0
"""Predict how far the arm deflects under load, live and on recordings."""
