"""Watch one push: as asked, held, released; from the load at the tip alone."""

from __future__ import annotations

import numpy as np
from galen_model.arrays import Array

from galen_deflection.collection.commands import State
from galen_deflection.collection.parameters import CollectionParameters
from galen_deflection.collection.plan import WantedPush


class PushWatch:
    """One try at a push. Give it the load some fifty times a second until there is an `outcome`.

        RELEASE (if in contact) -> PUSH <-> HOLD -> RELEASE -> REST

    `outcome` is None, "" for a push as asked, else the reason why it isn't. Along its axis the load
    must be within `level_tolerance` of the level, beside it (force of a force, torque of a torque:
    where exactly a hand takes hold of the tip is its own affair) at most `aside_share`, both for
    `hold_s` without a break. More than `overload_share` in all is rejected. Released is what is
    below `released_n` and `released_nm` for `rest_s`.
    """

    def __init__(
        self, wanted: WantedPush, limits: CollectionParameters, timeout_s: float, start_s: float
    ) -> None:
        """`timeout_s`: for the push from when it is asked for until it has been held."""
        self.wanted = wanted
        self._limits = limits
        self._timeout_s = timeout_s
        self._kind = slice(0, 3) if wanted.is_force else slice(3, 6)
        self._direction = wanted.wrench[self._kind] / wanted.level
        self.state = State.RELEASE
        self.outcome: str | None = None
        self.asked = False
        self.along = self.aside = 0.0
        self._since_s = start_s
        self._held_since_s: float | None = None
        self._verdict: str | None = None
        self._most = 0.0
        self._aside_then = 0.0

    def look(self, time_s: float, load: Array) -> None:
        """Take the load (6,) at the tip in base_link, N and N.m, and the time, s of stamps."""
        part = load[self._kind]
        self.along = float(part @ self._direction)
        self.aside = float(np.linalg.norm(part - self.along * self._direction))
        force, torque = np.linalg.norm(load[:3]), np.linalg.norm(load[3:])
        free = force <= self._limits.released_n and torque <= self._limits.released_nm
        if self.state in (State.PUSH, State.HOLD):
            self._look_at_push(time_s, float(np.linalg.norm(part)))
        elif self.state == State.RELEASE:
            if free:
                self._released(time_s)
            elif time_s - self._since_s > self._limits.release_timeout_s:
                self.outcome = (
                    f"the tool was not let go of for {self._limits.release_timeout_s:g} s"
                    f" ({force:.2f} N, {torque:.3f} N·m)"
                )
        elif not free:
            self._enter(State.RELEASE, time_s)
        elif time_s - self._since_s >= self._limits.rest_s:
            self.outcome = self._verdict

    def spoil(self, reason: str, time_s: float) -> None:
        """Reject the push for a reason other than its load."""
        if self._verdict:
            return
        self._verdict = reason
        if self.state in (State.PUSH, State.HOLD):
            self._enter(State.RELEASE, time_s)

    def _released(self, time_s: float) -> None:
        if self._verdict is None:
            self.asked = True
            self._enter(State.PUSH, time_s)
        else:
            self._enter(State.REST, time_s)

    def _look_at_push(self, time_s: float, size: float) -> None:
        limits, level = self._limits, self.wanted.level
        if size > limits.overload_share * level:
            self._judge(f"it came to {size:.2f} {self.wanted.unit}", time_s)
            return
        if self.along > self._most:
            self._most, self._aside_then = self.along, self.aside
        fits = (
            abs(self.along - level) <= limits.level_tolerance * level
            and self.aside <= limits.aside_share * level
        )
        if not fits:
            self._held_since_s = None
            self.state = State.PUSH
        elif self._held_since_s is None:
            self._held_since_s = time_s
            self.state = State.HOLD
        elif time_s - self._held_since_s >= limits.hold_s:
            self._judge("", time_s)
            return
        if time_s - self._since_s > self._timeout_s:
            self._judge(self._what_lacked(), time_s)

    def _what_lacked(self) -> str:
        level, unit, tolerance = self.wanted.level, self.wanted.unit, self._limits.level_tolerance
        if self._most < (1.0 - tolerance) * level:
            return f"it came to no more than {self._most:.2f} {unit} in {self._timeout_s:g} s"
        if self._aside_then > self._limits.aside_share * level:
            return f"{self._aside_then:.2f} {unit} went aside"
        return f"it was not held for {self._limits.hold_s:g} s within {self._timeout_s:g} s"

    def _judge(self, verdict: str, time_s: float) -> None:
        self._verdict = verdict
        self._enter(State.RELEASE, time_s)

    def _enter(self, state: State, time_s: float) -> None:
        self.state = state
        self._since_s = time_s
