from dataclasses import replace

import pytest
from fake_suite import ACTIVE
from galen_panel.messages.silence import COMPENSATED, DEFLECTION, JOINTS, RAW, Heard, tell
from galen_panel.snapshot import SuiteState

ALL = frozenset({RAW, COMPENSATED, DEFLECTION, JOINTS})


@pytest.mark.parametrize(
    ("silent", "active_tool", "words"),
    [
        (ALL, ACTIVE, "driver"),
        ({COMPENSATED, DEFLECTION}, replace(ACTIVE, enabled=False), "compensation is off"),
        ({COMPENSATED}, replace(ACTIVE, tool="", enabled=False), "no tool is active"),
        ({COMPENSATED}, None, "gravcomp_node is not running"),
        ({COMPENSATED, JOINTS}, ACTIVE, "no joint_states come"),
        ({COMPENSATED}, ACTIVE, "Nodes says why"),
        ({DEFLECTION}, ACTIVE, "ros2 run galen_deflection deflection_node"),
        ({JOINTS}, ACTIVE, "No joint_states"),
    ],
)
def test_it_says_what_is_missing_and_what_to_do(silent, active_tool, words):
    assert words in tell(frozenset(silent), SuiteState(active_tool=active_tool))


def test_nothing_is_said_where_all_come():
    assert tell(frozenset(), SuiteState(active_tool=ACTIVE)) == ""


def test_a_stream_is_silent_when_its_stamp_stands_still_whatever_the_clock_says():
    heard = Heard()
    for step in range(30):
        heard.look({RAW: 5_000_000_000 - step, COMPENSATED: 7, DEFLECTION: None}, step * 0.2)
    assert heard.silent(5.9) == {COMPENSATED, DEFLECTION}
    heard.forget(5.9)
    assert heard.silent(6.0) == frozenset()
    assert heard.silent(7.0) == {RAW, COMPENSATED, DEFLECTION}
