"""The baseline's network: features of the residual to probabilities of all names.

Trained with PyTorch (`train_baseline`), kept as safetensors, run with numpy:

    h = tanh(A (x - mean)/scale + a),  logits = B h + b,  p = softmax(logits)
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from galen_model.arrays import Array
from galen_model.errors import GalenError
from galen_model.files.atomic_file import write_whole

FILE = Path(__file__).parent / "network.safetensors"
NEEDS = "needs PyTorch and safetensors: `make networks` installs them"
_TENSORS = ("mean", "scale", "A", "a", "B", "b")
_PATIENCE = 60


class NetworkError(GalenError):
    """A network that can't be trained, read or written."""


@dataclass(frozen=True)
class Network:
    """names: of the outputs. tensors: mean, scale (f,), A (h, f), a (h,), B (c, h), b (c,)."""

    names: tuple[str, ...]
    tensors: dict[str, np.ndarray]

    def probabilities(self, features: Array) -> dict[str, float]:
        """Of features (f,)."""
        t = self.tensors
        hidden = np.tanh(t["A"] @ ((features - t["mean"]) / t["scale"]) + t["a"])
        logits = (t["B"] @ hidden + t["b"]).astype(float)
        weights = np.exp(logits - logits.max())
        return dict(zip(self.names, (weights / weights.sum()).tolist(), strict=True))

    def write(self, path: Path = FILE) -> None:
        """Write the file; raises NetworkError."""
        tensors = {name: np.ascontiguousarray(self.tensors[name], np.float32) for name in _TENSORS}
        raw = _library().numpy.save(tensors, {"names": json.dumps(list(self.names))})
        try:
            write_whole(path, bytes(raw))
        except OSError as error:
            raise NetworkError(f"{path}: can't be written: {error.strerror}") from error


def lacking(path: Path = FILE) -> str:
    """Why there is no network; empty where there is one."""
    if not path.exists():
        command = "python -m galen_diagnosis.blind.baselines.train_baseline"
        return f"{path.name}: isn't there; `{command}` makes it"
    try:
        _library()
    except NetworkError as error:
        return str(error)
    return ""


def read_network(path: Path = FILE) -> Network:
    """Read the file; raises NetworkError."""
    library = _library()
    try:
        with library.safe_open(path, framework="numpy") as stored:
            names = tuple(json.loads(stored.metadata()["names"]))
            tensors = {name: stored.get_tensor(name) for name in _TENSORS}
    except (OSError, KeyError, TypeError, ValueError, library.SafetensorError) as error:
        raise NetworkError(f"{path}: is no network of the blind check: {error}") from error
    hidden, inputs = tensors["A"].shape
    expected = {
        "mean": (inputs,), "scale": (inputs,), "a": (hidden,),
        "B": (len(names), hidden), "b": (len(names),),
    }  # fmt: skip
    for name, shape in expected.items():
        if tensors[name].shape != shape:
            raise NetworkError(f"{path}: tensor {name} is {tensors[name].shape}, not {shape}")
    return Network(names, tensors)


def train(
    features: Array,
    answers: Sequence[str],
    names: Sequence[str],
    *,
    hidden: int = 64,
    iterations: int = 600,
    weight_decay: float = 0.05,
    held_out: float = 0.2,
    seed: int = 0,
    on_progress: Callable[[int, int], None] | None = None,
) -> tuple[Network, dict[str, float]]:
    """Train on features (n, f) and answers (n); returns the network and how right it is.

    A fifth of the recordings is held out, and decides when to stop. Adam with decoupled weight
    decay (I. Loshchilov, F. Hutter, ICLR 2019), classes weighted alike, some noise on the inputs.
    Raises NetworkError without PyTorch or where a class has no recording.
    """
    torch = _torch()
    place = {name: number for number, name in enumerate(names)}
    target = np.array([place[answer] for answer in answers])
    random = np.random.default_rng(seed)
    check = np.zeros(len(target), dtype=bool)
    check[random.permutation(len(target))[: int(held_out * len(target))]] = True
    counts = np.bincount(target[~check], minlength=len(names))
    if not counts.all():
        lacking = names[int(np.argmin(counts))]
        raise NetworkError(f"no recording of {lacking} to train on; make more")
    mean = features[~check].mean(axis=0)
    scale = np.maximum(features[~check].std(axis=0), 0.3)
    x = torch.tensor((features - mean) / scale, dtype=torch.float32)
    y = torch.tensor(target)
    weight = torch.tensor(counts.sum() / (len(names) * counts), dtype=torch.float32)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        net = torch.nn.Sequential(
            torch.nn.Linear(features.shape[1], hidden),
            torch.nn.Tanh(),
            torch.nn.Linear(hidden, len(names)),
        )
        kept = _descend(torch, net, x, y, weight, check, iterations, weight_decay, on_progress)
    tensors = {"mean": mean, "scale": scale, **kept}
    network = Network(
        tuple(names), {name: np.asarray(t, np.float32) for name, t in tensors.items()}
    )
    said = [max(p, key=lambda name: p[name]) for p in map(network.probabilities, features)]
    right = np.array([one == answer for one, answer in zip(said, answers, strict=True)])
    return network, {
        "training": float(right[~check].mean()),
        "held_out": float(right[check].mean()) if check.any() else float("nan"),
    }


def _descend(
    torch: Any,
    net: Any,
    x: Any,
    y: Any,
    weight: Any,
    check: np.ndarray,
    iterations: int,
    weight_decay: float,
    on_progress: Callable[[int, int], None] | None,
) -> dict[str, np.ndarray]:
    """The tensors of the iteration with the least held-out loss."""
    loss = torch.nn.CrossEntropyLoss(weight=weight)
    optimiser = torch.optim.AdamW(net.parameters(), lr=3e-3, weight_decay=weight_decay)
    best, best_at, kept = float("inf"), 0, {}
    for iteration in range(iterations):
        net.train()
        optimiser.zero_grad()
        noisy = x[~check] + 0.1 * torch.randn_like(x[~check])
        loss(net(noisy), y[~check]).backward()
        optimiser.step()
        net.eval()
        with torch.no_grad():
            rows = check if check.any() else ~check
            now = float(loss(net(x[rows]), y[rows]))
        if not np.isfinite(now):
            raise NetworkError(f"training went astray at iteration {iteration + 1}")
        if now < best:
            best, best_at = now, iteration
            first, _, last = net
            kept = {
                "A": first.weight.detach().numpy().copy(), "a": first.bias.detach().numpy().copy(),
                "B": last.weight.detach().numpy().copy(), "b": last.bias.detach().numpy().copy(),
            }  # fmt: skip
        if on_progress is not None:
            on_progress(iteration + 1, iterations)
        if iteration - best_at >= _PATIENCE:
            break
    return kept


def _torch() -> Any:
    try:
        import torch
    except ImportError as error:
        raise NetworkError(f"the baseline's network {NEEDS}") from error
    return torch


def _library() -> Any:
    try:
        import safetensors
        import safetensors.numpy
    except ImportError as error:
        raise NetworkError(f"the baseline's network {NEEDS}") from error
    return safetensors
