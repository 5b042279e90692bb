# SPDX-License-Identifier: Apache-2.0
"""The calibration files of a directory: nothing lost, nothing overwritten, no way out of it."""

import json
import os
from dataclasses import replace
from pathlib import Path

import pytest
from galen_model.arm.galen import GALEN
from galen_model.errors import CalibrationFileError, GalenError, ToolNameError
from galen_model.files import atomic_file as atomic_file
from galen_model.files import calibration_store as tool_store
from galen_model.files.calibration_file import (
    calibration_path,
    read_calibration,
    write_calibration,
)
from galen_model.files.calibration_store import (
    CalibrationStore,
    CalibrationStoreError,
    FileState,
    ToolExistsError,
)
from model_files import calibration


@pytest.fixture
def store(tmp_path: Path) -> CalibrationStore:
    """A pointer with a calibration before it, and a retractor."""
    store = CalibrationStore(tmp_path / "tools", arm=GALEN)
    for tool in (
        calibration("pointer", 0.05),
        calibration("pointer"),
        calibration("retractor", 0.2),
    ):
        write_calibration(calibration_path(store.directory, tool.tool), tool)
    return store


def masses(store: CalibrationStore) -> dict[str, float]:
    """Every usable calibration in the directory, whatever it is called."""
    found = {}
    for path in store.directory.iterdir():
        try:
            found[path.name] = read_calibration(path, arm=GALEN).load.mass_kg
        except GalenError:
            continue
    return found


def files(store: CalibrationStore) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in store.directory.iterdir()}


BEFORE = {"pointer.json": 0.06, "pointer.json.bak": 0.05, "retractor.json": 0.2}
SWAPPED = BEFORE | {"pointer.json": 0.05, "pointer.json.bak": 0.06}
RENAMED = {"probe.json": 0.06, "probe.json.bak": 0.05, "retractor.json": 0.2}


def test_broken_files_are_listed_by_name(store, tmp_path):
    folder = store.directory
    (folder / "cut.json").write_text('{"schema_version": 1')
    (folder / "my tool.json").write_bytes((folder / "pointer.json").read_bytes())
    (folder / "copied.json").write_bytes((folder / "pointer.json").read_bytes())
    (folder / "folder.json").mkdir()
    os.mkfifo(folder / "pipe.json")  # opening it would wait for ever
    (tmp_path / "outside.json").write_bytes((folder / "pointer.json").read_bytes())
    (folder / "link.json").symlink_to(tmp_path / "outside.json")
    (folder / "circle.json").symlink_to(folder / "circle.json")
    (folder / "big.json").write_bytes(b" " * 1_000_001)
    (folder / ".pointer.json.x1").write_text("left by a killed process")
    (folder / ".hidden.json").write_text("{}")
    entries = {entry.name: entry for entry in store.entries()}
    assert [name for name, entry in entries.items() if entry.stored] == ["pointer", "retractor"]
    problems = {name: entry.problem for name, entry in entries.items() if not entry.stored}
    words = {
        "big": "larger than", "circle": "out of", "copied": "holds the tool 'pointer'",
        "cut": "not JSON", "folder": "regular file", "link": "a link that leads out of",
        "my tool": "letters, digits", "pipe": "regular file",
    }  # fmt: skip
    assert set(problems) == set(words)
    for name, word in words.items():
        assert word in problems[name] and name in problems[name]
    assert list(CalibrationStore(tmp_path / "none", arm=GALEN).entries()) == []


def test_a_link_within_the_directory_and_a_linked_directory_are_read(store, tmp_path):
    """Configuration systems keep the files in a folder beside and link to them."""
    data = store.directory / "..data"
    data.mkdir()
    write_calibration(data / "drill.json", calibration("drill"))
    (store.directory / "drill.json").symlink_to("..data/drill.json")
    (tmp_path / "linked").symlink_to(store.directory)
    assert CalibrationStore(tmp_path / "linked", arm=GALEN).read("drill").tool.tool == "drill"


@pytest.mark.parametrize("name", ["../outside", "a/b", "", ".", "pointer.json", "a\0", "ä"])
def test_names_are_checked_everywhere(store, name):
    before = files(store)
    for call in (
        lambda: store.read(name),
        lambda: store.rename(name, "new"),
        lambda: store.rename("pointer", name),
        lambda: store.remove(name),
        lambda: store.restore(name),
        lambda: store.previous(name),
        lambda: store.revert(name),
    ):
        with pytest.raises(ToolNameError):
            call()
    assert files(store) == before


def test_rename_takes_the_name_inside_and_the_backup_along(store):
    content = json.loads((store.directory / "pointer.json").read_text())
    content["of_a_later_version"] = {"x": 1}
    (store.directory / "pointer.json").write_text(json.dumps(content))
    renamed = store.rename("pointer", "probe")
    assert renamed.tool.tool == "probe" and renamed.sha256 == store.read("probe").sha256
    assert masses(store) == RENAMED
    assert json.loads(renamed.content) == content | {"tool": "probe"}
    assert read_calibration(store.directory / "probe.json.bak", arm=GALEN).tool == "probe"
    with pytest.raises(CalibrationFileError) as missing:
        store.rename("pointer", "again")
    assert isinstance(missing.value.__cause__, FileNotFoundError)


def test_rename_never_overwrites(store):
    before = files(store)
    for taken in ("retractor", "pointer"):
        with pytest.raises(ToolExistsError, match=taken):
            store.rename("pointer", taken)
    (store.directory / "odd.json").symlink_to("nowhere")
    with pytest.raises(ToolExistsError, match="odd"):
        store.rename("pointer", "odd")
    (store.directory / "odd.json").unlink()
    assert files(store) == before
    # A backup that a tool left behind is kept as well.
    (store.directory / "probe.json.bak").write_text("an old one")
    store.rename("pointer", "probe")
    assert (store.directory / "probe.json.bak.removed").read_text() == "an old one"
    assert read_calibration(store.directory / "probe.json.bak", arm=GALEN).load.mass_kg == 0.05


def steps(monkeypatch: pytest.MonkeyPatch, fail_at: int, error: type[BaseException]) -> None:
    """Let the `fail_at`th change of the directory fail, before it is done."""
    count = 0

    def failing(real):
        def call(*args, **options):
            nonlocal count
            count += 1
            # A killed process does nothing any more; a full disk fails once.
            if count == fail_at or (count > fail_at and error is KeyboardInterrupt):
                raise error(28, "No space left on device")
            return real(*args, **options)

        return call

    monkeypatch.setattr(atomic_file.os, "link", failing(os.link))
    monkeypatch.setattr(atomic_file.os, "replace", failing(os.replace))
    monkeypatch.setattr(Path, "unlink", failing(Path.unlink))


def cut_short(change, fail_at, error):
    """Whether the change of the directory was given up, with an error at that step of it."""
    with pytest.MonkeyPatch.context() as patch:
        steps(patch, fail_at, error)
        try:
            change()
        except (CalibrationStoreError, KeyboardInterrupt):
            return True
    return False


@pytest.mark.parametrize("fail_at", range(1, 8))
@pytest.mark.parametrize("error", [OSError, KeyboardInterrupt])
def test_a_rename_cut_short_loses_nothing(store, fail_at, error):
    """With an error all is as before, or renamed; killed, every calibration is still there, the
    list shows the tool under one name at least, and asking again ends it."""
    cut = cut_short(lambda: store.rename("pointer", "probe"), fail_at, error)
    names = {entry.name for entry in store.entries() if entry.stored}
    assert {0.05, 0.06, 0.2} == set(masses(store).values())
    assert {"pointer", "probe"} & names
    if error is OSError and cut:
        assert masses(store) == BEFORE
    if "pointer" in names:
        store.rename("pointer", "probe")
    assert masses(store).items() >= RENAMED.items()
    assert "pointer.json" not in masses(store)


@pytest.mark.parametrize("fail_at", range(1, 6))
@pytest.mark.parametrize("error", [OSError, KeyboardInterrupt])
def test_a_revert_cut_short_loses_nothing(store, fail_at, error):
    """Killed, the tool is still there whole, and every calibration under some name; with an error
    all is as before, or done."""
    cut = cut_short(lambda: store.revert("pointer"), fail_at, error)
    after = masses(store)
    assert {0.05, 0.06, 0.2} == set(after.values())
    assert after["pointer.json"] in (0.05, 0.06)
    if error is OSError:
        assert after == (BEFORE if cut else SWAPPED)
        assert not list(store.directory.glob(".*"))


@pytest.mark.parametrize("change", ["rename", "remove"])
def test_a_calibration_written_at_the_last_moment_is_not_lost(store, monkeypatch, change):
    """Between the last look at the old file and its removal."""
    real = Path.rename

    def calibrate_before(path, target):
        if path.name == "retractor.json" and ".aside." in Path(target).name:
            monkeypatch.undo()
            write_calibration(store.directory / "retractor.json", calibration("retractor", 0.3))
        return real(path, target)

    monkeypatch.setattr(Path, "rename", calibrate_before)
    with pytest.raises(CalibrationStoreError, match="is being written; ask again"):
        store.rename("retractor", "hook") if change == "rename" else store.remove("retractor")
    assert store.read("retractor").tool.load.mass_kg == 0.3
    assert not list(store.directory.glob(".*"))


def test_a_third_file_under_the_name_leaves_the_one_set_aside_as_bak(tmp_path):
    path = tmp_path / "a.json"
    path.write_text("second")

    def no_and_a_third(aside: Path) -> bool:
        path.write_text("third")
        return False

    with pytest.raises(OSError, match="ask again"):
        atomic_file.unlink_if(path, no_and_a_third)
    assert {file.name: file.read_text() for file in tmp_path.iterdir()} == {
        "a.json": "third",
        "a.json.bak": "second",
    }


def test_odd_names_and_texts_can_be_told_in_messages(store):
    """A byte or half a surrogate pair that is no UTF-8 would end a node that sends it."""
    (store.directory / os.fsdecode(b"\xff.json")).touch()
    assert "\\xff" in store.names()
    content = json.loads((store.directory / "pointer.json").read_text())
    for name, odd in (("note", {"note": "\ud800"}), ("frame", {"sensor_frame": "\ud800"})):
        text = json.dumps(content | {"tool": name} | odd, ensure_ascii=False)
        (store.directory / f"{name}.json").write_bytes(text.encode("utf-8", "surrogatepass"))
    with pytest.raises(CalibrationFileError, match="sensor_frame"):
        store.read("frame")
    assert store.read("note").content.encode()
    for entry in store.entries():
        assert (entry.name + entry.problem).encode()


def test_removed_tools_come_back_with_their_backup(store):
    kept = store.remove("pointer")
    assert kept.name == "pointer.json.removed"
    assert store.names() == ["retractor"] and store.removed() == ["pointer"]
    # Removed again under the same name: both are kept, and the last one comes back.
    write_calibration(store.directory / "pointer.json", calibration("pointer", 0.07))
    with pytest.raises(ToolExistsError, match="is there"):
        store.restore("pointer")
    assert store.remove("pointer").name == "pointer.json.removed.2"
    store.restore("pointer")
    assert masses(store) == {
        "pointer.json": 0.07,
        "pointer.json.removed": 0.06,
        "pointer.json.bak.removed": 0.05,
        "retractor.json": 0.2,
    }
    store.remove("pointer")
    (store.directory / "pointer.json.removed.2").unlink()
    store.restore("pointer")
    assert masses(store) == BEFORE
    with pytest.raises(CalibrationFileError, match="no removed tool"):
        store.restore("drill")


def test_reverting_twice_changes_nothing(store):
    before = files(store)
    assert store.has_previous("pointer") and store.previous("pointer").tool.load.mass_kg == 0.05
    reverted = store.revert("pointer")
    assert reverted.tool.load.mass_kg == 0.05 and reverted.path.name == "pointer.json"
    assert masses(store) == SWAPPED
    assert store.previous("pointer").tool.load.mass_kg == 0.06
    store.revert("pointer")
    assert files(store) == before
    store.rename("pointer", "probe")
    assert store.revert("probe").tool.load.mass_kg == 0.05


def test_what_can_not_be_reverted_stays(store, tmp_path):
    for missing in ("retractor", "drill"):
        with pytest.raises(CalibrationFileError) as absent:
            store.revert(missing)
        assert isinstance(absent.value.__cause__, FileNotFoundError)
        assert not store.has_previous(missing)
    with pytest.raises(
        CalibrationFileError, match="no calibration of 'retractor' before its present"
    ):
        store.revert("retractor")
    outside = tmp_path / "outside.json"
    write_calibration(outside, calibration("pointer", 0.04))
    content, backup = outside.read_bytes(), store.directory / "pointer.json.bak"
    for make, words in (
        (lambda: backup.write_text("{"), "not JSON"),
        (lambda: write_calibration(backup, calibration("retractor")), "holds the tool 'retractor'"),
        (lambda: backup.symlink_to(outside), "leads out of"),
        (lambda: backup.symlink_to(backup), "out of|levels of symbolic links"),
        (backup.mkdir, "regular file"),
    ):
        backup.unlink()
        make()
        present = (store.directory / "pointer.json").read_bytes()
        with pytest.raises(CalibrationFileError, match=words):
            store.revert("pointer")
        assert not store.has_previous("pointer")
        assert (store.directory / "pointer.json").read_bytes() == present
    assert outside.read_bytes() == content


def test_a_broken_file_is_reverted_and_links_within_swap_their_names(
    store,
):
    pointer = store.directory / "pointer.json"
    pointer.write_text("{")
    assert store.revert("pointer").tool.load.mass_kg == 0.05
    assert pointer.with_name("pointer.json.bak").read_text() == "{"
    data = store.directory / "..data"
    data.mkdir()
    write_calibration(data / "retractor.json", calibration("retractor", 0.19))
    (store.directory / "retractor.json.bak").symlink_to("..data/retractor.json")
    assert store.revert("retractor").tool.load.mass_kg == 0.19
    assert store.previous("retractor").tool.load.mass_kg == 0.2
    assert read_calibration(data / "retractor.json", arm=GALEN).load.mass_kg == 0.19


def test_a_calibration_written_during_a_revert_is_not_lost(store, monkeypatch):
    """What is active of both names is swapped, whatever was looked at before."""
    real = tool_store.exchange

    def calibrate_before(path, other, spare):
        write_calibration(path, calibration("pointer", 0.07))
        real(path, other, spare)

    monkeypatch.setattr(tool_store, "exchange", calibrate_before)
    assert store.revert("pointer").tool.load.mass_kg == 0.06
    assert store.previous("pointer").tool.load.mass_kg == 0.07


def test_a_broken_file_can_be_removed_and_a_link_never_takes_its_target(store, tmp_path):
    (store.directory / "cut.json").write_text("{")
    assert store.remove("cut").read_text() == "{"
    outside = tmp_path / "outside.json"
    write_calibration(outside, calibration("link"))
    (store.directory / "link.json").symlink_to(outside)
    for rejected in (lambda: store.remove("link"), lambda: store.rename("link", "new")):
        with pytest.raises(CalibrationFileError, match="leads out of"):
            rejected()
    assert read_calibration(outside, arm=GALEN).tool == "link"


def test_without_hard_links_it_works_as_well(store, monkeypatch):
    def no_links(*_args, **_options):
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(atomic_file.os, "link", no_links)
    store.rename("pointer", "probe")
    with pytest.raises(ToolExistsError):
        store.rename("retractor", "probe")
    store.remove("probe")
    store.restore("probe")
    assert masses(store) == RENAMED
    assert store.revert("probe").tool.load.mass_kg == 0.05


def test_what_became_of_a_file_since_it_was_read(store):
    stored = store.read("pointer")
    os.utime(stored.path)  # touched, but not changed
    assert stored.file_state() is FileState.AS_LOADED
    write_calibration(stored.path, replace(stored.tool, load=calibration("pointer", 0.07).load))
    assert stored.file_state() is FileState.CHANGED
    stored.path.unlink()
    assert stored.file_state() is FileState.GONE
