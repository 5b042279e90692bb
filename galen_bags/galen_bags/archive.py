# SPDX-License-Identifier: Apache-2.0
"""Archives: recordings on a store or a disk, and results that are kept one by one.

A store is named by a URL (s3://, gs://, az://, https://) and read by fsspec. A recording there is
copied to where it is worked on, and removed afterwards. Credentials come from the environment and
the configuration of the store's own library, never from a URL.
"""

from __future__ import annotations

import argparse
import contextlib
import glob
import hashlib
import json
import os
import re
import shutil
import socket
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from galen_model.errors import GalenError
from galen_model.files.atomic_file import write_new
from galen_model.json_fields import FieldError, parse_json

from galen_bags.formats.files import METADATA, find_bags, is_rosbag2, is_storage
from galen_bags.many import ArchivedRecording, Place, run_each

TABLE, _KEPT = "table.parquet", "recordings"
_PACKAGES = {"s3": "s3fs", "gs": "gcsfs", "az": "adlfs", "abfs": "adlfs", "https": "aiohttp"}
_READ_ONLY = ("https",)
# A bucket or host and a name; all else may be a credential, such as a secret key with a slash.
_PLAIN_URL = re.compile(
    r"https://[^/@:?#]+(:\d+)?(/[^@?#]*)?|(?!https:)\w+://[^/@:]+(/.*)?", re.DOTALL
)
_COPY = f"galen_archive_{socket.gethostname()}_"
# Fields that change with a file's content, by store.
_CHANGES = ("ETag", "etag", "md5Hash", "mtime", "LastModified", "last_modified")
_LONGEST = 255  # bytes of a file's name
_BATCH = 512
_SHOWN_ERRORS = 20
_NOT_YET = "not done: the command was ended before; the same command goes on"
_NOT_SEEN = (
    "its worker wrote the result where this command does not see it: --results must be a folder"
    " that all share, or a URL"
)


# Places


def place(text: str) -> Place:
    """Read a path or a store's URL, for argparse.

    Args:
        text: the command's argument; a URL has `://` in it.

    Returns:
        A path as it is given, or the URL without slashes at its end.

    Raises:
        argparse.ArgumentTypeError: the store's scheme is not known, or the URL may hold a
            credential (user, password, query, fragment).

    """
    scheme, separator, _ = text.partition("://")
    if not separator:
        return Path(text)
    if scheme not in _PACKAGES:
        known = ", ".join(f"{one}://" for one in _PACKAGES)
        raise argparse.ArgumentTypeError(f"{scheme}:// is not known here; stores are {known}")
    if not _PLAIN_URL.fullmatch(text):
        raise argparse.ArgumentTypeError(
            f"this URL is more than {scheme}://, a bucket or host, and a path: it may hold a"
            " credential, which the process list and the results would show; give it without user,"
            " password, query and fragment, and the credential by the store's environment"
            " variables or configuration"
        )
    return text.rstrip("/")


def add_results(options: argparse.ArgumentParser | argparse._ArgumentGroup) -> None:
    """Add `--results PLACE`.

    Args:
        options: parser, or group of options, of a command that keeps results.

    """
    options.add_argument(
        "--results",
        type=place,
        metavar="PLACE",
        help=f"folder or URL: keep there the result of each recording as JSON, and {TABLE} with a"
        " row a recording; those whose result is there are skipped, so that the same command goes"
        " on after an interrupt",
    )


@contextlib.contextmanager
def _store(url: Place) -> Iterator[tuple[Any, str]]:
    """Give a place's file system and the path in it; raises GalenError for what fails."""
    import fsspec

    scheme = str(url).partition("://")[0]
    try:
        yield fsspec.core.url_to_fs(str(url), use_listings_cache=False)
    except GalenError:
        raise
    except ImportError as error:
        raise GalenError(
            f"{url}: {scheme}:// needs a package that is not installed: `pip install"
            f" {_PACKAGES[scheme]}` where the command and its workers run"
        ) from error
    except FileNotFoundError as error:
        raise GalenError(f"{url}: is not there") from error
    except Exception as error:  # each store's library has its own
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        # A server may have led to a URL with a signature.
        reason = re.sub(r"\?[^\s'\"]+", "?...", reason)
        raise GalenError(f"{url}: the store fails: {reason}") from error


@contextlib.contextmanager
def local_copy(
    given: Place, beside: str = "", folders: Sequence[str] = (), files: Sequence[str] = ()
) -> Iterator[Path]:
    """Give the path of a place: its own, or that of a copy that is then removed.

    Args:
        given: a bag (directory or file), a single file, or a recording's directory.
        beside: a file that comes along from the directory above, or of a file the two above.
        folders: the directories of a recording that are copied; none for a bag.
        files: the files beside them that are copied.

    Raises:
        GalenError: the store fails, names a file that can't be one here, or holds more than the
            temporary directory has room for.

    """
    if isinstance(given, Path):
        yield given
        return
    _remove_copies_of_the_dead()
    with tempfile.TemporaryDirectory(prefix=f"{_COPY}{os.getpid()}_") as made:
        copied = _copy(given, Path(made), beside, folders, files)
        try:
            yield copied
        except GalenError as error:
            raise GalenError(str(error).replace(str(copied), given)) from error


def _remove_copies_of_the_dead() -> None:
    """Remove what killed processes of this machine have copied."""
    for copy in Path(tempfile.gettempdir()).glob(f"{glob.escape(_COPY)}*_*"):
        try:
            os.kill(int(copy.name[len(_COPY) :].partition("_")[0]), 0)
        except ProcessLookupError:
            shutil.rmtree(copy, ignore_errors=True)
        except (ValueError, OverflowError, OSError):
            continue


def _find(store: Any, root: str, maxdepth: int | None = None) -> dict[str, Mapping[str, Any]]:
    """Return a store's files at or below a key, without the empty ones that mark folders."""
    found = store.find(root, maxdepth=maxdepth, detail=True)
    if not found:
        store.info(root)  # raises what `find` has swallowed
    return {key: info for key, info in found.items() if not key.endswith("/")}


def _above(key: str) -> list[str]:
    """Return the two directories above, as far as the store has them, the nearest first."""
    found: list[str] = []
    while len(found) < 2 and (key := key.rpartition("/")[0]) and not key.endswith(":/"):
        found.append(key)
    return found


def _copy(url: str, made: Path, beside: str, folders: Sequence[str], files: Sequence[str]) -> Path:
    with _store(url) as (store, root):
        found = _find(store, root, maxdepth=2 if folders else 1)
        if not found:
            raise GalenError(f"{url}: is not there")
        # Two directories above, for what lies beside.
        target = made / "above" / "beside" / _local(url, root.rpartition("/")[2])
        wanted: dict[str, Path] = {}
        for key in found:
            parts = [part for part in key[len(root) :].split("/") if part]
            if folders and not (
                (len(parts) == 2 and parts[0] in folders) or (len(parts) == 1 and parts[0] in files)
            ):
                continue
            wanted[key] = target.joinpath(*(_local(url, part) for part in parts))
        size = sum(int(found[key].get("size") or 0) for key in wanted)
        free = shutil.disk_usage(made).free
        if size > free:
            raise GalenError(
                f"{url}: {size / 1e6:.0f} MB, but {made.parent} has {free / 1e6:.0f} MB free: set"
                " TMPDIR to a larger disk"
            )
        for key, path in wanted.items():
            path.parent.mkdir(parents=True, exist_ok=True)
            store.get_file(key, str(path))
        places = _above(root)[: 2 if root in found else 1] if beside else ()
        for above, path in zip(places, target.parents, strict=False):
            path.mkdir(parents=True, exist_ok=True)
            try:
                store.get_file(f"{above}/{beside}", str(path / _local(url, beside)))
            except (FileNotFoundError, PermissionError):
                (path / beside).unlink(missing_ok=True)
        return target


def _local(url: str, name: str) -> str:
    """Check that a store's name is one name here."""
    if name in ("", ".", "..") or "/" in name or "\0" in name or len(_utf8(name)) > _LONGEST:
        raise GalenError(f"{url}: {name!r} can't be the name of a file here")
    return name


# Search


def find_recordings(
    places: Sequence[Place], folders: Sequence[str] = (), files: Sequence[str] = ()
) -> list[ArchivedRecording]:
    """Return the recordings that places are or hold, each once, sorted.

    Args:
        places: bags or recordings, or what is searched for them.
        folders: a recording is a directory with one of these in it; none: a bag is one.
        files: what beside them a recording's result depends on, such as the tool's file.

    Raises:
        GalenError: a place is not there, or holds none; but a local one, with `folders`, is
            returned as it is: its reader says what lacks, and the others go on.

    """
    paths = [one for one in places if isinstance(one, Path)]
    here = [path for one in paths for path in _below(one, folders)] if folders else []
    if paths and not folders:
        here = find_bags(paths)
    listed = [ArchivedRecording(path, _version(_stats(path, folders, files))) for path in here]
    for url in places:
        if isinstance(url, str):
            there = _there(url, folders, files)
            if not there:
                what = f"with {', '.join(folders)}" if folders else "or bag"
                raise GalenError(f"{url}: no recording {what} in it")
            listed += there
    found = {str(recording): recording for recording in listed}
    return [found[name] for name in sorted(found)]


def _below(path: Path, folders: Sequence[str]) -> list[Path]:
    below: set[Path] = set()
    # What can't be read, or is none, gets its own message from the reader.
    with contextlib.suppress(OSError):
        if any((path / name).is_dir() for name in folders):
            return [path]
        bags = [bag for name in folders for bag in path.rglob(name) if bag.is_dir()]
        below = {bag.parent for bag in bags if not _is_hidden(bag.relative_to(path).parts)}
    return sorted(below) or [path]


def _is_hidden(parts: Iterable[str]) -> bool:
    return any(part.startswith(".") for part in parts)


def _stats(path: Path, folders: Sequence[str], files: Sequence[str]) -> Iterator[str]:
    """Return names, sizes and times of a recording's files, and of those beside it."""
    above = path if folders else path.parent
    places = [above / name for name in files] + [above.parent / name for name in files]
    inside = [path / name for name in folders] if folders else [path]
    for one in (*inside, *places):
        with contextlib.suppress(OSError):  # the reader says what can't be read
            for file in sorted(one.iterdir()) if one.is_dir() else [one]:
                if file.is_file():
                    status = file.stat()
                    yield f"{file} {status.st_size} {status.st_mtime_ns}"


def _version(lines: Iterable[str]) -> str:
    return hashlib.sha256(_utf8("\n".join(sorted(lines)))).hexdigest()[:16]


def _utf8(text: str) -> bytes:
    """Return a text's bytes; a local name may hold bytes that are none of UTF-8."""
    return text.encode(errors="backslashreplace")


def _there(url: str, folders: Sequence[str], files: Sequence[str]) -> list[ArchivedRecording]:
    with _store(url) as (store, root):
        listed: dict[str, dict[str, str]] = {}
        for key, info in _find(store, root).items():
            folder, _, name = key.rpartition("/")
            if not _is_hidden(key[len(root) :].split("/")):
                listed.setdefault(folder, {})[name] = _line(key, info)
        above, _, own = root.rpartition("/")
        for place in _above(root):
            for name in files:
                with contextlib.suppress(OSError):
                    line = _line(f"{place}/{name}", store.info(f"{place}/{name}"))
                    listed.setdefault(place, {}).setdefault(name, line)
        if own in listed.get(above, ()):  # the URL is a file
            keys = {root: [listed[above][own]]}
        elif folders:
            keys = _recording_keys(root, listed, folders)
        else:
            keys = _bag_keys(listed)
        for key, lines in keys.items():
            up = key if folders else key.rpartition("/")[0]
            near = (listed.get(place, {}) for place in (key, up, up.rpartition("/")[0]))
            lines += [at[name] for at in near for name in files if name in at]
        return [
            ArchivedRecording(store.unstrip_protocol(key), _version(lines))
            for key, lines in keys.items()
        ]


def _line(key: str, info: Mapping[str, Any]) -> str:
    change = next((info[what] for what in _CHANGES if what in info), "")
    return f"{key} {info.get('size')} {change}"


def _recording_keys(
    root: str, listed: Mapping[str, Mapping[str, str]], folders: Sequence[str]
) -> dict[str, list[str]]:
    keys: dict[str, list[str]] = {}
    for folder, names in listed.items():
        above, _, own = folder.rpartition("/")
        if own in folders and f"{above}/".startswith(f"{root}/"):
            keys.setdefault(above, []).extend(names.values())
    return keys


def _bag_keys(listed: Mapping[str, Mapping[str, str]]) -> dict[str, list[str]]:
    """Return the bags among a store's files, by the rules of `find_bags`."""
    keys: dict[str, list[str]] = {}
    last = "\0"
    for folder in sorted(listed, key=lambda name: name.split("/")):
        if folder.startswith(f"{last}/"):
            continue  # inside a bag
        names = listed[folder]
        bags = [name for name in names if is_storage(name)]
        if is_rosbag2(folder.rpartition("/")[2], bags, described=METADATA in names):
            last = folder
            keys[folder] = list(names.values())
        else:
            keys |= {f"{folder}/{name}": [names[name]] for name in bags}
    return keys


# Results


@dataclass(frozen=True)
class Archive:
    """Keeps what a job returns of each recording; picklable, for workers.

    job: returns a recording's result as JSON, at a path or URL. results: where it is kept.
    settings: what the result depends on beside the recording, as JSON; another one is another
    result.
    """

    job: Callable[[Place], dict[str, Any]]
    results: Place
    settings: Mapping[str, Any]

    def __call__(self, recording: ArchivedRecording) -> None:
        """Do one recording, and keep its result."""
        content = {**self.job(recording.place), "recording": str(recording)}
        text = json.dumps(content, allow_nan=False)
        self._write(f"{_KEPT}/{self._name(recording)}", text.encode())

    def run(
        self,
        recordings: Sequence[ArchivedRecording],
        columns: Mapping[str, str],
        to_row: Callable[[Mapping[str, Any]], Mapping[str, Any]],
        *,
        scheduler: str | None = None,
        workers: int | None = None,
    ) -> dict[str, Any]:
        """Do what has no result yet, and write the table of all, also where this is interrupted.

        Args:
            recordings: all of them.
            columns: the table's columns and their types, by pyarrow's names, beside `recording`
                and `error`.
            to_row: makes a row of a result.
            scheduler: as of `run_each`.
            workers: as of `run_each`.

        Returns:
            Counts of recordings, those done now, skipped and failed; `table`, where it is;
            `verdicts`, how many have each; `errors`, the first ones.

        Raises:
            GalenError: results can't be written, or as of `run_each`.
            KeyboardInterrupt: the table is written before.

        """
        note = json.dumps(self.settings, indent=2, default=str)
        self._write(f"settings-{self._settings_name()}.json", f"{note}\n".encode())
        there = self._kept()
        waiting = [one for one in recordings if self._name(one) not in there]
        if len(waiting) < len(recordings):
            print(
                f"{len(recordings) - len(waiting)} of {len(recordings)} results are there: nothing"
                " else is written of these",
                file=sys.stderr,
            )
        errors: dict[str, str] = {}
        try:
            for _, outcome in run_each(self, waiting, scheduler=scheduler, workers=workers):
                errors[str(outcome.bag)] = outcome.error or _NOT_SEEN
        finally:
            try:
                written = self._write_table(recordings, columns, to_row, errors, there)
            except OSError as error:
                raise GalenError(f"{self.results}/{TABLE}: can't be written: {error}") from error
        skipped, failed, first_errors, verdicts = written
        return {
            "recordings": len(recordings),
            "done": len(recordings) - skipped - failed,
            "skipped": skipped,
            "failed": failed,
            "verdicts": verdicts,
            "table": f"{self.results}/{TABLE}",
            "errors": first_errors,
        }

    def _settings_name(self) -> str:
        known = json.dumps(self.settings, sort_keys=True, default=str)
        return hashlib.sha256(known.encode()).hexdigest()[:12]

    def _name(self, recording: ArchivedRecording) -> str:
        known = f"{self._settings_name()} {recording.version} {recording}"
        return f"{hashlib.sha256(_utf8(known)).hexdigest()[:32]}.json"

    def _write(self, name: str, content: bytes | Path) -> None:
        """Write in one step; `content`: bytes that the name stands for, or a file to be moved."""
        if isinstance(self.results, Path):
            target = self.results / name
            try:
                target.parent.mkdir(parents=True, exist_ok=True)
                if isinstance(content, bytes):
                    with contextlib.suppress(FileExistsError):  # by another command
                        write_new(target, content)
                else:
                    os.replace(content, target)
            except OSError as error:
                raise GalenError(f"{target}: can't be written: {error.strerror}") from error
            return
        if self.results.startswith(tuple(f"{scheme}://" for scheme in _READ_ONLY)):
            raise GalenError(f"{self.results}: can't be written to: give a folder, s3:// or gs://")
        with _store(self.results) as (store, root):
            if isinstance(content, bytes):
                store.pipe_file(f"{root}/{name}", content)
            else:
                store.put_file(str(content), f"{root}/{name}")

    def _kept(self) -> set[str]:
        with _store(self.results) as (store, root):
            try:
                keys = store.ls(f"{root}/{_KEPT}", detail=False)
            except FileNotFoundError:
                return set()
            return {key.rpartition("/")[2] for key in keys}

    def _contents(self, names: Sequence[str]) -> Mapping[str, bytes | None]:
        """Return kept results by name, None for those that are not there."""
        with _store(self.results) as (store, root):
            keys = [f"{root}/{_KEPT}/{name}" for name in names]
            # Many at once, as `cat`, which would take brackets in a key for a pattern.
            read = store.cat_ranges(keys, None, None, on_error="return")
            for answer in read:
                if isinstance(answer, Exception) and not isinstance(answer, FileNotFoundError):
                    raise answer
            return {
                name: raw if isinstance(raw, bytes) else None
                for name, raw in zip(names, read, strict=True)
            }

    def _write_table(
        self,
        recordings: Sequence[ArchivedRecording],
        columns: Mapping[str, str],
        to_row: Callable[[Mapping[str, Any]], Mapping[str, Any]],
        errors: Mapping[str, str],
        there: set[str],
    ) -> tuple[int, int, list[str], dict[str, int]]:
        """Write a row a recording, some hundreds at a time.

        Returns how many were `there` and can be used, how many have an error, the first of these,
        and how many have each verdict. What counts is what was kept: of a lost worker or
        scheduler, a result may be there all the same.
        """
        import pyarrow
        from pyarrow import parquet

        types = {"recording": "string", "error": "string", **columns}
        schema = pyarrow.schema([(name, getattr(pyarrow, kind)()) for name, kind in types.items()])
        skipped, failed, first_errors, verdicts = 0, 0, list[str](), dict[str, int]()
        folder = self.results if isinstance(self.results, Path) else None
        with tempfile.TemporaryDirectory(prefix=".galen_table_", dir=folder) as made:
            unfinished = Path(made) / TABLE
            with parquet.ParquetWriter(unfinished, schema, compression="zstd") as writer:
                for first in range(0, len(recordings), _BATCH):
                    batch = recordings[first : first + _BATCH]
                    names = [self._name(one) for one in batch]
                    contents = self._contents(names)
                    rows = []
                    for one, name in zip(batch, names, strict=True):
                        row = self._row(one, contents[name], to_row, errors, schema)
                        rows.append(row)
                        if "error" not in row:
                            verdicts[row["verdict"]] = verdicts.get(row["verdict"], 0) + 1
                            skipped += name in there
                            continue
                        failed += 1
                        first_errors += [row["error"]][: _SHOWN_ERRORS - len(first_errors)]
                    writer.write_batch(pyarrow.RecordBatch.from_pylist(rows, schema=schema))
            self._write(TABLE, unfinished)
        return skipped, failed, first_errors, verdicts

    def _row(
        self,
        recording: ArchivedRecording,
        raw: bytes | None,
        to_row: Callable[[Mapping[str, Any]], Mapping[str, Any]],
        errors: Mapping[str, str],
        schema: Any,
    ) -> dict[str, Any]:
        import pyarrow

        row = {"recording": _utf8(str(recording)).decode()}
        if raw is None:
            return {**row, "error": _utf8(errors.get(str(recording), _NOT_YET)).decode()}
        try:
            whole = {**row, **to_row(parse_json(raw))}
            pyarrow.RecordBatch.from_pylist([whole], schema=schema)
            if whole["verdict"] is None:
                raise FieldError("it has no verdict")
        except (LookupError, TypeError, AttributeError, ValueError, OverflowError) as broken:
            name = f"{self.results}/{_KEPT}/{self._name(recording)}"
            return {**row, "error": f"{name}: can't be used, remove it: {broken!r}"}
        return whole


def print_summary(summary: Mapping[str, Any], *, as_json: bool) -> None:
    """Print what `Archive.run` returned, for a person or a program.

    Args:
        summary: the counts, errors and the table's place, by name.
        as_json: print it as one JSON object; else as lines, of which the errors go to stderr.

    """
    if as_json:
        print(json.dumps(summary, indent=2))
        return
    counts = ", ".join(f"{summary[what]} {what}" for what in ("done", "skipped", "failed"))
    print(f"{summary['recordings']} recordings: {counts}")
    for verdict, count in sorted(summary["verdicts"].items(), key=lambda one: -one[1]):
        print(f"  {verdict}: {count}")
    for error in summary["errors"]:
        print(f"failed: {error}", file=sys.stderr)
    if summary["failed"] > len(summary["errors"]):
        print("and more; the table has them all", file=sys.stderr)
    print(f"written: {summary['table']}")
