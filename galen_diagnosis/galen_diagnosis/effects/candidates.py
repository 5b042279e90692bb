# SPDX-License-Identifier: Apache-2.0
"""The forms in which an effect is tried on a recording.

A candidate is an effect with everything chosen that isn't a number to fit (which axis, which joint,
where a cable is held), the numbers to fit, where a fit starts and how large they usually are. An
effect is likely as a whole: its forms share its probability.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from galen_model.arrays import Array
from galen_sim_driver.effects.effect import Effect

from galen_diagnosis.observation.observation import Observation

EffectsAt = Callable[[Array], Sequence[Effect]]


@dataclass(frozen=True)
class Candidate:
    """An effect in one form; `base` holds all of it but the free numbers.

    effect: its identity (`Effect.identity`), which of a joint's effects has the joint. free (p,):
    which of the effect's `vector` are fitted. start (p,): nothing or next to nothing is changed.
    typical (p,): prior standard deviations about it. probe (p,): steps of finite differences.
    columns (N, p): how the prediction changes, where that is known and linear. make: the effect
    with other numbers, where that isn't a matter of `vector`. inputs: the numbers are unknown loads
    beside the effect, which no simulator knows. linear: how many of the numbers, the first ones, do
    anything at the start, None for all. known: parameters whose interval isn't the fit's.
    bonus: log evidence for the form that isn't in the rows. model: which of the effect's, in words,
    where it has several. into: the candidate that a fit takes in
    its place, and where it begins, of the linear answer (p,). wider: it holds a smaller form, which
    is easier to see. limit_unit: of the numbers, that a specification's limits are in.
    """

    effect: str
    label: str
    base: Effect
    free: np.ndarray
    start: Array
    typical: Array
    probe: Array
    columns: Array | None = None
    make: Callable[[Array], Effect] | None = None
    inputs: bool = False
    linear: int | None = None
    known: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    bonus: float = 0.0
    model: str = ""
    into: Callable[[Array], tuple[Candidate, Array]] | None = None
    wider: bool = False
    limit_unit: float = 1.0

    @property
    def key(self) -> tuple[str, str]:
        """By which its columns are found."""
        return self.effect, self.label

    def unsimulated(self, values: Array) -> Array | float:
        """Return what these numbers add to the rows' prediction that no simulator knows.

        Args:
            values: The free numbers, (p,).

        Returns:
            Changes in the rows' units, (N,); 0 of a form without inputs.

        """
        if not self.inputs or self.columns is None:
            return 0.0
        return np.asarray(self.columns @ values)

    def jacobian(self, observation: Observation, effects: EffectsAt, values: Array) -> Array:
        """Return how the rows' prediction changes by the numbers.

        Forward differences with the steps `probe`, unless `columns` are known.

        Args:
            observation: What was measured.
            effects: Returns all of a hypothesis' effects with given numbers (p,) of this one.
            values: The free numbers, (p,).

        Returns:
            Columns in the rows' units over the numbers', (N, p).

        """
        if self.columns is not None:
            return self.columns
        here = observation.change(effects(values))
        columns = np.empty((len(here), len(values)))
        for k, step in enumerate(self.probe):
            moved = values.copy()
            moved[k] += step
            columns[:, k] = (observation.change(effects(moved)) - here) / step
        return columns

    def limits(self) -> tuple[Array, Array]:
        """Return the lowest and highest value of each free number."""
        if self.make is not None:
            return np.full(len(self.start), -np.inf), np.full(len(self.start), np.inf)
        low, high = _bounds(self.base)
        return low[self.free], high[self.free]

    def at(self, values: Array) -> Effect:
        """Return the effect with these numbers, kept within its bounds.

        Args:
            values: The free numbers, (p,), in the units of the effect's `fitted`.

        Returns:
            The effect; where `make` is given, what it makes of them.

        """
        if self.make is not None:
            return self.make(values)
        vector = self.base.vector()
        vector[self.free] = values
        return self.base.with_vector(np.clip(vector, *_bounds(self.base)))


def _bounds(effect: Effect) -> tuple[Array, Array]:
    low = np.concatenate([np.full(p.size, p.lower) for p in effect.fitted])
    high = np.concatenate([np.full(p.size, p.upper) for p in effect.fitted])
    return low, high


def plain_form(
    effect: Effect, label: str = "", free: np.ndarray | None = None, name: str | None = None
) -> Candidate:
    """Return an effect with numbers free, from what they are, of usual size.

    Args:
        effect: Its other numbers stay.
        label: Name of the form among the effect's.
        free: Which of its `vector` are free, (p,); None for all.
        name: Its identity; None for its own.

    Returns:
        The form, steps of differences a twentieth of the usual sizes.

    """
    vector = effect.vector()
    free = np.arange(len(vector)) if free is None else free
    typical = np.concatenate([p.typicals for p in effect.fitted])[free]
    own = effect.identity if name is None else name
    return Candidate(own, label, effect, free, vector[free], typical, 0.05 * typical)


def linear_form(
    base: Effect, label: str, columns: Array, typical: Array, name: str | None = None
) -> Candidate:
    """Return a form whose columns are known.

    Args:
        base: The effect without its numbers.
        label: Name of the form among the effect's.
        columns: How the rows' prediction changes by the numbers, (N, p).
        typical: Prior standard deviations of the numbers, (p,).
        name: The effect's identity; None for its own.

    Returns:
        The form; its fit begins at zero.

    """
    start = np.zeros(columns.shape[1])
    own = base.identity if name is None else name
    free = np.arange(len(start))
    return Candidate(own, label, base, free, start, typical, 0.1 * typical, columns)


def freed(one: Candidate, fitted: Candidate, common: int | None = None) -> Candidate:
    """Return a form whose fit has further numbers behind its own.

    Args:
        one: Form that is judged linearly, with p numbers.
        fitted: Form that a fit takes in its place; its first p numbers are those of `one`.
        common: Only so many of them are, and the others are fitted beside in another way.

    Returns:
        `one`, whose fit begins at its linear answer and the start of the further numbers.

    """

    def begun(values: Array) -> tuple[Candidate, Array]:
        known = values[:common]
        return fitted, np.concatenate([known, fitted.start[len(known) :]])

    return replace(one, into=begun)


def floats(vector: Array) -> tuple[float, ...]:
    """Return numbers as an effect's field holds them.

    Args:
        vector: Numbers, (p,).

    Returns:
        p floats.

    """
    return tuple(float(value) for value in vector)
