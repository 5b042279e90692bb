"""Can the poses tell the mounting's parameters apart, and from the loads? A gate.

With rows whitened by the noise, N the columns of loads and offsets (and what is known of the loads
beforehand as further rows), S_i the column of a parameter and P the projection on columns:

    t_i = |(1 - P_N) S_i|                    what of it the loads can't take
    r_i = |(1 - P_{N, S_others}) S_i|        what nothing else can take; its deviation is 1 / r_i

Parameter i isn't told if t_i vanishes beside |(1 - P_offsets) S_i|, if r_i does beside t_i, or if
1 / r_i is beyond `MAX_STD`. Its twin is the load's part, or the parameter, without which it would
be told. Cf. the confusability D_ij = |(1 - P_{S_j}) S_i|.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from galen_model.arrays import Array
from galen_model.errors import NotToldApartError
from galen_model.load.excitation import MAX_INFLATION
from galen_model.load.mounting.mounting import FORCE_GAIN, TORQUE_GAIN

MAX_STD = 0.01
"""Rad (0.57 degrees) or gain (1 %): a parameter known no better isn't reported.

It is as large as what such parameters are in practice, and far within where the model is linear.
"""

_EXACT = 1e6  # an inflation that only rounding keeps from being infinite
_MASSES, _CENTRES = "the masses", "the centres"
_TURN = "turn the sensor further, about both axes"
_REMEDIES = {
    frozenset({"the roll joint's zero", "the base's inclination about x"}): (
        "ask for one of them; level the base, or find the joint's zero with a tracker"
    ),
    frozenset({"the tilt joint's zero", "the sensor's rotation about y"}): (
        "ask for one of them; a tracker tells where the joint stands"
    ),
    frozenset({FORCE_GAIN, _MASSES}): (
        "weigh the load on a scale (known mass), or ask for the gains' ratios only"
    ),
    frozenset({TORQUE_GAIN, _CENTRES}): (
        "a load whose centre is known from elsewhere, or ask for the gains' ratios only"
    ),
}


@dataclass(frozen=True)
class JacobianColumns:
    """Which columns of the Jacobian are what, and the names of the last ones."""

    masses: Sequence[int]
    centres: Sequence[int]
    offsets: Sequence[int]
    names: Sequence[str]


def check_told(
    jacobian: Array,
    sigma: Array,
    columns: JacobianColumns,
    known_rows: Array,
    *,
    what_separates: str = _TURN,
    max_std: float | None = MAX_STD,
) -> None:
    """Raise NotToldApartError naming the pairs, unless the poses tell every parameter.

    jacobian: (n, 6, p); sigma: (6,) noise of a reading; known_rows: (k, p) what is known of the
    loads beforehand, over its standard deviation. max_std None: before the noise is known.
    """
    space = _Space(jacobian, sigma, columns, known_rows)
    pairs: dict[frozenset[str], str] = {}
    for index, name in enumerate(columns.names):
        twins = space.twins(index, max_std)
        if twins is None:
            continue
        pair = frozenset({name, *twins})
        *first, last = sorted(pair, key=_order(columns.names))
        both = f"{', '.join(first)} and {last}"
        said = f"tell {both} apart" if first else f"tell enough of {name}"
        pairs.setdefault(pair, f"{said} ({_remedy(pair, what_separates)})")
    if pairs:
        raise NotToldApartError(
            "the poses can't " + "; nor can they ".join(pairs.values()),
            tuple(tuple(sorted(pair, key=_order(columns.names))) for pair in pairs),
        )


def _remedy(pair: frozenset[str], otherwise: str) -> str:
    if _CENTRES in pair and TORQUE_GAIN not in pair and any("of t" in name for name in pair):
        return "a load well off every axis, or ask for the force gains' ratios only"
    return _REMEDIES.get(pair, otherwise)


def _order(names: Sequence[str]) -> Callable[[str], tuple[int, str]]:
    places = {name: place for place, name in enumerate(names)}
    return lambda name: (places.get(name, len(places)), name)


class _Space:
    def __init__(
        self, jacobian: Array, sigma: Array, columns: JacobianColumns, known: Array
    ) -> None:
        rows = (jacobian / sigma[:, None]).reshape(-1, jacobian.shape[2])
        self._rows = np.concatenate([rows, known])
        self._has_known = len(known) > 0
        self._columns = columns
        self._first = self._rows.shape[1] - len(columns.names)
        self._loads = {_MASSES: list(columns.masses), _CENTRES: list(columns.centres)}

    def twins(self, index: int, max_std: float | None) -> tuple[str, ...] | None:
        """Names of what can't be told from parameter `index`; () for none in particular.

        None: it is told.
        """
        mine = [self._first + index]
        offsets = list(self._columns.offsets)
        every_load = [column for part in self._loads.values() for column in part]
        others = [self._first + j for j in range(len(self._columns.names)) if j != index]
        alone = self._left(mine, offsets)
        beside_loads = self._left(mine, offsets + every_load)
        beside_all = self._left(mine, offsets + every_load + others)

        # What is known beforehand is as good as it is stated, beside readings however exact.
        limit = _EXACT if self._has_known else MAX_INFLATION

        def lost(of: float, left: float) -> bool:
            return left * limit < of or (max_std is not None and left * max_std < 1.0)

        if alone == 0.0 or lost(alone, alone):
            return ()
        if lost(alone, beside_loads):
            free = {
                name: self._left(mine, [c for c in offsets + every_load if c not in part])
                for name, part in self._loads.items()
            }
            best = max(free, key=lambda name: free[name])
            return () if lost(alone, free[best]) else (best,)
        if not lost(beside_loads, beside_all):
            return None
        for other in others:
            if lost(beside_loads, self._left(mine, [*offsets, *every_load, other])):
                return (self._columns.names[other - self._first],)
        return tuple(
            self._columns.names[other - self._first]
            for other in others
            if self._left(mine, [*offsets, *every_load, *(o for o in others if o != other)])
            > 2.0 * beside_all
        )

    def _left(self, mine: list[int], taken: list[int]) -> float:
        """Length of column `mine` after the columns `taken` have taken what they can."""
        column, basis = self._rows[:, mine[0]], self._rows[:, taken]
        length = np.linalg.norm(basis, axis=0)
        basis = basis[:, length > 0.0] / length[length > 0.0]
        left, singular, _ = np.linalg.svd(basis, full_matrices=False)
        left = left[:, singular > 1e-9 * singular.max(initial=0.0)]
        for _ in range(2):  # twice: the first leaves rounding in the directions taken
            column = column - left @ (left.T @ column)
        return float(np.linalg.norm(column))
