"""Which recordings a blind check makes, under names that show nothing, and their making.

Bags go to the diagnosis, labels to the private directory.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from galen_bags.many import run_many
from galen_model.errors import GalenError
from galen_model.files.atomic_file import write_whole
from galen_model.files.json_fields import FieldError

from galen_diagnosis.answer.answer import NONE
from galen_diagnosis.blind.case import STRENGTHS, Case, Truth, generate
from galen_diagnosis.blind.causes import EFFECTS, PAIRS, TWINS
from galen_diagnosis.blind.labels import Label, LabelKind, directory_sha256, label_from_json
from galen_diagnosis.blind.unlisted import CALIBRATION_UNKNOWN, TEST_UNKNOWN

TEST, CALIBRATION = "unknown_test", "unknown_calibration"
_NONE_PER_CLASS = 20
_UNKNOWN_PER_CLASS = 2
_PAIRS_PER_CLASS = 15
_SHORT = (
    (NONE, (), "clear"),
    ("single", ("joint_zero_offset:tilt",), "gross"),
    ("single", ("bias_step",), "clear"),
    ("single", ("tool_mass_error",), "clear"),
    ("pair", ("axis_gain", "tracker_scale"), "clear"),
    (TEST, ("rattling_mass",), "gross"),
)
"""One of each sort, for a check of the program and not of its rates."""

Sort = tuple[str, tuple[str, ...], str]
"""Kind, effects and strength of a case."""


Plan = dict[str, Case]
"""What is hidden in the recordings to be made, by the names of their directories."""


def full_plan(seed: int, per_class: int, unknown: str = TEST) -> Plan:
    """Plan `per_class` recordings of each effect at each strength, and others in proportion."""
    kinds = TEST_UNKNOWN if unknown == TEST else CALIBRATION_UNKNOWN
    sorts: list[Sort] = [(NONE, (), "clear")] * (_NONE_PER_CLASS * per_class)
    sure = [strength for strength in STRENGTHS if strength != "faint"]
    for _ in range(per_class):
        sorts += [("single", (effect,), s) for effect in EFFECTS for s in STRENGTHS]
        sorts += [(unknown, (name,), s) for name in kinds for s in sure] * _UNKNOWN_PER_CLASS
        sorts += [("ambiguous", (name,), "clear") for name in TWINS]
    random = np.random.default_rng([seed, 1])
    pairs = random.choice(len(PAIRS), min(_PAIRS_PER_CLASS * per_class, len(PAIRS)), replace=False)
    sorts += [("pair", PAIRS[int(number)], "clear") for number in pairs]
    return _named(sorts, seed)


def short_plan(seed: int) -> Plan:
    """Plan one recording of each sort."""
    return _named(_SHORT, seed)


def _named(sorts: Sequence[Sort], seed: int) -> Plan:
    random = np.random.default_rng(np.random.SeedSequence(seed))
    names = random.choice(16**6, size=len(sorts), replace=False)
    seeds = random.integers(0, 2**31 - 1, size=len(sorts))
    planned = {
        f"recording_{int(name):06x}": Case(int(own), *sort)
        for name, own, sort in zip(names, seeds, sorts, strict=True)
    }
    # By name, which is at random: neither the order of work nor that of the files shows a sort.
    return dict(sorted(planned.items()))


_KINDS: dict[str, LabelKind] = {
    NONE: "none", "single": "single", "pair": "pair", "ambiguous": "ambiguous",
    TEST: "unknown", CALIBRATION: "unknown",
}  # fmt: skip
_SAME_TIME_S = 946_684_800
"""2000-01-01: the time that every file bears."""

Generate = Callable[[Case, Path], Truth]


def make(recording: Path, plan: Plan, private: Path, generate: Generate = generate) -> None:
    """Make one recording, if it isn't there whole; called in any process.

    recording: where it is to lie. private: where its label goes, written last, and the work in
    progress.
    """
    case, label = plan[recording.name], _label_path(private, recording.name)
    if label.exists() and recording.exists():
        return
    work = private / f"{recording.name}.work"
    for old in (work, recording):
        shutil.rmtree(old, ignore_errors=True)
    truth = generate(case, work)
    made = Label(
        recording=recording.name,
        kind=_KINDS[case.kind],
        effects=truth.effects,
        strength=truth.strength,
        d=min(truth.d, default=None),
        acceptable=truth.acceptable,
        plant_seed=case.seed,
        bags=tuple(case.bags),
        sha256=directory_sha256(work),
    )
    shutil.move(work, recording)
    write_whole(label, json.dumps(made.to_json()))


def _label_path(private: Path, name: str) -> Path:
    return private / f"{name}.json"


def _label(path: Path) -> Label:
    try:
        return label_from_json(json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, FieldError) as error:
        raise GalenError(f"{path}: a label can't be read: {error}") from error


def make_all(
    plan: Plan,
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
    one = partial(make, plan=plan, private=private, generate=generate)
    for outcome in run_many(one, [recordings / name for name in plan], workers=workers):
        if outcome.error is not None:
            raise GalenError(f"a recording couldn't be made: {outcome.error}")
    labels = [_label(_label_path(private, name)) for name in plan]
    same_times(recordings)
    return labels


def same_times(folder: Path) -> None:
    """Give all files and directories in a folder one time of access and change."""
    for path in (*sorted(folder.rglob("*"), reverse=True), folder):
        os.utime(path, (_SAME_TIME_S, _SAME_TIME_S))
