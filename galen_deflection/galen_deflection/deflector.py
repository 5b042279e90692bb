# SPDX-License-Identifier: Apache-2.0
"""A model on live samples: wrenches and joints go in, deflections come out. No ROS.

Each wrench pushed ends in exactly one way: as a `Deflected`, or as a `Rejected` that names the
reason. Which joints belong to a wrench is for `galen_common.stream.pairing` to say, as for the
compensator.

A model with hysteresis remembers the loads that it was given, in their order. Whatever makes that
memory doubtful makes it forget: its stream starts anew, and its covariance holds what is unknown
until loads have passed again: after a gap in the wrenches longer than `memory_gap_s` (rejected ones
count as lacking), after a restart of the driver, and by `forget`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

import numpy as np
from galen_common.parameters import param
from galen_common.stream.pairing import StreamParameters, WrenchPairing
from galen_common.stream.samples import PairedWrench, Rejected
from galen_model.arm.arm import Arm
from galen_model.arrays import Array
from galen_model.errors import KinematicsError
from galen_model.rotation import matrix_to_quaternion

from galen_deflection.models.file import DeflectionModel
from galen_deflection.models.interface import Predicted
from galen_deflection.models.network import NetworkStream
from galen_deflection.models.spring_model import SpringStream

TIP_TOLERANCE_M = 1e-5
"""Largest distance of a model's tip from the tool's: a third of the tracker's noise."""


@dataclass(frozen=True)
class DeflectionParameters(StreamParameters):
    """Parameters of the node. Times of samples are by their stamps."""

    model_file: str = param(
        "",
        "file of the model, as `train` writes it; `~` is expanded; empty: nothing is published."
        " Setting it again reads it again; a file that can't be used is rejected, and the active"
        " model stays",
        read_only=False,
    )
    joint_names: tuple[str, ...] = param(
        (),
        "names in `joint_states` of the arm's joints, in its order; empty: as the arm has them",
    )
    memory_gap_s: float = param(
        0.1,
        "s; after a longer time without a usable wrench, loads may have come and gone unseen: the"
        " hysteresis is forgotten",
        minimum=0.002,
        maximum=10.0,
    )
    gravcomp_node: str = param(
        "gravcomp",
        "name of the compensation's node, whose tool and tare are followed on `/diagnostics`;"
        " empty: they are not",
    )


class ModelRejection(Enum):
    """Why a deflection was not predicted, beside `galen_common.stream.samples.Rejection`."""

    NO_MODEL = "no_model"
    OTHER_TIP = "other_tip"  # the model was fitted for another tool's tip
    OUT_OF_ORDER = "out_of_order"  # hysteresis takes loads in their order only
    OUT_OF_REACH = "out_of_reach"  # joints at which the rods don't reach
    NONFINITE = "nonfinite_prediction"


class Deflected(NamedTuple):
    """A deflection at the stamp of its wrench, and the tip's pose with it, in base_link.

    tip: position (3,), m, and quaternion xyzw.
    """

    stamp_ns: int
    predicted: Predicted
    tip: tuple[tuple[float, ...], tuple[float, ...]]
    tag: object
    number: int  # of the wrench in the order of arrival, from 0
    joints: tuple[float, ...]  # at the stamp, m and rad


class Deflector:
    """Streams one sensor's compensated wrenches through one model.

    `pairing` decides which samples are taken, and counts.
    """

    def __init__(
        self,
        parameters: DeflectionParameters | None = None,
        on_restart: Callable[[str], None] | None = None,
        on_forgotten: Callable[[str], None] | None = None,
        *,
        arm: Arm,
    ) -> None:
        """`on_forgotten(why)` is called after the memory of the active model was dropped."""
        parameters = parameters or DeflectionParameters()
        self._on_restart = on_restart
        self.pairing = WrenchPairing(
            parameters,
            self._forget_driver,
            wrench_topic="wrench_compensated",
            sensor_frame=arm.sensor_frame,
            arm=arm,
        )
        self._memory_gap_ns = round(parameters.memory_gap_s * 1e9)
        self._on_forgotten = on_forgotten
        self._model: DeflectionModel | None = None
        self._why_none = "no model is loaded"
        self._stream: SpringStream | NetworkStream | None = None
        self._tool = ""
        self._tool_tip_m: Array | None = None
        self._other_tip = ""
        self._fed_ns: int | None = None
        self.last: Deflected | None = None
        """The newest result."""
        self.predicted = 0
        self.extrapolated = 0
        self.forgotten = 0
        self._compare_tips()

    # State

    @property
    def model(self) -> DeflectionModel | None:
        """The active model."""
        return self._model

    @property
    def other_tip(self) -> str:
        """Why the model is not for the tool that is on; empty if it is, or that isn't known."""
        return self._other_tip

    def set_model(
        self, model: DeflectionModel | None, why_none: str = "no model is loaded"
    ) -> list[Deflected | Rejected]:
        """Activate a model, or none; it has seen no load yet.

        Args:
            model: the fitted model; None: none, and every wrench is rejected.
            why_none: the reason without a model, as rejections name it.

        Returns:
            What became of the wrenches that waited, where they are rejected now.

        """
        self._model = model
        self._why_none = why_none
        self._stream = None if model is None else model.stream()
        self._fed_ns = None
        self.last = None
        return self._compare_tips()

    def set_tool(self, tool: str, tip_m: Array | None) -> list[Deflected | Rejected]:
        """Set the tool that is on; a model for another tip is not used with it.

        Args:
            tool: the tool's name, for messages.
            tip_m: (3,) in ft_sensor; None: not known, and not compared.

        Returns:
            What became of the wrenches that waited, where they are rejected now.

        """
        self._tool, self._tool_tip_m = tool, tip_m
        return self._compare_tips()

    def forget(self, why: str) -> bool:
        """Forget all loads, as if the arm had never been loaded.

        Args:
            why: the reason, for `on_forgotten`.

        Returns:
            Whether there were any.

        """
        if self._stream is None or self._fed_ns is None:
            return False
        self._stream.reset()
        self._fed_ns = None
        self.last = None
        self.forgotten += 1
        if self._on_forgotten is not None:
            self._on_forgotten(why)
        return True

    # Samples

    def push_joints(
        self, stamp_ns: int, positions: tuple[float, ...]
    ) -> list[Deflected | Rejected]:
        """Take a joint sample.

        Args:
            stamp_ns: its stamp.
            positions: (j,), m and rad.

        Returns:
            What became of the wrenches that waited for it.

        """
        return self._made(self.pairing.push_joints(stamp_ns, positions))

    def push_wrench(
        self,
        stamp_ns: int,
        wrench: Sequence[float] | Array,
        frame_id: str | None = None,
        tag: object = None,
    ) -> list[Deflected | Rejected]:
        """Take a wrench as `WrenchPairing.push_wrench`.

        Args:
            stamp_ns: its stamp.
            wrench: (6,) compensated, in the sensor's frame, N and N.m.
            frame_id: the message's; None: not checked.
            tag: comes back with the deflection.

        Returns:
            What became of it and of those that waited; empty while it waits for joints.

        """
        return self._made(self.pairing.push_wrench(stamp_ns, wrench, frame_id, tag))

    # Inside

    def _made(self, results: list[PairedWrench | Rejected]) -> list[Deflected | Rejected]:
        return [self._deflect(one) if isinstance(one, PairedWrench) else one for one in results]

    def _forget_driver(self, why: str) -> None:
        """Forget the loads that belong to the driver's life so far."""
        self.forget(why)
        if self._on_restart is not None:
            self._on_restart(why)

    def _compare_tips(self) -> list[Deflected | Rejected]:
        self._other_tip = ""
        model, tip_m = self._model, self._tool_tip_m
        if model is not None and tip_m is not None and _apart(model.tip_m, tip_m):
            self._other_tip = (
                f"the model is for a tip at {_point(model.tip_m)} m, the tool '{self._tool}'"
                f" has its tip at {_point(tip_m)} m: load a model of this tool (model_file)"
            )
        if model is None:
            return [*self.pairing.bar(ModelRejection.NO_MODEL, self._why_none)]
        if self._other_tip:
            return [*self.pairing.bar(ModelRejection.OTHER_TIP, self._other_tip)]
        self.pairing.unbar()
        return []

    def _deflect(self, paired: PairedWrench) -> Deflected | Rejected:
        stamp_ns, raw, joints, tag, number = paired
        topic = self.pairing.wrench_topic
        fed_ns = self._fed_ns
        if fed_ns is not None and stamp_ns <= fed_ns:
            detail = f"{topic} is out of order: hysteresis takes loads in their order"
            return self.pairing.reject(stamp_ns, ModelRejection.OUT_OF_ORDER, detail, number)
        if fed_ns is not None and stamp_ns - fed_ns > self._memory_gap_ns:
            self.forget(f"no usable {topic} for {(stamp_ns - fed_ns) * 1e-9:.3f} s")
        assert self._stream is not None
        at = np.array(joints)
        try:
            predicted = self._stream.step(stamp_ns, at, raw)
        except KinematicsError as error:
            detail = f"joint_states say what the arm can't do: {error}"
            return self.pairing.reject(stamp_ns, ModelRejection.OUT_OF_REACH, detail, number)
        self._fed_ns = stamp_ns
        mean = predicted.mean.tolist()
        # As with wrenches, one sum finds what is not finite.
        if not np.isfinite(predicted.covariance.sum() + sum(mean)):
            self.forget("the model gave a value that is not finite")
            detail = "the model gives a value that is not finite"
            return self.pairing.reject(stamp_ns, ModelRejection.NONFINITE, detail, number)
        self.predicted += 1
        self.extrapolated += predicted.extrapolated
        tip = corrected_tip(*self._stream.tip_pose(at), mean)
        self.last = Deflected(stamp_ns, predicted, tip, tag, number, joints)
        return self.last


class GravcompState(NamedTuple):
    """The report of galen_gravcomp on /diagnostics: tool, when it was calibrated, tare.

    tool: empty where none is loaded; tip_m (3,) in ft_sensor, m. tare: the offset subtracted, as
    text; ramping: it still comes in.
    """

    tool: str
    tip_m: Array | None
    calibrated_at: str
    tare: str
    ramping: bool

    @classmethod
    def of(cls, values: Mapping[str, str]) -> GravcompState:
        """Make it from a report's values; what lacks is empty.

        Args:
            values: texts by key, of galen_gravcomp's status on /diagnostics.

        Returns:
            The state.

        """
        try:
            tip = np.array([float(word) for word in values.get("tip_m", "").split()])
        except ValueError:
            tip = np.zeros(0)
        known = tip.shape == (3,) and bool(np.isfinite(tip).all())
        return cls(
            tool=values.get("tool", ""),
            tip_m=tip if known else None,
            calibrated_at=values.get("calibrated_at", ""),
            tare=f"{values.get('tare_force_n', '')} {values.get('tare_torque_nm', '')}".strip(),
            ramping=values.get("tare", "") == "ramping",
        )

    def change_since(self, before: GravcompState) -> str:
        """Return what changed of the wrench's meaning.

        Args:
            before: an earlier state.

        Returns:
            In words; empty if nothing did.

        """
        if self.tool != before.tool:
            return f"gravcomp's tool changed from '{before.tool}' to '{self.tool}'"
        if self.calibrated_at != before.calibrated_at:
            return f"gravcomp loaded another calibration of '{self.tool}'"
        if self.tare != before.tare or self.ramping != before.ramping:
            return "gravcomp's tare changed"
        return ""


def corrected_tip(
    rotation: Array, position: Array, deflection: Sequence[float]
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Displace the tip's pose by a deflection.

    A deflection is a rigid displacement: its translation adds to the tip's position, its rotation
    vector, along the axes of base_link, turns the tip after the joints have, R' = exp(r^) R.

    Args:
        rotation: (3, 3), of the tip in base_link by the joints.
        position: (3,), of the tip in base_link by the joints, m.
        deflection: (6,), translation (m) and rotation vector (rad) in base_link.

    Returns:
        Position (3,), m, and quaternion xyzw, in base_link.

    """
    x, y, z, w = matrix_to_quaternion(rotation).tolist()
    px, py, pz = position.tolist()
    dx, dy, dz, rx, ry, rz = deflection
    angle = math.sqrt(rx * rx + ry * ry + rz * rz)
    # sin(angle / 2) / angle; below, the next term of its series is lost in rounding
    scale = math.sin(0.5 * angle) / angle if angle > 1e-9 else 0.5
    a, b, c, d = scale * rx, scale * ry, scale * rz, math.cos(0.5 * angle)
    return (px + dx, py + dy, pz + dz), (
        d * x + a * w + b * z - c * y,
        d * y + b * w + c * x - a * z,
        d * z + c * w + a * y - b * x,
        d * w - a * x - b * y - c * z,
    )


def _apart(one: Array, other: Array) -> bool:
    return float(np.linalg.norm(one - other)) > TIP_TOLERANCE_M


def _point(point: Array) -> str:
    return "(" + ", ".join(f"{value:.6g}" for value in point) + ")"
