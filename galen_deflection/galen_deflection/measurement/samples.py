"""What deflection models are fitted to and scored on: load and displacement, sample by sample."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from galen_model.arrays import Array

from galen_deflection.errors import FitError

_LARGEST = 1e9
"""Nothing that is measured in SI units here is larger, and sums of squares still have room."""


@dataclass(frozen=True)
class DeflectionSamples:
    """Samples (n,) of an arm under load, at the tracker's stamps.

    stamp_ns (n,): increasing within a segment. segment (n,): stretches without a gap, a jump or a
    lost marker; what a model remembers of the load starts anew in each. position (n,): which of
    the arm's positions it is; set_number (n,): which recording, or which repetition of a position.
    joints (n, 5): m, rad. wrench (n, 6): applied to the tool, compensated, in ft_sensor about its
    origin, N and N.m. deflection (n, 6): displacement of tool_tip that was measured, translation
    (m) and rotation vector (rad) in base_link. tip_m (3,): in ft_sensor. noise (6,): standard
    deviation of one measured deflection.
    """

    stamp_ns: np.ndarray
    segment: np.ndarray
    position: np.ndarray
    set_number: np.ndarray
    joints: Array
    wrench: Array
    deflection: Array
    tip_m: Array
    noise: Array

    def __len__(self) -> int:
        """Number of samples."""
        return len(self.stamp_ns)

    def rows(self, rows: np.ndarray | slice) -> DeflectionSamples:
        """Some of the samples, in their order; whole segments, if a model with memory gets them."""
        picked = {name: getattr(self, name)[rows] for name in _BY_SAMPLE}
        return DeflectionSamples(**picked, tip_m=self.tip_m, noise=self.noise)


def check_to_fit(samples: DeflectionSamples, used: np.ndarray) -> None:
    """Raise FitError unless a model can be fitted to the used samples (n,) bool."""
    if not used.any():
        raise FitError("there are no samples to fit a deflection model to")
    for values in (samples.joints, samples.wrench, samples.deflection[used]):
        if not np.isfinite(values).all():
            raise FitError("samples to fit a deflection model to hold values that aren't finite")
        if np.abs(values).max() > _LARGEST:
            raise FitError(
                f"samples to fit a deflection model to hold {np.abs(values).max():.3g}, which is no"
                " measurement in SI units"
            )
    if not np.all(samples.noise > 0.0):
        raise FitError(
            "the noise of the samples, by which a fit weighs them, is"
            f" {', '.join(f'{value:.3g}' for value in samples.noise)} (m, rad): not above zero in"
            " all axes"
        )


_WHOLE = ("tip_m", "noise")
_BY_SAMPLE = tuple(f.name for f in fields(DeflectionSamples) if f.name not in _WHOLE)


def joined(parts: Sequence[DeflectionSamples]) -> DeflectionSamples:
    """Samples of several recordings of one tool; segments and set numbers stay apart.

    The noise is the root mean square of theirs. Positions keep their numbers: give the same one to
    the same place. Raises ValueError for another tip, or for no parts.
    """
    if not parts:
        raise ValueError("no samples to join")
    for part in parts[1:]:
        if not np.allclose(part.tip_m, parts[0].tip_m, atol=1e-9):
            raise ValueError(f"tips differ: {parts[0].tip_m.tolist()} and {part.tip_m.tolist()}")
    columns = {name: [getattr(part, name) for part in parts] for name in _BY_SAMPLE}
    for name in ("segment", "set_number"):
        first = 0
        for k, numbers in enumerate(columns[name]):
            columns[name][k] = numbers + first
            first += int(numbers.max(initial=-1)) + 1
    weights = np.array([len(part) for part in parts], dtype=float)
    noise = np.sqrt(np.average([part.noise**2 for part in parts], axis=0, weights=weights))
    return DeflectionSamples(
        **{name: np.concatenate(values) for name, values in columns.items()},
        tip_m=parts[0].tip_m,
        noise=noise,
    )
