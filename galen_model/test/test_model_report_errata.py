# SPDX-License-Identifier: Apache-2.0
"""The 2019 report's printed equations beside the sound ones, on noise-free data.

The printed forms live only here. R is R_ts(theta), from the sensor's frame to the base-parallel
one; R0 at home; f_t, f_b weights in the base-parallel frame; p_t, p_b centres in the sensor's.
"""

import numpy as np
import pytest
from galen_model.arm.galen import GALEN, GRAVITY_M_S2
from galen_model.load.model import ADAPTER, TOOLS, nominal_reading
from galen_model.rotation import skew

MESH = np.meshgrid(np.linspace(-1.5, 1.5, 8), np.linspace(-1, 0.9, 7))
ANGLES = np.column_stack([one.ravel() for one in MESH])
R = GALEN.rotation(ANGLES)
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
    reading = nominal_reading(ANGLES, tool, ADAPTER, arm=GALEN)
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


@pytest.mark.parametrize("right_form", ["R(theta) for R(0)", "f_t for f_b", "sound"])
def test_printed_eq_7_leaves_bias_torque_on_its_right_side(tool, right_form):
    """Eq. (7)'s Y4 takes the adapter's torque off the reading, with R(theta) - R(theta) or f_t^.

    The first takes off nothing, the second a torque of the tool's weight at the adapter's centre.
    Both miss the tool's centre by millimetres, without any noise.
    """
    f_t = tool.mass_kg * GRAVITY_M_S2
    torque = nominal_reading(ANGLES, tool, ADAPTER, arm=GALEN)[:, 3:]
    taken_off = {
        "R(theta) for R(0)": -(RT @ skew(F_B) @ R - RT @ skew(F_B) @ R) @ P_B,
        "f_t for f_b": -(RT @ skew(f_t) @ R - R0.T @ skew(f_t) @ R0) @ P_B,
        "sound": -(RT @ skew(F_B) @ R - R0.T @ skew(F_B) @ R0) @ P_B,
    }[right_form]
    rows = (-RT @ skew(f_t) @ R).reshape(-1, 3)
    centre = np.linalg.lstsq(rows, (torque - taken_off).reshape(-1), rcond=None)[0]
    error = np.linalg.norm(centre - tool.com_m)
    assert error < 1e-12 if right_form == "sound" else error > 1e-3
