#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Make the sample recordings in this folder again, the same to the last bit of what they say.

Each comes from the simulated driver's own core, stepped offline with a fixed seed and fixed stamps,
and is written into a bag with the messages that the driver's node would publish. A bag whose
content has not changed is left as it is; README.md's table is written from what then is there.
"""

from __future__ import annotations

import argparse
import math
import re
import sys
import tempfile
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from galen_bags.formats.bag import content_sha256, open_bag
from galen_bags.formats.errors import BagError
from galen_bags.formats.writer import BagWriter
from galen_calibration_behavior.calibration.estimate import estimate
from galen_calibration_behavior.calibration.procedure import CalibrationRequest
from galen_calibration_behavior.common.parameters import CalibrationParameters
from galen_model.arm.galen import GALEN
from galen_model.errors import CalibrationFileError, GalenError
from galen_model.files.calibration_file import read_calibration
from galen_model.load.model import ADAPTER, TOOLS
from galen_sim_driver.effects.effect import Effect
from galen_sim_driver.effects.load import CableDrag, InertialLoad
from galen_sim_driver.plant.cell import Plant
from galen_sim_driver.plant.config import (
    ZERO3,
    HandPush,
    PlantConfig,
    acceleration_limits,
    velocity_limits,
)
from galen_sim_driver.plant.motion import Trajectory, TrajectoryPoint
from offline_cell import CellBag, OfflineCell
from tqdm import tqdm

HERE = Path(__file__).resolve().parent
BEGIN, END = "<!-- made by make_bags.py -->", "<!-- end -->"
NS_PER_S = 1_000_000_000
# Numbers of a tool's file come from LAPACK, whose last bits are another processor's own affair.
_TOOL_TOLERANCE = 1e-6


@dataclass(frozen=True)
class Recipe:
    """How one recording is made; `expected_s` is for the progress bar."""

    name: str
    seed: int
    start: datetime
    rate_hz: float
    tool: str
    expected_s: float
    drive: Callable[[OfflineCell, Recipe, Path], None]
    tracker: bool = False
    hand: tuple[HandPush, ...] = ()
    effects: tuple[Effect, ...] = ()
    """What the arm has beside the nominal model."""

    @property
    def tool_file(self) -> str | None:
        """The tool's file that a calibration leaves, below the recordings' folder."""
        return f"tools/{self.tool}.json" if self.drive is _calibrate else None


def _calibrate(cell: OfflineCell, recipe: Recipe, folder: Path) -> None:
    """Run the calibration behaviour's procedure with its node's own parameters."""
    parameters = CalibrationParameters()
    measurements = cell.calibrate(
        parameters,
        CalibrationRequest(
            tool=recipe.tool,
            one_sweep=False,
            attach_by_service=True,
            poses=parameters.grid_poses(parameters.itersT, parameters.itersR),
        ),
    )
    last_stamp = datetime.fromtimestamp(cell.plant.now_ns // NS_PER_S, UTC)
    assert recipe.tool_file is not None
    path = folder / recipe.tool_file
    tip_m = TOOLS[recipe.tool].tip_m
    estimate(path, recipe.tool, tip_m, measurements, [], calibrated_at=last_stamp).write()


# --- free motion --------------------------------------------------------------------------------

_AMPLITUDE = np.array([0.05, 0.04, 0.04, 1.1, 0.7])
_FREQUENCY_HZ = np.array([0.19, 0.23, 0.29, 0.11, 0.17])
_STRETCH_S, _STOP_S, _STRETCHES, _POINT_S = 8.0, 2.0, 3, 0.05


def _free_motion(cell: OfflineCell, _recipe: Recipe, _folder: Path) -> None:
    """All joints swing, each with its own period; between the stretches the arm stands still."""
    cell.run(_STOP_S)
    phase_s = 0.0
    for _ in range(_STRETCHES):
        times = _POINT_S * np.arange(1, round(_STRETCH_S / _POINT_S) + 1)
        points = [_swing(phase_s, time_s) for time_s in times.tolist()]
        cell.plant.command(Trajectory(list(GALEN.joint_names), points))
        cell.run(_STRETCH_S + _STOP_S)
        phase_s += _progress(_STRETCH_S)[0]


def _swing(phase_s: float, time_s: float) -> TrajectoryPoint:
    """Where the joints are `time_s` into a stretch that began at `phase_s` of the swing."""
    progress, speed, speed_change = _progress(time_s)
    angular = 2.0 * math.pi * _FREQUENCY_HZ
    angle = angular * (phase_s + progress)
    position = GALEN.home + _AMPLITUDE * np.sin(angle)
    by_phase = _AMPLITUDE * angular * np.cos(angle)
    by_phase_twice = -_AMPLITUDE * angular**2 * np.sin(angle)
    velocity = by_phase * speed
    acceleration = by_phase_twice * speed**2 + by_phase * speed_change
    return TrajectoryPoint(time_s, position.tolist(), velocity.tolist(), acceleration.tolist())


def _progress(time_s: float) -> tuple[float, float, float]:
    """How far the swing has gone on in a stretch (s), how fast it goes on, and its change (1/s).

    Speed rises from 0 to 1 and falls back in 1 s each, as 10 x^3 - 15 x^4 + 6 x^5.
    """
    x = min(time_s, 1.0)
    y = min(_STRETCH_S - time_s, 1.0)
    rise = 2.5 * x**4 - 3.0 * x**5 + x**6
    fall = 2.5 * y**4 - 3.0 * y**5 + y**6
    edge = min(x, y)
    speed = 10.0 * edge**3 - 15.0 * edge**4 + 6.0 * edge**5
    change = math.copysign(30.0 * edge**2 - 60.0 * edge**3 + 30.0 * edge**4, 1.0 if x <= y else -1)
    full = min(max(time_s - 1.0, 0.0), _STRETCH_S - 2.0)
    return rise + full + (0.5 - fall), speed, change


# --- swings, for inertial forces ---------------------------------------------------------------

# About their own centres, kg m^2: adapter (3e-5, 3e-5, 4e-5, 0, 0, 0) and retractor
# (2e-4, 5e-4, 4e-4, 0, -3e-5, 0).
INERTIA = InertialLoad(
    TOOLS["retractor"].load.mass_kg + ADAPTER.mass_kg,
    (2.3e-4, 5.3e-4, 4.4e-4, 0.0, -3e-5, 0.0),
)
_SWING_MOVES, _SHARE_OF_LIMITS = 24, 0.97
_SWING_RANGE = np.array([0.08, 0.08, 0.06, 1.2, 0.8])


def _swings(cell: OfflineCell, recipe: Recipe, _folder: Path) -> None:
    """Move to random places, each as fast as the arm's limits allow."""
    rng = np.random.default_rng(recipe.seed)
    velocity, acceleration = np.array(velocity_limits(GALEN)), np.array(acceleration_limits(GALEN))
    joints = GALEN.home
    cell.run(1.5)
    for _ in range(_SWING_MOVES):
        target = GALEN.home + _SWING_RANGE * rng.uniform(-1.0, 1.0, 5)
        way = np.abs(target - joints)
        # The peaks of a quintic from rest to rest: 1.875 way / T, 5.7735 way / T^2.
        duration_s = max(
            float((1.875 * way / (_SHARE_OF_LIMITS * velocity)).max()),
            float(np.sqrt(5.7735 * way / (_SHARE_OF_LIMITS * acceleration)).max()),
        )
        cell.move_to(target.tolist(), duration_s)
        cell.run(duration_s + 0.2)
        joints = target
    cell.run(1.0)


# --- a sweep with a cable on --------------------------------------------------------------------

_ATTACHMENT_M = (0.08, 0.0, 0.06)
CABLE = CableDrag(
    tension_n=0.3,
    attachment_m=_ATTACHMENT_M,
    stretch_per_m=1.0 / 0.3,
    reference_m=tuple(GALEN.tip_pose(GALEN.home, _ATTACHMENT_M)[1].tolist()),
)


def _sweep(cell: OfflineCell, _recipe: Recipe, _folder: Path) -> None:
    """Each pose of the calibration's grid, 0.8 s still."""
    parameters = CalibrationParameters()
    cell.run(1.0)
    for angles in parameters.grid_poses(parameters.itersT, parameters.itersR):
        cell.move_to([*GALEN.home[:3].tolist(), *angles.tolist()], 1.2)
        cell.run(1.2 + 0.9)
    cell.run(0.5)


# --- pushes -------------------------------------------------------------------------------------

_POSITIONS = np.array(
    [
        [0.00, 0.00, 0.408, 0.0, 0.0],
        [0.06, -0.05, 0.43, 0.7, -0.4],
        [-0.07, 0.04, 0.37, -0.9, 0.5],
        [0.03, 0.07, 0.40, 0.3, 0.8],
    ]
)
_FORCES_N, _TORQUES_NM = (3.0, 6.0, 10.0), (0.3, 0.8)
_PUSH_S, _PAUSE_S, _RAMP_S = 1.0, 0.3, 0.25


def _push_script() -> tuple[HandPush, ...]:
    """Every force and torque to both sides along each axis of base_link, one after the other."""
    pushes: list[HandPush] = []
    for levels, torque in ((_FORCES_N, False), (_TORQUES_NM, True)):
        for axis in range(3):
            for sign in (1.0, -1.0):
                for level in levels:
                    x, y, z = (sign * level if k == axis else 0.0 for k in range(3))
                    pushes.append(
                        HandPush(
                            len(pushes) * (_PUSH_S + _PAUSE_S),
                            _PUSH_S,
                            force_n=ZERO3 if torque else (x, y, z),
                            torque_nm=(x, y, z) if torque else ZERO3,
                            ramp_s=_RAMP_S,
                        )
                    )
    return tuple(pushes)


def _pushes(cell: OfflineCell, _recipe: Recipe, _folder: Path) -> None:
    """At each position: arrive, 3 s untouched, then the whole script."""
    cell.run(1.0)
    for joints in _POSITIONS:
        cell.move_to(joints.tolist(), 2.0)
        cell.run(2.5)
        cell.run(3.0)
        cell.play_hand()
    cell.run(1.0)


RECIPES = (
    Recipe(
        "pointer_calibration", 1, datetime(2026, 3, 2, 9, tzinfo=UTC), 200.0, "pointer", 203.0,
        _calibrate,
    ),
    Recipe(
        "retractor_calibration", 2, datetime(2026, 3, 2, 10, tzinfo=UTC), 200.0, "retractor", 203.0,
        _calibrate,
    ),
    Recipe(
        "free_motion", 3, datetime(2026, 3, 2, 11, tzinfo=UTC), 500.0, "retractor", 32.0,
        _free_motion,
    ),
    Recipe(
        "pushes", 4, datetime(2026, 3, 2, 12, tzinfo=UTC), 250.0, "retractor", 179.0, _pushes,
        tracker=True, hand=_push_script(),
    ),
    Recipe(
        "swings", 5, datetime(2026, 3, 2, 13, tzinfo=UTC), 500.0, "retractor", 42.1, _swings,
        effects=(INERTIA,),
    ),
    Recipe(
        "cable_sweep", 6, datetime(2026, 3, 2, 14, tzinfo=UTC), 200.0, "pointer", 119.1, _sweep,
        effects=(CABLE,),
    ),
)  # fmt: skip


# --- making and comparing -----------------------------------------------------------------------


def make(recipe: Recipe, folder: Path, quiet: bool = False) -> None:
    """Write `folder/<name>`, and the tool's file of a calibration."""
    start_ns = int(recipe.start.timestamp()) * NS_PER_S
    config = PlantConfig(
        rate_hz=recipe.rate_hz,
        start_ns=start_ns,
        hand=recipe.hand,
        effects=recipe.effects,
        arm=GALEN,
    )
    (folder / recipe.name).parent.mkdir(parents=True, exist_ok=True)
    plant = Plant(config, np.random.default_rng(recipe.seed))
    if recipe.drive is not _calibrate:  # which itself puts the tool on
        plant.attach_tool(recipe.tool)
    with (
        tqdm(
            total=round(recipe.expected_s * recipe.rate_hz),
            desc=recipe.name.ljust(22),
            unit="sample",
            disable=quiet,
        ) as bar,
        BagWriter(folder / recipe.name) as bag,
    ):
        cell_bag = CellBag(bag, tracker=recipe.tracker)
        cell = OfflineCell(plant, [cell_bag, lambda _: bar.update()])
        recipe.drive(cell, recipe, folder)


def differences(recipe: Recipe, made: Path, kept: Path) -> list[str]:
    """Return the differences between a made and a kept recording, as sentences."""
    found = []
    try:
        if content_sha256(kept / recipe.name) != content_sha256(made / recipe.name):
            found.append(f"{kept / recipe.name}: made again, it has another content")
    except BagError as error:
        found.append(str(error))
    if recipe.tool_file is not None:
        try:
            old = read_calibration(kept / recipe.tool_file, arm=GALEN).to_json()
        except CalibrationFileError as error:
            return [*found, str(error)]
        new = read_calibration(made / recipe.tool_file, arm=GALEN).to_json()
        if not _same(new, old):
            found.append(f"{kept / recipe.tool_file}: made again, it holds other values")
    return found


def _same(a: Any, b: Any) -> bool:
    """Whether two JSON values are the same, numbers but for rounding."""
    if isinstance(a, dict) and isinstance(b, dict):
        return a.keys() == b.keys() and all(_same(a[key], b[key]) for key in a)
    if isinstance(a, list) and isinstance(b, list):
        return len(a) == len(b) and all(_same(x, y) for x, y in zip(a, b, strict=True))
    if isinstance(a, float) and isinstance(b, float):
        return math.isclose(a, b, rel_tol=_TOOL_TOLERANCE, abs_tol=1e-12)
    return bool(a == b)


def replace(recipe: Recipe, made: Path, kept: Path) -> None:
    """Put what was made in the old one's place."""
    for name in filter(None, (recipe.name, recipe.tool_file)):
        target = kept / name
        target.parent.mkdir(parents=True, exist_ok=True)
        if target.exists():
            target.rename(made / f"{target.name}.old")
        (made / name).rename(target)


# --- README -------------------------------------------------------------------------------------


def table(folder: Path) -> str:
    """Return README's table of the recordings, from what is in the folder."""
    lines = [
        "| recording | seed | first stamp | s | Hz | tool | messages | MB | `content_sha256` |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for recipe in RECIPES:
        path = folder / recipe.name
        with open_bag(path) as bag:
            counts = {name.lstrip("/"): info.count for name, info in sorted(bag.topics.items())}
            log_times = [block.log_time_ns for block in bag.blocks(sorted(bag.topics))]
        duration_s = (int(log_times[-1][-1]) - int(log_times[0][0])) / NS_PER_S
        messages = ", ".join(f"`{name}` {count}" for name, count in counts.items())
        lines.append(
            f"| `{recipe.name}` | {recipe.seed} | {recipe.start:%Y-%m-%dT%H:%M:%SZ} |"
            f" {duration_s:.1f} | {recipe.rate_hz:g} | {recipe.tool} | {messages} |"
            f" {size(path) / 1e6:.1f} | `{content_sha256(path)}` |"
        )
    return "\n".join(lines)


def size(path: Path) -> int:
    """Bytes of all files below `path`."""
    return sum(file.stat().st_size for file in path.rglob("*") if file.is_file())


def write_readme(folder: Path) -> None:
    """Put the table between its marks."""
    readme = folder / "README.md"
    text = readme.read_text(encoding="utf-8")
    pattern = re.compile(f"{re.escape(BEGIN)}\n.*?{re.escape(END)}", re.DOTALL)
    if len(pattern.findall(text)) != 1:
        raise GalenError(f"{readme}: the marks {BEGIN} and {END} must be there, once")
    content = f"{BEGIN}\n{table(folder)}\n{END}"
    readme.write_text(pattern.sub(lambda _: content, text), encoding="utf-8")


# --- command ------------------------------------------------------------------------------------


def run(recipes: Iterable[Recipe], check: bool, quiet: bool, folder: Path = HERE) -> list[str]:
    """Make the recordings again and return what differs from those in `folder`.

    Unless `check` is set, what differs is put in their place, and README's table is written.
    """
    changed: list[str] = []
    # Beside the bags, so that putting them in place is a rename.
    with tempfile.TemporaryDirectory(dir=None if check else folder, prefix=".making.") as made:
        for recipe in recipes:
            make(recipe, Path(made), quiet)
            found = differences(recipe, Path(made), folder)
            if found and not check:
                replace(recipe, Path(made), folder)
            changed += found
    if not check:
        write_readme(folder)
    return changed


def main(args: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    parser = argparse.ArgumentParser(
        description="Make the sample recordings again.",
        epilog="exit codes: 0 done, or all the same; 1 something differs (--check) or can't be"
        " made, a line says what; 2 usage; 130 interrupted",
    )
    names = [recipe.name for recipe in RECIPES]
    parser.add_argument(
        "--only",
        action="append",
        choices=names,
        metavar="NAME",
        help=f"make this one, may be given again: {', '.join(names)}",
    )
    parser.add_argument(
        "--check", action="store_true", help="write nothing here; compare with what is here"
    )
    parser.add_argument("--quiet", action="store_true", help="no progress bars")
    options = parser.parse_args(args)
    recipes = [r for r in RECIPES if options.only is None or r.name in options.only]
    try:
        changed = run(recipes, options.check, options.quiet)
    except (GalenError, OSError) as error:
        print(f"make_bags: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("make_bags: interrupted", file=sys.stderr)
        return 130
    for line in changed:
        print(line if options.check else f"written anew: {line}", file=sys.stderr)
    if not changed:
        print("all the same")
    return 1 if changed and options.check else 0


if __name__ == "__main__":
    sys.exit(main())
