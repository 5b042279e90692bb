# SPDX-License-Identifier: Apache-2.0
"""The queue of evaluations and diagnoses: one at a time, cancelled, killed, crashed; restarts."""

import json
import os
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from pathlib import Path

import pytest
from galen_panel.recordings.bag_worker import NICENESS
from galen_panel.recordings.jobs import MOST_WAITING, Jobs, Wanted
from galen_panel.recordings.reports import EVALUATION, PICTURE, Reports

PATIENCE_S = 30.0
WORKER = """
import json, os, pathlib, signal, subprocess, sys, time

def tell(**content):
    print(json.dumps(content), flush=True)

request = json.loads(sys.stdin.readline())
output = pathlib.Path(request["output"])
what = pathlib.Path(request["recording"]).name
tell(stage="reading", share=0.25, nice=os.nice(0))
if what.startswith("good"):
    given = {key: request[key] for key in ("tool", "specification", "reference")}
    (output / "evaluation.json").write_text(json.dumps(given))
    tell(verdict="fits", sentence="It fits.", since=", ".join(request["reference"]))
elif what == "hang":
    child = subprocess.Popen(["sleep", "600"], stdin=subprocess.DEVNULL)
    (output.parent / "child").write_text(str(child.pid))
    tell(stage="hanging", share=None)
    sys.stdin.read()
elif what == "killed":
    os.kill(os.getpid(), signal.SIGKILL)
elif what == "real-time":
    os.kill(os.getpid(), 40)
elif what == "error":
    tell(error="the bag has no joint_states")
    sys.exit(1)
elif what == "crash":
    raise ValueError("a bug")
elif what == "silent":
    sys.exit(0)
elif what == "garbage":
    print("no JSON {", flush=True)
"""


def wanted(name, kind="evaluate", tool="/tools/pointer.json", **given):
    return Wanted(kind, name, f"id-{name}", Path("/bags") / name, "pointer", Path(tool), **given)


def until(predicate, what):
    end_s = time.monotonic() + PATIENCE_S
    while time.monotonic() < end_s:
        if found := predicate():
            return found
        time.sleep(0.01)
    raise AssertionError(f"waited {PATIENCE_S} s in vain for {what}")


def gone(pid):
    """Whether a process has ended; one that nobody has waited for yet has."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except OSError:
        return True


@pytest.fixture
def output(tmp_path):
    return tmp_path / "reports"


@pytest.fixture
def jobs(output):
    one = Jobs(Reports(output), [sys.executable, "-c", WORKER])
    yield one
    one.close()


def job_of(jobs, job_id):
    return next((job for job in jobs.jobs if job.id == job_id), None)


def ended(jobs, job_id):
    return until(
        lambda: (job := job_of(jobs, job_id)) and job.ended and job, f"the end of {job_id}"
    )


def folders(output):
    return [path.name for path in output.iterdir() if path.is_dir()] if output.exists() else []


def test_a_job_leaves_a_report_that_is_found_again_after_a_restart(jobs, output):
    given = {"specification": ("ur5e", "bota_sensone"), "reference": (Path("/bags/old"),)}
    assert jobs.submit(wanted("good", **given)).ok
    job = ended(jobs, 1)
    assert (job.stage, job.text) == ("done", "It fits.")
    again = Reports(output)
    (report,) = again.all()
    assert report.id == job.report and report.recording_id == "id-good"
    assert (report.verdict, report.tool, report.since) == ("fits", "pointer", "/bags/old")
    content = json.loads(again.files(report)[EVALUATION].read_text())
    assert content == {"tool": "/tools/pointer.json", "specification": ["ur5e", "bota_sensone"],
                       "reference": ["/bags/old"]}  # fmt: skip
    assert folders(output) == [report.id]


def test_a_cancel_ends_the_worker_and_all_that_it_started_and_the_next_one_runs(jobs, output):
    jobs.submit(wanted("hang"))
    answer = jobs.submit(wanted("good"))
    assert answer.ok and "1 before it" in answer.text
    assert jobs.submit(wanted("good2")).ok and jobs.cancel(3).ok
    assert [job.stage for job in jobs.jobs][1:] == ["waiting", "canceled"]
    until(lambda: job_of(jobs, 1).doing == "hanging", "it to be at work")
    child = int((output / "child").read_text())
    assert not gone(child)
    assert jobs.cancel(1).ok
    assert ended(jobs, 1).stage == "canceled"
    until(lambda: gone(child), "the child's end")
    assert ended(jobs, 2).stage == "done" and job_of(jobs, 3).stage == "canceled"
    assert len(folders(output)) == 1
    assert not jobs.cancel(1).ok and not jobs.cancel(77).ok


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("error", "It failed: the bag has no joint_states"),
        (
            "killed",
            "Its process was ended by signal 9 (Killed). Perhaps there was not enough memory.",
        ),
        ("real-time", "Its process was ended by signal 40 (Real-time signal 6)."),
        ("crash", "Its process ended with code 1: ValueError: a bug"),
        ("silent", "Its process ended with code 0."),
        ("garbage", "Its process ended with code 0."),
    ],
)
def test_a_worker_that_fails_is_told_and_the_next_one_runs(jobs, output, name, text):
    jobs.submit(wanted(name))
    jobs.submit(wanted("good"))
    job = ended(jobs, 1)
    assert (job.stage, job.text) == ("failed", text)
    assert ended(jobs, 2).stage == "done"
    assert len(folders(output)) == 1


def test_a_worker_that_can_not_be_started_or_has_no_place_to_write_is_told(output, tmp_path):
    (tmp_path / "file").write_text("")
    no_place = Jobs(Reports(tmp_path / "file" / "reports"), [sys.executable, "-c", WORKER])
    no_worker = Jobs(Reports(output), ["/nowhere/python"])
    for jobs, text in ((no_place, "can't be written"), (no_worker, "No such file")):
        jobs.submit(wanted("good"))
        assert text in ended(jobs, 1).text
        jobs.close()


def test_the_same_job_is_not_queued_twice_and_the_queue_has_an_end(jobs):
    jobs.submit(wanted("hang"))
    assert not jobs.submit(wanted("hang")).ok
    for number in range(MOST_WAITING):
        assert jobs.submit(wanted(f"good{number}")).ok
    answer = jobs.submit(wanted("good"))
    assert not answer.ok and "wait already" in answer.text


def test_close_ends_what_runs_and_takes_nothing_more(output):
    jobs = Jobs(Reports(output), [sys.executable, "-c", WORKER])
    jobs.submit(wanted("hang"))
    jobs.submit(wanted("good"))
    until(lambda: job_of(jobs, 1).doing == "hanging", "it to be at work")
    child = int((output / "child").read_text())
    jobs.close()
    until(lambda: gone(child), "the child's end")
    assert not jobs.submit(wanted("good")).ok
    assert [thread for thread in threading.enumerate() if thread.name == "recordings"] == []
    assert folders(output) == []


ENDLESS = """
import time
from galen_panel.recordings import bag_worker
bag_worker.evaluate = lambda *_: time.sleep(600)
bag_worker.main()
"""
PANEL = f"""
import sys, time
from pathlib import Path
from galen_panel.recordings.jobs import Jobs, Wanted
from galen_panel.recordings.reports import Reports
jobs = Jobs(Reports(Path(sys.argv[1])), [sys.executable, "-c", {ENDLESS!r}])
jobs.submit(Wanted("evaluate", "x", "x", Path("x"), "x", Path("x")))
while jobs._worker is None:
    time.sleep(0.01)
print(jobs._worker.pid, flush=True)
time.sleep(600)
"""


@contextmanager
def process_with_a_job(output):
    panel = subprocess.Popen([sys.executable, "-c", PANEL, str(output)], stdout=subprocess.PIPE)
    try:
        yield panel, int(panel.stdout.readline())
    finally:
        panel.kill()
        panel.wait()
        panel.stdout.close()


def threads(pid):
    return len(list(Path(f"/proc/{pid}/task").iterdir()))


def test_the_real_worker_ends_when_the_panel_is_killed(output):
    with process_with_a_job(output) as (panel, worker):
        # Its second thread waits for the panel's end.
        until(lambda: threads(worker) > 1, "the worker at work")
        assert os.getpriority(os.PRIO_PROCESS, worker) == min(19, os.nice(0) + NICENESS)
        panel.kill()
        panel.wait()
        until(lambda: gone(worker), "the worker's end")


FAILING = """
from galen_panel.recordings import bag_worker

def evaluate(*_):
    print("a library's chatter")
    raise {error}

bag_worker.evaluate = evaluate
raise SystemExit(bag_worker.main())
"""


@pytest.mark.parametrize(
    ("error", "text"),
    [
        ("MemoryError", "It failed: there is not enough memory for this recording"),
        ("KeyError('x')", "It failed: the program failed: KeyError: 'x'"),
    ],
)
def test_the_real_worker_tells_what_ended_it(output, error, text):
    jobs = Jobs(Reports(output), [sys.executable, "-c", FAILING.format(error=error)])
    jobs.submit(wanted("good"))
    job = ended(jobs, 1)
    assert (job.stage, job.text) == ("failed", text)
    jobs.close()


# Reports on the disk


def finish(reports, kind="evaluate", **files):
    folder = reports.begin()
    for name, content in files.items():
        path = folder / name.replace("__", "/").replace("_dot_", ".")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    told = {"kind": kind, "recording": "run", "recording_id": "id", "tool": "pointer",
            "verdict": "fits", "sentence": "It fits."}  # fmt: skip
    return reports.finish(folder, told)


def test_only_the_reports_own_files_are_served_with_fixed_types(output):
    reports = Reports(output)
    report = finish(
        reports, evaluation_dot_json=b"{}", evaluation_dot_png=b"\x89PNG", other_dot_txt=b"x"
    )
    assert set(reports.files(report)) == {EVALUATION, PICTURE}
    picture = reports.response(report.id, PICTURE)
    assert (picture.body, picture.media_type) == (b"\x89PNG", "image/png")
    saved = reports.response(report.id, EVALUATION)
    assert saved.headers["content-disposition"].startswith("attachment")
    for name in ("other.txt", "report.json", "", "..", "../report.json", "/etc/passwd",
                 f"../{report.id}/{PICTURE}", f"{PICTURE}\x00"):  # fmt: skip
        assert reports.response(report.id, name).status_code == 404
    for name in ("", "..", ".", "../..", f"{report.id}/", f"./{report.id}", "/", report.id[:-1]):
        assert reports.response(name, PICTURE).status_code == 404


def test_links_in_a_report_are_not_served(output, tmp_path):
    secret = tmp_path / "secret"
    secret.mkdir()
    (secret / "report.html").write_text("secret")
    reports = Reports(output)
    one = finish(reports, evaluation_dot_json=b"{}")
    (output / one.id / PICTURE).symlink_to(secret / "report.html")
    assert reports.response(one.id, PICTURE).status_code == 404
    two = finish(reports, "diagnose")
    (output / two.id / "diagnosis").symlink_to(secret)
    assert reports.files(two) == {}
    three = finish(reports, "diagnose", diagnosis__report_dot_html=b"<html>")
    page = reports.response(three.id, "report.html")
    assert page.headers["content-type"] == "text/html; charset=utf-8"
    policy = page.headers["content-security-policy"]
    assert policy.startswith("sandbox; default-src 'none'") and "script-src" not in policy
    (output / three.id / "diagnosis" / "report.html").unlink()
    assert reports.response(three.id, "report.html").status_code == 404


def test_a_folder_that_is_no_report_is_not_listed(output, tmp_path):
    reports = Reports(output)
    good = finish(reports, evaluation_dot_json=b"{}")
    told = json.loads((output / good.id / "report.json").read_text())
    stem = good.id[:-8]
    for number, content in enumerate(
        ["{", "[]", "{}", json.dumps(told), json.dumps({**told, "schema_version": 2}),
         json.dumps({**told, "id": f"{stem}00000005", "kind": "else"}),
         json.dumps({**told, "id": f"{stem}00000006", "verdict": 3}), "[" * 100_000]
    ):  # fmt: skip
        folder = output / f"{stem}0000000{number}"
        folder.mkdir()
        (folder / "report.json").write_text(content)
    (output / "elsewhere").mkdir()
    (output / f"{stem}0000000f").symlink_to(output / good.id)
    assert [one.id for one in Reports(output).all()] == [good.id]


def test_what_a_killed_panel_left_is_swept_a_day_later(output):
    reports = Reports(output)
    old, new = reports.begin(), reports.begin()
    day_ago_s = time.time() - 25 * 3600.0
    os.utime(old, (day_ago_s, day_ago_s))
    reports.discard(reports.begin())
    assert not old.exists() and new.exists()
