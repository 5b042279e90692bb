"""Parameters of the node and the plant they make."""

from dataclasses import replace

import numpy as np
import pytest
from galen_model.errors import GalenError
from galen_sim_driver.parameters import DriverParameters
from galen_sim_driver.plant.cell import Plant
from galen_sim_driver.plant.config import PlantConfig

DEFAULT = DriverParameters()


def test_the_defaults_are_the_nominal_cell():
    DEFAULT.validate()

    def run(config):
        plant = Plant(config, np.random.default_rng(1))
        plant.attach_tool("retractor")
        plant.start_hand()
        return [plant.step() for _ in range(1000)]

    assert run(DEFAULT.plant_config()) == run(PlantConfig())


def test_tools_and_hand_are_read_from_flat_lists():
    parameters = replace(
        DEFAULT,
        tools=("a", "b"),
        tool_mass_kg=(0.1, 0.2),
        tool_com_m=(1.0, 2.0, 3.0, 4.0, 5.0, 6.0),
        tool_tip_m=(0.1, 0.2, 0.3, 0.4, 0.5, 0.6),
        hand_pushes=(1.0, 2.0, 3.0, 4.0, 5.0, 0.6, 0.7, 0.8),
        hand_frames=("tip",),
        hand_ramp_s=0.5,
    )
    parameters.validate()
    config = parameters.plant_config()
    assert config.tools["b"].load.mass_kg == 0.2
    assert config.tools["b"].load.com_m.tolist() == [4.0, 5.0, 6.0]
    assert config.tools["a"].tip_m.tolist() == [0.1, 0.2, 0.3]
    (push,) = config.hand
    assert (push.start_s, push.duration_s, push.ramp_s, push.frame) == (1.0, 2.0, 0.5, "tip")
    assert (push.force_n, push.torque_nm) == ((3.0, 4.0, 5.0), (0.6, 0.7, 0.8))


def test_the_admittance_timeout_is_wall_time_above_real_time():
    assert DEFAULT.plant_config().admittance.timeout_s == 0.05
    assert replace(DEFAULT, speed_factor=6.0).plant_config().admittance.timeout_s == pytest.approx(
        0.3
    )
    assert replace(DEFAULT, speed_factor=0.5).plant_config().admittance.timeout_s == 0.05


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"sensor_noise": (0.1,)}, "sensor_noise.*1 numbers.*6"),
        ({"start_joints": (0.0,) * 4}, "start_joints.*4 numbers.*5"),
        ({"tool_mass_kg": (0.1,)}, "tool_mass_kg.*1 numbers.*2"),
        ({"tools": ("a", "../b")}, "../b"),
        ({"tools": ("a", "a")}, "twice"),
        ({"initial_tool": "knife"}, "knife"),
        ({"admittance_source": "cooked"}, "cooked"),
        ({"hand_pushes": (1.0, 2.0, 3.0)}, "hand_pushes.*3 numbers"),
        ({"hand_frames": ("base", "tip")}, "2 entries for 6 pushes"),
        ({"hand_ramp_s": 1.5}, "rise and fall"),
        ({"tracker_rate_hz": 501.0}, "501"),
    ],
)
def test_bad_values_are_named(changes, words):
    with pytest.raises(GalenError, match=words):
        replace(DEFAULT, **changes).validate()
