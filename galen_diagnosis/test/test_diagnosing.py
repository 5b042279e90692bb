# SPDX-License-Identifier: Apache-2.0
"""The whole diagnosis on the simulated arm; test_baselines.py has another's arm."""

from dataclasses import replace

import numpy as np
import pytest
from galen_diagnosis.effects.forms import candidates
from galen_diagnosis.effects.sensor import crosstalk_candidates
from galen_diagnosis.inference.diagnosing import _cannot_tell, diagnose_recording
from galen_diagnosis.inference.gap import closed_fraction
from galen_diagnosis.observation.observation import Observation, Unknowns
from galen_diagnosis.observation.recording import read_recording
from galen_diagnosis.observation.rows import CHANNELS, FOLDS
from galen_diagnosis.simulated_recording import make_recording, sweep_poses
from galen_model.arm.galen import GALEN
from galen_model.errors import GalenError
from galen_sim_driver.effects.joints import JointZeroOffset

SWEEP_ONLY = ("sweep",)


@pytest.fixture(scope="module")
def healthy(tmp_path_factory):
    folder = tmp_path_factory.mktemp("healthy") / "made"
    make_recording(folder, seed=3, bags=SWEEP_ONLY, arm=GALEN)
    return Observation(read_recording(folder))


def test_a_healthy_arms_rows_are_white_with_unit_variance(healthy):
    rows = healthy.rows
    assert len(rows) == len(healthy.nominal) > 3000
    for number in np.unique(rows.channel):
        own = healthy.nominal[rows.channel == number]
        chance = np.sqrt(2.0 / len(own))
        assert np.mean(own**2) == pytest.approx(1.0, abs=5.0 * chance), CHANNELS[number]
        assert abs(np.mean(own[1:] * own[:-1])) < 5.0 / np.sqrt(len(own)), CHANNELS[number]


def test_a_recording_too_short_to_hold_anything_out_is_an_error(healthy):
    whole = healthy.recording.bags["sweep"]
    few = replace(whole, wrench_s=whole.wrench_s[:60], wrenches=whole.wrenches[:60])
    with pytest.raises(GalenError, match="score a fit"):
        Observation(replace(healthy.recording, bags={"sweep": few}))
    slow = replace(whole, wrench_s=whole.wrench_s[::25], wrenches=whole.wrenches[::25])
    with pytest.raises(GalenError, match="noise"):
        Observation(replace(healthy.recording, bags={"sweep": slow}))


def test_a_block_is_held_out_whole(healthy):
    rows = healthy.rows
    for number in np.unique(rows.block):
        assert len(np.unique(rows.fold[rows.block == number])) == 1
    assert set(np.unique(rows.fold)) == set(range(FOLDS))


def test_what_unknowns_add_is_what_they_say(healthy):
    offset = np.zeros(18)
    offset[2] = 0.01
    change = healthy.change((), Unknowns(offset))
    rows = healthy.rows
    there = rows.channel == 2
    assert change[~there] == pytest.approx(0.0, abs=1e-12)
    assert change[there] * rows.scale[there] == pytest.approx(0.01, rel=1e-6)


def test_a_candidates_columns_are_the_simulators_slope(healthy):
    for candidate in candidates(healthy):
        if candidate.effect in ("joint_zero_offset:tilt", "tool_com_error"):
            columns = candidate.jacobian(healthy, lambda v, c=candidate: [c.at(v)], candidate.start)
            step = 0.3 * candidate.typical
            told = healthy.change([candidate.at(candidate.start + step)])
            assert columns @ step == pytest.approx(told, abs=0.01 * np.abs(told).max())


def test_crosstalks_shortcut_is_what_the_simulator_does(healthy):
    zero = np.stack(
        [healthy.change((), Unknowns(np.eye(18)[k] * 0.01)) / 0.01 for k in range(6)], axis=1
    )
    for candidate in crosstalk_candidates(healthy, zero)[::7]:
        told = healthy.change([candidate.at(np.array([0.02]))])
        assert candidate.columns[:, 0] * 0.02 == pytest.approx(told, abs=1e-6)


def test_a_gap_that_is_none_has_no_closed_fraction(healthy):
    noise = np.random.default_rng(0).standard_normal(len(healthy.rows))
    assert closed_fraction(healthy.rows, noise, noise, 1.0) is None
    wide = closed_fraction(healthy.rows, 3.0 * noise, noise, 1.0)
    assert wide is not None
    assert wide.value == pytest.approx(1.0, abs=0.05)
    assert wide.low <= wide.value <= wide.high


@pytest.mark.slow
@pytest.mark.timeout(400)
def test_the_simulated_arms_tilt_zero_is_found_and_its_gap_closes(tmp_path):
    effects = [JointZeroOffset("tilt", offset_rad=0.012)]
    poses, bags = sweep_poses(arm=GALEN)[::2], ("sweep", "push")
    make_recording(tmp_path / "made", effects, seed=8, poses=poses, bags=bags, arm=GALEN)
    shares = []
    answer = diagnose_recording(
        read_recording(tmp_path / "made"), progress=lambda what, share: shares.append(share)
    ).answer
    assert answer.verdict == "identified"
    assert answer.ranking[0][0] == "joint_zero_offset:tilt"
    (cause,) = answer.causes
    assert (cause.effect, cause.joint) == ("joint_zero_offset", "tilt")
    found = cause.parameters["offset_rad"]
    assert found.low < 0.012 < found.high
    assert found.value == pytest.approx(0.012, rel=0.05)
    assert answer.gap["closed_fraction"]["value"] > 0.95
    assert shares == sorted(shares)


def test_without_pushes_the_answer_says_what_it_cant_tell(healthy):
    lines = "\n".join(_cannot_tell(healthy))
    assert "no push" in lines and "joint_compliance" in lines
