# SPDX-License-Identifier: Apache-2.0
"""A set's course: plan, make, seal; and have this program answer in a process kept from labels.

    SET/recordings/   what a diagnosis gets: bags, tool.json, arm.urdf
    SET/README.md     the rules in short
    SET/labels.sha256 the hash of labels.json, as `sha256sum -c` takes it
    SET.labels/       beside it, for this user alone: plan.json, a label each, labels.json
    SET.answers/      what `run` has this program and the baselines answer, a folder each

Names, sizes, stamps and counts of a recording depend on its own seed alone, and bags bear one time
of change. What this doesn't keep out: a program that finds the seed and simulates the arm itself,
and where there is no Landlock, one that reads SET.labels.
"""

from __future__ import annotations

import hashlib
import json
import os
import secrets
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from galen_bags.many import run_many
from galen_common.command import EXIT_INTERRUPTED, EXIT_OK, writing
from galen_model.arm.galen import GALEN
from galen_model.errors import GalenError
from galen_model.files.atomic_file import write_whole
from galen_model.json_fields import FieldError, read_json
from galen_sim_driver.effects.registry import contract_parameters, identities

from galen_validation.blind.case import SINCE, STRENGTHS, Case, Truth, generate
from galen_validation.blind.causes import listed
from galen_validation.blind.labels import (
    LABELS,
    SEAL,
    Label,
    LabelKind,
    beside,
    label_from_json,
    published_sha256,
    sealed,
)
from galen_validation.blind.measured_tables import DRAWN
from galen_validation.blind.mujoco_arm import require_mujoco
from galen_validation.blind.session import ARMS, USUAL, six_axis
from galen_validation.blind.unlisted import NEED_SPRINGS, TEST_UNKNOWN

_END_S = 20.0  # in which the diagnosing process ends by SIGINT
DIAGNOSING = (sys.executable, "-m", "galen_validation.blind.diagnosing")
_PER_CLASS: Mapping[LabelKind, int] = {
    "pair": 10, "ambiguous": 2, "several": 6, "changed": 10, "unchanged": 4,
}  # fmt: skip
_SHORT = (
    Case(0, "none"),
    Case(0, "single", ("joint_zero_offset:tilt",), "gross"),
    Case(0, "single", ("bias_step",)),
    Case(0, "single", ("tool_mass_error",)),
    Case(0, "pair", ("axis_gain", "tracker_scale")),
    Case(0, "unknown", ("rattling_mass",), "gross"),
)
"""One of each sort, for a check of the program and not of its rates."""

Generate = Callable[[Case, Path], Truth]

_RULES = """# A blind set of recordings

Each folder in `recordings/` holds the bags `sweep`, `motion` and `push` (MCAP; some have no `push`)
of an arm with a force/torque sensor, `tool.json` (the tool as it was calibrated), `arm.urdf` and,
of half of the arms, `specification.json` (limits of what is healthy; the others are carefully
calibrated). Each hides one to five causes of the gap between arm and model, one that is on no list,
or none. What lies within its limit is no cause. Of some, `reference` holds an earlier recording of
the same arm and tool: causes are then what has changed since, from a fifth of its limit on.
A folder with `table.csv` and `reference.csv` in place of bags has readings of a real sensor at rest
(N, N.m; gravity in the sensor's frame, m/s^2): at most one effect has come since the reference.

1. Answer from these files alone, each recording by itself. No answer may depend on another
   recording, on file times or names, or on a simulation with this set's seed.
2. An answer is `ANSWERS/<recording>/diagnosis.json` or `ANSWERS/<recording>.json`; one that is
   missing or malformed counts as wrong.
3. Freeze the program and publish the SHA-256 of your answers before `labels.json` is published.
   `sha256sum -c labels.sha256` then shows that no label has changed.

The page docs/benchmark.md of the suite Galen has the format of an answer and the scores. Effects
and their parameters, SI units; `joint` is a field of the cause, like `effect`:

"""


def rules() -> str:
    """Return the README of a set: rules, and the list's effects with their parameters."""
    lines = []
    for name, effect in {one.name: one for one in identities(GALEN).values()}.items():
        named = contract_parameters(effect) or {"stiffness": "by joint"}
        parts = [
            f"{key}[{len(value)}]" if isinstance(value, list) else key
            for key, value in named.items()
        ]
        lines.append(f"- `{name}`: {', '.join(parts)}\n")
    return _RULES + "".join(lines)


def full_plan(
    seed: int,
    per_class: int,
    healthy: int,
    unlisted: Sequence[str] = TEST_UNKNOWN,
    measured: Sequence[Path] = (),
) -> dict[str, Case]:
    """Plan a set: cases by the names of their recordings.

    There are 10 pairs, 6 cases of three to five effects, two twins, 10 changes since a reference
    and 4 references without one for each of `per_class`; arms take turns, of those with a reference
    the usual ones. Joints, pairs, twins and changes are drawn.

    Args:
        seed: Seed of the set, of which names, draws and the cases' own seeds follow.
        per_class: Recordings of each listed effect at each strength, and of each unlisted one that
            is clear and gross.
        healthy: Recordings without a cause.
        unlisted: Causes that are on no list.
        measured: Tables; a pair of each with every effect that a table shows, and two with none,
            for each of `per_class`.

    Returns:
        Cases by recording name, in the order of names.

    Raises:
        GalenError: The six-joint arm's description isn't installed.

    """
    random = np.random.default_rng([seed, 1])
    rigid = [name for name in unlisted if name not in NEED_SPRINGS]
    of_galen, of_six = [*listed(GALEN), *unlisted], [*listed(six_axis()), *rigid]
    shown = {arm: of_galen if arm.startswith("galen") else of_six for arm in ARMS}
    classes = list(dict.fromkeys(name.partition(":")[0] for name in listed(GALEN)))
    turn: list[tuple[LabelKind, str, str]] = [
        *(("single", effect, s) for effect in classes for s in STRENGTHS),
        *(("unknown", name, s) for name in unlisted for s in ("clear", "gross")),
    ]
    turn += [(kind, "", "clear") for kind, number in _PER_CLASS.items() for _ in range(number)]
    healthy_arms: list[tuple[LabelKind, str, str]] = [("none", "", "clear")] * healthy
    sorts: list[Case] = []
    for number, (kind, effect, strength) in enumerate(turn * per_class + healthy_arms):
        at = {
            arm: [x for x in names if x.partition(":")[0] == effect] for arm, names in shown.items()
        }
        # One further in each turn over the arms, so that a strength isn't always of the same one.
        arm = list(ARMS)[(number + number // len(ARMS)) % len(ARMS)]
        if kind in SINCE:  # a fifth of the limits of an arm that has some
            arm = arm.removesuffix(USUAL) + USUAL
        if effect and not at[arm]:
            arm = "galen_usual" if arm.endswith(USUAL) else "galen"
        names = (at[arm][random.integers(len(at[arm]))],) if effect else ()
        sorts.append(Case(0, kind, names, strength, arm=arm))
    of_table = [*((name,) for name in DRAWN), (), ()] * per_class
    sorts += [
        Case(0, "table", names, arm=path.stem, table=path)
        for path in measured
        for names in of_table
    ]
    return _named(sorts, seed)


def short_plan(seed: int) -> dict[str, Case]:
    """Plan one recording of each sort.

    Args:
        seed: Seed of the set.

    Returns:
        Six cases by recording name.

    """
    return _named(_SHORT, seed)


def _named(sorts: Sequence[Case], seed: int) -> dict[str, Case]:
    """Give cases seeds and names, in whose order they come: at random, it shows no sort."""
    random = np.random.default_rng(np.random.SeedSequence(seed))
    names = random.choice(16**6, size=len(sorts), replace=False)
    seeds = random.integers(0, 2**31 - 1, size=len(sorts))
    planned = {
        f"recording_{int(name):06x}": replace(sort, seed=int(own))
        for name, own, sort in zip(names, seeds, sorts, strict=True)
    }
    return dict(sorted(planned.items()))


def make(
    folder: Path,
    wanted: Mapping[str, Any],
    seed: int | None,
    workers: int | None,
    generate: Generate = generate,
    measured: Sequence[Path] = (),
) -> str:
    """Make a set, or what it lacks of one that was begun.

    Args:
        folder: The set; labels and plan go into `FOLDER.labels` beside it.
        wanted: `per_class`, `healthy` and `short`, as the command's options.
        seed: Seed of the set; None for a random one, or that of the set that was begun.
        workers: Processes; None for one per processor.
        generate: Makes a recording in a directory; tests replace it.
        measured: Tables for pairs; a short set has none.

    Returns:
        SHA-256 of the labels, hexadecimal.

    Raises:
        GalenError: The set was begun with other options, the folder holds something else, MuJoCo
            isn't installed, or a recording or file can't be made.

    """
    private = beside(folder, "labels")
    wanted = {**wanted, "tables": {path.stem: _sha256(path) for path in measured}}
    begun = _begun(folder, private / "plan.json")
    used = secrets.randbits(64) if seed is None else seed
    if begun is not None:
        used = begun["seed"] if seed is None else seed
        if begun != {**wanted, "seed": used}:
            raise GalenError(f"{folder}: was begun with other options; give another folder")
        if (folder / SEAL).exists():
            return published_sha256(folder)
    plan = {**wanted, "seed": used}
    cases = (
        short_plan(used)
        if wanted["short"]
        else full_plan(used, wanted["per_class"], wanted["healthy"], measured=measured)
    )
    require_mujoco()
    recordings = folder / "recordings"
    with writing(folder):
        recordings.mkdir(parents=True, exist_ok=True)
        private.mkdir(mode=0o700, exist_ok=True)
        if begun is None:
            write_whole(private / "plan.json", json.dumps(plan))
        (folder / "README.md").write_text(rules(), encoding="utf-8")
    one = partial(make_one, cases=cases, private=private, generate=generate)
    for outcome in run_many(one, [recordings / name for name in cases], workers=workers):
        if outcome.error is not None:
            raise GalenError(f"a recording couldn't be made: {outcome.error}")
    for path in (*sorted(recordings.rglob("*"), reverse=True), recordings):
        os.utime(path, (_SAME_TIME_S, _SAME_TIME_S))
    text, published = sealed(plan, [_label(private / f"{name}.json") for name in cases])
    with writing(folder):
        write_whole(private / LABELS, text)
        write_whole(folder / SEAL, f"{published}  {LABELS}\n")
    return published


_SAME_TIME_S = 946_684_800
"""2000-01-01: the time that every recorded file bears."""


def _sha256(path: Path) -> str:
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise GalenError(f"{path}: can't be read: {error}") from error


def _begun(folder: Path, plan: Path) -> dict[str, Any] | None:
    """Return the plan of a set that was begun; raises GalenError where something else is there."""
    if not plan.exists():
        if folder.exists() and any(folder.iterdir()):
            raise GalenError(f"{folder}: isn't empty, and no set was begun in it")
        return None
    try:
        return dict(read_json(plan, 10_000, "a plan"))
    except (OSError, FieldError, TypeError, ValueError) as error:
        raise GalenError(f"{plan}: can't be read: {error}") from error


def make_one(
    recording: Path, cases: Mapping[str, Case], private: Path, generate: Generate = generate
) -> None:
    """Make one recording with its label, unless both are there.

    The label is written last. Called in any process.

    Args:
        recording: Directory to write, named as in `cases`.
        cases: All planned cases by recording name.
        private: Folder of labels and unfinished recordings.
        generate: Writes the recording of a case.

    Raises:
        GalenError: The recording can't be made.

    """
    case, label = cases[recording.name], private / f"{recording.name}.json"
    if label.exists() and recording.exists():
        return
    work = private / f"{recording.name}.work"
    for old in (work, recording):
        shutil.rmtree(old, ignore_errors=True)
    truth = generate(case, work)
    if case.table is None and not (work / "arm.urdf").exists():
        (work / "arm.urdf").write_text(GALEN.urdf, encoding="utf-8")
    made = Label(
        recording=recording.name,
        kind=case.kind,
        effects=truth.effects,
        strength=truth.strength,
        d=min(truth.d, default=None),
        acceptable=truth.acceptable,
        arm=case.arm,
    )
    shutil.move(work, recording)
    write_whole(label, json.dumps(asdict(made)))


def _label(path: Path) -> Label:
    try:
        return label_from_json(read_json(path, 1_000_000, "a label"))
    except (OSError, FieldError) as error:
        raise GalenError(f"{path}: a label can't be read: {error}") from error


def diagnose(folder: Path, workers: int | None, command: Sequence[str] = DIAGNOSING) -> None:
    """Have the diagnosing process answer what has no answer yet.

    The process runs in a session of its own; an exception here interrupts it.

    Args:
        folder: The set; answers go into `FOLDER.answers` beside it.
        workers: Processes of the diagnosis; None for one per processor.
        command: Start of the command line, before recordings, answers and labels.

    Raises:
        GalenError: The process ended with an error, or the answers' folder can't be made.
        KeyboardInterrupt: The process was interrupted.

    """
    private, answers = beside(folder, "labels").resolve(), beside(folder, "answers")
    with writing(answers):
        answers.mkdir(exist_ok=True)
    options = [] if workers is None else ["--workers", str(workers)]
    with (
        tempfile.TemporaryDirectory(prefix="galen_blind_check_") as temporary,
        subprocess.Popen(
            [*command, str(folder / "recordings"), str(answers), str(private), *options],
            env={**os.environ, "TMPDIR": temporary, "PYTHONPATH": os.pathsep.join(sys.path)}
            | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
            start_new_session=True,
        ) as process,
    ):
        try:
            code = process.wait()
        except BaseException:
            os.killpg(process.pid, signal.SIGINT)
            try:
                process.wait(_END_S)
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()
            raise
    if code == EXIT_INTERRUPTED:
        raise KeyboardInterrupt
    if code != EXIT_OK:
        raise GalenError(f"the diagnosing process ended with {code}")
