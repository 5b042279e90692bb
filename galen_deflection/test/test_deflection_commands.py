"""train and evaluate, end to end on small recordings."""

import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from galen_deflection.errors import FitError
from galen_deflection.models.file import read_model
from galen_deflection.models.registry import KINDS
from galen_model.files.calibration_file import write_calibration
from galen_ros.command import EXIT_FAILED, EXIT_INTERRUPTED, EXIT_OK
from push_bag import POSITIONS, ROOT, TOOL, Scene, write

from galen_deflection import evaluate, train

PUSHES = ((8.0, 0.0, 0.0), (0.0, -8.0, 0.0), (0.0, 0.0, 8.0), (-5.0, 4.0, 0.0), (0.0, 6.0, -5.0))
TOOL_FILE = str(ROOT / "bags" / "tools" / "retractor.json")
COMMANDS = {"train": train, "evaluate": evaluate}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Bags `first` (positions 0 to 2), `second` (2, 0 and 3, in this order) and a model of each."""
    path = tmp_path_factory.mktemp("commands")
    for name, which, seed in (("first", [0, 1, 2], 1), ("second", [2, 0, 3], 2)):
        scene = Scene(positions=POSITIONS[which], pushes=PUSHES, push_s=0.5, gap_s=0.6, seed=seed)
        write(path / "bags" / name, scene.topics())
    for kind in ("coupled", "joint_stiffness"):
        arguments = [str(path / "bags" / "first"), "--tool", TOOL_FILE, "--kind", kind]
        assert train.main([*arguments, "-o", str(path / f"{kind}.json"), "--check", "none"]) == 0
    return path


def call(command, capsys, *arguments):
    """Exit code, standard output, standard error."""
    code = COMMANDS[command].main([str(argument) for argument in arguments])
    return code, *capsys.readouterr()


def call_json(command, capsys, *arguments):
    code, out, err = call(command, capsys, *arguments, "--json")
    assert err == ""
    return code, json.loads(out, parse_constant=lambda name: pytest.fail(name))


# --- train --------------------------------------------------------------------------------------


def test_train_joins_recordings_and_writes_what_it_fitted(folder, tmp_path, capsys):
    file = tmp_path / "new" / "model.json"
    code, said = call_json(
        "train", capsys, folder / "bags", "--tool", TOOL_FILE, "--kind", "joint_stiffness",
        "-o", file,
    )  # fmt: skip
    assert code == EXIT_OK
    model = read_model(file)
    # Four places in two recordings of three each: two are in both, under one number.
    assert (said["positions"], model.fitted_on.positions, model.fitted_on.sets) == (4, 4, 6)
    assert said["bags"] == [str(folder / "bags" / name) for name in ("first", "second")]
    by_name = {row["name"]: row for row in said["parameters"]}
    assert set(by_name) == {"1/k_roll", "1/k_tilt", "1/k_carriage", "1/k_rod"}
    for row, value in zip(said["parameters"], model.values, strict=True):
        assert row["value"] == value
        # The recording was made with the nominal arm.
        assert abs(row["value"] - row["nominal"]) < 5.0 * row["std"]
    assert said["fit"]["rmse_over_noise_all"] == pytest.approx(1.0, abs=0.06)
    assert list(said["held_out"]) == ["push", "position"]
    assert said["held_out"]["position"]["rmse_over_noise_all"] == pytest.approx(1.0, abs=0.1)


def test_train_tells_a_person(folder, tmp_path, capsys):
    file = tmp_path / "model.json"
    code, out, err = call(
        "train", capsys, folder / "bags" / "first", "--tool", TOOL_FILE, "--kind", "independent",
        "-o", file, "--check", "push", "report",
    )  # fmt: skip
    assert (code, err) == (EXIT_OK, "")
    for words in (
        "dx/fx", "m/N", "fitted to", "held out: push",
        "not held out, report: the report's split needs two sets",
        f"model file: {file}", "ros2 run galen_deflection evaluate BAG",
    ):  # fmt: skip
        assert words in out


def test_an_old_model_is_kept_beside_the_new_one(folder, tmp_path, capsys):
    file = tmp_path / "model.json"
    file.write_text("old")
    code, _, _ = call(
        "train", capsys, folder / "bags" / "first", "--tool", TOOL_FILE, "--kind", "coupled",
        "-o", file, "--check", "none",
    )  # fmt: skip
    assert code == EXIT_OK
    assert (tmp_path / "model.json.bak").read_text() == "old"
    assert read_model(file).name == "coupled"


def test_what_cant_be_fitted_leaves_the_old_file(folder, tmp_path, capsys):
    quiet = Scene(positions=POSITIONS[:2], pushes=((0.0, 0.0, 0.0),) * 2, push_s=0.3)
    bag = write(tmp_path / "quiet", quiet.topics())
    file = tmp_path / "model.json"
    file.write_text("old")
    arguments = ("--tool", TOOL_FILE, "--kind", "coupled", "-o", file)
    code, out, err = call("train", capsys, bag, *arguments)
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
        code, out, err = call(
            "train", capsys, tmp_path / "no_bag", "--tool", TOOL_FILE, "--kind", "coupled",
            "-o", output,
        )  # fmt: skip
        assert (code, out, err.count("\n")) == (EXIT_FAILED, "", 1)
        assert words in err


@pytest.mark.parametrize("command", list(COMMANDS))
def test_pictures_that_cant_be_are_told_before_the_bags_are_read(command, tmp_path, capsys):
    needs = {
        "train": ("--kind", "coupled", "-o", tmp_path / "m.json"),
        "evaluate": ("--model", tmp_path / "m.json"),
    }[command]
    (tmp_path / "file").write_text("")

    def words_of(plots):
        code, out, err = call(
            command, capsys, tmp_path / "no_bag", "--tool", TOOL_FILE, *needs, "--plots", plots
        )
        assert (code, out, err.count("\n")) == (EXIT_FAILED, "", 1)
        return err

    assert "file: is no directory" in words_of(tmp_path / "file" / "below")
    assert "p: can't be written: File name too long" in words_of(tmp_path / ("p" * 300))
    assert "new: can't be written: No such file" in words_of("/proc/galen/new")


def test_two_tools_in_one_call_are_rejected(folder, tmp_path, capsys):
    for name, tool in (("first", "retractor"), ("second", "hook")):
        (tmp_path / tool).mkdir()
        (tmp_path / tool / name).symlink_to(folder / "bags" / name)
        write_calibration(tmp_path / tool / "tool.json", replace(TOOL, tool=tool))
    code, _, err = call(
        "train", capsys, tmp_path / "retractor" / "first", tmp_path / "hook" / "second",
        "--tool-beside", "tool.json", "--kind", "coupled", "-o", tmp_path / "m.json",
    )  # fmt: skip
    assert code == EXIT_FAILED
    assert "the tool hook" in err
    assert f"{tmp_path / 'retractor' / 'first'} with retractor" in err
    assert not (tmp_path / "m.json").exists()


# --- evaluate -----------------------------------------------------------------------------------


def test_evaluate_scores_every_model_at_every_position(folder, capsys):
    code, said = call_json(
        "evaluate", capsys, folder / "bags" / "second", "--tool", TOOL_FILE,
        "--model", folder / "coupled.json", folder / "joint_stiffness.json",
    )  # fmt: skip
    assert code == EXIT_OK
    stiffness, coupled = said["models"]["joint_stiffness"], said["models"]["coupled"]
    assert stiffness["rmse_over_noise_all"] == pytest.approx(1.0, abs=0.06)
    # Position 2 of this recording was not in the first one.
    unseen = coupled["by_position"]["2"]
    assert unseen["extrapolated"] == 1.0
    assert coupled["by_position"]["0"]["extrapolated"] == 0.0
    assert (
        unseen["rmse_over_noise_all"] > 1.1 * stiffness["by_position"]["2"]["rmse_over_noise_all"]
    )
    assert sum(part["samples"] for part in coupled["by_position"].values()) == said["samples"]
    assert np.allclose(said["positions"]["2"], POSITIONS[3], atol=1e-3)
    assert said["notes"] == []


def test_evaluate_on_what_a_model_was_fitted_to_says_so(folder, capsys):
    code, out, err = call(
        "evaluate", capsys, folder / "bags" / "first", "--tool", TOOL_FILE,
        "--model", folder / "coupled.json",
    )  # fmt: skip
    assert (code, err) == (EXIT_OK, "")
    assert "was fitted to" in out
    for words in ("RMSE / noise", "95 % below", "left at no load", "position 2", "ellipsoid"):
        assert words in out


@pytest.mark.slow
def test_evaluate_draws(folder, tmp_path, capsys):
    _, said = call_json(
        "evaluate", capsys, folder / "bags" / "second", "--tool", TOOL_FILE,
        "--model", folder / "coupled.json", "--plots", tmp_path / "plots",
    )  # fmt: skip
    names = {path.name for path in (tmp_path / "plots").iterdir()}
    assert names == {
        "second_course_coupled.png", "second_over_predicted_coupled.png",
        "second_along_x_1.png", "second_along_x_2.png",
    }  # fmt: skip
    assert {path.rsplit("/", 1)[1] for path in said["plots"]} == names


def test_a_model_of_another_tip_is_rejected(folder, tmp_path, capsys):
    tip = np.asarray(TOOL.tip_m) + [0.0, 0.0, 1e-3]
    write_calibration(tmp_path / "other.json", replace(TOOL, tip_m=tip))
    model = folder / "coupled.json"
    code, _, err = call(
        "evaluate", capsys, folder / "bags" / "first", "--tool", tmp_path / "other.json",
        "--model", model,
    )  # fmt: skip
    assert code == EXIT_FAILED
    assert err.startswith(f"evaluate: {model}: was fitted for a tool with its tip at")
    assert str(folder / "bags" / "first") in err


def test_of_many_bags_the_bad_one_is_named_and_the_others_are_evaluated(folder, tmp_path, capsys):
    (tmp_path / "good.mcap").symlink_to(next((folder / "bags" / "second").glob("*.mcap")))
    (tmp_path / "bad.mcap").write_bytes(b"nothing")
    arguments = (tmp_path, "--tool", TOOL_FILE, "--model", folder / "coupled.json")
    code, said = call_json("evaluate", capsys, *arguments, "--workers", "1")
    assert code == EXIT_FAILED
    bad, good = said["bags"]
    assert "bad.mcap" in bad["error"]
    assert good["models"]["coupled"]["rmse_over_noise_all"] > 1.0
    code, out, _ = call("evaluate", capsys, *arguments, "--workers", "1")
    assert code == EXIT_FAILED
    assert "broken" in out
    assert bad["error"] in out


def test_two_models_of_a_kind_are_told_apart(folder, tmp_path, capsys):
    again = tmp_path / "again.json"
    again.write_bytes((folder / "coupled.json").read_bytes())
    _, said = call_json(
        "evaluate", capsys, folder / "bags" / "second", "--tool", TOOL_FILE,
        "--model", folder / "coupled.json", again,
    )  # fmt: skip
    assert list(said["models"]) == ["coupled coupled", "coupled again"]


# --- kinds --------------------------------------------------------------------------------------


def test_kinds_fits_where_it_does_not_check(folder, capsys):
    code, said = call_json(
        "evaluate", capsys, folder / "bags", "--tool", TOOL_FILE,
        "--kinds", "coupled", "joint_stiffness",
    )  # fmt: skip
    assert code == EXIT_OK
    seen, unseen = said["comparisons"]
    # Two of four positions have two sets: that isn't the report's split.
    assert (seen["split"], unseen["split"]) == ("push", "position")
    assert (len(seen["splits"]), len(unseen["splits"])) == (4, 4)
    for one in (seen, unseen):
        assert one["kinds"]["joint_stiffness"]["rmse_over_noise_all"] == pytest.approx(1, abs=0.1)
        assert len(one["kinds"]["coupled"]["fit_cpu_s"]) == 4
        assert set(one["kinds"]["coupled"]["rmse_over_noise_by_position"]) == set("0123")
        assert one["kinds"]["coupled"]["lstm_rmse_over_its"] is None
    ratio = [one["kinds"]["coupled"]["rmse_over_noise_all"] for one in (seen, unseen)]
    assert ratio[1] > 1.1 * ratio[0] > 1.1


def test_kinds_with_more_to_fit_to(folder, capsys):
    arguments = ("--tool", TOOL_FILE, "--kinds", "coupled", "--split", "position")
    first, second = folder / "bags" / "first", folder / "bags" / "second"
    _, alone = call_json("evaluate", capsys, first, *arguments)
    _, more = call_json("evaluate", capsys, first, *arguments, "--extra", second)
    (alone,), (more,) = alone["comparisons"], more["comparisons"]
    assert more["samples_only_fitted_to"] > 0
    assert alone["samples_checked"] == more["samples_checked"]
    before, after = (
        one["kinds"]["coupled"]["rmse_over_noise_by_position"] for one in (alone, more)
    )
    # Position 1 is only in the first; 0 and 2, left out, are left out of the second as well, but
    # its other positions are fitted to: every number moves, and none comes to be one of a position
    # that was seen.
    assert all(before[position] != after[position] for position in "012")
    assert all(value > 1.1 for value in after.values())


def test_kinds_tells_a_kind_that_fails_and_goes_on(folder, capsys, monkeypatch):
    def fails(samples, settings):
        raise FitError("no such luck")

    monkeypatch.setitem(KINDS, "independent", KINDS["independent"]._replace(fit=fails))
    arguments = (folder / "bags" / "first", "--tool", TOOL_FILE, "--split", "position")
    arguments += ("--kinds", "independent", "joint_stiffness")
    code, out, err = call("evaluate", capsys, *arguments)
    assert (code, err) == (EXIT_FAILED, "")
    assert "independent: no such luck" in out
    assert "joint_stiffness" in out


def test_the_networks_error_over_a_models_is_shown(folder, capsys, monkeypatch):
    monkeypatch.setitem(KINDS, "lstm", KINDS["independent"])
    arguments = (folder / "bags" / "first", "--tool", TOOL_FILE, "--split", "position")
    _, said = call_json("evaluate", capsys, *arguments, "--kinds", "lstm", "joint_stiffness")
    kinds = said["comparisons"][0]["kinds"]
    expected = (
        kinds["lstm"]["rmse_over_noise_all"] / kinds["joint_stiffness"]["rmse_over_noise_all"]
    )
    assert expected > 1.2
    assert kinds["joint_stiffness"]["lstm_rmse_over_its"] == pytest.approx(expected)
    assert kinds["lstm"]["lstm_rmse_over_its"] == 1.0
    assert kinds["lstm"]["lstm_error_beyond_noise_over_its"] == 1.0
    beyond = [kinds[name]["error_beyond_noise_over_noise"] for name in ("lstm", "joint_stiffness")]
    assert beyond[0] == pytest.approx(np.sqrt(kinds["lstm"]["rmse_over_noise_all"] ** 2 - 1.0))
    expected = None if beyond[1] is None else pytest.approx(beyond[0] / beyond[1])
    assert kinds["joint_stiffness"]["lstm_error_beyond_noise_over_its"] == expected


# --- all ----------------------------------------------------------------------------------------

LEAST = {
    "train": ["--kind", "coupled", "-o", "never.json"],
    "evaluate": [],
}


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
    code, out, err = call(command, capsys, bag, "--tool", TOOL_FILE, *LEAST[command])
    assert (code, out) == (EXIT_FAILED, "")
    assert err == f"{command}: {bag}: is not there\n"


@pytest.mark.parametrize("command", COMMANDS)
def test_an_interrupt_has_its_own_end(command, capsys, monkeypatch):
    def interrupted(*_args, **_kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr(COMMANDS[command], "check_folder", interrupted)
    bag = ROOT / "bags" / "pushes"
    code, out, err = call(command, capsys, bag, "--tool", TOOL_FILE, *LEAST[command])
    assert (code, out, err) == (EXIT_INTERRUPTED, "", f"{command}: interrupted\n")


HELP = """
import contextlib, importlib, io, sys

class Without:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {"torch", "safetensors", "rclpy", "matplotlib"}:
            raise ModuleNotFoundError("not for --help: " + name, name=name)

sys.meta_path.insert(0, Without())
for name in sys.argv[1:]:
    text = io.StringIO()
    try:
        with contextlib.redirect_stdout(text):
            importlib.import_module("galen_deflection." + name).main(["--help"])
    except SystemExit as end:
        assert end.code == 0
    assert "exit codes:" in text.getvalue()
    print(name)
"""


def test_help_needs_neither_torch_nor_ros_nor_matplotlib():
    done = subprocess.run(
        [sys.executable, "-c", HELP, *COMMANDS], capture_output=True, text=True, check=False
    )
    assert (done.stderr, done.stdout.split()) == ("", list(COMMANDS))
