"""One joint's two angles and torque as blocks of rows, and what could be in its lag.

The lag is the motor's angle less the link's. Nominal is a rigid gear: a constant, the encoders'
zeros. Beside that, with T the torque, q the motor's angle and v its velocity:

    joint_compliance        c T, k = 1 / c
    backlash                what plays of the motion leave, q - play_r(q); gap 2 sum u r
    deflection_hysteresis   the part of plays of the torque beside a spring, play_r(T) - beta T; or
                            a term by the direction of motion (dry friction before the spring)
    wrench_delay            c dT/dt delay, c of a plain fit: the torque's stamps are late
    encoder_delay           v delay: the link's stamps are late against the motor's
    gear_error              gain q

Plays, velocity and direction are `galen_model.transmission`'. The last two names are not
the contract's: an arm without encoders at both ends has neither. `residual_fraction` is the loop's
half width over half the range of the lag, since a joint's run has no zero load after the largest.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np
from galen_model.arrays import Array
from galen_model.evidence.held_out import BlockRows, Columns, Effects
from galen_model.play import PlayOperators
from galen_model.transmission import TERMS, TORQUE_PLAYS, JointRun, Parts, Scales, design, noise_of

_MOST_ROWS = 700
_SEVERAL = (0, 2, 4, 6)
_GAPS = np.geomspace(0.08, 2.2, 14)
"""Thresholds of plays of the motion over half of the lag's range."""
_DELAY_S = 0.005
_GEAR = 0.02
_APART_S = 1e4
_VELOCITY_WINDOW_S = 0.1
_SOFTEST = 1e-6
"""Where an interval's end would be less than rigid."""


def prepare_joint(
    runs: Sequence[JointRun], parts: Parts
) -> tuple[BlockRows, Effects, tuple[str, ...]]:
    """Return rows and effects of a joint's runs, and notes; a part is a block."""
    every = [np.ones(len(run), dtype=bool) for run in runs]
    scales = Scales.of(runs, every, _VELOCITY_WINDOW_S)
    gaps = scales.lag_half_range * _GAPS
    terms = np.concatenate([design(run, scales) for run in runs])
    lost = np.concatenate([_lost(run, gaps) for run in runs])
    lag = np.concatenate([run.lag for run in runs])
    torque_rate = np.concatenate([np.gradient(run.torque, run.time_s) for run in runs])
    at_s = np.concatenate([run.time_s + k * _APART_S for k, run in enumerate(runs)])
    label = np.concatenate(parts.label)
    window, size = _windows(runs, label)
    count = np.bincount(window)

    def mean(values: Array) -> Array:
        sums = np.zeros((len(count), *values.shape[1:]))
        np.add.at(sums, window, values)
        return sums / count.reshape(-1, *[1] * (values.ndim - 1))

    noise = noise_of(list(runs))
    floor = float(np.hypot(noise.quantisation, noise.jitter / np.sqrt(size)))
    wide = 100.0 * scales.lag_half_range
    residual = mean(lag)[:, None]
    step_s = size * runs[0].step_s
    span_s = sum(float(run.time_s[-1] - run.time_s[0]) for run in runs) / len(parts.names)
    rows = BlockRows(
        channels=("lag",),
        units=("rad",),
        residual=residual - residual.mean(),
        floor=np.array([max(floor, 1e-9 * scales.lag_half_range)]),
        at_s=mean(at_s),
        block=np.round(mean(label.astype(float))).astype(int),
        labels=parts.names,
        memories_s=(2.0 * step_s, max(span_s / 10.0, 4.0 * step_s), span_s),
    )
    constant = Columns(wide * np.ones((len(residual), 1, 1)), {})
    notes = (
        f"{len(residual)} means over {size} readings of {len(runs)} runs",
        "floor: encoders' steps and the lag's jitter",
    )
    of = {
        **_effects(mean(terms), mean(torque_rate), residual, scales),
        "backlash": _backlash(mean(lost), gaps),
    }
    cannot: tuple[str, ...] = ()
    if "wrench_delay" not in of:
        cannot = ("wrench_delay: the lag doesn't grow with the torque, so when it does is open",)
    return rows, Effects(constant, of, cannot), notes


def _windows(runs: Sequence[JointRun], label: np.ndarray) -> tuple[np.ndarray, int]:
    """Of each reading its window, which stays within a run and a part; readings in one."""
    total = sum(len(run) for run in runs)
    size = max(1, -(-total // _MOST_ROWS))
    run_of = np.concatenate([np.full(len(run), k) for k, run in enumerate(runs)])
    place = np.concatenate([np.arange(len(run)) for run in runs])
    edges = [0, *(np.flatnonzero((np.diff(run_of) != 0) | (np.diff(label) != 0)) + 1), total]
    window = np.zeros(total, dtype=int)
    first = 0
    for start, end in pairwise(edges):
        window[start:end] = first + (place[start:end] - place[start]) // size
        first = window[end - 1] + 1
    return window, size


def _effects(
    terms: Array, torque_rate: Array, lag: Array, scales: Scales
) -> dict[str, Sequence[Columns]]:
    column = {name: terms[:, k] for k, name in enumerate(TERMS)}
    half_lag = scales.lag_half_range
    soft = half_lag / scales.torque_half_range

    def stiffness(w: Array) -> Array:
        return np.asarray(1.0 / (soft * max(w[0], _SOFTEST)))

    of: dict[str, Sequence[Columns]] = {
        "joint_compliance": [_one(soft * column["spring"], {"k": stiffness}, _positive)],
        "deflection_hysteresis": _hysteresis(column, scales, soft),
        "encoder_delay": [_one(_DELAY_S * column["delay"], {"delay_s": lambda w: _DELAY_S * w[0]})],
        "gear_error": [_one(_GEAR * column["gear"], {"gain": lambda w: _GEAR * w[0]})],
    }
    plain = np.column_stack([column[name] for name in ("offset", "gear", "delay", "spring")])
    give = float(np.linalg.lstsq(plain, lag[:, 0], rcond=None)[0][3])
    if give > 0.0:
        slope = _DELAY_S * give * torque_rate
        of["wrench_delay"] = [_one(slope, {"delay_s": lambda w: _DELAY_S * w[0]})]
    return of


def _positive(weights: Array) -> bool:
    return bool(weights[0] > 0.0)


def _one(
    values: Array,
    parameters: dict[str, Callable[[Array], Array]],
    allowed: Callable[[Array], bool] = lambda weights: True,
) -> Columns:
    return Columns(values[:, None, None], parameters, allowed=allowed)


def _lost(run: JointRun, thresholds: Array) -> Array:
    """Return what each play of the motion leaves behind (n, p), rad; from amid the gap."""
    motion = np.repeat((run.motor - run.motor[0])[:, None], len(thresholds), axis=1)
    return np.asarray(motion - PlayOperators(thresholds).run(motion).output)


def _backlash(lost: Array, thresholds: Array) -> list[Columns]:
    """One gap, between two neighbouring thresholds, or several that close bit by bit."""
    ways = []
    pairs = [(k, k + 1) for k in range(len(thresholds) - 1)]
    for chosen in (*pairs, tuple(range(0, len(thresholds), 4))):
        some = thresholds[list(chosen)]

        def gap(w: Array, some: Array = some) -> Array:
            return np.asarray(2.0 * w @ some)

        ways.append(
            Columns(
                lost[:, None, list(chosen)],
                {"gap_rad": gap},
                allowed=lambda w, gap=gap: bool(gap(w) > 0.0),  # type: ignore[misc]
            )
        )
    return ways


def _hysteresis(column: dict[str, Array], scales: Scales, soft: float) -> list[Columns]:
    ways = [
        _one(
            scales.lag_half_range * column["direction"],
            {"residual_fraction": lambda w: w[0]},
            _positive,
        )
    ]
    spring = column["spring"]
    for chosen in (*((k,) for k in range(len(TORQUE_PLAYS))), _SEVERAL):
        plays = np.stack([column[TORQUE_PLAYS[k]] for k in chosen], axis=1)
        loops = soft * (plays - np.outer(spring, spring @ plays / (spring @ spring)))
        left = np.minimum(
            scales.torque_thresholds[list(chosen)],
            scales.torque_half_range - scales.torque_thresholds[list(chosen)],
        )

        def fraction(w: Array, left: Array = left) -> Array:
            return np.asarray(soft * (w @ left) / scales.lag_half_range)

        ways.append(
            Columns(
                loops[:, None, :],
                {"residual_fraction": fraction},
                allowed=lambda w, fraction=fraction: bool(fraction(w) > 0.0),  # type: ignore[misc]
            )
        )
    return ways
