# SPDX-License-Identifier: Apache-2.0
"""The collection's course against a pure arm and hand: every way through it, and out of it."""

import dataclasses

import numpy as np
import pytest
from collection_fake_arm import TIP, FakeArm, Hand, Impatient
from galen_common.goal.procedure import MoveTo, Stop
from galen_deflection.collection.plan import (
    ErrorCode,
    Feedback,
    Finished,
    Push,
    Record,
    State,
    make_plan,
)
from galen_deflection.collection.procedure import CollectionProcedure
from galen_model.arm.galen import GALEN
from galen_model.registration import IDENTITY
from push_bag import BASE_IN_TRACKER

SETTINGS = Impatient(
    settle_s=0.1,
    max_delta_velocity_m_s=0.5,
    max_angle_velocity_rad_s=5.0,
    max_delta_acceleration_m_s2=5.0,
    max_angle_acceleration_rad_s2=50.0,
    motion_timeout_s=2.0,
    untouched_s=1.0,
    untouched_timeout_s=4.0,
    hold_s=0.3,
    rest_s=0.2,
    push_timeout_s=1.2,
    max_torque_nm=4.0,
    service_timeout_s=5.0,
)
POSITIONS = [[0.0, 0.0, 0.408, 0.0, 0.0], [0.02, -0.02, 0.42, 0.3, -0.2]]


class World:
    """An arm, a hand, a recorder and a procedure; `run` until it ends or `until` holds."""

    def __init__(
        self, settings=SETTINGS, *, torques=(), sets=1, by_service=False, only=2, places=2
    ):
        """`only` so many of the pushes, to be quick."""
        self.arm, self.hand = FakeArm(), Hand()
        flat = tuple(value for joints in POSITIONS[:places] for value in joints)
        asked = {"positions": flat, "forces_n": (6.0,), "torques_nm": torques, "sets": sets}
        plan = make_plan(dataclasses.replace(settings, **asked), TIP)
        plan = dataclasses.replace(plan, pushes=plan.pushes[:only])
        self.procedure = CollectionProcedure(settings, plan, TIP, by_service)
        self.by_service = by_service
        self.commands = []
        self.dead = set()  # topics or answers that don't come any more
        self.wrench_offset_ns = 0
        self.wall_s = 0.0
        self.on_feedback = lambda feedback: None
        self.tamper = lambda *sample: sample  # with what the arm's step returns
        self._steps = 0
        self._served = None  # (start step, Push)
        self.procedure.start()

    @property
    def end(self):
        return next((c for c in self.commands if isinstance(c, Finished)), None)

    def of(self, kind):
        return [c for c in self.commands if isinstance(c, kind)]

    @property
    def messages(self):
        return [f.message for f in self.of(Feedback)]

    def run(self, until=lambda world: False, limit_s=300.0):
        for _ in range(round(limit_s / 0.01)):
            self._obey()
            if self.end or until(self):
                return self
            self._steps += 1
            self.arm.load = (
                self._served_load() if self.by_service else self.hand.step(self.arm.load)
            )
            stamp, position, velocity, wrench, tool, base = self.tamper(*self.arm.step())
            procedure = self.procedure
            if "joint_states" not in self.dead:
                procedure.on_joints(stamp, position, velocity)
            if "wrench_compensated" not in self.dead:
                procedure.on_wrench(stamp + self.wrench_offset_ns, wrench)
            if tool is not None:
                procedure.on_tool_marker(stamp, tool.rotation, tool.translation)
            if base is not None:
                procedure.on_base_marker(stamp, base.rotation, base.translation)
            self.wall_s += 0.01
            if self._steps % 10 == 0:
                procedure.on_wall(self.wall_s)
        raise AssertionError(f"no end in {limit_s} s, in state {self.procedure.state.name}")

    def _obey(self):
        while commands := self.procedure.take_commands():
            self.commands += commands
            for command in commands:
                match command:
                    case Feedback():
                        self.hand.hear(command)
                        self.on_feedback(command)
                    case MoveTo():
                        self.arm.move_to(command.joints, command.duration_s)
                    case Stop():
                        self.arm.stop()
                    case Record() if "recording" not in self.dead:
                        self.procedure.on_recording()
                    case Push() if "push_tool" not in self.dead:
                        self._served = (self._steps, command)
                        self.procedure.on_service(True, "")

    def _served_load(self):
        if self._served is None:
            return np.zeros(6)
        start, push = self._served
        since = (self._steps - start) * 0.01
        left = push.rise_s + push.hold_s + push.fall_s - since
        return push.wrench * np.clip(min(since / push.rise_s, left / push.fall_s), 0.0, 1.0)


def ended(world, code, *words):
    assert world.end is not None
    assert world.end.error_code == code, world.end
    assert all(word in world.end.error_msg for word in words), world.end.error_msg
    return world.end


def failed(world, code, *words):
    found = ended(world, code, *words)
    assert world.of(Stop), "the arm was not told to stop"
    assert not world.arm.moving
    return found


def in_state(state):
    """Also true once the first move has been ordered."""
    return lambda world: world.procedure.state == state and bool(world.of(MoveTo))


def through(world, pushes):
    found = ended(world.run(), ErrorCode.NONE)
    assert (found.pushes, found.left_out, found.warnings) == (pushes, (), ())
    assert found.holds
    assert [record.bag for record in world.of(Record)] == ["calibration_1", "push", "calibration_2"]
    assert not world.of(Stop)
    assert {f.state for f in world.of(Feedback)} == set(State)
    assert world.of(Feedback)[-1].done == world.procedure.progress[0] == pushes


def test_the_way_through_two_sets_with_a_person():
    world = World(sets=2)
    through(world, 2 * 2 * 2)
    targets = [move.joints.tolist() for move in world.of(MoveTo)]
    assert targets == [POSITIONS[k] for k in (0, 0, 1, 0, 1, 0)]
    assert not world.of(Push)


def test_the_way_through_by_the_service_to_both_sides_along_and_about_all_axes():
    world = World(torques=(0.3,), by_service=True, only=None, places=1)
    through(world, 12)
    asked = [push.wrench for push in world.of(Push)]
    assert len({tuple(wrench) for wrench in asked}) == 12
    assert np.all(np.sum(np.array(asked) != 0, axis=1) == 1)
    assert np.max(asked, axis=0) == pytest.approx([6.0] * 3 + [0.3] * 3)
    assert np.min(asked, axis=0) == pytest.approx([-6.0] * 3 + [-0.3] * 3)


def test_a_person_hears_what_to_do_and_what_is_there():
    world = World().run()
    pushing = [f for f in world.of(Feedback) if f.state == State.PUSH and "push 6" in f.message]
    first = pushing[0]
    assert first.message.startswith("push 6 N along +x: 0.0 N now, 0.0 N aside")
    assert first.wanted == pytest.approx([6.0, 0, 0, 0, 0, 0])
    assert (first.set_number, first.position) == (1, 1)
    holding = next(f for f in world.of(Feedback) if f.state == State.HOLD)
    assert holding.along == pytest.approx(6.0, rel=0.16)
    assert holding.load[:3] == pytest.approx([holding.along, 0.0, 0.0], abs=0.05)
    assert holding.aside < 0.05


def test_the_load_is_counted_from_what_the_wrench_is_untouched():
    world = World()
    world.arm.offset = np.array([0.45, 0.3, -0.4, 0.02, 0.0, 0.0])  # 0.67 N in all
    world.run()
    ended(world, ErrorCode.NONE)
    rests = [f for f in world.of(Feedback) if f.state == State.REST and np.isfinite(f.along)]
    assert rests and all(np.linalg.norm(f.load[:3]) < 0.15 for f in rests)


# --- pushes that are not as asked ---------------------------------------------------------------


def test_a_bad_push_is_asked_for_again_then_left_out_and_named():
    world = World()

    def hear(feedback):
        world.hand.share = 0.6 if feedback.done == 0 and feedback.set_number == 1 else 1.0
        world.hand.hear(feedback)

    world.on_feedback = hear
    found = ended(world.run(), ErrorCode.NONE)
    (text,) = found.left_out
    assert text.startswith("set 1, position 1, 6 N along +x: it came to no more than 3.6")
    assert found.pushes == 3
    assert sum("once more" in message for message in world.messages) == 1


def test_a_marker_that_is_lost_spoils_the_push():
    world = World()
    world.run(in_state(State.HOLD))
    world.arm.marker_hidden = True
    world.run(lambda w: w.procedure.state in (State.REST, State.PUSH), limit_s=5.0)
    world.arm.marker_hidden = False
    found = ended(world.run(), ErrorCode.NONE)
    assert any("the tool's marker was lost for" in message for message in world.messages)
    assert found.left_out == ()


def test_an_arm_that_gives_way_spoils_the_push():
    world = World(only=6)
    world.run(in_state(State.PUSH))
    world.arm.drift[3] = 0.02
    words = ("3 pushes in a row", "roll moved by", "admittance")
    failed(world.run(), ErrorCode.NO_PUSHES, *words)


def test_an_endless_joint_reported_within_one_turn_has_not_moved():
    roll = dataclasses.replace(GALEN.joints[3], lower=-np.inf, upper=np.inf)
    endless = dataclasses.replace(GALEN, joints=(*GALEN.joints[:3], roll, GALEN.joints[4]))
    world = World(dataclasses.replace(SETTINGS, arm=endless))

    def within_one_turn(stamp, position, *others):
        turns = 2.0 * np.pi * (stamp // 10_000_000 % 2)
        return stamp, position - turns * np.eye(5)[3], *others

    world.tamper = within_one_turn
    assert ended(world.run(), ErrorCode.NONE).left_out == ()


def test_stamps_that_jump_all_the_time_end_it_with_the_reason():
    """On a machine that loses samples there is never a second without a jump."""
    world = World()

    def jumps(world):
        world.arm.skip_ns = 200_000_000 if world._steps % 40 == 0 else 0
        return False

    world.run(in_state(State.CALIBRATION))
    failed(world.run(jumps), ErrorCode.NOT_UNTOUCHED, "when calibrating", "jumped by")


def test_a_jump_of_the_stamps_spoils_the_push_and_is_told():
    world = World()
    world.run(in_state(State.HOLD))
    world.arm.skip_ns = 500_000_000
    found = ended(world.run(), ErrorCode.NONE)
    assert any("jumped by +0.510 s" in message for message in world.messages)
    assert any("time stamps jumped" in text for text in found.warnings)
    assert found.left_out == ()


# --- left alone ---------------------------------------------------------------------------------


@pytest.mark.parametrize("state", [State.CALIBRATION, State.UNTOUCHED])
def test_a_touch_where_there_must_be_none_is_waited_out(state):
    world = World().run(in_state(state))
    world.hand._target = np.array([2.0, 0, 0, 0, 0, 0])
    world.hand.lets_go = False
    world.run(lambda w: any("in contact" in message for message in w.messages))
    world.hand.lets_go = True
    ended(world.run(), ErrorCode.NONE)


@pytest.mark.parametrize("state", [State.CALIBRATION, State.UNTOUCHED])
def test_a_touch_that_stays_ends_it(state):
    world = World().run(in_state(state))
    world.hand._target = np.array([2.0, 0, 0, 0, 0, 0])
    world.hand.lets_go = False
    failed(world.run(), ErrorCode.NOT_UNTOUCHED, "in contact")


def test_a_trembling_hand_is_a_touch():
    world = World().run(in_state(State.UNTOUCHED))

    def trembling(stamp, position, velocity, wrench, *poses):
        force = 0.5 * np.sin(2 * np.pi * 3.0 * stamp * 1e-9)
        return stamp, position, velocity, wrench + force * np.eye(6)[0], *poses

    world.tamper = trembling
    failed(world.run(), ErrorCode.NOT_UNTOUCHED, "in contact")


@pytest.mark.parametrize("seen", [None, IDENTITY], ids=["hidden", "frozen"])
def test_a_marker_that_is_not_seen_is_said_before_anyone_pushes(seen):
    world = World()
    world.tamper = lambda *sample: (*sample[:4], sample[4] and seen, sample[5])
    failed(world.run(), ErrorCode.NOT_UNTOUCHED, "the tool's marker was seen")
    assert not any("push 6" in message for message in world.messages)


def test_a_base_marker_that_is_not_seen_is_said():
    world = World()
    world.procedure.on_base_marker = lambda *_: None
    failed(world.run(), ErrorCode.NOT_UNTOUCHED, "the base's marker was seen 0 times")


def test_a_base_that_moved_between_the_calibration_sets_is_a_warning_with_numbers():
    world = World()
    world.run(lambda w: len(w.of(Record)) == 2)
    # Along +x of base_link, so that the tip seems to have gone back.
    along_x = BASE_IN_TRACKER.rotation @ np.array([4e-4, 0.0, 0.0])
    world.arm.base_shift = np.array([*along_x, 0.0, 0.0, 0.0])
    found = ended(world.run(), ErrorCode.NONE)
    assert not found.holds
    (text,) = found.warnings
    assert "did not stay constant" in text
    assert found.shift == pytest.approx([-4e-4, 0.0, 0.0, 0.0, 0.0, 0.0], abs=5e-5)


# --- ends ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("state", list(State))
def test_a_cancel_in_any_state_stops_the_arm(state):
    world = World().run(in_state(state))
    world.procedure.cancel()
    found = failed(world.run(limit_s=5.0), ErrorCode.CANCELED, state.name)
    assert np.all(np.isnan(found.shift))
    before = world.commands.copy()
    world.procedure.cancel()
    assert world.procedure.take_commands() == []
    assert before.count(world.end) == 1


def test_a_cancel_before_anything_came():
    world = World()
    world.dead |= {"joint_states", "wrench_compensated"}
    world.procedure.cancel()
    ended(world.run(limit_s=1.0), ErrorCode.CANCELED)


def test_more_force_than_the_limit_stops_it():
    world = World().run(in_state(State.HOLD))
    world.hand.share = 4.0
    world.hand.delay_s = 0.001
    world.hand.lets_go = False
    world.hand._target = np.array([24.0, 0, 0, 0, 0, 0])
    failed(world.run(), ErrorCode.OVERLOAD, "24.", "20 N")


def test_a_collision_on_the_way_stops_it():
    world = World().run(in_state(State.MOVE))
    world.arm.offset = np.array([0.0, 0, 0, 4.2, 0, 0])
    failed(world.run(limit_s=2.0), ErrorCode.OVERLOAD, "4.20 N·m")


def test_one_spike_is_no_overload():
    world = World().run(in_state(State.UNTOUCHED))
    spike = [np.array([100.0, 0, 0, 0, 0, 0])]

    def once(stamp, position, velocity, wrench, *poses):
        return stamp, position, velocity, wrench + (spike.pop() if spike else 0.0), *poses

    world.tamper = once
    ended(world.run(), ErrorCode.NONE)


@pytest.mark.parametrize(
    ("topic", "state"), [("joint_states", State.MOVE), ("wrench_compensated", State.HOLD)]
)
def test_a_silent_driver_ends_it_naming_the_topic(topic, state):
    world = World().run(in_state(state))
    world.dead.add(topic)
    ended(world.run(limit_s=5.0), ErrorCode.DRIVER_SILENT, f"nothing on {topic}")
    assert world.of(Stop)


def test_stamps_of_two_clocks_are_rejected():
    world = World()
    world.wrench_offset_ns = 3_000_000_000
    ended(world.run(limit_s=5.0), ErrorCode.BAD_INPUT, "+3.000 s", "one clock")
    assert not world.of(MoveTo)


def test_a_stuck_joint_is_named():
    world = World()
    world.arm.ignored_joints = (3,)
    failed(world.run(), ErrorCode.MOTION_TIMEOUT, "roll did not reach 0.3000 rad")


def test_values_that_are_not_finite_end_it():
    world = World().run(in_state(State.UNTOUCHED))
    world.arm.offset[2] = np.nan
    failed(world.run(limit_s=5.0), ErrorCode.BAD_INPUT, "wrench_compensated", "not finite")
    world = World().run(in_state(State.UNTOUCHED))
    world.tamper = lambda stamp, position, *others: (stamp, position * np.nan, *others)
    ended(world.run(limit_s=5.0), ErrorCode.BAD_INPUT, "joint_states", "not finite")


def test_a_recording_that_does_not_begin_is_said():
    world = World()
    world.dead.add("recording")
    ended(world.run(limit_s=10.0), ErrorCode.WRITE_FAILED, "recorded within 5 s")
    assert not world.of(MoveTo)


def test_a_service_that_rejects_or_does_not_answer_ends_it():
    world = World(by_service=True)
    world.dead.add("push_tool")
    world.run(lambda w: bool(w.of(Push)))
    world.procedure.on_service(False, "rise_s is negative")
    failed(world.run(), ErrorCode.SERVICE_FAILED, "rise_s is negative")
    patient = dataclasses.replace(SETTINGS, service_timeout_s=1.0)
    world = World(patient, by_service=True)
    world.dead.add("push_tool")
    failed(world.run(), ErrorCode.SERVICE_FAILED, "did not answer in 1 s")


def test_a_push_that_the_service_only_claims_is_left_out():
    """The wrench is what counts."""
    world = World(by_service=True)
    world._served_load = lambda: np.zeros(6)
    failed(world.run(), ErrorCode.NO_PUSHES, "it came to no more than 0.0")


def test_nothing_is_looked_at_before_the_arm_stands_by_the_wrench_s_own_stamps():
    """Through the compensation wrenches come late: those of the move must not count."""
    world = World(sets=1)
    world.wrench_offset_ns = -100_000_000

    def swinging(stamp, position, velocity, wrench, *poses):
        push = 5.0 * world.arm.moving * np.eye(6)[0]
        return stamp, position, velocity, wrench + push, *poses

    world.tamper = swinging
    ended(world.run(), ErrorCode.NONE)
    assert not any("in contact" in message for message in world.messages)


def test_a_service_that_is_busy_is_asked_again():
    world = World(by_service=True)
    world.dead.add("push_tool")
    world.run(lambda w: bool(w.of(Push)))
    world.dead.clear()
    world.procedure.on_service(False, "the hand is pushing already", busy=True)
    assert ended(world.run(), ErrorCode.NONE).pushes == 4
    assert any("already; once more" in message for message in world.messages)


def test_a_push_by_the_service_is_waited_for_where_it_was_spoiled_before_it_was_felt():
    """Else the next one is asked for while it is still to come."""
    world = World(by_service=True)
    world.run(lambda w: bool(w.of(Push)))
    start, push = world._served
    world._served = start + 50, push  # felt half a second late
    world.arm.skip_ns = 500_000_000
    world.run(lambda w: len(w.of(Push)) == 2)
    assert world._steps > start + 50 + (push.rise_s + push.hold_s + push.fall_s) / 0.01
    assert ended(world.run(), ErrorCode.NONE).pushes == 4
