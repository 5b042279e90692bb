"""One axis of the sensor sees some of another: reading_to += c true_from (contract, section 6)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from galen_model.arm.galen import WRENCH_AXES
from galen_model.arrays import Array
from galen_ros.parameters.param import param

from galen_sim_driver.effects.effect import Effect, Fitted, Instants, check_axis
from galen_sim_driver.errors import ConfigError


@dataclass(frozen=True)
class Crosstalk(Effect):
    """reading of `to_axis` += `coefficient` times the true `from_axis`; fx fy fz tx ty tz."""

    name: ClassVar[str] = "crosstalk"
    fitted: ClassVar[tuple[Fitted, ...]] = (Fitted("coefficient", "", 0.02, -2.0, 2.0),)
    order: ClassVar[int] = 2
    contract_names: ClassVar[Mapping[str, str]] = {"from_axis": "from", "to_axis": "to"}

    from_axis: str = param("fz", "the axis that another one sees some of: fx fy fz tx ty tz")
    to_axis: str = param("fx", "the axis that sees it")
    coefficient: float = param(0.0, "how much it sees of it, in N and Nm", -100.0, 100.0)

    def validate(self) -> None:
        """Both are axes, and not the same one."""
        check_axis(self.name, "from", self.from_axis)
        check_axis(self.name, "to", self.to_axis)
        if self.from_axis == self.to_axis:
            raise ConfigError(f"{self.name}: from and to are both {self.to_axis}")

    def read(self, when: Instants, wrench: Array) -> Array:
        """What the one axis has goes to the other as well."""
        return self._add(wrench, self.coefficient)

    def unread(self, when: Instants, reading: Array) -> Array:
        """Exactly back: `from_axis` reads what it did."""
        return self._add(reading, -self.coefficient)

    def _add(self, wrench: Array, coefficient: float) -> Array:
        changed = wrench.copy()
        origin, target = WRENCH_AXES.index(self.from_axis), WRENCH_AXES.index(self.to_axis)
        changed[:, target] += coefficient * wrench[:, origin]
        return changed
