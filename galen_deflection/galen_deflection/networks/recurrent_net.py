"""A trained recurrent network: one LSTM layer and a linear layer on it, in numpy.

With x the standardised inputs, h and c (hidden,) the state, and s the logistic function
(S. Hochreiter, J. Schmidhuber, *Long short-term memory*, Neural Computation 9, 1997, with the
forget gate of F. Gers et al., 2000; rows in PyTorch's order):

    (i, f, g, o) = W_in x + W_state h + b
    c' = s(f) c + s(i) tanh(g),   h' = s(o) tanh(c'),   y = W_out h' + b_out.

PyTorch only trains. One sample of a network this small takes it 0.4 ms, nearly all of which is the
calling; here it is a twentieth, and neither a stream nor the node has to load it.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np
from galen_model.arrays import Array

LONGEST_GAP_S = 1.0
"""Over a longer one nothing is interpolated, and it counts as one period."""

_LATE = 0.25
"""Share of the period by which a sample may come late and still be the next step."""


class Scaling(NamedTuple):
    """Standardisation: (value - mean) / scale."""

    mean: Array
    scale: Array

    @classmethod
    def of(cls, values: Array, least: Array | None = None) -> Scaling:
        """From training data (n, k); a constant column is only shifted.

        least (k,): a scale is not smaller, as that of an axis on which there was only rounding or
        noise would be.
        """
        scale = np.maximum(values.std(axis=0), 0.0 if least is None else least)
        # a constant's standard deviation is what rounding leaves
        constant = scale <= 1e-9 * np.abs(values).max(axis=0)
        return cls(values.mean(axis=0), np.where(constant, 1.0, scale))

    def apply(self, values: Array) -> Array:
        """Standardise (n, k) or (k,)."""
        return np.asarray((values - self.mean) / self.scale)

    def undo(self, values: Array) -> Array:
        """Back to units."""
        return np.asarray(values * self.scale + self.mean)


class State(NamedTuple):
    """What the network remembers: h and c (hidden,)."""

    h: Array
    c: Array


@dataclass(frozen=True)
class Weights:
    """In float32, of the shapes of `shapes`."""

    w_in: np.ndarray
    w_state: np.ndarray
    bias: np.ndarray
    w_out: np.ndarray
    bias_out: np.ndarray

    def tensors(self) -> dict[str, np.ndarray]:
        """By name."""
        return {f.name: getattr(self, f.name) for f in fields(self)}

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, np.ndarray]) -> Weights:
        """The other way; what is in the mapping beside them is left alone."""
        return cls(**{f.name: tensors[f.name] for f in fields(cls)})

    @staticmethod
    def shapes(inputs: int, hidden: int, outputs: int) -> dict[str, tuple[int, ...]]:
        """The shapes that belong to numbers of inputs, hidden units and outputs."""
        return {
            "w_in": (4 * hidden, inputs),
            "w_state": (4 * hidden, hidden),
            "bias": (4 * hidden,),
            "w_out": (outputs, hidden),
            "bias_out": (outputs,),
        }


class RecurrentNet:
    """A trained network with its standardisation."""

    def __init__(self, weights: Weights, inputs: Scaling, outputs: Scaling) -> None:
        """Scalings of n_in inputs and n_out outputs."""
        self.weights, self.inputs, self.outputs = weights, inputs, outputs
        self.hidden = weights.w_out.shape[1]
        w = {name: np.asarray(t, dtype=float) for name, t in weights.tensors().items()}
        # s(z) = (1 + tanh(z / 2)) / 2: one tanh for all gates
        half = np.full(4 * self.hidden, 0.5)
        half[2 * self.hidden : 3 * self.hidden] = 1.0
        self._w_in, self._w_state = half[:, None] * w["w_in"], half[:, None] * w["w_state"]
        self._bias = half * w["bias"]
        self._w_out, self._bias_out = w["w_out"], w["bias_out"]

    def start(self) -> State:
        """The state in which every sequence begins."""
        return State(np.zeros(self.hidden), np.zeros(self.hidden))

    def taken_in(self, inputs: Array) -> Array:
        """What inputs (n, n_in) add to the gates (n, 4 hidden): all of a sequence at once."""
        return np.asarray(self.inputs.apply(inputs) @ self._w_in.T + self._bias)

    def advanced(self, state: State, taken_in: Array) -> State:
        """The state after one more sample, of which `taken_in` (4 hidden,) is known."""
        n = self.hidden
        z = np.tanh(taken_in + self._w_state @ state.h)
        gate = 0.5 + 0.5 * z
        c = gate[n : 2 * n] * state.c + gate[:n] * z[2 * n : 3 * n]
        return State(gate[3 * n :] * np.tanh(c), c)

    def output(self, h: Array) -> Array:
        """Outputs (n, n_out) or (n_out,), in their units, of states h (n, hidden) or (hidden,)."""
        return self.outputs.undo(h @ self._w_out.T + self._bias_out)

    def step(self, state: State, inputs: Array) -> tuple[State, Array]:
        """Take one sample (n_in,): the state after it, and the outputs (n_out,)."""
        after = self.advanced(state, self.taken_in(inputs[None])[0])
        return after, self.output(after.h)

    def predict(self, inputs: Array) -> Array:
        """Outputs (n, n_out) for a whole sequence (n, n_in), from a fresh start."""
        state = self.start()
        h = np.empty((len(inputs), self.hidden))
        for k, taken_in in enumerate(self.taken_in(inputs)):
            state = self.advanced(state, taken_in)
            h[k] = state.h
        return self.output(h)


class _Moment(NamedTuple):
    """What the network knew at a stamp: its state, and what the inputs added to its gates."""

    stamp_ns: int
    state: State
    taken_in: Array


class PacedNet:
    """A network that steps by its samples' stamps. Starts fresh.

    A recurrent network knows no time, only steps: trained at 25 Hz and stepped at 500 Hz it would
    forget twenty times too fast. So every sample takes a step from the state of one training period
    before it, not from that of the sample before. At the training's own rate this is the ordinary
    way; at a rate k times as high it is k interleaved copies of the network, each at its own rate,
    of which every sample's output is as fresh as the sample. In between, the state of a period
    before is interpolated between those of its neighbours in time. Where samples lie further apart
    than the period, the steps between them get interpolated inputs.
    """

    def __init__(self, net: RecurrentNet, period_s: float) -> None:
        """period_s: of the network's training."""
        self._net = net
        self._period_ns = round(period_s * 1e9)
        self._past: deque[_Moment] = deque()

    def reset(self) -> None:
        """Forget what was."""
        self._past.clear()

    def run(self, stamp_ns: np.ndarray, inputs: Array) -> Array:
        """Outputs (n, n_out) of samples at stamps (n,) with inputs (n, n_in), one after another."""
        h = np.empty((len(stamp_ns), self._net.hidden))
        for k, taken_in in enumerate(self._net.taken_in(inputs)):
            h[k] = self._take(int(stamp_ns[k]), taken_in).h
        return self._net.output(h)

    def _take(self, stamp_ns: int, taken_in: Array) -> State:
        past = self._past
        if not past:
            past.append(_Moment(stamp_ns - self._period_ns, self._net.start(), taken_in))
        elif not 0 <= stamp_ns - past[-1].stamp_ns <= LONGEST_GAP_S * 1e9:
            # a jump, or too long a gap: it goes on from the last as if a period later
            last = past[-1]._replace(stamp_ns=stamp_ns - self._period_ns)
            past.clear()
            past.append(last)
        last = past[-1]
        steps = max(1, math.ceil((stamp_ns - last.stamp_ns) / self._period_ns - _LATE))
        state = self._state_at(stamp_ns - steps * self._period_ns)
        for k in range(steps - 1, 0, -1):
            share = k * self._period_ns / (stamp_ns - last.stamp_ns)
            between = taken_in + min(share, 1.0) * (last.taken_in - taken_in)
            state = self._net.advanced(state, between)
        state = self._net.advanced(state, taken_in)
        past.append(_Moment(stamp_ns, state, taken_in))
        return state

    def _state_at(self, stamp_ns: int) -> State:
        """The state at a stamp, which only grows: what lies further back is let go."""
        past = self._past
        while len(past) > 1 and past[1].stamp_ns <= stamp_ns:
            past.popleft()
        first = past[0]
        if len(past) == 1 or stamp_ns <= first.stamp_ns:
            return first.state
        second = past[1]
        share = (stamp_ns - first.stamp_ns) / (second.stamp_ns - first.stamp_ns)
        return State(*(a + share * (b - a) for a, b in zip(first.state, second.state, strict=True)))
