import json
import os
import stat
import sys
from pathlib import Path

import numpy as np
import pytest
from galen_diagnosis.blind import confine
from galen_diagnosis.blind.blind_protocol import Places, open_labels, sealed_set
from galen_diagnosis.blind.case import STRENGTHS, Truth
from galen_diagnosis.blind.causes import EFFECTS
from galen_diagnosis.blind.labels import (
    Label,
    ParsedAnswer,
    opened,
    private_directory,
    sealed,
    write_sealed,
)
from galen_diagnosis.blind.making import CALIBRATION, TEST, full_plan, make_all, short_plan
from galen_diagnosis.blind.score import Answered, score
from galen_diagnosis.blind.unlisted import CALIBRATION_UNKNOWN, TEST_UNKNOWN
from galen_model.errors import GalenError

from galen_diagnosis import blind_check

PROBE = (sys.executable, str(Path(__file__).with_name("blind_probe.py")))


@pytest.fixture(autouse=True)
def own_home(tmp_path, monkeypatch):
    """Labels of tests lie in a home of their own."""
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.delenv("XDG_STATE_HOME", raising=False)
    (tmp_path / "home").mkdir()
    return tmp_path / "home"


def fake_generate(case, directory):
    """A recording of one small file; what the probe is to answer stands in it."""
    drawn = {"none": (), "pair": EFFECTS[:2]}.get(case.kind, ("hail",))
    effects = case.effects or drawn
    reads = {"none": "none", TEST: "unknown"}.get(case.kind, effects[0] if effects else "none")
    if effects == ("bias_step",):
        reads = "breaks"
    directory.mkdir(parents=True)
    (directory / "tool.json").write_text(json.dumps({"reads": reads, "seed": case.seed}))
    hidden = tuple({"effect": name, "parameters": {"secret": 0.125}} for name in effects)
    same = tuple((name,) for name in effects)
    return Truth(case.strength, hidden, (30.0,) * len(effects), same)


def arguments(*options):
    return blind_check.build_parser().parse_args(["--workers", "1", *options])


def check(output, *options, **others):
    return blind_check.run(
        arguments("--output", str(output), *options), output, PROBE, fake_generate, **others
    )


def test_the_whole_way_and_what_the_diagnosing_process_can_see(tmp_path, own_home, capsys):
    output = tmp_path / "out"
    assert check(output, "--short", "--json") == 0
    printed = capsys.readouterr()
    lines = printed.err.splitlines()
    content = json.loads(printed.out)
    assert lines[0].endswith(content["labels_sha256"])
    scores = content["scores"]
    assert list(scores) == ["galen_diagnosis", "naive"]
    own = scores["galen_diagnosis"]
    # Of six sorts one breaks, and is counted as wrong; the rest is right.
    assert (own["cases"], own["failed"]) == (6, 1)
    counts = {name: (one["hits"], one["of"]) for name, one in own["rates"].items()}
    assert counts["top1_clear"] == (1, 2) and counts["top1_gross"] == (1, 1)
    assert counts["false_alarms"] == (0, 1) and counts["unknown_by_verdict"] == (1, 1)
    assert scores["naive"]["rates"]["top1_gross"]["hits"] == 0
    assert "| healthy: false alarms | ≤ 3 % | 0 %" in (output / "blind_check.md").read_text()
    assert not list((own_home / ".local/state/galen_blind_check").iterdir())

    labels = json.loads((output / "labels.json").read_text())["labels"]
    assert len({label["recording"] for label in labels}) == 6
    private = str(own_home / ".local/state/galen_blind_check")
    besides = sorted((output / "answers").glob("*/beside.json"))
    assert len(besides) == 5
    for beside in besides:
        seen = json.loads(beside.read_text())["attempts"]
        given = json.dumps([seen["argv"], seen["env"], seen["cwd"]])
        assert private not in given and "secret" not in given
        assert seen["cwd"] == str(output / "recordings")
        for label in labels:
            assert label["kind"] not in " ".join(seen["argv"])
        if confine.available():
            assert lines[1].startswith("diagnosed by a process that the system kept")
            assert seen["tried"][private] in ([], "PermissionError")
            assert seen["tried"][f"/proc/{os.getpid()}/mem"] == "PermissionError"
        else:
            assert "this system can't" in lines[1]


@pytest.mark.skipif(not confine.available(), reason="this system has no Landlock")
def test_the_lock_holds_and_is_not_there_without_it(tmp_path):
    import subprocess

    secret = tmp_path / "state" / "secret"
    (tmp_path / "seen").mkdir()
    secret.mkdir(parents=True)
    (secret / "labels.json").write_text("truth")
    (tmp_path / "state" / "beside").write_text("free")
    program = (
        "import pathlib, sys\n"
        "for path in sys.argv[1:]:\n"
        "    try: print(pathlib.Path(path).read_text())\n"
        "    except PermissionError: print('rejected')\n"
        "p = pathlib.Path('seen/new'); p.write_text('own'); print(p.read_text())\n"
    )
    asked = [str(secret / "labels.json"), str(tmp_path / "state" / "beside")]
    command = [sys.executable, "-c", program, *asked]
    lock = [sys.executable, "-m", "galen_diagnosis.blind.confine", "--allow", "seen", "--"]
    for start, expected in ((lock, ["rejected", "free", "own"]), ([], ["truth", "free", "own"])):
        done = subprocess.run(
            [*start, *command], input=f"{secret}\n", text=True, capture_output=True, cwd=tmp_path,
            check=True,
        )  # fmt: skip
        assert done.stdout.split() == expected


def test_recordings_tell_nothing_by_their_names_order_and_times(tmp_path):
    plan = full_plan(5, 1)
    labels = make_all(plan, tmp_path / "r", tmp_path / "p", 1, fake_generate)
    names = [label.recording for label in labels]
    assert sorted(names) == names == sorted(path.name for path in (tmp_path / "r").iterdir())
    times = {path.stat().st_mtime for path in (tmp_path / "r").rglob("*")}
    assert len(times) == 1
    # The kinds come in no order: as many changes between neighbours as a shuffle has.
    kinds = np.array([label.kind for label in labels])
    random = np.random.default_rng(0)
    shuffled = [np.sum(np.diff(random.permutation(kinds) == "single")) for _ in range(400)]
    low, high = np.quantile(shuffled, [0.005, 0.995])
    assert low <= np.sum(np.diff(kinds == "single")) <= high
    inside = {path.name for path in (tmp_path / "r").rglob("*") if path.is_file()}
    assert inside == {"tool.json"}


def test_plans():
    plan = full_plan(5, 2)
    assert plan == full_plan(5, 2) != full_plan(6, 2)
    kinds = [case.kind for case in plan.values()]
    singles = [(c.effects, c.strength) for c in plan.values() if c.kind == "single"]
    assert len(singles) == 2 * 23 * 3
    assert set(singles) == {((effect,), strength) for effect in EFFECTS for strength in STRENGTHS}
    assert kinds.count("none") == 40
    asked = {case.effects[0] for case in plan.values() if case.kind == TEST}
    other = full_plan(5, 1, unknown=CALIBRATION)
    trained = {case.effects[0] for case in other.values() if case.kind == CALIBRATION}
    assert asked == set(TEST_UNKNOWN) and trained == set(CALIBRATION_UNKNOWN)
    assert not asked & trained
    assert len({case.seed for case in plan.values()}) == len(plan)
    assert {case.kind for case in short_plan(1).values()} == {"none", "single", "pair", TEST}


def test_a_changed_label_or_recording_does_not_open(tmp_path):
    places = Places(tmp_path / "out")
    told = sealed_set(places, {}, 4, short_plan, 1, fake_generate)
    private = private_directory(places.output)
    assert stat.S_IMODE(private.stat().st_mode) == 0o700
    path = private / "labels.json"
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    whole = path.read_text()
    write_sealed(path, whole.replace('"none"', '"gain"', 1))
    with pytest.raises(GalenError, match="isn't what was sealed"):
        open_labels(places, told)
    write_sealed(path, whole)
    recording = next(places.recordings.iterdir())
    before = (recording / "tool.json").read_text()
    (recording / "tool.json").write_text(before + " ")
    with pytest.raises(GalenError, match=recording.name):
        open_labels(places, told)
    assert not places.labels.exists()
    (recording / "tool.json").write_text(before)
    assert len(open_labels(places, told)) == 6
    assert open_labels(places, told) == opened(places.labels, told)
    assert not private.exists()


def test_the_hash_does_not_tell_the_labels():
    labels = [Label("r", "none")]
    one, other = sealed(labels), sealed(labels)
    assert one[1] != other[1] and one[0] != other[0]
    assert len(json.loads(one[0])["salt"]) == 64


def test_an_interrupted_check_goes_on(tmp_path, monkeypatch):
    output = tmp_path / "out"
    made = []

    def stops(case, directory):
        if len(made) == 3:
            raise KeyboardInterrupt
        made.append(case)
        return fake_generate(case, directory)

    with pytest.raises(KeyboardInterrupt):
        blind_check.run(arguments("--short", "--seed", "7"), output, PROBE, stops)
    assert not (output / "commitment.json").exists()

    def goes_on(case, directory):
        made.append(case)
        return fake_generate(case, directory)

    blind_check.run(arguments("--short", "--seed", "7"), output, PROBE, goes_on)
    assert sorted(case.seed for case in made) == sorted(
        case.seed for case in short_plan(7).values()
    )
    told = json.loads((output / "commitment.json").read_text())["labels_sha256"]
    answers = sorted((output / "answers").glob("*/diagnosis.json"))
    stamps = [path.stat().st_mtime_ns for path in answers]
    # Once open it is scored again only: nothing is made, nothing diagnosed.
    blind_check.run(arguments("--short", "--seed", "7"), output, ("/bin/false",), None)
    assert [path.stat().st_mtime_ns for path in answers] == stamps
    assert json.loads((output / "commitment.json").read_text())["labels_sha256"] == told
    with pytest.raises(blind_check.GalenError, match="other options"):
        blind_check.run(arguments("--per-class", "1"), output, PROBE, fake_generate)


def test_a_score_may_be_asked_for():
    label = Label(
        "r", "single", ({"effect": "joint_gain", "parameters": {"joint": "tilt"}},), "clear"
    )
    right, wrong = (
        ParsedAnswer("r", "identified", {name: {}}, frozenset(), {name: 1.0})
        for name in ("joint_gain:tilt", "bias_step")
    )
    answers = [Answered(label, right)] * 3 + [Answered(label, wrong)]
    blind_check.check_score(score(answers, EFFECTS), 0.75)
    with pytest.raises(blind_check.GalenError, match=r"0\.750, below the 0\.8"):
        blind_check.check_score(score(answers, EFFECTS), 0.8)
    blind_check.check_answers(answers[:3])
    with pytest.raises(
        blind_check.GalenError, match=r"1 of 4.*r: verdict .*\(bias_step\) of joint_g"
    ):
        blind_check.check_answers(answers)
    with pytest.raises(blind_check.GalenError, match="1 of 4 diagnoses failed"):
        blind_check.check_score(score([*answers[:3], Answered(label, None)], EFFECTS), 0.0)


def test_a_strange_directory_is_left_alone(tmp_path):
    (tmp_path / "mine.txt").write_text("x")
    with pytest.raises(blind_check.GalenError, match="isn't empty"):
        blind_check.run(arguments("--short"), tmp_path, PROBE, fake_generate)
    assert {path.name for path in tmp_path.iterdir()} == {"home", "mine.txt"}


def test_wrong_arguments(capsys):
    for options in (
        ["--seed", "-1"],
        ["--at-least", "2"],
        ["--short", "--per-class", "2"],
    ):
        with pytest.raises(SystemExit) as ended:
            blind_check.main(options)
        assert ended.value.code == 2
    capsys.readouterr()
