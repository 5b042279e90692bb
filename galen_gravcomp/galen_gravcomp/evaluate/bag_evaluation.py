"""One recording through the compensator that the node runs, and its residual.

The bag's samples go through `Compensator` in the order in which they were received, as they would
through the node. What comes out is reduced to cells on the way (`cells`), so that memory is needed
for the hours and not for the samples.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from galen_bags.arrays.arm_recording import ArmBlock, ArmReader, ArmTopics
from galen_bags.arrays.stamp_check import StampCheck, StampReport
from galen_bags.formats.bag import Bag, open_bag
from galen_model.arrays import Array
from galen_model.evidence.verdict import Cause, Limits, Verdict
from galen_model.files.calibration_file import CalibrationFile
from galen_model.rest.binned import (
    CELL_S,
    CellReducer,
    Cells,
    StillCellSettings,
    StillPhases,
    find_still_phases,
)
from galen_ros.stream.samples import Notice

from galen_gravcomp.compensator import Compensator
from galen_gravcomp.corrections.inertial import inertia_source
from galen_gravcomp.evaluate.channel_check import ChannelCheck, ChannelReport
from galen_gravcomp.evaluate.residual_decomposition import (
    LoadChange,
    ResidualParts,
    decompose,
    find_change,
    rms,
)
from galen_gravcomp.evaluate.verdict import judge
from galen_gravcomp.parameters import GravcompParameters

# Slower sensors get longer cells, so that a cell holds a few readings.
_READINGS_A_CELL = 5
# Units that so much of a recording is suspected to be in leave the rest unknown.
_SUSPECT_SHARE = 0.1
_UNITS = {
    Notice.TORQUE_UNIT: "the torques look like N mm",
    Notice.ANGLE_UNIT: "the joint angles look like degrees",
}

OnBlock = Callable[[ArmBlock, np.ndarray, Array], None]
"""Is told each block, the running numbers (k,) of the wrenches that came out, and these (k, 6)."""


@dataclass(frozen=True)
class EvaluationSettings:
    """Topics, the node's parameters, when the arm is at rest, and what counts as a fit.

    Only `duration_s` (None: all) from `start_s` after the first message on are looked at.
    """

    topics: ArmTopics = field(default_factory=ArmTopics)
    start_s: float = 0.0
    duration_s: float | None = None
    parameters: GravcompParameters = field(default_factory=GravcompParameters)
    still: StillCellSettings = field(default_factory=StillCellSettings)
    limits: Limits = field(default_factory=Limits)


@dataclass(frozen=True)
class BagEvaluation:
    """What was found. Wrenches (6,) are N and N.m in the sensor's frame, NaN where there is none.

    rmse_still, rmse_moving: of single compensated readings while the arm was still, and not;
    rmse_phases: of the still phases' means. `rejected` and `notices` count by name, with an
    example of each rejection in words; `problems` are the bag's. motion: the inertia with which
    inertial forces were subtracted, in words; empty where they were not.
    """

    path: Path
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
        """Length of the still phases, s."""
        return float(np.sum(self.phases.end_ns - self.phases.start_ns) * 1e-9)

    @property
    def worst_phases(self) -> np.ndarray:
        """Rest segments by their residual in units of the limits, worst first."""
        over = np.max(np.abs(self.phases.mean) / self.limits.axes, axis=1)
        return np.argsort(-over)


def evaluate_bag(
    path: str | os.PathLike[str],
    tool: CalibrationFile,
    settings: EvaluationSettings | None = None,
    on_progress: Callable[[int, int | None], None] | None = None,
    on_block: OnBlock | None = None,
) -> BagEvaluation:
    """Evaluate a bag; raises BagError for one that can't be read or lacks the topics.

    `on_progress(done, total)` counts messages; the total is None where the bag doesn't say it.
    """
    with open_bag(path) as bag:
        return evaluate_open_bag(bag, tool, settings, on_progress, on_block)


def evaluate_open_bag(
    bag: Bag,
    tool: CalibrationFile,
    settings: EvaluationSettings | None = None,
    on_progress: Callable[[int, int | None], None] | None = None,
    on_block: OnBlock | None = None,
) -> BagEvaluation:
    """As `evaluate_bag`, of a bag that the caller opened."""
    settings = settings or EvaluationSettings()
    reader = ArmReader(
        bag,
        settings.topics,
        all_topics=on_block is not None,
        start_s=settings.start_s,
        duration_s=settings.duration_s,
    )
    run = _Run(tool, settings)
    total, done = reader.message_count, 0
    for block in reader.blocks():
        numbers, wrenches = run.add(block)
        if on_block is not None:
            on_block(block, numbers, wrenches)
        done += len(block.is_wrench)
        if on_progress is not None:
            on_progress(done, total)
    return run.finish(bag, (reader.joint_states, reader.wrench_raw))


class _Run:
    """A bag's way through compensator and checks."""

    def __init__(self, tool: CalibrationFile, settings: EvaluationSettings) -> None:
        self._tool = tool
        self._settings = settings
        self._compensator = Compensator(replace(settings.parameters, calibration_monitor=False))
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
        phases = find_still_phases(cells, self._settings.still)
        wrench_stamps = self._wrench_stamps.report()
        restart_s = self._settings.parameters.restart_gap_s
        stamps_jump = any(
            event.kind == "jump" and abs(event.size_s) > restart_s for event in wrench_stamps.events
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
        if doubt := self._doubt():
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
        compensator = self._compensator
        if not compensator.compensated:
            reasons = compensator.pairing.rejections.most_common(1)
            if not reasons:
                return "no wrench was compensated: the file's fit is unknown"
            why = self._examples[reasons[0][0].value]
            return f"no wrench was compensated, so the file's fit is unknown: {why}"
        for notice, what in _UNITS.items():
            count = compensator.pairing.notices[notice]
            if count > _SUSPECT_SHARE * compensator.pairing.received:
                return (
                    f"{what} in {count} of {compensator.pairing.received} wrenches:"
                    " the file's fit is unknown"
                )
        return ""


def _rmse(cells: Cells, which: np.ndarray) -> Array:
    """Root mean square (6,) of the single readings in some cells; NaN if there are none."""
    count = cells.count[which].sum()
    if not count:
        return np.full(6, np.nan)
    return np.asarray(np.sqrt(cells.sum_of_squares[which].sum(axis=0) / count))
