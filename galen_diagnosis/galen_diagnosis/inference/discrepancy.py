# SPDX-License-Identifier: Apache-2.0
"""What an effect's model may be off: by row, in proportion to what the effect does there.

An effect's model is not quite the arm's. With s (N,) what a fitted effect changes of the rows, the
arm's own change is taken to be (1 + m) s with a field m of mean zero: its model discrepancy
(Kennedy and O'Hagan, J. R. Statist. Soc. B 63, 2001), here multiplicative. Where the effect does
nothing nothing is allowed, so that what is there as well keeps its whole evidence. m is
constant over a piece of time in one group of channels, and over one channel of a bag,

    m = kappa (a_piece + a_channel) / sqrt(2),    a ~ N(0, 1),

so that D = [s on each piece, s on each channel] kappa / sqrt(2) are columns with unit priors.

Friction, or a gap, comes to a place in a state that nobody has recorded. Further columns of D let
each axis of the tip stand off there by as much as the effect moves it, until each axis of the load
has been at _ENOUGH of its largest. They are fitted beside where the effect's numbers are sought,
too (`refine`): else these would make up for them.

Where kappa has to be 1 the effect's size changes from piece to piece as much as it is large: then
something acts like the effect, and is another one: `Discrepancies.varying`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from galen_model.arrays import Array
from galen_model.estimation.evidence import Background
from galen_sim_driver.effects.effect import Effect
from scipy.linalg import cholesky, solve_triangular
from scipy.sparse import csc_array, hstack

from galen_diagnosis.effects.candidates import Candidate
from galen_diagnosis.effects.diagnosed_effect import DiagnosedEffect
from galen_diagnosis.effects.registry import record_of
from galen_diagnosis.inference.refine import Hypothesis
from galen_diagnosis.inference.structure import Structure
from galen_diagnosis.observation.observation import Observation
from galen_diagnosis.observation.rows import BAGS, CHANNELS, REGIMES, TIP_AXES, ResidualRows

_PIECES = {"sweep": 12, "motion": 10, "push": 40}
"""Into how many pieces of equally many blocks a bag is cut, loaded or not."""
_LOADED = [REGIMES.index(name) for name in ("loading", "held")]

_ANOTHER_MODEL = {"exact": 1.0, "firm": 1.0, "loose": 3.0, "rough": 8.0}
"""Log of the odds that m of about 1 is the effect, with a model that is not fitted here."""

_UNSEEN, _LEAST, _LEAST_SHAPED = 0.5, 0.1, 0.03
_LEAST_UNSEEN = 0.01
"""Of an effect's amplitude: no model is nearer, however small m is found."""
_DIRECTIONS = 20.0
_ACTS = 0.1
_NEGLIGIBLE = 0.1
"""Information about a number of unit prior that is none."""
_INPUTS_FREE = 0.8
_SCALES = (0.0, 0.1, 0.3, 1.0)
"""Of what models are off, over what they usually may be, and of what a drift does between its
knots, over what it does from knot to knot."""


@dataclass(frozen=True)
class Weighed:
    """A hypothesis with what its models may be off, D (N, M), in two parts.

    signatures: its effects'; shown: what the background leaves of them; off: by the signatures and
    what they remember; rough: of drifts between their knots. scale: of kappa, root mean square by
    its posterior. energy: F at the minimum with D fitted beside; occam: 1/2 log det of all;
    log_bayes: against none; log_rough: how much of it is by `rough`.
    """

    hypothesis: Hypothesis
    signatures: list[Array]
    shown: list[Array]
    off: csc_array
    rough: csc_array
    scale: float
    energy: float
    occam: float
    log_bayes: float
    log_rough: float

    @property
    def names(self) -> tuple[str, ...]:
        """The effects' names."""
        return self.hypothesis.names

    def missed(self) -> float:
        """Return the energy that models miss where no field m shows it: a part of theirs.

        Returns:
            Energy in units of the noise's variance, as far as m is found; 0 without effects.

        """
        return self._missed(self.scale, 0.0)

    def _missed(self, scale: float, least: float) -> float:
        energies = zip(self.names, self.hypothesis.energies_explained(), strict=True)
        return sum(max(_unseen(name, scale), least) ** 2 * energy for name, energy in energies)

    def answered(self, left: float, *, shaped: bool = False) -> float:
        """Return what a hypothesis has to answer for of the structure that it leaves.

        A model also misses what no field m on such pieces shows, however small m is: an instant, a
        corner, the healthy arm's own tolerances where it moves otherwise. Of an effect's energy E a
        part (_UNSEEN kappa)^2 E, of any effect _LEAST^2 E, spread over some directions, is nothing
        unlisted; less of what is a smooth function of something, which such misses are not.

        Args:
            left: Energy, or log evidence, of the structure.
            shaped: It is of a smooth function, or of an oscillation.

        Returns:
            At most `left`, in its unit.

        """
        least = _LEAST_SHAPED if shaped else _LEAST
        return left / (1.0 + self._missed(1.0, least) / _DIRECTIONS)

    def looks_like(self, signature: Array, but: int) -> float:
        """Return `looks_like` of all its effects but one.

        Args:
            signature: What that one changes of the rows, (N,).
            but: Which.

        Returns:
            A share, 0 ... 1.

        """
        pairs = list(zip(self.names, self.shown, strict=True))
        return looks_like([*pairs[:but], *pairs[but + 1 :]], signature, self.scale)


def _unseen(name: str, scale: float) -> float:
    """How much of an effect's amplitude its model misses where no field m shows it."""
    return max(_UNSEEN * record_of(name).kappa * scale, _LEAST_UNSEEN)


class _Worth:
    """What columns with unit priors are worth beside a background."""

    def __init__(self, behind: Background, off: csc_array, rows: Array) -> None:
        """Project them.

        Args:
            behind: What is fitted beside.
            off: Columns, (N, M).
            rows: Whitened rows before the background's fit, (N,).

        """
        cross = behind.dot(off)
        back = behind.solve(cross)
        self._gram = (off.T @ off).toarray() - cross.T @ back
        self._along = off.T @ rows - back.T @ behind.dot(rows)

    def at(self, scale: Array) -> tuple[float, float]:
        """Return by how much half the energy falls with the columns, and 1/2 log det.

        Args:
            scale: What the columns are taken times, (M,).

        Returns:
            Gain and cost.

        """
        used = np.flatnonzero(scale**2 * np.diag(self._gram) > _NEGLIGIBLE)
        inner = self._gram[np.ix_(used, used)] * np.outer(scale[used], scale[used])
        root = cholesky(np.eye(len(used)) + inner, lower=True)
        solved = solve_triangular(root, scale[used] * self._along[used], lower=True)
        return 0.5 * float(solved @ solved), float(np.sum(np.log(np.diag(root))))


def _telling(columns: csc_array) -> csc_array:
    """Return columns (N, M) that tell something, under unit priors."""
    return columns[:, columns.power(2).sum(axis=0) > _NEGLIGIBLE]


def looks_like(others: Sequence[tuple[str, Array]], signature: Array, scale: float = 1.0) -> float:
    """Return by how much what another effect gains may be what these effects' models miss.

    As `answered`, but only where the others act.

    Args:
        others: Names and signatures (N,) of what is there.
        signature: Of another effect beside them, (N,).
        scale: What their models are off over what they usually may be.

    Returns:
        A share, 0 ... 1.

    """
    unseen = sum(_unseen(name, scale) ** 2 * one**2 for name, one in others)
    unseen = np.broadcast_to(unseen, signature.shape)
    acts = unseen > _ACTS * np.mean(unseen)
    share = float(np.sum(signature[acts] ** 2) / max(np.sum(signature**2), 1e-300))
    size = float(np.sum(unseen)) / _DIRECTIONS
    return share * size / (1.0 + size)


def _counted(hypothesis: Hypothesis) -> float:
    """How much of Occam's factor counts against "unknown", which pays for no input.

    Loads beyond a clipped axis are inputs that were not measured, two a push, and no part of the
    effect; all listed effects but this one get them from the reading for nothing.
    """
    inputs = sum(
        len(values)
        for part, values in zip(hypothesis.parts, hypothesis.values, strict=True)
        if part.inputs
    )
    total = sum(len(values) for values in hypothesis.values)
    return 1.0 - _INPUTS_FREE * inputs / max(total, 1)


class Discrepancies:
    """What effects' models may be off in one recording, beside unknowns and tolerances."""

    def __init__(self, observation: Observation, behind: Background) -> None:
        self._observation = observation
        self._unknowns = behind.first(observation.unknowns)
        self._pieces = _pieces(observation.rows)
        self._by_second = _pieces(observation.rows, BAGS)
        self._push_by_second = _pieces(observation.rows, ("push",))
        self._unloaded = list(_before_loads(observation))
        self._nothing = csc_array((len(observation.rows.channel), 0))

    def of(
        self, hypothesis: Hypothesis, signatures: Sequence[Array] | None = None
    ) -> tuple[csc_array, csc_array, csc_array]:
        """Return D of a hypothesis.

        Args:
            hypothesis: Effects as fitted.
            signatures: Its effects' `signatures`; None where they aren't known yet.

        Returns:
            Columns (N, M): what its models may be off, what they remember of the way to a place,
            and what drifts do between their knots.

        """
        rows, knots = self._observation.rows, self._unknowns.columns[:, :6]
        off, rough = [self._nothing], [self._nothing]
        each = self.signatures(hypothesis) if signatures is None else signatures
        for part, alone, one in zip(hypothesis.parts, each, hypothesis.effects, strict=True):
            record = record_of(part.effect)
            off.append(_columns(record.kappa * alone, self._parts(record)))
            if record.between_knots is not None:
                rough.append(record.between_knots(one, rows, knots))
        on_the_way = self._on_the_way(hypothesis.names, hypothesis.effects, each)
        return hstack(off, format="csc"), on_the_way, hstack(rough, format="csc")

    def all_of(self, hypothesis: Hypothesis) -> csc_array:
        """Return D of a hypothesis in one.

        Args:
            hypothesis: Effects as fitted.

        Returns:
            Columns (N, M).

        """
        return hstack(self.of(hypothesis), format="csc")

    def on_the_way(self, parts: Sequence[Candidate], values: Sequence[Array]) -> csc_array:
        """Return what effects may remember of the way to a place: columns for a fit of them.

        Args:
            parts: Forms of the effects.
            values: Numbers of each, about as large as they are.

        Returns:
            Columns (N, M), with unit priors; none for effects that remember nothing.

        """
        pairs = zip(parts, values, strict=True)
        remembering = [pair for pair in pairs if record_of(pair[0].effect).remembers]
        effects = [part.at(own) for part, own in remembering]
        each = [self._observation.change([effect]) for effect in effects]
        return self._on_the_way([part.effect for part, _ in remembering], effects, each)

    def _on_the_way(
        self, names: Sequence[str], effects: Sequence[Effect], each: Sequence[Array]
    ) -> csc_array:
        """Return what effects that remember may keep of the way to a place.

        Displacements of the tip until it was loaded, and what is kept from before a bag.
        """
        remembered = [self._nothing]
        for name, effect, alone in zip(names, effects, each, strict=True):
            record = record_of(name)
            if not record.remembers:
                continue
            remembered.append(self._until_loaded(alone))
            if record.before_bag is not None:
                zero = self._unknowns.columns[:, :6]
                remembered.append(record.before_bag(effect, self._observation, zero))
        return hstack(remembered, format="csc")

    def weigh(self, behind: Background, one: Hypothesis, none_cost: float) -> Weighed:
        """Weigh a hypothesis with what its models may be off beside it.

        Args:
            behind: Unknowns and tolerances.
            one: Effects as fitted.
            none_cost: F without effects.

        Returns:
            It, with D on the likeliest of a few scales.

        """
        signatures = self.signatures(one)
        parts = self.of(one, signatures)
        sizes = [part.shape[1] for part in parts]
        worth = _Worth(behind, hstack(parts, format="csc"), one.raw_rows)
        way, scale, log_rough = [float(size > 0) for size in sizes], 1.0, 0.0
        for k in (1, 0, 2):  # what is remembered is the most
            if sizes[k]:
                ways = [[*way[:k], own, *way[k + 1 :]] for own in _SCALES]
                each = [worth.at(np.repeat(other, sizes)) for other in ways]
                logs = np.array([gain - cost for gain, cost in each])
                way = ways[int(np.argmax(logs))]
                if k == 0:
                    weights = np.exp(logs - logs.max())
                    scale = float(np.sqrt(weights @ np.square(_SCALES) / weights.sum()))
                log_rough = float(logs.max() - logs[0]) if k == 2 else 0.0
        gain, cost = worth.at(np.repeat(way, sizes))
        cost += np.count_nonzero(sizes) * np.log(len(_SCALES))
        off, remembered, rough = (
            _telling(own * part) for own, part in zip(way, parts, strict=True)
        )
        off = hstack([off, remembered], format="csc")
        occam = 0.5 * (none_cost - one.cost) - one.log_bayes
        log_bayes = one.log_bayes + gain - cost
        left, occam = one.cost - 2.0 * gain, occam * _counted(one) + cost
        shown = [behind.left(signature) for signature in signatures]
        return Weighed(one, signatures, shown, off, rough, scale, left, occam, log_bayes, log_rough)

    def signatures(self, hypothesis: Hypothesis) -> list[Array]:
        """Return what each effect of a hypothesis changes of the rows beside the others.

        Less what the unknowns take of it, which shows nowhere. What a healthy arm's tolerances take
        stays: they take an effect's mean, and not what its model misses from piece to piece.

        Args:
            hypothesis: Effects as fitted.

        Returns:
            Changes in the rows' units, each (N,), in the effects' order.

        """
        return [self._unknowns.left(one) for one in hypothesis.changes(self._observation)]

    def varying(self, behind: Background, of: Weighed) -> list[Structure]:
        """Return the evidence that each effect's size changes as another effect's would.

        Less what the other effects' models may miss there (`looks_like`).

        Args:
            behind: All that was fitted.
            of: Effects as fitted.

        Returns:
            One for each effect, in their order.

        """
        out = []
        for k, (part, whole) in enumerate(zip(of.hypothesis.parts, of.signatures, strict=True)):
            record = record_of(part.effect)
            columns = _columns(whole, self._parts(record))
            worth = _Worth(behind, columns, of.hypothesis.raw_rows)
            gain, cost = worth.at(np.ones(columns.shape[1]))
            log = gain - cost - _ANOTHER_MODEL[record.known]
            log *= 1.0 - of.looks_like(of.shown[k], k)
            out.append(Structure(f"size of {part.effect}, by time and load", log, 2.0 * gain))
        return out

    def _parts(self, record: DiagnosedEffect) -> np.ndarray:
        if record.by_second:
            return self._by_second
        return self._push_by_second if record.remembers else self._pieces

    def _until_loaded(self, signature: Array) -> csc_array:
        """Return the tip's displacements until it was loaded, as large as signature (N,)."""
        scale = self._observation.rows.scale
        size = np.abs(signature * scale)
        values = [np.max(size[own]) / scale[before] for own, before in self._unloaded]
        columns = np.repeat(np.arange(len(values)), [len(one) for one in values])
        rows = [before for _, before in self._unloaded]
        return csc_array(
            (np.concatenate([*values, []]), (np.concatenate([*rows, []]).astype(int), columns)),
            shape=(len(scale), len(values)),
        )


def _pieces(rows: ResidualRows, by_second: Sequence[str] = ()) -> np.ndarray:
    """Return the parts (3, N) that each row is in, numbered together.

    by_second: bags whose pieces are of a second, not as in `_PIECES`.
    """
    piece = np.zeros(len(rows.channel), dtype=np.int64)
    for number, name in enumerate(BAGS):
        here = rows.bag == number
        if name in by_second:
            piece[here] = np.floor(rows.bag_s[here]).astype(np.int64)
        else:
            _, block = np.unique(rows.block[here], return_inverse=True)
            count = block.max(initial=0) + 1
            piece[here] = block * min(_PIECES[name], count) // count
    loaded = np.isin(rows.regime, _LOADED)
    group = rows.channel // 3
    first = ((piece * 2 + loaded) * len(BAGS) + rows.bag) * len(CHANNELS) + group
    second = rows.bag * len(CHANNELS) + rows.channel
    _, first = np.unique(first, return_inverse=True)
    _, second = np.unique(second, return_inverse=True)
    second = second + first.max(initial=0) + 1
    return np.stack([first, second, np.full_like(second, second.max(initial=0) + 1)])


def _columns(signature: Array, of: np.ndarray) -> csc_array:
    acts = np.flatnonzero(signature)
    parts, column = np.unique(of[:, acts], return_inverse=True)
    values = np.tile(signature[acts] / np.sqrt(len(of)), len(of))
    where = np.tile(acts, len(of)), column.ravel()
    return csc_array((values, where), shape=(len(signature), len(parts)))


_ENOUGH = 0.2


def _before_loads(observation: Observation) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield rows of the tip at each place, in each of its axes, and those until it was loaded.

    Until each axis of the load was at _ENOUGH of its largest; nothing where nothing was pushed.
    """
    rows = observation.rows
    first = CHANNELS.index(TIP_AXES[0])
    tip = (rows.bag == BAGS.index("push")) & (rows.channel >= first)
    tip &= (rows.channel < first + len(TIP_AXES)) & (rows.pose >= 0)
    if not tip.any():
        return
    at_s, load = observation.applied_load("push")
    for place in np.unique(rows.pose[tip]):
        here = np.flatnonzero(tip & (rows.pose == place))
        for axis in np.abs(load[:, :3]).T:
            size = np.interp(rows.bag_s[here], at_s, axis)
            loaded = rows.bag_s[here[size > _ENOUGH * size.max()]]
            before = here[rows.bag_s[here] < loaded.min(initial=np.inf)]
            for channel in np.unique(rows.channel[before]):
                yield here[rows.channel[here] == channel], before[rows.channel[before] == channel]
