"""The 2019 report's printed equations beside the sound ones, on noise-free data.

The printed forms live only here. R is R_ts(theta), from the sensor's frame to the base-parallel
one; R0 at home; f_t, f_b weights in the base-parallel frame; p_t, p_b centres in the sensor's.
"""

import numpy as np
import pytest
from galen_model.arm.galen import GALEN, GRAVITY_M_S2
from galen_model.load.model import nominal_reading
from galen_model.load.nominal_tools import ADAPTER, TOOLS
from galen_model.registration import adjoint
from galen_model.rotation import skew

ROLL, TILT = (a.ravel() for a in np.meshgrid(np.linspace(-1.5, 1.5, 8), np.linspace(-1, 0.9, 7)))
R = GALEN.rotation(np.stack([ROLL, TILT], axis=-1))
RT = np.swapaxes(R, 1, 2)
R0 = GALEN.rotation((0.0, 0.0))
F_B = ADAPTER.mass_kg * GRAVITY_M_S2
P_B = np.asarray(ADAPTER.com_m)


@pytest.fixture(params=["pointer", "retractor"])
def tool(request):
    return TOOLS[request.param].load


def test_sound_force_and_torque_equations_are_the_model(tool):
    f_t = tool.mass_kg * GRAVITY_M_S2
    force = RT @ f_t + (RT - R0.T) @ F_B
    torque = -RT @ skew(f_t) @ R @ tool.com_m - (RT @ skew(F_B) @ R - R0.T @ skew(F_B) @ R0) @ P_B
    reading = nominal_reading(np.stack([ROLL, TILT], axis=-1), tool, ADAPTER)
    np.testing.assert_allclose(reading[:, :3], force, atol=1e-14)
    np.testing.assert_allclose(reading[:, 3:], torque, atol=1e-14)


def test_printed_eq_3_is_wrong_by_the_size_of_the_bias_torque():
    """Eq. (3) prints (R^T - R0^T) f_b^ (-R) p_b: right only at home."""
    sound = -(RT @ skew(F_B) @ R - R0.T @ skew(F_B) @ R0) @ P_B
    printed = (RT - R0.T) @ skew(F_B) @ -R @ P_B
    bias_torque = np.linalg.norm(np.cross(P_B, R0.T @ F_B))
    worst = np.abs(printed - sound).max()
    assert 0.5 * bias_torque < worst < 2.0 * bias_torque
    at_home = (R0.T - R0.T) @ skew(F_B) @ -R0 @ P_B
    np.testing.assert_allclose(at_home, 0.0, atol=1e-15)


def test_printed_eq_3_biases_the_adapters_centre():
    """Regression by eq. (4) on noise-free readings without a tool: sound exact, printed not.

    (R^T - R0^T) f_b^ (-R) p is not the reading, so that least squares on it misses the centre.
    """
    torque = -(RT @ skew(F_B) @ R - R0.T @ skew(F_B) @ R0) @ P_B
    sound = -(RT @ skew(F_B) @ R - R0.T @ skew(F_B) @ R0).reshape(-1, 3)
    printed = ((RT - R0.T) @ skew(F_B) @ -R).reshape(-1, 3)
    right = torque.reshape(-1)
    exact = np.linalg.lstsq(sound, right, rcond=None)[0]
    missed = np.linalg.lstsq(printed, right, rcond=None)[0]
    np.testing.assert_allclose(sound @ exact, right, atol=1e-14)
    np.testing.assert_allclose(exact, P_B, atol=1e-12)
    assert np.linalg.norm(missed - P_B) > 1e-3
    assert np.abs(printed @ missed - right).max() > 1e-3


def test_printed_eq_7_flips_a_sign_between_its_rows(tool):
    """Eq. (7)'s first row of A4 has -R^T f_t^ R, the last +R^T f_t^ R: they can't both hold."""
    f_t = tool.mass_kg * GRAVITY_M_S2
    torque = (-RT @ skew(f_t) @ R) @ tool.com_m
    rows = -RT @ skew(f_t) @ R
    mixed = rows.copy()
    mixed[-1] *= -1.0
    exact = np.linalg.lstsq(rows.reshape(-1, 3), torque.reshape(-1), rcond=None)[0]
    missed = np.linalg.lstsq(mixed.reshape(-1, 3), torque.reshape(-1), rcond=None)[0]
    np.testing.assert_allclose(exact, tool.com_m, atol=1e-12)
    assert np.linalg.norm(missed - tool.com_m) > 1e-4


@pytest.mark.parametrize("right_form", ["R(theta) for R(0)", "f_t for f_b", "sound"])
def test_printed_eq_7_leaves_bias_torque_on_its_right_side(tool, right_form):
    """Eq. (7)'s Y4 takes the adapter's torque off the reading, with R(theta) - R(theta) or f_t^.

    The first takes off nothing, the second a torque of the tool's weight at the adapter's centre.
    Both miss the tool's centre by millimetres, without any noise.
    """
    f_t = tool.mass_kg * GRAVITY_M_S2
    torque = nominal_reading(np.stack([ROLL, TILT], axis=-1), tool, ADAPTER)[:, 3:]
    taken_off = {
        "R(theta) for R(0)": -(RT @ skew(F_B) @ R - RT @ skew(F_B) @ R) @ P_B,
        "f_t for f_b": -(RT @ skew(f_t) @ R - R0.T @ skew(f_t) @ R0) @ P_B,
        "sound": -(RT @ skew(F_B) @ R - R0.T @ skew(F_B) @ R0) @ P_B,
    }[right_form]
    rows = (-RT @ skew(f_t) @ R).reshape(-1, 3)
    centre = np.linalg.lstsq(rows, (torque - taken_off).reshape(-1), rcond=None)[0]
    error = np.linalg.norm(centre - tool.com_m)
    assert error < 1e-12 if right_form == "sound" else error > 1e-3


def test_printed_eqs_9_to_11_with_a_constant_p_miss_the_torque(tool):
    """Ad of g = (R, p): p is the origin's place in the base-parallel frame, so it turns with R.

    Frame t stands at the centre of mass, parallel to the base; the sensor's origin in t is -R p_t.
    """
    weight = np.concatenate([tool.mass_kg * GRAVITY_M_S2, np.zeros(3)])
    reading = nominal_reading(np.stack([ROLL, TILT], axis=-1), tool, type(tool)(0.0))
    sound, printed = [], []
    for rotation in R:
        transform = np.eye(4)
        transform[:3, :3] = rotation
        transform[:3, 3] = -rotation @ tool.com_m
        sound.append(adjoint(transform).T @ weight)
        transform[:3, 3] = -R0 @ tool.com_m
        printed.append(adjoint(transform).T @ weight)
    np.testing.assert_allclose(sound, reading, atol=1e-14)
    worst = np.abs(np.array(printed)[:, 3:] - reading[:, 3:]).max()
    assert worst > 0.5 * tool.mass_kg * 9.80665 * np.linalg.norm(tool.com_m)
