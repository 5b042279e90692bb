"""The report's network (section 2.3.6), and the variant that its authors suggest.

The report: one LSTM layer of 18 hidden units, dropout 0.05, a fully connected layer to the six axes
of the deflection, 150 iterations, from the force sensor's wrench and the joints. The variant
(section 2.3.6, last paragraph) has no fully connected layer.

It doesn't say more. What it leaves open is chosen so that the network does as well as it can:

- the wrench is taken to the tip and into base_link, where the deflection is, so that the network
  need not learn the arm's kinematics;
- the error is measured in units of the tracker's noise, as the scores are;
- the learning rate is the best of those tried on simulated pushes (README);
- a first network is trained with a part of the repetitions held out. How many iterations were best
  for these, the final one is trained for, on everything. The errors on what was held out are also
  the prediction's uncertainty.

A network knows nothing of the arm's geometry: away from the positions that it was trained at it
says that it extrapolates.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from galen_deflection.errors import FitError
from galen_deflection.measurement.samples import DeflectionSamples, check_to_fit
from galen_deflection.models.fitted_range import FittedRange
from galen_deflection.models.interface import FitSettings
from galen_deflection.models.least_squares import beyond_noise
from galen_deflection.models.linear import FittedOn
from galen_deflection.networks.network import (
    INPUTS,
    LEAST_SCALE,
    OUTPUTS,
    Network,
    NetworkModel,
)
from galen_deflection.networks.sequences import hold_out, products, run, sequences
from galen_deflection.networks.training import RecurrentSettings, Series, TrainingError, train
from galen_deflection.springs.springs import TipWrench

KIND = "lstm"
KIND_DIRECT = "lstm_direct"

SETTINGS = RecurrentSettings(hidden=18, dropout=0.05, iterations=150, learning_rate=0.02)
"""The report's; the learning rate is ours."""

DIRECT = replace(SETTINGS, direct=True, learning_rate=0.01)

PERIOD_S = 0.04
"""A step of the network. A hand's pushes take a second; at the tracker's own 60 to 100 Hz a push
would be a hundred steps to look back over."""


_SETTINGS = {KIND: SETTINGS, KIND_DIRECT: DIRECT}


def fit(kind: str, samples: DeflectionSamples, settings: FitSettings | None = None) -> NetworkModel:
    """Train the report's network (KIND) or its variant (KIND_DIRECT); raises FitError."""
    settings = settings or FitSettings()
    used = settings.used(len(samples))
    check_to_fit(samples, used)
    at_tip = TipWrench(samples.tip_m)(samples.joints, samples.wrench)
    inputs = np.hstack([at_tip, samples.joints])
    network = replace(
        _SETTINGS[kind],
        seed=settings.seed,
        iterations=settings.iterations or _SETTINGS[kind].iterations,
    )
    held = hold_out(samples, used)
    if not held.any():
        raise FitError(f"{kind}: so few samples that no part of them can be held out")
    told = settings.on_progress or (lambda done, total, what: None)

    def part(rows: np.ndarray) -> list[Series]:
        return sequences(samples, inputs, samples.deflection, rows, PERIOD_S)

    try:
        first, curve = train(
            part(used & ~held),
            network,
            held_out=part(held),
            unit=samples.noise,
            least=LEAST_SCALE,
            on_progress=lambda done, total: told(done, total, f"{kind}: to see how long is best"),
        )
        final, _ = train(
            part(used),
            replace(network, iterations=curve.best + 1),
            unit=samples.noise,
            least=LEAST_SCALE,
            on_progress=lambda done, total: told(done, total, f"{kind}: on all samples"),
        )
    except TrainingError as error:
        raise FitError(f"{kind}: {error}") from error
    square = products(samples, run(first, samples, inputs, PERIOD_S), held)
    return NetworkModel(
        name=kind,
        tip_m=samples.tip_m,
        network=Network(final, PERIOD_S, INPUTS, OUTPUTS),
        discrepancy=beyond_noise(square, samples.noise),
        noise=samples.noise,
        fitted_range=FittedRange.of(samples.joints[used], at_tip[used], only_nearby=True),
        fitted_on=FittedOn.of(samples.rows(used)),
        training=curve,
    )
