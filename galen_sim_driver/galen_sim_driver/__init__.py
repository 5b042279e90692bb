# SPDX-License-Identifier: Apache-2.0
"""Stands in for the Galen's arm, force/torque sensor and optical tracker."""
