# SPDX-License-Identifier: Apache-2.0
"""Samples of load and displacement, which models are fitted to, and the pushes among them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from galen_model.arm.arm import Arm
from galen_model.arrays import Array, runs
from galen_model.errors import GalenError


class DeflectionError(GalenError):
    """A recording, a model or samples that are unusable; the message gives the reason."""


_NS_PER_S = 1e9

_LARGEST = 1e9
"""Nothing that is measured in SI units here is larger, and sums of squares still have room."""

_NO_FORCE_N, _NO_TORQUE_NM = 0.15, 0.02
_NO_LOAD_SHARE = 0.03  # of the largest load there is, if that is more

_MIN_PUSH_S = _MIN_REST_S = 0.05
"""Shorter loads are none, and shorter pauses belong to the push."""

_MARGIN_S = 0.05
"""Cut off a pause at both ends, where the load still falls or rises already."""


@dataclass(frozen=True)
class DeflectionSamples:
    """Samples (n,) of an arm under load, at the tracker's stamps.

    stamp_ns (n,): increasing within a segment. segment (n,): numbers of runs without a gap, a jump
    or a lost marker; what a model remembers of the load starts anew in each. position (n,): which
    of the arm's positions it is; set_number (n,): which recording, or which repetition of a
    position. joints (n, j): m, rad. wrench (n, 6): applied to the tool, compensated, in ft_sensor
    about its origin, N and N.m. deflection (n, 6): displacement of tool_tip that was measured,
    translation (m) and rotation vector (rad) in base_link. tip_m (3,): in ft_sensor. noise (6,):
    standard deviation of one measured deflection.
    """

    stamp_ns: np.ndarray
    segment: np.ndarray
    position: np.ndarray
    set_number: np.ndarray
    joints: Array
    wrench: Array
    deflection: Array
    tip_m: Array
    noise: Array
    arm: Arm

    def __len__(self) -> int:
        """Return the number of samples."""
        return len(self.stamp_ns)

    def rows(self, rows: np.ndarray | slice) -> DeflectionSamples:
        """Return some of the samples; whole segments, if a model with memory gets them.

        Args:
            rows: mask (n,) bool, indices or slice of samples.

        Returns:
            The samples, in the order of `rows`.

        """
        picked = {name: getattr(self, name)[rows] for name in _BY_SAMPLE}
        return replace(self, **picked)

    def segments(self) -> Iterator[slice]:
        """Yield the segments' rows, in their order."""
        starts = np.flatnonzero(np.diff(self.segment)) + 1
        for first, last in pairwise([0, *starts.tolist(), len(self)]):
            yield slice(first, last)


def check_to_fit(samples: DeflectionSamples, used: np.ndarray) -> None:
    """Check that a model can be fitted to the used samples.

    Args:
        samples: n samples.
        used: (n,) bool; the loads of the others count as well.

    Raises:
        DeflectionError: no sample is used, a value is not finite or beyond any measurement, or the
            noise is not positive.

    """
    if not used.any():
        raise DeflectionError("there are no samples to fit a deflection model to")
    for values in (samples.joints, samples.wrench, samples.deflection[used]):
        if not np.isfinite(values).all():
            raise DeflectionError(
                "samples to fit a deflection model to hold values that aren't finite"
            )
        if np.abs(values).max() > _LARGEST:
            raise DeflectionError(
                f"samples to fit a deflection model to hold {np.abs(values).max():.3g}, which is no"
                " measurement in SI units"
            )
    if not np.all(samples.noise > 0.0):
        raise DeflectionError(
            "the noise of the samples, by which a fit weighs them, is"
            f" {', '.join(f'{value:.3g}' for value in samples.noise)} (m, rad): not above zero in"
            " all axes"
        )


_WHOLE = ("tip_m", "noise", "arm")
_BY_SAMPLE = tuple(f.name for f in fields(DeflectionSamples) if f.name not in _WHOLE)


def joined(parts: Sequence[DeflectionSamples]) -> DeflectionSamples:
    """Join samples of several recordings of one tool; segments and set numbers stay apart.

    The noise is the root mean square of theirs. Positions keep their numbers: give the same one to
    the same place.

    Args:
        parts: samples of one arm, in the order wanted.

    Returns:
        All samples.

    Raises:
        ValueError: the tips differ, or there are no samples.

    """
    if not any(map(len, parts)):
        raise ValueError("no samples to join")
    for part in parts[1:]:
        if not np.allclose(part.tip_m, parts[0].tip_m, atol=1e-9):
            raise ValueError(f"tips differ: {parts[0].tip_m.tolist()} and {part.tip_m.tolist()}")
    columns = {name: [getattr(part, name) for part in parts] for name in _BY_SAMPLE}
    for name in ("segment", "set_number"):
        first = 0
        for k, numbers in enumerate(columns[name]):
            columns[name][k] = numbers + first
            first += int(numbers.max(initial=-1)) + 1
    weights = np.array([len(part) for part in parts], dtype=float)
    noise = np.sqrt(np.average([part.noise**2 for part in parts], axis=0, weights=weights))
    whole: dict[str, Any] = {name: np.concatenate(values) for name, values in columns.items()}
    return replace(parts[0], **whole, noise=noise)


class LoadCycle(NamedTuple):
    """One push from no load to no load.

    rows: of the samples, from the last unloaded one before it to the first one after it. rest: the
    unloaded ones after it, margins cut off; empty where there is no such pause. peak: the row of
    the largest load.
    """

    rows: slice
    rest: slice
    peak: int


def no_load(at_tip: Array) -> tuple[float, float]:
    """Return the largest force and torque that are no load among these.

    Args:
        at_tip: (n, 6) wrenches at the tip in base_link, N and N.m.

    Returns:
        Force (N) and torque (N.m).

    """
    force = np.linalg.norm(at_tip[:, :3], axis=1).max(initial=0.0)
    torque = np.linalg.norm(at_tip[:, 3:], axis=1).max(initial=0.0)
    return (
        max(_NO_FORCE_N, _NO_LOAD_SHARE * float(force)),
        max(_NO_TORQUE_NM, _NO_LOAD_SHARE * float(torque)),
    )


def find_pushes(
    samples: DeflectionSamples, at_tip: Array, limits: tuple[float, float] | None = None
) -> list[LoadCycle]:
    """Return the pushes in their order, none over the end of a segment.

    A push without an unloaded sample before or after it in its segment is left out: its deflection
    without load is not known.

    Args:
        samples: n samples.
        at_tip: (n, 6) their wrenches at the tip in base_link, N and N.m.
        limits: force (N) and torque (N.m) that are no load; None: those of `no_load`.

    Returns:
        The pushes, with rows of `samples`.

    """
    if not len(samples):
        return []
    force_n, torque_nm = limits or no_load(at_tip)
    force = np.linalg.norm(at_tip[:, :3], axis=1)
    torque = np.linalg.norm(at_tip[:, 3:], axis=1)
    # 1 at the border, so that the peak of a push of torque alone is found as well.
    size = np.maximum(force / force_n, torque / torque_nm)
    found = []
    for part in samples.segments():
        found += _in_segment(samples.stamp_ns[part], size[part], part.start)
    return found


def _in_segment(stamp_ns: np.ndarray, size: Array, first: int) -> list[LoadCycle]:
    margin_ns = round(_MARGIN_S * _NS_PER_S)
    loaded = size > 1.0
    for flag, shortest_s in ((False, _MIN_REST_S), (True, _MIN_PUSH_S)):
        for start, stop in runs(loaded == flag):
            inside = start > 0 and stop < len(loaded)
            if inside and stamp_ns[stop] - stamp_ns[start] < shortest_s * _NS_PER_S:
                loaded[start:stop] = not flag
    pushes = []
    for start, stop in runs(loaded):
        if start == 0 or stop == len(loaded):
            continue
        until = stop + int(np.argmax(np.append(loaded[stop:], True)))
        pause_ns = stamp_ns[stop:until]
        rest = slice(
            first + stop + int(np.searchsorted(pause_ns, pause_ns[0] + margin_ns)),
            first + stop + int(np.searchsorted(pause_ns, pause_ns[-1] - margin_ns, side="right")),
        )
        peak = first + start + int(np.argmax(size[start:stop]))
        pushes.append(LoadCycle(slice(first + start - 1, first + stop + 1), rest, peak))
    return pushes
