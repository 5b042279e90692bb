# SPDX-License-Identifier: Apache-2.0
"""Poses of the tracker's markers out of a bag, without those in which the marker was lost."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import scipy  # its parts are loaded when they are used
from galen_model.registration import Transform
from galen_model.rotation import quaternion_to_matrix

from galen_bags.arrays.arm_recording import (
    POSE_TYPE,
    Decoder,
    Samples,
    find_topic,
    join_samples,
)
from galen_bags.arrays.timeline import Timeline, lay_out, stamp_sentences
from galen_bags.formats.bag import Bag
from galen_bags.formats.errors import BagError

_NORM_TOLERANCE = 1e-3
# So many poses alike to the last bit are no measurement: noise alone would make them differ.
_FROZEN_SAMPLES = 3
_USUAL_REPEATS, _USUAL_RUNS = 0.3, 10
# A pose so far from the median of those around it is of something else that was taken for the
# marker: no push moves the tip so far, and the arm's own motion goes on from pose to pose.
_AROUND = 11
_ELSEWHERE_M, _ELSEWHERE_RAD = 5e-3, 20e-3


@dataclass(frozen=True)
class MarkerTrack:
    """A marker's good poses (n) in `tracker`, when they were taken, and what was wrong."""

    topic: str
    line: Timeline
    poses: Transform
    period_s: float
    problems: tuple[str, ...]

    def __len__(self) -> int:
        """Return the number of good poses."""
        return len(self.line)


@dataclass(frozen=True)
class RawTrack:
    """A marker's messages as they came: stamp_ns, log_ns (n,), values (n, 7), frames' names."""

    topic: str
    stamp_ns: np.ndarray
    log_ns: np.ndarray
    values: np.ndarray
    frame_ids: tuple[str, ...]
    bad: Mapping[int, str]


def read_poses(bag: Bag, names: tuple[str, ...]) -> list[RawTrack]:
    """Read topics of PoseStamped.

    Args:
        bag: an open bag.
        names: of each topic, the whole name or its last parts, as of `find_topic`.

    Returns:
        The topics' messages as they came, in the order of `names`.

    Raises:
        BagError: a topic is missing, has another type or no message, or is named twice.

    """
    topics = [find_topic(bag, name, POSE_TYPE) for name in names]
    if len(set(topics)) < len(topics):
        raise BagError(f"{bag.path}: {topics[0]} can't be both markers")
    decoders = [Decoder(POSE_TYPE) for _ in topics]
    parts: list[list[tuple[Samples, np.ndarray]]] = [[] for _ in topics]
    for block in bag.blocks(topics):
        for number, decoder in enumerate(decoders):
            rows = np.flatnonzero(block.topic == number)
            if len(rows):
                parts[number].append((decoder.decode(block, rows), block.log_time_ns[rows]))
    return [_joined(bag, topic, part) for topic, part in zip(topics, parts, strict=True)]


def _joined(bag: Bag, topic: str, parts: list[tuple[Samples, np.ndarray]]) -> RawTrack:
    if not parts:
        raise BagError(f"{bag.path}: {topic} has no message")
    all_samples, logs = zip(*parts, strict=True)
    samples = join_samples(list(all_samples), 7)
    return RawTrack(
        topic,
        samples.stamp_ns,
        np.concatenate(logs),
        samples.values,
        samples.frame_ids,
        samples.bad,
    )


def marker_track(
    raw: RawTrack,
    jump_s: float,
    start_ns: int,
    *,
    may_stand: bool,
    beside_ns: np.ndarray | None = None,
) -> MarkerTrack:
    """Return the good poses of a marker.

    Lost are poses that aren't finite, whose quaternion's length isn't 1, that are the identity (as
    some trackers mark it), those that repeat the one before to the last bit: a tracker that holds
    its last pose, and those of a few samples elsewhere.

    Args:
        raw: the marker's messages, n of them, in order of arrival.
        jump_s: change, s, of the delay from stamp to log time from which on the stamps jumped.
        start_ns: time, ns, from which the times in the problems' sentences count, in s.
        may_stand: repeats are all right, as of a marker that stands, looked at once and published
            for ever; and what is elsewhere is left to `base_stands`.
        beside_ns: stamps (m,) of another topic, ns, increasing; see `stamp_sentences`.

    Returns:
        The good poses in the tracker's frame, m, increasing in time, and the problems found.

    """
    line = lay_out(raw.stamp_ns, raw.log_ns, jump_s)
    problems = stamp_sentences(raw.topic, line, start_ns, beside_ns)
    if raw.bad:
        why = next(iter(raw.bad.values()))
        problems.append(f"{raw.topic}: {len(raw.bad)} messages can't be read: {why}")
    values = raw.values[line.row]
    with np.errstate(invalid="ignore"):
        finite = np.isfinite(values).all(axis=1)
        norm = np.linalg.norm(values[:, 3:], axis=1)
        unit = np.abs(norm - 1.0) <= _NORM_TOLERANCE
    nowhere = np.all(values == np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]), axis=1)
    repeats = frozen = elsewhere = np.zeros(len(values), dtype=bool)
    if not may_stand:
        repeats, frozen = _frozen(values)
        seen = finite & unit & ~nowhere & ~repeats
        elsewhere = np.zeros(len(values), dtype=bool)
        elsewhere[seen] = _elsewhere(values[seen])
    lost = ~finite | ~unit | nowhere | repeats | elsewhere
    for mask, why in (
        (~finite, "not finite"),
        (finite & ~unit, "a quaternion whose length isn't 1"),
        (nowhere, "the identity"),
        (frozen & finite & unit & ~nowhere, "frozen, the same to the last bit"),
        (elsewhere, "elsewhere for a few samples"),
    ):
        if mask.any():
            problems.append(_lost_sentence(raw.topic, why, mask, line.time_ns - start_ns))
    good = line.kept(~lost)
    steps = np.diff(good.time_ns)
    return MarkerTrack(
        raw.topic,
        good,
        Transform(
            quaternion_to_matrix(values[~lost, 3:] / norm[~lost, None])
            if len(good)
            else np.zeros((0, 3, 3)),
            values[~lost, :3],
        ),
        float(np.median(steps)) * 1e-9 if len(steps) else float("nan"),
        tuple(problems),
    )


def _frozen(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Poses (n,) that repeat the one before, and those of them that a frozen marker leaves.

    Where a topic is published faster than the tracker measures, short repeats are the rule: they
    are no measurements, and no trouble.
    """
    repeats = np.concatenate([[False], np.all(values[1:] == values[:-1], axis=1)])
    starts, stops = _runs(repeats)
    usual = 0.0
    if np.count_nonzero(repeats) > _USUAL_REPEATS * len(values) and len(starts) > _USUAL_RUNS:
        usual = float(np.median(stops - starts))
    frozen = np.zeros(len(values), dtype=bool)
    for start, stop in zip(starts, stops, strict=True):
        frozen[start:stop] = stop - start >= _FROZEN_SAMPLES - 1 + 3.0 * usual
    return repeats, frozen


def _elsewhere(values: np.ndarray) -> np.ndarray:
    """Poses (n, 7) that are far from the median of those around them, (n,) bool."""
    if not len(values):
        return np.zeros(0, dtype=bool)
    values = values.copy()  # q and -q are one rotation: take those that go on from the one before
    turned = np.sum(values[1:, 3:] * values[:-1, 3:], axis=1) < 0.0
    values[1:, 3:] *= np.where(np.cumsum(turned) % 2 == 1, -1.0, 1.0)[:, None]
    with np.errstate(over="ignore"):
        off = values - scipy.ndimage.median_filter(values, size=(_AROUND, 1), mode="nearest")
        shift, half_turn = (np.linalg.norm(part, axis=1) for part in (off[:, :3], off[:, 3:]))
    return (shift > _ELSEWHERE_M) | (2.0 * half_turn > _ELSEWHERE_RAD)


def _runs(mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(np.int8), [0]])))
    return edges[::2], edges[1::2]


def _lost_sentence(topic: str, why: str, mask: np.ndarray, since_ns: np.ndarray) -> str:
    starts, stops = _runs(mask)
    length = since_ns[stops - 1] - since_ns[starts]
    longest = int(np.argmax(length))
    number = int(mask.sum())
    return (
        f"{topic}: marker lost in {number} sample{'s' if number > 1 else ''} ({why}), "
        f"{len(starts)} time{'s' if len(starts) > 1 else ''}, longest"
        f" {length[longest] * 1e-9:.2f} s at {since_ns[starts[longest]] * 1e-9:.2f} s"
    )
