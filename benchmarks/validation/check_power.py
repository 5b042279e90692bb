"""How often the quick check is right: simulated changes, its answers, and what they could tell.

    python -m benchmarks.validation.check_power --checks 200

Readings are the simulated sensor's, white noise and quantum, averaged over 0.5 s at 500 Hz. Every
tenth check has a calibration of its own (two sweeps of the default grid) and a place of its own.
Beside the check stands what a ten-parameter least squares of the same readings says, load and
offset without any test of noise or of what is left: recalibrate where its load, re-tare where its
load and offset together are off by more than a limit, anywhere in the arm's range.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from galen_calibration_behavior.calibration.sweep import stack
from galen_calibration_behavior.parameters import CalibrationParameters
from galen_calibration_behavior.quick_check.causes import CheckLimits, load_and_offset
from galen_calibration_behavior.quick_check.decision import differences, quick_check
from galen_calibration_behavior.quick_check.procedure import plan_check
from galen_model.arm.galen import GALEN, SENSOR
from galen_model.arrays import Array
from galen_model.evidence.verdict import CheckAnswer
from galen_model.files.calibration_file import CalibrationFile
from galen_model.load.identification import StillPoses, identify_two_sweeps
from galen_model.load.model import Load, gravity_wrench, nominal_reading
from galen_model.load.nominal_tools import ADAPTER, TOOLS
from galen_model.poses.design import workspace
from galen_model.poses.order import SweepTimes
from galen_model.poses.plan import Surroundings
from galen_model.rest.pose import PoseRecord, average_pose
from rich.console import Console
from rich.table import Table
from tqdm import tqdm

_SAMPLES = 250
_CHECKS_A_FILE = 10
_POWER_CHECKS = 4  # for each of a case's
_PLATFORM = (0.0, 0.0, 0.408)
_LIMITS = CheckLimits()
_ANYWHERE = workspace(13)
_POINTER, _RETRACTOR = TOOLS["pointer"].load, TOOLS["retractor"].load
_SIDE_N = np.array([0.0, 1.0, 0.0, 0.0, 0.0, 0.0])


def _nothing(_roll: float, _tilt: float, _pose: int) -> Array:
    return np.zeros(6)


@dataclass(frozen=True)
class Case:
    """What is on the arm, and what the calibration file believes.

    offset (6,): on all readings; `extra(roll, tilt, pose)` (6,): on each, `pose` from 0.
    """

    name: str
    believed: Load
    true: Load
    offset: Array = field(default_factory=lambda: np.zeros(6))
    extra: Callable[[float, float, int], Array] = _nothing


def loose(load: Load, shift_m: float) -> Callable[[float, float, int], Array]:
    """A tool that hangs `shift_m` aside, the way gravity pulls it across the flange."""

    def extra(roll: float, tilt: float, _pose: int) -> Array:
        gravity = GALEN.gravity_in_sensor(np.stack([roll, tilt], axis=-1))
        aside = gravity / np.linalg.norm(gravity) * (1.0, 1.0, 0.0)
        return np.concatenate([np.zeros(3), np.cross(aside * shift_m, load.mass_kg * gravity)])

    return extra


def tilt_zero(load: Load, offset_rad: float) -> Callable[[float, float, int], Array]:
    """The tilt encoder reads `offset_rad` too little."""

    def extra(roll: float, tilt: float, _pose: int) -> Array:
        true = nominal_reading(np.stack([roll, tilt + offset_rad], axis=-1), load, ADAPTER)
        return true - nominal_reading(np.stack([roll, tilt], axis=-1), load, ADAPTER)

    return extra


def touched(force_n: float) -> Callable[[float, float, int], Array]:
    """A steady push at the third pose."""
    return lambda _roll, _tilt, pose: np.array([force_n, 0, 0, 0, 0, 0]) * (pose == 2)


def heavier(load: Load, mass_kg: float) -> Load:
    """The load with more mass at its centre."""
    return Load(load.mass_kg + mass_kg, load.com_m)


CASES = (
    Case("the file's tool, pointer", _POINTER, _POINTER),
    Case("the file's tool, retractor", _RETRACTOR, _RETRACTOR),
    Case("mass +2 g", _POINTER, heavier(_POINTER, 0.002)),
    Case("offset 0.03 N", _POINTER, _POINTER, 0.03 * _SIDE_N),
    Case("another tool with a file", _POINTER, _RETRACTOR),
    Case("no tool", _RETRACTOR, Load(0.0)),
    Case("mass +5 g, pointer", _POINTER, heavier(_POINTER, 0.005)),
    Case("mass +5 g, retractor", _RETRACTOR, heavier(_RETRACTOR, 0.005)),
    Case("mass +5 g, offset 0.2 N", _RETRACTOR, heavier(_RETRACTOR, 0.005), 0.2 * _SIDE_N),
    Case(
        "centre 3 mm off",
        _RETRACTOR,
        Load(_RETRACTOR.mass_kg, _RETRACTOR.com_m + np.array([0.003, 0.0, 0.0])),
    ),
    Case("offset 0.2 N", _POINTER, _POINTER, 0.2 * _SIDE_N),
    Case(
        "sensor never zeroed",
        _POINTER,
        _POINTER,
        gravity_wrench(GALEN.gravity_in_sensor((0.0, 0.0)), ADAPTER),
    ),
    Case("loose by 3 mm", _RETRACTOR, _RETRACTOR, extra=loose(_RETRACTOR, 0.003)),
    Case("loose by 6 mm", _RETRACTOR, _RETRACTOR, extra=loose(_RETRACTOR, 0.006)),
    Case("tilt's zero 0.02 rad off", _RETRACTOR, _RETRACTOR, extra=tilt_zero(_RETRACTOR, 0.02)),
    Case("one pose touched, 0.3 N", _POINTER, _POINTER, extra=touched(0.3)),
)


class Bench:
    """One file and six poses, and readings there; all by one source of random numbers."""

    def __init__(self, random: np.random.Generator, believed: Load) -> None:
        self._random = random
        self.tool = self.file("tool", believed)
        parameters = CalibrationParameters()
        times = SweepTimes(
            np.zeros(2), parameters.max_velocity[3:], parameters.max_acceleration[3:], 0.9
        )
        here = np.array([*_PLATFORM, *random.uniform((-1.2, -0.8), (1.2, 0.7))])
        self.poses = plan_check(
            here,
            parameters.check_reach_rad,
            parameters.check_poses,
            times,
            Surroundings(),
            np.zeros(3),
        ).poses

    def file(self, name: str, load: Load) -> CalibrationFile:
        """A file as `calibrate` writes it, from two sweeps of its own."""
        settings = CalibrationParameters()
        poses = settings.grid_poses(settings.itersT, settings.itersR)
        found = identify_two_sweeps(self._sweep(poses, Load(0.0)), self._sweep(poses, load))
        return CalibrationFile(
            tool=name,
            load=found.load,
            adapter=found.adapter,
            tip_m=np.array([0.15, 0.0, 0.05]),
            rmse=found.rmse,
            poses_used=len(poses),
            calibrated_at="2026-01-01T00:00:00+00:00",
            residual_offset=found.offset,
        )

    def records(self, case: Case) -> list[PoseRecord]:
        """The case's averages at the poses."""
        records = []
        for k, (roll, tilt) in enumerate(self.poses):
            wrench = nominal_reading(np.stack([roll, tilt], axis=-1), case.true, ADAPTER)
            wrench = wrench + case.offset + case.extra(roll, tilt, k)
            records.append(self._record(self.poses[k], wrench))
        return records

    def _sweep(self, poses: Array, load: Load) -> StillPoses:
        records = [self._record(pose, nominal_reading(pose, load, ADAPTER)) for pose in poses]
        return StillPoses(*stack(records))

    def _record(self, pose: Array, mean: Array) -> PoseRecord:
        noise = self._random.standard_normal((_SAMPLES, 6)) * SENSOR.noise_std
        wrench = np.round((mean + noise) / SENSOR.quantum) * SENSOR.quantum
        return average_pose(np.array([[*_PLATFORM, *pose]] * 2), wrench)


def plain_answer(records: Sequence[PoseRecord], tool: CalibrationFile) -> CheckAnswer:
    """What a ten-parameter least squares says by itself."""
    angles, wrench, _ = stack(list(records))
    rows = load_and_offset(angles, tool).reshape(-1, 10)
    values = np.linalg.lstsq(rows, (wrench - tool.predict(angles)).ravel(), rcond=None)[0]
    everywhere = load_and_offset(_ANYWHERE, tool)
    by_load = np.max(np.abs(everywhere[:, :, :4] @ values[:4]), axis=0)
    by_both = np.max(np.abs(everywhere @ values), axis=0)
    if _LIMITS.size(by_load) > 1.0:
        return CheckAnswer.RECALIBRATE
    return CheckAnswer.RETARE if _LIMITS.size(by_both) > 1.0 else CheckAnswer.GOOD


def answers(case: Case, checks: int, seed: int, step: Callable[[], object]) -> dict[str, Any]:
    """How often each answer and cause came in so many checks, and each plain answer."""
    random = np.random.default_rng([seed, *case.name.encode()])
    counts: dict[str, Counter[str]] = {
        "answers": Counter(),
        "causes": Counter(),
        "plain": Counter(),
    }
    other = _RETRACTOR if case.believed is _POINTER else _POINTER
    for k in range(checks):
        if k % _CHECKS_A_FILE == 0:
            bench = Bench(random, case.believed)
            others = {"other": bench.file("other", other)}
        records = bench.records(case)
        check = quick_check(records, bench.tool, _LIMITS, others=others)
        counts["answers"][check.answer.name] += 1
        counts["causes"][check.cause.name] += 1
        counts["plain"][plain_answer(records, bench.tool).name] += 1
        step()
    return {"case": case.name} | {name: dict(count) for name, count in counts.items()}


def power(checks: int, seed: int, step: Callable[[], object]) -> list[dict[str, float]]:
    """How often the tests call a change of that share of the smallest one that they promise.

    That is what `quick_check` says is told with 95 %: a mass at the pointer's centre, and a force
    along x; at 0 it is how often chance alone looks like one. It is said once for each file, and
    asked of other checks with it, whose noise is estimated anew. The sizes are medians.
    """
    random = np.random.default_rng(seed)
    rows = []
    for share in (0.0, 0.5, 1.0):
        told, promised = np.zeros(2), []
        for k in range(checks):
            if k % _CHECKS_A_FILE == 0:
                bench = Bench(random, _POINTER)
                untouched = bench.records(Case("", _POINTER, _POINTER))
                promise = quick_check(untouched, bench.tool, _LIMITS)
                promised.append([promise.found_mass_kg, *promise.found_offset])
            added = heavier(_POINTER, share * promise.found_mass_kg)
            pushed = share * promise.found_offset * np.array([1.0, 0, 0, 0, 0, 0])
            load, offset = (
                differences(bench.records(case), bench.tool, _LIMITS, np.zeros(6))
                for case in (Case("", _POINTER, added), Case("", _POINTER, _POINTER, pushed))
            )
            told += np.array([load.load_p, offset.offset_p]) < _LIMITS.false_alarm
            step()
        mass_kg, force_n, *_, torque_nm = np.median(promised, axis=0)
        rows.append(
            {
                "share": share,
                "load_told": float(told[0]) / checks,
                "offset_told": float(told[1]) / checks,
                "mass_kg": float(mass_kg),
                "force_n": float(force_n),
                "torque_nm": float(torque_nm),
            }
        )
    return rows


def _words(counts: dict[str, int]) -> str:
    ordered = sorted(counts.items(), key=lambda item: -item[1])
    return ", ".join(f"{name.lower()} {count}" for name, count in ordered)


def main(arguments: list[str] | None = None) -> None:
    """Print the tables, or JSON."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.validation.check_power",
        description=__doc__.partition("\n")[0],
        epilog="exit codes: 0 done, 2 wrong arguments, 130 interrupted (Ctrl-C)",
    )
    parser.add_argument(
        "--checks",
        type=int,
        default=50,
        help="of each case, and four times as many for what can be told (default 50)",
    )
    parser.add_argument("--seed", type=int, default=1, help="of the noise (default 1)")
    parser.add_argument("--json", action="store_true", help="print the result as one JSON object")
    options = parser.parse_args(arguments)
    if options.checks < 1 or options.seed < 0:
        parser.error("--checks is at least 1, --seed at least 0")
    silent = options.json or not sys.stderr.isatty()
    try:
        # Checks of one file share its errors: a rate to the per cent needs many files.
        more = _POWER_CHECKS * options.checks
        total = len(CASES) * options.checks + 3 * more
        with tqdm(total=total, unit="check", disable=silent) as bar:
            table = [answers(case, options.checks, options.seed, bar.update) for case in CASES]
            shares = power(more, options.seed + 1, bar.update)
    except KeyboardInterrupt:
        raise SystemExit(130) from None
    if options.json:
        print(json.dumps({"checks": options.checks, "cases": table, "power": shares}))
        return
    shown = Table("on the arm", "answer", "cause", "plain least squares")
    for row in table:
        shown.add_row(row["case"], *(_words(row[name]) for name in ("answers", "causes", "plain")))
    Console().print(shown)
    for row in shares:
        print(
            f"{row['share']:.1f} of the smallest change that is told with 95 %: told in"
            f" {100 * row['load_told']:.1f} % as a load, {100 * row['offset_told']:.1f} % as an"
            f" offset"
        )
    last = shares[-1]
    print(
        f"such a change: {1e3 * last['mass_kg']:.2f} g, {1e3 * last['force_n']:.1f} mN along x,"
        f" {1e3 * last['torque_nm']:.3f} mN.m about z (median of the files)"
    )


if __name__ == "__main__":
    main()
