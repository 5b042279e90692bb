"""Effects that are scanned: crosstalk's pairs, drifts of any shape, steps at any time.

What is added to a reading, b(t), changes the rows by the sensor's zero's columns O_k times b_k(t)
(where a hand pushes, the tip's too: what the reading has too much, the hand has not pushed). So
crosstalk, drift and steps need no simulation of their own,

    crosstalk: O_to f_from(t),    drift: O_k phi(t),    step: O_k [t >= t_0],

and of steps at all times t_0 the sums over time bins tell everything.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from galen_model.arm.galen import WRENCH_AXES
from galen_model.arrays import Array
from galen_model.evidence.background import Background, Evidence, evidences
from galen_sim_driver.effects.effect import Effect
from galen_sim_driver.effects.sensor import BiasStep, SensorDrift
from galen_sim_driver.effects.tracker import BaseShift
from galen_sim_driver.replay import Replay

from galen_diagnosis.effects.candidates import Candidate, EffectsAt, crosstalk_candidate, crosstalks
from galen_diagnosis.observation.observation import Observation
from galen_diagnosis.observation.rows import BAGS

_HOUR_S = 3600.0
_KNOT_S = 15.0
_MOST_PIECES = 80
"""Of a drift: bags may lie hours apart, and six columns a piece fill the memory."""
_BUMP = np.array([0.007] * 3 + [2e-4] * 3)
_RATE = np.array([1.0] * 3 + [0.02] * 3)
_STEP = np.array([0.1] * 3 + [3e-3] * 3)
_SHIFT = np.array([1e-3] * 3 + [3e-3] * 3)
_STEP_GRID_S = {"sweep": 0.4, "motion": 0.25, "push": 0.4}
_SHIFT_GRID_S = 0.2
_EDGE_S = 1.0
_TEMPER = 0.5


@dataclass(frozen=True)
class LinearCandidate(Candidate):
    """A candidate whose rows are linear in its numbers: `columns` (N, p) are known."""

    columns: Array

    def jacobian(self, observation: Observation, effects: EffectsAt, values: Array) -> Array:
        """Known beforehand."""
        return self.columns


@dataclass(frozen=True)
class DriftCandidate(LinearCandidate):
    """A drift by rates (6,) and bumps (k, 6) at knots between first and last."""

    knots_s: Array

    def limits(self) -> tuple[Array, Array]:
        """None."""
        return np.full(len(self.start), -np.inf), np.full(len(self.start), np.inf)

    def at(self, values: Array) -> Effect:
        """The drift through its levels."""
        line = np.outer(self.knots_s - self.knots_s[0], values[:6] / _HOUR_S)
        if len(values) > 6:
            line[1:-1] += values[6:].reshape(-1, 6)
        return SensorDrift.through(self.knots_s, line)


@dataclass(frozen=True)
class JumpCandidate(LinearCandidate):
    """A jump at a time; from_s, to_s: within the bag, where it was with 95 %."""

    from_s: float
    to_s: float


def readings_at_rows(observation: Observation) -> Array:
    """The reading (N, 6) at each row's time: predicted where untouched, measured where touched."""
    rows = observation.rows
    out = np.zeros((len(rows), 6))
    for name, view in observation.views.items():
        scene = view.scene
        reading = np.where(scene.touched[:, None], scene.reading, Replay(scene).reading())
        here = rows.bag == BAGS.index(name)
        at_s = rows.bag_s[here]
        out[here] = np.stack([np.interp(at_s, scene.wrench_s, axis) for axis in reading.T], axis=1)
    return out


def crosstalk_candidates(observation: Observation, zero: Array) -> list[LinearCandidate]:
    """All pairs; zero (N, 6): columns of the sensor's zero."""
    reading = readings_at_rows(observation)
    found = []
    for from_axis, to_axis, effect in crosstalks():
        column = zero[:, WRENCH_AXES.index(to_axis)] * reading[:, WRENCH_AXES.index(from_axis)]
        plain = crosstalk_candidate(effect)
        found.append(_linear(plain, column[:, None]))
    return found


def drift_candidates(observation: Observation, zero: Array) -> list[DriftCandidate]:
    """A steady drift, and one of any shape."""
    at_s = observation.rows.session_s
    length = float(at_s.max())
    if length < 2.0 * _KNOT_S:
        return []
    ramp = at_s / _HOUR_S
    steady = zero * ramp[:, None]
    ends = np.array([0.0, length])
    pieces = min(max(round(length / _KNOT_S), 2), _MOST_PIECES)
    knots = np.linspace(0.0, length, pieces + 1)
    bumps = []
    for k in range(1, pieces):
        height = np.interp(at_s, knots[k - 1 : k + 2], [0.0, 1.0, 0.0])
        bumps.append(zero * height[:, None])
    found = []
    for label, columns, times in (
        ("steady", steady, ends),
        ("any shape", np.concatenate([steady, *bumps], axis=1), knots),
    ):
        size = np.concatenate([_RATE, np.tile(_BUMP, len(times) - 2)])
        nothing = np.zeros(columns.shape[1])
        found.append(
            DriftCandidate(
                "sensor_drift",
                label,
                SensorDrift(),
                np.arange(len(nothing)),
                nothing,
                nothing,
                size,
                0.1 * size,
                columns,
                times,
            )
        )
    return found


@dataclass(frozen=True)
class Scan:
    """A jump of six numbers, at each of many times: the evidence of each, and how to make it."""

    effect: str
    times: tuple[tuple[str, float], ...]
    found: tuple[Evidence, ...]

    def best(self) -> int:
        """The likeliest time."""
        return int(np.argmax([one.log_bayes for one in self.found]))

    @property
    def log_bayes(self) -> float:
        """Of a jump at any of these times."""
        logs = np.array([one.log_bayes for one in self.found])
        return float(np.logaddexp.reduce(logs) - np.log(len(logs)))


def scan_steps(
    observation: Observation, zero: Array, rows: Array, behind: Background
) -> Scan | None:
    """A step of the reading at any time of any bag."""
    times = []
    for name, view in observation.views.items():
        last = float(view.scene.wrench_s[-1])
        grid = np.arange(_EDGE_S, last - _EDGE_S, _STEP_GRID_S[name])
        times += [(name, float(t)) for t in grid]
    return _scan(observation, "bias_step", zero, rows, behind, times, _STEP)


def scan_shifts(
    observation: Observation, marker: Array, rows: Array, behind: Background
) -> Scan | None:
    """A move of the base's marker at any time of push."""
    view = observation.views.get("push")
    if view is None or not view.tracks:
        return None
    grid = np.arange(_EDGE_S, float(view.scene.tracker_s[-1]) - _EDGE_S, _SHIFT_GRID_S)
    times = [("push", float(t)) for t in grid]
    return _scan(observation, "base_shift", marker, rows, behind, times, _SHIFT)


def _scan(
    observation: Observation,
    effect: str,
    columns: Array,
    rows: Array,
    behind: Background,
    times: list[tuple[str, float]],
    typical: Array,
) -> Scan | None:
    """Evidence of columns (N, 6) switched on at each time; None where there is none to try."""
    if not times:
        return None
    # Bags may not have been recorded in their usual order.
    times = sorted(times, key=lambda time: float(_session_times(observation, [time])[0]))
    after = _session_times(observation, times)
    bins = np.searchsorted(after, observation.rows.session_s, side="right")
    count = len(after) + 1
    order = np.argsort(bins, kind="stable")
    edges = np.searchsorted(bins[order], np.arange(count + 1))
    width = columns.shape[1]
    grams = np.zeros((count, width, width))
    cross = np.zeros((count, behind.columns.shape[1], width))
    along = np.zeros((count, width))
    for number in range(count):
        here = order[edges[number] : edges[number + 1]]
        if len(here):
            part = columns[here]
            grams[number] = part.T @ part
            cross[number] = behind.columns[here].T @ part
            along[number] = part.T @ rows[here]
    # From bins to all rows from a time on.
    grams, cross, along = (np.cumsum(a[::-1], axis=0)[::-1][1:] for a in (grams, cross, along))
    nuisance = behind.columns.T @ rows
    count = len(times)
    back = behind.solve(cross.transpose(1, 0, 2).reshape(cross.shape[1], -1))
    back = back.reshape(cross.shape[1], count, width).transpose(1, 0, 2)
    reduced = grams - np.einsum("mni,mnj->mij", cross, back)
    towards = along - np.einsum("mni,n->mi", back, nuisance)
    found = evidences(0.5 * (reduced + reduced.transpose(0, 2, 1)), towards, typical)
    return Scan(effect, tuple(times), tuple(found))


def jump_candidate(observation: Observation, scan: Scan, columns: Array, index: int) -> Candidate:
    """The scan's jump at one of its times."""
    bag, at_s = scan.times[index]
    after = _session_times(observation, [(bag, at_s)])[0]
    on = (observation.rows.session_s >= after).astype(float)
    base: Effect
    if scan.effect == "bias_step":
        base, typical = BiasStep(bag=bag, time_s=at_s), _STEP
    else:
        base, typical = BaseShift(time_s=at_s), _SHIFT
    nothing = np.zeros(6)
    from_s, to_s = _when(scan, bag)
    return JumpCandidate(
        scan.effect,
        f"{bag} {at_s:.2f} s",
        base,
        np.arange(6),
        nothing,
        nothing,
        typical,
        0.1 * typical,
        columns * on[:, None],
        from_s,
        to_s,
    )


def _when(scan: Scan, bag: str) -> tuple[float, float]:
    """Times of a bag that hold 95 % of a jump's probability there, and a step beside them.

    The evidence is tempered, as all is: noise is white but for what a fit leaves.
    """
    times = np.array([at_s for name, at_s in scan.times if name == bag])
    pairs = zip(scan.found, scan.times, strict=True)
    logs = np.array([found.log_bayes for found, (name, _) in pairs if name == bag])
    weights = np.exp(_TEMPER * (logs - logs.max()))
    order = np.argsort(-weights, kind="stable")
    enough = int(np.searchsorted(np.cumsum(weights[order]) / weights.sum(), 0.95)) + 1
    likely = times[order[:enough]]
    step = float(np.min(np.diff(np.sort(times)), initial=1.0)) if len(times) > 1 else 1.0
    return max(0.0, float(likely.min()) - step), float(likely.max()) + step


def _session_times(observation: Observation, times: list[tuple[str, float]]) -> Array:
    bags = observation.views
    return np.array([bags[bag].scene.start_s + at_s for bag, at_s in times])


def _linear(plain: Candidate, columns: Array) -> LinearCandidate:
    values = {name: getattr(plain, name) for name in plain.__dataclass_fields__}
    return LinearCandidate(**values, columns=columns)
