from dataclasses import replace

import pytest
from fake_suite import IN_FORCE
from galen_panel.messages.silence import COMPENSATED, DEFLECTION, JOINTS, RAW, Heard, tell
from galen_panel.state.snapshot import State

ALL = frozenset({RAW, COMPENSATED, DEFLECTION, JOINTS})


@pytest.mark.parametrize(
    ("silent", "active_tool", "words"),
    [
        (ALL, IN_FORCE, "driver"),
        ({COMPENSATED, DEFLECTION}, replace(IN_FORCE, enabled=False), "compensation is off"),
        ({COMPENSATED}, replace(IN_FORCE, tool="", enabled=False), "no tool is active"),
        ({COMPENSATED}, None, "gravcomp_node is not running"),
        ({COMPENSATED, JOINTS}, IN_FORCE, "no joint_states come"),
        ({COMPENSATED}, IN_FORCE, "Nodes says why"),
        ({DEFLECTION}, IN_FORCE, "ros2 run galen_deflection deflection_node"),
        ({JOINTS}, IN_FORCE, "No joint_states"),
    ],
)
def test_it_says_what_is_missing_and_what_to_do(silent, active_tool, words):
    assert words in tell(frozenset(silent), State(active_tool=active_tool))


def test_nothing_is_said_where_all_come():
    assert tell(frozenset(), State(active_tool=IN_FORCE)) == ""


def test_a_stream_is_silent_when_its_stamp_stands_still_whatever_the_clock_says():
    heard = Heard()
    for step in range(30):
        heard.look({RAW: 5_000_000_000 - step, COMPENSATED: 7, DEFLECTION: None}, step * 0.2)
    assert heard.silent(5.9) == {COMPENSATED, DEFLECTION}
    heard.forget(5.9)
    assert heard.silent(6.0) == frozenset()
    assert heard.silent(7.0) == {RAW, COMPENSATED, DEFLECTION}
