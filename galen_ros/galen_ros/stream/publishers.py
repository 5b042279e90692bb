"""Who publishes an input: one driver, one that took over from a dead one, or two at once. No ROS.

DDS hears of a `kill -9` only by a time-out of some 20 s, and so long the driver that came back is
the second publisher listed. No message tells which publisher it is from. So one that was silent
when the next one came counts as quiet, and only what is not quiet can be one too many.
"""

from collections import Counter
from collections.abc import Sequence


class Publishers:
    """The publishers of one topic, as they come and go."""

    def __init__(self, topic: str) -> None:
        """`topic` as it is called in sentences."""
        self._topic = topic
        self._names: tuple[str, ...] = ()
        self.listed = 0
        """How many there are, by discovery."""
        self.quiet = 0
        """How many of them had been silent when another one came."""
        self.since_s = float("-inf")
        """When that last changed, s."""

    @property
    def sending(self) -> int:
        """How many of them may send."""
        return self.listed - self.quiet

    def changed(self, listed: int, came: int, silent: bool, now_s: float) -> str:
        """Take what discovery says: `listed` now, `came` of them new; returns why to start anew.

        `silent`: whether those listed before had stopped sending. A first publisher is no restart:
        its first samples may even have come before. Nor is it one when a quiet publisher goes:
        what came since is from another one.
        """
        before = self.listed
        gone = before + came - listed
        quiet_gone = min(gone, self.quiet)
        self.quiet -= quiet_gone
        self.listed = listed
        self.since_s = now_s
        if came > 0 and silent:
            self.quiet = listed - came
        if gone > quiet_gone:
            return f"driver restarted: a publisher of {self._topic} is gone"
        if came > 0 and before > 0:
            return f"driver restarted: a publisher of {self._topic} is new"
        return ""

    def heard_again(self) -> None:
        """Say that those which had been quiet send as well."""
        self.quiet = 0

    def name(self, nodes: Sequence[str]) -> None:
        """Say which nodes they are, by full names."""
        self._names = tuple(nodes)

    @property
    def several(self) -> str:
        """Which are too many, in words; empty with one."""
        if self.sending < 2:
            return ""
        text = f"{self._topic} has {self.sending} publishers"
        return f"{text} ({self.nodes})" if self._names else text

    @property
    def nodes(self) -> str:
        """The names of their nodes."""
        counts = Counter(self._names)
        return ", ".join(
            name if count == 1 else f"{name} {count} times" for name, count in counts.items()
        )
