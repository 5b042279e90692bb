# SPDX-License-Identifier: Apache-2.0
"""The finite list of what people get wrong: each mistake undone, as far as readings tell it.

Four kinds: units, axes of the reading, orientation of the sensor, direction of gravity. A kind
yields the readings as they would be without each of its mistakes; two mistakes of different kinds
may stand together. Two have parameters that are found first, by linear least squares on forces:

    gravity's direction in the base   f_i = R_i^T u + b,   u = m g          (u free: 3)
    the sensing element's rotation    f_i = A g_i + b,     A = m Q          (A free: 9)

with Q the nearest rotation, or reflection, to A / |det A|^(1/3) by the polar decomposition
(Higham, *Functions of Matrices*, 2008, chapter 8).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import combinations
from xml.etree import ElementTree

import numpy as np

from galen_model.arm.arm import STANDARD_GRAVITY_M_S2
from galen_model.arrays import Array
from galen_model.errors import GalenError
from galen_model.rotation import about, matrix_to_quaternion, matrix_to_rotvec, quaternion_to_matrix
from galen_model.setup_check.readings import StillReadings, at_angles

LEAST_INCLINATION_RAD = np.radians(2.0)
"""A base inclined by less is an effect for the diagnosis, not a wrong set-up."""

LEAST_TURN_RAD = np.radians(8.0)
"""The same of a sensing element turned in its frame; flanges are off by 15 degrees or more."""

_EXACT_RAD = np.radians(3.0)  # so near to an axis a direction or a rotation is meant to be on it
_LEAST_SPREAD = 0.05  # smallest singular value over the largest, for directions that are found
_AXES = "xyz"


@dataclass(frozen=True)
class Corrected:
    """Readings without a mistake.

    Attributes:
        readings: what they would be.
        what: what is wrong, as a clause.
        remedy: the option or the line of the driver's configuration that corrects it.
        test: how a person sees whether it is this.
        parameters: how many numbers were fitted to undo it.

    """

    readings: StillReadings
    what: str
    remedy: str
    test: str
    parameters: int = 0


def units(readings: StillReadings) -> Iterator[Corrected]:
    """Undo torques in N.mm and forces in kgf.

    Args:
        readings: as reported.

    Yields:
        The readings without each mistake.

    """
    one = np.eye(3)
    weigh = "weigh the tool, or measure how far its centre is from the sensor"
    yield Corrected(
        readings.mapped(one, one / 1000.0),
        "torques are in N.mm",
        "divide torques by 1000 in the driver",
        weigh,
    )
    yield Corrected(
        readings.mapped(STANDARD_GRAVITY_M_S2 * one, one),
        "forces are in kgf",
        f"multiply forces by {STANDARD_GRAVITY_M_S2} in the driver",
        weigh,
    )


def axes(readings: StillReadings) -> Iterator[Corrected]:
    """Undo what the driver or the description may do to the reading's axes.

    Args:
        readings: as reported.

    Yields:
        The readings without each mistake.

    """
    one, minus = np.eye(3), -np.eye(3)
    yield Corrected(
        readings.mapped(minus, minus),
        "the reading is reversed",
        "negate the wrench in the driver",
        "push the tool along x of the sensor: fx must rise",
    )
    for k, axis in enumerate(_AXES):
        mirror = np.diag(np.where(np.arange(3) == k, -1.0, 1.0))
        push = f"push the tool along {axis} of the sensor: f{axis} must rise"
        for force, torque, names in (
            (mirror, mirror, f"f{axis} and t{axis}"),
            (mirror, one, f"f{axis}"),
            (one, mirror, f"t{axis}"),
        ):
            left_handed = ": the axes are left-handed" if len(names) > 2 else ""
            yield Corrected(
                readings.mapped(force, torque),
                f"{names} {'have' if len(names) > 2 else 'has'} the wrong sign{left_handed}",
                f"negate {names} in the driver",
                push,
            )
    if readings.rotation is not None:
        into_sensor = np.swapaxes(readings.rotation, 1, 2)
        yield Corrected(
            readings.mapped(into_sensor, into_sensor),
            f"the wrench is written in the axes of {readings.arm.base_frame}",
            "--wrench-frame base for recordings and tables; live the driver must turn it into the"
            " sensor's axes",
            "push the tool with the arm in two orientations: does the reading turn with the tool?",
        )
    yield from _turned_element(readings)


def _turned_element(readings: StillReadings) -> Iterator[Corrected]:
    """Yield the sensing element turned back, by the rotation or reflection that forces show."""
    gravity = readings.gravity - readings.gravity.mean(axis=0)
    force = readings.wrench[:, :3] - readings.wrench[:, :3].mean(axis=0)
    spread = np.linalg.svd(gravity, compute_uv=False)
    if len(gravity) < 5 or spread[2] < _LEAST_SPREAD * spread[0]:
        return
    matrix = np.linalg.lstsq(gravity, force, rcond=None)[0].T
    left, sizes, right = np.linalg.svd(matrix)
    if sizes[2] < _LEAST_SPREAD * sizes[0]:
        return
    turn = left @ right
    nearest = _signed_permutation(turn)
    if nearest is not None:
        turn = nearest
    mirrored = np.linalg.det(turn) < 0.0
    rotvec = matrix_to_rotvec(-turn if mirrored else turn)
    angle = float(np.linalg.norm(rotvec))
    if not mirrored and angle < LEAST_TURN_RAD:
        return
    if mirrored and (nearest is None or np.count_nonzero(np.diag(nearest)) == 3):
        return  # a reflection on no axis is none that people make; those on one are listed
    frame = readings.arm.sensor_frame
    if nearest is not None:
        listed = ", ".join(_mapped_axis(row) for row in turn.T)
        remedy = f"in the driver (fx, fy, fz) := ({listed}), torques alike"
    else:
        remedy = f"turn {frame} in the description by this rotation"
    what = f"the axes of {frame} are exchanged"
    if not mirrored:
        axis = _direction(rotvec / angle)
        what = (
            f"the sensing element is turned by {np.degrees(angle):.1f} deg about {axis}, in {frame}"
        )
        remedy += f", or give {frame} the element's axes in the description"
    yield Corrected(
        readings.mapped(turn.T, turn.T),
        what,
        remedy,
        "push the tool along each axis of the sensor's frame: which of fx, fy, fz rises?",
        0 if nearest is not None else 3,
    )


def orientation(readings: StillReadings) -> Iterator[Corrected]:
    """Undo what may be wrong with the sensor's orientation.

    Args:
        readings: as reported.

    Yields:
        The readings without each mistake.

    """
    arm = readings.arm
    if readings.angles is not None:
        yield from _joints(readings, readings.angles)
        yield from _frames(readings, readings.angles)
    elif readings.rotation is not None:
        look = "compare the orientation of one reading with the arm as it stood"
        yield Corrected(
            readings.turned(np.swapaxes(readings.rotation, 1, 2)),
            f"orientations are those of {arm.base_frame} in the sensor (inverse)",
            "conjugate the quaternions (negate qx, qy, qz), or transpose the matrices",
            look,
        )
        quaternion = matrix_to_quaternion(readings.rotation)
        for order, what, names in (
            ([1, 2, 3, 0], "quaternions are in the order w, x, y, z", "qw,qx,qy,qz"),
            ([3, 0, 1, 2], "quaternions are in the order x, y, z, w", "qx,qy,qz,qw"),
        ):
            yield Corrected(
                readings.turned(quaternion_to_matrix(quaternion[:, order])),
                what,
                f"name the columns in the file's order: --columns ...,{names}",
                look,
            )
    else:
        yield Corrected(
            replace(readings, gravity=-readings.gravity),
            "gx gy gz point up, as an accelerometer reads",
            "negate gx, gy, gz",
            "at rest with z of the sensor up gz must be negative",
        )


def _joints(readings: StillReadings, angles: Array) -> Iterator[Corrected]:
    arm, names = readings.arm, readings.arm.turning_names

    def at(corrected: Array) -> StillReadings:
        return at_angles(readings.wrench, corrected, arm)

    yield Corrected(
        at(np.radians(angles)),
        "joint angles are in degrees",
        "joint_states must be in rad: correct the driver",
        "compare joint_states with the angles that the robot's own display shows",
    )
    for k, name in enumerate(names):
        signs = np.where(np.arange(len(names)) == k, -1.0, 1.0)
        yield Corrected(
            at(angles * signs),
            f"joint {name} turns the other way than the description says",
            "reverse its sign in the driver, or its axis in the description (URDF)",
            f"move {name} alone: does the model turn as the arm does?",
        )
    for one, other in combinations(range(len(names)), 2):
        order = list(range(len(names)))
        order[one], order[other] = other, one
        yield Corrected(
            at(angles[:, order]),
            f"joints {names[one]} and {names[other]} are exchanged",
            "correct the order of names in joint_states (or --joint-names)",
            f"move {names[one]} alone: which value of joint_states changes?",
        )


def _frames(readings: StillReadings, angles: Array) -> Iterator[Corrected]:
    """Yield the readings as if other frames of the description were the sensor's."""
    arm = readings.arm
    if not arm.urdf:
        return
    # Pinocchio is slow to import, and a sound set-up needs none.
    from galen_model.arm.description import read_arm

    alike: dict[bytes, list[str]] = {}
    found: dict[bytes, StillReadings] = {}
    for link in ElementTree.fromstring(arm.urdf).iter("link"):
        name = str(link.get("name"))
        try:
            other = read_arm(
                arm.urdf,
                base_frame=arm.base_frame,
                sensor_frame=name,
                gravity_m_s2=arm.gravity_m_s2,
            )
        except GalenError:  # on another branch, or not moved by the joints
            continue
        count = len(other.turning_names)
        if other.turning_names != arm.turning_names[:count]:
            continue
        moved = at_angles(readings.wrench, angles[:, :count], other)
        if np.allclose(moved.gravity, readings.gravity, atol=1e-3):
            continue
        key = np.round(moved.gravity, 3).tobytes()
        alike.setdefault(key, []).append(name)
        found[key] = replace(moved, angles=None)
    for key, names in alike.items():
        several = f" ({' and '.join(names[1:3])} alike)" if len(names) > 1 else ""
        yield Corrected(
            found[key],
            f"the wrench is written in the axes of {names[0]}{several}, not of {arm.sensor_frame}",
            f"--sensor-frame {names[0]} (nodes: sensor_frame)",
            f"push the tool along x of {names[0]}: fx must rise",
        )


def gravity(readings: StillReadings) -> Iterator[Corrected]:
    """Turn gravity into the direction in the base that forces show.

    Args:
        readings: as reported.

    Yields:
        The readings under that gravity; nothing where it is the expected one, or not shown.

    """
    if readings.rotation is None or len(readings.wrench) < 4:
        return
    count = len(readings.wrench)
    design = np.zeros((count, 3, 6))
    design[:, :, :3] = np.swapaxes(readings.rotation, 1, 2)
    design[:, :, 3:] = np.eye(3)
    rows = design.reshape(-1, 6)
    spread = np.linalg.svd(rows, compute_uv=False)
    if spread[-1] < _LEAST_SPREAD * spread[0]:
        return
    weight = np.linalg.lstsq(rows, readings.wrench[:, :3].ravel(), rcond=None)[0][:3]
    size = float(np.linalg.norm(readings.arm.gravity_m_s2))
    down, expected = weight / (np.linalg.norm(weight) or 1.0), readings.arm.gravity_m_s2 / size
    exact = _on_an_axis(down)
    down = down if exact is None else exact
    angle = float(np.arccos(np.clip(down @ expected, -1.0, 1.0)))
    if angle < LEAST_INCLINATION_RAD:
        return
    gravity_text = " ".join(f"{value:g}" for value in np.round(size * down, 5) + 0.0)
    yield Corrected(
        readings.under(size * down),
        _mount(down, expected, angle, readings.arm.base_frame),
        f"--gravity {gravity_text} (nodes: gravity_m_s2)",
        f"look at how {readings.arm.base_frame} stands",
        2,
    )


def _mount(down: Array, expected: Array, angle: float, base: str) -> str:
    """Say how the base is mounted, from gravity's direction (3,) in it and the expected one."""
    if np.allclose(expected, (0.0, 0.0, -1.0), atol=1e-6):
        if down[2] > np.cos(_EXACT_RAD):
            return f"gravity is along +z of {base}: the arm hangs from the ceiling"
        if abs(down[2]) < np.sin(_EXACT_RAD):
            return f"gravity is along {_direction(down)} of {base}: the arm is mounted on a wall"
    axis = np.cross(down, expected)
    direction = _direction(axis / (np.linalg.norm(axis) or 1.0))
    return f"{base} is inclined by {np.degrees(angle):.1f} deg about {direction}"


def _direction(unit: Array) -> str:
    """Name a direction (3,): "+x", or its components."""
    exact = _on_an_axis(unit)
    if exact is None:
        return "(" + ", ".join(f"{value:.3f}" for value in unit) + ")"
    k = int(np.argmax(np.abs(exact)))
    return f"{'+' if exact[k] > 0.0 else '-'}{_AXES[k]}"


def _on_an_axis(unit: Array) -> Array | None:
    """Return the axis that a direction (3,) is meant to be on, or None."""
    k = int(np.argmax(np.abs(unit)))
    if abs(unit[k]) < np.cos(_EXACT_RAD / 2.0):
        return None
    return np.asarray(np.sign(unit[k]) * np.eye(3)[k])


def _signed_permutation(matrix: Array) -> Array | None:
    """Return the exchange of axes that a rotation or reflection (3, 3) is meant to be, or None."""
    exact = np.round(matrix)
    if not np.allclose(exact @ exact.T, np.eye(3)):
        return None
    angle = np.arccos(np.clip((np.trace(matrix @ exact.T) - 1.0) / 2.0, -1.0, 1.0))
    return exact if angle < _EXACT_RAD else None


def _mapped_axis(row: Array) -> str:
    k = int(np.argmax(np.abs(row)))
    return f"{'-' if row[k] < 0.0 else ''}f{_AXES[k]}"


def known_load_mistakes(readings: StillReadings) -> Iterator[Corrected]:
    """Undo the mistakes that a few readings of a known load show, without a fit.

    Of a sensing element turned in its frame those turns that people make.

    Args:
        readings: as reported.

    Yields:
        The readings without each mistake.

    """
    yield from axes(readings)
    yield from units(readings)
    frame = readings.arm.sensor_frame
    for k, axis in enumerate(_AXES):
        for degrees in (180, 90, -90):
            turn = np.round(about(np.eye(3)[k], np.radians(degrees)))
            listed = ", ".join(_mapped_axis(row) for row in turn.T)
            yield Corrected(
                readings.mapped(turn.T, turn.T),
                f"the sensing element is turned by {degrees} deg about {axis}, in {frame}",
                f"in the driver (fx, fy, fz) := ({listed}), torques alike, or give {frame} the"
                " element's axes in the description",
                "push the tool along each axis of the sensor's frame: which force rises?",
            )
    if readings.angles is not None:
        yield from _joints(readings, readings.angles)


KINDS: tuple[Callable[[StillReadings], Iterator[Corrected]], ...] = (
    gravity,
    axes,
    units,
    orientation,
)
"""In the order in which explanations that do alike are named."""
