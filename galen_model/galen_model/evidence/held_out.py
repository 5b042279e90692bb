"""Score hypotheses on blocks that no fit has seen.

Residual and columns are in units of the floor, weights about one, noise K block by block
(`galen_model.evidence.blocks.NoiseForm`). A block that is held out is predicted by the others with
the density Z(all) / Z(others) (`galen_model.evidence.linear`), parameters' uncertainty included.
Where an effect shows in one of several ways, Z is their mean. K's form, a few numbers, is chosen
channel by channel where it makes Z of all blocks largest; weights are not in that, being integrated
out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from galen_model.arrays import Array
from galen_model.evidence.blocks import FLOOR_FORMS, BlockRows, Columns, noise_forms
from galen_model.evidence.linear import (
    LOG_2PI,
    Information,
    Posterior,
    Prior,
    log_evidence,
    posterior,
)

_NEGLIGIBLE_NATS = 15.0
_SWEEPS = 2
_NOISE_AS_IT_IS = 1  # of FLOOR_FORMS
_MORE_THAN_NOISE_NATS = 4.0
"""What a channel's evidence must gain before it counts as more than noise."""


@dataclass(frozen=True)
class BlockHypothesis:
    """Some effects, and whether noise alone is what they leave.

    ways, fit: as fitted to all blocks; forms (C,): of the noise. elpd (B,): log density of each
    block by the others. folds: of each block, the ways and the fit that the others chose. kept: the
    sets of ways that are not negligible.
    """

    effects: tuple[str, ...]
    floor_only: bool
    ways: tuple[Columns, ...]
    fit: Posterior
    forms: np.ndarray
    elpd: Array
    folds: tuple[tuple[tuple[Columns, ...], Posterior], ...]
    kept: tuple[tuple[Columns, ...], ...]


class BlockEvidence:
    """Evidence of hypotheses on one set of rows, floor units throughout."""

    def __init__(self, rows: BlockRows, nominal: Columns) -> None:
        self.rows = rows
        self.nominal = nominal
        self.forms = noise_forms(rows)
        self.blocks = len(rows.labels)
        self.residual = rows.residual / rows.floor
        self._nominal = nominal.values / rows.floor[None, :, None]
        self._where = [np.flatnonzero(rows.block == b) for b in range(self.blocks)]
        self._inverse: list[Array] = []  # of each block (F, m, m)
        self._last: dict[tuple[int, ...], Information] = {}
        log_size = np.zeros((len(self.forms), self.blocks))
        for b, where in enumerate(self._where):
            whiteners = []
            for f, form in enumerate(self.forms):
                factor = np.linalg.cholesky(form.covariance(rows, rows.at_s[where]))
                log_size[f, b] = 2.0 * np.log(np.diag(factor)).sum()
                whiteners.append(np.linalg.inv(factor))
            self._inverse.append(np.stack(whiteners))
        count = np.array([len(where) for where in self._where])
        square = np.zeros((len(rows.channels), len(self.forms), self.blocks))
        for b, where in enumerate(self._where):
            white = self._inverse[b] @ self.residual[where]  # (F, m, C)
            square[:, :, b] = (white**2).sum(axis=1).T
        self._rest = square + log_size + count * LOG_2PI  # (C, F, B)

    # Sums over rows

    def information(self, ways: Sequence[Columns]) -> Information:
        """Of the nominal columns and those of `ways`: by channel, form and block (C, F, B)."""
        values = [self._nominal, *(way.values / self.rows.floor[None, :, None] for way in ways)]
        columns = np.concatenate(values, axis=2)  # (n, C, k)
        channels, size = columns.shape[1:]
        shape = (channels, len(self.forms), self.blocks, size)
        matrix, right = np.zeros((*shape, size)), np.zeros(shape)
        for c in range(channels):
            active = np.flatnonzero(np.any(columns[:, c] != 0.0, axis=0))
            if not len(active):
                continue
            both = np.concatenate([columns[:, c, active], self.residual[:, c, None]], axis=1)
            for b, where in enumerate(self._where):
                white = self._inverse[b] @ both[where]  # (F, m, a + 1)
                gram = np.swapaxes(white, 1, 2) @ white
                matrix[c, :, b][:, active[:, None], active] = gram[:, :-1, :-1]
                right[c, :, b][:, active] = gram[:, :-1, -1]
        return Information(matrix, right, self._rest)

    def _remembered(self, ways: tuple[Columns, ...]) -> Information:
        """What a hypothesis with and one without the floor alone share."""
        key = tuple(id(way) for way in ways)
        if key not in self._last:
            self._last[key] = self.information(ways)
        return self._last[key]

    def forget(self) -> None:
        """Free what was remembered of earlier sets."""
        self._last.clear()

    def shows(self, way: Columns) -> float:
        """How many sigma of noise the usual size of this effect is away from all nominal ones."""
        information = self.information((way,)).matrix[:, _NOISE_AS_IT_IS].sum(axis=(0, 1))
        size = self.nominal.size
        among = information[:size, :size] + np.eye(size)
        across = information[:size, size:]
        left = information[size:, size:] - across.T @ np.linalg.solve(among, across)
        return float(np.sqrt(max(np.linalg.eigvalsh(left)[-1], 0.0)))

    def _best_forms(self, of_each: Information, floor_only: bool) -> np.ndarray:
        """Of each channel (C,), by coordinate ascent of the evidence of all blocks."""
        allowed = slice(0, len(FLOOR_FORMS) if floor_only else None)
        whole = _picked(of_each, (slice(None), allowed)).total()  # (C, F)
        prior = Prior.unit(whole.right.shape[-1])
        channels = np.arange(len(whole.right))
        doubt = np.zeros(whole.rest.shape[1])
        doubt[len(FLOOR_FORMS) :] = _MORE_THAN_NOISE_NATS if self.rows.floor_known else 0.0
        forms = np.argmax(log_evidence(whole, prior) - doubt, axis=1)
        for _ in range(_SWEEPS):
            before = forms.copy()
            for c in channels:
                others = channels[channels != c]
                base = _picked(whole, (others, forms[others])).total()
                together = Information(
                    *(part[c] + rest for part, rest in zip(whole, base, strict=True))
                )
                forms[c] = np.argmax(log_evidence(together, prior) - doubt)
            if np.array_equal(before, forms):
                break
        return forms

    # Hypotheses

    def hypothesis(
        self, effects: tuple[str, ...], sets: Sequence[tuple[Columns, ...]], floor_only: bool
    ) -> BlockHypothesis | None:
        """A hypothesis that holds in one of `sets` of ways; None where no weights are allowed.

        None as well where noise was not to be alone, and is.
        """
        found = []
        for ways in sets:
            of_each = self._remembered(ways)
            forms = self._best_forms(of_each, floor_only)
            chosen = _picked(of_each, (np.arange(len(forms)), forms))  # (C, B)
            blocks = Information(*(part.sum(axis=0) for part in chosen))
            prior = Prior.unit(blocks.right.shape[-1])
            fit = posterior(blocks.total(), prior)
            if self._allowed(ways, fit):
                whole = float(log_evidence(blocks.total(), prior))
                found.append((whole, ways, forms, fit, blocks))
        if not found:
            return None
        best = max(found, key=lambda one: one[0])
        noise_alone = bool(np.all(best[2] < len(FLOOR_FORMS)))
        if noise_alone and not floor_only and self.rows.floor_known:
            return None  # the same as with the floor only
        kept = [one for one in found if one[0] > best[0] - _NEGLIGIBLE_NATS]
        left_out = [blocks.without_each() for *_, blocks in kept]
        priors = [Prior.unit(one.right.shape[-1]) for one in left_out]
        # (ways, B): evidence of all blocks but one
        seen = np.stack(list(map(log_evidence, left_out, priors)))
        of_all = np.array([one[0] for one in kept])
        elpd = np.logaddexp.reduce(of_all) - np.logaddexp.reduce(seen, axis=0)
        fits = list(map(posterior, left_out, priors))
        folds = []
        for b, k in enumerate(np.argmax(seen, axis=0)):
            folds.append((kept[k][1], Posterior(*(part[b] for part in fits[k]))))
        return BlockHypothesis(
            effects,
            floor_only,
            best[1],
            best[3],
            best[2],
            elpd,
            tuple(folds),
            tuple(one[1] for one in kept),
        )

    def _allowed(self, ways: tuple[Columns, ...], fit: Posterior) -> bool:
        at = self.nominal.size
        for way in ways:
            if not way.allowed(fit.values[at : at + way.size]):
                return False
            at += way.size
        return True

    def held_out(self, hypothesis: BlockHypothesis) -> Array:
        """Residuals (n, C) in floor units, each block by the fit to the others."""
        left = self.residual.copy()
        for (ways, fit), where in zip(hypothesis.folds, self._where, strict=True):
            left[where] -= self._predicted(ways, fit.values, where)
        return left

    def _predicted(self, ways: Sequence[Columns], weights: Array, where: np.ndarray) -> Array:
        """What nominal columns and ways give rows `where` (m, C), in floor units."""
        values = [self._nominal[where]]
        values += [way.values[where] / self.rows.floor[None, :, None] for way in ways]
        return np.asarray(np.concatenate(values, axis=2) @ weights)


def _picked(information: Information, places: tuple[object, ...]) -> Information:
    """Some of the sets, by an index of the leading axes."""
    return Information(*(part[places] for part in information))  # type: ignore[index]
