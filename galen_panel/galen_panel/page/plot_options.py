# SPDX-License-Identifier: Apache-2.0
"""How the plots look: ECharts' options, plain dictionaries. No ROS, no page.

Six plots of the wrench in two columns (force left, torque right), below them one of the tip's
deflection; where the page is narrow, all in one column. All share the time axis, seconds before the
newest sample, and one zoom. Above each plot is room for a heading that the page writes; `headings`
says where.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from galen_model.arm.galen import WRENCH_AXES
from galen_model.arrays import Array

Option = dict[str, Any]

LEGEND_PX = 44
ROW_PX = 172
HEADING_PX = 44
BETWEEN_PX = 16
TIME_PX = 34
NAME_PX = 30
SLIDER_PX = 34
NARROW_PX = 760
"""Up to this width headings would not fit beside each other."""
_FONT_PX = 18
_FONT = "Roboto, sans-serif"
_LEFT_PX = 96
_RIGHT_PX = 16
_RIGHT_COLUMN = "60%"

DEFLECTION_NAMES = ("x", "y", "z", "size")
# Distinguished by their dashes as well as by their colours.
_DASHES = ("solid", "dashed", "dotted", "solid")


def wrench_curves(values: Array) -> Array:
    """Turn wrenches into the units that are plotted.

    Args:
        values: (n, 6), N and N·m.

    Returns:
        (n, 6), N and mN·m.

    """
    return np.asarray(values * [1, 1, 1, 1e3, 1e3, 1e3])


def deflection_curves(values: Array) -> Array:
    """Turn deflections into the curves that are plotted.

    Args:
        values: (n, 6), translation in m and rotation in rad.

    Returns:
        (n, 4): x, y, z and their size, mm.

    """
    sizes = np.linalg.norm(values[:, :3], axis=1)
    return 1e3 * np.column_stack([values[:, :3], sizes])


def headings() -> list[tuple[str, str, str]]:
    """Return axis, unit and place (CSS) of the headings of the six axes, then of the tip."""
    return [
        (
            axis,
            _unit(index),
            f"left:{_left(index, narrow=False)};top:{_top(_row(index, narrow=False))}px;"
            f"--narrow-left:{_LEFT_PX}px;--narrow-top:{_top(_row(index, narrow=True))}px",
        )
        for index, axis in enumerate((*WRENCH_AXES, "tip"))
    ]


def heights() -> str:
    """Return the chart's height, wide and narrow (CSS)."""
    wide, narrow = (
        _top(rows) + (0 if rows % 3 == 0 else TIME_PX) + NAME_PX + SLIDER_PX for rows in (4, 7)
    )
    return f"height:{wide}px;--narrow-height:{narrow}px"


def options(window_s: float) -> Option:
    """Return all options of the chart; its datasets raw, compensated and deflection have no rows.

    Args:
        window_s: length of the time axis, s.

    Returns:
        ECharts' options.

    """
    return {
        "animation": False,
        "textStyle": {"fontSize": _FONT_PX, "fontFamily": _FONT},
        "legend": {
            "type": "scroll",
            "pageTextStyle": {"fontSize": _FONT_PX},
            "top": 2,
            "itemGap": 24,
            "itemWidth": 40,
            # A line with its dashes, without a symbol on it.
            "itemStyle": {"opacity": 0},
            "lineStyle": {"width": "inherit"},
            "textStyle": {"fontSize": _FONT_PX},
            "data": ["raw", "compensated", *(f"tip {name}" for name in DEFLECTION_NAMES)],
        },
        "tooltip": {
            "trigger": "axis",
            "confine": True,
            "textStyle": {"fontSize": _FONT_PX},
        },
        "axisPointer": {"link": [{"xAxisIndex": "all"}]},
        "dataset": [{"id": name, "source": []} for name in ("raw", "compensated", "deflection")],
        "media": [
            {"option": _places(narrow=False)},
            {"query": {"maxWidth": NARROW_PX}, "option": _places(narrow=True)},
        ],
        "xAxis": [_time_axis(index, window_s) for index in range(7)],
        "yAxis": [_value_axis(index) for index in range(7)],
        "dataZoom": [
            # Without a key the wheel scrolls the page.
            {"type": "inside", "xAxisIndex": "all", "zoomOnMouseWheel": "shift"},
            {
                "type": "slider",
                "xAxisIndex": "all",
                "bottom": 4,
                "left": _LEFT_PX,
                "right": _RIGHT_PX,
                "height": SLIDER_PX,
                "showDataShadow": False,
                "showDetail": False,
                "brushSelect": False,
            },
        ],
        "series": [
            *(_curve(stream, index) for stream in ("raw", "compensated") for index in range(6)),
            *(_tip_curve(index) for index in range(4)),
        ],
    }


def time_span(span_s: float) -> Option:
    """Return the option of another length of the time axis.

    Args:
        span_s: the length, s.

    Returns:
        ECharts' options, of the time axes alone.

    """
    return {"xAxis": [{"min": -span_s} for _ in range(7)]}


def look(dark: bool) -> Option:
    """Return the colours on a page.

    Args:
        dark: whether the page is dark.

    Returns:
        ECharts' options, of the colours alone.

    """
    text, faint = ("#e6eaee", "#3d4852") if dark else ("#1f2933", "#d5dbe1")
    raw, compensated = ("#8397ab", "#ffb347") if dark else ("#8294a6", "#b84300")
    tip = ("#6cb8ff", "#ff8fb1", "#7ddc9a", "#ffffff") if dark else (
        "#0a5fb4", "#b0145a", "#12703a", "#101418"
    )  # fmt: skip
    axis = {
        "axisLabel": {"color": text},
        "axisLine": {"lineStyle": {"color": text}},
        "nameTextStyle": {"color": text},
        "splitLine": {"lineStyle": {"color": faint}},
    }
    colours = [
        *((f"raw {name}", raw) for name in WRENCH_AXES),
        *((f"compensated {name}", compensated) for name in WRENCH_AXES),
        *((f"tip {name}", colour) for name, colour in zip(DEFLECTION_NAMES, tip, strict=True)),
    ]
    return {
        "textStyle": {"color": text},
        "legend": {
            "textStyle": {"color": text},
            "pageTextStyle": {"color": text},
            "pageIconColor": text,
            "inactiveColor": "#808890",
        },
        "tooltip": {
            "backgroundColor": "#2a3138" if dark else "#ffffff",
            "textStyle": {"color": text},
        },
        "xAxis": [axis] * 7,
        "yAxis": [axis] * 7,
        "series": [
            {"id": name, "lineStyle": {"color": colour}, "itemStyle": {"color": colour}}
            for name, colour in colours
        ],
    }


def _unit(index: int) -> str:
    return "mm" if index == 6 else "N" if index < 3 else "mN·m"


def _row(index: int, narrow: bool) -> int:
    """Return the row of a plot: fx ... tz, tip."""
    return index if narrow else 3 if index == 6 else index % 3


def _left(index: int, narrow: bool) -> str:
    # ECharts adds no lengths in px to those in %.
    return _RIGHT_COLUMN if 3 <= index < 6 and not narrow else f"{_LEFT_PX}px"


def _top(row: int) -> int:
    """Where a row begins, px; below the last row of forces, and of torques, the time is told."""
    return LEGEND_PX + row * ROW_PX + row // 3 * TIME_PX


def _places(narrow: bool) -> Option:
    return {
        "legend": {"left": 0 if narrow else _LEFT_PX},
        "grid": [
            {
                "top": _top(_row(index, narrow)) + HEADING_PX,
                "height": ROW_PX - HEADING_PX - BETWEEN_PX,
                "left": _left(index, narrow),
                "right": "52%" if index < 3 and not narrow else _RIGHT_PX,
            }
            for index in range(7)
        ],
    }


def _time_axis(index: int, window_s: float) -> Option:
    labelled = index in (2, 5, 6)
    axis: Option = {
        "type": "value",
        "gridIndex": index,
        "min": -window_s,
        "max": 0,
        "axisLabel": {
            "show": labelled,
            "fontSize": _FONT_PX,
            "hideOverlap": True,
            # Where it is zoomed the ends are no round numbers.
            ":formatter": "(seconds) => String(Number(seconds.toFixed(2)))",
        },
        "axisTick": {"show": labelled},
        "splitLine": {"show": True},
        # Otherwise the axis would cross at a value of 0, in the midst of the curves.
        "axisLine": {"onZero": False},
    }
    if index == 6:
        axis |= {
            "name": "seconds before the newest sample",
            "nameLocation": "middle",
            "nameGap": NAME_PX,
            "nameTextStyle": {"fontSize": _FONT_PX},
        }
    return axis


def _value_axis(index: int) -> Option:
    name = "tip" if index == 6 else WRENCH_AXES[index]
    return {
        "type": "value",
        "gridIndex": index,
        "scale": True,
        "splitNumber": 3,
        "name": f"{name}, {_unit(index)}",
        "nameLocation": "middle",
        "nameGap": 62,
        "nameTextStyle": {"fontSize": _FONT_PX},
        # Otherwise at a time of 0, on the right.
        "axisLine": {"show": True, "onZero": False},
        "axisLabel": {"fontSize": _FONT_PX, "hideOverlap": True},
    }


def _curve(stream: str, index: int) -> Option:
    raw = stream == "raw"
    return {
        "id": f"{stream} {WRENCH_AXES[index]}",
        "name": stream,
        "type": "line",
        "datasetIndex": 0 if raw else 1,
        "xAxisIndex": index,
        "yAxisIndex": index,
        "encode": {"x": 0, "y": index + 1},
        "showSymbol": False,
        "lineStyle": {"width": 1 if raw else 2.5},
        "z": 2 if raw else 3,
        "silent": True,
    }


def _tip_curve(index: int) -> Option:
    return {
        "id": f"tip {DEFLECTION_NAMES[index]}",
        "name": f"tip {DEFLECTION_NAMES[index]}",
        "type": "line",
        "datasetIndex": 2,
        "xAxisIndex": 6,
        "yAxisIndex": 6,
        "encode": {"x": 0, "y": index + 1},
        "showSymbol": False,
        "lineStyle": {"width": 3 if index == 3 else 2, "type": _DASHES[index]},
        "silent": True,
    }
