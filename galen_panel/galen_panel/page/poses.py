"""The poses of a behaviour that runs, as they are finished, with their residuals so far.

The calibration fits when all poses are done. Until then the plain least squares of one load and six
offsets, on the poses so far, shows whether something goes wrong: a pose with contact stands out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from itertools import groupby
from statistics import median

import numpy as np
from galen_model.arm.kinematics import gravity_in_sensor
from galen_model.load.identification import plain_least_squares
from galen_model.load.model import gravity_regressor
from nicegui import ui

from galen_panel.messages import texts
from galen_panel.snapshot import Behaviour, BehaviourKind, FinishedPose

_REASONS = 4


class PosesView:
    """The newest sweep pose by pose; those before it in a sentence each."""

    def __init__(self, behaviour: Behaviour) -> None:
        self._drawn = -1
        self._before = ui.label().classes("panel-number panel-lines")
        self._title = ui.label().classes("panel-number").props("data-testid=poses-summary")
        with ui.element("div").classes("panel-scroll"):
            self._table = ui.html("", sanitize=False).props("data-testid=poses")
        self._rejected = ui.label().classes("panel-lines")
        # A quick check's few poses are for its own fit; their residual is no news here.
        self._fits = behaviour.kind is BehaviourKind.CALIBRATE

    def update(self, behaviour: Behaviour) -> None:
        """Draw what is new."""
        if len(behaviour.poses) == self._drawn:
            return
        self._drawn = len(behaviour.poses)
        sweeps = [(name, list(of)) for name, of in groupby(behaviour.poses, lambda p: p.sweep)]
        lines = [_sentence(name, poses, self._fits) for name, poses in sweeps]
        self._before.set_text("\n".join(lines[:-1]))
        self._before.set_visibility(len(lines) > 1)
        newest = sweeps[-1][1] if sweeps else []
        self._title.set_text(lines[-1] if lines else "")
        left = residuals(newest) if self._fits else {}
        self._table.set_content(poses_table(newest, left))
        rejected = rejections(behaviour.poses)
        more = [f"and {len(rejected) - _REASONS} before"] if len(rejected) > _REASONS else []
        self._rejected.set_text("\n".join(["Not used:", *rejected[-_REASONS:], *more]))
        self._rejected.set_visibility(bool(rejected))


def _sentence(name: str, poses: list[FinishedPose], fits: bool) -> str:
    left = residuals(poses) if fits else {}
    return f"{sweep_title(name)}: {sweep_summary(poses, left)}"


_MOST_COLUMNS = 10
_NEWEST = 10
_STANDS_OUT = 4.0
_STANDS_OUT_N = 0.01
_SWEEPS = {"bare": "Without the tool", "tool": "With the tool", "check": "Poses"}

Residuals = Mapping[int, tuple[float, float]]


def sweep_title(sweep: str) -> str:
    """What a sweep is called on the page."""
    return _SWEEPS.get(sweep) or texts.sentence(sweep).rstrip(".") or "Poses"


def sweep_summary(poses: Sequence[FinishedPose], residuals: Residuals) -> str:
    """A sweep in a sentence, such as "12 poses, 1 not used, they agree within 3.1 mN, ..."."""
    rejected = sum(not pose.accepted for pose in poses)
    text = texts.count(len(poses), "pose")
    if rejected:
        text += f", {rejected} not used"
    if residuals:
        force = median(value[0] for value in residuals.values())
        torque = median(value[1] for value in residuals.values())
        text += f"; they agree within {texts.size(force, torque)} so far"
    return text + "."


def rejections(poses: Sequence[FinishedPose]) -> list[str]:
    """Why poses are not used, a line each."""
    return [
        f"Roll {texts.degrees(pose.roll_rad)}, tilt {texts.degrees(pose.tilt_rad)}: {pose.text}"
        for pose in poses
        if not pose.accepted
    ]


def poses_table(poses: Sequence[FinishedPose], residuals: Residuals) -> str:
    """HTML: a grid where the poses are one, else the newest in a list. All text is escaped."""
    if not poses:
        return ""
    rolls = sorted({texts.degrees(pose.roll_rad, 0) for pose in poses}, key=_angle)
    tilts = sorted({texts.degrees(pose.tilt_rad, 0) for pose in poses}, key=_angle)
    odd = _odd(residuals)
    if len(rolls) > _MOST_COLUMNS or len(rolls) * len(tilts) > 2 * len(poses) + len(rolls):
        return _list(poses, residuals, odd)
    cells = {(texts.degrees(p.roll_rad, 0), texts.degrees(p.tilt_rad, 0)): p for p in poses}
    if len(cells) < len(poses):
        return _list(poses, residuals, odd)
    lines = [
        "<tr><th scope='row'>tilt \\ roll</th>"
        + "".join(f"<th scope='col'>{escape(roll)}</th>" for roll in rolls)
        + "</tr>"
    ]
    for tilt in tilts:
        line = f"<tr><th scope='row'>{escape(tilt)}</th>"
        for roll in rolls:
            pose = cells.get((roll, tilt))
            line += "<td></td>" if pose is None else _cell(pose, residuals, odd)
        lines.append(line + "</tr>")
    return (
        "<p class='panel-quiet'>Residual force, mN. ✓ used, ✗ not used, ▲ stands out</p>"
        f"<table class='panel-poses'>{''.join(lines)}</table>"
    )


def _list(poses: Sequence[FinishedPose], residuals: Residuals, odd: frozenset[int]) -> str:
    lines = [
        f"<tr><th scope='row'>{pose.number}</th><td>{escape(texts.degrees(pose.roll_rad))}</td>"
        f"<td>{escape(texts.degrees(pose.tilt_rad))}</td>{_cell(pose, residuals, odd)}</tr>"
        for pose in list(poses)[-_NEWEST:]
    ]
    head = "".join(
        f"<th scope='col'>{name}</th>" for name in ("pose", "roll", "tilt", "residual, mN")
    )
    return (
        "<p class='panel-quiet'>✓ used, ✗ not used, ▲ stands out</p>"
        f"<table class='panel-poses'><tr>{head}</tr>{''.join(lines)}</table>"
    )


def _cell(pose: FinishedPose, residuals: Residuals, odd: frozenset[int]) -> str:
    if not pose.accepted:
        return f"<td class='panel-pose-rejected' title='{escape(pose.text, quote=True)}'>✗</td>"
    residual = residuals.get(pose.number)
    if residual is None:
        return "<td class='panel-pose-used'>✓</td>"
    mark = "▲ " if pose.number in odd else ""
    kind = "odd" if mark else "used"
    title = escape(texts.size(*residual), quote=True)
    return f"<td class='panel-pose-{kind}' title='{title}'>{mark}{1e3 * residual[0]:.1f}</td>"


def _odd(residuals: Residuals) -> frozenset[int]:
    """Poses that stand out among the others."""
    if not residuals:
        return frozenset()
    limit = max(_STANDS_OUT_N, _STANDS_OUT * median(force for force, _ in residuals.values()))
    return frozenset(number for number, (force, _) in residuals.items() if force > limit)


def _angle(text: str) -> float:
    return float(text.rstrip("°"))


_ENOUGH = 4
"""Poses: six readings each, ten unknowns."""


def residuals(poses: Sequence[FinishedPose]) -> Mapping[int, tuple[float, float]]:
    """Compute each pose's residual force and torque, N and N.m, by its number.

    poses: of one sweep. Only accepted ones with a finite reading count; empty while they are too
    few.
    """
    used = [p for p in poses if p.accepted and p.wrench is not None and np.isfinite(p.wrench).all()]
    if len(used) < _ENOUGH:
        return {}
    gravity = gravity_in_sensor([p.roll_rad for p in used], [p.tilt_rad for p in used])
    readings = np.array([p.wrench for p in used])
    moments, offset = plain_least_squares(gravity, readings)
    left = readings - gravity_regressor(gravity) @ moments - offset
    lengths = np.linalg.norm(left.reshape(-1, 2, 3), axis=2)
    return {
        pose.number: (float(force), float(torque))
        for pose, (force, torque) in zip(used, lengths, strict=True)
    }
