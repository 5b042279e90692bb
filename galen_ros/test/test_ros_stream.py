"""Pairing for any arm: which joints turn is the arm's, sample by sample and as arrays."""

from dataclasses import replace

import numpy as np
import pytest
from galen_model.arm.galen import GALEN
from galen_ros.stream.pairing import StreamParameters, WrenchPairing
from galen_ros.stream.regular_run import Arrivals
from galen_ros.stream.samples import Notice, PairedWrench

MS = 1_000_000
# Turning, sliding, turning.
ARM = replace(GALEN, joints=(GALEN.joints[3], GALEN.joints[0], GALEN.joints[4]), delta=None)


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
