# SPDX-License-Identifier: Apache-2.0
"""A suite without ROS, for what the page does; `python fake_panel.py` shows it in a browser."""

import math
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
from galen_model.arm.galen import GALEN
from galen_panel.state.history import History
from galen_panel.state.shapes import draw
from galen_panel.state.snapshot import (
    CallAnswer,
    ListedTool,
    LoadedTool,
    NodeLevel,
    NodeReport,
    QuantityDifference,
    SuiteState,
    ToolComparison,
)

POINTER = ListedTool(
    "pointer", 0.0601, 3e-5, (0.055, 0.002, 0.045), (1.6e-3, 1.7e-3, 2.8e-3),
    (3.6e-5, 3.5e-5, 3.5e-5), 56, "2026-11-21T14:03:11+00:00", (), True, True,
)  # fmt: skip
RETRACTOR = ListedTool(
    "retractor", 0.2, 3e-5, (0.07, -0.01, 0.055), (1.9e-3, 1.7e-3, 3.0e-3),
    (3.5e-5, 3.4e-5, 3.6e-5), 56, "2026-11-20T09:12:44+00:00", ("inertia",),
)  # fmt: skip
BROKEN = ListedTool("drill", problem="drill.json: field 'load' is missing")
ACTIVE = LoadedTool(
    "pointer", True, 0.0601, (0.055, 0.002, 0.045), (0.15, 0.0, 0.05),
    "2026-11-21T14:03:11+00:00", "as loaded", None,
)  # fmt: skip
COMPENSATING = NodeReport(
    "gravcomp", NodeLevel.OK, "compensating 'pointer'", {"state": "compensating"}, math.inf
)
"""It is never silent."""
CALIBRATION_READY = NodeReport(
    "calibration", NodeLevel.OK, "ready", {"state": "ready", "sweep_s": "102.0"}, math.inf
)
DRIVER_READY = NodeReport("sim_driver", NodeLevel.OK, "sends", {"state": "moving"}, math.inf)
ALL = frozenset(
    {
        "gravcomp/set_tool", "gravcomp/list_tools", "gravcomp/compare_tools",
        "gravcomp/remove_tool", "gravcomp/revert_tool", "gravcomp/enable", "gravcomp/tare",
        "calibration/confirm", "calibrate_tool", "check_tool", "collect_pushes", "attach_tool",
    }
)  # fmt: skip


class FakeSuite:
    """Notes each call in `calls`, answers `answer`; `put` changes the state."""

    def __init__(self, arm=GALEN):
        self.state = SuiteState(
            1, (POINTER, RETRACTOR, BROKEN), "/tools", "", ACTIVE,
            {one.name: one for one in (COMPENSATING, CALIBRATION_READY)}, {}, ALL,
            drawing=draw(arm),
        )  # fmt: skip
        self.history = History(arm)
        self.calls = []
        self.answer = CallAnswer(True, "done")
        self.comparison = ToolComparison(
            "the same within 2 sigma", True,
            (QuantityDifference("mass", "kg", 0.0601, 0.0602, 4e-5, "the same within 2 sigma"),),
            0.003, 0.0001,
        )  # fmt: skip
        self.watching = 0

    def put(self, **changes):
        self.state = replace(self.state, revision=self.state.revision + 1, **changes)

    @contextmanager
    def watch(self):
        self.watching += 1
        try:
            yield
        finally:
            self.watching -= 1

    def stream(self, start_s, seconds, rate_hz=500.0, seed=0):
        """Fill the history: the raw wrench swings, the compensated one is noise."""
        rng = np.random.default_rng(seed)
        t = start_s + np.arange(int(seconds * rate_hz)) / rate_hz
        stamps = (t * 1e9).astype(np.int64)
        noise = rng.normal(size=(len(t), 6)) * [0.02, 0.02, 0.03, 4e-4, 4e-4, 4e-4]
        swing = np.sin(t[:, None] * [0.5, 0.7, 0.9, 0.5, 0.7, 0.9])
        self.history.raw.append(stamps, noise + swing * [1, 2, 1, 0.08, 0.08, 0.09])
        self.history.compensated.append(stamps, noise)
        self.history.deflection.append(
            stamps[::5], swing[::5] * [3e-4, 2e-4, 1e-4, 1e-3, 1e-3, 1e-3]
        )
        arm = self.state.drawing.arm
        sizes = np.where(np.array(arm.units) == "m", 0.02, 0.8)
        joints = arm.home + sizes * np.resize(swing[::5].T, (len(arm.joints), len(t[::5]))).T
        self.history.joints.append(stamps[::5], joints)

    async def _called(self, *call):
        self.calls.append(call)
        return self.answer

    async def list_tools(self):
        return await self._called("list_tools")

    async def activate(self, tool):
        return await self._called("activate", tool)

    async def remove_tool(self, tool):
        return await self._called("remove_tool", tool)

    async def revert_tool(self, tool):
        return await self._called("revert_tool", tool)

    async def compare(self, tool):
        self.calls.append(("compare", tool))
        return self.comparison

    async def set_enabled(self, enabled):
        return await self._called("set_enabled", enabled)

    async def tare(self):
        return await self._called("tare")

    async def start(self, goal):
        return await self._called("start", goal)

    async def confirm(self):
        return await self._called("confirm")

    async def cancel(self, kind):
        return await self._called("cancel", kind)
