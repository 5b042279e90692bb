"""A block of a bag's samples through the compensator."""

from __future__ import annotations

from galen_bags.arrays.arm_recording import ArmBlock

from galen_gravcomp.block import BlockResult
from galen_gravcomp.compensator import Compensator


def push_arm_block(compensator: Compensator, block: ArmBlock) -> BlockResult:
    """Push both topics' samples in the order in which they were received."""
    joints, wrenches = block.joints, block.wrenches
    return compensator.push_block(
        block.is_wrench,
        joints.stamp_ns,
        joints.values[:, 3:5],
        wrenches.stamp_ns,
        wrenches.values,
        frame=wrenches.frame,
        frame_ids=wrenches.frame_ids,
        bad_joints=joints.bad,
        bad_wrenches=wrenches.bad,
        positions=joints.values[:, :3] if compensator.needs_positions else None,
    )
