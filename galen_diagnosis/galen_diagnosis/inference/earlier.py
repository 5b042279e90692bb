# SPDX-License-Identifier: Apache-2.0
"""What earlier recordings of an arm say of a later one.

The posterior of a healthy arm's deviations from an earlier recording, N(m, C), is the later one's
prior: m goes into the nominal model, with the causes that were found, and what is fitted beside
every cause has the covariance C + D, with D what an arm changes from day to day. Several earlier
recordings follow one another.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from galen_model.arrays import Array

from galen_diagnosis.effects.forms import Tolerances
from galen_diagnosis.effects.registry import record_of
from galen_diagnosis.inference.refine import Hypothesis
from galen_diagnosis.observation.recording import DAY_TO_DAY, DiagnosticRecording, Earlier


def after(
    recording: DiagnosticRecording,
    earlier: DiagnosticRecording,
    tolerances: Tolerances,
    mean: Array,
    covariance: Array,
    fit: Hypothesis,
) -> DiagnosticRecording:
    """Return a recording whose nominal model is the arm as an earlier one shows it.

    Args:
        recording: The later one.
        earlier: With what still earlier ones say of it, if any.
        tolerances: Its deviations of a healthy arm.
        mean: Of their numbers, (q,).
        covariance: Of them, (q, q).
        fit: The causes that were there.

    Returns:
        The later recording with this knowledge; with the first earlier one its limits become those
        of day-to-day changes.

    """
    kept = [(one, place) for one, place in tolerances.each if not record_of(one.effect).of_time]
    known = [one.at(one.start + mean[place]) for one, place in kept]
    for part, effect in zip(fit.parts, fit.effects, strict=True):
        record = record_of(part.effect)
        if record.jump is None and not record.of_time:
            known.append(record.later(effect))
    at = np.array([k for _, place in kept for k in range(place.start, place.stop)], dtype=int)
    before = earlier.earlier
    learned = Earlier(
        (*(before.names if before else ()), earlier.name),
        (*(before.effects if before else ()), *(one for one in known if not one.changes_nothing)),
        tuple(one.key for one, place in kept for _ in range(place.start, place.stop)),
        covariance[np.ix_(at, at)],
    )
    limits = recording.specification
    if recording.earlier is None:
        limits = limits.scaled(DAY_TO_DAY, "day-to-day changes of ")
    return replace(recording, earlier=learned, specification=limits)
