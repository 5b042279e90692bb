"""The ring of joint angles and its interpolation."""

import math

import numpy as np
import pytest
from galen_ros.stream.samples import JointBuffer, NoJoints, Notice

MS = 1_000_000


def filled(count: int = 10, step_ns: int = 2 * MS, **options: int) -> JointBuffer:
    buffer = JointBuffer(50 * MS, **options)
    for i in range(count):
        buffer.push(i * step_ns, (0.1 * i, -0.2 * i))
    return buffer


def test_interpolates_between_the_right_samples_of_a_curve() -> None:
    buffer = JointBuffer(50 * MS)
    rng = np.random.default_rng(1)
    stamps = np.cumsum(rng.integers(MS, 20 * MS, size=200))
    rolls, tilts = rng.normal(size=200), rng.normal(size=200)
    for stamp, roll, tilt in zip(stamps, rolls, tilts, strict=True):
        buffer.push(int(stamp), (float(roll), float(tilt)))
    for stamp in rng.integers(stamps[0], stamps[-1], size=300):
        expected = np.interp(stamp, stamps, rolls), np.interp(stamp, stamps, tilts)
        assert buffer.joints_at(int(stamp)) == pytest.approx(expected, abs=1e-12)


def test_never_extrapolates() -> None:
    buffer = JointBuffer(50 * MS)
    assert buffer.joints_at(5) is NoJoints.EMPTY
    buffer.push(10 * MS, (0.0, 0.0))
    assert buffer.joints_at(10 * MS - 1) is NoJoints.TOO_OLD
    assert buffer.joints_at(10 * MS + 1) is NoJoints.NOT_YET


def test_gap_between_samples() -> None:
    buffer = JointBuffer(50 * MS)
    buffer.push(0, (0.0, 0.0))
    buffer.push(50 * MS, (1.0, 1.0))
    buffer.push(100 * MS + 1, (2.0, 2.0))
    assert buffer.joints_at(25 * MS) == (0.5, 0.5)
    assert buffer.joints_at(75 * MS) is NoJoints.GAP
    assert buffer.joints_at(100 * MS + 1) == (2.0, 2.0)


def test_backward_and_repeated_stamps_are_not_stored() -> None:
    buffer = filled(3)
    assert buffer.push(4 * MS, (9.0, 9.0)) is Notice.DUPLICATE_JOINTS
    assert buffer.push(3 * MS, (9.0, 9.0)) is Notice.OUT_OF_ORDER_JOINTS
    assert buffer.push(5 * MS, (9.0, 9.0)) is None
    assert buffer.joints_at(4 * MS) == (0.1 * 2, -0.2 * 2)
    assert len(buffer) == 4


def test_nan_marks_a_hole() -> None:
    buffer = JointBuffer(50 * MS)
    for stamp, roll in ((0, 0.0), (2 * MS, math.nan), (4 * MS, 1.0), (6 * MS, 2.0)):
        buffer.push(stamp, (roll, roll))
    for stamp in (MS, 2 * MS, 3 * MS):
        angles = buffer.joints_at(stamp)
        assert isinstance(angles, tuple) and math.isnan(angles[0]) and math.isnan(angles[1])
    assert buffer.joints_at(5 * MS) == (1.5, 1.5)


def test_is_bounded_and_keeps_the_newest() -> None:
    buffer = filled(1000, capacity=16)
    assert 16 <= len(buffer) < 32
    assert buffer.newest_ns == 999 * 2 * MS
    assert buffer.joints_at((999 - 15) * 2 * MS) == (0.1 * 984, -0.2 * 984)
    assert buffer.joints_at(0) is NoJoints.TOO_OLD
