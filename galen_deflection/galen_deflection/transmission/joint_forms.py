"""The physical models of a joint: which terms each has, and how fine its thresholds are.

Thresholds lie on grids; how fine a grid is worth it, parts that a fit has not seen tell: of the
grids, the coarsest within 1 % of the best mean square is taken. `ours` is the form that these parts
choose in the same way, the simplest first.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from galen_model.arrays import Array
from galen_model.transmission.terms import MOTION_PLAYS, TORQUE_PLAYS

from galen_deflection.transmission.joint_fit import CellSums, fit_terms

_WORTH_IT = 0.01

_TORQUE_GRIDS = ((3,), (1, 4), (0, 2, 4, 6), tuple(range(len(TORQUE_PLAYS))))
_MOTION_GRIDS = ((4,), (2, 4), (0, 2, 4, 6), tuple(range(len(MOTION_PLAYS))))


@dataclass(frozen=True)
class Form:
    """A model's terms beside the offset and the common ones; grids of plays to choose from."""

    name: str
    summary: str
    terms: tuple[str, ...]
    grids: tuple[tuple[str, ...], ...] = ((),)
    common: bool = True

    def candidates(self, common: Sequence[str]) -> list[tuple[str, ...]]:
        """Sets of terms, the coarsest grid first."""
        given = ("offset", *(common if self.common else ()), *self.terms)
        return [given + grid for grid in self.grids]


def _plays(names: Sequence[str], grids: Sequence[Sequence[int]]) -> tuple[tuple[str, ...], ...]:
    return tuple(tuple(names[k] for k in grid) for grid in grids)


_TORQUE, _MOTION = _plays(TORQUE_PLAYS, _TORQUE_GRIDS), _plays(MOTION_PLAYS, _MOTION_GRIDS)

FORMS = (
    Form("constant", "the mean lag", (), common=False),
    Form("common terms", "no give: offset and the terms that all others have", ()),
    Form("linear", "a spring: linear in the torque", ("spring",)),
    Form("direction", "a spring and the motor's direction of motion", ("spring", "direction")),
    Form("torque plays", "a spring with friction: plays of the torque", ("spring",), _TORQUE),
    Form("lost motion", "a spring and lost motion: plays of the motor's", ("spring",), _MOTION),
    Form(
        "both plays",
        "a spring, plays of the torque and of the motor's motion",
        ("spring",),
        tuple(a + b for a, b in zip(_TORQUE, _MOTION, strict=True)),
    ),
)
"""In the order in which they are listed, simpler ones first."""

BASELINES = ("constant", "common terms")
"""What is no model of a torque."""


class Chosen(NamedTuple):
    """A form with its terms, and the mean square (rad^2) that they left on parts held out.

    next_best: the terms of its next best grid; the same where it has only one.
    """

    form: Form
    terms: tuple[str, ...]
    held_out: float
    next_best: tuple[str, ...]


def choose(form: Form, sums: CellSums, parts: Sequence[int], common: Sequence[str]) -> Chosen:
    """The terms of a form that hold-outs among these parts choose."""
    candidates = form.candidates(common)
    costs = [held_out_cost(sums, parts, terms) for terms in candidates]
    at = first_good(costs)
    others = [k for k in range(len(costs)) if k != at] or [at]
    return Chosen(form, candidates[at], costs[at], candidates[min(others, key=costs.__getitem__)])


def ours(chosen: Sequence[Chosen]) -> Chosen:
    """Of the forms that know of the torque or of motion, the one that hold-outs choose."""
    physical = [one for one in chosen if one.form.name not in BASELINES]
    return physical[first_good([one.held_out for one in physical])]


def held_out_cost(sums: CellSums, parts: Sequence[int], terms: Sequence[str]) -> float:
    """Mean square (rad^2) of the residuals of each part by a fit to the others of `parts`."""
    square, count = 0.0, 0
    for part in parts:
        weights = fit_terms(sums, sums.of_parts([k for k in parts if k != part]), terms)
        cells = sums.of_parts([part])
        square += sums.cost(weights, cells)
        count += int(sums.count[cells].sum())
    return square / count


def first_good(costs: Sequence[float]) -> int:
    """The first whose cost is the least, or within a hundredth of it."""
    array: Array = np.asarray(costs)
    return int(np.argmax(array <= (1.0 + _WORTH_IT) * array.min()))
