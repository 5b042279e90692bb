"""The base's marker stands still: its mean pose, and whether and when it moved.

One mean over the recording instead of the pose at each stamp, because the base marker's rotation
noise acts through the lever to the tool: 0.1 mrad over 0.7 m is 0.07 mm, more than all the rest.
What error is left in the mean, the registration takes up: it multiplies every pose from the left,
as the unknown pose of base_link in the marker does.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from galen_bags.arrays.marker_tracks import MarkerTrack
from galen_model.arrays import Array
from galen_model.distributions import chi2_isf
from galen_model.registration import Transform, mean_pose

_LEAST_SAMPLES = 20
_FALSE_MOVES_A_RECORDING = 1e-6
# A smaller move than this part of one sample's noise does no harm; a mean may drift as much.
_LEAST_SHARE_OF_NOISE = 0.25
_LEAST_NOISE = 1e-6
_CLIP_SIGMAS = 4.0
_MOST_MOVES = 20
_BLOCK = 15


class BaseStand(NamedTuple):
    """The base's marker while it stood: from start_ns to before end_ns.

    pose: mean in `tracker`; std (6,): of one sample, m and rad.
    """

    start_ns: int
    end_ns: int
    pose: Transform
    std: Array


def base_stands(track: MarkerTrack, start_ns: int) -> tuple[list[BaseStand], list[str]]:
    """Return where the marker stood, one after the other, and sentences about its moves.

    Moves are found by splitting at the largest step of the means on both sides, in units of the
    noise, for as long as it is larger than chance makes it anywhere in the recording (binary
    segmentation: Vostrikova, *Soviet Math. Doklady* 24, 1981). Poses far off are clipped, so that
    one of them makes no move; the noise's own correlation in time counts against a move.
    """
    mean = mean_pose(track.poses)
    off = track.poses.displacement_from(mean.pose)
    # The floor is for a marker that was looked at once, and published for ever.
    noise = np.maximum(_noise(off), _LEAST_NOISE)
    cuts = _moves(off / noise)
    edges = [0, *cuts, len(track)]
    time_ns = track.line.time_ns
    stands = []
    for number, (first, stop) in enumerate(pairwise(edges)):
        part = mean_pose(track.poses[first:stop])
        begin = int(time_ns[first]) if number else -(1 << 62)
        end = int(time_ns[stop]) if stop < len(track) else 1 << 62
        stands.append(BaseStand(begin, end, part.pose, part.std))
    moves = []
    for before, after in pairwise(stands):
        step = after.pose.displacement_from(before.pose)
        moves.append(
            f"{track.topic}: the base's marker moved at {(after.start_ns - start_ns) * 1e-9:.2f} s,"
            f" by {1e3 * np.linalg.norm(step[:3]):.3f} mm and"
            f" {1e3 * np.linalg.norm(step[3:]):.3f} mrad; cut there"
        )
    if len(cuts) >= _MOST_MOVES:
        moves.append(f"{track.topic}: the base's marker does not stand still")
    return stands, moves


def _noise(off: Array) -> Array:
    """Standard deviation (6,) of one sample from successive differences: a move doesn't count."""
    return np.asarray(1.4826 * np.median(np.abs(np.diff(off, axis=0)), axis=0) / np.sqrt(2.0))


def _correlation(scaled: Array) -> float:
    """How much more a mean scatters than of white noise, as a factor of its variance, at least 1.

    By means of blocks, from the differences of neighbours.
    """
    count = len(scaled) // _BLOCK
    if count < 4:
        return 1.0
    blocks = scaled[: count * _BLOCK].reshape(count, _BLOCK, -1).mean(axis=1)
    scatter = 1.4826 * np.median(np.abs(np.diff(blocks, axis=0)), axis=0) / np.sqrt(2.0)
    return float(max(1.0, _BLOCK * np.mean(scatter**2)))


def _moves(scaled: Array) -> list[int]:
    """Rows at which a new stand begins; scaled (n, 6) in units of the noise."""
    limit = chi2_isf(_FALSE_MOVES_A_RECORDING / max(len(scaled), 1), scaled.shape[1])
    limit *= _correlation(scaled)
    found: list[int] = []
    todo = [(0, len(scaled))]
    while todo and len(found) < _MOST_MOVES:
        first, stop = todo.pop()
        count = stop - first
        if count < 2 * _LEAST_SAMPLES:
            continue
        part = scaled[first:stop]
        middle = np.median(part, axis=0)
        spread = np.maximum(1.4826 * np.median(np.abs(part - middle), axis=0), 1.0)
        part = np.clip(part - middle, -_CLIP_SIGMAS * spread, _CLIP_SIGMAS * spread)
        left = np.arange(_LEAST_SAMPLES, count - _LEAST_SAMPLES + 1)
        sums = np.cumsum(part, axis=0)
        step = (
            sums[left - 1] / left[:, None] - (sums[-1] - sums[left - 1]) / (count - left)[:, None]
        )
        score = np.sum(step**2, axis=1) * left * (count - left) / count
        best = int(np.argmax(score))
        if score[best] > limit and np.max(np.abs(step[best])) > _LEAST_SHARE_OF_NOISE:
            at = first + int(left[best])
            found.append(at)
            todo += [(first, at), (at, stop)]
    return sorted(found)
