# SPDX-License-Identifier: Apache-2.0
"""What records need of a joint with encoders at both ends, and how they show in its lag."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from galen_model.arrays import Array
from galen_model.transmission import Scales

DELAY_S = 0.005
"""Usual delay of a stamp."""


@dataclass(frozen=True)
class Columns:
    """One way in which an effect shows: k columns and what their weights mean.

    values (n, k), rad: what the lag gains by a weight of one; weights are about one. parameters: by
    the contract's name, from weights (k,) to the number. allowed: whether weights are this effect.
    """

    values: Array
    parameters: Mapping[str, Callable[[Array], Array]] = field(default_factory=dict)
    allowed: Callable[[Array], bool] = lambda weights: True

    @property
    def size(self) -> int:
        """How many columns."""
        return int(self.values.shape[1])


@dataclass(frozen=True)
class JointTerms:
    """Means over n short windows of a joint's runs.

    lag (n,), rad; column (n,): each of `galen_model.transmission.TERMS`; torque_rate (n,), N.m/s;
    lost (n, p), rad: what plays of the motion of thresholds gaps (p,), rad, leave behind.
    """

    lag: Array
    column: Mapping[str, Array]
    torque_rate: Array
    lost: Array
    gaps: Array
    scales: Scales

    @property
    def usual_softness(self) -> float:
        """Half the lag's range over half the torque's, rad/(N.m)."""
        return self.scales.lag_half_range / self.scales.torque_half_range


def in_lag(
    values: Array, name: str, size: Callable[[Array], Array], *, positive: bool = False
) -> Columns:
    """Return the way of columns of a joint's lag.

    Args:
        values: Columns, (n,) or (n, k), rad.
        name: Name of the parameter.
        size: The parameter as a function of the weights.
        positive: Whether only weights with a parameter above 0 are allowed.

    Returns:
        The columns.

    """
    allowed = (lambda w: bool(size(w) > 0.0)) if positive else (lambda w: True)
    return Columns(np.reshape(values, (len(values), -1)), {name: size}, allowed)
