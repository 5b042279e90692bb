# SPDX-License-Identifier: Apache-2.0
"""A made-up recording's rows and streams, and diagnoses of it: for tests of what shows them."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
from galen_diagnosis.answer.answer import Answer, Diagnosis, FoundCause, Interval
from galen_diagnosis.answer.localization import localize
from galen_diagnosis.observation.rows import BAGS, CHANNELS, FOLDS, REGIMES, ResidualRows, Stream
from galen_diagnosis.report.words import sentence
from galen_model.arm.galen import GALEN
from galen_sim_driver.effects.joints import JointZeroOffset

TILTS = np.linspace(-0.9, 0.8, 7)
ROLLS = np.linspace(-1.4, 1.4, 8)
WRENCH_NOISE = np.array([0.02, 0.02, 0.03, 4e-4, 4e-4, 4e-4])
TIP_NOISE = np.array([3e-5] * 3 + [1e-4] * 3)
WRENCH, TIP, MARKER = CHANNELS[:6], CHANNELS[6:12], CHANNELS[12:]


def example_rows():
    """Rows of three bags: 56 poses, 45 s of motion, four positions with pushes."""
    home, still = np.array([0.0, 0.0, 0.408, 0.0, 0.0]), np.zeros(5)
    samples = []  # bag, its start, regime, time, joints, rate, pose, block, channels
    for pose, (tilt, roll) in enumerate(product(TILTS, ROLLS)):
        at = home + [0.0, 0.0, 0.0, roll, tilt]
        for at_s in (2.3 * pose + 0.8, 2.3 * pose + 1.3):
            samples.append(("sweep", 0.0, "still", at_s, at, still, pose, pose, WRENCH))
    amplitude, speed = np.array([[0.03] * 3 + [1.2, 0.8], [0.7, 0.9, 0.5, 0.6, 0.8]])
    for at_s in np.arange(0.0, 45.0, 0.25):
        rate = amplitude * speed * np.cos(speed * at_s)
        at = home + amplitude * np.sin(speed * at_s)
        regime, block = "moving+" if rate[4] > 0 else "moving-", 56 + int(at_s // 3)
        samples.append(("motion", 143.0, regime, at_s, at, rate, -1, block, WRENCH))
    parts = enumerate(("loading", "held", "unloading", "rest"))
    for place, push, (part, regime) in product(range(4), range(18), parts):
        at = np.array([0.02 * place, 0.0, 0.4, 0.3 * place - 0.5, 0.2 * place - 0.3])
        at_s, block = 30.0 * place + 3.0 + 1.5 * push + 0.375 * part, 72 + 6 * place + push // 3
        channels = TIP + MARKER + (WRENCH if regime == "rest" else ())
        samples.append(("push", 202.0, regime, at_s, at, still, place, block, channels))
    each = [(channel, *sample[:-1]) for sample in samples for channel in sample[-1]]
    channel, bag, start_s, regime, at_s, joints, rate, pose, block = zip(*each, strict=True)
    noise = dict(zip(CHANNELS, (*WRENCH_NOISE, *TIP_NOISE, *TIP_NOISE), strict=True))
    return ResidualRows(
        channel=np.array([CHANNELS.index(name) for name in channel]),
        bag=np.array([BAGS.index(name) for name in bag]),
        regime=np.array([REGIMES.index(name) for name in regime]),
        bag_s=np.array(at_s),
        session_s=np.array(at_s) + start_s,
        pose=np.array(pose),
        block=np.array(block),
        fold=np.array(block) % FOLDS,
        joints=np.array(joints),
        rate=np.array(rate),
        samples=np.full(len(each), 25),
        scale=np.array([noise[name] / 5.0 for name in channel]),
        arm=GALEN,
    )


def tilt_error(rows, size=20.0):
    """Whitened residual (N,) as a wrong zero of the tilt makes it, in fx, fz and ty."""
    tilt, roll = rows.joints[:, 4], rows.joints[:, 3]
    shape = {0: np.sin(tilt) * np.cos(roll), 2: np.cos(tilt) * np.cos(roll), 4: np.cos(tilt)}
    out = np.zeros(len(rows))
    for channel, values in shape.items():
        chosen = rows.channel == channel
        out[chosen] = size * (values[chosen] - values[chosen].mean())
    return out


def example_streams(error=0.0, seed=1):
    """Residuals in time; `error` times the noise, as a sine."""
    rng = np.random.default_rng(seed)
    at_s = np.arange(0.0, 45.0, 0.02)
    streams = []
    for bag, channels, noise in (("motion", WRENCH, WRENCH_NOISE), ("push", TIP, TIP_NOISE)):
        residual = rng.standard_normal((len(at_s), 6)) * noise
        residual[:, 0] += error * noise[0] * np.sin(0.8 * at_s)
        streams.append(Stream(bag, channels, at_s, residual, noise))
    return tuple(streams)


def example_answer(verdict="identified", recording="example"):
    """An answer with that verdict; its numbers are made up."""
    offset = "joint_zero_offset:tilt"
    tilt = FoundCause("joint_zero_offset", 0.93, {"offset_rad": Interval(0.0102, 0.0099, 0.0105)},
                      (), Interval(0.98, 0.97, 0.99), joint="tilt")  # fmt: skip
    nothing, about_y = Interval(0.0, -1e-4, 1e-4), Interval(0.01, 9e-3, 11e-3)
    turned = FoundCause("sensor_mount_rotation", 0.45, {"rotvec_rad": [nothing, about_y, nothing]},
                        (offset,), Interval(0.97, 0.95, 0.99))  # fmt: skip
    causes = {"identified": (tilt,), "ambiguous": (tilt, turned)}.get(verdict, ())
    ranking = {
        "none": (("none", 0.97), ("unknown", 0.02), (offset, 0.01)),
        "unknown": (("unknown", 0.96), ("cable_drag", 0.04), ("none", 0.0)),
        "ambiguous": ((offset, 0.5), ("sensor_mount_rotation", 0.45), ("none", 0.0)),
        "identified": ((offset, 0.93), ("unknown", 0.05), ("none", 0.0)),
    }[verdict]
    closed = None if verdict == "none" else Interval(0.98, 0.97, 0.99).to_json()
    after = 1.01 if verdict in ("identified", "ambiguous") else 8.0
    gap = {
        "before": {"mean_square": 1.0 if verdict == "none" else 17.3},
        "after": {"mean_square": 1.0 if verdict == "none" else after},
        "floor": {"mean_square": 1.0},
        "closed_fraction": closed,
    }
    following = {"separates": ["joint_zero_offset:tilt", "sensor_mount_rotation"], "do": "Push."}
    return Answer(
        recording=recording,
        verdict=verdict,
        causes=causes,
        ranking=ranking,
        where={},
        gap=gap,
        next_experiment=following if verdict == "ambiguous" else None,
        cannot_tell=("without a tracker a tilt's zero looks like a turned sensor",),
        problems=("sweep: 3 stamps went back",),
    )


def example_diagnosis(verdict="identified", recording="example", seed=0):
    """A whole diagnosis with the residuals that belong to it."""
    rows = example_rows()
    noise = np.random.default_rng(seed).standard_normal(len(rows))
    gap = 0.0 if verdict == "none" else 20.0
    before = noise + tilt_error(rows, gap)
    found = verdict in ("identified", "ambiguous")
    after = noise if found else before
    streams = example_streams(gap)
    answer = replace(example_answer(verdict, recording), where=localize(rows, before))
    return Diagnosis(
        answer=replace(answer, sentence=sentence(answer)),
        rows=rows,
        held_out_before=before,
        held_out_after=after,
        streams_before=streams,
        streams_after=example_streams(0.0) if found else streams,
        effects=(JointZeroOffset("tilt", 0.0102),) if found else (),
        floor=1.0,
    )
