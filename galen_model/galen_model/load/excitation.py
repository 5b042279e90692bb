"""Do the poses tell what is asked? A gate before, and again after, the fit.

With noise of one unit on every channel, A the stacked design and N = A^T A its information, the
parameters asked for have the covariance C, the leading block of N^-1, the offsets being fitted
too. It is compared with what as many poses would give whose gravity directions were spread evenly
over the sphere and whose offsets were known: var(m) = 1 / (n g^2), var(h) = 3 / (2 n g^2). The
square root of an eigenvalue of the ratio is the inflation of the standard deviation along its
eigenvector; where it is infinite or very large, the poses do not tell that combination.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from galen_model.arm.galen import GRAVITY_M_S2
from galen_model.arrays import Array
from galen_model.errors import NotExcitedError

if TYPE_CHECKING:
    from galen_model.load.identification import StillPoses

LOAD_PARAMETERS = (
    "the tool's mass",
    "the tool's centre along x",
    "the tool's centre along y",
    "the tool's centre along z",
    "the adapter's mass",
    "the adapter's centre along x",
    "the adapter's centre along y",
    "the adapter's centre along z",
)
"""The leading parameters of the designs, in order."""

MAX_INFLATION = 25.0
"""Standard deviation over that of ideal poses beyond which a combination counts as not told.

The default grid of 56 poses has 4 at worst; one within +-0.1 rad of roll and tilt has 29.
"""


def inflation(design: Array, parameters: int) -> tuple[Array, Array]:
    """Inflations (p,), largest last, and their directions (p, p; columns) of the leading p.

    design: (n, 6, q). Directions are in parameters scaled by their ideal standard deviations.
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
    _, told, directions = np.linalg.svd(free, full_matrices=False)
    with np.errstate(divide="ignore"):
        return 1.0 / np.where(told < 1e-9, 0.0, told), directions.T


def check_excitation(
    design: Array, names: Sequence[str], poses: Mapping[str, StillPoses] | None = None
) -> None:
    """Raise NotExcitedError, naming what is missing, unless the poses tell every parameter.

    design (n, 6, q): the parameters asked for come first, in the order of `names`.
    """
    values, directions = inflation(design, len(names))
    bad = np.flatnonzero(values > MAX_INFLATION)
    if not len(bad):
        return
    share = np.sum(directions[:, bad] ** 2, axis=1)
    missing = [name for name, part in zip(names, share, strict=True) if part > 0.1]
    worst = values[bad].max()
    size = "nothing" if np.isinf(worst) else f"{worst:.0f} times less than well-spread poses would"
    spread = "; ".join(
        f"{len(sweep.roll)} poses {label} span {np.ptp(sweep.roll):.3f} rad of roll and "
        f"{np.ptp(sweep.tilt):.3f} rad of tilt"
        for label, sweep in (poses or {}).items()
    )
    raise NotExcitedError(
        f"the poses tell {size} about {_join(missing)}"
        + (f" ({spread})" if spread else "")
        + ": turn the sensor further, about both axes"
    )


def _join(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else ", ".join(names[:-1]) + " and " + names[-1]
