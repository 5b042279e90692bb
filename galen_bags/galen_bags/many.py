"""One function over many bags, in parallel: on processes here, or on a Dask cluster.

And what such a job is given: the calibration file and the name of each bag.
"""

from __future__ import annotations

import contextlib
import os
import socket
import time
import traceback
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from galen_model.errors import GalenError
from galen_model.files.calibration_file import CalibrationFile, read_calibration
from tqdm import tqdm

if TYPE_CHECKING:
    from distributed import Client, Future

Result = TypeVar("Result")


@dataclass(frozen=True)
class Outcome(Generic[Result]):
    """What became of a bag: `error` is None, or a sentence that says why there is no result."""

    bag: Path
    result: Result | None
    error: str | None
    seconds: float


def json_rows(outcomes: Sequence[Outcome[dict[str, Any]]]) -> list[dict[str, Any]]:
    """Return each bag's result as JSON, or its path and the error."""
    return [
        {"bag": str(one.bag), "error": one.error} if one.result is None else one.result
        for one in outcomes
    ]


def run_many(
    function: Callable[[Path], Result],
    bags: Sequence[Path],
    *,
    scheduler: str | None = None,
    workers: int | None = None,
    progress: bool = True,
    timeout_s: float = 5.0,
) -> list[Outcome[Result]]:
    """Call `function` with each bag; returns the outcomes in the order of `bags`.

    A bag whose function raises, or ends its process, has an error for an outcome and does not
    stop the others. Without `scheduler`, on `workers` processes here (None: one a processor, but
    no more than bags), or in this process if that makes one or there is one bag. With it
    (`tcp://host:port` or a scheduler file), on whatever workers that has; the bags' paths must be
    absolute, and theirs too. Function and results must be picklable, and results should be small:
    all are held here. The function should print nothing: it shares a terminal with others.

    Args:
        function: a module's function, a `functools.partial` of one, or a callable object.
        bags: what it is called with, one at a time.
        scheduler: address or file of a Dask scheduler.
        workers: number of processes, at least 1; not with `scheduler`.
        progress: show a bar on standard error, where that is a terminal.
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
    if scheduler is not None and (relative := [bag for bag in bags if not bag.is_absolute()]):
        raise ValueError(f"{relative[0]}: with a scheduler, paths must be absolute")
    outcomes: dict[int, Outcome[Result]] = {}
    failed = 0
    with (
        tqdm(total=len(bags), unit="bag", disable=None if progress else True) as bar,
        # Closed here, so that an interrupt ends the workers before anything else goes on.
        contextlib.closing(_outcomes(function, bags, scheduler, workers, timeout_s)) as coming,
    ):
        for number, outcome in coming:
            outcomes[number] = outcome
            failed += outcome.error is not None
            if failed:
                bar.set_postfix(failed=failed, refresh=False)
            bar.update()
    return [outcomes[number] for number in range(len(bags))]


def _outcomes(
    function: Callable[[Path], Result],
    bags: Sequence[Path],
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
            yield from run.all_outcomes(at_once=len(bags))
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
        function: Callable[[Path], Result],
        bags: Sequence[Path],
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
            for following in islice(waiting, 1):
                another = self._submit(following)
                running[another] = following
                completed.add(another)
            yield number, self._outcome(number, future)

    def _death(self, number: int) -> Outcome[Result]:
        reason = "it crashed, was killed, or took more than its share of the memory"
        return self._error(number, f"the process that worked on it died: {reason}")

    def _loss(self, number: int) -> Outcome[Result]:
        return self._error(number, f"the scheduler {self._scheduler} was lost, or dropped it")

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
            self._lost = True
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
        seconds = time.monotonic() - self._started_s[number]
        return Outcome(bag, None, f"{bag}: {text}", seconds)


def _work(function: Callable[[Path], Result], bag: Path) -> Outcome[Result]:
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
    function: Callable[[Path], Result], bag: Path, scheduler: str | None
) -> Outcome[Result]:
    from distributed.protocol.pickle import dumps

    if scheduler is not None and not bag.exists():
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


def calibration_of_bag(bag: Path, tool: Path, *, beside: bool) -> CalibrationFile:
    """Read the calibration file that a bag was recorded with.

    Args:
        bag: the recording.
        tool: the file, or, with `beside`, its name in the bag's directory or the one above.
        beside: look for the file beside the bag.

    Raises:
        GalenError: the file is missing or invalid; the message names it.

    """
    if not beside:
        return read_calibration(tool)
    folder = bag if bag.is_dir() else bag.parent
    for place in (folder, folder.parent):
        if (place / tool.name).is_file():
            return read_calibration(place / tool.name)
    raise GalenError(f"{bag}: neither in it nor beside it is a tool's file {tool.name}")


def distinct_names(paths: Sequence[Path]) -> dict[Path, str]:
    """Name each path by its stem, with folders before it as far as they differ."""
    resolved = {path: Path(os.path.abspath(path)) for path in paths}  # noqa: PTH100 - keeps links
    depth = 1
    while True:
        names = {
            path: "_".join((*whole.parent.parts, whole.stem)[-depth:])
            for path, whole in resolved.items()
        }
        longest = max((len(whole.parts) for whole in resolved.values()), default=1)
        if len(set(names.values())) == len(names) or depth > longest:
            return names
        depth += 1
