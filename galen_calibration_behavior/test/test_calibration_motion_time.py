import numpy as np
import pytest
from galen_model.poses.order import quintic_duration_s

TIME = np.linspace(0.0, 1.0, 20001)


def peaks(distance, duration):
    """Peak velocity and acceleration of the quintic, by differences."""
    path = distance * (10 * TIME**3 - 15 * TIME**4 + 6 * TIME**5)
    velocity = np.gradient(path, TIME * duration)
    return np.max(np.abs(velocity)), np.max(np.abs(np.gradient(velocity, TIME * duration)))


@pytest.mark.parametrize("distance", [0.001, 0.3, -2.0])
def test_one_limit_is_met_and_none_is_broken(distance):
    duration = quintic_duration_s([distance], [0.8], [3.0])
    velocity, acceleration = peaks(distance, duration)
    assert velocity <= 0.8 * 1.001
    assert acceleration <= 3.0 * 1.001
    assert velocity >= 0.8 * 0.999 or acceleration >= 3.0 * 0.995 or duration == 0.05


def test_the_slowest_joint_decides():
    limits = [0.1, 0.8], [1.0, 3.0]
    both = quintic_duration_s([0.2, 0.3], *limits)
    assert both == quintic_duration_s([0.2, 0.0], *limits)
    assert both > quintic_duration_s([0.0, 0.3], *limits)


def test_no_distance_still_takes_time():
    assert quintic_duration_s(np.zeros(5), np.ones(5), np.ones(5)) == 0.05
