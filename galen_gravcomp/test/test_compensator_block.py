# SPDX-License-Identifier: Apache-2.0
"""`push_block` gives what pushing the samples one by one gives, whatever is wrong with them."""

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
import pytest
from calibration_files import pointer
from galen_common.stream import pairing as pairing_module
from galen_common.stream.samples import (
    ANGLE_UNIT_LIMIT_RAD,
    TORQUE_UNIT_FACTOR,
    JointBuffer,
    PairedWrench,
    Rejected,
    Rejection,
    Result,
    SampleLimits,
    angle_unit_notice,
    count_angle_unit_notices,
    surely_finite,
)
from galen_gravcomp.compensator import Compensator, TareRejectedError
from galen_gravcomp.corrections import tare as tare_module
from galen_gravcomp.parameters import GravcompParameters
from galen_model.arm.galen import GALEN
from galen_model.files.calibration_file import CalibrationFile
from sample_blocks import topic

from galen_gravcomp import block as block_module

MS = 1_000_000
S = 1_000_000_000
START = 1_700_000_000 * S
FRAMES = ("ft_sensor", "other_frame")


OFFSET = np.array([0.01, -0.02, 0.03, 1e-3, -2e-3, 3e-3])
TOOL, OTHER_TOOL = (pointer(mass_kg=mass, residual_offset=OFFSET) for mass in (0.06, 0.4))


class Sample(NamedTuple):
    """One message as it arrives: of a joint state with (roll, tilt), or a wrench with six."""

    is_wrench: bool
    stamp_ns: int
    values: tuple[float, ...]
    frame: int = 0
    bad: str = ""


# Streams and what goes wrong with them


def clean_stream(
    rng: np.random.Generator,
    duration_ns: int,
    joint_period_ns: int,
    wrench_period_ns: int,
    joint_delay_ns: int = 0,
    wrench_delay_ns: int = 0,
    wrench_offset_ns: int = 0,
) -> list[Sample]:
    """Both topics at their rates, in the order of arrival, a joint sample first."""
    joints = START + np.arange(0, duration_ns, joint_period_ns)
    wrenches = START + wrench_offset_ns + np.arange(0, duration_ns, wrench_period_ns)
    arrivals: list[tuple[int, int, Sample]] = []
    # No arm jumps from one to another by more than 0.2 rad; faults do.
    angles = rng.uniform(-0.1, 0.1, size=(len(joints), 2))
    for stamp, pair in zip(joints.tolist(), angles.tolist(), strict=True):
        arrivals.append((stamp + joint_delay_ns, 0, Sample(False, stamp, tuple(pair))))
    values = rng.normal(0.0, 1.0, size=(len(wrenches), 6))
    for stamp, six in zip(wrenches.tolist(), values.tolist(), strict=True):
        arrivals.append((stamp + wrench_delay_ns, 1, Sample(True, stamp, tuple(six))))
    arrivals.sort(key=lambda arrival: arrival[:2])
    return [sample for _, _, sample in arrivals]


def _repeat(rng: np.random.Generator, samples: list[Sample], at: int) -> None:
    """The same stamp again, at once or a little later."""
    samples.insert(at + int(rng.integers(1, 4)), samples[at])


def _late(rng: np.random.Generator, samples: list[Sample], at: int) -> None:
    """It comes only after later ones."""
    samples.insert(at + int(rng.integers(2, 40)), samples.pop(at))


def _jump(rng: np.random.Generator, samples: list[Sample], at: int) -> None:
    """From here on the stamps of one or both topics are others; also by exactly a limit."""
    sizes = [MS, 49 * MS, 50 * MS, 51 * MS, 300 * MS, 998 * MS, 1000 * MS, 1002 * MS, 7 * S]
    jump_ns = int(rng.choice(sizes)) + int(rng.integers(-1, 2))
    jump_ns *= int(rng.choice([-1, 1]))
    which = rng.choice(["joints", "wrenches", "both"])
    for row in range(at, len(samples)):
        sample = samples[row]
        if which == "both" or (which == "wrenches") == sample.is_wrench:
            samples[row] = sample._replace(stamp_ns=sample.stamp_ns + jump_ns)


def _silence(rng: np.random.Generator, samples: list[Sample], at: int) -> None:
    """One topic is missing for a while, or only arrives after the others."""
    is_wrench = bool(rng.integers(2))
    end = at + int(rng.integers(1, 120))
    gone = [s for s in samples[at:end] if s.is_wrench == is_wrench]
    samples[at:end] = [s for s in samples[at:end] if s.is_wrench != is_wrench]
    if rng.integers(2):
        at = max(at, end - len(gone))
        samples[at:at] = gone


def _value(rng: np.random.Generator, samples: list[Sample], at: int) -> None:
    """A number that is not finite, too large, or in another unit."""
    sample = samples[at]
    values = list(sample.values)
    column = int(rng.integers(len(values)))
    choices = [math.nan, math.inf, -math.inf, 1e305]
    choices += [1e4, 3.5, 70.0, -126.0, 125.0, 3.0] if sample.is_wrench else [7.0, -90.0]
    values[column] = float(rng.choice(choices))
    samples[at] = sample._replace(values=tuple(values))


def _stamp(rng: np.random.Generator, samples: list[Sample], at: int) -> None:
    """No stamp, a negative one, or one that lies beside the last one."""
    stamp_ns = samples[at].stamp_ns
    beside = [stamp_ns + step_ns for step_ns in (-2 * MS, -50 * MS, 50 * MS, 5 * S)]
    samples[at] = samples[at]._replace(stamp_ns=int(rng.choice([0, -1, 1, *beside])))


def _frame(rng: np.random.Generator, samples: list[Sample], at: int) -> None:
    samples[at] = samples[at]._replace(frame=1)


def _bad(rng: np.random.Generator, samples: list[Sample], at: int) -> None:
    samples[at] = samples[at]._replace(bad=f"message {at} is torn", stamp_ns=0)


FAULTS = [_repeat, _late, _jump, _silence, _value, _stamp, _frame, _bad]
Fault = Callable[[np.random.Generator, list[Sample], int], None]


def spoil(
    rng: np.random.Generator, samples: list[Sample], count: int, faults: Sequence[Fault] = FAULTS
) -> None:
    for _ in range(count):
        if samples:
            rng.choice(np.array(faults))(rng, samples, int(rng.integers(len(samples))))


# The two ways, with everything that can be seen of them


@dataclass
class Way:
    """A compensator, and all that came out of it."""

    compensator: Compensator
    outputs: list[PairedWrench] = field(default_factory=list)
    rejected: list[Rejected] = field(default_factory=list)
    log: list[str] = field(default_factory=list)

    def sort(self, results: list[Result]) -> None:
        for result in results:
            if isinstance(result, PairedWrench):
                self.outputs.append(result)
            else:
                self.rejected.append(result)

    def on_done(self, message: str, offset: np.ndarray | None) -> None:
        self.log.append(message)

    def act(self, action: str) -> None:
        """What a user does between two samples."""
        compensator = self.compensator
        if action == "tare":
            try:
                compensator.start_tare(self.on_done)
            except TareRejectedError as error:
                self.log.append(str(error))
        elif action in ("on", "off"):
            self.sort(compensator.set_enabled(action == "on"))
        elif action == "restart":
            self.sort(compensator.pairing.restart("a publisher is new"))
        else:
            tools = {"tool": TOOL, "other tool": OTHER_TOOL, "no tool": None}
            self.sort(compensator.set_tool(tools[action]))

    def singly(self, samples: Sequence[Sample]) -> None:
        compensator = self.compensator
        for sample in samples:
            if sample.is_wrench and sample.bad:
                self.sort(compensator.pairing.push_bad_wrench(sample.bad))
            elif sample.is_wrench:
                frame_id = FRAMES[sample.frame]
                self.sort(compensator.push_wrench(sample.stamp_ns, sample.values, frame_id))
            elif sample.bad:
                compensator.pairing.push_bad_joints(sample.bad)
            else:
                self.sort(compensator.push_joints(sample.stamp_ns, sample.values))

    def as_block(self, samples: Sequence[Sample]) -> None:
        result = self.compensator.push_block(**block_of(samples))
        rows = (result.index, result.stamp_ns, result.wrench, result.angles)
        for number, stamp_ns, wrench, angles in zip(*rows, strict=True):
            pair = (float(angles[0]), float(angles[1]))
            self.outputs.append(PairedWrench(int(stamp_ns), wrench, pair, None, int(number)))
        self.rejected += result.rejected

    def state(self) -> list[Any]:
        """What can be seen between two samples."""
        c = self.compensator
        counts = [c.pairing.received, c.compensated, c.pairing.waiting, c.pairing.newest_wrench_ns]
        return [*counts, c.pairing.rejections, c.pairing.notices, c.taring, c.tare_ramping]


def block_of(samples: Sequence[Sample]) -> dict[str, Any]:
    joints = [s for s in samples if not s.is_wrench]
    wrenches = [s for s in samples if s.is_wrench]
    return {
        "is_wrench": np.array([s.is_wrench for s in samples], dtype=bool),
        "joints": topic(
            [s.stamp_ns for s in joints],
            np.reshape([s.values for s in joints], (-1, 2)),
            bad={row: s.bad for row, s in enumerate(joints) if s.bad},
        ),
        "wrenches": topic(
            [s.stamp_ns for s in wrenches],
            np.reshape([s.values for s in wrenches], (-1, 6)),
            [s.frame for s in wrenches],
            FRAMES,
            {row: s.bad for row, s in enumerate(wrenches) if s.bad},
        ),
    }


@pytest.fixture(autouse=True)
def any_tare(monkeypatch: pytest.MonkeyPatch) -> None:
    """Tares succeed, whatever moves."""
    for name in ("MAX_MOTION_RAD", "MAX_STD_FORCE_N", "MAX_STD_TORQUE_NM"):
        monkeypatch.setattr(tare_module, name, 99.0)


def make_way(
    capacity: int = 4096, tool: CalibrationFile | None = TOOL, max_waiting: int = 1000
) -> Way:
    """With a ring of joint samples small enough to matter."""
    way = Way(
        Compensator(
            GravcompParameters(
                calibration_monitor=False,
                tare_window_s=0.02,
                tare_ramp_s=0.03,
                tare_max_force_n=99.0,
                tare_max_torque_nm=99.0,
            ),
            arm=GALEN,
        )
    )
    pairing = way.compensator.pairing
    pairing._limits = replace(pairing._limits, max_waiting=max_waiting)
    way.compensator._on_restart = way.log.append
    way.compensator.pairing._joints = JointBuffer(50 * MS, capacity)
    way.compensator.set_tool(tool)
    return way


def later(end: int) -> list[Sample]:
    """Samples that hang on all that is remembered: wrenches among the last joints, up to the newest
    wrench's stamp, then one more of both, for which all that waits is answered."""
    wrench = (1.0, 2.0, 3.0, 0.1, 0.2, 0.3)
    among = [Sample(True, end - k * 3 * MS - 1, wrench) for k in range(16, 0, -1)]
    return [*among, Sample(True, end + MS, wrench), Sample(False, end + 2 * MS, (0.1, 0.2))]


def assert_same(singly: Way, blocks: Way, samples: Sequence[Sample]) -> None:
    after = later(singly.compensator.pairing.newest_wrench_ns or START)
    for way in (singly, blocks):
        way.singly(after)
    assert [o.number for o in blocks.outputs] == [o.number for o in singly.outputs]
    assert [o.stamp_ns for o in blocks.outputs] == [o.stamp_ns for o in singly.outputs]
    assert blocks.rejected == singly.rejected
    assert blocks.log == singly.log, "restarts and answers to tares"
    assert blocks.state() == singly.state()
    raw = np.reshape([s.values for s in (*samples, *after) if s.is_wrench], (-1, 6))
    got = np.reshape([o.wrench for o in blocks.outputs], (-1, 6))
    expected = np.reshape([o.wrench for o in singly.outputs], (-1, 6))
    rows = np.array([o.number for o in singly.outputs], dtype=int)
    size = 1.0 + np.abs(raw[rows]).max(axis=1, initial=0.0)
    assert np.all(np.abs(got - expected) <= 1e-12 * size[:, None])
    angles = [np.reshape([o.joints[-2:] for o in way.outputs], (-1, 2)) for way in (blocks, singly)]
    np.testing.assert_allclose(*angles, rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(
        blocks.compensator.tare_offset, singly.compensator.tare_offset, rtol=1e-12, atol=1e-12
    )


ACTIONS = ["off", "no tool", "restart", "other tool", *["on", "tool"] * 4, *["tare"] * 8]


def random_case(rng: np.random.Generator) -> list[Sample]:
    periods = [MS, 2 * MS, 2 * MS, 2 * MS, 2 * MS, 3 * MS, 5 * MS, 25 * MS, 50 * MS, 51 * MS]
    samples = clean_stream(
        rng,
        duration_ns=int(rng.integers(0, 500)) * MS,
        joint_period_ns=int(rng.choice(periods)),
        wrench_period_ns=int(rng.choice(periods)),
        joint_delay_ns=int(rng.choice([0, 0, 0, 1, 2, 3, 10, 30, 49, 50, 51])) * MS,
        wrench_delay_ns=int(rng.choice([0, 0, 0, 1, 2, 3, 10, 49, 100])) * MS,
        wrench_offset_ns=int(rng.choice([0, 0, 1, 700_000, -1, 3 * MS])),
    )
    spoil(rng, samples, int(rng.choice([0, 1, 2, 3, 5, 20])))
    return samples


def compare(rng: np.random.Generator, samples: list[Sample], actions: float, **options: Any) -> Way:
    """Push blocks cut at random, with actions between some; returns the way of the blocks."""
    singly, blocks = make_way(**options), make_way(**options)
    cuts = np.sort(rng.integers(0, len(samples) + 1, size=int(rng.choice([0, 1, 2, 6, 20]))))
    for start, end in zip([0, *cuts], [*cuts, len(samples)], strict=True):
        part = samples[start:end]
        singly.singly(part)
        blocks.as_block(part)
        assert blocks.state() == singly.state()
        if rng.random() < actions:
            action = str(rng.choice(ACTIONS))
            singly.act(action)
            blocks.act(action)
    assert_same(singly, blocks, samples)
    return blocks


@pytest.fixture
def short_looks(monkeypatch: pytest.MonkeyPatch) -> None:
    """One sample is pushed singly around a fault and not sixteen: so much more goes as arrays."""
    monkeypatch.setattr(block_module, "_FEWEST_STEPS", 1)
    monkeypatch.setattr(block_module, "_SMALLEST_LOOK", 3)
    monkeypatch.setattr(block_module, "_MOST_STEPS", 4)


@pytest.mark.parametrize(
    "seed", [*range(4), *(pytest.param(s, marks=pytest.mark.slow) for s in range(1000, 1004))]
)
@pytest.mark.usefixtures("short_looks")
def test_random_faults_and_borders(seed: int) -> None:
    """Streams that come upon nearly everything; slow seeds upon many times as much."""
    rng = np.random.default_rng(seed)
    rejections: set[Any] = set()
    samples_in = as_arrays = 0
    for _ in range(100 if seed >= 1000 else 20):
        samples = random_case(rng)
        compensator = compare(
            rng,
            samples,
            actions=float(rng.choice([0.0, 0.5])),
            capacity=int(rng.choice([2, 3, 8, 64, 4096])),
            max_waiting=int(rng.choice([1, 5, 20, 1000, 1000, 1000])),
        ).compensator
        samples_in += len(samples)
        as_arrays += compensator.pushed_as_arrays
        rejections |= set(compensator.pairing.rejections)
    assert as_arrays > 0.3 * samples_in and len(rejections) > 5
    if seed >= 1000:
        # Inertial forces are asked for nowhere here, and no publishers, bits and set-ups watched.
        elsewhere = {Rejection.NO_MOTION, Rejection.SEVERAL_PUBLISHERS, Rejection.FROZEN}
        elsewhere |= {Rejection.UNITS, Rejection.WRONG_SETUP, Rejection.NOT_VERIFIED}
        assert rejections >= set(Rejection) - elsewhere - {Rejection.RESTART}


# What has to go as arrays


CLEAN = [
    {},
    {"joint_delay_ns": 49 * MS},
    {"wrench_delay_ns": 400 * MS},
    {"wrench_offset_ns": 700_000},
    {"wrench_offset_ns": 700_000, "joint_delay_ns": 3 * MS + 1},
    {"joint_period_ns": 50 * MS},
    {"joint_period_ns": 20 * MS, "wrench_offset_ns": 1, "joint_delay_ns": 30 * MS},
    {"wrench_period_ns": 1000 * MS},
]


@pytest.mark.parametrize("options", CLEAN, ids=[str(options) for options in CLEAN])
@pytest.mark.parametrize("cuts", [0, 40])
def test_a_clean_stream_goes_as_arrays(options: dict[str, int], cuts: int) -> None:
    rng = np.random.default_rng(3)
    periods = {"joint_period_ns": 2 * MS, "wrench_period_ns": 2 * MS}
    samples = clean_stream(rng, 4 * S, **{**periods, **options})
    singly, blocks = make_way(), make_way()
    singly.singly(samples)
    borders = np.sort(rng.integers(0, len(samples) + 1, size=cuts))
    for start, end in zip([0, *borders], [*borders, len(samples)], strict=True):
        blocks.as_block(samples[start:end])
    assert not blocks.rejected
    assert blocks.compensator.pushed_as_arrays == len(samples)
    assert_same(singly, blocks, samples)


def test_joints_behind_by_the_limit_are_not_stale_and_a_nanosecond_more_are() -> None:
    """Limits are met exactly: joints' age, joints' gaps, a restart's gap, the queue."""
    for more in (0, 1):
        for case in ("age", "gap", "restart", "joint restart", "back", "queue"):
            joints = [Sample(False, START + t * MS, (0.1, 0.2)) for t in range(0, 10, 2)]
            newest = joints[-1].stamp_ns
            ends = {
                "age": [(True, newest + 50 * MS + more)],
                "gap": [(False, newest + 50 * MS + more), (True, newest + 3)],
                "restart": [(True, newest), (True, newest + S + more)],
                "joint restart": [(False, newest + S + more)],
                "back": [(True, newest), (True, newest - 50 * MS - more)],
                "queue": [(True, newest + k) for k in range(4 + more)],
            }
            samples = list(joints)
            for is_wrench, stamp_ns in ends[case]:
                samples.append(Sample(is_wrench, stamp_ns, (1.0,) * (6 if is_wrench else 2)))
            singly, blocks = make_way(max_waiting=3), make_way(max_waiting=3)
            singly.singly(samples)
            blocks.as_block(samples)
            assert_same(singly, blocks, samples)
            # Out of order is pushed singly, and so is a wrench that goes a second ahead of joints.
            regular = more == 0 and case not in ("back", "restart")
            assert (blocks.compensator.pushed_as_arrays == len(samples)) == regular, (case, more)


def test_both_forms_of_a_rule_agree_at_its_limits() -> None:
    sensor_range = (125.0, 125.0, 500.0, 3.0, 3.0, 0.7)
    limits = SampleLimits(50 * MS, S, 1000, sensor_range)
    factors = (1.0, -1.0, TORQUE_UNIT_FACTOR, -TORQUE_UNIT_FACTOR)
    for axis, factor in itertools.product(range(6), factors):
        at = sensor_range[axis] * factor
        for value in (np.nextafter(at, 0.0), at, np.nextafter(at, 2.0 * at)):
            wrench = np.zeros(6)
            wrench[axis] = value
            one = limits.range_notices(wrench.tolist())
            assert limits.count_range_notices(wrench[None]) == (int(one[0]), int(one[1]))
    for at in (ANGLE_UNIT_LIMIT_RAD, -ANGLE_UNIT_LIMIT_RAD):
        for angle in (np.nextafter(at, 0.0), at, np.nextafter(at, 2.0 * at)):
            for pair in ((angle, 0.0), (0.0, angle)):
                for limited in ((True, True), (False, True)):
                    counted = count_angle_unit_notices(np.array([pair]), limited)
                    assert counted == int(angle_unit_notice(pair, limited))
                assert not angle_unit_notice((7.0 * angle, 0.0), (False, True))  # turns on and on
    for value in (1.0, 1e300, 1e308, math.inf, math.nan):
        wrenches = np.full((1, 6), value)
        assert surely_finite(wrenches)[0] == (value <= 1e300)
        assert math.isfinite(sum(wrenches[0].tolist())) or not surely_finite(wrenches)[0]


def test_rare_faults_leave_the_rest_to_arrays() -> None:
    rng = np.random.default_rng(4)
    samples = clean_stream(rng, 16 * S, 2 * MS, 2 * MS, wrench_offset_ns=500_000)
    # A jump of one topic's clock is not rare: all wrenches after it are rejected.
    spoil(rng, samples, 12, [fault for fault in FAULTS if fault is not _jump])
    way = compare(rng, samples, actions=0.0)
    assert len(way.compensator.pairing.rejections) + len(way.compensator.pairing.notices) > 5
    assert way.compensator.pushed_as_arrays > 0.95 * len(samples)


@pytest.mark.parametrize("every", [2, 17])
def test_frequent_faults_do_not_make_it_look_again_and_again(
    every: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However many there are, work stays in proportion to the samples, also of a huge block."""
    looked = []

    def counting(arrivals: Any, *state: Any) -> Any:
        looked.append(len(arrivals.is_wrench))
        return find_regular_run(arrivals, *state)

    find_regular_run = pairing_module.find_regular_run
    monkeypatch.setattr(pairing_module, "find_regular_run", counting)
    rng = np.random.default_rng(5)
    samples = clean_stream(rng, 8 * S, 2 * MS, 2 * MS)
    for at in range(every, len(samples), every):
        samples[at] = samples[at]._replace(bad="torn", stamp_ns=0)
    way = make_way()
    way.as_block(samples)
    assert sum(looked[1:]) < 3 * len(samples), "the first look is at the whole block"
    assert len(looked) < len(samples) / 10


# The interface


def test_numbers_run_over_all_blocks_and_single_wrenches() -> None:
    way = make_way()
    wrench = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    way.as_block([Sample(True, START, wrench), Sample(False, START - 1, (0.0, 0.0))])
    assert way.compensator.push_wrench(START + 1, wrench, tag="mine") == []
    way.as_block([])
    way.as_block([Sample(True, START + 2, wrench, frame=1), Sample(True, START + 3, wrench)])
    assert [(r.number, r.reason) for r in way.rejected] == [(2, Rejection.WRONG_FRAME)]
    (first, second, last) = way.compensator.push_joints(START + 3, (0.0, 0.0))
    assert [first.number, second.number, last.number] == [0, 1, 3]
    assert isinstance(second, PairedWrench) and second.tag == "mine"
    # A wrench that waited from before comes out with the block, in its place.
    assert way.compensator.push_wrench(START + 4, wrench, tag="mine") == []
    way.as_block([Sample(True, START + 5, wrench), Sample(False, START + 6, (0.0, 0.0))])
    assert [output.number for output in way.outputs] == [4, 5]


def test_counts_that_do_not_fit_are_rejected_before_anything_is_pushed() -> None:
    way = make_way()
    samples = clean_stream(np.random.default_rng(6), 4 * MS, 2 * MS, 2 * MS)
    change = {"is_wrench": np.ones(4, dtype=bool)}
    with pytest.raises(ValueError, match=r"is_wrench has 0 and 4"):
        way.compensator.push_block(**{**block_of(samples), **change})
    assert way.compensator.pairing.received == 0
    assert way.compensator.pairing.newest_angles is None
