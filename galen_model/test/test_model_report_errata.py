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


@pytest.mark.parametrize("name", ["pointer", "retractor"])
@pytest.mark.parametrize("right_form", ["R(theta) for R(0)", "f_t for f_b", "sound"])
def test_printed_eq_7_leaves_bias_torque_on_its_right_side(name, right_form):
    """Eq. (7)'s Y4 takes the adapter's torque off the reading, with R(theta) - R(theta) or f_t^.

    The first takes off nothing, the second a torque of the tool's weight at the adapter's centre.
    Both miss the tool's centre by millimetres, without any noise.
    """
    tool = TOOLS[name].load
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
