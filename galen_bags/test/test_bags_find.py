# SPDX-License-Identifier: Apache-2.0
import os

import pytest
from galen_bags.formats.errors import BagError
from galen_bags.formats.files import find_bags

METADATA = "rosbag2_bagfile_information:\n  version: 9\n"


def make(folder, *names):
    for name in names:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(METADATA if path.name == "metadata.yaml" else "")


def found(folder, *arguments):
    return [str(path.relative_to(folder)) for path in find_bags(arguments or [folder])]


FILES = ["a.mcap", "b.db3", "c.mcap.zstd", "d.db3.zstd"]


@pytest.mark.parametrize(
    ("names", "bags"),
    [
        # a directory of rosbag2
        (["run/metadata.yaml", "run/a_0.mcap", "run/a_1.mcap", "run/deeper/x.db3"], ["run"]),
        # recordings without metadata, whose files have their names
        (
            ["run/run_0.mcap", "run/run_1.mcap", "one/one.db3", "packed/packed_0.db3.zstd"],
            ["one", "packed", "run"],
        ),
        # a folder of files is none
        (
            ["monday/a.mcap", "monday/monday_0.mcap", "monday/b.db3"],
            ["monday/a.mcap", "monday/b.db3", "monday/monday_0.mcap"],
        ),
        # files of every kind, and nothing else
        ([*FILES, "notes.txt", "f.csv.zstd", "tool.json", "g.bag"], FILES),
    ],
)
def test_what_is_one_bag(tmp_path, names, bags):
    make(tmp_path, *names)
    assert found(tmp_path) == bags
    assert find_bags([tmp_path / bags[0]]) == [tmp_path / bags[0]]


def test_a_metadata_file_of_something_else_makes_no_bag_of_its_folder(tmp_path):
    make(tmp_path, "day/run/run.mcap")
    (tmp_path / "day" / "metadata.yaml").write_text("owner: lab\n")
    assert found(tmp_path) == ["day/run"]


def test_hidden_entries_are_left_out_unless_named(tmp_path):
    make(tmp_path, ".new.1/new/new.mcap", ".half.mcap", "a.mcap")
    assert found(tmp_path) == ["a.mcap"]
    hidden = tmp_path / ".new.1"
    assert find_bags([hidden]) == [hidden / "new"]


def test_each_bag_comes_once_whatever_leads_to_it(tmp_path):
    make(tmp_path, "b/b.mcap", "a/metadata.yaml", "a/a.mcap", "c.db3")
    (tmp_path / "again").symlink_to(tmp_path / "b")
    (tmp_path / "d.db3").symlink_to(tmp_path / "c.db3")
    arguments = [tmp_path / "c.db3", tmp_path, tmp_path / "a", os.path.relpath(tmp_path / "c.db3")]
    assert find_bags(arguments) == [tmp_path / name for name in ("a", "again", "c.db3")]


def test_links_that_go_round_end(tmp_path):
    make(tmp_path, "x/a.mcap")
    (tmp_path / "x" / "up").symlink_to(tmp_path)
    (tmp_path / "x" / "self").symlink_to(tmp_path / "x" / "self")
    (tmp_path / "x" / "gone.db3").symlink_to(tmp_path / "nowhere.db3")
    assert found(tmp_path) == ["x/a.mcap"]


@pytest.mark.parametrize(
    ("name", "reason"),
    [("gone", "is not there"), ("empty", "no bag in it"), ("notes.txt", "is no bag")],
)
def test_a_path_without_a_bag_is_rejected_by_name(tmp_path, name, reason):
    make(tmp_path, "a.mcap", "notes.txt")
    (tmp_path / "empty").mkdir()
    with pytest.raises(BagError, match=f"{name}: {reason}"):
        find_bags([tmp_path / "a.mcap", tmp_path / name])


def test_a_folder_that_may_not_be_read_is_named(tmp_path, monkeypatch):
    make(tmp_path, "a.mcap", "secret/b.mcap")
    listing = os.listdir

    def reject(path):
        # Root may read everything, so the rejection is played.
        if str(path).endswith("secret"):
            raise PermissionError(13, "Permission denied", str(path))
        return listing(path)

    monkeypatch.setattr(os, "listdir", reject)
    with pytest.raises(BagError, match=r"secret: can't be read: Permission denied"):
        find_bags([tmp_path])
