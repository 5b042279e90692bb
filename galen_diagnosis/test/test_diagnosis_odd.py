# SPDX-License-Identifier: Apache-2.0
"""What fits and scans do with columns and readings that aren't as they should be."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from galen_diagnosis.effects.candidates import Candidate
from galen_diagnosis.effects.drift import BIAS_STEP, drift_candidates
from galen_diagnosis.effects.forms import unknown_columns
from galen_diagnosis.inference.diagnosing import _full_covariance
from galen_diagnosis.observation.observation import Observation
from galen_diagnosis.observation.recording import read_recording
from galen_diagnosis.simulated_recording import make_recording, sweep_poses
from galen_model.arm.galen import GALEN, WRENCH_AXES
from galen_model.estimation.evidence import Background
from galen_sim_driver.effects.sensor import SensorSaturation

from galen_diagnosis import simulated_recording


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """Seven poses and a motion of 10 s."""
    folder, poses = tmp_path_factory.mktemp("odd") / "made", sweep_poses(arm=GALEN)[::8]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(simulated_recording, "MOTION_S", 10.0)
        make_recording(folder, seed=5, poses=poses, bags=("sweep", "motion"), arm=GALEN)
    return read_recording(folder)


def test_columns_that_are_alike_share_what_they_explain():
    generator = np.random.default_rng(0)
    column, other = generator.standard_normal((2, 50))
    alone = Background(np.stack([column, other], axis=1), np.full(2, np.inf))
    # Rounding can make a gram of twins indefinite; here it is singular for sure.
    twins = np.stack([column, column, other], axis=1)
    behind = Background(twins, np.full(3, np.inf))
    rows = generator.standard_normal(50)
    assert behind.sum_of_squares(rows) == pytest.approx(alone.sum_of_squares(rows), rel=1e-6)


def test_a_step_is_found_whatever_order_the_bags_were_recorded_in(recording):
    sweep, motion = recording.bags["sweep"], recording.bags["motion"]
    jumped = sweep.wrenches + 0.5 * (sweep.wrench_s >= 10.0)[:, None]
    bags = {
        "sweep": replace(sweep, start_s=80.0, wrenches=jumped),
        "motion": replace(motion, start_s=0.0),
    }
    observation = Observation(replace(recording, bags=bags))
    unknown = unknown_columns(observation)
    behind = Background(unknown, np.array([0.1] * 3 + [2e-3] * 3 + [np.inf] * 12))
    found, _ = BIAS_STEP.jump.judged(observation, unknown, observation.nominal, behind)
    bag, at_s = found.base.bag, found.base.time_s
    assert bag == "sweep"
    assert at_s == pytest.approx(10.0, abs=0.5)


def test_a_step_is_sought_only_before_the_last_reading_without_a_push(recording):
    """Later ones would show in the tip alone, as all that a model of the deflection misses."""
    observation = Observation(recording)
    unknown = unknown_columns(observation)
    rows, behind = observation.rows, Background(unknown, np.full(18, 1.0))
    last_s, at_s = 0.6 * rows.session_s.max(), 0.9 * rows.session_s.max()
    jumped = observation.nominal + unknown[:, 0] * (rows.session_s > at_s)
    found, _ = BIAS_STEP.jump.judged(observation, unknown, jumped, behind)
    assert _since_start_s(found, recording) == pytest.approx(at_s, abs=0.5)
    tip = np.where(rows.session_s > last_s, len(WRENCH_AXES), rows.channel)
    observation.rows = replace(rows, channel=tip)
    found, _ = BIAS_STEP.jump.judged(observation, unknown, jumped, behind)
    assert _since_start_s(found, recording) < last_s


def _since_start_s(found, recording):
    return recording.bags[found.base.bag].start_s + found.base.time_s


def test_a_drift_over_days_between_bags_stays_small(recording):
    motion = replace(recording.bags["motion"], start_s=3e5)
    recording = replace(recording, bags={**recording.bags, "motion": motion})
    observation = Observation(recording)
    zero = unknown_columns(observation)[:, :6]
    widths = [one.columns.shape[1] for one in drift_candidates(observation, zero)]
    assert widths[0] == 6
    assert widths[1] <= 6 * 80


def test_loads_beyond_a_limit_are_no_covariance_of_the_limit():
    effect, two = SensorSaturation(limit=4.0, axis="fz"), np.zeros(2)
    part = Candidate(
        "sensor_saturation", "fz 4", effect, np.arange(2), two, two + 2.0, two, inputs=True
    )
    fit = SimpleNamespace(
        parts=(part,), effects=(effect,), covariance=np.eye(2), slices=lambda: [slice(0, 2)]
    )
    assert np.array_equal(_full_covariance(fit), np.zeros((1, 1)))
