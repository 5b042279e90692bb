"""What the page knows of the suite, and what it may ask of it. No ROS.

A snapshot is the same for every browser and is never changed: what is new is another one, with a
higher `revision`. So that a thread may read it while the next one is made.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from enum import Enum
from typing import Protocol

from galen_panel.history import History

Vector = tuple[float, ...]


class NodeLevel(Enum):
    """Of what a node says on /diagnostics; named as there."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


class BehaviourKind(Enum):
    """The behaviours; the value is the action's name."""

    CALIBRATE = "calibrate_tool"
    CHECK = "check_tool"
    COLLECT = "collect_pushes"


class Asked(Enum):
    """What a behaviour waits for a person to do."""

    REMOVE_TOOL = "remove_tool"
    ATTACH_TOOL = "attach_tool"


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
    """A node's newest word on /diagnostics. heard_s: time.monotonic() of it."""

    name: str
    level: NodeLevel
    message: str
    values: Mapping[str, str]
    heard_s: float


@dataclass(frozen=True)
class FinishedPose:
    """One finished pose of a behaviour; wrench (6,) its averaged reading, or None."""

    sweep: str
    number: int
    roll_rad: float
    tilt_rad: float
    accepted: bool
    text: str
    wrench: Vector | None = None


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
    goal, so that a page sees that another one began. ours: whether this panel sent it.
    """

    number: int
    kind: BehaviourKind
    tool: str
    phase: str = ""
    message: str = ""
    done: int = 0
    total: int = 0
    poses: tuple[FinishedPose, ...] = ()
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

    def full_name(self, node: str) -> str:
        """What a node of the panel's own namespace is called on /diagnostics."""
        return f"{self.namespace}/{node}".lstrip("/")

    def report_of(self, node: str) -> NodeReport | None:
        """Its newest report; None where there is none."""
        return self.nodes.get(self.full_name(node))


@dataclass(frozen=True)
class CallAnswer:
    """What became of something that was asked for; text is for a person, never empty."""

    ok: bool
    text: str


@dataclass(frozen=True)
class QuantityDifference:
    """One quantity of two files; std_dev NaN where the files tell none."""

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
class CalibrateGoal:
    """As in CalibrateTool; tip_m None: the file's is kept."""

    tool: str
    tip_m: Vector | None = None
    one_sweep: bool = False
    by_hand: bool = False


@dataclass(frozen=True)
class CheckGoal:
    """As in CheckTool; tool "": the active one."""

    tool: str = ""


@dataclass(frozen=True)
class CollectGoal:
    """As in CollectPushes, positions and loads as the node's parameters say."""

    name: str
    tool: str
    by_hand: bool = True


Goal = CalibrateGoal | CheckGoal | CollectGoal


class Suite(Protocol):
    """The suite as the page sees it."""

    @property
    def state(self) -> SuiteState:
        """The newest snapshot."""

    @property
    def history(self) -> History:
        """The streams' newest samples; it grows only while a page shows them."""

    def watch(self) -> AbstractContextManager[None]:
        """Within it the streams are listened to; the last one to leave stops that."""

    async def list_tools(self) -> CallAnswer:
        """Ask anew for the tools; they are then in `state`."""

    async def activate(self, tool: str) -> CallAnswer:
        """Have gravcomp load a calibration file; "" for no tool."""

    async def remove_tool(self, tool: str) -> CallAnswer:
        """Remove a calibration file from the list; it is kept beside."""

    async def revert_tool(self, tool: str) -> CallAnswer:
        """Bring back the calibration before the present one."""

    async def compare(self, tool: str, with_tool: str = "") -> ToolComparison | CallAnswer:
        """Compare a calibration (b) with another's (a); "": with its own before."""

    async def set_enabled(self, enabled: bool) -> CallAnswer:
        """Switch the compensation."""

    async def tare(self) -> CallAnswer:
        """Tare: subtract the present residual."""

    async def start(self, goal: Goal) -> CallAnswer:
        """Send a goal; answers when it is accepted or rejected."""

    async def confirm(self) -> CallAnswer:
        """Tell a calibration that the person has done what it asked."""

    async def cancel(self, kind: BehaviourKind) -> CallAnswer:
        """Cancel a behaviour's goal, of any client; answers when that is accepted."""
