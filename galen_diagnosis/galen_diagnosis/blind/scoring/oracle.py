"""The share of a gap that its true cause closes: the same arm measured again without the cause."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from galen_model.arrays import Array

from galen_diagnosis.answer.gap import without_unknowns
from galen_diagnosis.inference.refine import nothing
from galen_diagnosis.inference.remaining_structure import leftover
from galen_diagnosis.inference.search import healthy_background
from galen_diagnosis.observation.observation import UNKNOWNS, Observation
from galen_diagnosis.observation.recording import read_recording
from galen_diagnosis.observation.rows import FOLDS


def oracle_closed(recording: Path, twin: Path) -> float | None:
    """(E - E_twin) / (E - floor); None where E isn't above the floor.

    twin: the recording with the same course, tolerances and noise, and without the cause. E is the
    mean square of held-out rows as a diagnosis counts it (`gap.py`), beside the nominal simulator
    with the tolerances that the twin shows: what is left when the true cause, as it really acts, is
    taken away.
    """
    healthy = _Told(twin)
    none = nothing(healthy.observation, healthy.behind)
    tolerances = none.background[UNKNOWNS:]
    floor = leftover(healthy.observation.rows, none.rows).floor
    before, after = (one.energy(tolerances) for one in (_Told(recording), healthy))
    return None if before <= floor else float((before - after) / (before - floor))


class _Told:
    """A recording beside the nominal simulator."""

    def __init__(self, path: Path) -> None:
        self.observation = Observation(read_recording(path))
        self.behind = healthy_background(self.observation)

    def energy(self, tolerances: Array) -> float:
        """Mean square of held-out rows with these tolerances in the simulator."""
        rows = self.observation.nominal - self.behind.columns[:, UNKNOWNS:] @ tolerances
        left = np.empty(len(rows))
        for fold in range(FOLDS):
            out = self.observation.rows.fold == fold
            left[out] = without_unknowns(self.behind, rows, out)
        return float(np.mean(left**2))
