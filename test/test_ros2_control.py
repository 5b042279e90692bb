# SPDX-License-Identifier: Apache-2.0
"""The how-to's parameter files against the exported load, the arm and the controllers' names."""

import re
from pathlib import Path

import pytest
import yaml
from galen_model.arm.galen import GALEN
from galen_model.files.calibration_file import read_calibration
from galen_model.files.export import export_load

ROOT = Path(__file__).resolve().parent.parent
FOLDER = ROOT / "docs" / "how-to" / "ros2_control"
CONTROLLERS, LOAD = (
    yaml.safe_load((FOLDER / f"{name}.yaml").read_text()) for name in ("controllers", "load")
)

# From src/*_parameters.yaml of ros2_controllers and control_toolbox, branches jazzy, August 2026:
# what has no default, and of the rest what the files give.
NEEDED = {
    "joint_trajectory_controller": {"joints", "command_interfaces", "state_interfaces"},
    "force_torque_sensor_broadcaster": {"frame_id", "sensor_name"},
    "admittance_controller": {
        "joints", "command_interfaces", "state_interfaces",
        "kinematics.plugin_name", "kinematics.plugin_package", "kinematics.base", "kinematics.tip",
        "ft_sensor.name", "ft_sensor.frame.id", "control.frame.id", "fixed_world_frame.frame.id",
        "gravity_compensation.frame.id", "gravity_compensation.CoG.pos",
        "admittance.selected_axes", "admittance.mass", "admittance.damping_ratio",
        "admittance.stiffness",
    },
}  # fmt: skip
FILTER = "sensor_filter_chain.filter1"
OPTIONAL = {
    "joint_trajectory_controller": set(),
    "force_torque_sensor_broadcaster": {
        *(f"offset.{part}.{axis}" for part in ("force", "torque") for axis in "xyz"),
        *(f"{FILTER}.{name}" for name in ("name", "type", "params.world_frame")),
        *(f"{FILTER}.params.{name}" for name in ("sensor_frame", "tool.mass", "tool.CoG")),
        f"{FILTER}.params.tool.gravity_field",
    },
    "admittance_controller": {"gravity_compensation.CoG.force"},
}


def parameters(content, name):
    """A controller's parameters by their full names."""

    def flat(branch, before=""):
        for key, value in branch.items():
            if isinstance(value, dict):
                yield from flat(value, f"{before}{key}.")
            else:
                yield before + key, value

    return dict(flat(content.get(name, {}).get("ros__parameters", {})))


def test_the_load_is_what_export_writes():
    tool = read_calibration(ROOT / "bags" / "tools" / "retractor.json", arm=GALEN)
    assert export_load(tool, "ros2_control")["text"] == (FOLDER / "load.yaml").read_text()
    params = parameters(LOAD, "force_torque_sensor_broadcaster")
    mass, centre = (params[f"{FILTER}.params.tool.{name}"] for name in ("mass", "CoG"))
    hung = parameters(LOAD, "admittance_controller")
    parts = (tool.load, tool.adapter)
    assert mass == pytest.approx(sum(part.mass_kg for part in parts))
    moments = sum(part.mass_kg * part.com_m for part in parts)
    assert centre == pytest.approx(list(moments / mass), abs=1e-9)
    assert hung["gravity_compensation.CoG.pos"] == centre
    assert hung["gravity_compensation.CoG.force"] == pytest.approx(9.80665 * mass)
    # With the offset, the sensor reads the weight of all that hangs on it.
    read = tool.predict(GALEN.home_angles)[:3] + [params[f"offset.force.{a}"] for a in "xyz"]
    assert read == pytest.approx(mass * GALEN.gravity_in_sensor(None), abs=1e-6)


@pytest.mark.parametrize("name", NEEDED)
def test_the_controllers_have_what_they_need_under_names_that_they_know(name):
    static, load = parameters(CONTROLLERS, name), parameters(LOAD, name)
    assert set(static) >= NEEDED[name]
    assert set(static) | set(load) <= NEEDED[name] | OPTIONAL[name]
    assert name in CONTROLLERS["controller_manager"]["ros__parameters"]
    frames = {key: static[key] for key in load.keys() & static.keys() if key.endswith("id")}
    assert frames == {key: load[key] for key in frames}


def test_joints_and_frames_are_the_arms():
    for name in ("joint_trajectory_controller", "admittance_controller"):
        assert parameters(CONTROLLERS, name)["joints"] == list(GALEN.joint_names)
    links = set(re.findall(r'<link name="(.*?)"', GALEN.urdf))
    admittance = parameters(CONTROLLERS, "admittance_controller")
    assert {value for key, value in admittance.items() if key.endswith(".frame.id")} <= links
    assert admittance["kinematics.base"] == admittance["fixed_world_frame.frame.id"]
    assert all(len(admittance[f"admittance.{key}"]) == 6 for key in ("mass", "stiffness"))
