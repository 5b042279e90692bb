# SPDX-License-Identifier: Apache-2.0
"""The 2019 report's first two models, as baselines: one compliance of the tip at all positions.

Section 2.3.5, figures 3 and 4: "independence of axes was assumed, and deflection was modeled
linearly with respect to force applied in each axis"; then, figure 5: "deflection of each axis was
modeled as a linear combination of force in each axis, determined by linear least squares":

    independent: d_i = C_ii w_i,    coupled: d_i = sum_j C_ij w_j,    i, j = 1 .. 6

with d the translation and rotation vector of tool_tip and w the force and the moment about it, both
in base_link. The report does not define the frame of its force: d and w must share axes and a point
for "each axis" to have a meaning. Without load there is no deflection, so there is no offset. As in
the report, C is not held symmetric, and nothing keeps its elements positive.

At one position an arm of springs is such a C = J K^-1 J^T; J and thus C changes with the position.
So a fit holds near the positions that it was fitted at (elsewhere a prediction is extrapolated), is
an average where they are several, and has no hysteresis.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import product
from typing import Any

import numpy as np
from galen_model.arm.arm import Arm
from galen_model.arrays import Array

from galen_deflection.measurement.samples import DeflectionSamples
from galen_deflection.models.interface import FitSettings, tip_from_json
from galen_deflection.models.least_squares import finished, sums
from galen_deflection.models.spring_model import Parameter, SpringBasis, SpringModel
from galen_deflection.models.springs import USUAL_COMPLIANCE, Springs

INDEPENDENT, COUPLED = "independent", "coupled"

BASELINE = (
    "a baseline (2019 report, section 2.3.5): one compliance for all positions, averaged over"
    " those that it was fitted at and of use only near them; no hysteresis"
)

_PAIRS = {
    INDEPENDENT: tuple((axis, axis) for axis in range(6)),
    COUPLED: tuple(product(range(6), range(6))),
}
_MOTIONS, _LOADS = ("x", "y", "z", "rx", "ry", "rz"), ("fx", "fy", "fz", "tx", "ty", "tz")


@dataclass(frozen=True)
class AxesBasis(SpringBasis):
    """Elements C_ij of the tip's compliance, at `pairs` (i, j) of motion and load."""

    pairs: tuple[tuple[int, int], ...] = ()

    @cached_property
    def compliances(self) -> tuple[Parameter, ...]:
        """C_ij, as x/fy: before any sample, 0 give or take sqrt(C_ii C_jj) at home.

        C is positive definite, so that no element is larger. For C_ii stands the trace of the
        translation's or the rotation's block, which depends less on how the arm stands at home.
        """
        jacobian = Springs(self.tip_m, self.arm).geometry(self.arm.home[None]).jacobian[0]
        expected = np.concatenate([[k.compliance_std] * len(k.springs) for k in self.kinds])
        own = (jacobian**2 @ expected).reshape(2, 3).sum(axis=1)
        std = np.sqrt(np.maximum(own, [USUAL_COMPLIANCE["m"], USUAL_COMPLIANCE["rad"]]))
        return tuple(
            Parameter(
                f"{_MOTIONS[i]}/{_LOADS[j]}",
                f"{'m' if i < 3 else 'rad'}/{'N' if j < 3 else '(N.m)'}",
                prior_std=float(std[i // 3] * std[j // 3]),
                signed=True,
            )
            for i, j in self.pairs
        )

    def elastic(self, at_tip: Array, jacobian: Array, loads: Array) -> Array:
        """Return designs of the elements C_ij.

        Args:
            at_tip: (n, 6) wrenches at the tip in base_link, N and N.m.
            jacobian: (n, 6, s) of the springs; not used.
            loads: (n, s) of the springs; not used.

        Returns:
            (n, 6, c), in N and N.m: a column for each of `pairs`.

        """
        motion, load = np.array(self.pairs).T
        design = np.zeros((len(at_tip), 6, len(self.pairs)))
        design[:, motion, np.arange(len(self.pairs))] = at_tip[:, load]
        return design


def _fit(kind: str, samples: DeflectionSamples, settings: FitSettings | None = None) -> SpringModel:
    """Fit by weighted linear least squares; raises DeflectionError."""
    basis = AxesBasis(samples.tip_m, arm=samples.arm, pairs=_PAIRS[kind])
    totals = sums(basis, samples, settings or FitSettings())
    return replace(finished(kind, basis, samples, totals, only_nearby=True), notes=(BASELINE,))


fit_independent, fit_coupled = partial(_fit, INDEPENDENT), partial(_fit, COUPLED)


def read_axes(content: Mapping[str, Any], arm: Arm) -> SpringModel:
    """Read a file's content.

    Args:
        content: the whole file's content, with `kind` one of `independent`, `coupled`.
        arm: the arm that the model is used on.

    Returns:
        The model.

    Raises:
        FieldError: naming what is wrong.

    """
    basis = AxesBasis(tip_from_json(content), arm=arm, pairs=_PAIRS[content["kind"]])
    return SpringModel.from_json(content, arm, basis)
