"""All models of a joint on the same readings held out.

Every model may look at the torque and at the motor's angle and velocity, from a run's first reading
up to now, and never at the link's angle; each runs through a whole run from a fresh start.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from galen_model.arrays import Array
from galen_model.transmission.joint_run import JointRun, LagNoise, noise_of
from galen_model.transmission.parts import Parts
from galen_model.transmission.terms import Scales, design, velocity

from galen_deflection.networks.training import RecurrentSettings, Series, train
from galen_deflection.transmission import joint_fit
from galen_deflection.transmission.joint_fit import FORMS, CellSums, fit_terms

OURS = "ours"
NETWORKS = ("LSTM", "LSTM direct")
"""The report's network; the variant that its authors suggest: no fully connected layer."""

_CONFIDENCE = 0.95
_DRAWS = 2000

Predictions = dict[str, list[Array]]
"""Lags (n,) of each run that each model predicts, each part by models that haven't seen it."""


@dataclass(frozen=True)
class JointSettings:
    """What is compared.

    common: terms that all models but the constant have (`terms.COMMON`). window_s: of the motor's
    velocity. standstill_rad_s: where its direction fades, or None as `Scales.of`. networks: train
    them as well. iterations: of the report's network.
    """

    common: tuple[str, ...] = ()
    window_s: float = 0.1
    standstill_rad_s: float | None = None
    networks: bool = False
    iterations: int = 150
    seed: int = 0


@dataclass(frozen=True)
class JointScore:
    """A model's errors on what it has not seen: rad, of the parts (p,), and of all.

    interval: 95 %, of `rmse`, parts drawn with replacement. share: rmse over the lag's standard
    deviation. seconds: to fit it, all parts together; None where that is nothing of its own.
    """

    rmse: float
    interval: tuple[float, float]
    share: float
    by_part: Array
    seconds: float | None


@dataclass(frozen=True)
class Comparison:
    """What came of it; scores by model, in the order of the table.

    lag_std: of all readings, rad. chosen: by part, the form that was `ours`. against: the better of
    the report's networks, and the RMSE of ours over that network's, with its 95 % interval; None
    without networks.
    """

    runs: list[JointRun]
    parts: Parts
    settings: JointSettings
    noise: LagNoise
    lag_std: float
    predictions: Predictions
    scores: dict[str, JointScore]
    chosen: tuple[str, ...]
    against: tuple[str, float, tuple[float, float]] | None


def compare(
    runs: list[JointRun],
    parts: Parts,
    settings: JointSettings | None = None,
    on_progress: Callable[[int, int, str], None] | None = None,
) -> Comparison:
    """Fit and check all models; on_progress(done, total, what) now and then.

    Raises FitError, or TrainingError where networks are wanted and can't be trained.
    """
    settings = settings or JointSettings()
    bench = _Bench(runs, parts, settings, on_progress)
    for part in range(len(parts.names)):
        bench.check(part)
    lag_std = float(np.std(np.concatenate([run.lag for run in runs])))
    draws = np.random.default_rng(settings.seed).integers(
        len(parts.names), size=(_DRAWS, len(parts.names))
    )
    squares = {name: _squares(runs, parts, lags) for name, lags in bench.predictions.items()}
    count = np.array([sum(some.sum() for some in parts.rows([k])) for k in range(len(parts.names))])
    return Comparison(
        runs=runs,
        parts=parts,
        settings=settings,
        noise=noise_of(runs),
        lag_std=lag_std,
        predictions=bench.predictions,
        scores={
            name: _score(square, count, draws, lag_std, bench.seconds.get(name))
            for name, square in sorted(squares.items(), key=lambda item: _place(item[0]))
        },
        chosen=tuple(bench.chosen),
        against=_against(squares, count, draws) if settings.networks else None,
    )


class _Bench:
    """Fits and predicts, part by part."""

    def __init__(
        self,
        runs: list[JointRun],
        parts: Parts,
        settings: JointSettings,
        on_progress: Callable[[int, int, str], None] | None,
    ) -> None:
        self._runs, self._parts, self._settings = runs, parts, settings
        self._on_progress = on_progress
        self._done, self._total = 0, _steps(parts, settings)
        self.predictions: Predictions = {}
        self.seconds: dict[str, float] = {}
        self.chosen: list[str] = []

    def check(self, part: int) -> None:
        """Predict one part by models that are fitted to those that stand apart from it."""
        runs, parts, settings = self._runs, self._parts, self._settings
        trained_on = parts.trained_on(part)
        started = time.monotonic()
        used = parts.rows(trained_on)
        scales = Scales.of(runs, used, settings.window_s, settings.standstill_rad_s)
        designs = [design(run, scales) for run in runs]
        sums = CellSums.of(runs, parts, designs)
        forms = [
            joint_fit.choose(form, sums, trained_on, settings.common)
            for form in FORMS
            if form.name != "common terms" or settings.common
        ]
        best = joint_fit.ours(forms)
        self.chosen.append(best.form.name)
        for chosen in forms:
            weights = fit_terms(sums, sums.of_parts(trained_on), chosen.terms)
            self._keep(chosen.form.name, part, [x @ weights for x in designs])
            if chosen is best:
                self._keep(OURS, part, [x @ weights for x in designs])
        self._spent(OURS, started)
        self._step(f"{parts.names[part]}: physics")
        if settings.networks:
            self._train_networks(part, trained_on)

    def _train_networks(self, part: int, trained_on: list[int]) -> None:
        """Train on torque, motor's angle and its velocity, from a run's first reading on."""
        runs, window_s = self._runs, self._settings.window_s
        inputs = [
            np.stack([run.torque, run.motor, velocity(run, window_s)], axis=1) for run in runs
        ]
        series = [
            Series(x, run.lag[:, None], some)
            for x, run, some in zip(inputs, runs, self._parts.rows(trained_on), strict=True)
            if some.any()
        ]
        for name in NETWORKS:
            started = time.monotonic()
            what = f"{self._parts.names[part]}: {name}"
            net, _ = train(
                series,
                RecurrentSettings(
                    iterations=self._settings.iterations,
                    seed=self._settings.seed,
                    direct=name == "LSTM direct",
                ),
                on_progress=lambda done, total: self._step(what),  # noqa: B023
            )
            self._spent(name, started)
            self._keep(name, part, [net.predict(x)[:, 0] for x in inputs])

    def _keep(self, name: str, part: int, lags: Sequence[Array]) -> None:
        rows = self._parts.rows([part])
        kept = self.predictions.setdefault(name, [np.full(len(run), np.nan) for run in self._runs])
        for all_of_run, lag, some in zip(kept, lags, rows, strict=True):
            all_of_run[some] = lag[some]

    def _spent(self, name: str, started: float) -> None:
        self.seconds[name] = self.seconds.get(name, 0.0) + time.monotonic() - started

    def _step(self, what: str) -> None:
        self._done += 1
        if self._on_progress is not None:
            self._on_progress(self._done, max(self._total, self._done), what)


def _place(name: str) -> int:
    """In the table: the forms, then what hold-outs choose of them, then networks."""
    order = [*(form.name for form in FORMS), OURS]
    return order.index(name) if name in order else len(order)


def _steps(parts: Parts, settings: JointSettings) -> int:
    count = len(parts.names)
    return count + (len(NETWORKS) * count * settings.iterations if settings.networks else 0)


def _squares(runs: Sequence[JointRun], parts: Parts, lags: Sequence[Array]) -> Array:
    """Sums of squared errors (p,) of the parts, rad^2."""
    return np.array(
        [
            sum(
                float(np.sum((lag[some] - run.lag[some]) ** 2))
                for run, lag, some in zip(runs, lags, parts.rows([part]), strict=True)
            )
            for part in range(len(parts.names))
        ]
    )


def _score(
    square: Array, count: Array, draws: np.ndarray, lag_std: float, seconds: float | None
) -> JointScore:
    rmse = float(np.sqrt(square.sum() / count.sum()))
    drawn = np.sqrt(square[draws].sum(axis=1) / count[draws].sum(axis=1))
    return JointScore(rmse, _interval(drawn), rmse / lag_std, np.sqrt(square / count), seconds)


def _against(
    squares: Mapping[str, Array], count: Array, draws: np.ndarray
) -> tuple[str, float, tuple[float, float]]:
    name = min(NETWORKS, key=lambda other: float(squares[other].sum()))
    mine, other = squares[OURS], squares[name]
    drawn = np.sqrt(mine[draws].sum(axis=1) / other[draws].sum(axis=1))
    return name, float(np.sqrt(mine.sum() / other.sum())), _interval(drawn)


def _interval(drawn: Array) -> tuple[float, float]:
    low, high = np.quantile(drawn, [0.5 - 0.5 * _CONFIDENCE, 0.5 + 0.5 * _CONFIDENCE])
    return float(low), float(high)
