"""Real evaluations and diagnoses by the worker, what the page shows of them, what is served."""

import asyncio
import json
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

import httpx
import pytest
from galen_panel.access import Access
from galen_panel.recordings.jobs import JobStage
from galen_panel.recordings.recordings import REPORTS_PATH, Recordings
from galen_panel.recordings.report_files import EVALUATION, PICTURE, StoredReport, StoredReportError
from galen_panel.recordings.report_view import VERDICTS, view_of
from galen_panel.snapshot import NodeLevel
from starlette.applications import Starlette

BAGS = Path(__file__).resolve().parents[2] / "bags"
PATIENCE_S = 300.0


def finished(recordings, job_id, patience_s=PATIENCE_S):
    """A job's end, and the shares that it told on the way."""
    shares = []
    end_s = time.monotonic() + patience_s
    while time.monotonic() < end_s:
        job = recordings.jobs.get(job_id)
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
        one.close()


def ask(recordings, path, method="GET", **headers):
    """A browser's request, past the panel's own guard."""
    app = Starlette()
    recordings.serve(app)
    transport = httpx.ASGITransport(Access(app, None, 8080))

    async def asked():
        async with httpx.AsyncClient(transport=transport, base_url="http://127.0.0.1:8080") as c:
            return await c.request(method, f"{REPORTS_PATH}/{path}", headers=headers)

    return asyncio.run(asked())


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_an_evaluation_says_what_the_command_says(make, tmp_path):
    recordings = make(BAGS)
    found = next(one for one in recordings.search().recordings if one.name == "free_motion")
    answer = recordings.start(found.id, "tools:retractor")
    assert answer.ok, answer.text
    job, shares = finished(recordings, 1)
    assert job.stage is JobStage.DONE, job.text
    assert shares == sorted(shares)  # none where it was done between two looks
    (report,) = recordings.reports.all()
    assert (report.verdict, report.tool, report.recording) == ("fits", "retractor", "free_motion")
    content = recordings.reports.content(report)
    command = [sys.executable, "-m", "galen_gravcomp.evaluate.command", BAGS / "free_motion",
               "--json", "--tool", BAGS / "tools" / "retractor.json"]  # fmt: skip
    said = subprocess.run(command, capture_output=True, text=True, check=True)
    assert content == json.loads(said.stdout)

    view = view_of(report, content, list(recordings.reports.files(report)))
    assert view.level is NodeLevel.OK and view.sentence == content["sentence"]
    left = view.tables[0]
    assert left.title.startswith("Residual") and len(left.headers) == 7
    fx_n = content["rmse"]["still_phases"]["fx"]
    assert left.rows[0][:2] == ["means of still phases", f"{1e3 * fx_n:.2f}"]
    assert view.picture == PICTURE and view.page == ""

    picture = ask(recordings, f"{report.id}/{PICTURE}")
    assert picture.headers["content-type"] == "image/png"
    assert picture.content.startswith(b"\x89PNG") and len(picture.content) > 10_000
    assert ask(recordings, f"{report.id}/{EVALUATION}").json() == content

    again = make(BAGS)
    assert again.reports.all() == [report]


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_an_evaluation_that_can_not_be_made_is_told(make, tmp_path):
    folder = tmp_path / "bags"
    shutil.copytree(BAGS / "free_motion", folder / "cut")
    whole = (folder / "cut" / "free_motion.mcap").read_bytes()
    (folder / "cut" / "free_motion.mcap").write_bytes(whole[:100])
    recordings = make(folder)
    (found,) = recordings.search().recordings
    assert recordings.start(found.id, "tools:retractor").ok
    job, _ = finished(recordings, 1)
    assert job.stage is JobStage.FAILED and job.text.startswith("It failed: ")
    assert "cut" in job.text and recordings.reports.all() == []


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_diagnosis_finds_its_cause_and_its_page_runs_nothing(make, tmp_path):
    from galen_diagnosis.examples.simulated_recording import make_recording
    from galen_sim_driver.effects.joints import JointGain

    folder = tmp_path / "bags"
    make_recording(folder / "tilted", [JointGain("tilt", 0.02)], seed=13)
    recordings = make(folder)
    found = next(one for one in recordings.search().recordings if one.name == "tilted")
    answer = recordings.start(found.id, "beside")
    assert answer.ok, answer.text
    job, shares = finished(recordings, 1, 800.0)
    assert job.stage is JobStage.DONE, job.text
    assert shares == sorted(shares) and max(shares) > 0.5
    (report,) = recordings.reports.all()
    assert report.kind == "diagnose" and report.verdict == "identified"
    content = recordings.reports.content(report)
    files = list(recordings.reports.files(report))
    view = view_of(report, content, files)
    causes = next(one for one in view.tables if one.title == "Causes")
    assert causes.rows[0][0] == "gain of the tilt joint"
    assert "(" in causes.rows[0][2] and "%" in causes.rows[0][3]
    assert view.page == "report.html" and "found_effect.yaml" in files
    assert next(name for name, _ in view.lists) == "What to do next"
    page = ask(recordings, f"{report.id}/report.html")
    assert page.headers["content-type"] == "text/html; charset=utf-8"
    policy = page.headers["content-security-policy"]
    assert policy.startswith("sandbox; default-src 'none'") and "script-src" not in policy
    effect = ask(recordings, f"{report.id}/found_effect.yaml")
    assert effect.headers["content-disposition"].startswith("attachment")


def test_nothing_but_a_reports_files_is_served(make, tmp_path):
    recordings = make(BAGS)
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "secret.json").write_text("{}")
    for path in ("", "x", "x/y", "../secret.json", "..%2fsecret.json", "%2e%2e/secret.json",
                 "./secret.json", "x/..%2f..%2fsecret.json", "x/%00"):  # fmt: skip
        assert ask(recordings, path).status_code == 404, path
    assert ask(recordings, "x/y", "POST").status_code == 405
    assert ask(recordings, "x/y", Origin="http://evil.example").status_code == 403


# What the page shows


def report_of(kind, verdict="unknown"):
    return StoredReport(
        "id", kind, "run", "id", "pointer", "2026-11-22T09:00:00+00:00", verdict, "So."
    )


@pytest.mark.parametrize("kind", ["evaluate", "diagnose"])
@pytest.mark.parametrize("content", [{}, {"rmse": None}, {"causes": [{}]}])
def test_a_damaged_report_is_an_error_that_is_told(kind, content):
    with pytest.raises(StoredReportError, match="damaged"):
        view_of(report_of(kind), content, [])


def test_each_verdict_has_words():
    from typing import get_args

    from galen_diagnosis.answer.answer import Verdict
    from galen_model.evidence.verdict import Cause

    folder = Path(__file__).resolve().parents[2] / "galen_gravcomp/galen_gravcomp/evaluate"
    judged = {name for path in folder.glob("*.py")
              for name in re.findall(r"\bCause\.([A-Z_]+)", path.read_text())}  # fmt: skip
    wanted = {("evaluate", Cause[name].word) for name in judged}
    wanted |= {("diagnose", one) for one in get_args(Verdict)}
    assert set(VERDICTS) == wanted
    assert len({word for _, word in VERDICTS.values()}) == len(VERDICTS)


def diagnosis(verdict, causes=(), experiment=None):
    return {
        "verdict": verdict,
        "causes": list(causes),
        "ranking": [{"effect": "none", "probability": 1.0}],
        "gap": {"closed_fraction": {"value": 0.97, "ci95": [0.95, 0.98]}},
        "next_experiment": experiment,
        "cannot_tell": ["crosstalk from noise"],
        "problems": [],
    }


def test_causes_are_said_with_numbers_people_read():
    cause = {
        "effect": "axis_gain",
        "probability": 0.934,
        "parameters": {"gain": {"value": [0.02] + [0.0] * 5, "ci95": [[0.019, 0.021]] * 6}},
        "equivalent": ["sensor_mount_rotation"],
        "gap_closed": None,
    }
    drift = {
        "effect": "sensor_saturation",
        "probability": 0.5,
        "parameters": {"axis": "fz", "limit": {"value": 12.0, "ci95": None}},
        "equivalent": [],
        "gap_closed": {"value": 0.5, "ci95": None},
    }
    content = diagnosis("ambiguous", [cause, drift], {"separates": [], "do": "push harder"})
    view = view_of(report_of("diagnose", "ambiguous"), content, ["report.html"])
    first, second = view.tables[0].rows
    assert first[:2] == ["gains of the sensor's axes", "93.4%"]
    assert first[2].startswith("gain: 2.0") and first[3:] == ["–", "turned sensor"]
    assert "fz" in second[2] and "12" in second[2] and second[3:] == ["50%", "–"]
    told = dict(view.lists)
    assert told["What to do next"] == ["Push harder."]
    assert told["Gap"] == ["With what was found 97% (95% to 98%) of the gap is closed."]
    assert told["What can't be told"] == ["Crosstalk from noise."]
    assert (view.page, view.picture) == ("report.html", "")


@pytest.mark.parametrize("verdict", ["none", "identified", "ambiguous", "unknown"])
def test_what_to_do_next_is_always_said(verdict):
    view = view_of(report_of("diagnose", verdict), diagnosis(verdict), [])
    (todo,) = dict(view.lists)["What to do next"]
    assert todo.endswith(".")
