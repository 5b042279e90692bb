# SPDX-License-Identifier: Apache-2.0
"""The load of a calibration in the formats that robots' drivers and simulators take.

Tool and adapter become one body in a frame that is rigid to the sensor. With masses m_i and centres
c_i it has m = sum m_i, c = sum m_i c_i / m, and to first order the covariance that follows from

    dc/dm_i = (c_i - c)/m,   dc/dc_i = m_i/m.

Tool and adapter of one calibration are correlated negatively (the tool is what the second sweep
reads more), which the file does not hold: the deviations here are upper bounds. The inertia about
the centre is I_c = I - m (c.c 1 - c c^T), turned into the frame's axes.

Sources: URScript's set_target_payload (inertia about the centre, the flange's axes), libfranka's
Robot::setLoad and RobotState::I_load (the same, column-major), KUKA's load data (principal axes at
the centre; A, B, C turn about z, y', x''), urdf/XML/link; of Jazzy control_toolbox's
gravity_compensation_filter_parameters.yaml, and ros2_controllers' force_torque_sensor_broadcaster
(which adds its offset) and admittance_controller (CoG.force is a weight along -z of
fixed_world_frame, CoG.pos lies at ft_sensor's origin, and a wrench_reference is added).
"""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from galen_model.arm.galen import TIP_FRAME
from galen_model.arrays import Array
from galen_model.files.calibration_file import CalibrationFile
from galen_model.load.frames import FrameError, SensorInFrame, sensor_in_frame
from galen_model.load.inertia import INERTIA_NAMES, inertia_matrix, inertia_numbers
from galen_model.load.model import LoadEstimate, gravity_wrench
from galen_model.rotation import matrix_to_rotvec

# Densest common material of a tool (steel, kg/m^3): the least that a body's inertia can be.
_DENSITY_KG_M3 = 7850.0
_DECIMALS = 12
_ROBOTS = ("ur", "franka", "franka-desk", "xarm", "kuka")
_WITHOUT_INERTIA = ("control_toolbox", "ros2_control")


def hung_load(tool: CalibrationFile) -> LoadEstimate:
    """Join tool and adapter to one load.

    Args:
        tool: with both loads.

    Returns:
        The load in the sensor's frame; its deviations are upper bounds.

    """
    parts = (tool.load, tool.adapter)
    mass = sum(part.mass_kg for part in parts)
    com = np.sum([part.load.moments[1:] for part in parts], axis=0) / mass
    covariance = np.zeros((4, 4))
    for part in parts:
        spread = np.eye(4)
        spread[1:, 0] = (part.com_m - com) / mass
        spread[1:, 1:] *= part.mass_kg / mass
        covariance += spread @ part.covariance @ spread.T
    return LoadEstimate(mass, com, covariance)


def inertia_about_centre(tool: CalibrationFile, load: LoadEstimate) -> Array | str:
    """Compute the inertia of `hung_load` about its centre.

    Args:
        tool: with the inertia about the sensor's origin.
        load: `hung_load` of it, in the sensor's frame.

    Returns:
        (3, 3), kg m^2, along the sensor's axes; or why there is none, in words.

    """
    if tool.inertia is None:
        return "the calibration holds no inertia (poses at rest do not show it)"
    com = np.asarray(load.com_m, dtype=float)
    steiner = load.mass_kg * (com @ com * np.eye(3) - np.outer(com, com))
    inertia = inertia_matrix(tool.inertia.about_sensor_kg_m2) - steiner
    least, middle, largest = np.linalg.eigvalsh(inertia)
    if least <= 0.0 or least + middle < largest:
        return (
            f"the calibration's inertia about the centre, {least:.3g} {middle:.3g} {largest:.3g}"
            " kg m^2, is that of no rigid body: record faster motion and estimate it again"
        )
    return inertia


def export_load(tool: CalibrationFile, form: str, frame: str = "") -> dict[str, Any]:
    """Write what hangs on the sensor in a format and a frame.

    Args:
        tool: the calibration.
        form: one of FORMATS.
        frame: name; empty: the sensor's.

    Returns:
        SI numbers in the frame, notes, and the file's `text`.

    Raises:
        FrameError: the arm has no such frame, or its description is needed and lacks.
        FrameNeedsJointsError: joints move the frame against the sensor.

    """
    known = ("", tool.sensor_frame, TIP_FRAME)
    if not tool.arm.urdf and (frame not in known or form in _WITHOUT_INERTIA):
        what = f"the frame '{frame}'" if frame not in known else "the base frame"
        raise FrameError(
            f"{what} is in the description of the arm '{tool.arm.name}': give --urdf FILE and"
            f" --sensor-frame {tool.sensor_frame}"
        )
    place = sensor_in_frame(frame or tool.sensor_frame, tool.tip_m, None, arm=tool.arm)
    at_sensor = hung_load(tool)
    load, found = place.load(at_sensor), inertia_about_centre(tool, at_sensor)
    inertia = None if isinstance(found, str) else place.rotation @ found @ place.rotation.T
    write, comment = FORMATS[form]
    own, lines = write(load, inertia, place.frame, tool)
    notes = [*_notes(tool, place, load), *own]
    if form in _ROBOTS and place.frame == tool.sensor_frame:
        notes.append(
            "The robot takes it in the flange's frame: where that is another one, export again with"
            " its name as the frame (such as tool0) and the robot's URDF."
        )
    if inertia is None and form not in _WITHOUT_INERTIA:
        notes.append(f"No inertia: {found}.")
    # Names come from files: they must not end a comment, nor hold what XML forbids in one.
    comments = [comment.format(" ".join(note.replace("--", "- -").split())) for note in notes]
    return {
        "tool": tool.tool,
        "format": form,
        "frame": place.frame,
        "sensor_frame": tool.sensor_frame,
        "sensor_rotation": place.rotation.tolist(),
        "sensor_origin_m": place.origin_m.tolist(),
        "mass_kg": float(load.mass_kg),
        "mass_std_kg": load.mass_std_kg,
        "com_m": load.com_m.tolist(),
        "com_std_m": load.com_std_m.tolist(),
        "inertia_about_com_kg_m2": None if inertia is None else inertia.tolist(),
        "notes": notes,
        "text": "\n".join([*comments, *lines, ""]),
    }


def _notes(tool: CalibrationFile, place: SensorInFrame, load: LoadEstimate) -> list[str]:
    """Comments of every format: what is given, where, how well it is known."""
    parts = ", ".join(
        f"{name} {_number(part.mass_kg)} kg at ({_row(part.com_m)}) m"
        for name, part in (("tool", tool.load), ("adapter", tool.adapter))
    )
    return [
        f"Load of the tool '{tool.tool}', calibrated {tool.calibrated_at}: tool and adapter as one"
        f" body. In {tool.sensor_frame}: {parts}.",
        "What sits between flange and sensing element (the sensor's own mass) is not identified:"
        " add it where the robot's load does not have it yet.",
        f"Frame: {place.frame}. {tool.sensor_frame} lies in it at ({_row(place.origin_m)}) m,"
        f" turned by the rotation vector ({_row(matrix_to_rotvec(place.rotation))}) rad.",
        f"Standard deviations (at most): mass {load.mass_std_kg:.2g} kg, centre"
        f" {' '.join(f'{value:.2g}' for value in load.com_std_m)} m.",
        *(f"Not identified by the calibration: {text}." for text in tool.unresolved),
    ]


# Formats: notes of their own, and lines, of a load and its inertia (3, 3) about the centre in a
# frame, kg m^2


def _ur(load: LoadEstimate, inertia: Array | None, *_: object) -> _Lines:
    mass, com = _number(load.mass_kg), _row(load.com_m, ", ")
    note = (
        "Setting the payload zeroes a force/torque sensor that is built into the robot: zero it at"
        " the calibration's pose again."
    )
    x, y, z = map(_number, load.com_m)
    request = f"mass: {mass}, center_of_gravity: {{x: {x}, y: {y}, z: {z}}}"
    script = [f"set_payload({mass}, [{com}])"]
    if inertia is not None:
        numbers = inertia_numbers(inertia)
        target = f"set_target_payload({mass}, [{com}], [{_row(numbers, ', ')}])"
        script = [f"# older controllers: {script[0]}", target]
        for name, value in zip(INERTIA_NAMES, numbers, strict=True):
            request += f", i{name}: {_number(value)}"
        note += " Drivers of before June 2026 take no ixx ... iyz in the service: leave them out."
    call = "ros2 service call /io_and_status_controller/set_payload ur_msgs/srv/SetPayload"
    return [note], [f'# {call} "{{{request}}}"', *script]


def _franka(load: LoadEstimate, inertia: Array | None, *_: object) -> _Lines:
    note = (
        "It comes on top of the end effector that is set in Desk: don't count a part twice. The"
        " robot takes it while no motion runs."
    )
    columns = np.zeros(9) if inertia is None else inertia.ravel()
    lines = [
        f"mass: {_number(load.mass_kg)}",
        f"center_of_mass: [{_row(load.com_m, ', ')}]",
        f"load_inertia: [{_row(columns, ', ')}]",
    ]
    call = "ros2 service call /service_server/set_load franka_msgs/srv/SetLoad"
    return [note], [f'# {call} "{{{", ".join(lines)}}}"', *lines]


def _franka_desk(load: LoadEstimate, inertia: Array | None, *_: object) -> _Lines:
    notes = [
        "endeffector-config.json of an end effector archive, which Desk's settings take (Franka's"
        " RIDE documentation): its own lines begin with { and end with }.",
        "It takes the place of the end effector that is set in Desk: don't count a part twice.",
    ]
    columns = np.zeros((3, 3)) if inertia is None else inertia
    return notes, [
        "{",
        '  "id": "galen-tool", "name": "galen tool", "color": "grey",',
        f'  "mass": {_number(load.mass_kg)},',
        f'  "centerOfMass": [{_row(load.com_m, ", ")}],',
        f'  "transformation": [{_row(np.eye(4).ravel(), ", ")}],',
        f'  "inertia": [{_row(columns.T.ravel(), ", ")}]',
        "}",
    ]


def _xarm(load: LoadEstimate, _inertia: Array | None, *_: object) -> _Lines:
    centre = _row(1e3 * np.asarray(load.com_m), ", ")
    return ["xArm-Python-SDK: kg and mm in the flange's frame; it takes no inertia."], [
        f"arm.set_tcp_load(weight={_number(load.mass_kg)}, center_of_gravity=[{centre}])"
    ]


def _kuka(load: LoadEstimate, inertia: Array | None, *_: object) -> _Lines:
    moments, r = principal_axes(np.zeros((3, 3)) if inertia is None else inertia)
    # R = Rz(A) Ry(B) Rx(C), and cos B is not 0.
    turn = math.atan2(r[1, 0], r[0, 0]), -math.asin(r[2, 0]), math.atan2(r[2, 1], r[2, 2])
    centre = [*(1e3 * np.asarray(load.com_m)), *np.degrees(turn)]
    fields = (
        ",".join(f"{name} {_number(value)}" for name, value in zip(names, values, strict=True))
        for names, values in (("XYZABC", centre), ("XYZ", moments))
    )
    line = "$LOAD={{M {},CM {{{}}},J {{{}}}}}".format(_number(load.mass_kg), *fields)
    return ["kg, mm, degrees, kg m^2; J is about the principal axes A B C at the centre."], [line]


def _urdf(load: LoadEstimate, inertia: Array | None, *_: object) -> _Lines:
    notes = ["To go into the link of that frame, which must have no other inertial."]
    if inertia is None:
        radius = (3.0 * load.mass_kg / (4.0 * math.pi * _DENSITY_KG_M3)) ** (1.0 / 3.0)
        inertia = np.eye(3) * 0.4 * load.mass_kg * radius**2
        notes.append(
            "The inertia below is not measured: a solid steel ball of this mass, since simulators"
            " reject a body without inertia."
        )
    numbers = " ".join(
        f'i{name}="{_number(value)}"'
        for name, value in zip(INERTIA_NAMES, inertia_numbers(inertia), strict=True)
    )
    return notes, [
        "<inertial>",
        f'  <origin xyz="{_row(load.com_m)}" rpy="0 0 0"/>',
        f'  <mass value="{_number(load.mass_kg)}"/>',
        f"  <inertia {numbers}/>",
        "</inertial>",
    ]


def _control_toolbox(
    load: LoadEstimate, _: Array | None, frame: str, tool: CalibrationFile
) -> _Lines:
    notes = [
        "Parameters of control_toolbox's gravity compensation in a filter chain (Jazzy).",
        f"The filter subtracts no constant: in {tool.sensor_frame} the sensor, zeroed as at the"
        f" calibration, reads ({_row(_constant(tool))}) N, N.m more than this load. Subtract that"
        " first.",
    ]
    notes += [
        f"The calibration has a {part}, which the filter has not."
        for part in ("mounting", "cable")
        if getattr(tool, part) is not None
    ]
    return notes, [
        "sensor_filter_chain:",
        "  filter1:",
        "    name: gravity_compensation",
        "    type: control_filters/GravityCompensationWrench",
        "    params:",
        f"      world_frame: {json.dumps(tool.arm.base_frame)}",
        f"      sensor_frame: {json.dumps(frame)}",
        "      tool:",
        f"        mass: {_number(load.mass_kg)}",
        f"        CoG: [{_row(load.com_m, ', ')}]",
        f"        gravity_field: [{_row(tool.gravity_m_s2, ', ')}]",
    ]


def _ros2_control(load: LoadEstimate, _: Array | None, frame: str, tool: CalibrationFile) -> _Lines:
    (_about, _constant_left, *lacking), chain = _control_toolbox(load, None, frame, tool)
    notes = ["Parameters beside those of docs/how-to/ros2-control.md (Jazzy).", *lacking]
    force, torque = (
        "{{x: {}, y: {}, z: {}}}".format(*map(_number, part))
        for part in np.split(-_constant(tool), 2)
    )
    sensor, base = json.dumps(tool.sensor_frame), json.dumps(tool.arm.base_frame)
    lines = [
        "force_torque_sensor_broadcaster:",
        "  ros__parameters:",
        f"    frame_id: {sensor}",
        "    offset:",
        f"      force: {force}",
        f"      torque: {torque}",
        *(f"    {line}" for line in chain),
    ]
    weight = tool.gravity_m_s2[2] * load.mass_kg
    if weight >= 0.0 or np.any(tool.gravity_m_s2[:2]):
        notes.append(
            "Nothing for admittance_controller: it takes gravity along -z of its base alone, and"
            f" this arm's is ({_row(tool.gravity_m_s2)}) m/s^2 in {tool.arm.base_frame}."
        )
        return notes, lines
    call = "ros2 topic pub --once /admittance_controller/wrench_reference"
    message = f"{{wrench: {{force: {force}, torque: {torque}}}}}"
    notes.append("admittance_controller has no offset: send it after each activation, as below.")
    return notes, [
        f"# {call} geometry_msgs/msg/WrenchStamped '{message}'",
        *lines,
        "admittance_controller:",
        "  ros__parameters:",
        f"    ft_sensor: {{frame: {{id: {sensor}}}}}",
        f"    fixed_world_frame: {{frame: {{id: {base}}}}}",
        "    gravity_compensation:",
        f"      frame: {{id: {sensor}}}",
        "      CoG:",
        f"        pos: [{_row(hung_load(tool).com_m, ', ')}]",
        f"        force: {_number(-weight)}",
    ]


def _constant(tool: CalibrationFile) -> Array:
    """Return what the sensor, zeroed as at the calibration, reads beside the load (6,), N, N m."""
    return tool.residual_offset - gravity_wrench(tool.gravity_at_zeroing, tool.adapter.load)


_Lines = tuple[list[str], list[str]]
FORMATS: dict[str, tuple[Callable[..., _Lines], str]] = {
    "ur": (_ur, "# {}"),
    "franka": (_franka, "# {}"),
    "franka-desk": (_franka_desk, "# {}"),
    "xarm": (_xarm, "# {}"),
    "kuka": (_kuka, "; {}"),
    "urdf": (_urdf, "<!-- {} -->"),
    "control_toolbox": (_control_toolbox, "# {}"),
    "ros2_control": (_ros2_control, "# {}"),
}
"""By name: what writes it, and its comments."""


def principal_axes(inertia: Array) -> tuple[Array, Array]:
    """Compute the principal moments and axes of an inertia.

    The axes are ordered and directed to lie as near as possible to the frame's: R's trace is then
    above 1, so that R turns by less than 90 degrees and is no reflection.

    Args:
        inertia: (3, 3), symmetric, kg m^2.

    Returns:
        Moments (3,), kg m^2, and R_frame_principal (3, 3).

    """
    moments, axes = np.linalg.eigh(inertia)
    order = max(
        (list(picked) for picked in itertools.permutations(range(3))),
        key=lambda picked: float(np.sum(np.abs(np.diag(axes[:, picked])))),
    )
    moments, axes = moments[order], axes[:, order]
    return moments, axes * np.where(np.diag(axes) < 0.0, -1.0, 1.0)


def _number(value: float) -> str:
    """Write a number without an exponent, which not every controller reads."""
    rounded = round(float(value), _DECIMALS) + 0.0  # no -0.0
    return np.format_float_positional(rounded, trim="0")


def _row(values: ArrayLike, between: str = " ") -> str:
    return between.join(_number(value) for value in np.asarray(values, dtype=float))
