"""A calibration's result for a person, and for a program."""

from __future__ import annotations

from array import array
from typing import Any

import numpy as np


def result_to_dict(result: Any) -> dict[str, Any]:
    """Return a CalibrateTool.Result as plain numbers, texts and lists, SI units."""
    plain = {}
    for name in result.get_fields_and_field_types():
        value = getattr(result, name)
        plain[name] = list(value) if isinstance(value, array) else value
        if isinstance(value, np.ndarray):
            plain[name] = value.tolist()
    return plain


def format_result(result: Any) -> str:
    """Return a successful CalibrateTool.Result as a table; one standard deviation after +-."""
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
    lines += [f"warning: {text}" for text in result.warnings]
    lines.append(f"written: {result.file}")
    return "\n".join(lines)


def _load_line(name: str, mass: float, mass_std: float, com: Any, com_std: Any) -> str:
    centre = "   ".join(
        f"{1e3 * value:8.3f} +- {1e3 * std:.3f}" for value, std in zip(com, com_std, strict=True)
    )
    return f"{name[:17]:18}{1e3 * mass:9.3f} +- {1e3 * mass_std:.3f}  {centre}"
