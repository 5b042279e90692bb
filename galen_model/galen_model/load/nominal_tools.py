"""The two tools and the adapter whose numbers the simulator starts with."""

from dataclasses import dataclass

import numpy as np

from galen_model.arrays import Array
from galen_model.load.model import Load


@dataclass(frozen=True)
class ToolGeometry:
    """A tool's load and its tip (3,) in ft_sensor, m."""

    load: Load
    tip_m: Array


ADAPTER = Load(0.100, np.array([0.0, 0.0, 0.020]))
"""The bias load: what stays on the sensor when no tool is on."""

TOOLS = {
    "pointer": ToolGeometry(
        Load(0.060, np.array([0.055, 0.002, 0.045])), np.array([0.150, 0.0, 0.050])
    ),
    "retractor": ToolGeometry(
        Load(0.200, np.array([0.070, -0.010, 0.055])), np.array([0.180, 0.010, 0.050])
    ),
}
