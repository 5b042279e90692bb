# SPDX-License-Identifier: Apache-2.0
"""The collection's parts one by one: plan, push, marker, folder, summary, parameters."""

import json
import math

import numpy as np
import pytest
from collection_fake_arm import TIP, Impatient
from galen_deflection.collection.plan import (
    CollectionParameters,
    ErrorCode,
    Finished,
    OutOfReachError,
    PlanError,
    State,
    WantedPush,
    make_plan,
)
from galen_deflection.collection.watches import MarkerPoses, PushWatch
from galen_deflection.measurement.samples import DeflectionError
from galen_deflection.ros.collection_node import summary
from galen_deflection.ros.recorder import CollectionFolder
from galen_model.arm.galen import GALEN
from galen_model.errors import ToolNameError
from galen_model.files.calibration_file import read_calibration
from push_bag import TOOL

from galen_msgs.action import CollectPushes

HERE = GALEN.home.tolist()
THERE = [0.02, -0.02, 0.42, 0.3, -0.2]


def plan(positions=(*HERE, *THERE), forces=(3.0, 6.0), torques=(0.3,), sets=2):
    asked = CollectionParameters(
        positions=tuple(positions), forces_n=forces, torques_nm=torques, sets=sets
    )
    return make_plan(asked, TIP)


# --- the plan -----------------------------------------------------------------------------------


def test_the_plan_is_every_direction_at_every_level():
    made = plan()
    assert made.positions.shape == (2, 5)
    assert len(made.pushes) == 6 * 2 + 6
    assert made.total == 2 * 2 * 18
    wrenches = {tuple(push.wrench) for push in made.pushes}
    assert len(wrenches) == 18
    assert (0.0, -6.0, 0.0, 0.0, 0.0, 0.0) in wrenches
    assert (0.0, 0.0, 0.0, 0.0, 0.0, 0.3) in wrenches
    assert [str(push) for push in made.pushes[:3]] == [
        "3 N along +x", "6 N along +x", "3 N along -x"
    ]  # fmt: skip
    assert str(made.pushes[-1]) == "0.3 N·m about -z"


@pytest.mark.parametrize(
    ("changes", "kind", "words"),
    [
        ({"positions": [*HERE, 0.2, 0.0, 0.408, 0.0, 0.0]}, OutOfReachError, "position 2: delta_x"),
        ({"positions": [*HERE[:4], math.nan]}, OutOfReachError, "tilt = nan"),
        # In the box, but a carriage would leave its travel.
        (
            {"positions": [*HERE, 0.14, 0.14, 0.6, 0.0, 0.0]},
            OutOfReachError,
            "position 2: carriage",
        ),
        ({"positions": HERE[:4]}, PlanError, "4 numbers"),
        ({"positions": [*HERE, *THERE, *HERE]}, PlanError, "positions 1 and 3 are the same"),
        ({"positions": HERE}, PlanError, "single position"),
        ({"sets": 0}, PlanError, "sets is 0"),
        ({"forces": (), "torques": ()}, PlanError, "both empty"),
        ({"forces": (3.0, -1.0)}, PlanError, "forces_n"),
        ({"forces": (math.inf,)}, PlanError, "forces_n"),
        ({"torques": (0.0,)}, PlanError, "torques_nm"),
        ({"forces": (21.0,)}, PlanError, "21 N along .* more than max_force_n = 20"),
        ({"forces": (16.0,)}, PlanError, "N·m at the sensor"),  # by its lever
    ],
)
def test_what_can_not_be_done_is_rejected_by_name(changes, kind, words):
    with pytest.raises(kind, match=words):
        plan(**changes)


def test_a_single_position_may_have_a_single_set():
    assert plan(positions=HERE, sets=1).total == 18


# --- one push -----------------------------------------------------------------------------------


PUSH_LIMITS = Impatient(hold_s=0.3, rest_s=0.2)


def watched(loads, wanted=None, timeout_s=2.0, period_s=0.02):
    """Show loads (n, 6) one after the other; return the watch and the states it went through."""
    watch = PushWatch(wanted or WantedPush(1, -1, 5.0), PUSH_LIMITS, timeout_s, 0.0)
    states = []
    for k, load in enumerate(loads):
        watch.look(k * period_s, np.asarray(load, float))
        if not states or states[-1] != watch.state:
            states.append(watch.state)
        if watch.outcome is not None:
            break
    return watch, states


def steps(*parts, axis=1, aside=0.0):
    """Loads along an axis: pairs of (value, number of looks)."""
    values = np.concatenate([np.full(count, float(value)) for value, count in parts])
    loads = np.zeros((len(values), 6))
    loads[:, axis] = values
    loads[:, (axis + 1) % 3 + 3 * (axis // 3)] = aside * np.abs(values)
    return loads


def test_a_push_as_asked_that_is_held_anew_where_it_breaks_off():
    watch, states = watched(steps((0, 5), (-3, 5), (-5.5, 5), (-3, 5), (-5.5, 18), (0, 20)))
    assert watch.outcome == ""
    assert states == [*[State.PUSH, State.HOLD] * 2, State.RELEASE, State.REST]


def test_a_torque_beside_a_force_does_not_matter_where_the_hand_takes_hold():
    loads = steps((0, 5), (-5.5, 18), (0, 20))
    loads[:, 4] = 0.1 * (loads[:, 1] < 0.0)
    assert watched(loads)[0].outcome == ""


@pytest.mark.parametrize(
    ("parts", "aside", "words"),
    [
        ([(0, 5), (-3, 120), (0, 20)], 0.0, "no more than 3.00 N in 2 s"),
        ([(0, 5), (5, 120), (0, 20)], 0.0, "no more than 0.00 N"),  # to the wrong side
        ([(0, 5), (-8, 5), (0, 20)], 0.0, "it came to 8.00 N"),
        ([(0, 5), (-5, 120), (0, 20)], 0.4, "2.00 N went aside"),
        ([(0, 5), *[(-5, 10), (-3, 5)] * 8, (0, 20)], 0.0, "not held for 0.3 s"),
        ([(0, 5), (-5, 200)], 0.0, "not let go of for 1 s"),
        ([(-1, 200)], 0.0, "not let go of for 1 s"),  # before it is even asked for
    ],
)
def test_a_push_that_is_not_as_asked_says_why(parts, aside, words):
    watch, _ = watched(steps(*parts, aside=aside))
    assert watch.outcome and words in watch.outcome


# --- markers ------------------------------------------------------------------------------------


def poses(stamps_s, change=1e-9, may_stand=False):
    marker = MarkerPoses(may_stand)
    for k, stamp_s in enumerate(stamps_s):
        marker.add(round(stamp_s * 1e9), np.eye(3), np.array([change * k, 0.0, 0.0]))
    return marker


def test_a_marker_seen_all_the_time():
    assert poses(np.arange(0.0, 1.0, 0.02)).complaint(1.0, 0.1) == ""


@pytest.mark.parametrize(
    ("stamps_s", "words"),
    [
        ([0.0, 0.5], "seen 2 times"),
        ([*np.arange(0.0, 0.4, 0.02), *np.arange(0.7, 1.0, 0.02)], "lost for 0.3"),
        (np.arange(0.0, 0.5, 0.02), "lost for 0.2"),  # and then no more
    ],
)
def test_a_marker_that_was_not(stamps_s, words):
    assert words in poses(stamps_s).complaint(1.0, 0.1)


def test_a_frozen_marker_is_not_seen_unless_it_may_stand():
    stamps_s = np.arange(0.0, 1.0, 0.02)
    assert "seen 1 times" in poses(stamps_s, change=0.0).complaint(1.0, 0.1)
    assert poses(stamps_s, change=0.0, may_stand=True).complaint(1.0, 0.1) == ""


# --- the folder ---------------------------------------------------------------------------------


def test_a_finished_folder_gets_its_name_at_the_end(tmp_path):
    folder = CollectionFolder(tmp_path / "new", "monday")
    assert list(tmp_path.iterdir()) == []
    folder.make(TOOL)
    assert [p.name for p in (tmp_path / "new").iterdir()] == ["monday.unfinished"]
    assert folder.close({"a": 1}, finished=True) == tmp_path / "new" / "monday"
    assert sorted(p.name for p in folder.path.iterdir()) == ["collection.json", "tool.json"]
    assert json.loads((folder.path / "collection.json").read_text()) == {"a": 1}
    assert read_calibration(folder.path / "tool.json", arm=GALEN).tip_m == pytest.approx(TOOL.tip_m)


@pytest.mark.parametrize("name", ["../x", "", "a/b", "/etc/x", "x" * 65, "a b", "x.unfinished"])
def test_a_name_that_must_not_reach_a_path(tmp_path, name):
    with pytest.raises(ToolNameError, match="recording's name"):
        CollectionFolder(tmp_path, name)


def test_what_is_there_is_not_written_over(tmp_path):
    (tmp_path / "monday").symlink_to(tmp_path / "nowhere")
    with pytest.raises(DeflectionError, match="monday: is there already"):
        CollectionFolder(tmp_path, "monday")
    folder = CollectionFolder(tmp_path, "tuesday")
    folder.make(TOOL)
    (tmp_path / "tuesday").mkdir()  # another one was quicker
    with pytest.raises(DeflectionError, match="tuesday: is there already"):
        folder.close({}, finished=True)
    assert (tmp_path / "tuesday.unfinished" / "tool.json").exists()
    (tmp_path / "tuesday").rmdir()  # another try is another folder
    CollectionFolder(tmp_path, "tuesday").make(TOOL)
    assert (tmp_path / "tuesday.unfinished-2" / "tool.json").exists()


def test_a_place_that_can_not_be_written_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    folder = CollectionFolder(tmp_path / "file", "monday")
    with pytest.raises(DeflectionError, match="monday: can't be made"):
        folder.make(TOOL)


# --- summary, parameters ------------------------------------------------------------------------


def test_the_summary_is_json_without_nan():
    left_out = ("set 1, position 2, 6 N along -x: reason",)
    end = Finished(ErrorCode.CANCELED, "canceled", 3, left_out, warnings=("odd",))
    request = CollectPushes.Goal(name="monday", tool="retractor", push_by_service=True)
    content = summary(request, plan(), end, 12)
    read = json.loads(json.dumps(content, allow_nan=False))
    assert read["calibration"] == {"shift": None, "holds": False}
    assert read["error"] == {"code": "CANCELED", "message": "canceled"}
    assert not read["finished"]
    assert (read["pushes"], read["pushes_asked"]) == (3, 72)
    assert read["asked"]["pushes"][0] == [3.0, 0, 0, 0, 0, 0]


def test_the_default_parameters_are_a_collection_like_the_report_s():
    parameters = CollectionParameters()
    parameters.validate()
    made = make_plan(parameters, np.asarray(TOOL.tip_m))
    assert (len(made.positions), made.sets) == (4, 2)  # eight sets
    assert made.total == 8 * 18
