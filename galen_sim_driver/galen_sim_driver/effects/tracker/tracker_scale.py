"""The tracker's lengths are wrong: positions are (1 + gain) times true (contract, section 6).

About the tracker's own origin, so that both markers move away from it; rotations stay. Whoever
finds where base_link is from what the tracker tells sees of it what is left of a scale about the
mean of the tool's positions.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from galen_model.arrays import Array
from galen_ros.parameters.param import param

from galen_sim_driver.effects.effect import Effect, Fitted, Instants


@dataclass(frozen=True)
class TrackerScale(Effect):
    """Positions of both markers in the tracker's frame are (1 + `gain`) times true."""

    name: ClassVar[str] = "tracker_scale"
    fitted: ClassVar[tuple[Fitted, ...]] = (Fitted("gain", "", 0.003, -0.5, 1.0),)

    gain: float = param(
        0.0, "how much too long the tracker's lengths are, as a fraction", -0.5, 1.0
    )

    def seen(self, when: Instants, position: Array) -> Array:
        """The position times its gain."""
        return position * (1.0 + self.gain)
