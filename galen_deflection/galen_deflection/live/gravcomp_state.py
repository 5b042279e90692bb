"""What galen_gravcomp says of itself on /diagnostics, as far as it concerns who uses its wrench."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from galen_model.arrays import Array

_LEVER_FIELDS = 3


class GravcompState(NamedTuple):
    """The active tool, its tip (3,) in ft_sensor, m, when it was calibrated, and the tare.

    `tool` is empty where none is loaded. `tare`: the offset taken off, as text, and whether it
    still comes in.
    """

    tool: str
    tip_m: Array | None
    calibrated_at: str
    tare: str
    ramping: bool

    @classmethod
    def of(cls, values: Mapping[str, str]) -> GravcompState:
        """From a report's values; what lacks is empty."""
        try:
            tip = np.array([float(word) for word in values.get("tip_m", "").split()])
        except ValueError:
            tip = np.zeros(0)
        known = tip.shape == (_LEVER_FIELDS,) and bool(np.isfinite(tip).all())
        return cls(
            tool=values.get("tool", ""),
            tip_m=tip if known else None,
            calibrated_at=values.get("calibrated_at", ""),
            tare=f"{values.get('tare_force_n', '')} {values.get('tare_torque_nm', '')}".strip(),
            ramping=values.get("tare", "") == "ramping",
        )

    def change_since(self, before: GravcompState) -> str:
        """What changed of the wrench's meaning, in words; empty if nothing did."""
        if self.tool != before.tool:
            return f"gravcomp's tool changed from '{before.tool}' to '{self.tool}'"
        if self.calibrated_at != before.calibrated_at:
            return f"gravcomp loaded another calibration of '{self.tool}'"
        if self.tare != before.tare or self.ramping != before.ramping:
            return "gravcomp's tare changed"
        return ""
