"""What a diagnosis leaves on the disk: a directory, there whole or not at all."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import yaml
from galen_model.files.atomic_file import sync_directory
from galen_ros.command import check_parent, writing
from galen_sim_driver.effects.effect import Effect
from galen_sim_driver.parameters import driver_file

from galen_diagnosis.answer.answer import Answer
from galen_diagnosis.errors import DiagnosisError
from galen_diagnosis.report.report import report

DIAGNOSIS, REPORT, EFFECT, PICTURES = (
    "diagnosis.json",
    "report.html",
    "found_effect.yaml",
    "pictures",
)


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
    answer: Answer,
    folder: Path,
    *,
    driver: str | None = None,
    draw: Callable[[Path], Mapping[str, Path]] | None = None,
    overwrite: bool = False,
) -> None:
    """Write diagnosis.json and, where given, found_effect.yaml, report.html with its pictures.

    They are made in a directory beside, which is renamed once all are there.

    Args:
        answer: the answer.
        folder: the directory.
        driver: `effect_file`'s text.
        draw: writes the pictures into a directory, by name; None for no report.
        overwrite: whether an old diagnosis is replaced.

    Raises:
        GalenError: an old directory is then untouched.

    """
    check_output(folder, overwrite=overwrite)
    with writing(folder):
        folder.parent.mkdir(parents=True, exist_ok=True)
        made = Path(tempfile.mkdtemp(dir=folder.parent, prefix=f".{folder.name}."))
        try:
            content = json.dumps(answer.to_json(), indent=2, allow_nan=False)
            (made / DIAGNOSIS).write_text(content + "\n", encoding="utf-8")
            if driver is not None:
                (made / EFFECT).write_text(driver, encoding="utf-8")
            if draw is not None:
                page = report(answer, draw(made / PICTURES))
                (made / REPORT).write_text(page, encoding="utf-8")
            made.chmod(0o755)  # mkdtemp's 0700 would hide it from the lab's others
            _put(made, folder, overwrite=overwrite)
        finally:
            shutil.rmtree(made, ignore_errors=True)
        sync_directory(folder.parent)


def _put(made: Path, folder: Path, *, overwrite: bool) -> None:
    """Give the new directory its name; an old one is moved aside first and then removed."""
    if not (overwrite and folder.exists()):
        made.rename(folder)  # fails where a directory with files came there meanwhile
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


def effect_file(recording: str, effects: Sequence[Effect]) -> str | None:
    """Return the found effects as the driver's parameters, YAML; None where there are none.

    Raises ConfigError: the driver has one of each effect, so that two of a kind are rejected.
    """
    if not effects:
        return None
    # A recording's name is whatever its directory is called: no line may end in it.
    name = "".join(letter if letter.isprintable() else "?" for letter in recording)
    head = _HEAD.format(recording=name, causes=", ".join(effect.identity for effect in effects))
    content = {f"/**/{node}": below for node, below in driver_file(effects).items()}
    return head + yaml.safe_dump(content, sort_keys=False)
