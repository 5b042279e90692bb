"""The streams as a CSV file, every sample at its full rate. No ROS, no page."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import datetime

import numpy as np
from galen_model.arm.galen import WRENCH_AXES
from galen_model.arrays import Array

from galen_panel.state.history import NS_PER_S, Samples

_UNITS = ("n",) * 3 + ("nm",) * 3
_DEFLECTION = ("x_m", "y_m", "z_m", "rx_rad", "ry_rad", "rz_rad")
_BLOCK = 2000

HEADER = ",".join(
    [
        "stamp_s",
        *(f"raw_{axis}_{unit}" for axis, unit in zip(WRENCH_AXES, _UNITS, strict=True)),
        *(f"compensated_{axis}_{unit}" for axis, unit in zip(WRENCH_AXES, _UNITS, strict=True)),
        *(f"deflection_{axis}" for axis in _DEFLECTION),
    ]
)
"""SI units; wrenches in ft_sensor, the deflection of the tip in base_link."""


def file_name(kind: str, ending: str, now: datetime) -> str:
    """Such as galen_wrench_2026-11-22_09-03-12.csv."""
    return f"galen_{kind}_{now:%Y-%m-%d_%H-%M-%S}.{ending}"


def between(samples: Samples, start_ns: int, end_ns: int) -> Samples:
    """The samples of this time, both ends included."""
    first, last = np.searchsorted(samples.stamps_ns, [start_ns, end_ns + 1])
    return Samples(samples.stamps_ns[first:last], samples.values[first:last], samples.run)


def csv(raw: Samples, compensated: Samples, deflection: Samples) -> bytes:
    """One row a stamp, joined by equal stamps; a cell is empty where a stream has no such stamp."""
    return "".join(_lines(raw, compensated, deflection)).encode()


def _lines(*streams: Samples) -> Iterator[str]:
    yield HEADER + "\n"
    stamps = np.unique(np.concatenate([samples.stamps_ns for samples in streams]))
    table: Array = np.full((len(stamps), 6 * len(streams)), np.nan)
    for index, samples in enumerate(streams):
        rows = np.searchsorted(stamps, samples.stamps_ns)
        table[rows, 6 * index : 6 * index + 6] = samples.values
    line = "%d.%09d" + ",%.7g" * table.shape[1] + "\n"
    for start in range(0, len(stamps), _BLOCK):
        block = zip(
            stamps[start : start + _BLOCK].tolist(),
            table[start : start + _BLOCK].tolist(),
            strict=True,
        )
        text = "".join(line % (*divmod(stamp, NS_PER_S), *row) for stamp, row in block)
        yield text.replace("nan", "")
