# SPDX-License-Identifier: Apache-2.0
"""The network: what it learns, what it must not look at, and how it runs at any rate."""

from dataclasses import replace

import numpy as np
import pytest
from deflection_synthetic import Arm, recording
from galen_deflection.measurement.samples import DeflectionError
from galen_deflection.models.interface import FitSettings, PredictedSamples
from galen_deflection.models.network import PacedNet, RecurrentNet, Scaling
from galen_deflection.models.network_training import (
    Series,
    TrainingSettings,
    fit_network,
    hold_out,
    interpolated,
    train,
)
from galen_model.play import PlayOperators

FEW = {"axes": (0, 1, 4), "forces_n": (8.0,), "torques_nm": (0.8,), "untouched_s": 0.5}
SMALL = TrainingSettings(hidden=6, dropout=0.0, iterations=60, learning_rate=0.03)


@pytest.fixture(scope="module")
def torch():
    return pytest.importorskip("torch", reason="networks need PyTorch: `make networks`")


@pytest.fixture(scope="module")
def pushed():
    return recording(Arm(friction=(0.3, 0.3, 4.0)), sets=2, rate_hz=25.0, **FEW)


@pytest.fixture(scope="module")
def lstm(torch, pushed):
    return fit_network(pushed, FitSettings(iterations=12))


def error_over_noise(model, samples):
    return np.sqrt(
        np.mean(((model.predict(samples).mean - samples.deflection) / samples.noise) ** 2)
    )


def rate_changed(one, rate_hz):
    """The same loads of one segment, interpolated at another rate."""
    time = (one.stamp_ns - one.stamp_ns[0]) * 1e-9
    at = np.arange(0.0, time[-1], 1.0 / rate_hz)
    return replace(
        one.rows(np.zeros(len(at), dtype=int)),
        stamp_ns=one.stamp_ns[0] + np.round(at * 1e9).astype(np.int64),
        wrench=interpolated(at, time, one.wrench),
        deflection=interpolated(at, time, one.deflection),
    )


def small_net(forget=2.0):
    """One unit that follows its input slowly; made, not trained."""
    w_in = np.array([[0.0], [0.0], [0.5], [0.0]])
    bias = np.array([-1.0, forget, 0.0, 3.0])
    one = Scaling(np.zeros(1), np.ones(1))
    weights = {
        "w_in": w_in, "w_state": np.zeros((4, 1)), "bias": bias,
        "w_out": np.ones((1, 1)), "bias_out": np.zeros(1),
    }  # fmt: skip
    return RecurrentNet(weights, one, one)


def slow_load(rate_hz, duration_s=6.0):
    at = np.arange(round(duration_s * rate_hz)) / rate_hz
    return np.round(at * 1e9).astype(np.int64), np.sin(1.5 * at)[:, None]


@pytest.mark.parametrize("rate_hz", [500.0, 137.0, 10.0])
def test_at_another_rate_it_remembers_as_long(rate_hz):
    net, (stamps, load) = small_net(), slow_load(25.0)
    expected = net.predict(load)[:, 0]
    fast_stamps, fast_load = slow_load(rate_hz)
    found = PacedNet(net, 0.04).run(fast_stamps, fast_load)[:, 0]
    at = (fast_stamps[:, None] == stamps).any(axis=1) if rate_hz == 10.0 else slice(None)
    there = np.interp(fast_stamps[at], stamps, expected)
    settled = fast_stamps[at] > 0.2e9
    np.testing.assert_allclose(found[at][settled], there[settled], atol=0.02)
    # one step a sample, without the stamps, is something else
    wrong = net.predict(fast_load)[:, 0][at]
    assert np.abs(wrong - there)[settled].max() > 0.1


@pytest.mark.parametrize("jump_s", [-3.0, 3600.0])
def test_stamps_that_jump_keep_the_memory(jump_s):
    """No thousand steps, no fresh start, and afterwards time goes on."""
    net, (stamps, load) = small_net(), slow_load(100.0)
    jumped = stamps + np.where(np.arange(len(stamps)) >= 300, round(jump_s * 1e9), 0)
    expected = PacedNet(net, 0.04).run(stamps, load)
    found = PacedNet(net, 0.04).run(jumped, load)
    assert np.abs(expected).max() > 0.5
    np.testing.assert_allclose(found, expected, atol=0.06)


def test_held_out_are_repetitions_and_every_position_remains(pushed):
    used = np.ones(len(pushed), dtype=bool)
    held = hold_out(pushed, used)
    assert held.mean() == pytest.approx(0.25)
    assert set(pushed.position[~held]) == set(pushed.position)
    assert set(pushed.set_number[held]) == {1}
    once = pushed.set_number == 0
    held = hold_out(pushed, once)
    assert not held[~once].any()
    for position in range(4):
        assert 0.02 < held[once & (pushed.position == position)].mean() < 0.45


def test_samples_that_cannot_be_learnt_from_are_rejected(pushed):
    with pytest.raises(DeflectionError, match="there are no samples"):
        fit_network(pushed, FitSettings(use=np.zeros(len(pushed), dtype=bool)))
    broken = replace(pushed, wrench=np.full_like(pushed.wrench, np.nan))
    with pytest.raises(DeflectionError, match="aren't finite"):
        fit_network(broken)


# --- trained ------------------------------------------------------------------------------------


def test_a_network_learns_and_is_extrapolated_elsewhere(lstm, pushed):
    assert lstm.net.hidden == 18 and 1 <= lstm.iterations <= 12
    nothing = np.sqrt(np.mean((pushed.deflection / pushed.noise) ** 2))
    assert error_over_noise(lstm, pushed) < 0.8 * nothing
    assert not lstm.predict(pushed).extrapolated.any()
    elsewhere = replace(pushed, joints=pushed.joints + [0.0, 0.0, 0.0, 0.0, 0.3])
    assert lstm.predict(elsewhere).extrapolated.all()
    assert lstm.predict(replace(pushed, wrench=3.0 * pushed.wrench)).extrapolated.mean() > 0.3


def test_the_uncertainty_is_the_error_on_what_was_held_out(lstm, pushed):
    scaled = lstm.predict(pushed).covariance[0] / np.outer(pushed.noise, pushed.noise)
    assert np.linalg.eigvalsh(scaled)[0] > -1e-9
    assert np.sqrt(1.0 + np.trace(scaled) / 6.0) == pytest.approx(lstm.held_out_error, rel=0.02)


def test_a_stream_is_the_prediction_at_any_rate(lstm, pushed):
    one = pushed.rows(pushed.segment == 1)
    samples = rate_changed(one, 60.0)
    predicted = lstm.predict(samples)
    stream = lstm.stream()
    for _ in range(2):
        steps = [
            stream.step(int(samples.stamp_ns[k]), samples.joints[k], samples.wrench[k])
            for k in range(len(samples))
        ]
        for name in PredictedSamples._fields:
            found = [getattr(step, name) for step in steps]
            np.testing.assert_allclose(found, getattr(predicted, name), rtol=1e-9, atol=1e-12)
        stream.reset()
    assert np.abs(predicted.mean).max() > 1e-5


def with_backlash(rng, count=300):
    """The output lags behind by 0.4: static fits are half a loop off."""
    corners = np.arange(0, count + 25, 25)
    load = np.interp(np.arange(count), corners, rng.uniform(-1.0, 1.0, len(corners)))[:, None]
    return Series(load, PlayOperators(np.array([0.4])).run(load).output, np.ones(count, bool))


def test_memory_is_learnt_that_no_static_fit_has(torch):
    rng = np.random.default_rng(3)
    learnt, held_out = (
        [with_backlash(rng) for _ in range(5)],
        [with_backlash(rng) for _ in range(3)],
    )
    net, errors, best = train(learnt, replace(SMALL, hidden=8, iterations=120))
    x, y = (np.concatenate([getattr(s, name) for s in learnt])[:, 0] for name in Series._fields[:2])
    line = np.polyfit(x, y, 1)
    found = np.concatenate([net.predict(s.inputs) - s.targets for s in held_out])
    static = np.concatenate([np.polyval(line, s.inputs) - s.targets for s in held_out])
    assert found.std() < 0.6 * static.std()
    assert errors[-1] < 0.3 * errors[0] and best == 119


def test_a_seed_gives_one_network_and_the_caller_keeps_its_own(torch):
    series = [with_backlash(np.random.default_rng(0))]
    settings = TrainingSettings(hidden=4, iterations=4, dropout=0.3, seed=5)
    threads = torch.get_num_threads()
    torch.manual_seed(99)
    expected = torch.rand(3)
    torch.manual_seed(99)
    first = train(series, settings)[0].predict(series[0].inputs)
    assert torch.equal(torch.rand(3), expected)
    assert torch.get_num_threads() == threads
    np.testing.assert_array_equal(train(series, settings)[0].predict(series[0].inputs), first)


def test_the_best_iteration_is_kept(torch):
    rng = np.random.default_rng(2)
    learnt = [with_backlash(rng, 60)]
    # held out: the opposite of what is learnt, so that learning must make it worse at some time
    held_out = [s._replace(targets=-s.targets) for s in [with_backlash(rng, 60)]]
    unit = np.array([0.1])
    settings = replace(SMALL, iterations=40, learning_rate=0.05)
    told = []
    net, errors, best = train(
        learnt, settings, held_out=held_out, unit=unit, on_progress=lambda *now: told.append(now)
    )
    assert len(errors) == 40 and told[-1] == (40, 40)
    assert best < 39 and errors[best] == min(errors) < errors[-1]
    error = (net.predict(held_out[0].inputs) - held_out[0].targets) / unit
    assert np.sqrt(np.mean(error**2)) == pytest.approx(errors[best], rel=1e-5)


def test_the_numpy_network_is_what_torch_calculates(torch):
    series = with_backlash(np.random.default_rng(6))
    net, _, _ = train([series], replace(SMALL, hidden=5, iterations=3))
    lstm = torch.nn.LSTM(1, 5)
    w = {name: torch.tensor(t, dtype=torch.float32) for name, t in net.weights.items()}
    with torch.no_grad():
        lstm.weight_ih_l0.copy_(w["w_in"])
        lstm.weight_hh_l0.copy_(w["w_state"])
        lstm.bias_ih_l0.copy_(w["bias"])
        lstm.bias_hh_l0.zero_()
        x = torch.tensor(net.inputs.apply(series.inputs), dtype=torch.float32)
        theirs = lstm(x[:, None])[0][:, 0] @ w["w_out"].T + w["bias_out"]
    ours = net.outputs.apply(net.predict(series.inputs))
    np.testing.assert_allclose(ours, theirs.numpy(), atol=2e-6)


def test_a_training_that_diverges_is_reported(torch):
    series = [with_backlash(np.random.default_rng(0))]
    with pytest.raises(DeflectionError, match="diverged at iteration"):
        train(series, replace(SMALL, learning_rate=1e30))
