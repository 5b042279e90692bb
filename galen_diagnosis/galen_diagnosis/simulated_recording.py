# SPDX-License-Identifier: Apache-2.0
"""Makes a diagnostic recording (contract, section 5) with the simulated arm, without ROS.

    python -m galen_diagnosis.simulated_recording tilt --output DIR

makes one of the 2019 report's two stories, to try a diagnosis with:

    drift   figure 12: the reading along z drifts, and compensation is the worse the later it is
    tilt    figure 13: the tilt joint's kinematics are wrong, and compensation errs with the tilt

or, of any arm, an effect of its usual size: `joint_zero_offset:elbow --urdf ARM.urdf`.

One plant goes through all three bags, with some seconds between them, as a person records them: the
sweep's poses row by row, a free motion of all joints, and pushes at four positions; the moves from
one position to the next are not in the bag. It steps as fast as it goes. A plant has no bags:
effects that count from a bag's first stamp get their time from the recording's first stamp.

Poses and motions of another arm than the Galen lie about the middle of its joints, or their zero
where the limits leave room; nothing checks that it doesn't touch itself there.
"""

from __future__ import annotations

import json
import os
import shutil
import sys
import tempfile
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path

import numpy as np
from galen_bags.arrays.arm_recording import JOINT_STATE_TYPE, POSE_TYPE, WRENCH_TYPE
from galen_bags.formats.writer import BagWriter
from galen_common.arm import add_arm, chosen_arm
from galen_common.cdr import joint_state_bytes, pose_bytes, wrench_bytes
from galen_common.command import EXIT_OK, make_parser, run_command, writing
from galen_model.arm.arm import Arm
from galen_model.arm.galen import GALEN, SENSOR, TRACKER_FRAME
from galen_model.arrays import Array, evenly_spread
from galen_model.errors import GalenError
from galen_model.files.calibration_file import CalibrationFile, write_calibration, zeroed_at
from galen_model.load.model import Load, LoadEstimate
from galen_model.poses.plan import quintic_duration_s
from galen_sim_driver.effects.effect import BAG_ORDER, Effect
from galen_sim_driver.effects.joints import JointGain
from galen_sim_driver.effects.registry import contract_parameters, identities
from galen_sim_driver.effects.sensor import SensorDrift
from galen_sim_driver.plant.cell import Plant, Sample
from galen_sim_driver.plant.config import HandPush, PlantConfig, velocity_limits
from galen_sim_driver.plant.motion import Trajectory, TrajectoryPoint

RATE_HZ = 200.0
"""Of the plant: a multiple of the rates of all bags."""

BAG_RATES_HZ = {"sweep": 50.0, "motion": 200.0, "push": 100.0}
TRACKER_RATE_HZ = 60.0
MOTION_S = 45.0

_START_NS = 1_700_000_000_000_000_000
_PAUSE_S = 5.0
"""Between two bags; the move to where the next starts takes as much."""
_STILL_S = 1.6
_MOVE_VELOCITY, _MOVE_ACCELERATION = (0.15, 1.3), (0.8, 5.0)
"""Of joints that slide and turn, m/s and rad/s, m/s^2 and rad/s^2; others at most this share:"""
_OF_FASTEST = 0.9
_REACH = (0.08, 1.2)
"""Of another arm, m and rad, to both sides of its middle pose."""
_POSES = 56
_POINT_S = 0.05

_REST_S = 3.0
_PUSH_S = 1.5
_PUSH_LEVELS_N = (3.0, 6.0, 11.0)
_PUSH_POSITIONS = np.array(
    [
        [0.000, 0.000, 0.408, 0.0, 0.0],
        [0.055, -0.045, 0.440, 0.6, -0.4],
        [-0.050, 0.060, 0.370, -0.7, 0.4],
        [0.030, 0.050, 0.420, 0.4, 0.6],
    ]
)


def sweep_poses(arm: Arm) -> Array:
    """Return joints of a sweep: of the Galen 7 tilts, 8 rolls each, there and back.

    Of another arm evenly about its middle pose.

    Args:
        arm: Which is recorded.

    Returns:
        Joints in the arm's order, (56, n), m and rad.

    """
    if arm.delta is None:
        return _about_middle(arm, _POSES, 1.0)
    tilts, rolls = np.linspace(-0.95, 0.85, 7), np.linspace(-1.4, 1.4, 8)
    rows = [
        (roll, tilt) for k, tilt in enumerate(tilts) for roll in rolls[:: 1 if k % 2 == 0 else -1]
    ]
    return arm.with_angles(rows)


def push_positions(arm: Arm) -> Array:
    """Return joints of the pushes, the first one's the middle pose.

    Args:
        arm: Which is recorded.

    Returns:
        Joints in the arm's order, (4, n), m and rad.

    """
    if arm.delta is not None:
        return _PUSH_POSITIONS
    return np.vstack([_middle(arm)[0], _about_middle(arm, len(_PUSH_POSITIONS) - 1, 0.5)])


def _middle(arm: Arm) -> tuple[Array, Array]:
    """Return home (n,), or as near to it as leaves room to both sides, and the room (n,)."""
    if arm.delta is not None:
        return arm.home, arm.by_unit(*_REACH)
    room = np.minimum(arm.by_unit(*_REACH), 0.5 * (arm.upper - arm.lower))
    return np.clip(arm.home, arm.lower + room, arm.upper - room), room


def _about_middle(arm: Arm, count: int, share: float) -> Array:
    middle, room = _middle(arm)
    return middle + share * room * (2.0 * evenly_spread(count, len(room)) - 1.0)


def make_recording(
    directory: str | os.PathLike[str],
    effects: Sequence[Effect] = (),
    seed: int = 0,
    tool: str = "pointer",
    *,
    arm: Arm,
    poses: Array | None = None,
    bags: Sequence[str] = BAG_ORDER,
    truth: bool = False,
) -> None:
    """Make a recording in a new directory; it is whole or not there.

    Args:
        directory: must not exist.
        effects: what the arm has beside nominal.
        seed: of all noise, of how the arm moves in the free motion and of how hard it is pushed.
        tool: its name.
        arm: which is recorded; `arm.urdf` is written of another one than the Galen.
        poses: (n, joints), of the sweep.
        bags: those that are written.
        truth: with truth.json beside it.

    Raises:
        GalenError: the directory exists or can't be made; a bag or tool that isn't known.
        ConfigError: an effect's numbers can't be.

    """
    target = Path(directory)
    if target.exists() or target.is_symlink():
        raise GalenError(f"{target}: is there already, and is not written over")
    unknown = [name for name in bags if name not in BAG_ORDER]
    if unknown:
        raise GalenError(f"no bag '{unknown[0]}'; a recording has {', '.join(BAG_ORDER)}")
    with writing(target):
        target.parent.mkdir(parents=True, exist_ok=True)
        work = Path(tempfile.mkdtemp(dir=target.parent, prefix=f".{target.name}."))
    try:
        session = _Session(work, effects, seed, tool, arm, poses)
        with writing(target):
            session.record(bags)
            if truth:
                added = [{"effect": e.name, "parameters": contract_parameters(e)} for e in effects]
                text = json.dumps({"effects": added}, indent=1)
                (work / "truth.json").write_text(text, encoding="utf-8")
            work.chmod(0o755)  # mkdtemp's are the owner's alone
            os.replace(work, target)
    finally:
        shutil.rmtree(work, ignore_errors=True)


class _Session:
    """One plant on its way through the bags."""

    def __init__(
        self,
        directory: Path,
        effects: Sequence[Effect],
        seed: int,
        tool: str,
        arm: Arm,
        poses: Array | None,
    ) -> None:
        self._directory, self._arm = directory, arm
        self._rng = np.random.default_rng([seed, 1])
        poses = self._poses = sweep_poses(arm) if poses is None else poses
        self._middle, self._places = _middle(arm)[0], push_positions(arm)
        fastest = _OF_FASTEST * np.array(velocity_limits(arm))
        self._limits = (
            np.minimum(arm.by_unit(*_MOVE_VELOCITY), fastest),
            arm.by_unit(*_MOVE_ACCELERATION),
        )
        self._motion = _free_motion(self._rng, arm, fastest)
        ways = zip([self._middle, *poses[:-1]], poses, strict=True)
        moves = [self._move_s(a, b) for a, b in ways]
        self._sweep_s = sum(moves) + _STILL_S * len(poses)
        starts = {"sweep": 0.0, "motion": self._sweep_s + _PAUSE_S}
        starts["push"] = starts["motion"] + MOTION_S + _PAUSE_S
        self._starts = starts
        config = PlantConfig(
            rate_hz=RATE_HZ,
            start_ns=_START_NS,
            start_joints=tuple(self._middle.tolist()),
            arm=arm,
            tracker_rate_hz=TRACKER_RATE_HZ,
            effects=tuple(effect.in_session(starts) for effect in effects),
            hand=_pushes(self._rng),
        )
        self._plant = Plant(config, np.random.default_rng([seed, 2]))
        attached = self._plant.attach_tool(tool)
        if attached is None:
            raise GalenError("a recording needs a tool on the arm")
        self._tool_file = _believed(tool, attached.load, config.adapter, attached.tip_m, arm)

    def record(self, bags: Sequence[str]) -> None:
        """Go through all bags and write those asked for."""
        write_calibration(self._directory / "tool.json", self._tool_file)
        if self._arm.joint_names != GALEN.joint_names:
            (self._directory / "arm.urdf").write_text(self._arm.urdf, encoding="utf-8")
        parts = {"sweep": self._sweep, "motion": self._free, "push": self._push}
        last = max(map(BAG_ORDER.index, bags), default=-1)
        for name in BAG_ORDER[: last + 1]:
            self._wait_for(self._starts[name])
            path = self._directory / name
            with BagWriter(path) if name in bags else nullcontext() as writer:
                parts[name](_Tape(writer, name, self._plant, self._arm))

    def _sweep(self, tape: _Tape) -> None:
        here = self._middle
        for pose in self._poses:
            self._move(here, pose, tape)
            tape.run(_STILL_S)
            here = pose
        # The way to where the motion starts is not recorded.
        self._order(here, self._middle, _PAUSE_S - 1.0)

    def _free(self, tape: _Tape) -> None:
        self._plant.command(self._motion)
        tape.run(MOTION_S)
        self._order(self._middle, self._places[0], 1.0)

    def _push(self, tape: _Tape) -> None:
        for number, position in enumerate(self._places):
            if number > 0:
                tape.on = False
                self._move(self._places[number - 1], position, tape)
                tape.run(1.0)
                tape.on = True
            tape.run(_REST_S)
            self._plant.start_hand()
            tape.run(_PUSH_S * 6 * len(_PUSH_LEVELS_N))

    def _move(self, start: Array, end: Array, tape: _Tape) -> None:
        duration_s = self._move_s(start, end)
        self._order(start, end, duration_s)
        tape.run(duration_s)

    def _move_s(self, start: Array, end: Array) -> float:
        """How long a quintic from rest to rest takes within the limits, and 0.3 s at least."""
        return round(quintic_duration_s(end - start, *self._limits, 0.3), 2)

    def _order(self, start: Array, end: Array, duration_s: float) -> None:
        if np.array_equal(start, end):
            return
        rest = [0.0] * len(self._arm.joint_names)
        point = TrajectoryPoint(duration_s, end.tolist(), rest, rest)
        self._plant.command(Trajectory(self._arm.joint_names, [point]))

    def _wait_for(self, since_start_s: float) -> None:
        until_ns = _START_NS + round(since_start_s * 1e9)
        while self._plant.now_ns < until_ns:
            self._plant.step()


class _Tape:
    """Steps the plant and writes what a recorder of one bag gets."""

    def __init__(self, writer: BagWriter | None, bag: str, plant: Plant, arm: Arm) -> None:
        self._writer, self._plant = writer, plant
        self._every = round(RATE_HZ / BAG_RATES_HZ[bag])
        self._period_ns = round(1e9 / RATE_HZ)
        self._joints = joint_state_bytes(arm.joint_names, arm.base_frame)
        self._wrench = wrench_bytes(arm.sensor_frame)
        self._pose = pose_bytes(TRACKER_FRAME)
        self._markers: list[int] = []
        self.on = True
        if writer is not None:
            self._joint_states = writer.add_topic("joint_states", JOINT_STATE_TYPE)
            self._wrench_raw = writer.add_topic("wrench_raw", WRENCH_TYPE)
            if bag == "push":
                names = ("tracker/tool_pose", "tracker/base_pose")
                self._markers = [writer.add_topic(name, POSE_TYPE) for name in names]

    def run(self, duration_s: float) -> None:
        """Step the plant for this long."""
        end_ns = self._plant.now_ns + round(duration_s * 1e9)
        while self._plant.now_ns < end_ns:
            sample = self._plant.step()
            if self.on and self._writer is not None:
                self._write(self._writer, sample)

    def _write(self, bag: BagWriter, sample: Sample) -> None:
        stamp_ns = sample.stamp_ns
        if (stamp_ns // self._period_ns) % self._every == 0:
            state = self._joints.fill(stamp_ns, sample.positions, sample.velocities)
            bag.write(self._joint_states, stamp_ns, state)
            late_ns = stamp_ns + self._plant.wrench_delay_ns
            bag.write(self._wrench_raw, late_ns, self._wrench.fill(late_ns, sample.wrench))
        seen = sample.tracker
        if self._markers and seen is not None and seen[0] is not None:
            late_ns = stamp_ns + self._plant.tracker_delay_ns
            for topic, marker in zip(self._markers, (seen[0], seen[1]), strict=True):
                position, turn = marker
                bag.write(topic, late_ns, self._pose.fill(late_ns, list(position), list(turn)))


_TONES_HZ = np.array([0.09, 0.17, 0.31, 0.83])
_SHARES = np.array([1.0, 0.6, 0.35, 0.12])


def _free_motion(rng: np.random.Generator, arm: Arm, fastest: Array) -> Trajectory:
    """All joints at once, sums of four sines with phases and tones of their own, there and back.

    About the middle pose; fastest (n,): m/s and rad/s. The ends are smooth: the sums are faded in
    and out over 3 s by a quintic. Velocities and accelerations at the points are differences of the
    curve itself.
    """
    step_s = 0.001
    at_s = np.arange(0.0, MOTION_S + 0.5 * step_s, step_s)
    middle, room = _middle(arm)
    amplitude = arm.by_unit(0.016, 0.28 if arm.delta is None else (0.42, 0.28))
    if arm.delta is None:  # sums of four sines have 2.07 times the first one's size
        slow = fastest / (1.15 * 2.0 * np.pi * _SHARES @ _TONES_HZ)
        amplitude = np.min([amplitude, 0.45 * room, slow], axis=0)
    amplitudes = amplitude[:, None] * _SHARES
    tones = _TONES_HZ * rng.uniform(0.85, 1.15, amplitudes.shape)
    phases = rng.uniform(0.0, 2.0 * np.pi, amplitudes.shape)
    angle = 2.0 * np.pi * tones[:, :, None] * at_s + phases[:, :, None]
    swing = np.einsum("jk,jkn->nj", amplitudes, np.sin(angle))
    ends = np.clip(np.minimum(at_s, at_s[-1] - at_s) / 3.0, 0.0, 1.0)
    fade = ends**3 * (10.0 - 15.0 * ends + 6.0 * ends**2)
    joints = middle + fade[:, None] * swing
    velocity = np.gradient(joints, step_s, axis=0)
    acceleration = np.gradient(velocity, step_s, axis=0)
    every = round(_POINT_S / step_s)
    points = [
        TrajectoryPoint(
            float(at_s[k]), joints[k].tolist(), velocity[k].tolist(), acceleration[k].tolist()
        )
        for k in range(every, len(at_s), every)
    ]
    return Trajectory(arm.joint_names, points)


def _pushes(rng: np.random.Generator) -> tuple[HandPush, ...]:
    """18 pushes: three levels in + and - every axis of base_link, as exactly as a hand can."""
    pushes: list[HandPush] = []
    for axis in range(3):
        for level in _PUSH_LEVELS_N:
            for sign in (1.0, -1.0):
                force = rng.normal(0.0, 0.08 * level, 3)
                force[axis] = sign * level * rng.uniform(0.85, 1.05)
                x, y, z = force.tolist()
                ramp_s = float(rng.uniform(0.25, 0.4))
                pushes.append(
                    HandPush(_PUSH_S * len(pushes), _PUSH_S - 0.4, (x, y, z), ramp_s=ramp_s)
                )
    return tuple(pushes)


def _believed(tool: str, load: Load, adapter: Load, tip_m: Array, arm: Arm) -> CalibrationFile:
    """tool.json as a calibration some time before would have left it, without its error."""

    def estimate(of: Load) -> LoadEstimate:
        covariance = np.diag([1e-8, 1e-10, 1e-10, 1e-10])
        return LoadEstimate(of.mass_kg, np.asarray(of.com_m, dtype=float), covariance)

    return CalibrationFile(
        tool=tool,
        load=estimate(load),
        adapter=estimate(adapter),
        tip_m=np.asarray(tip_m, dtype=float),
        rmse=SENSOR.noise_std.copy(),
        poses_used=56,
        calibrated_at="2023-11-14T00:00:00Z",
        arm=arm,
        zeroing=zeroed_at(arm=arm),
        gravity_m_s2=np.array(arm.gravity_m_s2),
    )


# The report's stories


def _bias_drift() -> SensorDrift:
    """Along z by 0.24 N in the recording's five minutes, not evenly; a little along x."""
    knots_s = np.linspace(0.0, 312.0, 7)
    levels = np.zeros((len(knots_s), 6))
    levels[:, 2] = [0.0, 0.06, 0.14, 0.12, 0.17, 0.20, 0.24]
    levels[:, 0] = [0.0, 0.004, 0.01, 0.012, 0.012, 0.016, 0.02]
    return SensorDrift.through(knots_s, levels)


STORIES: dict[str, tuple[Effect, int]] = {
    "drift": (_bias_drift(), 12),
    "tilt": (JointGain("tilt", 0.02), 13),
}
"""What each story's arm has, and its seed."""


def _story(name: str, arm: Arm) -> tuple[tuple[Effect, ...], int]:
    """Return a story, or an effect of the arm of its usual size; raises GalenError."""
    if name == "none":
        return (), 1
    known = identities(arm)
    if name in known:
        effect = known[name]
        sizes = np.concatenate([np.zeros(0), *(part.typicals for part in effect.fitted)])
        return (effect.with_vector(sizes),), 1
    if name not in STORIES or (name == "tilt" and arm.delta is None):
        raise GalenError(f"no story '{name}' of the arm {arm.name}; there are {', '.join(known)}")
    effect, seed = STORIES[name]
    return (effect,), seed


def main(args: Sequence[str] | None = None) -> int:
    """Entry point.

    Args:
        args: Command line; None for the process's own.

    Returns:
        The exit code.

    """
    parser = make_parser(
        "simulated_recording",
        "Make a recording that shows one of the 2019 report's stories, or one effect.",
        failed="the directory is there already, or can't be written",
    )
    parser.add_argument(
        "story",
        help="drift: figure 12; tilt: figure 13; none; or an effect, of a joint as effect:joint",
    )
    parser.add_argument("--output", type=Path, required=True, metavar="DIR", help="make this")
    add_arm(parser)
    arguments = parser.parse_args(args)

    def make() -> int:
        arm = chosen_arm(arguments)
        effects, seed = _story(arguments.story, arm)
        make_recording(arguments.output, effects, seed, arm=arm, truth=True)
        return EXIT_OK

    return run_command("simulated_recording", make)


if __name__ == "__main__":
    sys.exit(main())
