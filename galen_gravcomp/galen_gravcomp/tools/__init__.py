"""Calibration files, looked after from a command and over services."""
