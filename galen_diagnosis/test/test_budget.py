# SPDX-License-Identifier: Apache-2.0
"""What the whole gap is made of, and what has changed since an earlier recording."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from galen_diagnosis.answer.answer import RESIDUAL, BudgetItem, Interval
from galen_diagnosis.diagnose import main
from galen_diagnosis.effects.candidates import linear_form, plain_form
from galen_diagnosis.effects.forms import Forms
from galen_diagnosis.effects.registry import sought
from galen_diagnosis.inference.budget import budget
from galen_diagnosis.inference.diagnosing import diagnose_recording
from galen_diagnosis.inference.gap import parameters_of
from galen_diagnosis.inference.refine import refine
from galen_diagnosis.observation.observation import Observation
from galen_diagnosis.observation.recording import Earlier, read_recording
from galen_diagnosis.simulated_recording import make_recording, sweep_poses
from galen_model.arm.galen import GALEN
from galen_model.errors import GalenError
from galen_sim_driver.effects.joints import JointZeroOffset
from galen_sim_driver.effects.load import ToolMassError
from galen_sim_driver.effects.sensor import AxisGain, SensorSaturation
from scipy.sparse import csc_array

GAINS = (0.008, -0.006, 0.012, 0.0, 0.0, 0.0)
ARM = AxisGain(GAINS), JointZeroOffset("tilt", 0.0025)
LIMITS = {"axis_gain": 0.02, "joint_zero_offset": 0.005, "crosstalk": 0.004}


def made(folder, name, *effects, seed=4):
    path = folder / name
    poses = sweep_poses(arm=GALEN)[::2]
    make_recording(path, effects, seed, "retractor", bags=("sweep",), poses=poses, arm=GALEN)
    content = {"schema_version": 1, "name": "an arm", "source": "made up", "limits": LIMITS}
    (path / "specification.json").write_text(json.dumps(content))
    return path


@pytest.fixture(scope="module")
def ordinary(tmp_path_factory):
    """Half a sweep of an arm whose gains and tilt zero are off, within their limits."""
    return made(tmp_path_factory.mktemp("budget"), "ordinary", *ARM)


@pytest.fixture(scope="module")
def forms(ordinary):
    limits = [ordinary / "specification.json", "galen"]
    return Forms(Observation(read_recording(ordinary, specification=limits)))


def budget_of(forms, observation, *parts):
    fit = refine(observation, forms.behind, parts, [part.start for part in parts])
    none = csc_array((len(observation.rows), 0))
    return budget(observation, forms.behind, forms.tolerances, fit, none, 1.0)


def test_the_whole_gap_is_a_sum_of_shares_and_parts_are_what_was_put_in(forms):
    items = budget_of(forms, forms._observation)
    shares = [one.share.value for one in items]
    assert sum(shares) == pytest.approx(1.0, abs=1e-9)
    assert shares == sorted(shares, reverse=True)
    found = {one.label: one for one in items}
    zero, gains = found["joint_zero_offset:tilt"], found["axis_gain"]
    assert found[RESIDUAL].share.value < 0.05
    offset = zero.parameters["offset_rad"]
    # The made arm has a healthy one's own deviation of 0.1 mrad.
    assert offset.value == pytest.approx(0.0025, abs=0.0004)
    assert offset.low < offset.value < offset.high
    assert (zero.standing, zero.limits) == ("within", {"offset_rad": 0.005})
    for got, put in zip(gains.parameters["gain"][:3], GAINS[:3], strict=True):
        assert got.low - 6e-4 < put < got.high + 6e-4
    assert gains.standing == "within" and gains.limits["gain"] == [0.02] * 6


def test_a_limit_that_no_push_reaches_has_no_numbers(forms):
    observation = forms._observation
    clipped = SensorSaturation(limit=0.2, axis="tx")
    part = linear_form(clipped, "tx 0.2", np.zeros((len(observation.rows), 0)), np.zeros(0))
    part = replace(part, make=lambda _: clipped, inputs=True)
    labels = [one.label for one in budget_of(forms, observation, part)]
    assert "joint_zero_offset:tilt" in labels and "axis_gain" in labels


@pytest.mark.parametrize("compared", [False, True])
def test_healthy_deviations_become_effects_that_change_what_their_columns_do(forms, compared):
    """Also since a reference, where other numbers than the deviations' own are fitted."""
    if compared:
        recording, tolerances = forms._observation.recording, forms.tolerances
        keys = tuple(one.key for one, at in tolerances.each for _ in range(at.start, at.stop))
        known = 0.1 * np.linalg.inv(tolerances.precision)
        earlier = Earlier(("before",), (), keys, known)
        forms = Forms(Observation(replace(recording, earlier=earlier)))
    observation, behind, tolerances = forms._observation, forms.behind, forms.tolerances
    generator = np.random.default_rng(2)
    fitted = 0.5 * generator.standard_normal(tolerances.size) * behind.prior_std[-tolerances.size :]
    background = np.concatenate([np.ones(behind.columns.shape[1] - tolerances.size), fitted])
    change = observation.change(tolerances.effects(background))
    expected = behind.columns[:, -tolerances.size :] @ fitted
    assert np.linalg.norm(change - expected) < 0.02 * np.linalg.norm(expected)


def test_no_gap_has_no_budget(healthy_sweep):
    observation = Observation(healthy_sweep)
    observation.nominal = np.random.default_rng(1).standard_normal(len(observation.rows))
    assert budget_of(Forms(observation), observation) == ()


def test_an_item_is_within_beyond_or_undecided():
    share = Interval(0.5, 0.4, 0.6)
    limited = BudgetItem("axis_gain", share, limits={"gain": 1.0}, probability_beyond=0.03)
    assert limited.standing == "within"
    assert replace(limited, probability_beyond=0.95).standing == "beyond"
    assert replace(limited, probability_beyond=0.5).standing == "undecided"
    assert replace(limited, probability_beyond=None).standing == "undecided"
    assert BudgetItem("bias_step", share).standing is None
    two = replace(limited, parameters={"gain": [share] * 2}, limits={"gain": [0.5, 0.6]}).to_json()
    assert [one["limit"] for one in two["parameters"]["gain"]] == [0.5, 0.6]
    assert Interval(0.5, None, None).to_json() == {"value": 0.5, "ci95": None}
    assert BudgetItem(RESIDUAL, share).to_json() == {
        "effect": RESIDUAL, "share": {"value": 0.5, "ci95": [0.4, 0.6]},
    }  # fmt: skip


def test_a_recording_of_another_arm_is_no_reference():
    later, other = (
        SimpleNamespace(
            name=name, arm=SimpleNamespace(joint_names=(joint,)), earlier=None, readings=None
        )
        for name, joint in (("later", "tilt"), ("other", "elbow"))
    )
    with pytest.raises(GalenError, match=r"other: no reference of later.*elbow, not tilt"):
        diagnose_recording(later, references=[other])


def answer_of(tmp_path, capsys, *arguments):
    out = tmp_path / "out"
    command = ["--json", "--no-report", "--overwrite", "--output", str(out)]
    assert main([*map(str, arguments), *command]) == 0
    return json.loads(capsys.readouterr().out)


@pytest.mark.slow
def test_since_a_reference_only_what_has_changed_is_a_cause(ordinary, tmp_path, capsys):
    later = made(tmp_path, "later", *ARM, ToolMassError(0.001), seed=5)
    same = made(tmp_path, "same", *ARM, seed=6)
    changed = answer_of(tmp_path, capsys, later, "--reference", ordinary)
    assert changed["reference"] == ["ordinary"]
    assert [cause["effect"] for cause in changed["causes"]] == ["tool_mass_error"]
    low, high = changed["causes"][0]["parameters"]["delta_kg"]["ci95"]
    # A made arm's file is off by its own deviation, another one in each.
    assert low < 0.001 < high
    unchanged = answer_of(tmp_path, capsys, same, "--reference", ordinary)
    assert unchanged["verdict"] == "none"
    assert unchanged["sentence"].startswith("Unchanged since ordinary")
    alone = answer_of(tmp_path, capsys, later)
    assert alone["verdict"] == "none" and alone["reference"] is None
    assert sum(one["share"]["value"] for one in alone["budget"]) == pytest.approx(1.0)
    standings = {one["specification"] for one in alone["budget"] if "specification" in one}
    assert "within" in standings and "beyond" not in standings


def test_draws_of_the_nominal_arm_have_no_stiffness_and_count_for_none():
    effect = sought(SimpleNamespace(arm=GALEN, readings=None))["joint_compliance"]
    part = plain_form(effect, "first", np.array([0]))
    found = parameters_of(None, part, np.array([0.1]), np.array([[0.0], [0.05], [0.15]]))
    ((low, high),) = [(one.low, one.high) for one in found["stiffness"].values()]
    (stiffer,) = parameters_of(None, part, np.array([0.05]), np.array([[0.05]]))[
        "stiffness"
    ].values()
    assert 0.0 < low < high <= stiffer.value
