"""One blind case: a hidden cause in a drawn session, its recording and its truth.

How strong a cause is, D, is its distance from no cause in standard deviations: with d what it
changes of the whitened rows of the same arm's healthy recording, and N their unknowns and
tolerances with their prior S,

    D^2 = d^T d - b^T (N^T N + S^-1)^-1 b,    b = N^T d.

What other effects leave of D, each by its linear templates (`baselines.templates`), shows which
names this recording can't separate from the true one.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from galen_model.arrays import Array
from galen_model.errors import GalenError
from galen_sim_driver.effects.effect import Effect, Instants, Loading
from scipy.spatial.transform import Rotation

from galen_diagnosis.blind.baselines import explained, templates
from galen_diagnosis.blind.causes import EFFECTS, LISTED, NEED_PUSHES, PAIRS, TWINS, Cause
from galen_diagnosis.blind.measuring import Measurement, draw_tolerance, write_recording
from galen_diagnosis.blind.session import BAGS, draw_session
from galen_diagnosis.blind.unlisted import CALIBRATION_UNKNOWN, TEST_UNKNOWN, UNLISTED
from galen_diagnosis.effects.candidates import unknown_columns
from galen_diagnosis.inference.search import healthy_background
from galen_diagnosis.observation.observation import Observation
from galen_diagnosis.observation.recording import read_recording

STRENGTHS = {"faint": 6.0, "clear": 30.0, "gross": 150.0}
"""D of each."""

KINDS = ("none", "single", "pair", "unknown_calibration", "unknown_test", "ambiguous")

TELLABLE = 3.3
"""Two causes nearer to each other than this can't be separated: 5 % errors each way, 2 x 1.65."""
_PARTED = 2.0 * TELLABLE
"""What has to stay of a cause beside the other of a pair, or of an unlisted one beside any."""
_REDRAWS = 3
_NEAR = 1.25
_STEPS = 5


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

    effects: as in the contract's truth.json. d: D of each; of an unlisted one what the best listed
    effect leaves. acceptable: for each the names that this recording can't separate from it.
    """

    strength: str = ""
    effects: tuple[dict[str, Any], ...] = ()
    d: tuple[float, ...] = ()
    acceptable: tuple[tuple[str, ...], ...] = ()


def generate(case: Case, directory: Path) -> Truth:
    """Write the case's recording into a new directory; returns what it hides.

    Raises GalenError.
    """
    if directory.exists() and any(directory.iterdir()):
        raise GalenError(f"{directory}: is there already, and isn't empty")
    bags = tuple(b for b in case.bags if case.kind != "ambiguous" or b != "push")
    tolerance = draw_tolerance(case.seed, case.tolerance)
    healthy = Measurement(draw_session(case.seed, bags), tolerance)
    directory.mkdir(parents=True, exist_ok=True)
    if case.kind == "none":
        write_recording(directory, healthy)
        return Truth()
    with tempfile.TemporaryDirectory(prefix="galen_blind_healthy_") as folder:
        write_recording(Path(folder), healthy)
        changed, truth = _hidden(case, _Yardstick(healthy, Path(folder)))
    write_recording(directory, changed)
    return truth


@dataclass(frozen=True)
class _Difference(Effect):
    """What causes change of a measurement, as an effect that the diagnosis' rows can take."""

    name: ClassVar[str] = "difference"
    fitted: ClassVar[tuple[Any, ...]] = ()
    healthy: Any = None
    changed: Any = None

    def _reading(self, when: Instants) -> Array:
        at = when.bag, when.bag_s
        return np.asarray(self.changed.reading(*at) - self.healthy.reading(*at))

    def read(self, when: Instants, wrench: Array) -> Array:
        """Add the reading's change."""
        return wrench + self._reading(when)

    def unread(self, when: Instants, reading: Array) -> Array:
        """Subtract it."""
        return reading - self._reading(when)

    def deflect(self, when: Instants, loading: Loading) -> Array | None:
        """Return the tip's change."""
        at = when.bag, when.bag_s
        return self._moved(self.changed.tool_pose(*at), self.healthy.tool_pose(*at))

    def base_marker(self, when: Instants) -> Array | None:
        """Return the marker's change."""
        at = when.bag, when.bag_s
        return self._moved(self.changed.base_pose(*at), self.healthy.base_pose(*at))

    def _moved(self, one: tuple[Array, Array], other: tuple[Array, Array]) -> Array:
        base = self.healthy.session.base[0]
        turn = Rotation.from_matrix(one[0] @ np.swapaxes(other[0], 1, 2)).as_rotvec()
        return np.concatenate([(one[1] - other[1]) @ base, turn @ base], axis=1)


class _Yardstick:
    """Measures causes in one session, in the rows of its healthy recording."""

    def __init__(self, healthy: Measurement, recording: Path) -> None:
        self.healthy = healthy
        self._observation = Observation(read_recording(recording))
        self._behind = healthy_background(self._observation)
        unknowns = unknown_columns(self._observation)
        self._templates = list(templates(self._observation, unknowns))

    def with_causes(self, causes: Sequence[Cause]) -> Measurement:
        """Return the same arm with causes."""
        return Measurement(self.healthy.session, self.healthy.tolerance, causes, self.healthy)

    def difference(self, changed: Measurement) -> Array:
        """d: what its causes change of the rows (N,)."""
        return self._observation.change([_Difference(self.healthy, changed)])

    def strength(self, difference: Array) -> float:
        """D of a difference."""
        return math.sqrt(max(0.0, self._behind.sum_of_squares(difference)))

    def left(self, difference: Array) -> dict[str, float]:
        """D that each listed effect, as large as it likes, leaves of a difference."""
        whole = self.strength(difference) ** 2
        found: dict[str, float] = {}
        for name, columns in self._templates:
            rest = whole - explained(self._behind, columns, difference)
            found[name] = min(math.sqrt(max(0.0, rest)), found.get(name, math.inf))
        return found

    def left_by_best(self, difference: Array) -> float:
        """D that the best of them leaves."""
        return min(self.left(difference).values())

    def sized(
        self, cause: Cause, wanted: float, measure: Callable[[Array], float]
    ) -> tuple[Measurement, Array]:
        """Return the arm with the cause as large as this D asks, or its largest, and d.

        D goes about with the size; where that leaves what is known to hold it, halves follow.
        """
        low, high = 0.0, math.inf
        steps = _STEPS if cause.changes_motion else 3 * _STEPS
        for step in range(steps):
            changed = self.with_causes([cause])
            difference = self.difference(changed)
            reached, size = measure(difference), abs(cause.size)
            too_small = reached < wanted
            if 1.0 / _NEAR < reached / wanted < _NEAR or (too_small and size >= cause.largest):
                break
            low, high = (size, high) if too_small else (low, size)
            following = size * float(np.clip(wanted / max(reached, 1e-9), 0.1, 10.0))
            if not low < following < high:
                following = 0.5 * (low + min(high, 2.0 * cause.largest))
            if step < steps - 1:
                cause = cause.resized(math.copysign(following, cause.size))
        return changed, difference


def _hidden(case: Case, yardstick: _Yardstick) -> tuple[Measurement, Truth]:
    """Draw causes, give them their strength, and say what can't be separated from them."""
    rng = np.random.default_rng([case.seed, 3])
    for _ in range(_REDRAWS):
        names = case.effects or _drawn(rng, case, yardstick.healthy)
        alone: list[Measurement] = []
        strengths: list[float] = []
        lefts: list[dict[str, float]] = []
        for name in names:
            draw = TWINS[name] if case.kind == "ambiguous" else {**LISTED, **UNLISTED}[name]
            measure = yardstick.strength if name in LISTED else yardstick.left_by_best
            changed, difference = yardstick.sized(
                draw(rng, yardstick.healthy), STRENGTHS[case.strength], measure
            )
            alone.append(changed)
            strengths.append(measure(difference))
            lefts.append(yardstick.left(difference))
        if case.kind == "pair" and _parted(names, lefts) < _PARTED:
            continue
        if names[0] in LISTED or strengths[0] >= _PARTED:
            break
    causes = [cause for one in alone for cause in one.causes]
    together = alone[0] if len(alone) == 1 else yardstick.with_causes(causes)
    effects = tuple(
        {
            "effect": cause.name.partition(":")[0],
            "parameters": dict(cause.truth(cause.size, together)),
        }
        for cause in causes
    )
    rows = zip(names, strengths, lefts, strict=True)
    acceptable = tuple(_acceptable(*row) for row in rows)
    return together, Truth(case.strength, effects, tuple(strengths), acceptable)


def _acceptable(name: str, strength: float, left: dict[str, float]) -> tuple[str, ...]:
    if name not in LISTED:
        return ("unknown",)
    others = [other for other, rest in left.items() if rest < TELLABLE and other != name]
    return (name, *others, *(["none"] if strength < TELLABLE else []))


def _parted(names: Sequence[str], lefts: Sequence[dict[str, float]]) -> float:
    """D that either of a pair leaves of the other, the smaller one."""
    first, second = names
    return min(lefts[0].get(second, math.inf), lefts[1].get(first, math.inf))


def _drawn(rng: np.random.Generator, case: Case, healthy: Measurement) -> tuple[str, ...]:
    there = [e for e in EFFECTS if "push" in healthy.session.takes or e not in NEED_PUSHES]
    if case.kind == "pair":
        pairs = [pair for pair in PAIRS if set(pair) <= set(there)]
        return pairs[rng.integers(len(pairs))]
    lists = {
        "single": there,
        "unknown_calibration": CALIBRATION_UNKNOWN,
        "unknown_test": TEST_UNKNOWN,
        "ambiguous": tuple(TWINS),
    }
    if case.kind not in lists:
        raise GalenError(f"{case.kind!r} is no kind of case; there are {', '.join(KINDS)}")
    return (str(rng.choice(np.array(lists[case.kind]))),)
