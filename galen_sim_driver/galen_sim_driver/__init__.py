"""Stands in for the Galen's arm, force/torque sensor and optical tracker."""
