"""The parameters of sensor and mounting, by the names under which they are asked for.

Six gains hold two that no reading can tell without a weighed load: the mean of the three force
gains is a mass, that of the torque gains a centre. So gains are taken apart into their two means
and four ratios.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from galen_model.arm.galen import WRENCH_AXES
from galen_model.arrays import Array
from galen_model.errors import IdentificationError

PARAMETERS = (
    *(f"the sensor's rotation about {axis}" for axis in "xyz"),
    *(f"the gain of {axis}" for axis in WRENCH_AXES),
    "the base's inclination about x",
    "the base's inclination about y",
    "the roll joint's zero",
    "the tilt joint's zero",
)
"""Order of a mounting's parameters (13): rad, but for the gains."""

FORCE_GAIN = "the common force gain"
TORQUE_GAIN = "the common torque gain"


@dataclass(frozen=True)
class Entity:
    """A direction (13,) among the parameters that is told, or not, as one; its name."""

    name: str
    direction: Array


def _gain(name: str, first: int, *parts: float) -> Entity:
    direction = np.zeros(len(PARAMETERS))
    direction[first : first + 3] = parts
    return Entity(name, direction)


def _single(index: int) -> Entity:
    return Entity(PARAMETERS[index], np.eye(len(PARAMETERS))[index])


_ROTATION = tuple(_single(index) for index in range(3))
_FORCE = _gain(FORCE_GAIN, 3, 1.0, 1.0, 1.0)
_TORQUE = _gain(TORQUE_GAIN, 6, 1.0, 1.0, 1.0)
_FORCE_RATIO = (
    _gain("the ratio of the gains of fx and fy", 3, 1.0, -1.0, 0.0),
    _gain("the ratio of the gain of fz to those of fx and fy", 3, -0.5, -0.5, 1.0),
)
_TORQUE_RATIO = (
    _gain("the ratio of the gains of tx and ty", 6, 1.0, -1.0, 0.0),
    _gain("the ratio of the gain of tz to those of tx and ty", 6, -0.5, -0.5, 1.0),
)
_INCLINATION = (_single(9), _single(10))
_ZERO = (_single(11), _single(12))

GROUPS: dict[str, tuple[Entity, ...]] = {
    "sensor_rotation": _ROTATION,
    "axis_gain": (_FORCE, *_FORCE_RATIO, _TORQUE, *_TORQUE_RATIO),
    "base_inclination": _INCLINATION,
    "joint_zero": _ZERO,
    "sensor_rotation_x": _ROTATION[:1],
    "sensor_rotation_y": _ROTATION[1:2],
    "sensor_rotation_z": _ROTATION[2:],
    "force_gain": (_FORCE, *_FORCE_RATIO),
    "torque_gain": (_TORQUE, *_TORQUE_RATIO),
    "gain_ratio": (*_FORCE_RATIO, *_TORQUE_RATIO),
    "force_gain_ratio": _FORCE_RATIO,
    "torque_gain_ratio": _TORQUE_RATIO,
    "base_inclination_x": _INCLINATION[:1],
    "base_inclination_y": _INCLINATION[1:],
    "roll_zero": _ZERO[:1],
    "tilt_zero": _ZERO[1:],
}
"""What can be asked for, and which directions it holds."""


def entities(groups: Sequence[str]) -> tuple[Entity, ...]:
    """The directions of `groups`, each once; raises IdentificationError for an unknown name."""
    for group in groups:
        if group not in GROUPS:
            raise IdentificationError(
                f"{group!r:.60} can't be estimated; known are: {', '.join(GROUPS)}"
            )
    found = {entity.name: entity for group in groups for entity in GROUPS[group]}
    return tuple(found.values())
