# SPDX-License-Identifier: Apache-2.0
"""What a diagnosis of one recording takes, part by part, beside reading the recording's bags.

The recording is simulated: an arm with one effect, all three bags, some 40 000 messages. Baseline
is rosbags reading and deserialising every message of it.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from galen_diagnosis.inference.diagnosing import diagnose_recording
from galen_diagnosis.observation.recording import read_recording
from galen_diagnosis.simulated_recording import make_recording
from galen_model.arm.galen import GALEN
from galen_sim_driver.effects.sensor import AxisGain
from rich.table import Table

from galen_validation.speed.bags import rosbags_deserialise
from galen_validation.speed.nodes import spread

TITLE = "diagnosis of one recording"
BASELINE = "rosbags read and deserialise"
WHOLE = "whole diagnosis"
_EFFECT = AxisGain(gain=(0.05, 0.0, 0.0, 0.0, 0.0, 0.0))


@dataclass(frozen=True)
class Part:
    """Wall time of one part in one round, s."""

    part: str
    seconds: float


def measure(options: argparse.Namespace, progress: Callable[[str], None]) -> list[Part]:
    """Diagnose a simulated recording several times, beside reading it.

    Args:
        options: The command's; `rounds`: how often.
        progress: Called with what is done next.

    Returns:
        Of each round the baseline, the reading, and the whole diagnosis with its reading.

    """
    found: list[Part] = []
    with tempfile.TemporaryDirectory(prefix="galen_bench_") as directory:
        recording = Path(directory, "recording")
        progress("simulating a recording")
        make_recording(recording, [_EFFECT], seed=1, arm=GALEN)
        bags = [metadata.parent for metadata in sorted(recording.glob("*/metadata.yaml"))]
        for number in range(options.rounds):
            progress(f"diagnosis {number + 1} of {options.rounds}")
            found.append(Part(BASELINE, _timed(lambda: [rosbags_deserialise(b, b) for b in bags])))
            began_s = time.perf_counter()
            read = read_recording(recording, None)
            found.append(Part("reading", time.perf_counter() - began_s))
            diagnose_recording(read)
            found.append(Part(WHOLE, time.perf_counter() - began_s))
    return found


def table(found: Sequence[Part]) -> Table:
    """Make a row of each part: least/median/largest of the rounds, and median over the baseline's.

    Args:
        found: What `measure` returned.

    Returns:
        The table.

    """
    out = Table("part", "s", "x reading by rosbags", box=None, header_style="bold")
    base = statistics.median(one.seconds for one in found if one.part == BASELINE)
    for name in dict.fromkeys(one.part for one in found):
        own = [one.seconds for one in found if one.part == name]
        out.add_row(name, spread(own, 2), f"{statistics.median(own) / base:.1f}")
    return out


def _timed(call: Callable[[], object]) -> float:
    began_s = time.perf_counter()
    call()
    return time.perf_counter() - began_s
