"""Make the recordings of a blind check.

Which recordings a blind check makes: of every class so many, under names that tell nothing.

Makes the recordings of a plan: bags for the diagnosis, labels for the private directory.

The share of a gap that its true cause closes: the same arm measured again without the cause.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from galen_bags.many.run import run_many
from galen_model.arrays import Array
from galen_model.errors import GalenError
from galen_model.files.atomic_file import write_whole
from galen_model.files.json_fields import FieldError

from galen_diagnosis.answer.answer import NONE
from galen_diagnosis.answer.gap import without_unknowns
from galen_diagnosis.blind.answers import Label, LabelKind, label_from_json
from galen_diagnosis.blind.plant.case import STRENGTHS, Case, Truth, generate
from galen_diagnosis.blind.plant.listed import AMBIGUOUS, EFFECTS, PAIRS
from galen_diagnosis.blind.plant.unlisted import CALIBRATION_UNKNOWN, TEST_UNKNOWN
from galen_diagnosis.blind.seal import directory_sha256
from galen_diagnosis.inference.refine import nothing
from galen_diagnosis.inference.search import healthy_background
from galen_diagnosis.inference.structure import leftover
from galen_diagnosis.observation.observation import UNKNOWNS, Observation
from galen_diagnosis.observation.recording import read_recording
from galen_diagnosis.observation.rows import FOLDS

TEST, CALIBRATION = "unknown_test", "unknown_calibration"
_NONE_PER_CLASS = 20
_UNKNOWN_PER_CLASS = 2
_PAIRS_PER_CLASS = 15
_SHORT = (
    (NONE, (), "clear"),
    ("single", ("joint_zero_offset:tilt",), "gross"),
    ("single", ("bias_step",), "clear"),
    ("single", ("tool_mass_error",), "faint"),
    ("pair", (), "clear"),
    (TEST, (), "gross"),
)
"""One of each sort, for a check of the program and not of its rates."""


@dataclass(frozen=True)
class Planned:
    """A recording to be made: the name of its directory and what is hidden in it."""

    recording: str
    case: Case


def full_plan(seed: int, per_class: int, *, unknown: str = TEST) -> list[Planned]:
    """Every effect at every strength `per_class` times, and the other sorts in proportion.

    For each of these 20 healthy recordings, of every kind of unknown cause two a strength that
    isn't faint, 15 pairs, and every ambiguous case. `unknown`: TEST for a check, CALIBRATION for
    training and calibration, which so never see what the check asks. The order and the names are
    random.
    """
    kinds = TEST_UNKNOWN if unknown == TEST else CALIBRATION_UNKNOWN
    sure = [strength for strength in STRENGTHS if strength != "faint"]
    sorts: list[tuple[str, tuple[str, ...], str]] = []
    for _ in range(per_class):
        sorts += [("single", (name,), strength) for name in EFFECTS for strength in STRENGTHS]
        sorts += [(NONE, (), "clear")] * _NONE_PER_CLASS
        sorts += [
            (unknown, (name,), strength) for name in kinds for strength in sure
        ] * _UNKNOWN_PER_CLASS
        sorts += [("ambiguous", (name,), "clear") for name in AMBIGUOUS]
    random = np.random.default_rng([seed, 1])
    pairs = random.choice(len(PAIRS), min(_PAIRS_PER_CLASS * per_class, len(PAIRS)), replace=False)
    sorts += [("pair", PAIRS[int(number)], "clear") for number in pairs]
    return _named(sorts, seed)


def short_plan(seed: int) -> list[Planned]:
    """One recording of each sort."""
    return _named(_SHORT, seed)


def thinned(plan: Sequence[Planned], cases: int) -> list[Planned]:
    """So many of a plan, of every sort and strength in turn; all where it has no more."""
    sorts: dict[tuple[str, str], list[Planned]] = {}
    for planned in plan:
        sorts.setdefault((planned.case.kind, planned.case.strength), []).append(planned)
    kept: list[Planned] = []
    while sorts and len(kept) < cases:
        for key in sorted(sorts):
            kept.append(sorts[key].pop())
            if not sorts[key]:
                del sorts[key]
            if len(kept) == cases:
                break
    return sorted(kept, key=lambda planned: planned.recording)


def _named(sorts: Sequence[tuple[str, tuple[str, ...], str]], seed: int) -> list[Planned]:
    random = np.random.default_rng(np.random.SeedSequence(seed))
    names = random.choice(16**6, size=len(sorts), replace=False)
    seeds = random.integers(0, 2**31 - 1, size=len(sorts))
    planned = [
        Planned(
            f"recording_{int(name):06x}",
            Case(seed=int(own), kind=kind, effects=effects, strength=strength),
        )
        for name, own, (kind, effects, strength) in zip(names, seeds, sorts, strict=True)
    ]
    # By name, which is at random: neither the order of work nor that of the files tells a sort.
    return sorted(planned, key=lambda one: one.recording)


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


def oracle_closed(recording: Path, twin: Path) -> float | None:
    """(E - E_twin) / (E - floor); None where E isn't above the floor.

    twin: the recording with the same course, tolerances and noise, and without the cause. E is the
    mean square of held-out rows as a diagnosis counts it (`gap.py`), beside the nominal simulator
    with the tolerances that the twin shows: what is left when the true cause, as it really acts, is
    taken away.
    """
    healthy = _Told(twin)
    none = nothing(healthy.observation, healthy.behind)
    tolerances = none.background[UNKNOWNS:]
    floor = leftover(healthy.observation.rows, none.rows).floor
    before, after = (one.energy(tolerances) for one in (_Told(recording), healthy))
    return None if before <= floor else float((before - after) / (before - floor))


class _Told:
    """A recording beside the nominal simulator."""

    def __init__(self, path: Path) -> None:
        self.observation = Observation(read_recording(path))
        self.behind = healthy_background(self.observation)

    def energy(self, tolerances: Array) -> float:
        """Mean square of held-out rows with these tolerances in the simulator."""
        rows = self.observation.nominal - self.behind.columns[:, UNKNOWNS:] @ tolerances
        left = np.empty(len(rows))
        for fold in range(FOLDS):
            out = self.observation.rows.fold == fold
            left[out] = without_unknowns(self.behind, rows, out)
        return float(np.mean(left**2))
