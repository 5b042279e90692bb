"""Which stamps went in, which came out: what a stream lost, doubled or put out of order. No ROS."""

from __future__ import annotations

from dataclasses import dataclass

_ALLOWED_NS = 500_000_000


@dataclass
class Account:
    """What became of the stamps of one input so far."""

    went_in: int = 0
    came_out: int = 0
    lost: int = 0
    doubled: int = 0
    unknown: int = 0
    """Came out without having gone in."""
    disordered: int = 0


class StampLedger:
    """Compares the stamps of an output with those of its input, a stretch at a time.

    Both are heard from their publishers, in any order among each other. What went in more than
    half a second before the newest of both is looked at and forgotten, so that memory is bounded.
    """

    def __init__(self, allowed_ns: int = _ALLOWED_NS) -> None:
        """`allowed_ns`: so much later by stamps may an output be heard."""
        self.account = Account()
        self._allowed_ns = allowed_ns
        self._inputs: list[int] = []
        self._outputs: list[int] = []
        self._newest_out = 0
        self._begun = False

    def go_in(self, stamp_ns: int) -> None:
        """Heard on the input."""
        self._inputs.append(stamp_ns)

    def come_out(self, stamp_ns: int) -> None:
        """Heard on the output."""
        if stamp_ns < self._newest_out:
            self.account.disordered += 1
        self._newest_out = max(self._newest_out, stamp_ns)
        self._outputs.append(stamp_ns)

    def settle(self, *, last: bool = False) -> None:
        """Look at all that is old enough; `last`: at all up to the last that came out.

        The first stretch begins with the first stamp that was heard on both sides.
        """
        if not self._inputs or not self._outputs:
            return
        until_ns = min(max(self._inputs), max(self._outputs))
        if not last:
            until_ns -= self._allowed_ns
        inputs = [stamp for stamp in self._inputs if stamp <= until_ns]
        outputs = [stamp for stamp in self._outputs if stamp <= until_ns]
        self._inputs = [stamp for stamp in self._inputs if stamp > until_ns]
        self._outputs = [stamp for stamp in self._outputs if stamp > until_ns]
        known, seen = set(inputs), set(outputs)
        if not self._begun and known and seen:
            common = known & seen
            if not common:
                return
            begin_ns = min(common)
            known = {stamp for stamp in known if stamp >= begin_ns}
            outputs = [stamp for stamp in outputs if stamp >= begin_ns]
            seen = set(outputs)
            self._begun = True
        self.account.went_in += len(known)
        self.account.came_out += len(outputs)
        self.account.lost += len(known - seen)
        self.account.unknown += len(seen - known)
        self.account.doubled += len(outputs) - len(seen)
