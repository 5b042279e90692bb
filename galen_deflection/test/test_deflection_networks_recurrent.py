"""The recurrent regressor: what it learns, what it must not look at, and how it is run."""

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="networks need PyTorch: `make networks`")

from galen_deflection.networks.training import (  # noqa: E402
    RecurrentSettings,
    Series,
    TrainingError,
    train,
)
from galen_model.transmission.play import PlayOperators  # noqa: E402

SMALL = RecurrentSettings(hidden=6, dropout=0.0, iterations=60, learning_rate=0.03)


def bias_drift(rng, count):
    """A load (n,) that goes from one random level to the next."""
    corners = np.arange(0, count + 25, 25)
    return np.interp(np.arange(count), corners, rng.uniform(-1.0, 1.0, len(corners)))


def with_backlash(rng, count=300):
    """The output lags behind by 0.4: static fits are half a loop off."""
    load = bias_drift(rng, count)[:, None]
    return Series(load, PlayOperators(np.array([0.4])).run(load).output, np.ones(count, bool))


def smoothed(rng, count=300):
    """A low-pass of three inputs into two outputs of very different size and offset."""
    load = np.stack([bias_drift(rng, count) for _ in range(3)], axis=1)
    mixed = load @ np.array([[1e-3, 50.0], [2e-3, -20.0], [0.0, 10.0]])
    state, out = np.zeros(2), np.empty_like(mixed)
    for k, row in enumerate(mixed):
        state = state + 0.08 * (row - state)
        out[k] = state
    return Series(load, out + [5e-3, 200.0], np.ones(count, bool))


def static_error(learnt, held_out):
    """RMS over standard deviation (n_out,) of the best affine function of the present inputs."""

    def design(series):
        return np.hstack([series.inputs, np.ones((len(series.inputs), 1))])

    rows = np.concatenate([design(s) for s in learnt])
    values = np.linalg.lstsq(rows, np.concatenate([s.targets for s in learnt]), rcond=None)[0]
    return error_of(lambda s: design(s) @ values, held_out)


def error_of(predict, series):
    errors = np.concatenate([predict(s) - s.targets for s in series])
    return np.sqrt(np.mean(errors**2, axis=0)) / np.concatenate([s.targets for s in series]).std(0)


@pytest.mark.parametrize("direct", [False, True], ids=["fully connected", "direct"])
@pytest.mark.parametrize("make", [with_backlash, smoothed])
def test_memory_is_learnt_that_no_static_fit_has(make, direct):
    rng = np.random.default_rng(3)
    learnt, held_out = [make(rng) for _ in range(5)], [make(rng) for _ in range(3)]
    settings = RecurrentSettings(
        hidden=8, dropout=0.0, iterations=120, learning_rate=0.03, direct=direct
    )
    net, curve = train(learnt, settings)
    found = error_of(lambda s: net.predict(s.inputs), held_out)
    assert np.all(found < 0.6 * static_error(learnt, held_out))
    assert curve.training_loss[-1] < 0.3 * curve.training_loss[0]
    assert curve.check_loss == ()


def test_a_seed_gives_one_network_and_the_caller_keeps_its_own():
    series = [with_backlash(np.random.default_rng(0))]
    settings = RecurrentSettings(hidden=4, iterations=4, dropout=0.3, seed=5)
    threads = torch.get_num_threads()
    torch.manual_seed(99)
    expected = torch.rand(3)
    torch.manual_seed(99)
    first = train(series, settings)[0].predict(series[0].inputs)
    assert torch.equal(torch.rand(3), expected)
    assert torch.get_num_threads() == threads
    np.testing.assert_array_equal(train(series, settings)[0].predict(series[0].inputs), first)
    other = train(series, RecurrentSettings(hidden=4, iterations=4, dropout=0.3, seed=6))[0]
    assert np.abs(other.predict(series[0].inputs) - first).max() > 1e-3


def test_targets_that_may_not_be_used_are_never_looked_at():
    rng = np.random.default_rng(1)
    whole = [with_backlash(rng) for _ in range(2)]
    use = rng.uniform(size=300) < 0.5
    other = [s._replace(targets=s.targets.copy(), use=use) for s in whole]
    for s in other:
        s.targets[~use] = np.nan
    strange = [s._replace(targets=np.where(use[:, None], s.targets, 1e9)) for s in other]
    settings = RecurrentSettings(hidden=4, iterations=5)
    nets = [train(s, settings, held_out=s) for s in (other, strange)]
    for net, curve in nets:
        assert np.isfinite(curve.training_loss).all() and np.isfinite(curve.check_loss).all()
        assert net.outputs.scale == pytest.approx(
            np.concatenate([s.targets[use] for s in whole]).std(), rel=1e-12
        )
    a, b = (net.predict(whole[0].inputs) for net, _ in nets)
    np.testing.assert_array_equal(a, b)
    # but what they are loaded with still counts: another past gives another training
    pasts = [s._replace(inputs=np.where(use[:, None], s.inputs, -s.inputs)) for s in other]
    assert train(pasts, settings)[1].training_loss != train(other, settings)[1].training_loss


def test_the_best_iteration_is_kept():
    rng = np.random.default_rng(2)
    learnt = [with_backlash(rng, 60)]
    # held out: the opposite of what is learnt, so that learning must make it worse at some time
    held_out = [s._replace(targets=-s.targets) for s in [with_backlash(rng, 60)]]
    settings = RecurrentSettings(hidden=6, iterations=40, learning_rate=0.05)
    unit = np.array([0.1])
    net, curve = train(learnt, settings, held_out=held_out, unit=unit)
    assert len(curve.check_loss) == len(curve.training_loss) == 40
    assert curve.best < 39
    assert curve.check_loss[curve.best] == min(curve.check_loss) < curve.check_loss[-1]
    error = (net.predict(held_out[0].inputs) - held_out[0].targets) / unit
    assert np.sqrt(np.mean(error**2)) == pytest.approx(curve.check_loss[curve.best], rel=1e-5)


def test_sequences_of_any_lengths_count_by_their_samples():
    """What is padded is not counted: the loss is that of the samples one by one."""
    rng = np.random.default_rng(4)
    series = [with_backlash(rng, n) for n in (10, 37, 200, 90)]
    net, curve = train(
        series, RecurrentSettings(hidden=3, iterations=1), held_out=series, unit=np.array([1.0])
    )
    errors = np.concatenate([net.predict(s.inputs) - s.targets for s in series])
    assert np.sqrt(np.mean(errors**2)) == pytest.approx(curve.check_loss[0], rel=1e-5)


def test_step_by_step_is_the_whole_sequence_and_is_what_torch_says():
    rng = np.random.default_rng(6)
    series = smoothed(rng)
    net, _ = train([series], RecurrentSettings(hidden=5, iterations=3))
    whole = net.predict(series.inputs)
    state, steps = net.start(), []
    for row in series.inputs:
        state, out = net.step(state, row)
        steps.append(out)
    np.testing.assert_allclose(steps, whole, rtol=1e-12, atol=1e-15)
    lstm = torch.nn.LSTM(3, 5)
    w = {name: torch.tensor(t) for name, t in net.weights.tensors().items()}
    with torch.no_grad():
        lstm.weight_ih_l0.copy_(w["w_in"])
        lstm.weight_hh_l0.copy_(w["w_state"])
        lstm.bias_ih_l0.copy_(w["bias"])
        lstm.bias_hh_l0.zero_()
        x = torch.tensor(net.inputs.apply(series.inputs), dtype=torch.float32)
        theirs = lstm(x[:, None])[0][:, 0] @ w["w_out"].T + w["bias_out"]
    np.testing.assert_allclose(net.outputs.apply(whole), theirs.numpy(), atol=2e-6)


def test_direct_is_torch_s_projection():
    """What goes back into the gates are the outputs, as in nn.LSTM with proj_size."""
    rng = np.random.default_rng(7)
    series = smoothed(rng)
    net, _ = train([series], RecurrentSettings(hidden=5, iterations=3, direct=True))
    assert np.linalg.matrix_rank(net.weights.w_state, tol=1e-5) == 2
    assert not net.weights.bias_out.any()
    back = net.weights.w_state @ np.linalg.pinv(net.weights.w_out)
    lstm = torch.nn.LSTM(3, 5, proj_size=2)
    with torch.no_grad():
        lstm.weight_ih_l0.copy_(torch.tensor(net.weights.w_in))
        lstm.weight_hh_l0.copy_(torch.tensor(back))
        lstm.weight_hr_l0.copy_(torch.tensor(net.weights.w_out))
        lstm.bias_ih_l0.copy_(torch.tensor(net.weights.bias))
        lstm.bias_hh_l0.zero_()
        x = torch.tensor(net.inputs.apply(series.inputs), dtype=torch.float32)
        theirs = lstm(x[:, None])[0][:, 0].numpy()
    np.testing.assert_allclose(net.outputs.apply(net.predict(series.inputs)), theirs, atol=5e-6)


def test_an_input_of_nothing_but_rounding_is_not_blown_up():
    rng = np.random.default_rng(9)
    one = with_backlash(rng)
    rounding = 1e-16 * rng.normal(size=(300, 1))
    whole = one._replace(inputs=np.hstack([one.inputs, rounding]))
    net, _ = train([whole], RecurrentSettings(hidden=4, iterations=3), least=np.array([0.0, 0.1]))
    moved = np.hstack([one.inputs, rounding + 1e-6])
    np.testing.assert_allclose(net.predict(moved), net.predict(whole.inputs), atol=1e-5)
    blown_up, _ = train([whole], RecurrentSettings(hidden=4, iterations=3))
    assert np.abs(blown_up.predict(moved) - blown_up.predict(whole.inputs)).max() > 1e-2


def test_a_constant_input_and_output_do_no_harm():
    rng = np.random.default_rng(8)
    one = with_backlash(rng)
    inputs = np.hstack([one.inputs, np.full((300, 1), 0.1)])
    targets = np.hstack([one.targets, np.full((300, 1), 7.3)])
    net, _ = train([Series(inputs, targets, one.use)], SMALL)
    predicted = net.predict(inputs)
    assert np.isfinite(predicted).all()
    assert np.abs(predicted[:, 1] - 7.3).max() < 0.5


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda s: [], "there are no sequences"),
        (lambda s: [s._replace(use=np.zeros(300, bool))], "to train on, no sample may be used"),
        (lambda s: [s._replace(inputs=np.full((300, 1), np.nan))], "sequence 0 to train on holds"),
        (lambda s: [s, s._replace(targets=np.full((300, 1), np.inf))], "sequence 1 to train on"),
    ],
)
def test_what_cannot_be_learnt_from_is_rejected(change, said):
    with pytest.raises(TrainingError, match=said):
        train(change(with_backlash(np.random.default_rng(0))), SMALL)


def test_a_training_that_goes_astray_is_told():
    series = [with_backlash(np.random.default_rng(0))]
    with pytest.raises(TrainingError, match="went astray at iteration"):
        train(series, RecurrentSettings(hidden=3, iterations=9, learning_rate=1e30))


def test_progress_is_told():
    told = []
    train(
        [with_backlash(np.random.default_rng(0), 40)],
        RecurrentSettings(hidden=2, iterations=3),
        on_progress=lambda *done: told.append(done),
    )
    assert told == [(1, 3), (2, 3), (3, 3)]
