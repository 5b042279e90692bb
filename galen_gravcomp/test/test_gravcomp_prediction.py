"""The fast prediction is the tool file's own."""

import numpy as np
from galen_model.files.calibration_file import CalibrationFile, LoadEstimate, zeroed_at
from galen_model.load.prediction import Prediction


def test_equals_the_tool_file_at_every_pose() -> None:
    rng = np.random.default_rng(7)
    for _ in range(5):
        tool = CalibrationFile(
            tool="any",
            load=LoadEstimate(rng.uniform(0.05, 2.0), rng.normal(0, 0.1, 3), np.eye(4)),
            adapter=LoadEstimate(rng.uniform(0.05, 2.0), rng.normal(0, 0.1, 3), np.eye(4)),
            tip_m=np.zeros(3),
            rmse=np.zeros(6),
            poses_used=56,
            calibrated_at="2026-01-01T00:00:00+00:00",
            residual_offset=rng.normal(0, 0.1, 6),
            zeroing=zeroed_at(*rng.uniform(-1, 1, 2)),
            gravity_m_s2=np.array([0.0, 0.0, -9.81]),
        )
        prediction = Prediction(tool)
        for roll, tilt in rng.uniform(-np.pi, np.pi, (50, 2)):
            np.testing.assert_allclose(
                prediction.reading(float(roll), float(tilt)),
                tool.predict(roll, tilt),
                rtol=0,
                atol=1e-13,
            )


def test_readings_are_those_of_single_poses() -> None:
    rng = np.random.default_rng(8)
    load = LoadEstimate(0.3, rng.normal(0, 0.1, 3), np.eye(4))
    tool = CalibrationFile(
        tool="any",
        load=load,
        adapter=load,
        tip_m=np.zeros(3),
        rmse=np.zeros(6),
        poses_used=56,
        calibrated_at="2026-01-01T00:00:00+00:00",
        residual_offset=rng.normal(0, 0.1, 6),
    )
    prediction = Prediction(tool)
    roll, tilt = rng.uniform(-4.0, 4.0, size=(2, 100))
    single = [prediction.reading(*pair) for pair in zip(roll.tolist(), tilt.tolist(), strict=True)]
    np.testing.assert_allclose(prediction.readings(roll, tilt), single, rtol=1e-13, atol=1e-15)
    assert prediction.readings(roll[:0], tilt[:0]).shape == (0, 6)
