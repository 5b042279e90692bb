"""Which readings of a joint's runs are fitted to, and which are checked. Never by the sample.

All readings belong to parts: a run is one, or, where runs are few, a block of time in it. What a
part is checked with has seen nothing of its lag; the torque and the motor's motion in it still
count for what the joint remembers.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from galen_model.errors import GalenError
from galen_model.transmission.joint_run import JointRun

Used = list[np.ndarray]
"""Of each run, which readings (n,) bool."""


class PartsError(GalenError):
    """Runs that can't be held out as asked; the message says what lacks."""


@dataclass(frozen=True)
class Parts:
    """The parts (p,) of some runs.

    label: of each run, the part (n,) of its readings. apart (p, p) bool: [k, j] says that a model
    that is checked on part k may be fitted to part j.
    """

    names: tuple[str, ...]
    label: tuple[np.ndarray, ...]
    apart: np.ndarray
    whole_runs: bool

    def rows(self, parts: Sequence[int]) -> Used:
        """The readings of these parts."""
        return [np.isin(label, parts) for label in self.label]

    def trained_on(self, part: int) -> list[int]:
        """The parts that a model may be fitted to that is checked on this one."""
        return np.flatnonzero(self.apart[part]).tolist()


def whole_runs(runs: Sequence[JointRun], unlike: str | None = None) -> Parts:
    """Each run is a part.

    `unlike`: a pattern for the runs' names; where all its groups differ, and only there, one run
    may train for the other. Raises PartsError.
    """
    if len(runs) < 3:
        raise PartsError(f"{len(runs)} runs: to hold out whole ones takes three; hold out blocks")
    groups = [_groups(run.name, unlike) for run in runs]
    apart = np.array([[all(a != b for a, b in zip(x, y, strict=True)) for y in groups]
                      for x in groups])  # fmt: skip
    np.fill_diagonal(apart, False)
    for run, others in zip(runs, apart, strict=True):
        if others.sum() < 2:
            raise PartsError(
                f"run {run.name}: {int(others.sum())} runs differ from it in every group of "
                f"{unlike!r}; two are needed to fit a model that it checks"
            )
    label = tuple(np.full(len(run), k) for k, run in enumerate(runs))
    return Parts(tuple(run.name for run in runs), label, apart, whole_runs=True)


def time_blocks(runs: Sequence[JointRun], count: int) -> Parts:
    """Each run is cut into `count` equal blocks of time, the same of all runs are a part."""
    if count < 3:
        raise PartsError(f"{count} blocks: at least three are needed")
    label = tuple(np.arange(len(run)) * count // len(run) for run in runs)
    names = tuple(f"block {k + 1} of {count}" for k in range(count))
    return Parts(names, label, ~np.eye(count, dtype=bool), whole_runs=False)


def _groups(name: str, unlike: str | None) -> tuple[str, ...]:
    if unlike is None:
        return (name,)
    try:
        pattern = re.compile(unlike)
    except re.error as error:
        raise PartsError(f"{unlike!r} is no regular expression: {error}") from error
    found = pattern.search(name)
    if found is None or not pattern.groups or None in found.groups():
        raise PartsError(f"run {name}: {unlike!r} finds no groups in its name")
    return found.groups()
