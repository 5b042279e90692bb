# SPDX-License-Identifier: Apache-2.0
"""How an IMU is mounted, from still poses; and inertial forces by it, on tables."""

import json
from pathlib import Path

import numpy as np
import pytest
from galen_gravcomp.evaluate.command import main
from galen_model.errors import IdentificationError, NotExcitedError
from galen_model.load.inertia import fit_imu
from galen_model.rotation import rot_x, rot_y, rotvec_to_matrix

G = 9.80665
ROTVEC, BIAS, SCALE = np.array([0.4, -1.0, 0.7]), np.array([0.1, -0.2, 0.05]), 1.01
MEASURED = Path(__file__).resolve().parents[3] / "shared" / "data" / "real" / "kuka_ati_gamma"


def still(count=24, seed=0, noise=0.02):
    rng = np.random.default_rng(seed)
    gravity = rng.standard_normal((count, 3))
    gravity *= G / np.linalg.norm(gravity, axis=1, keepdims=True)
    read = SCALE * -gravity @ rotvec_to_matrix(ROTVEC) + BIAS
    return gravity, read + noise * rng.standard_normal(read.shape)


def test_rotation_scale_and_bias_are_found_to_the_noise():
    errors = []
    for seed in range(30):
        fit = fit_imu(*still(seed=seed))
        turned = rotvec_to_matrix(fit.mount.rotvec_rad).T @ rotvec_to_matrix(ROTVEC)
        errors.append(
            [
                np.arccos(np.clip((np.trace(turned) - 1) / 2, -1, 1)) * G,
                fit.mount.scale * G - SCALE * G,
                *(fit.mount.bias_m_s2 - BIAS),
                fit.std_m_s2.mean() - 0.02,
            ]
        )
    rms = np.sqrt(np.mean(np.square(errors), axis=0))
    # of 24 poses with 0.02 m/s^2: rotation about three axes sqrt(3 * 3 / 2 / 24), scale and bias
    # 1 / sqrt(24) each, of the noise
    limit = 0.02 * np.array([np.sqrt(4.5 / 24), *[np.sqrt(1 / 24)] * 4, np.sqrt(1 / 24)])
    assert np.all(rms < 1.6 * limit), rms / limit


def test_what_can_be_no_mount_is_rejected():
    gravity, read = still()
    with pytest.raises(IdentificationError, match="too few"):
        fit_imu(gravity[:3], read[:3])
    with pytest.raises(NotExcitedError, match="about two axes"):
        fit_imu(np.tile(gravity[0], (9, 1)), np.tile(read[0], (9, 1)))
    with pytest.raises(IdentificationError, match="are its units"):
        fit_imu(gravity, read / G)
    with pytest.raises(IdentificationError, match="right-handed"):
        fit_imu(gravity, -read)


def write(path, names, columns):
    lines = [",".join(names)] + [",".join(f"{v:.9g}" for v in row) for row in columns]
    path.write_text("\n".join(lines))
    return str(path)


def tables(folder, late_s=0.004):
    """A run that turns and shakes, the IMU's stamps late by `late_s`, each at its own rate."""
    rng = np.random.default_rng(3)
    mass, com = 0.9, np.array([0.0, 0.01, 0.044])
    offset = np.array([9.0, -1.0, 10.0, 0.4, -0.7, -0.2])

    def wrench(specific):
        force = mass * specific
        noise = np.array([0.02] * 3 + [1e-3] * 3) * rng.standard_normal((len(specific), 6))
        return np.hstack([force, np.cross(com, force)]) + offset + noise

    def gravity(t):
        angle = np.where(t < 4.0, 0.8 * (1 - np.cos(np.pi * t / 2.0)), 0.0)
        turn = rot_x(angle) @ rot_y(0.5 * angle)
        return np.einsum("nji,j->ni", turn, [0.0, 0.0, -G])

    def shake(t):
        size = np.where(t < 4.0, np.sin(np.pi * t / 4.0) ** 2, 0.0)
        waves = [np.sin(2 * np.pi * f * t + f) for f in (5.0, 7.0, 11.0)]
        return size[:, None] * np.stack(waves, axis=1)

    def imu(specific):
        return SCALE * -specific @ rotvec_to_matrix(ROTVEC) + BIAS

    poses, _ = still(24, 5)
    columns = np.hstack([wrench(poses), poses, imu(poses)])
    names = ["fx", "fy", "fz", "tx", "ty", "tz", "gx", "gy", "gz", "ax", "ay", "az"]
    still_file = write(folder / "still.csv", names, columns)
    t = 100.0 + np.arange(0.0, 6.0, 1 / 500)
    w = wrench(gravity(t - 100) - shake(t - 100))
    wrench_file = write(folder / "w.csv", ["t", *names[:6]], np.column_stack([1e3 * t, w]))
    t = 100.0 + np.arange(0.0, 6.0, 1 / 300)
    u = imu(gravity(t - 100) - shake(t - 100))
    stamps = 1e3 * (t + late_s)
    imu_file = write(folder / "i.csv", ["t", *names[9:]], np.column_stack([stamps, u]))
    t = 100.0 + np.arange(0.0, 6.0, 1 / 100)
    o = np.column_stack([1e3 * t, gravity(t - 100)])
    orientation_file = write(folder / "o.csv", ["t", *names[6:9]], o)
    return [still_file, "--run", wrench_file, imu_file, orientation_file]


def test_a_run_of_tables_is_scored_by_halves(tmp_path, capsys):
    args = [*tables(tmp_path), "--time-unit-s", "0.001"]
    assert main([*args, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    np.testing.assert_allclose(found["lag_of_halves_s"], 0.004, atol=3e-4)
    np.testing.assert_allclose(found["imu"]["rotvec_rad"], ROTVEC, atol=1e-3)
    everything = found["rms"]
    for axis, noise in (("fx", 0.02), ("fy", 0.02), ("fz", 0.02), ("tx", 1e-3), ("ty", 1e-3)):
        assert everything["weight only"][axis] > 5 * noise
        assert everything["with the IMU"][axis] < 1.15 * noise
        assert everything["at rest"][axis] == pytest.approx(noise, rel=0.1)
    assert main(args) == 0 and "with the IMU" in capsys.readouterr().out
    lines = (tmp_path / "o.csv").read_text().split("\n")
    (tmp_path / "o.csv").write_text("\n".join([*lines[:5], *lines[4:]]))
    assert main(args) == 1
    error = capsys.readouterr().err
    assert "o.csv: reading 5 has t = " in error and error.count("\n") == 1


@pytest.mark.skipif(not MEASURED.exists(), reason="the measured set is not here")
def test_the_measured_run_with_its_imu(capsys):
    parts = ("wrench", "accel", "orientations")
    names = ("0-calibration_fts-accel", *(f"1-baseline_{part}" for part in parts))
    still, *run = (str(MEASURED / f"{name}.csv") for name in names)
    args = [still, "--run", *run]
    units = ["--time-unit-s", "1e-6", "--imu-unit-m-s2", "9.80665", "--json"]
    assert main([*args, *units]) == 0
    found = json.loads(capsys.readouterr().out)
    np.testing.assert_allclose(found["lag_of_halves_s"], 0.0064, atol=5e-4)
    assert found["rms"]["with the IMU"]["fx"] < 0.8 * found["rms"]["weight only"]["fx"]
    assert found["rms"]["weight only"]["fx"] == pytest.approx(1.3, abs=0.1)
