"""A sweep over poses that a file lists."""

import numpy as np
import pytest
from galen_calibration_behavior.parameters import CalibrationParameters
from galen_model.arm.clearance import ObstacleError
from galen_model.errors import NotExcitedError
from galen_model.poses.plan import GridError
from galen_ros.parameters import ParameterError

TIP = np.array([0.15, 0.0, 0.05])
POSES = [[-1.2, 0.5], [0.0, -0.9], [1.1, 0.4], [0.6, -0.3], [-0.7, 0.1], [0.3, 0.8], [0.0, -0.9]]


def listed(poses, **more):
    numbers = tuple(float(value) for value in np.ravel(poses))
    return CalibrationParameters(poses="listed", listed_poses_rad=numbers, **more)


def test_listed_poses_are_visited_as_they_are_in_their_order():
    parameters = listed(POSES)
    parameters.validate()
    assert parameters.plan(TIP).poses.tolist() == POSES
    # each averaged as a grid's pose is, not for as long as a chosen one
    assert parameters.of_sweep().average_s == parameters.average_s
    assert parameters.times().stay_s == CalibrationParameters().times().stay_s


def test_what_can_not_be_visited_is_rejected_by_its_number():
    for numbers in ((), (0.1, 0.2, 0.3), tuple([0.1, 0.2] * 1001)):
        with pytest.raises(ParameterError, match=f"listed_poses_rad' has {len(numbers)} numbers"):
            CalibrationParameters(poses="listed", listed_poses_rad=numbers).validate()
    with pytest.raises(GridError, match=r"pose 2 of listed_poses_rad .roll 0, tilt 1.2 rad"):
        listed([[0.0, 0.0], [0.1, 0.0], [0.0, 1.2]]).validate()
    with pytest.raises(NotExcitedError):
        listed([[0.1 * k, 0.0] for k in range(8)]).plan(TIP)
    box = (0.5, 0.07, 0.2, 0.9, 0.5, 0.44)
    with pytest.raises(ObstacleError, match=r"pose \d of listed_poses_rad .* leave it out"):
        listed(POSES, obstacles=box).plan(TIP)


def test_a_list_that_is_not_used_is_not_looked_at():
    CalibrationParameters(listed_poses_rad=(9.0,)).validate()
