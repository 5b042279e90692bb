# SPDX-License-Identifier: Apache-2.0
"""One function over many bags, in parallel: on processes here, or on a Dask cluster.

And what such a job is given: the calibration file and the name of each bag.
"""

from __future__ import annotations

import contextlib
import os
import re
import socket
import time
import traceback
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from galen_model.arm.arm import Arm
from galen_model.errors import GalenError
from galen_model.files.calibration_file import CalibrationFile, read_calibration
from tqdm import tqdm

if TYPE_CHECKING:
    from distributed import Client, Future

Result = TypeVar("Result")
Place = Path | str
"""A path, or a store's URL."""
# So many bags are on their way on a cluster: they keep hundreds of workers busy, and a scheduler's
# memory does not grow with the archive.
_AT_ONCE = 1000


@dataclass(frozen=True)
class ArchivedRecording:
    """A recording of an archive; `version` is another one where its files are."""

    place: Place
    version: str = ""

    def __str__(self) -> str:
        return str(self.place)


@dataclass(frozen=True)
class Outcome(Generic[Result]):
    """What became of a bag: `error` is None, or a sentence that says why there is no result."""

    bag: Place | ArchivedRecording
    result: Result | None
    error: str | None
    seconds: float


def json_rows(outcomes: Sequence[Outcome[dict[str, Any]]]) -> list[dict[str, Any]]:
    """Return each bag's result as JSON, or its path and the error.

    Args:
        outcomes: of a function that returns JSON objects.

    Returns:
        One object a bag, in the same order; `bag` and `error` where there is no result.

    """
    return [
        {"bag": str(one.bag), "error": one.error} if one.result is None else one.result
        for one in outcomes
    ]


def run_many(
    function: Callable[[Any], Result],
    bags: Sequence[Place | ArchivedRecording],
    *,
    scheduler: str | None = None,
    workers: int | None = None,
    timeout_s: float = 5.0,
) -> list[Outcome[Result]]:
    """Call `function` with each bag, and hold all results; see `run_each`.

    Args:
        function: a module's function, a `functools.partial` of one, or a callable object.
        bags: what it is called with, one at a time.
        scheduler: address or file of a Dask scheduler.
        workers: number of processes, at least 1; not with `scheduler`.
        timeout_s: how long to wait for the scheduler's answer.

    Returns:
        The outcomes, in the order of `bags`.

    Raises:
        ValueError: both `scheduler` and `workers`, less than one worker, or with a scheduler a path
            that isn't absolute.
        GalenError: the scheduler can't be used, or no processes can be started.
        KeyboardInterrupt: Ctrl-C; no outcome is returned.

    """
    outcomes = dict(
        run_each(function, bags, scheduler=scheduler, workers=workers, timeout_s=timeout_s)
    )
    return [outcomes[number] for number in range(len(bags))]


def run_each(
    function: Callable[[Any], Result],
    bags: Sequence[Place | ArchivedRecording],
    *,
    scheduler: str | None = None,
    workers: int | None = None,
    timeout_s: float = 5.0,
) -> Iterator[tuple[int, Outcome[Result]]]:
    """Call `function` with each bag; yields the bags' numbers and outcomes as they come.

    A bag whose function raises, or ends its process, has an error for an outcome and does not
    stop the others. Without `scheduler`, on `workers` processes here (None: one a processor, but
    no more than bags), or in this process if that makes one or there is one bag. With it
    (`tcp://host:port` or a scheduler file), on whatever workers that has; the bags' paths must be
    absolute, and theirs too; URLs are the function's matter. Function and results must be
    picklable, and small. The function should print nothing: it shares a terminal with others.

    Args:
        function: a module's function, a `functools.partial` of one, or a callable object.
        bags: what it is called with, one at a time.
        scheduler: address or file of a Dask scheduler.
        workers: number of processes, at least 1; not with `scheduler`.
        timeout_s: how long to wait for the scheduler's answer.

    Raises:
        GalenError: the scheduler can't be used, or no processes can be started.
        KeyboardInterrupt: Ctrl-C; local processes have ended. On a cluster, bags that are being
            worked on are worked through, and their results dropped.

    """
    if scheduler is not None and workers is not None:
        raise ValueError("workers are for local processes; a scheduler has its own")
    if workers is not None and workers < 1:
        raise ValueError(f"workers must be at least 1, not {workers}")
    paths = (path for path in map(_path, bags) if path is not None)
    if scheduler is not None and (relative := [one for one in paths if not one.is_absolute()]):
        raise ValueError(f"{relative[0]}: with a scheduler, paths must be absolute")
    failed = 0
    with (
        tqdm(total=len(bags), unit="bag", disable=None) as bar,
        # Closed here, so that an interrupt ends the workers before anything else goes on.
        contextlib.closing(_outcomes(function, bags, scheduler, workers, timeout_s)) as coming,
    ):
        for number, outcome in coming:
            failed += outcome.error is not None
            if failed:
                bar.set_postfix(failed=failed, refresh=False)
            bar.update()
            yield number, outcome


def _path(bag: Place | ArchivedRecording) -> Path | None:
    """Return a bag's path; None for a URL."""
    place = bag.place if isinstance(bag, ArchivedRecording) else bag
    return place if isinstance(place, Path) else None


def _outcomes(
    function: Callable[[Any], Result],
    bags: Sequence[Place | ArchivedRecording],
    scheduler: str | None,
    workers: int | None,
    timeout_s: float,
) -> Generator[tuple[int, Outcome[Result]], None, None]:
    """Outcomes with the bags' numbers, as they come."""
    if not bags:
        return
    if scheduler is None and (len(bags) == 1 or workers == 1):
        for number, bag in enumerate(bags):
            yield number, _work(function, bag)
        return
    # Importing dask takes longer than many a bag.
    from galen_bags.workers import cpu_count, local_workers, scheduler_client

    if scheduler is not None:
        with scheduler_client(scheduler, timeout_s) as client:
            run = _Run(client, function, bags, scheduler)
            yield from run.all_outcomes(at_once=_AT_ONCE)
        return
    count = min(workers or cpu_count(), len(bags))
    with local_workers(count) as client:
        run = _Run(client, function, bags, None)
        yield from run.all_outcomes(at_once=count)


class _Run(Generic[Result]):
    """Bags on their way through a cluster."""

    def __init__(
        self,
        client: Client,
        function: Callable[[Any], Result],
        bags: Sequence[Place | ArchivedRecording],
        scheduler: str | None,
    ) -> None:
        self._client = client
        self._function = function
        self._bags = bags
        self._scheduler = scheduler
        self._started_s: dict[int, float] = {}
        self._lost = False

    def all_outcomes(self, at_once: int) -> Iterator[tuple[int, Outcome[Result]]]:
        """Outcomes with the bags' numbers, as they come; `at_once` bags are on their way."""
        killed = []
        for number, outcome in self._outcomes(range(len(self._bags)), at_once):
            if outcome is None:
                killed.append(number)
            else:
                yield number, outcome
        # Which of the bags on a worker ended it is certain only where one is alone; and alone, one
        # that was killed for its memory may go through.
        for number in killed:
            if self._lost:
                yield number, self._loss(number)
                continue
            for _, outcome in self._outcomes([number], 1):
                yield number, outcome or self._death(number)

    def _outcomes(
        self, numbers: Iterable[int], at_once: int
    ) -> Iterator[tuple[int, Outcome[Result] | None]]:
        """None if the worker died."""
        from distributed import as_completed

        waiting = iter(numbers)
        running = {self._submit(number): number for number in islice(waiting, at_once)}
        completed = as_completed(list(running), loop=self._client.loop)
        for future in completed:
            number = running.pop(future)
            self._lost = self._lost or future.cancelled()
            for following in islice(waiting, 0 if self._lost else 1):
                another = self._submit(following)
                running[another] = following
                completed.add(another)
            yield number, self._outcome(number, future)
            self._started_s.pop(number, None)
        for number in waiting:  # none, unless the scheduler was lost
            yield number, self._loss(number)

    def _death(self, number: int) -> Outcome[Result]:
        reason = "it crashed, was killed, or took more than its share of the memory"
        return self._error(number, f"the process that worked on it died: {reason}")

    def _loss(self, number: int) -> Outcome[Result]:
        text = f"the scheduler {self._scheduler} was lost, or dropped it; run the command again"
        return self._error(number, text)

    def _submit(self, number: int) -> Future:
        self._started_s[number] = time.monotonic()
        bag = self._bags[number]
        # Not pure: a bag may have changed since a cluster last saw the same call.
        return self._client.submit(
            _work_elsewhere, self._function, bag, self._scheduler, pure=False
        )

    def _outcome(self, number: int, future: Future) -> Outcome[Result] | None:
        """None if the worker died."""
        from distributed import KilledWorker

        if future.cancelled():
            return self._loss(number)
        try:
            outcome: Outcome[Result] = future.result()
        except KilledWorker:
            return None
        # Only what happens to the function and its result on their way.
        except Exception as error:
            while isinstance(error.__cause__, Exception):
                error = error.__cause__
            reason = " ".join(f"{type(error).__name__}: {error}".splitlines()[:1])
            where = "the scheduler and its workers" if self._scheduler else "the workers"
            return self._error(
                number, f"{reason} (what this command can import, {where} must be able to)"
            )
        return outcome

    def _error(self, number: int, text: str) -> Outcome[Result]:
        bag = self._bags[number]
        now_s = time.monotonic()
        seconds = now_s - self._started_s.get(number, now_s)
        return Outcome(bag, None, f"{bag}: {text}", seconds)


def _work(function: Callable[[Any], Result], bag: Place | ArchivedRecording) -> Outcome[Result]:
    started_s = time.monotonic()
    result, text = None, None
    try:
        result = function(bag)
    except GalenError as error:
        text = " ".join(str(error).split())
    # A library may end the process where it should raise.
    except (Exception, SystemExit) as error:
        last = traceback.extract_tb(error.__traceback__)[-1]
        at = f"{Path(last.filename).name}, line {last.lineno}"
        text = " ".join(f"{bag}: {type(error).__name__}: {error} ({at})".split())
    return Outcome(bag, result, text, time.monotonic() - started_s)


def _work_elsewhere(
    function: Callable[[Any], Result], bag: Place | ArchivedRecording, scheduler: str | None
) -> Outcome[Result]:
    from distributed.protocol.pickle import dumps

    path = _path(bag)
    if scheduler is not None and path is not None and not path.exists():
        where = f"{socket.gethostname()}, where a worker of {scheduler} looked for it"
        text = f"{bag}: is not there on {where}: its workers must see the same paths"
        return Outcome(bag, None, text, 0.0)
    outcome = _work(function, bag)
    try:
        dumps(outcome.result)
    except Exception as error:
        reason = f"{type(error).__name__}: {error}".splitlines()[0]
        text = f"{bag}: its result can't be sent from the worker: {reason}"
        return Outcome(bag, None, text, outcome.seconds)
    return outcome


# Inputs


def calibration_of_bag(bag: Path, tool: Path, *, beside: bool, arm: Arm) -> CalibrationFile:
    """Read the calibration file that a bag was recorded with.

    Args:
        bag: the recording.
        tool: the file, or, with `beside`, its name in the bag's directory or the one above.
        beside: look for the file beside the bag.
        arm: the one that it is used on.

    Raises:
        GalenError: the file is missing or invalid; the message names it.

    """
    if not beside:
        return read_calibration(tool, arm)
    folder = bag if bag.is_dir() else bag.parent
    for place in (folder, folder.parent):
        if (place / tool.name).is_file():
            return read_calibration(place / tool.name, arm)
    raise GalenError(f"{bag}: neither in it nor beside it is a tool's file {tool.name}")


def distinct_names(paths: Sequence[Path]) -> dict[Path, str]:
    """Name each path by its stem, with folders before it as far as they differ.

    Args:
        paths: bags or files, each once.

    Returns:
        A name by path, with "_" between the parts.

    """
    depth = name_depth(paths)
    return {path: name_of(path, depth) for path in paths}


def name_depth(places: Sequence[Place]) -> int:
    """Return how many parts of each place `name_of` needs to name all differently.

    Args:
        places: each once.

    Returns:
        Number of parts, from 1 (the stem) to those of the longest.

    """
    longest = max((len(_parts(place)) for place in places), default=1)
    for depth in range(1, longest):
        if len({name_of(place, depth) for place in places}) == len(places):
            return depth
    return longest


def name_of(place: Place, depth: int = 1) -> str:
    """Name a place by its stem and the folders before it.

    Args:
        place: a path, made absolute but for links, or a URL, whose scheme is left out.
        depth: number of parts, the stem among them.

    Returns:
        The parts with "_" between them; fit for a file's name.

    """
    name = "_".join(_parts(place)[-depth:])
    # A store's names may have what a file here may not.
    return name if isinstance(place, Path) else re.sub(r"[^\w.+-]", "_", name)


def _parts(place: Place) -> tuple[str, ...]:
    path = Path("/", place.partition("://")[2]) if isinstance(place, str) else place
    whole = Path(os.path.abspath(path))  # noqa: PTH100 - keeps links
    return (*whole.parent.parts, whole.stem)
