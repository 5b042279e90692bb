"""Training of a small recurrent regressor with PyTorch, over any inputs and outputs.

Every iteration goes through all sequences from their first sample to their last, back through all
of it, and takes one step of Adam (D. Kingma, J. Ba, 2015): with the six sequences of the report's
training sets its 150 iterations are MATLAB's, whose `trainNetwork` puts up to 128 whole sequences
into one mini-batch. Nothing is truncated: six sequences of 4000 samples cost 0.1 s an iteration
on one core. The weights begin as MATLAB's do: Glorot at the inputs, orthogonal at the state, one
for the forget gate's bias.

`direct` leaves out the fully connected layer: the LSTM's own projection (PyTorch's `proj_size`;
H. Sak et al., 2014) gives the outputs, and these, not the hidden units, go back into the gates. As
that is an LSTM whose matrix of the state is a product W_back W_out, it is calculated as one:
PyTorch's own way takes ten times longer and more.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from galen_model.arrays import Array
from galen_model.errors import GalenError

from galen_deflection.networks import NEEDS
from galen_deflection.networks.network import TrainingCurve
from galen_deflection.networks.recurrent_net import RecurrentNet, Scaling, Weights


class TrainingError(GalenError):
    """A network that can't be trained; the message says why."""


class Series(NamedTuple):
    """A sequence: inputs (t, n_in), targets (t, n_out), use (t,) bool.

    Where `use` is false the target is not looked at and may be anything; the inputs still count for
    what the network remembers.
    """

    inputs: Array
    targets: Array
    use: np.ndarray


@dataclass(frozen=True)
class RecurrentSettings:
    """Of a network and its training.

    direct: no fully connected layer. dropout: share of the hidden units' outputs that are left out
    at random, before the outputs are made of them. gradient_limit: the norm of a gradient is cut to
    it. seed: of weights and dropout.
    """

    hidden: int = 18
    dropout: float = 0.05
    iterations: int = 150
    direct: bool = False
    learning_rate: float = 0.02
    gradient_limit: float = 1.0
    seed: int = 0


def train(
    series: Sequence[Series],
    settings: RecurrentSettings,
    *,
    held_out: Sequence[Series] = (),
    unit: Array | None = None,
    least: Array | None = None,
    on_progress: Callable[[int, int], None] | None = None,
) -> tuple[RecurrentNet, TrainingCurve]:
    """Train on `series`; of `held_out` nothing is learnt, but its best iteration is kept.

    Without `held_out` the last iteration is. The standardisation is of the used samples of `series`
    alone. unit (n_out,): what an error is measured by, in the targets' units; None for the targets'
    standard deviations. least (n_in,): what inputs are standardised by is not smaller, in their
    units; None for no such limit. on_progress(done, total): told after every iteration. The same
    seed gives the same network on the same machine. Raises TrainingError.
    """
    torch = _torch()
    _check(series, held_out)
    inputs = Scaling.of(np.concatenate([s.inputs[s.use] for s in series]), least)
    outputs = Scaling.of(np.concatenate([s.targets[s.use] for s in series]))
    weight = outputs.scale / (outputs.scale if unit is None else unit)
    with _alone(torch, settings.seed):
        net = _Net(torch, len(inputs.mean), len(outputs.mean), settings)
        measure = _Measure(torch, weight)
        learnt = [_padded(torch, group, inputs, outputs) for group in _alike(series)]
        checked = [_padded(torch, group, inputs, outputs) for group in _alike(held_out)]
        best, curve = _descend(torch, net, measure, learnt, checked, settings, on_progress)
    return RecurrentNet(best, inputs, outputs), curve


def _descend(
    torch: Any,
    net: _Net,
    measure: _Measure,
    learnt: list[_Batch],
    checked: list[_Batch],
    settings: RecurrentSettings,
    on_progress: Callable[[int, int], None] | None,
) -> tuple[Weights, TrainingCurve]:
    optimiser = torch.optim.Adam(net.parameters, lr=settings.learning_rate)
    training, check = [], []
    best, kept = 0, net.weights()
    for iteration in range(settings.iterations):
        optimiser.zero_grad()
        training.append(measure.learn(net, learnt))
        torch.nn.utils.clip_grad_norm_(net.parameters, settings.gradient_limit)
        optimiser.step()
        if not np.isfinite(training[-1]):
            raise TrainingError(
                f"training went astray at iteration {iteration + 1}, with a learning rate of "
                f"{settings.learning_rate:g}: the loss is {training[-1]}"
            )
        if checked:
            check.append(measure.loss(net, checked))
        if not checked or check[-1] <= min(check):
            best, kept = iteration, net.weights()
        if on_progress is not None:
            on_progress(iteration + 1, settings.iterations)
    return kept, TrainingCurve(tuple(training), tuple(check), best)


class _Batch(NamedTuple):
    """Sequences side by side, standardised: (t, b, n_in), (t, b, n_out), used (t, b, 1)."""

    inputs: Any
    targets: Any
    used: Any
    samples: int


class _Net:
    """The layers while they are trained."""

    def __init__(self, torch: Any, inputs: int, outputs: int, settings: RecurrentSettings) -> None:
        self._torch, self._dropout, self._direct = torch, settings.dropout, settings.direct
        hidden = settings.hidden
        self._lstm = torch.nn.LSTM(inputs, hidden)
        self._out = torch.nn.Linear(hidden, outputs, bias=not settings.direct)
        self._back = torch.nn.Parameter(torch.zeros(4 * hidden, outputs))
        torch.nn.init.xavier_uniform_(self._lstm.weight_ih_l0)
        torch.nn.init.orthogonal_(self._lstm.weight_hh_l0)
        torch.nn.init.xavier_uniform_(self._back)
        torch.nn.init.xavier_uniform_(self._out.weight)
        with torch.no_grad():
            # PyTorch has two biases that are only ever added up
            self._lstm.bias_hh_l0.zero_().requires_grad_(False)
            self._lstm.bias_ih_l0.zero_()[hidden : 2 * hidden] = 1.0
            if not settings.direct:
                self._out.bias.zero_()
        state = self._back if settings.direct else self._lstm.weight_hh_l0
        self.parameters = [
            self._lstm.weight_ih_l0, state, self._lstm.bias_ih_l0, *self._out.parameters()
        ]  # fmt: skip

    def __call__(self, inputs: Any, training: bool) -> Any:
        lstm = self._lstm
        if self._direct:
            swapped = {"weight_hh_l0": self._back @ self._out.weight}
            hidden = self._torch.func.functional_call(lstm, swapped, (inputs,))[0]
        else:
            hidden = lstm(inputs)[0]
        return self._out(self._torch.nn.functional.dropout(hidden, self._dropout, training))

    def weights(self) -> Weights:
        """A copy, as it is run."""
        with self._torch.no_grad():
            state = self._lstm.weight_hh_l0
            if self._direct:
                state = self._back @ self._out.weight
            out = np.zeros(len(self._out.weight), np.float32)
            return Weights(
                w_in=self._lstm.weight_ih_l0.numpy().copy(),
                w_state=state.numpy().copy(),
                bias=self._lstm.bias_ih_l0.numpy().copy(),
                w_out=self._out.weight.numpy().copy(),
                bias_out=out if self._direct else self._out.bias.numpy().copy(),
            )


class _Measure:
    """Root mean square errors, each output in units that matter."""

    def __init__(self, torch: Any, weight: Array) -> None:
        self._torch = torch
        self._weight = torch.tensor(weight, dtype=torch.float32)
        # Adam does not care for the loss's size, but the limit of the gradient does
        self._size = float(np.mean(weight**2))

    def learn(self, net: _Net, batches: list[_Batch]) -> float:
        """Add up the gradients of the batches; the root mean square error."""
        used = sum(batch.samples for batch in batches)
        total = 0.0
        for batch in batches:
            square = self._square(net, batch, training=True) / used
            (square / self._size).backward()
            total += float(square.detach())
        return float(np.sqrt(total))

    def loss(self, net: _Net, batches: list[_Batch]) -> float:
        """The root mean square error, without dropout."""
        used = sum(batch.samples for batch in batches)
        with self._torch.no_grad():
            total = sum(float(self._square(net, batch, training=False)) for batch in batches)
        return float(np.sqrt(total / used))

    def _square(self, net: _Net, batch: _Batch, training: bool) -> Any:
        error = (net(batch.inputs, training) - batch.targets) * self._weight * batch.used
        return error.square().sum() / len(self._weight)


def _alike(series: Sequence[Series]) -> Iterator[list[Series]]:
    """Groups of similar lengths: beside a long sequence, short ones would be mostly padding."""
    left = sorted(series, key=lambda s: len(s.inputs))
    while left:
        longest = len(left[-1].inputs)
        first = next(k for k, s in enumerate(left) if 2 * len(s.inputs) >= longest)
        yield left[first:]
        left = left[:first]


def _padded(torch: Any, group: list[Series], inputs: Scaling, outputs: Scaling) -> _Batch:
    longest = len(group[-1].inputs)
    x = np.zeros((longest, len(group), len(inputs.mean)), np.float32)
    y = np.zeros((longest, len(group), len(outputs.mean)), np.float32)
    used = np.zeros((longest, len(group), 1), np.float32)
    for k, one in enumerate(group):
        size = len(one.inputs)
        x[:size, k] = inputs.apply(one.inputs)
        # what is not used may be NaN, which no mask of zeros would take away
        y[:size, k][one.use] = outputs.apply(one.targets[one.use])
        used[:size, k, 0] = one.use
    tensors = [torch.from_numpy(a) for a in (x, y, used)]
    return _Batch(tensors[0], tensors[1], tensors[2], int(used.sum()))


def _check(series: Sequence[Series], held_out: Sequence[Series]) -> None:
    for which, several in (("to train on", series), ("held out", held_out)):
        if several and not any(s.use.any() for s in several):
            raise TrainingError(f"of the sequences {which}, no sample may be used")
        for k, one in enumerate(several):
            if not np.isfinite(one.inputs).all() or not np.isfinite(one.targets[one.use]).all():
                raise TrainingError(f"sequence {k} {which} holds values that aren't finite")
    if not series:
        raise TrainingError("there are no sequences to train on")


def _torch() -> Any:
    try:
        import torch
    except ImportError as error:
        raise TrainingError(f"training a network {NEEDS}") from error
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
