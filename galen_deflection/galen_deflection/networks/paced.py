"""A network at work at another rate than the one it was trained at.

A recurrent network knows no time, only steps: trained at 25 Hz and stepped at 500 Hz it would
forget twenty times too fast. So every sample takes a step from the state of one training period
before it, not from that of the sample before. At the training's own rate this is the ordinary way;
at a rate k times as high it is k interleaved copies of the network, each at its own rate, of which
every sample's output is as fresh as the sample. In between, the state of a period before is
interpolated between those of its neighbours in time. Where samples lie further apart than the
period, the steps between them get interpolated inputs.
"""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

import numpy as np
from galen_model.arrays import Array

from galen_deflection.networks.recurrent_net import RecurrentNet, State

LONGEST_GAP_S = 1.0
"""Over a longer one nothing is interpolated, and it counts as one period."""

_LATE = 0.25
"""Share of the period by which a sample may come late and still be the next step."""


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
        past = self._past
        if not past:
            past.append(_Moment(stamp_ns - self._period_ns, self._net.start(), taken_in))
        elif not 0 <= stamp_ns - past[-1].stamp_ns <= LONGEST_GAP_S * 1e9:
            # a jump, or too long a gap: it goes on from the last as if a period later
            last = past[-1]._replace(stamp_ns=stamp_ns - self._period_ns)
            past.clear()
            past.append(last)
        last = past[-1]
        steps = max(1, math.ceil((stamp_ns - last.stamp_ns) / self._period_ns - _LATE))
        state = self._state_at(stamp_ns - steps * self._period_ns)
        for k in range(steps - 1, 0, -1):
            share = k * self._period_ns / (stamp_ns - last.stamp_ns)
            between = taken_in + min(share, 1.0) * (last.taken_in - taken_in)
            state = self._net.advanced(state, between)
        state = self._net.advanced(state, taken_in)
        past.append(_Moment(stamp_ns, state, taken_in))
        return state

    def _state_at(self, stamp_ns: int) -> State:
        """The state at a stamp, which only grows: what lies further back is let go."""
        past = self._past
        while len(past) > 1 and past[1].stamp_ns <= stamp_ns:
            past.popleft()
        first = past[0]
        if len(past) == 1 or stamp_ns <= first.stamp_ns:
            return first.state
        second = past[1]
        share = (stamp_ns - first.stamp_ns) / (second.stamp_ns - first.stamp_ns)
        return State(*(a + share * (b - a) for a, b in zip(first.state, second.state, strict=True)))
