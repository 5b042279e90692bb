"""Files that correct what was found, for the robot and for the compensation of its tool.

A robot description holds a joint's zero and its axis. With R the rotation of a joint's frame in its
parent and e its axis in that frame, what the arm does beside its description goes into it as

    true angle = reported + z:           R <- R exp(z e)
    axis turned by A in the parent:      e <- R^T A R e

A calibration file holds the tool's mass and centre, and in `mounting` the sensor's gains and
rotation and how the base is inclined, which so need no other frame and no parameter of a node.
Where the description changes, gravity at the zeroing does as well, and the file is made for the new
description. What a number's interval is goes into the file's covariances.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np
from galen_model.arm.arm import Arm
from galen_model.arm.description import read_arm
from galen_model.arrays import Array
from galen_model.errors import GalenError
from galen_model.files.calibration_file import (
    CalibrationFile,
    identity,
    parse_calibration,
    zeroed_at,
)
from galen_model.json_fields import LONGEST_SENTENCE
from galen_model.load.inertia import point_mass_inertia
from galen_model.load.model import LoadEstimate
from galen_model.load.mounting import Mounting, inclination, inclination_axes
from galen_model.rotation import about, matrix_to_rotvec, rotvec_to_matrix
from galen_sim_driver.effects.effect import Effect
from galen_sim_driver.effects.joints import (
    BaseInclination,
    JointAxisMisalignment,
    JointGain,
    JointZeroOffset,
)
from galen_sim_driver.effects.load import InertialLoad, ToolComError, ToolMassError
from galen_sim_driver.effects.registry import contract_parameters
from galen_sim_driver.effects.sensor import AxisGain, SensorMountRotation
from scipy.spatial.transform import Rotation

from galen_diagnosis.answer.answer import Diagnosis, FoundCause, Interval
from galen_diagnosis.observation.recording import DiagnosticRecording
from galen_diagnosis.report.words import title

DESCRIPTION = "corrected.urdf"
_OF_ARM = (JointZeroOffset, JointAxisMisalignment)
_OF_FILE = (AxisGain, SensorMountRotation, BaseInclination, ToolMassError, ToolComError)
_CI95 = 2.0 * 1.96


class Corrections(NamedTuple):
    """Files by name, as text, and a sentence on each: what it corrects, how it is used."""

    files: dict[str, str]
    sentences: tuple[str, ...]


def corrections(recording: DiagnosticRecording, diagnosis: Diagnosis) -> Corrections:
    """Return what corrects the causes of a diagnosis that identified them; else nothing."""
    if diagnosis.answer.verdict != "identified":
        return Corrections({}, ())
    effects = diagnosis.effects
    files, sentences = {}, []
    of_arm, of_file = (
        [effect for effect in effects if isinstance(effect, kinds)] for kinds in (_OF_ARM, _OF_FILE)
    )
    name = f"corrected_{recording.tool.tool}.json"
    try:
        arm = recording.arm
        if of_arm:
            text = corrected_description(arm, effects, f"the diagnosis of {recording.name}")
            arm = read_arm(text, sensor_frame=arm.sensor_frame, gravity_m_s2=arm.gravity_m_s2)
            files[DESCRIPTION] = text
            sentences.append(
                f"{DESCRIPTION}: the robot description corrected for the {_named(of_arm)}; for"
                " robot_state_publisher or the nodes' urdf_file, together with"
                f" {name}, which has the zeroing by it"
            )
        if of_arm or of_file:
            tool = corrected_tool(recording, arm, diagnosis.answer.causes, effects)
            text = json.dumps(tool.to_json(), indent=2, allow_nan=False) + "\n"
            parse_calibration(name, text.encode(), arm)
            files[name] = text
        if of_file:
            sentences.append(
                f"{name}: the calibration file corrected for the {_named(of_file)}; copy it to"
                f" {recording.tool.tool}.json in tools_dir and load it with set_tool"
            )
    except GalenError as error:
        return Corrections({}, (f"no corrected files: {error}",))
    for effect in effects:
        if isinstance(effect, JointGain):
            sentences.append(
                f"no robot description holds the gain of {effect.joint}: have the driver report"
                f" {1.0 + effect.gain:.6f} times its angle"
            )
        if isinstance(effect, BaseInclination):
            angles = _angles(inclination(effect.angles_rad).T)
            turn = " ".join(f"{angle:.6f}" for angle in angles)
            sentences.append(
                "inclined base: programs that take gravity from a robot description need a level"
                f' frame below {recording.arm.base_frame}, joined with rpy="{turn}"'
            )
        if isinstance(effect, InertialLoad) and not recording.inertial_forces:
            sentences.append(
                "inertial forces: subtract them with gravcomp_node's parameter motion, and diagnose"
                " with --inertial-forces"
            )
    return Corrections(files, tuple(sentences))


def _named(effects: Sequence[Effect]) -> str:
    return " and the ".join(title(effect.identity) for effect in effects)


def _provenance(source: str, effects: Sequence[Effect]) -> str:
    """One printable line: by what, and which numbers."""
    numbers = [f"{e.name} {json.dumps(contract_parameters(e))}" for e in effects]
    line = f"Corrected by {source}: {'; '.join(numbers)}"
    printable = "".join(letter if letter.isprintable() else "?" for letter in line)
    return printable[:LONGEST_SENTENCE]


def corrected_description(arm: Arm, effects: Sequence[Effect], source: str) -> str:
    """Return the arm's robot description with the effects of joints in it.

    source: what found them, for a comment.
    """
    parser = ElementTree.XMLParser(target=ElementTree.TreeBuilder(insert_comments=True))
    robot = ElementTree.fromstring(arm.urdf, parser)
    of_arm = [effect for effect in effects if isinstance(effect, _OF_ARM)]
    # In a comment two hyphens end it.
    comment = _provenance(source, of_arm).replace("--", "==")
    robot.insert(0, ElementTree.Comment(f" {comment} "))
    elements = {str(one.get("name")): one for one in robot.findall("joint")}
    true = arm
    for effect in of_arm:
        true = effect.misaligned(true)
        if isinstance(effect, JointAxisMisalignment):
            axis = true.joints[effect.index].axis
            _part(elements[effect.joint], "axis").set("xyz", _text(axis))
    for effect in of_arm:
        if isinstance(effect, JointZeroOffset):
            origin = _part(elements[effect.joint], "origin")
            before = [float(part) for part in origin.get("rpy", "0 0 0").split()]
            turned = about(true.joints[effect.index].axis, effect.offset_rad)
            origin.set(
                "rpy", _text(_angles(Rotation.from_euler("xyz", before).as_matrix() @ turned))
            )
    ElementTree.indent(robot)
    return ElementTree.tostring(robot, encoding="unicode") + "\n"


def _part(joint: ElementTree.Element, name: str) -> ElementTree.Element:
    found = joint.find(name)
    return ElementTree.SubElement(joint, name) if found is None else found


def _angles(rotation: Array) -> Array:
    """Roll, pitch and yaw (3,) about fixed axes, as descriptions write a rotation (3, 3)."""
    return np.asarray(Rotation.from_matrix(rotation).as_euler("xyz"))


def _text(vector: Array) -> str:
    return " ".join(repr(float(value)) for value in vector)


def corrected_tool(
    recording: DiagnosticRecording,
    arm: Arm,
    causes: Sequence[FoundCause],
    effects: Sequence[Effect],
) -> CalibrationFile:
    """Return the recording's calibration file with the effects of sensor and tool in it.

    For `arm`, by whose description gravity at the zeroing is.
    """
    file = recording.tool
    variances = {cause.effect: _variances(cause) for cause in causes}
    load, mounting = file.load, file.mounting or Mounting.of(recording.arm)
    covariance, spread = load.covariance.copy(), mounting.covariance.copy()
    mass_kg, com_m = load.mass_kg, np.array(load.com_m, dtype=float)
    estimated = list(mounting.estimated)
    told = [effect for effect in effects if isinstance(effect, (*_OF_ARM, *_OF_FILE))]
    for effect in told:
        own = variances[effect.name]
        if isinstance(effect, ToolMassError):
            mass_kg += effect.delta_kg
            covariance[0, 0] += own[0]
        elif isinstance(effect, ToolComError):
            com_m += effect.delta_m
            covariance[[1, 2, 3], [1, 2, 3]] += own
        elif isinstance(effect, AxisGain):
            gain = (1.0 + mounting.axis_gain) * (1.0 + np.array(effect.gain)) - 1.0
            mounting = replace(mounting, axis_gain=gain)
            spread[range(3, 9), range(3, 9)] += own
            estimated.append("axis_gain")
        elif isinstance(effect, SensorMountRotation):
            turn = rotvec_to_matrix(mounting.sensor_rotvec_rad) @ rotvec_to_matrix(
                effect.rotvec_rad
            )
            mounting = replace(mounting, sensor_rotvec_rad=matrix_to_rotvec(turn))
            spread[range(3), range(3)] += own
            estimated.append("sensor_rotation")
        elif isinstance(effect, BaseInclination):
            # Of two turns the sum: what they don't commute by is of second order.
            inclined = mounting.base_inclination_rad + effect.angles_rad
            mounting = replace(mounting, base_inclination_rad=inclined)
            at = [9 + "xyz".index(axis) for axis in inclination_axes(arm.gravity_m_s2)]
            spread[at, at] += own
            estimated.append("base_inclination")
    new = LoadEstimate(mass_kg, com_m, covariance)
    inertia = file.inertia
    if inertia is not None:
        moved = point_mass_inertia(new.load) - point_mass_inertia(load.load)
        inertia = replace(inertia, about_sensor_kg_m2=inertia.about_sensor_kg_m2 + moved)
    parts = replace(mounting, estimated=tuple(dict.fromkeys(estimated)), covariance=spread)
    corrected = replace(
        file,
        arm=arm,
        load=new,
        inertia=inertia,
        mounting=parts if estimated else file.mounting,
        model_reason=_provenance(f"the diagnosis of {recording.name}", told),
    )
    if arm is recording.arm:
        return corrected
    zeroing = None if file.zeroing is None else zeroed_at(file.zero_angles, arm=arm)
    return replace(corrected, made_on=identity(arm), zeroing=zeroing)


def _variances(cause: FoundCause) -> Array:
    """Variances (n,) of a cause's numbers, from their intervals; 0 where there is none."""

    def of(value: Any) -> list[float]:
        if isinstance(value, Interval):
            if value.low is None or value.high is None:
                return [0.0]
            return [((value.high - value.low) / _CI95) ** 2]
        parts = value if isinstance(value, list | tuple) else []
        return [one for part in parts for one in of(part)]

    return np.array([one for value in cause.parameters.values() for one in of(value)])
