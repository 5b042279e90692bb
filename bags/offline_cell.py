# SPDX-License-Identifier: Apache-2.0
"""The simulated cell for sample bags and tests: no ROS, stepped as fast as it goes.

What `sim_driver_node` and `calibration_node` do over topics and services is done here by calls,
between two steps of the plant. So services answer at once, and the wall clock runs with the stamps.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from galen_bags.formats.writer import BagWriter
from galen_calibration_behavior.calibration.procedure import (
    CalibrationProcedure,
    CalibrationRequest,
)
from galen_calibration_behavior.common.commands import (
    AttachTool,
    Command,
    Measurements,
    PoseFeedback,
    PosesEnd,
    ZeroSensor,
)
from galen_calibration_behavior.common.parameters import CalibrationParameters
from galen_common.cdr import joint_state_bytes, pose_bytes, wrench_bytes
from galen_common.goal.procedure import MoveTo, Stop
from galen_model.arm.galen import GALEN, TRACKER_FRAME
from galen_model.errors import GalenError
from galen_sim_driver.plant.cell import Plant, Sample
from galen_sim_driver.plant.config import PlantError
from galen_sim_driver.plant.motion import Trajectory, TrajectoryPoint
from galen_sim_driver.plant.sensors import Zeroing
from numpy import array

_WALL_TICK_NS = 100_000_000
# A message is logged this long after its stamp, and each further one of a step so much later:
# made up, of the size that a recorder on the same machine has, so that log times differ from stamps
# and tell the order in which the driver publishes.
DELAY_NS = 200_000
NEXT_MESSAGE_NS = 50_000
# Poses of the tracker are rounded to 1e-7 (m; 1 in a quaternion), three hundred times finer than
# its noise: they alone come unrounded from LAPACK, whose last bits differ between processors.
_POSE_DIGITS = 7


class OfflineCalibrationError(GalenError):
    """The calibration ended without measurements; the message is the procedure's own."""


class OfflineCell:
    """A plant and the listeners to its samples."""

    def __init__(self, plant: Plant, listeners: Sequence[Callable[[Sample], object]] = ()) -> None:
        """Call `listeners` with every sample, in this order."""
        self.plant = plant
        self._listeners = list(listeners)

    def step(self) -> Sample:
        """Go on by one period."""
        sample = self.plant.step()
        for listener in self._listeners:
            listener(sample)
        return sample

    def run(self, duration_s: float) -> None:
        """Go on for this long, by the stamps."""
        end_ns = self.plant.now_ns + round(duration_s * 1e9)
        while self.plant.now_ns < end_ns:
            self.step()

    def move_to(self, joints: Sequence[float], duration_s: float) -> None:
        """Order a move from rest to rest to `joints` (5,), m and rad, as the calibration does."""
        rest = [0.0] * len(GALEN.joint_names)
        point = TrajectoryPoint(duration_s, [float(value) for value in joints], rest, rest)
        self.plant.command(Trajectory(list(GALEN.joint_names), [point]))

    def play_hand(self) -> None:
        """Play the hand's script to its end."""
        self.plant.start_hand()
        while self.plant.hand_active:
            self.step()

    def calibrate(
        self,
        settings: CalibrationParameters,
        request: CalibrationRequest,
        *,
        zero_window_s: float = 0.5,
        on_feedback: Callable[[PoseFeedback, int], object] = lambda feedback, stamp_ns: None,
    ) -> Measurements:
        """Run a whole calibration and return what it would estimate from.

        The request must attach the tool by service, without a person. `zero_window_s` is the
        driver's `bias_window_s`; `on_feedback` gets each feedback and the stamp it came at. Raises
        OfflineCalibrationError.
        """
        if not request.attach_by_service:
            raise OfflineCalibrationError("no person puts the tool on: attach it by service")
        run = _Calibration(self, CalibrationProcedure(settings, request), zero_window_s)
        return run.finish(on_feedback)


class _Calibration:
    """One calibration under way."""

    def __init__(
        self, cell: OfflineCell, procedure: CalibrationProcedure, zero_window_s: float
    ) -> None:
        self._cell = cell
        self._procedure = procedure
        self._zero_window_s = zero_window_s
        self._zeroing: Zeroing | None = None
        self._measurements: Measurements | None = None

    def finish(self, on_feedback: Callable[[PoseFeedback, int], object]) -> Measurements:
        procedure, plant = self._procedure, self._cell.plant
        procedure.start()
        next_tick_ns = plant.now_ns
        while True:
            while commands := procedure.take_commands():
                for command in commands:
                    if isinstance(command, PoseFeedback):
                        on_feedback(command, plant.now_ns)
                    elif isinstance(command, PosesEnd) and self._measurements is None:
                        raise OfflineCalibrationError(
                            f"{command.error_code.name}: {command.error_msg}"
                        )
                    self._obey(command)
            if self._measurements is not None:
                return self._measurements
            self._hear(self._cell.step())
            if plant.now_ns >= next_tick_ns:
                next_tick_ns += _WALL_TICK_NS
                procedure.on_wall(plant.now_ns * 1e-9)

    def _hear(self, sample: Sample) -> None:
        procedure = self._procedure
        procedure.on_joints(sample.stamp_ns, array(sample.positions), array(sample.velocities))
        procedure.on_wrench(sample.stamp_ns, array(sample.wrench))
        if self._zeroing is not None and self._zeroing.done:
            error, self._zeroing = self._zeroing.error, None
            procedure.on_service(error is None, "" if error is None else str(error))

    def _obey(self, command: Command) -> None:
        plant, procedure = self._cell.plant, self._procedure
        match command:
            case MoveTo():
                self._cell.move_to(command.joints.tolist(), command.duration_s)
            case Stop():
                plant.stop()
            case ZeroSensor():
                try:
                    self._zeroing = plant.start_zeroing(self._zero_window_s)
                except PlantError as error:
                    procedure.on_service(False, str(error))
            case AttachTool():
                try:
                    plant.attach_tool(command.tool)
                except PlantError as error:
                    procedure.on_service(False, str(error))
                else:
                    procedure.on_service(True, "")
            case Measurements():
                self._measurements = command


class CellBag:
    """The driver's topics in an open bag; call it with each sample."""

    def __init__(self, bag: BagWriter, *, tracker: bool = False) -> None:
        """`tracker`: with both tracker topics."""
        self._bag = bag
        self._joint_states = bag.add_topic("joint_states", "sensor_msgs/msg/JointState")
        self._wrench_raw = bag.add_topic("wrench_raw", "geometry_msgs/msg/WrenchStamped")
        self._joint_bytes = joint_state_bytes(GALEN.joint_names)
        self._wrench_bytes = wrench_bytes(GALEN.sensor_frame)
        self._tracker = tracker
        if tracker:
            pose = "geometry_msgs/msg/PoseStamped"
            self._tool_pose = bag.add_topic("tracker/tool_pose", pose)
            self._base_pose = bag.add_topic("tracker/base_pose", pose)
            self._pose_bytes = pose_bytes(TRACKER_FRAME)

    def __call__(self, sample: Sample) -> None:
        """Write what the driver publishes of this sample, in its order."""
        stamp_ns = sample.stamp_ns
        messages = [
            (
                self._joint_states,
                self._joint_bytes.fill(stamp_ns, sample.positions, sample.velocities),
            ),
            (self._wrench_raw, self._wrench_bytes.fill(stamp_ns, sample.wrench)),
        ]
        if self._tracker and sample.tracker is not None:
            topics = (self._tool_pose, self._base_pose)
            for topic, seen in zip(topics, sample.tracker, strict=True):
                if seen is not None:  # there is no tool marker without a tool
                    position, turn = seen
                    data = self._pose_bytes.fill(stamp_ns, _rounded(position), _rounded(turn))
                    messages.append((topic, data))
        for number, (topic, data) in enumerate(messages):
            self._bag.write(topic, stamp_ns + DELAY_NS + number * NEXT_MESSAGE_NS, data)


def _rounded(values: Sequence[float]) -> list[float]:
    return [round(value, _POSE_DIGITS) for value in values]
