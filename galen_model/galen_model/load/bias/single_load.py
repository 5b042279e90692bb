"""One load from orientations and times alone, with a bias that may drift meanwhile."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from galen_model.arrays import Array
from galen_model.errors import IdentificationError, NotExcitedError
from galen_model.files.calibration_file import LoadEstimate
from galen_model.load.bias.choice import BiasMode, Choice, choose_by_mode
from galen_model.load.bias.curve import BiasShape
from galen_model.load.bias.drifting import BiasDriftFit, Sweeps, fit_drifting
from galen_model.load.excitation import LOAD_PARAMETERS, check_excitation
from galen_model.load.identification import MIN_POSES, load_estimate
from galen_model.load.model import gravity_regressor

MOST_COM_STD_M = 0.02
"""Standard deviation of a centre beyond which it counts as not told."""


@dataclass(frozen=True)
class DriftingLoad:
    """A load, and the six curves of its sensor's bias.

    choice: of the shapes (None: constant was asked for); found: fit and curves; bias_end (6,): the
    bias at the last reading, N and N.m.
    """

    load: LoadEstimate
    choice: Choice | None
    found: BiasDriftFit

    @property
    def bias_end(self) -> Array:
        """The bias (6,) at the last reading, N and N.m."""
        return self.found.fit.values[4:]

    def predict(self, gravity_sensor: ArrayLike, time_s: Array) -> Array:
        """Reading (n, 6), N and N.m, under gravity (n, 3), m/s^2, at times (n,), s."""
        bias = self.found.bias_at(time_s, np.zeros(len(time_s), dtype=int))
        return gravity_regressor(gravity_sensor) @ self.load.load.moments + bias


def identify_drifting_load(
    gravity_sensor: ArrayLike,
    wrench: ArrayLike,
    time_s: Array,
    groups: np.ndarray | None = None,
    bias: BiasMode = BiasMode.AUTO,
) -> DriftingLoad:
    """Mass, centre and six curves from gravity (n, 3), readings (n, 6) and their times (n,), s.

    groups (n,): blocks that the choice holds out, from 0 on; None: runs of neighbours.
    Raises as `identification.identify_single_load` does.
    """
    gravity, reading = np.asarray(gravity_sensor, dtype=float), np.asarray(wrench, dtype=float)
    if len(gravity) < MIN_POSES:
        raise IdentificationError(f"{len(gravity)} still poses; at least {MIN_POSES} are needed")
    rows = gravity_regressor(gravity)
    offsets = np.broadcast_to(np.eye(6), (len(rows), 6, 6))
    check_excitation(np.concatenate([rows, offsets], axis=2), LOAD_PARAMETERS[:4])
    sweeps = Sweeps(rows, reading, np.asarray(time_s, dtype=float), np.zeros(len(rows), dtype=int))
    choice = choose_by_mode(sweeps, bias, groups)
    shapes = (BiasShape(), BiasShape()) if choice is None else choice.shapes
    found = fit_drifting(sweeps, shapes)
    load = load_estimate(found.fit, slice(0, 4), "the load")
    check_told(load, found, "the load")
    return DriftingLoad(load, choice, found)


def check_told(load: LoadEstimate, found: BiasDriftFit, name: str) -> None:
    """Raise NotExcitedError where drift and load look so alike that the centre is not known."""
    worst = float(load.com_std_m.max())
    if worst > MOST_COM_STD_M:
        raise NotExcitedError(
            f"a drifting bias and {name} look alike in the order in which the poses were visited: "
            f"the standard deviation of its centre would be {worst * 1e3:.0f} mm, and the mass's "
            f"{found.growth[0]:.0f} times that under a constant bias; visit them in another order"
        )
