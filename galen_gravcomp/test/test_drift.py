# SPDX-License-Identifier: Apache-2.0
"""`drift`: Allan deviation against analytic values, and truths that the answer must name."""

import dataclasses
import json
from types import SimpleNamespace

import numpy as np
import pytest
from galen_gravcomp.evaluate.command import main
from galen_gravcomp.evaluate.drift import allan_deviation, judge_drift
from galen_gravcomp.evaluate.drift_series import series_of
from galen_model.errors import GalenError
from galen_model.load.verdict import Limits
from galen_model.rest.binned import CellReducer, Cells

UNITS = np.array([1.0, 1.0, 1.0, 0.02, 0.02, 0.02])


def test_white_noise_and_random_walk_have_their_analytic_deviations():
    """sigma / sqrt(m) of white noise; q sqrt((2 m^2 + 1) / (6 m)) of a walk of steps q."""
    rng = np.random.default_rng(0)
    white = allan_deviation(0.02 * rng.standard_normal(20000), 0.1)
    m = white.tau_s / 0.1
    early = m < 500
    np.testing.assert_allclose(white.deviation[early], 0.02 / np.sqrt(m[early]), rtol=0.15)
    assert white.white == pytest.approx(0.02 * np.sqrt(0.1), rel=0.03)
    assert np.mean((white.low < 0.02 / np.sqrt(m)) & (0.02 / np.sqrt(m) < white.high)) > 0.7
    walk = allan_deviation(np.cumsum(0.003 * rng.standard_normal(20000)), 1.0)
    m = walk.tau_s
    expected = 0.003 * np.sqrt((2.0 * m**2 + 1.0) / (6.0 * m))
    np.testing.assert_allclose(walk.deviation[m < 300], expected[m < 300], rtol=0.2)
    assert walk.walk == pytest.approx(0.003, rel=0.15)
    ramp = allan_deviation(0.5 * np.arange(1000.0), 1.0)
    assert ramp.ramp == pytest.approx(0.5, rel=1e-3)


def test_an_arm_that_moves_between_its_stops_hides_neither_noise_nor_walk():
    """Two of six cells missing, over and over, as where it holds for 4 s and moves for 2 s."""
    rng = np.random.default_rng(4)
    cells = 0.02 * rng.standard_normal(20000) + np.cumsum(0.003 * rng.standard_normal(20000))
    cells[np.arange(20000) % 6 >= 4] = np.nan
    found = allan_deviation(cells, 1.0)
    assert found.tau_s[-1] > 1000.0
    assert found.walk == pytest.approx(0.003, rel=0.15)
    assert found.white == pytest.approx(0.02, rel=0.05)
    assert np.all(allan_deviation(np.zeros(100), 1.0).deviation == 0.0)


def no_joints():
    return CellReducer(1.0).finish()


def cells_of(reading):
    count = len(reading)
    start = np.arange(count) * 1_000_000_000
    two = np.zeros((count, 2))
    squares = np.full((count, 6), 500 * 1e-4) * UNITS**2
    return Cells(start, start + 990_000_000, np.full(count, 500), reading, squares, two, two, 1.0)


def test_a_hand_is_left_out_and_a_jump_that_stays_is_told():
    rng = np.random.default_rng(1)
    reading = 0.002 * rng.standard_normal((7200, 6)) * UNITS
    reading[3000:3040] += 2.0 * UNITS
    reading[5000:] += 0.1 * UNITS
    series = series_of("x", cells_of(reading), no_joints(), None)
    assert len(series.contact_s) == 1
    begin, end = series.contact_s[0]
    assert 2990 <= begin <= 3000
    assert 3040 <= end <= 3050
    ((at_s, change),) = series.steps
    assert at_s == pytest.approx(5000, abs=60)
    np.testing.assert_allclose(change / UNITS, 0.1, atol=0.01)
    assert np.nanmax(np.abs(series.reading[:4900])) < 0.02


def test_cells_in_motion_are_not_the_sensor_s_noise_and_wild_stamps_are_rejected():
    rng = np.random.default_rng(5)
    cells = cells_of(0.002 * rng.standard_normal((600, 6)) * UNITS)
    moving = np.arange(600) % 6 >= 4
    cells.squares[moving] *= 100.0
    joints = dataclasses.replace(cells, spans=np.where(moving[:, None], 0.3, 0.0) * np.ones(2))
    joints.angles[300:] = 0.5
    tool = SimpleNamespace(predict=lambda angles: np.zeros((len(angles), 6)))
    series = series_of("x", cells, joints, tool)
    np.testing.assert_allclose(series.noise, 0.01 * np.sqrt(500 / 499) * UNITS)
    assert "several poses" in series.notes[1]
    cells.start_ns[-1] += 10**17
    with pytest.raises(GalenError, match=r"longest gap is 2.78e\+04 h"):
        series_of("x", cells, no_joints(), None)


def test_how_long_a_tare_holds():
    """A walk of 0.1 N/sqrt(h) is 0.05 N off after a quarter of an hour."""
    rng = np.random.default_rng(2)
    reading = np.cumsum(rng.standard_normal((20000, 6)), axis=0) / 60.0 * 0.1 * UNITS
    result = judge_drift(series_of("x", cells_of(reading), no_joints(), None), Limits())
    assert result.holds_s["force"] == pytest.approx(900.0, rel=0.4)
    assert "re-tare every" in result.sentence["force"]


def test_the_command_on_a_table(tmp_path, capsys):
    rng = np.random.default_rng(3)
    table = tmp_path / "still.csv"
    reading = 0.01 * rng.standard_normal((2000, 6)) * UNITS
    columns = np.column_stack([np.arange(2000) / 10.0, reading])
    np.savetxt(table, columns, delimiter=",", header="t,fx,fy,fz,tx,ty,tz", comments="")
    assert main([str(table), "--drift", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["samples"] == 2000
    assert found["axes"]["fx"]["white_per_sqrt_hz"] == pytest.approx(0.01 / np.sqrt(10), rel=0.2)
    parts = [str(tmp_path / name) for name in ("early.csv", "late.csv")]
    for part, rows in zip(parts, np.split(columns + [1.7e9, 0, 0, 0, 0, 0, 0], 2), strict=True):
        np.savetxt(part, rows, delimiter=",", header="t,fx,fy,fz,tx,ty,tz", comments="")
    assert main([*parts, "--drift", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["duration_s"] == pytest.approx(200.0, abs=1.0)
    assert main([*parts[::-1], "--drift"]) == 1
    assert "the stamps jump back" in capsys.readouterr().err
    assert main([str(table), "--drift", "--cell-s", "0.05"]) == 1
    assert "2000 of 3999 cells of 0.05 s hold readings" in capsys.readouterr().err
    np.savetxt(table, reading, delimiter=",", header="fx,fy,fz,tx,ty,tz", comments="")
    assert main([str(table), "--drift"]) == 1
    assert "no column 't'" in capsys.readouterr().err
    assert main([str(tmp_path / "nothing"), "--drift"]) == 1
    for wrong in (("--cell-s", "1e-10"), ("--gravity", "0", "0", "0")):
        with pytest.raises(SystemExit) as ended:
            main([str(table), "--drift", *wrong])
        assert ended.value.code == 2
