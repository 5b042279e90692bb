# SPDX-License-Identifier: Apache-2.0
"""One recording through the compensator that the node runs, and its residual.

The bag's samples go through `Compensator` in the order in which they were received, as they would
through the node. What comes out is reduced to time bins on the way, so that memory is needed for
the hours and not for the samples.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from galen_bags.archive import local_copy
from galen_bags.arrays.arm_recording import (
    WRENCH_TYPE,
    ArmBlock,
    ArmReader,
    ArmTopics,
    arm_of_bag,
)
from galen_bags.arrays.timeline import StampCheck, StampReport
from galen_bags.formats.bag import Bag, open_bag
from galen_bags.formats.writer import BagWriter
from galen_bags.many import Place, calibration_of_bag, name_of
from galen_common.arm import ArmParameters
from galen_common.cdr import MessageBytes, wrench_bytes
from galen_common.stream.samples import Notice
from galen_model.arrays import Array
from galen_model.errors import GalenError
from galen_model.files.calibration_file import CalibrationFile
from galen_model.load.verdict import Cause, Limits, Verdict
from galen_model.rest.binned import CELL_S, CellReducer, Cells, StillPhases, find_still_phases
from galen_model.setup_check.check import check_setup
from galen_model.setup_check.readings import at_angles

from galen_gravcomp.compensator import Compensator
from galen_gravcomp.corrections.inertial import inertia_source
from galen_gravcomp.evaluate.channel_check import ChannelCheck, ChannelReport
from galen_gravcomp.evaluate.residual import (
    LoadChange,
    ResidualParts,
    decompose,
    find_change,
    judge,
    rms,
)
from galen_gravcomp.parameters import GravcompParameters

# Slower sensors get longer cells, so that a cell holds a few readings.
_READINGS_A_CELL = 5
# Units that so much of a recording is suspected to be in leave the rest unknown.
_SUSPECT_SHARE = 0.1
_UNITS = {
    Notice.TORQUE_UNIT: "the torques look like N mm",
    Notice.ANGLE_UNIT: "the joint angles look like degrees",
}
_TOPIC = "wrench_compensated"

OnProgress = Callable[[int, int | None], None]
"""Called with how many messages are done, and the total; None where the bag does not hold it."""


@dataclass(frozen=True)
class EvaluationSettings:
    """Topics, the node's parameters, and what counts as a fit.

    Only `duration_s` (None: all) from `start_s` after the first message on are looked at.
    """

    topics: ArmTopics = field(default_factory=ArmTopics)
    start_s: float = 0.0
    duration_s: float | None = None
    parameters: GravcompParameters = field(default_factory=GravcompParameters)
    arm: ArmParameters = field(default_factory=ArmParameters)
    limits: Limits = field(default_factory=Limits)


@dataclass(frozen=True)
class BagEvaluation:
    """The evaluation of a bag. Wrenches (6,) are N and N.m in the sensor's frame, NaN for none.

    rmse_still, rmse_moving: of single compensated readings while the arm was at rest, and not;
    rmse_phases: of the rest segments' means. `rejected` and `notices` count by name, with an
    example of each rejection in words; `problems` are the bag's. motion: the inertia with which
    inertial forces were subtracted, in words; empty where they were not.
    """

    path: Place
    tool: CalibrationFile
    topics: tuple[str, str]
    duration_s: float
    received: int
    compensated: int
    waiting: int
    rejected: dict[str, int]
    rejected_example: dict[str, str]
    notices: dict[str, int]
    problems: tuple[str, ...]
    joint_stamps: StampReport
    wrench_stamps: StampReport
    channels: ChannelReport
    cells: Cells
    phases: StillPhases
    rmse_still: Array
    rmse_moving: Array
    rmse_phases: Array
    parts: ResidualParts | None
    change: LoadChange | None
    limits: Limits
    verdict: Verdict
    motion: str = ""

    @property
    def start_ns(self) -> int:
        """Stamp that times in the report count from."""
        return int(self.cells.start_ns[0]) if len(self.cells) else 0

    @property
    def still_s(self) -> float:
        """Length of the rest segments, s."""
        return float(np.sum(self.phases.end_ns - self.phases.start_ns) * 1e-9)

    @property
    def worst_phases(self) -> np.ndarray:
        """Rest segments by their residual in units of the limits, worst first."""
        over = np.max(np.abs(self.phases.mean) / self.limits.axes, axis=1)
        return np.argsort(-over)


@dataclass(frozen=True)
class BagJob:
    """Evaluates bags, in this process or another.

    `tool` is the calibration file, or, where `tool_beside` is true, a file's name to look for in
    the bag's directory and in the one above; it and bags may be a store's URLs. Plots and bags
    written are named by so many parts of the bag's place.
    """

    tool: Place
    tool_beside: bool = False
    settings: EvaluationSettings = field(default_factory=EvaluationSettings)
    plots: Path | None = None
    bags_out: Path | None = None
    name_parts: int = 1

    def __call__(self, bag: Place) -> dict[str, Any]:
        """Evaluate a bag, as plain numbers and texts."""
        from galen_gravcomp.evaluate.bag_report import to_json

        return to_json(self.evaluate(bag))

    def evaluate(self, bag: Place, on_progress: OnProgress | None = None) -> BagEvaluation:
        """Evaluate a bag; plots and bags that are asked for are written.

        Args:
            bag: path or URL.
            on_progress: called with the arm's messages done so far and their number; None: no
                calls.

        Returns:
            The evaluation.

        Raises:
            GalenError: naming the bag or the calibration file.

        """
        beside = str(self.tool) if self.tool_beside else ""
        file = Path(beside) if self.tool_beside else self.tool
        with local_copy(bag, beside) as path, local_copy(file) as tool:
            result = self._evaluate(path, tool, name_of(bag, self.name_parts), on_progress)
            return replace(result, path=bag)

    def _evaluate(
        self, path: Path, file: Path, name: str, on_progress: OnProgress | None
    ) -> BagEvaluation:
        with open_bag(path) as bag:
            arm = arm_of_bag(bag, self.settings.arm, self.settings.topics)
        tool = calibration_of_bag(path, file, beside=self.tool_beside, arm=arm)
        write_to = None if self.bags_out is None else self.bags_out / f"{name}_compensated"
        result = evaluate_bag(path, tool, self.settings, on_progress, write_to)
        if self.plots is not None:
            from galen_gravcomp.evaluate.plots import plot_evaluation  # slow to import

            try:
                plot_evaluation(result, self.plots, name)
            except OSError as error:
                raise GalenError(f"{self.plots}: can't be written: {error.strerror}") from error
        return result


def evaluate_bag(
    path: str | os.PathLike[str],
    tool: CalibrationFile,
    settings: EvaluationSettings | None = None,
    on_progress: OnProgress | None = None,
    write_to: Path | None = None,
) -> BagEvaluation:
    """Evaluate a bag on the tool's arm.

    Args:
        path: bag to read.
        tool: the calibration file that is judged.
        settings: topics, the node's parameters and limits; None: the defaults.
        on_progress: called with the arm's messages done so far and their number; None: no calls.
        write_to: bag to write, with the compensated wrench in it; None: none.

    Returns:
        The evaluation.

    Raises:
        BagError: the bag can't be read or written; the message names it.

    """
    settings = settings or EvaluationSettings()
    with ExitStack() as stack:
        bag = stack.enter_context(open_bag(path))
        reader = ArmReader(
            bag,
            settings.topics,
            arm=tool.arm,
            all_topics=write_to is not None,
            start_s=settings.start_s,
            duration_s=settings.duration_s,
        )
        written = None
        if write_to is not None:
            written = _CompensatedBag(stack.enter_context(BagWriter(write_to)), reader)
        run = _Run(tool, settings)
        total, done = reader.message_count, 0
        for block in reader.blocks():
            numbers, wrenches = run.add(block)
            if written is not None:
                written.add(block, numbers, wrenches)
            done += len(block.is_wrench)
            if on_progress is not None:
                on_progress(done, total)
        return run.finish(bag, (reader.joint_states, reader.wrench_raw))


class _Run:
    """A bag's way through compensator and checks."""

    def __init__(self, tool: CalibrationFile, settings: EvaluationSettings) -> None:
        self._tool = tool
        self._settings = settings
        parameters = replace(settings.parameters, calibration_monitor=False)
        self._compensator = Compensator(parameters, arm=tool.arm)
        self._compensator.set_tool(tool)
        self._joint_stamps = StampCheck()
        self._wrench_stamps = StampCheck()
        self._channels = ChannelCheck(np.array(settings.parameters.sensor_range))
        self._cells: CellReducer | None = None
        self._examples: dict[str, str] = {}
        self._span: tuple[int, int] | None = None

    def add(self, block: ArmBlock) -> tuple[np.ndarray, Array]:
        """Take a block; returns what came out: running numbers (k,) and wrenches (k, 6)."""
        joints, wrenches = block.joints, block.wrenches
        readable = np.ones(len(wrenches), dtype=bool)
        readable[list(wrenches.bad)] = False
        stamps = wrenches.stamp_ns[readable]
        self._joint_stamps.add(joints.stamp_ns, block.joint_log_ns)
        self._wrench_stamps.add(stamps, block.wrench_log_ns[readable])
        self._channels.add(stamps, wrenches.values[readable])
        for log_ns in (block.joint_log_ns, block.wrench_log_ns):
            if len(log_ns):
                first, last = self._span or (int(log_ns[0]), int(log_ns[0]))
                self._span = (min(first, int(log_ns[0])), max(last, int(log_ns[-1])))
        if self._cells is None and len(stamps) > 1:
            period_s = self._wrench_stamps.report().period_s
            slow_s = _READINGS_A_CELL * period_s if np.isfinite(period_s) else 0.0
            self._cells = CellReducer(max(CELL_S, slow_s))
        result = self._compensator.push_block(block.is_wrench, joints, wrenches)
        for rejected in result.rejected:
            self._examples.setdefault(rejected.reason.value, rejected.detail)
        if self._cells is not None:
            self._cells.add(result.stamp_ns, result.wrench, result.angles)
        return result.index, result.wrench

    def finish(self, bag: Bag, topics: tuple[str, str]) -> BagEvaluation:
        cells = (self._cells or CellReducer()).finish()
        phases = find_still_phases(cells)
        wrench_stamps = self._wrench_stamps.report()
        restart_s = self._settings.parameters.restart_gap_s
        stamps_jump = any(
            kind == "jump" and abs(size_s) > restart_s for kind, _, size_s in wrench_stamps.events
        )
        limits = self._settings.limits
        change = find_change(phases, self._tool, limits)
        # One load for both sides of a change fits neither.
        parts = decompose(phases, self._tool, stamps_jump=stamps_jump) if change is None else None
        verdict = judge(
            phases,
            parts,
            change,
            self._tool,
            limits,
            moving=rms(cells.mean[~phases.arm_still]),
            start_ns=int(cells.start_ns[0]) if len(cells) else 0,
            stamps_jump=stamps_jump,
        )
        doubt = self._doubt()
        if not doubt and verdict.cause is not Cause.FITS:
            doubt = self._wrong_setup(phases)
        if doubt:
            verdict = Verdict(Cause.UNKNOWN, doubt)
        compensator = self._compensator
        first, last = self._span or (0, 0)
        return BagEvaluation(
            path=bag.path,
            tool=self._tool,
            topics=topics,
            duration_s=(last - first) * 1e-9,
            received=compensator.pairing.received,
            compensated=compensator.compensated,
            waiting=compensator.pairing.waiting,
            rejected={reason.value: n for reason, n in compensator.pairing.rejections.items()},
            rejected_example=self._examples,
            notices={notice.value: n for notice, n in compensator.pairing.notices.items()},
            problems=tuple(bag.problems),
            joint_stamps=self._joint_stamps.report(),
            wrench_stamps=wrench_stamps,
            channels=self._channels.report(),
            cells=cells,
            phases=phases,
            rmse_still=_rmse(cells, phases.arm_still),
            rmse_moving=_rmse(cells, ~phases.arm_still),
            rmse_phases=rms(phases.mean),
            parts=parts,
            change=change,
            limits=limits,
            verdict=verdict,
            motion="" if compensator.motion is None else inertia_source(self._tool),
        )

    def _doubt(self) -> str:
        """Why the fit is unknown, whatever the residual; empty if it is not."""
        pairing = self._compensator.pairing
        if not self._compensator.compensated:
            reasons = pairing.rejections.most_common(1)
            if not reasons:
                return "no wrench was compensated: the file's fit is unknown"
            why = self._examples[reasons[0][0].value]
            return f"no wrench was compensated, so the file's fit is unknown: {why}"
        for notice, what in _UNITS.items():
            count = pairing.notices[notice]
            if count > _SUSPECT_SHARE * pairing.received:
                return (
                    f"{what} in {count} of {pairing.received} wrenches: the file's fit is unknown"
                )
        return ""

    def _wrong_setup(self, phases: StillPhases) -> str:
        """Return the wrong set-up that explains the rest segments, in words; empty for none."""
        tool = self._tool
        if tool.mounting is not None or not len(phases):
            return ""
        raw = phases.mean + tool.predict(phases.angles)
        noise = np.sqrt(np.mean(phases.std_of_mean**2, axis=0))
        found = check_setup(at_angles(raw, phases.angles, tool.arm), noise)
        return found.sentence if found is not None and found.explanations else ""


def _rmse(cells: Cells, which: np.ndarray) -> Array:
    """Root mean square (6,) of the single readings in some cells; NaN if there are none."""
    count = cells.count[which].sum()
    if not count:
        return np.full(6, np.nan)
    return np.asarray(np.sqrt(cells.sum_of_squares[which].sum(axis=0) / count))


class _CompensatedBag:
    """Writes an evaluation's blocks with its results.

    The compensated wrench has stamp, frame_id and log time of its raw one. A topic of its name in
    the source is left out, since it came from another compensation.
    """

    def __init__(self, writer: BagWriter, reader: ArmReader) -> None:
        self._writer = writer
        result = f"{reader.wrench_raw.rsplit('/', 1)[0]}/{_TOPIC}"
        self._topics = []
        for name in reader.read_topics:
            topic = reader.bag.topics[name]
            definition = topic.definition if topic.definition_form == "ros2msg" else None
            kept = name != result
            self._topics.append(
                writer.add_topic(name, topic.type_name, definition) if kept else None
            )
        self._out = writer.add_topic(result, WRENCH_TYPE)
        self._templates: dict[str, MessageBytes] = {}
        # Wrenches that were received and not yet answered for: number, log time, stamp, frame.
        self._open: deque[tuple[int, int, int, str]] = deque()
        self._received = 0

    def add(self, block: ArmBlock, numbers: np.ndarray, wrenches: Array) -> None:
        """Write a block's messages and the compensated wrenches (k, 6) with these numbers (k,)."""
        raw = block.wrenches
        for row in range(len(raw)):
            log_ns, stamp_ns = int(block.wrench_log_ns[row]), int(raw.stamp_ns[row])
            frame_id = raw.frame_ids[raw.frame[row]]
            self._open.append((self._received + row, log_ns, stamp_ns, frame_id))
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
