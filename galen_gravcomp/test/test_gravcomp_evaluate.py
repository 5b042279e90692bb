# SPDX-License-Identifier: Apache-2.0
"""`evaluate` on tables: every form of orientation, splits without a leak, errors by name."""

import json
from pathlib import Path

import numpy as np
import pytest
from calibration_files import pointer
from galen_bags.arrays.tables import OrientationTable, is_recording, read_table
from galen_gravcomp.evaluate.command import main
from galen_gravcomp.evaluate.table_scores import (
    contiguous_blocks,
    cross_validate,
    evaluate_table,
    identify_chosen,
    plain_model,
    robust_model,
)
from galen_model.arm.galen import GALEN, GRAVITY_M_S2
from galen_model.errors import GalenError
from galen_model.estimation.problem import MIN_POSES_TO_REJECT
from galen_model.files.calibration_file import read_calibration, write_calibration
from galen_model.load.model import Load, gravity_wrench
from galen_model.rotation import matrix_to_quaternion
from scipy.spatial.transform import Rotation

LOAD = Load(0.9, np.array([0.002, -0.001, 0.044]))
OFFSET = np.array([9.0, -1.0, 10.0, 0.4, -0.7, -0.2])
NOISE = np.array([0.05, 0.05, 0.05, 2e-3, 2e-3, 2e-3])
SHARED = Path(__file__).resolve().parents[3] / "shared" / "data" / "real"
needs_shared = pytest.mark.skipif(
    not SHARED.is_dir(), reason="measured data is not beside the checkout"
)


@pytest.fixture
def readings():
    rng = np.random.default_rng(1)
    roll, tilt = rng.uniform(-1.5, 1.5, 30), rng.uniform(-1.0, 0.9, 30)
    rotation = GALEN.rotation(np.stack([roll, tilt], axis=-1))
    gravity = np.einsum("nji,j->ni", rotation, GRAVITY_M_S2)
    wrench = gravity_wrench(gravity, LOAD) + OFFSET + NOISE * rng.standard_normal((30, 6))
    return roll, tilt, rotation, gravity, wrench


@pytest.fixture
def few(readings):
    """The first 14 readings: all models are compared on each of them in turn."""
    return tuple(part[:14] for part in readings)


@pytest.fixture
def fewest(readings):
    """So few that no models are compared."""
    return tuple(part[: MIN_POSES_TO_REJECT - 1] for part in readings)


def write(path, names, columns, separator=","):
    lines = [separator.join(names)] if names else []
    lines += [separator.join(repr(float(v)) for v in row) for row in columns]
    path.write_text("\n".join(lines) + "\n")
    return path


WRENCH = ["fx", "fy", "fz", "tx", "ty", "tz"]


def table_of(gravity, wrench):
    return OrientationTable("t", gravity, wrench, None, None, "gravity")


def test_a_column_of_temperatures_explains_the_drift_that_goes_with_it(tmp_path, readings):
    roll, tilt, _, _, wrench = readings
    kelvin = 300.0 + np.random.default_rng(2).standard_normal(30)
    drifted = wrench + 10.0 * NOISE * (kelvin - 300.0)[:, None]
    rows = np.column_stack([drifted, roll, tilt, kelvin])
    path = write(tmp_path / "warm.csv", [*WRENCH, "roll", "tilt", "temperature_k"], rows)
    table = read_table(path, arm=GALEN)
    np.testing.assert_allclose(table.temperature_c, kelvin - 273.15)
    for name, zero_k in (("temperature [K]", 0.0), ("temperature_k [C]", 273.15)):
        rows[:, -1] = kelvin - zero_k
        other = write(tmp_path / "other.csv", [*WRENCH, "roll", "tilt", name], rows)
        np.testing.assert_allclose(read_table(other, arm=GALEN).temperature_c, kelvin - 273.15)
    chosen = identify_chosen(table.timed())
    assert "temperature" in chosen.words
    assert chosen.single.load.mass_kg == pytest.approx(LOAD.mass_kg, abs=0.01)
    both = write(tmp_path / "both.csv", [*WRENCH, "roll", "tilt", "temp", "temperature"],
                 np.column_stack([rows, kelvin]))  # fmt: skip
    with pytest.raises(GalenError, match="2 columns of temperatures"):
        read_table(both, arm=GALEN)


def test_every_form_of_orientation_reads_the_same(tmp_path, readings):
    roll, tilt, rotation, gravity, wrench = readings
    forms = {
        "joints": (["roll", "tilt"], np.column_stack([roll, tilt])),
        "quaternion": (["qx", "qy", "qz", "qw"], matrix_to_quaternion(rotation)),
        "matrix": ([f"r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3)], rotation.reshape(-1, 9)),
        "gravity": (["gx", "gy", "gz"], gravity),
    }
    for separator in (",", ";", "\t", " "):
        for kind, (names, columns) in forms.items():
            path = write(
                tmp_path / "t.csv", names + WRENCH, np.hstack([columns, wrench]), separator
            )
            table = read_table(path, arm=GALEN)
            assert table.orientation == kind
            np.testing.assert_allclose(table.gravity, gravity, atol=1e-9)
            np.testing.assert_allclose(table.wrench, wrench)


def test_wrenches_in_the_base_are_turned_back(tmp_path, readings):
    _, _, rotation, gravity, wrench = readings
    in_base = np.hstack([np.einsum("nij,nj->ni", rotation, w) for w in np.split(wrench, 2, axis=1)])
    columns = np.hstack([matrix_to_quaternion(rotation), in_base])
    path = write(tmp_path / "t.txt", None, columns)
    table = read_table(path, ["qx", "qy", "qz", "qw", *WRENCH], wrench_frame="base", arm=GALEN)
    np.testing.assert_allclose(table.wrench, wrench, atol=1e-12)
    path = write(tmp_path / "g.csv", ["gx", "gy", "gz", *WRENCH], np.hstack([gravity, wrench]))
    with pytest.raises(GalenError, match=r"wrenches in the base need"):
        read_table(path, wrench_frame="base", arm=GALEN)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("fx,fy,fz,tx,ty,tz\n1,2,3,4,5,6\n", "no orientation"),
        ("fx,fy,fz,tx,ty,roll,tilt\n1,2,3,4,5,6,7\n", "no column 'tz'"),
        ("fx,fy,fz,tx,ty,tz,roll,tilt\n1,2,3,4,5,6,0\n", "line 2 has 7 values"),
        ("fx,fy,fz,tx,ty,tz,roll,tilt\n1,2,3,4,5,x,0,0\n", "line 2, column 'tz': 'x'"),
        ("fx,fy,fz,tx,ty,tz,roll,tilt\n1,2,3,4,5,nan,0,0\n", "every row lacks a number"),
        ("fx [g],fy,fz,tx,ty,tz,roll,tilt\n1,2,3,4,5,6,0,0\n", "has the unit 'g'; expected n or"),
        ("fx,fy,fz,tx [lbf],ty,tz,roll,tilt\n1,2,3,4,5,6,0,0\n", "has the unit 'lbf'"),
        ("fx,fy,fz,tx,ty,tz,roll,pitch,yaw\n1,2,3,4,5,6,0,0,90\n", "are they degrees?"),
        ("fx,fy,fz,tx,ty,tz,roll,tilt\n", "no readings"),
        ("", "no readings"),
        ("1,2,3,4,5,6,7,8\n1,2,3,4,5,6,7,8\n", "line 1 names no columns"),
        ("fx,fx,fy,fz,tx,ty,tz,roll,tilt\n1,1,1,1,1,1,1,1,1\n", "'fx' is there twice"),
        ("fx,fy,fz,tx,ty,tz,qx,qy,qz,qw\n1,2,3,4,5,6,1,1,0,0\n", "line 2: qx qy qz qw"),
        ("fx,fy,fz,tx,ty,tz,gx,gy,gz\n1,2,3,4,5,6,0,0,5\n", "gx gy gz has the length 5"),
        ("fx,fy,fz,tx,ty,tz,roll,tilt\n1,2,3,4,5,inf,0,0\n", "'inf' is not a finite number"),
    ],
)
def test_a_bad_table_is_named(tmp_path, text, message, capsys):
    path = tmp_path / "bad.csv"
    path.write_text(text)
    assert main([str(path)]) == 1
    error = capsys.readouterr().err
    assert "bad.csv" in error
    assert message in error
    assert len(error.strip().splitlines()) == 1


def test_tables_as_others_write_them_read_the_same(tmp_path, readings):
    _, _, rotation, gravity, wrench = readings
    columns = np.hstack([wrench * [1, 1, 1, 1e3, 1e3, 1e3], gravity])
    lines = [",".join(map(repr, row)) for row in columns.tolist()]
    path = tmp_path / "units.csv"
    header = "Fx [N],Fy [N],Fz [N],Tx [N.mm],Ty [N.mm],Mz (Nmm),gx,gy,gz"
    path.write_text("\n".join([header, *lines, "nan" + lines[0][lines[0].index(",") :]]))
    read = read_table(path, arm=GALEN)
    np.testing.assert_allclose(read.wrench, wrench, atol=1e-12)
    assert read.left_out == 1
    german = "\n".join([header, *lines]).replace(",", ";").replace(".", ",").replace("N,mm", "N.mm")
    path.write_text(german)
    np.testing.assert_allclose(read_table(path, arm=GALEN).wrench, wrench, atol=1e-12)
    names = "% [gx, gy, gz, fx, fy, fz, tx, ty, tz]"
    rows = [" ".join(map(repr, row)) for row in np.hstack([gravity, wrench]).tolist()]
    path.write_text("\n".join(["% gravity and f/t readings", names, *rows]))
    np.testing.assert_allclose(read_table(path, arm=GALEN).gravity, gravity, atol=1e-12)
    euler = Rotation.from_matrix(rotation).as_euler("xyz", degrees=True)
    rows = [",".join(map(repr, row)) for row in np.hstack([wrench, euler]).tolist()]
    path.write_text("\n".join(["fx,fy,fz,tx,ty,tz,roll [deg],pitch [deg],yaw [deg]", *rows]))
    np.testing.assert_allclose(read_table(path, arm=GALEN).rotation, rotation, atol=1e-9)


def test_a_table_has_a_verdict_and_a_wrong_set_up_writes_no_file(tmp_path, fewest, capsys):
    _, _, _, gravity, wrench = fewest
    path, tool = tmp_path / "t.csv", tmp_path / "tool.json"
    write(path, ["gx", "gy", "gz", *WRENCH], np.hstack([gravity, wrench]))
    assert main([str(path), "--write-tool", str(tool)]) == 0
    out = capsys.readouterr().out
    assert "The load fits, to" in out and "% of its weight" in out and "bias fx (N)" in out
    tool.unlink()
    for scale, words in (
        ([1, 1, 1, 0, 1, 1], "does not fit: the residual is"),  # a channel is dead
        ([1, 1, 1, 1e3, 1e3, 1e3], "torques are in N.mm"),
    ):
        write(path, ["gx", "gy", "gz", *WRENCH], np.hstack([gravity, wrench * scale]))
        assert main([str(path), "--write-tool", str(tool)]) == 1
        assert words in capsys.readouterr().err
        assert not tool.exists()
    assert main([str(path), "--write-tool", str(tool), "--no-setup-check"]) == 0
    assert tool.exists()


def test_many_poses_that_do_not_follow_each_other_are_no_recording():
    rng = np.random.default_rng(8)
    gravity = rng.normal(size=(600, 3))
    gravity *= 9.80665 / np.linalg.norm(gravity, axis=1, keepdims=True)
    assert not is_recording(table_of(gravity, gravity_wrench(gravity, LOAD)))


@pytest.mark.slow
def test_a_long_table_is_averaged_and_told_at_once(tmp_path, readings, capsys):
    _, _, _, gravity, wrench = readings
    rows = np.repeat(np.hstack([gravity, wrench]), 50, axis=0)
    rows[:, 3:] += 1e-3 * np.random.default_rng(9).normal(size=(1500, 6))
    path = tmp_path / "long.csv"
    write(path, ["gx", "gy", "gz", *WRENCH], rows)
    assert main([str(path), "--json"]) == 0
    captured = capsys.readouterr()
    assert "1500 rows look like a recording" in captured.err
    content = json.loads(captured.out)
    assert (content["rows"], content["readings"]) == (1500, 200)
    assert content["fits"] is True


def test_held_out_readings_never_reach_the_fit():
    """A model that remembers what it saw scores perfectly only if the split leaks."""
    rng = np.random.default_rng(2)
    gravity, wrench = rng.standard_normal((20, 3)), rng.standard_normal((20, 6))
    groups = contiguous_blocks(20, 4)
    seen = []

    def memory(known):
        seen.append(len(known))
        return lambda asked: np.array(
            [
                known.wrench[np.flatnonzero((known.gravity == g).all(axis=1))[0]]
                if (known.gravity == g).all(axis=1).any()
                else np.zeros(6)
                for g in asked.gravity
            ]
        )

    score = cross_validate(table_of(gravity, wrench), groups, memory)
    np.testing.assert_allclose(score.residuals, wrench)
    assert seen == [15] * 4


def test_scores_are_the_noise_on_clean_readings(readings):
    _, _, _, gravity, wrench = readings
    groups = np.arange(30)
    for model in (plain_model, robust_model):
        rmse = cross_validate(table_of(gravity, wrench), groups, model).rmse
        # ten parameters of 180 numbers leave the held-out error a little above the noise
        np.testing.assert_allclose(rmse / NOISE, 1.1, atol=4 / np.sqrt(60))


def test_scores_tell_how_far_they_are(fewest):
    _, _, _, gravity, wrench = fewest
    told = []
    evaluate_table(table_of(gravity, wrench), progress=lambda *one: told.append(one))
    texts, done, totals = zip(*told, strict=True)
    assert len(set(totals)) == 1 and done[0] == 0.0 and np.all(np.diff(done) > 0.0)
    assert 0.5 < done[-1] / totals[0] < 1.0 and "plain least squares" in texts[0]


def recording(noise, rng):
    """Four stops of 6 s at 20 Hz with moves of 3 s between them."""
    time = np.arange(0.0, 36.0, 0.05)
    stops = np.array([[0.0, 0.0], [1.2, -0.5], [-1.0, 0.7], [0.4, -0.9]])
    phase, into = np.minimum((time // 9).astype(int), 3), time % 9
    blend = np.clip((into - 6) / 3, 0.0, 1.0)[:, None]
    joints = stops[phase] * (1 - blend) + stops[np.minimum(phase + 1, 3)] * blend
    rotation = GALEN.rotation(joints)
    gravity = np.einsum("nji,j->ni", rotation, GRAVITY_M_S2)
    wrench = gravity_wrench(gravity, LOAD) + OFFSET + noise * rng.standard_normal((len(time), 6))
    return time, joints, gravity, wrench


def test_a_recording_is_scored_by_stops_and_its_json_is_whole(tmp_path, capsys):
    time, joints, _, wrench = recording(NOISE, np.random.default_rng(4))
    path = write(
        tmp_path / "r.csv", ["t", "roll", "tilt", *WRENCH], np.column_stack([time, joints, wrench])
    )
    assert main([str(path), "--average-s", "1", "--json"]) == 0
    content = json.loads(capsys.readouterr().out)
    assert content["still_phases"] == 4
    assert content["load"]["mass_kg"] == pytest.approx(0.9, abs=0.05)
    held_out = content["scores"]["leave one still phase out"]["galen"]
    assert held_out["groups"] == 4
    assert held_out["rmse"]["fx"] < 5 * NOISE[0]
    # two of four stops tell too little: the suite's model says so instead of a number
    blocks = content["scores"]["2 blocks of neighbours"]
    assert blocks["galen"]["rmse"] is None
    assert "the poses hold no information about" in blocks["galen"]["rejected"][0]


def test_a_tool_file_is_scored_beside_the_fits(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("galen_model.load.choice.MIN_POSES_TO_REJECT", 1000)  # the fits are plain
    rng = np.random.default_rng(6)
    tool = pointer()
    write_calibration(tmp_path / "pointer.json", tool)
    joints = np.column_stack([rng.uniform(-1.5, 1.5, 40), rng.uniform(-1.0, 0.9, 40)])
    noise = NOISE * 0.1
    wrench = tool.predict(joints) + noise * rng.standard_normal((40, 6))
    path = write(tmp_path / "t.csv", ["roll", "tilt", *WRENCH], np.hstack([joints, wrench]))
    assert main([str(path), "--tool", str(tmp_path / "pointer.json"), "--json"]) == 0
    rmse = json.loads(capsys.readouterr().out)["tool"]["rmse"]
    np.testing.assert_allclose(np.array(list(rmse.values())) / noise, 1.0, atol=4 / np.sqrt(80))


@pytest.mark.parametrize("count", [1, 2, 3])
def test_a_table_too_short_to_split_is_said(tmp_path, capsys, count):
    path = tmp_path / "short.csv"
    rows = "".join(f"1,2,3,4,5,{k},0,0\n" for k in range(count))
    path.write_text(f"fx,fy,fz,tx,ty,tz,roll,tilt\n{rows}")
    assert main([str(path)]) == 1
    assert capsys.readouterr().err == (
        f"evaluate: {path}: {count} readings; at least 4 are needed to hold some out\n"
    )


@needs_shared
def test_axia80_over_time_gives_the_known_weight():
    table = read_table(
        SHARED / "axia80" / "GP2025-07-22-22-06-02.txt",
        ["t", *WRENCH, "qx", "qy", "qz", "qw"],
        arm=GALEN,
    )
    result = evaluate_table(table, average_window_s=1.0)
    assert result.phases == 6
    weight = result.fit.load.mass_kg * 9.80665
    assert weight == pytest.approx(11.41, abs=3 * result.fit.load.mass_std_kg * 9.80665)


def test_readings_of_no_common_load_are_said_and_no_file_is_written(tmp_path, few, capsys):
    roll, tilt, _, _, wrench = few
    wrench = wrench.copy()
    wrench[::2] *= 3.0
    table = write(
        tmp_path / "t.csv", ["roll", "tilt", *WRENCH], np.column_stack([roll, tilt, wrench])
    )
    assert main([str(table)]) == 0
    printed = capsys.readouterr().out
    assert "The load does not fit" in printed
    assert "7 of 14 could not be scored" in printed
    assert main([str(table), "--write-tool", str(tmp_path / "tool.json")]) == 1
    assert "tool.json is not written: The load does not fit" in capsys.readouterr().err
    assert not (tmp_path / "tool.json").exists()


@pytest.mark.parametrize("kind", ["joints", pytest.param("gravity", marks=pytest.mark.slow)])
def test_a_tool_file_from_a_table_reads_what_the_fit_reads(tmp_path, few, kind):
    roll, tilt, _, gravity, wrench = few
    local = 9.8209 / 9.80665  # gravity at 60 degrees north
    names, columns = {
        "joints": (["roll", "tilt"], np.column_stack([roll, tilt])),
        "gravity": (["gx", "gy", "gz"], gravity * local),
    }[kind]
    wrench = wrench.copy()
    wrench[3, 0] += 5.0
    table = write(tmp_path / "t.csv", names + WRENCH, np.hstack([columns, wrench]), ",")
    path = tmp_path / "tools" / "gripper.json"
    assert main([str(table), "--write-tool", str(path), "--json"]) == 0
    tool = read_calibration(path, arm=GALEN)
    fit = identify_chosen(read_table(table, arm=GALEN).timed()).single
    under = gravity * (local if kind == "gravity" else 1.0)
    assert tool.predict(np.stack([roll, tilt], axis=-1)) == pytest.approx(
        fit.predict(under), rel=1e-12, abs=1e-12
    )
    assert tool.adapter.mass_kg == 0.0
    assert "adapter" in tool.unresolved[0]
    assert (tool.tool, tool.poses_used) == ("gripper", 13)
    assert tool.poses_rejected == ("reading 4: off the common load",)
    left = (wrench - fit.predict(under))[fit.used]
    assert tool.rmse == pytest.approx(np.sqrt(np.mean(left**2, axis=0)))


@pytest.mark.parametrize(
    ("name", "message"), [("gripper", "named <tool>.json"), ("a b.json", "letters, digits")]
)
def test_a_tool_file_of_another_name_is_rejected_before_anything_is_done(
    tmp_path, name, message, capsys
):
    assert main([str(tmp_path / "no.csv"), "--write-tool", str(tmp_path / name)]) == 1
    assert message in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
