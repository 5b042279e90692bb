# SPDX-License-Identifier: Apache-2.0
"""Files that correct what was found, for the robot and for the compensation of its tool.

What effects change in a robot description and in a calibration file is in their records; a joint's
zero and axis go into the one, into the other the tool's mass and centre and, in `mounting`, the
sensor's gains and rotation and how the base is inclined, which so need no other frame and no
parameter of a node. Where the description changes, gravity at the zeroing does as well, and the
file is made for the new description. What a number's interval is goes into the file's covariances.
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
from galen_model.load.mounting import Mounting
from galen_sim_driver.effects.effect import Effect
from galen_sim_driver.effects.registry import contract_parameters

from galen_diagnosis.answer.answer import Diagnosis, FoundCause, Interval
from galen_diagnosis.effects.diagnosed_effect import FileParts
from galen_diagnosis.effects.registry import RECORDS
from galen_diagnosis.observation.recording import DiagnosticRecording
from galen_diagnosis.report.words import title

DESCRIPTION = "corrected.urdf"
_CI95 = 2.0 * 1.96


class Corrections(NamedTuple):
    """Files by name, as text, and a sentence on each: what it corrects, how it is used."""

    files: dict[str, str]
    sentences: tuple[str, ...]


def corrections(recording: DiagnosticRecording, diagnosis: Diagnosis) -> Corrections:
    """Return what corrects the causes of a diagnosis that identified them; else nothing.

    Args:
        recording: What was diagnosed.
        diagnosis: The answer and the fitted effects.

    Returns:
        Files and sentences; a sentence alone where the corrected files would be invalid.

    """
    if diagnosis.answer.verdict != "identified":
        return Corrections({}, ())
    effects = diagnosis.effects
    files, sentences = {}, []
    known = [(effect, RECORDS[effect.name]) for effect in effects if effect.name in RECORDS]
    of_arm = [effect for effect, record in known if record.in_description is not None]
    of_file = [effect for effect, record in known if record.in_file is not None]
    name = f"corrected_{recording.tool.tool}.json"
    try:
        arm = recording.arm
        if of_arm:
            text = corrected_description(arm, of_arm, f"the diagnosis of {recording.name}")
            arm = read_arm(text, sensor_frame=arm.sensor_frame, gravity_m_s2=arm.gravity_m_s2)
            files[DESCRIPTION] = text
            sentences.append(
                f"{DESCRIPTION}: the robot description corrected for the {_named(of_arm)}; for"
                " robot_state_publisher or the nodes' urdf_file, together with"
                f" {name}, which has the zeroing by it"
            )
        if of_arm or of_file:
            both = [effect for effect in effects if effect in of_arm or effect in of_file]
            tool = corrected_tool(recording, arm, diagnosis.answer.causes, both)
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
    advice = (record.advice(effect, recording) for effect, record in known)
    sentences += filter(None, advice)
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
    """Return the arm's robot description with effects in it, of those that it can hold.

    Args:
        arm: Whose description it is.
        effects: What was found.
        source: What found them, for a comment.

    Returns:
        The URDF.

    """
    parser = ElementTree.XMLParser(target=ElementTree.TreeBuilder(insert_comments=True))
    robot = ElementTree.fromstring(arm.urdf, parser)
    # In a comment two hyphens end it.
    comment = _provenance(source, effects).replace("--", "==")
    robot.insert(0, ElementTree.Comment(f" {comment} "))
    joints = {str(one.get("name")): one for one in robot.findall("joint")}
    true = arm
    for effect in effects:
        true = effect.misaligned(true)
    for effect in effects:
        write = RECORDS[effect.name].in_description
        if write is not None:
            write(effect, true, joints)
    ElementTree.indent(robot)
    return ElementTree.tostring(robot, encoding="unicode") + "\n"


def corrected_tool(
    recording: DiagnosticRecording,
    arm: Arm,
    causes: Sequence[FoundCause],
    effects: Sequence[Effect],
) -> CalibrationFile:
    """Return the recording's calibration file with the effects of sensor and tool in it.

    Args:
        recording: Its tool's file is corrected.
        arm: By whose description gravity at the zeroing is: the recording's, or as corrected.
        causes: Their intervals give the variances that are added.
        effects: What was found; each that a file can hold is among the causes.

    Returns:
        The file's content.

    """
    file = recording.tool
    variances = {cause.effect: _variances(cause) for cause in causes}
    load, mounting = file.load, file.mounting or Mounting.of(recording.arm)
    com_m = np.array(load.com_m, dtype=float)
    covariance, spread = load.covariance.copy(), mounting.covariance.copy()
    parts = FileParts(arm, load.mass_kg, com_m, covariance, mounting, spread)
    for effect in effects:
        correct = RECORDS[effect.name].in_file
        if correct is not None:
            correct(effect, parts, variances[effect.name])
    new = LoadEstimate(parts.mass_kg, parts.com_m, parts.covariance)
    inertia = file.inertia
    if inertia is not None:
        moved = point_mass_inertia(new.load) - point_mass_inertia(load.load)
        inertia = replace(inertia, about_sensor_kg_m2=inertia.about_sensor_kg_m2 + moved)
    estimated = tuple(dict.fromkeys([*mounting.estimated, *parts.estimated]))
    mounting = replace(parts.mounting, estimated=estimated, covariance=parts.spread)
    corrected = replace(
        file,
        arm=arm,
        load=new,
        inertia=inertia,
        mounting=mounting if estimated else file.mounting,
        model_reason=_provenance(f"the diagnosis of {recording.name}", effects),
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
