"""Score load models on readings that their fit has not seen.

Groups are held out whole: a reading, a stop, a block of neighbouring readings. Each model is fitted
anew without the group and predicts it; the score is the root mean square of the residual.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from galen_bags.arrays.orientation_table import OrientationTable
from galen_model.arrays import Array
from galen_model.errors import GalenError, IdentificationError
from galen_model.evidence.block_gain import MOUNTED, PLAIN, ROBUST, Worth, compare
from galen_model.load.drifting_identification import DriftingLoad, identify_drifting_load
from galen_model.load.identification import identify_single_load, plain_least_squares
from galen_model.load.model import gravity_regressor
from galen_model.load.mounting.identification import (
    KnownLoad,
    MountedLoad,
    identify_single_load_mounted,
)

Predictor = Callable[[OrientationTable], Array]
"""From readings, whose wrench it must not look at, to what they should be (n, 6)."""

Model = Callable[[OrientationTable], Predictor]
"""From the readings to learn from to a predictor; both have a time, s or their order."""


def robust_model(known: OrientationTable) -> Predictor:
    """The suite's: each axis weighted by its own noise, outliers rejected, excitation checked."""
    found = identify_single_load(known.gravity, known.wrench)
    return lambda asked: found.predict(asked.gravity)


def plain_model(known: OrientationTable) -> Predictor:
    """The baseline of other packages: ten-parameter least squares, unweighted, unchecked."""
    moments, offset = plain_least_squares(known.gravity, known.wrench)
    return lambda asked: gravity_regressor(asked.gravity) @ moments + offset


def identify_drifting(known: OrientationTable) -> DriftingLoad:
    """The load with a bias chosen by blocks (`bias_choice`), the table's own where it has them.

    The table has times. Raises IdentificationError.
    """
    assert known.time is not None
    groups = None
    if known.block is not None:
        groups = np.unique(known.block, return_inverse=True)[1]
    return identify_drifting_load(known.gravity, known.wrench, known.time, groups)


def drifting_model(known: OrientationTable) -> Predictor:
    """With a bias that may drift, as blocks of the known readings choose.

    A held-out block between known readings is bridged by the curve, one at an end extrapolated.
    """
    found = identify_drifting(known)

    def predict(asked: OrientationTable) -> Array:
        assert asked.time is not None
        return found.predict(asked.gravity, asked.time)

    return predict


MODELS: dict[str, Model] = {"plain least squares": plain_model, "galen": robust_model}
BLOCK_MODELS: dict[str, Model] = {"galen, drifting bias": drifting_model}
"""Those for blocks alone: a single reading lies between two neighbours that tell any curve."""


@dataclass(frozen=True)
class Score:
    """Residuals (n, 6) of held-out readings, and the groups that could not be scored."""

    residuals: Array
    groups: int
    rejected: tuple[str, ...]

    @property
    def rmse(self) -> Array:
        """Root mean square residual (6,), N and N.m; NaN when no group could be scored."""
        if not len(self.residuals):
            return np.full(6, np.nan)
        return np.asarray(np.sqrt(np.mean(self.residuals**2, axis=0)))


def contiguous_blocks(count: int, blocks: int) -> np.ndarray:
    """Labels (count,) of `blocks` runs of neighbouring readings of about one length."""
    if not 2 <= blocks <= count:
        raise GalenError(f"{blocks} blocks of {count} readings: give 2 to {count}")
    return np.arange(count) * blocks // count


def cross_validate(table: OrientationTable, groups: np.ndarray, model: Model) -> Score:
    """Hold out each of `groups` (n,) in turn; a model may reject to do without one: see `Score`."""
    table = table.timed()
    residuals = np.full(table.wrench.shape, np.nan)
    rejected = []
    labels = list(dict.fromkeys(groups.tolist()))
    for label in labels:
        held = groups == label
        try:
            block = None if table.block is None else table.block[~held]
            predict = model(table.take(~held, block))
        except IdentificationError as error:
            rejected.append(f"without {label}: {error}")
            continue
        residuals[held] = table.wrench[held] - predict(table.take(held, None))
    scored = np.isfinite(residuals[:, 0])
    return Score(residuals[scored], len(labels), tuple(rejected))


@dataclass(frozen=True)
class TableMounting:
    """Groups (`galen_model.load.mounting.mounting`) to estimate beside the load; what is known."""

    groups: tuple[str, ...]
    known: KnownLoad | None = None

    def identify(self, table: OrientationTable) -> MountedLoad:
        """From all of a table's readings; raises IdentificationError."""
        return identify_single_load_mounted(
            table.gravity, table.wrench, self.groups, table.rotation, self.known
        )

    def model(self, known: OrientationTable) -> Predictor:
        """A model for `cross_validation`; raises IdentificationError."""
        found = self.identify(known)
        return lambda asked: found.predict(asked.gravity, asked.rotation)


def table_worth(scores: dict[str, Score], groups: np.ndarray, sigma: Array) -> Worth | None:
    """Whether the mounting pays on the held-out `groups` (n,); None where a group has no score."""
    chosen = {name: scores[name] for name in (PLAIN, ROBUST, MOUNTED)}
    if any(score.rejected for score in chosen.values()):
        return None
    labels = list(dict.fromkeys(groups.tolist()))
    return compare(
        {name: [of.residuals[groups == label] for label in labels] for name, of in chosen.items()},
        sigma,
    )
