# SPDX-License-Identifier: Apache-2.0
"""Training of the 2019 report's network (section 2.3.6) with PyTorch.

The report: one LSTM layer of 18 hidden units, dropout 0.05, a fully connected layer to the six axes
of the deflection, 150 iterations, from the force sensor's wrench and the joints. What it leaves
open is chosen so that the network does as well as it can:

- the wrench is taken to the tip and into base_link, where the deflection is, so that the network
  need not learn the arm's kinematics;
- the error is measured in units of the tracker's noise, as the scores are;
- the learning rate is the best of those tried on simulated pushes (README);
- a first network is trained with a part of the repetitions held out. How many iterations were best
  for these, the final one is trained for, on everything. The errors on what was held out are also
  the prediction's uncertainty.

Every iteration goes through all sequences from their first sample to their last, back through all
of it, and takes one step of Adam (D. Kingma, J. Ba, 2015): with the six sequences of the report's
training sets its 150 iterations are MATLAB's, whose `trainNetwork` puts up to 128 whole sequences
into one mini-batch. Nothing is truncated: six sequences of 4000 samples cost 0.1 s an iteration
on one core. The weights begin as MATLAB's do: Glorot at the inputs, orthogonal at the state, one
for the forget gate's bias.

A network knows nothing of the arm's geometry: away from the positions that it was trained at its
predictions are `extrapolated`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from galen_model.arrays import Array

from galen_deflection.measurement.samples import DeflectionError, DeflectionSamples, check_to_fit
from galen_deflection.models.interface import (
    SMALLEST_MARGIN,
    FitSettings,
    FittedRange,
    fitted_on,
    nearby,
)
from galen_deflection.models.least_squares import beyond_noise, blocks
from galen_deflection.models.network import (
    LSTM,
    NetworkModel,
    PacedNet,
    RecurrentNet,
    Scaling,
    weight_shapes,
)
from galen_deflection.models.springs import tip_wrench

NEEDS = "needs PyTorch: `make networks` installs it"
"""The remedy where it is missing."""

PERIOD_S = 0.04
"""A step of the network. A hand's pushes take a second; at the tracker's own 60 to 100 Hz a push
would be a hundred steps to look back over."""

_HELD_OUT_SHARE = 0.25


@dataclass(frozen=True)
class TrainingSettings:
    """Of a network and its training.

    dropout: share of the hidden units' outputs that are left out at random, before the outputs are
    made of them. gradient_limit: the norm of a gradient is cut to it. seed: of weights and dropout.
    """

    hidden: int = 18
    dropout: float = 0.05
    iterations: int = 150
    learning_rate: float = 0.02
    gradient_limit: float = 1.0
    seed: int = 0


class Series(NamedTuple):
    """A sequence: inputs (t, n_in), targets (t, n_out), use (t,) bool.

    Where `use` is false the target is not looked at and may be anything; the inputs still count for
    what the network remembers.
    """

    inputs: Array
    targets: Array
    use: np.ndarray


def fit_network(samples: DeflectionSamples, settings: FitSettings | None = None) -> NetworkModel:
    """Train the report's network.

    Args:
        samples: n samples to fit to.
        settings: which of them count, seed, most iterations, progress; None: the defaults.

    Returns:
        The model of the kind `lstm`, trained for as many iterations as were best for samples held
        out.

    Raises:
        DeflectionError: the samples can't be fitted to, no part of them can be held out, the
            training diverges, or PyTorch is missing.
        ValueError: `settings.use` is for another number of samples.

    """
    settings = settings or FitSettings()
    used = settings.used(len(samples))
    check_to_fit(samples, used)
    at_tip = tip_wrench(samples)
    inputs = np.hstack([at_tip, samples.joints])
    training = TrainingSettings(seed=settings.seed, iterations=settings.iterations)
    held = hold_out(samples, used)
    if not held.any():
        raise DeflectionError(f"{LSTM}: so few samples that no part of them can be held out")
    progress = settings.on_progress or (lambda done, total, what: None)

    # Of the inputs: a smaller load or way is nothing that a network should look at.
    least = 0.1 * np.concatenate([SMALLEST_MARGIN, nearby(samples.arm)])

    def part(rows: np.ndarray) -> list[Series]:
        return sequences(samples, inputs, rows, PERIOD_S)

    first, errors, best = train(
        part(used & ~held),
        training,
        held_out=part(held),
        unit=samples.noise,
        least=least,
        on_progress=lambda done, total: progress(done, total, f"{LSTM}: to see how long is best"),
    )
    final, _, _ = train(
        part(used),
        replace(training, iterations=best + 1),
        unit=samples.noise,
        least=least,
        on_progress=lambda done, total: progress(done, total, f"{LSTM}: on all samples"),
    )
    mean = np.empty_like(samples.deflection)
    for segment in samples.segments():
        mean[segment] = PacedNet(first, PERIOD_S).run(samples.stamp_ns[segment], inputs[segment])
    error = ((samples.deflection - mean) / samples.noise)[held]
    return NetworkModel(
        tip_m=samples.tip_m,
        net=final,
        period_s=PERIOD_S,
        discrepancy=beyond_noise(error.T @ error / len(error), samples.noise),
        noise=samples.noise,
        fitted_range=FittedRange.of(samples.joints[used], at_tip[used], True, samples.arm),
        fitted_on=fitted_on(samples.rows(used)),
        iterations=best + 1,
        held_out_error=errors[best],
        arm=samples.arm,
    )


# Sequences


def sequences(
    samples: DeflectionSamples, inputs: Array, use: np.ndarray, period_s: float
) -> list[Series]:
    """Return a sequence for each segment and phase, at one rate.

    Where samples come faster than the period, several sequences begin one after the other within
    the first period, so that every sample is learnt from, and as it will be run (`PacedNet`).
    Between samples inputs and targets are interpolated; a target counts if both its sides do.
    Sequences of which nothing counts are left out.

    Args:
        samples: n samples; their deflections are the targets.
        inputs: (n, k) of the samples, in their units.
        use: (n,) bool, the samples whose deflection counts.
        period_s: time between a sequence's steps, s.

    Returns:
        Sequences of k inputs and six targets (m, rad), in their units.

    """
    found = []
    for segment in samples.segments():
        time = (samples.stamp_ns[segment] - samples.stamp_ns[segment.start]) * 1e-9
        if len(time) < 2 or not use[segment].any():
            continue
        known = np.where(use[segment, None], samples.deflection[segment], np.nan)
        phases = max(1, round(period_s / float(np.median(np.diff(time)))))
        for phase in range(phases):
            at = np.arange(phase * period_s / phases, time[-1] + 1e-6, period_s)
            target = interpolated(at, time, known)
            use_target = np.asarray(np.isfinite(target).all(axis=1))
            if use_target.any():
                found.append(Series(interpolated(at, time, inputs[segment]), target, use_target))
    return found


def interpolated(at: Array, time: Array, values: Array) -> Array:
    """Interpolate values at other times, linearly; outside of `time` the ends' values hold.

    Args:
        at: (m,), s.
        time: (n,) increasing, at least two, s.
        values: (n, k) at `time`.

    Returns:
        (m, k); NaN where a side that counts is NaN.

    """
    after = np.clip(np.searchsorted(time, at), 1, len(time) - 1)
    share = np.clip((at - time[after - 1]) / (time[after] - time[after - 1]), 0.0, 1.0)[:, None]
    # a sample that is as good as hit needs no other side
    left = np.where(share > 1.0 - 1e-6, 0.0, (1.0 - share) * values[after - 1])
    right = np.where(share < 1e-6, 0.0, share * values[after])
    return left + right


def hold_out(samples: DeflectionSamples, used: np.ndarray) -> np.ndarray:
    """Choose about a quarter of the used samples, of positions that also remain.

    A training only checks itself on them. The last repetitions of positions that have several, as
    the report held out sets; of as many positions as make up at most a quarter. Where this finds
    none, the last quarter of each position's blocks, and at least one (blocks: as `least_squares`,
    about a push); nothing of a position that has only one.

    Args:
        samples: n samples.
        used: (n,) bool, those that count.

    Returns:
        (n,) bool, a part of `used`; all false where nothing can be held out.

    """
    held = np.zeros(len(samples), dtype=bool)
    most = _HELD_OUT_SHARE * np.count_nonzero(used)
    for position in np.unique(samples.position[used]):
        there = used & (samples.position == position)
        sets = np.unique(samples.set_number[there])
        last = there & (samples.set_number == sets[-1])
        if len(sets) > 1 and np.count_nonzero(held | last) <= most:
            held |= last
    if held.any():
        return held
    parts = [part for part in blocks(samples) if used[part].any()]
    places = np.array([samples.position[part.start] for part in parts])
    for position in np.unique(places):
        of_position = np.flatnonzero(places == position)
        if len(of_position) > 1:
            for k in of_position[-max(1, round(_HELD_OUT_SHARE * len(of_position))) :]:
                held[parts[k]] = used[parts[k]]
    return held


# Training


def train(
    series: Sequence[Series],
    settings: TrainingSettings,
    *,
    held_out: Sequence[Series] = (),
    unit: Array | None = None,
    least: Array | None = None,
    on_progress: Callable[[int, int], None] | None = None,
) -> tuple[RecurrentNet, list[float], int]:
    """Train on sequences, and keep the iteration that is best for others.

    The standardisation is of the used samples of `series` alone. The same seed gives the same
    network on the same machine.

    Args:
        series: to learn from.
        settings: the network's size and its training.
        held_out: nothing is learnt from these, but the iteration that is best for them is kept;
            none: the last one.
        unit: (n_out,), what an error is measured by; None: the targets' standard deviations.
        least: (n_in,), inputs are standardised by no less; None: no limit.
        on_progress: called after each iteration with the number done and the number of all.

    Returns:
        The network; root mean square errors over `unit` after each iteration, of `held_out` or else
        of `series`; the iteration that was kept, from 0.

    Raises:
        DeflectionError: there is nothing to learn from, a value is not finite, the training
            diverges, or PyTorch is missing.

    """
    torch = _torch()
    _check(series, held_out)
    inputs = Scaling.of(np.concatenate([s.inputs[s.use] for s in series]), least)
    outputs = Scaling.of(np.concatenate([s.targets[s.use] for s in series]))
    weight = outputs.scale / (outputs.scale if unit is None else unit)
    with _alone(torch, settings.seed):
        net = _Net(torch, len(inputs.mean), weight, settings)
        learnt = [_padded(torch, group, inputs, outputs) for group in _alike(series)]
        checked = [_padded(torch, group, inputs, outputs) for group in _alike(held_out)]
        optimiser = torch.optim.Adam(net.parameters, lr=settings.learning_rate)
        errors: list[float] = []
        best, kept = 0, net.weights()
        for iteration in range(settings.iterations):
            optimiser.zero_grad()
            error = net.learn(learnt)
            torch.nn.utils.clip_grad_norm_(net.parameters, settings.gradient_limit)
            optimiser.step()
            if not np.isfinite(error):
                raise DeflectionError(
                    f"{LSTM}: the training diverged at iteration {iteration + 1}, with a learning"
                    f" rate of {settings.learning_rate:g}: the loss is {error}"
                )
            errors.append(net.error(checked) if checked else error)
            if not checked or errors[-1] <= min(errors):
                best, kept = iteration, net.weights()
            if on_progress is not None:
                on_progress(iteration + 1, settings.iterations)
    return RecurrentNet(kept, inputs, outputs), errors, best


class _Net:
    """The layers while they are trained, and their errors: each output in units that matter."""

    def __init__(self, torch: Any, inputs: int, weight: Array, settings: TrainingSettings) -> None:
        self._torch, self._dropout = torch, settings.dropout
        hidden = settings.hidden
        self._lstm = torch.nn.LSTM(inputs, hidden)
        self._out = torch.nn.Linear(hidden, len(weight))
        torch.nn.init.xavier_uniform_(self._lstm.weight_ih_l0)
        torch.nn.init.orthogonal_(self._lstm.weight_hh_l0)
        torch.nn.init.xavier_uniform_(self._out.weight)
        with torch.no_grad():
            # PyTorch has two biases that are only ever added up
            self._lstm.bias_hh_l0.zero_().requires_grad_(False)
            self._lstm.bias_ih_l0.zero_()[hidden : 2 * hidden] = 1.0
            self._out.bias.zero_()
        self.parameters = [p for p in (*self._lstm.parameters(), *self._out.parameters())
                           if p.requires_grad]  # fmt: skip
        self._weight = torch.tensor(weight, dtype=torch.float32)
        # Adam does not care for the loss's size, but the limit of the gradient does
        self._size = float(np.mean(weight**2))

    def learn(self, batches: Sequence[Sequence[Any]]) -> float:
        """Add up the gradients of the batches; returns the root mean square error."""
        used = sum(float(batch[2].sum()) for batch in batches)
        total = 0.0
        for batch in batches:
            square = self._square(batch, training=True) / used
            (square / self._size).backward()
            total += float(square.detach())
        return float(np.sqrt(total))

    def error(self, batches: Sequence[Sequence[Any]]) -> float:
        """Return the root mean square error, without dropout."""
        used = sum(float(batch[2].sum()) for batch in batches)
        with self._torch.no_grad():
            total = sum(float(self._square(batch, training=False)) for batch in batches)
        return float(np.sqrt(total / used))

    def _square(self, batch: Sequence[Any], training: bool) -> Any:
        inputs, targets, used = batch
        hidden = self._torch.nn.functional.dropout(self._lstm(inputs)[0], self._dropout, training)
        error = (self._out(hidden) - targets) * self._weight * used
        return error.square().sum() / len(self._weight)

    def weights(self) -> dict[str, Array]:
        """Return a copy, as it is run."""
        lstm, out = self._lstm, self._out
        layers = (lstm.weight_ih_l0, lstm.weight_hh_l0, lstm.bias_ih_l0, out.weight, out.bias)
        names = weight_shapes(0, 0, 0)
        return {
            name: layer.detach().numpy().astype(float)
            for name, layer in zip(names, layers, strict=True)
        }


def _alike(series: Sequence[Series]) -> Iterator[list[Series]]:
    """Yield groups of similar lengths: short ones beside a long one would be mostly padding."""
    left = sorted(series, key=lambda s: len(s.inputs))
    while left:
        longest = len(left[-1].inputs)
        first = next(k for k, s in enumerate(left) if 2 * len(s.inputs) >= longest)
        yield left[first:]
        left = left[:first]


def _padded(torch: Any, group: list[Series], inputs: Scaling, outputs: Scaling) -> list[Any]:
    """Sequences side by side, standardised: (t, b, n_in), (t, b, n_out), used (t, b, 1)."""
    longest = len(group[-1].inputs)
    x = np.zeros((longest, len(group), len(inputs.mean)), np.float32)
    y = np.zeros((longest, len(group), len(outputs.mean)), np.float32)
    used = np.zeros((longest, len(group), 1), np.float32)
    for k, one in enumerate(group):
        size = len(one.inputs)
        x[:size, k] = inputs.apply(one.inputs)
        # what is not used may be NaN, which no mask of zeros would remove
        y[:size, k][one.use] = outputs.apply(one.targets[one.use])
        used[:size, k, 0] = one.use
    return [torch.from_numpy(a) for a in (x, y, used)]


def _check(series: Sequence[Series], held_out: Sequence[Series]) -> None:
    for which, several in (("to train on", series), ("held out", held_out)):
        if several and not any(s.use.any() for s in several):
            raise DeflectionError(f"{LSTM}: of the sequences {which}, no sample may be used")
        for k, one in enumerate(several):
            if not np.isfinite(one.inputs).all() or not np.isfinite(one.targets[one.use]).all():
                raise DeflectionError(
                    f"{LSTM}: sequence {k} {which} holds values that aren't finite"
                )
    if not series:
        raise DeflectionError(f"{LSTM}: there are no sequences to train on")


def _torch() -> Any:
    try:
        import torch
    except ImportError as error:
        raise DeflectionError(f"{LSTM}: training a network {NEEDS}") from error
    return torch


@contextmanager
def _alone(torch: Any, seed: int) -> Iterator[None]:
    """Draw from an own seed and work on one core; the caller's own are put back afterwards.

    A network of some dozen units is slower on more cores, and only on one the same every time.
    """
    threads = torch.get_num_threads()
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        torch.set_num_threads(1)
        try:
            yield
        finally:
            torch.set_num_threads(threads)
