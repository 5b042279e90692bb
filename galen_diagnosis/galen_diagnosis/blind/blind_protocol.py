"""The check's course: make, seal, publish the hash, diagnose in another process, open.

An output directory holds

    plan.json         what was asked for, and the seed once all is open
    commitment.json   the SHA-256 of the labels and the recordings' names, published first
    recordings/       what the diagnosis gets
    answers/          what it left: diagnosis.json and beside.json for each
    labels.json       the labels, when they are open

The labels lie in `labels.private_directory` till all answers are there. The diagnosing process is a
child with an environment and a working directory of its own; it gets two paths and can't read that
directory (`confine`). What this doesn't keep out: a program that finds the seed on this process's
command line and simulates the arm itself, one that runs as root where there is no Landlock, and the
workers of a Dask scheduler, which aren't started here.
"""

from __future__ import annotations

import json
import os
import secrets
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from galen_model.errors import GalenError
from galen_model.files.atomic_file import write_whole
from galen_model.files.json_fields import FieldError, get, mapping, read_json
from galen_ros.command import EXIT_FAILED, EXIT_INTERRUPTED, EXIT_OK, writing

from galen_diagnosis.blind import confine
from galen_diagnosis.blind.case import generate
from galen_diagnosis.blind.diagnosing import ANSWER, BESIDE
from galen_diagnosis.blind.labels import (
    Label,
    ParsedAnswer,
    directory_sha256,
    forget,
    opened,
    parse_answer,
    private_directory,
    sealed,
    write_sealed,
)
from galen_diagnosis.blind.making import Generate, Plan, make_all
from galen_diagnosis.blind.score import Answered

_LARGEST_JSON = 50_000_000
_KEPT_VARIABLES = (
    "PATH", "PYTHONPATH", "LD_LIBRARY_PATH", "HOME", "LANG", "LC_ALL", "TERM", "VIRTUAL_ENV",
    "AMENT_PREFIX_PATH", "COLUMNS",
)  # fmt: skip
DIAGNOSING = (sys.executable, "-m", "galen_diagnosis.blind.diagnosing")


class Places:
    """Where an output has what; the module's docstring says what each holds."""

    def __init__(self, output: Path) -> None:
        self.output = output
        self.plan = output / "plan.json"
        self.commitment = output / "commitment.json"
        self.recordings = output / "recordings"
        self.answers = output / "answers"
        self.labels = output / "labels.json"


def sealed_set(
    places: Places,
    wanted: dict[str, Any],
    seed: int | None,
    plan: Callable[[int], Plan],
    workers: int | None,
    generate: Generate = generate,
) -> str:
    """Make the recordings and seal their labels; returns their SHA-256.

    An output that was begun with the same options goes on where it stopped. wanted: what
    decides the plan but for the seed. seed: None for a random one. Raises GalenError.
    """
    started = _begun(places, wanted)
    if started and places.labels.exists():
        return str(get(_read(places.commitment), "labels_sha256"))
    private = private_directory(places.output)
    if started and places.commitment.exists() and (private / "labels.json").exists():
        return str(get(_read(places.commitment), "labels_sha256"))
    kept_seed = private / "seed.json"
    if not (started and kept_seed.exists()):
        _write(places.plan, {"wanted": wanted})
        write_sealed(kept_seed, json.dumps(secrets.randbits(64) if seed is None else seed))
    used = int(read_json(kept_seed, 100, "a seed"))
    if seed is not None and seed != used:
        raise GalenError(f"{places.output}: was begun with another seed; give a new --output")
    labels = make_all(plan(used), places.recordings, private, workers, generate)
    text, published = sealed(labels)
    write_sealed(private / "labels.json", text)
    _write(
        places.commitment, {"labels_sha256": published, "recordings": [x.recording for x in labels]}
    )
    return published


def _begun(places: Places, wanted: dict[str, Any]) -> bool:
    """Whether the output was begun with the same options; raises GalenError if with another."""
    if not places.plan.exists():
        if places.output.exists() and any(places.output.iterdir()):
            raise GalenError(f"{places.output}: isn't empty, and no blind check was begun in it")
        return False
    if get(_read(places.plan), "wanted") != wanted:
        raise GalenError(f"{places.output}: was begun with other options; give a new --output")
    return True


def diagnose_blind(
    places: Places,
    workers: int | None,
    scheduler: str | None = None,
    command: Sequence[str] = DIAGNOSING,
) -> bool:
    """Have the diagnosing process answer all; returns whether the system keeps it from the labels.

    Raises GalenError, or KeyboardInterrupt where it was interrupted.
    """
    private = private_directory(places.output)
    temporary = places.answers.with_name("work")
    for folder in (places.answers, temporary):
        folder.mkdir(parents=True, exist_ok=True)
    options = [] if workers is None else ["--workers", str(workers)]
    if scheduler is not None:
        options = ["--scheduler", scheduler]
    recordings, answers = places.recordings.resolve(), places.answers.resolve()
    allowed = [recordings, answers, temporary.resolve()]
    kept = {name: os.environ[name] for name in _KEPT_VARIABLES if name in os.environ}
    process = subprocess.Popen(
        [
            sys.executable, "-m", "galen_diagnosis.blind.confine",
            *(part for path in allowed for part in ("--allow", str(path))),
            "--", *command, str(recordings), str(answers), *options,
        ],
        stdin=subprocess.PIPE,
        cwd=recordings,
        env={**kept, "TMPDIR": str(temporary.resolve()), "OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    try:
        assert process.stdin is not None
        process.stdin.write(f"{private}\n".encode())
        process.stdin.close()
        code = process.wait()
    except BaseException:
        _end(process)
        raise
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    if code == EXIT_INTERRUPTED:
        raise KeyboardInterrupt
    if code not in (EXIT_OK, EXIT_FAILED):
        raise GalenError(f"the diagnosing process ended with {code}")
    return confine.available()


def _end(process: subprocess.Popen[bytes]) -> None:
    """Wait for its end, which a terminal's Ctrl-C brings as well; then insist."""
    for wait_s in (2.0, 15.0):
        try:
            process.wait(wait_s)
            return
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGINT)
    process.kill()
    process.wait()


def open_labels(places: Places, published: str) -> tuple[Label, ...]:
    """Open the labels, check them against the published hash, and put them into the output."""
    if places.labels.exists():
        return opened(places.labels, published)
    private = private_directory(places.output)
    labels = opened(private / "labels.json", published)
    for label in labels:
        if directory_sha256(places.recordings / label.recording) != label.sha256:
            raise GalenError(f"{places.recordings / label.recording}: isn't what was sealed")
    try:
        write_whole(places.labels, (private / "labels.json").read_text(encoding="utf-8"))
        seed = read_json(private / "seed.json", 100, "a seed")
    except OSError as error:
        raise GalenError(f"{places.labels}: can't be written: {error.strerror}") from error
    _write(places.plan, {**_read(places.plan), "seed": seed})
    forget(private)
    return labels


def answered(places: Places, labels: Sequence[Label]) -> list[Answered]:
    """Return labels with their answers; None where a diagnosis left none. Raises GalenError."""
    found = []
    for label in labels:
        folder = places.answers / label.recording
        found.append(Answered(label, _said(folder) if (folder / ANSWER).exists() else None))
    return found


def baselines(places: Places, labels: Sequence[Label]) -> dict[str, list[Answered]]:
    """Return the same for each baseline, by its name."""
    found: dict[str, list[Answered]] = {}
    beside = {label.recording: _beside(places.answers / label.recording) for label in labels}
    names = dict.fromkeys(name for one in beside.values() for name in one.get("baselines", {}))
    for name in names:
        for label in labels:
            answer = beside[label.recording].get("baselines", {}).get(name)
            path = places.answers / label.recording / BESIDE
            said = None if answer is None else _checked(path, label.recording, answer, None)
            found.setdefault(name, []).append(Answered(label, said))
    return found


def _said(folder: Path) -> ParsedAnswer:
    seconds = _beside(folder).get("seconds")
    return _checked(folder / ANSWER, folder.name, _read(folder / ANSWER), seconds)


def _checked(path: Path, recording: str, content: Any, seconds: float | None) -> ParsedAnswer:
    try:
        return parse_answer(recording, content, seconds)
    except (FieldError, TypeError, ValueError) as error:
        raise GalenError(f"{path}: {error}") from error


def _beside(folder: Path) -> dict[str, Any]:
    return dict(_read(folder / BESIDE)) if (folder / BESIDE).exists() else {}


def _read(path: Path) -> Any:
    try:
        return mapping(read_json(path, _LARGEST_JSON, "an answer"), "the content")
    except OSError as error:
        raise GalenError(f"{path}: can't be read: {error.strerror}") from error
    except FieldError as error:
        raise GalenError(f"{path}: {error}") from error


def _write(path: Path, content: Any) -> None:
    with writing(path):
        write_whole(path, json.dumps(content, indent=1))
