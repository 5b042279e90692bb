"""Which samples belong to one push, and which lie between two: from the load alone."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from galen_model.arrays import Array, runs

from galen_deflection.measurement.samples import DeflectionSamples
from galen_deflection.springs.springs import TipWrench

_NS_PER_S = 1e9


@dataclass(frozen=True)
class PushLimits:
    """What counts as no load, and what as a push.

    No load: force below `force_n`, and torque about the tip below `torque_nm`; or both below
    `share` of the largest there is. Loads that last less than `min_push_s` are none, and pauses of
    less than `min_rest_s` belong to the push. `margin_s` is cut off a pause at both ends, where
    the load still falls or rises already.
    """

    force_n: float = 0.15
    torque_nm: float = 0.02
    share: float = 0.03
    min_push_s: float = 0.05
    min_rest_s: float = 0.05
    margin_s: float = 0.05

    def at_most(self, at_tip: Array) -> tuple[float, float]:
        """The largest force (N) and torque (N.m) that are no load among these (n, 6)."""
        force = np.linalg.norm(at_tip[:, :3], axis=1).max(initial=0.0)
        torque = np.linalg.norm(at_tip[:, 3:], axis=1).max(initial=0.0)
        return max(self.force_n, self.share * float(force)), max(
            self.torque_nm, self.share * float(torque)
        )

    def absolute(self, at_tip: Array) -> PushLimits:
        """The same limits for any part of the samples with these wrenches (n, 6) at the tip."""
        force_n, torque_nm = self.at_most(at_tip)
        return replace(self, force_n=force_n, torque_nm=torque_nm)


@dataclass(frozen=True)
class Push:
    """One push from no load to no load.

    rows: of the samples, from the last unloaded one before it to the first one after it. rest: the
    unloaded ones after it, margins cut off; empty where there is no such pause. peak: the row of
    the largest load.
    """

    rows: slice
    rest: slice
    peak: int


def tip_wrench(samples: DeflectionSamples) -> Array:
    """Applied wrenches (n, 6) about the tip in base_link, N and N.m."""
    return TipWrench(samples.tip_m)(samples.joints, samples.wrench)


def find_pushes(
    samples: DeflectionSamples, at_tip: Array, limits: PushLimits | None = None
) -> list[Push]:
    """Pushes in their order, none over the end of a segment; `at_tip` (n, 6) by `tip_wrench`.

    A push without an unloaded sample before or after it in its segment is left out: its
    deflection without load is not known.
    """
    limits = limits or PushLimits()
    if not len(samples):
        return []
    force = np.linalg.norm(at_tip[:, :3], axis=1)
    torque = np.linalg.norm(at_tip[:, 3:], axis=1)
    at_most = limits.at_most(at_tip)
    # 1 at the border, so that the peak of a push of torque alone is found as well.
    size = np.maximum(force / at_most[0], torque / at_most[1])
    borders = (np.flatnonzero(np.diff(samples.segment)) + 1).tolist()
    found = []
    for first, last in zip([0, *borders], [*borders, len(samples)], strict=True):
        found += _in_segment(samples.stamp_ns[first:last], size[first:last], first, limits)
    return found


def _in_segment(stamp_ns: np.ndarray, size: Array, first: int, limits: PushLimits) -> list[Push]:
    margin_ns = round(limits.margin_s * _NS_PER_S)
    loaded = size > 1.0
    for flag, shortest_s in ((False, limits.min_rest_s), (True, limits.min_push_s)):
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
        pushes.append(Push(slice(first + start - 1, first + stop + 1), rest, peak))
    return pushes
