"""The residual as a diagnosis works on it: whitened rows, each with where it comes from.

A row is a residual (measured less predicted) of one channel, averaged over a few samples and scaled
so that noise alone has unit variance and no correlation from row to row. What isn't known of the
recording and is no gap (the sensor's zero, where the tracker stands) is not projected out of rows;
whoever fits has it among the columns.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from galen_model.arm.galen import WRENCH_AXES
from galen_model.arrays import Array

if TYPE_CHECKING:
    from galen_diagnosis.observation.noise import ChannelNoise

TIP_AXES = ("dx", "dy", "dz", "rx", "ry", "rz")
"""Displacement of tool_tip in base_link: m, rad."""

MARKER_AXES = ("mx", "my", "mz", "mrx", "mry", "mrz")
"""Displacement of the base's marker from its mean, in base_link: m, rad."""

CHANNELS = (*WRENCH_AXES, *TIP_AXES, *MARKER_AXES)
"""Order of a row's channel."""

BAGS = ("sweep", "motion", "push")

REGIMES = ("still", "moving+", "moving-", "accelerating", "rest", "loading", "held", "unloading")
"""still: sweep's poses and any other stop; moving+-: by the sign of the fastest angle's rate;
rest, loading, held, unloading: of the pushes, by the applied force and its rate."""

FOLDS = 4
"""Blocks are dealt to this many parts; each part is held out once."""


@dataclass(frozen=True)
class Rows:
    """Where N rows come from; all arrays (N,) unless said.

    channel, bag, regime: indices into CHANNELS, BAGS, REGIMES. bag_s, session_s: time of the row
    since the bag's and the recording's first stamp, s. pose: index of the still pose of the sweep,
    or of the arm's position among the pushes; -1 in motion. block: rows of one block are held out
    together, and are what is drawn in a bootstrap; numbered over the whole recording. fold (0 ...
    FOLDS - 1): of the block. joints (N, 5): reported, m and rad. rate (N, 5): their rates. samples:
    how many a row averages. scale: what one unit is in N, N.m, m or rad.
    """

    channel: np.ndarray
    bag: np.ndarray
    regime: np.ndarray
    bag_s: Array
    session_s: Array
    pose: np.ndarray
    block: np.ndarray
    fold: np.ndarray
    joints: Array
    rate: Array
    samples: np.ndarray
    scale: Array

    def __len__(self) -> int:
        return len(self.channel)


@dataclass(frozen=True)
class Stream:
    """A residual in time, for spectra and pictures: not averaged, in the channels' own units.

    channels: names of the k columns; bag; at_s (n,) since the bag's first stamp; residual (n, k);
    noise (k,): standard deviation of one sample. Rows that say nothing are NaN. models: of each
    column's noise, whose pieces they whiten; empty for white noise of `noise`.
    """

    bag: str
    channels: tuple[str, ...]
    at_s: Array
    residual: Array
    noise: Array
    models: tuple[ChannelNoise, ...] = ()
