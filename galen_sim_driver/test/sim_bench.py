# SPDX-License-Identifier: Apache-2.0
"""Plants, motions and effects that several tests of the simulator use."""

from dataclasses import replace

import numpy as np
from galen_model.arm.galen import GALEN
from galen_model.load.model import ADAPTER, TOOLS
from galen_sim_driver.plant.cell import Plant
from galen_sim_driver.plant.config import PlantConfig
from galen_sim_driver.plant.motion import Trajectory, TrajectoryPoint
from galen_sim_driver.replay import Scene

EXACT = {"noise": False, "quantise": False}
TURNED = (0.03, -0.05, 0.45, 0.8, -0.6)


def make_plant(tool="", seed=0, arm=GALEN, **changes):
    plant = Plant(replace(PlantConfig(arm=arm), **changes), np.random.default_rng(seed))
    plant.attach_tool(tool)
    return plant


def run(plant, steps):
    """The next samples."""
    return [plant.step() for _ in range(steps)]


def to_rest(joints, duration_s, arm=GALEN):
    """A trajectory to these joints, where the arm comes to rest."""
    zeros = [0.0] * len(joints)
    return Trajectory(arm.joint_names, [TrajectoryPoint(duration_s, joints, zeros, zeros)])


def scene(at_s, joints, *, joint_s=None, tool="retractor", bag="push", **changes):
    """A bag of which all samples are touched, with no wrench read; `changes` are other fields."""
    given = Scene(
        bag=bag,
        start_s=0.0,
        joint_s=at_s if joint_s is None else joint_s,
        joints=joints,
        wrench_s=at_s,
        reading=np.zeros((len(at_s), 6)),
        touched=np.ones(len(at_s), dtype=bool),
        tracker_s=at_s,
        tool=TOOLS[tool],
        adapter=ADAPTER,
        arm=GALEN,
    )
    return replace(given, **changes)


def typical(effect):
    """The effect with numbers in all that is fitted, no two alike."""
    values = np.concatenate([p.typicals for p in effect.fitted])
    upper = np.concatenate([np.full(p.size, p.upper) for p in effect.fitted])
    return effect.with_vector(np.minimum(values * (1.0 + 0.1 * np.arange(len(values))), upper))
