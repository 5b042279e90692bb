# SPDX-License-Identifier: Apache-2.0
"""Rest segments out of joint states and of a live stream: quanta, noise, jumps."""

from dataclasses import replace

import numpy as np
import pytest
from galen_model.arm.galen import ENCODER_QUANTUM, GALEN
from galen_model.rest.segments import JointRest, allowed_travel, rest_by_joints
from galen_model.rest.windows import WINDOW_S, StillWindows
from model_files import SIX_AXIS

LIFTED = replace(SIX_AXIS, joints=(GALEN.joints[2], *SIX_AXIS.joints))
NS = 1_000_000_000
START_NS = 1_700_000_000 * NS + 123_456_789


def encoded(joints):
    return np.round(joints / ENCODER_QUANTUM) * ENCODER_QUANTUM


def recording(
    rate_hz, *, moves=((1.0, 2.0), (4.0, 4.5)), duration_s=6.0, joint=3, size=0.4, arm=GALEN
):
    """Stamps (n,) and joints (n, d) that stand but for quintic moves of one joint."""
    time = np.arange(round(duration_s * rate_hz)) / rate_hz
    joints = np.tile(arm.home, (len(time), 1))
    for first, last in moves:
        x = np.clip((time - first) / (last - first), 0.0, 1.0)
        joints[:, joint] += size * x**3 * (10.0 - 15.0 * x + 6.0 * x**2)
    return START_NS + np.round(time * NS).astype(np.int64), joints


def ends(stamps, joints, settings=None, arm=GALEN):
    """First and last stamp of each rest segment."""
    return [
        (stamps[rows.start], stamps[rows.stop - 1])
        for rows in rest_by_joints(stamps, joints, settings, arm=arm)
    ]


def in_s(segments):
    return [((a - START_NS) / NS, (b - START_NS) / NS) for a, b in segments]


@pytest.mark.parametrize("rate_hz", [500.0, 50.0, 10.0])
@pytest.mark.parametrize(("joint", "size"), [(0, 0.05), (2, -0.03), (3, 0.4), (4, -0.2)])
def test_the_phases_between_moves_are_found_and_nothing_else(rate_hz, joint, size):
    stamps, joints = recording(rate_hz, joint=joint, size=size)
    phases = in_s(ends(stamps, encoded(joints)))
    assert len(phases) == 3
    for (start, end), (first, last) in zip(
        phases, ((0.0, 1.0), (2.0, 4.0), (4.5, 6.0)), strict=True
    ):
        # A quintic is slow at its ends, the slower the smaller it is: still by the limit.
        assert first - 0.16 <= start <= first + 0.16
        assert last - 0.16 <= end <= last + 0.16


def test_an_encoder_that_flickers_between_two_steps_stands_still():
    """One step of 5e-5 rad in 2 ms is 0.025 rad/s, twelve times the limit."""
    stamps, joints = recording(500.0, moves=())
    flicker = np.random.default_rng(1).integers(0, 2, joints.shape) * ENCODER_QUANTUM
    assert in_s(ends(stamps, joints + flicker)) == [(0.0, pytest.approx(6.0, abs=0.01))]


@pytest.mark.parametrize(
    ("arm", "joint"), [*((GALEN, k) for k in range(5)), (LIFTED, 0), (LIFTED, 6)]
)
def test_every_joint_alone_can_move(arm, joint):
    stamps, joints = recording(500.0, moves=(), arm=arm)
    limit = arm.by_unit(5e-4, 2e-3)[joint]
    time = (stamps - START_NS) / NS
    for speed, phases in ((0.5 * limit, 1), (3.0 * limit, 0)):
        creeping = joints.copy()
        creeping[:, joint] += speed * time
        creeping = np.round(creeping / arm.by_unit(5e-6, 5e-5)) * arm.by_unit(5e-6, 5e-5)
        assert len(ends(stamps, creeping, arm=arm)) == phases


def test_a_swing_that_comes_back_within_the_window_is_motion():
    stamps, joints = recording(500.0, moves=())
    joints[:, 4] += 2e-3 * np.sin(2.0 * np.pi * 10.0 * (stamps - START_NS) / NS)
    assert ends(stamps, joints) == []


def test_a_step_between_two_samples_parts_two_phases():
    stamps, joints = recording(500.0, moves=())
    joints[1500:, 3] += 1e-3
    assert len(ends(stamps, joints)) == 2


def test_a_short_stop_is_no_phase():
    stamps, joints = recording(500.0, moves=((1.0, 2.0), (2.3, 3.3)))
    assert len(ends(stamps, joints)) == 2
    assert len(ends(stamps, joints, JointRest(min_duration_s=0.2))) == 3


@pytest.mark.parametrize("step_s", [-100.0, -0.01, 0.6, 3600.0])
def test_a_jump_of_the_stamps_ends_a_phase_and_no_phase_runs_backward(step_s):
    stamps, joints = recording(500.0, moves=())
    stamps[1500:] += round(step_s * NS)
    rows = rest_by_joints(stamps, joints, arm=GALEN)
    assert [row.stop for row in rows] == [1500, 3000]
    assert rows[1].start == 1500
    for row in rows:
        assert np.all(np.diff(stamps[row]) >= 0)


def test_what_is_not_finite_is_no_standstill_and_a_joint_that_is_nowhere_does_not_count():
    stamps, joints = recording(500.0, moves=())
    joints[1500, 4] = np.nan
    joints[:, 0] = np.nan
    assert len(ends(stamps, joints)) == 2
    assert ends(stamps, np.full_like(joints, np.nan)) == []


def test_repeated_stamps_are_borne_and_nothing_gives_nothing():
    stamps, joints = recording(500.0, moves=())
    stamps, joints = np.repeat(stamps, 2), np.repeat(joints, 2, axis=0)
    assert len(ends(stamps, joints)) == 1
    for count in (0, 1):
        assert ends(stamps[:count], joints[:count]) == []


def test_the_phases_do_not_hang_on_where_the_recording_begins():
    stamps, joints = recording(500.0)
    joints = encoded(joints)
    later = ends(stamps[137:], joints[137:])
    assert later[1:] == ends(stamps, joints)[1:]


@pytest.mark.parametrize("seed", range(6))
def test_a_live_stream_and_a_recording_are_at_rest_at_the_same_times(seed):
    """Random rests and moves, rates and pauses of the stream, sample by sample and as arrays."""
    rng = np.random.default_rng(seed)
    rate_hz, at_s, moves = rng.uniform(60.0, 500.0), 1.0, []
    while at_s < 25.0:
        moves.append((at_s, at_s + rng.uniform(0.4, 1.5)))
        at_s = moves[-1][1] + rng.uniform(0.2, 4.0)
    stamps, joints = recording(
        rate_hz, moves=moves, duration_s=28.0, joint=3 + seed % 2, size=rng.uniform(0.1, 0.5)
    )
    kept = np.ones(len(stamps), dtype=bool)
    for first_s in rng.uniform(0.0, 28.0, 3):  # pauses
        kept &= np.abs(stamps - START_NS - first_s * NS) > 0.2 * NS
    flicker = rng.integers(0, 2, joints.shape) * ENCODER_QUANTUM
    stamps, joints = stamps[kept], (encoded(joints) + flicker)[kept]

    live = StillWindows()
    windows = [
        (window.start_ns, window.end_ns)
        for stamp, row in zip(stamps.tolist(), joints, strict=True)
        if (window := live.push(stamp, row[3:], rng.standard_normal(6)))
    ]
    # A window holds no more travel than its band to both sides, nor does a part of it.
    band = allowed_travel(1e-3, WINDOW_S, ENCODER_QUANTUM, steps=2.0)
    loose = ends(stamps, joints, JointRest(np.full(5, 2.0 * band[4] / 0.1), min_duration_s=0.3))
    margin = NS // 20
    for start, end in windows:
        assert any(a <= start + margin and end - margin <= b for a, b in loose)
    # The stream is late by a motion's rim and its slow end, and then has a window each half second.
    for start, end in ends(stamps, joints):
        inside = [one for one in windows if start <= one[0] and one[1] <= end]
        assert len(inside) >= int(((end - start) / NS - 0.7) / (WINDOW_S + 2.0 / rate_hz))
