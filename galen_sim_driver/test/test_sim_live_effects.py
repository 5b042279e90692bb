# SPDX-License-Identifier: Apache-2.0
"""The plant with effects set by parameters, against `replay` with the same effects."""

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from galen_common.parameters import param_fields
from galen_model.arm.galen import GALEN
from galen_model.errors import GalenError
from galen_model.rotation import quaternion_to_matrix, rotvec_to_matrix
from galen_sim_driver.effects.registry import effect_from, identities
from galen_sim_driver.effects.sensor import (
    BaseShift,
    BiasStep,
    Crosstalk,
    SensorDrift,
    SensorSaturation,
    WrenchDelay,
)
from galen_sim_driver.parameters import (
    EffectParameters,
    driver_file,
    driver_parameters,
    effects_of,
    parameter_name,
)
from galen_sim_driver.plant.config import BASE_IN_TRACKER, BASE_MARKER, HandPush
from galen_sim_driver.replay import Replay
from sim_bench import TURNED, make_plant, run, scene, to_rest, typical

RATE_HZ = 200.0
PUSHES = [
    HandPush(1.2, 0.6, (0.0, 10.0, 0.0)),
    HandPush(1.9, 0.6, (-6.0, 0.0, 8.0), (0.05, -0.03, 0.0)),
]
EXACT = {
    "rate_hz": RATE_HZ,
    "start_ns": 0,
    "encoder_quantum": (1e-12,) * 5,
    "noise": False,
    "quantise": False,
    "tracker_rate_hz": 50.0,
    "hand": PUSHES,
}
BASE = BASE_IN_TRACKER
IDENTITIES = identities(GALEN)


def scene_of(effects):
    """What the plant tells of a motion and two pushes: the scene, tracker poses, untouched rows."""
    plant = make_plant("retractor", effects=tuple(effects), **EXACT)
    plant.command(to_rest(TURNED, 1.0))
    plant.start_hand()
    samples = run(plant, round(2.7 * RATE_HZ))
    stamps = np.array([s.stamp_ns for s in samples]) * 1e-9
    looks = [k for k, sample in enumerate(samples) if sample.tracker is not None]
    given = scene(
        stamps + plant.wrench_delay_ns * 1e-9,
        np.array([s.positions for s in samples]),
        joint_s=stamps,
        reading=np.array([s.wrench for s in samples]),
        touched=stamps > 1.2,
        tracker_s=stamps[looks] + plant.tracker_delay_ns * 1e-9,
    )
    return given, [samples[k].tracker for k in looks]


@cache
def nominal():
    return scene_of([])


# Those that clip, are smoothed, or know more of a whole bag.
NOT_TOGETHER = {
    *("sensor_saturation", "sensor_hysteresis"),
    *("inertial_load", "deflection_hysteresis"),
}
CASES = {name: (typical(effect),) for name, effect in IDENTITIES.items()} | {
    "sensor_saturation": (SensorSaturation(0.9, "fx"),),
    "sensor_drift": (SensorDrift.through([0.0, 0.5, 3.0], 0.1 * np.arange(18.0).reshape(3, 6)),),
    "bias_step": (BiasStep(0.5, (0.1, 0.2, -0.3, 0.01, 0.0, 0.0)),),
    "wrench_delay": (WrenchDelay(0.025),),
    "base_shift": (BaseShift((0.001, -0.002, 0.003), (0.01, 0.02, -0.03), 1.5),),
    "together": tuple(typical(e) for name, e in IDENTITIES.items() if name not in NOT_TOGETHER),
}
# What is told of a remembered or differentiated path hangs on when somebody looks: replay smooths
# rates over 80 ms, knows the largest load of a bag beforehand, and sees the tip only when the
# tracker does. Springs are those of a place near by. As parts of what the effect does.
WRENCH_DIFFERS = {"inertial_load": 0.06, "sensor_hysteresis": 0.6}
TIP_DIFFERS = {
    "deflection_hysteresis": 0.15,
    "backlash": 0.06,
    "joint_eccentricity:roll": 1e-4,
    "joint_eccentricity:tilt": 1e-4,
    "together": 0.01,
}


@pytest.mark.parametrize("name", CASES)
def test_the_plant_with_parameters_tells_what_replay_with_the_effects_tells(name):
    effects = CASES[name]
    values = json.loads(json.dumps(driver_parameters(effects)))
    lists = {key: tuple(value) for key, value in values.items() if isinstance(value, list)}
    live = effects_of(EffectParameters(**(values | lists)))
    assert live == effects
    told, seen = scene_of(live)
    replay, (before, seen_before) = Replay(told, effects), nominal()
    untouched = ~told.touched
    error = np.abs(replay.reading() - told.reading)[untouched].max()
    size = np.abs(before.reading - told.reading)[untouched].max()
    assert error < WRENCH_DIFFERS.get(name, 0.0) * size + 1e-11

    # What was clipped, or lags by what a bag doesn't know, can't be told back: there the push is
    # taken as it was.
    lost = name in ("sensor_saturation", "sensor_hysteresis")
    applied = Replay(before).applied_wrench() if lost else None
    base_turn, base_m = rotvec_to_matrix(BASE.rotvec_rad), np.array(BASE.translation_m)
    turn, position = replay.seen_by_tracker(*replay.tip(applied), base_turn, base_m)
    told_m = np.array([tool[0] for tool, _ in seen])
    error = np.abs(position - told_m).max()
    size = np.abs(told_m - [tool[0] for tool, _ in seen_before]).max()
    differs = TIP_DIFFERS.get(name, 0.0)
    assert error < differs * size + 1e-11
    turned = quaternion_to_matrix([tool[1] for tool, _ in seen])
    assert np.abs(turn - turned).max() < 10.0 * differs * size + 1e-11

    marker, moved = BASE_MARKER, replay.base_marker()
    at = base_m + (np.array(marker.translation_m) + moved[:, :3]) @ base_turn.T
    for effect in effects:
        at = effect.seen(told.instants(told.tracker_s), at)
    assert np.abs(at - [base[0] for _, base in seen]).max() < 1e-12
    turn = base_turn @ rotvec_to_matrix(moved[:, 3:]) @ rotvec_to_matrix(marker.rotvec_rad)
    turned = quaternion_to_matrix([base[1] for _, base in seen])
    assert np.abs(turn - turned).max() < 1e-12

    # Each shows somewhere, so that all of this could fail.
    late = np.array_equal(told.wrench_s, before.wrench_s) and np.array_equal(
        told.tracker_s, before.tracker_s
    )
    same = np.array_equal(told.reading, before.reading) and seen == seen_before
    assert not (late and same)


@pytest.mark.parametrize("name", IDENTITIES)
def test_every_number_of_an_effect_is_a_parameter_of_the_driver(name):
    effect = IDENTITIES[name]
    kind = type(effect)
    asked = set(param_fields(kind)) - set(kind.recording_only)
    asked -= {"joint"} if kind.of_a_joint else set()
    names = [parameter_name(effect, field) for field in asked]
    assert set(names) <= set(param_fields(EffectParameters))
    assert len(set(names)) == len(asked) > 0
    for p in kind.fitted:  # what a fit may find the driver may have
        if p.name in param_fields(kind):
            _, _, meaning = param_fields(kind)[p.name]
            assert meaning.minimum is None or meaning.minimum <= p.lower
            assert meaning.maximum is None or p.upper <= meaning.maximum


def test_effects_become_a_parameter_file():
    zero = effect_from("joint_zero_offset", {"joint": "tilt", "offset_rad": 0.012}, arm=GALEN)
    effects = [zero, SensorDrift((1.0,) * 6), BiasStep(2.0, (0.1,) * 6, "push")]
    assert driver_file(effects)["sim_driver"]["ros__parameters"] == {
        "joint_zero_offset_tilt_rad": 0.012,
        "sensor_drift_rate_per_hour": [1.0] * 6,
        "bias_step_time_s": 2.0,
        "bias_step": [0.1] * 6,
    }
    with pytest.raises(GalenError, match="one crosstalk at a time"):
        driver_parameters([Crosstalk("fx", "fy", 0.1), Crosstalk("fx", "fz", 0.1)])


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"axis_gain": (0.1,)}, "axis_gain.*1 numbers.*6"),
        ({"crosstalk_from": "up"}, "crosstalk: from is 'up'"),
        ({"sensor_drift_knots_s": (1.0,)}, "sensor_drift: knots_s"),
        ({"backlash_joint": "knee"}, "backlash: joint is 'knee'"),
        ({"inertial_load_own_inertia_kg_m2": (1.0, 1.0, 3.0, 0.0, 0.0, 0.0)}, "no body"),
    ],
)
def test_bad_values_are_named(changes, words):
    with pytest.raises(GalenError, match=words):
        replace(EffectParameters(), **changes).validate()


def test_the_noise_is_the_same_with_and_without():
    offset = BiasStep(0.0, (0.5, -0.5, 0.25, 0.125, 0.0, 0.0))
    scale = effect_from("tracker_scale", {"gain": 0.01}, arm=GALEN)
    plain, other = (
        make_plant("pointer", 1, **EXACT | {"noise": True, "effects": effects})
        for effects in ((), (offset, scale))
    )
    for _ in range(40):
        a, b = plain.step(), other.step()
        assert np.abs(np.array(b.wrench) - a.wrench - offset.step).max() < 1e-12
        if a.tracker is not None:
            exact = np.array(BASE.translation_m)
            far = np.array(b.tracker[0][0]) - a.tracker[0][0]
            assert np.abs(far - 0.01 * np.array(a.tracker[0][0])).max() < 1e-5
            assert np.abs(far).max() > 1e-3 * np.abs(exact).max()
