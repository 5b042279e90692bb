"""A trained network with all that running it takes, as it stands in a model's file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from galen_model.files.json_fields import (
    FieldError,
    array,
    count,
    get,
    mapping,
    number,
    numbers,
    texts,
)

from galen_deflection.networks.paced import PacedNet
from galen_deflection.networks.recurrent_net import RecurrentNet, Scaling, Weights

LARGEST_HIDDEN = 512
"""Hidden units; a file that wants more is not one of ours, and would take long to reject."""

_RATES_HZ = (0.1, 10_000.0)


@dataclass(frozen=True)
class Network:
    """inputs, outputs: the columns' names, in their order; period_s: of its training."""

    net: RecurrentNet
    period_s: float
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]

    def paced(self) -> PacedNet:
        """At work, from a fresh start."""
        return PacedNet(self.net, self.period_s)

    def to_json(self) -> dict[str, Any]:
        """All but the weights."""
        return {
            "hidden": self.net.hidden,
            "period_s": self.period_s,
            "inputs": list(self.inputs),
            "outputs": list(self.outputs),
            "input_scaling": _scaling_to_json(self.net.inputs),
            "output_scaling": _scaling_to_json(self.net.outputs),
        }

    @classmethod
    def from_json(
        cls,
        content: Any,
        name: str,
        tensors: Mapping[str, np.ndarray],
        inputs: Sequence[str],
        outputs: Sequence[str],
    ) -> Network:
        """From a file's field and tensors, which must be those of these columns.

        Raises FieldError.
        """
        whole = mapping(content, name)
        for what, expected in (("inputs", inputs), ("outputs", outputs)):
            found = texts(get(whole, what), f"{name}.{what}")
            if found != tuple(expected):
                raise FieldError(
                    f"{name}.{what} is {', '.join(found):.80}; expected {', '.join(expected)}"
                )
        hidden = count(get(whole, "hidden"), f"{name}.hidden")
        if not 1 <= hidden <= LARGEST_HIDDEN:
            raise FieldError(f"{name}.hidden is {hidden}; expected 1 to {LARGEST_HIDDEN}")
        period_s = number(get(whole, "period_s"), f"{name}.period_s")
        if not 1.0 / _RATES_HZ[1] <= period_s <= 1.0 / _RATES_HZ[0]:
            raise FieldError(f"{name}.period_s is {period_s:g}; expected 0.0001 to 10")
        shapes = Weights.shapes(len(inputs), hidden, len(outputs))
        check_tensors(tensors, shapes)
        return cls(
            RecurrentNet(
                Weights.from_tensors(tensors),
                _scaling_from_json(get(whole, "input_scaling"), f"{name}.input_scaling", inputs),
                _scaling_from_json(get(whole, "output_scaling"), f"{name}.output_scaling", outputs),
            ),
            period_s,
            tuple(inputs),
            tuple(outputs),
        )


def check_tensors(tensors: Mapping[str, np.ndarray], shapes: Mapping[str, tuple[int, ...]]) -> None:
    """Raise FieldError unless the tensors are finite, of these shapes, and no others."""
    if set(tensors) != set(shapes):
        raise FieldError(
            f"the tensors are {', '.join(sorted(tensors)) or 'none'}; expected "
            f"{', '.join(sorted(shapes)) or 'none'}"
        )
    for name, shape in shapes.items():
        if tensors[name].shape != shape:
            raise FieldError(f"tensor {name} has shape {tensors[name].shape}; expected {shape}")
        if not np.isfinite(tensors[name]).all():
            raise FieldError(f"tensor {name} holds a value that is not finite")


def _scaling_to_json(scaling: Scaling) -> dict[str, Any]:
    return {"mean": numbers(scaling.mean), "scale": numbers(scaling.scale)}


def _scaling_from_json(content: Any, name: str, columns: Sequence[str]) -> Scaling:
    whole = mapping(content, name)
    shape = (len(columns),)
    scale = array(get(whole, "scale"), f"{name}.scale", shape)
    if np.any(scale <= 0.0):
        raise FieldError(f"{name}.scale holds a value that isn't positive")
    return Scaling(array(get(whole, "mean"), f"{name}.mean", shape), scale)
