# SPDX-License-Identifier: Apache-2.0
"""Evaluations and diagnoses, one after the other, each in a process of its own. No ROS.

The queue is the same for every browser. A worker that fails, is killed or has no memory left is a
job that failed with a sentence; the panel goes on.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import IO, Any, Literal

from galen_model.arm.arm import Arm
from galen_model.arm.galen import GALEN
from galen_model.errors import GalenError, one_line

from galen_panel.recordings.reports import Reports
from galen_panel.state.snapshot import CallAnswer

MOST_WAITING = 20
_MOST_ENDED = 20
_CLOSE_S = 5.0
_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
"""Numerical libraries would take all cores otherwise, and the arm's loop needs one."""


JobStage = Literal["waiting", "running", "done", "failed", "canceled"]


@dataclass(frozen=True)
class Wanted:
    """A job's task; kind: evaluate or diagnose; recording, tool: names for a person.

    arm: of a bag that doesn't describe its own. specification: presets and files, reference:
    earlier recordings; as `diagnose` takes them.
    """

    kind: str
    recording: str
    recording_id: str
    path: Path
    tool: str
    calibration_path: Path | None
    arm: Arm = field(default=GALEN, compare=False)
    specification: tuple[str, ...] = ()
    reference: tuple[Path, ...] = ()


@dataclass(frozen=True)
class QueuedJob:
    """A job's state; share: done so far, 0 to 1, None where unknown; report: its id."""

    id: int
    wanted: Wanted
    stage: JobStage = "waiting"
    doing: str = ""
    share: float | None = None
    text: str = ""
    report: str = ""
    canceling: bool = False

    @property
    def ended(self) -> bool:
        """Whether the job is over."""
        return self.stage not in ("waiting", "running")


class Jobs:
    """The queue and the thread that works it off."""

    def __init__(self, reports: Reports, command: Sequence[str] | None = None) -> None:
        """Start with an empty queue.

        Args:
            reports: where the jobs' reports are kept.
            command: the worker's; None: bag_worker. A test has its own.

        """
        self._reports = reports
        self._command = list(command or (sys.executable, "-m", "galen_panel.recordings.bag_worker"))
        self._changed = threading.Condition()
        self._jobs: list[QueuedJob] = []
        self._next_id = 1
        self._revision = 0
        self._closing = False
        self._worker: subprocess.Popen[bytes] | None = None
        self._thread: threading.Thread | None = None

    @property
    def revision(self) -> int:
        """Number of changes so far."""
        with self._changed:
            return self._revision

    @property
    def jobs(self) -> tuple[QueuedJob, ...]:
        """Open jobs in their order, then those that ended, newest first."""
        with self._changed:
            open_ = [job for job in self._jobs if not job.ended]
            ended = [job for job in reversed(self._jobs) if job.ended]
        return tuple(open_ + ended)

    def submit(self, wanted: Wanted) -> CallAnswer:
        """Put a task at the queue's end, unless it is there already.

        Args:
            wanted: the task.

        Returns:
            Whether it is in the queue now, and a sentence.

        """
        with self._changed:
            open_ = [job for job in self._jobs if not job.ended]
            if self._closing:
                return CallAnswer(False, "The panel is ending.")
            if any(job.wanted == wanted for job in open_):
                return CallAnswer(False, f"{wanted.recording} is in the queue already.")
            if len(open_) > MOST_WAITING:
                return CallAnswer(False, f"{MOST_WAITING} wait already. Cancel some, or wait.")
            self._jobs.append(QueuedJob(self._next_id, wanted))
            self._next_id += 1
            self._announce()
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="recordings", daemon=True)
                self._thread.start()
        if open_:
            return CallAnswer(True, f"{wanted.recording} is in the queue, {len(open_)} before it.")
        return CallAnswer(True, f"{wanted.recording}: begun.")

    def cancel(self, job_id: int) -> CallAnswer:
        """End a job, or take it out of the queue.

        Args:
            job_id: the job's.

        Returns:
            Whether there was something to cancel, and a sentence.

        """
        with self._changed:
            job = self._find(job_id)
            if job is None or job.ended:
                return CallAnswer(False, "That is over already.")
            if job.stage == "waiting":
                self._put(replace(job, stage="canceled", text="Canceled."))
            else:
                self._put(replace(job, canceling=True))
                self._kill()
        return CallAnswer(True, f"{job.wanted.recording}: canceled.")

    def close(self) -> None:
        """End what runs, forget what waits."""
        with self._changed:
            self._closing = True
            self._kill()
            self._changed.notify_all()
            thread = self._thread
        if thread is not None:
            thread.join(_CLOSE_S)

    # Inside; with the lock

    def _find(self, job_id: int) -> QueuedJob | None:
        return next((job for job in self._jobs if job.id == job_id), None)

    def _put(self, job: QueuedJob) -> None:
        self._jobs = [job if one.id == job.id else one for one in self._jobs]
        ended = [one.id for one in self._jobs if one.ended]
        old = set(ended[:-_MOST_ENDED])
        self._jobs = [one for one in self._jobs if one.id not in old]
        self._announce()

    def _announce(self) -> None:
        self._revision += 1
        self._changed.notify_all()

    def _kill(self) -> None:
        # The worker writes nothing that matters before it is done.
        if self._worker is not None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self._worker.pid, signal.SIGKILL)

    # Inside; the thread

    def _run(self) -> None:
        while (job := self._wait_for_next()) is not None:
            try:
                self._do(job)
            except (GalenError, OSError) as error:
                self._end(job.id, "failed", f"It failed: {error}.")

    def _wait_for_next(self) -> QueuedJob | None:
        with self._changed:
            while True:
                if self._closing:
                    return None
                waiting = [job for job in self._jobs if job.stage == "waiting"]
                if waiting:
                    job = replace(waiting[0], stage="running", doing="starting")
                    self._put(job)
                    return job
                self._changed.wait()

    def _do(self, job: QueuedJob) -> None:
        folder = self._reports.begin()
        try:
            with tempfile.TemporaryFile() as complaints:
                last, code = self._work(job, folder, complaints)
                said = _last_line(complaints)
            if code == 0 and "verdict" in last:
                report = self._reports.finish(
                    folder,
                    {
                        "kind": job.wanted.kind,
                        "recording": job.wanted.recording,
                        "recording_id": job.wanted.recording_id,
                        "tool": job.wanted.tool,
                        "verdict": str(last["verdict"]),
                        "sentence": str(last.get("sentence", "")),
                        "since": str(last.get("since", "")),
                    },
                )
                self._end(job.id, "done", report.sentence, report.id)
                return
        finally:
            self._reports.discard(folder)
        self._fail(job.id, last, code, said)

    def _work(
        self, job: QueuedJob, folder: Path, complaints: IO[bytes]
    ) -> tuple[Mapping[str, Any], int]:
        """Run the worker; returns its last line and its exit code."""
        with self._changed:
            if self._closing:
                return {}, -signal.SIGKILL
            worker = self._worker = subprocess.Popen(
                self._command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=complaints,
                env={**os.environ, **_ONE_THREAD},
                start_new_session=True,
            )
            if self._canceling(job.id):
                self._kill()
        assert worker.stdin is not None and worker.stdout is not None
        wanted = job.wanted
        tool = None if wanted.calibration_path is None else str(wanted.calibration_path.absolute())
        request = {
            "kind": wanted.kind,
            "recording": str(wanted.path.absolute()),
            "tool": tool,
            "output": str(folder.absolute()),
            "arm": {
                # The rods of the Galen can't be in a description.
                "urdf": "" if wanted.arm.delta is not None else wanted.arm.urdf,
                "base_frame": wanted.arm.base_frame,
                "sensor_frame": wanted.arm.sensor_frame,
                "gravity_m_s2": wanted.arm.gravity_m_s2.tolist(),
            },
            "specification": wanted.specification,
            "reference": [str(path.absolute()) for path in wanted.reference],
        }
        last: Mapping[str, Any] = {}
        watch = threading.Thread(target=self._end_group_with, args=(worker,), daemon=True)
        watch.start()
        try:
            # Its standard input stays open: its end tells the worker that the panel is gone.
            with contextlib.suppress(BrokenPipeError):
                worker.stdin.write(json.dumps(request).encode() + b"\n")
                worker.stdin.flush()
            for line in worker.stdout:
                last = _parsed(line)
                if "stage" in last:
                    self._progress(job.id, str(last["stage"]), last.get("share"))
            watch.join()
        finally:
            with self._changed:
                self._kill()
                code = worker.wait()
                self._worker = None
            with contextlib.suppress(BrokenPipeError):
                worker.stdin.close()
            worker.stdout.close()
        return last, code

    def _end_group_with(self, worker: subprocess.Popen[bytes]) -> None:
        """End what the worker started when it has ended itself; that may hold its output open."""
        # Its number isn't another process's as long as it was not waited for.
        os.waitid(os.P_PID, worker.pid, os.WEXITED | os.WNOWAIT)
        with self._changed:
            if self._worker is worker:
                self._kill()

    def _canceling(self, job_id: int) -> bool:
        job = self._find(job_id)
        return job is not None and job.canceling

    def _progress(self, job_id: int, doing: str, share: object) -> None:
        with self._changed:
            job = self._find(job_id)
            if job is not None:
                part = float(share) if isinstance(share, int | float) else None
                self._put(replace(job, doing=doing, share=part))

    def _fail(self, job_id: int, last: Mapping[str, Any], code: int, said: str) -> None:
        with self._changed:
            canceled = self._canceling(job_id) or self._closing
        if canceled:
            self._end(job_id, "canceled", "Canceled.")
        elif "error" in last:
            self._end(job_id, "failed", f"It failed: {last['error']}")
        elif code < 0:
            # Not signal.Signals, which lacks most real-time signals.
            name = f"signal {-code} ({signal.strsignal(-code)})"
            hint = " Perhaps there was not enough memory." if code == -signal.SIGKILL else ""
            self._end(job_id, "failed", f"Its process was ended by {name}.{hint}")
        else:
            detail = f": {said}" if said else "."
            self._end(job_id, "failed", f"Its process ended with code {code}{detail}")

    def _end(self, job_id: int, stage: JobStage, text: str, report: str = "") -> None:
        with self._changed:
            job = self._find(job_id)
            if job is not None:
                self._put(replace(job, stage=stage, text=text, report=report, share=None))


def _parsed(line: bytes) -> Mapping[str, Any]:
    try:
        content = json.loads(line)
    except ValueError:
        return {}
    return content if isinstance(content, dict) else {}


def _last_line(complaints: IO[bytes]) -> str:
    """Read the last line of the worker's standard error."""
    end = complaints.seek(0, os.SEEK_END)
    complaints.seek(max(0, end - 4096))
    lines = complaints.read().decode(errors="replace").strip().splitlines()
    return one_line(lines[-1]) if lines else ""
