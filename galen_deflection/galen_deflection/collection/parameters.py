"""The collection node's parameters."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from galen_model.arrays import Array
from galen_ros.goal.parameters import MotionParameters
from galen_ros.parameters import param

from galen_deflection.collection.plan import MOST_SETS, LoadLimits, make_plan

_POSITIONS = (
    (0.00, 0.00, 0.408, 0.0, 0.0),
    (0.06, -0.05, 0.43, 0.7, -0.4),
    (-0.07, 0.04, 0.37, -0.9, 0.5),
    (0.03, 0.07, 0.40, 0.3, 0.8),
)
"""Those of bags/pushes."""


@dataclass(frozen=True)
class CollectionParameters(MotionParameters):
    """Parameters of collection_node."""

    tools_dir: str = param("~/.ros/galen/tools", "directory of the tools' files; `~` is expanded")
    recordings_dir: str = param(
        "~/.ros/galen/recordings", "directory in which the recordings are made; `~` is expanded"
    )

    positions: tuple[float, ...] = param(
        [value for joints in _POSITIONS for value in joints],
        "five joints a position: delta x, y, z in m, roll, tilt in rad; the first is also that of"
        " the calibration sets",
    )
    sets: int = param(2, "how often each position is visited", minimum=1, maximum=MOST_SETS)
    forces_n: tuple[float, ...] = param(
        [3.0, 6.0, 10.0], "levels of force to both sides along each axis of base_link, N"
    )
    torques_nm: tuple[float, ...] = param(
        [], "levels of torque about the tip to both sides about each axis of base_link, N·m"
    )

    untouched_s: float = param(
        3.0, "the tool is left alone for so long at the start of each set", 0.6, 60.0
    )
    untouched_force_n: float = param(
        0.2, "left alone, the mean force of 0.1 s stays this near to itself", 0.001, 10.0
    )
    untouched_torque_nm: float = param(0.02, "likewise the torque, N·m", 1e-5, 1.0)
    untouched_timeout_s: float = param(
        60.0, "a tool that is not left alone, or a marker not seen, for so long ends it", 1.0, 3600
    )
    max_marker_gap_s: float = param(
        0.2, "a marker that isn't seen for longer spoils a push or a start", 0.01, 10.0
    )

    level_tolerance: float = param(
        0.15, "a push is as asked within this share of its level", 0.01, 1.0
    )
    aside_share: float = param(
        0.3, "most of it that may go aside of its axis, as a share of its level", 0.01, 10.0
    )
    overload_share: float = param(
        1.6, "a push that comes to this share of its level is asked for again", 1.05, 100.0
    )
    hold_s: float = param(0.5, "a push is held for so long", 0.05, 60.0)
    rest_s: float = param(0.5, "the tool is left alone for so long after a push", 0.1, 60.0)
    released_n: float = param(0.15, "let go of, below this force", 0.001, 10.0)
    released_nm: float = param(0.02, "and this torque about the tip, N·m", 1e-5, 1.0)
    push_timeout_s: float = param(20.0, "a person has so long for a push", 0.5, 3600.0)
    release_timeout_s: float = param(10.0, "and so long to let go", 0.5, 3600.0)
    push_retries: int = param(1, "how often a push that was not as asked is asked for again", 0, 10)
    max_left_out_in_a_row: int = param(4, "so many pushes left out in a row end it", 1, 10_000)
    push_rise_s: float = param(0.3, "time in which `push_tool` shall rise", 0.01, 10.0)
    push_fall_s: float = param(0.3, "and fall", 0.01, 10.0)

    max_force_n: float = param(20.0, "more force, at any time, stops the arm, N", 0.1, 500.0)
    max_torque_nm: float = param(
        2.9, "more torque about the sensor's origin stops the arm, N·m", 0.01, 100.0
    )
    shift_tolerance_m: float = param(
        0.0001, "largest way of the tip between the calibration sets, m", 1e-6, 0.1
    )
    shift_tolerance_rad: float = param(0.0003, "and its largest turn, rad", 1e-6, 0.5)

    def validate(self) -> None:
        """Reject positions or levels that can't be; raises PlanError."""
        make_plan(self.positions, self.forces_n, self.torques_nm, self.sets, _NO_TIP, self.limits)

    @property
    def limits(self) -> LoadLimits:
        """What the sensor may read."""
        return LoadLimits(self.max_force_n, self.max_torque_nm)

    def folder(self, name: str) -> Path:
        """One of the two directories, by its parameter's name."""
        return Path(getattr(self, name)).expanduser()

    @property
    def untouched_tolerance(self) -> Array:
        """(6,), N and N.m: without contact the mean wrench stays this near to itself."""
        return np.array([self.untouched_force_n] * 3 + [self.untouched_torque_nm] * 3)


_NO_TIP = np.zeros(3)
