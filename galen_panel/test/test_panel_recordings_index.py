# SPDX-License-Identifier: Apache-2.0
"""Recordings are found and described from their metadata; nothing leads out of the directory."""

import shutil
import time
from pathlib import Path

import pytest
from galen_model.arm.galen import GALEN
from galen_panel.recordings.recordings import (
    Recordings,
    find_recordings,
    line_of,
    look_at,
    tool_choices,
)

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


def make_set(folder, names=("sweep", "motion", "push"), tool=True, start=17 * 10**17):
    for number, name in enumerate(names):
        make_bag(folder / name, start=start + number * 10**11)
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
    return {one.name: (one, look_at(one, archive)) for one in find_recordings(archive)[0]}


def test_a_bag_without_messages_is_not_dated_by_its_metadata(tmp_path):
    make_bag(tmp_path / "empty", start=2**63 - 1, duration=0)
    found, _ = described(tmp_path)["empty"]
    assert abs(found.at_s - time.time()) < 3600.0


def test_the_repositorys_bags_are_found_with_what_metadata_says():
    found, details = described(BAGS)["free_motion"]
    assert found.kind == "bag" and found.at_s == pytest.approx(1772449200.0, abs=1.0)
    assert details.duration_s == pytest.approx(32.0, abs=0.01)
    assert details.size_bytes == (BAGS / "free_motion" / "free_motion.mcap").stat().st_size
    assert details.problem == ""
    assert "2026-03-02" in line_of(found, details) and "32 s" in line_of(found, details)


def test_the_newest_is_first_and_ids_stay_from_search_to_search(archive):
    make_bag(archive / "old", start=10**18)
    make_bag(archive / "new", start=2 * 10**18)
    make_bag(archive / "deep" / "middle", start=15 * 10**17)
    (first, _), (again, _) = find_recordings(archive), find_recordings(archive)
    assert [one.name for one in first] == ["new", "deep/middle", "old"]
    assert first == again
    assert len({one.id for one in first}) == 3


def test_broken_bags_are_listed_and_one_without_files_with_the_reason(archive):
    (make_bag(archive / "lost") / "lost_0.mcap").unlink()
    (make_bag(archive / "cut") / "metadata.yaml").unlink()
    (make_bag(archive / "damaged") / "metadata.yaml").write_text("rosbag2_bagfile_information: [")
    (archive / "alone.mcap").write_bytes(MCAP)
    found = described(archive)
    assert found["lost"][1].problem == "Its files are missing."
    for name in ("cut", "damaged", "alone.mcap"):
        assert found[name][1].problem == "" and found[name][1].duration_s is None


def test_a_diagnosis_recording_is_found_as_one_with_its_bags(archive):
    make_set(archive / "tuesday")
    make_set(archive / "one", names=("push",), tool=False)
    make_set(archive / "meant", names=("push",))
    found = described(archive)
    tuesday, details = found["tuesday"]
    assert tuesday.kind == "diagnosis recording" and details.problem == ""
    assert details.duration_s == pytest.approx(15.0)
    assert {"tuesday/sweep", "tuesday/motion", "tuesday/push", "meant"} < set(found)
    assert "one" not in found


def test_a_directory_without_bags_is_no_error(archive):
    found, problem = find_recordings(archive)
    assert found == [] and "no bag" in problem
    assert "is not there" in find_recordings(archive / "gone")[1]


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


@pytest.mark.parametrize("linked", ["push", "tool.json", "arm.urdf", "specification.json"])
def test_nothing_that_a_diagnosis_reads_leads_out(archive, tmp_path, linked):
    folder = make_set(archive / "set", names=("sweep", "motion"), tool=False)
    outside = make_bag(tmp_path / "outside")
    (folder / linked).symlink_to(outside if linked == "push" else outside / "metadata.yaml")
    found, details = described(archive)["set"]
    assert linked in details.problem and "is a link that leads out" in details.problem
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
    (found,) = recordings.search()
    answer = recordings.start(found.id, name)
    assert not answer.ok and "calibration file" in answer.text
    assert recordings.jobs.jobs == () and not (tmp_path / "out").exists()


def test_a_diagnosis_is_compared_with_what_was_offered_alone(archive, tmp_path):
    for number, name in enumerate(("monday", "tuesday", "wednesday")):
        make_set(archive / name, start=(15 + number) * 10**17)
    recordings = Recordings(archive, BAGS / "tools", tmp_path / "out", specification=["lab.json"])
    taken = []
    recordings.jobs.submit = taken.append
    ids = {one.name: one.id for one in recordings.search()}
    here = ids["wednesday"]
    assert [one.name for one in recordings.references(here)] == ["tuesday", "monday"]
    assert {"lab.json", "ur5e_calibrated", "ati_axia80"} <= set(recordings.specifications())

    recordings.start(here, "beside", ["ati_axia80", "lab.json"], [ids["tuesday"], ids["monday"]])
    (wanted,) = taken
    assert wanted.specification == ("ati_axia80", "lab.json")
    assert wanted.reference == (archive / "monday", archive / "tuesday")  # by time

    for name in ("../lab.json", "/etc/passwd", "", "ur5e.json"):
        answer = recordings.start(here, "beside", [name], [])
        assert not answer.ok and "specification" in answer.text
    for name in (here, ids["monday/sweep"], "monday", str(archive / "monday"), ""):
        answer = recordings.start(here, "beside", [], [ids["tuesday"], name])
        assert not answer.ok and "compare with" in answer.text
    (archive / "monday" / "sweep" / "sweep_0.mcap").unlink()
    answer = recordings.start(here, "beside", [], [ids["monday"]])
    assert not answer.ok and "monday can't be used. sweep: Its files are missing." in answer.text
    assert taken == [wanted]


# The tools


def test_the_tools_to_choose_from(archive, tmp_path):
    make_set(archive / "set")
    make_bag(archive / "plain")
    shutil.copytree(BAGS / "tools", archive / "tools")
    store = tmp_path / "tools"
    store.mkdir()
    shutil.copy(BAGS / "tools" / "pointer.json", store)
    (store / "broken.json").write_text("{")
    by_name = {one.name: one for one in find_recordings(archive)[0]}

    def ids(name):
        return [one.id for one in tool_choices(by_name[name], archive, store, arm=GALEN)]

    assert ids("plain") == ["tools:pointer", "bags:pointer", "bags:retractor"]
    assert ids("set") == ["beside", *ids("plain")] == ids("set/sweep")
    other = tool_choices(by_name["plain"], archive, archive / "tools", arm=GALEN)
    assert [one.id for one in other] == ["tools:pointer", "tools:retractor"]


# The list


def test_a_name_is_found_by_its_words_and_details_are_read_once_until_the_next_search(
    archive, tmp_path
):
    bag = make_bag(archive / "run_07")
    make_bag(archive / "run_08", start=10**18)
    make_set(archive / "tuesday")
    recordings = Recordings(archive, tmp_path, tmp_path / "out")
    assert [one.name for one in recordings.matching("RUN")] == ["run_07", "run_08"]
    assert [one.name for one in recordings.matching("diagnosis")] == ["tuesday"]
    (found,) = recordings.matching("run 07")
    assert recordings.matching("nowhere") == []
    before = recordings.details(found)
    make_bag(archive / "two")
    (bag / "metadata.yaml").write_text(METADATA.format(start=10**18, duration=10**9, name="run_07"))
    assert recordings.details(found) == before and recordings.matching("two") == []
    recordings.search(again=True)
    (found,) = recordings.matching("run 07")
    assert recordings.details(found).duration_s == 1.0 and len(recordings.matching("two")) == 1
