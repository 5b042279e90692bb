"""All forms of all effects on a recording, each with how the rows change by it at nominal."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from galen_model.arrays import Array
from galen_model.estimation.evidence import Background, Evidence, evidence

from galen_diagnosis.effects.candidates import (
    Candidate,
    background,
    candidates,
    tolerance,
    unknown_columns,
)
from galen_diagnosis.effects.scans import (
    bent_candidates,
    crosstalk_candidates,
    drift_candidates,
    jump_candidate,
    saturation_candidates,
    scan_shifts,
    scan_steps,
)
from galen_diagnosis.observation.observation import Observation


class Forms:
    """Candidates that are judged together, linearly; behind: unknowns and tolerances.

    Their columns stand side by side in one matrix, so that what a background takes of all of them
    is one product.
    """

    def __init__(self, observation: Observation) -> None:
        self._observation = observation
        self._unknowns = unknown_columns(observation)
        known = candidates(observation)
        columns = [_columns(observation, one) for one in known]
        by_key = {one.key: own for one, own in zip(known, columns, strict=True)}
        self.behind = background(observation, self._unknowns, by_key)
        zero = self._unknowns[:, :6]
        for one in (
            *crosstalk_candidates(observation, zero),
            *drift_candidates(observation, zero),
            *bent_candidates(observation, zero),
        ):
            known.append(one)
            columns.append(_columns(observation, one))
        self._limits = saturation_candidates(observation, zero)
        ends = np.cumsum([own.shape[1] for own in columns]).tolist()
        self._matrix = np.empty((len(observation.rows), ends[-1]), order="F")
        self._places: list[tuple[Candidate, slice, Array]] = []
        for one, end in zip(known, ends, strict=True):
            own = columns.pop(0)
            place = slice(end - own.shape[1], end)
            self._matrix[:, place] = own
            self._places.append((one, place, own.T @ own))
        self.behind.remember(self._matrix)

    def reduced(self, behind: Background, rows: Array) -> Iterator[tuple[Candidate, Array, Array]]:
        """Yield every candidate with G (p, p) and b (p,), as `Background.reduced` has them."""
        cross = behind.dot(self._matrix)
        back = behind.solve(cross)
        along = self._matrix.T @ rows - back.T @ behind.along(rows)
        for one, place, own in self._places:
            yield one, own - cross[:, place].T @ back[:, place], along[place]

    def judged(self, rows: Array, behind: Background) -> list[tuple[Candidate, Evidence]]:
        """Every form's evidence on rows (N,) beside a background, jumps in time included."""
        out = [
            (one, evidence(gram, along, one.typical[: len(along)]))
            for one, gram, along in self.reduced(behind, rows)
        ]
        for limit in self._limits:
            clipped = rows - self._observation.change([limit.base])
            gained = behind.sum_of_squares(rows) - behind.sum_of_squares(clipped)
            gram, along = behind.reduced(_columns(self._observation, limit), clipped)
            beyond = evidence(gram, along, limit.typical)
            log = beyond.log_bayes + 0.5 * gained + limit.bonus
            out.append((limit, replace(beyond, log_bayes=log, gain=beyond.gain + gained)))
        zero, marker = self._unknowns[:, :6], self._unknowns[:, 12:]
        for scan, columns in (
            (scan_steps(self._observation, zero, rows, behind), zero),
            (scan_shifts(self._observation, marker, rows, behind), marker),
        ):
            if scan is not None:
                best = scan.best()
                candidate = jump_candidate(self._observation, scan, columns, best)
                # Where the time is not known, a jump at any of them shares the probability.
                found = replace(scan.found[best], log_bayes=scan.log_bayes)
                out.append((candidate, found))
        return out


def _columns(observation: Observation, candidate: Candidate) -> Array:
    """How the prediction changes (N, p) from nominal by a candidate's linear numbers."""
    first = len(candidate.start) if candidate.linear is None else candidate.linear
    part = replace(
        candidate,
        free=candidate.free[:first],
        start=candidate.start[:first],
        typical=candidate.typical[:first],
        probe=candidate.probe[:first],
    )
    return part.jacobian(observation, lambda values: [part.at(values)], part.start)


def healthy_background(observation: Observation) -> Background:
    """Return unknowns and a healthy arm's tolerances alone."""
    columns = {
        one.key: _columns(observation, one)
        for one in candidates(observation)
        if tolerance(observation, *one.key) is not None
    }
    return background(observation, unknown_columns(observation), columns)
