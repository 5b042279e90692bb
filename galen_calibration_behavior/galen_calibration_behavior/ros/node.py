# SPDX-License-Identifier: Apache-2.0
"""`calibration_node`: calibrates and checks tools, one goal on the arm at a time."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any

from galen_model.errors import GalenError
from galen_ros.goal.node import GoalNode
from galen_ros.node.spin import run

from galen_calibration_behavior.common.parameters import CalibrationParameters
from galen_calibration_behavior.ros.calibration_action import CalibrateAction
from galen_calibration_behavior.ros.quick_check_action import CheckAction


class CalibrationNode(GoalNode):
    """The action servers `calibrate_tool` and `check_tool`."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(
            "calibration", CalibrationParameters, (CalibrateAction, CheckAction), **kwargs
        )

    def _set_up(self) -> None:
        self.status_values["tools_dir"] = Path(self.settings.tools_dir).expanduser()
        with suppress(GalenError):  # a goal's error says why its poses can't be
            self.status_values["sweep_s"] = self.settings.sweep_s()


def main() -> None:
    """Run the node until SIGINT or SIGTERM."""
    run(CalibrationNode)


if __name__ == "__main__":
    main()
