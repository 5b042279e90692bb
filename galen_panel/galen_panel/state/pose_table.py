"""A sweep's poses as a table: roll by tilt with what each one leaves over. No ROS, no NiceGUI."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from statistics import median

from galen_panel.messages import texts
from galen_panel.state.snapshot import Pose

_MOST_COLUMNS = 10
_NEWEST = 10
_STANDS_OUT = 4.0
_STANDS_OUT_N = 0.01
_SWEEPS = {"bare": "Without the tool", "tool": "With the tool", "check": "Poses"}

Residuals = Mapping[int, tuple[float, float]]


def sweep_title(sweep: str) -> str:
    """What a sweep is called on the page."""
    return _SWEEPS.get(sweep) or texts.sentence(sweep).rstrip(".") or "Poses"


def summary(poses: Sequence[Pose], residuals: Residuals) -> str:
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


def rejections(poses: Sequence[Pose]) -> list[str]:
    """Why poses are not used, a line each."""
    return [
        f"Roll {texts.degrees(pose.roll_rad)}, tilt {texts.degrees(pose.tilt_rad)}: {pose.text}"
        for pose in poses
        if not pose.accepted
    ]


def table(poses: Sequence[Pose], residuals: Residuals) -> str:
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
        "<p class='panel-quiet'>Force left over, mN. ✓ used, ✗ not used, ▲ stands out</p>"
        f"<table class='panel-poses'>{''.join(lines)}</table>"
    )


def _list(poses: Sequence[Pose], residuals: Residuals, odd: frozenset[int]) -> str:
    lines = [
        f"<tr><th scope='row'>{pose.number}</th><td>{escape(texts.degrees(pose.roll_rad))}</td>"
        f"<td>{escape(texts.degrees(pose.tilt_rad))}</td>{_cell(pose, residuals, odd)}</tr>"
        for pose in list(poses)[-_NEWEST:]
    ]
    head = "".join(f"<th scope='col'>{name}</th>" for name in ("pose", "roll", "tilt", "left, mN"))
    return (
        "<p class='panel-quiet'>✓ used, ✗ not used, ▲ stands out</p>"
        f"<table class='panel-poses'><tr>{head}</tr>{''.join(lines)}</table>"
    )


def _cell(pose: Pose, residuals: Residuals, odd: frozenset[int]) -> str:
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
