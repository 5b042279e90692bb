"""The few numbers of a node's report that a person looks at. No ROS."""

from __future__ import annotations

from collections.abc import Mapping

_RATE = "_hz"
_REJECTED = "rejected_"
_PLAIN = {
    "latency_median_ms": ("latency, half of them", "ms"),
    "latency_p99_ms": ("latency, 99 % of them", "ms"),
    "speed_reached": ("speed, times real time", ""),
    "std_mm": ("uncertain by", "mm"),
    "extrapolated_percent": ("beyond the model", "%"),
    "untouched_s": ("untouched so far", "s"),
    "messages": ("recorded messages", ""),
}
_COUNTS = {
    "late": "came late",
    "trajectories_rejected": "rejected motions",
    "restarts": "restarts of the driver",
}
_TEXTS = {"tool": "tool", "tare": "tare", "fit": "fit", "effects": "effects", "model": "model"}
_SAYS_NOTHING = ("", "none", "off", "not_judged")


def numbers_of(values: Mapping[str, str]) -> tuple[tuple[str, str], ...]:
    """Label and text of what matters: rates, latency, what was rejected at all, progress."""
    found = [(label, text) for key, label in _TEXTS.items()
             if (text := values.get(key, "")) not in _SAYS_NOTHING]  # fmt: skip
    if values.get("total", "0") != "0":
        found.append(("done", f"{values.get('done', '0')} of {values['total']}"))
    for key, text in values.items():
        number = _number(text)
        if number is None:
            continue
        if key.endswith(_RATE):
            found.append((key.removesuffix(_RATE), f"{number:.0f} Hz"))
        elif key in _PLAIN:
            label, unit = _PLAIN[key]
            found.append((label, f"{number:.3g} {unit}".rstrip()))
        elif number > 0.0 and key in _COUNTS:
            found.append((_COUNTS[key], f"{number:.0f}"))
        elif number > 0.0 and key.startswith(_REJECTED):
            reason = key.removeprefix(_REJECTED).replace("_", " ")
            found.append((f"left out, {reason}", f"{number:.0f}"))
    return tuple(found)


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None
