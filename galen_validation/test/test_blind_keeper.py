# SPDX-License-Identifier: Apache-2.0
import json
import os
import stat
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from galen_model.errors import GalenError

from galen_diagnosis import blind_check as installed
from galen_validation import blind_check
from galen_validation.blind import blind_protocol, confine
from galen_validation.blind.baselines import NAIVE_BIC
from galen_validation.blind.blind_protocol import full_plan, make, short_plan
from galen_validation.blind.case import SINCE, STRENGTHS, Truth
from galen_validation.blind.causes import EFFECTS
from galen_validation.blind.diagnosing import PROGRAM
from galen_validation.blind.labels import open_labels
from galen_validation.blind.measured_tables import DRAWN
from galen_validation.blind.session import ARMS, USUAL
from galen_validation.blind.unlisted import CALIBRATION_UNKNOWN, TEST_UNKNOWN

PROBE = (sys.executable, str(Path(__file__).with_name("blind_probe.py")))
SHORT = {"per_class": 3, "healthy": 60, "short": True}


def fake_generate(case, directory):
    """A recording of one small file; what the probe is to answer stands in it."""
    drawn = {"none": (), "unchanged": (), "pair": EFFECTS[:2], "several": EFFECTS[:3]}.get(
        case.kind, ("hail",)
    )
    effects = case.effects or drawn
    reads = "unknown" if case.kind == "unknown" else (*effects, "none")[0]
    if effects == ("bias_step",):
        reads = "breaks"
    directory.mkdir(parents=True)
    (directory / "tool.json").write_text(json.dumps({"reads": reads, "seed": case.seed}))
    hidden = tuple({"effect": name, "parameters": {"secret": 0.125}} for name in effects)
    same = tuple((name,) for name in effects)
    return Truth(case.strength, hidden, (30.0,) * len(effects), same)


def parsed(*options):
    return blind_check.build_parser().parse_args(options)


def run(folder, *options, generate=fake_generate):
    arguments = parsed("run", str(folder), "--workers", "1", *options)
    return blind_check.run(arguments, folder, PROBE, generate)


def test_a_run_from_the_plan_to_the_score(tmp_path, capfd):
    folder = tmp_path / "set"
    with pytest.raises(GalenError, match=r"2 of 6 .*no answer of \('bias_step',\)"):
        run(folder, "--short", "--seed", "3")
    printed = capfd.readouterr()
    assert "no diagnosis of this" in printed.err
    seal = (folder / "labels.sha256").read_text()
    assert printed.out.splitlines()[0].endswith(seal.split()[0])
    inside = {path.name for path in folder.rglob("*") if path.is_file()}
    assert inside == {"README.md", "labels.sha256", "tool.json", "arm.urdf"}
    private = tmp_path / "set.labels"
    assert stat.S_IMODE(private.stat().st_mode) == 0o700
    answers = sorted((tmp_path / "set.answers" / PROGRAM).glob("*/diagnosis.json"))
    assert len(answers) == 5
    for answer in answers:
        tried = json.loads(answer.read_text())["attempts"]
        assert len(tried) == 3
        if confine.available():
            assert set(tried.values()) == {"PermissionError"}

    # Called again it asks only for what has no answer.
    stamps = [path.stat().st_mtime_ns for path in answers]
    with pytest.raises(GalenError):
        run(folder, "--short", generate=None)
    assert [path.stat().st_mtime_ns for path in answers] == stamps
    capfd.readouterr()

    tools = [str(tmp_path / "set.answers" / name) for name in (PROGRAM, NAIVE_BIC)]
    assert blind_check.main(["score", str(folder), *tools, "--json"]) == 0
    scores = json.loads(capfd.readouterr().out)["scores"]
    assert list(scores) == [PROGRAM, NAIVE_BIC]
    # One breaks and is counted as wrong, and the pair's second effect isn't named.
    values = scores[PROGRAM]["values"]
    assert values["top1_clear"]["hits"] == 1 and values["top1_gross"]["hits"] == 1
    assert values["failed"]["hits"] == 1 and values["pairs_named"]["hits"] == 0
    assert values["unlisted"]["hits"] == 1 and values["false_alarms"]["hits"] == 0
    assert scores[NAIVE_BIC]["values"]["top1_gross"]["hits"] == 0


@pytest.mark.skipif(not confine.available(), reason="this system has no Landlock")
def test_the_lock_takes_one_directory_from_a_process_and_its_children(tmp_path):
    secret, beside = tmp_path / "state" / "secret", tmp_path / "state" / "beside"
    secret.mkdir(parents=True)
    (secret / "labels.json").write_text("truth")
    beside.mkdir()
    program = (
        "import pathlib, subprocess, sys\n"
        "from galen_validation.blind.confine import lock_out\n"
        "lock_out(pathlib.Path('secret'))\n"
        "pathlib.Path('beside/new').write_text('own')\n"
        "for name in ('beside/new', 'secret/labels.json'):\n"
        "    subprocess.run(['cat', name])\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program],
        text=True,
        capture_output=True,
        cwd=tmp_path / "state",
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )
    assert done.stdout == "own" and "Permission denied" in done.stderr


def test_a_seed_makes_the_same_set_and_its_hash_tells_no_label(tmp_path):
    told = [
        make(tmp_path / name, SHORT, seed, 1, fake_generate)
        for name, seed in zip("abc", (7, 7, 8), strict=True)
    ]
    assert told[0] == told[1] != told[2]
    plan, labels = open_labels(tmp_path / "a")
    assert plan["seed"] == 7 and len(labels) == 6
    # Without a seed 64 random bits are in the text that is hashed.
    make(tmp_path / "d", SHORT, None, 1, fake_generate)
    assert open_labels(tmp_path / "d")[0]["seed"] > 2**32


def test_recordings_tell_nothing_by_their_names_order_and_times(tmp_path):
    make(tmp_path / "set", {"per_class": 1, "healthy": 20, "short": False}, 5, 1, fake_generate)
    recordings = tmp_path / "set" / "recordings"
    _, labels = open_labels(tmp_path / "set")
    names = [label.recording for label in labels]
    assert sorted(names) == names == sorted(path.name for path in recordings.iterdir())
    assert len({path.stat().st_mtime for path in recordings.rglob("*")}) == 1
    # The kinds come in no order: as many changes between neighbours as a shuffle has.
    kinds = np.array([label.kind for label in labels])
    random = np.random.default_rng(0)
    shuffled = [np.sum(np.diff(random.permutation(kinds) == "single")) for _ in range(400)]
    low, high = np.quantile(shuffled, [0.005, 0.995])
    assert low <= np.sum(np.diff(kinds == "single")) <= high


def test_plans():
    plan = full_plan(5, 2, 20)
    assert plan == full_plan(5, 2, 20) != full_plan(6, 2, 20)
    cases = list(plan.values())
    singles = [(c.effects[0].partition(":")[0], c.strength) for c in cases if c.kind == "single"]
    classes = {effect.partition(":")[0] for effect in EFFECTS}
    assert sorted(singles) == sorted((one, s) for one in classes for s in STRENGTHS for _ in (0, 1))
    assert [c.kind for c in cases].count("none") == 20
    asked = {case.effects[0] for case in cases if case.kind == "unknown"}
    assert asked == set(TEST_UNKNOWN) and not asked & set(CALIBRATION_UNKNOWN)
    assert len({case.seed for case in cases}) == len(plan)
    for arm in ARMS:
        own = [case.kind for case in cases if case.arm == arm]
        assert 0.2 < np.mean([kind not in SINCE for kind in own]) * len(own) / len(plan) < 0.3
        assert set(own) >= {"single", "pair", "several", "none", "unknown"}
        assert ({"changed", "unchanged"} <= set(own)) == arm.endswith(USUAL)
    of_tables = full_plan(5, 2, 20, measured=[Path("sensor.csv")])
    pairs = [case for case in of_tables.values() if case.kind == "table"]
    assert sorted(c.effects for c in pairs) == sorted([*((name,) for name in DRAWN), (), ()] * 2)
    assert {c.arm for c in pairs} == {"sensor"}
    assert {c.kind for c in short_plan(1).values()} == {"none", "single", "pair", "unknown"}


def test_a_short_set_has_no_tables(tmp_path):
    with pytest.raises(GalenError, match="--tables beside --short"):
        run(tmp_path / "set", "--short", "--tables", "sensor.csv")
    assert not (tmp_path / "set").exists()


def test_changed_labels_do_not_open(tmp_path):
    make(tmp_path / "set", SHORT, 4, 1, fake_generate)
    path = tmp_path / "set.labels" / "labels.json"
    published = path.read_text()
    path.rename(tmp_path / "set" / "labels.json")
    assert len(open_labels(tmp_path / "set")[1]) == 6
    (tmp_path / "set" / "labels.json").write_text(published.replace('"none"', '"single"', 1))
    with pytest.raises(GalenError, match="isn't what was sealed"):
        open_labels(tmp_path / "set")


def test_an_interrupted_set_goes_on(tmp_path):
    made = []

    def stops(case, directory):
        if len(made) == 3:
            raise KeyboardInterrupt
        made.append(case.seed)
        return fake_generate(case, directory)

    with pytest.raises(KeyboardInterrupt):
        make(tmp_path / "set", SHORT, 7, 1, stops)
    assert not (tmp_path / "set" / "labels.sha256").exists()

    def goes_on(case, directory):
        made.append(case.seed)
        return fake_generate(case, directory)

    told = make(tmp_path / "set", SHORT, None, 1, goes_on)
    assert not list(tmp_path.rglob("*.bak"))
    assert sorted(made) == sorted(case.seed for case in short_plan(7).values())
    assert make(tmp_path / "set", SHORT, None, 1, None) == told
    with pytest.raises(GalenError, match="other options"):
        make(tmp_path / "set", {**SHORT, "short": False}, None, 1, fake_generate)


def test_an_interrupt_ends_the_diagnosing_process(tmp_path, monkeypatch):
    make(tmp_path / "set", SHORT, 7, 1, fake_generate)
    started = []

    class Interrupted(subprocess.Popen):
        def wait(self, timeout=None):
            if not started:
                started.append(self)
                raise KeyboardInterrupt
            return super().wait(timeout)

    monkeypatch.setattr(blind_protocol.subprocess, "Popen", Interrupted)
    sleeps = (sys.executable, "-c", "import time; time.sleep(60)")
    with pytest.raises(KeyboardInterrupt):
        blind_protocol.diagnose(tmp_path / "set", 1, sleeps)
    assert started[0].returncode not in (None, 0)


def test_a_strange_directory_is_left_alone(tmp_path):
    (tmp_path / "mine.txt").write_text("x")
    with pytest.raises(GalenError, match="isn't empty"):
        make(tmp_path, SHORT, 1, 1, fake_generate)
    assert {path.name for path in tmp_path.iterdir()} == {"mine.txt"}


@pytest.mark.parametrize(
    "options",
    [[], ["make"], ["run", "--seed", "-1"], ["score", "set"], ["make", "s", "--per-class", "0"]],
)
def test_wrong_arguments(options):
    with pytest.raises(SystemExit) as ended:
        blind_check.main(options)
    assert ended.value.code == 2


def test_a_copy_that_is_not_in_a_checkout_says_where_the_command_runs(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(installed, "__file__", str(tmp_path / "a" / "b" / "blind_check.py"))
    assert installed.main() == 1
    assert "make blind" in capsys.readouterr().err
