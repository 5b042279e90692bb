# SPDX-License-Identifier: Apache-2.0
"""The health of a node that takes wrenches: state, rates, latency. No ROS.

Rejections come and go with single samples; a state must not flap at 500 Hz. So a rejection stays
the state for `HOLD_S` after the last one. Times here are wall times (s, monotonic): they only say
whether something arrives at all, never what is done with a sample.
"""

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Mapping, Sequence
from enum import Enum
from itertools import pairwise
from typing import ClassVar, NamedTuple

import numpy as np

from galen_common.stream.pairing import WrenchPairing
from galen_common.stream.samples import Notice, Rejected, Rejection
from galen_common.stream.watches import FrozenWatch, LateWatch, Publishers

HOLD_S = 0.5
NOTICE_HOLD_S = 5.0
RATE_WINDOW_S = 2.0
# What stopped so recently may be what a new publisher goes on with.
SILENCE_SEEN_S = 1.5
# So long without a message is no jitter of a stream.
PAUSE_S = 0.1
UNIT_TEXTS = {
    Notice.TORQUE_UNIT: "torques far beyond the sensor's range: are they in N.mm?",
    Notice.ANGLE_UNIT: "joint angles beyond a full turn: are they in degrees?",
}
UNITS_HOLD_S = 1.0
"""Values of another unit that came so recently make all others doubtful."""
# From one look to the next; one publisher's stamps are in order.
MANY_IRREGULAR = 10
LATENCY_SAMPLES = 2000


class Severity(Enum):
    """Named as the levels of diagnostic_msgs/DiagnosticStatus."""

    OK = "OK"
    WARN = "WARN"
    ERROR = "ERROR"
    STALE = "STALE"


class StreamState(NamedTuple):
    """The state's severity, its short name, and a sentence for a person."""

    severity: Severity
    name: str
    message: str


class StreamMonitor(ABC):
    """Watches one `WrenchPairing`; what comes out of it is the subclass's to name."""

    reasons: ClassVar[tuple[Enum, ...]] = tuple(Rejection)
    """Rejections that are counted on /diagnostics."""
    not_shown: ClassVar[tuple[Enum, ...]] = (Rejection.RESTART,)
    """Rejections that are no state: the state itself, or the restart's own text, shows them."""
    working: ClassVar[str]
    """The state's name when all is well."""
    output: ClassVar[str] = ""
    """The topic that no other node may publish on; empty: others may."""
    lost: ClassVar[str] = "nothing is published"
    """What is so when all wrenches are rejected."""

    def __init__(self, pairing: WrenchPairing) -> None:
        self._pairing = pairing
        self._silence_s = pairing.parameters.silence_s
        self._outputs = 0
        self._joints_seen = 0
        self._joints_s: float | None = None
        self._wrench_s: float | None = None
        self._output_s: float | None = None
        self._last: tuple[Rejected, float] | None = None
        self._restart: tuple[str, float] | None = None
        self._notices_seen: Mapping[Notice, int] = {}
        self._notice: tuple[str, float] | None = None
        self.publishers = {
            topic: Publishers(topic) for topic in (pairing.wrench_topic, "joint_states")
        }
        """By the inputs' topics."""
        self.outputs = Publishers(self.output)
        self._frozen = FrozenWatch(pairing.parameters.frozen_s)
        self._lateness = LateWatch(pairing.parameters.late_s)
        self._irregular = 0
        self._counts: deque[tuple[float, dict[str, int]]] = deque()
        self._latencies_s: deque[float] = deque(maxlen=LATENCY_SAMPLES)

    def begin(self) -> None:
        """Forget when what came, and from whom: the inputs are subscribed to anew."""
        self._joints_s = self._wrench_s = self._output_s = None
        self.publishers = {topic: Publishers(topic) for topic in self.publishers}
        self.outputs = Publishers(self.output)
        self._lateness.forget()
        self._counts.clear()
        self._latencies_s.clear()

    def on_joints(self, now_s: float) -> None:
        """Note that a joint message came.

        Args:
            now_s: wall time, s.

        """
        self._joints_seen += 1
        self._joints_s = now_s

    def on_wrench(self, now_s: float) -> None:
        """Note that a wrench came.

        Args:
            now_s: wall time, s.

        """
        self._wrench_s = now_s

    def stamps_are_simulated(self) -> None:
        """Say that no wrench can be called late: a simulation's time stops and runs as it likes.

        Nor would its own clock tell: after a stall, the clock's messages are as late as the others.
        """
        self._lateness = LateWatch(0.0)

    def on_output(self, arrival_s: float, now_s: float, stamp_ns: int) -> bool:
        """Note an output, and when its wrench came.

        Args:
            arrival_s: wall time at which the wrench came, s.
            now_s: wall time of the output, s.
            stamp_ns: the wrench's stamp, ns.

        Returns:
            True when it may have changed the state.

        """
        first = self._output_s is None or now_s - self._output_s > HOLD_S
        self._outputs += 1
        self._output_s = now_s
        self._latencies_s.append(now_s - arrival_s)
        self._lateness.push(arrival_s, stamp_ns)
        return first

    def on_rejected(self, rejected: Rejected, now_s: float) -> bool:
        """Note a rejection.

        Args:
            rejected: the wrench that was not used, and why.
            now_s: wall time, s.

        Returns:
            True when it may have changed the state.

        """
        last = self._last
        self._last = (rejected, now_s)
        return last is None or last[0].reason is not rejected.reason or now_s - last[1] > HOLD_S

    def on_restart(self, why: str, now_s: float) -> None:
        """Note that everything was cleared.

        Args:
            why: sentence for /diagnostics.
            now_s: wall time, s.

        """
        self._restart = (why, now_s)
        self._output_s = None

    def on_notice(self, text: str, now_s: float) -> None:
        """Show a sentence in the state for NOTICE_HOLD_S.

        Args:
            text: sentence for an operator.
            now_s: wall time, s.

        """
        self._notice = (text, now_s)

    def publishers_changed(self, topic: str, listed: int, came: int, now_s: float) -> str:
        """Take a topic's publishers from discovery.

        Args:
            topic: the wrench's, or `joint_states`.
            listed: how many publishers there are now.
            came: how many of these are new.
            now_s: wall time, s.

        Returns:
            Why to start anew; empty: no need.

        """
        publishers = self.publishers[topic]
        silent = publishers.listed > 0 and self._was_silent(topic, publishers.since_s, now_s)
        why = publishers.changed(listed, came, silent, now_s)
        if why:
            self._lateness.forget()
        return why

    def review(self, now_s: float) -> Sequence[Rejected]:
        """Judge what no single sample shows; call it after `tick`, and when publishers changed.

        Args:
            now_s: wall time, s.

        Returns:
            The waiting wrenches that are rejected for it.

        """
        pairing = self._pairing
        topic = pairing.wrench_topic
        several = self.outputs.several or self.publishers[topic].several
        frozen = self._frozen.look(
            now_s, pairing.received, pairing.newest_wrench, pairing.newest_angles
        )
        if several:
            detail = f"{several}: stop all but one of them"
            return pairing.distrust(Rejection.SEVERAL_PUBLISHERS, detail)
        if frozen:
            return pairing.distrust(Rejection.FROZEN, f"{topic} {frozen}")
        pairing.trust()
        return []

    def tick(self, now_s: float) -> None:
        """Take the counts for the rates, and new notices; call it a few times a second.

        Args:
            now_s: wall time, s.

        """
        pairing = self._pairing
        seen, received, outputs = self._joints_seen, pairing.received, self._outputs
        self._counts.append((now_s, {"joints": seen, "wrenches": received, "outputs": outputs}))
        while len(self._counts) > 2 and now_s - self._counts[1][0] > RATE_WINDOW_S:
            self._counts.popleft()
        for notice, text in self._notice_texts().items():
            if pairing.notices[notice] > self._notices_seen.get(notice, 0):
                self.on_notice(text, now_s)
                break
        self._notices_seen = dict(pairing.notices)
        self._lateness.tick(now_s)
        irregular = (
            pairing.rejections[Rejection.DUPLICATE]
            + pairing.notices[Notice.OUT_OF_ORDER_WRENCH]
            + pairing.notices[Notice.RESTART]
        )
        if irregular - self._irregular >= MANY_IRREGULAR:
            self.publishers[pairing.wrench_topic].heard_again()
        self._irregular = irregular

    def state(self, now_s: float) -> StreamState:
        """Return the state now; the most serious and most basic trouble comes first.

        Args:
            now_s: wall time, s.

        Returns:
            The state.

        """
        return (
            self._standing_state()
            or self._silence_state(now_s)
            or self._several_state(now_s)
            or self._rejection_state(now_s)
            or self._waiting_state()
            or self._late_state(now_s)
            or self._noticed_state(now_s)
            or self._running_state()
        )

    @abstractmethod
    def _standing_state(self) -> StreamState | None:
        """Return why nothing can go out, whatever comes in."""

    @abstractmethod
    def _running_state(self) -> StreamState:
        """Return what is done when nothing is wrong with the samples."""

    def _notice_texts(self) -> Mapping[Notice, str]:
        """Notices that a person should hear of, and how."""
        topic = self._pairing.wrench_topic
        return {
            **UNIT_TEXTS,
            Notice.BEYOND_RANGE: f"{topic} is at the end of the sensor's range or beyond: the"
            " reading may be clipped, and the true load larger",
            Notice.JOINT_JUMP: "joint_states jumped faster than the arm can turn",
            Notice.OUT_OF_ORDER_WRENCH: f"{topic} stamps are out of order",
            Notice.OUT_OF_ORDER_JOINTS: "joint_states stamps are out of order",
        }

    def _silence_state(self, now_s: float) -> StreamState | None:
        # Wrenches without joints are rejected one by one: that says more than the joints' silence.
        if self._wrench_s is not None and now_s - self._wrench_s <= self._silence_s:
            return None
        silent = []
        topic = self._pairing.wrench_topic
        for name, last_s in ((topic, self._wrench_s), ("joint_states", self._joints_s)):
            if last_s is None:
                silent.append(f"no {name} came yet")
            elif now_s - last_s > self._silence_s:
                silent.append(f"no {name} for {now_s - last_s:.1f} s")
        return StreamState(Severity.STALE, "silent", " and ".join(silent))

    def _several_state(self, now_s: float) -> StreamState | None:
        """Two publishers' samples are repeated and out of order by turns: that is one state."""
        watched = (self.outputs, *self.publishers.values())
        several = [one.several for one in watched if one.several]
        if not several:
            return None
        text = " and ".join(several)
        if self.outputs.several or self.publishers[self._pairing.wrench_topic].several:
            text = f"{self.lost}: {text}: stop all but one of them"
            return StreamState(Severity.ERROR, "several_publishers", text)
        # Joints may come from several, as long as only one of them has this arm's.
        if self._output_s is None or now_s - self._output_s > HOLD_S:
            return None  # the rejection says why nothing goes out
        rest = (
            self._rejection_state(now_s) or self._noticed_state(now_s) or self._running_state()
        ).message
        text = f"{text}: only one of them may have this arm's joints; {rest}"
        return StreamState(Severity.WARN, "several_publishers", text)

    def _rejection_state(self, now_s: float) -> StreamState | None:
        if self._last is None or now_s - self._last[1] > HOLD_S:
            return None
        reason, detail = self._last[0].reason, self._last[0].detail
        if reason in self.not_shown:
            return None
        if self._output_s is None or now_s - self._output_s > HOLD_S:
            return StreamState(Severity.ERROR, reason.value, f"{self.lost}: {detail}")
        return StreamState(Severity.WARN, reason.value, f"some wrenches are rejected: {detail}")

    def _waiting_state(self) -> StreamState | None:
        if self._output_s is None:
            return StreamState(
                Severity.STALE, "waiting", "waiting for wrenches with joints around them"
            )
        return None

    def _late_state(self, now_s: float) -> StreamState | None:
        text = self._lateness.trouble(now_s, NOTICE_HOLD_S)
        if not text:
            return None
        text = f"{self.working}, but: of {self._pairing.wrench_topic} {text}"
        return StreamState(Severity.WARN, "late", text)

    def _noticed_state(self, now_s: float) -> StreamState | None:
        for held in (self._restart, self._notice):
            if held is not None and now_s - held[1] < NOTICE_HOLD_S:
                return StreamState(Severity.WARN, self.working, f"{self.working}, but: {held[0]}")
        return None

    def inputs(self, now_s: float, output_topic: str) -> dict[str, object]:
        """Return rates, ages and latency, for /diagnostics.

        Args:
            now_s: wall time, s.
            output_topic: as it is called in the values' names.

        Returns:
            Values by name; the unit (hz, s, ms) ends the name.

        """
        topic = self._pairing.wrench_topic
        values: dict[str, object] = {
            f"{topic}_hz": self._rate("wrenches"),
            "joint_states_hz": self._rate("joints"),
            f"{output_topic}_hz": self._rate("outputs"),
            f"{topic}_age_s": _since(self._wrench_s, now_s),
            "joint_states_age_s": _since(self._joints_s, now_s),
        }
        if self._latencies_s:
            median, p99 = np.percentile(np.array(self._latencies_s) * 1e3, (50, 99))
            values |= {"latency_median_ms": float(median), "latency_p99_ms": float(p99)}
        late = self._lateness
        values |= {"late": late.count, "late_worst_s": late.worst_s} if late.on else {"late": "off"}
        return values

    def rejected(self) -> dict[str, object]:
        """Return counts of rejections and notices, and the last ones, for /diagnostics."""
        pairing = self._pairing
        values: dict[str, object] = {"waiting": pairing.waiting}
        values |= {
            f"rejected_{reason.value}": pairing.rejections[reason] for reason in self.reasons
        }
        values |= {notice.value: pairing.notices[notice] for notice in Notice}
        values["last_rejection"] = "" if self._last is None else self._last[0].detail
        values["last_restart"] = "" if self._restart is None else self._restart[0]
        watched = {**self.publishers, self.output: self.outputs}
        for topic, publishers in watched.items():
            if topic:
                values[f"{topic}_publishers"] = publishers.listed
                values[f"{topic}_publisher_nodes"] = publishers.nodes
        return values

    def _was_silent(self, topic: str, since_s: float, now_s: float) -> bool:
        """Whether nothing came for a while just now, of publishers that were there."""
        wrenches = topic == self._pairing.wrench_topic
        last_s = self._wrench_s if wrenches else self._joints_s
        start_s = max(since_s, now_s - SILENCE_SEEN_S)
        if now_s - max(start_s, -np.inf if last_s is None else last_s) > PAUSE_S:
            return True
        name = "wrenches" if wrenches else "joints"
        totals = [counts[name] for at_s, counts in self._counts if at_s >= start_s]
        return any(before == after for before, after in pairwise(totals))

    def _rate(self, name: str) -> float:
        if len(self._counts) < 2:
            return 0.0
        (first_s, first), (last_s, last) = self._counts[0], self._counts[-1]
        return (last[name] - first[name]) / (last_s - first_s) if last_s > first_s else 0.0


def joined(numbers: np.ndarray) -> str:
    """Join numbers to a value on /diagnostics.

    Args:
        numbers: (n,), of any unit.

    Returns:
        Six digits of each, separated by spaces.

    """
    return " ".join(f"{number:.6g}" for number in numbers)


def _since(last_s: float | None, now_s: float) -> object:
    return "never came" if last_s is None else now_s - last_s
