"""The few numbers of the evidence that are not physics: calibrated on simulated recordings.

`python -m galen_diagnosis.calibrate` makes `calibration.json`; causes, sessions and unknown kinds
there are others than those of `blind_check`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import resources

LAWS = {
    "sensor_drift": "loose",
    "cable_drag": "loose",
    "deflection_hysteresis": "loose",
    "backlash": "loose",
    "inertial_load": "loose",
    "sensor_saturation": "loose",
    "loose_tool": "loose",
    "base_shift": "firm",
    "bias_step": "firm",
    "joint_compliance": "firm",
    "wrench_delay": "firm",
    "tracker_delay": "firm",
}
"""How well an effect's law is known; all others are exact."""


@dataclass(frozen=True)
class Settings:
    """kappa: fraction of what an effect explains that its law leaves, by how well it is known.

    dof: over how many directions that is spread. unknown_dof, unknown_cost: of the hypothesis that
    something else is there. more_cost: of each effect beyond the first. healthy: fraction of noise
    by which a healthy arm's excess may exceed chance. temper: power of the evidence.
    """

    kappa: Mapping[str, float] = field(
        default_factory=lambda: {"exact": 0.03, "firm": 0.06, "loose": 0.2}
    )
    dof: float = 12.0
    unknown_dof: float = 20.0
    unknown_cost: float = 5.0
    effect_cost: float = 5.0
    more_cost: float = 3.0
    healthy: float = 1.0
    temper: float = 0.5

    def kappa_of(self, effect: str) -> float:
        """Of an effect."""
        return float(self.kappa[LAWS.get(effect, "exact")])


def load_settings() -> Settings:
    """Those of the package's calibration."""
    file = resources.files("galen_diagnosis") / "calibration.json"
    if not file.is_file():
        return Settings()
    content = json.loads(file.read_text(encoding="utf-8"))
    return Settings(**content["settings"])
