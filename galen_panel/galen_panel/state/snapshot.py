# SPDX-License-Identifier: Apache-2.0
"""What the page knows of the suite. No ROS.

A snapshot is the same for every browser and is never changed: what is new is another one, with a
higher `revision`. So that a thread may read it while the next one is made.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import Enum
from pathlib import Path
from typing import Literal

from galen_panel.state.shapes import Drawing

Vector = tuple[float, ...]

TOOLS_DIR = Path("~/.ros/galen/tools")
"""Where nodes look for calibration files, if nothing else is given."""


class NodeLevel(Enum):
    """Level of a node's report on /diagnostics; named as there."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


class BehaviourKind(Enum):
    """A behaviour; the value is the action's name."""

    CALIBRATE = "calibrate_tool"
    CHECK = "check_tool"
    COLLECT = "collect_pushes"


Asked = Literal["REMOVE_TOOL", "ATTACH_TOOL"]
"""A person's step that a behaviour waits for: the name of its state."""


@dataclass(frozen=True)
class ListedTool:
    """One calibration file. `problem`: why it can't be used; the numbers are then 0.

    com_m (3,) in the sensor's frame; rmse_* (3,): residual of the calibration's averaged readings,
    NaN where the file has none. calibrated_at: RFC 3339. has_previous: the calibration before it is
    kept and `revert_tool` would bring it back.
    """

    name: str
    mass_kg: float = 0.0
    mass_std_kg: float = 0.0
    com_m: Vector = (0.0, 0.0, 0.0)
    rmse_force_n: Vector = (0.0, 0.0, 0.0)
    rmse_torque_nm: Vector = (0.0, 0.0, 0.0)
    poses_used: int = 0
    calibrated_at: str = ""
    parts: tuple[str, ...] = ()
    active_tool: bool = False
    has_previous: bool = False
    problem: str = ""


@dataclass(frozen=True)
class LoadedTool:
    """What gravcomp subtracts now. `file_state`: none, as loaded, changed, gone."""

    tool: str
    enabled: bool
    mass_kg: float
    com_m: Vector
    tip_m: Vector
    calibrated_at: str
    file_state: str
    tare: Vector | None
    """(6,) N, N.m; None: no tare."""


@dataclass(frozen=True)
class NodeReport:
    """A node's newest report on /diagnostics; heard_s: time.monotonic() of it.

    period_s: the longest between two of late, 1 s where all is well.
    """

    name: str
    level: NodeLevel
    message: str
    values: Mapping[str, str]
    heard_s: float
    period_s: float = 1.0

    def after(self, before: NodeReport | None) -> NodeReport:
        """Return the report with its period.

        Args:
            before: the same node's report before; None: there was none.

        Returns:
            A copy; the period falls slowly after a late report.

        """
        if before is None:
            return self
        late_s = min(2.0, self.heard_s - before.heard_s)
        return replace(self, period_s=max(1.0, late_s, 0.9 * before.period_s))


LOST = "LOST"
"""The error of a goal that no result will come of."""


@dataclass(frozen=True)
class BehaviourOutcome:
    """How a behaviour ended. `error`: its code's name or LOST, empty where it came to its end.

    text: a sentence for a person. file: what was written. values: the result's numbers, SI, by the
    action's own names. warnings, notes: as in the result. new: the tool had no file before.
    """

    error: str
    text: str
    tool: str = ""
    file: str = ""
    values: Mapping[str, object] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    new: bool = False


@dataclass(frozen=True)
class Behaviour:
    """A goal under way, or the one that ended last, of any client.

    phase: in words, such as "sweep with tool"; message: the feedback's sentence. number: of the
    goal, so that a page sees that another one began. rejected: a sentence for each pose that was
    not still enough, also where it is tried again. ours: whether this panel sent it.
    """

    number: int
    kind: BehaviourKind
    tool: str
    phase: str = ""
    message: str = ""
    done: int = 0
    total: int = 0
    rejected: tuple[str, ...] = ()
    asked: Asked | None = None
    canceling: bool = False
    ours: bool = True
    outcome: BehaviourOutcome | None = None

    @property
    def running(self) -> bool:
        """Whether it has not ended yet."""
        return self.outcome is None


@dataclass(frozen=True)
class SuiteState:
    """All of it. tools: None until a list came. available: services and actions that are there.

    available holds names as in the contract: `gravcomp/set_tool`, `calibrate_tool`, `attach_tool`.
    namespace: the panel's own, without slashes at its ends; nodes of others are another arm's.
    given: in what its parameters and names differ from the defaults: flag (-p, -r), name:=value.
    drawing: the arm, None until its description came; arm_problem: why it lacks or may be wrong.
    """

    revision: int = 0
    tools: tuple[ListedTool, ...] | None = None
    tools_dir: str = ""
    tools_problem: str = ""
    active_tool: LoadedTool | None = None
    nodes: Mapping[str, NodeReport] = field(default_factory=dict)
    behaviours: Mapping[BehaviourKind, Behaviour] = field(default_factory=dict)
    available: frozenset[str] = frozenset()
    namespace: str = ""
    given: tuple[tuple[str, str], ...] = ()
    drawing: Drawing | None = None
    arm_problem: str = ""

    @property
    def ros_arguments(self) -> list[tuple[str, str]]:
        """Return what starts a node as the panel: namespace, `given`, directory of tools."""
        found = [("-r", f"__ns:=/{self.namespace}")] if self.namespace else []
        found += self.given
        if self.tools_dir not in ("", str(TOOLS_DIR.expanduser())):
            found.append(("-p", f"tools_dir:={self.tools_dir}"))
        return found

    def full_name(self, node: str) -> str:
        """Return the name on /diagnostics of a node in the panel's own namespace.

        Args:
            node: its name without a namespace.

        Returns:
            The name, without a slash in front.

        """
        return f"{self.namespace}/{node}".lstrip("/")

    def report_of(self, node: str) -> NodeReport | None:
        """Return a node's newest report.

        Args:
            node: its name without a namespace.

        Returns:
            The report; None where there is none.

        """
        return self.nodes.get(self.full_name(node))


@dataclass(frozen=True)
class CallAnswer:
    """Answer to a request; text is for a person, never empty."""

    ok: bool
    text: str


@dataclass(frozen=True)
class QuantityDifference:
    """One quantity of two files; std_dev NaN where unknown."""

    quantity: str
    unit: str
    a: float
    b: float
    std_dev: float
    text: str


@dataclass(frozen=True)
class ToolComparison:
    """Two calibration files beside each other; worst_*: of the compensations, over all poses."""

    text: str
    same_load: bool
    differences: tuple[QuantityDifference, ...]
    worst_force_n: float
    worst_torque_nm: float


@dataclass(frozen=True)
class Goal:
    """A behaviour's goal. tool: of a check "" is the active one; name: of a collection's recording.

    tip_m None: the file's is kept. by_hand: an operator changes the tool, or pushes;
    hand_guided: an operator moves the arm, too.
    """

    kind: BehaviourKind
    tool: str = ""
    name: str = ""
    tip_m: Vector | None = None
    one_sweep: bool = False
    by_hand: bool = False
    hand_guided: bool = False
