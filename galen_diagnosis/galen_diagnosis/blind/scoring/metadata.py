"""What a recording tells beside its numbers, and whether that gives its cause away.

Names, sizes, times, counts and rates of a blind recording must say nothing of what is hidden in it:
a classifier on them alone must do no better than chance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from galen_bags.formats.bag import open_bag
from galen_bags.formats.files import find_bags
from galen_model.arrays import Array
from scipy.stats import rankdata

_NEIGHBOURS = 5


@dataclass(frozen=True)
class Chance:
    """A classifier against chance.

    share: of recordings told right when held out; by_chance: the mean share with the causes dealt
    anew at random; p: how often dealing at random does as well.
    """

    share: float
    by_chance: float
    p: float


def metadata(recording: Path) -> dict[str, float]:
    """Everything but the messages' content, as numbers by name."""
    found: dict[str, float] = {
        "name": float(sum(recording.name.encode()) % 997),
        "name length": float(len(recording.name)),
        "files": float(sum(1 for path in recording.rglob("*") if path.is_file())),
        "changed": recording.stat().st_mtime,
    }
    for path in sorted(recording.rglob("*")):
        if path.is_file():
            inside = str(path.relative_to(recording))
            found[f"{inside}: bytes"] = float(path.stat().st_size)
            found[f"{inside}: changed"] = path.stat().st_mtime
    for bag in find_bags([recording]):
        found |= _of_bag(bag)
    return found


def _of_bag(path: Path) -> dict[str, float]:
    found: dict[str, float] = {}
    with open_bag(path) as bag:
        names = sorted(bag.topics)
        blocks = list(bag.blocks(names))
    times = np.concatenate([block.log_time_ns for block in blocks]).astype(float) * 1e-9
    topics = np.concatenate([block.topic for block in blocks])
    found[f"{path.name}: start"] = times.min()
    found[f"{path.name}: duration"] = float(np.ptp(times))
    found[f"{path.name}: topics"] = float(len(names))
    for number, name in enumerate(names):
        own = np.sort(times[topics == number])
        found[f"{path.name} {name}: count"] = float(len(own))
        if len(own) > 2:
            steps = np.diff(own)
            found[f"{path.name} {name}: first"] = float(own[0] - times.min())
            found[f"{path.name} {name}: last"] = float(own[-1] - times.min())
            found[f"{path.name} {name}: step"] = float(np.median(steps))
            found[f"{path.name} {name}: longest"] = float(steps.max())
            found[f"{path.name} {name}: jitter"] = float(steps.std())
    return found


def table(recordings: Sequence[dict[str, float]]) -> Array:
    """Metadata of n recordings as ranks (n, columns); what is missing is the least of all.

    Columns that are the same everywhere are left out.
    """
    names = sorted({name for one in recordings for name in one})
    values = np.array([[one.get(name, -np.inf) for name in names] for one in recordings])
    ranks = np.stack([rankdata(column) for column in values.T], axis=1)
    return np.asarray(ranks[:, np.ptp(ranks, axis=0) > 0.0])


def chance(values: Array, causes: Sequence[str], draws: int = 500, seed: int = 0) -> Chance:
    """Whether metadata (n, columns) tell causes (n,), by two simple classifiers, the better taken.

    One takes the single column that tells most, the other the nearest five by all columns; both
    guess each recording from the others. The p-value is of a permutation test of the better share,
    so that choosing between them, and among columns, is paid for.
    """
    labels = np.unique(np.asarray(causes), return_inverse=True)[1]
    if not values.size:
        most = float(np.bincount(labels).max() / len(labels))
        return Chance(most, most, 1.0)
    orders = np.stack([_neighbours(columns) for columns in (*values.T[:, :, None], values)])
    random = np.random.default_rng(seed)
    own = _best_share(orders, labels)
    drawn = [_best_share(orders, random.permutation(labels)) for _ in range(draws)]
    p = (1 + sum(share >= own for share in drawn)) / (draws + 1)
    return Chance(own, float(np.mean(drawn)), float(p))


def _neighbours(values: Array) -> np.ndarray:
    """Of each recording the nearest others (n, k), by standardised columns (n, c)."""
    scaled = (values - values.mean(axis=0)) / values.std(axis=0)
    distance = np.linalg.norm(scaled[:, None] - scaled[None], axis=2)
    np.fill_diagonal(distance, np.inf)
    return np.argsort(distance, axis=1, kind="stable")[:, :_NEIGHBOURS]


def _best_share(orders: np.ndarray, labels: np.ndarray) -> float:
    """Share of recordings whose label most of their neighbours (m, n, k) have, of the best of m."""
    near = labels[orders]
    votes = np.stack([(near == label).sum(axis=2) for label in range(int(labels.max()) + 1)])
    return float(np.max(np.mean(votes.argmax(axis=0) == labels, axis=1)))
