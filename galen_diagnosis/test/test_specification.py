# SPDX-License-Identifier: Apache-2.0
"""Limits of a specification: read with checks, and what lies within is no cause."""

import json
from types import SimpleNamespace

import pytest
from galen_diagnosis.diagnose import main
from galen_diagnosis.effects.forms import _zero_rad
from galen_diagnosis.observation.recording import DAY_TO_DAY
from galen_diagnosis.observation.specification import presets, specification_of
from galen_diagnosis.simulated_recording import make_recording
from galen_model.arm.galen import GALEN
from galen_model.errors import GalenError
from galen_sim_driver.effects.joints import JointZeroOffset
from galen_sim_driver.effects.registry import LIMITED, limit_parts
from galen_sim_driver.effects.sensor import AxisGain

LIMITS = {
    "axis_gain": {"fz": 0.02, "default": 0.01},
    "joint_zero_offset": {"tilt": 0.003, "default": 0.002},
    "crosstalk": 0.004,
    "sensor_hysteresis": 0.001,
}
ORDINARY = AxisGain((0.004, -0.003, 0.005, -0.004, 0.003, 0.002)), JointZeroOffset("tilt", 0.0008)


def write(folder, limits, **more):
    path = folder / "specification.json"
    content = {"schema_version": 1, "name": "an arm", "source": "made up", "limits": limits}
    path.write_text(json.dumps(content | more))
    return path


def read(path):
    return specification_of([path], limit_parts(GALEN))


def test_a_limit_is_of_a_part_or_the_default(tmp_path):
    found = read(write(tmp_path, LIMITS))
    assert (found.name, found.source) == ("an arm", "made up")
    assert found.limit("axis_gain", "fz") == 0.02
    assert found.limit("axis_gain", "tx") == 0.01
    assert found.limit("joint_zero_offset", "roll") == 0.002
    assert found.limit("joint_gain", "roll") == read_default().limit("joint_gain")
    assert found.std("crosstalk", ("",)) == (0.002,)


@pytest.mark.parametrize(
    ("limits", "message"),
    [
        ({"axis_gains": 0.1}, "limits.axis_gains is no effect that has a limit; known: "),
        ({"bias_step": 0.1}, "limits.bias_step is no effect that has a limit"),
        ({"axis_gain": 0.0}, "limits.axis_gain.default is 0: a limit is positive and finite"),
        ({"axis_gain": {"fq": 0.1}}, "limits.axis_gain.fq is not known; known: fx, fy"),
        ({"joint_gain": {"elbow": 0.1}}, "limits.joint_gain.elbow is not known; known: delta_x"),
        ({"axis_gain": "1 %"}, "limits.axis_gain.default"),
        ([], "limits"),
    ],
)
def test_bad_limits_name_file_and_key(tmp_path, limits, message):
    path = write(tmp_path, limits)
    with pytest.raises(GalenError) as error:
        read(path)
    assert str(error.value).startswith(f"{path}: ")
    assert message in str(error.value)


def test_a_specification_of_another_version_is_rejected(tmp_path):
    with pytest.raises(GalenError, match="schema_version"):
        read(write(tmp_path, LIMITS, schema_version=2))


def test_what_a_file_leaves_out_comes_from_the_next_one_and_the_default(tmp_path):
    path = write(tmp_path, {"axis_gain": {"fz": 0.5}, "backlash": 7.0})
    both = specification_of([path, "ati_gamma"], limit_parts(GALEN))
    gamma = specification_of(["ati_gamma"], limit_parts(GALEN))
    assert (both.limit("axis_gain", "fz"), both.limit("backlash")) == (0.5, 7.0)
    assert both.limit("axis_gain", "fx") == gamma.limit("axis_gain")
    assert both.limit("loose_tool") == read_default().limit("loose_tool")
    assert both.name == f"an arm and {gamma.name}"


def read_default():
    return specification_of(["default"], limit_parts(GALEN))


@pytest.mark.parametrize("name", presets())
def test_a_preset_has_a_source_of_each_limit_and_the_default_has_all(name):
    found = specification_of([name], limit_parts(GALEN))
    assert found.limits.keys() <= found.sources.keys()
    assert name == "galen" or found.limits.keys() == limit_parts(GALEN).keys()
    assert all(found.sources.values()) and found.name and found.source


def test_limits_are_printed_with_their_sources(capsys):
    with pytest.raises(SystemExit) as ended:
        main(["--show-specification", "ati_gamma", "ur5e"])
    out = capsys.readouterr().out
    assert ended.value.code == 0
    assert "axis_gain" in out and "joint_zero_offset" in out and "assumed" in out
    with pytest.raises(SystemExit):
        main(["--show-specification", "no_such"])
    assert "no_such: can't be read" in capsys.readouterr().err


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    folder = tmp_path_factory.mktemp("specification") / "made"
    make_recording(folder, ORDINARY, seed=4, bags=("sweep",), arm=GALEN)
    return folder


def test_where_the_tip_is_is_known_as_well_as_the_joints_zeros():
    """Rads; since a reference limits are a part, but not of an arm's constant geometry."""

    def known_to(limits, earlier=None):
        recording = SimpleNamespace(arm=GALEN, specification=limits, earlier=earlier)
        return _zero_rad(SimpleNamespace(recording=recording))

    known = dict.fromkeys(LIMITED)
    tight, usual = (specification_of([name], known) for name in ("galen", "default"))
    assert known_to(usual) == usual.limit("joint_zero_offset") / 2.0
    for limits, expected in ((usual, known_to(usual)), (tight, 1e-4)):
        assert known_to(limits) == pytest.approx(expected)
        assert known_to(limits.scaled(DAY_TO_DAY, ""), "earlier") == pytest.approx(expected)


@pytest.mark.slow
def test_what_lies_within_is_no_cause_and_what_lies_beyond_is(recording, tmp_path, capsys):
    def verdict(*options):
        assert main([str(recording), "--json", "--no-report", "--overwrite", "--output",
                     str(tmp_path / "out"), *options]) == 0  # fmt: skip
        return json.loads(capsys.readouterr().out)

    limits = str(write(tmp_path, LIMITS))
    tight = verdict()
    assert tight["verdict"] != "none" and tight["specification"]["name"].startswith("a carefully")
    within = verdict("--specification", limits)
    assert within["verdict"] == "none"
    assert within["sentence"].startswith("Within specification (an arm)")
    assert within["specification"] == {"name": "an arm", "source": "made up"}
    better = {"axis_gain": 6e-4, "joint_zero_offset": LIMITS["joint_zero_offset"]}
    beyond = verdict("--specification", str(write(tmp_path, better)), "galen")
    assert [cause["effect"] for cause in beyond["causes"]] == ["axis_gain"]
    assert main([str(recording), "--specification", str(tmp_path / "none.json")]) == 1
    assert "none.json: can't be read: No such file" in capsys.readouterr().err
