"""Fast free motion of the arm, and what a sensor reads in it by Pinocchio: the second method."""

import calibration_files
import numpy as np
import pinocchio
from galen_model.arm.description import PinocchioArm
from galen_model.arm.galen import ENCODER_QUANTUM, GALEN, SENSOR
from galen_model.load.inertia import InertiaEstimate, inertia_matrix, point_mass_inertia
from galen_model.load.model import Load, gravity_wrench

MS = 1_000_000
START_NS = 1_000_000_000_000
TOOL, ADAPTER = Load(0.2, np.array([0.07, -0.01, 0.055])), Load(0.1, np.array([0, 0, 0.02]))
OWN_KG_M2 = np.array([3e-4, 5e-4, 4e-4, 2e-5, -4e-5, 1e-5])
"""Of both loads about their centres."""
INERTIA = point_mass_inertia(TOOL, ADAPTER) + OWN_KG_M2

FASTEST = np.array([0.2, 0.2, 0.2, 1.5, 1.5])
STRONGEST = np.array([1.0, 1.0, 1.0, 6.0, 6.0])
"""The arm's limits in free motion, m/s, rad/s and m/s^2, rad/s^2."""


def swing(times, share=1.0):
    """Positions, velocities, accelerations (n, 5): each joint swings at `share` of its limits."""
    rates = STRONGEST / FASTEST * np.array([0.9, 1.0, 0.8, 0.95, 0.9])
    size = share * np.minimum(FASTEST / rates, STRONGEST / rates**2)
    angle = np.outer(times, rates) + np.arange(5.0)
    return (
        GALEN.home + size * np.sin(angle),
        size * rates * np.cos(angle),
        -size * rates**2 * np.sin(angle),
    )


def readings(motion):
    """Readings (n, 6) without noise, zeroed at home with the adapter on, by Pinocchio's bodies."""
    arm = PinocchioArm()
    frame = arm.model.getFrameId("ft_sensor")
    data = arm.model.createData()
    mass = TOOL.mass_kg + ADAPTER.mass_kg
    centre = (TOOL.moments + ADAPTER.moments)[1:] / mass
    about_centre = inertia_matrix(INERTIA) - inertia_matrix(point_mass_inertia(Load(mass, centre)))
    body = pinocchio.Inertia(mass, centre, about_centre)
    gravity = pinocchio.Motion(np.array([0.0, 0.0, -9.80665]), np.zeros(3))
    rows = []
    for q, v, a in zip(*motion, strict=True):
        pinocchio.forwardKinematics(arm.model, data, q, v, a)
        pinocchio.updateFramePlacements(arm.model, data)
        at = (arm.model, data, frame, pinocchio.LOCAL)
        twist = pinocchio.getFrameVelocity(*at)
        turned = pinocchio.SE3(data.oMf[frame].rotation, np.zeros(3))
        felt = pinocchio.getFrameAcceleration(*at) - turned.actInv(gravity)
        rate = body * felt + twist.cross(body * twist)
        rows.append(-np.r_[rate.linear, rate.angular])
    home = pinocchio.SE3(arm.pose(GALEN.home)[0], np.zeros(3)).actInv(gravity).linear
    return np.array(rows) - gravity_wrench(home, ADAPTER)


def measured(motion, rng):
    """Joints (n, 5) by the encoders, wrenches (n, 6) with the sensor's noise and quanta."""
    joints = np.round(motion[0] / ENCODER_QUANTUM) * ENCODER_QUANTUM
    wrench = readings(motion)
    wrench = wrench + SENSOR.noise_std * rng.standard_normal(wrench.shape)
    return joints, np.round(wrench / SENSOR.quantum) * SENSOR.quantum


def tool_file(with_inertia=True):
    inertia = InertiaEstimate(INERTIA, np.eye(6) * 1e-12) if with_inertia else None
    return calibration_files.tool_file(std=1e-6, inertia=inertia)
