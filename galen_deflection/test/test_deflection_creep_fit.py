"""joint_hysteresis with creep: on creep of another law than its elements', and on none."""

import json
from dataclasses import replace

import numpy as np
import pytest
from deflection_synthetic import NOISE, TIP_M, Arm, recording, without_noise
from galen_deflection.errors import ModelFileError
from galen_deflection.models.creep_basis import CreepBasis
from galen_deflection.models.file import read_model, write_model
from galen_deflection.models.fit_settings import FitSettings
from galen_deflection.models.joint_hysteresis import NO_CREEP, fit
from galen_deflection.models.linear import segments
from galen_deflection.springs.springs import Springs, TipWrench, kinds

CREEP = FitSettings(creep=True)
SHARE, T0_S = 0.25, 0.2


def crept(samples):
    """Of roll, tilt and carriages: J(t) = share c log(1 + t / t0), by superposition.

    No sum of a few exponentials is that; it goes on at all time scales.
    """
    late = np.zeros((len(samples), 6))
    at_tip = TipWrench(TIP_M)(samples.joints, samples.wrench)
    for part in segments(samples):
        jacobian = Springs(TIP_M).jacobian(samples.joints[part])
        loads = np.einsum("nis,ni->ns", jacobian, at_tip[part])
        time_s = (samples.stamp_ns[part] - samples.stamp_ns[part.start]) * 1e-9
        since = np.maximum(time_s[:, None] - time_s[None, :], 0.0)
        grown = np.log1p(since / T0_S) @ np.diff(loads, axis=0, prepend=0.0)
        for kind in kinds()[:3]:
            given = SHARE * kind.compliance * grown[:, kind.springs]
            late[part] += np.einsum("nis,ns->ni", jacobian[:, :, kind.springs], given)
    return late


@pytest.fixture(scope="module")
def creeping():
    samples = recording(seed=3, rate_hz=12.0)
    return replace(samples, deflection=samples.deflection + crept(samples))


@pytest.fixture(scope="module")
def truth(creeping):
    clean = without_noise(creeping, Arm())
    return clean.deflection + crept(creeping)


@pytest.fixture(scope="module")
def model(creeping):
    return fit(creeping.rows(creeping.position < 3), CREEP)


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


def test_creep_is_found_and_an_unseen_position_comes_out_better(creeping, truth, model):
    assert isinstance(model.basis, CreepBasis)
    assert {lag.place for lag in model.basis.lags} >= {"tilt", "carriage"}
    there = creeping.position == 3
    without = fit(creeping.rows(~there)).predict(creeping.rows(there)).mean
    with_creep = model.predict(creeping.rows(there)).mean
    assert rms((with_creep - truth[there]) / NOISE) < 0.12
    assert rms((without - truth[there]) / NOISE) > 0.25


def test_a_stream_remembers_as_a_recording_does(creeping, model):
    some = creeping.rows(creeping.position == 2).rows(slice(30, 160))
    whole = model.predict(some)
    stream = model.stream()
    for k in range(len(some)):
        one = stream.step(int(some.stamp_ns[k]), some.joints[k], some.wrench[k])
        np.testing.assert_allclose(one.mean, whole.mean[k], rtol=0, atol=1e-14)
        np.testing.assert_allclose(one.covariance, whole.covariance[k], rtol=1e-9, atol=1e-18)


def test_a_start_under_load_is_less_certain(creeping, model):
    """The longer ago, the less."""
    there = np.flatnonzero(creeping.position == 2)
    at_tip = TipWrench(TIP_M)(creeping.joints[there], creeping.wrench[there])
    held = there[np.argmax(np.abs(at_tip[:, 1]))]
    stream = model.stream()
    joints, wrench = creeping.joints[held], creeping.wrench[held]
    steps = [stream.step(k * 10**8, joints, wrench) for k in range(400)]
    unknown = np.array([step.start[1, 1] for step in steps])
    assert np.all(np.diff(unknown) < 0.0)
    assert unknown[-1] < 0.1 * unknown[0] < 0.1 * steps[0].covariance[1, 1]


def test_its_file_gives_it_again_and_a_bad_one_is_rejected(creeping, model, tmp_path):
    path = tmp_path / "creep.json"
    write_model(path, model)
    some = creeping.rows(creeping.position == 1)
    np.testing.assert_array_equal(read_model(path).predict(some).mean, model.predict(some).mean)
    content = model.to_json()
    for lag, words in (
        ({"place": "elbow", "time_constant_s": 1.0}, "elbow"),
        ({"place": "roll", "time_constant_s": 0.0}, "not above zero"),
    ):
        bad = replace(model)
        spoiled = {**content, "lags": [lag, *content["lags"][1:]]}
        object.__setattr__(bad, "to_json", lambda spoiled=spoiled: json.loads(json.dumps(spoiled)))
        with pytest.raises(ModelFileError, match=words):
            write_model(path, bad)


def test_where_nothing_creeps_it_is_left_out():
    samples = recording(seed=4, rate_hz=12.0)
    found = fit(samples, CREEP)
    assert NO_CREEP in found.notes
    np.testing.assert_array_equal(found.values, fit(samples).values)
