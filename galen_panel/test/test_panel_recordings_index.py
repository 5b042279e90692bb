"""Recordings are found and described from their metadata; nothing leads out of the directory."""

import shutil
from pathlib import Path

import pytest
from galen_panel.recordings.index import Details, RecordingKind, find_recordings, look_at
from galen_panel.recordings.recordings import PAGE_LENGTH, Recordings, tool_choices

BAGS = Path(__file__).resolve().parents[2] / "bags"
METADATA = """rosbag2_bagfile_information:
  version: 5
  storage_identifier: mcap
  duration:
    nanoseconds: {duration}
  starting_time:
    nanoseconds_since_epoch: {start}
  message_count: 7
  topics_with_message_count:
    - topic_metadata:
        name: /wrench_raw
        type: geometry_msgs/msg/WrenchStamped
        serialization_format: cdr
        offered_qos_profiles: ""
      message_count: 7
  relative_file_paths:
    - {name}_0.mcap
"""
MCAP = b"\x89MCAP0\r\n"


def make_bag(folder, start=1_700_000_000_000_000_000, duration=5_000_000_000, content=MCAP):
    folder.mkdir(parents=True)
    (folder / f"{folder.name}_0.mcap").write_bytes(content)
    text = METADATA.format(start=start, duration=duration, name=folder.name)
    (folder / "metadata.yaml").write_text(text)
    return folder


def make_set(folder, names=("sweep", "motion", "push"), tool=True):
    for number, name in enumerate(names):
        make_bag(folder / name, start=1_700_000_000_000_000_000 + number * 10**11)
    if tool:
        shutil.copy(BAGS / "tools" / "pointer.json", folder / "tool.json")
    return folder


@pytest.fixture
def archive(tmp_path):
    folder = tmp_path / "bags"
    folder.mkdir()
    return folder


def described(archive):
    """What the search found and what their metadata says, by name."""
    return {one.name: (one, look_at(one, archive)) for one in find_recordings(archive).recordings}


def test_the_repositorys_bags_are_found_with_what_metadata_says():
    found, details = described(BAGS)["free_motion"]
    assert found.kind is RecordingKind.BAG and found.at_s == pytest.approx(1772449200.0, abs=1.0)
    assert details.duration_s == pytest.approx(32.0, abs=0.01)
    assert details.topics == {"/joint_states": 16000, "/wrench_raw": 16000}
    assert details.size_bytes == (BAGS / "free_motion" / "free_motion.mcap").stat().st_size
    assert (details.problem, details.note) == ("", "")


def test_the_newest_is_first_and_ids_stay_from_search_to_search(archive):
    make_bag(archive / "old", start=10**18)
    make_bag(archive / "new", start=2 * 10**18)
    make_bag(archive / "deep" / "middle", start=15 * 10**17)
    first, again = find_recordings(archive), find_recordings(archive)
    assert [one.name for one in first.recordings] == ["new", "deep/middle", "old"]
    assert first == again
    assert len({one.id for one in first.recordings}) == 3


def test_broken_bags_are_listed_with_the_reason(archive):
    make_bag(archive / "junk", content=b"no bag at all")
    make_bag(archive / "empty", content=b"")
    (make_bag(archive / "lost") / "lost_0.mcap").unlink()
    (make_bag(archive / "cut") / "metadata.yaml").unlink()
    (make_bag(archive / "damaged") / "metadata.yaml").write_text("rosbag2_bagfile_information: [")
    (archive / "alone.mcap").write_bytes(MCAP)
    found = described(archive)
    assert found["junk"][1].problem == "junk_0.mcap is no .mcap file."
    assert found["empty"][1].problem == "empty_0.mcap is empty."
    assert found["lost"][1].problem == "Its files are missing."
    assert found["cut"][1].problem == "" and "was cut off" in found["cut"][1].note
    assert found["damaged"][1].problem == "" and "damaged" in found["damaged"][1].note
    assert found["alone.mcap"][1].problem == "" and "alone" in found["alone.mcap"][1].note


def test_a_diagnosis_recording_is_found_as_one_with_its_bags(archive):
    make_set(archive / "tuesday")
    found, details = described(archive)["tuesday"]
    assert found.kind is RecordingKind.DIAGNOSIS and details.problem == details.note == ""
    assert details.duration_s == pytest.approx(15.0) and details.topics == {"/wrench_raw": 21}
    assert {"tuesday/sweep", "tuesday/motion", "tuesday/push"} < set(described(archive))


def test_what_a_diagnosis_recording_lacks_is_said(archive):
    make_set(archive / "half", names=("sweep", "push"), tool=False)
    _, details = described(archive)["half"]
    assert details.note == "It lacks motion. It has no tool.json."
    make_set(archive / "one", names=("push",), tool=False)
    assert "one" not in described(archive)
    make_set(archive / "meant", names=("push",))
    assert described(archive)["meant"][0].kind is RecordingKind.DIAGNOSIS


def test_a_directory_without_bags_is_no_error(archive):
    index = find_recordings(archive)
    assert index.recordings == () and "no bag" in index.problem
    assert "is not there" in find_recordings(archive / "gone").problem


# Nothing leads out


def test_links_that_lead_out_are_listed_and_not_used(archive, tmp_path):
    outside = make_bag(tmp_path / "outside")
    (archive / "link").symlink_to(outside)
    inner = make_bag(archive / "inner")
    (inner / "inner_0.mcap").unlink()
    (inner / "inner_0.mcap").symlink_to(outside / "outside_0.mcap")
    (archive / "file.mcap").symlink_to(outside / "outside_0.mcap")
    within = make_bag(archive / "within")
    (archive / "again").symlink_to(within)
    found = described(archive)
    for name in ("link", "inner", "file.mcap"):
        assert "leads out" in found[name][1].problem
    # What two names lead to is found once.
    (kept,) = {"within", "again"} & set(found)
    assert found[kept][1].problem == ""


def test_a_diagnosis_recordings_links_out_are_rejected(archive, tmp_path):
    outside = make_bag(tmp_path / "push")
    folder = make_set(archive / "set", names=("sweep", "motion"), tool=False)
    (folder / "push").symlink_to(outside)
    secret = tmp_path / "secret.json"
    secret.write_text("{}")
    (folder / "tool.json").symlink_to(secret)
    found, details = described(archive)["set"]
    assert "leads out" in details.problem
    recordings = Recordings(archive, tmp_path / "none", tmp_path / "out")
    recordings.search()
    assert recordings.tools(found.id) == []
    answer = recordings.start(found.id, "beside")
    assert not answer.ok and "leads out" in answer.text
    assert recordings.jobs.jobs == ()


@pytest.mark.parametrize(
    "name", ["../outside", "/etc/passwd", "free_motion", "", "0", "..", "\x00", "a" * 10_000]
)
def test_a_browsers_word_is_never_a_path(archive, tmp_path, name):
    make_bag(tmp_path / "outside")
    make_bag(archive / "free_motion")
    recordings = Recordings(archive, BAGS / "tools", tmp_path / "out")
    assert not recordings.start(name, "tools:pointer").ok  # before any search
    recordings.search()
    assert recordings.tools(name) == []
    assert not recordings.start(name, "tools:pointer").ok
    (found,) = recordings.search().recordings
    answer = recordings.start(found.id, name)
    assert not answer.ok and "calibration file" in answer.text
    assert recordings.jobs.jobs == () and not (tmp_path / "out").exists()


# The tools


def test_the_tools_to_choose_from(archive, tmp_path):
    make_set(archive / "set")
    make_bag(archive / "plain")
    shutil.copytree(BAGS / "tools", archive / "tools")
    store = tmp_path / "tools"
    store.mkdir()
    shutil.copy(BAGS / "tools" / "pointer.json", store)
    (store / "broken.json").write_text("{")
    by_name = {one.name: one for one in find_recordings(archive).recordings}

    def ids(name):
        return [one.id for one in tool_choices(by_name[name], archive, store)]

    assert ids("plain") == ["tools:pointer", "bags:pointer", "bags:retractor"]
    assert ids("set") == ["beside", *ids("plain")] == ids("set/sweep")
    assert [one.id for one in tool_choices(by_name["plain"], archive, archive / "tools")] == [
        "tools:pointer", "tools:retractor",
    ]  # fmt: skip


def test_a_recording_that_broke_since_the_search_is_rejected(archive, tmp_path):
    bag = make_bag(archive / "run")
    recordings = Recordings(archive, BAGS / "tools", tmp_path / "out")
    (found,) = recordings.search().recordings
    (bag / "run_0.mcap").unlink()
    answer = recordings.start(found.id, "tools:pointer")
    assert not answer.ok and "files are missing" in answer.text


# The list in pages


def test_a_large_archive_is_shown_in_pages_and_only_these_are_read(archive, tmp_path, monkeypatch):
    for number in range(PAGE_LENGTH + 3):
        make_bag(archive / f"run_{number:02d}", start=10**18 + number * 10**9)
    make_set(archive / "tuesday")
    read = []

    def look(recording, directory):
        read.append(recording.name)
        return Details()

    monkeypatch.setattr("galen_panel.recordings.recordings.look_at", look)
    recordings = Recordings(archive, tmp_path, tmp_path / "out")
    first = recordings.page("RUN")
    assert (first.total, first.number, first.pages) == (PAGE_LENGTH + 3, 0, 2)
    assert [one.number for one in first.listed] == list(range(PAGE_LENGTH))
    assert first.listed[0].recording.name == f"run_{PAGE_LENGTH + 2:02d}"
    assert len(read) == PAGE_LENGTH
    second = recordings.page("run", 99)
    assert second.number == 1 and [one.number for one in second.listed] == [15, 16, 17]
    recordings.page("run")
    assert len(read) == PAGE_LENGTH + 3, "what was read is kept"
    assert [one.recording.name for one in recordings.page("diagnosis").listed] == ["tuesday"]
    assert recordings.page("run 07").total == 1
    assert recordings.page("nowhere").listed == ()


def test_another_search_finds_what_is_new_and_reads_again(archive, tmp_path):
    bag = make_bag(archive / "one")
    recordings = Recordings(archive, tmp_path, tmp_path / "out")
    assert recordings.page().total == 1
    make_bag(archive / "two")
    text = (bag / "metadata.yaml").read_text()
    (bag / "metadata.yaml").write_text(text.replace("message_count: 7", "message_count: 9"))
    assert recordings.page().total == 1
    recordings.search(again=True)
    found = {one.recording.name: one.details for one in recordings.page().listed}
    assert set(found) == {"one", "two"} and found["one"].topics == {"/wrench_raw": 9}
