# SPDX-License-Identifier: Apache-2.0
"""Pushes made up for tests of scores and pictures."""

import numpy as np
from galen_deflection.measurement.samples import DeflectionSamples
from galen_deflection.models.interface import PredictedSamples
from galen_model.arm.galen import GALEN
from galen_model.registration import move_wrench

TIP = np.array([0.18, 0.01, 0.05])
JOINTS = np.array([0.03, -0.05, 0.45, 0.8, -0.6])
NOISE = np.array([3e-5, 3e-5, 3e-5, 1e-4, 1e-4, 1e-4])


def make_samples(
    at_tip, deflection, *, joints=JOINTS, segment=0, position=0, set_number=0, noise=NOISE
):
    """Samples with these wrenches (n, 6) at the tip in base_link, at one place."""
    at_tip = np.asarray(at_tip, dtype=float)
    count = len(at_tip)
    rotation, origin = GALEN.sensor_pose(joints)
    _, tip = GALEN.tip_pose(joints, TIP)
    wrench = move_wrench(at_tip, rotation.T, rotation.T @ (tip - origin))
    return DeflectionSamples(
        stamp_ns=1_700_000_000_000_000_000 + np.arange(count) * 10_000_000,
        segment=np.full(count, segment),
        position=np.full(count, position),
        set_number=np.full(count, set_number),
        joints=np.tile(joints, (count, 1)),
        wrench=wrench,
        deflection=np.asarray(deflection, dtype=float),
        tip_m=TIP,
        noise=np.asarray(noise, dtype=float),
        arm=GALEN,
    )


def predict(mean, variance=0.0, extrapolated=None):
    mean = np.asarray(mean, dtype=float)
    covariance = np.tile(np.diag(np.broadcast_to(variance, 6)), (len(mean), 1, 1))
    outside = np.zeros(len(mean), dtype=bool) if extrapolated is None else np.array(extrapolated)
    return PredictedSamples(mean, covariance, outside)


def along(axis, values):
    result = np.zeros((len(values), 6))
    result[:, axis] = values
    return result


def pushes_along(axis, levels, rest=30, ramp=25, hold=50):
    """Loads (n, 6): for each level a half cosine up, a hold, a half cosine down, and a pause."""
    edge = 0.5 - 0.5 * np.cos(np.pi * np.arange(1, ramp + 1) / ramp)
    one = np.concatenate([edge, np.ones(hold), edge[::-1][1:], np.zeros(rest)])
    return along(axis, np.concatenate([np.zeros(rest), *(level * one for level in levels)]))


def hysteretic(seed=2):
    """Samples whose model predicts half of what is left and of the loops."""
    rng = np.random.default_rng(seed)
    load = pushes_along(1, [10.0, -10.0] * 4)
    # Left behind: a fifth of the way of the last push, gained while it lets go.
    left = np.zeros(len(load))
    for k in range(8):
        end = 30 + 129 * k + 80
        left[end : end + 129] = 2e-4 * (1.0 if k % 2 == 0 else -1.0)
    elastic = 1e-4 * load
    samples = make_samples(load, elastic + along(1, left) + NOISE * rng.standard_normal(load.shape))
    return samples, predict(elastic + along(1, 0.5 * left), variance=1e-10)
