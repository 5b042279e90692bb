# SPDX-License-Identifier: Apache-2.0
"""The recordings in bags/: they are what README says, small, and made again the same."""

import dataclasses
import importlib.util
import json
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from galen_bags.arrays.arm_recording import read_arm
from galen_calibration_behavior.calibrate_from_bag import main as calibrate_from_bag
from galen_model.arm.galen import GALEN, SENSOR
from galen_model.files.calibration_file import read_calibration
from galen_model.load.inertia import point_mass_inertia
from galen_model.load.model import ADAPTER, TOOLS

BAGS = Path(__file__).resolve().parents[2] / "bags"


def _script():
    spec = importlib.util.spec_from_file_location("make_bags", BAGS / "make_bags.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


make_bags = _script()
RECIPES = {recipe.name: recipe for recipe in make_bags.RECIPES}


def test_readme_has_the_checksums_counts_and_sizes_of_what_is_there():
    text = (BAGS / "README.md").read_text(encoding="utf-8")
    assert f"{make_bags.BEGIN}\n{make_bags.table(BAGS)}\n{make_bags.END}" in text


def test_they_stay_small():
    total = sum(make_bags.size(BAGS / name) for name in [*RECIPES, "tools"])
    assert total < 20e6


@pytest.mark.parametrize("name", sorted(TOOLS))
def test_the_tools_files_hold_the_true_loads(name):
    tool = read_calibration(BAGS / "tools" / f"{name}.json", arm=GALEN)
    for found, true in ((tool.load, TOOLS[name].load), (tool.adapter, ADAPTER)):
        off = np.array([found.mass_kg - true.mass_kg, *(found.com_m - true.com_m)])
        sigmas = np.sqrt(off @ np.linalg.solve(found.covariance, off))
        assert sigmas < 4.5  # of four parameters: by chance in one file of two thousand
    assert tool.tip_m == pytest.approx(TOOLS[name].tip_m)
    assert (tool.poses_used, tool.poses_rejected, tool.unresolved) == (56, (), ())
    recipe = RECIPES[f"{name}_calibration"]
    assert tool.calibrated_at.startswith(f"{recipe.start:%Y-%m-%dT%H:03}")


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(TOOLS))
def test_the_recording_gives_the_file_that_the_calibration_itself_gave(name, tmp_path):
    bag = str(BAGS / f"{name}_calibration")
    calibrate_from_bag([name, bag, "--tools-dir", str(tmp_path), "--json"])
    file = f"{name}.json"
    live, recorded = (
        read_calibration(BAGS / "tools" / file, arm=GALEN),
        read_calibration(tmp_path / file, arm=GALEN),
    )
    # the same samples in the same averages, so the same numbers
    for found, expected in ((recorded.load, live.load), (recorded.adapter, live.adapter)):
        assert found.mass_kg == pytest.approx(expected.mass_kg, rel=1e-9)
        assert found.com_m == pytest.approx(expected.com_m, abs=1e-9)
    assert recorded.residual_offset == pytest.approx(live.residual_offset, abs=1e-9)


def test_nobody_touches_the_tool_in_free_motion():
    recording = read_arm(BAGS / "free_motion", arm=GALEN)
    tool = read_calibration(BAGS / "tools" / "retractor.json", arm=GALEN)
    left = recording.wrenches - tool.predict(recording.joints[:, 3:])
    assert np.sqrt(np.mean(left**2, axis=0)) == pytest.approx(SENSOR.noise_std, rel=0.05)
    moving = np.abs(recording.joint_velocities).max(axis=1) > 0.01
    assert 0.6 < moving.mean() < 0.8
    assert np.all(np.ptp(recording.joints, axis=0) > [0.08, 0.06, 0.06, 1.8, 1.1])


@pytest.mark.slow
def test_swings_tell_the_inertia_that_made_them(capsys):
    bag, tools = str(BAGS / "swings"), str(BAGS / "tools")
    options = ["--estimate", "inertia", "--tools-dir", tools, "--dry-run", "--json"]
    calibrate_from_bag(["retractor", bag, *options])
    found = json.loads(capsys.readouterr().out)
    points = point_mass_inertia(TOOLS["retractor"].load, ADAPTER)
    true = points + np.array(make_bags.INERTIA.own_inertia_kg_m2)
    off = np.array(found["inertia"]["about_sensor_kg_m2"]) - true
    covariance = np.array(found["inertia"]["covariance"])
    assert off @ np.linalg.solve(covariance, off) < 27.9  # of six: once in ten thousand
    assert np.abs(off).max() < 0.1 * np.abs(points - true).max()


@pytest.mark.slow
def test_the_cable_is_found_in_its_sweep(capsys):
    bag, tools = str(BAGS / "cable_sweep"), str(BAGS / "tools")
    options = ["--estimate", "cable", "--tools-dir", tools, "--dry-run", "--json"]
    calibrate_from_bag(["pointer", bag, *options])
    found = json.loads(capsys.readouterr().out)
    assert found["form"].startswith("point")
    assert found["attachment_m"] == pytest.approx(make_bags.CABLE.attachment_m, abs=2e-3)
    assert found["warnings"] == [text for text in found["warnings"] if "one place" in text]


def test_pushes_are_pushes_with_untouched_stretches_between():
    recording = read_arm(BAGS / "pushes", arm=GALEN)
    tool = read_calibration(BAGS / "tools" / "retractor.json", arm=GALEN)
    left = recording.wrenches - tool.predict(recording.joints[:, 3:])
    force = np.linalg.norm(left[:, :3], axis=1)
    assert force.max() == pytest.approx(10.0, abs=0.2)
    # 3 s of 250 Hz in a row without a touch, once at each of the four positions
    starts = np.flatnonzero(np.diff((force > 0.5).astype(int), prepend=1))
    longest = np.sort(np.diff(starts))[-4:]
    assert np.all(longest >= 3 * 250)


@pytest.fixture
def small(monkeypatch):
    """A recipe of a tenth of a second."""
    recipe = make_bags.Recipe(
        "small", 5, RECIPES["pushes"].start, 100.0, "pointer", 0.1,
        lambda cell, recipe, folder: cell.run(0.1),
    )  # fmt: skip
    monkeypatch.setattr(make_bags, "RECIPES", (recipe,))
    return recipe


def _folder(path):
    path.mkdir()
    (path / "README.md").write_text(f"# x\n\n{make_bags.BEGIN}\n{make_bags.END}\nend\n")
    return path


def test_what_differs_is_found_and_put_right(tmp_path, small):
    folder = _folder(tmp_path / "bags")
    assert make_bags.run([small], check=False, quiet=True, folder=folder)
    assert "| `small` | 5 |" in (folder / "README.md").read_text()
    assert make_bags.run([small], check=True, quiet=True, folder=folder) == []
    (file,) = (folder / "small").glob("*.mcap")
    before = file.read_bytes()
    file.write_bytes(before[:-200])
    assert make_bags.run([small], check=True, quiet=True, folder=folder)
    assert file.read_bytes() == before[:-200]
    assert make_bags.run([small], check=False, quiet=True, folder=folder)
    assert make_bags.run([small], check=True, quiet=True, folder=folder) == []
    other = dataclasses.replace(small, seed=6)
    (told,) = make_bags.run([other], check=True, quiet=True, folder=folder)
    assert "another content" in told
    assert sorted(p.name for p in folder.iterdir()) == ["README.md", "small"]


def test_a_tools_file_is_compared_number_by_number(tmp_path):
    recipe = dataclasses.replace(RECIPES["pointer_calibration"], name="free_motion")  # it is small
    made, kept = tmp_path / "made", tmp_path / "kept"
    for folder in (made, kept):
        shutil.copytree(BAGS / recipe.name, folder / recipe.name)
        shutil.copytree(BAGS / "tools", folder / "tools")
    assert make_bags.differences(recipe, made, kept) == []
    path = kept / recipe.tool_file
    content = json.loads(path.read_text())
    content["load"]["mass_kg"] *= 1 + 1e-5
    path.write_text(json.dumps(content))
    (told,) = make_bags.differences(recipe, made, kept)
    assert "other values" in told


@pytest.mark.soak
def test_all_are_made_again_the_same():
    assert make_bags.run(make_bags.RECIPES, check=True, quiet=True) == []
