"""How far the gap shrinks, on blocks that no fit has seen.

Blocks (a pose with its move, three seconds) are dealt to folds; effects, unknowns and what a
healthy arm may be off (`background.py`) are fitted on the others and the simulator, with the
effects in it, predicts the one left out. "Before" is the same arm without the effects: what it is
off stays as it was fitted beside them, unknowns are fitted anew. So tolerances, which are no gap,
neither close it nor stand in the way of seeing it closed. With mean squares E of whitened rows,
before, after and of noise alone,

    closed fraction = (E_before - E_after) / (E_before - E_floor),

with an interval from drawing blocks with replacement, before and after from the same draw.

What isn't a number of a fit was chosen on all blocks: which effects, in which form, when a jump
was, how white the noise is. Loads beyond a clipped axis are fitted to the block left out itself.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from galen_model.arrays import Array
from galen_model.evidence.background import Background

from galen_diagnosis.answer.answer import Interval
from galen_diagnosis.effects.saturation import SaturationCandidate
from galen_diagnosis.inference.refine import Hypothesis, refine
from galen_diagnosis.observation.observation import UNKNOWNS, Observation
from galen_diagnosis.observation.rows import FOLDS, Rows

_DRAWS = 400
_SEED = 20191


@dataclass(frozen=True)
class Gap:
    """before, after (N,): held-out rows; floor: mean square of noise; the closed fraction.

    fraction is None where there is nothing to close: E_before isn't above the floor.
    """

    before: Array
    after: Array
    floor: float
    fraction: Interval | None

    def to_json(self) -> dict[str, object]:
        """As the contract's `gap`: mean squares in units of the noise."""
        return {
            "before": {"mean_square": float(np.mean(self.before**2))},
            "after": {"mean_square": float(np.mean(self.after**2))},
            "floor": {"mean_square": self.floor},
            "closed_fraction": None if self.fraction is None else self.fraction.to_json(),
        }


def unknowns_alone(behind: Background) -> Background:
    """Only what isn't known and no gap, beside which the nominal arm itself is shown."""
    return Background(behind.columns[:, :UNKNOWNS], behind.prior_std[:UNKNOWNS])


def held_out_gap(
    observation: Observation,
    hypothesis: Hypothesis,
    behind: Background,
    floor: float,
    progress: Callable[[str, float], None] | None = None,
) -> Gap:
    """Every row predicted from the folds that it isn't in; the fit starts at the hypothesis'.

    behind: unknowns and tolerances; floor: mean square of a row that noise alone gives.
    """
    rows = observation.rows
    before, after = np.zeros(len(rows)), np.zeros(len(rows))
    for fold in range(FOLDS):
        if progress is not None:
            progress(f"held out, part {fold + 1} of {FOLDS}", 0.9 + 0.02 * fold)
        out = rows.fold == fold
        if not out.any() or out.all():
            continue
        fitted = refine(
            observation,
            _only(behind, ~out),
            hypothesis.parts,
            hypothesis.values,
            ~out,
            none_cost=0.0,
        )
        healthy = behind.columns[:, UNKNOWNS:] @ fitted.background[UNKNOWNS:]
        before[out] = without_unknowns(behind, observation.nominal - healthy, out)
        everywhere = observation.residual(fitted.effects, fitted.unknowns) - healthy
        for part in fitted.parts:
            # Loads that the sensor didn't tell are inputs, as the reading is, and no parameters.
            if isinstance(part, SaturationCandidate) and part.beyond.shape[1]:
                beyond = part.beyond[out]
                seen = np.any(beyond != 0.0, axis=0)
                loads = np.linalg.lstsq(beyond[:, seen], everywhere[out], rcond=None)[0]
                everywhere[out] -= beyond[:, seen] @ loads
        after[out] = everywhere[out]
    return Gap(before, after, floor, closed_fraction(rows, before, after, floor))


def closed_fraction(rows: Rows, before: Array, after: Array, floor: float) -> Interval | None:
    """Of rows before and after (N,), with its interval; None where before isn't above the floor."""
    blocks = int(rows.block.max()) + 1
    sums = [np.bincount(rows.block, part, blocks) for part in (before**2, after**2)]
    number = np.bincount(rows.block, minlength=blocks).astype(float)
    value = _fraction(sums[0].sum(), sums[1].sum(), floor * number.sum())
    chance = 3.0 * floor * np.sqrt(2.0 * len(before))
    if sums[0].sum() - floor * number.sum() <= chance or value is None:
        return None
    generator = np.random.default_rng(_SEED)
    draws = generator.integers(0, blocks, (_DRAWS, blocks))
    fractions = [
        _fraction(sums[0][draw].sum(), sums[1][draw].sum(), floor * number[draw].sum())
        for draw in draws
    ]
    known = np.array([one for one in fractions if one is not None])
    if len(known) < _DRAWS // 2:
        return Interval(value, None, None)
    low, high = np.quantile(known, [0.025, 0.975])
    return Interval(value, float(low), float(high))


def _fraction(before: float, after: float, floor: float) -> float | None:
    return None if before <= floor else float((before - after) / (before - floor))


def without_unknowns(behind: Background, rows: Array, out: np.ndarray) -> Array:
    """Rows left out (m,), less the unknowns as the other rows (N,) tell them."""
    unknowns = unknowns_alone(_only(behind, ~out)).fit(np.where(out, 0.0, rows))
    return np.asarray(rows[out] - behind.columns[out, :UNKNOWNS] @ unknowns)


def _only(behind: Background, keep: np.ndarray) -> Background:
    return Background(behind.columns * keep[:, None], behind.prior_std)
