"""Writes a recording: three bags and the tool's file."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from galen_bags.arrays.arm_recording import JOINT_STATE_TYPE, POSE_TYPE, WRENCH_TYPE
from galen_bags.formats.writer import BagWriter
from galen_model.arm.galen import (
    BASE_FRAME,
    ENCODER_QUANTUM,
    JOINT_NAMES,
    SENSOR,
    SENSOR_FRAME,
    TRACKER_FRAME,
)
from galen_model.arrays import Array
from galen_ros.cdr import NS_PER_S, joint_state_bytes, pose_bytes, wrench_bytes
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from galen_diagnosis.blind.plant.machine import Machine
from galen_diagnosis.blind.plant.session import ADAPTER_COM_M, ADAPTER_MASS_KG, Session, Take
from galen_diagnosis.blind.plant.turning import turned_by

_POSES, _SAMPLES_A_POSE = 56, 100


class _Topic(NamedTuple):
    name: str
    type_name: str
    stamp_ns: list[int]
    messages: Iterator[bytes]


def write_recording(directory: Path, machine: Machine) -> None:
    """Measure all of a session with one machine, noise and quanta included, and write it."""
    session = machine.session
    rng = np.random.default_rng([session.seed, 4])
    for bag, take in session.takes.items():
        topics = _topics(rng, machine, bag, take)
        _write_bag(directory / bag, topics)
    (directory / "tool.json").write_text(json.dumps(tool_file(session), indent=1), encoding="utf-8")


def stamps_ns(session: Session, take: Take, stamp_s: Array) -> Array:
    """Stamps (n,) int64 of times since the bag's first stamp."""
    start = session.epoch_s * NS_PER_S + round(take.start_s * NS_PER_S)
    return np.asarray(start + np.round(stamp_s * NS_PER_S).astype(np.int64))


def coloured(rng: np.random.Generator, shape: tuple[int, ...], rho: float) -> Array:
    """Noise of unit variance, of which each row has rho of the one before."""
    white = rng.standard_normal(shape)
    if not rho:
        return white
    white[1:] *= math.sqrt(1.0 - rho**2)
    return np.asarray(lfilter([1.0], [1.0, -rho], white, axis=0))


def _topics(rng: np.random.Generator, machine: Machine, bag: str, take: Take) -> list[_Topic]:
    session = machine.session
    going = take.course.at(take.joints.taken_s)
    joints = np.round(going.joints / ENCODER_QUANTUM) * ENCODER_QUANTUM
    states = joint_state_bytes(JOINT_NAMES, BASE_FRAME)
    state_ns = stamps_ns(session, take, take.joints.stamp_s).tolist()
    reading = machine.reading(bag, take.wrench.taken_s)
    noise = session.wrench_std * coloured(rng, reading.shape, session.rho)
    reading = np.round((reading + noise) / SENSOR.quantum) * SENSOR.quantum
    wrenches = wrench_bytes(SENSOR_FRAME)
    wrench_ns = stamps_ns(session, take, take.wrench.stamp_s).tolist()
    topics = [
        _Topic(
            "joint_states", JOINT_STATE_TYPE, state_ns,
            map(states.fill, state_ns, joints.tolist(), going.velocity.tolist()),
        ),
        _Topic(
            "wrench_raw", WRENCH_TYPE, wrench_ns, map(wrenches.fill, wrench_ns, reading.tolist())
        ),
    ]  # fmt: skip
    if take.tracker is None:
        return topics
    pose_ns = stamps_ns(session, take, take.tracker.stamp_s).tolist()
    for name, poses in (
        ("tracker/tool_pose", machine.tool_pose(bag, take.tracker.taken_s)),
        ("tracker/base_pose", machine.base_pose(bag, take.tracker.taken_s)),
    ):
        rotation, position = poses
        shaken = coloured(rng, (len(position), 6), session.tracker_rho)
        position = position + session.tracker_std[0] * shaken[:, :3]
        rotation = rotation @ turned_by(session.tracker_std[1] * shaken[:, 3:])
        quaternion = Rotation.from_matrix(rotation).as_quat()
        filler = pose_bytes(TRACKER_FRAME)
        topics.append(
            _Topic(
                name, POSE_TYPE, pose_ns,
                map(filler.fill, pose_ns, position.tolist(), quaternion.tolist()),
            )
        )  # fmt: skip
    return topics


def _write_bag(path: Path, topics: list[_Topic]) -> None:
    with BagWriter(path, compressed=False) as bag:
        connections = [bag.add_topic(topic.name, topic.type_name) for topic in topics]
        which = np.concatenate([np.full(len(t.stamp_ns), k) for k, t in enumerate(topics)])
        when = np.concatenate([topic.stamp_ns for topic in topics])
        order = np.argsort(when, kind="stable")
        for number, stamp_ns in zip(which[order].tolist(), when[order].tolist(), strict=True):
            bag.write(connections[number], stamp_ns, next(topics[number].messages))


def tool_file(session: Session) -> dict[str, Any]:
    """tool.json: what a calibration of 56 poses, some time before, left (contract, section 4)."""
    tool = session.tool
    std = SENSOR.noise_std / math.sqrt(_POSES * _SAMPLES_A_POSE)
    return {
        "schema_version": 1,
        "tool": tool.name,
        "sensor_frame": SENSOR_FRAME,
        "gravity_m_s2": [0, 0, -9.80665],
        "bias_pose_rad": {"roll": 0.0, "tilt": 0.0},
        "load": _load(tool.mass_kg, tool.com_m, std),
        "bias": _load(ADAPTER_MASS_KG, ADAPTER_COM_M, std),
        "residual_offset": {"force_N": [0, 0, 0], "torque_Nm": [0, 0, 0]},
        "tip_m": tool.tip_m.tolist(),
        "rmse": {
            "force_N": SENSOR.noise_std[:3].tolist(),
            "torque_Nm": SENSOR.noise_std[3:].tolist(),
        },
        "poses_used": _POSES,
        "poses_rejected": [],
        "calibrated_at": datetime.fromtimestamp(session.epoch_s - 86400, UTC).isoformat(),
    }


def _load(mass_kg: float, com_m: Array, std: Array) -> dict[str, Any]:
    """With the covariance that the poses' means leave of mass and centre: about 0.03 g, 10 um."""
    mass_std = float(np.mean(std[:3])) / 9.80665 * math.sqrt(3.0)
    # Torques tell the first moment; of a third of the poses each part.
    com_std = float(np.mean(std[3:])) / 9.80665 / mass_kg * math.sqrt(1.5)
    covariance = np.diag([mass_std**2, *[com_std**2] * 3])
    return {"mass_kg": mass_kg, "com_m": com_m.tolist(), "covariance": covariance.tolist()}
