"""How well columns predict blocks that they were not fitted to: Bayesian linear regression.

For y = X w + e, w ~ N(0, 1), e ~ N(0, K) with K block by block, all that blocks say of w is

    A = sum_b X_b^T K_b^-1 X_b,   r = sum_b X_b^T K_b^-1 y_b,

and the evidence of any blocks is (C. M. Bishop, *Pattern Recognition and Machine Learning*, 2006,
section 3.5.1, with K for the noise)

    2 log Z = r^T (A + 1)^-1 r - log|A + 1| - y^T K^-1 y - log|K| - n log 2 pi.

A block b that no fit has seen is predicted with the density p(y_b | others) = Z(all) / Z(others),
parameters' uncertainty included. Where an effect shows in one of several ways, Z is their mean. K's
form, a few numbers, is chosen channel by channel where it makes Z of all blocks largest; weights
are not in that, being integrated out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from galen_model.arrays import Array

from galen_diagnosis.tables.block_rows import FLOOR_FORMS, BlockRows, Columns, noise_forms

_NEGLIGIBLE_NATS = 15.0
_SWEEPS = 2
_NOISE_AS_IT_IS = 1  # of FLOOR_FORMS
_MORE_THAN_NOISE_NATS = 4.0
"""What a channel's evidence must gain before it counts as more than noise."""


class _Sums(NamedTuple):
    """Of one set of columns, for each channel and form of noise and block: A and r."""

    information: Array  # (C, F, B, k, k)
    right: Array  # (C, F, B, k)


@dataclass(frozen=True)
class Fit:
    """Weights (k,) with covariance (k, k) from some blocks."""

    weights: Array
    covariance: Array


@dataclass(frozen=True)
class Hypothesis:
    """Some effects, and whether noise alone is what they leave.

    ways, fit: as fitted to all blocks; forms (C,): of the noise. elpd (B,): log density of each
    block by the others. folds: of each block, the ways and the fit that the others chose. kept: the
    sets of ways that are not negligible.
    """

    effects: tuple[str, ...]
    floor_only: bool
    ways: tuple[Columns, ...]
    fit: Fit
    forms: np.ndarray
    elpd: Array
    folds: tuple[tuple[tuple[Columns, ...], Fit], ...]
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
        self._last: dict[tuple[int, ...], _Sums] = {}
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
        self._rest = square + log_size + count * np.log(2.0 * np.pi)  # (C, F, B)

    # --- sums ---------------------------------------------------------------------------------

    def sums(self, ways: Sequence[Columns]) -> _Sums:
        """Of the nominal columns followed by those of `ways`."""
        values = [self._nominal, *(way.values / self.rows.floor[None, :, None] for way in ways)]
        columns = np.concatenate(values, axis=2)  # (n, C, k)
        channels, size = columns.shape[1:]
        shape = (channels, len(self.forms), self.blocks, size)
        information, right = np.zeros((*shape, size)), np.zeros(shape)
        for c in range(channels):
            active = np.flatnonzero(np.any(columns[:, c] != 0.0, axis=0))
            if not len(active):
                continue
            both = np.concatenate([columns[:, c, active], self.residual[:, c, None]], axis=1)
            for b, where in enumerate(self._where):
                white = self._inverse[b] @ both[where]  # (F, m, a + 1)
                gram = np.swapaxes(white, 1, 2) @ white
                information[c, :, b][:, active[:, None], active] = gram[:, :-1, :-1]
                right[c, :, b][:, active] = gram[:, :-1, -1]
        return _Sums(information, right)

    def _remembered(self, ways: tuple[Columns, ...]) -> _Sums:
        """The sums, which a hypothesis with and one without the floor alone share."""
        key = tuple(id(way) for way in ways)
        if key not in self._last:
            self._last[key] = self.sums(ways)
        return self._last[key]

    def forget(self) -> None:
        """Free what was remembered of earlier sets."""
        self._last.clear()

    def shows(self, way: Columns) -> float:
        """How many sigma of noise the usual size of this effect is away from all nominal ones."""
        sums = self.sums((way,))
        information = sums.information[:, _NOISE_AS_IT_IS].sum(axis=(0, 1))
        size = self.nominal.size
        among = information[:size, :size] + np.eye(size)
        across = information[:size, size:]
        left = information[size:, size:] - across.T @ np.linalg.solve(among, across)
        return float(np.sqrt(max(np.linalg.eigvalsh(left)[-1], 0.0)))

    def _log_z(self, information: Array, right: Array, rest: Array) -> Array:
        """Of sums (..., k, k), (..., k), (...)."""
        size = right.shape[-1]
        factor = np.linalg.cholesky(information + np.eye(size))
        solved = np.linalg.solve(factor, right[..., None])[..., 0]
        log_det = 2.0 * np.log(np.diagonal(factor, axis1=-2, axis2=-1)).sum(axis=-1)
        return np.asarray(0.5 * ((solved**2).sum(axis=-1) - log_det - rest))

    def _best_forms(self, sums: _Sums, floor_only: bool) -> np.ndarray:
        """Of each channel (C,), by coordinate ascent of the evidence of all blocks."""
        allowed = slice(0, len(FLOOR_FORMS) if floor_only else None)
        a = sums.information[:, allowed].sum(axis=2)
        r = sums.right[:, allowed].sum(axis=2)
        rest = self._rest[:, allowed].sum(axis=2)
        channels = np.arange(len(a))
        doubt = np.zeros(a.shape[1])
        doubt[len(FLOOR_FORMS) :] = _MORE_THAN_NOISE_NATS if self.rows.floor_known else 0.0
        forms = np.argmax(self._log_z(a, r, rest) - doubt, axis=1)
        for _ in range(_SWEEPS):
            before = forms.copy()
            for c in channels:
                others = channels[channels != c]
                base = [part[others, forms[others]].sum(axis=0) for part in (a, r, rest)]
                log_z = self._log_z(a[c] + base[0], r[c] + base[1], rest[c] + base[2])
                forms[c] = np.argmax(log_z - doubt)
            if np.array_equal(before, forms):
                break
        return forms

    # --- hypotheses ---------------------------------------------------------------------------

    def hypothesis(
        self, effects: tuple[str, ...], sets: Sequence[tuple[Columns, ...]], floor_only: bool
    ) -> Hypothesis | None:
        """A hypothesis that holds in one of `sets` of ways; None where no weights are allowed.

        None as well where noise was not to be alone, and is.
        """
        found = []
        for ways in sets:
            sums = self._remembered(ways)
            forms = self._best_forms(sums, floor_only)
            channels = np.arange(len(forms))
            a = sums.information[channels, forms].sum(axis=0)  # (B, k, k)
            r = sums.right[channels, forms].sum(axis=0)
            rest = self._rest[channels, forms].sum(axis=0)
            fit = _fit(a.sum(axis=0), r.sum(axis=0))
            if self._allowed(ways, fit):
                whole = float(self._log_z(a.sum(axis=0), r.sum(axis=0), rest.sum()))
                found.append((whole, ways, forms, fit, a, r, rest))
        if not found:
            return None
        best = max(found, key=lambda one: one[0])
        noise_alone = bool(np.all(best[2] < len(FLOOR_FORMS)))
        if noise_alone and not floor_only and self.rows.floor_known:
            return None  # the same as with the floor only
        kept = [one for one in found if one[0] > best[0] - _NEGLIGIBLE_NATS]
        # (ways, B): evidence of all blocks but one
        seen = np.stack(
            [
                self._log_z(a.sum(axis=0) - a, r.sum(axis=0) - r, rest.sum() - rest)
                for _, _, _, _, a, r, rest in kept
            ]
        )
        of_all = np.array([one[0] for one in kept])
        elpd = np.logaddexp.reduce(of_all) - np.logaddexp.reduce(seen, axis=0)
        folds = []
        for b in range(self.blocks):
            _, ways, _, _, a, r, _ = kept[int(np.argmax(seen[:, b]))]
            folds.append((ways, _fit(a.sum(axis=0) - a[b], r.sum(axis=0) - r[b])))
        return Hypothesis(
            effects,
            floor_only,
            best[1],
            best[3],
            best[2],
            elpd,
            tuple(folds),
            tuple(one[1] for one in kept),
        )

    def _allowed(self, ways: tuple[Columns, ...], fit: Fit) -> bool:
        at = self.nominal.size
        for way in ways:
            if not way.allowed(fit.weights[at : at + way.size]):
                return False
            at += way.size
        return True

    def held_out(self, hypothesis: Hypothesis) -> Array:
        """Residuals (n, C) in floor units, each block by the fit to the others."""
        left = self.residual.copy()
        for (ways, fit), where in zip(hypothesis.folds, self._where, strict=True):
            left[where] -= self._predicted(ways, fit.weights, where)
        return left

    def _predicted(self, ways: Sequence[Columns], weights: Array, where: np.ndarray) -> Array:
        """What nominal columns and ways give rows `where` (m, C), in floor units."""
        values = [self._nominal[where]]
        values += [way.values[where] / self.rows.floor[None, :, None] for way in ways]
        return np.asarray(np.concatenate(values, axis=2) @ weights)


def _fit(information: Array, right: Array) -> Fit:
    covariance = np.asarray(np.linalg.inv(information + np.eye(len(right))), dtype=float)
    return Fit(covariance @ right, covariance)
