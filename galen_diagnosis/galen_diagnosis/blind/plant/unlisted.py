"""Causes that aren't on the contract's list."""

from __future__ import annotations

from galen_diagnosis.blind.plant.cause import Cause

UNLISTED: dict[str, type[Cause]] = {}
CALIBRATION_UNKNOWN: tuple[str, ...] = ()
TEST_UNKNOWN: tuple[str, ...] = ()
