"""A report as the page shows it: a verdict in a word, sentences, tables. No ROS, no NiceGUI."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from galen_diagnosis.answer.answer import Interval
from galen_diagnosis.report.words import parameter_words, title
from galen_model.arm.galen import WRENCH_AXES

from galen_panel.messages import texts
from galen_panel.recordings.report_files import PAGE, PICTURE, StoredReport, StoredReportError
from galen_panel.snapshot import NodeLevel

Row = list[str]
_UNITS = ("mN", "mN", "mN", "mN·m", "mN·m", "mN·m")
_AXES = [f"{axis} ({unit})" for axis, unit in zip(WRENCH_AXES, _UNITS, strict=True)]
_RANKED = 6
_WORTH_NAMING = 0.001

VERDICTS = {
    ("evaluate", "fits"): (NodeLevel.OK, "The calibration fits"),
    ("evaluate", "offset"): (NodeLevel.WARN, "An offset"),
    ("evaluate", "drift"): (NodeLevel.WARN, "The sensor drifts"),
    ("evaluate", "load"): (NodeLevel.ERROR, "Another load"),
    ("evaluate", "changed"): (NodeLevel.ERROR, "Something changed during the recording"),
    ("evaluate", "unexplained"): (NodeLevel.ERROR, "Does not fit, and nothing explains it"),
    ("evaluate", "unknown"): (NodeLevel.WARN, "Can't tell"),
    ("diagnose", "none"): (NodeLevel.OK, "No gap"),
    ("diagnose", "identified"): (NodeLevel.WARN, "Cause found"),
    ("diagnose", "ambiguous"): (NodeLevel.WARN, "Several causes are possible"),
    ("diagnose", "unknown"): (NodeLevel.ERROR, "A gap without a known cause"),
}
"""By the kind of a report and its verdict."""

_NEXT = {
    "none": "Nothing has to be done.",
    "identified": "Fix what is named above, then record again and diagnose again.",
    "ambiguous": "No experiment that is known here would separate the causes that are left.",
    "unknown": "Look below where the gap lies; record again to see whether it stays.",
}


@dataclass(frozen=True)
class ReportTable:
    """Texts in rows and columns; the first column names its row."""

    title: str
    headers: list[str]
    rows: list[Row]


@dataclass(frozen=True)
class ReportView:
    """All that is shown. lists: titles with sentences. picture, page: a file's name or empty."""

    level: NodeLevel
    word: str
    sentence: str
    about: str
    lists: list[tuple[str, list[str]]]
    tables: list[ReportTable]
    picture: str
    page: str


def verdict_of(report: StoredReport) -> tuple[NodeLevel, str]:
    """A verdict's level and its words."""
    return VERDICTS.get((report.kind, report.verdict), (NodeLevel.WARN, report.verdict))


def view_of(report: StoredReport, content: Mapping[str, Any], files: Sequence[str]) -> ReportView:
    """What to show of a report; files: those that it has. Raises ReportError for a damaged one."""
    try:
        lists, tables = _PARTS[report.kind](content)
    except (LookupError, TypeError, ValueError, AttributeError) as error:
        raise StoredReportError(f"{report.id}: the report is damaged: {error!r}") from error
    level, word = verdict_of(report)
    names = {"picture": PICTURE, "page": PAGE.rsplit("/", 1)[-1]}
    found = {key: name if name in files else "" for key, name in names.items()}
    about = f"{report.recording}, with {report.tool}, {texts.date(report.made_at)}"
    shown = [(heading, lines) for heading, lines in lists if lines]
    return ReportView(level, word, report.sentence, about, shown, tables, **found)


# An evaluation


def _evaluation(
    content: Mapping[str, Any],
) -> tuple[list[tuple[str, list[str]]], list[ReportTable]]:
    rmse = content["rmse"]
    received, out = content["wrenches"]["received"], content["wrenches"]["compensated"]
    summary = [
        f"{content['duration_s']:.1f} s recorded, {out} of {received} wrenches compensated.",
        f"{texts.count(content['still_phases'], 'still phase')}, {content['still_s']:.1f} s.",
    ]
    names = (
        ("means of still phases", "still_phases"),
        ("limit of a fit", "limit"),
        ("arm still, one reading", "still"),
        ("arm moving, one reading", "moving"),
        ("noise of one reading", "noise"),
    )
    tables = [
        ReportTable(
            "Residual (root mean square)",
            ["", *_AXES],
            [[name, *_cells(rmse[key])] for name, key in names],
        )
    ]
    misfit = content["residual_decomposition"]
    reasons = []
    if misfit is not None:
        tables.append(_made_of(misfit))
        for what in ("load", "drift"):
            if misfit[f"why_no_{what}"]:
                reasons.append(texts.sentence(f"{what} can't be told: {misfit[f'why_no_{what}']}"))
    if content["worst_poses"]:
        tables.append(_worst(content["worst_poses"]))
    tables.append(_stamps(content["stamps"]))
    found = [texts.sentence(str(line)) for line in content["findings"]]
    lists = [
        ("Recording", summary),
        ("What is wrong with the recording", found),
        ("What can't be told", reasons),
    ]
    return lists, tables


def _made_of(misfit: Mapping[str, Any]) -> ReportTable:
    parts = (
        ("another load", "load"),
        ("an offset", "offset"),
        ("drift", "drift"),
        ("the rest", "rest"),
    )
    rows = [[name, *_cells(misfit[key])] for name, key in parts if misfit[key] is not None]
    if misfit["rate_per_hour"] is not None:
        rows.append(["drift, per hour", *_cells(misfit["rate_per_hour"])])
        rows.append(["± of that", *_cells(misfit["rate_std"])])
    return ReportTable("What that is made of", ["", *_AXES], rows)


def _worst(poses: Sequence[Mapping[str, Any]]) -> ReportTable:
    rows = [
        [
            f"{pose['time_s']:.1f} s",
            f"{pose['duration_s']:.1f} s",
            texts.degrees(pose["roll_rad"]),
            texts.degrees(pose["tilt_rad"]),
            *_cells(pose["residual"]),
            "" if pose["agrees"] else "stands out",
        ]
        for pose in poses
    ]
    return ReportTable("Worst still phases", ["at", "for", "roll", "tilt", *_AXES, ""], rows)


def _stamps(stamps: Mapping[str, Any]) -> ReportTable:
    counted = ("gaps", "missing", "jumps", "duplicates", "out_of_order")
    rows = [
        [topic, str(one["messages"]), _number(one["rate_hz"], 1), *(str(one[k]) for k in counted)]
        for topic, one in stamps.items()
    ]
    headers = ["topic", "messages", "rate (Hz)", *(name.replace("_", " ") for name in counted)]
    return ReportTable("Time stamps", headers, rows)


def _cells(by_axis: Mapping[str, float] | None) -> Row:
    if by_axis is None:
        return [texts.NOTHING] * len(WRENCH_AXES)
    return [_number(1e3 * by_axis[axis], 2) for axis in WRENCH_AXES]


def _number(value: float | None, digits: int) -> str:
    return texts.NOTHING if value is None else f"{value:.{digits}f}"


# A diagnosis


def _diagnosis(content: Mapping[str, Any]) -> tuple[list[tuple[str, list[str]]], list[ReportTable]]:
    experiment = content["next_experiment"]
    todo = _NEXT.get(content["verdict"], "") if experiment is None else str(experiment["do"])
    closed = content["gap"].get("closed_fraction")
    gap = [f"With what was found {_share(closed)} of the gap is closed."] if closed else []
    lists = [
        ("What to do next", [texts.sentence(todo)]),
        ("Gap", gap if content["causes"] else []),
        ("What can't be told", [texts.sentence(str(one)) for one in content["cannot_tell"]]),
        ("What is wrong with the recording", [texts.sentence(str(p)) for p in content["problems"]]),
    ]
    tables = []
    if content["causes"]:
        headers = ["cause", "probability", "how much (95 % interval)", "gap closed", "or else"]
        tables.append(ReportTable("Causes", headers, [_cause(one) for one in content["causes"]]))
    ranking = [
        [title(_label(one)), f"{one['probability']:.1%}"]
        for one in content["ranking"][:_RANKED]
        if one["probability"] >= _WORTH_NAMING
    ]
    tables.append(
        ReportTable(
            "How likely each effect is; several can be there together",
            ["effect", "probability"],
            ranking,
        )
    )
    return lists, tables


def _cause(cause: Mapping[str, Any]) -> Row:
    parameters = {name: _parameter(value) for name, value in cause["parameters"].items()}
    words = [
        f"{name.rsplit('_', 1)[0].replace('_', ' ')}: "
        f"{parameter_words(cause['effect'], name, parameters)}"
        for name in parameters
    ]
    closed = cause["gap_closed"]
    return [
        title(_label(cause)),
        f"{cause['probability']:.1%}",
        "; ".join(words),
        _share(closed) if closed else texts.NOTHING,
        ", ".join(title(name) for name in _equivalent(cause)) or texts.NOTHING,
    ]


def _label(entry: Mapping[str, Any]) -> str:
    return f"{entry['effect']}:{entry['joint']}" if entry.get("joint") else str(entry["effect"])


def _equivalent(cause: Mapping[str, Any]) -> Iterator[str]:
    joints = cause.get("equivalent_joints", {})
    for effect in cause["equivalent"]:
        yield from [f"{effect}:{joint}" for joint in joints.get(effect, ())] or [effect]


def _parameter(value: Any) -> Any:
    """As `galen_diagnosis.answer.answer` had it before it became JSON."""
    if isinstance(value, Mapping) and "value" not in value:
        return {name: _parameter(part) for name, part in value.items()}
    if not isinstance(value, Mapping):
        return value
    number, limits = value["value"], value["ci95"]
    if isinstance(number, list):
        return [_interval(one, two) for one, two in zip(number, limits, strict=True)]
    return _interval(number, limits)


def _interval(number: float | None, limits: Sequence[float | None] | None) -> Interval:
    low, high = (None, None) if limits is None else limits
    return Interval(math.nan if number is None else number, low, high)


def _share(closed: Mapping[str, Any]) -> str:
    if closed["value"] is None:
        return texts.NOTHING
    text = f"{closed['value']:.0%}"
    limits = closed.get("ci95")
    return f"{text} ({limits[0]:.0%} to {limits[1]:.0%})" if limits else text


_PARTS = {"evaluate": _evaluation, "diagnose": _diagnosis}
