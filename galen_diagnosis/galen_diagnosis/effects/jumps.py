# SPDX-License-Identifier: Apache-2.0
"""Jumps at any time of a recording: the evidence of all times at once.

A jump b at t_0 changes the rows by columns of the unknowns O_k (the sensor's zero, the base's
marker) times b_k [t >= t_0]; of all times the sums over time bins suffice.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from galen_model.arm.galen import WRENCH_AXES
from galen_model.arrays import Array
from galen_model.estimation.evidence import Background, Evidence, evidences
from galen_sim_driver.effects.effect import Effect

from galen_diagnosis.effects.candidates import Candidate, linear_form
from galen_diagnosis.observation.observation import Observation

_EDGE_S = 1.0
_TEMPER = 0.5
_MOST_GAPS = 400
_FINER = 21
"""Times about the likeliest, from the one before to the one after."""


@dataclass(frozen=True)
class Jump:
    """An effect that is a jump of six of the unknowns.

    effect(bag, s): itself at a time of a bag, of no size. unknowns: which of `Unknowns` jump.
    typical (6,): its usual size. grid_s: by bag, how far apart it is tried. tracked: only the
    tracker sees it.
    """

    effect: Callable[[str, float], Effect]
    unknowns: slice
    typical: Array
    grid_s: Mapping[str, float]
    tracked: bool = False

    def judged(
        self, observation: Observation, unknowns: Array, rows: Array, behind: Background
    ) -> tuple[Candidate, Evidence] | None:
        """Return the likeliest jump, and the evidence of one at any time.

        Where the time is not known, a jump at any of them shares the probability.

        Args:
            observation: What was measured.
            unknowns: Columns of `Unknowns`, (N, 18).
            rows: Whitened residuals, (N,).
            behind: What is fitted beside.

        Returns:
            The jump's form with the interval of its time, and its evidence; None where no time is
            tried.

        """
        times = self._times(observation)
        if not times:
            return None
        columns = unknowns[:, self.unknowns]
        after = _session_times(observation, times)
        found = _evidences(after, observation.rows.session_s, columns, rows, behind, self.typical)
        logs = np.array([one.log_bayes for one in found])
        best = int(np.argmax(logs))
        bag, at_s = times[best]
        here = [k for k, (name, _) in enumerate(times) if name == bag]
        known = {"time_s": _likely(np.array([times[k][1] for k in here]), logs[here])}
        if observation.recording.readings is None:
            # A large jump that is a tenth of a second off leaves a pulse that looks like no jump.
            near = at_s + self.grid_s[bag] * np.linspace(-1.0, 1.0, _FINER)
            after = _session_times(observation, [(bag, float(t)) for t in near])
            found = _evidences(
                after, observation.rows.session_s, columns, rows, behind, self.typical
            )
            finer = np.array([one.log_bayes for one in found])
            logs[best] = max(logs[best], np.max(finer) - np.log(_FINER))
            best = int(np.argmax(finer))
            at_s = float(near[best])
        on = (observation.rows.session_s >= after[best]).astype(float)
        base, label = self.effect(bag, at_s), f"{bag} {at_s:.2f} s"
        one = linear_form(base, label, columns * on[:, None], self.typical)
        anywhere = float(np.logaddexp.reduce(logs) - np.log(len(logs)))
        return replace(one, known=known), replace(found[best], log_bayes=anywhere)

    def _times(self, observation: Observation) -> list[tuple[str, float]]:
        times = []
        rows = observation.rows
        # A jump of the sensor's zero after all readings without a push would show in nothing but
        # how far the pushes go, as would whatever else a model of the arm's deflection misses.
        shows = np.ones(len(rows), dtype=bool) if self.tracked else rows.channel < len(WRENCH_AXES)
        shown_s = float(np.max(rows.session_s[shows], initial=0.0))
        for name, view in observation.views.items():
            if name in self.grid_s and (view.tracks or not self.tracked):
                at_s = view.scene.tracker_s if self.tracked else view.scene.wrench_s
                if observation.recording.readings is not None:
                    times += [(name, float(t)) for t in _between(at_s)]
                    continue
                last_s = min(float(at_s[-1]), shown_s - view.scene.start_s) - _EDGE_S
                grid = np.arange(_EDGE_S, last_s, self.grid_s[name])
                times += [(name, float(t)) for t in grid]
        # Bags may not have been recorded in their usual order.
        return sorted(times, key=lambda time: float(_session_times(observation, [time])[0]))


def _between(at_s: Array) -> Array:
    """Return times between two neighbouring readings, or some of many."""
    gaps = 0.5 * (at_s[1:] + at_s[:-1])
    chosen = np.linspace(0, len(gaps) - 1, min(len(gaps), _MOST_GAPS)).round().astype(int)
    return gaps[chosen]


def _session_times(observation: Observation, times: list[tuple[str, float]]) -> Array:
    bags = observation.views
    return np.array([bags[bag].scene.start_s + at_s for bag, at_s in times])


def _likely(times: Array, logs: Array) -> tuple[float, float]:
    """Return times that hold 95 % of a jump's probability, and a step beside them.

    The evidence is tempered, as all is: noise is white but for what a fit leaves.
    """
    weights = np.exp(_TEMPER * (logs - logs.max()))
    order = np.argsort(-weights, kind="stable")
    enough = int(np.searchsorted(np.cumsum(weights[order]) / weights.sum(), 0.95)) + 1
    likely = times[order[:enough]]
    step = float(np.min(np.diff(np.sort(times)), initial=1.0)) if len(times) > 1 else 1.0
    return max(0.0, float(likely.min()) - step), float(likely.max()) + step


def _evidences(
    after: Array, at_s: Array, columns: Array, rows: Array, behind: Background, typical: Array
) -> list[Evidence]:
    """Evidence of columns (N, 6) switched on after each time (k,), of rows (N,) at at_s (N,)."""
    bins = np.searchsorted(after, at_s, side="right")
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
    half = behind.half(cross.transpose(1, 0, 2).reshape(cross.shape[1], -1))
    half = half.reshape(cross.shape[1], len(after), width).transpose(1, 2, 0)
    reduced = grams - half @ half.transpose(0, 2, 1)
    towards = along - half @ behind.half(behind.dot(rows))
    return evidences(0.5 * (reduced + reduced.transpose(0, 2, 1)), towards, typical)
