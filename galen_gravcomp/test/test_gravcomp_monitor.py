"""State, rates and latency of the compensator, with a clock made up."""

import numpy as np
import pytest
from galen_gravcomp.compensator import Compensator
from galen_gravcomp.monitor import Monitor
from galen_gravcomp.results import Compensated, Refused
from galen_gravcomp.stream_monitor import HOLD_S, NOTICE_HOLD_S, Severity
from galen_model.tool_file import LoadEstimate, ToolFile

S = 1_000_000_000
TOOL = ToolFile(
    tool="pointer",
    load=LoadEstimate(0.06, np.array([0.055, 0.002, 0.045]), np.eye(4)),
    bias=LoadEstimate(0.1, np.array([0.0, 0.0, 0.02]), np.eye(4)),
    tip_m=np.array([0.15, 0.0, 0.05]),
    rmse=np.zeros(6),
    poses_used=56,
    calibrated_at="2026-01-01T00:00:00+00:00",
)
GOOD = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0)
BAD = (float("nan"), 0.0, 0.0, 0.0, 0.0, 0.0)


class Rig:
    """Compensator and monitor fed as the node feeds them, at a time of our choice."""

    def __init__(self) -> None:
        self.compensator = Compensator(on_restart=lambda why: self.monitor.on_restart(why, self.t))
        self.monitor = Monitor(self.compensator, silence_s=1.0)
        self.t = 1000.0

    def step(self, wrench: tuple[float, ...] = GOOD, joints: bool = True) -> bool:
        self.t += 0.01
        stamp = round(self.t * S)
        changed = False
        if joints:
            self.monitor.on_joints(self.t)
            self.compensator.push_joints(stamp, 0.0, 0.0)
        self.monitor.on_wrench(self.t)
        for result in self.compensator.push_wrench(stamp, wrench):
            if isinstance(result, Compensated):
                changed |= self.monitor.on_output(self.t - 0.001, self.t)
            else:
                assert isinstance(result, Refused)
                changed |= self.monitor.on_refused(result, self.t)
        self.monitor.tick(self.t)
        return changed

    @property
    def now(self) -> tuple[Severity, str]:
        state = self.monitor.state(self.t)
        return state.severity, state.name

    @property
    def message(self) -> str:
        return self.monitor.state(self.t).message


@pytest.fixture
def rig() -> Rig:
    rig = Rig()
    rig.compensator.set_tool(TOOL)
    return rig


def test_no_tool_and_bad_file_come_first() -> None:
    rig = Rig()
    assert rig.now == (Severity.WARN, "no_tool")
    rig.monitor.set_tool_error("tools/pointer.json: not JSON")
    assert rig.now == (Severity.ERROR, "bad_tool_file")
    assert "tools/pointer.json" in rig.message


def test_silence(rig: Rig) -> None:
    assert rig.now == (Severity.STALE, "silent")
    assert "no wrench_raw came yet and no joint_states came yet" in rig.message
    rig.step()
    assert rig.now == (Severity.OK, "compensating")
    rig.t += 1.2
    assert rig.now == (Severity.STALE, "silent")
    assert "no wrench_raw for 1.2 s" in rig.message


def test_refusal_with_outputs_warns_and_without_is_an_error(rig: Rig) -> None:
    rig.step()
    assert rig.step(BAD)
    assert rig.now == (Severity.WARN, "nonfinite_wrench")
    for _ in range(60):
        rig.step(BAD)
    assert rig.now == (Severity.ERROR, "nonfinite_wrench")
    assert "not finite" in rig.message
    assert not rig.step(BAD)  # same reason: nothing new to tell
    assert rig.step(GOOD)
    assert rig.now == (Severity.WARN, "nonfinite_wrench")
    rig.t += HOLD_S + 0.01
    rig.step()
    assert rig.now == (Severity.OK, "compensating")


def test_disabled(rig: Rig) -> None:
    rig.step()
    rig.compensator.set_enabled(False)
    rig.step()
    assert rig.now == (Severity.WARN, "disabled")
    rig.compensator.set_enabled(True)
    rig.step()
    assert rig.now == (Severity.OK, "compensating")


def test_restart_is_told_for_a_while(rig: Rig) -> None:
    rig.step()
    rig.compensator.restart("driver restarted: test")
    assert rig.now == (Severity.STALE, "waiting")
    rig.step()
    assert rig.now == (Severity.WARN, "compensating") and "driver restarted" in rig.message
    for _ in range(int(NOTICE_HOLD_S / 0.01) + 1):
        rig.step()
    assert rig.now == (Severity.OK, "compensating")
    assert rig.monitor.values(rig.t)["last_restart"] == "driver restarted: test"


def test_suspicious_units_warn(rig: Rig) -> None:
    rig.step((0.0, 0.0, 0.0, 90.0, 0.0, 0.0))
    assert rig.now == (Severity.WARN, "compensating") and "N.mm" in rig.message


def test_values(rig: Rig) -> None:
    for i in range(400):
        rig.step(GOOD if i % 4 else BAD)
    values = rig.monitor.values(rig.t)
    assert values["tool"] == "pointer" and values["mass_kg"] == 0.06
    assert values["com_m"] == "0.055 0.002 0.045"
    assert values["tip_m"] == "0.15 0 0.05"
    assert values["wrench_raw_hz"] == pytest.approx(100.0, rel=1e-6)
    assert values["joint_states_hz"] == pytest.approx(100.0, rel=1e-6)
    assert values["wrench_compensated_hz"] == pytest.approx(75.0, rel=0.01)
    assert values["latency_median_ms"] == pytest.approx(1.0, abs=1e-6)
    assert values["latency_p99_ms"] == pytest.approx(1.0, abs=1e-6)
    assert values["refused_nonfinite_wrench"] == 100
    assert values["received"] == 400 and values["compensated"] == 300
    assert "not finite" in str(values["last_refusal"])


def test_two_publishers_are_one_state(rig: Rig) -> None:
    """What their wrenches are refused for changes with each of them; the state must not."""
    rig.step()
    rig.monitor.set_publishers({"wrench_raw": 2, "joint_states": 1})
    for wrench in (GOOD, BAD, GOOD):
        rig.step(wrench)
        assert rig.now == (Severity.WARN, "several_publishers")
        assert rig.message.startswith("wrench_raw has 2 publishers: stop all but one")
    rig.t += HOLD_S + 0.1
    rig.step(BAD)
    assert rig.now == (Severity.ERROR, "nonfinite_wrench")  # nothing goes out: that is worse
    rig.step(GOOD)
    rig.monitor.set_publishers({"wrench_raw": 1, "joint_states": 1})
    assert rig.now == (Severity.WARN, "nonfinite_wrench")
