import numpy as np
import pytest
from galen_model.poses.plan import GridError, SweepGrid

LOWER, UPPER = (-1.57, -1.04), (1.57, 0.96)


def poses(tstart=-1.0, tend=0.9, tilts=7, rstart=-1.5, rend=1.5, rolls=8):
    return SweepGrid(tstart, tend, tilts, rstart, rend, rolls).poses(LOWER, UPPER)


def test_the_report_s_grid_has_56_different_poses_ends_included():
    grid = poses()
    assert grid.shape == (56, 2)
    assert len({tuple(row) for row in grid.round(12)}) == 56
    assert np.allclose(np.unique(grid[:, 0].round(12)), np.linspace(-1.5, 1.5, 8))
    assert np.allclose(np.unique(grid[:, 1].round(12)), np.linspace(-1.0, 0.9, 7))


@pytest.mark.parametrize(("tilts", "rolls"), [(7, 8), (3, 12), (12, 3), (1, 5), (5, 1), (1, 1)])
def test_each_move_is_one_step_of_one_joint(tilts, rolls):
    grid = poses(tilts=tilts, rolls=rolls)
    moves = np.abs(np.diff(grid, axis=0))
    assert len(grid) == tilts * rolls
    assert np.all(np.sum(moves > 1e-12, axis=1) == 1)
    assert np.all(moves[:, 0] <= 3.0 / max(rolls - 1, 1) + 1e-12)
    assert np.all(moves[:, 1] <= 1.9 / max(tilts - 1, 1) + 1e-12)


def test_the_serpentine_takes_the_order_with_less_travel():
    for grid in (poses(), poses(tilts=3, rolls=12), poses(tilts=12, rolls=3)):
        rolls, tilts = np.unique(grid[:, 0]), np.unique(grid[:, 1])
        travel = np.abs(np.diff(grid, axis=0)).sum()
        roll_inside = np.ptp(tilts) + len(tilts) * np.ptp(rolls)
        tilt_inside = np.ptp(rolls) + len(rolls) * np.ptp(tilts)
        assert travel == pytest.approx(min(roll_inside, tilt_inside))


def test_one_pose_of_a_joint_stands_in_the_middle():
    assert poses(tilts=1, rolls=2)[:, 1].tolist() == pytest.approx([-0.05, -0.05])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"tstart": -1.2}, ["tilt", "tstart", "-1.2", "-1.04"]),
        ({"tend": 1.0}, ["tilt", "tend", "0.96"]),
        ({"rstart": -2.0}, ["roll", "rstart", "-2"]),
        ({"rend": float("nan")}, ["roll", "rend", "nan"]),
        ({"tilts": 0}, ["itersT", "0", "tilt"]),
        ({"rolls": -3}, ["itersR", "-3", "roll"]),
        ({"rstart": 0.5, "rend": 0.5}, ["roll", "0.5", "same"]),
    ],
)
def test_an_impossible_grid_names_joint_and_value(change, words):
    with pytest.raises(GridError) as error:
        poses(**change)
    assert all(word in str(error.value) for word in words), str(error.value)


def test_a_range_may_run_downward():
    assert poses(tstart=0.9, tend=-1.0)[0, 1] == 0.9
