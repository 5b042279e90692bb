"""Networks' files: read as written to the last bit; what was changed, cut or mixed is rejected."""

import hashlib
import json
from dataclasses import replace

import numpy as np
import pytest
from deflection_synthetic import POSITIONS, recording
from galen_deflection.errors import ModelFileError
from galen_deflection.models.file import read_model, write_model
from galen_deflection.models.fitted_range import FittedRange
from galen_deflection.models.linear import FittedOn
from galen_deflection.models.registry import KINDS
from galen_deflection.networks.network import INPUTS, OUTPUTS, Network, NetworkModel, TrainingCurve
from galen_deflection.networks.recurrent_net import RecurrentNet, Scaling, Weights
from galen_deflection.networks.tensor_file import digest

safetensors = pytest.importorskip(
    "safetensors.numpy", reason="networks' files need safetensors: `make networks`"
)

HIDDEN = 4
CURVE = TrainingCurve((3.0, 2.0, 1.5), (3.1, 2.5, 2.6), 1)


@pytest.fixture(scope="module")
def samples():
    return recording(rate_hz=10.0, positions=POSITIONS[:3])


def network(inputs, noise):
    rng = np.random.default_rng(1)
    shapes = Weights.shapes(len(inputs), HIDDEN, 6)
    weights = {name: rng.normal(size=shape).astype(np.float32) for name, shape in shapes.items()}
    scaling = Scaling(rng.normal(size=len(inputs)), rng.uniform(0.1, 1.0, len(inputs)))
    net = RecurrentNet(Weights(**weights), scaling, Scaling(rng.normal(size=6) * noise, noise))
    return Network(net, 0.04, inputs, OUTPUTS)


@pytest.fixture(scope="module")
def models(samples):
    lstm = NetworkModel(
        name="lstm",
        tip_m=samples.tip_m,
        network=network(INPUTS, samples.noise),
        discrepancy=np.diag(samples.noise**2 / 3.0),
        noise=samples.noise,
        fitted_range=FittedRange.of(samples.joints, samples.wrench, only_nearby=True),
        fitted_on=FittedOn.of(samples),
        training=CURVE,
    )
    return {"lstm": lstm, "lstm_direct": replace(lstm, name="lstm_direct")}


@pytest.fixture
def path(tmp_path, models):
    path = tmp_path / "arm.safetensors"
    write_model(path, models["lstm"])
    return path


@pytest.mark.parametrize("name", ["lstm", "lstm_direct"])
def test_a_network_that_was_read_predicts_the_same_to_the_last_bit(name, models, samples, tmp_path):
    path = tmp_path / "arm.json"  # the name does not matter
    model = models[name]
    write_model(path, model)
    read = read_model(path)
    assert (read.name, read.to_json(), read.training) == (
        model.name,
        model.to_json(),
        model.training,
    )
    ours, theirs = model.predict(samples), read.predict(samples)
    np.testing.assert_array_equal(theirs.mean, ours.mean)
    np.testing.assert_array_equal(theirs.covariance, ours.covariance)
    np.testing.assert_array_equal(theirs.extrapolated, ours.extrapolated)
    assert np.abs(ours.mean).max() > 1e-5


def test_others_can_open_it(path):
    tensors = safetensors.load(path.read_bytes())
    assert {name: tensor.shape for name, tensor in tensors.items()} == Weights.shapes(11, HIDDEN, 6)
    header = json.loads(path.read_bytes()[8:].split(b"}}")[0] + b"}}")
    described = json.loads(header["__metadata__"]["galen_deflection"])
    assert (described["kind"], described["schema_version"]) == ("lstm", 1)
    assert described["training"]["best"] == 1


def unpacked(path):
    raw = path.read_bytes()
    length = int.from_bytes(raw[:8], "little")
    header = json.loads(raw[8 : 8 + length])
    return json.loads(header["__metadata__"]["galen_deflection"]), safetensors.load(raw)


def pack(path, content, tensors):
    """With a checksum that is right."""
    rest = {name: value for name, value in content.items() if name != "sha256"}
    canonical = json.dumps(rest, sort_keys=True, separators=(",", ":")).encode()
    rest["sha256"] = hashlib.sha256(canonical + digest(tensors)).hexdigest()
    path.write_bytes(safetensors.save(tensors, {"galen_deflection": json.dumps(rest)}))


def of(name, value):
    return lambda content, tensors: tensors.update({name: value(tensors[name])})


def nan_in(tensor):
    changed = tensor.copy()
    changed.flat[3] = np.nan
    return changed


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda c, t: c.update(schema_version=2), "schema_version is 2; this version reads 1"),
        (lambda c, t: c.update(kind="gru"), 'kind is "gru"; this version knows independent'),
        (lambda c, t: c.update(kind="coupled"), "kind coupled is in JSON, not in this format"),
        (lambda c, t: c["network"].update(hidden=5), r"tensor w_in has shape \(16, 11\); expected"),
        (lambda c, t: c["network"].update(hidden=10**9), "network.hidden is 1000000000; expected"),
        (lambda c, t: c["network"].update(period_s=0.0), "network.period_s is 0; expected"),
        (lambda c, t: c["network"]["inputs"].reverse(), "network.inputs is tilt, roll"),
        (lambda c, t: c["network"]["outputs"].pop(), "network.outputs is dx"),
        (
            lambda c, t: c["network"]["input_scaling"].update(scale=[0.0] * 11),
            "network.input_scaling.scale holds a value that isn't positive",
        ),
        (lambda c, t: c["network"].pop("output_scaling"), "output_scaling is missing"),
        (lambda c, t: c["training"].update(best=3), "training.best is beyond the iterations"),
        (lambda c, t: c["training"]["check_loss"].pop(), "training.check_loss is not as long"),
        (lambda c, t: c["discrepancy"][0].__setitem__(0, -1.0), "discrepancy has a negative"),
        (lambda c, t: c.update(noise=[0.0] * 6), "noise holds a value that isn't positive"),
        (lambda c, t: c.pop("fitted_on"), "fitted_on is missing"),
        (of("w_in", lambda w: w[:, :-1].copy()), r"tensor w_in has shape \(16, 10\); expected"),
        (of("w_state", nan_in), "tensor w_state holds a value that is not finite"),
        (of("bias", lambda b: b.astype(np.float64)), "tensor bias is in 'F64'; expected F32"),
        (lambda c, t: t.pop("w_out"), "the tensors are .*; expected .*w_out"),
        (lambda c, t: t.update(more=t["bias"]), "the tensors are .*more"),
    ],
)
def test_a_wrong_field_is_named_with_the_file(path, change, said):
    content, tensors = unpacked(path)
    change(content, tensors)
    pack(path, content, tensors)
    with pytest.raises(ModelFileError, match=said) as error:
        read_model(path)
    assert str(error.value).startswith(f"{path}: ")


def test_the_description_alone_is_no_network(path, tmp_path):
    content, _ = unpacked(path)
    del content["sha256"]
    canonical = json.dumps(content, sort_keys=True, separators=(",", ":")).encode()
    content["sha256"] = hashlib.sha256(canonical).hexdigest()
    path.write_text(json.dumps(content))
    with pytest.raises(ModelFileError, match="kind lstm is in safetensors, not in this format"):
        read_model(path)


@pytest.mark.parametrize("where", [0.3, 0.9, -1])
def test_a_flipped_bit_is_found_wherever_it_is(path, where):
    raw = bytearray(path.read_bytes())
    raw[where if where == -1 else int(where * len(raw))] ^= 1
    path.write_bytes(bytes(raw))
    with pytest.raises(ModelFileError, match=f"^{path}: "):
        read_model(path)


def test_every_single_changed_byte_of_the_weights_shows(path):
    raw = path.read_bytes()
    start = 8 + int.from_bytes(raw[:8], "little")
    for k in range(start, len(raw), 97):
        changed = bytearray(raw)
        changed[k] ^= 0x10
        path.write_bytes(bytes(changed))
        with pytest.raises(ModelFileError, match="sha256 is not that of the content"):
            read_model(path)


@pytest.mark.parametrize("left", [8, 9, 20, 1000, -1, -200])
def test_a_cut_file_is_rejected(path, left):
    path.write_bytes(path.read_bytes()[:left])
    with pytest.raises(ModelFileError, match=f"^{path}: "):
        read_model(path)


@pytest.mark.parametrize(
    ("raw", "said"),
    [
        (b"\xff" * 8 + b"{", "its header should have 18446744073709551615 bytes, but only 1"),
        ((10**6).to_bytes(8, "little") + b"{}", "its header should have 1000000 bytes, but only 2"),
        ((2).to_bytes(8, "little") + b"{}", "__metadata__ is missing"),
        ((4).to_bytes(8, "little") + b"{]{]", "not JSON"),
        (
            (36).to_bytes(8, "little") + b'{"__metadata__": {"format": "pt" } }',
            "galen_deflection is missing",
        ),
        (b"\x80\x04\x95" + b"\0" * 5 + b"cos\nsystem\n", "not JSON"),  # a pickle's beginning
    ],
)
def test_what_is_no_model_is_rejected(tmp_path, raw, said):
    path = tmp_path / "arm.safetensors"
    path.write_bytes(raw)
    with pytest.raises(ModelFileError, match=said):
        read_model(path)


def test_a_large_file_is_not_read_to_its_end(tmp_path):
    path = tmp_path / "arm.safetensors"
    with path.open("wb") as stream:
        stream.truncate(2_000_000_000)  # takes no room on the disk
    with pytest.raises(ModelFileError, match="larger than 10000000 bytes, not a model's file"):
        read_model(path)


def test_what_could_not_be_read_is_not_written_and_the_old_is_kept(path, models, samples):
    before = path.read_bytes()
    model = models["lstm"]
    bad = model.network.net.weights
    bad = replace(bad, bias=np.full_like(bad.bias, np.inf))
    net = RecurrentNet(bad, model.network.net.inputs, model.network.net.outputs)
    with pytest.raises(ModelFileError, match="not written: tensor bias holds"):
        write_model(path, replace(model, network=replace(model.network, net=net)))
    assert path.read_bytes() == before
    write_model(path, KINDS["independent"].fit(samples, None))
    assert read_model(path).name == "independent"
    assert path.with_name("arm.safetensors.bak").read_bytes() == before
