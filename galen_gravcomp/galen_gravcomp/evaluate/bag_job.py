"""One bag's evaluation as a job: everything it needs can be sent to another process."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from galen_bags.arrays.arm_recording import ArmBlock, ArmReader
from galen_bags.arrays.messages import WRENCH_TYPE
from galen_bags.formats.bag import open_bag
from galen_bags.formats.writer import BagWriter
from galen_bags.many.inputs import calibration_of_bag
from galen_model.arrays import Array
from galen_model.errors import GalenError
from galen_ros.cdr import MessageBytes, wrench_bytes

from galen_gravcomp.evaluate.bag_evaluation import (
    BagEvaluation,
    EvaluationSettings,
    OnBlock,
    evaluate_open_bag,
)
from galen_gravcomp.evaluate.bag_report import to_dict

_TOPIC = "wrench_compensated"


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


class CompensatedBag:
    """Takes an evaluation's blocks (`bag_evaluation.OnBlock`) and writes them with its results.

    The compensated wrench has stamp, frame_id and log time of its raw one. A topic of its name in
    the source is left out, since it came from another compensation.
    """

    def __init__(self, writer: BagWriter, reader: ArmReader) -> None:
        """`reader` with all topics."""
        self._writer = writer
        raw = reader.wrench_raw
        self._name = f"{raw.rsplit('/', 1)[0]}/{_TOPIC}"
        self._topics = []
        for name in reader.read_topics:
            topic = reader.bag.topics[name]
            definition = topic.definition if topic.definition_form == "ros2msg" else None
            kept = name != self._name
            self._topics.append(
                writer.add_topic(name, topic.type_name, definition) if kept else None
            )
        self._out = writer.add_topic(self._name, WRENCH_TYPE)
        self._templates: dict[str, MessageBytes] = {}
        # Wrenches that were received and not yet answered for: number, log time, stamp, frame.
        self._open: deque[tuple[int, int, int, str]] = deque()
        self._received = 0

    def add(self, block: ArmBlock, numbers: np.ndarray, wrenches: Array) -> None:
        """Write a block's messages and the compensated wrenches (k, 6) with these numbers (k,)."""
        raw = block.wrenches
        for row in range(len(raw)):
            frame_id = raw.frame_ids[raw.frame[row]]
            self._open.append(
                (
                    self._received + row,
                    int(block.wrench_log_ns[row]),
                    int(raw.stamp_ns[row]),
                    frame_id,
                )
            )
        self._received += len(raw)
        out = self._compensated(numbers, wrenches)
        for row in range(len(block.messages)):
            time_ns = int(block.messages.log_time_ns[row])
            while out and out[0][0] < time_ns:
                self._writer.write(self._out, *out.popleft())
            topic = self._topics[block.messages.topic[row]]
            if topic is not None:
                self._writer.write(topic, time_ns, block.messages.message(row))
        for entry in out:
            self._writer.write(self._out, *entry)

    def _compensated(self, numbers: np.ndarray, wrenches: Array) -> deque[tuple[int, bytes]]:
        """Log time and message of each; what is not among the numbers was rejected."""
        out: deque[tuple[int, bytes]] = deque()
        by_number = dict(zip(numbers.tolist(), wrenches.tolist(), strict=True))
        last = max(by_number, default=-1)
        still_open: deque[tuple[int, int, int, str]] = deque()
        for entry in self._open:
            number, log_ns, stamp_ns, frame_id = entry
            wrench = by_number.get(number)
            if wrench is not None:
                template = self._templates.setdefault(frame_id, wrench_bytes(frame_id))
                out.append((log_ns, template.fill(stamp_ns, wrench)))
            elif number > last:
                still_open.append(entry)
        self._open = still_open
        return out
