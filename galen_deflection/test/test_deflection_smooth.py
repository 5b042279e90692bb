"""Smooth operators by their properties; and what friction like Dahl's needs them for."""

from dataclasses import replace

import numpy as np
import pytest
from deflection_synthetic import NOISE, TIP_M, Arm, dahl, recording
from galen_deflection.models.hysteresis_basis import COLUMNS, HysteresisBasis, Operator
from galen_deflection.models.joint_hysteresis import fit
from galen_deflection.scoring.score import score
from galen_model.transmission.play import PlayOperators, SmoothOperators
from scipy.integrate import solve_ivp

R = np.array([0.1, 0.4, 1.5])


def smooth(load, thresholds=R):
    columns = np.tile(np.asarray(load, dtype=float)[:, None], (1, len(thresholds)))
    return SmoothOperators(thresholds).run(columns)


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


def test_the_virgin_curve_and_the_way_back():
    """Up: z = 1 - exp(-x/r). Back: z falls straight by x/r to zero, then bends to -1."""
    load = np.array([0.0, 0.3, 1.0, 0.9, 0.0])
    z_top = 1.0 - np.exp(-1.0 / R)
    past_zero = np.maximum(1.0 / R - z_top, 0.0)
    z_end = np.where(past_zero > 0.0, np.expm1(-past_zero), z_top - 1.0 / R)
    output = smooth(load).output
    np.testing.assert_allclose(output[1], 0.3 + R * np.expm1(-0.3 / R), rtol=1e-12)
    np.testing.assert_allclose(output[4], -R * z_end, rtol=1e-12)


def test_against_the_differential_equation():
    """Bouc and Wen's equation in time, with n = 1 and beta = gamma = 1/2, by a general solver."""
    corners = np.array([0.0, 0.8, -0.3, 0.5, 0.45, -1.0, 0.0])

    def rate(t, z):
        k = min(int(t), len(corners) - 2)
        dx = corners[k + 1] - corners[k]
        return (dx - 0.5 * abs(dx) * z - 0.5 * dx * np.abs(z)) / R

    solved = solve_ivp(
        rate, (0.0, 6.0), np.zeros(3), t_eval=np.arange(7.0), rtol=1e-10, atol=1e-12, max_step=0.01
    )
    expected = corners[:, None] - R * solved.y.T
    np.testing.assert_allclose(smooth(corners).output, expected, atol=1e-6)


def test_speed_and_samples_in_between_change_nothing():
    corners = np.array([0.0, 0.8, -0.3, 0.5, 0.45, -1.0, 0.0])
    finer = np.interp(np.linspace(0.0, 6.0, 6 * 37 + 1), np.arange(7.0), corners)
    held = np.repeat(finer, 3)
    np.testing.assert_allclose(smooth(finer).output[::37], smooth(corners).output, atol=1e-13)
    np.testing.assert_array_equal(smooth(held).output[::3], smooth(finer).output)


def test_cut_into_calls_it_is_the_same_to_the_last_bit():
    inputs = np.random.default_rng(0).normal(size=(200, 3))
    whole = SmoothOperators(R).run(inputs)
    parts = SmoothOperators(R)
    cut = [parts.run(inputs[a:b]) for a, b in ((0, 1), (1, 90), (90, 91), (91, 200))]
    for name in ("output", "spread", "unknown"):
        together = np.concatenate([getattr(part, name) for part in cut])
        np.testing.assert_array_equal(together, getattr(whole, name))


def test_no_past_lies_outside_of_the_spread():
    """Loads before the first sample, whatever they were, that end where the stream begins."""
    rng = np.random.default_rng(1)
    load = np.concatenate([[0.6], 0.6 + np.cumsum(rng.normal(size=80) * 0.2)])
    played = smooth(load)
    widths = []
    for _ in range(200):
        past = np.append(rng.normal(size=8) * rng.choice([0.05, 0.5, 5.0]), 0.6)
        output = smooth(np.append(past, load)).output[len(past) :]
        widths.append(output - played.output)
    assert np.all(np.diff(played.spread, axis=0) <= 1e-12)
    assert np.all(np.max(np.abs(widths), axis=0) <= played.spread + 1e-12)
    np.testing.assert_allclose(played.spread[0], 2.0 * R)
    assert played.spread[-1, 0] < 1e-3 * R[0]


def test_closed_loops_take_work():
    turn = np.linspace(0.0, 6.0 * np.pi, 3000)
    load = np.sin(turn)
    output = smooth(load).output[1000:]
    work = np.sum(0.5 * (load[1001:] + load[1000:-1])[:, None] * np.diff(output, axis=0), axis=0)
    assert np.all(work > 0.0)


def test_unlike_a_play_it_does_not_return_to_where_it_left():
    """A small loop under load: the play comes back to the same point, this one has moved on."""
    load = np.array([0.0, 1.0, 0.6, 1.0])
    columns = np.tile(load[:, None], (1, 3))
    play = PlayOperators(R).run(columns).output
    np.testing.assert_allclose(play[3], play[1], atol=1e-15)
    assert np.all(smooth(load).output[3] > smooth(load).output[1] + 0.01 * R)


def test_a_threshold_that_is_none_is_rejected():
    with pytest.raises(ValueError, match="threshold is zero"):
        SmoothOperators(np.array([0.1, 0.0]))
    with pytest.raises(ValueError, match="negative"):
        SmoothOperators(np.array([-0.1]))


def test_a_model_may_have_both_kinds_of_plays():
    """Each operator gets its own load, whichever kind stands beside it."""
    samples = recording(seed=5, rate_hz=6.0)
    plays = Operator("tilt", "play", (0.2,)), Operator("roll", "smooth_play", (0.3,))
    both = HysteresisBasis(TIP_M, plays).run()
    alone = [HysteresisBasis(TIP_M, (one,)).run() for one in plays]
    here = samples.rows(samples.segment == 0)
    found = both.rows(here.joints, here.wrench).design
    for k, run in enumerate(alone):
        design = run.rows(here.joints, here.wrench).design
        np.testing.assert_array_equal(found[:, :, 4 + k], design[:, :, 4])
        assert np.abs(design[:, :, 4]).max() > 0.0


def test_what_soft_friction_leaves_at_no_load_is_predicted():
    """Soft friction in every spring, rods included, which never quite slides; on pushes not seen.

    The friction acts on each spring's own motion and follows another law: it bends at once on the
    way back, too.
    """
    samples = recording(seed=6, rate_hz=20.0, sets=2)
    rubbed = _rubbed(samples)
    there = rubbed.set_number == 1
    model = fit(rubbed.rows(~there))
    assert {operator.shape for operator in model.basis.operators} == {"smooth_play"}
    rests = score(rubbed.rows(there), model.predict(rubbed.rows(there))).rests
    gain, noise = rests.gain(slice(0, 3))
    assert abs(gain - 1.0) < 0.1 + 2.0 * noise
    assert "rod" in {operator.place for operator in model.basis.operators}


def _rubbed(samples):
    """Dahl's friction beside each spring: a fifth of its stiffness, half of its largest load."""
    basis = HysteresisBasis(TIP_M, ())
    clean = np.zeros_like(samples.deflection)
    for segment in np.unique(samples.segment):
        rows = samples.segment == segment
        _, _, jacobian, loads = basis.run().loads(samples.joints[rows], samples.wrench[rows])
        for compliance, (place, friction) in zip(Arm().compliances, _FRICTION.items(), strict=True):
            for column in COLUMNS[place]:
                moved = dahl(loads[:, column], 1.0 / compliance, friction, share=0.2)
                clean[rows] += jacobian[:, :, column] * moved[:, None]
    noise = np.random.default_rng(7).normal(size=clean.shape) * NOISE
    return replace(samples, deflection=clean + noise)


_FRICTION = {"roll": 0.3, "tilt": 0.3, "carriage": 3.0, "rod": 12.0}
