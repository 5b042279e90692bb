# SPDX-License-Identifier: Apache-2.0
"""`python -m galen_panel.recordings.bag_worker`: one evaluation or diagnosis, for the panel.

A process of its own, so that what a recording does to it (a crash, want of memory) ends this one
alone. Its task is one line of JSON on standard input, its progress are lines of JSON on standard
output. It ends when standard input is closed: then the panel is gone.

    {"kind": "evaluate", "recording": PATH, "tool": PATH or null, "output": PATH,
     "arm": {"urdf": TEXT, "base_frame": ..., "sensor_frame": ..., "gravity_m_s2": [...]},
     "specification": [PRESET or PATH, ...], "reference": [PATH, ...]}
    {"stage": "reading", "share": 0.4}     share: null where unknown
    {"error": "a sentence"}                the last line, where it failed
    {"verdict": "fits", "sentence": "...", "since": "..."}
                                           the last line, where it is done; since: the references
"""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from io import StringIO
from pathlib import Path
from typing import Any, TextIO

from galen_model.errors import GalenError, one_line

from galen_panel.recordings.reports import (
    DIAGNOSIS_FOLDER,
    EVALUATION,
    EVALUATION_PAGE,
    PICTURE,
)

NICENESS = 10
"""The arm's loop goes first."""
_REPORT_PERIOD_S = 0.2
_READ_SHARE = 0.9
"""Of an evaluation's time; the rest is for the picture."""
_COLUMNS = 130

OnProgress = Callable[[str, float | None], None]


def main() -> int:
    """Do one job, whose task is on standard input.

    Returns:
        The exit code: 0 done, 1 failed; the last line on standard output has the result or the
        reason.

    """
    os.nice(NICENESS)
    answers = _own_output()
    request = json.loads(sys.stdin.readline())
    threading.Thread(target=_end_with_panel, daemon=True).start()
    reporter = _Reporter(answers)
    try:
        job = {"evaluate": evaluate, "diagnose": diagnose}[request["kind"]]
        tool = None if request["tool"] is None else Path(request["tool"])
        places = Path(request["recording"]), tool, Path(request["output"])
        result = job(*places, request, reporter.progress)
    except GalenError as error:
        reporter.line({"error": str(error)})
        return 1
    except MemoryError:
        reporter.line({"error": "there is not enough memory for this recording"})
        return 1
    except Exception as error:
        reporter.line({"error": one_line(f"the program failed: {type(error).__name__}: {error}")})
        return 1
    reporter.line(result)
    return 0


def evaluate(
    recording: Path,
    tool: Path | None,
    output: Path,
    request: dict[str, Any],
    on_progress: OnProgress,
) -> dict[str, Any]:
    """Do as the command `evaluate`; writes its JSON, its picture, and its terminal's report.

    Args:
        recording: the bag.
        tool: calibration file, not None.
        output: folder that exists, for what is written.
        request: the task; its `arm` is read.
        on_progress: called with the stage, and the share that is done, 0 to 1; None where unknown.

    Returns:
        `verdict`, `sentence` and an empty `since`.

    Raises:
        GalenError: the bag or the calibration can't be used.

    """
    from galen_bags.arrays.arm_recording import description_of_bag
    from galen_bags.formats.bag import open_bag
    from galen_common.arm import ArmParameters
    from galen_gravcomp.evaluate.bag import BagJob, EvaluationSettings
    from galen_gravcomp.evaluate.bag_report import report
    from rich.console import Console

    assert tool is not None
    arm = request["arm"]
    on_progress("reading", None)
    with open_bag(recording) as bag:
        own = description_of_bag(bag)
    parameters = ArmParameters()
    if own in ("", arm["urdf"]):  # the panel's arm, with its frames and gravity
        file = output / "arm.urdf"
        if arm["urdf"]:
            file.write_text(arm["urdf"], encoding="utf-8")
        parameters = ArmParameters(
            urdf_file=str(file) if arm["urdf"] else "",
            base_frame=arm["base_frame"],
            sensor_frame=arm["sensor_frame"],
            gravity_m_s2=tuple(arm["gravity_m_s2"]),
        )
    job = BagJob(tool=tool, settings=EvaluationSettings(arm=parameters), plots=output)

    def counted(done: int, total: int | None) -> None:
        on_progress("reading", _READ_SHARE * min(1.0, done / total) if total else None)

    result = job.evaluate(recording, counted)
    made = report(result)
    content = made.content
    (output / EVALUATION).write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    page = Console(record=True, width=_COLUMNS, file=StringIO())
    made.print(page)
    page.save_html(str(output / EVALUATION_PAGE), inline_styles=True)
    for picture in output.glob("*.png"):
        picture.rename(output / PICTURE)
    return {"verdict": content["verdict"], "sentence": content["sentence"], "since": ""}


def diagnose(
    recording: Path,
    tool: Path | None,
    output: Path,
    request: dict[str, Any],
    on_progress: OnProgress,
) -> dict[str, Any]:
    """Do as the command `diagnose`, with its report; the recording describes its own arm.

    Args:
        recording: folder of the diagnosis recording.
        tool: calibration file; None: the recording's own.
        output: folder that exists, for what is written.
        request: the task; its `specification` and `reference` are read.
        on_progress: called with the stage, and the share that is done, 0 to 1; None where unknown.

    Returns:
        `verdict`, `sentence` and, in `since`, the names of the references.

    Raises:
        GalenError: the recording, the calibration or a reference can't be used.

    """
    from galen_diagnosis.diagnose import Job

    folders = {recording: output / DIAGNOSIS_FOLDER}
    job = Job(
        tool=tool,
        folders=folders,
        report=True,
        overwrite=False,
        specification=tuple(request["specification"]),
        reference=tuple(map(Path, request["reference"])),
    )
    answer = job.diagnose(recording, on_progress).answer
    since = ", ".join(answer.reference)
    return {"verdict": answer.verdict, "sentence": answer.sentence, "since": since}


class _Reporter:
    """Lines for the panel; progress not more often than can be read."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._stage = ""
        self._reported_s = -_REPORT_PERIOD_S

    def progress(self, stage: str, share: float | None) -> None:
        """Report the progress: a share of 1, None where unknown."""
        now_s = time.monotonic()
        if stage == self._stage and now_s - self._reported_s < _REPORT_PERIOD_S:
            return
        self._stage, self._reported_s = stage, now_s
        self.line({"stage": stage, "share": share})

    def line(self, content: dict[str, Any]) -> None:
        """Write a line."""
        print(json.dumps(content), file=self._stream, flush=True)


def _own_output() -> TextIO:
    """Take standard output for the answers alone; what a library prints goes to standard error."""
    own = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    return own


def _end_with_panel() -> None:
    """Wait for the end of standard input, then end this process and what it started."""
    while os.read(0, 4096):
        pass
    if os.getpgrp() == os.getpid():
        os.killpg(0, signal.SIGKILL)
    os._exit(1)


if __name__ == "__main__":
    sys.exit(main())
