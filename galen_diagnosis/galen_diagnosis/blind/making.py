"""Makes the recordings of a plan: bags for the diagnosis, labels for the private directory."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from galen_bags.many.run import run_many
from galen_model.errors import GalenError
from galen_model.files.atomic_file import write_whole
from galen_model.files.json_fields import FieldError

from galen_diagnosis.answer.answer import NONE
from galen_diagnosis.blind.label import Label, LabelKind, label_from_json
from galen_diagnosis.blind.plan import CALIBRATION, TEST, Planned
from galen_diagnosis.blind.plant.case import Case, Truth, generate
from galen_diagnosis.blind.scoring.oracle import oracle_closed
from galen_diagnosis.blind.seal import directory_sha256

_KINDS: dict[str, LabelKind] = {
    NONE: "none", "single": "single", "pair": "pair", "ambiguous": "ambiguous",
    TEST: "unknown", CALIBRATION: "unknown",
}  # fmt: skip
_SAME_TIME_S = 946_684_800
"""2000-01-01: what every file says that it was written at."""

Generate = Callable[[Case, Path, Path | None], Truth]


@dataclass(frozen=True)
class Maker:
    """Makes one recording; called with where it is to lie, in any process.

    cases: by the recording's name. private: where the labels go, and the work in progress.
    """

    cases: dict[str, Case]
    private: Path
    generate: Generate = generate

    def __call__(self, recording: Path) -> None:
        """Make it, if it isn't there whole; a label is written last, and says that it is."""
        case = self.cases[recording.name]
        label = self._label_path(recording.name)
        if label.exists() and recording.exists():
            return
        work, twin = (self.private / f"{recording.name}{end}" for end in (".work", ".twin"))
        for old in (work, twin, recording):
            shutil.rmtree(old, ignore_errors=True)
        truth = self.generate(case, work, twin if _asks_oracle(case) else None)
        made = label_of(
            recording.name,
            case,
            truth,
            oracle_closed(work, twin) if twin.exists() else None,
            directory_sha256(work),
        )
        shutil.rmtree(twin, ignore_errors=True)
        shutil.move(work, recording)
        write_whole(label, json.dumps(made.to_json()))

    def label(self, name: str) -> Label:
        """Of a recording that was made."""
        path = self._label_path(name)
        try:
            return label_from_json(json.loads(path.read_text(encoding="utf-8")))
        except (OSError, ValueError, FieldError) as error:
            raise GalenError(f"{path}: a label can't be read: {error}") from error

    def _label_path(self, name: str) -> Path:
        return self.private / f"{name}.json"


def _asks_oracle(case: Case) -> bool:
    """Whether there is a listed cause that should close the gap."""
    return case.kind in ("single", "pair", "ambiguous") and case.strength != "faint"


def label_of(name: str, case: Case, truth: Truth, oracle: float | None, sha256: str) -> Label:
    """What is sealed of a recording."""
    return Label(
        recording=name,
        kind=_KINDS[case.kind],
        effects=tuple(truth.effects),
        strength="" if case.kind == NONE else truth.strength,
        d=min(truth.d) if truth.d else None,
        acceptable=tuple(tuple(names) for names in truth.acceptable),
        oracle_closed=oracle,
        plant_seed=case.seed,
        bags=tuple(case.bags),
        sha256=sha256,
    )


def make_all(
    plan: Sequence[Planned],
    recordings: Path,
    private: Path,
    workers: int | None,
    generate: Generate = generate,
) -> list[Label]:
    """Make what isn't there yet; returns the labels in the plan's order. Raises GalenError."""
    try:
        recordings.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise GalenError(f"{recordings}: can't be made: {error.strerror}") from error
    maker = Maker({one.recording: one.case for one in plan}, private, generate)
    places = [recordings / one.recording for one in plan]
    for outcome in run_many(maker, places, workers=workers):
        if outcome.error is not None:
            raise GalenError(f"a recording couldn't be made: {outcome.error}")
    labels = [maker.label(one.recording) for one in plan]
    same_times(recordings)
    return labels


def same_times(folder: Path) -> None:
    """Give all files and directories in a folder one time of access and change."""
    for path in sorted(folder.rglob("*"), reverse=True):
        os.utime(path, (_SAME_TIME_S, _SAME_TIME_S))
    os.utime(folder, (_SAME_TIME_S, _SAME_TIME_S))
