"""A calibration's estimate of sensor and mounting, for a person and for a program."""

from __future__ import annotations

from typing import Any

import numpy as np
from galen_model.arm.galen import WRENCH_AXES
from galen_model.load.mounting.held_out import Worth
from galen_model.load.mounting.mounting import Mounting

from galen_calibration_behavior.calibration.estimate import Calibration


def mounting_fields(calibration: Calibration) -> dict[str, Any] | None:
    """What the file holds of the mounting and how it did on held-out poses; SI units."""
    mounting, worth = calibration.content.mounting, calibration.worth
    if mounting is None or worth is None:
        return None
    return mounting.to_json() | {
        "held_out": {
            "blocks": worth.blocks,
            "rmse": {
                name: dict(zip(WRENCH_AXES, [_number(v) for v in rmse], strict=True))
                for name, rmse in worth.rmse.items()
            },
            "against": worth.against,
            "gain": worth.gain,
            "gain_std": worth.gain_std,
            "pays": worth.pays,
        }
    }


def format_mounting(calibration: Calibration) -> str:
    """The same as tables, in degrees, per cent, mN and mN.m; empty where nothing was asked."""
    mounting, worth = calibration.content.mounting, calibration.worth
    if mounting is None or worth is None:
        return ""
    return f"\n{_values(mounting)}\n\n{_scores(worth)}\n{worth.sentence}\n"


def _values(mounting: Mounting) -> str:
    lines = [f"{'estimated with the load':48}{'value':>10}{'std':>9}"]
    lines += [f"{n:48}{value:10.4f}{std:9.4f} {unit}" for n, value, std, unit in mounting.rows]
    return "\n".join(lines)


def _scores(worth: Worth) -> str:
    heads = [f"{axis} [{'mN' if axis[0] == 'f' else 'mN.m'}]" for axis in WRENCH_AXES]
    lines = [f"{'RMSE on held-out poses':24}" + "".join(f"{head:>11}" for head in heads)]
    for name, rmse in worth.rmse.items():
        cells = "".join(f"{1e3 * v:11.3f}" if np.isfinite(v) else f"{'-':>11}" for v in rmse)
        lines.append(f"{name:24}{cells}")
    return "\n".join(lines)


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
