"""How a training went."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from galen_model.files.json_fields import FieldError, array, count, get, items, mapping, numbers


@dataclass(frozen=True)
class TrainingCurve:
    """After every iteration: root mean square errors, in units of what an error is measured by.

    training_loss: on what was learnt from; check_loss: on what was held out, of the same length, or
    empty if nothing was. best: the iteration that was kept, from 0.
    """

    training_loss: tuple[float, ...]
    check_loss: tuple[float, ...]
    best: int

    def to_json(self) -> dict[str, Any]:
        """As plain numbers."""
        return {
            "training_loss": numbers(self.training_loss),
            "check_loss": numbers(self.check_loss),
            "best": self.best,
        }

    @classmethod
    def from_json(cls, content: Any, name: str) -> TrainingCurve:
        """Read with checks; raises FieldError."""
        whole = mapping(content, name)
        losses = {}
        for what in ("training_loss", "check_loss"):
            rows = get(whole, what)
            size = len(items(rows, f"{name}.{what}"))
            losses[what] = tuple(array(rows, f"{name}.{what}", (size,)).tolist())
        curve = cls(**losses, best=count(get(whole, "best"), f"{name}.best"))
        if curve.best >= len(curve.training_loss):
            raise FieldError(f"{name}.best is beyond the iterations there were")
        if len(curve.check_loss) not in (0, len(curve.training_loss)):
            raise FieldError(f"{name}.check_loss is not as long as {name}.training_loss")
        return curve
