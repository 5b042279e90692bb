# SPDX-License-Identifier: Apache-2.0
"""Real evaluations and diagnoses by the worker, what the page shows of them, what is served."""

import asyncio
import json
import re
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import httpx
import numpy as np
import pytest
from galen_bags.formats.writer import BagWriter
from galen_common.cdr import joint_state_bytes, wrench_bytes
from galen_model.arm.description import read_arm
from galen_model.arm.galen import GALEN
from galen_model.files.calibration_file import CalibrationFile, write_calibration, zeroed_at
from galen_model.load.model import LoadEstimate
from galen_panel.access import Access
from galen_panel.recordings import reports as report_files
from galen_panel.recordings.bag_worker import diagnose, evaluate
from galen_panel.recordings.recordings import Recordings
from starlette.applications import Starlette

BAGS = Path(__file__).resolve().parents[2] / "bags"
PATIENCE_S = 300.0


def finished(recordings, job_id, patience_s=PATIENCE_S):
    """A job's end, and the shares that it told on the way."""
    shares = []
    end_s = time.monotonic() + patience_s
    while time.monotonic() < end_s:
        job = next(job for job in recordings.jobs.jobs if job.id == job_id)
        if job.ended:
            return job, shares
        if job.share is not None and job.share not in shares[-1:]:
            shares.append(job.share)
        time.sleep(0.02)
    raise AssertionError(f"waited {patience_s} s in vain for {job}")


@pytest.fixture
def make(tmp_path):
    made = []

    def of(bags_dir):
        recordings = Recordings(bags_dir, BAGS / "tools", tmp_path / "out")
        made.append(recordings)
        return recordings

    yield of
    for one in made:
        one.jobs.close()


def ask(recordings, path, method="GET", **headers):
    """A browser's request, past the panel's own guard."""
    app = Starlette()
    recordings.reports.serve(app)
    transport = httpx.ASGITransport(Access(app, None, 8080))

    async def asked():
        async with httpx.AsyncClient(transport=transport, base_url="http://127.0.0.1:8080") as c:
            return await c.request(method, f"{report_files.REPORTS_PATH}/{path}", headers=headers)

    return asyncio.run(asked())


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_an_evaluation_says_what_the_command_says(make, tmp_path):
    recordings = make(BAGS)
    found = next(one for one in recordings.search() if one.name == "free_motion")
    answer = recordings.start(found.id, "tools:retractor")
    assert answer.ok, answer.text
    job, shares = finished(recordings, 1)
    assert job.stage == "done", job.text
    assert shares == sorted(shares)  # none where it was done between two looks
    (report,) = recordings.reports.all()
    assert (report.verdict, report.tool, report.recording) == ("fits", "retractor", "free_motion")
    content = json.loads(recordings.reports.files(report)[report_files.EVALUATION].read_text())
    command = [sys.executable, "-m", "galen_gravcomp.evaluate.command", BAGS / "free_motion",
               "--json", "--tool", BAGS / "tools" / "retractor.json"]  # fmt: skip
    said = subprocess.run(command, capture_output=True, text=True, check=True)
    assert content == json.loads(said.stdout)

    page = ask(recordings, f"{report.id}/{report_files.EVALUATION_PAGE}").text
    assert "root mean square" in page and "<script" not in page
    picture = ask(recordings, f"{report.id}/{report_files.PICTURE}")
    assert picture.headers["content-type"] == "image/png"
    assert picture.content.startswith(b"\x89PNG") and len(picture.content) > 10_000
    assert ask(recordings, f"{report.id}/{report_files.EVALUATION}").json() == content

    again = make(BAGS)
    assert again.reports.all() == [report]


URDF = (BAGS.parent / "galen_bringup/urdf/six_axis.urdf").read_text()


def write_rest(folder, tool_path, arm):
    """A bag of an arm in six poses, and the file of its tool."""
    load, std = LoadEstimate(0.5, np.array([0.0, 0.01, 0.05]), 1e-8 * np.eye(4)), np.zeros(6)
    tool = CalibrationFile("gripper", load, load, std[:3], std, 20, "2026-01-01T00:00:00+00:00",
                           arm=arm, zeroing=zeroed_at(arm=arm))  # fmt: skip
    tool_path.parent.mkdir(parents=True, exist_ok=True)
    write_calibration(tool_path, tool)
    rng = np.random.default_rng(2)
    names = arm.joint_names
    wire, joints = wrench_bytes(arm.sensor_frame), joint_state_bytes(names)
    with BagWriter(folder) as bag:
        at = {name: bag.add_topic(name, kind) for name, kind in (
            ("joint_states", "sensor_msgs/msg/JointState"),
            ("wrench_raw", "geometry_msgs/msg/WrenchStamped"),
        )}  # fmt: skip
        poses = np.repeat(rng.uniform(-0.5, 0.5, (6, len(names))), 400, axis=0)
        readings = tool.predict(arm.angles(poses)) + rng.normal(size=(2400, 6)) * np.repeat(
            [0.02, 4e-4], 3
        )
        for k, (pose, reading) in enumerate(zip(poses, readings, strict=True)):
            stamp = 10**18 + k * 10**7
            bag.write(at["joint_states"], stamp, joints.fill(stamp, pose, 0.0 * pose))
            bag.write(at["wrench_raw"], stamp, wire.fill(stamp, reading))


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_bag_of_another_arm_is_evaluated_on_the_panels(tmp_path):
    arm = read_arm(URDF, sensor_frame="tool0")
    write_rest(tmp_path / "bags" / "rest", tmp_path / "tools" / "gripper.json", arm)
    recordings = Recordings(tmp_path / "bags", tmp_path / "tools", tmp_path / "out", lambda: arm)
    (found,) = recordings.search()
    assert recordings.start(found.id, "tools:gripper").ok
    job, _ = finished(recordings, 1)
    recordings.jobs.close()
    assert (job.stage, recordings.reports.all()[0].verdict) == ("done", "fits"), job.text


@pytest.mark.slow
def test_a_bag_with_its_own_description_is_evaluated_on_that(tmp_path):
    tool = tmp_path / "tools" / "gripper.json"
    write_rest(tmp_path / "rest", tool, read_arm(URDF, sensor_frame="tool0"))
    (tmp_path / "rest" / "arm.urdf").write_text(URDF)
    panels = {"urdf": "<robot/>", "base_frame": "floor", "sensor_frame": "flange",
              "gravity_m_s2": [0.0, 9.81, 0.0]}  # fmt: skip
    result = evaluate(tmp_path / "rest", tool, tmp_path, {"arm": panels}, lambda *_: None)
    assert result["verdict"] == "fits"


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_diagnosis_finds_its_cause_and_its_page_runs_nothing(make, tmp_path):
    from galen_diagnosis.simulated_recording import make_recording
    from galen_sim_driver.effects.joints import JointGain

    folder = tmp_path / "bags"
    make_recording(folder / "healthy", [], seed=12, arm=GALEN)
    make_recording(folder / "tilted", [JointGain("tilt", 0.02)], seed=13, arm=GALEN)
    recordings = make(folder)
    ids = {one.name: one.id for one in recordings.search()}
    answer = recordings.start(ids["tilted"], "beside", ["galen"], [ids["healthy"]])
    assert answer.ok, answer.text
    job, shares = finished(recordings, 1, 800.0)
    assert job.stage == "done", job.text
    assert shares == sorted(shares) and max(shares) > 0.5
    (report,) = recordings.reports.all()
    assert report.kind == "diagnose" and report.verdict == "identified"
    assert report.since == "healthy" and report.sentence.startswith("Since healthy: ")
    assert {"report.html", "found_effect.yaml"} <= set(recordings.reports.files(report))
    page = ask(recordings, f"{report.id}/report.html")
    assert page.headers["content-type"] == "text/html; charset=utf-8"
    effect = ask(recordings, f"{report.id}/found_effect.yaml")
    assert effect.headers["content-disposition"].startswith("attachment")


def test_what_was_chosen_reaches_the_diagnosis(monkeypatch, tmp_path):
    from galen_diagnosis.diagnose import Job

    def answer(job, place, progress):
        assert (job.specification, job.reference) == (("ur5e", "lab.json"), (tmp_path / "old",))
        said = {"verdict": "none", "sentence": "Unchanged.", "reference": ("older", "old")}
        return SimpleNamespace(answer=SimpleNamespace(**said))

    monkeypatch.setattr(Job, "diagnose", answer)
    request = {"specification": ["ur5e", "lab.json"], "reference": [str(tmp_path / "old")]}
    said = diagnose(tmp_path / "new", None, tmp_path / "out", request, lambda *_: None)
    assert said == {"verdict": "none", "sentence": "Unchanged.", "since": "older, old"}


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_what_a_diagnosis_can_not_take_is_told_as_by_the_command(capsys, tmp_path):
    from galen_diagnosis.diagnose import main

    bags = tmp_path / "bags"
    for name, arm in (("galen", GALEN), ("six", read_arm(URDF, sensor_frame="tool0"))):
        write_rest(bags / name / "sweep", bags / name / "tool.json", arm)
    (bags / "six" / "arm.urdf").write_text(URDF)
    broken = tmp_path / "lab.json"
    broken.write_text('{"schema_version": 1, "limits": {"axis_gian": 0.01}}')
    recordings = Recordings(bags, BAGS / "tools", tmp_path / "out", specification=[str(broken)])
    ids = {one.name: one.id for one in recordings.search()}
    assert recordings.start(ids["galen"], "beside", [], [ids["six"]]).ok
    assert recordings.start(ids["galen"], "beside", [str(broken)]).ok
    texts = [finished(recordings, number)[0].text for number in (1, 2)]
    recordings.jobs.close()
    assert "six: no reference of galen, since its arm has other joints" in texts[0]
    assert "lab.json: limits.axis_gian is no effect that has a limit" in texts[1]
    for text, option in zip(
        texts, [("--reference", bags / "six"), ("--specification", broken)], strict=True
    ):
        out = "--output", tmp_path / "none"
        assert main([str(one) for one in (bags / "galen", *option, *out)]) == 1
        assert capsys.readouterr().err.strip() == text.replace("It failed", "diagnose")


def test_nothing_but_a_reports_files_is_served(make, tmp_path):
    recordings = make(BAGS)
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "secret.json").write_text("{}")
    for path in (
        "",
        "x/y",
        "../secret.json",
        "..%2fsecret.json",
        "x/..%2f..%2fsecret.json",
        "x/%00",
    ):
        assert ask(recordings, path).status_code == 404, path
    assert ask(recordings, "x/y", "POST").status_code == 405
    assert ask(recordings, "x/y", Origin="http://evil.example").status_code == 403


def test_each_verdict_has_words():
    from typing import get_args

    from galen_diagnosis.answer.answer import Verdict
    from galen_model.load.verdict import Cause

    folder = Path(__file__).resolve().parents[2] / "galen_gravcomp/galen_gravcomp/evaluate"
    judged = {name for path in folder.glob("*.py")
              for name in re.findall(r"\bCause\.([A-Z_]+)", path.read_text())}  # fmt: skip
    wanted = {("evaluate", Cause[name].word) for name in judged}
    wanted |= {("diagnose", one) for one in get_args(Verdict)}
    assert set(report_files.VERDICTS) == wanted
    assert len({word for _, word in report_files.VERDICTS.values()}) == len(report_files.VERDICTS)
