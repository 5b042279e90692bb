# SPDX-License-Identifier: Apache-2.0
"""A tool's file when its writer is killed, the disk is full, the folder is closed, or links."""

from __future__ import annotations

import errno
import json
import os
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import pytest
from fuzz.readers import a_tool
from galen_model.arm.galen import GALEN
from galen_model.errors import CalibrationFileError
from galen_model.files import atomic_file as atomic_file
from galen_model.files.calibration_file import calibration_path, read_calibration, write_calibration
from galen_model.files.calibration_store import CalibrationStore

NURSERY = """
import json, mmap, os, random, signal, struct, sys, time
from dataclasses import replace
from pathlib import Path
from galen_model.arm.galen import GALEN
from galen_model.files.calibration_file import read_calibration, write_calibration

path, kills, seed = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
rng = random.Random(seed)
first = read_calibration(path, GALEN)

def tool(number):
    return replace(first, poses_used=number, poses_rejected=(f"{number} " * 60,) * 20)

def content(number):
    return (json.dumps(tool(number).to_json(), indent=2) + "\\n").encode()

shared = mmap.mmap(-1, 16)  # what the child has begun to write, and what it has written

def write_on(number):
    while True:
        number += 1
        struct.pack_into("q", shared, 0, number)
        write_calibration(path, tool(number))
        struct.pack_into("q", shared, 8, number)

write_calibration(path, tool(1))
number, counts, seconds = 1, {"old": 0, "new": 0, "between": 0, "other": 0, "backup": 0}, 0.01
for _ in range(kills):
    shared[:] = struct.pack("qq", number, number)
    child = os.fork()
    if child == 0:
        try:
            write_on(number)
        finally:
            os._exit(3)
    begun_s = time.monotonic()
    while struct.unpack("qq", shared[:])[1] < number + 2:  # at work, and how long one takes
        time.sleep(1e-4)
    seconds = 0.9 * seconds + 0.1 * (time.monotonic() - begun_s) / 2
    time.sleep(rng.uniform(0.0, 2.0 * seconds))
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    begun, written = struct.unpack("qq", shared[:])
    raw = path.read_bytes()
    is_old, is_new = raw == content(written), raw == content(begun)
    kind = "between" if is_old and is_new else "old" if is_old else "new" if is_new else "other"
    counts[kind] += 1
    backup = path.with_name(path.name + ".bak").read_bytes()
    counts["backup"] += backup in [content(begun - k) for k in range(3)]
    number = begun
counts["left"] = len([p for p in path.parent.iterdir() if p.name.startswith(".")])
counts["listed"] = sorted(p.name for p in path.parent.iterdir() if not p.name.startswith("."))
print(json.dumps(counts))
"""


def killed(folder: Path, kills: int, seed: int) -> dict:
    """Kill a writer that often; how often its file was the old one, the new one, or another."""
    path = calibration_path(folder, "pointer")
    write_calibration(path, a_tool("pointer"))
    done = subprocess.run(
        [sys.executable, "-c", NURSERY, str(path), str(kills), str(seed)],
        stdout=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        check=True,
    )
    return json.loads(done.stdout)


def check_kills(counts: dict, kills: int) -> None:
    assert counts["other"] == 0
    assert counts["old"] + counts["new"] + counts["between"] == kills == counts["backup"]
    assert counts["listed"] == ["pointer.json", "pointer.json.bak"]
    assert counts["old"] > 0  # it was hit at work


def test_fifteen_kills_leave_the_old_file_or_the_new_one(tmp_path: Path) -> None:
    check_kills(killed(tmp_path, 15, seed=1), 15)
    assert CalibrationStore(tmp_path, arm=GALEN).names() == [
        "pointer"
    ]  # what is left of a killed writer is hidden


@pytest.mark.soak
@pytest.mark.timeout(1800)
def test_a_thousand_kills_leave_the_old_file_or_the_new_one(tmp_path: Path) -> None:
    counts = killed(tmp_path, 1000, seed=2)
    print(f"1000 kills: {counts}")
    check_kills(counts, 1000)
    assert counts["new"] > 0


def test_what_killed_writers_left_goes_with_a_later_writing_of_the_same_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not while it is young: it may be another writer's at work."""
    path = calibration_path(tmp_path, "pointer")
    write_calibration(path, a_tool("pointer"))
    left = [".pointer.json.unfinished.ab_12cd9", ".pointer.json.unfinished.bak77"]
    others = [
        ".pointer.json.original", ".pointer.json.aside.5", ".pointer.jsonx.unfinished.abcdefgh",
        ".retractor.json.unfinished.abcdefgh", "pointer.json.bak", "pointer.json",
    ]  # fmt: skip
    for name in {*left, *others[:4]}:
        (tmp_path / name).write_text("half of a file")
    os.utime(tmp_path / left[0], (0.0, 0.0))  # what it says of itself doesn't matter
    write_calibration(path, a_tool("pointer"))
    assert names(tmp_path) == sorted(left + others)
    now_s = time.time()
    monkeypatch.setattr(atomic_file.time, "time", lambda: now_s + 660.0)
    write_calibration(path, a_tool("pointer"))
    assert names(tmp_path) == sorted(others)


# --- errors of the disk ---------------------------------------------------------------------------


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.EROFS])
@pytest.mark.parametrize("call", ["fsync", "replace", "link", "second replace"])
def test_an_error_of_the_disk_leaves_the_old_file_and_nothing_else(
    number: int, call: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At each step; without hard links the backup is a copy, which fails as well."""
    path = calibration_path(tmp_path, "pointer")
    for mass_kg in (0.05, 0.06):
        write_calibration(path, a_tool("pointer", mass_kg))
    before = {name: (tmp_path / name).read_bytes() for name in names(tmp_path)}
    calls = Counter[str]()

    def failing(*_args: object, **_options: object) -> None:
        raise OSError(number, os.strerror(number))

    def second(*args: object, **options: object) -> None:
        calls["replace"] += 1
        (failing if calls["replace"] == 2 else real)(*args, **options)

    real = os.replace
    if call == "link":
        monkeypatch.setattr(atomic_file.os, "link", failing)
        monkeypatch.setattr(Path, "write_bytes", _half_written(number))
    elif call == "second replace":
        monkeypatch.setattr(atomic_file.os, "replace", second)
    else:
        monkeypatch.setattr(atomic_file.os, call, failing)
    with pytest.raises(CalibrationFileError, match="can't be written") as error:
        write_calibration(path, a_tool("pointer", 0.07))
    monkeypatch.undo()
    assert str(path) in str(error.value) and os.strerror(number) in str(error.value)
    assert names(tmp_path) == sorted(before)
    assert path.read_bytes() == before["pointer.json"]
    assert read_calibration(path.with_name("pointer.json.bak"), arm=GALEN).load.mass_kg in (
        0.05,
        0.06,
    )
    write_calibration(path, a_tool("pointer", 0.07))
    assert read_calibration(path, arm=GALEN).load.mass_kg == 0.07


def _half_written(number: int):
    def write_bytes(path: Path, data: bytes) -> None:
        with path.open("wb") as stream:
            stream.write(data[: len(data) // 2])
        raise OSError(number, os.strerror(number))

    return write_bytes


IN_A_PROCESS = """
import resource, signal, sys
from pathlib import Path
from galen_model.errors import CalibrationFileError
from galen_model.arm.galen import GALEN
from galen_model.files.calibration_file import read_calibration, write_calibration
from dataclasses import replace

path = Path(sys.argv[1])
tool = read_calibration(path, GALEN)
new = replace(tool, poses_used=57)
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (300, 300))
try:
    write_calibration(path, new)
except CalibrationFileError as error:
    print(error)
"""


def test_a_file_that_may_not_grow_stays_the_old_one(tmp_path: Path) -> None:
    """The kernel itself ends the writing after 300 bytes, as on a full disk."""
    path = calibration_path(tmp_path, "pointer")
    write_calibration(path, a_tool("pointer"))
    before = path.read_bytes()
    done = subprocess.run(
        [sys.executable, "-c", IN_A_PROCESS, str(path)],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        check=True,
    )
    assert done.stdout == f"{path}: can't be written: File too large\n"
    assert path.read_bytes() == before and names(tmp_path) == ["pointer.json"]


def test_a_pipe_in_the_file_s_place_is_rejected_and_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pointer.json")
    with pytest.raises(CalibrationFileError, match="no regular file"):
        read_calibration(tmp_path / "pointer.json", arm=GALEN)
    (tmp_path / "folder.json").mkdir()
    with pytest.raises(CalibrationFileError, match="no regular file"):
        read_calibration(tmp_path / "folder.json", arm=GALEN)
    with pytest.raises(CalibrationFileError, match="no regular file"):
        read_calibration("/dev/zero", arm=GALEN)


# --- links ----------------------------------------------------------------------------------------


def test_a_link_in_the_file_s_place_is_replaced_and_leads_no_write_out(tmp_path: Path) -> None:
    """What it led to stays as it was, and `.bak` leads there."""
    tools, elsewhere = tmp_path / "tools", tmp_path / "elsewhere"
    elsewhere.mkdir()
    write_calibration(elsewhere / "mine.json", a_tool("pointer", 0.05))
    before = (elsewhere / "mine.json").read_bytes()
    tools.mkdir()
    path = calibration_path(tools, "pointer")
    path.symlink_to(elsewhere / "mine.json")
    write_calibration(path, a_tool("pointer", 0.07))
    assert not path.is_symlink() and read_calibration(path, arm=GALEN).load.mass_kg == 0.07
    assert names(elsewhere) == ["mine.json"]
    assert (elsewhere / "mine.json").read_bytes() == before
    backup = path.with_name("pointer.json.bak")
    assert backup.resolve() == elsewhere / "mine.json"
    write_calibration(path, a_tool("pointer", 0.08))  # and the backup is replaced, not followed
    assert read_calibration(backup, arm=GALEN).load.mass_kg == 0.07 and not backup.is_symlink()
    assert (elsewhere / "mine.json").read_bytes() == before
