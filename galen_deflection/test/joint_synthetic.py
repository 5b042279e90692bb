# SPDX-License-Identifier: Apache-2.0
"""Transmissions made for the tests, of laws that none of the models has.

Springs with Dahl's friction under a torque, and lost motion that friction takes up over a length
(Dahl's law in the motion): both turn smoothly where plays have corners.
"""

import numpy as np
from deflection_synthetic import dahl
from galen_model.transmission import JointRun

RATE_HZ = 100.0
STIFFNESS = 5e3  # N.m/rad
FRICTION_NM = 12.0
LOST_RAD = 4e-3  # from one side to the other
NOISE_RAD = 5e-5


def motion(seconds, seed, rate_hz=RATE_HZ):
    """Motor's angle (n,), rad: strokes of different lengths, and time (n,), s."""
    random = np.random.default_rng(seed)
    time_s = np.arange(round(seconds * rate_hz)) / rate_hz
    hz, phase = 0.25 + 0.1 * random.random(), 2.0 * np.pi * random.random()
    slow = 1.0 + 0.4 * np.sin(2.0 * np.pi * 0.06 * time_s + phase)
    return time_s, 0.3 * slow * np.sin(2.0 * np.pi * hz * time_s)


def load(time_s, seed, largest=60.0):
    """Torque (n,), N.m: pushes of different sizes, both ways."""
    random = np.random.default_rng(seed + 100)
    hz = 0.31 + 0.1 * random.random()
    size = 0.6 + 0.4 * np.sin(2.0 * np.pi * 0.07 * time_s + 6.0 * random.random())
    return largest * size * np.sin(2.0 * np.pi * hz * time_s)


def taken_up(motor, lost, length):
    """Lag (n,) of lost motion that a motion of about `length` takes up, exponentially."""
    half, z = 0.5 * lost, 0.0
    lag = np.empty_like(motor)
    for k, dx in enumerate(np.diff(motor, prepend=motor[0])):
        side = np.sign(dx) * half
        z = side + (z - side) * np.exp(-abs(dx) / length)
        lag[k] = z
    return lag


def dahl_run(name, seed, seconds=20.0, noise=NOISE_RAD, delay_s=0.0):
    """A spring with Dahl's friction; the link's clock may be late."""
    time_s, motor = motion(seconds, seed)
    torque = load(time_s, seed)
    lag = dahl(torque, STIFFNESS, FRICTION_NM, steps=2)
    link = np.interp(time_s - delay_s, time_s, motor - lag)
    return JointRun(name, time_s, motor, link + noise * white(len(time_s), seed), torque)


def lost_run(name, seed, seconds=20.0):
    """A spring without friction, and lost motion."""
    time_s, motor = motion(seconds, seed)
    torque = load(time_s, seed)
    lag = torque / STIFFNESS + taken_up(motor, LOST_RAD, 3e-3)
    return JointRun(name, time_s, motor, motor - lag + NOISE_RAD * white(len(time_s), seed), torque)


def spring_run(name, seed, noise, seconds=20.0):
    """A spring and white noise, nothing else."""
    time_s, motor = motion(seconds, seed)
    torque = load(time_s, seed)
    link = motor - torque / STIFFNESS + noise * white(len(time_s), seed)
    return JointRun(name, time_s, motor, link, torque)


def white(count, seed):
    return np.random.default_rng(seed + 1000).standard_normal(count)


def write_csv(path, run, header="t,motor,link,torque"):
    """A run as a table."""
    rows = np.column_stack([run.time_s, run.motor, run.link, run.torque])
    np.savetxt(path, rows, delimiter=",", header=header, comments="", fmt="%.9g")
    return path
