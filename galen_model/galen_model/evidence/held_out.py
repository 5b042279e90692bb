# SPDX-License-Identifier: Apache-2.0
"""Score hypotheses on blocks that no fit has seen.

Residual and columns are in units of the floor, weights about one, noise K block by block
(`galen_model.evidence.held_out.NoiseForm`). A block that is held out is predicted by the others
with the density Z(all) / Z(others) (`galen_model.estimation.evidence`), parameters' uncertainty
included. Where an effect shows in one of several ways, Z is their mean. K's form, a few numbers, is
chosen channel by channel where it makes Z of all blocks largest; weights are not in that, being
integrated out.

A reading has C channels. What may be in it is linear: columns, each of one or more channels, scaled
so that one unit is what is usual (the prior's standard deviation). A block (a stop, a stretch of
time, a run) is held out as a whole.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from galen_model.arrays import Array
from galen_model.estimation.evidence import (
    LOG_2PI,
    Posterior,
    Prior,
    log_evidence,
    posterior,
)
from galen_model.estimation.least_squares import Information


@dataclass(frozen=True)
class Columns:
    """One way in which an effect shows: k columns and what their weights mean.

    values (n, C, k): what the reading gains by a weight of one; weights are about one. parameters:
    by the contract's name, from weights (k,) to the number or numbers. words: parameters that are
    no number (`axis`), or were set beforehand (`time_s`). allowed: whether weights are this effect.
    """

    values: Array
    parameters: Mapping[str, Callable[[Array], Array]]
    words: Mapping[str, Any] = field(default_factory=dict)
    allowed: Callable[[Array], bool] = lambda weights: True

    @property
    def size(self) -> int:
        """How many columns."""
        return int(self.values.shape[2])


@dataclass(frozen=True)
class Effects:
    """What may be there: of each effect, the ways in which it shows (one of them holds).

    nominal: columns that are always fitted. cannot_tell: sentences on effects that the data can't
    show.
    """

    nominal: Columns
    of: Mapping[str, Sequence[Columns]]
    cannot_tell: tuple[str, ...] = ()


@dataclass(frozen=True)
class BlockRows:
    """n readings of C channels.

    residual (n, C): reading less the nominal prediction, in the channels' own units. floor (C,):
    standard deviation that noise alone gives a row. alike, memory_s: how noise hangs together,
    correlation alike * exp(-dt / memory_s) beside white. at_s (n,); block (n,): 0 ... B - 1;
    labels: of the blocks. floor_known: whether anything told the floor; if not, `floor` is only a
    unit. levels: how many times the floor noise alone may be; empty: it is never alone. memories_s:
    how long what a model lacks may hang together; inf: all of a block.
    """

    channels: tuple[str, ...]
    units: tuple[str, ...]
    residual: Array
    floor: Array
    at_s: Array
    block: np.ndarray
    labels: tuple[str, ...]
    alike: float = 0.0
    memory_s: float = 1.0
    floor_known: bool = True
    levels: tuple[float, ...] = (0.8, 1.0, 1.25)
    memories_s: tuple[float, ...] = (float("inf"),)

    def __len__(self) -> int:
        """Return the number of readings."""
        return len(self.residual)

    def finer(self, parts: int) -> BlockRows:
        """Cut every block into parts of about equal length, in the order of rows.

        Args:
            parts: of each block, at most as many as it has rows.

        Returns:
            The same readings in more blocks.

        """
        block = np.zeros(len(self), dtype=int)
        labels: list[str] = []
        for number, label in enumerate(self.labels):
            rows = np.flatnonzero(self.block == number)
            for k, part in enumerate(np.array_split(rows, min(parts, len(rows)))):
                block[part] = len(labels)
                labels.append(f"{label}, part {k + 1}")
        return replace(self, block=block, labels=tuple(labels))


@dataclass(frozen=True)
class NoiseForm:
    """Covariance of a channel within a block, in units of its floor squared.

    white^2 (floor's own correlation) + size^2 exp(-dt / memory_s): noise, and what a model lacks.
    """

    white: float
    size: float = 0.0
    memory_s: float = float("inf")

    def covariance(self, rows: BlockRows, at_s: Array) -> Array:
        """Compute the covariance of a channel's readings in one block.

        Args:
            rows: whose floor the noise is of: its correlation and memory.
            at_s: times (m,) of the block's readings.

        Returns:
            (m, m), in units of the channel's floor squared.

        """
        apart = np.abs(at_s[:, None] - at_s[None, :])
        floor = rows.alike * np.exp(-apart / rows.memory_s) + (1.0 - rows.alike) * np.eye(len(at_s))
        lacking = np.exp(-apart / self.memory_s) if np.isfinite(self.memory_s) else 1.0
        # A little of it is white: a law that isn't quite the right one scatters as well.
        lacking = 0.98 * lacking + 0.02 * np.eye(len(at_s))
        return np.asarray(self.white**2 * floor + self.size**2 * lacking)


_SIZES = (0.7, 2.0, 6.0, 18.0, 50.0, 150.0)


def noise_forms(rows: BlockRows) -> tuple[NoiseForm, ...]:
    """List the forms of noise that are tried.

    Args:
        rows: with the levels of noise and the memories to try.

    Returns:
        Noise alone at its levels first, then what something that is missing may be like.

    """
    more = [NoiseForm(1.0, size, memory) for memory in rows.memories_s for size in _SIZES]
    return (*map(NoiseForm, rows.levels), *more)


_NEGLIGIBLE_NATS = 15.0
_SWEEPS = 2
_MORE_THAN_NOISE_NATS = 4.0
"""What a channel's evidence must gain before it counts as more than noise."""


@dataclass(frozen=True)
class BlockHypothesis:
    """Some effects, and whether noise alone is what they leave.

    ways, fit: as fitted to all blocks; forms (C,): of the noise. elpd (B,): log density of each
    block by the others. folds: of each block, the ways and the weights that the others chose.
    kept: the sets of ways that are not negligible.
    """

    effects: tuple[str, ...]
    floor_only: bool
    ways: tuple[Columns, ...]
    fit: Posterior
    forms: np.ndarray
    elpd: Array
    folds: tuple[tuple[tuple[Columns, ...], Array], ...]
    kept: tuple[tuple[Columns, ...], ...]


def _present(columns: Array, channel: int) -> np.ndarray:
    """Return which of columns (n, C, k) a channel has, (a,)."""
    return np.flatnonzero(np.any(columns[:, channel] != 0.0, axis=0))


class _ByChannel(NamedTuple):
    """Sums over rows of k columns: of each channel the columns that it has, by form and block.

    size: k; each: places (a,) of a channel's columns among all, and their sums, (F, B).
    """

    size: int
    each: tuple[tuple[np.ndarray, Information], ...]

    @property
    def separate(self) -> bool:
        """Whether no column is of more than one channel."""
        return bool(np.all(np.bincount(np.concatenate([at for at, _ in self.each])) <= 1))

    def totals(self, sums: Sequence[Information]) -> Information:
        """Return channels' sums over blocks, each (F,) of its own columns, among all: (C, F)."""
        shape = (len(sums), len(sums[0].rest), self.size)
        matrix, right = np.zeros((*shape, self.size)), np.zeros(shape)
        for c, (at, _) in enumerate(self.each):
            matrix[c][:, at[:, None], at] = sums[c].matrix
            right[c][:, at] = sums[c].right
        return Information(matrix, right, np.stack([one.rest for one in sums]))

    def chosen(self, forms: np.ndarray) -> Information:
        """Return the sums over channels, each in a form (C,) of noise, by block (B,)."""
        parts = [part.part(form) for form, (_, part) in zip(forms, self.each, strict=True)]
        rest = np.sum([one.rest for one in parts], axis=0)
        matrix, right = (
            np.zeros((len(rest), self.size, self.size)),
            np.zeros((len(rest), self.size)),
        )
        for (at, _), one in zip(self.each, parts, strict=True):
            matrix[:, at[:, None], at] += one.matrix
            right[:, at] += one.right
        return Information(matrix, right, rest)


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
        self._last: dict[tuple[int, ...], _ByChannel] = {}
        log_size = np.zeros((len(self.forms), self.blocks))
        for b, where in enumerate(self._where):
            whiteners = []
            for f, form in enumerate(self.forms):
                factor = np.linalg.cholesky(form.covariance(rows, rows.at_s[where]))
                log_size[f, b] = 2.0 * np.log(np.diag(factor)).sum()
                whiteners.append(np.linalg.inv(factor))
            self._inverse.append(np.stack(whiteners))
        count = np.array([len(where) for where in self._where])
        self._normalisation = log_size + count * LOG_2PI  # (F, B)
        self._white_nominal: list[tuple[np.ndarray, list[Array]]] = []
        """Of each channel: which nominal columns it has; by block, residual and these."""
        for c in range(len(rows.channels)):
            at = _present(self._nominal, c)
            both = np.concatenate([self.residual[:, [c]], self._nominal[:, c, at]], axis=1)
            self._white_nominal.append((at, self._whitened(both)))

    # Sums over rows

    def _whitened(self, columns: Array) -> list[Array]:
        """Return columns (n, a) of one channel by block, (F, m, a)."""
        pairs = zip(self._inverse, self._where, strict=True)
        return [inverse @ columns[where] for inverse, where in pairs]

    def information(self, ways: Sequence[Columns]) -> _ByChannel:
        """Sum over the rows of the nominal columns and those of `ways`.

        Args:
            ways: one way of each effect.

        Returns:
            Sums by channel, form and block.

        """
        first = self.nominal.size
        values = [way.values / self.rows.floor[None, :, None] for way in ways]
        more = np.concatenate([np.zeros((*self.residual.shape, 0)), *values], axis=2)
        each = []
        for c, (at, nominal) in enumerate(self._white_nominal):
            own = _present(more, c)
            white = self._whitened(more[:, c, own])
            whole = [np.concatenate(pair, axis=2) for pair in zip(nominal, white, strict=True)]
            gram = np.stack([np.swapaxes(one, 1, 2) @ one for one in whole], axis=1)
            rest = gram[..., 0, 0] + self._normalisation
            part = Information(gram[..., 1:, 1:], gram[..., 1:, 0], rest)
            each.append((np.concatenate([at, first + own]), part))
        return _ByChannel(first + more.shape[2], tuple(each))

    def _remembered(self, ways: tuple[Columns, ...]) -> _ByChannel:
        """Return what a hypothesis with and one without the floor alone share."""
        key = tuple(id(way) for way in ways)
        if key not in self._last:
            self._last[key] = self.information(ways)
        return self._last[key]

    def forget(self) -> None:
        """Free what was remembered of earlier sets."""
        self._last.clear()

    def shows(self, way: Columns) -> float:
        """Compute how far the usual size of an effect is away from all nominal ones.

        Args:
            way: a way in which the effect shows.

        Returns:
            Distance in sigma of the noise, along the direction that shows most.

        """
        as_it_is = int(np.argmin(np.abs(np.log(self.rows.levels))))
        forms = np.full(len(self.rows.channels), as_it_is)
        information = self.information((way,)).chosen(forms).total().matrix
        size = self.nominal.size
        among = information[:size, :size] + np.eye(size)
        across = information[:size, size:]
        left = information[size:, size:] - across.T @ np.linalg.solve(among, across)
        return float(np.sqrt(max(np.linalg.eigvalsh(left)[-1], 0.0)))

    def _best_forms(self, of_each: _ByChannel, floor_only: bool) -> np.ndarray:
        """Of each channel (C,), by coordinate ascent of the evidence of all blocks."""
        allowed = slice(0, len(self.rows.levels) if floor_only else None)
        doubt = np.zeros(len(self.forms[allowed]))
        doubt[len(self.rows.levels) :] = _MORE_THAN_NOISE_NATS
        sums = [part.part(allowed).total() for _, part in of_each.each]
        alone = [log_evidence(one, Prior.unit(one.right.shape[-1])) for one in sums]
        forms = np.argmax(np.stack(alone) - doubt, axis=1)
        if of_each.separate:
            return forms
        whole = of_each.totals(sums)  # (C, F)
        prior = Prior.unit(of_each.size)
        channels = np.arange(len(sums))
        for _ in range(_SWEEPS):
            before = forms.copy()
            for c in channels:
                others = channels[channels != c]
                base = whole.part((others, forms[others])).total()
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
        """Fit a hypothesis that holds in one of several sets of ways.

        Args:
            effects: names of its effects.
            sets: alternatives, each with one way of every effect, in the order of `effects`.
            floor_only: noise alone is what the effects leave; otherwise something unknown as well.

        Returns:
            The fitted hypothesis; None where no set has weights that are allowed, or where, without
            `floor_only`, noise alone is found all the same.

        """
        found = []
        for ways in sets:
            of_each = self._remembered(ways)
            forms = self._best_forms(of_each, floor_only)
            blocks = of_each.chosen(forms)
            prior = Prior.unit(blocks.right.shape[-1])
            fit = posterior(blocks.total(), prior)
            if self._allowed(ways, fit):
                whole = float(log_evidence(blocks.total(), prior))
                found.append((whole, ways, forms, fit, blocks))
        if not found:
            return None
        best = max(found, key=lambda one: one[0])
        noise_alone = bool(np.all(best[2] < len(self.rows.levels)))
        if noise_alone and not floor_only:
            return None  # the same as with the floor only
        kept = [one for one in found if one[0] > best[0] - _NEGLIGIBLE_NATS]
        left_out = [blocks.without_each() for *_, blocks in kept]
        priors = [Prior.unit(one.right.shape[-1]) for one in left_out]
        # (ways, B): evidence of all blocks but one
        seen = np.stack(list(map(log_evidence, left_out, priors)))
        of_all = np.array([one[0] for one in kept])
        elpd = np.logaddexp.reduce(of_all) - np.logaddexp.reduce(seen, axis=0)
        folds = []
        for b, k in enumerate(np.argmax(seen, axis=0)):
            others = left_out[k].part(b)
            weights = np.linalg.solve(others.matrix + priors[k].precision, others.right)
            folds.append((kept[k][1], weights))
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
        """Compute residuals, each block by the fit to the others.

        Args:
            hypothesis: fitted on these rows.

        Returns:
            Residuals (n, C), in floor units.

        """
        left = self.residual.copy()
        for (ways, weights), where in zip(hypothesis.folds, self._where, strict=True):
            left[where] -= self._predicted(ways, weights, where)
        return left

    def _predicted(self, ways: Sequence[Columns], weights: Array, where: np.ndarray) -> Array:
        """Return what nominal columns and ways give rows `where` (m, C), in floor units."""
        values = [self._nominal[where]]
        values += [way.values[where] / self.rows.floor[None, :, None] for way in ways]
        return np.asarray(np.concatenate(values, axis=2) @ weights)
