"""An axis that clips: where its readings pile up, and what a hand pushed beyond.

A clipped axis shows as a pile of readings at its limit, of one size to the last bit where the noise
is clipped as well. What it should have read is predicted where nobody touches the tool. Where a
hand pushes, the load beyond the limit is not in the reading but in the deflection: an unknown
input, which each clipped push has in the form

    a_1 sin(pi u) + a_2 sin(3 pi u),   u from 0 to 1 over the time at the limit.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from galen_model.arm.galen import WRENCH_AXES
from galen_model.arrays import Array
from galen_sim_driver.effects.effect import Effect
from galen_sim_driver.effects.sensor import SensorSaturation

from galen_diagnosis.effects.candidates import Candidate, EffectsAt
from galen_diagnosis.observation.observation import Observation
from galen_diagnosis.observation.rows import BAGS

_PINNED, _NEXT = 6, 5
_PILE, _PILE_OVER = 25, 5.0
_LOWEST_PART = 0.4
_SAME = 1e-7
_NEAR_SIGMAS = 2.5
_LEAST_RUN_S = 0.08
_BEYOND = (2.0, 2.0, 2.0, 0.1, 0.1, 0.1)
_WORTH_EACH, _WORTH_MOST = 0.5, 40.0


@dataclass(frozen=True)
class SaturationCandidate(Candidate):
    """A limit of an axis. Its numbers are the loads beyond it, which no simulator knows.

    beyond (N, p): what each adds to the prediction. bonus: log evidence of the pile itself. noise:
    of one reading, in the axis' unit.
    """

    beyond: Array
    bonus: float
    noise: float

    def at(self, values: Array) -> Effect:
        """The effect, the same whatever was pushed."""
        return self.base

    def unsimulated(self, values: Array) -> Array | float:
        """The loads beyond the limit."""
        return np.asarray(self.beyond @ values)

    @property
    def has_inputs(self) -> bool:
        """Loads are inputs."""
        return True

    @property
    def other_evidence(self) -> float:
        """The pile's."""
        return self.bonus

    def limits(self) -> tuple[Array, Array]:
        """None."""
        return np.full(len(self.start), -np.inf), np.full(len(self.start), np.inf)

    def jacobian(self, observation: Observation, effects: EffectsAt, values: Array) -> Array:
        """Known beforehand."""
        return self.beyond


def saturation_candidates(observation: Observation, zero: Array) -> list[SaturationCandidate]:
    """Limits that readings pile up at; zero (N, 6): columns of the sensor's zero."""
    found = []
    for axis, name in enumerate(WRENCH_AXES):
        readings = np.concatenate(
            [bag.wrenches[:, axis] for bag in observation.recording.bags.values()]
        )
        noise = max(one[axis].std for one in observation.noise.values())
        for limit, bonus in _piles(np.abs(readings), noise):
            beyond = _beyond(observation, zero, axis, limit, noise)
            count = beyond.shape[1]
            nothing = np.zeros(count)
            typical = np.full(count, _BEYOND[axis])
            effect = SensorSaturation(limit=limit, axis=name)
            found.append(
                SaturationCandidate(
                    "sensor_saturation",
                    f"{name} {limit:.4g}",
                    effect,
                    np.arange(count),
                    nothing,
                    nothing,
                    typical,
                    0.1 * typical,
                    beyond,
                    bonus,
                    noise,
                )
            )
    return found


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
    """Times from to in which `on` holds, short gaps of noise closed."""
    times = at_s[on]
    if not len(times):
        return []
    cuts = np.flatnonzero(np.diff(times) > _LEAST_RUN_S) + 1
    return [
        (float(run[0]), float(run[-1]))
        for run in np.split(times, cuts)
        if run[-1] - run[0] >= _LEAST_RUN_S
    ]
