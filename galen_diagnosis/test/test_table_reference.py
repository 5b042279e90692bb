# SPDX-License-Identifier: Apache-2.0
"""Tables since an earlier one of the same sensor and load: its own errors cancel."""

import itertools
import json

import numpy as np
import pytest
from galen_diagnosis.diagnose import main

NAMES = "fx,fy,fz,tx,ty,tz,gx,gy,gz"
OWN = np.diag([0.03, -0.04, 0.02, 0.0, 0.0, 0.0])
"""What this sensor reads wrong on both days."""


def table(path, seed, more=None, count=24, along_axes=False, drift=0.0):
    draws = np.random.default_rng(seed)
    direction = draws.standard_normal((count, 3))
    if along_axes:  # as readings are taken by hand: a few directions, again and again
        direction = np.vstack([np.eye(3), -np.eye(3)[1:]])[np.arange(count) % 5]
    gravity = 9.80665 * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    force = 0.9 * gravity
    wrench = np.hstack([force, np.cross([0.0, 0.01, 0.05], force)])
    wrench = wrench + wrench @ OWN.T + (0.0 if more is None else wrench @ more.T)
    course = np.cumsum(draws.standard_normal((count, 6)), axis=0) / np.sqrt(count)
    wrench = wrench + drift * course
    noise = draws.standard_normal(wrench.shape) * ([0.02] * 3 + [0.001] * 3)
    rows = np.hstack([wrench + noise + draws.standard_normal(6), gravity])
    np.savetxt(path, rows, delimiter=",", header=NAMES, comments="")
    return str(path)


def answer(tmp_path, capsys, *arguments):
    command = ["--json", "--no-report", "--overwrite", "--output", str(tmp_path / "out")]
    code = main([*arguments, *command])
    out, err = capsys.readouterr()
    return (json.loads(out) if code == 0 else err), code


@pytest.mark.slow
def test_only_what_was_added_since_is_a_cause(tmp_path, capsys):
    earlier = table(tmp_path / "earlier.csv", 1)
    added = np.zeros((6, 6))
    added[1, 2] = 0.03
    later = table(tmp_path / "later.csv", 2, added)
    found, code = answer(tmp_path, capsys, later, "--reference", earlier)
    assert code == 0 and found["reference"] == ["earlier"]
    (cause,) = found["causes"]
    assert (cause["effect"], cause["parameters"]["from"]) == ("crosstalk", "fz")
    low, high = cause["parameters"]["coefficient"]["ci95"]
    assert cause["parameters"]["to"] == "fy" and low < 0.03 < high
    same = table(tmp_path / "same.csv", 3)
    found, code = answer(tmp_path, capsys, same, "--reference", earlier)
    assert code == 0 and found["verdict"] == "none"


@pytest.mark.slow
@pytest.mark.parametrize("effect", ["crosstalk", "tool_mass_error"])
def test_readings_under_the_same_gravity_tell_of_each_other(tmp_path, capsys, effect):
    """What shows under one direction of gravity alone is found, though no other predicts it."""
    earlier = table(tmp_path / "earlier.csv", 1, count=15, along_axes=True)
    added = np.zeros((6, 6))
    if effect == "crosstalk":
        added[1, 0] = 0.03
    else:
        added[:3, :3] = -0.03 * np.eye(3)  # a part is missing at the sensor's own centre
    later = table(tmp_path / "later.csv", 2, added, count=15, along_axes=True)
    found, code = answer(tmp_path, capsys, later, "--reference", earlier)
    assert code == 0
    (cause,) = found["causes"]
    assert cause["effect"] == effect
    if effect == "tool_mass_error":
        assert cause["parameters"]["delta_kg"]["value"] == pytest.approx(-0.027, rel=0.1)


@pytest.mark.slow
def test_a_drift_that_the_reference_has_too_is_no_change(tmp_path, capsys):
    earlier = table(tmp_path / "earlier.csv", 1, count=40, drift=0.3)
    later = table(tmp_path / "later.csv", 2, count=40, drift=0.3)
    found, code = answer(tmp_path, capsys, later, "--reference", earlier)
    assert code == 0 and found["verdict"] == "none"
    drifts = table(tmp_path / "drifts.csv", 3, count=40, drift=3.0)
    found, code = answer(tmp_path, capsys, drifts, "--reference", earlier)
    assert code == 0 and found["verdict"] != "none"


def moving_table(path, seed, more=None, stops=7, stop=40, way=25):
    """Write an arm's way through stops, reading by reading: forces come late while it turns."""
    draws = np.random.default_rng(seed)
    at = np.random.default_rng(0).standard_normal((stops, 3))  # the same stops on both days
    gravity = np.concatenate(
        [
            piece
            for here, there in itertools.pairwise(at)
            for piece in (np.tile(here, (stop, 1)), np.linspace(here, there, way + 2)[1:-1])
        ]
    )
    gravity *= 9.80665 / np.linalg.norm(gravity, axis=1, keepdims=True)
    force = 1.2 * gravity
    wrench = np.hstack([force, np.cross([0.0, 0.01, 0.05], force)])
    wrench = wrench + wrench @ OWN.T + (0.0 if more is None else wrench @ more.T)
    wrench = np.vstack([np.repeat(wrench[:1], 3, axis=0), wrench])[: len(gravity)]
    noise = draws.standard_normal(wrench.shape) * ([0.02] * 3 + [0.001] * 3)
    rows = np.hstack([wrench + noise + draws.standard_normal(6), gravity])
    np.savetxt(path, rows, delimiter=",", header=NAMES, comments="")
    return str(path)


@pytest.mark.slow
def test_readings_between_stops_are_left_out(tmp_path, capsys):
    earlier = moving_table(tmp_path / "earlier.csv", 1)
    later = moving_table(tmp_path / "later.csv", 2)
    found, code = answer(tmp_path, capsys, later, "--reference", earlier)
    assert code == 0 and found["verdict"] == "none"
    assert any("averages" in note and "in rest segments" in note for note in found["notes"])
    added = np.zeros((6, 6))
    added[1, 2] = 0.03
    later = moving_table(tmp_path / "later.csv", 2, added)
    found, code = answer(tmp_path, capsys, later, "--reference", earlier)
    (cause,) = found["causes"]
    assert (cause["effect"], cause["parameters"]["from"]) == ("crosstalk", "fz")


@pytest.mark.parametrize("count", [4, 5])
def test_too_few_readings_are_no_reference(tmp_path, capsys, count):
    few = table(tmp_path / "few.csv", 1, count=count)
    said, code = answer(tmp_path, capsys, table(tmp_path / "later.csv", 2), "--reference", few)
    assert code == 1
    assert f"{few}: {count} readings are too few for a reference, which takes 6 or more" in said


def test_directions_in_a_plane_are_no_reference(tmp_path, capsys):
    flat = tmp_path / "flat.csv"
    rows = np.loadtxt(table(flat, 1), delimiter=",", skiprows=1)
    rows[:, 8] = 0.0
    rows[:, 6:] *= 9.80665 / np.linalg.norm(rows[:, 6:], axis=1, keepdims=True)
    np.savetxt(flat, rows, delimiter=",", header=NAMES, comments="")
    said, code = answer(
        tmp_path, capsys, table(tmp_path / "later.csv", 2), "--reference", str(flat)
    )
    assert code == 1 and "too few directions of gravity" in said


@pytest.mark.parametrize("option", ["--noise", "--tool"])
def test_what_a_reference_replaces_is_not_ignored(tmp_path, capsys, option):
    earlier = table(tmp_path / "earlier.csv", 1)
    later = table(tmp_path / "later.csv", 2)
    said, code = answer(tmp_path, capsys, later, "--reference", earlier, option, earlier)
    assert code == 1 and f"{option} beside --reference" in said
