# SPDX-License-Identifier: Apache-2.0
"""Numbers and times as the page writes them: g, mm, N, mN·m. No ROS, no NiceGUI.

What a file or a message has no number for (NaN) is written as "–".
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from datetime import datetime

NOTHING = "–"
# By a file's unit: what to multiply by, the unit then, and its decimals.
_SHOWN = {
    "kg": (1e3, "g", 2),
    "m": (1e3, "mm", 2),
    "N": (1e3, "mN", 1),
    "N.m": (1e3, "mN·m", 2),
}
_NAMES = {"com": "centre", "adapter com": "adapter's centre", "adapter mass": "adapter's mass"}


def mass(mass_kg: float, std_kg: float = math.nan) -> str:
    """Write a mass as "60.10 ± 0.03 g"; without a standard deviation "60.10 g".

    Args:
        mass_kg: the mass, kg.
        std_kg: its standard deviation, kg; NaN, 0 or infinite: unknown.

    Returns:
        The text.

    """
    if not math.isfinite(mass_kg):
        return NOTHING
    if not std_kg > 0.0 or math.isinf(std_kg):
        return f"{_plain(1e3 * mass_kg, 2)} g"
    digits = _digits(1e3 * std_kg)
    return f"{_plain(1e3 * mass_kg, digits)} ± {_plain(1e3 * std_kg, digits)} g"


def centre(com_m: Sequence[float]) -> str:
    """Write a centre as "55.0, 2.0, 45.0 mm".

    Args:
        com_m: (3,), m.

    Returns:
        The text.

    """
    return f"{_list([1e3 * value for value in com_m], 1)} mm"


def size(force_n: float, torque_nm: float) -> str:
    """Write a wrench's size as "3.1 mN, 0.05 mN·m"; from 1 N on in N.

    Args:
        force_n: size of the force, N.
        torque_nm: size of the torque, N·m.

    Returns:
        The text; "unknown" where one is not finite.

    """
    if not (math.isfinite(force_n) and math.isfinite(torque_nm)):
        return "unknown"
    force = f"{_short(force_n)} N" if abs(force_n) >= 1.0 else f"{_short(1e3 * force_n)} mN"
    return f"{force}, {_short(1e3 * torque_nm)} mN·m"


def norm(values: Sequence[float]) -> float:
    """Return the length of a vector.

    Args:
        values: its parts, of any unit.

    Returns:
        The length, in that unit; NaN where a part is.

    """
    return math.sqrt(sum(value * value for value in values))


def quantity_name(quantity: str) -> str:
    """Name a file's quantity: "com_x" is "centre x".

    Args:
        quantity: as `compare_tools` names it.

    Returns:
        The name.

    """
    words = quantity.replace("_", " ")
    head, _, axis = words.rpartition(" ")
    return _NAMES.get(words) or f"{_NAMES.get(head, head)} {axis}".strip()


def quantity(value: float, unit: str) -> str:
    """Write a file's number, units kg, m, N and N.m as g, mm, mN and mN·m.

    Args:
        value: in the file's unit.
        unit: the file's; another than these stays.

    Returns:
        The text.

    """
    factor, shown, digits = _SHOWN.get(unit, (1.0, unit, 4))
    return f"{_plain(factor * value, digits)} {shown}" if math.isfinite(value) else NOTHING


def change(value: float, unit: str) -> str:
    """Write a difference with its sign, such as "+0.10 g".

    Args:
        value: in the file's unit.
        unit: the file's, as for `quantity`.

    Returns:
        The text; a difference that is rounded to zero has no sign.

    """
    factor, shown, digits = _SHOWN.get(unit, (1.0, unit, 4))
    if not math.isfinite(value):
        return NOTHING
    rounded = round(factor * value, digits)
    return f"{rounded:+.{digits}f} {shown}" if rounded else f"{0:.{digits}f} {shown}"


def sigmas(value: float, std_dev: float) -> str:
    """Write a difference in standard deviations, such as "2.5 σ".

    Args:
        value: the difference.
        std_dev: its standard deviation, of the same unit; NaN: unknown.

    Returns:
        The text, without a sign.

    """
    if not std_dev > 0.0 or not math.isfinite(value / std_dev):
        return NOTHING
    return f"{abs(value) / std_dev:.1f} σ"


def date(rfc3339: str) -> str:
    """Write a time as "2026-11-21 14:03 UTC", in its own zone.

    Args:
        rfc3339: the time.

    Returns:
        The text; what can't be read comes back unchanged.

    """
    try:
        at = datetime.fromisoformat(rfc3339)
    except ValueError:
        return rfc3339
    zone = at.strftime("%z")
    if zone == "+0000":
        return at.strftime("%Y-%m-%d %H:%M UTC")
    return at.strftime("%Y-%m-%d %H:%M ") + zone if zone else at.strftime("%Y-%m-%d %H:%M")


def duration(seconds: float) -> str:
    """Write a duration roughly, such as "40 s", "2 min", "1 h 10 min".

    Args:
        seconds: the duration, s, finite.

    Returns:
        The text.

    """
    if seconds < 55.0:
        return f"{max(5, 5 * round(seconds / 5.0))} s"
    minutes = max(1, round(seconds / 60.0))
    if minutes < 60:
        return f"{minutes} min"
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min" if minutes else f"{hours} h"


def count(number: int, what: str) -> str:
    """Write a count, such as "1 pose", "56 poses".

    Args:
        number: how many.
        what: the word for one.

    Returns:
        The text.

    """
    return f"{number} {what}" if number == 1 else f"{number} {what}s"


def model_sentence(model: str) -> str:
    """Describe in plain words what a calibration's model has beside load and a constant offset.

    Args:
        model: the model's name, as the result has it.

    Returns:
        A sentence.

    """
    if "drifting bias" in model:
        text = "The sensor's offset drifted during the calibration, and the drift was taken out."
    elif "gains" in model or "rotation of the sensor" in model:
        text = "Gains or a rotation of the sensor were found, and are corrected."
    elif "rejected" in model:
        text = "The load and a constant offset explain the poses, but for some that were left out."
    else:
        text = "The load and a constant offset explain all poses."
    return text


def sentence(text: str, name: str = "") -> str:
    """Add a full stop at the end, and a capital at the start unless a name is there.

    Args:
        text: a node's message.
        name: a tool's, which keeps its first letter.

    Returns:
        The sentence; empty for an empty text.

    """
    text = text.strip()
    if not text:
        return text
    first = text.split()[0]
    is_word = first.rstrip(",:;.!?").isalpha() and first != name
    start = text[0].upper() if is_word else text[0]
    return start + text[1:] + ("" if text[-1] in ".!?" else ".")


def _digits(std: float) -> int:
    """Decimals that show a standard deviation with one digit, with two from 0.10 to 0.19 on."""
    leading = math.floor(math.log10(std))
    return min(3, max(0, -leading + (std < 2.0 * 10.0**leading)))


def _plain(value: float, digits: int) -> str:
    return f"{round(value, digits) + 0.0:.{digits}f}"


def _short(value: float, significant: int = 2) -> str:
    """With so many digits, and never as a power of ten."""
    if not math.isfinite(value):
        return NOTHING
    if value == 0.0:
        return "0"
    decimals = max(0, significant - 1 - math.floor(math.log10(abs(value))))
    return _plain(value, min(decimals, 6))


def _list(values: Sequence[float], digits: int) -> str:
    return ", ".join(_plain(v, digits) if math.isfinite(v) else NOTHING for v in values)
