# SPDX-License-Identifier: Apache-2.0
"""The page of a calibration from a recording: what was found, pictures, what to do better."""

from __future__ import annotations

import io
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib

matplotlib.use("Agg")  # a lab's machine over ssh has no display
import matplotlib.pyplot as plt
import numpy as np
from galen_common.command import PageRow, render_page
from galen_common.goal.arrival import NS
from galen_model.arm.galen import WRENCH_AXES
from galen_model.arrays import Array
from galen_model.estimation.problem import MIN_POSES_TO_REJECT
from galen_model.load.model import LoadEstimate, gravity_wrench
from galen_model.poses.design import compensation_std_under, workspace_gravity
from galen_model.rest.segments import PoseRecord

from galen_calibration_behavior.calibration.by_hand import down_text, missing_direction
from galen_calibration_behavior.calibration.estimate import Calibration
from galen_calibration_behavior.common.parameters import CalibrationParameters
from galen_calibration_behavior.from_bag.sweeps import RecordedSweeps
from galen_calibration_behavior.from_bag.visits import Visits

_COLOURS = ("#0072b2", "#e69f00", "#009e73")
"""Of x, y, z: Okabe and Ito's, which colour-blind people distinguish."""
_BARE, _TOOL, _OUT = "#56b4e9", "#0072b2", "#d55e00"
_KINDS = ((slice(0, 3), "force, mN"), (slice(3, 6), "torque, mN.m"))
_SWEEPS = {"bare": "without the tool", "tool": "with the tool"}
_CAPTIONS = {
    "residual": "Readings less what load and model predict, pose by pose in visiting order. Grey:"
    " ± 2 standard deviations of an average, by the scatter within the poses. Crosses: rejected.",
    "bias": "The sensor's bias in time, from its value at each sweep's first pose: the line is the"
    " model's, the dots are the readings less the load.",
    "orientations": "Where gravity pointed in the sensor: one dot a pose. Grey: what the arm's"
    " joints allow.",
    "timeline": "Rest segments in time. Not used: where the sensor was zeroed, or before it was.",
}
# From where on something is worth a sentence.
_POSE_GAIN = 0.1  # in the error of the compensation, by one more pose
_STAY_RATIO = 2.0  # of what a rest segment lasts to what is averaged
_NOISE_RATIO = 3.0  # between axes of a kind; of residual to scatter
_SHORT_STOP_S = 0.25  # shorter ones are turns of a motion
_SHORT_STOPS = 0.1  # of the poses
_WARMED_K = 1.0
_LOST = 0.01  # of the samples


@dataclass(frozen=True)
class PoseTable:
    """All averaged poses (n) of both sweeps in visiting order; N, N.m, m/s^2.

    bare (n,): before the tool came on; used (n,): by the fit; residual (n, 6); bias (n, 6): the
    model's, from its value at the end of the sweep; std (6,): of an average, by the scatter.
    """

    bare: np.ndarray
    time_s: Array
    gravity: Array
    used: np.ndarray
    residual: Array
    bias: Array
    std: Array
    temperature_c: Array


def pose_table(sweeps: RecordedSweeps, calibration: Calibration) -> PoseTable:
    """Return the poses with their residuals, those that were rejected, too.

    Args:
        sweeps: the recorded sweeps; visits without an average are left out.
        calibration: what was identified from them.

    Returns:
        The averaged poses of both sweeps, bare ones first.

    """
    file, found, drift = calibration.content, calibration.found, calibration.found.bias_drift
    parts = []
    for name in _SWEEPS:
        poses = [p for p in sweeps.poses if p.sweep == name]
        kept = [(p, r) for p in poses if isinstance(r := p.visit.outcome, PoseRecord)]
        if not kept:
            continue
        mask, curve = found.used_tool, None if drift is None else drift.tool
        angles = file.arm.angles(np.array([record.joints for _, record in kept]))
        expected, gravity = file.predict(angles), file.gravity_in_sensor(angles)
        if name == "bare":
            mask, curve = found.used_bare, None if drift is None else drift.bare
            pull = gravity_wrench(gravity, file.load.load)
            if file.mounting is not None:
                pull = pull @ file.mounting.reading_from_wrench.T
            expected = expected - pull
            if found.offset_change is not None:
                expected = expected - found.offset_change
        time_s = np.array([pose.time_s for pose, _ in kept])
        used = np.array([not pose.fault for pose, _ in kept])
        bias = np.zeros((len(kept), 6))
        if curve is not None:
            columns = [np.interp(time_s, time_s[used], one - one[-1]) for one in curve.T]
            bias = np.column_stack(columns)
            bias[used] = curve - curve[-1]  # exactly, even where stamps have jumped
        used[used] = mask
        wrench = np.array([record.wrench for _, record in kept])
        std = np.array([record.std_of_mean for _, record in kept])
        warm = np.array([record.temperature_c for _, record in kept])
        bare = np.full(len(kept), name == "bare")
        residual = wrench - expected - bias
        parts.append((bare, time_s, gravity, used, residual, bias, std, warm))
    bare, time_s, gravity, used, residual, bias, std, warm = map(
        np.concatenate, zip(*parts, strict=True)
    )
    return PoseTable(bare, time_s, gravity, used, residual, bias, np.median(std, axis=0), warm)


def calibration_page(
    sweeps: RecordedSweeps, calibration: Calibration, settings: CalibrationParameters
) -> str:
    """Return the page as HTML: one file that loads and runs nothing.

    Args:
        sweeps: the recorded sweeps.
        calibration: what was identified from them.
        settings: with which poses were averaged and judged.

    Returns:
        The page, with its pictures in it.

    """
    file, found = calibration.content, calibration.found
    table = pose_table(sweeps, calibration)
    missing, advice = _missing(table, calibration)
    advice += [*_advice(table, sweeps, calibration, settings), *calibration.warnings]
    figures = {
        "residual": _residual_figure(table),
        "bias": _bias_figure(table) if np.any(table.bias) else None,
        "orientations": _orientations_figure(table, calibration, missing),
        "timeline": _timeline_figure(sweeps),
    }
    noise = {
        "residual, RMS [mN, mN.m]": file.rmse,
        "noise of an average, by the scatter within poses": table.std,
    }
    return render_page(
        Path(__file__).parent / "calibration.html",
        {name: _png(figure) for name, figure in figures.items() if figure is not None},
        title=f"Calibration of {file.tool}, {file.calibrated_at}",
        sentence=f"{_mass(file.load)} g at ({_centre(file.load)}) mm in {file.sensor_frame}",
        verdict=f"{len(advice) or 'no'} remark{'' if len(advice) == 1 else 's'}",
        good=not advice,
        advice=advice,
        frame=file.sensor_frame,
        loads=[
            PageRow((name, _mass(load), _centre(load)))
            for name, load in ((file.tool, file.load), ("adapter", file.adapter))
            if load.mass_kg  # one load has no adapter of its own
        ],
        model=f"Model: {found.model}." if found.model else "",
        reason=found.reason,
        noise=[PageRow((name, *(f"{1e3 * v:.3g}" for v in row))) for name, row in noise.items()],
        found=[PageRow(cells) for cells in _facts(table, sweeps, calibration)],
        captions=_CAPTIONS,
        rejected=file.poses_rejected,
    )


def _mass(load: LoadEstimate) -> str:
    return f"{1e3 * load.mass_kg:.2f} ± {1e3 * load.mass_std_kg:.2f}"


def _centre(load: LoadEstimate) -> str:
    pairs = zip(load.com_m, load.com_std_m, strict=True)
    return ", ".join(f"{1e3 * value:.2f} ± {1e3 * std:.2f}" for value, std in pairs)


def _facts(
    table: PoseTable, sweeps: RecordedSweeps, calibration: Calibration
) -> Iterator[tuple[str, str]]:
    """Say what the recordings hold, in rows of a name and a value."""
    arm = calibration.content.arm
    yield "arm", f"{arm.name}: {', '.join(arm.joint_names)}; wrenches in {arm.sensor_frame}"
    for found in sweeps.recordings:
        recording = found.recording
        yield "recording", str(recording.path)
        for name, stamps in _streams(found):
            span_s = (int(stamps[-1]) - int(stamps[0])) / NS
            rate = f", {(len(stamps) - 1) / span_s:.4g} Hz" if span_s > 0.0 else ""
            yield name, f"{len(stamps)} messages in {span_s:.1f} s{rate}"
        yield (
            "rest segments",
            f"{len(found.visits)} long enough for an average, {len(found.short_ns)} shorter",
        )
    for name, words in _SWEEPS.items():
        poses = [pose for pose in sweeps.poses if pose.sweep == name]
        if poses:
            count = int(np.sum(table.used & (table.bare == (name == "bare"))))
            yield f"poses {words}", f"{count} used of {len(poses)}"
    if sweeps.tool_on_s is not None:
        yield "tool came on", "between {:.1f} s and {:.1f} s".format(*sweeps.tool_on_s)
    if np.all(np.isfinite(table.temperature_c)):
        warm = table.temperature_c
        yield "temperature", f"{warm.min():.1f} to {warm.max():.1f} °C"


def _streams(found: Visits) -> list[tuple[str, np.ndarray]]:
    """Topics and their stamps."""
    recording = found.recording
    stamps = recording.joint_stamp_ns, recording.wrench_stamp_ns, recording.temperature_stamp_ns
    return [pair for pair in zip(recording.topics, stamps, strict=False) if len(pair[1])]


# What to do better


def _missing(table: PoseTable, calibration: Calibration) -> tuple[Array | None, list[str]]:
    """Return gravity's direction (3,) that would pay as one more pose, and the sentence."""
    arm, sigma = calibration.content.arm, calibration.found.sigma
    gravity = table.gravity[table.used & ~table.bare]
    direction = missing_direction(gravity, sigma, arm)
    more = np.vstack([gravity, direction * np.linalg.norm(arm.gravity_m_s2)])
    now, then = (compensation_std_under(g, sigma, arm) for g in (gravity, more))
    gain = float(1.0 - np.mean(then / now))
    if not gain > _POSE_GAIN:
        return None, []
    return direction, [
        f"An orientation is missing: one more pose with {down_text(direction, arm.sensor_frame)}"
        f" would lower the error of the compensation by {gain:.0%}."
    ]


def _advice(
    table: PoseTable,
    sweeps: RecordedSweeps,
    calibration: Calibration,
    settings: CalibrationParameters,
) -> list[str]:
    """Return a sentence, with its number, for each thing that was not as good as it can be."""
    said = []
    for name, words in _SWEEPS.items():
        poses = [pose for pose in sweeps.poses if pose.sweep == name]
        if 0 < len(poses) < MIN_POSES_TO_REJECT:
            said.append(
                f"The sweep {words} has {len(poses)} poses: from {MIN_POSES_TO_REJECT} on a pose"
                " that was touched can be found, and models compared."
            )
    faults = [pose.fault for pose in sweeps.poses if pose.fault]
    if faults:
        said.append(
            f"{len(faults)} of {len(sweeps.poses)} poses were not still ({faults[-1]}): keep hands,"
            " cables and tool free of contact while a pose is held."
        )
    if calibration.found.outliers:
        worst = max(calibration.found.outliers, key=lambda one: one[2])
        said.append(
            f"{len(calibration.found.outliers)} of {len(sweeps.poses)} poses do not fit the common"
            f" load, by up to {worst[2]:.0f} standard deviations: look for a contact, or a cable"
            " that pulls."
        )
    said += _about_time(table, sweeps, settings)
    said += _about_sensor(table, calibration, settings)
    for found in sweeps.recordings:
        for name, stamps in _streams(found)[:2]:
            step = np.diff(np.sort(stamps))
            usual = float(np.median(step))
            lost = int(np.sum(np.round(step[step > 1.5 * usual] / usual) - 1.0))
            if lost > _LOST * len(stamps):
                said.append(
                    f"{lost} of {lost + len(stamps)} samples of {name} are missing, up to"
                    f" {step.max() / NS:.2f} s at once: record on a machine with less load."
                )
    return said


def _about_time(
    table: PoseTable, sweeps: RecordedSweeps, settings: CalibrationParameters
) -> Iterator[str]:
    """Say whether the poses were held for too short or too long a time."""
    needed_s = settings.arrival.settle_s + settings.average_s
    short_s = np.concatenate([np.diff(one.short_ns)[:, 0] / NS for one in sweeps.recordings])
    short_s = short_s[short_s >= _SHORT_STOP_S]
    if len(short_s) > max(2.0, _SHORT_STOPS * len(sweeps.poses)):
        yield (
            f"{len(short_s)} stops lasted at most {short_s.max():.2g} s and give no pose: hold each"
            f" for the {needed_s:.2g} s that settling and averaging take."
        )
    visits = [pose.visit for pose in sweeps.poses if not pose.fault]
    held_s = np.array([(visit.end_ns - visit.window_ns[0]) / NS for visit in visits])
    longest_s = math.floor(10.0 * np.quantile(held_s, 0.1)) / 10.0
    ratio = np.sqrt(np.mean((table.residual[table.used] / table.std) ** 2))
    if longest_s > _STAY_RATIO * settings.average_s and ratio < _NOISE_RATIO:
        lower = 1.0 - math.sqrt(settings.average_s / longest_s)
        yield (
            f"Averages of {settings.average_s:g} s use a part of the poses only, which are held for"
            f" {longest_s:g} s and more: -p average_s:={longest_s:g} lowers white noise by"
            f" {lower:.0%}."
        )


def _about_sensor(
    table: PoseTable, calibration: Calibration, settings: CalibrationParameters
) -> Iterator[str]:
    """Say what is wrong with zero, noise, temperature and residuals."""
    found, names = calibration.found, WRENCH_AXES
    if found.offset_change is not None:
        first = found.offset - found.offset_change + table.bias[0]
        over = np.abs(first) / settings.zero_tolerance
        k = int(np.argmax(over))
        if over[k] > 1.0:
            unit = "N" if k < 3 else "N.m"
            yield (
                f"The sensor was not zeroed: in the pose of the zeroing it read {first[k]:.3g}"
                f" {unit} ({names[k]}), more than {settings.zero_tolerance[k]:g} {unit}. Zero"
                " it before the first pose, without the tool."
            )
    for axes, kind in _KINDS:
        std = table.std[axes]
        k = int(np.argmax(std))
        ratio = std[k] / np.median(std)
        if ratio > _NOISE_RATIO:
            yield (
                f"{names[axes][k]} is {ratio:.1f} times as noisy as the other axes"
                f" ({1e3 * std[k]:.3g} {kind.split()[-1]} an average): look at its cable and"
                " filter."
            )
    rms = np.sqrt(np.mean(table.residual[table.used] ** 2, axis=0)) / table.std
    k = int(np.argmax(rms))
    if rms[k] > _NOISE_RATIO:
        yield (
            f"The residual of {names[k]} is {rms[k]:.0f} times what its scatter explains: more than"
            " the load changes from pose to pose, such as a drift, a cable's pull or a loose tool."
        )
    change = float(np.ptp(table.temperature_c))
    if change > _WARMED_K and np.any(table.bias):
        yield (
            f"The sensor's temperature changed by {change:.1f} K while its bias drifted: let it"
            " warm up first."
        )


# Pictures


def _png(figure: plt.Figure) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=110, format="png")
    plt.close(figure)
    return buffer.getvalue()


def _residual_figure(table: PoseTable) -> plt.Figure:
    figure, axes = plt.subplots(2, 1, figsize=(10.5, 5.0), sharex=True, layout="constrained")
    number = np.arange(1, len(table.used) + 1)
    for axis, (part, label) in zip(axes, _KINDS, strict=True):
        values, band = 1e3 * table.residual[:, part], 2e3 * table.std[part].max()
        top = 1.25 * max(float(np.abs(values[table.used]).max(initial=0.0)), band)
        axis.axhspan(-band, band, color="0.9", lw=0)
        for k, colour in enumerate(_COLOURS):
            shown = np.clip(values[:, k], -top, top)
            used, name = table.used, WRENCH_AXES[part][k]
            axis.plot(number[used], shown[used], ".", color=colour, label=name)
            axis.plot(number[~used], shown[~used], "x", color=colour, ms=8)
        if 0 < table.bare.sum() < len(number):
            axis.axvline(table.bare.sum() + 0.5, color="0.4", lw=1)
        axis.set_ylim(-1.05 * top, 1.05 * top)
        axis.set_ylabel(label)
        axis.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)
    axes[1].xaxis.get_major_locator().set_params(integer=True)
    axes[1].set_xlabel("pose" + (" (right of the line: with the tool)" if table.bare.any() else ""))
    return figure


def _bias_figure(table: PoseTable) -> plt.Figure:
    """Draw a column for each sweep: both may be of recordings of their own."""
    warm = bool(np.all(np.isfinite(table.temperature_c)))
    sweeps = [bare for bare in (True, False) if np.any(table.used & (table.bare == bare))]
    count = 3 if warm else 2
    figure, axes = plt.subplots(
        count, len(sweeps), figsize=(10.5, 2.4 * count), sharex="col", sharey="row",
        squeeze=False, layout="constrained",
    )  # fmt: skip
    for column, bare in zip(axes.T, sweeps, strict=True):
        rows = table.used & (table.bare == bare)
        time_s, first = table.time_s[rows], table.bias[rows][0]
        column[0].set_title(_SWEEPS["bare" if bare else "tool"], fontsize=11)
        for axis, (part, _) in zip(column, _KINDS, strict=False):
            bias = 1e3 * (table.bias[rows] - first)[:, part]
            reading = bias + 1e3 * table.residual[rows][:, part]
            for k, colour in enumerate(_COLOURS):
                axis.plot(time_s, bias[:, k], color=colour, label=WRENCH_AXES[part][k])
                axis.plot(time_s, reading[:, k], ".", color=colour, ms=4)
        if warm:
            column[2].plot(time_s, table.temperature_c[rows], ".-", color="black")
        column[-1].set_xlabel("time, s")
    for row, (_, label) in zip(axes, _KINDS, strict=False):
        row[0].set_ylabel(label)
    for axis in axes[:2, -1]:
        axis.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)
    if warm:
        axes[2, 0].set_ylabel("temperature, °C")
    return figure


def _orientations_figure(
    table: PoseTable, calibration: Calibration, missing: Array | None
) -> plt.Figure:
    """Draw both halves of the sphere of gravity's directions, as seen along z."""
    arm = calibration.content.arm
    figure, axes = plt.subplots(1, 2, figsize=(9.5, 4.3), layout="constrained")
    reach = _unit(workspace_gravity(arm))
    drawn: Sequence[tuple[Array, dict[str, object]]] = [
        (reach, {"marker": "o", "s": 150, "color": "0.92", "lw": 0}),
        (_unit(table.gravity[table.used & table.bare]),
         {"marker": "o", "s": 42, "facecolors": "none", "edgecolors": _BARE,
          "label": "without the tool"}),
        (_unit(table.gravity[table.used & ~table.bare]),
         {"marker": ".", "s": 42, "color": _TOOL, "label": "with the tool"}),
        (_unit(table.gravity[~table.used]),
         {"marker": "x", "s": 42, "color": _OUT, "label": "rejected"}),
        (np.zeros((0, 3)) if missing is None else missing[None],
         {"marker": "*", "s": 220, "color": _OUT, "label": "missing"}),
    ]  # fmt: skip
    for axis, sign in zip(axes, (1.0, -1.0), strict=True):
        for directions, style in drawn:
            if len(directions):
                half = directions[sign * directions[:, 2] >= 0.0]
                # Lambert's: equal areas of the sphere are equal here.
                flat = half[:, :2] / np.sqrt(1.0 + np.abs(half[:, 2:]))
                axis.scatter(flat[:, 0], flat[:, 1], **style)
        axis.add_patch(plt.Circle((0.0, 0.0), 1.0, fill=False, color="0.5"))
        axis.set(
            xlim=(-1.05, 1.05),
            ylim=(-1.05, 1.05),
            aspect="equal",
            xticks=[],
            yticks=[],
            frame_on=False,
        )
        side = "+z" if sign > 0.0 else "-z"
        axis.set_title(f"{side} of {arm.sensor_frame} down", fontsize=11, parse_math=False)
        axis.set_xlabel("x down to the right, y down at the top")
    axes[1].legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)
    return figure


def _unit(gravity: Array) -> Array:
    return np.asarray(gravity / np.linalg.norm(gravity, axis=1, keepdims=True))


def _timeline_figure(sweeps: RecordedSweeps) -> plt.Figure:
    count = len(sweeps.recordings)
    figure, axes = plt.subplots(
        count, 1, figsize=(10.5, 0.6 + 1.5 * count), squeeze=False, layout="constrained"
    )
    for number, (axis, found) in enumerate(zip(axes[:, 0], sweeps.recordings, strict=True)):
        names = (*_SWEEPS.values(), "rejected", "not used", "too short")
        rows: dict[str, list[tuple[int, int]]] = {name: [] for name in names}
        here = {id(visit): (visit.start_ns, visit.end_ns) for visit in found.visits}
        for pose in sweeps.poses:
            if span := here.pop(id(pose.visit), None):
                rows["rejected" if pose.fault else _SWEEPS[pose.sweep]].append(span)
        rows["not used"] = list(here.values())
        rows["too short"] = [(int(a), int(b)) for a, b in found.short_ns]
        shown = [name for name, spans in rows.items() if spans]
        for row, name in enumerate(shown):
            bars = [(found.time_s(a), max((b - a) / NS, 0.05)) for a, b in rows[name]]
            colour = {"with the tool": _TOOL, "without the tool": _BARE, "rejected": _OUT}
            axis.broken_barh(bars, (row - 0.4, 0.8), color=colour.get(name, "0.6"))
        axis.set_yticks(range(len(shown)), shown)
        axis.invert_yaxis()
        if sweeps.tool_on_s is not None:
            axis.axvspan(*sweeps.tool_on_s, color="0.85", lw=0, zorder=0)
        if count > 1:
            axis.set_title(found.path.name, fontsize=9, loc="left", parse_math=False)
        if number == count - 1:
            axis.set_xlabel("time, s" + (" (grey: the tool came on)" if sweeps.tool_on_s else ""))
    return figure
