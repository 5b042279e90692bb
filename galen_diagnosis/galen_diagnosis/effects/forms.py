# SPDX-License-Identifier: Apache-2.0
"""All forms of all effects on a recording, and the background of every fit.

Beside every hypothesis are fitted unknowns that are no gap, and a healthy arm's tolerances: no arm
is the nominal one to the last micrometre. Its joints' zeros, its sensor's gains, its tool's file
are right within what workshops and calibrations reach; a gap is what lies beyond.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from galen_model.arrays import Array
from galen_model.estimation.evidence import Background, Evidence, evidence
from galen_sim_driver.effects.effect import Effect
from galen_sim_driver.effects.joints import JointZeroOffset
from scipy.sparse import csc_array

from galen_diagnosis.effects.candidates import Candidate
from galen_diagnosis.effects.diagnosed_effect import Sizes
from galen_diagnosis.effects.registry import record_of, sought
from galen_diagnosis.observation.observation import UNKNOWNS, Observation, Unknowns
from galen_diagnosis.observation.recording import DAY_TO_DAY, Earlier
from galen_diagnosis.observation.rows import CHANNELS, TIP_AXES

_ZERO_N, _ZERO_NM = 0.1, 2e-3
"""How far the sensor's zero may lie off, beside what its drift makes of it."""

_PLACE_M, _PLACE_RAD = 0.5, 0.8
"""How well the joints tell where the tip is, from one place of the arm to another: its geometry.

By what its joints' zeros may be off, rad.
"""
_LEAST_ZERO_RAD = 0.1e-3


def candidates(observation: Observation) -> list[Candidate]:
    """Return all forms that the recording could show and the simulator differentiates.

    Args:
        observation: What was measured.

    Returns:
        Forms in the order of the effects that are sought.

    """
    there = {"": True}
    there["tracker"] = any(view.tracks for view in observation.views.values())
    there["motion"] = bool(np.any(np.abs(observation.rows.rate) > 0.05))
    found: list[Candidate] = []
    for name, effect in sought(observation.recording).items():
        record = record_of(name)
        if there[record.needs]:
            found += record.forms(observation, effect)
    return found


class Tolerances(NamedTuple):
    """A healthy arm's own deviations: numbers with a prior of mean zero.

    each: forms, and where their numbers are among all; columns (N, q): how the rows change with
    them; precision (q, q): of the prior; mixed (q, q): them by the numbers of the background's
    columns.
    """

    each: tuple[tuple[Candidate, slice], ...]
    columns: Array
    precision: Array
    mixed: Array

    @property
    def size(self) -> int:
        """How many numbers."""
        return self.columns.shape[1]

    def effects(self, background: Array) -> list[Effect]:
        """Return the effects of a healthy arm's deviations in a fit.

        Args:
            background: Numbers of a fitted background, (n,), those of the deviations last.

        Returns:
            Those that change something.

        """
        numbers = self.mixed @ background[len(background) - self.size :]
        made = [one.at(one.start + numbers[place]) for one, place in self.each]
        return [one for one in made if not one.changes_nothing]


class Forms:
    """Candidates that are judged together, linearly; behind: unknowns and tolerances.

    tolerances: of `behind`, its last columns.

    Their columns stand side by side in one matrix, so that what a background takes of all of them
    is one product.
    """

    def __init__(self, observation: Observation) -> None:
        self._observation = observation
        self._unknowns = unknown_columns(observation)
        zero = self._unknowns[:, :6]
        records = [record_of(name) for name in sought(observation.recording)]
        known = candidates(observation)
        for record in records:
            known += record.columns(observation, zero)
        columns = [_columns(observation, one) for one in known]
        self.behind, self.tolerances = background(
            observation, self._unknowns, zip(known, columns, strict=True)
        )
        self._limits = [one for record in records for one in record.limits(observation, zero)]
        self._jumps = [record.jump for record in records if record.jump is not None]
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
        """Yield every candidate beside a background.

        Args:
            behind: What is fitted beside.
            rows: Whitened residuals, (N,); they may not be changed later.

        Yields:
            The candidate, G (p, p) and b (p,), as `Background.reduced` has them; p counts its
            linear numbers.

        """
        cross = behind.dot(self._matrix)
        back = behind.solve(cross)
        along = self._matrix.T @ rows - back.T @ behind.along(rows)
        for one, place, own in self._places:
            yield one, own - cross[:, place].T @ back[:, place], along[place]

    def judged(self, rows: Array, behind: Background) -> list[tuple[Candidate, Evidence]]:
        """Return every form's evidence beside a background, jumps in time included.

        Args:
            rows: Whitened residuals, (N,); they may not be changed later.
            behind: What is fitted beside.

        Returns:
            Forms with their evidence against none, not sorted.

        """
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
        jumps = (one.judged(self._observation, self._unknowns, rows, behind) for one in self._jumps)
        return [*out, *filter(None, jumps)]


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


def unknown_columns(observation: Observation) -> Array:
    """Return how the prediction changes by each of `Unknowns`.

    Args:
        observation: What was measured.

    Returns:
        Columns, (N, 18), in the rows' units over N, N.m, m or rad.

    """
    steps = np.array([1e-2] * 3 + [1e-3] * 3 + [1e-4] * 6 + [1.0] * 6)
    columns = []
    for k, step in enumerate(steps):
        values = np.zeros(UNKNOWNS)
        values[k] = step
        columns.append(observation.change((), Unknowns(values)) / step)
    first = np.stack(columns, axis=1)
    return np.concatenate([first, observation.unknown], axis=1)


def background(
    observation: Observation, unknowns: Array, columns: Iterable[tuple[Candidate, Array]]
) -> tuple[Background, Tolerances]:
    """Join unknowns, places of the arm, and tolerances among candidates' columns.

    Args:
        observation: Its specification and earlier recordings give the tolerances' prior.
        unknowns: Columns of `unknown_columns`, (N, 18).
        columns: Candidates with their columns, (N, p); those that a healthy arm has none of are
            left out.

    Returns:
        What is fitted beside every hypothesis, in this order, and its tolerances.

    """
    of_table = np.ones(unknowns.shape[1] - UNKNOWNS)
    unknown_std = [_ZERO_N] * 3 + [_ZERO_NM] * 3 + [np.inf] * 12
    places = _place_columns(observation)
    place_std = _zero_rad(observation) * np.array([_PLACE_M] * 3 + [_PLACE_RAD] * 3)
    behind = Background(unknowns, np.concatenate([unknown_std, of_table]))
    behind = behind.beside(places, np.tile(place_std, places.shape[1] // 6))
    parts, std = [np.zeros((len(unknowns), 0))], list[Array]()
    each: list[tuple[Candidate, slice]] = []
    count = 0
    for one, values in columns:
        size = _tolerance(observation, one)
        if size is not None:
            parts.append(values)
            std.append(np.atleast_1d(np.asarray(size, dtype=float)))
            each.append((one, slice(count, count + values.shape[1])))
            count += values.shape[1]
    own = np.concatenate(parts, axis=1)
    healthy_std = np.concatenate([np.zeros(0), *std])
    covariance = np.diag(healthy_std**2)
    mixed = np.eye(count)
    if observation.recording.earlier is None:
        behind = behind.beside(own, healthy_std)
    else:
        covariance += _known_before(observation.recording.earlier, each, count)
        mixed = np.linalg.cholesky(covariance)  # of numbers of unit variance
        behind = behind.beside(own @ mixed, 1.0)
    return behind, Tolerances(tuple(each), own, np.linalg.inv(covariance), mixed)


def _known_before(earlier: Earlier, each: Sequence[tuple[Candidate, slice]], count: int) -> Array:
    """Return the covariance (count, count) of what earlier recordings leave open."""
    here = [one.key for one, place in each for _ in range(place.start, place.stop)]
    places = {key: [k for k, own in enumerate(here) if own == key] for key in set(here)}
    there = [places[key].pop(0) if places.get(key) else None for key in earlier.keys]
    kept = [k for k, place in enumerate(there) if place is not None]
    at = [place for place in there if place is not None]
    out = np.zeros((count, count))
    out[np.ix_(at, at)] = earlier.covariance[np.ix_(kept, kept)]
    return out


def _tolerance(observation: Observation, one: Candidate) -> Sizes | None:
    """Return what a healthy arm's parameters may be off, in a form; None for no such."""
    record, recording = record_of(one.effect), observation.recording
    sizes = record.tolerances(recording, one)
    of_file = recording.specification.limit(record.name) is None
    if sizes is None or recording.earlier is None or not of_file:
        return sizes
    return tuple(DAY_TO_DAY * np.atleast_1d(np.asarray(sizes)))


def _zero_rad(observation: Observation) -> float:
    """Return how far the zeros of a healthy arm's joints may be off: a standard deviation, rad.

    Of a later recording, too: what an arm's places are off isn't learned from earlier ones.
    """
    recording = observation.recording
    part = 1.0 if recording.earlier is None else DAY_TO_DAY  # what its limits are scaled by
    each = [
        recording.specification.std(JointZeroOffset.name, (name,))
        for name in recording.arm.turning_names
    ]
    return max([_LEAST_ZERO_RAD, *(std[0] / part for std in each if std is not None)])


def _place_columns(observation: Observation) -> csc_array:
    """Rows of the tip at each place of the arm: (N, 6 places), in the rows' units."""
    rows = observation.rows
    first = CHANNELS.index(TIP_AXES[0])
    tip = (rows.channel >= first) & (rows.channel < first + 6)
    places = [number for number in np.unique(rows.pose[tip]) if number >= 0]
    # A constant becomes sqrt(n) / sigma in a row of n samples: one over the row's scale.
    there = np.flatnonzero(tip & (rows.pose >= 0))
    column = 6 * np.searchsorted(places, rows.pose[there]) + rows.channel[there] - first
    return csc_array((1.0 / rows.scale[there], (there, column)), shape=(len(rows), 6 * len(places)))


def healthy_background(observation: Observation) -> Background:
    """Return unknowns and a healthy arm's tolerances alone.

    Args:
        observation: What was measured.

    Returns:
        The same background as that of `Forms`.

    """
    unknowns = unknown_columns(observation)
    known = candidates(observation)
    for name in sought(observation.recording):
        known += record_of(name).columns(observation, unknowns[:, :6])
    columns = (
        (one, _columns(observation, one))
        for one in known
        if _tolerance(observation, one) is not None
    )
    return background(observation, unknowns, columns)[0]
