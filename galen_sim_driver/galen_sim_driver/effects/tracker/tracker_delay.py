"""Tracker stamps are late: stamp = measurement + delay (contract, section 6)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from galen_ros.parameters.param import param

from galen_sim_driver.effects.effect import Effect, Fitted


@dataclass(frozen=True)
class TrackerDelay(Effect):
    """A tracker's stamp is `delay_s` later than its measurement."""

    name: ClassVar[str] = "tracker_delay"
    fitted: ClassVar[tuple[Fitted, ...]] = (Fitted("delay_s", "s", 0.02, -0.3, 0.3),)

    delay_s: float = param(
        0.0, "a tracker's stamp is so much later than its measurement, s", -0.3, 0.3
    )

    @property
    def tracker_delay_s(self) -> float:
        """The delay itself; whoever looks up what happened at a tracker's stamp takes it away."""
        return self.delay_s
