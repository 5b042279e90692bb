"""Did the robot's position stay constant? By two calibration sets, as in the 2019 report.

The first set registers the tracker as the report does (eq. 13), W = F(q_1) M_1^-1 with F the tip by
the joints and M the tool's marker in the base's; in the second one the tip is at W M_2 (eq. 14),
and by the joints at F(q_2). A tool marker that is not at the tip hardly counts, because the joints
are nearly the same.
"""

from __future__ import annotations

import numpy as np
from galen_model.arm.kinematics import tip_pose
from galen_model.arrays import Array
from galen_model.registration.rigid import Transform

from galen_deflection.collection.untouched import Untouched


def collection_shift(first: Untouched, second: Untouched, tip_m: Array) -> Array:
    """How far the tip (6,) is from where it should be, in base_link, m and rad."""
    registered = _tip(first, tip_m) @ _tool_in_base_marker(first).inverse()
    return (registered @ _tool_in_base_marker(second)).displacement_from(_tip(second, tip_m))


def shift_sentence(
    first: Untouched, second: Untouched, shift: Array, most_m: float, most_rad: float
) -> str:
    """A warning with the numbers where it is more than allowed, else empty."""
    moved_m, turned_rad = _sizes(shift)
    if moved_m <= most_m and turned_rad <= most_rad:
        return ""
    marker_m, marker_rad = _sizes(second.base.displacement_from(first.base))
    return (
        "the robot's position did not stay constant: between the calibration sets the tip moved by"
        f" {1e3 * moved_m:.3f} mm and {1e3 * turned_rad:.3f} mrad from where the joints say (at"
        f" most {1e3 * most_m:g} mm and {1e3 * most_rad:g} mrad): the base, a marker or the tool"
        f" moved; the tracker saw the base's marker move by {1e3 * marker_m:.3f} mm and"
        f" {1e3 * marker_rad:.3f} mrad"
    )


def _tip(at: Untouched, tip_m: Array) -> Transform:
    return Transform(*tip_pose(at.joints, tip_m))


def _tool_in_base_marker(at: Untouched) -> Transform:
    return at.base.inverse() @ at.tool


def _sizes(displacement: Array) -> tuple[float, float]:
    return float(np.linalg.norm(displacement[:3])), float(np.linalg.norm(displacement[3:]))
