"""A diagnosis with everything that its report shows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from galen_model.arrays import Array
from galen_sim_driver.effects.effect import Effect

from galen_diagnosis.answer.answer import Answer
from galen_diagnosis.observation.rows import Rows, Stream

if TYPE_CHECKING:
    from galen_diagnosis.experiment.next_experiment import Experiment


@dataclass(frozen=True)
class Diagnosis:
    """The answer and the residuals behind it.

    rows (N); before, after (N,): whitened residuals without and with the effects that were found,
    what isn't known but no gap fitted in both; streams_before, streams_after: the same in time.
    held_out_before, held_out_after (N,): each row predicted from the folds that it isn't in.
    effects: as fitted to all of it, for the driver; empty where nothing was found.
    floor: mean square of a row that noise alone gives, 1 but for what the noise estimate leaves.
    experiment: the next one, whose sweep `diagnose --next` writes. healthy (N, q): how rows change
    by each of q tolerances of a healthy arm, for what is marked as beyond noise.
    """

    answer: Answer
    rows: Rows
    before: Array
    after: Array
    held_out_before: Array
    held_out_after: Array
    streams_before: tuple[Stream, ...]
    streams_after: tuple[Stream, ...]
    effects: tuple[Effect, ...]
    floor: float
    seconds: dict[str, float]
    experiment: Experiment | None = None
    healthy: Array | None = None
