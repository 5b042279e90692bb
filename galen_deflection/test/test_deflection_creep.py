"""Kelvin-Voigt elements: against closed forms, a stiff ODE solver, and however they are cut."""

import numpy as np
import pytest
from galen_deflection.springs.creep import LagOperators
from scipy.integrate import solve_ivp

TAU = np.array([0.3, 2.0, 15.0])


def lag(stamp_s, load, tau=TAU):
    columns = np.tile(np.asarray(load, dtype=float)[:, None], (1, len(tau)))
    return LagOperators(tau).run(np.round(np.asarray(stamp_s) * 1e9).astype(np.int64), columns)


def test_a_load_that_comes_at_once_and_stays():
    """1 - exp(-t / tau), after a rise of a nanosecond."""
    time = np.concatenate([[0.0, 1e-9], np.linspace(0.01, 30.0, 50)])
    load = np.where(time > 0.0, 4.0, 0.0)
    expected = 4.0 * (1.0 - np.exp(-time[:, None] / TAU))
    np.testing.assert_allclose(lag(time, load).output, expected, atol=1e-7)


def test_uneven_samples_of_a_piecewise_straight_load_are_exact():
    rng = np.random.default_rng(0)
    time = np.cumsum(rng.uniform(0.002, 0.8, 60))
    load = rng.normal(size=60)
    load[0] = 0.0
    steps = [
        solve_ivp(
            lambda t, y: (np.interp(t, time, load) - y) / TAU,
            (time[0], time[-1]), np.zeros(3), t_eval=time, rtol=1e-9, atol=1e-11, max_step=0.02,
        ).y.T
    ]  # fmt: skip
    np.testing.assert_allclose(lag(time, load).output, steps[0], atol=2e-5)
    # Between two corners nothing depends on where it is looked at.
    finer = np.union1d(time, np.linspace(time[0], time[-1], 400))
    looked = lag(finer, np.interp(finer, time, load)).output
    np.testing.assert_allclose(
        looked[np.searchsorted(finer, time)], lag(time, load).output, atol=1e-7
    )


def test_cut_into_calls_it_is_the_same_to_the_last_bit():
    rng = np.random.default_rng(1)
    stamp = np.cumsum(rng.integers(1, 10**8, 200))
    inputs = rng.normal(size=(200, 3))
    whole = LagOperators(TAU).run(stamp, inputs)
    parts = LagOperators(TAU)
    cut = [parts.run(stamp[a:b], inputs[a:b]) for a, b in ((0, 1), (1, 77), (77, 78), (78, 200))]
    np.testing.assert_array_equal(np.concatenate([p.output for p in cut]), whole.output)
    np.testing.assert_array_equal(np.concatenate([p.unknown for p in cut]), whole.unknown)


def test_stamps_that_stand_or_go_back_move_nothing():
    stamps = np.array([0, 10**9, 10**9, 5 * 10**8, 2 * 10**9])
    inputs = np.full((5, 3), 2.0)
    crept = LagOperators(TAU).run(stamps, inputs)
    assert np.all(crept.output[1] == crept.output[2]) and np.all(crept.output[1] == crept.output[3])
    alone = LagOperators(TAU).run(stamps[[0, 1, 4]], inputs[:3])
    np.testing.assert_array_equal(crept.output[4], alone.output[2])


def test_what_a_start_under_load_leaves_unknown_covers_every_past():
    """Pasts of any length under the same load: the mean square distance over uniform starts."""
    time = np.linspace(0.0, 4.0, 40)
    crept = lag(time, np.full(40, 3.0))
    starts = np.linspace(0.0, 3.0, 20001)
    truth = 3.0 + (starts[:, None, None] - 3.0) * np.exp(-time[:, None] / TAU)
    distance = np.sqrt(np.mean((truth - crept.output) ** 2, axis=0))
    np.testing.assert_allclose(crept.unknown, distance, rtol=1e-4)
    assert np.all(lag(time, np.concatenate([[0.0], np.full(39, 3.0)])).unknown == 0.0)


def test_a_long_gap_ends_at_the_load():
    assert lag([0.0, 1e6], [0.0, 2.0]).output[1] == pytest.approx([2.0] * 3, rel=1e-4)


def test_a_time_constant_that_is_none_is_rejected():
    with pytest.raises(ValueError, match="time constant"):
        LagOperators(np.array([1.0, 0.0]))
