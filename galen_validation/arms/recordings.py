# SPDX-License-Identifier: Apache-2.0
"""Recordings from outside the suite: a UR5 in MuJoCo, driven by torques; a measured Panda.

The UR5's links and inertias are those of its URDF, read by MuJoCo, whose kinematics, dynamics and
force sensor share nothing with the suite's. A controller that knows the arm, but not the tool,
computes torques from the joints (Siciliano et al., *Robotics*, 2009, section 8.5.2).
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import mujoco
import numpy as np
from galen_bags.arrays.arm_recording import JOINT_STATE_TYPE, WRENCH_TYPE
from galen_bags.formats.writer import BagWriter
from galen_common.cdr import NS_PER_S, joint_state_bytes, wrench_bytes
from galen_model.arm.arm import STANDARD_GRAVITY_M_S2
from galen_model.arm.galen import GALEN, SENSOR, WRENCH_AXES
from galen_model.arrays import Array
from galen_model.calibrated.inertia_identification import CUTOFF_HZ, MotionRecord, identify_inertia
from galen_model.errors import GalenError
from galen_model.load.identification import identify_single_load
from galen_model.load.inertia import inertial_regressor
from galen_model.load.model import Load
from scipy.interpolate import BPoly, CubicSpline, PPoly
from scipy.signal import butter, sosfiltfilt
from scipy.spatial.transform import Rotation

from galen_validation.arms import UR5

_STEP_S, _STAY_S, _MOVE_S = 1e-3, 1.2, 4.0
_ENCODER_RAD, _ROTOR_KG_M2 = 5e-5, 0.2
_STIFFNESS_S2, _DAMPING_S = 3600.0, 120.0
_REST_REACH = np.array([0.3, 0.4, 0.4, 1.5, 1.5, 2.5])
_MOTION_REACH = np.array([0.3, 0.2, 0.3, 0.5, 0.6, 1.0])
HOME = np.array([0.3, -1.3, 1.6, -1.2, -1.4, 0.2])
ADAPTER, ADAPTER_INERTIA_KG_M2 = Load(0.1, np.array([0.0, 0.0, 0.02])), [3e-5, 3e-5, 5e-5]
TOOL, TOOL_INERTIA_KG_M2 = Load(0.5, np.array([0.03, -0.02, 0.09])), [2.0e-3, 2.4e-3, 0.6e-3]
"""Inertias are the principal ones about the centres, along tool0's axes."""


class Ur5InMujoco:
    """A UR5 with sensor and adapter at tool0, with or without the tool."""

    def __init__(self, tool: bool) -> None:
        """Read the URDF without its shapes; rotors weigh on the joints."""
        root = ElementTree.fromstring(UR5.path.read_text(encoding="utf-8"))
        for link in root.iter("link"):
            for part in list(link):
                mass = part.find("mass")
                # MuJoCo rejects what is written as weighing nothing.
                if mass is None or float(mass.get("value", 0)) == 0.0:
                    link.remove(part)
        extension = ElementTree.SubElement(root, "mujoco")
        ElementTree.SubElement(extension, "compiler", {"fusestatic": "false"})
        spec = mujoco.MjSpec.from_string(ElementTree.tostring(root, encoding="unicode"))
        spec.option.timestep = _STEP_S
        spec.option.gravity = [0.0, 0.0, -STANDARD_GRAVITY_M_S2]
        for joint in spec.joints:
            joint.armature = _ROTOR_KG_M2
        adapter = self._add(spec.body(UR5.sensor_frame), ADAPTER, ADAPTER_INERTIA_KG_M2)
        adapter.add_site(name="sensor")
        for kind in (mujoco.mjtSensor.mjSENS_FORCE, mujoco.mjtSensor.mjSENS_TORQUE):
            spec.add_sensor(type=kind, objtype=mujoco.mjtObj.mjOBJ_SITE, objname="sensor")
        self._known = spec.compile()
        if tool:
            self._add(adapter, TOOL, TOOL_INERTIA_KG_M2)
        self._model = spec.compile()

    def _add(self, parent: Any, load: Load, inertia: list[float]) -> Any:
        return parent.add_body(
            mass=load.mass_kg, ipos=load.com_m, inertia=inertia, explicitinertial=True
        )

    def hold(self, joints: Array) -> Array:
        """Return the wrench on the sensor at rest.

        Args:
            joints: Joints, (6,), rad.

        Returns:
            Wrench about tool0's origin in its axes, (6,), N and N.m.

        """
        data = mujoco.MjData(self._model)
        data.qpos[:] = joints
        for _ in range(2):  # the second time against gravity's own torques
            mujoco.mj_forward(self._model, data)
            data.qfrc_applied[:] = data.qfrc_bias
        return -np.array(data.sensordata)

    def run(self, course: PPoly | BPoly) -> tuple[Array, Array]:
        """Follow a course of joints.

        Args:
            course: Joints (6,), rad, over time, s; its first and last knot are start and end.

        Returns:
            Times (n,), s, 1 ms apart; joints (rad), rates (rad/s) and wrench on the sensor (N and
            N.m in tool0), (n, 3, 6).

        """
        model, data, known = self._model, mujoco.MjData(self._model), mujoco.MjData(self._known)
        at_s = np.arange(course.x[0], course.x[-1], _STEP_S)
        wanted, speed, thrust = (course(at_s, order) for order in range(3))
        rows, inertia = np.zeros((len(at_s), 3, 6)), np.zeros((6, 6))
        data.qpos[:], data.qvel[:] = wanted[0], speed[0]
        for k in range(len(at_s)):
            rows[k, 0], rows[k, 1] = known.qpos[:], known.qvel[:] = data.qpos, data.qvel
            mujoco.mj_step1(self._known, known)
            mujoco.mj_fullM(self._known, known, inertia)
            pull = _STIFFNESS_S2 * (wanted[k] - data.qpos) + _DAMPING_S * (speed[k] - data.qvel)
            data.qfrc_applied[:] = inertia @ (thrust[k] + pull) + known.qfrc_bias
            mujoco.mj_step(model, data)
            # The sensors are those of the step's begin.
            rows[k, 2] = -data.sensordata
        return at_s, rows


def ur5_in_mujoco() -> str:
    """Record a UR5 in MuJoCo, calibrate from the bags, evaluate: the section's Markdown."""
    random = np.random.default_rng(1)
    bare, tool = Ur5InMujoco(tool=False), Ur5InMujoco(tool=True)
    sweep, unseen, *motions = (
        HOME + reach * random.uniform(-1.0, 1.0, (count, 6))
        for count, reach in (
            (24, _REST_REACH), (12, _REST_REACH), (50, _MOTION_REACH), (50, _MOTION_REACH)
        )
    )  # fmt: skip
    swings = [CubicSpline(0.8 * np.arange(50.0), poses) for poses in motions]
    zero = bare.hold(HOME)
    with tempfile.TemporaryDirectory() as name:
        bags = [str(Path(name, bag)) for bag in ("bare", "tool", "swing", "rest", "motion")]
        courses = (stops(sweep), stops(sweep), swings[0], stops(unseen), swings[1])
        for number, (bag, course) in enumerate(zip(bags, courses, strict=True)):
            at_s, rows = (tool if number else bare).run(course)
            rows[:, 2] += random.normal(0.0, SENSOR.noise_std, (len(rows), 6)) - zero
            _write_bag(bag, 600.0 * number + at_s, rows)
        options = [*UR5.options, "--tools-dir", name]
        calibrate = partial(command, "galen_calibration_behavior.calibrate_from_bag", "tool")
        found = calibrate("--bare", bags[0], "--with-tool", bags[1], *options)
        calibrate(bags[2], "--estimate", "inertia", *options)
        evaluate = partial(command, "galen_gravcomp.evaluate.command")
        options = ["--tool", str(Path(name, "tool.json")), *UR5.options, "--motion"]
        rest, weight, inertial = (
            evaluate(bag, *options, motion)
            for bag, motion in ((bags[3], "off"), (bags[4], "off"), (bags[4], "joints"))
        )
    over = {
        "rest segments": np.hypot(over_noise(rest, "noise"), over_noise(rest, "still_phases")),
        "at rest, ends of moves included": over_noise(rest, "still"),
        "in motion, weight alone": over_noise(weight, "moving"),
        "in motion, inertial forces from the joints": over_noise(inertial, "moving"),
    }
    text = (
        f"A UR5 in MuJoCo {mujoco.__version__}, driven by torques, with the contract's noise and"
        " quanta and a tool of 0.5 kg: two sweeps of 24 poses to `calibrate_from_bag`, 40 s of"
        " motion to its `--estimate inertia`, then `evaluate` on 12 poses and 40 s of motion that"
        f" no fit has seen. Error over σ of mass, x, y, z: {errors(found, TOOL)}."
    )
    return f"{text}\n\n{axes_table('residual over noise', over, 1.0)}"


def command(module: str, *arguments: str) -> dict[str, Any]:
    """Run one of the suite's commands with `--json`.

    Args:
        module: Its module, as after `python -m`.
        *arguments: Its options.

    Returns:
        The JSON object that it prints.

    Raises:
        GalenError: The command ends with another exit code than 0.

    """
    line = [sys.executable, "-m", module, *arguments, "--json"]
    done = subprocess.run(line, capture_output=True, text=True, check=False)
    if done.returncode:
        raise GalenError(f"{module} ended with code {done.returncode}: {done.stderr[-1000:]}")
    return dict(json.loads(done.stdout))


def errors(found: Mapping[str, Any], true: Load) -> str:
    """Return the errors of mass and centre over their standard deviations.

    Args:
        found: A calibration's answer: `mass_kg`, `com_m`, `mass_std_kg`, `com_std_m`.
        true: The load that was simulated.

    Returns:
        Four numbers with sign: mass, x, y, z.

    """
    error = np.array([found["mass_kg"], *found["com_m"]]) - [true.mass_kg, *true.com_m]
    over = error / [found["mass_std_kg"], *found["com_std_m"]]
    return ", ".join(f"{value:+.1f}" for value in over)


def over_noise(answer: Mapping[str, Any], key: str) -> Array:
    """Return one of `evaluate`'s RMS over the noise of one reading, rounding included.

    Args:
        answer: What `evaluate` prints as JSON.
        key: Name of the RMS under `rmse`.

    Returns:
        Ratios by axis, (6,).

    """
    noise = np.sqrt(SENSOR.noise_std**2 + SENSOR.quantum**2 / 12.0)
    return np.asarray(np.array(list(answer["rmse"][key].values())) / noise)


def stops(poses: Array) -> BPoly:
    """Return a course that stands at home, at each of the poses, and at home.

    Args:
        poses: Joints, (n, 6), rad.

    Returns:
        Joints over time, s; moves between are of the fifth degree.

    """
    poses = np.concatenate([[HOME], poses, [HOME]])
    arrive_s = np.arange(len(poses)) * (_STAY_S + _MOVE_S)
    knots = np.stack([arrive_s, arrive_s + _STAY_S], axis=1).ravel()
    still = np.zeros_like(poses)
    values = np.repeat(np.stack([poses, still, still], axis=1), 2, axis=0)
    return BPoly.from_derivatives(knots, values)


def _write_bag(path: str, at_s: Array, rows: Array) -> None:
    """Write joints (even steps) and wrenches (odd steps) with their quanta, 500 Hz each."""
    rows[:, 0] = _ENCODER_RAD * np.round(rows[:, 0] / _ENCODER_RAD)
    rows[:, 2] = SENSOR.quantum * np.round(rows[:, 2] / SENSOR.quantum)
    fillers = joint_state_bytes(UR5.arm.joint_names), wrench_bytes(UR5.sensor_frame)
    with BagWriter(path, compressed=False) as bag:
        topics = (
            bag.add_topic("joint_states", JOINT_STATE_TYPE),
            bag.add_topic("wrench_raw", WRENCH_TYPE),
        )
        for k, values in enumerate(rows.tolist()):
            stamp_ns = 1_790_000_000 * NS_PER_S + round(1e9 * at_s[k])
            runs = values[2:] if k % 2 else values[:2]
            bag.write(topics[k % 2], stamp_ns, fillers[k % 2].fill(stamp_ns, *runs))


# A measured Panda

_RECORD = Path(__file__).parents[3] / "shared/data/real/panda_ft_imu/record.txt"
_PERIOD_S, _EDGE, _BLOCKS = 1e-3, 300, 12


def measured_panda() -> str:
    """Score fits of a measured record on blocks that they have not seen: the section's Markdown."""
    if not _RECORD.is_file():
        return "Not measured: the record `panda_ft_imu` is missing."
    table = np.loadtxt(_RECORD, skiprows=1)
    _, acceleration, quaternion, gyro, sensed = np.split(table, [3, 6, 10, 13], axis=1)
    # It fits the quaternions' changes only if degrees were turned into rad twice.
    omega = np.degrees(gyro)
    to_sensor = Rotation.from_quat(quaternion, scalar_first=True)
    gravity = to_sensor.apply([0.0, 0.0, -STANDARD_GRAVITY_M_S2])
    parts = [gravity, acceleration, omega, -sensed]
    low_pass = butter(4, CUTOFF_HZ, fs=1.0 / _PERIOD_S, output="sos")
    # Ten readings a period of the cut-off, as the suite takes them; filters hold nothing at ends.
    thin = slice(_EDGE, -_EDGE, round(0.1 / (CUTOFF_HZ * _PERIOD_S)))
    smooth = _record([sosfiltfilt(low_pass, part, axis=0) for part in parts], thin)
    raw, still = _record(parts, slice(_EDGE, -_EDGE)), np.zeros_like(smooth.gravity)
    weight = MotionRecord(smooth.time_s, smooth.gravity, still, still, still, smooth.wrench)
    try:
        # The arm enters with its mounting alone, which is not asked for.
        found = identify_single_load(smooth.gravity[::5], smooth.wrench[::5], arm=GALEN)
        load = found.load.load
        fit = identify_inertia(smooth, load.moments, np.eye(4))
        answer = f"finds {fit.moments[0]:.3f} kg in the record"
    except GalenError as error:
        answer = f"rejects the record: *{error}*"
    scores = {
        "weight alone": held_out(weight, weight, weighted=False),
        "ten parameters, plain: not filtered, not weighted": held_out(raw, smooth, weighted=False),
        "ten parameters, low-passed alike": held_out(smooth, smooth, weighted=False),
        "and axes weighted, as the suite does": held_out(smooth, smooth, weighted=True),
    }
    return (
        f"{len(table) * _PERIOD_S:.1f} s of motion of a Franka Panda with some 1.2 kg on a coarse"
        f" sensor, and an IMU. Each fit is made without one of {_BLOCKS} blocks of time and scored"
        f" there: root mean square of the residual of readings low-passed at {CUTOFF_HZ:g} Hz. Ten"
        " parameters: mass, first moment, inertia, by least squares with six constants. The arm"
        f" turns at {np.max(np.abs(smooth.velocity_rad_s)):.1f} rad/s at most: `identify_inertia`"
        f" {answer}\n\n{axes_table('fit', scores)}"
    )


def _record(parts: list[Array], rows: slice) -> MotionRecord:
    """Make a record of gravity, acceleration, angular velocity and wrench at each period."""
    gravity, acceleration, omega, wrench = (part[rows] for part in parts)
    alpha = np.gradient(parts[2], _PERIOD_S, axis=0)[rows]
    time_s = _PERIOD_S * np.arange(float(len(parts[0])))[rows]
    return MotionRecord(time_s, gravity, acceleration, omega, alpha, wrench)


def held_out(known: MotionRecord, asked: MotionRecord, *, weighted: bool) -> Array:
    """Return the RMS of residuals in blocks of time that the fit has not seen.

    Args:
        known: Record that is fitted, outside of each block.
        asked: Record whose residuals are taken, inside of each block.
        weighted: Whether axes are weighted by their residuals, in three turns; else all count
            alike.

    Returns:
        RMS by axis, (6,), N and N.m.

    """
    edges = np.linspace(asked.time_s[0], asked.time_s[-1], _BLOCKS + 1)[1:-1]
    block, others = (np.searchsorted(edges, part.time_s) for part in (asked, known))
    rows, all_rows = _rows(known), _rows(asked)
    residuals = np.zeros_like(asked.wrench)
    for number in range(_BLOCKS):
        inside, outside = block == number, others != number
        sigma = np.ones(6)
        for _ in range(3 if weighted else 1):
            design = (rows[outside] / sigma[:, None]).reshape(-1, rows.shape[2])
            right = (known.wrench[outside] / sigma).reshape(-1)
            # Columns of nothing, as of a weight alone, get the value zero.
            values = np.linalg.lstsq(design, right, rcond=None)[0]
            sigma = np.std(known.wrench[outside] - rows[outside] @ values, axis=0)
        residuals[inside] = asked.wrench[inside] - all_rows[inside] @ values
    return np.asarray(np.sqrt(np.mean(residuals**2, axis=0)))


def _rows(record: MotionRecord) -> Array:
    """Return the equations (n, 6, 16) of mass, first moment, inertia and six constants."""
    specific = record.gravity - record.acceleration_m_s2
    rows = inertial_regressor(specific, record.velocity_rad_s, record.acceleration_rad_s2)
    return np.concatenate([rows, np.broadcast_to(np.eye(6), (len(record), 6, 6))], axis=2)


def axes_table(first: str, rows: Mapping[str, Array], unit: float = 1e3) -> str:
    """Make a Markdown table with a column for each axis.

    Args:
        first: Heading of the names' column.
        rows: Values (6,) by name, N and N.m, or plain numbers.
        unit: Factor on the values: 1e3 for mN and mN.m, 1 for plain numbers.

    Returns:
        The table, without a line break at its end.

    """
    heads = [f"{a}, mN{'·m' * (a[0] == 't')}" if unit != 1.0 else a for a in WRENCH_AXES]
    lines = [f"| {first} | {' | '.join(heads)} |", "| --- |" + " ---: |" * len(heads)]
    lines += [
        f"| {name} | {' | '.join(f'{unit * value:.{1 if unit > 1 else 2}f}' for value in six)} |"
        for name, six in rows.items()
    ]
    return "\n".join(lines)
