# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from galen_bags.arrays.tables import read_table
from galen_model.arm.galen import GALEN, WRENCH_AXES
from galen_model.errors import GalenError

from galen_validation.blind.baselines import RMSE_DROP
from galen_validation.blind.case import TELLABLE, Case, generate
from galen_validation.blind.diagnosing import PROGRAM, diagnosed
from galen_validation.blind.measured_tables import CLEAR, DRAWN, EARLIER, TABLE, pair_of

MASS_KG, COM_M = 0.9, np.array([0.002, -0.004, 0.045])
SIGMA = np.array([0.03] * 3 + [0.001] * 3)


@pytest.fixture(scope="module")
def table(tmp_path_factory):
    """48 readings of 0.9 kg under directions of gravity all over the sphere."""
    random = np.random.default_rng(1)
    gravity = random.standard_normal((48, 3))
    gravity *= 9.80665 / np.linalg.norm(gravity, axis=1, keepdims=True)
    wrench = np.concatenate([MASS_KG * gravity, np.cross(COM_M, MASS_KG * gravity)], axis=1)
    wrench += [1.0, -2.0, 0.5, 0.01, 0.02, -0.03] + SIGMA * random.standard_normal((48, 6))
    path = tmp_path_factory.mktemp("measured") / "sensor.csv"
    header = ",".join((*WRENCH_AXES, "gx", "gy", "gz"))
    rows = np.concatenate([wrench, gravity], axis=1)
    np.savetxt(path, rows, delimiter=",", header=header, comments="")
    return path


@pytest.mark.parametrize("effect", DRAWN)
def test_the_effect_and_nothing_else_is_put_into_every_other_reading(table, effect):
    whole = read_table(table, arm=GALEN)
    pair = pair_of(table, 3, effect, TELLABLE)
    assert sorted([*pair.earlier_rows, *pair.later_rows]) == list(range(len(whole)))
    change = pair.later - whole.wrench[pair.later_rows]
    gravity = whole.gravity[pair.later_rows]
    force = MASS_KG * gravity
    load = np.concatenate([force, np.cross(COM_M, force)], axis=1)
    true = pair.parameters
    expected = {
        "axis_gain": lambda: np.array(true["gain"]) * load,
        "crosstalk": lambda: (
            true["coefficient"]
            * load[:, [WRENCH_AXES.index(true["from"])]]
            * np.eye(6)[WRENCH_AXES.index(true["to"])]
        ),
        "sensor_mount_rotation": lambda: np.concatenate(  # to first order
            [np.cross(part, true["rotvec_rad"]) for part in (force, load[:, 3:])], axis=1
        ),
        "sensor_nonlinearity": lambda: (
            true["coefficient"] * load**2 * np.eye(6)[WRENCH_AXES.index(true["axis"])]
        ),
        "bias_step": lambda: (np.any(change != 0.0, axis=1))[:, None] * np.array(true["step"]),
        "tool_com_error": lambda: np.concatenate(
            [np.zeros_like(force), np.cross(true["delta_m"], force)], axis=1
        ),
        "tool_mass_error": lambda: true["delta_kg"] / MASS_KG * load,
    }[effect]()
    assert np.max(np.abs(change - expected)) < 0.05 * np.max(np.abs(change))
    assert 0.99 * CLEAR < pair.d < 4.1 * CLEAR and pair.acceptable[0] == effect


def test_how_clear_an_effect_is_by_an_estimate_of_its_size(table):
    whole = read_table(table, arm=GALEN)
    pair = pair_of(table, 5, "tool_mass_error", TELLABLE)
    gravity = whole.gravity[pair.later_rows]
    load = MASS_KG * np.concatenate([gravity, np.cross(COM_M, gravity)], axis=1)
    rows = (load - load.mean(axis=0)) / (np.sqrt(2.0) * SIGMA)
    deviation = MASS_KG / np.linalg.norm(rows)  # of a fitted mass, both halves being as noisy
    assert pair.d == pytest.approx(abs(pair.parameters["delta_kg"]) / deviation, rel=0.15)


def test_a_pair_from_the_case_to_the_answers(table, tmp_path):
    folder = tmp_path / "pair"
    case = Case(7, "table", ("tool_com_error",), arm="sensor", table=table)
    truth = generate(case, folder)
    assert {path.name for path in folder.iterdir()} == {TABLE, EARLIER}
    assert truth.strength == "clear"
    answers = diagnosed(folder)
    for method in (PROGRAM, RMSE_DROP):
        assert [one["effect"] for one in answers[method]["causes"]] == ["tool_com_error"]


def test_a_table_with_too_few_readings_is_named(table, tmp_path):
    path = tmp_path / "few.csv"
    path.write_text("\n".join(table.read_text().splitlines()[:9]))
    with pytest.raises(GalenError, match=r"few\.csv: 8 readings; a pair needs at least 16"):
        pair_of(path, 1, None, TELLABLE)
