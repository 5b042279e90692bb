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


def write(path, gravity, mass_kg, draws, more, added=0.0, late=0):
    """Write the readings of a load under gravity (n, 3), `late` rows late; more: (6, 6) or None."""
    force = mass_kg * gravity
    wrench = np.hstack([force, np.cross([0.0, 0.01, 0.05], force)])
    wrench = wrench + wrench @ OWN.T + (0.0 if more is None else wrench @ more.T) + added
    wrench = np.vstack([np.repeat(wrench[:1], late, axis=0), wrench])[: len(gravity)]
    noise = draws.standard_normal(wrench.shape) * ([0.02] * 3 + [0.001] * 3)
    rows = np.hstack([wrench + noise + draws.standard_normal(6), gravity])
    np.savetxt(path, rows, delimiter=",", header=NAMES, comments="")
    return str(path)


def of_earths_size(direction):
    return 9.80665 * direction / np.linalg.norm(direction, axis=1, keepdims=True)


def table(path, seed, more=None, count=24, along_axes=False, drift=0.0):
    draws = np.random.default_rng(seed)
    direction = draws.standard_normal((count, 3))
    if along_axes:  # as readings are taken by hand: a few directions, again and again
        direction = np.vstack([np.eye(3), -np.eye(3)[1:]])[np.arange(count) % 5]
    course = np.cumsum(draws.standard_normal((count, 6)), axis=0) / np.sqrt(count)
    return write(path, of_earths_size(direction), 0.9, draws, more, drift * course)


def added_crosstalk(to, source):
    added = np.zeros((6, 6))
    added[to, source] = 0.03
    return added


def run(tmp_path, *arguments):
    command = ["--json", "--no-report", "--overwrite", "--output", str(tmp_path / "out")]
    return main([*arguments, *command])


def answer(tmp_path, capsys, later, earlier):
    assert run(tmp_path, later, "--reference", earlier) == 0
    return json.loads(capsys.readouterr().out)


def error(tmp_path, capsys, later, earlier, *options):
    assert run(tmp_path, later, "--reference", earlier, *options) == 1
    return capsys.readouterr().err


@pytest.mark.slow
def test_only_what_was_added_since_is_a_cause(tmp_path, capsys):
    earlier = table(tmp_path / "earlier.csv", 1)
    later = table(tmp_path / "later.csv", 2, added_crosstalk(1, 2))
    found = answer(tmp_path, capsys, later, earlier)
    assert found["reference"] == ["earlier"]
    (cause,) = found["causes"]
    assert (cause["effect"], cause["parameters"]["from"]) == ("crosstalk", "fz")
    low, high = cause["parameters"]["coefficient"]["ci95"]
    assert cause["parameters"]["to"] == "fy" and low < 0.03 < high
    same = table(tmp_path / "same.csv", 3)
    assert answer(tmp_path, capsys, same, earlier)["verdict"] == "none"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("effect", "added"),
    [
        ("crosstalk", added_crosstalk(1, 0)),
        # a part is missing at the sensor's own centre
        ("tool_mass_error", np.diag([-0.03] * 3 + [0.0] * 3)),
    ],
)
def test_readings_under_the_same_gravity_tell_of_each_other(tmp_path, capsys, effect, added):
    """What shows under one direction of gravity alone is found, though no other predicts it."""
    earlier = table(tmp_path / "earlier.csv", 1, count=15, along_axes=True)
    later = table(tmp_path / "later.csv", 2, added, count=15, along_axes=True)
    (cause,) = answer(tmp_path, capsys, later, earlier)["causes"]
    assert cause["effect"] == effect
    if effect == "tool_mass_error":
        assert cause["parameters"]["delta_kg"]["value"] == pytest.approx(-0.027, rel=0.1)


@pytest.mark.slow
def test_a_drift_that_the_reference_has_too_is_no_change(tmp_path, capsys):
    earlier = table(tmp_path / "earlier.csv", 1, count=40, drift=0.3)
    later = table(tmp_path / "later.csv", 2, count=40, drift=0.3)
    assert answer(tmp_path, capsys, later, earlier)["verdict"] == "none"
    drifts = table(tmp_path / "drifts.csv", 3, count=40, drift=3.0)
    assert answer(tmp_path, capsys, drifts, earlier)["verdict"] != "none"


def moving_table(path, seed, more=None, stops=7, stop=40, way=25):
    """Write an arm's way through stops, reading by reading: forces come late while it turns."""
    at = np.random.default_rng(0).standard_normal((stops, 3))  # the same stops on both days
    pieces = [
        piece
        for here, there in itertools.pairwise(at)
        for piece in (np.tile(here, (stop, 1)), np.linspace(here, there, way + 2)[1:-1])
    ]
    gravity = of_earths_size(np.concatenate(pieces))
    return write(path, gravity, 1.2, np.random.default_rng(seed), more, late=3)


@pytest.mark.slow
def test_readings_between_stops_are_left_out(tmp_path, capsys):
    earlier = moving_table(tmp_path / "earlier.csv", 1)
    found = answer(tmp_path, capsys, moving_table(tmp_path / "later.csv", 2), earlier)
    assert found["verdict"] == "none"
    assert any("averages" in note and "in rest segments" in note for note in found["notes"])
    later = moving_table(tmp_path / "later.csv", 2, added_crosstalk(1, 2))
    (cause,) = answer(tmp_path, capsys, later, earlier)["causes"]
    assert (cause["effect"], cause["parameters"]["from"]) == ("crosstalk", "fz")


@pytest.mark.parametrize("count", [4, 5])
def test_too_few_readings_are_no_reference(tmp_path, capsys, count):
    few = table(tmp_path / "few.csv", 1, count=count)
    told = error(tmp_path, capsys, table(tmp_path / "later.csv", 2), few)
    assert f"{few}: {count} readings are too few for a reference, which takes 6 or more" in told


def test_directions_in_a_plane_are_no_reference(tmp_path, capsys):
    in_plane = of_earths_size(np.random.default_rng(1).standard_normal((24, 3)) * [1, 1, 0])
    flat = write(tmp_path / "flat.csv", in_plane, 0.9, np.random.default_rng(1), None)
    told = error(tmp_path, capsys, table(tmp_path / "later.csv", 2), flat)
    assert "too few directions of gravity" in told


@pytest.mark.parametrize("option", ["--noise", "--tool"])
def test_what_a_reference_replaces_is_not_ignored(tmp_path, capsys, option):
    earlier = table(tmp_path / "earlier.csv", 1)
    told = error(tmp_path, capsys, table(tmp_path / "later.csv", 2), earlier, option, earlier)
    assert f"{option} beside --reference" in told
