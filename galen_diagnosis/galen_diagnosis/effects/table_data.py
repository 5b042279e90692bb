# SPDX-License-Identifier: Apache-2.0
"""What records need of a table: of orientations, or of a joint with encoders at both ends.

A table of orientations holds gravity in the sensor and, perhaps, the sensor's rotation in its base;
no joints. Effects of geometry, load and sensor are the simulator's own: those hooks that need no
joints are called as the replay calls them (`galen_sim_driver.replay`), and differences give the
columns,

    reading = read(W(tool_load(load); R^T gravity(g))).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from galen_model.arrays import Array
from galen_model.evidence.held_out import Columns
from galen_model.transmission import Scales

DELAY_S = 0.005
"""Usual delay of a stamp."""


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
        Columns of one channel.

    """
    allowed = (lambda w: bool(size(w) > 0.0)) if positive else (lambda w: True)
    return Columns(values.reshape(len(values), 1, -1), {name: size}, allowed=allowed)
