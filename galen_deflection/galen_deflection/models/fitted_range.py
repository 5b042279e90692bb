"""The loads and arm positions that a model was fitted on; beyond them it extrapolates."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from galen_model.arrays import Array
from galen_model.files.json_fields import FieldError, array, get, items, mapping, numbers

MARGIN = 0.1
"""Share of its span by which a range may be left before that counts: noise, a bit more push."""

SMALLEST_MARGIN = np.array([1.0, 1.0, 1.0, 0.1, 0.1, 0.1])
"""N and N.m: what a resting hand or the sensor's bias drift loads the tip with."""

NEARBY = np.array([0.03, 0.03, 0.03, 0.15, 0.15])
"""m and rad: how far a position may be from one that was fitted on and still count as it.

At the tip, 0.8 m from the roll axis, the nominal compliance changes by some percent over it.
"""


@dataclass(frozen=True)
class FittedRange:
    """Wrenches at the tip in base_link, lowest and highest (6,), N and N.m; joints, m and rad.

    `joints_low`, `joints_high` (5,): between them a model that knows the arm's geometry
    interpolates. `positions` (k, 5) or None: a model that doesn't know it holds near these only.
    """

    wrench_low: Array
    wrench_high: Array
    joints_low: Array
    joints_high: Array
    positions: Array | None = None

    @classmethod
    def of(cls, joints: Array, wrench: Array, only_nearby: bool) -> FittedRange:
        """The range of samples: joints (n, 5), wrenches (n, 6) at the tip in base_link."""
        return cls(
            wrench_low=wrench.min(axis=0),
            wrench_high=wrench.max(axis=0),
            joints_low=joints.min(axis=0),
            joints_high=joints.max(axis=0),
            positions=_distinct(joints) if only_nearby else None,
        )

    def left_by(self, joints: Array, wrench: Array) -> np.ndarray:
        """Which of the samples (n,) lie outside: joints (n, 5), wrenches (n, 6) as for `of`."""
        low, high = self._limits
        both = np.concatenate([wrench, joints], axis=1)
        outside = ((both < low) | (both > high)).any(axis=1)
        if self.positions is not None:
            far = np.abs(joints[:, None] - self.positions) > NEARBY
            return np.asarray(outside | np.all(far.any(axis=2), axis=1))
        return np.asarray(outside)

    @cached_property
    def _limits(self) -> tuple[Array, Array]:
        """Lowest and highest (11,) of wrench and joints; near positions, joints have none here."""
        wrench = np.maximum(MARGIN * (self.wrench_high - self.wrench_low), SMALLEST_MARGIN)
        joints = np.maximum(MARGIN * (self.joints_high - self.joints_low), NEARBY)
        if self.positions is not None:
            joints = np.full_like(joints, np.inf)
        margin = np.concatenate([wrench, joints])
        return (
            np.concatenate([self.wrench_low, self.joints_low]) - margin,
            np.concatenate([self.wrench_high, self.joints_high]) + margin,
        )

    def to_json(self) -> dict[str, Any]:
        """As plain numbers."""
        content: dict[str, Any] = {
            "wrench_at_tip_low": numbers(self.wrench_low),
            "wrench_at_tip_high": numbers(self.wrench_high),
            "joints_low": numbers(self.joints_low),
            "joints_high": numbers(self.joints_high),
        }
        if self.positions is not None:
            content["positions"] = [numbers(row) for row in self.positions]
        return content

    @classmethod
    def from_json(cls, content: Any, name: str) -> FittedRange:
        """Read with checks; raises FieldError."""
        whole = mapping(content, name)
        sides = {
            (what, side): array(get(whole, f"{what}_{side}"), f"{name}.{what}_{side}", (count,))
            for what, count in (("wrench_at_tip", 6), ("joints", 5))
            for side in ("low", "high")
        }
        for what in ("wrench_at_tip", "joints"):
            if np.any(sides[what, "low"] > sides[what, "high"]):
                raise FieldError(f"{name}.{what}_low is above {name}.{what}_high")
        positions = whole.get("positions")
        if positions is not None:
            rows = len(items(positions, f"{name}.positions"))
            positions = array(positions, f"{name}.positions", (rows, 5))
        return cls(
            sides["wrench_at_tip", "low"],
            sides["wrench_at_tip", "high"],
            sides["joints", "low"],
            sides["joints", "high"],
            positions,
        )


def _distinct(joints: Array) -> Array:
    """Positions (k, 5) such that every one of joints (n, 5) is near one of them."""
    found: list[Array] = []
    left = joints
    while len(left):
        found.append(left[0])
        left = left[np.any(np.abs(left - left[0]) > NEARBY, axis=1)]
    return np.array(found)
