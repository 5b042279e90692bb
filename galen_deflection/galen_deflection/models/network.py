# SPDX-License-Identifier: Apache-2.0
"""The 2019 report's network as a deflection model: one LSTM layer and a linear layer, in numpy.

With x the standardised inputs (the wrench at the tip in base_link, N and N.m, and the joints, m and
rad), h and c (hidden,) the state, and s the logistic function (S. Hochreiter, J. Schmidhuber,
*Long short-term memory*, Neural Computation 9, 1997, with the forget gate of F. Gers et al., 2000;
rows in PyTorch's order):

    (i, f, g, o) = W_in x + W_state h + b
    c' = s(f) c + s(i) tanh(g),   h' = s(o) tanh(c'),   y = W_out h' + b_out.

PyTorch only trains. One sample of a network this small takes it 0.4 ms, nearly all of which is the
calling; here it is a twentieth, and neither a stream nor the node has to load it.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from galen_model.arm.arm import Arm
from galen_model.arrays import Array
from galen_model.json_fields import (
    FieldError,
    array,
    count,
    covariance,
    get,
    mapping,
    number,
    numbers,
)

from galen_deflection.measurement.samples import DeflectionSamples
from galen_deflection.models.interface import (
    FittedRange,
    Predicted,
    PredictedSamples,
    fitted_on_from_json,
    noise_from_json,
    tip_from_json,
)
from galen_deflection.models.springs import Springs

LSTM = "lstm"

OUTPUTS = 6

LARGEST_HIDDEN = 128
"""Hidden units; a file that wants more is not one of ours, and would take long to reject."""

LONGEST_GAP_S = 1.0
"""Over a longer one nothing is interpolated, and it counts as one period."""

_LATE = 0.25
"""Share of the period by which a sample may come late and still be the next step."""

_LIMITS_S = (1e-4, 10.0)


class Scaling(NamedTuple):
    """Standardisation: (value - mean) / scale."""

    mean: Array
    scale: Array

    @classmethod
    def of(cls, values: Array, least: Array | None = None) -> Scaling:
        """Make it from training data; a constant column is only shifted.

        Args:
            values: (n, k), in their units.
            least: (k,): a scale is not smaller, as that of an axis on which there was only rounding
                or noise would be; None: no limit.

        Returns:
            Means and standard deviations (k,).

        """
        scale = np.maximum(values.std(axis=0), 0.0 if least is None else least)
        # a constant's standard deviation is what rounding leaves
        constant = scale <= 1e-9 * np.abs(values).max(axis=0)
        return cls(values.mean(axis=0), np.where(constant, 1.0, scale))

    def apply(self, values: Array) -> Array:
        """Standardise.

        Args:
            values: (n, k) or (k,), in their units.

        Returns:
            The same shape, without unit.

        """
        return np.asarray((values - self.mean) / self.scale)

    def undo(self, values: Array) -> Array:
        """Return to units.

        Args:
            values: (n, k) or (k,), standardised.

        Returns:
            The same shape, in units.

        """
        return np.asarray(values * self.scale + self.mean)

    def to_json(self) -> dict[str, Any]:
        """Return plain numbers."""
        return {"mean": numbers(self.mean), "scale": numbers(self.scale)}

    @classmethod
    def from_json(cls, content: Any, name: str, size: int) -> Scaling:
        """Read with checks.

        Args:
            content: the file's field.
            name: the field's name, for messages.
            size: k, the number of columns.

        Returns:
            The scaling.

        Raises:
            FieldError: a field lacks or has another size, or a scale is not positive.

        """
        whole = mapping(content, name)
        scale = array(get(whole, "scale"), f"{name}.scale", (size,))
        if np.any(scale <= 0.0):
            raise FieldError(f"{name}.scale holds a value that isn't positive")
        return cls(array(get(whole, "mean"), f"{name}.mean", (size,)), scale)


def weight_shapes(inputs: int, hidden: int, outputs: int) -> dict[str, tuple[int, ...]]:
    """Return the weights' shapes.

    Args:
        inputs: number of inputs.
        hidden: number of hidden units.
        outputs: number of outputs.

    Returns:
        Shapes by the weights' names, in the order of the layers.

    """
    return {
        "w_in": (4 * hidden, inputs),
        "w_state": (4 * hidden, hidden),
        "bias": (4 * hidden,),
        "w_out": (outputs, hidden),
        "bias_out": (outputs,),
    }


class RecurrentNet:
    """A trained network with its standardisation."""

    def __init__(self, weights: Mapping[str, Array], inputs: Scaling, outputs: Scaling) -> None:
        """Take weights of `weight_shapes`, and scalings of n_in inputs and n_out outputs."""
        self.weights, self.inputs, self.outputs = weights, inputs, outputs
        self.hidden = weights["w_out"].shape[1]
        # s(z) = (1 + tanh(z / 2)) / 2: one tanh for all gates
        half = np.full(4 * self.hidden, 0.5)
        half[2 * self.hidden : 3 * self.hidden] = 1.0
        self._w_in, self._w_state = (
            half[:, None] * weights["w_in"],
            half[:, None] * weights["w_state"],
        )
        self._bias = half * weights["bias"]

    def start(self) -> Array:
        """Return the state (2, hidden), h and c, in which every sequence begins."""
        return np.zeros((2, self.hidden))

    def taken_in(self, inputs: Array) -> Array:
        """Return the contribution of a sequence's inputs to the gates.

        Args:
            inputs: (n, n_in), in their units.

        Returns:
            (n, 4 hidden), rows of the gates i, f, g, o.

        """
        return np.asarray(self.inputs.apply(inputs) @ self._w_in.T + self._bias)

    def advanced(self, state: Array, taken_in: Array) -> Array:
        """Return the state after one more sample.

        Args:
            state: (2, hidden), h and c before it.
            taken_in: (4 hidden,), the sample's contribution to the gates.

        Returns:
            (2, hidden), h and c.

        """
        n = self.hidden
        z = np.tanh(taken_in + self._w_state @ state[0])
        gate = 0.5 + 0.5 * z
        after = np.empty_like(state)
        after[1] = gate[n : 2 * n] * state[1] + gate[:n] * z[2 * n : 3 * n]
        after[0] = gate[3 * n :] * np.tanh(after[1])
        return after

    def output(self, h: Array) -> Array:
        """Return outputs of states.

        Args:
            h: (n, hidden).

        Returns:
            (n, n_out), in their units.

        """
        return self.outputs.undo(h @ self.weights["w_out"].T + self.weights["bias_out"])

    def predict(self, inputs: Array) -> Array:
        """Return outputs for a whole sequence, from a fresh start.

        Args:
            inputs: (n, n_in), in their units.

        Returns:
            (n, n_out), in their units.

        """
        state = self.start()
        h = np.empty((len(inputs), self.hidden))
        for k, taken_in in enumerate(self.taken_in(inputs)):
            state = self.advanced(state, taken_in)
            h[k] = state[0]
        return self.output(h)

    def to_json(self) -> dict[str, Any]:
        """Return plain numbers."""
        return {
            "hidden": self.hidden,
            "input_scaling": self.inputs.to_json(),
            "output_scaling": self.outputs.to_json(),
            "weights": {name: np.asarray(value).tolist() for name, value in self.weights.items()},
        }

    @classmethod
    def from_json(cls, content: Any, inputs: int, outputs: int) -> RecurrentNet:
        """Read a file's field `network`.

        Args:
            content: the field itself.
            inputs: n_in, the expected number of inputs.
            outputs: n_out, the expected number of outputs.

        Returns:
            The network.

        Raises:
            FieldError: a field lacks, or has another shape.

        """
        whole = mapping(content, "network")
        hidden = count(get(whole, "hidden"), "network.hidden")
        if not 1 <= hidden <= LARGEST_HIDDEN:
            raise FieldError(f"network.hidden is {hidden}; expected 1 to {LARGEST_HIDDEN}")
        rows = mapping(get(whole, "weights"), "network.weights")
        weights = {
            name: array(get(rows, name), f"network.weights.{name}", shape)
            for name, shape in weight_shapes(inputs, hidden, outputs).items()
        }
        scalings = [
            Scaling.from_json(get(whole, f"{what}_scaling"), f"network.{what}_scaling", size)
            for what, size in (("input", inputs), ("output", outputs))
        ]
        return cls(weights, *scalings)


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
        # Stamp, state (2, hidden) there, and what the inputs added to its gates.
        self._past: deque[tuple[int, Array, Array]] = deque()

    def run(self, stamp_ns: np.ndarray, inputs: Array) -> Array:
        """Return outputs of the next samples.

        Args:
            stamp_ns: (n,) their stamps.
            inputs: (n, n_in), in their units.

        Returns:
            (n, n_out), in their units.

        """
        h = np.empty((len(stamp_ns), self._net.hidden))
        for k, taken_in in enumerate(self._net.taken_in(inputs)):
            h[k] = self._take(int(stamp_ns[k]), taken_in)[0]
        return self._net.output(h)

    def _take(self, stamp_ns: int, taken_in: Array) -> Array:
        past, period_ns = self._past, self._period_ns
        if not past:
            past.append((stamp_ns - period_ns, self._net.start(), taken_in))
        elif not 0 <= stamp_ns - past[-1][0] <= LONGEST_GAP_S * 1e9:
            # a jump, or too long a gap: it goes on from the last as if a period later
            _, state, last_in = past[-1]
            past.clear()
            past.append((stamp_ns - period_ns, state, last_in))
        last_ns, _, last_in = past[-1]
        steps = max(1, math.ceil((stamp_ns - last_ns) / period_ns - _LATE))
        state = self._state_at(stamp_ns - steps * period_ns)
        for k in range(steps - 1, 0, -1):
            share = k * period_ns / (stamp_ns - last_ns)
            between = taken_in + min(share, 1.0) * (last_in - taken_in)
            state = self._net.advanced(state, between)
        state = self._net.advanced(state, taken_in)
        past.append((stamp_ns, state, taken_in))
        return state

    def _state_at(self, stamp_ns: int) -> Array:
        """Return the state at a stamp, which only grows: what lies further back is dropped."""
        past = self._past
        while len(past) > 1 and past[1][0] <= stamp_ns:
            past.popleft()
        first_ns, first, _ = past[0]
        if len(past) == 1 or stamp_ns <= first_ns:
            return first
        second_ns, second, _ = past[1]
        share = (stamp_ns - first_ns) / (second_ns - first_ns)
        return np.asarray(first + share * (second - first))


@dataclass(frozen=True)
class NetworkModel:
    """A fitted network; the fields as `SpringModel`'s.

    net: of 6 + j inputs. period_s: of a step. iterations: of the training, those that were best for
    what was held out. held_out_error: root mean square error there, in units of the noise.
    """

    tip_m: Array
    net: RecurrentNet
    period_s: float
    discrepancy: Array
    noise: Array
    fitted_range: FittedRange
    fitted_on: Mapping[str, int]
    iterations: int
    held_out_error: float
    arm: Arm
    name: str = LSTM
    notes: tuple[str, ...] = ()

    def predict(self, samples: DeflectionSamples) -> PredictedSamples:
        """Predict every sample, each segment from a fresh start: the same as stream by stream.

        Args:
            samples: n samples, of whole segments; their deflections are not looked at.

        Returns:
            Predictions (n) in base_link, m and rad; all have the covariance `discrepancy`.

        """
        size = len(samples)
        mean, outside = np.empty((size, OUTPUTS)), np.empty(size, dtype=bool)
        for segment in samples.segments():
            mean[segment], outside[segment] = self.stream().run(
                samples.stamp_ns[segment], samples.joints[segment], samples.wrench[segment]
            )
        return PredictedSamples(mean, np.tile(self.discrepancy, (size, 1, 1)), outside)

    def stream(self) -> NetworkStream:
        """Return a stream that starts unloaded."""
        return NetworkStream(self)

    def to_json(self) -> dict[str, Any]:
        """Return everything needed to make it again: numbers, lists and texts."""
        return {
            "kind": self.name,
            "tip_m": numbers(self.tip_m),
            "network": self.net.to_json(),
            "period_s": self.period_s,
            "discrepancy": [numbers(row) for row in self.discrepancy],
            "noise": numbers(self.noise),
            "fitted_range": self.fitted_range.to_json(),
            "fitted_on": dict(self.fitted_on),
            "iterations": self.iterations,
            "held_out_error": self.held_out_error,
        }

    @classmethod
    def from_json(cls, content: Mapping[str, Any], arm: Arm) -> NetworkModel:
        """Read a file's content.

        Args:
            content: the whole file's content.
            arm: the arm that the model is used on.

        Returns:
            The model.

        Raises:
            FieldError: naming what is wrong.

        """
        period_s = number(get(content, "period_s"), "period_s")
        if not _LIMITS_S[0] <= period_s <= _LIMITS_S[1]:
            raise FieldError(f"period_s is {period_s:g}; expected 0.0001 to 10")
        inputs = 6 + len(arm.joints)
        return cls(
            tip_m=tip_from_json(content),
            net=RecurrentNet.from_json(get(content, "network"), inputs, OUTPUTS),
            period_s=period_s,
            discrepancy=covariance(get(content, "discrepancy"), "discrepancy", OUTPUTS),
            noise=noise_from_json(content),
            fitted_range=FittedRange.from_json(get(content, "fitted_range"), "fitted_range", arm),
            fitted_on=fitted_on_from_json(get(content, "fitted_on")),
            iterations=count(get(content, "iterations"), "iterations"),
            held_out_error=number(get(content, "held_out_error"), "held_out_error"),
            arm=arm,
        )


class NetworkStream:
    """A network on samples as they come."""

    def __init__(self, model: NetworkModel) -> None:
        self._model = model
        self._springs = Springs(model.tip_m, model.arm)
        self.reset()

    def run(self, stamp_ns: np.ndarray, joints: Array, wrench: Array) -> tuple[Array, np.ndarray]:
        """Predict the next samples.

        Args:
            stamp_ns: (n,) their stamps.
            joints: (n, j), m and rad.
            wrench: (n, 6) applied, in ft_sensor about its origin, N and N.m.

        Returns:
            Means (n, 6) of the deflection in base_link, m and rad; whether they are extrapolated
            (n,).

        """
        at_tip = self._springs.at_tip(joints, wrench)
        mean = self._paced.run(stamp_ns, np.hstack([at_tip, joints]))
        return mean, self._model.fitted_range.left_by(joints, at_tip)

    def step(self, stamp_ns: int, joints: Array, wrench: Array) -> Predicted:
        """Take the next sample.

        Args:
            stamp_ns: its stamp.
            joints: (j,), m and rad.
            wrench: (6,) applied, in ft_sensor about its origin, N and N.m.

        Returns:
            The deflection of tool_tip in base_link.

        """
        mean, outside = self.run(
            np.array([stamp_ns]),
            np.asarray(joints, dtype=float)[None],
            np.asarray(wrench, dtype=float)[None],
        )
        return Predicted(mean[0], self._model.discrepancy, bool(outside[0]))

    def tip_pose(self, joints: Array) -> tuple[Array, Array]:
        """Return the tip's pose by the joints, without deflection.

        Args:
            joints: (j,), m and rad.

        Returns:
            R (3, 3) and position (3,), m, in base_link.

        Raises:
            KinematicsError: a delta's rods don't reach.

        """
        rotation, position = self._springs.geometry(joints[None]).tip
        return rotation[0], position[0]

    def reset(self) -> None:
        """Forget all loads, as if the arm had never been loaded."""
        self._paced = PacedNet(self._model.net, self._model.period_s)
