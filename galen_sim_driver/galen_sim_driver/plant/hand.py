"""The hand at tool_tip: a script of pushes, one after the other or at once, or a single push."""

from __future__ import annotations

import math
from collections.abc import Sequence

from galen_sim_driver.errors import HandBusyError
from galen_sim_driver.plant.config import HandPush
from galen_sim_driver.plant.geometry import Matrix, rotate_back


class Hand:
    """Plays a script of pushes, or one push, from the moment it is started."""

    def __init__(self, script: Sequence[HandPush]) -> None:
        self._script = list(script)
        self._played: list[HandPush] = []
        self._end_s = 0.0
        self._start_ns: int | None = None

    @property
    def active(self) -> bool:
        """Whether it is pushing, or has still to."""
        return self._start_ns is not None

    def start(self, now_ns: int) -> None:
        """Play the script from its beginning, instead of what is played."""
        self._play(self._script, now_ns)

    def push(self, push: HandPush, now_ns: int) -> None:
        """Push once. Raises HandBusyError while something is played, ConfigError for nonsense."""
        push.validate()
        if self.active:
            raise HandBusyError("the hand is pushing already")
        self._play([push], now_ns)

    def _play(self, pushes: list[HandPush], now_ns: int) -> None:
        self._played = pushes
        self._end_s = max((push.start_s + push.duration_s for push in pushes), default=0.0)
        self._start_ns = now_ns

    def wrench_at_tip(self, now_ns: int, matrix: Matrix) -> list[float] | None:
        """Force and torque (6,) about tool_tip along its axes, N and N.m, or None for no touch.

        `matrix` is R_base_tip.
        """
        if self._start_ns is None:
            return None
        time_s = (now_ns - self._start_ns) * 1e-9
        if time_s > self._end_s:
            self._start_ns = None
            return None
        total: list[float] | None = None
        for push in self._played:
            strength = push_strength(push, time_s)
            if strength == 0.0:
                continue
            force: Sequence[float] = push.force_n
            torque: Sequence[float] = push.torque_nm
            if push.frame == "base":
                force, torque = rotate_back(matrix, force), rotate_back(matrix, torque)
            part = [strength * value for value in (*force, *torque)]
            total = part if total is None else [a + b for a, b in zip(total, part, strict=True)]
        return total


def push_strength(push: HandPush, time_s: float) -> float:
    """Between 0 and 1: a half cosine up, full, a half cosine down."""
    since = time_s - push.start_s
    left = push.duration_s - since
    if since <= 0.0 or left <= 0.0:
        return 0.0
    return min(_edge(since, push.ramp_s), _edge(left, push.falling_s))


def _edge(time_s: float, ramp_s: float) -> float:
    if time_s >= ramp_s:
        return 1.0
    return 0.5 - 0.5 * math.cos(math.pi * time_s / ramp_s)
