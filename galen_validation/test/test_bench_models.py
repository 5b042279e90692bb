# SPDX-License-Identifier: Apache-2.0
"""The benchmark's own models: files that read, and that do what they are measured for."""

import numpy as np
from galen_deflection.models.file import read_model
from galen_model.arm.galen import GALEN

from galen_validation.nominal import write_bench_models
from galen_validation.speed.computing import six_joints


def test_its_models_read_and_work_and_one_remembers(tmp_path):
    joints, push = np.array([0.0, 0.0, 0.408, 0.1, 0.2]), np.array([0.0, 8.0, 2.0, 0.1, 0.1, 0.0])
    left = {}
    for path in write_bench_models(tmp_path):
        stream = read_model(path, arm=GALEN).stream()
        bent = stream.step(0, joints, push)
        assert np.linalg.norm(bent.mean[:3]) > 1e-4 and not bent.extrapolated
        left[path.stem] = np.linalg.norm(stream.step(2_000_000, joints, np.zeros(6)).mean)
    assert left == {"joint_stiffness": 0.0, "joint_hysteresis": left["joint_hysteresis"]}
    assert left["joint_hysteresis"] > 0.0


def test_six_joints_are_timed_live_and_in_arrays_against_pinocchio():
    live, arrays = six_joints(1, samples=256)
    assert 0.0 < arrays.time_s[1] < live.time_s[1] < 1e-3
    assert live.baseline_s == arrays.baseline_s
