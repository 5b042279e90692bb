"""How a joint gives, from a form fitted to all of its readings, with uncertainty."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from galen_model.arrays import Array
from galen_model.transmission.terms import MOTION_PLAYS, TERMS, TORQUE_PLAYS, Scales, design

from galen_deflection.transmission.comparison import Comparison
from galen_deflection.transmission.joint_fit import FORMS, CellSums, bootstrap, choose, fit_terms
from galen_deflection.transmission.joint_fit import ours as chosen_form

UNITS = {
    "compliance_first": "rad/(N.m)",
    "compliance": "rad/(N.m)",
    "direction": "rad",
    "torque_loop": "rad",
    "lost_motion": "rad",
    "gear_error": "1",
    "delay": "s",
    "offset": "rad",
}
_BOUNDED = ("compliance_first", "compliance", "torque_loop", "lost_motion")
MEANINGS = {
    "compliance_first": "give just after the torque turns back",
    "compliance": "give once everything slides",
    "direction": "lag + or - this, by the motor's direction",
    "torque_loop": "widest loop at one torque",
    "lost_motion": "lost when the motor turns back",
    "gear_error": "lag that grows with the motor's angle",
    "delay": "lag that grows with the motor's velocity",
    "offset": "lag amid the motor's range, without torque",
}


class Estimate(NamedTuple):
    """A value with its standard deviation and 95 % interval.

    Of the bootstrap; made larger by what the form's next best grid of thresholds says otherwise,
    since a form is never the law itself.
    """

    value: float
    std: float
    interval: tuple[float, float]


class JointParameters(NamedTuple):
    """What a form says, by the names of UNITS.

    plain: compliance, direction's part and delay of a least squares fit without bounds, for which
    a negative compliance is no error.
    """

    form: str
    estimates: dict[str, Estimate]
    plain: dict[str, Estimate]

    @property
    def stiffness(self) -> Estimate | None:
        """Once everything slides, N.m/rad; None if the lag does not tell it from a rigid joint."""
        found = self.estimates["compliance"]
        if found.interval[0] <= 0.0:
            return None
        value = 1.0 / found.value
        return Estimate(
            value, found.std * value**2, (1.0 / found.interval[1], 1.0 / found.interval[0])
        )


def estimate(comparison: Comparison, form: str | None = None) -> JointParameters:
    """Fit a form, or the one that hold-outs choose among all parts, to all readings."""
    runs, parts, settings = comparison.runs, comparison.parts, comparison.settings
    every = list(range(len(parts.names)))
    used = parts.rows(every)
    scales = Scales.of(runs, used, settings.window_s, settings.standstill_rad_s)
    sums = CellSums.of(runs, parts, [design(run, scales) for run in runs])
    wanted = [one for one in FORMS if form is None or one.name == form]
    chosen = [choose(one, sums, every, settings.common) for one in wanted]
    best = chosen_form(chosen) if form is None else chosen[0]
    plain = ("offset", *settings.common, "spring", "direction")
    return JointParameters(
        best.form.name,
        _estimates(sums, scales, best.terms, settings.seed, True, best.next_best),
        {
            name: found
            for name, found in _estimates(sums, scales, plain, settings.seed, False).items()
            if name in ("compliance", "direction", *(("delay",) * ("delay" in plain)))
        },
    )


def _estimates(
    sums: CellSums,
    scales: Scales,
    terms: tuple[str, ...],
    seed: int,
    bounded: bool,
    otherwise: tuple[str, ...] | None = None,
) -> dict[str, Estimate]:
    every = np.arange(len(sums.count))
    values = _derived(fit_terms(sums, every, terms, bounded)[None], scales)
    others = _derived(fit_terms(sums, every, otherwise or terms, bounded)[None], scales)
    drawn = _derived(bootstrap(sums, terms, seed, bounded), scales)
    found = {}
    for name in UNITS:
        low, high = np.quantile(drawn[name], [0.025, 0.975])
        value = float(values[name][0])
        apart = abs(float(others[name][0]) - value)
        std = float(np.hypot(np.std(drawn[name], ddof=1), apart))
        # each side of the interval grows by two of these standard deviations, as squares add up
        below, above = (
            np.hypot(max(side, 0.0), 2.0 * apart) for side in (value - low, high - value)
        )
        least = 0.0 if bounded and name in _BOUNDED else -np.inf
        bounds = max(value - float(below), least), value + float(above)
        found[name] = Estimate(value, std, bounds)
    return found


def _derived(weights: Array, scales: Scales) -> dict[str, Array]:
    """From weights (k, len(TERMS))."""
    column = {name: weights[:, TERMS.index(name)] for name in TERMS}
    torque = np.stack([column[name] for name in TORQUE_PLAYS], axis=1)
    motion = np.stack([column[name] for name in MOTION_PLAYS], axis=1)
    return {
        "compliance_first": column["spring"],
        "compliance": column["spring"] + torque.sum(axis=1),
        "direction": column["direction"],
        "torque_loop": 2.0 * torque @ scales.torque_thresholds,
        "lost_motion": 2.0 * motion @ scales.motion_thresholds,
        "gear_error": column["gear"],
        "delay": column["delay"],
        "offset": column["offset"],
    }


def to_json(parameters: JointParameters) -> dict[str, Any]:
    """Plain numbers, SI units."""

    def row(found: Estimate, unit: str) -> dict[str, Any]:
        return {
            "value": found.value, "std": found.std, "ci95": list(found.interval), "unit": unit
        }  # fmt: skip

    def rows(estimates: Mapping[str, Estimate]) -> dict[str, Any]:
        return {name: row(found, UNITS[name]) for name, found in estimates.items()}

    stiffness = parameters.stiffness
    return {
        "form": parameters.form,
        "stiffness": None if stiffness is None else row(stiffness, "N.m/rad"),
        "estimates": rows(parameters.estimates),
        "plain_least_squares": rows(parameters.plain),
    }
