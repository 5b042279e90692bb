"""Effects that are scanned: crosstalk's pairs, drifts of any shape, steps at any time, limits.

What is added to a reading, b(t), changes the rows by the sensor's zero's columns O_k times b_k(t)
(where the tool is pushed, the tip's too: the excess of the reading wasn't applied). So crosstalk,
drift and steps need no simulation of their own,

    crosstalk: O_to f_from(t),    drift: O_k phi(t),    step: O_k [t >= t_0],

and of steps at all times t_0 the sums over time bins suffice.

A clipped axis shows as a pile of readings at its limit, of one size to the last bit where the noise
is clipped as well. What it should have read is predicted where the tool isn't touched. During a
push the load beyond the limit is not in the reading but in the deflection: an unknown input, which
each clipped push has in the form

    a_1 sin(pi u) + a_2 sin(3 pi u),   u from 0 to 1 over the time at the limit.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from galen_model.arm.galen import WRENCH_AXES
from galen_model.arrays import Array
from galen_model.estimation.evidence import Background, Evidence, evidences
from galen_sim_driver.effects.effect import Effect
from galen_sim_driver.effects.sensor import BaseShift, BiasStep, SensorDrift, SensorSaturation
from galen_sim_driver.replay import Replay

from galen_diagnosis.effects.candidates import Candidate, crosstalk_candidate, crosstalks
from galen_diagnosis.effects.general_shapes import SoftSaturation
from galen_diagnosis.observation.observation import Observation
from galen_diagnosis.observation.rows import BAGS

_HOUR_S = 3600.0
_KNOT_S = 20.0
_MOST_PIECES = 80
"""Of a drift: bags may lie hours apart, and six columns a piece fill the memory."""
_BUMP = np.array([0.007] * 3 + [2e-4] * 3)
_BENDS, _BEND = 2, 3.0
"""Of a smooth drift: half waves over the recording, and their usual size over that of a bump."""
_RATE = np.array([1.0] * 3 + [0.02] * 3)
_STEP = np.array([0.1] * 3 + [3e-3] * 3)
_SHIFT = np.array([1e-3] * 3 + [3e-3] * 3)
_STEP_GRID_S = {"sweep": 0.4, "motion": 0.25, "push": 0.4}
_SHIFT_GRID_S = 0.2
_EDGE_S = 1.0
_TEMPER = 0.5


def crosstalk_candidates(observation: Observation, zero: Array) -> list[Candidate]:
    """Return all pairs; zero (N, 6): columns of the sensor's zero."""
    reading = _readings_at_rows(observation)
    found = []
    for from_axis, to_axis, effect in crosstalks():
        column = zero[:, WRENCH_AXES.index(to_axis)] * reading[:, WRENCH_AXES.index(from_axis)]
        found.append(replace(crosstalk_candidate(effect), columns=column[:, None]))
    return found


def _readings_at_rows(observation: Observation) -> Array:
    """Return the reading (N, 6) at each row's time, where untouched the predicted one."""
    rows = observation.rows
    out = np.zeros((len(rows), 6))
    for name, view in observation.views.items():
        scene = view.scene
        reading = np.where(scene.touched[:, None], scene.reading, Replay(scene).reading())
        here = rows.bag == BAGS.index(name)
        at_s = rows.bag_s[here]
        out[here] = np.stack([np.interp(at_s, scene.wrench_s, axis) for axis in reading.T], axis=1)
    return out


def drift_candidates(observation: Observation, zero: Array) -> list[Candidate]:
    """Return a steady drift, a smooth one, and one of any shape."""
    at_s = observation.rows.session_s
    length = float(at_s.max())
    if length < 2.0 * _KNOT_S:
        return []
    knots = np.linspace(0.0, length, min(max(round(length / _KNOT_S), 2), _MOST_PIECES) + 1)
    line = knots[:, None] / _HOUR_S
    bent = np.sin(np.pi * knots[:, None] / length * np.arange(1, _BENDS + 1))
    hats = np.eye(len(knots))[:, 1:-1]
    found = []
    for label, times, shapes, size in (
        ("steady", knots[[0, -1]], line[[0, -1]], _BUMP),
        ("smooth", knots, np.hstack([line, bent]), _BEND * _BUMP),
        ("any shape", knots, np.hstack([line, hats]), _BUMP),
    ):
        courses = [np.interp(at_s, times, shape) for shape in shapes.T]
        columns = np.concatenate([zero * course[:, None] for course in courses], axis=1)
        typical = np.concatenate([_RATE, np.tile(size, len(courses) - 1)])
        one = _linear("sensor_drift", label, SensorDrift(), columns, typical)
        make = partial(_drift, times, shapes)
        found.append(replace(one, make=make, model=f"drift, {label}"))
    return found


def _drift(knots_s: Array, shapes: Array, values: Array) -> Effect:
    """Return a drift of shapes (k, m) at knots (k,), by their sizes (6 m,) in the axes."""
    return SensorDrift.through(knots_s, shapes @ values.reshape(-1, 6))


def _linear(name: str, label: str, base: Effect, columns: Array, typical: Array) -> Candidate:
    start = np.zeros(columns.shape[1])
    free = np.arange(len(start))
    return Candidate(name, label, base, free, start, typical, 0.1 * typical, columns)


@dataclass(frozen=True)
class Scan:
    """A jump of six numbers, at each of many times: the evidence of each, and how to make it."""

    effect: str
    times: tuple[tuple[str, float], ...]
    found: tuple[Evidence, ...]

    def best(self) -> int:
        """Return the likeliest time."""
        return int(np.argmax([one.log_bayes for one in self.found]))

    @property
    def log_bayes(self) -> float:
        """Of a jump at any of these times."""
        logs = np.array([one.log_bayes for one in self.found])
        return float(np.logaddexp.reduce(logs) - np.log(len(logs)))


def scan_steps(
    observation: Observation, zero: Array, rows: Array, behind: Background
) -> Scan | None:
    """Scan for a step of the reading at any time of any bag."""
    times = []
    for name, view in observation.views.items():
        last = float(view.scene.wrench_s[-1])
        grid = np.arange(_EDGE_S, last - _EDGE_S, _STEP_GRID_S[name])
        times += [(name, float(t)) for t in grid]
    return _scan(observation, "bias_step", zero, rows, behind, times, _STEP)


def scan_shifts(
    observation: Observation, marker: Array, rows: Array, behind: Background
) -> Scan | None:
    """Scan for a move of the base's marker at any time of push."""
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
    acts = np.flatnonzero(np.any(columns != 0.0, axis=1))
    acts = acts[np.argsort(bins[acts], kind="stable")]
    edges = np.searchsorted(bins[acts], np.arange(count + 1))
    width = columns.shape[1]
    grams = np.zeros((count, width, width))
    cross = np.zeros((count, len(behind.prior_std), width))
    along = np.zeros((count, width))
    own, others, towards_own = columns[acts], behind.columns[acts], rows[acts]
    for number in range(count):
        here = slice(edges[number], edges[number + 1])
        part = own[here]
        grams[number] = part.T @ part
        cross[number] = others[here].T @ part
        along[number] = part.T @ towards_own[here]
    # From bins to all rows from a time on.
    grams, cross, along = (np.cumsum(a[::-1], axis=0)[::-1][1:] for a in (grams, cross, along))
    nuisance = behind.dot(rows)
    count = len(times)
    back = behind.solve(cross.transpose(1, 0, 2).reshape(cross.shape[1], -1))
    back = back.reshape(cross.shape[1], count, width).transpose(1, 0, 2)
    reduced = grams - np.einsum("mni,mnj->mij", cross, back)
    towards = along - np.einsum("mni,n->mi", back, nuisance)
    found = evidences(0.5 * (reduced + reduced.transpose(0, 2, 1)), towards, typical)
    return Scan(effect, tuple(times), tuple(found))


def jump_candidate(observation: Observation, scan: Scan, columns: Array, index: int) -> Candidate:
    """Return the scan's jump at one of its times."""
    bag, at_s = scan.times[index]
    after = _session_times(observation, [(bag, at_s)])[0]
    on = (observation.rows.session_s >= after).astype(float)
    base: Effect
    if scan.effect == "bias_step":
        base, typical = BiasStep(bag=bag, time_s=at_s), _STEP
    else:
        base, typical = BaseShift(time_s=at_s), _SHIFT
    one = _linear(scan.effect, f"{bag} {at_s:.2f} s", base, columns * on[:, None], typical)
    return replace(one, known={"time_s": _when(scan, bag)})


def _when(scan: Scan, bag: str) -> tuple[float, float]:
    """Return times of a bag that hold 95 % of a jump's probability there, and a step beside them.

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


# Limits

_PINNED, _NEXT = 6, 5
_PILE, _PILE_OVER = 25, 5.0
_LOWEST_PART = 0.4
_SAME = 1e-7
_NEAR_SIGMAS = 2.5
_LEAST_RUN_S = 0.08
_BEYOND = (2.0, 2.0, 2.0, 0.1, 0.1, 0.1)
_WORTH_EACH, _WORTH_MOST = 0.5, 40.0
_POWER, _FAR, _SHORT = 20.0, 1.5, np.array([0.02])


def saturation_candidates(observation: Observation, zero: Array) -> list[Candidate]:
    """Return limits that readings pile up at; zero (N, 6): columns of the sensor's zero."""
    found = []
    for axis, name in enumerate(WRENCH_AXES):
        readings = np.concatenate(
            [bag.wrenches[:, axis] for bag in observation.recording.bags.values()]
        )
        noise = max(one[axis].std for one in observation.noise.values())
        for limit, bonus in _piles(np.abs(readings), noise):
            beyond = _beyond(observation, zero, axis, limit, noise)
            typical = np.full(beyond.shape[1], _BEYOND[axis])
            effect = SensorSaturation(limit=limit, axis=name)
            one = _linear("sensor_saturation", f"{name} {limit:.4g}", effect, beyond, typical)
            # Where readings pile up is known to the noise of one of them.
            known = {"limit": (limit - noise, limit + noise)}
            make = partial(_same, effect)
            one = replace(one, make=make, inputs=True, known=known, bonus=bonus)
            found.append(replace(one, model="hard limit"))
    return found


def bent_candidates(observation: Observation, zero: Array) -> list[Candidate]:
    """Return limits that axes bend towards, softly; zero (N, 6): columns of the sensor's zero.

    Far below its limit L a reading falls short by x |x / L|^p / p.
    """
    true = _readings_at_rows(observation)
    found = []
    for axis, name in enumerate(WRENCH_AXES):
        largest = float(np.max(np.abs(true[:, axis])))
        short = -true[:, axis] * (np.abs(true[:, axis]) / largest) ** _POWER
        none = SoftSaturation(float(np.log(_FAR * largest)), float(np.log(_POWER)), name)
        fitted = Candidate(
            *("sensor_saturation", f"{name} softly", none, np.arange(2), none.vector()),
            *(np.array([0.3, 0.4]), np.array([0.01, 0.05])),
            model="soft limit",
        )

        def begun(values: Array, fitted: Candidate = fitted) -> tuple[Candidate, Array]:
            share = min(max(_POWER * float(values[0]), 1e-3), 1e3)
            return fitted, fitted.start - np.array([np.log(_FAR) + np.log(share) / _POWER, 0.0])

        one = _linear(
            "sensor_saturation", f"{name} softly", none, zero[:, [axis]] * short[:, None], _SHORT
        )
        found.append(replace(one, into=begun))
    return found


def _same(effect: Effect, _loads: Array) -> Effect:
    return effect


def _piles(sizes: Array, noise: float) -> list[tuple[float, float]]:
    """Limits (value, log evidence of the pile) of an axis from its readings' sizes (n,)."""
    top = float(sizes.max())
    if top <= 4.0 * noise:
        return []
    at_top = sizes >= top - _SAME * max(top, 1.0)
    pinned = int(np.sum(at_top))
    # Coarse steps repeat every value, a limit only its own.
    _, repeats = np.unique(sizes[~at_top], return_counts=True)
    usual = float(np.median(repeats[-_NEXT:])) if len(repeats) else 0.0
    if pinned >= _PINNED and pinned > 2.0 * usual:
        return [(top, min(_WORTH_EACH * pinned, _WORTH_MOST))]
    width = 2.0 * noise
    edges = np.arange(_LOWEST_PART * top, top + width, width)
    if len(edges) < 12:
        return []
    counts, _ = np.histogram(sizes, edges)
    # A limit has nothing above it, but for noise.
    last = len(counts) - 1
    for bin_ in range(last, max(last - 4, 6), -1):
        before = float(np.mean(counts[bin_ - 6 : bin_ - 2]))
        if counts[bin_] >= _PILE and counts[bin_] > _PILE_OVER * max(before, 1.0):
            inside = np.abs(sizes - edges[bin_]) < width
            return [(float(np.mean(sizes[inside])), 0.0)]
    return []


def _beyond(observation: Observation, zero: Array, axis: int, limit: float, noise: float) -> Array:
    """Columns (N, p): two for each push that the axis clips."""
    columns = []
    for name, view in observation.views.items():
        if not view.tracks:
            continue
        bag = observation.recording.bags[name]
        # Columns of the zero tell what a reading's excess takes from the tip: loads add it.
        here = np.where(observation.rows.bag == BAGS.index(name), -zero[:, axis], 0.0)
        wrench_rows = observation.rows.channel < len(WRENCH_AXES)
        here[wrench_rows] = 0.0
        at_limit = np.abs(bag.wrenches[:, axis]) >= limit - _NEAR_SIGMAS * noise
        for start, end in _runs(bag.wrench_s, at_limit):
            sign = np.sign(np.interp(0.5 * (start + end), bag.wrench_s, bag.wrenches[:, axis]))
            u = (observation.rows.bag_s - start) / (end - start)
            inside = (u > 0.0) & (u < 1.0) & (here != 0.0)
            if inside.any():
                for order in (1, 3):
                    shape = np.where(inside, np.sin(order * np.pi * u), 0.0)
                    columns.append(sign * here * shape)
    if not columns:
        return np.zeros((len(observation.rows), 0))
    return np.stack(columns, axis=1)


def _runs(at_s: Array, on: np.ndarray) -> list[tuple[float, float]]:
    """Return times from to in which `on` holds, short gaps of noise closed."""
    times = at_s[on]
    if not len(times):
        return []
    cuts = np.flatnonzero(np.diff(times) > _LEAST_RUN_S) + 1
    return [
        (float(run[0]), float(run[-1]))
        for run in np.split(times, cuts)
        if run[-1] - run[0] >= _LEAST_RUN_S
    ]
