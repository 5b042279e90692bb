# SPDX-License-Identifier: Apache-2.0
"""Pairing for any arm: which joints turn is the arm's, sample by sample and as arrays."""

from dataclasses import replace

import numpy as np
import pytest
from galen_common.parameters import ParameterError
from galen_common.stream.pairing import StreamParameters, WrenchPairing
from galen_common.stream.regular_run import Arrivals
from galen_common.stream.samples import Notice, PairedWrench
from galen_model.arm.galen import GALEN

MS = 1_000_000
# Turning, sliding, turning.
ARM = replace(GALEN, joints=(GALEN.joints[3], GALEN.joints[0], GALEN.joints[4]), delta=None)
# The first one has no limits.
ENDLESS = replace(
    ARM, joints=(replace(ARM.joints[0], lower=-np.inf, upper=np.inf), *ARM.joints[1:])
)


@pytest.mark.parametrize(("joint", "jumps"), [(0, True), (1, False), (2, True)])
@pytest.mark.parametrize("as_arrays", [False, True])
def test_only_a_turning_joint_jumps(joint, jumps, as_arrays):
    joints = np.tile([0.1, 0.2, 0.3], (4, 1))
    joints[2:, joint] += 1.0
    stamp_ns = MS * np.array([10, 12, 14, 16])
    pairing = WrenchPairing(StreamParameters(), arm=ARM)
    taken = 0
    if as_arrays:
        fine = np.ones(4, dtype=bool)
        is_wrench = np.tile([False, True], 4)
        run = pairing.push_run(
            Arrivals(is_wrench, stamp_ns, joints, fine, stamp_ns, np.ones((4, 6)), fine)
        )
        taken = run.taken // 2
        assert np.array_equal(run.joints, joints[:taken])
        assert taken == (2 if jumps else 4)
    results = []
    for k in range(taken, 4):
        results += pairing.push_joints(int(stamp_ns[k]), tuple(joints[k].tolist()))
        results += pairing.push_wrench(int(stamp_ns[k]), [1.0] * 6)
    assert pairing.notices[Notice.JOINT_JUMP] == jumps
    paired = [one.joints for one in results if isinstance(one, PairedWrench)]
    assert len(paired) + taken == (3 if jumps else 4)
    assert pairing.newest_angles == (joints[3, 0], joints[3, 2])


@pytest.mark.parametrize("as_arrays", [False, True])
@pytest.mark.parametrize("turning_only", [False, True])
@pytest.mark.parametrize("arm", [ARM, ENDLESS])
def test_only_an_endless_joint_is_interpolated_through_half_a_turn(arm, turning_only, as_arrays):
    # 33 ms between samples: a wrap is no jump of an arm that may turn by 200 rad/s.
    joint_ns, wrench_ns = MS * np.array([10, 43]), MS * np.array([10, 32])
    joints = np.array([[3.1, 0.2, 0.3], [-3.1, 0.2, 0.5]])
    if turning_only:
        joints = joints[:, [0, 2]]
    pairing = WrenchPairing(StreamParameters(), arm=arm)
    if as_arrays:
        fine, is_wrench = np.ones(2, dtype=bool), np.array([False, True, True, False])
        wrenches = np.ones((2, 6))
        run = pairing.push_run(
            Arrivals(is_wrench, joint_ns, joints, fine, wrench_ns, wrenches, fine)
        )
        found = run.joints
    else:
        results = pairing.push_joints(int(joint_ns[0]), tuple(joints[0].tolist()))
        for stamp_ns in wrench_ns.tolist():
            results += pairing.push_wrench(stamp_ns, [1.0] * 6)
        results += pairing.push_joints(int(joint_ns[1]), tuple(joints[1].tolist()))
        found = np.array([one.joints for one in results])
    share = 22 / 33
    end = -3.1 + (2.0 * np.pi if arm is ENDLESS else 0.0)
    assert found[0].tolist() == joints[0].tolist()
    np.testing.assert_allclose(found[1, 0], 3.1 + share * (end - 3.1), atol=1e-12)
    np.testing.assert_allclose(found[1, -1], 0.3 + share * 0.2, atol=1e-12)


@pytest.mark.parametrize(("arm", "jumps"), [(ARM, True), (ENDLESS, False)])
@pytest.mark.parametrize("as_arrays", [False, True])
def test_the_wrap_of_an_endless_joint_is_no_jump(arm, jumps, as_arrays):
    stamp_ns = MS * np.array([10, 12])
    joints = np.array([[3.1, 0.2, 0.3], [-3.1, 0.2, 0.3]])
    pairing = WrenchPairing(StreamParameters(), arm=arm)
    if as_arrays:
        fine = np.ones(2, dtype=bool)
        is_wrench, none = np.zeros(2, dtype=bool), np.zeros(0, dtype=np.int64)
        run = pairing.push_run(
            Arrivals(is_wrench, stamp_ns, joints, fine, none, np.zeros((0, 6)), none.astype(bool))
        )
        assert run.taken == (1 if jumps else 2)
    else:
        for stamp, position in zip(stamp_ns.tolist(), joints.tolist(), strict=True):
            pairing.push_joints(stamp, tuple(position))
        assert pairing.notices[Notice.JOINT_JUMP] == jumps


def test_a_range_of_five_axes_is_no_parameter_of_the_stream():
    with pytest.raises(ParameterError, match="'sensor_range' has 5 numbers, but must have 6"):
        StreamParameters(sensor_range=(1.0,) * 5).validate()
