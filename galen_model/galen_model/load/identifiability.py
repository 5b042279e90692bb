# SPDX-License-Identifier: Apache-2.0
"""Do the poses identify what is asked? Gates before, and again after, a fit.

**Loads** (`check_excitation`). With noise of one unit on every channel, A the stacked design and
N = A^T A its information, the parameters asked for have the covariance C, the leading block of
N^-1, the offsets being fitted too. It is compared with what as many poses would give whose gravity
directions were spread evenly over the sphere and whose offsets were known: var(m) = 1 / (n g^2),
var(h) = 3 / (2 n g^2). The square root of an eigenvalue of the ratio is the inflation of the
standard deviation along its eigenvector; where it is infinite or very large, that combination is
not identifiable.

**Mounting** (`check_identifiable`). With rows whitened by the noise, N the columns of loads and
offsets (and what is known of the loads beforehand as further rows), S_i the column of a parameter
and P the projection on columns:

    t_i = |(1 - P_N) S_i|                    the part of it that the loads can't take
    r_i = |(1 - P_{N, S_others}) S_i|        the part that nothing else can; its std is 1 / r_i

Parameter i isn't identifiable if t_i vanishes beside |(1 - P_offsets) S_i|, if r_i does beside t_i,
or if 1 / r_i is beyond `MAX_STD`. Its twin is the load's part, or the parameter, without which it
would be. Cf. the confusability D_ij = |(1 - P_{S_j}) S_i|.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from galen_model.arm.galen import GRAVITY_M_S2
from galen_model.arrays import Array
from galen_model.errors import NotExcitedError
from galen_model.load.mounting import COMMON_ZERO, FORCE_GAIN, TORQUE_GAIN

if TYPE_CHECKING:
    from galen_model.load.readings import StillPoses

LOAD_PARAMETERS = tuple(
    f"the {load}'s {what}"
    for load in ("tool", "adapter")
    for what in ("mass", "centre along x", "centre along y", "centre along z")
)
"""The leading parameters of the designs, in order."""

MAX_INFLATION = 25.0
"""Standard deviation over that of ideal poses beyond which a combination is not identifiable.

The default grid of 56 poses has 4 at worst; one within +-0.1 rad of both angles has 29.
"""
MAX_STD = 0.01
"""Rad (0.57 degrees) or gain (1 %): a parameter known no better isn't reported.

It is as large as what such parameters are in practice, and far within where the model is linear.
"""

_EXACT = 1e6  # an inflation that only rounding keeps from being infinite
_ROUNDING = 1e-9  # of the largest column: a smaller one has no effect
_MASSES, _CENTRES = "the masses", "the centres"
_TURN = "turn the sensor further, about every axis, or sweep with the base in another place"
_ZERO_TWINS = {
    "the base's inclination": (
        "ask for one of them; level the base, or find the joint's zero with a tracker"
    ),
    "the sensor's rotation": "ask for one of them; a tracker shows where the joint stands",
}
"""Remedies where a joint's zero is confused with these."""
_REMEDIES = {
    frozenset({FORCE_GAIN, _MASSES}): (
        "weigh the load on a scale (known mass), or ask for the gains' ratios only"
    ),
    frozenset({TORQUE_GAIN, _CENTRES}): (
        "a load whose centre is known from elsewhere, or ask for the gains' ratios only"
    ),
}


def check_excitation(
    design: Array, names: Sequence[str], poses: Mapping[str, StillPoses] | None = None
) -> None:
    """Check that the poses identify every parameter of the loads.

    Args:
        design: (n, 6, q): the parameters asked for come first, four of each load.
        names: of these parameters.
        poses: sweeps by their labels, for the error's text.

    Raises:
        NotExcitedError: a combination is not identifiable; the message names what is missing.

    """
    values, directions = _inflation(design, len(names))
    bad = np.flatnonzero(values > MAX_INFLATION)
    if not len(bad):
        return
    share = np.sum(directions[:, bad] ** 2, axis=1)
    missing = [name for name, part in zip(names, share, strict=True) if part > 0.1]
    worst = values[bad].max()
    size = "no information"
    if np.isfinite(worst):
        size = f"{worst:.0f} times less information than well-spread poses"
    spread = "; ".join(
        f"{len(sweep)} poses {label} span "
        + _join(
            [
                f"{span:.3f} rad of {name}"
                for name, span in zip(
                    sweep.arm.turning_names, np.ptp(sweep.angles, axis=0), strict=True
                )
            ]
        )
        for label, sweep in (poses or {}).items()
    )
    raise NotExcitedError(
        f"insufficient excitation: the poses hold {size} about {_join(missing)}"
        + (f" ({spread})" if spread else "")
        + ": turn the sensor further, about two axes at least"
    )


def _inflation(design: Array, parameters: int) -> tuple[Array, Array]:
    """Inflations (p,), largest last, and their directions (p, p; columns) of the leading p.

    Directions are in parameters scaled by their ideal standard deviations.
    """
    count = len(design)
    gravity = -GRAVITY_M_S2[2]
    ideal = np.where(
        np.arange(parameters) % 4 == 0,
        1.0 / (gravity * np.sqrt(count)),
        np.sqrt(1.5 / count) / gravity,
    )
    rows = design.reshape(-1, design.shape[2])
    asked, nuisance = rows[:, :parameters] * ideal, rows[:, parameters:]
    # what of the asked columns the nuisances can't take
    basis, singular, _ = np.linalg.svd(nuisance, full_matrices=False)
    basis = basis[:, singular > 1e-9 * singular.max()]
    free = asked - basis @ (basis.T @ asked)
    _, size, directions = np.linalg.svd(free, full_matrices=False)
    with np.errstate(divide="ignore"):
        return 1.0 / np.where(size < 1e-9, 0.0, size), directions.T


def _join(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else ", ".join(names[:-1]) + " and " + names[-1]


def check_identifiable(
    jacobian: Array,
    sigma: Array,
    loads: int,
    names: Sequence[str],
    known_rows: Array,
    max_std: float | None = MAX_STD,
) -> None:
    """Check that every parameter of the mounting is identifiable.

    Args:
        jacobian: (n, 6, p), columns: the loads' moments, the parameters, the offsets.
        sigma: (6,) noise of a reading.
        loads: number of moments.
        names: of the parameters.
        known_rows: (k, p) what is known of the loads beforehand, over its standard deviation.
        max_std: largest standard deviation, rad or a gain; None: the noise is not known yet.

    Raises:
        NotExcitedError: naming the parameters that are not, each with what it is confused with.

    """
    space = _Space(jacobian, sigma, loads, names, known_rows, max_std)
    order = {name: place for place, name in enumerate(names)}
    pairs: dict[frozenset[str], str] = {}
    for index, name in enumerate(names):
        twins = space.twins(index)
        if twins is None:
            continue
        pair = frozenset({name, *twins})
        named = sorted(pair, key=lambda one: (order.get(one, len(order)), one))
        pairs.setdefault(pair, f"{_join(named)} ({_remedy(pair)})")
    if pairs:
        raise NotExcitedError(f"not identifiable from these poses: {'; '.join(pairs.values())}")


def _remedy(pair: frozenset[str]) -> str:
    if _CENTRES in pair and TORQUE_GAIN not in pair and any("of t" in name for name in pair):
        return "a load well off every axis, or ask for the force gains' ratios only"
    if any(name.endswith("joint's zero") or name.startswith(COMMON_ZERO) for name in pair):
        for twin, remedy in _ZERO_TWINS.items():
            if any(name.startswith(twin) for name in pair):
                return remedy
    return _REMEDIES.get(pair, _TURN)


class _Space:
    def __init__(
        self,
        jacobian: Array,
        sigma: Array,
        loads: int,
        names: Sequence[str],
        known: Array,
        max_std: float | None,
    ) -> None:
        rows = (jacobian / sigma[:, None]).reshape(-1, jacobian.shape[2])
        self._rows = np.concatenate([rows, known])
        self._nothing = _ROUNDING * float(np.linalg.norm(rows, axis=0).max())
        # What is known beforehand is as good as it is stated, beside readings however exact.
        self._limit = _EXACT if len(known) else MAX_INFLATION
        self._max_std = max_std
        self._names = names
        self._first = loads
        self._offsets = list(range(loads + len(names), self._rows.shape[1]))
        moments = np.arange(loads)
        self._loads = {
            _MASSES: moments[moments % 4 == 0].tolist(),
            _CENTRES: moments[moments % 4 != 0].tolist(),
        }

    def twins(self, index: int) -> tuple[str, ...] | None:
        """Names of what parameter `index` is confused with, () for none in particular.

        None: it is identifiable.
        """
        mine = self._first + index
        beside = self._offsets + [column for part in self._loads.values() for column in part]
        others = [self._first + j for j in range(len(self._names)) if j != index]
        alone = self._free(mine, self._offsets)
        beside_loads = self._free(mine, beside)
        beside_all = self._free(mine, beside + others)
        if alone <= self._nothing or self._lost(alone, alone):
            return ()
        if self._lost(alone, beside_loads):
            free = {
                name: self._free(mine, [c for c in beside if c not in part])
                for name, part in self._loads.items()
            }
            best = max(free, key=lambda name: free[name])
            return () if self._lost(alone, free[best]) else (best,)
        if not self._lost(beside_loads, beside_all):
            return None
        for other in others:
            if self._lost(beside_loads, self._free(mine, [*beside, other])):
                return (self._names[other - self._first],)
        return tuple(
            self._names[other - self._first]
            for other in others
            if self._free(mine, [*beside, *(o for o in others if o != other)]) > 2.0 * beside_all
        )

    def _lost(self, of: float, free: float) -> bool:
        too_vague = self._max_std is not None and free * self._max_std < 1.0
        return free * self._limit < of or too_vague

    def _free(self, mine: int, taken: list[int]) -> float:
        """Length of column `mine` after the columns `taken` have taken what they can."""
        column, basis = self._rows[:, mine], self._rows[:, taken]
        length = np.linalg.norm(basis, axis=0)
        basis = basis[:, length > 0.0] / length[length > 0.0]
        left, singular, _ = np.linalg.svd(basis, full_matrices=False)
        left = left[:, singular > 1e-9 * singular.max(initial=0.0)]
        for _ in range(2):  # twice: the first leaves rounding in the directions taken
            column = column - left @ (left.T @ column)
        return float(np.linalg.norm(column))
