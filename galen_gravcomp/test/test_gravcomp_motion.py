# SPDX-License-Identifier: Apache-2.0
"""Inertial forces: the differentiator, the joints' and the IMU's stage, in the compensator."""

from dataclasses import replace

import numpy as np
from galen_common.stream.samples import PairedWrench, Rejection
from galen_gravcomp.compensator import Compensator
from galen_gravcomp.corrections.inertial import LocalPolynomial
from galen_gravcomp.parameters import GravcompParameters
from galen_model.arm.galen import GALEN, SENSOR
from galen_model.arm.sensor_motion import sensor_motion
from galen_model.load.inertia import ImuMount
from galen_model.rotation import rotvec_to_matrix
from motion_tape import MS, START_NS, measured, readings, swing, tool_file

PARAMETERS = GravcompParameters(motion="joints", calibration_monitor=False)
FIRST = 13
"""Wrenches at 500 Hz before the window is full but for a gap at its start."""


def compensator(parameters=PARAMETERS, **settings):
    made = Compensator(replace(parameters, **settings), arm=GALEN)
    made.set_tool(tool_file())
    return made


def push(made, stamps, joints, wrenches, wrench_late_ns=0):
    """Joints, then the wrench of each stamp; returns all results."""
    results = []
    for stamp, q, wrench in zip(stamps, joints, wrenches, strict=True):
        results += made.push_joints(int(stamp), tuple(q))
        results += made.push_wrench(int(stamp) + wrench_late_ns, wrench)
    return results


def stamps_of(times):
    return START_NS + np.round(times * 1e9).astype(np.int64)


def compensated(results):
    """The wrenches (n, 6) that came out."""
    return np.array([r.wrench for r in results if isinstance(r, PairedWrench)])


def rms(wrenches):
    return np.sqrt(np.mean(np.square(wrenches), axis=0))


def test_a_cubic_is_differentiated_exactly_at_any_stamps():
    rng = np.random.default_rng(1)
    polynomial = LocalPolynomial(0.06, 0.02)
    at_ns = START_NS + 12_345_678
    # stamps at which rounding to the microsecond changes nothing
    stamps = at_ns + 1000 * np.sort(rng.choice(np.arange(-40_000, 20_000), 25, replace=False))
    after_s = (stamps - at_ns) * 1e-9
    values = np.stack([3.0 + 2.0 * after_s - 5.0 * after_s**2 + 70.0 * after_s**3] * 2, axis=1)
    found = polynomial.derivatives(stamps, values, at_ns)
    for derivative, expected, atol in zip(
        found, (3.0, 2.0, -10.0), (1e-12, 1e-9, 1e-7), strict=True
    ):
        np.testing.assert_allclose(derivative, expected, atol=atol)


def test_noise_and_bias_are_what_the_docstring_says():
    window_s, rate_hz = 0.1, 1000.0
    polynomial = LocalPolynomial(window_s, window_s / 2)
    count = round(window_s * rate_hz)
    expected = [np.sqrt(75 / count) / window_s, np.sqrt(720 / count) / window_s**2]
    after_ns = np.arange(-50, 51) * MS
    found = np.sqrt(np.sum(polynomial.weights(after_ns) ** 2, axis=1))
    np.testing.assert_allclose(found[1:], expected, rtol=0.04)
    quartic = (after_ns * 1e-9) ** 4 / 24.0
    second = polynomial.derivatives(after_ns, quartic[:, None], 0)[2][0]
    np.testing.assert_allclose(second, window_s**2 / 56, rtol=0.05)


def test_free_motion_at_the_arms_limits_leaves_the_sensors_noise():
    times = np.arange(0.0, 4.0, 0.002)  # an rms of 2000 readings is known to 2 %
    joints, wrenches = measured(swing(times), np.random.default_rng(2))
    stamps = stamps_of(times)
    out = compensated(push(compensator(), stamps, joints, wrenches))
    assert len(out) == len(times) - FIRST - 10  # what still waits at the end
    assert np.all(rms(out) < 1.1 * SENSOR.noise_std)
    static = compensated(push(compensator(motion="off"), stamps, joints, wrenches))
    assert np.all(rms(static) > 5.0 * SENSOR.noise_std)


def test_without_an_inertia_the_points_at_the_centres_stand_in_and_it_is_said():
    times = np.arange(0.0, 2.0, 0.002)
    motion = swing(times)
    stamps = stamps_of(times)
    worst = {}
    for known in (True, False):
        made = compensator()
        made.set_tool(tool_file(with_inertia=known))
        out = compensated(push(made, stamps, motion[0], readings(motion)))
        worst[known] = np.abs(out).max(axis=0)
        said = made.motion.values()["motion_inertia"]
        assert said == ("the tool's file" if known else "of two points at the centres")
    # what is lacking is the loads' own inertia about their centres: 3e-4 to 5e-4 kg m^2
    assert 1e-3 < worst[False][3:].max() < 5e-4 * 6.0 * 2.0 * 1.5
    np.testing.assert_allclose(worst[False][:3], worst[True][:3], atol=1e-12)


def test_a_wrench_waits_for_the_delay_and_not_longer():
    made = compensator()
    stamps = START_NS + np.arange(60) * 2 * MS
    joints = np.tile([0.0, 0.0, 0.4, 0.1, 0.2], (60, 1))
    out_at = {}
    for stamp, q in zip(stamps, joints, strict=True):
        for result in made.push_joints(int(stamp), tuple(q)):
            out_at[result.stamp_ns] = int(stamp) - result.stamp_ns
        made.push_wrench(int(stamp), np.zeros(6))
    assert set(out_at.values()) == {20 * MS}
    assert made.pairing.waiting == 10


def test_the_lag_between_wrench_and_joints_is_taken_into_account():
    times = np.arange(0.0, 1.5, 0.002)
    motion = swing(times)
    stamps = stamps_of(times)
    left = {}
    for lag_s in (0.0, 0.004):
        whole = readings(motion)  # weight and inertial forces are late alike
        late = np.vstack([whole[:2], whole[:-2]])
        results = push(compensator(motion_lag_s=lag_s), stamps, motion[0], late)
        left[lag_s] = rms(compensated(results))
    assert np.all(left[0.004] < 0.3 * left[0.0])
    assert np.all(left[0.004] < SENSOR.noise_std)


def rejections(results):
    return [r.detail for r in results if not isinstance(r, PairedWrench)]


def test_gaps_bad_values_and_lacking_positions_are_rejected_with_their_own_reason():
    stamps = START_NS + np.arange(100) * 2 * MS
    q = (0.0, 0.0, 0.4, 0.1, 0.2)
    zeros = np.zeros(6)

    def run(joint_at):
        made = compensator()
        results = []
        for number, stamp in enumerate(stamps.tolist()):
            for sample in joint_at(number):
                results += made.push_joints(stamp, sample)
            results += made.push_wrench(stamp, zeros)
        assert set(made.pairing.rejections) == {Rejection.NO_MOTION}
        assert len(results) + made.pairing.waiting == len(stamps)
        return rejections(results)

    gap = run(lambda number: [] if 50 <= number < 60 else [q])
    # Stamps whose window ends more than half the delay after 98 ms, to those where it starts there.
    assert len(gap) == FIRST + 28 and "a gap of 22 ms in joint_states" in "".join(gap)
    bad = run(lambda number: [(np.nan, *q[1:])] if number == 50 else [q])
    assert len(bad) == FIRST + 31 and "not finite" in bad[-1]
    few = run(lambda number: [q] if number % 5 == 0 else [])
    assert "samples of joint_states; 8 are needed (a longer motion_window_s" in few[-1]
    none = run(lambda number: [(np.nan,) * 3 + q[3:]])
    assert none[-1].endswith("joint_states lacks delta_x, delta_y, delta_z")
    for wild in (0.01, 1e200, np.inf):  # 1 cm, or anything, in one sample
        wrong = run(lambda number, wild=wild: [(wild, *q[1:])] if number == 50 else [q])
        assert len(wrong) in (FIRST + 31, FIRST + 32) and "or jumps" in wrong[-1], wild


def test_inertial_forces_beyond_the_sensors_range_are_rejected():
    made = compensator(MOUNTED)
    for k in range(60):
        stamp = START_NS + k * 2 * MS
        made.push_imu(stamp, (0.0, 0.0, 1e6 if k == 30 else 0.0), (0.0, 0.0, 9.8))
        made.push_joints(stamp, (0.1, 0.2))
    results = [made.push_wrench(START_NS + k * 2 * MS, np.zeros(6))[0] for k in (25, 30)]
    assert [r.reason for r in results] == [Rejection.NO_MOTION] * 2
    assert all("beyond the sensor's range" in r.detail for r in results)


MOUNT = ImuMount(
    rotvec_rad=np.array([0.4, -1.0, 0.7]),
    lever_m=np.array([0.02, -0.03, 0.01]),
    bias_m_s2=np.array([0.1, -0.2, 0.05]),
    scale=1.01,
)
MOUNTED = replace(
    PARAMETERS,
    motion="imu",
    imu_rotvec_rad=tuple(MOUNT.rotvec_rad),
    imu_lever_m=tuple(MOUNT.lever_m),
    imu_bias_m_s2=tuple(MOUNT.bias_m_s2),
    imu_scale=MOUNT.scale,
)


def imu_readings(motion):
    """What an IMU mounted so reads: angular velocity, specific force, (n, 3) each."""
    w, al, a = sensor_motion(*motion, arm=GALEN)
    there = a + np.cross(al, MOUNT.lever_m) + np.cross(w, np.cross(w, MOUNT.lever_m))
    felt = there - GALEN.gravity_in_sensor(motion[0][:, 3:])
    back = rotvec_to_matrix(MOUNT.rotvec_rad)
    return w @ back, MOUNT.scale * felt @ back + MOUNT.bias_m_s2


def test_an_imu_tells_the_inertial_forces_in_its_own_axes_and_at_its_own_stamps():
    times = np.arange(0.0, 1.0, 0.002)
    motion = swing(times)
    stamps = stamps_of(times)
    # the IMU's stamps are 5 ms late
    imu_times = np.arange(0.0, 1.0, 0.003)
    angular, linear = imu_readings(swing(imu_times))
    imu_stamps = stamps_of(imu_times) + 5 * MS
    made = compensator(MOUNTED, motion_window_s=0.04, motion_lag_s=-0.005)
    wrenches = readings(motion)
    both = (stamps, imu_stamps)
    events = [(stamp, kind, k) for kind in (0, 1) for k, stamp in enumerate(both[kind])]
    results, waited = [], []
    for stamp, kind, k in sorted(events):
        if kind:
            results += made.push_imu(int(stamp), tuple(angular[k]), tuple(linear[k]))
        else:
            new = made.push_joints(int(stamp), tuple(motion[0][k, 3:]))
            results += new + made.push_wrench(int(stamp), wrenches[k])
        waited.append(made.pairing.waiting)
    out = compensated(results)
    assert len(out) > 450 and max(waited) < 16
    # What the polynomial's bias leaves, far below the noise.
    assert np.all(np.abs(out).max(axis=0) < 0.1 * SENSOR.noise_std)


def test_an_imu_that_is_silent_or_broken_off_is_rejected():
    made = compensator(MOUNTED)
    silent = push(made, START_NS + np.arange(100) * 2 * MS, np.zeros((100, 5)), np.zeros((100, 6)))
    assert rejections(silent) and "the IMU has sent nothing (topic imu)" in rejections(silent)[0]
    for k in range(100, 160):
        made.push_imu(int(START_NS + k * 2 * MS), (0.0,) * 3, (0.0, 0.0, 9.8))
    late = push(
        made, START_NS + np.arange(100, 260) * 2 * MS, np.zeros((160, 5)), np.zeros((160, 6))
    )
    assert set(made.pairing.rejections) == {Rejection.NO_MOTION}
    assert "ms behind the wrench (topic imu)" in rejections(late)[-1]
    assert sum(isinstance(r, PairedWrench) for r in late) == 60 - FIRST - 10
