"""Whether a sensor hangs: its reading stays the same to the last bit while the arm turns. No ROS.

A live reading's noise and the weight that turns with the arm both change it. Looked at a few times
a second only: that six numbers with noise repeat bit for bit at several looks in a row does not
happen by chance (noise of four quanta: once in 10^7 looks).
"""

from collections.abc import Sequence

from galen_model.arrays import Array

# A pointer's weight of 0.6 N then changes by six quanta of the sensor.
TURN_RAD = 0.05
FROZEN_S = 1.0


class FrozenWatch:
    """Looks at the newest wrench and the newest angles. Times are wall times, s."""

    def __init__(self, frozen_s: float = FROZEN_S) -> None:
        """`frozen_s`: so long must it stay the same; 0: not watched."""
        self._frozen_s = frozen_s
        self._wrench: tuple[float, ...] = ()
        self._since_s = 0.0
        self._received = 0
        self._angles: tuple[float, ...] = ()
        self._turned_rad = 0.0

    def look(
        self,
        now_s: float,
        received: int,
        wrench: Sequence[float] | Array | None,
        angles: Sequence[float] | None,
    ) -> str:
        """Why the reading can't be a live one, in words; empty while it may be.

        received: how many wrenches came so far; wrench (6,); angles: roll and tilt, rad.
        """
        if self._frozen_s <= 0.0 or wrench is None or angles is None:
            return ""
        held = tuple(wrench)
        if held != self._wrench:
            self._wrench, self._angles = held, tuple(angles)
            self._since_s, self._turned_rad = now_s, 0.0
        elif received == self._received:
            return ""  # nothing new came: that is silence
        self._received = received
        pairs = zip(angles, self._angles, strict=True)
        self._turned_rad = max(self._turned_rad, *(abs(now - then) for now, then in pairs))
        held_s = now_s - self._since_s
        if held_s < self._frozen_s or self._turned_rad < TURN_RAD:
            return ""
        return (
            f"has been the same to the last bit for {held_s:.1f} s while the arm turned by"
            f" {self._turned_rad:.2f} rad: the sensor hangs"
        )
