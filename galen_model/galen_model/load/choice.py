# SPDX-License-Identifier: Apache-2.0
"""Choose how a load is identified: by held-out blocks, the simplest model that is not worse.

The candidates, the simplest first; each is fitted to all blocks of poses but one and predicts it:

    plain        constant bias, all poses: what the others must not be worse than
    robust       constant bias, axes weighted by noise, poses off the common load rejected
    unexplained  constant bias, only the poses rejected that no structure explains
    structured   a bias that drifts or steps, gains, a rotation of the sensor (`structure`)

Forces and torques choose on their own, but for the sensor's response, which is one: a force says
nothing but the mass, a torque nothing but the first moment, and they share no parameter.

**Rejecting competes with explaining.** A pose that a drift has moved away, or that a gain or a
rotation of the sensor sets off, is no outlier. Candidates are therefore scored on all poses but
those that stand out of a model that explains nearly any structure: readings affine in gravity,
y_k = a_k . g + b_k(t) with 18 free slopes (gains, crosstalk and rotations are in them) and a bias
that walks. Poses that stand out and follow each other in time count as structure. A candidate that
rejects what this model explains has to predict it all the same.

**The choice.** A candidate is safe if the root mean square of its held-out residual is on none of
the three axes above the plain one's. Of the safe ones the first is taken whose mean over the axes'
log residuals lies within `MARGIN` of the smallest. With fewer poses than are needed to call one an
outlier nothing can be compared, and the fit is the plain one. A calibration rejects the poses off
the common load where they are a tenth at most and no run of them, or no structure is found, unless
a structure is as good: that one is clearly better by its density already.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from galen_model.arm.arm import Arm
from galen_model.arm.galen import WRENCH_AXES
from galen_model.arrays import Array
from galen_model.errors import IdentificationError, NotExcitedError
from galen_model.estimation.curves import CONSTANT, BiasShape, Shape
from galen_model.estimation.held_out import FEWEST_BLOCKS, held_out, time_blocks
from galen_model.estimation.problem import MIN_POSES_TO_REJECT, Fit
from galen_model.load.identification import (
    MIN_POSES,
    Identification,
    SingleLoad,
    SweepBiasDrift,
    check_loads,
    check_one_sweep,
    check_rejections,
    check_two_sweeps,
    identification,
    load_estimate,
    zeroing_fault,
)
from galen_model.load.model import LoadEstimate
from galen_model.load.mounting import Mounting
from galen_model.load.pose_order import drift_warning
from galen_model.load.readings import LoadReadings, StillPoses
from galen_model.load.structure import (
    BLOCKS,
    FLEXIBLE,
    KINDS,
    RESPONSES,
    LoadStructure,
    choose_structure,
    linear,
)

MARGIN = 0.2
"""Mean log residual by which one constant bias may be above another and count as equal.

On eight blocks of some 40 poses less is often chance. Chosen on 300 simulated sets: at 0.02 16 %
of them had an axis more than 5 % above the plain fit on unseen poses, at 0.2 6 %, and the mean
residual was the same within 2 %.
"""

PLAIN, ROBUST, UNEXPLAINED, STRUCTURED = "plain", "robust", "unexplained", "structured"
"""The candidates' names."""

_WORDS = {
    PLAIN: "constant bias",
    ROBUST: "constant bias, poses off the common load rejected",
    UNEXPLAINED: "constant bias, only poses rejected that no drift, gain or rotation explains",
}
_SHORT = {
    ROBUST: "poses off the common load rejected",
    UNEXPLAINED: "unexplained poses rejected",
    STRUCTURED: "drift, gains or rotation",
}
MOST_COM_STD_M = 0.02
"""Standard deviation of a centre beyond which it counts as unknown."""
_COMMON_GAIN = (
    "the common gain of the forces and that of the torques: taken as 1; masses and centres hold "
    "its error, which their standard deviations don't (a known mass tells it: --known-mass-kg)"
)
# Of the values (m, h, bias): what forces and torques determine.
_PARAMETERS = np.array([0, 4, 5, 6]), np.array([1, 2, 3, 7, 8, 9])
_MOST_UNEXPLAINED = 1 / 3  # as many as a calibration may reject
_FEW_REJECTED = 0.1  # a calibration that rejects more has to look for structure first
_LONGEST_RUN = 2  # of poses that stand out by chance; more that follow each other are structure
_STRUCTURE_LIMIT = 1.05
_ALIKE = 0.02  # mean log residual
_NOTHING = 1e-12  # N and N.m, far below any sensor's step
_Progress = Callable[[str], None] | None


@dataclass(frozen=True)
class _Choice:
    """What blocks chose: names of forces' and torques' candidates, masks (n,) of poses by name."""

    names: tuple[str, str]
    masks: dict[str, np.ndarray]
    structure: LoadStructure | None
    reason: str
    scores: dict[str, Array] | None = None
    fault: str = ""

    @property
    def words(self) -> str:
        """The models for a person."""
        if self.structure is None:
            force, torque = (
                _WORDS[PLAIN if self.masks[name].all() else name] for name in self.names
            )
            return force if force == torque else f"forces: {force}; torques: {torque}"
        return str(self.structure)


@dataclass(frozen=True)
class ChosenLoad:
    """A load and its bias, by the models that held-out blocks chose.

    names: the candidates' for forces and torques. single: load, bias at the last reading, noise,
    poses used. words, reason: what was chosen, and how the candidates compare, in one line.
    scores: held-out rmse (6,), N and N.m, by candidate; None where none could be compared. fault:
    what the robust fit misses where nothing but the plain fit is left: a common load. curves: where
    a bias drifts; mounting: where gains or a rotation are chosen.
    """

    names: tuple[str, str]
    single: SingleLoad
    words: str = ""
    reason: str = ""
    scores: dict[str, Array] | None = None
    fault: str = ""
    curves: Fit | None = None
    mounting: Mounting | None = None
    choice: _Choice | None = None

    def predict(
        self, gravity_sensor: ArrayLike, time_s: Array, temperature_c: Array | None = None
    ) -> Array:
        """Predict readings.

        Args:
            gravity_sensor: (n, 3) in the sensor's frame, m/s^2.
            time_s: (n,) on the clock of the identified readings.
            temperature_c: (n,) of the sensor, or None.

        Returns:
            (n, 6), N and N.m, with the bias at those times.

        """
        expected = self.single.predict(gravity_sensor) - self.single.offset
        if self.mounting is not None:
            expected = expected @ self.mounting.reading_from_wrench.T
        expected += self.single.offset
        if self.curves is not None:
            bias = self.curves.bias_at(time_s, np.zeros(len(time_s), dtype=int), temperature_c)
            for name, axes in zip(self.names, KINDS, strict=True):
                if name == STRUCTURED:
                    expected[:, axes] += (bias - self.single.offset)[:, axes]
        return expected


def choose_load(
    gravity_sensor: ArrayLike,
    wrench: ArrayLike,
    time_s: Array | None,
    groups: np.ndarray | None = None,
    temperature_c: Array | None = None,
    *,
    arm: Arm,
) -> ChosenLoad:
    """Identify mass, centre and bias by the models that held-out blocks prefer.

    Args:
        gravity_sensor: (n, 3) in the sensor's frame, m/s^2.
        wrench: (n, 6) averaged readings of still poses, N and N.m.
        time_s: (n,) when each was taken, s, or their order; None: no drift is tried.
        groups: (n,) blocks to hold out; None: runs of neighbours in time.
        temperature_c: (n,) of the sensor, deg C, or None.
        arm: whose sensor it is.

    Returns:
        The load, with what was chosen and why.

    Raises:
        IdentificationError: as `identification.identify_single_load` does.

    """
    readings = replace(
        LoadReadings.of_orientations(gravity_sensor, wrench, arm=arm),
        time_s=time_s,
        temperature_c=temperature_c,
    )
    if len(readings) < MIN_POSES:
        raise IdentificationError(f"{len(readings)} still poses; at least {MIN_POSES} are needed")
    return _fitted_load(readings, _choose(readings, groups))


def refit(
    chosen: ChosenLoad,
    gravity_sensor: Array,
    wrench: Array,
    time_s: Array,
    rows: np.ndarray,
    temperature_c: Array | None = None,
    *,
    arm: Arm,
) -> SingleLoad:
    """Fit the chosen model to some of the readings, without another choice.

    Args:
        chosen: what `choose_load` returned for all n readings.
        gravity_sensor: (n, 3) in the sensor's frame, m/s^2.
        wrench: (n, 6), N and N.m.
        time_s: (n,).
        rows: mask (n,) of the readings to fit.
        temperature_c: (n,) of the sensor, deg C, or None.
        arm: whose sensor it is.

    Returns:
        The load; `used` is the mask of the fitted rows alone.

    Raises:
        IdentificationError: as `identification.identify_single_load` does.

    """
    assert chosen.choice is not None
    readings = replace(
        LoadReadings.of_orientations(gravity_sensor[rows], wrench[rows], arm=arm),
        time_s=time_s[rows],
        temperature_c=None if temperature_c is None else temperature_c[rows],
    )
    masks = {name: mask[rows] for name, mask in chosen.choice.masks.items()}
    return _fitted_load(readings, replace(chosen.choice, masks=masks)).single


def choose_calibration(
    bare: StillPoses | None,
    tool: StillPoses,
    zero_angles: ArrayLike | None = None,
    progress: _Progress = None,
    zeroed: bool | None = None,
) -> Identification:
    """Identify tool and adapter by the model that held-out blocks prefer.

    Without times nothing that needs them is tried.

    Args:
        bare: the sweep without the tool, or None.
        tool: the sweep with it.
        zero_angles: (k,) where the sensor was zeroed, rad; None: the arm's home.
        progress: called with a text on what is compared; what it raises comes through. None: not
            called.
        zeroed: of one sweep, whether the sensor was zeroed there with the adapter alone; if not,
            tool and adapter are one load. None: the readings decide (`zeroing_fault`).

    Returns:
        Loads and offsets, with what was chosen and why.

    Raises:
        NotExcitedError: naming what the poses don't identify.
        IdentificationError: for a mass that is not positive, too few poses or too many that fit no
            load.

    """
    apart, why = True, ""
    if bare is None:
        measured = check_one_sweep(tool)
        if zeroed is None:
            why = zeroing_fault(tool, tool.arm.gravity_in_sensor(zero_angles))
        apart = not why if zeroed is None else zeroed
        final = LoadReadings.of_one_sweep(tool, zero_angles) if apart else measured
    else:
        measured = final = check_two_sweeps(bare, tool, zero_angles)
    choice = _choose(measured, None, equal=False, progress=progress)
    if measured.time_s is None:
        choice = replace(choice, reason=f"the poses have no times; {choice.reason}")
    used = choice.masks[choice.names[0]] & choice.masks[choice.names[1]]
    structure = choice.structure
    fit, mounting = _fitted(final, choice, used)
    check_rejections(fit)
    check_loads(measured, fit.used)
    groups = () if structure is None else structure.groups
    drifts = structure is not None and structure.drifts
    found = identification(
        fit,
        mounting if groups else None,
        tool,
        bare,
        gravity_zero=final.zero.gravity(mounting)[0][0] if bare is None and apart else None,
        drifts=drifts,
    )
    if structure is not None and bare is not None:
        _check_known(found.load, fit, "the tool")
        _check_known(found.adapter, fit, "the adapter")
    if "gain_ratio" in groups:
        found = replace(
            found,
            unresolved=(*found.unresolved, _COMMON_GAIN),
            warnings=(*found.warnings, _COMMON_GAIN),
        )
    if drifts:
        count = len(measured) - len(tool)
        of_bare = None if bare is None else fit.bias[:count]
        found = _with_drift(found, SweepBiasDrift(fit.shapes, of_bare, fit.bias[count:]))
    return _with_choice(_with_zeroing(found, why), choice, bare, tool)


def _with_zeroing(found: Identification, why: str) -> Identification:
    """Add a warning where tool and adapter are one load: why, and what belongs to the file then."""
    if found.zeroed:
        return found
    text = (
        "tool and adapter are one load, and the file holds the sensor's offset, as the sensor was"
        " not zeroed with the adapter alone"
        + (f" ({why})" if why else "")
        + "; tare after each restart or zeroing of the sensor"
    )
    return replace(found, warnings=(*found.warnings, text))


def _with_choice(
    found: Identification, choice: _Choice, bare: StillPoses | None, tool: StillPoses
) -> Identification:
    """Add what was chosen, and a warning where the order of a sweep's poses hides a drift.

    Under a constant bias of a straight one, which such an order makes look like load.
    """
    shapes = [BiasShape(Shape.LINEAR)] * 6
    if found.bias_drift is not None:
        # What goes with the temperature has no order.
        shapes = [BiasShape(one.shape, one.roughness) for one in found.bias_drift.shapes]
    sweeps: dict[str, list[str]] = {}
    for name, sweep in (("without", bare), ("with", tool)):
        if sweep is not None and sweep.time_s is not None:
            price = drift_warning(sweep.gravity, sweep.time_s, shapes)
            sweeps.setdefault(price, []).append(f"sweep {name} the tool")
    orders = [f"{' and '.join(names)}: {price}" for price, names in sweeps.items() if price]
    return replace(
        found, model=choice.words, reason=choice.reason, warnings=(*found.warnings, *orders)
    )


def _fitted(readings: LoadReadings, choice: _Choice, used: np.ndarray) -> tuple[Fit, Mounting]:
    """Fit the structure chosen, or a constant bias, to the readings `used` (n,)."""
    structure = choice.structure
    if structure is None:
        return readings.of_loads.fit(used), Mounting.of(readings.zero.arm)
    near = linear(readings, structure.groups, used, structure.response)
    fit = near.problem.under(structure.shapes).fit(used)
    return fit, near.model.mounting(fit.values, structure.groups, fit.covariance)


def _choose(
    readings: LoadReadings,
    groups: np.ndarray | None,
    *,
    equal: bool = True,
    progress: _Progress = None,
) -> _Choice:
    """Compare the candidates on blocks `groups` (n,); equal: a kind's axes weigh alike in plain."""
    every = np.ones(len(readings), dtype=bool)
    masks = {PLAIN: every, ROBUST: every, UNEXPLAINED: every}
    if len(readings) < MIN_POSES_TO_REJECT:
        reason = f"{len(readings)} poses are too few to compare models"
        return _Choice((PLAIN, PLAIN), masks, None, reason)
    explained = _explained(readings)
    constant = readings.of_loads
    masks[UNEXPLAINED] = explained
    names, fault = [PLAIN, ROBUST, UNEXPLAINED], ""
    try:
        fit = constant.robust()
        check_rejections(fit)
        masks[ROBUST] = fit.used
    except IdentificationError as error:
        names.remove(ROBUST)
        fault = str(error)
    if explained.all():
        names.remove(UNEXPLAINED)  # the same as the plain one
    if groups is None:
        groups = time_blocks(readings.order_s, readings.segment, BLOCKS)
    groups = _spared(readings, np.unique(groups, return_inverse=True)[1], explained)
    blocks = len(np.unique(groups[groups >= 0]))
    if blocks < FEWEST_BLOCKS:
        reason = f"{blocks} blocks can be held out, too few to compare models"
        return _Choice((PLAIN, PLAIN), masks, None, reason, fault=fault)
    residuals = {
        name: held_out(constant, masks[name], groups, equal=equal and name != ROBUST)[0]
        for name in names
    }
    scored = explained & (groups >= 0)
    few = np.mean(~masks[ROBUST]) <= _FEW_REJECTED and not _runs(readings, masks[ROBUST])
    # where the response costs one kind what it gives the other, it is something else
    for responses in (RESPONSES, RESPONSES[:1]):
        structure = choose_structure(
            readings, explained, groups, responses, progress, by_axis=not equal
        )
        is_found = bool(structure.groups) or structure.drifts
        trusted = PLAIN if equal or ROBUST not in names or (is_found and not few) else ROBUST
        if is_found:
            residuals[STRUCTURED] = structure.held_out
            masks[STRUCTURED] = _agreeing(structure, explained)
        scores = {
            name: np.sqrt(np.mean(part[scored] ** 2, axis=0)) for name, part in residuals.items()
        }
        force, torque = (_best(scores, axes, trusted, equal) for axes in KINDS)
        if not structure.groups or force == torque == STRUCTURED:
            break
        residuals.pop(STRUCTURED)
    reason = _reason(scores, blocks)
    if structure.alike and STRUCTURED in (force, torque):
        reason += "; a rotation of the sensor explains the poses as well"
    if (force, torque) != (PLAIN, PLAIN):
        fault = ""
    chosen = None
    if STRUCTURED in (force, torque):
        kinds = np.repeat([force == STRUCTURED, torque == STRUCTURED], 3)
        shapes = zip(structure.shapes, kinds, strict=True)
        chosen = replace(structure, shapes=tuple(s if kind else CONSTANT for s, kind in shapes))
    return _Choice((force, torque), masks, chosen, reason, scores, fault)


def _spared(readings: LoadReadings, groups: np.ndarray, explained: np.ndarray) -> np.ndarray:
    """Labels (n,) of the blocks without which the poses still tell the loads; -1 for others."""
    result = np.full(len(groups), -1)
    for label in np.unique(groups[explained]):
        try:
            check_loads(readings, groups != label)
        except IdentificationError:
            continue
        result[groups == label] = label
    return result


def _explained(readings: LoadReadings) -> np.ndarray:
    """Mask (n,) of the poses that readings affine in gravity and a bias drift explain."""
    every = np.ones(len(readings), dtype=bool)
    try:
        used = readings.affine().under((FLEXIBLE,) * 6).agreeing()
    except IdentificationError:
        return every
    for run in _runs(readings, used):
        used[run] = True
    return used if np.mean(~used) <= _MOST_UNEXPLAINED else every


def _runs(readings: LoadReadings, used: np.ndarray) -> list[np.ndarray]:
    """Return the poses not used (n,) that follow each other beyond chance, run by run."""
    order = np.lexsort((readings.order_s, readings.segment))
    runs = np.split(order, np.flatnonzero(np.diff(used[order])) + 1)
    return [run for run in runs if len(run) > _LONGEST_RUN and not used[run[0]]]


def _agreeing(structure: LoadStructure, explained: np.ndarray) -> np.ndarray:
    """Mask (n,) of the poses that the structure explains."""
    try:
        used = structure.linear.problem.under(structure.shapes).agreeing()
    except IdentificationError:
        return explained
    return used if np.mean(~used) <= _MOST_UNEXPLAINED else explained


def _best(scores: dict[str, Array], axes: slice, trusted: str, equal: bool) -> str:
    """Return the first that is safe beside the one trusted, and within the margin of the best.

    A calibration trusts rejection where few poses are rejected or no structure is found; then
    nothing that rejects none competes.
    A calibration's structure is clearly better by its density already: it may be 5 % worse on an
    axis, and needs no margin: a step inside a held-out block is missed there by any model.
    """
    names = [PLAIN, ROBUST, UNEXPLAINED, STRUCTURED]
    if trusted == ROBUST:
        names = [ROBUST, STRUCTURED]
    over = {name: _ratio(scores[name], scores[trusted])[axes] for name in names if name in scores}
    mean = {
        name: float(np.mean(np.log(one)))
        for name, one in over.items()
        if one.max() <= (1.0 if equal or name != STRUCTURED else _STRUCTURE_LIMIT)
    }
    best = min(mean.values(), default=0.0)
    if not equal and mean.get(STRUCTURED, np.inf) <= best + _ALIKE:
        return STRUCTURED
    return next((name for name, value in mean.items() if value <= best + MARGIN), trusted)


def _ratio(score: Array, other: Array) -> Array:
    """Divide residuals (6,); those of a channel that every model predicts exactly are equal."""
    return np.asarray((score + _NOTHING) / (other + _NOTHING))


def _reason(scores: dict[str, Array], blocks: int) -> str:
    """Say how the candidates did beside the plain one: mean over the axes, and the worst axis."""
    parts = []
    for name, score in scores.items():
        if name != PLAIN and np.all(np.isfinite(score)):
            ratio = _ratio(score, scores[PLAIN])
            worst = int(np.argmax(ratio))
            mean = np.exp(np.mean(np.log(ratio)))
            parts.append(
                f"{_SHORT[name]} {mean:.2f} (worst {WRENCH_AXES[worst]} {ratio[worst]:.2f})"
            )
    if STRUCTURED not in scores:
        parts.append("no drift, gain or rotation is clear")
    compared = "; ".join(parts)
    return f"residual on {blocks} held-out blocks relative to plain least squares: {compared}"


def _fitted_load(readings: LoadReadings, choice: _Choice) -> ChosenLoad:
    """Fit the candidates chosen of one load; raises IdentificationError."""
    curves, mounting, fits = None, None, {}
    for name in set(choice.names):
        used = choice.masks[name]
        if name == STRUCTURED:
            fits[name], turned = _fitted(readings, choice, used)
            curves = fits[name]
            if choice.structure is not None and choice.structure.groups:
                mounting = turned
        elif name == ROBUST:
            fits[name] = readings.of_loads.robust()
        else:
            fits[name] = readings.of_loads.fit(used, equal=True)
        check_rejections(fits[name])
    single = _joined(fits[choice.names[0]], fits[choice.names[1]])
    check_loads(readings, single.used)
    if curves is not None:
        _check_known(single.load, curves, "the load")
    return ChosenLoad(
        choice.names, single, choice.words, choice.reason, choice.scores, choice.fault, curves,
        mounting, choice,
    )  # fmt: skip


def _joined(force: Fit, torque: Fit) -> SingleLoad:
    """Take mass and force bias from one fit, first moment and torque bias from the other."""
    values, covariance = np.zeros(10), np.zeros((10, 10))
    sigma = force.sigma.copy()
    for fit, rows, axes in zip((force, torque), _PARAMETERS, KINDS, strict=True):
        # loads, response, offsets
        places = np.concatenate([np.arange(4), np.arange(len(fit.values))[-6:]])
        values[rows] = fit.values[places[rows]]
        covariance[np.ix_(rows, rows)] = fit.covariance[np.ix_(places[rows], places[rows])]
        sigma[axes] = fit.sigma[axes]
    if force is torque:
        covariance = force.covariance[np.ix_(places, places)]
    load = load_estimate(values, covariance, "the load")
    return SingleLoad(load, values[4:], sigma, force.used & torque.used)


def _check_known(load: LoadEstimate, found: Fit, name: str) -> None:
    """Raise NotExcitedError where drift and load look so alike that the centre is not known."""
    worst = float(load.com_std_m.max())
    if worst > MOST_COM_STD_M:
        raise NotExcitedError(
            f"a drifting bias and {name} look alike in the order in which the poses were visited: "
            f"the standard deviation of its centre would be {worst * 1e3:.0f} mm, and the mass's "
            f"{found.growth[0]:.0f} times that under a constant bias; visit them in another order"
        )


def _with_drift(found: Identification, bias_drift: SweepBiasDrift) -> Identification:
    """Add what the bias did."""
    parts = [part for part in (bias_drift.bare, bias_drift.tool) if part is not None]
    span = np.max([np.ptp(part, axis=0) for part in parts], axis=0)
    force, torque = int(np.argmax(span[:3])), 3 + int(np.argmax(span[3:]))
    text = (
        f"the sensor's bias drifted, by up to {span[force]:.3f} N ({WRENCH_AXES[force]}) and "
        f"{span[torque] * 1e3:.2f} mN.m ({WRENCH_AXES[torque]}) over a sweep; the offset written "
        "is that at the end"
    )
    return replace(found, bias_drift=bias_drift, warnings=(text, *found.warnings))
