# SPDX-License-Identifier: Apache-2.0
"""Effects beyond the nominal model: forces of acceleration, cable, bias drift, a tool that sags."""

import numpy as np
import pinocchio
import pytest
from galen_model.arm.galen import GALEN, GRAVITY_M_S2, SENSOR
from galen_model.arm.sensor_motion import sensor_motion
from galen_model.load.model import ADAPTER, TOOLS, Load
from galen_sim_driver.effects.effect import Instants, Posture
from galen_sim_driver.effects.load import InertialLoad
from galen_sim_driver.effects.sensor import SensorDrift
from sim_bench import EXACT, TURNED, make_plant, run, to_rest

from galen_validation.pinocchio_arm import PinocchioArm

ADAPTER_INERTIA = (2e-5, 3e-5, 4e-5, 1e-6, -2e-6, 3e-6)
TOOL_INERTIA = (1e-4, 5e-4, 4.5e-4, -3e-5, 2e-5, 1e-5)


def move(plant, steps=700):
    plant.command(to_rest(TURNED, 1.2))
    return run(plant, steps)


def tensor(entries):
    xx, yy, zz, xy, xz, yz = entries
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


SWUNG = InertialLoad(
    TOOLS["retractor"].load.mass_kg + ADAPTER.mass_kg, tuple(np.add(ADAPTER_INERTIA, TOOL_INERTIA))
)


def test_without_them_the_plant_reads_as_it_did_before_there_were_any():
    samples = move(make_plant("retractor"), 500)
    quanta = np.array([sample.wrench for sample in samples]) / SENSOR.quantum
    # Sums of a plant that knew none of these effects, and was bit for bit the same over a longer
    # run; a few roundings may go the other way with another libm.
    before = [159513.5, -89561.0, -57824.0, 213370.0, 595117.5, -123130.0]
    assert np.abs(quanta.sum(axis=0) - before).max() < 4.0


# --- forces of acceleration ---------------------------------------------------------------------


def inertial_wrench(load, about_com, joints, velocities, accelerations):
    motion = sensor_motion(
        *(np.atleast_2d(part) for part in (joints, velocities, accelerations)), arm=GALEN
    )
    at = Posture(
        np.atleast_2d(joints), None, None, np.zeros((1, 3)), motion, load, Load(0.0, np.zeros(3)),
        np.zeros(3), GALEN,
    )  # fmt: skip
    effect = InertialLoad(load.mass_kg, about_com)
    (wrench,) = effect.wrench(Instants("", np.zeros(1), np.zeros(1)), at)
    return wrench


def test_forces_of_acceleration_are_those_of_pinocchios_inverse_dynamics():
    rng = np.random.default_rng(4)
    load = Load(0.27, np.array([0.06, -0.01, 0.05]))
    model = PinocchioArm().model.copy()
    model.gravity.linear = GRAVITY_M_S2
    tilt = model.getJointId("tilt")
    frame = model.frames[model.getFrameId(GALEN.sensor_frame)].placement
    inertia = pinocchio.Inertia(load.mass_kg, load.com_m, tensor(TOOL_INERTIA))
    model.appendBodyToJoint(tilt, inertia, frame)
    data = model.createData()
    for _ in range(20):
        joints = GALEN.home + rng.uniform(-1.0, 1.0, 5) * [0.1, 0.1, 0.1, 1.5, 0.9]
        velocities, accelerations = rng.uniform(-2.0, 2.0, (2, 5)) * [1.0, 1.0, 1.0, 2.0, 2.0]
        pinocchio.rnea(model, data, joints, velocities, accelerations)
        # The joint carries the load; the load pulls the other way.
        expected = -frame.actInv(data.f[tilt]).vector
        found = np.array(inertial_wrench(load, TOOL_INERTIA, joints, velocities, accelerations))
        weight = np.cross(load.com_m, load.mass_kg * GALEN.gravity_in_sensor(joints[3:]))
        found[:3] += load.mass_kg * GALEN.gravity_in_sensor(joints[3:])
        found[3:] += weight
        assert np.abs(found - expected).max() < 1e-12
        assert np.abs(found[3:] - weight).max() > 1e-3


def test_the_plant_reads_the_change_of_momentum_along_its_own_path():
    # It obeys a command a period later, and goes the same way then.
    samples = move(make_plant("retractor", **EXACT, effects=(SWUNG,)))[1:]
    without = move(make_plant("retractor", **EXACT))[:-1]
    assert [s.true_joints for s in samples] == [s.true_joints for s in without]
    joints = np.array([sample.true_joints for sample in samples])
    reading = np.array([s.wrench for s in samples]) - [s.wrench for s in without]
    arm = PinocchioArm()
    poses = [arm.pose(q) for q in joints]
    rotation = np.array([pose[0] for pose in poses])
    origin = np.array([pose[1] for pose in poses])
    period_s = 0.002
    tool = TOOLS["retractor"].load
    expected = np.zeros_like(reading)
    for load, entries in ((ADAPTER, ADAPTER_INERTIA), (tool, TOOL_INERTIA)):
        # Momentum and angular momentum about the load's own centre, by central differences.
        centre = origin + rotation @ load.com_m
        turn = np.gradient(rotation, period_s, axis=0) @ rotation.transpose(0, 2, 1)
        rate = np.stack([turn[:, 2, 1], turn[:, 0, 2], turn[:, 1, 0]], axis=-1)
        inertia = rotation @ tensor(entries) @ rotation.transpose(0, 2, 1)
        spin = np.einsum("nij,nj->ni", inertia, rate)
        second = (centre[2:] - 2.0 * centre[1:-1] + centre[:-2]) / period_s**2
        force = np.zeros_like(centre)
        force[1:-1] = -load.mass_kg * second
        torque = np.cross(centre - origin, force) - np.gradient(spin, period_s, axis=0)
        expected[:, :3] += np.einsum("nji,nj->ni", rotation, force)
        expected[:, 3:] += np.einsum("nji,nj->ni", rotation, torque)
    # At its own stamp: a period earlier or later would be wrong by several percent.
    error = np.abs(reading[10:-10] - expected[10:-10]).max(axis=0)
    shifted = np.abs(reading[10:-10] - expected[9:-11]).max(axis=0)
    assert (error < 0.003 * np.abs(reading).max(axis=0) + 1e-6).all()
    assert (shifted > 3.0 * error).all()
    assert np.abs(reading[:, :3]).max() > 0.05
    assert np.abs(reading[-50:]).max() < 1e-12


# --- bias drift, sagging tool -------------------------------------------------------------------


def test_drift_is_what_was_asked_for_and_zeroing_takes_it_away_once():
    drift = np.array([3.0, -2.0, 9.0, 0.01, -0.02, 0.03])
    changes = {**EXACT, "start_joints": TURNED}
    plant = make_plant("retractor", effects=(SensorDrift(tuple(drift)),), **changes)
    nominal = np.array(make_plant("retractor", **changes).step().wrench)
    shift = np.array([sample.wrench for sample in run(plant, 1000)]) - nominal
    assert shift[-1] == pytest.approx(drift * 2.0 / 3600.0, rel=1e-9)
    assert shift[499] == pytest.approx(0.5 * shift[-1], rel=1e-9)
    plant.start_zeroing(0.002)
    plant.step()
    assert run(plant, 500)[-1].wrench == pytest.approx(drift * 1.0 / 3600.0, rel=1e-6, abs=1e-12)
