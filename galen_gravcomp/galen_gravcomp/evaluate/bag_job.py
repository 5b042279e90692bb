"""One bag's evaluation as a job: everything it needs can be sent to another process."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from galen_bags.arrays.arm_recording import ArmReader
from galen_bags.formats.bag import open_bag
from galen_bags.formats.writer import BagWriter
from galen_model.errors import GalenError
from galen_model.files.calibration_file import CalibrationFile, read_calibration

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
        tool = self.find_tool(path)
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

    def find_tool(self, bag: Path) -> CalibrationFile:
        """The tool's file for this bag; raises GalenError."""
        if not self.tool_beside:
            return read_calibration(self.tool)
        folder = bag if bag.is_dir() else bag.parent
        for place in (folder, folder.parent):
            if (place / self.tool.name).is_file():
                return read_calibration(place / self.tool.name)
        raise GalenError(f"{bag}: neither in it nor beside it is a tool's file {self.tool.name}")


def distinct_names(paths: Sequence[Path]) -> dict[Path, str]:
    """A name for each path: its own, with folders before it as far as they differ."""
    resolved = {path: Path(os.path.abspath(path)) for path in paths}  # noqa: PTH100 - keeps links
    depth = 1
    while True:
        names = {
            path: "_".join((*whole.parent.parts, whole.stem)[-depth:])
            for path, whole in resolved.items()
        }
        longest = max((len(whole.parts) for whole in resolved.values()), default=1)
        if len(set(names.values())) == len(names) or depth > longest:
            return names
        depth += 1
