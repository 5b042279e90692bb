"""The few numbers of the evidence that are not physics: calibrated on simulated recordings.

`python -m galen_diagnosis.inference.calibrate` makes `calibration.json`; causes, sessions and
unknown kinds there are others than those of `blind_check`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from importlib import resources
from typing import Any

from galen_model.files.json_fields import FieldError, get, mapping, number, parse_json

from galen_diagnosis.errors import DiagnosisError

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

_LAW_KINDS = ("exact", "firm", "loose")


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
    """Those of the package's calibration. Raises DiagnosisError."""
    file = resources.files(__package__) / "calibration.json"
    if not file.is_file():
        return Settings()
    try:
        return settings_from_json(parse_json(file.read_bytes()))
    except (OSError, FieldError) as error:
        raise DiagnosisError(f"{file}: {error}; install the package again") from error


def settings_from_json(content: Any) -> Settings:
    """From the file that `calibrate` writes; raises FieldError."""
    found = mapping(get(mapping(content, "the file"), "settings"), "settings")
    known = {field.name for field in fields(Settings)}
    if strange := set(found) ^ known:
        raise FieldError(f"settings: {sorted(strange)[0]!r:.40} is missing or unknown")
    kappa = mapping(found["kappa"], "kappa")
    return Settings(
        kappa={law: _positive(get(kappa, law), f"kappa.{law}") for law in _LAW_KINDS},
        **{name: _positive(found[name], name) for name in known - {"kappa"}},
    )


def _positive(value: Any, name: str) -> float:
    found = number(value, name)
    if found <= 0.0:
        raise FieldError(f"{name} is {found:g}; it must be positive")
    return found
