# SPDX-License-Identifier: Apache-2.0
"""What the page writes: numbers, times, hints, poses, outcomes. No page is needed."""

import math
from dataclasses import replace

import pytest
from fake_suite import ACTIVE, ALL, POINTER, RETRACTOR
from galen_model.arm.galen import GALEN
from galen_panel.messages import programs, texts
from galen_panel.page.layout import count
from galen_panel.page.outcome import ACTIVE as KEPT
from galen_panel.page.outcome import HERE, REPLACED, fate, left_out, sentence_of, title_and_level
from galen_panel.state.shapes import draw
from galen_panel.state.snapshot import (
    Behaviour,
    BehaviourKind,
    BehaviourOutcome,
    NodeLevel,
    NodeReport,
    SuiteState,
)

NAN = math.nan


@pytest.mark.parametrize(
    ("written", "text"),
    [
        (texts.mass(0.0601, 3e-5), "60.10 ± 0.03 g"),
        (texts.mass(0.0601, 1.4e-5), "60.100 ± 0.014 g"),
        (texts.mass(0.2, 4e-3), "200 ± 4 g"),
        *((texts.mass(0.2, std_kg), "200.00 g") for std_kg in (NAN, 0.0, math.inf)),
        (texts.mass(NAN, 1e-5), "–"),
        (texts.size(0.0031, 5e-5), "3.1 mN, 0.050 mN·m"),
        (texts.size(0.0, 0.0), "0 mN, 0 mN·m"),
        (texts.size(12.34, 0.5), "12 N, 500 mN·m"),
        (texts.size(NAN, 0.1), "unknown"),
        (texts.quantity(-1e-9, "m"), "0.00 mm"),
        (texts.quantity(NAN, "N.m"), "–"),
        (texts.change(-1e-9, "m"), "0.00 mm"),
        (texts.change(-0.003, "N"), "-3.0 mN"),
        (texts.sigmas(4e-4, 1e-4), "4.0 σ"),
        (texts.sigmas(4e-4, NAN), "–"),
        (texts.quantity_name("com_x"), "centre x"),
        (texts.quantity_name("adapter_com_z"), "adapter's centre z"),
        (texts.date("2026-11-21T14:03:11.123456+00:00"), "2026-11-21 14:03 UTC"),
        (texts.date("2026-11-21T14:03:11+01:00"), "2026-11-21 14:03 +0100"),
        (texts.date("yesterday"), "yesterday"),
        (texts.duration(0.0), "5 s"),
        (texts.duration(130.0), "2 min"),
        (texts.duration(4200.0), "1 h 10 min"),
        (texts.sentence("going home"), "Going home."),
        (texts.sentence("done!"), "Done!"),
        (texts.sentence("pointer is calibrated", "pointer"), "pointer is calibrated."),
        (texts.sentence("joint_states stopped"), "joint_states stopped."),
        (texts.sentence(""), ""),
    ],
)
def test_numbers_and_times_are_written_as_a_person_reads_them(written, text):
    assert written == text


def test_each_service_that_the_page_calls_has_a_program_that_offers_it():
    nothing = SuiteState()
    for name in ALL:
        assert "Start it: ros2 run" in programs.missing(nothing, name)
        assert programs.missing(SuiteState(available=ALL), name) == ""


def test_nothing_is_started_while_something_moves_the_arm():
    running = Behaviour(1, BehaviourKind.COLLECT, "pointer")
    state = SuiteState(available=ALL, behaviours={BehaviourKind.COLLECT: running})
    reason = programs.cannot_start(state, BehaviourKind.CHECK)
    assert "Collection of pushes with pointer is under way" in reason
    ended = replace(running, outcome=BehaviourOutcome("", "done"))
    state = replace(state, behaviours={BehaviourKind.COLLECT: ended})
    assert programs.cannot_start(state, BehaviourKind.CHECK) == ""


def test_before_a_calibration_its_duration_is_told_where_its_node_tells_it():
    def told(values, arm=GALEN, **options):
        node = NodeReport("left/calibration", NodeLevel.OK, "ready", values, 0.0)
        state = SuiteState(nodes={node.name: node}, namespace="left", drawing=draw(arm))
        chosen = {"one_sweep": False, "by_hand": False} | options
        return " ".join(programs.before_calibration(state, **chosen))

    assert "about 3 min" in told({"sweep_s": "102"})
    assert "about 50 s" in told({"sweep_s": "49.5"}, one_sweep=True)
    serial = replace(GALEN, delta=None, urdf="")
    assert "goes through its poses" in told({})
    assert "goes through poses around the one that it has now" in told({}, serial)
    for odd in ({}, {"sweep_s": "soon"}, {"sweep_s": "nan"}):
        assert "does not tell how long" in told(odd)


def test_a_count_says_what_is_counted():
    behaviour = Behaviour(1, BehaviourKind.COLLECT, "pointer", done=3, total=48)
    assert count(behaviour) == "3 of 48 pushes"
    assert count(replace(behaviour, kind=BehaviourKind.CHECK)) == "3 of 48 poses"
    assert count(replace(behaviour, total=0)) == ""


VALUES = {"mass_kg": 0.2, "mass_std_kg": 3e-5, "com_m": [0.07, -0.01, 0.055]}
WRITTEN = BehaviourOutcome("", "done", "retractor", values=VALUES)


def test_a_calibrations_file_is_known_by_what_is_in_it():
    state = SuiteState(tools=(POINTER, RETRACTOR), active_tool=ACTIVE)
    assert fate(WRITTEN, state) == HERE
    other = replace(RETRACTOR, mass_kg=0.2 + 1e-6)
    assert fate(WRITTEN, replace(state, tools=(other,))) == REPLACED
    assert fate(WRITTEN, replace(state, tools=None)) == REPLACED
    broken = replace(RETRACTOR, problem="cut off")
    assert fate(WRITTEN, replace(state, tools=(broken,))) == REPLACED
    old = replace(ACTIVE, tool="retractor", mass_kg=0.1999, com_m=RETRACTOR.com_m)
    assert fate(WRITTEN, replace(state, active_tool=old)) == HERE
    new = replace(old, mass_kg=0.2)
    assert fate(WRITTEN, replace(state, active_tool=new)) == KEPT


def test_a_checks_sentence_has_no_command_for_a_terminal():
    outcome = BehaviourOutcome(
        "", "a constant offset; a tare takes it off: ros2 service call /gravcomp/tare"
        " std_srvs/srv/Trigger",
    )  # fmt: skip
    assert sentence_of(outcome) == "A constant offset; a tare takes it off."


@pytest.mark.parametrize(
    ("error", "title", "level"),
    [
        ("", "Calibrated", "positive"),
        ("CANCELED", "Canceled", "warning"),
        ("LOST", "Lost", "negative"),
        ("DRIVER_SILENT", "It failed", "negative"),
    ],
)
def test_every_end_has_a_title(error, title, level):
    outcome = BehaviourOutcome(error, "x", values={"left_out": ["set 1"]})
    assert title_and_level(BehaviourKind.CALIBRATE, outcome) == (title, level)
    assert left_out(outcome) == ["set 1"]
