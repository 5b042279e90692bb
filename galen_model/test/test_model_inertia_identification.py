# SPDX-License-Identifier: Apache-2.0
"""Inertia from recordings of motion: known ones found, to the noise's limit, or rejected."""

from dataclasses import replace

import numpy as np
import pytest
from galen_model.arm.galen import ENCODER_QUANTUM, GALEN, SENSOR
from galen_model.arm.sensor_motion import sensor_motion
from galen_model.calibrated.inertia_identification import (
    identify_inertia,
    motion_record,
    total_moments,
)
from galen_model.errors import IdentificationError, NotExcitedError
from galen_model.load.inertia import inertial_regressor, inertial_wrench, point_mass_inertia
from galen_model.load.model import Load, LoadEstimate
from model_files import SIX_AXIS, calibration

TOOL, ADAPTER = Load(0.2, np.array([0.07, -0.01, 0.055])), Load(0.1, np.array([0, 0, 0.02]))
INERTIA = point_mass_inertia(TOOL, ADAPTER) + np.array([3e-4, 5e-4, 4e-4, 2e-5, -4e-5, 1e-5])
MOMENTS = TOOL.moments + ADAPTER.moments
KNOWN = np.diag([3e-5, 5e-6, 5e-6, 5e-6]) ** 2
RATES = np.array([3.1, 4.0, 3.6, 2.9, 3.7])
SIZE = np.array([0.04, 0.04, 0.04, 0.45, 0.35])
NS = 1e9


def motion(times, size=SIZE, arm=GALEN):
    """Swings that never repeat within a recording."""
    rates = RATES if arm is GALEN else np.linspace(2.6, 4.1, len(arm.joints))
    angle = np.outer(times, rates) + 0.5 * np.sin(0.37 * times)[:, None]
    rate = rates + 0.5 * 0.37 * np.cos(0.37 * times)[:, None]
    rate_rate = -0.5 * 0.37**2 * np.sin(0.37 * times)[:, None]
    return (
        arm.home + size * np.sin(angle),
        size * rate * np.cos(angle),
        size * (rate_rate * np.cos(angle) - rate**2 * np.sin(angle)),
    )


def recording(
    seed, duration_s=20.0, rate_hz=250.0, size=SIZE, late_s=0.0, moments=MOMENTS, arm=GALEN
):
    """Stamps, joints by the encoders, wrenches with noise and an offset."""
    rng = np.random.default_rng(seed)
    times = np.arange(0.0, duration_s, 1.0 / rate_hz)
    q, _, _ = motion(times, size, arm)
    felt, v, a = motion(times - late_s, size, arm)  # a late wrench is late with its weight as well
    moving = sensor_motion(felt, v, a, arm)
    specific = arm.gravity_in_sensor(arm.angles(felt)) - moving[2]
    wrench = inertial_wrench(specific, moving[0], moving[1], moments, INERTIA)
    wrench += np.array([0.4, 0.0, -0.2, 0.001, 0.02, -0.01])
    wrench += SENSOR.noise_std * rng.standard_normal(wrench.shape)
    stamps = np.round(times * NS).astype(np.int64) + 1_700_000_000_000_000_000
    quantum = ENCODER_QUANTUM if arm is GALEN else 5e-5
    return stamps, np.round(q / quantum) * quantum, stamps, wrench


def identify(seed=0, arm=GALEN, **changes):
    record = motion_record(*recording(seed, arm=arm, **changes), arm=arm)
    return identify_inertia(record, MOMENTS, KNOWN)


def cramer_rao_std(rate_hz=250.0, duration_s=20.0):
    """The least that white noise allows: offset, lag unknown, (m, h) known as by the file."""
    times = np.arange(0.0, duration_s, 1.0 / rate_hz)
    q, v, a = motion(times)
    moving = sensor_motion(q, v, a, arm=GALEN)
    gravity = GALEN.gravity_in_sensor(q[:, 3:])
    design = np.zeros((len(q), 6, 17))
    design[..., :10] = inertial_regressor(gravity - moving[2], moving[0], moving[1])
    design[..., 10:16] = np.eye(6)
    forces = inertial_wrench(gravity - moving[2], moving[0], moving[1], MOMENTS, INERTIA)
    design[..., 16] = -np.gradient(forces, times, axis=0)
    rows = (design / SENSOR.noise_std[None, :, None]).reshape(-1, 17)
    information = rows.T @ rows
    information[:4, :4] += np.linalg.inv(KNOWN)
    return np.sqrt(np.diag(np.linalg.inv(information))[4:10])


@pytest.mark.slow
def test_the_inertia_is_found_to_the_noises_limit_and_its_covariance_is_honest():
    fits = [identify(seed) for seed in range(16)]
    errors = np.array([fit.inertia.about_sensor_kg_m2 for fit in fits]) - INERTIA
    z = errors / [fit.inertia.std_kg_m2 for fit in fits]
    # 96 values of 95 % intervals, and the scatter beside the bound's
    assert np.mean(np.abs(z) < 1.96) > 0.88 and 0.6 < np.sqrt(np.mean(z**2)) < 1.25
    scatter = np.sqrt(np.mean(errors**2, axis=0)) / cramer_rao_std()
    assert np.all(scatter < 1.4), scatter
    assert sum(fit.disagrees for fit in fits) <= 1
    assert np.mean([abs(fit.lag_s) < 3.0 * fit.lag_std_s for fit in fits]) > 0.9


WALL = replace(SIX_AXIS, gravity_m_s2=np.array([0.0, 9.80665, 0.0]))


@pytest.mark.parametrize(("arm", "size"), [(GALEN, SIZE), (WALL, np.full(6, 0.3))])
def test_one_recording_tells_inertia_lag_and_offset(arm, size):
    fit = identify(1, arm, late_s=0.003, size=size)
    error = fit.inertia.about_sensor_kg_m2 - INERTIA
    assert np.all(np.abs(error) < 4.0 * fit.inertia.std_kg_m2)
    assert fit.inertia.std_kg_m2.max() < 0.01 * INERTIA.max()
    assert (
        fit.lag_s == pytest.approx(0.003, abs=4.0 * fit.lag_std_s + 3e-5) and fit.lag_std_s < 5e-5
    )
    np.testing.assert_allclose(fit.offset[:3], [0.4, 0.0, -0.2], atol=0.01)
    assert not fit.disagrees and fit.touched == 0


@pytest.mark.parametrize(
    ("size", "missing", "told"),
    [
        ([0.04, 0.04, 0.04, 0.0, 0.35], ("xx", "zz", "xz"), ("yy",)),
        ([0.04, 0.04, 0.04, 0.45, 0.0], ("yy",), ("zz",)),
        ([0.0] * 5, ("xx", "yy", "zz"), ()),
    ],
)
def test_what_the_motion_does_not_tell_is_rejected_and_named(size, missing, told):
    with pytest.raises(NotExcitedError, match="does not tell the inertia's") as error:
        identify(size=np.array(size))
    names = str(error.value).split("'s ")[1].split(":")[0].split(", ")
    assert set(missing) <= set(names) and not set(told) & set(names)


def test_another_load_than_the_files_is_noticed():
    heavier = (TOOL.moments + ADAPTER.moments) * np.array([1.05, 1.0, 1.0, 1.0])
    assert identify(moments=heavier).disagrees
    with pytest.raises(IdentificationError, match=r"of 19\d\.\d g, the file of 300\.0 g"):
        identify(moments=MOMENTS * np.array([0.65, 0.6, 0.6, 0.6]))


def test_readings_that_hold_the_weight_alone_are_rejected():
    stamps, joints, same, wrench = recording(8)
    q, v, a = motion((stamps - stamps[0]) / NS)
    moving = sensor_motion(q, v, a, arm=GALEN)
    wrench -= inertial_wrench(-moving[2], moving[0], moving[1], MOMENTS, INERTIA)
    with pytest.raises(IdentificationError, match="weight alone"):
        identify_inertia(motion_record(stamps, joints, same, wrench, arm=GALEN), MOMENTS, KNOWN)


def test_touched_blocks_are_left_out_and_a_recording_touched_all_over_is_rejected():
    stamps, joints, same, wrench = recording(5)
    wrench[1000:1250, 2] += 5.0
    fit = identify_inertia(motion_record(stamps, joints, same, wrench, arm=GALEN), MOMENTS, KNOWN)
    assert 2 <= fit.touched <= 4
    error = fit.inertia.about_sensor_kg_m2 - INERTIA
    assert np.all(np.abs(error) < 4.0 * fit.inertia.std_kg_m2)


def test_a_short_recording_and_one_in_pieces_are_rejected():
    with pytest.raises(IdentificationError, match="too short"):
        identify(duration_s=8.0)
    stamps, joints, same, wrench = recording(6)
    gappy = np.arange(len(stamps)) % 250 > 25
    with pytest.raises(IdentificationError, match="without a gap"):
        motion_record(stamps[gappy], joints[gappy], same, wrench, arm=GALEN)


def test_an_endless_joint_that_is_reported_within_one_turn_moves_all_the_same():
    stamps, joints, same, wrench = recording(7, duration_s=5.0)
    joints[:, 3:] += np.pi - GALEN.home_angles
    folded = np.where(joints > np.pi, joints - 2.0 * np.pi, joints)
    assert np.ptp(folded) > 6.0
    whole, found = (motion_record(stamps, q, same, wrench, arm=GALEN) for q in (joints, folded))
    np.testing.assert_allclose(found.acceleration_rad_s2, whole.acceleration_rad_s2, atol=1e-6)


def test_the_files_moments_are_the_sum_of_both_loads_with_their_covariances():
    covariance = np.diag([1e-4, 1e-5, 2e-5, 3e-5]) ** 2
    tool = calibration(
        load=LoadEstimate(TOOL.mass_kg, TOOL.com_m, covariance),
        adapter=LoadEstimate(ADAPTER.mass_kg, ADAPTER.com_m, covariance),
    )
    moments, spread = total_moments(tool)
    np.testing.assert_allclose(moments, MOMENTS)
    rng = np.random.default_rng(7)
    drawn = np.zeros((20000, 4))
    for load in (TOOL, ADAPTER):
        sample = rng.multivariate_normal(np.r_[load.mass_kg, load.com_m], covariance, 20000)
        drawn += np.column_stack([sample[:, 0], sample[:, :1] * sample[:, 1:]])
    np.testing.assert_allclose(np.sqrt(np.diag(spread)), drawn.std(axis=0), rtol=0.03)
