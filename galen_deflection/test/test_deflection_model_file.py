# SPDX-License-Identifier: Apache-2.0
"""Model files: what is written is read; what was changed, cut or mixed is rejected by its name."""

import hashlib
import json
import os
from dataclasses import replace

import numpy as np
import pytest
from deflection_synthetic import Arm, recording
from galen_deflection.measurement.samples import DeflectionError
from galen_deflection.models.file import KINDS, read_model, write_model
from galen_deflection.models.interface import FittedRange, fitted_on
from galen_deflection.models.network import NetworkModel, RecurrentNet, Scaling, weight_shapes
from galen_model.arm.galen import GALEN
from galen_model.errors import CalibrationFileError
from galen_model.files.calibration_file import read_calibration, write_calibration
from push_bag import TOOL

LINEAR = ["joint_stiffness", "joint_hysteresis", "independent", "coupled"]


@pytest.fixture(scope="module")
def samples():
    return recording(Arm(friction=(0.3, 0.3, 4.0)), rate_hz=10.0)


@pytest.fixture(scope="module")
def models(samples):
    return {kind: KINDS[kind].fit(samples, None) for kind in LINEAR} | {"lstm": network(samples)}


def network(samples, hidden=4):
    """Of random weights."""
    rng = np.random.default_rng(1)
    shapes = weight_shapes(11, hidden, 6)
    weights = {name: rng.normal(size=shape) for name, shape in shapes.items()}
    inputs = Scaling(rng.normal(size=11), rng.uniform(0.1, 1.0, 11))
    noise = samples.noise
    outputs = Scaling(rng.normal(size=6) * noise, noise)
    return NetworkModel(
        tip_m=samples.tip_m,
        net=RecurrentNet(weights, inputs, outputs),
        period_s=0.04,
        discrepancy=np.diag(noise**2 / 3.0),
        noise=noise,
        fitted_range=FittedRange.of(samples.joints, samples.wrench, True, GALEN),
        fitted_on=fitted_on(samples),
        iterations=12,
        held_out_error=1.5,
        arm=GALEN,
    )


@pytest.fixture
def path(tmp_path, models):
    path = tmp_path / "arm.json"
    write_model(path, models["joint_hysteresis"])
    return path


def signed(content):
    """The content with a checksum that is right for it."""
    rest = {name: value for name, value in content.items() if name != "sha256"}
    canonical = json.dumps(rest, sort_keys=True, separators=(",", ":"))
    return {**rest, "sha256": hashlib.sha256(canonical.encode()).hexdigest()}


@pytest.mark.parametrize("kind", [*LINEAR, "lstm"])
def test_a_model_that_was_read_predicts_the_same_to_the_last_bit(kind, models, samples, tmp_path):
    path = tmp_path / "deeper" / f"{kind}.json"
    write_model(path, models[kind])
    read = read_model(path, arm=GALEN)
    assert read.name == kind
    assert read.to_json() == models[kind].to_json()
    ours, theirs = models[kind].predict(samples), read.predict(samples)
    np.testing.assert_array_equal(theirs.mean, ours.mean)
    np.testing.assert_array_equal(theirs.covariance, ours.covariance)
    np.testing.assert_array_equal(theirs.extrapolated, ours.extrapolated)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda c: c.update(schema_version=2), "schema_version is 2; this version reads 1"),
        (lambda c: c.update(kind="spline"), 'kind is "spline"; this version knows joint_stiffness'),
        (lambda c: c.pop("kind"), "kind is missing"),
        (lambda c: c.pop("tip_m"), "tip_m is missing"),
        (lambda c: c.update(tip_m=[0.1, 0.2]), "tip_m has shape"),
        (lambda c: c.update(noise=[0.0] * 6), "noise holds a value that isn't positive"),
        (lambda c: c["parameters"].pop(), "parameters has .* entries; expected"),
        (lambda c: c["parameters"][1].update(name="1/k_x"), r"parameters\[1\].name is \"1/k_x\""),
        (lambda c: c["parameters"][0].update(unit="m"), r"parameters\[0\].unit is \"m\""),
        (lambda c: c["parameters"][0].update(value="1"), r"parameters\[0\].value is '1'"),
        (lambda c: c["parameters"][0].update(value=-1e-4), r"parameters\[0\].value is -0.0001"),
        (lambda c: c["covariance"][0].__setitem__(0, -1e-9), "covariance has a negative variance"),
        (lambda c: c["covariance"][0].__setitem__(1, 1e-9), "covariance is not symmetric"),
        (lambda c: c["discrepancy"].pop(), "discrepancy has shape"),
        (lambda c: c["operators"][0].update(place="elbow"), r'operators\[0\].place is "elbow"'),
        (lambda c: c["operators"][0].update(shape="dahl"), r'operators\[0\].shape is "dahl"'),
        (lambda c: c["operators"][0].update(thresholds=[-1.0]), r"operators\[0\].thresholds holds"),
        (lambda c: c["fitted_on"].update(samples=1.5), "fitted_on.samples is 1.5"),
        (lambda c: c["fitted_range"].pop("joints_low"), "joints_low is missing"),
        (
            lambda c: c["fitted_range"].update(joints_low=[9.0] * 5),
            "joints_low is above fitted_range.joints_high",
        ),
        (lambda c: c.update(notes="x"), "notes is not a list"),
    ],
)
def test_a_wrong_field_is_named_with_the_file(path, change, said):
    rejects_changed(path, change, said)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda c: c["network"].update(hidden=5), r"network.weights.w_in has shape \(16, 11\)"),
        (lambda c: c["network"].update(hidden=10**9), "network.hidden is 1000000000; expected"),
        (lambda c: c.update(period_s=0.0), "period_s is 0; expected"),
        (lambda c: c["network"]["input_scaling"].update(scale=[0.0] * 11), "isn't positive"),
        (lambda c: c["network"].pop("output_scaling"), "output_scaling is missing"),
        (lambda c: c["network"]["weights"].pop("w_out"), "w_out is missing"),
        (lambda c: c["network"]["weights"]["bias"].pop(), "network.weights.bias has shape"),
        (lambda c: c["discrepancy"][0].__setitem__(0, -1.0), "discrepancy has a negative"),
        (lambda c: c.pop("iterations"), "iterations is missing"),
    ],
)
def test_a_wrong_field_of_a_network_is_named(tmp_path, models, change, said):
    path = tmp_path / "lstm.json"
    write_model(path, models["lstm"])
    rejects_changed(path, change, said)


def rejects_changed(path, change, said):
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(signed(content)))
    with pytest.raises(DeflectionError, match=said) as error:
        read_model(path, arm=GALEN)
    assert str(error.value).startswith(f"{path}: ")


def test_any_change_shows_in_the_checksum(path):
    text = path.read_text()
    content = json.loads(text)
    content["parameters"][3]["value"] *= 1.0 + 1e-12
    path.write_text(json.dumps(content))
    with pytest.raises(DeflectionError, match="sha256 is not that of the content"):
        read_model(path, arm=GALEN)
    path.write_text(json.dumps(json.loads(text), indent=3, sort_keys=True))  # only laid out anew
    read_model(path, arm=GALEN)


@pytest.mark.parametrize(
    ("raw", "said"),
    [
        (b"", "not JSON"),
        (b"[1, 2]", "the file is not an object"),
        (b'{"schema_version": 1, "kind"', "not JSON"),
        (b"\xff\xfe\x00", "not JSON"),
        (b"[" * 100_000, "not JSON"),
        (b" " * 10_000_001, "larger than 10000000 bytes"),
    ],
)
def test_what_is_no_model_is_rejected(tmp_path, raw, said):
    path = tmp_path / "arm.json"
    path.write_bytes(raw)
    with pytest.raises(DeflectionError, match=said):
        read_model(path, arm=GALEN)


def test_a_missing_file_and_a_folder_that_cannot_be_are_named(tmp_path, models):
    with pytest.raises(DeflectionError, match=r"gone.json: can't be read: No such file"):
        read_model(tmp_path / "gone.json", arm=GALEN)
    (tmp_path / "file").write_text("")
    with pytest.raises(DeflectionError, match=r"arm.json: can't be written: "):
        write_model(tmp_path / "file" / "arm.json", models["joint_stiffness"])


def test_what_has_no_end_is_not_waited_for(tmp_path):
    """The node reads files that anyone may name to it."""
    pipe = tmp_path / "pipe.json"
    os.mkfifo(pipe)
    for path in ("/dev/null", pipe):
        with pytest.raises(DeflectionError, match="no regular file"):
            read_model(path, arm=GALEN)


def test_what_could_not_be_read_is_not_written(path, models):
    before = path.read_bytes()
    broken = replace(models["joint_stiffness"], values=np.full(4, np.nan))
    with pytest.raises(DeflectionError, match="not written"):
        write_model(path, broken)
    assert path.read_bytes() == before
    assert [entry.name for entry in path.parent.iterdir()] == [path.name]


def test_the_old_file_is_kept(path, models):
    before = path.read_bytes()
    write_model(path, models["joint_stiffness"])
    assert read_model(path, arm=GALEN).name == "joint_stiffness"
    assert path.with_name("arm.json.bak").read_bytes() == before


def test_a_calibration_file_and_a_model_are_not_taken_for_each_other(path, tmp_path):
    model, tool = path, tmp_path / "pointer.json"
    write_calibration(tool, TOOL)
    calibration = "a tool's calibration file (`calibrate` writes it)"
    deflection = "a deflection model (`train` writes it)"
    with pytest.raises(CalibrationFileError) as wrong:
        read_calibration(model, arm=GALEN)
    assert str(wrong.value) == f"{model}: it is {deflection}; {calibration} is needed here"
    with pytest.raises(DeflectionError) as wrong:
        read_model(tool, arm=GALEN)
    assert str(wrong.value) == f"{tool}: it is {calibration}; {deflection} is needed here"
