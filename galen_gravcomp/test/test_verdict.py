# SPDX-License-Identifier: Apache-2.0
"""The verdict on still phases that were made up, so that each rule is met on its own."""

import numpy as np
import pytest
from galen_gravcomp.evaluate.residual import decompose, find_change, judge
from galen_model.arm.galen import SENSOR
from galen_model.load.verdict import Cause, Limits
from galen_model.rest.binned import StillPhases
from gravcomp_bags import START_NS, tool_file

LIMITS = Limits()
NOISE = SENSOR.noise_std / 10.0
NOWHERE = np.full(6, np.nan)


def phases(true, tool, count=20, *, seed=1, noise=1.0, angles=None, every_s=5.0, left=0.0):
    """Phases of a recording of `true` that was compensated as `tool`; `left` (n, 6) is added."""
    rng = np.random.default_rng(seed)
    if angles is None:
        angles = np.column_stack([rng.uniform(-1.3, 1.3, count), rng.uniform(-0.9, 0.9, count)])
    mean = true.predict(angles) - tool.predict(angles)
    start = START_NS + np.round(every_s * 1e9 * np.arange(len(angles))).astype(np.int64)
    return StillPhases(
        start,
        start + 1_000_000_000,
        np.full(len(angles), 100),
        mean + left + noise * rng.normal(size=mean.shape) * NOISE,
        np.tile(NOISE, (len(angles), 1)),
        angles,
        np.ones(0, dtype=bool),
        SENSOR.noise_std,
    )


def told(found, tool):
    change = find_change(found, tool, LIMITS)
    parts = None if change else decompose(found, tool)
    verdict = judge(found, parts, change, tool, LIMITS, moving=NOWHERE, start_ns=START_NS)
    return verdict.cause, verdict.text


def alternating(count, size, axis):
    """What no load, offset or drift follows."""
    left = np.zeros((count, 6))
    left[:, axis] = size * np.random.default_rng(8).choice([-1.0, 1.0], count)
    return left


def test_stronger_gravity_in_the_file_makes_a_smaller_mass_of_the_same_weight():
    gravity = np.array([0.0, 0.0, -1.2 * 9.80665])
    stronger, heavier = (tool_file(mass, gravity_m_s2=gravity) for mass in (0.2, 0.3))
    parts = decompose(phases(heavier, stronger), stronger)
    assert parts.values["load"][0] == pytest.approx(0.1, abs=1e-3)


@pytest.mark.parametrize(
    ("count", "every_s", "why"),
    [(7, 20.0, "7 rest segments are too few"), (8, 20.0, ""), (20, 1.2, "the rest segments span")],
)
def test_drift_takes_eight_phases_and_half_a_minute(count, every_s, why):
    tool = tool_file()
    parts = decompose(phases(tool, tool, count, every_s=every_s), tool)
    assert (parts.why_no_drift == why) if not why else parts.why_no_drift.startswith(why)
    assert ("drift" not in parts.values) == bool(why)


def test_a_step_within_the_limits_is_no_change():
    tool = tool_file()
    left = np.zeros((20, 6))
    left[10:, 0] = 0.04
    found = phases(tool, tool, noise=0.05, left=left)
    assert find_change(found, tool, LIMITS) is None
    left[10:, 0] = 0.4
    change = find_change(phases(tool, tool, noise=0.05, left=left), tool, LIMITS)
    assert (change.first_after, change.mass_kg) == (10, None)
    assert change.offset_step[0] == pytest.approx(0.4, abs=0.01)
    assert change.time_ns == START_NS + 48_000_000_000


def test_adapter_and_tool_off_is_not_less_than_nothing():
    """The file's mass is the tool's; with the adapter off as well, the reading misses both."""
    tool = tool_file()
    bare = tool_file(mass_kg=-0.1, com_m=(0.0, 0.0, 0.02))
    verdict, sentence = told(phases(bare, tool, 30), tool)
    assert verdict is Cause.LOAD
    assert sentence.endswith("(no tool on it?)")


@pytest.mark.parametrize(
    ("offset", "rest", "verdict"),
    [
        (0.12, 0.02, Cause.OFFSET),
        (0.12, 0.045, Cause.OFFSET),
        # taken off, more than half would be left
        (0.04, 0.04, Cause.UNEXPLAINED),
        # taken off, it would still not fit
        (0.18, 0.09, Cause.UNEXPLAINED),
        # nor here, but by far the most is the offset
        (1.0, 0.09, Cause.OFFSET),
    ],
)
def test_what_would_not_fix_it_is_not_the_reason(offset, rest, verdict):
    tool = tool_file()
    left = alternating(30, rest, 0)
    left[:, 0] += offset
    found, sentence = told(phases(tool, tool, 30, left=left), tool)
    assert found is verdict
    besides = rest > 0.025 and verdict is Cause.OFFSET
    assert ("besides, 0.0" in sentence) == besides
    assert ("which a tare subtracts" in sentence) == (verdict is Cause.OFFSET and not besides)
