# SPDX-License-Identifier: Apache-2.0
"""A tool's cable in the compensator: fast and slow way, one by one and as arrays, in and out."""

from dataclasses import replace

import numpy as np
import pytest
from calibration_files import tool_file
from galen_common.stream.monitor import Severity
from galen_common.stream.samples import PairedWrench, Rejection
from galen_gravcomp.compensator import Compensator
from galen_gravcomp.corrections.cable import CablePull
from galen_gravcomp.monitor import Monitor
from galen_gravcomp.parameters import GravcompParameters
from galen_model.arm.galen import GALEN, SENSOR
from galen_model.load.cable import FORMS, LearnedPull, form_matrices
from sample_blocks import topic

PERIOD_NS = 2_000_000
START_NS = 1_000_000_000
AT = np.array([0.09, 0.01, 0.05])


def a_drag(form="point", seed=0):
    """A cable learned from 20 poses at home's place."""
    roll, tilt = np.meshgrid(np.linspace(-1.0, 1.0, 5), np.linspace(-0.8, 0.8, 4), indexing="ij")
    joints = np.tile(GALEN.home, (20, 1))
    joints[:, 3], joints[:, 4] = roll.ravel(), tilt.ravel()
    matrices = form_matrices("point_and_couple", joints, AT, arm=GALEN)
    force = np.array([0.2, -0.15, 0.1]) + 0.05 * np.sin(joints[:, 3:4] + [0.0, 1.0, 2.0])
    couple = 0.005 * np.cos(joints[:, 4:] + [0.0, 1.0, 2.0])
    wrench = np.einsum("gnkl,gnl->nk", matrices, np.array([force, couple]))
    std = np.tile(SENSOR.noise_std / 20.0, (20, 1))
    length = np.array([1.2, 1.1])
    return LearnedPull(
        form, joints, wrench, std, length, 0.3, [0.1, 0.01] * np.ones(2), 0.6, "x", AT
    )


def a_tool(cable=None):
    return tool_file(cable=cable)


def motion(count=1500):
    """Joints (n, 5) that leave the poses seen in the last third, and come back."""
    t = np.linspace(0.0, 1.0, count)
    joints = np.tile(GALEN.home, (count, 1))
    joints[:, 3] = 0.9 * np.sin(5.0 * t)
    joints[:, 4] = 0.6 * np.sin(7.0 * t + 1.0)
    joints[:, 0] += 0.2 * np.clip(np.sin(3.0 * np.pi * t - 2.0 * np.pi), 0.0, None) * (t > 0.66)
    return joints


def raw_of(tool, joints, push=0.0):
    expected = tool.predict(joints[:, 3:])
    if tool.cable is not None:
        expected = expected + tool.cable.posterior.means(joints)
    return expected + push


def one_by_one(compensator, joints, raw, lag=1):
    """Outputs (n, 6) in order; wrenches come `lag` samples before their joints."""
    results = []
    for row in range(len(joints) + lag):
        if row < len(joints):
            results += compensator.push_wrench(START_NS + row * PERIOD_NS, raw[row])
        late = row - lag
        if late >= 0:
            q = joints[late].tolist()
            stamp_ns = START_NS + late * PERIOD_NS - PERIOD_NS // 3
            results += compensator.push_joints(stamp_ns, tuple(q))
    return results


# --- the pull itself ----------------------------------------------------------------------------


@pytest.mark.parametrize("form", FORMS)
def test_the_fast_way_is_the_posteriors(form):
    drag = a_drag(form)
    rng = np.random.default_rng(1)
    joints = GALEN.home + rng.uniform(-1.0, 1.0, (300, 5)) * [0.15, 0.05, 0.05, 1.6, 1.2]
    pull, expected = CablePull(drag, arm=GALEN), drag.posterior.readings(joints)
    found = np.array([pull.reading(tuple(q)) for q in joints.tolist()])
    assert np.abs(found - expected).max() < 1e-12
    assert np.abs(pull.readings(joints) - expected).max() < 1e-12
    weights = drag.posterior.weights(joints)
    assert (weights == 0.0).any() and (weights == 1.0).any()
    assert ((weights > 0.0) & (weights < 1.0)).any()
    assert pull.weight == pytest.approx(weights[-1], abs=1e-12)
    # Far from everything nothing overflows.
    assert not pull.reading((1e6, -1e6, 1e6, 1e6, -1e6)).any()


def test_an_endless_joint_a_turn_away_is_where_it_was_seen():
    joints = tuple(replace(joint, lower=-np.inf, upper=np.inf) for joint in GALEN.joints[3:])
    arm = replace(GALEN, joints=GALEN.joints[:3] + joints)
    drag = replace(a_drag(), arm=arm)
    pull, at = CablePull(drag, arm), drag.joints[7] + 0.01
    seen, turned = tuple(at.tolist()), tuple((at + [0, 0, 0, 2.0 * np.pi, -4.0 * np.pi]).tolist())
    expected = pull.reading(seen)
    assert pull.weight == 1.0
    assert pull.reading(turned) == pytest.approx(expected, abs=1e-12)
    assert drag.posterior.readings([turned]) == pytest.approx(expected[None], abs=1e-12)
    assert drag.posterior.covariance(turned) == pytest.approx(drag.posterior.covariance(seen))


# --- in the compensator -------------------------------------------------------------------------


def test_one_by_one_and_as_arrays_it_is_the_same_and_gone_where_it_was_seen():
    tool, joints = a_tool(a_drag()), motion()
    raw = raw_of(tool, joints)
    single = Compensator(arm=GALEN)
    single.set_tool(tool)
    assert single.needs_positions and single.pairs_positions
    results = one_by_one(single, joints, raw)
    wrench = np.array([result.wrench for result in results if isinstance(result, PairedWrench)])
    stamps = [result.stamp_ns for result in results if isinstance(result, PairedWrench)]

    block = Compensator(GravcompParameters(calibration_monitor=False), arm=GALEN)
    block.set_tool(tool)
    kinds, joint_rows = [], np.arange(len(joints))
    for row in range(len(joints) + 1):
        kinds += [True] * (row < len(joints)) + [False] * (row > 0)
    whole = block.push_block(
        np.array(kinds),
        topic(START_NS + joint_rows * PERIOD_NS - PERIOD_NS // 3, joints),
        topic(START_NS + joint_rows * PERIOD_NS, raw),
    )
    assert block.pushed_as_arrays > 0.9 * len(kinds)
    assert whole.stamp_ns.tolist() == stamps
    assert len(wrench) > 1400
    assert np.abs(whole.wrench - wrench).max() < 1e-9
    assert whole.angles.shape == (len(wrench), 2)
    # Inside, all of the pull is taken off; outside, nothing.
    at = joints[np.searchsorted(START_NS + joint_rows * PERIOD_NS, stamps)]
    weights = tool.cable.posterior.weights(at)
    inside, outside = weights == 1.0, weights == 0.0
    assert inside.sum() > 500 and outside.sum() > 50
    # Joints are interpolated a third of a period: the pull changes by no more between two samples.
    assert np.abs(wrench[inside]).max() < 5e-3
    pull = tool.cable.posterior.means(at)
    assert np.abs(wrench - pull)[outside].max() < 5e-3 < 0.1 < np.abs(pull[outside]).max()
    assert np.abs(np.diff(wrench, axis=0)).max() < 0.01


def test_a_tool_with_a_cable_and_one_without_follow_each_other():
    plain, corded = a_tool(), a_tool(a_drag())
    compensator = Compensator(arm=GALEN)
    compensator.set_tool(plain)
    q = GALEN.home.tolist()

    def step(number):
        stamp_ns = START_NS + number * PERIOD_NS
        compensator.push_joints(stamp_ns, tuple(q))
        return compensator.push_wrench(stamp_ns, raw_of(corded, GALEN.home[None])[0])

    (first,) = step(1)
    assert np.abs(first.wrench).max() > 0.1
    waits = compensator.push_wrench(START_NS + 3 * PERIOD_NS // 2, np.zeros(6))
    assert waits == []
    (rejected,) = compensator.set_tool(corded)
    assert rejected.reason is Rejection.NO_JOINTS
    (second,) = step(2)
    assert np.abs(second.wrench).max() < 1e-3
    assert compensator.set_tool(replace(corded, tool="other")) == []
    assert np.abs(step(3)[0].wrench).max() < 1e-3
    compensator.set_tool(plain)
    assert not compensator.needs_positions
    assert np.abs(step(4)[0].wrench - first.wrench).max() < 1e-12


def test_outside_is_told_on_diagnostics():
    compensator = Compensator(GravcompParameters(late_s=0.0), arm=GALEN)
    monitor = Monitor(compensator)
    compensator.set_tool(a_tool(a_drag()))
    for number, (away, state) in enumerate(((0.0, "compensating"), (0.3, "cable_outside"))):
        stamp_ns = START_NS + number * PERIOD_NS
        now_s = 0.002 * number
        monitor.on_joints(now_s)
        monitor.on_wrench(now_s)
        compensator.push_joints(stamp_ns, (away, 0.0, 0.408, 0.0, 0.0))
        assert isinstance(compensator.push_wrench(stamp_ns, np.zeros(6))[0], PairedWrench)
        monitor.on_output(now_s, now_s, stamp_ns)
        assert monitor.state(now_s).name == state
    assert monitor.state(now_s).severity is Severity.WARN
    assert monitor.values(now_s)["cable"] == "outside"
    compensator.set_tool(a_tool())
    assert monitor.values(now_s)["cable"] == "none"
