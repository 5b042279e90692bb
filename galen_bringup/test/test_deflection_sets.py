"""The recordings that models are compared on: what the hand does, and what its pushes leave."""

import importlib.util
import sys
from datetime import UTC, datetime
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from galen_deflection.measurement.pushes import find_pushes, tip_wrench
from galen_deflection.measurement.recordings import ReadSettings, read_recording
from galen_deflection.models import joint_stiffness
from galen_deflection.scoring.score import score
from galen_sim_driver.plant.config import PlantConfig

BAGS = Path(__file__).resolve().parents[2] / "bags"


def _module(name):
    spec = importlib.util.spec_from_file_location(name, BAGS / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


deflection_sets = _module("deflection_sets")


def test_the_hand_pushes_every_way_and_never_twice_the_same():
    pushes, ends_s = deflection_sets.script(3, seed=4)
    PlantConfig(hand=pushes).validate()
    assert len(pushes) == 90
    for push, following in pairwise(pushes):
        assert following.start_s - (push.start_s + push.duration_s) >= 0.3
    begins_s = [pushes[30 * visit].start_s for visit in range(3)]
    # After the pushes before: a move of 2 s, and 3 s untouched.
    assert np.all(np.array(begins_s) - [0.0, *ends_s[:2]] > 5.0)
    loads = np.array([[*push.force_n, *push.torque_nm] for push in pushes]).reshape(3, 30, 6)
    main = np.argmax(np.abs(loads) > 0.5 * np.abs(loads).max(axis=2, keepdims=True), axis=2)
    assert np.array_equal(main, np.tile(np.repeat(np.arange(6), [6, 6, 6, 4, 4, 4]), (3, 1)))
    peak = np.take_along_axis(loads, main[:, :, None], axis=2)[:, :, 0]
    level = np.array([3.0, 6.0, 10.0] * 6 + [0.3, 0.8] * 6)
    assert np.all(np.abs(np.abs(peak) / level - 1.0) <= 0.15)
    assert len(np.unique(peak)) == 90
    aside = np.linalg.norm(loads, axis=2) / np.abs(peak)
    assert 1.0 < np.median(aside) < 1.05
    assert deflection_sets.script(3, seed=4) == (pushes, ends_s)
    assert deflection_sets.script(3, seed=5)[0] != pushes


@pytest.mark.slow
def test_a_visit_is_recorded_with_what_its_pushes_leave(tmp_path):
    make_bags = _module("make_bags")
    hand, ends_s = deflection_sets.script(1, seed=4)
    drive = partial(
        deflection_sets.play, positions=deflection_sets.EXTRA_POSITIONS[:1], ends_s=ends_s
    )
    recipe = make_bags.Recipe(
        "sets/one", 4, datetime(2026, 3, 3, 12, tzinfo=UTC), 200.0, "retractor", 50.0, drive,
        tracker=True, hand=hand, hysteresis_fraction=deflection_sets.RESIDUAL_FRACTION,
    )  # fmt: skip
    make_bags.make(recipe, tmp_path, quiet=True)
    tool = ReadSettings(BAGS / "tools" / "retractor.json")
    samples = read_recording(tmp_path / "sets" / "one", tool).samples
    found = find_pushes(samples, tip_wrench(samples))
    assert len(found) == 30
    loaded = [abs(tip_wrench(samples)[push.peak]).max() for push in found]
    pushed = max(abs(value) for push in hand for value in push.force_n)
    assert max(loaded) == pytest.approx(pushed, rel=0.02)
    # Springs alone can't say it: the loops have an area, and something is left at no load.
    springs = joint_stiffness.fit(samples)
    result = score(samples, springs.predict(samples))
    assert result.loops.measured.sum() > 5.0 * np.linalg.norm(result.loops.noise)
    assert result.rests.truth_rms(slice(0, 3)) > 1e-5


def test_sets_are_made_only_into_a_new_folder_and_alone(tmp_path, capsys):
    make_bags = _module("make_bags")
    assert make_bags.main(["--deflection-sets", str(tmp_path)]) == 1
    assert f"{tmp_path}: is there already" in capsys.readouterr().err
    with pytest.raises(SystemExit) as ended:
        make_bags.main(["--deflection-sets", str(tmp_path / "new"), "--check"])
    assert ended.value.code == 2
    assert list(tmp_path.iterdir()) == []
