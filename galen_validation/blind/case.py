# SPDX-License-Identifier: Apache-2.0
"""One blind case: a hidden cause in a drawn session, its recording and its truth.

How strong a cause is, D, is its distance from no cause in standard deviations: with d what it
changes of the whitened rows of the same arm's healthy recording, and N their unknowns and
tolerances with their prior S,

    D^2 = d^T d - b^T (N^T N + S^-1)^-1 b,    b = N^T d.

What other effects leave of D, each by its linear templates (`baselines.templates`), shows which
names this recording can't separate from the true one.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from galen_diagnosis.effects.forms import healthy_background, unknown_columns
from galen_diagnosis.observation.observation import Observation
from galen_diagnosis.observation.recording import BagData, DiagnosticRecording, Track
from galen_diagnosis.observation.specification import (
    CALIBRATED,
    DEFAULT,
    SPECIFICATION_FILE,
    specification_of,
)
from galen_model.arm.galen import WRENCH_AXES
from galen_model.arrays import Array
from galen_model.errors import GalenError
from galen_model.files.atomic_file import write_whole
from galen_sim_driver.effects.effect import Effect, Instants, Loading
from galen_sim_driver.effects.registry import LIMITED
from scipy.spatial.transform import Rotation

from galen_validation.blind.baselines import templates
from galen_validation.blind.causes import NEED_PUSHES, Cause, listed, pairs, twins
from galen_validation.blind.labels import KINDS, LabelKind
from galen_validation.blind.measured_tables import CLEAR, pair_of
from galen_validation.blind.measuring import (
    CROSSTALK_LEVER_M,
    Measurement,
    draw_tolerance,
    limits,
    recorded,
    tool_file,
    write_recording,
)
from galen_validation.blind.session import ARMS, BAGS, REFERENCE, USUAL, draw_session
from galen_validation.blind.unlisted import (
    NEED_SPRINGS,
    TEST_UNKNOWN,
    UNLISTED,
)

STRENGTHS = {"faint": 6.0, "clear": 30.0, "gross": 150.0}
"""D of each."""
OF_LIMITED = {"faint": 3.0, "clear": 10.0, "gross": 60.0}
"""D of those that a specification limits, which allows for as much beside them."""

SINCE = "changed", "unchanged"
"""Kinds with an earlier recording of the arm: a single cause since, and none."""

TELLABLE = 3.3
"""Two causes nearer to each other than this can't be separated: 5 % errors each way, 2 x 1.65."""
_PARTED = 2.0 * TELLABLE
"""What has to stay of a cause beside the other of a pair, or of an unlisted one beside any."""
_REDRAWS = 3
BEYOND = 3.0
"""Causes over so many times their limit are to be named."""
_LEAST = {"faint": 1.0 / 3.0, "clear": BEYOND, "gross": 2.0 * BEYOND}
"""Causes are at least so many times their limit."""
_CHANGE = 0.2
"""Changes since a reference are at least such a share of their limit."""
_SEVERAL = (3, 4, 5)
_NEAR = 1.25
_STEPS = 5


@dataclass(frozen=True)
class Case:
    """What is asked for; what isn't given, the seed draws.

    effects: names, () to let the seed draw them from the kind's list. bags: those that are
    recorded. tolerance: of the healthy arm, 1 as it usually is, 0 for exactly nominal. arm: one of
    ARMS. table: a measured one, of which the case is a pair (`measured_tables`).
    """

    seed: int
    kind: LabelKind
    effects: tuple[str, ...] = ()
    strength: str = "clear"
    bags: tuple[str, ...] = BAGS
    tolerance: float = 1.0
    arm: str = "galen"
    table: Path | None = None


@dataclass(frozen=True)
class Truth:
    """What a case hides.

    effects: as in the contract's truth.json, with the `member` of those that have models. d: D of
    each; of an unlisted one what the best listed
    effect leaves. acceptable: for each the names that this recording can't separate from it.
    """

    strength: str = ""
    effects: tuple[dict[str, Any], ...] = ()
    d: tuple[float, ...] = ()
    acceptable: tuple[tuple[str, ...], ...] = ()


def generate(case: Case, directory: Path) -> Truth:
    """Write the case's recording into a new directory; an earlier one into `reference` in it.

    Args:
        case: What is asked for.
        directory: Recording to write; missing or empty.

    Returns:
        The hidden causes and what this recording can't separate from them.

    Raises:
        GalenError: The directory isn't empty, the case's arm, kind or effect is unknown, MuJoCo
            isn't installed, or the simulation became unstable.

    """
    if directory.exists() and any(directory.iterdir()):
        raise GalenError(f"{directory}: is there already, and isn't empty")
    if case.table is not None:
        return _of_table(case, case.table, directory)
    if case.arm not in ARMS:
        raise GalenError(f"{case.arm!r} is no arm of the blind check; there are {', '.join(ARMS)}")
    arm, usual = ARMS[case.arm](), case.arm.endswith(USUAL)
    bags = tuple(b for b in case.bags if case.kind != "ambiguous" or b != "push")
    session = draw_session(case.seed, bags, arm=arm, usual=usual)
    tolerance = draw_tolerance(case.seed, case.tolerance, arm=arm, usual=usual)
    changed, truth = Measurement(session, tolerance), Truth()
    specified = limits(session) if usual else None
    written = {directory: changed}
    if case.kind in SINCE:
        before = int(np.random.default_rng([case.seed, 4]).integers(2**31))
        earlier = draw_session(before, bags, arm=arm, usual=usual, tool=session.tool)
        written[directory / REFERENCE] = Measurement(earlier, tolerance)
    if case.kind not in ("none", "unchanged"):
        share = _CHANGE / BEYOND if case.kind in SINCE else 1.0
        changed, truth = _hidden(case, _Yardstick(changed, _scaled(specified, share)))
        written[directory] = changed
    for folder, measured in written.items():
        folder.mkdir(parents=True, exist_ok=True)
        write_recording(folder, measured)
        if specified is not None:
            content = {"schema_version": 1, "name": "data sheets", "limits": specified}
            write_whole(folder / SPECIFICATION_FILE, json.dumps(content, indent=1))
    return truth


def _of_table(case: Case, table: Path, directory: Path) -> Truth:
    effect = case.effects[0] if case.effects else None
    pair = pair_of(table, case.seed, effect, TELLABLE)
    pair.write(directory)
    if pair.parameters is None:
        return Truth()
    effects = ({"effect": effect, "parameters": dict(pair.parameters)},)
    strength = "clear" if pair.d > 0.99 * CLEAR else "faint"
    return Truth(strength, effects, (pair.d,), (pair.acceptable,))


def _scaled(specified: Mapping[str, Any] | None, share: float) -> Mapping[str, Any] | None:
    if specified is None:
        return None
    return {
        effect: {part: share * limit for part, limit in by_part(of).items()}
        for effect, of in specified.items()
    }


def observed(
    measured: Measurement, specified: Mapping[str, Any] | None = None
) -> DiagnosticRecording:
    """Return what reading the recording would give, without writing it.

    Args:
        measured: The arm in its session; noise is drawn from the session's seed.
        specified: Limits by effect as in the recording's specification file; None for the preset of
            a calibrated arm.

    Returns:
        The recording, samples with noise and quanta.

    """
    samples = recorded(measured)
    first_ns = {bag: min(s.joint_ns[0], s.wrench_ns[0]) for bag, s in samples.items()}
    bags = {}
    for bag, s in samples.items():
        joint_s, wrench_s, tracker_s = (
            1e-9 * (stamps - first_ns[bag]) for stamps in (s.joint_ns, s.wrench_ns, s.tracker_ns)
        )
        tool, base = (None if one is None else Track(tracker_s, *one) for one in (s.tool, s.base))
        start_s = 1e-9 * (first_ns[bag] - min(first_ns.values()))
        bags[bag] = BagData(
            bag, start_s, joint_s, s.joints, wrench_s, s.readings, tool, base
        )  # fmt: skip
    session = measured.session
    missing = tuple(bag for bag in BAGS if bag not in bags)
    whole = specification_of([CALIBRATED], dict.fromkeys(LIMITED))
    if specified is not None:
        whole = replace(whole, limits={effect: by_part(of) for effect, of in specified.items()})
    return DiagnosticRecording("healthy", tool_file(session), bags, missing, (), session.arm, whole)


def by_part(limit: Any) -> Mapping[str, float]:
    """Return a limit of a specification's file by joint, axis or `default`.

    Args:
        limit: One number for all parts, or a mapping by part, in the effect's unit.

    Returns:
        The mapping; a number is under `default`.

    """
    return limit if isinstance(limit, Mapping) else {DEFAULT: limit}


def over_limit(
    cause: Cause, truth: Mapping[str, Any], specified: Mapping[str, Any] | None
) -> float:
    """Return how many times its limit a cause is.

    A drift's rate is a mean, which says nothing of its size.

    Args:
        cause: The cause at its size.
        truth: Its true parameters, SI, as `Cause.truth` returns them.
        specified: Limits by effect; None where the arm has no specification file.

    Returns:
        Size over limit; infinite for a drift and where there is no limit.

    """
    effect = cause.name.partition(":")[0]
    if specified is None or effect not in specified or effect == "sensor_drift":
        return math.inf
    size = abs(cause.size)
    if effect == "axis_gain":
        size = max(map(abs, truth["gain"]))
    elif effect == "crosstalk":
        levers = {name: CROSSTALK_LEVER_M if name[0] == "t" else 1.0 for name in WRENCH_AXES}
        size = abs(truth["coefficient"]) * levers[truth["from"]] / levers[truth["to"]]
    elif effect in _OF_TRUTH:
        size = abs(truth[_OF_TRUTH[effect]])
    return size / float(by_part(specified[effect])[DEFAULT])


_OF_TRUTH = {
    "sensor_nonlinearity": "coefficient", "sensor_hysteresis": "fraction",
    "cable_drag": "tension_N", "deflection_hysteresis": "residual_fraction",
    "deflection_creep": "fraction",
}  # fmt: skip
"""Parameters that are another number than the cause's size."""


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

    def __init__(self, healthy: Measurement, specified: Mapping[str, Any] | None = None) -> None:
        """Take the limits of a specification, where there is one."""
        self.healthy = healthy
        self.specified = specified
        self._observation = Observation(observed(healthy, specified))
        self._behind = healthy_background(self._observation)
        self._directions: list[tuple[str, Array]] = []

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
        if not self._directions:
            unknowns = unknown_columns(self._observation)
            self._directions = [
                (name, self._across(columns))
                for name, columns in templates(self._observation, unknowns)
            ]
        rows = self._behind.left(difference)
        whole = self._behind.sum_of_squares(difference)
        found: dict[str, float] = {}
        for name, directions in self._directions:
            rest = whole - float(np.sum((rows @ directions) ** 2))
            found[name] = min(math.sqrt(max(0.0, rest)), found.get(name, math.inf))
        return found

    def _across(self, columns: Array) -> Array:
        """Return combinations (N, k) of columns, of unit length each after the background's fit."""
        norms = np.linalg.norm(columns, axis=0)
        columns = columns[:, norms > 0.0] / norms[norms > 0.0]
        gram, _ = self._behind.reduced(columns, np.zeros(len(columns)))
        size, vectors = np.linalg.eigh(gram)
        good = size > 1e-9
        return np.asarray(columns @ (vectors[:, good] / np.sqrt(size[good])))

    def left_by_best(self, difference: Array) -> float:
        """D that the best of them leaves."""
        return min(self.left(difference).values())

    def sized(
        self, cause: Cause, wanted: float, measure: Callable[[Array], float], least: float
    ) -> tuple[Measurement, Array]:
        """Return the arm with the cause as large as this D asks, or its largest, and d.

        It is at least so many times its limit.

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
        over = self.over(changed)
        if 0.0 < over < least:
            cause = cause.resized(1.1 * least / over * cause.size)
            changed = self.with_causes([cause])
            difference = self.difference(changed)
        return changed, difference

    def over(self, changed: Measurement) -> float:
        """Return how many times its limit an arm's one cause is."""
        (cause,) = changed.causes
        return over_limit(cause, cause.truth(cause.size, changed), self.specified)


def _hidden(case: Case, yardstick: _Yardstick) -> tuple[Measurement, Truth]:
    """Draw causes, give them their strength, and say what can't be separated from them."""
    rng, arm = np.random.default_rng([case.seed, 3]), yardstick.healthy.session.arm
    known = listed(arm)
    draws = {**known, **UNLISTED, **(twins(arm) if case.kind == "ambiguous" else {})}
    for _ in range(_REDRAWS):
        names = case.effects or _drawn(rng, case, yardstick.healthy)
        if strange := [name for name in names if name not in draws]:
            raise GalenError(f"{strange[0]!r} is no cause of the arm {case.arm}")
        alone: list[Measurement] = []
        strengths: list[float] = []
        lefts: list[dict[str, float]] = []
        overs: list[float] = []
        for name in names:
            measure = yardstick.left_by_best if name in UNLISTED else yardstick.strength
            limited = name.partition(":")[0] in (yardstick.specified or ())
            wanted = (OF_LIMITED if limited else STRENGTHS)[case.strength]
            changed, difference = yardstick.sized(
                draws[name](rng, yardstick.healthy), wanted, measure, _LEAST[case.strength]
            )
            alone.append(changed)
            overs.append(yardstick.over(changed))
            strengths.append(measure(difference))
            lefts.append(yardstick.left(difference))
        if len(names) > 1 and _parted(names, lefts) < _PARTED:
            continue
        if names[0] not in UNLISTED or strengths[0] >= _PARTED:
            break
    causes = [cause for one in alone for cause in one.causes]
    together = alone[0] if len(alone) == 1 else yardstick.with_causes(causes)
    effects = tuple(
        {
            "effect": cause.name.partition(":")[0],
            "parameters": dict(cause.truth(cause.size, together)),
            **({"member": cause.member} if cause.member else {}),
        }
        for cause in causes
    )
    rows = zip(names, strengths, lefts, overs, strict=True)
    acceptable = tuple(_acceptable(*row) for row in rows)
    return together, Truth(case.strength, effects, tuple(strengths), acceptable)


def _acceptable(name: str, strength: float, left: dict[str, float], over: float) -> tuple[str, ...]:
    if name in UNLISTED:
        return ("unknown",)
    others = [other for other, rest in left.items() if rest < TELLABLE and other != name]
    return (name, *others, *(["none"] if strength < TELLABLE or over < BEYOND else []))


def _parted(names: Sequence[str], lefts: Sequence[dict[str, float]]) -> float:
    """D that any of several leaves of another, the smallest one."""
    return min(
        left.get(other, math.inf)
        for name, left in zip(names, lefts, strict=True)
        for other in names
        if other != name
    )


def _drawn(rng: np.random.Generator, case: Case, healthy: Measurement) -> tuple[str, ...]:
    arm = healthy.session.arm
    there = [e for e in listed(arm) if "push" in healthy.session.takes or e not in NEED_PUSHES]
    shows = [e for e in UNLISTED if arm.stiffness or e not in NEED_SPRINGS]
    singles: list[tuple[str, ...]] = [(name,) for name in there]
    lists: dict[str, list[tuple[str, ...]]] = {
        "single": singles,
        "changed": singles,
        "pair": [pair for pair in pairs(arm) if set(pair) <= set(there)],
        "unknown": [(name,) for name in shows if name in TEST_UNKNOWN],
        "ambiguous": [(name,) for name in twins(arm)],
    }
    if case.kind == "several":
        wanted = rng.choice(_SEVERAL)
        found: list[str] = []
        for name in rng.permutation(there):
            apart = all(
                pair in lists["pair"] or pair[::-1] in lists["pair"]
                for pair in ((str(name), other) for other in found)
            )
            if apart and name.partition(":")[0] not in [one.partition(":")[0] for one in found]:
                found.append(str(name))
        return tuple(found[:wanted])
    if case.kind not in lists:
        raise GalenError(f"{case.kind!r} is no kind of case; there are {', '.join(KINDS)}")
    return lists[case.kind][rng.integers(len(lists[case.kind]))]
