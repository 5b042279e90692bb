# SPDX-License-Identifier: Apache-2.0
"""Effects of the tracker and of its base marker."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from galen_sim_driver.effects.sensor import BaseShift, TrackerDelay, TrackerScale

from galen_diagnosis.effects.candidates import Candidate, plain_form
from galen_diagnosis.effects.diagnosed_effect import DiagnosedEffect, no_forms
from galen_diagnosis.effects.jumps import Jump
from galen_diagnosis.observation.observation import UNKNOWNS, Observation

_LONG_S = 0.1


def _delays(_: Observation, effect: TrackerDelay) -> Iterator[Candidate]:
    """Yield a short delay, and one of about _LONG_S, over which pushes come and go.

    How likely that is linearly, and where its fit begins, is by a difference of this size.
    """
    short = plain_form(effect)
    yield short
    yield replace(
        plain_form(effect, "long"),
        probe=np.array([_LONG_S]),
        wider=True,
        into=lambda values: (short, np.clip(values, *short.limits())),
    )


TRACKER_DELAY = DiagnosedEffect(
    name=TrackerDelay.name,
    title="late tracker",
    sentence="the tracker's stamps are {delay_s} late",
    remedy="take the delay off the stamps in the tracker's driver",
    needs="tracker",
    healthy=True,
    forms=_delays,
    known="firm",
    by_second=True,
    mujoco="the tip's pose stamped t is that of t - delay_s",
    gazebo="no such thing: the same shift",
)

TRACKER_SCALE = DiagnosedEffect(
    name=TrackerScale.name,
    title="tracker's scale",
    sentence="the tracker's positions are {gain} too large",
    remedy="have the tracker calibrated",
    needs="tracker",
    healthy=True,
    mujoco="positions in the tracker's frame are (1 + gain) times the site's",
    gazebo="no such thing: the same formula",
)

BASE_SHIFT = DiagnosedEffect(
    name=BaseShift.name,
    title="moved base marker",
    sentence="the base marker's stand moves at {time_s} of push, by {translation_m} and"
    " {rotvec_rad}",
    remedy="fasten the base marker's stand, and record the pushes again",
    needs="tracker",
    forms=no_forms,
    jump=Jump(
        effect=lambda _, at_s: BaseShift(time_s=at_s),
        unknowns=slice(12, UNKNOWNS),
        typical=np.array([1e-3] * 3 + [3e-3] * 3),
        grid_s={"push": 0.2},
        tracked=True,
    ),
    known="firm",
    mujoco="from time_s of push on the base marker is displaced by translation_m and rotvec_rad"
    " along the base's axes",
    gazebo="no such thing: the same displacement",
)
