# SPDX-License-Identifier: Apache-2.0
"""Shared by all deflection models: predictions, settings of a fit, the range of a fit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from galen_model.arm.arm import Arm
from galen_model.arrays import Array
from galen_model.json_fields import (
    FieldError,
    array,
    count,
    get,
    items,
    mapping,
    numbers,
)

from galen_deflection.measurement.samples import DeflectionSamples

MARGIN = 0.1
"""Share of its span by which a range may be left before that counts: noise, a bit more push."""

SMALLEST_MARGIN = np.array([1.0, 1.0, 1.0, 0.1, 0.1, 0.1])
"""N and N.m: what a resting hand or the sensor's bias drift loads the tip with."""

NEARBY_M, NEARBY_RAD = 0.03, 0.15
"""How far a joint may be from one that was fitted on and still count as it.

At the Galen's tip the nominal compliance changes by some percent over it.
"""


def nearby(arm: Arm) -> Array:
    """Return how far a joint may be from one that was fitted on and still count as it.

    Args:
        arm: the arm whose joints are compared.

    Returns:
        (j,), m and rad, by joint.

    """
    return np.array([NEARBY_M if unit == "m" else NEARBY_RAD for unit in arm.units])


class Predicted(NamedTuple):
    """A prediction for one sample.

    mean (6,): translation (m) and rotation vector (rad) of tool_tip in base_link; covariance
    (6, 6) of the true deflection about it; extrapolated: the load or the arm's position lies
    outside of what the model was fitted on. start (6, 6): the part of the covariance that is there
    only because the loads before the stream's start are unknown; None where there is none.
    """

    mean: Array
    covariance: Array
    extrapolated: bool
    start: Array | None = None


class PredictedSamples(NamedTuple):
    """Predictions for samples (n,): mean (n, 6), covariance (n, 6, 6), extrapolated (n,)."""

    mean: Array
    covariance: Array
    extrapolated: np.ndarray

    def rows(self, rows: np.ndarray | slice) -> PredictedSamples:
        """Return some of the samples' predictions.

        Args:
            rows: mask (n,) bool, indices or slice of samples.

        Returns:
            Their predictions, in the order of `rows`.

        """
        return PredictedSamples(*(values[rows] for values in self))


@dataclass(frozen=True)
class FitSettings:
    """What every kind of model takes; a kind that doesn't need one of these ignores it.

    use (n,) bool, or None for all: the samples whose measured deflection a fit may look at. The
    loads of the others still count for what the arm remembers, as they would live. seed,
    iterations (1 or more): of a network's training. on_progress(done, total, what): called now and
    then.
    """

    use: np.ndarray | None = None
    seed: int = 0
    iterations: int = 150
    on_progress: Callable[[int, int, str], None] | None = None

    def used(self, count: int) -> np.ndarray:
        """Return the samples to look at.

        Args:
            count: n, the number of samples to fit to.

        Returns:
            `use` (n,) bool, all true where it is None.

        Raises:
            ValueError: `use` is for another number of samples.

        """
        if self.use is None:
            return np.ones(count, dtype=bool)
        use = np.asarray(self.use, dtype=bool)
        if use.shape != (count,):
            raise ValueError(f"use has the shape {use.shape} for {count} samples")
        return use


@dataclass(frozen=True)
class FittedRange:
    """The loads and positions that a model was fitted on; beyond them it extrapolates.

    Wrenches at the tip in base_link, lowest and highest (6,), N and N.m; joints (j,), m and rad:
    between them a model that knows the arm's geometry interpolates. `positions` (k, j) or None: a
    model without that knowledge holds near these only.
    """

    wrench_low: Array
    wrench_high: Array
    joints_low: Array
    joints_high: Array
    positions: Array | None = None
    arm: Arm = field(kw_only=True)

    @classmethod
    def of(cls, joints: Array, wrench: Array, only_nearby: bool, arm: Arm) -> FittedRange:
        """Make the range of the samples that a model is fitted to.

        Args:
            joints: (n, j), m and rad.
            wrench: (n, 6) at the tip in base_link, N and N.m.
            only_nearby: the model holds near these joints only, and not between them.
            arm: the arm whose joints they are.

        Returns:
            Their range; with `positions` if `only_nearby`.

        """
        return cls(
            wrench_low=wrench.min(axis=0),
            wrench_high=wrench.max(axis=0),
            joints_low=joints.min(axis=0),
            joints_high=joints.max(axis=0),
            positions=_distinct(joints, nearby(arm)) if only_nearby else None,
            arm=arm,
        )

    def left_by(self, joints: Array, wrench: Array) -> np.ndarray:
        """Return which of the samples lie outside of the range.

        Args:
            joints: (n, j), m and rad.
            wrench: (n, 6) at the tip in base_link, N and N.m.

        Returns:
            (n,) bool, true outside.

        """
        low, high = self._limits
        both = np.concatenate([wrench, joints], axis=1)
        outside = ((both < low) | (both > high)).any(axis=1)
        if self.positions is not None:
            far = np.abs(joints[:, None] - self.positions) > nearby(self.arm)
            outside |= np.all(far.any(axis=2), axis=1)
        return np.asarray(outside)

    @cached_property
    def _limits(self) -> tuple[Array, Array]:
        """Lowest and highest (6 + j,) of wrench and joints; only near positions: wrench only."""
        wrench = np.maximum(MARGIN * (self.wrench_high - self.wrench_low), SMALLEST_MARGIN)
        joints = np.maximum(MARGIN * (self.joints_high - self.joints_low), nearby(self.arm))
        if self.positions is not None:
            joints = np.full_like(joints, np.inf)
        margin = np.concatenate([wrench, joints])
        return (
            np.concatenate([self.wrench_low, self.joints_low]) - margin,
            np.concatenate([self.wrench_high, self.joints_high]) + margin,
        )

    def to_json(self) -> dict[str, Any]:
        """Return plain numbers."""
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
    def from_json(cls, content: Any, name: str, arm: Arm) -> FittedRange:
        """Read with checks.

        Args:
            content: the file's field.
            name: the field's name, for messages.
            arm: the arm whose joints they are.

        Returns:
            The range.

        Raises:
            FieldError: a field lacks or is wrong; the message names it.

        """
        whole = mapping(content, name)
        sides: list[Array] = []
        for what, size in (("wrench_at_tip", 6), ("joints", len(arm.joints))):
            low, high = (
                array(get(whole, f"{what}_{side}"), f"{name}.{what}_{side}", (size,))
                for side in ("low", "high")
            )
            if np.any(low > high):
                raise FieldError(f"{name}.{what}_low is above {name}.{what}_high")
            sides += [low, high]
        positions = whole.get("positions")
        if positions is not None:
            rows = len(items(positions, f"{name}.positions"))
            positions = array(positions, f"{name}.positions", (rows, len(arm.joints)))
        wrench_low, wrench_high, joints_low, joints_high = sides
        return cls(wrench_low, wrench_high, joints_low, joints_high, positions, arm=arm)


def _distinct(joints: Array, near: Array) -> Array:
    """Positions (k, j) such that every one of joints (n, j) is near one of them."""
    found: list[Array] = []
    left = joints
    while len(left):
        found.append(left[0])
        left = left[np.any(np.abs(left - left[0]) > near, axis=1)]
    return np.array(found)


def fitted_on(samples: DeflectionSamples) -> dict[str, int]:
    """Count what a model is fitted to, for its file.

    Args:
        samples: those that the fit looked at.

    Returns:
        Numbers of samples, segments, positions and sets (repetitions of a position), by name.

    """
    places = np.stack([samples.position, samples.set_number], axis=1)
    return {
        "samples": len(samples),
        "segments": len(np.unique(samples.segment)),
        "positions": len(np.unique(samples.position)),
        "sets": len(np.unique(places, axis=0)),
    }


def fitted_on_from_json(content: Any) -> dict[str, int]:
    """Read the field fitted_on.

    Args:
        content: the field itself.

    Returns:
        The counts of `fitted_on`.

    Raises:
        FieldError: a count lacks or is none.

    """
    counts = mapping(content, "fitted_on")
    names = ("samples", "segments", "positions", "sets")
    return {name: count(get(counts, name), f"fitted_on.{name}") for name in names}


def tip_from_json(content: Any) -> Array:
    """Read the field tip_m.

    Args:
        content: the whole file's content.

    Returns:
        The tip (3,) in ft_sensor, m.

    Raises:
        FieldError: it lacks or is wrong.

    """
    return array(get(content, "tip_m"), "tip_m", (3,))


def noise_from_json(content: Any) -> Array:
    """Read the field noise.

    Args:
        content: the whole file's content.

    Returns:
        Standard deviation (6,) of one measured deflection in base_link, m and rad.

    Raises:
        FieldError: it lacks, or a value is not positive.

    """
    noise = array(get(content, "noise"), "noise", (6,))
    if np.any(noise <= 0.0):
        raise FieldError("noise holds a value that isn't positive")
    return noise
