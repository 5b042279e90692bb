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


def pushed(pairing, as_arrays, joint_ns, joints, wrench_ns):
    """Push by stamps; return the joints of what is paired, and how many arrivals made one run."""
    order = sorted(
        [(ns, False, k) for k, ns in enumerate(joint_ns.tolist())]
        + [(ns, True, k) for k, ns in enumerate(wrench_ns.tolist())]
    )
    taken, found = 0, []
    if as_arrays:
        is_wrench = np.array([each[1] for each in order])
        fine, wrenches = np.ones(len(joints), dtype=bool), np.ones((len(wrench_ns), 6))
        run = pairing.push_run(
            Arrivals(is_wrench, joint_ns, joints, fine, wrench_ns, wrenches, fine)
        )
        taken, found = run.taken, list(run.joints)
    for stamp_ns, is_wrench, k in order[taken:]:
        if is_wrench:
            results = pairing.push_wrench(stamp_ns, [1.0] * 6)
        else:
            results = pairing.push_joints(stamp_ns, tuple(joints[k].tolist()))
        found += [one.joints for one in results if isinstance(one, PairedWrench)]
    return np.array(found), taken


@pytest.mark.parametrize("as_arrays", [False, True])
@pytest.mark.parametrize(
    ("arm", "joint", "before", "after", "jumps"),
    [
        (ARM, 0, 0.1, 1.1, True),
        (ARM, 1, 0.1, 1.1, False),
        (ARM, 2, 0.1, 1.1, True),
        (ARM, 0, 3.1, -3.1, True),
        (ENDLESS, 0, 3.1, -3.1, False),
    ],
    ids=["first", "sliding", "last", "wrap with limits", "wrap of an endless one"],
)
def test_only_a_turning_joint_jumps_and_not_by_a_wrap(arm, joint, before, after, jumps, as_arrays):
    joints = np.tile([0.1, 0.2, 0.3], (4, 1))
    joints[:2, joint], joints[2:, joint] = before, after
    stamp_ns = MS * np.array([10, 12, 14, 16])
    pairing = WrenchPairing(StreamParameters(), arm=arm)
    found, taken = pushed(pairing, as_arrays, stamp_ns, joints, stamp_ns)
    assert pairing.notices[Notice.JOINT_JUMP] == jumps
    assert len(found) == (3 if jumps else 4) and np.array_equal(found[:2], joints[:2])
    if as_arrays:
        assert taken == (4 if jumps else 8)
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
    found, taken = pushed(pairing, as_arrays, joint_ns, joints, wrench_ns)
    assert taken == (4 if as_arrays else 0)
    share = 22 / 33
    end = -3.1 + (2.0 * np.pi if arm is ENDLESS else 0.0)
    assert found[0].tolist() == joints[0].tolist()
    np.testing.assert_allclose(found[1, 0], 3.1 + share * (end - 3.1), atol=1e-12)
    np.testing.assert_allclose(found[1, -1], 0.3 + share * 0.2, atol=1e-12)


def test_a_range_of_five_axes_is_no_parameter_of_the_stream():
    with pytest.raises(ParameterError, match="'sensor_range' has 5 numbers, but must have 6"):
        StreamParameters(sensor_range=(1.0,) * 5).validate()
