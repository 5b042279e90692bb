"""One blind case: a hidden cause in a drawn session, its recording and its truth."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
from galen_model.arrays import Array

from galen_diagnosis.blind.plant.cause import Cause
from galen_diagnosis.blind.plant.listed import AMBIGUOUS, CAUSES, EFFECTS, NEED_PUSHES, PAIRS, TWINS
from galen_diagnosis.blind.plant.machine import Machine
from galen_diagnosis.blind.plant.session import BAGS, Session, draw_session
from galen_diagnosis.blind.plant.strength import TELLABLE, Scale
from galen_diagnosis.blind.plant.tolerance import draw_tolerance
from galen_diagnosis.blind.plant.unlisted import CALIBRATION_UNKNOWN, TEST_UNKNOWN, UNLISTED
from galen_diagnosis.blind.plant.writing import write_recording
from galen_diagnosis.errors import DiagnosisError

STRENGTHS = {"faint": 6.0, "clear": 30.0, "gross": 150.0}
"""D of each."""

KINDS = ("none", "single", "pair", "unknown_calibration", "unknown_test", "ambiguous")

_REDRAWS = 8
_PARTED = 2.0 * TELLABLE
"""What has to be left of a cause by the other of a pair, or of an unlisted one by any effect."""


@dataclass(frozen=True)
class Case:
    """What is asked for; what isn't given, the seed draws.

    effects: names, () to let the seed draw them from the kind's list. bags: those that are
    recorded. tolerance: of the healthy arm, 1 as it usually is, 0 for exactly nominal.
    """

    seed: int
    kind: str
    effects: tuple[str, ...] = ()
    strength: str = "clear"
    bags: tuple[str, ...] = BAGS
    tolerance: float = 1.0


@dataclass(frozen=True)
class Truth:
    """What a case hides.

    effects: as in the contract's truth.json. d: D of each effect, d_all of everything together.
    left: of an unlisted one, D that the best listed effect leaves. acceptable: for each effect the
    names that can't be told from it here. capped: where a strength couldn't be reached.
    """

    seed: int
    kind: str
    strength: str
    effects: list[dict[str, Any]]
    d: list[float]
    d_all: float
    left: list[float]
    acceptable: list[list[str]]
    expected_verdict: str
    capped: bool

    def to_json(self) -> dict[str, Any]:
        """For the sealed file."""
        return asdict(self)

    @classmethod
    def from_json(cls, content: dict[str, Any]) -> Self:
        """Back from the sealed file."""
        return cls(**content)


@dataclass(frozen=True)
class Made:
    """A case worked out, not yet written: its session, causes and truth."""

    session: Session
    causes: tuple[Cause, ...]
    truth: Truth


def generate(case: Case, directory: Path, twin: Path | None = None) -> Truth:
    """Write the case's recording into a new directory; returns what it hides.

    twin: directory for the same recording, noise included, without the cause. Raises
    DiagnosisError.
    """
    if directory.exists() and any(directory.iterdir()):
        raise DiagnosisError(f"{directory}: is there already, and isn't empty")
    made = work_out(case)
    full = Machine(made.session, made.causes, draw_tolerance(case.seed, case.tolerance))
    directory.mkdir(parents=True, exist_ok=True)
    write_recording(directory, full)
    if twin is not None:
        twin.mkdir(parents=True, exist_ok=True)
        write_recording(twin, Machine(made.session, (), full.tolerance))
    return made.truth


def work_out(case: Case) -> Made:
    """Draw causes, give them their strength, and say what can't be told from them."""
    session = draw_session(case.seed, _bags(case))
    rng = np.random.default_rng([case.seed, 3])
    if case.kind == "none":
        truth = Truth(case.seed, "none", "", [], [], 0.0, [], [], "none", False)
        return Made(session, (), truth)
    scale = Scale(session, case.tolerance)
    listed = Listed(session, scale)
    for _ in range(_REDRAWS):
        names = case.effects or _drawn(rng, case, session)
        made, explained = _made(rng, case, session, scale, listed, names)
        if case.kind == "pair" and _parted(names, explained) < _PARTED:
            continue
        if case.kind.startswith("unknown") and made.truth.left[0] < _PARTED:
            continue
        return made
    return made


def _made(
    rng: np.random.Generator,
    case: Case,
    session: Session,
    scale: Scale,
    listed: Listed,
    names: Sequence[str],
) -> tuple[Made, list[dict[str, float]]]:
    """The case with these names, and what each listed effect leaves of each cause."""
    wanted = STRENGTHS[case.strength]
    capped = False
    causes, strengths, lefts, acceptable = [], [], [], []
    for name in names:
        if case.kind == "ambiguous":
            cause = TWINS[name].times(float(rng.choice([-1.0, 1.0])))
        else:
            cause = (CAUSES | UNLISTED)[name].draw(rng, session)
        if name in UNLISTED:
            cause, reached = scale.sized(cause, wanted, listed.left_by_best)
        else:
            cause, reached = scale.sized(cause, wanted)
        difference = scale.difference([cause])
        explained = listed.left(difference)
        lefts.append(explained)
        causes.append(cause)
        strengths.append(scale.strength(difference))
        if name in UNLISTED:
            acceptable.append(["unknown"])
        else:
            others = [e for e, rest in explained.items() if rest < TELLABLE and e != name]
            weak = ["none"] if strengths[-1] < TELLABLE else []
            acceptable.append([name, *others, *weak])
        capped = capped or bool(reached < 0.9 * wanted)
    machine = Machine(session, causes)
    effects = [
        {
            "effect": cause.name.partition(":")[0],
            "parameters": dict(cause.parameters(machine)),
        }
        for cause in causes
    ]
    unknown = any(name in UNLISTED for name in names)
    verdict = "identified" if all(len(a) == 1 for a in acceptable) else "ambiguous"
    truth = Truth(
        seed=case.seed,
        kind=case.kind,
        strength=case.strength,
        effects=effects,
        d=strengths,
        d_all=scale.strength(scale.difference(causes)),
        left=[min(explained.values()) for explained in lefts],
        acceptable=acceptable,
        expected_verdict="unknown" if unknown else verdict,
        capped=capped,
    )
    return Made(session, tuple(causes), truth), lefts


def _parted(names: Sequence[str], explained: list[dict[str, float]]) -> float:
    """D that either of a pair leaves of the other, the smaller one."""
    first, second = names
    return min(explained[0].get(second, math.inf), explained[1].get(first, math.inf))


def _bags(case: Case) -> tuple[str, ...]:
    if case.kind == "ambiguous":
        return tuple(bag for bag in case.bags if bag != "push")
    return case.bags


def _drawn(rng: np.random.Generator, case: Case, session: Session) -> tuple[str, ...]:
    there = [e for e in EFFECTS if "push" in session.takes or e not in NEED_PUSHES]
    pairs = [pair for pair in PAIRS if set(pair) <= set(there)]
    if case.kind == "single":
        return (str(rng.choice(there)),)
    if case.kind == "pair":
        return pairs[rng.integers(len(pairs))]
    lists = {
        "unknown_calibration": CALIBRATION_UNKNOWN,
        "unknown_test": TEST_UNKNOWN,
        "ambiguous": AMBIGUOUS,
    }
    if case.kind not in lists:
        raise DiagnosisError(f"{case.kind!r} is no kind of case; there are {', '.join(KINDS)}")
    return (str(rng.choice(lists[case.kind])),)


class Listed:
    """What the listed effects can explain in one session."""

    def __init__(self, session: Session, scale: Scale) -> None:
        self._scale = scale
        self._families = {
            name: [scale.family(family) for family in cause.spans(session)]
            for name, cause in CAUSES.items()
            if "push" in session.takes or name not in NEED_PUSHES
        }

    def left(self, difference: Array) -> dict[str, float]:
        """D that each effect, as large as it likes, leaves of a difference."""
        own = self._scale.strength(difference)
        return {
            name: min(family.left(difference, own) for family in families)
            for name, families in self._families.items()
        }

    def left_by_best(self, difference: Array) -> float:
        """D that the best of them leaves."""
        return min(self.left(difference).values())
