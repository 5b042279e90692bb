"""Recurrent networks for a joint's lag: the report's, its variant, and a residual on physics.

All see torque, motor's angle and its velocity, from a run's first reading on; the residual's also
what the physical model predicts. It learns what that model, fitted to the other parts, leaves of
each part, and is only kept if it helps on parts that it has not been trained on either.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from galen_model.arrays import Array

from galen_deflection.networks.recurrent import RecurrentSettings, Series, train
from galen_deflection.networks.recurrent_net import RecurrentNet
from galen_deflection.transmission.parts import Parts
from galen_deflection.transmission.runs import Run
from galen_deflection.transmission.terms import velocity

_RESIDUAL_HIDDEN = 6
_RESIDUAL_DECAY = 0.01
_WORTH_IT = 0.01

NETWORKS = {
    "LSTM": "the report's network: 18 LSTM units, a fully connected layer",
    "LSTM direct": "the variant that its authors suggest: no fully connected layer",
}


@dataclass(frozen=True)
class NetworkSettings:
    """iterations: of the report's network; the residual's training has half of them."""

    iterations: int = 150
    seed: int = 0

    def of(self, name: str) -> RecurrentSettings:
        """Of one of NETWORKS."""
        return RecurrentSettings(
            iterations=self.iterations, seed=self.seed, direct=name == "LSTM direct"
        )

    @property
    def residual(self) -> RecurrentSettings:
        """Of the residual."""
        return RecurrentSettings(
            hidden=_RESIDUAL_HIDDEN,
            weight_decay=_RESIDUAL_DECAY,
            iterations=max(1, self.iterations // 2),
            seed=self.seed,
        )


class Residual(NamedTuple):
    """What is added to physics for each run (n,), rad; zeros if it was not kept."""

    added: list[Array]
    kept: bool


def inputs_of(run: Run, window_s: float) -> Array:
    """What every network sees (n, 3): torque, motor's angle, its velocity."""
    return np.stack([run.torque, run.motor, velocity(run, window_s)], axis=1)


def predicted(
    inputs: Sequence[Array],
    lags: Sequence[Array],
    used: Sequence[np.ndarray],
    settings: RecurrentSettings,
    on_step: Callable[[], None],
) -> list[Array]:
    """Lags (n,) of each run by a network trained on the used readings; raises TrainingError."""
    net = _trained(inputs, lags, used, settings, on_step)
    return [net.predict(x)[:, 0] for x in inputs]


def residual(
    inputs: Sequence[Array],
    left: Sequence[Array],
    parts: Parts,
    trained_on: Sequence[int],
    settings: RecurrentSettings,
    on_step: Callable[[], None],
) -> Residual:
    """The recurrent residual, from what physics leaves (n,) of each run's readings in `trained_on`.

    It is tried on each of these parts by a network that was trained on the others.
    """
    before, after = 0.0, 0.0
    for part in trained_on:
        others = parts.rows([k for k in trained_on if k != part])
        outputs = predicted(inputs, left, others, settings, on_step)
        for output, remains, some in zip(outputs, left, parts.rows([part]), strict=True):
            before += float(np.sum(remains[some] ** 2))
            after += float(np.sum((remains[some] - output[some]) ** 2))
    if after > (1.0 - _WORTH_IT) ** 2 * before:
        return Residual([np.zeros(len(x)) for x in inputs], kept=False)
    added = predicted(inputs, left, parts.rows(trained_on), settings, on_step)
    return Residual(added, kept=True)


def _trained(
    inputs: Sequence[Array],
    lags: Sequence[Array],
    used: Sequence[np.ndarray],
    settings: RecurrentSettings,
    on_step: Callable[[], None],
) -> RecurrentNet:
    series = [
        Series(x, lag[:, None], some)
        for x, lag, some in zip(inputs, lags, used, strict=True)
        if some.any()
    ]
    return train(series, settings, on_progress=lambda done, total: on_step())[0]
