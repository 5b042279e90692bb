"""One bag's evaluation as a job: everything it needs can be sent to another process."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from galen_bags.arrays.arm_recording import ArmReader
from galen_bags.formats.bag import open_bag
from galen_bags.formats.writer import BagWriter
from galen_bags.many.inputs import calibration_of_bag
from galen_model.errors import GalenError

from galen_gravcomp.evaluate.bag_evaluation import (
    BagEvaluation,
    EvaluationSettings,
    OnBlock,
    evaluate_open_bag,
)
from galen_gravcomp.evaluate.bag_report import to_dict
from galen_gravcomp.evaluate.compensated_bag import CompensatedBag


@dataclass(frozen=True)
class BagJob:
    """What is to be done with each bag.

    `tool` is the tool's file, or, where `tool_beside` is true, a file's name to look for in the
    bag's directory and in the one above. `names` has the name that plots and bags written get.
    """

    tool: Path
    tool_beside: bool = False
    settings: EvaluationSettings = field(default_factory=EvaluationSettings)
    plots: Path | None = None
    bags_out: Path | None = None
    names: dict[Path, str] = field(default_factory=dict)

    def __call__(self, bag: Path) -> dict[str, Any]:
        """Do it, and return the evaluation as plain numbers and texts."""
        return to_dict(self.evaluate(bag))

    def evaluate(
        self, path: Path, on_progress: Callable[[int, int | None], None] | None = None
    ) -> BagEvaluation:
        """Do it; raises GalenError, naming the bag or the tool's file."""
        tool = calibration_of_bag(path, self.tool, beside=self.tool_beside)
        name = self.names.get(path, path.stem)
        with ExitStack() as stack:
            bag = stack.enter_context(open_bag(path))
            on_block: OnBlock | None = None
            if self.bags_out is not None:
                target = self.bags_out / f"{name}_compensated"
                writer = stack.enter_context(BagWriter(target))
                reader = ArmReader(bag, self.settings.topics, all_topics=True)
                on_block = CompensatedBag(writer, reader).add
            result = evaluate_open_bag(bag, tool, self.settings, on_progress, on_block)
        if self.plots is not None:
            from galen_gravcomp.evaluate.plots import plot_evaluation  # slow to import

            try:
                plot_evaluation(result, self.plots, name)
            except OSError as error:
                raise GalenError(f"{self.plots}: can't be written: {error.strerror}") from error
        return result
