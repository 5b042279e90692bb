"""Functions of before `Arm`, until every package has switched."""

from numpy.typing import ArrayLike

from galen_model.arm.arm import Arm
from galen_model.arm.galen import GALEN
from galen_model.arrays import Array


def platform_stiffness(platform_m: ArrayLike, arm: Arm = GALEN) -> Array:
    """Use `LinearDelta.platform_stiffness`."""
    assert arm.delta is not None
    return arm.delta.platform_stiffness(platform_m)


def tip_compliance(joints: ArrayLike, tip_m: ArrayLike, arm: Arm = GALEN) -> Array:
    """Use `Arm.tip_compliance`."""
    return arm.tip_compliance(joints, tip_m)


def deflection(
    joints: ArrayLike, applied_wrench: ArrayLike, tip_m: ArrayLike, arm: Arm = GALEN
) -> Array:
    """Use `Arm.deflection`."""
    return arm.deflection(joints, applied_wrench, tip_m)
