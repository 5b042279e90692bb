"""A network at work at another rate than the one it was trained at.

A recurrent network knows no time, only steps: trained at 25 Hz and stepped at 500 Hz it would
forget twenty times too fast. So every sample takes one step from the state of one training period
before it, not from that of the sample before. At the training's own rate this is the ordinary way;
at a rate k times as high it is k interleaved copies of the network, each at its own rate, of which
every sample's output is as fresh as the sample. Where samples lie further apart than the period,
the steps between them get interpolated inputs.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np
from galen_model.arrays import Array

from galen_deflection.networks.recurrent_net import RecurrentNet, State

LONGEST_GAP_S = 1.0
"""Over a longer one nothing is interpolated, and it counts as one period."""


class _Moment(NamedTuple):
    """What the network knew at a stamp: its state, and what the inputs added to its gates."""

    stamp_ns: int
    state: State
    taken_in: Array


class PacedNet:
    """A network that steps by its samples' stamps. Starts fresh."""

    def __init__(self, net: RecurrentNet, period_s: float) -> None:
        """period_s: of the network's training."""
        self._net = net
        self._period_ns = round(period_s * 1e9)
        self._past: deque[_Moment] = deque()

    def reset(self) -> None:
        """Forget what was."""
        self._past.clear()

    def run(self, stamp_ns: np.ndarray, inputs: Array) -> Array:
        """Outputs (n, n_out) of samples at stamps (n,) with inputs (n, n_in), one after another."""
        h = np.empty((len(stamp_ns), self._net.hidden))
        for k, taken_in in enumerate(self._net.taken_in(inputs)):
            h[k] = self._take(int(stamp_ns[k]), taken_in).h
        return self._net.output(h)

    def _take(self, stamp_ns: int, taken_in: Array) -> State:
        before = self._before(stamp_ns)
        if before is None:
            state, steps = self._net.start(), 1
        else:
            state = before.state
            steps = max(1, round((stamp_ns - before.stamp_ns) / self._period_ns))
        for k in range(1, steps):
            assert before is not None
            between = before.taken_in + (taken_in - before.taken_in) * (k / steps)
            state = self._net.advanced(state, between)
        state = self._net.advanced(state, taken_in)
        self._past.append(_Moment(stamp_ns, state, taken_in))
        return state

    def _before(self, stamp_ns: int) -> _Moment | None:
        """The moment that lies most nearly a period before; None at the start."""
        past = self._past
        if past and not 0 <= stamp_ns - past[-1].stamp_ns <= LONGEST_GAP_S * 1e9:
            # a jump, or too long a gap: it goes on from the last as if a period later
            last = past[-1]._replace(stamp_ns=stamp_ns - self._period_ns)
            past.clear()
            past.append(last)
        wanted = stamp_ns - self._period_ns
        # of what is as old, only the nearest is of use, now and later
        while len(past) > 1 and abs(past[1].stamp_ns - wanted) <= abs(past[0].stamp_ns - wanted):
            past.popleft()
        if not past or 2 * (stamp_ns - past[0].stamp_ns) <= self._period_ns:
            return None
        return past[0]
