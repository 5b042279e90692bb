"""A made-up recording's rows and streams, and diagnoses of it: for tests of what shows them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from galen_diagnosis.answer.answer import Answer, Diagnosis, FoundCause, Interval
from galen_diagnosis.answer.localization import localize
from galen_diagnosis.observation.rows import BAGS, CHANNELS, FOLDS, REGIMES, ResidualRows, Stream
from galen_diagnosis.report.words import sentence
from galen_sim_driver.effects.joints import JointZeroOffset

TILTS = np.linspace(-0.9, 0.8, 7)
ROLLS = np.linspace(-1.4, 1.4, 8)
WRENCH_NOISE = np.array([0.02, 0.02, 0.03, 4e-4, 4e-4, 4e-4])
TIP_NOISE = np.array([3e-5] * 3 + [1e-4] * 3)
WRENCH, TIP, MARKER = CHANNELS[:6], CHANNELS[6:12], CHANNELS[12:]


def example_rows(rows_a_pose=2, seed=0):
    """Rows of three bags: 56 poses, 45 s of motion, four positions with pushes."""
    parts = []
    for pose in range(56):
        tilt, roll = TILTS[pose // 8], ROLLS[pose % 8]
        at_s = 2.3 * pose + 0.8 + 0.5 * np.arange(rows_a_pose)
        joints = np.tile([0.0, 0.0, 0.408, roll, tilt], (rows_a_pose, 1))
        parts.append(_part("sweep", "still", at_s, joints, 0.0 * joints, pose, pose, WRENCH))
    at_s = np.arange(0.0, 45.0, 0.25)
    amplitude = np.array([0.03, 0.03, 0.03, 1.2, 0.8])
    speed = np.array([0.7, 0.9, 0.5, 0.6, 0.8])
    middle = np.array([0.0, 0.0, 0.408, 0.0, 0.0])
    joints = middle + amplitude * np.sin(np.outer(at_s, speed))
    rate = amplitude * speed * np.cos(np.outer(at_s, speed))
    for first in range(0, len(at_s), 12):
        own = slice(first, first + 12)
        for regime, sign in (("moving+", 1.0), ("moving-", -1.0)):
            moving = sign * rate[own, 4] > 0
            block = 56 + first // 12
            chosen = (at_s[own][moving], joints[own][moving], rate[own][moving])
            parts.append(_part("motion", regime, *chosen, -1, block, WRENCH))
    for position in range(4):
        place = np.array([0.02 * position, 0.0, 0.4, 0.3 * position - 0.5, 0.2 * position - 0.3])
        for push in range(18):
            for part, regime in enumerate(("loading", "held", "unloading", "rest")):
                at_s = np.array([30.0 * position + 3.0 + 1.5 * push + 0.375 * part])
                block = 72 + 6 * position + push // 3
                joints = place[None]
                channels = TIP + MARKER + (WRENCH if regime == "rest" else ())
                parts.append(
                    _part("push", regime, at_s, joints, 0 * joints, position, block, channels)
                )
    columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    return ResidualRows(**columns)


def _part(bag, regime, at_s, joints, rate, pose, block, channels):
    n, k = len(at_s), len(channels)
    start_s = {"sweep": 0.0, "motion": 143.0, "push": 202.0}[bag]
    noise = dict(zip(CHANNELS, (*WRENCH_NOISE, *TIP_NOISE, *TIP_NOISE), strict=True))

    def every(value):
        return np.full(n * k, value)

    return {
        "channel": np.tile([CHANNELS.index(name) for name in channels], n),
        "bag": every(BAGS.index(bag)),
        "regime": every(REGIMES.index(regime)),
        "bag_s": np.repeat(at_s, k),
        "session_s": np.repeat(at_s, k) + start_s,
        "pose": every(pose),
        "block": every(block),
        "fold": every(block % FOLDS),
        "joints": np.repeat(joints, k, axis=0),
        "rate": np.repeat(rate, k, axis=0),
        "samples": every(25),
        "scale": np.tile([noise[name] / 5.0 for name in channels], n),
    }


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
    tilt = FoundCause(
        "joint_zero_offset",
        0.93,
        {"offset_rad": Interval(0.0102, 0.0099, 0.0105)},
        (),
        Interval(0.98, 0.97, 0.99),
        joint="tilt",
    )
    turned = FoundCause(
        "sensor_mount_rotation",
        0.45,
        {"rotvec_rad": [Interval(0.0, -1e-4, 1e-4), Interval(0.01, 9e-3, 11e-3)]
         + [Interval(0.0, -1e-4, 1e-4)]},
        ("joint_zero_offset:tilt",),
        Interval(0.97, 0.95, 0.99),
    )  # fmt: skip
    causes = {"identified": (tilt,), "ambiguous": (tilt, turned)}.get(verdict, ())
    offset = "joint_zero_offset:tilt"
    ranking = {
        "none": (("none", 0.97), ("unknown", 0.02), (offset, 0.01)),
        "unknown": (("unknown", 0.96), ("cable_drag", 0.04), ("none", 0.0)),
        "ambiguous": (
            (offset, 0.5),
            ("sensor_mount_rotation", 0.45),
            ("none", 0.0),
        ),
    }.get(verdict, ((offset, 0.93), ("unknown", 0.05), ("none", 0.0)))
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
