"""Fitting physics with hysteresis, and a small recurrent network for what that leaves: if it helps.

`joint_hysteresis` is fitted first; the network learns its residual from the wrench at the tip and
from what the physics predicts. It is not told the joints: with a handful of positions it would
learn these by heart. It has few units, much dropout, decaying weights, and stops early.

Whether it helps is asked on positions that neither has seen. Each position in turn is left out, and
physics and network are fitted to the others; the network's number of iterations is what was best
for the *other* positions when these were left out, none being one of the choices. It is kept if it
takes off the mean square error on the positions left out, noise and all,

- a share of at least LEAST_SHARE, and
- more than two standard errors of that, from how the positions differ.

Else, or with fewer than FEWEST_POSITIONS, the model is the physics alone, predicts exactly as it,
and its notes say why. The errors on the positions left out are also the uncertainty of a model with
a network, and with those it holds between the positions, as the physics does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from galen_model.arrays import Array

from galen_deflection.errors import FitError
from galen_deflection.measurement.samples import DeflectionSamples, check_to_fit
from galen_deflection.models import joint_hysteresis
from galen_deflection.models.fit_settings import FitSettings
from galen_deflection.models.fitted_range import SMALLEST_MARGIN
from galen_deflection.models.least_squares import beyond_noise
from galen_deflection.models.linear import LinearModel
from galen_deflection.networks.network import Network
from galen_deflection.networks.recurrent import (
    RecurrentSettings,
    Series,
    TrainingError,
    train,
)
from galen_deflection.networks.recurrent_net import RecurrentNet
from galen_deflection.networks.residual_model import (
    INPUTS,
    KIND,
    OUTPUTS,
    ResidualModel,
    inputs_of,
)
from galen_deflection.networks.sequences import products, run, sequences
from galen_deflection.networks.training_curve import TrainingCurve

SETTINGS = RecurrentSettings(
    hidden=8, dropout=0.1, iterations=120, learning_rate=0.03, weight_decay=0.05
)

PERIOD_S = 0.04

FEWEST_POSITIONS = 3

LEAST_SHARE = 0.05

_STANDARD_ERRORS = 2.0


def fit(samples: DeflectionSamples, settings: FitSettings | None = None) -> ResidualModel:
    """Fit the physics, and train the network if it helps; raises FitError."""
    settings = settings or FitSettings()
    used = settings.used(len(samples))
    check_to_fit(samples, used)
    physics = joint_hysteresis.fit(samples, settings)
    positions = np.unique(samples.position[used])
    if len(positions) < FEWEST_POSITIONS:
        return _without(
            physics,
            None,
            f"whether one helps on positions that it hasn't seen takes {FEWEST_POSITIONS} "
            f"positions to tell, and these samples have {len(positions)}",
        )
    try:
        return _with_network(_Question(samples, used, settings), physics, positions)
    except TrainingError as error:
        raise FitError(f"{KIND}: {error}") from error


def _with_network(
    question: _Question, physics: LinearModel, positions: np.ndarray
) -> ResidualModel:
    trials = []
    for k, position in enumerate(positions):
        try:
            trials.append(question.without(position, k, len(positions)))
        except FitError as error:
            return _without(physics, None, f"without position {position}, {error}")
    squares = np.array([trial.squares for trial in trials])
    curve = _together(trials)
    asked = [_Asked.of(question, trial, squares, k) for k, trial in enumerate(trials)]
    before = np.array([np.trace(one.before) for one in asked])
    gain = (before - [np.trace(one.after) for one in asked]) / before.mean()
    share, spread = gain.mean(), gain.std(ddof=1) / np.sqrt(len(gain))
    iterations = int(np.argmin(squares.mean(axis=0)))
    found = (
        f"on positions left out it takes {100.0 * share:.1f} +- {100.0 * spread:.1f} % off the "
        "mean square error"
    )
    if iterations == 0 or share < LEAST_SHARE or share <= _STANDARD_ERRORS * spread:
        wanted = f"{100.0 * LEAST_SHARE:.0f} % and {_STANDARD_ERRORS:.0f} standard errors"
        return _without(physics, curve, f"{found}, and must take off more than {wanted}")
    square = np.mean([one.after for one in asked], axis=0)
    discrepancy = beyond_noise(square, question.samples.noise)
    net = question.trained(physics, question.used, iterations)
    return ResidualModel(
        replace(physics, discrepancy=discrepancy),
        Network(net, PERIOD_S, INPUTS, OUTPUTS),
        curve,
        (*physics.notes, f"with a network: {found}"),
    )


class _Trial(NamedTuple):
    """Physics fitted without a position, and how a network's training beside it went.

    squares (iterations + 1,): mean square error over noise on the position, from none on.
    """

    physics: LinearModel
    rest: np.ndarray
    there: np.ndarray
    curve: TrainingCurve
    squares: Array


class _Question:
    """What there is to learn from, and how."""

    def __init__(self, samples: DeflectionSamples, used: np.ndarray, settings: FitSettings) -> None:
        self.samples, self.used, self._settings = samples, used, settings
        self._network = replace(
            SETTINGS, seed=settings.seed, iterations=settings.iterations or SETTINGS.iterations
        )
        self._least = np.concatenate([0.1 * SMALLEST_MARGIN, samples.noise])

    def without(self, position: int, done: int, total: int) -> _Trial:
        """Leave a position out, the `done`th of `total`; raises FitError, TrainingError."""
        there = self.used & (self.samples.position == position)
        rest = self.used & ~there
        physics = joint_hysteresis.fit(self.samples, replace(self._settings, use=rest))
        told = self._settings.on_progress

        def on_progress(now: int, last: int) -> None:
            if told is not None:
                told(done * last + now, total * last, f"{KIND}: positions left out")

        held_out = self._series(physics, there)
        _, curve = train(
            self._series(physics, rest),
            self._network,
            held_out=held_out,
            unit=self.samples.noise,
            least=self._least,
            on_progress=on_progress,
        )
        targets = np.concatenate([s.targets[s.use] for s in held_out]) / self.samples.noise
        squares = np.array([np.mean(targets**2), *np.square(curve.check_loss)])
        return _Trial(physics, rest, there, curve, squares)

    def trained(self, physics: LinearModel, rows: np.ndarray, iterations: int) -> RecurrentNet:
        """The network for what a physics leaves of some rows (n,)."""
        settings = replace(self._network, iterations=iterations)
        series = self._series(physics, rows)
        return train(series, settings, unit=self.samples.noise, least=self._least)[0]

    def _series(self, physics: LinearModel, rows: np.ndarray) -> list[Series]:
        mean = physics.predict(self.samples).mean
        left = self.samples.deflection - mean
        return sequences(self.samples, inputs_of(self.samples, mean), left, rows, PERIOD_S)


class _Asked(NamedTuple):
    """Residuals' products (6, 6) over noise on a position left out: of physics, and with a network.

    The network's iterations are chosen on the other positions.
    """

    before: Array
    after: Array

    @classmethod
    def of(cls, question: _Question, trial: _Trial, squares: Array, k: int) -> _Asked:
        """Of the k-th trial; squares (positions, iterations + 1): of all."""
        samples = question.samples
        mean = trial.physics.predict(samples).mean
        before = products(samples, mean, trial.there)
        iterations = int(np.argmin(np.delete(squares, k, axis=0).mean(axis=0)))
        if iterations == 0:
            return cls(before, before)
        net = question.trained(trial.physics, trial.rest, iterations)
        added = run(net, samples, inputs_of(samples, mean), PERIOD_S)
        return cls(before, products(samples, mean + added, trial.there))


def _without(physics: LinearModel, curve: TrainingCurve | None, why: str) -> ResidualModel:
    return ResidualModel(physics, None, curve, (*physics.notes, f"no network: {why}"))


def _together(trials: Sequence[_Trial]) -> TrainingCurve:
    """The root mean square of the trials' curves."""
    training, check = (
        np.sqrt(np.mean(np.square([getattr(trial.curve, name) for trial in trials]), axis=0))
        for name in ("training_loss", "check_loss")
    )
    best = int(np.argmin(check))
    return TrainingCurve(tuple(training.tolist()), tuple(check.tolist()), best)
