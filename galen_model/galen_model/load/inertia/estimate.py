"""The inertia of tool and adapter together, as a calibration file may hold it under `inertia`.

Tool and adapter move as one, so no motion tells their inertias apart; only the sum is asked for.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from galen_model.arrays import Array
from galen_model.files.json_fields import FieldError, array, get, mapping, numbers
from galen_model.load.inertia.inertial import INERTIA_NAMES, inertia_matrix

_LARGEST_KG_M2 = 10.0
"""A tool of 1 kg would be metres long."""
_MOST_UNKNOWN = 0.5
"""Of the largest principal inertia: below minus it no other may be, whatever the covariance."""


@dataclass(frozen=True)
class InertiaEstimate:
    """Inertia (6,) about the sensor's origin in ft_sensor, kg m^2, and its covariance (6, 6).

    Order: `galen_model.load.inertia.inertial.INERTIA_NAMES`, xx yy zz xy xz yz.
    """

    about_sensor_kg_m2: Array
    covariance: Array

    @property
    def std_kg_m2(self) -> Array:
        """Standard deviations (6,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    def to_json(self) -> dict[str, Any]:
        """The content of the key `inertia`."""
        return {
            "about_sensor_kg_m2": numbers(self.about_sensor_kg_m2),
            "order": list(INERTIA_NAMES),
            "covariance": [numbers(row) for row in self.covariance],
        }

    @classmethod
    def from_json(cls, value: Any, name: str) -> InertiaEstimate:
        """From the key's content; raises FieldError that names what is wrong."""
        whole = mapping(value, name)
        inertia = array(
            get(whole, "about_sensor_kg_m2"), f"{name}.about_sensor_kg_m2", (len(INERTIA_NAMES),)
        )
        order = whole.get("order", list(INERTIA_NAMES))
        if order != list(INERTIA_NAMES):
            raise FieldError(f"{name}.order is not {' '.join(INERTIA_NAMES)}")
        covariance = array(get(whole, "covariance"), f"{name}.covariance", (6, 6))
        if np.any(np.diag(covariance) < 0.0):
            raise FieldError(f"{name}.covariance has a negative variance")
        if np.any(np.abs(inertia) > _LARGEST_KG_M2):
            raise FieldError(f"{name}.about_sensor_kg_m2 holds more than {_LARGEST_KG_M2:g} kg m^2")
        lowest, _, largest = np.linalg.eigvalsh(inertia_matrix(inertia)).tolist()
        # An estimate's noise may make the least principal one a little negative.
        noise = min(5.0 * float(np.sqrt(np.trace(covariance))), _MOST_UNKNOWN * largest)
        if lowest < -noise - 1e-12:
            raise FieldError(
                f"{name}.about_sensor_kg_m2 has a principal inertia of {lowest:.3g} kg m^2;"
                " they are positive"
            )
        return cls(inertia, covariance)
