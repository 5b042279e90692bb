# SPDX-License-Identifier: Apache-2.0
"""Parameters of the node, the plant they make, and the pacing of its steps."""

from dataclasses import replace

import numpy as np
import pytest
from galen_model.arm.galen import GALEN
from galen_model.errors import GalenError
from galen_sim_driver.parameters import DriverParameters, EffectParameters, effects_of
from galen_sim_driver.plant.cell import Plant
from galen_sim_driver.plant.config import PlantConfig
from galen_sim_driver.ros.node import Pacer, SpeedMeter
from sim_bench import run

DEFAULT = DriverParameters()


def test_the_defaults_are_the_nominal_cell_without_effects():
    DEFAULT.validate()
    assert effects_of(EffectParameters()) == ()

    def samples(config):
        plant = Plant(config, np.random.default_rng(1))
        plant.attach_tool("retractor")
        plant.start_hand()
        return run(plant, 600)

    assert samples(DEFAULT.plant_config(arm=GALEN)) == samples(PlantConfig(arm=GALEN))


def test_tools_and_hand_are_read_from_flat_lists():
    parameters = replace(
        DEFAULT,
        tools=("a", "b"),
        tool_mass_kg=(0.1, 0.2),
        tool_com_m=(1.0, 2.0, 3.0, 4.0, 5.0, 6.0),
        tool_tip_m=(0.1, 0.2, 0.3, 0.4, 0.5, 0.6),
        hand_pushes=(1.0, 2.0, 3.0, 4.0, 5.0, 0.6, 0.7, 0.8),
        hand_frames=("tip",),
    )
    parameters.validate()
    config = parameters.plant_config(arm=GALEN)
    assert config.tools["b"].load.mass_kg == 0.2
    assert config.tools["b"].load.com_m.tolist() == [4.0, 5.0, 6.0]
    assert config.tools["a"].tip_m.tolist() == [0.1, 0.2, 0.3]
    (push,) = config.hand
    assert (push.start_s, push.duration_s, push.frame) == (1.0, 2.0, "tip")
    assert (push.force_n, push.torque_nm) == ((3.0, 4.0, 5.0), (0.6, 0.7, 0.8))


def test_the_admittance_timeout_is_wall_time_above_real_time():
    for speed, wanted in ((1.0, 0.05), (6.0, 0.3), (0.5, 0.05)):
        config = replace(DEFAULT, speed_factor=speed).plant_config(arm=GALEN)
        assert config.admittance_timeout_s == pytest.approx(wanted)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"sensor_noise": (0.1,)}, "sensor_noise.*1 numbers.*6"),
        ({"tool_mass_kg": (0.1,)}, "tool_mass_kg.*1 numbers.*2"),
        ({"tools": ("a", "../b")}, "../b"),
        ({"tools": ("a", "a")}, "twice"),
        ({"initial_tool": "knife"}, "knife"),
        ({"admittance_source": "cooked"}, "cooked"),
        ({"hand_pushes": (1.0, 2.0, 3.0)}, "hand_pushes.*3 numbers"),
        ({"hand_frames": ("base", "tip")}, "2 entries for 6 pushes"),
        ({"hand_pushes": (1.0, 0.1) + (0.0,) * 6, "hand_frames": ("base",)}, "rise and fall"),
        ({"tracker_rate_hz": 501.0}, "501"),
    ],
)
def test_bad_values_are_named(changes, words):
    with pytest.raises(GalenError, match=words):
        replace(DEFAULT, **changes).validate()


def test_the_start_is_checked_against_the_arm():
    config = replace(DEFAULT, start_joints=(0.0,) * 4).plant_config(arm=GALEN)
    with pytest.raises(GalenError, match=r"start_joints.*4 numbers.*5: delta_x, delta_y"):
        config.validate()


# --- pacing -----------------------------------------------------------------------------------


def test_steps_follow_the_clock():
    pacer = Pacer(0.002, 1.0)
    pacer.start(100.0)
    assert pacer.due(100.0) == 0
    assert pacer.due(100.0051) == 2
    assert pacer.due(100.0061) == 1
    assert pacer.due(100.0) == 0
    taken = 3 + sum(pacer.due(100.0 + 0.0017 * tick) for tick in range(1, 1001))
    assert taken == pytest.approx(1.7 / 0.002, abs=1)


def test_real_time_makes_every_missing_step_up_in_bounded_batches():
    pacer = Pacer(0.002, 1.0)
    pacer.start(0.0)
    batches = [pacer.due(1.0 + 0.002 * tick) for tick in range(100)]
    assert max(batches) == 40
    assert sum(batches) == pytest.approx(1.198 / 0.002, abs=1)
    assert batches[-1] == 1


def test_another_speed_runs_slower_after_a_stall_instead_of_bursts():
    pacer = Pacer(0.002, 10.0)
    pacer.start(0.0)
    assert pacer.due(0.004) == 20
    # 0.4 s late: 2000 steps are missing, one batch of them is taken.
    assert pacer.due(0.4) == 40
    assert pacer.due(0.4021) == 10
    assert pacer.due(0.4041) == 10


def test_the_speed_is_averaged_over_a_window():
    meter = SpeedMeter(0.5)
    meter.update(0.0, 0)
    meter.update(0.3, 9_000_000_000)
    assert meter.speed is None
    meter.update(0.6, 3_000_000_000)
    assert meter.speed == pytest.approx(5.0)
    meter.update(0.7, 3_000_000_000)
    assert meter.speed == pytest.approx(5.0)
