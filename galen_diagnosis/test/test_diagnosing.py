# SPDX-License-Identifier: Apache-2.0
"""Rows and columns of a healthy arm; whole diagnoses are in test_diagnosis_any_arm.py and
test_disclosed_recordings.py."""

from dataclasses import replace

import numpy as np
import pytest
from galen_diagnosis.effects.forms import candidates
from galen_diagnosis.effects.sensor import crosstalk_candidates
from galen_diagnosis.inference.diagnosing import _cannot_tell
from galen_diagnosis.inference.gap import closed_fraction
from galen_diagnosis.observation.observation import Observation, Unknowns
from galen_diagnosis.observation.rows import CHANNELS, FOLDS
from galen_model.errors import GalenError


@pytest.fixture(scope="module")
def healthy(healthy_sweep):
    return Observation(healthy_sweep)


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


def test_without_pushes_the_answer_says_what_it_cant_tell(healthy):
    lines = "\n".join(_cannot_tell(healthy))
    assert "no push" in lines and "joint_compliance" in lines
