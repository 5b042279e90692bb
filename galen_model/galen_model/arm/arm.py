# SPDX-License-Identifier: Apache-2.0
"""One arm: the joints between its base and its force/torque sensor, and what follows from them.

With joint k's placement (R_k, p_k) in the link before it, its axis a_k and its value q_k

    T_base_sensor = prod_k [Trans(p_k) R_k M(a_k, q_k)] T_mount,

where M is a rotation about a_k (revolute) or a translation along it (prismatic). Source: product
of exponentials as in Lynch and Park, *Modern Robotics*, 2017, section 4.1; Pinocchio gives the same
from the URDF, and a test compares the two.

Joints come as arrays in the order of `Arm.joints`. Gravity in the sensor depends on the revolute
joints alone: `Arm.turning` are their places, and an array of their values is called `angles`.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from galen_model.arm.delta import LinearDelta
from galen_model.arrays import Array
from galen_model.errors import KinematicsError
from galen_model.registration import move_wrench
from galen_model.rotation import about, skew

STANDARD_GRAVITY_M_S2 = 9.80665
GRAVITY_RANGE_M_S2 = 9.7, 9.9
"""Sizes of gravity that are on earth."""
MAX_URDF_BYTES = 10_000_000


def constant(*values: float) -> Array:
    """Make an array that can't be written to.

    Args:
        *values: its elements.

    Returns:
        (n,).

    """
    array = np.array(values, dtype=float)
    array.setflags(write=False)
    return array


Components = tuple[Any, Any, Any]
"""Components of a vector: floats, or arrays of one shape."""


def _placement(joint: Joint) -> list[float]:
    rotation = np.eye(3) if joint.rotation is None else joint.rotation
    return [*joint.axis, *joint.origin_m, *rotation.flat, joint.lower, joint.upper]


def _same(one: ArrayLike, other: ArrayLike) -> bool:
    return bool(np.allclose(one, other, rtol=0.0, atol=1e-9))


Turn = Callable[[Components, Any, Any], Components]
"""Rot(a, q)^T v of v, cos q and sin q."""


def _about_x(parts: Components, cos: Any, sin: Any) -> Components:
    x, y, z = parts
    return x, y * cos + z * sin, z * cos - y * sin


def _about_y(parts: Components, cos: Any, sin: Any) -> Components:
    x, y, z = parts
    return x * cos - z * sin, y, z * cos + x * sin


def _about_z(parts: Components, cos: Any, sin: Any) -> Components:
    x, y, z = parts
    return x * cos + y * sin, y * cos - x * sin, z


def _about(axis: Array) -> Turn:
    """Return the turn about a unit axis (3,), by Rodrigues' formula."""
    a, b, c = axis.tolist()

    def turn(parts: Components, cos: Any, sin: Any) -> Components:
        x, y, z = parts
        along = (a * x + b * y + c * z) * (1.0 - cos)
        return (
            x * cos - (b * z - c * y) * sin + a * along,
            y * cos - (c * x - a * z) * sin + b * along,
            z * cos - (a * y - b * x) * sin + c * along,
        )

    return turn


def _joint_turn(joint: Joint) -> Turn:
    own = {(1.0, 0.0, 0.0): _about_x, (0.0, 1.0, 0.0): _about_y, (0.0, 0.0, 1.0): _about_z}
    about = own.get(tuple(joint.axis.tolist())) or _about(joint.axis)
    if joint.rotation is None:
        return about
    fixed = _fixed(joint.rotation)
    return lambda parts, cos, sin: about(fixed(parts), cos, sin)


def _fixed(rotation: Array) -> Callable[[Components], Components]:
    """Return R^T v; where R only swaps axes, components keep their last bit."""
    columns = rotation.T.tolist()
    exact = np.round(rotation)
    if np.allclose(rotation, exact, rtol=0.0, atol=1e-15):
        (i, j, k), (a, b, c) = np.argmax(np.abs(exact), axis=0).tolist(), exact.sum(axis=0).tolist()
        return lambda parts: (a * parts[i], b * parts[j], c * parts[k])

    def turned(parts: Components) -> Components:
        x, y, z = (a * parts[0] + b * parts[1] + c * parts[2] for a, b, c in columns)
        return x, y, z

    return turned


@dataclass(frozen=True)
class Joint:
    """A movable joint; lengths m, angles rad, stiffness N/m or N.m/rad (inf: rigid).

    axis: (3,) unit vector in the joint's own frame; origin_m (3,) and rotation (3, 3), None for no
    turn, place that frame in the link before it; link: the name of the link that it moves;
    max_velocity: m/s or rad/s, inf where it is not known.
    """

    name: str
    kind: Literal["revolute", "prismatic"]
    axis: Array
    origin_m: Array
    lower: float
    upper: float
    home: float = 0.0
    stiffness: float = math.inf
    rotation: Array | None = None
    link: str = ""
    max_velocity: float = math.inf

    @property
    def unit(self) -> str:
        """Unit of the joint's value."""
        return "rad" if self.kind == "revolute" else "m"


@dataclass(frozen=True)
class Arm:
    """A chain of joints from base to sensor. Functions take joints (..., n) in the chain's order.

    sensor_origin_m (3,) and sensor_rotation (3, 3) place the sensor in the last joint's link.
    gravity_m_s2: (3,) in the base's frame. delta: rods that hold a platform, which the first three
    joints move along x, y, z; None for a serial arm. beside: where joints of the description that
    are not the arm's stand, as a gripper's, by name, m and rad.
    """

    name: str
    joints: tuple[Joint, ...]
    sensor_origin_m: Array
    sensor_rotation: Array
    gravity_m_s2: Array = field(default_factory=lambda: constant(0.0, 0.0, -STANDARD_GRAVITY_M_S2))
    base_frame: str = "base_link"
    sensor_frame: str = "ft_sensor"
    delta: LinearDelta | None = None
    urdf: str = field(default="", repr=False)
    beside: Mapping[str, float] = field(default_factory=dict, repr=False, compare=False)

    def __getstate__(self) -> dict[str, Any]:
        """Return the fields alone: what was derived of them may hold functions."""
        return {name.name: getattr(self, name.name) for name in fields(self)}

    # Joints

    @cached_property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints (n)."""
        return tuple(joint.name for joint in self.joints)

    @cached_property
    def units(self) -> tuple[str, ...]:
        """Unit of each joint's value: m or rad."""
        return tuple(joint.unit for joint in self.joints)

    def by_unit(self, metres: float, radians: ArrayLike) -> Array:
        """Make an array by the joints' kinds.

        Args:
            metres: value of each prismatic joint.
            radians: value of the revolute joints: one, or (k,).

        Returns:
            (n,) in the arm's order.

        """
        values = np.full(len(self.joints), float(metres))
        values[list(self.turning)] = radians
        return values

    @cached_property
    def home(self) -> Array:
        """Joints (n,) at home."""
        return constant(*(joint.home for joint in self.joints))

    @cached_property
    def lower(self) -> Array:
        """Lowest value (n,) of each joint."""
        return constant(*(joint.lower for joint in self.joints))

    @cached_property
    def upper(self) -> Array:
        """Highest value (n,) of each joint."""
        return constant(*(joint.upper for joint in self.joints))

    @cached_property
    def stiffness(self) -> dict[str, float]:
        """Stiffness by joint, and of a delta's `carriage` and `rod`; rigid joints left out."""
        found = {joint.name: joint.stiffness for joint in self.joints}
        if self.delta is not None:
            found |= {"carriage": self.delta.carriage_stiffness, "rod": self.delta.rod_stiffness}
        return {name: value for name, value in found.items() if math.isfinite(value)}

    def with_stiffness(self, stiffness: Mapping[str, float]) -> Arm:
        """Change stiffnesses.

        Args:
            stiffness: N/m or N.m/rad by names as `Arm.stiffness` has them; others stay.

        Returns:
            The changed arm.

        """
        joints = tuple(
            replace(joint, stiffness=stiffness.get(joint.name, joint.stiffness))
            for joint in self.joints
        )
        delta = self.delta
        if delta is not None:
            delta = replace(
                delta,
                carriage_stiffness=stiffness.get("carriage", delta.carriage_stiffness),
                rod_stiffness=stiffness.get("rod", delta.rod_stiffness),
            )
        return replace(self, joints=joints, delta=delta)

    @cached_property
    def urdf_sha256(self) -> str:
        """SHA-256 of the description's text."""
        return hashlib.sha256(self.urdf.encode()).hexdigest()

    def difference(self, other: Arm) -> str:
        """Describe what another arm has otherwise: joints, frames, sensor's place and gravity.

        Args:
            other: arm to compare with.

        Returns:
            The first difference, in words; empty where both move alike.

        """
        if self.joint_names != other.joint_names:
            return (
                f"the joints are {', '.join(other.joint_names)} instead of"
                f" {', '.join(self.joint_names)}"
            )
        for one, two in zip(self.joints, other.joints, strict=True):
            if one.kind != two.kind or not _same(_placement(one), _placement(two)):
                return f"joint {one.name} has another place, axis or limits"
        if (self.base_frame, self.sensor_frame) != (other.base_frame, other.sensor_frame):
            return (
                f"the frames are {other.base_frame} and {other.sensor_frame} instead of"
                f" {self.base_frame} and {self.sensor_frame}"
            )
        if not _same(
            [*self.sensor_origin_m, *self.sensor_rotation.flat],
            [*other.sensor_origin_m, *other.sensor_rotation.flat],
        ):
            return f"the frame {self.sensor_frame} is elsewhere"
        if not _same(self.gravity_m_s2, other.gravity_m_s2):
            return f"gravity is {other.gravity_m_s2} instead of {self.gravity_m_s2} m/s^2"
        return ""

    @cached_property
    def turning(self) -> tuple[int, ...]:
        """Places of the revolute joints: what gravity in the sensor depends on."""
        return tuple(k for k, joint in enumerate(self.joints) if joint.kind == "revolute")

    @cached_property
    def turning_names(self) -> tuple[str, ...]:
        """Names of the revolute joints (k)."""
        return tuple(self.joint_names[k] for k in self.turning)

    @cached_property
    def endless(self) -> np.ndarray:
        """Which joints (n,) turn without limits; some drivers report them within one turn."""
        return np.array(
            [j.kind == "revolute" and math.isinf(j.upper - j.lower) for j in self.joints]
        )

    def nearest(self, joints: ArrayLike, to: ArrayLike) -> Array:
        """Move endless joints by whole turns to where they are nearest to other values.

        Args:
            joints: (..., n), or angles (..., k); m and rad.
            to: values of the same kind, which broadcast.

        Returns:
            Joints or angles as given, the endless ones moved; not where `to` is NaN.

        """
        q = np.asarray(joints, dtype=float)
        endless = self.endless
        if not endless.any():
            return q
        if q.shape[-1] != len(endless):
            endless = endless[list(self.turning)]
        turns = np.round((q - np.asarray(to, dtype=float)) / (2.0 * np.pi))
        return np.where(endless, q - 2.0 * np.pi * np.nan_to_num(turns), q)

    def unwrapped(self, joints: Array) -> Array:
        """Undo jumps of endless joints by whole turns, as of drivers that report one turn.

        Args:
            joints: (m, n) in the order of their times, m and rad; NaN stays.

        Returns:
            Joints (m, n), the endless ones without jumps.

        """
        found = joints.copy()
        for k in np.flatnonzero(self.endless):
            known = np.isfinite(found[:, k])
            found[known, k] = np.unwrap(found[known, k])
        return found

    @cached_property
    def home_angles(self) -> Array:
        """Values (k,) of the revolute joints at home, rad."""
        return constant(*(self.joints[k].home for k in self.turning))

    def angles(self, joints: ArrayLike) -> Array:
        """Select the values of the revolute joints.

        Args:
            joints: (..., n), m and rad.

        Returns:
            Angles (..., k), rad.

        """
        return np.asarray(joints, dtype=float)[..., self.turning]

    def angles_of(self, joints: tuple[float, ...]) -> tuple[float, ...]:
        """Select the values of the revolute joints of one sample in plain floats.

        Args:
            joints: n of them, m and rad; k angles alone come back as they are.

        Returns:
            k angles, rad.

        """
        turning = self.turning
        return joints if len(joints) == len(turning) else tuple([joints[k] for k in turning])

    def with_angles(self, angles: ArrayLike, joints: ArrayLike | None = None) -> Array:
        """Complete angles of the revolute joints by the other joints.

        Args:
            angles: (..., k), rad.
            joints: (..., n), whose prismatic joints are taken; None: home.

        Returns:
            Joints (..., n), m and rad.

        """
        angles = np.asarray(angles, dtype=float)
        others = self.home if joints is None else np.asarray(joints, dtype=float)
        found = np.broadcast_to(others, (*angles.shape[:-1], len(self.joints))).copy()
        found[..., self.turning] = angles
        return found

    def described(self, angles: ArrayLike) -> str:
        """Write angles with the joints' names, for people: "roll 0.300, tilt 1.200 rad".

        Args:
            angles: (k,), rad.

        Returns:
            The text.

        """
        values = np.asarray(angles, dtype=float)
        pairs = zip(self.turning_names, values, strict=True)
        return ", ".join(f"{name} {value:.3f}" for name, value in pairs) + " rad"

    def limit_fault(self, joints: ArrayLike) -> str:
        """Name the limit that joints exceed, a delta's carriages included.

        Args:
            joints: (n,), m and rad.

        Returns:
            A clause on the first one; empty for none.

        """
        q = np.asarray(joints, dtype=float)
        for joint, value in zip(self.joints, q, strict=True):
            if not joint.lower <= value <= joint.upper:
                return (
                    f"{joint.name} = {value:g} {joint.unit} is outside its limits"
                    f" {joint.lower:g} ... {joint.upper:g}"
                )
        if self.delta is not None:
            try:
                self.delta.carriages(q[:3])
            except KinematicsError as error:
                return str(error)
        return ""

    # Gravity and kinematics

    def direction_in_sensor(self, angles: ArrayLike, direction: ArrayLike) -> Array:
        """Turn a vector from the base's frame into the sensor's: R_base_sensor^T d.

        Args:
            angles: (..., k), rad.
            direction: d (3,) in the base's frame.

        Returns:
            (..., 3) in the sensor's frame.

        """
        angles = np.asarray(angles, dtype=float)
        places = range(angles.shape[-1])
        cosines, sines = np.cos(angles), np.sin(angles)
        x, y, z = np.asarray(direction, dtype=float).tolist()
        parts = self.components_in_sensor(
            (x, y, z), [cosines[..., k] for k in places], [sines[..., k] for k in places]
        )
        return np.stack(np.broadcast_arrays(*parts, angles[..., 0])[:3], axis=-1)

    def components_in_sensor(
        self, direction: Components, cosines: Iterable[Any], sines: Iterable[Any]
    ) -> Components:
        """Turn a vector's components as `direction_in_sensor`, by the angles' cosines and sines.

        Args:
            direction: three components in the base's frame, floats or arrays.
            cosines: of the k angles, floats or arrays.
            sines: of the k angles, alike.

        Returns:
            Three components in the sensor's frame.

        """
        parts = direction
        for turn, cos, sin in zip(self.turns, cosines, sines, strict=True):
            parts = turn(parts, cos, sin)
        return self.into_sensor(parts)

    def gravity_in_sensor(self, angles: ArrayLike | None) -> Array:
        """Compute gravity in the sensor's frame.

        Args:
            angles: (..., k), rad; None: home.

        Returns:
            (..., 3), m/s^2.

        """
        angles = self.home_angles if angles is None else angles
        size = float(np.linalg.norm(self.gravity_m_s2))
        return self.direction_in_sensor(angles, self.gravity_m_s2 / size) * size

    def rotation(self, angles: ArrayLike) -> Array:
        """Compute R_base_sensor.

        Args:
            angles: (..., k), rad.

        Returns:
            (..., 3, 3).

        """
        return self.sensor_pose(self.with_angles(angles))[0]

    def sensor_pose(self, joints: ArrayLike) -> tuple[Array, Array]:
        """Compute the sensor's pose in the base.

        Args:
            joints: (..., n), m and rad.

        Returns:
            R_base_sensor (..., 3, 3) and the sensor's origin (..., 3), m.

        """
        rotation, origin = self._links(joints)[-1] if self.joints else (np.eye(3), np.zeros(3))
        origin = origin + rotation @ self.sensor_origin_m
        return rotation @ self.sensor_rotation, origin

    def tip_pose(self, joints: ArrayLike, tip_m: ArrayLike) -> tuple[Array, Array]:
        """Compute the tip's pose in the base; the tip has the sensor's axes.

        Args:
            joints: (..., n), m and rad.
            tip_m: (3,) in the sensor's frame.

        Returns:
            R_base_tip (..., 3, 3) and the tip (..., 3), m.

        """
        rotation, origin = self.sensor_pose(joints)
        return rotation, origin + rotation @ np.asarray(tip_m, dtype=float)

    def joint_axes(self, joints: ArrayLike) -> tuple[Array, Array]:
        """Compute the joints' places in the base.

        Args:
            joints: (..., n), m and rad.

        Returns:
            Origins (..., n, 3), m, and unit axes (..., n, 3), in the base's frame.

        """
        links = self._links(joints)
        # A joint's own motion doesn't change its axis.
        axes = [
            rotation @ joint.axis for joint, (rotation, _) in zip(self.joints, links, strict=True)
        ]
        return np.stack([origin for _, origin in links], axis=-2), np.stack(axes, axis=-2)

    def tip_jacobian(self, joints: ArrayLike, tip_m: ArrayLike) -> Array:
        """Compute the Jacobian of the tip's twist by joint velocities.

        A revolute column is (axis x (tip - origin), axis); a prismatic one (axis, 0).

        Args:
            joints: (..., n), m and rad.
            tip_m: (3,) in the sensor's frame.

        Returns:
            (..., 6, n): linear, then angular velocity, in the base's frame.

        """
        links = self._links(joints)
        rotation, origin = links[-1]
        in_link = self.sensor_origin_m + self.sensor_rotation @ np.asarray(tip_m, dtype=float)
        tip = origin + rotation @ in_link
        jacobian = np.zeros((*tip.shape[:-1], 6, len(self.joints)))
        for k, (joint, (rotation, origin)) in enumerate(zip(self.joints, links, strict=True)):
            axis = rotation @ joint.axis
            if joint.kind == "revolute":
                jacobian[..., :3, k] = np.cross(axis, tip - origin)
                jacobian[..., 3:, k] = axis
            else:
                jacobian[..., :3, k] = axis
        return jacobian

    # Elasticity

    def tip_compliance(self, joints: ArrayLike, tip_m: ArrayLike) -> Array:
        """Compute the tip's compliance.

        Springs in series, J K^-1 J^T over the elastic joints; a delta adds its platform on rods,
        T K_p^-1 T^T with T the transport of a twist from platform to tip.

        Args:
            joints: (n,), m and rad.
            tip_m: (3,) in the sensor's frame.

        Returns:
            C (6, 6): twist of the tip (m, rad) over the wrench at the tip (N, N.m), base's frame.

        Raises:
            KinematicsError: a delta's rods don't reach the pose.

        """
        q = np.asarray(joints, dtype=float)
        _, tip = self.tip_pose(q, tip_m)
        compliance = np.zeros((6, 6))
        if self.delta is not None:
            # v_tip = v_platform + w x (tip - platform)
            transport = np.eye(6)
            transport[:3, 3:] = -skew(tip - q[:3])
            stiffness = self.delta.platform_stiffness(q[:3])
            compliance = transport @ np.linalg.solve(stiffness, transport.T)
        columns = self.tip_jacobian(q, tip_m)
        for joint, column in zip(self.joints, columns.T, strict=True):
            compliance = compliance + np.outer(column, column) / joint.stiffness
        return np.asarray(compliance)

    def deflection(self, joints: ArrayLike, applied_wrench: ArrayLike, tip_m: ArrayLike) -> Array:
        """Compute the tip's displacement under a wrench at the sensor.

        Args:
            joints: (n,), m and rad.
            applied_wrench: (6,) in the sensor's frame about its origin, N and N.m.
            tip_m: (3,) in the sensor's frame.

        Returns:
            (6,): translation (m) and rotation vector (rad) in the base's frame.

        Raises:
            KinematicsError: a delta's rods don't reach the pose.

        """
        rotation, origin = self.sensor_pose(joints)
        _, tip = self.tip_pose(joints, tip_m)
        wrench = move_wrench(applied_wrench, rotation, origin - tip)
        return self.tip_compliance(joints, tip_m) @ wrench

    @cached_property
    def turns(self) -> tuple[Turn, ...]:
        """The turn back at each revolute joint, the fixed rotations before it included."""
        turns: list[Turn] = []
        fixed: Array | None = None
        for joint in self.joints:
            if joint.rotation is not None:
                fixed = joint.rotation if fixed is None else fixed @ joint.rotation
            if joint.kind == "revolute":
                turns.append(_joint_turn(replace(joint, rotation=fixed)))
                fixed = None
        return tuple(turns)

    @cached_property
    def into_sensor(self) -> Callable[[Components], Components]:
        """Turns components back from the last revolute joint to the sensor."""
        last = self.turning[-1] if self.turning else -1
        rotation = np.eye(3)
        for joint in self.joints[last + 1 :]:
            if joint.rotation is not None:
                rotation = rotation @ joint.rotation
        return _fixed(rotation @ self.sensor_rotation)

    def _links(self, joints: ArrayLike) -> list[tuple[Array, Array]]:
        """R_base_link (..., 3, 3) and origin (..., 3) of the link after each joint."""
        q = np.asarray(joints, dtype=float)
        rotation = np.broadcast_to(np.eye(3), (*q.shape[:-1], 3, 3))
        origin = np.zeros((*q.shape[:-1], 3))
        links = []
        for k, joint in enumerate(self.joints):
            origin = origin + rotation @ joint.origin_m
            if joint.rotation is not None:
                rotation = rotation @ joint.rotation
            if joint.kind == "revolute":
                rotation = rotation @ about(joint.axis, q[..., k])
            else:
                origin = origin + q[..., k, None] * (rotation @ joint.axis)
            links.append((rotation, origin))
        return links
