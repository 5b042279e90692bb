# SPDX-License-Identifier: Apache-2.0
"""Files: calibration files, JSON with checks, writing whole or not at all."""
