# SPDX-License-Identifier: Apache-2.0
"""`evaluate` of a joint: tables in, sentences and numbers out; networks; the measured sets."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
from galen_bags.arrays.joint_table import JointColumns, read_joint_run, read_joint_runs
from galen_deflection.evaluate import main
from galen_model.errors import GalenError
from joint_synthetic import RATE_HZ, STIFFNESS, lost_run, spring_run, write_csv

REAL = Path(__file__).resolve().parents[3] / "shared" / "data" / "real"
measured = pytest.mark.skipif(not REAL.is_dir(), reason="measured data is not beside the checkout")


def edited(path, line, text):
    lines = path.read_text().splitlines()
    lines[line - 1] = text
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.fixture
def table(tmp_path):
    return write_csv(tmp_path / "run.csv", spring_run("run", 1, 1e-5, seconds=2.0))


# --- tables ---------------------------------------------------------------------------------------


def test_columns_gears_and_senses(tmp_path):
    run = spring_run("geared", 1, 1e-5, seconds=2.0)
    shaft = replace(run, link=-run.link, torque=run.torque / -100.0)
    file = write_csv(tmp_path / "geared.csv", shaft, "ms,q_m,q_l,tau")
    columns = JointColumns("ms", "q_m", "q_l", "tau", 1e-3, True, -100.0)
    read = read_joint_run(file, columns)
    assert read.name == "geared"
    assert read.lag == pytest.approx(run.lag, abs=1e-8)
    assert read.torque == pytest.approx(run.torque)
    assert read.time_s == pytest.approx(1e-3 * run.time_s)
    in_ms, header = replace(run, time_s=1e3 * run.time_s), "time [ms],motor,link [rad],tau [mNm]"
    file = write_csv(tmp_path / "units.csv", in_ms, header)
    read = read_joint_run(file, JointColumns(t="time", torque="tau"))
    assert read.torque == pytest.approx(1e-3 * run.torque)
    assert read.time_s == pytest.approx(run.time_s)


def test_stamps_that_cannot_be_are_told_with_their_line(table, tmp_path):
    text = table.read_text()
    edited(table, 12, text.splitlines()[10])
    with pytest.raises(GalenError, match=r"run.csv: line 12: the time 0.09 in column 't' does not"):
        read_joint_run(table, JointColumns())
    table.write_text("\n".join(text.splitlines()[:40] + text.splitlines()[60:]) + "\n")
    with pytest.raises(GalenError, match=r"run.csv: line 41: 0.21 after the reading before it"):
        read_joint_run(table, JointColumns())
    fast = spring_run("fast", 1, 1e-5, seconds=2.0)
    file = write_csv(tmp_path / "fast.csv", replace(fast, time_s=1e-3 * fast.time_s))
    with pytest.raises(GalenError, match=r"fast.csv: column 't' steps by 1e-05; .* --time-scale"):
        read_joint_run(file, JointColumns())
    assert read_joint_run(file, JointColumns(time_scale_s=1e3)).step_s == pytest.approx(
        1.0 / RATE_HZ
    )


def test_columns_that_do_not_do_are_told(table):
    with pytest.raises(GalenError, match=r"run.csv: no column 'tau'; there are t, motor"):
        read_joint_run(table, JointColumns(torque="tau"))
    with pytest.raises(GalenError, match="two runs have the name run"):
        read_joint_runs([table, table], JointColumns())
    with pytest.raises(GalenError, match="'motor' and 'motor' are the same but for an offset"):
        read_joint_run(table, JointColumns(link="motor"))
    text = table.read_text()
    edited(table, 20, "0.18,0.1,0.1,1e200")
    with pytest.raises(GalenError, match="column 'torque': '1e200' is not a finite number"):
        read_joint_run(table, JointColumns())
    edited(table, 20, "0.18,0.1,nan,3")
    with pytest.raises(GalenError, match=r"line 20, column 'link': 'nan' is not a finite number"):
        read_joint_run(table, JointColumns())
    table.write_text("\n".join(text.splitlines()[:30]) + "\n")
    with pytest.raises(GalenError, match=r"run.csv: 29 readings"):
        read_joint_run(table, JointColumns())
    still = "".join(f"{k / 100},{k},1.5,2\n" for k in range(60))
    table.write_text("t,motor,link,torque\n" + still)
    with pytest.raises(GalenError, match=r"column 'link' never changes"):
        read_joint_run(table, JointColumns())


# --- the command ----------------------------------------------------------------------------------


def test_a_table_becomes_a_stiffness(tmp_path, capsys):
    file = write_csv(tmp_path / "run.csv", spring_run("run", 1, 1e-5, seconds=8.0))
    assert main([str(file), "--blocks", "3", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    stiffness = result["parameters"]["stiffness"]
    assert stiffness["ci95"][0] < STIFFNESS < stiffness["ci95"][1]
    assert stiffness["value"] == pytest.approx(STIFFNESS, rel=0.01)
    assert result["scores"]["linear"]["rmse_rad"] == pytest.approx(1e-5, rel=0.1)
    assert result["held_out"]["block 1 of 3"] == ["block 2 of 3", "block 3 of 3"]
    assert "common terms" not in result["scores"]


def test_several_runs_for_a_person(tmp_path, capsys):
    files = [
        str(write_csv(tmp_path / f"run{k}.csv", lost_run(f"run{k}", k, seconds=4.0)))
        for k in range(3)
    ]
    assert main([*files, "--terms", "delay,gear"]) == 0
    shown = capsys.readouterr().out
    for text in ("common terms", "lost motion", "3 parts held out", "stiffness"):
        assert text in shown


def test_what_goes_wrong_is_one_line(table, tmp_path, capsys):
    assert main([str(tmp_path / "none.csv")]) == 1
    assert main([str(table), "--columns", "torque=tau"]) == 1
    assert main([str(table), "--unlike", "(.)"]) == 1
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 3
    assert all(line.startswith("evaluate: ") for line in lines)
    for wrong in (
        ["--columns", "speed=x"],
        ["--columns", "motor"],
        ["--columns", "motor=a,motor=b"],
        ["--torque-gear", "0"],
        ["--terms", "friction"],
        ["--blocks", "3", "--unlike", "(.)"],
        ["--blocks", "2"],
        ["--model", "m.json"],
        ["--tool", "t.json"],
        ["bag.mcap"],
        ["--plots", "plots"],
    ):
        with pytest.raises(SystemExit) as ended:
            main([str(table), *wrong])
        assert ended.value.code == 2


# --- measured -------------------------------------------------------------------------------------


@measured
@pytest.mark.slow
def test_a_cable_transmission_of_another_frequency_and_brake(capsys):
    files = [str(file) for file in sorted((REAL / "davinci_tool").glob("*.csv"))]
    columns = "t=t_s,motor=output_angle_rad,link=input_angle_rad,torque=input_torque_Nm"
    options = ["--opposite", "--terms", "gear", "--unlike", "tool4_(.)(.)", "--json"]
    assert main([*files, "--columns", columns, *options]) == 1
    assert "tool4_00.csv: column 't_s' steps by 5e-06" in capsys.readouterr().err
    assert main([*files, "--columns", columns, *options, "--time-scale", "1000"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["held_out"]["tool4_33"] == ["tool4_00", "tool4_01", "tool4_12", "tool4_21"]
    scores = {name: score["share_of_std"] for name, score in result["scores"].items()}
    assert scores["ours"] < 0.2
    assert scores["ours"] < 0.5 * scores["linear"]
    assert scores["linear"] < scores["common terms"] < scores["constant"]
    # the driving end's torque has the friction in it: a loop, and a worse prediction
    driven = columns.replace("input_torque", "output_torque")
    assert main([*files, "--columns", driven, *options, "--time-scale", "1000"]) == 0
    assert json.loads(capsys.readouterr().out)["parameters"]["plain_least_squares"][
        "compliance"
    ]["ci95"][1] < 0.0  # fmt: skip
    reversed_torque = ["--torque-gear", "-1", "--time-scale", "1000"]
    assert main([*files, "--columns", driven, *options, *reversed_torque]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["scores"]["ours"]["rmse_rad"] < 0.6 * result["scores"]["linear"]["rmse_rad"]
    assert result["parameters"]["form"] == "torque plays"


@measured
@pytest.mark.slow
@pytest.mark.parametrize(("axis", "gear"), [(1, 256.857), (2, 267.429), (3, 252.333)])
def test_an_industrial_arms_lag_is_a_late_clock_first_of_all(axis, gear, capsys):
    names = f"motor=motor_angle_{axis}_rad,link=link_angle_{axis}_rad"
    columns = f"t=t_s,{names},torque=motor_torque_{axis}_Nm"
    command = [str(REAL / "kr300_joints" / "run_a.csv"), "--columns", columns, "--torque-gear"]
    assert main([*command, str(gear), "--json"]) == 0
    without = json.loads(capsys.readouterr().out)
    assert main([*command, str(gear), "--json", "--terms", "gear,delay"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert without["scores"]["ours"]["share_of_std"] > 0.4
    assert told["scores"]["ours"]["share_of_std"] < 0.15
    delay = told["parameters"]["estimates"]["delay"]
    assert 2.6e-3 < delay["value"] < 3.1e-3
    # with the delay, hardly anything is left that depends on the direction
    direction = "plain_least_squares", "direction"
    left = [result["parameters"][direction[0]][direction[1]] for result in (without, told)]
    assert abs(left[1]["value"]) < 0.2 * abs(left[0]["value"])
