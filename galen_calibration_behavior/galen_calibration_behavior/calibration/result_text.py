"""A calibration's result for a person, and for a program."""

from __future__ import annotations

from typing import Any

import numpy as np
from galen_model.arm.galen import WRENCH_AXES
from galen_model.load.mounting.held_out import Worth
from galen_model.load.mounting.mounting import Mounting

from galen_calibration_behavior.calibration.estimate import Calibration


def calibration_fields(calibration: Calibration) -> dict[str, Any]:
    """A calibration's part of a CalibrateTool.Result by the names of its fields, as JSON has it.

    All but `tool`, `file` and the error; SI units.
    """
    file = calibration.content
    return {
        "mass_kg": file.load.mass_kg,
        "mass_std_kg": file.load.mass_std_kg,
        "com_m": file.load.com_m.tolist(),
        "com_std_m": file.load.com_std_m.tolist(),
        "bias_mass_kg": file.adapter.mass_kg,
        "bias_mass_std_kg": file.adapter.mass_std_kg,
        "bias_com_m": file.adapter.com_m.tolist(),
        "bias_com_std_m": file.adapter.com_std_m.tolist(),
        "rmse_force_n": file.rmse[:3].tolist(),
        "rmse_torque_nm": file.rmse[3:].tolist(),
        "poses_used": file.poses_used,
        "poses_rejected": list(file.poses_rejected),
        "warnings": list(calibration.warnings),
        "notes": list(calibration.notes),
    }


def format_result(result: Any) -> str:
    """Return a successful CalibrateTool.Result, or what has its fields, as a table.

    One standard deviation after +-. Without a `file` nothing was written.
    """
    lines = [
        f"{'':18}{'mass [g]':>18}   centre x, y, z in ft_sensor [mm]",
        _load_line(result.tool, result.mass_kg, result.mass_std_kg, result.com_m, result.com_std_m),
        _load_line(
            "adapter",
            result.bias_mass_kg,
            result.bias_mass_std_kg,
            result.bias_com_m,
            result.bias_com_std_m,
        ),
        "",
        "RMSE force  [N]    " + "".join(f"{v:10.4f}" for v in result.rmse_force_n),
        "RMSE torque [mN.m] " + "".join(f"{1e3 * v:10.4f}" for v in result.rmse_torque_nm),
        f"poses used         {result.poses_used:10d}",
        f"poses rejected     {len(result.poses_rejected):10d}",
    ]
    lines += [f"  {text}" for text in result.poses_rejected]
    lines += [*result.notes, *(f"warning: {text}" for text in result.warnings)]
    lines.append(f"written: {result.file}" if result.file else "nothing is written")
    return "\n".join(lines)


def _load_line(name: str, mass: float, mass_std: float, com: Any, com_std: Any) -> str:
    centre = "   ".join(
        f"{1e3 * value:8.3f} +- {1e3 * std:.3f}" for value, std in zip(com, com_std, strict=True)
    )
    return f"{name[:17]:18}{1e3 * mass:9.3f} +- {1e3 * mass_std:.3f}  {centre}"


def mounting_fields(calibration: Calibration) -> dict[str, Any] | None:
    """What the file holds of the mounting and how it did on held-out poses; SI units."""
    mounting, worth = calibration.content.mounting, calibration.worth
    if mounting is None or worth is None:
        return None
    return mounting.to_json() | {
        "held_out": {
            "blocks": worth.blocks,
            "rmse": {
                name: dict(zip(WRENCH_AXES, [_finite(v) for v in rmse], strict=True))
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
    return f"\n{_mounting_rows(mounting)}\n\n{_mounting_scores(worth)}\n{worth.sentence}\n"


def _mounting_rows(mounting: Mounting) -> str:
    lines = [f"{'estimated with the load':48}{'value':>10}{'std':>9}"]
    lines += [f"{n:48}{value:10.4f}{std:9.4f} {unit}" for n, value, std, unit in mounting.rows]
    return "\n".join(lines)


def _mounting_scores(worth: Worth) -> str:
    heads = [f"{axis} [{'mN' if axis[0] == 'f' else 'mN.m'}]" for axis in WRENCH_AXES]
    lines = [f"{'RMSE on held-out poses':24}" + "".join(f"{head:>11}" for head in heads)]
    for name, rmse in worth.rmse.items():
        cells = "".join(f"{1e3 * v:11.3f}" if np.isfinite(v) else f"{'-':>11}" for v in rmse)
        lines.append(f"{name:24}{cells}")
    return "\n".join(lines)


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
