# SPDX-License-Identifier: Apache-2.0
"""State, rates and latency of the compensator, with a clock made up."""

import pytest
from calibration_files import pointer
from galen_common.stream.monitor import HOLD_S, NOTICE_HOLD_S, Severity
from galen_common.stream.samples import Notice, PairedWrench, Rejected, Rejection
from galen_gravcomp.compensator import Compensator
from galen_gravcomp.monitor import Monitor
from galen_gravcomp.parameters import GravcompParameters
from galen_model.arm.galen import GALEN

S = 1_000_000_000
TOOL = pointer()
GOOD = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0)
BAD = (float("nan"), 0.0, 0.0, 0.0, 0.0, 0.0)


class Rig:
    """Compensator and monitor fed as the node feeds them, at a time of our choice."""

    def __init__(self, late_s: float = 0.0) -> None:
        parameters = GravcompParameters(late_s=late_s)
        self.compensator = Compensator(
            parameters, lambda why: self.monitor.on_restart(why, self.t), arm=GALEN
        )
        self.compensator.set_tool(TOOL)
        self.monitor = Monitor(self.compensator)
        self.t = 1000.0

    def wait(self, time_s: float) -> None:
        """Nothing comes for so long."""
        end_s = self.t + time_s
        while self.t < end_s:
            self.t += 0.01
            self.tick()

    def tick(self) -> None:
        self.monitor.tick(self.t)
        for rejected in self.monitor.review(self.t):
            self.monitor.on_rejected(rejected, self.t)

    def publishers(self, topic: str, listed: int, came: int) -> str:
        why = self.monitor.publishers_changed(topic, listed, came, self.t)
        if why:
            self.compensator.pairing.restart(why)
        self.monitor.review(self.t)
        return why

    def step(
        self, wrench: tuple[float, ...] = GOOD, joints: bool = True, roll: float = 0.0
    ) -> bool:
        self.t += 0.01
        stamp = round(self.t * S)
        changed = False
        if joints:
            self.monitor.on_joints(self.t)
            self.compensator.push_joints(stamp, (roll, 0.0))
        self.monitor.on_wrench(self.t)
        for result in self.compensator.push_wrench(stamp, wrench):
            if isinstance(result, PairedWrench):
                changed |= self.monitor.on_output(self.t - 0.001, self.t, result.stamp_ns)
            else:
                assert isinstance(result, Rejected)
                changed |= self.monitor.on_rejected(result, self.t)
        self.tick()
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
    return Rig()


def test_silence(rig: Rig) -> None:
    assert rig.now == (Severity.STALE, "silent")
    assert "no wrench_raw came yet and no joint_states came yet" in rig.message
    rig.step()
    assert rig.now == (Severity.OK, "compensating")
    rig.t += 1.2
    assert rig.now == (Severity.STALE, "silent")
    assert "no wrench_raw for 1.2 s" in rig.message


def test_rejection_with_outputs_warns_and_without_is_an_error(rig: Rig) -> None:
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


def test_late_is_a_state_with_numbers_that_goes_by_itself() -> None:
    rig = Rig(late_s=0.05)
    for _ in range(100):
        rig.step()
    assert rig.now == (Severity.OK, "compensating")
    rig.t += 0.3
    for left in range(30, 0, -1):  # all that queued up, at once
        rig.monitor.on_wrench(rig.t)
        rig.monitor.on_output(rig.t, rig.t, round((rig.t - 0.01 * left + 0.005) * S))
    rig.tick()
    assert rig.now == (Severity.WARN, "late")
    assert "25 so far came late, the worst by 0.3 s: they go out" in rig.message
    for _ in range(round(NOTICE_HOLD_S / 0.01) + 10):
        rig.step()
    assert rig.now == (Severity.OK, "compensating")
    values = rig.monitor.values(rig.t)
    assert values["late"] == 25 and values["late_worst_s"] == pytest.approx(0.296, abs=1e-5)


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
    assert values["rejected_nonfinite_wrench"] == 100
    assert values["received"] == 400 and values["compensated"] == 300
    assert "not finite" in str(values["last_rejection"])


def test_two_publishers_of_the_wrench_are_rejected_by_name(rig: Rig) -> None:
    """Whose is it? What their wrenches are rejected for changes with each; the state must not."""
    rig.publishers("wrench_raw", 1, 1)
    for _ in range(100):
        rig.step()
    assert (
        rig.publishers("wrench_raw", 2, 1) == "driver restarted: a publisher of wrench_raw is new"
    )
    rig.monitor.publishers["wrench_raw"].name(["/left/driver", "/sim_driver"])
    before = rig.compensator.compensated
    for wrench in (GOOD, BAD, GOOD):
        rig.step(wrench)
        assert rig.now == (Severity.ERROR, "several_publishers")
        assert rig.message == (
            "nothing is published: wrench_raw has 2 publishers (/left/driver, /sim_driver):"
            " stop all but one of them"
        )
    assert rig.compensator.compensated == before
    assert rig.compensator.pairing.rejections[Rejection.SEVERAL_PUBLISHERS] == 3
    assert "is gone" in rig.publishers("wrench_raw", 1, 0)
    rig.step()
    assert rig.compensator.compensated == before + 1


def test_another_publisher_of_the_output_is_rejected_by_name(rig: Rig) -> None:
    rig.step()
    rig.monitor.outputs.listed = 2
    rig.monitor.outputs.name(["/gravcomp", "/gravcomp"])
    rig.tick()
    before = rig.compensator.compensated
    rig.step()
    assert rig.now == (Severity.ERROR, "several_publishers")
    assert rig.message == (
        "nothing is published: wrench_compensated has 2 publishers (/gravcomp 2 times):"
        " stop all but one of them"
    )
    assert rig.monitor.values(rig.t)["wrench_compensated_publisher_nodes"] == "/gravcomp 2 times"
    rig.monitor.outputs.listed = 1
    rig.tick()
    rig.step()
    assert rig.compensator.compensated == before + 1


@pytest.mark.parametrize("back_after_s", [0.3, 30.0])
def test_a_killed_driver_that_came_back_is_one(rig: Rig, back_after_s: float) -> None:
    """DDS lists the killed one for some 20 s yet, and its end is no restart of the new one."""
    rig.publishers("wrench_raw", 1, 1)
    for _ in range(200):
        rig.step()
    rig.wait(back_after_s)
    assert "is new" in rig.publishers("wrench_raw", 2, 1)
    for _ in range(2000):
        rig.step()
    assert rig.now == (Severity.OK, "compensating")
    assert rig.publishers("wrench_raw", 1, 0) == ""
    assert "is gone" in rig.publishers("wrench_raw", 0, 0)


def test_a_publisher_thought_dead_that_speaks_again_is_one_too_many(rig: Rig) -> None:
    rig.publishers("wrench_raw", 1, 1)
    for _ in range(200):
        rig.step()
    rig.wait(0.5)
    rig.publishers("wrench_raw", 2, 1)
    for _ in range(50):
        rig.step()
        assert rig.now[1] == "compensating"
    for _ in range(20):  # with the same stamps
        rig.monitor.on_wrench(rig.t)
        rig.compensator.push_wrench(round(rig.t * S), GOOD)
    rig.step()
    assert rig.now == (Severity.ERROR, "several_publishers")


def test_another_publisher_of_joints_is_a_warning(rig: Rig) -> None:
    """A gripper publishes its joints on the same topic."""
    rig.publishers("joint_states", 1, 1)
    rig.step()
    rig.publishers("joint_states", 2, 1)
    rig.step()
    assert rig.now == (Severity.WARN, "several_publishers")
    assert "joint_states has 2 publishers: only one of them may" in rig.message
    rig.t += HOLD_S + 0.1
    rig.step(BAD)
    assert rig.now == (Severity.ERROR, "nonfinite_wrench")  # nothing goes out: that is worse


def test_a_frozen_wrench_is_rejected_while_the_arm_turns(rig: Rig) -> None:
    same = (1.0, 2.0, 3.0, 0.1, 0.2, 0.3)
    for i in range(90):
        rig.step(same, roll=0.01 * i)
    assert rig.now == (Severity.OK, "compensating")
    for i in range(90, 130):
        rig.step(same, roll=0.01 * i)
    assert rig.compensator.pairing.rejections[Rejection.FROZEN] >= 25
    rig.t += HOLD_S
    rig.step(same, roll=1.4)
    assert rig.now == (Severity.ERROR, "frozen_wrench")
    assert "nothing is published: wrench_raw has been the same to the last bit for" in rig.message
    rig.step((1.0, 2.0, 3.0, 0.1, 0.2, 0.3001), roll=1.4)
    done = rig.compensator.compensated
    rig.step((1.0, 2.0, 3.0, 0.1, 0.2, 0.3002), roll=1.4)
    assert rig.compensator.compensated == done + 1


def test_a_jump_of_the_joints_costs_its_own_wrenches_and_is_told(rig: Rig) -> None:
    for i in range(20):
        rig.step(roll=0.8 if i == 10 else 0.01 * i)
    # 10 ms a sample: 80 rad/s is fast, but no jump by the limit of 200
    assert rig.compensator.pairing.notices[Notice.JOINT_JUMP] == 0
    for i in range(20):
        rig.step(roll=0.2 + (2.5 if i == 10 else 0.0))
    assert rig.compensator.pairing.rejections[Rejection.JUMPING_JOINTS] == 2  # there and back
    assert rig.now == (Severity.WARN, "jumping_joints")
    assert "joint_states jumped by 2.50 rad within 10.0 ms" in rig.message
    for _ in range(60):
        rig.step(roll=0.2)
    assert rig.now == (Severity.WARN, "compensating") and "faster than the arm" in rig.message
