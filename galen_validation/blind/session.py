# SPDX-License-Identifier: Apache-2.0
"""How a blind recording is made: rates, poses, speeds, pushes, noise; drawn from a seed alone.

Whatever names, sizes and durations of the files show is decided here, before any cause is known,
so that they don't depend on it. The arm is the Galen, or six joints of a robot description.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from galen_model.arm.arm import Arm
from galen_model.arm.description import read_arm
from galen_model.arm.galen import (
    GALEN,
    SENSOR,
    TRACKER_POSITION_NOISE_M,
    TRACKER_ROTATION_NOISE_RAD,
)
from galen_model.arrays import Array, evenly_spread
from galen_model.errors import GalenError
from scipy.interpolate import BPoly, CubicSpline
from scipy.spatial.transform import Rotation

from galen_validation.blind.mujoco_arm import Body

BAGS = ("sweep", "motion", "push")
REFERENCE = "reference"
"""Folder of an earlier recording, in a recording's."""
_POSES = 56
_HIGHEST_JITTER_S = 3e-4
_MOVE_BETWEEN_PUSHES_S = 2.5
_PUSHES = 18
_RAMPS: tuple[Callable[[Array], Array], ...] = (
    lambda part: part,
    lambda part: part**2 * (3.0 - 2.0 * part),
    lambda part: 1.0 - (1.0 - part) ** 2,
)
"""Straight, rounded, and quick at first."""


@cache
def six_axis() -> Arm:
    """Return the arm of the description that galen_bringup installs; raises GalenError."""
    installed = Path("share", "galen_bringup", "urdf", "six_axis.urdf")
    prefixes = os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
    found = [path for prefix in prefixes if prefix and (path := prefix / installed).exists()]
    if not found:
        raise GalenError(
            f"the six-joint arm needs {installed}, which no prefix of AMENT_PREFIX_PATH has: build"
            " galen_bringup and source its set-up"
        )
    arm = read_arm(found[0].read_text(encoding="utf-8"))
    bent = 0.0, -1.3, 1.7, -0.8, 0.5, 0.0
    joints = zip(arm.joints, bent, strict=True)
    return replace(arm, joints=tuple(replace(joint, home=home) for joint, home in joints))


ARMS: Mapping[str, Callable[[], Arm]] = {
    "galen": lambda: GALEN,
    "six_axis": six_axis,
    "galen_usual": lambda: GALEN,
    "six_axis_usual": six_axis,
}
"""Carefully calibrated ones, and `usual` ones that are as data sheets say."""

USUAL = "_usual"
_HEAVIER = 4.0
"""Tools of a usual serial arm over the surgeon's: 0.2 to 0.8 kg."""


class Space(NamedTuple):
    """Where an arm is used, about its middle (n,): each joint's reach and speed in free motion."""

    middle: Array
    reach: Array
    fastest: Array


_LOW, _HIGH = np.array([-1.45, -0.95]), np.array([1.45, 0.87])
"""Used part of the Galen's angles, rad: inside the limits with what jitter adds."""


def space(arm: Arm) -> Space:
    """Return an arm's usual space; that of a serial arm is the wider the nearer to the tool.

    Args:
        arm: The nominal arm; one with a delta is taken for the Galen.

    Returns:
        Middle and reach (n,), rad or m, and speeds (n,), rad/s or m/s.

    """
    if arm.delta is not None:
        middle = arm.with_angles(0.5 * (_LOW + _HIGH))
        return Space(middle, arm.by_unit(0.09, (1.35, 0.85)), arm.by_unit(0.1, 2.0))
    reach = np.linspace(0.6, 1.4, len(arm.joints))
    room = np.minimum(arm.upper - arm.home, arm.home - arm.lower) - 0.1
    return Space(arm.home, np.minimum(reach, room), arm.by_unit(0.1, 1.2))


@dataclass(frozen=True)
class Tool:
    """What the tool's file says: name, mass (kg), centre and tip (3,) in ft_sensor (m)."""

    name: str
    mass_kg: float
    com_m: Array
    tip_m: Array

    @property
    def body(self) -> Body:
        """A rod from the mount through the centre, 15 mm thick."""
        length = 2.0 * float(np.linalg.norm(self.com_m))
        along = self.com_m / np.linalg.norm(self.com_m)
        across = np.eye(3) - np.outer(along, along)
        inertia = self.mass_kg * (length**2 / 12.0 * across + 0.0075**2 / 2.0 * np.eye(3))
        return Body(self.mass_kg, self.com_m, inertia)


TOOLS = (
    Tool("pointer", 0.060, np.array([0.055, 0.002, 0.045]), np.array([0.150, 0.0, 0.050])),
    Tool("retractor", 0.200, np.array([0.070, -0.010, 0.055]), np.array([0.180, 0.010, 0.050])),
    Tool("probe", 0.118, np.array([0.048, 0.012, 0.062]), np.array([0.128, 0.022, 0.081])),
)
"""The contract's two and a third one."""

ADAPTER = Body(0.100, np.array([0.0, 0.0, 0.020]), 0.1 * 0.025**2 * np.diag([0.25, 0.25, 0.5]))
"""The adapter as the file has it: a disc of 50 mm."""


@dataclass(frozen=True)
class Clock:
    """One topic's n samples: stamps and when they were taken, s since the bag's first stamp."""

    stamp_s: Array
    taken_s: Array


@dataclass(frozen=True)
class Pushes:
    """k pushes, each with its start, rise, hold, fall, tremor_hz, tremor and ramp (k,).

    force_n (k, 3) and at_m (k, 3), where it acts: in ft_sensor. tremor: share of the force; ramp:
    number in `_RAMPS`.
    """

    start_s: Array
    rise_s: Array
    hold_s: Array
    fall_s: Array
    force_n: Array
    at_m: Array
    ramp: np.ndarray
    tremor: Array
    tremor_hz: Array

    @property
    def end_s(self) -> Array:
        """When each is over (k,)."""
        return self.start_s + self.rise_s + self.hold_s + self.fall_s

    def wrench(self, at_s: Array) -> Array:
        """Return the pushes' wrench at times.

        Args:
            at_s: Times since the bag's first stamp, (n,), s.

        Returns:
            Wrenches about the sensor's origin in ft_sensor, (n, 6), N and N.m; 0 between pushes.

        """
        k = np.maximum(np.searchsorted(self.start_s, at_s, side="right") - 1, 0)
        since = at_s - self.start_s[k]
        up = np.clip(since / self.rise_s[k], 0.0, 1.0)
        down = np.clip((self.end_s[k] - at_s) / self.fall_s[k], 0.0, 1.0)
        share = np.choose(self.ramp[k], [ramp(up) * ramp(down) for ramp in _RAMPS])
        held = np.sin(np.pi * np.clip((since - self.rise_s[k]) / self.hold_s[k], 0, 1))
        wave = np.sin(2.0 * np.pi * self.tremor_hz[k] * since)
        force = (share * (1.0 + self.tremor[k] * held * wave))[:, None] * self.force_n[k]
        return np.concatenate([force, np.cross(self.at_m[k], force)], axis=1)


@dataclass(frozen=True)
class Take:
    """One bag: how the arm moves, and when what is recorded.

    start_s: its first stamp since the recording's; end_s: since the bag's. course: reported joints
    over time. recorded (k, 2): spans that are in the bag. places (k, n): where the tool is pushed.
    """

    bag: str
    start_s: float
    end_s: float
    course: BPoly | CubicSpline
    joints: Clock
    wrench: Clock
    tracker: Clock | None = None
    pushes: Pushes | None = None
    places: Array | None = None
    recorded: Array | None = None


@dataclass(frozen=True)
class Session:
    """A recording as it is planned; the sensor is zeroed with the arm at home.

    wrench_std (6,): of a sample, N and N.m; rho: correlation of a sample's noise with the one
    before. tracker_std (2,): m, rad. base, marker: rotation and place of base_link in `tracker`,
    and of the base marker in base_link. zero (6,): offset of the reading. epoch_s: first stamp.
    """

    seed: int
    arm: Arm
    tool: Tool
    takes: dict[str, Take]
    wrench_std: Array
    rho: float
    tracker_std: Array
    tracker_rho: float
    base: tuple[Array, Array]
    marker: tuple[Array, Array]
    zero: Array
    epoch_s: int
    duration_s: float


def draw_session(
    seed: int,
    bags: tuple[str, ...] = BAGS,
    *,
    arm: Arm,
    usual: bool = False,
    tool: Tool | None = None,
) -> Session:
    """Draw the session of a seed with an arm.

    Args:
        seed: Seed of the case.
        bags: Bags to keep; all are drawn, so that leaving one out changes the others' course in
            nothing.
        arm: The nominal arm.
        usual: Whether the arm is as data sheets say; serial ones then have heavier tools.
        tool: That of an earlier session; None to draw one.

    Returns:
        The session, before any cause is known.

    """
    rng = np.random.default_rng([seed, 1])
    drawn = TOOLS[rng.integers(len(TOOLS))]
    if usual and arm.delta is None:
        drawn = replace(drawn, mass_kg=_HEAVIER * drawn.mass_kg)
    tool = tool or drawn
    makers = {"sweep": _sweep, "motion": _motion, "push": _push}
    takes: dict[str, Take] = {}
    start_s = 0.0
    for bag in BAGS:
        # Every bag is drawn, so that leaving one out changes no other.
        take = makers[bag](rng, start_s, tool, arm)
        pause_s = rng.uniform(8.0, 25.0)
        if bag in bags:
            takes[bag] = take
            start_s = start_s + take.end_s + pause_s
    rho = float(rng.uniform(0.2, 0.6)) if rng.random() < 1.0 / 3.0 else 0.0
    tracker_std = np.array([TRACKER_POSITION_NOISE_M, TRACKER_ROTATION_NOISE_RAD])
    return Session(
        seed=seed,
        arm=arm,
        tool=tool,
        takes=takes,
        wrench_std=SENSOR.noise_std * rng.uniform(0.8, 1.2, 6),
        rho=rho,
        tracker_std=tracker_std * rng.uniform(0.8, 1.2, 2),
        tracker_rho=rho if rng.random() < 0.5 else 0.0,
        base=(
            Rotation.from_rotvec(rng.uniform(0.3, 2.5) * any_direction(rng)).as_matrix(),
            rng.uniform([-0.5, -0.5, 1.2], [0.5, 0.5, 2.2]),
        ),
        marker=(
            Rotation.from_rotvec(rng.uniform(0.1, 1.5) * any_direction(rng)).as_matrix(),
            rng.uniform([0.1, -0.4, 0.0], [0.5, 0.4, 0.4]),
        ),
        zero=np.array([*[0.01] * 3, *[2e-4] * 3]) * rng.standard_normal(6),
        epoch_s=int(rng.integers(1_740_000_000, 1_790_000_000)),
        duration_s=start_s - pause_s,
    )


def any_direction(rng: np.random.Generator, count: int = 3) -> Array:
    """Draw a unit vector, every direction as likely.

    Args:
        rng: Random generator.
        count: Number of components.

    Returns:
        The vector, (count,), of length 1.

    """
    drawn = rng.standard_normal(count)
    return np.asarray(drawn / np.linalg.norm(drawn))


def _clock(rng: np.random.Generator, rate_hz: float, recorded: Array, phase_s: float) -> Clock:
    parts = [
        np.arange(np.ceil((a - phase_s) * rate_hz), np.floor((b - phase_s) * rate_hz) + 1) / rate_hz
        for a, b in recorded
    ]
    taken = np.concatenate(parts) + phase_s
    jitter = rng.uniform(0.0, _HIGHEST_JITTER_S) * rng.random(len(taken))
    return Clock(taken + jitter, taken)


def _clocks(
    rng: np.random.Generator, recorded: Array, slowest_hz: float, fastest_hz: float
) -> tuple[Clock, Clock]:
    """Of joints, which start at zero, and of wrenches."""
    rate_hz = float(rng.uniform(slowest_hz, fastest_hz))
    ratio = 1.0 if rng.random() < 0.5 else rng.uniform(0.8, 1.0)
    phase = rng.uniform(0.0, 7e-4)
    return _clock(rng, rate_hz * ratio, recorded, 0.0), _clock(rng, rate_hz, recorded, phase)


def _stops(poses: Array, arrive_s: Array, leave_s: Array) -> BPoly:
    """Stand at poses (k, n) from arrive_s to leave_s (k,), with moves of the fifth degree."""
    knots = np.stack([arrive_s, leave_s], axis=1).ravel()
    still = np.zeros_like(poses)
    values = np.repeat(np.stack([poses, still, still], axis=1), 2, axis=0)
    return BPoly.from_derivatives(knots, values)


def _sweep(rng: np.random.Generator, start_s: float, tool: Tool, arm: Arm) -> Take:
    if arm.delta is None:
        mean, reach, fastest = space(arm)
        poses = mean + reach * (2.0 * evenly_spread(_POSES, len(reach)) - 1.0)
        if rng.random() < 0.5:
            rng.shuffle(poses)
        poses = poses + rng.uniform(-0.06, 0.06, poses.shape)
        poses, speed = np.vstack([mean, poses]), float(fastest[-1])
    else:
        poses, speed = _grid(rng, arm), 2.6
    a_pose_s = rng.uniform(1.2, 2.5)
    stay_s = a_pose_s * rng.uniform(0.55, 0.75)
    farthest = np.max(np.abs(np.diff(arm.angles(poses), axis=0)), axis=1)
    # A move of the fifth degree is fastest in its middle, at 15/8 of its mean speed.
    move_s = np.maximum(a_pose_s - stay_s, 15.0 / 8.0 * farthest / speed)
    stay = stay_s * rng.uniform(0.95, 1.05, len(poses))
    arrive_s = np.concatenate([[0.0], np.cumsum(stay[:-1] + move_s)])
    leave_s = arrive_s + stay
    end_s = float(leave_s[-1])
    clocks = _clocks(rng, np.array([[0.0, end_s]]), 40.0, 120.0)
    return Take("sweep", start_s, end_s, _stops(poses, arrive_s, leave_s), *clocks)


def _grid(rng: np.random.Generator, arm: Arm) -> Array:
    """Poses (57, 5) of the Galen, home's angles first: 7 tilts by 8 rolls at one place."""
    inner, outer = np.linspace(_LOW[0], _HIGH[0], 8), np.linspace(_LOW[1], _HIGH[1], 7)
    rows = [[(a, b) for a in inner[:: (-1) ** k]] for k, b in enumerate(outer)]
    angles = np.concatenate([np.array(row) for row in rows])
    if rng.random() < 0.5:
        rng.shuffle(angles)
    angles = angles + rng.uniform(-0.06, 0.06, angles.shape)
    place = arm.home[:3] + rng.uniform(-0.04, 0.04, 3) * (rng.random() < 0.5)
    return arm.with_angles(np.vstack([np.zeros(2), angles]), np.append(place, np.zeros(2)))


def _motion(rng: np.random.Generator, start_s: float, tool: Tool, arm: Arm) -> Take:
    duration_s = float(rng.uniform(30.0, 60.0))
    middle, reach, fastest = space(arm)
    fastest = fastest * rng.uniform(0.5, 1.0, len(reach))
    knots = max(8, round(duration_s / rng.uniform(0.9, 1.8)))
    knot_s = np.linspace(0.0, duration_s, knots)
    knot_s[1:-1] += 0.2 * duration_s / knots * rng.uniform(-1.0, 1.0, knots - 2)
    offset = reach * rng.uniform(-0.8, 0.8, (knots, len(reach)))
    offset[[0, -1]] = 0.0
    course = CubicSpline(knot_s, offset, bc_type="clamped")
    fine = np.arange(0.0, duration_s, 0.05)
    # A spline swings past its knots.
    share = np.minimum(1.0, fastest / np.max(np.abs(course(fine, 1)), axis=0))
    share = np.minimum(share, reach / np.max(np.abs(course(fine)), axis=0))
    course = CubicSpline(knot_s, middle + share * offset, bc_type="clamped")
    clocks = _clocks(rng, np.array([[0.0, duration_s]]), 100.0, 500.0)
    return Take("motion", start_s, duration_s, course, *clocks)


def _push(rng: np.random.Generator, start_s: float, tool: Tool, arm: Arm) -> Take:
    if arm.delta is None:
        mean, reach, _ = space(arm)
        poses = mean + 0.5 * reach * rng.uniform(-1.0, 1.0, (4, len(reach)))
    else:
        corners = np.array([[0.4, 0.25], [-0.5, 0.3], [0.55, -0.35], [-0.35, -0.4]])
        corners = corners + rng.uniform(-0.2, 0.2, (4, 2))
        rng.shuffle(corners)
        poses = np.column_stack([arm.home[:3] + rng.uniform(-0.08, 0.08, (4, 3)), corners])
    if rng.random() < 0.5:
        poses[0] = arm.home
    rest_s = 3.0
    gap_s = float(rng.uniform(0.12, 0.3))
    stay_s = rest_s + _PUSHES * (0.45 + 0.6 + 0.45 + 1.2 * gap_s) + 0.5
    arrive_s = np.arange(4.0) * (stay_s + _MOVE_BETWEEN_PUSHES_S)
    pushes = _draw_pushes(rng, arrive_s + rest_s, tool.tip_m, gap_s)
    ends = np.asarray(pushes.end_s.reshape(4, -1)[:, -1] + 0.4)
    # What doesn't give under a push shows a tracker's delay on the last of the way there.
    begin_s = arrive_s - (0.5 if not arm.stiffness else 0.0) * (arrive_s > 0.0)
    recorded = np.column_stack([begin_s, ends])
    clocks = _clocks(rng, recorded, 80.0, 250.0)
    tracker = _clock(rng, float(rng.uniform(60.0, 150.0)), recorded, rng.uniform(0.0, 5e-3))
    course = _stops(poses, arrive_s, arrive_s + stay_s)
    return Take("push", start_s, float(ends[-1]), course, *clocks, tracker, pushes, poses, recorded)


def _draw_pushes(rng: np.random.Generator, begin_s: Array, tip_m: Array, gap_s: float) -> Pushes:
    """18 pushes from each of the times (p,) on: about 3, 6 and 11 N along every axis both ways."""
    first_ramp = int(rng.integers(len(_RAMPS)))
    found: dict[str, list[Any]] = {name: [] for name in Pushes.__dataclass_fields__}
    ways = np.concatenate([np.eye(3), -np.eye(3)])
    for begin in begin_s:
        plan = [(level, way) for level in (3.0, 6.0, 11.0) for way in ways]
        rng.shuffle(plan)
        at_s = float(begin)
        for level, way in plan:
            rise, fall = rng.uniform(0.2, 0.45, 2)
            hold = rng.uniform(0.35, 0.6)
            aside = way + 0.04 * rng.standard_normal(3)
            force = level * (1.0 + 0.04 * rng.standard_normal()) * aside / np.linalg.norm(aside)
            drawn = (
                at_s, rise, hold, fall, force, tip_m + 0.002 * rng.standard_normal(3),
                (first_ramp + rng.integers(2)) % len(_RAMPS), rng.uniform(0.0, 0.03),
                rng.uniform(1.0, 5.0),
            )  # fmt: skip
            for values, value in zip(found.values(), drawn, strict=True):
                values.append(value)
            at_s += rise + hold + fall + gap_s * rng.uniform(0.8, 1.2)
    return Pushes(**{name: np.array(values) for name, values in found.items()})
