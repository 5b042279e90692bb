"""The kinds that are networks: what they are fitted to, how they run, what they own up to."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from deflection_synthetic import POSITIONS, Arm, recording
from galen_deflection.errors import FitError
from galen_deflection.models.interface import FitSettings, PredictedSamples
from galen_deflection.models.linear import segments
from galen_deflection.models.registry import KINDS
from galen_deflection.networks import lstm
from galen_deflection.networks.recurrent_net import PacedNet, RecurrentNet, Scaling, Weights
from galen_deflection.networks.sequences import hold_out, interpolated, sequences

LSTMS = ["lstm", "lstm_direct"]
FEW = {"axes": (0, 1, 4), "forces_n": (8.0,), "torques_nm": (0.8,), "untouched_s": 0.5}


@pytest.fixture(scope="module")
def torch():
    return pytest.importorskip("torch", reason="networks need PyTorch: `make networks`")


@pytest.fixture(scope="module")
def pushed():
    return recording(Arm(friction=(0.3, 0.3, 4.0)), sets=2, rate_hz=25.0, **FEW)


@pytest.fixture(scope="module")
def lstms(torch, pushed):
    return {kind: KINDS[kind].fit(pushed, FitSettings(iterations=12)) for kind in LSTMS}


def error_over_noise(model, samples):
    error = (model.predict(samples).mean - samples.deflection) / samples.noise
    return np.sqrt(np.mean(error**2))


def rate_changed(samples, rate_hz):
    """The same loads, interpolated at another rate."""
    parts = []
    for segment in segments(samples):
        one = samples.rows(segment)
        time = (one.stamp_ns - one.stamp_ns[0]) * 1e-9
        at = np.arange(0.0, time[-1], 1.0 / rate_hz)
        first = one.rows(np.zeros(len(at), dtype=int))
        parts.append(
            replace(
                first,
                stamp_ns=one.stamp_ns[0] + np.round(at * 1e9).astype(np.int64),
                wrench=interpolated(at, time, one.wrench),
                deflection=interpolated(at, time, one.deflection),
            )
        )
    assert len(parts) == 1
    return parts[0]


# without PyTorch


def test_nothing_loads_torch_but_a_training(tmp_path):
    """What the node and the commands need is quick, and works where there is no PyTorch."""
    path = tmp_path / "arm.safetensors"
    header = b'{"__metadata__": {"galen_deflection": "{}"}}'
    path.write_bytes(len(header).to_bytes(8, "little") + header)
    code = (
        f"import sys; sys.path[:0] = {[entry for entry in sys.path if entry]!r}\n"
        "class NoTorch:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name.partition('.')[0] in ('torch', 'safetensors'):\n"
        "            raise ModuleNotFoundError(name)\n"
        "sys.meta_path.insert(0, NoTorch())\n"
        "import galen_deflection.evaluate, galen_deflection.models.file, galen_deflection.node\n"
        "from galen_deflection.models.registry import KINDS\n"
        "from deflection_synthetic import recording\n"
        "samples = recording(sets=1, rate_hz=10.0)\n"
        "for name in ('joint_stiffness', 'joint_hysteresis'):\n"
        "    stream = KINDS[name].fit(samples, None).stream()\n"
        "    stream.step(0, samples.joints[0], samples.wrench[0])\n"
        "assert 'torch' not in sys.modules and 'safetensors' not in sys.modules\n"
        "try:\n"
        "    KINDS['lstm'].fit(samples, None)\n"
        "except Exception as error:\n"
        "    print(type(error).__name__, error)\n"
        "try:\n"
        f"    galen_deflection.models.file.read_model({str(path)!r})\n"
        "except Exception as error:\n"
        "    print(type(error).__name__, error)\n"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], timeout=100, check=True, capture_output=True, text=True
    )
    assert result.stdout.splitlines() == [
        "FitError lstm: training a network needs PyTorch and safetensors: "
        "`make networks` installs them",
        f"ModelFileError {path}: a network's file needs PyTorch and safetensors: "
        "`make networks` installs them",
    ]


def small_net(forget=2.0):
    """One unit that follows its input slowly; made, not trained."""
    w_in = np.array([[0.0], [0.0], [0.5], [0.0]], dtype=np.float32)
    bias = np.array([-1.0, forget, 0.0, 3.0], dtype=np.float32)
    one = Scaling(np.zeros(1), np.ones(1))
    weights = Weights(
        w_in, np.zeros((4, 1), np.float32), bias, np.ones((1, 1), np.float32), np.zeros(1, "f4")
    )
    return RecurrentNet(weights, one, one)


def slow_load(rate_hz, duration_s=6.0):
    at = np.arange(round(duration_s * rate_hz)) / rate_hz
    return np.round(at * 1e9).astype(np.int64), np.sin(1.5 * at)[:, None]


def test_at_the_rate_of_the_training_every_sample_is_a_step():
    net, (stamps, load) = small_net(), slow_load(25.0)
    expected = net.predict(load)
    np.testing.assert_allclose(PacedNet(net, 0.04).run(stamps, load), expected, rtol=1e-12)
    jitter = np.random.default_rng(0).integers(-4_000_000, 4_000_000, len(stamps))
    found = PacedNet(net, 0.04).run(stamps + jitter, load)
    np.testing.assert_allclose(found, expected, atol=0.02)


@pytest.mark.parametrize("rate_hz", [500.0, 137.0, 60.0, 10.0])
def test_at_another_rate_it_remembers_as_long(rate_hz):
    net, (stamps, load) = small_net(), slow_load(25.0)
    expected = net.predict(load)[:, 0]
    fast_stamps, fast_load = slow_load(rate_hz)
    found = PacedNet(net, 0.04).run(fast_stamps, fast_load)[:, 0]
    at = (fast_stamps[:, None] == stamps).any(axis=1) if rate_hz == 10.0 else slice(None)
    there = np.interp(fast_stamps[at], stamps, expected)
    settled = fast_stamps[at] > 0.2e9
    np.testing.assert_allclose(found[at][settled], there[settled], atol=0.02)
    # one step a sample, as if it knew no time, is something else
    wrong = net.predict(fast_load)[:, 0][at]
    assert np.abs(wrong - there)[settled].max() > 0.1


def test_sample_by_sample_is_the_same_and_a_reset_is_a_fresh_start():
    net, (stamps, load) = small_net(), slow_load(137.0, 2.0)
    whole = PacedNet(net, 0.04).run(stamps, load)
    paced = PacedNet(net, 0.04)
    paced.run(stamps, -load)
    paced.reset()
    single = [paced.run(stamps[k : k + 1], load[k : k + 1])[0] for k in range(len(load))]
    np.testing.assert_allclose(single, whole, rtol=1e-12)


@pytest.mark.parametrize("jump_s", [-3.0, 3600.0, 1e9])
def test_stamps_that_jump_keep_what_was(jump_s):
    """No thousand steps, no fresh start, and afterwards time goes on."""
    net, (stamps, load) = small_net(), slow_load(100.0)
    jumped = stamps + np.where(np.arange(len(stamps)) >= 300, round(jump_s * 1e9), 0)
    expected = PacedNet(net, 0.04).run(stamps, load)
    found = PacedNet(net, 0.04).run(jumped, load)
    assert np.abs(expected).max() > 0.5
    np.testing.assert_allclose(found, expected, atol=0.06)


def test_every_sample_is_in_one_sequence():
    samples = recording(sets=1, rate_hz=100.0, positions=POSITIONS[:2], axes=(0,))
    inputs = np.arange(len(samples), dtype=float)[:, None]
    use = np.ones(len(samples), bool)
    use[40:47] = False
    found = sequences(samples, inputs, inputs, use, 0.04)
    assert len(found) == 8
    for one in found:
        np.testing.assert_allclose(np.diff(one.inputs[:, 0]), 4.0, atol=1e-6)
        np.testing.assert_allclose(one.targets[one.use], one.inputs[one.use])
    seen = np.concatenate([one.targets[one.use, 0] for one in found])
    np.testing.assert_allclose(np.sort(seen), np.flatnonzero(use), atol=1e-6)


def test_between_samples_a_target_needs_both_sides():
    values = np.array([[0.0], [1.0], [np.nan], [3.0]])
    at = np.array([0.5, 1.0, 1.5, 2.5, 3.0])
    found = interpolated(at, np.arange(4.0), values)[:, 0]
    np.testing.assert_array_equal(found, [0.5, 1.0, np.nan, np.nan, 3.0])


def test_held_out_are_repetitions_and_no_position_is_lost(pushed):
    used = np.ones(len(pushed), dtype=bool)
    held = hold_out(pushed, used)
    assert held.mean() == pytest.approx(0.25)
    assert set(pushed.position[~held]) == set(pushed.position)
    assert set(pushed.set_number[held]) == {1}
    once = pushed.set_number == 0
    held = hold_out(pushed, once)
    assert not held[~once].any()
    for position in range(4):
        share = held[once & (pushed.position == position)].mean()
        assert 0.02 < share < 0.45


# trained


@pytest.mark.parametrize("kind", LSTMS)
def test_a_network_learns_and_says_where_it_has_not(kind, lstms, pushed):
    model = lstms[kind]
    assert model.name == kind
    assert model.network.net.hidden == 18
    assert len(model.training.training_loss) == len(model.training.check_loss) == 12
    nothing = np.sqrt(np.mean((pushed.deflection / pushed.noise) ** 2))
    assert error_over_noise(model, pushed) < 0.8 * nothing
    assert not model.predict(pushed).extrapolated.any()
    elsewhere = replace(pushed, joints=pushed.joints + [0.0, 0.0, 0.0, 0.0, 0.3])
    assert model.predict(elsewhere).extrapolated.all()
    assert model.predict(replace(pushed, wrench=3.0 * pushed.wrench)).extrapolated.mean() > 0.3


@pytest.mark.parametrize("kind", LSTMS)
def test_the_uncertainty_is_what_was_wrong_where_nothing_was_learnt(kind, lstms, pushed):
    model = lstms[kind]
    covariance = model.predict(pushed).covariance[0]
    assert np.linalg.eigvalsh(covariance / np.outer(pushed.noise, pushed.noise))[0] > -1e-9
    beyond = np.trace(covariance / np.outer(pushed.noise, pushed.noise)) / 6.0
    held_out = model.training.check_loss[model.training.best]
    assert np.sqrt(1.0 + beyond) == pytest.approx(held_out, rel=0.02)


@pytest.mark.parametrize("kind", LSTMS)
def test_a_stream_is_the_prediction(kind, lstms, pushed):
    check_stream(lstms[kind], rate_changed(pushed.rows(pushed.segment == 1), 60.0))


def check_stream(model, samples):
    predicted = model.predict(samples)
    stream = model.stream()
    for _ in range(2):
        steps = [
            stream.step(int(samples.stamp_ns[k]), samples.joints[k], samples.wrench[k])
            for k in range(len(samples))
        ]
        mean, covariance, extrapolated = (
            [getattr(step, name) for step in steps] for name in PredictedSamples._fields
        )
        np.testing.assert_allclose(mean, predicted.mean, rtol=0, atol=1e-12)
        np.testing.assert_allclose(covariance, predicted.covariance, rtol=1e-9, atol=1e-18)
        np.testing.assert_array_equal(extrapolated, predicted.extrapolated)
        stream.reset()
    assert np.abs(predicted.mean).max() > 1e-5


def test_a_network_runs_at_the_node_s_rate(lstms, pushed):
    one = pushed.rows(pushed.segment == 0)
    fast = rate_changed(one, 500.0)
    expected = lstms["lstm"].predict(one).mean
    found = lstms["lstm"].predict(fast).mean
    there = interpolated(one.stamp_ns * 1.0, fast.stamp_ns * 1.0, found)
    assert np.abs((there - expected) / one.noise).max() < 1e-3 * np.abs(expected / one.noise).max()


def test_what_may_not_be_used_is_not_looked_at(torch, pushed):
    use = pushed.position != 2
    hidden = np.where(use[:, None], pushed.deflection, np.nan)
    settings = FitSettings(use=use, iterations=2, seed=3)
    masked = lstm.fit(lstm.KIND, replace(pushed, deflection=hidden), settings)
    alone = lstm.fit(lstm.KIND, pushed.rows(use), FitSettings(iterations=2, seed=3))
    assert masked.fitted_on == alone.fitted_on
    np.testing.assert_array_equal(masked.discrepancy, alone.discrepancy)
    np.testing.assert_array_equal(masked.predict(pushed).mean, alone.predict(pushed).mean)
    other = lstm.fit(lstm.KIND, pushed.rows(use), FitSettings(iterations=2, seed=4))
    assert np.abs(other.predict(pushed).mean - alone.predict(pushed).mean).max() > 1e-6


def test_progress_reaches_the_training(torch, pushed):
    told = []
    model = lstm.fit(
        lstm.KIND,
        pushed,
        FitSettings(iterations=3, on_progress=lambda *now: told.append(now)),
    )
    assert told[0][:2] == (1, 3)
    assert len(told) == len(model.training.training_loss) + model.training.best + 1


@pytest.mark.parametrize("kind", LSTMS)
def test_samples_that_cannot_be_learnt_from_are_rejected(kind, pushed):
    with pytest.raises(FitError, match="there are no samples"):
        KINDS[kind].fit(pushed, FitSettings(use=np.zeros(len(pushed), dtype=bool)))
    broken = replace(pushed, wrench=np.full_like(pushed.wrench, np.nan))
    with pytest.raises(FitError, match="aren't finite"):
        KINDS[kind].fit(broken, None)
