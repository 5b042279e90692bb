# SPDX-License-Identifier: Apache-2.0
"""What sensor and tracker measure of the blind arm, and the recording that is written of it.

    reading = show( sense(wrench on the sensor) - sense(adapter at the zeroing) ) + zero

The sensor's errors act on the whole wrench on it, the adapter's weight at the zeroing included, as
in a real sensor. Tolerances are what workshops and calibrations leave of a healthy arm; each is a
hundredth to a third of a clear cause.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from galen_bags.arrays.arm_recording import JOINT_STATE_TYPE, POSE_TYPE, WRENCH_TYPE
from galen_bags.formats.writer import BagWriter
from galen_common.cdr import NS_PER_S, joint_state_bytes, pose_bytes, wrench_bytes
from galen_model.arm.arm import STANDARD_GRAVITY_M_S2, Arm
from galen_model.arm.galen import ENCODER_QUANTUM, GALEN, SENSOR, TRACKER_FRAME
from galen_model.arrays import Array
from galen_model.files.calibration_file import CalibrationFile, write_calibration, zeroed_at
from galen_model.load.model import LoadEstimate
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from galen_validation.blind.causes import Cause, Moment
from galen_validation.blind.mujoco_arm import STEP_S, Body, MujocoArm, Plant, Trace
from galen_validation.blind.session import ADAPTER, Session

TOLERANCES: Mapping[str, tuple[int, float]] = {
    # Lengths: +-0.1 mm (two sigma), a fine workshop's general tolerance (ISO 2768-f) calibrated.
    "length_m": (6, 0.05e-3),
    # Pairs of rods differ by 0.02 mm; rods of a pair by what leaves 0.03 mrad over their 110 mm.
    "pair_m": (3, 0.02e-3),
    "rod_m": (3, 0.0035e-3),
    # Squareness of the axes: 0.05 mm over 0.5 m.
    "axis_rad": (3, 0.1e-3),
    # Joints' zeros and the base, levelled to 0.1 mrad.
    "zero_rad": (2, 0.1e-3),
    "level_rad": (2, 0.1e-3),
    # What a static test on the arm repeats: +-1 % (two sigma).
    "stiffness": (4, 0.005),
    # What is left after the maker's matrix and an adjustment.
    "sensor_gain": (6, 0.25e-3),
    # 0.12 mm over a volume of some 2.5 m.
    "tracker_scale": (1, 0.05e-3),
    # Eccentricity of encoders and gears, an arc minute a turn.
    "transmission": (2, 0.1e-3),
    # The tool's file: 56 poses of 100 samples leave 0.03 g, and 10 um of a centre of 60 g.
    "mass_kg": (1, 0.03e-3),
    "moment_kg_m": (3, 0.6e-6),
    # A sample is stamped when it is read; a camera's exposure and way.
    "wrench_late_s": (1, 0.3e-3),
    "tracker_late_s": (1, 1.0e-3),
    # Of N to N and N.m to N.m; between them with a lever of 0.1 m.
    "crosstalk": (30, 0.0),
}
"""How many differences a calibrated Galen has of each kind, and their standard deviation."""

DATA_SHEETS: Mapping[str, float] = {
    # Halves of limits: gains of 0.4 % of a sensor's full scale (ATI: 0.5 to 1.5 %), zeros of
    # 1 mrad (UR and Franka arms after their factory's calibration: 0.5 to 2.5), a tool that was
    # weighed to a gram, with its centre from a drawing.
    "sensor_gain": 2e-3, "crosstalk": 1e-3, "zero_rad": 0.5e-3, "axis_rad": 0.3e-3,
    "level_rad": 0.5e-3, "transmission": 0.2e-3, "stiffness": 0.02, "mass_kg": 0.5e-3,
    "moment_kg_m": 20e-6, "wrench_late_s": 0.5e-3, "tracker_late_s": 2.0e-3,
}  # fmt: skip
"""Standard deviations of an arm that is as its data sheets say, where they are others."""

_NOT_DRAWN: Mapping[str, Any] = {
    "loose_tool": 1e-4, "cable_drag": 0.03, "backlash": 5e-5, "joint_eccentricity": 3e-4,
    "sensor_nonlinearity": 1e-4, "sensor_hysteresis": 1e-3, "deflection_hysteresis": 5e-3,
    "deflection_creep": 0.01,
    "sensor_drift": {"force_N_per_hour": 0.3, "torque_Nm_per_hour": 0.01},
}  # fmt: skip
"""Limits of effects that these arms haven't at all."""


def _stds(usual: bool) -> dict[str, float]:
    calibrated = {name: size for name, (_, size) in TOLERANCES.items()}
    return {**calibrated, **(DATA_SHEETS if usual else {})}


def limits(session: Session) -> dict[str, Any]:
    """Return the specification's limits of arms by DATA_SHEETS: two standard deviations.

    Args:
        session: Its tool's mass turns the limit of the moment into one of the centre.

    Returns:
        By effect, a limit in the effect's unit; of a drift two limits by entry.

    """
    std = _stds(True)
    of = {
        "axis_gain": "sensor_gain", "crosstalk": "crosstalk", "joint_zero_offset": "zero_rad",
        "joint_axis_misalignment": "axis_rad", "sensor_mount_rotation": "axis_rad",
        "base_inclination": "level_rad", "joint_gain": "transmission",
        "joint_compliance": "stiffness", "tool_mass_error": "mass_kg",
        "wrench_delay": "wrench_late_s", "tracker_delay": "tracker_late_s",
        "tracker_scale": "tracker_scale",
    }  # fmt: skip
    drawn = {effect: 2.0 * std[kind] for effect, kind in of.items()}
    # Of the centre, of which the file's moment has an error.
    drawn["tool_com_error"] = 2.0 * std["moment_kg_m"] / session.tool.mass_kg
    return drawn | dict(_NOT_DRAWN)


CROSSTALK_LEVER_M = 0.1
_POSES, _SAMPLES_A_POSE = 56, 100
_HISTORY_N = 11.0


def draw_tolerance(
    seed: int, scale: float = 1.0, *, arm: Arm, usual: bool = False
) -> dict[str, Array]:
    """Draw a healthy arm's differences from nominal, cut at two sigma.

    Zeros, axes and gears are as many as the arm's angles, lengths as the links that they move; of
    more links than two each has the less, so that the tip is as far off.

    Args:
        seed: Seed of the case.
        scale: Factor on all standard deviations; 0 for the nominal arm.
        arm: The nominal arm.
        usual: Whether the arm is as its data sheets say, and not carefully calibrated.

    Returns:
        By the names of TOLERANCES, differences (count,) in the unit of the name: m, rad, kg, kg.m,
        s, or shares.

    """
    rng = np.random.default_rng([seed, 2])
    angles = len(arm.turning)
    counts = {
        "length_m": 3 * angles, "axis_rad": 2 * angles - 1, "zero_rad": angles,
        "stiffness": len(arm.stiffness), "transmission": angles,
    }  # fmt: skip
    std = _stds(usual)
    drawn = {
        name: scale * std[name] * np.clip(rng.standard_normal(counts.get(name, count)), -2.0, 2.0)
        for name, (count, _) in TOLERANCES.items()
    }
    drawn["length_m"] *= math.sqrt(2.0 / angles)
    return drawn


def healthy_plant(session: Session, tolerance: Mapping[str, Array]) -> Plant:
    """Return the session's arm and tool with these differences.

    Args:
        session: Nominal arm and tool.
        tolerance: Differences as `draw_tolerance` returns them.

    Returns:
        The plant without causes.

    """
    nominal = session.arm
    length = tolerance["length_m"].reshape(-1, 3)
    # Two ways across each axis; that of the last one which is left is in the sensor's mount.
    turned = np.append(tolerance["axis_rad"], 0.0).reshape(-1, 2)
    joints = list(nominal.joints)
    for k, turn in zip(nominal.turning, turned, strict=True):
        across = np.delete(np.eye(3), np.argmax(np.abs(joints[k].axis)), axis=0)
        own = joints[k].axis + turn @ across
        joints[k] = replace(joints[k], axis=own / np.linalg.norm(own))
    for k, more in zip(nominal.turning[1:], length, strict=False):
        joints[k] = replace(joints[k], origin_m=joints[k].origin_m + more)
    level = np.append(tolerance["level_rad"], 0.0)
    stiffness = 1.0 + tolerance["stiffness"]
    arm = replace(
        nominal,
        joints=tuple(joints),
        sensor_origin_m=nominal.sensor_origin_m + length[-1],
        gravity_m_s2=nominal.gravity_m_s2 - np.cross(level, nominal.gravity_m_s2),
    ).with_stiffness(
        dict(zip(nominal.stiffness, stiffness * list(nominal.stiffness.values()), strict=True))
    )
    tool = session.tool.body
    mass = tool.mass_kg + float(tolerance["mass_kg"][0])
    com = (tool.mass_kg * tool.com_m + tolerance["moment_kg_m"]) / mass
    rods = np.repeat(tolerance["pair_m"], 2) + np.kron(tolerance["rod_m"], [0.5, -0.5])
    return Plant(
        tool=Body(mass, com, tool.inertia_kg_m2),
        adapter=ADAPTER,
        tip_m=session.tool.tip_m,
        arm=arm,
        rods_m=rods,
        zero=arm.with_angles(tolerance["zero_rad"], np.zeros(len(joints))),
        gain=arm.with_angles(tolerance["transmission"], np.zeros(len(joints))),
    )


class Measurement:
    """One arm in one session, noise and quanta apart."""

    def __init__(
        self,
        session: Session,
        tolerance: Mapping[str, Array],
        causes: Sequence[Cause] = (),
        like: Measurement | None = None,
    ) -> None:
        """Take the motion from `like`, the arm without causes, where no cause changes it."""
        self.session = session
        self.tolerance = tolerance
        self.causes = tuple(causes)
        self.plant = healthy_plant(session, tolerance)
        self._crosstalk = np.zeros((6, 6))
        self._crosstalk[~np.eye(6, dtype=bool)] = tolerance["crosstalk"]
        self._crosstalk[3:, :3] *= CROSSTALK_LEVER_M
        self._crosstalk[:3, 3:] /= CROSSTALK_LEVER_M
        for cause in causes:
            if cause.plant is not None:
                self.plant = cause.plant(cause.size, self.plant)
        moves_alike = like is not None and not any(cause.changes_motion for cause in causes)
        self._traces: dict[str, Trace] = like._traces if like and moves_alike else {}
        self._arm: MujocoArm | None = like._arm if like and moves_alike else None

    @property
    def arm(self) -> MujocoArm:
        """The simulated arm."""
        if self._arm is None:
            self._arm = MujocoArm(self.plant, self.session.arm)
        return self._arm

    def trace(self, bag: str) -> Trace:
        """Return what the arm does in a bag, simulated at the first call.

        Args:
            bag: Name of one of the session's bags.

        Returns:
            The trace, STEP_S apart, from the bag's first stamp to just past its end.

        """
        if bag not in self._traces:
            take = self.session.takes[bag]
            at_s = np.arange(0.0, take.end_s + 0.02, STEP_S)
            reported = self._reported(bag, at_s)
            push = None if take.pushes is None else take.pushes.wrench(at_s)
            self._traces[bag] = self.arm.run(at_s, reported, push)
        return self._traces[bag]

    def pushed_by(self, bag: str) -> tuple[Array, Array]:
        """Return how far the bag's pushes move the tip.

        Args:
            bag: Name of one of the session's bags.

        Returns:
            Times (n,), s, and translation and rotation (n, 6) in the tip's axes, m and rad.

        """
        trace = self.trace(bag)
        rest = self.arm.run(trace.at_s, self._reported(bag, trace.at_s))
        back = np.swapaxes(trace.rotation, 1, 2)
        moved = np.einsum("nij,nj->ni", back, trace.position - rest.position)
        turned = Rotation.from_matrix(np.swapaxes(rest.rotation, 1, 2) @ trace.rotation)
        return trace.at_s, np.concatenate([moved, turned.as_rotvec()], axis=1)

    def reading(self, bag: str, taken_s: Array) -> Array:
        """Return the sensor's reading, with the errors of sensor and causes, without noise.

        Args:
            bag: Name of one of the session's bags.
            taken_s: Times when samples are thought to be taken, since the bag's first stamp, (n,),
                s; true ones are earlier by the topic's delay.

        Returns:
            Zeroed readings in ft_sensor, (n, 6), N and N.m.

        """
        at = self._moment(bag, taken_s, "wrench")
        trace = _at(self.trace(bag), at.bag_s)
        reading = self._sensed(at, trace.wrench) - self._zeroing(at) + self.session.zero
        for cause in self.causes:
            if cause.show is not None:
                reading = cause.show(cause.size, at, reading)
        return reading

    def tool_pose(self, bag: str, taken_s: Array) -> tuple[Array, Array]:
        """Return the pose of the tool's marker in `tracker`, without noise.

        Args:
            bag: Name of one of the session's bags.
            taken_s: Times when samples are thought to be taken, since the bag's first stamp, (n,),
                s.

        Returns:
            Rotation (n, 3, 3) and position (n, 3), m.

        """
        at = self._moment(bag, taken_s, "tracker")
        trace = _at(self.trace(bag), at.bag_s)
        slips = [cause.slip(cause.size, at) for cause in self.causes if cause.slip is not None]
        if not slips:
            return self._seen(trace.rotation, trace.position)
        slip = np.sum(slips, axis=0)
        turn = Rotation.from_rotvec(slip[:, 3:]).as_matrix()
        moved = np.einsum("nij,nj->ni", trace.rotation, slip[:, :3])
        return self._seen(trace.rotation @ turn, trace.position + moved)

    def base_pose(self, bag: str, taken_s: Array) -> tuple[Array, Array]:
        """Return the pose of the base's marker in `tracker`, without noise.

        Args:
            bag: Name of one of the session's bags.
            taken_s: Times when samples are thought to be taken, since the bag's first stamp, (n,),
                s.

        Returns:
            Rotation (n, 3, 3) and position (n, 3), m.

        """
        at = self._moment(bag, taken_s, "tracker")
        moved = np.zeros((len(at.bag_s), 6))
        for cause in self.causes:
            if cause.stand is not None:
                moved = moved + cause.stand(cause.size, at)
        rotation, position = self.session.marker
        turned = Rotation.from_rotvec(moved[:, 3:]).as_matrix() @ rotation
        return self._seen(turned, position + moved[:, :3])

    def peaks(self) -> Array:
        """Largest size of each axis' reading (6,)."""
        takes = self.session.takes.items()
        return np.max(
            [np.max(np.abs(self.reading(b, t.wrench.taken_s[::5])), axis=0) for b, t in takes],
            axis=0,
        )

    def mean_tension(self) -> float:
        """Mean tension of a cable, or size of a pull, over the wrenches, N."""
        takes = self.session.takes.items()
        each = [_at(self.trace(bag), take.wrench.taken_s).tension for bag, take in takes]
        return float(np.mean(np.concatenate(each)))

    def residual_fraction(self) -> float:
        """Deflection that stays after one large push along each axis over the one under it."""
        places = self.session.takes["push"].places
        assert places is not None
        at_s = np.arange(0.0, 3.4, STEP_S)
        share = np.interp(at_s, [0.2, 0.6, 1.0, 1.4], [0.0, 1.0, 1.0, 0.0])
        top, after = (at_s > 0.9) & (at_s < 1.0), at_s > 2.0
        held = np.tile(places[0], (len(at_s), 1))
        rest = self.arm.run(at_s, held).position
        stayed, largest = 0.0, 0.0
        for way in np.eye(3):
            force = _HISTORY_N * way
            push = np.outer(share, np.concatenate([force, np.cross(self.plant.tip_m, force)]))
            moved = self.arm.run(at_s, held, push).position - rest
            # The mean, since the arm sways for a second after a push.
            stayed += float(np.sum(np.mean(moved[after], axis=0) ** 2))
            largest += float(np.sum(np.mean(moved[top], axis=0) ** 2))
        return math.sqrt(stayed / largest)

    def _reported(self, bag: str, at_s: Array) -> Array:
        """Return the joints that the drives follow, with what causes make of them (n, k)."""
        take = self.session.takes[bag]
        return self._true(take.course(np.minimum(at_s, take.end_s)), at_s + take.start_s)

    def _true(self, reported: Array, session_s: Array) -> Array:
        for cause in self.causes:
            if cause.joints is not None:
                reported = cause.joints(cause.size, reported, session_s)
        return reported

    def _moment(self, bag: str, taken_s: Array, topic: str) -> Moment:
        age_s = np.full(len(taken_s), float(self.tolerance[f"{topic}_late_s"][0]))
        for cause in self.causes:
            if cause.late is not None and cause.late[0] == topic:
                age_s = age_s + cause.late[1](cause.size, taken_s)
        then = taken_s - age_s
        return Moment(bag, then, then + self.session.takes[bag].start_s)

    def _sensed(self, at: Moment, total: Array) -> Array:
        total = total @ (np.diag(1.0 + self.tolerance["sensor_gain"]) + self._crosstalk).T
        for cause in self.causes:
            if cause.sense is not None:
                total = cause.sense(cause.size, at, total)
        return total

    def _zeroing(self, at: Moment) -> Array:
        """Return what the sensor was zeroed at (1, 6): the adapter at home, before it all."""
        plant, adapter = self.plant, self.plant.adapter
        home = (
            self._true(self.session.arm.home[None], np.zeros(1)) * (1.0 + plant.gain) + plant.zero
        )
        force = adapter.mass_kg * plant.arm.gravity_in_sensor(plant.arm.angles(home))
        total = np.concatenate([force, np.cross(adapter.com_m, force)], axis=1)
        return self._sensed(Moment(at.bag, np.zeros(1), np.zeros(1)), total)

    def _seen(self, rotation: Array, position: Array) -> tuple[Array, Array]:
        turn, place = self.session.base
        there = (position @ turn.T + place) * (1.0 + self.tolerance["tracker_scale"])
        for cause in self.causes:
            if cause.seen is not None:
                there = cause.seen(cause.size, there)
        return turn @ rotation, there


def _at(trace: Trace, at_s: Array) -> Trace:
    """Interpolate the trace at other times (n,); its ends hold."""
    parts = []
    for values in trace[1:]:
        flat = values.reshape(len(trace.at_s), -1)
        columns = [np.interp(at_s, trace.at_s, column) for column in flat.T]
        parts.append(np.stack(columns, axis=1).reshape(-1, *values.shape[1:]))
    return Trace(at_s, *parts)


@dataclass(frozen=True)
class Samples:
    """What is recorded of one bag, noise and quanta included; stamps in ns.

    joints, rates (nj, n): m and rad; readings (nw, 6): N and N.m; tool, base: rotation (nt, 3, 3)
    and position (nt, 3) of the markers in `tracker`, None without it.
    """

    joint_ns: np.ndarray
    joints: Array
    rates: Array
    wrench_ns: np.ndarray
    readings: Array
    tracker_ns: np.ndarray
    tool: tuple[Array, Array] | None = None
    base: tuple[Array, Array] | None = None


def recorded(measured: Measurement) -> dict[str, Samples]:
    """Return what the bags hold, noise and quanta included.

    Args:
        measured: The arm in its session, whose seed the noise is drawn from.

    Returns:
        Samples by the bag's name.

    """
    rng = np.random.default_rng([measured.session.seed, 4])
    return {bag: _samples(rng, measured, bag) for bag in measured.session.takes}


def _samples(rng: np.random.Generator, measured: Measurement, bag: str) -> Samples:
    session, take = measured.session, measured.session.takes[bag]
    begin_ns = session.epoch_s * NS_PER_S + round(take.start_s * NS_PER_S)

    def stamps(stamp_s: Array) -> np.ndarray:
        return np.asarray(begin_ns + np.round(stamp_s * NS_PER_S).astype(np.int64))

    at_s = np.minimum(take.joints.taken_s, take.end_s)
    quantum = session.arm.by_unit(ENCODER_QUANTUM[0], ENCODER_QUANTUM[-1])
    joints = np.round(take.course(at_s) / quantum) * quantum
    reading = measured.reading(bag, take.wrench.taken_s)
    reading = reading + session.wrench_std * _coloured(rng, reading.shape, session.rho)
    reading = np.round(reading / SENSOR.quantum) * SENSOR.quantum
    found = Samples(
        stamps(take.joints.stamp_s), joints, take.course(at_s, 1), stamps(take.wrench.stamp_s),
        reading, np.zeros(0, dtype=np.int64),
    )  # fmt: skip
    if take.tracker is None:
        return found
    markers = []
    for see in (measured.tool_pose, measured.base_pose):
        rotation, position = see(bag, take.tracker.taken_s)
        noise = _coloured(rng, (len(position), 6), session.tracker_rho)
        turn = Rotation.from_rotvec(session.tracker_std[1] * noise[:, 3:]).as_matrix()
        markers.append((rotation @ turn, position + session.tracker_std[0] * noise[:, :3]))
    tool, base = markers
    return replace(found, tracker_ns=stamps(take.tracker.stamp_s), tool=tool, base=base)


def write_recording(directory: Path, measured: Measurement) -> None:
    """Write the bags, the tool's file and, of another arm than the Galen, its description.

    Args:
        directory: Existing directory of the recording.
        measured: The arm in its session.

    """
    arm = measured.session.arm
    for bag, samples in recorded(measured).items():
        _write_bag(directory / bag, _topics(samples, arm))
    write_calibration(directory / "tool.json", tool_file(measured.session))
    if arm.joint_names != GALEN.joint_names:
        (directory / "arm.urdf").write_text(arm.urdf, encoding="utf-8")


_Topic = tuple[str, str, list[int], list[bytes]]
"""Name, type, stamps (ns) and messages."""


def _topics(samples: Samples, arm: Arm) -> list[_Topic]:
    state_ns, wrench_ns = samples.joint_ns.tolist(), samples.wrench_ns.tolist()
    states, wrenches = (
        joint_state_bytes(arm.joint_names, arm.base_frame),
        wrench_bytes(arm.sensor_frame),
    )
    moving = zip(state_ns, samples.joints.tolist(), samples.rates.tolist(), strict=True)
    reads = zip(wrench_ns, samples.readings.tolist(), strict=True)
    topics: list[_Topic] = [
        ("joint_states", JOINT_STATE_TYPE, state_ns, [states.fill(*one) for one in moving]),
        ("wrench_raw", WRENCH_TYPE, wrench_ns, [wrenches.fill(*one) for one in reads]),
    ]
    pose_ns, filler = samples.tracker_ns.tolist(), pose_bytes(TRACKER_FRAME)
    for name, marker in (("tool_pose", samples.tool), ("base_pose", samples.base)):
        if marker is not None:
            turns = Rotation.from_matrix(marker[0]).as_quat().tolist()
            poses = zip(pose_ns, marker[1].tolist(), turns, strict=True)
            messages = [filler.fill(*one) for one in poses]
            topics.append((f"tracker/{name}", POSE_TYPE, pose_ns, messages))
    return topics


def _coloured(rng: np.random.Generator, shape: tuple[int, ...], rho: float) -> Array:
    """Noise of unit variance, of which each row has rho of the one before."""
    white = rng.standard_normal(shape)
    white[1:] *= math.sqrt(1.0 - rho**2)
    return np.asarray(lfilter([1.0], [1.0, -rho], white, axis=0))


def _write_bag(path: Path, topics: list[_Topic]) -> None:
    with BagWriter(path, compressed=False) as bag:
        connections = [bag.add_topic(name, type_name) for name, type_name, _, _ in topics]
        order = sorted(
            (stamp_ns, k, number)
            for k, (_, _, stamps_ns, _) in enumerate(topics)
            for number, stamp_ns in enumerate(stamps_ns)
        )
        for stamp_ns, k, number in order:
            bag.write(connections[k], stamp_ns, topics[k][3][number])


def tool_file(session: Session) -> CalibrationFile:
    """Return the tool's file as a calibration of 56 poses left it a day before.

    Args:
        session: Arm and tool, both nominal in the file, and the time.

    Returns:
        The calibration, with covariances that follow from the sensor's noise.

    """
    tool, arm = session.tool, session.arm
    std = SENSOR.noise_std / math.sqrt(_POSES * _SAMPLES_A_POSE)
    return CalibrationFile(
        tool=tool.name,
        load=_load(tool.body, std),
        adapter=_load(ADAPTER, std),
        tip_m=tool.tip_m,
        rmse=SENSOR.noise_std.copy(),
        poses_used=_POSES,
        calibrated_at=datetime.fromtimestamp(session.epoch_s - 86400, UTC).isoformat(),
        arm=arm,
        zeroing=zeroed_at(arm=arm),
        gravity_m_s2=np.array(arm.gravity_m_s2),
    )


def _load(body: Body, std: Array) -> LoadEstimate:
    """With the covariance that the poses' means leave of mass and centre: about 0.03 g, 10 um."""
    mass_std = float(np.mean(std[:3])) / STANDARD_GRAVITY_M_S2 * math.sqrt(3.0)
    # Torques show the first moment; of a third of the poses each part.
    com_std = float(np.mean(std[3:])) / STANDARD_GRAVITY_M_S2 / body.mass_kg * math.sqrt(1.5)
    return LoadEstimate(
        body.mass_kg, np.array(body.com_m), np.diag([mass_std**2, *[com_std**2] * 3])
    )
