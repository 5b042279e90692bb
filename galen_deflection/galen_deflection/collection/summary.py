"""`collection.json`: what a collection was asked for, and what came of it."""

from __future__ import annotations

from typing import Any

import numpy as np
from galen_model.arrays import Array
from galen_model.files.json_fields import numbers

from galen_deflection.collection.commands import Collected, ErrorCode
from galen_deflection.collection.plan import CollectionPlan

SCHEMA_VERSION = 1


def summary(
    name: str,
    tool: str,
    plan: CollectionPlan,
    by_service: bool,
    error_code: ErrorCode,
    error_msg: str,
    collected: Collected,
    messages: int,
) -> dict[str, Any]:
    """The file's content; SI units, lengths m, angles rad, loads N and N.m."""
    return {
        "schema_version": SCHEMA_VERSION,
        "name": name,
        "tool": tool,
        "finished": error_code == ErrorCode.NONE,
        "error": {"code": error_code.name, "message": error_msg},
        "asked": {
            "sets": plan.sets,
            "positions": [numbers(row) for row in plan.positions],
            "pushes": [numbers(push.wrench) for push in plan.pushes],
            "push_by_service": by_service,
        },
        "pushes": collected.pushes,
        "pushes_asked": plan.total,
        "left_out": list(collected.left_out),
        "calibration": {"shift": _or_none(collected.shift), "holds": collected.holds},
        "messages": messages,
        "warnings": list(collected.warnings),
    }


def _or_none(values: Array) -> list[float] | None:
    """JSON has no NaN."""
    return numbers(values) if np.all(np.isfinite(values)) else None
