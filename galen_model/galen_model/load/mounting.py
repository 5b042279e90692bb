# SPDX-License-Identifier: Apache-2.0
"""How the sensor sits in its mount and the base on its stand, and what both do to a reading.

With the conventions of the effects `sensor_mount_rotation`, `axis_gain`, `base_inclination`,
`joint_zero_offset`: S = exp(rotvec) turns the sensing element in the sensor's frame
(the tool is not turned), reading_k = (1 + g_k) true_k, gravity in the base's frame is
(Rx(a) Ry(b) Rz(c))^T g with the arm's g, and a true angle is the reported one plus its zero. So

    u(q)    = R_base_sensor(q + zeros)^T (Rx(a) Ry(b) Rz(c))^T g
    reading = M w(u),   M = diag(1 + g) blockdiag(S^T, S^T)

for a wrench w in the sensor's frame. The element reads about the same origin, so force and torque
turn alike. Zeroing subtracts a reading; with M linear, M w(u) - M w(u_0) = M (w(u) - w(u_0)), so
that the adapter's part at the zeroing pose goes through M as all others do, and a push F reads M F.
C = M^-1 gives it back from the difference of two readings.

The parameters of sensor and mounting, by the names under which they are asked for.

Six gains hold two that no reading can tell without a weighed load: the mean of the three force
gains is a mass, that of the torque gains a centre. So gains are taken apart into their two means
and four ratios.

A turn about gravity changes nothing: an inclination is two angles, about the base's axes other than
the one nearest to gravity, and the third stays at zero.

Not every joint's zero changes gravity in the sensor. That of a joint about gravity itself, as of
most arms' first one, stays at zero; of joints in a row with parallel axes, as a UR's second to
fourth, only the sum is told, and `joint_zero` spreads it evenly.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from galen_model.arm.arm import Arm
from galen_model.arm.galen import GALEN, WRENCH_AXES
from galen_model.arrays import Array
from galen_model.errors import IdentificationError
from galen_model.json_fields import FieldError, array, get, mapping, number, numbers, texts
from galen_model.rotation import rot_x, rot_y, rot_z, rotvec_to_matrix

_PARAMETERS = (
    *(f"the sensor's rotation about {axis}" for axis in "xyz"),
    *(f"the gain of {axis}" for axis in WRENCH_AXES),
    *(f"the base's inclination about {axis}" for axis in "xyz"),
)
ZEROS = len(_PARAMETERS)
"""Where the joints' zeros begin among the parameters."""


def parameters(joints: Sequence[str]) -> tuple[str, ...]:
    """Name a mounting's 12 + k parameters, rad but for gains.

    Args:
        joints: names of the k revolute joints.

    Returns:
        Names in the order of `Mounting.vector`.

    """
    return (*_PARAMETERS, *(f"the {name} joint's zero" for name in joints))


FORCE_GAIN = "the common force gain"
TORQUE_GAIN = "the common torque gain"
COMMON_ZERO = "the common zero of the joints"


@dataclass(frozen=True)
class Entity:
    """A direction (12 + k,) among the parameters that is told, or not, as one; its name."""

    name: str
    direction: Array


def inclination_axes(gravity: ArrayLike) -> str:
    """Choose the two base axes of an inclination: those other than the one nearest to gravity.

    Args:
        gravity: (3,) in the base's frame.

    Returns:
        Their letters: "xy" for gravity along z.

    """
    return "xyz".replace("zyx"[int(np.argmax(np.abs(np.asarray(gravity))[::-1]))], "")


def groups_of(arm: Arm) -> dict[str, tuple[Entity, ...]]:
    """List what can be asked for of an arm, and which directions it holds.

    Args:
        arm: with its turning joints and gravity.

    Returns:
        Directions by group; a group is empty where nothing in it changes gravity in the sensor.

    """
    joints = arm.turning_names
    names = parameters(joints)

    def single(index: int) -> Entity:
        return Entity(names[index], np.eye(len(names))[index])

    def gain(name: str, first: int, *parts: float) -> Entity:
        direction = np.zeros(len(names))
        direction[first : first + 3] = parts
        return Entity(name, direction)

    rotation = tuple(single(index) for index in range(3))
    force = gain(FORCE_GAIN, 3, 1.0, 1.0, 1.0)
    torque = gain(TORQUE_GAIN, 6, 1.0, 1.0, 1.0)
    force_ratio = (
        gain("the ratio of the gains of fx and fy", 3, 1.0, -1.0, 0.0),
        gain("the ratio of the gain of fz to those of fx and fy", 3, -0.5, -0.5, 1.0),
    )
    torque_ratio = (
        gain("the ratio of the gains of tx and ty", 6, 1.0, -1.0, 0.0),
        gain("the ratio of the gain of tz to those of tx and ty", 6, -0.5, -0.5, 1.0),
    )
    inclination = tuple(single(index) for index in range(9, ZEROS))
    zero = tuple(single(ZEROS + k) for k in range(len(joints)))
    return {
        "sensor_rotation": rotation,
        "axis_gain": (force, *force_ratio, torque, *torque_ratio),
        "base_inclination": tuple(
            inclination["xyz".index(axis)] for axis in inclination_axes(arm.gravity_m_s2)
        ),
        "joint_zero": _told_zeros(arm, zero),
        "sensor_rotation_x": rotation[:1],
        "sensor_rotation_y": rotation[1:2],
        "sensor_rotation_z": rotation[2:],
        "force_gain": (force, *force_ratio),
        "torque_gain": (torque, *torque_ratio),
        "gain_ratio": (*force_ratio, *torque_ratio),
        "force_gain_ratio": force_ratio,
        "torque_gain_ratio": torque_ratio,
        "base_inclination_x": inclination[:1],
        "base_inclination_y": inclination[1:2],
        "base_inclination_z": inclination[2:],
        **{f"{name}_zero": (one,) for name, one in zip(joints, zero, strict=True)},
    }


_PARALLEL_RAD = 1e-3
"""Axes that differ by less are parallel: robot descriptions round right angles to this."""


def _told_zeros(arm: Arm, zero: Sequence[Entity]) -> tuple[Entity, ...]:
    """Return the zeros, of joints (k,), that change gravity in the sensor; parallel ones as one."""
    if not zero:
        return ()
    q = np.random.default_rng(0).uniform(-1.0, 1.0, (4, len(arm.joints)))
    axes = arm.joint_axes(q)[1][:, arm.turning]
    chains: list[list[int]] = []
    for k in range(len(zero)):
        if k and _parallel(axes[:, k - 1], axes[:, k]):
            chains[-1].append(k)
        else:
            chains.append([k])
    found = []
    for chain in chains:
        if _parallel(axes[:, chain[0]], arm.gravity_m_s2 / np.linalg.norm(arm.gravity_m_s2)):
            continue
        first, *others = (zero[k] for k in chain)
        if others:
            signs = np.sign(axes[0, chain] @ axes[0, chain[0]])
            direction = sum(sign * zero[k].direction for sign, k in zip(signs, chain, strict=True))
            names = ", ".join(arm.turning_names[k] for k in chain)
            first = Entity(f"{COMMON_ZERO} {names}", np.asarray(direction))
        found.append(first)
    return tuple(found)


def _parallel(a: Array, b: Array) -> bool:
    return bool(np.all(np.linalg.norm(np.cross(a, b), axis=-1) < _PARALLEL_RAD))


GROUPS = (*tuple(groups_of(GALEN))[: -len(GALEN.turning)], "JOINT_zero")
"""Names of what can be asked for; JOINT stands for any revolute joint of the arm."""


def entities(names: Sequence[str], arm: Arm) -> tuple[Entity, ...]:
    """Collect the directions of groups, each once.

    Args:
        names: of groups.
        arm: with its turning joints and gravity.

    Returns:
        Directions in the order of the names.

    Raises:
        IdentificationError: there is no such group, or it is empty for this arm.

    """
    known = groups_of(arm)
    for name in names:
        if name not in known:
            raise IdentificationError(
                f"{name!r:.60} can't be estimated; known are: {', '.join(known)}"
            )
        if not known[name]:
            raise IdentificationError(
                f"{name!r} can't be estimated: no joint's zero of the arm '{arm.name}' changes"
                " gravity in the sensor"
            )
    found = {entity.name: entity for name in names for entity in known[name]}
    return tuple(found.values())


_LARGEST_GAIN = 0.5
_ANGLES = ("about_x", "about_y", "about_z")
_ABOUT_Z = ZEROS - 1


def inclination(about_rad: ArrayLike) -> Array:
    """Compute (Rx(a) Ry(b) Rz(c))^T, which takes a level base's gravity into the inclined.

    Args:
        about_rad: a, b, c (3,).

    Returns:
        (3, 3), in the base's frame.

    """
    a, b, c = np.asarray(about_rad, dtype=float)
    return np.asarray((rot_x(a) @ rot_y(b) @ rot_z(c)).T)


@dataclass(frozen=True)
class Mounting:
    """Rotation and gains of the sensor, inclination of the base (about x, y, z), joint zeros.

    axis_gain (6,) in the order fx fy fz tx ty tz; all others in rad, joint_zero_rad (k,) of the
    revolute `joints`. estimated: the names of groups that a calibration told; what is not among
    them is zero by assumption. covariance: (12 + k, 12 + k) in the order of `parameters`, zero
    where not estimated.
    """

    sensor_rotvec_rad: Array
    axis_gain: Array
    base_inclination_rad: Array
    joint_zero_rad: Array
    estimated: tuple[str, ...]
    covariance: Array
    joints: tuple[str, ...]

    @staticmethod
    def of(arm: Arm) -> "Mounting":
        """Make the mounting of an arm whose sensor and joints are as they should be.

        Args:
            arm: with its turning joints.

        Returns:
            All parameters zero.

        """
        return Mounting.from_vector(np.zeros(ZEROS + len(arm.turning)), joints=arm.turning_names)

    @staticmethod
    def from_vector(
        vector: Array,
        estimated: tuple[str, ...] = (),
        covariance: Array | None = None,
        *,
        joints: tuple[str, ...],
    ) -> "Mounting":
        """Make a mounting of its parameters.

        Args:
            vector: (12 + k,) in the order of `parameters`.
            estimated: names of the groups that were estimated.
            covariance: (12 + k, 12 + k); None: zero.
            joints: names of the k revolute joints.

        Returns:
            The mounting.

        """
        none = np.zeros((len(vector), len(vector)))
        return Mounting(
            vector[:3], vector[3:9], vector[9:ZEROS], vector[ZEROS:], estimated,
            none if covariance is None else covariance, joints,
        )  # fmt: skip

    @property
    def vector(self) -> Array:
        """The parameters (12 + k,) in the order of `parameters`."""
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
        """Standard deviations (12 + k,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def rows(self) -> list[tuple[str, float, float, str]]:
        """Name, value, standard deviation and unit (deg or %) of what was estimated."""
        rows, names = [], parameters(self.joints)
        for index in np.flatnonzero(self.std > 0.0):
            factor, unit = (100.0, "%") if 3 <= index < 9 else (np.degrees(1.0), "deg")
            value, std = factor * self.vector[index], factor * self.std[index]
            rows.append((names[index], float(value), float(std), unit))
        return rows

    @property
    def inclination(self) -> Array:
        """(3, 3): takes a level base's gravity into the inclined one."""
        return inclination(self.base_inclination_rad)

    def gravity_direction(self, arm: Arm) -> Array:
        """Compute the direction of gravity in the arm's base frame, inclined.

        Args:
            arm: whose base it is.

        Returns:
            Unit vector (3,).

        """
        return self.inclination @ (arm.gravity_m_s2 / np.linalg.norm(arm.gravity_m_s2))

    def gravity_in_sensor(self, angles: ArrayLike | None, arm: Arm) -> Array:
        """Compute gravity in the sensor's frame, with inclination and zeros.

        Args:
            angles: reported (..., k) of the turning joints, rad; None: home.
            arm: whose joints they are.

        Returns:
            (..., 3), m/s^2.

        """
        reported = arm.home_angles if angles is None else np.asarray(angles, dtype=float)
        true = reported + self.joint_zero_rad
        size = float(np.linalg.norm(arm.gravity_m_s2))
        return arm.direction_in_sensor(true, self.gravity_direction(arm)) * size

    def turned_gravity(self, gravity_sensor: ArrayLike, base_from_sensor: ArrayLike) -> Array:
        """Compute gravity in the sensor's frame as the inclined base has it.

        u + R^T ((Rx(a) Ry(b) Rz(c))^T - 1) R u.

        Args:
            gravity_sensor: u (n, 3) in the sensor's frame of a level base, m/s^2.
            base_from_sensor: R = R_base_sensor (n, 3, 3).

        Returns:
            (n, 3), m/s^2.

        """
        gravity = np.asarray(gravity_sensor, dtype=float)[..., None]
        rotation = np.asarray(base_from_sensor, dtype=float)
        change = (self.inclination - np.eye(3)) @ (rotation @ gravity)
        return np.asarray((gravity + np.swapaxes(rotation, -1, -2) @ change)[..., 0])

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
        """Convert to the content that the calibration file holds.

        Returns:
            The fields, without the base's angle about z where it is none.

        """
        angles = dict(zip(_ANGLES, numbers(self.base_inclination_rad), strict=True))
        covariance = self.covariance
        if not (angles["about_z"] or self.std[_ABOUT_Z]):
            del angles["about_z"]
            covariance = np.delete(np.delete(covariance, _ABOUT_Z, 0), _ABOUT_Z, 1)
        return {
            "sensor_rotvec_rad": numbers(self.sensor_rotvec_rad),
            "axis_gain": numbers(self.axis_gain),
            "base_inclination_rad": angles,
            "joint_zero_rad": dict(zip(self.joints, numbers(self.joint_zero_rad), strict=True)),
            "estimated": list(self.estimated),
            "covariance": [numbers(row) for row in covariance],
        }

    @staticmethod
    def from_json(value: Any, name: str, arm: Arm) -> "Mounting":
        """Read a mounting as `to_json` writes it.

        Args:
            value: the content as parsed.
            name: the field's name in errors.
            arm: whose joints the zeros are of.

        Returns:
            The mounting.

        Raises:
            FieldError: a field is missing or wrong; the message names it.

        """
        whole = mapping(value, name)
        rotvec = array(get(whole, "sensor_rotvec_rad"), f"{name}.sensor_rotvec_rad", (3,))
        gain = array(get(whole, "axis_gain"), f"{name}.axis_gain", (6,))
        given = mapping(get(whole, "base_inclination_rad"), f"{name}.base_inclination_rad")
        about_z = "about_z" in given
        inclined = _parts(whole, "base_inclination_rad", _ANGLES[: 2 + about_z], name)
        zero = _parts(whole, "joint_zero_rad", arm.turning_names, name)
        count = ZEROS - 1 + about_z + len(zero)
        covariance = array(get(whole, "covariance"), f"{name}.covariance", (count, count))
        if not about_z:
            inclined = np.append(inclined, 0.0)
            covariance = np.insert(np.insert(covariance, _ABOUT_Z, 0.0, 0), _ABOUT_Z, 0.0, 1)
        estimated = texts(get(whole, "estimated"), f"{name}.estimated")
        if np.linalg.norm(rotvec) > np.pi:
            raise FieldError(f"{name}.sensor_rotvec_rad turns by more than pi")
        if np.any(np.abs(gain) > _LARGEST_GAIN):
            raise FieldError(f"{name}.axis_gain has one beyond {_LARGEST_GAIN}")
        for field_name, angles in (("base_inclination_rad", inclined), ("joint_zero_rad", zero)):
            if np.any(np.abs(angles) > np.pi / 2):
                raise FieldError(f"{name}.{field_name} has an angle beyond pi/2")
        if np.any(np.diag(covariance) < 0.0):
            raise FieldError(f"{name}.covariance has a negative variance")
        known = groups_of(arm)
        for group in estimated:
            if group not in known:
                raise FieldError(f"{name}.estimated names {group!r:.40}, which is no parameter")
        return Mounting(rotvec, gain, inclined, zero, estimated, covariance, arm.turning_names)


def _parts(whole: Any, key: str, parts: Sequence[str], name: str) -> Array:
    inner = mapping(get(whole, key), f"{name}.{key}")
    return np.array([number(get(inner, part), f"{name}.{key}.{part}") for part in parts])
