"""How a recording is made: rates, poses, speeds, pushes, noise; drawn from a seed alone.

Whatever names, sizes and durations of the files can tell is decided here, before any cause is
known, so that they tell nothing about it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from galen_model.arm.galen import (
    HOME,
    SENSOR,
    TRACKER_POSITION_NOISE_M,
    TRACKER_ROTATION_NOISE_RAD,
)
from galen_model.arrays import Array

from galen_diagnosis.blind.plant.arm import Body
from galen_diagnosis.blind.plant.course import Course, Multisine, Spline, Stops
from galen_diagnosis.blind.plant.hand import Pushes, draw_pushes, longest_s
from galen_diagnosis.blind.plant.turning import any_direction, turned_by

BAGS = ("sweep", "motion", "push")
_ROLL_REACH, _TILT_LOW, _TILT_HIGH = 1.45, -0.95, 0.87
"""Used part of roll and tilt, rad: inside the limits with what jitter adds."""
_FASTEST_TURN, _FASTEST_WAY = 2.0, 0.1
"""rad/s and m/s in the bag of motion."""
_HIGHEST_JITTER_S = 3e-4
_MOVE_BETWEEN_PUSHES_S = 2.5


@dataclass(frozen=True)
class Tool:
    """What the tool's file says: load's mass, centre (3,) m, tip (3,) m in ft_sensor; its name."""

    name: str
    mass_kg: float
    com_m: Array
    tip_m: Array


TOOLS = (
    Tool("pointer", 0.060, np.array([0.055, 0.002, 0.045]), np.array([0.150, 0.0, 0.050])),
    Tool("retractor", 0.200, np.array([0.070, -0.010, 0.055]), np.array([0.180, 0.010, 0.050])),
    Tool("probe", 0.118, np.array([0.048, 0.012, 0.062]), np.array([0.128, 0.022, 0.081])),
)
"""The contract's two and a third one."""

ADAPTER_MASS_KG = 0.100
ADAPTER_COM_M = np.array([0.0, 0.0, 0.020])


@dataclass(frozen=True)
class Clock:
    """One topic's n samples: stamps and when they were taken, s since the bag's first stamp."""

    stamp_s: Array
    taken_s: Array


@dataclass(frozen=True)
class Take:
    """One bag: how the arm moves, and when what is recorded.

    start_s: its first stamp since the recording's. end_s: since the bag's. recorded (k, 2): spans
    that are in the bag. pushes: None where nobody touches. tracker: None without.
    """

    bag: str
    start_s: float
    end_s: float
    course: Course
    recorded: Array
    joints: Clock
    wrench: Clock
    tracker: Clock | None
    pushes: Pushes | None
    places: Array
    """Poses (k, 5) that it stands at: of the sweep, or where it is pushed."""
    until_s: Array
    """When it leaves each (k,)."""


@dataclass(frozen=True)
class Session:
    """A recording as it is planned.

    wrench_std (6,): of a sample, N and N.m; rho: what a sample's noise has of the one before.
    tracker_std (2,): m, rad. base_rotation, base_position: base_link in `tracker`; marker_rotation,
    marker_position: the base marker in base_link. zero (6,): what the reading is off from the
    start. epoch_s: the first stamp.
    """

    seed: int
    tool: Tool
    takes: dict[str, Take]
    wrench_std: Array
    rho: float
    tracker_std: Array
    tracker_rho: float
    base_rotation: Array
    base_position: Array
    marker_rotation: Array
    marker_position: Array
    zero: Array
    epoch_s: int
    duration_s: float


def draw_session(seed: int, bags: tuple[str, ...] = BAGS) -> Session:
    """The session of a seed."""
    rng = np.random.default_rng([seed, 1])
    tool = TOOLS[rng.integers(len(TOOLS))]
    makers = {"sweep": _sweep, "motion": _motion, "push": _push}
    takes: dict[str, Take] = {}
    start_s = 0.0
    for bag in BAGS:
        # Every bag is drawn, so that leaving one out changes no other.
        take = makers[bag](rng, start_s, tool)
        pause_s = rng.uniform(8.0, 25.0)
        if bag in bags:
            takes[bag] = take
            start_s = start_s + take.end_s + pause_s
    coloured = rng.random() < 1.0 / 3.0
    rho = float(rng.uniform(0.2, 0.6)) if coloured else 0.0
    return Session(
        seed=seed,
        tool=tool,
        takes=takes,
        wrench_std=SENSOR.noise_std * rng.uniform(0.8, 1.2, 6),
        rho=rho,
        tracker_std=np.array([TRACKER_POSITION_NOISE_M, TRACKER_ROTATION_NOISE_RAD])
        * rng.uniform(0.8, 1.2, 2),
        tracker_rho=rho if rng.random() < 0.5 else 0.0,
        base_rotation=turned_by(rng.uniform(0.3, 2.5) * any_direction(rng)[None])[0],
        base_position=np.array([*rng.uniform(-0.5, 0.5, 2), rng.uniform(1.2, 2.2)]),
        marker_rotation=turned_by(rng.uniform(0.1, 1.5) * any_direction(rng)[None])[0],
        marker_position=rng.uniform([0.1, -0.4, 0.0], [0.5, 0.4, 0.4]),
        zero=np.array([*[0.01] * 3, *[2e-4] * 3]) * rng.standard_normal(6),
        epoch_s=int(rng.integers(1_740_000_000, 1_790_000_000)),
        duration_s=start_s - pause_s,
    )


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


def _sweep(rng: np.random.Generator, start_s: float, tool: Tool) -> Take:
    tilts = np.linspace(_TILT_LOW, _TILT_HIGH, 7)
    rolls = np.linspace(-_ROLL_REACH, _ROLL_REACH, 8)
    place = HOME[:3] + rng.uniform(-0.04, 0.04, 3) * (rng.random() < 0.5)
    kind = rng.choice(["tilt first", "roll first", "shuffled"])
    outer, inner = (tilts, rolls) if kind == "tilt first" else (rolls, tilts)
    pairs = [(a, b) for k, a in enumerate(outer) for b in (inner if k % 2 == 0 else inner[::-1])]
    angles = np.array([(b, a) for a, b in pairs] if kind == "tilt first" else pairs)
    if kind == "shuffled":
        rng.shuffle(angles)
    angles = angles + rng.uniform(-0.06, 0.06, angles.shape)
    poses = np.column_stack([np.tile(place, (len(angles), 1)), angles])
    poses = np.vstack([[*place, 0.0, 0.0], poses])
    a_pose_s = rng.uniform(1.2, 2.5)
    stay_s = a_pose_s * rng.uniform(0.55, 0.75)
    farthest = np.max(np.abs(np.diff(poses[:, 3:], axis=0)), axis=1)
    # A move of the fifth degree is fastest in its middle, at 15/8 of its mean speed.
    move_s = np.maximum(a_pose_s - stay_s, 15.0 / 8.0 * farthest / 2.6)
    stay = stay_s * rng.uniform(0.95, 1.05, len(poses))
    arrive_s = np.concatenate([[0.0], np.cumsum(stay[:-1] + move_s)])
    leave_s = arrive_s + stay
    recorded = np.array([[0.0, leave_s[-1]]])
    joints, wrench = _clocks(rng, recorded, 40.0, 120.0)
    course = Stops(poses, arrive_s, leave_s)
    return Take(
        "sweep", start_s, float(leave_s[-1]), course, recorded, joints, wrench, None, None,
        poses, leave_s,
    )  # fmt: skip


def _motion(rng: np.random.Generator, start_s: float, tool: Tool) -> Take:
    duration_s = float(rng.uniform(30.0, 60.0))
    middle = np.array([*HOME[:3], 0.0, 0.5 * (_TILT_LOW + _TILT_HIGH)])
    reach = np.array([0.09, 0.09, 0.09, 1.35, 0.85])
    fastest = np.array([_FASTEST_WAY] * 3 + [_FASTEST_TURN] * 2) * rng.uniform(0.5, 1.0, 5)
    course: Course
    if rng.random() < 0.5:
        count = int(rng.integers(3, 6))
        frequency = rng.uniform(0.05, 0.45, (count, 5))
        amplitude = reach * rng.dirichlet(np.ones(count) * 3.0, 5).T
        phase = rng.uniform(0.0, 2.0 * np.pi, (count, 5))
        course = Multisine(middle, amplitude, frequency, phase, duration_s, 2.0)
        speed = np.max(np.abs(course.at(np.arange(0.0, duration_s, 0.05)).velocity), axis=0)
        amplitude = amplitude * np.minimum(1.0, fastest / speed)
        course = Multisine(middle, amplitude, frequency, phase, duration_s, 2.0)
    else:
        knots = max(8, round(duration_s / rng.uniform(0.9, 1.8)))
        knot_s = np.linspace(0.0, duration_s, knots)
        knot_s[1:-1] += 0.2 * duration_s / knots * rng.uniform(-1.0, 1.0, knots - 2)
        at_knots = reach * rng.uniform(-0.8, 0.8, (knots, 5))
        at_knots[[0, -1]] = 0.0
        course = Spline(knot_s, middle + at_knots)
        grid = course.at(np.arange(0.0, duration_s, 0.05))
        share = np.minimum(1.0, fastest / np.max(np.abs(grid.velocity), axis=0))
        # A spline swings past its knots.
        share = np.minimum(share, reach / np.max(np.abs(grid.joints - middle), axis=0))
        course = Spline(knot_s, middle + share * at_knots)
    recorded = np.array([[0.0, duration_s]])
    joints, wrench = _clocks(rng, recorded, 100.0, 500.0)
    none = np.zeros((0, 5))
    return Take(
        "motion", start_s, duration_s, course, recorded, joints, wrench, None, None,
        none, np.zeros(0),
    )  # fmt: skip


def _push(rng: np.random.Generator, start_s: float, tool: Tool) -> Take:
    corners = np.array([[0.4, 0.25], [-0.5, 0.3], [0.55, -0.35], [-0.35, -0.4]]) + rng.uniform(
        -0.2, 0.2, (4, 2)
    )
    rng.shuffle(corners)
    xyz = HOME[:3] + rng.uniform(-0.08, 0.08, (4, 3))
    poses = np.column_stack([xyz, corners])
    if rng.random() < 0.5:
        poses[0] = [*HOME[:3], 0.0, 0.0]
    rest_s = 3.0
    gap_s = float(rng.uniform(0.12, 0.3))
    stay_s = rest_s + longest_s(gap_s) + 0.5
    arrive_s = np.arange(4.0) * (stay_s + _MOVE_BETWEEN_PUSHES_S)
    pushes = draw_pushes(rng, arrive_s + rest_s, tool.tip_m, gap_s)
    ends = np.asarray(pushes.end_s.reshape(4, -1)[:, -1] + 0.4)
    recorded = np.column_stack([arrive_s, ends])
    joints, wrench = _clocks(rng, recorded, 80.0, 250.0)
    tracker = _clock(rng, float(rng.uniform(60.0, 150.0)), recorded, rng.uniform(0.0, 5e-3))
    leave_s = arrive_s + stay_s
    return Take(
        "push", start_s, float(ends[-1]), Stops(poses, arrive_s, leave_s), recorded, joints,
        wrench, tracker, pushes, poses, leave_s,
    )  # fmt: skip


def adapter() -> Body:
    """The bias load as the file has it: a disc of 50 mm."""
    disc = ADAPTER_MASS_KG * 0.025**2 * np.diag([0.25, 0.25, 0.5])
    return Body(ADAPTER_MASS_KG, ADAPTER_COM_M, disc)


def tool_body(tool: Tool) -> Body:
    """The tool as the file has it: a rod from the mount through its centre, 15 mm thick."""
    length = 2.0 * float(np.linalg.norm(tool.com_m))
    along = tool.com_m / np.linalg.norm(tool.com_m)
    across = np.eye(3) - np.outer(along, along)
    inertia = tool.mass_kg * (length**2 / 12.0 * across + 0.0075**2 / 2.0 * np.eye(3))
    return Body(tool.mass_kg, tool.com_m, inertia)
