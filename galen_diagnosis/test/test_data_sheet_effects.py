# SPDX-License-Identifier: Apache-2.0
"""What every data sheet has: eccentricity, nonlinearity, hysteresis and creep, found with sizes."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from galen_diagnosis.answer.answer import Interval
from galen_diagnosis.effects.candidates import plain_form
from galen_diagnosis.effects.forms import Forms, healthy_background, unknown_columns
from galen_diagnosis.effects.registry import record_of
from galen_diagnosis.effects.sensor import lagging_candidates, nonlinear_candidates
from galen_diagnosis.inference.budget import beyond_chance, limits_of
from galen_diagnosis.inference.refine import nothing, refine
from galen_diagnosis.inference.search import _begun, search
from galen_diagnosis.observation.observation import Observation, Unknowns
from galen_diagnosis.observation.recording import read_recording
from galen_diagnosis.observation.specification import (
    CALIBRATED,
    DEFAULT,
    Specification,
    specification_of,
)
from galen_diagnosis.simulated_recording import make_recording, sweep_poses
from galen_model.arm.galen import GALEN
from galen_sim_driver.effects.effect import Instants
from galen_sim_driver.effects.hysteresis import DeflectionCreep
from galen_sim_driver.effects.joints import JointEccentricity
from galen_sim_driver.effects.registry import contract_parameters, limit_parts
from galen_sim_driver.effects.sensor import SensorHysteresis, SensorNonlinearity
from galen_sim_driver.replay import Replay


def recorded(folder, effects, bag="sweep"):
    poses = sweep_poses(GALEN)[::2]
    make_recording(folder, effects, 6, "retractor", arm=GALEN, poses=poses, bags=(bag,))
    return read_recording(folder)


@pytest.fixture(scope="module")
def healthy(healthy_sweep):
    return Observation(healthy_sweep)


def with_lag(observation, effect, kept=0.0):
    """The recording as a sensor with this hysteresis, and what it has kept, would read it."""
    recording = observation.recording
    bag = recording.bags["sweep"]
    load = _load(observation, bag.wrench_s)
    lag = effect.lag(Instants("sweep", bag.wrench_s, bag.wrench_s), load) + kept
    return replace(recording, bags={"sweep": replace(bag, wrenches=bag.wrenches - lag)})


def _load(observation, at_s):
    known_s, thin = observation.views["sweep"].scene.wrench_s, observation.nominal_reading("sweep")
    return np.stack([np.interp(at_s, known_s, axis) for axis in thin.T], axis=1)


def test_columns_of_the_sensor_are_what_the_simulator_does(healthy):
    zero = np.stack(
        [healthy.change((), Unknowns(np.eye(18)[k] * 0.01)) / 0.01 for k in range(6)], axis=1
    )
    for candidate in (
        *nonlinear_candidates(healthy, zero)[::5],
        *lagging_candidates(healthy, zero)[::5],
    ):
        size = 0.1 * candidate.typical
        told = healthy.change([candidate.at(size)])
        assert candidate.columns @ size == pytest.approx(told, abs=1e-6 + 0.01 * np.abs(told).max())
        assert np.abs(told).max() > 0.01, candidate.label


@pytest.mark.parametrize("whole", [False, True])
def test_a_sensor_bends_with_its_whole_load_or_with_what_it_reads(whole, healthy):
    """As the square of what it reads, the one of its whole load would have a gain beside it."""
    bag = healthy.recording.bags["sweep"]
    tare = Replay(healthy.views["sweep"].scene).tare()[0, 0]
    effect = SensorNonlinearity("fx", 0.02, tare=float(whole * tare))
    wrenches = bag.wrenches.copy()
    wrenches[:, 0] += effect.too_much(wrenches[:, 0])
    bags = {"sweep": replace(bag, wrenches=wrenches)}
    observation = Observation(replace(healthy.recording, bags=bags))
    forms = Forms(observation)
    judged = {c.label: e.log_bayes for c, e in forms.judged(observation.nominal, forms.behind)}
    right, wrong = ("fx even", "fx even of its load")[:: -1 if whole else 1]
    assert judged[right] > judged[wrong] + 20.0


@pytest.mark.parametrize("sharp", [False, True])
@pytest.mark.parametrize("of_range", [False, True])
def test_what_a_lag_keeps_from_before_a_bag_goes_and_is_among_its_columns(sharp, of_range, healthy):
    effect = SensorHysteresis(0.01, knee=0.3, sharp=sharp, of_range=of_range)
    kept = _kept(healthy, effect)
    assert np.all(np.abs(kept) <= np.abs(kept[0]) + 1e-12)
    if not of_range:
        assert np.abs(kept[-1]).max() < 0.05 * np.abs(kept[0]).max(), "a sweep wipes it out"
    lagging = Observation(with_lag(healthy, replace(effect, fraction=0.0), kept))
    columns = record_of(effect.name).before_bag(effect, healthy, unknown_columns(healthy)[:, :6])
    told = healthy.nominal - lagging.nominal
    assert columns.shape[1] == 6
    assert np.linalg.norm(told + columns.sum(axis=1)) < 0.1 * np.linalg.norm(told)


def test_a_lag_that_was_at_its_end_before_the_bag_is_found_alone(healthy):
    """Where moves that weren't recorded have left it, which was a drift beside it."""
    effect = SensorHysteresis(0.01, knee=0.2, of_range=True)
    observation = Observation(with_lag(healthy, effect, _kept(healthy, effect)))
    found = search(observation).weighed[0]
    assert found.names == (effect.name,)
    assert found.hypothesis.effects[0].fraction == pytest.approx(effect.fraction, rel=0.1)


def _kept(observation, effect):
    at_s = observation.recording.bags["sweep"].wrench_s
    return effect.kept(_load(observation, at_s))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("effect", "bag"),
    [
        (JointEccentricity("tilt", 0.004, 2.0, 0.8), "sweep"),
        (JointEccentricity("roll", 0.004, 2.6, 3.1), "sweep"),
        (SensorNonlinearity("fy", 0.02, True), "sweep"),
        (SensorNonlinearity("tz", -0.3), "sweep"),
        (SensorHysteresis(0.02, -1.0, 0.3, "force"), "sweep"),
        (SensorHysteresis(0.02, knee=0.3, restarts=False, sharp=True), "sweep"),
        (DeflectionCreep(0.15, 1.5), "push"),
    ],
)
def test_is_found_alone_with_its_size(effect, bag, healthy, tmp_path):
    if isinstance(effect, SensorHysteresis):
        recording = with_lag(healthy, effect)
    else:
        recording = recorded(tmp_path / "made", (effect,), bag)
    observation = Observation(recording)
    forms = Forms(observation)
    none = nothing(observation, forms.behind)
    judged = forms.judged(none.raw_rows, forms.behind)
    candidate, found = max(judged, key=lambda pair: pair[1].log_bayes)
    assert candidate.effect == effect.identity
    part, start = _begun(candidate, found.theta)
    fit = refine(observation, forms.behind, [part], [start], None, none.cost)
    assert fit.log_bayes > 20.0
    told = record_of(effect.name).parameters(observation, fit.effects[0])
    for name, value in contract_parameters(effect).items():
        assert told[name] == (value if isinstance(value, str) else pytest.approx(value, rel=0.12))


LIMITS = {
    "joint_eccentricity": {"tilt": 2e-4, "default": 4e-4},
    "sensor_nonlinearity": {"tx": 8e-4, "default": 6e-4},
    "sensor_hysteresis": 1e-3,
    "deflection_creep": 0.01,
}


def specified(folder, limits):
    path = folder / "specification.json"
    path.write_text(json.dumps({"schema_version": 1, "limits": limits}))
    return specification_of([path, CALIBRATED], limit_parts(GALEN))


def test_within_its_limit_each_is_a_healthy_arms_tolerance(healthy, tmp_path):
    usual = Observation(replace(healthy.recording, specification=specified(tmp_path, {})))
    limited = Observation(replace(healthy.recording, specification=specified(tmp_path, LIMITS)))
    plain, std = (healthy_background(one).prior_std for one in (usual, limited))
    # Two squares of each axis; force and torque; the tilt's eccentricity, of one and two cycles
    # with two numbers each, is another one. Without pushes no creep is seen.
    sizes = (4e-4, 3e-4, 5e-4, 1e-4, 2e-4)
    more = [int(np.sum(std == size) - np.sum(plain == size)) for size in sizes]
    assert more == [2, 10, 2, 4, -4]
    assert len(std) == len(plain) + 14


def test_what_is_fitted_beside_a_size_has_no_limit(healthy):
    draws = np.array([[1e-4, 1e-4, 3.0]])
    for effect, numbers in (
        (JointEccentricity("tilt"), draws),
        (SensorHysteresis(), draws[:, [0, 2]]),
        (DeflectionCreep(), draws[:, [0, 2]]),
    ):
        candidate = plain_form(effect)
        named = {
            key: Interval(value, None, None)
            for key, value in contract_parameters(candidate.at(numbers[0])).items()
            if not isinstance(value, str)
        }
        asked = Specification("made", "", {effect.name: {DEFAULT: 3e-4}})
        observation = SimpleNamespace(recording=SimpleNamespace(specification=asked))
        limits = limits_of(asked, candidate, named)
        assert list(limits.values()) == [3e-4]
        assert beyond_chance(observation, candidate, numbers, limits) == 0.0
        assert beyond_chance(observation, candidate, 10.0 * numbers, limits) == 1.0
