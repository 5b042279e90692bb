# SPDX-License-Identifier: Apache-2.0
"""`blind_check`: starts the checkout's `galen_validation.blind_check`, which is not installed."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

from galen_common.command import run_command
from galen_model.errors import GalenError


def main() -> int:
    """Entry point; returns the exit code."""
    checkout = Path(__file__).resolve().parents[2]
    if not (checkout / "galen_validation").is_dir():
        return run_command("blind_check", _not_installed)
    sys.path.insert(0, str(checkout))
    code: int = importlib.import_module("galen_validation.blind_check").main()
    return code


def _not_installed() -> int:
    raise GalenError("galen_validation is not installed: run `make blind` in the suite's folder")
