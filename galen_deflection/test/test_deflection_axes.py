# SPDX-License-Identifier: Apache-2.0
"""The report's two models: what they recover, what they can't, live and in files."""

from dataclasses import replace

import numpy as np
import pytest
import test_deflection_any_arm as six_axis
from deflection_synthetic import NOISE, POSITIONS, TIP_M, in_sensor, recording
from galen_deflection.measurement.samples import DeflectionError
from galen_deflection.models.file import KINDS, read_model, write_model
from galen_deflection.models.springs import tip_wrench
from galen_deflection.scoring.cross_check import SPLITS, cross_check
from galen_model.arm.galen import GALEN

OWN = np.array([1e-5, 2e-5, 3e-5, 1e-4, 2e-4, 3e-4])
"""m/N and rad/(N.m), of each axis for itself."""


@pytest.fixture(scope="module")
def coarse():
    return recording(rate_hz=10.0)


def of_axes(seed):
    """Pushes on an arm that is a spring for each axis of the tip, everywhere the same."""
    samples = recording(rate_hz=5.0)
    noise = NOISE * np.random.default_rng(seed).normal(size=(len(samples), 6))
    return replace(samples, deflection=tip_wrench(samples) * OWN + noise)


def of_six_axes(seed):
    return six_axis.pushes(seed, positions=six_axis.POSITIONS[1:2])[0]


STIFFNESS = dict(zip(six_axis.ARM.joint_names, six_axis.STIFFNESS, strict=True))
SIX_AXIS = six_axis.ARM.with_stiffness(STIFFNESS)


@pytest.mark.parametrize(
    ("kind", "simulated", "true"),
    [
        ("independent", of_axes, OWN),
        (
            "coupled",
            lambda seed: recording(seed=seed, positions=POSITIONS[1:2], rate_hz=10.0),
            GALEN.tip_compliance(POSITIONS[1], TIP_M).ravel(),
        ),
        (
            "coupled",
            of_six_axes,
            SIX_AXIS.tip_compliance(six_axis.POSITIONS[1], six_axis.TIP_M).ravel(),
        ),
    ],
    ids=["independent", "coupled", "coupled, six-axis arm"],
)
def test_compliances_come_back_within_the_cramer_rao_bound(kind, simulated, true):
    """At one position an arm is such a matrix."""
    errors, seeds = [], 12
    for seed in range(seeds):
        samples = simulated(seed)
        model = KINDS[kind].fit(samples, None)
        assert model.unresolved == ()
        errors.append((model.values - true) / model.std)
    wrench = tip_wrench(samples)
    if kind == "independent":
        bound = NOISE / np.sqrt(np.sum(wrench**2, axis=0))
    else:
        bound = np.outer(NOISE, np.sqrt(np.diag(np.linalg.inv(wrench.T @ wrench)))).ravel()
    parameters = [p.name for p in model.basis.parameters]
    assert (parameters[0], parameters[-1], len(parameters)) == ("x/fx", "rz/tz", len(true))
    assert np.all(model.std > 0.999 * bound) and np.all(model.std < 1.4 * bound)
    mean_square = np.mean(np.square(errors))
    spread = np.sqrt(2.0 / (seeds * len(true)))
    assert 1.0 / 1.3**2 - 4.0 * spread < mean_square < 1.0 + 4.0 * spread


def test_what_the_report_found():
    """Coupled axes are enough at one position; no constant compliance is at another."""
    samples = recording(seed=4, rate_hz=10.0)
    one = samples.rows(samples.position == 1)

    def ratio(kind, some):
        split = "push" if some is one else "position"
        return cross_check(kind, some, SPLITS[split](some)).score

    here = {kind: ratio(kind, one).ratio_of() for kind in ("independent", "coupled")}
    assert here["coupled"] < 1.05 and here["independent"] > 1.4
    for kind in ("independent", "coupled"):
        elsewhere = ratio(kind, samples)
        assert elsewhere.ratio_of() > 1.4
        assert elsewhere.extrapolated == 1.0
    assert ratio("joint_stiffness", samples).ratio_of() < 1.05


def test_an_axis_that_was_never_pushed_is_named_and_predicted_as_unknown():
    samples = recording(positions=POSITIONS[:1], axes=[0, 1, 2])
    model = KINDS["independent"].fit(samples, None)
    assert model.unresolved == ("rx/tx", "ry/ty", "rz/tz")
    load = np.tile(0.5 * np.eye(6)[3], (len(samples), 1))
    predicted = model.predict(replace(samples, wrench=in_sensor(samples.joints, load)))
    assert predicted.extrapolated.all()
    nominal = 0.5 * GALEN.tip_compliance(GALEN.home, TIP_M)[3, 3]
    assert np.sqrt(predicted.covariance[0, 3, 3]) > 0.9 * nominal
    assert len(KINDS["coupled"].fit(samples, None).unresolved) == 18


@pytest.mark.parametrize("kind", ["independent", "coupled"])
def test_it_holds_near_fitted_positions_only_and_is_called_a_baseline(kind, coarse):
    model = KINDS[kind].fit(coarse, None)
    assert "baseline" in KINDS[kind].summary and "baseline" in model.notes[0]
    assert not model.predict(coarse).extrapolated.any()
    between = replace(coarse, joints=np.tile(POSITIONS.mean(axis=0), (len(coarse), 1)))
    assert model.predict(between).extrapolated.all()


def test_elements_below_zero_are_kept_in_a_file_and_one_of_another_kind_is_rejected(
    coarse, tmp_path
):
    path = tmp_path / "model.json"
    coupled = KINDS["coupled"].fit(coarse, None)
    assert coupled.values.min() < 0.0
    write_model(path, coupled)
    np.testing.assert_array_equal(read_model(path, arm=GALEN).values, coupled.values)
    with pytest.raises(DeflectionError, match="parameters has 36 entries; expected 6"):
        write_model(path, replace(coupled, name="independent"))
    np.testing.assert_array_equal(read_model(path, arm=GALEN).values, coupled.values)
