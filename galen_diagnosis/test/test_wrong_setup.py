# SPDX-License-Identifier: Apache-2.0
"""A wrong set-up is named before a cause is looked for; what can't be told apart is one answer."""

import json
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest
from galen_diagnosis.diagnose import main
from galen_diagnosis.inference.posterior import (
    Scored,
    Settings,
    excused,
    merge_equivalents,
    posterior,
)
from galen_diagnosis.observation.recording import (
    BagData,
    DiagnosticRecording,
    require_sound_setup,
)
from galen_diagnosis.observation.specification import Specification
from galen_model.arm.galen import GALEN
from galen_model.load.model import Load, gravity_wrench
from galen_model.rotation import rot_y
from galen_model.setup_check.check import SetupError
from scipy.spatial.transform import Rotation

LOAD = Load(0.5, np.array([0.01, -0.02, 0.06]))
NOISE = np.array([0.02, 0.02, 0.02, 1e-3, 1e-3, 1e-3])
DOWN = np.array([0.0, 0.0, -9.80665])


def table(path, inclined_deg, repeats=1, count=24, odd_n=0.0):
    """Readings at orientations of a base that is inclined about y; odd_n: each is off by this."""
    rng = np.random.default_rng(4)
    rotation = Rotation.random(count, rng).as_matrix()
    gravity = rot_y(np.radians(inclined_deg)).T @ DOWN
    wrench = gravity_wrench(np.einsum("nji,j->ni", rotation, gravity), LOAD)
    wrench += odd_n * np.repeat([1.0, 0.05], 3) * rng.normal(size=wrench.shape)
    wrench += NOISE * rng.normal(size=wrench.shape)
    rows = np.hstack([wrench, Rotation.from_matrix(rotation).as_quat()])
    lines = [",".join(f"{value:.6f}" for value in row) for row in rows for _ in range(repeats)]
    path.write_text("\n".join(["fx,fy,fz,tx,ty,tz,qx,qy,qz,qw", *lines]) + "\n")
    return str(path)


def test_a_table_of_an_inclined_base_is_not_called_a_cable(tmp_path, capsys):
    options = ("--output", str(tmp_path / "found"), "--no-report")
    tilted = table(tmp_path / "t.csv", 20.0)
    assert main([tilted, *options]) == 1
    error = capsys.readouterr().err
    assert "base_link is inclined by 20.0 deg about +y" in error and "--gravity" in error
    assert not (tmp_path / "found").exists()
    assert main([tilted, *options, "--gravity", "3.35407", "0", "-9.21524"]) == 0
    assert "cable" not in capsys.readouterr().out.split("not identifiable")[0].split("tested")[0]


def diagnosed(path, tmp_path, *options):
    out = tmp_path / "found"
    assert main([path, "--output", str(out), "--no-report", "--overwrite", *options]) == 0
    return json.loads((out / "diagnosis.json").read_text())


@pytest.mark.slow
@pytest.mark.parametrize("inclined_deg", [4.0, 20.0])
def test_a_large_inclination_is_found_with_its_angle(tmp_path, inclined_deg):
    path = table(tmp_path / "t.csv", inclined_deg, count=12)
    found = diagnosed(path, tmp_path, "--no-setup-check")
    (cause,) = found["causes"]
    assert cause["effect"] == "base_inclination"
    about_y = np.degrees(cause["parameters"]["about_y_rad"]["value"])
    assert about_y == pytest.approx(inclined_deg, abs=0.3)


def test_a_healthy_table_without_a_known_noise_has_no_gap(tmp_path):
    found = diagnosed(table(tmp_path / "t.csv", 0.0, count=12), tmp_path)
    assert found["verdict"] == "none" and found["gap"]["closed_fraction"] is None
    assert "the noise isn't known" in found["problems"][0]


@pytest.mark.slow
def test_a_scatter_of_a_third_of_the_weight_is_not_taken_for_noise(tmp_path):
    path = table(tmp_path / "t.csv", 0.0, count=12, odd_n=1.5)
    assert diagnosed(path, tmp_path)["verdict"] == "unknown"


def test_repeated_rows_count_once_and_have_an_answer(tmp_path, capsys):
    repeated = table(tmp_path / "t.csv", 0.0, repeats=2, count=12)
    assert main([repeated, "--output", str(tmp_path / "found"), "--no-report"]) == 0
    out = " ".join(capsys.readouterr().out.split())
    assert "12 rows repeat another one: counted once" in out


def recording(gravity):
    """A sweep of still poses under another gravity than the tool's file says."""
    rng = np.random.default_rng(5)
    poses = [(roll, tilt) for roll in (-1.2, -0.4, 0.4, 1.2) for tilt in (-0.9, 0.0, 0.8)]
    angles = np.repeat(np.array(poses), 200, axis=0)
    joints = GALEN.with_angles(angles)
    down = GALEN.direction_in_sensor(angles, gravity)
    wrench = gravity_wrench(down, LOAD) + NOISE * rng.normal(size=(len(angles), 6))
    at_s = 0.01 * np.arange(len(angles))
    bag = BagData("sweep", 0.0, at_s, joints, at_s, wrench, None, None)
    tool = SimpleNamespace(mounting=None)
    return DiagnosticRecording(
        "r", tool, {"sweep": bag}, (), (), GALEN, Specification("none", "", {})
    )


def test_a_recording_of_an_arm_on_a_wall_is_not_diagnosed():
    require_sound_setup(recording(DOWN))
    require_sound_setup(recording(rot_y(np.radians(3.0)).T @ DOWN))  # an effect like others
    with pytest.raises(SetupError, match="mounted on a wall"):
        require_sound_setup(recording(np.array([9.80665, 0.0, 0.0])))


def weighed(names, rows):
    return SimpleNamespace(hypothesis=SimpleNamespace(names=names, raw_rows=np.array(rows)))


@dataclass(frozen=True)
class Fitted:
    """A hypothesis; of what another one gains beside it its models may miss nine tenths."""

    names: tuple[str, ...]
    energy: float
    log_bayes: float
    shown: tuple[float, ...] = (1.0, 1.0)

    def looks_like(self, signature, but):
        return 0.9


def test_what_models_may_miss_is_excused_once_in_whatever_forms_the_fuller_set_was_fitted():
    single = Fitted(("friction",), 1000.0, 100.0)
    pairs = [Fitted(("friction", "drift"), 100.0 + k, 500.0 - k) for k in range(3)]
    for fuller in (pairs[:1], pairs, [*pairs, Fitted(("friction", "step"), 400.0, 350.0)]):
        (found,) = [
            one
            for one in excused(SimpleNamespace(weighed=(*fuller, single)))
            if one.names == single.names
        ]
        assert found.energy == pytest.approx(190.0)
        assert found.log_bayes == pytest.approx(505.0)


def test_sets_that_the_rows_can_not_distinguish_are_one_answer_whatever_numbers_they_have():
    behind = SimpleNamespace(sum_of_squares=lambda rows: float(rows @ rows))
    of = [
        weighed(("zero:a",), [0.0, 1.0]),
        weighed(("zero:b",), [0.0, 1.5]),
        weighed(("base",), [0.5, 1.0]),
        weighed(("cable",), [30.0, 1.0]),
        weighed((), [99.0, 99.0]),
    ]
    sums = [
        Scored(("zero:a",), 1.0, 4.0),
        Scored(("zero:b",), 1.1, 4.0),
        Scored(("base",), 0.9, 12.0),
        Scored(("cable",), 40.0, 4.0),
        Scored((), 900.0, 0.0),
    ]
    merged, alike = merge_equivalents(behind, of, sums)
    assert [one.names for one in merged] == [("zero:a",), ("cable",), ()]
    assert (merged[0].energy, merged[0].occam) == (0.9, 4.0)
    assert alike == {frozenset({"zero:a"}): (frozenset({"zero:b"}), frozenset({"base"}))}
    apart = posterior(sums[:1] + sums[3:], Settings()).effects["zero:a"]
    together = posterior(merged, Settings()).effects["zero:a"]
    assert together == pytest.approx(apart, abs=0.01)  # the names add nothing
