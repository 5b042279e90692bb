# SPDX-License-Identifier: Apache-2.0
"""Two calibration files compared: by drawn estimates, by hand, over the whole workspace."""

from dataclasses import replace

import numpy as np
import pytest
from galen_model.arm.galen import GALEN
from galen_model.files.calibration_file import CalibrationFile
from galen_model.files.comparison import (
    IncomparableError,
    compare_calibrations,
    same_load,
)
from galen_model.load.model import LoadEstimate
from model_files import calibration

COVARIANCE = np.diag([0.03e-3, 0.2e-3, 0.3e-3, 0.1e-3]) ** 2
COVARIANCE[0, 1] = COVARIANCE[1, 0] = -0.6 * 0.03e-3 * 0.2e-3
CENTRE = np.array([0.055, 0.002, 0.045])
POINTER = calibration(
    load=LoadEstimate(0.06, CENTRE, COVARIANCE),
    adapter=LoadEstimate(0.1, np.array([0.0, 0.0, 0.02]), COVARIANCE),
)


def with_load(mass_kg: float, com_m: np.ndarray, **fields) -> CalibrationFile:
    return replace(POINTER, load=LoadEstimate(mass_kg, com_m, COVARIANCE), **fields)


def test_two_calibrations_of_one_load_are_called_another_in_one_of_twenty():
    rng = np.random.default_rng(2)
    mean = [0.06, *CENTRE]
    pairs = rng.multivariate_normal(mean, COVARIANCE, size=(1000, 2))
    same = [
        same_load(*(LoadEstimate(x[0], x[1:], COVARIANCE) for x in (first, second)))
        for first, second in pairs
    ]
    assert 0.93 < np.mean(same) < 0.97  # standard deviation of this mean: 0.007


def test_a_difference_is_told_in_its_standard_deviations():
    found = {
        row.quantity: row
        for row in compare_calibrations(POINTER, with_load(0.0631, CENTRE)).differences
    }
    mass = found["mass"]
    assert mass.value == pytest.approx(3.1e-3)
    assert mass.std_dev == pytest.approx(np.sqrt(2) * 0.03e-3)
    assert mass.text == "differs by 3.10 g (73.1 sigma)"
    assert found["com_y"].text == "the same within 2 sigma"
    # The file says nothing of the offset's and the tip's uncertainty.
    moved = replace(POINTER, tip_m=POINTER.tip_m + [0.0, 0.002, 0.0])
    moved = replace(moved, residual_offset=np.array([0, 0, 0.5, 0, 0, 0]))
    found = {row.quantity: row for row in compare_calibrations(POINTER, moved).differences}
    assert found["tip_y"].text == "differs by 2.00 mm" and found["tip_x"].text == "the same"
    assert found["offset_fz"].text == "differs by 500 mN"
    assert np.isnan(found["tip_y"].sigmas)


def test_a_correlation_tells_what_single_numbers_can_not():
    """Each within 2 sigma of its own, together impossible: mass and centre up, though they vary
    against each other."""
    shift = 1.9 * np.sqrt(2 * np.diag(COVARIANCE))
    other = with_load(0.06 + shift[0], CENTRE + [shift[1], 0, 0])
    comparison = compare_calibrations(POINTER, other)
    assert {d.text for d in comparison.differences[:4]} == {"the same within 2 sigma"}
    assert not comparison.same_load and "another load;" in comparison.text


def test_without_uncertainty_only_the_same_numbers_are_the_same():
    exact = LoadEstimate(0.06, CENTRE, np.zeros((4, 4)))
    assert same_load(exact, exact)
    assert not same_load(exact, replace(exact, mass_kg=0.06 + 1e-9))
    row = compare_calibrations(
        replace(POINTER, load=exact), replace(POINTER, load=replace(exact, mass_kg=0.061))
    ).differences[0]
    assert row.sigmas == np.inf and row.text == "differs by 1.00 g (inf sigma)"


def test_the_worst_case_is_the_largest_over_the_workspace():
    other = with_load(0.2, np.array([0.07, -0.01, 0.055]), residual_offset=np.full(6, 0.01))
    comparison = compare_calibrations(POINTER, other)
    rng = np.random.default_rng(5)
    angles = rng.uniform(GALEN.lower[3:], GALEN.upper[3:], (20000, 2))
    difference = other.predict(angles) - POINTER.predict(angles)
    for (size, at_rad), part in (
        (comparison.worst_force, slice(3)),
        (comparison.worst_torque, slice(3, 6)),
    ):
        drawn = np.linalg.norm(difference[:, part], axis=1).max()
        assert drawn * (1 - 1e-3) < size < drawn * (1 + 1e-3)
        there = other.predict(at_rad) - POINTER.predict(at_rad)
        assert np.linalg.norm(there[part]) == pytest.approx(size)
    assert compare_calibrations(POINTER, POINTER).worst_force[0] == 0.0


def test_files_of_two_arms_are_rejected():
    other = replace(POINTER, arm=replace(POINTER.arm, sensor_frame="other"))
    with pytest.raises(IncomparableError, match=r"'a' and 'b' are of two arms: .* and other"):
        compare_calibrations(POINTER, other, ("a", "b"))
