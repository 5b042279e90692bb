"""Wrench stamps are late against the joints': stamp = measurement + delay (contract, section 6)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from galen_ros.parameters.param import param

from galen_sim_driver.effects.effect import Effect, Fitted


@dataclass(frozen=True)
class WrenchDelay(Effect):
    """A wrench's stamp is `delay_s` later than its measurement."""

    name: ClassVar[str] = "wrench_delay"
    fitted: ClassVar[tuple[Fitted, ...]] = (Fitted("delay_s", "s", 0.01, -0.2, 0.2),)

    delay_s: float = param(
        0.0, "a wrench's stamp is so much later than its measurement, s", -0.2, 0.2
    )

    @property
    def wrench_delay_s(self) -> float:
        """The delay itself; whoever looks up the joints at a wrench's stamp takes it away."""
        return self.delay_s
