"""Write what a diagnosis found.

What a diagnosis leaves on the disk: a directory, there whole or not at all.

The effect that was found, as parameters of the simulated driver.
"""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from dataclasses import replace
from pathlib import Path

import yaml
from galen_model.files.atomic_file import sync_directory
from galen_ros.command import check_parent
from galen_sim_driver.effects.effect import ConfigError
from galen_sim_driver.parameters import driver_file

from galen_diagnosis.answer.answer import Diagnosis
from galen_diagnosis.answer.localization import where
from galen_diagnosis.errors import DiagnosisError
from galen_diagnosis.report.report import report
from galen_diagnosis.report.words import sentence

DIAGNOSIS, REPORT, EFFECT, PICTURES = (
    "diagnosis.json",
    "report.html",
    "found_effect.yaml",
    "pictures",
)


def told(diagnosis: Diagnosis) -> Diagnosis:
    """With where the gap lies and the sentence, where they aren't there yet.

    Effects that the driver can't have are left out, with a problem that says so.
    """
    answer = diagnosis.answer
    if not answer.where:
        place = where(
            diagnosis.rows,
            diagnosis.before,
            diagnosis.streams_before,
            diagnosis.floor,
            healthy=diagnosis.healthy,
        )
        answer = replace(answer, where=place.to_json())
    if not answer.sentence:
        answer = replace(answer, sentence=sentence(answer))
    try:
        effect_file(diagnosis)
    except ConfigError as error:
        problem = f"{EFFECT} is not written: {error}"
        answer = replace(answer, problems=(*answer.problems, problem))
        diagnosis = replace(diagnosis, effects=())
    return replace(diagnosis, answer=answer)


def check_output(folder: Path, *, overwrite: bool) -> None:
    """Raise GalenError where `write_output` would reject the folder, or can't write it."""
    check_parent(folder)
    if not os.path.lexists(folder):
        return
    if not overwrite:
        raise DiagnosisError(f"{folder}: is there already; --overwrite replaces an old diagnosis")
    if folder.is_symlink() or not (folder / DIAGNOSIS).is_file():
        raise DiagnosisError(f"{folder}: not overwritten: it holds no {DIAGNOSIS}")


def write_output(
    diagnosis: Diagnosis, folder: Path, *, with_report: bool = True, overwrite: bool = False
) -> list[Path]:
    """Write diagnosis.json, report.html with its pictures, found_effect.yaml; returns the files.

    They are made in a directory beside, which is renamed once all are there. Raises GalenError;
    an old directory is then untouched.
    """
    check_output(folder, overwrite=overwrite)
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        made = Path(tempfile.mkdtemp(dir=folder.parent, prefix=f".{folder.name}."))
        try:
            names = _fill(diagnosis, made, with_report=with_report)
            made.chmod(0o755)  # mkdtemp's 0700 would hide it from the lab's others
            _put(made, folder, overwrite=overwrite)
        finally:
            shutil.rmtree(made, ignore_errors=True)
        sync_directory(folder.parent)
    except OSError as error:
        raise DiagnosisError(f"{folder}: can't be written: {error.strerror or error}") from error
    return [folder / name for name in names]


def _fill(diagnosis: Diagnosis, folder: Path, *, with_report: bool) -> list[str]:
    content = json.dumps(diagnosis.answer.to_json(), indent=2, allow_nan=False)
    (folder / DIAGNOSIS).write_text(content + "\n", encoding="utf-8")
    names = [DIAGNOSIS]
    effect = effect_file(diagnosis)
    if effect is not None:
        (folder / EFFECT).write_text(effect, encoding="utf-8")
        names.append(EFFECT)
    if with_report:
        from galen_diagnosis.report.pictures import (
            write_pictures,  # slow to import, so only when asked
        )

        pictures = write_pictures(diagnosis, folder / PICTURES)
        (folder / REPORT).write_text(report(diagnosis, pictures), encoding="utf-8")
        names += [REPORT, *(f"{PICTURES}/{path.name}" for path in pictures.values())]
    return names


def _put(made: Path, folder: Path, *, overwrite: bool) -> None:
    """Give the new directory its name; an old one is moved aside first and then removed."""
    if not (overwrite and folder.exists()):
        made.rename(folder)  # fails where somebody put a directory with files there meanwhile
        return
    aside = made.with_name(made.name + ".old")
    folder.rename(aside)
    try:
        made.rename(folder)
    except OSError:
        aside.rename(folder)
        raise
    shutil.rmtree(aside, ignore_errors=True)


_HEAD = """\
# What the diagnosis of {recording} found, for the simulated driver:
# {causes}
#
#   ros2 run galen_sim_driver sim_driver_node --ros-args --params-file THIS_FILE
"""


def effect_file(diagnosis: Diagnosis) -> str | None:
    """The YAML's text; None where no effect was found. Raises ConfigError.

    The driver has one of each effect, so that two of a kind are rejected.
    """
    if not diagnosis.effects:
        return None
    head = _HEAD.format(
        recording=_one_line(diagnosis.answer.recording),
        causes=", ".join(effect.identity for effect in diagnosis.effects),
    )
    content = {f"/**/{node}": below for node, below in driver_file(diagnosis.effects).items()}
    return head + yaml.safe_dump(content, sort_keys=False)


def _one_line(text: str) -> str:
    """Without what would end a comment: a recording's name is whatever its directory is called."""
    return "".join(letter if letter.isprintable() else "?" for letter in text)
