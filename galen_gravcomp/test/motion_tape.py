# SPDX-License-Identifier: Apache-2.0
"""Fast free motion of the arm, and what a sensor reads in it by Pinocchio: the second method."""

import calibration_files
import numpy as np
import pinocchio
from galen_model.arm.galen import GALEN, SENSOR
from galen_model.files.calibration_file import zeroed_at
from galen_model.load.inertia import InertiaEstimate, inertia_matrix, point_mass_inertia
from galen_model.load.model import Load, gravity_wrench

MS = 1_000_000
START_NS = 1_000_000_000_000
TOOL, ADAPTER = Load(0.2, np.array([0.07, -0.01, 0.055])), Load(0.1, np.array([0, 0, 0.02]))
OWN_KG_M2 = np.array([3e-4, 5e-4, 4e-4, 2e-5, -4e-5, 1e-5])
"""Of both loads about their centres."""
INERTIA = point_mass_inertia(TOOL, ADAPTER) + OWN_KG_M2


def swing(times, share=1.0, arm=GALEN):
    """Positions, velocities, accelerations (n, d): each joint swings at `share` of its limits."""
    fastest, strongest = arm.by_unit(0.2, 1.5), arm.by_unit(1.0, 6.0)
    rates = strongest / fastest * np.resize([0.9, 1.0, 0.8, 0.95, 0.9], len(fastest))
    size = share * np.minimum(fastest / rates, strongest / rates**2)
    angle = np.outer(times, rates) + np.arange(float(len(fastest)))
    return (
        arm.home + size * np.sin(angle),
        size * rates * np.cos(angle),
        -size * rates**2 * np.sin(angle),
    )


def readings(motion, arm=GALEN):
    """Readings (n, 6) without noise, zeroed at home with the adapter on, by Pinocchio's bodies."""
    model = pinocchio.buildModelFromXML(arm.urdf)
    frame = model.getFrameId("ft_sensor")
    data = model.createData()
    mass = TOOL.mass_kg + ADAPTER.mass_kg
    centre = (TOOL.moments + ADAPTER.moments)[1:] / mass
    about_centre = inertia_matrix(INERTIA) - inertia_matrix(point_mass_inertia(Load(mass, centre)))
    body = pinocchio.Inertia(mass, centre, about_centre)
    gravity = pinocchio.Motion(arm.gravity_m_s2, np.zeros(3))
    rows = []
    for q, v, a in zip(*motion, strict=True):
        pinocchio.forwardKinematics(model, data, q, v, a)
        pinocchio.updateFramePlacements(model, data)
        at = (model, data, frame, pinocchio.LOCAL)
        twist = pinocchio.getFrameVelocity(*at)
        turned = pinocchio.SE3(data.oMf[frame].rotation, np.zeros(3))
        felt = pinocchio.getFrameAcceleration(*at) - turned.actInv(gravity)
        rate = body * felt + twist.cross(body * twist)
        rows.append(-np.r_[rate.linear, rate.angular])
    pinocchio.framesForwardKinematics(model, data, np.array(arm.home))
    home = data.oMf[frame].rotation.T @ gravity.linear
    return np.array(rows) - gravity_wrench(home, ADAPTER)


def measured(motion, rng, arm=GALEN):
    """Joints (n, d) by the encoders, wrenches (n, 6) with the sensor's noise and quanta."""
    quantum = arm.by_unit(5e-6, 5e-5)
    joints = np.round(motion[0] / quantum) * quantum
    wrench = readings(motion, arm)
    wrench = wrench + SENSOR.noise_std * rng.standard_normal(wrench.shape)
    return joints, np.round(wrench / SENSOR.quantum) * SENSOR.quantum


def tool_file(with_inertia=True, arm=GALEN, **fields):
    inertia = InertiaEstimate(INERTIA, np.eye(6) * 1e-12) if with_inertia else None
    known = {"arm": arm, "zeroing": zeroed_at(arm=arm), "gravity_m_s2": arm.gravity_m_s2}
    return calibration_files.tool_file(std=1e-6, inertia=inertia, **known, **fields)
