"""Which recordings a blind check makes: of every class so many, under names that tell nothing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from galen_diagnosis.answer.answer import NONE
from galen_diagnosis.blind.plant.case import STRENGTHS, Case
from galen_diagnosis.blind.plant.listed import AMBIGUOUS, EFFECTS, PAIRS
from galen_diagnosis.blind.plant.unlisted import CALIBRATION_UNKNOWN, TEST_UNKNOWN

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
