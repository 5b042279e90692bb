# SPDX-License-Identifier: Apache-2.0
"""Effects of the joints' kinematics and of the base.

A robot description holds a joint's zero and its axis. With R the rotation of a joint's frame in its
parent and e its axis in that frame, what the arm does beside its description goes into it as

    true angle = reported + z:           R <- R exp(z e)
    axis turned by A in the parent:      e <- R^T A R e
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
from galen_model.arm.arm import Arm
from galen_model.arm.galen import GALEN
from galen_model.arrays import Array
from galen_model.load.mounting import inclination, inclination_axes
from galen_model.rotation import about
from galen_sim_driver.effects import joints as simulated
from scipy.spatial.transform import Rotation

from galen_diagnosis.effects.candidates import Candidate, freed, plain_form
from galen_diagnosis.effects.diagnosed_effect import DiagnosedEffect, FileParts, MujocoParts
from galen_diagnosis.observation.observation import Observation
from galen_diagnosis.observation.recording import DiagnosticRecording

_ALONG = 0.9
"""Cosine between two axes from which on they are taken for one."""


def _zero_in_description(
    effect: simulated.JointZeroOffset, true: Arm, joints: Mapping[str, ElementTree.Element]
) -> None:
    origin = _part(joints[effect.joint], "origin")
    before = [float(part) for part in origin.get("rpy", "0 0 0").split()]
    turned = about(true.joints[effect.index].axis, effect.offset_rad)
    origin.set("rpy", _text(_angles(Rotation.from_euler("xyz", before).as_matrix() @ turned)))


def _part(joint: ElementTree.Element, name: str) -> ElementTree.Element:
    found = joint.find(name)
    return ElementTree.SubElement(joint, name) if found is None else found


def _angles(rotation: Array) -> Array:
    """Roll, pitch and yaw (3,) about fixed axes, as descriptions write a rotation (3, 3)."""
    return np.asarray(Rotation.from_matrix(rotation).as_euler("xyz"))


def _text(vector: Array) -> str:
    return " ".join(repr(float(value)) for value in vector)


def _zero_in_mujoco(effect: simulated.JointZeroOffset, parts: MujocoParts) -> None:
    parts.zero[effect.joint] = effect.offset_rad


JOINT_ZERO_OFFSET = DiagnosedEffect(
    name=simulated.JointZeroOffset.name,
    title="zero of the {joint} joint",
    sentence="the {joint} joint's zero is off by {offset_rad}",
    remedy="set the {joint} joint's zero in its driver or in the robot description",
    healthy=True,
    in_description=_zero_in_description,
    in_mujoco=_zero_in_mujoco,
    mujoco="the joint's `ref`, -offset_rad: true = qpos - ref",
    gazebo="the joint's `<pose>`, turned about its axis by offset_rad",
)


def _gain_in_mujoco(effect: simulated.JointGain, parts: MujocoParts) -> None:
    parts.gain[effect.joint] = effect.gain


JOINT_GAIN = DiagnosedEffect(
    name=simulated.JointGain.name,
    title="gain of the {joint} joint",
    sentence="the {joint} joint turns by {gain} more than it reports",
    remedy="correct the scale of the {joint} joint's encoder in its driver",
    not_on_galen=("roll",),
    healthy=True,
    advice=lambda effect, _: (
        f"no robot description holds the gain of {effect.joint}: have the driver report"
        f" {1.0 + effect.gain:.6f} times its angle"
    ),
    in_mujoco=_gain_in_mujoco,
    mujoco="the `gear` of the joint's actuator, 1/(1 + gain): its length is the reported joint",
    gazebo="no such thing: command (1 + gain) times the joint",
)


_CYCLES = (1.0, 2.0)
"""Of a gear or disc on the joint's own shaft; others a fit finds from there."""


def _eccentricities(_: Observation, effect: simulated.JointEccentricity) -> Iterator[Candidate]:
    """Yield one cycle and two, which a fit may leave."""
    bonus = -np.log(len(_CYCLES))
    for cycles in _CYCLES:
        base, label = replace(effect, cycles=cycles), f"{cycles:g} cycles"
        typical, probe = np.array([5e-3, 5e-3, 0.1]), np.array([1e-3, 1e-3, 0.01])
        fitted = replace(plain_form(base, label), typical=typical, probe=probe, bonus=bonus)
        yield freed(replace(plain_form(base, label, np.arange(2)), bonus=bonus), fitted)


JOINT_ECCENTRICITY = DiagnosedEffect(
    name=simulated.JointEccentricity.name,
    title="eccentricity at the {joint} joint",
    sentence="the {joint} joint's angle errs by up to {amplitude_rad}, {cycles} times a turn from"
    " {phase_rad} on",
    remedy="centre the encoder's disc or the gear of the {joint} joint, or have its driver subtract"
    " the error",
    healthy=True,
    forms=_eccentricities,
    known="firm",
    mujoco="qpos is reported + amplitude_rad sin(cycles reported + phase_rad)",
    gazebo="no such thing: the same formula",
)


def _misalignments(
    observation: Observation, effect: simulated.JointAxisMisalignment
) -> Iterator[Candidate]:
    """Yield a turn about each axis of the parent link; about the joint's own it is no turn."""
    arm = observation.recording.arm
    if arm.joint_names == GALEN.joint_names:  # its tilt axis turned about x is the roll's zero
        yield plain_form(effect)
        return
    joint = arm.joints[effect.index]
    axis = joint.axis if joint.rotation is None else joint.rotation @ joint.axis
    for turned, along in zip("xyz", np.abs(axis), strict=True):
        if along < _ALONG:
            yield plain_form(replace(effect, about=turned), turned)


def _axis_in_description(
    effect: simulated.JointAxisMisalignment, true: Arm, joints: Mapping[str, ElementTree.Element]
) -> None:
    _part(joints[effect.joint], "axis").set("xyz", _text(true.joints[effect.index].axis))


def _axis_in_mujoco(effect: simulated.JointAxisMisalignment, parts: MujocoParts) -> None:
    parts.arm = effect.misaligned(parts.arm)


JOINT_AXIS_MISALIGNMENT = DiagnosedEffect(
    name=simulated.JointAxisMisalignment.name,
    title="direction of the {joint} axis",
    sentence="the {joint} axis is turned by {angle_rad} about {about} of its parent link",
    remedy="correct the {joint} axis in the robot description",
    not_on_galen=("roll",),
    healthy=True,
    forms=_misalignments,
    known="firm",
    in_description=_axis_in_description,
    in_mujoco=_axis_in_mujoco,
    mujoco="the joint's `axis`",
    gazebo="the joint's `<axis><xyz>`",
)


def _inclined_further(effect: simulated.BaseInclination, file: FileParts, variances: Array) -> None:
    # Of two turns the sum: what they don't commute by is of second order.
    inclined = file.mounting.base_inclination_rad + effect.angles_rad
    at = [9 + "xyz".index(axis) for axis in inclination_axes(file.arm.gravity_m_s2)]
    mounting = replace(file.mounting, base_inclination_rad=inclined)
    file.remount(effect.name, at, variances, mounting)


def _level_frame(effect: simulated.BaseInclination, recording: DiagnosticRecording) -> str:
    turn = " ".join(f"{angle:.6f}" for angle in _angles(inclination(effect.angles_rad).T))
    return (
        "inclined base: programs that take gravity from a robot description need a level"
        f' frame below {recording.arm.base_frame}, joined with rpy="{turn}"'
    )


def _inclined_in_mujoco(effect: simulated.BaseInclination, parts: MujocoParts) -> None:
    parts.gravity_m_s2 = effect.gravity(parts.gravity_m_s2)


BASE_INCLINATION = DiagnosedEffect(
    name=simulated.BaseInclination.name,
    title="inclined base",
    sentence="the base is inclined, by {inclination}",
    remedy="level the base, or correct gravity in the calibration file",
    healthy=True,
    hidden_in_table=lambda table, _: (
        "the table has gravity alone, not the rotation" if table.rotation is None else ""
    ),
    in_file=_inclined_further,
    advice=_level_frame,
    in_mujoco=_inclined_in_mujoco,
    mujoco="`<option gravity>`",
    gazebo="`<world><gravity>`",
)
