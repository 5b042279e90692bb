# SPDX-License-Identifier: Apache-2.0
"""Load models on a table of readings: fitted to all, scored on readings that no fit has seen.

Groups are held out whole: a reading, a rest segment, a block of neighbouring readings. Each model
is fitted anew without the group and predicts it; the score is the root mean square of the residual.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import partial

import numpy as np
from galen_bags.arrays.tables import (
    OrientationTable,
    average_runs,
    average_still,
    is_recording,
    still_readings,
    without_repeats,
)
from galen_model.arm.arm import STANDARD_GRAVITY_M_S2
from galen_model.arrays import Array
from galen_model.errors import GalenError, IdentificationError
from galen_model.files.calibration_file import CalibrationFile
from galen_model.load.choice import ChosenLoad, choose_load, refit
from galen_model.load.identification import SingleLoad, identify_single_load, plain_least_squares
from galen_model.load.model import LoadEstimate, gravity_regressor
from galen_model.load.mounting_worth import MOUNTED, PLAIN, ROBUST, Worth, compare
from galen_model.rest.segments import DirectionRest
from galen_model.setup_check.check import SetupError, SetupFinding, check_setup
from galen_model.setup_check.readings import fit_load

_FEWEST_READINGS = 4
_AVERAGES = 200
_LEAST_LEVER_M = 0.002
_FITS, _DOES_NOT_FIT = 0.02, 0.3  # residual over change; sensors promise 0.5 to 1.5 % of full scale
_MOST_LEFT_OUT_ONE_BY_ONE = 200  # each takes a fit of all others
_CHOSEN = "galen, chosen"
_CHOICE = 300.0  # how many times longer a choice takes than a fit
_UNRESOLVED = (
    "how much of the load is the adapter: all that hangs on the sensor is written as the tool, and"
    " the adapter as nothing; the compensation is not affected",
    "where and with what on it the sensor was zeroed: residual_offset holds the whole constant part"
    " of the reading",
    "the tip: written as (0, 0, 0)",
)

Predictor = Callable[[OrientationTable], Array]
"""From readings, whose wrench it must not look at, to what they should be (n, 6)."""

Model = Callable[[OrientationTable], Predictor]
"""From the readings to learn from to a predictor; both have a time, s or their order."""


def robust_model(known: OrientationTable) -> Predictor:
    """Fit the suite's: axes weighted by their noise, outliers rejected, excitation checked.

    Args:
        known: readings to learn from.

    Returns:
        Predictor of readings (n, 6), N and N.m.

    Raises:
        IdentificationError: the readings don't determine the load.

    """
    found = identify_single_load(known.gravity, known.wrench, arm=known.arm)
    return lambda asked: found.predict(asked.gravity)


def plain_model(known: OrientationTable) -> Predictor:
    """Fit the baseline of other packages: ten-parameter least squares, unweighted, unchecked.

    Args:
        known: readings to learn from.

    Returns:
        Predictor of readings (n, 6), N and N.m.

    """
    moments, offset = plain_least_squares(known.gravity, known.wrench)
    return lambda asked: gravity_regressor(asked.gravity) @ moments + offset


def identify_mounted(groups: tuple[str, ...], known: OrientationTable) -> SingleLoad:
    """Identify load and mounting groups together.

    Args:
        groups: names of mounting groups, as `sensor_rotation`.
        known: readings to learn from; some groups need their rotation.

    Returns:
        Load and mounting.

    Raises:
        IdentificationError: the readings don't determine them.

    """
    return identify_single_load(known.gravity, known.wrench, groups, known.rotation, arm=known.arm)


def mounted_model(groups: tuple[str, ...], known: OrientationTable) -> Predictor:
    """Fit load and mounting groups together.

    Args:
        groups: names of mounting groups, as `sensor_rotation`.
        known: readings to learn from; some groups need their rotation.

    Returns:
        Predictor of readings (n, 6), N and N.m.

    Raises:
        IdentificationError: the readings don't determine them.

    """
    found = identify_mounted(groups, known)
    return lambda asked: found.predict(asked.gravity, asked.rotation)


def identify_chosen(known: OrientationTable) -> ChosenLoad:
    """Identify the load by the model that blocks choose: the table's own where it has them.

    Args:
        known: readings to learn from, with times.

    Returns:
        The load, and which model and why.

    Raises:
        IdentificationError: the readings don't determine the load.

    """
    assert known.time is not None
    groups = None if known.block is None else np.unique(known.block, return_inverse=True)[1]
    return choose_load(
        known.gravity, known.wrench, known.time, groups, known.temperature_c, arm=known.arm
    )


def chosen_model(known: OrientationTable) -> Predictor:
    """Fit the model that blocks of the known readings choose.

    A drifting bias bridges a block between known readings, and is extrapolated to one at an end.

    Args:
        known: readings to learn from, with times.

    Returns:
        Predictor of readings (n, 6), N and N.m, that have times as well.

    Raises:
        IdentificationError: the readings don't determine the load.

    """
    found = identify_chosen(known)

    def predict(asked: OrientationTable) -> Array:
        assert asked.time is not None
        return found.predict(asked.gravity, asked.time, asked.temperature_c)

    return predict


@dataclass(frozen=True)
class HeldOutScore:
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
    """Label readings by runs of neighbours of about one length.

    Args:
        count: number of readings.
        blocks: number of runs.

    Returns:
        (count,), from 0 to blocks - 1.

    """
    return np.arange(count) * blocks // count


def cross_validate(
    table: OrientationTable,
    groups: np.ndarray,
    model: Model,
    held_out: Callable[[], None] = lambda: None,
) -> HeldOutScore:
    """Hold out each group in turn; a model may reject to do without one.

    Args:
        table: n readings.
        groups: (n,) the group's label of each reading.
        model: fits the others, and predicts the group.
        held_out: called before each.

    Returns:
        Residuals of all readings that could be predicted; why groups were not.

    """
    table = table.timed()
    residuals = np.full(table.wrench.shape, np.nan)
    rejected = []
    labels = list(dict.fromkeys(groups.tolist()))
    for label in labels:
        held = groups == label
        held_out()
        try:
            block = None if table.block is None else table.block[~held]
            predict = model(table.take(~held, block))
        except IdentificationError as error:
            rejected.append(f"without {label}: {error}")
            continue
        residuals[held] = table.wrench[held] - predict(table.take(held, None))
    scored = np.isfinite(residuals[:, 0])
    return HeldOutScore(residuals[scored], len(labels), tuple(rejected))


@dataclass(frozen=True)
class TableEvaluation:
    """Fits and scores of a table; scores by split, then by model.

    phases: how many rest segments were averaged, with their scatter (6,); None: it was no
    recording. chosen: the model that blocks choose, and why; fit: its load. mounted, worth: with
    the mounting groups asked for, and whether they pay. setup: a wrong set-up, or None.
    """

    table: OrientationTable
    source_rows: int
    phases: int | None
    chosen: ChosenLoad
    fit: SingleLoad
    scores: dict[str, dict[str, HeldOutScore]]
    scatter: Array | None
    tool: CalibrationFile | None = None
    tool_residuals: Array | None = None
    notes: list[str] = field(default_factory=list)
    mounted: SingleLoad | None = None
    worth: Worth | None = None
    setup: SetupFinding | None = None

    @property
    def off(self) -> float:
        """Residual over how readings change: of forces or, where they are more than noise, torques.

        A torque's residual counts from a lever of 2 mm of the weight on.
        """
        fit = fit_load(still_readings(self.table))
        weight = abs(fit.mass_kg) * STANDARD_GRAVITY_M_S2
        counts = fit.residual[1] > _LEAST_LEVER_M * weight
        return float(max(fit.relative[0], fit.relative[1] if counts else 0.0))

    @property
    def fits(self) -> bool | None:
        """Whether the load fits; None: not well, and not badly."""
        off = self.off
        if self.setup is not None or off > _DOES_NOT_FIT:
            return False
        return True if off < _FITS else None

    @property
    def verdict(self) -> str:
        """Whether the load fits, to what, and against its weight, in a sentence."""
        if self.setup is not None:
            return f"The load does not fit. {self.setup.sentence}"
        residual = self.table.wrench[self.fit.used] - self.fit.predict(
            self.table.gravity[self.fit.used]
        )
        force, torque = (np.sqrt(np.mean(part**2)) for part in np.split(residual, 2, axis=1))
        weight = self.fit.load.mass_kg * STANDARD_GRAVITY_M_S2
        size = f"{force:.3g} N and {torque * 1e3:.3g} mN.m, {force / weight:.2%} of its weight"
        if self.fits:
            return f"The load fits, to {size}"
        if self.fits is None:
            return f"The load fits to {size}, more than sensors promise: `diagnose` names the cause"
        return (
            f"The load does not fit: the residual is {size}. Was the tool touched, do the"
            " orientations belong to the readings?"
        )


def evaluate_table(
    table: OrientationTable,
    average_window_s: float | None = None,
    tool: CalibrationFile | None = None,
    mounting: tuple[str, ...] = (),
    progress: Callable[[str, float, float], None] = lambda text, done, total: None,
) -> TableEvaluation:
    """Fit and score every model on a table.

    Args:
        table: n readings.
        average_window_s: the table is a recording, and averages of so long, s, are taken at rest;
            None: its rows count, or averages of them where it looks like a recording.
        tool: calibration file to score beside, without a fit; None: none.
        mounting: groups to estimate beside the load, in a model of its own.
        progress: called with what is held out, how much is done, and of how much.

    Returns:
        Fits to all readings, and scores on held-out ones.

    Raises:
        GalenError: naming the obstacle; a `SetupError` where a wrong set-up explains it.

    """
    source_rows, phases, scatter = len(table), None, None
    read_notes = []
    if table.left_out:
        read_notes.append(f"{table.left_out} rows left out: a number is missing or NaN")
    if average_window_s is None:
        table, repeats = without_repeats(table)
        if repeats:
            read_notes.append(f"{repeats} rows repeat another one: counted once")
    if average_window_s is None and is_recording(table):
        table = average_runs(table, _AVERAGES)
        read_notes.append(
            f"{source_rows} rows are a recording: averaged to {len(table)} readings, also in"
            " motion; --average-s SECONDS averages at rest alone"
        )
    elif average_window_s is not None:
        table, scatter = average_still(table, average_window_s, DirectionRest())
        assert table.block is not None
        phases = len(np.unique(table.block))
    if len(table) < _FEWEST_READINGS:
        raise GalenError(
            f"{table.path}: {len(table)} readings; at least {_FEWEST_READINGS} are needed to hold"
            " some out"
        )
    setup = check_setup(still_readings(table))
    try:
        return _evaluated(
            table, source_rows, phases, scatter, tool, mounting, setup, read_notes, progress
        )
    except IdentificationError as error:
        if setup is None:
            raise
        raise SetupError(f"{table.path}: {setup.sentence}") from error


def _evaluated(
    table: OrientationTable,
    source_rows: int,
    phases: int | None,
    scatter: Array | None,
    tool: CalibrationFile | None,
    mounting: tuple[str, ...],
    setup: SetupFinding | None,
    read_notes: list[str],
    progress: Callable[[str, float, float], None],
) -> TableEvaluation:
    splits, notes = _splits(table, phases)
    notes += read_notes
    models: dict[str, Model] = {PLAIN: plain_model, ROBUST: robust_model}
    mounted = None
    if mounting:
        mounted = identify_mounted(mounting, table)
        models[MOUNTED] = partial(mounted_model, mounting)
    blocks = {split: len(set(groups.tolist())) for split, groups in splits.items()}
    tasks = [(split, name, model, 1.0) for split in splits for name, model in models.items()]
    # Not one by one: each choice takes a second.
    tasks += [
        (split, _CHOSEN, chosen_model, _CHOICE)
        for split, count in blocks.items()
        if count < len(table)
    ]
    total, done = sum(cost * blocks[split] for split, _, _, cost in tasks) + _CHOICE, 0.0

    def held_out(cost: float, text: str) -> None:
        nonlocal done
        progress(text, done, total)
        done += cost

    scores: dict[str, dict[str, HeldOutScore]] = {split: {} for split in splits}
    for split, name, model, cost in tasks:
        tell = partial(held_out, cost, f"held out: {split}, {name}")
        scores[split][name] = cross_validate(table, splits[split], model, tell)
    held_out(_CHOICE, "choosing the model")
    chosen = identify_chosen(table.timed())
    fit = chosen.single
    if chosen.fault:
        notes.append(f"no model fits: {chosen.fault}")
    if phases is not None and phases > 2:
        # averages within a segment share its error, so the residuals' own covariance is too small
        covariance = _jackknife(table, partial(_load_vector, chosen, table.timed()))
        fit = replace(fit, load=replace(fit.load, covariance=covariance))
        if mounted is not None:
            mounted = _jackknifed(mounted, mounting, table)
    worth = None
    if mounted is None and chosen.mounting is not None:
        mounted = replace(fit, mounting=chosen.mounting)
    elif mounted is not None:  # the widest blocks that leave enough to identify the mounting
        found = (_worth(scores[s], splits[s], mounted.sigma) for s in reversed(splits))
        worth = next((one for one in found if one is not None), None)
    if not fit.used.all():
        rows = ", ".join(str(row + 1) for row in np.flatnonzero(~fit.used))
        notes.append(f"the fit on all readings left out reading {rows}: off the common load")
    residuals = None if tool is None else table.wrench - table_prediction(tool, table)
    return TableEvaluation(
        table, source_rows, phases, chosen, fit, scores, scatter, tool, residuals, notes, mounted,
        worth, setup,
    )  # fmt: skip


def _splits(table: OrientationTable, phases: int | None) -> tuple[dict[str, np.ndarray], list[str]]:
    """Labels (n,) of the groups that are held out, by name; notes."""
    if table.block is not None:
        splits = {"leave one still phase out" if phases else "leave one block out": table.block}
        order = list(dict.fromkeys(table.block.tolist()))
        count = min(3, len(order) // 2)
        if count >= 2:
            group = contiguous_blocks(len(order), count)
            of_label = {label: f"block {g + 1}" for label, g in zip(order, group, strict=True)}
            splits[f"{count} blocks of neighbours"] = np.array([of_label[b] for b in table.block])
        return splits, []
    splits, notes = {}, []
    if len(table) <= _MOST_LEFT_OUT_ONE_BY_ONE:
        labels = [f"reading {i + 1}" for i in range(len(table))]
        splits["leave one reading out"] = np.array(labels)
    else:
        notes.append(
            f"leave one reading out: not done for {len(table)} readings, more than"
            f" {_MOST_LEFT_OUT_ONE_BY_ONE}; is it a recording (--average-s)?"
        )
    count = min(6, len(table) // 2)
    blocks = [f"block {b + 1}" for b in contiguous_blocks(len(table), count)]
    splits[f"{count} blocks of neighbours"] = np.array(blocks)
    return splits, notes


def _worth(scores: dict[str, HeldOutScore], groups: np.ndarray, sigma: Array) -> Worth | None:
    """Whether the mounting pays on the held-out `groups` (n,); None where a group has no score."""
    chosen = {name: scores[name] for name in (PLAIN, ROBUST, MOUNTED)}
    if any(score.rejected for score in chosen.values()):
        return None
    labels = list(dict.fromkeys(groups.tolist()))
    return compare(
        {name: [of.residuals[groups == label] for label in labels] for name, of in chosen.items()},
        sigma,
    )


def _load_vector(chosen: ChosenLoad, table: OrientationTable, rows: np.ndarray) -> Array:
    assert table.time is not None
    load = refit(
        chosen, table.gravity, table.wrench, table.time, rows, table.temperature_c, arm=table.arm
    ).load
    return np.concatenate([[load.mass_kg], load.com_m])


def _jackknifed(
    mounted: SingleLoad, groups: tuple[str, ...], table: OrientationTable
) -> SingleLoad:

    def values(rows: np.ndarray) -> Array:
        found = identify_mounted(groups, table.take(rows, None))
        assert found.mounting is not None
        load = found.load
        return np.concatenate([[load.mass_kg], load.com_m, found.mounting.vector])

    covariance = _jackknife(table, values)
    assert mounted.mounting is not None
    return replace(
        mounted,
        load=replace(mounted.load, covariance=covariance[:4, :4]),
        mounting=replace(mounted.mounting, covariance=covariance[4:, 4:]),
    )


def _jackknife(table: OrientationTable, estimate: Callable[[np.ndarray], Array]) -> Array:
    """Covariance (k, k) of what `estimate` (k,) finds in rows (n,), leaving out each of G blocks.

    (G - 1) / G sum (x_g - mean) (x_g - mean)^T: Efron and Tibshirani, *An Introduction to the
    Bootstrap* (1993), eq. (11.5). Raises IdentificationError when a block can't be spared.
    """
    assert table.block is not None
    labels = np.unique(table.block)
    values = [estimate(table.block != label) for label in labels]
    spread = np.array(values) - np.mean(values, axis=0)
    return np.asarray((len(labels) - 1) / len(labels) * spread.T @ spread)


# Calibration files


def table_prediction(tool: CalibrationFile, table: OrientationTable) -> Array:
    """Predict readings at a table's orientations by a file, its mounting included.

    Args:
        tool: the calibration file.
        table: n readings, whose orientations are used.

    Returns:
        (n, 6), N and N.m in the sensor's frame.

    Raises:
        GalenError: the file's mounting needs what the table doesn't hold.

    """
    mounting = tool.mounting
    if mounting is None:
        return tool.predict_under(table.gravity)
    if np.any(mounting.joint_zero_rad):
        raise GalenError(f"{table.path}: {tool.tool} holds zeros of joints; a table has none")
    if not np.any(mounting.base_inclination_rad):
        return tool.predict_under(table.gravity)
    if table.rotation is None:
        raise GalenError(
            f"{table.path}: {tool.tool} holds an inclination of the base, which needs qx..qw,"
            f" r11..r33 or {', '.join(table.arm.turning_names)}"
        )
    return tool.predict_under(mounting.turned_gravity(table.gravity, table.rotation))


def tool_from_table(
    name: str, table: OrientationTable, fit: SingleLoad, mounted: SingleLoad | None = None
) -> CalibrationFile:
    """Make the calibration file of one load and six constants found on `table`.

    Its reading under any gravity is `fit.predict`'s or, where `mounted` is given, whose load then
    holds, `mounted.predict`'s. Gravity is as large as in the table, since the mass was found with
    that. `unresolved` lists what is not identifiable from readings with one load.

    Args:
        name: the tool's name.
        table: the readings that were fitted to.
        fit: load and constants found on them.
        mounted: the same with mounting groups; None: without.

    Returns:
        The calibration, not yet written.

    """
    predicted = fit.predict(table.gravity)
    if mounted is not None:
        fit, predicted = mounted, mounted.predict(table.gravity, table.rotation)
    residuals = (table.wrench - predicted)[fit.used]
    gravity = table.arm.gravity_m_s2
    if table.orientation == "gravity":
        size = np.mean(np.linalg.norm(table.gravity, axis=1))
        gravity = gravity / np.linalg.norm(gravity) * size
    return CalibrationFile(
        tool=name,
        load=fit.load,
        adapter=LoadEstimate(0.0, np.zeros(3), np.zeros((4, 4))),
        tip_m=np.zeros(3),
        rmse=np.sqrt(np.mean(residuals**2, axis=0)),
        poses_used=int(np.sum(fit.used)),
        calibrated_at=datetime.now(UTC).isoformat(timespec="seconds"),
        residual_offset=fit.offset,
        poses_rejected=tuple(
            f"reading {row + 1}: off the common load" for row in np.flatnonzero(~fit.used)
        ),
        zeroing=None,
        gravity_m_s2=gravity,
        unresolved=_UNRESOLVED,
        mounting=None if mounted is None else mounted.mounting,
        arm=table.arm,
    )
