# SPDX-License-Identifier: Apache-2.0
"""train and evaluate, end to end on small recordings."""

import json
import sys
from dataclasses import replace

import numpy as np
import pytest
from galen_common.command import EXIT_FAILED, EXIT_OK
from galen_deflection.measurement.samples import DeflectionError
from galen_deflection.models.file import KINDS, read_model
from galen_model.arm.galen import GALEN
from galen_model.files.calibration_file import write_calibration
from push_bag import POSITIONS, ROOT, TOOL, Scene, write

from galen_deflection import evaluate, train

PUSHES = ((8.0, 0.0, 0.0), (0.0, -8.0, 0.0), (0.0, 0.0, 8.0), (-5.0, 4.0, 0.0), (0.0, 6.0, -5.0))
WITH_TOOL = ("--tool", ROOT / "bags" / "tools" / "retractor.json")
SPRINGS = ("--kind", "joint_stiffness", "-o")
COMMANDS = {"train": train, "evaluate": evaluate}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Bags `first` (positions 0 to 2), `second` (2, 0 and 3, in this order) and a model of each."""
    path = tmp_path_factory.mktemp("commands")
    for name, which, seed in (("first", [0, 1, 2], 1), ("second", [2, 0, 3], 2)):
        scene = Scene(positions=POSITIONS[which], pushes=PUSHES, push_s=0.5, gap_s=0.6, seed=seed)
        write(path / "bags" / name, scene.topics())
    assert run("train", path / "bags" / "first", *WITH_TOOL, *SPRINGS, path / "model.json") == 0
    return path


def run(command, *arguments):
    return COMMANDS[command].main([str(argument) for argument in arguments])


def call(command, capsys, *arguments):
    """Exit code, standard output, standard error."""
    return run(command, *arguments), *capsys.readouterr()


def call_json(command, capsys, *arguments):
    code, out, err = call(command, capsys, *arguments, "--json")
    assert err == ""
    return code, json.loads(out, parse_constant=lambda name: pytest.fail(name))


# --- train --------------------------------------------------------------------------------------


def test_train_joins_recordings_and_writes_what_it_fitted(folder, tmp_path, capsys):
    file = tmp_path / "new" / "model.json"
    code, said = call_json("train", capsys, folder / "bags", *WITH_TOOL, *SPRINGS, file)
    assert code == EXIT_OK
    model = read_model(file, arm=GALEN)
    # Four places in two recordings of three each: two are in both, under one number.
    assert said["positions"] == model.fitted_on["positions"] == 4
    assert model.fitted_on["sets"] == 6
    assert said["bags"] == [str(folder / "bags" / name) for name in ("first", "second")]
    by_name = {row["name"]: row for row in said["parameters"]}
    assert set(by_name) == {"1/k_roll", "1/k_tilt", "1/k_carriage", "1/k_rod"}
    for row, value in zip(said["parameters"], model.values, strict=True):
        assert row["value"] == value
        # The recording was made with the nominal arm.
        assert abs(row["value"] - row["nominal"]) < 5.0 * row["std"]
    assert said["fit"]["rmse_over_noise_all"] == pytest.approx(1.0, abs=0.06)


def test_train_tells_a_person(folder, tmp_path, capsys):
    file = tmp_path / "model.json"
    code, out, err = call("train", capsys, folder / "bags" / "first", *WITH_TOOL, *SPRINGS, file)
    assert (code, err) == (EXIT_OK, "")
    for words in (
        "1/k_roll", "rad/(N.m)", "fitted to", "nothing was held out",
        f"model file: {file}", "ros2 run galen_deflection evaluate BAG",
    ):  # fmt: skip
        assert words in out


def test_what_cant_be_fitted_leaves_the_old_file(folder, tmp_path, capsys):
    quiet = Scene(positions=POSITIONS[:2], pushes=((0.0, 0.0, 0.0),) * 2, push_s=0.3)
    bag = write(tmp_path / "quiet", quiet.topics())
    file = tmp_path / "model.json"
    file.write_text("old")
    code, out, err = call("train", capsys, bag, *WITH_TOOL, *SPRINGS, file)
    assert (code, out) == (EXIT_FAILED, "")
    assert err.startswith("train: ")
    assert "nothing loads the arm" in err
    assert err.count("\n") == 1
    assert file.read_text() == "old"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["model.json", "quiet"]


def test_an_output_that_cant_be_is_told_before_the_bags_are_read(folder, tmp_path, capsys):
    (tmp_path / "file").write_text("")
    for output, words in (
        (tmp_path, f"{tmp_path}: is a directory"),
        (tmp_path / "file" / "new" / "m.json", "file: is no directory"),
        (tmp_path / ("m" * 300), "m: can't be written: File name too long"),
    ):
        arguments = (tmp_path / "no_bag", *WITH_TOOL, *SPRINGS, output)
        code, out, err = call("train", capsys, *arguments)
        assert (code, out, err.count("\n")) == (EXIT_FAILED, "", 1)
        assert words in err


def test_two_tools_in_one_call_are_rejected(folder, tmp_path, capsys):
    for name, tool in (("first", "retractor"), ("second", "hook")):
        (tmp_path / tool).mkdir()
        (tmp_path / tool / name).symlink_to(folder / "bags" / name)
        write_calibration(tmp_path / tool / "tool.json", replace(TOOL, tool=tool))
    bags = (tmp_path / "retractor" / "first", tmp_path / "hook" / "second")
    arguments = (*bags, "--tool-beside", "tool.json", *SPRINGS, tmp_path / "m.json")
    code, _, err = call("train", capsys, *arguments)
    assert code == EXIT_FAILED
    assert "the tool hook" in err
    assert f"{tmp_path / 'retractor' / 'first'} with retractor" in err
    assert not (tmp_path / "m.json").exists()


# --- evaluate -----------------------------------------------------------------------------------


def test_evaluate_scores_every_model_at_every_position(folder, tmp_path, capsys):
    again = tmp_path / "again.json"
    again.write_bytes((folder / "model.json").read_bytes())
    code, said = call_json(
        "evaluate", capsys, folder / "bags" / "second", *WITH_TOOL,
        "--model", folder / "model.json", again, "--plots", tmp_path / "plots",
    )  # fmt: skip
    assert code == EXIT_OK
    # Two models of a kind have their files' names.
    names = ["joint_stiffness model", "joint_stiffness again"]
    assert list(said["models"]) == names
    for name in names:
        model = said["models"][name]
        assert model["rmse_over_noise_all"] == pytest.approx(1.0, abs=0.06)
        assert sum(part["samples"] for part in model["by_position"].values()) == said["samples"]
        # Position 2 of this recording was not in the first one.
        assert model["by_position"]["2"]["extrapolated"] == 1.0
        assert model["by_position"]["0"]["extrapolated"] == 0.0
    assert np.allclose(said["positions"]["2"], POSITIONS[3], atol=1e-3)
    assert said["notes"] == []
    drawn = {f"second_course_{name}.png" for name in names}
    assert {path.name for path in (tmp_path / "plots").iterdir()} == drawn
    assert {path.rsplit("/", 1)[1] for path in said["plots"]} == drawn


def test_evaluate_names_what_a_model_was_fitted_to(folder, capsys):
    arguments = (folder / "bags" / "first", *WITH_TOOL, "--model", folder / "model.json")
    code, out, err = call("evaluate", capsys, *arguments)
    assert (code, err) == (EXIT_OK, "")
    for words in ("was fitted to", "RMSE / noise", "95 % below", "residual", "position 2"):
        assert words in out


def test_a_model_of_another_tip_is_rejected(folder, tmp_path, capsys):
    tip = np.asarray(TOOL.tip_m) + [0.0, 0.0, 1e-3]
    write_calibration(tmp_path / "other.json", replace(TOOL, tip_m=tip))
    bag, model = folder / "bags" / "first", folder / "model.json"
    arguments = (bag, "--tool", tmp_path / "other.json", "--model", model)
    code, _, err = call("evaluate", capsys, *arguments)
    assert code == EXIT_FAILED
    assert err.startswith(f"evaluate: {model}: was fitted for a tool with its tip at")
    assert str(bag) in err


def test_of_many_bags_the_bad_one_is_named_and_the_others_are_evaluated(folder, tmp_path, capsys):
    (tmp_path / "good.mcap").symlink_to(next((folder / "bags" / "second").glob("*.mcap")))
    (tmp_path / "bad.mcap").write_bytes(b"nothing")
    arguments = (tmp_path, *WITH_TOOL, "--model", folder / "model.json")
    code, said = call_json("evaluate", capsys, *arguments)
    assert code == EXIT_FAILED
    bad, good = said["bags"]
    assert "bad.mcap" in bad["error"]
    assert good["models"]["joint_stiffness"]["rmse_over_noise_all"] > 0.9
    code, out, _ = call("evaluate", capsys, *arguments)
    assert code == EXIT_FAILED
    assert bad["error"] in out


# --- kinds --------------------------------------------------------------------------------------


def test_kinds_are_fitted_where_they_are_not_checked(folder, capsys):
    arguments = (folder / "bags", *WITH_TOOL, "--kinds", "joint_stiffness")
    code, said = call_json("evaluate", capsys, *arguments)
    assert code == EXIT_OK
    seen, unseen = said["comparisons"]
    # Two of four positions have two sets: that isn't the report's split.
    assert (seen["split"], unseen["split"]) == ("push", "position")
    for one in (seen, unseen):
        kind = one["kinds"]["joint_stiffness"]
        assert kind["rmse_over_noise_all"] == pytest.approx(1, abs=0.1)
        assert len(kind["fit_cpu_s"]) == 4
        assert set(kind["rmse_over_noise_by_position"]) == set("0123")


def test_a_kind_that_fails_is_named_and_the_others_go_on(folder, capsys, monkeypatch):
    def fails(samples, settings):
        raise DeflectionError("no such luck")

    monkeypatch.setitem(KINDS, "lstm", KINDS["lstm"]._replace(fit=fails))
    arguments = (folder / "bags" / "first", *WITH_TOOL, "--split", "position")
    arguments += ("--kinds", "lstm", "joint_stiffness")
    code, out, err = call("evaluate", capsys, *arguments)
    assert (code, err) == (EXIT_FAILED, "")
    assert "lstm: no such luck" in out
    assert "joint_stiffness" in out


def test_without_pytorch_the_network_is_left_out_unless_it_is_asked_for(
    folder, capsys, monkeypatch
):
    monkeypatch.setattr(evaluate, "find_spec", lambda _: None)
    monkeypatch.delitem(KINDS, "joint_hysteresis")  # slow
    monkeypatch.setitem(sys.modules, "torch", None)
    arguments = (folder / "bags" / "first", *WITH_TOOL, "--split", "position")
    code, out, err = call("evaluate", capsys, *arguments)
    assert code == EXIT_OK and "joint_stiffness" in out and "lstm" not in out
    needs = "training a network needs PyTorch: `make networks` installs it"
    assert err == f"evaluate: lstm is left out: {needs}\n"
    code, out, err = call("evaluate", capsys, *arguments, "--kinds", "lstm", "joint_stiffness")
    assert code == EXIT_FAILED and "needs PyTorch" in out and "joint_stiffness" in out


def test_the_report_s_models_are_fitted_scored_and_drawn(folder, tmp_path, capsys):
    code, said = call_json(
        "evaluate", capsys, folder / "bags", *WITH_TOOL, "--split", "position",
        "--plots", tmp_path, "--kinds", "independent", "coupled", "joint_stiffness",
    )  # fmt: skip
    assert code == EXIT_OK
    (found,) = said["comparisons"]
    first, second, springs = (one["rmse_over_noise_all"] for one in found["kinds"].values())
    assert first > 1.2 * springs and second > 1.2 * springs
    assert {path.rsplit("_course_", 1)[1] for path in found["plots"]} == {
        "independent.png", "coupled.png", "joint_stiffness.png",
    }  # fmt: skip


# --- all ----------------------------------------------------------------------------------------

LEAST = {"train": ["--kind", "joint_stiffness", "-o", "never.json"], "evaluate": []}


@pytest.mark.parametrize("command", COMMANDS)
def test_wrong_arguments_are_usage(command, capsys):
    for arguments in ([], ["bag"], ["bag", "--tool", "x", "--tool-beside", "y", *LEAST[command]]):
        with pytest.raises(SystemExit) as ended:
            COMMANDS[command].main(arguments)
        assert ended.value.code == 2
        assert "usage:" in capsys.readouterr().err


@pytest.mark.parametrize("command", COMMANDS)
def test_a_bag_that_is_not_there_is_one_line(command, tmp_path, capsys):
    bag = tmp_path / "nowhere"
    code, out, err = call(command, capsys, bag, *WITH_TOOL, *LEAST[command])
    assert (code, out) == (EXIT_FAILED, "")
    assert err == f"{command}: {bag}: is not there\n"
