# SPDX-License-Identifier: Apache-2.0
"""Requests, goals and parameters that no node can take, made from a seed; and a world to ask in.

Each request has one field or more that is wrong, so that the one right answer is "no".
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from fuzz.readers import a_tool
from galen_calibration_behavior.ros.node import CalibrationNode
from galen_deflection.ros.collection_node import CollectionNode
from galen_deflection.ros.node import DeflectionNode
from galen_gravcomp.ros.node import GravcompNode
from galen_model.arm.galen import GALEN
from galen_model.files.calibration_file import calibration_path, write_calibration
from galen_ros.messages import STREAM, wrench_to_array
from galen_ros.node.testing import Harness, parameters
from galen_sim_driver.ros.node import SimDriverNode
from geometry_msgs.msg import WrenchStamped
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import GetParameters, ListParameters, SetParameters
from rclpy.action import ActionClient
from rclpy.node import Node
from rclpy.serialization import serialize_message

from galen_msgs.action import CalibrateTool, CheckTool, CollectPushes
from galen_msgs.srv import (
    CompareTools,
    GetTool,
    PushTool,
    RemoveTool,
    RenameTool,
    RevertTool,
    SetTool,
)

Bad = dict[str, list[Any]]

NAMES = [
    "../x", "/etc/passwd", "a/b", ".", "..", "a\nb", "\x1b[2J", "ä", "x" * 65, "%s%n", "${HOME}",
    "~", "absent", "\u202e", " ", "pointer.json", "pointer ", "POINTER", "x" * 100_000,
]  # fmt: skip
"""As a tool's name; none of them is there."""

NO_NAMES = [name for name in NAMES if name not in ("absent", "POINTER")]
"""Which not even a new tool can have."""

NOT_FINITE = [math.nan, math.inf, -math.inf]
HUGE = [1e300, -1e300, 1.7e308]

FORCES = [[x, 0.0, 0.0] for x in (*NOT_FINITE, *HUGE)] + [[0.0, math.nan, 1e308]]
TIMES = [*NOT_FINITE, -1.0, -1e308, 1.7e308]

SERVICES: dict[str, tuple[type, dict[str, Any], Bad]] = {
    "gravcomp/set_tool": (SetTool, {}, {"tool": NAMES}),
    "gravcomp/get_tool": (
        GetTool,
        {"tool": "pointer", "frame": "base_link", "joints": [*GALEN.home]},
        {
            "tool": NAMES,
            "frame": [*NAMES, "/base_link"],
            "joints": [[x] * 5 for x in NOT_FINITE] + [[0.0], [0.0] * 7, [0.0] * 100_000],
        },
    ),
    "gravcomp/compare_tools": (
        CompareTools,
        {"a": "pointer", "b": "retractor"},
        {"a": NAMES, "b": NAMES, "a_previous": [True], "b_previous": [True]},
    ),
    "gravcomp/rename_tool": (
        RenameTool,
        {"tool": "retractor", "new_name": "new"},
        {"tool": ["", *NAMES], "new_name": ["", "pointer", *NO_NAMES]},
    ),
    "gravcomp/remove_tool": (RemoveTool, {}, {"tool": ["", "pointer", *NAMES]}),
    "gravcomp/revert_tool": (RevertTool, {}, {"tool": ["", "pointer", *NAMES]}),
    "attach_tool": (SetTool, {}, {"tool": NAMES}),
    "push_tool": (
        PushTool,
        {"force_n": [1.0, 0.0, 0.0], "rise_s": 0.1, "hold_s": 0.1, "fall_s": 0.1},
        {"force_n": FORCES, "torque_nm": FORCES, "rise_s": TIMES, "hold_s": TIMES, "fall_s": TIMES},
    ),
}

NUMBERS = [*NOT_FINITE, *HUGE]
ACTIONS: dict[str, tuple[Any, dict[str, Any], Bad]] = {
    "calibrate_tool": (
        CalibrateTool,
        {"tool": "new", "tip_m": [0.1, 0.0, 0.0]},
        {
            "tool": ["", *NO_NAMES],
            "tip_m": [[x, 0.0, 0.0] for x in NUMBERS],
            "iters_t": [65535, 1000],
            "iters_r": [65535, 1000],
        },
    ),
    "check_tool": (CheckTool, {"tool": "pointer"}, {"tool": NAMES, "poses": [1, 3, 1000, 65535]}),
    "collect_pushes": (
        CollectPushes,
        {"name": "monday", "tool": "pointer", "push_by_service": True},
        {
            "name": ["", *NO_NAMES],
            "tool": ["", *NAMES],
            "sets": [21, 255],
            "positions": [[x] * 5 for x in NUMBERS] + [[0.0], [0.0] * 100_000],
            "forces_n": [[x] for x in (*NUMBERS, 0.0, -1.0, 1e5)] + [[1.0] * 100_000],
            "torques_nm": [[x] for x in (*NUMBERS, 0.0, -1.0, 1e5)] + [[1.0] * 100_000],
        },
    ),
}


def wrong(rng: random.Random, right: dict[str, Any], bad: Bad) -> dict[str, Any]:
    """A right request's fields with one of them wrong, or more."""
    names = rng.sample(sorted(bad), rng.choice([1, 1, 1, min(2, len(bad)), len(bad)]))
    return right | {name: rng.choice(bad[name]) for name in names}


def wrong_values() -> list[ParameterValue]:
    """Of every type that there is, and of some that there are not."""
    kind = ParameterType
    texts = ["", "../x", "a\nb", "\x1b[2J", "ä", "x" * 100_000, "/dev/zero", "/", "~", "off", "nan"]
    numbers = [*NOT_FINITE, *HUGE, -1.0, 0.0, 5e-324, 1e9]
    integers = [-(2**63), 2**63 - 1, -1, 0, 10**9]
    return [
        *(ParameterValue(type=kind.PARAMETER_STRING, string_value=text) for text in texts),
        *(ParameterValue(type=kind.PARAMETER_DOUBLE, double_value=x) for x in numbers),
        *(ParameterValue(type=kind.PARAMETER_INTEGER, integer_value=n) for n in integers),
        *(ParameterValue(type=kind.PARAMETER_BOOL, bool_value=on) for on in (True, False)),
        *(
            ParameterValue(type=kind.PARAMETER_DOUBLE_ARRAY, double_array_value=row)
            for row in ([], [math.nan] * 3, [1e300] * 3, [0.0] * 10_000)
        ),
        *(
            ParameterValue(type=kind.PARAMETER_STRING_ARRAY, string_array_value=row)
            for row in ([], [""], ["roll", "roll"], ["a\nb", "ä"], ["x"] * 1000)
        ),
        ParameterValue(type=kind.PARAMETER_INTEGER_ARRAY, integer_array_value=[-1]),
        ParameterValue(type=kind.PARAMETER_BOOL_ARRAY, bool_array_value=[True]),
        ParameterValue(type=kind.PARAMETER_BYTE_ARRAY, byte_array_value=[b"\xff"]),
        ParameterValue(type=kind.PARAMETER_NOT_SET),
        ParameterValue(type=10),
        ParameterValue(type=77),
        ParameterValue(type=255),
    ]


def told(text: str) -> str:
    """What a node says of a request that it rejects: one plain line, not a book."""
    assert text, "rejected without a word"
    assert text.isprintable(), f"not one plain line: {text!r:.300}"
    assert len(text) < 1200, f"{len(text)} letters: {text[:200]}"
    return text


class World:
    """Every node that takes requests, and a person who asks; an exception in any ends the test."""

    def __init__(self, harness: Harness, folder: Path) -> None:
        self.harness, self.folder = harness, folder
        self.tools, self.recordings = folder / "tools", folder / "recordings"
        for name, mass_kg in (("pointer", 0.06), ("retractor", 0.2)):
            write_calibration(calibration_path(self.tools, name), a_tool(name, mass_kg))
        tools = {"tools_dir": str(self.tools)}
        self.gravcomp = self.add(GravcompNode, tool="pointer", **tools)
        self.driver = self.add(SimDriverNode, initial_tool="pointer", speed_factor=0.2)
        self.nodes: list[Node] = [
            self.gravcomp,
            self.driver,
            self.add(CalibrationNode, **tools),
            self.add(CollectionNode, recordings_dir=str(self.recordings), **tools),
            self.add(DeflectionNode),
        ]
        self.person = harness.add(lambda context: Node("person", context=context))
        self.wrenches: list[np.ndarray] = []
        self.person.create_subscription(
            WrenchStamped,
            "wrench_compensated",
            lambda message: self.wrenches.append(wrench_to_array(message)),
            STREAM,
        )
        self._clients: dict[str, Any] = {}
        self.count = self.rejected = 0

    def add(self, kind: Callable[..., Any], **values: Any) -> Any:
        return self.harness.add(
            lambda context: kind(context=context, parameter_overrides=parameters(**values))
        )

    def call(self, name: str, kind: Any, /, **request: Any) -> Any:
        if name not in self._clients:
            self._clients[name] = self.person.create_client(kind, name)
        self.count += 1
        return self.harness.call(self._clients[name], kind.Request(**request))

    def goal(self, name: str, kind: Any, /, **goal: Any) -> Any:
        """The goal's result; None where it was rejected."""
        if name not in self._clients:
            self._clients[name] = ActionClient(self.person, kind, name)
            self.harness.wait_for(self._clients[name].server_is_ready, 10.0, name)
        self.count += 1
        request = kind.Goal(**goal)
        handle = self.harness.answer_of(
            lambda: self._clients[name].send_goal_async(request), 10.0, f"an answer of {name}"
        )
        if not handle.accepted:
            return None
        what = f"a result of {name}: {goal!r:.300}"
        return self.harness.answer_of(handle.get_result_async, 10.0, what).result

    def names_of(self, node: Node) -> list[str]:
        service = f"{node.get_name()}/list_parameters"
        return sorted(self.call(service, ListParameters).result.names)

    def values_of(self, node: Node, names: list[str]) -> list[ParameterValue]:
        return list(
            self.call(f"{node.get_name()}/get_parameters", GetParameters, names=names).values
        )

    @staticmethod
    def parameter(name: str, value: ParameterValue) -> Parameter:
        return Parameter(name=name, value=value)

    def set(self, node: Node, name: str, value: ParameterValue) -> str:
        """Why it was rejected, or ""."""
        service = f"{node.get_name()}/set_parameters"
        request = {"parameters": [self.parameter(name, value)]}
        (result,) = self.call(service, SetParameters, **request).results
        if result.successful:
            return ""
        self.rejected += 1
        return told(result.reason)

    def set_and_back(self, node: Node, name: str, value: ParameterValue) -> None:
        """Where it was taken, the old value is set again."""
        (old,) = self.values_of(node, [name])
        if not self.set(node, name, value) and old.type != ParameterType.PARAMETER_NOT_SET:
            assert self.set(node, name, old) == ""

    def let_them_work(self) -> None:
        """Some turns of the executor."""
        for _ in range(3):
            self.harness.call_in_executor(lambda: None)

    def files(self) -> dict[str, bytes | None]:
        """All there is in the folder that the nodes work in."""
        return {
            str(path.relative_to(self.folder)): path.read_bytes() if path.is_file() else None
            for path in self.folder.rglob("*")
        }

    def compensates(self) -> None:
        """After what strangers published as the compensation's output."""

        def found() -> bool:
            return len(self.wrenches) > count + 20 and bool(np.isfinite(self.wrenches[-20:]).all())

        count = len(self.wrenches)
        self.harness.wait_for(found, 10.0, "compensated wrenches that are finite")


def garbage(rng: random.Random, kind: type, count: int) -> list[bytes]:
    """Bytes that are no message of this type, or hardly."""
    right = serialize_message(kind())
    made = [b"", b"\0", b"\0\1\0\0", right[:5], right[:-1]]
    while len(made) < count:
        data = bytearray(right)
        for _ in range(rng.randint(1, 4)):
            at = rng.randrange(4, len(data))
            data[at : at + rng.choice([1, 4, 8])] = rng.choice([b"\xff", b"\xff" * 4, b"\x7f" * 8])
        made.append(bytes(data[: rng.randint(4, len(data))]) if rng.random() < 0.5 else bytes(data))
    return made[:count]
