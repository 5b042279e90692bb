# SPDX-License-Identifier: Apache-2.0
"""The arm as a diagnosis found it, as a model for MuJoCo.

Each joint stands in its body as in the arm's kinematics; a `<position>` actuator with the joint's
stiffness drives it, whose length is the reported joint. With z and k the joint's zero and gain

    true = (1 + k) reported + z = qpos - ref,    ref = -z,    gear = 1 / (1 + k).

Adapter and tool are one body on the sensor, which reads

    reading = -(force, torque) - zero,    zero = E^T W(zeroing pose; adapter) - the file's offset,

E the axes in which it reads. MuJoCo's sensors hold all inertial forces, a reading a share of them.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from typing import Any
from xml.etree import ElementTree

import numpy as np
from galen_model.arm.arm import Joint
from galen_model.arrays import Array
from galen_model.load.inertia import inertia_matrix, inertia_numbers, point_mass_inertia
from galen_model.load.model import Load, gravity_wrench
from galen_sim_driver.effects.effect import Effect, in_order
from scipy.spatial.transform import Rotation

from galen_diagnosis.effects.diagnosed_effect import MujocoParts
from galen_diagnosis.effects.registry import RECORDS
from galen_diagnosis.observation.recording import DiagnosticRecording

MODEL = "found_effect.mjcf.xml"
_STEP_S = 1e-3
_RIGID = 1e6
"""Of a joint without a stiffness, N.m/rad or N/m."""
_LINK_KG, _LINK_KG_M2, _ROTOR_KG_M2 = 0.1, 1e-4, 4e-3
_GEAR_KG_M2 = 0.3
_LEAST_KG_M2 = 1e-7
"""MuJoCo accepts no body without extent."""
_HARD = {"solref": np.array([2.0 * _STEP_S, 1.0]), "solimp": np.array([0.9999, 0.9999, 1e-5])}
"""Stops and friction that give less than a gap."""
_NOTES = (
    "Set ctrl, or qpos times the actuator's gear, to a joint as it is reported.",
    "A reading (fx fy fz tx ty tz) is -(force, torque) - zero, with the numeric zero. Of MuJoCo's"
    " inertial forces, which come with qvel and qacc, it holds the share inertial_share.",
    "What MuJoCo lacks is done to that, in the order of these comments.",
    f"Links have {_LINK_KG} kg each, which the sensor does not feel; drives carry all weight"
    " (gravcomp), since the nominal arm is not bent by it.",
)


def mujoco_model(recording: DiagnosticRecording, effects: Sequence[Effect]) -> str:
    """Return a recording's arm and load with effects in them as MJCF.

    What MuJoCo has no such thing for is a comment, with its numbers.

    Args:
        recording: Its arm, tool's file and name.
        effects: Those of the driver; each has a record.

    Returns:
        The model's XML.

    """
    tool = recording.tool
    parts = MujocoParts(
        recording.arm, recording.arm.gravity_m_s2, tool.load.load, np.asarray(tool.tip_m)
    )
    notes = [f"The arm {recording.arm.name} in {recording.name}, for MuJoCo.", *_NOTES]
    for effect in in_order(effects):
        record = RECORDS[effect.name]
        if record.in_mujoco is not None:
            record.in_mujoco(effect, parts)
        known = "" if record.in_mujoco is not None else "no such thing in MuJoCo: "
        notes.append(f"{effect.name} {_numbers(effect)}: {known}{record.mujoco}.")
    return _written(recording, parts, notes)


def _numbers(effect: Effect) -> str:
    own = [f.name for f in dataclasses.fields(effect) if "param" in f.metadata]
    return json.dumps({name: getattr(effect, name) for name in own})


def _written(recording: DiagnosticRecording, parts: MujocoParts, notes: Sequence[str]) -> str:
    root = ElementTree.Element("mujoco", model="found_effect")
    for note in notes:
        printable = "".join(letter if letter.isprintable() else "?" for letter in note)
        # In a comment two hyphens end it.
        root.append(ElementTree.Comment(f" {printable.replace('--', '==')} "))
    _add(root, "compiler", angle="radian", autolimits="true")
    _add(root, "option", timestep=_STEP_S, integrator="implicitfast", gravity=parts.gravity_m_s2)
    body, drives = _add(root, "worldbody"), _add(root, "actuator")
    for joint in parts.arm.joints:
        body = _link(body, drives, joint, parts)
    masses = parts.tool.mass_kg + recording.tool.adapter.mass_kg
    share = parts.accelerating_kg / masses if masses > 0.0 else 0.0
    _load(body, recording.tool.adapter.load, parts, share)
    sensors = _add(root, "sensor")
    for kind in ("force", "torque"):
        _add(sensors, kind, name=kind, site="sensor")
    for kind in ("framepos", "framequat"):
        _add(sensors, kind, name=f"tip_{kind}", objtype="site", objname="tip")
    custom = _add(root, "custom")
    _add(custom, "numeric", name="zero", data=_zero(recording, parts))
    _add(custom, "numeric", name="inertial_share", data=share)
    places: list[float] = []
    for joint in parts.arm.joints:
        places.append((1.0 + parts.gain.get(joint.name, 0.0)) * joint.home)
        places += [0.0] * (joint.name in parts.gap)
    _add(_add(root, "keyframe"), "key", name="home", qpos=places, ctrl=parts.arm.home)
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n"


def _add(parent: ElementTree.Element, tag: str, **attributes: Any) -> ElementTree.Element:
    texts = {
        name: value if isinstance(value, str) else " ".join(map(repr, np.ravel(value).tolist()))
        for name, value in attributes.items()
    }
    return ElementTree.SubElement(parent, tag, texts)


def _link(
    parent: ElementTree.Element, drives: ElementTree.Element, joint: Joint, parts: MujocoParts
) -> ElementTree.Element:
    """Add a joint's body with its drive; returns the body."""
    rotation = np.eye(3) if joint.rotation is None else joint.rotation
    body = _add(
        parent, "body", name=joint.link or f"{joint.name}_link", pos=joint.origin_m,
        quat=_quaternion(rotation), gravcomp=1.0,
    )  # fmt: skip
    _add(body, "inertial", pos=np.zeros(3), mass=_LINK_KG, diaginertia=_LINK_KG_M2 * np.ones(3))
    kind = {"type": "hinge" if joint.kind == "revolute" else "slide", "axis": joint.axis}
    scale = 1.0 + parts.gain.get(joint.name, 0.0)
    stiffness = min(joint.stiffness, _RIGID)
    more: dict[str, Any] = {}
    if np.isfinite([joint.lower, joint.upper]).all() and joint.lower < joint.upper:
        more["range"] = scale * np.array([joint.lower, joint.upper])
    if joint.name in parts.friction:
        more |= _held(parts.friction[joint.name])
    _add(
        body, "joint", name=joint.name, **kind, ref=0.0 - parts.zero.get(joint.name, 0.0),
        armature=max(_ROTOR_KG_M2, _STEP_S**2 * stiffness), **more,
    )  # fmt: skip
    gap = parts.gap.get(joint.name)
    if gap is not None:
        stops = {f"{name}limit": value for name, value in _HARD.items()}
        held = gap | (_held(gap["frictionloss"]) if "frictionloss" in gap else {})
        _add(
            body, "joint", name=f"{joint.name}/gap", **kind, damping=0.2, armature=_GEAR_KG_M2,
            **stops, **held,
        )  # fmt: skip
    _add(
        drives, "position", name=joint.name, joint=joint.name, kp=stiffness * scale**2,
        dampratio=1.0, gear=1.0 / scale,
    )  # fmt: skip
    return body


def _held(friction: float) -> dict[str, Any]:
    return {"frictionloss": friction} | {f"{name}friction": part for name, part in _HARD.items()}


def _load(parent: ElementTree.Element, adapter: Load, parts: MujocoParts, share: float) -> None:
    """Add adapter and tool as one body on the sensor."""
    body = _add(
        parent, "body", name="sensed_load", pos=parts.arm.sensor_origin_m,
        quat=_quaternion(parts.arm.sensor_rotation), gravcomp=1.0,
    )  # fmt: skip
    loads = [load for load in (adapter, parts.tool) if load.mass_kg > 0.0]
    mass_kg = sum(load.mass_kg for load in loads)
    if mass_kg > 0.0:
        com_m = sum(load.mass_kg * np.asarray(load.com_m) for load in loads) / mass_kg
        about = [Load(load.mass_kg, load.com_m - com_m) for load in loads]
        own = parts.own_kg_m2 / share if share > 0.0 else parts.own_kg_m2
        inertia = inertia_matrix(point_mass_inertia(*about) + own)
        least, middle, largest = np.linalg.eigvalsh(inertia)
        lacking = max(_LEAST_KG_M2 - least, largest - least - middle + _LEAST_KG_M2, 0.0)
        full = inertia_numbers(inertia + lacking * np.eye(3))
        _add(body, "inertial", pos=com_m, mass=mass_kg, fullinertia=full)
    _add(body, "site", name="sensor", quat=_quaternion(parts.element))
    _add(body, "site", name="tip", pos=parts.tip_m)


def _zero(recording: DiagnosticRecording, parts: MujocoParts) -> Array:
    """Return what is subtracted of a reading (6,), N and N.m in the axes in which it reads."""
    arm, tool = parts.arm, recording.tool
    true = [
        (1.0 + parts.gain.get(name, 0.0)) * angle + parts.zero.get(name, 0.0)
        for name, angle in zip(arm.turning_names, tool.zero_angles, strict=True)
    ]
    gravity = arm.direction_in_sensor(true, parts.gravity_m_s2)
    weight = gravity_wrench(gravity, tool.adapter.load).reshape(2, 3) @ parts.element
    return np.asarray(weight.ravel() - tool.residual_offset)


def _quaternion(rotation: Array) -> Array:
    """MuJoCo's order: w, x, y, z."""
    return np.asarray(Rotation.from_matrix(rotation).as_quat(scalar_first=True))
