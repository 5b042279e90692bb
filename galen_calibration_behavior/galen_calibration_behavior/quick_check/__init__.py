# SPDX-License-Identifier: Apache-2.0
"""The calibration check: a few poses, then an answer."""
