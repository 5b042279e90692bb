"""How the sensor sits in its mount and the base on its stand, and what both do to a reading.

With the conventions of the effects `sensor_mount_rotation`, `axis_gain`, `base_inclination`,
`joint_zero_offset`: S = exp(rotvec) turns the sensing element in ft_sensor
(the tool is not turned), reading_k = (1 + g_k) true_k, gravity in base_link is
(Rx(a) Ry(b))^T (0, 0, -g), and a true angle is the reported one plus its zero. So

    u(q)    = R_base_sensor(q + zeros)^T (Rx(a) Ry(b))^T (0, 0, -g)
    reading = M w(u),   M = diag(1 + g) blockdiag(S^T, S^T)

for a wrench w in ft_sensor. The element reads about the same origin, so force and torque turn
alike. Zeroing takes a reading off; with M linear, M w(u) - M w(u_0) = M (w(u) - w(u_0)), so that
the adapter's part at the zeroing pose goes through M as all others do, and a push F reads M F.
C = M^-1 gives it back from the difference of two readings.

The parameters of sensor and mounting, by the names under which they are asked for.

Six gains hold two that no reading can tell without a weighed load: the mean of the three force
gains is a mass, that of the torque gains a centre. So gains are taken apart into their two means
and four ratios.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from galen_model.arm.arm import Arm
from galen_model.arm.galen import GALEN, GRAVITY_M_S2, WRENCH_AXES
from galen_model.arrays import Array
from galen_model.errors import IdentificationError
from galen_model.files.json_fields import FieldError, array, get, mapping, number, numbers, texts
from galen_model.rotation import rotvec_to_matrix

PARAMETERS = (
    *(f"the sensor's rotation about {axis}" for axis in "xyz"),
    *(f"the gain of {axis}" for axis in WRENCH_AXES),
    "the base's inclination about x",
    "the base's inclination about y",
    *(f"the {name} joint's zero" for name in GALEN.turning_names),
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
_ZERO = tuple(map(_single, range(11, len(PARAMETERS))))

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
    **{f"{name}_zero": (zero,) for name, zero in zip(GALEN.turning_names, _ZERO, strict=True)},
}
"""What can be asked for, and which directions it holds."""


def entities(groups: Sequence[str]) -> tuple[Entity, ...]:
    """Return the directions of `groups`, each once; raises IdentificationError."""
    for group in groups:
        if group not in GROUPS:
            raise IdentificationError(
                f"{group!r:.60} can't be estimated; known are: {', '.join(GROUPS)}"
            )
    found = {entity.name: entity for group in groups for entity in GROUPS[group]}
    return tuple(found.values())


_LARGEST_GAIN = 0.5
_COUNT = len(PARAMETERS)


def gravity_direction(about_x_rad: float, about_y_rad: float) -> Array:
    """Return unit vector (3,) of gravity in base_link, (Rx(a) Ry(b))^T (0, 0, -1), written out."""
    sin_a, cos_a = np.sin(about_x_rad), np.cos(about_x_rad)
    sin_b, cos_b = np.sin(about_y_rad), np.cos(about_y_rad)
    return np.array([sin_b * cos_a, -sin_a, -cos_b * cos_a])


@dataclass(frozen=True)
class Mounting:
    """Rotation and gains of the sensor, inclination of the base (about x, y), joint zeros.

    axis_gain (6,) in the order fx fy fz tx ty tz; all others in rad. estimated: the names of
    `GROUPS` that a calibration told; what is not among them is
    zero by assumption. covariance: (13, 13) in the order of `PARAMETERS`, zero where not estimated.
    """

    sensor_rotvec_rad: Array = field(default_factory=lambda: np.zeros(3))
    axis_gain: Array = field(default_factory=lambda: np.zeros(6))
    base_inclination_rad: Array = field(default_factory=lambda: np.zeros(2))
    joint_zero_rad: Array = field(default_factory=lambda: np.zeros(2))
    estimated: tuple[str, ...] = ()
    covariance: Array = field(default_factory=lambda: np.zeros((_COUNT, _COUNT)))

    @staticmethod
    def from_vector(
        vector: Array, estimated: tuple[str, ...] = (), covariance: Array | None = None
    ) -> "Mounting":
        """Of parameters (13,) in the order of `PARAMETERS`."""
        none = np.zeros((_COUNT, _COUNT))
        return Mounting(
            vector[:3], vector[3:9], vector[9:11], vector[11:13], estimated,
            none if covariance is None else covariance,
        )  # fmt: skip

    @property
    def vector(self) -> Array:
        """The parameters (13,) in the order of `PARAMETERS`."""
        return np.concatenate(
            [
                self.sensor_rotvec_rad,
                self.axis_gain,
                self.base_inclination_rad,
                self.joint_zero_rad,
            ]
        )

    @property
    def std(self) -> Array:
        """Standard deviations (13,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def rows(self) -> list[tuple[str, float, float, str]]:
        """Name, value, standard deviation and unit (deg or %) of what was estimated."""
        rows = []
        for index in np.flatnonzero(self.std > 0.0):
            factor, unit = (100.0, "%") if 3 <= index < 9 else (np.degrees(1.0), "deg")
            value, std = factor * self.vector[index], factor * self.std[index]
            rows.append((PARAMETERS[index], float(value), float(std), unit))
        return rows

    @property
    def gravity_direction(self) -> Array:
        """Unit vector (3,) of gravity in base_link."""
        return gravity_direction(*self.base_inclination_rad)

    def gravity_in_sensor(self, angles: ArrayLike | None, arm: Arm = GALEN) -> Array:
        """Gravity (..., 3) in the sensor, m/s^2, at reported angles (..., k); None for home."""
        reported = arm.home_angles if angles is None else np.asarray(angles, dtype=float)
        true = reported + self.joint_zero_rad
        return arm.direction_in_sensor(true, self.gravity_direction) * -GRAVITY_M_S2[2]

    def turned_gravity(self, gravity_sensor: ArrayLike, base_from_sensor: ArrayLike) -> Array:
        """Gravity (n, 3) in ft_sensor as the inclined base has it.

        From the gravity (n, 3) of a level base and R_base_sensor (n, 3, 3): u + g R^T (d - d_0).
        """
        gravity = np.asarray(gravity_sensor, dtype=float)
        change = self.gravity_direction - gravity_direction(0.0, 0.0)
        size = np.linalg.norm(gravity, axis=-1, keepdims=True)
        turned = np.einsum("nji,j->ni", np.asarray(base_from_sensor, dtype=float), change)
        return np.asarray(gravity + size * turned)

    @property
    def reading_from_wrench(self) -> Array:
        """M (6, 6): what the sensor makes of a wrench in ft_sensor."""
        turned = np.zeros((6, 6))
        turned[:3, :3] = turned[3:, 3:] = rotvec_to_matrix(self.sensor_rotvec_rad).T
        return (1.0 + self.axis_gain)[:, None] * turned

    @property
    def wrench_from_reading(self) -> Array:
        """C (6, 6) = M^-1: undoes the gains, then the rotation."""
        turned = np.zeros((6, 6))
        turned[:3, :3] = turned[3:, 3:] = rotvec_to_matrix(self.sensor_rotvec_rad)
        return turned / (1.0 + self.axis_gain)[None, :]

    def to_json(self) -> dict[str, Any]:
        """As the calibration file holds it."""
        about_x, about_y = numbers(self.base_inclination_rad)
        return {
            "sensor_rotvec_rad": numbers(self.sensor_rotvec_rad),
            "axis_gain": numbers(self.axis_gain),
            "base_inclination_rad": {"about_x": about_x, "about_y": about_y},
            "joint_zero_rad": dict(
                zip(GALEN.turning_names, numbers(self.joint_zero_rad), strict=True)
            ),
            "estimated": list(self.estimated),
            "covariance": [numbers(row) for row in self.covariance],
        }

    @staticmethod
    def from_json(value: Any, name: str) -> "Mounting":
        """Read back; raises FieldError naming the field below `name`."""
        whole = mapping(value, name)
        rotvec = array(get(whole, "sensor_rotvec_rad"), f"{name}.sensor_rotvec_rad", (3,))
        gain = array(get(whole, "axis_gain"), f"{name}.axis_gain", (6,))
        inclination = _pair(whole, "base_inclination_rad", ("about_x", "about_y"), name)
        zero = _pair(whole, "joint_zero_rad", GALEN.turning_names, name)
        covariance = array(get(whole, "covariance"), f"{name}.covariance", (_COUNT, _COUNT))
        estimated = texts(get(whole, "estimated"), f"{name}.estimated")
        if np.linalg.norm(rotvec) > np.pi:
            raise FieldError(f"{name}.sensor_rotvec_rad turns by more than pi")
        if np.any(np.abs(gain) > _LARGEST_GAIN):
            raise FieldError(f"{name}.axis_gain has one beyond {_LARGEST_GAIN}")
        for field_name, angles in (("base_inclination_rad", inclination), ("joint_zero_rad", zero)):
            if np.any(np.abs(angles) > np.pi / 2):
                raise FieldError(f"{name}.{field_name} has an angle beyond pi/2")
        if np.any(np.diag(covariance) < 0.0):
            raise FieldError(f"{name}.covariance has a negative variance")
        for group in estimated:
            if group not in GROUPS:
                raise FieldError(f"{name}.estimated names {group!r:.40}, which is no parameter")
        return Mounting(rotvec, gain, inclination, zero, estimated, covariance)


def _pair(whole: Any, key: str, parts: Sequence[str], name: str) -> Array:
    inner = mapping(get(whole, key), f"{name}.{key}")
    return np.array([number(get(inner, part), f"{name}.{key}.{part}") for part in parts])
